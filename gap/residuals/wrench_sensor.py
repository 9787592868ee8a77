"""Force sensors of a scene, and what a tool's own motion adds to their readings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame

from makebreak.gap.data.recording import Recording
from makebreak.models.dynamics import SceneDynamics

FORCE, MOMENT = ("fx", "fy", "fz"), ("tx", "ty", "tz")


@dataclass(frozen=True, eq=False)
class WrenchSensor:
    """A force sensor at a frame: what acts on the bodies `welded` to that of the frame.

    names: of its channels, forces and then, where they were measured, moments about the
    frame's origin, all in world axes; first: of its rows among those of all sensors.
    """

    place: str
    frame: Frame
    welded: list[int]
    names: tuple[str, ...]
    first: int

    @property
    def forces(self) -> slice:
        return slice(self.first, self.first + len(FORCE))

    @property
    def rows(self) -> slice:
        return slice(self.first, self.first + len(self.names))

    @property
    def moments(self) -> slice:
        return slice(self.forces.stop, self.rows.stop)

    @property
    def feels_moments(self) -> bool:
        return len(self.names) > len(FORCE)


def wrench_sensors(
    plant: MultibodyPlant, recordings: Sequence[Recording]
) -> list[WrenchSensor]:
    """The sensors at frames of the plant whose forces are in all recordings, with their
    moments where all recordings have these too."""
    sensors: list[WrenchSensor] = []
    first = 0
    for place in recordings[0].places(FORCE):
        frame = frame_of(plant, place)
        forces, moments = (
            tuple(f"{place}.{a}" for a in axes) for axes in (FORCE, MOMENT)
        )
        if frame is None or not all(n in r for n in forces for r in recordings):
            continue
        names = forces
        if all(n in r for n in moments for r in recordings):
            names += moments
        welded = [int(b.index()) for b in plant.GetBodiesWeldedTo(frame.body())]
        sensors.append(WrenchSensor(place, frame, welded, names, first))
        first += len(names)
    return sensors


def frame_of(plant: MultibodyPlant, place: str) -> Frame | None:
    """The frame "model.name", if the plant has it."""
    model, name = place.split(".", 1)
    if not plant.HasModelInstanceNamed(model):
        return None
    instance = plant.GetModelInstanceByName(model)
    if not plant.HasFrameNamed(name, instance):
        return None
    return plant.GetFrameByName(name, instance)


def felt_motion(dynamics: SceneDynamics, frame: Frame, q, v, vd) -> np.ndarray:
    """What a tool's own motion adds to a force sensor in its mount, from which the
    weight alone is taken off: -m a, and its moment about the frame.

    Args: frame, of the sensor, on the tool; q (n, n_q), v, vd (n, n_v).
    Returns: (n, 6), force first, in world axes [N], [N m].
    """
    body = frame.body()
    mass = body.default_mass()
    if not mass > 0.0:
        return np.zeros((len(q), 6))
    _, V, A, R = dynamics.body_motion(body, q, v, vd)
    w, alpha = V[:, :3], A[:, :3]
    arm = R @ body.default_com()  # To the centre of mass, from the body's origin.
    a = A[:, 3:] + np.cross(alpha, arm) + np.cross(w, np.cross(w, arm))
    about = body.default_spatial_inertia().Shift(body.default_com())
    I_W = R @ about.CalcRotationalInertia().CopyToFullMatrix3() @ R.transpose(0, 2, 1)
    spin = np.einsum("nij,nj->ni", I_W, alpha)
    spin += np.cross(w, np.einsum("nij,nj->ni", I_W, w))
    from_frame = arm - R @ frame.GetFixedPoseInBodyFrame().translation()
    return np.hstack([-mass * a, -mass * np.cross(from_frame, a) - spin])

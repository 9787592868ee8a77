"""Errors of a real station that its model lacks: the `realism` setting.

A level gives the size of the errors; the seed draws them. They are constant over
trials, as on a robot, and unknown to the controllers. make_station puts all of them
into its world.
"""

from copy import deepcopy
from dataclasses import dataclass, field

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.schema import Transform
from pydrake.math import RigidTransform, RollPitchYaw

from makebreak.diagrams.scene_facts import N_JOINTS, PANDA_JOINTS
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import Scene
from makebreak.models.typed_yaml import nearest


@dataclass(frozen=True)
class Level:
    """Sizes of the errors."""

    encoder: float  # Standard deviation of each encoder's offset [rad].
    tool: float  # Length of the tool beyond the model's [m].
    tilt: float  # Of the table, in a random direction [rad].
    force: float  # Largest bias of each force component [N].
    drift: float  # Largest drift of each force component [N/s].
    delay: float  # Of encoders and wrench [s].


REALISM = {
    "none": Level(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "lab": Level(5e-4, 0.002, np.radians(0.5), 0.5, 0.01, 0.001),
    "poor": Level(1e-3, 0.004, np.radians(1.0), 1.0, 0.03, 0.003),
}
REACH = 0.7  # Typical distance from an encoder to the tip [m].
# Where the arm works, x and y [m]: there a tilted table has the modelled height.
WORKPLACE = (0.5, 0.0)


@dataclass(frozen=True, eq=False)
class StationErrors:
    """The errors of one station; none by default."""

    encoders: np.ndarray = field(default_factory=lambda: np.zeros(N_JOINTS))  # [rad]
    tool: float = 0.0  # [m]
    tilt: np.ndarray = field(default_factory=lambda: np.zeros(2))  # Roll, pitch [rad].
    force_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [N]
    force_drift: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [N/s]
    delay: float = 0.0  # [s]

    @property
    def place(self) -> float:
        """Typical error of the tip's position by the encoders [m]."""
        return abs(self.tool) + 3.0 * REACH * float(np.std(self.encoders))

    def table_rise(self, p, origin, corner: float = 0.0) -> np.ndarray:
        """Height above a level table at which an upright tool touches the tilted one,
        (n,) [m].

        Args:
            p: (n, 3) positions of the tool in the world [m].
            origin: (3,) point about which the table is tilted [m].
            corner: from p to the corners of the tool, in x and in y [m].
        """
        roll, pitch = self.tilt
        # The table's normal, Ry(pitch) Rx(roll) z.
        normal = np.array([
            np.sin(pitch) * np.cos(roll),
            -np.sin(roll),
            np.cos(pitch) * np.cos(roll),
        ])  # fmt: skip
        away = np.asarray(p)[:, :2] - np.asarray(origin)[:2]
        slope = -normal[:2] / normal[2]
        return away @ slope + corner * float(np.abs(slope).sum())


def draw_errors(level: str, seed: int) -> StationErrors:
    """The errors of the station of this seed.

    Raises: ValueError for an unknown level or a negative seed.
    """
    if level not in REALISM:
        raise ValueError(f"realism is {level!r}: {nearest(level, REALISM)}")
    if seed < 0:
        raise ValueError(f"seed is {seed}, expected an integer of 0 or more")
    size = REALISM[level]
    rng = np.random.default_rng([seed, 23])
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return StationErrors(
        encoders=size.encoder * rng.normal(size=N_JOINTS),
        tool=size.tool,
        tilt=size.tilt * np.array([np.cos(angle), np.sin(angle)]),
        force_bias=size.force * rng.uniform(-1.0, 1.0, size=3),
        force_drift=size.drift * rng.uniform(-1.0, 1.0, size=3),
        delay=size.delay,
    )


def with_errors(scene: Scene, errors: StationErrors, arm: str, tool: str) -> Scene:
    """The world scene with these errors, except those of the wrench and the delays.

    The table is the first model beside the arm that is welded to the world. What
    stands on it is tilted with it, so that it rests on it as before.

    Args: arm, tool: names of models; the tool is welded to the arm.
    """
    scene = deepcopy(scene)
    joints = [f"{arm}.{joint}" for joint in PANDA_JOINTS]
    for joint, offset in zip(joints, errors.encoders.tolist(), strict=True):
        if offset != 0.0:
            scene.effects.append(Effect("joint_offset", [joint], {"offset": offset}))
    if np.any(errors.tilt):
        _tilt_table(scene, errors, arm)
    for directive in scene.directives:
        weld = directive.add_weld
        if weld is not None and weld.child.split("::")[0] == tool and errors.tool:
            if weld.X_PC is None:
                weld.X_PC = Transform()
            x, y, z = np.array(weld.X_PC.translation, dtype=float)
            weld.X_PC.translation = [x, y, z + errors.tool]
    return scene


def _tilt_table(scene: Scene, errors: StationErrors, arm: str) -> None:
    weld = next(
        weld
        for weld in (d.add_weld for d in scene.directives)
        if weld is not None
        and weld.parent == "world"
        and weld.child.split("::")[0] != arm
    )
    table = weld.child.split("::")[0]
    roll, pitch = errors.tilt.tolist()
    scene.effects.append(Effect("plane_tilt", [table], {"roll": roll, "pitch": pitch}))
    R, lift = RollPitchYaw(roll, pitch, 0.0).ToRotationMatrix(), 0.0
    if weld.X_PC is None:
        # Tilted about the arm's base, it would be 5 mm too high where the arm works.
        origin = np.zeros(3)
        lift = -float(errors.table_rise(np.array([WORKPLACE]), origin)[0])
        scene.effects.append(Effect("plane_height", [table], {"height": lift}))
    else:
        origin = np.array(weld.X_PC.translation, dtype=float)
    moved = RigidTransform(R, origin - R @ origin + [0.0, 0.0, lift])
    for body, pose in scene.initial.poses.items():
        # Normalised, as a quaternion that was typed in is not exactly.
        q = np.array(pose[:4], dtype=float)
        X = moved @ RigidTransform(Quaternion(q / np.linalg.norm(q)), pose[4:])
        quaternion = X.rotation().ToQuaternion().wxyz()
        scene.initial.poses[body] = [*quaternion.tolist(), *X.translation().tolist()]

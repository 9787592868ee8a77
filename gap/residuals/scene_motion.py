"""The measured motion of a scene: what recordings show of each coordinate, smoothed."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody

from makebreak.gap.data.recording import Episode, Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.permitted_forces import FEWEST
from makebreak.gap.residuals.wrench_sensor import wrench_sensors
from makebreak.gap.simulation.contact_shapes import ContactShapes, poses_of
from makebreak.gap.simulation.windows import TURN, spin_of
from makebreak.models.drives import law_of
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import full_name, one_dof_joints, sliding_joints
from makebreak.models.scene import Scene
from makebreak.models.scene_schema import COMMANDS_OF
from makebreak.systems.numerics.smoother import Smoothed, blur_sec, smooth_filtered

SAMPLES = 8  # Of the slowest pose, in half a test function.
LEAST_HALF, MOST_HALF = 0.05, 0.2  # [s]
FEWEST_ROWS, FEWEST_SAMPLES = 24, 12  # Of an episode, and of a channel in it.
POSE = (*TURN, "x", "y", "z")


@dataclass(frozen=True, eq=False)
class SmoothedEpisode:
    """The motion of an episode of n rows: positions, and by smoothing them velocities
    and accelerations."""

    recording: int  # Its index.
    episode: Episode
    time: np.ndarray  # (n,) [s]
    q: np.ndarray  # (n, n_q)
    v: np.ndarray  # (n, n_v)
    vd: np.ndarray  # (n, n_v)
    blur: np.ndarray  # (n_v,) [s] over which smoothing spreads a jump (blur_sec).
    turn: dict[str, np.ndarray] = field(default_factory=dict)  # {body: (n, 4) w x y z}


class SceneMotion:
    """The recordings of a scene as its coordinates, drives, sensors and their motion.

    Attributes:
        joints, bodies: {name: (index in q, in v)} of joints and free bodies.
        objects: {link that nothing drives: see _read_objects}.
        coordinates: (n_v,) names. by, sensors, n_wrench, extra: see the methods.
        tracks: the episodes, smoothed; their rows one after the other are those of all.
        half: half width of a test function [s].

    Raises: DoesNotFit where the recordings lack a part of the motion (a position of
        every joint, a whole pose of every free body), or no episode is long enough.
    """

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        self.scene, self.recordings = scene, list(recordings)
        self.dynamics = SceneDynamics(scene)
        self.plant: MultibodyPlant = self.dynamics.plant
        self.shapes = ContactShapes(self.dynamics.loaded)
        self._read_coordinates()
        self._check_positions()
        self._read_drives()
        self._read_objects()
        self.sensors = wrench_sensors(self.plant, self.recordings)
        self.n_wrench = sum(len(sensor.names) for sensor in self.sensors)
        self._read_extra()
        self.tracks: list[SmoothedEpisode] = []
        for i, recording in enumerate(self.recordings):
            for episode in recording.episodes:
                track = self._smoothed(i, recording, episode)
                if track is not None:
                    self.tracks.append(track)
        if not self.tracks:
            raise DoesNotFit("no episode is long enough for equations of motion")
        self._offset = np.cumsum([0, *(len(t.time) for t in self.tracks)])
        self._q = np.vstack([t.q for t in self.tracks])
        self._v = np.vstack([t.v for t in self.tracks])
        # What a velocity may be off by where it just jumped.
        self._v_off = np.vstack([t.vd * t.blur for t in self.tracks])
        self._vd = np.vstack([t.vd for t in self.tracks])
        self._choose_half()

    def _read_coordinates(self) -> None:
        """joints, bodies and coordinates."""
        plant = self.plant
        self.joints = {
            full_name(plant, j): (j.position_start(), j.velocity_start())
            for j in one_dof_joints(plant)
            if j.num_velocities()
        }
        self.bodies: dict[str, tuple[int, int]] = {}
        for i in sorted(plant.GetFloatingBaseBodies()):
            body = plant.get_body(i)
            if not body.has_quaternion_dofs():
                raise DoesNotFit("a floating base without a quaternion")
            self.bodies[full_name(plant, body)] = (
                body.floating_positions_start(),
                body.floating_velocities_start_in_v(),
            )
        n = len(self.joints) + 6 * len(self.bodies)
        if n != plant.num_velocities():
            raise DoesNotFit(
                "the scene has other joints than those with one coordinate"
            )
        self.coordinates = [""] * plant.num_velocities()
        for joint, (_, i) in self.joints.items():
            self.coordinates[i] = joint
        for body, (_, i) in self.bodies.items():
            for k, axis in enumerate(("rx", "ry", "rz", "x", "y", "z")):
                self.coordinates[i + k] = f"{body}.{axis}"

    def _check_positions(self) -> None:
        for recording in self.recordings:
            for joint in self.joints:
                if f"{joint}.position" not in recording:
                    raise DoesNotFit(f"expected {joint}.position")
            for body in self.bodies:
                if not all(f"{body}.{a}" in recording for a in POSE):
                    raise DoesNotFit(f"expected the whole pose of {body}")

    def _read_drives(self) -> None:
        """by: {joint: how its effort is known}: "law" (the drive's, from commands and
        positions), "command", "measured", "passive" (no drive), or "", not known."""
        act = self.scene.actuation
        takes = COMMANDS_OF[act.type]
        self.by: dict[str, str] = {}
        for joint in self.joints:
            own = [f"{joint}.{what}" for what in takes]
            given = joint in act.joints and all(
                any(name in r for name in own) for r in self.recordings
            )
            if given:
                self.by[joint] = "law" if law_of(act, joint) is not None else "command"
            elif all(f"{joint}.effort_measured" in r for r in self.recordings):
                self.by[joint] = "measured"
            else:
                self.by[joint] = "" if joint in act.joints else "passive"

    def _read_objects(self) -> None:
        """objects: {link with shapes that passive joints alone move: indices in v of
        those that slide, and that turn}. It is pushed as a free body is, and its mass
        is no better known."""
        plant, slides = self.plant, sliding_joints(self.plant)
        passive: dict[str, list[int]] = {}
        driven: set[str] = set()
        for index in plant.GetJointIndices():
            if not plant.get_joint(index).num_velocities():
                continue
            name = full_name(plant, plant.get_joint(index))
            for k in plant.GetBodiesKinematicallyAffectedBy([index]):
                body = full_name(plant, plant.get_body(k))
                if self.by.get(name) == "passive":
                    passive.setdefault(body, []).append(self.joints[name][1])
                else:  # Or it floats.
                    driven.add(body)
        shown = {
            full_name(plant, self._heaviest_welded_to(BodyIndex(k)))
            for k in self.shapes.bodies()
        }
        sliding = {self.joints[name][1] for name in slides if name in self.joints}
        self.objects = {
            body: (np.array([i for i in index if i in sliding], int),
                   np.array([i for i in index if i not in sliding], int))
            for body, index in passive.items() if body in shown and body not in driven
        }  # fmt: skip

    def _heaviest_welded_to(self, index: BodyIndex) -> RigidBody:
        """One rigid body has one mass, wherever its shapes are."""
        body = self.plant.get_body(index)
        welded = self.plant.GetBodiesWeldedTo(body)
        return max(welded, key=lambda each: each.default_mass())

    def _read_extra(self) -> None:
        """extra: redundant channels, measured rates and efforts that must agree with
        positions and commands, with the coordinate (index in v) of each."""
        extra: list[tuple[str, int]] = []
        for joint, (_, i) in self.joints.items():
            extra.append((f"{joint}.velocity", i))
            if self.by[joint] in ("law", "command"):
                extra.append((f"{joint}.effort_measured", i))
        for body, (_, i) in self.bodies.items():
            for k, axis in enumerate(("wx", "wy", "wz", "vx", "vy", "vz")):
                extra.append((f"{body}.{axis}", i + k))
        self.extra = [
            (name, i) for name, i in extra if all(name in r for r in self.recordings)
        ]

    def _smoothed(
        self, i: int, recording: Recording, episode: Episode
    ) -> SmoothedEpisode | None:
        """The motion of an episode; None where it or a channel of it is too short."""
        time = recording.time[episode.rows]
        if len(time) < FEWEST_ROWS:
            return None
        n, n_v = len(time), self.plant.num_velocities()
        default = self.plant.GetPositions(self.plant.CreateDefaultContext())
        v, vd, blur = np.zeros((n, n_v)), np.zeros((n, n_v)), np.zeros(n_v)
        track = SmoothedEpisode(i, episode, time, np.tile(default, (n, 1)), v, vd, blur)
        whole = all(
            _fill_joint(track, recording, joint, *index)
            for joint, index in self.joints.items()
        ) and all(
            _fill_body(track, recording, body, *index)
            for body, index in self.bodies.items()
        )
        return track if whole else None

    def _choose_half(self) -> None:
        """Half a test function: as many samples of the slowest pose as it needs."""
        slowest = 0.0
        names = [f"{j}.position" for j in self.joints]
        names += [f"{b}.{a}" for b in self.bodies for a in POSE]
        for recording in self.recordings:
            for name in names:
                for episode in recording.episodes:
                    t, _ = recording.samples(name, episode)
                    if len(t) > 2:
                        slowest = max(slowest, float(np.median(np.diff(t))))
        self.half = float(np.clip(SAMPLES * slowest, LEAST_HALF, MOST_HALF))
        self._least_half = max(0.5 * (FEWEST + 1) * slowest, LEAST_HALF)

    def _poses_at(self, q: np.ndarray):
        """poses_of the shapes at q (n, n_q)."""
        return poses_of(self.plant, q, self.shapes)


def _smooth(track: SmoothedEpisode, recording: Recording, name: str) -> Smoothed | None:
    """A channel in the episode, without its filters' delay; None: too few samples."""
    channel = recording.channels[name]
    y = recording[name][track.episode.rows]
    if np.isfinite(y).sum() < FEWEST_SAMPLES:
        return None
    return smooth_filtered(track.time, y, channel.noise, channel.stages or ())


def _blur(track: SmoothedEpisode, recording: Recording, name: str, s: Smoothed):
    """[s] over which the smoothed channel spreads a jump."""
    t, _ = recording.samples(name, track.episode)
    every = float(np.median(np.diff(t)))
    return blur_sec(recording.channels[name].noise, every, s.density)


def _fill_joint(track, recording: Recording, joint: str, i_q: int, i_v: int) -> bool:
    """Fills in a joint's coordinate; returns whether it has enough samples."""
    name = f"{joint}.position"
    s = _smooth(track, recording, name)
    if s is None:
        return False
    track.q[:, i_q], track.v[:, i_v], track.vd[:, i_v] = s.x.T
    track.blur[i_v] = _blur(track, recording, name, s)
    return True


def _fill_body(track, recording: Recording, body: str, i_q: int, i_v: int) -> bool:
    """Fills in a free body's seven positions, with the quaternion normalised, and six
    velocities; returns whether they have enough samples."""
    names = [f"{body}.{a}" for a in POSE]
    each = [s for n in names if (s := _smooth(track, recording, n)) is not None]
    if len(each) < len(names):
        return False
    q, v, vd = track.q, track.v, track.vd
    turn = np.stack([s.x for s in each[:4]], axis=1)
    size = np.linalg.norm(turn[:, :, 0], axis=1)[:, None]
    unit, rate = turn[:, :, 0] / size, turn[:, :, 1] / size
    q[:, i_q : i_q + 4] = unit
    v[:, i_v : i_v + 3] = spin_of(unit, rate)
    vd[:, i_v : i_v + 3] = spin_of(unit, turn[:, :, 2] / size)
    track.turn[body] = unit
    for k in range(3):
        q[:, i_q + 4 + k], v[:, i_v + 3 + k], vd[:, i_v + 3 + k] = each[4 + k].x.T
    blur = [_blur(track, recording, n, s) for n, s in zip(names, each, strict=True)]
    track.blur[i_v : i_v + 3] = min(blur[:4])  # By the part that turns most.
    track.blur[i_v + 3 : i_v + 6] = blur[4:]
    return True

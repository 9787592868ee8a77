"""Means of what was measured, over short whiles in which no contact comes or goes.

Positions alone are differentiated, within the test function of each mean
(numerics/permitted_forces.py); an effort is what the drive's law makes of commands and
encoders, so that its ripple between rows does not matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame
from scipy.sparse import block_diag, csr_matrix
from scipy.spatial.transform import Rotation

from makebreak.gap.data.recording import Episode, Recording
from makebreak.gap.numerics.permitted_forces import (
    FEWEST,
    RATE_OF_MEAN,
    held_means,
    test_functions,
)
from makebreak.gap.residuals.contact_shapes import ContactShapes, Slot, poses_of
from makebreak.gap.simulation.free_windows import IMPACT_ACCELERATION
from makebreak.gap.simulation.windows import TURN, spin_of
from makebreak.models.drives import law_of
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import full_name, one_dof_joints
from makebreak.models.scene import Scene
from makebreak.models.scene_schema import COMMANDS_OF
from makebreak.systems.numerics.smoother import Smoothed, blur_sec, smooth_filtered

SAMPLES = 8  # Of the slowest pose, in half a test function.
LEAST_HALF, MOST_HALF = 0.05, 0.2  # [s]
HOP = 0.75  # From one test function to the next, in half widths.
NODES = 5  # Rows of a test function at which geometry and dynamics are evaluated.
MOST = 420  # Test functions at most, and how many of them without a moving object.
STILL = 80
FEWEST_MEANS = 30
BETWEEN_ROWS = 1.5  # Commands from one row to the next: more, and some are not known.
BESIDE = -1  # Marks what a body touches beside what carries it.
FAR = 1.0  # Of what is not there [m].
UPRIGHT = 0.7  # Cosine of normal and vertical: less, and it is a wall.
NEAR = 0.02  # Shapes that never come so near do not matter [m].
ROBUST = 1.4826  # Standard deviation over median deviation, of normal noise.
MEETS = 2.5e-3  # Two bodies touch when the nearest points are within this [m].
APPROACH = 0.02  # Faster along the normal is no lasting contact [m/s].
SLIDES = 0.01  # Slower slip may be sticking [m/s].
MODELLED = 0.02  # What models are off by, as a share of the forces in a row.
# A force is felt where the mean of so many samples is clear of noise, and at least this
# [N]; where one may be felt, the mean over a test function is so many times its noise.
FELT_SAMPLES, LEAST_FELT, MAYBE_FELT = 9, 0.2, 4.0
SHORT = 0.5  # Of half a test function: a contact that is lost for less goes on.
# A tool farther than this from everything touches nothing [m]. The farthest share of
# such rows, if they last so long in an episode, and in all [s], show what its force
# sensor reads then: a bias, if it is this large [N] and so many times what these rows
# scatter by.
FREE, FARTHEST, FREE_SEC, ALL_FREE_SEC = 4e-3, 0.5, 0.1, 0.3
LEAST_BIAS, STEADY_BIAS = 0.1, 1.5
POSE = (*TURN, "x", "y", "z")
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


@dataclass(frozen=True, eq=False)
class _Track:
    """An episode, smoothed: n rows. blur (n_v,): as of blur_sec."""

    recording: int
    episode: Episode
    time: np.ndarray
    q: np.ndarray
    v: np.ndarray
    vd: np.ndarray
    blur: np.ndarray
    turn: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(eq=False)
class _Means:
    """Means over K test functions; n_v coordinates. acceleration and effort (K, n_v)
    with variances; centre: row of the middle among all rows; nodes: rows at which
    things are evaluated, weights (K, n_nodes)."""

    episode: np.ndarray
    time: np.ndarray
    acceleration: np.ndarray
    acceleration_var: np.ndarray
    effort: np.ndarray
    effort_var: np.ndarray
    effort_slope: np.ndarray  # By a delay of all commands [N/s].
    centre: np.ndarray
    weights: csr_matrix
    wrench: np.ndarray  # (K, n_wrench), forces and moments of all sensors
    wrench_var: np.ndarray
    extra: np.ndarray  # (K, n_extra) measured rates and efforts less what they must be.
    extra_var: np.ndarray

    def of(self, some: np.ndarray) -> "_Means":
        """Of some (K,) test functions."""
        return _Means(**{name: x[some] for name, x in vars(self).items()})


class ContactMeans:
    """The recordings of a scene as means over test functions.

    Raises: ValueError where the recordings do not tell the whole motion (a position of
        every joint, a whole pose of every free body), or hold too little of it.
    """

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        self.scene, self.recordings = scene, list(recordings)
        self.dynamics = SceneDynamics(scene)
        self.plant: MultibodyPlant = self.dynamics.plant
        self.shapes = ContactShapes(self.dynamics.loaded)
        self._read_coordinates()
        self._read_drives()
        self._read_sensors()
        self.tracks: list[_Track] = []
        for i, recording in enumerate(self.recordings):
            for episode in recording.episodes:
                track = self._track(i, recording, episode)
                if track is not None:
                    self.tracks.append(track)
        if not self.tracks:
            raise ValueError("no episode is long enough for equations of motion")
        self._offset = np.cumsum([0, *(len(t.time) for t in self.tracks)])
        self._q = np.vstack([t.q for t in self.tracks])
        self._v = np.vstack([t.v for t in self.tracks])
        # What a velocity may be off by where it just jumped.
        self._v_off = np.vstack([t.vd * t.blur for t in self.tracks])
        self._vd = np.vstack([t.vd for t in self.tracks])
        self._choose_half()
        self._touching = self._touching_rows()
        self.means = self._all_means()
        if len(self.means.time) < FEWEST_MEANS:
            raise ValueError("the recordings hold too little motion")

    # ----- What is there

    def _read_coordinates(self) -> None:
        """joints: {name: (index in q, in v)}; bodies: {name: (index in q, in v)}."""
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
                raise ValueError("a floating base without a quaternion")
            self.bodies[full_name(plant, body)] = (
                body.floating_positions_start(),
                body.floating_velocities_start_in_v(),
            )
        n = len(self.joints) + 6 * len(self.bodies)
        if n != plant.num_velocities():
            raise ValueError(
                "the scene has other joints than those with one coordinate"
            )
        for recording in self.recordings:
            for joint in self.joints:
                if f"{joint}.position" not in recording:
                    raise ValueError(f"expected {joint}.position")
            for body in self.bodies:
                if not all(f"{body}.{a}" in recording for a in POSE):
                    raise ValueError(f"expected the whole pose of {body}")
        self.coordinates = [""] * plant.num_velocities()
        for joint, (_, i) in self.joints.items():
            self.coordinates[i] = joint
        for body, (_, i) in self.bodies.items():
            for k, axis in enumerate(("rx", "ry", "rz", "x", "y", "z")):
                self.coordinates[i + k] = f"{body}.{axis}"

    def _read_drives(self) -> None:
        """by: of each joint how its effort is known: "law", "command", "measured",
        "passive", or "" where it is not."""
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

    def _read_sensors(self) -> None:
        """sensors, with n_wrench rows in all; extra: channels that must agree with what
        others tell, with the coordinate each is of."""
        plant = self.plant
        self.sensors: list[WrenchSensor] = []
        self.n_wrench = 0
        for place in self.recordings[0].places(FORCE):
            forces, moments = (
                tuple(f"{place}.{a}" for a in axes) for axes in (FORCE, MOMENT)
            )
            if not all(n in r for n in forces for r in self.recordings):
                continue
            names = forces
            if all(n in r for n in moments for r in self.recordings):
                names += moments
            model, name = place.split(".", 1)
            if not plant.HasModelInstanceNamed(model):
                continue
            instance = plant.GetModelInstanceByName(model)
            if not plant.HasFrameNamed(name, instance):
                continue
            frame = plant.GetFrameByName(name, instance)
            welded = [int(b.index()) for b in plant.GetBodiesWeldedTo(frame.body())]
            self.sensors.append(
                WrenchSensor(place, frame, welded, names, self.n_wrench)
            )
            self.n_wrench += len(names)
        self.extra: list[tuple[str, int]] = []
        for joint, (_, i) in self.joints.items():
            self.extra.append((f"{joint}.velocity", i))
            if self.by[joint] in ("law", "command"):
                self.extra.append((f"{joint}.effort_measured", i))
        for body, (_, i) in self.bodies.items():
            for k, axis in enumerate(("wx", "wy", "wz", "vx", "vy", "vz")):
                self.extra.append((f"{body}.{axis}", i + k))
        self.extra = [
            (name, i)
            for name, i in self.extra
            if all(name in r for r in self.recordings)
        ]

    # ----- Motion

    def _track(self, i: int, recording: Recording, episode: Episode) -> _Track | None:
        time = recording.time[episode.rows]
        if len(time) < 24:
            return None
        n, plant = len(time), self.plant
        q = np.tile(plant.GetPositions(plant.CreateDefaultContext()), (n, 1))
        v, vd = (
            np.zeros((n, plant.num_velocities())),
            np.zeros((n, plant.num_velocities())),
        )

        def smoothed(name: str):
            channel = recording.channels[name]
            y = recording[name][episode.rows]
            if np.isfinite(y).sum() < 12:
                return None
            return smooth_filtered(time, y, channel.noise, channel.stages or ())

        def spread_over(name: str, s: Smoothed) -> float:
            t, _ = recording.samples(name, episode)
            every = float(np.median(np.diff(t)))
            return blur_sec(recording.channels[name].noise, every, s.density)

        blur = np.zeros(plant.num_velocities())

        for joint, (i_q, i_v) in self.joints.items():
            s = smoothed(f"{joint}.position")
            if s is None:
                return None
            q[:, i_q], v[:, i_v], vd[:, i_v] = s.x.T
            blur[i_v] = spread_over(f"{joint}.position", s)
        turns = {}
        for body, (i_q, i_v) in self.bodies.items():
            each = [smoothed(f"{body}.{a}") for a in POSE]
            if any(s is None for s in each):
                return None
            turn = np.stack([s.x for s in each[:4]], axis=1)  # type: ignore[union-attr]
            size = np.linalg.norm(turn[:, :, 0], axis=1)[:, None]
            unit, rate = turn[:, :, 0] / size, turn[:, :, 1] / size
            q[:, i_q : i_q + 4] = unit
            v[:, i_v : i_v + 3] = spin_of(unit, rate)
            vd[:, i_v : i_v + 3] = spin_of(unit, turn[:, :, 2] / size)
            turns[body] = unit
            spread = [
                spread_over(f"{body}.{a}", s)  # type: ignore[arg-type]
                for a, s in zip(POSE, each, strict=True)
            ]
            blur[i_v : i_v + 3] = min(spread[:4])  # By the part that turns most.
            blur[i_v + 3 : i_v + 6] = spread[4:]
            for k in range(3):
                x = each[4 + k].x  # type: ignore[union-attr]
                q[:, i_q + 4 + k], v[:, i_v + 3 + k], vd[:, i_v + 3 + k] = x.T
        return _Track(i, episode, time, q, v, vd, blur, turns)

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
        return poses_of(self.plant, q, self.shapes)

    def _pair_of(self, s: Slot) -> tuple[int, int]:
        return min(s.a, s.b), max(s.a, s.b)

    def _up(self) -> np.ndarray:
        """(3,) against gravity; of weightless scenes z."""
        g = self.dynamics.gravity
        size = np.linalg.norm(g)
        return -g / size if size > 0.0 else np.array([0.0, 0.0, 1.0])

    def carries(self, s: Slot) -> np.ndarray:
        """(n,) whether what is fixed is below what moves, at each pose of a slot."""
        sign = -1.0 if s.a in self.shapes.anchored else 1.0
        return sign * (s.normal @ self._up()) > UPRIGHT

    def _is_of_a_free_body(self, pair: tuple[int, int]) -> bool:
        """Whether something free touches what is fixed."""
        return bool(set(pair) & self.shapes.anchored) and any(
            self.shapes.names[k] in self.bodies for k in pair
        )

    def _touching_rows(self) -> dict[tuple[int, ...], np.ndarray]:
        """{bodies: (n_rows,) whether they touch}; with BESIDE behind them, of what a
        free body touches that does not carry it."""
        poses = self._poses_at(self._q)
        slots = self.shapes.slots(poses, NEAR)
        least: dict[tuple[int, ...], np.ndarray] = {}

        def add(key: tuple[int, ...], phi: np.ndarray) -> None:
            least[key] = np.minimum(least.get(key, np.full(len(phi), FAR)), phi)

        for s in slots:
            pair = self._pair_of(s)
            if not self._is_of_a_free_body(pair):
                add(pair, s.phi)
                continue
            below = self.carries(s)
            if below.any():
                add(pair, np.where(below, s.phi, FAR))
            if not below.all():
                add((*pair, BESIDE), np.where(below | ~s.best, FAR, s.phi))
        found: dict[tuple[int, ...], np.ndarray] = {}
        # How far what a sensor may feel is apart (n_rows,) [m].
        self._apart: dict[tuple[int, ...], np.ndarray] = {}
        for key, phi in least.items():
            rate = np.concatenate([
                np.gradient(phi[a:b], t.time)
                for a, b, t in zip(self._offset, self._offset[1:], self.tracks,
                                   strict=False)
            ])  # fmt: skip
            found[key] = (phi < MEETS) & (np.abs(rate) < APPROACH)
        self.biased: dict[str, float] = {}
        for sensor in self.sensors:
            welded = sensor.welded
            apart = [x for key, x in least.items() if set(key) & set(welded)]
            bias = self._biases(sensor, np.min(apart, axis=0) if apart else None)
            size = self._force_size(sensor, bias)
            for key in found:
                if set(key) & set(welded) and np.isfinite(size).all():
                    partner = key[0] if key[1] in welded else key[1]
                    if partner not in self.shapes.anchored:
                        felt = (size > 0.0) & (least[key] < NEAR)
                        found[key] = self._without_short_losses(felt)
                        self._apart[key] = least[key]
        return found

    def _without_short_losses(self, felt: np.ndarray) -> np.ndarray:
        """(n_rows,) felt too where it is lost for little of a test function: a tip that
        hardly presses is felt now and then, and a contact that may act need not."""
        out = felt.copy()
        for a, b, t in zip(self._offset, self._offset[1:], self.tracks, strict=False):
            on = np.flatnonzero(felt[a:b])
            lost = np.diff(t.time[on]) < SHORT * self.half
            for k in np.flatnonzero(lost & (np.diff(on) > 1)):
                out[a + on[k] : a + on[k + 1]] = True
        return out

    def _biases(self, sensor: WrenchSensor, apart: np.ndarray | None) -> np.ndarray:
        """(n_tracks, 3) what a force sensor reads while its tool touches nothing, in
        each episode, for a bias may drift [N]; noted in `biased`. 0 where it reads next
        to nothing, or where that is not known.

        Args: apart (n_rows,): how far the tool is from all that it could touch [m].
        """
        none = np.zeros((len(self.tracks), 3))
        if apart is None or not self.bodies:  # Of walls it is not known where they are.
            return none
        forces, owner, known = [], [], 0.0
        for number, t in enumerate(self.tracks):
            rows = slice(self._offset[number], self._offset[number + 1])
            f = np.stack(
                [self.recordings[t.recording][f"{sensor.place}.{a}"][t.episode.rows]
                 for a in FORCE], axis=1,
            )  # fmt: skip
            free = np.isfinite(f).all(axis=1) & (apart[rows] > FREE)
            if free.any():
                far = apart[rows][free]
                free[free] = far >= np.quantile(far, 1.0 - FARTHEST)
            if (lasts := float(free.sum()) * self._row_of(t)) >= FREE_SEC:
                forces.append(f[free])
                owner.append(number)
                known += lasts
        if known < ALL_FREE_SEC:
            return none
        every = np.vstack(forces)
        bias = np.median(every, axis=0)
        scatter = ROBUST * np.median(np.abs(every - bias), axis=0)
        clear = np.maximum(LEAST_BIAS, STEADY_BIAS * scatter)
        if not (np.abs(bias) > clear).any():
            return none
        self.biased |= {
            f"{sensor.place}.{a}": float(b)
            for a, b in zip(FORCE, bias, strict=True)
            if abs(b) > 0.5 * LEAST_BIAS
        }
        none[:] = bias
        none[owner] = [np.median(f, axis=0) for f in forces]
        return none

    @staticmethod
    def _row_of(t: _Track) -> float:
        """[s] from one row to the next."""
        return float(np.median(np.diff(t.time)))

    def _force_size(self, sensor: WrenchSensor, bias: np.ndarray) -> np.ndarray:
        """(n_rows,) of the measured force, less the sensor's bias (n_tracks, 3), where
        it is clear of noise and of what the tool's own motion makes, else 0; of few
        newtons too, as of a tool that leans on something at rest."""
        out, place = [], sensor.place
        own = felt_motion(self.dynamics, sensor.frame, self._q, self._v, self._vd)
        own = np.linalg.norm(own[:, :3], axis=1)
        for first, t, off in zip(self._offset, self.tracks, bias, strict=False):
            recording = self.recordings[t.recording]
            f = np.stack(
                [recording[f"{place}.{a}"][t.episode.rows] for a in FORCE], axis=1
            ) - off  # fmt: skip
            noise = max(recording.channels[f"{place}.{a}"].noise for a in FORCE)
            good = np.isfinite(f).all(axis=1)
            if good.sum() < 2:
                return np.full(self._offset[-1], np.nan)
            n = min(FELT_SAMPLES, int(good.sum()))
            f = np.apply_along_axis(
                np.convolve, 0, f[good], np.full(n, 1.0 / n), "same"
            )
            size = np.interp(t.time, t.time[good], np.linalg.norm(f, axis=1))
            least = max(6.0 * noise / np.sqrt(n), LEAST_FELT)
            least = least + own[first : first + len(t.time)]
            out.append(np.where(size > least, size, 0.0))
        return np.concatenate(out)

    # ----- Means

    def _all_means(self) -> _Means:
        parts = []
        for number, t in enumerate(self.tracks):
            part = self._means_of(number, t)
            if part is not None:
                parts.append(part)
        if not parts:
            raise ValueError("no test function fits between changes of contact")
        joined = {
            name: np.concatenate([getattr(p, name) for p in parts])
            for name in vars(parts[0])
            if name != "weights"
        }
        weights = csr_matrix(block_diag([p.weights for p in parts], format="csr"))
        columns = np.concatenate(
            [self._offset[p.episode[0]] + np.arange(len(self.tracks[p.episode[0]].time))
             for p in parts]
        )  # fmt: skip
        whole = csr_matrix(
            (weights.data, columns[weights.indices], weights.indptr),
            (weights.shape[0], self._offset[-1]),
        )
        keep = self._kept(joined)
        return _Means(
            weights=whole[keep], **{name: x[keep] for name, x in joined.items()}
        )

    def _kept(self, joined) -> np.ndarray:
        """Which test functions: where an object moves first, few of the others."""
        v = self._v[joined["centre"]]
        moves = np.zeros(len(v), bool)
        for _, i in self.bodies.values():
            moves |= np.linalg.norm(v[:, i + 3 : i + 6], axis=1) > SLIDES
        if not self.bodies:
            moves[:] = True

        def thinned(which, most):
            index = np.flatnonzero(which)
            if len(index) <= most:
                return index
            return index[np.unique(np.linspace(0, len(index) - 1, most).astype(int))]

        return np.sort(np.concatenate([thinned(moves, MOST), thinned(~moves, STILL)]))

    def _means_of(self, number: int, t: _Track) -> _Means | None:
        recording = self.recordings[t.recording]
        n_v = self.plant.num_velocities()
        whole = self.half
        centres = np.arange(t.time[0] + whole, t.time[-1] - whole, HOP * whole)
        rows = slice(self._offset[number], self._offset[number + 1])
        good = np.ones(len(centres), bool)
        first = np.searchsorted(t.time, centres - whole)
        last = np.searchsorted(t.time, centres + whole)
        for touching in self._touching.values():  # No contact that comes or goes.
            own = touching[rows].astype(int)
            total = np.concatenate([[0], np.cumsum(own)])
            inside = total[last] - total[first]
            good &= (inside == 0) | (inside == last - first)
        total = np.concatenate([[0], np.cumsum(self._is_struck(rows))])
        good &= total[last] == total[first]
        centres, half = self._with_short_touches(t, rows, centres[good])
        if not len(centres):
            return None
        first = np.searchsorted(t.time, centres - half)
        last = np.searchsorted(t.time, centres + half)
        K = len(centres)
        a, a_var = np.zeros((K, n_v)), np.zeros((K, n_v))
        held = held_means(t.time, centres, half)
        effort, effort_var, slope = (np.zeros((K, n_v)) for _ in range(3))
        full = np.ones(K, bool)

        def second(name: str, value=None):
            """Mean second derivative of a channel, its variance."""
            channel = recording.channels[name]
            y = recording[name][t.episode.rows]
            there = np.isfinite(y)
            w, dd = test_functions(t.time[there], centres, half)
            nonlocal full
            full &= np.diff(dd.indptr) > 0
            y = y[there] if value is None else value[there]
            return dd, w, y, there, channel.noise**2

        for joint, (i_q, i_v) in self.joints.items():
            name = f"{joint}.position"
            stages = recording.channels[name].stages
            dd, w, y, there, var = second(name, t.q[:, i_q] if stages else None)
            a[:, i_v] = dd @ y
            a_var[:, i_v] = np.asarray(dd.multiply(dd).sum(axis=1)).ravel() * var
            u, u_var, du = self._effort(
                joint, recording, t, held, w, there, centres, half
            )
            effort[:, i_v], effort_var[:, i_v], slope[:, i_v] = u, u_var, du
        for body, (i_q, i_v) in self.bodies.items():
            for k, axis in enumerate("xyz"):
                name = f"{body}.{axis}"
                stages = recording.channels[name].stages
                value = t.q[:, i_q + 4 + k] if stages else None
                dd, _, y, _, var = second(name, value)
                a[:, i_v + 3 + k] = dd @ y
                a_var[:, i_v + 3 + k] = (
                    np.asarray(dd.multiply(dd).sum(axis=1)).ravel() * var
                )
            q = np.stack(
                [recording[f"{body}.{c}"][t.episode.rows] for c in TURN], axis=1
            )
            there = np.isfinite(q).all(axis=1)
            q = q[there] / np.linalg.norm(q[there], axis=1)[:, None]
            _, dd = test_functions(t.time[there], centres, half)
            full &= np.diff(dd.indptr) > 0
            noise = np.mean([recording.channels[f"{body}.{c}"].noise for c in TURN])
            # Small turns from the smoothed orientation at the middle.
            middle = np.clip(np.searchsorted(t.time, centres), 0, len(t.time) - 1)
            for k in range(K):
                row = dd[[k]]
                some = row.indices
                if not len(some):
                    continue
                back = Rotation.from_quat(np.roll(t.turn[body][middle[k]], -1)).inv()
                turned = Rotation.from_quat(np.roll(q[some], -1, axis=1)) * back
                a[k, i_v : i_v + 3] = row.data @ turned.as_rotvec()
                a_var[k, i_v : i_v + 3] = 4.0 * noise**2 * np.sum(row.data**2)
        # Nodes: rows spread over each test function.
        wr, wc, wv = [], [], []
        for k in range(K):
            b, e = first[k], last[k]
            some = np.unique(np.linspace(b, e - 1, NODES + 2).astype(int))[1:-1]
            u = (t.time[some] - centres[k]) / half[k]
            w_k = np.maximum(1.0 - u * u, 0.0) ** 4
            wr.append(np.full(len(some), k))
            wc.append(some)
            wv.append(w_k / w_k.sum())
        weights = csr_matrix(
            (np.concatenate(wv), (np.concatenate(wr), np.concatenate(wc))),
            (K, len(t.time)),
        )
        wrench, wrench_var = self._wrench_means(recording, t, centres, half)
        extra, extra_var = self._extra_means(recording, t, centres, half, effort)
        centre = self._offset[number] + np.clip(
            np.searchsorted(t.time, centres), 0, len(t.time) - 1
        )
        full &= ~self._maybe_felt(first, last, rows, wrench, wrench_var)
        part = _Means(
            np.full(K, number), centres, a, a_var, effort, effort_var, slope, centre,
            weights, wrench, wrench_var, extra, extra_var,
        )  # fmt: skip
        if not full.all():
            part = part.of(full)
        return part if len(part.time) else None

    def _with_short_touches(self, t: _Track, rows: slice, centres):
        """Centres (K,), sorted, and half widths (K,) of test functions: those that are
        given, and one for each touch that is felt and holds none of them, as wide as
        the touch lasts. A push often takes less than a slow camera's test function."""
        halves = np.full(len(centres), self.half)
        felt = np.zeros(len(t.time), bool)
        changes = np.zeros(len(t.time), bool)
        for key, touching in self._touching.items():
            own = touching[rows]
            changes[1:] |= own[1:] != own[:-1]
            if key in self._apart:
                felt |= own
        struck = self._is_struck(rows)
        changes |= struck
        changes[1:] |= struck[:-1]
        edges = np.flatnonzero(np.concatenate([[True], changes[1:], [True]]))
        added, widths = [], []
        for a, b in zip(edges, edges[1:], strict=False):
            start, end = t.time[a], t.time[b - 1]
            half = min(0.5 * (end - start), self.half)
            inside = (centres > start) & (centres < end)
            if felt[a] and half >= self._least_half and not inside.any():
                added.append(0.5 * (start + end))
                widths.append(half)
        centres = np.concatenate([centres, added])
        order = np.argsort(centres)
        return centres[order], np.concatenate([halves, widths])[order]

    def _maybe_felt(self, first, last, rows: slice, wrench, wrench_var) -> np.ndarray:
        """(K,) whether a sensor near something free feels a force that is too small to
        say from when to when: then it is not known whether they touch.

        Args: first, last: rows of each test function within the episode, whose rows
            among all are `rows`; wrench, wrench_var (K, n_wrench).
        """
        maybe = np.zeros(len(first), bool)
        for sensor in self.sensors:
            size = np.linalg.norm(wrench[:, sensor.forces], axis=1)
            noise = np.sqrt(np.max(wrench_var[:, sensor.forces], axis=1, initial=0.0))
            near = np.zeros(len(first), bool)
            on = np.zeros(len(first), bool)
            for pair, touching in self._touching.items():
                if not set(pair) & set(sensor.welded):
                    continue
                distance = self._apart.get(pair)
                for k, (a, b) in enumerate(zip(first, last, strict=True)):
                    on[k] |= bool(touching[rows][a:b].any())
                    near[k] |= distance is not None and bool(
                        (distance[rows][a:b] < NEAR).any()
                    )
            maybe |= near & ~on & (size > MAYBE_FELT * noise)
        return maybe

    def _is_struck(self, rows: slice) -> np.ndarray:
        """(n,) whether something free lands at a row: other points carry it then, and
        the force is over before it is seen."""
        struck = np.zeros(rows.stop - rows.start, bool)
        for _, i in self.bodies.values():
            size = np.linalg.norm(self._vd[rows, i + 3 : i + 6], axis=1)
            struck |= size > IMPACT_ACCELERATION
        return struck

    def _effort(self, joint, recording, t: _Track, held, w, there, centres, half):
        """Mean effort of a drive, its variance, its slope by a delay of commands."""
        by, act = self.by[joint], self.scene.actuation
        i_q, i_v = self.joints[joint]
        K = len(centres)
        if by in ("passive", ""):
            # An effort that nobody knows explains nothing.
            return np.zeros(K), np.full(K, 1e12 if by == "" else 0.0), np.zeros(K)
        if by == "measured":
            name = f"{joint}.effort_measured"
            y = recording[name][t.episode.rows]
            ok = np.isfinite(y)
            means, _ = test_functions(t.time[ok], centres, half)
            var = variance_of_means(means, y[ok], recording.channels[name].noise)
            return means @ y[ok], var, np.zeros(K)
        if by == "command":
            u = np.nan_to_num(recording.held(f"{joint}.effort_command")[t.episode.rows])
            rate = np.gradient(held @ u, centres) if K > 1 else np.zeros(K)
            var = np.zeros(K)
            if act.rate_hz and act.rate_hz * np.median(np.diff(t.time)) > BETWEEN_ROWS:
                var = variance_of_means(held, u, 0.0)
            return held @ u, var, rate
        law = law_of(act, joint)
        assert law is not None
        takes = COMMANDS_OF[act.type]
        x, v = t.q[:, i_q], t.v[:, i_v]

        def column(what):
            name = f"{joint}.{what}"
            if what not in takes or name not in recording:
                return np.zeros(len(x))
            return np.nan_to_num(recording.held(name)[t.episode.rows])

        p, dp = column("position_command"), column("velocity_command")
        has_p = "position_command" in takes
        p = law.received(p)

        def effort(at):
            """With the commands of each row and the state at the rows `at`."""
            error = p - x[at] if has_p else np.zeros(len(x))
            return law.effort(error, dp, v[at])

        now = np.arange(len(x))
        u = 0.5 * (effort(now) + effort(np.minimum(now + 1, len(x) - 1)))
        kp = float(law.kp) if has_p else 0.0
        noise = recording.channels[f"{joint}.position"].noise
        size = np.asarray(w.multiply(w).sum(axis=1)).ravel()
        # Velocities are smoothed ones: known by positions, and better if measured too.
        v_var = RATE_OF_MEAN / np.broadcast_to(half, K) ** 2 * noise**2
        velocity = recording.channels.get(f"{joint}.velocity")
        if velocity is not None and velocity.noise > 0.0:  # 0: it is not known.
            v_var = v_var * velocity.noise**2 / (v_var + velocity.noise**2)
        damping = float(law.kd + law.emf)
        var = size * ((kp * noise) ** 2 + damping**2 * v_var)
        mean = held @ u
        # Commands that act later by a while: less of what they ask by their rate.
        rate = np.gradient(p, t.time) if has_p else np.zeros(len(x))
        late = -(kp * rate + float(law.kd) * np.gradient(dp, t.time))
        return mean, var, held @ late

    def _wrench_means(self, recording: Recording, t: _Track, centres, half):
        columns, variances = [], []
        for sensor in self.sensors:
            for name in sensor.names:
                y = recording[name][t.episode.rows]
                ok = np.isfinite(y)
                w, _ = test_functions(t.time[ok], centres, half)
                columns.append(w @ y[ok])
                # A knock is over between two samples: its force is hardly known.
                var = variance_of_means(w, y[ok], recording.channels[name].noise)
                # Where there are no samples, nothing is known.
                variances.append(np.where(var > 0.0, var, 1e12))
        K = len(centres)
        if not columns:
            return np.zeros((K, 0)), np.zeros((K, 0))
        return np.stack(columns, axis=1), np.stack(variances, axis=1)

    def _extra_means(self, recording: Recording, t: _Track, centres, half, effort):
        columns, variances = [], []
        for name, i in self.extra:
            y = recording[name][t.episode.rows]
            ok = np.isfinite(y)
            w, _ = test_functions(t.time[ok], centres, half)
            if name.endswith(".effort_measured"):
                other, off = effort[:, i], MODELLED * float(np.std(effort[:, i]))
            else:
                other = w @ t.v[ok, i]
                off = 0.01 * float(np.std(t.v[:, i])) + 1e-4
            var = np.asarray(w.multiply(w).sum(axis=1)).ravel()
            columns.append(np.where(var > 0.0, w @ y[ok] - other, 0.0))
            variances.append(var * recording.channels[name].noise ** 2 + off**2)
        K = len(centres)
        if not columns:
            return np.zeros((K, 0)), np.zeros((K, 0))
        return np.stack(columns, axis=1), np.stack(variances, axis=1)


def variance_of_means(w: csr_matrix, y: np.ndarray, noise: float) -> np.ndarray:
    """(K,) of the means w @ y of samples y (n,): of their noise, and of what the signal
    does between them. Where it goes by d from one sample to the next its mean there is
    anything between the two, uniform: d^2/12. (An effort that jumps by 3 N m within a
    tenth of a second was off by six times its noise.)"""
    steps = np.maximum(np.diff(y) ** 2 - 2.0 * noise**2, 0.0)
    between = 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps)) / 12.0
    return np.asarray(w.multiply(w) @ (noise**2 + between)).ravel()

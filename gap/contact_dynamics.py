"""Equations of motion of robots and objects that touch, and what contact cannot give.

For a mean over a short while (a test function of numerics/permitted_forces.py) the
measured motion needs the generalized force ID(q, v, vd), of which the drives give u;
what is left, P, must be contact forces that the model permits: none that pulls, none
outside the friction cone, along the slip where something slides, and only where shapes
are near. What they do not explain of P is the residual. Nothing is simulated.

How noise is kept out: positions alone are differentiated, within the test function;
while two bodies stay in touch their distance does not accelerate, which tells the
seen body's acceleration along the normal from the robot's encoders (conditioning on
that constraint, a Kalman update); the effort is what the drive's law makes of commands
and encoders, so that its ripple between rows does not matter.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable
from scipy.optimize import linprog
from scipy.sparse import block_diag, csr_matrix
from scipy.spatial.transform import Rotation
from scipy.special import expit

from makebreak.gap.contact_shapes import ContactShapes, Slot, poses_of
from makebreak.gap.recording import Episode, Recording
from makebreak.gap.windows import TURN, spin_of
from makebreak.models.drives import law_of
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact import CONTACT_LAW
from makebreak.models.effects.inertia import SIX, central_inertia, inertial_columns
from makebreak.models.effects.kind import (
    Effect,
    find_bodies,
    find_joints,
    full_name,
    one_dof_joints,
)
from makebreak.models.effects.loads import rotation
from makebreak.models.effects.signature import Motion, added_effort
from makebreak.models.scene import Scene
from makebreak.models.scene_schema import COMMANDS_OF
from makebreak.systems.numerics.permitted_forces import (
    explain,
    held_means,
    roots_of,
    tangential,
    test_functions,
    unshared_load,
)
from makebreak.systems.numerics.smoother import smooth_filtered

SAMPLES = 8  # Of the slowest pose, in half a test function.
LEAST_HALF, MOST_HALF = 0.05, 0.2  # [s]
HOP = 0.75  # From one test function to the next, in half widths.
NODES = 5  # Rows of a test function at which geometry and dynamics are evaluated.
MOST = 420  # Test functions at most, and how many of them without a moving object.
STILL = 80
NEAR = 0.02  # Shapes that never come so near do not matter [m].
SLACK = 8e-4  # Points so little farther than the nearest of two bodies touch too [m].
CARRIES = 0.012  # What is fixed may carry what is measured so far above it [m],
STEEP = 0.12  # and turned by so much against how it would rest [rad].
MEETS = 2.5e-3  # Two bodies touch when the nearest points are within this [m].
APPROACH = 0.02  # Faster along the normal is no lasting contact [m/s].
SLIDES = 0.01  # Slower slip may be sticking [m/s].
EDGE = 8e-4  # Over which a patch of friction sets in [m].
UNEVEN = (
    2e-5  # How flat what carries is: several points share a load to k times it [m].
)
PYRAMID = 12  # Sides about a friction cone.
MOST_SHARED = 6  # Rows that share loads.
HOLDS = 0.03  # Known of the distance's acceleration where bodies stay in touch [m/s2].
SHAPES = 2e-4  # How well shapes are known where the scene does not say [m].
THIN = 4  # Distances change slowly: every so many test functions are told.
MODELLED = 0.02  # What models are off by, as a share of the forces in a row.
WRENCHED = 0.05  # A wrench sampled amid a drive's ripple is off by as much.
_POSE = (*TURN, "x", "y", "z")
_FORCE = ("fx", "fy", "fz")
# What changes shapes, surfaces and where they are.
SURFACES = ("contact_friction", "friction_patch", "plane_tilt", "plane_height")
SHAPED = (*SURFACES, *CONTACT_LAW)

# What changes a free body's inertial parameters.
INERTIAL = ("object_mass", "object_com", "object_inertia")


@dataclass(frozen=True, eq=False)
class _Track:
    """An episode, smoothed: n rows. raw: {coordinate: (samples' times, values)}."""

    recording: int
    episode: Episode
    time: np.ndarray
    q: np.ndarray
    v: np.ndarray
    vd: np.ndarray
    turn: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Shift:
    """By what a camera may show a body wrongly: place [m], turn [rad], late [s]."""

    body: str
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    late: float = 0.0


@dataclass(frozen=True, eq=False)
class _Column:
    """A generator, pressing + mu rubbing: means (K, rows), and rubbing at the nodes
    (n_nodes, rows), of which scale (K,) times the mean counts; can (K,) act."""

    slot: int
    can: np.ndarray
    scale: np.ndarray
    pressing: np.ndarray
    rubbing: np.ndarray
    mean_rubbing: np.ndarray


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
    wrench: np.ndarray  # (K, 3 n_sensors)
    wrench_var: np.ndarray
    extra: np.ndarray  # (K, n_extra) measured rates and efforts less what they must be.
    extra_var: np.ndarray


class ContactDynamics:
    """Residuals (K, rows) of a scene's equations of motion with permitted forces.

    Raises: ValueError where the recordings do not tell the whole motion (a position of
        every joint, a whole pose of every free body), no effort, or nothing touches.
    """

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        self.scene, self.recordings = scene, list(recordings)
        self.dynamics = SceneDynamics(scene)
        self.plant: MultibodyPlant = self.dynamics.plant
        plant = self.plant
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
        self._vd = np.vstack([t.vd for t in self.tracks])
        self._context = plant.CreateDefaultContext()
        self._last: tuple | None = None
        self._known_columns: list[_Column] | None = None
        self._known_sharing: np.ndarray | None = None
        self._inertial_of: dict[str, np.ndarray] = {}
        self._choose_half()
        self._touching = self._touching_rows()
        self.means = self._all_means()
        if len(self.means.time) < 30:
            raise ValueError("the recordings hold too little motion")
        self._evaluate_nodes()
        self._prepare()

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
                if not all(f"{body}.{a}" in recording for a in _POSE):
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
        """sensors: (frame, body index) of wrenches; extra: channels that must agree
        with what others tell, with the coordinate each is of."""
        plant = self.plant
        self.sensors: list[tuple[str, list[int]]] = []
        for place in self.recordings[0].places(_FORCE):
            names = [f"{place}.{f}" for f in _FORCE]
            if not all(n in r for n in names for r in self.recordings):
                continue
            model, name = place.split(".", 1)
            if not plant.HasModelInstanceNamed(model):
                continue
            instance = plant.GetModelInstanceByName(model)
            if not plant.HasFrameNamed(name, instance):
                continue
            body = plant.GetFrameByName(name, instance).body()
            welded = [int(b.index()) for b in plant.GetBodiesWeldedTo(body)]
            self.sensors.append((place, welded))
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

        for joint, (i_q, i_v) in self.joints.items():
            s = smoothed(f"{joint}.position")
            if s is None:
                return None
            q[:, i_q], v[:, i_v], vd[:, i_v] = s.x.T
        turns = {}
        for body, (i_q, i_v) in self.bodies.items():
            each = [smoothed(f"{body}.{a}") for a in _POSE]
            if any(s is None for s in each):
                return None
            turn = np.stack([s.x for s in each[:4]], axis=1)  # type: ignore[union-attr]
            size = np.linalg.norm(turn[:, :, 0], axis=1)[:, None]
            unit, rate = turn[:, :, 0] / size, turn[:, :, 1] / size
            q[:, i_q : i_q + 4] = unit
            v[:, i_v : i_v + 3] = spin_of(unit, rate)
            vd[:, i_v : i_v + 3] = spin_of(unit, turn[:, :, 2] / size)
            turns[body] = unit
            for k in range(3):
                x = each[4 + k].x  # type: ignore[union-attr]
                q[:, i_q + 4 + k], v[:, i_v + 3 + k], vd[:, i_v + 3 + k] = x.T
        return _Track(i, episode, time, q, v, vd, turns)

    def _choose_half(self) -> None:
        """Half a test function: as many samples of the slowest pose as it needs."""
        slowest = 0.0
        names = [f"{j}.position" for j in self.joints]
        names += [f"{b}.{a}" for b in self.bodies for a in _POSE]
        for recording in self.recordings:
            for name in names:
                for episode in recording.episodes:
                    t, _ = recording.samples(name, episode)
                    if len(t) > 2:
                        slowest = max(slowest, float(np.median(np.diff(t))))
        self.half = float(np.clip(SAMPLES * slowest, LEAST_HALF, MOST_HALF))

    def _poses_at(self, q: np.ndarray):
        return poses_of(self.plant, q, self.shapes)

    def _touching_rows(self) -> dict[tuple[int, int], np.ndarray]:
        """{bodies: (n_rows,) whether they touch}, of pairs with a moving mechanism."""
        poses = self._poses_at(self._q)
        slots = self.shapes.slots(poses, NEAR)
        least: dict[tuple[int, int], np.ndarray] = {}
        for s in slots:
            pair = (min(s.a, s.b), max(s.a, s.b))
            now = least.get(pair)
            least[pair] = s.phi if now is None else np.minimum(now, s.phi)
        found = {}
        for pair, phi in least.items():
            rate = np.concatenate([
                np.gradient(phi[a:b], t.time)
                for a, b, t in zip(self._offset, self._offset[1:], self.tracks,
                                   strict=False)
            ])  # fmt: skip
            found[pair] = (phi < MEETS) & (np.abs(rate) < APPROACH)
        for place, welded in self.sensors:
            size = self._force_size(place)
            for pair in found:
                if set(pair) & set(welded) and np.isfinite(size).all():
                    partner = pair[0] if pair[1] in welded else pair[1]
                    if partner not in self.shapes.anchored:
                        found[pair] = (size > 0.0) & (least[pair] < NEAR)
        return found

    def _force_size(self, place: str) -> np.ndarray:
        """(n_rows,) of the measured force where it is clear of noise, else 0."""
        out = []
        for t in self.tracks:
            recording = self.recordings[t.recording]
            f = np.stack(
                [recording[f"{place}.{a}"][t.episode.rows] for a in _FORCE], axis=1
            )
            noise = max(recording.channels[f"{place}.{a}"].noise for a in _FORCE)
            size = np.linalg.norm(f, axis=1)
            good = np.isfinite(size)
            if good.sum() < 2:
                return np.full(self._offset[-1], np.nan)
            size = np.interp(t.time, t.time[good], size[good])
            out.append(np.where(size > max(6.0 * noise, 0.2), size, 0.0))
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
        half, n_v = self.half, self.plant.num_velocities()
        centres = np.arange(t.time[0] + half, t.time[-1] - half, HOP * half)
        rows = slice(self._offset[number], self._offset[number + 1])
        good = np.ones(len(centres), bool)
        first = np.searchsorted(t.time, centres - half)
        last = np.searchsorted(t.time, centres + half)
        for touching in self._touching.values():  # No contact that comes or goes.
            own = touching[rows].astype(int)
            total = np.concatenate([[0], np.cumsum(own)])
            inside = total[last] - total[first]
            good &= (inside == 0) | (inside == last - first)
        centres = centres[good]
        if not len(centres):
            return None
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
            u, u_var, du = self._effort(joint, recording, t, held, w, there, centres)
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
            b, e = np.searchsorted(t.time, [centres[k] - half, centres[k] + half])
            some = np.unique(np.linspace(b, e - 1, NODES + 2).astype(int))[1:-1]
            u = (t.time[some] - centres[k]) / half
            w_k = np.maximum(1.0 - u * u, 0.0) ** 4
            wr.append(np.full(len(some), k))
            wc.append(some)
            wv.append(w_k / w_k.sum())
        weights = csr_matrix(
            (np.concatenate(wv), (np.concatenate(wr), np.concatenate(wc))),
            (K, len(t.time)),
        )
        wrench, wrench_var = self._wrench_means(recording, t, centres)
        extra, extra_var = self._extra_means(recording, t, centres, effort)
        centre = self._offset[number] + np.clip(
            np.searchsorted(t.time, centres), 0, len(t.time) - 1
        )
        part = _Means(
            np.full(K, number), centres, a, a_var, effort, effort_var, slope, centre,
            weights, wrench, wrench_var, extra, extra_var,
        )  # fmt: skip
        if not full.all():
            part = _Means(**{name: x[full] for name, x in vars(part).items()})
        return part if len(part.time) else None

    def _effort(self, joint, recording, t: _Track, held, w, there, centres):
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
            means, _ = test_functions(t.time[ok], centres, self.half)
            var = np.asarray(means.multiply(means).sum(axis=1)).ravel()
            return means @ y[ok], var * recording.channels[name].noise ** 2, np.zeros(K)
        if by == "command":
            u = np.nan_to_num(recording.held(f"{joint}.effort_command")[t.episode.rows])
            rate = np.gradient(held @ u, centres) if K > 1 else np.zeros(K)
            return held @ u, np.zeros(K), rate
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
        var = np.asarray(w.multiply(w).sum(axis=1)).ravel() * (kp * noise) ** 2
        mean = held @ u
        # Commands that act later by a while: less of what they ask by their rate.
        rate = np.gradient(p, t.time) if has_p else np.zeros(len(x))
        late = -(kp * rate + float(law.kd) * np.gradient(dp, t.time))
        return mean, var, held @ late

    def _wrench_means(self, recording: Recording, t: _Track, centres):
        columns, variances = [], []
        for place, _ in self.sensors:
            for a in _FORCE:
                y = recording[f"{place}.{a}"][t.episode.rows]
                ok = np.isfinite(y)
                w, _ = test_functions(t.time[ok], centres, self.half)
                columns.append(w @ y[ok])
                var = np.asarray(w.multiply(w).sum(axis=1)).ravel()
                noise = recording.channels[f"{place}.{a}"].noise
                # Where there are no samples, nothing is known.
                variances.append(np.where(var > 0.0, var * noise**2, 1e12))
        K = len(centres)
        if not columns:
            return np.zeros((K, 0)), np.zeros((K, 0))
        return np.stack(columns, axis=1), np.stack(variances, axis=1)

    def _extra_means(self, recording: Recording, t: _Track, centres, effort):
        columns, variances = [], []
        for name, i in self.extra:
            y = recording[name][t.episode.rows]
            ok = np.isfinite(y)
            w, _ = test_functions(t.time[ok], centres, self.half)
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

    # ----- Geometry and dynamics at nodes

    def _evaluate_nodes(self) -> None:
        m, plant = self.means, self.plant
        self._rows = np.unique(m.weights.indices)
        self._W = csr_matrix(m.weights[:, self._rows])
        q, v = self._q[self._rows], self._v[self._rows]
        self._node_poses = self._poses_at(q)
        moving = [k for k in self.shapes.bodies() if k not in self.shapes.anchored]
        n_v, W = plant.num_velocities(), plant.world_frame()
        self._J = {k: np.empty((len(q), 6, n_v)) for k in moving}
        wrt = JacobianWrtVariable.kV
        for n, row in enumerate(q):
            plant.SetPositions(self._context, row)
            for k in moving:
                frame = plant.get_body(BodyIndex(k)).body_frame()
                self._J[k][n] = plant.CalcJacobianSpatialVelocity(
                    self._context, wrt, frame, np.zeros(3), W, W
                )
        self._node_v = v
        # The equations without acceleration at nodes, the mass matrix in the middle.
        self._still = self._W @ self.dynamics.inverse_dynamics(q, v, np.zeros_like(v))
        self._M = np.empty((len(m.time), n_v, n_v))
        for k, row in enumerate(m.centre):
            plant.SetPositions(self._context, self._q[row])
            self._M[k] = plant.CalcMassMatrix(self._context)

    def _prepare(self) -> None:
        """Accelerations with what lasting contacts tell, what the motion needs, and
        what its rows are divided by; all in the scene as it came."""
        m = self.means
        self.slots, _ = self._slots(())
        self._masks = self._touches(self.slots)
        self._pairs_met = sorted(
            {self._pair_of(s) for s, on in zip(self.slots, self._masks, strict=True)
             if on.any()}
        )  # fmt: skip
        self._condition()
        q, v = self._q[m.centre], self._W @ self._node_v
        self.motion = Motion(m.time, q, v, m.acceleration, m.effort)
        needs = self._still + np.einsum("kij,kj->ki", self._M, m.acceleration)
        self._needs = needs - m.effort
        self._weigh()

    def _slots(self, effects: Sequence[Effect], shift: Shift | None = None):
        """Slots at the nodes, and the poses that they are of."""
        poses = dict(self._node_poses)
        for e in effects:
            if e.kind not in ("plane_tilt", "plane_height"):
                continue
            for k in poses:
                if k in self.shapes.anchored and self._is_at(e, k):
                    R, p = poses[k]
                    if e.kind == "plane_height":
                        poses[k] = R, p + [0.0, 0.0, e.parameters["height"]]
                    else:
                        poses[k] = rotation(e).matrix() @ R, p
        for k in poses if shift else ():
            assert shift is not None
            if self.shapes.names.get(k) == shift.body:
                R, p = poses[k]
                late = 0.0
                if shift.late:
                    i_v = self.bodies[shift.body][1]
                    late = shift.late * self._node_v[:, i_v + 3 : i_v + 6]
                turn = Rotation.from_rotvec(shift.turn).as_matrix()
                poses[k] = turn @ R, p + np.array(shift.place) + late
        return self.shapes.slots(poses, NEAR), poses

    def _is_at(self, effect: Effect, body: int) -> bool:
        name = self.shapes.names.get(body, "")
        return any(at in (name, name.split(".")[0]) for at in effect.at)

    def _pair_of(self, s: Slot) -> tuple[int, int]:
        return min(s.a, s.b), max(s.a, s.b)

    def pair_name(self, pair: tuple[int, int]) -> str:
        """As an effect names it: the free body first."""
        a, b = (self.shapes.names[k] for k in pair)
        return f"{a}~{b}" if a in self.bodies or b not in self.bodies else f"{b}~{a}"

    def _at_pair(self, effect: Effect, pair: tuple[int, int]) -> bool:
        names = {self.shapes.names[k] for k in pair}
        short = {n.split(".")[0] for n in names}
        for at in effect.at:
            two = {x.strip() for x in at.split("~")}
            if two == names or two == short:
                return True
        return False

    def _touches(self, slots: Sequence[Slot]) -> list[np.ndarray]:
        """Of each slot (n_nodes,) whether it may act. What lies on something fixed is
        carried by the points on which it would come to rest there, however far its
        measured pose is from that: distances are judged apart from forces."""
        of: dict[tuple[int, int], list[int]] = {}
        for k, s in enumerate(slots):
            of.setdefault(self._pair_of(s), []).append(k)
        out = [np.zeros(len(s.phi), bool) for s in slots]
        for pair, index in of.items():
            phi = np.stack([slots[k].phi for k in index], axis=1)
            best = np.stack([slots[k].best for k in index], axis=1)
            nearest = phi.min(axis=1)
            close: np.ndarray = phi < nearest[:, None] + SLACK
            may = np.logical_and(best, close)
            touching = self._touching.get(pair)
            if set(pair) & self.shapes.anchored and any(
                self.shapes.names[k] in self.bodies for k in pair
            ):
                rests = self._at_rest_on([slots[k] for k in index])
                rested = np.any(rests, axis=1, keepdims=True)
                may = np.where(rested, rests & best, may)
                may &= nearest[:, None] < CARRIES
            elif touching is not None:
                may &= touching[self._rows][:, None]
            else:
                may &= nearest[:, None] < MEETS
            for column, k in enumerate(index):
                out[k] = may[:, column]
        return out

    def _at_rest_on(self, slots: Sequence[Slot]) -> np.ndarray:
        """(n_nodes, n_slots) which points would touch once the body has come to rest on
        a plane below it as it is: the highest plane under all points at the body's
        middle (a linear program). None where the plane would be steep."""
        n = len(slots[0].phi)
        out = np.zeros((n, len(slots)), bool)
        if len(slots) < 3:
            return out
        place = np.stack([s.place for s in slots], axis=1)
        phi = np.stack([s.phi for s in slots], axis=1)
        best = np.stack([s.best for s in slots], axis=1)
        normal = slots[0].normal
        known: dict[tuple, np.ndarray] = {}
        for k in range(n):
            some = np.flatnonzero(best[k])
            if len(some) < 3:
                continue
            e3 = normal[k]
            e1 = np.cross(e3, [1.0, 0.0, 0.0] if abs(e3[0]) < 0.9 else [0.0, 1.0, 0.0])
            e1 /= np.linalg.norm(e1)
            at = place[k, some] - place[k, some].mean(axis=0)
            x, y, z = at @ e1, at @ np.cross(e3, e1), phi[k, some]
            # Poses that differ little rest alike.
            key = tuple(np.round([*(phi[k, some] - phi[k, some].min())], 4))
            if key not in known:
                A = np.column_stack([np.ones(len(some)), x, y])
                found = linprog(
                    [-1.0, 0.0, 0.0], A_ub=A, b_ub=z,
                    bounds=[(None, None), (-STEEP, STEEP), (-STEEP, STEEP)],
                )  # fmt: skip
                rests = np.zeros(len(some), bool)
                if found.success and np.abs(found.x[1:]).max() < 0.999 * STEEP:
                    rests = z - A @ found.x < SLACK
                known[key] = rests
            out[k, some] = known[key]
        return out

    def _relative(self, s: Slot, poses=None) -> np.ndarray:
        """(n_nodes, 3, n_v): how the point of a moves against that of b, with v."""
        poses = poses or self._node_poses
        n = len(s.phi)
        out = np.zeros((n, 3, self.plant.num_velocities()))
        for k, sign in ((s.a, 1.0), (s.b, -1.0)):
            if k not in self._J:
                continue
            arm = s.place - poses[k][1]
            J = self._J[k]
            out += sign * (J[:, 3:] - np.cross(arm[:, :, None], J[:, :3], axis=1))
        return out

    def _condition(self) -> None:
        """While two bodies stay in touch the distance does not accelerate."""
        m = self.means
        touch = self._masks
        q, v = self._q[m.centre], self._v[m.centre]
        vd = self._vd[m.centre]
        a, covariance = self._expected_acceleration(v)
        middle = np.searchsorted(self._rows, m.centre)
        middle = np.clip(middle, 0, len(self._rows) - 1)
        h = 0.004  # [s] The distance along the smoothed motion, by differences.
        moved = []
        for sign in (-1.0, 0.0, 1.0):
            at = self.dynamics.shifted(q, v + 0.5 * sign * h * vd, sign * h)
            for i_q, _ in self.bodies.values():
                size = np.linalg.norm(at[:, i_q : i_q + 4], axis=1)
                at[:, i_q : i_q + 4] /= size[:, None]
            moved.append(
                {s.key: s for s in self.shapes.slots(self._poses_at(at), np.inf)}
            )
        for s, mine in zip(self.slots, touch, strict=True):
            whole = np.asarray(self._W @ mine.astype(float)).ravel() > 0.999
            whole &= mine[middle]
            if not whole.any():
                continue
            J = np.einsum("nj,njk->nk", s.normal, self._relative(s))[middle]
            before, now, after = (each[s.key].phi for each in moved)
            bend = (after - 2.0 * now + before) / h**2
            rest = bend - np.sum(J * vd, axis=1)
            for k in np.flatnonzero(whole):
                e = -rest[k] - J[k] @ a[k]
                S = J[k] @ covariance[k] @ J[k] + HOLDS**2
                gain = covariance[k] @ J[k] / S
                a[k] += gain * e
                covariance[k] -= np.outer(gain, J[k] @ covariance[k])
        self.means.acceleration = a
        self._a_covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))

    def _expected_acceleration(self, v: np.ndarray):
        """Of each test function the acceleration that is expected (K, n_v), and its
        covariance: the measured mean, shrunk by how noise compares with what bodies
        do (along their path, across it, upright, in turning). What is left off by is
        then not correlated with it, else a mass would be found too small (regression
        calibration: Carroll et al., Measurement Error in Nonlinear Models, 2006,
        chapter 4).
        """
        m = self.means
        a, var = m.acceleration.copy(), m.acceleration_var
        K, n_v = a.shape
        covariance = np.zeros((K, n_v, n_v))
        i = np.arange(n_v)
        covariance[:, i, i] = var
        for _, k in self.joints.values():
            true = max(
                float(np.mean(a[:, k] ** 2 - var[:, k])), 0.05 * var[:, k].mean()
            )
            share = true / (true + var[:, k])
            a[:, k] *= share
            covariance[:, k, k] = share * var[:, k]
        up = -self.dynamics.gravity
        up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.0 else np.eye(3)[2]
        for _, i_v in self.bodies.values():
            along = v[:, i_v + 3 : i_v + 6]
            along = along - (along @ up)[:, None] * up
            size = np.linalg.norm(along, axis=1)
            spare = np.cross(
                up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0]
            )
            spare /= np.linalg.norm(spare)
            e1 = np.where(size[:, None] > 1e-6, along / np.maximum(size, 1e-6)[:, None],
                          spare)  # fmt: skip
            R = np.stack([e1, np.cross(up, e1), np.broadcast_to(up, e1.shape)], axis=1)
            for first, turn in ((i_v, None), (i_v + 3, R)):
                index = slice(first, first + 3)
                axes = np.broadcast_to(np.eye(3), (K, 3, 3)) if turn is None else turn
                y = np.einsum("kij,kj->ki", axes, a[:, index])
                noise = np.einsum("kij,kj->ki", axes**2, var[:, index])
                true = np.mean(y**2 - noise, axis=0)
                true = np.maximum(true, 0.05 * np.mean(noise, axis=0))
                share = true / (true + noise)
                a[:, index] = np.einsum("kji,kj->ki", axes, share * y)
                covariance[:, index, index] = np.einsum(
                    "kji,kj,kjl->kil", axes, share * noise, axes
                )
        return a, covariance

    # ----- What contacts can give

    def _friction(self, s: Slot, effects: Iterable[Effect]) -> np.ndarray:
        """(n_nodes,) of a slot's contact."""
        mu = np.full(len(s.phi), s.friction)
        for e in effects:
            if e.kind == "contact_friction" and self._at_pair(e, self._pair_of(s)):
                if e.parameters["friction"] < 0.0:
                    raise ValueError("contact_friction: below zero")
                mu[:] = e.parameters["friction"]
        for e in effects:
            if e.kind == "friction_patch" and self._at_pair(e, self._pair_of(s)):
                p = e.parameters
                if not (p["x_min"] < p["x_max"] and p["y_min"] < p["y_max"]):
                    raise ValueError("friction_patch: the patch is empty")
                if p["friction"] < 0.0:
                    raise ValueError("friction_patch: below zero")
                x, y = s.place[:, 0], s.place[:, 1]
                inside = _between(x, p["x_min"], p["x_max"])
                inside = inside * _between(y, p["y_min"], p["y_max"])
                mu = mu + inside * (p["friction"] - mu)
        return mu

    def _generators(self, effects: Sequence[Effect], shift: Shift | None = None):
        """G (K, rows, columns), which can act (K, columns), slot of each column; the
        slots; how loads are shared."""
        moved = shift or any(e.kind in ("plane_tilt", "plane_height") for e in effects)
        if moved:
            slots, poses = self._slots(effects, shift)
            masks = dict(zip((s.key for s in self.slots), self._masks, strict=True))
            slots = [s for s in slots if s.key in masks]
            made = self._columns(slots, poses, masks)
        else:
            slots = self.slots
            if self._known_columns is None:
                masks = dict(zip((s.key for s in slots), self._masks, strict=True))
                self._known_columns = self._columns(slots, self._node_poses, masks)
            made = self._known_columns
        K, n = len(self.means.time), len(self.coordinates) + 3 * len(self.sensors)
        frictions = {
            number: self._friction(slots[number], effects)
            for number in {c.slot for c in made}
        }
        G = np.zeros((K, n, max(len(made), 1)))
        there = np.zeros((K, max(len(made), 1)), bool)
        for k, c in enumerate(made):
            mu = frictions[c.slot]
            if np.ptp(mu) == 0.0:
                G[:, :, k] = c.pressing + mu[0] * c.mean_rubbing
            else:
                rubbing = self._W @ (mu[:, None] * c.rubbing)
                G[:, :, k] = c.pressing + c.scale[:, None] * rubbing
            there[:, k] = c.can
        if made is not self._known_columns or self._known_sharing is None:
            sharing = self._sharing(made, slots)
            if made is self._known_columns:
                self._known_sharing = sharing
        else:
            sharing = self._known_sharing
        return G, there, [c.slot for c in made], slots, sharing

    def _columns(self, slots: Sequence[Slot], poses, masks) -> list[_Column]:
        """Of each slot the force along its slip, and where it may stick those of a
        pyramid, as generalized forces and on the sensors."""
        W, found = self._W, list[_Column]()
        for number, s in enumerate(slots):
            mine = masks[s.key]
            weight = np.asarray(W @ mine.astype(float)).ravel()
            acts = weight > 0.5
            if not acts.any():
                continue
            J = self._relative(s, poses)
            u = np.einsum("nij,nj->ni", J, self._node_v)
            slip = tangential(u, s.normal)
            speed = np.linalg.norm(slip, axis=1)
            fast = np.asarray(W @ ((speed >= SLIDES) & mine).astype(float)).ravel()
            slides = fast >= 0.999 * weight  # Slower in any part: it may stick.
            along = slip / np.maximum(speed, 1e-9)[:, None]
            e1 = np.cross(s.normal, np.where(
                np.abs(s.normal[:, :1]) > 0.7, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]]
            ))  # fmt: skip
            e1 /= np.linalg.norm(e1, axis=1)[:, None]
            e2 = np.cross(s.normal, e1)
            ways = [(-along, acts)]
            may = acts & ~slides
            for k in range(PYRAMID if may.any() else 0):
                angle = 2.0 * np.pi * k / PYRAMID
                way = np.cos(angle) * e1 + np.sin(angle) * e2
                ways.append((way / np.cos(np.pi / PYRAMID), may))
            scale = np.where(weight > 0.0, 1.0 / np.maximum(weight, 1e-9), 0.0)
            pressing = scale[:, None] * (W @ self._felt(s, J, s.normal * mine[:, None]))
            for way, can in ways:
                rubbing = self._felt(s, J, way * mine[:, None])
                found.append(
                    _Column(number, can, scale, pressing, rubbing,
                            scale[:, None] * (W @ rubbing))
                )  # fmt: skip
        return found

    def _felt(self, s: Slot, J: np.ndarray, f: np.ndarray) -> np.ndarray:
        """(n_nodes, rows) a force f (n_nodes, 3) on the slot's a, and back on its b."""
        n_v = self.plant.num_velocities()
        out = np.zeros((len(f), n_v + 3 * len(self.sensors)))
        out[:, :n_v] = np.einsum("nij,ni->nj", J, f)
        for k, (_, welded) in enumerate(self.sensors):
            sign = float(s.a in welded) - float(s.b in welded)
            out[:, n_v + 3 * k : n_v + 3 * k + 3] = sign * f
        return out

    def _sharing(self, made: Sequence[_Column], slots: Sequence[Slot]) -> np.ndarray:
        """(K, d, columns) what makes the points of a thing that lies share its load, as
        springs on ground that is even to UNEVEN would: rows of unshared_load."""
        K = len(self.means.time)
        out = np.zeros((K, MOST_SHARED, max(len(made), 1)))
        there = np.stack([c.can for c in made], axis=1) if made else np.zeros((K, 0))
        of = np.array([c.slot for c in made], int)
        row = np.zeros(K, int)
        for pair in self._pairs_met:
            mine = [k for k in dict.fromkeys(of) if self._pair_of(slots[k]) == pair]
            if not self._lies(pair) or len(mine) < 4:
                continue
            ease = 1.0 / (slots[mine[0]].stiffness * UNEVEN)
            places = np.stack([self._W @ slots[k].place[:, :2] for k in mine], axis=1)
            acts = np.stack([there[:, of == k].any(axis=1) for k in mine], axis=1)
            for i in range(K):
                some = np.flatnonzero(acts[i])
                if len(some) < 4:
                    continue
                loads = unshared_load(places[i, some])[: MOST_SHARED - row[i]]
                for one in loads:
                    for k, x in zip(some, one, strict=True):
                        out[i, row[i], of == mine[k]] = ease * x
                    row[i] += 1
        return out

    def _weigh(self) -> None:
        """What rows are divided by: noise of accelerations, efforts and wrenches, and
        to begin with MODELLED of the forces that act in a row."""
        m = self.means
        K, n_v = m.acceleration.shape
        n = n_v + m.wrench.shape[1]
        C = np.zeros((K, n, n))
        M = self._M
        C[:, :n_v, :n_v] = M @ self._a_covariance @ M.transpose(0, 2, 1)
        i, j = np.arange(n_v), np.arange(n_v, n)
        C[:, i, i] += m.effort_var
        C[:, j, j] += m.wrench_var
        self._sensors_alone = C
        needs = self._all_needs(())
        G, there, of, _, sharing = self._generators(())
        rough = np.array(C)
        size = np.sqrt(np.mean(needs**2, axis=0))
        rough[:, np.arange(n), np.arange(n)] += (0.1 * size + 1e-6) ** 2
        weights = np.zeros(there.shape)
        explain(
            needs, G, there, roots_of(rough), sharing, np.zeros_like(needs),
            weights, np.zeros(K, np.int64),
        )  # fmt: skip
        acting = np.abs(G * weights[:, None, :]).sum(axis=2) + np.abs(needs)
        self.acting = np.sqrt(np.mean(acting**2, axis=0))
        share = np.append(np.full(n_v, MODELLED), np.full(n - n_v, WRENCHED))
        self.allow(share * self.acting)

    def allow(self, allowance: np.ndarray) -> None:
        """Weighs rows anew. allowance (rows,): what models are off by, in N and N m."""
        self.allowance = np.asarray(allowance, float)
        C = np.array(self._sensors_alone)
        k = np.arange(C.shape[1])
        C[:, k, k] += (self.allowance + 1e-9 + 1e-6 * self.acting) ** 2
        self.root, self._last = roots_of(C), None
        needs = self._all_needs(())
        G, there, of, _, sharing = self._generators(())
        weights = np.zeros(there.shape)
        left, rank = np.zeros_like(needs), np.zeros(len(needs), np.int64)
        explain(needs, G, there, self.root, sharing, left, weights, rank)
        # Of n rows those are free that no force takes up.
        n = needs.shape[1]
        self.free = np.sqrt(n / np.maximum(n - rank, 1))
        # How hard each pair presses: the distance is that much less.
        self._pressed: dict[tuple[int, int], np.ndarray] = {}
        for column, number in enumerate(of):
            pair = self._pair_of(self.slots[number])
            f = self._pressed.setdefault(pair, np.zeros(len(needs)))
            f += weights[:, column]

    def in_newtons(self, left: np.ndarray) -> np.ndarray:
        """Rows (K, rows) of equations as left() gives them, in N and N m."""
        return np.linalg.solve(self.root, left[:, :, None])[:, :, 0]

    def sensor_std(self) -> np.ndarray:
        """(rows,) rms of what sensors' noise alone makes of each row [N, N m]."""
        k = np.arange(self._sensors_alone.shape[1])
        return np.sqrt(np.mean(self._sensors_alone[:, k, k], axis=0))

    # ----- Residuals

    def _all_needs(self, effects: Sequence[Effect]) -> np.ndarray:
        """(K, rows): generalized forces that contact must give, measured wrenches."""
        m = self.means
        P = self._needs.copy()
        inertial: dict[str, list[Effect]] = {}
        for e in effects:
            kind = KINDS[e.kind]
            if e.kind in SHAPED:
                continue
            if e.kind in INERTIAL:
                for body in find_bodies(e, self.plant):
                    inertial.setdefault(full_name(self.plant, body), []).append(e)
                continue
            if kind.path:
                P -= self._driven_more(e)
                continue
            if kind.at not in ("body", "free body", "joint", "actuator"):
                raise ValueError(
                    f"effect {e.kind} is not one of equations with contact"
                )
            more = added_effort(e, kind, self.dynamics, self.motion)
            if more is None:
                raise ValueError(f"effect {e.kind}: its equations are not known")
            P += more
        for body, own in inertial.items():
            P += self._inertial(body) @ self._more_inertia(body, own)
        return np.hstack([P, m.wrench])

    def _driven_more(self, effect: Effect) -> np.ndarray:
        """(K, n_v) what drives give more with an effect on their path."""
        out = np.zeros_like(self.means.effort)
        for joint in find_joints(effect, self.plant):
            i = joint.velocity_start()
            if effect.kind == "actuator_gain":
                out[:, i] = (effect.parameters["gain"] - 1.0) * self.means.effort[:, i]
            elif effect.kind == "actuator_bias":
                out[:, i] = effect.parameters["bias"]
            elif effect.kind == "input_delay":
                out[:, i] = effect.parameters["delay"] * self.means.effort_slope[:, i]
            else:
                raise ValueError(f"effect {effect.kind}: its equations are not known")
        return out

    def _inertial(self, body: str) -> np.ndarray:
        """(K, n_v, 10) of a free body's inertial parameters."""
        if body not in self._inertial_of:
            (found,) = find_bodies(Effect("", [body], {}), self.plant)
            self._inertial_of[body] = inertial_columns(
                self.dynamics, self.motion, found
            )[0]
        return self._inertial_of[body]

    def _more_inertia(self, body: str, effects: Sequence[Effect]) -> np.ndarray:
        """(10,) by which the body's inertial parameters change: kinds in the order of
        their rank, as on a plant."""
        (found,) = find_bodies(Effect("", [body], {}), self.plant)
        M = found.default_spatial_inertia()
        mass, com = M.get_mass(), np.array(M.get_com())
        central = central_inertia(M)
        before = _ten(mass, com, central)
        for e in sorted(effects, key=lambda e: KINDS[e.kind].rank):
            p = e.parameters
            if e.kind == "object_mass":
                if not p["mass"] > 0.0:
                    raise ValueError("object_mass: not above zero")
                central, mass = central * (p["mass"] / mass), p["mass"]
            elif e.kind == "object_com":
                com = np.array([p.get(a, x) for a, x in zip("xyz", com, strict=True)])
            else:
                for i, a in enumerate(("ixx", "iyy", "izz")):
                    central[i, i] = p.get(a, central[i, i])
                w = np.linalg.eigvalsh(central)
                if not (w[0] > 0.0 and w[0] + w[1] >= w[2]):
                    raise ValueError(f"object_inertia: no body has {p}")
        return _ten(mass, com, central) - before

    def left(self, effects: Sequence[Effect] = (), shift: Shift | None = None):
        """What permitted forces leave over the noise, (K, n): equations and wrenches,
        then channels that tell the same twice, then distances."""
        needs = self._all_needs(effects)
        shaped = [e for e in effects if e.kind in SHAPED]
        G, there, _, slots, sharing = self._generators(shaped, shift)
        r = self._explained(needs, G, there, sharing)
        r = r * self.free[:, None]
        more = self.means.extra / np.sqrt(np.maximum(self.means.extra_var, 1e-300))
        return np.hstack([r, more, self._distances(slots)])

    def _explained(self, needs, G, there, sharing) -> np.ndarray:
        """What permitted forces leave; only where anything is other than the last time
        is it computed."""
        new = np.ones(len(needs), bool)
        r = np.zeros_like(needs)
        if self._last is not None and self._last[1].shape == G.shape:
            P_last, G_last, there_last, r_last = self._last
            new = (needs != P_last).any(axis=1) | (G != G_last).any(axis=(1, 2))
            new |= (there != there_last).any(axis=1)
            r[:] = r_last
        if new.any():
            some = np.zeros((int(new.sum()), needs.shape[1]))
            explain(
                needs[new], G[new], there[new], self.root[new], sharing[new], some,
                np.zeros((len(some), there.shape[1])), np.zeros(len(some), np.int64),
            )  # fmt: skip
            r[new] = some
        self._last = (needs, G, there, r)
        return r

    def _distances(self, slots: Sequence[Slot]) -> np.ndarray:
        """(K, n) over what shapes and poses are known to, and their numbers: of each
        pair that lies, height and slopes; of each other one, the distance."""
        masks = dict(zip((s.key for s in self.slots), self._masks, strict=True))
        shape = float(self.scene.tolerance.get("shape_m", SHAPES))
        K = len(self.means.time)
        thinned = np.arange(K) % THIN == 0
        columns = []
        for pair in self._pairs_met:
            mine = [s for s in slots if self._pair_of(s) == pair and s.key in masks]
            mask = np.stack([masks[s.key] for s in mine]).astype(float)
            phi = np.stack([s.phi for s in mine])
            n = mask.sum(axis=0)
            some = n > 0.0
            there = np.asarray(self._W @ some.astype(float)).ravel()
            good = (there > 0.999) & thinned
            place, turn = self._pose_noise(pair)
            stiffness = mine[0].stiffness
            mean = np.sum(mask * phi, axis=0) / np.maximum(n, 1.0)
            pressed = self._pressed.get(pair, np.zeros(K)) / stiffness
            if self._lies(pair):
                xy = np.stack([s.place[:, :2] for s in mine])
                middle = np.einsum("sn,snj->nj", mask, xy) / np.maximum(n, 1.0)[:, None]
                off = (xy - middle) * mask[:, :, None]
                A = np.einsum("snj,snk->njk", off, off) + 1e-12 * np.eye(2)
                b = np.einsum("snj,sn->nj", off, mask * (phi - mean))
                slope = np.linalg.solve(A, b[:, :, None])[:, :, 0]
                arm = float(np.sqrt(np.median(A[some].trace(axis1=1, axis2=2)) / 4.0))
                # Each of several points carries its share.
                h = self._W @ mean + pressed / np.maximum(self._W @ n, 1.0)
                columns.append(np.where(good, h / np.hypot(shape, place), 0.0))
                std = np.sqrt((shape / max(arm, 1e-3)) ** 2 + turn**2 + 1e-6)
                spread = np.asarray(self._W @ (n >= 3).astype(float)).ravel() > 0.999
                for k in range(2):
                    columns.append(
                        np.where(good & spread, (self._W @ slope[:, k]) / std, 0.0)
                    )
            else:
                least = np.where(mask > 0.0, phi, np.inf).min(axis=0)
                least = np.where(some, least, 0.0)
                d = self._W @ least + pressed
                columns.append(np.where(good, d / np.hypot(shape, place), 0.0))
        return -np.stack(columns, axis=1) if columns else np.zeros((K, 0))

    def _lies(self, pair: tuple[int, int]) -> bool:
        return bool(set(pair) & self.shapes.anchored)

    def _pose_noise(self, pair: tuple[int, int]) -> tuple[float, float]:
        """Of a smoothed place [m] and turn [rad] of a pair's seen bodies."""
        place = turn = 0.0
        for k in pair:
            body = self.shapes.names[k]
            if body in self.bodies:
                every = [r.channels[f"{body}.{a}"].noise for r in self.recordings
                         for a in "xyz"]  # fmt: skip
                place = max(place, *every)
                every = [2.0 * r.channels[f"{body}.{a}"].noise for r in self.recordings
                         for a in TURN]  # fmt: skip
                turn = max(turn, *every)
        return 0.5 * place, 0.5 * turn

    def row_names(self) -> list[str]:
        names = [f"{c} equation" for c in self.coordinates]
        names += [f"{place}.{a}" for place, _ in self.sensors for a in _FORCE]
        names += [name for name, _ in self.extra]
        for pair in self._pairs_met:
            name = self.pair_name(pair)
            names.append(f"{name}.distance")
            if self._lies(pair):
                names += [f"{name}.slope_x", f"{name}.slope_y"]
        return names

    def counts(self) -> np.ndarray:
        """(K, n) which entries of left() are there."""
        r = self.left()
        out = np.ones(r.shape, bool)
        n = len(self.coordinates) + self.means.wrench.shape[1]
        out[:, n : n + len(self.extra)] = self.means.extra_var < 1e11
        known = [i for j, (_, i) in self.joints.items() if self.by[j] == ""]
        out[:, known] = False
        out[:, n + len(self.extra) :] = r[:, n + len(self.extra) :] != 0.0
        return out


def _is_of(effect: Effect, body: str) -> bool:
    return any(at in (body, body.split(".")[0]) for at in effect.at)


def _ten(mass: float, com: np.ndarray, central: np.ndarray) -> np.ndarray:
    """Mass, mass times centre, inertia about the origin, as inertial_columns has it."""
    about = central + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.array([mass, *(mass * com), *(about[at] for at in SIX)])


def _between(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """1 within, 0 without; over EDGE about the ends it is in between, so that a search
    has slopes."""
    return expit((x - low) / EDGE) * expit((high - x) / EDGE)

"""A mechanism that runs against what is fixed: windows through impacts.

Joints are all that moves, and every so often a link touches a wall. Equations of motion
without contact say nothing there. Windows are simulated instead, by a continuous plant:
short ones about each touch, which show the contact's stiffness and dissipation, and
some of the free motion between, which show friction and drives. A window begins before
the touch, from a state that is smoothed on that side alone.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from makebreak.gap.data.findings import Finding
from makebreak.gap.data.pieces import MOST_SHARE, less_of, part_of
from makebreak.gap.data.recording import FEWEST_ROWS, Episode, Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.runs import runs_of
from makebreak.gap.problem import Candidate, Fitted, Nuisances, SearchPlan
from makebreak.gap.residuals.contact import PLACES
from makebreak.gap.residuals.contact_candidates import reader_of_trial
from makebreak.gap.residuals.mechanism import link_changes
from makebreak.gap.residuals.objects import WindowedProblem
from makebreak.gap.simulation.contact_shapes import BEYOND, ContactShapes, poses_of
from makebreak.gap.simulation.windows import Window, WindowModel, drawn, with_step
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact import CONTACT_LAW, DAMPER, DISSIPATION, STIFFNESS
from makebreak.models.effects.ground import PLACE
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints
from makebreak.models.scene import Scene
from makebreak.systems.numerics.smoother import smooth_filtered

ROWS_BEFORE, ROWS_AFTER = 12, 12  # Of a window about a touch, beside the touch itself.
LONGEST_SEC = 0.3  # Of a window.
FREE_SEC, MOST_FREE, MOST_TOUCHES = 0.25, 6, 9
AS_LONG = 0.8  # As the longest free windows; some are much shorter.
LOOKS = 4000  # Rows at which it is first asked whether anything comes near.
NEAR = 0.01  # [m]
FEWEST = 3  # Touches.
# Rows beside a touch between which an approach changes, and by how many times what it
# nearly always does elsewhere.
BESIDE, FELT = 2, 2.0
DRAWS = 3  # Of uncertain starts.
BLUR = 0.003  # Of how far a channel goes in a window: laws are no better.
TRIED = (0.2, 0.4, 0.7, 0.9, 1.15, 1.7, 2.6, 4.5)  # Times what the scene has.
DAMPED = (0.02, 0.06, 0.12, 0.25, 0.5, 1.0)  # Of critical damping: a linear damper's.
SMALL = 0.2  # First trial of an effect on joints, of the efforts there.
REACH = 3.0
LATE_SHARE = 0.1  # Of a row, by which commands are moved to see what that does.
TIMING = "timing of the commands"  # A nuisance.
LATE_SEC = 2.5e-4  # A velocity may come so much later than its position.


def runs_against(dynamics: SceneDynamics, recordings: Sequence[Recording]) -> bool:
    """Whether a link touches something fixed every now and then, as the scene has the
    shapes; what belongs to the robot's own model does not count."""
    return _met_walls(dynamics, recordings) is not None


def _met_walls(
    dynamics: SceneDynamics, recordings: Sequence[Recording]
) -> ContactShapes | None:
    """The shapes that run against each other every now and then; those of a robot's own
    base only if no others do, as models overlap there. None: none do."""
    for own in (False, True):
        try:
            shapes = walls_of(dynamics, own)
        except DoesNotFit:
            return None
        if shapes is None or not _now_and_then(dynamics, shapes, recordings):
            continue
        if not own or _is_felt(dynamics, shapes, recordings):
            return shapes
    return None


def without_contact(
    dynamics: SceneDynamics, recordings: Sequence[Recording]
) -> tuple[list[Recording], list[Finding]]:
    """The recordings less the few times at which a link touches what is fixed, for
    equations that know of no contact; and what was left out. All of them where nothing
    touches, or so much that it is no touch."""
    kept = list(recordings)
    for own in (False, True):
        try:
            shapes = walls_of(dynamics, own)
        except DoesNotFit:
            return kept, []
        if shapes is None or (own and not _is_felt(dynamics, shapes, recordings)):
            continue
        parts = [_apart(dynamics, shapes, recording) for recording in recordings]
        if all(part is None for part in parts) or any(
            part is not None and not part[0] for part in parts
        ):
            continue
        found = []
        for k, part in enumerate(parts):
            if part is None:
                continue
            episodes, seconds = part
            name = recordings[k].name
            kept[k] = part_of(recordings[k], episodes)
            says = (
                f"A link touches what is fixed now and then; {seconds:.2g} s about "
                "that are left out: too few touches to judge contact by."
            )
            found.append(Finding("touches", name, "time", seconds, "s", "info", says))
        return kept, found
    return kept, []


def _apart(dynamics: SceneDynamics, shapes, recording: Recording):
    """As less_of where anything touches; None: nothing does."""
    q, near = positions(dynamics, recording), np.zeros(len(recording.time), bool)
    for episode in recording.episodes:
        near[episode.rows] = nearest(shapes, dynamics, q[episode.rows]) < 0.0
    return less_of(recording, near) if near.any() else None


def _now_and_then(dynamics: SceneDynamics, shapes, recordings) -> bool:
    touches, inside, whole = 0, 0, 0
    for recording in recordings:
        q = positions(dynamics, recording)
        for episode in recording.episodes:
            rows = np.arange(episode.first, episode.last)
            whole += len(rows)
            some = rows[:: max(len(rows) // LOOKS, 1)]
            if not nearest(shapes, dynamics, q[some]).min(initial=np.inf) < NEAR:
                continue
            near = nearest(shapes, dynamics, q[rows]) < 0.0
            touches += int(np.sum(np.diff(near.astype(int)) == 1))
            inside += int(near.sum())
    return touches >= FEWEST and inside < MOST_SHARE * whole


def _is_felt(dynamics: SceneDynamics, shapes, recordings) -> bool:
    """Whether something happens where shapes overlap: some pair's approach changes more
    than in as many rows anywhere else. (Links of a robot's model pass through its own
    base where those of the real one pass beside it.)"""
    felt = 0
    for recording in recordings:
        q = positions(dynamics, recording)
        for episode in recording.episodes:
            time = recording.time[episode.rows]
            if len(time) < FEWEST_ROWS:
                continue
            poses = poses_of(dynamics.plant, q[episode.rows], shapes)
            slots = shapes.slots(poses, np.inf, _with_fixed(shapes))
            overlap = np.any([s.phi < 0.0 for s in slots], axis=0)
            last = len(time) - 1
            for phi in (s.phi for s in slots):
                rate = np.gradient(phi, time)
                for a, b in runs_of(phi < 0.0):
                    first, end = max(a - BESIDE, 0), min(b + BESIDE, last)
                    n = end - first
                    free = np.convolve(overlap, np.ones(n + 1), "valid") < 0.5
                    usual = np.abs(rate[n:] - rate[:-n])[free]
                    if len(usual):
                        change = abs(rate[end] - rate[first])
                        felt += bool(change > FELT * np.quantile(usual, 0.99))
    return felt >= FEWEST


def walls_of(dynamics: SceneDynamics, own: bool = False) -> ContactShapes | None:
    """Shapes of links, and of what is fixed and, unless `own`, no part of a robot; None
    if there are not both. Raises: DoesNotFit as ContactShapes."""
    shapes, bases = (
        ContactShapes(dynamics.loaded, hulls=False),
        bases_of(dynamics.plant),
    )
    shapes.keep(lambda body: own or body not in shapes.anchored or body not in bases)
    sides = {s.body in shapes.anchored for s in shapes.surfaces}
    return shapes if sides == {True, False} else None


def bases_of(plant: MultibodyPlant) -> set[int]:
    """Bodies of the robots' bases: what a joint that moves hangs on, and all that the
    robot's own model has welded to that, other than by way of the world. (The ground
    may be in the same file.)"""
    welded: dict[int, set[int]] = {}
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        both = {int(joint.parent_body().index()), int(joint.child_body().index())}
        models = {plant.get_body(BodyIndex(k)).model_instance() for k in both}
        if not joint.num_velocities() and len(models) == 1:
            for k in both:
                welded.setdefault(k, set()).update(both)
    found = set[int]()
    at = {int(j.parent_body().index()) for j in one_dof_joints(plant)}
    while at := {other for k in at for other in welded.get(k, {k})} - found - {0}:
        found |= at
    return found


def positions(dynamics: SceneDynamics, recording: Recording) -> np.ndarray:
    """(n, n_q) as measured, with lines over what is missing in an episode."""
    plant = dynamics.plant
    q = np.tile(
        plant.GetPositions(plant.CreateDefaultContext()), (len(recording.time), 1)
    )
    for joint in one_dof_joints(plant):
        name = f"{full_name(plant, joint)}.position"
        if name not in recording:
            continue
        i, there = joint.position_start(), np.isfinite(recording[name])
        q[there, i] = recording[name][there]
        for e in recording.episodes:  # In each, time may start anew.
            t, y = recording.samples(name, e)
            if len(t):
                q[e.rows, i] = np.interp(recording.time[e.rows], t, y)
    return q


def nearest(
    shapes: ContactShapes, dynamics: SceneDynamics, q, within: float = NEAR
) -> np.ndarray:
    """(n,) distance of the nearest pair of a link and what is fixed; see nearest_of."""
    return nearest_of(shapes, dynamics, q, _with_fixed(shapes), within)


def _with_fixed(shapes: ContactShapes) -> Callable[[int, int], bool]:
    """Whether a pair of bodies is a link and something fixed."""
    return lambda a, b: (a in shapes.anchored) != (b in shapes.anchored)


def nearest_of(
    shapes: ContactShapes,
    dynamics: SceneDynamics,
    q: np.ndarray,
    counts: Callable[[int, int], bool],
    within: float = NEAR,
) -> np.ndarray:
    """(n,) distance of the nearest of the pairs of bodies that count; infinite where
    none is nearer than `within` [m]."""
    found = np.full(len(q), np.inf)
    asked = any(counts(a, b) for a, b in permutations(shapes.bodies(), 2))
    if not (asked and len(q)):
        return found
    poses = poses_of(dynamics.plant, q, shapes)
    # A corner just beyond a face's edge is as far as that face's plane.
    near = within + 2.0 * BEYOND
    pairs, rows = shapes.close(poses, near, counts)
    if pairs:
        some = {body: (R[rows], p[rows]) for body, (R, p) in poses.items()}
        slots = shapes.slots(
            some, near, lambda a, b: counts(a, b) and frozenset((a, b)) in pairs
        )
        found[rows] = np.min([s.phi for s in slots], axis=0) if slots else np.inf
    return np.where(found < within, found, np.inf)


class ImpactWindows(WindowModel):
    """Windows about touches, and of free motion.

    Args: shapes: those that touch, if that was decided on other recordings; then one
        touch is enough. commands_late: by how much later than their rows commands act
        [s].
    Raises: DoesNotFit where there are fewer than FEWEST touches.
    """

    def __init__(
        self,
        scene: Scene,
        recordings: Sequence[Recording],
        shapes: ContactShapes | None = None,
        commands_late: float = 0.0,
    ):
        self.commands_late = commands_late
        scene, fewest = with_step(scene, 0.0), FEWEST if shapes is None else 1
        self.shapes = shapes or _met_walls(SceneDynamics(scene), recordings)
        if self.shapes is None:
            raise DoesNotFit("nothing fixed that a link touches now and then")
        self._touches = 0
        self._touch_sec: list[float] = []  # How long each lasts.
        self._free: list[Window] = []
        super().__init__(scene, recordings, LONGEST_SEC, most=10**6)
        if self._touches < fewest:
            raise DoesNotFit(f"{self._touches} touches, expected {fewest} or more")
        both: list[Window] = []
        self.is_free: list[bool] = []  # Of each window.
        touching = [w for w in self.windows if w not in self._free]
        for some, most, is_free in (
            (touching, MOST_TOUCHES, False), (self._longest(), MOST_FREE, True),
        ):  # fmt: skip
            keep = np.unique(np.linspace(0, len(some) - 1, most).astype(int))
            # Every third is held out, of each sort.
            both += [
                replace(some[k], train=i % 3 != 1)
                for i, k in enumerate(keep if some else [])
            ]
            self.is_free += [is_free] * (len(both) - len(self.is_free))
        self.windows = both
        self.window_sec = float(np.median([
            np.ptp(self.recordings[w.recording].time[w.rows]) for w in both
        ]))  # fmt: skip
        self._add_spread()

    def _cut(self, i, recording: Recording, episode: Episode, hop, block, number):
        assert self.shapes is not None
        time = recording.time[episode.rows]
        if len(time) < 3 * ROWS_BEFORE:
            return
        q = positions(self.dynamics, recording)[episode.rows]
        near = nearest(self.shapes, self.dynamics, q) < 0.0
        touches = runs_of(near)
        # Free stretches, and the states in them: a smoother across a touch blurs both.
        names = self._signals()
        paths = {name: np.zeros((len(time), 3)) for name in names}
        spread = {name: np.zeros((len(time), 3, 3)) for name in names}
        free = []
        starts = [0, *(t[1] for t in touches)]
        ends = [*(t[0] for t in touches), len(time)]
        for a, b in zip(starts, ends, strict=True):
            if b - a < ROWS_BEFORE:
                continue
            free.append((a, b))
            for name in names:
                y = recording[name][episode.rows][a:b]
                if np.isfinite(y).sum() < 8:
                    return
                channel = recording.channels[name]
                s = smooth_filtered(time[a:b], y, channel.noise, channel.stages or ())
                paths[name][a:b], spread[name][a:b] = s.x, s.P
        self._paths[i, episode.first] = {"time": time, **paths}
        commands = [recording.held(c.name)[episode.rows] for c in recording.commands()]

        def window(k: int, end: int) -> Window | None:
            if end - k < 8 or not all(np.isfinite(u[k]) for u in commands):
                return None
            state = {n: x[k] for n, x in paths.items()}
            std = np.tile(self.noise, (end - k, 1))
            return Window(
                i, episode.number, float(time[k]),
                slice(episode.first + k, episode.first + end), state, std, True,
                {n: P[k, :2, :2] for n, P in spread.items()},
            )  # fmt: skip

        for a, b in touches:
            self._touch_sec.append(float(time[min(b, len(time) - 1)] - time[a]))
            before = [s for s in free if s[1] == a]
            if not before or a - before[0][0] < ROWS_BEFORE:
                continue
            k = a - ROWS_BEFORE
            last = int(np.searchsorted(time, time[k] + LONGEST_SEC, "right"))
            after = next((t[0] for t in touches if t[0] > a), len(time))
            found = window(k, min(b + ROWS_AFTER, last, after, len(time)))
            if found is not None:
                self._touches += 1
                self.windows.append(found)
        for a, b in free:
            # What bounces to and fro is free for less: the whole of each way then.
            start, last = a + 3, b - 3
            while last - start >= ROWS_BEFORE:
                end = int(np.searchsorted(time, time[start] + FREE_SEC, "right"))
                found = window(start, min(end, last))
                if found is not None:
                    self.windows.append(found)
                    self._free.append(found)
                start = end

    def _longest(self) -> list[Window]:
        """Free windows that are about as long as the longest few: friction and drives
        show in them by the square of the time."""
        rows = [w.rows.stop - w.rows.start for w in self._free]
        least = AS_LONG * min(sorted(rows)[-MOST_FREE:], default=0)
        return [w for w, n in zip(self._free, rows, strict=True) if n >= least]

    def _add_spread(self) -> None:
        """Noise, what uncertain starts do in the scene as it is, and BLUR."""
        rng = np.random.default_rng(0)
        plain, kept = self.simulate(()), self.windows
        wide = [np.zeros_like(y) for y in plain]
        try:
            for _ in range(DRAWS):
                self.windows = [drawn(w, rng) for w in kept]
                for total, y, y0 in zip(wide, self.simulate(()), plain, strict=True):
                    off = (y - y0) ** 2
                    total += np.where(np.isfinite(off), off, 1.0) / DRAWS
        finally:
            self.windows = kept
        self.windows = [
            replace(w, std=np.sqrt(w.std**2 + v + (BLUR * np.ptp(y, axis=0)) ** 2))
            for w, v, y in zip(self.windows, wide, plain, strict=True)
        ]


class ImpactProblem(ImpactWindows, WindowedProblem):
    """A mechanism that runs against walls, as a problem for the search."""

    _names: tuple[str, ...] | None = None  # Of the nuisances.

    plan = SearchPlan(
        evaluations=10, diff_step=0.01, least_gain=0.05, most_effects=4, shortlist=8
    )

    def _model(self) -> WindowModel:
        return self

    def _again(self, recordings: Sequence[Recording]) -> WindowModel:
        return ImpactWindows(self.scene, recordings, self.shapes, self.commands_late)

    def nuisances(self) -> Nuisances:
        """The links' masses and centres, contact stiffness and dissipation as far as
        the scene's `tolerance` says, and when velocities were measured."""
        columns, prior, names = [], [], []
        changes = list(link_changes(self.dynamics, self.scene))
        for kind in CONTACT_LAW:
            share = float(self.scene.tolerance.get(kind, 0.0))
            for at in self._pairs() if share > 0.0 else ():
                try:
                    ((name, now),) = self.dynamics.now(kind, [at]).items()
                except ValueError:  # Its shapes are not alike.
                    continue
                step = min(0.3 * share, 0.2) * now
                changes.append(
                    (f"{kind} of {at}", Effect(kind, [at], {name: now + step}), step)
                )
        for name, effect, size in changes:
            moved = tried(self, effect)
            if moved is None:
                continue
            column = (self.base() - moved) / size
            if np.abs(column).max() * size > 1e-2:
                columns.append(column)
                prior.append(self._tolerance(name, effect, size))
                names.append(name)
        for channel in self.channels:
            if channel.endswith(".velocity"):
                columns.append(self._late(channel))
                prior.append(LATE_SEC)
                names.append(f"timing of {channel}")
        if self.has_commands():
            columns.append(self.of_late_commands())
            prior.append(self.row_sec() / REACH)
            names.append(TIMING)
        self._names = tuple(names)
        if not columns:
            return Nuisances.none(len(self.base()))
        return Nuisances(np.stack(columns, 1), np.array(prior), self._names, REACH)

    def of_late_commands(self) -> np.ndarray:
        """(m,) what each second by which commands act later adds to the residual."""
        now, base, step = self.commands_late, self.base(), LATE_SHARE * self.row_sec()
        try:
            self.set_commands_late(now + step)
            return (base - self.residual()) / step
        finally:
            self.set_commands_late(now)
            self._base = base

    def of_joints(self) -> np.ndarray:
        """(m, k) what each kind with one parameter does at each joint, in its first
        step; but those that make commands late."""
        columns = []
        for kind, at, name, trials in kinds_of_joints(self):
            moved = None
            if KINDS[kind].path not in ("delay", "lag"):
                moved = tried(self, Effect(kind, [at], {name: trials[0][1]}))
            if moved is not None and np.abs(self.base() - moved).max() > 1e-3:
                columns.append(self.base() - moved)
        return np.stack(columns, 1) if columns else np.zeros((len(self.base()), 0))

    def free_rows(self) -> np.ndarray:
        """(m,) whether each row is of free motion."""
        return self._by_row(self.is_free)

    def _late(self, channel: str) -> np.ndarray:
        """(m,) what each second by which a channel is late adds to the residual: its
        measured rate. (In a stiff touch 0.05 ms are 5 times a velocity's noise, all to
        one side; a simulator that steps a velocity before its position has them.)"""
        k, rates = self.channels.index(channel), []
        for recording in self.recordings:
            rate = np.full(len(recording.time), np.nan)
            for e in recording.episodes:
                t, y = recording.samples(channel, e)
                if len(t) > 1:
                    rate[e.rows] = np.interp(
                        recording.time[e.rows], t, np.gradient(y, t)
                    )
            rates.append(rate)
        each = []
        for w in self.windows:
            column = np.zeros_like(w.std)
            column[:, k] = -np.nan_to_num(rates[w.recording][w.rows]) / w.std[:, k]
            each.append(column.ravel())
        return np.concatenate(each)[self.measured()]

    def replaced(self, effects: Sequence[Effect]) -> np.ndarray | None:
        """The dissipation of a contact that a linear damper damps."""
        names = {f"{DISSIPATION} of {at}" for e in effects for at in e.at
                 if e.kind == DAMPER}  # fmt: skip
        if not names:
            return None
        return np.array([name in names for name in self._named()])

    def _named(self) -> tuple[str, ...]:
        if self._names is None:
            self._names = self.nuisances().names
        return self._names

    def _tolerance(self, name: str, effect: Effect, size: float) -> float:
        if not effect.kind.startswith("contact_"):
            return size
        ((_, now),) = self.dynamics.now(effect.kind, effect.at).items()
        return float(self.scene.tolerance[effect.kind]) * now

    def _pairs(self) -> list[str]:
        """Links and walls that come near each other."""
        return list(self._near())

    def _met_axes(self) -> list[tuple[str, str]]:
        """Walls, and the axes of the world along which they are met."""
        assert self.shapes is not None
        anchored = self.shapes.anchored
        fixed = {name for k, name in self.shapes.names.items() if k in anchored}
        found = {
            (at, "xyz"[int(np.argmax(across))]): True
            for pair, across in self._near().items()
            for at in pair.split("~") if at in fixed
        }  # fmt: skip
        return list(found)

    def _near(self) -> dict[str, np.ndarray]:
        """{pair of a link and a wall that come near each other: (3,) how much of the
        way between them is along each axis}."""
        assert self.shapes is not None
        found: dict[str, np.ndarray] = {}
        for recording in self.recordings:
            q = positions(self.dynamics, recording)
            q = q[:: max(len(q) // LOOKS, 1)]
            poses = poses_of(self.dynamics.plant, q, self.shapes)
            for s in self.shapes.slots(poses, NEAR):
                if (s.a in self.shapes.anchored) != (s.b in self.shapes.anchored):
                    a, b = (s.a, s.b) if s.b in self.shapes.anchored else (s.b, s.a)
                    pair = f"{self.shapes.names[a]}~{self.shapes.names[b]}"
                    across = np.abs(s.normal[s.phi < NEAR]).sum(axis=0)
                    found[pair] = found.get(pair, np.zeros(3)) + across
        return found

    def candidates(self, nuisances: Nuisances, current: Fitted) -> list[Candidate]:
        trials = [*self._of_contacts(), *self._of_places(), *kinds_of_joints(self)]
        return candidates_of(self, trials, current)

    def _of_contacts(self):
        for at in self._pairs():
            for kind in CONTACT_LAW:
                try:
                    ((name, now),) = self.dynamics.now(kind, [at]).items()
                except ValueError:
                    continue
                trials = [((f - 1.0) * now, f * now) for f in TRIED]
                if now > 0.0:
                    yield kind, at, name, trials
            try:
                stiffness = self.dynamics.now(STIFFNESS, [at])["stiffness"]
            except ValueError:
                continue
            # A mass m on a spring k touches for pi sqrt(m/k).
            critical = 2.0 * stiffness * float(np.median(self._touch_sec)) / np.pi
            values = [share * critical for share in DAMPED]
            yield DAMPER, at, "damping", [(c, c) for c in values]

    def _of_places(self):
        for at, axis in self._met_axes():
            if at in self.dynamics.places(PLACE):
                yield PLACE, at, axis, [(x, x) for x in PLACES]


def kinds_of_joints(model: WindowModel):
    """(kind, place, parameter, trials) of kinds with one parameter, at each joint; a
    trial is a step and the value with it."""
    dynamics, plant = model.dynamics, model.dynamics.plant
    M = np.diag(plant.CalcMassMatrix(plant.CreateDefaultContext()))
    for joint in one_dof_joints(plant):
        at, i = full_name(plant, joint), joint.velocity_start()
        path = [
            p[f"{at}.position"] for p in model._paths.values() if f"{at}.position" in p
        ]
        if not path:
            continue
        x = np.concatenate(path)
        speed = float(np.sqrt(np.mean(x[:, 1] ** 2))) or 1e-3
        effort = float(M[i] * np.median(np.abs(x[:, 2]))) or 1e-3
        for kind, entry in KINDS.items():
            if (
                entry.at not in ("joint", "actuator", "drive")
                or len(entry.parameters) != 1
            ):
                continue
            if at not in dynamics.places(kind) or entry.hidden_state:
                continue
            (p,) = entry.parameters
            now = dynamics.now(kind, [at]).get(p.name, 0.0)
            step = {
                "N m": SMALL * effort,
                "N m/rad": 0.1 * now,
                "N m s/rad": SMALL * effort / speed,
                "N m s2/rad2": SMALL * effort / speed**2,
                "kg m2": 0.1 * float(M[i]),
                "s": 0.002,
                "": 0.05,
            }.get(p.unit)
            if step and abs(now) < 1e20:
                yield kind, at, p.name, [(step, now + step)]


def candidates_of(
    model: WindowedProblem, trials: Iterable, current: Fitted
) -> list[Candidate]:
    """Candidates of one parameter, by simulating them beside what is there now.

    Args: trials: (kind, place, parameter, [(step, value with it), ...]) of each.
    """
    found = []
    taken = {(e.kind, at) for e in current.effects for at in e.at}
    for kind, at, name, steps in trials:
        columns, readers = [], []
        for step, value in steps if (kind, at) not in taken else ():
            moved = tried(model, *current.effects, Effect(kind, [at], {name: value}))
            if moved is None or not np.abs(current.r - moved).max() > 1e-3:
                continue
            columns.append(((current.r - moved) / step)[:, None])
            readers.append(reader_of_trial(kind, (name,), [(step, {name: value})]))
        if columns:
            least = model.least(kind, [at])
            found.append(
                Candidate(kind, (at,), 1, tuple(columns), tuple(readers), least=least)
            )
    return found


def tried(model: WindowedProblem, *effects: Effect) -> np.ndarray | None:
    """The residual with effects; None where the scene cannot have them."""
    try:
        return model.residual(effects)
    except (ValueError, RuntimeError):
        return None

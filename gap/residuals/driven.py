"""A mechanism whose drives follow commands, by its windows: the other way of its
equations of motion (mechanism.py), where these leave a gap without a name.

Without a measured effort an equation says what the drive's law makes of its own error.
Here windows are simulated by compiled code (gap/simulation/driven_arm.py), a hundred
times as fast as by Drake, and what effects would do is seen by differences.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from makebreak.gap.data.recording import Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import (
    Candidate,
    Fitted,
    GapProblem,
    Nuisances,
    Outcome,
    SearchPlan,
    rms,
)
from makebreak.gap.residuals.drive_gains import (
    gain_changes,
    gain_name,
    gains_known_to,
    with_moved_gains,
)
from makebreak.gap.residuals.inverse import LOOPS
from makebreak.gap.residuals.mechanism import (
    LESS,
    MISFIT,
    beyond_noise,
    link_changes,
    moved_links,
)
from makebreak.gap.residuals.mechanism_candidates import (
    NUISANCE_LIMIT,
    loads,
    tolerances,
    values_tried,
)
from makebreak.gap.residuals.mechanism_motion import bearings_of
from makebreak.gap.residuals.where import unexplained_in_windows, where_in_windows
from makebreak.gap.result import Where
from makebreak.gap.simulation.driven_arm import DrivenArmSimulation, can_have
from makebreak.gap.simulation.measure import gap_measure, series_of, why_stopped
from makebreak.gap.simulation.windows import LARGEST, WindowModel
from makebreak.gap.thresholds import UNEXPLAINED_RMS
from makebreak.models.drives import DRIVEN_BY, law_of
from makebreak.models.effects import KINDS
from makebreak.models.effects.joints import rotor
from makebreak.models.effects.kind import (
    Effect,
    Parameter,
    full_name,
    one_dof_joints,
)
from makebreak.models.effects.signature import Motion
from makebreak.models.scene import Scene
from makebreak.models.scene_schema import COMMANDS_OF

# A drive's position loop keeps a simulation near: it forgets its start. Without one
# errors add up.
WINDOW_SEC, WITHOUT_LOOP_SEC, MOST_WINDOWS = 2.0, 0.5, 60
# Of what the scene as it came is off by, taken for unknown until a model tells.
UNKNOWN = 0.1
# How far a parameter is moved to see what it does, in shares of a typical size.
SMALL = 0.1
# Such a move, in deviations of what is known of a parameter beforehand.
STEP_OF_PRIOR = 0.3
# How late a drive's own loop may act: half a period of one at 1 kHz.
LOOP_SEC = 5e-4
# Units of the kinds that all joints have in a rich model.
RICH = ("N m", "N m s/rad", "N m/rad", "kg m2")
OWN = 0.02  # Of a column, what is no sum of those before it: less says the same.
LAW = 0.1  # Of such a step: what is smaller may be the law's own error.
HALF = 0.5  # Of what a rich model leaves: a wider kind must leave less.
RICH_STEPS = 16  # Gauss-Newton steps of the fit of all that a joint may have.
# Columns of links are taken again where they are off by this, over what rows are
# divided by, so many times at most.
CURVED, MOST_MOVES = 0.3, 6
LIMITS = (0.5, 1.0, 1.5, 2.0)  # Of a joint's rms effort, tried as its most.
JOINTS = ("joint", "actuator", "drive")  # Kinds at these act on a joint.
BEST_SEC = 0.25  # In which the best start is looked for.
BESIDE_SEC = 0.06  # About a start, within which a jerk spoils what is known of it.


class DrivenWindows(WindowModel):
    """Windows of a mechanism, simulated by compiled code. What an uncertain start does
    is simulated, too: a stiff drive soon makes it forgotten. Rows are 20 ms apart or
    more: of what a drive follows those between say nothing new.

    Raises: DoesNotFit where the scene takes Drake's steps, or no window fits in.
    """

    rows_sec = 0.02

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        self.looped = "position_command" in COMMANDS_OF[scene.actuation.type]
        seconds = WINDOW_SEC if self.looped else WITHOUT_LOOP_SEC
        self._arms = DrivenArmSimulation(scene)
        super().__init__(
            scene, recordings, seconds, block_sec=max(seconds, 1.2), most=MOST_WINDOWS,
            simulation=self._arms,
        )  # fmt: skip
        base = self.simulate(())
        given = self.windows
        variance = [np.tile(self.noise**2, (len(y), 1)) for y in base]
        for k in range(2):  # Along each axis of the start's covariance.
            self.windows = [replace(w, state=_moved_start(w, k)) for w in given]
            for of, a, b in zip(variance, self.simulate(()), base, strict=True):
                off = a - b
                of += np.where(np.isfinite(off), off, 0.0) ** 2
        self.windows = [
            replace(w, std=np.sqrt(of)) for w, of in zip(given, variance, strict=True)
        ]

    def _best_start(self, time, states, row: int) -> int:
        """Of the next BEST_SEC, the row about which accelerations jump least: a joint
        that a command or its friction jerks there has another speed than the smoothed
        one."""
        last = int(np.searchsorted(time, time[row] + BEST_SEC))
        rows = np.arange(row, max(min(last, len(time) - 4), row + 1))
        worst = np.zeros(len(rows))
        for x in states.values():
            jump = _jumps(time, x)
            worst += (jump[rows] / max(float(np.sqrt(np.mean(jump**2))), 1e-12)) ** 2
        return int(rows[np.argmin(worst)])


class DrivenProblem(DrivenWindows, GapProblem):
    """Windows of joints that follow commands, as a problem for the search."""

    by_equations = False
    plan = SearchPlan(  # fmt: skip
        evaluations=8,
        diff_step=1e-2,
        most_effects=8,
        by_channel=True,
        shortlist=4,
        alike=True,
    )

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        super().__init__(scene, recordings)
        # What models are off by, of each channel, beside noise: not known yet.
        off = self.errors_over(
            self.simulate(()), [np.ones_like(w.std) for w in self.windows]
        )
        off = np.nan_to_num(np.concatenate(off), posinf=0.0, neginf=0.0)
        self.misfit = UNKNOWN * np.sqrt(np.mean(off**2, axis=0))
        self._sizes = self._typical_sizes()
        self._rich: tuple[Effect, ...] = ()
        self._nuisances: Nuisances | None = None
        self._told: tuple[Fitted, list[Candidate]] | None = None
        self._slopes: tuple[np.ndarray, list[float], list[str]] | None = None
        self._explained: bool | None = None
        # Links as they fit best beside the rich model, and what columns say of them.
        self._links: tuple[Effect, ...] = ()
        self._moved_by: np.ndarray | None = None

    # ----- Residuals

    def errors(self, simulated: Sequence[np.ndarray]) -> list[np.ndarray]:
        stds = [np.hypot(w.std, self.misfit) for w in self.windows]
        each = self.errors_over(simulated, stds)
        return [np.clip(e, -LARGEST, LARGEST) for e in each]

    def in_noise(self, left: np.ndarray) -> np.ndarray:
        return left * self._misfit_ratio()

    def error(self, fitted: Fitted) -> float:
        whole = float(np.sqrt(np.mean(self.in_noise(fitted.left) ** 2)))
        return max(self.noise_error(fitted.left), whole)

    def _misfit_ratio(self) -> np.ndarray:
        """(m,) what rows were divided by over the noise alone."""
        return self._divided_by() / self._noise_of_rows()

    def _divided_by(self) -> np.ndarray:
        """(m,) what rows are divided by."""
        each = [np.hypot(w.std, self.misfit) for w in self.windows]
        return np.concatenate([x.ravel() for x in each])[self.measured()]

    def _noise_of_rows(self) -> np.ndarray:
        return np.concatenate([w.std.ravel() for w in self.windows])[self.measured()]

    # ----- What models are off by

    def _forget_nuisances(self) -> None:
        self._links, self._moved_by = (), None
        self._base = self._slopes = self._nuisances = None

    def is_explained(self) -> bool:
        """Whether the scene as it came, its background within its tolerance, explains
        windows as well as noise lets it, and leaves no gap at any channel."""
        if self._explained is None:
            unknown = self.misfit
            for _ in range(MOST_MOVES):
                n = self.nuisances()
                screen = Screen(
                    self.base(), n.columns, n.prior, self.train(), reach=n.reach
                )
                left = screen.fit_nuisances(self.base())[1]
                less = np.minimum(self._misfit_of(left), self.misfit)
                if (less >= LESS * self.misfit).all():
                    break
                # A weak joint's links are off by much that they explain themselves.
                self.misfit, self._base, self._nuisances = less, None, None
                self._move_links()
            channel, left = self.channel_of_rows(), self.in_noise(left)
            each = [left[channel == c] for c in np.unique(channel)]
            most = max(rms(x) for x in each)
            self._explained = rms(left) < MISFIT and most < UNEXPLAINED_RMS
            if not self._explained:  # They are seen beside a rich model.
                self.misfit = unknown
                self._forget_nuisances()
        return self._explained

    def learn_misfit(self) -> None:
        """To be called before a search. What a model with all that a drive may have at
        all joints leaves is what models are off by: no fit is believed beyond that."""
        held = ~self.train()
        if not held.any() or held.all() or self.is_explained():
            return
        n = Nuisances.none(len(held))
        screen = Screen(self.base(), n.columns, n.prior, self.train())
        small = self._independent()
        rich = fit_effects(self, screen, small, evaluations=RICH_STEPS)
        rich = self._with_wider(rich, screen)
        left = rich.r
        if rich.fit.train > screen.evaluate(self.base()).train:  # It went astray.
            left = self.base()
        else:
            self._rich = rich.effects
        self.misfit = np.minimum(self._misfit_of(left), self._misfit_of(self.base()))
        self.correlation = self._correlation_of(left)
        self._base = None
        self.nuisances()  # Links may move, and the scene's rows with them.

    def _with_wider(self, rich: Fitted, screen: Screen) -> Fitted:
        """The rich model with kinds that change with the motion at those joints of
        which they at least halve what it leaves of held-out rows. (Elsewhere they would
        stand for what it lacks: a load's weight, a friction that grows with effort.)"""
        every = self._wider()

        def fitted(some: Sequence[Effect]) -> Fitted:
            effects = [*rich.effects, *some]
            return fit_effects(self, screen, effects, evaluations=RICH_STEPS)

        try:
            wide = fitted(every) if every else rich
        except ValueError:
            return rich
        held = ~self.train()
        kept = [
            e for e in every
            for mine in [held & self._rows_of(e.at[0])]
            if rms(wide.r[mine]) < HALF * rms(rich.r[mine])
        ]  # fmt: skip
        return fitted(kept) if kept else rich

    def prior_rows(self, effects: Sequence[Effect]) -> np.ndarray:
        """Of what several parameters of a joint can do alike none is large: each is
        known beforehand to the size that its joint's motion gives it."""
        rows = []
        for e in effects:
            if KINDS[e.kind].at not in JOINTS or "." not in e.at[0]:
                continue
            for name, value in e.parameters.items():
                unit = KINDS[e.kind].parameter(name).unit
                for joint in e.at:
                    now = self.dynamics.now(e.kind, [joint]).get(name, np.inf)
                    if unit in RICH and now < 1e20:
                        size = self._step(unit, now, joint) / STEP_OF_PRIOR
                        rows.append((value - now) / size)
        return np.array(rows)

    def _independent(self) -> list[Effect]:
        """Small effects at all joints of the kinds that a joint may have, each with a
        column of its own: the simpler kind comes first."""
        found: list[Effect] = []
        basis: dict[str, np.ndarray] = {}
        base = self.base()
        for kind, name, each in self._at_joints():
            if KINDS[kind].channel or KINDS[kind].parameter(name).unit not in RICH:
                continue
            moved = {joint: x + step for joint, (x, step) in each.items() if step}
            small = [Effect(kind, [j], {name: x}) for j, x in moved.items()]
            try:
                off = self.residual(small) - base
            except ValueError:
                continue
            for effect in small:
                (joint,) = effect.at
                x = off[self._rows_of(joint)]
                known = basis.get(joint, np.zeros((len(x), 0)))
                rest = x - known @ (known.T @ x)
                size = float(np.linalg.norm(rest))
                if size > OWN * float(np.linalg.norm(x)):
                    basis[joint] = np.column_stack([known, rest / size])
                    found.append(effect)
        return found

    def _wider(self) -> list[Effect]:
        """Small effects of kinds that change with what the motion gives, at all joints:
        small where the first of their parameters holds."""
        motions, found = self._motions(), []
        for kind, entry in KINDS.items():
            names = [p.name for p in entry.parameters if not p.given]
            if len(names) == len(entry.parameters) or entry.at not in JOINTS:
                continue
            for joint in self.dynamics.places(kind):
                for held in values_tried(kind, joint, self.dynamics.plant, motions):
                    p = dict.fromkeys(names, 0.0) | held
                    unit = entry.parameter(names[0]).unit
                    p[names[0]] = self._step(unit, 0.0, joint)
                    found.append(Effect(kind, [joint], p))
        return found

    def _motions(self) -> list[Motion]:
        """The smoothed motion of each episode."""
        plant, found = self.dynamics.plant, []
        for path in self._paths.values():
            x = np.zeros((3, len(path["time"]), plant.num_velocities()))
            for joint in one_dof_joints(plant):
                name = f"{full_name(plant, joint)}.position"
                if name in path and joint.num_velocities():
                    x[:, :, joint.velocity_start()] = path[name].T
            q, v, vd = x
            found.append(Motion(path["time"], q, v, vd, np.zeros_like(q)))
        return found

    def _misfit_of(self, left: np.ndarray) -> np.ndarray:
        held, of = ~self.train(), self.channel_of_rows()
        noise, ratio = self._noise_of_rows(), self.in_noise(left)
        found = np.zeros(len(self.channels))
        for c in range(len(found)):
            mine = held & (of == c)
            if mine.any():
                found[c] = beyond_noise(ratio[mine] * noise[mine], noise[mine])
        return found

    def _correlation_of(self, left: np.ndarray) -> float:
        """Root of how many neighbouring rows of a window err together."""
        sums, squares, n = 0.0, 0.0, 0
        window, channel = self.blocks(), self.channel_of_rows()
        for k in np.unique(window):
            for c in np.unique(channel):
                x = left[(window == k) & (channel == c)]
                sums, squares = sums + np.sum(x) ** 2, squares + np.sum(x**2)
                n = max(n, len(x))
        return float(np.sqrt(np.clip(sums / max(squares, 1e-300), 1.0, max(n, 1))))

    def reweigh(self, fitted: Fitted) -> bool:
        less = np.minimum(self._misfit_of(fitted.left), self.misfit)
        if (less >= LESS * self.misfit).all():
            return False
        self.misfit, self._base, self._nuisances = less, None, None
        return True

    # ----- The search

    def rich(self) -> Sequence[Effect]:
        return self._rich

    def nuisances(self) -> Nuisances:
        """The links' masses and centres of mass, gains of drives and how late their
        loops are, where all is as it may be (a joint that friction holds hardly shows
        them): columns where links are as they fit best, as a weak drive sags too far
        for what a link does to be seen where the scene has it."""
        if self._nuisances is None:
            if self._slopes is None:
                self._slopes = self._differences(None)
                for _ in range(MOST_MOVES):
                    if not self._move_links():
                        break
            self._nuisances = self._as_nuisances(self._slopes)
        return self._nuisances

    def _as_nuisances(self, slopes) -> Nuisances:
        columns, prior, names = slopes
        if not names:
            return Nuisances.none(len(self.train()))
        columns = columns / self._divided_by()[:, None]
        return Nuisances(columns, np.array(prior), tuple(names), NUISANCE_LIMIT)

    def _move_links(self) -> bool:
        """Moves the links to where they fit best, and the columns with them; whether
        that is where columns did not say what they do."""
        assert self._slopes is not None
        n = self._as_nuisances(self._slopes)
        if not n.names:
            return False
        left = self.residual(self._rich)
        screen = Screen(left, n.columns, n.prior, self.train(), reach=n.reach)
        b, expected = screen.fit_nuisances(left)
        was = self._links, self._moved_by
        kinds = tolerances(self.scene)
        ours = np.array([name.split(" of ", 1)[0] in kinds for name in n.names])
        self._base = None
        self._links = tuple(moved_links(self, n, np.where(ours, b, 0.0)))
        self._moved_by = self._slopes[0] @ np.where(ours, b, 0.0)
        try:
            found = self.residual(self._rich) - n.columns @ b
        except ValueError:  # No scene has such links.
            self._links, self._moved_by = was
            return False
        channel = self.channel_of_rows()
        curved = any(
            rms((found - expected)[channel == c]) > CURVED for c in np.unique(channel)
        )
        if not curved:
            self._links, self._moved_by = was
            return False
        self._slopes = self._differences(np.where(ours, b, 0.0))
        # As much as the columns now say of links that are there.
        self._moved_by = self._slopes[0] @ np.where(ours, b, 0.0)
        return True

    def residual(self, effects: Sequence[Effect] = ()) -> np.ndarray:
        """As GapProblem.residual: of links that were moved, with what columns say that
        they do taken back."""
        r = super().residual([*self._links, *effects])
        if self._moved_by is not None:
            r = r + self._moved_by / self._divided_by()
        return r

    def _differences(
        self, moved: np.ndarray | None
    ) -> tuple[np.ndarray, list[float], list[str]]:
        """What each nuisance does to simulated samples, (m, n_b) over its size; sizes
        and names. moved (n_b,): where links are."""
        columns, prior, names = [], [], []

        def simulated(effects: Sequence[Effect]) -> np.ndarray:
            each = self.simulate(effects)
            y = np.concatenate([x.ravel() for x in each])[self.measured()]
            return np.where(np.isfinite(y), y, 0.0)

        there = simulated([*self._links, *self._rich])
        links = list(link_changes(self.dynamics, self.scene))
        changes = [
            *links, *self._late_loops(), *gain_changes(self.scene, self.joints),
        ]  # fmt: skip
        every = tuple(name for name, _, _ in changes)
        for k, (name, effect, size) in enumerate(changes):
            with_it = [*self._links, *self._beside_rich(effect)]
            if k < len(links) and moved is not None:
                b = np.array(moved)
                b[k] += size
                n = Nuisances(np.zeros((0, len(b))), np.ones(len(b)), every)
                with_it = [*moved_links(self, n, b), *self._rich]
            columns.append((simulated(with_it) - there) / size)
            prior.append(abs(size))
            names.append(name)
        none = np.zeros((len(there), 0))
        return np.stack(columns, axis=1) if names else none, prior, names

    def _beside_rich(self, effect: Effect) -> list[Effect]:
        """The rich model with an effect. Where both say what a gain is, the rich one,
        more by the same share."""
        out, known = [], False
        for e in self._rich:
            if (e.kind, e.at) == (effect.kind, effect.at):
                ((name, value),) = effect.parameters.items()
                if KINDS[e.kind].parameter(name).neutral is None:
                    now = self.dynamics.now(e.kind, e.at)[name]
                    value = value / now * e.parameters[name]
                    e, known = Effect(e.kind, e.at, {name: value}), True
            out.append(e)
        return out if known else [*out, effect]

    def replaced(self, effects: Sequence[Effect]) -> np.ndarray | None:
        """A drive's gain that is fitted has no tolerance beside."""
        n = self._nuisances
        if n is None:
            return None
        fitted = {gain_name(e.at[0]) for e in effects if KINDS[e.kind].drive == "kp"}
        return np.array([name in fitted for name in n.names])

    def _late_loops(self):
        """(name, effect, size) as link_changes, of drives' own loops: a velocity that
        is fed back late adds to a joint what a smaller rotor would take away."""
        late = float(self.scene.tolerance.get(LOOPS, LOOP_SEC))
        for joint, damping in zip(
            self.joints, bearings_of(self.dynamics.plant), strict=True
        ):
            law = law_of(self.scene.actuation, joint)
            if law is None or not law.kd + damping > 0.0:
                continue
            more = rotor(joint, float(law.kd + damping) * late)
            if self._takes(more.kind, joint):
                yield f"input_delay of {joint}, loop", more, -late

    def _moved_loops(self, effects, nuisances: Nuisances, b) -> list[Effect]:
        """Drives' loops as the nuisances (n_b,) have them."""
        found = dict(zip(nuisances.names, b, strict=True))
        there = {(e.kind, at) for e in effects for at in e.at}
        moved = []
        for name, more, size in self._late_loops():
            if (more.kind, more.at[0]) not in there:
                times = float(found.get(name, 0.0)) / size
                p = {k: times * x for k, x in more.parameters.items()}
                moved.append(Effect(more.kind, more.at, p))
        return moved

    def candidates(self, nuisances: Nuisances, current: Fitted) -> list[Candidate]:
        """Kinds at each joint, of which a simulation with all of them tells, and at
        bodies and bases; a delay also at all joints of a model."""
        if self._told is None or self._told[0] is not current:
            self._told = current, self._candidates(current)
        return self._told[1]

    def _candidates(self, current: Fitted) -> list[Candidate]:
        found: list[Candidate] = []
        taken = {(e.kind, at) for e in current.effects for at in e.at}
        for kind, name, each in self._at_joints():
            each = {j: of for j, of in each.items() if (kind, j) not in taken}
            columns, readers = [], []
            for times in (1.0,) if all(s for _, s in each.values()) else LIMITS:
                effects = [
                    Effect(kind, [j], {name: now + (step or times * self._effort(j))})
                    for j, (now, step) in each.items()
                ]
                columns.append(current.r - self._residual(current, effects))
            for joint, (now, step) in each.items():
                mine = self._rows_of(joint)
                own = [np.where(mine, x, 0.0)[:, None] / (step or 1.0) for x in columns]
                if step:
                    readers = [_reader(name, now, 1.0)]
                else:
                    readers = [
                        _reader(name, x * self._effort(joint), 0.0) for x in LIMITS
                    ]
                found.append(
                    Candidate(kind, (joint,), 1, tuple(own), tuple(readers),
                              least=self.least(kind, [joint]))
                )  # fmt: skip
            if KINDS[kind].path == "delay" and each:
                _, step = next(iter(each.values()))
                for model in dict.fromkeys(j.split(".")[0] for j in each):
                    if (kind, model) not in taken:
                        whole = ((columns[0] / step)[:, None],)
                        reader = (_reader(name, 0.0, 1.0),)
                        found.append(Candidate(kind, (model,), 1, whole, reader))
        found += loads(
            self.dynamics, taken, current.r, partial(self._with_load, current.r),
            lambda kind: self.dynamics.places(kind) if can_have(kind) else (),
        )  # fmt: skip
        return [c for c in found if any(x.any() for x in c.columns)]

    def _with_load(self, r: np.ndarray, effect: Effect) -> np.ndarray | None:
        """(m,) what a small load leaves of r (m,), by what the mass of its link and
        where its centre is do; None where that is no nuisance."""
        assert self._slopes is not None
        columns, _, names = self._slopes
        (at,), p = effect.at, effect.parameters
        rows = {name: k for k, name in enumerate(names) if f" of {at}, " in name}
        kinds = {kind: self.dynamics.now(kind, [at]) for kind in tolerances(self.scene)}
        each = [
            (rows.get(f"{kind} of {at}, {name}"), value)
            for kind, now in kinds.items()
            for name, value in now.items()
        ]
        some = [k for k, _ in each if k is not None]
        if len(each) != 4 or len(some) != 4:
            return None
        (_, mass), *centre = each
        more = p.get("mass", 0.0)
        moves = [more, *(p.get(axis, 0.0) for axis in "xyz")]
        if "com_x" in p:
            place = [p[f"com_{axis}"] for axis in "xyz"]
            moves[1:] = [
                more * (x - c) / (mass + more)
                for x, (_, c) in zip(place, centre, strict=True)
            ]
        return r + columns[:, some] @ np.array(moves) / self._divided_by()

    def _residual(self, current: Fitted, more: Sequence[Effect]) -> np.ndarray:
        try:
            return self.residual([*current.effects, *more])
        except ValueError:  # Not with these.
            return current.r

    def apart(self, effects: Sequence[Effect], names) -> list[list[int]]:
        """What one joint is given moves others only as fast as no drive can follow."""
        found: list[list[int]] = []
        nth: dict[str, int] = {}
        sets: dict[int, list[int]] = {}
        for k, (i, _) in enumerate(names):
            at = effects[i].at
            if KINDS[effects[i].kind].at not in JOINTS or "." not in at[0]:
                found.append([k])
                continue
            nth[at[0]] = nth.get(at[0], -1) + 1
            sets.setdefault(nth[at[0]], []).append(k)
        return [*sets.values(), *found]

    def moved_by(self, effect: Effect) -> np.ndarray:
        if KINDS[effect.kind].at not in JOINTS or "." not in effect.at[0]:
            return np.ones(len(self.train()), bool)
        return np.any([self._rows_of(joint) for joint in effect.at], axis=0)

    def _rows_of(self, joint: str) -> np.ndarray:
        mine = [c.rsplit(".", 1)[0] == joint for c in self.channels]
        return np.array(mine)[self.channel_of_rows()]

    def _takes(self, kind: str, joint: str) -> bool:
        return joint in self.dynamics.places(kind)

    def _at_joints(self):
        """(kind, parameter, {joint: (its value now, a step)}) of all kinds with one
        parameter at joints; no step where values are tried."""
        for kind, entry in KINDS.items():
            if entry.at not in JOINTS or not can_have(kind):
                continue
            if len(entry.parameters) != 1:
                continue
            (parameter,) = entry.parameters
            each = {}
            for joint in self.dynamics.places(kind):
                now = self.dynamics.now(kind, [joint]).get(parameter.name, np.inf)
                step = self._step(parameter.unit, now, joint) if now < 1e20 else 0.0
                each[joint] = (now if step else 0.0), step
            if each:
                yield kind, parameter.name, each

    def _step(self, unit: str, now: float, joint: str) -> float:
        k = self.joints.index(joint)
        effort, speed, inertia = (float(x[k]) for x in self._sizes)
        typical = {
            "N m": SMALL * effort,
            "N m s/rad": SMALL * effort / speed,
            "N m s2/rad2": SMALL * effort / speed**2,
            "N m/rad": 0.2 * now,
            "kg m2": 0.3 * inertia,
            "s": 0.01,
            "rad": 0.01,
        }
        return typical.get(unit, 0.15)

    def _effort(self, joint: str) -> float:
        return float(self._sizes[0][self.joints.index(joint)])

    def _typical_sizes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each joint: rms of what its drive gives by its law [N m], rms speed
        [rad/s], inertia [kg m2]."""
        efforts, speeds = [], []
        for joint in self.joints:
            law = law_of(self.scene.actuation, joint)
            u, v = [np.zeros(1)], [np.zeros(1)]
            for i, recording in enumerate(self.recordings):
                for episode in recording.episodes:
                    path = self._paths.get((i, episode.first))
                    if path is None:
                        continue
                    x = path[f"{joint}.position"]
                    v.append(x[:, 1])
                    error, rate = np.zeros(len(x)), np.zeros(len(x))
                    held = self.commands(())[i][episode.first].columns
                    if f"{joint}.position_command" in held:
                        error = held[f"{joint}.position_command"] - x[:, 0]
                    if f"{joint}.velocity_command" in held:
                        rate = held[f"{joint}.velocity_command"]
                    if law is not None:
                        u.append(law.effort(error, rate, x[:, 1]))
            efforts.append(np.sqrt(np.mean(np.concatenate(u) ** 2)))
            speeds.append(np.sqrt(np.mean(np.concatenate(v) ** 2)))
        plant = self.dynamics.plant
        context = plant.CreateDefaultContext()
        M = np.diag(plant.CalcMassMatrix(context))
        effort, speed = np.array(efforts), np.array(speeds)
        return (
            np.maximum(effort, 1e-3 * effort.max() + 1e-9),
            np.maximum(speed, 1e-3 * speed.max() + 1e-6), M,
        )  # fmt: skip

    # ----- What it comes to

    def judged(self) -> dict[str, str]:
        return dict.fromkeys(self.channels, "simulation")

    def is_within_law(self, effect: Effect) -> bool:
        return self.is_within_tolerance(effect)

    def is_within_tolerance(self, effect: Effect) -> bool:
        """Drives keep time, and friction reverses, as well as laws say it: to 1 % of a
        joint's inertia and of its effort. Of a gain, what its own tolerance may be."""
        entry, at = KINDS[effect.kind], effect.at[0]
        if entry.at not in JOINTS:
            return False
        joint = at if "." in at else self.joints[0]
        has = self.dynamics.now(effect.kind, [joint])

        def is_within(parameter: Parameter) -> bool:
            now = has.get(parameter.name, np.inf)
            off = abs(effect.parameters.get(parameter.name, now) - now)
            if entry.drive == "kp":
                return off < NUISANCE_LIMIT * gains_known_to(self.scene) * now
            return now < 1e20 and off < LAW * abs(
                self._step(parameter.unit, now, joint)
            )

        return all(is_within(p) for p in entry.parameters if not p.given)

    def parts(self) -> np.ndarray:
        return self._by_row([w.recording for w in self.windows])

    def nuisance_effects(self, nuisances: Nuisances, b: np.ndarray) -> list[Effect]:
        return moved_links(self, nuisances, b)

    def where(self, left: np.ndarray) -> list[Where]:
        base = self.simulate(())
        return where_in_windows(
            self, self.errors_over(base, [w.std for w in self.windows])
        )

    def outcome(
        self, effects, start: Fitted, end: Fitted, nuisances: Nuisances,
        recordings=None, jobs: int = 1,
    ) -> Outcome | None:  # fmt: skip
        model: DrivenWindows = self
        scene = with_moved_gains(self.scene, nuisances.names, end.b)
        if recordings is not None or scene is not self.scene:
            try:
                model = DrivenWindows(scene, recordings or self.recordings)
            except DoesNotFit:  # No window fits in.
                return None
        held = [recordings is not None or not w.train for w in model.windows]
        if not any(held):
            return None
        links = moved_links(self, nuisances, end.b)
        loops = self._moved_loops(effects, nuisances, end.b)
        # What a background would make impossible is left out: a late loop takes from a
        # rotor that may not be there.
        for moved in ([*links, *loops], links, []):
            try:
                before = model.simulate(moved)
                after = model.simulate([*moved, *effects])
            except ValueError:
                continue
            break

        def why(k: int, with_effects: bool) -> str:
            return why_stopped(model, [*moved, *effects] if with_effects else moved, k)

        gap = gap_measure(model, before, after, held, why)
        if not gap.is_measured:
            return Outcome(gap)
        return Outcome(
            gap,
            series_of(model, before, after, held),
            unexplained_in_windows(model, after),
            where=where_in_windows(model, model.errors(before)) if recordings else (),
        )


def is_driven(scene: Scene, recordings: Sequence[Recording]) -> bool:
    """Whether all that moves are joints that follow commands of their drives, which are
    in the recordings, and no effort is measured."""
    takes = [c for c in COMMANDS_OF[scene.actuation.type] if c in DRIVEN_BY]
    joints = scene.actuation.joints
    if not takes or not joints:
        return False
    for recording in recordings:
        for joint in joints:
            if f"{joint}.position" not in recording:
                return False
            if f"{joint}.effort_measured" in recording:
                return False
            if not any(f"{joint}.{what}" in recording for what in takes):
                return False
    return True


def _jumps(time: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(n,) by how much a smoothed acceleration, of states x (n, 3), changes about each
    row."""
    beside = max(int(BESIDE_SEC / float(np.median(np.diff(time)))), 1)
    row, n = np.arange(len(time)), len(time)
    spans = [
        np.abs(x[np.clip(row + k, 0, n - 1), 2] - x[:, 2])
        for k in (-beside, -1, 1, beside)
    ]
    return np.max(spans, axis=0) + np.abs(x[:, 2])


def _moved_start(window, k: int):
    """The window's state, each signal moved by one deviation along axis k."""
    state = dict(window.state)
    for name, P in window.spread.items():
        w, u = np.linalg.eigh(P)
        state[name] = np.array(state[name])
        state[name][:2] += np.sqrt(max(w[k], 0.0)) * u[:, k]
    return state


def _reader(name: str, now: float, share: float):
    return lambda c: {name: now + share * float(c[0])}

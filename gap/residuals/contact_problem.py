"""A robot that pushes, slides or presses on objects: as a problem for the search.

Residuals are those of gap/residuals/contact_dynamics.py; simulated windows
(gap/simulation/contact_windows.py) then say what effects are worth.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from makebreak.gap.data.recording import Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.selection import Screen, benjamini_hochberg
from makebreak.gap.problem import (
    Fitted,
    Found,
    GapProblem,
    Nuisances,
    Outcome,
    SearchPlan,
    is_sane,
    rms,
)
from makebreak.gap.residuals.contact_candidates import ContactCandidates
from makebreak.gap.residuals.contact_dynamics import OF_ROBOTS, WRENCHED
from makebreak.gap.residuals.contact_means import SLIDES
from makebreak.gap.residuals.lying_on_faces import lying_on_faces
from makebreak.gap.residuals.mechanism import link_changes
from makebreak.gap.residuals.mechanism_candidates import tolerances
from makebreak.gap.residuals.permitted_contacts import Shift
from makebreak.gap.residuals.pose_times import earlier
from makebreak.gap.residuals.touching import ROBUST
from makebreak.gap.residuals.where import unexplained_in_windows, where_in_windows
from makebreak.gap.residuals.wrench_sensor import WrenchSensor, felt_motion
from makebreak.gap.result import InUnits, Where
from makebreak.gap.simulation.contact_windows import (
    LAW,
    PushWindows,
    led_as_measured,
    varies,
)
from makebreak.gap.simulation.face_supports import LiesOn
from makebreak.gap.simulation.measure import (
    gap_measure,
    series_of,
    unseen_series,
    why_stopped,
)
from makebreak.gap.thresholds import AGREEMENT_RMS_MAX
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact_damper import STICTION
from makebreak.models.effects.kind import Effect, sliding_joints
from makebreak.models.effects.objects import MASS
from makebreak.models.scene import Scene

PLACED = 1e-3  # A camera's place [m],
TURNED = 3e-3  # its turn [rad],
LATE = 0.25  # and its clock, in periods of its samples.
TIMING = 2.5e-4  # Of what drives get [s].
FELT = 0.05  # What a force sensor shows more, sampled amid a drive's ripple too.
BEYOND = 3.0
MISFIT = 1.15  # Less than so many times the sensors' noise is no misfit.
(DELAY,) = (name for name, kind in KINDS.items() if kind.channel == "delay")
LEAST_MISFIT = 0.002  # Of the forces in a row: laws are no better than that.
LESS = 0.85
EXACT = 4  # Single effects that are fitted for what models are off by.
# Of a patch's side: how far it is moved [m], and what that may add to the sum of
# squares (neighbouring rows err together: four times what one row would count).
MOVED, PROFILE = (5e-4, 1e-3, 2e-3, 4e-3, 8e-3, 0.016, 0.032, 0.064), 16.0
# By what share of itself a friction is moved likewise.
SHARES = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 0.9)
JUMP = 20.0  # Times the noise, between what a shift does forwards and backwards.
AT_MOST = 20.0  # Of a row, where a block of time is asked whether it is loud.
FEWEST_ROWS = 8  # Of a channel that is looked at by itself.


class ContactProblem(ContactCandidates, GapProblem):
    """Robots and free bodies that touch, by their equations of motion."""

    plan = SearchPlan(
        evaluations=8,
        diff_step=1e-3,
        least_gain=0.05,
        least_error=1.0,
        most_effects=4,
        shortlist=10,
        simulation_agrees=True,
    )

    def __init__(
        self,
        scene: Scene,
        recordings: Sequence[Recording],
        learned: "ContactProblem | None" = None,
        slides: float = SLIDES,
    ):
        """Args: learned: a problem of the same scene with other recordings, of which
        stays what models are off by and what sensors feel; None: both are learned of
        these. slides: slower slip [m/s] may be sticking.
        """
        self.slides = slides if learned is None else learned.slides
        if self.slides > SLIDES:  # Of contacts that creep laws are less exact.
            self.plan = replace(self.plan, least_error=AGREEMENT_RMS_MAX)
        self._scalable: dict[str, bool] = {}
        # By how much bodies' poses were moved earlier before this (late_poses.py) [s],
        # and the error before and with that.
        self.late: dict[str, float] = {}
        self.late_errors = (np.nan, np.nan)
        super().__init__(scene, recordings)
        self._base: np.ndarray | None = None
        self._nuisances: Nuisances | None = None
        self._shown = self.counts()
        self._windows: PushWindows | None = None
        # The model whose noise weighs all others'; None: each is weighed by its own.
        self._weights: Sequence[Effect] | None = None
        self._share_out(self.left())
        # Those from which the tool's own motion is taken off, by the place of each.
        self._feel_motion: tuple[str, ...] = ()
        if learned is not None:
            self._take_off_motion(learned._feel_motion)
            self._set(learned.allowance)
            return
        self._take_off_motion(self._felt_motion())
        self._learn_misfit()
        # What is seen in few blocks may be loud only by the weights that were learned:
        # then these are shared out by them.
        left = self._without_nuisances()
        if max(size for size, _ in self._blocks_left(left)) > self.plan.loud:
            calm = self._in_table(left)
            self._share_out(calm)

    def weighed_by(
        self, effects: Sequence[Effect], every_row: bool = False
    ) -> GapProblem:
        alike = copy(self)
        alike._weights = list(effects)
        if every_row:
            alike._train = np.ones_like(self._train)
        return alike

    def _without_nuisances(self) -> np.ndarray:
        """(m,) what the scene as it came leaves, its nuisances fitted to all rows."""
        n, r = self.nuisances(), self.base()
        return Screen(r, n.columns, n.prior, np.ones(len(r), bool)).fit_nuisances(r)[1]

    def _felt_motion(self) -> tuple[str, ...]:
        """Places of sensors that feel more than half of their tool's own motion."""
        if not self.sensors:
            return ()
        n, r = self.nuisances(), self.base()
        screen = Screen(r, n.columns, n.prior, np.ones(len(r), bool), reach=n.reach)
        by_name = dict(zip(n.names, screen.fit_nuisances(r)[0], strict=True))
        return tuple(
            s.place for s in self.sensors if by_name.get(_felt_by(s), 0.0) < -0.5
        )

    def _take_off_motion(self, places: tuple[str, ...]) -> None:
        """From sensors all of their tools' own motion: what is felt of it is too much
        for a nuisance, along whose slope a force that slides turns out of its cone."""
        self._feel_motion = places
        for sensor in self.sensors:
            if sensor.place in places:
                self.means.wrench[:, sensor.rows] -= self._motion_felt_by(sensor)
        if places:
            self._set(self.allowance)
            self._shown = self.counts()
            self._share_out(self.left())

    def _motion_felt_by(self, sensor: WrenchSensor) -> np.ndarray:
        """(K, n) what a sensor reads of its tool's motion if it feels all of it."""
        m, row = self.means, self.means.centre
        return felt_motion(
            self.dynamics, sensor.frame, self._q[row], self._v[row], m.acceleration
        )[:, : len(sensor.names)]

    # ----- What models are off by

    def _learn_misfit(self) -> None:
        """What a model with everything ordinary in it leaves of held-out rows; or, if
        that is less, one with a single effect, fitted exactly (a mass half as large
        again is far from where its column is straight)."""
        base, nuisances = self.base(), self.nuisances()
        found = self._plain_candidates(base, ())
        n = nuisances.columns
        screen = Screen(base, n, nuisances.prior, self.train())
        plain = screen.fit()
        left, least = base, plain.score
        # What is left with all effects, and how far nuisances are moved beside them, by
        # name: by other weights others may be among them.
        self.rich_left, b = plain.score, plain.b
        if found:
            X = np.hstack([c.columns[0] for c in found])
            rich = screen.fit(X)
            if rich.score < least:
                self.rich_left, b = rich.score, rich.b
                left, least = base - X @ rich.c - n @ rich.b, rich.score
        self.rich_nuisances = dict(zip(nuisances.names, map(float, b), strict=True))
        singles = [
            (fit.score, c.effects(k, fit.c))
            for c in found
            for k, fit in enumerate(map(screen.fit, c.columns))
        ]
        sizes = self.sizes
        singles = [s for s in singles if all(is_sane(e, sizes) for e in s[1])]
        for _, effects in sorted(singles, key=lambda s: s[0])[:EXACT]:
            try:
                one = fit_effects(self, screen, effects)
            except ValueError:
                continue
            if one.score < least:
                left, least = one.left, one.score
        self._set(self._misfit(left))

    def _misfit(self, left: np.ndarray) -> np.ndarray:
        """(rows,) [N, N m] what held-out equations are off by beside sensors' noise."""
        r = self._in_table(left)
        n = len(self.allowance)
        held = ~self._train if not self._train.all() else self._train
        sensors, off = self.sensor_std(), np.abs(self.in_newtons(r[:, :n]))
        # What dry friction holds at rest says nothing of laws.
        told = np.ones(off.shape, bool)
        told[:, : len(self.coordinates)] = (
            self._held(()) < sensors[: len(self.coordinates)]
        )
        size = np.array([_size(off[held & told[:, k], k]) for k in range(n)])
        beside = np.sqrt(np.maximum(size**2 - (MISFIT * sensors) ** 2, 0.0))
        off = np.maximum(beside, LEAST_MISFIT * self.acting)
        for sensor in self.sensors:
            # A moment is a force, of which other rows tell, at a point that geometry
            # tells: one that is off by more is no law of contact.
            rows = np.arange(len(self.coordinates) + self.n_wrench)
            rows = rows[len(self.coordinates) :][sensor.moments]
            off[rows] = np.minimum(off[rows], WRENCHED * self.acting[rows])
        return off

    def _set(self, allowance: np.ndarray) -> None:
        self.allow(allowance)
        self._base, self._nuisances = None, None

    def reweigh(self, fitted: Fitted) -> bool:
        less = np.minimum(self._misfit(fitted.left), self.allowance)
        if (less >= LESS * self.allowance).all():
            return False
        self._set(less)
        return True

    # ----- What may be slightly wrong

    def nuisances(self) -> Nuisances:
        """The drives' timing, the robot's links, where a camera is, and its clock."""
        if self._nuisances is not None:
            return self._nuisances
        base = self.residual()
        columns, prior, names = [], [], []

        def add(name: str, moved: np.ndarray, step: float, size: float) -> None:
            column = (base - moved) / step
            if np.abs(column).max(initial=0.0) * size > 1e-3:
                columns.append(column)
                prior.append(size)
                names.append(name)

        if np.abs(self.means.effort_slope).max(initial=0.0) > 0.0:
            step, kept = 1e-4, self._needs
            self._needs = kept - step * self.means.effort_slope
            try:
                add("timing of the drives", self.residual(), step, TIMING)
            finally:
                self._needs = kept
        for sensor in self.sensors:
            at, kept, forces = sensor.place, self.means.wrench, sensor.forces
            ripple = self._ripple(sensor.welded)
            motion = self._motion_felt_by(sensor)
            for name, own, more, step, size in (
                (f"gain of {at}", sensor.rows, kept[:, sensor.rows], 0.01, FELT),
                (f"ripple of {at}", forces, ripple, 1e-4, self._row_sec()),
                # From none of it, of a sensor at the tip, to all, of one in the mount.
                (_felt_by(sensor), sensor.rows, motion, 1.0, 1.0),
            ):
                self.means.wrench = np.array(kept)
                self.means.wrench[:, own] += step * more
                try:
                    add(name, self.residual(), step, size)
                finally:
                    self.means.wrench = kept
        for name, effect, size in link_changes(self.dynamics, self.scene):
            if set(effect.at) & {*self.bodies, *self.objects}:
                continue
            add(name, self.residual([effect]), size, size)
        for body in self.bodies:
            step = 1e-3
            shifts: list[tuple[str, float, list[Shift]]] = []
            for name, by in zip("xyz", step * np.eye(3), strict=True):
                both = [Shift(body, place=tuple(x)) for x in (by, -by)]
                shifts.append((f"place of {body}, {name}", PLACED, both))
            for name, by in zip("xy", step * np.eye(3)[:2], strict=True):
                both = [Shift(body, turn=tuple(x)) for x in (by, -by)]
                shifts.append((f"turn of {body}, {name}", TURNED, both))
            both = [Shift(body, late=late) for late in (step, -step)]
            shifts.append((f"clock of {body}", LATE * self._period(body), both))
            for name, size, both in shifts:
                ahead, back = (self._flat(self.left((), shift)) for shift in both)
                slope = self._without_jumps((base - ahead) / step, (back - base) / step,
                                            size)  # fmt: skip
                add(name, base - slope, 1.0, size)
        self._nuisances = (
            Nuisances(np.stack(columns, axis=1), np.array(prior), tuple(names), BEYOND)
            if columns
            else Nuisances.none(len(base))
        )
        return self._nuisances

    def _without_jumps(self, ahead, back, size: float) -> np.ndarray:
        """(m,) a slope, of those one way and the other. Where one of the two shifts
        meets another face, or none, that is a jump and no slope, and would count many
        times as much: at such moments the lesser of the two is taken, none where they
        contradict each other. size: of the shift."""
        apart = np.abs(ahead - back) * size > JUMP
        of = self._of_moments()
        jumps = np.bincount(of, weights=apart) > 0.0
        lesser = np.where(np.abs(ahead) < np.abs(back), ahead, back)
        lesser = np.where(ahead * back > 0.0, lesser, 0.0)
        return np.where(jumps[of], lesser, ahead)

    def _ripple(self, welded: Sequence[int]) -> np.ndarray:
        """(K, 3) force at a sensor by a delay of all commands [N/s]: a drive's effort
        steps up with each command and falls until the next, and a sensor that is read
        with the commands sees the top of it, not the mean."""
        m, shown = self.means, [k for k in welded if k in self._J]
        if not shown:
            return np.zeros((len(m.time), 3))
        middle = np.searchsorted(self._rows, m.centre)
        J = self._J[shown[0]][np.clip(middle, 0, len(self._rows) - 1), 3:]
        inverse = np.linalg.pinv(J.transpose(0, 2, 1), rcond=1e-3)
        return np.einsum("kij,kj->ki", inverse, m.effort_slope)

    def _row_sec(self) -> float:
        return float(np.median([np.median(np.diff(t.time)) for t in self.tracks]))

    def _period(self, body: str) -> float:
        steps = []
        for recording in self.recordings:
            for episode in recording.episodes:
                t, _ = recording.samples(f"{body}.x", episode)
                if len(t) > 2:
                    steps.append(float(np.median(np.diff(t))))
        return float(np.median(steps))

    def replaced(self, effects: Sequence[Effect]) -> np.ndarray | None:
        """The mass of a link that is fitted, and that of the heaviest link beside gains
        of all drives or another inertia of the robot: with it free all forces would
        shrink, or grow, together, and with them what noise leaves."""
        places = {at for e in effects if e.kind in OF_ROBOTS for at in e.at}
        if not places and not self._gains_are_free(effects):
            return None
        links = self.dynamics.links()
        places.add(max(links, key=lambda at: links[at]))
        mine = {f"{MASS} of {at}, mass" for at in places}
        return np.array([name in mine for name in self.nuisances().names], bool)

    def _gains_are_free(self, effects: Sequence[Effect]) -> bool:
        driven = {j for j, by in self.by.items() if by not in ("", "passive")}
        gains = {at for e in effects if KINDS[e.kind].path == "gain" for at in e.at}
        return bool(driven) and driven <= gains

    def widened(self, end: Fitted, k: int) -> tuple[dict[str, float], tuple[str, ...]]:
        """A patch's side that nothing slid across can be anywhere until something did,
        and what sticks says of friction only that it is not less: each is moved by ever
        more, and its deviation is half of how far that goes without a loss of PROFILE
        noise variances; infinite where it goes on. Of a friction and a size held-out
        rows are asked: a single fitted one may want more and more of it. A friction
        that is larger than the scene's, and may be any larger, is known from below, if
        not by one moment alone."""
        effect, std = end.effects[k], dict(end.std[k])
        p, every = effect.parameters, np.ones(len(end.r), bool)
        asked = every
        if effect.kind == "friction_patch":
            sides = ("x_min", "x_max", "y_min", "y_max")
            moves: dict[str, tuple[float, ...]] = dict.fromkeys(sides, MOVED)
        elif effect.kind == "contact_friction":
            moves = {"friction": tuple(x * p["friction"] for x in SHARES)}
        elif effect.kind == "object_size":  # Another face is met: its slopes jump.
            moves = {"scale": tuple(x * p["scale"] for x in SHARES)}
        else:
            if KINDS[effect.kind].path == "gain" and self._gains_are_free(end.effects):
                # What the masses are known to, a gain of all drives is known to.
                share = tolerances(self.scene)[MASS].size
                std = {n: float(np.hypot(x, share * p[n])) for n, x in std.items()}
            return std, ()
        if effect.kind != "friction_patch" and not self._train.all():
            asked = ~self.train()
        calm = self.nuisances().columns @ end.b
        limit = PROFILE * max(end.score, 1.0) ** 2

        def squares(parameters) -> np.ndarray:
            others = [*end.effects]
            others[k] = replace(effect, parameters=parameters)
            try:
                return (self.residual(others) - calm) ** 2
            except ValueError:  # The patch is empty.
                return np.full(len(end.r), np.inf)

        least = squares(p)
        moment = self._of_moments()

        def far(name: str, sign: float, rows, but_one: bool = False) -> float:
            for d in moves[name]:
                more = (squares({**p, name: p[name] + sign * d}) - least)[rows]
                lost = float(np.sum(more))
                if but_one and np.isfinite(lost):
                    lost -= float(np.bincount(moment[rows], weights=more).max())
                if lost > limit:
                    return d
            return np.inf

        or_more: tuple[str, ...] = ()
        for name in moves:
            below, above = far(name, -1.0, asked), far(name, 1.0, asked)
            if name == "friction" and above == np.inf > p[name] > self._now_at(effect):
                below = far(name, -1.0, every, but_one=True)
                if p[name] - below >= self._now_at(effect):
                    std[name], or_more = 0.5 * below, (name,)
                    continue
            std[name] = max(std.get(name, 0.0), 0.5 * max(below, above))
        return std, or_more

    # ----- What it comes to

    def loudest(self, fitted: Fitted) -> tuple[str, float]:
        """Of equations, and of blocks of time, fitted or not: what is met once may be
        among the fitted ones alone."""
        found = [("", 0.0)]
        for k, name in enumerate(self.row_names()):
            mine = np.sort(np.abs(fitted.left[self.channel_of_rows() == k]))
            if len(mine) >= FEWEST_ROWS:
                # What is really there is there in the next moment, too: they overlap.
                found.append((name, rms(mine[:-1])))
        size, number = max(self._blocks_left(fitted.left))
        if size > max(each[1] for each in found):
            block = self._block == number
            t, time = self.tracks[int(self.means.episode[block][0])], self.means.time
            found = [(
                f"{self.recordings[t.recording].name} from {time[block].min():.3g} to "
                f"{time[block].max():.3g} s (episode {t.episode.number})", size
            )]  # fmt: skip
        return max(found, key=lambda each: each[1])

    def found_before(self) -> list[Found]:
        """Late poses, which were moved before the search; to half a row's period."""
        std = {"delay": 0.5 * self._row_sec()}
        found = []
        for body, late in self.late.items():
            more = self.rich_nuisances.get(f"clock of {body}", 0.0)
            effect = Effect(DELAY, [body], {"delay": late + more})
            found.append(Found(effect, std, *self.late_errors))
        return found

    def is_within_law(self, effect: Effect) -> bool:
        """Coulomb's law, a mass by it and a drive's gain are no more accurate than
        LAW: what is that near to the scene is no error of it."""
        for at in effect.at:
            if effect.kind == "contact_friction":
                now = self._now_at(effect)
            elif effect.kind == "object_mass" or KINDS[effect.kind].path == "gain":
                (now,) = self.dynamics.now(effect.kind, [at]).values()
            else:
                return False
            (value,) = effect.parameters.values()
            if not abs(value - now) < LAW * now:
                return False
        return True

    def late_poses(self, end: Fitted) -> list[str]:
        """Of bodies whose poses would have to be later, or earlier, than a camera's
        samples allow: by how much, in words."""
        n, said = self.nuisances(), []
        for body in self.bodies:
            name = f"clock of {body}"
            if name not in n.names:
                continue
            k = n.names.index(name)
            late = float(end.b[k])
            if abs(late) > BEYOND * n.prior[k]:
                how = "late" if late > 0.0 else "early"
                said.append(
                    f" The poses of {body} seem to come {1e3 * abs(late):.0f} ms {how} "
                    "beside the joints, or more: if so, declare it (`filters: {delay: "
                    "...}` of these channels, or `sensor_delay`) and run gap again "
                    "before you trust anything else here."
                )
        return said

    def hint(self, end: Fitted) -> str:
        """What a camera's clock would explain; else which shapes that press on each
        other are apart."""
        # All else may follow from a clock.
        return "".join(self.late_poses(end) or self.distances_off(end))

    def distances_off(self, end: Fitted) -> list[str]:
        """Of pairs whose shapes are apart, or in one another, by more than a channel
        may be loud: how much, in words."""
        names, of_rows, said = self.row_names(), self.channel_of_rows(), []
        for pair in self._pairs_met:
            name = self.pair_name(pair)
            left = end.left[of_rows == names.index(f"{name}.distance")]
            if len(left) < FEWEST_ROWS or rms(left) <= self.plan.loud:
                continue
            d = -1e3 * float(np.median(left)) * self.distance_std(pair)
            how = "apart" if d > 0.0 else "inside one another"
            said.append(
                f" Where {name} press on each other, the scene's shapes are "
                f"{abs(d):.2g} mm {how}."
            )
        return said

    def _blocks_left(self, left: np.ndarray) -> list[tuple[float, int]]:
        """Rms of rows (m,) and number of each block that has enough of them. Of a row
        counts AT_MOST: what one reading is off by says nothing of a stretch of time. As
        if each had one moment more, which nothing is off in: of a hundred blocks of one
        moment each some meet their object just as it tips, or a touch sets in."""
        of_rows = self.blocks()
        found = [(left[of_rows == k], int(k)) for k in np.unique(of_rows)]
        found = [(r, k) for r, k in found if len(r) >= FEWEST_ROWS]
        moments = np.bincount(self._block)
        seen = np.sqrt(moments / (moments + 1.0))
        return [
            (rms(np.clip(r, -AT_MOST, AT_MOST)) * float(seen[k]), k) for r, k in found
        ] or [(0.0, 0)]

    def where(self, left: np.ndarray) -> list[Where]:
        r = self._in_table(left)
        m, names = self.means, self.row_names()
        found, p = [], []
        for number, t in enumerate(self.tracks):
            mine = m.episode == number
            stretch = (m.time / 0.5).astype(int)
            for part in np.unique(stretch[mine]):
                rows = np.flatnonzero(mine & (stretch == part))
                for k, name in enumerate(names):
                    some = rows[self._shown[rows, k]]
                    if len(some) < 2:
                        continue
                    score = float(np.sqrt(np.mean(r[some, k] ** 2)))
                    p.append(
                        float(np.exp(-0.5 * len(some) * max(score / 1.3, 0.0) ** 2))
                    )
                    found.append(
                        Where(
                            name, float(m.time[rows[0]]), float(m.time[rows[-1]]),
                            t.episode.number, self.recordings[t.recording].name,
                            "in contact", score,
                        )
                    )  # fmt: skip
        out = benjamini_hochberg(p, 0.01)
        kept = [
            w for w, is_out in zip(found, out, strict=True) if is_out and w.score > 1.3
        ]
        return sorted(kept, key=lambda w: -w.score)[:40]

    def judged(self) -> dict[str, str]:
        """Positions and poses by the equations and in simulation; all that is measured
        twice, and wrenches, in equations."""
        _, led = led_as_measured(self.scene, self.recordings)
        how = {
            f"{j}.position": "equations" if j in led else "equations and simulation"
            for j in self.joints
        }
        for body in self.bodies:
            for a in ("qw", "qx", "qy", "qz", "x", "y", "z"):
                both = varies(self.recordings, name := f"{body}.{a}")
                how[name] = "equations and simulation" if both else "equations"
        for name, _ in self.extra:
            how[name] = "equations"
        for joint, by in self.by.items():
            if by == "measured":
                how[f"{joint}.effort_measured"] = "equations"
        for sensor in self.sensors:
            for name in sensor.names:
                how[name] = "equations"
        return how

    def lying(self) -> list[LiesOn]:
        """What touches with more points than Drake's point contact makes of it."""
        return lying_on_faces(self)

    def pressed(self) -> list[str]:
        """Pairs of which windows expect that friction is not known better than LAW."""
        return []

    def unseen(
        self, recordings: Sequence[Recording], start: Fitted, end: Fitted
    ) -> tuple[tuple[float, float], dict[str, InUnits]] | None:
        """What two fits, with their effects and nuisances, leave of the equations of
        motion in recordings that nothing was decided on: rms over the noise, and of
        each equation in its unit. None where too little moves, or touches, there."""
        try:
            other = type(self)(self.scene, earlier(recordings, self.late), self)
        except DoesNotFit:
            return None
        its = other.nuisances()
        left = []
        for fitted in (start, end):
            by_name = dict(zip(self.nuisances().names, fitted.b, strict=True))
            b = np.array([by_name.get(name, 0.0) for name in its.names])
            try:
                left.append(other.residual(fitted.effects) - its.columns @ b)
            except ValueError:  # There a tool was where a wall would be.
                return None
        before, after = left
        units = other.in_units_of_equations(before, after)
        return (rms(before), rms(after)), units

    def in_units_of_equations(
        self, before: np.ndarray, after: np.ndarray
    ) -> dict[str, InUnits]:
        """{name: errors} of each equation, of what two models leave of rows (m,)."""
        n, noise = len(self.allowance), self.sensor_std()
        newtons = []
        for left in (before, after):
            r = self._in_table(left)
            newtons.append(self.in_newtons(r[:, :n]))
        slides = sliding_joints(self.plant)
        found = {}
        for k, name in enumerate(self.coordinates):
            body, _, axis = name.rpartition(".")
            turns = axis[0] == "r" if body in self.bodies else name not in slides
            rows = self._shown[:, k]
            found[f"{name} equation"] = InUnits(
                "N m" if turns else "N", rms(newtons[0][rows, k]),
                rms(newtons[1][rows, k]), float(noise[k]),
            )  # fmt: skip
        return found

    def outcome(
        self, effects, start: Fitted, end: Fitted, nuisances: Nuisances,
        recordings=None, jobs: int = 1,
    ) -> Outcome | None:  # fmt: skip
        creep = self.slides if self.slides > SLIDES else STICTION
        if recordings is not None:
            try:
                model = PushWindows(
                    self.scene, recordings, None, self.lying(), self.pressed(), creep
                )
            except DoesNotFit:  # No window fits in.
                return None
            held = [True] * len(model.windows)
        else:
            if self._windows is None:
                episodes = {
                    (t.recording, t.episode.number)
                    for k, t in enumerate(self.tracks)
                    if not self._train[self.means.episode == k].all()
                }
                try:
                    self._windows = PushWindows(
                        self.scene, self.recordings, episodes, self.lying(),
                        self.pressed(), creep,
                    )  # fmt: skip
                except DoesNotFit:
                    return None
            model = self._windows
            held = [True] * len(model.windows)
        if effects:
            model = model.with_spread_of(effects)
        before = model.simulate(())
        after = model.simulate(effects) if effects else before

        def why(k: int, with_effects: bool) -> str:
            return why_stopped(model, effects if with_effects else (), k)

        gap = gap_measure(model, before, after, held, why)
        if recordings is not None and (found := self.unseen(recordings, start, end)):
            gap = replace(gap, in_equations=found[0], equations=found[1])
            if not gap.is_measured:
                gap = replace(gap, before=found[0][0], after=found[0][1])
        if not gap.is_measured or not gap.window_s:
            return Outcome(gap)
        return Outcome(
            gap,
            [
                *series_of(model, before, after, held),
                *unseen_series(model, effects, held),
            ],
            unexplained_in_windows(model, after),
            where=where_in_windows(model, model.errors(before)) if recordings else (),
        )


def _size(off: np.ndarray) -> float:
    """Of deviations (m,) what most of them are like; 0 of none. Where forces take up
    most rows, the median of what is left says little."""
    if not len(off):
        return 0.0
    size = ROBUST * np.median(off)
    return max(size, 0.6 * rms(np.minimum(off, 4.0 * size)))


def _felt_by(sensor: WrenchSensor) -> str:
    """The name of a nuisance."""
    return f"inertia felt by {sensor.place}"

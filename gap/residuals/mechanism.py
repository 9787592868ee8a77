"""A mechanism whose joints are measured, as a problem for the search."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from makebreak.gap.data.findings import Finding
from makebreak.gap.data.recording import Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.selection import (
    Screen,
    cost_of_few,
    in_place_of_others,
    is_predicted,
)
from makebreak.gap.problem import (
    Candidate,
    Fitted,
    GapProblem,
    Nuisances,
    Outcome,
    SearchPlan,
    leaves_gap,
    rms,
    share_left,
)
from makebreak.gap.residuals.drive_gains import KEY as GAINS
from makebreak.gap.residuals.drive_gains import (
    gain_columns,
    gain_name,
    with_moved_gains,
)
from makebreak.gap.residuals.inverse import (
    LOOPS,
    VELOCITIES_LATE,
    InverseModel,
    loop_name,
)
from makebreak.gap.residuals.mechanism_candidates import (
    candidates,
    inseparable,
    is_mass_of,
    nuisances,
    of_drives,
    of_no_scene,
    rich_columns,
    tolerances,
)
from makebreak.gap.residuals.mechanism_measure import measure
from makebreak.gap.residuals.pushes import ROBUST, Push, find_pushes
from makebreak.gap.residuals.where import unexplained, where_in_motion
from makebreak.gap.residuals.whitened_rows import REST_EFFORT, REST_SHARE, rms_of
from makebreak.gap.result import GapMeasure, Series, Where
from makebreak.gap.simulation.channel_effects import PATH, SENSED
from makebreak.gap.simulation.windows import Window
from makebreak.gap.thresholds import (
    BESIDE_NOISE_EVIDENCE,
    CLOSED_SHARE_MIN,
    NOISE_RMS_MAX,
    SAME_ERROR,
    SAME_EVIDENCE,
    SIMULATED_RIVAL_GAIN,
    UNEXPLAINED_RMS,
)
from makebreak.models.drives import TooStiff
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.joints import ROTOR, rotor
from makebreak.models.effects.kind import Effect, find_body, sliding_joints
from makebreak.models.effects.objects import MASS
from makebreak.models.scene import Scene
from makebreak.systems.numerics.joint_laws import coulomb_law

# Below this over the sensors' noise a rich model leaves what noise may: models are
# right. A weight is changed where it would become less by this share.
MISFIT, LESS = 1.3, 0.8
LOUD = 1.5  # Rms over noise of one joint's rows that is looked into by itself.
# With which friction may stop joints (DrivenArmScene.stops_sec): of robots, and of
# MuJoCo's solver as it comes, (1 - d) / d of its solimp's d times its damping's time;
# twice the log likelihood that this must gain; and how many test functions of which a
# joint moves nearly all, or rests for so much, tell its friction.
STOPS_SEC, REST_EVIDENCE, FEW, HELD = (1.0556e-3, 0.0), 20.0, 10, 0.7
ABOVE = 3.0  # Times what is found at first: friction is looked for from above.
MOST_WEIGHINGS = 10
AT_REST = 2.0  # Times the least uncertainty: rows with more are of joints at rest.
RICH_PRIOR = 10.0  # Times a nuisance's tolerance, in a rich model.
# What is left of a measured effort is noise where less than this share of it repeats,
# and no block of time has so many times the usual power.
REPEATS, EVENT = 0.1, 10.0
MOST_WANDER = 5.0  # Times a sample's noise: more is no sensor's.
HALF = 0.5  # Of a channel's power: what one effect more must explain to be a law of it.
# A rich model is fitted without what it leaves more than TRIM_Z of beside the usual, at
# most such a share of all, until that stays the same.
TRIMS, TRIMMED, TRIM_Z = 8, 0.3, 4.0
LAST = 1.9  # In rows: how early commands may be.
UNWEIGHTED = 10.0  # Times what a push left, as its rows' noise.
LAGS = 9  # Test functions over which errors may go together (0.9 s).
OVERLAP = 1.3  # What neighbouring test functions share of white noise.
# A base is mounted otherwise than the scene says from this angle [rad] on, where its
# gravity comes out as large as it is, to this share.
TURNED, SAME_GRAVITY = 0.3, 0.1
AT_ONCE = 128  # Candidates of which one product of matrices is formed.
KEPT = 0.1  # Of its mass, that a link keeps at least; of inertia, a joint.


class MechanismProblem(InverseModel, GapProblem):
    """Equations of motion of all joints, and other channels beside them."""

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        super().__init__(scene, recordings)
        self.plan = SearchPlan(
            evaluations=25, most_effects=10, by_channel=True, loud=LOUD
        )
        self._found: list[Candidate] | None = None
        self._nuisances: Nuisances | None = None
        self._other: InverseModel | None = None
        self._weighed: tuple = ()  # Effects in whose model rows have their noise.
        # Stretches in which something else moved it: they have next to no weight.
        self.pushes: list[Push] = []
        self._learn_misfit()

    # ----- What models are off by

    def _learn_misfit(self) -> None:
        """What a model with friction, rotors, gains, biases, loads and delays of all
        joints leaves is what models are off by: no fit is believed beyond that."""
        held = ~self.train()
        if not held.any() or held.all():
            return
        n = self.nuisances()
        plain = Screen(self.base(), n.columns, n.prior, self.train(), reach=n.reach)
        left = plain.fit_nuisances(self.base())[1]
        if self.noise_error(left) < MISFIT:
            return
        self._found = candidates(self, n, left)
        self._learn_friction()
        for _ in range(MOST_WEIGHINGS):
            n = _without_gains(self.nuisances())
            rich, _ = rich_columns(self, self._found)
            prior = RICH_PRIOR * n.prior
            screen = Screen(self.base(), n.columns, prior, self.train())
            fit = screen.fit(rich)
            left = self.base() - rich @ fit.c - n.columns @ fit.b
            unbent = self._unbent(rich, n, prior)[0]
            pushes = self._pushes_in(unbent)
            if len(pushes) > len(self.pushes):
                self._set_pushes(pushes, unbent)
                continue  # What they bent is fitted again.
            error = self._misfit(left)
            # A rich model may do worse than none, where noise is all that is left; and
            # what one more effect of the catalogue explains is nothing models lack.
            others = [self._settled(self.base()), self._with_best(left, rich)]
            for other in map(self._misfit, others):
                error = {w: np.minimum(error[w], other[w]) for w in error}
            old = self.model_error
            if all(np.allclose(error[w], old[w], rtol=0.1, atol=1e-12) for w in error):
                break
            self._set(error)
        self.correlation = self._correlation(left)

    def _learn_friction(self) -> None:
        """How friction stops joints, and how much holds them: beside all that a rich
        model has, the most likely."""
        found = []
        for seconds in STOPS_SEC:
            left, most = self._with_friction(0.0)
            most = ABOVE * most  # Where too little is held, a fit bends to damping.
            for _ in range(MOST_WEIGHINGS):
                if not self._hold_by(seconds, most):
                    break
                left, most = self._with_friction(seconds)
            n = len(self.joints)
            off, own = (x[:, :n] for x in (self.in_units(left), self.noise_in_units()))
            found.append((_surprise(off, own) + REST_EVIDENCE * (seconds > 0.0), most))
        k = min(range(len(found)), key=lambda k: found[k][0])
        most = found[k][1]
        if not STOPS_SEC[k]:  # Hardly any that hardly rested: any may have held it.
            rests = [self.at_rest(t, 0.0, most) > HELD for t in self.tracks]
            few = np.concatenate(rests).sum(axis=0) < FEW
            noise = np.median(self.noise_in_units(held=False)[:, : len(most)], axis=0)
            most = np.where(few & (most < FEW * noise), np.nan, most)
        self._hold_by(STOPS_SEC[k], most)

    def _hold_by(self, stops_sec: float, most: np.ndarray) -> bool:
        """As hold, of what is kept as well; whether it is another."""
        to_new = self.hold(stops_sec, most)
        if to_new is None:
            return False
        self._reexpress(to_new)
        self._found = [
            c if KINDS[c.kind].joint_law is not coulomb_law
            else replace(c, columns=(self.columns_of([
                self.dynamics.signatures(c.kind, list(c.at), m)[0].columns
                for m in self.motions()
            ]),))
            for c in self._found or ()
        ]  # fmt: skip
        if self._dry.any():
            self._renew_gains()
        return True

    def _renew_gains(self) -> None:
        """Columns of drives' gains anew: the scene's own friction, which is part of
        what drives are told, stops joints otherwise."""
        kinds = dict.fromkeys(c.kind for c in self._found or () if KINDS[c.kind].drive)
        anew = {(c.kind, c.at): c for kind in kinds for c in of_drives(self, kind)}
        self._found = [anew.get((c.kind, c.at), c) for c in self._found or ()]
        n = self._nuisances
        if n is not None and n.names and not self._weighed:
            each, _, names = gain_columns(self)
            known = dict(zip(names, each, strict=True))
            old = zip(n.names, n.columns.T, strict=True)
            columns = [known.get(name, x) for name, x in old]
            self._nuisances = replace(n, columns=np.stack(columns, axis=1))

    def _with_friction(self, stops_sec: float) -> tuple[np.ndarray, np.ndarray]:
        """What a rich model leaves (m,), and (n_joints,) what may hold joints [N m] if
        it stops them so: more where they hardly moved."""
        n = _without_gains(self.nuisances())
        rich, whose = rich_columns(self, self._found or ())
        left, c = self._unbent(rich, n, RICH_PRIOR * n.prior)
        most = self._dry + np.maximum(self._coulomb(zip(whose, c, strict=True)), 0.0)
        rest = np.concatenate([self.at_rest(t, stops_sec, most) for t in self.tracks])
        moves, rests = rest < REST_SHARE, rest > HELD
        if not stops_sec:  # No law says what it does there.
            off = self.in_units(left)[:, : len(self.joints)] / np.maximum(rest, HELD)
            each = np.sqrt(np.sum(rests * off**2, 0) / np.maximum(rests.sum(0), FEW))
            most = np.maximum(most, each)
        efforts = rms_of(np.concatenate([m.effort for m in self.motions()]))
        hardly = moves.sum(axis=0) < FEW
        return left, np.where(hardly, np.maximum(most, REST_EFFORT * efforts), most)

    def _coulomb(self, found: Iterable[tuple[Candidate | Effect, float]]) -> np.ndarray:
        """(n_joints,) friction [N m] of those of these that are Coulomb's."""
        out = np.zeros(len(self.joints))
        for each, size in found:
            if KINDS[each.kind].joint_law is coulomb_law:
                out[[self.joints.index(at) for at in each.at]] += size
        return out

    def _settled(self, r: np.ndarray) -> np.ndarray:
        """What the nuisances leave of r (m,), free within their limits."""
        n = self.nuisances()
        return Screen(r, n.columns, n.prior, self.train(), reach=n.reach).fit_nuisances(
            r
        )[1]

    def _with_best(self, left: np.ndarray, rich: np.ndarray) -> np.ndarray:
        """What a rich model and one candidate more leave of rows (m,): of each channel
        with the candidate that fits its training rows best, if that takes half of it.
        rich (m, p)."""
        t, k = self.train(), len(self.names())
        size = np.linalg.norm(rich[t], axis=0)
        rich = rich[:, size > 0.0] / size[size > 0.0]
        back = np.linalg.pinv(rich[t], rcond=1e-8)
        out = np.array(left).reshape(-1, k)
        least = HALF * _powers(left[t], k)
        # A gain is in the rich model, of what the model needs. Beside that a gain of
        # the measured effort would cancel all, also what models are off by.
        found = [c for c in self._found or () if KINDS[c.kind].path != "gain"]
        every = [x for c in found for x in c.columns]
        for some in (every[i : i + AT_ONCE] for i in range(0, len(every), AT_ONCE)):
            X = np.hstack(some)
            beside = X - rich @ (back @ X[t])
            own = np.linalg.norm(beside[t], axis=0) > 1e-6 * np.linalg.norm(
                X[t], axis=0
            )
            ends = np.cumsum([x.shape[1] for x in some])[:-1]
            for x, mine in zip(
                np.split(beside, ends, 1), np.split(own, ends), strict=True
            ):
                if not mine.any():
                    continue
                x = x[:, mine]
                r = left - x @ np.linalg.lstsq(x[t], left[t], rcond=1e-8)[0]
                power = _powers(r[t], k)
                better = power < least
                least[better] = power[better]
                out[:, better] = r.reshape(-1, k)[:, better]
        return out.ravel()

    def _unbent(
        self, rich: np.ndarray, n: Nuisances, prior
    ) -> tuple[np.ndarray, np.ndarray]:
        """What a rich model leaves (m,) that was fitted without the test functions that
        it explains least: least trimmed squares, so that what acts for a short while
        bends nothing; and its parameters (k,)."""
        k, joints = len(self.names()), len(self.joints)
        noise = np.median(self.noise_in_units()[:, :joints], axis=0)
        whole = self.train()
        train, left, c = whole, self.base(), np.zeros(rich.shape[1])
        for _ in range(TRIMS):
            fit = Screen(self.base(), n.columns, prior, train).fit(rich)
            c, left = fit.c, self.base() - rich @ fit.c - n.columns @ fit.b
            units = np.abs(self.in_units(left)[:, :joints])
            z = (units / np.maximum(ROBUST * np.median(units, axis=0), noise)).max(1)
            most = np.quantile(z, 1.0 - TRIMMED)
            kept = np.repeat(z <= max(most, TRIM_Z), k) & whole
            if (kept == train).all():
                break
            train = kept
        return left, c

    def _pushes_in(self, left: np.ndarray) -> list[Push]:
        n = len(self.joints)
        units, noise = self.in_units(left)[:, :n], self.noise_in_units()[:, :n]
        known = [row for push in self.pushes for row in push.rows]
        units[known], noise[known] = 0.0, np.median(noise, axis=0)
        found = find_pushes(self.tracks, self.joints, units, noise, self._needed_rms())
        return [*self.pushes, *found] if found else self.pushes

    def _needed_rms(self) -> np.ndarray:
        """(n_joints,) of the efforts that the scene as it came needs [N m]."""
        efforts = np.concatenate([m.effort for m in self.needed_motions()])
        return np.sqrt(np.mean(efforts**2, axis=0))

    def _is_pushed(self, window: Window) -> bool:
        name = self.recordings[window.recording].name
        end = self.recordings[window.recording].time[window.rows][-1]
        return any(
            (push.recording, push.episode) == (name, window.episode)
            and window.start < push.end and end > push.start
            for push in self.pushes
        )  # fmt: skip

    def _set_pushes(self, pushes: list[Push], left: np.ndarray) -> None:
        """What nothing explains while something else moves it counts as its noise, at
        all joints: where a push sets in, none moves as smoothly as it is taken to."""
        units = self.in_units(left)[:, : len(self.joints)]
        more = np.zeros_like(units)
        for push in pushes[len(self.pushes) :]:
            rows = list(push.rows)
            size = np.sqrt(np.mean(units[rows] ** 2, axis=0))
            more[rows] = UNWEIGHTED * np.maximum(size, self._needed_rms())
        self.pushes = pushes
        self._set(self.model_error, more)

    def push_findings(self) -> list[Finding]:
        sliding = sliding_joints(self.dynamics.plant)
        found = []
        for push in self.pushes:
            each = [
                f"{effort:.3g} {'N' if joint in sliding else 'N m'} at {joint}"
                for joint, effort in push.efforts
            ]
            joint, effort = push.efforts[0]
            unit = "N" if joint in sliding else "N m"
            says = (
                f"From {push.start:.3g} to {push.end:.3g} s something that comes back "
                f"nowhere else moved the robot, as a person's push would (rms: "
                f"{', '.join(each)}); these {push.end - push.start:.2g} s have next to "
                "no weight, and no effect is named for them."
            )
            found.append(
                Finding("push", push.recording, joint, effort, unit, "warning", says)
            )
        return found

    def _misfit(self, left: np.ndarray) -> dict[str, np.ndarray]:
        """What held-out rows (m,) are off by beside noise: robust, of each channel."""
        held = (~self.train()).reshape(-1, len(self.names()))[:, 0]
        held[[row for push in self.pushes for row in push.rows]] = False
        if not held.any():
            return self.model_error
        off, noise = self.in_units(left)[held], self.noise_in_units()[held]
        # A joint at rest may be held by anything: its rows say nothing of models.
        usual = noise <= AT_REST * np.quantile(noise, 0.1, axis=0)
        error = {w: np.zeros(len(self.joints)) for w in self.model_error}
        for k, (what, joint) in enumerate(self.names()):
            mine = usual[:, k]
            beside = beyond_noise(off[mine, k], noise[mine, k])
            error[what][self.joints.index(joint)] = beside
        return error

    def _correlation(self, left: np.ndarray) -> float:
        """Root of how many neighbouring rows err together, where models are off."""
        k = len(self.names())
        off = np.array([self.model_error[w][self.joints.index(j)] for w, j in
                        self.names()]) > 0.0  # fmt: skip
        if not off.any():
            return 1.0
        r = left.reshape(-1, k)[:, off]
        block = self.blocks().reshape(-1, k)[:, 0]
        held = (~self.train()).reshape(-1, k)[:, 0]
        sums, counts = np.zeros(LAGS + 1), np.zeros(LAGS + 1)
        for number in np.unique(block[held]):
            x = r[block == number]
            x = x / np.maximum(np.sqrt(np.mean(r[held] ** 2, axis=0)), 1e-12)
            for lag in range(min(LAGS + 1, len(x))):
                sums[lag] += np.sum(x[lag:] * x[: len(x) - lag])
                counts[lag] += x[lag:].size
        rho = sums / np.maximum(counts, 1) / max(sums[0] / max(counts[0], 1), 1e-12)
        ends = np.flatnonzero(rho <= 0.0)
        last = int(ends[0]) if len(ends) else LAGS + 1
        return float(np.sqrt(max((1.0 + 2.0 * rho[1:last].sum()) / OVERLAP, 1.0)))

    def _set(self, error: dict[str, np.ndarray], more=None) -> None:
        self._reexpress(self.allow(error, more))

    def _reexpress(self, to_new: Callable[[np.ndarray], np.ndarray]) -> None:
        """Columns that are kept, in new units of rows."""
        if self._found is not None:
            self._found = [_moved(c, to_new) for c in self._found]
        if self._nuisances is not None:
            n = self._nuisances
            self._nuisances = replace(n, columns=to_new(n.columns))

    def reweigh(self, fitted: Fitted) -> bool:
        error = self._misfit(fitted.left)
        old = self.model_error
        less = {w: np.minimum(error[w], old[w]) for w in old}
        is_less = any((less[w] < LESS * old[w]).any() for w in old)
        is_another = self._weigh_by(fitted.effects)
        if self.stops_sec:
            named = self._coulomb(
                (e, next(iter(e.parameters.values()))) for e in fitted.effects
            )
            most = np.where(named == 0.0, self._hold, self._dry + named)
            is_another = self._hold_by(self.stops_sec, most) or is_another
        if is_less:
            self._set(less)
        return is_less or is_another

    def _weigh_by(self, effects: Sequence[Effect]) -> bool:
        """Takes noise and nuisances as they are in the scene with these effects: with
        an arm twice as heavy, positions' noise is twice as much effort, and links'
        masses are where their centres are now. Returns: whether that is another."""
        key = tuple(e.key for e in effects if self._reweighs(e))
        if key == self._weighed:
            return False
        try:
            model, gains = self.model_with(effects), self.gains_with(effects)
        except ValueError:  # A joint that is too light for its drive, say.
            return False
        if not self._moves_as_much(model):
            return False
        self._weighed = key
        self._reexpress(self.weigh_by(model, gains))
        before = self.nuisances()
        now = nuisances(self, effects)
        # What hardly shows may show in one of the two models alone.
        shown = dict(zip(now.names, now.columns.T, strict=True))
        columns = np.array(before.columns)
        for k, name in enumerate(before.names):
            columns[:, k] = shown.get(name, columns[:, k])
        self._nuisances = replace(before, columns=columns)
        return True

    def _moves_as_much(self, model: SceneDynamics) -> bool:
        """Whether a model has at least a share of each joint's inertia. One that takes
        nearly all of it away has next to no noise, and all that it leaves is large."""
        q = self.motions()[0].q[0]
        sizes = []
        for plant in (self.dynamics.plant, model.plant):
            context = plant.CreateDefaultContext()
            plant.SetPositions(context, q)
            sizes.append(np.diag(plant.CalcMassMatrix(context)))
        return bool((sizes[1] > KEPT * sizes[0]).all())

    def _reweighs(self, effect: Effect) -> bool:
        entry = KINDS[effect.kind]
        return (
            entry.weighs
            or entry.path in ("gain", "kp")
            or (entry.before_finalize is not None and not entry.hidden_state)
        )

    def commands_are_samples(self) -> bool:
        """Whether commanded efforts fit half a period earlier, or a bit more: a loop
        that is faster than the table gave them, and a row has what it gave at that
        instant. What else makes them seem early (damping that the scene has too much
        of) does not say so at half a period, to the noise or to half of what is
        left."""
        given = [j for j, has in zip(self.joints, self.has["effort_command"],
                                     strict=True) if has]  # fmt: skip
        if not given or any(law is not None for law in self.laws):
            return False
        left = self._left_by_early(given)
        shifts = (0.0, 0.25, 0.5, 0.75, 1.0)
        held, less, half, more, whole = (left(periods) for periods in shifts)
        half = np.minimum(half, more)  # Stamps of two topics differ by a part of a row.
        gained = len(self.base()) * (held**2 - half**2)
        enough = np.maximum(NOISE_RMS_MAX, (1.0 - CLOSED_SHARE_MIN) * held)
        is_half = (half < less) & (half < whole) & (half <= enough)
        is_sure = gained > BESIDE_NOISE_EVIDENCE * self.correlation**2
        return bool((is_half & is_sure).any())

    def commands_early(self) -> float:
        """By how much earlier than their rows, less than two of these, drives have
        their position and velocity commands [s]: what a command does to a position
        comes half a step early from a simulator's steps, and one step more where rows
        were written after the step. 0 where that is not needed beyond doubt by the few
        effects that explain the motion with it."""
        told = zip(self.joints, self.laws, self.commanded, strict=True)
        given = [j for j, law, has in told if law is not None and has]
        if not given:
            return 0.0
        kind, row = self._delay_kind(), self.row_sec()

        def left_by(seconds: float) -> np.ndarray:
            late = Effect(kind, given, {"delay": -seconds})
            return self.residual([late])

        early = (self.base() - left_by(row)) / row
        by_drives, by_bearings = self.late_velocities()
        columns = np.column_stack([early, by_drives, by_bearings])
        beside, others, scale = self._beside_nuisances(columns)
        # The same steps have velocities that drives, and that bearings, act on late, or
        # early if they are implicit in them.
        r, loops = beside(self.base()), [
            beside(drives * by_drives + bearings * by_bearings)
            for drives, bearings in ((0, 0), (1, 1), (1, -1), (-1, -1))
        ]  # fmt: skip
        found = [
            in_place_of_others(np.column_stack([beside(early) + x, others]), r, scale)
            for x in loops
        ]
        k = max(range(len(loops)), key=lambda k: found[k][1])
        (first, *c), gained = found[k]
        if not (gained > SAME_EVIDENCE and 0.0 < first < LAST * row):
            return 0.0
        some = others[:, np.array(c) != 0.0]

        def cost(seconds: float) -> float:
            """Of commands in stairs the column was a chord."""
            off = beside(left_by(seconds)) - seconds * loops[k]
            return rms(off - some @ np.linalg.lstsq(some, off)[0])

        around = (0.5 * first, min(1.5 * first, LAST * row))
        return float(minimize_scalar(cost, bounds=around, method="bounded").x)

    def _less_by_efforts(self, other: Sequence[Recording]) -> np.ndarray:
        """(m,) what it takes off the residual that measured efforts which stand in for
        commands are those of other recordings, of the same rows."""
        by_name, parts = {r.name: r for r in other}, []
        for track in self.tracks:
            its = by_name[track.recording]
            rows = next(e.rows for e in its.episodes if e.number == track.episode
                        and its.time[e.first] == track.time[0])  # fmt: skip
            less = np.zeros((len(track.middle), len(self.joints), 1))
            for i, joint in enumerate(self.joints):
                name = f"{joint}.effort_measured"
                if self.by_measured[i]:
                    y = track.samples[name] - its[name][rows]
                    good = np.isfinite(y)
                    less[:, i, 0] = np.interp(track.middle, track.time[good], y[good])
            parts.append(less)
        return self.columns_of(parts)[:, 0]

    def gained_by_efforts(self, others: Sequence[Sequence[Recording]]) -> np.ndarray:
        """(n,) by how much less the few effects cost that explain the motion with the
        efforts of each of n recordings, of the same rows."""
        each = np.stack([self._less_by_efforts(other) for other in others], axis=1)
        beside, lacks, scale = self._beside_nuisances(each)
        r = beside(self.base())
        before = cost_of_few(lacks, r, scale)
        return np.array(
            [before - cost_of_few(lacks, r - x, scale) for x in beside(each).T]
        )

    def _beside_nuisances(self, more: np.ndarray):
        """What gives of columns (m, k), or one (m,), the fitted part that no nuisance
        can be; those parts of all that joints may lack; and what is left of a row with
        these and `more` (m, k)."""
        n, train = self.nuisances(), self.train()
        if self._found is None:
            self._found = candidates(self, n, self._settled(self.base()))
        lacks = rich_columns(self, self._of_joints())[0]
        rich = np.hstack([more, lacks])
        left = Screen(self.base(), n.columns, n.prior, train, reach=n.reach).fit(rich)
        scale = max(left.train, 1.0) * self.correlation
        # With nuisances' own costs as rows, all is one least-squares problem.
        free = np.vstack([n.columns[train], np.diag(scale / n.prior)])
        Q = np.linalg.qr(free)[0]

        def beside(x: np.ndarray) -> np.ndarray:
            x = np.concatenate([x[train], np.zeros((len(n.prior), *x.shape[1:]))])
            return x - Q @ (Q.T @ x)

        return beside, beside(lacks), scale

    def _of_joints(self) -> list[Candidate]:
        """Of what is found all that is no matter of channels and commands."""
        return [c for c in self._found or () if c.kind not in (*SENSED, *PATH)]

    def _delay_kind(self) -> str:
        return next(k for k, entry in KINDS.items() if entry.path == "delay")

    def row_sec(self) -> float:
        """As written: rows may be means."""
        return min(r.period_sec() for r in self.recordings)

    def _left_by_early(self, given: Sequence[str]) -> Callable[[float], np.ndarray]:
        """What is left, by rms (with what nuisances take) and robust, if commands of
        these joints act so many rows early, whatever joints may lack beside it: that
        hides when they act."""
        kind, n, train = self._delay_kind(), self.nuisances(), self.train()
        more, _ = rich_columns(self, self._of_joints())

        def left(periods: float) -> np.ndarray:
            """As no sample says when an effort jumps; of each channel, as most joints
            may be at rest."""
            late = Effect(kind, list(given), {"delay": -periods * self.row_sec()})
            r = self.residual([late]) if periods else self.base()
            fit = Screen(r, n.columns, n.prior, train, reach=n.reach).fit(more)
            off = self.in_noise(r - more @ fit.c - n.columns @ fit.b)
            each = np.median(np.abs(off).reshape(-1, len(self.names())), axis=0)
            cost = np.concatenate([off, fit.b / n.prior])
            return np.array([rms(cost), ROBUST * rms(each)])

        return left

    # ----- The search

    def nuisances(self) -> Nuisances:
        if self._nuisances is None:
            self._nuisances = nuisances(self)
        return self._nuisances

    def replaced(self, effects: Sequence[Effect]) -> np.ndarray | None:
        """The mass of the heaviest link beside gains of all drives. These multiply all
        that the motors give, as if every mass were another: with both free, all of it
        would shrink together, and with it what noise leaves."""
        if not self._gains_are_free(effects):
            return None
        mine = f"{MASS} of {self._unit()}, "
        return np.array([name.startswith(mine) for name in self.nuisances().names])

    def _unit(self) -> str:
        """The heaviest link, in whose mass the others' are where gains are free."""
        links = self.dynamics.links()
        return max(links, key=lambda at: links[at])

    def _gains_are_free(self, effects: Sequence[Effect] | Sequence[Candidate]) -> bool:
        driven = {
            joint
            for joint, told, given in zip(
                self.joints, self.commanded, self.by_measured, strict=True
            )
            if told or given
        }
        gains = {at for e in effects if KINDS[e.kind].path == "gain" for at in e.at}
        return bool(driven) and driven <= gains

    def widened(self, end: Fitted, k: int) -> tuple[dict[str, float], tuple[str, ...]]:
        # What the masses are known to, a gain of all drives is known to.
        std, or_more = super().widened(end, k)
        effect = end.effects[k]
        if KINDS[effect.kind].path == "gain" and self._gains_are_free(end.effects):
            share = tolerances(self.scene)[MASS].size
            std = {
                name: float(np.hypot(x, share * effect.parameters[name]))
                for name, x in std.items()
            }
        if share := self._gain_unknown(end, effect.at):
            # In units of what the drive is told.
            forces = [p.name for p in KINDS[effect.kind].parameters
                      if p.unit.startswith("N") or p.unit == "kg m2"]  # fmt: skip
            for name in std.keys() & forces:
                std[name] = float(np.hypot(std[name], share * effect.parameters[name]))
        return std, or_more

    def _gain_unknown(self, end: Fitted, joints: Sequence[str]) -> float:
        """The share by which the gain of any of these joints' drives may be off."""
        n = self.nuisances()
        mine = [k for k, name in enumerate(n.names)
                if any(name == gain_name(joint) for joint in joints)]  # fmt: skip
        if not mine:
            return 0.0
        deviation = np.sqrt(np.diag(self._covariance_of(n)))
        return float(np.hypot(end.b[mine], deviation[mine]).max())

    def candidates(self, nuisances: Nuisances, current: Fitted) -> list[Candidate]:
        if self._found is None:
            self._found = candidates(self, nuisances, current.left)
        if self._gains_are_free(current.effects):
            unit = self._unit()
            return [c for c in self._found if not is_mass_of(c, unit)]
        if any(is_mass_of(c, self._unit()) for c in current.effects):
            return [c for c in self._found if not self._gains_are_free(c.members)]
        return self._found

    def error(self, fitted: Fitted) -> float:
        # Which blocks are held out is by the clock: some hold next to nothing of it.
        rows = self.in_noise(fitted.left)
        slow = self.slow_noise(fitted.r)
        for k in np.flatnonzero(slow > 0.0):
            mine = self.channel_of_rows() == k
            rows[mine] /= max(rms(rows[mine]), 1.0)
        held = rows[~self.train()] if not self.train().all() else rows
        return float(np.sqrt(max(np.mean(held**2), np.mean(rows**2))))

    def loudest(self, fitted: Fitted) -> tuple[str, float]:
        """By the rows that were fitted and by those that were not, whichever is less:
        one of many joints hardly shows in what all leave together."""
        rows = self.in_noise(fitted.left)
        slow, held = self.slow_noise(fitted.r), ~self.train()
        found = ("", 0.0)
        for k, (what, joint) in enumerate(self.names()):
            mine = self.channel_of_rows() == k
            if slow[k] > 0.0 or not (mine & held).any():
                continue
            size = min(rms(rows[mine & some]) for some in (held, ~held))
            found = max(found, (f"{joint}.{what}", size), key=lambda each: each[1])
        return found

    def closed(self, start: Fitted, end: Fitted) -> float:
        # All joints together would say little where one of them has a measured effort
        # that nothing explains: what is closed of another does not show beside that.
        held = ~self.train()
        each = [super().closed(start, end)]
        for k, (what, _) in enumerate(self.names()):
            mine = held & (self.channel_of_rows() == k)
            if what == "effort" and mine.any():
                before, after = (
                    rms(self.in_noise(fitted.left)[mine]) for fitted in (start, end)
                )
                if before > UNEXPLAINED_RMS:
                    each.append(1.0 - share_left(before, after))
        return max(each)

    def slow_noise(self, r: np.ndarray) -> np.ndarray:
        """(n_names,) what rows (m,), before the nuisances, leave of an effort that is
        measured, in its unit [N m], where that is no gap but noise that goes together
        over a while: nothing of it is told by where the joint is, how it moves and what
        it needs, and it is there all the time. 0 for all other channels."""
        names = self.names()
        found = np.zeros(len(names))
        left = self._settled(r)
        rows = self.in_noise(left).reshape(-1, len(names))
        off, noise = self.in_units(left), self.noise_in_units()
        block = self.blocks().reshape(-1, len(names))[:, 0]
        state = None
        for k, (what, joint) in enumerate(names):
            i = self.joints.index(joint)
            loud = rms(rows[:, k]) > MISFIT
            if what != "effort" or not self.by_measured[i] or not loud:
                continue
            mine = noise[:, k] <= AT_REST * np.quantile(noise[:, k], 0.1)
            y = off[mine, k]
            if rms(y) > MOST_WANDER * self._sample_noise(f"{joint}.effort_measured"):
                continue
            power = [np.mean(y[block[mine] == b] ** 2) for b in np.unique(block[mine])]
            if max(power) > EVENT * np.median(power):
                continue  # Something happened, once.
            state = self._mean_motion() if state is None else state
            X = features_of(i, *state)[mine]
            if not is_predicted(y, X, block[mine], REPEATS):
                found[k] = rms(y)
        return found

    def _expected_noise(self, start: Fitted, end: Fitted) -> dict[str, float]:
        """{joint: slow noise of its effort [N m]} that simulated windows expect. None
        where the equations leave a gap beside it: joints move each other, so what is
        missing at one shows at others, and windows that have it for noise would agree
        with any model."""
        if leaves_gap(self.error(start), self.error(end)):
            return {}
        found = self.slow_noise(end.r)
        return {j: float(found[k]) for k, (_, j) in enumerate(self.names()) if found[k]}

    def _says_expected(self, found: dict[str, float]) -> str:
        """The slow noise {joint: [N m]} that windows expect, as a sentence."""
        if not found:
            return ""
        times = {
            joint: size / self._sample_noise(f"{joint}.effort_measured")
            for joint, size in found.items()
        }
        joint = max(times, key=lambda each: times[each])
        unit = "N" if joint in sliding_joints(self.dynamics.plant) else "N m"
        size = f"{found[joint]:.2g} {unit}"
        ratio = f"{times[joint]:.2g} times a sample's noise"
        what = f"the measured effort of {joint}, {size} ({ratio}),"
        if len(found) > 1:
            what = (
                f"the measured efforts of {len(found)} joints, up to {ratio} ({size} "
                f"at {joint}),"
            )
        return (
            f" What is left of {what} is correlated in time and nothing in the motion "
            "predicts it: it is taken for noise of the sensors. A force that is not in "
            "the catalogue would look the same."
        )

    def _sample_noise(self, channel: str) -> float:
        """Of one sample, before means over many were taken."""
        every = [r.channels[channel] for r in self.recordings]
        return max(c.noise * np.sqrt(c.averaged) for c in every)

    def _mean_motion(self) -> list[np.ndarray]:
        """q, v, vd, effort needed and sign of v, each (n_bumps, n_v), over bumps."""
        parts = []
        for track, motion in zip(self.tracks, self.needed_motions(), strict=True):
            signals = (motion.q, motion.v, motion.vd, motion.effort, np.sign(motion.v))
            parts.append([track.bumps.mean(x) for x in signals])
        return [np.concatenate(x) for x in zip(*parts, strict=True)]

    def judged(self) -> dict[str, str]:
        how = {}
        for i, joint in enumerate(self.joints):
            by = "equations and simulation"
            if self.untold[i]:  # It is given in simulation.
                by = "not"
            how[f"{joint}.position"] = by
            if self.has["velocity"][i]:
                how[f"{joint}.velocity"] = by
            if self.has["effort_measured"][i]:
                how[f"{joint}.effort_measured"] = "equations"
        return how

    def nuisance_effects(self, nuisances: Nuisances, b: np.ndarray) -> list[Effect]:
        return moved_links(self, nuisances, b)

    def parts(self) -> np.ndarray:
        k = len(self.names())
        names = [r.name for r in self.recordings]
        return np.concatenate(
            [np.full(len(t.bumps.centre) * k, names.index(t.recording))
             for t in self.tracks]
        )  # fmt: skip

    def is_within_tolerance(self, effect: Effect) -> bool:
        # All that a joint carries may be heavier by the masses' tolerance.
        if KINDS[effect.kind].path != "gain":
            return False
        share = tolerances(self.scene)[MASS].size
        return abs(effect.parameters["gain"] - 1.0) < share

    def inseparable(self, effect: Effect) -> Effect | None:
        return inseparable(effect, self)

    def clock_of(self, effect: Effect) -> str:
        # A measured effort that stands in for a command has the commands' clock.
        is_late = KINDS[effect.kind].channel in ("delay", "skew")
        whole = all("." not in at for at in effect.at)
        if is_late and whole and all(self.by_measured):
            return "its measured efforts"
        return ""

    def is_one_place(self, one: Sequence[str], other: Sequence[str]) -> bool:
        plant = self.dynamics.plant
        try:
            a, b = (
                find_body(Effect("", list(at), {}), plant, at[0]) for at in (one, other)
            )
        except ValueError:
            return False
        return b.index() in {body.index() for body in plant.GetBodiesWeldedTo(a)}

    # ----- What it comes to

    def hint(self, end: Fitted) -> str:
        return self._other_gravity()[0]

    def other_gravity(self, end: Fitted) -> tuple[str, bool]:
        says, error = self._other_gravity()
        named = rms(self.in_noise(end.left)[~self.train()])
        if not says or error > (1.0 + SAME_ERROR) * max(named, 1.0):
            return "", False
        return says, error < SIMULATED_RIVAL_GAIN * named

    def _other_gravity(self) -> tuple[str, float]:
        """Another direction of gravity, in words, if that explains most of the gap, and
        the error that it leaves: a robot on a wall or a ceiling, of which the scene
        says that it stands."""
        weight = [
            self.dynamics.mass_times_com_jacobian(m.q).transpose(0, 2, 1)
            for m in self.motions()
        ]
        X, n = self.columns_of(weight), self.nuisances()
        if not np.abs(X).max(initial=0.0) > 0.0:
            return "", np.inf
        screen = Screen(self.base(), n.columns, n.prior, self.train(), reach=n.reach)
        less = screen.fit(X).c
        held = ~self.train()
        before = rms(self.in_noise(screen.fit_nuisances(self.base())[1])[held])
        left = screen.fit_nuisances(self.base() - X @ less)[1]
        after = rms(self.in_noise(left)[held])
        old = self.dynamics.gravity
        new = old - less
        size = [float(np.linalg.norm(g)) for g in (old, new)]
        if not min(size) > 0.0 or not after < (1.0 - CLOSED_SHARE_MIN) * before:
            return "", np.inf
        angle = float(np.arccos(np.clip(old @ new / (size[0] * size[1]), -1.0, 1.0)))
        if angle < TURNED or abs(size[1] / size[0] - 1.0) > SAME_GRAVITY:
            return "", np.inf
        along = ", ".join(f"{x:.1f}" for x in new)
        says = (
            f" Gravity of ({along}) m/s2 instead of the scene's would take the error "
            f"of the equations from {before:.3g} to {after:.3g}: is the base mounted "
            "as the scene says?"
        )
        return says, after

    def where(self, left: np.ndarray) -> list[Where]:
        return where_in_motion(self, self.in_noise(left))

    def outcome(
        self, effects, start: Fitted, end: Fitted, nuisances: Nuisances,
        recordings=None, jobs: int = 1,
    ) -> Outcome | None:  # fmt: skip
        scene = with_moved_gains(self.scene, nuisances.names, end.b)
        if recordings is not None:
            try:
                model = self._model_of(recordings)
            except DoesNotFit:  # No episode is long enough.
                return None
        elif self.train().all():
            return None
        else:
            model = self
        size = dict(zip(nuisances.names, end.b, strict=True))
        timing = self._moved_timing(size)
        moved = [*moved_links(self, nuisances, end.b), *timing.values()]
        columns, _, names = of_no_scene(model)
        known = np.zeros(len(model.train()))
        for name, column in zip(names, columns, strict=True):
            if name not in timing:
                known += size.get(name, 0.0) * column
        slow = self._expected_noise(start, end)
        expects = self._says_expected(slow)

        def measured_with(
            noise: dict[str, float],
        ) -> tuple[GapMeasure, list[Series], list[Where]] | None:
            rest = (
                effects, moved, model, model is not self, jobs,
                self._is_pushed if model is self else lambda window: False, noise,
                known,
            )  # fmt: skip
            try:
                return measure(scene, *rest)
            except TooStiff:  # As its nuisances would make it.
                return measure(self.scene, *rest)

        measured = measured_with(slow)
        if measured is None:  # In every window something pushes.
            return None
        agree = not leaves_gap(self.error(start), self.error(end))
        if agree and not effects and measured[0].before > UNEXPLAINED_RMS:
            # Where equations are sure of nothing, links are not known better than
            # that, and windows of encoders that are good show it.
            unknown = self._effort_of_nuisances(nuisances)
            more = measured_with(
                {j: float(np.hypot(x, slow.get(j, 0.0))) for j, x in unknown.items()}
            )
            if more is not None and more[0].before <= UNEXPLAINED_RMS:
                expects += (
                    " Simulated windows differ by "
                    f"{measured[0].before:.2g} times the noise of the sensors, but by "
                    "no more than masses and centres of mass of the links, known to "
                    "within their tolerance, leave unknown."
                )
                measured = more
        rest = unexplained(self, self.in_noise(end.left))
        gap, series, where = measured
        return Outcome(gap, series, rest, expects, where)

    def _moved_timing(self, size: dict[str, float]) -> dict[str, Effect]:
        """{nuisance: an effect that does the same to windows}, of a simulator's steps:
        velocities that are late, and rotors where what goes with them is.

        Args: size: {nuisance: as it was found [s]}.
        """
        found: dict[str, Effect] = {}
        if LOOPS not in self.scene.tolerance:
            return found
        delay = next(k for k, entry in KINDS.items() if entry.channel == "delay")
        late = size.get(VELOCITIES_LATE, 0.0)
        has = zip(self.joints, self.has["velocity"], strict=True)
        at = [f"{joint}.velocity" for joint, there in has if there]
        if late > 0.0:
            found[VELOCITIES_LATE] = Effect(delay, at, {"delay": late})
        for i, joint in enumerate(self.joints):
            name = loop_name(joint, "velocity")
            more = (self._loop(i)[1] + self._damping[i]) * size.get(name, 0.0)
            if more and more > self.least(ROTOR, [joint]).get("inertia", -np.inf):
                found[name] = rotor(joint, more)
        return found

    def _model_of(self, recordings: Sequence[Recording]) -> InverseModel:
        """That of other recordings, which is asked for again and again."""
        if self._other is None or self._other.recordings != list(recordings):
            self._other = InverseModel(self.scene, recordings)
            self._other.hold(self.stops_sec, self._hold)
        return self._other

    def _effort_of_nuisances(self, nuisances: Nuisances) -> dict[str, float]:
        """{joint: standard deviation of its effort [N m]} that is not known of the
        nuisances, after what the fitted rows say of them."""
        root = np.linalg.cholesky(self._covariance_of(nuisances))
        each = [self.in_units(column) for column in (nuisances.columns @ root).T]
        std = np.sqrt(np.sum(np.square(each), axis=0))
        return {
            joint: rms(std[:, k])
            for k, (what, joint) in enumerate(self.names())
            if what == "effort"
        }

    def _covariance_of(self, nuisances: Nuisances) -> np.ndarray:
        """(n_b, n_b) of the nuisances, after what the fitted rows say of them."""
        N = nuisances.columns[self.train()]
        return np.linalg.inv(N.T @ N + np.diag(1.0 / nuisances.prior**2))


def beyond_noise(off: np.ndarray, noise: np.ndarray) -> float:
    """What rows (m,) are off by beside their noise (m,), robust; 0 where noise may
    leave as much."""
    size, times = (ROBUST * np.median(np.abs(x)) for x in (off, off / noise))
    return float(size * np.sqrt(1.0 - 1.0 / times**2)) if times > MISFIT else 0.0


def _powers(rows: np.ndarray, k: int) -> np.ndarray:
    """(k,) of rows (m,) of k channels in turns, the sum of squares of each."""
    return np.sum(rows.reshape(-1, k) ** 2, axis=0)


def _without_gains(n: Nuisances) -> Nuisances:
    """Nuisances but for gains of drives. Beside all that a joint may have they would be
    of no use: no drive would leave nothing, nor does what the model needs, rescaled."""
    kept = [k for k, name in enumerate(n.names) if not name.startswith(GAINS)]
    return replace(n, columns=n.columns[:, kept], prior=n.prior[kept],
                   names=tuple(n.names[k] for k in kept))  # fmt: skip


def _surprise(off: np.ndarray, noise: np.ndarray) -> float:
    """Minus twice the logarithm of the likelihood of rows (m, n), but for a constant,
    with what models are off by beside noise; of Cauchy's distribution, as some rows are
    off by anything."""
    more = [beyond_noise(x, std) for x, std in zip(off.T, noise.T, strict=True)]
    variance = noise**2 + np.square(more)
    return float(np.sum(np.log(variance) + 2.0 * np.log1p(off**2 / variance)))


def features_of(i: int, q, v, vd, effort, sign) -> np.ndarray:
    """(m, k) of what an effect on joint i could go with: its place, speed and effort,
    and how all joints move; all arguments (m, n_v)."""
    own = [
        sign[:, i], np.abs(v[:, i]), v[:, i] * np.abs(v[:, i]), effort[:, i],
        sign[:, i] * np.abs(effort[:, i]), sign[:, i] * np.exp(-np.abs(v[:, i]) / 0.1),
        q[:, i] ** 2, *(f(n * q[:, i]) for n in (1, 2) for f in (np.sin, np.cos)),
    ]  # fmt: skip
    return np.column_stack([*own, q, v, vd])


def _moved(candidate: Candidate, to_new) -> Candidate:
    return replace(
        candidate,
        columns=tuple(to_new(x) for x in candidate.columns),
        members=tuple(_moved(m, to_new) for m in candidate.members),
    )


def link_changes(dynamics: SceneDynamics, scene: Scene):
    """(name, effect, size) of each nuisance of the links: the mass, or a coordinate of
    the centre of mass, moved by `size`, which is its tolerance."""
    for kind, tolerance in tolerances(scene).items():
        for at in dynamics.links():
            now = dynamics.now(kind, [at])
            for name, value in now.items():
                size = tolerance.of(value)
                effect = Effect(kind, [at], {**now, name: value + size})
                yield f"{kind} of {at}, {name}", effect, size


def moved_links(model: Any, nuisances: Nuisances, values) -> list[Effect]:
    """The links as the nuisances (n_b,) have them, as effects of a scene."""
    known = tolerances(model.scene)
    moved: dict[tuple[str, str], dict[str, float]] = {}
    for name, b in zip(nuisances.names, values, strict=True):
        kind, rest = name.split(" of ", 1)
        if kind in known:  # Others are no part of the scene.
            at, unknown = rest.rsplit(", ", 1)
            parameter = unknown.removesuffix("_change")
            moved.setdefault((kind, at), {})[parameter] = float(b)
    out = []
    for (kind, at), changes in moved.items():
        now = model.dynamics.now(kind, [at])
        there = {name: value + changes.get(name, 0.0) for name, value in now.items()}
        if known[kind].relative:  # No link is left without a mass.
            there = {name: max(x, KEPT * now[name]) for name, x in there.items()}
        out.append(Effect(kind, [at], there))
    return out

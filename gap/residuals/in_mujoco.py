"""A scene of one MJCF file, by windows that MuJoCo simulates with that file's contact.

What is soft there creeps, lands and slides otherwise than in Drake, and what has long
steps moves otherwise: by more than the noise of a log that MuJoCo made. Rows are of
samples over the covariance that they have in a window: noise, what an uncertain start
does, which goes together throughout, and what contacts that chatter do by chance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np
from pydrake.multibody.tree import BodyIndex

from makebreak.gap.data.findings import Finding
from makebreak.gap.data.recording import Recording
from makebreak.gap.problem import Candidate, Fitted, Nuisances, SearchPlan, rms
from makebreak.gap.residuals.impacts import (
    bases_of,
    candidates_of,
    kinds_of_joints,
    tried,
)
from makebreak.gap.residuals.mechanism_candidates import loads
from makebreak.gap.residuals.objects import MOST_EFFECTS, WindowedProblem
from makebreak.gap.simulation.mujoco_simulation import MujocoSimulation
from makebreak.gap.simulation.windows import (
    BESIDE,
    LARGEST,
    Window,
    WindowModel,
    by_measured,
    moved,
    seen_in,
)
from makebreak.gap.thresholds import AGREEMENT_RMS_MAX, UNEXPLAINED_RMS
from makebreak.models.effects import KINDS
from makebreak.models.effects.ground import PLACE
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints
from makebreak.models.scene import Scene

WINDOW_SEC, MOST = 0.6, 60
MOST_MOVES = 16  # Of starts, to know what their uncertainty does.
# Variance between two runs whose contacts chatter by chance, over that of what is bent.
CHANCE = 1.33
# Of a row, by which commands may act before it; and the error with that, to be so.
LATE, LESS = (-1.25, -1.0, -0.75, -0.5, -0.25, 0.0), 0.97
# In which a calm start is looked for, if so much of a window is left.
CALM_SEC, LEAST = 0.3, 0.65
# Of windows: of more the model is wrong, not their starts. Starts that are tried of a
# window, about the best so far, and how wide.
MOST_LOUD, DRAWS, WIDTHS = 0.5, 12, (1.0, 0.5, 0.25)
DRAWN = 6  # Of errors of measured efforts.
PART_SEC = 0.1  # Of a window, where parts are held out.
# Relative: where contacts chatter slopes over smaller steps say what chance does.
DIFF_STEP = 0.1
# Of how far a parameter is from the scene: where the sum of squares is asked; and how
# many times as far where that is too near to tell.
ASIDE, FARTHER = (-0.4, -0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.4), (1.0, 2.5)
UNEVEN = 0.5  # What is held out must have so much of the error.
BLUR = 5e-4  # Of how far a channel goes: where steps fall between rows is not known.


class MujocoProblem(WindowModel, WindowedProblem):
    """Anything that MuJoCo can simulate, as a problem for the search.

    Raises: DoesNotFit as MujocoSimulation.
    """

    plan = SearchPlan(
        evaluations=8, diff_step=DIFF_STEP, least_gain=0.05, most_effects=MOST_EFFECTS,
        jumps=True, alike=True, loud=UNEXPLAINED_RMS, counts_evidence=True,
    )  # fmt: skip

    simulation: MujocoSimulation

    def __init__(
        self,
        scene: Scene,
        recordings: Sequence[Recording],
        commands_late: float | None = None,
    ):
        """Args: commands_late: by how much later than their rows commands act [s];
        None: it is asked of these recordings, within a row.
        """
        super().__init__(
            scene, recordings, WINDOW_SEC, WINDOW_SEC - CALM_SEC, most=MOST,
            simulation=MujocoSimulation(scene),
        )  # fmt: skip
        self.dynamics.friction_of = lambda pair: self._pairs_met.get(pair)
        self.windows = [self._as_smoothed(w) for w in self.windows]
        self._weighed_by: tuple = ()
        self._in_parts = False
        if commands_late is not None:
            self.set_commands_late(commands_late)
        self._weigh(())
        if commands_late is None:
            self._set_late(())
        self._start_again()
        self._share_out()

    def _best_start(self, time, states, row: int) -> int:
        """The calmest row soon after: amid a push that sets in a smoothed state is a
        mean of those before and after."""
        rows = np.flatnonzero((time >= time[row]) & (time < time[row] + CALM_SEC))
        rows = rows[time[-1] - time[rows] > LEAST * self.window_sec]
        pace = np.zeros(len(rows))
        for x in states.values():
            pace += x[rows, 2] ** 2 / max(float(np.mean(x[:, 2] ** 2)), 1e-12)
        return int(rows[np.argmin(pace)]) if len(rows) else row

    def _as_smoothed(self, w: Window) -> Window:
        """The window, less sure of its start where the smoothed motion is farther from
        what was measured there than noise is: something touches or parts."""
        recording = self.recordings[w.recording]
        episode = recording.episode_at(w.rows.start)
        path = self._paths[w.recording, episode.first]
        k = w.rows.start - episode.first
        near = slice(max(k - BESIDE, 0), k + BESIDE + 1)
        wide = {}
        for name, P in w.spread.items():
            at, what = name.rsplit(".", 1)
            off = [1.0]
            rate = f"{at}.velocity" if what == "position" else f"{at}.v{what}"
            for order, channel in enumerate((name, rate)):
                if channel in recording.channels:
                    y = recording[channel][episode.rows][near] - path[name][near, order]
                    y = y[np.isfinite(y)] / recording.channels[channel].noise
                    off.append(float(np.mean(y**2)) if len(y) else 1.0)
            wide[name] = max(off) * P
        return replace(w, spread=wide)

    def _set_late(self, effects: Sequence[Effect]) -> None:
        """A loop that writes its row after a step writes what acted since the step, and
        changes what acts between two rows."""
        if not self.has_commands():
            return
        row, now = self.row_sec(), self.commands_late
        left = {}
        for share in LATE:
            self.set_commands_late(share * row)
            left[share * row] = rms(self.residual(effects))
        best = min(left, key=lambda late: left[late])
        best = best if left[best] < LESS * left[0.0] else 0.0
        self.set_commands_late(best)
        if best != now:
            self._weigh(effects)

    def _start_again(self) -> None:
        """Windows that are off where most are not, from the best of starts that are as
        likely: within what a start is uncertain by a foot catches or does not, and no
        covariance says so."""
        loud = self._by_windows(self.base()) > UNEXPLAINED_RMS**2
        if not loud.any() or loud.mean() > MOST_LOUD:
            return
        kept, rng = self.windows, np.random.default_rng(0)
        for k in np.flatnonzero(loud):
            best, least = kept[k], np.inf
            for width in WIDTHS:
                about = best
                for by in width * rng.normal(size=(DRAWS, 2 * len(best.state))):
                    self.windows = [moved(about, by)]
                    (y,) = self.simulate(())
                    (off,) = self.errors_over([y], [self.noise])
                    if (square := float(np.mean(off**2))) < least:
                        best, least = self.windows[0], square
            kept[k] = best
        self.windows = kept
        self._weigh(())

    def _share_out(self) -> None:
        """Every third window is held out, of those that differ as much: most of a log
        may be rest. Where one window has it all, every third part of each is."""
        off = self._by_windows(self.base())
        train = np.ones(len(off), bool)
        train[np.argsort(off)[::-1][1::3]] = False
        self.windows = [
            replace(w, train=bool(t)) for w, t in zip(self.windows, train, strict=True)
        ]
        held = off[~train].mean() if len(off) > 1 else 0.0
        self._in_parts = bool(held < UNEVEN * off[train].mean())

    def _by_windows(self, left: np.ndarray) -> np.ndarray:
        """Mean square of the rows (m,) of each window."""
        number = self.blocks()
        return np.bincount(number, left**2) / np.maximum(np.bincount(number), 1)

    def train(self) -> np.ndarray:
        """(m,) which rows are fitted."""
        if not self._in_parts:
            return super().train()
        part = [
            np.repeat(
                (self.recordings[w.recording].time[w.rows] - w.start) // PART_SEC,
                len(self.channels),
            )
            for w in self.windows
        ]
        return (np.concatenate(part) % 3 != 1)[self.measured()]

    def loudest(self, fitted: Fitted) -> tuple[str, float]:
        """The window of which most is left."""
        off = self._by_windows(fitted.left)
        k = int(np.argmax(off))
        w = self.windows[k]
        name = self.recordings[w.recording].name
        end = w.start + self.window_sec
        return f"{name} from {w.start:.3g} to {end:.3g} s", float(np.sqrt(off[k]))

    @property
    def met(self) -> Mapping[tuple[str, str], float]:
        """Of everything that is fixed, but for robots' bases, it is asked along each
        axis."""
        plant, places = self.dynamics.plant, self.dynamics.places(PLACE)
        bases = {
            full_name(plant, plant.get_body(BodyIndex(k))) for k in bases_of(plant)
        }
        return {(at, axis): 0.0 for at in places if at not in bases for axis in "xyz"}

    def _model(self) -> WindowModel:
        return self

    def _again(self, recordings: Sequence[Recording]) -> WindowModel:
        return type(self)(self.scene, recordings, self.commands_late)

    def _weigh(self, effects: Sequence[Effect]) -> None:
        """Rows by the covariance that a window's samples have with these effects:
        noise, and what one deviation of each part of an uncertain start does, which
        goes together throughout the window."""
        kept, self._base = self.windows, None
        plain = self.simulate(effects)
        apart, bent = [], [np.zeros_like(y) for y in plain]
        axes = 2 * len(kept[0].state)
        moves = np.eye(axes)
        if axes > MOST_MOVES:  # So many at random have the same covariance.
            rng = np.random.default_rng(0)
            moves = rng.normal(size=(MOST_MOVES, axes)) / np.sqrt(MOST_MOVES)
        try:
            for by in moves:
                pair = []
                for sign in (1.0, -1.0):
                    self.windows = [moved(w, sign * by) for w in kept]
                    pair.append(self.simulate(effects))
                # What is straight in it, and what is bent.
                apart.append([0.5 * (a - b) for a, b in zip(*pair, strict=True)])
                apart.append(
                    [0.5 * (a + b) - y for a, b, y in zip(*pair, plain, strict=True)]
                )
                for total, y in zip(bent, apart[-1], strict=True):
                    total += np.nan_to_num(y**2)
        finally:
            self.windows = kept
        far = np.max([np.nan_to_num(np.ptp(y, axis=0)) for y in plain], axis=0)
        driven = self._by_errors_of_efforts(effects, plain)
        own = np.sqrt(self.noise**2 + (BLUR * far) ** 2)
        self._own, self._start = [], []
        for k, w in enumerate(kept):
            mine = np.sqrt(own**2 + CHANCE * bent[k] / len(moves) + driven[k])
            self._own.append(mine)
            by = np.stack([y[k] / mine for y in apart], axis=-1)
            by = np.nan_to_num(by, posinf=0.0, neginf=0.0)
            by[~np.isfinite(seen_in(self, w))] = 0.0
            A, size, _ = np.linalg.svd(by.reshape(-1, len(apart)), full_matrices=False)
            self._start.append((A, 1.0 - 1.0 / np.sqrt(1.0 + size**2)))
            wide = mine * np.sqrt(1.0 + np.sum(by**2, axis=-1))
            self.windows[k] = replace(w, std=wide)

    def _by_errors_of_efforts(self, effects, plain) -> list[np.ndarray]:
        """Variance that noise of measured efforts makes of the samples of each window,
        where these stand in for commands."""
        made = [np.zeros_like(y) for y in plain]
        if any(by_measured(self.scene, r) for r in self.recordings):
            self._draw = np.random.default_rng(0)
            for _ in range(DRAWN):
                for total, a, b in zip(
                    made, self.simulate(effects), plain, strict=True
                ):
                    total += np.nan_to_num(a - b, posinf=0.0, neginf=0.0) ** 2 / DRAWN
            self._draw = None
        return made

    def does_with(self, effects: Sequence[Effect]) -> bool:
        """Whether MuJoCo does what was measured with these; not where it cannot have
        them."""
        try:
            self._weigh(effects)
            if rms(self.residual(effects)) <= AGREEMENT_RMS_MAX:
                return True
        except ValueError:
            pass
        self._weigh(())
        return False

    def residual(self, effects: Sequence[Effect] = ()) -> np.ndarray:
        """(m,) over the covariance of each window."""
        simulated = self.simulate(effects)
        each = []
        for e, (A, less) in zip(
            self.errors_over(simulated, self._own), self._start, strict=True
        ):
            e = np.clip(e, -LARGEST, LARGEST).ravel()
            each.append(e - A @ (less * (A.T @ e)))
        return np.concatenate(each)[self.measured()]

    def reweigh(self, fitted: Fitted) -> bool:
        """Once for each set of kinds that is fitted; and asks when commands act."""
        key = tuple(e.kind for e in fitted.effects)
        if self._weighed_by == key:
            return False
        self._weighed_by = key
        self._weigh(fitted.effects)
        self._set_late(fitted.effects)
        return True

    def widened(self, end: Fitted, k: int) -> tuple[dict[str, float], tuple[str, ...]]:
        """By a parabola through the sum of squares about the best values, which is
        rough where contacts chatter by chance: how far its bottom may be moved by
        twice what it is rough by."""
        effect, std = end.effects[k], dict(end.std[k])
        now = self.dynamics.now(effect.kind, effect.at)
        calm = self.nuisances().columns @ end.b
        for name, value in effect.parameters.items():
            reach = abs(value - now.get(name, 0.0))
            if name not in std or reach == 0.0:
                continue
            wide = np.inf
            for far in FARTHER:
                steps = far * reach * np.array(ASIDE)
                left = np.array([
                    self._try_at(end, k, name, float(value + step), calm)
                    for step in steps
                ])  # fmt: skip
                good = np.isfinite(left)
                if good.sum() > 4:
                    wide = min(wide, _by_parabola(steps[good], left[good], reach))
                if wide < 0.5 * reach:
                    break
            std[name] = max(std[name], wide)
        return std, ()

    def _try_at(self, end: Fitted, k: int, name: str, value: float, calm) -> float:
        """The sum of squares with one parameter of effect k moved; NaN where the scene
        cannot have it."""
        others = list(end.effects)
        moved = {**others[k].parameters, name: value}
        others[k] = Effect(others[k].kind, others[k].at, moved)
        r = tried(self, *others)
        return np.nan if r is None else float(np.sum((r - calm) ** 2))

    def places_of(self, kind: str) -> list[str]:
        """Of pairs those that meet, links of a robot among them."""
        if KINDS[kind].at != "pair":
            return super().places_of(kind)
        return sorted(self._pairs_met)

    @cached_property
    def _pairs_met(self) -> dict[str, float]:
        with self.simulation.noting_pairs() as met:
            self.simulate(())
        return met

    def candidates(self, nuisances: Nuisances, current: Fitted) -> list[Candidate]:
        found = super().candidates(nuisances, current)
        found += candidates_of(self, kinds_of_joints(self), current)
        return found + loads(
            self.dynamics, {(e.kind, at) for e in current.effects for at in e.at},
            current.r, partial(tried, self, *current.effects), self._carriers,
        )  # fmt: skip

    def _carriers(self, kind: str) -> list[str]:
        """Bodies that joints join; less those that are free where the kind is of what
        these are asked for themselves."""
        joints = one_dof_joints(self.dynamics.plant)
        joined = {
            full_name(self.dynamics.plant, body)
            for j in joints for body in (j.parent_body(), j.child_body())
        }  # fmt: skip
        names = [p.name for p in KINDS[kind].parameters]
        asked = [[p.name for p in e.parameters] for e in KINDS.values() if e.absolute]
        own = self.bodies if names in asked else ()
        return [at for at in self.dynamics.links() if at in joined and at not in own]


def _by_parabola(steps: np.ndarray, left: np.ndarray, reach: float) -> float:
    """How far a parameter may be off, by the sum of squares that is left (n,) at steps
    from it; at most `reach` by where the parabola's bottom is."""
    fit = np.polyfit(steps, left, 2)
    if fit[0] <= 0.0:
        return np.inf
    rough = np.sqrt(np.sum((left - np.polyval(fit, steps)) ** 2) / (len(steps) - 3))
    low = min(abs(0.5 * fit[1] / fit[0]), reach)
    return float(np.hypot(low, np.sqrt(max(1.0, 2.0 * rough) / fit[0])))


def contacts_of_mujoco(problem: MujocoProblem) -> Finding:
    """That another simulator was compared."""
    says = (
        f"Windows of {WINDOW_SEC:g} s were simulated by MuJoCo, with the contacts, "
        "stops and time step of the model's own file. In Drake what pushes, slides or "
        "lands, or has long steps, moves differently by more than the noise."
    )
    name = problem.recordings[0].name
    return Finding("mujoco_contacts", name, "time", WINDOW_SEC, "s", "info", says)

"""Effects fitted together, exactly and not by their columns."""

from collections.abc import Callable, Sequence
from weakref import WeakKeyDictionary

import numpy as np
from scipy.optimize import least_squares

from makebreak.gap.budget import go_on
from makebreak.gap.numerics.agreed_step import agreed_step
from makebreak.gap.numerics.selection import Screen, spread_by_blocks
from makebreak.gap.problem import Fitted, GapProblem
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, Parameter, check_parameters

AT_BOUND = 1e-9  # A parameter that may not be negative is zero.
# Of the largest slope: a parameter with less may not show at all, if all rows together
# do not change by this share of the noise without it.
HARDLY, UNSEEN = 1e-3, 1e-3
SHORT = 8  # Evaluations: a fit of no more is not asked to converge.
# Of what a step changed, what slopes may have missed: to be kept, and to be as good as
# exact; and of all that is left, what is nothing.
BENT, STRAIGHT, NOTHING = 0.1, 1e-2, 1e-6
# Of a search by blocks of time: steps, shares of each that are tried, and the least of
# what is left that a step must take off.
MOST_BY_BLOCKS, SHARES_OF_STEP, BETTER = 8, (1.0, 0.5, 0.25), 0.02
MOST_FREE = 6  # Parameters that are searched where errors jump.
ROUGH = np.linspace(0.85, 1.15, 16)  # Of a start, tried.


def fit_effects(
    problem: GapProblem,
    screen: Screen,
    start: Sequence[Effect],
    fixed: Sequence[Sequence[str]] | None = None,
    evaluations: int | None = None,
) -> Fitted:
    """Least squares over the training rows, the nuisances fitted along.

    Args: start: effects with parameters to start from; fixed: of each the parameters
        that stay as they are. evaluations: Gauss-Newton steps at most; else the
        problem's own number, which goes with how long its residual takes.
    """
    fixed = [tuple(names) for names in fixed or [()] * len(start)]
    start, rough = _try_rough(problem, screen, list(start), fixed)
    fixed = [(*a, *b) for a, b in zip(fixed, rough, strict=True)]
    replaced = problem.replaced(start)
    if replaced is not None and replaced.any():
        screen = screen.without(replaced)
    steps = evaluations or problem.plan.evaluations
    free = _Free(problem, start, fixed)
    x0, scale, low = free.x0, free.scale, free.low
    cache: dict[bytes, np.ndarray] = {}

    def residual(z) -> np.ndarray:
        key = np.asarray(z).tobytes()
        if key not in cache:
            go_on()
            cache[key] = problem.residual(free.effects(z))
        return cache[key]

    def cost(z):
        try:
            rows = screen.cost_rows(residual(z))
        except (ValueError, RuntimeError):  # Drake refuses such parameters.
            rows = np.full(_n_rows(screen), 1e6)
        rows = np.append(rows, problem.prior_rows(free.effects(z)))
        return np.where(np.isfinite(rows), rows, 1e6)

    slopes = _Slopes(problem, free, residual, cost, screen.cost_rows)
    solved = None
    if len(x0):
        solved = _solved(
            cost, slopes, x0 / scale, (low / scale, free.high / scale), steps
        )
    z = x0 / scale if solved is None else solved.x
    if solved is not None:  # What does not show is not told: it stays neutral.
        shows = np.linalg.norm(solved.jac, axis=0)
        for k, (i, name) in enumerate(free.names):
            if shows[k] > HARDLY * shows.max():
                continue
            there = np.array(z)
            parameter = KINDS[start[i].kind].parameter(name)
            there[k] = _unidentified(parameter, x0[k]) / scale[k]
            # Slopes are differences over short steps, and have noise of their own.
            if shows[k] <= 1e-6 * shows.max() or _is_same(residual, z, there):
                z = there
    try:
        r = residual(z)
    except (ValueError, RuntimeError):  # Back to where it came from, which may raise.
        z = x0 / scale
        r = residual(z)
    effects = free.effects(z)
    std: list[dict[str, float]] = [{} for _ in start]
    J = np.zeros((0, len(x0)))
    if solved is not None:
        J = solved.jac / scale
        u, w, vt = np.linalg.svd(solved.jac, full_matrices=False)
        inverse = 1.0 / np.maximum(w, max(1e-12 * w[0], 1e-100))
        spread = np.sqrt(np.sum((vt.T * inverse) ** 2, axis=1))
        # What is left, in units of what was allowed for, widens the interval.
        spread *= max(np.sqrt(2.0 * solved.cost / len(solved.fun)), 1.0)
        # So do errors that go together for a while: blocks of time, drawn anew.
        block = np.full(len(solved.fun), -1)
        train = problem.train()
        block[: train.sum()] = problem.blocks()[train]
        spread = np.maximum(spread, spread_by_blocks(solved.jac, solved.fun, block))
        for (i, name), each in zip(free.names, spread * scale, strict=True):
            std[i][name] = float(each)
    for each, tried in zip(std, rough, strict=True):
        each.update(tried)
    b, left = screen.fit_nuisances(r)
    return Fitted(
        tuple(_tidy(e) for e in effects), tuple(std), r, left, b, screen.evaluate(r),
        J, np.array(solved.fun) if solved is not None else np.zeros(0),
        tuple(free.names),
    )  # fmt: skip


def _solved(cost: Callable, slopes: "_Slopes", z, bounds, steps: int):
    """scipy's least squares, of which the last slopes are exact where it is asked to
    converge."""
    solved, converges = None, steps > SHORT
    while True:
        slopes.renew(exactly=solved is not None)
        solved = least_squares(
            cost, z, slopes, bounds=bounds, x_scale=1.0, xtol=1e-6,
            ftol=1e-6 if converges else 1e-4, max_nfev=max(steps, 1),
        )  # fmt: skip
        steps -= solved.nfev
        if slopes.are_exact or not converges:
            return solved
        z = solved.x


# Of each problem how residuals change with a parameter, by earlier fits: the scene's
# residual, of whose weights they are, and {(kind, places, name): (m,) column}.
_known: WeakKeyDictionary[
    GapProblem, tuple[np.ndarray, dict[tuple[str, tuple[str, ...], str], np.ndarray]]
] = WeakKeyDictionary()


def _known_columns(problem: GapProblem) -> dict:
    """Those of the weights of now, to be read and added to. Equations are linear in
    most parameters, so that one fit's slopes are the next one's."""
    base = problem.base()
    if problem not in _known or _known[problem][0] is not base:
        _known[problem] = base, {}
    return _known[problem][1]


class _Slopes:
    """Of the rows that a fit minimises, with respect to its parameters. Differences, or
    those of an earlier fit, if one step of all parameters at once does what they say;
    taken anew where what the last step did is not what they said, else corrected by it.

    Source: Broyden, Math. Comp. 19(92), 1965, method 1.
    """

    def __init__(self, problem: GapProblem, free: "_Free", residual, cost, rows_of):
        self._problem, self._free = problem, free
        self._residual, self._cost, self._rows_of = residual, cost, rows_of
        alone = [[k] for k in range(len(free.names))]
        self._sets = problem.apart(free.start, free.names) or alone
        every = np.ones(1, bool)
        self._mine = [
            every if self._sets is alone else problem.moved_by(free.start[i])
            for i, _ in free.names
        ]
        self._last: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._columns = _known_columns(problem) if problem.by_equations else {}
        self._keys = [
            (free.start[i].kind, tuple(free.start[i].at), name)
            for i, name in free.names
        ]
        self.are_exact = self._must_be_exact = False

    def renew(self, exactly: bool) -> None:
        """The next are asked for anew."""
        self._last, self._must_be_exact = None, exactly

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """(n, k) at parameters z (k,)."""
        rows = self._cost(z)
        if self._last is not None:
            there, were, J = self._last
            step = z - there
            off = rows - were - J @ step
            missed, change, size = map(np.linalg.norm, (off, rows - were, rows))
            if missed <= max(BENT * change, NOTHING * size):
                if missed > NOTHING * size:
                    J = J + np.outer(off, step) / (step @ step)
                    self.are_exact &= bool(missed <= STRAIGHT * change)
                self._last = z.copy(), rows, J
                return J
        J = self._differences(z, rows)
        self._last = z.copy(), rows, J
        return J

    def _differences(self, z: np.ndarray, rows: np.ndarray) -> np.ndarray:
        r, h = self._residual(z), self._steps(z)
        columns, J = self.columns(z), np.zeros((len(rows), len(z)))
        for k in range(len(z)):
            alone = np.array(z)
            alone[k] += h[k]
            there = np.append(
                self._rows_of(r + columns[:, k] * h[k]),
                self._problem.prior_rows(self._free.effects(alone)),
            )
            J[:, k] = (there - rows) / h[k]
        return np.where(np.isfinite(J), J, 0.0)

    def _steps(self, z: np.ndarray) -> np.ndarray:
        h = self._problem.plan.diff_step * np.maximum(np.abs(z), 0.3)
        return np.where(z + h > self._free.high / self._free.scale, -h, h)

    def columns(self, z: np.ndarray) -> np.ndarray:
        """(m, k) of the residual, as each parameter changes by its typical size; 0
        where steps to both sides are refused."""
        r, h = self._residual(z), self._steps(z)
        old = [key in self._columns for key in self._keys]
        for some in self._sets:
            if not all(old[k] for k in some):
                self._take(z, some, r, h)
        missed = self._missed(z, r, h) if any(old) else 0.0
        if missed > (STRAIGHT if self._must_be_exact else BENT):
            for some in self._sets:
                self._take(z, some, r, h)
            missed = 0.0
        self.are_exact = missed <= STRAIGHT
        none = np.zeros(len(r))
        each = [
            self._column(k) if key in self._columns else none
            for k, key in enumerate(self._keys)
        ]
        return np.stack(each, axis=1) if each else np.zeros((len(r), 0))

    def _column(self, k: int) -> np.ndarray:
        """(m,) of the residual, as one parameter changes by its typical size."""
        return self._columns[self._keys[k]] * self._free.scale[k]

    def _take(self, z, some: Sequence[int], r: np.ndarray, h: np.ndarray) -> None:
        """Columns of some parameters by differences over steps h (k,), backwards where
        a step is refused."""
        for side in (1.0, -1.0):
            moved = np.array(z)
            moved[some] += side * h[some]
            try:
                off = self._residual(moved) - r
            except (ValueError, RuntimeError):
                continue
            for k in some:
                mine = np.where(self._mine[k], off, 0.0)
                self._columns[self._keys[k]] = mine / (
                    side * h[k] * self._free.scale[k]
                )
            return
        for k in some:
            self._columns.pop(self._keys[k], None)

    def _missed(self, z: np.ndarray, r: np.ndarray, h: np.ndarray) -> float:
        """Share of what one step of all parameters does, each of which moves the
        residual about as far, that is not what columns say; infinite where it is
        refused."""
        there = [k for k, key in enumerate(self._keys) if key in self._columns]
        each = np.array([self._column(k) * h[k] for k in there])
        sizes = np.linalg.norm(each, axis=1)
        share = np.clip(np.median(sizes) / np.maximum(sizes, 1e-300), 0.1, 10.0)
        moved = np.array(z)
        moved[there] += share * h[there]
        try:
            off = self._residual(moved) - r
        except (ValueError, RuntimeError):
            return np.inf
        missed = np.linalg.norm(off - share @ each)
        return float(missed / max(np.linalg.norm(off), 1e-300))


def _unidentified(parameter: Parameter, start: float) -> float:
    """What a parameter is taken to be of which the data tell nothing: neutral; a
    coordinate zero (of a load across a planar arm's plane); else as it came."""
    if parameter.neutral is not None:
        return parameter.neutral
    return 0.0 if parameter.low < 0.0 < parameter.high else start


def _is_same(residual: Callable, z: np.ndarray, there: np.ndarray) -> bool:
    """Whether two sets of parameters leave the same, as far as noise is concerned."""
    try:
        off = residual(z) - residual(there)
    except (ValueError, RuntimeError):
        return False
    return bool(np.sqrt(np.mean(off**2)) < UNSEEN)


def tangents(
    problem: GapProblem, fitted: Fitted, fixed: Sequence[Sequence[str]]
) -> tuple[np.ndarray, np.ndarray]:
    """(m, k) how residuals change with each free parameter of what is fitted, in units
    of its typical size; and the number (k,) of the effect that each is one of."""
    free = _Free(problem, fitted.effects, [tuple(names) for names in fixed])

    def residual(z) -> np.ndarray:
        go_on()
        return problem.residual(free.effects(z))

    slopes = _Slopes(problem, free, residual, None, None)
    of = np.array([i for i, _ in free.names], int)
    return slopes.columns(free.x0 / free.scale), of


def search_by_blocks(
    problem: GapProblem,
    screen: Screen,
    start: Sequence[Effect],
    fixed: Sequence[Sequence[str]],
) -> tuple[Effect, ...] | None:
    """Effects from which a fit may go on, by steps that blocks of time ask for in which
    columns say what a step does (agreed_step), while the training rows get better.
    None: so many parameters cost too many simulations."""
    free = _Free(problem, start, [tuple(names) for names in fixed])
    if len(free.names) > MOST_FREE:
        return None
    low, high = free.low / free.scale, free.high / free.scale
    train, block = problem.train(), problem.blocks()

    def residual(z) -> np.ndarray:
        go_on()
        return problem.residual(free.effects(z))

    def left(z) -> np.ndarray:
        try:
            return screen.fit_nuisances(residual(z))[1][train]
        except (ValueError, RuntimeError):  # Such parameters are refused.
            return np.full(int(train.sum()), np.inf)

    z, slopes = free.x0 / free.scale, _Slopes(problem, free, residual, None, None)
    now = left(z)
    for _ in range(MOST_BY_BLOCKS if np.isfinite(now).all() else 0):
        step, _ = agreed_step(-slopes.columns(z)[train], now, block[train])
        tried = [np.clip(z + share * step, low, high) for share in SHARES_OF_STEP]
        then = next(
            ((x, r) for x in tried
             if np.linalg.norm(r := left(x)) < np.linalg.norm(now)), None,
        )  # fmt: skip
        if then is None:
            break
        better = 1.0 - np.linalg.norm(then[1]) / np.linalg.norm(now)
        z, now = then
        if better < BETTER:
            break
    return tuple(_tidy(e) for e in free.effects(z))


class _Free:
    """The parameters of effects that a fit may move, as one vector.

    names: (index of effect, name) of each; x0, scale, low, high (n,): where they start,
    a typical size, a least and a greatest value.
    """

    def __init__(
        self,
        problem: GapProblem,
        start: Sequence[Effect],
        fixed: Sequence[Sequence[str]],
    ):
        self.start = start
        self.names = [
            (i, name)
            for i, effect in enumerate(start)
            for name in effect.parameters
            if name not in fixed[i] and not KINDS[effect.kind].parameter(name).given
        ]
        self.scale = np.array([size_of(start[i], name) for i, name in self.names])
        least = [problem.least(e.kind, e.at) for e in start]
        self.low = np.array(
            [
                max(_lowest(start[i].kind, name), least[i].get(name, -np.inf))
                for i, name in self.names
            ]
        )
        self._leave_for_all(problem)
        self.high = np.array([highest(start[i].kind, name) for i, name in self.names])
        self._most = np.array(
            [KINDS[start[i].kind].parameter(name).most for i, name in self.names]
        )
        x0 = np.array([start[i].parameters[name] for i, name in self.names])
        x0 = np.maximum(x0, self.low + 1e-9 * self.scale)
        self.x0 = np.minimum(x0, self.high - 1e-9 * self.scale)

    def _leave_for_all(self, problem: GapProblem) -> None:
        """Raises what effects may take away where several of a kind act at one place:
        together they take no more than the model has there."""
        for k, (i, name) in enumerate(self.names):
            kind, places = self.start[i].kind, self.start[i].at
            for at in places if np.isfinite(self.low[k]) else ():
                others = [
                    self.low[m] for m, (j, other) in enumerate(self.names[:k])
                    if (self.start[j].kind, other) == (kind, name)
                    and at in self.start[j].at
                ]  # fmt: skip
                if others:
                    least = problem.least(kind, [at]).get(name, -np.inf)
                    self.low[k] = max(self.low[k], least - sum(others))

    def effects(self, z: np.ndarray) -> list[Effect]:
        """Effects of parameters z (n,), in units of `scale`."""
        parameters = [dict(effect.parameters) for effect in self.start]
        # A number that is refused is not where a fit ends, which may not see it at all.
        values = np.clip(z * self.scale, -self._most, self._most)
        for (i, name), value in zip(self.names, values, strict=True):
            parameters[i][name] = float(value)
        return [
            Effect(e.kind, list(e.at), p)
            for e, p in zip(self.start, parameters, strict=True)
        ]


def _try_rough(problem, screen, start: list[Effect], fixed):
    """Effects with those parameters tried that a gradient is no guide for, each about
    its start; and of each effect the steps in which that was done, by name."""
    steps: list[dict[str, float]] = [{} for _ in start]
    for i, effect in enumerate(start):
        for name, value in list(effect.parameters.items()):
            if name in fixed[i] or not KINDS[effect.kind].parameter(name).rough:
                continue
            tried = []
            for v in value * ROUGH:
                go_on()
                other = Effect(effect.kind, effect.at, {**effect.parameters, name: v})
                r = problem.residual([*start[:i], other, *start[i + 1 :]])
                tried.append((screen.evaluate(r).train, other))
            start[i] = min(tried, key=lambda each: each[0])[1]
            steps[i][name] = float(value * (ROUGH[1] - ROUGH[0]))
    return start, steps


def _n_rows(screen: Screen) -> int:
    return len(screen.cost_rows(screen.r))


def size_of(effect: Effect, name: str) -> float:
    """A typical size of a parameter, in which a fit moves it."""
    value = abs(effect.parameters[name])
    unit = KINDS[effect.kind].parameter(name).unit
    typical = {"rad": 0.1, "s": 0.01, "m": 0.05, "s/s": 1e-3, "kg": 0.1}.get(unit, 0.0)
    group = [abs(effect.parameters[p.name]) for p in KINDS[effect.kind].parameters
             if p.unit == unit and p.name in effect.parameters]  # fmt: skip
    return max(value, typical, 0.3 * max(group), 1e-3)


def _lowest(kind: str, name: str) -> float:
    valid = KINDS[kind].parameter(name).valid
    return {">= 0": 0.0, "> 0": 1e-9, "share": 0.0}.get(valid, -np.inf)


def highest(kind: str, name: str) -> float:
    """The highest value to which a fit takes a parameter. A share ends where robots'
    do: at 1 nothing is left."""
    parameter = KINDS[kind].parameter(name)
    ends = parameter.ends or parameter.valid == "share"
    return parameter.high if ends else np.inf


def _tidy(effect: Effect) -> Effect:
    """Phases within one turn, and what ended at its limit of zero zero."""
    p = dict(effect.parameters)
    for each in KINDS[effect.kind].parameters:
        if each.valid == ">= 0" and p.get(each.name, 1.0) < AT_BOUND:
            p[each.name] = 0.0
        if each.name == "phase" and "phase" in p:
            p["phase"] = float(np.arctan2(np.sin(p["phase"]), np.cos(p["phase"])))
    tidy = Effect(effect.kind, list(effect.at), p)
    check_parameters(tidy, KINDS[effect.kind])
    return tidy

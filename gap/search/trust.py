"""What each fitted parameter would be on parts of the data, and from other starts."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import linregress
from scipy.stats import t as student_t

from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.selection import Screen, between_parts, random_effects
from makebreak.gap.problem import Fitted, GapProblem
from makebreak.gap.result import Trust
from makebreak.gap.said import called
from makebreak.gap.thresholds import DIFFERS_SHARE, DIFFERS_Z
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, sliding_joints, unit_at

PARTS = 5  # Stretches of time of a recording.
FEWEST_PARTS = 4  # Of which a scatter is taken.
FEWEST_TELLING = 3  # Of those, that tell the parameter by themselves: with this share
LEAST_SHARE = 0.01  # of what all of them say, or to this share of its value. What a
STRAIGHT = 0.2  # part knows less well it puts where columns are no longer straight.
STARTS = (0.5, 1.6)  # Of each parameter's distance from neutral.
NORMAL_975 = 1.96  # Deviations of a 95 % interval.
Known = tuple[np.ndarray, np.ndarray] | None
BY_CHANCE = 1e-3  # p of a straight line through values that only scatter.
BETWEEN = 0.2  # Of a drift, by which values may go beyond those at its ends.
RIDGE = 0.98  # Two parameters whose errors go together like this: their sum shows.


def trust_in(
    problem: GapProblem, screen: Screen, fitted: Fitted,
    fixed: Sequence[Sequence[str]], std: Sequence[Mapping[str, float]],
) -> list[Trust]:  # fmt: skip
    """Each parameter of `fitted` over recordings, stretches of time and starts.

    Args: screen: as it was fitted with; of each effect, fixed: parameters that stay as
        they are; std: the deviations that are reported.
    """
    if not fitted.names:
        return []
    J, r, known = _rows(problem, fitted)
    value = _values(fitted)
    recording, stretches_of = _parts(problem)
    by_recording = {
        int(k): value + gauss_newton(J, r, recording == k, known)
        for k in np.unique(recording)
    }
    stretches = [value + gauss_newton(J, r, some, known) for some in stretches_of]
    starts = [_from_elsewhere(problem, screen, fitted, fixed, s) for s in STARTS]
    ridge, alike = ridges(fitted.J), correlations(fitted.J)
    names = [f"{name} of {called(fitted.effects[i])}" for i, name in fitted.names]
    found = []
    for k, (i, name) in enumerate(fitted.names):
        effect = fitted.effects[i]
        other = ""
        if ridge[k] >= 0:
            other = names[ridge[k]]
        found.append(
            Trust(
                effect.kind, tuple(effect.at), name,
                KINDS[effect.kind].parameter(name).unit, float(value[k]),
                std[i].get(name, fitted.std[i].get(name, 0.0)),
                {
                    problem.recordings[number].name: float(of[k])
                    for number, of in by_recording.items()
                },
                tuple(float(of[k]) for of in stretches),
                tuple(float(of[i][name]) for of in starts if of is not None),
                other,
                {n: float(alike[k, j]) for j, n in enumerate(names) if j != k},
            )
        )  # fmt: skip
    return found


def by_recording(
    problem: GapProblem, fitted: Fitted
) -> dict[tuple[int, str], dict[str, tuple[float, float]]]:
    """{(effect, parameter): {recording: (value, standard deviation)}} to first order,
    of the recordings that show it."""
    if not fitted.names:
        return {}
    J, r, known = _rows(problem, fitted)
    recording, _ = _parts(problem)
    value = _values(fitted)
    found: dict[tuple[int, str], dict[str, tuple[float, float]]] = {
        named: {} for named in fitted.names
    }
    for number in np.unique(recording):
        some = recording == number
        x = value + gauss_newton(J, r, some, known)
        variance = _variances(J, r, some, known)
        for k, named in enumerate(fitted.names):
            if np.isfinite(x[k]) and np.isfinite(variance[k]):
                name = problem.recordings[number].name
                found[named][name] = float(x[k]), float(np.sqrt(variance[k]))
    return found


def consistency(problem: GapProblem, fitted: Fitted) -> list[float]:
    """Of each effect, by how many standard deviations it is off neutral if what it is
    on parts of the data (recordings; stretches of time where there are few) differs
    from part to part by more than noise: its surest parameter's. What imitates another
    law is one thing here and another there. Infinite where parts say nothing. Of what
    every model has (a friction, a moment of inertia) neutral is what the scene has."""
    found: dict[int, float] = {}
    neutrals = [problem.dynamics.now(e.kind, e.at) for e in fitted.effects]
    for (i, name), (x, variance) in _over_parts(problem, fitted).items():
        neutral = neutrals[i].get(name, np.inf)
        if np.isfinite(neutral):
            mean, std = random_effects(x, variance)
            found[i] = max(found.get(i, 0.0), abs(mean - neutral) / std)
    return [found.get(i, np.inf) for i in range(len(fitted.effects))]


def scatter(problem: GapProblem, fitted: Fitted) -> list[dict[str, float]]:
    """Of each effect, the deviations of its parameters by how they differ from part to
    part of the data: laws are approximations, and one that is not quite that of the
    world has another best value where it moves otherwise, which rows, taken as
    independent, do not say. Without those of which too few parts tell something."""
    out: list[dict[str, float]] = [{} for _ in fitted.effects]
    for (i, name), (x, variance) in _over_parts(problem, fitted).items():
        w = 1.0 / np.maximum(variance, 1e-300)
        value = fitted.effects[i].parameters[name]
        telling = w >= LEAST_SHARE * w.sum()
        telling |= variance <= (STRAIGHT * value) ** 2
        n = int(telling.sum())
        if n < FEWEST_TELLING:
            continue
        # Of the fit, in which each part has the weight that it has by itself. A few
        # parts hardly tell how they differ.
        few = float(student_t.ppf(0.975, n - 1)) / NORMAL_975
        own = variance + few**2 * between_parts(x[telling], variance[telling])
        out[i][name] = float(np.sqrt(np.sum(w**2 * own)) / np.sum(w))
    return out


def drifts(problem: GapProblem, fitted: Fitted) -> dict[tuple[int, str], np.ndarray]:
    """{(effect, parameter): its values in stretches of time} of those that go from one
    value to another over a recording: friction while a gear warms up, a load that is
    picked up. None of several recordings, which are compared one by one."""
    if not fitted.names or len(problem.recordings) > 1:
        return {}
    J, r, known = _rows(problem, fitted)
    _, parts = _parts(problem)
    if len(parts) < FEWEST_PARTS:
        return {}
    value = _values(fitted)
    x = np.array([value + gauss_newton(J, r, some, known) for some in parts])
    std = np.sqrt(np.array([_variances(J, r, some, known) for some in parts]))
    found = {}
    for k, (i, name) in enumerate(fitted.names):
        neutral = KINDS[fitted.effects[i].kind].parameter(name).neutral
        ends, sure = x[[0, -1], k], float(np.hypot(std[0, k], std[-1, k]))
        if neutral is None or not np.isfinite(x[:, k]).all() or not sure > 0.0:
            continue
        far = float(np.abs(ends - neutral).max())
        apart = float(abs(ends[1] - ends[0]))
        # Their own deviations have in common what links are not known to: steps that
        # go one way are told by how straight they go, too.
        steps = linregress(np.arange(len(x)), x[:, k])
        is_sure = apart > DIFFERS_Z * sure or steps.pvalue < BY_CHANCE
        off = np.maximum(x[:, k] - ends.max(), ends.min() - x[:, k])
        between = bool((off <= BETWEEN * apart).all())
        if apart > DIFFERS_SHARE * far and is_sure and between:
            found[i, name] = x[:, k]
    return found


def drift_sentences(problem: GapProblem, fitted: Fitted) -> str:
    """What is to be said of parameters that change over a recording; "": none does."""
    text = ""
    for (i, name), x in drifts(problem, fitted).items():
        effect = fitted.effects[i]
        slides = {*effect.at} <= sliding_joints(problem.dynamics.plant)
        unit = unit_at(KINDS[effect.kind].parameter(name).unit, slides)
        text += (
            f" The {name.replace('_', ' ')} of {called(effect)} goes from "
            f"{x[0]:.3g} to {x[-1]:.3g} {unit} over the recording: it is not constant."
        )
    return text


def _over_parts(
    problem: GapProblem, fitted: Fitted
) -> dict[tuple[int, str], tuple[np.ndarray, np.ndarray]]:
    """{(effect, parameter): its values in recordings, or stretches of time where there
    are few, and their variances}, of those that enough parts show."""
    if not fitted.names:
        return {}
    J, r, known = _rows(problem, fitted)
    recording, parts = _parts(problem)
    several = np.unique(recording)
    if len(several) >= FEWEST_PARTS:
        parts = [recording == k for k in several]
    value = _values(fitted)
    x = np.array([value + gauss_newton(J, r, some, known) for some in parts])
    variance = np.array([_variances(J, r, some, known) for some in parts])
    there = np.isfinite(x) & np.isfinite(variance)
    return {
        named: (x[there[:, k], k], variance[there[:, k], k])
        for k, named in enumerate(fitted.names)
        if there[:, k].sum() >= FEWEST_PARTS
    }


def _rows(
    problem: GapProblem, fitted: Fitted
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """J (m, k) and r (m,) of the rows that were fitted; and the same of the rows that
    say what is known beforehand: the cost of the nuisances."""
    n = int(problem.train().sum())
    J, r = fitted.J, fitted.rows
    return J[:n], r[:n], (J[n:], r[n:])


def _values(fitted: Fitted) -> np.ndarray:
    return np.array([fitted.effects[i].parameters[p] for i, p in fitted.names])


def _parts(problem: GapProblem) -> tuple[np.ndarray, list[np.ndarray]]:
    """(m,) the recording of each fitted row, and the rows (m,) of each stretch."""
    train = problem.train()
    recording, block = problem.parts()[train], problem.blocks()[train]
    stretches = np.array_split(np.unique(block), PARTS)
    return recording, [np.isin(block, some) for some in stretches if len(some)]


def _variances(
    J: np.ndarray, r: np.ndarray, some: np.ndarray, known: Known = None
) -> np.ndarray:
    """(k,) of the step that gauss_newton takes; NaN where it takes none."""
    out = np.full(J.shape[1], np.nan)
    step = gauss_newton(J, r, some, known)
    shown = np.isfinite(step)
    if shown.any():
        A = J[some][:, shown]
        left = r[some] + A @ step[shown]
        A, _ = _with_known(A, r[some], shown, np.mean(some), known)
        size = np.linalg.norm(A, axis=0)
        C = np.linalg.pinv((A / size).T @ (A / size), rcond=1e-12, hermitian=True)
        out[shown] = np.diag(C) / size**2 * max(float(np.mean(left**2)), 1.0)
    return out


def gauss_newton(
    J: np.ndarray, r: np.ndarray, some: np.ndarray, known: Known = None
) -> np.ndarray:
    """(k,) by which parameters change if only some (m,) of the rows r (m,), J (m, k)
    are fitted; NaN where those do not show a parameter.

    Args: known: (J, r) of what is known beforehand, of which a part has the share that
        it has of the rows. Without it a load would seem to differ wildly from part to
        part: the masses of links, which are known to a few per cent, could take its
        place, and only their cost keeps them from it.
    """
    step = np.full(J.shape[1], np.nan)
    size = np.linalg.norm(J[some], axis=0)
    shown = size > 1e-3 * np.linalg.norm(J, axis=0) * np.sqrt(np.mean(some))
    if shown.any():
        A, y = _with_known(J[some][:, shown], r[some], shown, np.mean(some), known)
        size = np.linalg.norm(A, axis=0)
        step[shown] = -np.linalg.lstsq(A / size, y, rcond=1e-6)[0] / size
    return step


def _with_known(
    A: np.ndarray, y: np.ndarray, shown: np.ndarray, share: float, known: Known
) -> tuple[np.ndarray, np.ndarray]:
    """Rows A (m, k), y (m,) of a part with its share of what is known beforehand."""
    if known is None or not len(known[1]):
        return A, y
    J, r = known
    weight = np.sqrt(share)
    return np.vstack([A, weight * J[:, shown]]), np.append(y, weight * r)


def correlations(J: np.ndarray) -> np.ndarray:
    """(k, k) of the errors of the parameters with columns J (m, k). Of columns that are
    alike the inverse has no variance in the direction that does not show."""
    k = J.shape[1]
    size = np.linalg.norm(J, axis=0)
    size[size == 0.0] = 1.0
    A = J / size
    C = np.linalg.pinv(A.T @ A, rcond=1e-14, hermitian=True)
    std = np.sqrt(np.maximum(np.diag(C), 1e-300))
    R, alike = C / std[:, None] / std, A.T @ A
    R = np.where(np.abs(alike) > RIDGE, -alike, R)
    R[np.diag_indices(k)] = 1.0
    return R


def ridges(J: np.ndarray) -> np.ndarray:
    """(k,) of each parameter the other with which its errors go together so closely
    that only a sum of the two shows; -1 where there is none. J (m, k)."""
    R, k = np.abs(correlations(J)), J.shape[1]
    np.fill_diagonal(R, 0.0)
    out = np.full(k, -1)
    if k > 1:
        best = np.argmax(R, axis=1)
        out = np.where(R[np.arange(k), best] > RIDGE, best, -1)
    return out


def _from_elsewhere(problem, screen, fitted: Fitted, fixed, factor: float):
    """{parameter: value} of each effect, fitted from other starts; None if refused."""
    start = []
    for effect, held in zip(fitted.effects, fixed, strict=True):
        p = dict(effect.parameters)
        for each in KINDS[effect.kind].parameters:
            if each.name in p and each.name not in held and each.neutral is not None:
                p[each.name] = each.neutral + factor * (p[each.name] - each.neutral)
        start.append(Effect(effect.kind, list(effect.at), p))
    try:
        again = fit_effects(problem, screen, start, fixed)
    except ValueError:
        return None
    return [e.parameters for e in again.effects]

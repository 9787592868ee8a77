"""What each fitted parameter would be on parts of the data, and from other starts."""

from collections.abc import Sequence

import numpy as np

from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import Fitted, GapProblem
from makebreak.gap.result import Trust
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.systems.numerics.selection import Screen

PARTS = 5  # Stretches of time of a recording.
STARTS = (0.5, 1.6)  # Of each parameter's distance from neutral.
RIDGE = 0.98  # Two parameters whose errors go together like this: their sum shows.


def trust_in(
    problem: GapProblem, screen: Screen, fitted: Fitted, fixed: Sequence[Sequence[str]]
) -> list[Trust]:
    """Each parameter of `fitted` over recordings, stretches of time and starts.

    Args: screen: as it was fitted with; fixed: parameters that stay as they are.
    """
    if not fitted.names:
        return []
    train = problem.train()
    n = int(train.sum())
    J, r = fitted.J[:n], fitted.rows[:n]
    value = np.array([fitted.effects[i].parameters[p] for i, p in fitted.names])
    recording, block = problem.parts()[train], problem.blocks()[train]
    by_recording = {
        int(k): value + gauss_newton(J, r, recording == k) for k in np.unique(recording)
    }
    stretches = [
        value + gauss_newton(J, r, np.isin(block, some))
        for some in np.array_split(np.unique(block), PARTS)
        if len(some)
    ]
    starts = [_from_elsewhere(problem, screen, fitted, fixed, s) for s in STARTS]
    ridge = ridges(fitted.J)
    found = []
    for k, (i, name) in enumerate(fitted.names):
        effect = fitted.effects[i]
        other = ""
        if ridge[k] >= 0:
            j, its = fitted.names[ridge[k]]
            other = f"{its} of {_called(fitted.effects[j])}"
        found.append(
            Trust(
                effect.kind, tuple(effect.at), name,
                KINDS[effect.kind].parameter(name).unit, float(value[k]),
                fitted.std[i].get(name, 0.0),
                {
                    problem.recordings[number].name: float(of[k])
                    for number, of in by_recording.items()
                },
                tuple(float(of[k]) for of in stretches),
                tuple(float(of[i][name]) for of in starts if of is not None),
                other,
            )
        )  # fmt: skip
    return found


def gauss_newton(J: np.ndarray, r: np.ndarray, some: np.ndarray) -> np.ndarray:
    """(k,) by which parameters change if only some (m,) of the rows r (m,), J (m, k)
    are fitted; NaN where those do not show a parameter."""
    step = np.full(J.shape[1], np.nan)
    size = np.linalg.norm(J[some], axis=0)
    shown = size > 1e-3 * np.linalg.norm(J, axis=0) * np.sqrt(np.mean(some))
    if shown.any():
        A = J[some][:, shown] / size[shown]
        step[shown] = -np.linalg.lstsq(A, r[some], rcond=1e-8)[0] / size[shown]
    return step


def ridges(J: np.ndarray) -> np.ndarray:
    """(k,) of each parameter the other with which its errors go together so closely
    that only a sum of the two shows; -1 where there is none. J (m, k)."""
    k = J.shape[1]
    size = np.linalg.norm(J, axis=0)
    size[size == 0.0] = 1.0
    A = J / size
    C = np.linalg.pinv(A.T @ A, rcond=1e-14, hermitian=True)
    std = np.sqrt(np.maximum(np.diag(C), 1e-300))
    R = np.abs(C / std[:, None] / std) - np.eye(k)
    # A truncated direction has no variance in the inverse: it is a ridge all the same.
    R = np.maximum(R, np.abs(A.T @ A) - np.eye(k))
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


def _called(effect: Effect) -> str:
    return f"{effect.kind} at {', '.join(effect.at)}"

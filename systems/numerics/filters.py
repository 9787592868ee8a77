"""Filters between a true signal and its samples: low-passes, moving averages, delays.

All are linear, with unit gain at zero frequency, and in continuous time, so that they
can be applied to unevenly sampled signals:

    low-pass        dz_i/dt = p_i z_i + x,  y = sum_i r_i z_i   (order 1, Butterworth)
    moving average  y(t) = 1/T integral(x, t - T .. t), or centred about t
    delay           y(t) = x(t - d)

A velocity by backward differences is the moving average of the true one over a period.
Signals are linear between their samples; each low-pass is solved exactly for that.
Source: Butterworth, Wireless Engineer 7, 1930; poles as in Oppenheim and Schafer,
Discrete-Time Signal Processing, appendix B.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

ORDER_MAX = 8  # With a higher order the sum of partial fractions loses digits.


@dataclass(frozen=True)
class LowPass:
    """A Butterworth low-pass; for order 1, tau dy/dt = x - y.

    cutoff: where the gain is 1/sqrt(2) [rad/s]; 1/tau for order 1.
    """

    cutoff: float
    order: int = 1

    def __post_init__(self):
        if not (np.isfinite(self.cutoff) and self.cutoff > 0.0):
            raise ValueError(f"a cut-off is {self.cutoff} rad/s, expected more than 0")
        if not 1 <= self.order <= ORDER_MAX:
            raise ValueError(
                f"the order of a low-pass is {self.order}, expected 1 to {ORDER_MAX}"
            )

    def poles(self) -> np.ndarray:
        """(order,) complex [rad/s], in the left half plane."""
        k = np.arange(self.order)
        angle = np.pi * (2.0 * k + 1.0 + self.order) / (2.0 * self.order)
        return self.cutoff * np.exp(1j * angle)

    def residues(self) -> np.ndarray:
        """(order,) complex, of the partial fractions of the transfer function."""
        p = self.poles()
        others = p[:, None] - p[None, :]
        np.fill_diagonal(others, 1.0)
        return self.cutoff**self.order / np.prod(others, axis=1)

    def gain(self, w) -> np.ndarray:
        s = 1j * np.asarray(w, float)[..., None]
        return np.sum(self.residues() / (s - self.poles()), axis=-1)

    def mean_delay(self) -> float:
        return float(np.sum(-1.0 / self.poles()).real)

    def memory(self) -> float:
        return float(12.0 / np.abs(self.poles().real).min())  # exp(-12) = 6e-6.

    def apply(self, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        return _low_pass(t, x, self.poles(), self.residues())


@dataclass(frozen=True)
class MovingAverage:
    """The mean over the last `width` [s]; centred: over half of it on either side."""

    width: float
    centred: bool = False

    def __post_init__(self):
        if not (np.isfinite(self.width) and self.width > 0.0):
            raise ValueError(f"a mean over {self.width} s, expected more than 0")

    def gain(self, w) -> np.ndarray:
        half = 0.5 * self.width * np.asarray(w, float)
        late = 0.0 if self.centred else half
        return np.exp(-1j * late) * np.sinc(half / np.pi)

    def mean_delay(self) -> float:
        return 0.0 if self.centred else 0.5 * self.width

    def memory(self) -> float:
        return self.width

    def apply(self, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        slope = (x[1] - x[0]) / (t[1] - t[0])
        area = np.concatenate([[0.0], np.cumsum(0.5 * (x[1:] + x[:-1]) * np.diff(t))])

        def integral(at):
            k = np.clip(np.searchsorted(t, at, "right") - 1, 0, len(t) - 2)
            d = at - t[k]
            rise = (x[k + 1] - x[k]) / (t[k + 1] - t[k])
            before = at < t[0]  # The first line is extended to before the samples.
            return np.where(
                before,
                x[0] * (at - t[0]) + 0.5 * slope * (at - t[0]) ** 2,
                area[k] + x[k] * d + 0.5 * rise * d**2,
            )

        end = t + (0.5 * self.width if self.centred else 0.0)
        return (integral(end) - integral(end - self.width)) / self.width


@dataclass(frozen=True)
class Delay:
    """A delay [s]."""

    delay: float

    def __post_init__(self):
        if not (np.isfinite(self.delay) and self.delay >= 0.0):
            raise ValueError(f"a delay of {self.delay} s, expected 0 or more")

    def gain(self, w) -> np.ndarray:
        return np.exp(-1j * self.delay * np.asarray(w, float))

    def mean_delay(self) -> float:
        return self.delay

    def memory(self) -> float:
        return self.delay

    def apply(self, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        return _on_lines(t - self.delay, t, x)


Stage = LowPass | MovingAverage | Delay


def first_order(time_constant: float) -> LowPass:
    """The low-pass tau dy/dt = x - y. Args: time_constant: tau [s]."""
    if not time_constant > 0.0:
        raise ValueError(f"a time constant is {time_constant} s, expected more than 0")
    return LowPass(1.0 / time_constant)


def with_lag(stages: Sequence[Stage], lag: float) -> tuple[Stage, ...]:
    """The stages with `lag` [s] added to the time constant of the slowest first-order
    stage, or with one more stage if there is none.

    Raises: ValueError if the time constant would be negative.
    """
    if lag == 0.0:
        return tuple(stages)
    slow = [s for s in stages if isinstance(s, LowPass) and s.order == 1]
    slowest = min(slow, key=lambda s: s.cutoff, default=None)
    total = lag + (1.0 / slowest.cutoff if slowest else 0.0)
    if total < 0.0:
        raise ValueError(
            f"a time constant of {lag} s: no declared first-order filter is so slow"
        )
    stage = (first_order(total),) if total > 0.0 else ()
    if slowest is None:
        return (*stages, *stage)
    k = list(stages).index(slowest)
    return (*stages[:k], *stage, *stages[k + 1 :])


def filtered(stages: Sequence[Stage], times, samples, at=None) -> np.ndarray:
    """A signal after all stages (n,), or at other times (m,).

    Args: times (n,): increasing [s]; samples (n,): of the true signal, at least two,
        linear in between. Before the first sample the signal is the line through the
        first two, on which the filters have settled. at (m,): times of the result,
        within `times`; None: `times`.
    """
    t, y = np.asarray(times, float), np.asarray(samples, float)
    for stage in stages:
        y = stage.apply(t, y)
    return y if at is None else _on_lines(np.asarray(at, float), t, y)


def gain(stages: Sequence[Stage], w) -> np.ndarray:
    """Complex transfer function at angular frequencies w [rad/s]."""
    total = np.ones(np.shape(w), complex)
    for stage in stages:
        total = total * stage.gain(w)
    return total


def subdivided(times, longest: float) -> np.ndarray:
    """The times (n,) with more in between, so that no step is longer than `longest`
    [s]."""
    t = np.asarray(times, float)
    n = np.maximum(np.ceil(np.diff(t) / longest - 1e-6), 1.0).astype(int)
    starts, parts = np.repeat(t[:-1], n), np.repeat(np.diff(t) / n, n)
    within = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
    return np.append(starts + parts * within, t[-1])


def mean_delay(stages: Sequence[Stage]) -> float:
    """Delay of slow signals, -dH/ds at s = 0 [s]."""
    return float(sum(stage.mean_delay() for stage in stages))


def memory(stages: Sequence[Stage]) -> float:
    """Time after which earlier values have no effect [s]."""
    return float(sum(stage.memory() for stage in stages))


def _on_lines(at: np.ndarray, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    y = np.interp(at, t, x)
    slope = (x[1] - x[0]) / (t[1] - t[0])
    return np.where(at < t[0], x[0] + slope * (at - t[0]), y)


@njit(cache=True)
def _low_pass(t, x, poles, residues):
    """Exact for a piecewise linear signal: for the state z of one pole p, over a step h

    z(t + h) = e z + x0 (e - 1)/p + slope ((e - 1)/p - h)/p,   e = exp(p h).
    """
    n = len(t)
    y = np.zeros(n)
    for i in range(len(poles)):
        p, r = poles[i], residues[i]
        slope = (x[1] - x[0]) / (t[1] - t[0])
        z = -x[0] / p - slope / (p * p)  # Settled on the first line.
        y[0] += (r * z).real
        for k in range(n - 1):
            h = t[k + 1] - t[k]
            ph = p * h
            if abs(ph) < 1e-3:  # Series: the closed form would lose digits.
                a = h * (1.0 + ph * (0.5 + ph * (1.0 / 6.0 + ph / 24.0)))
                b = h * h * (0.5 + ph * (1.0 / 6.0 + ph * (1.0 / 24.0 + ph / 120.0)))
                e = 1.0 + p * a
            else:
                e = np.exp(ph)
                a = (e - 1.0) / p
                b = (a - h) / p
            z = e * z + x[k] * a + (x[k + 1] - x[k]) / h * b
            y[k + 1] += (r * z).real
    return y

"""Stamps of rows, and the clock that they scatter about."""

import numpy as np
from scipy.ndimage import median_filter
from scipy.optimize import isotonic_regression
from scipy.stats import chi2

_ROWS = 31  # Over which medians are taken.
_FEWEST = 3  # Medians in a stretch of a clock that goes at one rate.
_CHANCE = 1e-4  # Of taking a rate for changed that has not.
_LEAST = 1e-9  # Standard deviation of a median [s]: what stamps are written with.
_LOST = 0.75  # Periods by which medians of rows jump where one was lost.
_PHASE_ROWS = 32, 64, 128, 256, 512, 1024  # Whose stamps have one phase: tried.
_RATE_RANGE = 0.1  # Rates tried, about the usual one.
_TRIED_ROWS = 20000  # As many at most tell the rate.
_COHERENT = 8.0  # Deviations by which a clock's power is above that of no clock.
_SURE = 12.0  # Times that power: phases are known to 0.2 rad.


def clock_period(t: np.ndarray) -> float:
    """Period [s] of stamps (n,) that scatter: the median over many rows at a time, as
    that of single steps is off by a share of the scatter."""
    if len(t) < 3 * _ROWS:
        return float(np.median(np.diff(t)))
    return float(np.median(t[_ROWS:] - t[:-_ROWS])) / _ROWS


def even_clock(t: np.ndarray) -> np.ndarray:
    """Stamps (n,) whose scatter about an even clock is taken out; the clock may drift
    and lose rows."""
    if len(t) < 3 * _ROWS:
        return t
    k = _numbers(t)
    period = float(np.polyfit(k, t, 1)[0])
    off = t - period * k
    slow = median_filter(off, _ROWS, mode="nearest")
    spread = 1.4826 * float(np.median(np.abs(off - slow)))
    even = period * k + _drift(off, slow, spread)
    return even if (np.diff(even) > 0.2 * period).all() else t


def _numbers(t: np.ndarray) -> np.ndarray:
    """(n,) number of each row, where lost rows count."""
    usual = float(np.median(np.diff(t)))  # 0: stamps are coarser than rows.
    numbers = _numbers_by_phase(t, usual) if usual > 0.0 else None
    if numbers is not None:
        return numbers
    k, quarter = np.arange(len(t)), len(t) // 4
    period = float(np.median(t[quarter:] - t[:-quarter])) / quarter
    slow = median_filter(t - period * k, _ROWS, mode="nearest")
    half = _ROWS // 2
    jump = np.zeros(len(t))  # Of the medians of rows before and after each row.
    jump[half + 1 : -half] = (slow[2 * half + 1 :] - slow[: -2 * half - 1]) / period
    edges = np.diff((jump > _LOST).astype(int), prepend=0, append=0)
    for first, end in zip(
        np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True
    ):
        middle = (first + end) // 2
        k[middle:] += int(np.round(jump[middle]))
    return k


def _numbers_by_phase(t: np.ndarray, usual: float) -> np.ndarray | None:
    """The same from the phase of all stamps in a clock's period, which lost rows do not
    change, whatever their number. None: the stamps scatter too much to have a phase.

    Args: usual: about the period [s].
    """
    power = 0.0
    for rows in [n for n in _PHASE_ROWS if n <= len(t)]:
        first = np.append(np.arange(0, len(t) - rows, rows // 2), len(t) - rows)
        blocks = t[first[:, None] + np.arange(rows)]
        some = blocks[:: int(np.ceil(blocks.size / _TRIED_ROWS))]
        steps = int(np.ceil(4 * rows * _RATE_RANGE))
        rates = (1.0 + np.linspace(-1, 1, 2 * steps + 1) * _RATE_RANGE) / usual
        # Of stamps that follow no clock the power is 1 +- 1 / sqrt(blocks).
        powers = [rows * np.mean(np.abs(_phasors(some, rate)) ** 2) for rate in rates]
        if (max(powers) - 1.0) * np.sqrt(some.size / rows) < _COHERENT:
            continue
        if max(powers) > power:
            power, rate = max(powers), rates[np.argmax(powers)]
            turns, middles = _phasors(blocks, rate), blocks.mean(axis=1)
        if power > _SURE:
            break  # Short blocks follow a clock that wanders.
    if power == 0.0:
        return None
    number = rate * t - np.interp(t, middles, np.unwrap(np.angle(turns)) / 2.0 / np.pi)
    # Rows come in order, each one or more after the last: the closest whole numbers are
    # those of the closest real ones.
    row = np.arange(len(t))
    return row + np.round(isotonic_regression(number - row).x)


def _phasors(blocks: np.ndarray, rate: float) -> np.ndarray:
    """Means (n,) over blocks (n, rows) of stamps on the unit circle."""
    return np.exp(2j * np.pi * rate * blocks).mean(axis=1)


def _drift(off: np.ndarray, slow: np.ndarray, spread: float) -> np.ndarray:
    """How far a clock is off (n,): straight lines through medians of stamps' offsets
    off (n,), no more than these need. `slow`, a running median, where no lines do: its
    own errors go together over _ROWS rows, as long as what moves.

    Args: spread: standard deviation of single stamps [s].
    """
    n = len(off) // _ROWS
    if n < _FEWEST:
        return slow
    y = np.median(off[: n * _ROWS].reshape(n, _ROWS), axis=1)
    x = _ROWS * (np.arange(n) + 0.5)
    # The median of normal values varies 1.25 times as much as their mean.
    std = max(1.25 * spread / np.sqrt(_ROWS), _LEAST)
    knots = np.array([x[0], x[-1]])
    while True:
        heights, left = _lines(x, y / std, knots)
        where = np.clip(np.searchsorted(knots, x, "right") - 1, 0, len(knots) - 2)
        size = np.bincount(where, minlength=len(knots) - 1)
        square = np.bincount(where, left**2, minlength=len(knots) - 1)
        bent = square > chi2.isf(_CHANCE, size)
        if (size[bent] < 2 * _FEWEST).any():
            return slow
        middles = 0.5 * (knots[1:] + knots[:-1])
        for i in np.flatnonzero(~bent & (size >= 2 * _FEWEST)):
            _, then = _lines(x, y / std, np.insert(knots, i + 1, middles[i]))
            bent[i] = left @ left - then @ then > chi2.isf(_CHANCE, 1)
        if not bent.any():
            break
        knots = np.sort(np.append(knots, middles[bent]))
    heights = heights * std
    k = np.arange(len(off))
    slopes = np.diff(heights) / np.diff(knots)
    out = np.interp(k, knots, heights)
    out += slopes[0] * np.minimum(k - knots[0], 0.0)
    return out + slopes[-1] * np.maximum(k - knots[-1], 0.0)


def _lines(x: np.ndarray, y: np.ndarray, knots: np.ndarray):
    """Heights (n_knots,) of the broken line through y (n,) at x (n,), and what it
    leaves (n,)."""
    at = np.interp(x, knots, np.arange(len(knots)))
    hats = np.maximum(1.0 - np.abs(at[:, None] - np.arange(len(knots))), 0.0)
    heights = np.linalg.lstsq(hats, y, rcond=None)[0]
    return heights, y - hats @ heights

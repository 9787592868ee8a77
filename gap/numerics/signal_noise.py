"""The noise of a measured signal, estimated from the signal alone.

The k-th difference of a smooth signal sampled often is small, that of white noise is
not: its variance is binom(2k, k) times the noise's. A median makes it robust: impacts,
reversals and outliers are few.
"""

from dataclasses import dataclass
from functools import cache
from math import comb

import numpy as np
from scipy.ndimage import median_filter

_ORDERS = (2, 3, 4, 5, 6)
_MOST = 200_000  # Samples that are looked at: 0.3 % precision is plenty.
_LAGS = 40  # Over which noise may go together.
_NORMAL = 1.4826  # Standard deviation over median absolute deviation, if normal.
# Standard deviations of a second difference from which it is a jump, beside the median
# of so many.
_JUMP_Z, _JUMP_ROWS = 5.0, 7
# A jump after which a sample changes by this share of it again is the end of something
# that its samples are too far apart to show; one is new if it is so many times the step
# before it.
_TRANSIENT, _NEW = 0.15, 2.0


@dataclass(frozen=True)
class Noise:
    """What a signal's noise looks like.

    std: standard deviation [unit of the signal]. step: the signal's resolution if its
    values lie on a grid, else 0. pole: 0 if the noise is white; a filter that passes
    `x += (1 - pole) (new - x)` a sample leaves it so.
    """

    std: float
    step: float
    pole: float


def estimate_noise(values, breaks=None, times=None) -> Noise:
    """Standard deviation, resolution and colour of a signal's noise.

    A filtered channel's noise is coloured: high differences see only what the filter
    left at high frequency, so the correlation of neighbouring differences tells the
    pole of a first-order filter, and the level follows from it. A quantised channel's
    noise is at least that of its grid, step/sqrt(12), even where it stands still.

    Args:
        values: (n,) samples in order, without NaN.
        breaks: (m,) indices at which a new stretch of time begins; none if None.
        times: (n,) of the samples; even steps if None. A clock that jitters would add
            speed times jitter to the noise, if its time stamps were not used.
    """
    y = np.asarray(values, dtype=float)
    t = np.arange(len(y), dtype=float) if times is None else np.asarray(times, float)
    cuts = np.asarray([] if breaks is None else breaks, dtype=int)
    pieces = _some_of(np.split(y, cuts))
    stamps = _some_of(np.split(t, cuts))
    step = resolution(np.concatenate(pieces)) if pieces else 0.0
    found: list[tuple[float, float]] = []
    for order in _ORDERS:
        d = [
            _differences(piece, stamp, order)
            for piece, stamp in zip(pieces, stamps, strict=True)
            if len(piece) > order + 4
        ]
        if sum(map(len, d)) < 8:
            break
        pole = _pole(d, order)
        spread = _NORMAL * np.median(np.abs(np.concatenate(d)))
        share = _gain(order, pole) / comb(2 * order, order)
        found.append((float(spread / np.sqrt(share)), pole))
    std, pole = _first_settled(found)
    return Noise(max(std, float(step / np.sqrt(12.0))), step, pole)


def noise_and_jitter(values, breaks, times, noise: float) -> tuple[float, float]:
    """What stamps seem to be off by [s], and the rms noise that this makes of a
    signal's own.

    High differences of a signal with noise s0 and stamps off by s_t have the variance
    s0^2 + (rate s_t)^2: its growth with the rate tells s_t. 0 and `noise` where it does
    not grow clearly.

    Args: values, breaks, times: as estimate_noise; noise: the signal's own.
    """
    y, t = np.asarray(values, float), np.asarray(times, float)
    cuts = np.asarray([] if breaks is None else breaks, dtype=int)
    pieces = [
        (piece, stamp)
        for piece, stamp in zip(
            _some_of(np.split(y, cuts)), _some_of(np.split(t, cuts)), strict=True
        )
        if len(piece) >= 24
    ]
    if sum(len(piece) for piece, _ in pieces) < 150:
        return 0.0, noise
    # What both orders see is noise: of the motion, the higher one sees less.
    return min(
        (_jitter_of(pieces, order, noise) for order in (3, 5)), key=lambda x: x[1]
    )


def jump_variance(values, noise: float) -> np.ndarray:
    """(n,) variance of a signal's integral that its jumps make, by row [(unit row)^2]:
    at what time between two samples they were is not known.

    A jump J, taken to be in the middle of a period T, is off by J T/sqrt(12). Second
    differences show it, twice, and nothing of what is smooth. Where the signal goes on
    changing as fast after a jump, a loop that is faster than the samples made it, and
    between the two it may have been anything that it ever is: the span of all samples
    is in the place of J. (A joint's controller that answers a step gives all that it
    can for a millisecond: 45 N m, of which samples 4 ms apart showed 3 to 5.)

    Args: values (n,): NaN where there is no sample. noise: of a sample.
    """
    y = np.asarray(values, dtype=float)
    found = np.zeros(len(y))
    good = np.flatnonzero(np.isfinite(y))
    if len(good) >= 3:
        y, steps = y[good], np.diff(y[good])
        second = np.diff(steps)
        second -= median_filter(second, _JUMP_ROWS)
        clear = _JUMP_Z * noise * np.sqrt(6.0)
        is_jump = np.abs(second) > clear
        # A table may have more rows than this signal has samples.
        periods = np.gradient(good.astype(float))[1:-1]
        found[good[1:-1]] = np.where(is_jump, (periods * second) ** 2 / 24.0, 0.0)
        before, jump, after = steps[:-2], steps[1:-1], steps[2:]
        unseen = is_jump[:-1] & (np.abs(jump) > _NEW * np.abs(before))
        unseen &= np.abs(after - before) > np.maximum(_TRANSIENT * np.abs(jump), clear)
        for k in np.flatnonzero(unseen) + 1:  # Between sample k and the next.
            rows = good[k : k + 2]
            most = (np.diff(rows)[0] * np.ptp(y)) ** 2 / 24.0
            found[rows] = np.maximum(found[rows], most)
    return found


def noise_beside(parts) -> tuple[float, float]:
    """Standard deviation of a signal's noise, and how many neighbouring samples of it
    err together, from how it differs from a better known one.

    What a signal is late by, or what its gain is off by, is no noise: of the difference
    the parts along the known signal and its derivatives are taken out first. The noise
    is robust to few outliers; `together` is the sum of the autocorrelation over all
    lags, up to where it first is none.

    Args: parts: of each stretch of time the difference (n,), and the known signal with
        derivatives (n, k).
    """
    beside = np.concatenate([d for d, _ in parts])
    known = np.concatenate([x for _, x in parts])
    X = np.column_stack([np.ones(len(beside)), known])
    size = np.linalg.norm(X, axis=0)
    size[size == 0.0] = 1.0
    c = np.linalg.lstsq(X / size, beside, rcond=1e-10)[0]
    left = beside - (X / size) @ c
    std = float(_NORMAL * np.median(np.abs(left)))
    # What stands out would hide the colour of the rest.
    left = np.clip(left, -4.0 * std, 4.0 * std)
    pieces = np.split(left, np.cumsum([len(d) for d, _ in parts])[:-1])
    power = np.mean(left * left)
    together = 1.0
    for lag in range(1, _LAGS):
        pairs = [p[lag:] * p[:-lag] for p in pieces if len(p) > lag]
        rho = np.mean(np.concatenate(pairs)) / power if power > 0.0 else 0.0
        if not rho > 0.0:
            break
        together += 2.0 * float(rho)
    return std, together


def _jitter_of(pieces, order: int, noise: float) -> tuple[float, float]:
    squares, rates = [], []
    for piece, stamp in pieces:
        d = _differences(piece, stamp, order)
        # The slope over a few samples on either side of each difference's middle.
        wide = (piece[11:] - piece[:-11]) / (stamp[11:] - stamp[:-11])
        skip = (11 - order) // 2
        n = min(len(d) - skip, len(wide))
        squares.append(d[skip : skip + n] ** 2)
        rates.append(np.abs(wide[:n]))
    square, rate = np.concatenate(squares), np.concatenate(rates)
    slow, fast = rate <= np.quantile(rate, 0.3), rate >= np.quantile(rate, 0.7)
    low, high = (_NORMAL**2 * np.median(square[k]) for k in (slow, fast))
    low_rate, high_rate = (np.mean(rate[k] ** 2) for k in (slow, fast))
    if not (high > 1.5 * low and high_rate > 2.0 * low_rate):
        return 0.0, noise
    jitter = float(np.sqrt((high - low) / (high_rate - low_rate)))
    total = np.hypot(min(noise, np.sqrt(high)), jitter * np.sqrt(np.mean(rate**2)))
    return jitter, float(total)


def _differences(y: np.ndarray, t: np.ndarray, order: int) -> np.ndarray:
    """Differences that remove every polynomial of a degree below `order` at the very
    times of the samples, scaled so that white noise keeps its standard deviation."""
    n = len(y) - order
    times = [t[i : i + n] for i in range(order + 1)]
    total, power = np.zeros(n), np.zeros(n)
    for i, here in enumerate(times):
        weight = np.ones(n)
        for j, other in enumerate(times):
            if j != i:
                weight /= other - here
        total += weight * y[i : i + n]
        power += weight * weight
    return total / np.sqrt(power)


def _first_settled(found: list[tuple[float, float]]) -> tuple[float, float]:
    """The first estimate that the next order confirms; else the smallest.

    A higher order removes more of the signal, and leaves the noise's share as it is:
    what no longer falls is noise.
    """
    for (std, pole), (following, _) in zip(found, found[1:], strict=False):
        if std < 1.12 * following:
            return std, pole
    return min(found, default=(0.0, 0.0))


_NEAR = 10  # Steps between most neighbouring values of a signal that has a grid.


def resolution(values) -> float:
    """The step of the grid that all values lie on, 0 if there is none.

    A grid is believed if values come back often, or most of its points are close to
    others (so many decimals that a text was written with are no grid), and all jumps
    are multiples of the smallest: noise of double precision never does.
    """
    unique = np.unique(np.asarray(values, dtype=float))
    if len(unique) < 3:
        return 0.0
    gaps = np.diff(unique)
    # What prints as one decimal may differ in the last bits.
    gaps = gaps[gaps > 1e-9 * max(np.abs(unique).max(), 1e-300)]
    if gaps.size < 2:
        return 0.0
    step = float(gaps.min())
    counts = np.rint(gaps / step)
    if len(unique) > 0.5 * np.size(values) and np.median(counts) > _NEAR:
        return 0.0
    step = float(gaps.sum() / counts.sum())  # Averages what rounding did to each.
    return step if np.all(np.abs(gaps / step - counts) < 0.05) else 0.0


def _some_of(pieces: list[np.ndarray]) -> list[np.ndarray]:
    """The pieces; the middle part of each where they are very long together."""
    total = sum(map(len, pieces))
    if total <= _MOST:
        return pieces
    share = _MOST / total
    cut = []
    for piece in pieces:
        keep = max(int(len(piece) * share), 1)
        start = (len(piece) - keep) // 2
        cut.append(piece[start : start + keep])
    return cut


def _autocovariance(order: int, lag: int) -> float:
    """Of the order-th difference of white noise of variance 1."""
    if lag > order:
        return 0.0
    return (-1.0) ** lag * comb(2 * order, order - lag)


@cache
def _gain(order: int, pole: float, lag: int = 0) -> float:
    """Autocovariance at a lag of the order-th difference of first-order noise.

    The noise has variance 1 and autocorrelation pole^|h|.
    """
    return sum(
        _autocovariance(order, abs(k)) * pole ** abs(lag - k)
        for k in range(-order, order + 1)
    )


_POLES = np.linspace(0.0, 0.95, 50)


def _pole(differences: list[np.ndarray], order: int) -> float:
    """The pole with which neighbouring differences would correlate as they do."""
    a = np.concatenate([d[:-1] for d in differences])
    b = np.concatenate([d[1:] for d in differences])
    limit = 6.0 * _NORMAL * np.median(np.abs(a)) + 1e-300
    keep = (np.abs(a) < limit) & (np.abs(b) < limit)  # No impacts, no outliers.
    a, b = a[keep], b[keep]
    power = np.mean(a * a)
    if len(a) < 100 or not power > 0.0:
        return 0.0
    seen = np.mean(a * b) / power
    table = np.array([_gain(order, p, 1) / _gain(order, p) for p in _POLES])
    if seen > table[-5]:  # So smooth is the signal itself: this order sees no noise.
        return 0.0
    # Within four standard errors of white noise it is taken as white.
    if seen < table[0] + 4.0 * (1.0 - table[0] ** 2) / np.sqrt(len(a)):
        return 0.0
    return float(np.interp(seen, table, _POLES))

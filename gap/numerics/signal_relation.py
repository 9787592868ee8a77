"""How one measured signal follows from another: scale, bias, lag, growth of the lag.

    y(t) = scale d^k x/dt^k (t - lag) + bias,      k = 0 or 1

Both are put on one uniform clock and smoothed by one Gaussian, which leaves the
relation as it is, however wide it is; derivatives are those of the Gaussian.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

_TRUNCATE = 6.0  # Of the Gaussian, in widths: at 4 a derivative is 0.1 % too small.
_FEWEST = 40  # Samples on the clock.


@dataclass(frozen=True)
class Relation:
    """std_*: standard errors, the larger of the fit's and of the windows' scatter.

    lag_std and skew_std are infinite where there are too few windows to tell.
    """

    scale: float  # [unit of y/unit of d^k x]
    scale_std: float
    bias: float  # [unit of y]
    bias_std: float
    lag: float  # [s], positive where y comes late.
    lag_std: float
    skew: float  # [s/s], the lag's growth.
    skew_std: float
    residual: float  # rms of what is left of the smoothed y [unit of y].
    signal: float  # rms of the smoothed y about its mean.
    period: float  # [s] of the clock.

    def of_a_difference(self) -> bool:
        """Whether y is as late as a backward difference of x."""
        return abs(self.lag / self.period - 0.5) < 0.1


def relate(t_y, y, t_x, x, order=0, held=False, longest_lag=0.3, width=3.0):
    """The relation of y to the order-th derivative of x; None if it cannot be told.

    Args:
        t_y, y: (n,) times [s] and samples, without NaN. t_x, x: (m,) likewise.
        order: 0 or 1. held: x is a command that holds until its next sample.
        longest_lag: that is looked for, either way [s].
        width: standard deviation of the Gaussian, in samples.
    Returns: Relation, or None for too few samples or a signal too small to tell.
    """
    if min(len(t_y), len(t_x)) < _FEWEST:
        return None
    period = max(np.median(np.diff(t_y)), np.median(np.diff(t_x)))
    start, end = max(t_y[0], t_x[0]), min(t_y[-1], t_x[-1])
    # The clock's origin is t_y's, so that an even clock is not interpolated.
    clock = start + period * np.arange(int(np.floor((end - start) / period + 1e-6)) + 1)
    margin = int(np.ceil(_TRUNCATE * width))
    if len(clock) < _FEWEST + 2 * margin:
        return None
    ys = gaussian_filter1d(_on_clock(t_y, y, clock), width, truncate=_TRUNCATE)
    on_clock = _hold(t_x, x, clock) if held else _on_clock(t_x, x, clock)
    xs = [
        gaussian_filter1d(on_clock, width, order=k, truncate=_TRUNCATE) / period**k
        for k in (order, order + 1)
    ]
    good = _covered(t_y, clock, period) & _covered(
        t_x, clock, np.inf if held else period
    )
    good = ~_widened(~good, margin)
    good[:margin] = good[-margin:] = False
    if good.sum() < _FEWEST:
        return None
    signal = float(ys[good].std())
    if not (signal > 0.0 and xs[0][good].std() > 0.0):
        return None
    lag = period * _coarse_lag(ys, xs[0], good, int(longest_lag / period))
    curves = [CubicSpline(clock, value) for value in xs]
    fit = _fit(clock, ys, curves, good, lag, width)
    if fit is None or abs(fit[0][2]) > longest_lag + period:
        return None
    (scale, bias, lag), std, residual = fit
    lags, middles, scales = [], [], []
    for piece in np.array_split(np.flatnonzero(good), _n_windows(good.sum())):
        inside = np.zeros(len(good), dtype=bool)
        inside[piece] = True
        part = _fit(clock, ys, curves, inside, lag, width, steps=2)
        if part is not None and part[0][0] * scale > 0.0:
            lags.append((part[0][2], max(part[1][2], 1e-12)))
            scales.append(part[0][0])
            middles.append(clock[piece].mean())
    skew, skew_std, lag_std = _line(middles, lags)
    if len(scales) > 3:
        std[0] = max(std[0], np.std(scales) / np.sqrt(len(scales)))
    return Relation(
        scale=float(scale),
        scale_std=float(std[0]),
        bias=float(bias),
        bias_std=float(std[1]),
        lag=float(lag),
        lag_std=float(max(std[2], lag_std)),
        skew=skew,
        skew_std=skew_std,
        residual=residual,
        signal=signal,
        period=float(period),
    )


def angular_velocity(t, q):
    """Angular velocity between samples of an orientation, in world and in body.

    Args: t (n,) [s]; q (n, 4) unit quaternions qw qx qy qz, without jumps of sign.
    Returns: times (n-1,) in the middle of the steps, w_world, w_body (n-1, 3) [rad/s].
    """
    w, v = q[:, :1], q[:, 1:]
    # The rotation of a step: q1 conj(q0) turns about world axes, conj(q0) q1 about the
    # body's.
    real = (w[1:] * w[:-1])[:, 0] + np.sum(v[1:] * v[:-1], axis=1)
    cross = np.cross(v[:-1], v[1:])
    world = w[:-1] * v[1:] - w[1:] * v[:-1] + cross
    body = w[:-1] * v[1:] - w[1:] * v[:-1] - cross
    size = np.linalg.norm(world, axis=1)
    angle = 2.0 * np.arctan2(size, real)
    rate = np.where(size > 1e-12, angle / np.maximum(size, 1e-12), 2.0) / np.diff(t)
    return 0.5 * (t[1:] + t[:-1]), world * rate[:, None], body * rate[:, None]


def _on_clock(t, y, clock):
    if len(t) == len(clock) and np.abs(t - clock).max() < 1e-9 * (t[1] - t[0]):
        return np.array(y, dtype=float)
    return CubicSpline(t, y)(clock)


def _hold(t, x, clock):
    # A sample at the clock's very instant already counts.
    i = np.searchsorted(t, clock + 1e-9 * (t[1] - t[0]), side="right") - 1
    return np.asarray(x, dtype=float)[np.maximum(i, 0)]


def _covered(t, clock, period):
    """Where the clock is no further than 1.6 periods from a sample on either side."""
    if not np.isfinite(period):
        return np.ones(len(clock), dtype=bool)
    i = np.clip(np.searchsorted(t, clock), 1, len(t) - 1)
    return t[i] - t[i - 1] < 3.2 * period


def _widened(bad, margin):
    return np.convolve(bad, np.ones(2 * margin + 1), mode="same") > 0.5


def _coarse_lag(y, x, good, most):
    """The shift of x [samples] with which it correlates best with y, of either sign.
    Of where both are good at that shift: by the power of all, slow motion that grows
    would correlate best far off."""
    size = 1 << int(np.ceil(np.log2(2 * len(y))))
    most = min(most, len(y) // 3)
    shifts = np.arange(-most, most + 1)

    def correlated(a, b):
        product = np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size))
        return np.fft.irfft(product, size)[shifts]

    y, x = (np.where(good, z - z[good].mean(), 0.0) for z in (y, x))
    power = correlated(y * y, good) * correlated(good, x * x)
    share = np.abs(correlated(y, x)) / np.sqrt(np.maximum(power, 1e-12 * power.max()))
    return int(shifts[np.argmax(share)])


def _fit(clock, y, curves, good, lag, width, steps=8):
    """Gauss-Newton: ((scale, bias, lag), their standard errors, rms residual)."""
    t, y = clock[good], y[good]
    # A Gaussian of this width leaves so many independent samples of white noise.
    n_free = max(len(t) / (2.0 * np.sqrt(np.pi) * width) - 3.0, 2.0)
    first = lag
    for _ in range(steps):
        x, slope = (curve(t - lag) for curve in curves)
        A = np.stack([x, np.ones_like(x), -slope], axis=1)
        size = np.sqrt(np.sum(A * A, axis=0))
        if not size.all():
            return None
        solution, _, rank, _ = np.linalg.lstsq(A / size, y, rcond=1e-9)
        if rank < 3:
            return None
        scale, bias, move = solution / size
        if scale == 0.0:
            return None
        step = float(np.clip(move / scale, -0.05, 0.05))
        lag = lag + step
        if abs(lag - first) > 0.5 * (t[-1] - t[0]) or not np.isfinite(lag):
            return None
        if abs(step) < 1e-9:
            break
    r = y - A @ (solution / size)
    residual = float(np.sqrt(np.mean(r * r)))
    inverse = np.linalg.inv((A / size).T @ (A / size))
    each = residual * np.sqrt(len(t) / n_free * np.diag(inverse)) / size
    return (scale, bias, lag), [each[0], each[1], each[2] / abs(scale)], residual


def _n_windows(n):
    return int(np.clip(n // 150, 1, 16))


def _line(t, lags):
    """Slope of the windows' lags over time, its standard error, and the lag's."""
    if len(lags) < 4:
        return 0.0, np.inf, 0.0
    t, (y, std) = np.array(t), np.array(lags).T
    weight = 1.0 / np.maximum(std, 0.3 * np.median(std))
    A = np.stack([np.ones_like(t), t - t.mean()], axis=1) * weight[:, None]
    solution = np.linalg.lstsq(A, y * weight, rcond=None)[0]
    r = y * weight - A @ solution
    spread = max(np.sqrt(r @ r / (len(t) - 2)), 1.0)  # Never below what the fits say.
    covariance = np.linalg.inv(A.T @ A) * spread**2
    # A lag that grows has no single value, but it has a mean.
    return (
        float(solution[1]),
        float(np.sqrt(covariance[1, 1])),
        float(np.sqrt(covariance[0, 0])),
    )

"""From what happened to what was recorded: noise, delays, scales, lost samples."""

import numpy as np

SENSED = ("sensor_delay", "clock_skew", "sensor_bias", "length_scale")


def _matches(at, column: str) -> bool:
    """Whether a column belongs to `at`: a channel, a joint or body, or a model."""
    return any(
        column == a or column.startswith(a + ".")
        for a in ([at] if isinstance(at, str) else at)
    )


def measured(columns: dict, functions: dict, tick, effects, noise, lost, rng) -> dict:
    """The columns as measured at the ticks.

    Args:
        columns: those that are already measured exactly, such as commands.
        functions: {column: function of time -> true value}.
        tick: (n,) [s] on the clock of the commands.
        effects: those with a kind of SENSED are applied.
        noise: {column: standard deviation}. lost: share of the cells that are empty.
    """
    out = dict(columns)
    for name, true in functions.items():
        t, scale, bias = tick, 1.0, 0.0
        for effect in effects:
            if effect["kind"] not in SENSED or not _matches(effect["at"], name):
                continue
            p, quantity = effect["parameters"], name.rsplit(".", 1)[1]
            if effect["kind"] == "sensor_delay":
                t = t - p["delay"]
            elif effect["kind"] == "clock_skew":
                t = t / (1.0 + p["skew"])
            elif effect["kind"] == "sensor_bias":
                bias += p["bias"]
            elif quantity in ("x", "y", "z", "vx", "vy", "vz"):
                scale *= p["scale"]
        value = scale * true(np.clip(t, tick[0], tick[-1])) + bias
        value = value + noise.get(name, 0.0) * rng.normal(size=len(tick))
        # What was measured before the first tick is unknown.
        value = np.where(t < tick[0] - 1e-12, np.nan, value)
        if lost:
            gone = rng.uniform(size=len(tick)) < lost
            gone[:2] = False
            value = np.where(gone, np.nan, value)
        out[name] = value
    return out


def hermite(t, y, dy):
    """Cubic through values and slopes; a function of time."""
    from scipy.interpolate import CubicHermiteSpline

    return CubicHermiteSpline(t, y, dy)


def linear(t, y):
    return lambda at: np.interp(at, t, y)


def held(t, y):
    return lambda at: y[np.clip(np.searchsorted(t, at + 1e-9, "right") - 1, 0, None)]

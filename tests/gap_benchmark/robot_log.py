"""From what happened to a log as robots write them: held rows, jittering stamps, coarse
encoders, filtered velocities, noise that wanders, clocks that differ."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter, lfilter_zi

from gap_benchmark.robot_world import Track

_GRID = 0.001  # [s] of a track.


@dataclass(frozen=True)
class Filter:
    """kind: first order, Butterworth, moving average, backward difference, none.
    size: its corner [Hz], or the average's length [s]."""

    kind: str = "none"
    size: float = 0.0
    order: int = 1

    def says(self) -> str:
        """As a sidecar declares it."""
        if self.kind == "first order":
            return f"first order, {self.size:g} Hz"
        if self.kind == "Butterworth":
            return f"Butterworth of order {self.order}, {self.size:g} Hz"
        if self.kind == "moving average":
            return f"moving average, {self.size:g} s"
        return self.kind

    def delay(self) -> float:
        """Of slow signals [s]; a backward difference is half a row late beside it."""
        if self.kind == "first order":
            return 1.0 / (2 * np.pi * self.size)
        if self.kind == "Butterworth":
            poles = np.exp(1j * np.pi * (2 * np.arange(self.order) + self.order + 1)
                           / (2 * self.order))  # fmt: skip
            return float(np.sum(-1 / poles).real) / (2 * np.pi * self.size)
        return 0.5 * self.size if self.kind == "moving average" else 0.0

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """(k, n) on a grid of 1 ms, filtered, as if it had been x[0] for ever."""
        if self.kind == "first order":
            pole = np.exp(-2 * np.pi * self.size * _GRID)
            # Trapezoids: the delay is the time constant.
            b, a = np.array([0.5, 0.5]) * (1 - pole), np.array([1.0, -pole])
        elif self.kind == "Butterworth":
            b, a = butter(self.order, self.size, fs=1.0 / _GRID)
        elif self.kind == "moving average":
            n = round(self.size / _GRID)
            b, a = np.r_[0.5, np.ones(n - 1), 0.5] / n, np.ones(1)
        else:
            return x
        zi = lfilter_zi(b, a)[:, None] * x[:1] if len(a) + len(b) > 2 else None
        return lfilter(b, a, x, axis=0, zi=zi)[0]


@dataclass(frozen=True)
class Logging:
    """How a robot is logged. Noise: standard deviations of single samples, velocity's
    before its filter. wander: of the effort noise that is correlated over `memory` [s].
    quantum: of the encoders [rad, or m]. side: where effort is measured, motor or link,
    or "" if it is not. held: fraction of the rows that repeat the row before."""

    rate_hz: float = 1000.0
    jitter: float = 0.0  # [s]
    held: float = 0.0
    position_noise: float = 2e-5
    velocity_noise: float = 3e-3
    effort_noise: np.ndarray | float = 0.03
    wander: np.ndarray | float = 0.0
    memory: float = 0.2
    quantum: float = 0.0
    side: str = "motor"
    with_velocity: bool = True
    with_command: bool = False
    filter: Filter = Filter()
    skew: float = 0.0  # The clock of the measurements runs fast by this.
    delay: float = 0.0  # [s] All that is measured is late.
    effort_bias: np.ndarray | float = 0.0
    effort_gain: np.ndarray | float = 1.0  # What the motors give over what they show.


def wandering(n: int, step: float, memory: float, shape, rng) -> np.ndarray:
    """(n, *shape) of unit variance, correlation exp(-t/memory)."""
    keep = np.exp(-step / memory)
    white = rng.normal(size=(n, *shape))
    white[1:] *= np.sqrt(1 - keep**2)
    return lfilter([1.0], [1.0, -keep], white, axis=0)


def write_log(
    track: Track, joints: list[str], how: Logging, offset: np.ndarray, rng
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """The table's columns, and the noise's standard deviations by channel."""
    n = len(joints)
    spacing = round(1.0 / how.rate_hz / _GRID)
    rows = np.arange(spacing, len(track.time) - spacing, spacing)
    # What a slow clock would show at the end has not happened.
    last = track.time[-1] * (1.0 + min(how.skew, 0.0)) + min(how.delay, 0.0)
    rows = rows[track.time[rows] <= last]
    true = track.time[rows]
    stamp = true + np.clip(
        how.jitter * rng.normal(size=len(rows)), -0.45 / how.rate_hz,
        0.45 / how.rate_hz,
    )  # fmt: skip
    # What is measured now, by its own clock, was so a while ago.
    when = (true - how.delay) / (1.0 + how.skew)

    def at_rows(values):
        if how.delay or how.skew:
            return CubicSpline(track.time, values)(np.maximum(when, 0.0))
        return values[rows]

    shape = (len(rows), n)
    q = at_rows(track.q) + offset + how.position_noise * rng.normal(size=shape)
    if how.quantum:
        q = how.quantum * np.round(q / how.quantum)
    measured = {"position": q}
    noise = {"position": max(how.position_noise, how.quantum / np.sqrt(12))}
    if how.with_velocity:
        if how.filter.kind == "backward difference":
            v = np.diff(q, axis=0, prepend=q[:1]) * how.rate_hz
            v[0] = v[1]
            noise["velocity"] = np.sqrt(2.0) * noise["position"] * how.rate_hz
        else:
            raw = track.v + how.velocity_noise * rng.normal(size=track.v.shape)
            v = at_rows(how.filter(raw))
            # What a filter leaves of white noise: the energy of its impulse's response.
            impulse = np.zeros((4000, 1))
            impulse[500] = 1.0
            left = float(np.linalg.norm(how.filter(impulse)))
            noise["velocity"] = how.velocity_noise * left
        measured["velocity"] = v
    if how.side:
        u = track.motor if how.side == "motor" else track.link
        if how.side == "motor" and not how.with_command:
            # The drive renews its effort each millisecond: what it gives about an
            # instant is the mean of both, else every log would be half of one late.
            u = np.vstack([u[:1], 0.5 * (u[1:] + u[:-1])])
        u = at_rows(u) / np.asarray(how.effort_gain)
        u = u + np.asarray(how.effort_bias) + how.effort_noise * rng.normal(size=shape)
        u = u + how.wander * wandering(
            len(rows), spacing * _GRID, how.memory, (n,), rng
        )
        measured["effort_measured"] = u
    if how.held:
        for k in np.flatnonzero(rng.uniform(size=len(rows)) < how.held):
            if k:
                for values in measured.values():
                    values[k] = values[k - 1]
    columns = {"time": stamp}
    deviations = {}
    for i, joint in enumerate(joints):
        if how.with_command:
            for name, values in track.commands.items():
                columns[f"{joint}.{name}"] = values[rows, i]
        for name, values in measured.items():
            columns[f"{joint}.{name}"] = values[:, i]
            each = noise.get(name)
            if each is None:
                each = np.hypot(*(np.broadcast_to(x, n)[i] for x in
                                  (how.effort_noise, how.wander)))  # fmt: skip
            deviations[f"{joint}.{name}"] = float(each)
    return columns, deviations

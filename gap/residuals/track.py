"""One episode of a mechanism as measured: smoothed motion, commands, samples, and test
functions over it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.gap.budget import go_on
from makebreak.gap.data.filters import FILTERED_SEC
from makebreak.gap.data.recording import Episode, Recording
from makebreak.gap.numerics.weak_form import Bumps, make_bumps
from makebreak.systems.numerics.filters import Stage, mean_delay, subdivided
from makebreak.systems.numerics.smoother import smooth_filtered

FEWEST_POSITIONS = 6  # In an episode: fewer are not smoothed.
END_SEC = 0.05  # At either end of an episode little is known.
# A longer step in time is a hole: so many periods and such a share of a bump.
HOLE_PERIODS, HOLE_SHARE = 4.0, 0.1
HELD_OUT = 3  # One block of time of so many is held out.
REVERSAL_PARTS = 8  # In which an interval is cut where a joint reverses.
# Where less than this share of the usual samples is there, a mean is nothing.
LEAST_THERE = 0.3


@dataclass(frozen=True, eq=False)
class Track:
    """One episode as measured. Rows: the table's; middles: of the intervals between.

    q, v, vd: smoothed positions on `grid` (rows and middles), (n_grid, n_v).
    """

    recording: str
    episode: int
    time: np.ndarray  # (n,) [s]
    middle: np.ndarray  # (n_mid,) Where the equations are evaluated [s].
    step: np.ndarray  # (n_mid,) How long each of these stands for [s].
    row: np.ndarray  # (n_mid,) Whose command holds there.
    grid: np.ndarray
    dense: np.ndarray  # (n_dense,) [s] The grid, for signals before a filter.
    q: np.ndarray
    v: np.ndarray
    vd: np.ndarray
    commands: dict[str, np.ndarray]  # Held, (n,).
    samples: dict[str, np.ndarray]  # Measured, (n,), NaN where missing.
    stages: dict[str, tuple[Stage, ...]]  # Declared filters of measured channels.
    bumps: Bumps  # On the middles.
    row_bumps: Bumps  # On the rows.
    block: np.ndarray  # (n_bumps,) Number of the block of time.
    train: np.ndarray  # (n_bumps,)

    def at(self, i: int, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, v, vd (n,) of joint i at any times (n,), as cubics between the grid's."""
        grid = self.grid
        k = np.clip(np.searchsorted(grid, t, "right") - 1, 0, len(grid) - 2)
        h = grid[k + 1] - grid[k]
        s = np.clip((t - grid[k]) / h, 0.0, 1.0)
        a, b = self.vd[k, i], self.vd[k + 1, i]
        d = s * h
        vd = a + (b - a) * s
        v = self.v[k, i] + a * d + 0.5 * (b - a) / h * d**2
        q = self.q[k, i] + self.v[k, i] * d + 0.5 * a * d**2 + (b - a) / h * d**3 / 6
        return q, v, vd

    def motion_at_middles(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, v, vd (n_mid, n_v)."""
        each = [self.at(i, self.middle) for i in range(self.q.shape[1])]
        q, v, vd = (np.stack(x, axis=1) for x in zip(*each, strict=True))
        return q, v, vd

    def mean_held(self, command: np.ndarray, delay: float) -> np.ndarray:
        """(n_mid,) mean over each interval of a command that arrives late."""
        u = np.where(np.isfinite(command), command, 0.0)[self.row]
        if delay == 0.0:
            return u
        edges = np.append(self.time[0], self.time[0] + np.cumsum(self.step))
        total = np.concatenate([[0.0], np.cumsum(u * self.step)])
        # Before the first command: that command.
        at = edges - delay
        value = np.interp(at, edges, total) + np.minimum(at - edges[0], 0.0) * u[0]
        return np.diff(value) / self.step

    def mean_over_rows(self, difference: np.ndarray) -> np.ndarray:
        """(n_bumps,) means of what is there of (n,); 0 where next to nothing is, beside
        what that channel usually has: it may be slower than the table."""
        good = np.isfinite(difference)
        weight = self.row_bumps.mean(good.astype(float))
        total = self.row_bumps.mean(np.where(good, difference, 0.0))
        least = LEAST_THERE * max(float(np.median(weight)), 1e-9)
        return np.where(weight > least, total / np.maximum(weight, least), 0.0)

    def spacing(self, channels: Sequence[str]) -> float:
        """Usual time between samples [s] of the slowest of the channels."""
        steps = [
            np.median(np.diff(self.time[np.isfinite(self.samples[c])]))
            for c in channels
            if np.isfinite(self.samples[c]).sum() > 1
        ]
        return float(max(steps, default=np.median(np.diff(self.time))))


def track_of(
    recording: Recording,
    episode: Episode,
    joints: Sequence[str],
    noise: np.ndarray,
    bump_sec: float,
    block_sec: float,
) -> Track | None:
    """An episode as a track; None if it is too short.

    Args: joints (n_v names), in the order of coordinates; noise (n_v,) of their
        positions; bump_sec, block_sec as of InverseModel.
    """
    time = recording.time[episode.rows]
    if time[-1] - time[0] < 2.0 * bump_sec:
        return None
    period = float(np.median(np.diff(time)))
    step = np.append(np.diff(time), period)
    smoothed = _smoothed(recording, episode, joints, noise, time, time + 0.5 * step)
    if smoothed is None:
        return None
    grid, q, v, vd, v_std = smoothed
    held = {c.name: recording.held(c.name)[episode.rows] for c in recording.commands()}
    samples = {c.name: c.values[episode.rows] for c in recording.measured()}
    stages = {c.name: c.stages or () for c in recording.measured()}
    late = max(mean_delay(stages[f"{j}.position"]) for j in joints)
    longest = max(HOLE_PERIODS * period, HOLE_SHARE * bump_sec)
    holes = _holes(time, step, longest, held, late)
    edges = _around_reversals(time, step, grid, v, v_std)
    row = np.searchsorted(time, edges[:-1] + 1e-12, "right") - 1
    middle, step = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    bumps = make_bumps(middle, step, bump_sec, 0.5 * bump_sec, holes)
    about = np.append(np.diff(time, prepend=time[0])[1:], period)
    row_bumps = make_bumps(time, about, bump_sec, 0.5 * bump_sec, holes)
    m = min(len(bumps.centre), len(row_bumps.centre))
    if m < 2:
        return None
    bumps, row_bumps = _first(bumps, m), _first(row_bumps, m)
    block = ((bumps.centre - time[0]) / block_sec).astype(int)
    return Track(
        recording.name, episode.number, time, middle, step, row, grid,
        subdivided(grid, FILTERED_SEC), q, v, vd, held, samples, stages,
        bumps, row_bumps, block, block % HELD_OUT != 1,
    )  # fmt: skip


def _smoothed(recording, episode, joints, noise, time, middle):
    """The grid of rows and middles, and q, v, vd (n_grid, n_v) on it, and standard
    deviations of v; None where a joint has too few samples."""
    grid = np.concatenate([time, middle])
    order = np.argsort(grid)
    grid = grid[order]
    q, v, vd, std = (np.empty((len(grid), len(joints))) for _ in range(4))
    for i, joint in enumerate(joints):
        y = recording[f"{joint}.position"][episode.rows]
        if np.isfinite(y).sum() < FEWEST_POSITIONS:
            return None
        seen = np.concatenate([y, np.full(len(time), np.nan)])[order]
        stages = recording.channels[f"{joint}.position"].stages or ()
        go_on()
        found = smooth_filtered(grid, seen, noise[i], stages)
        q[:, i], v[:, i], vd[:, i] = found.x.T
        std[:, i] = np.sqrt(np.maximum(found.P[:, 1, 1], 0.0))
    return grid, q, v, vd, std


def _holes(time, step, longest, held, late) -> list[tuple[float, float]]:
    """Spans [s] in which no test function may be: nothing is known before the first
    command and in a step longer than `longest`, and little at the ends."""
    known = np.ones(len(time), bool)
    for value in held.values():
        known &= np.isfinite(value)
    unknown = [*np.flatnonzero(~known), *np.flatnonzero(step > longest)]
    holes = [(time[k], time[k] + step[k]) for k in unknown]
    holes.append((time[0] - 1.0, time[0] + END_SEC))
    holes.append((time[-1] - END_SEC - late, time[-1] + 1.0))
    return holes


def _around_reversals(time, step, grid, v, v_std) -> np.ndarray:
    """Edges of intervals: the rows' own, in parts where a joint reverses, so that
    the instant at which friction turns round is known well. (Not of a joint that is so
    slow that noise does not tell in which interval that is.)"""
    edges = np.append(time, time[-1] + step[-1])
    speed, std = (
        np.stack([np.interp(edges, grid, each) for each in x.T], axis=1)
        for x in (v, v_std)
    )
    turns = np.sign(speed[1:]) != np.sign(speed[:-1])
    turns &= np.abs(np.diff(speed, axis=0)) > std[1:]
    turns = turns.any(axis=1)
    turns |= np.append(turns[1:], False) | np.append(False, turns[:-1])
    parts = [
        edges[k]
        + (edges[k + 1] - edges[k]) * np.arange(REVERSAL_PARTS) / REVERSAL_PARTS
        for k in np.flatnonzero(turns)
    ]
    return np.unique(np.concatenate([edges, *parts]))


def _first(bumps: Bumps, m: int) -> Bumps:
    return Bumps(bumps.w[:m], bumps.dw[:m], bumps.centre[:m], bumps.width)

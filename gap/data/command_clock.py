"""When commands changed that a slower or uneven table shows only at its next row.

A loop at 200 Hz in a table of 500 Hz changes its commands 2 or 3 rows apart, and each
change is seen up to a row late. Where all changes fit one even clock between the rows
at which they were not there yet and those at which they were, they happened at its
ticks, and get rows of their own there.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linprog

from makebreak.gap.data.findings import Finding
from makebreak.gap.data.recording import Episode, Recording

FEWEST = 20  # Changes that tell a clock.
SLACK = 0.05  # Of a row: by how much stamps may be off.
MOVED = 0.05  # Of a row: what is less, on average, needs no rows.
# Commands that change in so many of the rows, and come within so much of half a row
# sooner than these, are samples of a faster loop; in steps no shorter than this [s].
EACH_ROW, HALF_WAY, STEP_SEC = 0.5, 0.2, 0.002
LONGEST = 1.5  # Rows in which a command goes to its next sample: there is one missing.
_OFF = 0.004  # Share by which the mean between changes may be off a period.
_FARTHER = 1.25  # Times as far ticks are counted at a time.
_AT_FIRST = 200  # Changes of which ticks are counted at first.


def on_command_clock(recording: Recording) -> tuple[Recording, list[Finding]]:
    """The recording with a row at each instant at which a command changed between rows,
    and what was done."""
    commands = recording.commands()
    quantities = dict.fromkeys(c.quantity for c in commands)
    one, found = _on_clock_of(recording, [c.name for c in commands])
    if found or len(quantities) < 2:
        return one, found
    for each in quantities:  # They may have a clock each.
        names = [c.name for c in commands if c.quantity == each]
        recording, more = _on_clock_of(recording, names)
        found += more
    return recording, found


def _on_clock_of(
    recording: Recording, names: Sequence[str]
) -> tuple[Recording, list[Finding]]:
    """The same of commands that change together."""
    instants = [_instants(recording, e, names) for e in recording.episodes]
    known = [x for x in instants if x is not None]
    row = recording.period_sec()
    late = np.concatenate([np.zeros(0), *(at - sooner for at, sooner, _ in known)])
    if not np.sum(late) > MOVED * row * len(late):
        return recording, []
    period = float(np.median(np.concatenate([np.diff(t) for _, t, _ in known])))
    says = (
        f"The commands of {recording.path.name} change every {1e3 * period:.4g} ms or "
        f"a multiple of it, and its rows, {1e3 * row:.3g} ms apart, show that up to "
        f"{1e3 * late.max():.2g} ms late: they get rows of their own."
    )
    name = recording.name
    finding = Finding("command_clock", name, "time", period, "s", "info", says)
    return _with_rows(recording, names, instants), [finding]


def moved_sooner(recordings: Sequence[Recording], early: float) -> list[Recording]:
    """The recordings with positions and velocities commanded so much sooner [s]. Those
    of a loop that is p times as fast as the rows come (p - 1)/(2 p) of a row sooner
    than if they held for it: they go from sample to sample in p steps."""
    return [_sooner(r, early) for r in recordings]


def in_lines(recording: Recording) -> Recording:
    """With position and velocity commands that go from row to row in small steps."""
    row = recording.period_sec()
    return _sooner(recording, 0.5 * row, max(round(row / STEP_SEC), 1))


def _sooner(r: Recording, early: float, parts: int | None = None) -> Recording:
    names = [c.name for c in r.commands() if c.quantity != "effort_command"]
    row = r.period_sec()
    changed = [_changed(r, episode, names) for episode in r.episodes]
    apart = np.concatenate([np.full(1, np.inf), *(np.diff(k) for k in changed)])
    share = early / row
    if parts is None and np.mean(apart == 1) > EACH_ROW and abs(share - 0.5) < HALF_WAY:
        faster = 1.0 / max(1.0 - 2.0 * share, 1e-6)
        parts = round(min(faster, row / STEP_SEC))
    parts = max(parts or 1, 1)
    # The first of the steps from one sample to the next comes with the loop's period.
    off = early - 0.5 * row * (1.0 - 1.0 / parts)
    steps = np.arange(1, parts + 1) / parts
    instants = []
    for episode, k in zip(r.episodes, changed, strict=True):
        time = r.time[episode.rows]
        since = np.minimum(time[k] - time[k - 1], LONGEST * row)
        sooner = time[k, None] - since[:, None] * (1.0 - steps) - off
        instants.append((np.repeat(time[k], parts), sooner.ravel(),
                         np.tile(steps, len(k))))  # fmt: skip
    return _with_rows(r, names, instants)


def ticks(before: np.ndarray, after: np.ndarray) -> np.ndarray | None:
    """The latest ticks (n,) of an even clock, one in each interval (before, after] (n,)
    [s]; None if there is no such clock. Ticks at which nothing changed are allowed."""
    if len(after) < FEWEST:
        return None
    row = float(np.median(after - before))
    gap = np.diff(after)
    usual = float(np.median(gap))
    period = float(np.mean(gap[np.abs(gap - usual) < 1.01 * row]))
    # Ticks are counted a little farther at a time, as far as a period is known: between
    # two changes there may be a pause, and of a period little above the rows' a gap of
    # two rows may be one tick.
    some, start = min(_AT_FIRST, len(after)), before[0]
    period, phase = _rough(before[:some] - start, after[:some] - start, period)
    while True:
        if not period > row * (1.0 + SLACK):  # As fast as the rows: nothing shows.
            return None
        middle = 0.5 * (before + after)[:some] - start
        k = np.round((middle - phase) / period)
        # phase + period k <= after + slack, >= before - slack, with the least slack.
        one = np.ones(some)
        A = np.block([[one[:, None], k[:, None], -one[:, None]],
                      [-one[:, None], -k[:, None], -one[:, None]]])  # fmt: skip
        b = np.concatenate([after[:some] - start, start - before[:some]])
        free = [(None, None), (0.0, None)]
        tight = linprog([0.0, 0.0, 1.0], A, b, bounds=[*free, (-row, None)])
        if tight.status != 0 or tight.x[2] > SLACK * row:
            return None
        if some == len(after):
            break
        phase, period = tight.x[:2]
        farther = start + _FARTHER * (after[some - 1] - start)
        some = max(int(np.searchsorted(after, farther)), some + 1)
    if (np.diff(k) < 0.5).any():
        return None
    slack = max(tight.x[2], 0.0) + 1e-6 * row
    latest = linprog([-some, -k.sum(), 0.0], A, b, bounds=[*free, (slack, slack)])
    if latest.status != 0:
        return None
    return np.minimum(start + latest.x[0] + latest.x[1] * k, after)


def _rough(before: np.ndarray, after: np.ndarray, period: float) -> tuple[float, float]:
    """Period and phase of a clock near a period that has a tick in most intervals; the
    middle of those that have it in as many."""
    periods = period * (1.0 + np.linspace(-_OFF, _OFF, 41))
    phases = np.linspace(0.0, 1.0, 60, endpoint=False)
    p, turn = (x.ravel() for x in np.meshgrid(periods, phases, indexing="ij"))
    off = 0.5 * (before + after) / p[:, None] - turn[:, None]
    off = np.abs(off - np.round(off)) * p[:, None]
    hits = np.sum(off <= (0.5 + SLACK) * (after - before), axis=1)
    best = hits == hits.max()
    centre = np.angle(np.sum(np.exp(2j * np.pi * turn[best]))) / (2.0 * np.pi)
    off = np.abs(turn[best] - centre - np.round(turn[best] - centre))
    k = np.flatnonzero(best)[np.argmin(off + np.abs(p[best] / p[best].mean() - 1.0))]
    return float(p[k]), float(turn[k] * p[k])


def changes(held: np.ndarray) -> np.ndarray:
    """(n,) whether a command (n,), NaN before its first value, is another one than in
    the row before."""
    before = np.concatenate([[np.nan], held[:-1]])
    return np.isfinite(held) & (held != before)


def _instants(recording: Recording, episode: Episode, names: Sequence[str]):
    """(the rows' times at which commands changed, when they did, and which share of the
    change they did) (n,) each; None where that is not known better."""
    time = recording.time[episode.rows]
    if not names or len(time) < 3:
        return None
    changed = _changed(recording, episode, names)
    found = ticks(time[changed - 1], time[changed])
    return None if found is None else (time[changed], found, np.ones(len(found)))


def _changed(recording: Recording, episode: Episode, names: Sequence[str]):
    """The rows of an episode, but its first, in which one of these commands changed."""
    each = [changes(recording.held(name)[episode.rows]) for name in names]
    return 1 + np.flatnonzero(np.any(each, axis=0)[1:])


def _with_rows(recording: Recording, names: Sequence[str], instants) -> Recording:
    """The recording with rows of these commands alone at the instants at which they
    changed, or a share of a change was done."""
    times, rows, told, shares, episodes, own = [], [], [], [], [], []
    first = 0
    for episode, found in zip(recording.episodes, instants, strict=True):
        time = recording.time[episode.rows]
        at, sooner, share = (np.zeros(0),) * 3 if found is None else found
        new = at - sooner > 1e-6 * recording.period_sec()
        every = np.concatenate([time, sooner[new]])
        changed = np.searchsorted(time, at)
        shown = np.concatenate([np.arange(len(time)), changed[new]])
        order = np.argsort(every, kind="stable")
        times.append(every[order])
        rows.append(episode.first + shown[order])
        # The row whose commands act then: of the last change that has come, if any has.
        last = np.searchsorted(sooner, every[order], "right")
        told.append(
            episode.first + np.append(0, changed)[last] if len(at) else rows[-1]
        )
        shares.append(np.append(1.0, share)[last])
        own.append(order < len(time))
        episodes.append(replace(episode, first=first, last=first + len(every)))
        first += len(every)
    shown, measured, acts, done = map(np.concatenate, (rows, own, told, shares))
    moved = {}
    for name, channel in recording.channels.items():
        if name in names:
            held = recording.held(name)
            values = held[acts]
            part = done < 1.0
            values[part] += (1.0 - done[part]) * (held[acts[part] - 1] - values[part])
        else:
            values = np.where(measured, channel.values[shown], np.nan)
        values.setflags(write=False)
        moved[name] = replace(channel, values=values)
    return replace(
        recording, time=np.concatenate(times), row=recording.row[shown],
        episodes=tuple(episodes), channels=moved, raw_period_sec=recording.period_sec(),
    )  # fmt: skip

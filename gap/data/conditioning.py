"""What is done to a recording before anything is fitted, and what is said of it.

Logs of real robots repeat rows, stamp them when they arrive, and are written faster
than anything moves. Held samples are taken out, stamps are replaced by an even clock
where the samples fit that better, and fast logs are averaged over blocks of time. What
averaging does to a signal joins the channel's filters, so that it is simulated like a
declared one.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from makebreak.gap.data.channel_noise import with_noise
from makebreak.gap.data.clock import clock_period, even_clock
from makebreak.gap.data.command_clock import changes, on_command_clock
from makebreak.gap.data.effort_loops import OF_LOOP
from makebreak.gap.data.filters import FILTERED_SEC
from makebreak.gap.data.findings import Finding
from makebreak.gap.data.recording import Channel, Episode, Recording, unit_of
from makebreak.gap.numerics.signal_noise import (
    estimate_noise,
    noise_and_jitter,
    noise_beside,
)
from makebreak.systems.numerics.filters import MovingAverage, filtered, subdivided
from makebreak.systems.numerics.smoother import smooth_filtered

# Blocks are no shorter than this, hold at least so many rows, and are so many times
# shorter than a period of the fastest motion.
BLOCK_SEC, BLOCK_ROWS, PER_PERIOD = 0.01, 4, 10.0
BAND_SHARE = 0.99  # Of the acceleration's power, that lies below the fastest motion.
RARE = 0.5  # A command that changes in a smaller share of the rows keeps its own.
HELD_SHARE = 2e-3  # Fewer repeated rows are chance, or rest.
LONGEST_HOLD_SEC = 0.05  # What stays the same for longer stands still.
ENDS_SEC = 0.2  # Of an episode, where rates are not known well.
EVEN_GAIN = 0.85  # An even clock must leave so much less noise.


def condition(
    recordings: Iterable[Recording], average: bool = True
) -> tuple[list[Recording], list[Finding]]:
    """The recordings as they are compared, and what was done to them.

    Args: average: whether fast logs may be averaged; not where things hit each other.
    """
    out, found = [], []
    for recording in recordings:
        for step in (
            _without_held, _on_even_clock, on_command_clock, _averaged, _with_jitter,
            _beside_positions,
        ):  # fmt: skip
            if step is _averaged and not average:
                continue
            recording, findings = step(recording)
            found += findings
        out.append(recording)
    return out, found


# ----- Held samples


def _without_held(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Samples that repeat the one before, because no new one had come, are missing."""
    measured = recording.measured()
    held = {c.name: _repeats(recording, c) for c in measured}
    there = {c.name: np.isfinite(c.values) for c in measured}
    rows = np.ones(len(recording.time), bool)
    chance = 1.0
    for name, repeats in held.items():
        rows &= repeats | ~there[name]
        chance *= float(repeats.sum()) / max(int(there[name].sum()), 1)
    rows &= np.any(list(there.values()), axis=0)
    share = float(rows.mean())
    # On grids, values repeat by chance; independently of each other.
    found = []
    if not (share > HELD_SHARE and share > 3.0 * chance and len(measured) > 1):
        rows[:] = False
    else:
        says = (
            f"{rows.sum()} rows of {recording.path.name} ({share:.1%}) repeat what was "
            "measured in the row before; they are left out."
        )
        found.append(
            Finding("rows_held", recording.name, "time", share, "share", "info", says)
        )
    channels = dict(recording.channels)
    for channel in measured:
        gone = rows & there[channel.name]
        own = held[channel.name] & ~rows
        # Values off any grid never repeat by chance.
        part = float(own.sum()) / max(int(there[channel.name].sum()), 1)
        if channel.step == 0.0 and 0.01 < part < 0.98:
            gone |= own
            rate = channel.rate_hz * (1.0 - part)
            says = (
                f"{channel.name} repeats its last value in {part:.0%} of its samples, "
                f"as if it came at {rate:.3g} Hz; these are left out."
            )
            name = channel.name
            found.append(
                Finding("samples_held", recording.name, name, part, "share", "info",
                        says)
            )  # fmt: skip
        if gone.any():
            values = np.where(gone, np.nan, channel.values)
            values.setflags(write=False)
            channels[channel.name] = replace(channel, values=values)
    if not found:
        return recording, []
    return with_noise(replace(recording, channels=channels)), found


def _repeats(recording: Recording, channel: Channel) -> np.ndarray:
    """(n,) whether a sample equals the one before it, in runs that are no rest."""
    out = np.zeros(len(recording.time), bool)
    for episode in recording.episodes:
        rows = np.flatnonzero(np.isfinite(channel.values[episode.rows]))
        rows = rows + episode.first
        y, t = channel.values[rows], recording.time[rows]
        same = np.diff(y, prepend=np.nan) == 0.0
        starts = np.flatnonzero(np.diff(same.astype(int), prepend=0) == 1)
        ends = np.flatnonzero(np.diff(same.astype(int), append=0) == -1) + 1
        for i, j in zip(starts, ends, strict=True):
            if t[j - 1] - t[i - 1] > LONGEST_HOLD_SEC and j - i > 20:
                same[i:j] = False
        out[rows[same]] = True
    return out


# ----- Stamps


def _on_even_clock(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Stamps of an even clock, where the samples fit those better."""
    stamps = [recording.time[e.rows] for e in recording.episodes]
    period = float(np.median([clock_period(t) for t in stamps]))
    even = np.array(recording.time)
    for episode, t in zip(recording.episodes, stamps, strict=True):
        even[episode.rows] = even_clock(t)
    off = float(np.std(even - recording.time))
    positions = [
        c for c in recording.measured()
        if c.quantity in ("position", *"xyz") and np.ptp(_there(c)) > 0.0
    ]  # fmt: skip
    if off < 0.02 * period or not positions:
        return recording, []
    ratios = [
        _noise(recording, c, even) / max(_noise(recording, c, recording.time), 1e-300)
        for c in positions
    ]
    if np.median(ratios) > EVEN_GAIN:
        return recording, []
    even.setflags(write=False)
    says = (
        f"The stamps of {recording.path.name} scatter by {off * 1e3:.2g} ms about an "
        f"even clock of {period * 1e3:.4g} ms, and the samples fit that clock better "
        f"(noise {np.median(ratios):.2g} times): it is used."
    )
    finding = Finding("even_clock", recording.name, "time", off, "s", "info", says)
    return with_noise(replace(recording, time=even)), [finding]


def _there(channel: Channel) -> np.ndarray:
    return channel.values[np.isfinite(channel.values)]


def _noise(recording: Recording, channel: Channel, time: np.ndarray) -> float:
    values, stamps, breaks = _samples(recording, channel, time)
    return estimate_noise(values, breaks, stamps).std


def _samples(recording: Recording, channel: Channel, time: np.ndarray):
    """Values and stamps of all samples, and where episodes begin."""
    rows = [
        np.flatnonzero(np.isfinite(channel.values[e.rows])) + e.first
        for e in recording.episodes
    ]
    every = np.concatenate(rows)
    return channel.values[every], time[every], np.cumsum([len(r) for r in rows])[:-1]


# ----- Averages


def _averaged(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Means over blocks of time, of a log that is much faster than its motion.

    Commands get the row of their block's start, from which they hold, and measured
    channels that of its middle. Slower channels keep their own rows, commands of loops
    those at which they change.
    """
    period = recording.period_sec()
    fastest = max(
        (_fastest(recording, c) for c in recording.measured()
         if c.quantity in ("position", *"xyz")),
        default=0.0,
    )  # fmt: skip
    length = BLOCK_SEC
    if fastest > 0.0:
        length = min(BLOCK_SEC, 1.0 / (PER_PERIOD * fastest))
    n = round(length / period)
    if n < BLOCK_ROWS or not recording.measured():
        return recording, []
    length = n * period
    fast = {c.name for c in recording.measured() if c.rate_hz * length > 1.9}
    if not fast:
        return recording, []
    parts = [_blocks(recording, e, length, fast) for e in recording.episodes]
    parts = [p for p in parts if len(p["time"]) >= 4]
    if not parts:
        return recording, []
    ends = np.cumsum([len(p["time"]) for p in parts])
    kept = [e for e in recording.episodes if _n_blocks(recording, e, length) >= 2]
    episodes = tuple(
        Episode(e.number, int(end) - len(p["time"]), int(end), e.stretch)
        for e, p, end in zip(kept, parts, ends, strict=True)
    )
    columns = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    _unit_quaternions(columns)
    for value in columns.values():
        value.setflags(write=False)
    centred = MovingAverage(length, centred=True)
    channels = {}
    for name, channel in recording.channels.items():
        channel = replace(channel, values=columns[name])
        if name in fast:
            channel = replace(
                channel,
                stages=(*(channel.stages or ()), centred),
                averaged=channel.rate_hz * length,
            )
        channels[name] = channel
    averaged = replace(
        recording, time=columns["time"], row=columns["row"].astype(int),
        episodes=episodes, channels=channels, raw_period_sec=period,
    )  # fmt: skip
    says = (
        f"{recording.path.name} has a row every {period * 1e3:.3g} ms; the motion "
        f"(99 % of its acceleration below {fastest:.2g} Hz) needs no more than one in "
        f"{length * 1e3:.3g} ms: means over so long are compared."
    )
    finding = Finding("averaged", recording.name, "time", length, "s", "info", says)
    return with_noise(averaged), [finding]


def _fastest(recording: Recording, channel: Channel) -> float:
    """Frequency [Hz] below which most of the acceleration's power lies that is more
    than noise; 0 where nothing moves."""
    found = 0.0
    for episode in recording.episodes[:20]:
        t, y = recording.samples(channel.name, episode)
        if len(t) < 64:
            continue
        h = float(np.median(np.diff(t)))
        clock = np.arange(t[0], t[-1], h)
        x = np.interp(clock, t, y)
        x = (x - x.mean()) * np.hanning(len(x))
        w = 2.0 * np.pi * np.fft.rfftfreq(len(x), h)
        power = np.abs(np.fft.rfft(x)) ** 2
        white = channel.noise**2 * float(np.sum(np.hanning(len(x)) ** 2))
        # Smoothed over neighbours: one line of noise alone is no motion.
        power = np.convolve(power, np.ones(9) / 9.0, mode="same")
        # Filled holes make more noise than that of single samples.
        white = max(white, float(np.median(power[len(power) // 2 :])))
        above = power > 4.0 * white
        last = int(np.argmin(above)) if not above.all() else len(above)
        motion = np.where(np.arange(len(w)) < last, power - white, 0.0) * w**4
        total = np.cumsum(motion)
        if last and total[-1] > 0.0:
            k = int(np.searchsorted(total, BAND_SHARE * total[-1]))
            found = max(found, float(w[k] / (2.0 * np.pi)))
    return found


def _n_blocks(recording: Recording, episode: Episode, length: float) -> int:
    t = recording.time[episode.rows]
    return int((t[-1] - t[0]) / length + 1e-6)


def _blocks(recording: Recording, episode: Episode, length: float, fast):
    """The table of one episode: block starts, block middles and slow channels' rows."""
    n = _n_blocks(recording, episode, length)
    if n < 2:
        return {"time": np.zeros(0)}
    time = recording.time[episode.rows]
    starts = time[0] + length * np.arange(n)
    # Of the samples: what is on a line through them elsewhere is off by what repeats
    # in every block, as with each new command.
    middles = starts + 0.5 * (length - recording.period_sec())
    block = np.minimum(((time - time[0]) / length + 1e-6).astype(int), n)
    slow = [
        c for c in recording.measured() if c.name not in fast
    ]  # Each at its own stamps.
    held = {c.name: recording.held(c.name)[episode.rows] for c in recording.commands()}
    changed = {name: changes(x) & (block < n) for name, x in held.items()}
    # (What an effort does follows from its mean; a loop's gains would seem smaller.)
    rare = {
        name for name, x in changed.items()
        if np.mean(x) < RARE and not name.endswith(".effort_command")
    }  # fmt: skip
    rows = [middles, *([starts] if len(rare) < len(held) else [])]
    rows += [time[changed[name]] for name in rare]
    for channel in slow:
        rows.append(time[np.isfinite(channel.values[episode.rows]) & (block < n)])
    every = np.unique(np.concatenate(rows))
    at_start, at_middle = (np.searchsorted(every, x) for x in (starts, middles))
    first = np.searchsorted(time, every, "right") - 1
    out = {"time": every, "row": recording.row[episode.rows][np.maximum(first, 0)]}
    for name, channel in recording.channels.items():
        y, column = channel.values[episode.rows], np.full(len(every), np.nan)
        if name in rare:
            at = changed[name]
            column[np.searchsorted(every, time[at])] = held[name][at]
        elif channel.is_command:
            column[at_start] = _mean_of_held(time, held[name], starts, length)
        elif name in fast:
            there = np.isfinite(y) & (block < n)
            column[at_middle] = _mean_at_middle(
                time[there], y[there], block[there], middles, length
            )
        else:
            there = np.isfinite(y) & (block < n)
            column[np.searchsorted(every, time[there])] = y[there]
        out[name] = column
    return out


def _mean_of_held(time, held, starts, length) -> np.ndarray:
    """(n,) means over blocks of what holds from each row until the next; NaN before the
    first command."""
    known = np.isfinite(held)
    edges = np.append(time, time[-1] + length)
    area = np.concatenate(
        [[0.0], np.cumsum(np.where(known, held, 0.0) * np.diff(edges))]
    )
    total = np.interp(starts + length, edges, area) - np.interp(starts, edges, area)
    first = time[int(np.argmax(known))] if known.any() else np.inf
    return np.where(starts >= first - 1e-9, total / length, np.nan)


def _mean_at_middle(time, y, block, middles, length) -> np.ndarray:
    """(n,) the line through each block's samples, at its middle: where samples are
    missing on one side, their mean would be that of another time."""
    n = len(middles)
    count = np.bincount(block, minlength=n).astype(float)
    s = time - middles[block]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, centre = (np.bincount(block, x, n) / count for x in (y, s))
        spread = np.bincount(block, (s - centre[block]) ** 2, n)
        cross = np.bincount(block, (s - centre[block]) * (y - mean[block]), n)
        out = mean - np.where(spread > 0.0, cross / spread, 0.0) * centre
    usual = np.median(count[count > 0]) if (count > 0).any() else 1.0
    enough = (count >= max(0.4 * usual, 1.0)) & (np.abs(centre) < 0.3 * length)
    return np.where(enough, out, np.nan)


def _unit_quaternions(columns: dict[str, np.ndarray]) -> None:
    for name in [c for c in columns if c.endswith(".qw")]:
        parts = [f"{name[:-3]}.{q}" for q in ("qw", "qx", "qy", "qz")]
        size = np.sqrt(sum(columns[p] ** 2 for p in parts))
        for p in parts:
            columns[p] = columns[p] / size


# ----- Jitter


def _with_jitter(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Noise that includes what stamps are off by, times how fast a channel changes."""
    channels, found = dict(recording.channels), []
    for channel in recording.measured():
        values, stamps, breaks = _samples(recording, channel, recording.time)
        # A coarse grid shows its steps where a channel moves, and none at rest.
        coarse = channel.step / np.sqrt(12.0) > 0.5 * channel.noise
        if len(values) < 200 or coarse or channel.noise_from == OF_LOOP:
            continue
        jitter, total = noise_and_jitter(values, breaks, stamps, channel.noise)
        if total > 1.2 * channel.noise:
            channels[channel.name] = replace(channel, noise=total)
            says = (
                f"{channel.name} scatters more the faster it changes, as stamps "
                f"{jitter * 1e3:.2g} ms off would make it: its noise is taken as "
                f"{total:.2g} and not {channel.noise:.2g}."
            )
            name = channel.name
            found.append(
                Finding("noise_of_jitter", recording.name, name, jitter, "s", "info",
                        says)
            )  # fmt: skip
    return replace(recording, channels=channels), found


# ----- Velocities beside positions


def _beside_positions(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Noise of measured velocities as the positions tell it: how they scatter about
    the rates of these. Of a filtered velocity neighbouring samples err together, and
    their differences show little of it."""
    channels, found = dict(recording.channels), []
    for channel in recording.measured():
        position = f"{channel.at}.position"
        if channel.quantity != "velocity" or position not in recording:
            continue
        parts = [_beside(recording, channel, position, e) for e in recording.episodes]
        parts = [p for p in parts if p is not None]
        if sum(len(p[0]) for p in parts) < 200:
            continue
        std, together = noise_beside(parts)
        noise = channel.noise
        if channel.noise_from != "given" and std > 1.2 * noise:
            noise = std
            says = (
                f"{channel.name} scatters about the rate of its position more than its "
                f"own differences show: its noise is taken as {std:.2g} and not "
                f"{channel.noise:.2g}."
            )
            name = channel.name
            unit = unit_of("velocity", False)
            found.append(
                Finding("noise_of_velocity", recording.name, name, std, unit, "info",
                        says)
            )  # fmt: skip
        channels[channel.name] = replace(channel, noise=noise, together=together)
    return replace(recording, channels=channels), found


def _beside(recording: Recording, channel: Channel, position: str, episode: Episode):
    """Of an episode: a velocity's samples (n,) less the rate of its position, and that
    rate with its first two derivatives (n, 3), behind the velocity's filters."""
    time = recording.time[episode.rows]
    q, y = recording[position][episode.rows], channel.values[episode.rows]
    there = np.isfinite(y)
    if np.isfinite(q).sum() < 60 or there.sum() < 60:
        return None
    own = recording.channels[position]
    x = smooth_filtered(time, q, own.noise, own.stages or ()).x
    rate = np.stack([x[:, 1], x[:, 2], np.gradient(x[:, 2], time)], axis=1)
    if channel.stages:
        dense = subdivided(time, FILTERED_SEC)
        rate = np.stack(
            [
                filtered(channel.stages, dense, np.interp(dense, time, each), time)
                for each in rate.T
            ],
            axis=1,
        )
    # At the ends neither filters nor the smoother know enough.
    inner = there & (time > time[0] + ENDS_SEC) & (time < time[-1] - ENDS_SEC)
    return y[inner] - rate[inner, 0], rate[inner]

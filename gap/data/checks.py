"""What a recording says about itself, before any model is simulated or fitted.

Here: clocks, lost samples, units, quaternions, ceilings, resolution, stuck channels.
A lag that is mistaken for friction, or degrees for radians, spoils every fit after it.
"""

from collections.abc import Iterable

import numpy as np

from makebreak.gap.data.check_motion import check_excitation, check_gravity
from makebreak.gap.data.check_relations import check_relations
from makebreak.gap.data.clock import clock_period
from makebreak.gap.data.filters import EXAMPLES
from makebreak.gap.data.findings import Finding, JointFacts, SceneFacts, longest_sec
from makebreak.gap.data.match import JointName, Match
from makebreak.gap.data.recording import Channel, Recording, unit_of
from makebreak.gap.data.table import COMMANDS
from makebreak.gap.data.units import in_units, said_of_units
from makebreak.systems.numerics.filters import mean_delay


def check_recordings(
    recordings: Iterable[Recording], facts: SceneFacts | None = None
) -> list[Finding]:
    """All findings, the grave ones first.

    Args: facts: what the scene knows; without, limits are not looked at.
    """
    facts = facts or SceneFacts()
    found: list[Finding] = []
    for recording in recordings:
        found += _notes(recording)
        found += check_filters(recording)
        found += check_clock(recording)
        units = check_units(recording, facts)
        found += units
        found += check_relations(recording, {f.channel for f in units})
        found += check_values(recording, facts)
        found += check_commands(recording, facts)
        found += check_gravity(recording, facts)
        found += check_excitation(recording, facts)
    order = ("error", "warning", "info")
    return sorted(found, key=lambda f: order.index(f.severity))


def check_clock(recording: Recording) -> list[Finding]:
    """Uneven steps, lost rows, and lost samples of each channel."""
    found = []
    steps = np.concatenate(
        [np.diff(recording.time[e.rows]) for e in recording.episodes]
    )
    period = float(np.median(steps))
    near = steps[steps < 1.5 * period]
    # A time stamp's own scatter: two of them make a step.
    jitter = float(1.4826 * np.median(np.abs(near - np.median(near))) / np.sqrt(2.0))
    if jitter > 0.02 * period:
        found.append(
            Finding(
                "clock_jitter",
                recording.name,
                "time",
                jitter,
                "s",
                "warning" if jitter > 0.2 * period else "info",
                f"The clock ticks every {period * 1e3:.3g} ms with a scatter of "
                f"{jitter * 1e3:.2g} ms.",
            )
        )
    # A channel may be slower than the table: rows are lost where the table's own
    # period is skipped.
    missing = np.rint(steps / period) - 1.0
    lost = float(missing[steps > 1.5 * period].sum())
    if jitter > 0.1 * period:  # Then a long step is often followed by a short one.
        lost = 0.0
        for episode in recording.episodes:
            t = recording.time[episode.rows]
            lost += max(np.rint((t[-1] - t[0]) / clock_period(t)) - len(t) + 1.0, 0.0)
    if lost > 0:
        share = lost / (len(steps) + lost)
        found.append(
            Finding(
                "rows_lost",
                recording.name,
                "time",
                share,
                "share",
                "warning" if share > 0.05 else "info",
                f"{lost:.0f} rows ({share:.2%}) are missing; the longest hole is "
                f"{steps.max() * 1e3:.3g} ms.",
            )
        )
    for channel in recording.channels.values():
        if channel.is_command:
            continue
        lost, there, longest = 0.0, 0, 0.0
        for episode in recording.episodes:
            rows = np.flatnonzero(~np.isnan(channel.values[episode.rows]))
            there += len(rows)
            if len(rows) > 2:
                t = recording.time[episode.rows][rows]
                # Lost are neither whole rows, which the clock shows, nor the rows of
                # channels that come at instants of their own.
                of_rows, of_time = np.diff(rows), np.diff(t)
                jumps = np.minimum(
                    of_rows / max(float(np.median(of_rows)), 1.0),
                    of_time / float(np.median(of_time)),
                )
                lost += float(np.sum(np.maximum(np.rint(jumps) - 1.0, 0.0)))
                longest = max(longest, float(of_time.max()))
        if lost > 0:
            share = lost / (there + lost)
            found.append(
                Finding(
                    "samples_lost",
                    recording.name,
                    channel.name,
                    share,
                    "share",
                    "warning" if share > 0.05 else "info",
                    f"{channel.name} lacks {lost:.0f} samples ({share:.2%}); the "
                    f"longest hole is {longest * 1e3:.3g} ms.",
                )
            )
    return found


def check_filters(recording: Recording) -> list[Finding]:
    """What is made of the filters that the sidecar declares: one finding a text."""
    by_text: dict[str, list[Channel]] = {}
    for channel in recording.channels.values():
        if channel.filter:
            by_text.setdefault(channel.filter, []).append(channel)
    found = []
    for text, channels in by_text.items():
        name = channels[0].name
        others = f" and {len(channels) - 1} more" if len(channels) > 1 else ""
        stages = channels[0].stages
        if stages is None:
            kind, late, severity = "filter_unknown", 0.0, "warning"
            says = (
                f'The filter of {name}{others}, "{text}", is none that can be '
                f"simulated, and is left out: expected one as {EXAMPLES}."
            )
        else:
            kind, late, severity = "filter_declared", mean_delay(stages), "info"
            says = (
                f'{name}{others} is compared behind its declared filter, "{text}": '
                f"{late * 1e3:.3g} ms late."
            )
        found.append(Finding(kind, recording.name, name, late, "s", severity, says))
    return found


def check_units(recording: Recording, facts: SceneFacts) -> list[Finding]:
    """Of joints what in_units finds; millimetres for metres of bodies."""
    columns = {"time": recording.time}
    columns |= {c.name: c.values for c in recording.channels.values()}
    joints = []
    for at in recording.places(("position",)):
        own = facts.joints.get(at, JointFacts())
        joints.append(JointName(at, own.prismatic, own.lower, own.upper))
    matches = in_units(columns, joints, {name: Match(name, name) for name in columns})
    found = [
        Finding(
            kind, recording.name, channel, size, "", "error",
            f"{says} Its scale in the sidecar is {size:.6g}.",
        )
        for kind, channel, size, says in said_of_units(matches.values())
    ]  # fmt: skip
    for channel in recording.channels.values():
        y = np.abs(channel.values[~np.isnan(channel.values)])
        if channel.quantity in "xyz" and y.size and float(np.median(y)) > 50.0:
            size = float(np.median(y))
            says = f"{channel.name} is {size:.4g} m in the median: it looks as if it "
            says += "were in mm."
            found.append(
                Finding(
                    "units", recording.name, channel.name, size, "mm", "error", says
                )
            )
    return found


# Noise alone is as large as all that a channel varies, and 1.3 times that in a velocity
# by differences; to and fro it looks larger.
HUNTING = 1.6


def check_values(recording: Recording, facts: SceneFacts) -> list[Finding]:
    """Quaternions, ceilings of commands, resolution, stuck channels."""
    found: list[Finding] = []

    def add(
        kind: str, channel: str, size: float, unit: str, severity: str, says: str
    ) -> None:
        found.append(Finding(kind, recording.name, channel, size, unit, severity, says))

    for at, error in recording.quaternion_norm_error.items():
        if error > 1e-3:
            says = f"Quaternions of {at} are up to {error:.2g} off unit length."
            add("quaternion_norm", f"{at}.qw", error, "1", "info", says)
    for at, n in recording.quaternion_flips.items():
        if n:
            says = f"Quaternions of {at} change sign {n} times; that was undone."
            add("quaternion_flips", f"{at}.qw", n, "1", "info", says)
    for channel in recording.channels.values():
        unit = unit_of(channel.quantity)
        y = channel.values[~np.isnan(channel.values)]
        if len(y) < 20:
            continue
        if channel.is_command:
            plateau = _plateau(recording, channel)
            if plateau is not None:
                value, share = plateau
                says = (
                    f"{channel.name} stays at its extreme {value:.4g} again and again "
                    f"({share:.1%} of the time): it is clipped where it is made."
                )
                add("command_ceiling", channel.name, value, unit, "info", says)
            limit = facts.joints.get(channel.at, JointFacts()).effort_limit
            most = float(np.abs(y).max())
            if channel.quantity == "effort_command" and most > 1.001 * limit:
                share = float(np.mean(np.abs(y) > limit))
                says = (
                    f"{channel.name} asks for up to {most:.4g}, the scene's limit is "
                    f"{limit:.4g} ({share:.1%} of the samples are beyond)."
                )
                add("beyond_limit", channel.name, most, unit, "warning", says)
            continue
        if channel.step > 0.0 and channel.step / np.sqrt(12.0) > 0.5 * channel.noise:
            says = f"{channel.name} comes in steps of {channel.step:.4g} {unit}."
            add("resolution", channel.name, channel.step, unit, "info", says)
        if not np.ptp(y) > 0.0:
            says = f"{channel.name} is {y[0]:.4g} in all rows: it measures nothing."
            add("stuck", channel.name, longest_sec(recording), "s", "warning", says)
            continue
        spread = float(np.std(y))
        if channel.noise_from == "estimated" and channel.noise > HUNTING * spread:
            says = (
                f"{channel.name} goes to and fro from sample to sample, by "
                f"{spread:.3g} {unit}: something swings faster than it is recorded, as "
                "a controller that hunts; taken for noise, that hides any gap."
            )
            add("hunting", channel.name, spread, unit, "warning", says)
        stuck = _longest_stuck(recording, channel)
        if stuck > 0.0:
            says = (
                f"{channel.name} is constant for {stuck:.3g} s, although it is noisy."
            )
            add("stuck", channel.name, stuck, "s", "warning", says)
    return found


def check_commands(recording: Recording, facts: SceneFacts) -> list[Finding]:
    """Whether it is known what drove each joint that has an actuator."""
    found = []
    for at, joint in facts.joints.items():
        if not joint.driven or f"{at}.position" not in recording:
            continue
        if any(f"{at}.{command}" in recording for command in COMMANDS):
            continue
        if f"{at}.effort_measured" in recording:
            kind, severity = "command_measured", "info"
            says = f"No command of {at} was recorded; its measured effort stands in."
        else:
            kind, severity = "no_command", "warning"
            says = (
                f"No command of {at} was recorded, though the scene has an actuator "
                "there: it is taken to have done nothing."
            )
        found.append(Finding(kind, recording.name, at, 0.0, "", severity, says))
    return found


def _plateau(recording: Recording, channel: Channel) -> tuple[float, float] | None:
    """(value, share) of an extreme at which a smooth command stays repeatedly."""
    y = recording.held(channel.name)
    y = y[~np.isnan(y)]
    reach = np.ptp(y)
    if not reach > 0.0 or len(np.unique(y[:5000])) < 50:
        return None  # Steps and bangs are plateaus by design.
    for extreme in (y.max(), y.min()):
        at = np.abs(y - extreme) < 1e-6 * reach
        starts = np.flatnonzero(np.diff(at.astype(int), prepend=0) == 1)
        ends = np.flatnonzero(np.diff(at.astype(int), append=0) == -1) + 1
        if np.sum(ends - starts >= 3) >= 3 and at.mean() > 0.005:
            return float(extreme), float(at.mean())
    return None


def _longest_stuck(recording: Recording, channel: Channel) -> float:
    """[s] of the longest run of equal values, where noise should move them; 0: none.

    Values on a grid repeat by themselves: there a run counts if the channel jumps at
    its end as it does nowhere else.
    """
    if not channel.noise > 0.0:
        return 0.0
    longest, moving, n = 0.0, 0, 0
    for episode in recording.episodes:
        t, y = recording.samples(channel.name, episode)
        step = np.diff(y)
        same = step == 0.0
        moving, n = moving + int(np.sum(~same)), n + len(same)
        if not same.any():
            continue
        coarse = channel.step > channel.noise or len(np.unique(y)) < 0.5 * len(y)
        usual = np.quantile(np.abs(step), 0.995)
        starts = np.flatnonzero(np.diff(same.astype(int), prepend=0) == 1)
        ends = np.flatnonzero(np.diff(same.astype(int), append=0) == -1) + 1
        for i, j in zip(starts, ends, strict=True):
            jumps = j < len(step) and abs(step[j]) > 4.0 * usual
            if j - i >= 8 and (jumps or not coarse):
                longest = max(longest, float(t[j] - t[i]))
    # Where most samples repeat, the channel is slow, or at rest.
    return longest if moving > 0.3 * n else 0.0


def _notes(recording: Recording) -> list[Finding]:
    return [
        Finding(kind, recording.name, "time", 0.0, "", "warning", says + ".")
        for kind, says in recording.notes
    ]

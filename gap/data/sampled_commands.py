"""Efforts that a fast loop commands, logged as samples at the rate of the table.

Held from row to row they would act half a period late.
"""

from collections.abc import Sequence
from dataclasses import replace

from makebreak.gap.data.findings import SAMPLED_COMMANDS, Finding
from makebreak.gap.data.recording import Recording


def as_samples(recordings: Sequence[Recording]) -> list[Recording]:
    """The recordings with each commanded effort as a measured one, which goes in a
    straight line from sample to sample, unless that was measured too."""
    out = []
    for recording in recordings:
        channels = {}
        for name, channel in recording.channels.items():
            if channel.quantity == "effort_command":
                name = f"{channel.at}.effort_measured"
                if name in recording:
                    continue
                channel = replace(
                    channel, name=name, noise_from="estimated", sampled=True
                )
            channels[name] = channel
        out.append(replace(recording, channels=channels))
    return out


def finding(recordings: Sequence[Recording]) -> Finding:
    name = recordings[0].name
    period = recordings[0].period_sec()
    says = (
        "The commanded efforts fit the motion as samples of a faster loop, and not as "
        f"commands that hold for the {1e3 * period:.3g} ms until the next row: they "
        "are interpolated, as if they were mapped to effort_measured. Where efforts "
        "were measured too, those drive the model in their place."
    )
    return Finding(SAMPLED_COMMANDS, name, "time", period, "s", "warning", says)


def finding_of_moved(name: str, late: float, row: float) -> Finding:
    """Of commands that were moved by late [s], in a log of rows so far apart [s]."""
    which = "later" if late > 0.0 else "earlier"
    says = (
        f"The commands fit the motion {1e3 * abs(late):.2g} ms "
        f"({abs(late) / row:.2g} of a row) {which} than the rows that hold them, and "
        "were moved by that: their loop may be faster than the log, or a simulator's "
        "(half of its step), or their stamps off."
    )
    return Finding(SAMPLED_COMMANDS, name, "time", late, "s", "warning", says)

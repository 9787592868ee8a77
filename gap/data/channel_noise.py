"""Noise, resolution and rate of channels, as their own rows tell them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.data.effort_loops import OF_LOOP
from makebreak.gap.data.recording import Channel, Episode, Recording
from makebreak.gap.numerics.signal_noise import estimate_noise
from makebreak.models.effects.measured_channels import torque_constant


def with_noise(recording: Recording) -> Recording:
    """The recording with noise, resolution and rates that its own rows tell."""
    channels = {
        name: c if c.is_command else noise_told(c, recording.time, recording.episodes)
        for name, c in recording.channels.items()
    }
    return replace(recording, channels=channels)


def in_newton_metres(
    recordings: Iterable[Recording], words: Mapping[str, str]
) -> list[Recording]:
    """Measured efforts that a scene's `channels` say to be currents, as torques."""
    out = []
    for recording in recordings:
        channels = dict(recording.channels)
        for name, channel in recording.channels.items():
            factor = 1.0
            if channel.quantity == "effort_measured":
                factor = torque_constant(words, name)
            if factor != 1.0:
                values = factor * channel.values
                values.setflags(write=False)
                given = abs(factor) * channel.noise_given
                channels[name] = replace(channel, values=values, noise_given=given)
        changed = any(channels[n] is not c for n, c in recording.channels.items())
        other = replace(recording, channels=channels)
        out.append(with_noise(other) if changed else recording)
    return out


def noise_told(
    channel: Channel, time: np.ndarray, episodes: Sequence[Episode]
) -> Channel:
    """A measured channel with noise, resolution and rate as its samples tell them; a
    given standard deviation stands."""
    rows, duration = [], 0.0
    for episode in episodes:
        i = np.flatnonzero(~np.isnan(channel.values[episode.rows])) + episode.first
        if len(i) > 1:
            duration += time[i[-1]] - time[i[0]] + np.median(np.diff(time[i]))
        rows.append(i)
    every = np.concatenate(rows)
    rate = len(every) / duration if duration > 0.0 else 0.0
    if not len(every):
        return replace(channel, rate_hz=rate)
    breaks = np.cumsum([len(i) for i in rows])[:-1]
    own = estimate_noise(channel.values[every], breaks, time[every])
    std, source, given = own.std, "estimated", channel.noise_given
    if channel.noise_from == OF_LOOP:  # In its differences are its loop's, too.
        std, source = given / np.sqrt(channel.averaged), OF_LOOP
    elif channel.averaged > 1.0:
        # A mean of many may hold noise that goes together over them.
        std = max(own.std, given / np.sqrt(channel.averaged))
    elif given > 0.0:
        std, source = max(given, own.step / np.sqrt(12.0)), "given"
    return replace(channel, noise=std, noise_from=source, step=own.step, rate_hz=rate)

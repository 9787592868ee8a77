"""Measured efforts that are samples of a loop: what acts between two of them.

A drive that follows positions gives kp (command - position) - kd velocity. While its
command holds, the effort changes as the joint moves; where a row has a new command, it
jumps. As a straight line from sample to sample each jump would act half a row early,
and a simulator's steps hold what they give: both are damping that is not there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from makebreak.gap.data.findings import SAMPLED_COMMANDS, Finding
from makebreak.gap.data.recording import Recording

# Of its jumps and of the rest: a jump is more than so many deviations, at least such a
# share of rows has one, and at most that; together they are this share of all changes.
JUMP_Z, FEWEST, MOST, LEAST_JUMPS = 5.0, 0.005, 0.5, 0.5
FITS = 30  # Of iteratively reweighted least squares.
OF_LOOP = "loop"  # Of a channel's noise_from.
# Share of what its loop changes within a row that shows in the row's mean: none where
# the row is one step of a simulator, half where loops are much faster.
SHARES = (0.0, 0.25, 1.0 / 3.0, 0.4, 0.5)


@dataclass(frozen=True, eq=False)
class Loop:
    """Changes (n,) of an effort from the row before to each row: what its loop and what
    a new command makes, 0 in the first; std: of a sample's noise [N m]."""

    own: np.ndarray
    jumps: np.ndarray
    std: float


def loop_of(recording: Recording, joint: str) -> Loop | None:
    """The loop that gave a joint's measured effort; None where its samples show none.
    kp and kd are those of the changes without the jumps, by Cauchy's likelihood."""
    names = [f"{joint}.{what}" for what in ("effort_measured", "position", "velocity")]
    if not all(name in recording for name in names):
        return None
    y, *moved = (
        np.concatenate([
            np.append(0.0, np.diff(recording[name][e.rows]))
            for e in recording.episodes
        ])
        for name in names
    )  # fmt: skip
    X = np.stack(moved, axis=1)
    good = np.isfinite(y) & np.isfinite(X).all(axis=1)
    if len(y) != len(recording.time) or good.sum() < 1.0 / FEWEST:
        return None
    weight, c, left, scale = good.astype(float), np.zeros(2), y, 0.0
    for _ in range(FITS):
        root = np.sqrt(weight[good])
        c = np.linalg.lstsq(X[good] * root[:, None], y[good] * root, rcond=None)[0]
        left = np.where(good, y - X @ c, 0.0)
        scale = 1.4826 * float(np.median(np.abs(left[good])))
        if not scale > 0.0:
            return None
        weight = good / (1.0 + (left / scale) ** 2)
    jumps = np.where(good, (1.0 - weight) * left, 0.0)  # By how little they fit.
    share = np.mean(np.abs(left) > JUMP_Z * scale)
    most = LEAST_JUMPS * float(np.sum(y[good] ** 2))
    if not (c < 0.0).all() or not FEWEST < share < MOST or np.sum(jumps**2) < most:
        return None
    own = np.where(good, y - jumps, 0.0)
    return Loop(own, jumps, scale / np.sqrt(2.0))


def of_loops(
    recordings: Sequence[Recording], share: float | None = None
) -> list[Recording]:
    """The recordings, with the noise of efforts that loops gave beside these; with a
    share (SHARES), as samples through which a straight line acts as they did."""
    out = []
    for recording in recordings:
        channels = dict(recording.channels)
        for name, channel in recording.channels.items():
            if channel.quantity != "effort_measured" or channel.sampled:
                continue
            is_told = channel.noise_given and channel.noise_from != OF_LOOP
            loop = None if is_told else loop_of(recording, channel.at)
            if loop is None:
                continue
            values = channel.values
            if share is not None:
                # In the mean of a row a line has half of what changes within it.
                less = 0.5 * loop.jumps + (0.5 - share) * loop.own
                values = values - 0.5 * (less + np.append(less[1:], 0.0))
                values.setflags(write=False)
            channels[name] = replace(
                channel, values=values, noise=loop.std, noise_given=loop.std,
                noise_from=OF_LOOP, sampled=share is not None,
            )  # fmt: skip
        out.append(replace(recording, channels=channels))
    return out


def finding(recordings: Sequence[Recording], share: float) -> Finding:
    """Of efforts that act otherwise between their rows than a line drawn through."""
    first, row = recordings[0].name, min(r.period_sec() for r in recordings)
    says = (
        "Measured efforts jump where their loops got new commands, and change as the "
        "joints move meanwhile. The motion says that jumps act from their rows on, and "
        f"that of what loops change within a row {share:.2g} acts in it (half of it "
        "where loops are fast, none in a simulator's single step)."
    )
    return Finding(SAMPLED_COMMANDS, first, "time", share * row, "s", "info", says)

"""Where a scene and its recordings disagree: channel, time, and what went on there."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from makebreak.gap.data.recording import Recording, unit_of
from makebreak.gap.numerics.selection import benjamini_hochberg
from makebreak.gap.residuals.inverse import InverseModel
from makebreak.gap.residuals.whitened_rows import REST_SPEED
from makebreak.gap.result import Unexplained, Where
from makebreak.models.effects.kind import full_name, one_dof_joints

FALSE_RATE = 0.01  # Share of the windows told that may stand out by chance.
ALLOWED = 1.3  # What estimates of noise may be off by.
MOST = 300
LOUD = 2.0  # Rms over noise of what is said to be left.
BINS, EXPLAINED = 12, 0.2  # Of a feature; share of the variance that it explains.
ALIKE = 2.0  # Neighbours are told as one if what happened, and how much, is alike.


def where_in_motion(model: InverseModel, left: np.ndarray) -> list[Where]:
    """Stretches of half a second in which a joint's equation, or another channel, is
    not met.

    Args: left (m,) the residual over its noise, of InverseModel's rows.
    """
    names = model.names()
    R = left.reshape(-1, len(names))
    units = {
        full_name(model.dynamics.plant, joint): (
            "m/s" if joint.type_name() == "prismatic" else "rad/s"
        )
        for joint in one_dof_joints(model.dynamics.plant)
    }
    found, p = [], []
    first = 0
    for track in model.tracks:
        n = len(track.bumps.centre)
        rows = R[first : first + n]
        first += n
        stretch = ((track.bumps.centre - track.time[0]) / 0.5).astype(int)
        _, v, _ = track.motion_at_middles()
        for number in np.unique(stretch):
            mine = np.flatnonzero(stretch == number)
            half = 0.5 * track.bumps.width
            a = float(track.bumps.centre[mine[0]] - half)
            b = float(track.bumps.centre[mine[-1]] + half)
            here = (track.middle >= a) & (track.middle <= b)
            for k, (what, joint) in enumerate(names):
                e = rows[mine, k] / ALLOWED
                # Neighbouring bumps share half of their samples.
                df = max(0.7 * len(mine), 1.0)
                p.append(float(chi2.sf(np.sum(e**2) * df / len(mine), df)))
                region = _moving(v[here, model.joints.index(joint)], units[joint])
                channel = f"{joint}.{'effort' if what == 'effort' else what}"
                score = float(np.sqrt(np.mean(rows[mine, k] ** 2)))
                found.append(
                    Where(channel, a, b, track.episode, track.recording, region, score)
                )
    return _merged(found, benjamini_hochberg(p, FALSE_RATE))


def where_in_windows(model: Any, errors: Sequence[np.ndarray]) -> list[Where]:
    """Windows whose end is not where the scene would have it; those that could not be
    simulated to their end say nothing."""
    found, p = [], []
    for w, e in zip(model.windows, errors, strict=True):
        if not len(e) or not np.isfinite(e).all():
            continue
        recording = model.recordings[w.recording]
        time = recording.time[w.rows]
        for c, channel in enumerate(model.channels):
            score = float(np.sqrt(np.mean(e[:, c] ** 2)))
            # The samples of a window err together: they count as three.
            p.append(float(chi2.sf(3.0 * (score / ALLOWED) ** 2, 3.0)))
            region = _moving(*_rate(channel, recording[channel][w.rows], time))
            found.append(
                Where(
                    channel, float(time[0]), float(time[-1]), w.episode,
                    recording.name, region, score,
                )
            )  # fmt: skip
    return _merged(found, benjamini_hochberg(p, FALSE_RATE))


def unexplained(model: InverseModel, left: np.ndarray) -> list[Unexplained]:
    """What is left of each joint's equation, and what it goes with."""
    names = model.names()
    each: list[list[np.ndarray]] = []
    for track in model.tracks:
        m = model.motion(track)
        motion = [track.bumps.mean(x) for x in (m.q, m.v, m.vd, m.effort)]
        each.append([*motion, track.bumps.centre])
    *motion, time = (np.concatenate(x) for x in zip(*each, strict=True))
    features = {
        f"the {what} of {joint}": x[:, i]
        for i, joint in enumerate(model.joints)
        for what, x in zip(
            ("position", "velocity", "acceleration", "effort"), motion, strict=True
        )
    }
    features["time"] = time
    R = left.reshape(-1, len(names))
    found = []
    for k, (what, joint) in enumerate(names):
        size, goes, best = _goes_with(R[:, k], features)
        if size < LOUD:
            continue
        since = None
        if best == "time" and len(model.recordings) == 1:
            since = jump_time(time, R[:, k])
        found.append(Unexplained(f"{joint}.{what}", "everywhere", size, goes, since))
    return sorted(found, key=lambda each: -each.size)


def unexplained_in_windows(
    model: Any, simulated: Sequence[np.ndarray]
) -> list[Unexplained]:
    """Of each channel what is left, while what, and what its size goes with."""
    errors = model.errors(simulated)
    used = [
        k for k, e in enumerate(errors) if len(e) and not np.isinf(simulated[k]).any()
    ]
    if not used:
        return []
    features: dict[str, list[np.ndarray]] = {}
    for k in used:
        w = model.windows[k]
        recording = model.recordings[w.recording]
        time = recording.time[w.rows]
        features.setdefault("time since the window's start", []).append(time - w.start)
        for c in model.channels:
            if c.rsplit(".", 1)[-1] in ("x", "y", "z", "position"):
                y = recording[c][w.rows]
                good = np.isfinite(y)
                if good.sum() < 2:
                    y, good = np.zeros(len(time)), np.ones(len(time), bool)
                y = np.interp(time, time[good], y[good])
                features.setdefault(f"the value of {c}", []).append(y)
                rate = np.gradient(y, time)
                features.setdefault(f"the rate of {c}", []).append(rate)
    joined = {what: np.concatenate(x) for what, x in features.items()}
    E = np.concatenate([errors[k] for k in used])
    found = []
    for i, name in enumerate(model.channels):
        size, goes, _ = _goes_with(E[:, i], joined)
        if size < LOUD:
            continue
        worst = max(used, key=lambda k: float(np.mean(errors[k][:, i] ** 2)))
        w = model.windows[worst]
        region = f"most in episode {w.episode}, from {w.start:.3g} s"
        found.append(Unexplained(name, region, size, goes))
    return sorted(found, key=lambda each: -each.size)


def _goes_with(
    y: np.ndarray, features: Mapping[str, np.ndarray]
) -> tuple[float, str, str]:
    """Rms of y (n,), what explains most of its variance, in words, and that feature
    (n,) alone; "" where none explains a fifth."""
    shares = {what: share_explained(x, y) for what, x in features.items()}
    best = max(shares, key=lambda what: shares[what])
    size = float(np.sqrt(np.mean(y**2)))
    if shares[best] <= EXPLAINED:
        return size, "nothing that is measured", ""
    return size, f"{best} (it explains {shares[best]:.0%} of its variance)", best


def jump_time(t: np.ndarray, y: np.ndarray) -> float | None:
    """The time at which the mean of y (n,) changes, if one jump tells half of its
    variance: by least squares, a tenth of the rows at least on either side."""
    order = np.argsort(t)
    t, y = t[order], y[order] - np.mean(y)
    n = len(y)
    k = np.arange(max(n // 10, 2), n - max(n // 10, 2))
    if not len(k) or not np.var(y) > 0.0:
        return None
    before = np.cumsum(y)[k - 1]
    told = before**2 * n / (k * (n - k))  # Of the sum of squares.
    best = int(np.argmax(told))
    return float(t[k[best]]) if told[best] > 0.5 * np.sum(y**2) else None


def spans_of(
    recordings: Sequence[Recording],
) -> dict[tuple[str, int], tuple[float, float]]:
    """{(recording, episode): from and to [s]} of all that is in recordings."""
    found: dict[tuple[str, int], tuple[float, float]] = {}
    for recording in recordings:
        for episode in recording.episodes:
            key, time = (recording.name, episode.number), recording.time[episode.rows]
            low, high = found.get(key, (np.inf, -np.inf))
            found[key] = min(low, float(time[0])), max(high, float(time[-1]))
    return found


def begins(
    where: Sequence[Where], extents: Mapping[tuple[str, int], tuple[float, float]]
) -> tuple[str, int, float] | None:
    """Recording, episode and time [s] from which on something stands out that did not
    before: nothing does in the first fifth of what was looked at there, and in most of
    what follows; None if it is not so, or in another episode from the start.

    Args: extents: {(recording, episode): from and to [s]}, of what was looked at.
    """
    found = None
    for (recording, episode), (low, high) in extents.items():
        mine = [w for w in where if (w.recording, w.episode) == (recording, episode)]
        if not mine:
            continue
        first = min(w.from_s for w in mine)
        grid = np.linspace(first, high, 201)[:-1]
        out = np.zeros(len(grid), bool)
        for w in mine:
            out |= (grid >= w.from_s) & (grid <= w.to_s)
        if first < low + 0.2 * (high - low) or out.mean() < 0.5 or found:
            return None
        found = recording, episode, first
    return found


def share_explained(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the variance of y (n,) that its mean in bins of x (n,) tells, less what
    chance gives."""
    if np.std(x) == 0.0 or np.std(y) == 0.0 or len(y) <= BINS:
        return 0.0
    edges = np.quantile(x, np.linspace(0, 1, BINS + 1)[1:-1])
    group = np.searchsorted(edges, x)
    count = np.bincount(group, minlength=BINS)
    mean = np.bincount(group, y, minlength=BINS) / np.maximum(count, 1)
    within = float(np.sum((y - mean[group]) ** 2))
    return 1.0 - within / (len(y) - BINS) / float(np.var(y, ddof=1))


def _rate(channel: str, y: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, str]:
    """How fast what a channel measures changes, and the unit."""
    quantity = channel.rsplit(".", 1)[1]
    unit = unit_of(quantity)
    if unit.endswith("/s"):
        return y, unit
    return np.gradient(y, time), "1/s" if unit == "1" else f"{unit}/s"


def _moving(v: np.ndarray, unit: str) -> str:
    v = v[np.isfinite(v)]
    if not len(v) or np.mean(np.abs(v) < REST_SPEED) > 0.5:
        return "at rest"
    fastest = np.abs(v).max()
    turning = v.min() < -0.02 * fastest and v.max() > 0.02 * fastest
    how = "reversing" if turning else "moving"
    return f"{how}, up to {fastest:.2g} {unit}"


def _merged(found: list[Where], stands_out: np.ndarray) -> list[Where]:
    """Those that stand out, neighbours of a channel as one, the strongest first."""
    groups: dict[tuple, list[Where]] = {}
    for each, is_out in zip(found, stands_out, strict=True):
        if is_out:
            key = (each.recording, each.episode, each.channel)
            groups.setdefault(key, []).append(each)
    out: list[Where] = []
    for group in groups.values():
        run: list[Where] = []
        for window in sorted(group, key=lambda w: w.from_s):
            if run and not _alike(run[-1], window):
                out.append(_one(run))
                run = []
            run.append(window)
        if run:
            out.append(_one(run))
    return sorted(out, key=lambda w: -w.score)[:MOST]


def _alike(a: Where, b: Where) -> bool:
    """Whether b, which starts later, goes on where a ends."""
    same = a.region.split(",")[0] == b.region.split(",")[0]
    near = b.from_s <= a.to_s + 0.01
    return near and same and 1.0 / ALIKE < a.score / max(b.score, 1e-12) < ALIKE


def _one(run: list[Where]) -> Where:
    top = max(run, key=lambda w: w.score)
    return Where(
        top.channel, run[0].from_s, max(w.to_s for w in run), top.episode,
        top.recording, top.region, top.score,
    )  # fmt: skip

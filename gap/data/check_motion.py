"""What bodies in flight say of gravity, and whether joints move enough to tell."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from makebreak.gap.data.findings import (
    SURE,
    Finding,
    G,
    JointFacts,
    SceneFacts,
    complete_rows,
    some_episodes,
)
from makebreak.gap.data.recording import Recording, unit_of


def check_gravity(recording: Recording, facts: SceneFacts) -> list[Finding]:
    """Apparent gravity of what flies freely: a length or clock scale shows in it."""
    found = []
    for at in recording.places("z"):
        if facts.free and at not in facts.free:
            continue
        apparent = free_flight_gravity(recording, at)
        if apparent is None or not facts.gravity > 0.0:
            continue
        g, std = apparent
        ratio = g / facts.gravity
        if 500.0 < ratio < 2000.0:
            says = f"{at} falls with {g:.4g} m/s2: its position is in mm."
            found.append(
                Finding("units", recording.name, f"{at}.z", g, "mm", "error", says)
            )
        elif abs(ratio - 1.0) > max(SURE * std / facts.gravity, 0.005):
            says = (
                f"{at} falls with {g:.3f} +- {std:.3f} m/s2 instead of "
                f"{facts.gravity:.3f}, as if lengths were measured {ratio - 1.0:+.1%} "
                f"off or the clock {ratio**-0.5 - 1.0:+.1%}; or something pulls at it."
            )
            found.append(
                Finding(
                    "apparent_gravity",
                    recording.name,
                    f"{at}.z",
                    g,
                    "m/s2",
                    "warning",
                    says,
                )
            )
    return found


def free_flight_gravity(recording: Recording, at: str) -> tuple[float, float] | None:
    """Downward acceleration of a body in free flight, and its standard error [m/s2].

    Flight is where a parabola fits as well as the noise lets it, falls with a third to
    three times gravity (or a thousand times that), and does not turn sideways. None
    where nothing flies, or not long enough to tell 10 %.
    """
    values = recording.stack(at, "xyz")
    if values is None:
        return None
    noise = np.array([recording.channels[f"{at}.{axis}"].noise for axis in "xyz"])
    estimates, weights = [], []
    for episode in some_episodes(recording, 600):
        t, p = complete_rows(recording, values, episode)
        if len(t) < 8:
            continue
        first = 0
        while first + 8 <= len(t):
            best = None
            for n in (8, 12, 18, 27, 40, 60, 90):
                if first + n > len(t):
                    break
                fit = _parabola(t[first : first + n], p[first : first + n], noise)
                if fit is None:
                    break
                best = (n, *fit)
            if best is None:
                first += 4
                continue
            n, a, std = best
            first += n
            if std < 0.1 * a:
                estimates.append(a)
                weights.append(std**-2)
    if len(estimates) < 3:
        return None
    g, w = np.array(estimates), np.array(weights)
    middle = np.median(g)
    keep = np.abs(g - middle) < 5.0 * np.maximum(w**-0.5, 0.01 * middle)
    g, w = g[keep], w[keep]
    if len(g) < 3:
        return None
    mean = float(np.average(g, weights=w))
    scatter = np.sqrt(np.average((g - mean) ** 2, weights=w) / (len(g) - 1))
    std = float(max(scatter, w.sum() ** -0.5))
    return (mean, std) if std < 0.1 * mean else None


def _parabola(t, p, noise) -> tuple[float, float] | None:
    """Downward acceleration and its standard error, if p (n, 3) is a flight."""
    s = t - t.mean()
    A = np.stack([np.ones_like(s), s, 0.5 * s * s], axis=1)
    solution, *_ = np.linalg.lstsq(A, p, rcond=None)
    left = np.sqrt(np.mean((p - A @ solution) ** 2, axis=0) * len(s) / (len(s) - 3))
    each = np.sqrt(np.linalg.inv(A.T @ A)[2, 2]) * noise
    a = solution[2]
    down = -a[2]
    scale = 1000.0 if down > 100.0 * G else 1.0
    flying = (
        0.3 * G < down / scale < 3.0 * G
        and np.all(left < 1.6 * noise + 1e-12)
        and np.all(np.abs(a[:2]) < 0.15 * G * scale + 4.0 * each[:2])
    )
    return (float(down), float(each[2])) if flying else None


def check_excitation(recording: Recording, facts: SceneFacts) -> list[Finding]:
    """Whether each joint's motion can tell the usual effects apart at all."""
    found: list[Finding] = []
    for at in recording.places(("position",)):
        e = excitation(recording, at)
        if e is None:
            continue
        name, own = f"{at}.position", facts.joints.get(at, JointFacts())
        unit = unit_of("position", own.prismatic)

        def add(kind: str, size: float, unit: str, says: str, name=name) -> None:
            found.append(Finding(kind, recording.name, name, size, unit, "info", says))

        if e.range < 20.0 * recording.channels[name].noise:
            says = (
                f"{at} hardly moves ({e.range:.2g} {unit}): its effects are not "
                "identifiable."
            )
            add("no_motion", e.range, unit, says)
            continue
        if e.reversals < 3:
            says = (
                f"{at} reverses {e.reversals} times: dry friction and a constant bias "
                "cannot be distinguished."
            )
            add("few_reversals", e.reversals, "1", says)
        if e.speed_decades < 0.5:
            says = (
                f"{at} moves at nearly one speed ({e.speed_decades:.2g} decades): "
                "viscous and dry friction cannot be distinguished."
            )
            add("one_speed", e.speed_decades, "decades", says)
    if facts.torques is not None:
        found += _inertia_findings(recording, facts)
    return found


@dataclass(frozen=True)
class Excitation:
    """Of a joint's motion: range [rad or m], reversals, decades of speed between its
    10 and 95 % quantile while it moves, largest speed [unit/s]."""

    range: float
    reversals: int
    speed_decades: float
    speed_max: float


def excitation(recording: Recording, at: str) -> Excitation | None:
    """Of a joint `<model>.<joint>`, by its position alone; None for too few samples."""
    name = f"{at}.position"
    noise = recording.channels[name].noise
    reversals, speeds, low, high = 0, [], np.inf, -np.inf
    for episode in some_episodes(recording):
        t, y = recording.samples(name, episode)
        if len(t) < 30:
            continue
        period = float(np.median(np.diff(t)))
        clock = np.arange(t[0], t[-1], period)
        width = 3.0
        v = gaussian_filter1d(np.interp(clock, t, y), width, order=1) / period
        # Noise of the smoothed derivative: below it nothing is a reversal.
        floor = 5.0 * noise / period * np.sqrt(0.25 / np.sqrt(np.pi) / width**3)
        moving = v[np.abs(v) > max(floor, 1e-9)]
        reversals += int(np.sum(moving[1:] * moving[:-1] < 0.0))
        speeds.append(np.abs(moving))
        low, high = min(low, y.min()), max(high, y.max())
    if not speeds:
        return None
    speed = np.concatenate(speeds)
    if not speed.size:
        return Excitation(float(high - low), 0, 0.0, 0.0)
    slow, fast = np.quantile(speed, [0.1, 0.95])
    return Excitation(
        float(high - low), reversals, float(np.log10(fast / slow)), float(speed.max())
    )


def _inertia_findings(recording: Recording, facts: SceneFacts) -> list[Finding]:
    """Inertial beside gravity torque: a slow recording does not weigh inertias."""
    joints = recording.places(("position",))
    episode = max(recording.episodes, key=lambda e: e.last - e.first)
    samples = {at: recording.samples(f"{at}.position", episode) for at in joints}
    if any(len(t) < 60 for t, _ in samples.values()) or not joints:
        return []
    start = max(t[0] for t, _ in samples.values())
    end = min(t[-1] for t, _ in samples.values())
    period = float(np.median(np.diff(samples[joints[0]][0])))
    clock = np.arange(start, end, period)
    if len(clock) < 60:
        return []
    q: dict[str, np.ndarray] = {}
    v: dict[str, np.ndarray] = {}
    a: dict[str, np.ndarray] = {}
    for at, (t, y) in samples.items():
        on_clock = np.interp(clock, t, y)
        for k, into in enumerate((q, v, a)):
            into[at] = gaussian_filter1d(on_clock, 5.0, order=k) / period**k
    pick = np.linspace(20, len(clock) - 21, 100).astype(int)
    weights: dict[str, list] = {at: [] for at in joints}
    inertias: dict[str, list] = {at: [] for at in joints}
    for i in pick:
        gravity, inertial = facts.torques(  # type: ignore[misc]
            *({at: float(x[at][i]) for at in joints} for x in (q, v, a))
        )
        for at in joints:
            if at in gravity:
                weights[at].append(gravity[at])
                inertias[at].append(inertial[at])
    found = []
    for at in joints:
        if not weights[at]:
            continue
        weight, inertia = (
            float(np.sqrt(np.mean(np.square(x)))) for x in (weights[at], inertias[at])
        )
        if inertia < 0.1 * weight:
            says = (
                f"{at}: inertial torque is {inertia:.2g} beside {weight:.2g} of "
                "gravity (rms): too slow to weigh inertias."
            )
            found.append(
                Finding(
                    "slow_motion",
                    recording.name,
                    f"{at}.position",
                    inertia / weight,
                    "1",
                    "info",
                    says,
                )
            )
    return found

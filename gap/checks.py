"""What a recording says about itself, before any model is simulated or fitted.

Clocks, lost samples, lag and growing lag between channels, velocity against position,
quaternions, ceilings, resolution, stuck channels, units, apparent gravity, excitation.
A lag that is mistaken for friction, or degrees for radians, spoils every fit after it.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import gaussian_filter1d

from makebreak.gap.recording import Channel, Episode, Recording, unit_of
from makebreak.gap.table import TWIST
from makebreak.systems.numerics.signal_relation import (
    Relation,
    angular_velocity,
    relate,
)

_G = 9.81  # [m/s2]
_SURE = 5.0  # Standard errors: with 50 channels a chance finding is one in 30 000.
_MOST_EPISODES = 40
_MOST_ROWS = 30_000  # Of an episode that a check looks at.


@dataclass(frozen=True)
class Finding:
    """severity: "info", "warning" (a fit may mislead) or "error" (it will)."""

    kind: str
    recording: str
    channel: str
    size: float
    unit: str
    severity: str
    says: str  # One English sentence.


@dataclass(frozen=True)
class JointFacts:
    """What a scene knows of a joint; limits are infinite where there are none."""

    prismatic: bool = False
    lower: float = -np.inf  # [rad] or [m]
    upper: float = np.inf
    effort_limit: float = np.inf  # [N m] or [N]


@dataclass(frozen=True)
class SceneFacts:
    """What the checks need of a scene; gap/scene_facts.py takes it from a plant.

    gravity: [m/s2], its size. free: `<model>.<body>` of bodies that nothing holds.
    torques(q, v, a): for {joint: value}, ({joint: gravity torque}, {joint: inertial
    torque}) [N m]; None if unknown.
    """

    joints: Mapping[str, JointFacts] = field(default_factory=dict)
    free: frozenset[str] = frozenset()
    gravity: float = _G
    torques: Callable | None = None


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
        found += check_clock(recording)
        found += check_units(recording, facts)
        found += check_relations(recording, facts)
        found += check_values(recording, facts)
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
                jumps = np.diff(rows)
                usual = max(float(np.median(jumps)), 1.0)
                lost += float(np.sum(np.rint(jumps / usual) - 1.0))
                t = recording.time[episode.rows][rows]
                longest = max(longest, float(np.diff(t).max()))
        if not there:
            found.append(
                Finding(
                    "channel_empty",
                    recording.name,
                    channel.name,
                    0.0,
                    "",
                    "warning",
                    f"{channel.name} has no sample at all.",
                )
            )
        elif lost > 0:
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


def check_units(recording: Recording, facts: SceneFacts) -> list[Finding]:
    """Degrees for radians, millimetres for metres, milliseconds for seconds."""
    found = []

    def suspect(channel: str, size: float, unit: str, says: str) -> None:
        found.append(
            Finding("units", recording.name, channel, size, unit, "error", says)
        )

    for channel in recording.channels.values():
        y = channel.values[~np.isnan(channel.values)]
        if not y.size:
            continue
        most = float(np.abs(y).max())
        joint = facts.joints.get(channel.at)
        if channel.quantity in ("position", "position_command") and joint is not None:
            limit = max(abs(joint.lower), abs(joint.upper))
            unit, factor = ("mm", 1e-3) if joint.prismatic else ("deg", np.pi / 180.0)
            # Only what the other unit would put right.
            if (
                np.isfinite(limit)
                and most > 3.0 * limit
                and factor * most < 1.2 * limit
            ):
                suspect(
                    channel.name,
                    most,
                    unit,
                    f"{channel.name} reaches {most:.4g}, the joint's limit is "
                    f"{limit:.4g} {unit_of('position', joint.prismatic)}: it looks as "
                    f"if it were in {unit}.",
                )
        if channel.quantity in "xyz" and float(np.median(np.abs(y))) > 50.0:
            suspect(
                channel.name,
                most,
                "mm",
                f"{channel.name} is {np.median(np.abs(y)):.4g} m in the median: it "
                "looks as if it were in mm.",
            )
    return found


# Ratios of velocity to differentiated position that a wrong unit explains.
_RATIOS = (
    (np.pi / 180.0, "the position is in degrees, or the velocity in rad/s beside it"),
    (180.0 / np.pi, "the velocity is in degrees per second"),
    (1e-3, "the position is in mm"),
    (1e3, "the velocity is in mm/s, or the time in milliseconds"),
    (2.0 * np.pi / 60.0, "the position is in other units than the velocity"),
    (60.0 / (2.0 * np.pi), "the velocity is in revolutions per minute"),
)


def check_relations(recording: Recording, facts: SceneFacts) -> list[Finding]:
    """Velocity against position, measured against commanded effort: scale, bias, lag,
    and a lag that grows, which is a clock that runs fast or slow."""
    found: list[Finding] = []
    for at in recording.places(("velocity",)):
        if f"{at}.position" in recording:
            relation = _related(recording, f"{at}.velocity", f"{at}.position", 1)
            found += _velocity_findings(recording, f"{at}.velocity", relation)
    for at in recording.places(TWIST):
        for axis in "xyz":
            name, position = f"{at}.v{axis}", f"{at}.{axis}"
            if name in recording and position in recording:
                relation = _related(recording, name, position, 1)
                found += _velocity_findings(recording, name, relation)
        found += _spin_findings(recording, at)
    for at in recording.places(("effort_measured",)):
        if f"{at}.effort_command" in recording:
            found += _effort_findings(recording, at)
    return found


def _velocity_findings(
    recording: Recording, name: str, relation: Relation | None
) -> list[Finding]:
    if relation is None or relation.residual > 0.3 * relation.signal:
        return []
    found, r = [], relation
    # Noise of the position makes the scale too small, by at most its share of power.
    faded = 2.0 * (r.residual / r.signal) ** 2
    unit = unit_of(name.rsplit(".", 1)[1])

    def add(kind: str, size: float, unit: str, severity: str, says: str) -> None:
        found.append(Finding(kind, recording.name, name, size, unit, severity, says))

    for ratio, why in _RATIOS:
        if abs(abs(r.scale) / ratio - 1.0) < 0.03:
            says = f"{name} is {r.scale:.4g} times the derivative of position: {why}."
            add("units", r.scale, "1", "error", says)
            return found
    if r.scale < 0.0:
        says = f"{name} has the opposite sign of the derivative of position."
        add("sign", r.scale, "1", "error", says)
    elif abs(r.scale - 1.0) > max(_SURE * r.scale_std, 0.01, faded):
        says = (
            f"{name} is {r.scale:.4f} +- {r.scale_std:.4f} times the derivative of "
            "position."
        )
        add("velocity_scale", r.scale, "1", "warning", says)
    if abs(r.bias) > max(_SURE * r.bias_std, 0.005 * r.signal):
        says = f"{name} reads {r.bias:.3g} {unit} too high, by its integral."
        add("velocity_bias", r.bias, unit, "warning", says)
    longest = _longest_sec(recording)
    if abs(r.skew) > max(_SURE * r.skew_std, 2e-5, 0.15 * r.period / longest):
        says = (
            f"{name} comes later by {r.skew * 1e3:.3g} ms each second than position: "
            "their clocks run apart."
        )
        add("clock_skew", r.skew, "s/s", "warning", says)
    elif abs(r.lag) > max(_SURE * r.lag_std, 0.15 * r.period):
        late = "after" if r.lag > 0 else "before"
        says = (
            f"{name} comes {abs(r.lag) * 1e3:.3g} +- {r.lag_std * 1e3:.2g} ms {late} "
            "position"
        )
        half = abs(r.lag / r.period - 0.5) < 0.1
        says += ", as a backward difference of it would." if half else "."
        add("velocity_lag", r.lag, "s", "warning", says)
    return found


def _spin_findings(recording: Recording, at: str) -> list[Finding]:
    """Angular velocity against orientation."""
    quaternions = recording.stack(at, ("qw", "qx", "qy", "qz"))
    if quaternions is None:
        return []
    found: list[Finding] = []
    left = {"world": 0.0, "body": 0.0}
    for j, name in enumerate([f"{at}.w{axis}" for axis in "xyz"]):
        if name not in recording:
            return found
        parts: list[Relation] = []
        for episode in _some_episodes(recording):
            t, q = _rows(recording, quaternions, episode)
            t_w, w = recording.samples(name, episode)
            if min(len(t), len(t_w)) < 20:
                continue
            middle, world, body = angular_velocity(t, q)
            for frame, rate in (("world", world), ("body", body)):
                # By the samples themselves; a lag is small beside another frame.
                wrong = np.interp(t_w, middle, rate[:, j]) - w
                left[frame] += float(np.sum(wrong**2))
            relation = relate(t_w, w, middle, world[:, j], width=_width(len(t)))
            if relation is not None:
                parts.append(relation)
        found += _velocity_findings(recording, name, _together(parts))
    if left["body"] < 0.25 * left["world"]:
        ratio = np.sqrt(left["body"] / left["world"])
        says = (
            f"The angular velocity of {at} fits its orientation when taken in the "
            "body's axes, and not in the world's."
        )
        return [
            Finding("body_axes", recording.name, f"{at}.wx", ratio, "1", "error", says)
        ]
    return found


def _effort_findings(recording: Recording, at: str) -> list[Finding]:
    name, command = f"{at}.effort_measured", f"{at}.effort_command"
    r = _related(recording, name, command, 0, held=True)
    found: list[Finding] = []

    def add(kind: str, size: float, unit: str, severity: str, says: str) -> None:
        found.append(Finding(kind, recording.name, name, size, unit, severity, says))

    ceiling = _ceiling_of_measured(recording, name, command)
    if ceiling is not None:
        limit, beyond = ceiling
        says = (
            f"{name} stays at {limit:.4g} N m while more is commanded "
            f"({beyond:.1%} of the samples): the actuator is at its limit."
        )
        add("effort_ceiling", limit, "N m", "warning", says)
        return found  # Scale and lag would be those of the clipped signal.
    if r is None or r.residual > 0.2 * r.signal:
        return found
    if abs(r.scale - 1.0) > max(_SURE * r.scale_std, 0.01):
        says = f"{name} is {r.scale:.4f} +- {r.scale_std:.4f} times its command."
        add("effort_scale", r.scale, "1", "warning", says)
    if abs(r.bias) > max(_SURE * r.bias_std, 0.005 * r.signal):
        says = f"{name} reads {r.bias:.3g} N m above its command."
        add("effort_bias", r.bias, "N m", "warning", says)
    slip = r.period / _longest_sec(recording)  # Within a row, nothing can be told.
    if abs(r.skew) > max(_SURE * r.skew_std, 2e-5, slip):
        says = (
            f"{name} comes later by {r.skew * 1e3:.3g} ms each second than its "
            "command: their clocks run apart."
        )
        add("clock_skew", r.skew, "s/s", "warning", says)
    # Within a row, the sample may be taken before or after the new command: a period.
    elif abs(r.lag) > 1.2 * r.period + _SURE * r.lag_std:
        says = (
            f"{name} follows its command after {r.lag * 1e3:.3g} +- "
            f"{r.lag_std * 1e3:.2g} ms."
        )
        add("effort_lag", r.lag, "s", "warning", says)
    return found


def _ceiling_of_measured(
    recording: Recording, name: str, command: str
) -> tuple[float, float] | None:
    """(limit, share of the samples beyond) of an effort that no longer follows."""
    held = recording.held(command)
    y = recording[name]
    there = ~(np.isnan(y) | np.isnan(held))
    u, y = held[there], y[there]
    if len(u) < 100 or not np.ptp(u) > 0.0:
        return None
    noise = recording.channels[name].noise
    limit = float(np.quantile(np.abs(y), 0.995))
    beyond = (np.abs(u) > 1.1 * limit + 6.0 * noise) & (np.sign(u) == np.sign(y))
    inside = np.abs(u) < 0.9 * limit
    if beyond.sum() < 20 or inside.sum() < 20:
        return None
    # Flat beyond, following within.
    flat = np.std(np.abs(y[beyond])) / np.std(np.abs(u[beyond]))
    within = np.polyfit(u[inside], y[inside], 1)[0]
    at_limit = np.median(np.abs(y[beyond]))
    if flat < 0.3 * abs(within) and abs(within) > 0.3:
        return float(at_limit), float(beyond.mean())
    return None


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
        stuck = _longest_stuck(recording, channel)
        if stuck > 0.0:
            says = f"{channel.name} stands still for {stuck:.3g} s amid its own noise."
            add("stuck", channel.name, stuck, "s", "warning", says)
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
        coarse = len(np.unique(y)) < 0.5 * len(y)
        usual = np.quantile(np.abs(step), 0.995)
        starts = np.flatnonzero(np.diff(same.astype(int), prepend=0) == 1)
        ends = np.flatnonzero(np.diff(same.astype(int), append=0) == -1) + 1
        for i, j in zip(starts, ends, strict=True):
            jumps = j < len(step) and abs(step[j]) > 4.0 * usual
            if j - i >= 8 and (jumps or not coarse):
                longest = max(longest, float(t[j] - t[i]))
    # Where most samples repeat, the channel is slow, or at rest.
    return longest if moving > 0.3 * n else 0.0


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
        elif abs(ratio - 1.0) > max(_SURE * std / facts.gravity, 0.005):
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
    for episode in _some_episodes(recording, 600):
        t, p = _rows(recording, values, episode)
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
    scale = 1000.0 if down > 100.0 * _G else 1.0
    flying = (
        0.3 * _G < down / scale < 3.0 * _G
        and np.all(left < 1.6 * noise + 1e-12)
        and np.all(np.abs(a[:2]) < 0.15 * _G * scale + 4.0 * each[:2])
    )
    return (float(down), float(each[2])) if flying else None


def check_excitation(recording: Recording, facts: SceneFacts) -> list[Finding]:
    """Whether each joint's motion can tell the usual effects apart at all."""
    found: list[Finding] = []
    for at in recording.places(("position",)):
        e = excitation(recording, at)
        if e is None:
            continue
        name = f"{at}.position"
        prismatic = facts.joints.get(at, JointFacts()).prismatic
        unit = unit_of("position", prismatic)

        def add(kind: str, size: float, unit: str, says: str, name=name) -> None:
            found.append(Finding(kind, recording.name, name, size, unit, "info", says))

        if e.range < 20.0 * recording.channels[name].noise:
            says = (
                f"{at} hardly moves ({e.range:.2g} {unit}): nothing of it can be told."
            )
            add("no_motion", e.range, unit, says)
            continue
        if e.reversals < 3:
            says = (
                f"{at} reverses {e.reversals} times: dry friction and a constant bias "
                "cannot be told apart."
            )
            add("few_reversals", e.reversals, "1", says)
        if e.speed_decades < 0.5:
            says = (
                f"{at} moves at nearly one speed ({e.speed_decades:.2g} decades): "
                "viscous and dry friction cannot be told apart."
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
    for episode in _some_episodes(recording):
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


def _notes(recording: Recording) -> list[Finding]:
    return [
        Finding(kind, recording.name, "time", 0.0, "", "warning", says + ".")
        for kind, says in recording.notes
    ]


def _some_episodes(recording: Recording, most: int = _MOST_EPISODES) -> list[Episode]:
    """All episodes, or evenly spread ones; the first rows of very long ones."""
    episodes = recording.episodes
    if len(episodes) > most:
        pick = np.linspace(0, len(episodes) - 1, most).astype(int)
        episodes = tuple(episodes[i] for i in pick)
    return [
        Episode(e.number, e.first, min(e.last, e.first + _MOST_ROWS), e.stretch)
        for e in episodes
    ]


def _rows(recording: Recording, values: np.ndarray, episode: Episode):
    """Times and rows of an episode in which nothing is missing."""
    there = ~np.isnan(values[episode.rows]).any(axis=1)
    return recording.time[episode.rows][there], values[episode.rows][there]


def _longest_sec(recording: Recording) -> float:
    t = recording.time
    return max(float(t[e.last - 1] - t[e.first]) for e in recording.episodes)


def _width(n: int) -> float:
    """Of the Gaussian [samples]: narrow where an episode is short."""
    return 3.0 if n > 300 else 1.5


def _related(
    recording: Recording, y: str, x: str, order: int, held: bool = False
) -> Relation | None:
    parts = []
    for episode in _some_episodes(recording):
        t_y, values_y = recording.samples(y, episode)
        t_x, values_x = recording.samples(x, episode)
        if min(len(t_y), len(t_x)) < 20:
            continue
        width = _width(min(len(t_y), len(t_x)))
        relation = relate(t_y, values_y, t_x, values_x, order, held, width=width)
        if relation is not None:
            parts.append(relation)
    return _together(parts)


def _together(parts: list[Relation]) -> Relation | None:
    """The weighted mean of episodes, with the larger of both standard errors."""
    if not parts:
        return None
    if len(parts) == 1:
        return parts[0]

    def mean(name: str) -> tuple[float, float]:
        value = np.array([getattr(p, name) for p in parts])
        std = np.array([getattr(p, f"{name}_std") for p in parts])
        if not np.isfinite(std).any():
            return 0.0, np.inf
        weight = np.where(np.isfinite(std), np.maximum(std, 1e-12) ** -2.0, 0.0)
        # No episode counts more than ten middling ones.
        weight = np.minimum(weight, 10.0 * np.median(weight[weight > 0.0]))
        middle = float(np.average(value, weights=weight))
        n = int((weight > 0.0).sum())
        scatter = np.sqrt(
            np.average((value - middle) ** 2, weights=weight) / max(n - 1, 1)
        )
        share = weight / weight.sum()
        fit = np.sqrt(np.sum((share * np.where(np.isfinite(std), std, 0.0)) ** 2))
        return middle, float(max(scatter, fit))

    scale, scale_std = mean("scale")
    bias, bias_std = mean("bias")
    lag, lag_std = mean("lag")
    skew, skew_std = mean("skew")
    rms = [np.sqrt(np.mean([getattr(p, k) ** 2 for p in parts])) for k in ("residual",)]
    return Relation(
        scale=scale,
        scale_std=scale_std,
        bias=bias,
        bias_std=bias_std,
        lag=lag,
        lag_std=lag_std,
        skew=skew,
        skew_std=skew_std,
        residual=float(rms[0]),
        signal=float(np.sqrt(np.mean([p.signal**2 for p in parts]))),
        period=parts[0].period,
    )

"""How channels of a recording relate to each other where they measure one motion."""

from collections.abc import Collection, Sequence

import numpy as np

from makebreak.gap.data.findings import (
    SURE,
    Finding,
    complete_rows,
    longest_sec,
    some_episodes,
)
from makebreak.gap.data.recording import Recording, unit_of
from makebreak.gap.data.table import TWIST
from makebreak.gap.data.units import unit_of_rate
from makebreak.gap.numerics.signal_relation import (
    Relation,
    angular_velocity,
    relate,
)
from makebreak.systems.numerics.filters import filtered


def check_relations(recording: Recording, told: Collection[str]) -> list[Finding]:
    """Velocity against position, measured against commanded effort: scale, bias, lag,
    and a lag that grows, which is a clock that runs fast or slow.

    Args: told: channels that are in other units than they should.
    """
    found: list[Finding] = []
    for at in recording.places(("velocity",)):
        pair = {f"{at}.position", f"{at}.velocity"}
        if f"{at}.position" in recording and not pair & {*told}:
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
    if relation is None or not is_rate(relation):
        return []
    found, r = [], relation
    filters = recording.channels[name].stages
    # Noise of the position makes the scale too small, by at most its share of power.
    faded = 2.0 * (r.residual / r.signal) ** 2
    unit = unit_of(name.rsplit(".", 1)[1])

    def add(kind: str, size: float, unit: str, severity: str, says: str) -> None:
        found.append(Finding(kind, recording.name, name, size, unit, severity, says))

    wrong = unit_of_rate(1.0 / r.scale, prismatic=unit == "m/s")
    if wrong is not None and wrong.factor != 1.0:
        says = (
            f"{name} is {r.scale:.4g} times the derivative of position, as if in "
            f"{wrong.name}."
        )
        add("units", r.scale, "1", "error", says)
        return found
    if r.scale < 0.0:
        says = f"{name} has the opposite sign of the derivative of position."
        add("sign", r.scale, "1", "error", says)
    elif abs(r.scale - 1.0) > max(SURE * r.scale_std, 0.01, faded):
        says = (
            f"{name} is {r.scale:.4f} +- {r.scale_std:.4f} times the derivative of "
            "position."
        )
        add("velocity_scale", r.scale, "1", "warning", says)
    if abs(r.bias) > max(SURE * r.bias_std, 0.005 * r.signal):
        way = "high" if r.bias > 0.0 else "low"
        says = f"{name} reads {abs(r.bias):.3g} {unit} too {way}, by its integral."
        add("velocity_bias", r.bias, unit, "warning", says)
    if run_apart(r, longest_sec(recording)):
        late = "later" if r.skew > 0.0 else "earlier"
        says = (
            f"{name} comes {late} by {abs(r.skew) * 1e3:.3g} ms each second than "
            "position: their clocks run apart."
        )
        add("clock_skew", r.skew, "s/s", "warning", says)
    elif is_late(r):
        says = says_late([name], [r], ", beyond its declared filter" if filters else "")
        add("velocity_lag", r.lag, "s", "warning", says)
    return found


def is_rate(r: Relation) -> bool:
    """Whether a velocity follows from its position."""
    return not r.residual > 0.3 * r.signal


def run_apart(r: Relation, longest: float) -> bool:
    """Whether the clocks of a velocity and its position do, over so long [s]."""
    return abs(r.skew) > max(SURE * r.skew_std, 2e-5, 0.15 * r.period / longest)


def is_late(r: Relation) -> bool:
    """Whether a velocity comes later or earlier than its position beyond doubt."""
    return abs(r.lag) > max(SURE * r.lag_std, 0.15 * r.period)


def says_late(names: Sequence[str], each: Sequence[Relation], beyond: str = "") -> str:
    """A sentence for velocities that are late, or early, or differences. beyond: what
    is declared already."""
    lags = sorted(1e3 * abs(r.lag) for r in each)
    by = f"{lags[0]:.3g} +- {1e3 * each[0].lag_std:.2g} ms"
    if f"{lags[0]:.2g}" != f"{lags[-1]:.2g}":
        by = f"{lags[0]:.3g} to {lags[-1]:.3g} ms"
    comes, it = ("come", "them") if len(names) > 1 else ("comes", "it")
    as_what = ""
    if each[0].of_a_difference():
        as_what = f", as a backward difference of {it} would"
    late = "after" if each[0].lag > 0.0 else "before"
    return f"{', '.join(names)} {comes} {by} {late} position{beyond}{as_what}."


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
        for episode in some_episodes(recording):
            t, q = complete_rows(recording, quaternions, episode)
            t_w, w = recording.samples(name, episode)
            if min(len(t), len(t_w)) < 20:
                continue
            middle, world, body = angular_velocity(t, q)
            for frame, rate in (("world", world), ("body", body)):
                # By the samples themselves; a lag is small beside another frame.
                wrong = np.interp(t_w, middle, rate[:, j]) - w
                left[frame] += float(np.sum(wrong**2))
            stages = recording.channels[name].stages or ()
            behind = filtered(stages, middle, world[:, j])
            relation = relate(t_w, w, middle, behind, width=width_of(len(t)))
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
    if abs(r.scale - 1.0) > max(SURE * r.scale_std, 0.01):
        says = f"{name} is {r.scale:.4f} +- {r.scale_std:.4f} times its command."
        add("effort_scale", r.scale, "1", "warning", says)
    if abs(r.bias) > max(SURE * r.bias_std, 0.005 * r.signal):
        says = f"{name} reads {r.bias:.3g} N m above its command."
        add("effort_bias", r.bias, "N m", "warning", says)
    slip = r.period / longest_sec(recording)  # Within a row, nothing can be told.
    if abs(r.skew) > max(SURE * r.skew_std, 2e-5, slip):
        says = (
            f"{name} comes later by {r.skew * 1e3:.3g} ms each second than its "
            "command: their clocks run apart."
        )
        add("clock_skew", r.skew, "s/s", "warning", says)
    # Within a row, the sample may be taken before or after the new command: a period.
    elif abs(r.lag) > 1.2 * r.period + SURE * r.lag_std:
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


def width_of(n: int) -> float:
    """Of the Gaussian [samples]: narrow where an episode is short."""
    return 3.0 if n > 300 else 1.5


def _related(
    recording: Recording, y: str, x: str, order: int, held: bool = False
) -> Relation | None:
    parts = []
    for episode in some_episodes(recording):
        t_y, values_y = recording.samples(y, episode)
        t_x, values_x = recording.samples(x, episode)
        if min(len(t_y), len(t_x)) < 20:
            continue
        width = width_of(min(len(t_y), len(t_x)))
        if not held:
            # Each behind the other's declared filters: they then have the same ones.
            values_y, values_x = (
                filtered(recording.channels[b].stages or (), t, values)
                for t, values, b in ((t_y, values_y, x), (t_x, values_x, y))
            )
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
    return Relation(
        scale=scale,
        scale_std=scale_std,
        bias=bias,
        bias_std=bias_std,
        lag=lag,
        lag_std=lag_std,
        skew=skew,
        skew_std=skew_std,
        residual=float(np.sqrt(np.mean([p.residual**2 for p in parts]))),
        signal=float(np.sqrt(np.mean([p.signal**2 for p in parts]))),
        period=parts[0].period,
    )

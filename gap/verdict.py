"""The verdict on a gap, in numbers and in words."""

from collections.abc import Sequence
from dataclasses import replace
from math import isfinite, isnan

from pydrake.multibody.plant import MultibodyPlant

from makebreak.gap.budget import present
from makebreak.gap.data.recording import unit_of
from makebreak.gap.problem import leaves_gap, share_left
from makebreak.gap.result import Estimate, Evidence, GapMeasure, NamedEffect, plain
from makebreak.gap.search.choice import Choice, Selection, called
from makebreak.gap.thresholds import (
    AGREEMENT_RMS_MAX,
    CLOSED_SHARE_MIN,
    NOISE_RMS_MAX,
    UNEXPLAINED_RMS,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import (
    of_slides,
    sentence,
    sliding_joints,
    unit_at,
)

OF_CHANNEL = "(unit of the channel)"


def figure(x: float, digits: int = 3) -> str:
    """So many digits of x, in full: 3700 and not 3.7e+03."""
    return f"{float(f'{x:.{digits}g}'):g}"


def in_plain_units(gap: GapMeasure) -> str:
    """In brackets, the error of the channel that is farthest off, in its own unit,
    beside what a perfect model would leave; nothing where that is not known."""
    known = {
        name: each for name, each in gap.in_units.items()
        if isfinite(each.expected + each.before) and name in gap.per_channel
    }  # fmt: skip
    if not known:
        return ""
    name = max(known, key=lambda n: gap.per_channel[n]["before"])
    e = known[name]
    goes = plain(e.before, e.unit)
    if e.after != e.before and isfinite(e.after):
        goes = f"from {goes} to {plain(e.after, e.unit)}"
    return (
        f" ({name}: {goes}; expected from noise and uncertain start: "
        f"{plain(e.expected, e.unit)})"
    )


def verdict_of(
    choices: Sequence[Choice], start: float, end: float, far: bool = False
) -> str:
    """Args: start, end: held-out error without and with all effects, the background
    within its tolerance; far: it had to be moved beyond."""
    if not choices:
        calm = start <= max(AGREEMENT_RMS_MAX, NOISE_RMS_MAX) and not far
        return "no_gap" if calm else "gap_unnamed"
    if far or leaves_gap(start, end):
        return "gap_unnamed"
    return "ambiguous" if any(c.ties or c.sets for c in choices) else "gap_named"


def after_simulation(
    verdict: str, choices: Sequence[Choice], gap: GapMeasure, far: bool = False
) -> str:
    """The verdict by the equations, after simulated windows were asked.

    Args: gap: of windows that were chosen on; far: as of verdict_of.
    """
    if not choices:
        return verdict
    if gap.after > max(gap.before, UNEXPLAINED_RMS):
        return "gap_unnamed"  # Simulation does not bear the equations out.
    if gap.after > UNEXPLAINED_RMS and gap.reduction < CLOSED_SHARE_MIN:
        return "gap_unnamed"  # Most of what it shows is something else.
    if (
        verdict == "gap_unnamed"
        and gap.before > UNEXPLAINED_RMS
        and gap.after <= AGREEMENT_RMS_MAX
    ):
        # With the effects no gap is left. What the equations leave is how a law was
        # written down in them (a backlash: where the link is in its gap).
        return verdict_of(choices, 1.0, 1.0, far)
    return verdict


def why_not_confirmed(verdict: str, gap: GapMeasure) -> str:
    """Why an agreement does not stand, in words; empty where it does. gap: of windows
    that nothing was decided on."""
    if verdict != "no_gap" or not gap.before > UNEXPLAINED_RMS:
        return ""
    return (
        " The data used for the decision show no error beyond noise, but on the data "
        f"held out for the report the simulation error is {figure(gap.before, 2)} "
        f"times the expected error{in_plain_units(gap)}."
    )


def withdraw_if_weak(
    selection: Selection, verdict: str, closed: float
) -> tuple[Selection, str]:
    """The selection, without effects where they are no name for the gap, and then what
    they are worth, in words. closed: share of the gap that they close, simulated and in
    the equations."""
    if verdict != "gap_unnamed" or not selection.choices or closed >= CLOSED_SHARE_MIN:
        return selection, ""
    names = [called(c.effect) for c in selection.choices]
    near = f" The best candidates ({'; '.join(names)}) "
    if isnan(closed):  # No window could be simulated to its end.
        near += "could not be judged by simulation, so none is named."
    else:
        near += f"close {max(closed, 0.0):.0%} of the gap, too little to be named."
    return replace(selection, choices=(), end=selection.start), near


def shows_in_equations_alone(gap: GapMeasure) -> bool:
    """Whether simulated windows do not show what is left."""
    return gap.window_s > 0.0 and gap.after <= AGREEMENT_RMS_MAX


def two_figures(
    start: float, end: float, gap: GapMeasure, by_equations: bool = True
) -> str:
    """A sentence where equations, whose error goes from start to end, and simulated
    windows disagree on what is left by more than a factor of two, or only equations
    show the gap (a heavier object goes where it is pushed all the same); else nothing.
    by_equations: False where these errors are of simulated windows, too: of the data
    that effects were selected on."""
    if not start > AGREEMENT_RMS_MAX or not gap.window_s > 0.0:
        return ""
    if gap.before <= AGREEMENT_RMS_MAX:
        where = "Simulated windows do not show this gap; in the equations of motion"
        if not by_equations:
            where = (
                "The data held out for the report do not show this gap; in the data "
                "that effects were selected on"
            )
        elif gap.in_equations and gap.in_equations[0] > AGREEMENT_RMS_MAX:
            where += " of data held out for the report"
            start, end = gap.in_equations
        goes = f"is {figure(start)}"
        if end < start:
            goes = f"falls from {figure(start)} to {figure(end)}"
        return f" {where} the error {goes} times the expected error."
    one, other = (share_left(*each) for each in ((start, end), (gap.before, gap.after)))
    # Of next to nothing, half and twice are the same.
    if 0.5 <= max(one, 0.1) / max(other, 0.1) <= 2.0:
        return ""
    if not by_equations:
        return (
            f" Of the gap {min(one, 1.0):.0%} is left in the data that effects were "
            f"selected on, {other:.0%} in the data held out for the report."
        )
    return (
        f" The equations of motion say that {min(one, 1.0):.0%} of the gap is "
        f"left, simulation {other:.0%}: trust the simulation, because it is how "
        "the repaired model will be used."
    )


def named(choice: Choice, plant: MultibodyPlant, beside: str = "") -> NamedEffect:
    """The choice in the report's words.

    Args: plant: the scene's, without it. beside: what it makes channels late beside.
    """
    kind = KINDS[choice.effect.kind]
    slides = kind.at in ("joint", "actuator") and of_slides(choice.effect, plant)
    own_unit = OF_CHANNEL
    if kind.at == "channel" and (place := choice.effect.at[0]).count(".") == 2:
        joint, quantity = place.rsplit(".", 1)
        own_unit = unit_of(quantity, joint in sliding_joints(plant))
    parameters, std = {}, {}
    weak = False
    for each in kind.parameters:
        if each.name not in choice.effect.parameters:
            continue
        value = choice.effect.parameters[each.name]
        spread = choice.std.get(each.name, 0.0)
        width = each.high - each.low
        if not spread < width:  # The data say nothing of it.
            spread = float("inf")
        weak |= spread > max(abs(value), 1e-3 * width)
        unit = own_unit if each.unit == OF_CHANNEL else unit_at(each.unit, slides)
        or_more = each.name in choice.or_more
        is_fitted = each.name not in choice.fixed
        parameters[each.name] = Estimate(value, spread, unit, or_more, is_fitted)
        if spread > 0.0:
            std[each.name] = spread
    apart = ""
    tied = bool(choice.ties or choice.sets)
    if tied or kind.tell_apart:
        apart = kind.tell_apart[:1].upper() + kind.tell_apart[1:] + "."
    says = sentence(choice.effect, kind, std, slides, choice.or_more, choice.fixed)
    says = says.replace(OF_CHANNEL, own_unit)
    if beside:
        says += f" beside {beside}"
    return NamedEffect(
        choice.effect.kind,
        tuple(choice.effect.at),
        parameters,
        says[:1].upper() + says[1:] + ".",
        Evidence(
            choice.before, choice.after, choice.runner_up, choice.margin, choice.why
        ),
        choice.ties,
        apart if tied else "",
        "weak" if weak else "identifiable",
        sets=choice.sets,
    )


def says(
    verdict: str,
    effects: Sequence[NamedEffect],
    gap: GapMeasure,
    more: str = "",
    left: float = 0.0,
    by_equations: bool = True,
) -> str:
    """The first screen's sentence. more: what is to be added to it; left: the error in
    the equations of motion, with all effects; by_equations: as of two_figures."""
    before, after = figure(gap.before), figure(gap.after)
    if verdict == "no_gap":
        return (
            "The scene and the recordings agree to within noise and tolerance "
            f"(held-out error {figure(gap.before, 2)} times the expected error"
            f"{in_plain_units(gap).replace(' (', '; ').replace(')', '')}).{more}"
        )
    if verdict == "not_judged":
        return (
            "The channels that were compared agree (held-out error "
            f"{figure(gap.before, 2)} times the expected error), but not every "
            f"measured channel was compared, so the scene is not confirmed.{more} "
            "To leave a channel out, write `columns: {name: null}` in the recording's "
            "sidecar."
        )
    words = " ".join(each.says for each in effects)
    if verdict == "gap_unnamed":
        head = f"{words} Beyond that, " if words else ""
        error = f"{after} times the expected error"
        if shows_in_equations_alone(gap) and left > gap.after:
            places = "the equations of motion", "simulated windows"
            if not by_equations:
                places = "the data for selection", "those for the report"
            error = f"{figure(left)} times the expected error in {places[0]}, "
            error += f"{after} in {places[1]}"
        if words and gap.before > AGREEMENT_RMS_MAX:
            error += f" ({before} without what is named)"
        tried = "tried so far" if present().undone else "of the catalogue"
        if not shows_in_equations_alone(gap):
            error += in_plain_units(gap)
        return head + (
            f"{'a' if head else 'A'} gap remains that no effect {tried} explains: "
            f"held-out error {error}.{more}"
        )
    tail = ""
    if verdict == "ambiguous":
        tail = _apart_from(effects)
    goes = "falls" if gap.after < gap.before else "goes"
    return (
        f"{words}{tail} The held-out error {goes} from {before} to {after} times the "
        f"expected error{in_plain_units(gap)}.{more}"
    )


def _apart_from(effects: Sequence[NamedEffect]) -> str:
    """What the data do not tell the effects from, in words."""
    kinds = sorted(
        {t.kind for e in effects for t in e.indistinguishable_from if t.kind != e.kind}
    )
    places = sorted(
        {", ".join(t.at) for e in effects for t in e.indistinguishable_from
         if t.kind == e.kind}
    )  # fmt: skip
    text = ""
    if kinds:
        text += f" These data cannot distinguish it from {', '.join(kinds)}."
    if places:
        text += f" It could equally be at {' or '.join(places)}."
    for each in effects:
        for rival in each.sets:
            two = [f"{each.kind} at {', '.join(each.at)}", *map(called, rival.beside)]
            text += (
                f" These data cannot distinguish {' together with '.join(two)} from "
                f"{' together with '.join(map(called, rival.instead))}."
            )
    return text

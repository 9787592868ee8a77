"""The verdict on a gap, in numbers and in words."""

from collections.abc import Sequence
from dataclasses import replace

from pydrake.multibody.plant import MultibodyPlant

from makebreak.gap.recording import unit_of
from makebreak.gap.result import Estimate, Evidence, NamedEffect
from makebreak.gap.select import FLOOR, Choice, Selection
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import (
    of_slides,
    sentence,
    sliding_joints,
    unit_at,
)

# Left after all that could be named: more than so many times the noise, and more than
# this share of the gap, is a gap without a name.
UNNAMED, UNNAMED_SHARE = 2.0, 0.2
# Effects that leave a gap without a name are told only if they close this share of it,
# simulated: less is what any model with a free parameter may fit to another law.
TOLD = 0.5
OF_CHANNEL = "(unit of the channel)"
NO_GAP = 1.5  # Times the noise, after the background within its tolerance.


def verdict_of(
    choices: Sequence[Choice], start: float, end: float, far: bool = False
) -> str:
    """Args: start, end: held-out error without and with all effects, the background
    within its tolerance; far: it had to be moved far beyond."""
    if not choices:
        calm = start <= max(NO_GAP, FLOOR) and not far
        return "no_gap" if calm else "gap_unnamed"
    if end > max(UNNAMED, UNNAMED_SHARE * start):
        return "gap_unnamed"
    return "ambiguous" if any(c.ties for c in choices) else "gap_named"


def told(selection: Selection, verdict: str, closed: float) -> tuple[Selection, str]:
    """The selection, without effects where they are no name for the gap, and then what
    they are worth, in words. closed: share of the gap that they close, simulated."""
    if verdict != "gap_unnamed" or not selection.choices or closed >= TOLD:
        return selection, ""
    names = [f"{c.effect.kind} at {', '.join(c.effect.at)}" for c in selection.choices]
    near = (
        f" The nearest that it has ({'; '.join(names)}) closes {max(closed, 0.0):.0%} "
        "of it, too little to be named."
    )
    return replace(selection, choices=(), end=selection.start), near


def named(choice: Choice, plant: MultibodyPlant) -> NamedEffect:
    """The choice in the report's words; plant: the scene's, without it."""
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
        parameters[each.name] = Estimate(value, spread, unit)
        if spread > 0.0:
            std[each.name] = spread
    apart = ""
    if choice.ties or kind.tell_apart:
        apart = kind.tell_apart[:1].upper() + kind.tell_apart[1:] + "."
    says = sentence(choice.effect, kind, std, slides).replace(OF_CHANNEL, own_unit)
    return NamedEffect(
        choice.effect.kind,
        tuple(choice.effect.at),
        parameters,
        says[:1].upper() + says[1:] + ".",
        Evidence(choice.before, choice.after, choice.runner_up, choice.margin),
        choice.ties,
        apart if choice.ties else "",
        "weak" if weak else "identifiable",
    )


def says(
    verdict: str,
    effects: Sequence[NamedEffect],
    start: float,
    end: float,
    near: str = "",
) -> str:
    """The first screen's sentence. near: what `told` left out, in words."""
    if verdict == "no_gap":
        return (
            "The scene and the recordings agree: nothing is left beyond noise and "
            f"tolerance (held-out error {start:.2g} times the noise)."
        )
    words = " ".join(each.says for each in effects)
    if verdict == "gap_unnamed":
        head = f"{words} Beyond that, " if words else ""
        return head + (
            f"{'a' if head else 'A'} gap is left that no effect of the catalogue "
            f"explains: held-out error {end:.3g} times the noise.{near}"
        )
    tail = ""
    if verdict == "ambiguous":
        others = sorted({t.kind for e in effects for t in e.indistinguishable_from})
        tail = f" These data cannot tell it apart from {', '.join(others)}."
    return f"{words}{tail} Held-out error falls from {start:.3g} to {end:.3g}."

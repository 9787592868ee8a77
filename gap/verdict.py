"""The verdict on a gap, in numbers and in words."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import isfinite

from pydrake.multibody.plant import MultibodyPlant

from makebreak.gap.budget import present
from makebreak.gap.data.recording import unit_of
from makebreak.gap.problem import leaves_gap, share_left
from makebreak.gap.result import (
    Estimate,
    Evidence,
    GapMeasure,
    NamedEffect,
    Tried,
    plain,
)
from makebreak.gap.said import called, figure, said_together
from makebreak.gap.search.choice import Choice
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
from makebreak.models.effects.sizes import range_of, sizes_of

OF_CHANNEL = "(unit of the channel)"


def in_plain_units(gap: GapMeasure) -> str:
    """In brackets, the error of the channel that is farthest off, in its own unit,
    beside what a perfect model would leave; nothing where that is not known."""
    known = {
        name: each for name, each in gap.in_units.items()
        if isfinite(each.expected + each.before) and name in gap.per_channel
        and each.unit != "1"  # A quaternion's part tells a reader nothing.
    }  # fmt: skip
    if not known:
        return ""
    name = max(known, key=lambda n: gap.per_channel[n]["before"])
    e = known[name]
    goes, to = plain(e.before, e.unit), plain(e.after, e.unit)
    if to != goes and isfinite(e.after):
        goes = f"from {goes} to {to}"
    return (
        f" ({name}: {goes}; expected from noise and uncertain start: "
        f"{plain(e.expected, e.unit)})"
    )


@dataclass(frozen=True, eq=False)
class Facts:
    """What a verdict is decided by.

    choices: what is named. start, end: held-out error without and with it, the
    background within its tolerance; far: that had to be moved beyond. chosen_on,
    reported: what simulation says of data that effects were chosen on, and of data that
    nothing was decided on; None: not asked. loud: a channel, or equation, and how many
    times its noise it is off, of which more than `loud_max` is a gap. asks_simulation:
    whether agreement needs simulated windows. turned: that another direction of gravity
    explains as much, as a sentence. unjudged: what was measured and not compared, as a
    sentence. found_before: whether an effect was taken off the recordings beforehand.
    steady: `start` without the block of time that leaves most: no single stretch
    decides. below: held-out error with effects, too, that move simulated windows less
    than the scene's own time step does.
    """

    choices: Sequence[Choice]
    start: float
    end: float
    far: bool = False
    chosen_on: GapMeasure | None = None
    reported: GapMeasure | None = None
    loud: tuple[str, float] = ("", 0.0)
    loud_max: float = UNEXPLAINED_RMS
    asks_simulation: bool = False
    turned: str = ""
    unjudged: str = ""
    found_before: bool = False
    steady: float = float("inf")
    below: float = float("inf")


def _before(gap: GapMeasure | None) -> float:
    """The simulated error without effects; 0 where nothing was simulated."""
    return gap.before if gap is not None and gap.is_measured else 0.0


def _left_in_simulation(f: Facts) -> bool:
    """Simulation does not bear the equations out, or most of what it shows is something
    else."""
    g = f.chosen_on
    if g is None or not g.is_measured:
        return False
    if g.after > max(g.before, UNEXPLAINED_RMS):
        return True
    return g.after > UNEXPLAINED_RMS and g.reduction < CLOSED_SHARE_MIN


def _closed_in_simulation(f: Facts) -> bool:
    """With the effects simulated windows show no gap any more. What the equations leave
    is how a law was written down in them (a backlash: where the link is in its gap)."""
    g = f.chosen_on
    return _before(g) > UNEXPLAINED_RMS and g.after <= AGREEMENT_RMS_MAX  # type: ignore[union-attr]


def _agree_in_simulation(f: Facts) -> bool:
    """Simulated windows show nothing, and the equations hardly more than smoothing."""
    return f.steady <= UNEXPLAINED_RMS and 0.0 < _before(f.chosen_on) <= NOISE_RMS_MAX


def _not_simulated(f: Facts) -> bool:
    return f.chosen_on is None or not f.chosen_on.is_measured


def _said(text: str) -> Callable[[Facts], str]:
    return lambda f: text


# (condition, verdict, sentence): the first that holds decides.
Row = tuple[Callable[[Facts], bool], str, Callable[[Facts], str]]
WITHOUT_EFFECTS: Sequence[Row] = (
    (lambda f: f.far or not (f.start <= max(AGREEMENT_RMS_MAX, NOISE_RMS_MAX)
                             or f.below <= UNEXPLAINED_RMS or _agree_in_simulation(f)),
     "gap_unnamed", _said("")),
    # Among many others one that is off would not show.
    (lambda f: f.loud[1] > max(f.loud_max, UNEXPLAINED_RMS), "gap_unnamed",
     lambda f: f" {f.loud[0]} is off by {figure(f.loud[1], 2)} times its noise."),
    (lambda f: f.asks_simulation and _not_simulated(f), "not_judged",
     _said(" No window could be simulated.")),
    (lambda f: _before(f.chosen_on) > UNEXPLAINED_RMS, "gap_unnamed",
     _said(" The equations of motion agree, simulated windows do not.")),
    (lambda f: _before(f.reported) > UNEXPLAINED_RMS, "gap_unnamed",
     lambda f: (
        " The data used for the decision show no error beyond noise, but on the data "
        "held out for the report the simulation error is "
        f"{figure(_before(f.reported), 2)} times the expected "
        f"error{in_plain_units(f.reported) if f.reported else ''}.")),
    (lambda f: bool(f.unjudged), "not_judged", lambda f: f.unjudged),
    (lambda f: f.found_before, "gap_named", _said("")),
    (lambda f: True, "no_gap", _said("")),
)  # fmt: skip
WITH_EFFECTS: Sequence[Row] = (
    (lambda f: f.far or _left_in_simulation(f), "gap_unnamed", _said("")),
    (lambda f: leaves_gap(f.start, min(f.end, f.below))
     and not _closed_in_simulation(f), "gap_unnamed", _said("")),
    (lambda f: bool(f.turned), "ambiguous", lambda f: f.turned),
    (lambda f: any(c.ties for c in f.choices), "ambiguous", _said("")),
    (lambda f: True, "gap_named", _said("")),
)  # fmt: skip


def decide(facts: Facts) -> tuple[str, str]:
    """The verdict, and what is to be said of it beside the figures."""
    rows = WITH_EFFECTS if facts.choices else WITHOUT_EFFECTS
    return next((verdict, says(facts)) for holds, verdict, says in rows if holds(facts))


def closed_at(gap: GapMeasure, acts_at: Callable[[str], bool]) -> float:
    """Share of the gap that is closed: of the whole, or of that of one of an effect's
    own channels, whichever is more."""
    own = [
        1.0 - share_left(each["before"], each["after"])
        for name, each in gap.per_channel.items()
        if each["before"] > AGREEMENT_RMS_MAX and acts_at(name)
    ]
    return max([gap.reduction, *own])


def too_weak(
    facts: Facts, closed: float, acts_on: Callable[[Choice, str], bool]
) -> list[tuple[Choice, str]]:
    """Of effects that leave a gap those that are no name for it, and why, in words.

    Args: closed: share of the gap that all close in the equations. acts_on: whether one
        acts at a channel, whose own gap counts, too: what one joint lacks is no less
        certain where much is left at others.
    """
    if not facts.choices or decide(facts)[0] != "gap_unnamed":
        return []
    weak = []
    for choice in facts.choices:
        most = closed
        if facts.chosen_on is not None:
            own = closed_at(facts.chosen_on, partial(acts_on, choice))
            most = min(closed, own)
        if most < CLOSED_SHARE_MIN:
            why = f"It closes {max(most, 0.0):.0%} of the gap, too little to be named."
            weak.append((choice, why))
    return weak


def tried(choice: Choice, why: str, plant: MultibodyPlant) -> Tried:
    """An effect that the data do not confirm, in the report's words."""
    each = named(choice, plant)
    return Tried(each.kind, each.at, each.parameters, each.says, why)


def says_tried(of: Sequence[Tried]) -> str:
    """What was tried, with its value and why it is not named, as sentences: those with
    one reason together."""
    text = ""
    for why in dict.fromkeys(each.why for each in of):
        each = [
            f"{t.kind} at {', '.join(t.at)} ({_values(t)})" for t in of if t.why == why
        ]
        text += f" Tried, not confirmed: {'; '.join(each)}. {why}"
    return text


def _values(of: Tried) -> str:
    return ", ".join(
        f"{name} {p.text()} {p.unit}".strip() for name, p in of.parameters.items()
    )


def shows_in_equations_alone(gap: GapMeasure) -> bool:
    """Whether simulated windows do not show what is left."""
    return gap.window_s > 0.0 and gap.after <= AGREEMENT_RMS_MAX


def below_noise(choices: Sequence[Choice], start: float, gap: GapMeasure) -> str:
    """A sentence where effects are named though no error is larger than it may be."""
    if not choices or max(start, gap.before) > AGREEMENT_RMS_MAX:
        return ""
    it = "them" if len(choices) > 1 else "it"
    return (
        f" The error without {it} is no larger than noise and an uncertain start "
        f"allow; all data together leave no doubt of {it}."
    )


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
    go_with_size = any(p.of_size for p in kind.parameters)
    sizes = sizes_of(plant) if go_with_size else None
    weak = False
    for each in kind.parameters:
        if each.name not in choice.effect.parameters:
            continue
        value = choice.effect.parameters[each.name]
        spread = choice.std.get(each.name, 0.0)
        low, high = range_of(each, choice.effect.at, sizes)
        width = high - low
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
    if choice.ties or kind.tell_apart:
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
        apart if choice.ties else "",
        "weak" if weak else "identifiable",
        sliding=frozenset(
            at
            for tie in choice.ties
            if KINDS[tie.kind].at in ("joint", "actuator") and of_slides(tie, plant)
            for at in tie.at
        ),
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
    words = " ".join(said for said, _ in said_together(effects))
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
    goes = f"{'falls' if gap.after < gap.before else 'goes'} from {before} to {after}"
    if before == after:
        goes = f"stays at {after}"
    return (
        f"{words}{tail} The held-out error {goes} times the expected error"
        f"{in_plain_units(gap)}.{more}"
    )


def _apart_from(effects: Sequence[NamedEffect]) -> str:
    """What the data do not tell the effects from, in words."""
    text = ""
    for each in effects:
        it = "it" if len(effects) == 1 else called(each.effect())
        ties = each.indistinguishable_from
        kinds = sorted({t.kind for t in ties if t.kind != each.kind})
        places = sorted({", ".join(t.at) for t in ties if t.kind == each.kind})
        if kinds:
            text += f" These data cannot distinguish {it} from {', '.join(kinds)}."
        if places:
            it = "It" if it == "it" else f"The {it}"
            text += f" {it} could equally be at {' or '.join(places)}."
    return text

"""What data held out for the report confirm of the effects that a search has chosen.

They were neither fitted nor chosen on, and they may only veto: an effect stays if they
get no worse with it, as a whole and at each joint or body that it acts on. Of several
that act where they get worse the one that was added last goes; what stays is fitted
again, so that what is reported belongs to it. A tie goes if simulated windows refute
it. Nothing is chosen by its value here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.stats import ttest_1samp

from makebreak.gap.data.recording import Recording
from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import Fitted, GapProblem, Outcome, leaves_gap
from makebreak.gap.result import GapMeasure
from makebreak.gap.said import figure
from makebreak.gap.search.choice import (
    Choice,
    Selection,
    fixed_parameters,
    units_of,
)
from makebreak.gap.search.select import without
from makebreak.gap.thresholds import (
    AGREEMENT_RMS_MAX,
    CLOSED_SHARE_MIN,
    NOISE_RMS_MAX,
    P_VALUE_MIN,
    SAME_ERROR,
    SIMULATED_RIVAL_GAIN,
)
from makebreak.gap.verdict import closed_at
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints

# Windows in which nothing moves differ by less, and say nothing.
ROUNDING = 1e-6

Judge = Callable[[Selection], Outcome | None]
Veto = tuple[Choice, str]  # And why, as a sentence.


@dataclass(frozen=True, eq=False)
class Confirmed:
    """What held-out data left of a selection, what that is worth on them (None: they
    hold nothing to compare), and what they took away."""

    selection: Selection
    outcome: Outcome | None
    vetoed: tuple[Veto, ...] = ()


def judge_of(
    problem: GapProblem, reported: Sequence[Recording], jobs: int = 1
) -> Judge:
    """What held-out recordings say of a selection, each of which is simulated once;
    None where they hold nothing to compare."""
    known: dict[tuple, Outcome | None] = {}

    def judge(some: Selection) -> Outcome | None:
        if not reported:
            return None
        key = (
            tuple(e.key for e in some.effects()),
            some.start.b.tobytes(), some.end.b.tobytes(),
        )  # fmt: skip
        if key not in known:
            known[key] = problem.outcome(
                some.effects(), some.start, some.end, some.nuisances, reported, jobs
            )
        return known[key]

    return judge


def confirmed(problem: GapProblem, selection: Selection, judge: Judge) -> Confirmed:
    """The effects of a selection that the held-out recordings do not veto."""
    vetoed: list[Veto] = []
    outcome = judge(selection)
    while selection.choices and outcome is not None:
        found = _vetoes(problem, selection, outcome.gap, judge)
        if not found:
            found = _needless(problem, selection, outcome.gap, judge)
        if not found:
            break
        vetoed += found
        selection = without(problem, selection, *[choice.effect for choice, _ in found])
        outcome = judge(selection)
    if outcome is not None and any(c.ties for c in selection.choices):
        selection = _without_refuted(problem, selection, judge)
    return Confirmed(selection, outcome, tuple(vetoed))


def _vetoes(
    problem: GapProblem, selection: Selection, gap: GapMeasure, judge: Judge
) -> list[Veto]:
    """Of the effects that act where held-out data get worse with all of them the last
    ones; else those of which what is closed is no confirmation."""
    choices = selection.choices
    if not gap.is_measured:
        why = gap.failure or "It could not be judged by simulation."
        return [(choice, why) for choice in choices]
    found: dict[int, str] = {}
    for place, why, in_equations in _worse_places(gap):
        acting = [
            k for k, c in enumerate(choices)
            if acts_on(problem, c.effect, place)
            # Equations only approximate what has a state of its own.
            and not (in_equations and KINDS[c.effect.kind].hidden_state)
        ]  # fmt: skip
        if acting:
            found.setdefault(acting[-1], why)
    if not found and _is_worse_whole(gap):
        found[len(choices) - 1] = _goes("simulated error", gap.before, gap.after)
    if not found and selection.end.b.any():
        written = judge(_as_written(selection))
        if written is not None and _is_worse_whole(written.gap):
            found[len(choices) - 1] = "Without the nuisance parameters: " + _goes(
                "simulated error", written.gap.before, written.gap.after
            )
    if found:
        return [(choices[k], why) for k, why in found.items()]
    return [
        (choice, not_confirmed(gap))
        for choice in choices
        if not is_confirmed(gap, partial(acts_on_channel, problem, choice.effect))
    ]


def _needless(
    problem: GapProblem, selection: Selection, gap: GapMeasure, judge: Judge
) -> list[Veto]:
    """The last one of several effects (or of groups, one kind at several places) with
    which held-out windows are worse than with the others alone."""
    units = units_of(selection.choices)
    for unit in reversed(units) if len(units) > 1 else ():
        alone = _gap_without(problem, selection, unit, judge)
        if alone is None:
            continue
        places = {
            place for place in [WHOLE, *_channels_of(gap)]
            if place == WHOLE
            or any(acts_on(problem, c.effect, place) for c in unit)
        }  # fmt: skip
        for place in sorted(places):
            if not _is_worse_than(alone, gap, place):
                continue
            # Of a group what acts there, if that is worse than without, too.
            mine = [
                c for c in unit if place == WHOLE or acts_on(problem, c.effect, place)
            ]
            less = alone
            if len(mine) < len(unit):
                found = _gap_without(problem, selection, mine, judge)
                if found is None or not _is_worse_than(found, gap, place):
                    continue
                less = found
            if _is_worse_than(gap, less, WHOLE):  # Others are worse without.
                continue
            a, b = (_error_at(g, place) for g in (less, gap))
            at = "" if place == WHOLE else f" at {place}"
            why = (
                f"Beside the other effects it takes the held-out error{at} from "
                f"{figure(a)} to {figure(b)} times the expected error."
            )
            return [(c, why) for c in mine]
    return []


def _gap_without(
    problem: GapProblem, selection: Selection, some: Sequence[Choice], judge: Judge
) -> GapMeasure | None:
    """What held-out windows show without some effects; None: nothing."""
    outcome = judge(without(problem, selection, *[c.effect for c in some]))
    return outcome.gap if outcome is not None and outcome.gap.window_s else None


# ----- Where held-out data are worse

WHOLE = ""  # In the place of a joint or body: all of them.


def is_worse(before: float, after: float, squares: np.ndarray | None = None) -> bool:
    """Whether an error (over the noise) is larger than another one: by more than
    SAME_ERROR, or by less in so many windows that chance hardly gives it. An error that
    a right model may leave counts as none.

    Args: squares (2, n): mean squares of windows, or of blocks of time, before, after.
    """
    a, b = (max(x, NOISE_RMS_MAX) for x in (before, after))
    if not b > a:
        return False
    return b > (1.0 + SAME_ERROR) * a or (squares is not None and _is_sure(squares))


def _is_sure(squares: np.ndarray) -> bool:
    d = squares[1] - squares[0]
    d = d[np.isfinite(d)]
    if len(d) < 3 or not np.ptp(d) > 0.0:
        return False
    return float(ttest_1samp(d, 0.0, alternative="greater").pvalue) < P_VALUE_MIN


def _worse_places(gap: GapMeasure) -> list[tuple[str, str, bool]]:
    """(joint or body, why, whether by its equation) of each at which held-out data are
    worse after than before."""
    found = []
    for place, channels in _channels_of(gap).items():
        a, b = (_error_of(gap, channels, when) for when in ("before", "after"))
        if is_worse(a, b, _squares(gap, channels)):
            why = (
                f"With it the simulated error at {place} goes from {figure(a)} to "
                f"{figure(b)} times the expected error on held-out data."
            )
            found.append((place, why, False))
    for name, of in gap.equations.items():
        noise = max(of.noise, 1e-300)
        if is_worse(of.before / noise, of.after / noise, gap.by_block.get(name)):
            place = name.removesuffix(" equation").removesuffix(".effort")
            why = (
                f"With it the error in the equation of motion of {place} goes from "
                f"{figure(of.before)} to {figure(of.after)} {of.unit} on held-out data."
            )
            found.append((place, why, True))
    return found


def _is_worse_whole(gap: GapMeasure) -> bool:
    return is_worse(gap.before, gap.after, _squares(gap, list(gap.by_window)))


def _is_worse_than(alone: GapMeasure, gap: GapMeasure, place: str) -> bool:
    """Whether the simulated error is larger than without some effects, over what is
    expected and over the noise (of which windows may expect more in one of the two)."""
    one, two = (_squares_after(g, place) for g in (alone, gap))
    if one is None or two is None or one.shape != two.shape:
        return is_worse(_error_at(alone, place), _error_at(gap, place))
    expected = is_worse(
        _error_at(alone, place), _error_at(gap, place), np.stack([one[0], two[0]])
    )
    both = np.isfinite(one[1]) & np.isfinite(two[1])
    return expected and bool(np.mean(two[1][both]) > np.mean(one[1][both]))


def _error_at(gap: GapMeasure, place: str) -> float:
    if place == WHOLE:
        return gap.after
    return _error_of(gap, _channels_of(gap).get(place, ()), "after")


def _error_of(gap: GapMeasure, channels: Sequence[str], when: str) -> float:
    squares = [gap.per_channel[c][when] ** 2 for c in channels]
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


def _channels_of(gap: GapMeasure) -> dict[str, list[str]]:
    """{joint or body: its channels}."""
    found: dict[str, list[str]] = {}
    for channel in gap.per_channel:
        found.setdefault(channel.rsplit(".", 1)[0], []).append(channel)
    return found


def _squares(gap: GapMeasure, channels: Sequence[str]) -> np.ndarray | None:
    """(2, n) mean squares of windows over what is expected, of some channels."""
    known = [gap.by_window[c][0] for c in channels if c in gap.by_window]
    return np.mean(known, axis=0) if known else None


def _squares_after(gap: GapMeasure, place: str) -> np.ndarray | None:
    """(2, n) those with all effects, over what is expected and over the noise."""
    channels = gap.by_window if place == WHOLE else _channels_of(gap).get(place, ())
    known = [gap.by_window[c][:, 1] for c in channels if c in gap.by_window]
    return np.mean(known, axis=0) if known else None


def acts_on(problem: GapProblem, effect: Effect, place: str) -> bool:
    """Whether an effect acts on a joint or body, or on a coordinate of a body: it is
    there, or at all of a model, or at a body that the joint moves."""
    for at in effect.at:
        for one in at.split("~"):
            if one == "world" or f"{one}.".startswith(f"{place}."):
                return True
            if place.startswith(f"{one}.") or _moves(problem, place, one):
                return True
    return False


def acts_on_channel(problem: GapProblem, effect: Effect, channel: str) -> bool:
    """The same of a channel of a joint or body."""
    return acts_on(problem, effect, channel.rsplit(".", 1)[0])


def _moves(problem: GapProblem, joint: str, body: str) -> bool:
    plant = getattr(problem.dynamics, "plant", None)
    if plant is None:
        return False
    for each in one_dof_joints(plant):
        if full_name(plant, each) == joint:
            moved = plant.GetBodiesKinematicallyAffectedBy([each.index()])
            return any(full_name(plant, plant.get_body(i)) == body for i in moved)
    return False


# ----- What held-out data confirm


def is_confirmed(gap: GapMeasure, acts_at: Callable[[str], bool]) -> bool:
    """Whether simulated windows do better with what is named, all together or the
    channels at which an effect acts; where they show no gap without it, whether they
    show none with it, and are no worse unless the equations of motion are better, and
    these say the same of what shows in them."""
    if gap.before > AGREEMENT_RMS_MAX:
        return closed_at(gap, acts_at) >= CLOSED_SHARE_MIN
    worse = gap.after > (1.0 + ROUNDING) * gap.before
    if worse and (gap.in_equations is None or gap.reduction_in_equations <= 0.0):
        return False
    return gap.after <= AGREEMENT_RMS_MAX and _equations_confirm(gap)


def _equations_confirm(gap: GapMeasure) -> bool:
    if gap.in_equations is None:
        return True
    if max(gap.in_equations) <= AGREEMENT_RMS_MAX:
        return True
    return gap.reduction_in_equations >= CLOSED_SHARE_MIN


def not_confirmed(gap: GapMeasure) -> str:
    """In words, that data held out for the report do not bear out what is named."""
    if max(gap.before, gap.after) <= AGREEMENT_RMS_MAX and gap.in_equations is not None:
        return _goes("error in the equations of motion", *gap.in_equations)
    return _goes("simulated error", gap.before, gap.after)


def _goes(what: str, before: float, after: float) -> str:
    return (
        f"On the data held out for the report the effects take the {what} from "
        f"{figure(before)} to {figure(after)} times the expected error."
    )


# ----- Ties


def _without_refuted(
    problem: GapProblem, selection: Selection, judge: Judge
) -> Selection:
    """The selection without ties that leave a gap in held-out windows, simulated
    without the help of nuisances, and clearly more than what is named leaves."""
    ours = judge(_as_written(selection))
    if ours is None or not ours.gap.window_s or not ours.gap.is_measured:
        return selection

    def is_refuted(tie: Effect, of: Choice) -> bool:
        rest = [c for c in selection.choices if c is not of]
        effects = [*(c.effect for c in rest), tie]
        end = selection.end
        if rest:
            fixed = [*fixed_parameters(rest), ()]
            try:
                end = fit_effects(problem, selection.screen(problem), effects, fixed)
            except (ValueError, RuntimeError):
                return True  # The scene cannot have them.
            effects = list(end.effects)
        tied = tuple(Choice(e, {}, np.inf, np.inf, "", 0.0, (), (), 1) for e in effects)
        theirs = judge(_as_written(replace(selection, choices=tied, end=end)))
        if theirs is None or not theirs.gap.window_s or not theirs.gap.is_measured:
            return False  # No evidence.
        # Links that are off within their tolerance leave something with either.
        left = theirs.gap.after
        gap_left = leaves_gap(theirs.gap.before, left)
        return gap_left and ours.gap.after < SIMULATED_RIVAL_GAIN * left

    choices = [
        replace(c, ties=tuple(t for t in c.ties if not is_refuted(t, c)))
        for c in selection.choices
    ]
    return replace(selection, choices=tuple(choices))


def _as_written(selection: Selection) -> Selection:
    """The selection with nuisances as the scene has them: as its file will be used."""

    def bare(fitted: Fitted) -> Fitted:
        return replace(fitted, b=np.zeros_like(fitted.b))

    return replace(selection, start=bare(selection.start), end=bare(selection.end))

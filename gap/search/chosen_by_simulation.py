"""What was found, once more by simulated windows: what they keep, and what they prefer.

Equations of motion approximate some effects, and a law that is written down otherwise
makes them prefer another; simulation decides between the few that are left.
"""

from dataclasses import replace

from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import GapProblem, Outcome, is_sane
from makebreak.gap.said import called
from makebreak.gap.search.choice import (
    Choice,
    Selection,
    units_of,
)
from makebreak.gap.search.select import without
from makebreak.gap.thresholds import (
    AGREEMENT_RMS_MAX,
    SIMULATED_RIVAL_GAIN,
    SIMULATED_RIVAL_RATIO,
    SIMULATED_RIVALS_MAX,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect


def kept_by_simulation(
    problem: GapProblem, selection: Selection, jobs: int
) -> tuple[Selection, Outcome | None]:
    """The selection without those of several effects with a state of their own (a
    spring or a gap in a joint) that make simulated windows no better: equations only
    approximate them, and they imitate what else is fast. And what it comes to, on what
    was chosen on."""

    def outcome_of(some: Selection) -> Outcome | None:
        return problem.outcome(
            some.effects(), some.start, some.end, some.nuisances, jobs=jobs
        )

    outcome = outcome_of(selection)
    for choice in selection.choices:
        if outcome is None or len(selection.choices) < 2:
            break
        if not KINDS[choice.effect.kind].hidden_state:
            continue
        fewer = without(problem, selection, choice.effect)
        other = outcome_of(fewer)
        if other is not None and other.gap.after <= outcome.gap.after:
            selection, outcome = fewer, other
    return selection, outcome


def above_step(
    problem: GapProblem,
    selection: Selection,
    outcome: Outcome | None,
    step: float,
    jobs: int,
) -> tuple[Selection, Outcome | None, list[tuple[Choice, str]], float]:
    """The selection without effects that move simulated windows, which agree without
    them, less than the scene's own time step does, all together: the world may have
    such a step, too, or none. And what it comes to; those effects, and why; the
    held-out error with them.

    Args: step: what the scene's time step errs by, in windows' expected errors.
    """
    small: list[tuple[Choice, str]] = []
    below, first = problem.error(selection.end), outcome
    for unit in reversed(units_of(selection.choices)) if step > 0.0 else ():
        if first is None or not first.gap.is_measured:
            break
        fewer = without(problem, selection, *[choice.effect for choice in unit])
        other = problem.outcome(
            fewer.effects(), fewer.start, fewer.end, fewer.nuisances, jobs=jobs
        )
        if other is None or not other.gap.is_measured:
            break
        moved = abs(other.gap.after**2 - first.gap.after**2) ** 0.5
        if other.gap.after <= AGREEMENT_RMS_MAX and moved <= step:
            why = (
                "It moves simulated windows, with what else moves them as little, by "
                f"{moved:.2g} times the expected error, no more than the scene's time "
                f"step errs by ({step:.2g})."
            )
            small += [(choice, why) for choice in unit]
            selection, outcome = fewer, other
    return selection, outcome, small, below if small else float("inf")


def preferred_by_simulation(
    problem: GapProblem, selection: Selection, outcome: Outcome | None, jobs: int
) -> tuple[Selection, Outcome | None]:
    """Of contact, where a law that is written down otherwise (how friction sets in) may
    make equations prefer the wrong one of two effects: if with the one that they chose
    simulated windows still show a gap, those with one parameter that they found nearly
    as good are simulated too, and one that leaves clearly less is taken."""
    if not problem.plan.simulation_agrees:
        return selection, outcome
    if len(selection.choices) != 1:
        return selection, outcome
    if outcome is None or outcome.gap.after <= AGREEMENT_RMS_MAX or not selection.table:
        return selection, outcome
    (choice,) = selection.choices
    known, limit = (
        {choice.effect.kind},
        SIMULATED_RIVAL_RATIO * selection.table[0].score,
    )
    screen = selection.screen(problem)
    for each in selection.table:
        if each.kind in known or len(each.parameters) != 1 or len(each.at) != 1:
            continue
        if each.score > limit or len(known) > SIMULATED_RIVALS_MAX:
            break
        known.add(each.kind)
        start = Effect(each.kind, list(each.at), dict(each.parameters))
        try:
            fit = fit_effects(problem, screen, [start])
        except ValueError:
            continue
        if not all(map(is_sane, fit.effects)):
            continue
        other = problem.outcome(
            fit.effects, selection.start, fit, selection.nuisances, jobs=jobs
        )
        if (
            other is not None
            and other.gap.after < SIMULATED_RIVAL_GAIN * outcome.gap.after
        ):
            new = replace(
                choice, effect=fit.effects[0], std=fit.std[0], after=fit.score,
                runner_up=called(choice.effect), why="",
                margin=choice.after / fit.score - 1.0, ties=(), fixed=(), size=1,
            )  # fmt: skip
            selection = replace(selection, choices=(new,), end=fit)
            outcome = other
    return selection, outcome

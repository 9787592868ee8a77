"""Which effects a scene lacks: added one after another by held-out error, then dropped
where they are not needed.

Models are fitted to the rows that a problem's `train` names and chosen by the others.
The stages, each in a file of its own:

    screen.py       every candidate, ranked by its linear columns
    groups.py       one kind at all joints as one candidate
    add.py          one step: rank, fit the best exactly, take the simplest
    trials.py       exact fits, and which of them is the simplest
    rivals.py       needed instead, both needed, or a tie
    pairs.py        two effects at once
    own_values.py   one value for each joint
    drop.py         what is not needed, or not certain

comparison.py says what "better" means in all of them, gap/thresholds.py by how much.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from makebreak.gap.numerics.selection import is_plausible
from makebreak.gap.problem import Fitted, GapProblem
from makebreak.gap.result import Considered
from makebreak.gap.search.add import add_next
from makebreak.gap.search.choice import (
    Choice,
    Selection,
    fixed_parameters,
    refreshed,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.drop import drop_needless, keep_certain, simplify
from makebreak.gap.search.fit import derivative_free_search, fit_effects
from makebreak.gap.search.own_values import with_own_values
from makebreak.gap.search.rivals import Rivals, still_tied, with_rivals_of_pairs
from makebreak.models.effects.kind import Effect


def select(
    problem: GapProblem, say: Callable[[str], None] = lambda text: None
) -> Selection:
    """Greedy forward selection with a refit of all effects after each addition; then
    whatever is not needed any more is dropped."""
    search = Comparison(problem, say)
    chosen, current, table = _added(search)
    if search.plan.own_values and chosen:
        chosen, current = with_own_values(search, chosen, current)
    chosen, current = drop_needless(search, chosen, current)
    chosen, current = simplify(search, chosen, current)
    if chosen:
        chosen, current = keep_certain(search, chosen, current)
    if len(chosen) > 1 and any(c.paired for c in chosen):
        chosen = with_rivals_of_pairs(search, chosen, current)
    chosen = [
        replace(c, ties=still_tied(search, chosen, current, k))
        for k, c in enumerate(chosen)
    ]
    beyond = search.nuisances_beyond(current)
    far = bool(beyond) or not is_plausible(current.b, search.nuisances.prior)
    return Selection(
        tuple(chosen), search.start, current, search.nuisances, table, beyond, far
    )


def without(problem: GapProblem, selection: Selection, effect: Effect) -> Selection:
    """A selection less the effect of that kind and place, all others fitted again."""
    rest = [
        c for c in selection.choices
        if (c.effect.kind, list(c.effect.at)) != (effect.kind, list(effect.at))
    ]  # fmt: skip
    fitted = fit_effects(
        problem, selection.screen(problem), [c.effect for c in rest],
        fixed_parameters(rest),
    )  # fmt: skip
    return replace(selection, choices=tuple(refreshed(rest, fitted)), end=fitted)


def _added(
    search: Comparison,
) -> tuple[list[Choice], Fitted, tuple[Considered, ...]]:
    """What steps forward add, the fit of all of it, and the first step's candidates."""
    problem, rivals = search.problem, Rivals(search)
    current, chosen = search.start, list[Choice]()
    table: tuple[Considered, ...] = ()
    for _ in range(search.plan.most_effects):  # A group counts as one.
        if not search.needs_more(current):
            break
        found = problem.candidates(search.nuisances, current)
        step = add_next(search, rivals, found, chosen, current)
        table = table or step.table
        if step.fitted is None:
            break
        chosen += step.added
        current = _converged(search, chosen, step.fitted)
        chosen = refreshed(chosen, current)  # The next fit starts from here.
        if problem.reweigh(current.left):
            # Less is left than models were taken to be off by.
            search.start_again()
            current = search.refit(chosen, current)
            chosen = refreshed(chosen, current)
    return chosen, current, table


def _converged(search: Comparison, chosen: Sequence[Choice], current: Fitted) -> Fitted:
    """A fit of a short list is stopped early; here it is carried on, because what it
    has not reached yet would be looked for in other effects."""
    fixed, jumps = fixed_parameters(chosen), search.plan.jumps
    steps = 2 * search.plan.evaluations
    for far in (False, True) if jumps else (False,):
        if not search.needs_more(current):
            break
        screen = search.screen(current.r, current.fit.train)
        effects = current.effects
        if jumps:
            effects = derivative_free_search(
                search.problem, screen, effects, fixed, far
            )
        more = fit_effects(search.problem, screen, effects, fixed, steps)
        if more.fit.train < current.fit.train:
            current = more
    return current

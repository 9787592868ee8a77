"""Which effects a scene lacks: added one after another by held-out error, then dropped
where they are not needed.

Models are fitted to the rows that a problem's `train` names and chosen by the others.
The stages, each in a file of its own:

    screen.py       candidates, ranked by their linear columns
    groups.py       one kind at all joints as one candidate
    forward.py      step by step
    add.py          one step: rank, fit the best exactly, take the simplest
    trials.py       exact fits, and which of them is the simplest
    rivals.py       needed instead, both needed, or a tie
    pairs.py        two effects at once
    refine.py       a further parameter of an effect that is named
    drop.py         what is not needed, or not certain

comparison.py says what "better" means in all of them, gap/thresholds.py by how much.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from makebreak.gap.budget import PRUNE
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.selection import is_plausible
from makebreak.gap.problem import Fitted, GapProblem
from makebreak.gap.search.choice import (
    Choice,
    Selection,
    fixed_parameters,
    refreshed,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.drop import drop_needless, keep_certain, simplify
from makebreak.gap.search.forward import forward, reweighed
from makebreak.gap.search.rivals import (
    still_tied,
    with_rivals_of_pairs,
    with_shared_gains,
)
from makebreak.models.effects.kind import Effect


def select(
    problem: GapProblem, say: Callable[[str], None] = lambda text: None
) -> Selection:
    """Greedy forward selection with a refit of all effects after each addition; then
    whatever is not needed any more is dropped."""
    search = Comparison(problem, say)
    path = forward(search)
    chosen, current = reweighed(search, list(path.chosen), path.fitted)
    with search.budget.part(PRUNE):
        chosen, current = _pruned(search, chosen, current)
        chosen = search.budget.if_time(
            "looking for ties", lambda: _with_ties(search, chosen, current), chosen
        )
    beyond = search.nuisances_beyond(current)
    far = bool(beyond) or not is_plausible(current.b, search.nuisances.prior)
    return Selection(
        tuple(chosen), search.start, current, search.nuisances, path.table, beyond, far
    )


def _pruned(
    search: Comparison, chosen: list[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    # Where all that joints may have was fitted at once, what is not needed went there.
    needless = [] if search.problem.rich() else [drop_needless]
    steps: dict[str, list[Callable]] = {
        "dropping what is not needed": [*needless, simplify],
        "whether each effect is certain": [keep_certain],
    }
    for what, each in steps.items():
        for step in each if chosen else ():
            chosen, current = search.if_time(
                what, partial(step, search), chosen, current
            )
    return reweighed(search, chosen, current)


def _with_ties(
    search: Comparison, chosen: list[Choice], current: Fitted
) -> list[Choice]:
    if any(c.paired for c in chosen):
        chosen = with_rivals_of_pairs(search, chosen, current)
    chosen = [
        replace(c, ties=still_tied(search, chosen, current, k))
        for k, c in enumerate(chosen)
    ]
    return with_shared_gains(search, chosen, current)


def without(problem: GapProblem, selection: Selection, *effects: Effect) -> Selection:
    """A selection less the effects of these kinds and places, all others fitted again;
    less all of them where the others cannot be without these."""
    gone = {(e.kind, tuple(e.at)) for e in effects}
    rest = [
        c for c in selection.choices if (c.effect.kind, tuple(c.effect.at)) not in gone
    ]
    if rest:
        try:
            fitted = fit_effects(
                problem, selection.screen(problem), [c.effect for c in rest],
                fixed_parameters(rest),
            )  # fmt: skip
            kept = tuple(refreshed(rest, fitted))
            return replace(selection, choices=kept, end=fitted)
        except (ValueError, RuntimeError):
            pass
    return replace(selection, choices=(), end=selection.start)

"""Forward selection: effects added one after another, each with a refit of all."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from makebreak.gap.budget import Stopped
from makebreak.gap.fit import fit_effects, search_by_blocks
from makebreak.gap.problem import Fitted
from makebreak.gap.result import Considered
from makebreak.gap.search.add import add_next
from makebreak.gap.search.all_at_once import all_at_once, is_worse_somewhere
from makebreak.gap.search.choice import Choice, fixed_parameters, refreshed
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.refine import refine
from makebreak.gap.search.rivals import Rivals
from makebreak.models.effects.kind import Effect


@dataclass(frozen=True, eq=False)
class Path:
    """What steps forward have added, and the fit of all of it.

    steps: how many; a group counts as one. table: the candidates of the first step, the
    best first. ended: nothing more earns its place, or is needed.
    """

    chosen: tuple[Choice, ...]
    fitted: Fitted
    steps: int = 0
    table: tuple[Considered, ...] = ()
    ended: bool = False


def forward(search: Comparison) -> Path:
    """Adds effects until nothing more earns its place."""
    path, rivals = Path((), search.start), Rivals(search)
    try:
        path = _step(search, rivals, path)
        chosen, fitted = all_at_once(search)
        if chosen and is_worse_somewhere(search, path.fitted, fitted):
            path = Path(tuple(chosen), fitted, 1, path.table)
        while not path.ended:
            path = _step(search, rivals, path)
    except Stopped:
        search.budget.leave("looking for further effects")
    return path


def _step(search: Comparison, rivals: Rivals, path: Path) -> Path:
    problem, current = search.problem, path.fitted
    full = path.steps >= search.plan.most_effects
    if full or not search.may_need_more(current):
        return replace(path, ended=True)
    found = problem.candidates(search.nuisances, current)
    step = add_next(search, rivals, found, path.chosen, current)
    more = sum(c.size for c in step.added)
    if step.fitted is None or not search.is_needed(step.fitted, current, more):
        return replace(path, table=path.table or step.table, ended=True)
    chosen = refreshed([*path.chosen, *step.added], step.fitted)
    current = step.fitted
    if search.plan.jumps:  # By its own weights it may be done.
        chosen, current = reweighed(search, chosen, current)
    current = _converged(search, chosen, current)
    chosen = refreshed(chosen, current)  # The next fit starts from here.
    chosen, current = reweighed(search, chosen, current)
    chosen, current = search.if_time(
        "improving the last effects", partial(refine, search), chosen, current
    )
    table = path.table or step.table
    return Path(tuple(chosen), current, path.steps + 1, table)


def reweighed(
    search: Comparison, chosen: list[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """By the weights of what is chosen, fitted again where those are others: less is
    left than models were taken to be off by, or noise is another in them; or those of
    an effect that was dropped are left."""
    with search.budget.held():
        if search.problem.reweigh(current):
            search.start_again()
            current = search.refit(chosen, current) if chosen else search.start
    return refreshed(chosen, current), current


def _converged(search: Comparison, chosen: Sequence[Choice], current: Fitted) -> Fitted:
    """A fit of a short list is stopped early; here it is carried on, because what it
    has not reached yet would be looked for in other effects."""
    fixed, jumps = fixed_parameters(chosen), search.plan.jumps
    by_evidence = jumps and search.plan.counts_evidence
    if not (search.needs_more(current) or by_evidence):
        return current
    screen = search.screen(current.r, current.fit.train)
    effects: tuple[Effect, ...] | None = current.effects
    try:
        if jumps:
            effects = search_by_blocks(search.problem, screen, current.effects, fixed)
        if effects is None:
            return current
        steps = 2 * search.plan.evaluations
        more = fit_effects(search.problem, screen, effects, fixed, steps)
    except Stopped:
        search.budget.leave("the last fit to its end")
        return current
    return more if more.fit.train < current.fit.train else current

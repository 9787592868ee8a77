"""Forward selection: effects added one after another, each with a refit of all; and a
step back to a tie where the gap stays unexplained."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

from makebreak.gap.budget import Stopped
from makebreak.gap.fit import fit_effects, search_by_blocks
from makebreak.gap.problem import Fitted
from makebreak.gap.result import Considered
from makebreak.gap.search.add import add_next
from makebreak.gap.search.all_at_once import all_at_once, is_worse_somewhere
from makebreak.gap.search.choice import (
    Choice,
    fixed_parameters,
    places,
    refreshed,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.refine import refine
from makebreak.gap.search.rivals import Rivals, in_place_of
from makebreak.gap.thresholds import (
    BRANCHES_MAX,
    SAME_ERROR,
    UNEXPLAINED_RMS,
)
from makebreak.models.effects.kind import Effect


@dataclass(frozen=True, eq=False)
class State:
    """All effects after a step, and their fit."""

    chosen: tuple[Choice, ...]
    fitted: Fitted


@dataclass(frozen=True, eq=False)
class Path:
    """What steps forward have added.

    states: without effects, and after each step. table: the candidates of the first
    step, the best first. ended: nothing more earns its place, or is needed.
    """

    states: tuple[State, ...]
    table: tuple[Considered, ...] = ()
    ended: bool = False

    @property
    def end(self) -> State:
        return self.states[-1]

    def plus(self, state: State, table: tuple[Considered, ...]) -> "Path":
        return Path((*self.states, state), self.table or table)


def forward(search: Comparison) -> Path:
    """Adds effects until nothing more earns its place. If much is left then, steps
    back to each tie in turn and takes the other effect: what is added after it tells
    two apart that did equally well when the choice was made."""
    path, rivals = Path((State((), search.start),)), Rivals(search)
    try:
        path = _step(search, rivals, path)
        chosen, fitted = all_at_once(search)
        if chosen and is_worse_somewhere(search, path.end.fitted, fitted):
            path = Path((path.states[0], State(tuple(chosen), fitted)), path.table)
        while not path.ended:
            path = _step(search, rivals, path)
    except Stopped:
        search.budget.leave("looking for further effects")
        return path
    try:
        for steps, k, branch in _branches(search, path):
            path = _better(search, path, steps, k, branch)
            if not _is_unexplained(search, path.end.fitted):
                break
    except Stopped:
        search.budget.leave("trying ties in the place of effects")
    return path


def _to_the_end(search: Comparison, path: Path) -> Path:
    rivals = Rivals(search)
    while not path.ended:
        path = _step(search, rivals, path)
    return path


def _step(search: Comparison, rivals: Rivals, path: Path) -> Path:
    problem, current = search.problem, path.end.fitted
    full = len(path.states) > search.plan.most_effects  # A group counts as one.
    if full or not search.may_need_more(current):
        return replace(path, ended=True)
    found = problem.candidates(search.nuisances, current)
    step = add_next(search, rivals, found, path.end.chosen, current)
    more = sum(c.size for c in step.added)
    if step.fitted is None or not search.is_needed(step.fitted, current, more):
        return replace(path, table=path.table or step.table, ended=True)
    chosen = refreshed([*path.end.chosen, *step.added], step.fitted)
    current = step.fitted
    if search.plan.jumps:  # By its own weights it may be done.
        chosen, current = reweighed(search, chosen, current)
    current = _converged(search, chosen, current)
    chosen = refreshed(chosen, current)  # The next fit starts from here.
    chosen, current = reweighed(search, chosen, current)
    chosen, current = search.if_time(
        "improving the last effects", partial(refine, search), chosen, current
    )
    return path.plus(State(tuple(chosen), current), step.table)


def reweighed(
    search: Comparison, chosen: list[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """By the weights of what is chosen, fitted again where those are others: less is
    left than models were taken to be off by, or noise is another in them; or those of a
    branch that was given up, or of an effect that was dropped, are left."""
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


# ----- Back to a tie


def _is_unexplained(search: Comparison, fitted: Fitted) -> bool:
    """Whether much is left, or nuisances are where they should not be."""
    much = search.problem.noise_error(fitted.left) > UNEXPLAINED_RMS
    return much or search.is_strained(fitted)


def _branches(search: Comparison, path: Path) -> Iterator[tuple[int, int, Path]]:
    """(steps, k, branch): the path so far, with a tie in the place of effect k, which
    is the last one. None if little is left at the end, or if fits need simulations
    without derivatives."""
    if search.plan.jumps or not _is_unexplained(search, path.end.fitted):
        return
    tried = 0
    for steps, (before, after) in enumerate(pairwise(path.states), start=1):
        k = len(before.chosen)
        if len(after.chosen) != k + 1:  # A group or a pair has no ties.
            continue
        for tie in after.chosen[k].ties:
            if tried == BRANCHES_MAX:
                return
            branch = _with_tie(search, path, steps, k, tie)
            if branch is not None:
                tried += 1
                yield steps, k, branch


def _with_tie(
    search: Comparison, path: Path, steps: int, k: int, tie: Effect
) -> Path | None:
    """None where the tie is impossible, or was added later."""
    if (tie.kind, tuple(tie.at)) in places(path.end.chosen):
        return None
    state = path.states[steps]
    chosen, current = list(state.chosen), search.refit(state.chosen, state.fitted)
    found = [
        c for c in search.problem.candidates(search.nuisances, current)
        if (c.kind, c.at) == (tie.kind, tuple(tie.at))
    ]  # fmt: skip
    trial = in_place_of(search, found[0], k, chosen, current) if found else None
    if trial is None:
        return None
    old = chosen[k]
    chosen[k] = replace(
        old, fixed=found[0].fixed, size=found[0].size,
        ties=(old.effect, *(t for t in old.ties if t is not tie)),
    )  # fmt: skip
    state = State(tuple(refreshed(chosen, trial.fit)), trial.fit)
    return Path((*path.states[:steps], state), path.table)


def _better(search: Comparison, path: Path, steps: int, k: int, branch: Path) -> Path:
    """The branch at effect k, followed to its end, if it leaves clearly less there than
    the path; it is given up if after one step it leaves no less than the path did."""
    tie = branch.end.chosen[k].effect
    branch = _step(search, Rivals(search), branch)
    then = path.states[min(steps + 1, len(path.states) - 1)]
    theirs, ours = (_error(search, each) for each in (then, branch.end))
    if not ours < (1.0 - SAME_ERROR) * theirs:
        return path
    branch = _to_the_end(search, branch)
    theirs, ours = (_error(search, each) for each in (path.end, branch.end))
    if not ours < (1.0 - search.plan.least_gain) * theirs:
        return path
    was = path.states[steps].chosen[k].effect
    runner_up, margin = f"{was.kind} at {', '.join(was.at)}", theirs / ours - 1.0
    chosen = [
        replace(c, runner_up=runner_up, margin=margin, why="")
        if _is_at(c.effect, tie)
        else c
        for c in branch.end.chosen
    ]
    end = State(tuple(chosen), branch.end.fitted)
    return Path((*branch.states[:-1], end), branch.table, ended=True)


def _is_at(one: Effect, other: Effect) -> bool:
    return (one.kind, tuple(one.at)) == (other.kind, tuple(other.at))


def _error(search: Comparison, state: State) -> float:
    """By the weights of now."""
    return search.error(search.refit(state.chosen, state.fitted).score)

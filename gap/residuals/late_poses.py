"""Cameras whose poses come late beside the joints, and nobody said so.

In the equations of motion a camera's clock is free by a quarter of its sample's period.
A camera that is late by more moves the object into the tool or away from it, at every
touch, and what else is wrong cannot be told from that. So the poses are moved earlier,
by as much as the equations ask for, until they ask for no more; then the search begins.
"""

from collections.abc import Iterable, Sequence

from makebreak.gap.data.recording import Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.residuals.contact_means import SLIDES
from makebreak.gap.residuals.contact_problem import BEYOND, MISFIT, ContactProblem
from makebreak.gap.residuals.pose_times import earlier
from makebreak.models.scene import Scene

ROUNDS, MOST_LATE = 6, 0.1  # Of moving poses; later than this is no camera [s].
NO_WORSE = 1.1  # Of what a model with every effect leaves, what it may leave then.


def contact_problem(
    scene: Scene, recordings: Sequence[Recording], slides: float = SLIDES
) -> ContactProblem:
    """The problem with poses where they belong in time; `late` says by how much each
    body's were moved.

    Args: slides: as ContactProblem.
    Raises: DoesNotFit as ContactProblem.
    """
    problem = first = ContactProblem(scene, recordings, slides=slides)
    late: dict[str, float] = {}
    for _ in range(ROUNDS):
        more = wanted(problem)
        trial = {body: late.get(body, 0.0) + more.get(body, 0.0)
                 for body in {*late, *more}}  # fmt: skip
        if not more or max(trial.values()) > MOST_LATE:
            break
        try:
            other = ContactProblem(scene, earlier(recordings, trial), slides=slides)
        except DoesNotFit:  # Too little is left to say so.
            break
        problem, late = other, trial
    if not late or wanted(problem):
        return first
    if problem.rich_left > max(NO_WORSE * first.rich_left, MISFIT):
        return first
    problem.late = late
    problem.late_errors = left_by_clocks(first, late), left_by_clocks(problem, late)
    return problem


def left_by_clocks(problem: ContactProblem, bodies: Iterable[str]) -> float:
    """The error without effects if the clocks of some bodies are right as they are."""
    n = problem.nuisances()
    own = {f"clock of {body}" for body in bodies}
    others = [k for k, name in enumerate(n.names) if name not in own]
    screen = Screen(
        problem.base(), n.columns[:, others], n.prior[others], problem.train()
    )
    return screen.fit().score


def wanted(problem: ContactProblem) -> dict[str, float]:
    """{body: by how much later its poses are than its camera's samples allow [s]}."""
    n, out = problem.nuisances(), {}
    for body in problem.bodies:
        name = f"clock of {body}"
        if name in n.names:
            late = problem.rich_nuisances.get(name, 0.0)
            if late > BEYOND * n.prior[n.names.index(name)]:
                out[body] = late
    return out

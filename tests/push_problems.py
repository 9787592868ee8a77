"""Pushes of push_world as a problem for the search."""

from gap_benchmark import push_world

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.models.scene import read_scene


def pushed_problem(folder, world, truth, rng, episodes: int) -> ContactProblem:
    """The problem of a few pushes of `truth` in the scene `world`."""
    table, noise = push_world.record(truth, rng, episodes=episodes)
    scene = push_world.write(folder, world, table, noise)
    return ContactProblem(
        read_scene(scene), read_recordings([folder / "recording.csv"])
    )


def screen_of(problem: ContactProblem) -> Screen:
    """A Screen of the problem's training rows, with its nuisances."""
    n = problem.nuisances()
    return Screen(problem.base(), n.columns, n.prior, problem.train(), reach=n.reach)

"""`makebreak bench parameter_push`: push_object with a planner that has a wrong model.

T, L and box, each with friction or mass half or twice the model's, or 5 % smaller or
larger: the time to a goal without learning, with the learner of parameters, and with
the right model. A seed gives start and goal, and the cases take turns.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydrake.systems.analysis import Simulator

from makebreak.diagrams.push_object import PushObjectConfig, make_push_object
from makebreak.models.pushed_object import PushedObject

Shape = Literal["t", "l", "box"]
SHAPES: tuple[Shape, ...] = ("t", "l", "box")
# {setting of the model: its value over the world's}.
WRONG = (
    {"friction": 0.5}, {"friction": 2.0}, {"mass": 0.5}, {"mass": 2.0},
    {"scale": 0.95}, {"scale": 1.05},
)  # fmt: skip
FIRST_SEED, N_RUNS = 29016, 18
TICK = 0.05  # Period at which a run is checked for its end [s].
VARIANTS = ("without", "with", "right_model")


@dataclass(frozen=True)
class Run:
    """time to the goal [s], the limit if it was missed; learned: {name: factor on the
    model's value, or value}."""

    time: float
    learned: dict[str, float]


def case(seed: int) -> tuple[Shape, dict[str, float]]:
    """The shape and the wrong setting of a seed."""
    k = seed % (len(SHAPES) * len(WRONG))
    return SHAPES[k % len(SHAPES)], WRONG[k // len(SHAPES)]


def run(seed: int, variant: str) -> Run:
    """Args: variant: of VARIANTS."""
    shape, wrong = case(seed)
    config = PushObjectConfig(seed=seed, object=PushedObject(shape=shape))
    config.learner = "parameters" if variant == "with" else "none"
    if variant != "right_model":
        for name, factor in wrong.items():
            if name == "friction":
                factor *= config.friction
            setattr(config.model, name, factor)
    diagram = make_push_object(config)
    simulator = Simulator(diagram)
    goal = diagram.GetSubsystemByName("push_goals")
    own, limit = goal.GetMyContextFromRoot(simulator.get_context()), 0.0
    while limit < config.goals.limit_sec:
        limit += TICK
        simulator.AdvanceTo(limit)
        if goal.GetOutputPort("log").Eval(own)[0] >= config.n_goals:
            break
    learned = {}
    if diagram.HasSubsystemNamed("parameter_learner"):
        learner = diagram.GetSubsystemByName("parameter_learner")
        of_run = learner.GetMyContextFromRoot(simulator.get_context())
        for row in learner.learned(of_run):
            learned[row.name] = row.learned / row.model if row.model else row.learned
    return Run(limit, learned)


def rows(seeds: Sequence[int] = range(FIRST_SEED, FIRST_SEED + N_RUNS)) -> list[dict]:
    """One of each wrong setting, and one of all runs; times are means."""
    times = np.array([[run(seed, each).time for each in VARIANTS] for seed in seeds])
    what = [" x ".join(map(str, *case(seed)[1].items())) for seed in seeds]
    found = []
    for name in (*dict.fromkeys(what), "any of these"):
        of_kind = times[[name in ("any of these", each) for each in what]]
        without, learned, right = of_kind.mean(axis=0)
        found.append({
            "what": f"push, {len(of_kind)} with {name} in the model: time to the goal",
            "value": float(learned),
            "unit": "s",
            "without": float(without),
            "right_model": float(right),
            "worst": [round(float(t), 1) for t in of_kind.max(axis=0)],
            "ratio_to_right": float(learned / right),
        })  # fmt: skip
    return found

"""CarefulGoal: a goal that is no farther than what is not yet known allows."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import LeafSystem


@dataclass
class CarefulGoalConfig:
    """Which positions are approached with care, and how much of it."""

    positions: list[int] = field(default_factory=list)  # Indices in x.
    deviations: float = 1.0  # By which what is unknown may be off.


class CarefulGoal(LeafSystem):
    """Moves the goal of some positions nearer to where they are, while masses, friction
    and damping are not known: a light push, which tells them, before a hard one.

    What is pushed once and coasts comes on from too short a way by another push, and
    back from too long a way never. It goes exp(unknown) times as far as planned if it
    is lighter or smoother than believed by one deviation, so the goal is at
    exp(-unknown) of the way that is left. As the learner gets sure it moves to where it
    shall be.

    Inputs:  x (n_x,); unknown (1,) of a ParameterLearner.
    Outputs: x_desired (n_knots n_x,): at each knot, row by row.

    Args: config: no positions of a quaternion; goal (n_x,).
    Raises: ValueError for a position that is not one of x, deviations below 0.
    """

    def __init__(self, config: CarefulGoalConfig, goal, n_knots: int):
        super().__init__()
        self._goal, self._n_knots = np.array(goal, dtype=float), n_knots
        n_x, self._config = self._goal.size, config
        for i in config.positions:
            if i not in range(n_x):
                raise ValueError(
                    f"CarefulGoalConfig.positions has {i}, expected 0 to {n_x - 1}"
                )
        if not 0.0 <= config.deviations < np.inf:
            raise ValueError(
                f"CarefulGoalConfig.deviations is {config.deviations}, expected >= 0"
            )
        self._x = self.DeclareVectorInputPort("x", n_x)
        self._unknown = self.DeclareVectorInputPort("unknown", 1)
        self.DeclareVectorOutputPort("x_desired", n_knots * n_x, self._calc)

    def _calc(self, context, output):
        goal, of = self._goal.copy(), self._config.positions
        now = self._x.Eval(context)[of]
        share = np.exp(-self._config.deviations * self._unknown.Eval(context)[0])
        goal[of] = now + share * (goal[of] - now)
        output.SetFromVector(np.tile(goal, self._n_knots))

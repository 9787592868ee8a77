"""The target of a planner that tips a planar cube (numerics/pivot_target.py)."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.contact_mpc.numerics.pivot_target import (
    N_X,
    fingers_away,
    pivot_target,
    share_of_rate,
)
from makebreak.systems.numerics.settings import check_settings

# Where the fingers touch: distance from the middle of the face over the side, the left
# finger's upwards, the right one's to the right (on the upper face).
LEFT_AT, RIGHT_AT = 0.2, 0.15
# The rate is full while both fingers are nearer than NEAR to their places, and zero
# beyond FAR [m].
NEAR, FAR = 0.03, 0.06


@dataclass
class PivotTargetConfig:
    """Settings of PivotTarget."""

    side: float = 0.1  # Of the cube [m].
    finger_radius: float = 0.012  # [m]
    goal: float = np.pi / 2  # Angle of the cube [rad].
    rate: float = 1.0  # Of the angle towards the goal [rad/s].


class PivotTarget(LeafSystem):
    """Desired states of cube and fingers at the knots of a plan.

    Inputs:  x (14,), as in numerics/pivot_target.py.
    Outputs: x_desired ((N + 1) 14,), row by row.

    Args: config; dt_sec: between the knots [s]; N: number of knots after the first.
    Raises: ValueError for a setting out of range.
    """

    def __init__(self, config: PivotTargetConfig, dt_sec: float, N: int):
        super().__init__()
        check_settings(config)
        c = config
        for name in ("side", "finger_radius", "rate"):
            if not 0.0 < getattr(c, name) < np.inf:
                raise ValueError(
                    f"PivotTargetConfig.{name} is {getattr(c, name)}, expected > 0"
                )
        if not np.isfinite(c.goal):
            raise ValueError(f"PivotTargetConfig.goal is {c.goal}, expected an angle")
        self._config, self._dt, self._N = c, dt_sec, N
        out = 0.5 * c.side + c.finger_radius
        self._points = np.array([[-out, LEFT_AT * c.side], [RIGHT_AT * c.side, out]])
        self._x = self.DeclareVectorInputPort("x", N_X)
        self.DeclareVectorOutputPort("x_desired", (N + 1) * N_X, self._calc)

    def _calc(self, context: Context, output: BasicVector):
        c, q = self._config, self._x.Eval(context)[: N_X // 2]
        rate = c.rate * share_of_rate(fingers_away(q, self._points), NEAR, FAR)
        rows = pivot_target(q, c.side, self._points, c.goal, rate, self._dt, self._N)
        output.SetFromVector(rows.ravel())

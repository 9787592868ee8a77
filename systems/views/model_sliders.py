"""Sliders in Meshcat that change the contact model of a controller."""

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import LeafSystem

FRICTION, GAP = "model friction", "gap error [mm]"  # Longer ones are cut off.
FRICTION_MAX, GAP_MAX = 2.0, 15.0  # [-], [mm]


class ModelSliders(LeafSystem):
    """Inputs of AnitescuLcsBuilder: the friction of all pairs, and a distance that is
    added to the first one's gap. A slider that was not moved has no effect.

    Outputs: friction (n_pairs,); gap (n_pairs,) [m].
    State:   values of both sliders, NaN for one that was not moved.

    Args: friction (n_pairs,): of the configured pairs.
    """

    def __init__(
        self, friction: Sequence[float], meshcat: Meshcat, period_sec: float = 0.05
    ):
        super().__init__()
        self._friction, self._meshcat = np.array(friction, dtype=float), meshcat
        # As Meshcat returns the values: rounded to the sliders' steps.
        self._first = [
            meshcat.AddSlider(FRICTION, 0.0, FRICTION_MAX, 0.01, self._friction[0]),
            meshcat.AddSlider(GAP, -GAP_MAX, GAP_MAX, 0.1, 0.0),
        ]
        self._moved = self.DeclareDiscreteState([np.nan, np.nan])
        n = len(self._friction)
        self.DeclareVectorOutputPort("friction", n, self._calc_friction)
        self.DeclareVectorOutputPort("gap", n, self._calc_gap)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._look)

    def _look(self, context, discrete_state):
        moved = context.get_discrete_state(self._moved).value().copy()
        for i, (name, first) in enumerate(
            zip((FRICTION, GAP), self._first, strict=True)
        ):
            value = self._meshcat.GetSliderValue(name)
            if value != first or np.isfinite(moved[i]):
                moved[i] = value
        discrete_state.set_value(self._moved, moved)

    def _calc_friction(self, context, output):
        friction = context.get_discrete_state(self._moved)[0]
        moved = np.isfinite(friction)
        output.SetFromVector(
            np.full(len(self._friction), friction) if moved else self._friction
        )

    def _calc_gap(self, context, output):
        gap = np.zeros(len(self._friction))
        gap[0] = 1e-3 * np.nan_to_num(context.get_discrete_state(self._moved)[1])
        output.SetFromVector(gap)

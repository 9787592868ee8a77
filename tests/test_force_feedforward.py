"""What is fed forward of a predicted force."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.systems.arm.force_feedforward import (
    ForceFeedforward,
    ForceFeedforwardConfig,
)

PUSH = np.array([1.0, 0.0, -8.0, 0.1, 0.2, 0.3])


def fed(predicted, direction, seconds=0.5, **config):
    """What comes out after a while."""
    builder = DiagramBuilder()
    system = builder.AddSystem(ForceFeedforward(ForceFeedforwardConfig(**config)))
    values = {"wrench_predicted": predicted, "direction": direction, "wrench": PUSH}
    for name, value in values.items():
        source = builder.AddSystem(ConstantVectorSource(np.array(value, dtype=float)))
        builder.Connect(source.get_output_port(), system.GetInputPort(name))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(seconds)
    context = system.GetMyContextFromRoot(simulator.get_context())
    return system.GetOutputPort("wrench_feedforward").Eval(context) - PUSH


def test_the_force_against_the_motion_is_cancelled_and_nothing_else():
    # Friction of 5 N against a motion along y, and a normal force.
    force = fed([0.3, -5.0, 8.0, 1, 1, 1], [0, 1, 0])
    np.testing.assert_allclose(force, [0, 5.0, 0, 0, 0, 0], atol=1e-9)
    d = np.array([0.6, 0.8, 0.0])
    np.testing.assert_allclose(fed([1, 2, 3, 0, 0, 0], d)[:3], -2.2 * d, atol=1e-9)


def test_it_grows_with_the_time_constant_of_the_filter():
    # Updates at 0, 1, ... 20 ms: 21 steps of exp(-1/20).
    force = fed([0, -5.0, 0, 0, 0, 0], [0, 1, 0], seconds=0.0205)
    assert force[1] == pytest.approx(5.0 * (1.0 - np.exp(-21.0 / 20.0)), rel=1e-12)


@pytest.mark.parametrize(
    "predicted, direction",
    [([0, np.nan, 0, 0, 0, 0], [0, 1, 0]), ([0, -5.0, 0, 0, 0, 0], [0, 0, 0])],
)
def test_without_a_prediction_or_at_rest_there_is_nothing(predicted, direction):
    np.testing.assert_allclose(fed(predicted, direction), 0.0)


def test_it_is_bounded():
    assert fed([0, 90.0, 0, 0, 0, 0], [0, 1, 0])[1] == pytest.approx(-20.0)
    with pytest.raises(ValueError, match="filter_sec is 0"):
        ForceFeedforward(ForceFeedforwardConfig(filter_sec=0.0))

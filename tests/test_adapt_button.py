"""The residual is passed on, or not, as a button in Meshcat says."""

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from test_run_buttons import press

from makebreak.systems.views.adapt_button import ADAPT, AdaptButton


def test_each_press_takes_the_residual_away_or_brings_it_back():
    meshcat, builder = Meshcat(), DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource([0.3, -0.1]))
    button = builder.AddSystem(AdaptButton(2, meshcat))
    builder.Connect(source.get_output_port(), button.get_input_port())
    simulator = Simulator(builder.Build())
    context = button.GetMyContextFromRoot(simulator.get_context())
    for clicks, expected in enumerate(([0.3, -0.1], [0.0, 0.0], [0.3, -0.1])):
        if clicks:
            press(meshcat, ADAPT)
        simulator.AdvanceTo(0.1 * (clicks + 1))
        np.testing.assert_array_equal(button.get_output_port().Eval(context), expected)

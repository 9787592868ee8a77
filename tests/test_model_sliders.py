"""The controllers' model is as configured until a slider in Meshcat is moved."""

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator

from makebreak.systems.views.model_sliders import FRICTION, GAP, ModelSliders


def test_a_slider_acts_from_when_it_is_moved_and_back():
    meshcat = Meshcat()
    sliders = ModelSliders([1.0 / 3.0, 0.7], meshcat)
    simulator = Simulator(sliders)
    context = simulator.get_mutable_context()

    def outputs_at(t):
        simulator.AdvanceTo(t)
        return [sliders.GetOutputPort(n).Eval(context) for n in ("friction", "gap")]

    # A third is on no step of a slider: what nobody moved is passed on as it is.
    friction, gap = outputs_at(0.1)
    np.testing.assert_array_equal(friction, [1.0 / 3.0, 0.7])
    np.testing.assert_array_equal(gap, [0.0, 0.0])
    meshcat.SetSliderValue(GAP, -4.0)
    friction, gap = outputs_at(0.2)
    np.testing.assert_array_equal(friction, [1.0 / 3.0, 0.7])
    np.testing.assert_allclose(gap, [-0.004, 0.0])
    meshcat.SetSliderValue(FRICTION, 1.2)
    meshcat.SetSliderValue(GAP, 0.0)
    friction, gap = outputs_at(0.3)
    np.testing.assert_allclose(friction, [1.2, 1.2])
    np.testing.assert_array_equal(gap, [0.0, 0.0])
    meshcat.SetSliderValue(FRICTION, 0.0)
    np.testing.assert_array_equal(outputs_at(0.4)[0], [0.0, 0.0])

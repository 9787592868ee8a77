"""What Meshcat shows of a point effector in the plane."""

import numpy as np
import pytest
from meshcat_page import Browser
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.systems.views.planar_view import PlanarView, PlanarViewConfig


@pytest.mark.parametrize("seconds, viscosity", [(0.0, 40.0), (1.5, 70.0), (3.1, 100.0)])
def test_the_bar_beside_the_circle_is_as_long_as_the_viscosity(seconds, viscosity):
    page = Browser()
    config = PlanarViewConfig(viscosity=[40.0, 100.0], ramp_sec=3.0)
    builder = DiagramBuilder()
    view = builder.AddSystem(PlanarView(config, page))
    for name, size in dict(state=4, x_desired=6).items():
        source = builder.AddSystem(ConstantVectorSource(np.zeros(size)))
        builder.Connect(source.get_output_port(), view.GetInputPort(name))
    Simulator(builder.Build()).AdvanceTo(seconds)
    length = page.shown_scale("/makebreak/planar/viscosity")[1]
    # 0.5 m at 200 N s/m, on a millimetre; drawn 30 times a second.
    assert length == pytest.approx(0.001 + 0.5 * viscosity / 200.0, abs=0.002)

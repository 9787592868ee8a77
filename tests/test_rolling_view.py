"""What Meshcat shows of a roll."""

import numpy as np
import pytest
from meshcat_page import Browser
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.systems.contact_mpc.numerics.ball_state import pack
from makebreak.systems.views.rolling_view import (
    GAP_SLIDER,
    RollingView,
    RollingViewConfig,
)

BALL = np.array([0.6, 0.1, 0.0315])


@pytest.fixture(scope="module")
def meshcat():
    return Meshcat()


def show(meshcat, gap, seconds=0.35):
    builder = DiagramBuilder()
    view = builder.AddSystem(RollingView(RollingViewConfig(), meshcat))
    x = pack([0.5, 0.0, 0.1], np.zeros(3), BALL, np.zeros(3), 0.0315)
    for name, value in dict(p_ball=BALL, x=x, gap=[gap]).items():
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), view.GetInputPort(name))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(seconds)


def test_path_ghost_and_bar_are_there_at_once_and_the_track_after_it_moved(meshcat):
    meshcat.Delete("/makebreak")
    builder = DiagramBuilder()
    builder.AddSystem(RollingView(RollingViewConfig(), meshcat))
    for name in ("path", "model_ball", "r_comp"):
        assert meshcat.HasPath(f"/makebreak/{name}"), name
    assert not meshcat.HasPath("/makebreak/track")
    meshcat.DeleteSlider(GAP_SLIDER)
    show(meshcat, 0.01)
    assert meshcat.HasPath("/makebreak/track")
    meshcat.DeleteSlider(GAP_SLIDER)


@pytest.mark.parametrize("gap, mm", [(0.0073, 7.3), (-0.004, -4.0), (np.nan, 0.0)])
def test_slider_shows_the_gap_in_millimetres_and_a_nan_breaks_nothing(meshcat, gap, mm):
    show(meshcat, gap)
    assert meshcat.GetSliderValue(GAP_SLIDER) == pytest.approx(mm)
    meshcat.DeleteSlider(GAP_SLIDER)


@pytest.mark.parametrize("gap", [0.01, 0.005, 0.0002])
def test_bar_stands_on_the_table_and_is_as_high_as_the_gap_times_its_scale(gap):
    browser = Browser()
    show(browser, gap)
    height = 10.0 * gap  # The box is 1 m high and centred.
    np.testing.assert_allclose(browser.shown_scale(RollingView.BAR), [1, 1, height])
    np.testing.assert_allclose(browser.pose[RollingView.BAR][2], height / 2)
    np.testing.assert_allclose(browser.pose["/makebreak/model_ball"], BALL)


@pytest.mark.parametrize("gap", [np.nan, np.inf, -0.02])
def test_bar_is_never_without_a_height(gap):
    browser = Browser()
    show(browser, gap)
    shown = browser.shown_scale(RollingView.BAR)
    assert np.isfinite(shown).all() and shown.min() > 0.0
    assert shown.max() <= 1.0
    assert np.isfinite(browser.pose[RollingView.BAR]).all()

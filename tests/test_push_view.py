"""What Meshcat shows of an object that is pushed."""

import numpy as np
import pytest
from meshcat_page import Browser
from pydrake.geometry import Box, Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL, Q_BALL
from makebreak.systems.views.push_view import PushView, PushViewConfig

PARTS = [
    (Box(0.16, 0.04, 0.04), RigidTransform([0.0, 0.03, 0.0])),
    (Box(0.04, 0.12, 0.04), RigidTransform([0.0, -0.05, 0.0])),
]


def show(meshcat, goal, x_first, x_last=None, seconds=0.5, valid=1.0):
    """The page after the object went from one state to another (N_X,)."""
    builder = DiagramBuilder()
    view = builder.AddSystem(PushView(PushViewConfig(), PARTS, meshcat))
    for name, value in (("goal", goal), ("valid", [valid])):
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), view.GetInputPort(name))
    ends = np.array([x_first, x_first if x_last is None else x_last]).T
    way = PiecewisePolynomial.FirstOrderHold([0.0, seconds], ends)
    x = builder.AddSystem(TrajectorySource(way))
    builder.Connect(x.get_output_port(), view.GetInputPort("x"))
    Simulator(builder.Build()).AdvanceTo(seconds)


def state(x, y, yaw):
    found = np.zeros(N_X)
    found[Q_BALL] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    found[P_BALL] = [x, y, 0.02]
    return found


def test_ghosts_stand_at_goal_and_estimate():
    browser = Browser()
    show(browser, [0.5, -0.1, 0.7], state(0.4, 0.1, -0.4))
    np.testing.assert_allclose(browser.pose[PushView.GOAL], [0.5, -0.1, 0.02])
    np.testing.assert_allclose(browser.pose[PushView.MODEL], [0.4, 0.1, 0.02])
    for path in (PushView.GOAL, PushView.MODEL):
        np.testing.assert_allclose(browser.pose[f"{path}/1"], [0.0, -0.05, 0.0])


def test_track_is_there_after_it_moved_and_not_before():
    meshcat = Meshcat()
    show(meshcat, [0.5, 0.0, 0.0], state(0.4, 0.1, 0.0))
    assert not meshcat.HasPath(PushView.TRACK)
    way = state(0.4, 0.1, 0.0), state(0.5, 0.1, 0.0)
    show(meshcat, [0.5, 0.0, 0.0], *way, valid=0.0)
    assert not meshcat.HasPath(PushView.TRACK)
    show(meshcat, [0.5, 0.0, 0.0], *way)
    assert meshcat.HasPath(PushView.TRACK)


def test_what_is_not_finite_breaks_nothing_and_no_parts_are_refused():
    meshcat = Meshcat()
    show(meshcat, [np.nan, 0.0, 0.0], np.full(N_X, np.nan))
    with pytest.raises(ValueError, match="parts is empty, expected the object's"):
        PushView(PushViewConfig(), [], meshcat)

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.systems.contact_mpc.numerics.pivot_target import (
    LEFT,
    RIGHT,
    THETA,
    corners,
    fingers_away,
    pivot_target,
    share_of_rate,
)
from makebreak.systems.contact_mpc.pivot_target import PivotTarget, PivotTargetConfig

SIDE = 0.1
POINTS = np.array([[-0.062, 0.02], [0.015, 0.062]])


def turned(point, theta):
    """A body point in the world's axes: complex numbers, theta > 0 turns z to x."""
    z = complex(*point) * np.exp(-1j * theta)
    return np.array([z.real, z.imag])


def test_corners_of_a_turned_cube():
    q = np.array([0.3, 0.2, 0.4])
    body = [(-0.05, -0.05), (0.05, -0.05), (0.05, 0.05), (-0.05, 0.05)]
    expected = [q[:2] + turned(point, 0.4) for point in body]
    np.testing.assert_allclose(corners(q, SIDE), expected, atol=1e-15)
    # Tipped by a positive angle the cube stands on its lower right corner.
    assert np.argmin(corners(q, SIDE)[:, 1]) == 1


def test_the_edge_stays_and_the_fingers_go_with_the_cube():
    rng = np.random.default_rng(0)
    q = rng.normal(size=7)
    q[THETA] = 0.3
    x = pivot_target(q, SIDE, POINTS, 1.5, 0.8, 0.05, 10)
    assert x.shape == (11, 14)
    np.testing.assert_allclose(x[:, THETA], 0.3 + 0.8 * 0.05 * np.arange(11))
    edge = corners(q, SIDE)[1]
    for row in x:
        np.testing.assert_allclose(corners(row, SIDE)[1], edge, atol=1e-14)
        for finger, point in ((LEFT, POINTS[0]), (RIGHT, POINTS[1])):
            np.testing.assert_allclose(
                row[finger] - row[:2], turned(point, row[THETA]), atol=1e-14
            )


def test_velocities_lead_from_knot_to_knot_and_end_in_rest():
    x = pivot_target(np.zeros(7), SIDE, POINTS, 1.5, 0.8, 0.05, 6)
    np.testing.assert_allclose(x[:-1, :7] + 0.05 * x[:-1, 7:], x[1:, :7], atol=1e-15)
    assert (x[-1, 7:] == 0.0).all()


@pytest.mark.parametrize("theta", [1.4, 1.7])
def test_the_angle_never_passes_its_goal(theta):
    q = np.zeros(7)
    q[THETA] = theta
    angles = pivot_target(q, SIDE, POINTS, 1.55, 1.0, 0.05, 10)[:, THETA]
    assert angles[0] == theta and angles[-1] == pytest.approx(1.55)
    steps = np.diff(angles) * np.sign(1.55 - theta)
    assert (steps >= -1e-15).all() and steps[0] == pytest.approx(0.05)


def test_the_farther_finger_counts():
    q = np.array([0.1, 0.05, 0.7, 0.0, 0.0, 0.0, 0.0])
    q[LEFT] = q[:2] + turned(POINTS[0], 0.7) + [0.03, 0.0]
    q[RIGHT] = q[:2] + turned(POINTS[1], 0.7) + [0.0, -0.04]
    assert fingers_away(q, POINTS) == pytest.approx(0.04)


def test_the_rate_fades_between_near_and_far():
    shares = [share_of_rate(d, 0.03, 0.06) for d in (0.0, 0.03, 0.04, 0.06, 1.0)]
    np.testing.assert_allclose(shares, [1.0, 1.0, 2.0 / 3.0, 0.0, 0.0], atol=1e-14)


def test_the_system_asks_for_no_turn_before_the_fingers_are_there():
    config = PivotTargetConfig(side=SIDE, finger_radius=0.012, rate=0.8)
    for away, rate in ((0.0, 0.8), (0.2, 0.0)):
        x = np.zeros(14)
        x[LEFT], x[RIGHT] = POINTS[0] - [away, 0.0], POINTS[1]
        builder = DiagramBuilder()
        target = builder.AddSystem(PivotTarget(config, 0.05, 4))
        source = builder.AddSystem(ConstantVectorSource(x))
        builder.Connect(source.get_output_port(), target.GetInputPort("x"))
        builder.ExportOutput(target.GetOutputPort("x_desired"), "x_desired")
        diagram = builder.Build()
        context = diagram.CreateDefaultContext()
        found = diagram.GetOutputPort("x_desired").Eval(context).reshape(5, 14)
        expected = pivot_target(x[:7], SIDE, POINTS, np.pi / 2, rate, 0.05, 4)
        np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(side=0.0), "side is 0.0, expected > 0"),
        (dict(rate=-1.0), "rate is -1.0, expected > 0"),
        (dict(goal=np.nan), "goal is nan"),
    ],
)
def test_numbers_out_of_range_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        PivotTarget(PivotTargetConfig(**changes), 0.05, 10)

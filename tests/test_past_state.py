"""The state a moment ago: no lag, and tip and object of the same moment."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    P_TIP,
    Q_BALL,
    V_BALL,
    V_TIP,
    W_BALL,
)
from makebreak.systems.perception.numerics.past_state import pose_at
from makebreak.systems.perception.numerics.pose_filter import turn_between, turned
from makebreak.systems.perception.past_state import PastState, PastStateConfig
from makebreak.systems.perception.pose_sensor import PoseSensor, PoseSensorConfig

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
A, ALPHA = np.array([0.4, -0.2, 0.0]), 3.0  # [m/s2], [rad/s2]


def position(t):
    return np.array([0.5, 0.1, 0.02]) + 0.5 * A * t**2


def readings(times, noise=0.0, rng=None):
    return tuple(
        (
            t,
            position(t) + (noise * rng.normal(size=3) if noise else 0.0),
            turned(UPRIGHT, np.array([0.0, 0.0, 0.5 * ALPHA * t**2])),
        )
        for t in times
    )


def test_a_steady_acceleration_is_known_exactly():
    times = np.arange(1.0, 1.3, 1 / 30)
    p, v, q, w = pose_at(1.13, readings(times), 0.1)
    # Position and turn are parabolas: rounding alone.
    np.testing.assert_allclose(p, position(1.13), atol=1e-12)
    np.testing.assert_allclose(v, A * 1.13, atol=1e-11)
    angle = turn_between(UPRIGHT, q)[2]
    assert angle == pytest.approx(0.5 * ALPHA * 1.13**2, abs=1e-9)
    np.testing.assert_allclose(w, [0.0, 0.0, ALPHA * 1.13], atol=1e-9)


def test_noise_is_averaged_as_least_squares_tells():
    rng, found = np.random.default_rng(0), []
    times = 1.0 + np.arange(-3, 4) / 30.0
    for _ in range(400):
        found.append(pose_at(1.0, readings(times, 1e-3, rng), 0.1)[1])
    # Standard deviation of a slope; 400 x 3 samples know it to 2 %.
    expected = 1e-3 / np.sqrt(((times - 1.0) ** 2).sum())
    assert np.std(np.array(found) - A) == pytest.approx(expected, rel=0.08)


def test_too_few_readings_or_none_on_one_side_tell_nothing():
    times = 1.0 + np.arange(-3, 4) / 30.0
    assert pose_at(1.0, readings(times), 0.1) is not None
    assert pose_at(1.0, readings(times), 0.05) is None  # Three of them.
    assert pose_at(1.101, readings(times), 0.2) is None  # All of them before.
    bad = list(readings(times))
    bad[2] = (bad[2][0], np.full(3, np.nan), bad[2][2])
    assert pose_at(1.0, bad, 0.1) is None


class Moving(LeafSystem):
    """Tip and object in steady acceleration, and the force, as ports."""

    def __init__(self):
        super().__init__()
        self.DeclareAbstractOutputPort(
            "body_poses", lambda: Value([RigidTransform()]), self._poses
        )
        self.DeclareVectorOutputPort("x", N_X, self._x)
        self.DeclareVectorOutputPort("u", 3, self._u)

    def _poses(self, context, output):
        t = context.get_time()
        turn = RotationMatrix.MakeZRotation(0.5 * ALPHA * t**2)
        output.set_value([RigidTransform(), RigidTransform(turn, position(t))])

    def _x(self, context, output):
        t, x = context.get_time(), np.full(N_X, np.nan)  # Of the object: not used.
        x[P_TIP], x[V_TIP] = [t, 2.0 * t, 3.0], [1.0, 2.0, 0.0]
        output.SetFromVector(x)

    def _u(self, context, output):
        output.SetFromVector([0.0, 0.0, context.get_time()])


def test_tip_object_and_force_are_of_one_moment():
    builder = DiagramBuilder()
    world = builder.AddSystem(Moving())
    sensor = builder.AddSystem(PoseSensor(PoseSensorConfig(noise=[0.0, 0.0]), 1))
    past = builder.AddSystem(PastState(PastStateConfig(height=0.02)))
    for source, output, target, port in (
        (world, "body_poses", sensor, "body_poses"), (world, "x", past, "x"),
        (world, "u", past, "u_measured"), (sensor, "readings", past, "readings"),
    ):  # fmt: skip
        builder.Connect(source.GetOutputPort(output), target.GetInputPort(port))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    own = past.GetMyContextFromRoot(simulator.get_context())

    def now(name):
        return past.GetOutputPort(name).Eval(own)

    simulator.AdvanceTo(0.21)
    assert now("ready")[0] == 0.0  # The first moments lack readings before them.
    simulator.AdvanceTo(1.01)
    assert now("ready")[0] == 1.0
    x, t = now("x"), 0.8  # Four periods of 50 ms before 1.0 s.
    np.testing.assert_allclose(x[P_TIP], [t, 2 * t, 3.0], atol=1e-9)
    np.testing.assert_allclose(now("u_measured"), [0, 0, t], atol=1e-9)
    np.testing.assert_allclose(x[P_BALL], position(t), atol=1e-9)
    np.testing.assert_allclose(x[V_BALL], A * t, atol=1e-9)
    assert turn_between(UPRIGHT, x[Q_BALL])[2] == pytest.approx(0.5 * ALPHA * t**2)
    np.testing.assert_allclose(x[W_BALL], [0, 0, ALPHA * t], atol=1e-8)


def test_a_period_or_a_width_out_of_range_is_refused():
    with pytest.raises(ValueError, match="ticks is 0"):
        PastState(PastStateConfig(ticks=0))
    with pytest.raises(ValueError, match="half_width is 0.0"):
        PastState(PastStateConfig(half_width=0.0))

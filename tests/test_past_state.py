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
    p, v, q, w, *_ = pose_at(1.13, readings(times), 0.1)
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

    # Motion of the object, and the input, which a test may change.
    place = staticmethod(position)
    turn_rate, tip = ALPHA, staticmethod(lambda t: np.array([t, 2.0 * t, 3.0]))
    force = staticmethod(lambda t: np.array([0.0, 0.0, 5.0]))

    def _poses(self, context, output):
        t = context.get_time()
        turn = RotationMatrix.MakeZRotation(0.5 * self.turn_rate * t**2)
        output.set_value([RigidTransform(), RigidTransform(turn, self.place(t))])

    def _x(self, context, output):
        t, x = context.get_time(), np.full(N_X, np.nan)  # Of the object: not used.
        x[P_TIP] = self.tip(t)
        output.SetFromVector(x)

    def _u(self, context, output):
        output.SetFromVector(self.force(context.get_time()))


def past_of(world, past=None):
    builder = DiagramBuilder()
    builder.AddSystem(world)
    sensor = builder.AddSystem(PoseSensor(PoseSensorConfig(noise=[0.0, 0.0]), 1))
    past = builder.AddSystem(past or PastState(PastStateConfig(height=0.02)))
    for source, output, target, port in (
        (world, "body_poses", sensor, "body_poses"), (world, "x", past, "x"),
        (world, "u", past, "u"), (sensor, "reading", past, "reading"),
    ):  # fmt: skip
        builder.Connect(source.GetOutputPort(output), target.GetInputPort(port))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    own = past.GetMyContextFromRoot(simulator.get_context())
    return simulator, lambda name: past.GetOutputPort(name).Eval(own)


def test_tip_object_and_force_are_of_one_moment():
    simulator, now = past_of(Moving())
    simulator.AdvanceTo(0.21)
    assert now("ready")[0] == 0.0  # The first moments lack readings before them.
    simulator.AdvanceTo(1.01)
    assert now("ready")[0] == 1.0
    x, t = now("x"), 0.8  # Four periods of 50 ms before 1.0 s.
    np.testing.assert_allclose(x[P_TIP], [t, 2 * t, 3.0], atol=1e-9)
    np.testing.assert_allclose(x[V_TIP], [1.0, 2.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(now("u_measured"), [0.0, 0.0, 5.0], atol=1e-9)
    np.testing.assert_allclose(x[P_BALL], position(t), atol=1e-9)
    np.testing.assert_allclose(x[V_BALL], A * t, atol=1e-9)
    assert turn_between(UPRIGHT, x[Q_BALL])[2] == pytest.approx(0.5 * ALPHA * t**2)
    np.testing.assert_allclose(x[W_BALL], [0, 0, ALPHA * t], atol=1e-8)


def test_a_push_that_begins_and_ends_within_the_filter_keeps_its_balance():
    """The object of 0.7 kg has all its motion from a force of 40 ms, and the tip of
    1 kg feels it back: in every step the filtered momentum is that of the filtered
    force. (With the tip and the force as they were then, it is off by 0.07 N s.)"""
    mass, force, begins, ends = 0.7, np.array([3.0, -1.0, 0.0]), 0.503, 0.543

    def moved(t):  # Second integral of the force.
        since = [max(t - at, 0.0) ** 2 / 2.0 for at in (begins, ends)]
        return force * (since[0] - since[1])

    class Pushed(Moving):
        place = staticmethod(lambda t: np.array([0.5, 0.1, 0.02]) + moved(t) / mass)
        tip = staticmethod(lambda t: np.array([0.1 * t**2, 0.0, 0.0]) - moved(t))
        turn_rate = 0.0
        force = staticmethod(lambda t: np.array([0.2, 0.0, 0.0]))

    simulator, now = past_of(Pushed())
    before, moving = None, 0.0
    for k in range(8, 24):
        simulator.AdvanceTo(0.05 * k + 0.001)
        x = now("x")
        momentum = x[V_TIP] + mass * x[V_BALL]
        if before is not None:
            expected = 0.05 * now("u_measured")
            np.testing.assert_allclose(momentum - before, expected, atol=2e-4)
        before, moving = momentum, max(moving, np.linalg.norm(x[V_BALL]))
    assert moving > 0.1


def test_an_input_that_is_not_finite_is_forgotten_with_all_that_is_before():
    class Broken(Moving):
        force = staticmethod(
            lambda t: np.full(3, np.nan if abs(t - 0.6) < 3e-3 else 1.0)
        )

    simulator, now = past_of(Broken())
    ready = []
    for k in range(8, 24):
        simulator.AdvanceTo(0.05 * k + 0.001)
        ready.append(bool(now("ready")[0]))
        if ready[-2:] == [True, True]:
            np.testing.assert_allclose(now("u_measured"), 1.0, atol=1e-9)
    # Known until the gap comes, and again when all readings in use are after it.
    assert ready == [True] * 4 + [False] * 7 + [True] * 5


def test_a_period_or_a_width_out_of_range_is_refused():
    with pytest.raises(ValueError, match="ticks is 0"):
        PastState(PastStateConfig(ticks=0))
    with pytest.raises(ValueError, match="half_width is 0.0"):
        PastState(PastStateConfig(half_width=0.0))
    with pytest.raises(ValueError, match="period_sec is 0.05, expected a multiple"):
        PastState(PastStateConfig(tick_sec=0.03))


def test_a_ball_rolls_without_slipping_and_turns_as_far_as_it_moves():
    """Its readings say nothing of how it is turned (q is what the table makes of it),
    and the learner takes the mean speed of a step from the change of the pose."""
    past = PastState(PastStateConfig(height=0.02), is_ball=True)
    simulator, now = past_of(Moving(), past)
    simulator.AdvanceTo(1.01)
    before = now("x")
    simulator.AdvanceTo(1.06)
    x, t = now("x"), 0.85
    np.testing.assert_allclose(x[V_BALL], A * t, atol=1e-9)
    np.testing.assert_allclose(x[W_BALL], [0.2 * t / 0.02, 0.4 * t / 0.02, 0.0])
    turn, way = turn_between(before[Q_BALL], x[Q_BALL]), (x - before)[P_BALL]
    np.testing.assert_allclose(turn, [-way[1] / 0.02, way[0] / 0.02, 0.0], atol=1e-9)

"""The tip's motion from the joint sensors, and the estimator around it."""

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces

from makebreak.diagrams.station import TIP_FRAME, make_control_plant
from makebreak.systems.arm.impedance_controller import serial_chain_of
from makebreak.systems.arm.numerics.serial_chain import chain_state
from makebreak.systems.contact_mpc.numerics.ball_state import (
    P_BALL,
    P_TIP,
    Q_BALL,
    V_BALL,
    V_TIP,
    W_BALL,
)
from makebreak.systems.perception.numerics.state_estimator import (
    input_with_force,
    observe_force,
    tip_mobility,
    tip_motion,
)
from makebreak.systems.perception.state_estimator import (
    StateEstimator,
    StateEstimatorConfig,
)

MASS, R_BALL = 1.3, 0.03
CONFIG = StateEstimatorConfig(
    ball_radius=R_BALL, tip_mass=MASS, window_sec=0.01, period_sec=0.0025
)
N_WINDOW = 4  # 10 ms of 2.5 ms each.


@pytest.fixture(scope="module")
def arm() -> MultibodyPlant:
    return make_control_plant()


@pytest.fixture(scope="module")
def chain(arm):
    return serial_chain_of(arm, TIP_FRAME)


def random_motion(arm, rng):
    """q, v, and the torque and the tip's p, v, a that Drake gives for some vdot."""
    context = arm.CreateDefaultContext()
    q = arm.GetPositions(context) + rng.uniform(-0.5, 0.5, 7)
    v, vdot = rng.uniform(-1.0, 1.0, (2, 7))
    arm.SetPositions(context, q)
    arm.SetVelocities(context, v)
    forces = MultibodyForces(arm)
    arm.CalcForceElementsContribution(context, forces)
    torque = arm.CalcInverseDynamics(context, vdot, forces)
    tip, world = arm.GetFrameByName(TIP_FRAME), arm.world_frame()
    of_v = JacobianWrtVariable.kV
    at_tip = of_v, tip, np.zeros(3), world, world
    a = arm.CalcBiasTranslationalAcceleration(context, *at_tip).ravel()
    a += arm.CalcJacobianTranslationalVelocity(context, *at_tip) @ vdot
    p = tip.CalcPoseInWorld(context).translation()
    v_tip = tip.CalcSpatialVelocityInWorld(context).translational()
    return q, v, torque, p, v_tip, a


def test_tip_moves_as_in_drake_and_u_is_the_mass_times_its_free_acceleration(
    arm, chain
):
    rng = np.random.default_rng(0)
    for _ in range(10):
        q, v, torque, p, v_tip, a = random_motion(arm, rng)
        ours = tip_motion(chain, q, v, torque, MASS)
        np.testing.assert_allclose(ours[0], p, atol=1e-14)
        np.testing.assert_allclose(ours[1], v_tip, atol=1e-14)
        # Accelerations of order 1 to 10 m/s2, through a mass matrix whose condition
        # number is some hundred: 1e-11 is round-off.
        np.testing.assert_allclose(ours[2], MASS * a, atol=1e-11)


class Bench:
    """The estimator alone: feed it readings, let it tick, look at its ports."""

    def __init__(self, arm, chain):
        q_default = arm.GetPositions(arm.CreateDefaultContext())
        self.estimator = StateEstimator(CONFIG, chain, q_default)
        self.context = self.estimator.CreateDefaultContext()
        self.good = dict(
            q=q_default, v=np.zeros(7), torque=np.zeros(7), seen=[1.0],
            p_ball=[0.6, 0.1, R_BALL], v_ball=[0.03, -0.02, 0.0],
        )  # fmt: skip
        self.feed()

    def feed(self, **changes):
        for name, value in (self.good | changes).items():
            self.estimator.GetInputPort(name).FixValue(self.context, value)

    def tick(self, **changes):
        self.feed(**changes)
        after = self.estimator.EvalUniquePeriodicDiscreteUpdate(self.context)
        self.context.SetDiscreteState(after)
        return self.read()

    def read(self):
        names = ("x", "u_measured", "valid")
        return [self.estimator.GetOutputPort(n).Eval(self.context) for n in names]


@pytest.fixture
def bench(arm, chain):
    return Bench(arm, chain)


def test_x_has_the_layout_of_the_lcs_and_a_ball_that_rolls(bench, arm):
    q, v, torque, p, v_tip, _ = random_motion(arm, np.random.default_rng(1))
    x, _, valid = bench.tick(q=q, v=v, torque=torque)
    assert x.shape == (19,) and valid == 1.0
    np.testing.assert_allclose(x[P_TIP], p, atol=1e-14)
    np.testing.assert_allclose(x[V_TIP], v_tip, atol=1e-14)
    np.testing.assert_array_equal(x[Q_BALL], [1, 0, 0, 0])
    np.testing.assert_array_equal(x[P_BALL], [0.6, 0.1, R_BALL])
    np.testing.assert_array_equal(x[V_BALL], [0.03, -0.02, 0.0])
    slip = x[V_BALL] + np.cross(x[W_BALL], [0.0, 0.0, -R_BALL])
    np.testing.assert_allclose(slip, 0.0, atol=1e-17)


def test_a_known_pose_takes_the_place_of_rolling(bench):
    pose = dict(q_object=[2.0, 0.0, 0.0, 0.0], w_object=[0.1, 0.2, 0.3])
    x, _, valid = bench.tick(**pose)
    assert valid == 1.0
    np.testing.assert_array_equal(x[Q_BALL], [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(x[W_BALL], pose["w_object"])
    for name, bad in (
        ("q_object", np.full(4, np.nan)),
        ("q_object", np.zeros(4)),
        ("w_object", np.full(3, np.nan)),
    ):
        held, _, valid = bench.tick(**pose | {name: bad, "p_ball": [0.0, 0.0, 0.0]})
        assert valid == -1.0
        np.testing.assert_array_equal(held, x)


def test_before_the_first_reading_the_tip_is_at_its_default_and_nothing_is_valid(
    bench, arm
):
    x, u, valid = bench.read()
    tip = arm.GetFrameByName(TIP_FRAME)
    p_tip = tip.CalcPoseInWorld(arm.CreateDefaultContext()).translation()
    np.testing.assert_allclose(x[P_TIP], p_tip, atol=1e-14)
    assert np.isfinite(x).all() and (u == 0.0).all() and valid == 0.0


def test_the_input_beside_the_real_force_makes_the_point_move_as_the_tip(arm, chain):
    """An arm that is pushed at the tip in Drake: (input + force) / m is the tip's
    acceleration, though the tip has not the point's mass."""
    rng = np.random.default_rng(3)
    for _ in range(5):
        q, v, torque, _, v_tip, free = random_motion(arm, rng)
        force, dt = rng.normal(0.0, 10.0, 3), 1e-3
        context = arm.CreateDefaultContext()
        arm.SetPositions(context, q)
        J = arm.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, arm.GetFrameByName(TIP_FRAME), np.zeros(3),
            arm.world_frame(), arm.world_frame(),
        )  # fmt: skip
        a = free + J @ np.linalg.solve(arm.CalcMassMatrix(context), J.T @ force)
        u = tip_motion(chain, q, v, torque, MASS)[2]
        found = input_with_force(
            u, v_tip - dt * a, v_tip, tip_mobility(chain_state(chain, q, v)), MASS, dt
        )
        np.testing.assert_allclose((found + force) / MASS, a, atol=1e-8)


def test_the_input_beside_a_force_is_averaged_and_missing_where_a_reading_is(bench):
    def read():
        return [
            bench.estimator.GetOutputPort(name).Eval(bench.context)
            for name in ("u_with_force_now", "u_with_force")
        ]

    rng, found = np.random.default_rng(4), []
    for k in range(8):
        torque = np.full(7, np.nan) if k == 2 else rng.normal(0.0, 10.0, 7)
        bench.tick(torque=torque)
        now, mean = read()
        found.append(now)
        if k >= N_WINDOW - 1:  # Not a number as long as one of them is not.
            np.testing.assert_allclose(mean, np.mean(found[-N_WINDOW:], axis=0))
    # A change of speed is known between two good readings.
    known = [bool(np.isfinite(u).all()) for u in found]
    assert known == [True, True, False, False, True, True, True, True]


def test_u_measured_is_the_mean_of_the_window_and_forgets_what_is_older(bench, chain):
    rng = np.random.default_rng(2)
    forces = []
    for torque in rng.normal(0.0, 10.0, (7, 7)):
        _, u, _ = bench.tick(torque=torque)
        q, v = bench.good["q"], bench.good["v"]
        forces.append(tip_motion(chain, q, v, torque, MASS)[2])
        # The window starts with zeros.
        expected = np.sum(forces[-N_WINDOW:], axis=0) / N_WINDOW
        np.testing.assert_allclose(u, expected, atol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("port", ["q", "v", "p_ball", "v_ball"])
def test_a_reading_that_is_not_finite_leaves_x_and_u_and_is_not_valid(bench, port, bad):
    x, u, _ = bench.tick(torque=np.full(7, 5.0))
    value = np.array(bench.good[port], dtype=float)
    value[1] = bad
    other = np.full(7, -3.0)  # Would change x and u, if it were taken.
    readings = {"v": other, "torque": other} | {port: value}
    x_after, u_after, valid = bench.tick(**readings)
    np.testing.assert_array_equal(x_after, x)
    np.testing.assert_array_equal(u_after, u)
    assert valid == -1.0
    assert bench.tick()[2] == 1.0


def test_without_torques_the_tip_is_followed_and_the_forces_are_held(bench, arm):
    def tip_force():
        return bench.estimator.GetOutputPort("tip_force").Eval(bench.context)

    for _ in range(3):
        _, u, _ = bench.tick(torque=np.full(7, 5.0))
    force = tip_force()
    assert np.linalg.norm(force) > 0.1
    q, v, _, p, v_tip, _ = random_motion(arm, np.random.default_rng(1))
    x, u_after, valid = bench.tick(q=q, v=v, torque=np.full(7, np.nan))
    np.testing.assert_allclose(x[P_TIP], p, atol=1e-14)
    np.testing.assert_allclose(x[V_TIP], v_tip, atol=1e-14)
    np.testing.assert_array_equal(u_after, u)
    np.testing.assert_array_equal(tip_force(), force)
    assert valid == 1.0
    # The speed that the tip gained meanwhile is not taken for a force.
    bench.tick(q=q, v=v)
    np.testing.assert_array_equal(tip_force(), 0.0)


@pytest.mark.parametrize("seen", [0.0, np.nan])
def test_a_ball_that_is_not_seen_is_not_valid_but_the_tip_is_followed(bench, seen):
    q = bench.good["q"] + 0.1
    before = bench.read()[0]
    x, _, valid = bench.tick(q=q, seen=[seen])
    assert valid == 0.0
    assert np.linalg.norm(x[P_TIP] - before[P_TIP]) > 0.01


@pytest.mark.parametrize(
    "fault",
    [{"seen": [0.0]}, {"v": np.full(7, np.nan)}, {"torque": np.full(7, np.nan)}],
)
def test_a_fault_spoils_the_window_until_it_has_left_it(bench, fault):
    def window_valid():
        port = bench.estimator.GetOutputPort("window_valid")
        return port.Eval(bench.context)[0]

    bench.tick()
    assert window_valid() == 1.0
    bench.tick(**fault)
    for _ in range(N_WINDOW - 1):
        assert window_valid() == 0.0
        bench.tick()
    assert window_valid() == 0.0
    bench.tick()
    assert window_valid() == 1.0
    bench.tick()  # Readings beyond the window's are not counted.
    states = bench.context.get_discrete_state()
    every = (states.get_vector(i).value() for i in range(states.num_groups()))
    assert [x[-1] for x in every if x.size == 3 * N_WINDOW + 1] == [N_WINDOW]


@pytest.mark.parametrize("name", ["ball_radius", "tip_mass"])
def test_wrong_settings_are_refused_by_name(arm, chain, name):
    config = StateEstimatorConfig(**{name: -1.0})
    with pytest.raises(ValueError, match=rf"{name}.*-1\.0"):
        StateEstimator(config, chain, np.zeros(7))


def test_a_steady_force_on_the_tip_is_felt_with_a_first_order_lag():
    mass, force, gain, dt = (
        np.diag([3.0, 4.0, 6.0]),
        np.array([1.0, -2.0, 9.0]),
        60,
        1e-4,
    )
    a_motors = np.array([0.3, 0.1, -0.5])
    observer, v = np.zeros(7), np.array([0.02, 0.0, -0.03])
    for _ in range(500):
        observer = observe_force(observer, v, a_motors, np.linalg.inv(mass), gain, dt)
        v = v + dt * (a_motors + np.linalg.solve(mass, force))
    # Euler at gain dt = 0.006: the lag's exponential is right to half of that.
    expected = force * (1.0 - np.exp(-gain * 499 * dt))
    np.testing.assert_allclose(observer[3:6], expected, rtol=0.01)


def test_mobility_of_the_tip_is_drakes(chain, arm):
    context = arm.CreateDefaultContext()
    frame = arm.GetFrameByName("tip")
    J = arm.CalcJacobianTranslationalVelocity(
        context, JacobianWrtVariable.kV, frame, np.zeros(3), arm.world_frame(),
        arm.world_frame(),
    )  # fmt: skip
    M = arm.CalcMassMatrixViaInverseDynamics(context)  # Rotors included.
    q = arm.GetPositions(context)
    ours = tip_mobility(chain_state(chain, q, np.zeros(q.size)))
    np.testing.assert_allclose(ours, J @ np.linalg.solve(M, J.T), rtol=1e-9, atol=1e-12)

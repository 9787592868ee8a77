import numpy as np
import pytest
from chain_against_drake import assert_moves_as_in_drake
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JacobianWrtVariable,
    RevoluteJoint,
    SpatialInertia,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Demultiplexer
from scipy.spatial.transform import Rotation

from makebreak.diagrams.station import (
    SensorNoise,
    StationConfig,
    make_control_plant,
    make_station,
)
from makebreak.models.model_files import MODELS
from makebreak.models.scene import read_scene
from makebreak.systems.arm.impedance_controller import (
    DELAY_DAMPING_MAX,
    ImpedanceConfig,
    ImpedanceController,
    PostureConfig,
    serial_chain_of,
)
from makebreak.systems.arm.numerics.energy_tank import N_TANK
from makebreak.systems.arm.numerics.impedance_controller import (
    N_SLOTS,
    REFERENCE_HELD,
    SENSORS_HELD,
    SLOT,
    impedance_torque,
    memory_size,
    quaternion_of,
    rotation_error,
    rotation_of,
    tick,
)
from makebreak.systems.arm.numerics.joint_limits import (
    EFFORT_LIMITED,
    JOINT_BRAKED,
    RATE_LIMITED,
)
from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.serial_chain import chain_state, tip_kinematics

EFFORT = np.repeat([87.0, 12.0], [4, 3])
NO_NOISE = SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0)
P_TIP = np.array([0.5, 0.0, 0.1])
# Directions, targets, measured wrench; delay.
NO_FORCE = (np.zeros(6), np.zeros(2), np.zeros(6), 0.0)


@pytest.fixture(scope="module")
def plant():
    return make_control_plant()


@pytest.fixture(scope="module")
def law(plant):
    return ImpedanceController(ImpedanceConfig(), plant)._law


@pytest.fixture(scope="module")
def chain(plant):
    return serial_chain_of(plant, "tip")


def unused():
    """No slots under force control, a tank without a past, no lag."""
    return np.zeros((N_SLOTS, SLOT)), np.zeros(N_TANK), 0.0


def reference(p=P_TIP, v=(0, 0, 0), a=(0, 0, 0), quaternion=(1, 0, 0, 0)):
    x_d = np.zeros(19)
    x_d[:3], x_d[3:7], x_d[7:10], x_d[13:16] = p, quaternion, v, a
    return x_d


def random_states(n):
    rng = np.random.default_rng(0)
    return [(rng.uniform(-2.5, 2.5, 7), rng.uniform(-2, 2, 7)) for _ in range(n)]


class Loop:
    """Station without noise and controller, closed."""

    def __init__(self, config=None, ball=(0.8, 0.3), effects=None):
        scene = read_scene(StationConfig().scene)
        scene.initial.poses["ball.ball"] = [1, 0, 0, 0, *ball, 0.0315]
        builder = DiagramBuilder()
        self.station = builder.AddSystem(
            make_station(StationConfig(noise=NO_NOISE), scene=scene)
        )
        self.controller = builder.AddSystem(
            ImpedanceController(
                config or ImpedanceConfig(offset_sec=0.0005), make_control_plant()
            )
        )
        for port, name in (("position", "q"), ("velocity", "v")):
            builder.Connect(
                self.station.GetOutputPort(f"panda.{port}_measured"),
                self.controller.GetInputPort(name),
            )
        builder.Connect(
            self.controller.GetOutputPort("tau"),
            self.station.GetInputPort("panda.torque_commanded"),
        )
        self.simulator = Simulator(builder.Build())
        root = self.simulator.get_mutable_context()
        self.root = root
        self.context = self.controller.GetMyMutableContextFromRoot(root)
        self.plant = self.station.GetSubsystemByName("plant")
        self.plant_context = self.plant.GetMyMutableContextFromRoot(root)
        self.tip = self.plant.GetFrameByName("tip")
        self.set(reference())

    def set(self, x_d, **ports):
        self.controller.GetInputPort("x_desired").FixValue(self.context, x_d)
        for name, value in ports.items():
            self.controller.GetInputPort(name).FixValue(self.context, value)

    def run(self, seconds):
        self.simulator.AdvanceTo(self.root.get_time() + seconds)

    def tau(self):
        return self.controller.GetOutputPort("tau").Eval(self.context)

    def status(self):
        return int(self.controller.GetOutputPort("status").Eval(self.context)[0])

    def pose(self):
        return self.tip.CalcPoseInWorld(self.plant_context)

    def push(self, force):
        """A force on the tip in the world [N], as the torques that it makes."""
        J = self.plant.CalcJacobianTranslationalVelocity(
            self.plant_context,
            JacobianWrtVariable.kV,
            self.tip,
            [0, 0, 0],
            self.plant.world_frame(),
            self.plant.world_frame(),
        )
        port = self.plant.get_applied_generalized_force_input_port()
        port.FixValue(self.plant_context, J.T @ np.asarray(force, dtype=float))


# The arm's dynamics.


def test_chain_agrees_with_drake(plant, chain):
    # Both are exact; numbers up to 1e2 keep 13 digits.
    context = plant.CreateDefaultContext()
    tip = plant.GetFrameByName("tip")
    for q, v in random_states(20):
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        s = chain_state(chain, q, v)
        close = dict(atol=1e-12, rtol=1e-12)
        gravity = plant.CalcGravityGeneralizedForces(context)
        np.testing.assert_allclose(
            s.bias, plant.CalcBiasTerm(context) - gravity, **close
        )
        assert_moves_as_in_drake(s, plant, context, tip, **close)
        p, R, J_again = tip_kinematics(chain, q)
        np.testing.assert_array_equal(p, s.p_WE)
        np.testing.assert_array_equal(R, s.R_WE)
        np.testing.assert_array_equal(J_again, s.J)


def test_rotations_agree_with_scipy():
    rng = np.random.default_rng(0)
    for _ in range(50):
        A, B = Rotation.random(rng=rng), Rotation.random(rng=rng)
        wxyz = np.roll(A.as_quat(), 1)
        np.testing.assert_allclose(rotation_of(3.0 * wxyz), A.as_matrix(), atol=1e-14)
        same = quaternion_of(A.as_matrix())
        np.testing.assert_allclose(same, wxyz * np.sign(wxyz[0]), atol=1e-14)
        expected = (A * B.inv()).as_rotvec()
        error = rotation_error(A.as_matrix(), B.as_matrix())
        np.testing.assert_allclose(error, expected, atol=1e-12)


# The law.


@pytest.mark.parametrize("control_orientation", [False, True])
def test_torque_is_the_law_written_out(law, chain, control_orientation):
    law = law._replace(control_orientation=control_orientation)
    rng = np.random.default_rng(1)
    m = 6 if control_orientation else 3
    for q, v in random_states(5):
        q_n, x_d, wrench = (
            q + 0.1 * rng.normal(size=7),
            rng.normal(size=19),
            np.arange(6.0),
        )
        R_d = Rotation.random(rng=rng).as_matrix()
        K, D = law.stiffness, law.damping
        s = chain_state(chain, q, v)
        J, M_inv = s.J[:m], np.linalg.inv(s.M)
        Lambda = np.linalg.inv(J @ M_inv @ J.T)
        turn = Rotation.from_matrix(R_d @ s.R_WE.T).as_rotvec()
        error = np.concatenate([x_d[:3] - s.p_WE, turn])[:m]
        F = K[:m] * error + D[:m] * (x_d[7:13] - s.J @ v)[:m] + wrench[:m]
        F += Lambda @ (x_d[13:19][:m] - s.bias_a[:m])
        follow = np.concatenate([J @ v, np.zeros(6 - m)])
        damped = s.J.T @ np.linalg.inv(s.J @ s.J.T + 0.02**2 * np.eye(6))
        qdd = 100.0 * (q_n - q) + 20.0 * (damped @ follow - v)
        N_T = np.eye(7) - J.T @ Lambda @ J @ M_inv
        expected = J.T @ F + s.bias + N_T @ s.M @ qdd
        tau, p = impedance_torque(
            chain, law, q, v, q_n, x_d, R_d, K, D, 0.0, wrench, *unused()
        )
        np.testing.assert_allclose(p, s.p_WE)
        # Lambda is regularised by 1e-9 of its inverse's size.
        np.testing.assert_allclose(tau, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("control_orientation", [False, True])
def test_posture_never_accelerates_the_task(law, chain, control_orientation):
    # J inv(M) N' = 0: the tip's acceleration is the same for any posture.
    law = law._replace(control_orientation=control_orientation)
    m = 6 if control_orientation else 3
    for q, v in random_states(10):
        s = chain_state(chain, q, v)
        x_d = reference()
        args = (x_d, np.eye(3), law.stiffness, law.damping, 0.0, np.zeros(6))
        tau = [
            impedance_torque(chain, law, q, v, q_n, *args, *unused())[0]
            for q_n in (q, q + 0.5)
        ]
        assert np.abs(tau[1] - tau[0]).max() > 1.0
        change = s.J[:m] @ np.linalg.solve(s.M, tau[1] - tau[0])
        # Exact but for Lambda's regularisation, by 1e-9 of its inverse's largest entry.
        J = s.J[:m]
        mobility = J @ np.linalg.solve(s.M, J.T)
        left = 1e-9 * mobility.max() * np.linalg.solve(mobility, J @ np.full(7, 50.0))
        atol = 1.1 * np.abs(left).max() + 1e-10
        np.testing.assert_allclose(change, 0.0, atol=atol)


def test_rotational_gains_are_lessened_where_the_wrist_is_light(law, chain):
    # Without rotors the wrist has 0.005 kg m2: explicit damping of 20 N m s/rad would
    # be unstable at 1 kHz. One explicit step must not reverse the rate of turning.
    light = chain._replace(rotor=np.zeros(7))
    law = law._replace(control_orientation=True)
    D = np.array([0.0, 0, 0, 20, 20, 20])
    q = law.q_nominal
    s = chain_state(light, q, np.zeros(7))
    for w in np.eye(3):
        v = np.linalg.pinv(s.J) @ np.concatenate([np.zeros(3), w])
        at_v = chain_state(light, q, v)
        x_d = reference(s.p_WE)
        tau, _ = impedance_torque(
            light,
            law,
            q,
            v,
            q,
            x_d,
            s.R_WE,
            np.zeros(6),
            D,
            0.0,
            np.zeros(6),
            *unused(),
        )
        v_next = v + 1e-3 * np.linalg.solve(at_v.M, tau - at_v.bias)
        assert (s.J[3:] @ v_next) @ w > 0.0


# Limits and bad input, one tick at a time.


def run_ticks(chain, law, inputs):
    """tau, status after each of a sequence of (q, v, x_d[, K, D, wrench])."""
    tau = chain_state(chain, law.q_nominal, np.zeros(7)).bias
    memory, rows = np.zeros(memory_size(7)), []
    for q, v, x_d, *rest in inputs:
        K, D, wrench = (*rest, *(law.stiffness, law.damping, np.zeros(6))[len(rest) :])
        status = tick(
            packed(chain),
            packed(law),
            tau,
            memory,
            q,
            v,
            x_d,
            K,
            D,
            0.0,
            wrench,
            *NO_FORCE,
        )
        rows.append((tau.copy(), status))
    return rows


@pytest.mark.parametrize("size", [1.0, 1e3, 1e12, 1e200, 1e307])
def test_limits_hold_under_absurd_inputs(law, chain, size):
    rng = np.random.default_rng(2)
    inputs = [
        (
            law.q_nominal + 0.3 * rng.normal(size=7),
            size * rng.normal(size=7),
            reference(size * rng.normal(size=3), size * rng.normal(size=3)),
            law.stiffness,
            law.damping,
            size * rng.normal(size=6),
        )
        for _ in range(300)
    ]
    before = chain_state(chain, law.q_nominal, np.zeros(7)).bias
    flags = 0
    for tau, status in run_ticks(chain, law, inputs):
        assert np.all(np.isfinite(tau))
        assert np.all(np.abs(tau) <= EFFORT)
        assert np.all(np.abs(tau - before) <= 1.0 + 1e-12)  # 1000 N m/s x 1 ms.
        before, flags = tau, flags | status
    assert flags & RATE_LIMITED


def test_effort_limit_is_reached_and_said(law, chain):
    rows = run_ticks(
        chain, law, [(law.q_nominal, np.zeros(7), reference([0.5, 0.0, 5.0]))] * 150
    )
    tau, status = rows[-1]
    assert status & EFFORT_LIMITED
    assert np.abs(tau / EFFORT).max() == 1.0


@pytest.mark.parametrize("delay", [np.nan, np.inf, -1.0])
def test_a_delay_that_is_no_time_counts_as_none_and_is_said(law, chain, delay):
    """At 2 rad/s near the end of its range a joint is braked all the same."""
    args = packed(chain), packed(law)
    q, v = law.q_nominal.copy(), np.zeros(7)
    q[0], v[0] = law.q_upper[0] - 0.05, 2.0
    gains = law.stiffness, law.damping, 0.0, np.zeros(6)
    *others, none = NO_FORCE

    def once(delay):
        tau = chain_state(chain, q, v).bias
        start = tau, np.zeros(memory_size(7)), q, v, reference()
        return tau, tick(*args, *start, *gains, *others, delay)

    (tau, status), (without, status_without) = once(delay), once(none)
    assert status_without & JOINT_BRAKED
    assert status == status_without | REFERENCE_HELD
    np.testing.assert_array_equal(tau, without)


@pytest.mark.parametrize("which", ["q", "v"])
def test_nan_sensors_ramp_to_carrying_the_arm(law, chain, which):
    still = np.zeros(7)
    good = (law.q_nominal, still, reference([0.5, 0.0, 0.13]))  # 30 N upwards.
    bad_q, bad_v = law.q_nominal.copy(), still.copy()
    (bad_q if which == "q" else bad_v)[3] = np.nan
    rows = run_ticks(chain, law, [good] * 30 + [(bad_q, bad_v, good[2])] * 60)
    carrying = chain_state(chain, law.q_nominal, still).bias
    assert not rows[29][1] & SENSORS_HELD
    assert np.abs(rows[29][0] - carrying).max() > 5.0
    assert all(status & SENSORS_HELD for _, status in rows[30:])
    steps = np.diff([tau for tau, _ in rows], axis=0)
    assert np.abs(steps).max() <= 1.0 + 1e-12
    np.testing.assert_allclose(rows[-1][0], carrying, atol=1e-12)


def test_nan_sensors_from_the_start_carry_the_nominal_arm(law, chain):
    nan = np.full(7, np.nan)
    rows = run_ticks(chain, law, [(nan, nan, reference())] * 3)
    carrying = chain_state(chain, law.q_nominal, np.zeros(7)).bias
    np.testing.assert_allclose(rows[-1][0], carrying, atol=1e-12)


def coast(law, chain, which, joints, t_nan=0.1, t_end=0.4):
    """A moving arm of which sensors give NaN from t_nan on, by its own equations.

    Returns: per ms, speed norm in the mass matrix (n,) [sqrt(J)], tau (n, 7), status.
    """
    dt = 1e-3
    q = law.q_nominal.copy()
    v = np.linalg.pinv(chain_state(chain, q, np.zeros(7)).J)[:, 1] * 0.4  # [m/s] in y.
    tau, memory = chain_state(chain, q, v).bias, np.zeros(memory_size(7))
    v_d = np.array([0.0, 0.4, 0.0])
    speeds, taus = [], []
    for k in range(round(t_end / dt)):
        q_read, v_read = q.copy(), v.copy()
        if k * dt >= t_nan:
            if "q" in which:
                q_read[joints] = np.nan
            if "v" in which:
                v_read[joints] = np.nan
        x_d = reference(P_TIP + k * dt * v_d, v_d)
        status = tick(
            packed(chain), packed(law), tau, memory, q_read, v_read, x_d,
            law.stiffness, law.damping, 0.0, np.zeros(6), *NO_FORCE,
        )  # fmt: skip
        s = chain_state(chain, q, v)
        speeds.append(np.sqrt(v @ s.M @ v))
        taus.append(tau.copy())
        v = v + dt * np.linalg.solve(s.M, tau - s.bias)
        q = q + dt * v
    return np.array(speeds), np.array(taus), status


@pytest.mark.parametrize("joints", [[3], [0, 5], list(range(7))])
@pytest.mark.parametrize("which", ["q", "v", "qv"])
def test_an_arm_whose_encoders_fail_while_it_moves_is_braked(law, chain, which, joints):
    speed, tau, status = coast(law, chain, which, joints)
    assert status & SENSORS_HELD and np.isfinite(tau).all()
    assert abs(np.diff(tau, axis=0)).max() <= 1.0 + 1e-12  # 1000 N m/s x 1 ms.
    # v' = -20/s v: 300 ms leave exp(-6) = 0.2 %. An arm that is only carried keeps its
    # speed. Joints without any sensor are braked by a prediction, which does not know
    # that the torque took some 20 ms, at its limited rate, to become the brake's:
    # 20/s x 20 ms / 2 of their speed is left over.
    left = 0.2 if which == "qv" else 0.01
    assert speed[-1] < left * speed[99]
    assert np.isfinite(speed).all() and speed[100:].max() < 1.3 * speed[99]


def test_a_joint_that_stands_still_is_not_pushed_by_an_old_velocity(law, chain):
    """The last good velocity may be large; held for ever it would drive the arm."""
    nan, fast = np.full(7, np.nan), np.array([0, 0, 0, 1e6, 0, 0, 0])
    first = (law.q_nominal, fast, reference())
    rows = run_ticks(chain, law, [first] + [(nan, nan, reference())] * 1500)
    assert np.isfinite([tau for tau, _ in rows]).all()
    # At rest it carries the arm near where it was: 10 rad/s over 20/s is 0.5 rad.
    settled = np.diff([tau for tau, _ in rows[-100:]], axis=0)
    assert abs(settled).max() < 1e-6


@pytest.mark.parametrize("index", [0, 4, 8, 14])
def test_nan_reference_holds_the_last_good_pose_at_rest(law, chain, index):
    moving = reference([0.5, 0.0, 0.102], v=[0.02, 0, 0])
    at_rest = reference([0.5, 0.0, 0.102])
    bad = moving.copy()
    bad[index] = np.nan
    state = (law.q_nominal, np.zeros(7))
    rows = run_ticks(chain, law, [(*state, moving)] * 30 + [(*state, bad)] * 30)
    held = run_ticks(chain, law, [(*state, moving)] * 30 + [(*state, at_rest)] * 30)
    np.testing.assert_array_equal(rows[-1][0], held[-1][0])
    assert rows[-1][1] == REFERENCE_HELD and held[-1][1] == 0


@pytest.mark.parametrize(("size", "is_held"), [(0.4, True), (0.9, False), (2.1, True)])
def test_a_quaternion_far_from_unit_length_is_no_reference(law, chain, size, is_held):
    state = (law.q_nominal, np.zeros(7))
    good = reference([0.5, 0.0, 0.102])
    other = reference([0.6, 0.0, 0.102], quaternion=(size, 0, 0, 0))
    rows = run_ticks(chain, law, [(*state, good)] * 30 + [(*state, other)] * 30)
    stayed = run_ticks(chain, law, [(*state, good)] * 60)
    assert np.array_equal(rows[-1][0], stayed[-1][0]) == is_held
    assert bool(rows[-1][1] & REFERENCE_HELD) == is_held


def test_without_any_good_reference_the_arm_stays(law, chain):
    state = (law.q_nominal, np.zeros(7))
    bad = np.full(19, np.nan)
    rows = run_ticks(chain, law, [(*state, bad)] * 30)
    carrying = chain_state(chain, *state).bias
    # The posture takes a step every 12 ticks, from nominal angles of six digits.
    np.testing.assert_allclose(rows[-1][0], carrying, atol=1e-3)
    assert rows[-1][1] == REFERENCE_HELD


@pytest.mark.parametrize(  # A wrench may be negative.
    "port, value",
    [(port, x) for port in range(3) for x in (np.nan, np.inf)] + [(0, -1.0), (1, -1.0)],
)
def test_bad_gains_and_wrench_fall_back_and_are_said(law, chain, port, value):
    state = (law.q_nominal, np.zeros(7), reference([0.5, 0.0, 0.101]))
    rest = [law.stiffness, law.damping, np.zeros(6)]
    expected = run_ticks(chain, law, [(*state, *rest)] * 5)[-1]
    rest[port] = np.full(6, value)
    tau, status = run_ticks(chain, law, [(*state, *rest)] * 5)[-1]
    assert status == REFERENCE_HELD and expected[1] == 0
    np.testing.assert_array_equal(tau, expected[0])


# On the simulated arm.


def test_arm_is_held_still_against_gravity():
    loop = Loop()
    loop.run(1.0)
    # The scene's angles have six digits: the posture settles within 1e-5 m.
    np.testing.assert_allclose(loop.pose().translation(), P_TIP, atol=1e-5)
    assert np.abs(loop.plant.GetVelocities(loop.plant_context)[:7]).max() < 1e-4
    assert loop.status() == 0


@pytest.mark.parametrize("control_orientation", [False, True])
def test_a_pushed_tip_yields_by_force_over_stiffness(control_orientation):
    loop = Loop(
        ImpedanceConfig(control_orientation=control_orientation, offset_sec=0.0005)
    )
    force = np.array([4.0, -3.0, 5.0])
    stiffness = np.array([500.0, 1000.0, 2000.0, 50.0, 50.0, 50.0])
    damping = np.array([120.0, 150.0, 200.0, 15.0, 15.0, 15.0])
    loop.set(reference(), stiffness=stiffness, damping=damping)
    for _ in range(10):
        loop.push(force)
        loop.run(0.25)
    yielded = loop.pose().translation() - P_TIP
    # Slowest: 120/500 s, so 2.5 s leave e^-10 of 8 mm.
    np.testing.assert_allclose(yielded, force / stiffness[:3], atol=1e-5)


def test_feed_forward_adds_to_the_spring():
    loop = Loop()
    damping = [150.0] * 3 + [0.0] * 3
    wrench = [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]
    loop.set(reference(), damping=damping, wrench_feedforward=wrench)
    loop.run(1.5)
    moved = loop.pose().translation() - P_TIP
    np.testing.assert_allclose(moved, [0.0, 0.0, 5.0 / 1000.0], atol=2e-5)


def test_reference_acceleration_is_followed_without_lag():
    # A quintic over 40 mm with its acceleration: only the 1 ms hold is left. Without
    # a_d the tip would be behind by Lambda a/K, 4 kg 0.9 m/s2/(1000 N/m) = 4 mm.
    loop = Loop()
    worst = 0.0
    for k in range(500):
        s = k / 500.0
        p = P_TIP + [0.0, 0.0, 0.04 * (10 * s**3 - 15 * s**4 + 6 * s**5)]
        v = [0.0, 0.0, 0.04 / 0.5 * (30 * s**2 - 60 * s**3 + 30 * s**4)]
        a = [0.0, 0.0, 0.04 / 0.25 * (60 * s - 180 * s**2 + 120 * s**3)]
        loop.set(reference(p, v, a))
        error = loop.pose().translation() - p
        worst = max(worst, np.linalg.norm(error))
        loop.run(0.001)
    assert worst < 5e-4


def test_finger_stays_upright_while_the_tip_circles():
    loop = Loop()
    worst, rate = 0.0, 2.0 * np.pi / 3.0
    for k in range(800):
        t = 0.004 * k
        s = min(t / 0.8, 1.0)
        radius = 0.12 * (10 * s**3 - 15 * s**4 + 6 * s**5)
        spoke = np.array([np.cos(rate * t), np.sin(rate * t), 0.0])
        along = np.array([-spoke[1], spoke[0], 0.0])
        p, v = P_TIP + radius * spoke, radius * rate * along
        loop.set(reference(p, v, -radius * rate**2 * spoke))
        loop.run(0.004)
        up = loop.pose().rotation().matrix()[2, 2]
        worst = max(worst, np.degrees(np.arccos(min(up, 1.0))))
    assert worst < 3.0


def test_spring_and_damper_push_no_harder_than_force_max(law, chain):
    """At rest, far from the reference: the torque is that of force_max towards it."""
    q, still = law.q_nominal, np.zeros(7)
    s = chain_state(chain, q, still)
    away = np.array([0.3, -0.2, 0.6])
    limited = law._replace(force_max=15.0)
    args = (q, still, q, reference(s.p_WE + away), s.R_WE, law.stiffness, law.damping)
    tau, _ = impedance_torque(chain, limited, *args, 0.0, np.zeros(6), *unused())
    free, _ = impedance_torque(
        chain, limited, q, still, q, reference(s.p_WE), s.R_WE, law.stiffness,
        law.damping, 0.0, np.zeros(6), *unused(),
    )  # fmt: skip
    expected = s.J[:3].T @ (15.0 * away / np.linalg.norm(away))
    np.testing.assert_allclose(tau - free, expected, atol=1e-9)


def test_full_pose_is_reached_when_orientation_is_controlled():
    # The slowest part takes 15/50 s, so 3 s leave e^-10 of 0.36 rad.
    loop = Loop(
        ImpedanceConfig(
            control_orientation=True, damping=[200.0] * 3 + [15.0] * 3, offset_sec=5e-4
        )
    )
    turned = RotationMatrix.MakeXRotation(0.2) @ RotationMatrix.MakeZRotation(0.3)
    wxyz = turned.ToQuaternion().wxyz()
    loop.set(reference([0.52, 0.03, 0.12], quaternion=wxyz))
    loop.run(3.0)
    X = loop.pose()
    np.testing.assert_allclose(X.translation(), [0.52, 0.03, 0.12], atol=1e-4)
    np.testing.assert_allclose(X.rotation().matrix(), turned.matrix(), atol=1e-3)


def test_a_restored_context_replays_bit_for_bit():
    loop = Loop(ball=(0.5, 0.0))
    loop.set(reference([0.5, 0.02, 0.08]))  # Presses on the ball's side.
    loop.run(0.2)
    saved = loop.root.Clone()
    loop.run(0.2)
    first = (loop.tau(), loop.plant.GetPositions(loop.plant_context))
    again = Simulator(loop.simulator.get_system(), saved)
    again.AdvanceTo(0.4)
    context = loop.controller.GetMyContextFromRoot(saved)
    np.testing.assert_array_equal(
        loop.controller.GetOutputPort("tau").Eval(context), first[0]
    )
    q = loop.plant.GetPositions(loop.plant.GetMyContextFromRoot(saved))
    np.testing.assert_array_equal(q, first[1])


def test_the_default_torque_carries_the_arm(plant, chain):
    controller = ImpedanceController(ImpedanceConfig(), plant)
    tau = controller.GetOutputPort("tau").Eval(controller.CreateDefaultContext())
    context = plant.CreateDefaultContext()
    expected = -plant.CalcGravityGeneralizedForces(context)
    np.testing.assert_allclose(tau, expected, atol=1e-12)


def test_a_delay_bounds_the_damping_of_the_tips_position(plant, chain):
    config = ImpedanceConfig()
    q = plant.GetPositions(plant.CreateDefaultContext())
    at_rest = chain_state(chain, q, np.zeros(7))
    mobility = at_rest.J[:3] @ np.linalg.solve(at_rest.M, at_rest.J[:3].T)
    delay = 0.02
    bound = DELAY_DAMPING_MAX / np.diag(mobility) / delay
    assert np.all(bound < config.damping[:3])

    def torque(**ports):
        controller = ImpedanceController(config, plant)
        context = controller.CreateDefaultContext()
        values = {"q": q, "v": np.full(7, 0.03), "x_desired": reference()} | ports
        for name, value in values.items():
            controller.GetInputPort(name).FixValue(context, np.array(value))
        Simulator(controller, context).AdvanceTo(0.2)
        return controller.GetOutputPort("tau").Eval(context)

    bounded = torque(damping=[*bound, *config.damping[3:]])
    np.testing.assert_allclose(torque(delay=[delay]), bounded, rtol=1e-9)
    # A delay of one period is that of every tick.
    np.testing.assert_array_equal(torque(delay=[0.001]), torque())
    assert np.max(abs(bounded - torque())) > 0.1


@pytest.mark.parametrize("control_orientation", [False, True])
def test_a_tip_that_no_joint_moves_is_no_error(control_orientation):
    """One joint whose axis goes through the tip: only its own weight is carried."""
    arm = MultibodyPlant(0.0)
    inertia = SpatialInertia.SolidBoxWithMass(2.0, 0.1, 0.2, 0.3)
    link = arm.AddRigidBody("link", inertia)
    arm.mutable_gravity_field().set_gravity_vector([0.0, -9.81, 0.0])
    side = arm.AddFrame(
        FixedOffsetFrame("side", link.body_frame(), RigidTransform([0.1, 0.0, 0.0]))
    )
    joint = arm.AddJoint(RevoluteJoint("joint", arm.world_frame(), side, [0, 0, 1]))
    arm.AddJointActuator("motor", joint, 50.0)
    arm.AddFrame(FixedOffsetFrame("tip", side, RigidTransform([0.0, 0.0, 0.2])))
    arm.Finalize()
    config = ImpedanceConfig(
        stiffness=[100.0] * 3 + [0.0] * 3,
        damping=[10.0] * 3 + [0.0] * 3,
        control_orientation=control_orientation,
    )
    controller = ImpedanceController(config, arm)
    context = controller.CreateDefaultContext()
    q, at = np.array([0.7]), arm.CreateDefaultContext()
    arm.SetPositions(at, q)
    pose = arm.GetFrameByName("tip").CalcPoseInWorld(at)
    wxyz = pose.rotation().ToQuaternion().wxyz()
    x_d = reference(pose.translation() + [0.0, 0.1, 0.0], quaternion=wxyz)
    for name, value in {"q": q, "v": np.zeros(1), "x_desired": x_d}.items():
        controller.GetInputPort(name).FixValue(context, value)
    Simulator(controller, context).AdvanceTo(0.1)
    tau = controller.GetOutputPort("tau").Eval(context)
    expected = -arm.CalcGravityGeneralizedForces(at)
    assert abs(expected) > 0.1
    np.testing.assert_allclose(tau, expected, atol=1e-9)


# Refusals.


@pytest.mark.parametrize(
    "change, words",
    [
        ({"stiffness": [1.0] * 5}, "stiffness is .* expected 6 numbers"),
        ({"damping": [-1.0] * 6}, "damping is .* expected 6 numbers"),
        ({"stiffness": [np.nan] * 6}, r"stiffness\[0\] is nan, expected a number"),
        ({"posture": PostureConfig(-1.0)}, "posture.stiffness is -1.0"),
        ({"period_sec": 0.0}, "period_sec is 0.0, expected a positive time"),
    ],
)
def test_bad_configs_are_refused(plant, change, words):
    with pytest.raises(ValueError, match=words):
        ImpedanceController(ImpedanceConfig(**change), plant)


def test_plants_that_are_no_arm_are_refused(plant):
    with pytest.raises(ValueError, match="no frame 'tap'"):
        ImpedanceController(ImpedanceConfig(), plant, "tap")
    ball = MultibodyPlant(0.0)
    Parser(ball).AddModels(str(MODELS / "ball.sdf"))
    ball.Finalize()
    with pytest.raises(ValueError, match="is quaternion_floating"):
        ImpedanceController(ImpedanceConfig(), ball, "ball")
    with pytest.raises(ValueError, match="torque_rate_max is 0"):
        ImpedanceController(ImpedanceConfig(), plant, torque_rate_max=0.0)


# An arm without a spare joint: six joints, the full pose as its task.


def six_joint_arm(time_step):
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    rod = SpatialInertia.SolidCylinderWithMassAboutEnd(1.0, 0.05, 0.2, [0, 0, 1])
    X, end = RigidTransform(), plant.world_frame()
    for i, angle in enumerate([0.3, 0.6, 0.9, 0.2, 0.7, 0.1]):
        base = plant.AddFrame(FixedOffsetFrame(f"base{i}", end, X))
        link = plant.AddRigidBody(f"link{i}", rod).body_frame()
        axis = np.eye(3)[[2, 1, 1, 2, 1, 2][i]]
        joint = plant.AddJoint(RevoluteJoint(f"joint{i}", base, link, axis))
        joint.set_default_angle(angle)
        plant.AddJointActuator(f"motor{i}", joint, effort_limit=80.0)
        X, end = RigidTransform([0, 0, 0.2]), link
    plant.AddFrame(FixedOffsetFrame("tip", end, X))
    plant.Finalize()
    return builder, plant


SOFT = dict(stiffness=[200.0] * 3 + [5.0] * 3, damping=[40.0] * 3 + [1.0] * 3)


@pytest.mark.parametrize(
    ("gains", "move", "reachable"),
    [
        # The elbow is 0.9 rad bent and would be 0.34 at the first goal: one that is
        # passed by a little stretches the arm.
        ({}, [0.05, 0.0, 0.0], True),
        (SOFT, [0.05, 0.0, 0.0], True),
        (SOFT, [0.0, 0.0, 0.05], True),
        ({}, [0.2, 0.0, 0.0], False),
        (SOFT, [0.2, 0.0, 0.0], False),
    ],
)
def test_a_six_joint_arm_holds_its_pose_through_stretched_ones(gains, move, reachable):
    config = ImpedanceConfig(**gains, control_orientation=True)
    builder, plant = six_joint_arm(0.001)
    arm = builder.AddSystem(ImpedanceController(config, six_joint_arm(0.0)[1]))
    tip = plant.GetFrameByName("tip")
    X_0 = tip.CalcPoseInWorld(plant.CreateDefaultContext())
    goal = reference(X_0.translation() + move, (0, 0, 0), (0, 0, 0))
    goal[3:7] = X_0.rotation().ToQuaternion().wxyz()
    sources = [
        (builder.AddSystem(ConstantVectorSource(goal)).get_output_port(), "x_desired")
    ]
    split = builder.AddSystem(Demultiplexer([6, 6]))
    builder.Connect(plant.get_state_output_port(), split.get_input_port())
    sources += [(split.get_output_port(0), "q"), (split.get_output_port(1), "v")]
    for port, name in sources:
        builder.Connect(port, arm.GetInputPort(name))
    builder.Connect(arm.GetOutputPort("tau"), plant.get_actuation_input_port())
    simulator = Simulator(builder.Build())
    context, fastest = plant.GetMyContextFromRoot(simulator.get_context()), 0.0
    for k in range(1, 61):
        simulator.AdvanceTo(0.05 * k)
        fastest = max(fastest, abs(plant.GetVelocities(context)).max())
    # Thrown about it turned at 200 rad/s and more, and ended in NaN.
    assert fastest < 20.0
    X = tip.CalcPoseInWorld(context)
    reached = np.linalg.norm(X.translation() - X_0.translation() - move)
    turned = rotation_error(X_0.rotation().matrix(), X.rotation().matrix())
    if reachable:
        # Damping ratios near one: e^-(K/D t) of 5 cm is left after 3 s, and friction
        # is none.
        assert reached < 0.003 and np.linalg.norm(turned) < 0.05
    else:  # Stretched towards it, and nearly at rest.
        assert 0.02 < reached < 0.1
        assert abs(plant.GetVelocities(context)).max() < 3.0

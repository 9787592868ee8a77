from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from makebreak.diagrams.station import make_control_plant
from makebreak.systems.arm.impedance_controller import (
    ImpedanceConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.arm.numerics.impedance_controller import (
    memory_size,
    tick,
)
from makebreak.systems.arm.numerics.joint_limits import (
    FREE_SHARE,
    GAIN,
    JOINT_BRAKED,
    OVERSPEED,
    RANGE_MARGIN,
    RANGE_RATE,
    SPEED_SHARE,
    STOP_RATE,
    braked,
    is_free,
    own_brakes,
    speed_bounds,
    within_limits,
)
from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.serial_chain import chain_state
from makebreak.systems.numerics.first_calls import deferred

TICK = ImpedanceConfig().period_sec


@pytest.fixture(scope="module", autouse=True)
def _arm():
    """Made here, as nothing is to be compiled while tests are collected."""
    global CHAIN, PACKED_CHAIN, LAW, NO_LIMITS, V
    plant = make_control_plant()
    CHAIN = serial_chain_of(plant, "tip")
    PACKED_CHAIN = packed(CHAIN)
    with deferred():
        LAW = ImpedanceController(ImpedanceConfig(), plant)._law
    infinite = {"q_lower": np.full(7, -99.0), "q_upper": np.full(7, 99.0)}
    NO_LIMITS = LAW._replace(speed_max=np.full(7, np.inf), **infinite)
    V = SPEED_SHARE * LAW.speed_max


def one_joint(mass, effort, rate, q_upper=99.0):
    """A law and mass matrix of one joint, with a speed limit of 2 rad/s."""
    one = {"effort_max": effort, "step_max": rate * TICK, "speed_max": 2.0}
    one |= {"q_lower": -99.0, "q_upper": q_upper}
    law = LAW._replace(**{name: np.array([value]) for name, value in one.items()})
    return law, np.array([[mass]])


def pushed(law, M, seconds):
    """q and v of one joint that always gets its full torque, if it is not braked."""
    q, v, tau, rows = np.zeros(1), np.zeros(1), np.zeros(1), []
    for _ in range(round(seconds / TICK)):
        before = tau
        tau, _ = within_limits(law, tau, law.effort_max)
        if not is_free(law, q, v):
            tau, _ = braked(law, before, tau, q, v, M, np.zeros(1), 0.0)
        assert abs(tau - before) <= law.step_max + 1e-12
        assert abs(tau) <= law.effort_max
        v = v + TICK * tau / M[0]
        q = q + TICK * v
        rows.append((q[0], v[0]))
    return np.array(rows).T


@pytest.mark.parametrize("mass, effort", [(0.2, 12.0), (1.0, 12.0), (0.7, 87.0)])
def test_a_joint_that_is_pushed_on_reaches_its_bound_and_stays_there(mass, effort):
    _, v = pushed(*one_joint(mass, effort, 1000.0), 2.0)
    assert v.max() <= 1.6 * 1.01  # 1.6: SPEED_SHARE of 2. One tick adds 1 %.
    np.testing.assert_allclose(v[-1], 1.6, rtol=1e-3)


def test_a_joint_that_is_pushed_to_its_stop_comes_to_rest_before_it():
    q, v = pushed(*one_joint(0.7, 87.0, 1000.0, q_upper=2.0), 4.0)
    assert q.max() <= 2.0 - RANGE_MARGIN + 1e-4
    # From the margin's end on the distance shrinks by exp(-RANGE_RATE t).
    late = slice(-1000, -500)
    slope = np.polyfit(TICK * np.arange(500), np.log(2.0 - RANGE_MARGIN - q[late]), 1)
    np.testing.assert_allclose(slope[0], -RANGE_RATE, rtol=0.15)
    assert abs(v[-1]) < 1e-6


@given(st.integers(0, 2**32 - 1))
def test_the_brakes_are_those_of_the_complementarity_problem(seed):
    rng = np.random.default_rng(seed)
    q, v = LAW.q_nominal, V * rng.uniform(-1.2, 1.2, 7)
    s = chain_state(CHAIN, q, v)
    mobility = np.linalg.inv(s.M)
    asked = rng.normal(0.0, 100.0, 7)
    brake = own_brakes(LAW, asked, q, v, mobility, GAIN)
    qdd = asked + mobility @ brake
    for i in range(7):
        low, high = speed_bounds(LAW, q, i)
        side = 1.0 if v[i] > 0.0 else -1.0
        room = max(high, -low) - abs(v[i])  # The nominal arm is far from its ranges.
        jerk = 1000.0 * mobility[i, i]
        bound = GAIN * room if room < 0.0 else min(GAIN * room, np.sqrt(jerk * room))
        if abs(v[i]) > FREE_SHARE * high:
            slack = bound - side * qdd[i]
            assert slack > -1e-3 and side * brake[i] <= 0.0
            assert abs(brake[i] * slack) < 1e-2
        else:
            assert brake[i] == 0.0


def arm_run(law, reference, seconds, rng, motor=None, push=None):
    """Speeds and positions (rows, 7) of an arm that follows reference(t), and its
    torques. Args: motor(tau): what the motors give; push(t) (7,): on the joints."""
    PACKED_LAW = packed(law)
    q, v = LAW.q_nominal.copy(), np.zeros(7)
    tau = chain_state(CHAIN, q, v).bias
    memory = np.zeros(memory_size(7))
    rows = []
    for k in range(round(seconds / TICK)):
        read_q, read_v = q + 1e-5 * rng.normal(size=7), v + 1e-3 * rng.normal(size=7)
        x_d = np.zeros(19)
        x_d[:3], x_d[3] = reference(k * TICK), 1.0
        status = tick(
            PACKED_CHAIN, PACKED_LAW, tau, memory, read_q, read_v, x_d, law.stiffness,
            law.damping, 0.0, np.zeros(6), np.zeros(6), np.zeros(2), np.zeros(6), 0.0,
        )  # fmt: skip
        s = chain_state(CHAIN, q, v)
        given = tau if motor is None else motor(tau)
        given = given if push is None else given + push(k * TICK)
        v = v + TICK * np.linalg.solve(s.M, given - s.bias)
        q = q + TICK * v
        rows.append((v, q, tau.copy(), int(status)))
    return tuple(np.array(each) for each in zip(*rows, strict=True))


def jumps(rng, size):
    """A reference that jumps to random places within `size` [m], faster than the arm
    can follow."""
    places = [0.4, 0.0, 0.3] + size * rng.uniform(-1.0, 1.0, (20, 3))
    every = rng.uniform(0.1, 0.6)
    return lambda t: places[int(t / every) % 20]


def beyond(q):
    return np.maximum(q - LAW.q_upper, LAW.q_lower - q).max()


@pytest.mark.parametrize("seed", [0, 1, 2, 1010])
def test_an_arm_keeps_its_speeds_ranges_torques_whatever_the_reference(seed):
    rng = np.random.default_rng(seed)
    v, q, tau, _ = arm_run(LAW, jumps(rng, 0.3), 1.5, rng)
    assert (abs(v) <= LAW.speed_max).all()
    assert beyond(q) < 0.0
    assert (abs(tau) <= LAW.effort_max).all()
    assert (abs(np.diff(tau, axis=0)) <= LAW.step_max + 1e-12).all()


def test_without_the_barrier_the_same_references_break_the_limits():
    rng = np.random.default_rng(0)
    v, _, _, _ = arm_run(NO_LIMITS, jumps(rng, 0.3), 1.5, rng)
    assert (abs(v) / LAW.speed_max).max() > 1.5


@pytest.mark.parametrize("joint", range(7))
def test_an_arm_with_a_weak_joint_keeps_the_speeds_of_all(joint):
    """A third of the torque: the wrong model of the motors, which the brake does not
    know. The weak joint still carries the arm here, but cannot brake it as asked."""
    rng = np.random.default_rng(joint)
    weak = LAW.effort_max.copy()
    weak[joint] /= 3.0
    v, _, tau, _ = arm_run(
        LAW, jumps(rng, 0.2), 1.0, rng, motor=lambda tau: np.clip(tau, -weak, weak)
    )
    assert (abs(v) <= LAW.speed_max).all()
    assert (abs(np.diff(tau, axis=0)) <= LAW.step_max + 1e-12).all()


@pytest.mark.parametrize("seed", [1006, 1009])
def test_an_arm_that_is_pushed_keeps_its_speeds_and_ranges(seed):
    rng = np.random.default_rng(seed)
    reference = jumps(rng, 0.5)
    force = rng.uniform(-1.0, 1.0, 7) * [10.0, 10.0, 8.0, 8.0, 2.0, 2.0, 2.0]  # [N m]
    v, q, _, _ = arm_run(
        LAW, reference, 2.0, rng, push=lambda t: force * (int(t / 0.3) % 2)
    )
    assert (abs(v) <= LAW.speed_max).all()
    assert beyond(q) < 0.0


def test_a_joint_that_is_driven_too_fast_against_its_motor_stops_all_motors():
    """Joint 6 brakes with all its torque, but something drives it on."""
    q, v = LAW.q_nominal.copy(), np.zeros(7)
    v[5] = -(1.0 + 0.5 * OVERSPEED) * V[5]
    s = chain_state(CHAIN, q, v)
    before = s.bias + [0.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0]
    before[5] = LAW.effort_max[5]
    asked = before + [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    tau, status = braked(LAW, before, asked, q, v, s.M, s.bias, 0.0)
    stop = np.clip(s.bias - STOP_RATE * s.M @ v, -LAW.effort_max, LAW.effort_max)
    step = (stop - before) / np.abs((stop - before) / LAW.step_max).max()
    assert status & JOINT_BRAKED
    np.testing.assert_allclose(tau, asked + 0.5 * (before + step - asked), atol=1e-9)


def test_a_joint_at_the_end_of_its_range_does_not_stop_the_others():
    q, v = LAW.q_nominal.copy(), np.zeros(7)
    q[3] = LAW.q_lower[3] + RANGE_MARGIN - 5e-4
    s = chain_state(CHAIN, q, v)
    qdd = np.array([0.5, 0.5, 0.5, -0.1, 0.5, 0.5, 0.5])  # Joint 4 outwards.
    asked = s.bias + s.M @ qdd
    tau, status = braked(LAW, asked, asked, q, v, s.M, s.bias, 0.0)
    assert status & JOINT_BRAKED
    np.testing.assert_array_equal(np.delete(tau, 3), np.delete(asked, 3))
    back = GAIN * RANGE_RATE * 5e-4
    assert np.linalg.solve(s.M, tau - s.bias)[3] == pytest.approx(back, rel=1e-6)


def test_below_half_of_the_bounds_the_torque_is_untouched_bit_for_bit():
    def around(t):
        return [0.5 + 0.1 * np.cos(t), 0.1 * np.sin(t), 0.15]

    runs = [
        arm_run(law, around, 1.0, np.random.default_rng(1)) for law in (LAW, NO_LIMITS)
    ]
    for with_limits, without in zip(*runs, strict=True):
        np.testing.assert_array_equal(with_limits, without)
    assert (abs(runs[0][0]) < FREE_SHARE * V).all()
    assert not (runs[0][3] & JOINT_BRAKED).any()


def test_bounds_of_the_speed_shrink_to_zero_at_the_margin_of_the_range():
    for i, side in product(range(7), (0, 1)):
        q = LAW.q_nominal.copy()
        end = (LAW.q_lower, LAW.q_upper)[side][i]
        inwards = (1.0, -1.0)[side]
        q[i] = end + inwards * RANGE_MARGIN
        assert speed_bounds(LAW, q, i)[side] == pytest.approx(0.0, abs=1e-12)
        q[i] = end + inwards * (RANGE_MARGIN + 0.05)
        assert speed_bounds(LAW, q, i)[side] == pytest.approx(
            -inwards * 0.05 * RANGE_RATE
        )
        q[i] = end + inwards * 0.5
        assert abs(speed_bounds(LAW, q, i)[side]) == pytest.approx(V[i])

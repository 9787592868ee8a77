import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

from makebreak.systems.arm_reference import ArmReference, ArmReferenceConfig
from makebreak.systems.numerics.arm_reference import approach, clip_norm, ticks_left
from makebreak.systems.numerics.lcs import LCS
from makebreak.systems.numerics.rolling_task import REPOSITION, ROLL


def test_ticks_left_counts_down_to_the_next_command():
    # Commands every 12.5 ms from 0.3 ms on, ticks every 1 ms from 0.5 ms on: 13 and 12
    # ticks fall between two commands in turn.
    left = [ticks_left(0.5e-3 + k * 1e-3, 0.0125, 0.3e-3, 1e-3) for k in range(26)]
    assert left == [13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1,
                    12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 13]  # fmt: skip


def test_approach_arrives_on_the_last_tick_along_a_straight_line():
    value, target = np.array([1.0, -2.0, 0.5]), np.array([2.0, 2.0, 2.0])
    start, steps = value, []
    for n_left in range(12, 0, -1):
        new = approach(value, target, n_left, np.inf)
        steps.append(new - value)
        value = new
    np.testing.assert_allclose(value, target, atol=1e-15)
    np.testing.assert_allclose(steps, [(target - start) / 12] * 12, atol=1e-14)


def test_steps_and_norms_are_bounded():
    step = approach(np.zeros(3), np.array([3.0, 4.0, 0.0]), 1, 0.5)
    np.testing.assert_allclose(step, [0.3, 0.4, 0.0], atol=1e-15)
    np.testing.assert_allclose(clip_norm(np.array([0.0, 6.0, 8.0]), 5.0), [0, 3, 4])
    np.testing.assert_allclose(clip_norm(np.array([0.0, 0.3]), 5.0), [0.0, 0.3])


def one_force_lcs(tip_mass):
    """One contact force that pushes the tip up; the state is the rolling task's."""
    D = np.zeros((19, 1))
    D[12] = 0.0125 / tip_mass
    zero, one = np.zeros((1, 19)), np.eye(1)
    return LCS(
        np.eye(19), np.zeros((19, 3)), D, np.zeros(19), zero, one, np.zeros((1, 3)),
        [0.0], 0.0125,
    )  # fmt: skip


def run(phase, x_next, lam, t_end=0.0125):
    builder = DiagramBuilder()
    lcs = one_force_lcs(2.0)
    config = ArmReferenceConfig(tip_mass=2.0, offset_sec=1e-4)
    arm = builder.AddNamedSystem("arm", ArmReference(config, 1, np.zeros(3), lcs))
    reference = np.arange(9.0)
    for name, value in dict(
        phase=[phase], reference=reference, x_next=x_next, lam=lam
    ).items():
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), arm.GetInputPort(name))
    source = builder.AddSystem(ConstantValueSource(AbstractValue.Make(lcs)))
    builder.Connect(source.get_output_port(), arm.GetInputPort("lcs"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(t_end)
    context = arm.GetMyContextFromRoot(simulator.get_context())
    return [arm.GetOutputPort(n).Eval(context) for n in ("x_desired", "wrench")]


def test_rolling_goes_to_x_next_and_pushes_against_the_planned_contact_force():
    x_next = np.zeros(19)
    x_next[0:3], x_next[10:13] = [0.001, 0.0, 0.002], [0.01, 0.0, 0.0]
    pose, wrench = run(ROLL, x_next, [1.5])
    np.testing.assert_allclose(pose[0:3], [0.001, 0.0, 0.002], atol=1e-15)
    np.testing.assert_allclose(pose[7:10], [0.01, 0.0, 0.0], atol=1e-15)
    # lam pushes the tip up with 1.5 N; the arm has to push down with as much.
    np.testing.assert_allclose(wrench, [0, 0, -1.5, 0, 0, 0], atol=1e-13)


def test_feed_forward_and_the_slope_of_the_velocity_are_bounded():
    x_next = np.zeros(19)
    x_next[10:13] = [5.0, 0.0, 0.0]
    pose, wrench = run(ROLL, x_next, [1e3])
    assert np.linalg.norm(wrench) <= 3.0 + 1e-12
    assert 0.0 < pose[7] <= 13 * 1.5 * 1e-3 + 1e-12  # 13 ticks of 1.5 m/s2.


def test_reposition_follows_the_task_and_pushes_nothing():
    pose, wrench = run(REPOSITION, np.ones(19), [1.5])
    np.testing.assert_allclose(pose[[0, 1, 2, 7, 8, 9, 13, 14, 15]], range(9))
    np.testing.assert_allclose(wrench, 0.0)


def test_nan_from_the_planner_leaves_the_reference_where_it_was():
    pose, wrench = run(ROLL, np.full(19, np.nan), [1.0])
    np.testing.assert_allclose(pose, np.eye(19)[3])
    np.testing.assert_allclose(wrench, 0.0)

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

from makebreak.systems.arm.arm_reference import ArmReference, ArmReferenceConfig
from makebreak.systems.arm.numerics.arm_reference import (
    clip_norm,
    next_end,
    no_nearer,
    on_the_line,
)
from makebreak.systems.contact_mpc.numerics.ball_state import (
    P_BALL,
    P_TIP,
    V_BALL,
    V_TIP,
)
from makebreak.systems.contact_mpc.numerics.lcs import LCS
from makebreak.systems.contact_mpc.numerics.rolling_task import REPOSITION, ROLL


def test_line_is_straight_and_stays_at_its_end():
    rng = np.random.default_rng(0)
    start, end = rng.normal(size=(2, 12))
    line = np.concatenate([start, end, [3.0]])
    for t, share in ((2.9, 0.0), (3.0, 0.0), (3.1, 0.25), (3.4, 1.0), (3.5, 1.0)):
        expected = (1 - share) * start + share * end
        # 3.1 - 3.0 is 0.1 to 1e-16 / 0.4 of a line of length 2.
        np.testing.assert_allclose(on_the_line(line, t, 0.4), expected, atol=1e-14)


def test_norms_and_the_change_of_velocity_are_bounded():
    np.testing.assert_allclose(clip_norm(np.array([0.0, 6.0, 8.0]), 5.0), [0, 3, 4])
    np.testing.assert_allclose(clip_norm(np.array([0.0, 0.3]), 5.0), [0.0, 0.3])
    target = np.array([0, 0, 0.2, 3, 4, 0, 0, 0.1, 0, 1, 2, 3], dtype=float)
    end = next_end(np.zeros(12), target, 1.0, 9.0, 0.5, 1.0)
    np.testing.assert_allclose(end[3:6], [0.3, 0.4, 0.0], atol=1e-15)
    np.testing.assert_allclose(np.delete(end, [3, 4, 5]), np.delete(target, [3, 4, 5]))


@pytest.mark.parametrize("size", [1.0, 1e3, 1e200, 1e308])
def test_position_velocity_and_acceleration_of_a_line_are_bounded(size):
    start = np.array([0.4, 0.1, 0.2, 0.03, 0, 0, 0, 0, 0, 0, 0, 0])
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    target = np.concatenate([size * direction] * 3 + [np.zeros(3)])
    end = next_end(start, target, 0.01, 0.5, np.inf, 0.7)
    way = target[:3] - start[:3]
    way /= abs(way).max()  # At once, its square would overflow.
    expected = start[:3] + 0.01 * way / np.linalg.norm(way)
    np.testing.assert_allclose(end[:3], expected, atol=1e-15)
    np.testing.assert_allclose(end[3:6], 0.5 * direction, atol=1e-15)
    np.testing.assert_allclose(end[6:9], 0.7 * direction, atol=1e-15)


def one_force_lcs(tip_mass):
    """One contact force that pushes the tip up; the state is the rolling task's."""
    D = np.zeros((19, 1))
    D[12] = 0.0125 / tip_mass
    zero, one = np.zeros((1, 19)), np.eye(1)
    return LCS(
        np.eye(19), np.zeros((19, 3)), D, np.zeros(19), zero, one, np.zeros((1, 3)),
        [0.0], 0.0125,
    )  # fmt: skip


# Slow enough for no bound of the reference to be met.
REFERENCE = np.array([1, 2, 3, 40, 50, 60, 700, 800, 900]) * 1e-3


def settings_of(**flat):
    """follow_hard is follow.hard, force_max is limits.force_max."""
    made = ArmReferenceConfig()
    for key, value in flat.items():
        group, _, name = key.partition("_")
        if hasattr(made.limits, key):
            setattr(made.limits, key, value)
        elif group in ("follow", "touch"):
            setattr(getattr(made, group), name, value)
        else:
            setattr(made, key, value)
    return made


def run(
    phase,
    x_next,
    lam,
    t_end=0.0126,
    status=0.0,
    reference=REFERENCE,
    tip_force=None,
    feel=1.0,
    height=None,
    p_tip=(0.0, 0.0, 0.0),
    touch=None,
    **config,
):
    builder = DiagramBuilder()
    lcs = one_force_lcs(2.0)
    settings = settings_of(tip_mass=2.0, height=height, **config)
    arm = builder.AddNamedSystem("arm", ArmReference(settings, 1, np.array(p_tip), lcs))
    for name, value in dict(
        phase=[phase], reference=reference, x_next=x_next, lam=lam, status=[status]
    ).items():
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), arm.GetInputPort(name))
    if tip_force is not None:
        source = builder.AddSystem(ConstantVectorSource([0.0, 0.0, tip_force]))
        builder.Connect(source.get_output_port(), arm.GetInputPort("tip_force"))
        source = builder.AddSystem(ConstantVectorSource([feel]))
        builder.Connect(source.get_output_port(), arm.GetInputPort("feel"))
    if touch is not None:
        source = builder.AddSystem(ConstantVectorSource([touch]))
        builder.Connect(source.get_output_port(), arm.GetInputPort("touch_speed"))
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
    # At 12.5 ms a period of 1.5 m/s2 is over, and 0.1 ms of the next.
    np.testing.assert_allclose(pose[7], 1.5 * 0.0126, atol=1e-12)


def test_a_held_height_leaves_what_is_across_the_table():
    x_next = np.zeros(19)
    x_next[0:3], x_next[10:13] = [0.001, 0.0, -0.005], [0.01, 0.0, -0.03]
    pose, wrench = run(ROLL, x_next, [1.5], height=0.003)
    np.testing.assert_allclose(pose[0:3], [0.001, 0.0, 0.003], atol=1e-15)
    np.testing.assert_allclose(pose[7:10], [0.01, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(wrench, 0.0)  # This contact pushes up alone.


@pytest.mark.parametrize("bearing", [0.0, 0.8, 3.0])
def test_a_pushing_tip_comes_no_nearer_to_the_arm_than_it_may(bearing):
    out = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    along = np.array([-out[1], out[0], 0.0])
    start = 0.402 * out
    x_next = np.zeros(19)
    x_next[0:3], x_next[10:13] = start - 4e-3 * out, -0.01 * out + 0.01 * along
    free = run(ROLL, x_next, [0.0], p_tip=start)[0]
    pose, wrench = run(ROLL, x_next, [0.0], p_tip=start, nearest=0.4)
    np.testing.assert_allclose(np.hypot(*free[:2]), 0.398, atol=1e-6)
    np.testing.assert_allclose(np.hypot(*pose[:2]), 0.4, atol=1e-6)
    np.testing.assert_allclose(pose[7:10], 0.01 * along, atol=1e-9)
    # Outwards, and along the table where it is far enough, it goes as C3 says.
    x_next[0:3], x_next[10:13] = start + 4e-3 * out, 0.01 * out
    for nearest in (0.0, 0.4):
        pose, _ = run(ROLL, x_next, [0.0], p_tip=start, nearest=nearest)
        np.testing.assert_allclose(pose[:3], start + 4e-3 * out, atol=1e-9)


def test_a_tip_that_may_come_no_nearer_pushes_only_outwards_and_along():
    p, v, force = np.array([0.3, 0.0, 0.02]), np.ones(3), np.array([-5.0, 2.0, 1.0])
    p, v, force = no_nearer(p, v, force, 0.4)
    np.testing.assert_allclose(p, [0.4, 0.0, 0.02])
    np.testing.assert_allclose(v, np.ones(3))
    np.testing.assert_allclose(force, [0.0, 2.0, 1.0])
    # What counts is where the wrist is: here straight below the tip's x, 0.1 m aside.
    p, v, _ = no_nearer(np.array([0.1, 0.4, 0.0]), -np.ones(3), force, 0.35, [0.1, 0.1])
    np.testing.assert_allclose(p, [0.1, 0.45, 0.0])
    np.testing.assert_allclose(v, [-1.0, 0.0, -1.0])


def test_half_a_period_later_the_reference_is_half_way():
    x_next = np.zeros(19)
    x_next[0] = 0.002
    pose, _ = run(ROLL, x_next, [0.0], t_end=0.00625)
    np.testing.assert_allclose(pose[0], 0.001, atol=1e-15)


def test_an_old_command_of_c3_is_not_followed():
    pose, wrench = run(ROLL, np.ones(19), [1.5], status=6.0)
    np.testing.assert_allclose(pose, np.eye(19)[3])
    np.testing.assert_allclose(wrench, 0.0)


def test_reposition_follows_the_task_and_pushes_nothing():
    pose, wrench = run(REPOSITION, np.ones(19), [1.5])
    np.testing.assert_allclose(pose[[0, 1, 2, 7, 8, 9, 13, 14, 15]], REFERENCE)
    np.testing.assert_allclose(wrench, 0.0)


@pytest.mark.parametrize("phase", [ROLL, REPOSITION])
@pytest.mark.parametrize("size", [1.0, 1e6, 1e300])
def test_an_absurd_command_moves_the_reference_no_faster_than_speed_max(phase, size):
    x_next, reference = np.full(19, size), np.full(9, size)
    c = ArmReferenceConfig()
    for t_end in (0.0126, 0.1251):
        pose, _ = run(phase, x_next, [0.0], t_end, reference=reference)
        # A period is 12.5 ms; the line that starts at t_end has gone 0.1 ms.
        assert np.linalg.norm(pose[:3]) <= c.limits.speed_max * t_end * (1.0 + 1e-9)
        assert np.linalg.norm(pose[7:10]) <= c.limits.speed_max * (1.0 + 1e-9)
        fed_forward = np.linalg.norm(pose[13:16])
        assert fed_forward <= c.limits.acceleration_fed_forward_max * (1.0 + 1e-9)
    assert (
        np.linalg.norm(pose[:3]) > 0.9 * c.limits.speed_max * 0.125
    )  # Not frozen either.


def test_a_command_that_becomes_nan_ends_motion_and_push():
    """A velocity that were kept would be a force on the arm, damping times it."""
    moving = np.array([0.1, 0, 0, 0.2, 0, 0, 1.0, 0, 0, 0, 0, -2.0])
    end = next_end(moving, np.full(12, np.nan), 1.0, 1.0, 1.0, 1.0)
    np.testing.assert_array_equal(end, [0.1, *np.zeros(11)])


def test_nan_from_the_planner_leaves_the_reference_where_it_was():
    pose, wrench = run(ROLL, np.full(19, np.nan), [1.0])
    np.testing.assert_allclose(pose, np.eye(19)[3])
    np.testing.assert_allclose(wrench, 0.0)


def test_while_rolling_the_reference_goes_down_slowly_and_up_as_it_is_told():
    x_next = np.zeros(19)
    for v_z, expected in ((-0.3, -ArmReferenceConfig().limits.down_max), (0.06, 0.06)):
        x_next[12] = v_z
        pose, _ = run(ROLL, x_next, [0.0], t_end=0.2)
        np.testing.assert_allclose(pose[9], expected, atol=1e-12)


def test_a_tip_that_has_lost_its_contact_goes_down_and_with_the_ball():
    x_next = np.zeros(19)
    x_next[0], x_next[10], x_next[16] = 3e-4, 0.012, 0.004  # p, v of tip; v of ball.
    found = {}
    for felt in (-1.0, 0.0, 0.5, 1.0, 3.0, None):
        x_desired, _ = run(ROLL, x_next, [2.0], 0.012499, tip_force=felt)
        found[felt] = x_desired[[0, 7, 9]]
    dt = 0.0125
    for felt, lost in ((-1.0, 1.0), (0.0, 1.0), (0.5, 0.5)):
        change = lost * (0.004 - 0.012)
        # The reference starts at rest, and changes by 1.5 m/s2 at most.
        v = clip_norm(np.array([0.012 + change, -lost * 0.015]), 1.5 * dt)
        expected = [3e-4 + change * dt, *v]
        # 1e-4 before the end of a line of at most 0.02 m/s.
        np.testing.assert_allclose(found[felt], expected, atol=2e-6)
    x_desired, _ = run(ROLL, x_next, [2.0], 0.012499, tip_force=0.0, feel=0.0)
    found["needs it not"] = x_desired[[0, 7, 9]]
    for felt in (1.0, 3.0, None, "needs it not"):  # In contact, or without a feeling.
        np.testing.assert_allclose(found[felt], [3e-4, 0.012, 0.0], atol=2e-6)


@pytest.mark.parametrize(("felt", "lost"), [(-1.0, 1.0), (0.5, 0.5), (3.0, 0.0)])
def test_a_tip_that_has_lost_a_hard_ball_goes_towards_it_and_pushes_on(felt, lost):
    """C3 has it climb over the ball; from 3 cm behind and 4 cm above."""
    x_next = np.zeros(19)
    x_next[P_TIP], x_next[P_BALL] = [1e-4, 0.0, 2e-4], [0.0301, 0.0, -0.0398]
    v_tip, v_ball = np.array([0.006, 0.002, 0.005]), np.array([0.002, 0.0, 0.0])
    x_next[V_TIP], x_next[V_BALL] = v_tip, v_ball
    x_desired, _ = run(
        ROLL, x_next, [0.0], 0.012499, tip_force=felt, follow_hard=True
    )  # fmt: skip
    n = np.array([-0.6, 0.0, 0.8])
    v = v_tip - lost * ((v_tip - v_ball) @ n + 0.015) * n
    np.testing.assert_allclose(x_desired[7:10], v, atol=3e-6)
    p = x_next[P_TIP] + 0.0125 * (v - v_tip)
    np.testing.assert_allclose(x_desired[:3], p, atol=3e-6)
    if lost == 1.0:
        assert (v - v_ball) @ n == pytest.approx(-0.015, abs=1e-12)


def test_a_tip_that_feels_nothing_yet_goes_slowly():
    """What it is to touch may be nearer than planned: it hits it no faster."""
    x_next = np.zeros(19)
    x_next[0:2], x_next[10:12] = [0.004, 0.003], [0.32, 0.24]
    found = {}
    for felt in (0.0, 0.9, -1.1, 2.0):
        x_desired, _ = run(
            ROLL, x_next, [2.0], 0.0999, tip_force=felt, feel=0.0, touch_speed=0.1
        )
        found[felt] = x_desired[[0, 1, 7, 8]]
    for felt in (0.0, 0.9):  # Where it is to go it is after 5 / 1.25 periods.
        np.testing.assert_allclose(found[felt], [4e-3, 3e-3, 0.08, 0.06], atol=1e-6)
    for felt in (-1.1, 2.0):  # 1.5 m/s2 for 8 periods.
        np.testing.assert_allclose(found[felt], [4e-3, 3e-3, 0.12, 0.09], atol=2e-4)
    early = {
        felt: run(
            ROLL, x_next, [2.0], 0.012499, tip_force=felt, feel=0.0, touch_speed=0.1
        )[0][:2]
        for felt in (0.0, 2.0)
    }
    np.testing.assert_allclose(early[0.0], [1e-3, 7.5e-4], atol=1e-6)  # 1.25 mm.
    np.testing.assert_allclose(early[2.0], [4e-3, 3e-3], atol=1e-6)


def test_a_tip_that_pushes_goes_no_faster_than_it_may():
    x_next = np.zeros(19)
    x_next[0:2], x_next[10:12] = [0.004, 0.003], [0.32, 0.24]
    both = dict(tip_force=5.0, feel=0.0, touch_speed=0.05)
    for settings, speed in (
        (dict(), 0.1),
        (both, 0.1),
        (both | dict(tip_force=0.0), 0.05),
    ):
        early, _ = run(ROLL, x_next, [0.0], 0.012499, push_speed=0.1, **settings)
        late, _ = run(ROLL, x_next, [0.0], 0.0999, push_speed=0.1, **settings)
        np.testing.assert_allclose(np.hypot(*early[:2]), speed * 0.0125, rtol=1e-3)
        np.testing.assert_allclose(np.hypot(*late[7:9]), speed, rtol=1e-3)


@pytest.mark.parametrize(
    ("touch", "setting", "felt", "speed"),
    [
        (0.05, np.inf, 0.0, 0.05), (0.05, 0.08, 0.0, 0.05), (0.09, 0.08, 0.0, 0.09),
        (np.nan, 0.08, 0.0, 0.08), (0.05, np.inf, 5.0, 0.1), (-1.0, np.inf, 0.0, 0.0),
    ],
)  # fmt: skip
def test_a_learned_speed_of_touching_holds_until_something_is_felt(
    touch, setting, felt, speed
):
    x_next = np.zeros(19)
    x_next[0:2], x_next[10:12] = [0.004, 0.003], [0.32, 0.24]
    settings = dict(tip_force=felt, feel=0.0, push_speed=0.1, touch_speed=setting)
    late, _ = run(ROLL, x_next, [0.0], 0.0999, touch=touch, **settings)
    np.testing.assert_allclose(np.hypot(*late[7:9]), speed, rtol=1e-3, atol=1e-9)


def test_what_cannot_be_followed_is_refused_by_name():
    with pytest.raises(ValueError, match="touch.speed is 0.3, expected at most limits"):
        ArmReference(
            settings_of(touch_speed=0.3, push_speed=0.2), 1, np.zeros(3),
            one_force_lcs(1.0),
        )  # fmt: skip
    with pytest.raises(ValueError, match="nearest is -0.1, expected at least 0"):
        ArmReference(settings_of(nearest=-0.1), 1, np.zeros(3), one_force_lcs(1.0))
    with pytest.raises(ValueError, match="touch.speed is 0.0, expected more"):
        ArmReference(settings_of(touch_speed=0.0), 1, np.zeros(3), one_force_lcs(1.0))
    with pytest.raises(ValueError, match="follow.force is 0.0, expected more"):
        ArmReference(settings_of(follow_force=0.0), 1, np.zeros(3), one_force_lcs(1.0))

"""A ball rolled along a circle without a hand-written cycle."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.diagrams.ball_rolling import make_ball_rolling
from makebreak.diagrams.ball_rolling_config import BallRollingConfig
from makebreak.diagrams.camera import CameraConfig
from makebreak.diagrams.gentle_rolling import GentleRollingConfig, ball_config
from makebreak.diagrams.sampled_contacts import (
    SampledContactsConfig,
    SampledPlannerConfig,
    ball_shape,
    beside,
    check_contacts,
    sampled_c3_config,
)
from makebreak.models.tip_and_ball import TipAndBall, make_tip_and_ball
from makebreak.scripts.experiments import ball_rolling as experiment
from makebreak.systems.arm.arm_reference import TouchConfig
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs, ContactPair
from makebreak.systems.contact_mpc.numerics.ball_state import (
    P_BALL,
    P_TIP,
    V_BALL,
    V_TIP,
    W_BALL,
    pack,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Problem, solve_c3
from makebreak.systems.contact_mpc.numerics.contact_sampling import (
    SamplingConfig,
    SamplingMemory,
    sample_round,
)
from makebreak.systems.contact_mpc.numerics.lcs import simulate
from makebreak.systems.contact_mpc.numerics.outline import (
    distance_to_outline,
    outline_of,
)
from makebreak.systems.contact_mpc.numerics.path_target import (
    moving_target,
    next_waypoint,
    push_direction,
)
from makebreak.systems.contact_mpc.numerics.push_task import (
    CONTACT,
    TRAVEL,
    WAIT,
    PushConfig,
    PushState,
    TravelConfig,
    next_push,
)
from makebreak.systems.contact_mpc.numerics.rolling_task import CircleConfig, CirclePath
from makebreak.systems.contact_mpc.numerics.tip_travel import way_around, way_is_free
from makebreak.systems.contact_mpc.path_target import PathTarget, PathTargetConfig
from makebreak.systems.contact_mpc.push_task import PushTask, PushTaskConfig
from makebreak.systems.contact_mpc.rolling_task import RollingTaskConfig

MODEL = TipAndBall(ball_radius=0.0315)
HEIGHT, R_BALL, R_TIP = 0.038, 0.0315, 0.0195
SHAPE = ball_shape(MODEL, HEIGHT)
PATH = CirclePath(np.array([0.5, 0.0]), 0.1)
DT = 0.0125
FAR = beside(MODEL, HEIGHT) + R_TIP  # Between the centres, seen from above [m].


def ball_at(p, v=(0.0, 0.0), tip=(0.5, -0.2, 0.15), v_tip=(0.0, 0.0, 0.0)):
    return pack(tip, v_tip, [*p, R_BALL], [*v, 0.0], R_BALL)


def outline(x):
    return outline_of(SHAPE.parts, np.eye(3), x[P_BALL])


# The target and the goals on the way.


def test_the_tips_target_goes_with_the_balls():
    x = ball_at(PATH.point(0.4), (0.0, 0.03))
    goal = moving_target(PATH, x, 0.1, 0.05, HEIGHT, 0.05, R_BALL, 0.1, 6)
    angle = 0.5 + 0.05 / 0.1 * 0.1 * np.arange(6)
    on = np.stack([0.5 + 0.1 * np.cos(angle), 0.1 * np.sin(angle)], axis=1)
    np.testing.assert_allclose(goal[:, P_BALL][:, :2], on, atol=1e-12)
    along = 0.05 * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    np.testing.assert_allclose(goal[:, V_BALL][:, :2], along, atol=1e-12)
    # The tip stays beside the ball as that goes on, 50 mm from it.
    np.testing.assert_array_equal(goal[:, V_TIP], np.tile([0.0, 0.03, 0.0], (6, 1)))
    goes = x[P_BALL][:2] + 0.1 * np.arange(6)[:, None] * x[V_BALL][:2]
    off = goal[:, P_TIP][:, :2] - goes
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), 0.05, atol=1e-12)
    np.testing.assert_allclose(off, np.tile(off[0], (6, 1)), atol=1e-12)
    np.testing.assert_array_equal(goal[:, 2], HEIGHT)


@pytest.mark.parametrize("angle", [0.4, 2.0, -1.1])
def test_the_ball_is_pushed_from_where_it_has_too_much_velocity(angle):
    """In the circle's own directions at the ball, outwards and along it."""
    out = np.array([np.cos(angle), np.sin(angle)])
    along = np.array([-out[1], out[0]])

    def pushed(outside, v):
        p = PATH.point(angle) + outside * out
        d = push_direction(PATH, ball_at(p, v), 0.05)
        assert np.linalg.norm(d) == pytest.approx(1.0)
        return np.array([d @ out, d @ along])

    at_rest = pushed(0.0, (0.0, 0.0))
    # To the point 20 degrees ahead: inwards by half of that.
    np.testing.assert_allclose(at_rest, [-np.sin(0.175), np.cos(0.175)], atol=1e-3)
    # As fast as it should be, along the circle: mostly inwards, as a curve needs.
    rolls = pushed(0.0, 0.05 * along)
    assert rolls[0] < -0.4 and rolls[1] > 0.5
    # One that rolls outwards, or is outside, is pushed inwards more; and the reverse.
    assert pushed(0.0, 0.05 * along + 0.02 * out)[0] < rolls[0] - 0.2
    assert pushed(0.01, 0.05 * along)[0] < rolls[0] - 0.2
    assert pushed(-0.02, 0.05 * along)[0] > 0.0


def test_goals_lie_ahead_and_do_not_go_back_with_the_ball():
    lead, step = np.deg2rad([6.0, 10.0])
    for degrees in np.arange(0.0, 720.0, 0.7):
        angle = np.deg2rad(degrees)
        ahead = (next_waypoint(angle, lead, step) - angle) % (2.0 * np.pi)
        assert lead < ahead + 1e-9 and ahead <= lead + step + 1e-9
    last = next_waypoint(np.deg2rad(25.0), lead, step)
    assert np.rad2deg(last) == pytest.approx(40.0)
    assert next_waypoint(np.deg2rad(5.0), lead, step, last) == last
    on = next_waypoint(np.deg2rad(36.0), lead, step, last)
    assert np.rad2deg(on) == pytest.approx(50.0)
    # Past a whole turn, and a ball that was put elsewhere.
    late = np.deg2rad(350.0)
    assert np.rad2deg(next_waypoint(np.deg2rad(359.0), lead, step, late)) == (
        pytest.approx(10.0)
    )
    assert np.rad2deg(next_waypoint(np.deg2rad(185.0), lead, step, last)) == (
        pytest.approx(200.0)
    )


def test_the_system_gives_target_and_goal_and_holds_them_for_bad_input():
    builder = DiagramBuilder()
    target = builder.AddSystem(
        PathTarget(PathTargetConfig(integral_sec=2.0), 6, 0.1, R_BALL, 0.05, 8, 4, 0.05)
    )
    x = ball_at([0.5 + 0.104, 0.0])  # 4 mm outside.
    sources = {}
    r = np.append(np.full(4, -0.04), np.full(4, 9.0))  # 2 mm nearer, and another's.
    for name, value in (("x", x), ("valid", [1.0]), ("r_comp", r)):
        sources[name] = builder.AddSystem(ConstantVectorSource(np.array(value)))
        builder.Connect(sources[name].get_output_port(), target.GetInputPort(name))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()

    def read(name):
        own = target.GetMyContextFromRoot(context)
        return np.array(target.GetOutputPort(name).Eval(own))

    simulator.AdvanceTo(0.1)
    first = read("x_desired").reshape(6, 19)
    np.testing.assert_allclose(
        read("goal"), [*PATH.point(np.deg2rad(10.0)), 0.0], atol=1e-12
    )
    simulator.AdvanceTo(1.1)
    later = read("x_desired").reshape(6, 19)
    # The circle that is aimed at shrinks by 1 s / 2 s of the distance to the path.
    inward = np.linalg.norm((first - later)[-1, P_BALL][:2])
    assert inward == pytest.approx(0.004 * 1.0 / 2.0, rel=0.05)
    away = np.linalg.norm((first[0, P_TIP] - x[P_BALL])[:2])
    assert away == pytest.approx(0.05 + 0.001 + 0.002)
    value = x.copy()
    value[7] = np.nan
    own = sources["x"].GetMyMutableContextFromRoot(context)
    sources["x"].get_mutable_source_value(own).SetFromVector(value)
    simulator.AdvanceTo(1.5)
    np.testing.assert_array_equal(read("x_desired").reshape(6, 19), later)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"circle": CircleConfig(speed=0.0)}, "path.circle.speed is 0.0"),
        ({"goal_deg": -1.0}, "path.goal_deg is -1.0"),
        ({"circle": CircleConfig(lead_deg=-1.0)}, "path.circle.lead_deg is -1.0"),
        ({"circle": CircleConfig([0.5])}, "path.circle.center"),
    ],
)
def test_a_path_out_of_range_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        PathTarget(PathTargetConfig(**change), 6, 0.1, R_BALL, 0.05, 8, 4, 0.05)


# The way, and places around a ball.


def test_the_outline_is_as_far_from_the_tip_as_the_ball():
    x = ball_at([0.5, 0.1])
    for angle in np.linspace(0.0, 6.0, 20):
        way = np.array([np.cos(angle), np.sin(angle)])
        far = np.sqrt((R_BALL + R_TIP) ** 2 - (HEIGHT - R_BALL) ** 2)
        touching = [0.5, 0.1] + far * way
        off = distance_to_outline(touching[None], outline(x))[0] - R_TIP
        assert 0.0 <= off + 1e-9 < 3.5e-4  # Within the corners.
    with pytest.raises(ValueError, match="below the ball's top"):
        ball_shape(MODEL, 0.07)


@pytest.mark.parametrize("goal_deg", [20.0, 90.0, 179.0, -120.0])
def test_the_way_around_arrives_and_keeps_its_distance(goal_deg):
    x = ball_at([0.5, 0.1])
    around, distance = outline(x), R_TIP + 0.002
    at = np.array([0.5, 0.1]) + [0.0515, 0.0]
    angle = np.deg2rad(goal_deg)
    goal = np.array([0.5, 0.1]) + 0.0555 * np.array([np.cos(angle), np.sin(angle)])
    length = 0.0
    for _ in range(400):
        to = way_around(at, goal, around, distance)
        if way_is_free(at, goal, around, distance):
            np.testing.assert_array_equal(to, goal)
        step = to - at
        step *= min(1.0, 1e-3 / np.linalg.norm(step))
        at = at + step
        length += np.linalg.norm(step)
        assert distance_to_outline(at[None], around)[0] > R_TIP - 5e-4
        if np.linalg.norm(at - goal) < 1e-6:
            break
    assert np.linalg.norm(at - goal) < 1e-6
    assert length < 0.06 * abs(angle) + 0.015  # The shorter way around.


def travelled(v, config, seconds=1.0, inside=0.0, nearer=0.0):
    """References of a tip that goes to the far side of a ball that moves at v (2,), to
    a place by so much nearer than the model's ball lets it."""
    start, along = np.array([0.5, 0.0]), np.array(v)
    state = PushState(
        TRAVEL, np.array([0.5, -0.056, HEIGHT]), np.array([*v, 0.0]), np.zeros(3), go=1
    )
    rows = []
    for k in range(round(seconds / DT)):
        x = ball_at(start + along * k * DT, v, state.p, state.v)
        place = (1.0 - inside / 0.0555) * np.array([0.02, 0.0518])
        state = next_push(
            config, state, SHAPE, DT, x, True, place, 1, HEIGHT, 0.004, nearer
        )  # fmt: skip
        rows.append([*(state.p[:2] - along * (k + 1) * DT), *(state.v[:2] - along)])
        if state.phase == CONTACT:
            break
    return np.array(rows), state


def test_the_way_beside_a_ball_that_rolls_is_that_beside_one_at_rest():
    config = PushConfig(TravelConfig(around=True), follow=True)
    at_rest, end = travelled([0.0, 0.0], config)
    moving, end_moving = travelled([0.05, -0.03], config)
    assert end.phase == end_moving.phase == CONTACT
    np.testing.assert_allclose(moving, at_rest, atol=1e-9)
    # One that does not follow arrives at rest; one that may not go around goes up.
    _, lags = travelled([0.05, -0.03], replace(config, follow=False))
    assert np.linalg.norm(end_moving.v[:2] - [0.05, -0.03]) < 0.02
    assert np.linalg.norm(lags.v[:2]) < 0.02
    _, over = travelled([0.0, 0.0], replace(config, travel=TravelConfig()), 0.3)
    assert over.p[2] > HEIGHT + 0.01 and end.p[2] == pytest.approx(HEIGHT, abs=2e-3)


def test_a_ball_that_is_learned_to_be_smaller_is_passed_and_reached_nearer():
    config = PushConfig(TravelConfig(around=True), follow=True)
    rows, end = travelled([0.0, 0.0], config, inside=0.004, nearer=-0.005)
    assert end.phase == CONTACT
    far = np.hypot(*(rows[:, :2] - [0.5, 0.0]).T)
    assert far[-1] == pytest.approx(0.0515, abs=2e-3)
    _, kept = travelled([0.0, 0.0], config, inside=0.004)
    # As modelled it is passed no nearer than with half the clearance, 52.5 mm from its
    # middle; a place that is nearer is reached as far out as that.
    assert np.hypot(*(kept.p[:2] - [0.5, 0.0])) == pytest.approx(0.0525, abs=4e-4)


def test_a_task_without_a_learned_distance_takes_the_shape_as_it_is_modelled():
    start = [0.5, -0.056, HEIGHT]
    config = PushTaskConfig(PushConfig(TravelConfig(around=True), follow=True), HEIGHT)

    def reference(nearer):
        """The tip's after half a second of travelling to the ball's other side."""
        task = PushTask(config, 6, SHAPE, start)
        context = task.CreateDefaultContext()
        values = {
            "x": ball_at([0.5, 0.0], tip=start),
            "valid": [1.0],
            "goal": [0.5, 0.1, 0.0],
            "command": [1.0, 0.02, 0.0518],
        }
        if nearer is not None:
            values["nearer"] = [nearer]
        for name, value in values.items():
            task.GetInputPort(name).FixValue(context, np.array(value))
        Simulator(task, context).AdvanceTo(0.5)
        return task.GetOutputPort("reference").Eval(context)

    np.testing.assert_array_equal(reference(None), reference(0.0))
    assert np.linalg.norm((reference(0.005) - reference(0.0))[:3]) > 1e-3


# Rounds and the loop.


def pairs(friction):
    return [
        ContactPair("tip::tip", "ball::ball", friction, tangent=[0.0, 0.0, 1.0]),
        ContactPair("ball::ball", "table::table", friction),
    ]


@pytest.fixture(scope="module")
def planner():
    contacts = SampledContactsConfig()
    plan = AnitescuLcs(make_tip_and_ball(MODEL)[0], pairs(0.5), 0.1)
    c3 = sampled_c3_config(contacts.planner, plan.n_lam, 4, R_BALL, 0.05)
    problem = C3Problem(c3.weights, c3.projection, c3.options)
    return plan, problem, contacts.sampler.sampling, contacts.push


def test_a_tip_elsewhere_is_taken_to_arrive_with_the_balls_velocity(planner):
    plan, problem, sampling, _ = planner
    x = ball_at(PATH.point(0.4), (-0.02, 0.04), [0.55, -0.02, HEIGHT], (0.1, 0.2, 0.0))
    target = moving_target(
        PATH, x, 0.1, 0.05, HEIGHT, 0.05, R_BALL, 0.1, problem.options.N + 1
    )
    seen = []

    def build_many(states, u):
        seen.append(states.copy())
        return plan.build_many(states, u)

    def round_of(config):
        sample_round(
            config, SamplingMemory(), build_many, problem, SHAPE, x, target, 0.01, True,
            0.0,
        )  # fmt: skip
        return seen[-1]

    states = round_of(sampling)
    np.testing.assert_array_equal(states[0], x)
    assert len(states) > 8
    np.testing.assert_array_equal(
        states[1:, V_TIP], np.tile([-0.02, 0.04, 0.0], (len(states) - 1, 1))
    )
    at_rest = round_of(replace(sampling, follow=False))
    np.testing.assert_array_equal(at_rest[1:, V_TIP], 0.0)


def test_a_place_that_is_reached_is_kept_for_a_while(planner):
    """A tip in front of a ball that it should be behind."""
    plan, problem, sampling, _ = planner
    at, along = PATH.point(0.4), np.array([-np.sin(0.4), np.cos(0.4)])
    x = ball_at(at, (0.0, 0.0), [*(at + 0.0512 * along), HEIGHT])
    target = moving_target(
        PATH, x, 0.1, 0.05, HEIGHT, FAR, R_BALL, 0.1, problem.options.N + 1
    )

    def chosen(keep_sec, times):
        memory, found = SamplingMemory(), []
        for t in times:
            memory, one = sample_round(
                replace(sampling, change=replace(sampling.change, keep_sec=keep_sec)),
                memory, plan.build_many, problem,
                SHAPE, x, target, 0.01, True, t,
            )  # fmt: skip
            found.append(one.chosen)
        return found

    assert chosen(0.0, [5.0])[0] != 0
    kept = chosen(0.5, [5.0, 5.3, 5.6])
    assert kept[:2] == [0, 0] and kept[2] != 0


def test_a_ball_is_rolled_along_the_circle_from_beside(planner):
    """The model is the world, of smaller steps; no arm."""
    plan, problem, sampling, push = planner
    world = AnitescuLcs(make_tip_and_ball(MODEL)[0], pairs(0.5), DT / 4)
    x = ball_at(PATH.point(0.5))
    still = np.zeros(3)
    task = PushState(WAIT, x[P_TIP].copy(), still, still)
    memory, warm = SamplingMemory(), problem.cold_start()
    angle, last, errors, touched = 0.0, 0.5, [], 0
    goal = None
    for k in range(round(7.0 / DT)):
        target = moving_target(
            PATH, x, np.deg2rad(6.0), 0.05, HEIGHT, FAR + 1e-3, R_BALL, 0.1,
            problem.options.N + 1,
        )  # fmt: skip
        goal = next_waypoint(PATH.angle(x[P_BALL]), 0.1, np.deg2rad(10.0), goal)
        if k % 8 == 0:
            off = float(np.linalg.norm(PATH.point(goal) - x[P_BALL][:2]))
            memory, _ = sample_round(
                sampling, memory, plan.build_many, problem, SHAPE, x, target, off,
                task.phase == CONTACT, k * DT, goal=(goal,),
            )  # fmt: skip
        task = next_push(
            push, task, SHAPE, DT, x, True, memory.place, memory.go, HEIGHT, 0.004
        )
        v = task.v
        if task.phase == CONTACT:
            touched += 1
            lcs = plan.build(x, np.zeros(3))
            found, warm = solve_c3(lcs, x, target, problem, warm)
            v = x[V_TIP] + DT * found.u[0]
            v[2] = 0.0
        for _ in range(4):
            now = x.copy()
            now[V_TIP] = v
            after, _ = simulate(world.build(now, np.zeros(3)), now, np.zeros(3))
            after[P_TIP], after[V_TIP] = x[P_TIP] + v * DT / 4, v
            # Sliding contacts of this model open; and a ball that rolls slows down.
            after[9], after[18], after[3:7] = R_BALL, 0.0, [1.0, 0.0, 0.0, 0.0]
            after[V_BALL] *= 1.0 - 0.8 * DT / 4
            after[W_BALL] *= 1.0 - 0.8 * DT / 4
            x = after
        if task.phase != CONTACT:
            x[P_TIP] = task.p
        now_at = PATH.angle(x[P_BALL])
        angle += (now_at - last + np.pi) % (2.0 * np.pi) - np.pi
        last = now_at
        errors.append(abs(np.hypot(*(x[P_BALL][:2] - PATH.center)) - PATH.radius))
    assert angle > np.deg2rad(60.0)
    assert max(errors) < 0.015
    assert touched > 100


# The diagram.


def config(**changes) -> BallRollingConfig:
    return BallRollingConfig(
        camera=CameraConfig(renderer="drawn"),
        start_angle_rad=-0.7,
        contact_sequence="sampled",
        **changes,
    )


def test_the_arm_goes_to_the_ball_and_rolls_it_on_along_the_circle():
    diagram = make_ball_rolling(config(radius_error_m=0.0))
    names = [system.get_name() for system in diagram.GetSystems()]
    assert "contact_sampler" in names and "rolling_task" not in names
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()

    def read(name, port):
        system = diagram.GetSubsystemByName(name)
        own = system.GetMyContextFromRoot(context)
        return np.array(system.GetOutputPort(port).Eval(own))

    plant = diagram.GetSubsystemByName("station").GetSubsystemByName("plant")
    ball = plant.GetBodyByName("ball")

    def angle():
        own = plant.GetMyContextFromRoot(context)
        p = plant.EvalBodyPoseInWorld(own, ball).translation()
        return np.arctan2(p[1], p[0] - 0.5), np.hypot(p[0] - 0.5, p[1])

    start = angle()[0]
    phases = set()
    for k in range(1, 51):
        simulator.AdvanceTo(0.1 * k)
        phases.add(int(read("push_task", "phase")[0]))
    assert {CONTACT, TRAVEL} <= phases
    end, far = angle()
    assert end - start > np.deg2rad(8.0)
    assert abs(far - 0.1) < 0.02
    assert read("arm_reference", "x_desired")[2] == pytest.approx(HEIGHT, abs=5e-3)
    assert np.isfinite(read("impedance_controller", "tau")).all()
    # What touch has learned of the radius, the camera's ray heeds.
    tracker = diagram.GetSubsystemByName("ball_tracker")
    told = tracker.GetInputPort("radius_error").Eval(
        tracker.GetMyContextFromRoot(context)
    )
    r = read("residual_learner", "r_comp")[:4].mean() - 0.003 / 0.05
    assert told == pytest.approx(0.05 * r) and abs(told) > 1e-4


def test_a_touch_speed_has_the_force_that_it_asks_for():
    reference = replace(SampledContactsConfig().reference, touch=TouchConfig(speed=0.1))
    contacts = replace(SampledContactsConfig(), reference=reference)
    diagram = make_ball_rolling(config(contacts=contacts))
    arm = diagram.GetSubsystemByName("arm_reference")
    own = arm.GetMyContextFromRoot(diagram.CreateDefaultContext())
    assert arm.GetInputPort("tip_force").HasValue(own)


def _set(config, setting, value):
    *parts, last = setting.split(".")
    for part in parts:
        config = getattr(config, part)
    setattr(config, last, value)


@pytest.mark.parametrize(
    ("choice", "setting", "value"),
    [
        ({}, "contacts.gap_allowance", 0.002),
        ({}, "contacts.push.travel.speed", 0.5),
        ({"contact_sequence": "sampled"}, "task.rolling.reposition.lift", 0.02),
        ({"contact_sequence": "sampled"}, "task.circle.speed", 0.03),
        ({"contact_sequence": "sampled"}, "planner.options.N", 6),
        ({"contact_sequence": "sampled"}, "learning.eps", 1e-4),
        ({"contact_sequence": "sampled"}, "learning.posterior.walk.drift", 0.01),
        ({"controller": "paper"}, "learning.posterior.walk.hold_sec", 3.0),
    ],
)
def test_a_setting_that_the_chosen_parts_do_not_read_is_refused(choice, setting, value):
    made = BallRollingConfig(camera=CameraConfig(renderer="drawn"), **choice)
    _set(made, setting, value)
    ((name, chosen),) = (choice or {"contact_sequence": "cycle"}).items()
    with pytest.raises(ValueError, match=f"^{setting} is {value}, .*{name}={chosen}$"):
        make_ball_rolling(made)


def test_the_chosen_parts_settings_are_taken():
    made = config(task=RollingTaskConfig(CircleConfig([0.52, 0.0], 0.09, speed=0.045)))
    made.learning.r_max = 0.6
    made.contacts.gap_allowance = 0.002
    make_ball_rolling(made)


def test_what_does_not_go_with_it_is_refused_in_one_line():
    for change, message in (
        ({"controller": "paper"}, "controller=paper"),
        ({"projection": "qp"}, "projection=qp"),
        ({"learner": "both"}, "learner=both"),
    ):
        with pytest.raises(ValueError, match=message):
            make_ball_rolling(config(**change))
    with pytest.raises(ValueError, match="--robot lcm: contact_sequence is sampled"):
        experiment.run_on_lcm(config(), None, "")
    gentle = GentleRollingConfig(ball=config())
    with pytest.raises(ValueError, match="ball.contact_sequence is sampled"):
        ball_config(gentle)
    gentle = GentleRollingConfig(ball=BallRollingConfig(learner="none"))
    with pytest.raises(ValueError, match="ball.learner is none, .*adapt=false"):
        ball_config(gentle)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"path": PathTargetConfig(CircleConfig(radius=0.2))},
            "contacts.path.circle.radius is 0.2",
        ),
        ({"push": PushConfig()}, "contacts.push.follow"),
        ({"learning_weight": -1.0}, "contacts.learning_weight is -1.0"),
        ({"learning_drift": -0.1}, "contacts.learning_drift is -0.1"),
        ({"gap_allowance": np.inf}, "contacts.gap_allowance is inf"),
        ({"learning_eps": 0.0}, "contacts.learning_eps is 0.0, expected > 0"),
    ]
    + [
        (
            {"planner": replace(SampledPlannerConfig(), **{name: 0.0})},
            f"contacts.planner.{name} is 0.0, expected > 0",
        )
        for name in (
            "position",
            "velocity",
            "tip",
            "tip_height",
            "tip_speed",
            "force",
            "friction",
        )
    ],
)
def test_settings_that_cannot_act_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        check_contacts(replace(SampledContactsConfig(), **change))


def test_zero_is_no_bad_weight_drift_or_allowance():
    free = {"learning_weight": 0.0, "learning_drift": 0.0, "gap_allowance": 0.0}
    check_contacts(replace(SampledContactsConfig(), **free))


def test_rounds_of_things_that_lie_still_are_as_before():
    assert not SamplingConfig().follow
    assert not PushConfig().follow and not TravelConfig().around

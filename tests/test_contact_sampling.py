"""Places around an object, their plans, and the choice between them."""

from dataclasses import replace

import numba
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from makebreak.diagrams.push_object_config import (
    PushPlannerConfig,
    c3_config,
    contact_pairs,
)
from makebreak.models.pushed_object import (
    PushedObject,
    make_tip_and_object,
    parts,
    rest_height,
)
from makebreak.models.tip_and_ball import TipAndBall
from makebreak.systems.contact_mpc.contact_sampler import (
    ContactSampler,
    ContactSamplerConfig,
    SamplerStatus,
)
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs
from makebreak.systems.contact_mpc.numerics.ball_state import (
    P_BALL,
    P_TIP,
    Q_BALL,
    V_BALL,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import (
    C3Problem,
    plan_cost,
    solve_c3,
)
from makebreak.systems.contact_mpc.numerics.c3_plan import WarmStart
from makebreak.systems.contact_mpc.numerics.contact_sampling import (
    ChangeConfig,
    ObjectShape,
    ReachConfig,
    SamplingConfig,
    SamplingMemory,
    choose,
    in_reach,
    out_of_reach,
    sample_round,
)
from makebreak.systems.contact_mpc.numerics.lcs import simulate
from makebreak.systems.contact_mpc.numerics.object_frame import (
    heading_of,
    rotation_of,
    to_object,
    to_world,
    turned_inputs,
)
from makebreak.systems.contact_mpc.numerics.outline import (
    distance_to_outline,
    inward,
    outline_of,
    places_around,
)
from makebreak.systems.contact_mpc.numerics.plan_scores import score_plans, score_within
from makebreak.systems.contact_mpc.numerics.push_task import (
    CONTACT,
    TRAVEL,
    WAIT,
    PushConfig,
    PushState,
    TravelConfig,
    angle_between,
    errors,
    heading,
    look_ahead,
    next_push,
)
from makebreak.systems.contact_mpc.numerics.tip_travel import (
    travel_length,
    travel_step,
    way_is_free,
)

T = PushedObject("t")
HEIGHT = 0.024
TIP = TipAndBall(tip_mass=1.0, tip_radius=0.0195)


def turned(yaw):
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def state(tip, pose, spec=T):
    x = np.zeros(19)
    x[P_TIP], x[Q_BALL] = tip, turned(pose[2])
    x[P_BALL] = [*pose[:2], rest_height(spec)]
    return x


def outline_at(pose, spec=T):
    x = state(np.zeros(3), pose, spec)
    points = [part.points for part in parts(spec)]
    return outline_of(points, rotation_of(x[Q_BALL]), x[P_BALL])


def planner_of(spec, axis=()):
    """The model of tip and object, the problem, and the shape."""
    model = AnitescuLcs(
        make_tip_and_object(spec, TIP)[0], contact_pairs(spec, 0.5), 0.1
    )
    c3 = c3_config(PushPlannerConfig(), model.n_lam, axis)
    problem = C3Problem(c3.weights, c3.projection, c3.options)
    points = [part.points for part in parts(spec)]
    return model, problem, ObjectShape(points, TIP.tip_radius, 2.0 * rest_height(spec))


@pytest.fixture(scope="module")
def planner():
    return planner_of(T)


# Geometry.


@pytest.mark.parametrize("shape", ["t", "box", "disc", "cylinder"])
def test_the_outline_is_the_convex_hull_of_each_part_from_above(shape):
    rng = np.random.default_rng(0)
    for part in parts(PushedObject(shape)):
        for _ in range(10):
            R = Rotation.random(random_state=int(rng.integers(1000))).as_matrix()
            (polygon,) = outline_of([part.points], R, np.array([0.4, -0.2, 0.1]))
            hull = ConvexHull(part.points @ R[:2].T + [0.4, -0.2])
            x, y = polygon.T
            area = 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))
            # Counter-clockwise: positive. Corners of less than 1e-12 m2 are left out.
            assert area == pytest.approx(hull.volume, abs=1e-9)


def test_distance_to_the_outline_agrees_with_the_nearest_of_many_points():
    outline = outline_at([0.5, 0.1, 0.7])
    rng = np.random.default_rng(0)
    points = [0.5, 0.1] + rng.uniform(-0.2, 0.2, (200, 2))
    share = np.linspace(0.0, 1.0, 400)[:, None]
    edges = np.concatenate([
        a + share * (b - a)
        for polygon in outline
        for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True)
    ])  # fmt: skip
    brute = np.linalg.norm(points[:, None] - edges, axis=2).min(axis=1)
    distance = distance_to_outline(points, outline)
    outside = distance > 0.0
    assert 20 < outside.sum() < 200
    # Points every 0.4 mm: the nearest is off by 0.2 mm along the edge at most.
    np.testing.assert_allclose(distance[outside], brute[outside], atol=2e-4)
    inside = [
        any((ConvexHull(p).equations @ [*point, 1.0] <= 0).all() for p in outline)
        for point in points
    ]
    np.testing.assert_array_equal(~outside, inside)


@pytest.mark.parametrize("shape", ["t", "l", "box", "disc", "cylinder"])
@pytest.mark.parametrize("phase", [0.0, 0.4, 0.99])
def test_places_lie_at_the_clearance_all_around_the_object(shape, phase):
    outline = outline_at([0.5, 0.1, 0.7], PushedObject(shape))
    places = places_around(outline, 0.0235, 16, phase)
    assert len(places) == 16
    # None inside or nearer; on the bends a straight piece of the contour is cut short.
    np.testing.assert_allclose(distance_to_outline(places, outline), 0.0235, atol=1e-4)
    middle = np.concatenate(outline).mean(axis=0)
    angles = np.sort(np.arctan2(*(places - middle).T))
    assert np.diff(np.r_[angles, angles[0] + 2 * np.pi]).max() < 1.3  # On every side.


def test_a_place_goes_with_the_object():
    x = state([0, 0, 0], [0.5, 0.1, 0.7])
    place = np.array([0.03, -0.08])
    there = to_world(x, place)
    expected = Rotation.from_euler("z", 0.7).as_matrix()[:2, :2] @ place + [0.5, 0.1]
    np.testing.assert_allclose(there, expected, atol=1e-12)
    np.testing.assert_allclose(to_object(x, there), place, atol=1e-12)


def test_the_first_guess_pushes_into_the_object():
    outline = outline_at([0.5, 0.1, 0.7])
    places = places_around(outline, 0.0235, 16)
    ahead = distance_to_outline(places + 0.01 * inward(places, outline), outline)
    np.testing.assert_allclose(ahead, 0.0135, atol=2e-4)


# Travel.


def travel(p, goal, outline, v=(0.0, 0.0, 0.0), up=0.075, keep=0.0215, dt=0.0125):
    """The references from p to the goal, and whether it arrived."""
    p, v, way = np.array(p), np.array(v, dtype=float), []
    for _ in range(400):
        p, v, a, arrived = travel_step(p, v, goal, outline, keep, up, (0.35, 2.0), dt)
        way.append((p, v, a))
        if arrived:
            break
    return way, arrived


@pytest.mark.parametrize("seed", range(6))
def test_the_way_arrives_and_never_comes_nearer_than_it_may(seed):
    rng = np.random.default_rng(seed)
    outline = outline_at([0.5, 0.0, rng.uniform(-np.pi, np.pi)])
    places = places_around(outline, 0.0235, 16, rng.random())
    a, b = places[rng.choice(16, 2, replace=False)]
    way, arrived = travel([*a, HEIGHT], np.array([*b, HEIGHT]), outline)
    assert arrived
    p, v, acceleration = (np.array(each) for each in zip(*way, strict=True))
    low = p[:, 2] < 0.04 + 0.0195 + 0.01  # Else it passes above the object.
    # Between a place's distance and what is kept there are 2 mm.
    assert distance_to_outline(p[low, :2], outline).min() > 0.0215 - 1e-9
    assert p[:, 2].min() > HEIGHT - 1e-3  # Nor does it go into the table.
    assert np.linalg.norm(v, axis=1).max() < 0.35 + 1e-9
    assert np.linalg.norm(acceleration, axis=1).max() < 2.0 + 1e-9


def test_a_free_way_is_not_gone_through_the_air():
    outline = outline_at([0.5, 0.0, 0.0], PushedObject("box"))
    a, b = np.array([0.40, -0.05]), np.array([0.40, 0.05])
    assert way_is_free(a, b, outline, 0.0215)
    way, arrived = travel([*a, HEIGHT], np.array([*b, HEIGHT]), outline)
    assert arrived and max(p[2] for p, _, _ in way) < HEIGHT + 1e-9
    across = np.array([0.60, 0.05])
    assert not way_is_free(a, across, outline, 0.0215)
    way, arrived = travel([*a, HEIGHT], np.array([*across, HEIGHT]), outline)
    assert arrived and max(p[2] for p, _, _ in way) > 0.074


def test_a_tip_that_touches_may_leave_but_not_go_through():
    outline = outline_at([0.5, 0.0, 0.0], PushedObject("box"))
    at = np.array([0.45 - 0.0195, 0.0])  # The box is 100 mm wide.
    assert way_is_free(at, np.array([0.40, 0.0]), outline, 0.0215)
    assert not way_is_free(at, np.array([0.45 - 0.0195, 0.03]), outline, 0.0215)
    assert not way_is_free(at, np.array([0.60, 0.0]), outline, 0.0215)


# Plans.


def places_of(planner, pose=(0.5, 0.0, 0.3), n=16):
    model, problem, shape = planner
    outline = outline_at(pose)
    places = places_around(outline, shape.tip_radius + 0.004, n)
    x = np.array([state([*place, HEIGHT], pose) for place in places])
    guess = np.zeros((n, problem.options.N, 3))
    guess[:, :, :2] = 4.0 * inward(places, outline)[:, None]
    return x, guess


def target(x, goal, n_knots):
    return look_ahead(PushConfig(), x, np.array(goal), HEIGHT, n_knots)


def test_a_batch_is_what_build_and_solve_c3_give_one_by_one(planner):
    model, problem, _ = planner
    x, guess = places_of(planner)
    x_desired = target(x[0], [0.55, 0.02, 0.6], problem.options.N + 1)
    cost, u, plans = score_plans(
        model.build_many(x, np.zeros(3)), x, x_desired, problem, guess
    )
    z = np.zeros((problem.options.N, problem.n_z))
    for i in range(len(x)):
        lcs = model.build(x[i], np.zeros(3))
        plan, _ = solve_c3(lcs, x[i], x_desired, problem, WarmStart(guess[i], z, z))
        # The same operations: rounding alone.
        np.testing.assert_allclose(u[i], plan.u, atol=1e-9)
        np.testing.assert_allclose(plans[i], plan.x, atol=1e-9)
        # The angle's cost is quadratic in the batch, the angle itself in plan_cost.
        real = plan_cost(lcs, x[i], plan.u, x_desired, problem)
        assert cost[i] == pytest.approx(real, rel=0.1)


def test_no_bit_of_a_score_depends_on_the_number_of_threads(planner):
    model, problem, _ = planner
    x, guess = places_of(planner)
    lcs = model.build_many(x, np.zeros(3))
    x_desired = target(x[0], [0.55, 0.02, 0.6], problem.options.N + 1)
    threads = numba.get_num_threads()
    found = []
    for n in {1, threads}:
        numba.set_num_threads(n)
        try:
            found.append(score_plans(lcs, x, x_desired, problem, guess))
        finally:
            numba.set_num_threads(threads)
    # And a place alone has the score that it has among others.
    alone = score_plans(lcs, x, x_desired, problem, guess, 2, 3)
    for first, last, one in zip(found[0], found[-1], alone, strict=True):
        np.testing.assert_array_equal(first, last)
        np.testing.assert_array_equal(first[2], one[2])


def test_many_lcs_are_those_of_one_after_the_other(planner):
    model, _, _ = planner
    x, _ = places_of(planner)
    x[3, Q_BALL] *= 1.3  # Normalised.
    x[5, 0] = np.nan
    arrays = model.build_many(x, np.ones(3))
    for i in range(len(x)):
        if i == 5:
            assert all(np.isnan(a[i]).all() for a in arrays)
            continue
        lcs = model.build(x[i], np.ones(3))
        for a, name in zip(arrays, "A B D d E F H c phi".split(), strict=True):
            np.testing.assert_allclose(a[i], getattr(lcs, name), atol=1e-12)
    general = AnitescuLcs(
        make_tip_and_object(T, TIP)[0], contact_pairs(T, 0.5), 0.1, analytic=False
    )
    assert model.is_analytic and not general.is_analytic
    for a, b in zip(arrays, general.build_many(x, np.ones(3)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_the_best_place_is_behind_the_object(planner):
    model, problem, _ = planner
    pose = (0.5, 0.0, np.pi / 2)  # The cross bar is at -x, the stem towards +x.
    x, guess = places_of(planner, pose)
    x_desired = target(x[0], [0.44, 0.0, np.pi / 2], problem.options.N + 1)
    cost, _, plans = score_plans(
        model.build_many(x, np.zeros(3)), x, x_desired, problem, guess
    )
    best = int(np.argmin(cost))
    assert x[best, 0] > 0.5 and abs(x[best, 1]) < 0.03
    assert plans[best, -1, P_BALL.start] < 0.46
    # In front of it nothing can be done: the tip stays, and so does the object.
    in_front = int(np.argmin(x[:, 0]))
    assert cost[in_front] > 3.0 * cost[best]


def test_the_budget_leaves_the_last_places_out(planner):
    model, problem, _ = planner
    x, guess = places_of(planner)
    lcs = model.build_many(x, np.zeros(3))
    x_desired = target(x[0], [0.55, 0.02, 0.6], problem.options.N + 1)
    whole = score_plans(lcs, x, x_desired, problem, guess)
    little = score_within(1e-9, lcs, x, x_desired, problem, guess, at_once=4)
    np.testing.assert_array_equal(little[0][:4], whole[0][:4])
    assert np.isinf(little[0][4:]).all()
    enough = score_within(1e3, lcs, x, x_desired, problem, guess, at_once=4)
    for a, b in zip(enough, whole, strict=True):
        np.testing.assert_array_equal(a, b)


# The choice.


def test_the_present_place_is_kept_unless_another_is_clearly_better():
    hysteresis = (0.2, 1.0)
    assert choose(np.array([10.0, 7.1, 9.0]), hysteresis) == 0
    assert choose(np.array([10.0, 6.9, 9.0]), hysteresis) == 1
    assert choose(np.array([10.0, 6.9, np.nan]), hysteresis) == 1
    assert choose(np.array([np.inf, 50.0, 49.0]), hysteresis) == 2
    assert choose(np.array([np.inf, np.inf]), hysteresis) == 0


def rounds(planner, x, goal, n, in_contact, memory=None, dt=0.1):
    model, problem, shape = planner
    memory = SamplingMemory() if memory is None else memory
    x_desired = target(x, goal, problem.options.N + 1)
    for k in range(n):
        memory, found = sample_round(
            SamplingConfig(), memory, model.build_many, problem, shape, x, x_desired,
            sum(errors(x, np.array(goal))), in_contact, k * dt,
        )  # fmt: skip
    return memory, found


def test_a_tip_on_its_way_keeps_its_place_and_a_stuck_one_leaves_it(planner):
    x, _ = places_of(planner)
    goal = [0.55, 0.02, 0.6]
    memory, found = rounds(planner, x[0], goal, 1, in_contact=False)
    assert memory.go == 1 and found.chosen > 0
    # Nothing changes but the places that are looked at.
    later, _ = rounds(planner, x[0], goal, 12, False, memory)
    assert later.go <= 3
    best = state([*to_world(x[0], later.place), HEIGHT], (0.5, 0.0, 0.3))
    pushing, found = rounds(planner, best, goal, 11, True, later)
    assert found.chosen == 0 and pushing.go == later.go
    stuck, _ = rounds(planner, best, goal, 14, True, later, dt=0.2)
    assert stuck.go == later.go + 1  # No progress for more than 1.2 s.


def test_another_goal_is_no_lack_of_progress(planner):
    model, problem, shape = planner
    x, _ = places_of(planner)
    first, second = [0.505, 0.0, 0.3], [0.7, 0.02, 0.3]
    memory, found = rounds(planner, x[0], first, 1, in_contact=False)
    at = state([*to_world(x[0], memory.place), HEIGHT], (0.5, 0.0, 0.3))

    def again(memory, goal, t, error):
        x_desired = target(at, goal, problem.options.N + 1)
        return sample_round(
            SamplingConfig(), memory, model.build_many, problem, shape, at, x_desired,
            error, True, t, goal=tuple(goal),
        )  # fmt: skip

    memory, _ = again(memory, first, 0.1, 0.005)
    for k in range(20):  # 3 cm/s towards the second, whose error was 0.2 m.
        memory, found = again(memory, second, 0.2 + 0.1 * k, 0.2 - 0.003 * k)
        assert np.isfinite(found.cost[0])
    memory, found = again(memory, second, 5.0, 0.2)
    assert not np.isfinite(found.cost[0])  # Of the same goal it is one.


def test_a_place_goes_along_with_what_rolls_and_not_with_its_noise(planner):
    shape = planner[2]
    place = np.array([0.0, 0.13])
    for follow, change in ((True, 0.008), (True, 0.0), (False, 0.008)):
        config, rng = PushConfig(follow=follow, place_change=change), (
            np.random.default_rng(0)
        )  # fmt: skip
        x = state([0.5, 0.3, 0.1], (0.5, 0.0, 0.0))
        task = PushState(WAIT, x[P_TIP].copy(), np.zeros(3), np.zeros(3))
        off = []
        for k in range(60):
            y = 0.1 * 0.0125 * k
            x[P_BALL][:2] = [0.5, y] + 5e-4 * rng.normal(size=2)
            x[V_BALL][:2] = [0.0, 0.1]
            task = next_push(
                config, task, shape, 0.0125, x, True, place, 1, HEIGHT, 0.004
            )
            x[P_TIP] = task.p
            off.append(task.place - [0.5, y + 0.13])
        steps = np.diff(np.array(off)[1:], axis=0)
        still = bool(np.median(abs(steps[:, 0])) < 1e-9)
        assert still is (change > 0.0)  # It does not shake with the noise.
        lag = abs(np.array(off)[:, 1]).max()
        assert lag < 0.003 if follow else lag > 0.006


def at_a_good_place(planner, goal, spec=T):
    """A state with the tip where it is best for a goal, and the target."""
    pose, (model, problem, shape) = (0.5, 0.0, 0.3), planner
    x = state([0.3, 0.0, 0.1], pose, spec)
    x_desired = target(x, goal, problem.options.N + 1)
    memory, _ = sample_round(
        SamplingConfig(), SamplingMemory(), model.build_many, problem, shape, x,
        x_desired, 0.1, False, 0.0,
    )  # fmt: skip
    at = state([*to_world(x, memory.place), HEIGHT], pose, spec)
    return at, target(at, goal, problem.options.N + 1)


@pytest.mark.parametrize("goal", [(0.45, 0.06, 0.0), (0.5, -0.06, 0.8)])
def test_a_tip_that_pushes_keeps_the_plan_that_it_pushes_by(goal):
    """It looked for one from nothing, of which noise made the cost three and five times
    as large, and so left what it had just touched."""
    spec, rng = PushedObject("box"), np.random.default_rng(0)
    model, problem, shape = own = planner_of(spec)
    at, x_desired = at_a_good_place(own, goal, spec)
    config = SamplingConfig(places=1, change=ChangeConfig(hysteresis=[0.0, 1e9]))
    memory, costs = SamplingMemory(), []
    for _ in range(20):
        x = at.copy()
        x[P_TIP][:2] += 1e-3 * rng.normal(size=2)
        x[V_BALL][:2] += 0.02 * rng.normal(size=2)
        memory, found = sample_round(
            config, memory, model.build_many, problem, shape, x, x_desired, 0.1, True,
            0.0,
        )  # fmt: skip
        costs.append(found.cost[0])
    assert found.chosen == 0 and max(costs[1:]) < 1.25 * min(costs)


def test_c3_pushes_by_the_plan_that_its_place_was_chosen_for():
    """From the place it does not find as good a one by itself: it stood there, and the
    sampler waited for what its own plan promised."""
    spec, goal = PushedObject("box"), (0.5, -0.06, 0.8)
    model, problem, shape = own = planner_of(spec)
    at, x_desired = at_a_good_place(own, goal, spec)
    memory = SamplingMemory()
    for _ in range(5):
        memory, found = sample_round(
            SamplingConfig(places=1, change=ChangeConfig(hysteresis=[0.0, 1e9])),
            memory, model.build_many, problem, shape, at, x_desired, 0.1, True, 0.0,
        )  # fmt: skip
    inputs = turned_inputs(memory.inputs, heading_of(at[Q_BALL]))
    lcs, zero = model.build(at, np.zeros(3)), problem.cold_start()
    costs = [
        plan_cost(lcs, at, solve_c3(
            lcs, at, x_desired, problem, zero, guess=guess)[0].u, x_desired, problem)
        for guess in (None, inputs)
    ]  # fmt: skip
    assert costs[1] <= found.cost[0] + 1e-6 < 0.9 * costs[0]


@pytest.mark.parametrize("shape", ["disc", "cylinder"])
def test_a_place_keeps_the_plan_that_it_was_chosen_for(shape):
    """Round by round the search finds a good plan from a place, or a bad one: where the
    good one is not kept, the tip turns round each time that it is not found again."""
    spec = PushedObject(shape)
    model, problem, own = planner_of(spec)
    goal, rng = [0.563, -0.02, -2.819], np.random.default_rng(0)
    for pose in ((0.556, -0.005, -1.812), (0.52, -0.05, -2.5), (0.58, 0.02, -2.0)):
        memory, costs = SamplingMemory(), []
        for k in range(20):
            noise = rng.normal(size=5) * [5e-4, 5e-4, 5e-3, 0.02, 0.02]
            x = state([0.5, 0.05, 0.08], np.array(pose) + noise[:3], spec)
            x[V_BALL.start : V_BALL.start + 2] = noise[3:]
            x_desired = target(x, goal, problem.options.N + 1)
            memory, found = sample_round(
                SamplingConfig(), memory, model.build_many, problem, own, x, x_desired,
                sum(errors(x, np.array(goal))), False, 0.1 * k,
            )  # fmt: skip
            costs.append(found.cost[found.chosen])
        assert memory.go <= 3
        # It is kept as noise turns it, and made better.
        assert (np.array(costs[1:]) < 1.3 * np.array(costs[:-1])).all()


def test_what_rolls_is_pushed_on_and_is_slow_where_the_plan_ends():
    """A lying cylinder: as it rolls its orientation is another one, but no wrong one;
    and it rolls on when the plan is over."""
    spec, ends = PushedObject("cylinder"), {}
    model, _, _ = planner_of(spec)
    x = state([0.5, -0.0435, HEIGHT], (0.5, 0.0, 0.0), spec)
    for axis, coast in (([], 0.5), ([1.0, 0.0, 0.0], 0.0), ([1.0, 0.0, 0.0], 0.5)):
        c3 = c3_config(PushPlannerConfig(coast_sec=coast), model.n_lam, axis)
        problem = C3Problem(c3.weights, c3.projection, c3.options)
        x_desired = target(x, [0.5, 0.05, 0.0], problem.options.N + 1)
        guess = np.zeros((1, problem.options.N, 3))
        guess[:, :, 1] = 1.0
        lcs = model.build_many(x[None], np.zeros(3))
        plan = score_plans(lcs, x[None], x_desired, problem, guess)[2][0]
        ends[len(axis), coast] = plan[-1, P_BALL][1], plan[-1, V_BALL][1]
    still, fast, slow = ends[0, 0.5], ends[3, 0.0], ends[3, 0.5]
    assert still[0] < 0.005  # It is not to turn, and so not to roll.
    assert slow[0] > 0.025 and fast[0] > 0.035
    assert slow[1] < 0.8 * fast[1]


def test_places_that_moved_out_of_reach_with_the_object_are_dropped(planner):
    model, problem, shape = planner
    x = state([0.6, 0.0, HEIGHT], (0.72, 0.0, 0.3))
    far = np.array([0.2, 0.0])  # In the object's frame.
    memory = SamplingMemory(best=far, place=far, go=1)
    x_desired = target(x, [0.6, 0.0, 0.3], problem.options.N + 1)
    _, found = sample_round(
        SamplingConfig(), memory, model.build_many, problem, shape, x, x_desired,
        0.1, False, 0.0,
    )  # fmt: skip
    reach = np.hypot(*found.places.T)
    assert reach[0] > 0.78 and not np.isfinite(found.cost[0])
    assert (reach[1:] <= 0.78).all() and found.chosen > 0


def test_places_out_of_reach_are_not_looked_at(planner):
    model, problem, shape = planner
    x = state([0.6, 0.0, HEIGHT], (0.72, 0.0, 0.3))
    x_desired = target(x, [0.6, 0.0, 0.0], problem.options.N + 1)
    _, found = sample_round(
        SamplingConfig(), SamplingMemory(), model.build_many, problem, shape, x,
        x_desired, 0.1, False, 0.0,
    )  # fmt: skip
    assert len(found.places) > 4
    assert (np.hypot(*found.places.T) <= 0.78).all()
    # Nor those beside and behind the arm's base, however near they are.
    x = state([0.4, 0.3, HEIGHT], (0.25, 0.4, 0.3))
    _, found = sample_round(
        SamplingConfig(), SamplingMemory(), model.build_many, problem, shape, x,
        x_desired, 0.1, False, 0.0,
    )  # fmt: skip
    side = np.arctan2(found.places[1:, 1], found.places[1:, 0])
    assert 2 < len(side) < 14 and (side <= 1.05).all()


def test_a_plan_that_leads_the_tip_out_of_reach_costs_more(planner):
    plans = np.zeros((4, 2, 19))
    plans[:, :, 1] = [[0.41, 0.45], [0.39, 0.38], [0.5, 0.81], [0.4, 0.78]]
    expected = [0.0, 0.01**2 + 0.02**2, 0.03**2, 0.0]
    np.testing.assert_allclose(out_of_reach(plans, [0.41, 0.78], 0.01), expected)
    # With the wrist 0.1 m nearer along y, it is where the tips were; they are farther.
    plans[:, :, 1] += 0.1
    expected = [0.0, 0.01**2 + 0.02**2, 0.13**2, 0.1**2]
    found = out_of_reach(plans, [0.41, 0.78], 0.01, [0.0, 0.1])
    np.testing.assert_allclose(found, expected)
    plans[:, :, 1] -= 0.1
    model, problem, shape = planner
    # A tip on the far side, which has to push the object towards the arm.
    x = state([0.41, 0.0, 0.024], (0.31, 0.0, 0.0))
    x_desired = target(x, [0.24, 0.0, 0.0], problem.options.N + 1)

    def cost(price):
        _, found = sample_round(
            SamplingConfig(
                reach=ReachConfig(cost=price),
                change=ChangeConfig(hysteresis=[0.0, 1e6]),
            ), SamplingMemory(),
            model.build_many, problem, shape, x, x_desired, 0.1, True, 0.0,
        )  # fmt: skip
        assert found.chosen == 0
        return found.cost[0], found.x

    (free, plan), (paid, _) = cost(0.0), cost(1e5)
    near = np.hypot(plan[1:, 0], plan[1:, 1])
    assert near.min() < 0.395
    np.testing.assert_allclose(
        paid - free, 1e5 * (np.maximum(0.4 - near, 0) ** 2).sum(), rtol=1e-6
    )


def test_the_way_through_the_air_has_its_price_but_not_for_a_tip_that_pushes(planner):
    model, problem, shape = planner
    x = state([0.35, 0.0, 0.024], (0.5, 0.0, 0.3))
    x_desired = target(x, [0.55, 0.02, 0.6], problem.options.N + 1)

    def cost(travel, in_contact):
        memory, found = sample_round(
            SamplingConfig(change=ChangeConfig(travel)), SamplingMemory(),
            model.build_many, problem,
            shape, x, x_desired, 0.1, in_contact, 0.0,
        )  # fmt: skip
        return found

    free, paid = cost(0.0, False), cost(20.0, False)
    outline = outline_at((0.5, 0.0, 0.3))
    up = shape.clear_height(0.0)
    way = [
        travel_length(x[P_TIP], np.array([*place, HEIGHT]), outline, 0.0235, up)
        for place in paid.places[1:]
    ]
    np.testing.assert_allclose(paid.cost[1:] - free.cost[1:], 20.0 * np.array(way))
    # Over the object: up 55.5 mm, across, and down; beside it the straight way.
    behind = int(np.argmax(paid.places[1:, 0]))
    across = np.hypot(*(paid.places[1 + behind] - x[:2]))
    assert way[behind] == pytest.approx(across + 2 * (0.04 + 0.0195 - HEIGHT))
    beside = int(np.argmin(way))
    assert way[beside] == pytest.approx(
        np.hypot(*(paid.places[1 + beside] - x[:2])), abs=1e-9
    )
    assert cost(20.0, True).cost[0] == cost(0.0, True).cost[0]


def test_a_tip_that_pushes_pays_for_the_time_of_a_way_by_what_it_would_push(planner):
    """The cost of the object's pose, knot by knot, by hand: as long as the way takes it
    stays where it is, instead of where the present plan leads it."""
    model, problem, shape = planner
    x, x_desired = at_a_good_place(planner, [0.55, 0.02, 0.6])

    def one(speed, pause_sec):
        change = ChangeConfig(0.0, speed, pause_sec, hysteresis=[0.0, 1e9])
        return sample_round(
            SamplingConfig(change=change), SamplingMemory(), model.build_many, problem,
            shape, x, x_desired, 0.1, True, 0.0, dt_sec=model.dt_sec,
        )[1]  # fmt: skip

    free, paid = one(1e9, 0.0), one(0.2, 0.3)
    assert free.chosen == paid.chosen == 0 and free.cost[0] == paid.cost[0]
    cost, goal = PushPlannerConfig(), x_desired[0]

    def of(at):
        turn = cost.angle_radius * (heading(at[Q_BALL]) - heading(goal[Q_BALL]))
        return cost.position * (((at - goal)[P_BALL][:2] ** 2).sum() + turn**2)

    gain = of(x) - of(free.x[-1])
    assert gain > 5.0
    outline, up = outline_at((0.5, 0.0, 0.3)), shape.clear_height(0.0)
    away = [
        0.3 + travel_length(x[P_TIP], [*place, HEIGHT], outline, 0.0235, up) / 0.2
        for place in paid.places[1:]
    ]
    np.testing.assert_allclose(
        paid.cost[1:] - free.cost[1:], gain * np.array(away) / model.dt_sec, rtol=0.01
    )  # The cost of a turn is that of its quadratic.


def test_a_learned_gap_counts_in_every_plan(planner):
    model, problem, shape = planner
    x, _ = places_of(planner)
    x_desired = target(x[0], [0.55, 0.02, 0.6], problem.options.N + 1)
    r = np.zeros(model.n_lam)

    def best(gap):
        r[:4] = gap / model.dt_sec
        _, found = sample_round(
            SamplingConfig(), SamplingMemory(), model.build_many, problem, shape, x[0],
            x_desired, 0.1, False, 0.0, r,
        )  # fmt: skip
        return found.cost.min()

    _, found = sample_round(
        SamplingConfig(), SamplingMemory(), model.build_many, problem, shape, x[0],
        x_desired, 0.1, False, 0.0, nearer=0.006,
    )  # fmt: skip
    outline = outline_at((0.5, 0.0, 0.3))
    far = distance_to_outline(found.places[1:], outline)
    np.testing.assert_allclose(far, 0.0195 + 0.004 + 0.006, atol=1e-4)
    # An object that begins 30 mm farther away than seen is reached too late to be moved
    # as far in half a second.
    assert best(0.03) > 1.3 * best(0.0)


# The task.


def test_the_target_is_the_goal_or_a_part_of_the_way():
    x = state([0.4, 0.0, 0.1], (0.5, 0.0, 3.0))
    near = look_ahead(PushConfig(), x, np.array([0.52, 0.01, -3.1]), HEIGHT, 3)
    np.testing.assert_allclose(near[:, P_BALL], [[0.52, 0.01, x[9]]] * 3, atol=1e-12)
    assert heading(near[0, Q_BALL]) == pytest.approx(-3.1)
    far = look_ahead(PushConfig(), x, np.array([0.5, 0.3, -2.0]), HEIGHT, 3)
    np.testing.assert_allclose(far[0, P_BALL], [0.5, 0.06, x[9]], atol=1e-12)
    turn = angle_between(3.0, heading(far[0, Q_BALL]))
    assert turn == pytest.approx(0.5)  # The shorter way round, through pi.
    assert (far[:, 2] == HEIGHT).all() and not far[:, 10:].any()


def test_noise_changes_the_way_of_half_a_turn_at_most_once():
    """A T whose goal was half a turn away was never pushed in 60 s: with each tick the
    shorter way was the other one, and the tip went to another place."""
    rng, goal, before, ways = np.random.default_rng(0), [0.5, 0.0, np.pi], None, []
    for _ in range(50):
        x = state([0.4, 0.0, 0.1], (0.5, 0.0, 0.01 * rng.normal()))
        before = look_ahead(PushConfig(), x, np.array(goal), HEIGHT, 1, before)[0]
        ways.append(angle_between(heading(x[Q_BALL]), heading(before[Q_BALL])))
    assert abs(np.sum(np.sign(ways))) == 50 and min(np.abs(ways)) == pytest.approx(0.5)
    x = state([0.4, 0.0, 0.1], (0.5, 0.0, -0.3 * np.sign(ways[0])))
    other = look_ahead(PushConfig(), x, np.array(goal), HEIGHT, 1, before)[0]
    turn = angle_between(heading(x[Q_BALL]), heading(other[Q_BALL]))
    assert turn == pytest.approx(-ways[0])  # The shorter one by far.


def test_what_the_arm_hides_on_its_way_is_gone_to_and_pushed_a_little(planner):
    """Waited for at once, it would be seen, gone to and hidden again without end."""
    shape, config = planner[2], PushConfig()
    x = state([0.35, 0.0, 0.1], (0.5, 0.0, 0.3))
    in_object = to_object(x, places_of(planner)[0][0, :2])
    task = PushState(WAIT, x[P_TIP].copy(), np.zeros(3), np.zeros(3))
    phases = []
    for k in range(600):
        task = next_push(
            config, task, shape, 0.0125, x, k == 0, in_object, 1, HEIGHT, 0.004
        )
        if task.phase != CONTACT:
            x[P_TIP] = task.p
        phases.append(task.phase)
        if task.phase == WAIT:
            break
    n = [phases.count(phase) * 0.0125 for phase in (TRAVEL, CONTACT)]
    assert phases == sorted(phases, key=[TRAVEL, CONTACT, WAIT].index)
    assert config.unseen.sec < n[0] < config.unseen.believed_sec
    assert n[1] == pytest.approx(config.unseen.sec, abs=0.03)
    # And not for ever, where the place is far away.
    slow = PushConfig(TravelConfig(speed=0.01))
    x = state([0.35, 0.0, 0.1], (0.5, 0.0, 0.3))
    task = PushState(TRAVEL, x[P_TIP].copy(), np.zeros(3), np.zeros(3))
    ticks = 0
    while task.phase == TRAVEL and ticks < 400:
        task = next_push(
            slow, task, shape, 0.0125, x, False, in_object, 1, HEIGHT, 0.004
        )
        ticks += 1
    assert task.phase == WAIT
    assert 0.0125 * ticks == pytest.approx(slow.unseen.believed_sec, abs=0.03)


def test_an_object_out_of_reach_is_not_followed(planner):
    shape, config = planner[2], PushConfig()
    for phase in (TRAVEL, CONTACT):
        for at, expected in (
            ((0.5, 0.5), phase),
            ((0.5, 0.6), WAIT),  # Too far,
            ((0.24, 0.0), WAIT),  # too near,
            ((0.26, 0.0), phase),
            ((0.1, 0.4), WAIT),  # beside the arm's base,
            ((-0.5, 0.2), WAIT),  # behind it: there the tip would go through the base.
        ):
            x = state([0.35, 0.0, 0.1], (*at, 0.3))
            task = PushState(phase, x[P_TIP].copy(), np.zeros(3), np.zeros(3), go=1)
            task = next_push(
                config, task, shape, 0.0125, x, True, np.array([0.1, 0.0]), 1, HEIGHT,
                0.004,
            )  # fmt: skip
            assert task.phase == expected


def test_the_task_travels_pushes_and_waits_for_what_is_not_seen(planner):
    shape, config = planner[2], PushConfig()
    x = state([0.35, 0.0, 0.1], (0.5, 0.0, 0.3))
    place = places_of(planner)[0][0, :2]
    in_object = to_object(x, place)
    still = np.zeros(3)
    task = PushState(WAIT, x[P_TIP].copy(), still, still)

    def tick(task, seen=True, go=1):
        task = next_push(
            config, task, shape, 0.0125, x, seen, in_object if go else None, go,
            HEIGHT, 0.004,
        )  # fmt: skip
        x[P_TIP] = task.p if task.phase != CONTACT else x[P_TIP]
        return task

    assert tick(task, go=0).phase == WAIT
    falls = []
    for _ in range(400):
        task = tick(task)
        if task.p[2] < 0.04 + 0.0195:  # Beside the object, or on it.
            falls.append(-task.v[2])
        if task.phase == CONTACT:
            break
        assert task.phase == TRAVEL
    # Down slowly from where it may hit something; the last step of braking is on it.
    assert 0.06 < max(falls) < config.travel.descent + 2.0 * 0.0125
    np.testing.assert_allclose(x[P_TIP], [*place, HEIGHT], atol=2e-3)
    for _ in range(20):
        task = tick(task)
        assert task.phase == CONTACT
    x[P_TIP] += [-0.03, 0.0, 0.0]
    assert tick(task, go=2).phase == TRAVEL  # A new command.
    x[P_TIP] += [0.03, 0.0, 0.0]
    for _ in range(20):
        task = tick(task, seen=False)
        assert task.phase == CONTACT  # For 0.25 s it may be hidden.
    for _ in range(200):
        task = tick(task, seen=False)
    assert task.phase == WAIT
    assert task.p[2] > 0.07 and np.hypot(*(task.p[:2] - config.unseen.withdrawn)) < 0.01


def test_a_tip_comes_down_farther_out_and_goes_in_along_the_table(planner):
    """An object that reaches 10 mm farther out than believed is not landed on."""
    shape, config = planner[2], PushConfig()
    for k in range(0, 12, 3):
        x = state([0.35, 0.0, 0.1], (0.5, 0.0, 0.3))
        place = places_of(planner)[0][k, :2]
        in_object = to_object(x, place)
        outline = outline_at((0.5, 0.0, 0.3))
        task = PushState(WAIT, x[P_TIP].copy(), np.zeros(3), np.zeros(3))
        way = []
        for _ in range(800):
            task = next_push(
                config, task, shape, 0.0125, x, True, in_object, 1, HEIGHT, 0.004
            )
            x[P_TIP] = task.p
            way.append(task.p)
            if task.phase == CONTACT:
                break
        assert task.phase == CONTACT
        assert np.hypot(*(task.p[:2] - place)) < 2e-3
        way = np.array(way)
        falling = way[(way[:, 2] < 0.0595) & (way[:, 2] > 0.036)]
        near = distance_to_outline(falling[:, :2], outline) - 0.0195
        assert len(falling) > 10 and near.min() > 0.0075  # 4 mm, and room for 8.
    # A tip that is down already, on its way to a place nearby, does not go out for it.
    task = replace(task, phase=CONTACT)
    x[P_TIP] = [*place, HEIGHT + 0.004]
    near = places_of(planner)[0][9, :2] + [0.002, 0.0]
    ticks = 0
    while ticks == 0 or task.phase == TRAVEL:
        task = next_push(
            config, task, shape, 0.0125, x, True, to_object(x, near), 2, HEIGHT, 0.004
        )
        x[P_TIP] = task.p
        ticks += 1
    assert ticks * 0.0125 < 0.2


def test_a_tip_that_comes_down_on_the_object_goes_up_and_comes_down_farther_out(
    planner,
):
    shape, config = planner[2], PushConfig(TravelConfig(room=0.0))
    x = state([0.35, 0.0, 0.1], (0.5, 0.0, 0.3))
    place = places_of(planner)[0][0, :2]
    in_object = to_object(x, place)
    outline = outline_at((0.5, 0.0, 0.3))
    still = np.zeros(3)
    task = PushState(WAIT, x[P_TIP].copy(), still, still)
    lowest, pressed = [], 0.0
    for _ in range(1200):
        task = next_push(
            config, task, shape, 0.0125, x, True, in_object, 1, HEIGHT, 0.004
        )
        # The object reaches 4 mm farther out than believed.
        x[P_TIP] = task.p
        if distance_to_outline(task.p[None, :2], outline)[0] < 0.0195 + 0.0075:
            x[2] = max(task.p[2], 0.0585)
            pressed = max(pressed, x[2] - task.p[2])
        lowest.append(task.p[2])
        if task.phase == CONTACT:
            break
    assert task.phase == CONTACT and x[2] == pytest.approx(HEIGHT, abs=2e-3)
    assert task.extra == pytest.approx(0.006)  # 4 mm of clearance, and two steps of 3.
    # It went up after each of the two misses, not along the table.
    low = np.array(lowest) < 0.055
    assert np.sum(np.diff(low.astype(int)) == 1) == 3
    # As soon as it notices: it does not press on the object all the way down.
    assert pressed < 0.0125
    # That is not kept for ever: each time that it goes on from a place where it came
    # down well, it takes some of it back.
    for go, extra in ((2, 0.005), (3, 0.004)):
        task = replace(task, phase=CONTACT)
        task = next_push(
            config, task, shape, 0.0125, x, True, in_object, go, HEIGHT, 0.004
        )
        assert task.phase == TRAVEL and task.extra == pytest.approx(extra)
    for k in range(20):
        task = replace(task, phase=CONTACT)
        task = next_push(
            config, task, shape, 0.0125, x, True, in_object, 4 + k, HEIGHT, 0.004
        )
    assert task.extra == 0.0


@pytest.mark.parametrize(("moves", "learned"), [(0.003, 0.0), (0.0, 0.003)])
def test_a_place_that_the_object_came_nearer_to_is_reached(planner, moves, learned):
    """While the tip travels the object still moves, by less than would make the place
    another, or is learned to reach farther out: what is left of the 4 mm is too little
    for a way along the table."""
    shape, config = planner[2], PushConfig()
    x = state([0.35, 0.0, 0.1], (0.5, 0.0, 0.3))
    place = places_of(planner)[0][0, :2]
    in_object = to_object(x, place)
    outline = outline_at((0.5, 0.0, 0.3))
    task = PushState(WAIT, x[P_TIP].copy(), np.zeros(3), np.zeros(3))
    nearer = 0.0
    for k in range(800):
        if k == 4:  # The place is held by now.
            assert task.place is not None
            x[P_BALL.start : P_BALL.start + 2] -= (
                moves * inward(place[None], outline)[0]
            )
            in_object, nearer = to_object(x, place), learned
            outline = outline_at((*x[P_BALL][:2], 0.3))
        task = next_push(
            config, task, shape, 0.0125, x, True, in_object, 1, HEIGHT, 0.004, nearer
        )
        x[P_TIP] = task.p
        if task.phase == CONTACT:
            break
    assert task.phase == CONTACT
    near = distance_to_outline(task.p[None, :2], outline)[0] - 0.0195
    assert near >= 0.002 + nearer - 1.5e-3  # As near as a tip counts as arrived.


@pytest.mark.parametrize("off", [[0.02, 0.0, 0.0], [0.0, 0.0, 0.02]])
def test_a_place_that_is_not_reached_does_not_keep_the_tip_for_ever(planner, off):
    """The arm stays 20 mm beside its place, or 20 mm above it, whatever it does."""
    shape, config = planner[2], PushConfig()
    x = state([0.35, 0.0, 0.1], (0.5, 0.0, 0.3))
    in_object = to_object(x, places_of(planner)[0][0, :2])
    task = PushState(WAIT, x[P_TIP].copy(), np.zeros(3), np.zeros(3))
    lifts, low = 0, False
    for _ in range(3000):
        task = next_push(
            config, task, shape, 0.0125, x, True, in_object, 1, HEIGHT, 0.004
        )
        x[P_TIP] = task.p + off
        lifts += task.lifting and not low
        low = task.lifting
        if task.phase == CONTACT:
            break
    assert task.phase == CONTACT
    assert lifts == (0 if off[0] else 4)  # As often as it may go 3 mm out.


# The loop, without an arm: the model is the world, of smaller steps.


def test_a_t_is_pushed_to_a_pose_by_changing_contact(planner):
    model, problem, shape = planner
    pairs = contact_pairs(T, 0.5)
    world = AnitescuLcs(make_tip_and_object(T, TIP)[0], pairs, 0.0125)
    goal = np.array([0.53, 0.05, 0.9])
    x = state([0.35, 0.0, 0.1], (0.5, 0.0, 0.3))
    start = errors(x, goal)
    still = np.zeros(3)
    task = PushState(WAIT, x[P_TIP].copy(), still, still)
    memory, warm = SamplingMemory(), problem.cold_start()
    for k in range(480):
        x_desired = target(x, goal, problem.options.N + 1)
        if k % 8 == 0:
            memory, _ = sample_round(
                SamplingConfig(), memory, model.build_many, problem, shape, x,
                x_desired, sum(errors(x, goal)), task.phase == CONTACT, k * 0.0125,
            )  # fmt: skip
        task = next_push(
            PushConfig(), task, shape, 0.0125, x, True, memory.place, memory.go, HEIGHT,
            0.004,
        )  # fmt: skip
        if task.phase == CONTACT:
            plan, warm = solve_c3(
                model.build(x, np.zeros(3)), x, x_desired, problem, warm
            )
            x, _ = simulate(world.build(x, np.zeros(3)), x, plan.u[0])
        else:
            x[P_TIP], x[10:13], x[V_BALL] = task.p, task.v, 0.0
            x[13:16] = 0.0
        # Sliding contacts of this model open: the object is put back on the table.
        yaw = heading(x[Q_BALL])
        x[Q_BALL], x[9] = turned(yaw), rest_height(T)
        x[13:15], x[18] = 0.0, 0.0
    length, angle = errors(x, goal)
    assert start[0] > 0.05 and start[1] > 0.5
    assert length < 0.02 and angle < 0.1
    assert memory.go >= 1


# The system.


def system_of(planner, x, x_desired=None, goal=(0.55, 0.02, 0.6), phase=TRAVEL):
    model, problem, shape = planner
    builder = DiagramBuilder()
    sampler = builder.AddSystem(
        ContactSampler(ContactSamplerConfig(), model, problem, shape)
    )
    if x_desired is None:
        x_desired = target(x, goal, problem.options.N + 1)
    values = dict(
        x=x, x_desired=np.ravel(x_desired), goal=np.array(goal), phase=[float(phase)],
        valid=[1.0],
    )  # fmt: skip
    for name, value in values.items():
        source = builder.AddSystem(ConstantVectorSource(np.array(value, dtype=float)))
        source.set_name(name)
        builder.Connect(source.get_output_port(), sampler.GetInputPort(name))
    diagram = builder.Build()
    return diagram, sampler


def outputs(diagram, sampler, context):
    own = sampler.GetMyContextFromRoot(context)
    return (
        sampler.GetOutputPort("command").Eval(own),
        sampler.GetOutputPort("status").Eval(own)[0],
    )


def test_the_system_gives_the_place_of_the_round_and_holds_it_for_bad_input(planner):
    x, _ = places_of(planner)
    diagram, sampler = system_of(planner, x[0])
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    command, status = outputs(diagram, sampler, context)
    assert command[0] == 0.0 and status == SamplerStatus.NONE_YET
    simulator.AdvanceTo(0.05)
    memory, _ = rounds(planner, x[0], [0.55, 0.02, 0.6], 1, in_contact=False)
    command, status = outputs(diagram, sampler, context)
    assert status == SamplerStatus.CHOSEN
    # The target's goal counts an angle by its radius there, by one metre here: both
    # are the first round's, which progress does not matter to.
    np.testing.assert_array_equal(command, [1.0, *memory.place])
    bad = {"x": 7, "goal": 0, "x_desired": 3, "valid": 0}
    for name, entry in bad.items():
        source = diagram.GetSubsystemByName(name)
        own = source.GetMyMutableContextFromRoot(context)
        value = source.get_source_value(own).value().copy()
        wrong = value.copy()
        wrong[entry] = 0.0 if name == "valid" else np.nan
        source.get_mutable_source_value(own).SetFromVector(wrong)
        simulator.AdvanceTo(context.get_time() + 0.1)
        held, status = outputs(diagram, sampler, context)
        np.testing.assert_array_equal(held, command)
        expected = SamplerStatus.NOT_SEEN if name == "valid" else (
            SamplerStatus.NOT_FINITE
        )  # fmt: skip
        assert status == expected
        source.get_mutable_source_value(own).SetFromVector(value)
    simulator.AdvanceTo(context.get_time() + 0.1)
    assert outputs(diagram, sampler, context)[1] == SamplerStatus.CHOSEN


def test_a_model_that_fails_leaves_the_place_as_it_is(planner):
    model, problem, shape = planner
    x, _ = places_of(planner)
    diagram, sampler = system_of(planner, x[0])
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.05)
    context = simulator.get_mutable_context()
    before, _ = outputs(diagram, sampler, context)

    class Broken:
        n_x, n_u, n_lam, dt_sec = model.n_x, model.n_u, model.n_lam, model.dt_sec

        def build_many(self, x, u):
            return tuple(np.full_like(a, np.nan) for a in model.build_many(x, u))

    sampler._model = Broken()
    simulator.AdvanceTo(0.15)
    after, status = outputs(diagram, sampler, context)
    np.testing.assert_array_equal(after, before)
    assert status == SamplerStatus.NO_PLAN


def test_a_context_replays_the_same_choices(planner):
    x, _ = places_of(planner)
    diagram, sampler = system_of(planner, x[0])
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.15)
    saved = simulator.get_context().Clone()
    simulator.AdvanceTo(0.45)
    one = outputs(diagram, sampler, simulator.get_context())
    again = Simulator(diagram, saved)
    again.AdvanceTo(0.45)
    two = outputs(diagram, sampler, again.get_context())
    np.testing.assert_array_equal(one[0], two[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"places": 0}, "sampling.places is 0"),
        ({"clearance": 0.0}, "sampling.clearance is 0.0"),
        ({"change": ChangeConfig(-1.0)}, "sampling.change.travel is -1.0"),
        ({"change": ChangeConfig(hysteresis=[1.0, 0.0])}, "sampling.change.hysteresis"),
        ({"reach": ReachConfig([0.5, 0.4])}, "sampling.reach.range"),
        ({"reach": ReachConfig(cost=-1.0)}, "sampling.reach.cost is -1.0"),
        ({"reach": ReachConfig(inwards=-0.1)}, "sampling.reach.inwards is -0.1"),
    ],
)
def test_a_setting_out_of_range_is_named(planner, change, message):
    config = ContactSamplerConfig(SamplingConfig(**change))
    with pytest.raises(ValueError, match=message):
        ContactSampler(config, *planner)


@pytest.mark.parametrize(
    ("x", "y", "inside"),
    [
        (0.40, 0.0, True), (0.75, 0.0, True), (0.3999, 0.0, False),
        (0.7501, 0.0, False), (0.0, 0.5, False), (-0.5, 0.0, False),
        # 1.0 rad to either side of x, a hair within it and beyond.
        (0.5 * np.cos(0.999), 0.5 * np.sin(0.999), True),
        (0.5 * np.cos(0.999), -0.5 * np.sin(0.999), True),
        (0.5 * np.cos(1.001), 0.5 * np.sin(1.001), False),
        (0.5 * np.cos(1.001), -0.5 * np.sin(1.001), False),
    ],
)  # fmt: skip
def test_a_place_is_in_reach_within_two_radii_and_a_bearing(x, y, inside):
    found = in_reach(np.array([[0.5, 0.1], [x, y]]), [0.40, 0.75], 1.0)
    assert found.tolist() == [True, inside]


def test_it_is_the_wrist_that_may_not_be_too_near():
    wrist = [0.065, 0.11]
    near, aside, beyond = [0.38, 0.12], [0.38, -0.1], [0.1, 0.79]
    found = in_reach(np.array([near, aside, beyond]), [0.32, 0.78], 2.0, wrist)
    np.testing.assert_array_equal(found, [False, True, False])

"""The velocity shaper: arrival speed, smoothness, events, statuses, bad input."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource
from scipy.spatial.transform import Rotation

from makebreak.systems.changing_contact.numerics.contact_regions import (
    REGIONS,
    REGIONS_MAX,
    expected,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    BAD_INPUT,
    BROKEN,
    BROKEN_ROW,
    CONTACT_MISSING,
    CONTACT_UNEXPECTED,
    DIRECTION,
    DONE,
    ENTER,
    HOLD,
    IMPACT,
    IMPACTLESS,
    MADE,
    MOVE,
    NO_CONTACT,
    REGION,
    REGION_COVERS_PATH,
    SETTLE,
    SPEED_FLOOR,
    STATUS,
    ContactBelief,
    ExpectedContact,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    Segment,
    load_pattern,
)
from makebreak.systems.changing_contact.numerics.path_geometry import path_point
from makebreak.systems.changing_contact.numerics.shaped_reference import pose_output
from makebreak.systems.changing_contact.numerics.shaper_memory import N_MEMORY
from makebreak.systems.changing_contact.numerics.velocity_shaper import plan, tick
from makebreak.systems.changing_contact.velocity_shaper import (
    RegionConfig,
    SearchConfig,
    VelocityShaper,
    VelocityShaperConfig,
    _law,
)

PATTERNS = Path(__file__).resolve().parent.parent / "models" / "patterns"
DOWN, LEFT, AHEAD = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
DT, V_A = 1e-3, 0.03
LAW = _law(VelocityShaperConfig())
FADES = LAW._replace(release_sec=1.0)
# Sixth-order central difference.
WEIGHTS = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60.0


def contact(mean, direction, segment, sigma=0.01, speed=V_A, kind=IMPACT):
    C = sigma**2 * np.eye(3)
    return ExpectedContact(np.array(mean), C, direction, kind, segment, speed)


THREE = load_pattern(PATTERNS / "three_contacts.yaml")
BELIEF = ContactBelief((
    contact([0.4, -0.15, 0.08], DOWN, 0),
    contact([0.4, 0.15, 0.08], LEFT, 1),
    contact([0.58, 0.15, 0.08], AHEAD, 2),
))  # fmt: skip
WORLD = ((0, DOWN, -0.085), (1, LEFT, 0.147), (2, AHEAD, 0.585))  # p.d of each surface.
LINE = MotionPattern((Segment("line", [[0, 0, 0.3], [0.5, 0, 0.3]], (0.0, 3.5)),))


class Log:
    def __init__(self, rows, memory):
        self.t, self.X, self.tangent, self.n, self.targets, self.phase = (
            np.array(column) for column in zip(*rows, strict=True)
        )
        self.p, self.v, self.a = self.X[:, 0, :3], self.X[:, 1, :3], self.X[:, 2, :3]
        self.segment, self.stage, self.kind = self.phase[:, :3].T.astype(int)
        self.speed, self.s = self.phase[:, 3], self.phase[:, 4]
        self.status = self.phase[:, 5].astype(int)
        self.memory = memory


def follow(
    pattern, belief, world=(), law=LAW, seconds=15.0, change=None, feel=None, pose=None
):
    """The shaper in a world of planes: (segment, direction, p.d); contact is told a
    millisecond after the reference meets one. `change(t, belief)` is the belief then;
    `feel(t, contact, log)` may edit the contact vector; `pose(t, p)` is measured."""
    memory, felt, rows, waiting = np.zeros(N_MEMORY), np.zeros(14), [], list(world)
    regions = None
    for i in range(round(seconds / DT)):
        t = i * DT + 1e-4
        if i % 10 == 0:
            now = belief if change is None else change(t, belief)
            regions = plan(pattern.table, law, memory, t, expected(now))
        measured = np.zeros(7)
        if rows:
            measured[:3] = rows[-1][1][0, :3]
            measured[:3] = measured[:3] if pose is None else pose(t, measured[:3])
        if feel is not None:
            felt = feel(t, felt.copy(), rows)
        result = tick(pattern.table, law, regions, memory, t, felt, measured)
        rows.append((t, *result))
        X, phase = result[0], result[4]
        if waiting and phase[0] == waiting[0][0]:
            _, d, where = waiting[0]
            if X[0, :3] @ d >= where:
                waiting.pop(0)
                felt = felt.copy()
                felt[MADE] += 1
                felt[DIRECTION] = d
        if phase[1] == DONE:
            break
    return Log(rows, memory)


@pytest.fixture(scope="module")
def three():
    return follow(THREE, BELIEF, WORLD)


def entry(c, law=LAW):
    """Where region c begins, along its direction [m]."""
    sigma = np.sqrt(c.direction @ c.covariance @ c.direction)
    before = law.sigmas * sigma + law.margin + law.settle_sec * c.approach_speed
    return c.mean @ c.direction - before


# --- Arrival.


def test_it_arrives_at_each_region_with_v_a_exactly_and_keeps_it_until_the_contact(
    three,
):
    for c, (segment, d, where) in zip(BELIEF.contacts, WORLD, strict=True):
        x = three.p @ d
        inside = (three.segment == segment) & (x >= entry(c)) & (x < where)
        assert inside.sum() > 100
        assert abs(three.speed[inside] - V_A).max() < 1e-9
        # It does not creep for longer than it must: 5 mm before it is faster.
        before = (three.segment == segment) & (x < entry(c) - 5e-3)
        assert three.speed[before][-1] > V_A + 1e-3


def test_away_from_regions_the_speed_is_the_patterns(three):
    for segment in range(3):
        assert three.speed[three.segment == segment].max() == pytest.approx(
            THREE.speed(segment), abs=1e-12
        )
    assert three.stage[-1] == DONE and three.status[-1] == 0


@pytest.mark.parametrize("v_n, v_a", [(0.05, 0.01), (0.1, 0.03), (0.25, 0.05)])
def test_speed_falls_monotonely_within_a_max_before_a_region(v_n, v_a):
    T = 0.4 / v_n + v_n
    pattern = MotionPattern((
        Segment("line", [[0, 0, 0.5], [0, 0, 0.1]], (0, T)),
        Segment("line", [[0, 0, 0.1], [0.1, 0, 0.1]], (T, T + 2),
                force_directions=[DOWN], force_targets=[5]),
    ))  # fmt: skip
    log = follow(pattern, ContactBelief((contact([0, 0, 0.2], DOWN, 0, speed=v_a),)))
    first = log.segment == 0
    peak = np.argmax(log.speed)
    near = log.p[:, 2] > 0.19
    falling = log.speed[peak : np.flatnonzero(near)[-1]]
    assert np.all(np.diff(falling) <= 1e-15)
    assert falling[-1] == pytest.approx(v_a, abs=1e-12)
    assert np.linalg.norm(log.a[first], axis=1).max() <= LAW.acceleration_max * (
        1 + 1e-9
    )


# --- Smoothness and geometry.


def test_the_path_is_not_left_while_only_the_speed_changes():
    for pattern in (
        LINE,
        MotionPattern((Segment("arc", [[0.5, 0, 0.1], [0.4, 0.1, 0.1], [0.3, 0, 0.1]],
                               (0, 4)),)),
        MotionPattern((Segment("spline", [[0.5, 0.2, 0.1], [0.5, 0.1, 0.12],
                                          [0.45, 0.05, 0.1]], (0, 3)),)),
    ):  # fmt: skip
        middle = pattern.geometry(0, 0.6 * pattern.length(0))
        belief = ContactBelief((contact(middle[0], middle[1], 0),))
        log = follow(pattern, belief)
        assert log.speed.min() >= 0.0 and log.stage[-1] == DONE
        slow = (log.stage == REGION) & (abs(log.speed - V_A) < 1e-12)
        assert slow.sum() > 100
        for p, s in zip(log.p[::50], log.s[::50], strict=True):
            # The path at that arc length: the nearest point is no farther.
            assert np.linalg.norm(p - pattern.geometry(0, s)[0]) < 1e-12


def test_velocity_and_acceleration_are_derivatives_across_all_changes_of_speed(three):
    X, h = three.X, DT
    # Across every contact too, but for the last: there a force direction is dropped.
    n = np.flatnonzero(three.segment == 3)[0] - 3
    slope = (
        sum(
            w * X[3 + j : n - 3 + j] for j, w in zip(range(-3, 4), WEIGHTS, strict=True)
        )
        / h
    )
    # Error h^6 x^(7) / 140: steps of 50 ms at 3 cm/s have x^(7) up to 1e7 m/s7.
    np.testing.assert_allclose(slope[:, 0], X[3 : n - 3, 1], atol=1e-7)
    np.testing.assert_allclose(slope[:, 1], X[3 : n - 3, 2], atol=1e-4)


def test_no_jump_in_jerk_at_any_join(three):
    n = np.flatnonzero(three.segment == 3)[0]
    jerk = np.diff(three.a[:n], axis=0) / DT
    # Between ticks jerk changes by snap x 1 ms: at most 111 dv/T^3 = 1.1e4 m/s4 for the
    # shortest step (0.05 s); a jump would be a_max / 1 ms = 900 m/s3.
    assert abs(np.diff(jerk, axis=0)).max() < 30.0


def test_a_belief_that_changes_while_the_speed_changes_keeps_it_smooth():
    def change(t, belief):  # The contact wanders by 3 cm to and fro, and v_a with it.
        shift = 0.03 * np.sin(4.0 * t)
        return ContactBelief((contact([0.35 + shift, 0, 0.3], AHEAD, 0,
                                      speed=0.03 + 0.01 * np.sin(7 * t)),))  # fmt: skip

    log = follow(LINE, BELIEF, change=change, seconds=12)
    v = np.gradient(log.p, DT, axis=0)
    # Second-order differences: error h^2 x''' / 6 < 1e-6 * 111.
    np.testing.assert_allclose(v[1:-1], log.v[1:-1], atol=2e-5)
    assert log.speed.min() >= -1e-12
    assert abs(np.diff(log.a[:, 0], n=2)).max() / DT < 40.0
    assert log.stage[-1] == DONE


def test_a_step_down_that_begins_within_a_longer_step_up_never_turns_the_motion_back():
    covers = contact([0.3, 0, 0.3], AHEAD, 0, sigma=0.2, speed=0.1)

    def change(t, belief):  # Up to 0.15 m/s takes 0.33 s; down to 0.1 would take 0.11.
        return ContactBelief((covers,) if t > 0.02 else ())

    log = follow(LINE, BELIEF, change=change, seconds=1)
    assert log.speed.min() >= 0.0 and np.all(np.diff(log.p[:, 0]) >= 0.0)
    assert log.speed[-1] == pytest.approx(0.1, abs=1e-12)


def test_quaternion_angular_velocity_and_acceleration_are_consistent():
    turn = Rotation.from_rotvec([0.3, -0.5, 0.8]) * Rotation.from_quat([1, 0, 0, 0])
    q = [[0, 1, 0, 0], turn.as_quat(scalar_first=True)]
    pattern = MotionPattern((
        Segment("line", [[0, 0, 0.3], [0.3, 0, 0.3]], (0, 3), q),
    ))  # fmt: skip
    log = follow(pattern, ContactBelief((contact([0.2, 0, 0.3], AHEAD, 0),)))
    x = np.array([pose_output(X, pattern.base) for X in log.X])
    R = Rotation.from_quat(x[:, 3:7], scalar_first=True)
    w = (R[2:] * R[:-2].inv()).as_rotvec() / (2 * DT)
    np.testing.assert_allclose(w, x[1:-1, 10:13], atol=1e-4)  # h^2 / 6 of its jerk.
    alpha = (x[2:, 10:13] - x[:-2, 10:13]) / (2 * DT)
    np.testing.assert_allclose(alpha, x[1:-1, 16:19], atol=1e-2)


# --- Stages.


def test_the_blend_is_over_when_the_region_begins(three):
    for segment, c in enumerate(BELIEF.contacts):
        here = np.flatnonzero(three.segment == segment)
        enter = here[three.stage[here] == ENTER]
        assert len(enter) == pytest.approx(LAW.blend_sec / DT, abs=3)
        arrives = three.p[enter[-1]] @ c.direction
        assert arrives == pytest.approx(entry(c), abs=3 * DT * V_A)
        assert set(three.kind[enter]) == {IMPACT}
        after = three.stage[here[-1] + 1 : here[-1] + 1 + round(LAW.blend_sec / DT) - 1]
        assert set(after) == {SETTLE}


def test_an_impactless_change_is_reported_and_not_slowed():
    belief = ContactBelief((contact([0.25, 0, 0.3], AHEAD, 0, kind=IMPACTLESS),))
    log = follow(LINE, belief)
    plain = follow(LINE, ContactBelief())
    np.testing.assert_array_equal(log.p, plain.p)
    inside = log.stage == REGION
    half = LAW.sigmas * 0.01 + LAW.margin
    assert set(log.kind[inside]) == {IMPACTLESS}
    assert log.p[inside, 0].min() == pytest.approx(0.25 - half, abs=2e-4)
    assert log.p[inside, 0].max() == pytest.approx(0.25 + half, abs=2e-4)
    order = [
        s for s, before in zip(log.stage, [-1, *log.stage], strict=False) if s != before
    ]
    assert order == [MOVE, ENTER, REGION, SETTLE, MOVE, DONE]


def test_two_contacts_in_one_segment_are_each_slowed_for_and_sped_up_after():
    belief = ContactBelief((contact([0.15, 0, 0.3], AHEAD, 0),
                            contact([0.38, 0, 0.3], AHEAD, 0, speed=0.05)))  # fmt: skip
    log = follow(LINE, belief)
    for c in belief.contacts:
        at = np.argmin(abs(log.p[:, 0] - c.mean[0]))
        assert log.speed[at] == pytest.approx(c.approach_speed, abs=1e-9)
        assert log.stage[at] == REGION
    between = (log.p[:, 0] > 0.2) & (log.p[:, 0] < 0.33)
    assert log.speed[between].max() > 0.12


# --- Contact events.


def test_after_a_contact_the_next_segment_starts_at_once_from_where_it_is(three):
    for segment in range(1, 4):
        first = np.flatnonzero(three.segment == segment)[0]
        step = np.linalg.norm(three.p[first] - three.p[first - 1])
        assert step <= V_A * DT * 1.01
        assert three.tangent[first] @ (
            THREE.geometry(segment, 0.0)[1]
        ) == pytest.approx(1)
        assert three.s[first] == 0.0
    n = three.n[three.segment == 2][-1].reshape(2, 3)
    np.testing.assert_array_equal(n, [DOWN, LEFT])


def test_the_pattern_stays_shifted_by_what_its_contacts_have_taught(three):
    last = three.segment == 3
    # The first wall came 2.3 cm before the plan; then 10 cm back.
    at_wall = three.p[~last][-1, 1]
    assert three.p[last][-1, 1] == pytest.approx(at_wall - 0.1, abs=2e-3)


def test_where_the_contact_decides_the_offset_stays_and_elsewhere_it_may_fade():
    three = follow(THREE, BELIEF, WORLD, FADES)
    # The table came 3.5 cm early: while it is pressed on, the reference stays there.
    assert three.p[three.segment == 2][-1, 2] == pytest.approx(0.085, abs=2e-3)
    # The first wall, dropped with the last segment: its 2.3 cm fade within the segment.
    last = three.segment == 3
    assert three.p[last][-1, 1] == pytest.approx(0.07, abs=1e-12)


def test_a_released_direction_is_put_to_the_measured_position_and_then_fades():
    pattern = MotionPattern((
        Segment("line", [[0, 0, 0.1], [0.3, 0, 0.1]], (0, 3), force_directions=[DOWN],
                force_targets=[5]),
        Segment("line", [[0.3, 0, 0.1], [0.3, 0.4, 0.1]], (3, 7)),
    ))  # fmt: skip
    log = follow(
        pattern, ContactBelief(), law=FADES, pose=lambda t, p: p + [0, 0, -0.01]
    )
    first = np.flatnonzero(log.segment == 1)[0]
    # The reference feels its own measured offset once, at the release.
    assert log.p[first, 2] == pytest.approx(0.09, abs=1e-9)
    assert log.p[-1, 2] == pytest.approx(0.1, abs=1e-12)
    h = np.diff(log.v[first:, 2]) / DT
    assert abs(h).max() < 0.5 * LAW.acceleration_max + 1e-3
    np.testing.assert_allclose(
        np.diff(log.p[first:, 2]) / DT, log.v[first:-1, 2], atol=1e-3
    )


def loss(at, row=0):
    def feel(t, felt, rows):
        if felt[BROKEN] == 0 and t > at:
            felt[BROKEN], felt[BROKEN_ROW] = 1, row
        return felt

    return feel


WALL = dict(force_directions=[AHEAD], force_targets=[5.0])


@pytest.fixture(scope="module")
def up():
    return MotionPattern((
        Segment("line", [[0.6, 0, 0.05], [0.6, 0, 0.2]], (0.0, 1.2), **WALL),
        Segment("line", [[0.6, 0, 0.2], [0.6, 0, 0.3]], (1.2, 2.1)),
        Segment("line", [[0.6, 0, 0.3], [0.6, 0.2, 0.3]], (2.1, 4.1)),
    ))  # fmt: skip


@pytest.mark.parametrize("at", [0.8, 1.2, 1.5])
def test_the_loss_of_a_contact_starts_the_next_segment_without_a_stop(at, up):
    log = follow(up, ContactBelief(), law=FADES, feel=loss(at))
    first = np.flatnonzero(log.segment == 1)[0]
    assert log.t[first] == pytest.approx(at, abs=2 * DT)
    np.testing.assert_allclose(log.speed[first], log.speed[first - 1], atol=1e-3)
    np.testing.assert_array_equal(log.n[first], 0.0)
    assert log.stage[-1] == DONE and log.status[-1] == 0
    np.testing.assert_allclose(log.p[-1], [0.6, 0.2, 0.3], atol=1e-12)


def test_a_loss_that_does_not_come_is_waited_for_up_to_the_limit(up):
    log = follow(up, ContactBelief())
    first = np.flatnonzero(log.segment == 1)[0]
    assert log.p[first, 2] == pytest.approx(0.2 + LAW.search_max, abs=1e-3)


SLIDE = MotionPattern((
    Segment("line", [[0, 0, 0.1], [0.3, 0, 0.1]], (0, 3), force_directions=[DOWN],
            force_targets=[5]),
    Segment("line", [[0.3, 0, 0.1], [0.3, 0.2, 0.1]], (3, 5),
            force_directions=[DOWN, AHEAD], force_targets=[5, 5]),
))  # fmt: skip


def off_the_edge(t, p):
    """Measured: pressed down at 12 mm/s from 1 s on, to where something is at 2 s."""
    return [p[0], 0, 0.1 - 0.012 * np.clip(t - 1.0, 0, 1)]


def test_a_contact_lost_on_the_way_is_held_after_5_mm_until_it_is_felt_again():
    def feel(t, felt, rows):
        felt[BROKEN], felt[MADE] = t > 1.0, t > 2.0
        return felt

    log = follow(SLIDE, ContactBelief(), feel=feel, pose=off_the_edge, seconds=2.5)
    pressed = log.t < 1.0 + 0.005 / 0.012 - 0.01
    np.testing.assert_array_equal(log.n[pressed][:, 2], -1.0)
    lost = (log.t > 1.0 + 0.005 / 0.012 + 0.01) & (log.t < 2.0)
    np.testing.assert_array_equal(log.n[lost], 0.0)
    np.testing.assert_array_equal(log.targets[lost], 0.0)
    np.testing.assert_allclose(log.p[lost, 2], 0.095, atol=1e-4)
    assert set(log.status[lost]) == {CONTACT_MISSING}
    again = log.t > 2.01
    np.testing.assert_array_equal(log.n[again][:, 2], -1.0)
    assert set(log.status[again]) == {0} and log.segment[-1] == 0


def test_a_bounce_does_not_end_the_pressing_nor_hide_the_next_contact():
    def feel(t, felt, rows):  # Off the table for a moment; then the wall.
        felt[BROKEN], felt[MADE], felt[DIRECTION] = t > 1.0, t > 1.3, AHEAD
        return felt

    log = follow(SLIDE, ContactBelief(), feel=feel, seconds=1.5)
    np.testing.assert_array_equal(log.n[:, 2], -1.0)
    assert log.segment[-1] == 1 and set(log.status) == {0}


def test_the_next_contact_counts_while_another_one_is_lost():
    def feel(t, felt, rows):
        felt[BROKEN], felt[MADE], felt[DIRECTION] = t > 1.0, t > 1.8, AHEAD
        return felt

    log = follow(SLIDE, ContactBelief(), feel=feel, pose=off_the_edge, seconds=2)
    assert log.segment[-1] == 1 and log.status[-1] == 0


def test_an_echo_of_the_last_contact_does_not_end_the_next_segment():
    def feel(t, felt, rows):
        if rows and rows[-1][5][0] == 1 and felt[MADE] == 1:
            felt[MADE], felt[DIRECTION] = 2, DOWN  # The tool bounces on the table.
        return felt

    log = follow(THREE, BELIEF, WORLD[:1], feel=feel, seconds=4)
    assert log.segment[-1] == 1 and log.status[-1] == 0


# --- Statuses and holds.


def test_a_missing_contact_is_searched_for_at_v_a_and_then_held():
    log = follow(THREE, BELIEF)
    assert log.stage[-1] == HOLD and log.status[-1] == CONTACT_MISSING
    assert log.p[-1, 2] == pytest.approx(0.05 - LAW.search_max, abs=1e-9)
    beyond = (log.p[:, 2] < 0.05) & (log.p[:, 2] > 0.05 - LAW.search_max + 5e-3)
    np.testing.assert_allclose(log.speed[beyond], V_A, atol=1e-12)
    np.testing.assert_array_equal(log.v[-1], 0.0)


def test_without_a_belief_the_search_goes_at_its_own_speed():
    log = follow(THREE, ContactBelief())
    beyond = (log.p[:, 2] < 0.049) & (log.p[:, 2] > 0.05 - LAW.search_max + 5e-3)
    np.testing.assert_allclose(log.speed[beyond], LAW.search_speed, atol=1e-12)
    assert log.stage[-1] == HOLD and log.status[-1] == CONTACT_MISSING


@pytest.mark.parametrize("go_on", [False, True])
def test_an_unexpected_contact_stops_it_smoothly_unless_told_to_go_on(go_on):
    law = LAW._replace(go_on_unexpected=go_on)
    log = follow(LINE, ContactBelief(), ((0, AHEAD, 0.2),), law)
    assert log.status[-1] == CONTACT_UNEXPECTED
    assert log.stage[-1] == (DONE if go_on else HOLD)
    assert np.linalg.norm(log.a, axis=1).max() <= LAW.acceleration_max * (1 + 1e-9)
    if not go_on:  # v^2 / a_max further on.
        stop = 0.2 + LINE.speed(0) ** 2 / LAW.acceleration_max
        assert log.p[-1, 0] == pytest.approx(stop, abs=2e-3 * LINE.speed(0))


def test_a_region_that_covers_the_path_is_gone_through_at_v_a_from_the_start():
    log = follow(THREE, ContactBelief((contact([0.4, -0.15, 0.2], DOWN, 0, 0.1),)),
                 WORLD[:1], seconds=7)  # fmt: skip
    first = log.segment == 0
    assert log.speed[first].max() == pytest.approx(V_A, abs=1e-12)
    assert np.all(log.status[first] & REGION_COVERS_PATH)
    assert not np.any(log.status[~first] & REGION_COVERS_PATH)
    enter = np.flatnonzero(log.stage == ENTER)
    assert len(enter) == pytest.approx(LAW.blend_sec / DT, abs=2)


@pytest.mark.parametrize("speed", [0.0, -1.0, np.nan])
def test_a_v_a_that_is_no_speed_is_raised_to_the_least_and_said_so(speed):
    belief = ContactBelief((contact([0.4, -0.15, 0.08], DOWN, 0, speed=speed),))
    log = follow(THREE, belief, seconds=2)
    assert np.all(log.status & SPEED_FLOOR)
    assert log.speed[-1] == pytest.approx(LAW.speed_min, abs=1e-12)


def test_a_v_a_above_the_patterns_speed_changes_nothing():
    belief = ContactBelief((contact([0.25, 0, 0.3], AHEAD, 0, speed=5.0),))
    np.testing.assert_array_equal(
        follow(LINE, belief).p, follow(LINE, ContactBelief()).p
    )


@pytest.mark.parametrize("fault", ["nan", "status"])
def test_while_the_force_sensor_fails_the_motion_pauses(fault):
    def feel(t, felt, rows):
        felt[:] = np.nan if fault == "nan" and 1.0 < t < 1.5 else 0.0
        felt[STATUS] = felt[0] if fault == "nan" else float(1.0 < t < 1.5)
        return felt

    log = follow(LINE, ContactBelief(), feel=feel)
    assert np.all(np.isfinite(log.X))
    paused = (log.t > 1.01) & (log.t < 1.5)
    assert set(log.stage[paused]) == {HOLD} and set(log.status[paused]) == {BAD_INPUT}
    assert log.speed[log.t < 1.49][-1] == 0.0
    assert log.stage[-1] == DONE and log.status[-1] == 0
    np.testing.assert_allclose(log.p[-1], [0.5, 0, 0.3], atol=2e-3)


def test_a_pose_that_is_nan_at_a_release_is_not_used(up):
    log = follow(up, ContactBelief(), feel=loss(0.8), pose=lambda t, p: p * np.nan)
    assert np.all(np.isfinite(log.X)) and log.stage[-1] == DONE


def test_more_contacts_than_there_is_room_for_and_foreign_segments_are_told():
    many = tuple(contact([0.01 * i, 0, 0.3], AHEAD, 0) for i in range(REGIONS_MAX + 1))
    log = follow(LINE, ContactBelief(many), seconds=0.1)
    assert np.all(log.status & BAD_INPUT)
    log = follow(LINE, ContactBelief((contact([0, 0, 0.3], AHEAD, 7),)), seconds=0.1)
    assert np.all(log.status & BAD_INPUT)


def test_a_contact_that_the_path_does_not_approach_has_no_region():
    belief = ContactBelief((contact([0.2, 0, 0.3], -AHEAD, 0),
                            contact([0.2, 0, 0.3], LEFT, 0)))  # fmt: skip
    log = follow(LINE, belief)
    np.testing.assert_array_equal(log.p, follow(LINE, ContactBelief()).p)
    assert set(log.kind) == {NO_CONTACT}


@pytest.mark.parametrize(
    "kind, points",
    [
        ("arc", [[0.5, 0.2, 0.1], [0.55, 0.1, 0.1], [0.5, 0.0, 0.1]]),
        ("spline", [[0.5, 0.2, 0.1], [0.5, 0.1, 0.12], [0.4, 0.0, 0.05]]),
    ],
)
def test_a_region_on_a_bent_path_reaches_as_far_from_the_contact_as_on_a_line(
    kind, points
):
    pattern = MotionPattern((Segment(kind, points, (0.0, 4.0)),))
    for share in (0.4, 0.6, 0.8):
        at = path_point(pattern.table, 0, share * pattern.length(0))
        mean, d = at[0, :3], at[1, :3]
        belief = ContactBelief((contact(mean, d, 0, sigma=0.004),))
        memory = np.zeros(N_MEMORY)
        regions = plan(pattern.table, LAW, memory, 0.0, expected(belief))
        region = regions.view(REGIONS)[0]["rows"][0]
        half = LAW.sigmas * 0.004 + LAW.margin
        for s, off in (
            (region["entry"], -half - V_A * LAW.settle_sec),
            (region["leave"], half),
        ):
            found = (path_point(pattern.table, 0, s)[0, :3] - mean) @ d
            assert found == pytest.approx(off, abs=1e-9)


# --- The system.


def diagram(pattern, belief, motion=None, **config):
    builder = DiagramBuilder()
    shaper = builder.AddSystem(VelocityShaper(VelocityShaperConfig(**config), pattern))
    sources = {
        "contacts": ConstantValueSource(AbstractValue.Make(belief)),
        "contact": ConstantVectorSource(np.zeros(14)),
        "ee_pose": ConstantVectorSource(np.zeros(7)),
    }
    for name, source in sources.items():
        builder.AddSystem(source)
        builder.Connect(source.get_output_port(0), shaper.GetInputPort(name))
    if motion is not None:
        builder.ExportInput(shaper.GetInputPort("motion"), "motion")
    return builder.Build(), shaper


def test_the_system_gives_what_the_numerics_give():
    built, shaper = diagram(LINE, ContactBelief((contact([0.3, 0, 0.3], AHEAD, 0),)))
    simulator = Simulator(built)
    context = shaper.GetMyContextFromRoot(simulator.get_context())
    at_start = shaper.GetOutputPort("x_desired").Eval(context)
    np.testing.assert_allclose(at_start[:7], [0, 0, 0.3, 1, 0, 0, 0], atol=1e-15)
    np.testing.assert_array_equal(at_start[7:], 0.0)
    belief = ContactBelief((contact([0.3, 0, 0.3], AHEAD, 0),))
    rows = expected(belief)
    memory = np.zeros(N_MEMORY)
    for i in range(2000):
        t = i * DT
        if i % 10 == 0:
            regions = plan(LINE.table, LAW, memory, t, rows)
        X, *_, phase = tick(
            LINE.table, LAW, regions, memory, t, np.zeros(14), np.zeros(7)
        )
    simulator.AdvanceTo(2000 * DT - 0.5 * DT)
    x = shaper.GetOutputPort("x_desired").Eval(context)
    np.testing.assert_array_equal(x, pose_output(X, LINE.base))
    np.testing.assert_array_equal(shaper.GetOutputPort("phase").Eval(context), phase)


def test_a_new_pattern_is_taken_over_smoothly_from_where_it_is_and_at_its_speed():
    built, shaper = diagram(LINE, ContactBelief(), motion=LINE)
    simulator = Simulator(built)
    root = simulator.get_mutable_context()
    port = built.GetInputPort("motion")
    port.FixValue(root, AbstractValue.Make(LINE))
    context = shaper.GetMyContextFromRoot(root)
    output = shaper.GetOutputPort("x_desired")
    rows = []
    for i in range(5000):
        if i in (1000, 1030, 1200):  # The second waits until the first is blended in.
            p = output.Eval(context)[:3]
            goal = [0.6, 0.1 * (i - 900) / 100.0, 0.3]
            new = MotionPattern((Segment("line", [p, goal], (0, 4.0)),))
            port.FixValue(root, AbstractValue.Make(new))
        simulator.AdvanceTo((i + 0.5) * DT)
        rows.append(output.Eval(context))
    x = np.array(rows)
    np.testing.assert_allclose(np.gradient(x[:, :3], DT, axis=0)[1:-1], x[1:-1, 7:10],
                               atol=5e-4)  # fmt: skip
    assert np.linalg.norm(x[999, 7:10] - x[1005, 7:10]) < 1e-3
    # Smooth: no jump in acceleration (one of a_max would be 0.9).
    assert abs(np.diff(x[:, 13:16], axis=0)).max() < 0.1
    assert np.linalg.norm(x[:, 13:16], axis=1).max() < 1.5 * LAW.acceleration_max
    np.testing.assert_allclose(x[-1, :3], goal, atol=1e-3)


@pytest.mark.parametrize(
    "config, message",
    [
        (VelocityShaperConfig(acceleration_max=0.0), "acceleration_max is 0.0"),
        (VelocityShaperConfig(speed_min=np.nan), "speed_min is nan"),
        (VelocityShaperConfig(release_sec=-1.0), "release_sec is -1.0"),
        (
            VelocityShaperConfig(region=RegionConfig(sigmas=-1.0)),
            "region.sigmas is -1.0",
        ),
        (
            VelocityShaperConfig(region=RegionConfig(blend_sec=0)),
            "region.blend_sec is 0",
        ),
        (
            VelocityShaperConfig(search=SearchConfig(speed=np.inf)),
            "search.speed is inf",
        ),
        (VelocityShaperConfig(period_sec=0.0), "period_sec is 0.0"),
    ],
)
def test_bad_numbers_are_refused_by_name(config, message):
    with pytest.raises(ValueError, match=message):
        VelocityShaper(config, LINE)
    with pytest.raises(ValueError, match="plan_sec is 0"):
        VelocityShaper(VelocityShaperConfig(), LINE, 0.0)


@pytest.mark.parametrize("seed", range(8))
def test_pauses_and_contacts_that_move_keep_the_acceleration_within_its_limit(seed):
    """Steps of the speed that begin while others run add up."""
    rng = np.random.default_rng(seed)
    line = Segment("line", [[0, 0, 0.5], [0, 0, 0.0]], (0, 3.0))
    slide = Segment("line", [[0, 0, 0], [0.1, 0, 0]], (3.0, 5.0),
                    force_directions=[DOWN], force_targets=[5])  # fmt: skip
    begins = np.sort(rng.uniform(0.1, 2.5, 3))
    heights, speeds = rng.uniform(0.1, 0.4, 4), rng.uniform(0.01, 0.1, 4)

    def feel(t, f, rows):
        f[STATUS] = float(((begins <= t) & (t < begins + 0.05)).any())
        return f

    def change(t, belief):
        k = int(np.sum(t > begins - 0.04))
        at = [0, 0, heights[k]]
        return ContactBelief((contact(at, DOWN, 0, sigma=0.005, speed=speeds[k]),))

    first = ContactBelief((contact([0, 0, heights[0]], DOWN, 0, sigma=0.005,
                                   speed=speeds[0]),))  # fmt: skip
    log = follow(MotionPattern((line, slide)), first, seconds=4.0, feel=feel,
                 change=change)  # fmt: skip
    along = np.abs(log.a[log.segment == 0][:, 2])
    assert along.max() <= 1.01 * LAW.acceleration_max
    assert along.max() > 0.5 * LAW.acceleration_max


def test_the_largest_curvature_is_how_fast_the_tangent_turns():
    turn = np.deg2rad(160)
    corner = [[0.3, 0, 0.3], [0.5, 0, 0.3],
              [0.5 + 0.2 * np.cos(turn), 0.2 * np.sin(turn), 0.3]]  # fmt: skip
    pattern = MotionPattern((Segment("spline", corner, (0, 20.0)),))
    s = np.linspace(0.0, pattern.length(0), 2000)
    tangents = np.array([pattern.geometry(0, x)[1] for x in s])
    turned = np.linalg.norm(np.gradient(tangents, s, axis=0), axis=1).max()
    # By central differences.
    np.testing.assert_allclose(pattern.largest_curvature(0), turned, rtol=0.02)

"""Motion patterns: geometry by arc length, time, files, demonstrations, bad input."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation, Slerp

from makebreak.systems.changing_contact.numerics.demonstration import (
    pattern_from_demonstration,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    Segment,
    least_time,
    load_pattern,
    pattern_from,
    save_pattern,
    segment_time,
)
from makebreak.systems.changing_contact.numerics.path_geometry import (
    last_parameter,
    length_to,
    path_point,
    place,
)

PATTERNS = Path(__file__).resolve().parent.parent / "models" / "patterns"
DOWN, LEFT = [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]
# Sixth-order central difference.
WEIGHTS = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60.0
POINTS = [[0.5, 0.2, 0.1], [0.5, 0.1, 0.12], [0.45, 0.05, 0.1], [0.4, 0.0, 0.05]]


def turned(degrees, axis=(0.0, 0.0, 1.0)):
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * np.array(axis))
    return turn.as_quat(scalar_first=True)


def one(kind, positions, times=(0.0, 4.0), **more):
    return MotionPattern((Segment(kind, positions, times, **more),))


@pytest.mark.parametrize("kind, points", [("arc", POINTS[:3]), ("spline", POINTS)])
def test_a_place_is_where_the_path_is_at_its_length(kind, points):
    table = one(kind, points).table
    lengths = []
    for w in np.linspace(0.0, last_parameter(table, 0) + 0.05, 60):
        lengths.append(length_to(table, 0, w))
        expected = path_point(table, 0, lengths[-1])[0, :3]
        np.testing.assert_allclose(place(table, 0, w)[:3], expected, atol=1e-13)
    assert (np.diff(lengths) > 0.0).all() and lengths[0] == 0.0


def shapes():
    arc = [[0.5, 0.0, 0.1], [0.4, 0.1, 0.1], [0.3, 0.0, 0.1]]
    quaternions = [turned(a) for a in (0, 10, 40, 60)]
    return {
        "line": one("line", [[0.4, 0, 0.3], [0.5, 0.2, 0.1]]),
        "arc": one("arc", arc, quaternions=[turned(a) for a in (0, 20, 40)]),
        "spline": one("spline", POINTS, quaternions=quaternions),
    }


@pytest.mark.parametrize("kind", ["line", "arc", "spline"])
def test_derivatives_by_arc_length_agree_with_finite_differences(kind):
    pattern, h = shapes()[kind], 1e-3
    for s in np.linspace(0.1, 0.9, 9) * pattern.length(0):
        around = [path_point(pattern.table, 0, s + j * h) for j in range(-3, 4)]
        slope = np.einsum("j,jdx->dx", WEIGHTS, around) / h
        # Error h^6 X^(7) / 140: within a span the spline's is below 1e-6.
        np.testing.assert_allclose(slope[:3], around[3][1:], rtol=1e-6, atol=2e-6)
        assert np.linalg.norm(around[3][1, :3]) == pytest.approx(1.0, abs=1e-14)


def test_an_arc_keeps_its_radius_and_has_the_length_of_its_angle():
    pattern = shapes()["arc"]
    assert pattern.length(0) == pytest.approx(0.1 * np.pi, abs=1e-15)
    for s in np.linspace(-0.1, 0.4, 11):  # Beyond its ends it goes on along the circle.
        point = pattern.geometry(0, s)
        assert np.linalg.norm(point[0] - [0.4, 0, 0.1]) == pytest.approx(0.1, abs=1e-15)
        assert np.linalg.norm(point[2]) == pytest.approx(10.0, abs=1e-12)


def test_a_spline_goes_through_its_points_and_ends_straight():
    pattern = shapes()["spline"]
    L = pattern.length(0)
    dense = np.array([pattern.geometry(0, s)[0] for s in np.linspace(0, L, 4001)])
    for point in POINTS:  # Neighbours are 0.07 mm apart.
        assert np.linalg.norm(dense - point, axis=1).min() < 4e-5
    for s in (1e-7, L - 1e-7):  # Curvature and its slope are 0 at the ends.
        assert np.linalg.norm(pattern.geometry(0, s)[2:], axis=1).max() < 1e-2
    polygon = np.linalg.norm(np.diff(dense, axis=0), axis=1).sum()
    assert L == pytest.approx(polygon, rel=1e-6)


@pytest.mark.parametrize("kind", ["line", "arc", "spline"])
def test_pose_velocity_and_acceleration_are_derivatives_of_each_other(kind):
    pattern, h = shapes()[kind], 2e-3
    for t in np.linspace(0.05, 3.95, 14):
        X = np.array([pattern.pose(t + j * h) for j in range(-3, 4)])
        now = X[3]
        np.testing.assert_allclose(WEIGHTS @ X[:, :3] / h, now[7:10], atol=1e-7)
        np.testing.assert_allclose(WEIGHTS @ X[:, 7:13] / h, now[13:19], atol=2e-6)
        R = Rotation.from_quat(X[:, 3:7], scalar_first=True)
        turn = (R * R[3].inv()).as_rotvec()  # Small, so its slope is w.
        np.testing.assert_allclose(WEIGHTS @ turn / h, now[10:13], atol=1e-7)


def test_orientation_along_a_line_is_slerp():
    q = [turned(0), turned(70, [0.6, 0.0, 0.8])]
    pattern = one("line", [[0.4, 0, 0.3], [0.5, 0.2, 0.1]], quaternions=q)
    slerp = Slerp([0, pattern.length(0)], Rotation.from_quat(q, scalar_first=True))
    for t in np.linspace(0, 4, 9):
        ours = Rotation.from_quat(pattern.pose(t)[3:7], scalar_first=True)
        exact = slerp(min(pattern.along(0, t)[0], pattern.length(0)))
        assert (ours * exact.inv()).magnitude() < 1e-12


def test_segments_take_their_time_and_start_and_end_at_rest():
    for pattern in shapes().values():
        s, v, a = pattern.along(0, 4.0)
        assert s == pytest.approx(pattern.length(0), abs=1e-14)
        assert (v, a) == (pytest.approx(0.0, abs=1e-15), 0.0)
        covered = quad(lambda t, p=pattern: p.along(0, t)[1], 0, 4, limit=200)[0]
        assert covered == pytest.approx(pattern.length(0), abs=1e-9)
        peak = max(abs(pattern.along(0, t)[2]) for t in np.linspace(0, 4, 4001))
        assert peak <= pattern.acceleration_max * (1 + 1e-12)


def test_time_and_speed_of_a_segment_fit():
    for starts, stops in ((True, True), (True, False), (False, False)):
        T = segment_time(0.3, 0.2, 1.0, starts, stops)
        assert T == pytest.approx(0.3 / 0.2 + 0.2 * (starts + stops))
    pattern = one("line", [[0, 0, 0], [0.3, 0, 0]], (0, segment_time(0.3, 0.2, 1.0)))
    assert pattern.speed(0) == pytest.approx(0.2, abs=1e-12)
    with pytest.raises(ValueError, match="too short for 0.2"):
        segment_time(0.01, 0.2, 1.0)


def test_a_segment_that_ends_in_a_contact_is_not_slowed_down_for_it():
    pattern = load_pattern(PATTERNS / "three_contacts.yaml")
    assert [pattern.ends_in_contact(k) for k in range(4)] == [True, True, True, False]
    assert not any(pattern.ends_in_loss(k) for k in range(4))
    end = pattern.segments[0].times[1]
    s, v, _ = pattern.along(0, end)
    assert (s, v) == (pytest.approx(0.2), pytest.approx(pattern.speed(0)))
    assert pattern.along(3, 5.4)[1] == pytest.approx(0.0, abs=1e-15)


def up_and_over():
    wall = dict(force_directions=[[1, 0, 0]], force_targets=[5.0])
    return MotionPattern((
        Segment("line", [[0.6, 0, 0.05], [0.6, 0, 0.2]], (0.0, 1.0), **wall),
        Segment("line", [[0.6, 0, 0.2], [0.6, 0, 0.3]], (1.0, 1.8)),
        Segment("line", [[0.6, 0, 0.3], [0.6, 0.2, 0.3]], (1.8, 3.8)),
    ))  # fmt: skip


def test_a_direction_dropped_on_a_line_that_goes_on_ends_in_a_loss_without_a_stop():
    pattern = up_and_over()
    assert [pattern.ends_in_loss(k) for k in range(3)] == [True, False, False]
    assert not any(pattern.ends_in_contact(k) for k in range(3))
    v = [pattern.pose(t)[9] for t in (1.0, 1.0 + 1e-9)]
    assert v[0] == pytest.approx(pattern.speed(0)) == pytest.approx(v[1], abs=1e-9)
    for k in range(3):
        end = pattern.segments[k].times[1]
        assert pattern.along(k, end)[0] == pytest.approx(pattern.length(k), abs=1e-14)


def test_a_file_is_read_back_as_it_was_written(tmp_path):
    save_pattern(up_and_over(), tmp_path / "p.yaml")
    again = load_pattern(tmp_path / "p.yaml")
    np.testing.assert_array_equal(again.table, up_and_over().table)


# --- Demonstrations.


def demonstration(noise=1e-4, seed=0):
    """Down to a table, along it, along table and wall: 100 Hz, by hand."""
    rng = np.random.default_rng(seed)
    corners = np.array(
        [[0.4, 0, 0.2], [0.4, 0, 0.05], [0.4, 0.2, 0.05], [0.55, 0.2, 0.05]]
    )
    t = np.arange(0.0, 6.0, 0.01)
    k = np.minimum((t // 2).astype(int), 2)
    x = np.clip((t - 2 * k - 0.2) / 1.6, 0, 1)
    share = x**3 * (10 - 15 * x + 6 * x * x)
    p = corners[k] + share[:, None] * (corners[k + 1] - corners[k])
    force = np.zeros((len(t), 3))
    force[k >= 1, 2] = 5.0  # On the tool: against the direction that it presses in.
    force[(k >= 1) & (k < 2), 1] -= 2.0 * (np.gradient(p[:, 1])[k == 1] > 1e-5)
    force[k == 2, 1] -= 4.0
    pose = np.hstack([p, np.tile([0.0, 1.0, 0.0, 0.0], (len(t), 1))])
    pose[:, :3] += noise * rng.normal(size=p.shape)
    return t, pose, force + 0.2 * rng.normal(size=force.shape), corners


def test_a_demonstration_becomes_segments_where_the_force_directions_change():
    t, pose, force, corners = demonstration()
    pattern = pattern_from_demonstration(t, pose, force)
    assert [one.kind for one in pattern.segments] == ["line"] * 3
    found = [one.force_directions.tolist() for one in pattern.segments]
    assert found[0] == [] and found[1] == [DOWN]
    assert sorted(found[2]) == sorted([DOWN, LEFT])
    targets = dict(
        zip(map(tuple, found[2]), pattern.segments[2].force_targets, strict=True)
    )
    assert targets[tuple(DOWN)] == pytest.approx(5.0, abs=0.2)
    assert targets[tuple(LEFT)] == pytest.approx(4.0, abs=0.3)
    for k in range(3):  # Smoothing cuts a corner by less than 5 mm.
        end = pattern.segments[k].positions[-1]
        np.testing.assert_allclose(end, corners[k + 1], atol=5e-3)
    assert pattern.ends_in_contact(0) and pattern.ends_in_contact(1)


@pytest.mark.parametrize("degrees", [60, 90, 120])
def test_a_demonstrated_corner_is_passed_within_the_acceleration_limit(degrees):
    """At the demonstrated speed its pattern would take 2 to 6 m/s2 there."""
    t = np.arange(0.0, 1.2, 0.005)
    s, a = 0.5 * t, np.deg2rad(degrees)
    p = np.stack([np.minimum(s, 0.3), 0.0 * s, 0.0 * s], axis=1)
    p += np.maximum(s - 0.3, 0.0)[:, None] * [np.cos(a), np.sin(a), 0.0]
    pose = np.hstack([p, np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))])
    pattern = pattern_from_demonstration(t, pose, np.zeros((len(t), 3)))
    assert [segment.kind for segment in pattern.segments] == ["spline"]
    s = np.linspace(0.0, pattern.length(0), 2000)
    bend = max(np.linalg.norm(pattern.geometry(0, x)[2]) for x in s)
    # As fast as that allows; bends are looked at in 513 points.
    assert 0.95 < bend * pattern.speed(0) ** 2 / pattern.acceleration_max < 1.01


def test_a_curved_demonstration_becomes_a_smooth_path_near_it():
    t = np.linspace(0.0, 5.0, 501)
    angle = np.pi * (t / 5.0)
    p = np.stack([0.5 + 0.1 * np.cos(angle), 0.1 * np.sin(angle), 0.1 + 0 * t], axis=1)
    pose = np.hstack([p, np.tile([0.0, 1.0, 0.0, 0.0], (len(t), 1))])
    pattern = pattern_from_demonstration(t, pose, np.zeros((501, 3)))
    assert [one.kind for one in pattern.segments] == ["spline"]
    inner = np.linspace(0.05, 0.95, 50) * pattern.length(0)
    path = np.array([pattern.geometry(0, s)[0] for s in inner])
    radius = np.linalg.norm(path[:, :2] - [0.5, 0.0], axis=1)
    assert abs(radius - 0.1).max() < 1e-3


# --- Bad input.

STRAIGHT = dict(kind="line", positions=[[0, 0, 0], [0.3, 0, 0]], times=[0.0, 3.0])


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(kind="curve"), "kind is 'curve'"),
        (dict(times=[1.0, 1.0]), "expected increasing ones"),
        (dict(times=[2.0, 1.0]), "expected increasing ones"),
        (dict(times=[0.0, np.nan]), "times are"),
        (dict(positions=[[0, 0, 0], [0, 0, 0]]), "repeat one"),
        (dict(positions=[[0, 0, 0], [0, np.inf, 0]]), "3 finite numbers"),
        (dict(positions=[[0, 0, 0]]), "has 1 positions, expected 2"),
        (dict(quaternions=[[2.0, 0, 0, 0]]), "of length 1"),
        (
            dict(force_directions=[[0, 0, -2]], force_targets=[5]),
            "expected unit vectors",
        ),
        (dict(force_directions=[[0, 0, np.nan]], force_targets=[5]), "unit vectors"),
        (dict(force_directions=[DOWN], force_targets=[]), "expected 1 numbers"),
        (dict(force_directions=[DOWN], force_targets=[-1.0]), "expected 1 numbers"),
        (dict(force_directions=[DOWN], force_targets=[np.inf]), "finite numbers"),
        (dict(force_directions=[DOWN, DOWN], force_targets=[1, 1]), "nearly parallel"),
        (dict(force_directions=[DOWN] * 3, force_targets=[1] * 3), "at most 2"),
        (dict(times=[0.0, 0.5]), "expected more time: acceleration_max is 1"),
        (dict(colour="red"), "segment 0 has 'colour', expected only"),
    ],
)
def test_a_bad_segment_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        pattern_from({"segments": [{**STRAIGHT, **change}]})


def test_a_gap_in_space_time_or_orientation_is_refused():
    def after(**change):
        second = dict(kind="line", positions=[[0.3, 0, 0], [0.3, 0.2, 0]], times=[3, 6])
        return pattern_from({"segments": [STRAIGHT, {**second, **change}]})

    after()
    with pytest.raises(ValueError, match="segment 1 starts 1.000 mm"):
        after(positions=[[0.301, 0, 0], [0.3, 0.2, 0]])
    with pytest.raises(ValueError, match="starts at 3.1 s, expected 3.0 s"):
        after(times=[3.1, 6])
    with pytest.raises(ValueError, match="90.000 degrees from the end"):
        after(quaternions=turned(90))
    # But along a force direction the contact decides, so there is no gap.
    pressing = dict(force_directions=[[1.0, 0, 0]], force_targets=[5.0])
    after(positions=[[0.35, 0, 0], [0.35, 0.2, 0]], **pressing)


def test_an_arc_through_a_line_and_too_far_a_turn_are_refused():
    with pytest.raises(ValueError, match="not on a line"):
        one("arc", [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    with pytest.raises(ValueError, match="175 degrees"):
        one("line", [[0, 0, 0], [1, 0, 0]], quaternions=[turned(0), turned(175)])


@pytest.mark.parametrize(
    "text, message",
    [
        ("segments: []", "expected a list"),
        ("[1, 2]", "expected a mapping"),
        ("segments: [{kind: line}]", "segment 0 has no positions"),
        ("acceleration_max: fast\nsegments: [{kind: line, times: [0, 9], "
         "positions: [[0,0,0],[1,0,0]]}]", "expected a number"),
        ("a: [", "pattern .*p.yaml: while parsing"),
    ],
)  # fmt: skip
def test_a_bad_file_is_refused_by_its_name(tmp_path, text, message):
    (tmp_path / "p.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_pattern(tmp_path / "p.yaml")
    with pytest.raises(ValueError, match="No such file"):
        load_pattern(tmp_path / "none.yaml")


@pytest.mark.parametrize("what", ["time", "nan", "short"])
def test_a_bad_demonstration_is_refused(what):
    t, pose, force, _ = demonstration()
    if what == "time":
        t[100] = t[99]
        message = "row 100, expected increasing times"
    elif what == "nan":
        force[7, 1] = np.nan
        message = "force of row 7 is not finite"
    else:
        t, pose, force = t[:10], pose[:10], force[:10]
        message = "n >= 20"
    with pytest.raises(ValueError, match=message):
        pattern_from_demonstration(t, pose, force)


@pytest.mark.parametrize(
    ("turn", "a_max"), [(45, 0.5), (90, 5.0), (160, 0.5), (170, 5.0)]
)
def test_a_corner_too_sharp_for_its_speed_is_refused_and_has_a_least_time(turn, a_max):
    """v^2 kappa, by finite differences of the reference, within acceleration_max."""
    angle = np.deg2rad(turn)
    points = np.array([[0.3, 0, 0.3], [0.5, 0, 0.3], [0.5, 0, 0.3]])
    points[2, :2] += 0.2 * np.array([np.cos(angle), np.sin(angle)])
    segment = Segment("spline", points, [0.0, 1.0])
    least = least_time(segment, a_max)
    for share in (0.9, 0.99):
        with pytest.raises(ValueError, match="bends within|expected more time"):
            MotionPattern((replace(segment, times=[0.0, share * least]),), a_max)
    pattern = MotionPattern((replace(segment, times=[0.0, 1.001 * least]),), a_max)
    times = np.linspace(0.0, pattern.duration, 5001)
    p = np.array([pattern.pose(t)[:3] for t in times])
    a = np.diff(p, n=2, axis=0) / (times[1] - times[0]) ** 2
    largest = np.linalg.norm(a, axis=1).max()
    assert 0.9 * a_max < largest <= 1.02 * a_max

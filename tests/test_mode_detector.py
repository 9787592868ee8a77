"""The mode detector on a model of friction: first its maths, then the system."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from sklearn.cluster import Birch
from sliding_tool import DOWN, TOOL_MASS, Slide

from makebreak.systems.changing_contact.mode_detector import (
    ModeDetector,
    ModeDetectorConfig,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    CHANGE_TIME,
    COUNT,
    DECIDED_TIME,
    FREE_MODE,
    FROM_MODE,
    IS_NEW,
    TO_MODE,
    UNKNOWN_MODE,
)
from makebreak.systems.changing_contact.numerics.mode_detector import (
    BAD_WRENCH,
    COLLECTING,
    HINTED,
    NO_FEATURE,
    OK,
    STIFF_SEC,
    TRACKING,
    ModeMemory,
    ModeTuning,
    contact_feature,
    detect,
)
from makebreak.systems.changing_contact.numerics.mode_table import ModeTable, no_modes


def start(tuning):
    return ModeMemory(no_modes(tuning.n_features, tuning.threshold))


def follow(
    slide, tuning, seconds, memory=None, normal=None, edit=None, hint=None, touch=-1
):
    """Rows (time, place, memory). edit(time, wrench) changes the wrench in place;
    hint(time, place, memory) gives the hint; touch is that of touches."""
    memory = memory or start(tuning)
    rows = []
    for time, wrench, velocity, direction, s in slide.samples(seconds, normal):
        if edit:
            edit(time, wrench)
        told = hint(time, s, memory) if hint else UNKNOWN_MODE
        memory = detect(
            memory, tuning, time, wrench, velocity, direction, DOWN, told, touch
        )
        rows.append((time, s, memory))
    return rows


def random_friction(seed, gap=0.1):
    rng = np.random.default_rng(seed)
    while True:
        mu = rng.uniform(0.1, 0.6, size=3)
        if min(abs(np.diff(np.sort(mu)))) >= gap:
            return list(mu)


def score(slide, rows, missed=None):
    """Every change to another surface, from the sample at which the tool is wholly on
    it: (surface, mode that was known for it or 0, mode decided, delay [s], events).

    missed: a list for the times of changes that were not reported; without it, none
    may be missed.
    """
    known: dict[int, int] = {}
    changes = []
    before, pending = None, None
    for time, s, memory in rows:
        surface = slide.surface_at(s)
        if time < slide.touch_sec or surface < 0:
            continue
        if before is not None and surface != before:
            if pending is not None:
                assert missed is not None, "a change was missed"
                missed.append(pending[0])
            pending = (time, memory.transition[COUNT])
        before = surface
        if pending is None:
            if memory.stage == TRACKING:
                known.setdefault(surface, memory.mode)
                assert memory.mode == known[surface], (time, s)
        elif memory.transition[COUNT] > pending[1]:
            changes.append((
                surface,
                known.get(surface, 0),
                memory.mode,
                memory.transition[DECIDED_TIME] - pending[0],
                memory,
            ))  # fmt: skip
            known.setdefault(surface, memory.mode)
            pending = None
    return changes


def check_changes(slide, rows, known_sec, new_sec):
    """All changes right, in time; as many events as changes; as many modes as
    surfaces. Returns: the changes."""
    return check_scored(slide, rows, score(slide, rows), known_sec, new_sec)


def check_scored(slide, rows, changes, known_sec, new_sec):
    for surface, known, mode, delay, memory in changes:
        assert mode == known or (known == 0 and memory.is_new), (surface, known, mode)
        assert delay <= (known_sec if known else new_sec), (surface, known, delay)
        assert memory.confidence[0] >= 0.9 and memory.confidence[1] <= 0.1
    last = rows[-1][2]
    assert last.transition[COUNT] in (len(changes), len(changes) + 1)
    assert len(last.table) == len(slide.friction)
    return changes


@pytest.mark.parametrize("as_rows", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_surfaces_are_told_apart_and_known_again_in_any_direction(seed, as_rows):
    rng = np.random.default_rng(seed)
    slide = Slide(
        random_friction(seed),
        [0.2, 0.4],
        rows=as_rows,
        seed=seed,
        normal=rng.uniform(6.0, 12.0),
        angle=rng.uniform(0.0, 2 * np.pi),
    )
    rows = follow(slide, ModeTuning(crossing=0.03), 20.0)
    # 0.15 and 0.25 s are what the task asks for.
    assert len(check_changes(slide, rows, 0.15, 0.25)) >= 5


@pytest.mark.slow
@pytest.mark.parametrize(
    "speed, normal, known_sec, new_sec",
    # A ramp of 0.5 N over 0.6 s is felt late, and its end is a matter of opinion.
    [(0.1, 8.0, 0.2, 0.3), (0.05, 5.0, 0.4, 0.45), (0.2, 15.0, 0.15, 0.25)],
)
def test_over_20_seeds_changes_are_right(speed, normal, known_sec, new_sec):
    n, all_missed = 0, 0
    for seed in range(20):
        slide = Slide(
            random_friction(100 + seed),
            [0.2, 0.4],
            rows=bool(seed % 2),
            seed=seed,
            normal=normal,
            speed=speed,
        )
        rows = follow(slide, ModeTuning(crossing=0.03), 4.0 / speed)
        missed: list[float] = []
        changes = score(slide, rows, missed)
        if not missed:
            check_scored(slide, rows, changes, known_sec, new_sec)
        all_missed += len(missed)
        n += len(changes) + len(missed)
    assert n >= 200
    assert all_missed <= 0.02 * n  # 98 % is what the task asks for; none was missed.


def two_surfaces(gap, seed, normal, threshold):
    """Of changes between two surfaces `gap` apart: how many were right, how many there
    were, how many modes there are, and the delays from the last foot [s]."""
    rng = np.random.default_rng([seed, round(1000 * gap)])
    low = rng.uniform(0.1, 0.6 - gap)
    friction = [low, low + gap] if rng.random() < 0.5 else [low + gap, low]
    slide = Slide(
        friction,
        [0.2],
        length=0.4,
        rows=bool(seed % 2),
        seed=seed,
        normal=normal,
        angle=rng.uniform(0.0, 2.0 * np.pi),
    )
    stays: list[tuple[int, float, list]] = []  # Surface, since when, (time, mode).
    rows = follow(slide, ModeTuning(crossing=0.03, threshold=threshold), 20.0)
    for time, s, memory in rows:
        surface = slide.surface_at(s)
        if time < slide.touch_sec or surface < 0:
            continue
        if not stays or stays[-1][0] != surface:
            stays.append((surface, time, []))
        mode = memory.mode if memory.stage == TRACKING else UNKNOWN_MODE
        stays[-1][2].append((time, mode))
    mode_of = {surface: told[-1][1] for surface, _, told in reversed(stays)}
    right, delays = 0, []
    for surface, since, told in stays[1:]:
        mode = told[-1][1]
        if mode == mode_of[surface] != mode_of[1 - surface]:
            right += 1
            delays.append(next(t for t, one in told if one == mode) - since)
    return right, len(stays) - 1, len(rows[-1][2].table), delays


@pytest.mark.parametrize(
    "threshold, gap, modes", [(0.04, 0.07, 2), (0.04, 0.03, 1), (0.02, 0.05, 2)]
)
def test_how_near_two_surfaces_may_be_goes_with_the_threshold(threshold, gap, modes):
    for seed in (10, 11):
        right, n, found, delays = two_surfaces(gap, seed, 8.0, threshold)
        assert n >= 4 and found == modes
        assert right == (n if modes == 2 else 0)
        assert max(delays, default=0.0) <= 0.3


def test_a_point_knows_a_surface_again_within_80_ms():
    slide = Slide([0.15, 0.5, 0.3], [0.2, 0.4], ramp=0.0)
    rows = follow(slide, ModeTuning(crossing=0.0), 20.0)
    changes = check_changes(slide, rows, 0.08, 0.13)
    for _, _, _, delay, memory in changes:
        # The change is dated to its first sample, to 10 ms or 1 mm.
        change = memory.transition[CHANGE_TIME]
        assert abs(memory.transition[DECIDED_TIME] - delay - change) < 0.011
        assert memory.transition[IS_NEW] == memory.is_new
        assert memory.transition[TO_MODE] == memory.mode


def test_the_change_is_dated_where_the_ramp_begins_to_show():
    slide = Slide([0.2, 0.6], [0.3], ramp=0.03)
    rows = follow(slide, ModeTuning(crossing=0.03), 5.0)
    at = {round(time, 3): s for time, s, _ in rows}
    change = rows[-1][2].transition[CHANGE_TIME]
    place = min(at.items(), key=lambda item: abs(item[0] - change))[1]
    # Half a departure, 0.15 N, is reached 1.4 mm into a ramp of 3.2 N over 30 mm.
    assert 0.3 < place < 0.304


@pytest.mark.parametrize("speed", [0.03, 0.1, 0.2])
def test_direction_and_normal_force_never_make_a_mode(speed):
    """One surface, many reversals, and a normal force that swings and jumps."""

    def normal(time):
        steps = 4.0 if int(time / 3.0) % 2 else 12.0
        return steps + 3.0 * np.sin(2.0 * time)

    for seed in range(2):
        slide = Slide([0.35], [], length=0.08, speed=speed, seed=seed)
        rows = follow(slide, ModeTuning(crossing=0.03), 9.0, normal=normal)
        last = rows[-1][2]
        assert len(last.table) == 1 and last.mode == 1
        assert last.transition[COUNT] == 0
        settled = [m for time, _, m in rows if time > 1.0]
        assert all(m.mode == 1 for m in settled)
        # It is hardly ever in doubt.
        assert np.mean([m.collecting for m in settled]) < 0.1


@pytest.mark.parametrize("noise, normal", [(0.3, 10.0), (0.6, 12.0), (0.1, 2.0)])
def test_with_its_noise_told_it_stays_right(noise, normal):
    slide = Slide([0.15, 0.35, 0.6], [0.2, 0.4], noise=noise, normal=normal, seed=1)
    tuning = ModeTuning(crossing=0.03, force_noise=noise)
    rows = follow(slide, tuning, 20.0)
    changes = score(slide, rows)
    assert len(changes) >= 5 and len(rows[-1][2].table) == 3
    assert all(mode == known or known == 0 for _, known, mode, _, _ in changes)


def test_a_mixture_of_two_surfaces_is_a_mode_only_without_crossing():
    """What `crossing` is for: the plateau of a block that stands on both."""
    slide = Slide([0.15, 0.55], [0.3], rows=True, ramp=0.03, speed=0.05)
    assert len(follow(slide, ModeTuning(crossing=0.03), 20.0)[-1][2].table) == 2
    assert len(follow(slide, ModeTuning(crossing=0.0), 20.0)[-1][2].table) == 3


def test_without_normal_force_it_is_free_and_after_a_touch_unknown():
    slide = Slide([0.3], [], touch_sec=0.5)
    rows = follow(slide, ModeTuning(), 2.0)
    for time, _, memory in rows:
        if time < 0.5:
            assert memory.mode == FREE_MODE and memory.status == NO_FEATURE
            assert not memory.collecting
    modes = [memory.mode for _, _, memory in rows]
    assert UNKNOWN_MODE in modes and modes[-1] == 1
    first = modes.index(1) * slide.period
    # After 0.1 s of sliding and a batch of 75 ms; acceleration takes 10 ms of it.
    assert 0.67 < first < 0.75
    assert rows[-1][2].transition[COUNT] == 0  # A touch is no change of surface.
    lifted = follow(slide, ModeTuning(), 0.2, memory=rows[-1][2])
    assert lifted[15][2].mode == FREE_MODE


def test_at_rest_there_is_no_feature_and_nothing_changes():
    tuning = ModeTuning(crossing=0.0)
    slide = Slide([0.3, 0.6], [0.3], ramp=0.0)
    memory = follow(slide, tuning, 1.0)[-1][2]
    rng = np.random.default_rng(0)
    for k in range(400):  # A side force of 5 N, that stiction carries.
        wrench = np.array([5.0, 0.0, 8.0, 0.0, 0.0, 0.0]) + 0.1 * rng.normal(size=6)
        velocity = 7e-4 * rng.normal(size=6)
        time = 1.0 + 0.005 * k
        memory = detect(memory, tuning, time, wrench, velocity, np.zeros(3), DOWN)
    assert memory.mode == 1 and memory.stage == TRACKING
    assert memory.status == NO_FEATURE and len(memory.table) == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, 200.0])
def test_a_sensor_that_drops_out_is_said_and_changes_nothing(bad):
    slide = Slide([0.2, 0.5], [0.3], seed=2)

    def edit(time, wrench):
        if 1.0 < time < 1.4 or (time > 5.0 and int(time / 0.02) % 7 == 0):
            wrench[int(time * 1000) % 6] = bad

    rows = follow(slide, ModeTuning(crossing=0.03), 20.0, edit=edit)
    before = next(m for time, _, m in rows if time > 0.99)
    inside = [m for time, _, m in rows if 1.005 < time < 1.395]
    for memory in inside:
        assert memory.status == BAD_WRENCH
        assert memory.mode == before.mode and memory.table is before.table
    # Later one sample in seven is lost, now and then at a seam.
    assert len(rows[-1][2].table) == 2
    changes = score(slide, rows)
    assert len(changes) == 3
    assert all(mode == known or known == 0 for _, known, mode, _, _ in changes)


def slid(friction, normal, seconds):
    """Rows (time, memory) of a tool that slides along x; friction(t), normal(t) [N]."""
    tuning, rng = ModeTuning(), np.random.default_rng(0)
    memory, rows = start(tuning), []
    motion = np.array([0.1, 0, 0, 0, 0, 0]), np.array([1.0, 0, 0])
    for k in range(round(seconds / tuning.period)):
        time = k * tuning.period
        wrench = np.zeros(6)
        wrench[:3] = np.array([-friction(time), 0.0, 1.0]) * normal(time)
        wrench[:3] += tuning.force_noise * rng.normal(size=3)
        memory = detect(memory, tuning, time, wrench, *motion, DOWN, -1, -1)
        rows.append((time, memory))
    return rows


def test_no_mode_is_made_while_the_normal_force_rises():
    """It doubles every 60 ms up to 96 N, and the halves of a batch are 40 ms apart."""
    rows = slid(lambda _: 0.3, lambda t: 1.5 * 2.0 ** min(t / 0.06, 6.0), 1.0)
    assert all(memory.mode < 1 for time, memory in rows if time <= 0.36)
    assert rows[-1][1].mode == 1


def test_a_feature_that_creeps_away_from_its_mode_is_another_mode_in_the_end():
    """By 0.015 a second, to which the reference alone would be near all the time."""
    rows = slid(lambda t: 0.2 + 0.015 * max(t - 1.0, 0.0), lambda _: 10.0, 20.0)
    friction = {}
    for time, memory in rows:
        friction.setdefault(memory.mode, 0.2 + 0.015 * max(time - 1.0, 0.0))
    threshold = ModeTuning().threshold
    assert 0.2 + threshold < friction[2] < 0.2 + 4.0 * threshold


def test_a_sensor_of_a_wider_range_is_used_to_its_limit():
    """A tool that is pressed with 400 N, as for grinding."""
    slide = Slide([0.2, 0.5], [0.3], seed=2)
    tuning = ModeTuning(crossing=0.03, wrench_limit=1000.0)
    rows = follow(slide, tuning, 20.0, normal=lambda _: 400.0)
    assert not any(memory.status == BAD_WRENCH for *_, memory in rows)
    check_changes(slide, rows, 0.4, 0.4)
    held = follow(slide, ModeTuning(crossing=0.03), 2.0, normal=lambda _: 400.0)
    assert held[-1][2].status == BAD_WRENCH


def test_a_blow_is_an_anomaly_and_leaves_the_mode():
    """Algorithm 1: high stiffness for a moment, then on with the same model."""
    slide = Slide([0.3], [], length=2.0)

    def edit(time, wrench):
        if 2.0 < time < 2.05:
            wrench[0] -= 4.0

    rows = follow(slide, ModeTuning(crossing=0.03), 4.0, edit=edit)
    assert any(m.collecting for time, _, m in rows if 2.0 < time < 2.1)
    last = rows[-1][2]
    assert last.mode == 1 and not last.collecting and len(last.table) == 1
    assert last.transition[COUNT] == 0


def test_the_arm_is_stiff_at_a_departure_and_for_the_batch_not_on_both_surfaces():
    slide = Slide([0.2, 0.5], [0.3], ramp=0.03)
    rows = follow(slide, ModeTuning(crossing=0.03), 4.5)
    collected = [(t, m) for t, _, m in rows if m.stage == COLLECTING]
    departed = collected[0][1].change_time
    # 30 mm at 0.1 m/s take 0.3 s.
    for time, memory in collected:
        assert memory.undecided
        if time < departed + STIFF_SEC - 0.01 or len(memory.features):
            assert memory.collecting
        elif time > departed + STIFF_SEC:
            assert not memory.collecting
    soft = sum(not memory.collecting for _, memory in collected)
    assert 30 <= soft <= 45  # Of 5 ms each.


def test_pressed_as_before_it_slides_on_what_it_did_before():
    """At a wall a surface's mode is another one; away from it the first one is back,
    while it is found out again."""
    tuning = ModeTuning(crossing=0.03)
    memory = start(tuning)
    wall = np.array([0.0, 0.0, -1.0, 0.0, 1.0, 0.0])
    noise = np.random.default_rng(0)
    modes = []
    for k in range(300):
        at_wall = 100 <= k < 200
        normal = np.array([0.0, -8.0 if at_wall else 0.0, 8.0])
        friction = 0.2 if not at_wall else 0.45
        wrench = np.zeros(6)
        wrench[:3] = normal + 0.1 * noise.normal(size=3)
        wrench[0] -= friction * (16.0 if at_wall else 8.0)
        v = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
        d, rows = np.array([1.0, 0.0, 0.0]), wall if at_wall else DOWN
        memory = detect(memory, tuning, 0.005 * k, wrench, v, d, rows)
        modes.append(memory.mode)
    assert modes[99] == 1 and modes[199] == 2
    # At the wall the table's mode stays until the new one is found; then no longer.
    assert set(modes[100:110]) == {1} and set(modes[200:]) == {1}
    assert memory.stage == TRACKING and memory.touch_mode == (3.0, 1.0)


# Hints.


def known_surfaces(slide, tuning):
    """A table that knows both surfaces."""
    return follow(slide, tuning, 5.0)[-1][2].table


def hinted(place_hint, mode_hint, tuning, friction=(0.2, 0.5), seam=0.3):
    """A trial in which mode_hint is given from place_hint on, the way out."""
    slide = Slide(list(friction), [seam], seed=5)
    table = known_surfaces(Slide([0.2, 0.5], [0.3], seed=4), tuning)
    return follow(
        slide,
        tuning,
        4.8,
        memory=ModeMemory(table),
        hint=lambda time, s, m: mode_hint if s > place_hint else UNKNOWN_MODE,
    )


@pytest.mark.parametrize("friction, told", [(0.2, 1), (0.5, 2), (0.5, 1)])
def test_the_mode_of_a_touch_may_be_told_and_is_found_out_all_the_same(friction, told):
    tuning = ModeTuning(crossing=0.03)
    table = known_surfaces(Slide([0.2, 0.5], [0.3], seed=4), tuning)
    right = 1 if friction == 0.2 else 2
    slide = Slide([friction], [], seed=6)
    memory = ModeMemory(table)
    memories = [m for _, _, m in follow(slide, tuning, 1.0, memory, touch=told)]
    untold = [m for _, _, m in follow(slide, tuning, 1.0, memory)]
    found = next(k for k, m in enumerate(memories) if m.touch_mode[0])
    touched = next(k for k, m in enumerate(memories) if m.mode != FREE_MODE)
    assert found - touched > 10
    assert {m.mode for m in memories[touched:found]} == {told}
    assert {m.mode for m in untold[touched:found]} == {UNKNOWN_MODE}
    # Stiff until then, and found as soon as without.
    assert all(m.collecting for m in memories[touched + 10 : found])
    assert untold[found].touch_mode == memories[found].touch_mode == (1.0, right)
    assert {m.mode for m in memories[found:]} == {right}
    assert memories[-1].transition[COUNT] == 0  # No change of surface.


def test_a_touch_s_mode_that_nobody_knows_is_not_taken():
    tuning = ModeTuning(crossing=0.03)
    slide = Slide([0.2], [], seed=6)
    for told in (1, np.nan):  # Of an empty table.
        rows = follow(slide, tuning, 0.2, touch=told)
        assert rows[-1][2].mode == UNKNOWN_MODE


@pytest.mark.parametrize("place", [0.29, 0.3, 0.31])
def test_a_right_hint_is_taken_at_once_and_the_change_still_dated(place):
    rows = hinted(place, 2, ModeTuning(crossing=0.03))
    k = next(i for i, (_, s, _) in enumerate(rows) if s > place)
    assert rows[k - 1][2].mode == 1
    for _, _, memory in rows[k:]:
        # Stiff until the whole tool is across and the mode is confirmed.
        assert memory.mode == 2
        assert memory.collecting == (memory.transition[COUNT] == 0)
    transition = rows[-1][2].transition
    assert transition[COUNT] == 1
    assert (transition[FROM_MODE], transition[TO_MODE]) == (1.0, 2.0)
    at = min(rows, key=lambda row: abs(row[0] - transition[CHANGE_TIME]))[1]
    assert 0.298 < at < 0.304  # The seam, wherever the hint was.


def test_a_hint_of_a_change_that_does_not_come_is_undone():
    rows = hinted(0.15, 2, ModeTuning(crossing=0.03))
    rows = [row for row in rows if row[0] < 4.5]  # Only the way out.
    inside = [m for _, s, m in rows if 0.151 < s < 0.19]
    assert all(m.mode == 2 and m.stage == HINTED for m in inside)
    assert all(m.collecting for m in inside)
    after = [m for _, s, m in rows if 0.2 < s < 0.3]
    assert not any(m.collecting for m in after)
    assert all(m.mode == 1 and m.transition[COUNT] == 0 for m in after)
    # And the change that comes later is found as ever.
    assert rows[-1][2].mode == 2 and rows[-1][2].transition[COUNT] == 1


def test_a_hint_of_the_wrong_mode_is_corrected():
    tuning = ModeTuning(crossing=0.03)
    rows = hinted(0.3, 2, tuning, friction=(0.2, 0.8))
    last = rows[-1][2]
    assert last.mode == 3 and last.is_new and len(last.table) == 3
    assert (last.transition[FROM_MODE], last.transition[TO_MODE]) == (1.0, 3.0)


@pytest.mark.parametrize("told", [0, 9, np.nan, 1])
def test_a_hint_of_no_known_or_of_this_mode_changes_nothing(told):
    rows = hinted(0.15, told, ModeTuning(crossing=0.03))
    assert all(m.mode == 1 for _, s, m in rows if 0.15 < s < 0.29)
    assert rows[-1][2].mode == 2


# The feature and the table.


def test_the_feature_is_friction_whatever_the_direction_and_the_acceleration():
    rng = np.random.default_rng(0)
    for _ in range(20):
        n, a = rng.normal(size=3), rng.normal(size=3)
        n /= np.linalg.norm(n)
        d = np.cross(n, rng.normal(size=3))
        d /= np.linalg.norm(d)
        a -= n * (n @ a)
        mu, R, arm = rng.uniform(0.1, 0.8), rng.uniform(2.0, 15.0), 0.05
        tau = rng.normal(size=3)
        ring = np.zeros((5, 9))
        ring[:, :3] = -R * n - mu * R * d - TOOL_MASS * a
        ring[:, 3:6] = tau
        ring[:, 6:] = 0.1 * d + np.outer(0.005 * np.arange(5), a)
        rows = np.concatenate([n, np.zeros(3)])
        out = contact_feature(ring, rows, TOOL_MASS, arm, 0.005)
        speed = np.linalg.norm(ring[-1, 6:])
        expected = [mu, np.linalg.norm(tau) / (R * arm), R, speed]
        np.testing.assert_allclose(out, expected, rtol=1e-9)
        assert contact_feature(ring, rows, TOOL_MASS, 0.0, 0.005)[1] == 0.0


def test_the_torque_tells_two_kinds_of_contact_apart_that_rub_the_same():
    """Edge and face: the same friction, another lever arm (CC section 3.2)."""

    def edit(time, wrench):
        if time > 3.0:
            wrench[3:] *= 4.0

    slide = Slide([0.4], [], length=1.0)
    # 0.1 m: 0.01 N m of noise then count as 0.1 N do.
    with_torque = ModeTuning(crossing=0.0, torque_arm=0.1)
    assert len(follow(slide, with_torque, 6.0, edit=edit)[-1][2].table) == 2
    slide = Slide([0.4], [], length=1.0)
    assert len(follow(slide, ModeTuning(), 6.0, edit=edit)[-1][2].table) == 1


def batches(seed, centres=(0.15, 0.35, 0.5, 0.15, 0.35)):
    rng = np.random.default_rng(seed)
    return [rng.normal(mu, 0.012, size=(15, 1)) for mu in centres]


def test_the_subclusters_are_those_of_birch_fed_batch_by_batch():
    table, birch = no_modes(1, 0.04), Birch(n_clusters=None, threshold=0.04)
    for batch, mode in zip(batches(0), (1, 2, 3, 1, 2), strict=True):
        table = table.learned(batch, mode)
        birch.partial_fit(batch)
        expected = birch.subcluster_centers_
        np.testing.assert_array_equal(table.centres[: len(expected)], expected)
    np.testing.assert_allclose(
        table.centroids.ravel(),
        [
            np.mean(np.vstack([batches(0)[k] for k in ks]))
            for ks in ((0, 3), (1, 4), (2,))
        ],
        atol=1e-12,
    )


def test_fractions_count_what_lies_near_a_mode():
    table = no_modes(1, 0.04)
    for mu, mode in ((0.2, 1), (0.5, 2)):
        table = table.learned(np.full((15, 1), mu), mode)
    batch = np.array([[0.2], [0.25], [0.27], [0.35], [0.45]])
    # 1.5 thresholds are 0.06; 0.27 is too far off, 0.45 is not.
    np.testing.assert_allclose(table.fractions(batch), [0.4, 0.2])
    np.testing.assert_allclose(table.fractions(batch, 0.08), [0.6, 0.2])
    assert table.nearest(np.array([0.36])) == (2, pytest.approx(0.14))
    assert no_modes(1, 0.04).nearest(np.array([0.3])) == (0, np.inf)
    assert len(no_modes(1, 0.04).fractions(batch)) == 0


def test_numbers_of_modes_do_not_change_when_birch_splits_a_leaf():
    """More subclusters than a leaf has room for: scikit-learn re-orders them."""
    table = no_modes(1, 0.001)
    rng = np.random.default_rng(0)
    where = rng.permutation(np.linspace(0.0, 3.0, 80))
    for mode, mu in enumerate(where, start=1):
        table = table.learned(np.full((5, 1), mu), mode)
    assert not np.allclose(table.centres[:80, 0], where)
    for mode, mu in enumerate(where, start=1):
        fractions = table.fractions(np.full((4, 1), mu))
        assert fractions[mode - 1] == 1.0


def test_learning_leaves_the_table_that_was():
    table = no_modes(1, 0.04)
    for batch, mode in zip(batches(1), (1, 2, 3, 1, 2), strict=True):
        table = table.learned(batch, mode)
    before = table.centres.copy()
    table.learned(np.full((15, 1), 0.9), 4)
    np.testing.assert_array_equal(table.centres, before)
    with pytest.raises(ValueError, match="read-only"):
        table.centroids[0] = 0.0


def test_modes_come_back_from_their_file_and_go_on_alike(tmp_path):
    table = no_modes(1, 0.04)
    for batch, mode in zip(batches(2), (1, 2, 3, 1, 2), strict=True):
        table = table.learned(batch, mode)
    table.save(tmp_path / "modes.json")
    again = ModeTable.load(tmp_path / "modes.json")
    more = batches(3)[0]
    for a, b in ((table, again), (table.learned(more, 1), again.learned(more, 1))):
        for name in ("centroids", "weights", "samples", "centres", "labels"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    no_modes(1, 0.04).save(tmp_path / "none.json")
    assert len(ModeTable.load(tmp_path / "none.json")) == 0
    for text in ("{}", "[", '{"threshold": 0.04, "centroids": [[1]], "weights": []}'):
        (tmp_path / "modes.json").write_text(text)
        with pytest.raises(ValueError, match="modes .*modes.json"):
            ModeTable.load(tmp_path / "modes.json")


# The system.


class Played(LeafSystem):
    """Slide's samples as ports, functions of time."""

    def __init__(self, slide, seconds):
        super().__init__()
        samples = list(slide.samples(seconds))
        parts = [np.array([row[i] for row in samples]) for i in (1, 2, 3)]
        parts.append(np.tile(DOWN, (len(samples), 1)))
        names = ("wrench", "ee_velocity", "direction", "force_directions")

        def row(context):
            k = int(context.get_time() / slide.period + 1e-6)
            return min(k, len(samples) - 1)

        for name, rows in zip(names, parts, strict=True):
            self.DeclareVectorOutputPort(
                name,
                rows.shape[1],
                lambda c, out, rows=rows: out.SetFromVector(rows[row(c)]),
                {self.time_ticket()},
            )


NAMES = (
    "mode", "confidence", "is_new", "transition", "collecting", "undecided", "status",
)  # fmt: skip


def small_diagram(knowledge=None, slide=None):
    builder = DiagramBuilder()
    slide = slide or Slide([0.2, 0.5], [0.15], length=0.3, ramp=0.0)
    played = builder.AddSystem(Played(slide, 9.0))
    detector = builder.AddSystem(
        ModeDetector(ModeDetectorConfig(crossing=0.0), knowledge, 0.005, 1e-4)
    )
    for port in ("wrench", "ee_velocity", "direction", "force_directions"):
        builder.Connect(played.GetOutputPort(port), detector.GetInputPort(port))
    return Simulator(builder.Build()), detector


def outputs(simulator, detector):
    context = detector.GetMyContextFromRoot(simulator.get_context())
    return np.concatenate([detector.GetOutputPort(n).Eval(context) for n in NAMES])


def test_the_system_gives_what_the_maths_does():
    slide = Slide([0.2, 0.5], [0.15], length=0.3, ramp=0.0)
    rows = follow(slide, ModeTuning(crossing=0.0), 8.0)
    simulator, detector = small_diagram()
    np.testing.assert_array_equal(
        outputs(simulator, detector), [*[0.0] * 12, NO_FEATURE]
    )
    for k in (30, 100, 200, 400, 700, 1500):
        simulator.AdvanceTo(0.005 * k + 1e-3)
        m = rows[k][2]
        out = outputs(simulator, detector)
        numbers = [m.mode, *m.confidence, m.is_new, *m.transition]
        numbers += [m.collecting, m.undecided]
        # The detector's clock is 0.1 ms later.
        np.testing.assert_allclose(out[:-1], numbers, atol=1.1e-4)
        assert out[-1] == m.status
    assert out[4] >= 2.0 and out[-1] == OK  # Two changes of surface by then.


def test_a_restored_context_replays_bit_for_bit_with_birch_in_it():
    simulator, detector = small_diagram()
    simulator.AdvanceTo(0.9)
    saved = simulator.get_context().Clone()
    results = []
    for _ in range(3):
        simulator.reset_context(saved.Clone())
        simulator.AdvanceTo(6.0)
        context = detector.GetMyContextFromRoot(simulator.get_context())
        table = detector.knowledge(context)
        results.append((outputs(simulator, detector), table.centres, table.samples))
    assert len(results[0][1]) > 2
    for result in results[1:]:
        for a, b in zip(result, results[0], strict=True):
            np.testing.assert_array_equal(a, b)


def test_what_was_learned_is_known_in_the_next_trial():
    simulator, detector = small_diagram()
    simulator.AdvanceTo(4.0)
    table = detector.knowledge(detector.GetMyContextFromRoot(simulator.get_context()))
    assert len(table) == 2
    # The other way round: 0.5 first, which is mode 2.
    slide = Slide([0.5, 0.2], [0.15], length=0.3, ramp=0.0, seed=7)
    simulator, detector = small_diagram(table, slide)
    simulator.AdvanceTo(1.0)
    out = outputs(simulator, detector)
    assert out[0] == 2.0 and out[3] == 0.0


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(threshold=0.0), "threshold is 0.0, expected a positive number"),
        (dict(crossing=-1.0), "crossing is -1.0, expected a number of 0 or more"),
        (dict(force_noise=np.nan), "force_noise is nan"),
        (dict(normal_force_min=0.0), "normal_force_min is 0.0"),
        (dict(torque_arm=np.inf), "torque_arm is inf"),
        (dict(tool_mass=-0.1), "tool_mass is -0.1"),
        (dict(batch=3), "batch is 3, expected a whole number from 6 to 60"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        ModeDetector(replace(ModeDetectorConfig(), **changes))


def test_modes_of_another_feature_are_refused():
    with pytest.raises(ValueError, match="2 features and threshold 0.04, expected 1"):
        ModeDetector(ModeDetectorConfig(), no_modes(2, 0.04))
    with pytest.raises(ValueError, match="period_sec is 0.1"):
        ModeDetector(ModeDetectorConfig(), period_sec=0.1)

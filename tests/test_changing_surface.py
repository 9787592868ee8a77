"""changing_surface: the task, its scores on made-up logs, and a short run."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from makebreak.diagrams.changing_contact import telemetry
from makebreak.diagrams.changing_surface import (
    GAP,
    PATH,
    ChangingSurfaceConfig,
    constant_stiffness,
    make_changing_surface,
    make_task,
    surface_at,
)
from makebreak.scripts.experiments.changing_surface import (
    changes_of,
    modes_of,
    sliding,
    tracking_error,
)


def test_seeds_draw_frictions_with_gaps_and_a_path_over_every_seam():
    for seed in range(20):
        task = make_task(ChangingSurfaceConfig(seed=seed))
        assert np.diff(np.sort(task.friction)).min() >= GAP
        assert task.friction.min() >= 0.1 and task.friction.max() <= 0.6
        assert task.forces.min() >= 6.0 and task.forces.max() <= 12.0
    pattern = task.pattern
    assert len(pattern) == len(PATH) + 1
    times = np.arange(0.0, pattern.duration, 0.01)
    p = np.array([pattern.pose(t)[:3] for t in times])
    on = np.array([len(pattern.forces(t)[0]) for t in times]) > 0
    here = surface_at(p[on], 0.0)[:, 0]
    changes = here[1:][np.diff(here) != 0]
    np.testing.assert_array_equal(changes, [2, 3, 1, 2, 3, 1, 2, 3, 2, 1])
    # All feet are on one surface at every corner: a change is over before it turns.
    for piece in PATH:
        feet = surface_at([[*piece[-1], 0.0]], 0.012)
        assert len(set(feet[0])) == 1


def test_feet_stand_where_they_are():
    # 5 mm short of the seam y = 0, two feet are across.
    np.testing.assert_array_equal(
        surface_at([[0.42, -0.005, 0.0]], 0.012), [[1, 2, 1, 2]]
    )
    np.testing.assert_array_equal(surface_at([[0.42, -0.005, 0.0]], 0.0), [[1] * 4])
    np.testing.assert_array_equal(
        surface_at([[0.495, -0.1, 0.0]], 0.012), [[1, 1, 3, 3]]
    )


def made_up(decisions):
    """A log of a tip that goes over y = 0 to and fro, at 0.1 m/s: 1, 2, 1.

    Args: decisions: (time of decision, from, to, is_new), in order.
    """
    time = np.arange(0.0, 6.0, 0.001)
    y = np.where(time < 3.0, -0.15 + 0.1 * time, 0.45 - 0.1 * time)
    n = len(time)
    log = {
        "time": time,
        "ee_pose": np.column_stack([np.full(n, 0.42), y, np.zeros((n, 5))]),
        "phase": np.tile([1.0, 0, 0, 0, 0, 0], (n, 1)),
        "force_directions": np.tile([0.0, 0, -1, 0, 0, 0], (n, 1)),
        "transition": np.zeros((n, 6)),
        "mode": np.ones((n, 1)),
        "confidence": np.tile([1.0, 0.0], (n, 1)),
        "stiffness": np.full((n, 6), 200.0),
        "x_desired": np.zeros((n, 19)),
    }
    for k, (at, before, after, is_new) in enumerate(decisions):
        rows = time >= at
        log["transition"][rows] = [k + 1, at - 0.3, before, after, is_new, at]
        log["mode"][rows] = after
    return log


# The tip is over the seam at 1.5 and 4.5 s, its feet 0.12 s before and after.
RIGHT = [(1.70, 1, 2, 1), (4.70, 2, 1, 0)]


def test_right_decisions_are_scored_with_their_delays():
    changes, surplus = changes_of(made_up(RIGHT), 0.012)
    assert [(c.before, c.after, c.new, c.right) for c in changes] == [
        (1, 2, True, True),
        (2, 1, False, True),
    ]
    assert surplus == 0
    for c, at in zip(changes, (1.5, 4.5), strict=True):
        times = [c.begins, c.centre, c.ends, c.decided, c.felt]
        expected = [at - 0.12, at, at + 0.12, at + 0.2, at - 0.1]
        np.testing.assert_allclose(times, expected, atol=2.1e-3)  # Two samples.


@pytest.mark.parametrize(
    "decisions, right, surplus",
    [
        ([], 0, 0),
        (RIGHT[:1], 1, 0),  # The second one missed.
        ([(1.7, 1, 2, 1), (4.7, 2, 3, 1)], 1, 0),  # Not known again.
        ([(1.7, 1, 1, 0), (4.7, 1, 1, 0)], 1, 0),  # A new one taken for an old one.
        ([*RIGHT, (5.5, 1, 3, 1)], 1, 1),  # Changed its mind: the second is wrong.
        ([(1.7, 1, 3, 1), (1.9, 3, 2, 1), (4.7, 2, 1, 0)], 1, 1),
        # A mode out of nothing: surface 1 has two names then.
        ([(0.8, 1, 2, 1), (1.7, 2, 3, 1), (4.7, 3, 1, 0)], 1, 1),
    ],
)
def test_wrong_decisions_are_counted(decisions, right, surplus):
    changes, too_many = changes_of(made_up(decisions), 0.012)
    assert len(changes) == 2
    assert sum(c.right for c in changes) == right
    assert too_many == surplus


def test_of_a_rehearsal_a_surface_s_mode_is_known_when_it_is_first_met():
    known = [(1.70, 1, 2, 0), (4.70, 2, 1, 0)]
    assert [c.right for c in changes_of(made_up(known), 0.012)[0]] == [False, True]
    assert [c.right for c in changes_of(made_up(known), 0.012, True)[0]] == [True, True]
    # One mode for two surfaces is wrong all the same.
    one = [(1.70, 1, 1, 0), (4.70, 1, 1, 0)]
    assert not changes_of(made_up(one), 0.012, True)[0][0].right


def test_modes_that_were_hinted_or_only_rehearsed_do_not_count():
    log = made_up([(1.70, 2, 4, 1), (4.70, 4, 2, 0)])
    log["mode"][:1700] = 2
    log["collecting"] = np.zeros((6000, 1))
    log["mode"][400:500], log["collecting"][400:500] = 3, 1
    assert modes_of(log) == {2, 4}


def test_the_tracking_error_is_in_the_surface_alone():
    log = made_up([])
    log["x_desired"][:, :3] = log["ee_pose"][:, :3] + [0.003, -0.004, 0.1]
    np.testing.assert_allclose(tracking_error(log), 0.005, rtol=1e-9)
    assert not sliding(log)[:300].any() and sliding(log)[300:].all()


def test_the_baseline_has_one_stiffness_and_no_feed_forward():
    config = ChangingSurfaceConfig()
    law = constant_stiffness(config, 700.0).control.variable_impedance
    assert law.stiffness.free == law.stiffness.maximum == 700.0
    assert not law.feedforward
    assert config.control.variable_impedance.feedforward  # The given one stays.


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(speed=0.0), "speed is 0.0"),
        (dict(normal_force=-1.0), "normal_force is -1.0"),
        (dict(tool="brush"), "brush"),
        (dict(seed=-1), "seed is -1"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        make_task(ChangingSurfaceConfig(**changes))


@pytest.mark.parametrize("tool, laid", [("block", True), ("sphere", False)])
def test_what_has_a_face_is_laid_flat(tool, laid):
    config = ChangingSurfaceConfig(tool=tool)
    diagram = make_changing_surface(config, make_task(config))
    assert diagram.HasSubsystemNamed("surface_alignment") == laid
    config.control.align.angle_max_deg = 1.0
    if not laid:
        with pytest.raises(ValueError, match="align.angle_max_deg is 1.0, .* no face"):
            make_task(config)


@pytest.mark.slow
@pytest.mark.parametrize("tool", ["block", "sphere"])
def test_the_first_three_changes_are_recognised(tool):
    config = ChangingSurfaceConfig(seed=100, tool=tool)
    task = make_task(config)
    diagram = make_changing_surface(config, task)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(11.0)
    log = telemetry(diagram, simulator.get_context())
    changes, surplus = changes_of(log, task.feet)
    assert [(c.before, c.after) for c in changes] == [(1, 2), (2, 3), (3, 1)]
    assert all(c.right for c in changes) and surplus == 0
    assert np.sqrt(np.mean(tracking_error(log)[sliding(log)] ** 2)) < 1e-3

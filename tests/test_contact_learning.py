from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.contact_learning import (
    DIRECTIONS,
    ERRORS,
    START,
    SURFACES,
    ContactLearningConfig,
    make_task,
)
from makebreak.diagrams.realism import StationErrors
from makebreak.diagrams.tabletop import tool_half_width
from makebreak.models.scene import load_scene
from makebreak.scripts.experiments.contact_learning import (
    LearningTrial,
    checks,
    run,
    scored,
    summary,
)
from makebreak.scripts.runner.session import Session
from makebreak.systems.changing_contact.numerics.contact_task import (
    DIRECTION,
    DONE,
    MADE,
    N_CONTACT,
    PEAK_FORCE,
    PHASE_SEGMENT,
    PHASE_STAGE,
    POSITION,
    REGION,
    SPEED,
    TIME,
    ContactBelief,
)


@pytest.mark.parametrize("tool", ["block", "sphere"])
def test_the_tool_touches_the_surfaces_where_the_task_says(tool):
    # Drake's own geometry: the point of the tool that touches is on the surface.
    for seed in range(3):
        task = make_task(ContactLearningConfig(seed=seed, tool=tool))
        nominal = np.array([0.62, 0.16, 0.015])
        nominal += (tool_half_width(tool) - 0.015) * np.array([-1.0, -1.0, 1.0])
        assert np.all(abs(task.truth[2] - nominal) <= 0.05 + 1e-9)
        builder = DiagramBuilder()
        loaded = load_scene(task.world, builder)
        diagram = builder.Build()
        root = diagram.CreateDefaultContext()
        plant, inspector = loaded.plant, loaded.scene_graph.model_inspector()
        tip = plant.GetFrameByName("tip").CalcPoseInWorld(
            plant.GetMyContextFromRoot(root)
        )
        np.testing.assert_allclose(tip.translation(), START, atol=1e-4)
        query = loaded.scene_graph.get_query_output_port().Eval(
            loaded.scene_graph.GetMyContextFromRoot(root)
        )
        for name, d, p in zip(SURFACES, DIRECTIONS, task.truth, strict=True):
            touching = p + tool_half_width(tool) * d
            distances = [
                one.distance
                for one in query.ComputeSignedDistanceToPoint(touching, 0.01)
                if inspector.GetName(one.id_G).startswith(f"{name}::")
            ]
            np.testing.assert_allclose(distances, 0.0, atol=1e-9)
            assert len(distances) == 1


def test_tasks_differ_by_seed_within_what_is_promised():
    tasks = [make_task(ContactLearningConfig(seed=s)) for s in range(40)]
    friction = np.array([t.friction for t in tasks])
    assert friction.min() >= 0.1 and friction.max() <= 0.6 and friction.std() > 0.1
    signs = []
    for task in tasks:
        for i, contact in enumerate(task.prior.contacts):
            error = (contact.mean - task.truth[i]) @ DIRECTIONS[i]
            np.testing.assert_allclose(abs(error), ERRORS[i])
            signs.append(np.sign(error))
            # The pattern goes beyond each surface, so each can be met.
            end = task.pattern.segments[i].positions[1]
            assert (end - task.truth[i]) @ DIRECTIONS[i] > 0.009
    assert 30 < np.sum(np.array(signs) > 0) < 90
    a, b = make_task(ContactLearningConfig(seed=3)), tasks[3]
    np.testing.assert_array_equal(a.truth, b.truth)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"tool": "spoon"}, "tool is 'spoon'"),
        ({"trials": 0}, "trials is 0, expected a positive"),
        ({"speed": np.nan}, "speed is nan"),
    ],
)
def test_bad_configs_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        make_task(ContactLearningConfig(**change))


# The score, on a log that is made up.


def made_up_log(task, force=(8.0, 9.0, 7.0), events=(0, 1, 2), offset=0.0):
    """The tip goes along the path at 0.1 m/s, with half-sine impacts of 40 ms."""
    corners = [np.array(START), *task.truth]
    places, segments, touches = [], [], []
    for k in range(3):
        # Across, a segment starts where the contact before it was.
        start = corners[0] if k == 0 else places[-1]
        d = DIRECTIONS[k]
        way = (task.truth[k] - start) @ d
        s = np.arange(0.0, way, 1e-4)
        touches.append(sum(segments_n(segments)) + len(s))
        places.extend(start + d * x for x in s)
        places.extend([start + d * way] * 300)
        segments.append(len(s) + 300)
    n = len(places)
    log = {
        "time": 1e-3 * np.arange(n),
        "ee_pose": np.zeros((n, 7)),
        "ee_velocity": np.zeros((n, 6)),
        "wrench": np.zeros((n, 6)),
        "phase": np.zeros((n, 6)),
        "contact": np.zeros((n, N_CONTACT)),
    }
    log["ee_pose"][:, :3] = places
    log["tip_true"] = log["ee_pose"][:, :3]
    segment = np.repeat(np.arange(3), segments)
    log["phase"][:, PHASE_SEGMENT] = segment
    log["phase"][-100:, PHASE_STAGE] = DONE
    pulse = np.sin(np.pi * np.arange(40) / 40)
    for i, k in enumerate(touches):
        log["wrench"][k : k + 40, :3] -= force[i] * pulse[:, None] * DIRECTIONS[i]
        log["phase"][k - 500 : k, PHASE_STAGE] = REGION
        log["phase"][k - 500 : k, 2] = 1  # IMPACT
    for number, i in enumerate(events):
        again = i in events[:number]
        k = touches[i] + (55 if again else 5)
        log["contact"][k:, MADE] += 1
        log["contact"][k:, TIME] = 1e-3 * touches[i]
        log["contact"][k:, POSITION] = task.truth[i] + offset * DIRECTIONS[i]
        log["contact"][k:, DIRECTION] = DIRECTIONS[i]
        log["contact"][k:, SPEED] = 0.1
        log["contact"][k + 70 :, PEAK_FORCE] = force[i]
    return log


def segments_n(segments):
    return segments or [0]


@pytest.fixture(scope="module")
def task():
    return make_task(ContactLearningConfig(seed=0))


def test_the_score_finds_force_speed_and_time(task):
    trial = scored(made_up_log(task), task, task.prior)
    # 100 Hz takes a little off a pulse of 40 ms: below 3 %.
    np.testing.assert_allclose(trial.force, [8.0, 9.0, 7.0], rtol=0.03)
    np.testing.assert_allclose(trial.force_raw, [8.0, 9.0, 7.0], rtol=1e-9)
    np.testing.assert_allclose(trial.force_felt, [8.0, 9.0, 7.0])
    np.testing.assert_allclose(trial.speed, 0.1)
    np.testing.assert_allclose(abs(trial.error), ERRORS)
    np.testing.assert_allclose(trial.transition, 1.5, atol=2e-3)
    assert (trial.missed, trial.false, trial.done) == (0, 0, True)


def test_missed_and_false_contacts_are_counted(task):
    trial = scored(made_up_log(task, events=(0, 2)), task, task.prior)
    assert (trial.missed, trial.false) == (1, 0)
    trial = scored(made_up_log(task, offset=-0.01), task, task.prior)
    assert (trial.missed, trial.false) == (3, 3)
    # An arm that believes its tip 8 mm off reports the contact there.
    off = replace(task, errors=StationErrors(tool=0.008))
    trial = scored(made_up_log(task, offset=-0.01), off, task.prior)
    assert (trial.missed, trial.false) == (0, 0)
    trial = scored(made_up_log(task, events=(0, 1, 1, 2)), task, task.prior)
    assert (trial.missed, trial.false) == (0, 1)
    log = made_up_log(task)
    log["phase"][:, PHASE_STAGE] = REGION
    assert not scored(log, task, task.prior).done


def with_numbers(error, force, completion):
    three = np.full(3, np.nan)
    return LearningTrial(
        {}, ContactBelief(), True, completion, 1.0, three, np.array(force), three,
        three, three, three, three, np.full(3, error), three, 0, 0,
    )  # fmt: skip


def test_each_part_of_the_criterion_can_fail(task):
    good = [with_numbers(2e-3, [15, 1, 9.5], 14.0)]
    good += [with_numbers(1e-3, [8.6, 7.4, 8.0], 7.0)] * 4
    assert checks(good)["success"]
    for change, key in (
        ((0, with_numbers(2.1e-3, [8, 8, 8], 14.0)), "met_error_after_1"),
        ((0, with_numbers(2e-3, [15.1, 8, 8], 14.0)), "met_force_first"),
        ((2, with_numbers(1.1e-3, [8, 8, 8], 7.0)), "met_error_after_3"),
        ((1, with_numbers(1e-3, [8, 8.7, 8], 7.0)), "met_force_from_trial_2"),
        ((2, with_numbers(1e-3, [8, np.nan, 8], 7.0)), "met_force_from_trial_2"),
        ((4, with_numbers(1e-3, [8, 8, 8], 7.1)), "met_shorter"),
    ):
        trials = list(good)
        trials[change[0]] = change[1]
        met = checks(trials)
        failed = [k for k in met if k.startswith("met_") and not met[k]]
        assert failed == [key]
        assert summary(trials, task)["success"] is False
    assert summary(good, task)["success"] is True


@pytest.mark.slow
def test_two_trials_teach_place_and_speed(tmp_path):
    config = ContactLearningConfig(seed=100, tool="sphere", trials=2)
    result = run(config, Session(tmp_path, progress=False))
    assert result["missed_contacts"] == result["false_contacts"] == 0
    assert result["trials_done"] == 2
    for i in (1, 2, 3):
        assert abs(result[f"contact_error_m_contact_{i}"][0]) < 2e-3
        force = result[f"impact_force_peak_N_contact_{i}"]
        assert force[0] <= 10.0 and abs(force[1] - 8.0) < 1.0
    time = result["completion_time_s"]
    assert time[1] < time[0]
    for name in ("trials.png", "learning.png", "contacts.json", "recording.csv"):
        assert (tmp_path / name).exists()
    belief = ContactBelief.load(tmp_path / "contacts.json")
    assert [c.seen for c in belief.contacts] == [2, 2, 2]

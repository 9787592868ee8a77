"""The chain of collisions: its task, its score, and a whole run."""

import json
from dataclasses import replace

import numpy as np
import pytest

from makebreak.diagrams.multiple_collisions import (
    BLUE_TOP,
    DOWN,
    FRICTION,
    IMPACTS,
    SPREAD,
    MultipleCollisionsConfig,
    make_multiple_collisions,
    make_pattern,
    make_task,
    with_known_height,
)
from makebreak.diagrams.realism import StationErrors
from makebreak.diagrams.tabletop import tool_half_width
from makebreak.scripts.experiments import multiple_collisions
from makebreak.scripts.experiments.multiple_collisions import (
    CollisionTrial,
    creeping_distances,
    extra_time_bound,
    scored,
    summary,
)
from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.settings import apply_settings
from makebreak.systems.changing_contact.numerics.contact_task import (
    BROKEN,
    DIRECTION,
    DONE,
    MADE,
    N_CONTACT,
    PHASE_SEGMENT,
    PHASE_STAGE,
    POSITION,
    SPEED,
)


@pytest.fixture(scope="module")
def task():
    return make_task(MultipleCollisionsConfig(seed=100))


# --- The task.


@pytest.mark.parametrize("tool", ["sphere", "block"])
def test_the_pattern_ends_in_four_contacts_and_one_loss(tool):
    config = MultipleCollisionsConfig(tool=tool)
    pattern = make_pattern(config, tool_half_width(tool))
    made = [k for k in range(len(pattern)) if pattern.ends_in_contact(k)]
    assert made == [k for _, _, k in IMPACTS]
    assert [k for k in range(len(pattern)) if pattern.ends_in_loss(k)] == [3]
    for k in (0, 1, 2, 3, 4, 6):
        assert pattern.speed(k) == pytest.approx(config.speed, abs=1e-9)
    # At rest at the end, and each segment in its time.
    assert pattern.along(7, 1e9)[1] == pytest.approx(0.0, abs=1e-12)


def test_surfaces_frictions_and_estimates_vary_by_seed_within_their_bounds():
    nominal = make_task(MultipleCollisionsConfig(known_heights=False))
    seen = []
    for seed in range(20):
        config = MultipleCollisionsConfig(seed=seed, known_heights=False)
        task = make_task(config)
        assert abs(task.truth - nominal.truth).max() <= 2.0 * SPREAD
        # The top of the red block moves with the table that it stands on.
        assert task.truth[0] - task.truth[3] == pytest.approx(0.06, abs=1e-12)
        for mu in task.friction.values():
            assert FRICTION[0] <= mu <= FRICTION[1]
        errors = [
            c.mean @ d - where
            for c, (d, *_), where in zip(
                task.prior.contacts, IMPACTS, task.truth, strict=True
            )
        ]
        assert np.abs(errors).max() <= config.error_max
        sigma = np.sqrt(task.prior.contacts[0].covariance[0, 0])
        assert config.error_max <= 2.0 * sigma  # The region holds all errors.
        seen.append([*task.truth, *task.friction.values(), *errors])
    assert np.linalg.matrix_rank(np.array(seen) - np.mean(seen, axis=0)) == 10
    np.testing.assert_array_equal(
        make_task(MultipleCollisionsConfig()).truth, nominal.truth
    )


@pytest.mark.slow
def test_a_known_height_narrows_both_regions_and_they_still_hold_the_surfaces():
    narrower = []
    for seed in range(100):
        plain, task = (
            make_task(MultipleCollisionsConfig(seed=seed, known_heights=known))
            for known in (False, True)
        )
        np.testing.assert_array_equal(task.truth, plain.truth)
        for i, (d, *_) in enumerate(IMPACTS):
            c, before = task.prior.contacts[i], plain.prior.contacts[i]
            sigma = np.sqrt(d @ c.covariance @ d)
            assert abs(c.mean @ d - task.truth[i]) <= 2.0 * sigma + 1e-12
            if i in (1, 2):  # Sideways nothing is known of one from another.
                np.testing.assert_array_equal(c.mean, before.mean)
            narrower.append(sigma / np.sqrt(d @ before.covariance @ d))
        assert task.prior.contacts[3].known_from[:2] == (0.0, pytest.approx(-0.06))
    table = np.array(narrower).reshape(-1, 4)[:, 0]
    # Two ranges of 6 cm about two uniform estimates overlap by 4 cm on average; the
    # height's tolerance adds up to 4 mm.
    assert 0.63 < table.mean() < 0.74


def test_estimates_that_contradict_a_known_height_stay_as_they_are():
    contacts = make_task(MultipleCollisionsConfig(known_heights=False)).prior.contacts
    wrong = with_known_height(list(contacts), -0.2, 0.03)
    for a, b in zip(contacts, wrong, strict=True):
        np.testing.assert_array_equal(a.mean, b.mean)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_the_bound_of_the_extra_time_is_that_of_creeping_at_the_fastest_impacts():
    config = MultipleCollisionsConfig(seed=100)
    task = make_task(config)
    far = creeping_distances(task)
    # From the nearest end of the range of errors to the surface.
    c, (d, *_) = task.prior.contacts[1], IMPACTS[1]
    assert far[1] == pytest.approx(0.03 - (c.mean @ d - task.truth[1]), abs=1e-9)
    bound, speeds = extra_time_bound(task, config)
    assert bound == pytest.approx(np.sum(far * (1.0 / speeds - 1.0 / config.speed)))
    # 10 N at 2e5 N/m and 3 to 8 kg without any braking: 8 to 13 mm/s; with it more.
    assert np.all(speeds > 0.008) and np.all(speeds < 0.02)
    soft = replace(config, stiffness=[2e4, 2e4])
    soft.control.anticipator.speed.first.stiffness_most = 2e4
    assert np.all(extra_time_bound(task, soft)[1] > speeds)


def test_the_model_does_not_know_where_the_world_is(task):
    weld = {
        d.add_weld.child: d.add_weld.X_PC.translation
        for scene in (task.model,)
        for d in scene.directives
        if d.add_weld is not None and d.add_weld.X_PC is not None
    }
    assert list(weld["blue_wall::blue_wall"]) == [0.635, 0.05, 0]


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(tool="hand"), "tool is 'hand'"),
        (dict(speed=0.0), "speed is 0.0"),
        (dict(trials=0), "trials is 0"),
        (dict(error_max=-0.01), "error_max is -0.01"),
        (dict(error_max=np.nan), "error_max is nan"),
        (dict(speed=2.0), "too short for 2"),
    ],
)
def test_bad_settings_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        make_task(MultipleCollisionsConfig(**change))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("trials", "3"),
        ("error_max", "0.01"),
        ("known_heights", "false"),
        ("control.shaper.region.margin", "0.01"),
        ("control.shaper.search.speed", "0.1"),
        ("control.variable_impedance.transition", "false"),
        ("control.reflex.gain", "1"),
    ],
)
def test_what_only_handling_uses_is_refused_without_it(key, value):
    settings = ["handling=false", f"{key}={value}"]
    config = apply_settings(MultipleCollisionsConfig(), settings)
    with pytest.raises(ValueError, match=f"{key} is .*: not used with handling=false"):
        make_task(config)
    make_task(replace(config, handling=True))
    if key in ("error_max", "known_heights"):  # A rehearsal uses them.
        make_task(replace(config, rehearse=1))


def test_without_handling_nothing_is_anticipated():
    config = MultipleCollisionsConfig(handling=False)
    diagram = make_multiple_collisions(config)
    assert not diagram.HasSubsystemNamed("impact_reflex")
    anticipator = diagram.GetSubsystemByName("contact_anticipator")
    context = diagram.CreateDefaultContext()
    belief = anticipator.knowledge(anticipator.GetMyContextFromRoot(context))
    assert belief.contacts == ()


# --- The score.


def made_up_log(task, peak=6.0, late=0.0):
    """A tip that goes from contact to contact, each a half sine of `peak` N, 40 ms."""
    time = np.arange(0.0, 8.0, 0.001)
    n = len(time)
    p, wrench = np.zeros((n, 7)), np.zeros((n, 6))
    contact, phase = np.zeros((n, N_CONTACT)), np.zeros((n, 6))
    p[:, :3] = [0.42, -0.16, 0.19]
    for i, ((d, _, k), where) in enumerate(zip(IMPACTS, task.truth, strict=True)):
        at = time >= 1.5 * (i + 1)
        begin = np.argmax(at)
        p[at, :3] += d * (where - p[-1, :3] @ d)
        pulse = peak * np.sin(np.pi * np.arange(40) / 40.0)
        wrench[begin : begin + 40, :3] -= pulse[:, None] * d
        phase[at, PHASE_SEGMENT] = k + 1
        contact[at, MADE] = i + 1
        contact[at, DIRECTION] = d
        contact[at, POSITION] = p[begin, :3] + late * d
        contact[at, SPEED] = 0.028
        if k == 2:
            contact[time > 1.5 * (i + 1) + 0.5, BROKEN] = 1
            p[time > 1.5 * (i + 1) + 0.6, 2] += 0.2
            p[time > 1.5 * (i + 1) + 0.6, 0] -= 0.05
    phase[time > 7.0, PHASE_STAGE] = DONE
    log = dict(
        time=time,
        ee_pose=p,
        tip_true=p[:, :3],
        wrench=wrench,
        contact=contact,
        phase=phase,
    )
    return log | dict(ee_velocity=np.zeros((n, 6)))


def test_a_made_up_trial_has_the_scores_it_was_made_with(task):
    log = made_up_log(task)
    # The segments are told one late here: the contact is where the segment begins.
    trial = scored(log, task)
    # A 100 Hz filter takes 2 % off a half sine of 40 ms.
    np.testing.assert_allclose(trial.force, 6.0, rtol=0.03)
    np.testing.assert_allclose(trial.touched, [1.5, 3.0, 4.5, 6.0], atol=2e-3)
    np.testing.assert_allclose(trial.error, 0.0, atol=1e-9)
    assert trial.whole and trial.completion == pytest.approx(6.8, abs=2e-3)


def test_a_contact_reported_elsewhere_is_false_and_the_true_one_missed(task):
    trial = scored(made_up_log(task, late=-0.01), task)
    assert trial.false == 4 and trial.missed == 4 and not trial.whole
    # An arm that believes its tip 8 mm off reports the contact there.
    off = replace(task, errors=StationErrors(tool=0.008))
    trial = scored(made_up_log(task, late=-0.01), off)
    assert trial.false == 0 and trial.missed == 0


def test_success_asks_for_each_part_of_the_criterion(task):
    good = scored(made_up_log(task), task)
    base = replace(good, completion=good.completion - 1.0)

    def success(**change):
        trials = {"baseline": base, "trial_1": replace(good, **change), "trial_2": good}
        return summary(trials, task, MultipleCollisionsConfig())["success"]

    assert success()
    assert not success(force=np.array([1.0, 1.0, 10.1, 1.0]))
    assert not success(force=np.array([1.0, np.nan, 1.0, 1.0]))
    assert not success(a10=1.01)
    assert not success(completion=base.completion + 3.1)
    assert not success(lost=False)
    assert not success(done=False)
    assert not success(missed=1)
    assert not success(false=1)


def test_result_has_one_number_per_contact(task):
    good: CollisionTrial = scored(made_up_log(task), task)
    trials = {"baseline": good, "trial_1": good, "trial_2": good}
    result = summary(trials, task, MultipleCollisionsConfig())
    for key in ("impact_force_peak_N", "impact_force_peak_known_N", "estimate_error_m"):
        assert len(result[key]) == 4
    assert result["extra_time_s"] == 0.0
    json.dumps(result, allow_nan=False)


# --- A whole run.


@pytest.mark.slow
@pytest.mark.parametrize("tool", ["sphere", "block"])
def test_the_whole_chain_is_gentle_in_the_first_trial_and_hard_without_handling(
    tool, tmp_path
):
    config = MultipleCollisionsConfig(tool=tool, trials=1, seed=103)
    result = multiple_collisions.run(config, Session(tmp_path, progress=False))
    assert result["chain_complete"] and result["contacts_missed"] == 0
    assert max(result["impact_force_peak_N"]) <= multiple_collisions.FIRST_MAX
    assert result["acceleration_10Hz_max_mps2"] <= multiple_collisions.A10_MAX
    assert max(result["impact_force_peak_baseline_N"]) > 45.0
    assert np.abs(result["contact_place_error_m"]).max() < 1e-3
    assert {p.name for p in tmp_path.glob("*.png")} == {"profiles.png", "path.png"}


def test_up_the_wall_the_motion_is_free_of_it_at_the_end():
    config = MultipleCollisionsConfig()
    half = tool_half_width(config.tool)
    pattern = make_pattern(config, half)
    up = pattern.segments[4]
    assert up.positions[-1] @ -DOWN >= BLUE_TOP + half + 0.02
    assert len(up.force_directions) == 0

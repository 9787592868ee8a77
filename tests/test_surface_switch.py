"""surface_switch: the task, its scores on made-up logs, and two short trials."""

import numpy as np
import pytest

from makebreak.diagrams.changing_contact import Knowledge
from makebreak.diagrams.surface_switch import (
    CROSSINGS,
    DOWN,
    ERROR,
    Anticipation,
    SurfaceSwitchConfig,
    Y,
    make_surface_switch,
    make_task,
    taken_over,
)
from makebreak.scripts.experiments.surface_switch import N, SwitchTrial, scored, summary
from makebreak.systems.changing_contact.numerics.contact_task import (
    IMPACTLESS,
    REGION,
    UNKNOWN_MODE,
    ContactBelief,
    ExpectedContact,
)


def test_the_motion_crosses_the_seam_twice_and_ends_in_three_contacts():
    task = make_task(SurfaceSwitchConfig(seed=3))
    pattern = task.pattern
    in_contact = [pattern.ends_in_contact(k) for k in range(len(pattern))]
    assert in_contact == [True, True, False, True, False]
    for k in range(len(pattern)):
        y = pattern.segments[k].positions[[0, -1], 1]
        assert (y[0] * y[1] < 0.0) == (k in CROSSINGS)
    # Only the three contacts are expected at first, and they are known to 3 cm: the
    # block's half width is 15 mm, the wall is at 0.175, the stop at -0.2 m.
    truth = [(DOWN, 0.015), (Y, 0.16), (-Y, -0.185)]
    for contact, (d, place) in zip(task.prior.contacts, truth, strict=True):
        np.testing.assert_array_equal(contact.direction, d)
        axis = int(np.argmax(abs(d)))
        assert 0.0 < abs(contact.mean[axis] - place) <= ERROR
    assert task.friction[0] < 0.3 < 0.4 < task.friction[1]


def belief():
    seam = ExpectedContact(
        np.zeros(3),
        1e-6 * np.eye(3),
        Y,
        kind=IMPACTLESS,
        seen=1,
        from_mode=1,
        to_mode=2,
    )
    wall = ExpectedContact(np.ones(3), 1e-6 * np.eye(3), Y)
    return Knowledge(contacts=ContactBelief((seam, wall)))


@pytest.mark.parametrize(
    "places, models, seams, to_mode",
    [(True, True, 1, 2), (True, False, 1, UNKNOWN_MODE), (False, True, 0, None)],
)
def test_what_is_anticipated_can_be_left_out(places, models, seams, to_mode):
    out = taken_over(belief(), Anticipation(places, models)).contacts.contacts
    found = [c for c in out if c.kind == IMPACTLESS]
    assert len(found) == seams and len(out) == seams + 1
    if seams:
        assert found[0].to_mode == to_mode and found[0].from_mode == 1


def made_up(spike=0.01, error=0.002, region=(0.01, 0.02)):
    """A log over the seam in segments 1 and 3 at 0.1 m/s, with what is to be found."""
    time = np.arange(0.0, 8.0, 0.001)
    n = len(time)
    out = time < 4.0
    y = np.where(out, -0.2 + 0.1 * time, 0.6 - 0.1 * time)
    sign = np.where(out, 1.0, -1.0)
    log = {
        "time": time,
        "ee_pose": np.column_stack([np.zeros(n), y, np.zeros((n, 5))]),
        "ee_velocity": np.zeros((n, 6)),
        "x_desired": np.zeros((n, 19)),
        "phase": np.zeros((n, 6)),
        "transition": np.zeros((n, 6)),
        "stiffness": np.full((n, 6), 300.0),
    }
    log["phase"][:, 0] = np.where(out, *CROSSINGS)
    log["ee_velocity"][:, 1] = 0.1 * sign
    log["x_desired"][:, 8] = 0.1 * sign
    log["x_desired"][:, :3] = log["ee_pose"][:, :3]
    for k, at in enumerate((2.0, 6.0)):  # Over the seam.
        near = abs(time - at) < 0.1
        log["ee_velocity"][near, 1] -= (spike * sign)[near]
        log["x_desired"][near, 0] += error
        inside = abs(time - at) < region[k] / 0.2
        log["phase"][inside, 1:3] = REGION, IMPACTLESS
        # The feet are 12 mm ahead: 0.12 s before.
        log["transition"][time > at + 0.3] = [k + 1, at - 0.12, 1, 2, 0, at + 0.3]
    return log


def test_scores_are_what_the_log_was_made_of():
    trial = scored(made_up(), 0.012)
    np.testing.assert_allclose(trial.error, 0.002, rtol=1e-6)
    # A Butterworth filter overshoots a step of 10 mm/s by 4.3 %.
    np.testing.assert_allclose(trial.spike, 0.01043, rtol=2e-3)
    np.testing.assert_allclose(trial.place_error, 0.0, atol=2.1e-4)  # Two samples.
    np.testing.assert_allclose(trial.handling, [0.1, 0.2], atol=2.1e-3)
    # Its speed is 10 mm/s lower there.
    np.testing.assert_allclose(trial.region, [0.009, 0.018], atol=3e-4)
    np.testing.assert_allclose(trial.stiff, 300.0)
    assert not trial.done


def test_a_seam_without_its_report_is_not_recognised():
    log = made_up()
    log["transition"][:, 0] = np.minimum(log["transition"][:, 0], 1.0)
    trial = scored(log, 0.012)
    assert np.isfinite(trial.place_error[0]) and np.isnan(trial.place_error[1])


def trials(spikes, errors, regions):
    out = []
    for spike, error, region in zip(spikes, errors, regions, strict=True):
        both = {"spike": spike, "error": error, "region": region, "handling": region}
        both |= {"a10": 0.1, "place_error": 0.001, "stiff": 300.0}
        values = {name: np.full(N, value) for name, value in both.items()}
        out.append(SwitchTrial(log={}, done=True, rows=[], **values))
    return out


@pytest.mark.parametrize(
    "spikes, errors, regions, success",
    [
        ((8, 4, 3), (2, 1, 1), (0, 5, 4), True),
        ((8, 4.1, 3), (2, 1, 1), (0, 5, 4), False),
        ((8, 4, 3), (2, 1.1, 1), (0, 5, 4), False),
        ((8, 4, 3), (2, 1, 1), (0, 5, 5), False),
    ],
)
def test_the_criterion_is_the_one_that_was_set(spikes, errors, regions, success):
    task = make_task(SurfaceSwitchConfig())
    assert summary(trials(spikes, errors, regions), task)["success"] is success


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(speed=np.nan), "speed is nan"),
        (dict(trials=0), "trials is 0"),
        (dict(normal_force=0.0), "normal_force is 0.0"),
        (dict(tool="brush"), "brush"),
        (dict(seed=-2), "seed is -2"),
        (
            dict(trials=1, anticipation=Anticipation(models=False)),
            "anticipation.models is False, expected True: nothing is known",
        ),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        make_task(SurfaceSwitchConfig(**changes))


def test_rows_of_feet_are_those_of_the_tool():
    config = SurfaceSwitchConfig()
    config.control.forward_model.handover.rows = 0.01
    with pytest.raises(ValueError, match="handover.rows is 0.01, expected 0.0: the di"):
        make_surface_switch(config, make_task(config))


def test_the_tool_decides_how_a_seam_is_crossed():
    for tool, rows, height, crossing in (
        ("block", 0.024, 0.015, 0.03),
        ("sphere", 0.0, 0.0, 0.01),
    ):
        config = SurfaceSwitchConfig(tool=tool)
        diagram = make_surface_switch(config, make_task(config))
        bank = diagram.GetSubsystemByName("forward_model_bank")
        detector = diagram.GetSubsystemByName("mode_detector")
        np.testing.assert_allclose(bank._tuning.rows, rows)
        np.testing.assert_allclose(bank._tuning.height, height)
        np.testing.assert_allclose(detector._tuning.crossing, crossing)

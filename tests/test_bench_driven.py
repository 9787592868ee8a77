"""The comparison of tools on robots that follow commands, of `makebreak bench gap`."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from makebreak.benchmarks import driven
from makebreak.benchmarks.driven_rig import Log, Rig, scales

mujoco = pytest.importorskip("mujoco", reason="mujoco has no wheels for this Python")

# A rod on a hinge: m g l = 2 N m; inertia about the hinge 0.05, rotor 0.02 kg m2.
ROD = """<mujoco><worldbody><body><joint name="j" axis="0 1 0" armature="0.02"/>
<inertial pos="0 0 -0.2" mass="1.0194" diaginertia="0.009224 0.009224 0.001"/></body>
</worldbody></mujoco>"""
PULL, INERTIA, KP, KD = 1.0194 * 9.81 * 0.2, 0.07, 40.0, 2.0
FRICTION, DAMPING = 0.3, 0.1
HARD = np.array([0.002, 1.0]), np.array([0.9999, 0.9999, 0.001, 0.5, 2.0])


def rod(friction=0.0, damping=0.0):
    spec = mujoco.MjSpec.from_string(ROD)
    rig = Rig(spec, ["j"], [KP], [KD], dry=HARD)
    found = {"friction": np.array([friction]), "damping": np.array([damping])}
    return rig, replace(rig.values, **found)


def log_of(time, q, goal, hz):
    return Log(time, q[:, None], goal[:, None], 0.0 * q[:, None], hz)


def motion(t):
    """q, v and v' of two sines."""
    w, size = np.array([[3.0], [11.0]]), np.array([[0.5], [0.15]])
    sin, cos = size * np.sin(w * t), size * np.cos(w * t)
    return sin.sum(axis=0), (w * cos).sum(axis=0), -(w**2 * sin).sum(axis=0)


def effort_of(q, v, a):
    return INERTIA * a + PULL * np.sin(q) + FRICTION * np.sign(v) + DAMPING * v


def swing():
    """The rod follows them against friction and damping: closed form."""
    time = np.arange(0.0, 2.5, 0.002)
    q, v, a = motion(time + 0.001)  # A held command acts half a row late.
    goal = q + (effort_of(q, v, a) + KD * v) / KP
    return log_of(time, motion(time)[0], goal, 500.0)


def test_a_step_gets_the_mean_of_the_commands_that_arrive_in_it():
    time = np.array([0.0, 0.1, 0.2])
    log = log_of(time, time, np.array([1.0, 3.0, 8.0]), 10.0)
    # 30 ms late: 1 for 30 ms, then 3 for 20 ms; before the first command, the first.
    got = log.controls(np.array([-0.05, 0.1, 0.15]) - 0.03)[:, 0]
    np.testing.assert_allclose(got, [1.0, (0.03 * 1.0 + 0.02 * 3.0) / 0.05])


def test_a_command_acts_from_when_it_was_sent_not_from_its_row():
    time = np.arange(0.0, 0.2, 0.04)  # Commands each 50 ms: shown 30, 20, 10 ms late.
    sent = np.floor(time / 0.05 + 1e-9)
    log = log_of(time, time, sent, 20.0)
    got = log.controls(np.array([0.0, 0.05, 0.1, 0.15]))[:, 0]
    np.testing.assert_allclose(got, [0.0, 1.0, 2.0], atol=1e-12)


def test_a_simulated_joint_moves_by_the_drive_s_law():
    """Beside scipy, with an offset, a delay, damping, and another gain and rotor."""
    goal, late, offset, kp, rotor = 0.5, 0.013, 0.05, 30.0, 0.04
    time = np.arange(0.0, 0.6, 0.005)
    commands = np.where(time < 0.1 - 1e-9, 0.0, goal)

    def law(t, x):
        sent = goal if t - late >= 0.1 else 0.0
        effort = kp * (sent + offset - x[0]) - (KD + DAMPING) * x[1]
        return [x[1], (effort - PULL * np.sin(x[0])) / (0.05 + rotor)]

    true = solve_ivp(law, (0, time[-1]), [0, 0], t_eval=time, max_step=1e-3, rtol=1e-9)
    rig, values = rod(damping=DAMPING)
    values = replace(
        values, offset=np.array([offset]), kp=np.array([kp]), rotor=np.array([rotor]),
        delay=np.array([late]),
    )  # fmt: skip
    log = log_of(time, 0.0 * time, commands, 200.0)
    errors = []
    for step in (2e-3, 5e-4):
        [q] = rig.simulate([values], log, step=step)
        errors.append(abs(q[:, 0] - true.y[0]).max())
    # Half of a step's motion, and its half again by other terms of first order.
    assert errors[1] < 5e-4 * abs(true.y[1]).max()
    # Four times the step errs four times as much unless its commands come later.
    assert errors[0] < 2.5 * errors[1]


def test_what_was_right_and_moves_effort_by_more_than_a_share_is_false():
    log = swing()
    rig, _ = rod()
    true = replace(rig.values, friction=np.array([FRICTION]))
    effort = scales(rig, log)[1][0]
    q, v, _ = motion(log.time)
    law = KP * (log.goal[:, 0] - q) - KD * v
    assert effort == pytest.approx(np.sqrt(np.mean(law**2)), rel=0.01)
    found = replace(
        rig.values, friction=np.array([0.9 * FRICTION]),
        offset=np.array([0.031 * effort / KP]),
        damping=np.array([0.029 * effort / np.sqrt(np.mean(v**2))]),
    )  # fmt: skip
    assert driven.false_of(found, rig, true, log) == ["offset 1"]
    np.testing.assert_allclose(driven.errors_of(found, rig.values, true), [0.1])
    late = replace(rig.values, delay=np.array([0.02]))
    assert driven.false_of(late, rig, true, log) == ["delay 1"]


@pytest.mark.parametrize("fit", [driven.by_cma, driven.by_sysid])
def test_the_tools_find_friction_and_damping_of_a_swing_of_closed_form(fit):
    if not driven.available():
        pytest.skip("needs makebreak[sysid]")
    rig, _ = rod()
    found = fit(rig, swing())
    assert found.friction == pytest.approx(FRICTION, rel=0.05)
    assert found.damping == pytest.approx(DAMPING, rel=0.1)


def test_without_the_tools_one_row_says_so(monkeypatch):
    monkeypatch.setattr(driven, "available", lambda: False)
    monkeypatch.setattr(driven.bench_sysid, "check", lambda which: None)
    [row] = driven.rows()
    assert "makebreak[sysid]" in row["note"] and "value" not in row

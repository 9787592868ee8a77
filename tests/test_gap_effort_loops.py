"""Measured efforts that are samples of a loop: no damping that is not there."""

import json
from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import double

from makebreak.gap.data.effort_loops import OF_LOOP, SHARES, loop_of, of_loops
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.workflow import run_gap
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import ActuationSection
from makebreak.models.scene_file import write_scene
from makebreak.scripts.cli import main

JOINTS = ["d.j1", "d.j2"]
KP, KD, NOISE = np.array([200.0, 60.0]), np.array([12.0, 4.0]), 0.02


def log_of_efforts(tmp_path, step, rows=0.004, told_sec=0.02):
    """A scene without commands, and the log of a simulator's steps [s] (semi-implicit
    Euler) of drives that follow positions: positions, velocities and efforts as they
    are when a row's step begins; and the mean effort from each row to the next."""
    scene = replace(
        double(tmp_path), actuation=ActuationSection("effort", joints=JOINTS)
    )
    write_scene(scene, tmp_path / "scene.yaml")
    plant = SceneDynamics(scene).plant
    context = plant.CreateDefaultContext()
    braked = [plant.GetJointByName(j.split(".")[1]).default_damping() for j in JOINTS]
    at = told_sec * np.arange(round(20.0 / told_sec))
    told = 0.3 * np.array([
        np.sin(2.1 * at) + np.sin(0.7 * at), np.sin(2.9 * at) - np.sin(1.1 * at)
    ])  # fmt: skip
    q, v, log, acted = np.array(told[:, 0]), np.zeros(2), [], []
    for k in range(round(19.0 / step)):
        t = k * step
        goal = told[:, int(t / told_sec + 1e-9)]
        effort = KP * (goal - q) - KD * v
        if k % round(rows / step) == 0:
            log.append([t, *q, *v, *effort])
            acted.append([])
        acted[-1].append(effort)
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        force = effort - braked * v - plant.CalcBiasTerm(context)
        force += plant.CalcGravityGeneralizedForces(context)
        v = v + step * np.linalg.solve(plant.CalcMassMatrix(context), force)
        q = q + step * v
    log = np.array(log)
    noise = np.random.default_rng(1).normal(size=(len(log), 6))
    log[:, 1:] += noise * np.repeat([1e-5, 1e-3, NOISE], 2)
    names = [f"{j}.{what}" for what in ("position", "velocity", "effort_measured")
             for j in JOINTS]  # fmt: skip
    file = tmp_path / "recording.csv"
    np.savetxt(file, log, "%.9g", ",", header=",".join(["time", *names]), comments="")
    return file, np.array([np.mean(each, axis=0) for each in acted])


def test_a_loop_is_told_by_how_its_effort_changes_between_commands(tmp_path):
    file, _ = log_of_efforts(tmp_path, 0.0005)
    (recording,) = read_recordings([file])
    for i, joint in enumerate(JOINTS):
        loop = loop_of(recording, joint)
        q, v = (recording[f"{joint}.{what}"] for what in ("position", "velocity"))
        own = -KP[i] * np.diff(q) - KD[i] * np.diff(v)
        held = np.abs(loop.jumps[1:]) < 5.0 * NOISE
        assert np.std((loop.own[1:] - own)[held]) < 3.0 * NOISE
        assert NOISE < loop.std < 1.5 * NOISE  # Velocities' is in it.
        assert 0.05 < np.mean(~held) < 0.25  # Every fifth row.


def test_a_line_through_samples_acts_as_their_loop_did(tmp_path):
    """Fast loops, and commands that come at rows: each jump acts half a row early
    else, which is damping of 2 ms of the stiffness."""
    file, acted = log_of_efforts(tmp_path, 0.0005)
    recordings = read_recordings([file])
    (line,), (right,) = recordings, of_loops(recordings, 0.5)
    for i, joint in enumerate(JOINTS):
        name = f"{joint}.effort_measured"
        v = line[f"{joint}.velocity"][:-1]
        found = []
        for r in (line, right):
            off = 0.5 * (r[name][1:] + r[name][:-1]) - acted[:-1, i]
            found.append(float(off @ v / (v @ v)))
        assert found[0] == pytest.approx(KP[i] * 0.002, rel=0.3)
        assert abs(found[1]) < 0.15 * abs(found[0])
        assert right.channels[name].noise_from == OF_LOOP


def test_efforts_that_no_command_jumps_in_stay_as_they_are(tmp_path):
    t = 0.004 * np.arange(5000)
    q, v = np.sin(t), np.cos(t)
    effort = -3.0 * q - 0.2 * v
    noise = np.random.default_rng(0).normal(size=(3, len(t)))
    columns = np.array([q, v, effort]) + noise * [[1e-5], [1e-3], [NOISE]]
    file = tmp_path / "recording.csv"
    names = "time,d.j1.position,d.j1.velocity,d.j1.effort_measured"
    np.savetxt(file, np.vstack([t, columns]).T, "%.9g", ",", header=names, comments="")
    recordings = read_recordings([file])
    assert loop_of(recordings[0], "d.j1") is None
    (same,) = of_loops(recordings, 0.0)
    name = "d.j1.effort_measured"
    np.testing.assert_array_equal(same[name], recordings[0][name])


@pytest.mark.parametrize(
    "step, share",
    [(0.002, 0.25), pytest.param(0.0005, 0.5, marks=pytest.mark.slow)],
)
def test_of_efforts_alone_no_damping_is_named(tmp_path, step, share):
    """Dampings of all joints of a Pegasus and of a B1, before."""
    file, _ = log_of_efforts(tmp_path, step)
    result = run_gap(tmp_path / "scene.yaml", [file])
    assert result.verdict == "no_gap" and not result.effects
    assert share in SHARES
    (said,) = [f for f in result.checks if f.kind == "sampled_commands"]
    assert abs(said.size / 0.004 - share) < 0.16


ARM = """<mujoco model="arm"><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="a" pos="0 0 .3"><joint name="j1" axis="0 0 1"/>
<inertial mass="4" pos="0 .02 .1" diaginertia=".03 .03 .02"/>
<body name="b" pos="0 0 .2"><joint name="j2" axis="0 1 0"/>
<inertial mass="4" pos="0 0 .2" diaginertia=".06 .06 .01"/>
<body name="c" pos="0 0 .4"><joint name="j3" axis="0 1 0"/>
<inertial mass="2" pos=".01 0 .15" diaginertia=".02 .02 .005"/>
<body name="d" pos="0 0 .3"><joint name="j4" axis="1 0 0"/>
<inertial mass="1" pos="0 0 .1" diaginertia=".005 .005 .002"/>
</body></body></body></body></worldbody></mujoco>"""


@pytest.mark.slow
def test_a_torque_constant_that_all_gains_and_masses_could_stand_for_is_named(tmp_path):
    """Of one joint by a tenth: with all masses and the other drives' gains a few per
    cent larger, each within its tolerance, equations agree. Nothing else is named."""
    mujoco = pytest.importorskip("mujoco")
    spec, rng = mujoco.MjSpec.from_string(ARM), np.random.default_rng(3)
    for joint in list(spec.joints):
        spec.add_actuator(name=joint.name, target=joint.name).trntype = 0
    model = spec.compile()
    data, rows = mujoco.MjData(model), []
    kp, kd = np.array([400.0, 1600.0, 250.0, 13.0]), np.array([18.0, 70.0, 11.0, 0.6])
    f, phase = rng.uniform(0.15, 0.45, (3, 4)), rng.uniform(0.0, 6.0, (3, 4))
    size, middle = np.array([0.4, 0.25, 0.3, 0.3]), np.array([0.0, 0.3, 0.6, 0.2])
    for k in range(9000):  # Each second step has a row, with a new command.
        if k % 2 == 0:
            told = middle + size * np.sum(np.sin(4e-3 * np.pi * f * k + phase), axis=0)
        data.qpos[:] = told if k == 0 else data.qpos
        data.ctrl[:] = kp * (told - data.qpos) - kd * data.qvel
        if k % 2 == 0 and k >= 500:
            rows.append([*data.qpos, *data.qvel, *data.ctrl, *told])
        mujoco.mj_step(model, data)
    q, v, u, told = np.array(rows).reshape(-1, 4, 4).transpose(1, 0, 2)
    u = u * [1.0, 1.0, 1.1, 1.0]
    q, v, u = (
        x + std * rng.normal(size=x.shape)
        for x, std in ((q, 2e-5), (v, 4e-4), (u, 0.003 * np.abs(u).max(axis=0)))
    )
    (tmp_path / "arm.xml").write_text(ARM)
    time = 0.004 * np.arange(len(q))
    np.savez(tmp_path / "log.npz", time=time, q=q, dq=v, tau=u, q_des=told)
    out = tmp_path / "out"
    paths = [str(tmp_path / name) for name in ("arm.xml", "log.npz")]
    assert main(["gap", *paths, "--out", str(out)]) == 0
    result = json.loads((out / "result.json").read_text())
    (effect,) = result["effects"]
    assert (effect["kind"], effect["at"]) == ("actuator_gain", "arm.j3")
    gain = effect["parameters"]["gain"]
    assert abs(gain["value"] - 1.0 / 1.1) < 2.0 * gain["std"] < 0.08

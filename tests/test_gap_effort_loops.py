"""Measured efforts that are samples of a loop: no damping that is not there."""

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


@pytest.mark.parametrize("step, share", [(0.002, 0.25), (0.0005, 0.5)])
def test_of_efforts_alone_no_damping_is_named(tmp_path, step, share):
    """Dampings of all joints of a Pegasus and of a B1, before."""
    file, _ = log_of_efforts(tmp_path, step)
    result = run_gap(tmp_path / "scene.yaml", [file])
    assert result.verdict == "no_gap" and not result.effects
    assert share in SHARES
    (said,) = [f for f in result.checks if f.kind == "sampled_commands"]
    assert abs(said.size / 0.004 - share) < 0.16

"""Logs of MuJoCo's own steps: what its world does, and equations of motion do not."""

import json
from pathlib import Path

import numpy as np
import pytest

from makebreak.gap import workflow
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.robot import propose_scene, read_log, read_robot
from makebreak.gap.problem import rms
from makebreak.gap.residuals.in_mujoco import MujocoProblem
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene
from makebreak.scripts.cli import main

mujoco = pytest.importorskip("mujoco", reason="MuJoCo has no wheels for Python 3.10")

# Damping stops it within 20 ms, which is a step.
LIGHT = """<mujoco model="light"><option timestep="0.02"/><worldbody><body name="arm">
<joint name="turn" axis="0 0 1" damping=".01" frictionloss="{friction}" range="-60 60"/>
<geom type="capsule" size=".01" fromto="0 0 0 .12 0 0"/></body></worldbody>
<actuator><motor joint="turn" gear=".05" ctrlrange="-1 1"/></actuator></mujoco>"""


def compared(folder, friction):
    """(verdict, {kind}, what is left, kinds of checks) of a log of 14 s, with friction
    hidden [N m]."""
    (folder / "light.xml").write_text(LIGHT.format(friction=0.0))
    model = mujoco.MjModel.from_xml_string(LIGHT.format(friction=friction))
    data, rng = mujoco.MjData(model), np.random.default_rng(2)
    waves = [(rng.uniform(2, 15), rng.uniform(0, 6)) for _ in range(4)]
    rows = []
    for t in np.arange(0.0, 14.0, 0.02):
        u = 0.22 * sum(np.sin(w * t + p) for w, p in waves)
        rows.append([t, data.qpos[0], data.qvel[0], u])
        data.ctrl[0] = u
        mujoco.mj_step(model, data)
    t, q, v, u = np.transpose(rows)
    noise = rng.normal(size=(2, len(t)))
    columns = {"qpos": q + 1e-4 * noise[0], "qvel": v + 1e-3 * noise[1], "ctrl": u}
    np.savez(
        folder / "log.npz", time=t, **{name: y[:, None] for name, y in columns.items()}
    )
    files = [str(folder / name) for name in ("light.xml", "log.npz")]
    main(["gap", *files, "--out", str(folder / "out")])
    result = json.loads((folder / "out" / "result.json").read_text())
    return (
        result["verdict"], {e["kind"] for e in result["effects"]},
        result["gap"]["after"], {check["kind"] for check in result["checks"]},
    )  # fmt: skip


def test_what_mujocos_steps_do_is_no_gap(tmp_path):
    verdict, effects, left, checks = compared(tmp_path, 0.0)
    assert (verdict, effects) == ("no_gap", set())
    assert left < 1.0 and {"mujoco_contacts", "velocity_lag"} <= checks


def test_a_friction_is_named_beside_such_steps(tmp_path):
    verdict, effects, left, _ = compared(tmp_path, 0.004)
    assert (verdict, effects) == ("gap_named", {"joint_coulomb_friction"})
    assert left < 3.0


# A tip that is pressed on a table: what it feels is known by measured efforts alone.
WIPER = """<mujoco model="wiper"><compiler angle="radian"/><option timestep=".002"/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
<geom name="table" type="box" pos=".55 0 {z}" size=".4 .3 .02" contype="1"/>
<body name="upper" pos="0 0 .35">
<joint name="a" axis="0 1 0" damping=".1" armature=".05"/>
<geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="2"/>
<body name="fore" pos=".4 0 0">
<joint name="b" axis="0 1 0" damping=".1" armature=".04" frictionloss="{friction}"/>
<geom type="capsule" fromto="0 0 0 .35 0 0" size=".025" mass="1.5"/>
<geom type="sphere" pos=".37 0 0" size=".02" mass=".1" conaffinity="1"/>
<site name="tip" pos=".37 0 0"/></body></body></worldbody>
<actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""
START, NOISE = [-0.3, 1.1], 0.05


def wiped(folder, seconds, **hidden):
    """Files of a robot and of its log at 250 Hz, with measured torques; hidden: what
    the robot's file has otherwise."""
    given = {"z": 0.02, "friction": 0.0}
    (folder / "wiper.xml").write_text(WIPER.format(**given))
    model = mujoco.MjModel.from_xml_string(WIPER.format(**given | hidden))
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(4), []
    data.qpos[:] = START
    mujoco.mj_forward(model, data)
    x0, J = data.site("tip").xpos.copy(), np.zeros((3, 2))
    for k in range(int(seconds / 0.002)):
        t, x = data.time, data.site("tip").xpos
        mujoco.mj_jacSite(model, data, J, None, model.site("tip").id)
        to = x0[0] + 0.06 * min(t, 1.0) * np.sin(2.0 * t)
        push = -15.0 - 4.0 * np.sin(5.0 * t) if t > 0.5 else 300.0 * (x0[2] - x[2])
        force = np.array([300.0 * (to - x[0]), 0.0, push]) - 30.0 * (J @ data.qvel)
        data.ctrl[:] = J.T @ force + data.qfrc_bias
        if k % 2 == 0:
            rows.append([t, *data.qpos, *data.qvel, *data.ctrl])
        mujoco.mj_step(model, data)
    rows = np.array(rows)
    size = [0.0, 2e-5, 2e-5, 2e-3, 2e-3, NOISE, NOISE]
    rows += size * rng.normal(size=rows.shape)
    names = "time,a_pos,b_pos,a_vel,b_vel,a_torque,b_torque"
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=names, comments="")
    return [str(folder / name) for name in ("wiper.xml", "log.csv")]


def test_windows_know_the_noise_of_measured_efforts(tmp_path):
    """Which the noise of positions is nothing beside: what it makes of a motion is
    expected, and so is no gap."""
    robot, log = map(Path, wiped(tmp_path, 6.0))
    proposal = propose_scene(read_robot(robot), [read_log(log)])
    (tmp_path / "scene.yaml").write_text(proposal.scene)
    for path, text in proposal.sidecars.items():
        path.with_suffix(".yaml").write_text(text)
    problem = MujocoProblem(read_scene(tmp_path / "scene.yaml"), read_recordings([log]))
    assert 0.4 < rms(problem.base()) < 1.3
    assert problem.does_with([])
    assert not problem.does_with([Effect("link_mass", ["wiper.fore"], {"mass": 0.5})])


def test_what_equations_of_measured_efforts_explain_is_not_asked_of_mujoco(
    tmp_path, monkeypatch
):
    asked = []
    monkeypatch.setattr(workflow, "_in_mujoco", lambda *args: asked.append(args))
    main(["gap", *wiped(tmp_path, 8.0), "--out", str(tmp_path / "out")])
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["verdict"] == "no_gap" and not asked


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "kind", "value"),
    [
        ({"z": 0.024}, "plane_height", 0.004),
        ({"friction": 0.6}, "joint_coulomb_friction", 0.6),
    ],
)
def test_of_an_arm_that_presses_measured_efforts_tell_what_is_hidden(
    tmp_path, hidden, kind, value
):
    main(["gap", *wiped(tmp_path, 14.0, **hidden), "--out", str(tmp_path / "out")])
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert [e["kind"] for e in result["effects"]] == [kind]
    (found,) = result["effects"][0]["parameters"].values()
    assert abs(found["value"] - value) < 3.0 * found["std"] + 0.02 * value

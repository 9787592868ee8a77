"""Commands that a drive adds up, or lags behind: as MuJoCo does it, in sidecars and in
proposals."""

import mujoco
import numpy as np
import pytest

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.robot import propose_scene, read_log, read_robot
from makebreak.models.activation import Activation

ROBOT = """<mujoco><option timestep="0.001"/><worldbody><body>
<joint name="j" axis="0 1 0" armature="0.02"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/></body></worldbody>
<actuator>{actuator}</actuator></mujoco>"""
PERIOD = 0.01


def simulated(folder, actuator: str, begins: float = 0.0):
    """A log of 4 s from `begins` on [s], and what MuJoCo's actuator followed."""
    (folder / "a.xml").write_text(ROBOT.format(actuator=actuator))
    m = mujoco.MjModel.from_xml_path(str(folder / "a.xml"))
    d, rows, act = mujoco.MjData(m), [], []
    for k in range(round((begins + 4.0) / 0.001)):
        if k % 10 == 0:
            d.ctrl[0] = 1.5 * np.cos(2.0 * d.time) + 0.4 * np.sign(np.sin(3.0 * d.time))
            if d.time > begins - 1e-6:
                rows.append([d.time, *d.qpos, *d.qvel, *d.ctrl])
                act.append(d.act[0])
        mujoco.mj_step(m, d)
    text = "time,j_position,j_velocity,ctrl_a\n"
    text += "\n".join(",".join(map(repr, map(float, row))) for row in rows)
    (folder / "log.csv").write_text(text + "\n")
    return np.array(act)


def proposed(folder):
    """The scene and the recording as a proposal has them."""
    robot, log = read_robot(folder / "a.xml"), read_log(folder / "log.csv")
    proposal = propose_scene(robot, [log])
    (folder / "log.yaml").write_text(proposal.sidecars[log.path])
    return proposal, read_recordings([log.path])[0]


@pytest.mark.parametrize(
    ("actuator", "gear"),
    [
        ('<intvelocity joint="j" kp="50" kv="2" actrange="-2 2"/>', 1.0),
        ('<intvelocity joint="j" kp="50" kv="2" actrange="-0.2 0.3"/>', 1.0),
        ('<intvelocity joint="j" kp="5" kv="0.2" gear="-3" actrange="-6 6"/>', -3.0),
        ('<position joint="j" kp="50" kv="2" timeconst="0.08"/>', 1.0),
    ],
)
def test_a_command_is_what_the_actuator_makes_of_its_ctrl(tmp_path, actuator, gear):
    act = simulated(tmp_path, actuator)
    proposal, recording = proposed(tmp_path)
    assert "type: servo  # From the file." in proposal.scene
    assert "hold: first_order" in proposal.scene
    np.testing.assert_allclose(recording["a.j.position_command"], act / gear, atol=2e-9)


def test_one_of_effort_holds_on_average_between_rows(tmp_path):
    actuator = '<general joint="j" gear="2" dyntype="filterexact" dynprm="0.05"/>'
    act = simulated(tmp_path, actuator)
    _, recording = proposed(tmp_path)
    mean = 2.0 * 0.5 * (act[1:] + act[:-1])
    np.testing.assert_allclose(recording["a.j.effort_command"][:-1], mean, atol=1e-9)


def test_a_log_that_begins_later_begins_where_the_joint_is(tmp_path):
    act = simulated(tmp_path, '<intvelocity joint="j" kp="500" actrange="-2 2"/>', 0.5)
    _, recording = proposed(tmp_path)
    off = recording["a.j.position_command"] - act
    assert np.ptp(off) < 1e-8 and abs(off[0]) < 0.01 < 0.1 < abs(act[0])


def test_what_an_unknown_actuator_takes_is_no_effort(tmp_path):
    simulated(tmp_path, '<intvelocity joint="j" kp="50" actrange="-2 2"/>')
    robot = (tmp_path / "a.xml").read_text()
    other = '<general joint="j" biastype="affine" biasprm="1 0 0"/>'
    at = robot.index("<intvelocity")
    (tmp_path / "a.xml").write_text(robot[:at] + other + "</actuator></mujoco>")
    proposal, recording = proposed(tmp_path)
    assert (
        "ctrl_a: null  # what a.xml's actuator makes of it is not known"
        in (proposal.sidecars[recording.path])
    )
    assert [c.name for c in recording.commands()] == []


def test_gains_of_a_velocity_servo_are_those_of_the_file(tmp_path):
    simulated_velocity(tmp_path)
    proposal, recording = proposed(tmp_path)
    assert "type: velocity  # From the file." in proposal.scene
    assert "kd: [18.0]" in proposal.scene
    ctrl = np.genfromtxt(tmp_path / "log.csv", delimiter=",", names=True)["ctrl_a"]
    np.testing.assert_allclose(recording["a.j.velocity_command"], ctrl / 3.0)


def simulated_velocity(folder):
    simulated(folder, '<intvelocity joint="j" kp="50" actrange="-2 2"/>')
    actuator = '<velocity joint="j" kv="2" gear="3"/>'
    (folder / "a.xml").write_text(ROBOT.format(actuator=actuator))


@pytest.mark.parametrize(
    ("said", "wants"),
    [
        ("{channel: a.j.position_command, lag: 0}", "expected add_up_from, or a lag"),
        ("{channel: a.j.position_command, lag: 1, add_up_from: 0}", "expected add_up"),
        ("{channel: a.j.position_command, add_up_from: x}", "where it begins is 'x'"),
        ("{channel: a.j.position_command, lag: 1, between: [2, 1]}", "[low, high]"),
        ("{channel: a.j.position_command, lag: 1, between: 3}", "[low, high]"),
    ],
)
def test_a_sidecar_that_says_it_wrongly_is_refused(tmp_path, said, wants):
    simulated(tmp_path, '<intvelocity joint="j" kp="50" actrange="-2 2"/>')
    (tmp_path / "log.yaml").write_text(
        "columns: {j_position: a.j.position, j_velocity: a.j.velocity, "
        f"ctrl_a: {said}}}"
    )
    with pytest.raises(ValueError, match="ctrl_a") as error:
        read_recordings([tmp_path / "log.csv"])
    assert wants in str(error.value) and "\n" not in str(error.value)


def test_what_is_added_up_begins_again_with_an_episode():
    time = np.array([0.0, 0.1, 0.2, 0.0, 0.1])
    u = np.array([1.0, np.nan, 2.0, 3.0, 0.0])
    act = Activation(start=0.5).of(u, time)
    np.testing.assert_allclose(act, [0.5, 0.6, 0.7, 0.5, 0.8])


SWUNG = """<mujoco><option timestep="0.001"><flag {flag}="disable"/></option>
<worldbody><geom type="plane" size="1 1 0.1"/><body pos="0 0 0.5">
<joint name="rail" type="slide" axis="1 0 0" range="-1 1" frictionloss="0.5"
 limited="true" stiffness="2" damping="0.3"/><geom type="box" size="0.1 0.1 0.05"/>
<body><joint name="pole" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 0.6"
 size="0.02"/></body><body><joint name="goal" type="slide" axis="0 1 0"/>
<geom type="sphere" size="0.01"/></body></body></worldbody>
<actuator><motor joint="rail" gear="20"/></actuator></mujoco>"""


def swung(folder, flag="contact"):
    (folder / "a.xml").write_text(SWUNG.format(flag=flag))
    m = mujoco.MjModel.from_xml_path(str(folder / "a.xml"))
    d, rows = mujoco.MjData(m), {k: [] for k in ("time", "qpos", "qvel", "ctrl")}
    d.qvel[1] = 9.0
    for k in range(8000):
        d.ctrl[0] = np.sin(5.0 * d.time)
        if k % 10 == 0:
            for name, values in rows.items():
                values.append(np.copy(getattr(d, name)))
        mujoco.mj_step(m, d)
    np.savez(folder / "log.npz", **{k: np.array(x) for k, x in rows.items()})
    return m, read_robot(folder / "a.xml"), read_log(folder / "log.npz")


def test_a_list_of_one_actuator_and_a_joint_that_stands_still(tmp_path):
    _, robot, log = swung(tmp_path)
    assert np.ptp(log.table.columns["qpos[1]"]) > 15.0  # It turns over and over.
    proposal = propose_scene(robot, [log])
    sidecar = proposal.sidecars[log.path]
    assert "ctrl: {channel: a.rail.effort_command, scale: 20.0}" in sidecar
    assert "'qpos[1]': a.pole.position" in sidecar  # In rad.
    assert "fixed_joints: {a.goal: 0}" in proposal.scene
    assert not {"units", "position_from_start"} & {s.kind for s in proposal.said}


@pytest.mark.parametrize(
    ("flag", "gone"),
    [
        ("gravity", {"gravity"}),
        ("contact", {"contact"}),
        ("frictionloss", {"friction"}),
        ("limit", {"limit"}),
        ("damper", {"damping"}),
        ("spring", {"spring"}),
        ("constraint", {"contact", "friction", "limit"}),
        ("midphase", set()),
    ],
)
def test_what_a_flag_of_mujoco_switches_off_is_not_in_the_scene(tmp_path, flag, gone):
    (tmp_path / "a.xml").write_text(SWUNG.format(flag=flag))
    robot = read_robot(tmp_path / "a.xml")
    rail = robot.plant.GetJointByName("rail")
    kinds = {e.kind for e in robot.file.effects}
    there = {
        "gravity": robot.file.gravity[2] != 0.0,
        "contact": robot.file.has_ground,
        "friction": "joint_coulomb_friction" in kinds,
        "limit": bool(np.isfinite(rail.position_upper_limits()[0])),
        "damping": bool(rail.default_damping_vector()[0]),
        "spring": "joint_spring" in kinds,
    }
    assert {name for name, is_there in there.items() if not is_there} == gone

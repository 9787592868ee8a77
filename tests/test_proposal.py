"""A robot's file and a log with foreign names: what is proposed, and that it runs."""

import json
from dataclasses import astuple, replace

import numpy as np
import pytest
import yaml
from gap_benchmark.cases import cases, make
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.data.findings import NO_COLUMN
from makebreak.gap.data.joined import read_joined
from makebreak.gap.data.match import JointName
from makebreak.gap.data.proposal import of_one_drive, propose
from makebreak.gap.data.reading import read_recording
from makebreak.gap.data.robot import propose_scene, read_log, read_robot
from makebreak.gap.data.servo_gains import (
    ServoGains,
    ServoLog,
    _fitted,
    _fitted_at,
    gains_of_efforts,
    go_in_lines,
    needed_efforts,
    servo_gains,
)
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import load_scene, read_scene
from makebreak.scripts.cli import main
from makebreak.scripts.cli.gap_command import name_from

T = np.arange(400) * 0.01
PANDA = [JointName(f"panda.panda_joint{k}", lower=-2.9, upper=2.9) for k in range(1, 8)]
NAMED = [JointName(f"so.{n}", lower=-2.0, upper=2.0)
         for n in ("shoulder_pan", "elbow_flex", "wrist_roll")]  # fmt: skip


def sines(names, size=1.0):
    return {n: size * np.sin(3.0 * T + k) for k, n in enumerate(names)}


def channels(columns, joints, text=None):
    return {m.column: m.channel for m in propose(columns, joints, text)}


@pytest.mark.parametrize(
    "names, expected",
    [
        (["theta_1", "theta_dot_1", "torque_1", "theta_ddot_1"],
         ["1.position", "1.velocity", "1.effort_measured", None]),
        (["q1", "dq1", "tau1", "q_d_1"],
         ["1.position", "1.velocity", "1.effort_measured", "1.position_command"]),
        (["actual_q_0", "actual_qd_0", "target_moment_0", "actual_current_0"],
         ["1.position", "1.velocity", "1.effort_command", None]),
        (["O_F_1", "panda_joint1_temperature", "ddq1", "error_1"], [None] * 4),
        (["/joint_states/panda_joint1/position", "/joint_states/panda_joint1/effort",
          "/arm_controller/commands/data[0]"],
         ["1.position", "1.effort_measured", "1.position_command"]),
        (["observation.state.panda_joint7.pos", "action.panda_joint7.pos"],
         ["7.position", "7.position_command"]),
        (["jointAngle[0]", "jointVelocity[6]", "commandedTorque[3]"],
         ["1.position", "7.velocity", "4.effort_command"]),
    ],
    ids=["dots", "papers", "industrial", "others", "ros", "lerobot", "camel"],
)  # fmt: skip
def test_columns_are_matched_by_their_names(names, expected):
    columns = {"time": T} | sines(names)
    found = channels(columns, PANDA)
    assert found["time"] == "time"
    for name, channel in zip(names, expected, strict=True):
        assert found[name] == (channel and f"panda.panda_joint{channel}"), name


def test_of_columns_without_a_name_the_one_with_even_steps_is_the_time():
    """What drifts (an encoder that counts on, or a sum) is none."""
    drifting = np.cumsum(1e-3 * np.exp(2.0 * np.sin(9.0 * T)))
    columns = {"column_1": drifting, "column_2": np.sin(T), "column_3": 900.0 + T}
    found = propose(columns, PANDA)
    assert [m.channel for m in found] == [None, None, "time"]
    assert "does not name it" in found[0].why


def test_a_unit_tells_what_a_column_is_beside_a_joints_name_alone():
    joints = [JointName("a.q1"), JointName("a.slide", prismatic=True)]
    names = {
        "q1_rad": "q1.position", "q1_rpm": "q1.velocity", "q1_Nm": "q1.effort_measured",
        "slide [mm]": "slide.position", "slide [mm/s]": "slide.velocity",
        "slide [N]": "slide.effort_measured",
    }  # fmt: skip
    found = channels({"time": T} | sines(names), joints)
    assert [found[n] for n in names] == [f"a.{c}" for c in names.values()]


def test_a_slide_beyond_its_limits_in_m_is_in_mm():
    joints = [JointName("a.slide", True, 0.0, 0.18)]
    columns = {"time": T, "slide_pos": 90.0 + 50.0 * np.sin(3.0 * T)}
    columns["slide_vel"] = 150.0 * np.cos(3.0 * T)
    columns["slide_goal_pos"] = columns["slide_pos"] + 1.0
    scale = {m.channel: m.scale for m in propose(columns, joints)}
    assert scale["a.slide.position"] == 1e-3 == scale["a.slide.velocity"]
    assert scale["a.slide.position_command"] == 1e-3
    columns = {"time": T, "slide_pos": 0.09 + 0.05 * np.sin(3.0 * T)}
    assert [m.scale for m in propose(columns, joints)] == [1.0, 1.0]


def test_a_force_is_the_effort_of_a_joint_that_slides_and_has_its_name():
    """`joint` in a joint's own name does not make its force a position."""
    joints = [JointName("g.lift_joint", prismatic=True), JointName("g.yaw_joint")]
    names = ["lift_joint.actual_force", "lift_joint.force_cmd", "yaw_joint.force",
             "force_1", "tool_force_x"]  # fmt: skip
    found = channels({"time": T} | sines(names), joints)
    assert found["lift_joint.actual_force"] == "g.lift_joint.effort_measured"
    assert found["lift_joint.force_cmd"] == "g.lift_joint.effort_command"
    assert [found[n] for n in names[2:]] == [None] * 3


def test_german_degrees_and_a_stamp_called_stamp_are_read(tmp_path):
    ends = ("ist_grad", "soll_grad", "moment_promille")
    names = [f"elbow_flex_{end}" for end in ends]
    columns = {"t": T} | sines(names, 40.0)
    found = {m.column: m for m in propose(columns, NAMED)}
    for name, what in zip(names, ("position", "position_command"), strict=False):
        assert found[name].channel == f"so.elbow_flex.{what}"
        assert found[name].scale == pytest.approx(np.pi / 180.0)
    assert found[names[2]].channel is None  # Per mille of what?
    # A proposal that names stamp, of stamp/sec and stamp/nanosec, fits its log.
    rows = [{"stamp": {"sec": int(t), "nanosec": int(round(1e9 * (t % 1.0)))}, "q": t}
            for t in T]  # fmt: skip
    file = tmp_path / "log.jsonl"
    file.write_text("\n".join(map(json.dumps, rows)))
    said = {"stamp": "time", "stamp/sec": None, "stamp/nanosec": None}
    table, _ = read_joined(file, {"columns": said})
    np.testing.assert_allclose(table.columns["stamp"], T, atol=1e-8)


def test_numbers_count_from_zero_where_any_group_does():
    found = channels(sines([f"q{k}" for k in range(7)]), PANDA)
    assert found["q0"].startswith("panda.panda_joint1.")
    assert found["q6"].startswith("panda.panda_joint7.")


def test_joints_are_found_by_name_and_commands_without_a_quantity():
    columns = {"t": T} | sines(
        ["shoulder_pan_goal", "shoulderPan_pos", "wrist_roll_vel", "gripper_pos",
         "elbow_flex Soll", "elbow_flex Ist"]
    )  # fmt: skip
    found = channels(columns, NAMED)
    assert found["shoulder_pan_goal"] == "so.shoulder_pan.position_command"
    assert found["shoulderPan_pos"] == "so.shoulder_pan.position"
    assert found["wrist_roll_vel"] == "so.wrist_roll.velocity"
    assert found["gripper_pos"] is None
    assert found["elbow_flex Soll"] == "so.elbow_flex.position_command"
    assert found["elbow_flex Ist"] == "so.elbow_flex.position"


def test_qd_is_a_speed_or_a_command_by_what_it_goes_with():
    q = np.sin(3.0 * T)
    joint = [JointName("a.j")]
    columns = {"t": T, "q1": q, "qd1": 3.0 * np.cos(3.0 * T)}
    assert channels(columns, joint)["qd1"] == "a.j.velocity"
    columns["qd1"] = q + 0.01 * np.sin(20.0 * T)
    assert channels(columns, joint)["qd1"] == "a.j.position_command"


def test_inputs_of_all_joints_are_of_one_kind():
    """One whose weak drive sags far below its command is as the others are."""
    q = np.sin(3.0 * T)
    columns = {"t": T} | {f"q{k}": q for k in (1, 2, 3)}
    columns |= {f"ctrl{k}": q + 0.01 * np.sin(20.0 * T) for k in (1, 2)}
    columns["ctrl3"] = 1.5 * np.sin(3.0 * T + 1.0)
    found = channels(columns, [JointName(f"a.j{k}") for k in (1, 2, 3)])
    commands = [f"a.j{k}.position_command" for k in (1, 2, 3)]
    assert [found[f"ctrl{k}"] for k in (1, 2, 3)] == commands


@pytest.mark.parametrize("time_scale, unit", [(1.0, "s"), (1e3, "ms"), (1e9, "ns")])
def test_units_are_told_by_size_and_by_the_derivative(time_scale, unit):
    q = 1.5 * np.sin(3.0 * T)
    v = 4.5 * np.cos(3.0 * T)
    columns = {
        "timestamp": time_scale * T,
        "q1": np.degrees(q),
        "dq1": np.degrees(v),
        "q2": q,
        "dq2": v * 30.0 / np.pi,  # rpm
        "q3": q,
        "dq3": -v,
    }
    matches = {m.column: m for m in propose(columns, PANDA)}
    assert matches["timestamp"].scale == pytest.approx(1.0 / time_scale)
    # All of one name are in one unit: q2 and q3 would be 1.5 degrees.
    assert matches["q1"].scale == pytest.approx(np.pi / 180.0)
    assert matches["dq1"].scale == pytest.approx(np.pi / 180.0)
    columns = {k: columns[k] for k in ("timestamp", "q2", "dq2", "q3", "dq3")}
    matches = {m.column: m for m in propose(columns, PANDA)}
    assert matches["q2"].scale == 1.0
    assert matches["dq2"].scale == pytest.approx(np.pi / 30.0)
    assert matches["dq3"].scale == -1.0 and "other sign" in matches["dq3"].why


def test_there_is_one_drive():
    columns = {"t": T} | sines(["q1", "tau1", "tau_cmd1", "q1_cmd", "dq1_cmd"])
    kept = {m.column: m.channel for m in of_one_drive(propose(columns, PANDA))}
    assert kept["tau_cmd1"].endswith("effort_command")
    assert kept["q1_cmd"] is None and kept["dq1_cmd"] is None
    assert kept["tau1"].endswith("effort_measured")


UR = [JointName(f"ur.{n}_joint", lower=-6.3, upper=6.3)
      for n in ("shoulder_pan", "shoulder_lift", "elbow",
                "wrist_1", "wrist_2", "wrist_3")]  # fmt: skip


@pytest.mark.parametrize(
    "name, channel",
    [
        ("pan angle [deg]", "shoulder_pan_joint.position"),
        ("Lift torque [mNm]", "shoulder_lift_joint.effort_measured"),
        ("elbow_vel", "elbow_joint.velocity"),
        ("wrist 2 position", "wrist_2_joint.position"),  # Not the second joint's.
        ("shoulder angle", None),  # Two have it.
        ("q2", "shoulder_lift_joint.position"),
    ],
)
def test_a_word_that_one_joint_alone_has_names_it(name, channel):
    found = channels({"time": T} | sines([name]), UR)[name]
    assert found == (channel and f"ur.{channel}")


def test_of_two_arms_side_and_number_name_a_joint():
    arms = [
        JointName(f"r.{side}_joint{k}") for side in ("left", "right") for k in (1, 2)
    ]
    found = channels({"time": T} | sines(["q_right_1", "left tau 2", "right q"]), arms)
    assert found["q_right_1"] == "r.right_joint1.position"
    assert found["left tau 2"] == "r.left_joint2.effort_measured"
    assert found["right q"] is None


@pytest.mark.parametrize("first", [0, 1])
def test_columns_may_be_counted_from_0_or_1_beside_joints_of_other_names(first):
    """A gripper makes "arm" a word that not all joints have. arm_q_1 is the second
    joint where arm_q_0 is there too."""
    names = [*(f"arm_joint_{k}" for k in (1, 2, 3)), "gripper_joint"]
    columns = [f"arm_{q}_{k + first}" for q in ("q", "tau") for k in range(3)]
    found = channels(
        {"time": T} | sines([*columns, "gripper pos"]),
        [JointName(f"r.{name}") for name in names],
    )
    for k in range(3):
        assert found[f"arm_q_{k + first}"] == f"r.arm_joint_{k + 1}.position"
        tau = found[f"arm_tau_{k + first}"]
        assert tau == f"r.arm_joint_{k + 1}.effort_measured"
    assert found["gripper pos"] == "r.gripper_joint.position"


def test_a_joint_without_a_column_is_told_with_the_columns_left_out(robot_and_log):
    _, robot, log, table, joints = robot_and_log
    known = read_log(log)
    assert not propose_scene(read_robot(robot), [known]).findings()
    columns = dict(known.table.columns)
    columns["front angle [deg]"] = columns.pop("Angle 1 [deg]")
    other = replace(known, table=replace(known.table, columns=columns))
    (finding,) = propose_scene(read_robot(robot), [other]).findings()
    assert finding.kind == NO_COLUMN
    assert f"position of {joints[0]}; " in finding.says
    assert "left out: front angle [deg]." in finding.says


@pytest.mark.parametrize("lists", [False, True])
def test_names_in_columns_of_text_say_which_number_is_which_joint(lists):
    """A driver sends its joints sorted by name, not in the robot's order."""
    order = ["elbow_flex", "shoulder_pan", "wrist_roll"]
    text = {f"field.name{k}": name for k, name in enumerate(order)}
    if lists:
        text = {"name": str(order), "frame_id": "base"}
    names = [f"field.{what}{k}" for what in ("position", "effort") for k in range(3)]
    found = channels({"time": T} | sines(names), NAMED, text)
    for k, joint in enumerate(order):
        assert found[f"field.position{k}"] == f"so.{joint}.position"
        assert found[f"field.effort{k}"] == f"so.{joint}.effort_measured"


def test_a_joints_name_with_no_other_word_is_its_position():
    names = ["present.elbow_flex", "goal.elbow_flex", "wrist_roll", "elbow_flex_load"]
    found = channels({"time": T} | sines(names), NAMED)
    assert [found[n] for n in names] == [
        "so.elbow_flex.position", "so.elbow_flex.position_command",
        "so.wrist_roll.position", None,
    ]  # fmt: skip


def test_a_unit_in_brackets_tells_the_time_in_any_language():
    columns = {"Zeit [ms]": 7731.0 + 10.0 * np.arange(400)} | sines(["q1"])
    time, _ = propose(columns, [JointName("a.q1")])
    assert (time.channel, time.scale) == ("time", 1e-3)


ONE = """<robot name="one"><link name="base"/><link name="rod"><inertial>
<origin xyz="0 0 -0.3"/><mass value="2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint></robot>
"""


def test_a_robot_without_its_collision_meshes_is_compared(tmp_path):
    """A log in the air needs no shapes; the scene has a copy without them."""
    shape = '<{0}><geometry><mesh filename="package://gone/a.obj"/></geometry></{0}>'
    shapes = shape.format("visual") + shape.format("collision")
    text = ONE.replace("</inertial>", "</inertial>" + shapes)
    (tmp_path / "one.urdf").write_text(text)
    rows = np.stack([T, 0.5 * np.sin(3.0 * T), np.cos(3.0 * T)], axis=1)
    head = "time,hinge_pos,hinge_torque"
    np.savetxt(tmp_path / "log.csv", rows, "%.9g", ",", header=head, comments="")
    proposal = propose_scene(
        read_robot(tmp_path / "one.urdf"), [read_log(tmp_path / "log.csv")]
    )
    assert any("1 collision meshes" in note for note in proposal.notes)
    (tmp_path / "out").mkdir()
    for name, copy in proposal.copies.items():
        (tmp_path / "out" / name).write_text(copy)
    (tmp_path / "out" / "scene.yaml").write_text(proposal.scene)
    SceneDynamics(read_scene(tmp_path / "out" / "scene.yaml"))
    # The result's scene is written elsewhere, and moved together with the copy.
    out = tmp_path / "gap"
    command = ["gap", str(tmp_path / "one.urdf"), str(tmp_path / "log.csv")]
    assert main([*command, "--out", str(out), "--jobs", "1"]) == 0
    SceneDynamics(read_scene(out / "scene.yaml"))


def with_currents(folder):
    (folder / "one.urdf").write_text(ONE)
    q = 0.5 * np.sin(3.0 * T)
    torque = (0.1 + 2.0 * 0.09) * -9.0 * q + 2.0 * 9.81 * 0.3 * np.sin(q)
    rows = np.stack([5.0 + T, np.degrees(q), torque / 1.7], axis=1)
    head = "tick,hinge_pos [deg],hinge_current_A"
    np.savetxt(folder / "log.csv", rows, "%.9g", ",", header=head, comments="")
    return read_robot(folder / "one.urdf"), folder / "log.csv"


def test_a_sidecar_beside_the_log_is_kept_and_completed(tmp_path):
    """What the messages ask for, a line for the time, is enough for a proposal."""
    robot, log = with_currents(tmp_path)
    (tmp_path / "log.yaml").write_text(
        "columns:\n  tick: time\n  hinge_current_A: "
        "{channel: one.hinge.effort_measured, scale: 1.7}\n"
        "ignore: [{from: 6, to: 7}]\n"
    )
    proposal = propose_scene(robot, [read_log(log)])
    assert "type: effort" in proposal.scene
    (tmp_path / "whole.yaml").write_text(proposal.sidecars[log])
    recording = read_recording(log, sidecar_path=tmp_path / "whole.yaml")
    position = recording["one.hinge.position"]
    assert len(recording.episodes) == 2  # What is to be ignored still is.
    assert np.ptp(position) == pytest.approx(1.0, abs=0.02)
    assert np.ptp(recording["one.hinge.effort_measured"]) > 2.0
    # One that says all is left alone.
    (tmp_path / "log.yaml").write_text(proposal.sidecars[log])
    assert not propose_scene(robot, [read_log(log)]).sidecars


def test_currents_alone_are_asked_for_their_torque_constant(tmp_path):
    robot, log = with_currents(tmp_path)
    (tmp_path / "log.yaml").write_text("columns: {tick: time}\n")
    with pytest.raises(ValueError, match="hinge_current_A.*one.hinge.effort_measured"):
        propose_scene(robot, [read_log(log)])


@pytest.fixture(scope="module")
def robot_and_log(tmp_path_factory):
    """The benchmark's pendulum with a gain error, as a stranger would log it."""
    folder = tmp_path_factory.mktemp("stranger")
    (case,) = [c for c in cases("development") if c.name == "28_pendulum_actuator_gain"]
    made = make(case)
    ((file, text),) = made.models.items()
    (folder / file).write_text(text)
    joints = list(
        dict.fromkeys(c.rsplit(".", 1)[0] for c in made.columns if ".position" in c)
    )
    table = made.columns
    rows = {"Time [ms]": 1e3 * table["time"], "Episode": table["episode"]}
    for k, joint in enumerate(joints):
        rows[f"Angle {k + 1} [deg]"] = np.degrees(table[f"{joint}.position"])
        command = f"{joint}.effort_command"
        if command in table:
            rows[f"Torque command {k + 1} [Nm]"] = table[command]
    lines = [";".join(rows)]
    for cells in zip(*rows.values(), strict=True):
        words = ("" if np.isnan(c) else f"{c:.10g}".replace(".", ",") for c in cells)
        lines.append(";".join(words))
    (folder / "log.csv").write_text("\n".join(lines))
    return folder, folder / file, folder / "log.csv", table, joints


def test_what_is_proposed_for_a_stranger_is_read_as_it_was(robot_and_log, tmp_path):
    _, robot, log, table, joints = robot_and_log
    proposal = propose_scene(read_robot(robot), [read_log(log)])
    (sidecar,) = proposal.sidecars.values()
    (tmp_path / "log.yaml").write_text(sidecar)
    recording = read_recording(log, sidecar_path=tmp_path / "log.yaml")
    for joint in joints:
        np.testing.assert_allclose(
            recording[f"{joint}.position"], table[f"{joint}.position"], atol=1e-9
        )
    assert {e.number for e in recording.episodes} == set(table["episode"])
    assert "type: effort" in proposal.scene


def test_a_speed_loop_is_as_stiff_as_what_its_joint_moves_allows(tmp_path):
    """An arm of 5 kg m2 with a wrist of 0.4 g m2: one gain for both would stop the
    wrist faster than can be simulated, and the scene would be refused."""
    link = """<link name="{n}"><inertial><origin xyz="{x} 0 0"/><mass value="{m}"/>
      <inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="j_{n}" type="revolute"><parent link="{on}"/><child link="{n}"/>
      <origin xyz="{at} 0 0"/><axis xyz="0 1 0"/>
      <limit lower="-2" upper="2" effort="50" velocity="3"/></joint>"""
    robot = tmp_path / "arm.urdf"
    robot.write_text(
        '<robot name="arm"><link name="base"/>'
        + link.format(n="big", on="base", m=20, x=0.4, i=1.8, at=0)
        + link.format(n="small", on="big", m=0.2, x=0, i=4e-4, at=0.8)
        + "</robot>"
    )
    q = {"j_big_pos": np.sin(T), "j_small_pos": np.cos(T)}
    rows = {"time": T} | q | {f"{n[:-4]}_vel_cmd": np.gradient(x, T)
                              for n, x in q.items()}  # fmt: skip
    log = tmp_path / "log.csv"
    np.savetxt(log, np.stack([*rows.values()], 1), delimiter=",",
               header=",".join(rows), comments="")  # fmt: skip
    proposal = propose_scene(read_robot(robot), [read_log(log)])
    (tmp_path / "scene.yaml").write_text(proposal.scene)
    scene = read_scene(tmp_path / "scene.yaml")
    assert scene.actuation.type == "velocity"
    # Parallel axes through its centre: the wrist's own moment of inertia.
    big, small = scene.actuation.kd
    assert small == pytest.approx(50.0 * 4e-4, rel=0.05)
    assert big == pytest.approx(50.0 * (1.8 + 20 * 0.4**2 + 0.2 * 0.8**2), rel=0.05)
    SceneDynamics(scene)  # It can be simulated.


def test_inspect_prints_and_writes_only_where_asked(robot_and_log, tmp_path, capsys):
    folder, robot, log, _, _ = robot_and_log
    before = sorted(folder.iterdir())
    assert main(["inspect", str(log), "--robot", str(robot)]) == 0
    out = capsys.readouterr().out
    assert "Angle 1 [deg]" in out and "scale: 0.01745" in out
    assert sorted(folder.iterdir()) == before
    assert main(["inspect", str(log), "--out", str(tmp_path / "o")]) == 0
    assert "columns:" in (tmp_path / "o" / "log.yaml").read_text()


def test_a_proposed_scene_can_be_moved_together_with_its_robot(robot_and_log, tmp_path):
    _, robot, log, _, _ = robot_and_log
    rig = tmp_path / "rig"
    (rig / "first").mkdir(parents=True)
    (rig / robot.name).write_bytes(robot.read_bytes())
    scene = rig / "first" / "proposed_scene.yaml"
    proposal = propose_scene(read_robot(rig / robot.name), [read_log(log)])
    scene.write_text(proposal.scene)
    name_from(scene.parent, rig / robot.name, scene)
    rig.rename(tmp_path / "elsewhere")
    moved = tmp_path / "elsewhere" / "first" / "proposed_scene.yaml"
    assert load_scene(read_scene(moved), DiagramBuilder()).plant.num_actuators() == 2


@pytest.mark.slow
def test_gap_runs_on_a_robot_and_a_strangers_log(robot_and_log, tmp_path):
    folder, robot, log, _, _ = robot_and_log
    before = sorted(folder.iterdir())
    out = tmp_path / "out"
    assert main(["gap", str(robot), str(log), "--out", str(out), "--jobs", "1"]) == 0
    result = json.loads((out / "result.json").read_text())
    assert [e["kind"] for e in result["effects"]] == ["actuator_gain"]
    assert (out / "proposed_scene.yaml").is_file() and (out / "log.yaml").is_file()
    assert sorted(folder.iterdir()) == before
    # The report's own command is the one that was given; the proposal's also runs.
    page = (out / "report.html").read_text()
    assert f"makebreak gap {robot} {log} --out {out}" in page
    assert ".unfinished" not in page
    assert str(tmp_path) not in (out / "proposed_scene.yaml").read_text()
    again = ["gap", str(out / "proposed_scene.yaml"), str(log), "--jobs", "1"]
    assert main([*again, "--out", str(tmp_path / "again")]) == 0


def test_a_log_or_a_robot_that_tells_nothing_is_refused(
    robot_and_log, tmp_path, capsys
):
    _, robot, _, _, _ = robot_and_log
    log = tmp_path / "a.csv"
    rows = "\n".join(f"{k * 0.01},{k}" for k in range(50))
    for header, message in (
        ("q,y", "no column looks like a time"),
        ("x,y", "no column looks like the position of a joint"),  # x is even.
        ("t,y", "no column looks like the position of a joint"),
    ):
        log.write_text(f"{header}\n{rows}\n")
        assert main(["gap", str(robot), str(log), "--out", str(tmp_path / "o")]) == 2
        assert message in capsys.readouterr().err
    (tmp_path / "bad.urdf").write_text("<robot")
    assert main(["inspect", str(log), "--robot", str(tmp_path / "bad.urdf")]) == 2
    assert "cannot be read" in capsys.readouterr().err


SERVO_ARM = """<robot name="s"><link name="base"/><link name="arm"><inertial>
<origin xyz="0.1 0 0"/><mass value="0.2"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5"
ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="lift" type="revolute">
<parent link="base"/><child link="arm"/><axis xyz="0 -1 0"/>
<limit lower="-2" upper="2" effort="3" velocity="5"/></joint></robot>"""


def test_a_servo_is_proposed_with_the_stiffness_that_its_sag_tells(tmp_path):
    (tmp_path / "s.urdf").write_text(SERVO_ARM)
    q = 0.5 * np.sign(np.sin(3.0 * T))  # It stands: only its sag tells.
    # It holds 0.2 kg at 0.1 m with 6 N m/rad; about -y, upwards is positive.
    goal = q + 0.2 * 9.81 * 0.1 * np.cos(q) / 6.0
    rows = np.stack([T, np.degrees(q), np.degrees(goal)], axis=1)
    head = "t,lift_pos [deg],lift_goal [deg]"
    np.savetxt(tmp_path / "log.csv", rows, "%.9g", ",", header=head, comments="")
    robot = read_robot(tmp_path / "s.urdf")
    proposal = propose_scene(robot, [read_log(tmp_path / "log.csv")])
    (tmp_path / "scene.yaml").write_text(proposal.scene)
    scene = read_scene(tmp_path / "scene.yaml")
    assert scene.actuation.type == "servo"
    assert "# [N m/rad], " in proposal.scene and "# [N m s/rad], " in proposal.scene
    np.testing.assert_allclose(scene.actuation.kp, 6.0, rtol=0.01)
    SceneSimulation(scene)  # It can be simulated.


SERVO_SLIDE = """<robot name="s"><link name="base"/><link name="cart"><inertial>
<mass value="6"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
</link><joint name="x" type="prismatic"><parent link="base"/><child link="cart"/>
<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="300" velocity="5"/></joint>
</robot>"""


@pytest.mark.parametrize("limit, taken", [("300", 300.0), ("20", 1e9)])
def test_a_servo_is_proposed_with_the_gains_that_its_motion_tells(
    tmp_path, limit, taken
):
    """A slide on level ground sags nowhere; its dry friction is not taken for a gain,
    nor that its command holds until the next one for damping. The motion needs 34 N, so
    that a file's limit of 20 N is none."""
    motor = "<transmission><type>transmission_interface/SimpleTransmission</type>"
    motor += '<joint name="x"/><actuator name="m"/></transmission></robot>'
    text = SERVO_SLIDE.replace('effort="300"', f'effort="{limit}"')
    text = text.replace("</robot>", motor)
    (tmp_path / "s.urdf").write_text(text)
    kp, kd, coulomb, step = 4000.0, 300.0, 15.0, 5e-4
    x, v, u, rows, told = 0.0, 0.0, 0.0, [], 0.0
    for k in range(int(20.0 / step)):
        t = k * step
        if k % 40 == 0:  # 50 rows a second.
            told = 0.2 * np.sin(2.0 * t) + 0.05 * np.sin(7.0 * t)
            rows.append([t, x, told])
        u = kp * (told - x) - kd * v - coulomb * np.tanh(v / 1e-3)
        v += step * u / 6.0
        x += step * v
    head = "t,x_pos,x_goal_pos"
    np.savetxt(tmp_path / "log.csv", rows, "%.9g", ",", header=head, comments="")
    robot = read_robot(tmp_path / "s.urdf")
    proposal = propose_scene(robot, [read_log(tmp_path / "log.csv")])
    (tmp_path / "scene.yaml").write_text(proposal.scene)
    scene = read_scene(tmp_path / "scene.yaml")
    # Half a row late would be 40 N s/m; a mean over 0.2 s bends the motion a little.
    np.testing.assert_allclose(scene.actuation.kp, kp, rtol=0.01)
    np.testing.assert_allclose(scene.actuation.kd, kd, rtol=0.02)
    assert not scene.effects  # No rotor that is not there.
    assert scene.tolerance == {"drive_gains": 0.05} and not proposal.findings()
    assert "# [N/m], " in proposal.scene and "# [N s/m], " in proposal.scene
    assert scene.actuation.limit == [taken]


@pytest.mark.parametrize(
    "late, rows, rotor",
    [
        (0.016, 1, 0.0),
        (-0.005, 10, 1.5),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in [
                (0.0, 1, 0.0),
                (0.0, 1, 1.5),
                (-0.005, 10, 0.0),
                (0.016, 1, 1.5),
            ]
        ),
    ],
)
def test_gains_of_motion_are_not_those_of_late_commands_or_rotors(
    tmp_path, late, rows, rotor
):
    """A slide, which nothing weighs on, and a pendulum, solved finely: commands that
    act late, or whose loop is ten times as fast as the log, look like damping, and a
    rotor of the slide like a smaller stiffness."""
    (tmp_path / "rig.urdf").write_text(
        """<robot name="rig"><link name="base"/>
        <link name="cart"><inertial><mass value="4"/>
          <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
        </link><joint name="slide" type="prismatic"><parent link="base"/>
          <child link="cart"/><axis xyz="1 0 0"/><limit effort="99" velocity="9"/>
        </joint><link name="bob"><inertial><origin xyz="0 0 -0.3"/><mass value="0.5"/>
          <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
        </link><joint name="swing" type="continuous"><parent link="cart"/>
          <child link="bob"/><axis xyz="0 1 0"/></joint></robot>"""
    )
    plant = read_robot(tmp_path / "rig.urdf").plant
    kp, kd = np.array([900.0, 20.0]), np.array([60.0, 1.2])
    step, row = 5e-4, 0.01

    def told(t):
        held = row / rows * np.floor((t - max(late, 0.0)) / (row / rows) + 1e-9)
        return np.array([0.2 * np.sin(2.0 * held) + 0.1 * np.sin(5.0 * held),
                         0.5 * np.sin(3.0 * held + 1.0)])  # fmt: skip

    context = plant.CreateDefaultContext()
    q, v, states = told(0.0), np.zeros(2), []
    for k in range(int(15.0 / step)):
        states.append(q)
        u = kp * (told(k * step) - q) - kd * v
        bias = needed_efforts(plant, q[None], v[None], np.zeros((1, 2)))[0]
        plant.SetPositions(context, q)
        M = plant.CalcMassMatrix(context) + np.diag([rotor, 0.0])
        # By the middle of a step: a velocity half a step late would be another rotor.
        vd = np.linalg.solve(M + 0.5 * step * np.diag(kd), u - bias)
        q, v = q + step * (v + 0.5 * step * vd), v + step * vd
    every = round(row / step)
    t = row * np.arange(len(states[::every]))
    command = np.stack([told(at + max(late, 0.0)) for at in t])
    log = ServoLog(t, np.array(states[::every]), command)
    found = servo_gains(plant, [log])
    np.testing.assert_allclose([g.kp for g in found], kp, rtol=0.01)
    np.testing.assert_allclose([g.kd for g in found], kd, rtol=0.02)
    np.testing.assert_allclose([g.rotor for g in found], [rotor, 0.0], atol=0.03)


def test_of_a_servo_that_needs_no_effort_the_rest_goes_with_its_stiffness():
    """Without an effort it has no scale: kp e = kd v + friction + rotor v'."""
    rng = np.random.default_rng(0)
    kd, coulomb, rotor, kp = 0.5, 0.08, 0.02, 9.0
    v, vd = rng.standard_normal(400), 5.0 * rng.standard_normal(400)
    error = (kd * v + coulomb * np.sign(v) + rotor * vd) / kp
    equations = np.stack([error, -v, -np.sign(v), -vd], axis=1), np.zeros(400)
    assert _fitted([equations]) is None
    found = _fitted_at(kp, [equations])
    most = np.abs(coulomb * np.sign(v) + rotor * vd).max()
    expected = ServoGains(kp, kd, rotor, coulomb, most)
    np.testing.assert_allclose(astuple(found), astuple(expected), rtol=1e-6)


@pytest.mark.parametrize(
    "name, channel, scale",
    [
        ("mast actual position [mm]", "a.mast.position", 1e-3),
        ("mast actual speed [mm/s]", "a.mast.velocity", 1e-3),
        ("mast_pos_cm", "a.mast.position", 1e-2),
        ("mast_pos_\u00b5m", "a.mast.position", 1e-6),
        ("mast motor force torque (kN)", "a.mast.effort_measured", 1e3),
        ("elbow_position_mrad", "a.elbow.position", 1e-3),
        ("elbow position [deg]", "a.elbow.position", np.pi / 180),
        ("elbow position [rad]", "a.elbow.position", 1.0),
        ("elbow_velocity_deg_per_s", "a.elbow.velocity", np.pi / 180),
        ("elbow velocity {1/min}", "a.elbow.velocity", np.pi / 30),
        ("elbow torque [N cm]", "a.elbow.effort_measured", 1e-2),
        ("elbow torque [%]", None, 1.0),
        ("elbow torque [A]", None, 1.0),
        # No unit of such a quantity, and an index, say nothing.
        ("elbow position [mm]", "a.elbow.position", 1.0),
        ("elbow position[0]", "a.elbow.position", 1.0),
    ],
)
def test_the_unit_in_a_name_is_believed(name, channel, scale):
    joints = [JointName("a.mast", True, -0.2, 0.2), JointName("a.elbow", False, -2, 2)]
    [_, match] = propose({"time": T, name: 0.5 * np.sin(3.0 * T)}, joints)
    assert (match.channel, match.scale) == (channel, pytest.approx(scale))


@pytest.mark.parametrize(
    "joint, prismatic, name",
    [
        ("a.wrist_rev", False, "position_wrist_rev"),
        ("a.j1", False, "position_j1_rev"),
        ("a.lift_cm", True, "position_lift_cm"),
        ("a.arm_ma", False, "effort_arm_ma"),
        ("a.A", False, "torque (A)"),
    ],
)
def test_a_word_of_a_joints_own_name_is_no_unit(joint, prismatic, name):
    joints = [JointName(joint, prismatic, -2.0, 2.0)]
    [_, match] = propose({"time": T, name: 0.5 * np.sin(3.0 * T)}, joints)
    assert match.channel is not None and match.channel.startswith(joint)
    assert match.scale == 1.0


@pytest.mark.parametrize(
    "scale, expected",
    [(1.0, 1.0), (-1.0, -1.0), (180.0 / np.pi, np.pi / 180), (7.0, 1.0),
     (-180.0 / np.pi, -np.pi / 180)],
)  # fmt: skip
def test_a_velocity_with_a_unit_is_held_against_its_position(scale, expected):
    """Of the other sign, or in deg/s by what it does; a scale of 7 is of no unit."""
    q, v = 0.5 * np.sin(3.0 * T), 1.5 * np.cos(3.0 * T)
    columns = {"time": T, "position_j1_rad": q, "velocity_j1_rad_s": scale * v}
    [_, _, match] = propose(columns, [JointName("a.j1", False, -2.0, 2.0)])
    assert match.channel == "a.j1.velocity"
    assert match.scale == pytest.approx(expected)


def test_an_effort_in_percent_gives_way_to_one_in_newton_metres():
    names = ("torque_j1 (%)", "torque_j1 (Nm)")
    [_, share, torque] = propose({"time": T} | sines(names, 1.0), [JointName("a.j1")])
    assert share.channel is None and torque.channel == "a.j1.effort_measured"


@pytest.mark.parametrize(
    "name, scale", [("lift torque [mN]", 1e-3), ("lift torque [MN]", 1e6)]
)
def test_mega_is_no_milli(name, scale):
    [_, match] = propose({"time": T} | sines([name], 1.0), [JointName("a.lift", True)])
    assert match.scale == pytest.approx(scale)


def test_the_unit_in_a_name_is_no_matter_of_size():
    """0.5 could be m, and what a velocity is beside it could be anything."""
    joints = [JointName("a.mast", True)]
    names = ("mast position [mm]", "mast speed [m/s]")
    [_, q, v] = propose({"time": T} | sines(names, 100.0), joints)
    assert (q.scale, v.scale) == (1e-3, 1.0)


def servo_log(tmp_path, kp, kd, given, gravity=0.0, limit=1e3):
    """A wheel of 0.2 kg m2 in MJCF with a position servo, and a log of positions,
    commands that step each 20 ms and efforts `given(error, rate)`, with a weight's
    moment `gravity` [N m] beside it."""
    robot = tmp_path / "one.xml"
    robot.write_text(
        '<mujoco model="one"><compiler angle="radian"/><worldbody><body name="link">'
        '<joint name="j" axis="0 1 0" range="-2 2" armature="0.1"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="0.2 0.2 0.2"/></body></worldbody>'
        f'<actuator><position joint="j" kp="{kp}" kv="{kd}" '
        f'forcerange="-{limit} {limit}"/></actuator></mujoco>'
    )
    t = 0.002 * np.arange(6000)
    q = np.sin(2.0 * t) + 0.2 * np.sin(7.0 * t)
    v = 2.0 * np.cos(2.0 * t) + 1.4 * np.cos(7.0 * t)
    held = q[10 * (np.arange(6000) // 10)] + 0.05 * np.cos(3.0 * t)
    rows = {"time": t, "j_pos": q, "j_vel": v, "j_cmd_pos": held}
    if given is not None:
        rows["j_effort"] = given(held - q, v) + gravity * np.sin(q)
    log = tmp_path / "log.csv"
    np.savetxt(log, np.stack([*rows.values()], 1), delimiter=",",
               header=",".join(rows), comments="")  # fmt: skip
    proposal = propose_scene(read_robot(robot), [read_log(log)])
    (tmp_path / "scene.yaml").write_text(proposal.scene)
    return read_scene(tmp_path / "scene.yaml"), proposal.sidecars[log]


@pytest.mark.parametrize("own", [(80.0, 3.0), (120.0, 0.5)])
def test_efforts_that_are_what_a_servo_gives_tell_its_gains(tmp_path, own):
    """Of the file's servo those of the file, of another one its own. Their samples do
    not tell what acts between rows, and the servo does."""
    kp, kd = own
    scene, sidecar = servo_log(tmp_path, 80.0, 3.0, lambda e, v: kp * e - kd * v)
    assert scene.actuation.type == "servo"
    # kd from rates averaged over 0.2 s; the gains in the text have three digits.
    assert scene.actuation.kp == pytest.approx([kp], rel=0.01)
    assert scene.actuation.kd == pytest.approx([kd], rel=0.05)
    assert '"j_effort": null' in sidecar or "j_effort: null" in sidecar


@pytest.mark.parametrize("kp", [80.0, 120.0])
@pytest.mark.parametrize("late", [0.007, 0.01])
def test_commands_of_a_faster_loop_go_in_lines_where_efforts_say_so(tmp_path, kp, late):
    """Rows of 10 ms, of the file's servo and of another one. Commands that are a whole
    row late may hold for it."""
    servo_log(tmp_path, 80.0, 3.0, None)
    t = 0.01 * np.arange(1500)

    def told(t):
        return np.sin(2.0 * t) + 0.05 * np.cos(3.0 * t) + 0.2 * np.sin(7.0 * t)

    q, v = np.sin(2.0 * t), 2.0 * np.cos(2.0 * t)
    rows = {"time": t, "j_pos": q, "j_vel": v, "j_cmd_pos": told(t),
            "j_effort": kp * (told(t - late) - q) - 3.0 * v}  # fmt: skip
    log = tmp_path / "other.csv"
    np.savetxt(log, np.stack([*rows.values()], 1), delimiter=",",
               header=",".join(rows), comments="")  # fmt: skip
    proposal = propose_scene(read_robot(tmp_path / "one.xml"), [read_log(log)])
    (tmp_path / "scene.yaml").write_text(proposal.scene)
    actuation = read_scene(tmp_path / "scene.yaml").actuation
    assert (actuation.hold == "first_order") == (late == 0.007)
    assert actuation.kp == pytest.approx([kp], rel=0.01)


@pytest.mark.parametrize("wrong", [1, 3])
def test_efforts_of_one_joint_that_are_a_multiple_of_its_servos_are_said(
    tmp_path, wrong
):
    """Of five wheels; where three have other gains than the file, it is the file."""
    t = 0.002 * np.arange(6000)
    bodies, motors, rows = "", "", {"time": t}
    for k in range(5):
        bodies += (
            f'<body name="link{k}" pos="0 {k} 0"><joint name="w{k}" axis="0 1 0" '
            'range="-2 2"/><inertial pos="0 0 0" mass="1" diaginertia="0.3 0.3 0.3"/>'
            "</body>"
        )
        motors += f'<position joint="w{k}" kp="80" kv="3"/>'
        goal = 0.5 * np.sin((2.0 + 0.3 * k) * t) + 0.2 * np.sin(5.0 * t + k)
        told = goal[10 * (np.arange(6000) // 10)]
        q, v, effort, x, rate = *np.zeros((3, 6000)), told[0], 0.0
        for i in range(6000):
            q[i], v[i], effort[i] = x, rate, 80.0 * (told[i] - x) - 3.0 * rate
            rate += 0.002 * effort[i] / 0.3
            x += 0.002 * rate
        rows |= {f"w{k}_pos": q, f"w{k}_vel": v, f"w{k}_cmd_pos": told,
                 f"w{k}_effort": effort * (0.85 if k < wrong else 1.0)}  # fmt: skip
    robot, log = tmp_path / "five.xml", tmp_path / "log.csv"
    robot.write_text(
        '<mujoco model="five"><compiler angle="radian"/><worldbody>'
        f"{bodies}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    np.savetxt(log, np.stack([*rows.values()], 1), delimiter=",",
               header=",".join(rows), comments="")  # fmt: skip
    proposal = propose_scene(read_robot(robot), [read_log(log)])
    (tmp_path / "scene.yaml").write_text(proposal.scene)
    kp = read_scene(tmp_path / "scene.yaml").actuation.kp
    said = [s for s in proposal.said if s.kind == "effort_of_other_gains"]
    if wrong > 1:
        assert not said and kp == pytest.approx(wrong * [68.0] + [80.0] * 2, rel=0.02)
        return
    assert kp == [80.0] * 5
    assert [s.channel for s in said] == ["five.w0"]
    assert said[0].size == pytest.approx(0.85, rel=0.01)


@pytest.mark.parametrize("kp, told", [(80.8, 80.0), (88.0, 88.0)])
def test_gains_of_the_file_are_taken_where_parts_of_a_law_nearly_cancel(kp, told):
    """A light joint needs next to nothing of the tens of N m that stiffness and damping
    give against each other: their size is not in that to a per cent."""
    t = 0.002 * np.arange(6000)
    q, v = np.sin(2.0 * t), 2.0 * np.cos(2.0 * t)
    error = 3.0 / 80.0 * v + 5e-4 * np.sin(5.0 * t)
    effort = kp * error - 3.0 * v
    log = ServoLog(t, q[:, None], (q + error)[:, None], effort[:, None])
    (found,), _ = gains_of_efforts([log], [(80.0, 3.0)])
    # Rates averaged over 0.2 s: half a per cent.
    assert found.kp == pytest.approx(told, rel=5e-3)


@pytest.mark.parametrize("known", [None, (40.0, 2.0)])
@pytest.mark.parametrize("late", [0.0, 0.0126])
def test_efforts_tell_gains_beside_late_commands_and_another_zero(known, late):
    """Of two joints one has its zero 0.04 rad off; commands come 6.3 rows late."""
    t = 0.002 * np.arange(8000)
    q = np.stack([np.sin(2.0 * t), 0.5 * np.cos(3.1 * t)], axis=1)
    v = np.stack([2.0 * np.cos(2.0 * t), -1.55 * np.sin(3.1 * t)], axis=1)

    def told(t):
        own = (np.sin(2.0 * t + 0.2), np.sin(7.0 * t), np.cos(3.1 * t), np.sin(9.0 * t))
        return np.stack([own[0] + 0.2 * own[1], 0.4 * own[2] + 0.1 * own[3]], axis=1)

    effort = 40.0 * (told(t - late) - q + [0.0, 0.04]) - 2.0 * v
    log = ServoLog(t, q, told(t), effort)
    found, by = gains_of_efforts([log], [known] * 2)
    assert go_in_lines([log], by) == (late > 0.0)
    assert by == pytest.approx(late, abs=2e-4)
    # Rates averaged over 0.2 s: half a per cent.
    np.testing.assert_allclose([g.kp for g in found], 40.0, rtol=5e-3)
    np.testing.assert_allclose([g.kd for g in found], 2.0, rtol=1e-2)


@pytest.mark.parametrize("rows_late", [0, 1, 2])
def test_efforts_of_a_stiff_loop_tell_gains_where_each_row_has_a_new_command(rows_late):
    """Rows of 10 ms, in which a loop of 1 ms is done with a step of its command, as
    policies of learned robots have them; of rates that are measured."""
    kp, kd, rows = 1600.0, 56.0, []
    q = v = 0.0
    commands = 0.4 * np.sin(0.02 * np.arange(2000)) + 0.2 * np.sin(
        0.051 * np.arange(2000)
    )
    for k, now in enumerate(commands):
        acts = commands[max(k - rows_late, 0)]
        for step in range(10):
            effort = kp * (acts - q) - kd * v
            if step == 0:
                rows.append((0.01 * k, q, now, effort, v))
            v += 1e-3 * effort
            q += 1e-3 * v
    t, *columns = np.array(rows).T
    log = ServoLog(t, *(x[:, None] for x in columns))
    (found,), late = gains_of_efforts([log], [None])
    assert late == pytest.approx(0.01 * rows_late, abs=1e-4)
    assert not go_in_lines([log], late)
    assert (found.kp, found.kd) == (pytest.approx(kp), pytest.approx(kd))
    # Means over rows fit as well, with gains that are a tenth off or more.
    (by_means,), _ = gains_of_efforts([replace(log, velocity=None)], [None])
    assert by_means.kp != pytest.approx(kp, rel=0.05)
    # Not by more: late commands are told from what means leave by themselves.
    assert by_means.kp == pytest.approx(kp, rel=0.15)


def test_without_efforts_no_joint_has_gains_by_them():
    """None of each joint, also where one of two logs has none."""
    t = 0.01 * np.arange(400)
    q = np.stack([np.sin(t), np.cos(t)], axis=1)
    whole, none = (
        ServoLog(t, q, q + 0.1, 40.0 * np.full_like(q, 0.1)),
        ServoLog(t, q, q),
    )
    assert gains_of_efforts([none], [None, (40.0, 2.0)]) == ([None, None], 0.0)
    assert gains_of_efforts([whole, none], [None, None]) == ([None, None], 0.0)


def test_efforts_that_a_servo_does_not_give_drive_the_joints(tmp_path):
    scene, sidecar = servo_log(
        tmp_path, 80.0, 3.0, lambda e, v: 80.0 * e - 3.0 * v, gravity=4.0
    )
    assert scene.actuation.type == "effort"
    assert "one.j.effort_measured" in sidecar


def test_a_drive_that_stops_its_joint_within_a_millisecond_has_a_shorter_step(tmp_path):
    scene, _ = servo_log(tmp_path, 4500.0, 450.0, None)
    # 0.2 kg m2 and a rotor of 0.1: 0.67 ms.
    assert scene.plant.time_step == 0.0005
    load_scene(scene, DiagramBuilder())  # At 1 ms it refuses.


@pytest.mark.parametrize("own", [80.0, 120.0])
def test_a_limit_that_measured_efforts_are_beyond_is_no_limit(tmp_path, own):
    """Of the file's own servo and of another: a world without it was logged."""

    def given(e, v):
        return own * e - 3.0 * v

    def limit_of(most):
        scene, _ = servo_log(tmp_path, 80.0, 3.0, given, limit=most)
        return scene.actuation.limit

    t = 0.002 * np.arange(6000)
    most = 3.0 * np.abs(2.0 * np.cos(2.0 * t) + 1.4 * np.cos(7.0 * t)).max()
    assert limit_of(2.0 * most) == [2.0 * most]
    assert limit_of(0.5 * most) == [1e9]


@pytest.mark.parametrize(
    ("lag", "says", "declared"),
    [
        (0.005, "5 +-", {"r.j1.velocity": "backward difference"}),
        (0.02, "20 +-", {"r.j1.velocity": "delay, 20 ms"}),
        (-0.02, "before position", {"r.j1.position": "delay, 20 ms"}),
        (0.0005, "", {}),
    ],
)
@pytest.mark.parametrize("own", ["", "filters: {r.j1.velocity: none}\n"])
def test_a_velocity_that_is_late_is_declared_so(tmp_path, lag, says, declared, own):
    """Of a log alone: two of its columns tell it. What its sidecar says stays."""
    t, rng = np.arange(0.0, 12.0, 0.01), np.random.default_rng(3)
    (tmp_path / "r.urdf").write_text(
        '<robot name="r"><link name="base"/><link name="bar"><inertial><mass value="1"'
        '/><origin xyz="0 0 -.3"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" '
        'iyz="0"/></inertial></link><joint name="j1" type="continuous"><parent '
        'link="base"/><child link="bar"/><axis xyz="0 1 0"/></joint></robot>'
    )

    def wave(t, rate=False):
        each = [(1.1, 3.0, 0.2), (0.6, 7.3, 1.0), (0.3, 11.9, 0.4)]
        if rate:
            return sum(a * w * np.cos(w * t + p) for a, w, p in each)
        return sum(a * np.sin(w * t + p) for a, w, p in each)

    noise = rng.normal(size=(2, len(t)))
    rows = [t, wave(t) + 1e-4 * noise[0], wave(t - lag, True) + 2e-3 * noise[1]]
    header = "time,j1_position,j1_velocity"
    path = tmp_path / "log.csv"
    np.savetxt(path, np.transpose(rows), delimiter=",", header=header, comments="")
    if own:
        (tmp_path / "log.yaml").write_text(own)
    log = read_log(path)
    proposal = propose_scene(read_robot(tmp_path / "r.urdf"), [log])
    filters = yaml.safe_load(proposal.sidecars[path]).get("filters") or {}
    told = [each.says for each in proposal.said if each.kind == "velocity_lag"]
    if own or not says:
        assert not told and filters == ({"r.j1.velocity": "none"} if own else {})
    else:
        assert filters == declared and says in told[0]

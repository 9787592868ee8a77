"""Logs with one wrong thing each: it is said, and no mass has to make up for it."""

import json
import re
from csv import reader
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
import yaml
from front_doors import KINDS, ROBOTS, exact, one

from makebreak.gap.data.content import Reading, check_contents, likeness
from makebreak.gap.data.reading import read_recording, read_recordings
from makebreak.gap.data.reshaped import reshaped
from makebreak.gap.data.robot import propose_scene, read_log, read_robot
from makebreak.gap.data.servo_gains import needed_efforts
from makebreak.gap.data.table import write_recording
from makebreak.gap.data.turns import without_turns


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_wrong_with_a_log_is_said_and_put_right(tmp_path, kind):
    """The channels that are read are those of the motion that the log was made of."""
    robot = list(ROBOTS)[len(kind) % len(ROBOTS)]
    said, right, found = one(kind, robot, 11, tmp_path)
    assert said, found.words
    assert right, found.words


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_of_a_log_that_is_right_nothing_is_said(tmp_path, robot, seed):
    _, right, found = one("semicolons and commas", robot, seed, tmp_path)
    assert right
    told = {line.split(" ", 1)[0] for line in found.words.splitlines()}
    wrong = ("effort_factor", "effort_sign", "columns_swapped", "columns_shifted",
             "columns_mixed", "no_content", "position_turns")  # fmt: skip
    assert not told & {*wrong}


def scene_log(tmp_path, factor):
    """A recording under our names whose efforts are `factor` times the true ones."""
    path, log = exact("three", tmp_path, np.random.default_rng(5))
    columns = {"time": log.time} | {
        name: y * (factor if name.endswith("effort_measured") else 1.0)
        for name, y in log.truth.items()
    }
    write_recording(tmp_path / "log.csv", columns)
    return read_robot(path).plant, read_recording(tmp_path / "log.csv")


def test_efforts_before_a_gear_are_an_error_beside_a_scene_too(tmp_path):
    """As an error: nothing is named until the sidecar has the factor."""
    plant, recording = scene_log(tmp_path, 1.0 / 80.0)
    (finding,) = check_contents(plant, [recording])
    assert (finding.kind, finding.severity) == ("effort_factor", "error")
    assert finding.size == pytest.approx(80.0)
    assert "scale: 80}" in finding.says


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.4])
def test_a_gain_that_the_search_can_name_is_left_to_it(tmp_path, factor):
    plant, recording = scene_log(tmp_path, factor)
    assert check_contents(plant, [recording]) == []


def test_a_rotor_that_the_model_lacks_is_no_factor(tmp_path):
    """A geared motor's own inertia makes efforts several times larger."""
    plant, recording = scene_log(tmp_path, 1.0)
    channels = dict(recording.channels)
    for i in range(1, 4):
        name = f"arm.joint{i}.effort_measured"
        speed = recording[f"arm.joint{i}.velocity"]
        rotor = 0.5 * np.gradient(speed, recording.time)
        channels[name] = replace(channels[name], values=channels[name].values + rotor)
    found = check_contents(plant, [replace(recording, channels=channels)])
    assert [f.kind for f in found] == []


def test_noise_of_a_column_makes_its_factor_no_smaller():
    """Of 4 N(0, 1) over N(0, 1) with noise of the same size, least squares give 2."""
    rng = np.random.default_rng(0)
    x, (a, b) = rng.normal(size=4000), rng.normal(size=(2, 4000))
    rest = np.ones((4000, 1))
    # The mean of two halves, each of sqrt(2) times the noise.
    halves = x + np.sqrt(2.0) * a, x + np.sqrt(2.0) * b
    found = likeness(4.0 * x, sum(halves) / 2.0, rest, halves)
    assert found.factor == pytest.approx(4.0, rel=0.1)
    assert found.explained == pytest.approx(1.0, abs=0.05)
    assert likeness(4.0 * x, sum(halves) / 2.0, rest).factor < 2.2


def test_a_log_of_half_a_second_is_said_to_be_too_short(tmp_path):
    plant, recording = scene_log(tmp_path, 1.0 / 80.0)
    short = {c.name: c.values[:60] for c in recording.channels.values()}
    write_recording(tmp_path / "short.csv", {"time": recording.time[:60]} | short)
    (finding,) = check_contents(plant, [read_recording(tmp_path / "short.csv")])
    assert (finding.kind, finding.severity) == ("too_short", "info")


def test_the_factor_is_that_of_least_squares_with_friction_free():
    """predicted = 3 column + 2 + 0.5 sign(v), with noise in neither."""
    t = np.linspace(0.0, 10.0, 500)
    v, column = np.cos(2.0 * t), np.sin(3.0 * t) + 0.2 * np.sign(np.cos(2.0 * t))
    predicted = 3.0 * column + 2.0 + 0.5 * np.sign(v)
    rest = np.stack([np.ones_like(v), v, np.sign(v)], axis=1)
    found = likeness(predicted, column, rest)
    np.testing.assert_allclose([found.factor, found.explained], [3.0, 1.0], atol=1e-9)


def test_turns_are_undone_and_fast_motion_is_left_alone():
    t = np.linspace(0.0, 10.0, 1000)
    q = 5.0 * np.sin(t)
    wrapped = np.mod(q + np.pi, 2.0 * np.pi) - np.pi
    back, n = without_turns(wrapped)
    # Up through pi, down through it and -pi, up again, and half of that once more.
    assert n == np.sum(np.abs(np.diff(wrapped)) > np.pi)
    np.testing.assert_allclose(back, q, atol=1e-12)
    steps = 3.0 * np.arange(50.0) % 7.0
    assert without_turns(steps)[1] == 0


def with_limits(path, limits):
    """The URDF with these effort limits, joint by joint."""
    parts = path.read_text().split('effort="500"')
    text = "".join(
        f'{part}effort="{limit}"' for part, limit in zip(parts, limits, strict=False)
    )
    path.write_text(text + parts[-1])


def csv(path, columns):
    np.savetxt(path, np.column_stack(list(columns.values())), "%.9g", ",",
               header=",".join(columns), comments="")  # fmt: skip
    return path


@pytest.mark.parametrize(("part", "word"), [(0.01, "per cent"), (0.001, "per mille")])
def test_efforts_in_parts_of_each_joints_limit_are_said_as_that(tmp_path, part, word):
    """Also where a part is near 1, as that of 87 N m, and of joints that cannot tell
    their unit from a rotor."""
    path, log = exact("scara", tmp_path, np.random.default_rng(8))
    limits = [87.0, 120.0, 40.0, 12.0]
    with_limits(path, limits)
    columns = {"time": log.time} | log.columns
    for k, limit in enumerate(limits, start=1):
        columns[f"joint{k}_effort"] = columns[f"joint{k}_effort"] / (part * limit)
    read = read_log(csv(tmp_path / "log.csv", columns))
    proposal = propose_scene(read_robot(path), [read])
    assert f"{word} of each joint's effort limit" in proposal.sidecars[read.path]
    for k, limit in enumerate(limits, start=1):
        line = f"joint{k}_effort: {{channel: arm.joint{k}.effort_measured, scale: "
        assert f"{line}{part * limit!r}" in proposal.sidecars[read.path]


def test_of_one_swing_no_effort_is_taken_to_lack_the_weight(tmp_path):
    """Weight and motion then go with the same sine: a pendulum without gravity, with
    other efforts of the other sign, explains it as well."""
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="base"/><link name="rod"><inertial><origin xyz="0'
        ' 0 -0.2"/><mass value="1"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" '
        'ixz="0" iyz="0"/></inertial></link><joint name="j1" type="continuous"><parent '
        'link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint></robot>'
    )
    t = np.arange(0.0, 3.0, 0.01)
    q = 0.5 * np.sin(3.0 * t)
    columns = {"time": t, "j1_position": q, "j1_effort": 1.78 * q}
    read = read_log(csv(tmp_path / "log.csv", columns))
    proposal = propose_scene(read_robot(tmp_path / "arm.urdf"), [read])
    assert "gravity" not in proposal.scene
    assert "scale" not in proposal.sidecars[read.path]


def test_a_slide_that_is_moved_by_six_metres_makes_no_turn(tmp_path):
    q = 1.0 + np.where(np.arange(400) < 200, 0.0, 2.0 * np.pi)
    table = {"time": 0.01 * np.arange(400.0), "arm.rail.position": q,
             "arm.hinge.position": q}  # fmt: skip
    write_recording(tmp_path / "log.csv", table)
    (read,) = read_recordings([tmp_path / "log.csv"], slides=["arm.rail"])
    assert np.ptp(read["arm.rail.position"]) == pytest.approx(2.0 * np.pi)
    assert np.ptp(read["arm.hinge.position"]) == pytest.approx(0.0, abs=1e-9)


PUSHED = {
    "urdf": """<robot name="arm"><link name="base"/>{links}
<joint name="finger" type="prismatic"><parent link="base"/><child link="f"/>
<axis xyz="1 0 0"/><limit effort="20" lower="-2" upper="2" velocity="9"/></joint>
<joint name="puck" type="prismatic"><parent link="base"/><child link="p"/>
<axis xyz="1 0 0"/><limit effort="{of_puck}" lower="-2" upper="2" velocity="9"/>
</joint></robot>""",
    "sdf": """<sdf version="1.9"><model name="arm"><link name="base"/>{links}
<joint name="finger" type="prismatic"><parent>base</parent><child>f</child>
<axis><xyz>1 0 0</xyz></axis></joint>
<joint name="puck" type="prismatic"><parent>base</parent><child>p</child>
<axis><xyz>1 0 0</xyz><limit><effort>{of_puck}</effort></limit></axis></joint>
</model></sdf>""",
    "xml": """<mujoco model="arm"><worldbody>{links}</worldbody><actuator>
<motor joint="finger"/>{of_puck}</actuator></mujoco>""",
}
LINK = {
    "urdf": '<link name="{0}"><inertial><mass value="1"/><inertia ixx="1e-3" iyy="1e-3"'
            ' izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>',
    "sdf": '<link name="{0}"><inertial><mass>1</mass></inertial></link>',
    "xml": '<body><joint name="{1}" type="slide" axis="1 0 0"/><inertial pos="0 0 0" '
           'mass="1" diaginertia="1e-3 1e-3 1e-3"/></body>',
}  # fmt: skip


@pytest.mark.parametrize(
    ("suffix", "passive", "driven"),
    [("urdf", "0", "20"), ("sdf", "0", "20"), ("xml", "", '<motor joint="puck"/>')],
)
def test_what_the_file_gives_no_drive_has_none(tmp_path, suffix, passive, driven):
    """A puck that a finger pushes needs as much force as if it were driven itself."""
    t = np.arange(0.0, 6.0, 0.01)
    q = 0.3 * np.sin(2.0 * t) + 0.2 * np.sin(3.1 * t)
    force = -2.4 * np.sin(2.0 * t) - 3.844 * np.sin(3.1 * t)
    columns = {"time": t, "finger_position": q, "puck_position": q}
    columns["finger_effort"] = force
    read = read_log(csv(tmp_path / "log.csv", columns))
    links = "".join(LINK[suffix].format(*n) for n in (("f", "finger"), ("p", "puck")))
    for of_puck, joints in ((passive, "arm.finger"), (driven, "arm.finger, arm.puck")):
        path = tmp_path / f"arm.{suffix}"
        path.write_text(PUSHED[suffix].format(links=links, of_puck=of_puck))
        proposal = propose_scene(read_robot(path), [read])
        assert f"actuation: {{type: effort, joints: [{joints}]}}" in proposal.scene
        said = any("nothing drives arm.puck" in note for note in proposal.notes)
        assert said == (of_puck == passive)


WALL = """<link name="wall"/><joint name="hook" type="fixed"><parent link="wall"/>
<child link="base"/><origin xyz="0 0 0" rpy="{0}"/></joint><link name="base"/>"""


def judged(folder, change, robot="three"):
    """What is said of a log whose columns and times `change` alters in place."""
    path, log = exact(robot, folder, np.random.default_rng(4))
    columns = {"time": log.time.copy()} | log.columns
    change(columns)
    proposal = propose_scene(
        read_robot(path), [read_log(csv(folder / "log.csv", columns))]
    )
    return {each.kind: each.says for each in proposal.said}


def test_a_joint_without_a_command_beside_others_is_told(tmp_path):
    path, log = exact("three", tmp_path, np.random.default_rng(4))
    columns = {"time": log.time}
    for k in (1, 2, 3):
        columns[f"joint{k}_position"] = q = log.columns[f"joint{k}_position"]
        columns[f"joint{k}_command"] = np.append(q[5:], q[-5:])
    told = []
    for _ in range(2):
        read = read_log(csv(tmp_path / "log.csv", columns))
        notes = propose_scene(read_robot(path), [read]).notes
        told.append([note for note in notes if "in this scene nothing does" in note])
        columns.pop("joint2_command", None)
    assert told[0] == [] and "what drives arm.joint2:" in told[1][0]


def test_positions_that_count_from_the_logs_start_are_asked_about(tmp_path):
    def from_start(columns):
        for name in [n for n in columns if n.endswith("position")]:
            columns[name] = columns[name] - columns[name][0]

    found = judged(tmp_path, from_start)
    assert "count from where the log" in found["position_from_start"]


def test_a_servo_that_sets_out_at_its_command_took_no_offset(tmp_path):
    """Its efforts begin at 0, and are a little off afterwards; the weight is there."""

    def sets_out(columns):
        for name in [n for n in columns if n.endswith("effort")]:
            columns[name] = columns[name] + 0.5 * np.std(columns[name])
            columns[name][0] = 0.0

    assert "effort_tared" not in judged(tmp_path, sets_out)


def test_efforts_of_another_motion_are_said_to_explain_nothing(tmp_path):
    def other(columns):
        for name in [n for n in columns if n.endswith("effort")]:
            columns[name] = np.random.default_rng(1).normal(size=len(columns[name]))

    assert "in its joints' order" in judged(tmp_path, other)["effort_unexplained"]
    assert judged(tmp_path, lambda columns: None) == {}


@pytest.mark.parametrize("lean", [1.5708, 0.15])
def test_a_base_that_hangs_on_a_wall_is_told_by_the_efforts(tmp_path, lean):
    """In a log without an IMU, whose efforts do not go with the motion of a base that
    stands. One that leans a little is the search's (gravity_tilt)."""
    path, log = exact("six", tmp_path, np.random.default_rng(4))
    text = path.read_text()
    columns = {"time": log.time} | log.columns
    q = np.stack([log.truth[f"arm.joint{k}.position"] for k in range(1, 7)], axis=1)
    for sign, turn in ((-1.0, "0 0 0"), (1.0, f"0 {lean} 0")):
        path.write_text(text.replace('<link name="base"/>', WALL.format(turn)))
        at_rest = needed_efforts(read_robot(path).plant, q, 0.0 * q, 0.0 * q)
        for k in range(6):
            name = f"joint{k + 1}_effort"
            columns[name] = columns[name] + sign * at_rest[:, k]
    path.write_text(text)
    file = csv(tmp_path / "log.csv", columns)
    proposal = propose_scene(read_robot(path), [read_log(file)])
    if lean < 1.0:
        assert "base_tilted" not in [each.kind for each in proposal.said]
        return
    assert [each.kind for each in proposal.said] == ["base_tilted"]
    gravity = yaml.safe_load(proposal.scene)["plant"]["gravity"]
    np.testing.assert_allclose(gravity, [9.81, 0.0, 0.0], atol=0.3)


def test_a_robot_without_masses_is_refused_by_its_joints(tmp_path):
    """As a xacro is whose arguments leave them out."""
    path, log = exact("planar", tmp_path, np.random.default_rng(4))
    file = csv(tmp_path / "log.csv", {"time": log.time} | log.columns)
    path.write_text(
        re.sub("<inertial>.*?</inertial>", "", path.read_text(), flags=re.S)
    )
    with pytest.raises(ValueError, match=r"arm.joint1, arm.joint2 moves has no mass"):
        propose_scene(read_robot(path), [read_log(file)])


def driven_by(folder, change) -> tuple[str, dict[str, str]]:
    """The proposed actuation's type, and why each column is what it is."""
    path, log = exact("three", folder, np.random.default_rng(4))
    columns = {"time": log.time} | log.columns
    change(columns, lambda k: log.truth[f"arm.joint{k}.position"])
    file = csv(folder / "log.csv", columns)
    proposal = propose_scene(read_robot(path), [read_log(file)])
    kind = yaml.safe_load(proposal.scene)["actuation"]["type"]
    return kind, yaml.safe_load(proposal.sidecars[file])["columns"]


def test_positions_commands_drive_where_efforts_do_not_go_with_the_motion(tmp_path):
    """As the loads that hobby servos report, in steps of a thousandth of the stall."""

    def servos(columns, position):
        for k in (1, 2, 3):
            noise = np.random.default_rng(k).normal(size=len(columns["time"]))
            columns[f"joint{k}_effort"] = noise
            columns[f"joint{k}_position_command"] = position(k) + 1e-3 * noise

    kind, columns = driven_by(tmp_path, servos)
    assert kind == "servo" and columns["joint1_effort"] is None
    assert columns["joint1_position_command"] == "arm.joint1.position_command"


@pytest.mark.parametrize("part", [0.3, 1.0])
def test_commanded_efforts_to_which_a_loop_adds_do_not_drive(tmp_path, part):
    """A feed-forward that is called the desired torque, beside the measured one."""

    def feed_forward(columns, position):
        for k in (1, 2, 3):
            own = columns[f"joint{k}_effort"]
            columns[f"joint{k}_effort_desired"] = own * part + (1.0 - part) * np.std(
                own
            ) * np.sin(3.0 * columns["time"])

    kind, columns = driven_by(tmp_path, feed_forward)
    assert kind == "effort"
    own = columns["joint2_effort_desired"]
    assert own == (None if part < 1.0 else "arm.joint2.effort_command")
    assert columns["joint2_effort"] == "arm.joint2.effort_measured"


@pytest.mark.parametrize(("late", "said"), [(0.03, True), (0.0, False), (-0.03, False)])
def test_efforts_stamped_late_are_said_to_be(tmp_path, late, said):
    """Commands that act later than their stamps are what a search names."""

    def shift(columns):
        for name in [n for n in columns if n.endswith("effort")]:
            t = columns["time"]
            columns[name] = np.interp(t - late, t, columns[name])

    found = judged(tmp_path, shift)
    assert ("effort_late" in found) == said
    assert not said or "30 ms before" in found["effort_late"]


@pytest.mark.parametrize("late, damping", [(0.03, 0.0), (0.0, 0.0), (0.0, 0.5)])
def test_late_efforts_of_a_slow_robot_are_no_friction(tmp_path, late, damping):
    """A sixth of the pace: what is late by 30 ms differs by 2 % at most, and goes with
    the velocity. So does damping that the model has and the robot lacks."""
    path, log = exact("three", tmp_path, np.random.default_rng(4))
    at = [f"joint{k}_position" for k in (1, 2, 3)]
    q, pace = np.stack([log.columns[name] for name in at], axis=1), 6.0
    v = np.gradient(q, pace * log.time, axis=0)
    vd = np.gradient(v, pace * log.time, axis=0)
    efforts = needed_efforts(read_robot(path).plant, q, v, vd)
    path.write_text(path.read_text().replace(
        "</joint>", f'<dynamics damping="{damping}"/></joint>'
    ))  # fmt: skip
    t = np.arange(0.0, 60.0, 0.01)
    columns = {"time": t}
    for k, name in enumerate(at):
        columns[name] = np.interp(t, pace * log.time, q[:, k])
        own = np.interp(t - late, pace * log.time, efforts[:, k])
        noise = 0.02 * np.std(own) * np.random.default_rng(k).normal(size=len(t))
        columns[f"joint{k + 1}_effort"] = own + noise
    log_path = csv(tmp_path / "slow.csv", columns)
    said = propose_scene(read_robot(path), [read_log(log_path)]).said
    assert [s.kind for s in said] == (["effort_late"] if late else [])


@pytest.mark.parametrize("toes", [0, 3])
def test_left_and_right_legs_taken_for_each_other_are_told(tmp_path, toes):
    """Two legs whose hips lean to their own sides, and a log of them: right, and with
    all columns of the one called the other's. Of few joints that is put right; of more
    than are tried in all orders it is asked about."""
    legs = []
    for side, y in (("left", 0.1), ("right", -0.1)):
        for k, (axis, com) in enumerate((
            ("1 0 0", f"0.02 {y} 0"), *[("0 1 0", "0.1 0 -0.2")] * (1 + toes)
        )):  # fmt: skip
            parent = "base" if k == 0 else f"{side}{k - 1}"
            legs.append(
                f'<link name="{side}{k}"><inertial><origin xyz="{com}"/>'
                '<mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" '
                f'ixz="0" iyz="0"/></inertial></link><joint name="{side}_{k}" '
                f'type="revolute"><parent link="{parent}"/><child link="{side}{k}"/>'
                f'<origin xyz="0 {y} 0"/><axis xyz="{axis}"/><limit lower="-2" '
                'upper="2" effort="50" velocity="20"/></joint>'
            )
    path = tmp_path / "legs.urdf"
    path.write_text(f'<robot name="legs"><link name="base"/>{"".join(legs)}</robot>')
    robot = read_robot(path)
    t = np.arange(0.0, 12.0, 0.01)
    w = np.linspace(1.3, 2.9, 2 * (2 + toes))
    q = 0.6 * np.sin(t[:, None] * w)
    tau = needed_efforts(robot.plant, q, w * 0.6 * np.cos(t[:, None] * w), -q * w**2)
    for swapped in (False, True):
        columns = {"time": t}
        for k, joint in enumerate(robot.joints):
            name = joint.name.partition(".")[2]
            if swapped:
                side, end = name.split("_")
                name = f"{'left' if side == 'right' else 'right'}_{end}"
            columns |= {f"{name}_position": q[:, k], f"{name}_effort": tau[:, k]}
        log = read_log(csv(tmp_path / "log.csv", columns))
        said = {s.kind: s.says for s in propose_scene(robot, [log]).said}
        if not swapped:
            assert said == {}
        elif toes:
            assert "turned the other way" in said["joints_mirrored"]
        else:
            assert "right_0_position is legs.left_0.position" in said["columns_mixed"]


def test_efforts_in_parts_of_unknown_ratings_are_asked_about(tmp_path):
    """Two of three joints could be explained by nothing but their unit."""

    def rated(columns):
        for name, rating in (("joint2_effort", 4.0), ("joint3_effort", 3.0)):
            columns[name] = columns[name] * rating

    found = judged(tmp_path, rated)
    assert "joint2_effort, joint3_effort: larger" in found["effort_unsure"]


LONG = "time,joint,position\n"


@pytest.mark.parametrize(
    "rows, is_long",
    [
        # Two rows of one instant.
        (['0,"a, b",1', "0,c,2", '1,"a, b",3', "1,c,4", "2,c,5"], True),
        # Each row at an instant of its own, names in turns; too few of them to tell.
        ([f"{k},{'ab'[k % 2]},{k}" for k in range(8)], True),
        ([f"{k},{'ab'[k % 2]},{k}" for k in range(6)], False),
        ([f"{k},{'aab'[k % 3]},{k}" for k in range(12)], False),
    ],
)
def test_a_row_for_each_joint_becomes_a_column_for_each(rows, is_long):
    file = BytesIO((LONG + "\n".join(rows) + "\n").encode())
    wide = reshaped(file)
    if not is_long:
        assert wide is None and file.tell() == 0
        return
    names, *table = reader(wide.read().decode().splitlines())
    label = next(reader(rows[:1]))[1]
    assert names[:2] == ["time", f"{label}/position"] and len(names) == 3
    for row in reader(rows):
        own = next(each for each in table if each[0] == row[0])
        assert own[names.index(f"{row[1]}/position")] == row[2]


def test_columns_that_are_counted_are_of_the_order_that_the_efforts_go_with(tmp_path):
    """Nine joints, whose file does not have them along the robot; names in each line of
    JSON say it without that."""
    links, n = [], 9
    order = [0, 3, 6, 1, 4, 7, 2, 5, 8]  # Three limbs, joint by joint.
    for k in order:
        limb, place = divmod(k, 3)
        parent = f"l{k - 1}" if place else "base"
        links.append(
            f'<link name="l{k}"><inertial><origin xyz="0 0 -0.1"/><mass value="{1 + k}"'
            '/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
            f'</inertial></link><joint name="j{k}" type="revolute"><parent '
            f'link="{parent}"/><child link="l{k}"/><origin xyz="0 {limb} -0.2"/><axis '
            f'xyz="{place % 2} {1 - place % 2} 0"/><limit lower="-2" upper="2" '
            'effort="90" velocity="9"/></joint>'
        )
    path = tmp_path / "limbs.urdf"
    path.write_text(f'<robot name="limbs"><link name="base"/>{"".join(links)}</robot>')
    robot = read_robot(path)
    along = [joint.name.partition(".")[2] for joint in robot.joints]
    assert along != [f"j{k}" for k in order]
    t, w = np.arange(0.0, 12.0, 0.01), 1.0 + 0.2 * np.arange(n)
    q = 0.6 * np.sin(t[:, None] * w + np.arange(n))
    v, vd = w * 0.6 * np.cos(t[:, None] * w + np.arange(n)), -q * w**2
    tau = needed_efforts(robot.plant, q, v, vd)
    at = [along.index(f"j{k}") for k in order]
    columns = {"time": t} | {f"q[{i}]": q[:, k] for i, k in enumerate(at)}
    columns |= {f"tau[{i}]": tau[:, k] for i, k in enumerate(at)}
    log = csv(tmp_path / "log.csv", columns)
    proposal = propose_scene(robot, [read_log(log)])
    assert "as the robot's file has its joints" in proposal.said[0].says
    assert "'q[1]': limbs.j3.position" in proposal.sidecars[log]
    lines = tmp_path / "log.jsonl"
    text = [f"j{k}" for k in order]
    lines.write_text("".join(
        json.dumps({"t": s, "name": text, "q": list(x[at]), "tau": list(y[at])}) + "\n"
        for s, x, y in zip(t, q, tau, strict=True)
    ))  # fmt: skip
    proposal = propose_scene(robot, [read_log(lines)])
    assert proposal.said == ()
    assert "q/j3: limbs.j3.position" in proposal.sidecars[lines]


def test_a_reading_scaled_has_its_zero_in_the_new_unit():
    """What was read, times a factor: a zero that was found in degrees, too."""
    reading = Reading((1, 0), np.array([1.0, -2.0]), np.array([0.3, 0.5]))
    q = np.array([0.7, -0.4])
    other = reading.scaled([1], 0.1)
    np.testing.assert_allclose(
        q * other.scale + other.zero, (q * reading.scale + reading.zero) * [1.0, 0.1]
    )
    assert other.order == reading.order


def test_friction_tells_the_sign_of_an_effort_that_carries_nothing(tmp_path):
    """It never drives. Beside it, what the model needs of the joint is next to none."""
    path, log = exact("scara", tmp_path, np.random.default_rng(3))
    v = log.truth["arm.joint4.velocity"]
    friction = 40.0 * (np.tanh(v / 0.01) + 0.5 * v)
    columns = {"time": log.time} | log.columns
    for sign in (1.0, -1.0):
        columns["joint4_effort"] = sign * (log.columns["joint4_effort"] + friction)
        read = read_log(csv(tmp_path / f"log{sign:.0f}.csv", columns))
        said = propose_scene(read_robot(path), [read]).findings()
        turned = [f for f in said if f.kind == "effort_sign"]
        assert [f.channel for f in turned] == (
            [] if sign > 0.0 else ["arm.joint4.effort_measured"]
        )


@pytest.mark.parametrize("first", [1.0, -1.0])
def test_efforts_of_joints_that_do_not_tell_have_the_sign_of_those_that_do(
    tmp_path, first
):
    """As a KUKA's, all of whose efforts have the other sign. Two joints tell it, each
    with a gain of its own; where these differ the third is left."""
    path, log = exact("three", tmp_path, np.random.default_rng(4))
    columns = {"time": log.time} | log.columns
    slow = np.cumsum(np.random.default_rng(1).normal(size=len(log.time)))
    drift = slow / np.std(slow) * 10.0 * np.std(columns["joint3_effort"])
    columns["joint3_effort"] = -(columns["joint3_effort"] + drift)
    columns["joint1_effort"] = -0.8 * first * columns["joint1_effort"]
    columns["joint2_effort"] = -1.3 * columns["joint2_effort"]
    read = read_log(csv(tmp_path / "log.csv", columns))
    text = propose_scene(read_robot(path), [read]).sidecars[read.path]
    for k, turned in ((1, first > 0.0), (2, True), (3, first > 0.0)):
        line = f"joint{k}_effort: {{channel: arm.joint{k}.effort_measured, scale: -1"
        assert (line in text) == turned


def test_efforts_are_in_the_unit_that_most_of_them_are_in(tmp_path):
    """One joint gives 12 % more than its model needs: a gain, for the search to find,
    and no unit of its own."""
    path, log = exact("three", tmp_path, np.random.default_rng(4))
    columns = {"time": log.time} | log.columns
    for k, gain in enumerate((1.0, 1.0, 1.12), start=1):
        columns[f"joint{k}_effort"] = 1e3 * gain * columns[f"joint{k}_effort"]
    read = read_log(csv(tmp_path / "log.csv", columns))
    text = propose_scene(read_robot(path), [read]).sidecars[read.path]
    for k in (1, 2, 3):
        line = f"joint{k}_effort: {{channel: arm.joint{k}.effort_measured, scale: 0.001"
        assert line in text


def test_gears_that_differ_are_not_taken_from_the_joint_that_tells_best(tmp_path):
    """As of a mobile manipulator's currents: one joint tells its factor well, another
    one less well, and of the other sign, and the third hardly moves its own."""
    path, log = exact("three", tmp_path, np.random.default_rng(4))
    columns = {"time": log.time} | log.columns
    noise = np.random.default_rng(1).normal(size=len(log.time))
    slow = np.cumsum(noise)  # What the model has not.
    tau = columns["joint3_effort"]
    columns["joint3_effort"] = (tau + 0.4 * np.std(tau) * slow / np.std(slow)) / 9.0
    columns["joint2_effort"] = columns["joint2_effort"] / -6.0
    columns["joint1_effort"] = 1e-3 * noise
    read = read_log(csv(tmp_path / "log.csv", columns))
    proposal = propose_scene(read_robot(path), [read])
    own = yaml.safe_load(proposal.sidecars[read.path])["columns"]
    assert own["joint2_effort"]["scale"] == -6.0
    assert own["joint3_effort"]["scale"] == pytest.approx(9.0, rel=0.2)
    assert own["joint1_effort"] == "arm.joint1.effort_measured"
    says = {each.kind: each.says for each in proposal.said}
    assert "joint1_effort: in a unit of its own" in says["effort_unsure"]

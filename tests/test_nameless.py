"""Tables without names: columns by what is in them."""

import numpy as np
import pytest
import yaml
from front_doors import exact

from makebreak.gap.data.robot import propose_scene, read_log, read_robot
from makebreak.gap.data.servo_gains import needed_efforts

WHAT = {"position": "position", "velocity": "velocity", "effort": "effort_measured"}


def proposed(folder, blocks, by_joint=False, timed=True):
    """What is proposed for the columns of a log of three joints, and what is said; and
    the names that these columns should have. blocks: of what, or numbers (n, 3)."""
    path, log = exact("three", folder, np.random.default_rng(4))
    columns, names = [], []
    for block in blocks:
        for i in (1, 2, 3):
            if isinstance(block, str):
                columns.append(log.columns[f"joint{i}_{block}"])
                names.append(f"arm.joint{i}.{WHAT[block]}")
            else:
                columns.append(block(log.columns[f"joint{i}_position"], i))
                names.append(None)
    order = np.arange(3 * len(blocks)).reshape(-1, 3)
    order = (order.T if by_joint else order).ravel()
    table = np.stack(columns, axis=1)[:, order]
    file = folder / "log.csv"
    if timed:
        table = np.column_stack([log.time, table])
    else:
        (folder / "log.yaml").write_text("rate_hz: 100\n")
    np.savetxt(file, table, delimiter=" ", fmt="%.9g")
    read = read_log(file)
    proposal = propose_scene(read_robot(path), [read])
    own = yaml.safe_load(proposal.sidecars[file])["columns"]
    found = [own[f"column_{k + 1 + timed}"] for k in range(len(order))]
    found = [x["channel"] if isinstance(x, dict) else x for x in found]
    said = [s.says for s in proposal.said if s.kind == "columns_unnamed"]
    return found, [names[k] for k in order], said


@pytest.mark.parametrize("by_joint", [False, True])
@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.parametrize(
    "blocks",
    [
        ("position", "velocity", "effort"),
        ("effort", "velocity", "position"),
        ("position", "effort"),
        ("effort", "position"),
    ],
)
def test_columns_are_known_by_the_motion_and_the_model(
    tmp_path, blocks, by_joint, timed
):
    found, expected, said = proposed(tmp_path, blocks, by_joint, timed)
    assert found == expected
    assert "log.csv does not name its columns" in said[0]


def test_accelerations_and_what_says_nothing_are_left_out(tmp_path):
    def rate(q, i):
        return np.gradient(np.gradient(q, 0.01), 0.01)

    def other(q, i):
        return np.random.default_rng(i).normal(size=len(q)).cumsum()

    blocks = (other, "position", "velocity", rate, "effort")
    found, expected, _ = proposed(tmp_path, blocks)
    assert found == expected


def test_commands_are_what_positions_follow(tmp_path):
    def command(q, i):
        return np.append(q[3:], q[-3:])

    found, expected, _ = proposed(tmp_path, ("position", "velocity", command))
    expected[-3:] = [f"arm.joint{i}.position_command" for i in (1, 2, 3)]
    assert found == expected


def test_columns_that_could_be_efforts_as_well_are_named(tmp_path):
    path, log = exact("three", tmp_path, np.random.default_rng(4))

    def also(q, i):  # As currents beside the torques that a controller wanted.
        tau = log.columns[f"joint{i}_effort"]
        return 0.1 * (tau + 0.2 * np.std(tau) * np.random.default_rng(i).normal())

    found, expected, said = proposed(tmp_path, ("position", "velocity", also, "effort"))
    assert found == expected and "column_8 could be the efforts as well" in said[0]


@pytest.mark.parametrize("names", [("x", "u"), ("state", "input"), ("data", "tau")])
def test_a_state_and_inputs_that_are_one_fewer_are_read(tmp_path, names):
    """As control has them: x of n + 1 instants, u between them, and a step."""
    path, log = exact("three", tmp_path, np.random.default_rng(4))
    x = [
        log.columns[f"joint{i}_{w}"]
        for w in ("position", "velocity")
        for i in (1, 2, 3)
    ]
    u = [log.columns[f"joint{i}_effort"][:-1] for i in (1, 2, 3)]
    file = tmp_path / "log.npz"
    np.savez(file, **dict(zip(names, (np.array(x), np.array(u)), strict=True)), dt=0.01)
    proposal = propose_scene(read_robot(path), [read_log(file)])
    own = yaml.safe_load(proposal.sidecars[file])["columns"]
    for k in range(6):
        what = "position" if k < 3 else "velocity"
        assert own[f"{names[0]}[{k}]"] == f"arm.joint{k % 3 + 1}.{what}"
    for k in range(3):
        assert own[f"{names[1]}[{k}]"].startswith(f"arm.joint{k + 1}.effort_")


def test_an_array_of_its_own_is_read(tmp_path):
    path, log = exact("three", tmp_path, np.random.default_rng(4))
    what = [(w, i) for w in ("position", "velocity", "effort") for i in (1, 2, 3)]
    table = [log.time, *(log.columns[f"joint{i}_{w}"] for w, i in what)]
    np.save(tmp_path / "log.npy", np.array(table).T)
    read = read_log(tmp_path / "log.npy")
    sidecar = propose_scene(read_robot(path), [read]).sidecars[read.path]
    own = yaml.safe_load(sidecar)["columns"]
    assert own["column[0]"] == "time" and own["column[9]"].startswith("arm.joint3.eff")
    np.save(tmp_path / "objects.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(ValueError, match="pickled objects"):
        read_log(tmp_path / "objects.npy")


def test_numbers_that_are_no_motion_are_refused(tmp_path):
    def noise(q, i):
        return np.random.default_rng(i).normal(size=len(q))

    with pytest.raises(ValueError, match="no column looks like the position"):
        proposed(tmp_path, (noise, noise, noise))


LEG = """<link name="{0}_thigh"><inertial><origin xyz="0 {1} -0.03"/><mass value="0.7"/>
<inertia ixx="0.002" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{0}_hip" type="revolute"><parent link="base"/><child link="{0}_thigh"/>
<origin xyz="0 {1} 0"/><axis xyz="1 0 0"/>
<limit lower="-2" upper="2" effort="50" velocity="20"/></joint>
<link name="{0}_shank"><inertial><origin xyz="0.01 0 -0.1"/><mass value="0.3"/>
<inertia ixx="0.001" iyy="0.001" izz="4e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{0}_calf" type="revolute"><parent link="{0}_thigh"/>
<child link="{0}_shank"/><origin xyz="0 {1} -0.2"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="50" velocity="20"/></joint>"""


@pytest.mark.parametrize("right_first", [True, False])
def test_legs_may_be_counted_by_their_names(tmp_path, right_first):
    """The file has the right leg first, and pinocchio the left one: of legs that mirror
    each other only the hips tell whose columns they are."""
    text = '<robot name="r"><link name="base"/>' + LEG.format("r", -0.1)
    (tmp_path / "r.urdf").write_text(text + LEG.format("l", 0.1) + "</robot>")
    robot = read_robot(tmp_path / "r.urdf")
    names = [j.name for j in robot.joints]
    assert names == ["r.r_hip", "r.r_calf", "r.l_hip", "r.l_calf"]
    t = np.arange(0.0, 12.0, 0.01)[:, None]
    w, at = np.array([2.1, 3.3, 2.7, 3.9]), np.arange(4)
    q, v, vd = (0.5 * np.sin(w * t + at), 0.5 * w * np.cos(w * t + at),
                -0.5 * w**2 * np.sin(w * t + at))  # fmt: skip
    effort = needed_efforts(robot.plant, q, v, vd)
    effort += 0.01 * np.random.default_rng(3).normal(size=q.shape)
    order = [0, 1, 2, 3] if right_first else [2, 3, 0, 1]
    columns = [f"{what}_{k}" for what in ("q", "tau") for k in range(4)]
    table = np.column_stack([t, q[:, order], effort[:, order]])
    np.savetxt(tmp_path / "log.csv", table, "%.9g", ",",
               header=",".join(["time", *columns]), comments="")  # fmt: skip
    proposal = propose_scene(robot, [read_log(tmp_path / "log.csv")])
    own = yaml.safe_load(proposal.sidecars[tmp_path / "log.csv"])["columns"]
    found = [x["channel"] if isinstance(x, dict) else x for x in own.values()]
    expected = [names[k] for k in order]
    assert [x for x in found if x.endswith(".position")] == [
        f"{name}.position" for name in expected
    ]
    said = [s.says for s in proposal.said if s.kind == "columns_mixed"]
    assert said == [] if right_first else "counted limb by limb" in said[0]


@pytest.mark.parametrize("behind, taken", [(12, True), (None, False)])
def test_the_only_column_that_goes_after_a_command_is_the_position(
    tmp_path, behind, taken
):
    rng = np.random.default_rng(3)
    command = np.repeat(rng.uniform(-0.5, 0.5, 20), 30)
    y = rng.normal(size=600).cumsum()
    if behind is not None:
        y = np.roll(np.convolve(command, np.ones(9) / 9.0, "same"), behind)
    robot = """<mujoco><worldbody><body><joint name="j" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/></body></worldbody>
        <actuator><position joint="j" kp="20" kv="2"/></actuator></mujoco>"""
    (tmp_path / "a.xml").write_text(robot)
    rows = zip(0.01 * np.arange(600), command, y, strict=True)
    text = "\n".join(",".join(map(str, row)) for row in rows)
    (tmp_path / "log.csv").write_text(f"time,actions,sensor_data\n{text}\n")
    read = read_log(tmp_path / "log.csv")
    if not taken:
        with pytest.raises(ValueError, match="no column looks like the position"):
            propose_scene(read_robot(tmp_path / "a.xml"), [read])
        return
    proposal = propose_scene(read_robot(tmp_path / "a.xml"), [read])
    own = yaml.safe_load(proposal.sidecars[read.path])["columns"]
    assert own["sensor_data"] == "a.j.position"
    assert own["actions"] == "a.j.position_command"

"""Joints that stand still in a scene, and models that couple joints."""

import numpy as np
import pytest

from makebreak.gap import run_gap
from makebreak.gap.data.findings import FIXED
from makebreak.gap.data.robot import propose_scene, read_log, read_robot
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.fixed_joints import coupled_joints
from makebreak.models.scene import read_scene

JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/>
<child link="{child}"/><origin xyz="{xyz}" rpy="0.3 0 0"/><axis xyz="{axis}"/>
<limit lower="-1" upper="1" effort="50" velocity="2"/>{mimic}</joint>"""
LINK = """<link name="{name}"><inertial><origin xyz="0.1 0.02 0"/><mass value="{mass}"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
FOLLOWS = '"-0.5" offset="0.2"'
MIMIC = '<mimic joint="left" multiplier="1"/>'


def robot(folder, right=MIMIC, beyond=""):
    """An arm of two joints with a gripper: a finger that slides and one that turns."""
    masses = {"upper": 2.0, "fore": 1.0, "l": 0.3, "r": 0.2}
    links = [LINK.format(name=n, mass=m) for n, m in masses.items()]
    joints = [
        JOINT.format(name=n, kind=k, parent=p, child=c, xyz=x, axis=a, mimic=m)
        for n, k, p, c, x, a, m in (
            ("shoulder", "revolute", "base", "upper", "0 0 0.5", "0 1 0", ""),
            ("elbow", "revolute", "upper", "fore", "0.3 0 0", "0 1 0", ""),
            ("left", "prismatic", "fore", "l", "0.2 0.1 0", "0 1 0", ""),
            ("right", "revolute", "fore", "r", "0.2 -0.1 0", "0 0 1", right),
        )
    ]  # fmt: skip
    path = folder / "arm.urdf"
    text = '<robot name="arm"><link name="base"/>' + "".join([*links, *joints])
    path.write_text(text + beyond + "</robot>")
    return path


def scene(folder, more=""):
    path = folder / "scene.yaml"
    path.write_text(
        "directives:\n"
        f'- add_model: {{name: arm, file: "file://{folder}/arm.urdf"}}\n'
        "- add_weld: {parent: world, child: arm::base}\n"
        f"actuation: {{type: effort, joints: [arm.shoulder, arm.elbow]}}\n{more}"
    )
    return path


LOOP = """<drake:ball_constraint>
<drake:ball_constraint_body_A name="upper"/><drake:ball_constraint_body_B name="fore"/>
<drake:ball_constraint_p_AP value="0.3 0 0"/>
<drake:ball_constraint_p_BQ value="0 0 0"/></drake:ball_constraint>"""


@pytest.mark.parametrize("right", ["", MIMIC])
def test_a_closed_loop_of_other_joints_is_not_lost(tmp_path, right):
    """Its forces would be missing in the equations of the joints that move."""
    path = robot(tmp_path, right, beyond=LOOP)
    assert coupled_joints(path) == ({"right": "left"} if right else {})
    fixed = "fixed_joints: {arm.left: 0, arm.right: 0}\n"
    with pytest.raises(ValueError, match="expected no others: closed loops"):
        SceneDynamics(read_scene(scene(tmp_path, fixed)))


def log(folder, names):
    """Sines, 100 rows a second, of joints' positions and of the arm's efforts."""
    t = np.arange(0.0, 8.0, 0.01)
    columns = {"time": t}
    for k, name in enumerate(names):
        columns[f"{name}.position"] = 0.3 + 0.2 * np.sin((2.0 + k) * t)
    for name in ("shoulder", "elbow"):
        columns[f"{name}.effort"] = np.cos(2.0 * t)
    path = folder / "log.csv"
    np.savetxt(path, np.column_stack(list(columns.values())), "%.9g", ",",
               header=",".join(columns), comments="")  # fmt: skip
    return path


def test_fixed_joints_carry_their_links_as_if_they_did_not_turn(tmp_path):
    """The inertia of the others is the block of the whole mass matrix that is theirs,
    and their gravity is the same."""
    robot(tmp_path, right="")
    whole = SceneDynamics(read_scene(scene(tmp_path))).plant
    fixed = "fixed_joints: {arm.left: 0.07, arm.right: -0.4}\n"
    less = SceneDynamics(read_scene(scene(tmp_path, fixed))).plant
    assert (whole.num_velocities(), less.num_velocities()) == (4, 2)
    q = np.array([0.3, -0.8])
    a, b = whole.CreateDefaultContext(), less.CreateDefaultContext()
    whole.SetPositions(a, [*q, 0.07, -0.4])
    less.SetPositions(b, q)
    np.testing.assert_allclose(
        less.CalcMassMatrix(b), whole.CalcMassMatrix(a)[:2, :2], rtol=1e-12
    )
    np.testing.assert_allclose(
        less.CalcGravityGeneralizedForces(b),
        whole.CalcGravityGeneralizedForces(a)[:2], rtol=1e-12,
    )  # fmt: skip


def test_a_mimic_is_refused_with_the_joints_to_fix_and_a_tilt_needs_no_mimic(tmp_path):
    robot(tmp_path)
    path = log(tmp_path, ["shoulder", "elbow", "left", "right"])
    text = path.read_text().replace("shoulder.", "arm.shoulder.")
    for name in ("elbow", "left", "right"):
        text = text.replace(f",{name}.", f",arm.{name}.")
    path.write_text(text.replace(".effort", ".effort_measured"))
    says = r"arm.right follows arm.left.*fixed_joints: \{arm.right: 0, arm.left: 0\}"
    with pytest.raises(ValueError, match=says):
        run_gap(scene(tmp_path), [path])
    one = scene(tmp_path, "fixed_joints: {arm.left: 0.07}\n")
    with pytest.raises(ValueError, match="arm.right follows arm.left"):
        SceneDynamics(read_scene(one))
    tilt = "- {kind: gravity_tilt, at: arm, parameters: {roll: 0.1, pitch: 0}}\n"
    both = "fixed_joints: {arm.left: 0.07, arm.right: 0}\neffects:\n" + tilt
    assert SceneDynamics(read_scene(scene(tmp_path, both))).plant.num_velocities() == 2
    robot(tmp_path, right="")
    wrong = scene(tmp_path, "fixed_joints: {arm.wrist: 0}\n")
    with pytest.raises(ValueError, match="no joint arm.wrist, the scene has arm.shou"):
        SceneDynamics(read_scene(wrong))


@pytest.mark.parametrize(
    "suffix, text",
    [
        ("urdf", "<robot><joint name='b'><mimic joint='a'/></joint></robot>"),
        ("sdf", "<sdf><model><joint name='b'><axis><mimic joint='a'/></axis></joint>"
                "</model></sdf>"),
        ("xml", "<mujoco><equality><joint joint1='b' joint2='a'/></equality></mujoco>"),
    ],
)  # fmt: skip
def test_couplings_are_read_from_every_format(suffix, text, tmp_path):
    path = tmp_path / f"robot.{suffix}"
    path.write_text(text)
    assert coupled_joints(path) == {"b": "a"}


@pytest.mark.parametrize(
    "logged, right, fixed",
    [
        (["shoulder", "elbow"], MIMIC, "{arm.left: 0, arm.right: 0}"),
        (["shoulder", "elbow"], "", "{arm.left: 0, arm.right: 0}"),
        (["shoulder", "elbow", "left", "right"], MIMIC, "{arm.left: 0.3"),
        (["shoulder", "elbow", "left"], MIMIC.replace('"1"', FOLLOWS), "{arm.left: "),
        # What was seen counts.
        (
            ["shoulder", "elbow", "left", "right"],
            MIMIC.replace('"1"', FOLLOWS),
            "{arm.left: 0.3",
        ),
        (["shoulder", "elbow", "left", "right"], "", None),
        (["elbow", "left", "right"], "", None),  # Where the shoulder is nobody knows.
    ],
    ids=[
        "not logged",
        "no mimic",
        "mimic",
        "one logged",
        "all logged",
        "free",
        "carries others",
    ],
)
def test_a_proposal_fixes_a_grippers_fingers(logged, right, fixed, tmp_path):
    proposal = propose_scene(
        read_robot(robot(tmp_path, right)), [read_log(log(tmp_path, logged))]
    )
    if fixed is None:
        assert "fixed_joints" not in proposal.scene
        assert FIXED not in {f.kind for f in proposal.findings()}
        return
    assert f"fixed_joints: {fixed}" in proposal.scene
    # (The log's efforts are made up, which is said, too.)
    kinds = [f.kind for f in proposal.findings()]
    assert FIXED in kinds and set(kinds) <= {FIXED, "effort_unexplained"}
    (sidecar,) = proposal.sidecars.values()
    assert sidecar.count("taken to stand still") == len({"left", "right"} & {*logged})
    path = tmp_path / "proposed.yaml"
    path.write_text(proposal.scene)
    proposed = read_scene(path)
    if FOLLOWS in right:
        left, follows = (proposed.fixed_joints[f"arm.{j}"] for j in ("left", "right"))
        seen = "right" in logged
        expected, off = (0.3, 0.05) if seen else (0.2 - 0.5 * left, 1e-5)
        assert left > 0.2 and follows == pytest.approx(expected, abs=off)
    assert SceneDynamics(proposed).plant.num_velocities() == 2


def test_coupled_joints_that_carry_others_are_refused(tmp_path):
    beyond = LINK.format(name="tip", mass=0.1) + JOINT.format(
        name="wrist", kind="revolute", parent="r", child="tip", xyz="0.1 0 0",
        axis="0 1 0", mimic="",
    )  # fmt: skip
    path = robot(tmp_path, beyond=beyond)
    with pytest.raises(ValueError, match="arm.right is coupled .* carries arm.wrist"):
        propose_scene(read_robot(path), [read_log(log(tmp_path, ["shoulder"]))])

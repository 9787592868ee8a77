"""The pose of a robot's base in a log: the proposed scene holds it there."""

from pathlib import Path

import numpy as np
import pytest
from front_doors import exact
from scipy.spatial.transform import Rotation

from makebreak.gap.data.base_pose import base_pose
from makebreak.gap.data.robot import BASE_MOVES, Log, propose_scene, read_robot
from makebreak.gap.data.table import RecordingTable
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import read_scene

N = 400
TRUE = Rotation.from_euler("xyz", [25.0, -40.0, 70.0], degrees=True)


def turns(seed=0, noise=2e-3):
    off = np.random.default_rng(seed).normal(0.0, noise, (N, 3))
    return TRUE * Rotation.from_rotvec(off)


def columns(values, names):
    return dict(zip(names, np.asarray(values).T, strict=True))


QUAT = turns().as_quat(scalar_first=True)
ANGLES = turns().as_euler("xyz")


@pytest.mark.parametrize(
    "log",
    [
        columns(QUAT, [f"base_quat_{k}" for k in "wxyz"]),
        columns(QUAT, [f"trunk.q{k}" for k in "wxyz"]),
        columns(QUAT, [f"root_quat[{k}]" for k in range(4)]),
        columns(np.roll(QUAT, -1, 1), [f"/imu/data/orientation/{k}" for k in "xyzw"]),
        columns(np.roll(QUAT, -1, 1), [f"imu_orientation[{k}]" for k in range(4)]),
        columns(np.rad2deg(ANGLES), [f"imu {k} [deg]" for k in ("roll", "pitch",
                                                                "yaw")]),
        columns(ANGLES, ["body_roll", "body_pitch", "body_yaw"]),
    ],
)  # fmt: skip
def test_an_orientation_is_found_whatever_its_names_and_order(log):
    log = {"joint0_pos": np.linspace(0.0, 1.0, N)} | log
    found = base_pose([log], ["trunk"])
    assert found is not None and found.is_still
    # 400 samples of 2 mrad: 0.1 mrad.
    assert (found.rotation.inv() * TRUE).magnitude() < 5e-4


def test_gravitys_direction_tells_all_but_the_heading():
    down = turns().inv().apply([0.0, 0.0, -1.0])
    found = base_pose([columns(down, [f"projected_gravity[{k}]" for k in range(3)])],
                      ["base"])  # fmt: skip
    there = found.rotation.inv().apply([0.0, 0.0, -1.0])
    np.testing.assert_allclose(there, TRUE.inv().apply([0.0, 0.0, -1.0]), atol=1e-3)


@pytest.mark.parametrize(
    "names",
    [
        [f"target_quat_{k}" for k in "wxyz"],
        [f"ball_pose_q{k}" for k in "wxyz"],
        [f"ee_orientation[{k}]" for k in range(4)],
        [f"joint{k}_pos" for k in range(4)],
    ],
)
def test_of_a_command_an_object_or_four_joints_nothing_is_taken(names):
    assert base_pose([columns(QUAT, names)], ["base"]) is None


def two_joints(name: str) -> str:
    """An arm with two joints on a base that nothing holds."""
    inertial = (
        '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" '
        'ixz="0" iyz="0"/></inertial>'
    )
    links = "".join(f'<link name="l{k}">{inertial}</link>' for k in range(3))
    joints = "".join(
        f'<joint name="{name}_{end}" type="revolute"><parent link="l{k}"/>'
        f'<child link="l{k + 1}"/><axis xyz="{axis}"/><origin xyz="0 0 0.3"/>'
        '<limit lower="-2" upper="2" effort="50" velocity="9"/></joint>'
        for k, (end, axis) in enumerate((("Roll", "1 0 0"), ("Pitch", "0 1 0")))
    )
    return f'<robot name="arm">{links}{joints}</robot>'


def proposal(folder: Path, more):
    path, log = exact("three", folder, np.random.default_rng(3))
    table = {"time": log.time[:N], **{k: y[:N] for k, y in log.columns.items()}, **more}
    whole = RecordingTable(table, np.arange(N) + 1, N)
    return propose_scene(read_robot(path), [Log(folder / "log.csv", whole)])


def test_a_robot_that_hangs_is_welded_as_it_hangs(tmp_path):
    more = columns(QUAT, [f"base_quat_{k}" for k in "wxyz"])
    more |= columns(np.tile([0.1, 0.2, 1.3], (N, 1)), [f"base_pos_{k}" for k in "xyz"])
    found = proposal(tmp_path, more)
    (tmp_path / "scene.yaml").write_text(found.scene)
    plant = SceneDynamics(read_scene(tmp_path / "scene.yaml")).plant
    context = plant.CreateDefaultContext()
    pose = plant.GetBodyByName("base").EvalPoseInWorld(context)
    np.testing.assert_allclose(pose.translation(), [0.1, 0.2, 1.3], atol=1e-6)
    np.testing.assert_allclose(pose.rotation().matrix(), TRUE.as_matrix(), atol=1e-3)
    assert not found.said
    assert found.notes[0].startswith("base is welded to the world at the pose")
    (sidecar,) = found.sidecars.values()
    assert "base_quat_w: null" in sidecar


def test_a_joint_whose_name_ends_in_roll_is_no_base(tmp_path):
    (tmp_path / "arm.urdf").write_text(two_joints("Left_Shoulder"))
    swing = {"time": 0.01 * np.arange(N)}
    for k, end in enumerate(("Roll", "Pitch")):
        swing[f"log/q/Left_Shoulder_{end}"] = 0.4 * np.sin(
            0.03 * (k + 1) * np.arange(N)
        )
    whole = RecordingTable(swing, np.arange(N) + 1, N)
    robot = read_robot(tmp_path / "arm.urdf")
    found = propose_scene(robot, [Log(tmp_path / "log.csv", whole)])
    assert not found.without and not found.said
    (sidecar,) = found.sidecars.values()
    assert "arm.Left_Shoulder_Roll.position" in sidecar


def test_a_base_that_moves_is_an_error_and_one_that_is_not_told_is_said(tmp_path):
    t = np.linspace(0.0, 2.0 * np.pi, N)
    sway = Rotation.from_rotvec(np.stack([0.3 * np.sin(2 * t), 0 * t, 0 * t], axis=1))
    moved = (sway * TRUE).as_quat(scalar_first=True)
    found = proposal(tmp_path, columns(moved, [f"base_quat_{k}" for k in "wxyz"]))
    (error,) = [f for f in found.findings() if f.severity == "error"]
    assert error.kind == BASE_MOVES and "moves by 17 deg" in error.says
    level = proposal(tmp_path, {})
    assert "level, as no column has its pose" in level.notes[0]
    assert not level.findings()


@pytest.mark.parametrize(
    ("names", "known"),
    [
        ([f"base_pos_{k}" for k in "xyz"], True),
        ([f"base_position[{k}]" for k in range(3)], True),
        ([f"torso_{k}" for k in "xyz"], True),  # The body's own name.
        ([f"imu_{k}" for k in "xyz"], False),  # Of what?
        ([f"base_lin_vel_{k}" for k in "xyz"], False),
        ([f"object_pos_{k}" for k in "xyz"], False),
    ],
)
def test_where_a_base_is_is_read_of_a_place_alone(names, known):
    n, place = 50, (0.1, -0.2, 0.9)
    log = {f"torso_quat_{k}": np.full(n, float(k == "w")) for k in "wxyz"}
    log |= {name: np.full(n, x) for name, x in zip(names, place, strict=True)}
    found = base_pose([log], ["torso"])
    assert found is not None and found.is_still
    assert found.position == pytest.approx(place if known else (0.0, 0.0, 0.0))
    assert set(names) <= set(found.columns) if known else len(found.columns) == 4

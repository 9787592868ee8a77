"""A wrench that holds the weight of its tool: found, told from a bias, taken off."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_gap_pressing import MASS, record, write_scene

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.residuals.tool_weight import as_used, check_tool_weight
from makebreak.gap.workflow import run_gap
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import read_scene

G = np.array([0.0, 0.0, -9.81])
TOOL, COM = 0.5, np.array([0.01, 0.0, 0.08])  # [kg], [m] in the tool's frame.
WEIGHT = TOOL * G
MODEL = """<?xml version="1.0"?>
<sdf version="1.9"><model name="arm"><link name="base"/>
<link name="upper">{inertia}</link>
<link name="wrist"><pose>0 0 0.4 0 0 0</pose>{inertia}</link>
<link name="tool"><pose>0 0 0.5 0.3 0 0</pose><inertial>
<pose>0.01 0 0.05 0 0 0</pose><mass>0.3</mass><inertia><ixx>1e-3</ixx><iyy>1e-3</iyy>
<izz>1e-3</izz></inertia></inertial></link>
<link name="finger"><pose>0 0 0.5 0.3 0 0</pose><inertial>
<pose>0.01 0 0.125 0 0 0</pose><mass>0.2</mass><inertia><ixx>1e-3</ixx><iyy>1e-3</iyy>
<izz>1e-3</izz></inertia></inertial></link>
<joint name="swing" type="revolute"><parent>base</parent><child>upper</child>
<axis><xyz>1 0 0</xyz></axis></joint>
<joint name="turn" type="revolute"><parent>upper</parent><child>wrist</child>
<axis><xyz>0 1 0</xyz></axis></joint>
<joint name="mount" type="fixed"><parent>wrist</parent><child>tool</child></joint>
<joint name="glue" type="fixed"><parent>tool</parent><child>finger</child></joint>
</model></sdf>"""
INERTIA = """<inertial><mass>1</mass><inertia><ixx>0.01</ixx><iyy>0.01</iyy>
<izz>0.01</izz></inertia></inertial>"""
SCENE = """directives:
  - add_model: {name: arm, file: arm.sdf}
  - add_weld: {parent: world, child: arm::base}
"""
FORCES = ("fx", "fy", "fz")


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """An arm with a force sensor at its tool, which two bodies make up."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.sdf").write_text(MODEL.format(inertia=INERTIA))
    (folder / "scene.yaml").write_text(SCENE)
    return SceneDynamics(read_scene(folder / "scene.yaml"))


def motion(seed, reach):
    """t (n,), positions (n, 2), the sensor's axes in world (n, 3, 3)."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 20.0, 0.01)
    w, phase = rng.uniform(1.0, 3.0, 2), rng.uniform(0.0, 6.0, 2)
    q = reach * np.sin(np.outer(t, w) + phase)
    # The sensor is mounted askew.
    R = Rotation.from_euler("XY", q) * Rotation.from_euler("X", 0.3)
    return t, q, R.as_matrix()


def log(path, t, q, force, seed=0, noise=0.05, moment=None, sidecar=""):
    rng = np.random.default_rng(seed)
    columns = {"time": t, "arm.swing.position": q[:, 0], "arm.turn.position": q[:, 1]}
    for k, name in enumerate(FORCES):
        columns[f"arm.tool.{name}"] = force[:, k] + noise * rng.normal(size=len(t))
        if moment is not None:
            columns[f"arm.tool.t{name[1]}"] = moment[:, k]
    write_recording(path / "log.csv", columns)
    (path / "log.yaml").write_text(sidecar)
    return read_recordings([path / "log.csv"])


def own(R, vector):
    """(n, 3) a world's vector in the sensor's axes."""
    return R.transpose(0, 2, 1) @ vector


def shaken(t, seed):
    """(n, 3) what a tool's own motion adds."""
    rng = np.random.default_rng(seed)
    w, phase = rng.uniform(2.0, 9.0, 3), rng.uniform(0.0, 6.0, 3)
    return 0.5 * np.sin(np.outer(t, w) + phase)


@pytest.mark.parametrize("reach", [0.0, 0.05, 0.3, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_a_wrench_without_the_weight_raises_no_finding(arm, tmp_path, reach, seed):
    t, q, R = motion(seed, reach)
    for bias in (np.zeros(3), np.array([0.5, -0.3, 1.0])):
        found = log(tmp_path, t, q, shaken(t, seed) + bias, seed)
        assert check_tool_weight(arm, found) == []


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("seed", range(4))
def test_the_weight_is_found_whatever_the_wrist_does(arm, tmp_path, sign, seed):
    """In world, and in the axes of the sensor; on the robot and on the environment."""
    t, q, R = motion(seed, 0.6)
    more = shaken(t, seed)
    for force, line in (
        (sign * (WEIGHT + more), "{holds_weight: true"),
        (sign * (own(R, WEIGHT) + more), "{holds_weight: true, axes: sensor"),
    ):
        (finding,) = check_tool_weight(arm, log(tmp_path, t, q, force, seed))
        assert finding.kind == "tool_weight" and finding.severity == "warning"
        assert finding.size == pytest.approx(sign, abs=0.05)
        line += ", acts_on: environment}" if sign < 0 else "}"
        assert f"in log.yaml: `wrench: {{arm.tool: {line}}}`" in finding.says


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (0.6, 0, 0.8)])
@pytest.mark.parametrize("reach", [0.3, 0.6, 1.2])
def test_a_bias_as_large_as_the_weight_is_none_where_the_wrist_turns(
    arm, tmp_path, direction, reach
):
    t, q, R = motion(1, reach)
    bias = TOOL * 9.81 * np.array(direction)
    assert check_tool_weight(arm, log(tmp_path, t, q, R @ bias)) == []


def test_a_bias_in_the_sensors_axes_is_none_unless_it_is_as_the_weight_in_world(
    arm, tmp_path
):
    """Then nothing tells them apart, and the sentence says so."""
    t, q, R = motion(2, 0.6)
    for bias in ([4.9, 0, 0], [0, 3.5, -3.5]):
        force = np.tile(bias, (len(t), 1))
        assert check_tool_weight(arm, log(tmp_path, t, q, force)) == []
    force = np.tile(WEIGHT, (len(t), 1))
    (finding,) = check_tool_weight(arm, log(tmp_path, t, q, force))
    assert "in the axes of the sensor, which turns, this would be a bias" in (
        finding.says
    )


def test_where_the_wrist_does_not_turn_a_bias_would_look_the_same(arm, tmp_path):
    t, q, R = motion(0, 0.02)
    (finding,) = check_tool_weight(
        arm, log(tmp_path, t, q, WEIGHT + [0.2, -0.3, 0.0] + shaken(t, 0))
    )
    assert "does not turn, so a bias of it would look the same" in finding.says
    # Neither along gravity, nor of its size.
    for force in ([4.9, 0, 0], [0, 3.5, -3.5], [0, 0, -2.0], [0, 0, 11.0]):
        force = force + shaken(t, 0)
        assert check_tool_weight(arm, log(tmp_path, t, q, force)) == []


def test_a_tool_that_points_down_may_be_read_in_two_ways(arm, tmp_path):
    t, q, R = motion(0, 0.02)
    q = q + np.array([np.pi - 0.3, 0.0])
    (finding,) = check_tool_weight(arm, log(tmp_path, t, q, 0.0 * R[:, 0] - WEIGHT))
    assert "{holds_weight: true, axes: sensor}}`, or, if that is how" in finding.says
    assert "{holds_weight: true, acts_on: environment}}`" in finding.says


@pytest.mark.parametrize("share", [0.3, 0.7, 1.4])
def test_a_payload_that_the_scene_lacks_is_no_tool(arm, tmp_path, share):
    """A small one is a payload; of another, it is said that it may be one."""
    t, q, R = motion(3, 0.6)
    found = check_tool_weight(arm, log(tmp_path, t, q, share * WEIGHT + shaken(t, 3)))
    if share < 0.5:
        assert found == []
    else:
        assert "or it is a payload that the scene lacks" in found[0].says


def test_a_sensor_that_was_zeroed_with_its_tool_on_holds_the_weight(arm, tmp_path):
    t, q, R = motion(4, 0.6)
    force = own(R, WEIGHT)
    (finding,) = check_tool_weight(arm, log(tmp_path, t, q, force - force[0]))
    assert "axes: sensor" in finding.says and "in its own axes" in finding.says
    said = finding.says.split("a bias of (")[1].split(")")[0]
    told = [float(x) for x in said.split(",")]
    np.testing.assert_allclose(told, -force[0], atol=0.02)


@pytest.mark.parametrize("axes", ["world", "sensor"])
@pytest.mark.parametrize("acts_on", ["robot", "environment"])
def test_a_declared_wrench_is_used_on_the_robot_in_world_without_the_weight(
    arm, tmp_path, axes, acts_on
):
    t, q, R = motion(5, 0.8)
    rng = np.random.default_rng(5)
    force, moment = 5.0 * rng.normal(size=(2, len(t), 3))
    raw = [force + WEIGHT, moment + np.cross(R @ COM, WEIGHT)]
    if axes == "sensor":
        raw = [np.einsum("nji,nj->ni", R, y) for y in raw]
    if acts_on == "environment":
        raw = [-y for y in raw]
    said = f"{{holds_weight: true, axes: {axes}, acts_on: {acts_on}}}"
    found = log(
        tmp_path, t, q, raw[0], noise=0.0, moment=raw[1],
        sidecar=f"wrench: {{arm.tool: {said}}}",
    )  # fmt: skip
    (used,) = as_used(found, arm)
    for wanted, letter in ((force, "f"), (moment, "t")):
        got = used.stack("arm.tool", [f"{letter}{a}" for a in "xyz"])
        np.testing.assert_allclose(got, wanted, atol=1e-6)  # As a csv has them.
    # Once alone.
    assert as_used([used], arm)[0] is used


def test_noise_of_axes_that_turn_is_told_anew(arm, tmp_path):
    t, q, R = motion(6, 0.8)
    found = log(
        tmp_path, t, q, own(R, WEIGHT),
        sidecar="wrench: {arm.tool: {holds_weight: true, axes: sensor}}",
    )  # fmt: skip
    (used,) = as_used(found, arm)
    for name in FORCES:
        assert used.channels[f"arm.tool.{name}"].noise == pytest.approx(0.05, rel=0.2)
    assert check_tool_weight(arm, [used]) == []


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ("{arm.tool: raw}", "got 'raw', expected {holds_weight: true"),
        ("{arm.tool: {weight: true}}", "expected {holds_weight: true"),
        ("{arm.tool: {holds_weight: 3}}", "holds_weight is 3, expected false or true"),
        ("{arm.tool: {axes: tool}}", "axes is 'tool', expected world or sensor"),
        ("{arm.flange: {axes: sensor}}", "wrench of arm.flange: expected a frame"),
        ("[arm.tool]", "wrench must be names with values"),
    ],
)  # fmt: skip
def test_what_a_sidecar_cannot_mean_is_refused(arm, tmp_path, said, message):
    t, q, R = motion(0, 0.5)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        as_used(log(tmp_path, t, q, own(R, WEIGHT), sidecar=f"wrench: {said}"), arm)
    assert "\n" not in str(error.value)


def test_a_sensor_whose_wrist_is_not_measured_cannot_be_turned(arm, tmp_path):
    t, q, R = motion(0, 0.5)
    (one,) = log(
        tmp_path, t, q, own(R, WEIGHT),
        sidecar="wrench: {arm.tool: {holds_weight: true, axes: sensor}}",
    )  # fmt: skip
    channels = {k: v for k, v in one.channels.items() if k != "arm.turn.position"}
    blind = replace(one, channels=channels)
    with pytest.raises(ValueError, match="lacks a position or pose that tells how"):
        as_used([blind], arm)
    assert check_tool_weight(arm, [replace(blind, wrenches={})]) == []


@pytest.mark.slow
def test_what_presses_half_of_the_time_is_weighed_while_it_does_not(tmp_path):
    """A gantry that presses its tool on a table and a wall, with 8 N, of a tool of
    20 N: the log says at once what is wrong, and what that line changes is right."""
    write_scene(tmp_path)
    (right,) = record(tmp_path, waits=2.0, leaves=5.0)
    scene, raw = tmp_path / "scene.yaml", tmp_path / "raw.csv"
    dynamics = SceneDynamics(read_scene(scene))
    assert check_tool_weight(dynamics, [right]) == []
    columns = {"time": right.time} | {n: c.values for n, c in right.channels.items()}
    columns["gantry.tip.fz"] = columns["gantry.tip.fz"] - 9.81 * MASS
    write_recording(raw, columns)
    result = run_gap(scene, [raw])
    assert result.verdict == "gap_unnamed"
    assert "it holds the weight of its tool" in result.says
    line = result.says.split("`")[1]
    assert line == "wrench: {gantry.tip: {holds_weight: true}}"
    raw.with_suffix(".yaml").write_text(line)
    after = run_gap(scene, [raw])
    assert after.verdict == "no_gap"
    assert [c for c in after.checks if c.kind == "tool_weight"] == []

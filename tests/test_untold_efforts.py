"""A joint that moves and whose effort no column tells: not zero, but unknown."""

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

from makebreak.gap import run_gap
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.robot import propose_scene, read_log, read_robot
from makebreak.gap.data.table import write_recording
from makebreak.gap.residuals.inverse import InverseModel
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import read_scene

URDF = """<robot name="arm"><link name="base"/>
<link name="l1"><inertial><origin xyz="0 0 -0.2"/><mass value="2"/>
<inertia ixx="0.02" iyy="0.02" izz="2e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="l2"><inertial><origin xyz="0 0 -0.15"/><mass value="1"/>
<inertia ixx="8e-3" iyy="8e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j1" type="continuous"><parent link="base"/><child link="l1"/>
<axis xyz="0 1 0"/></joint>
<joint name="j2" type="continuous"><parent link="l1"/><child link="l2"/>
<origin xyz="0 0 -0.4"/><axis xyz="0 1 0"/></joint></robot>"""
T = np.arange(0.0, 16.0, 0.01)


def plant_of():
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(URDF, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    return plant


def swings():
    """q, v, vd (n, 2): two sines a joint."""
    waves = [((0.37, 0.8), (0.83, 0.4)), ((0.51, 0.7), (1.1, 0.3))]
    q, v, vd = np.zeros((3, len(T), 2))
    for i, of in enumerate(waves):
        for hertz, size in of:
            w = 2.0 * np.pi * hertz
            q[:, i] += size * np.sin(w * T)
            v[:, i] += size * w * np.cos(w * T)
            vd[:, i] -= size * w**2 * np.sin(w * T)
    return q, v, vd


def recorded(folder, q, v, effort):
    """A scene and a log, with noise, of efforts {joint number: (n,)}."""
    rng = np.random.default_rng(0)
    (folder / "arm.urdf").write_text(URDF)
    columns = {"time": T}
    for i in range(2):
        columns[f"arm.j{i + 1}.position"] = q[:, i] + rng.normal(0.0, 2e-5, len(T))
        columns[f"arm.j{i + 1}.velocity"] = v[:, i] + rng.normal(0.0, 2e-3, len(T))
    for i, u in effort.items():
        columns[f"arm.j{i + 1}.effort_measured"] = u + rng.normal(0.0, 0.02, len(T))
    write_recording(folder / "log.csv", columns)


def proposed(folder):
    log = read_log(folder / "log.csv")
    proposal = propose_scene(read_robot(folder / "arm.urdf"), [log])
    (folder / "scene.yaml").write_text(proposal.scene)
    return read_scene(folder / "scene.yaml")


@pytest.mark.parametrize("friction", [0.0, pytest.param(0.3, marks=pytest.mark.slow)])
def test_the_other_joints_are_judged_without_the_effort_that_is_missing(
    tmp_path, friction
):
    q, v, vd = swings()
    (tmp_path / "arm.urdf").write_text(URDF)
    recorded(tmp_path, q, v, {0: 0.0 * T})
    effort = SceneDynamics(proposed(tmp_path)).inverse_dynamics(q, v, vd)
    recorded(tmp_path, q, v, {0: effort[:, 0] + friction * np.sign(v[:, 0])})
    assert proposed(tmp_path).actuation.joints == ["arm.j1", "arm.j2"]
    result = run_gap(tmp_path / "scene.yaml", [tmp_path / "log.csv"])
    (check,) = [c for c in result.checks if c.kind == "untold_effort"]
    assert check.channel == "arm.j2" and "moves as measured" in check.says
    judged = {c.channel: c.judged for c in result.channels}
    assert judged["arm.j2.position"] == "not" != judged["arm.j1.position"]
    if not friction:
        assert (result.verdict, list(result.effects)) == ("not_judged", [])
        return
    (effect,) = result.effects
    assert (effect.kind, effect.at) == ("joint_coulomb_friction", ("arm.j1",))
    # Noise of the effort over 1600 rows is 1e-3 of it; signs of v near 0 add to that.
    np.testing.assert_allclose(effect.parameters["coulomb"].value, friction, rtol=0.03)


def test_a_joint_that_nothing_drives_is_left_passive(tmp_path):
    """A double pendulum whose first joint is moved by a slow torque."""
    plant = plant_of()
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    plant.SetPositions(context, [1.0, -0.5])
    port = plant.get_applied_generalized_force_input_port()
    q, v = np.empty((2, len(T), 2))
    torque = 1.5 * np.sin(1.3 * T)
    for k, t in enumerate(T):
        simulator.AdvanceTo(t)
        q[k], v[k] = plant.GetPositions(context), plant.GetVelocities(context)
        port.FixValue(context, [torque[k], 0.0])
    recorded(tmp_path, q, v, {0: torque})
    assert proposed(tmp_path).actuation.joints == ["arm.j1"]


def test_an_equation_whose_effort_is_not_told_says_nothing_of_others_neither(tmp_path):
    """The first joint's rows are 0; the second one's are what it leaves over its own
    noise, although both have the noise of the same accelerations."""
    q, v, vd = swings()
    (tmp_path / "arm.urdf").write_text(URDF)
    recorded(tmp_path, q, v, {1: 0.0 * T})
    effort = SceneDynamics(proposed(tmp_path)).inverse_dynamics(q, v, vd)
    recorded(tmp_path, q, v, {1: effort[:, 1] + 0.3 * np.sign(v[:, 1])})
    scene = proposed(tmp_path)
    assert scene.actuation.joints == ["arm.j1", "arm.j2"]
    model = InverseModel(scene, read_recordings([tmp_path / "log.csv"]))
    assert model.names()[:2] == [("effort", "arm.j1"), ("effort", "arm.j2")]
    first, second = model.base().reshape(-1, len(model.names())).T[:2]
    assert not first.any()
    left = model.in_units(model.base())[:, 1]
    assert np.abs(left).max() > 0.2  # [N m], the friction.
    np.testing.assert_allclose(second, left / model.noise_in_units()[:, 1], rtol=1e-9)

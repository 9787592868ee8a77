"""From an arm's URDF and a log in degrees to what the URDF lacks.

python examples/gap_of_an_arm.py [FOLDER]: scene, log and report are in FOLDER.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import pydrake.all as drake

from makebreak.gap import run_gap, write_report
from makebreak.models.scene import read_scene

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
folder.mkdir(parents=True, exist_ok=True)
arm = '<robot name="arm"><link name="base"/>'
for parent, joint, link, z in ("base", "j1", "upper", 0), ("upper", "j2", "fore", -0.3):
    arm += f"""<link name="{link}"><inertial><origin xyz="0 0 -.15"/><mass value="1"/>
    <inertia ixx=".01" iyy=".01" izz=".002" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 -.15"/><geometry><cylinder radius=".03" length=".3"/>
    </geometry></visual></link>
    <joint name="{joint}" type="continuous"><parent link="{parent}"/><axis xyz="0 1 0"/>
    <child link="{link}"/><origin xyz="0 0 {z}"/></joint>"""
(folder / "arm.urdf").write_text(arm + "</robot>")
scene = "directives: [add_model: {name: arm, file: arm.urdf}, "
scene += "add_weld: {parent: world, child: arm::base}]\n"
scene += "actuation: {type: effort, joints: [arm.j1, arm.j2]}\n"
(folder / "scene.yaml").write_text(scene)
degrees = [
    f"q{k}: {{channel: arm.j{k}.position, scale: {np.pi / 180}}}" for k in (1, 2)
]
(folder / "log.yaml").write_text("columns:\n  " + "\n  ".join(degrees))

# Instead of your robot: one with 0.2 N m of friction in its second joint.
plant, rng = drake.MultibodyPlant(0.0), np.random.default_rng(0)
drake.Parser(plant).AddModels(str(folder / "arm.urdf"))
plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
plant.Finalize()
goals, smooth = rng.uniform(-1, 1, (2, 30)), drake.PiecewisePolynomial
path = smooth.CubicWithContinuousSecondDerivatives(np.linspace(0, 15, 30), goals)
context, rows = plant.CreateDefaultContext(), []
for t in np.arange(0.0, 15.0, 0.01):
    q, v, a = (path.EvalDerivative(t, k).ravel() for k in range(3))
    plant.SetPositionsAndVelocities(context, [*q, *v])
    plant.CalcForceElementsContribution(context, g := drake.MultibodyForces(plant))
    tau = plant.CalcInverseDynamics(context, a, g) + [0, 0.2 * np.sign(v[1])]
    seen = [*np.degrees(q), *tau] + rng.normal(size=4) * [0.005, 0.005, 0.01, 0.01]
    rows.append([t, *seen])
header = "time,q1,q2,arm.j1.effort_measured,arm.j2.effort_measured"
np.savetxt(folder / "log.csv", rows, delimiter=",", header=header, comments="")

result = run_gap(folder / "scene.yaml", [folder / "log.csv"])
print(*(each.says for each in result.effects))
write_report(result, read_scene(folder / "scene.yaml"), folder / "report")
print("Its report:", folder / "report" / "report.html")

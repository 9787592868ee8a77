"""From a camera's poses of a thrown ball to the friction that the scene has wrong."""

import tempfile
from pathlib import Path

import numpy as np
import pydrake.all as drake

from makebreak import model_path
from makebreak.gap import run_gap
from makebreak.models.scene import apply_initial_velocities, load_scene

scene = f"""directives:
  - add_model: {{name: table, file: {model_path("table.sdf")}}}
  - add_weld: {{parent: world, child: table::table}}
  - add_model: {{name: ball, file: {model_path("ball.sdf")}}}
plant: {{time_step: 0.00005, contact_model: point}}
initial:
  poses: {{ball.ball: [1, 0, 0, 0, 0.4, 0, 0.08]}}
  body_velocities: {{ball.ball: [0, 3, 0, SPEED, 0, 0]}}
"""
folder, rows, rng = Path(tempfile.mkdtemp()), [], np.random.default_rng(0)
file = folder / "scene.yaml"
file.write_text(scene.replace("SPEED", "0"))
# Instead of your camera: ten throws on a table that is smoother than the scene's.
truth = "effects: [{kind: contact_friction, at: ball~table, "
truth += "parameters: {friction: 0.12}}]"
for episode, speed in enumerate(rng.uniform(0.5, 1.5, 10)):
    (folder / "world.yaml").write_text(scene.replace("SPEED", str(speed)) + truth)
    world = load_scene(folder / "world.yaml", builder := drake.DiagramBuilder())
    simulator = drake.Simulator(builder.Build())
    apply_initial_velocities(simulator.get_system(), simulator.get_mutable_context())
    context = world.plant.GetMyContextFromRoot(simulator.get_context())
    for t in np.arange(0.0, 0.5, 1 / 120):
        simulator.AdvanceTo(t)
        seen = world.plant.GetPositions(context) + 5e-4 * rng.normal(size=7)
        rows.append([t, episode, *seen])
pose = [f"ball.ball.{k}" for k in ("qw", "qx", "qy", "qz", "x", "y", "z")]
header = ",".join(["time", "episode", *pose])
np.savetxt(folder / "log.csv", rows, delimiter=",", header=header, comments="")


result = run_gap(file, [folder / "log.csv"])

print(*(each.says for each in result.effects))

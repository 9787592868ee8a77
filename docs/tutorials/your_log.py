"""
Your robot, Monday's log, Friday's check
========================================

You have a robot, its URDF, and a log. ``makebreak gap`` says what the URDF lacks.
Later, a second log shows whether the robot is still the same. The lines that begin
with ``makebreak`` are what you would type in a terminal.
"""

# %%
# The robot
# ---------
#
# Here it is a simulated arm with two joints, so that you can run this page as it is.
# With your own robot, skip this part: take your URDF and your logs. The URDF below
# knows of no friction. The "real" arm has 0.3 N m of Coulomb friction in its second
# joint.

import contextlib
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pydrake.all as drake

folder = Path(tempfile.mkdtemp())
link = """
  <link name="{0}">
    <inertial><origin xyz="0 0 -0.15"/><mass value="{1}"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 -0.15"/>
      <geometry><cylinder radius="0.03" length="0.3"/></geometry></visual>
  </link>
  <joint name="{2}" type="continuous"><parent link="{3}"/><child link="{0}"/>
    <origin xyz="0 0 {4}"/><axis xyz="0 1 0"/></joint>"""
urdf = '<robot name="arm"><link name="base"/>'
urdf += link.format("upper", 1.5, "shoulder", "base", 0.0)
urdf += link.format("fore", 1.0, "elbow", "upper", -0.3) + "</robot>"
(folder / "arm.urdf").write_text(urdf)


def record(name, friction, load, seed):
    """Writes a log of 20 s: times, angles in degrees, torques, each with its noise."""
    plant, rng = drake.MultibodyPlant(0.0), np.random.default_rng(seed)
    drake.Parser(plant).AddModels(str(folder / "arm.urdf"))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    inertia = drake.SpatialInertia.SolidSphereWithMass(load, 0.03)
    hand = plant.AddRigidBody("hand", drake.default_model_instance(), inertia)
    at = drake.RigidTransform([0.0, 0.0, -0.3])
    plant.WeldFrames(plant.GetFrameByName("fore"), hand.body_frame(), at)
    plant.Finalize()
    goals, knots = rng.uniform(-1.0, 1.0, (2, 40)), np.linspace(0.0, 20.0, 40)
    path = drake.PiecewisePolynomial.CubicWithContinuousSecondDerivatives(knots, goals)
    context, rows = plant.CreateDefaultContext(), []
    for t in np.arange(0.0, 20.0, 0.01):
        q, v, a = (path.EvalDerivative(t, k).ravel() for k in range(3))
        plant.SetPositionsAndVelocities(context, [*q, *v])
        gravity = drake.MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, gravity)
        torque = plant.CalcInverseDynamics(context, a, gravity)
        torque += [0.0, friction * np.sign(v[1])]
        noise = rng.normal(size=4) * [0.005, 0.005, 0.01, 0.01]
        rows.append([t, *(np.array([*np.degrees(q), *torque]) + noise)])
    head = "time,shoulder_deg,elbow_deg,shoulder_torque,elbow_torque"
    np.savetxt(folder / name, rows, "%.5f", ",", header=head, comments="")
    return np.array(rows)


record("monday.csv", friction=0.3, load=1e-6, seed=1)


def terminal(command):
    """Runs a command of makebreak, and shows what it prints in a terminal."""
    words = [sys.executable, "-m", *shlex.split(command)]
    wide = os.environ | {"COLUMNS": "96"}  # As wide as this page.
    reader, writer = os.openpty()
    run = subprocess.Popen(words, cwd=folder, env=wide, stdout=writer, stderr=-1)
    os.close(writer)
    printed = b""
    with contextlib.suppress(OSError):  # The terminal is closed: all is printed.
        while more := os.read(reader, 4096):
            printed += more
    os.close(reader)
    errors = run.communicate()[1].decode()
    assert run.returncode == 0, errors
    print(printed.decode().replace("\r\n", "\n"))


# %%
# Is the log good enough?
# -----------------------
#
# ``inspect`` says what each column seems to be, and what is wrong with the data.

terminal("makebreak inspect monday.csv --robot arm.urdf")

# %%
# What does the model lack?
# -------------------------
#
# ``gap`` simulates the URDF beside the log, tries the effects of its catalogue, and
# keeps those that data confirm which it has not fitted.

terminal("makebreak gap arm.urdf monday.csv --out monday")

# %%
# The friction is named, with its interval. Open ``monday/report.html``: how much of
# the error is explained, what fits nearly as well, how certain each number is.
# ``monday/scene.yaml`` is the repaired model, and ``--export urdf,sdf,mjcf,isaaclab``
# writes it for other simulators. ``monday/proposed_scene.yaml`` and
# ``monday/monday.yaml`` say what ``gap`` assumed about the robot and the columns.
# Where that is wrong, correct it, and run ``gap`` on the corrected files.

print((folder / "monday" / "scene.yaml").read_text())

# %%
# Friday's check
# --------------
#
# On Friday the robot gets another log, of another motion. Is it still the robot of
# Monday? ``judge`` simulates both models beside the new log, to which neither was
# fitted.

record("friday.csv", friction=0.3, load=1e-6, seed=2)
terminal("makebreak judge monday/proposed_scene.yaml monday/scene.yaml --on friday.csv")

# %%
# And ``gap``, with the repaired model, finds nothing more to add:

terminal("makebreak gap monday/scene.yaml friday.csv --out friday")

# %%
# Had somebody left a tool of 250 g in the gripper, it would say so:

record("later.csv", friction=0.3, load=0.25, seed=3)
terminal("makebreak gap monday/scene.yaml later.csv --out later")

# %%
# The load is named with its mass and its place, 0.3 m below the elbow, where the
# gripper is. ``later/compare.html`` is an animation of what was measured beside both
# models.

"""A 6-joint arm as a spring and damper at its tip moves it by 5 cm along x."""

import numpy as np
import pydrake.all as drake

from makebreak import ImpedanceConfig, ImpedanceController

rod = drake.SpatialInertia.SolidCylinderWithMassAboutEnd(1.0, 0.05, 0.2, [0, 0, 1])
arms = []
for time_step in (0.0, 0.001):  # The controller's arm, and the world's.
    plant, _ = drake.AddMultibodyPlantSceneGraph(
        builder := drake.DiagramBuilder(), time_step
    )
    X, end = drake.RigidTransform(), plant.world_frame()
    for i, angle in enumerate([0.3, 0.6, 0.9, 0.2, 0.7, 0.1]):
        base = plant.AddFrame(drake.FixedOffsetFrame(f"base{i}", end, X))
        link = plant.AddRigidBody(f"link{i}", rod).body_frame()
        axis = np.eye(3)[[2, 1, 1, 2, 1, 2][i]]
        joint = plant.AddJoint(drake.RevoluteJoint(f"joint{i}", base, link, axis))
        joint.set_default_angle(angle)
        plant.AddJointActuator(f"motor{i}", joint, effort_limit=80.0)
        X, end = drake.RigidTransform([0, 0, 0.2]), link
    tip = plant.AddFrame(drake.FixedOffsetFrame("tip", end, X))
    plant.Finalize()
    arms.append(plant)
config = ImpedanceConfig([200] * 3 + [5] * 3, [20] * 3 + [0.2] * 3)  # Position alone.
arm = builder.AddSystem(ImpedanceController(config, arms[0]))
X_0 = tip.CalcPoseInWorld(plant.CreateDefaultContext())
pose = [*(X_0.translation() + [0.05, 0, 0]), *X_0.rotation().ToQuaternion().wxyz()]
goal = builder.AddSystem(drake.ConstantVectorSource(np.array([*pose, *[0] * 12])))
split = builder.AddSystem(drake.Demultiplexer([6, 6]))
builder.Connect(goal.get_output_port(), arm.GetInputPort("x_desired"))
builder.Connect(plant.get_state_output_port(), split.get_input_port())
builder.Connect(split.get_output_port(0), arm.GetInputPort("q"))
builder.Connect(split.get_output_port(1), arm.GetInputPort("v"))
builder.Connect(arm.GetOutputPort("tau"), plant.get_actuation_input_port())
simulator = drake.Simulator(builder.Build())
simulator.AdvanceTo(3.0)
X = tip.CalcPoseInWorld(plant.GetMyContextFromRoot(simulator.get_context()))
print("tip moved by", (1e3 * (X.translation() - X_0.translation())).round(1), "mm")

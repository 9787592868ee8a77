"""Any scene as a diagram that runs."""

from collections.abc import Callable
from pathlib import Path

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Demultiplexer, LogVectorOutput

from makebreak.models.effects.kind import full_name, is_added, one_dof_joints
from makebreak.models.scene import (
    LoadedScene,
    Scene,
    actuators_of_model,
    load_scene,
)

STATE_LOG = "state_log"


def make_scene_diagram(
    scene: Scene | str | Path,
    command_delays: bool = True,
    log: bool = False,
    before_finalize: Callable[[MultibodyPlant, SceneGraph], None] | None = None,
) -> tuple[Diagram, LoadedScene]:
    """The scene's plant, effects, actuation and sensors, for each model <m> that has
    actuators or joints.

    Inputs:  <m>.effort_command (n_u,) [N m]; or where the scene's drives have a loop of
             their own, <m>.position_command, <m>.velocity_command (n_u,), as they take
             them. What is not connected is zero.
    Outputs: <m>.position_measured, <m>.velocity_measured (joints with one degree of
             freedom, in the order of LoadedScene.plant's), without noise; <m>.effort,
             the motors' (n_u,), where something lies between command and joint;
             state (n_x,), body_poses, contact_results: the truth.

    Args: command_delays: False if the caller delays the commands itself;
        log: with a log of the state each step, for a discrete plant;
        before_finalize: as of load_scene.
    """
    builder = DiagramBuilder()
    loaded = load_scene(scene, builder, command_delays, before_finalize)
    plant = loaded.plant
    builder.ExportOutput(plant.get_state_output_port(), "state")
    builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
    builder.ExportOutput(plant.get_contact_results_output_port(), "contact_results")
    for i in range(plant.num_model_instances()):
        instance = ModelInstanceIndex(i)
        model = plant.GetModelInstanceName(instance)
        if is_added(model):
            continue
        _export_actuation(builder, loaded, model)
        _export_joints(builder, loaded, instance)
    if log and plant.time_step() > 0.0:
        sink = LogVectorOutput(
            plant.get_state_output_port(), builder, plant.time_step()
        )
        sink.set_name(STATE_LOG)
    diagram = builder.Build()
    diagram.set_name("scene")
    return diagram, loaded


def _export_actuation(builder: DiagramBuilder, loaded: LoadedScene, model: str) -> None:
    """A model's commands, and what its motors make of them."""
    path = loaded.paths.get(model)
    if actuators_of_model(loaded.plant, model):
        if path is None or path.command is not None:
            port = loaded.command_input_port(model)
            builder.ExportInput(port, f"{model}.effort_command")
        else:
            for name in ("position_command", "velocity_command"):
                if (port := getattr(path, name)) is not None:
                    builder.ExportInput(port, f"{model}.{name}")
    if path is not None:
        builder.ExportOutput(path.effort, f"{model}.effort")


def _export_joints(
    builder: DiagramBuilder, loaded: LoadedScene, instance: ModelInstanceIndex
) -> None:
    """Measured positions and velocities of a model's joints, where these are all that
    its state consists of."""
    plant = loaded.plant
    model = plant.GetModelInstanceName(instance)
    joints = one_dof_joints(plant, model)
    n = plant.num_positions(instance)
    if not joints or n != len(joints) or n != plant.num_velocities(instance):
        return
    joints = sorted(joints, key=lambda joint: joint.position_start())
    names = [full_name(plant, joint) for joint in joints]
    state = plant.get_state_output_port(instance)
    channels = [f"{name}.{w}" for w in ("position", "velocity") for name in names]
    port = loaded.measured_output_port(builder, state, channels)
    split = builder.AddSystem(Demultiplexer([n, n]))
    builder.Connect(port, split.get_input_port())
    for k, what in enumerate(("position", "velocity")):
        builder.ExportOutput(split.get_output_port(k), f"{model}.{what}_measured")

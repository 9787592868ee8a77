"""Injects faults into a station: `makebreak run ... --fault NAME` (fault_kinds.py).

They act only on the world and on the signals that leave or enter it: controllers can
notice them only through their sensors.
"""

import math
from collections.abc import Sequence
from copy import deepcopy

import numpy as np
from pydrake.common.schema import Transform
from pydrake.multibody.parsing import AddModel, AddWeld, ModelDirective
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, OutputPort

from makebreak.diagrams.camera import CameraConfig, camera_model
from makebreak.diagrams.fault_kinds import TICK, Injected
from makebreak.diagrams.scene_facts import actuators_of, spheres_of
from makebreak.diagrams.wiring import add_generalized_forces
from makebreak.models.effects.joint_forces import JointForces
from makebreak.models.effects.joints import fade_velocity
from makebreak.models.scene import LoadedScene, Scene
from makebreak.systems.faults.fault_forces import Hand, Push
from makebreak.systems.faults.fault_pictures import LatePictures, PaintedPictures
from makebreak.systems.faults.fault_signals import (
    BiasedSignal,
    LateSignal,
    LimitedSignal,
    SpoiledLcs,
    StuckSignal,
)
from makebreak.systems.faults.numerics.time_span import lasts

GLARE = (255, 255, 255)
BALL_COLOR = (242, 102, 13)  # Of models/ball.sdf.
GLARE_SHARE = 0.7  # Radius of the glare over that of the ball.


def with_box(scene: Scene, faults: Sequence[Injected], place, folder) -> Scene:
    """The scene, with a box at `place` (3,) [m] if a fault asks for it.

    Args: folder: of the model files.
    """
    if not any(fault.name == "box" for fault in faults):
        return scene
    scene = deepcopy(scene)
    name = "stray_box"
    file = f"file://{folder / 'stray_box.sdf'}"
    scene.directives.append(ModelDirective(add_model=AddModel(file=file, name=name)))
    X_PC = Transform()
    X_PC.translation = [float(x) for x in place]
    scene.directives.append(
        ModelDirective(
            add_weld=AddWeld(parent="world", child=f"{name}::{name}", X_PC=X_PC)
        )
    )
    return scene


def _entries(n: int, which) -> np.ndarray:
    """A mask (n,) that is true at the entries `which`."""
    mask = np.zeros(n, dtype=bool)
    mask[which] = True
    return mask


def faulty_sensor(
    builder: DiagramBuilder, port: OutputPort, sensor: str, faults: Sequence[Injected]
) -> OutputPort:
    """The sensor's port behind its faults; the port itself if it has none.

    Args: sensor: position_velocity (side by side), torque or wrench.
    """
    for i, fault in enumerate(faults):
        if fault.kind.on != sensor:
            continue
        n, p = port.size(), fault.numbers
        half = n // 2
        span = fault.start, fault.end
        system: BiasedSignal | StuckSignal | LateSignal
        if fault.name == "position_stuck":
            system = StuckSignal(_entries(n, int(p["joint"]) - 1), *span)
        elif fault.name == "position_delay":
            late = round(p["sec"] / TICK)
            system = LateSignal(_entries(n, slice(0, half)), late, *span)
        else:
            bias = np.zeros(n)
            if fault.name == "position_nan":
                bias[:half] = np.nan
            elif fault.name == "velocity_nan":
                bias[half:] = np.nan
            elif fault.name == "velocity_bias":
                bias[half:] = p["by"]
            elif fault.name.endswith("_nan"):
                bias[:] = np.nan
            elif fault.name == "wrench_bias":
                bias[2] = p["by"]
            else:
                bias[int(p["joint"]) - 1] = p["by"]
            system = BiasedSignal(bias, *span)
        port = _between(builder, f"fault_{i}_{fault.name}", system, port)
    return port


def faulty_command(
    builder: DiagramBuilder, limit: np.ndarray, faults: Sequence[Injected]
) -> list[LateSignal | LimitedSignal]:
    """The systems, connected in order, that a command (n,) passes before the motors.

    Args: limit (n,): of the motors [N m].
    """
    chain: list[LateSignal | LimitedSignal] = []
    for i, fault in enumerate(faults):
        if fault.kind.on != "command":
            continue
        n, span = len(limit), (fault.start, fault.end)
        system: LateSignal | LimitedSignal
        if fault.name == "compute_delay":
            late = round(fault.numbers["sec"] / TICK)
            system = LateSignal(np.ones(n, dtype=bool), late, *span)
        else:
            least = np.full(n, np.inf)
            joint = int(fault.numbers["joint"]) - 1
            least[joint] = fault.numbers["share"] * limit[joint]
            system = LimitedSignal(least, *span)
        builder.AddNamedSystem(f"fault_{i}_{fault.name}", system)
        if chain:
            builder.Connect(
                chain[-1].GetOutputPort("value"), system.GetInputPort("value")
            )
        chain.append(system)
    return chain


def faulty_image(
    builder: DiagramBuilder,
    port: OutputPort,
    config: CameraConfig,
    loaded: LoadedScene,
    ball: str,
    seed: int,
    faults: Sequence[Injected],
) -> OutputPort:
    """The camera's image behind its faults. Args: ball: name of the ball's model."""
    plant = loaded.plant
    for i, fault in enumerate(faults):
        if fault.kind.on != "camera":
            continue
        p, span = fault.numbers, (fault.start, fault.end)
        name = f"fault_{i}_{fault.name}"
        if fault.name in ("second_ball", "glare"):
            body = plant.GetBodyByName(
                ball, plant.GetModelInstanceByName(ball)
            )  # The model's only body has its name.
            _, radii = spheres_of(plant, loaded.scene_graph, ball)
            radius = float(radii.max())
            offset, color = np.array([p.get("x", 0.0), p.get("y", 0.0), 0.0]), GLARE
            if fault.name == "glare":
                offset[2] = radius  # On its top.
                radius *= GLARE_SHARE
            else:
                color = BALL_COLOR
            painted = PaintedPictures(
                camera_model(config), int(body.index()), offset, radius, color, *span
            )
            builder.AddNamedSystem(name, painted)
            builder.Connect(port, painted.GetInputPort("image"))
            builder.Connect(
                plant.get_body_poses_output_port(), painted.GetInputPort("body_poses")
            )
            port = painted.GetOutputPort("rgb_image")
            continue
        share = 1.0 if fault.name == "frames_frozen" else p.get("share", 0.0)
        late = LatePictures(
            config.width, config.height, int(p.get("frames", 0)), share, seed, *span,
            config.period_sec,
        )  # fmt: skip
        builder.AddNamedSystem(name, late)
        builder.Connect(port, late.GetInputPort("image"))
        port = late.GetOutputPort("rgb_image")
    return port


def add_forces(
    builder: DiagramBuilder,
    loaded: LoadedScene,
    arm: str,
    tool: str,
    ball: str,
    center,
    faults: Sequence[Injected],
) -> None:
    """Adds the faults that are forces to the forces of the scene.

    Args: arm, tool, ball: names of models; center (2,): of the ball's circle [m].
    """
    plant, forces = loaded.plant, []
    for i, fault in enumerate(faults):
        if fault.kind.on not in ("arm", "ball"):
            continue
        p, span = fault.numbers, (fault.start, fault.end)
        name = f"fault_{i}_{fault.name}"
        system: Push | Hand | JointForces
        if fault.name == "joint_friction":
            driven = actuators_of(plant, arm)[: int(p["joints"])]
            joints = [each.joint() for each in driven]
            c = p["coulomb"]
            numbers = [[c, fade_velocity(plant, j, c), *span] for j in joints]
            system = JointForces(
                plant, [_timed_friction] * len(joints), joints, numbers
            )
        elif fault.name == "push":
            body = _only_body(plant, tool)
            system = Push(plant, body, [p["x"], p["y"], p["z"]], *span)
        else:
            system = Hand(plant, _only_body(plant, ball), center, p["turn"], *span)
        builder.AddNamedSystem(name, system)
        builder.Connect(plant.get_state_output_port(), system.GetInputPort("state"))
        forces.append(system.GetOutputPort("generalized_force"))
    add_generalized_forces(builder, plant, forces)


def faulty_lcs(
    builder: DiagramBuilder, port: OutputPort, example, faults: Sequence[Injected]
) -> OutputPort:
    """The planner's LCS, unsolvable while a fault of the planner lasts.

    Args: example: an LCS of the same sizes.
    """
    for i, fault in enumerate(faults):
        if fault.kind.on == "planner":
            spoiled = SpoiledLcs(example, fault.start, fault.end)
            builder.AddNamedSystem(f"fault_{i}_{fault.name}", spoiled)
            builder.Connect(port, spoiled.get_input_port())
            port = spoiled.get_output_port()
    return port


def _timed_friction(q, v, t, p):
    """Joint torque [N m]. p: Coulomb friction [N m], the speed below which it fades
    [rad/s], start and end [s]."""
    if lasts(t, p[2], p[3]):
        return -p[0] * math.tanh(v / p[1])
    return 0.0


def _only_body(plant: MultibodyPlant, model: str):
    (index,) = plant.GetBodyIndices(plant.GetModelInstanceByName(model))
    return plant.get_body(index)


def _between(builder, name, system, port) -> OutputPort:
    """Adds a system behind a port; its output."""
    builder.AddNamedSystem(name, system)
    builder.Connect(port, system.GetInputPort("value"))
    return system.GetOutputPort("value")

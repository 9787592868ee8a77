"""A point effector in the plane under any one controller (CC 4.1, 4.2).

    target --x_desired--> controller --u--> world --state--> controller
                             ^                |
                             +-- force sensor-+ (noisy, where the controller listens)

The world comes to the state of t_k just before t_k; the controller reads it at t_k, and
its u acts from t_k to t_{k+1}: there is no period of delay.
"""

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem

from makebreak.systems.noisy_sensor import NoisySensor
from makebreak.systems.planar_view import PlanarView, PlanarViewConfig
from makebreak.systems.planar_world import (
    CircleTarget,
    CircleTargetConfig,
    PlanarWorld,
    PlanarWorldConfig,
)

PERIOD = 0.001  # Of world and controllers [s].
FORCE_MAX = 100.0  # |u| of every controller [N].
MASS = 1.0  # Of the effector; known to the controllers that use a mass [kg].
_VIEW_OFFSET = 5e-4


def make_planar(
    controller: LeafSystem,
    world: PlanarWorldConfig,
    target: CircleTargetConfig,
    force_noise: float,
    seed: int,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """The closed loop. The effector starts at rest on the target's first position.

    Outputs: state (4,), x_desired (6,), force (2,) true, of the world on the effector,
        force_measured (2,), and every output of the controller.

    Args: force_noise, standard deviation of each axis of the force sensor [N].
    """
    builder = DiagramBuilder()
    goal = builder.AddNamedSystem("target", CircleTarget(target))
    x_desired = goal.GetOutputPort("x_desired")
    first = np.zeros(4)
    start = [target.radius * np.cos(target.phase), target.radius * np.sin(target.phase)]
    first[:2] = start
    plant = builder.AddNamedSystem("world", PlanarWorld(world, first))
    state = plant.GetOutputPort("state")
    sensor = builder.AddNamedSystem(
        "force_sensor", NoisySensor([force_noise, force_noise], seed, PERIOD)
    )
    builder.Connect(plant.GetOutputPort("external_force"), sensor.GetInputPort("value"))
    builder.AddNamedSystem("controller", controller)
    builder.Connect(state, controller.GetInputPort("state"))
    builder.Connect(x_desired, controller.GetInputPort("x_desired"))
    if controller.HasInputPort("force"):
        builder.Connect(
            sensor.GetOutputPort("measured"), controller.GetInputPort("force")
        )
    builder.Connect(controller.GetOutputPort("u"), plant.GetInputPort("u"))
    if meshcat is not None:
        view = builder.AddNamedSystem(
            "view",
            PlanarView(
                PlanarViewConfig(
                    anchors=world.anchors,
                    stiffness=world.stiffness,
                    viscosity=world.viscosity,
                    ramp_sec=target.duration_sec,
                ),
                meshcat,
                _VIEW_OFFSET,
            ),
        )
        builder.Connect(state, view.GetInputPort("state"))
        builder.Connect(x_desired, view.GetInputPort("x_desired"))
    builder.ExportOutput(state, "state")
    builder.ExportOutput(x_desired, "x_desired")
    builder.ExportOutput(plant.GetOutputPort("external_force"), "force")
    builder.ExportOutput(sensor.GetOutputPort("measured"), "force_measured")
    for i in range(controller.num_output_ports()):
        port = controller.get_output_port(i)
        builder.ExportOutput(port, port.get_name())
    diagram = builder.Build()
    diagram.set_name("planar")
    return diagram


def knowledge_of(diagram: Diagram, context: Context):
    """What the controller of make_planar learned in this context."""
    controller = diagram.GetSubsystemByName("controller")
    return controller.knowledge(controller.GetMyContextFromRoot(context))


def circle_of_seed(rng: np.random.Generator) -> CircleTargetConfig:
    """Where the circle starts, and which way around it goes."""
    return CircleTargetConfig(
        phase=float(rng.uniform(0.0, 2.0 * np.pi)), turn=int(rng.choice([-1, 1]))
    )

"""A point effector in the plane under one of several controllers (CC 4.1, 4.2).

    target --x_desired--> controller --u--> world --state--> sensor -> controller
                             ^                |
                             +-- force sensor-+ (if the controller has this input)

The world reaches the state of t_k just before t_k; the controller reads it at t_k, and
its u acts from t_k to t_{k+1}. Sensors add noise and a delay (PlanarSensing). With
force feedforward the measured force is subtracted from the u of any controller.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem

from makebreak.diagrams.recorder import add_recorder
from makebreak.diagrams.wiring import add_legend
from makebreak.models.effects.delay_line import DelayLine
from makebreak.models.model_files import MODELS
from makebreak.systems.baselines.force_feedforward import ForceFeedforward
from makebreak.systems.perception.noisy_sensor import NoisySensor
from makebreak.systems.planar.planar_world import (
    CircleTarget,
    CircleTargetConfig,
    PlanarWorld,
    PlanarWorldConfig,
)
from makebreak.systems.views.legend import LegendConfig
from makebreak.systems.views.planar_view import PlanarView, PlanarViewConfig

PLANAR = str(MODELS / "planar.scene.yaml")  # The effector alone: the model.
AXES = "effector"  # Name of its model instance; the joints are x and y.
PERIOD = 0.001  # Of world and controllers [s].
FORCE_MAX = 100.0  # |u| of every controller [N].
MASS = 1.0  # Of the effector; known to the controllers that use a mass [kg].
_VIEW_OFFSET = 5e-4


@dataclass(frozen=True)
class PlanarSensing:
    """The controllers' sensors; noise as standard deviation along each axis."""

    position_noise: float = 0.0  # [m]
    velocity_noise: float = 0.0  # [m/s]
    force_noise: float = 0.2  # [N]
    delay_sec: float = 0.0  # Of all measurements, whole milliseconds.

    @property
    def delay_ticks(self) -> int:
        return round(self.delay_sec / PERIOD)

    def state_std(self) -> list[float]:
        return 2 * [self.position_noise] + 2 * [self.velocity_noise]


# As on an arm in a laboratory. The default: noise of the force only, and no delay.
LAB = PlanarSensing(2e-5, 2e-3, 0.2, 0.001)


def state_noise_seed(seed: int) -> int:
    """Seed of the state sensor's noise; `seed` itself is the force sensor's."""
    return seed + 2**32


def make_planar(
    controller: LeafSystem,
    world: PlanarWorldConfig,
    target: CircleTargetConfig,
    sensing: PlanarSensing,
    seed: int,
    meshcat: Meshcat | None = None,
    feedforward: bool = False,
) -> Diagram:
    """The closed loop. The effector starts at rest at the target's first position.

    Outputs: state (4,), x_desired (6,), force (2,): the true force of the world on the
        effector [N], state_measured (4,), force_measured (2,), and every output of the
        controller.

    Args: seed: of the sensors' noise; feedforward: whether the measured force is also
        fed forward.
    """
    builder = DiagramBuilder()
    goal = builder.AddNamedSystem("target", CircleTarget(target))
    x_desired = goal.GetOutputPort("x_desired")
    first = np.zeros(4)
    start = [target.radius * np.cos(target.phase), target.radius * np.sin(target.phase)]
    first[:2] = start
    plant = builder.AddNamedSystem("world", PlanarWorld(world, first))
    state = plant.GetOutputPort("state")

    def sensed(name, port, std, noise_seed):
        """The port behind a sensor with noise and delay."""
        if np.any(std):
            sensor = NoisySensor(std, noise_seed, PERIOD)
            builder.AddNamedSystem(f"{name}_sensor", sensor)
            builder.Connect(port, sensor.GetInputPort("value"))
            port = sensor.GetOutputPort("measured")
        if sensing.delay_ticks:
            late = DelayLine(np.full(port.size(), sensing.delay_sec), PERIOD)
            builder.AddNamedSystem(f"{name}_delay", late)
            builder.Connect(port, late.GetInputPort("u"))
            port = late.GetOutputPort("y")
        return port

    noise_seed = state_noise_seed(seed)
    measured = sensed("state", state, sensing.state_std(), noise_seed)
    true_force = plant.GetOutputPort("external_force")
    force = sensed("force", true_force, 2 * [sensing.force_noise], seed)
    builder.AddNamedSystem("controller", controller)
    builder.Connect(measured, controller.GetInputPort("state"))
    builder.Connect(x_desired, controller.GetInputPort("x_desired"))
    if controller.HasInputPort("force"):
        builder.Connect(force, controller.GetInputPort("force"))
    u = controller.GetOutputPort("u")
    if feedforward:
        feed = ForceFeedforward(FORCE_MAX, PERIOD)
        total = builder.AddNamedSystem("feedforward", feed)
        builder.Connect(u, total.GetInputPort("u"))
        builder.Connect(force, total.GetInputPort("force"))
        u = total.GetOutputPort("u_total")
    builder.Connect(u, plant.GetInputPort("u"))
    if meshcat is not None:
        view = builder.AddNamedSystem(
            "view",
            PlanarView(
                PlanarViewConfig(
                    anchors=[spring.anchor for spring in world.springs],
                    stiffness=[spring.stiffness for spring in world.springs],
                    viscosity=world.viscosity,
                    ramp_sec=target.duration_sec,
                ),
                meshcat,
                _VIEW_OFFSET,
            ),
        )
        builder.Connect(state, view.GetInputPort("state"))
        builder.Connect(x_desired, view.GetInputPort("x_desired"))
        legend = LegendConfig(view.LEGEND, (), view.CAMERA, view.LOOK_AT)
        add_legend(builder, meshcat, legend)
    builder.ExportOutput(state, "state")
    builder.ExportOutput(x_desired, "x_desired")
    builder.ExportOutput(plant.GetOutputPort("external_force"), "force")
    builder.ExportOutput(measured, "state_measured")
    builder.ExportOutput(force, "force_measured")
    for i in range(controller.num_output_ports()):
        port = controller.get_output_port(i)
        builder.ExportOutput(port, port.get_name())
    entries = [f"{AXES}.{axis}" for axis in "xy"]
    add_recorder(
        builder,
        {
            "state": (
                measured,
                [f"{e}.{q}" for q in ("position", "velocity") for e in entries],
            ),
            "force": (force, [f"{AXES}.tip.f{axis}" for axis in "xy"]),
        },
        {"u": (u, [f"{e}.effort_command" for e in entries])},
        late=True,
    )
    diagram = builder.Build()
    diagram.set_name("planar")
    return diagram


def knowledge_of(diagram: Diagram, context: Context):
    """What the controller of make_planar has learned in this context."""
    controller = diagram.GetSubsystemByName("controller")
    return controller.knowledge(controller.GetMyContextFromRoot(context))


def circle_of_seed(rng: np.random.Generator) -> CircleTargetConfig:
    """A circle with random start and direction."""
    return CircleTargetConfig(
        phase=float(rng.uniform(0.0, 2.0 * np.pi)), turn=int(rng.choice([-1, 1]))
    )

"""The state of a scene at the start of a window, from what was measured there."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from makebreak.gap.simulation.scene_channels import POSE, TWIST, SceneChannels
from makebreak.models.effects import KINDS
from makebreak.models.effects.actuation_path import PathPorts
from makebreak.models.effects.kind import Effect, full_name
from makebreak.models.effects.transmission import motor_joint
from makebreak.models.scene import InitialSection, LoadedScene, actuators_of_model


def initial_state(
    plant: MultibodyPlant,
    channels: SceneChannels,
    default: np.ndarray,
    initial: InitialSection,
    true_value: Callable[[str, float], float],
) -> np.ndarray:
    """The state (n_x,), in which motors and links are without twist unless both are
    given.

    Args: default (n_q,): positions of what is not named, which is at rest. true_value:
        of a channel and its value in `initial`.
    Raises: ValueError for a joint or body that the scene has not.
    """
    x = np.concatenate([default, np.zeros(plant.num_velocities())])

    def put(channel: str, value: float) -> None:
        index = channels.state_index(channel)
        if index is None:
            raise ValueError(f"initial value of {channel!r}, not in the scene")
        x[index] = true_value(channel, value)

    for name, value in initial.positions.items():
        put(f"{name}.position", value)
    for name, value in initial.velocities.items():
        put(f"{name}.velocity", value)
    for names, suffixes in (
        (initial.poses, POSE),
        (initial.body_velocities, TWIST),
    ):
        for name, values in names.items():
            if channels.state_index(f"{name}.x") is None:
                raise ValueError(f"initial pose of {name!r}, which is no free body")
            if len(values) != len(suffixes):
                raise ValueError(
                    f"initial state of {name!r} is {values}, expected "
                    f"[{' '.join(suffixes)}]"
                )
            for suffix, each in zip(suffixes, values, strict=True):
                put(f"{name}.{suffix}", each)
            if suffixes is POSE:
                at = channels.state_index(f"{name}.qw")
                assert at is not None
                x[at : at + 4] /= np.linalg.norm(x[at : at + 4])
    _without_twist(plant, channels, initial, x)
    return x


def _without_twist(
    plant: MultibodyPlant,
    channels: SceneChannels,
    initial: InitialSection,
    x: np.ndarray,
) -> None:
    """A motor and its link start without twist, unless both are given; in place."""
    n_q = plant.num_positions()
    for name, joint in channels.joints.items():
        motor = motor_joint(plant, joint)
        if motor is None:
            continue
        own, a, b = full_name(plant, motor), joint, motor
        if channels.state_index(f"{name}.position") == motor.position_start():
            a, b = motor, joint
        if own not in initial.positions:
            x[b.position_start()] = x[a.position_start()]
        if own not in initial.velocities:
            x[n_q + b.velocity_start()] = x[n_q + a.velocity_start()]


def twist_transmissions(
    loaded: LoadedScene,
    root_context: Context,
    channels: SceneChannels,
    effects: Sequence[Effect],
    initial: InitialSection,
    twists: Mapping[str, tuple[float, float]],
) -> None:
    """A motor leads its link by the given twist; else as it would at rest under its
    effort: by effort over stiffness, or by half the gap. In the Context.

    Args: twists: {joint: (twist [rad], its rate [rad/s])}.
    """
    plant = loaded.plant
    context = plant.GetMyMutableContextFromRoot(root_context)
    for effect in effects:
        if not KINDS[effect.kind].hidden_state:
            continue
        for name, joint in channels.joints.items():
            model = name.split(".")[0]
            if not any(at in (name, model) for at in effect.at):
                continue
            motor, path = motor_joint(plant, joint), loaded.paths[model]
            assert motor is not None and path.effort is not None
            if full_name(plant, motor) in initial.positions:
                continue
            if name in twists:
                twist, rate = twists[name]
            else:
                twist = _rest_twist(plant, root_context, effect, name, path)
                rate = 0.0
            x = plant.GetPositionsAndVelocities(context)
            side, sign = joint, -1.0
            if channels.state_index(f"{name}.position") == joint.position_start():
                side, sign = motor, 1.0
            x[side.position_start()] += sign * twist
            x[plant.num_positions() + side.velocity_start()] += sign * rate
            plant.SetPositionsAndVelocities(context, x)


def _rest_twist(
    plant: MultibodyPlant,
    root_context: Context,
    effect: Effect,
    name: str,
    path: PathPorts,
) -> float:
    """[rad] under the effort of now."""
    own = path.path.GetMyContextFromRoot(root_context)
    model = name.split(".")[0]
    names = [full_name(plant, a.joint()) for a in actuators_of_model(plant, model)]
    assert path.effort is not None
    effort = path.effort.Eval(own)[names.index(name)]
    static_deflection = KINDS[effect.kind].static_deflection
    assert static_deflection is not None
    return static_deflection(effect, float(effort))

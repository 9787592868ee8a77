"""What effects do to a measured channel, and to a command on its way to the motor."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from makebreak.models.effects import KINDS
from makebreak.models.effects.actuation_path import OWN
from makebreak.models.effects.kind import (
    Effect,
    actuator_of,
    full_name,
    one_dof_joints,
)
from makebreak.models.effects.measured_channels import acts_on, is_link_side
from makebreak.models.scene import Scene

SENSED = tuple(name for name, kind in KINDS.items() if kind.channel)
# Between command and motor; a gear's loss is in the equations.
PATH = tuple(n for n, kind in KINDS.items() if kind.path and kind.on_top is None)


def sensing(effects: Sequence[Effect], channel: str) -> tuple[float, float, float]:
    """(1 + skew, delay, bias) of a channel."""
    scale, late, bias = 1.0, 0.0, 0.0
    for effect in effects:
        if effect.kind not in SENSED or not acts_on(
            effect, KINDS[effect.kind].channel, channel
        ):
            continue
        p = effect.parameters
        late += p.get("delay", 0.0)
        scale += p.get("skew", 0.0)
        bias += p.get("bias", 0.0) + p.get("offset", 0.0)
    return scale, late, bias


def lag_of(effects: Sequence[Effect], channel: str) -> float:
    """Time constants [s] of a channel's low-passes, added up."""
    return sum(
        effect.parameters["time_constant"]
        for effect in effects
        if KINDS[effect.kind].channel == "lag" and acts_on(effect, "lag", channel)
    )


def given_late(effects: Sequence[Effect], channel: str) -> float:
    """By how much [s] a measured effort that stands in for a command is late: by the
    effects that name this very channel. Those of a whole joint or model say how late
    its other channels are beside the commands, and so beside what stands in for them.
    """
    return sum(
        effect.parameters["delay"]
        for effect in effects
        if KINDS[effect.kind].channel == "delay" and channel in effect.at
    )


class CommandPath(NamedTuple):
    """Effort of a motor from its command: clipped to +-limit after gain and bias."""

    delay: float  # [s]
    gain: float
    bias: float  # [N m], or [N].
    limit: float
    lag: float  # Time constant [s].
    kp: float  # Of the drive's own loop; OWN: as the scene has it.


def path_of(effects: Sequence[Effect], joint: str) -> CommandPath:
    """What lies between a joint's command and its motor."""
    delay, gain, bias, limit, lag, kp = 0.0, 1.0, 0.0, np.inf, 0.0, OWN
    for effect in effects:
        if effect.kind not in PATH:
            continue
        if joint not in effect.at and joint.split(".")[0] not in effect.at:
            continue
        p = effect.parameters
        delay += p.get("delay", 0.0)
        gain *= p.get("gain", 1.0)
        bias += p.get("bias", 0.0)
        limit = min(limit, p.get("limit", np.inf))
        lag += p.get("time_constant", 0.0)
        kp = p.get("kp", kp)
    return CommandPath(delay, gain, bias, limit, lag, kp)


def rotor_before(scene: Scene, plant: MultibodyPlant, joint: str) -> float:
    """Inertia [kg m2], at the joint, of a rotor before the sensor of effort, where the
    scene's `channels` say that it measures on the link's side; else 0."""
    if not is_link_side(scene.channels, f"{joint}.effort_measured"):
        return 0.0
    (own,) = [j for j in one_dof_joints(plant) if full_name(plant, j) == joint]
    actuator = actuator_of(plant, own)
    return 0.0 if actuator is None else float(actuator.default_reflected_inertia())

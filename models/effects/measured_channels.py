"""The map from a true value to its measured channel: scale, bias, delay, skew, lag."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FrameIndex
from pydrake.systems.framework import LeafSystem

from makebreak.models.effects.kind import Effect, model_names

JOINT = ("position", "velocity", "effort_measured")
BODY = "x y z qw qx qy qz vx vy vz wx wy wz".split()
WRENCH = "fx fy fz tx ty tz".split()
LENGTHS = ("x", "y", "z", "vx", "vy", "vz")
_CURRENT = re.compile(r"current[, :x*]*(-?\d*\.?\d+(?:e[+-]?\d+)?)\s*n\s?m\s?/\s?a")
# Steps of the map that a kind of effect can change (EffectKind.channel).
STEPS = ("offset", "delay", "skew", "bias", "scale", "lag")


@dataclass(frozen=True)
class ChannelMap:
    """measured(t) = scale true((t - delay) / (1 + skew)) + bias, with the true value
    after first-order low-passes of the time constants `lags`."""

    scale: float = 1.0
    bias: float = 0.0  # [unit of the channel]
    delay: float = 0.0  # [s]
    skew: float = 0.0  # [s/s]
    lags: tuple[float, ...] = ()  # [s]

    def true_value(self, measured):
        """The true value of a measured one, apart from the shift in time."""
        return (measured - self.bias) / self.scale

    def stamp(self, time):
        """The time stamp at which the value of `time` is measured [s]."""
        return time * (1.0 + self.skew) + self.delay


def acts_on(effect: Effect, step: str, channel: str) -> bool:
    """Whether an effect with this step changes a channel."""
    if step == "offset" and not channel.endswith(".position"):
        return False
    if step == "scale" and channel.rsplit(".", 1)[-1] not in LENGTHS:
        return False
    if channel.endswith("_command"):
        return False
    return any(
        at == "world" or channel == at or channel.startswith(f"{at}.")
        for at in effect.at
    )


def is_link_side(notes: Mapping[str, str], channel: str) -> bool:
    """Whether the scene's `channels` place the sensor on the link's side: whether the
    entry for the channel, or for its last part, begins with `link`."""
    note = notes.get(channel, notes.get(channel.rsplit(".", 1)[-1], ""))
    return note.strip().lower().startswith("link")


def torque_constant(notes: Mapping[str, str], channel: str) -> float:
    """Torque constant [N m/A] of a channel that the scene's `channels` declare as a
    motor current ("current, 0.11 N m/A"); 1 for other channels.

    Raises: ValueError for a current without a usable constant.
    """
    note = notes.get(channel, notes.get(channel.rsplit(".", 1)[-1], ""))
    note = note.strip().lower()
    if not note.startswith("current"):
        return 1.0
    found = _CURRENT.fullmatch(note)
    value = float(found.group(1)) if found else 0.0
    if value == 0.0 or abs(value) > 1e6:
        raise ValueError(
            f'channels.{channel}: got "{note}", expected a torque constant, as in '
            '"current, 0.11 N m/A"'
        )
    return value


def channel_maps(
    effects: Iterable[Effect], steps: Mapping[str, str], channels: Iterable[str]
) -> dict[str, ChannelMap]:
    """{channel: ChannelMap} of those channels that an effect changes.

    Args: steps: {kind: step} of the kinds that act on channels.
    """
    maps: dict[str, ChannelMap] = {}
    effects = list(effects)
    for channel in channels:
        total = ChannelMap()
        for effect in effects:
            step = steps.get(effect.kind, "")
            if not step or not acts_on(effect, step, channel):
                continue
            (value,) = effect.parameters.values()
            if step in ("offset", "bias"):
                total = replace(total, bias=total.bias + value)
            elif step == "delay":
                total = replace(total, delay=total.delay + value)
            elif step == "skew":
                total = replace(total, skew=total.skew + value)
            elif step == "lag":
                total = replace(total, lags=(*total.lags, value))
            else:
                total = replace(total, scale=total.scale * value)
        if total != ChannelMap():
            maps[channel] = total
    return maps


def check_channels(effect: Effect, step: str, plant: MultibodyPlant) -> None:
    """Raises: ValueError if `at` names no channel that the step can act on."""
    for at in effect.at:
        if at == "world" and step == "scale":
            continue
        model, _, rest = at.partition(".")
        element, _, suffix = rest.rpartition(".") if "." in rest else (rest, "", "")
        where = f"effect {effect.kind} at {at!r}"
        if model not in model_names(plant):
            raise ValueError(
                f"{where}: no model {model!r}, the scene has "
                f"{', '.join(model_names(plant))}"
            )
        instance = plant.GetModelInstanceByName(model)
        frames = [
            plant.get_frame(FrameIndex(i)).name()
            for i in range(plant.num_frames())
            if plant.get_frame(FrameIndex(i)).model_instance() == instance
        ]
        joints = [plant.get_joint(i).name() for i in plant.GetJointIndices(instance)]
        bodies = [plant.get_body(i).name() for i in plant.GetBodyIndices(instance)]
        suffixes = [
            *(JOINT if element in joints else ()),
            *(BODY if element in bodies else ()),
            *(WRENCH if element in frames else ()),
        ]
        if element and not suffixes:
            raise ValueError(
                f"{where}: {model!r} has no joint, body or frame {element!r}"
            )
        if suffix and suffix not in suffixes:
            raise ValueError(
                f"{where}: {model}.{element} has no measured channel {suffix!r}, "
                f"expected one of {' '.join(suffixes)}"
            )
        if step == "offset" and (
            suffix not in ("", "position") or (element and element not in joints)
        ):
            raise ValueError(f"{where}: expected a joint or a model")
        if step == "scale" and (
            (suffix and suffix not in LENGTHS) or (element and element not in bodies)
        ):
            raise ValueError(f"{where}: expected a body, a model or `world`")


class MeasuredChannels(LeafSystem):
    """y = scale u + bias, entry by entry; some entries are read from the plant's state.

    Inputs:  u (n,); state (n_x,) of the plant, if `from_state` is not empty.
    Outputs: y (n,).

    Args: maps: one of each entry; from_state: {entry: index in the state} of the joints
        whose encoder is on the motor's side of an elastic element.
    """

    def __init__(
        self, maps: Sequence[ChannelMap], from_state: Mapping[int, int], n_x: int
    ):
        super().__init__()
        self._scale = np.array([each.scale for each in maps])
        self._bias = np.array([each.bias for each in maps])
        self._own = np.array(list(from_state.keys()), dtype=int)
        self._index = np.array(list(from_state.values()), dtype=int)
        n = len(maps)
        self._u = self.DeclareVectorInputPort("u", n)
        self._state = self.DeclareVectorInputPort("state", n_x) if from_state else None
        self.DeclareVectorOutputPort("y", n, self._calc)

    def _calc(self, context, output):
        u = np.array(self._u.Eval(context))
        if self._state is not None:
            u[self._own] = self._state.Eval(context)[self._index]
        output.SetFromVector(self._scale * u + self._bias)

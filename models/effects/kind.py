"""What an effect is in a scene file, and what a kind of effect is to the project."""

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.dom.minidom import Element

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Joint,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
)
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort

from makebreak.models.typed_yaml import nearest

_MOST_TIMES = 1e4  # Of the range that is searched.
_MOST_SEC = 10.0  # A delay keeps that many samples.


@dataclass
class Effect:
    """One effect of a scene.

    at: where it acts: `<model>.<joint>`, `<model>.<body>`, `<model>.<joint>.<channel>`,
    `<model>` for all its joints (or, where it has one, its body), `<a>~<b>` for a
    contact pair of bodies, `world`. parameters: SI units.
    """

    kind: str = ""
    at: list[str] = field(default_factory=list)
    parameters: dict[str, float] = field(default_factory=dict)

    @property
    def key(self) -> tuple:
        """All of it, to be looked up by."""
        return self.kind, tuple(self.at), tuple(sorted(self.parameters.items()))


@dataclass(frozen=True)
class Parameter:
    """One parameter of a kind.

    low, high: where to search for it in robots that people build; not limits.
    neutral: the value that changes nothing; None where that is the model's own value
        (EffectKind.now) or where another parameter must be neutral instead.
    valid: what is refused: "any" number, ">= 0", "> 0" or "share" (of 0 to below 1).
    rough: what it does jumps with it, so that it is found by trying values.
    endless: beyond low and high it says the same as there, and is allowed.
    ends: a fit does not look beyond high, where other parameters make up for it.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float | None = 0.0
    valid: str = "any"
    optional: bool = False
    rough: bool = False
    endless: bool = False
    ends: bool = False

    @property
    def most(self) -> float:
        """No robot has more: a wrong unit, or what a computer cannot hold."""
        if self.unit == "s":
            return _MOST_SEC
        return _MOST_TIMES * max(abs(self.low), abs(self.high))


@dataclass(frozen=True)
class Tolerance:
    """How well any scene knows what a kind changes, one standard deviation.

    key: its name in a scene's `tolerance`; default: where the scene does not give it;
    relative: whether both are shares of the value.
    """

    key: str
    default: float
    relative: bool = False


@dataclass(frozen=True)
class EffectKind:
    """A kind of effect: what it is called, what it does, how it shows.

    at: what it acts on: "joint" (with one degree of freedom), "actuator" (a joint that
        scene.actuation drives or that has an actuator), "drive" (a joint whose drive
        has a loop of position), "body", "free body" (where to
        look for it; it may be on another), "ground" (an anchored body with shapes),
        "pair" (of bodies that touch), "channel", "length" (channels that are lengths),
        "base" (a model that stands on the world, or the world).
    says: the report's sentence; {at} and the parameters' names are filled in.
    says_less: the same where the first parameter is negative, which is then told
        without its sign.
    confused_with, tell_apart: kinds that look alike, and what tells them apart.
    time: "both", or "discrete"/"continuous" where it makes sense in one only.
    rank: effects of lower rank are applied first, else in the scene's order.
    several: a place may have more than one.
    hidden_state: it adds coordinates that no channel measures.
    weighs: it changes weights or gravity: what two such add is not what both add.
    absolute: its parameters are the body's own numbers; of a mechanism's links other
        kinds give the same as a difference.
    tolerance: of what it changes, which is then a nuisance of every fit; None: it is
        known exactly.
    may_lack: parameters without which it is a candidate of its own.

    What it does; a kind has those steps that it needs:
    edit_text(effect, link): the link's element in the model's URDF or SDF text.
    before_finalize(effect, plant, scene_graph): bodies, shapes and their properties.
    possible(effect, plant, effects): raises ValueError if the finalized plant, with
        these effects in it, is none that could be.
    after_finalize(effect, plant, scene_graph, builder): adds systems; the port that it
        returns gives generalized forces (n_v,) on the plant.
    joint_law: compiled (q, v, t, p) -> force of the effect on the joint [N m] or [N];
        joint_numbers(effect, plant, joint) -> its numbers p, up to four.
    body_law: compiled (V_WB (6,), t, p, F (6,)): adds to F the spatial force, torque
        first, on the body at its origin; body_numbers(effect) -> its numbers p.
    exported: how URDF and MJCF say it: "inertia" (damping and rotors too: the plant has
        it), "friction" or "kp" (its one parameter); "": they cannot.
    drive: the number of the drive's law (DriveLaw) that its parameter replaces.
    path: what it does between command and plant, of a name in actuation_path.STEPS.
    channel: what it does to a measured channel, of a name in measurement.STEPS.
    set_in_context(old, new, plant, plant_context): other parameters without a new
        plant; old: the effect whose parameters the context has.
    least(effect, plant, effects, damped): least values of parameters that a plant
        without the effect allows, where there are such; `effects`: those that it has,
        `damped`: {joint: what its drive damps it with [N m s/rad]}.
    contains: kinds that are this one with fewer parameters: it is named only where it
        gains clearly over them.
    plausible(effect): whether its parameters go together in robots that people build.
    tries(effect, plant, motions): {a nonlinear parameter: values that a search tries}.
    rest_twist(effect, effort): how far a motor leads its joint at rest.
    now(effect, plant, scene_graph): the parameters at which `effect` (whose own do not
        matter) would leave the model as it is; None: the neutral values.
    signature: see models/effects/signature.py; None: it is seen in simulation alone.
    on_top(effect, model, motion, needed) -> (n, n_v): what it adds where the effort
        that all else needs is `needed` (n, n_v); `added` is then of the model alone.
    added(effect, model, motion) -> (n, n_v): what the effect adds to the inverse
        dynamics, where the signature's unknowns are not the parameters.
    """

    at: str
    parameters: tuple[Parameter, ...]
    says: str
    says_less: str = ""
    confused_with: tuple[str, ...] = ()
    tell_apart: str = ""
    time: str = "both"
    rank: int = 0
    several: bool = False
    hidden_state: bool = False
    weighs: bool = False
    absolute: bool = False
    tolerance: Tolerance | None = None
    may_lack: tuple[str, ...] = ()
    check: Callable[[Effect], None] | None = None
    edit_text: Callable[[Effect, Element], None] | None = None
    before_finalize: Callable[[Effect, MultibodyPlant, SceneGraph], None] | None = None
    after_finalize: (
        Callable[[Effect, MultibodyPlant, SceneGraph, DiagramBuilder], OutputPort]
        | None
    ) = None
    possible: Callable[[Effect, MultibodyPlant, Sequence[Effect]], None] | None = None
    least: (
        Callable[
            [Effect, MultibodyPlant, Sequence[Effect], Mapping[str, float]],
            Mapping[str, float],
        ]
        | None
    ) = None
    contains: tuple[str, ...] = ()
    plausible: Callable[[Effect], bool] | None = None
    tries: Callable[..., Mapping[str, Sequence[float]]] | None = None
    rest_twist: Callable[[Effect, float], float] | None = None
    joint_law: Callable | None = None
    joint_numbers: Callable[[Effect, MultibodyPlant, Joint], list[float]] | None = None
    body_law: Callable | None = None
    body_numbers: Callable[[Effect], list[float]] | None = None
    path: str = ""
    drive: str = ""
    exported: str = ""
    channel: str = ""
    set_in_context: Callable[[Effect, Effect, MultibodyPlant, Context], None] | None = (
        None
    )
    now: Callable[[Effect, MultibodyPlant, SceneGraph], Mapping[str, float]] | None = (
        None
    )
    signature: Callable[..., list[Any]] | None = None
    added: Callable[..., Any] | None = None
    on_top: Callable[..., Any] | None = None

    def parameter(self, name: str) -> Parameter:
        for each in self.parameters:
            if each.name == name:
                return each
        raise KeyError(name)


def check_parameters(effect: Effect, kind: EffectKind) -> None:
    """Raises: ValueError for a parameter that is unknown, missing or not valid."""
    known = [each.name for each in kind.parameters]
    for name, value in effect.parameters.items():
        if name not in known:
            raise ValueError(
                f"effect {effect.kind} has no parameter {name!r}: "
                f"{nearest(name, sorted(known))}"
            )
        if not math.isfinite(value):
            raise ValueError(f"effect {effect.kind}: {name} is {value}")
    for each in kind.parameters:
        if each.name not in effect.parameters:
            if not each.optional:
                raise ValueError(
                    f"effect {effect.kind} at {effect.at} needs `{each.name}`"
                )
            continue
        value = effect.parameters[each.name]
        good = {
            "any": True,
            ">= 0": value >= 0.0,
            "> 0": value > 0.0,
            "share": 0.0 <= value < 1.0,
        }[each.valid]
        if not good:
            wanted = "0 or more and below 1" if each.valid == "share" else each.valid
            raise ValueError(
                f"effect {effect.kind}: {each.name} is {value}, expected {wanted}"
            )
        if abs(value) > each.most:
            raise ValueError(
                f"effect {effect.kind}: {each.name} is {value:g}, expected at most "
                f"{each.most:g} {each.unit}".rstrip()
            )
    if kind.check is not None:
        kind.check(effect)


# What a joint's units are where it slides.
_ALONG = {
    "rad": "m", "rad/s": "m/s", "N m": "N", "N m/rad": "N/m", "N m s/rad": "N s/m",
    "N m s2/rad2": "N s2/m2", "kg m2": "kg",
}  # fmt: skip


def unit_at(unit: str, slides: bool) -> str:
    """A parameter's unit, which for a joint is written as of one that turns."""
    return _ALONG.get(unit, unit) if slides else unit


def sliding_joints(plant: MultibodyPlant) -> set[str]:
    """Full names of the joints that slide."""
    joints = one_dof_joints(plant)
    return {full_name(plant, j) for j in joints if isinstance(j, PrismaticJoint)}


def of_slides(effect: Effect, plant: MultibodyPlant) -> bool:
    """Whether it is of joints that slide, all of them."""
    joints = find_joints(effect, plant)
    return bool(joints) and all(isinstance(j, PrismaticJoint) for j in joints)


def with_deviation(value: float, std: float, or_more: bool = False) -> str:
    """value +- std, to the digits that the deviation leaves: 0.03149 +- 0.00002.

    A deviation that begins with 1 has two digits. Without a finite one: three digits.
    or_more: the value may as well be any larger, and is "0.8 (at least 0.4)".
    """
    if or_more and 0.0 < std < np.inf:
        return f"{value:.2g} (at least {value - 2.0 * std:.2g})"
    if not 0.0 < std < np.inf:
        return f"{value:.3g}"
    digits = 2 if f"{std:.0e}"[0] == "1" else 1
    decimals = digits - 1 - int(f"{std:.{digits - 1}e}".split("e")[1])
    size = int(f"{value:.0e}".split("e")[1]) if value else 0
    if not 0 <= decimals <= 8 or decimals + size > 7:  # Beyond what is read easily.
        return f"{value:.3g} +- {std:.1g}"
    return f"{value:.{decimals}f} +- {std:.{decimals}f}"


def sentence(
    effect: Effect,
    kind: EffectKind,
    std: Mapping[str, float] | None = None,
    slides: bool = False,
    or_more: Collection[str] = (),
) -> str:
    """The report's sentence on an effect.

    Args: std, of the parameters where they are known: as "+- ...", an infinite one
        in words; slides, whether it is of joints that slide; or_more, parameters that
        may as well be any larger than two deviations below what they are.
    """
    first = effect.parameters.get(kind.parameters[0].name, 0.0)
    is_less = bool(kind.says_less) and first < 0.0
    words: dict[str, str] = {"at": "nothing" if not effect.at else _place(effect, kind)}
    for i, each in enumerate(kind.parameters):
        value = effect.parameters.get(each.name)
        if is_less and i == 0:
            value = -first
        if value is None:
            words[each.name] = "(unset)"
            continue
        spread = (std or {}).get(each.name)
        at_least = each.name in or_more and spread is not None
        text = with_deviation(value, 0.0 if spread is None else spread, at_least)
        words[each.name] = f"{text} {unit_at(each.unit, slides)}".rstrip()
        if spread is not None and not np.isfinite(spread):
            words[each.name] += " (not identifiable from these data)"
    # An optional parameter that is not there takes its [bracket] with it.
    says = re.sub(
        r"\[([^\]]*)\]", lambda m: "" if "(unset)" in _fill(m[1], words) else m[1],
        kind.says_less if is_less else kind.says,
    )  # fmt: skip
    return _fill(says, words)


def _fill(template: str, words: Mapping[str, str]) -> str:
    return template.format(**words)


def _place(effect: Effect, kind: EffectKind) -> str:
    what = {
        "joint": "joint",
        "actuator": "the actuator of",
        "drive": "joint",
        "body": "body",
        "free body": "body",
        "ground": "body",
        "channel": "channel",
        "length": "body",
        "base": "",
        "pair": "",
    }[kind.at]
    places = [at.replace("~", " on ") for at in effect.at]
    if kind.at in ("joint", "actuator") and all("." not in at for at in effect.at):
        what = "each joint of" if kind.at == "joint" else "each actuator of"
    elif kind.at == "channel" and all(at.count(".") < 2 for at in effect.at):
        what = "each channel of"
    elif len(places) > 1 and what == "joint":
        what = "each of the joints"
    if len(places) > 1:
        places = [f"{', '.join(places[:-1])} and {places[-1]}"]
    return f"{what} {places[0]}".strip()


def parameter(effect: Effect, name: str) -> float:
    """A parameter that must be there. Raises: ValueError."""
    if name not in effect.parameters:
        raise ValueError(f"effect {effect.kind} at {effect.at} needs `{name}`")
    return effect.parameters[name]


def model_names(plant: MultibodyPlant) -> list[str]:
    return [
        plant.GetModelInstanceName(ModelInstanceIndex(i))
        for i in range(plant.num_model_instances())
    ]


def find_body(effect: Effect, plant: MultibodyPlant, name: str) -> RigidBody:
    """The body `<model>.<body>`, or the only body of `<model>`, or the world's.

    Raises: ValueError.
    """
    if name == "world":
        return plant.world_body()
    model, _, body = name.partition(".")
    models = model_names(plant)
    if model not in models:
        raise ValueError(
            f"effect {effect.kind} at {name!r}: no model {model!r}, "
            f"the scene has {', '.join(models)}"
        )
    instance = plant.GetModelInstanceByName(model)
    bodies = [plant.get_body(i) for i in plant.GetBodyIndices(instance)]
    if not body and len(bodies) == 1:
        return bodies[0]
    for candidate in bodies:
        if candidate.name() == body:
            return candidate
    raise ValueError(
        f"effect {effect.kind} at {name!r}: expected a body of {model!r}: "
        f"{', '.join(f'{model}.{b.name()}' for b in bodies)}"
    )


def find_bodies(effect: Effect, plant: MultibodyPlant) -> list[RigidBody]:
    """The bodies that `at` names, each once. Raises: ValueError."""
    bodies = [find_body(effect, plant, name) for name in effect.at]
    _refuse_twice(effect, [body.scoped_name().get_full() for body in bodies])
    return bodies


def find_pair(effect: Effect, plant: MultibodyPlant) -> tuple[RigidBody, RigidBody]:
    """The two bodies of the contact pair `<a>~<b>`. Raises: ValueError."""
    names = effect.at[0].split("~")
    if len(effect.at) != 1 or len(names) != 2:
        raise ValueError(
            f"effect {effect.kind} at {effect.at}, expected one contact pair like "
            "'ball~table'"
        )
    first, second = (find_body(effect, plant, name.strip()) for name in names)
    if first is second:
        raise ValueError(f"effect {effect.kind}: {effect.at[0]!r} names one body twice")
    for body in (first, second):
        if not plant.GetCollisionGeometriesForBody(body):
            raise ValueError(
                f"effect {effect.kind}: body {body.scoped_name()} has no collision "
                "geometry"
            )
    return first, second


def one_dof_joints(plant: MultibodyPlant, model: str | None = None) -> list[Joint]:
    """Joints with one degree of freedom, in the order of their velocities' owners."""
    joints = [plant.get_joint(i) for i in plant.GetJointIndices()]
    return [
        joint
        for joint in joints
        if isinstance(joint, (RevoluteJoint, PrismaticJoint))
        and (model is None or model_of(plant, joint) == model)
    ]


def model_of(plant: MultibodyPlant, element: Joint | RigidBody) -> str:
    return plant.GetModelInstanceName(element.model_instance())


def full_name(plant: MultibodyPlant, element: Joint | RigidBody) -> str:
    """`<model>.<joint>` or `<model>.<body>`, as scenes and recordings name it."""
    return f"{model_of(plant, element)}.{element.name()}"


def find_joints(effect: Effect, plant: MultibodyPlant) -> list[Joint]:
    """The one-dof joints that `at` names: `<model>.<joint>`, or all of `<model>`.

    Raises: ValueError, also for a joint that is named twice.
    """
    found: list[Joint] = []
    for name in effect.at:
        model, _, joint = name.partition(".")
        models = model_names(plant)
        if model not in models:
            raise ValueError(
                f"effect {effect.kind} at {name!r}: no model {model!r}, "
                f"the scene has {', '.join(models)}"
            )
        joints = one_dof_joints(plant, model)
        chosen = [each for each in joints if not joint or each.name() == joint]
        if not chosen:
            raise ValueError(
                f"effect {effect.kind} at {name!r}: expected a joint of {model!r} that "
                "turns or slides: "
                f"{', '.join(f'{model}.{each.name()}' for each in joints) or 'none'}"
            )
        found += chosen
    _refuse_twice(effect, [full_name(plant, joint) for joint in found])
    return found


def _refuse_twice(effect: Effect, names: list[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(
                f"effect {effect.kind} at {effect.at} names {name} more than once"
            )


def velocity_unit(joint: Joint) -> float:
    """A slow speed of the joint: 0.005 rad/s, or 0.001 m/s where it slides."""
    return 0.001 if isinstance(joint, PrismaticJoint) else 0.005


def actuator_of(plant: MultibodyPlant, joint: Joint):
    """The joint's actuator, or None."""
    for i in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(i)
        if actuator.joint().index() == joint.index():
            return actuator
    return None

"""Effects of a scene, and the description of a kind of effect (EffectKind)."""

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

_MAX_OVER_RANGE = 1e4  # Bound of a parameter over its search range.
_MAX_SI = 1e9  # The same of one whose range goes with the size of the scene.
_MAX_SEC = 10.0  # Bound of a delay, whose samples are stored.


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
        """A hashable copy of the effect."""
        return self.kind, tuple(self.at), tuple(sorted(self.parameters.items()))


@dataclass(frozen=True)
class Parameter:
    """One parameter of a kind.

    low, high: range in real robots, in which a search looks for it; not limits.
    of_size: whether low and high are multiples of a size of the scene (sizes.py).
    neutral: the value without effect; None if that is the model's own value
        (EffectKind.now), or if another parameter has to be neutral instead.
    valid: valid values: "any", ">= 0", "> 0" or "share" (from 0 to below 1).
    optional: whether it may be missing.
    rough: its effect is discontinuous, so a fit tries values instead of gradients.
    endless: values beyond low and high have the same effect as these, and are allowed.
    ends: a fit does not go above high, where other parameters could compensate it.
    given: it says where the others hold: a search takes it from the motion, and a fit
        leaves it.
    refines: optional, and added by a search to an effect that is named without it,
        where that earns its place.
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
    refines: bool = False
    given: bool = False
    of_size: bool = False

    @property
    def most(self) -> float:
        """Largest magnitude accepted; more is a wrong unit, or too much data."""
        if self.unit == "s":
            return _MAX_SEC
        if self.of_size:
            return _MAX_SI
        return _MAX_OVER_RANGE * max(abs(self.low), abs(self.high))


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
    """A kind of effect: its name and parameters, what it does in Drake, and how it is
    found in data.

    Identity:
    at: what it acts on: "joint" (of one degree of freedom), "actuator" (a joint that is
        driven by scene.actuation or has an actuator), "drive" (a joint whose drive has
        a position loop), "body", "free body" (a search looks only there), "ground" (an
        anchored body with shapes), "pair" (of bodies that touch), "channel", "length"
        (the channels of a body that are lengths), "base" (a model that stands on the
        world, or the world).
    parameters: see Parameter.
    says: sentence of the report, with {at} and {parameter} filled in.
    says_less: the same if the first parameter is negative; it is given without sign.
    confused_with: kinds with similar signatures. tell_apart: an experiment that
        distinguishes them.
    time: "both", or "discrete" or "continuous" for plants of that kind only.
    rank: effects are applied by rank, then in the scene's order.
    several: one place may have more than one.
    hidden_state: it adds coordinates that no channel measures.
    weighs: it changes masses or gravity, so that two such effects do not just add up.
    absolute: its parameters are the body's own values; for the links of a mechanism
        other kinds give the same as a difference.
    tolerance: of what it changes, which is then a nuisance of every fit; None: it is
        known exactly.
    may_lack: parameters without which it is a candidate of its own.
    exported: how URDF and MJCF express it: "inertia" (also damping and rotors: they are
        in the plant), "friction" or "kp" (its only parameter), "delay" (for Isaac Lab
        alone); "": not at all.

    What it does in Drake; a kind has only the steps that it needs:
    check(effect): raises ValueError for parameters that do not fit together.
    edit_text(effect, link): edits the link's element in the model's URDF or SDF text.
    before_finalize(effect, plant, scene_graph): changes bodies, shapes, properties.
    possible(effect, plant, effects): raises ValueError if the finalized plant with
        these effects is physically impossible.
    after_finalize(effect, plant, scene_graph, builder): adds systems; returns a port of
        generalized forces (n_v,) on the plant.
    joint_law: compiled (q, v, t, p) -> force of the effect on the joint [N m] or [N];
        joint_numbers(effect, plant, joint) -> p, up to five numbers.
    body_law: compiled (V_WB (6,), t, p, F (6,)): adds to F the spatial force on the
        body at its origin, torque first; body_numbers(effect) -> p.
    path: its step between command and plant: a key of actuation_path.STEPS.
    drive: the entry of the drive's law (DriveLaw) that its parameter replaces.
    channel: its step on a measured channel: one of measured_channels.STEPS.
    set_in_context(old, new, plant, plant_context): changes the parameters without a new
        plant; old: the effect with the Context's present parameters.

    How it is found in data:
    now(effect, plant, scene_graph): the parameters at which the effect (whose own are
        not used) changes nothing; None: the neutral values.
    least(effect, plant, effects, damped): {parameter: lower bound} from the model;
        effects: that it has; damped: {joint: damping of its drive [N m s/rad]}.
    plausible(effect): whether the combination of parameters occurs in real robots.
    tries(effect, plant, motions): {nonlinear parameter: values that a search tries}.
    probes(mass): the parameters of small effects, of about so many kilograms, whose
        responses add up to that of any small effect, and a function from their shares
        (k,) to its parameters; of kinds at bodies.
    contains: kinds that are special cases of this one with fewer parameters: it is only
        named if it is clearly better than they are.
    signature: see signature.py; None: it is only visible in simulation.
    added(effect, model, motion) -> (n, n_v): contribution to the inverse dynamics, if
        the signature's unknowns are not the parameters.
    on_top(effect, model, motion, needed) -> (n, n_v): contribution that depends on the
        effort `needed` (n, n_v) for everything else.
    static_deflection(effect, effort): angle by which a motor leads its joint at rest.
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
    probes: Callable[[float], tuple[list[dict[str, float]], Callable]] | None = None
    static_deflection: Callable[[Effect, float], float] | None = None
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

    @property
    def is_inertia(self) -> bool:
        """Whether it changes what forces accelerate: a mass, or a moment of inertia."""
        return any(p.unit in ("kg", "kg m2") for p in self.parameters)

    def parameter(self, name: str) -> Parameter:
        for each in self.parameters:
            if each.name == name:
                return each
        raise KeyError(name)


def check_parameters(effect: Effect, kind: EffectKind) -> None:
    """Raises: ValueError for an unknown, missing or invalid parameter."""
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
            expected = "0 or more and below 1" if each.valid == "share" else each.valid
            raise ValueError(
                f"effect {effect.kind}: {each.name} is {value}, expected {expected}"
            )
        if abs(value) > each.most:
            raise ValueError(
                f"effect {effect.kind}: {each.name} is {value:g}, expected at most "
                f"{each.most:g} {each.unit}".rstrip()
            )
    if kind.check is not None:
        kind.check(effect)


# Units of a revolute joint's parameters, and the same of a prismatic joint's.
_ALONG = {
    "rad": "m", "rad/s": "m/s", "N m": "N", "N m/rad": "N/m", "N m s/rad": "N s/m",
    "N m s2/rad2": "N s2/m2", "kg m2": "kg",
}  # fmt: skip


def unit_at(unit: str, slides: bool) -> str:
    """A parameter's unit, which is declared for revolute joints, at a prismatic one."""
    return _ALONG.get(unit, unit) if slides else unit


def sliding_joints(plant: MultibodyPlant) -> set[str]:
    """Full names of the prismatic joints."""
    joints = one_dof_joints(plant)
    return {full_name(plant, j) for j in joints if isinstance(j, PrismaticJoint)}


def of_slides(effect: Effect, plant: MultibodyPlant) -> bool:
    """Whether all joints of an effect are prismatic."""
    joints = find_joints(effect, plant)
    return bool(joints) and all(isinstance(j, PrismaticJoint) for j in joints)


def with_deviation(value: float, std: float, or_more: bool = False) -> str:
    """Text of value +- std with the significant digits: 0.03149 +- 0.00002.

    The std has one digit, or two if it begins with 1; without a finite std the value
    has three digits; one beyond all sense is none. or_more: only a lower bound is
    known: "0.8 (at least 0.4)".
    """
    if or_more and 0.0 < std < np.inf:
        return f"{value:.2g} (at least {value - 2.0 * std:.2g})"
    if not 0.0 < std < np.inf:
        return f"{value:.3g}"
    if std > 1e6 and std > 1e3 * abs(value):
        return f"{value:.3g} (the data do not show it)"
    digits = 2 if f"{std:.0e}"[0] == "1" else 1
    decimals = digits - 1 - int(f"{std:.{digits - 1}e}".split("e")[1])
    size = int(f"{value:.0e}".split("e")[1]) if value else 0
    if not 0 <= decimals <= 8 or decimals + size > 7:  # Too long to read.
        return f"{value:.3g} +- {std:.1g}"
    return f"{value:.{decimals}f} +- {std:.{decimals}f}"


def sentence(
    effect: Effect,
    kind: EffectKind,
    std: Mapping[str, float] | None = None,
    slides: bool = False,
    or_more: Collection[str] = (),
    kept: Collection[str] = (),
) -> str:
    """The report's sentence about an effect.

    Args: std: standard deviations of parameters, written as "+- ..." (an infinite one
        in words); slides: whether its joints are prismatic; or_more: parameters of
        which only a lower bound, two std below the value, is known; kept: parameters
        that were not fitted.
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
        elif each.name in kept:
            words[each.name] += " (as modelled)"
    # A [bracket] with an optional parameter that is not set is left out.
    says = re.sub(
        r"\[([^\]]*)\]", lambda m: "" if "(unset)" in _fill(m[1], words) else m[1],
        kind.says_less if is_less else kind.says,
    )  # fmt: skip
    return _fill(says, words)


def _fill(template: str, words: Mapping[str, str]) -> str:
    return template.format(**words)


def _place(effect: Effect, kind: EffectKind) -> str:
    """The words for `at` in a sentence."""
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
    elif len(places) > 1 and what in ("joint", "channel"):
        what = f"each of the {what}s"
    elif len(places) > 1 and what == "body":
        what = "bodies"
    if len(places) > 1:
        places = [f"{', '.join(places[:-1])} and {places[-1]}"]
    return f"{what} {places[0]}".strip()


def parameter(effect: Effect, name: str) -> float:
    """The value of a parameter. Raises: ValueError if it is missing."""
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

    Raises: ValueError for an unknown body.
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


ONE_DOF = (RevoluteJoint, PrismaticJoint)


def one_dof_joints(plant: MultibodyPlant, model: str | None = None) -> list[Joint]:
    """Joints with one degree of freedom, in the order of their velocities' owners."""
    joints = [plant.get_joint(i) for i in plant.GetJointIndices()]
    return [
        joint
        for joint in joints
        if isinstance(joint, ONE_DOF)
        and (model is None or model_of(plant, joint) == model)
    ]


def model_of(plant: MultibodyPlant, element: Joint | RigidBody) -> str:
    return plant.GetModelInstanceName(element.model_instance())


# What load_scene adds for an effect: models of one body.
PAYLOAD_ON, MOTOR_OF = "payload_on_", "motor_of_"


def is_added(model: str) -> bool:
    """Whether a model is a payload, or a motor behind something elastic, and none of
    the scene's own."""
    return model.startswith((PAYLOAD_ON, MOTOR_OF))


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
        if not plant.HasModelInstanceNamed(model):
            raise ValueError(
                f"effect {effect.kind} at {name!r}: no model {model!r}, "
                f"the scene has {', '.join(model_names(plant))}"
            )
        instance = plant.GetModelInstanceByName(model)
        if joint and plant.HasJointNamed(joint, instance):
            named = plant.GetJointByName(joint, instance)
            chosen = [named] if isinstance(named, ONE_DOF) else []
        else:
            chosen = [] if joint else one_dof_joints(plant, model)
        if not chosen:
            joints = [each.name() for each in one_dof_joints(plant, model)]
            raise ValueError(
                f"effect {effect.kind} at {name!r}: expected a joint of {model!r} that "
                "turns or slides: "
                f"{', '.join(f'{model}.{each}' for each in joints) or 'none'}"
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
    """The joint's actuator; None if it has none."""
    for i in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(i)
        if actuator.joint().index() == joint.index():
            return actuator
    return None

"""Effects on a link of a mechanism: its mass and its centre of mass."""

from xml.dom.minidom import Element

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from makebreak.models.effects.inertia import (
    added_inertia,
    change_inertia,
    com_mix,
    inertial_signature,
    mass_mix,
    ten_parameters,
)
from makebreak.models.effects.kind import Effect, EffectKind, Parameter, find_bodies
from makebreak.models.effects.model_text import read_inertial, write_inertial
from makebreak.models.effects.signature import Signature

# A link keeps at least this fraction of its mass, so that its moments of inertia, which
# scale with the mass, can be scaled up again.
MASS_FRACTION_MIN = 1e-9


def _left(effect: Effect, mass: float, change: float) -> float:
    """mass + change [kg]. Raises: ValueError if it is negative."""
    if not mass + change >= -1e-6 * mass:
        raise ValueError(
            f"effect link_mass at {effect.at}: {-change:g} kg less, and the link has "
            f"{mass:g} kg"
        )
    return max(mass + change, MASS_FRACTION_MIN * mass)


def _mass_in_text(effect: Effect, link: Element) -> None:
    inertial = read_inertial(link)
    mass = _left(effect, inertial.mass, effect.parameters["mass"])
    inertial.central *= mass / inertial.mass
    inertial.mass = mass
    write_inertial(link, inertial)


def _mass_in_context(old: Effect, new: Effect, mass, com, central):
    left = _left(new, mass, new.parameters["mass"] - old.parameters["mass"])
    return left, com, central * (left / mass)


def _shift(effect: Effect) -> np.ndarray:
    return np.array([effect.parameters[axis] for axis in "xyz"])


def _com_in_text(effect: Effect, link: Element) -> None:
    inertial = read_inertial(link)
    inertial.com = inertial.com + _shift(effect)
    write_inertial(link, inertial)


def _com_in_context(old: Effect, new: Effect, mass, com, central):
    return mass, com + _shift(new) - _shift(old), central


def _no_change(effect: Effect, plant: MultibodyPlant, scene_graph):
    """The neutral values. Raises: ValueError for a body without mass."""
    for body in find_bodies(effect, plant):
        if not body.default_spatial_inertia().get_mass() > 0.0:
            raise ValueError(
                f"effect {effect.kind} at {effect.at}: {body.scoped_name()} has no mass"
            )
    names = ("mass",) if effect.kind == "link_mass" else "xyz"
    return dict.fromkeys(names, 0.0)


def _least_mass(effect, plant: MultibodyPlant, effects, damped) -> dict[str, float]:
    masses = [
        b.default_spatial_inertia().get_mass() for b in find_bodies(effect, plant)
    ]
    return {"mass": -min(masses)}


def _signature(effect: Effect, model, motion, grid=None) -> list[Signature]:
    """Linear in the mass; linearised in the centre of mass."""
    body = find_bodies(effect, model.plant)[0]
    M = body.default_spatial_inertia()
    is_mass = effect.kind == "link_mass"
    mix, names = (mass_mix(M), ("mass",)) if is_mass else (com_mix(M), tuple("xyz"))
    return [
        inertial_signature(
            effect, model, motion, body, names, mix,
            lambda c: {n: float(x) for n, x in zip(names, c, strict=True)}, is_mass,
        )
    ]  # fmt: skip


def _mass_added(effect: Effect, model, motion) -> np.ndarray:
    return added_inertia(
        effect, model, motion,
        lambda M: effect.parameters["mass"] * mass_mix(M)[:, 0],
    )  # fmt: skip


def _com_added(effect: Effect, model, motion) -> np.ndarray:
    def more(M):
        mass, com = M.get_mass(), M.get_com()
        after = ten_parameters(mass, com + _shift(effect))
        return after - ten_parameters(mass, com)

    return added_inertia(effect, model, motion, more)


def _mass_probes(size: float):
    return [{"mass": size}], lambda c: {"mass": size * float(c[0])}


def _com_probes(size: float):
    arm = 0.01
    each = [{a: arm * (a == axis) for a in "xyz"} for axis in "xyz"]
    return each, lambda c: {a: arm * float(x) for a, x in zip("xyz", c, strict=True)}


KINDS = {
    # The moments of inertia scale with the mass: its distribution stays.
    "link_mass": EffectKind(
        at="body",
        parameters=(Parameter("mass", "kg", -2.0, 2.0, of_size=True),),
        says="{at} is {mass} heavier than in the model",
        says_less="{at} is {mass} lighter than in the model",
        confused_with=("payload", "link_com", "actuator_gain", "constant_force"),
        exported="inertia",
        tell_apart="weigh the part, or look whether it is mounted; else hold poses in "
        "which its weight acts on other joints than a payload's",
        rank=2,
        weighs=True,
        edit_text=_mass_in_text,
        set_in_context=change_inertia(_mass_in_context),
        least=_least_mass,
        now=_no_change,
        signature=_signature,
        added=_mass_added,
        probes=_mass_probes,
    ),
    # The inertia about the centre of mass is kept.
    "link_com": EffectKind(
        at="body",
        parameters=tuple(Parameter(axis, "m", -0.3, 0.3) for axis in "xyz"),
        says="the centre of mass of {at} lies ({x}, {y}, {z}) away from where the "
        "model has it, in its axes",
        confused_with=("payload", "link_mass", "gravity_tilt", "joint_offset"),
        exported="inertia",
        tell_apart="hold the link in several attitudes: a shift turns with it, and the "
        "weight stays",
        rank=2,
        weighs=True,
        edit_text=_com_in_text,
        set_in_context=change_inertia(_com_in_context),
        now=_no_change,
        signature=_signature,
        added=_com_added,
        probes=_com_probes,
    ),
}

"""Effects in the contact of two bodies: friction, stiffness, rolling resistance."""

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, OutputPort

from makebreak.models.effects.contact_damper import ContactDamper
from makebreak.models.effects.contact_surface import (
    changed_and_other,
    combined_friction,
    coulomb,
    dissipation_of,
    friction_against,
    set_surface,
    shapes_that_meet,
    single_value,
    stiffness_of,
)
from makebreak.models.effects.friction_patch import cut_patch, patch_values
from makebreak.models.effects.kind import (
    Effect,
    EffectKind,
    Parameter,
    find_pair,
    parameter,
)
from makebreak.models.effects.rolling_resistance import (
    add_rolling_resistance,
    rolling_values,
)


def _set_friction(
    effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Sets the pair's friction mu through the surface of one body, if possible.

    Drake combines two surfaces to mu = 2 mu1 mu2/(mu1 + mu2), so mu1 becomes
    mu mu2/(2 mu2 - mu). Body 1 is that of changed_and_other, so that the friction of a
    free ball with table and with finger are independent; the pairs of body 1 with
    third bodies change with it. A mu of 2 mu2 or more is out of reach of mu1: then
    both surfaces become mu. Of a body whose shapes differ in friction, those that
    touch the other body count (shapes_that_meet).
    """
    mu = parameter(effect, "friction")
    changed, other = changed_and_other(effect, plant)
    mu_other = friction_against(effect, plant, scene_graph, other, changed)
    if 2.0 * mu_other > mu or mu == 0.0:
        mu_changed = mu * mu_other / (2.0 * mu_other - mu) if mu > 0.0 else 0.0
    else:
        mu_changed = mu
        only = shapes_that_meet(effect, plant, scene_graph, other, changed)
        set_surface(plant, scene_graph, other, "coulomb_friction", coulomb(mu), only)
    set_surface(plant, scene_graph, changed, "coulomb_friction", coulomb(mu_changed))


def _set_stiffness(
    effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Drake combines two surfaces as springs in series, k = k1 k2/(k1 + k2). Both are
    scaled by one factor, so that the contact point between them stays in place."""
    k = parameter(effect, "stiffness")
    changed, other = changed_and_other(effect, plant)
    k1 = single_value(effect, plant, scene_graph, changed, stiffness_of, "stiffness")
    k2 = single_value(effect, plant, scene_graph, other, stiffness_of, "stiffness")
    if np.isfinite([k1, k2]).all():
        scale = k * (k1 + k2) / (k1 * k2)
        k1, k2 = scale * k1, scale * k2
    else:
        k1 = k2 = 2.0 * k
    set_surface(plant, scene_graph, changed, "point_contact_stiffness", k1)
    set_surface(plant, scene_graph, other, "point_contact_stiffness", k2)


def _set_dissipation(
    effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Drake weighs two surfaces by their stiffness: d = (k2 d1 + k1 d2)/(k1 + k2). As
    with friction d1 alone is changed if it can give d, else both become d."""
    if (
        plant.get_discrete_contact_approximation().name == "kSap"
        and plant.time_step() > 0.0
    ):
        raise ValueError(
            "effect contact_dissipation: the approximation `sap` has no Hunt-Crossley "
            "dissipation; expected `lagged`, `similar` or `tamsi`"
        )
    d = parameter(effect, "dissipation")
    changed, other = changed_and_other(effect, plant)
    k1 = single_value(effect, plant, scene_graph, changed, stiffness_of, "stiffness")
    k2 = single_value(effect, plant, scene_graph, other, stiffness_of, "stiffness")
    d2 = single_value(effect, plant, scene_graph, other, dissipation_of, "dissipation")
    d1 = -1.0
    if np.isfinite([k1, k2]).all():
        d1 = (d * (k1 + k2) - k1 * d2) / k2
    if d1 < 0.0:
        d1 = d
        set_surface(plant, scene_graph, other, "hunt_crossley_dissipation", d)
    set_surface(plant, scene_graph, changed, "hunt_crossley_dissipation", d1)


def _values_now(effect: Effect, plant: MultibodyPlant, scene_graph) -> dict[str, float]:
    """The pair's values as Drake combines them."""
    a, b = find_pair(effect, plant)

    def both(read, what):
        return (
            single_value(effect, plant, scene_graph, body, read, what)
            for body in (a, b)
        )

    if effect.kind == FRICTION:
        mu1 = friction_against(effect, plant, scene_graph, a, b)
        mu2 = friction_against(effect, plant, scene_graph, b, a)
        return {"friction": combined_friction(mu1, mu2)}
    k1, k2 = both(stiffness_of, "stiffness")
    if effect.kind == "contact_stiffness":
        # Drake does not report the stiffness that it estimates: assume a stiff one.
        finite = [k for k in (k1, k2) if np.isfinite(k)]
        stiffness = 1.0 / sum(1.0 / k for k in finite) if finite else 1e6
        return {"stiffness": stiffness}
    d1, d2 = both(dissipation_of, "dissipation")
    if not np.isfinite([k1, k2]).all():
        return {"dissipation": (d1 + d2) / 2.0}
    return {"dissipation": (k2 * d1 + k1 * d2) / (k1 + k2)}


def _undamp(effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Removes the Hunt-Crossley dissipation, which the linear damper replaces."""
    for body in find_pair(effect, plant):
        set_surface(plant, scene_graph, body, "hunt_crossley_dissipation", 0.0)


def _add_damper(
    effect: Effect,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    builder: DiagramBuilder,
) -> OutputPort:
    stiffness, friction = (
        _values_now(Effect(kind, effect.at, {}), plant, scene_graph)[name]
        for kind, name in ((STIFFNESS, "stiffness"), (FRICTION, "friction"))
    )
    damper = builder.AddNamedSystem(
        f"contact_damper_{effect.at[0].replace('.', '_').replace('~', '_')}",
        ContactDamper(
            plant,
            find_pair(effect, plant),
            stiffness,
            parameter(effect, "damping"),
            friction,
        ),
    )
    builder.Connect(plant.get_state_output_port(), damper.GetInputPort("state"))
    builder.Connect(scene_graph.get_query_output_port(), damper.GetInputPort("query"))
    return damper.GetOutputPort("generalized_force")


FRICTION = "contact_friction"
# Kinds that set the normal force of a contact.
CONTACT_LAW = (STIFFNESS, DISSIPATION) = ("contact_stiffness", "contact_dissipation")
DAMPER = "contact_damping"  # A linear damper instead of the dissipation.

KINDS = {
    FRICTION: EffectKind(
        at="pair",
        # Data of sticking contact only bound it from below: a fit ends at `high`.
        parameters=(
            Parameter("friction", "", 0.01, 1.5, None, valid=">= 0", ends=True),
        ),
        says="the friction coefficient of {at} is {friction}",
        confused_with=("plane_tilt", "contact_dissipation", "object_com"),
        tell_apart="let it slide both ways, and look at windows of 0.1 s or longer",
        before_finalize=_set_friction,
        now=_values_now,
    ),
    "friction_patch": EffectKind(
        at="pair",
        several=True,
        parameters=(
            # With more and more friction a fitted patch shrinks to a point.
            Parameter("friction", "", 0.01, 1.5, None, valid=">= 0", ends=True),
            *(
                Parameter(f"{a}_{end}", "m", -2.0, 2.0, None, endless=True)
                for a in "xy"
                for end in ("min", "max")
            ),
        ),
        says="where x is {x_min} to {x_max} and y is {y_min} to {y_max}, the friction "
        "coefficient of {at} is {friction}",
        confused_with=(FRICTION, "plane_tilt"),
        tell_apart="slide over the place in another direction, and beside it",
        contains=(FRICTION,),  # A patch under the whole path.
        rank=1,
        before_finalize=cut_patch,
        now=patch_values,
    ),
    "rolling_resistance": EffectKind(
        at="pair",
        parameters=(Parameter("coefficient", "", 0.0, 0.1, valid=">= 0"),),
        says="{at} rolls against a resistance of {coefficient} (times the radius: the "
        "lever arm) that the model lacks",
        confused_with=("body_drag", "plane_tilt"),
        tell_apart="roll at two speeds, and both ways: the resistance slows evenly",
        after_finalize=add_rolling_resistance,
        now=rolling_values,
    ),
    "contact_stiffness": EffectKind(
        at="pair",
        parameters=(Parameter("stiffness", "N/m", 300.0, 1e6, None, valid="> 0"),),
        says="the contact of {at} has a stiffness of {stiffness}",
        confused_with=("plane_height", "object_size", "contact_dissipation"),
        tell_apart="compare impacts with how deep it lies at rest",
        before_finalize=_set_stiffness,
        now=_values_now,
    ),
    "contact_dissipation": EffectKind(
        at="pair",
        parameters=(Parameter("dissipation", "s/m", 0.0, 100.0, None, valid=">= 0"),),
        says="the contact of {at} has a dissipation of {dissipation}",
        confused_with=("contact_stiffness", FRICTION, "corner_radius"),
        tell_apart="let it hit at two speeds",
        rank=1,
        before_finalize=_set_dissipation,
        now=_values_now,
    ),
    "contact_damping": EffectKind(
        at="pair",
        parameters=(Parameter("damping", "N s/m", 0.0, 1e4, None, valid=">= 0"),),
        says="the contact of {at} is damped by a linear damper of {damping}, not by "
        "Hunt and Crossley's",
        confused_with=("contact_dissipation", "contact_stiffness"),
        tell_apart="let it hit at several speeds: a linear damper takes the same share "
        "of each",
        rank=2,  # After the dissipation, which it replaces.
        before_finalize=_undamp,
        after_finalize=_add_damper,
        now=lambda effect, plant, scene_graph: {},
    ),
}

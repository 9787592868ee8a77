"""What an effect is in a scene file, and what a kind of effect can do to a model."""

from collections.abc import Callable
from dataclasses import dataclass, field
from xml.dom.minidom import Element

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder, OutputPort


@dataclass
class Effect:
    """One effect of a scene.

    at: where it acts: `<model>.<body>`, `<a>~<b>` for a contact pair of bodies, ...;
    where a model has one body only, the model's name will do. parameters: SI units.
    """

    kind: str = ""
    at: list[str] = field(default_factory=list)
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class EffectKind:
    """The steps at which a kind of effect acts; it has those that it needs.

    edit_text(effect, link): the link's element in the model's URDF or SDF text.
    before_finalize(effect, plant, scene_graph): shapes and their properties.
    after_finalize(effect, plant, scene_graph, builder): adds systems; the port that it
        returns gives generalized forces (n_v,) on the plant.
    """

    parameters: tuple[str, ...]
    edit_text: Callable[[Effect, Element], None] | None = None
    before_finalize: Callable[[Effect, MultibodyPlant, SceneGraph], None] | None = None
    after_finalize: (
        Callable[[Effect, MultibodyPlant, SceneGraph, DiagramBuilder], OutputPort]
        | None
    ) = None


def parameter(effect: Effect, name: str) -> float:
    """A parameter that must be there. Raises: ValueError."""
    if name not in effect.parameters:
        raise ValueError(f"effect {effect.kind} at {effect.at} needs `{name}`")
    return effect.parameters[name]


def find_body(effect: Effect, plant: MultibodyPlant, name: str) -> RigidBody:
    """The body `<model>.<body>`, or the only body of `<model>`. Raises: ValueError."""
    model, _, body = name.partition(".")
    models = [
        plant.GetModelInstanceName(ModelInstanceIndex(i))
        for i in range(plant.num_model_instances())
    ]
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

"""Scenes: what a world, or a model of it, consists of. YAML in, a Drake plant out."""

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.yaml import yaml_dump, yaml_load, yaml_load_typed
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    ModelDirective,
    ModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Adder

from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.model_text import edited_model_file

ACTUATIONS = ("effort", "pd", "none")


@dataclass
class PlantSection:
    time_step: float = 0.001  # [s]; 0 is continuous.
    contact_model: str = "point"
    discrete_contact_approximation: str = "lagged"
    gravity: list[float] = field(default_factory=lambda: [0.0, 0.0, -9.81])  # [m/s2]


@dataclass
class ActuationSection:
    """Who drives the joints. The effort of type pd is
    kp (position_command - position) + kd (velocity_command - velocity)."""

    type: str = "none"  # effort, pd or none.
    joints: list[str] = field(default_factory=list)
    kp: list[float] = field(default_factory=list)  # [N m/rad] or [N/m]
    kd: list[float] = field(default_factory=list)  # [N m s/rad] or [N s/m]
    hold: str = "zero_order"
    rate_hz: float = 1000.0


@dataclass
class InitialSection:
    """Named `<model>.<joint>` and `<model>.<body>`; bodies in the world's axes."""

    positions: dict[str, float] = field(default_factory=dict)  # [rad] or [m]
    velocities: dict[str, float] = field(default_factory=dict)  # [rad/s] or [m/s]
    poses: dict[str, list[float]] = field(default_factory=dict)  # [qw qx qy qz x y z]
    body_velocities: dict[str, list[float]] = field(
        default_factory=dict
    )  # [wx wy wz vx vy vz]


@dataclass
class Scene:
    directives: list[ModelDirective] = field(default_factory=list)
    plant: PlantSection = field(default_factory=PlantSection)
    actuation: ActuationSection = field(default_factory=ActuationSection)
    initial: InitialSection = field(default_factory=InitialSection)
    tolerance: dict[str, float] = field(default_factory=dict)
    channels: dict[str, str] = field(default_factory=dict)
    effects: list[Effect] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class LoadedScene:
    plant: MultibodyPlant  # Finalized.
    scene_graph: SceneGraph
    scene: Scene
    effects: tuple[Effect, ...]  # As applied, in order.


def read_scene(path: str | Path) -> Scene:
    """The scene that a YAML or JSON file describes.

    Relative model files become absolute: they are relative to the scene's own folder.

    Raises: ValueError if the file is missing, or is not a scene.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"scene file {path} does not exist")
    try:
        raw = yaml_load(filename=str(path))
        for effect in raw.get("effects") or []:
            if isinstance(effect.get("at"), str):
                effect["at"] = [effect["at"]]  # The typed reader knows lists only.
        scene = yaml_load_typed(schema=Scene, data=yaml_dump(raw))
    except Exception as error:  # The reader raises several kinds.
        raise ValueError(f"scene file {path}: {' '.join(str(error).split())}") from None
    for directive in scene.directives:
        for part in (directive.add_model, directive.add_directives):
            if part is not None and "://" not in part.file:
                # Not as_uri(): Drake does not decode %20.
                part.file = f"file://{(path.parent / part.file).resolve()}"
    _check(scene)
    return scene


def load_scene(scene: Scene | str | Path, builder: DiagramBuilder) -> LoadedScene:
    """Adds the scene's plant, with every effect applied, and its scene graph.

    What is added depends on the scene alone, and its default context is the scene's
    initial state. If an effect needs it, the plant's applied_generalized_force port
    is connected.

    Args: scene, or the path of its file.
    Raises: ValueError, naming what in the scene is wrong.
    """
    if not isinstance(scene, Scene):
        scene = read_scene(scene)
    _check(scene)
    section = scene.plant
    plant, scene_graph = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=section.time_step,
            contact_model=section.contact_model,
            discrete_contact_approximation=section.discrete_contact_approximation,
            use_sampled_output_ports=False,  # A 1 kHz law must read x[n] at t_n.
        ),
        builder,
    )
    plant.mutable_gravity_field().set_gravity_vector(section.gravity)
    _parse(scene, plant)
    for effect in scene.effects:
        before = KINDS[effect.kind].before_finalize
        if before is not None:
            before(effect, plant, scene_graph)
    plant.Finalize()
    _set_initial(scene.initial, plant)
    forces: list[OutputPort] = []
    for effect in scene.effects:
        after = KINDS[effect.kind].after_finalize
        if after is not None:
            forces.append(after(effect, plant, scene_graph, builder))
    if forces:
        total = forces[0]
        if len(forces) > 1:
            adder = builder.AddNamedSystem(
                "effect_forces", Adder(len(forces), plant.num_velocities())
            )
            for i, port in enumerate(forces):
                builder.Connect(port, adder.get_input_port(i))
            total = adder.get_output_port()
        builder.Connect(total, plant.get_applied_generalized_force_input_port())
    return LoadedScene(plant, scene_graph, scene, tuple(scene.effects))


def set_initial_velocities(loaded: LoadedScene, plant_context: Context) -> None:
    """Sets the scene's initial velocities: Drake has no default for them."""
    plant, initial = loaded.plant, loaded.scene.initial
    for name, value in initial.velocities.items():
        joint = _find(plant, name, "joint")
        v = plant.GetVelocities(plant_context)
        v[joint.velocity_start()] = value
        plant.SetVelocities(plant_context, v)
    for name, twist in initial.body_velocities.items():
        plant.SetFreeBodySpatialVelocity(
            context=plant_context,
            body=_find(plant, name, "body"),
            V_JpJc=SpatialVelocity(twist[:3], twist[3:]),
        )


def nearest(name: str, known: Iterable[str]) -> str:
    """What may have been meant by a wrong name, as the end of an error message."""
    known = sorted(known)
    close = get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"


def _check(scene: Scene) -> None:
    if not scene.plant.time_step >= 0.0:
        raise ValueError(
            f"plant.time_step is {scene.plant.time_step}, expected 0 or more [s]"
        )
    if len(scene.plant.gravity) != 3:
        raise ValueError(f"plant.gravity is {scene.plant.gravity}, expected [x, y, z]")
    kind = scene.actuation.type
    if kind not in ACTUATIONS:
        raise ValueError(
            f"actuation.type is {kind!r}, expected one of {', '.join(ACTUATIONS)}"
        )
    for effect in scene.effects:
        if effect.kind not in KINDS:
            raise ValueError(
                f"effect kind {effect.kind!r} is unknown: {nearest(effect.kind, KINDS)}"
            )
        if not effect.at:
            raise ValueError(f"effect {effect.kind} needs `at`: where it acts")
        known = KINDS[effect.kind].parameters
        for name, value in effect.parameters.items():
            if name not in known:
                raise ValueError(
                    f"effect {effect.kind} has no parameter {name!r}: "
                    f"{nearest(name, known)}"
                )
            if not np.isfinite(value):
                raise ValueError(f"effect {effect.kind}: {name} is {value}")


def _parse(scene: Scene, plant: MultibodyPlant) -> None:
    """Adds the directives' models; inertia effects edit a copy of the model's text,
    as a body's default inertia can be given to Drake in no other way."""
    parser = Parser(plant)
    flat = FlattenModelDirectives(
        ModelDirectives(directives=scene.directives), parser.package_map()
    )
    with tempfile.TemporaryDirectory() as folder:
        for i, effect in enumerate(scene.effects):
            edit = KINDS[effect.kind].edit_text
            if edit is None:
                continue
            for at in effect.at:
                model, _, body = at.partition(".")
                for directive in flat.directives:
                    add = directive.add_model
                    if add is not None and add.name == model:
                        # A copy: the scene must stay as it was.
                        copy = Path(folder) / f"{i}_{model}"
                        add.file = edited_model_file(
                            add.file, parser.package_map(), body, effect, edit, copy
                        )
                        break
                else:
                    raise ValueError(
                        f"effect {effect.kind} at {at!r}: no model {model!r} is added"
                    )
        try:
            ProcessModelDirectives(flat, parser)
        except RuntimeError as error:
            raise ValueError(
                f"scene's directives: {' '.join(str(error).split())}"
            ) from None


def _set_initial(initial: InitialSection, plant: MultibodyPlant) -> None:
    for name, value in initial.positions.items():
        joint = _find(plant, name, "joint")
        joint.set_default_positions([value])
    for name, pose in initial.poses.items():
        if len(pose) != 7 or not abs(np.linalg.norm(pose[:4]) - 1.0) < 1e-3:
            raise ValueError(
                f"initial.poses of {name!r} is {pose}, expected 7 numbers "
                "[qw qx qy qz x y z] with a unit quaternion"
            )
        unit = np.array(pose[:4]) / np.linalg.norm(pose[:4])
        plant.SetDefaultFloatingBaseBodyPose(
            _find(plant, name, "body"), RigidTransform(Quaternion(unit), pose[4:])
        )


def _find(plant: MultibodyPlant, name: str, what: str):
    """The joint or body called `<model>.<name>`."""
    indices = plant.GetJointIndices if what == "joint" else plant.GetBodyIndices
    get = plant.get_joint if what == "joint" else plant.get_body
    named = {}
    for i in range(plant.num_model_instances()):
        instance = ModelInstanceIndex(i)
        for index in indices(instance):
            element = get(index)
            key = f"{plant.GetModelInstanceName(instance)}.{element.name()}"
            named[key] = element
    if name not in named:
        raise ValueError(f"no {what} {name!r} in the scene: {nearest(name, named)}")
    return named[name]

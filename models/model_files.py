"""Adds the models of a scene's directives to a plant: files, packages, inertias.

Checks what Drake would replace silently (impossible inertias) or abort on (directives
that include themselves).
"""

import logging
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    ModelDirective,
    ModelDirectives,
    PackageMap,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant

from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import (
    Effect,
    actuator_of,
    full_name,
    one_dof_joints,
)
from makebreak.models.effects.model_text import edited_model_file
from makebreak.models.fixed_joints import couplings_in, fix_joints
from makebreak.models.model_inertias import ModelText, mended
from makebreak.models.robot_file import (
    RobotFile,
    checked_inertias,
    is_robot,
    path_of,
    read_robot_file,
)
from makebreak.models.scene_schema import COMMANDS_OF, Scene
from makebreak.models.typed_yaml import one_line, read_yaml

MODELS = Path(__file__).resolve().parent  # Folder of the shipped models.
# pydrake raises SystemExit for a failed assertion in Drake, and ValueError for some
# errors of its parser.
DRAKE_ERRORS = (RuntimeError, SystemExit, ValueError)
_LOG = logging.getLogger("makebreak")
_INCLUDES_MAX = 20  # Depth of directives that include directives.


def add_models(scene: Scene, effects: Sequence[Effect], plant: MultibodyPlant) -> None:
    """Adds the directives' models. Inertia effects edit a copy of the model's text,
    because a body's default inertia cannot be changed otherwise.

    Raises: ValueError that names the file, package or link that is wrong.
    """
    parser = Parser(plant)
    packages = parser.package_map()
    _add_packages(scene, packages)
    flat = _flattened(scene.directives, packages)
    with tempfile.TemporaryDirectory() as folder:
        for i, directive in enumerate(flat.directives):
            add = directive.add_model
            if add is not None:
                add.file = _usable(add.file, packages, Path(folder) / f"{i}")
        _with_mended_inertias(flat, scene, packages)
        for i, effect in enumerate(effects):
            edit = KINDS[effect.kind].edit_text
            if edit is None:
                continue
            for at in effect.at:
                model, _, body = at.partition(".")
                for directive in flat.directives:
                    add = directive.add_model
                    if add is not None and add.name == model:
                        # A copy, as the scene must not change.
                        copy = Path(folder) / f"{i}_{model}"
                        add.file = edited_model_file(
                            add.file, packages, body, effect, edit, copy
                        )
                        break
                else:
                    raise ValueError(
                        f"effect {effect.kind} at {at!r}: no model {model!r} is added"
                    )
        _process(flat, parser)
    if scene.fixed_joints:
        _check_fixed_together(scene)
        fix_joints(plant, scene.fixed_joints, len(couplings_of(scene)))


def robot_files(scene: Scene) -> dict[str, RobotFile]:
    """{model: its file} of the models that come from files of robots."""
    packages, found = PackageMap(), {}
    _add_packages(scene, packages)
    for directive in _flattened(scene.directives, packages).directives:
        add = directive.add_model
        path = None if add is None else path_of(add.file, Path("/"), packages)
        if add is not None and path is not None and is_robot(path) and path.is_file():
            found[add.name] = read_robot_file(path, packages, bare=True)
    return found


def couplings_of(scene: Scene) -> dict[str, str]:
    """{<model>.<joint>: the one that it follows} of the models' files."""
    return {
        f"{model}.{joint}": f"{model}.{other}"
        for model, file in robot_files(scene).items()
        for joint, other in couplings_in(file.text).items()
    }


def with_what_files_say(scene: Scene) -> Scene:
    """The scene with what its models' files say of their joints and Drake keeps no
    place for, as effects: dry friction, rotors, springs; and with the positions of
    their first keyframe, where the scene has no initial state. What the scene itself
    says of a joint counts, and joints that do not move have none."""
    named = {(e.kind, at) for e in scene.effects for at in e.at}
    effects = list(scene.effects)
    home: dict[str, float] = {}
    for model, file in robot_files(scene).items():
        for effect in file.effects:
            at = f"{model}.{effect.at[0]}"
            is_said = {(effect.kind, at), (effect.kind, model)} & named
            if at not in scene.fixed_joints and not is_said:
                effects.append(replace(effect, at=[at]))
        home |= {f"{model}.{joint}": q for joint, q in file.home.items()}
    home = {joint: q for joint, q in home.items() if joint not in scene.fixed_joints}
    initial = scene.initial
    if home and not initial.positions and not scene.initial_of:
        initial = replace(initial, positions=home)
    return replace(scene, effects=effects, initial=initial)


def _check_fixed_together(scene: Scene) -> None:
    for joint, other in couplings_of(scene).items():
        if not {joint, other} <= set(scene.fixed_joints):
            raise ValueError(
                f"fixed_joints: {joint} follows {other} (mimic), so it needs both"
            )


def with_actuated_joints(scene: Scene) -> Scene:
    """The scene with the joints of its actuation filled in: if it names none, those
    with an actuator in the models' own files.

    Raises: ValueError if there are none; as add_models.
    """
    actuation = scene.actuation
    if actuation.joints or not COMMANDS_OF[actuation.type]:
        return scene
    plant = MultibodyPlant(0.0)
    add_models(scene, (), plant)
    joints = one_dof_joints(plant)
    driven = [full_name(plant, j) for j in joints if actuator_of(plant, j) is not None]
    if not driven:
        every = ", ".join(full_name(plant, joint) for joint in joints)
        raise ValueError(
            "actuation names no joints and the models have no actuators of their own: "
            + (f"add `joints: [{every}]` to it" if every else "no joint can be driven")
        )
    return replace(scene, actuation=replace(actuation, joints=driven))


def check_can_move(plant: MultibodyPlant) -> None:
    """Raises: ValueError that names a joint which moves no inertia."""
    context = plant.CreateDefaultContext()
    M = plant.CalcMassMatrix(context)
    if not M.size:
        return
    size = np.sqrt(np.maximum(np.diag(M), 0.0))
    names = _velocity_names(plant)
    if not (size > 0.0).all():
        raise ValueError(
            f"{names[int(np.argmin(size))]} moves nothing that has inertia: give the "
            "link behind it an <inertial> with mass and moments of inertia"
        )
    value, vector = np.linalg.eigh(M / np.outer(size, size))
    if not value[0] > 1e-13:
        raise ValueError(
            f"{names[int(np.argmax(np.abs(vector[:, 0])))]} can move against others "
            "without any inertia: a link between joints has none"
        )


def _velocity_names(plant: MultibodyPlant) -> list[str]:
    """Name of the joint or body of each velocity of the plant, for messages."""
    names = ["a joint"] * plant.num_velocities()
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        for k in range(joint.num_velocities()):
            names[joint.velocity_start() + k] = f"joint {full_name(plant, joint)}"
    for index in plant.GetFloatingBaseBodies():
        body = plant.get_body(index)
        start = body.floating_velocities_start_in_v()
        for k in range(6):
            names[start + k] = f"the free body {full_name(plant, body)}"
    return names


# ----- Packages and meshes


def _add_packages(scene: Scene, packages: PackageMap) -> None:
    for name, where in scene.packages.items():
        if not Path(where).is_dir():
            raise ValueError(f"packages.{name}: {where} is no folder")
        if packages.Contains(name):
            packages.Remove(name)
        packages.Add(name, where)


def _usable(uri: str, packages: PackageMap, copy: Path) -> str:
    """URI of a robot's file as Drake reads it (robot_file.py), written as a copy; of
    other files their own.

    Raises: ValueError for a collision mesh that is not there.
    """
    path = path_of(uri, Path("/"), packages)
    if path is None:
        raise _unknown_package(uri)
    if not is_robot(path):
        return uri
    file = read_robot_file(path, packages)
    for mesh, where in sorted(file.lost.items()):
        if where is None:
            raise _unknown_package(mesh, path)
        why = "cannot be read as a mesh" if where.is_file() else "does not exist"
        raise ValueError(f"{path}: {mesh} {why} ({where})")
    if file.path.suffix == ".xml" and file.left_out:
        raise ValueError(f"{path}: {file.left_out} meshes of its shapes are not there")
    lost = file.lost_visuals
    if lost:
        _warn_once(
            f"{path.name}: {file.visuals_left_out} visual meshes are left out, as they "
            f"are not there ({sorted(lost)[0]}{', ...' if len(lost) > 1 else ''})"
            + ("; --package NAME=PATH says where" if None in lost.values() else "")
        )
    copy.mkdir()
    target = copy / f"{path.stem}{file.suffix}"  # Errors name it.
    target.write_text(file.text)
    return f"file://{target}"


def without_lost_collisions(path: Path, given: Mapping[str, str]) -> RobotFile:
    """A robot's file without the collision meshes that are not there, for use where it
    touches nothing. given: {package: folder}."""
    packages = PackageMap()
    for name, where in given.items():
        packages.Add(name, where)
    return read_robot_file(path, packages, bare=True)


def _unknown_package(uri: str, path: Path | None = None) -> ValueError:
    name = uri.partition("://")[2].partition("/")[0]
    of = f"{path}: " if path else ""
    return ValueError(
        f"{of}{uri}: the package {name} is unknown; say where it is with "
        f"--package {name}=PATH, or in the scene: packages: {{{name}: PATH}}"
    )


@lru_cache(maxsize=256)
def _warn_once(message: str) -> None:
    _LOG.warning(message)


# ----- Directives


def _flattened(
    directives: Sequence[ModelDirective], packages: PackageMap
) -> ModelDirectives:
    for directive in directives:
        if directive.add_directives is not None:
            _check_includes(directive.add_directives.file, Path("/"), packages, ())
    try:
        return FlattenModelDirectives(
            ModelDirectives(directives=list(directives)), packages
        )
    except DRAKE_ERRORS as error:
        raise ValueError(f"scene's directives: {one_line(error)}") from None


def _check_includes(
    uri: str, near: Path, packages: PackageMap, above: tuple[Path, ...]
) -> None:
    """Raises: ValueError for directives that include themselves, at which Drake would
    overflow its stack."""
    path = path_of(uri, near, packages)
    if path is None:
        raise _unknown_package(uri)
    path = path.resolve()
    if path in above or len(above) >= _INCLUDES_MAX:
        chain = " -> ".join(each.name for each in (*above, path))
        raise ValueError(f"add_directives: {path} adds itself ({chain})")
    try:
        content = read_yaml(path)
    except ValueError as error:
        raise ValueError(f"add_directives: {path}: {one_line(error)}") from None
    listed = content.get("directives") if isinstance(content, dict) else None
    for each in listed if isinstance(listed, list) else ():
        part = each.get("add_directives") if isinstance(each, dict) else None
        if isinstance(part, dict) and isinstance(part.get("file"), str):
            _check_includes(part["file"], path, packages, (*above, path))


# ----- Inertias


def _with_mended_inertias(
    flat: ModelDirectives, scene: Scene, packages: PackageMap
) -> None:
    """Mends the copies of the models' texts, in place."""
    paths = {
        d.add_model.name: path_of(d.add_model.file, Path("/"), packages)
        for d in flat.directives if d.add_model is not None
    }  # fmt: skip
    texts = [
        ModelText(name, path.read_text()) for name, path in paths.items()
        if path is not None and path.suffix in (".urdf", ".sdf")
    ]  # fmt: skip

    def make_plant() -> MultibodyPlant:
        plant = MultibodyPlant(0.0)
        parser = Parser(plant)
        _add_packages(scene, parser.package_map())
        _process(flat, parser)
        fix_joints(plant, scene.fixed_joints, plant.num_constraints())
        plant.Finalize()
        return plant

    new, notes = mended(texts, make_plant)
    for before, after in zip(texts, new, strict=True):
        if after is not before:
            path = paths[after.name]
            assert path is not None
            path.write_text(after.text)
    for note in notes:
        _warn_once(note)


def _process(flat: ModelDirectives, parser: Parser) -> None:
    with checked_inertias():
        try:
            ProcessModelDirectives(flat, parser)
        except DRAKE_ERRORS as error:
            raise ValueError(f"scene's directives: {one_line(error)}") from None

"""Adds the models of a scene's directives to a plant: files, packages, inertias.

Checks what Drake would replace silently (impossible inertias), abort on (directives
that include themselves) or refuse without need (missing visual meshes).
"""

import logging
import re
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from xml.dom import minidom
from xml.parsers.expat import ExpatError

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
from makebreak.models.effects.model_text import (
    children,
    edited_model_file,
    make_mesh_paths_absolute,
    read_inertial,
    text,
)
from makebreak.models.fixed_joints import coupled_joints, fix_joints
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
                add.file = _usable(add.file, packages, Path(folder) / f"visual_{i}")
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
        with _drake_warnings() as warnings:
            try:
                ProcessModelDirectives(flat, parser)
            except DRAKE_ERRORS as error:
                raise ValueError(f"scene's directives: {one_line(error)}") from None
        _refuse_inertias(flat.directives, packages, warnings)
    if scene.fixed_joints:
        _check_fixed_together(scene)
        fix_joints(plant, scene.fixed_joints, len(couplings_of(scene)))


def couplings_of(scene: Scene) -> dict[str, str]:
    """{<model>.<joint>: the one that it follows} of the models' files."""
    packages = PackageMap()
    _add_packages(scene, packages)
    found: dict[str, str] = {}
    for directive in _flattened(scene.directives, packages).directives:
        add = directive.add_model
        path = None if add is None else _path_of(add.file, Path("/"), packages)
        if add is not None and path is not None:
            found |= {
                f"{add.name}.{joint}": f"{add.name}.{other}"
                for joint, other in coupled_joints(path).items()
            }
    return found


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


def _path_of(uri: str, near: Path, packages: PackageMap) -> Path | None:
    """The file of a URI as Drake reads it (no %20, and "#" is part of the name); None
    for an unknown package. Args: near: the file that contains the URI."""
    scheme, separator, rest = uri.partition("://")
    if not separator:
        return near.parent / uri
    if scheme not in ("package", "model"):
        return Path(rest)
    name, *inside = Path(rest).parts or ("",)
    if not packages.Contains(name):
        found = _package_above(name, near)
        if found is None:
            return None
        packages.Add(name, str(found))
    return Path(packages.GetPath(name)).joinpath(*inside)


def _package_above(name: str, near: Path) -> Path | None:
    """The folder above a file whose name, or whose package.xml, is the package's."""
    for folder in near.resolve().parents:
        manifest = folder / "package.xml"
        if folder.name == name or (
            manifest.is_file()
            and re.search(
                rf"<name>\s*{re.escape(name)}\s*</name>",
                manifest.read_text(errors="replace"),
            )
        ):
            return folder
    return None


_MESH = re.compile(r"""<mesh\b[^>]*?filename\s*=\s*["']([^"']+)|<uri>\s*([^<]+?)\s*<""")


def _usable(uri: str, packages: PackageMap, copy: Path) -> str:
    """URI of the model, or of a copy without its missing visual meshes.

    Raises: ValueError for other missing meshes.
    """
    path = _path_of(uri, Path("/"), packages)
    if path is None:
        raise _unknown_package(uri)
    if path.suffix.lower() not in (".urdf", ".sdf") or not path.is_file():
        return uri
    source = path.read_text(errors="replace")
    lost = _lost_meshes(source, path, packages)
    if not lost:
        return uri
    try:
        document = minidom.parseString(source.encode())
    except ExpatError:
        return uri  # Drake's own message is better.
    gone = _without_meshes(document, "visual", lost)
    left = {a or b for a, b in _MESH.findall(document.toxml())} & set(lost)
    for mesh in sorted(left):
        if lost[mesh] is None:
            raise _unknown_package(mesh, path)
        raise ValueError(f"{path}: {mesh} does not exist ({lost[mesh]})")
    _warn_once(
        f"{path.name}: {gone} visual meshes are left out, as they are not there "
        f"({sorted(lost)[0]}{', ...' if len(lost) > 1 else ''})"
        + ("; --package NAME=PATH says where" if None in lost.values() else "")
    )
    make_mesh_paths_absolute(document, path.parent)
    target = copy.with_suffix(path.suffix)
    target.write_text(document.toxml())
    return f"file://{target}"


def _lost_meshes(
    source: str, path: Path, packages: PackageMap
) -> dict[str, Path | None]:
    """{mesh of a file that is not there: where it should be; None: package unknown}."""
    lost = {}
    for mesh in {a or b for a, b in _MESH.findall(source)}:
        where = _path_of(mesh, path, packages)
        if where is None or not where.exists():
            lost[mesh] = where
    return lost


def _without_meshes(
    document: minidom.Document, kind: str, lost: Collection[str]
) -> int:
    """Takes out elements of a kind, visual or collision, that have one of these meshes.
    Returns: how many."""
    gone = []
    for element in document.getElementsByTagName(kind):
        shapes = children(element, "geometry", "mesh")
        names = [mesh.getAttribute("filename") for mesh in shapes]
        names += [text(uri).strip() for m in shapes for uri in children(m, "uri")]
        if any(name in lost for name in names):
            gone.append(element)
    for element in gone:
        assert element.parentNode is not None
        element.parentNode.removeChild(element)
    return len(gone)


def without_lost_collisions(path: Path, given: Mapping[str, str]) -> tuple[str, int]:
    """The text of a robot's file without the collision meshes that are not there, nor
    visual ones, for use where it touches nothing; and how many collision meshes are
    left out. given: {package: folder}."""
    source = path.read_text(errors="replace")
    packages = PackageMap()
    for name, where in given.items():
        packages.Add(name, where)
    lost = _lost_meshes(source, path, packages)
    if path.suffix.lower() not in (".urdf", ".sdf") or not lost:
        return source, 0
    try:
        document = minidom.parseString(source.encode())
    except ExpatError:
        return source, 0  # Drake's own message is better.
    gone = _without_meshes(document, "collision", lost)
    _without_meshes(document, "visual", lost)
    for element in document.getElementsByTagName("mesh"):  # Packages that were found.
        file = _path_of(element.getAttribute("filename"), path, packages)
        if element.getAttribute("filename") and file is not None:
            element.setAttribute("filename", f"file://{file.resolve()}")
    make_mesh_paths_absolute(document, path.parent)
    return document.toxml(), gone


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
    path = _path_of(uri, near, packages)
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


@contextmanager
def _drake_warnings() -> Iterator[list[str]]:
    """Collects Drake's warnings about inertias while it parses; others pass."""
    found: list[str] = []
    log = logging.getLogger("drake")

    def keep(record: logging.LogRecord) -> bool:
        message = record.getMessage()
        if "inertia" not in message.lower():
            return True
        found.append(one_line(ValueError(message)))
        return False

    log.addFilter(keep)
    try:
        yield found
    finally:
        log.removeFilter(keep)


def _refuse_inertias(
    directives: Sequence[ModelDirective], packages: PackageMap, warnings: list[str]
) -> None:
    """Raises: ValueError that names a link with an impossible inertia, which Drake
    would replace by another one."""
    if not warnings:
        return
    for directive in directives:
        add = directive.add_model
        path = None if add is None else _path_of(add.file, Path("/"), packages)
        if path is None or path.suffix.lower() not in (".urdf", ".sdf"):
            continue
        for link in minidom.parse(str(path)).getElementsByTagName("link"):
            fault = _fault(link)
            if fault:
                assert add is not None
                raise ValueError(
                    f"model {add.name}: link {link.getAttribute('name')!r} {fault}"
                )
    raise ValueError(f"a link's inertia is impossible: {warnings[0]}")


def _fault(link: minidom.Element) -> str:
    """What is wrong with a link's inertia; "" if nothing is."""
    if not children(link, "inertial", "mass"):
        return ""
    try:
        inertial = read_inertial(link)
    except ValueError:
        return ""
    if not inertial.mass >= 0.0:
        return f"has the mass {inertial.mass:g} [kg], expected >= 0"
    least, middle, greatest = np.linalg.eigvalsh(inertial.central)
    if inertial.mass == 0.0 and greatest > 0.0:
        return "has moments of inertia without a mass"
    if not (least >= 0.0 and least + middle >= greatest * (1.0 - 1e-9)):
        return (
            f"has the central moments of inertia {least:g}, {middle:g}, {greatest:g} "
            "[kg m2]: of no body is one negative, or more than the two others together"
        )
    return ""

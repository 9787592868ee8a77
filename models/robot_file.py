"""A robot's file as Drake can read it, whatever its format and meshes are.

xacro is expanded, MJCF compiled (mjcf.py), meshes become OBJ (meshes.py), visual meshes
that cannot be used are left out. What the file says and Drake keeps no place for is
handed on as effects (friction, rotors, springs); what nobody uses is a note.
"""

import logging
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.dom import expatbuilder, minidom
from xml.parsers.expat import ExpatError

import numpy as np
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import MultibodyPlant

from makebreak.models.effects.kind import Effect
from makebreak.models.effects.model_text import (
    children,
    make_mesh_paths_absolute,
    set_text,
    text,
)
from makebreak.models.meshes import READ_BY_DRAKE, as_obj
from makebreak.models.mjcf import FileDrive, plain_mjcf

ROBOTS = (".urdf", ".sdf", ".xml", ".xacro")
# Limits that only a controller of the robot's maker knows.
_WORDS_MAX = 30  # Kinds of words that an SDF may have of its own.
_UNUSED = {
    "safety_controller": "limits of the robot's own controller; motion is limited by "
    "<limit> alone",
    "calibration": "where the robot finds its zero; positions are taken as logged",
}


@dataclass(frozen=True, eq=False)
class RobotFile:
    """text: as Drake reads it, with the suffix. effects: of joints, by their names in
    the file. drives, home: of joints, {} where the file does not say them. limits: of
    joints' efforts [N m] or [N]. passive: joints that the file gives no drive, where it
    gives others one. notes: what
    nobody uses, and what that means. lost: {collision mesh that is not there, or cannot
    be read: where it should be, or None: its package is unknown}; lost_visuals: of
    meshes for display. left_out: collision shapes that text lacks. order, actuators,
    has_ground, frictions: of MJCF, as PlainMjcf has them."""

    path: Path
    text: str
    suffix: str
    effects: tuple[Effect, ...] = ()
    drives: Mapping[str, FileDrive] = field(default_factory=dict)
    home: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    passive: tuple[str, ...] = ()
    gravity: tuple[float, ...] = (0.0, 0.0, -9.81)
    notes: tuple[str, ...] = ()
    lost: Mapping[str, Path | None] = field(default_factory=dict)
    lost_visuals: Mapping[str, Path | None] = field(default_factory=dict)
    left_out: int = 0
    visuals_left_out: int = 0
    order: tuple[tuple[str, int], ...] = ()
    actuators: tuple[tuple[str, float], ...] = ()
    has_ground: bool = False
    frictions: tuple[tuple[str, str, float], ...] = ()


def is_robot(path: Path) -> bool:
    return path.suffix.lower() in ROBOTS


def read_robot_file(path: Path, packages: PackageMap, bare: bool = False) -> RobotFile:
    """Args: bare: without collision shapes whose meshes cannot be read.
    Raises: ValueError, one line, for a file that is not there or means nothing."""
    path = path.resolve()
    if not path.is_file():
        raise ValueError(f"robot {path} does not exist")
    # Drake's own stay out: it would download one to say where it is.
    own = {*PackageMap().GetPackageNames()}
    names = {*packages.GetPackageNames()} - own
    known = {name: packages.GetPath(name) for name in sorted(names)}
    surroundings = tuple(os.environ.get(name, "") for name in _PACKAGE_PATHS)
    found = _read(path, path.stat().st_mtime_ns, tuple(known.items()), surroundings)
    if bare and found.lost:
        return replace(found, text=_without_collisions(found), lost={})
    return found


@lru_cache(maxsize=64)
def _read(path: Path, changed: int, packages: tuple, surroundings: tuple) -> RobotFile:
    source = path.read_text(errors="replace")
    # A declaration stands first; other readers do not mind where it is.
    source = re.sub(r"<\?xml[^>]*\?>", "", source)
    if path.suffix.lower() == ".xacro" or _uses_xacro(source):
        source = _expanded(path, dict(packages))
    try:
        # Drake knows `drake:` without a declaration of it.
        document = expatbuilder.parseString(source.encode(), namespaces=False)
    except ExpatError as error:
        raise ValueError(f"robot {path} cannot be read: {error}") from None
    root = document.documentElement
    assert root is not None  # Of a document that could be read.
    if root.tagName == "mujoco":
        plain = plain_mjcf(path)
        named = re.sub(
            r'(<mujoco[^>]*\bmodel=")([^"]*)',
            lambda m: m[1] + plain_word(m[2]), plain.text, count=1,
        )  # fmt: skip
        return RobotFile(
            path, named, ".xml", plain.effects, plain.drives, plain.home,
            passive=plain.passive, gravity=plain.gravity, notes=plain.notes,
            left_out=plain.left_out, order=plain.order, actuators=plain.actuators,
            has_ground=plain.has_ground, frictions=plain.frictions,
        )  # fmt: skip
    suffix = {"robot": ".urdf", "sdf": ".sdf"}.get(root.tagName)
    if suffix is None:
        raise ValueError(
            f"{path}: its first element is <{root.tagName}>, expected <robot> (URDF), "
            "<sdf> or <mujoco>"
        )
    given = PackageMap()
    for name, where in packages:
        given.Add(name, where)
    return _of_document(document, path, suffix, given)


def plain_word(name: str) -> str:
    """A model's name as places of effects can have it, where a dot parts words."""
    return re.sub(r"\W", "_", name)


def _of_document(document: Any, path: Path, suffix: str, packages) -> RobotFile:
    if suffix == ".urdf" and not children(document.documentElement, "link"):
        raise ValueError(f"{path} has no <link>, so it describes no robot")
    if suffix == ".urdf":
        name = document.documentElement.getAttribute("name") or path.name.split(".")[0]
        document.documentElement.setAttribute("name", plain_word(name))
    flat = _without_flat_shapes(document)
    lost: dict[str, Path | None] = {}
    lost_visuals: dict[str, Path | None] = {}
    visuals = collisions = 0
    for kind, gone in (("visual", lost_visuals), ("collision", lost)):
        for element in document.getElementsByTagName(kind):
            for uri, write in _meshes(element):
                where = path_of(uri, path, packages)
                there = where if where is not None and where.is_file() else None
                if there is not None and kind == "visual":
                    if there.suffix in READ_BY_DRAKE:
                        write(f"file://{there.resolve()}")
                    else:
                        _remove(element)  # Drake draws no others.
                    continue
                if there is not None:
                    try:
                        write(f"file://{as_obj(there.resolve())}")
                        continue
                    except ValueError:  # It holds no mesh that can be read.
                        pass
                gone[uri] = where
                if kind == "visual":
                    visuals += 1
                    _remove(element)
                else:
                    collisions += 1
    make_mesh_paths_absolute(document, path.parent)
    notes = flat + _cleaned_mimics(document) + _unused(document)
    if suffix == ".urdf":
        notes += _cleaned_transmissions(document) + _without_commas(document)
        notes += _without_empty_limits(document)
        _clean_materials(document)
    else:
        notes += _as_gazebo_reads(document) + _without_undefined(document)
    effects, more = _of_joints(document)
    limits, passive = _drives(document)
    return RobotFile(
        path, document.toxml(), suffix, effects, limits=limits, passive=passive,
        notes=(*notes, *more),
        lost=lost, lost_visuals=lost_visuals, visuals_left_out=visuals,
        left_out=collisions,
    )  # fmt: skip


def _remove(element: minidom.Element) -> None:
    if element.parentNode is not None:
        element.parentNode.removeChild(element)


def _meshes(element: minidom.Element) -> Iterator[tuple]:
    """(URI, function that writes another one) of the meshes of a visual or collision,
    as elements say them: what a comment says is none."""
    for mesh in children(element, "geometry", "mesh"):
        if mesh.hasAttribute("filename"):
            yield (
                mesh.getAttribute("filename"),
                lambda uri, mesh=mesh: mesh.setAttribute("filename", uri),
            )
        for own in children(mesh, "uri"):
            yield text(own).strip(), lambda uri, own=own: set_text(own, uri)


def _without_flat_shapes(document: Any) -> list[str]:
    """Without cylinders, boxes and others of a size of 0, at which Drake stops."""
    gone = 0
    for kind in ("box", "cylinder", "capsule", "ellipsoid"):
        for shape in list(document.getElementsByTagName(kind)):
            sizes = [shape.getAttribute(name) for name in ("size", "radius", "length")]
            sizes += [text(own) for name in ("size", "radius", "length", "radii")
                      for own in children(shape, name)]  # fmt: skip
            if re.search(r"(^|\s)0*\.?0+(\s|$)", "  ".join(sizes)):
                _remove(shape.parentNode.parentNode)
                gone += 1
    return [f"{gone} shapes of a size of 0 are left out"] if gone else []


def _without_collisions(file: RobotFile) -> str:
    document = expatbuilder.parseString(file.text.encode(), namespaces=False)
    for element in document.getElementsByTagName("collision"):
        # Those that are there are files of the cache, or absolute paths.
        for uri, _ in _meshes(element):
            if not Path(uri.partition("://")[2] or uri).is_file():
                _remove(element)
    return document.toxml()


# ----- xacro


def _uses_xacro(source: str) -> bool:
    plain = re.sub(r"<!--.*?-->", "", source, flags=re.S)
    return "<xacro:" in plain or re.search(r"\$\((optenv|env|arg)\b", plain) is not None


def _expanded(path: Path, packages: Mapping[str, str]) -> str:
    """Raises: ValueError with xacro's own words."""
    import xacro
    from xacro import substitution_args

    def find(name: str) -> str:
        where = packages.get(name) or package_near(name, path, Path())
        if where is None:
            raise ValueError(
                f"the package {name} is unknown; say where it is with --package "
                f"{name}=PATH"
            )
        return str(where)

    before = substitution_args._eval_find
    substitution_args._eval_find = find  # It asks ROS, which need not be there.
    try:
        # A root may ask for an argument that only lines below declare.
        declared = re.findall(r"<xacro:arg\b[^>]*>", path.read_text())
        pairs = (dict(re.findall(r'(\w+)="([^"]*)"', each)) for each in declared)
        given = {x["name"]: x["default"] for x in pairs
                 if "name" in x and "$" not in x.get("default", "$")}  # fmt: skip
        return xacro.process_file(str(path), mappings=given).toxml()
    except Exception as error:  # It raises many types, of Python's too.
        why = " ".join(str(error).split())
        if "substitution argument" in why:  # One that has no default.
            why += f"; expand it first: xacro {path.name} ARG:=VALUE ... > robot.urdf"
        raise ValueError(f"{path}: xacro says: {why}") from None
    finally:
        substitution_args._eval_find = before


# ----- Packages

_PACKAGE_PATHS = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
_FOLDERS_MAX = 20000  # Looked at below ROS_PACKAGE_PATH.


def path_of(uri: str, near: Path, packages: PackageMap) -> Path | None:
    """The file of a URI as Drake reads it (no %20, and "#" is part of the name); None
    for an unknown package. Args: near: the file that contains the URI."""
    scheme, separator, rest = uri.partition("://")
    if not separator:
        return near.parent / uri
    if scheme not in ("package", "model"):
        return Path(rest)
    name, *inside = Path(rest).parts or ("",)
    if not packages.Contains(name):
        found = package_near(name, near, Path(*inside))
        if found is None:
            return None
        if not (found / Path(*inside)).exists() or found.name != name:
            # Good for this file; another one of the package may be elsewhere.
            return found / Path(*inside)
        packages.Add(name, str(found))
    return Path(packages.GetPath(name)).joinpath(*inside)


def package_near(name: str, near: Path, inside: Path) -> Path | None:
    """A package's folder: one above a file, or beside one above, whose name, or whose
    package.xml, is the package's; one of ROS's paths, or below a workspace's `src` or a
    checkout that the file is in; or, where the file of it is there, a folder above that
    bears another name. The first that has the file inside it, else the first."""
    first = None
    for folder in _candidates(name, near):
        if (folder / inside).exists():
            return folder
        first = first or folder
    if inside.parts:
        for folder in near.resolve().parents:
            if len(folder.parts) > 1 and (folder / inside).is_file():
                return folder
    return first


def _candidates(name: str, near: Path) -> Iterator[Path]:
    above = near.resolve().parents
    for folder in above:
        if folder.name == name or _is_package(folder, name):
            yield folder
    for folder in above:
        if name and len(folder.parts) > 1 and (folder / name).is_dir():
            yield folder / name
    for prefix in _listed("AMENT_PREFIX_PATH"):
        if (prefix / "share" / name).is_dir():
            yield prefix / "share" / name
    spaces = [f for f in above if f.name == "src" or (f / ".git").exists()]
    for root in (*_listed("ROS_PACKAGE_PATH"), *spaces):
        if root.name == name or _is_package(root, name):
            yield root
        looked = 0
        for where, folders, files in os.walk(root):
            looked += 1
            if looked > _FOLDERS_MAX:
                break
            folder = Path(where)
            if "package.xml" in files:
                folders.clear()  # Packages hold no packages.
                if folder.name == name or _is_package(folder, name):
                    yield folder
            elif folder.name == name:
                yield folder


def _listed(variable: str) -> list[Path]:
    return [Path(p) for p in os.environ.get(variable, "").split(os.pathsep) if p]


def _is_package(folder: Path, name: str) -> bool:
    manifest = folder / "package.xml"
    return manifest.is_file() and (
        re.search(
            rf"<name>\s*{re.escape(name)}\s*</name>",
            manifest.read_text(errors="replace"),
        )
        is not None
    )


# ----- What joints say


def _cleaned_mimics(document: minidom.Document) -> list[str]:
    """Takes out couplings that Drake stops at. Returns: what was, in words."""
    joints = {
        e.getAttribute("name"): e.getAttribute("type")
        for e in document.getElementsByTagName("joint")
        if e.hasAttribute("type")
    }
    notes = []
    for mimic in list(document.getElementsByTagName("mimic")):
        joint: Any = mimic.parentNode
        if joint.tagName == "axis":  # SDF
            joint = joint.parentNode
        name, other = joint.getAttribute("name"), mimic.getAttribute("joint")
        if other not in joints:
            notes.append(
                f"joint {name} follows {other}, which is no joint: it is taken as free"
            )
        elif "fixed" in (joints.get(name), joints[other]):
            notes.append(f"joint {name} follows {other}, and one of them is fixed")
        else:
            continue
        _remove(mimic)
    return notes


def _cleaned_transmissions(document: minidom.Document) -> list[str]:
    joints = {
        e.getAttribute("name")
        for e in document.getElementsByTagName("joint") if e.hasAttribute("type")
    }  # fmt: skip
    notes = []
    for transmission in list(document.getElementsByTagName("transmission")):
        for joint in children(transmission, "joint"):
            if (name := joint.getAttribute("name")) not in joints:
                notes.append(f"a transmission drives {name}, which is no joint")
                _remove(transmission)
    names = set[str]()
    for actuator in document.getElementsByTagName("actuator"):
        name = actuator.getAttribute("name")
        if name in names:  # As after copying a block; nothing asks for it.
            actuator.setAttribute("name", f"{name}_{len(names)}")
        names.add(actuator.getAttribute("name"))
    return notes


def _without_empty_limits(document: minidom.Document) -> list[str]:
    """Of joints whose lower limit is above the upper, which simulators take for none,
    or both 0, as exporters of CAD write what nobody filled in, and of continuous ones,
    which have none."""
    notes = []
    for limit in document.getElementsByTagName("limit"):
        try:
            low, high = (float(limit.getAttribute(k)) for k in ("lower", "upper"))
        except ValueError:
            continue
        joint: Any = limit.parentNode
        empty = low > high or low == high == 0.0
        if empty or joint.getAttribute("type") == "continuous":
            for key in ("lower", "upper"):
                limit.removeAttribute(key)
            kind, name = (joint.getAttribute(k) for k in ("type", "name"))
            notes.append(
                f"{kind} joint {name} has a lower limit of {low:g} and an upper one of "
                f"{high:g}: it is taken to have none"
            )
    return notes


_UNDEFINED = re.compile(
    r"XML (?:Element\[(\w+)\], child of|Attribute\[(\w+)\] in) element\[(\w+)\],? not"
)


def _without_undefined(document: minidom.Document) -> list[str]:
    """An SDF without words that SDF does not have, such as PyBullet's own, at which
    Drake stops: one kind after the other."""
    gone: list[str] = []
    while len(gone) < _WORDS_MAX:
        try:
            with checked_inertias():
                plant = MultibodyPlant(0.0)
                Parser(plant).AddModelsFromString(document.toxml(), "sdf")
        except RuntimeError as error:
            if (found := _UNDEFINED.search(str(error))) is None:
                break
        else:
            break
        name, mark, parent = found.groups()
        if mark == "relative_to":
            break  # Where something is may not change.
        for element in document.getElementsByTagName(parent):
            for own in children(element, name or ""):
                _remove(own)
            if mark and element.hasAttribute(mark):
                element.removeAttribute(mark)
        gone.append(f"<{name}> of <{parent}>" if name else f"{mark} of <{parent}>")
    return [f"{', '.join(gone)}: no words of SDF, which are left out"] if gone else []


def _as_gazebo_reads(document: minidom.Document) -> list[str]:
    """An SDF without what Gazebo or PyBullet do not mind and Drake stops at: joints
    with a link's name, scripts of materials, a link as the frame of its own inertia,
    and an empty link called world, which is the world."""
    notes = []
    for link in document.getElementsByTagName("link"):
        if link.getAttribute("name") == "world" and not children(link, "inertial"):
            _remove(link)
    links = {e.getAttribute("name") for e in document.getElementsByTagName("link")}
    for joint in document.getElementsByTagName("joint"):
        if (name := joint.getAttribute("name")) in links:
            joint.setAttribute("name", f"{name}_joint")
            notes.append(f"joint {name} has a link's name: it is called {name}_joint")
    for inertial in document.getElementsByTagName("inertial"):
        own: Any = inertial.parentNode
        for pose in children(inertial, "pose"):
            if pose.getAttribute("relative_to") == own.getAttribute("name"):
                pose.removeAttribute("relative_to")
    for material in document.getElementsByTagName("material"):
        for script in children(material, "script"):  # Gazebo's; colours stay.
            _remove(script)
    return notes


def _without_commas(document: minidom.Document) -> list[str]:
    """Numbers of a vector are parted by blanks; ROS reads those with commas, too."""
    n = 0
    for element in document.getElementsByTagName("*"):
        for key in ("xyz", "rpy", "size", "scale"):
            if "," in (value := element.getAttribute(key)):
                element.setAttribute(key, value.replace(",", " "))
                n += 1
    return [f"{n} vectors have commas, which are read as blanks"] if n else []


def _clean_materials(document: minidom.Document) -> None:
    """Keeps the first definition of each material: Drake stops at another one, and at
    a name that nothing defines."""
    known = set()
    materials = document.getElementsByTagName("material")
    for material in materials:
        name = material.getAttribute("name")
        if children(material, "color") and name and name not in known:
            known.add(name)
        elif material.hasChildNodes() and name in known:
            while material.firstChild is not None:
                material.removeChild(material.firstChild)
    for material in materials:
        if material.getAttribute("name") not in known:
            if not children(material, "color"):
                _remove(material)


def _drives(document: minidom.Document) -> tuple[dict[str, float], tuple[str, ...]]:
    """Effort limits of joints, and those that nothing drives: of which no transmission
    is, or of a limit of 0. Where that is all of them, nobody thought of it."""
    limits = {}
    joints = [e for e in document.getElementsByTagName("joint")
              if e.getAttribute("type") not in ("", "fixed")]  # fmt: skip
    for joint in joints:
        values = [e.getAttribute("effort") for e in children(joint, "limit")]
        values += [text(e) for e in children(joint, "axis", "limit", "effort")]
        try:
            limits[joint.getAttribute("name")] = float(values[0])
        except (IndexError, ValueError):
            continue
    drives = {
        joint.getAttribute("name")
        for transmission in document.getElementsByTagName("transmission")
        for joint in children(transmission, "joint")
    }
    names = [joint.getAttribute("name") for joint in joints]
    passive = tuple(
        n for n in names if limits.get(n) == 0.0 or drives and n not in drives
    )
    limits = {name: limit for name, limit in limits.items() if limit > 0.0}
    return limits, passive if len(passive) < len(names) else ()


def _unused(document: minidom.Document) -> list[str]:
    """One note for each kind of element that says nothing of the physics."""
    notes = []
    for tag, means in _UNUSED.items():
        found = document.getElementsByTagName(tag)
        if found:
            notes.append(f"{len(found)} <{tag}> are not used: {means}")
    return notes


def _of_joints(document: minidom.Document):
    """Effects of the joints' dry friction, and notes."""
    effects, gears, notes = [], {}, []
    for joint in document.getElementsByTagName("joint"):
        name, kind = joint.getAttribute("name"), joint.getAttribute("type")
        values = [e.getAttribute("friction") for e in children(joint, "dynamics")]
        values += [text(e) for e in children(joint, "axis", "dynamics", "friction")]
        for value in filter(None, (each.strip() for each in values)):
            try:
                friction = float(value)
            except ValueError:
                friction = np.nan
            if friction == 0.0 or kind == "fixed":
                continue
            if not friction > 0.0 or not np.isfinite(friction):
                notes.append(
                    f"joint {name}: a friction of {value} is not used, expected 0 or "
                    "more"
                )
            elif kind in ("revolute", "continuous", "prismatic"):
                effects.append(
                    Effect("joint_coulomb_friction", [name], {"coulomb": friction})
                )
            else:
                notes.append(
                    f"joint {name}: friction {value} of a {kind} joint is left out"
                )
    for transmission in document.getElementsByTagName("transmission"):
        for gear in transmission.getElementsByTagName("mechanicalReduction"):
            try:
                ratio = float(text(gear))
            except ValueError:
                continue
            for joint in children(transmission, "joint"):
                if ratio not in (0.0, 1.0):
                    gears[joint.getAttribute("name")] = ratio
    if gears:
        shown = ", ".join(f"{name} {gear:g}" for name, gear in [*gears.items()][:4])
        notes.append(
            f"mechanicalReduction of {shown}{', ...' if len(gears) > 4 else ''} is not "
            "used: positions and efforts are taken at the joint; of a log of the "
            "motor's side each sidecar entry needs the ratio as its scale"
        )
    return tuple(effects), notes


# ----- Drake's warnings

_TOLD = ("inertia", "'friction'", "mechanicalreduction", "unsupported and will be")


class _InertiasAreChecked(logging.Filter):
    """Keeps Drake's words about inertias back while it parses: model_inertias.py has
    looked at them before, and MuJoCo has at those of MJCF; and those about elements of
    which a note has told once what they mean."""

    def filter(self, record: logging.LogRecord) -> bool:
        message = record.getMessage().lower()
        return not any(word in message for word in _TOLD)


@contextmanager
def checked_inertias() -> Iterator[None]:
    log, quiet = logging.getLogger("drake"), _InertiasAreChecked()
    log.addFilter(quiet)
    try:
        yield
    finally:
        log.removeFilter(quiet)

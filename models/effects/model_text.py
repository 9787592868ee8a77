"""Edits of URDF, SDF and MJCF files, for properties that Drake reads only from a file.

Of an MJCF file, which is as mjcf.py writes it, only inertias can be edited.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.dom import expatbuilder, minidom

import numpy as np
from pydrake.math import RollPitchYaw
from pydrake.multibody.parsing import PackageMap

from makebreak.models.effects.kind import Effect


def edited_model_file(
    uri: str,
    package_map: PackageMap,
    body: str,
    effect: Effect,
    edit: Callable[[Effect, minidom.Element], None],
    copy: Path,
) -> str:
    """Writes a copy of a model file with one link edited.

    Args: uri: of the model; body: name of the link, or empty if there is only one;
        copy: path of the copy without its suffix.
    Returns: the copy's URI.
    Raises: ValueError if the file is none of URDF, SDF and MJCF, or has no such link.
    """
    path = model_path(uri, package_map)
    where = f"effect {effect.kind} at {effect.at}"
    if path.suffix not in (".urdf", ".sdf", ".xml"):
        raise ValueError(f"{where}: {path.name} is neither URDF nor SDF nor MJCF")
    # Keeps prefixes such as drake: as they are.
    document = expatbuilder.parse(str(path), namespaces=False)
    tag = "body" if path.suffix == ".xml" else "link"
    links = [x for x in document.getElementsByTagName(tag) if x.hasAttribute("name")]
    chosen = [
        link
        for link in links
        if link.getAttribute("name") == body or (not body and len(links) == 1)
    ]
    if len(chosen) != 1:
        names = ", ".join(link.getAttribute("name") for link in links)
        raise ValueError(f"{where}: expected one link of {path.name}: {names}")
    if tag == "body":
        _edit_mjcf(document, chosen[0], effect, edit)
    else:
        edit(effect, chosen[0])
    make_mesh_paths_absolute(document, path.parent)
    target = copy.with_suffix(path.suffix)
    target.write_text(document.toxml())
    return f"file://{target}"


def model_path(uri: str, package_map: PackageMap) -> Path:
    """Path of a file:// or package:// URI as Drake reads it: without %-escapes or
    fragments."""
    scheme, _, rest = uri.partition("://")
    path = Path(rest)
    if scheme == "package":
        package, *inside = path.parts
        path = Path(package_map.GetPath(package)).joinpath(*inside)
    return path


def _edit_mjcf(
    document: minidom.Document,
    body: minidom.Element,
    effect: Effect,
    edit: Callable[[Effect, minidom.Element], None],
) -> None:
    """Makes the edit to a body's `inertial`, which has a `fullinertia` (mjcf.py). Of
    its shapes the edit sees spheres."""
    if not children(body, "inertial"):
        name = body.getAttribute("name")
        raise ValueError(f"body {name!r} has no mass and inertia to change")
    (old,) = children(body, "inertial")
    com, full = (
        [float(x) for x in old.getAttribute(key).split()]
        for key in ("pos", "fullinertia")
    )
    link = _element(document, "link", name=body.getAttribute("name"))
    own = link.appendChild(_element(document, "inertial"))
    own.appendChild(_element(document, "mass", value=old.getAttribute("mass")))
    own.appendChild(_element(document, "origin", xyz=_numbers(com)))
    keys = (f"i{key}" for key in MOMENTS | PRODUCTS)
    moments = dict(zip(keys, map(repr, full), strict=True))
    own.appendChild(_element(document, "inertia", **moments))
    for geom in children(body, "geom"):
        if geom.getAttribute("type") == "sphere" and not geom.hasAttribute("contype"):
            shape = link.appendChild(_element(document, "collision"))
            shape = shape.appendChild(_element(document, "geometry"))
            radius = geom.getAttribute("size").split()[0]
            shape.appendChild(_element(document, "sphere", radius=radius))
    edit(effect, link)
    new = read_inertial(link)
    written = [new.central[i, j] for i, j in (MOMENTS | PRODUCTS).values()]
    old.setAttribute("pos", _numbers(new.com))
    old.setAttribute("mass", repr(new.mass))
    old.setAttribute("fullinertia", _numbers(written))


def _element(document: minidom.Document, tag: str, **attributes) -> minidom.Element:
    element = document.createElement(tag)
    for key, value in attributes.items():
        element.setAttribute(key, value)
    return element


def _numbers(values) -> str:
    return " ".join(repr(float(x)) for x in values)


def make_mesh_paths_absolute(document: minidom.Document, folder: Path) -> None:
    """Makes paths relative to `folder` absolute, so that the document can be moved."""
    for compiler in document.getElementsByTagName("compiler"):
        for key in ("meshdir", "texturedir", "assetdir"):
            if compiler.hasAttribute(key):
                where = (folder / compiler.getAttribute(key)).resolve()
                compiler.setAttribute(key, str(where))
    for element in document.getElementsByTagName("mesh"):
        file = element.getAttribute("file")
        beside = not any(
            compiler.hasAttribute(key)
            for compiler in document.getElementsByTagName("compiler")
            for key in ("meshdir", "assetdir")
        )
        if file and beside:
            element.setAttribute("file", str((folder / file).resolve()))
    for element in document.getElementsByTagName("uri"):
        uri = text(element).strip()
        if "://" not in uri:
            set_text(element, f"file://{(folder / uri).resolve()}")
    for element in document.getElementsByTagName("mesh"):
        uri = element.getAttribute("filename")
        if uri and "://" not in uri:
            element.setAttribute("filename", f"file://{(folder / uri).resolve()}")


def text(element: minidom.Element) -> str:
    """The element's own text, without that of its children."""
    return "".join(node.data for node in element.childNodes if hasattr(node, "data"))


def set_text(element: minidom.Element, value: str) -> None:
    while element.firstChild is not None:
        element.removeChild(element.firstChild)
    node = minidom.Text()
    node.data = value
    node.ownerDocument = element.ownerDocument
    element.appendChild(node)


def children(element: minidom.Element, *path: str) -> list[minidom.Element]:
    """The elements at a path of tag names below an element."""
    found = [element]
    for tag in path:
        found = [
            node
            for parent in found
            for node in parent.childNodes
            if isinstance(node, minidom.Element) and node.tagName == tag
        ]
    return found


def scale_inertia(link: minidom.Element, scale: float) -> None:
    """Scales a link about its frame's origin at constant mass: centre of mass times
    scale, moments of inertia times scale^2. Raises: ValueError without inertia."""
    inertias = children(link, "inertial", "inertia")
    if not inertias:
        raise ValueError(f"link {link.getAttribute('name')!r} has no inertia to scale")
    for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"):
        for element in children(inertias[0], key):  # SDF
            set_text(element, repr(float(text(element)) * scale**2))
        if inertias[0].hasAttribute(key):  # URDF
            value = float(inertias[0].getAttribute(key))
            inertias[0].setAttribute(key, repr(value * scale**2))
    for pose in children(link, "inertial", "pose"):
        set_text(pose, _scaled(text(pose), scale))
    for origin in children(link, "inertial", "origin"):
        origin.setAttribute("xyz", _scaled(origin.getAttribute("xyz"), scale))


def _scaled(numbers: str, scale: float) -> str:
    """Numbers of a pose, the first three (the translation) times scale."""
    values = [float(x) for x in numbers.split()]
    return " ".join(repr(scale * x if i < 3 else x) for i, x in enumerate(values))


@dataclass
class Inertial:
    """A link's inertia: mass [kg], com (3,) [m] in the link's frame, central (3, 3)
    about the centre of mass in the link's axes [kg m2]."""

    mass: float
    com: np.ndarray
    central: np.ndarray


MOMENTS = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2)}
PRODUCTS = {"xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}


def _state_sdf_defaults(link: minidom.Element) -> None:
    """Writes down what an SDF file leaves out: 1 kg, moments of 1 kg m2."""
    document: Any = link.ownerDocument
    if document.documentElement.tagName != "sdf":
        return
    ones = {f"i{key}": "1" for key in MOMENTS}
    for parents, tags in (
        ((), {"inertial": ""}),
        (("inertial",), {"mass": "1", "inertia": ""}),
        (("inertial", "inertia"), ones),
    ):
        parent = children(link, *parents)[0] if parents else link
        for tag, value in tags.items():
            if not children(parent, tag):
                set_text(parent.appendChild(_element(document, tag)), value)


def read_inertial(link: minidom.Element) -> Inertial:
    """The inertia of a link element; what SDF has for want of one is written into it.

    Raises: ValueError if mass or inertia is missing, or if the inertial pose has
        attributes other than its six numbers in radians.
    """
    _state_sdf_defaults(link)
    name = link.getAttribute("name")
    inertia = children(link, "inertial", "inertia")
    mass = children(link, "inertial", "mass")
    if not inertia or not mass:
        raise ValueError(f"link {name!r} has no mass and inertia to change")
    m = mass[0].getAttribute("value") or text(mass[0])
    I_S = np.zeros((3, 3))
    for key, (i, j) in (MOMENTS | PRODUCTS).items():
        value = inertia[0].getAttribute(f"i{key}")
        for element in children(inertia[0], f"i{key}"):
            value = text(element)
        I_S[i, j] = I_S[j, i] = float(value or 0.0)
    pose = np.zeros(6)
    for element in children(link, "inertial", "pose"):
        if any(element.hasAttribute(a) for a in ("relative_to", "rotation_format")) or (
            element.getAttribute("degrees") == "true"
        ):
            raise ValueError(
                f"link {name!r}: its inertial pose has attributes; expected six "
                "numbers x y z roll pitch yaw in the link's frame"
            )
        pose = np.array([float(x) for x in text(element).split()])
    for element in children(link, "inertial", "origin"):
        for at, key in ((0, "xyz"), (3, "rpy")):
            if element.hasAttribute(key):
                pose[at : at + 3] = [
                    float(x) for x in element.getAttribute(key).split()
                ]
    R = RollPitchYaw(*pose[3:]).ToRotationMatrix().matrix()
    return Inertial(float(m), pose[:3], R @ I_S @ R.T)


def write_inertial(link: minidom.Element, inertial: Inertial) -> None:
    """Writes an inertia into a link element, with the inertial frame along the link's.

    Raises: ValueError for an unphysical inertia, which Drake would replace by another.
    """
    least, middle, greatest = np.linalg.eigvalsh(inertial.central)
    slack = 1e-9 * abs(greatest) + 1e-15  # Rounding, and nothing [kg m2].
    if not (least >= -slack and least + middle >= greatest - slack):
        raise ValueError(
            f"link {link.getAttribute('name')!r}: no body has the central moments of "
            f"inertia {least:g}, {middle:g}, {greatest:g} [kg m2]"
        )
    mass = children(link, "inertial", "mass")[0]
    if mass.hasAttribute("value"):
        mass.setAttribute("value", repr(inertial.mass))
    else:
        set_text(mass, repr(inertial.mass))
    inertia = children(link, "inertial", "inertia")[0]
    for key, (i, j) in (MOMENTS | PRODUCTS).items():
        value = repr(float(inertial.central[i, j]))
        elements = children(inertia, f"i{key}")
        for element in elements:
            set_text(element, value)
        if not elements and not inertia.hasChildNodes():
            inertia.setAttribute(f"i{key}", value)
        elif not elements:  # SDF may omit products of inertia.
            element = minidom.Document().createElement(f"i{key}")
            element.ownerDocument = link.ownerDocument
            inertia.appendChild(element)
            set_text(element, value)
    com = _numbers(inertial.com)
    is_urdf = mass.hasAttribute("value")
    tag = "origin" if is_urdf else "pose"
    places = children(link, "inertial", tag)
    if not places:
        place = minidom.Document().createElement(tag)
        place.ownerDocument = link.ownerDocument
        children(link, "inertial")[0].appendChild(place)
        places = [place]
    if is_urdf:
        places[0].setAttribute("xyz", com)
        places[0].setAttribute("rpy", "0 0 0")
    else:
        set_text(places[0], f"{com} 0 0 0")

"""Edits of a model's URDF or SDF text: what Drake can take only from a file."""

from collections.abc import Callable
from pathlib import Path
from xml.dom import minidom

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

    Args: uri, of the model; body, name of the link, may be empty if there is but one;
        copy, path of the copy without the suffix.
    Returns: the copy's URI.
    Raises: ValueError if the file is neither URDF nor SDF, or has no such link.
    """
    # As Drake reads it: no %20, and "#" is part of the name.
    scheme, _, rest = uri.partition("://")
    path = Path(rest)
    if scheme == "package":
        package, *inside = path.parts
        path = Path(package_map.GetPath(package)).joinpath(*inside)
    where = f"effect {effect.kind} at {effect.at}"
    if path.suffix not in (".urdf", ".sdf"):
        raise ValueError(f"{where}: {path.name} is neither URDF nor SDF")
    document = minidom.parse(str(path))  # It keeps prefixes, as in drake:..., as is.
    links = [x for x in document.getElementsByTagName("link") if x.hasAttribute("name")]
    chosen = [
        link
        for link in links
        if link.getAttribute("name") == body or (not body and len(links) == 1)
    ]
    if len(chosen) != 1:
        names = ", ".join(link.getAttribute("name") for link in links)
        raise ValueError(f"{where}: expected one link of {path.name}: {names}")
    edit(effect, chosen[0])
    # Meshes stay where they are, the copy does not.
    for element in document.getElementsByTagName("uri"):
        uri = text(element)
        if "://" not in uri:
            set_text(element, f"file://{(path.parent / uri).resolve()}")
    for element in document.getElementsByTagName("mesh"):
        uri = element.getAttribute("filename")
        if uri and "://" not in uri:
            element.setAttribute("filename", f"file://{(path.parent / uri).resolve()}")
    target = copy.with_suffix(path.suffix)
    target.write_text(document.toxml())
    return f"file://{target}"


def text(element: minidom.Element) -> str:
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
    """The link's mass stays; it is spread `scale` times as far: centre of mass times
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
    """The first three numbers times scale, the others as they are."""
    values = [float(x) for x in numbers.split()]
    return " ".join(repr(scale * x if i < 3 else x) for i, x in enumerate(values))

"""Inertias that no body has, in a model's file: which matter, and what may stand there.

What moves together counts together: a light dummy link, or a camera's, that is fixed to
a trunk may have any numbers, if those of the whole are a body's. So its moments are
counted with the link that it is fixed to. What is fixed to the world counts nowhere.
Moments that are a body's but for less than they are ever known to are taken as such.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from xml.dom import expatbuilder, minidom

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from makebreak.models.effects.model_text import (
    Inertial,
    children,
    read_inertial,
    write_inertial,
)

ROUNDING = 1e-9  # Of the largest moment.
NOTHING = 1e-15  # [kg m2] A gram at a micrometre: less is rounding, too.
KNOWN_TO = 0.05  # Of the largest moment: CAD models without cables and grease.
LEAST = 1e-3  # Of the largest part of a repaired inertia: no rounding undoes it.


@dataclass(frozen=True)
class ModelText:
    """A URDF or SDF. name: of its model in the plant."""

    name: str
    text: str


def mended(
    models: list[ModelText], make_plant: Callable[[], MultibodyPlant]
) -> tuple[list[ModelText], list[str]]:
    """The texts with inertias that Drake takes as they are meant, and what was done,
    in words. make_plant: a finalized plant of the models as they are.

    Raises: ValueError that names every link whose inertia is impossible and matters.
    """
    faults = [faults_of(model.text) for model in models]
    if not any(faults):
        return models, []
    plant = make_plant()
    context = plant.CreateDefaultContext()
    done: list[ModelText] = []
    notes: list[str] = []
    defects: list[str] = []
    for model, own in zip(models, faults, strict=True):
        document = _parsed(model.text)
        links = _links(document)
        instance = plant.GetModelInstanceByName(model.name)
        for name, fault in own.items():
            inertial = read_inertial(links[name])
            if not fault:
                central = nearest_physical(inertial.central, 0.0)
                write_inertial(links[name], replace(inertial, central=central))
                continue
            is_world = name == "world"  # Drake has one, of no model.
            body = (
                plant.world_body() if is_world else plant.GetBodyByName(name, instance)
            )
            group = plant.GetBodiesWeldedTo(body)
            empty = replace(inertial, mass=max(inertial.mass, 0.0),
                            central=np.zeros((3, 3)))  # fmt: skip
            if any(each.index() == plant.world_body().index() for each in group):
                write_inertial(links[name], empty)
                notes.append(f"link {name} {fault}; it does not move, so none is used")
                continue
            others = [
                each for each in group
                if each.model_instance() == instance and each.name() in links
                and each.name() not in own and each.default_mass() > 0.0
            ]  # fmt: skip
            moved = False
            if others and inertial.mass >= 0.0:
                heavy = max(others, key=lambda each: each.default_mass())
                R = plant.CalcRelativeTransform(
                    context, heavy.body_frame(), body.body_frame()
                ).rotation()
                R = R.matrix()
                whole = read_inertial(links[heavy.name()])
                central = whole.central + R @ inertial.central @ R.T
                if not fault_of(replace(whole, central=central)):
                    write_inertial(links[heavy.name()], replace(whole, central=central))
                    write_inertial(links[name], empty)
                    notes.append(
                        f"link {name} {fault}; its moments are counted with link "
                        f"{heavy.name()}, which it is fixed to"
                    )
                    moved = True
            near = nearest_physical(inertial.central)
            off = np.abs(near - inertial.central).max()
            largest = np.abs(inertial.central).max()
            if not moved and inertial.mass > 0.0 and off < KNOWN_TO * largest:
                write_inertial(links[name], replace(inertial, central=near))
                notes.append(
                    f"link {name} {fault}; taken as {_moments(near)}, which is "
                    f"{off / largest:.1%} of the largest off"
                )
            elif not moved:
                defects.append(f"link {name!r} {fault}")
        if defects:
            raise ValueError(
                f"model {model.name}: {'; '.join(defects)}. `makebreak inspect ROBOT "
                "--repair` proposes inertias"
            )
        done.append(ModelText(model.name, document.toxml()))
    return done, notes


@lru_cache(maxsize=64)
def faults_of(text: str) -> dict[str, str]:
    """{link: what is wrong with its inertia, or "" of a mere rounding}."""
    found = {}
    for name, link in _links(_parsed(text)).items():
        if not children(link, "inertial", "mass"):
            continue
        try:
            inertial = read_inertial(link)
        except ValueError:
            continue
        fault = fault_of(inertial)
        if fault or np.linalg.eigvalsh(_spread(inertial.central))[0] < 0.0:
            found[name] = fault
    return found


def fault_of(inertial: Inertial) -> str:
    """What is wrong with an inertia; "" if nothing is, but for rounding."""
    if not np.isfinite([inertial.mass, *np.ravel(inertial.central)]).all():
        return "has an inertia that is no number"
    if not inertial.mass >= 0.0:
        return f"has the mass {inertial.mass:g} [kg], expected >= 0"
    least, middle, greatest = np.linalg.eigvalsh(inertial.central)
    if inertial.mass == 0.0 and greatest > NOTHING:
        return "has moments of inertia without a mass"
    slack = ROUNDING * abs(greatest) + NOTHING
    if not (least >= -slack and least + middle >= greatest - slack):
        return (
            f"has the central moments of inertia {least:g}, {middle:g}, {greatest:g} "
            "[kg m2]: of no body is one negative, or more than the two others together"
        )
    return ""


def _spread(central: np.ndarray) -> np.ndarray:
    """(3, 3) second moment of the mass about its centre [kg m2]: positive where the
    moments of inertia are a body's (Wensing et al., RA-L 3(1), 2018, eq. 12)."""
    return 0.5 * np.trace(central) * np.eye(3) - central


def nearest_physical(central: np.ndarray, least: float = LEAST) -> np.ndarray:
    """The (3, 3) inertia of a body whose spread of mass is that of `central` where it
    is positive. least: of the largest spread, that all others have at least."""
    value, vector = np.linalg.eigh(_spread(central))
    value = np.maximum(value, least * max(value[-1], 0.0))
    spread = vector @ np.diag(value) @ vector.T
    return np.trace(spread) * np.eye(3) - spread


def repaired(text: str) -> tuple[str, list[str]]:
    """A text with inertias of bodies where it has others, and what was changed."""
    document, changed = _parsed(text), []
    links = _links(document)
    for name, fault in faults_of(text).items():
        inertial = read_inertial(links[name])
        central = nearest_physical(inertial.central)
        if not fault or not np.isfinite(central).all() or inertial.mass < 0.0:
            if fault:
                changed.append(f"link {name!r} {fault}: not repaired, measure it")
            continue
        if inertial.mass == 0.0:
            central = np.zeros((3, 3))
        write_inertial(links[name], replace(inertial, central=central))
        changed.append(f"link {name!r} {fault}; proposed: {_moments(central)}")
    return document.toxml(), changed


def _moments(central: np.ndarray) -> str:
    return ", ".join(f"{x:g}" for x in np.linalg.eigvalsh(central))


def _parsed(text: str) -> minidom.Document:
    return expatbuilder.parseString(text.encode(), namespaces=False)


def _links(document: minidom.Document) -> dict[str, minidom.Element]:
    return {
        link.getAttribute("name"): link
        for link in document.getElementsByTagName("link")
        if link.hasAttribute("name")
    }

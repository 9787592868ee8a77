"""Worlds of the changing-contact experiments: what stands on the table, and where.

A world is read from a scene file and then changed in memory: these functions take the
scene that was read and change it in place.
"""

from pathlib import Path

import numpy as np

from makebreak.models.effects.kind import Effect
from makebreak.models.friction_zones import FrictionZone
from makebreak.models.scene import Scene
from makebreak.models.typed_yaml import nearest

MODELS = Path(__file__).resolve().parent.parent / "models"
TABLETOP_WALLS = str(MODELS / "tabletop_walls.scene.yaml")
THREE_SURFACES = str(MODELS / "three_surfaces.scene.yaml")
SURFACE_SWITCH = str(MODELS / "surface_switch.scene.yaml")
TOOL = "tool"  # The model instance in each of them.

# The file of each tool, and the distance [m] from its tip to what it touches, straight
# down and straight to the sides.
TOOLS = {"block": ("block.sdf", 0.015), "sphere": ("sphere_tool.sdf", 0.02)}
FRICTION_MAX = 1.8  # A surface reaches 2 with none of its own left to give.


def _known_tool(tool: str) -> tuple[str, float]:
    if tool not in TOOLS:
        raise ValueError(f"tool is {tool!r}: {nearest(tool, TOOLS)}")
    return TOOLS[tool]


def tool_half_width(tool: str) -> float:
    """From the tip to what it touches, straight down or to a side [m].

    Raises: ValueError if there is no such tool.
    """
    return _known_tool(tool)[1]


def set_tool(scene: Scene, tool: str) -> None:
    """Mounts the block or the sphere.

    Raises: ValueError if there is no such tool, or no model `tool` in the scene.
    """
    file, _ = _known_tool(tool)
    for directive in scene.directives:
        add = directive.add_model
        if add is not None and add.name == TOOL:
            add.file = f"file://{MODELS / file}"
            return
    raise ValueError(f"the scene has no model {TOOL!r} to be replaced")


def objects(scene: Scene) -> list[str]:
    """Names of the models that are welded to the world, but for the arm."""
    return [
        weld.child.split("::")[0]
        for weld in (d.add_weld for d in scene.directives)
        if weld is not None and weld.parent == "world" and weld.X_PC is not None
    ]


def _weld(scene: Scene, name: str):
    for directive in scene.directives:
        weld = directive.add_weld
        if (
            weld is not None
            and weld.parent == "world"
            and weld.X_PC is not None
            and weld.child.split("::")[0] == name
        ):
            return weld
    raise ValueError(
        f"no object {name!r} in the scene: {nearest(name, objects(scene))}"
    )


def position(scene: Scene, name: str) -> np.ndarray:
    """Where an object's origin is in the world, (3,) [m].

    Raises: ValueError if there is no such object.
    """
    return np.array(_weld(scene, name).X_PC.translation, dtype=float)


def move(scene: Scene, name: str, by) -> None:
    """Moves an object by (3,) [m] in the world.

    Raises: ValueError if there is no such object, or `by` is not three numbers.
    """
    by = np.asarray(by, dtype=float)
    if by.shape != (3,) or not np.all(np.isfinite(by)):
        raise ValueError(f"{name} is to be moved by {by}, expected 3 numbers [m]")
    weld = _weld(scene, name)
    weld.X_PC.translation = list(position(scene, name) + by)


def set_friction(scene: Scene, friction: dict[str, float]) -> None:
    """Gives each named object its coefficient of friction with the tool.

    Drake combines two surfaces to 2 m1 m2/(m1 + m2). The tool has m1 = 1, so an object
    is given m2 = m/(2 - m): any m below 2 can be had. Objects not named keep 0.3.

    Raises: ValueError if there is no such object, or a value is not from 0 to 1.8.
    """
    for name, value in friction.items():
        _weld(scene, name)
        if not 0.0 <= value <= FRICTION_MAX:
            raise ValueError(
                f"friction of {name} is {value}, expected 0 to {FRICTION_MAX}"
            )
        # The object first: the effect changes the first one's surface.
        scene.effects.append(
            Effect("contact_friction", [f"{name}~{TOOL}"], {"friction": float(value)})
        )


def set_friction_by_place(
    scene: Scene, name: str, friction: list[float], areas: list[FrictionZone]
) -> None:
    """Gives one flat object a friction with the tool that depends on the place.

    Args: friction: of each area; areas: FrictionZones of which x and y count, and
        which cover the object. The smallest friction becomes the object's own.
    Raises: ValueError as set_friction.
    """
    least = float(min(friction))
    set_friction(scene, {name: least})
    for value, area in zip(friction, areas, strict=True):
        if not value <= FRICTION_MAX:
            raise ValueError(
                f"friction of {name} is {value}, expected 0 to {FRICTION_MAX}"
            )
        if value > least:
            scene.friction_zones.append(
                FrictionZone(f"{name}~{TOOL}", float(value), area.x, area.y)
            )

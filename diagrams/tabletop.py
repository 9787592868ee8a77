"""The worlds of the changing-contact experiments: objects on a table and the tool.

A world is read from a scene file; these functions then change that scene in place.
"""

import numpy as np
from scipy.optimize import brentq

from makebreak.models.effects.kind import Effect
from makebreak.models.friction_zones import FrictionZone
from makebreak.models.model_files import MODELS
from makebreak.models.scene import Scene, read_scene
from makebreak.models.typed_yaml import nearest

TABLETOP_WALLS = str(MODELS / "tabletop_walls.scene.yaml")
THREE_SURFACES = str(MODELS / "three_surfaces.scene.yaml")
SURFACE_SWITCH = str(MODELS / "surface_switch.scene.yaml")
TOOL = "tool"  # Name of the tool's model instance in each of them.

# File of each tool, and the distance from its tip to its surface, straight down and to
# the sides [m].
TOOLS = {"block": ("block.sdf", 0.015), "sphere": ("sphere_tool.sdf", 0.02)}
# Number of contact points on which a tool stands.
POINTS = {"block": 4, "sphere": 1}
SURFACE_STIFFNESS = 4e4  # Of every surface in the model files [N/m].
# Stiffness of a tool against a surface [N/m]; controllers know the largest one.
STIFFNESS_RANGE = (5e3, 2e5)
SPREAD = 0.05  # Largest displacement of the surfaces [m].
# Drake's combination 2 m1 m2/(m1 + m2) with the tool's m1 = 1 stays below 2.
FRICTION_MAX = 1.8


def _known_tool(tool: str) -> tuple[str, float]:
    """File and half width [m] of a tool. Raises: ValueError."""
    if tool not in TOOLS:
        raise ValueError(f"tool is {tool!r}: {nearest(tool, TOOLS)}")
    return TOOLS[tool]


def read_model(path: str, shipped: str, tool: str) -> Scene:
    """The scene of the controllers' model: the file, with the tool on the arm.

    Args: path: of a scene file; "": the shipped one.
    Raises: ValueError for an unknown tool, or an object of the shipped scene that the
        file lacks.
    """
    model = read_scene(path or shipped)
    set_tool(model, tool)
    for name in objects(read_scene(shipped)):
        position(model, name)  # Raises if it is not there.
    return model


def tool_half_width(tool: str) -> float:
    """Distance from the tip to the tool's surface, straight down or to a side [m].

    Raises: ValueError for an unknown tool.
    """
    return _known_tool(tool)[1]


def tool_corner(tool: str) -> float:
    """Distance from the tip to the tool's corners, in x and in y [m]; 0: no corners.

    Raises: ValueError for an unknown tool.
    """
    return tool_half_width(tool) if POINTS[tool] > 1 else 0.0


def check_spread(spread: float) -> None:
    """Raises: ValueError for a displacement of surfaces that is out of range [m]."""
    if not 0.0 <= spread <= SPREAD:
        raise ValueError(f"spread is {spread}, expected 0 to {SPREAD} m")


def set_tool(scene: Scene, tool: str) -> None:
    """Mounts the block or the sphere on the arm.

    Raises: ValueError for an unknown tool, or a scene without a model `tool`.
    """
    file, _ = _known_tool(tool)
    for directive in scene.directives:
        add = directive.add_model
        if add is not None and add.name == TOOL:
            add.file = f"file://{MODELS / file}"
            return
    raise ValueError(f"the scene has no model {TOOL!r} to be replaced")


def objects(scene: Scene) -> list[str]:
    """Names of the models that are welded to the world, without the arm."""
    return [
        weld.child.split("::")[0]
        for weld in (d.add_weld for d in scene.directives)
        if weld is not None and weld.parent == "world" and weld.X_PC is not None
    ]


def _weld(scene: Scene, name: str):
    """The directive that welds an object to the world. Raises: ValueError."""
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
    """Position of an object's origin in the world (3,) [m].

    Raises: ValueError for an unknown object.
    """
    return np.array(_weld(scene, name).X_PC.translation, dtype=float)


def move(scene: Scene, name: str, by) -> None:
    """Moves an object by (3,) [m] in the world.

    Raises: ValueError for an unknown object, or unless `by` is three numbers.
    """
    by = np.asarray(by, dtype=float)
    if by.shape != (3,) or not np.all(np.isfinite(by)):
        raise ValueError(f"{name} is to be moved by {by}, expected 3 numbers [m]")
    weld = _weld(scene, name)
    weld.X_PC.translation = list(position(scene, name) + by)


def frictions(given: list[float], drawn: np.ndarray) -> np.ndarray:
    """The given frictions, or the drawn ones if none are given.

    Raises: ValueError for another number of them.
    """
    if given and len(given) != len(drawn):
        raise ValueError(f"friction is {given}, expected {len(drawn)} numbers")
    return np.array(given, dtype=float) if given else drawn


def set_friction(scene: Scene, friction: dict[str, float]) -> None:
    """Sets the coefficients of friction between objects and the tool, {name: value}.

    Drake combines two surfaces to m = 2 m1 m2/(m1 + m2). The tool has m1 = 1, so the
    object gets m2 = m/(2 - m), for any m below 2. Other objects keep 0.3.

    Raises: ValueError for an unknown object, or a value that is not from 0 to 1.8.
    """
    for name, value in friction.items():
        _weld(scene, name)
        if not 0.0 <= value <= FRICTION_MAX:
            raise ValueError(
                f"friction of {name} is {value}, expected 0 to {FRICTION_MAX}"
            )
        # The object first: the effect changes the surface of the first one.
        scene.effects.append(
            Effect("contact_friction", [f"{name}~{TOOL}"], {"friction": float(value)})
        )


def draw_stiffness(rng: np.random.Generator, names, span) -> dict[str, float]:
    """A stiffness for each of the names, log-uniform in span (2,) [N/m].

    Raises: ValueError for a span that is not 0 < low <= high.
    """
    if len(span) != 2 or not 0.0 < span[0] <= span[1] < np.inf:
        raise ValueError(f"stiffness is {span}, expected two numbers, 0 < low <= high")
    low, high = np.log(span)
    draw = np.exp(rng.uniform(low, high, size=len(names)))
    return dict(zip(names, draw.tolist(), strict=True))


def set_stiffness(scene: Scene, tool: str, stiffness: dict[str, float]) -> None:
    """Sets the stiffness of contact between objects and the tool, {name: [N/m]}, of all
    contact points of the tool together.

    The effect contact_stiffness scales both surfaces of a pair, so each pair also
    changes the tool's. The effects' values are computed so that every pair has its
    stiffness after the last effect.

    Args: tool: its name in TOOLS.
    Raises: ValueError for an unknown object or tool, or a stiffness that is not
        positive.
    """
    _known_tool(tool)
    for name, value in stiffness.items():
        _weld(scene, name)
        if not 0.0 < value < np.inf:
            raise ValueError(
                f"stiffness of {name} is {value}, expected a positive number [N/m]"
            )
    k = np.array(list(stiffness.values())) / POINTS[tool]

    def scale(log_tool):  # Of each object's surface, for this final one of the tool.
        end = np.exp(log_tool)
        return k * end / ((end - k) * SURFACE_STIFFNESS)

    def excess(log_tool):
        return np.log(scale(log_tool)).sum() - log_tool + np.log(SURFACE_STIFFNESS)

    least, most = np.log(k.max()) + 1e-9, np.log(1e3 * k.max())
    while excess(most) > 0.0:
        most += 1.0
    tool_now = SURFACE_STIFFNESS
    for name, factor in zip(stiffness, scale(brentq(excess, least, most)), strict=True):
        tool_now = factor * tool_now
        surface = factor * SURFACE_STIFFNESS
        pair = tool_now * surface / (tool_now + surface)
        scene.effects.append(
            Effect("contact_stiffness", [f"{name}~{TOOL}"], {"stiffness": float(pair)})
        )


def set_friction_by_place(
    scene: Scene, name: str, friction: list[float], areas: list[FrictionZone]
) -> None:
    """Sets a friction between one flat object and the tool that depends on the place.

    Args: friction: of each area; areas: zones that together cover the object; only
        their x and y are used. The smallest friction becomes the object's own.
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

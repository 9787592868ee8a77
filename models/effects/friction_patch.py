"""Effect friction_patch: a rectangle of a level ground with a friction of its own."""

import numpy as np
from pydrake.geometry import (
    Box,
    HalfSpace,
    ProximityProperties,
    RoleAssign,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from makebreak.models.effects.change_shape import (
    change_shape,
    keep_apart,
    not_colliding_with,
)
from makebreak.models.effects.contact_surface import (
    anchored_pose,
    changed_and_other,
    combined_friction,
    coulomb,
    friction_against,
    friction_of,
    set_surface,
    shapes_that_meet,
    touchable_shapes,
)
from makebreak.models.effects.kind import Effect, full_name

# A half-space that is cut becomes a box of this half width and depth [m].
HALF_SPACE_EXTENT = 100.0


def _level_ground(effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph):
    """(id, shape, world pose) of each collision shape of the ground.

    Raises: ValueError if the ground is neither a half-space nor level boxes with flush
        tops (several of which an earlier patch leaves).
    """
    ground, _ = changed_and_other(effect, plant)
    where = f"effect friction_patch at {effect.at[0]!r}"
    X_WB = anchored_pose(effect, plant, ground)
    inspector = scene_graph.model_inspector()
    found = []
    for geometry, _ in touchable_shapes(plant, scene_graph, ground):
        X_WG = X_WB @ inspector.GetPoseInFrame(geometry)
        found.append((geometry, inspector.GetShape(geometry), X_WG))
    kinds = {type(shape) for _, shape, _ in found}
    if kinds != {Box} and not (kinds == {HalfSpace} and len(found) == 1):
        raise ValueError(
            f"{where}: expected {full_name(plant, ground)} to have one collision shape,"
            " a box or a half-space"
        )
    tops = []
    for _, shape, X_WG in found:
        R = X_WG.rotation().matrix()
        level = abs(R[2, 2]) > 1.0 - 1e-9
        square = np.allclose(np.sort(abs(R), axis=0)[:2], 0.0, atol=1e-6)
        if not level or (isinstance(shape, Box) and not square):
            raise ValueError(
                f"{where}: expected {full_name(plant, ground)} level, its sides along "
                "x, y"
            )
        tops.append(_span(shape, X_WG)[1][2])
    if np.ptp(tops) > 1e-9:
        raise ValueError(
            f"{where}: expected the shapes of {full_name(plant, ground)} to be flush"
        )
    return found


def _span(shape: Box | HalfSpace, X_WG: RigidTransform):
    """Lower and upper corner (3,) in the world [m]; a half-space is cut off at
    HALF_SPACE_EXTENT from the world's origin."""
    centre = X_WG.translation()
    if isinstance(shape, Box):
        half = abs(X_WG.rotation().matrix()) @ (shape.size() / 2.0)
        return centre - half, centre + half
    far = HALF_SPACE_EXTENT
    return np.array([-far, -far, centre[2] - far]), np.array([far, far, centre[2]])


def patch_values(
    effect: Effect, plant: MultibodyPlant, scene_graph
) -> dict[str, float]:
    """Empty, as a patch has no neutral values. Raises: ValueError as _level_ground."""
    _level_ground(effect, plant, scene_graph)
    return {}


def _cut(p: dict[str, float], low, high) -> tuple[bool, list[tuple]]:
    """Whether the patch p lies on the box from low to high, and the rectangles
    (x_from, x_to, y_from, y_to) [m] into which it cuts the box: first the part under
    the patch, then the strips on either side in x, then those in y."""
    x = np.clip([low[0], p["x_min"], p["x_max"], high[0]], low[0], high[0])
    y = np.clip([low[1], p["y_min"], p["y_max"], high[1]], low[1], high[1])
    if not (x[1] < x[2] and y[1] < y[2]):
        return False, [(low[0], high[0], low[1], high[1])]
    rectangles = [
        (x[1], x[2], y[1], y[2]),
        (x[0], x[1], y[0], y[3]),
        (x[2], x[3], y[0], y[3]),
        (x[1], x[2], y[0], y[1]),
        (x[1], x[2], y[2], y[3]),
    ]
    return True, [r for r in rectangles if r[0] < r[1] and r[2] < r[3]]


def cut_patch(effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Cuts each shape of the ground into the part under the patch and the rest.

    The pieces' tops are flush. Where the patch needs more friction than the ground's
    surface alone can give, the sliding object is made rougher and the ground around
    the patch smoother; the object's pairs with third bodies change with it. An object
    that slides over the edge touches both pieces for a moment: a sphere of radius R
    that penetrates by s for a distance of sqrt(8 R s). Where patches overlap, the
    later one counts.
    """
    p = effect.parameters
    where = f"effect friction_patch at {effect.at[0]!r}"
    if p["x_min"] >= p["x_max"] or p["y_min"] >= p["y_max"]:
        raise ValueError(f"{where}: the patch is empty: {p}")
    ground, thing = changed_and_other(effect, plant)
    shapes = _level_ground(effect, plant, scene_graph)
    X_BW = anchored_pose(effect, plant, ground).inverse()
    inspector = scene_graph.model_inspector()
    mu = p["friction"]
    mu_thing = friction_against(effect, plant, scene_graph, thing, ground)
    # The pair's friction stays below twice that of the object.
    rougher = mu if not 2.0 * mu_thing > mu else mu_thing
    mu_patch = mu * rougher / (2.0 * rougher - mu) if mu > 0.0 else 0.0
    source, hit, added = plant.get_source_id(), False, []
    for number, (geometry, shape, X_WG) in enumerate(shapes):
        low, high = _span(shape, X_WG)
        # A copy, as AssignRole below replaces the original.
        old = ProximityProperties(inspector.GetProximityProperties(geometry))
        apart = not_colliding_with(scene_graph, geometry)
        around = combined_friction(friction_of(old), mu_thing)
        mu_ground = around * rougher / (2.0 * rougher - around)
        inside, rectangles = _cut(p, low, high)
        hit |= inside
        for i, (x0, x1, y0, y1) in enumerate(rectangles):
            box = Box(x1 - x0, y1 - y0, high[2] - low[2])
            middle = [(x0 + x1) / 2.0, (y0 + y1) / 2.0, (low[2] + high[2]) / 2.0]
            X_BG = X_BW @ RigidTransform(middle)
            mu_piece = coulomb(mu_patch if inside and i == 0 else mu_ground)
            properties = ProximityProperties(old)
            properties.UpdateProperty("material", "coulomb_friction", mu_piece)
            if i == 0:
                change_shape(plant, scene_graph, geometry, box, X_BG)
                scene_graph.AssignRole(
                    source, geometry, properties, RoleAssign.kReplace
                )
            else:
                name = f"{ground.name()}_of_{len(shapes)}_{number}_around_patch_{i}"
                added.append((apart, X_BG, box, name, properties))
    # Registered last: doing so makes the geometry ids that were read above invalid.
    for apart, *piece in added:
        keep_apart(
            scene_graph, [plant.RegisterCollisionGeometry(ground, *piece)], apart
        )
    if not hit:
        raise ValueError(f"{where}: the patch is off {full_name(plant, ground)}")
    if rougher != mu_thing:
        only = shapes_that_meet(effect, plant, scene_graph, thing, ground)
        set_surface(plant, scene_graph, thing, "coulomb_friction", coulomb(mu), only)

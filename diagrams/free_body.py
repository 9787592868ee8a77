"""What a scene's one free body feels, as numbers for the fast stepping of it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydrake.geometry import Box, HalfSpace, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.effects.contact import DEFAULT_DISSIPATION, FADE_RATE
from makebreak.models.effects.kind import Effect, full_name
from makebreak.models.scene import LoadedScene, Scene, load_scene
from makebreak.systems.numerics.free_body import FreeBody

# Forces that have their own numbers here; what changes shapes, inertias and surfaces is
# read off the plant.
_FORCES = ("constant_force", "sinusoidal_force", "body_drag", "rolling_resistance")
_SENSORS = ("length_scale", "sensor_delay", "sensor_bias", "clock_skew")
_PLANT = ("object_size", "corner_radius", "object_mass", "object_com", "object_inertia",
          "contact_friction", "contact_stiffness", "contact_dissipation",
          "friction_patch", "plane_height", "plane_tilt", "gravity_tilt")  # fmt: skip


def free_body_of(scene: Scene, effects: Sequence[Effect] = ()) -> tuple[str, FreeBody]:
    """The scene's free body, `<model>.<body>`, and its numbers, with these effects
    added.

    Raises: ValueError where the scene has anything else that moves, shapes other than
        a body of spheres on boxes and half-spaces, or effects of other kinds.
    """
    scene = replace(scene, effects=[*scene.effects, *effects])
    for effect in scene.effects:
        if effect.kind not in (*_FORCES, *_SENSORS, *_PLANT):
            raise ValueError(f"effect {effect.kind} is not one of a free body")
    if scene.friction_zones or scene.plant.contact_model != "point":
        raise ValueError("friction zones and hydroelastic contact are Drake's alone")
    builder = DiagramBuilder()
    loaded = load_scene(scene, builder)
    plant = loaded.plant
    bodies = [plant.get_body(i) for i in sorted(plant.GetFloatingBaseBodies())]
    if len(bodies) != 1 or plant.num_velocities() != 6:
        raise ValueError("expected one free body and nothing else that moves")
    return full_name(plant, bodies[0]), _numbers(loaded, bodies[0])


def _numbers(loaded: LoadedScene, body: RigidBody) -> FreeBody:
    plant, inspector = loaded.plant, loaded.scene_graph.model_inspector()
    mine = plant.GetCollisionGeometriesForBody(body)
    if not mine:
        raise ValueError(f"{full_name(plant, body)} has nothing to touch with")
    spheres, fixed, others, grounds = [], [], [], []
    for g in mine:
        shape = inspector.GetShape(g)
        if not isinstance(shape, Sphere):
            raise ValueError(f"a {type(shape).__name__} of a free body")
        centre = inspector.GetPoseInFrame(g).translation()
        spheres.append([*centre, shape.radius()])
    context = plant.CreateDefaultContext()
    for i in range(plant.num_bodies()):
        ground = plant.get_body(BodyIndex(i))
        if not plant.IsAnchored(ground):
            continue
        for g in plant.GetCollisionGeometriesForBody(ground):
            shape = inspector.GetShape(g)
            X = plant.EvalBodyPoseInWorld(context, ground) @ inspector.GetPoseInFrame(g)
            if isinstance(shape, Box):
                half = shape.size() / 2.0
            elif isinstance(shape, HalfSpace):
                half = np.array([-1.0, 0.0, 0.0])
            else:
                raise ValueError(f"a {type(shape).__name__} that is fixed")
            fixed.append([*X.rotation().matrix().ravel(), *X.translation(), *half])
            others.append(g)
            grounds.append(full_name(plant, ground))
    name = full_name(plant, body)
    guess = default_stiffness(plant)
    pairs = np.zeros((len(mine), len(others), 5))
    levers = np.zeros(pairs.shape[:2])
    lever = _levers(loaded, name)
    for j, a in enumerate(mine):
        for m, b in enumerate(others):
            if not inspector.CollisionFiltered(a, b):
                pairs[j, m] = _pair(inspector, a, b, guess)
                levers[j, m] = lever.get(grounds[m], 0.0) * spheres[j][3]
    M = body.default_spatial_inertia()
    mass, com = M.get_mass(), np.array(M.get_com())
    about = M.CalcRotationalInertia().CopyToFullMatrix3()
    central = about - mass * (com @ com * np.eye(3) - np.outer(com, com))
    forces, drag = [], np.zeros(2)
    for effect in loaded.effects:
        if not any(at in (name, name.split(".")[0]) for at in effect.at):
            continue
        p = effect.parameters
        if effect.kind in ("constant_force", "sinusoidal_force"):
            wave = [p.get("frequency", 0.0), p.get("phase", 0.0), 0.0]
            forces.append([p["fx"], p["fy"], p["fz"], *wave])
        elif effect.kind == "body_drag":
            drag += [p["linear"], p["angular"]]
    return FreeBody(
        mass, com, central, np.array(plant.gravity_field().gravity_vector()),
        np.array(spheres), np.array(fixed).reshape(-1, 15), pairs, levers,
        np.array(forces, float).reshape(-1, 6), drag, fade=FADE_RATE,
    )  # fmt: skip


def default_stiffness(plant: MultibodyPlant) -> float:
    """What Drake gives shapes that have none [N/m]: at twice it in each of two, the
    heaviest body would rest a millimetre deep."""
    heaviest = max(
        plant.get_body(BodyIndex(i)).default_mass()
        for i in range(1, plant.num_bodies())
    )
    g = float(np.linalg.norm(plant.gravity_field().gravity_vector()))
    return 2.0 * heaviest * g / 1e-3


def _pair(inspector, a, b, guess: float) -> list[float]:
    values = []
    for g in (a, b):
        properties = inspector.GetProximityProperties(g)
        k = properties.GetPropertyOrDefault(
            "material", "point_contact_stiffness", guess
        )
        d = properties.GetPropertyOrDefault(
            "material", "hunt_crossley_dissipation", DEFAULT_DISSIPATION
        )
        mu = properties.GetProperty("material", "coulomb_friction")
        values.append((k, d, mu.static_friction(), mu.dynamic_friction()))
    (k1, d1, s1, m1), (k2, d2, s2, m2) = values
    both = k1 + k2
    return [
        k1 * k2 / both, (k2 * d1 + k1 * d2) / both, _mean(s1, s2), _mean(m1, m2),
        k1 / both,
    ]  # fmt: skip


def _mean(mu1: float, mu2: float) -> float:
    return 2.0 * mu1 * mu2 / (mu1 + mu2) if mu1 + mu2 > 0.0 else 0.0


def _levers(loaded: LoadedScene, name: str) -> dict[str, float]:
    """Coefficient of rolling resistance by the name of what is fixed."""
    found: dict[str, float] = {}
    for effect in loaded.effects:
        if effect.kind == "rolling_resistance":
            pair = effect.at[0].split("~")
            for other in pair:
                found[other.strip()] = found.get(other.strip(), 0.0) + float(
                    effect.parameters["coefficient"]
                )
    found.pop(name, None)
    return found

"""Settings of cube_pivoting, and what follows from them: the cube of the world and of
the planner's model, their scenes, the start, contact pairs and C3's weights."""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from operator import attrgetter
from typing import Literal

import numpy as np
from pydrake.geometry import Box
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.effects.kind import Effect
from makebreak.models.model_files import MODELS, add_models
from makebreak.models.scene import Scene, read_scene
from makebreak.systems.contact_mpc.c3_mpc import C3Config
from makebreak.systems.contact_mpc.lcs_builder import ContactPair
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Bounds, C3Options, C3Weights
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    PlusProjection,
    QpProjection,
)
from makebreak.systems.contact_mpc.numerics.pivot_target import (
    LEFT,
    N_X,
    RIGHT,
    THETA,
    corners,
)
from makebreak.systems.contact_mpc.pivot_target import PivotTargetConfig
from makebreak.systems.contact_mpc.residual_learner import (
    AdamConfig,
    ResidualLearnerConfig,
)

SCENE = str(MODELS / "cube_pivoting.scene.yaml")
FINGERS = ("left", "right")
CUBE_BODY, CORNERS_BODY, PLATFORM = "pivot.cube", "pivot.corners", "pivot.platform"
# Weights of C3 on x: cube x, z [1/m^2], angle [1/rad^2], x and z of each finger
# [1/m^2], then the same of the velocities.
Q = (2000.0, 2000.0, 200.0, *4 * [50.0], 2.0, 2.0, 0.5, *4 * [5.0])
R = 0.01  # Weight of C3 on u [1/N^2].
CLEARANCE = 1e-3  # Least distance between bodies at the start [m].


@dataclass
class PivotStart:
    """Ranges of the uniform distributions from which the seed draws a run."""

    place: float = 0.05  # Largest distance of the cube's centre from x = -0.1 m [m].
    tilt: float = 0.15  # Largest tilt of the cube, to either side [rad].
    # Range of the distance from the cube's sides to the fingers' surfaces, [low, high]
    # [m].
    distance: list[float] = field(default_factory=lambda: [0.01, 0.06])
    # Range of the height of the fingers' centres, [low, high] [m].
    height: list[float] = field(default_factory=lambda: [0.02, 0.12])
    # Range of the cube's friction with fingers and platform, [low, high].
    friction: list[float] = field(default_factory=lambda: [0.4, 1.0])


@dataclass
class PivotModel:
    """What is wrong in the planner's model of the cube."""

    # Friction in the planner's model over that in the world.
    friction_error: float = 1.0
    # Mass of the cube in the planner's model over that in the world.
    mass_error: float = 1.0
    # Size of the cube in the planner's model over that in the world.
    size_error: float = 1.0


@dataclass
class PivotPlanner:
    """Settings of cube_pivoting's planner."""

    projection: Literal["plus", "qp"] = "plus"  # Projection of C3: plus or qp.
    options: C3Options = field(
        default_factory=lambda: C3Options(N=10, rounds=3, polish=10)
    )
    dt_sec: float = 0.05  # Time between two knots of the plan [s].
    period_sec: float = 0.02  # Period of planning and of learning [s].
    # Whether each knot has its own LCS, about the last plan; false: all have that of
    # the present state.
    lcs_along_plan: bool = False
    # Largest force of each slide of a finger, in addition to its weight [N].
    force_max: float = 10.0
    # Speed at which the desired angle turns to its goal while the fingers are near
    # their places [rad/s].
    rate: float = 1.0


def _learner() -> ResidualLearnerConfig:
    """One residual for each finger on the cube and one for the corners on the platform.

    A contact with a gap velocity error g is learned from if its force is above
    g / (eps |D|^2): for a finger of 0.3 kg, 20 ms and an error of 5 mm (0.25 m/s) from
    0.2 N on.
    """
    return ResidualLearnerConfig(
        eps=300.0,
        gamma=2e-4,
        adam=AdamConfig(n_b=10, learning_rate=0.01, n_steps=5),
        groups=[[0, 1], [2, 3], [4, 5, 6, 7]],
        r_max=1.0,
    )


@dataclass
class CubePivotingConfig:
    """Settings of `makebreak run cube_pivoting`."""

    seed: int = 0  # Seed of the start and the friction.
    start: PivotStart = field(default_factory=PivotStart)
    mass: float = 0.4  # Mass of the cube in the world [kg].
    size: float = 1.0  # Size of the cube in the world over that in the scene file.
    model: PivotModel = field(default_factory=PivotModel)
    planner: PivotPlanner = field(default_factory=PivotPlanner)
    adapt: bool = False  # Whether the contacts' residuals are learned.
    learning: ResidualLearnerConfig = field(default_factory=_learner)
    # Scene file of the simulated world; the planner's model is made from it too.
    world: str = SCENE


@dataclass(frozen=True)
class Cube:
    """The properties that may differ between the world and the planner's model."""

    friction: float
    mass: float  # [kg]
    side: float  # [m]


def world_cube(config: CubePivotingConfig) -> Cube:
    """The simulated cube in the run of config.seed. Raises: ValueError."""
    c = config
    friction = _range("start.friction", c.start.friction, 0.0)
    for name in (
        "mass", "size", "model.friction_error", "model.mass_error", "model.size_error",
    ):  # fmt: skip
        if not 0.0 < (value := attrgetter(name)(c)) < np.inf:
            raise ValueError(f"{name} is {value}, expected > 0")
    drawn = np.random.default_rng([c.seed, 1]).uniform(friction[0], friction[1])
    return Cube(float(drawn), c.mass, c.size * _side(c.world))


def model_cube(config: CubePivotingConfig) -> Cube:
    """The cube of the planner's model in the same run."""
    c, cube = config, world_cube(config)
    return Cube(
        cube.friction * c.model.friction_error,
        cube.mass * c.model.mass_error,
        cube.side * c.model.size_error,
    )


def scene_with(path: str, cube: Cube) -> Scene:
    """The scene of the file with this cube."""
    scene = read_scene(path)
    pairs = [f"{CORNERS_BODY}~{PLATFORM}"]
    pairs += [f"{finger}.finger~{CUBE_BODY}" for finger in FINGERS]
    effects = [
        Effect("contact_friction", [pair], {"friction": cube.friction})
        for pair in pairs
    ]
    effects.append(Effect("object_mass", [CUBE_BODY], {"mass": cube.mass}))
    scale = cube.side / _side(path)
    if scale != 1.0:
        bodies = [CUBE_BODY, CORNERS_BODY]
        effects.append(Effect("object_size", bodies, {"scale": scale}))
    return replace(scene, effects=[*scene.effects, *effects])


def initial_state(config: CubePivotingConfig) -> np.ndarray:
    """Start of the run of config.seed, x (14,): at rest and without contacts."""
    c = config.start
    for name in ("place", "tilt"):
        if not 0.0 <= getattr(c, name) < np.inf:
            raise ValueError(f"start.{name} is {getattr(c, name)}, expected >= 0")
    radius = PivotTargetConfig().finger_radius
    distance = _range("start.distance", c.distance, CLEARANCE)
    height = _range("start.height", c.height, radius + CLEARANCE)
    rng, cube = np.random.default_rng([config.seed, 0]), world_cube(config)
    x = np.zeros(N_X)
    x[0] = -0.1 + rng.uniform(-c.place, c.place)
    x[THETA] = rng.uniform(-c.tilt, c.tilt)
    x[1] = CLEARANCE - corners(x, cube.side)[:, 1].min()
    ends = corners(x, cube.side)[:, 0]
    for finger, face, sign in ((LEFT, ends.min(), -1.0), (RIGHT, ends.max(), 1.0)):
        x[finger] = (
            face + sign * (radius + rng.uniform(distance[0], distance[1])),
            rng.uniform(height[0], height[1]),
        )
    return x


def _range(name: str, values, least: float) -> list[float]:
    """The values as [low, high] with low at least `least`. Raises: ValueError."""
    good = len(values) == 2 and np.isfinite(values).all()
    if not (good and least <= values[0] <= values[1]):
        raise ValueError(
            f"{name} is {list(values)}, expected [low, high] with {least:g} <= low"
        )
    return list(values)


@lru_cache
def _side(path: str) -> float:
    """Side of the cube in a scene file, without the scene's effects [m]."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    add_models(read_scene(path), (), plant)
    try:
        body = plant.GetBodyByName("cube", plant.GetModelInstanceByName("pivot"))
    except RuntimeError:
        raise ValueError("the scene has no body pivot.cube") from None
    shapes = plant.GetCollisionGeometriesForBody(body)
    box = scene_graph.model_inspector().GetShape(shapes[0]) if shapes else None
    if len(shapes) != 1 or not isinstance(box, Box) or box.width() != box.height():
        raise ValueError("pivot.cube is no box with equal sides in the x-z plane")
    return float(box.width())


def contact_pairs(friction: float) -> list[ContactPair]:
    """Fingers on the cube, the cube's two lowest corners on the platform, and, without
    friction, the fingers on the platform."""
    y = [0.0, 1.0, 0.0]

    def pair(a, b, mu, closest=None):
        return ContactPair(
            a, b, mu, friction_directions=1, plane_normal=y, closest=closest
        )

    return [
        *(pair(f"{f}::finger", "pivot::cube", friction) for f in FINGERS),
        pair("pivot::corners", "pivot::platform", friction, closest=2),
        *(pair(f"{f}::finger", "pivot::platform", 0.0) for f in FINGERS),
    ]


def c3_config(planner: PivotPlanner, n_lam: int) -> C3Config:
    """C3's weights for n_lam forces, and bounds of the fingers' forces.

    In G a force of 1 N counts as a gap velocity of 1 m/s, and x and u count little.
    """
    if not 0.0 < planner.force_max < np.inf:
        raise ValueError(
            f"planner.force_max is {planner.force_max}, expected a positive force [N]"
        )
    n_u = 2 * len(FINGERS)
    sizes = [N_X, n_lam, n_u]
    G, U = [0.01, 1.0, 0.01], [1.0, 1.0, 1.0]
    if planner.projection == "plus":
        sizes, G, U = [*sizes, n_lam], [*G, 1.0], [*U, 10.0]
    weights = C3Weights(
        Q=np.array(Q), R=R * np.ones(n_u), G=np.repeat(G, sizes), U=np.repeat(U, sizes)
    )
    u_max = planner.force_max * np.ones(n_u)
    return C3Config(
        weights,
        projection=PlusProjection() if planner.projection == "plus" else QpProjection(),
        options=planner.options,
        bounds=C3Bounds(u_lower=-u_max, u_upper=u_max),
        residual_dt_sec=planner.period_sec,
    )

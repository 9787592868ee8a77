"""Time to render an image and to detect the ball in it, and the detection's error."""

from functools import partial

import numpy as np
from pydrake.geometry import Box, Capsule, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from makebreak.benchmarks.bench import median_call_ms
from makebreak.diagrams.camera import (
    CameraConfig,
    add_camera,
    camera_model,
    vtk_works,
)
from makebreak.systems.perception.ball_tracker import BallTrackerConfig
from makebreak.systems.perception.numerics.ball_tracker import (
    find_ball,
    strength_weights,
)

BALL, TIP, ROD = 0.0315, 0.0195, 0.12  # [m] radius, radius, length.
WORKSPACE = [0.35, -0.15], [0.65, 0.15]  # [m]
ORANGE, DARK = [0.95, 0.4, 0.05, 1.0], [0.2, 0.2, 0.22, 1.0]
N_POSITIONS = 40


class _Scene:
    """A ball, a finger that touches it, a table and a camera."""

    def __init__(self, config):
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        inertia = SpatialInertia.SolidSphereWithMass(0.07, BALL)
        parts = (Sphere(BALL), ORANGE), (Sphere(TIP), DARK), (Capsule(0.008, ROD), DARK)
        self._bodies = []
        for i, (shape, color) in enumerate(parts):
            body = plant.AddRigidBody(f"part{i}", inertia)
            X = RigidTransform()
            plant.RegisterVisualGeometry(body, X, shape, "visual", np.array(color))
            self._bodies.append(body)
        X, grey = RigidTransform([0.5, 0.0, -0.05]), np.array([0.8, 0.8, 0.8, 1.0])
        table = Box(1.6, 1.6, 0.1)
        plant.RegisterVisualGeometry(plant.world_body(), X, table, "table", grey)
        plant.Finalize()
        port = add_camera(builder, scene_graph, plant, config, seed=0)
        builder.ExportOutput(port, "image")
        self._plant, self._diagram = plant, builder.Build()
        self._context = self._diagram.CreateDefaultContext()

    def picture(self, ball, offset):
        """(h, w, 4), the finger's tip at offset (2,) [m] from above the ball (3,)."""
        tip = ball + [*offset, np.sqrt((BALL + TIP) ** 2 - offset @ offset)]
        slope = np.deg2rad(50.0)
        away = np.array([-np.cos(slope), 0.0, np.sin(slope)])
        rod = RotationMatrix.MakeFromOneVector(away, 2)
        X_rod = RigidTransform(rod, tip + ROD / 2 * away)
        poses = RigidTransform(ball), RigidTransform(tip), X_rod
        context = self._plant.GetMyMutableContextFromRoot(self._context)
        for body, X in zip(self._bodies, poses, strict=True):
            self._plant.SetFreeBodyPose(context, body, X)
        return self._diagram.GetOutputPort("image").Eval(self._context).data.copy()


def rows() -> list[dict]:
    """Milliseconds per picture and per search; errors with the finger in the way and
    the radius right and 5 mm too large."""
    found = []
    for renderer in ("vtk", "drawn") if vtk_works() else ("drawn",):
        for width, height in ((320, 240), (640, 480)):
            config = CameraConfig(width=width, height=height, renderer=renderer)
            found += _rows(config, f"{renderer} {width}x{height}")
    return found


def _rows(config, name):
    scene, camera = _Scene(config), camera_model(config)
    weights = strength_weights(BallTrackerConfig().hue)
    rng = np.random.default_rng(0)
    positions = np.full((N_POSITIONS, 3), BALL)
    positions[:, :2] = rng.uniform(*WORKSPACE, (N_POSITIONS, 2))
    offsets = rng.uniform(-0.014, 0.014, (N_POSITIONS, 2))  # Up to 20 mm.
    pictures = [scene.picture(p, o) for p, o in zip(positions, offsets, strict=True)]
    turn = iter(range(10**9))

    def render():
        i = next(turn) % N_POSITIONS
        scene.picture(positions[i], offsets[i])

    def search(where):
        i = next(turn) % N_POSITIONS
        guess = positions[i] if where == "near" else None
        find_ball(pictures[i], camera, weights, BALL, 0.0, guess)

    found = [
        {"what": f"{name}: picture", "value": median_call_ms(render, 80), "unit": "ms"}
    ]
    for where in ("near", "everywhere"):
        value = median_call_ms(partial(search, where), 80)
        row = {"what": f"{name}: find the ball, {where}", "value": value, "unit": "ms"}
        if where == "near" and config.width == 320:
            row |= {"target": "<= 1.5", "met": value <= 1.5}
        found.append(row)
    for radius in (BALL, BALL + 5e-3):
        errors = np.full(N_POSITIONS, np.inf)
        for i, picture in enumerate(pictures):
            ball = find_ball(picture, camera, weights, radius, 0.0, positions[i])
            if ball is not None:
                errors[i] = np.hypot(*(ball.p_WB - positions[i])[:2])
        value = 1e3 * float(np.median(errors))
        what = f"{name}: median error, radius {1e3 * radius:.1f} mm"
        row = {"what": what, "value": value, "unit": "mm"}
        if radius == BALL:
            limit = 2.0 if config.width == 320 else 1.0
            row |= {"target": f"<= {limit:g}", "met": value <= limit}
        found.append(row)
    return found

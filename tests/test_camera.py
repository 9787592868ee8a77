import subprocess
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from pydrake.geometry import Box, Capsule, Cylinder, Ellipsoid, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder
from scipy import ndimage

from makebreak.diagrams.camera import (
    CameraConfig,
    CameraNoise,
    add_camera,
    camera_model,
    describe_camera,
    vtk_works,
)
from makebreak.systems.perception.numerics.pinhole import (
    Pinhole,
    frame_shift,
    look_down,
    paint_exactly,
    shifted,
    sphere_circle,
)

RADIUS = 0.0315
ORANGE, GREY, DARK = [0.95, 0.4, 0.05, 1.0], [0.8, 0.8, 0.8, 1.0], [0.2, 0.2, 0.2, 1.0]
RENDERERS = [
    "drawn",
    pytest.param(
        "vtk",
        marks=pytest.mark.skipif(
            not vtk_works(), reason="Drake cannot render here: no GL libraries"
        ),
    ),
]


class Studio:
    """A grey table, the camera, and bodies that can be put anywhere."""

    def __init__(self, config, shapes, seed=0):
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        inertia = SpatialInertia.SolidSphereWithMass(0.07, RADIUS)
        identity = RigidTransform()
        self.bodies = []
        for i, (shape, color) in enumerate(shapes):
            body = plant.AddRigidBody(f"body{i}", inertia)
            plant.RegisterVisualGeometry(body, identity, shape, "v", np.array(color))
            self.bodies.append(body)
        X_WT = RigidTransform([0.5, 0.0, -0.05])
        table = Box(1.6, 1.6, 0.1)
        world = plant.world_body()
        plant.RegisterVisualGeometry(world, X_WT, table, "table", np.array(GREY))
        plant.Finalize()
        port = add_camera(builder, scene_graph, plant, config, seed)
        builder.ExportOutput(port, "image")
        self.plant, self.diagram = plant, builder.Build()
        self.context = self.diagram.CreateDefaultContext()

    def picture(self, *poses, time=0.0):
        """(h, w, 4) uint8 with the bodies at these poses, or positions (3,) [m]."""
        self.context.SetTime(time)
        context = self.plant.GetMyMutableContextFromRoot(self.context)
        for body, X in zip(self.bodies, poses, strict=True):
            X = X if isinstance(X, RigidTransform) else RigidTransform(X)
            self.plant.SetFreeBodyPose(context, body, X)
        return self.diagram.GetOutputPort("image").Eval(self.context).data.copy()


def orange_centroid(picture):
    """(u, v) [px], each pixel weighed by how orange it is."""
    weight = np.maximum(picture[:, :, 0].astype(float) - picture[:, :, 2], 0.0)
    weight[weight < 30.0] = 0.0  # The table is not exactly grey.
    v, u = np.indices(weight.shape)
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def test_a_point_comes_back_from_its_pixel():
    camera = look_down(320, 240, 0.7, [0.5, 0.0, 0.8], -0.5)
    rng = np.random.default_rng(0)
    for p in rng.uniform([0.3, -0.2, 0.0], [0.7, 0.2, 0.3], (20, 3)):
        ray = camera.rays(camera.project(camera.to_camera(p)[None]))[0]
        # Round-off of a few operations on numbers below 1e3 px.
        np.testing.assert_allclose(camera.meet_plane(ray, p[2]), p, atol=1e-12)
    assert camera.meet_plane(np.array([0.0, 0.0, 1.0]), 0.9) is None  # Behind it.


def test_every_ray_of_an_outline_touches_its_sphere():
    rng = np.random.default_rng(0)
    for p in rng.uniform([-0.2, -0.2, 0.3], [0.2, 0.2, 1.0], (20, 3)):
        points = sphere_circle(p, 0.1, 0.1 / np.linalg.norm(p))
        rays = points / np.linalg.norm(points, axis=1, keepdims=True)
        distance = np.linalg.norm(np.cross(rays, p), axis=1)
        np.testing.assert_allclose(distance, 0.1, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(points - p, axis=1), 0.1, atol=1e-12)


def test_a_painted_outline_covers_its_area_and_keeps_its_centre():
    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for center in ([30.0, 25.0], [30.3, 25.45], [29.5, 24.9]):
        picture = np.zeros((50, 60, 3), np.uint8)
        paint_exactly(picture, center + 12.0 * circle, (255.0, 255.0, 255.0))
        cover = picture[:, :, 0] / 255.0
        v, u = np.indices(cover.shape)
        centroid = np.array([(cover * u).sum(), (cover * v).sum()]) / cover.sum()
        # A fine pixel is 1/8; OpenCV fills those on the edge: half of one more, and
        # not quite the same on the left as on the right.
        np.testing.assert_allclose(np.sqrt(cover.sum() / np.pi), 12.0, atol=1 / 8)
        np.testing.assert_allclose(centroid, center, atol=0.05)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_world_x_is_up_and_world_y_is_left_in_the_picture(renderer):
    studio = Studio(CameraConfig(renderer=renderer), [(Sphere(RADIUS), ORANGE)])
    u0, v0 = orange_centroid(studio.picture([0.5, 0.0, RADIUS]))
    u1, v1 = orange_centroid(studio.picture([0.6, 0.0, RADIUS]))
    u2, v2 = orange_centroid(studio.picture([0.5, 0.1, RADIUS]))
    f = camera_model(CameraConfig()).focal
    step = f * 0.1 / (0.8 - RADIUS)  # A sphere's centroid moves a little further.
    np.testing.assert_allclose([u1 - u0, v1 - v0], [0.0, -step], atol=0.5)
    np.testing.assert_allclose([u2 - u0, v2 - v0], [-step, 0.0], atol=0.5)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_pictures_lie_where_the_camera_model_says(renderer):
    config = CameraConfig(renderer=renderer)
    studio, camera = Studio(config, [(Sphere(RADIUS), ORANGE)]), camera_model(config)
    rng = np.random.default_rng(0)
    errors = []
    for x, y in rng.uniform([0.4, -0.1], [0.6, 0.1], (20, 2)):
        p = camera.to_camera(np.array([x, y, RADIUS]))
        outline = camera.project(sphere_circle(p, RADIUS, RADIUS / np.sqrt(p @ p)))
        seen = orange_centroid(studio.picture([x, y, RADIUS]))
        errors.append(seen - outline.mean(axis=0))
    # Without the half pixel this would be 0.5; single pictures scatter by 0.1 px.
    np.testing.assert_allclose(np.mean(errors, axis=0), [0.0, 0.0], atol=0.1)


@pytest.mark.skipif(not vtk_works(), reason="Drake cannot render here: no GL libraries")
def test_both_renderers_draw_the_same_outlines():
    shapes = [
        (Sphere(RADIUS), ORANGE),
        (Capsule(0.02, 0.1), DARK),
        (Cylinder(0.03, 0.08), DARK),
        (Box(0.05, 0.08, 0.03), DARK),
        (Ellipsoid(0.02, 0.04, 0.03), DARK),
    ]
    R = RotationMatrix.MakeXRotation(0.7) @ RotationMatrix.MakeYRotation(0.9)
    poses = [
        RigidTransform(R, p)
        for p in (
            [0.58, 0.12, RADIUS],
            [0.58, -0.12, 0.10],
            [0.42, 0.10, 0.12],
            [0.42, -0.1, 0.06],
            [0.5, 0.0, 0.05],
        )
    ]
    masks = []
    for renderer in ("drawn", "vtk"):
        studio = Studio(CameraConfig(renderer=renderer), shapes)
        picture = studio.picture(*poses).astype(float)
        table = np.array([204.0, 204.0, 204.0])
        # What is orange or clearly darker than the table, which is dim at the corners.
        light = np.linalg.norm(picture[:, :, :3], axis=2) / np.linalg.norm(table)
        tint = picture[:, :, 0] - picture[:, :, 2]
        masks.append(((light < 0.6) | (tint > 40.0)).astype(np.uint8))
    n_shapes, _ = cv2.connectedComponents(masks[0])
    assert n_shapes == 1 + len(shapes)
    contours, _ = cv2.findContours(masks[0], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    perimeter = sum(cv2.arcLength(contour, True) for contour in contours)
    # Half a pixel along every edge.
    assert (masks[0] != masks[1]).sum() < 0.5 * perimeter
    # The ball alone: the circle of equal area, and its centre.
    balls = [mask[:100, :150] for mask in masks]
    radii = [np.sqrt(ball.sum() / np.pi) for ball in balls]
    centers = [np.argwhere(ball).mean(axis=0) for ball in balls]
    np.testing.assert_allclose(radii[0], radii[1], atol=0.5)
    np.testing.assert_allclose(centers[0], centers[1], atol=0.5)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_what_is_nearer_hides_what_is_behind(renderer):
    shapes = [(Sphere(0.0195), DARK), (Sphere(RADIUS), ORANGE)]
    config = CameraConfig(renderer=renderer)
    camera, studio = camera_model(config), Studio(config, shapes)
    ball = np.array([0.55, 0.05, RADIUS])
    tip = ball + [0.0, 0.01, 0.05]
    picture = studio.picture(tip, ball)
    u, v = np.rint(camera.project(camera.to_camera(tip)[None])[0]).astype(int)
    assert picture[v, u, :3].max() < 80
    u, v = np.rint(camera.project(camera.to_camera(ball)[None])[0]).astype(int)
    assert picture[v, u + 9, 0] > 2 * picture[v, u + 9, 2]


def test_bodies_behind_or_beside_the_camera_are_not_drawn():
    shapes = [
        (Sphere(RADIUS), ORANGE),
        (Capsule(0.05, 0.5), DARK),
        (Box(1, 1, 1), DARK),
    ]
    studio = Studio(CameraConfig(renderer="drawn"), shapes)
    empty = studio.picture([5.0, 0.0, 0.0], [0.5, 0.0, 2.0], [0.5, 9.0, 0.8])
    above = studio.picture([0.5, 0.0, 0.9], [0.5, 0.0, 0.9], [0.5, 0.0, 1.0])
    assert (empty[:, :, :3] == 204).all()
    np.testing.assert_array_equal(empty, above)


def test_frame_shifts_are_standard_normal_and_independent():
    shifts = np.array([frame_shift(7, k) for k in range(4000)])
    n = np.sqrt(4000)  # 4 standard errors of each statistic: a chance of 1e-4 each.
    np.testing.assert_allclose(shifts.mean(axis=0), 0.0, atol=4 / n)
    np.testing.assert_allclose(shifts.std(axis=0), 1.0, atol=4 / n / np.sqrt(2))
    next_to = (shifts[1:] * shifts[:-1]).mean(axis=0)
    np.testing.assert_allclose(next_to, 0.0, atol=4 / n)
    np.testing.assert_allclose((shifts[:, 0] * shifts[:, 1]).mean(), 0.0, atol=4 / n)


@pytest.mark.parametrize("shape", [(24, 31, 4), (3, 2, 4), (2, 1, 3)])
def test_a_shifted_picture_is_linear_between_pixels_and_ends_as_its_edges(shape):
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, shape).astype(np.uint8)
    for u, v in [(0.0, 0.0), (2.0, -1.0), (-40.0, 0.5), *rng.normal(0.0, 2.0, (20, 2))]:
        floats = picture.astype(float)
        expected = ndimage.shift(floats, (v, u, 0.0), order=1, mode="nearest")
        moved = np.empty_like(picture)
        shifted(picture, u, v, moved)
        # Half a count of rounding, and 255 times single precision at 40 px: 1e-3.
        np.testing.assert_allclose(moved, expected, atol=0.5 + 1e-3)


def test_shaken_pictures_move_by_the_frame_shift():
    config = CameraConfig(renderer="drawn", noise=CameraNoise(0.002))
    still = Studio(CameraConfig(renderer="drawn"), [(Sphere(RADIUS), ORANGE)])
    shaken = Studio(config, [(Sphere(RADIUS), ORANGE)], seed=3)
    p = [0.55, 0.05, RADIUS]
    pixels_per_metre = camera_model(config).focal / (0.8 - RADIUS)
    for k in range(5):
        moved = shaken.picture(p, time=k * config.period_sec + 1e-3)
        difference = orange_centroid(moved) - orange_centroid(still.picture(p))
        expected = 0.002 * pixels_per_metre * frame_shift(3, k)
        # warpAffine interpolates at 1/32 px; rounding and a threshold do the rest.
        np.testing.assert_allclose(difference, expected, atol=0.05)


def test_a_frame_is_shaken_the_same_whenever_it_is_asked_for():
    config = CameraConfig(renderer="drawn", noise=CameraNoise(0.002))
    p, time = [0.55, 0.05, RADIUS], 13 * config.period_sec
    first, again, other = (
        Studio(config, [(Sphere(RADIUS), ORANGE)], seed) for seed in (3, 3, 4)
    )
    picture = first.picture(p, time=time)
    first.picture(p, time=2.0)
    np.testing.assert_array_equal(first.picture(p, time=time + 0.011), picture)
    np.testing.assert_array_equal(again.picture(p, time=time), picture)
    assert (other.picture(p, time=time) != picture).any()
    assert (first.picture(p, time=time + config.period_sec) != picture).any()


def test_without_graphics_libraries_the_picture_is_drawn(monkeypatch):
    crashed = SimpleNamespace(returncode=-11)  # A segmentation fault.
    monkeypatch.setattr(subprocess, "run", lambda *args, **kwargs: crashed)
    vtk_works.cache_clear()
    try:
        assert describe_camera(CameraConfig()) == "drawn 320x240"
        with pytest.raises(ValueError, match="libegl1 and libgl1-mesa-dri"):
            describe_camera(CameraConfig(renderer="vtk"))
    finally:
        vtk_works.cache_clear()


@pytest.mark.parametrize("renderer", RENDERERS)
def test_the_renderer_in_use_can_be_asked_for(renderer):
    config = CameraConfig(renderer=renderer, width=640, height=480)
    assert describe_camera(config) == f"{renderer} 640x480"


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(renderer="opengl"), "camera.renderer is 'opengl', expected auto, vtk"),
        (
            dict(noise=CameraNoise(-1.0)),
            "noise.position_m must be at least 0, got -1.0",
        ),
        (dict(position=[0.5, 0.0, 0.01]), "height 0.01 must be above noise.height"),
        (dict(position=[0.5, 0.0]), "position must be 3 numbers"),
        (dict(fov_y=4.0), "fov_y must be between 0 and pi, got 4.0"),
        (dict(width=0), "width, height and focal length must be positive, got 0"),
        (dict(period_sec=0.0, noise=CameraNoise(1e-3)), "period_sec positive, got"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_by_name(change, message):
    config = CameraConfig(**{"renderer": "drawn"} | change)
    with pytest.raises(ValueError, match=message):
        Studio(config, [(Sphere(RADIUS), ORANGE)])


def test_a_pinhole_of_wrong_shape_is_refused_by_name():
    with pytest.raises(ValueError, match=r"Pinhole.p_WC is \(2,\), expected \(3,\)"):
        Pinhole(320, 240, 300.0, np.zeros(2), np.zeros(2), np.eye(3))


@pytest.mark.skipif(not vtk_works(), reason="Drake cannot render here: no GL libraries")
def test_a_region_has_the_pixels_of_the_whole_image_and_nothing_beyond():
    studio = Studio(CameraConfig(renderer="vtk"), [(Sphere(RADIUS), ORANGE)])
    camera = studio.diagram.GetSubsystemByName("overhead_camera")
    region = camera.GetInputPort("region")
    own = camera.GetMyMutableContextFromRoot(studio.context)
    ball = np.array([0.45, 0.12, RADIUS])
    whole = studio.picture(ball)
    pinhole = camera_model(CameraConfig(renderer="vtk"))
    u, v = pinhole.project(pinhole.to_camera(ball)[None])[0]
    for center in ((u, v), (160.0, 120.0), (3.0, 237.0), (400.0, -50.0)):
        region.FixValue(own, [*center, 30.0])  # Also at a corner, and beyond.
        part = studio.picture(ball)
        seen = part[:, :, 3] > 0
        rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
        assert seen.sum() == rows.size * columns.size < 0.4 * seen.size
        difference = abs(part[seen].astype(int) - whole[seen])
        assert difference.mean() < 0.05 and np.mean(difference > 2) < 0.005
        asked = np.ix_(
            np.arange(max(int(center[1]) - 30, 0), min(int(center[1]) + 30, 240)),
            np.arange(max(int(center[0]) - 30, 0), min(int(center[0]) + 30, 320)),
        )
        assert seen[asked].all()
        if center == (u, v):
            np.testing.assert_allclose(
                orange_centroid(part), orange_centroid(whole), atol=0.01
            )
    for nothing in ([np.nan] * 3, [u, v, 200.0]):
        region.FixValue(own, nothing)
        np.testing.assert_array_equal(studio.picture(ball), whole)

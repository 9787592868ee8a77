import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import Box, Capsule, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import ImageRgba8U
from scipy.linalg import expm, solve_discrete_are

from makebreak.diagrams.camera import (
    CameraConfig,
    add_camera,
    camera_model,
    vtk_works,
)
from makebreak.systems.perception.ball_tracker import (
    HOLD_SEC,
    NOT_FOUND,
    PATIENCE,
    TRACKED,
    WRONG_IMAGE,
    BallMotionConfig,
    BallTracker,
    BallTrackerConfig,
)
from makebreak.systems.perception.numerics import constant_velocity
from makebreak.systems.perception.numerics.ball_tracker import (
    bilinear,
    find_ball,
    fit_cone,
    outline_points,
    strength_weights,
)
from makebreak.systems.perception.numerics.pinhole import draw, look_down, sphere_circle

RADIUS, TIP_RADIUS = 0.0315, 0.0195
ORANGE, GREY, DARK = (242.0, 102.0, 13.0), (204.0, 204.0, 204.0), (60.0, 62.0, 66.0)
HUE = BallTrackerConfig().hue
WEIGHTS = strength_weights(HUE)
CAMERA = look_down(320, 240, 0.7, [0.5, 0.0, 0.8], -0.5)
RENDERERS = [
    "drawn",
    pytest.param(
        "vtk",
        marks=pytest.mark.skipif(
            not vtk_works(), reason="Drake cannot render here: no GL libraries"
        ),
    ),
]


def tip_above(ball, offset, angle):
    """Centre of a tip that touches the ball, offset [m] from its vertical."""
    height = np.sqrt((RADIUS + TIP_RADIUS) ** 2 - offset**2)
    return ball + [offset * np.cos(angle), offset * np.sin(angle), height]


def rod_pose(tip):
    """A rod from the tip towards the robot and up, at 50 degrees."""
    slope = np.deg2rad(50.0)
    away = np.array([-np.cos(slope), 0.0, np.sin(slope)])
    return RigidTransform(RotationMatrix.MakeFromOneVector(away, 2), tip + 0.06 * away)


def sketch(ball=None, tip=None, radius=RADIUS, camera=CAMERA):
    """A picture (h, w, 4) of a ball on the table, and the finger, without a plant."""
    picture = np.empty((camera.height, camera.width, 4), np.uint8)
    picture[:] = (*GREY, 255.0)
    rgb = picture[:, :, :3].copy()
    if ball is not None:
        p = camera.to_camera(np.asarray(ball, float))
        draw(rgb, camera, "sphere", (radius,), p, np.eye(3), ORANGE)
    if tip is not None:
        X = rod_pose(tip)
        p, R = camera.to_camera(X.translation()), camera.R_WC.T @ X.rotation().matrix()
        tip = camera.to_camera(tip)
        draw(rgb, camera, "sphere", (TIP_RADIUS,), tip, np.eye(3), DARK)
        draw(rgb, camera, "capsule", (0.008, 0.12), p, R, DARK)
    picture[:, :, :3] = rgb
    return picture


class Scene:
    """A ball, a finger and a table before either renderer."""

    def __init__(self, config):
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        inertia = SpatialInertia.SolidSphereWithMass(0.07, RADIUS)
        identity = RigidTransform()
        parts = [(Sphere(RADIUS), ORANGE), (Sphere(TIP_RADIUS), DARK)]
        parts += [(Capsule(0.008, 0.12), DARK)]
        self.bodies = []
        for i, (shape, color) in enumerate(parts):
            body = plant.AddRigidBody(f"body{i}", inertia)
            rgba = np.array([*color, 255.0]) / 255.0
            plant.RegisterVisualGeometry(body, identity, shape, "v", rgba)
            self.bodies.append(body)
        rgba = np.array([*GREY, 255.0]) / 255.0
        X_WT = RigidTransform([0.5, 0.0, -0.05])
        world = plant.world_body()
        plant.RegisterVisualGeometry(world, X_WT, Box(1.6, 1.6, 0.1), "table", rgba)
        plant.Finalize()
        port = add_camera(builder, scene_graph, plant, config, 0)
        builder.ExportOutput(port, "image")
        self.plant, self.diagram = plant, builder.Build()
        self.context = self.diagram.CreateDefaultContext()

    def picture(self, ball, tip=None):
        context = self.plant.GetMyMutableContextFromRoot(self.context)
        away = RigidTransform([5.0, 0.0, 0.0])
        poses = [RigidTransform(ball), away, away]
        if tip is not None:
            poses[1:] = RigidTransform(tip), rod_pose(tip)
        for body, X in zip(self.bodies, poses, strict=True):
            self.plant.SetFreeBodyPose(context, body, X)
        return self.diagram.GetOutputPort("image").Eval(self.context).data


# Numerics: colour, outline, cone.


def test_an_image_that_is_linear_is_interpolated_as_it_is_up_to_its_last_pixel():
    v, u = np.mgrid[0:5, 0:7].astype(float)
    image = 3.0 + 2.0 * u - 5.0 * v
    for at in ([0.0, 0.0], [2.25, 1.5], [5.75, 3.1], [6.0, 4.0], [6.0, 0.5]):
        expected = 3.0 + 2.0 * at[0] - 5.0 * at[1]
        assert bilinear(image, *at) == pytest.approx(expected, abs=1e-12)


def test_strength_is_zero_for_grey_and_largest_for_its_own_hue():
    for hue in np.linspace(0.0, 6.0, 7):
        weights = strength_weights(hue)[0, :3]
        np.testing.assert_allclose(weights @ [1.0, 1.0, 1.0], 0.0, atol=1e-6)
    pure = np.array([[1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1], [1, 0, 1]])
    for i in range(6):
        weights = strength_weights(np.deg2rad(60.0 * i))[0, :3]
        assert np.argmax(pure @ weights) == i


@pytest.mark.parametrize("seed", range(5))
def test_the_fitted_cone_is_the_one_that_touches_the_sphere(seed):
    rng = np.random.default_rng(seed)
    p, radius = rng.uniform([-0.3, -0.3, 0.5], [0.3, 0.3, 1.0]), 0.06
    points = sphere_circle(p, radius, radius / np.linalg.norm(p))
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    m, n_kept = fit_cone(rays, 1e-4)
    assert n_kept == len(rays)
    # Normal equations of a cone of 5 degrees: condition 1e3 squared, times 1e-16.
    np.testing.assert_allclose(m / np.linalg.norm(m), p / np.linalg.norm(p), atol=1e-9)
    np.testing.assert_allclose(
        1.0 / np.linalg.norm(m), np.sqrt(1.0 - radius**2 / (p @ p)), atol=1e-9
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_cone_withstands_a_hidden_third_and_false_points(seed):
    rng = np.random.default_rng(seed)
    p, radius = np.array([0.1, -0.15, 0.77]), RADIUS
    points = sphere_circle(p, radius, radius / np.linalg.norm(p))[16:]
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    wrong = rng.choice(len(rays), 6, replace=False)
    rays[wrong] = rays[wrong] * 0.7 + 0.3 * p / np.linalg.norm(p)  # Further inside.
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    m, n_kept = fit_cone(rays, 1e-4)
    assert n_kept == len(rays) - 6
    np.testing.assert_allclose(m / np.linalg.norm(m), p / np.linalg.norm(p), atol=1e-9)


def test_too_few_rays_or_rays_that_agree_on_no_cone_give_none():
    assert fit_cone(np.eye(3)[:2], 1e-3)[1] == 0
    assert fit_cone(np.ones((9, 3)) / np.sqrt(3.0), 1e-3)[1] == 0


def test_outline_points_keep_to_the_edge_against_the_table():
    strength = np.zeros((60, 60), np.uint8)
    region = np.full((60, 60, 4), 204, np.uint8)
    v, u = np.indices(strength.shape)
    inside = (u - 30.0) ** 2 + (v - 30.0) ** 2 < 14.0**2
    strength[inside] = 200
    finger = (np.abs(u - 30) < 6) & (v > 30)
    strength[finger], region[finger] = 0, 40
    angle = np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False)
    angles = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = outline_points(strength, region, 32.0, 22.0, 24.0, angles)
    assert 50 < len(points) < 90
    # A picture without antialiasing: half a pixel's diagonal.
    np.testing.assert_allclose(np.hypot(*(points - 30.0).T), 14.0, atol=0.71)
    assert not ((np.abs(points[:, 0] - 30) < 6) & (points[:, 1] > 30)).any()


# Numerics: the ball in a picture.


@pytest.mark.parametrize("hidden", [False, True], ids=["seen", "part hidden"])
@pytest.mark.parametrize("size, limit", [((320, 240), 4e-4), ((640, 480), 2e-4)])
@pytest.mark.parametrize("renderer", RENDERERS)
def test_median_error_over_the_workspace(renderer, size, limit, hidden):
    config = CameraConfig(width=size[0], height=size[1], renderer=renderer)
    scene, camera = Scene(config), camera_model(config)
    rng = np.random.default_rng(0)
    errors = []
    for x in np.linspace(0.35, 0.65, 5):
        for y in np.linspace(-0.15, 0.15, 5):
            ball = np.array([x, y, RADIUS])
            tip = tip_above(ball, 0.02 * rng.random(), 2.0 * np.pi * rng.random())
            picture = scene.picture(ball, tip if hidden else None)
            guess = ball + [*rng.normal(0.0, 3e-3, 2), 0.0]
            found = find_ball(picture, camera, WEIGHTS, RADIUS, 0.0, guess)
            errors.append(np.inf if found is None else found.p_WB - ball)
    errors = np.linalg.norm(errors, axis=1)
    assert np.median(errors) < limit  # A fifth of a pixel. Needed: 2 mm and 1 mm.
    assert errors.max() < 1.5e-3  # Not one position is lost or far off.


def test_the_ball_is_found_in_a_noisy_picture():
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(10):
        ball = np.array([*([0.5, 0.0] + rng.uniform(-0.12, 0.12, 2)), RADIUS])
        picture = sketch(ball).astype(float)
        picture[:, :, :3] += rng.normal(0.0, 20.0, picture[:, :, :3].shape)
        picture = np.clip(picture, 0, 255).astype(np.uint8)
        found = find_ball(picture, CAMERA, WEIGHTS, RADIUS, 0.0, ball)
        assert found is not None
        errors.append(np.linalg.norm(found.p_WB - ball))
    assert np.sqrt(np.mean(np.square(errors))) < 3e-4


@pytest.mark.parametrize("model_radius", [RADIUS - 5e-3, RADIUS + 5e-3, RADIUS + 8e-3])
def test_a_wrong_radius_moves_the_ball_along_its_ray_and_no_more(model_radius):
    for x, y in [(0.5, 0.0), (0.6, 0.1), (0.38, -0.12)]:
        found = find_ball(
            sketch([x, y, RADIUS]), CAMERA, WEIGHTS, model_radius, 0.0, None
        )
        nearer = (0.8 - model_radius) / (0.8 - RADIUS)
        expected = [0.5 + nearer * (x - 0.5), nearer * y, model_radius]
        np.testing.assert_allclose(found.p_WB, expected, atol=2e-4)  # A tenth of a px.
        # What the camera sees is reported: the true radius, less the dim rim.
        assert 0.9 * RADIUS < found.seen_radius < 1.02 * RADIUS


def test_the_ball_is_found_without_a_guess_even_under_the_finger():
    rng = np.random.default_rng(0)
    for x, y in rng.uniform([0.35, -0.15], [0.65, 0.15], (20, 2)):
        ball = np.array([x, y, RADIUS])
        tip = tip_above(ball, 0.02 * rng.random(), 2.0 * np.pi * rng.random())
        found = find_ball(sketch(ball, tip), CAMERA, WEIGHTS, RADIUS, 0.0)
        np.testing.assert_allclose(found.p_WB, ball, atol=1e-3)


def test_pictures_without_the_ball_give_none():
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 4), np.uint8)
    orange = np.full((240, 320, 4), (*ORANGE, 255.0)).astype(np.uint8)
    square = sketch()
    square[100:140, 100:140, :3] = ORANGE
    finger = sketch(None, np.array([0.5, 0.0, 0.08]))
    black = np.zeros((240, 320, 4), np.uint8)
    guess = np.array([0.5, 0.0, RADIUS])
    for picture in (noise, orange, square, finger, black, sketch()):
        for p in (None, guess, guess + [9.0, 0.0, 0.0], guess + [0.0, 0.0, 5.0]):
            assert find_ball(picture, CAMERA, WEIGHTS, RADIUS, 0.0, p) is None


@pytest.mark.parametrize("factor", [0.3, 0.5, 0.57, 1.75, 2.0, 3.0])
def test_a_ball_of_quite_another_size_gives_none(factor):
    for x, y in [(0.5, 0.0), (0.6, 0.1), (0.38, -0.12)]:
        picture = sketch([x, y, RADIUS], radius=factor * RADIUS)
        assert find_ball(picture, CAMERA, WEIGHTS, RADIUS, 0.0) is None


def test_a_ball_of_another_hue_gives_none():
    ball = [0.5, 0.0, RADIUS]
    blue = strength_weights(HUE + np.pi)
    assert find_ball(sketch(ball), CAMERA, blue, RADIUS, 0.0) is None


# Numerics: the filter.


def matrices(dt, q):
    """Transition and noise of [p, v], by Van Loan's matrix exponential."""
    A, G = np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, q])
    block = expm(np.block([[-A, G], [np.zeros((2, 2)), A.T]]) * dt)
    Phi = block[2:, 2:].T
    return Phi, Phi @ block[:2, 2:]


def test_one_step_of_the_filter_is_the_textbook_one():
    dt, q, sigma = 0.0125, 0.03, 1e-3
    Phi, Q = matrices(dt, q)
    p, v, P = np.array([0.5, 0.1]), np.array([0.2, -0.1]), np.array([4e-6, 1e-5, 1e-3])
    measured = np.array([0.504, 0.098])
    p1, v1, P1 = constant_velocity.predict(p, v, P, dt, q)
    p2, v2, P2 = constant_velocity.correct(p1, v1, P1, measured, sigma)
    full = Phi @ np.array([[P[0], P[1]], [P[1], P[2]]]) @ Phi.T + Q
    gain = full[:, 0] / (full[0, 0] + sigma**2)
    after = full - np.outer(gain, full[0])
    np.testing.assert_allclose(P1, [full[0, 0], full[0, 1], full[1, 1]], rtol=1e-12)
    np.testing.assert_allclose(P2, [after[0, 0], after[0, 1], after[1, 1]], rtol=1e-12)
    for i in range(2):
        x = Phi @ [p[i], v[i]]
        x = x + gain * (measured[i] - x[0])
        np.testing.assert_allclose([p2[i], v2[i]], x, rtol=1e-12)


def test_the_covariance_settles_where_the_riccati_equation_says():
    dt, q, sigma = 0.0125, 0.03, 1e-3
    Phi, Q = matrices(dt, q)
    H = np.array([[1.0, 0.0]])
    predicted = solve_discrete_are(Phi.T, H.T, Q, np.array([[sigma**2]]))
    p = v = np.zeros(2)
    P = np.array([sigma**2, 0.0, 0.1])
    for _ in range(400):
        p, v, P = constant_velocity.correct(p, v, P, p, sigma)
        p, v, P = constant_velocity.predict(p, v, P, dt, q)
    expected = [predicted[0, 0], predicted[0, 1], predicted[1, 1]]
    np.testing.assert_allclose(P, expected, rtol=1e-6)  # scipy's accuracy for dare.


# The system.


class Rig:
    """A tracker that is shown sketches, frame by frame."""

    def __init__(self, **config):
        self.tracker = BallTracker(BallTrackerConfig(**config), CAMERA)
        self.simulator = Simulator(self.tracker)
        self.context = self.simulator.get_mutable_context()
        self.k = 0

    def show(self, picture):
        height, width = picture.shape[:2]
        image = ImageRgba8U(width, height)
        image.mutable_data[:] = picture
        self.tracker.GetInputPort("image").FixValue(self.context, Value(image))
        self.simulator.AdvanceTo((self.k + 0.5) * 0.0125)
        self.k += 1

    def __getattr__(self, name):
        value = self.tracker.GetOutputPort(name).Eval(self.context)
        return value if len(value) > 1 else value[0]


def test_what_is_outside_its_region_changes_nothing():
    """So a camera need not render it."""
    whole, part = Rig(), Rig()
    assert np.isnan(whole.region).all()  # Everywhere, as nothing was seen.
    for k in range(40):
        picture = sketch(np.array([0.55 + 0.002 * k, -0.1 + 0.003 * k, RADIUS]))
        masked = picture.copy()
        if np.isfinite(part.region).all():
            u, v, half = part.region
            rows, columns = np.indices(picture.shape[:2])
            masked[(abs(rows - v) > half + 2) | (abs(columns - u) > half + 2)] = 0
        whole.show(picture)
        part.show(masked)
        assert part.status == TRACKED
        np.testing.assert_array_equal(part.p_WB, whole.p_WB)
        np.testing.assert_array_equal(part.v_WB, whole.v_WB)
    assert np.isfinite(part.region).all() and part.region[2] < 60.0
    for _ in range(3):
        part.show(sketch())  # It is gone.
    assert np.isnan(part.region).all()


def test_before_the_first_picture_nothing_is_seen_and_all_is_finite():
    rig = Rig()
    assert rig.seen == 0.0 and rig.status == NOT_FOUND and rig.reading[0] == -1.0
    np.testing.assert_array_equal(rig.p_WB, [0.5, 0.0, RADIUS])
    np.testing.assert_array_equal(rig.v_WB, np.zeros(3))


def test_a_ball_that_rolls_on_is_followed_with_its_velocity():
    rig = Rig()
    v = np.array([0.06, 0.08, 0.0])
    for k in range(80):
        p = np.array([0.45, -0.05, RADIUS]) + 0.0125 * k * v
        rig.show(sketch(p, tip_above(p, 0.01, 0.03 * k)))
        assert rig.seen == 1.0
    np.testing.assert_allclose(rig.p_WB, p, atol=5e-4)
    # Steady gain to v: 1.7 /s, times errors of .2 mm that last for a few frames.
    np.testing.assert_allclose(rig.v_WB, v, atol=0.01)
    assert rig.v_WB[2] == 0.0 and rig.p_WB[2] == RADIUS
    assert rig.position_std < 1e-3  # Below that of one measurement.


def test_a_ball_that_rocks_is_followed_with_two_models_of_motion():
    """8 mm at 2.2 Hz, with the slow filter of ball_rolling: the one beside it helps."""
    off = {}
    for driven in (0.0, 0.3):
        rig = Rig(
            position_std=1.5e-3, motion=BallMotionConfig(4e-3, driven, 2.0, 0.2)
        )  # fmt: skip
        errors = []
        for k in range(160):
            p = np.array([0.5, 0.0, RADIUS])
            p[0] += 8e-3 * np.sin(2.0 * np.pi * 2.2 * 0.0125 * k)
            rig.show(sketch(p))
            errors.append(rig.p_WB[0] - p[0])
        off[driven] = np.sqrt(np.mean(np.square(errors[40:])))
    assert off[0.3] < 0.6 * off[0.0]


def test_a_lost_ball_is_said_held_and_found_again():
    rig = Rig()
    v = np.array([0.1, 0.0, 0.0])
    for k in range(40):
        p_seen = np.array([0.45, 0.0, RADIUS]) + 0.0125 * k * v
        rig.show(sketch(p_seen))
    p_last, v_last, std_last = rig.p_WB, rig.v_WB, rig.position_std
    assert v_last[0] > 0.05
    std = []
    for k in range(40):
        rig.show(sketch())
        assert rig.seen == 0.0 and rig.status == NOT_FOUND
        np.testing.assert_array_equal(rig.p_WB, p_last)
        held = 0.0125 * (k + 1) <= HOLD_SEC
        np.testing.assert_array_equal(rig.v_WB, v_last if held else np.zeros(3))
        std.append(rig.position_std)
    assert (np.diff([std_last, *std]) > 0.0).all()
    np.testing.assert_allclose(rig.reading[:4], [0.4875, *p_seen], atol=5e-4)
    elsewhere = np.array([0.6, -0.12, RADIUS])
    rig.show(sketch(elsewhere))
    assert rig.seen == 1.0
    np.testing.assert_allclose(rig.p_WB, elsewhere, atol=5e-4)
    np.testing.assert_allclose(rig.reading[:4], [1.0, *elsewhere], atol=5e-4)
    np.testing.assert_array_equal(rig.reading[4:], [1.0, 0.0, 0.0, 0.0])
    rig.show(sketch(elsewhere))
    np.testing.assert_allclose(rig.v_WB, 0.0, atol=0.05)


@pytest.mark.parametrize("jump", [0.02, 0.1])
def test_a_ball_that_was_moved_is_not_locked_out(jump):
    rig = Rig()
    before, after = np.array([0.5, 0.05, RADIUS]), np.array([0.5, 0.05 - jump, RADIUS])
    for _ in range(40):
        rig.show(sketch(before))
    for _ in range(PATIENCE + 1):  # The first may miss it: it is out of the window.
        rig.show(sketch(after))
    assert rig.seen == 1.0
    np.testing.assert_allclose(rig.p_WB, after, atol=5e-4)


def test_a_single_false_sight_is_not_followed():
    rig = Rig()
    ball = np.array([0.5, 0.05, RADIUS])
    for _ in range(40):
        rig.show(sketch(ball))
    rig.show(sketch(ball + [0.02, 0.0, 0.0]))
    assert rig.seen == 0.0
    np.testing.assert_allclose(rig.p_WB, ball, atol=5e-4)
    rig.show(sketch(ball))
    assert rig.seen == 1.0


@pytest.mark.parametrize("error", [-0.004, 0.005])
def test_a_learned_radius_puts_the_ball_where_it_is(error):
    """Seen from the side, a ball of which the model's radius is wrong lies elsewhere on
    the camera's ray."""
    ball = np.array([0.62, 0.15, RADIUS - error])  # The sketch's is as large as RADIUS.
    off = {}
    for told in (None, error, np.nan):
        rig = Rig()
        if told is not None:
            rig.tracker.GetInputPort("radius_error").FixValue(rig.context, [told])
        for _ in range(40):
            rig.show(sketch(ball))
        off[told] = rig.p_WB[:2] - ball[:2]
        assert rig.p_WB[2] == RADIUS
    # As many times the error as the ray goes sideways per metre down.
    np.testing.assert_allclose(
        off[None], -error * (ball - CAMERA.p_WC)[:2] / (0.8 - RADIUS), atol=3e-4
    )
    np.testing.assert_allclose(off[error], 0.0, atol=3e-4)
    np.testing.assert_array_equal(*(v for k, v in off.items() if k != error))


def test_a_picture_of_wrong_size_is_a_status_and_the_estimate_is_held():
    rig = Rig()
    ball = np.array([0.5, 0.05, RADIUS])
    rig.show(sketch(ball))
    p = rig.p_WB
    for shape in ((120, 160, 4), (1, 1, 4), (480, 640, 4)):
        rig.show(np.zeros(shape, np.uint8))
        assert rig.seen == 0.0 and rig.status == WRONG_IMAGE
        np.testing.assert_array_equal(rig.p_WB, p)
    rig.show(sketch(ball))
    assert rig.seen == 1.0 and rig.status == TRACKED


def test_any_picture_leaves_every_output_finite():
    rng = np.random.default_rng(0)
    rig = Rig()
    for k in range(40):
        p = rng.uniform([0.1, -0.4, 0.0], [0.9, 0.4, 0.3])
        picture = sketch(p, None, rng.uniform(0.01, 0.1))
        if k % 4 == 0:
            picture = rng.integers(0, 256, picture.shape, np.uint8)
        rig.show(picture)
        for name in ("p_WB", "v_WB", "seen", "status", "position_std"):
            assert np.isfinite(getattr(rig, name)).all()


def test_a_saved_context_replays_bit_for_bit():
    rig = Rig()
    ball = np.array([0.5, 0.05, RADIUS])
    rig.show(sketch(ball))
    rig.show(sketch(ball + [0.001, 0.0, 0.0]))
    saved, k = rig.context.Clone(), rig.k
    rig.show(sketch(ball + [0.003, 0.0, 0.0]))
    first = np.concatenate([rig.p_WB, rig.v_WB])
    rig.show(sketch())
    rig.simulator.reset_context(saved)
    rig.simulator.Initialize()
    rig.context, rig.k = rig.simulator.get_mutable_context(), k
    rig.show(sketch(ball + [0.003, 0.0, 0.0]))
    np.testing.assert_array_equal(np.concatenate([rig.p_WB, rig.v_WB]), first)


@pytest.mark.parametrize(
    "config, message",
    [
        (dict(ball_radius=0.0), "ball_radius must be positive, got 0.0"),
        (dict(ball_radius=np.nan), "ball_radius is nan, expected a number"),
        (dict(position_std=-1e-3), "position_std must be positive, got -0.001"),
        (dict(motion=BallMotionConfig(0.0)), "acceleration_density must be positive"),
        (dict(motion=BallMotionConfig(driven_density=-1.0)), "driven_density is -1.0"),
        (dict(motion=BallMotionConfig(driven_sec=0.0)), "driven_sec must be positive"),
        (dict(table_z=0.9), "the camera at height 0.8 must be above the ball"),
        (dict(hue=np.inf), "hue must be finite, got inf"),
        (dict(period_sec=0.0), "period_sec is 0.0, expected a positive time"),
    ],
)
def test_a_tracker_that_cannot_be_is_refused_by_name(config, message):
    with pytest.raises(ValueError, match=message):
        BallTracker(BallTrackerConfig(**config), CAMERA)

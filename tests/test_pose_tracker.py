"""Finding a flat object in a picture, and following it."""

import cv2
import numpy as np
import pytest
from object_alone import object_alone
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import ImageRgba8U

from makebreak.diagrams.camera import (
    CameraConfig,
    add_camera,
    camera_model,
    vtk_works,
)
from makebreak.models.pushed_object import (
    HUE,
    PushedObject,
    rest_height,
    seen_parts,
)
from makebreak.models.scene import load_scene
from makebreak.systems.perception.numerics import constant_velocity
from makebreak.systems.perception.numerics.aruco_marker import find_marker
from makebreak.systems.perception.numerics.ball_tracker import strength_weights
from makebreak.systems.perception.numerics.object_outline import make_shape, nearest_yaw
from makebreak.systems.perception.numerics.pose_tracker import (
    MIN_SEEN,
    find_pose,
    rolling_turn,
)
from makebreak.systems.perception.pose_tracker import (
    HOLD_SEC,
    NOT_FOUND,
    OUTLIER,
    PATIENCE,
    START_RATE,
    START_SPEED,
    TRACKED,
    WRONG_IMAGE,
    Marker,
    PoseTracker,
    PoseTrackerConfig,
)

WEIGHTS = strength_weights(HUE)
CAMERA = camera_model(CameraConfig())
ARM, DARK, BLUE = (236, 236, 238, 255), (60, 62, 66, 255), (30, 60, 220, 255)
RENDERERS = [
    "drawn",
    pytest.param(
        "vtk",
        marks=pytest.mark.skipif(
            not vtk_works(), reason="Drake cannot render here: no GL libraries"
        ),
    ),
]
_photographers: dict = {}
# A house: 0.14 x 0.1 m, with a gable over +y.
HOUSE = 0.1 * np.array([[-0.7, -0.5], [0.7, -0.5], [0.7, 0.3], [0.0, 0.8], [-0.7, 0.3]])


def test_what_rolls_turns_so_that_it_does_not_slip():
    height, yaw = 0.02, 0.7
    rate = np.array([0.05, -0.08, 0.4])
    axis = np.array([1.0, 0.0, 0.0])
    w = rolling_turn(rate, yaw, axis, height)
    level = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    # Where it touches the table it is at rest, but along its axis, where it slides.
    foot = np.array([*rate[:2], 0.0]) + np.cross(w, [0.0, 0.0, -height])
    np.testing.assert_allclose(foot, (foot @ level) * level, atol=1e-12)
    assert foot @ level == pytest.approx(rate[:2] @ level[:2])
    assert w[2] == 0.4 and np.linalg.norm(w[:2]) > 1.0
    # What does not roll turns about the vertical alone.
    np.testing.assert_array_equal(
        rolling_turn(rate, yaw, np.zeros(3), height), [0.0, 0.0, 0.4]
    )


def shape_of(name, **changes):
    return make_shape(*seen_parts(PushedObject(name, **changes)))


def photograph(pose, name="t", renderer="drawn", **changes):
    """A picture of the object alone on the table, at x, y, yaw."""
    spec = PushedObject(name, **changes)
    key = (repr(spec), renderer)
    if key not in _photographers:
        scene = object_alone(spec)
        scene.initial.positions = {}
        builder = DiagramBuilder()
        loaded = load_scene(scene, builder)
        config = CameraConfig(renderer=renderer)
        port = add_camera(builder, loaded.scene_graph, loaded.plant, config, 0)
        builder.ExportOutput(port, "image")
        diagram = builder.Build()
        _photographers[key] = diagram, loaded.plant, diagram.CreateDefaultContext()
    diagram, plant, context = _photographers[key]
    X = RigidTransform(
        RotationMatrix.MakeZRotation(pose[2]), [pose[0], pose[1], rest_height(spec)]
    )
    body = plant.GetBodyByName("object")
    plant.SetFreeBodyPose(plant.GetMyMutableContextFromRoot(context), body, X)
    return diagram.GetOutputPort("image").Eval(context).data.copy()


def poses(n, seed=0, reach=(0.08, 0.16)):
    """(n, 3) within sight of the camera."""
    rng = np.random.default_rng(seed)
    at = [0.5, 0.0] + rng.uniform(-1.0, 1.0, (n, 2)) * reach
    return np.column_stack([at, rng.uniform(-np.pi, np.pi, n)])


def error(found, pose, fold):
    """Of a Detection, [m], [rad]."""
    off = nearest_yaw(found.pose[2], fold, pose[2]) - pose[2]
    return np.hypot(*(found.pose[:2] - pose[:2])), abs(off)


def hide(picture, pose, part, direction, color=ARM):
    """An arm, a band of 110 px (some 25 cm), reaches over the object along a direction
    [rad, in the picture] so far that 1 - part of the coloured pixels are seen."""
    strength = cv2.transform(picture, WEIGHTS)
    v, u = np.nonzero(strength > 60)
    along = np.array([np.cos(direction), np.sin(direction)])
    edge = np.quantile(np.stack([u, v], axis=1) @ along, 1.0 - part)
    rows, columns = np.indices(picture.shape[:2])
    picture = picture.copy()
    far = columns * along[0] + rows * along[1]
    middle = np.array([u.mean(), v.mean()]) @ [-along[1], along[0]]
    aside = rows * along[0] - columns * along[1] - middle
    picture[(far > edge) & (abs(aside) < 55)] = color
    return picture


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("name", ["t", "l", "box", "disc"])
def test_flat_object_is_found_anywhere_to_a_millimetre_and_a_hundredth_of_a_radian(
    renderer, name
):
    shape, z = shape_of(name), rest_height(PushedObject(name))
    for pose in poses(12):
        picture = photograph(pose, name, renderer)
        found = find_pose(picture, CAMERA, WEIGHTS, shape, z)
        p, yaw = error(found, pose, shape.fold)
        assert p < 1e-3 and yaw < 0.01 and found.seen_part > 0.9
        # And from where it should be, 5 mm and 3 degrees off.
        near = pose + [0.004, -0.003, 0.05]
        found = find_pose(picture, CAMERA, WEIGHTS, shape, z, near)
        p, yaw = error(found, pose, shape.fold)
        assert p < 1e-3 and yaw < 0.01


@pytest.mark.parametrize("renderer", RENDERERS)
def test_lying_cylinder_is_found(renderer):
    shape, z = shape_of("cylinder"), 0.02
    for pose in poses(12):
        picture = photograph(pose, "cylinder", renderer)
        p, yaw = error(find_pose(picture, CAMERA, WEIGHTS, shape, z), pose, 2)
        # A rendered cylinder is dark where its surface is steep.
        assert p < 3e-3 and yaw < 0.03


@pytest.mark.parametrize("renderer", RENDERERS)
def test_convex_mesh_is_drawn_and_found(renderer, tmp_path):
    path = tmp_path / "house.obj"
    prism = [(*p, z) for z in (0.0, 0.01) for p in HOUSE]
    lines = [f"v {x} {y} {z}" for x, y, z in prism]
    lines += ["f 5 4 3 2 1", "f 6 7 8 9 10"]
    lines += [f"f {i + 1} {j + 1} {j + 6} {i + 6}" for i, j in zip(
        range(5), (1, 2, 3, 4, 0), strict=True)]  # fmt: skip
    path.write_text("\n".join(lines) + "\n")
    mesh = dict(name="mesh", file=str(path))
    shape, z = shape_of(**mesh), rest_height(PushedObject("mesh", file=str(path)))
    assert shape.fold == 1
    for pose in poses(6):
        picture = photograph(pose, renderer=renderer, **mesh)
        found = find_pose(picture, CAMERA, WEIGHTS, shape, z)
        p, yaw = error(found, pose, 1)
        # Its sides, 10 mm high, have the colour too, and are dark in VTK's light.
        assert p < 1.5e-3 and yaw < 0.02


@pytest.mark.parametrize("color", [ARM, DARK])
@pytest.mark.parametrize("name", ["t", "l", "box", "disc"])
def test_a_third_hidden_costs_little(name, color):
    shape, z = shape_of(name), rest_height(PushedObject(name))
    directions = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, 12)
    off = []
    for pose, direction in zip(poses(12), directions, strict=True):
        picture = hide(photograph(pose, name), pose, 0.33, direction, color)
        found = find_pose(picture, CAMERA, WEIGHTS, shape, z)
        off.append(error(found, pose, shape.fold))
        near = pose + [0.004, -0.003, 0.03]
        found = find_pose(picture, CAMERA, WEIGHTS, shape, z, near)
        off.append(error(found, pose, shape.fold))
    p, yaw = np.max(off, axis=0)
    assert p < 3e-3 and yaw < 0.03


@pytest.mark.parametrize("name", ["t", "box"])
def test_half_hidden_is_found_right_or_not_at_all(name):
    shape, z = shape_of(name), 0.02
    directions = np.random.default_rng(2).uniform(0.0, 2.0 * np.pi, 16)
    n_found = 0
    for pose, direction in zip(poses(16), directions, strict=True):
        picture = hide(photograph(pose, name), pose, 0.5, direction)
        found = find_pose(picture, CAMERA, WEIGHTS, shape, z, pose + [0.004, 0, 0.03])
        if found is not None:
            p, yaw = error(found, pose, shape.fold)
            assert p < 5e-3 and yaw < 0.05
            n_found += 1
    assert n_found >= 12


def test_what_one_straight_edge_leaves_open_is_not_guessed():
    shape, pose = shape_of("box"), np.array([0.5, 0.0, 0.3])
    picture = photograph(pose, "box")
    # A strip of the picture about the middle of the two long sides is left.
    c, s = np.cos(pose[2]), np.sin(pose[2])
    rows, columns = np.indices(picture.shape[:2])
    u = columns - CAMERA.center[0]
    v = rows - CAMERA.center[1]
    along = -c * u - s * v  # Along the box's y axis, in pixels.
    picture[abs(along) > 15] = ARM
    assert find_pose(picture, CAMERA, WEIGHTS, shape, 0.02, pose) is None


def test_noise_a_shadow_and_another_colour_do_not_mislead():
    shape, rng = shape_of("t"), np.random.default_rng(3)
    for pose in poses(8):
        picture = photograph(pose)
        cv2.rectangle(picture, (10, 10), (70, 60), BLUE, -1)
        cv2.circle(picture, (280, 200), 25, (40, 160, 60, 255), -1)
        noisy = picture[:, :, :3] + rng.normal(0.0, 8.0, picture[:, :, :3].shape)
        light = np.linspace(0.75, 1.0, picture.shape[1])[None, :, None]
        picture[:, :, :3] = np.clip(noisy * light, 0, 255)
        p, yaw = error(find_pose(picture, CAMERA, WEIGHTS, shape, 0.02), pose, 1)
        assert p < 1.5e-3 and yaw < 0.015


@pytest.mark.parametrize("scale", [0.9, 1.1])
@pytest.mark.parametrize("name", ["t", "box"])
def test_object_of_another_size_than_modelled_is_found(name, scale):
    """The model has size 1: edges are up to 8 mm from where they should be."""
    shape = shape_of(name)
    for pose in poses(8):
        picture = photograph(pose, name, scale=scale)
        p, yaw = error(find_pose(picture, CAMERA, WEIGHTS, shape, 0.02), pose, 2)
        assert p < 6e-3 and yaw < 0.05


def test_nothing_is_found_where_nothing_of_the_kind_is():
    shape = shape_of("t")
    empty = photograph([0.5, 2.0, 0.0])  # Far out of sight.
    assert find_pose(empty, CAMERA, WEIGHTS, shape, 0.02) is None
    assert find_pose(empty, CAMERA, WEIGHTS, shape, 0.02, [0.5, 0.0, 0.0]) is None
    other = photograph([0.5, 0.0, 0.0], "disc")
    assert find_pose(other, CAMERA, WEIGHTS, shape, 0.02) is None
    assert find_pose(empty, CAMERA, WEIGHTS, shape, 0.02, [5.0, 5.0, 0.0]) is None


def test_turns_that_leave_an_outline_as_it_is_are_found_out():
    folds = {"t": 1, "l": 1, "box": 2, "disc": 0, "cylinder": 2}
    assert {name: shape_of(name).fold for name in folds} == folds
    corners = [[1, 0, 0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0]]
    assert make_shape([0.05 * np.array(corners)]).fold == 3
    square = 0.05 * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
    assert make_shape([square]).fold == 4
    cross = [square * [1, 0.3, 0], square * [0.3, 1, 0]]
    assert make_shape(cross).fold == 4


def test_nearest_yaw_is_the_same_outline_and_nearest():
    assert nearest_yaw(0.1, 1, 6.3) == pytest.approx(0.1 + 2 * np.pi)
    assert nearest_yaw(3.0, 2, 0.0) == pytest.approx(3.0 - np.pi)
    assert nearest_yaw(1.0, 0, -7.0) == -7.0


def test_shapes_that_are_none_are_refused():
    with pytest.raises(ValueError, match="colored is empty, expected one part"):
        make_shape([])
    with pytest.raises(ValueError, match=r"colored has a part of shape \(2, 3\)"):
        make_shape([np.zeros((2, 3))])
    with pytest.raises(ValueError, match="whole has a point that is not finite"):
        make_shape([np.eye(3)], [np.full((3, 3), np.nan)])


# ----- The marker.

SIDE = 0.05
FINE = CameraConfig(width=640, height=480)


def with_marker(pose, number=7, side=SIDE, camera=None):
    """A picture of a marker that lies flat at height 0.04, as a camera sees it."""
    camera = camera_model(FINE) if camera is None else camera
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    n = 120
    marker = cv2.aruco.generateImageMarker(dictionary, number, n)
    paper = cv2.copyMakeBorder(marker, 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=255)
    corners = Marker(number, side).corners()[:, :2]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    xy = corners @ np.array([[c, s], [-s, c]]) + pose[:2]
    p_W = np.column_stack([xy, np.full(4, 0.04)])
    uv = camera.project(camera.to_camera(p_W)).astype(np.float32)
    at = np.array([[20, 20], [20 + n, 20], [20 + n, 20 + n], [20, 20 + n]], np.float32)
    H = cv2.getPerspectiveTransform(at - 0.5, uv)
    size = (camera.width, camera.height)
    grey = cv2.warpPerspective(paper, H, size, flags=cv2.INTER_AREA, borderValue=200)
    picture = np.full((camera.height, camera.width, 4), 255, np.uint8)
    picture[:, :, :3] = grey[:, :, None]
    return picture


def test_marker_gives_the_pose_and_only_the_right_one_does():
    camera, corners = camera_model(FINE), Marker(7, SIDE).corners()
    for pose in poses(10):
        picture = with_marker(pose)
        found = find_marker(picture, camera, 7, corners, 0.02)
        p, yaw = error(found, pose, 1)
        assert p < 1e-3 and yaw < 0.02
        assert find_marker(picture, camera, 8, corners, 0.02) is None
        small = Marker(7, 0.7 * SIDE).corners()
        assert find_marker(picture, camera, 7, small, 0.02) is None


def test_marker_beside_the_origin_and_turned():
    camera = camera_model(FINE)
    marker = Marker(7, SIDE, center=(0.02, -0.01, 0.02), yaw=0.6)
    pose = np.array([0.47, 0.08, -0.9])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    at = pose[:2] + [c * 0.02 + s * 0.01, s * 0.02 - c * 0.01]
    picture = with_marker([*at, pose[2] + 0.6])
    found = find_marker(picture, camera, 7, marker.corners(), 0.02)
    p, yaw = error(found, pose, 1)
    assert p < 1.5e-3 and yaw < 0.02


# ----- The system.


class Follower:
    """A PoseTracker that is shown one picture after the other."""

    def __init__(self, name="t", config=None, marker=None, camera=CAMERA):
        self.config = PoseTrackerConfig() if config is None else config
        self.tracker = PoseTracker(self.config, camera, shape_of(name), marker)
        self.context = self.tracker.CreateDefaultContext()
        self.simulator = Simulator(self.tracker, self.context)
        self.n = 0

    def show(self, picture):
        image = ImageRgba8U(picture.shape[1], picture.shape[0])
        image.mutable_data[:] = picture
        port = self.tracker.GetInputPort("image")
        port.FixValue(self.context, Value(image))
        self.simulator.AdvanceTo((self.n + 0.5) * self.config.period_sec)
        self.n += 1
        return self

    def get(self, name):
        value = self.tracker.GetOutputPort(name).Eval(self.context)
        assert np.isfinite(value).all()
        return value if len(value) > 1 else float(value[0])


def test_before_the_first_sight_it_is_below_the_camera_and_not_seen():
    follower = Follower()
    np.testing.assert_allclose(follower.get("p_WB"), [0.5, 0.0, 0.02])
    np.testing.assert_allclose(follower.get("q_WB"), [1, 0, 0, 0])
    assert follower.get("seen") == 0.0 and follower.get("status") == NOT_FOUND
    assert follower.get("reading")[0] == -1.0


def test_moving_and_turning_object_is_followed_with_its_rates():
    follower = Follower()
    start, rate = np.array([0.45, -0.1, 2.5]), np.array([0.05, 0.1, 0.8])
    for k in range(80):  # 1 s; the yaw passes pi.
        pose = start + rate * k * 0.0125
        follower.show(photograph(pose))
        assert follower.get("seen") == 1.0
    np.testing.assert_allclose(follower.get("p_WB"), [*pose[:2], 0.02], atol=1e-3)
    assert follower.get("yaw") == pytest.approx(pose[2], abs=0.01)
    q = RotationMatrix.MakeZRotation(pose[2]).ToQuaternion().wxyz()
    assert abs(follower.get("q_WB") @ q) > 1.0 - 1e-4
    np.testing.assert_allclose(follower.get("v_WB"), [0.05, 0.1, 0.0], atol=0.015)
    np.testing.assert_allclose(follower.get("w_WB"), [0.0, 0.0, 0.8], atol=0.1)


def test_position_and_yaw_are_filtered_by_their_own_standard_deviations():
    follower = Follower()
    c = follower.config
    for _ in range(2):
        follower.show(photograph(np.array([0.5, 0.0, 0.4])))
    expected = []
    for sigma, speed, density in (
        (c.position_std, START_SPEED, c.motion.acceleration_density),
        (c.yaw_std, START_RATE, c.motion.turning_density),
    ):
        P, zero = np.array([sigma**2, 0.0, speed**2]), np.zeros(2)
        *_, P = constant_velocity.predict(zero, zero, P, c.period_sec, density)
        *_, P = constant_velocity.correct(zero, zero, P, zero, sigma)
        expected.append(np.sqrt(P[0]))
    np.testing.assert_allclose(follower.get("std"), expected, rtol=1e-9)


def test_yaw_of_a_box_goes_on_without_jumps_and_of_a_disc_stays():
    for name, expected in (("box", 1.8 * 2), ("disc", 0.0)):
        follower = Follower(name)
        for k in range(161):
            follower.show(photograph([0.5, 0.02, 1.8 * k * 0.0125], name))
        # A first sight is nearest to yaw 0.
        assert follower.get("yaw") == pytest.approx(expected, abs=0.03)


def test_hidden_object_is_held_and_comes_to_rest_and_is_found_again():
    follower = Follower()
    for k in range(40):
        follower.show(photograph([0.45 + 0.1 * k * 0.0125, 0.0, 0.3]))
    held, std = follower.get("p_WB"), follower.get("std")
    # As it was measured: where it is, and not where a filter has it.
    read, half = follower.get("reading"), [np.cos(0.15), 0.0, 0.0, np.sin(0.15)]
    assert read[0] == pytest.approx(39 * 0.0125, abs=1e-9)
    np.testing.assert_allclose(read[1:4], [0.45 + 0.1 * read[0], 0.0, 0.02], atol=5e-4)
    np.testing.assert_allclose(read[4:], half, atol=3e-3)
    empty = photograph([0.5, 2.0, 0.0])
    follower.show(empty)
    assert follower.get("seen") == 0.0 and follower.get("v_WB")[0] > 0.05
    for _ in range(int(HOLD_SEC / 0.0125) + 1):
        follower.show(empty)
    np.testing.assert_allclose(follower.get("p_WB"), held, atol=1e-12)
    np.testing.assert_array_equal(follower.get("reading"), read)
    assert (follower.get("v_WB") == 0.0).all() and (follower.get("w_WB") == 0.0).all()
    assert (follower.get("std") > std).all()
    follower.show(photograph([0.55, 0.1, -2.0]))  # Elsewhere.
    assert follower.get("seen") == 1.0
    np.testing.assert_allclose(follower.get("p_WB"), [0.55, 0.1, 0.02], atol=1e-3)


def test_one_far_off_measurement_is_an_outlier_several_are_believed():
    follower = Follower()
    for _ in range(40):
        follower.show(photograph([0.5, 0.0, 0.3]))
    moved = photograph([0.5, 0.0, 0.65])
    for _ in range(PATIENCE - 1):
        follower.show(moved)
        assert follower.get("status") in (OUTLIER, NOT_FOUND)
        assert follower.get("yaw") == pytest.approx(0.3, abs=0.01)
    for _ in range(12):
        follower.show(moved)
    assert follower.get("status") == TRACKED
    assert follower.get("yaw") == pytest.approx(0.65, abs=0.01)


def test_wrong_image_is_not_used():
    follower = Follower()
    follower.show(photograph([0.5, 0.0, 0.3]))
    before = follower.get("p_WB")
    follower.show(np.zeros((10, 10, 4), np.uint8))
    assert follower.get("status") == WRONG_IMAGE and follower.get("seen") == 0.0
    np.testing.assert_allclose(follower.get("p_WB"), before)
    follower.show(np.zeros((CAMERA.height, CAMERA.width, 4), np.uint8))
    assert follower.get("status") == NOT_FOUND


def test_marker_is_followed_in_place_of_an_outline():
    camera = camera_model(FINE)
    follower = Follower("t", marker=Marker(7, SIDE), camera=camera)
    for _ in range(5):
        follower.show(with_marker([0.48, 0.05, 1.0]))
    np.testing.assert_allclose(follower.get("p_WB"), [0.48, 0.05, 0.02], atol=1e-3)
    assert follower.get("yaw") == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(position_std=0.0), "position_std is 0.0, expected above 0"),
        (dict(yaw_std=np.nan), "yaw_std is nan, expected a number"),
        (dict(hue=np.inf), "hue is inf, expected a number"),
        (dict(z=0.9), "the camera at height 0.8 must be above the object"),
    ],
)
def test_what_makes_no_tracker_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        PoseTracker(PoseTrackerConfig(**changes), CAMERA, shape_of("t"))
    with pytest.raises(ValueError, match="marker has number 50 and side 0.04"):
        PoseTracker(PoseTrackerConfig(), CAMERA, shape_of("t"), Marker(50))


def test_less_than_a_quarter_of_the_outline_is_not_enough():
    assert MIN_SEEN == 0.25
    shape, pose = shape_of("t"), np.array([0.5, 0.0, 0.4])
    picture = hide(photograph(pose), pose, 0.85, 0.3)
    assert find_pose(picture, CAMERA, WEIGHTS, shape, 0.02, pose) is None

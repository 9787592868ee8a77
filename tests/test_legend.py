"""The legend in Meshcat, and tracks that grow."""

import base64
import json

import cv2
import numpy as np
import pytest
from pydrake.geometry import Meshcat, Rgba
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.diagrams.wiring import add_legend
from makebreak.systems.views.legend import ROOT, Legend, LegendConfig
from makebreak.systems.views.numerics.text_board import LINE, text_board
from makebreak.systems.views.numerics.trail import PIECE, Trail

RED = (1.0, 0.0, 0.0)


class Page:
    """Stands for Meshcat: what is drawn, and when each path is visible."""

    def __init__(self):
        self.lines, self.visible, self.deleted = {}, {}, []

    def SetLine(self, path, points, width, color):
        self.lines[path] = np.array(points).T

    def SetProperty(self, path, name, value, t=None):
        assert name == "visible"
        self.visible.setdefault(path, []).append((t, value))

    def Delete(self, path):  # What was recorded of it stays.
        self.deleted.append(path)
        for each in [k for k in self.lines if f"{k}/".startswith(f"{path}/")]:
            del self.lines[each]

    def played(self, t):
        """The points (n, 3) that a recording shows at t."""
        seen = []
        for path, points in self.lines.items():
            frames = dict(self.visible[path])  # The last that was said of a time.
            if frames[max(s for s in frames if s <= t)]:
                seen.append(points)
        return np.concatenate(seen) if seen else np.zeros((0, 3))


def along(n):
    return np.column_stack([np.arange(n), np.zeros(n), np.zeros(n)]).astype(float)


def test_a_track_grows_where_it_is_played_again():
    page = Page()
    trail = Trail(page, "/t", None)
    n = 5 * PIECE
    for k in range(1, n + 1):  # A point each second, the first at 0.
        trail.show(along(k), k - 1.0)
    for t in range(n):
        shown = page.played(t)
        assert (shown[:, 0] <= t).all()  # Nothing of what is to come,
        last = shown[:, 0].max() if len(shown) else 0.0
        assert t - last <= PIECE  # and a piece at most is missing,
        assert set(range(int(last))) <= set(shown[:, 0])
    assert set(page.played(n)[:, 0]) == set(range(n))  # at the end nothing.


def test_while_it_runs_all_of_a_track_is_seen_without_gaps():
    page = Page()
    trail = Trail(page, "/t", None)
    for k in range(1, 3 * PIECE + 3):
        trail.show(along(k), k - 1.0)
        seen = [p for path, p in page.lines.items() if page.visible[path][-1][1]]
        if k > 1:
            assert {int(x) for p in seen for x in p[:, 0]} == set(range(k))
            steps = {(a[0], b[0]) for p in seen for a, b in zip(p, p[1:], strict=False)}
            assert {(i, i + 1) for i in range(k - 1)} <= steps


def test_another_track_takes_the_one_before_away():
    page = Page()
    trail = Trail(page, "/t", None)
    trail.show(along(3 * PIECE), 5.0)
    trail.show(along(3 * PIECE + 4), 5.5)
    whole = page.played(5.5)
    assert len(whole) and len(page.played(6.0))
    trail.show(along(1) + 70.0, 6.0)
    assert not len(page.played(6.0)) and len(page.played(5.0))
    assert set(page.played(5.9)[:, 0]) == set(whole[:, 0]) == set(range(3 * PIECE + 4))
    for k in (2, PIECE, PIECE + 4):
        trail.show(along(k) + 70.0, 6.0 + k)
        assert page.played(6.0 + k)[:, 0].min() == 70.0
        assert page.played(5.9)[:, 0].max() < 70.0
    assert page.played(90.0)[:, 0].max() == 70.0 + PIECE + 3
    trail.show(np.zeros((0, 3)), 91.0)


def test_a_board_has_the_words_and_the_colour_and_is_read_from_left_to_right():
    board = text_board([("words", RED), ("i", None)])
    picture = cv2.imdecode(np.frombuffer(board.png, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[0] == 2 * LINE == board.height * LINE
    assert picture.shape[1] == pytest.approx(board.width * LINE)
    assert list(picture[LINE // 2, LINE // 2]) == [0, 0, 255]  # Blue first: red.
    dark = (picture < 80).all(axis=2)
    upper, lower = np.where(dark[:LINE].any(axis=0))[0], np.where(dark[LINE:])[1]
    assert upper.min() >= LINE and upper.max() < picture.shape[1]
    assert len(lower) and lower.max() < LINE  # A short word, without a square.
    # The picture's left is at y = 0 and its top at z = 0; it faces x. In glTF Drake's y
    # is -z, and its z is y.
    file = json.loads(board.gltf)

    def content(uri):
        return base64.b64decode(uri.split(",")[1])

    assert content(file["images"][0]["uri"]) == board.png
    data, arrays = content(file["buffers"][0]["uri"]), []
    kinds = {5126: ("<f4", 4), 5123: ("<u2", 2)}
    views = file["bufferViews"]
    for k, accessor in enumerate(file["accessors"]):
        view = views[accessor["bufferView"]]
        kind, size = kinds[accessor["componentType"]]
        assert view["byteOffset"] == sum(v["byteLength"] for v in views[:k])
        assert view["byteLength"] % (size * accessor["count"]) == 0
        part = data[view["byteOffset"] :][: view["byteLength"]]
        arrays.append(np.frombuffer(part, kind).reshape(accessor["count"], -1))
    position, texture, index = arrays
    corner = np.column_stack([position[:, 0], -position[:, 2], position[:, 1]])
    uv = np.column_stack([corner[:, 1] / board.width, -corner[:, 2] / board.height])
    np.testing.assert_allclose(texture, uv, atol=1e-6)  # Single precision.
    assert sorted(uv.round(6).tolist()) == [[0, 0], [0, 1], [1, 0], [1, 1]]
    for a, b, c in corner[index.ravel()].reshape(-1, 3, 3):
        assert np.cross(b - a, c - a)[0] > 0.0


class Scene(Page):
    """A page with objects that stand somewhere."""

    def __init__(self):
        super().__init__()
        self.objects, self.poses = {}, {}

    def SetObject(self, path, shape, color):
        self.objects[path] = shape

    def SetTransform(self, path, X):
        self.poses[path] = X


def legend(scene, phases=("a", "b")):
    builder = DiagramBuilder()
    phase = builder.AddSystem(ConstantVectorSource([1.0]))
    lines = [("goal", Rgba(1, 0, 0, 0.5)), ("track", Rgba(0, 0, 1))]
    config = LegendConfig(lines, phases, [1.0, 0.5, 1.0], [0.0, 0.2, 0.1])
    add_legend(builder, scene, config, phase.get_output_port())
    return config, phase, builder.Build()


def test_a_legend_is_in_the_upper_left_of_what_the_camera_sees_and_faces_it():
    scene = Scene()
    config, _, _ = legend(scene)
    camera = np.array(config.camera)
    away = np.array(config.look_at) - camera
    away /= np.linalg.norm(away)
    right = np.cross(away, [0, 0, 1]) / np.hypot(*away[:2])
    up = np.cross(right, away)
    for path in ("lines", "phase/0", "phase/1"):
        X = scene.poses[f"{ROOT}/{path}"]
        np.testing.assert_allclose(X.rotation().matrix()[:, 0], -away, atol=1e-12)
        np.testing.assert_allclose(X.rotation().matrix()[:, 2], up, atol=1e-12)
        seen = X.translation() - camera
        x, y = seen @ right / (seen @ away), seen @ up / (seen @ away)
        # Within 75 degrees from top to bottom, of a page as wide as it is high.
        assert -np.tan(np.radians(37.5)) < x < 0.0
        assert 0.0 < y < np.tan(np.radians(37.5))
    below = scene.poses[f"{ROOT}/lines"].translation()
    below = below - scene.poses[f"{ROOT}/phase/0"].translation()
    height = scene.objects[f"{ROOT}/lines"].scale3()[2]
    assert below @ up > 2 * height  # Below both lines.


def test_a_note_stands_below_the_phase_until_it_is_taken_away():
    scene = Scene()
    _, _, diagram = legend(scene)
    board = diagram.GetSubsystemByName("legend")
    board.note("compiling 1 of 2")
    above = scene.poses[f"{ROOT}/phase/0"].translation()
    height = scene.objects[f"{ROOT}/note"].scale3()[2]
    assert above[2] - scene.poses[f"{ROOT}/note"].translation()[2] > 0.5 * height
    del scene.objects[f"{ROOT}/note"]
    board.note("")
    assert f"{ROOT}/note" not in scene.objects
    assert scene.deleted[-1] == f"{ROOT}/note"


def test_a_camera_that_looks_straight_down_sees_the_legend_too():
    scene = Scene()
    config = LegendConfig([("goal", Rgba(1, 0, 0))], (), [0.0, 0, 2], [0.0, 0, 0])
    Legend(config, scene)
    X = scene.poses[f"{ROOT}/lines"]
    np.testing.assert_allclose(X.rotation().matrix()[:, 0], [0.0, 0.0, 1.0])
    x, y, z = X.translation()
    x, y = x / (2.0 - z), y / (2.0 - z)
    assert z < 2.0 and -0.767 < x < 0.0 < y < 0.767  # Meshcat has x right, y up.
    np.testing.assert_allclose(X.rotation().matrix()[:, 1], [1.0, 0.0, 0.0])


def test_a_camera_where_it_looks_at_is_refused():
    with pytest.raises(ValueError, match="expected not where it looks at"):
        Legend(LegendConfig([("a", Rgba(1, 0, 0))], (), [1, 0, 1], [1, 0, 1]), Scene())


def test_the_phase_alone_is_seen_and_its_changes_are_recorded():
    scene = Scene()
    _, phase, diagram = legend(scene)
    simulator = Simulator(diagram)
    own = phase.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    values = phase.get_mutable_source_value(own)

    def seen():
        paths = [f"{ROOT}/phase/{k}" for k in range(2)]
        return [scene.visible[path][-1][1] for path in paths]

    assert seen() == [False, False]
    for end, k, expected in ((1.0, 1, [False, True]), (2.0, 0, [True, False])):
        values.set_value([float(k)])
        simulator.AdvanceTo(end)
        assert seen() == expected
        t, shown = scene.visible[f"{ROOT}/phase/{k}"][-1]
        assert shown and end - 1.0 <= t < end - 1.0 + 0.1
    assert len(scene.visible[f"{ROOT}/phase/0"]) == 3  # What stays is not said twice.
    for k, end in ((7.0, 2.2), (1.0, 2.4), (np.nan, 2.6)):  # Without a text.
        values.set_value([k])
        simulator.AdvanceTo(end)
        assert seen() == [False, k == 1.0]


def test_a_second_simulation_says_its_phase_from_the_beginning():
    scene = Scene()
    _, _, diagram = legend(scene)
    for _ in range(2):
        scene.visible.clear()
        Simulator(diagram).AdvanceTo(0.3)
        assert scene.visible[f"{ROOT}/phase/1"] == [(0.0, True)]


def test_the_grid_and_the_axes_of_meshcat_are_hidden():
    page = Page()
    Legend(LegendConfig(), page)
    assert page.visible == {"/Grid": [(None, False)], "/Axes": [(None, False)]}


def test_a_real_meshcat_takes_a_legend():
    meshcat = Meshcat()
    _, _, diagram = legend(meshcat)
    Simulator(diagram).AdvanceTo(0.1)
    for path in ("lines", "phase/0", "phase/1"):
        assert meshcat.HasPath(f"{ROOT}/{path}")


def test_a_legend_without_lines_or_phases_draws_nothing():
    meshcat = Meshcat()
    Legend(LegendConfig(), meshcat)
    assert not meshcat.HasPath(ROOT)

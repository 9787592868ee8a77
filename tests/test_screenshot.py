"""What a browser shows of Meshcat's page."""

import shutil

import cv2
import numpy as np
import pytest
from pydrake.geometry import Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform

from makebreak.scripts.meshcat_page import page_of
from makebreak.scripts.screenshot import _BROWSERS, screenshot
from makebreak.systems.views.legend import Legend, LegendConfig
from makebreak.systems.views.numerics.trail import PIECE, Trail

needs_a_browser = pytest.mark.skipif(
    not any(map(shutil.which, _BROWSERS)), reason="no browser is installed"
)


def pixels(picture, color):
    """(n, 2) rows and columns of what has a hue: color, blue first, is 0 or 1 each."""
    strong = picture.astype(int)
    low, high = strong[:, :, color == 0], strong[:, :, color == 1]
    return np.argwhere(high.min(axis=2) > low.max(axis=2) + 60)


@needs_a_browser
@pytest.mark.parametrize("live", [False, True])
def test_a_page_shows_the_legend_a_body_and_its_track(tmp_path, live):
    camera, look_at = [1.0, 0.0, 0.4], [0.0, 0.0, 0.0]
    meshcat = Meshcat()
    for path in ("/Grid", "/Axes", "/Background"):
        meshcat.SetProperty(path, "visible", False)
    meshcat.SetCameraPose(camera, look_at)
    Legend(LegendConfig([("a ball", Rgba(1, 0, 0))], (), camera, look_at), meshcat)
    meshcat.SetObject("/ball", Sphere(0.05), Rgba(0, 1, 0))
    meshcat.SetTransform("/ball", RigidTransform([0.0, 0.1, 0.0]))
    points = np.zeros((3 * PIECE, 3))
    points[:, 1] = np.linspace(0.15, 0.6, len(points))
    Trail(meshcat, "/track", Rgba(0, 0, 1), 8.0).show(points, 1.0)
    page, png = tmp_path / "page.html", tmp_path / "page.png"
    page.write_text(page_of(meshcat))
    screenshot(meshcat.web_url() if live else page, png, size=(800, 600))
    picture = cv2.imread(str(png))
    assert picture.shape == (600, 800, 3)
    red = pixels(picture, np.array([0, 0, 1]))
    green = pixels(picture, np.array([0, 1, 0]))
    blue = pixels(picture, np.array([1, 0, 0]))
    blue = blue[blue[:, 0] > 200]  # Not what the controls are drawn in.
    assert len(red) and red.max() < 300  # The legend's square, to the upper left.
    row, column = green.mean(axis=0)  # The ball, in the middle and a little right.
    assert abs(row - 300) < 40 and 400 < column < 520
    assert len(blue) > 100 and blue[:, 1].min() > column  # On beyond the ball.


@needs_a_browser
def test_a_page_that_is_played_has_its_controls_open(tmp_path):
    meshcat = Meshcat()
    meshcat.StartRecording()
    meshcat.SetTransform("/ball", RigidTransform([0.0, 0.0, 1.0]), 1.0)
    meshcat.PublishRecording()
    shown = []
    for name, html in (("plain", meshcat.StaticHtml()), ("ours", page_of(meshcat))):
        page, png = tmp_path / f"{name}.html", tmp_path / f"{name}.png"
        page.write_text(html)
        screenshot(page, png, size=(800, 600))
        panel = cv2.imread(str(png))[20:200, -240:]
        shown.append((panel.max(axis=2) < 40).mean())
    assert shown[0] < 0.1 and shown[1] > 0.5  # The panel is black.


def test_no_page_is_told(tmp_path):
    with pytest.raises(ValueError, match="page: got .*none.html.*expected an HTML"):
        screenshot(tmp_path / "none.html", tmp_path / "a.png")

"""What a browser shows of Meshcat's page."""

import shutil
from functools import partial
from threading import Thread
from time import sleep

import cv2
import numpy as np
import pytest
from pydrake.geometry import Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from makebreak.scripts.runner.browser import BROWSERS, Browser
from makebreak.scripts.runner.meshcat_page import OPEN_CONTROLS, page_of
from makebreak.scripts.runner.screenshot import screenshot
from makebreak.systems.views.contact_view import FORCE_SLIDER, SPEED_SLIDER
from makebreak.systems.views.legend import Legend, LegendConfig
from makebreak.systems.views.model_sliders import FRICTION, GAP
from makebreak.systems.views.numerics.trail import PIECE, Trail
from makebreak.systems.views.rolling_view import GAP_SLIDER

needs_a_browser = pytest.mark.skipif(
    not any(map(shutil.which, BROWSERS)), reason="no browser is installed"
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
    at = meshcat.web_url() if live else page
    screenshot(at, png, size=(1300, 600), wait_ms=6000)
    picture = cv2.imread(str(png))
    assert picture.shape == (600, 1300, 3)
    picture = picture[:, 250:1050]  # Without the controls, to the right.
    red = pixels(picture, np.array([0, 0, 1]))
    green = pixels(picture, np.array([0, 1, 0]))
    blue = pixels(picture, np.array([1, 0, 0]))
    assert len(red) and red.max() < 300  # The legend's square, to the upper left.
    row, column = green.mean(axis=0)  # The ball, in the middle and a little right.
    assert abs(row - 300) < 40 and 400 < column < 520
    assert len(blue) > 100 and blue[:, 1].min() > column  # On beyond the ball.


@needs_a_browser
def test_the_page_of_a_running_diagram_shows_its_present_phase(tmp_path):
    """The diagram starts when the browser is connected. Its second phase, which is
    shown at the end, has a longer line than the first."""
    camera, look_at = [1.0, 0.0, 0.4], [0.0, 0.0, 0.0]
    meshcat = Meshcat()
    for path in ("/Grid", "/Axes", "/Background"):
        meshcat.SetProperty(path, "visible", False)
    meshcat.SetCameraPose(camera, look_at)
    builder = DiagramBuilder()
    phases = ("short", "a phase with a long line")
    legend = Legend(LegendConfig((), phases, camera, look_at), meshcat)
    builder.AddSystem(legend)
    second = PiecewisePolynomial.ZeroOrderHold([0.0, 0.3, 1.0], [[0.0, 1.0, 1.0]])
    source = builder.AddSystem(TrajectorySource(second))
    builder.Connect(source.get_output_port(), legend.GetInputPort("phase"))
    simulator = Simulator(builder.Build())

    png = tmp_path / "page.png"
    take = partial(screenshot, meshcat.web_url(), png, (800, 600), 6000)
    taking = Thread(target=take)
    taking.start()
    while not meshcat.GetNumActiveConnections():
        sleep(0.05)
    simulator.AdvanceTo(0.2)
    sleep(1.0)
    simulator.AdvanceTo(0.6)
    taking.join()
    upper_left = cv2.imread(str(png))[60:80, 90:500].min(axis=2)
    columns = np.flatnonzero((upper_left < 250).any(axis=0))
    assert len(columns) > 80  # The first phase has 35 columns.
    board = upper_left[5:15, columns.min() + 2 : columns.max() - 2]
    assert board.min() < 128 < 200 < np.median(board)  # Dark words on a pale board.


@needs_a_browser
def test_the_names_of_all_sliders_have_one_line_in_the_controls():
    meshcat = Meshcat()
    names = (GAP_SLIDER, FORCE_SLIDER, SPEED_SLIDER, FRICTION, GAP)
    too_long = "target speed [mm/s]"
    for name in (*names, too_long):
        meshcat.AddSlider(name, 0.0, 1.0, 0.1, 0.0)
    heights = """Object.fromEntries([...document.querySelectorAll(".property-name")]
        .map((name) => [name.innerText, name.offsetHeight]))"""
    height: dict[str, int] = {}
    with Browser() as browser:
        browser.open(meshcat.web_url())
        browser.run(OPEN_CONTROLS)
        while too_long not in height:  # The last one.
            sleep(0.1)
            height = browser.run(heights)
    line = height["save_scene"]
    assert {name: height[name] for name in names} == dict.fromkeys(names, line)
    assert height[too_long] > line


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

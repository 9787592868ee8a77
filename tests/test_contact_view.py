"""What Meshcat shows of a motion with contacts."""

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

from makebreak.systems.changing_contact.numerics.contact_task import (
    ContactBelief,
    ExpectedContact,
)
from makebreak.systems.views.contact_view import (
    FORCE_SLIDER,
    SPEED_SLIDER,
    ContactView,
    ContactViewConfig,
)

TIP = np.array([0.4, 0.1, 0.2])
CONTACT = ExpectedContact(TIP, np.diag([1e-4, 4e-4, 9e-4]), np.array([0.0, 0.0, -1.0]))


class Recorder:
    """Stands for Meshcat, and remembers what it was last told of each path."""

    def __init__(self):
        self.place, self.scale, self.slider, self.drawn = {}, {}, {}, set()

    def SetObject(self, path, *_):
        self.drawn.add(path)

    def SetTransform(self, path, X, *_):
        self.place[path] = X.translation()

    def SetProperty(self, path, name, value, *_):
        if name == "scale":
            self.scale[path] = value

    def SetSliderValue(self, name, value):
        self.slider[name] = value

    def __getattr__(self, _):
        return lambda *args, **more: None

    def seen(self, part):
        return [p for p, at in self.place.items() if part in p and at[2] > -1.0]


def show(meshcat, config=None, **change):
    values = {
        "wrench": [0.0, 0, 8, 0, 0, 0],
        "ee_pose": [*TIP, 1, 0, 0, 0],
        "mode": [2.0],
        "phase": [0, 0, 0, 0.15, 0, 0],
    } | change
    builder = DiagramBuilder()
    view = ContactView(config or ContactViewConfig(), meshcat)
    builder.AddSystem(view)
    belief = ConstantValueSource(AbstractValue.Make(ContactBelief((CONTACT,))))
    builder.AddSystem(belief)
    builder.Connect(belief.get_output_port(), view.GetInputPort("contacts"))
    for name, value in values.items():
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), view.GetInputPort(name))
    Simulator(builder.Build()).AdvanceTo(0.3)
    return meshcat


def test_region_arrow_mode_and_sliders_show_what_came():
    told = show(Recorder())
    (region,) = told.seen("region/1")
    np.testing.assert_allclose(told.place[region], TIP)
    # Two standard deviations each way.
    scale = told.scale[f"{region}/<object>"]
    np.testing.assert_allclose(sorted(scale), [0.02, 0.04, 0.06])
    (mode,) = told.seen("contact/mode")
    assert mode.endswith("/3")  # Unknown, free, 1, 2.
    # 8 N upwards at 12 mm/N: the shaft's middle is 48 mm above the tip.
    shaft = next(p for p in told.seen("shaft"))
    np.testing.assert_allclose(told.place[shaft], TIP + [0, 0, 0.048])
    assert told.slider == {FORCE_SLIDER: 8.0, SPEED_SLIDER: 150.0}


@pytest.mark.parametrize("name", ["wrench", "ee_pose", "mode", "phase"])
def test_a_nan_breaks_nothing(name):
    size = dict(wrench=6, ee_pose=7, mode=1, phase=6)[name]
    told = show(Recorder(), **{name: np.full(size, np.nan)})
    assert all(np.all(np.isfinite(at)) for at in told.place.values())
    assert all(np.isfinite(value) for value in told.slider.values())


def test_a_real_meshcat_takes_it_twice_and_shows_track_and_bars():
    meshcat = Meshcat()
    config = ContactViewConfig(peaks=[[12.0, 7.9], [8.1, np.nan]])
    for _ in range(2):  # A trial after the other in one window.
        show(meshcat, config)
    for path in ("track", "peaks/0/1", "peaks/1/0", "region/1/0", "force/head"):
        assert meshcat.HasPath(f"/makebreak/contact/{path}"), path
    assert not meshcat.HasPath("/makebreak/contact/peaks/1/1")


def test_the_legend_names_the_bars_where_there_are_bars():
    config = ContactViewConfig(peaks=[[12.0, 7.9]], peak_limit=9.0)
    texts = [text for text, _ in ContactView(config, Recorder()).legend]
    assert "bars: above 9 N" in texts
    plain = ContactView(ContactViewConfig(), Recorder()).legend
    assert len(plain) == len(texts) - 2


def test_the_planned_path_is_drawn_before_anything_is_simulated():
    meshcat = Meshcat()
    pieces = [np.zeros((2, 3)), np.ones((60, 3))]
    ContactView(ContactViewConfig(), meshcat, plan=pieces)
    assert all(meshcat.HasPath(f"/makebreak/contact/plan/{k}") for k in (0, 1))
    ContactView(ContactViewConfig(), meshcat)  # Another one takes it away.
    assert not meshcat.HasPath("/makebreak/contact/plan")

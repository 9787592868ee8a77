"""Buttons in Meshcat that act on a run: pressed as a browser presses them."""

import json
from time import sleep

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Integrator

from makebreak.scripts import run_buttons
from makebreak.scripts.run_buttons import PAUSE, STOP
from makebreak.scripts.session import Session


def press(meshcat, name):
    """What the page sends: a map of two texts, in MessagePack."""
    texts = [b"type", b"button", b"name", name.encode()]
    packed = b"".join(bytes([0xA0 + len(text)]) + text for text in texts)
    meshcat._InjectWebsocketMessage(message=b"\x82" + packed)


def ramp():
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource([1.0]))
    q = builder.AddNamedSystem("q", Integrator(1))
    builder.Connect(source.get_output_port(), q.get_input_port())
    builder.ExportOutput(q.get_output_port(), "q")
    return builder.Build()


def run(tmp_path, at, duration=0.5):
    """A run in which at(t, meshcat) is called at each sample."""
    meshcat, diagram = Meshcat(), ramp()
    own = Session(tmp_path / "out", meshcat=meshcat, progress=False)
    log = own.simulate(
        diagram,
        duration,
        {"q": diagram.GetOutputPort("q")},
        until=lambda t, _: bool(at(t, meshcat)),
    )
    return own, log, meshcat


def test_stop_ends_a_run_as_ctrl_c_does(tmp_path):
    def at(t, meshcat):
        if t == 0.25:
            press(meshcat, STOP)

    own, log, meshcat = run(tmp_path, at, 1e6)
    assert log.interrupted and own.interrupted
    np.testing.assert_allclose(log.time[-1], 0.25)
    with pytest.raises(RuntimeError):  # It is gone, also from meshcat.html.
        meshcat.GetButtonClicks(STOP)


def pause(monkeypatch, presses):
    """Presses pause at 0.25 s, and then `presses` after ten looks at the buttons."""
    looks = []

    def at(t, meshcat):
        if t == 0.25:
            press(meshcat, PAUSE)
            monkeypatch.setattr(
                run_buttons, "sleep", lambda sec: look(sec, len(looks), meshcat)
            )

    def look(sec, number, meshcat):
        looks.append(sec)
        sleep(sec)
        if number == 9:
            press(meshcat, presses)

    return looks, at


def test_a_pause_stands_still_and_is_no_time_of_the_run(tmp_path, monkeypatch):
    looks, at = pause(monkeypatch, PAUSE)
    own, log, _ = run(tmp_path, at)
    assert len(looks) == 10 and not log.interrupted
    np.testing.assert_allclose(np.diff(log.time), 0.0125)
    np.testing.assert_allclose(log.time[-1], 0.5)
    own.finish()
    timing = json.loads((tmp_path / "out" / "timing.json").read_text())
    assert timing["wall_s"] < sum(looks)  # 0.5 s; without the pause it takes 0.01 s.


def test_a_paused_run_can_be_stopped(tmp_path, monkeypatch):
    looks, at = pause(monkeypatch, STOP)
    _, log, _ = run(tmp_path, at, 1e6)
    assert log.interrupted and len(looks) == 10
    np.testing.assert_allclose(log.time[-1], 0.25)

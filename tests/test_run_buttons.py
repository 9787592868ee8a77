"""Buttons in Meshcat that act on a run: pressed as a browser presses them."""

import json
from time import sleep
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Integrator

from makebreak.scripts.cli import run_command
from makebreak.scripts.runner import run_buttons
from makebreak.scripts.runner.run_buttons import OVER, PAUSE, STOP
from makebreak.scripts.runner.session import Session


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


@pytest.mark.parametrize("paused", [False, True])
def test_a_run_starts_over_and_only_the_last_one_counts(tmp_path, monkeypatch, paused):
    """As by `makebreak run`: the result is that of a run in which nothing was pressed,
    but for the table of times."""
    runs = []
    monkeypatch.setattr(run_command, "_open_meshcat", Meshcat)

    def experiment(_, session):
        diagram = ramp()
        runs.append(diagram)
        for path in ("of_the_first", "/makebreak/of_the_first"):
            assert not session.meshcat.HasPath(path)
            session.meshcat.SetTransform(path, RigidTransform())
        _, pauses = pause(monkeypatch, OVER)

        def at(t, _):
            if len(runs) == 1:
                if paused:
                    pauses(t, session.meshcat)
                elif t == 0.25:
                    press(session.meshcat, OVER)
            return False

        ends = {"q": diagram.GetOutputPort("q")}
        log = session.simulate(diagram, 0.5, ends, until=at)
        return {"success": True, "end": float(log["q"][-1, 0]), "rows": len(log.time)}

    args = SimpleNamespace(
        diagram=None, is_trial=True, no_meshcat=False, experiment="ramp"
    )
    out = tmp_path / "out"
    with Session(out, progress=False) as session:
        status = run_command.run_in(session, args, experiment, {}, None)
    assert status == 0 and len(runs) == 2 and runs[0] is not runs[1]
    result = json.loads((out / "result.json").read_text())
    assert result["end"] == pytest.approx(0.5) and result["rows"] == 41
    assert not result["interrupted"] and result["ended"] == []
    timing = json.loads((out / "timing.json").read_text())
    assert timing["simulated_s"] == 0.5


def test_what_nobody_begins_again_has_no_button_for_it(tmp_path):
    def at(t, meshcat):
        if t == 0.25:
            with pytest.raises(RuntimeError):
                meshcat.GetButtonClicks(OVER)

    run(tmp_path, at)

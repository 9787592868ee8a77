"""What a run simulates, samples and writes."""

import base64
import csv
import json
import re
import signal
from dataclasses import dataclass, field
from pathlib import Path
from time import sleep

import numba
import numpy as np
import pytest
from matplotlib.figure import Figure
from pydrake.geometry import Box, Meshcat, MeshcatVisualizer
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, Integrator

from makebreak.gap.data.table import check_columns, write_recording
from makebreak.scripts.runner.compiling import FIRST, CompilingShown
from makebreak.scripts.runner.run_buttons import RunButtons
from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.settings import (
    apply_settings,
    convert,
    dump_config,
    load_config,
)
from makebreak.scripts.runner.table import Table
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.timing import UpdateTimes, timed
from makebreak.systems.views.legend import Legend, LegendConfig


def ramp():
    """A diagram whose port q is (t, 2 t), inside a diagram of its own."""
    inner = DiagramBuilder()
    source = inner.AddSystem(ConstantVectorSource([1.0, 2.0]))
    integrator = inner.AddNamedSystem("integrator", Integrator(2))
    inner.Connect(source.get_output_port(), integrator.get_input_port())
    inner.ExportOutput(integrator.get_output_port(), "q")
    builder = DiagramBuilder()
    part = builder.AddSystem(inner.Build())
    builder.ExportOutput(part.GetOutputPort("q"), "q")
    return builder.Build(), integrator


def session(tmp_path, **more):
    return Session(tmp_path / "out", progress=False, **more)


def test_samples_are_taken_at_multiples_of_the_period_and_at_the_end(tmp_path):
    diagram, integrator = ramp()
    record = {"outer": diagram.GetOutputPort("q"), "deep": integrator.get_output_port()}
    log = session(tmp_path).simulate(diagram, 0.35, record, period_sec=0.1)
    np.testing.assert_allclose(log.time, [0.0, 0.1, 0.2, 0.3, 0.35], atol=1e-15)
    # The integrand is constant: any Runge-Kutta method is exact but for rounding.
    expected = np.outer(log.time, [1.0, 2.0])
    np.testing.assert_allclose(log["outer"], expected, atol=1e-13)
    np.testing.assert_array_equal(log["deep"], log["outer"])
    assert not log.interrupted and log.diagram is diagram
    assert log.context.get_time() == 0.35
    assert list(log) == ["outer", "deep"]


def test_the_number_of_samples_does_not_suffer_from_rounding(tmp_path):
    diagram, _ = ramp()
    log = session(tmp_path).simulate(diagram, 0.3, {}, period_sec=0.1)
    np.testing.assert_allclose(log.time, [0.0, 0.1, 0.2, 0.3], atol=1e-15)


def test_until_sees_each_sample_and_ends_the_simulation(tmp_path):
    diagram, _ = ramp()
    seen = []

    def until(t, sample):
        seen.append(t)
        return sample["q"][1] > 0.5

    log = session(tmp_path).simulate(
        diagram, 9.0, {"q": diagram.GetOutputPort("q")}, 0.1, until
    )
    np.testing.assert_allclose(log.time[-1], 0.3, atol=1e-12)  # 2 * 0.3 > 0.5.
    assert seen == list(log.time)


def test_it_starts_from_the_context_that_it_is_given(tmp_path):
    diagram, integrator = ramp()
    context = diagram.CreateDefaultContext()
    integrator.set_integral_value(integrator.GetMyContextFromRoot(context), [5.0, 7.0])
    log = session(tmp_path).simulate(
        diagram, 0.1, {"q": diagram.GetOutputPort("q")}, context=context
    )
    np.testing.assert_array_equal(log["q"][0], [5.0, 7.0])


def test_the_sessions_duration_overrides_the_experiments(tmp_path):
    diagram, _ = ramp()
    log = session(tmp_path, duration_sec=0.2).simulate(diagram, 50.0, {})
    np.testing.assert_allclose(log.time[-1], 0.2, atol=1e-15)


def test_simulated_time_passes_no_faster_than_the_rate_allows(tmp_path):
    diagram, _ = ramp()
    own = session(tmp_path, realtime=2.0)
    own.simulate(diagram, 0.4, {})
    own.finish()
    timing = json.loads((own.out_dir / "timing.json").read_text())
    assert timing["real_time_factor"] < 2.2  # A bound from above holds on any machine.


def test_updates_that_take_longer_than_their_period_are_said(tmp_path):
    builder = DiagramBuilder()
    for name, late in (("fast", 101), ("rarely", 100), ("slow", 20)):
        builder.AddNamedSystem(name, Timed(late))
    own = session(tmp_path)
    own.simulate(builder.Build(), 0.5, {})
    assert own.too_slow() == [
        "Too slow for real time: slow, 5 of 100 updates took more CPU time than its "
        "period of 5 ms (99 %: 6)"
    ]
    own.finish()
    systems = json.loads((own.out_dir / "timing.json").read_text())["systems"]
    assert [systems[name]["overruns"] for name in systems] == [0, 1, 5]


class Timed(LeafSystem):
    """Says that one update in `late`, of 200 a second, took 6 ms, and the others 4."""

    def __init__(self, late):
        super().__init__()
        self.update_times, self._late = UpdateTimes(), late
        self.DeclarePeriodicDiscreteUpdateEvent(0.005, 0.0, self._update)

    def _update(self, context, discrete_state):
        times = self.update_times
        times.updates += 1
        times.wall_sec.append(0.006 if times.updates % self._late == 0 else 0.004)
        times.cpu_sec.append(times.wall_sec[-1])


class Waiting(LeafSystem):
    """Waits 3 ms in each update, of 500 a second."""

    def __init__(self):
        super().__init__()
        self.DeclarePeriodicDiscreteUpdateEvent(0.002, 0.0, self._update)

    @timed
    def _update(self, context, discrete_state):
        sleep(0.003)


def test_a_system_that_others_keep_waiting_is_not_called_too_slow(tmp_path):
    builder = DiagramBuilder()
    builder.AddNamedSystem("waiting", Waiting())
    own = session(tmp_path)
    own.simulate(builder.Build(), 0.1, {})
    own.finish()
    timing = json.loads((own.out_dir / "timing.json").read_text())
    waiting = timing["systems"]["waiting"]
    assert waiting["p50_ms"] >= 3.0 and waiting["overruns"] == waiting["timed"]
    assert waiting["cpu_p99_ms"] < 2.0
    assert own.too_slow() == []


class Quick(LeafSystem):
    """Does nothing, 100000 times a second."""

    def __init__(self):
        super().__init__()
        self.DeclarePeriodicDiscreteUpdateEvent(1e-5, 0.0, self._update)

    @timed
    def _update(self, context, discrete_state):
        pass


def test_all_updates_are_counted_and_one_in_5_ms_is_timed():
    system = Quick()
    Simulator(system).AdvanceTo(0.01)
    times = system.update_times
    assert times.updates > 900
    assert 1 <= len(times.wall_sec) == len(times.cpu_sec) < 500
    assert min(times.cpu_sec) >= 0.0


class Ticker(LeafSystem):
    """Counts at 100 Hz. Outputs: n (1,); words (abstract)."""

    def __init__(self):
        super().__init__()
        n = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("n", n)
        self.DeclareAbstractOutputPort("words", lambda: _value(), lambda *_: None)
        self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.0, self._update)

    @timed
    def _update(self, context, discrete_state):
        discrete_state.set_value(context.get_discrete_state_vector().value() + 1.0)


def _value():
    from pydrake.common.value import Value

    return Value("")


def ticking():
    builder = DiagramBuilder()
    ticker = builder.AddNamedSystem("ticker", Ticker())
    return builder.Build(), ticker


def test_a_sample_is_taken_before_the_update_at_its_time(tmp_path):
    diagram, ticker = ticking()
    log = session(tmp_path).simulate(
        diagram, 0.03, {"n": ticker.GetOutputPort("n")}, 0.01
    )
    np.testing.assert_array_equal(log["n"][:, 0], [0.0, 1.0, 2.0, 3.0])


def test_timing_counts_the_updates_of_each_simulation_apart(tmp_path):
    diagram, _ = ticking()
    own = session(tmp_path)
    own.simulate(diagram, 0.5, {}, label="first")
    own.simulate(diagram, 1.0, {}, label="second")
    assert own.finish() == [own.out_dir / "timing.json"]
    timing = json.loads((own.out_dir / "timing.json").read_text())
    assert timing["simulated_s"] == 1.5
    updates = [
        timing["simulations"][k]["systems"]["ticker"]["updates"]
        for k in ("first", "second")
    ]
    assert updates == [50, 100]


def test_systems_of_one_name_in_nested_diagrams_are_told_apart(tmp_path):
    builder = DiagramBuilder()
    for name in ("left", "right"):
        part, _ = ticking()
        builder.AddNamedSystem(name, part)
    own = session(tmp_path)
    own.simulate(builder.Build(), 0.1, {})
    own.finish()
    timing = json.loads((own.out_dir / "timing.json").read_text())
    first, second = timing["systems"]
    assert first == "ticker" and second.endswith("::right::ticker")


def test_a_port_that_cannot_be_sampled_is_refused_by_name(tmp_path):
    diagram, ticker = ticking()
    _, other = ticking()
    own = session(tmp_path)
    with pytest.raises(ValueError, match="record: words is an abstract port"):
        own.simulate(diagram, 1.0, {"words": ticker.GetOutputPort("words")})
    with pytest.raises(ValueError, match="record: n is a port of ticker, expected one"):
        own.simulate(diagram, 1.0, {"n": other.GetOutputPort("n")})
    for bad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="duration_sec: got"):
            own.simulate(diagram, bad, {})
        with pytest.raises(ValueError, match="period_sec: got"):
            own.simulate(diagram, 1.0, {}, period_sec=bad)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_ends_the_simulation_and_forbids_the_next(tmp_path, number):
    diagram, _ = ramp()
    own = session(tmp_path)
    before = signal.getsignal(number)

    def until(t, sample):
        if t > 0.45:
            signal.raise_signal(number)
        return False

    record = {"q": diagram.GetOutputPort("q")}
    log = own.simulate(diagram, 1e6, record, 0.1, until)
    assert log.interrupted and own.interrupted
    np.testing.assert_allclose(log.time[-1], 0.5, atol=1e-12)
    assert log["q"].shape == (6, 2)
    assert signal.getsignal(number) is before
    with pytest.raises(KeyboardInterrupt):
        own.simulate(diagram, 1.0, {})


def test_ctrl_c_while_buttons_are_asked_ends_the_run(tmp_path, monkeypatch):
    """It was overwritten by their answer: the run went on."""

    def stopped(self, interrupted, restart):
        signal.raise_signal(signal.SIGINT)
        return False

    monkeypatch.setattr(RunButtons, "stopped", stopped)
    own, (diagram, _) = session(tmp_path), ramp()
    log = own.simulate(diagram, 1.0, {"q": diagram.GetOutputPort("q")}, 0.1)
    assert log.interrupted and log.time[-1] == pytest.approx(0.1)


def test_ctrl_c_while_the_log_is_put_together_is_not_lost(tmp_path, monkeypatch):
    diagram, _ = ramp()
    own = session(tmp_path)
    monkeypatch.setattr(
        own, "_note_limits", lambda *_: signal.raise_signal(signal.SIGTERM)
    )
    own.simulate(diagram, 1.0, {})
    assert own.interrupted


def test_a_second_ctrl_c_does_not_wait(tmp_path):
    diagram, _ = ramp()

    def until(t, sample):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    own = session(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        own.simulate(diagram, 1e6, {"q": diagram.GetOutputPort("q")}, until=until)
    assert own.keep_partial() and own.finish()
    assert (own.out_dir / "partial.npz").stat().st_size > 0


def test_meshcat_html_holds_the_whole_animation(tmp_path):
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    body = plant.AddRigidBody("falling_box", inertia)
    box = Box(0.1, 0.1, 0.1)
    plant.RegisterVisualGeometry(body, RigidTransform(), box, "box", [1, 0, 0, 1])
    plant.Finalize()
    meshcat = Meshcat()
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    own = session(tmp_path, meshcat=meshcat)
    own.simulate(builder.Build(), 0.5, {})
    assert own.out_dir / "meshcat.html" in own.finish()
    html = (own.out_dir / "meshcat.html").read_text()
    blobs = [base64.b64decode(b) for b in re.findall(r"base64,([\w+/=]+)", html)]
    [animation] = [b for b in blobs if b"set_animation" in b and b"keys" in b]
    # A key is a time and a position; at 32 pictures per second there are 17 in 0.5 s.
    assert b"falling_box" in animation and animation.count(b"time") >= 17


def test_the_scene_is_in_meshcat_before_anything_is_computed(tmp_path):
    """Also what is compiled, which takes a minute at the first time."""
    meshcat = Meshcat()
    there = []

    class First(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareInitializationPublishEvent(
                lambda _: there.append(meshcat.HasPath("/drake/visualizer/ball"))
            )

    builder = DiagramBuilder()
    builder.AddSystem(First())  # Its events come before the viewer's.
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    body = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    box = Box(0.1, 0.1, 0.1)
    plant.RegisterVisualGeometry(body, RigidTransform(), box, "box", [1, 0, 0, 1])
    plant.Finalize()
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    session(tmp_path, meshcat=meshcat).simulate(builder.Build(), 0.1, {})
    assert there == [True]


def test_what_is_compiled_is_told_and_what_was_compiled_is_not(capsys):
    @numba.njit
    def inner(x):
        return x + 1.0

    @numba.njit
    def outer(x):
        return inner(2.0 * x)

    for function in (inner, outer):
        function.py_func.__module__ = "makebreak.systems.arm.numerics.made_up"
    seen: list[str] = []
    with CompilingShown(seen.append):
        assert outer(1.0) == 3.0
        assert seen == ["compiling made_up.outer", ""]
        assert outer(2.0) == 5.0 and inner(2.0) == 3.0
        assert seen == ["compiling made_up.outer", ""]
    assert capsys.readouterr().err.splitlines() == [FIRST]
    outer(1)  # Of other types; nobody listens any more.
    assert len(seen) == 2


def test_the_legend_says_which_of_the_first_calls_compiles(tmp_path, monkeypatch):
    told: list[str] = []
    monkeypatch.setattr(Legend, "note", lambda _, text: told.append(text))

    def function_of(name):
        @numba.njit
        def function(x):
            return x + 1.0

        function.py_func.__module__ = "makebreak.systems.arm.numerics.made_up"
        function.py_func.__name__ = name
        return function

    builder = DiagramBuilder()
    meshcat = Meshcat()
    builder.AddNamedSystem("legend", Legend(LegendConfig(), meshcat))
    with session(tmp_path, meshcat=meshcat) as own:
        for name in ("one", "two"):
            first_call(function_of(name), 1.0)
        own.simulate(builder.Build(), 0.1, {})
    assert told == [
        "compiling 1 of 2: made_up.one",
        "",
        "compiling 2 of 2: made_up.two",
        "",
    ]


def test_result_json_is_flat_in_the_given_order_and_without_nan(tmp_path):
    own = session(tmp_path)

    def written(result):
        own.write_result(result)
        return own.path("result.json").read_text()

    result = {
        "b_m": np.float64(0.1),
        "success": np.True_,
        "a": np.nan,
        "n": np.int64(3),
    }
    text = written(result)
    assert json.loads(text) == {"b_m": 0.1, "success": True, "a": None, "n": 3}
    assert list(json.loads(text)) == ["b_m", "success", "a", "n"]
    listed = {"success": True, "x_m": np.array([1.0, np.nan]), "n": (1, None)}
    text = written(listed)
    assert json.loads(text) == {"success": True, "x_m": [1.0, None], "n": [1, None]}
    with pytest.raises(ValueError, match="result x: got dict, expected a scalar"):
        own.write_result({"success": True, "x": [{}]})
    with pytest.raises(ValueError, match="result success: got None, expected True or"):
        own.write_result({"x": 1.0})


def test_a_plot_is_a_picture_and_needs_no_display(tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    own = session(tmp_path)
    figure = Figure()
    figure.subplots().plot([0.0, 1.0])
    own.save_plot(figure, "line")
    [path] = own.finish()
    assert path == own.out_dir / "line.png"
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_child_session_writes_in_a_folder_below(tmp_path):
    own = session(tmp_path, duration_sec=3.0)
    child = own.child("trial")
    assert child.out_dir == own.out_dir / "trial" and child.out_dir.is_dir()
    assert child.duration_sec == 3.0 and child.meshcat is None


def test_a_recording_reads_back_as_the_very_same_numbers(tmp_path):
    rng = np.random.default_rng(0)
    columns = {
        "panda.joint1.position": rng.normal(size=50),
        "ball.ball.x": rng.normal(size=50) * 1e-9,
        "time": np.cumsum(rng.uniform(size=50)),
    }
    columns["ball.ball.x"][7] = np.nan  # A missing sample.
    noise = {"ball.ball.x": 0.001}
    path, beside = write_recording(tmp_path / "recording.csv", columns, noise)
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[0] == "time"
    assert rows[7]["ball.ball.x"] == ""
    for name, value in columns.items():
        read = [float(row[name] or "nan") for row in rows]
        np.testing.assert_array_equal(read, value)
    assert json.loads(beside.read_text()) == noise
    [path] = write_recording(tmp_path / "recording.npz", columns)
    with np.load(path) as table:
        for name, value in columns.items():
            np.testing.assert_array_equal(table[name], value)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"a.b.x": [1.0]}, "needs the column time"),
        ({"time": [0.0], "speed": [1.0]}, 'recording column "speed", expected <model>'),
        ({"time": [0.0], "a.b.c": [1.0]}, 'recording column "a.b.c", expected <model>'),
        ({"time": [0.0], "a.b.x": [1.0, 2.0]}, r"a.b.x is \(2,\), expected \(1,\)"),
        ({"time": [0.0, 1.0, 1.0]}, "time does not increase at row 3: 1.0 after 1.0"),
        ({"time": [0.0, np.nan]}, "time is not finite"),
    ],
)
def test_a_wrong_recording_is_refused_by_column_and_row(columns, message):
    with pytest.raises(ValueError, match=message):
        check_columns({k: np.array(v) for k, v in columns.items()})


def test_time_starts_again_with_each_episode():
    time, episode = np.array([0.0, 1.0, 0.0]), np.array([0, 0, 1])
    assert list(check_columns({"time": time, "episode": episode})) == [
        "time",
        "episode",
    ]


def test_a_table_is_aligned_and_says_which_rows_miss_their_target():
    rows = [("short", 1.23456789, None), ("a longer one", 20, True)]
    table = Table("Title", ("what", "ours", "ok"), rows, met=(True, False))
    assert table.missed == 1
    assert table.to_text().splitlines() == [
        "Title",
        "",
        "what           ours  ok   target",
        "------------  -----  ---  ------",
        "short         1.235  -    met",
        "a longer one     20  yes  MISSED",
    ]
    assert "| a longer one | 20 | yes | MISSED |" in table.to_markdown()
    assert table.to_dict()["rows"][1] == {
        "what": "a longer one",
        "ours": 20,
        "ok": True,
        "met": False,
    }
    with pytest.raises(ValueError, match="row 0 has 1 cells, expected 2"):
        Table("Title", ("a", "b"), [(1,)])
    with pytest.raises(ValueError, match="met has 1 entries, expected one per row"):
        Table("Title", ("a",), [(1,), (2,)], met=(True,))


def test_a_table_fits_the_terminal():
    says = "a sentence that has some more words than fit"
    table = Table(says, ("what", "n", "why"), [("one", 12345, says)], notes=[says])
    lines = table.to_text(30).splitlines()
    assert max(map(len, lines)) <= 30 and len(lines) == 10
    assert lines[3:8] == [
        "what      n  why",
        "----  -----  -----------------",
        "one   12345  a sentence that",
        "             has some more",
        "             words than fit",
    ]
    assert table.to_text(200) == table.to_text()
    assert Table("t", ("a", "b"), [], notes=["n"]).to_text() == "t\n\nn\n"
    rows = [("a_name_that_is_long", "some words"), ("b", "many words of a sentence")]
    lines = Table("t", ("at", "why"), rows).to_text(38).splitlines()
    assert lines[4] == "a_name_that_is_long  some words"
    assert lines[5:7] == [f"{'b':19}  many words of a", " " * 21 + "sentence"]


def test_a_narrow_terminal_breaks_no_name():
    """Neither of two that do not fit side by side, nor at a hyphen."""
    name, channel = "arm.joint-1.effort_measured", "arm.joint1.effort_measured"
    heads = ("column", "samples", "empty", "proposed channel", "reason")
    why = "has a channel's name already"
    table = Table(f"runs/a-b/{name}", heads, [(name, 12, "", channel, why)] * 2)
    for width in (20, 40, 60, 80, 100):
        lines = table.to_text(width).splitlines()
        assert sum(name in line.split() for line in lines) == 2
        assert sum(channel in line.replace(";", "").split() for line in lines) == 2
        assert max(map(len, lines)) <= max(width, len(lines[0]))
    assert table.to_text(60).splitlines()[2:5] == [
        name,
        "    samples: 12; proposed channel:",
        f"    {channel}; reason: has a channel's name",
    ]


@pytest.mark.parametrize(
    ("value", "text", "in_json"),
    [
        (np.nan, "-", None),
        (np.float32("nan"), "-", None),
        ([0.25, np.nan], "0.25, -", [0.25, None]),
        (f"{np.nan:.1f} mm ({np.nan:.1f} to {np.nan:.1f})", "-", "-"),
        (f"{np.nan:.2f} -> {0.5:.2f} m/s2", "- -> 0.50 m/s2", "- -> 0.50 m/s2"),
        ("3 of 4, position_nan", "3 of 4, position_nan", "3 of 4, position_nan"),
        ("a nanometre", "a nanometre", "a nanometre"),
        ('got "nan"', 'got "nan"', 'got "nan"'),
    ],
)
def test_a_table_shows_a_dash_for_what_was_not_measured(value, text, in_json):
    table = Table("Title", ("what", "ours"), [("time", value)])
    assert table.to_text().splitlines()[-1].split(maxsplit=1) == ["time", text]
    assert table.to_markdown().splitlines()[-1] == f"| time | {text} |"
    assert table.to_dict()["rows"] == [{"what": "time", "ours": in_json}]


def test_a_transposed_table_has_a_column_for_each_row():
    table = Table(
        "Title", ("case", "rate", "error"), [("a=1", "2 of 2", 0.5)], notes="n"
    )
    assert table.transposed().to_text().splitlines() == [
        "Title",
        "",
        "case   a=1",
        "-----  ------",
        "rate   2 of 2",
        "error  0.5",
        "n",
    ]


@pytest.mark.parametrize(
    ("value", "hint", "expected"),
    [
        (3, float, 3.0),
        ("1e-3", float, 1e-3),  # YAML 1.1 reads it as a text.
        (2.0, int, 2),
        (None, float | None, None),
        ([1, 2], list[float], [1.0, 2.0]),
        ([1, True], tuple[int, bool], (1, True)),
        ({"a": 1}, dict[str, float], {"a": 1.0}),
    ],
)
def test_values_become_the_declared_type(value, hint, expected):
    got = convert("name", value, hint)
    assert got == expected and type(got) is type(expected)


@dataclass(frozen=True)
class Pair:
    a: str
    b: str = "table"


@dataclass
class Pairs:
    pairs: list[Pair] = field(default_factory=list)
    size: tuple[int, int] = (3, 4)
    path: Path = Path("scene.yaml")
    gains: np.ndarray = field(default_factory=lambda: np.ones(3))
    best: Pair = field(default_factory=lambda: Pair("ball", "wall"))


def test_any_config_reads_back_from_what_is_written(tmp_path):
    settings = ["pairs=[{a: tip, b: ball}]", "size=[1, 2]", "path=a b.yaml"]
    settings += ["gains=[1, 1e-7, 3]", "best.a=tip"]
    config = apply_settings(Pairs(), settings)
    assert config.pairs == [Pair("tip", "ball")] and config.best == Pair("tip", "wall")
    path = tmp_path / "config.yaml"
    path.write_text(dump_config(config))
    again = load_config(Pairs, path)
    np.testing.assert_array_equal(again.gains, [1.0, 1e-7, 3.0])
    for name in ("pairs", "size", "path", "best"):
        assert getattr(again, name) == getattr(config, name)
    for text, message in (
        ("pairs: [{b: ball}]", r"pairs\[0\].a: missing, expected a value"),
        ("pairs: [{a: x, c: y}]", r"unknown key pairs\[0\].c"),
        ("size: [1]", r'size: got "\[1\]", expected a list of 2'),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            load_config(Pairs, path)

"""What diagrams record for the gap workflow."""

from itertools import pairwise

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LinearSystem, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from makebreak.diagrams.multi_spring import (
    MultiSpringConfig,
    impedance,
    make_multi_spring,
)
from makebreak.diagrams.planar import PLANAR
from makebreak.diagrams.recorder import (
    add_recorder,
    behind_sec,
    episodes,
    mean_until_next,
    recorded,
    with_noise,
)
from makebreak.gap.data.reading import check_against_scene, read_recordings
from makebreak.gap.data.scene_facts import scene_names
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import read_scene
from makebreak.scripts.runner.session import MODEL, Session


def ramp(slope: float) -> TrajectorySource:
    line = PiecewisePolynomial.FirstOrderHold([0.0, 10.0], [[0.0, 10.0 * slope]])
    return TrajectorySource(line)


@pytest.mark.parametrize(("late", "shift"), [(False, 0.0), (True, 1e-3)])
def test_a_row_has_samples_and_the_mean_of_what_acted_until_the_next(late, shift):
    builder = DiagramBuilder()
    q = builder.AddSystem(ramp(1.0)).get_output_port()
    u = builder.AddSystem(ramp(3.0)).get_output_port()
    add_recorder(
        builder, {"q": (q, ["a.j.position"])}, {"u": (u, ["a.j.effort_command"])},
        0.01, late,
    )  # fmt: skip
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.05)
    got = recorded(diagram, simulator.get_context())
    np.testing.assert_allclose(got["time"], 0.01 * np.arange(6), atol=1e-12)
    np.testing.assert_allclose(got["a.j.position"], got["time"], atol=1e-12)
    # Ten ticks, 0 to 9 ms after the row: 4.5 ms on in the mean.
    expected = 3.0 * (got["time"] + 4.5e-3 + shift)
    np.testing.assert_allclose(got["a.j.effort_command"][:4], expected[:4], atol=1e-9)


class LateSensor(LeafSystem):
    """Reads a line every 4 ms, a little after the tick, and knows it 7 ms later."""

    def __init__(self, after):
        super().__init__()
        self._after = after
        self.DeclareVectorOutputPort("reading", 2, self._read)

    def _read(self, context, output):
        t = 0.004 * np.floor((context.get_time() - 0.007) / 0.004 + 1e-9)
        t += self._after
        output.SetFromVector([t, 2.0 * t] if t >= 0.0 else [-1.0, 0.0])


@pytest.mark.parametrize("after", [0.0, 1e-4, 4e-4])
def test_what_is_read_late_stands_at_the_time_it_was_so(after):
    builder = DiagramBuilder()
    q = builder.AddSystem(ramp(1.0)).get_output_port()
    u = builder.AddSystem(ramp(3.0)).get_output_port()
    reading = builder.AddSystem(LateSensor(after)).get_output_port()
    add_recorder(
        builder, {"q": (q, ["a.j.position"])}, {"u": (u, ["a.j.effort_command"])},
        0.005, readings={"r": (reading, ["", "o.o.x"])}, behind_sec=0.011,
    )  # fmt: skip
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.03)
    context = simulator.get_context()
    got = recorded(diagram, context)
    # Rows of the joints every 5 ms, of the object every 4 ms, up to 30 - 7 ms.
    of_joints, of_object = (~np.isnan(got[n]) for n in ("a.j.position", "o.o.x"))
    np.testing.assert_allclose(1e3 * got["time"][of_joints], np.arange(0, 31, 5))
    at = 1e3 * got["time"][of_object]
    read = np.arange(0, 21, 4) + 1e3 * after
    # One of a row's tick is in the row: systems of one tick run one after the other.
    in_rows = read - 1e3 * after if after < 2e-4 else read
    expected = np.where(np.isin(np.arange(0, 21, 4), [0, 20]), in_rows, read)
    np.testing.assert_allclose(at, expected, atol=1e-9)
    np.testing.assert_allclose(got["o.o.x"][of_object], 2e-3 * read, atol=1e-12)
    assert (np.diff(got["time"]) > 1e-9).all()
    # Commands are of the row until the next one, whatever it holds: of its ticks.
    rows = pairwise(np.round(1e3 * got["time"], 6))
    ticks = [np.arange(np.ceil(a), b) for a, b in rows]
    # Between two ticks: what holds there.
    starts = np.floor(1e3 * got["time"][:-1] + 1e-6)
    held = [t.mean() if len(t) else a for t, a in zip(ticks, starts, strict=True)]
    expected = 3e-3 * np.array(held)
    np.testing.assert_allclose(got["a.j.effort_command"][:-1], expected, atol=1e-9)
    # From a time on: the rows from then on, and no others.
    for begin in [*got["time"], 0.011]:
        later = recorded(diagram, context, begin)
        for name, y in got.items():
            expected = y[got["time"] >= begin - 1e-9]
            np.testing.assert_allclose(later[name], expected, atol=1e-9, err_msg=name)
    assert behind_sec(diagram) == pytest.approx(0.012)


def test_rows_between_two_ticks_have_what_holds_there():
    fine_time, fine = 1e-3 * np.arange(10, 20), np.arange(10.0, 20.0)[:, None]
    time = np.array([0.0091, 0.0092, 0.0093, 0.0121, 0.0122, 0.0123, 0.015])
    got = mean_until_next(time, fine_time, fine)[:, 0]
    # Before the first tick its value; then those of ticks 10 to 12, of 12, and so on.
    np.testing.assert_allclose(got, [10.0, 10.0, 11.0, 12.0, 12.0, 13.5, 15.0])


def test_an_entry_without_a_name_and_a_diagram_without_a_recorder():
    builder = DiagramBuilder()
    both = builder.AddSystem(LinearSystem(D=np.zeros((2, 1)))).get_output_port()
    builder.ExportInput(builder.GetSystems()[0].get_input_port(), "u")
    add_recorder(builder, {"q": (both, ["", "a.j.position"])}, {})
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    assert list(recorded(diagram, context)) == ["time", "a.j.position"]
    builder = DiagramBuilder()
    builder.AddSystem(ramp(1.0))
    with pytest.raises(ValueError, match="has no recorder"):
        recorded(builder.Build(), context)


def test_simulations_are_episodes_and_perfect_sensors_get_noise():
    one = {"time": np.arange(3.0), "a.j.position": np.zeros(3)}
    two = {"time": np.arange(2.0), "a.j.position": np.ones(2)}
    table = episodes([one, two])
    np.testing.assert_array_equal(table["episode"], [0, 0, 0, 1, 1])
    np.testing.assert_array_equal(table["a.j.position"], [0, 0, 0, 1, 1])
    many = {"time": np.arange(4000.0), "a.j.position": np.zeros(4000)}
    noisy = with_noise(many, 3)
    assert np.std(noisy["a.j.position"]) == pytest.approx(2e-5, rel=0.05)
    np.testing.assert_array_equal(noisy["time"], many["time"])


def test_a_planar_run_records_forces_that_its_motion_obeys(tmp_path):
    """m dv/dt = u + F from one row to the next, with what was recorded alone; and the
    scene that is written beside it takes every channel."""
    config = MultiSpringConfig(seed=3)
    diagram = make_multi_spring(config, impedance(config.impedance, config.model))
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.0)
    columns = recorded(diagram, simulator.get_context())
    dt = np.diff(columns["time"])
    for axis in "xy":
        v, u, F = (
            columns[f"effector.{name}"]
            for name in (f"{axis}.velocity", f"{axis}.effort_command", f"tip.f{axis}")
        )
        rate = np.diff(v) / dt
        off = rate - u[:-1] - (F[:-1] + F[1:]) / 2.0
        # The force sensor's noise of 0.2 N, of two samples: 0.14 N. A command that
        # were a tick late would be off by its rate, a newton and more.
        assert np.sqrt(np.mean(off**2)) < 0.2
    with Session(tmp_path / "out", progress=False) as session:
        session.write_recording(with_noise(columns, 3), read_scene(PLANAR))
        session.finish()
    assert session.compared_by.startswith("makebreak gap ")
    scene = read_scene(tmp_path / "out" / MODEL)
    [recording] = read_recordings([tmp_path / "out" / "recording.csv"])
    check_against_scene(recording, *scene_names(SceneDynamics(scene).plant))

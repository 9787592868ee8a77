import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantValueSource,
    ConstantVectorSource,
    Gain,
    ZeroOrderHold,
)
from pydrake.systems.sensors import ImageRgba8U

from makebreak.benchmarks import latency as bench_latency
from makebreak.benchmarks.latency import (
    ENCODERS,
    NUDGES,
    PICTURE,
    TORQUES,
    WITHIN_SEC,
    ages,
    make_nudged_station,
)
from makebreak.diagrams.ball_rolling_config import LEARN

PERIOD, OFFSET = LEARN / 5, 1e-3


def station():
    builder = DiagramBuilder()
    for name in (ENCODERS, TORQUES):
        source = builder.AddSystem(ConstantVectorSource(np.arange(2.0)))
        builder.ExportOutput(source.get_output_port(), name)
    image = ImageRgba8U(4, 2)
    image.mutable_data[:, 0] = 200
    picture = builder.AddSystem(ConstantValueSource(Value(image)))
    builder.ExportOutput(picture.get_output_port(), PICTURE)
    return builder.Build()


@pytest.fixture
def loop():
    """A sensor that a sampler reads, and what is made of it at once."""
    builder = DiagramBuilder()
    sensors = builder.AddNamedSystem("station", make_nudged_station(station()))
    sampler = builder.AddNamedSystem("sampler", ZeroOrderHold(PERIOD, 2, OFFSET))
    double = builder.AddNamedSystem("double", Gain(2.0, 2))
    builder.Connect(sensors.GetOutputPort(ENCODERS), sampler.get_input_port())
    builder.Connect(sampler.get_output_port(), double.get_input_port())
    at_once = builder.AddNamedSystem("at_once", Gain(1.0, 2))
    builder.Connect(sensors.GetOutputPort(ENCODERS), at_once.get_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.2)
    return diagram, simulator.get_context()


def test_ages_are_those_of_a_sampled_signal(loop):
    diagram, context = loop
    outputs = {name: (name, "y0") for name in ("sampler", "double", "at_once")}
    outputs = {
        name: (name, diagram.GetSubsystemByName(name).get_output_port().get_name())
        for name in outputs
    }
    found = ages(diagram, context, ENCODERS, outputs, 10)
    # Starts are 2.5, 7.5, 12.5 ... ms after an instant of the learner; the sampler's
    # ticks are 1 ms after each 10 ms.
    expected = np.tile([0.0085, 0.0035], 5)
    np.testing.assert_allclose(found["sampler"], expected, atol=3e-4)
    np.testing.assert_array_equal(found["double"], found["sampler"])
    np.testing.assert_allclose(found["at_once"], 0.0, atol=3e-4)
    assert context.get_time() == pytest.approx(0.2)


def test_what_does_not_depend_on_a_sensor_has_no_age(loop):
    diagram, context = loop
    port = diagram.GetSubsystemByName("sampler").get_output_port().get_name()
    found = ages(diagram, context, TORQUES, {"sampler": ("sampler", port)}, 1)
    assert found["sampler"][0] == np.inf > WITHIN_SEC


def test_a_nudge_shifts_a_picture_and_nothing_else():
    diagram = make_nudged_station(station())
    context = diagram.CreateDefaultContext()
    before = diagram.GetOutputPort(PICTURE).Eval(context).data.copy()
    assert before[0, 0, 0] == 200
    nudge = diagram.GetSubsystemByName(PICTURE)
    nudge.start(nudge.GetMyMutableContextFromRoot(context), NUDGES[PICTURE])
    after = diagram.GetOutputPort(PICTURE).Eval(context).data
    np.testing.assert_array_equal(after[:, 1], before[:, 0])
    np.testing.assert_array_equal(
        diagram.GetOutputPort(ENCODERS).Eval(context), [0.0, 1.0]
    )


def test_what_is_not_seen_in_time_has_a_row_that_says_so(loop, monkeypatch):
    late = {"state": np.array([0.001, np.inf]), "torque": np.array([0.001, 0.002])}
    monkeypatch.setattr(bench_latency, "ages", lambda *_: late)
    outputs = {name: ("sampler", "y0") for name in late}
    monkeypatch.setattr(bench_latency, "OUTPUTS", outputs)
    diagram, context = loop
    bad, good = bench_latency._rows(ENCODERS, diagram, context)
    assert bad["value"] is None and "1 of 2" in bad["note"] and not bad["met"]
    assert good["value"] == pytest.approx(1.5) and good["max"] == pytest.approx(2.0)

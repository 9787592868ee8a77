"""What is on disk of a run that is killed."""

import signal
import subprocess
import sys
import time

import numpy as np
import pydrake.all as drake
import pytest

from makebreak.diagrams.recorder import add_recorder, recorded
from makebreak.gap.data.reading import read_recording
from makebreak.scripts.runner import recording_stream
from makebreak.scripts.runner.session import Session

# A pendulum with a recorder, simulated in real time for a minute.
RUN = """
import sys
from pathlib import Path
import numpy as np
import pydrake.all as drake
from makebreak.diagrams.recorder import add_recorder
from makebreak.scripts.runner.session import Session

def pendulum():
    builder = drake.DiagramBuilder()
    plant, _ = drake.AddMultibodyPlantSceneGraph(builder, 0.001)
    rod = drake.SpatialInertia.SolidCylinderWithMassAboutEnd(1.0, 0.02, 0.5, [0, 0, -1])
    link = plant.AddRigidBody("link", rod)
    joint = plant.AddJoint(drake.RevoluteJoint(
        "swing", plant.world_frame(), link.body_frame(), [0, 1, 0]))
    plant.AddJointActuator("motor", joint)
    joint.set_default_angle(1.0)
    plant.Finalize()
    told = builder.AddSystem(drake.Sine(0.3, 5.0, 0.0, 1))
    builder.Connect(told.get_output_port(0), plant.get_actuation_input_port())
    add_recorder(
        builder,
        {"x": (plant.get_state_output_port(), ["p.j.position", "p.j.velocity"])},
        {"u": (told.get_output_port(0), ["p.j.effort_command"])},
    )
    return builder.Build()
"""
MAIN = (
    RUN
    + """
with Session(Path(sys.argv[1]), realtime=1.0, progress=False) as session:
    session.simulate(pendulum(), 60.0, {})
"""
)


def test_a_killed_run_loses_a_second_at_most(tmp_path):
    out = tmp_path / "out"
    script = tmp_path / "run.py"
    script.write_text(MAIN)
    process = subprocess.Popen([sys.executable, str(script), str(out)])
    file = out / ".unfinished" / "recording.csv"
    try:
        began = None
        while began is None or time.monotonic() < began + 2.5:
            assert process.poll() is None
            if began is None and file.is_file() and file.stat().st_size:
                began = time.monotonic()  # Of what a second and more had gathered.
            time.sleep(0.02)
        first = time.monotonic() - began
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    recording = read_recording(file)
    t = recording.time
    assert np.diff(t) == pytest.approx(np.full(len(t) - 1, 0.005), abs=1e-9)
    # A second had passed in simulation when the file came (real time is as fast as it
    # may go), or less on a slow machine; since then at most one was lost.
    assert t[-1] > first - 1.5
    # The next run of that folder keeps it.
    with Session(out, progress=False) as session:
        assert session.outputs.salvaged == out / "killed"
        assert (out / "killed" / "recording.csv").is_file()
        assert not file.exists()
    assert read_recording(out / "killed" / "recording.csv").time[-1] == t[-1]


ROW_SEC = 0.0125  # Of ball_rolling's recording, and its samples.

# ball_rolling, which says the clock and its simulated time at each sample.
ROLL = """
import os, sys
from pathlib import Path
from time import monotonic
from makebreak.diagrams.ball_rolling import BallRollingConfig, make_ball_rolling
from makebreak.diagrams.camera import CameraConfig
from makebreak.scripts.runner.session import Session

def say(t, sample):
    os.write(1, f"{monotonic()!r} {t!r}\\n".encode())

with Session(Path(sys.argv[1]), realtime=1.0, progress=False) as session:
    config = BallRollingConfig(camera=CameraConfig(renderer="drawn"))
    diagram = make_ball_rolling(config)
    tau = diagram.GetSubsystemByName("impedance_controller").GetOutputPort("tau")
    session.simulate(diagram, 60.0, {"tau": tau}, until=say)
"""


@pytest.mark.slow
def test_ball_rolling_that_is_killed_at_ten_random_moments_loses_a_second(tmp_path):
    script = tmp_path / "roll.py"
    script.write_text(ROLL)
    moments = np.random.default_rng(0).uniform(2.0, 8.0, 10)
    for k, moment in enumerate(moments):
        out = tmp_path / f"out_{k}"
        process = subprocess.Popen(
            [sys.executable, str(script), str(out)], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        said = []
        try:
            while not said or time.monotonic() < said[0][0] + moment:
                line = process.stdout.readline()
                assert line, "it ended by itself"
                said.append([float(number) for number in line.split()])
        finally:
            process.send_signal(signal.SIGKILL)
            rest = process.communicate()[0]
        clock, simulated = np.array(
            said + [[float(n) for n in s.split()] for s in rest.splitlines()]
        ).T
        recording = read_recording(out / ".unfinished" / "recording.csv")
        np.testing.assert_allclose(np.diff(recording.time), ROW_SEC, atol=1e-9)
        # At the sample of the last writing two rows were not yet whole. It had ended
        # when the next one was said. From then on a second may pass until one sample,
        # the last, begins to write again: whatever else the machine does.
        written = np.searchsorted(simulated, recording.time[-1] + 2 * ROW_SEC - 1e-6)
        later = clock[written + 1 : -1]
        assert len(later) == 0 or later[-1] - later[0] < 1.0


def test_what_was_streamed_is_what_is_written_at_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr(recording_stream, "EVERY_SEC", 0.0)  # At each sample.
    scope: dict = {}
    exec(RUN, scope)
    diagram = scope["pendulum"]()
    with Session(tmp_path / "out", progress=False) as session:
        log = session.simulate(diagram, 0.5, {})
        columns = recorded(diagram, log.context)
        streamed = session.outputs.file("recording.csv")
        table = np.genfromtxt(streamed, delimiter=",", names=True, deletechars="")
        assert set(table.dtype.names) == set(columns)
        for name, y in columns.items():
            assert table[name] == pytest.approx(y, rel=1e-12, abs=1e-12)  # Of sums.
        session.write_recording(columns)
        session.simulate(scope["pendulum"](), 0.1, {}, label="again")
        session.finish()
    # What was streamed beside it is gone with a complete run.
    assert {p.name for p in (tmp_path / "out").glob("*.csv")} == {"recording.csv"}


class LateSensor(drake.LeafSystem):
    """Reads a line every 7 ms, and knows it 20 ms later."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("reading", 2, self._read)

    def _read(self, context, output):
        t = 0.007 * np.floor((context.get_time() - 0.02) / 0.007 + 1e-9)
        output.SetFromVector([t, 2.0 * t] if t >= 0.0 else [-1.0, 0.0])


def test_what_is_read_late_is_streamed_in_its_place(tmp_path, monkeypatch):
    monkeypatch.setattr(recording_stream, "EVERY_SEC", 0.0)  # At each sample.
    builder = drake.DiagramBuilder()
    line = builder.AddSystem(drake.Sine(1.0, 3.0, 0.0, 1)).get_output_port(0)
    reading = builder.AddSystem(LateSensor()).get_output_port()
    add_recorder(
        builder, {"q": (line, ["a.j.position"])}, {"u": (line, ["a.j.effort_command"])},
        readings={"r": (reading, ["", "o.o.x"])}, behind_sec=0.027,
    )  # fmt: skip
    with Session(tmp_path / "out", progress=False) as session:
        log = session.simulate(builder.Build(), 0.5, {})
        columns = recorded(log.diagram, log.context)
        streamed = session.outputs.file("recording.csv")
        table = np.genfromtxt(streamed, delimiter=",", names=True, deletechars="")
    assert np.isfinite(columns["o.o.x"]).sum() == 69  # 0 to 480 ms.
    assert set(table.dtype.names) == set(columns)
    for name, y in columns.items():
        np.testing.assert_allclose(table[name], y, atol=1e-12, err_msg=name)


def test_an_interrupted_run_keeps_what_was_streamed(tmp_path):
    scope: dict = {}
    exec(RUN, scope)
    with Session(tmp_path / "out", progress=False) as session:
        session.simulate(scope["pendulum"](), 0.1, {})
        session.finish(complete=False)
    t = read_recording(tmp_path / "out" / "recording.csv").time
    assert t[-1] == pytest.approx(0.1)

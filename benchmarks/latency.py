"""Latencies in `ball_rolling`: from a change of a sensor to that of each output.

They are measured: two copies of one Context are simulated, and in one of them a sensor
is perturbed from some instant on. An output has seen the change when it differs. As
updates take no simulated time, their computing time is given as well.
"""

import subprocess
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    PortDataType,
)
from pydrake.systems.sensors import ImageRgba8U

from makebreak.benchmarks.rows import failed
from makebreak.diagrams.ball_rolling import CONTROL, make_ball_rolling, make_world
from makebreak.diagrams.ball_rolling_config import LEARN, BallRollingConfig
from makebreak.diagrams.camera import CameraConfig
from makebreak.diagrams.station import ARM
from makebreak.scripts.runner.trials import makebreak_command, run_commands
from makebreak.systems.contact_mpc.numerics.rolling_task import ROLL

WARM_SEC = 6.0  # Time by which the ball rolls and the learner's buffer is full.
WARM_MAX_SEC = 30.0  # Timeout for the ball to roll.
ROLLS = 8  # Consecutive periods of C3 with a rolling ball before the measurement.
PHASES = 32  # Instants within a period of the learner at which a sensor changes.
LOOK_SEC = 2.5e-4  # Period at which outputs are compared.
WITHIN_SEC = 0.15  # An output unchanged after this time does not depend on the sensor.
# Size of the perturbation of each sensor: far above rounding, but too small to change
# decisions of state machines.
ENCODERS, TORQUES = f"{ARM}.position_measured", f"{ARM}.torque_measured"
PICTURE = "overhead.rgb_image"
NUDGES = {ENCODERS: 1e-6, TORQUES: 1e-3, PICTURE: 1.0}
SAYS = {ENCODERS: "encoders", TORQUES: "joint torques", PICTURE: "picture"}
# Outputs that are compared, in the order of the data flow: (system, port).
OUTPUTS = {
    "tracked ball": ("ball_tracker", "p_WB"),
    "state": ("state_estimator", "x"),
    "force on the tip": ("state_estimator", "u_measured"),
    "learned gap": ("residual_learner", "r_comp"),
    "plan": ("c3_mpc", "u"),
    "arm's reference": ("arm_reference", "command"),
    "torque": ("impedance_controller", "tau"),
}
SHOWN = {
    ENCODERS: {name: port for name, port in OUTPUTS.items() if name != "tracked ball"},
    # The state depends on torques only through the arm's motion.
    TORQUES: {
        name: OUTPUTS[name] for name in ("force on the tip", "learned gap", "plan")
    },
    PICTURE: OUTPUTS,
}
LCM_SEC, LCM_RATE = 4.0, 0.2  # Duration; simulated seconds per real second.
LCM_URL = "udpm://239.255.76.67:7693?ttl=0"


class Nudge(LeafSystem):
    """Adds its state (initially 0) to a vector, or shifts an image by that [pixels]."""

    def __init__(self, port):
        super().__init__()
        self._more = self.DeclareDiscreteState(1)
        if port.get_data_type() == PortDataType.kVectorValued:
            self.DeclareVectorInputPort("value", port.size())
            self.DeclareVectorOutputPort("value", port.size(), self._add)
        else:
            example = port.Allocate()
            self.DeclareAbstractInputPort("value", example)
            self.DeclareAbstractOutputPort("value", example.Clone, self._shift)

    def start(self, context: Context, by: float) -> None:
        context.SetDiscreteState(self._more, [by])

    def _by(self, context) -> float:
        return context.get_discrete_state(self._more).value()[0]

    def _add(self, context: Context, output: BasicVector):
        value = self.get_input_port().Eval(context)
        output.SetFromVector(value + self._by(context))

    def _shift(self, context: Context, output: Value[ImageRgba8U]):
        pixels = self.get_input_port().Eval(context).data
        by = int(self._by(context))
        output.get_mutable_value().mutable_data[:] = np.roll(pixels, by, axis=1)


def make_nudged_station(station: Diagram) -> Diagram:
    """The station with a Nudge, named after the port, behind each sensor of NUDGES."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("inner", station)
    for i in range(station.num_input_ports()):
        port = station.get_input_port(i)
        builder.ExportInput(port, port.get_name())
    for i in range(station.num_output_ports()):
        port = station.get_output_port(i)
        name = port.get_name()
        if name in NUDGES:
            nudge = builder.AddNamedSystem(name, Nudge(port))
            builder.Connect(port, nudge.get_input_port())
            port = nudge.get_output_port()
        builder.ExportOutput(port, name)
    diagram = builder.Build()
    diagram.set_name("station")
    return diagram


def ages(
    diagram: Diagram,
    context: Context,
    sensor: str,
    outputs: Mapping[str, tuple[str, str]],
    phases: int,
) -> dict[str, np.ndarray]:
    """{output: (phases,) time [s] from the change of `sensor` to that of the output};
    inf if it does not change within WITHIN_SEC.

    Args: context: of the diagram, not changed; sensor: a key of NUDGES; outputs: {name:
        (system, port)}.
    """
    nudge = diagram.GetSubsystemByName("station").GetSubsystemByName(sensor)
    ports = {
        name: diagram.GetSubsystemByName(system).GetOutputPort(port)
        for name, (system, port) in outputs.items()
    }
    found = {name: np.full(phases, np.inf) for name in ports}
    for k in range(phases):
        # In the middle between two ticks, so that each tick reads a current value.
        start = context.get_time() + (k + 0.5) * LEARN / phases
        runs = [Simulator(diagram, context.Clone()) for _ in range(2)]
        for run in runs:
            run.AdvanceTo(start)
        nudge.start(
            nudge.GetMyMutableContextFromRoot(runs[1].get_mutable_context()),
            NUDGES[sensor],
        )
        for i in range(round(WITHIN_SEC / LOOK_SEC)):
            for run in runs:
                run.AdvanceTo(start + i * LOOK_SEC)
            for name, port in ports.items():
                if found[name][k] < np.inf:
                    continue
                was, now = (
                    port.Eval(port.get_system().GetMyContextFromRoot(r.get_context()))
                    for r in runs
                )
                if not np.array_equal(was, now):
                    found[name][k] = i * LOOK_SEC
            if all(each[k] < np.inf for each in found.values()):
                break
    return found


def rows() -> list[dict]:
    """Mean and largest latency [ms] from each sensor to each output that depends on it,
    with the computing time of the output's system; then the loop over LCM."""
    config = BallRollingConfig(camera=CameraConfig(renderer="drawn"), seed=2)
    diagram = make_ball_rolling(config, station=make_nudged_station(make_world(config)))
    simulator = Simulator(diagram)
    phase = diagram.GetSubsystemByName("rolling_task").GetOutputPort("phase")
    context = simulator.get_context()
    own = phase.get_system().GetMyContextFromRoot(context)
    periods, rolls = round(WARM_SEC / CONTROL), 0
    while rolls < ROLLS:  # C3's command reaches the arm only while the ball rolls.
        simulator.AdvanceTo(periods * CONTROL)
        rolls = rolls + 1 if phase.Eval(own)[0] == ROLL else 0
        periods += 1
        if context.get_time() > WARM_MAX_SEC:
            raise RuntimeError(f"the ball is not rolled within {WARM_MAX_SEC} s")
    found = [row for sensor in NUDGES for row in _rows(sensor, diagram, context)]
    try:
        return found + _lcm_rows()
    except (RuntimeError, OSError) as error:
        return [*found, failed("over LCM", error)]


def _rows(sensor: str, diagram: Diagram, context: Context) -> list[dict]:
    found = []
    for name, sec in ages(diagram, context, sensor, SHOWN[sensor], PHASES).items():
        what = f"{SAYS[sensor]} -> {name}, mean age"
        late = int(np.sum(~np.isfinite(sec)))
        if late:
            why = f"not seen within {WITHIN_SEC} s in {late} of {len(sec)}"
            found.append(failed(what, RuntimeError(why)))
            continue
        row = {
            "what": what,
            "unit": "ms",
            "value": 1e3 * float(sec.mean()),
            "max": 1e3 * float(sec.max()),
        }
        system = diagram.GetSubsystemByName(OUTPUTS[name][0])
        times = getattr(system, "update_times", None)
        if times is not None:
            computing = 1e3 * np.array(times.wall_sec)
            row["computing p50"] = float(np.percentile(computing, 50))
            row["computing p99"] = float(np.percentile(computing, 99))
        found.append(row)
    return found


def _lcm_rows() -> list[dict]:
    """Controllers and simulated robot in two processes on this machine: wall time from
    a status to its command, and the robot's time until that acts."""
    common = ["--set", "camera.renderer=drawn", "--seed", "2"]
    station = makebreak_command(
        "station", "--url", LCM_URL, "--rate", f"{LCM_RATE}", *common
    )
    with TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        run = makebreak_command(
            "run", "--robot", "lcm", LCM_URL, "--duration", f"{LCM_SEC}", "--out",
            str(out), *common,
        )  # fmt: skip
        with subprocess.Popen(station, stdout=subprocess.DEVNULL) as robot:
            try:
                [result] = run_commands("latency", [run], [out], 1)
            finally:
                robot.terminate()
    if "error" in result:
        raise RuntimeError(result["error"])
    rows = []
    for what, key in (
        ("status -> command, computing", "status_to_command"),
        (f"reading -> its torque acts, at {LCM_RATE} of real time", "loop_delay"),
    ):
        p50, p99 = (result[f"{key}_{p}_ms"] for p in ("p50", "p99"))
        rows.append(
            {"what": f"over LCM: {what}", "unit": "ms", "value": p50, "p99": p99}
        )
    return rows

"""A recording in place of a station: its sensors give what was recorded.

Controllers can so be compared with what was commanded in the recording, open loop:
their commands have no effect. Values are interpolated between the recording's rows,
which come every 12.5 ms, while controllers read every millisecond.
"""

from collections.abc import Mapping

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
)
from scipy.signal import savgol_filter

from makebreak.diagrams.scene_facts import N_JOINTS, PANDA_JOINTS
from makebreak.diagrams.station import ARM

SMOOTH_ROWS = 9  # The ball's velocity is the slope of a parabola through these rows.


class RecordedSignals(LeafSystem):
    """Recorded signals, interpolated between rows; the last row stays.

    Outputs: one (k,) for each of `signals`.

    Args: time (n,) [s]; signals: {name: (n, k)}; held: names of signals that keep the
        value of the row before, instead of being interpolated.
    """

    def __init__(self, time, signals: Mapping[str, np.ndarray], held=()):
        super().__init__()
        self._time = np.asarray(time, dtype=float)
        for name, rows in signals.items():
            self.DeclareVectorOutputPort(
                name, rows.shape[1], self._reader(rows, name in held)
            )

    def _reader(self, rows: np.ndarray, is_held: bool):
        time = self._time

        def read(context: Context, output: BasicVector):
            t = context.get_time()
            i = int(np.searchsorted(time, t + 1e-9, side="right")) - 1
            i = min(max(i, 0), len(time) - 1)
            if is_held or i == len(time) - 1:
                output.SetFromVector(rows[i])
                return
            s = (t - time[i]) / (time[i + 1] - time[i])
            output.SetFromVector(rows[i] + max(s, 0.0) * (rows[i + 1] - rows[i]))

        return read


def joint_columns(what: str) -> list[str]:
    """Column names of the arm's joints in a recording. Args: what: as `position`."""
    return [f"{ARM}.{joint}.{what}" for joint in PANDA_JOINTS]


def make_replay_station(
    columns: Mapping[str, np.ndarray], ball: tuple[str, str], radius: float
) -> Diagram:
    """The sensors of a recording with the ports of a station.

    Inputs:  panda.torque_commanded (7,), without effect.
    Outputs: panda.position_measured, velocity_measured, torque_measured (7,);
             ball.p_WB [m], ball.v_WB [m/s] (3,), ball.seen (1,).

    Args: columns: as in gap/data/table.py; ball: names of the columns of the ball's x
        and y [m]; radius: of the modelled ball, which gives its z [m].
    Raises: ValueError for a missing column, or NaN in a column of the joints.
    """
    missing = [
        name
        for what in ("position", "velocity", "effort_measured", "effort_command")
        for name in joint_columns(what)
        if name not in columns
    ]
    missing += [name for name in ("time", *ball) if name not in columns]
    if missing:
        raise ValueError(f"the recording lacks {', '.join(missing[:3])}")
    time = np.asarray(columns["time"], dtype=float)
    if len(time) < SMOOTH_ROWS:
        raise ValueError(f"the recording has {len(time)} rows, expected {SMOOTH_ROWS}")
    signals = {}
    for port, what in (
        ("position_measured", "position"),
        ("velocity_measured", "velocity"),
        ("torque_measured", "effort_measured"),
    ):
        signals[port] = np.column_stack([columns[name] for name in joint_columns(what)])
        if not np.isfinite(signals[port]).all():
            raise ValueError(f"the recording has holes in its {what} columns")
    p = np.column_stack([columns[name] for name in ball])
    seen = np.isfinite(p).all(axis=1)
    if seen.sum() < 2:
        raise ValueError(f"the recording has no ball: {', '.join(ball)} are empty")
    for k in range(2):
        p[:, k] = np.interp(time, time[seen], p[seen, k])
    step = float(np.median(np.diff(time)))
    v = savgol_filter(p, SMOOTH_ROWS, 2, deriv=1, delta=step, axis=0)
    n = len(time)
    signals["p_WB"] = np.column_stack([p, np.full(n, radius)])
    signals["v_WB"] = np.column_stack([v, np.zeros(n)])
    signals["seen"] = seen[:, None].astype(float)

    builder = DiagramBuilder()
    source = builder.AddNamedSystem(
        "recorded", RecordedSignals(time, signals, held=("seen",))
    )
    for port in signals:
        of = "ball" if port in ("p_WB", "v_WB", "seen") else ARM
        builder.ExportOutput(source.GetOutputPort(port), f"{of}.{port}")
    sink = builder.AddNamedSystem("torque_sink", _TorqueSink())
    builder.ExportInput(sink.get_input_port(), f"{ARM}.torque_commanded")
    diagram = builder.Build()
    diagram.set_name("station")
    return diagram


class _TorqueSink(LeafSystem):
    """Ignores the torque (7,)."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("torque", N_JOINTS)

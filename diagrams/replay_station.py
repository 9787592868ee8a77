"""A recording in place of a station: its sensors, as they were, whatever is commanded.

Between two rows of the recording its values are interpolated: rows come every 12.5 ms,
controllers ask every millisecond. What they answer can then be compared with what was
commanded (open loop: nothing that they command is felt).
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

SMOOTH_ROWS = 9  # Of a parabola through the ball's places, whose slope is its speed.


class RecordedSignals(LeafSystem):
    """Signals that were recorded, by interpolation; the last ones stay.

    Outputs: one for each of `signals`, {name: (n, k)}; those in `held` are taken from
             the row before.
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
            share = (t - time[i]) / (time[i + 1] - time[i])
            output.SetFromVector(rows[i] + max(share, 0.0) * (rows[i + 1] - rows[i]))

        return read


def joint_columns(what: str) -> list[str]:
    """Names of a recording's columns of the arm's joints, such as `position`."""
    return [f"{ARM}.{joint}.{what}" for joint in PANDA_JOINTS]


def make_replay_station(
    columns: Mapping[str, np.ndarray], ball: tuple[str, str], radius: float
) -> Diagram:
    """The sensors of a recording with the ports of a station.

    Inputs:  panda.torque_commanded (7,), which moves nothing.
    Outputs: panda.position_measured, velocity_measured, torque_measured (7,);
             ball.p_WB, ball.v_WB (3,), ball.seen (1,).

    Args: columns, of gap/data/table.py; ball: names of those of the ball's place in the
        plane [m]; radius: its height, as it is believed [m].
    Raises: ValueError for a column that is not there or has holes where none may be.
    """
    lacks = [
        name
        for what in ("position", "velocity", "effort_measured", "effort_command")
        for name in joint_columns(what)
        if name not in columns
    ]
    lacks += [name for name in ("time", *ball) if name not in columns]
    if lacks:
        raise ValueError(f"the recording lacks {', '.join(lacks[:3])}")
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
    nobody = builder.AddNamedSystem("nobody", _Nobody())
    builder.ExportInput(nobody.get_input_port(), f"{ARM}.torque_commanded")
    diagram = builder.Build()
    diagram.set_name("station")
    return diagram


class _Nobody(LeafSystem):
    """Takes torques and does nothing."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("torque", N_JOINTS)

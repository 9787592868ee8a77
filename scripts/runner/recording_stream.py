"""Writes a recording to disk during the run, in case the run is killed."""

from pathlib import Path
from time import monotonic

import numpy as np
from pydrake.systems.framework import Context, Diagram

from makebreak.diagrams.recorder import behind_sec, has_recorder, recorded
from makebreak.gap.data.table import csv_rows

EVERY_SEC = 1.0  # Wall time between writes; at most this much is lost.


class RecordingStream:
    """Appends the rows of a diagram's Recorder to a csv file.

    The format is that of write_recording (gap/data/table.py). The rows are the raw
    readings, including those that an experiment removes at its end (such as of a ball
    that the camera does not see). Without a Recorder there is no file; after an error,
    such as a full disk, no more is written.
    """

    def __init__(self, path: Path, diagram: Diagram):
        self.path = path
        self._diagram = diagram
        self._next = -np.inf  # Simulated time of the first row not on disk [s].
        self._due = monotonic() + EVERY_SEC
        self._open = has_recorder(diagram)
        self._begun = False

    def tick(self, context: Context) -> None:
        """Writes new rows every EVERY_SEC. context: the simulation's root context."""
        if self._open and monotonic() >= self._due:
            self.catch_up(context)
            self._due = monotonic() + EVERY_SEC

    def catch_up(self, context: Context, ended: bool = False) -> None:
        """Writes new rows. ended: whether the last row is complete; otherwise its
        command is still acting."""
        if not self._open:
            return
        columns = recorded(self._diagram, context, self._next)
        time = columns["time"]
        n = len(time)
        # The last row may still change, and late readings may still arrive.
        if n and not ended:
            until = time[-1] - behind_sec(self._diagram)
            n = int(np.searchsorted(time, until - 1e-9))
        if n < 1:
            return
        last = columns["time"][n:]
        rows = csv_rows({name: y[:n] for name, y in columns.items()})
        try:
            with self.path.open("a") as file:
                if not self._begun:
                    file.write(",".join(columns) + "\n")
                file.write("\n".join(rows) + "\n")
        except OSError:
            self._open = False
            return
        self._begun = True
        self._next = float(last[0]) if len(last) else np.inf

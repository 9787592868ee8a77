"""A recording on disk while it is made: what a run that is killed leaves behind."""

from pathlib import Path
from time import monotonic

import numpy as np
from pydrake.systems.framework import Context, Diagram

from makebreak.diagrams.recorder import behind_sec, has_recorder, recorded
from makebreak.gap.data.table import csv_rows

# By the clock: so much is lost at most, and the time by which readings are late.
EVERY_SEC = 1.0


class RecordingStream:
    """Appends the rows that a diagram's Recorder has gathered to a csv file, as
    write_recording writes it (gap/data/table.py), but as the sensors gave them: what an
    experiment leaves out at the end (a ball that the camera did not see) is there.

    A diagram without a Recorder has no file. A file that cannot be written, as on a
    full disk, is not tried again.
    """

    def __init__(self, path: Path, diagram: Diagram):
        self.path = path
        self._diagram = diagram
        self._next = -np.inf  # Time of the first row that is not on disk [s].
        self._due = monotonic() + EVERY_SEC
        self._open = has_recorder(diagram)
        self._begun = False

    def tick(self, context: Context) -> None:
        """Writes what has come, if it is time. context: the simulation's root."""
        if self._open and monotonic() >= self._due:
            self.catch_up(context)
            self._due = monotonic() + EVERY_SEC

    def catch_up(self, context: Context, ended: bool = False) -> None:
        """Writes what has come. ended: the last row is whole, too; else its command
        is still acting."""
        if not self._open:
            return
        columns = recorded(self._diagram, context, self._next)
        time = columns["time"]
        n = len(time)
        # The last row may still change, and what is read late come.
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

"""Writes recordings: one table, a column per measured channel, a row per instant.

The columns are those of docs/command_line.md, in SI units:

    time                                         [s]
    episode                                      optional integer
    <model>.<joint>.position, .velocity, .effort_command, ...
    <model>.<body>.x .y .z .qw .qx .qy .qz       pose in world
    <model>.<body>.vx .vy .vz .wx .wy .wz        velocity in world
    <model>.<frame>.fx .fy .fz .tx .ty .tz       wrench on the robot, in world
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

SUFFIXES = frozenset(
    "position velocity effort_command effort_measured position_command "
    "velocity_command x y z qw qx qy qz vx vy vz wx wy wz fx fy fz tx ty tz".split()
)


def check_columns(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns as 1-D float arrays of one length, `time` first.

    Raises: ValueError, naming the column, for a name that recordings do not have, a
        column of another length, and a time that does not increase in an episode.
    """
    if "time" not in columns:
        raise ValueError(f"a recording needs the column time, got {sorted(columns)}")
    names = ["time", *(["episode"] if "episode" in columns else [])]
    names += [name for name in columns if name not in names]
    table = {name: np.asarray(columns[name], dtype=float) for name in names}
    n = np.size(columns["time"])
    for name, value in table.items():
        parts = name.split(".")
        if name not in ("time", "episode") and (
            len(parts) < 3 or parts[-1] not in SUFFIXES or not all(parts)
        ):
            raise ValueError(
                f'recording column "{name}", expected <model>.<joint, body or frame>.'
                "<one of: " + " ".join(sorted(SUFFIXES)) + ">"
            )
        if value.shape != (n,):
            raise ValueError(
                f"recording column {name} is {value.shape}, expected ({n},) as time"
            )
    time, episode = table["time"], table.get("episode", np.zeros(n))
    step = np.diff(time)
    bad = np.flatnonzero(~(step > 0) & (np.diff(episode) == 0))
    if n and not np.isfinite(time).all():
        raise ValueError("recording column time is not finite in every row")
    if bad.size:
        row = bad[0] + 1
        raise ValueError(
            f"recording column time does not increase at row {row}: "
            f"{time[row]} after {time[row - 1]}"
        )
    return table


def write_recording(
    path: Path, columns: Mapping[str, np.ndarray], noise: Mapping | None = None
) -> list[Path]:
    """Writes the table at `path`, .csv or .npz, and noise.json beside it.

    Args:
        path: the file; its suffix chooses the format.
        columns: {column: (n,) array}; NaN is a missing sample: an empty cell.
        noise: what is known of the noise, as JSON; {column: standard deviation}.
    Returns: the files written.
    Raises: ValueError as check_columns, and for another suffix.
    """
    path = Path(path)
    table = check_columns(columns)
    if path.suffix == ".csv":
        # repr gives the shortest text that reads back as the very same number.
        cells = [
            [str(int(v)) for v in value]
            if name == "episode"
            else ["" if v != v else repr(v) for v in value.tolist()]
            for name, value in table.items()
        ]
        rows = [",".join(row) for row in zip(*cells, strict=True)]
        path.write_text("\n".join([",".join(table), *rows]) + "\n")
    elif path.suffix == ".npz":
        with path.open("wb") as file:
            np.savez_compressed(file, **table)  # type: ignore[arg-type]
    else:
        raise ValueError(f'recording file "{path}", expected a name in .csv or .npz')
    written = [path]
    if noise is not None:
        beside = path.with_name("noise.json")
        beside.write_text(json.dumps(dict(noise), indent=2) + "\n")
        written.append(beside)
    return written

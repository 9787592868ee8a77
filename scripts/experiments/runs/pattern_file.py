"""Reads a motion pattern from a user's file: a pattern in YAML, or the recording of a
demonstration with the tool's pose and the force on it.

A recording is a table as in docs/recordings.md. The pose is that of a body or frame,
`<model>.<frame>.x .y .z .qw .qx .qy .qz`; without one, it is computed from the arm's
joint positions with the controllers' model of the arm. The force on the tool is
`<model>.<frame>.fx .fy .fz`, in world axes.
"""

from pathlib import Path

import numpy as np

from makebreak.diagrams.arm_reach import ArmReach
from makebreak.diagrams.scene_facts import PANDA_JOINTS
from makebreak.diagrams.station import ARM, TIP_FRAME, make_control_plant
from makebreak.diagrams.tabletop import TOOL
from makebreak.gap.data.table import FORMATS, POSE, read_table, suffix_of
from makebreak.models.scene import Scene
from makebreak.systems.changing_contact.numerics.demonstration import (
    pattern_from_demonstration,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    load_pattern,
)

YAML = (".yaml", ".yml")
LONGEST_SEC = 600.0  # Longest demonstration.
FORCE = ("fx", "fy", "fz")
RATE_HZ = 100.0  # Rate to which a demonstration is resampled; its motion is below 3 Hz.
# A demonstration starts at rest: during this time a force up to the second number is
# taken for the sensor's bias.
REST_SEC, BIAS_MAX = 0.1, 1.0  # [s], [N]


def read_pattern(path: str | Path, model: Scene) -> MotionPattern:
    """The pattern of a file.

    Args: model: the controllers' scene, with arm and tool.
    Raises: ValueError in one line: the file, what was wrong, what was expected.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise ValueError(
            f"pattern {path} {what}, expected a motion pattern ({', '.join(YAML)}) or "
            f"a recorded demonstration ({', '.join(FORMATS)})"
        )
    if path.suffix.lower() in YAML:
        return load_pattern(path)
    if suffix_of(path) not in (*FORMATS, ".csv.gz"):
        raise ValueError(
            f'pattern {path}: the name ends in "{path.suffix}", expected one of '
            f"{', '.join((*YAML, *FORMATS))}"
        )
    time, pose, force = _demonstration(path, model)
    try:
        return pattern_from_demonstration(time, pose, force)
    except ValueError as error:
        raise ValueError(f"pattern {path}: {error}") from None


def _demonstration(path: Path, model: Scene):
    """Times (n,), poses (n, 7) and forces (n, 3) of the last episode of a recording.

    Raises: ValueError as read_pattern.
    """
    columns = read_table(path).columns
    if "time" not in columns:
        raise ValueError(
            f"pattern {path}: no column time, expected it beside the tool's pose and "
            f"the force on it; got {_listed(columns)}"
        )
    last = np.ones(len(columns["time"]), bool)
    if "episode" in columns:
        last = columns["episode"] == columns["episode"][-1]
    columns = {name: values[last] for name, values in columns.items()}
    time = columns["time"]
    bad = np.flatnonzero(~(np.diff(time) > 0.0))
    if bad.size:
        row = bad[0] + 1
        raise ValueError(
            f"pattern {path}: time {time[row]:g} follows {time[row - 1]:g} in row "
            f"{row + 1}, expected increasing times [s]"
        )
    if time[-1] - time[0] > LONGEST_SEC:
        raise ValueError(
            f"pattern {path}: {time[-1] - time[0]:.0f} s long, expected at most "
            f"{LONGEST_SEC:.0f} s"
        )
    at = _element(path, columns, FORCE, "force on the tool", "fx .fy .fz")
    force = np.stack([columns[f"{at}.{name}"] for name in FORCE], axis=1)
    rest = force[time <= time[0] + REST_SEC].mean(axis=0)
    if np.linalg.norm(rest) < BIAS_MAX:
        force = force - rest
    pose = _poses(path, columns, model)
    step = 1
    if len(time) > 1:
        step = max(1, round(1.0 / (RATE_HZ * float(np.median(np.diff(time))))))
    return tuple(_thinned(values, step) for values in (time, pose, force))


def _poses(path: Path, columns, model: Scene) -> np.ndarray:
    """(n, 7) poses of the tip, as recorded or from the arm's joint positions."""
    joints = [f"{ARM}.{name}.position" for name in PANDA_JOINTS]
    if not any(name.endswith(".qw") for name in columns):
        missing = [name for name in joints if name not in columns]
        if missing:
            raise ValueError(
                f"pattern {path}: no pose of the tool, expected <model>.<frame>.x .y "
                f".z .qw .qx .qy .qz, or the arm's joints (no {missing[0]}); got "
                f"{_listed(columns)}"
            )
        q = np.stack([columns[name] for name in joints], axis=1)
        bad = np.flatnonzero(~np.isfinite(q).all(axis=1))
        if bad.size:
            raise ValueError(
                f"pattern {path}: the joint positions of row {bad[0] + 1} are not all "
                "there, expected a number in each"
            )
        reach = ArmReach(make_control_plant(model, TOOL))
        rows = []
        for each in q:
            p, R = reach.pose(each)
            rows.append([*p, *R.ToQuaternion().wxyz()])
        return np.array(rows)
    at = _element(path, columns, POSE, "pose of the tool", "x .y .z .qw .qx .qy .qz")
    pose = np.stack([columns[f"{at}.{name}"] for name in POSE], axis=1)
    size = np.linalg.norm(pose[:, 3:], axis=1)
    bad = np.flatnonzero(~(abs(size - 1.0) < 1e-2))
    if bad.size:
        raise ValueError(
            f"pattern {path}: the quaternion of row {bad[0] + 1} has length "
            f"{size[bad[0]]:.3g}, expected 1"
        )
    q = pose[:, 3:] / size[:, None]
    flips = np.sign(np.sum(q[1:] * q[:-1], axis=1))  # q and -q are one orientation.
    q[1:] *= np.cumprod(np.where(flips < 0.0, -1.0, 1.0))[:, None]
    return np.hstack([pose[:, :3], q])


def _element(path: Path, columns, quantities, what: str, wanted: str) -> str:
    """The body or frame with all of these quantities: `tool.tip`, or the only one."""
    last = f".{quantities[-1]}"
    found = [
        name.removesuffix(last)
        for name in columns
        if name.endswith(last)
        and all(f"{name.removesuffix(last)}.{q}" in columns for q in quantities)
    ]
    tip = f"{TOOL}.{TIP_FRAME}"
    if tip in found:
        return tip
    if len(found) == 1:
        return found[0]
    got = f"got {_listed(columns)}" if not found else f"got {', '.join(found)}"
    expected = "expected" if not found else f"expected one, or one named {tip}, as"
    raise ValueError(
        f"pattern {path}: {len(found) or 'no'} columns of the {what}, {expected} "
        f"<model>.<frame>.{wanted}; {got}"
    )


def _listed(columns) -> str:
    names = list(columns)
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" * (len(names) > 4))


def _thinned(values: np.ndarray, step: int) -> np.ndarray:
    """(n // step, ...) means of `step` rows each, which also reduces the noise."""
    n = len(values) // step
    return values[: n * step].reshape(n, step, *values.shape[1:]).mean(axis=1)

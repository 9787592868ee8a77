"""The faults that `--fault` can inject into a station, and how its text is parsed.

A fault is written NAME[:from=S,for=S,...=...]: `from` is its start and `for` its
duration [s]. faults.py implements them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from makebreak.models.typed_yaml import nearest

ALWAYS = math.inf
TICK = 0.001  # Of the station [s].


@dataclass(frozen=True)
class Fault:
    """A kind of fault.

    says: what happens, in one line.
    on: what it acts on: camera, ball, arm, command, planner, scene, or the sensor
        position_velocity, torque or wrench.
    recoverable: whether the task should continue during or after it; else the arm has
        to be held safely. Decided before anything was run.
    lasts: duration [s], unless `for` is given.
    numbers: its own settings, {name: default}.
    """

    says: str
    on: str
    recoverable: bool
    lasts: float
    numbers: dict[str, float] = field(default_factory=dict)


FAULTS: dict[str, Fault] = {
    "none": Fault(
        "no fault; only the arm's limits are monitored",
        "nothing", True, ALWAYS,
    ),
    "frames_dropped": Fault(
        "a fraction of the camera's frames is lost; the previous one stays",
        "camera", True, ALWAYS, {"share": 0.5},
    ),
    "frames_frozen": Fault(
        "the camera freezes at its last frame", "camera", True, 0.5
    ),
    "frames_delayed": Fault(
        "each frame is some frames late", "camera", True, ALWAYS, {"frames": 3}
    ),
    "second_ball": Fault(
        "the camera shows a second ball of the same colour [m]",
        "camera", True, 3.0, {"x": 0.0, "y": 0.12},
    ),
    "glare": Fault(
        "a white spot hides most of the ball", "camera", True, 0.5
    ),
    "position_nan": Fault(
        "all encoders give NaN for positions", "position_velocity", True, 0.05
    ),
    "velocity_nan": Fault(
        "all encoders give NaN for velocities", "position_velocity", True, 0.05
    ),
    "torque_nan": Fault("the torque sensors give NaN", "torque", True, 0.5),
    "wrench_nan": Fault("the force sensor gives NaN", "wrench", True, 0.5),
    "position_stuck": Fault(
        "one encoder is stuck at its position",
        "position_velocity", False, 0.2, {"joint": 4},
    ),
    "position_bias": Fault(
        "one encoder's position has an offset [rad]",
        "position_velocity", True, ALWAYS, {"joint": 2, "by": 0.003},
    ),
    "velocity_bias": Fault(
        "all velocities have an offset [rad/s]",
        "position_velocity", False, ALWAYS, {"by": 0.1},
    ),
    "torque_bias": Fault(
        "one torque sensor has an offset [N m]",
        "torque", True, ALWAYS, {"joint": 2, "by": 2.0},
    ),
    "wrench_bias": Fault(
        "the force sensor has an offset along z [N]",
        "wrench", True, ALWAYS, {"by": 1.0},
    ),
    "position_delay": Fault(
        "positions are delayed [s], velocities are not",
        "position_velocity", True, ALWAYS, {"sec": 0.05},
    ),
    "compute_delay": Fault(
        "torques reach the arm late, as from a slow computer [s]",
        "command", True, ALWAYS, {"sec": 0.005},
    ),
    "solver_fails": Fault(
        "the planner's solver fails at every tick", "planner", True, 0.5
    ),
    "ball_taken": Fault(
        "a hand moves the ball to another place on its circle [rad]",
        "ball", True, 4.0, {"turn": 1.57},
    ),
    "push": Fault(
        "the arm's last link is pushed [N]",
        "arm", True, 0.3, {"x": 0.0, "y": 20.0, "z": 0.0},
    ),
    "weak_joint": Fault(
        "one joint gives only a fraction of its torque",
        "command", False, ALWAYS, {"joint": 2, "share": 0.333},
    ),
    "joint_friction": Fault(
        "dry friction in the first joints [N m]",
        "arm", False, ALWAYS, {"joints": 4, "coulomb": 2.0},
    ),
    "box": Fault(
        "a fixed box stands on the path from the start", "scene", False, ALWAYS
    ),
}  # fmt: skip
# Range of a setting: minimum, maximum, whether it is an integer.
RANGES: dict[str, tuple[float, float, bool]] = {
    "sec": (TICK, 1.0, False),
    "joint": (1, 7, True),
    "joints": (1, 7, True),
    "frames": (0, 80, True),  # 80: one second.
    "share": (0.0, 1.0, False),
    "coulomb": (0.0, 100.0, False),
}
FROM = 6.0  # Start of a fault, unless `from` is given [s].


@dataclass(frozen=True)
class Injected:
    """A requested fault: FAULTS[name] from `start` to `end` [s]."""

    name: str
    start: float
    end: float
    numbers: dict[str, float]

    @property
    def kind(self) -> Fault:
        return FAULTS[self.name]


def read_fault(text: str) -> Injected:
    """Parses NAME[:from=S,for=S,...=...].

    Raises: ValueError for an unknown name or setting, or a value out of range.
    """
    name, _, rest = text.partition(":")
    if name not in FAULTS:
        raise ValueError(f"unknown fault {name}; {nearest(name, FAULTS)}")
    kind = FAULTS[name]
    start = 0.0 if kind.on == "scene" else FROM
    numbers = {"from": start, "for": kind.lasts} | dict(kind.numbers)
    if kind.on == "scene":  # Present from the beginning to the end.
        numbers = dict(kind.numbers)
    for setting in filter(None, rest.split(",")):
        key, _, value = setting.partition("=")
        if key not in numbers:
            raise ValueError(f"fault {name}: unknown setting {key}; {_known(numbers)}")
        try:
            numbers[key] = float(value)
        except ValueError:
            numbers[key] = math.nan
        endless = key == "for" and numbers[key] == ALWAYS
        if not math.isfinite(numbers[key]) and not endless:
            raise ValueError(f'fault {name}: {key}: got "{value}", expected a number')
    start, lasts = numbers.pop("from", 0.0), numbers.pop("for", ALWAYS)
    if not 0.0 <= start < math.inf or not lasts > 0.0:
        raise ValueError(
            f"fault {name}: from is {start}, for {lasts}, expected >= 0 and > 0"
        )
    for key, (least, most, whole) in RANGES.items():
        number = numbers.get(key, least)
        if not least <= number <= most or whole and number != round(number):
            what = "a whole number" if whole else "a number"
            raise ValueError(
                f"fault {name}: {key} is {number:g}, expected {what} from {least:g} to "
                f"{most:g}"
            )
    return Injected(name, start, start + lasts, numbers)


def _known(numbers) -> str:
    return f"it has {', '.join(numbers)}" if numbers else "it has none"


def read_faults(texts: Sequence[str], has: Sequence[str]) -> list[Injected]:
    """Parses the faults of an experiment.

    Args: has: what the experiment has beside the arm and its sensors: camera, ball,
        planner, scene (a place for a box).
    Raises: ValueError as read_fault, and for a fault that acts on something else.
    """
    faults = [read_fault(text) for text in texts]
    for fault in faults:
        on = fault.kind.on
        if on in ("camera", "ball", "planner", "scene") and on not in has:
            what = {"scene": "known place for a box"}.get(on, on)
            raise ValueError(f"fault {fault.name}: there is no {what} here")
    return faults

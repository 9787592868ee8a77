"""A recording in memory: channels with names, episodes, rates and noise."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from makebreak.gap.data.table import COMMANDS, QUANTITIES, TWIST
from makebreak.systems.numerics.filters import Stage

FEWEST_ROWS = 10  # In an episode: fewer hold no window and no noise.
QUATERNION = ("qw", "qx", "qy", "qz")
_UNITS = {q: "N" for q in ("fx", "fy", "fz")} | {q: "N m" for q in ("tx", "ty", "tz")}
_UNITS |= {q: "m" for q in "xyz"} | {q: "1" for q in QUATERNION}
_UNITS |= {q: "m/s" for q in TWIST[:3]} | {q: "rad/s" for q in TWIST[3:]}


def unit_of(quantity: str, prismatic: bool = False) -> str:
    """The unit of a quantity; of a joint's, that of a revolute one unless said."""
    if quantity in _UNITS:
        return _UNITS[quantity]
    if "position" in quantity:
        return "m" if prismatic else "rad"
    if "velocity" in quantity:
        return "m/s" if prismatic else "rad/s"
    return "N" if prismatic else "N m"


@dataclass(frozen=True, eq=False)
class Channel:
    """One column. `<model>.<element>.<quantity>`: an element is a joint, body or frame.

    noise: standard deviation, in the channel's unit; for a command 0.
    noise_from: "given", "estimated", or "none" for a command. noise_given: of a single
    sample as the sidecar says it, else 0. averaged: samples in each value, as a mean.
    together: how many neighbouring samples' noise goes together, 1 for white noise.
    step: the channel's resolution if it is quantised, else 0.
    rate_hz: samples that are there per second. filter: what the sidecar says.
    stages: what of that is simulated; None if the text says no filter we know.
    sampled: it is what a faster loop commanded at each row.
    """

    name: str
    values: np.ndarray  # (n,), NaN where a sample is missing; read-only.
    noise: float = 0.0
    noise_from: str = "none"
    noise_given: float = 0.0
    averaged: float = 1.0
    together: float = 1.0
    step: float = 0.0
    rate_hz: float = 0.0
    filter: str = ""
    stages: tuple[Stage, ...] | None = ()
    sampled: bool = False

    @property
    def model(self) -> str:
        """The first word of the name."""
        return self.name.split(".")[0]

    @property
    def element(self) -> str:
        """The joint, body or frame."""
        return self.name.split(".", 1)[1].rsplit(".", 1)[0]

    @property
    def quantity(self) -> str:
        """The last word of the name."""
        return self.name.rsplit(".", 1)[1]

    @property
    def at(self) -> str:
        """`<model>.<element>`."""
        return self.name.rsplit(".", 1)[0]

    @property
    def is_command(self) -> bool:
        """Whether it was commanded, not measured."""
        return self.quantity in COMMANDS


@dataclass(frozen=True)
class WrenchAsLogged:
    """How a logged wrench differs from one on the robot, in world, without the weight
    of what is mounted beyond the sensor.

    axes: "world", or "sensor" for those of its frame. acts_on: "robot", or
    "environment" for the opposite sign.
    """

    holds_weight: bool = False
    axes: str = "world"
    acts_on: str = "robot"


@dataclass(frozen=True)
class Episode:
    """Rows [first, last) of a recording, without a break.

    number: that of the column `episode`, 0 where there is none. stretch: counts the
    parts of an episode of which rows were left out because the table is too long.
    """

    number: int
    first: int
    last: int
    stretch: int = 0

    @property
    def rows(self) -> slice:
        """The episode's rows, as a slice."""
        return slice(self.first, self.last)

    @property
    def is_start(self) -> bool:
        """Whether its first row is the episode's own, where `initial` holds."""
        return self.stretch == 0


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording. All arrays are read-only.

    name: unique among the recordings read together. notes: what was done to the table
    in reading: (kind, sentence). wrenches: {`<model>.<frame>`: how its wrench was
    logged}, where that is not as it is used (residuals/tool_weight.py).
    """

    name: str
    path: Path
    time: np.ndarray  # (n,) [s]
    row: np.ndarray  # (n,) number of each row in the file, from 1.
    episodes: tuple[Episode, ...]
    channels: Mapping[str, Channel]
    n_rows_in_file: int
    provenance: str = ""
    notes: tuple[tuple[str, str], ...] = ()
    quaternion_flips: Mapping[str, int] = field(default_factory=dict)
    quaternion_norm_error: Mapping[str, float] = field(default_factory=dict)
    wrenches: Mapping[str, WrenchAsLogged] = field(default_factory=dict)
    raw_period_sec: float = 0.0  # Of the rows that were averaged; 0 if none were.

    def __contains__(self, name: str) -> bool:
        return name in self.channels

    def __getitem__(self, name: str) -> np.ndarray:
        """(n,) values of a channel, NaN where a sample is missing."""
        return self.channels[name].values

    def commands(self) -> list[Channel]:
        """The channels that were commanded."""
        return [c for c in self.channels.values() if c.is_command]

    def measured(self) -> list[Channel]:
        """The channels that were measured."""
        return [c for c in self.channels.values() if not c.is_command]

    def places(self, quantities: Iterable[str] = QUANTITIES) -> list[str]:
        """`<model>.<element>` that have any of the quantities, in the file's order."""
        wanted = set(quantities)
        found = (c.at for c in self.channels.values() if c.quantity in wanted)
        return list(dict.fromkeys(found))

    def stack(self, at: str, quantities: Iterable[str]) -> np.ndarray | None:
        """(n, k) of channels `<at>.<quantity>`; None if one of them is missing."""
        names = [f"{at}.{q}" for q in quantities]
        if not all(name in self.channels for name in names):
            return None
        return np.stack([self[name] for name in names], axis=1)

    def samples(self, name: str, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
        """Times [s] and values of the samples of an episode that are there."""
        y, t = self[name][episode.rows], self.time[episode.rows]
        there = ~np.isnan(y)
        return t[there], y[there]

    def episode_at(self, row: int) -> Episode:
        """The episode that a row is in. Raises: StopIteration for a row in none."""
        return next(e for e in self.episodes if e.first <= row < e.last)

    def held(self, name: str) -> np.ndarray:
        """(n,) a command, held from its row on; NaN before an episode's first one."""
        y = self[name]
        index = np.where(np.isnan(y), -1, np.arange(len(y)))
        out = np.empty(len(y))
        for episode in self.episodes:
            last = np.maximum.accumulate(index[episode.rows])
            out[episode.rows] = np.where(last >= 0, y[last], np.nan)
        return out

    def period_sec(self) -> float:
        """Between rows, as they were written."""
        if self.raw_period_sec:
            return self.raw_period_sec
        steps = [np.diff(self.time[e.rows]) for e in self.episodes]
        return float(np.median(np.concatenate(steps)))

    def duration_sec(self) -> float:
        """Of all episodes together."""
        return float(
            sum(self.time[e.last - 1] - self.time[e.first] for e in self.episodes)
        )

"""What a column of a log is taken for."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from makebreak.models.activation import Activation

AS_SAID = "as the recording's sidecar says"


@dataclass(frozen=True)
class JointName:
    """A joint of the robot. name: `<model>.<joint>`; limits in rad or m; effort: its
    largest [N m] or [N]."""

    name: str
    prismatic: bool = False
    lower: float = -np.inf
    upper: float = np.inf
    effort: float = np.inf


@dataclass(frozen=True)
class Match:
    """What a column is taken for. channel: of a recording, `time`, `episode`, or None:
    it is left out. why: a few words. may: the channel that one that is left out would
    be, were another column not. told: of its unit, what its name does not say.
    activation: of a command that its drive does not follow as it is; clock: the time's
    match, that it goes by; filter: of the channel, for the sidecar."""

    column: str
    channel: str | None
    scale: float = 1.0
    offset: float = 0.0
    why: str = ""
    may: str = ""
    told: str = ""
    activation: Activation | None = None
    clock: "Match | None" = None
    filter: str = ""

    def values(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n,) of the channel, in its unit."""
        y = self.scale * columns[self.column] + self.offset
        if self.activation is None or self.clock is None:
            return y
        return follow(self.activation, self.channel, y, self.clock.values(columns))


def follow(
    activation: Activation, channel: str | None, u: np.ndarray, time: np.ndarray
) -> np.ndarray:
    """(n,) what a drive makes of the commands u (n,) at time (n,) [s]: where they go in
    lines from row to row, or, of efforts, what holds on average until the next row."""
    return activation.of(u, time, str(channel).endswith("effort_command"))


def plain_name(name: str) -> str:
    """Its letters and digits, in lower case."""
    return re.sub(r"[^a-z0-9]", "", name.lower())

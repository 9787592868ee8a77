"""What a column of a log is taken for."""

import re
from dataclasses import dataclass

import numpy as np

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
    be, were another column not. told: of its unit, what its name does not say."""

    column: str
    channel: str | None
    scale: float = 1.0
    offset: float = 0.0
    why: str = ""
    may: str = ""
    told: str = ""


def plain_name(name: str) -> str:
    """Its letters and digits, in lower case."""
    return re.sub(r"[^a-z0-9]", "", name.lower())

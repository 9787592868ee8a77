"""What a check says of a recording, what it needs of a scene, and what checks share."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from makebreak.gap.data.recording import Episode, Recording

G = 9.81  # [m/s2]
SURE = 5.0  # Standard errors: with 50 channels a chance finding is one in 30 000.
GUESSED_GAINS = "guessed_gains"  # Kind of the finding about a proposed scene's drives.
NO_DRIVE = "no_drive"  # The same where no column says what drives them.
NO_COLUMN = "no_column"  # Joints of a proposed scene that no column was taken for.
FIXED = "fixed_joints"  # The same of joints that it takes to stand still.
MODEL_FILE = "model_file"  # What a robot's file says and nobody uses.
TOOL_WEIGHT = "tool_weight"  # Of a wrench that holds it (residuals/tool_weight.py).
SAMPLED_COMMANDS = "sampled_commands"  # Kind of the finding of sampled_commands.py.
_MOST_EPISODES = 40
_MOST_ROWS = 30_000  # Of an episode that a check looks at.


@dataclass(frozen=True)
class Finding:
    """severity: "info", "warning" (a fit may mislead) or "error" (it will)."""

    kind: str
    recording: str
    channel: str
    size: float
    unit: str
    severity: str
    says: str  # One English sentence.
    of: tuple[tuple[str, float], ...] = ()  # (channel, its size), where it has many.


@dataclass(frozen=True)
class JointFacts:
    """What a scene knows of a joint; limits are infinite where there are none."""

    prismatic: bool = False
    lower: float = -np.inf  # [rad] or [m]
    upper: float = np.inf
    effort_limit: float = np.inf  # [N m] or [N]
    driven: bool = False  # It has an actuator.


@dataclass(frozen=True)
class SceneFacts:
    """What the checks need of a scene; gap/data/scene_facts.py takes it from a plant.

    gravity: [m/s2], its size. free: `<model>.<body>` of bodies that nothing holds.
    torques(q, v, a): for {joint: value}, ({joint: gravity torque}, {joint: inertial
    torque}) [N m]; None if unknown.
    """

    joints: Mapping[str, JointFacts] = field(default_factory=dict)
    free: frozenset[str] = frozenset()
    gravity: float = G
    torques: Callable | None = None


def some_episodes(recording: Recording, most: int = _MOST_EPISODES) -> list[Episode]:
    """All episodes, or evenly spread ones; the first rows of very long ones."""
    episodes = recording.episodes
    if len(episodes) > most:
        pick = np.linspace(0, len(episodes) - 1, most).astype(int)
        episodes = tuple(episodes[i] for i in pick)
    return [
        Episode(e.number, e.first, min(e.last, e.first + _MOST_ROWS), e.stretch)
        for e in episodes
    ]


def complete_rows(recording: Recording, values: np.ndarray, episode: Episode):
    """Times and rows of an episode in which nothing is missing."""
    there = ~np.isnan(values[episode.rows]).any(axis=1)
    return recording.time[episode.rows][there], values[episode.rows][there]


def longest_sec(recording: Recording) -> float:
    t = recording.time
    return max(float(t[e.last - 1] - t[e.first]) for e in recording.episodes)

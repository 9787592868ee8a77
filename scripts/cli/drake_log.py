"""What Drake says while a command runs: once, after what the command has to say."""

import logging
import re
import sys

from makebreak.gap.data.findings import Finding

# Of a model that lacks it the motion is another one, whatever else Drake can do.
_PHYSICS = re.compile(
    r"armature|coulomb|damping|density|equality|frictionloss|friction|gear|gravcomp|"
    r"gravity|inertia|limit|mass\b|mimic|rotor|solref|solimp|springref|stiffness|"
    r"tendon|transmission",
    re.IGNORECASE,
)
_PLACE = re.compile(r"^(\S+?:\d+(:\d+)?:\s*)?((warning|error):\s*)?", re.IGNORECASE)


# Said of each plane of a MJCF file, of contacts that scenes do not have.
_IDLE = "half spaces are not currently supported for deformable contact"


class DrakeLog(logging.Handler):
    """Keeps Drake's warnings and errors back, for a `with`; alike ones are one line
    with a count. Two are alike that differ in numbers and paths.

    (pydrake sends all that Drake logs to Python's logger "drake"; processes that are
    copied keep theirs to themselves.)
    """

    def __init__(self):
        super().__init__(logging.WARNING)
        self._found: dict[str, list[str]] = {}

    def emit(self, record: logging.LogRecord) -> None:
        text = " ".join(record.getMessage().split())
        said = _PLACE.sub("", text)
        alike = re.sub(r"\S*/\S*|\d+(\.\d+)?", "#", said)
        self._found.setdefault(alike, []).append(text)

    def lines(self) -> list[str]:
        """A line for each kind of message that changes no physics."""
        return [
            self._line(found)
            for found in self._found.values()
            if not _is_physics(found) and _IDLE not in found[0]
        ]

    def findings(self, recording: str) -> list[Finding]:
        """A warning for each kind of message that names what changes the motion."""
        return [
            Finding(
                "model_file", recording, "model", float(len(set(found))), "messages",
                "warning", f"Drake says of the model: {self._line(found)}",
            )
            for found in self._found.values()
            if _is_physics(found)
        ]  # fmt: skip

    @staticmethod
    def _line(found: list[str]) -> str:
        places = len(set(found))  # A model that is loaded again says it again.
        more = "" if places == 1 else f" (and {places - 1} alike)"
        return found[0] + more

    def __enter__(self) -> "DrakeLog":
        self._log = logging.getLogger("drake")
        self._propagates = self._log.propagate
        self._others = self._log.handlers[:]
        self._log.handlers[:] = [self]
        self._log.propagate = False
        return self

    def __exit__(self, kind, *_) -> None:
        self._log.handlers[:] = self._others
        self._log.propagate = self._propagates
        if kind is not None:  # It may be why.
            self.show()

    def show(self) -> None:
        """Prints lines() beside what the command prints."""
        for line in self.lines():
            print(f"Drake: {line}", file=sys.stderr)


def _is_physics(found: list[str]) -> bool:
    return bool(_PHYSICS.search(_PLACE.sub("", found[0])))

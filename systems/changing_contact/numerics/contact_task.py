"""What the changing-contact systems tell each other: layouts of their vectors, and the
belief about contacts.

Vectors, so that they can be logged and replayed; counters, so that an event is seen by
a reader of any rate and never twice. Wrenches are force first, on the tool, in world
axes. A force direction n is a unit vector along which the tool presses: into the
surface.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

# --- phase (6,): where the motion is, from the velocity shaper.
N_PHASE = 6
PHASE_SEGMENT, PHASE_STAGE, PHASE_KIND, PHASE_SPEED, PHASE_LENGTH, PHASE_STATUS = range(
    N_PHASE
)
# Stages. MOVE: the base controller. ENTER: it is blended into the transition-phase
# controller, before the region. REGION: inside. SETTLE: after the contact, blended
# back. DONE: at the end of the motion. HOLD: stopped, see the status.
MOVE, ENTER, REGION, SETTLE, DONE, HOLD = range(6)
# Kinds of contact change.
NO_CONTACT, IMPACT, IMPACTLESS = range(3)
# Status, a sum.
REGION_COVERS_PATH, CONTACT_MISSING, CONTACT_UNEXPECTED, SPEED_FLOOR, BAD_INPUT = (
    1,
    2,
    4,
    8,
    16,
)

# --- contact (14,): what the contact detector has felt so far.
N_CONTACT = 14
MADE, BROKEN, MEASURED = range(3)  # Counts: made, broken, peak forces measured.
TIME = 3  # Of the last contact made, its first sample [s].
POSITION = slice(4, 7)  # p_WE there [m].
DIRECTION = slice(7, 10)  # Of the motion into it, a unit vector.
SPEED = 10  # Along it, just before [m/s].
PEAK_FORCE = 11  # F_m: its peak along it, friction taken off [N]; 0 until MEASURED.
BROKEN_ROW = 12  # Which row of force_directions was lost last, 0 or 1.
STATUS = 13  # 0, or 1: the wrench is not to be used (NaN, stuck, or at its limit).

# --- transition (6,): mode changes, from the mode detector.
N_TRANSITION = 6
COUNT, CHANGE_TIME, FROM_MODE, TO_MODE, IS_NEW, DECIDED_TIME = range(N_TRANSITION)

# --- touch_mode (2,): of touches, from the mode detector.
N_TOUCH_MODE = 2
FOUND, TOUCH_MODE = range(
    N_TOUCH_MODE
)  # Of how many it found the mode; the last one's.

# --- modes. Clusters are numbered from 1.
UNKNOWN_MODE, FREE_MODE = -1, 0


@dataclass(frozen=True, eq=False)
class ExpectedContact:
    """A contact change that is expected, and what is known of it."""

    mean: np.ndarray  # (3,) p_WE at the change [m].
    covariance: np.ndarray  # (3, 3) [m2]
    direction: np.ndarray  # (3,) of the motion into it, a unit vector.
    kind: int = IMPACT
    segment: int = 0  # Of the motion pattern in which it happens.
    approach_speed: float = 0.05  # [m/s]; without meaning for IMPACTLESS.
    seen: int = 0  # How often it has been felt.
    # (n, 2) [m/s, N]: speeds of approach and the peak forces that they gave.
    impacts: np.ndarray = None  # type: ignore[assignment]
    from_mode: int = UNKNOWN_MODE  # Of an IMPACTLESS change.
    to_mode: int = UNKNOWN_MODE
    # An impact from which the position of this one follows, as where both surfaces
    # belong to bodies of known sizes: (its segment, the distance from it along
    # `direction` [m], the standard deviation of that distance [m]). Empty: none.
    known_from: tuple[float, ...] = ()

    def __post_init__(self):
        if self.impacts is None:
            object.__setattr__(self, "impacts", np.zeros((0, 2)))
        shapes: dict[str, tuple[int, ...]] = {
            "mean": (3,),
            "covariance": (3, 3),
            "direction": (3,),
        }
        shapes["impacts"] = (len(self.impacts), 2)
        for name, shape in shapes.items():
            value: np.ndarray = np.array(getattr(self, name), dtype=float).ravel()
            if value.size != np.prod(shape) or not np.all(np.isfinite(value)):
                raise ValueError(
                    f"expected contact: {name} is {getattr(self, name)}, expected "
                    f"finite numbers of shape {shape}"
                )
            value = value.reshape(shape)
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        known = np.array(self.known_from, dtype=float).ravel()
        if known.size not in (0, 3) or not (np.isfinite(known).all()):
            raise ValueError(
                f"expected contact: known_from is {self.known_from}, expected none or "
                "three numbers: segment, distance, standard deviation"
            )
        object.__setattr__(self, "known_from", tuple(known.tolist()))
        C = self.covariance
        if abs(C - C.T).max() > 1e-9 * max(abs(C).max(), 1e-12) or not np.all(
            np.linalg.eigvalsh(C) > 0.0
        ):
            raise ValueError(
                f"expected contact: covariance is {C.tolist()}, expected a symmetric "
                "positive definite matrix"
            )
        if not abs(np.linalg.norm(self.direction) - 1.0) < 1e-6:
            raise ValueError(
                f"expected contact: direction is {self.direction}, expected a unit "
                "vector"
            )


@dataclass(frozen=True, eq=False)
class ContactBelief:
    """All expected contacts: the value of the anticipator's port `contacts`."""

    contacts: tuple[ExpectedContact, ...] = ()

    def __copy__(self):  # Drake clones abstract state; this never changes.
        return self

    def __deepcopy__(self, _):
        return self

    def changed(self, index: int, **changes) -> "ContactBelief":
        """The same with some fields of contact `index` replaced."""
        contacts = list(self.contacts)
        contacts[index] = replace(contacts[index], **changes)
        return ContactBelief(tuple(contacts))

    def save(self, path: str | Path) -> None:
        """Writes it as JSON."""
        rows = [
            {
                name: value.tolist() if isinstance(value, np.ndarray) else value
                for name, value in vars(contact).items()
            }
            for contact in self.contacts
        ]
        Path(path).write_text(json.dumps({"contacts": rows}, indent=2) + "\n")

    @staticmethod
    def load(path: str | Path) -> "ContactBelief":
        """What `save` wrote.

        Raises: ValueError if the file is missing or is not a belief.
        """
        try:
            rows = json.loads(Path(path).read_text())["contacts"]
            return ContactBelief(tuple(ExpectedContact(**row) for row in rows))
        except (OSError, KeyError, TypeError, json.JSONDecodeError) as error:
            raise ValueError(
                f"contact belief {path}: {' '.join(str(error).split())}"
            ) from None

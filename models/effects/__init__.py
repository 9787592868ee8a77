"""The catalogue of physical effects that a scene can have.

Each family of kinds has a file; a new kind is one entry of its family's KINDS.
"""

import makebreak.systems.numerics.code_cache  # noqa: F401  (before its functions)
from makebreak.models.effects import (
    actuation,
    contact,
    forces,
    ground,
    joints,
    links,
    loads,
    measurement,
    objects,
    transmission,
)
from makebreak.models.effects.kind import EffectKind

KINDS: dict[str, EffectKind] = {
    name: kind
    for family in (
        joints,
        transmission,
        loads,
        links,
        actuation,
        measurement,
        forces,
        objects,
        contact,
        ground,
    )
    for name, kind in family.KINDS.items()
}

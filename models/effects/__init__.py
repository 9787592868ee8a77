"""The catalogue of physical effects that a scene can have.

One file a family; a new kind is one entry of its family's KINDS.
"""

from makebreak.models.effects import contact, objects
from makebreak.models.effects.kind import EffectKind

KINDS: dict[str, EffectKind] = objects.KINDS | contact.KINDS

"""Words that sentences and tables of a result share."""

from collections.abc import Sequence

from makebreak.gap.result import NamedEffect
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect

MANY_ALIKE = 4  # Joints with an effect of one kind, of which one sentence tells.


def figure(x: float, digits: int = 3) -> str:
    """So many digits of x, in full: 3700 and not 3.7e+03."""
    return f"{float(f'{x:.{digits}g}'):g}"


def called(effect: Effect) -> str:
    """Kind and place, as a report has them."""
    return f"{effect.kind} at {', '.join(effect.at)}"


def said_together(
    effects: Sequence[NamedEffect],
) -> list[tuple[str, list[NamedEffect]]]:
    """A sentence for each effect, and one for many joints that have the same kind, of
    one parameter, in one direction and without ties; with whom it is of."""
    groups: dict[object, list[NamedEffect]] = {}
    for k, each in enumerate(effects):
        key: object = k
        if KINDS[each.kind].at in ("joint", "actuator", "drive") and not (
            each.indistinguishable_from
        ):
            values = [(p.unit, p.value < 0.0) for p in each.parameters.values()]
            key = (each.kind, *values) if len(values) == 1 else k
        groups.setdefault(key, []).append(each)
    found = []
    for same in groups.values():
        if len(same) < MANY_ALIKE:
            found += [(each.says, [each]) for each in same]
        else:
            found.append((_of_each(same), same))
    return found


def _of_each(same: Sequence[NamedEffect]) -> str:
    """One sentence of effects of a kind with one parameter, with the range of it."""
    kind = KINDS[same[0].kind]
    ((name, first),) = same[0].parameters.items()
    sizes = [abs(p.value) for each in same for p in each.parameters.values()]
    n = sum(len(each.at) for each in same)
    is_less = bool(kind.says_less) and first.value < 0.0
    values = f"{figure(min(sizes))} to {figure(max(sizes))} {first.unit}".rstrip()
    words = {"at": f"each of {n} joints", name: values}
    said = (kind.says_less if is_less else kind.says).format(**words)
    return f"{said[:1].upper()}{said[1:]}."

"""When a run is a success: each condition by name, with its value and its bound."""

from collections.abc import Mapping

from makebreak.scripts.table import format_cell
from makebreak.systems.changing_contact.numerics.contact_task import DONE, HOLD


class Criteria:
    """The conditions of an experiment's success, for result.json and for the reader.

    `result()` has, for each, met_<key>: True or False; `success`: whether all are met;
    `criteria`: a line of text for each.
    """

    def __init__(self):
        self._met: dict[str, bool] = {}
        self._lines: list[str] = []

    def at_most(self, key: str, what: str, value, bound: float, unit: str = "") -> None:
        """A number that is to be at most `bound`; NaN and None are not."""
        met = value is not None and bool(value <= bound)
        self._add(key, met, what, value, f"at most {bound:.4g}", unit)

    def at_least(
        self, key: str, what: str, value, bound: float, unit: str = ""
    ) -> None:
        """A number that is to be at least `bound`; NaN and None are not."""
        met = value is not None and bool(value >= bound)
        self._add(key, met, what, value, f"at least {bound:.4g}", unit)

    def holds(self, key: str, what: str, met, value="", wanted: str = "yes") -> None:
        """A condition of another kind."""
        self._add(key, bool(met), what, bool(met) if value == "" else value, wanted, "")

    def _add(self, key, met, what, value, wanted, unit) -> None:
        shown = format_cell(value) + f" {unit}".rstrip()
        if unit and format_cell(value) == "-":
            shown = "-"  # There is none.
        line = f"{what}: {shown}, wanted {wanted} {unit}".rstrip()
        self._met[f"met_{key}"] = met
        self._lines.append(f"{'met   ' if met else 'MISSED'}  {line}")

    def result(self) -> dict:
        """What is added to the result; without any condition there is no success."""
        success = bool(self._met) and all(self._met.values())
        return {"success": success} | self._met | {"criteria": list(self._lines)}


def told(result: Mapping) -> str:
    """What is printed at the end of a run: whether it succeeded, and why not."""
    lines = result.get("criteria") or []
    missed = sum(line.startswith("MISSED") for line in lines)
    says = "yes" if result["success"] else "no"
    if missed:
        says += f": {missed} of {len(lines)} criteria missed"
    return "\n".join([f"success: {says}", *(f"  {line}" for line in lines)])


def motion_ended(stage: float) -> str:
    """Why a motion of the velocity shaper is over, by its stage; empty: it is not."""
    if stage == DONE:
        return "the motion is complete"
    if stage == HOLD:
        return "the motion is held: what it is steered by is missing or failed"
    return ""

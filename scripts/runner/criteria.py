"""Success criteria of a run: each has a name, a value and a bound."""

import math
from collections.abc import Mapping

from makebreak.scripts.runner.table import format_cell
from makebreak.systems.changing_contact.numerics.contact_task import DONE, HOLD


class Criteria:
    """Collects the success criteria of a run, for result.json and the terminal.

    `result()` has met_<key> (a bool) for each of them, `success`, whether all are met,
    and `criteria`, a line of text for each.
    """

    def __init__(self):
        self._met: dict[str, bool] = {}
        self._lines: list[str] = []

    def at_most(self, key: str, what: str, value, bound: float, unit: str = "") -> None:
        """Adds the criterion value <= bound, which NaN and None do not meet."""
        met = value is not None and bool(value <= bound)
        self._add(key, met, what, value, f"at most {bound:.4g}", unit)

    def at_least(
        self, key: str, what: str, value, bound: float, unit: str = ""
    ) -> None:
        """Adds the criterion value >= bound, which NaN and None do not meet."""
        met = value is not None and bool(value >= bound)
        self._add(key, met, what, value, f"at least {bound:.4g}", unit)

    def holds(self, key: str, what: str, met, value="", wanted: str = "yes") -> None:
        """Adds a criterion that is true or false."""
        self._add(key, bool(met), what, bool(met) if value == "" else value, wanted, "")

    def _add(self, key, met, what, value, wanted, unit) -> None:
        shown = format_cell(value) + f" {unit}".rstrip()
        if value is None or (isinstance(value, float) and math.isnan(value)):
            shown = "not measured"
        line = f"{what}: {shown}, wanted {wanted} {unit}".rstrip()
        self._met[f"met_{key}"] = met
        self._lines.append(f"{'met   ' if met else 'MISSED'}  {line}")

    def result(self) -> dict:
        """The entries for result.json; a run without criteria is not a success."""
        success = bool(self._met) and all(self._met.values())
        return {"success": success} | self._met | {"criteria": list(self._lines)}


def success_text(result: Mapping) -> str:
    """The lines printed at the end of a run: success, and each criterion."""
    lines = result.get("criteria") or []
    missed = sum(line.startswith("MISSED") for line in lines)
    answer = "yes" if result["success"] else "no"
    if missed:
        answer += f": {missed} of {len(lines)} criteria missed"
    return "\n".join([f"success: {answer}", *(f"  {line}" for line in lines)])


def motion_ended(stage: float) -> str:
    """Why a motion ends, by the velocity shaper's stage; empty if it goes on."""
    if stage == DONE:
        return "the motion is complete"
    if stage == HOLD:
        return "the motion is held: what it is steered by is missing or failed"
    return ""

"""What a result says in lines of text, for the command line and the page."""

from collections.abc import Sequence, Set

import numpy as np

from makebreak.gap.data.findings import Finding
from makebreak.gap.result import Estimate, Evidence, GapResult, NamedEffect
from makebreak.gap.said import said_together
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, sentence

HEADINGS = {  # Of each verdict, and its colour on the page.
    "no_gap": ("No gap", "#2f855a"),
    "not_judged": ("Not every channel judged", "#b7791f"),
    "gap_named": ("Gap named", "#2b6cb0"),
    "ambiguous": ("Gap named, with a tie", "#b7791f"),
    "gap_unnamed": ("Gap found, not explained", "#c53030"),
}
LEAST_GAP = 0.05  # Of the noise floor: less above it, and its share is noise.


def heading_of(result: GapResult) -> tuple[str, str]:
    """The verdict in words, and its colour on the page."""
    heading, colour = HEADINGS[result.verdict]
    if not result.unfinished:
        return heading, colour
    if not np.isfinite(result.gap.before):
        return "Unfinished: nothing compared", colour
    so_far = {"not_judged": "no gap so far", "gap_unnamed": "gap not explained so far"}
    return f"Unfinished: {so_far.get(result.verdict, 'gap named so far')}", colour


def summary_lines(result: GapResult) -> list[str]:
    """The end of the command line's run: the verdict, and a line for each effect."""
    lines = [f"{heading_of(result)[0]}: {result.says}"]
    lines += [f"  Doubtful data: {each}" for each, _ in doubts(result)]
    for said, _ in said_together(result.effects):
        if said not in result.says:
            lines.append(f"  {said}")
    for each in result.effects:
        for other in each.indistinguishable_from:
            lines.append(f"    or: {says_of(other, each.sliding)}")
        if each.tell_apart:
            lines.append(f"    to distinguish them: {each.tell_apart}")
    for none in result.tried:
        if none.why not in result.says:
            lines.append(f"  Tried, not confirmed: {none.says} {none.why}")
    return lines


def not_told(each: NamedEffect, says: str) -> dict[str, Estimate]:
    """The parameters of an effect whose values are not in what a result says."""
    told = each.says if each.says in says else ""
    return {name: p for name, p in each.parameters.items() if p.text() not in told}


def doubts(result: GapResult) -> list[tuple[str, list[str]]]:
    """What the checks found that no fit can be trusted with, and where."""
    return together([c for c in result.checks if c.severity == "error"])


def together(findings: Sequence[Finding]) -> list[tuple[str, list[str]]]:
    """A sentence for each kind and channel, and the recordings that it is true of;
    that of the largest of them, where sizes differ."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for each in findings:
        groups.setdefault((each.kind, each.channel), []).append(each)
    return [
        (
            max(found, key=lambda f: abs(f.size)).says,
            list(dict.fromkeys(f.recording for f in found)),
        )
        for found in groups.values()
    ]


def next_best(evidence: Evidence) -> str:
    """The best other explanation and its error, beside that of the effect."""
    if not evidence.runner_up or not np.isfinite(evidence.margin):
        return evidence.runner_up
    percent = round(100.0 * abs(evidence.margin))
    if percent == 0:
        why = evidence.why or "the data do not prefer it"
        return f"{evidence.runner_up}, the same error: {why}"
    if evidence.margin > 0.0:
        return f"{evidence.runner_up}, error {percent} % larger"
    why = f", and {evidence.why}" if evidence.why else ""
    return (
        f"{evidence.runner_up}, error {percent} % smaller: too little to prefer it{why}"
    )


def windows_of(result: GapResult) -> str:
    """What the gap was measured over; a length of 0: nothing had to be simulated."""
    seconds = result.gap.window_s
    return f"simulated windows of {number(seconds)} s" if seconds > 0.0 else "samples"


def says_of(effect: Effect, sliding: Set[str] = frozenset()) -> str:
    """The sentence of an effect without deviations. sliding: joints that slide."""
    slides = bool(effect.at) and sliding >= {*effect.at}
    return sentence(effect, KINDS[effect.kind], slides=slides)


def closed_share(before: float, after: float, floor: float) -> str:
    """How much of the gap is closed, in percent; "" where there was hardly any."""
    above = before - floor
    if not (np.isfinite(above) and np.isfinite(after)) or above <= LEAST_GAP * floor:
        return ""
    return f"{100.0 * max(min((before - after) / above, 1.0), 0.0):.0f} %"


def number(value: float | None, digits: int = 3) -> str:
    """So many digits, or "-" where it is not known."""
    if value is None or not np.isfinite(value):
        return "-"
    return f"{value:.{digits}g}"

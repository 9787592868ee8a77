"""The report as one HTML page: its first screen, and the sections below it."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from makebreak.gap.data.recording import Recording
from makebreak.gap.report import sections
from makebreak.gap.report.interactive import shown_series
from makebreak.gap.report.markup import STYLE, headline, image, sentence_html
from makebreak.gap.report.summary import (
    closed_share,
    doubts,
    heading_of,
    next_best,
    not_told,
    number,
    says_of,
    windows_of,
)
from makebreak.gap.result import GapResult, NamedEffect, Unexplained
from makebreak.gap.said import said_together


def report_html(
    result: GapResult,
    pictures: Mapping[str, bytes],
    out: Path,
    scene_path: str | Path = "SCENE.yaml",
    recordings: Sequence[Recording] = (),
    has_comparison: bool = False,
    formats: Sequence[str] = (),
) -> str:
    """The report as one HTML page, pictures inside.

    Args: pictures: PNG files by name. out: the folder where the page will be.
        formats: in which the repaired model can be written. The others: as of
        files.write_report.
    """
    heading, _ = heading_of(result)
    first = _first_screen(result, pictures, has_comparison)
    below = [
        sections.evidence(result),
        sections.where(result, pictures, recordings),
        sections.series(result, pictures, shown_series(result.series)),
        sections.in_units(result),
        sections.trust(result, pictures),
        sections.tried(result),
        sections.considered(result),
        sections.unexplained(result),
        sections.checks(result),
        sections.background(result),
        sections.channels(result),
        sections.next_steps(
            result, out, scene_path, recordings, has_comparison, formats
        ),
        sections.seconds(result),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(heading)} - makebreak gap</title>"
        f"<style>{STYLE}</style></head>\n<body><main>\n"
        f'<section class="first">{first}</section>\n'
        + "\n".join(each for each in below if each)
        + "\n</main></body></html>\n"
    )


def _first_screen(
    result: GapResult, pictures: Mapping[str, bytes], has_comparison: bool
) -> str:
    """The verdict, its effects, and how much of the gap they close."""
    heading, colour = heading_of(result)
    says = "Held-out error of each channel, before and after"
    parts = [
        f'<p class="badge" style="background:{colour}">{escape(heading)}</p>',
        headline(result.says),
        _doubts(result),
        '<div class="two"><div>',
        *[_effects(*each, result) for each in said_together(result.effects)],
        _no_effect(result) if not result.effects else "",
        "</div><div>",
        _numbers(result),
        image(pictures, "channels", says),
        _MOVING if has_comparison else "",
        "</div></div>",
    ]
    return "".join(parts)


# The animation without its controls: comparison.py knows `#small`.
_MOVING = (
    '<iframe src="compare.html#small" title="Measured (grey), before (orange), after '
    '(blue)"></iframe><p class="small"><a href="compare.html">The animation</a>: '
    "measured (grey), before (orange), after (blue).</p>"
)


def _doubts(result: GapResult) -> str:
    found = doubts(result)
    if not found:
        return ""
    items = "".join(f"<li>{sentence_html(says)}</li>" for says, _ in found[:4])
    return (
        '<div class="doubt"><b>Correct the data first:</b> the result depends on '
        f"them.<ul>{items}</ul></div>"
    )


def _effects(said: str, same: Sequence[NamedEffect], result: GapResult) -> str:
    """Of effects that one sentence tells what the headline has not told."""
    kind, at, rows = same[0].kind, "", ""
    if len(same) == 1:
        at = f" at {', '.join(same[0].at)}"
    for each in same:
        for name, p in not_told(each, result.says).items():
            of = name if len(same) == 1 else ", ".join(each.at)
            value = f"<td class=n>{sentence_html(p.text())}</td><td>{escape(p.unit)}"
            rows += f"<tr><td>{escape(of)}</td>{value}</td></tr>"
    others = dict.fromkeys(filter(None, (next_best(e.evidence) for e in same)))
    sure = f"Next best: {escape('; '.join(others))}." if others else ""
    for state, words in _HARDLY.items():
        if places := [", ".join(e.at) for e in same if e.identifiable == state]:
            sure += f" {words} from these data"
            sure += f": {escape('; '.join(places))}." if len(same) > 1 else "."
    title = "" if said in result.says else f"<h3>{sentence_html(said)}</h3>"
    return (
        f'<div class="effect">{title}<p class="kind">{escape(kind + at)}</p>'
        f"<table>{rows}</table><p>{sure}</p>{_ties(same[0])}</div>"
    )


_HARDLY = {"weak": "Only weakly identifiable", "not": "Not identifiable"}


def _ties(each: NamedEffect) -> str:
    if not each.indistinguishable_from:
        return ""
    others = "".join(
        f"<li>{sentence_html(says_of(other, each.sliding))}</li>"
        for other in each.indistinguishable_from
    )
    tell = f"<p><b>To distinguish them:</b> {sentence_html(each.tell_apart)}</p>"
    return (
        '<div class="tie"><b>These data cannot distinguish it from:</b>'
        f"<ul>{others}</ul>{tell if each.tell_apart else ''}</div>"
    )


def _no_effect(result: GapResult) -> str:
    if result.unfinished:
        says = "The run ended before all was tried: nothing was added to the scene."
    elif result.verdict == "no_gap":
        says = "The model explains the recording to within its noise and the stated "
        says += "tolerance of the model. Nothing was added to the scene."
    elif result.verdict == "not_judged":
        says = "The channels that were compared agree, to within their noise and the "
        says += "stated tolerance of the model. Some channels were not compared "
        says += "(below). Nothing was added to the scene."
    else:
        says = "No effect of the catalogue explains the remaining error, so none is "
        says += "named and the scene is unchanged. Where the error is, and what it "
        says += "correlates with:"
    items = "".join(
        f"<li>{escape(_left(each))}</li>" for each in result.unexplained[:4]
    )
    return f'<div class="effect"><p>{says}</p><ul>{items}</ul></div>'


def _left(each: Unexplained) -> str:
    text = f"{each.channel}, {each.region}: {each.size:.3g} times the expected error"
    return text + (
        f"; correlates with {each.correlates_with}" if each.correlates_with else ""
    )


def _numbers(result: GapResult) -> str:
    g = result.gap
    closed = closed_share(g.before, g.after, g.noise_floor)
    cells = [("before", number(g.before)), ("after", number(g.after))]
    if closed and result.effects:
        cells.append(("of the gap closed", closed))
    elif g.in_equations and result.effects:
        closed = closed_share(*g.in_equations, g.noise_floor)
        if closed:
            cells.append(("closed in the equations of motion", closed))
    shown = "".join(
        f"<div><b>{value}</b><span>{name}</span></div>" for name, value in cells
    )
    seen = {
        "reported": " used neither to fit nor to select",
        "chosen on": " used to select effects: no data were left for a final test",
    }.get(g.data, ": nothing could be held out")
    if g.n_windows and any(g.failed):
        seen += (
            f"; {g.failed[0]} before and {g.failed[1]} after of {g.n_windows} could "
            "not be simulated to their end and count in neither"
        )
    return (
        f'<div class="numbers">{shown}</div><p class="small">Held-out error in units '
        "of the expected error, which sensor noise and the uncertain start of a window "
        f"leave with a perfect model; rms over {windows_of(result)}{seen}.</p>"
    )

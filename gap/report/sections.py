"""The sections of the report below its first screen: HTML, or "" where the result has
nothing for them. `pictures` are PNG files by name."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from shlex import quote

import numpy as np

from makebreak.gap.data.recording import Recording
from makebreak.gap.report.clock import zeros_of
from makebreak.gap.report.markup import cell, folded, image, section, table
from makebreak.gap.report.summary import number, together, windows_of
from makebreak.gap.result import GapResult, InUnits, Where, plain

_SEVERITIES = ("error", "warning", "info")
_MOST_TOLERANCES = 2.0  # Of a nuisance parameter: farther off, its model is doubtful.


def where(
    result: GapResult, pictures: Mapping[str, bytes], recordings: Sequence[Recording]
) -> str:
    """Where the disagreement stands out: a row for each channel and kind of motion."""
    if not result.where:
        return ""
    groups: dict[tuple[str, str], list[Where]] = {}
    for w in sorted(result.where, key=lambda w: -w.score):
        groups.setdefault((w.channel, w.region.split(",")[0]), []).append(w)
    rows = [
        [
            channel,
            region,
            f"{sum(w.to_s - w.from_s for w in found):.3g} s",
            f"{found[0].score:.3g}",
            f"{found[0].from_s:.2f} - {found[0].to_s:.2f} s of {found[0].recording}, "
            f"episode {found[0].episode}, {found[0].region}"
            f"{', held out' if found[0].held_out else ''}",
        ]
        for (channel, region), found in groups.items()
    ]
    heads = [
        "channel",
        "while",
        "in total",
        "largest error / expected",
        "where that is",
    ]
    clock = ""
    if any(zeros_of(recordings).values()):
        clock = " Times count from the start of a recording."
    note = (
        '<p class="small">Coloured: windows whose error is significantly larger than '
        "expected. Grey: no significant error, or nothing was measured. Underlined, "
        "and 'held out': in the part that is reported on, by simulated windows."
        f"{clock}</p>"
    )
    picture = image(pictures, "where", "Where the disagreement stands out")
    return section("Where", picture + note + table(heads, rows, most=6))


def series(result: GapResult, pictures: Mapping[str, bytes]) -> str:
    """What was measured, beside the simulation before and after."""
    if "series" not in pictures:
        return ""
    note = '<p class="small">Held-out data.'
    if result.gap.window_s > 0.0:
        note += " Each window starts from a measured state."
    note += "</p>"
    picture = image(pictures, "series", "Measured and simulated, before and after")
    return section("Measured, before, after", picture + note)


def tried(result: GapResult) -> str:
    """What was tried and is not in the scene, with its value and why."""
    if not result.tried:
        return ""
    rows = [
        [
            t.kind, ", ".join(t.at),
            ", ".join(f"{n} {p.text()} {p.unit}" for n, p in t.parameters.items()),
            t.why,
        ]
        for t in result.tried
    ]  # fmt: skip
    heads = ["kind", "at", "value", "why it is not in the scene"]
    return section("Tried, not confirmed", table(heads, rows, most=8))


def considered(result: GapResult) -> str:
    """The candidates, and what each would have left."""
    if not result.candidates:
        return ""
    heads = ("kind", "at", "score", "parameters")
    rows = [[cell(getattr(each, h)) for h in heads] for each in result.candidates]
    note = (
        '<p class="small">Each candidate alone. Score: its held-out error, as a '
        "fraction of the error without it. Of candidates with nearly the same score "
        "the one with the fewest parameters is chosen.</p>"
    )
    return section("What else was considered", note + table(heads, rows, most=8))


def unexplained(result: GapResult) -> str:
    """The error that is left, and what it goes with."""
    if not result.unexplained:
        return ""
    rows = [
        [u.channel, u.region, f"{u.size:.3g}", u.correlates_with]
        for u in sorted(result.unexplained, key=lambda u: -u.size)
    ]
    heads = ["channel", "where", "error / expected", "correlates with"]
    return section("Remaining error", table(heads, rows, most=6))


def checks(result: GapResult) -> str:
    """What was found before any fit: errors and warnings; notes are folded away."""
    if not result.checks:
        return section("Checks of the data", "<p>Nothing wrong was found.</p>")
    grave: list[tuple[str, tuple[str, list[str]]]] = []
    light: list[tuple[str, tuple[str, list[str]]]] = []
    for severity in _SEVERITIES:
        found = together([c for c in result.checks if c.severity == severity])
        (light if severity == "info" else grave).extend((severity, f) for f in found)

    def items(found):
        return "".join(
            f'<li class="{severity}">{escape(says)} <span class="small">'
            f"{escape(', '.join(where[:6]))}{', ...' if where[6:] else ''}</span></li>"
            for severity, (says, where) in found
        )

    body = f"<ul>{items(grave[:10])}</ul>" if grave else "<p>No warnings.</p>"
    if grave[10:]:
        body += folded(f"{len(grave) - 10} more", f"<ul>{items(grave[10:])}</ul>")
    if light:
        title = "1 note" if len(light) == 1 else f"{len(light)} notes"
        body += folded(title, f"<ul>{items(light)}</ul>")
    return section("Checks of the data", body)


def background(result: GapResult) -> str:
    """What the nuisance parameters moved."""
    if not result.background:
        return ""
    moved = sorted(result.background.items(), key=lambda item: -abs(item[1]))
    most = abs(moved[0][1])
    says = "What may be slightly wrong in any model: the fitted change, in units of "
    says += "its tolerance. "
    says += (
        f"The largest is {most:.2g}."
        if most <= _MOST_TOLERANCES
        else f"<b>The largest is {most:.2g}: more than the tolerance allows for.</b>"
    )
    rows = [[name, f"{value:+.2f}"] for name, value in moved]
    return section(
        "Nuisance parameters",
        f"<p>{says}</p>" + table(["term", "tolerances"], rows, most=5),
    )


def in_units(result: GapResult) -> str:
    """Held-out errors as they are: not over noise, not clipped."""
    if not result.gap.in_units:
        return ""
    body = (
        f"<p>Rms over {windows_of(result)}. Expected: what noise and the uncertain "
        "start of a window leave with a perfect model.</p>"
        + _errors(result.gap.in_units)
    )
    if result.gap.equations:
        body += (
            "<p>Residual of each equation of motion on the same data, with the "
            "nuisance parameters in both.</p>"
        )
        body += _errors(result.gap.equations)
    return section("Errors in SI units", body)


def _errors(of: Mapping[str, InUnits]) -> str:
    heads = ["channel", "before", "after", "expected", "noise of a sample"]
    rows = [
        [name, *(plain(x, e.unit) for x in (e.before, e.after, e.expected, e.noise))]
        for name, e in of.items()
    ]
    if not any(np.isfinite(e.expected) for e in of.values()):  # Equations.
        heads = [*heads[:3], "expected from noise"]
        rows = [[*row[:3], row[4]] for row in rows]
    return table(heads, rows, most=14)


def trust(result: GapResult, pictures: Mapping[str, bytes]) -> str:
    """Each parameter again, on parts of the data and from other initial values."""
    if not result.trust:
        return ""
    rows = [
        [f"{t.parameter} of {t.kind} at {', '.join(t.at)}", number(t.value),
         number(t.std, 2), _range(t.stretches), _range(t.starts), _ridge(t.ridge_with)]
        for t in result.trust
    ]  # fmt: skip
    heads = ["parameter", "value", "std", "on parts of the data",
             "from other initial values", ""]  # fmt: skip
    note = (
        '<p class="small">Each parameter fitted again on one part of the data (all '
        "others unchanged), and from other initial values.</p>"
    )
    picture = image(pictures, "trust", "Each parameter on parts of the data")
    return section(
        "How certain the parameters are", picture + note + table(heads, rows, most=12)
    )


def _range(values: Iterable[float]) -> str:
    """From the least to the largest, of those that are numbers."""
    known = [v for v in values if np.isfinite(v)]
    return f"{number(min(known))} to {number(max(known))}" if known else "-"


def _ridge(other: str) -> str:
    return f"only its sum with {other} is identifiable" if other else ""


def channels(result: GapResult) -> str:
    """How each channel was judged, and its noise."""
    if not result.channels:
        return ""
    rows = [
        [c.channel, c.judged, f"{number(c.noise)} {c.unit}", c.noise_from]
        for c in result.channels
    ]
    heads = ["channel", "judged by", "noise (std)", "noise is"]
    return section("Channels", table(heads, rows, most=8))


def next_steps(
    result: GapResult,
    out: Path,
    scene_path: str | Path,
    recordings: Sequence[Recording],
    has_comparison: bool,
) -> str:
    """Commands to go on with. Arguments: as of page.report_html."""
    scene = quote(str(out / "scene.yaml"))
    tables = " ".join(quote(str(each.path)) for each in recordings) or "RECORDING"
    again = f"makebreak gap {quote(str(scene_path))} {tables}"
    lines = []
    if result.effects and Path(scene_path).name == "model.yaml":  # Of a run.
        run = f"makebreak run EXPERIMENT --model {scene}"
        lines.append(("Run the experiment with the repaired model:", run))
    if result.effects:
        left = f"makebreak gap {scene} {tables}"
        lines.append(("Is there a gap left in the repaired model?", left))
        export = f"{again} --export urdf,mjcf"
        lines.append(("The repaired model for other simulators:", export))
    lines.append(("This comparison again:", f"{again} --out {quote(str(out))}"))
    body = "".join(
        f"<p class=small>{escape(says)}</p><pre>{escape(line)}</pre>"
        for says, line in lines
    )
    if has_comparison:
        body += '<p><a href="compare.html">compare.html</a>: an animation of the '
        body += "measured motion (grey) and of the model before and after.</p>"
    body += '<p class="small">In the same folder: result.json has all numbers, '
    body += "scene.yaml is the repaired model.</p>"
    return section("Next steps", body)


def seconds(result: GapResult) -> str:
    """What the run took."""
    if not result.seconds:
        return ""
    total = sum(result.seconds.values())
    parts = ", ".join(f"{name} {value:.1f}" for name, value in result.seconds.items())
    return f'<p class="small">Computed in {total:.0f} s: {escape(parts)}.</p>'

"""The sections of the report below its first screen: HTML, or "" where the result has
nothing for them. `pictures` are PNG files by name."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from shlex import quote

import numpy as np

from makebreak.gap.data.recording import Recording
from makebreak.gap.report.clock import zeros_of
from makebreak.gap.report.interactive import axis_of, series_html
from makebreak.gap.report.markup import bar, cell, folded, image, section, table
from makebreak.gap.report.pictures import expected_of
from makebreak.gap.report.summary import number, together, windows_of
from makebreak.gap.result import GapResult, InUnits, Series, Where, plain

_SEVERITIES = ("error", "warning", "info")
_MOST_CORRELATED = 12
_MOST_TOLERANCES = 2.0  # Of a nuisance parameter: farther off, its model is doubtful.


def evidence(result: GapResult) -> str:
    """The effects by how much larger the error is without each."""
    known = []
    for each in result.effects:
        before, after = each.evidence.held_out_before, each.evidence.held_out_after
        if np.isfinite(before) and np.isfinite(after) and after > 0.0:
            known.append((before / after, each))
    if not known:
        return ""
    known.sort(key=lambda item: -item[0])
    longest = max(known[0][0], 1.0 + 1e-9)
    rows = "".join(
        f"<tr><td>{escape(each.kind)} at {escape(', '.join(each.at))}</td>"
        f"<td>{bar(np.log(max(ratio, 1.0)) / np.log(longest))}</td>"
        f"<td class=n>{number(ratio)} times</td></tr>"
        for ratio, each in known
    )
    note = (
        '<p class="small">Error without an effect, all others being in the model, '
        "over the error with it, on the data by which effects were chosen (the error "
        "above is on data used for nothing); bars on a logarithmic scale.</p>"
    )
    title = "What each effect explains"
    return section(title, f"{note}<table class=bars>{rows}</table>")


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


def series(
    result: GapResult, pictures: Mapping[str, bytes], shown: Sequence[Series]
) -> str:
    """What was measured, beside the simulation before and after. shown: of
    interactive.shown_series."""
    if not shown:
        return ""
    note = '<p class="small">Held-out data.'
    if result.gap.window_s > 0.0:
        note += " Each window starts from a measured state."
    note += (
        " Drag to zoom, all channels together; click twice to see all. The errors are "
        "shown at the scale of those after; click on a name to hide its lines.</p>"
    )
    units = {c: u.unit for c, u in result.gap.in_units.items()}
    picture = image(pictures, "series", "Measured and simulated, before and after")
    plot = series_html(shown, units, picture)
    return section("Measured, before, after", note + plot + _worst_windows(shown))


def _worst_windows(shown: Sequence[Series]) -> str:
    """The windows with the largest error that is left, of the channels that are shown;
    a click on one shows it in the plot."""
    found: list[tuple[float, float, float, float, int, Series]] = []
    for k, each in enumerate(shown):
        cuts = [0, *sorted({int(s) for s in each.starts if s > 0}), len(each.time)]
        over = expected_of(each)
        errors = [((each.measured - x) / over) ** 2 for x in (each.after, each.before)]
        for a, b in pairwise(cuts):
            if np.isfinite(errors[0][a:b]).any():
                known = [e[a:b][np.isfinite(e[a:b])] for e in errors]
                after, before = (
                    float(np.mean(e)) ** 0.5 if len(e) else np.nan for e in known
                )
                span = float(each.time[a]), float(each.time[b - 1])
                found.append((after, before, *span, k, each))
    worst = sorted(found, key=lambda w: -w[0])[:6]
    rows = "".join(
        f"<tr><td>{escape(each.channel)}</td><td><a data-axis='{axis_of(k)}' "
        f"data-from={start} data-to={end}>{start:.2f} - {end:.2f} s</a> of "
        f"{escape(each.recording)}, episode {each.episode}</td>"
        f"<td>{number(before)}</td><td>{number(after)}</td></tr>"
        for after, before, start, end, k, each in worst
    )
    heads = "".join(
        f"<th>{each}</th>"
        for each in ("channel", "window", "error / expected, before", "after")
    )
    says = "Worst windows after"
    return f"<h3>{says}</h3><table><tr>{heads}</tr>{rows}</table>" if rows else ""


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
    body = picture + note + table(heads, rows, most=12) + _correlations(result)
    return section("How certain the parameters are", body)


def _correlations(result: GapResult) -> str:
    """Of the errors of parameters that were fitted together: a coloured table."""
    names = [f"{t.parameter} of {t.kind} at {', '.join(t.at)}" for t in result.trust]
    shown = [k for k, t in enumerate(result.trust) if t.correlation]
    shown = shown[:_MOST_CORRELATED]
    if len(shown) < 2:
        return ""
    rows = ""
    for k in shown:
        cells = ""
        for j in shown:
            value = result.trust[k].correlation.get(names[j], np.nan)
            tint = f' style="background:rgba({_tint(value)})"' if value == value else ""
            text = "1" if j == k else "-"
            if value == value and j != k:
                text = f"{round(value, 2) + 0.0:.2f}"  # No minus before a zero.
            cells += f"<td class=n{tint}>{text}</td>"
        rows += f"<tr><td>{shown.index(k) + 1}. {escape(names[k])}</td>{cells}</tr>"
    heads = "".join(f"<th>{i + 1}</th>" for i in range(len(shown)))
    note = (
        '<p class="small">Correlation of their errors: of two near 1 or -1 these data '
        "determine one combination only.</p>"
    )
    return f"{note}<table><tr><th></th>{heads}</tr>{rows}</table>"


def _tint(value: float) -> str:
    """Blue for the one sign and orange for the other, stronger the nearer to one."""
    rgb = "43,108,176" if value > 0.0 else "217,128,50"
    return f"{rgb},{0.75 * abs(value):.2f}"


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
    formats: Sequence[str],
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
        if formats:
            export = f"{again} --export {','.join(formats)}"
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

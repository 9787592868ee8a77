"""The files of a gap run: result.json, scene.yaml, report.html and its pictures."""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from io import BytesIO
from pathlib import Path
from shlex import quote

import numpy as np
from matplotlib.figure import Figure

from makebreak.gap.data.findings import Finding
from makebreak.gap.data.recording import Recording
from makebreak.gap.report.clock import zero_of
from makebreak.gap.report.pictures import (
    picture_of_channels,
    picture_of_series,
    picture_of_trust,
    picture_of_where,
)
from makebreak.gap.result import Evidence, GapResult, NamedEffect, Where
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, sentence, with_deviation
from makebreak.models.scene import Scene
from makebreak.models.scene_file import write_scene

_HEADINGS = {
    "no_gap": ("No gap", "#2f855a"),
    "not_judged": ("Not every channel judged", "#b7791f"),
    "gap_named": ("Gap named", "#2b6cb0"),
    "ambiguous": ("Gap named, with a tie", "#b7791f"),
    "gap_unnamed": ("Gap found, not explained", "#c53030"),
}
_MOST_ROWS = 12  # Of a table, before the rest is folded away.
_SEVERITIES = ("error", "warning", "info")


def write_report(
    result: GapResult,
    scene: Scene,
    out_dir: str | Path,
    recordings: Sequence[Recording] = (),
    scene_path: str | Path = "SCENE.yaml",
    comparison: str | None = None,
    place: str | Path | None = None,
) -> list[Path]:
    """Writes the run's files into `out_dir`, which is made if it is missing.

    Args:
        scene: as it came; scene.yaml is this one with the effects added.
        recordings: what was looked at: for the heat map's axis, and commands to go on.
        scene_path: as the user gave it, for these commands.
        comparison: the text of compare.html, if there is one.
        place: the folder where the files will be in the end; None: out_dir.
    Returns: the files, report.html last.
    Raises: ValueError where they cannot be written.
    """
    out, place = Path(out_dir), Path(out_dir if place is None else place)
    zeros = zeros_of(recordings)
    shown = from_zero(result, zeros)
    pictures = {
        "channels": picture_of_channels(result) if result.gap.per_channel else None,
        "where": picture_of_where(shown, extents_of(recordings)),
        "series": picture_of_series(shown.series),
        "trust": picture_of_trust(result),
    }
    drawn = {name: _png(each) for name, each in pictures.items() if each is not None}
    try:
        out.mkdir(parents=True, exist_ok=True)
        files = [out / "result.json", out / "scene.yaml"]
        text = json.dumps(result.to_json(), indent=2, allow_nan=False) + "\n"
        _write(files[0], text)
        fixed = replace(scene, effects=[*scene.effects, *result.scene_effects()])
        write_scene(fixed, files[1], _scene_heading(result, scene_path), place)
        if result.effects and result.nuisance_scene:
            # The links as they were moved, too: for who trusts these data more than
            # the model. Effects come last: they change what is there.
            moved = [*scene.effects, *result.nuisance_scene, *result.scene_effects()]
            files.append(out / "scene_moved.yaml")
            write_scene(
                replace(scene, effects=moved), files[-1],
                _scene_heading(result, scene_path), place,
            )  # fmt: skip
        for name in dict.fromkeys(r for e in result.effects for r in e.recordings):
            own = [*scene.effects, *result.effects_in(name)]
            files.append(out / _scene_of(name))
            write_scene(
                replace(scene, effects=own), files[-1],
                _scene_heading(result, scene_path), place,
            )  # fmt: skip
        page = report_html(
            shown, drawn, place, scene_path, recordings, comparison is not None
        )
        _write(out / "report.html", page)
        # What would be missed least comes last, should the disk be full.
        for name, png in drawn.items():
            files.append(out / f"{name}.png")
            _write(files[-1], png)
        if comparison is not None:
            files.append(out / "compare.html")
            _write(files[-1], comparison)
    except OSError as error:
        raise ValueError(
            f'--out: got "{place}", expected a folder to write in ({error.strerror})'
        ) from error
    return [*files, out / "report.html"]


def _write(path: Path, content: str | bytes) -> None:
    """Writes the file; none is left of it where the disk is full."""
    try:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    except OSError:
        path.unlink(missing_ok=True)
        raise


def zeros_of(recordings: Sequence[Recording]) -> dict[str, float]:
    """{recording: the stamp [s] that its times are shown from}: see `zero_of`."""
    return {each.name: zero_of(float(each.time[0])) for each in recordings}


def from_zero(result: GapResult, zeros: Mapping[str, float]) -> GapResult:
    """The result with the times that a reader sees counted from `zeros`."""
    where = [
        replace(w, from_s=w.from_s - zero, to_s=w.to_s - zero)
        for w in result.where
        for zero in (zeros.get(w.recording, 0.0),)
    ]
    series = [
        replace(s, time=s.time - zeros.get(s.recording, 0.0)) for s in result.series
    ]
    return replace(result, where=where, series=series)


def extents_of(
    recordings: Sequence[Recording],
) -> dict[tuple[str, int], tuple[float, float]]:
    """{(recording, episode): (first, last time) [s] as shown}, in their order."""
    found: dict[tuple[str, int], tuple[float, float]] = {}
    for recording in recordings:
        zero = zero_of(float(recording.time[0]))
        for episode in recording.episodes:
            time = recording.time[episode.rows] - zero
            key = (recording.name, episode.number)
            low, high = found.get(key, (np.inf, -np.inf))
            found[key] = (min(low, float(time[0])), max(high, float(time[-1])))
    return found


def summary_lines(result: GapResult) -> list[str]:
    """The end of the command line's run: the verdict, and a line for each effect."""
    lines = [f"{_HEADINGS[result.verdict][0]}: {result.says}"]
    lines += [f"  Doubtful data: {each}" for each, _ in doubts(result)]
    for each in result.effects:
        if each.says not in result.says:
            lines.append(f"  {each.says}")
        for other in each.indistinguishable_from:
            lines.append(f"    or: {_says(other)}")
        if each.tell_apart:
            lines.append(f"    to distinguish them: {each.tell_apart}")
    return lines


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


def report_html(
    result: GapResult,
    pictures: Mapping[str, bytes],
    out: Path,
    scene_path: str | Path = "SCENE.yaml",
    recordings: Sequence[Recording] = (),
    has_comparison: bool = False,
) -> str:
    """The report as one HTML page, pictures inside."""
    heading, colour = _HEADINGS[result.verdict]
    first = [
        f'<p class="badge" style="background:{colour}">{escape(heading)}</p>',
        f"<h1>{_text(result.says)}</h1>",
        _doubts(result),
        '<div class="two"><div>',
        *[_effect(each, result, i) for i, each in enumerate(result.effects)],
        _no_effect(result) if not result.effects else "",
        "</div><div>",
        _numbers(result),
        _image(
            pictures, "channels", "Held-out error of each channel, before and after"
        ),
        "</div></div>",
    ]
    sections = [
        _where(result, pictures, recordings),
        _series(result, pictures),
        _in_units(result),
        _trust(result, pictures),
        _considered(result),
        _unexplained(result),
        _checks(result),
        _background(result),
        _channels(result),
        _go_on(result, out, scene_path, recordings, has_comparison),
        _seconds(result),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(heading)} - makebreak gap</title>"
        f"<style>{_STYLE}</style></head>\n<body><main>\n"
        f'<section class="first">{"".join(first)}</section>\n'
        + "\n".join(each for each in sections if each)
        + "\n</main></body></html>\n"
    )


# ----- The first screen


def _doubts(result: GapResult) -> str:
    found = doubts(result)
    if not found:
        return ""
    items = "".join(f"<li>{_text(says)}</li>" for says, _ in found[:4])
    return (
        '<div class="doubt"><b>Correct the data first:</b> the result depends on '
        f"them.<ul>{items}</ul></div>"
    )


def _effect(each: NamedEffect, result: GapResult, i: int) -> str:
    rows = ""
    for name, p in each.parameters.items():
        value = _text(with_deviation(p.value, p.std, p.or_more))
        rows += f"<tr><td>{escape(name)}</td><td class=n>{value}</td>"
        rows += f"<td>{escape(p.unit)}</td></tr>"
    other = next_best(each.evidence)
    sure = f"Next best: {escape(other)}." if other else ""
    if each.identifiable == "weak":
        sure += " It is only weakly identifiable from these data."
    elif each.identifiable == "not":
        sure += " Its parameters are not identifiable from these data."
    # Of a lone effect the headline is its sentence.
    title = ""
    if len(result.effects) > 1 or each.says not in result.says:
        number = f"{i + 1}. " if len(result.effects) > 1 else ""
        title = f"<h3>{number}{_text(each.says)}</h3>"
    return (
        f'<div class="effect">{title}<p class="kind">{escape(each.kind)} '
        f"at {escape(', '.join(each.at))}</p>"
        f"<table>{rows}</table><p>{sure}</p>{_ties(each)}</div>"
    )


def next_best(evidence: Evidence) -> str:
    """The best other explanation and its error, beside that of the effect."""
    if not evidence.runner_up or not np.isfinite(evidence.margin):
        return evidence.runner_up
    percent = round(100.0 * abs(evidence.margin))
    if percent == 0:
        return f"{evidence.runner_up}, the same error"
    if evidence.margin > 0.0:
        return f"{evidence.runner_up}, error {percent} % larger"
    return f"{evidence.runner_up}, error {percent} % smaller: too little to prefer it"


def _ties(each: NamedEffect) -> str:
    if not each.indistinguishable_from:
        return ""
    others = "".join(f"<li>{_text(_says(o))}</li>" for o in each.indistinguishable_from)
    tell = f"<p><b>To distinguish them:</b> {_text(each.tell_apart)}</p>"
    return (
        '<div class="tie"><b>These data cannot distinguish it from:</b>'
        f"<ul>{others}</ul>{tell if each.tell_apart else ''}</div>"
    )


def _no_effect(result: GapResult) -> str:
    if result.verdict == "no_gap":
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


def _left(each) -> str:
    text = f"{each.channel}, {each.region}: {each.size:.3g} times the noise"
    return text + (
        f"; correlates with {each.correlates_with}" if each.correlates_with else ""
    )


def _numbers(result: GapResult) -> str:
    g = result.gap
    closed = _share(g.before, g.after, g.noise_floor)
    cells = [("before", _n(g.before)), ("after", _n(g.after))]
    cells += [("noise floor", _n(g.noise_floor))]
    if closed and result.effects:
        cells.append(("of the gap closed", closed))
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
        f'<div class="numbers">{shown}</div><p class="small">Error over noise, rms '
        f"over {windows_of(result)}{seen}.</p>"
    )


def windows_of(result: GapResult) -> str:
    """What the gap was measured over; a length of 0: nothing had to be simulated."""
    seconds = result.gap.window_s
    return f"simulated windows of {_n(seconds)} s" if seconds > 0.0 else "samples"


# ----- Below it


def _where(result: GapResult, pictures, recordings) -> str:
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
            f"episode {found[0].episode}, {found[0].region}",
        ]
        for (channel, region), found in groups.items()
    ]
    heads = ["channel", "while", "in total", "largest error / noise", "where that is"]
    table = _table(heads, rows, most=6)
    clock = ""
    if any(zeros_of(recordings).values()):
        clock = " Times count from the start of a recording."
    note = (
        '<p class="small">Coloured: windows whose error is significantly larger than '
        f"the noise. Grey: no significant error, or nothing was measured.{clock}</p>"
    )
    picture = _image(pictures, "where", "Where the disagreement stands out")
    return _section("Where", picture + note + table)


def _series(result: GapResult, pictures) -> str:
    if "series" not in pictures:
        return ""
    note = '<p class="small">Held-out data.'
    if result.gap.window_s > 0.0:
        note += " Each window starts from a measured state."
    note += "</p>"
    image = _image(pictures, "series", "Measured and simulated, before and after")
    return _section("Measured, before, after", image + note)


def _considered(result: GapResult) -> str:
    if not result.candidates:
        return ""
    heads = ("kind", "at", "score", "parameters")
    rows = [[_cell(getattr(each, h)) for h in heads] for each in result.candidates]
    note = (
        '<p class="small">Each candidate alone. Score: its held-out error, as a '
        "fraction of the error without it. Of candidates with nearly the same score "
        "the one with the fewest parameters is chosen.</p>"
    )
    return _section("What else was considered", note + _table(heads, rows, most=8))


def _unexplained(result: GapResult) -> str:
    if not result.unexplained:
        return ""
    rows = [
        [u.channel, u.region, f"{u.size:.3g}", u.correlates_with]
        for u in sorted(result.unexplained, key=lambda u: -u.size)
    ]
    heads = ["channel", "where", "error / noise", "correlates with"]
    return _section("Remaining error", _table(heads, rows, most=6))


def _checks(result: GapResult) -> str:
    if not result.checks:
        return _section("Checks of the data", "<p>Nothing wrong was found.</p>")
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
        body += _folded(f"{len(grave) - 10} more", f"<ul>{items(grave[10:])}</ul>")
    if light:
        title = "1 note" if len(light) == 1 else f"{len(light)} notes"
        body += _folded(title, f"<ul>{items(light)}</ul>")
    return _section("Checks of the data", body)


def _background(result: GapResult) -> str:
    if not result.background:
        return ""
    moved = sorted(result.background.items(), key=lambda item: -abs(item[1]))
    most = abs(moved[0][1])
    says = "What may be slightly wrong in any model: the fitted change, in units of "
    says += "its tolerance. "
    says += (
        f"The largest is {most:.2g}."
        if most <= 2.0
        else f"<b>The largest is {most:.2g}: more than the tolerance allows for.</b>"
    )
    rows = [[name, f"{value:+.2f}"] for name, value in moved]
    return _section(
        "Nuisance parameters",
        f"<p>{says}</p>" + _table(["term", "tolerances"], rows, most=5),
    )


def _in_units(result: GapResult) -> str:
    """Held-out errors as they are: not over noise, not clipped."""
    rows = [
        [name, e.unit, _n(e.before), _n(e.after), _n(e.noise)]
        for name, e in result.gap.in_units.items()
    ]
    heads = ["channel", "unit", "before", "after", "noise"]
    if not rows:
        return ""
    body = f"<p>Rms over {windows_of(result)}.</p>" + _table(heads, rows, most=14)
    rows = [
        [name, e.unit, _n(e.before), _n(e.after), _n(e.noise)]
        for name, e in result.gap.equations.items()
    ]
    if rows:
        body += (
            "<p>Residual of each joint's equation of motion on the same data, with the "
            "nuisance parameters fitted in both.</p>"
        )
        body += _table(heads, rows, most=14)
    return _section("Errors in SI units", body)


def _trust(result: GapResult, pictures) -> str:
    if not result.trust:
        return ""
    rows = []
    for t in result.trust:
        parts = [v for v in t.stretches if np.isfinite(v)]
        spread = f"{_n(min(parts))} to {_n(max(parts))}" if parts else "-"
        starts = [v for v in t.starts if np.isfinite(v)]
        rows.append(
            [f"{t.parameter} of {t.kind} at {', '.join(t.at)}", _n(t.value),
             _n(t.std, 2), spread,
             f"{_n(min(starts))} to {_n(max(starts))}" if starts else "-",
             _ridge(t.ridge_with)]
        )  # fmt: skip
    heads = ["parameter", "value", "std", "on parts of the data",
             "from other initial values", ""]  # fmt: skip
    note = (
        '<p class="small">Each parameter fitted again on one part of the data (all '
        "others unchanged), and from other initial values.</p>"
    )
    picture = _image(pictures, "trust", "Each parameter on parts of the data")
    return _section(
        "How certain the parameters are", picture + note + _table(heads, rows, most=12)
    )


def _ridge(other: str) -> str:
    return f"only its sum with {other} is identifiable" if other else ""


def _channels(result: GapResult) -> str:
    if not result.channels:
        return ""
    rows = [
        [c.channel, c.judged, f"{_n(c.noise)} {c.unit}", c.noise_from]
        for c in result.channels
    ]
    heads = ["channel", "judged by", "noise (std)", "noise is"]
    return _section("Channels", _table(heads, rows, most=8))


def _go_on(result, out, scene_path, recordings, has_comparison) -> str:
    scene = quote(str(out / "scene.yaml"))
    tables = " ".join(quote(str(each.path)) for each in recordings) or "RECORDING"
    lines = []
    again = f"makebreak gap {quote(str(scene_path))} {tables}"
    if result.effects and Path(scene_path).name == "model.yaml":  # Of a run.
        run = f"makebreak run EXPERIMENT --model {scene}"
        lines.append(("Run the experiment with the repaired model:", run))
    if result.effects:
        lines.append(
            (
                "Is there a gap left in the repaired model?",
                f"makebreak gap {scene} {tables}",
            )
        )
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
    return _section("Next steps", body)


def _seconds(result: GapResult) -> str:
    if not result.seconds:
        return ""
    total = sum(result.seconds.values())
    parts = ", ".join(f"{name} {value:.1f}" for name, value in result.seconds.items())
    return f'<p class="small">Computed in {total:.0f} s: {escape(parts)}.</p>'


# ----- Pieces


def _scene_heading(result: GapResult, scene_path: str | Path) -> str:
    name = Path(scene_path).name
    if not result.effects:
        return f"{name}; makebreak gap added nothing to it."
    n = len(result.effects)
    what = "an effect" if n == 1 else f"{n} effects"
    return f"{name} with {what} that makebreak gap found."


def _scene_of(recording: str) -> str:
    """The file of the scene with what is in one recording only."""
    return f"scene_{re.sub(r'[^A-Za-z0-9.-]+', '_', recording)}.yaml"


def _says(effect: Effect) -> str:
    return sentence(effect, KINDS[effect.kind])


def _text(sentence: str) -> str:
    """A sentence as HTML: it begins with a capital and has a sign for +-."""
    text = escape(sentence[:1].upper() + sentence[1:]).replace("+-", "&plusmn;")
    for unit in ("N m", "kg m2", "rad/s", "N s/m"):  # A number keeps its unit.
        text = text.replace(f" {unit}", "&nbsp;" + unit.replace(" ", "&nbsp;"))
    return text


def _share(before: float, after: float, floor: float) -> str:
    above = before - floor
    if not (np.isfinite(above) and np.isfinite(after)) or above <= 0.05 * floor:
        return ""
    return f"{100.0 * max(min((before - after) / above, 1.0), 0.0):.0f} %"


def _n(value: float | None, digits: int = 3) -> str:
    if value is None or not np.isfinite(value):
        return "-"
    return f"{value:.{digits}g}"


def _cell(value) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return _n(float(value))
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_cell(v)}" for k, v in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(map(_cell, value))
    return str(value)


def _section(title: str, body: str) -> str:
    return f"<section><h2>{title}</h2>{body}</section>"


def _folded(title: str, body: str) -> str:
    return f"<details><summary>{title}</summary>{body}</details>"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], most: int) -> str:
    """The first rows; the others are folded away, and beyond 200 in result.json."""
    head = "".join(f"<th>{escape(each)}</th>" for each in heads)

    def body(some):
        return "".join(
            "<tr>" + "".join(f"<td>{escape(str(c))}</td>" for c in row) + "</tr>"
            for row in some
        )

    text = f"<table><tr>{head}</tr>{body(rows[:most])}</table>"
    rest = rows[most:200]
    if rest:
        more = f"<table><tr>{head}</tr>{body(rest)}</table>"
        text += _folded(f"{len(rows) - most} more", more)
    return text


def _png(figure: Figure) -> bytes:
    file = BytesIO()
    figure.savefig(file, format="png", dpi=110, metadata={"Software": None})
    return file.getvalue()


def _image(pictures: Mapping[str, bytes], name: str, says: str) -> str:
    if name not in pictures:
        return ""
    data = base64.b64encode(pictures[name]).decode()
    return f'<img alt="{escape(says)}" src="data:image/png;base64,{data}">'


_STYLE = """
body{font:15px/1.45 system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;
 color:#1a202c;background:#fff;margin:0}
main{max-width:1180px;margin:0 auto;padding:18px 24px 60px}
.badge{display:inline-block;color:#fff;font-weight:600;border-radius:4px;
 padding:3px 12px;margin:0}
h1{font-size:23px;line-height:1.3;margin:10px 0 14px;font-weight:600}
h2{font-size:18px;margin:34px 0 8px;border-top:1px solid #e2e8f0;padding-top:16px}
h3{font-size:16px;margin:0 0 4px}
.two{display:grid;grid-template-columns:minmax(0,1fr) minmax(0,1fr);gap:28px}
@media(max-width:800px){.two{grid-template-columns:1fr}}
.effect{border-left:3px solid #cbd5e0;padding:2px 0 2px 14px;margin-bottom:18px}
.effect p{margin:6px 0}
.kind{font-family:ui-monospace,"DejaVu Sans Mono",monospace;font-size:13px;
 color:#4a5568}
.tie{background:#fffbeb;border:1px solid #f6e05e;border-radius:4px;padding:8px 12px}
.tie ul{margin:4px 0;padding-left:20px}.tie p{margin:4px 0}
.doubt{background:#fff5f5;border:1px solid #fc8181;border-radius:4px;
 padding:8px 12px;margin:0 0 14px}.doubt ul{margin:4px 0;padding-left:20px}
.numbers{display:flex;gap:30px;margin:0 0 4px}
.numbers b{display:block;font-size:25px;line-height:1.2}
.numbers span,.small{color:#718096;font-size:13px}
img{max-width:100%;height:auto;display:block}
table{border-collapse:collapse;font-size:14px;margin:6px 0}
td,th{text-align:left;padding:3px 16px 3px 0;border-bottom:1px solid #edf2f7;
 vertical-align:top}
th{color:#718096;font-weight:500}
pre{background:#f7fafc;border:1px solid #e2e8f0;border-radius:4px;padding:8px 12px;
 margin:2px 0 10px;white-space:pre-wrap;overflow-wrap:anywhere;font-size:13px}
summary{cursor:pointer;color:#2b6cb0;font-size:14px;margin:4px 0}
li.error{color:#c53030}li.warning{color:#975a16}
"""

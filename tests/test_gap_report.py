"""The report says what the result says, in one file."""

import json
import re
from dataclasses import replace
from shutil import which

import numpy as np
import pytest
from effect_scenes import pendulum

from makebreak.gap.by_recording import _surest
from makebreak.gap.data.findings import Finding
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.report.clock import extents_of
from makebreak.gap.report.comparison import comparison_html
from makebreak.gap.report.files import write_report
from makebreak.gap.report.interactive import (
    _figure,
    _library,
    expected_of,
    shown_series,
)
from makebreak.gap.report.markup import headline, sentence_html
from makebreak.gap.report.page import _first_screen
from makebreak.gap.report.pictures import picture_of_series, picture_of_where
from makebreak.gap.report.sections import considered, evidence, series
from makebreak.gap.report.summary import next_best, summary_lines
from makebreak.gap.result import (
    Considered,
    Estimate,
    Evidence,
    GapMeasure,
    GapResult,
    NamedEffect,
    Series,
    Trust,
    Unexplained,
    Where,
)
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.verdict import says
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, sentence
from makebreak.models.scene import InitialSection, read_scene
from makebreak.models.scene_file import write_scene
from makebreak.scripts.cli.gap_command import effects_table
from makebreak.scripts.runner.browser import BROWSERS, Browser

COULOMB = Effect("joint_coulomb_friction", ["p.j1"], {"coulomb": 0.35})
VISCOUS = Effect("joint_viscous_damping", ["p.j1"], {"damping": 0.2})
CHANNELS = ("p.j1.position", "p.j1.velocity")
NOISE = (1e-3, 1e-2)
WINDOW = 0.3


def small_case(folder):
    """A pendulum with friction that its scene lacks, recorded; the paths of both."""
    scene = pendulum(folder)
    write_scene(scene, folder / "scene.yaml")
    rng = np.random.default_rng(0)
    time = np.arange(600) * 0.01
    effort = 2.5 * np.sin(3.0 * time) + 1.5 * np.sin(7.0 * time)
    commands = Commands(time, {"p.j1.effort_command": effort})
    start = InitialSection(positions={"p.j1": 0.4})
    world = SceneSimulation(replace(scene, effects=[COULOMB]))
    measured = world.run(start, time, CHANNELS, commands)
    measured += rng.normal(size=measured.shape) * NOISE
    columns = {"time": time, "p.j1.effort_command": effort}
    columns |= dict(zip(CHANNELS, measured.T, strict=True))
    write_recording(folder / "run.csv", columns)
    return folder / "scene.yaml", folder / "run.csv"


def simulated(scene, recording):
    """Every window from its measured first row, (n, 2), and the first rows."""
    simulation = SceneSimulation(scene)
    time = recording.time
    commands = Commands(time, {"p.j1.effort_command": recording["p.j1.effort_command"]})
    length = round(WINDOW / 0.01)
    starts = np.arange(0, len(time), length)
    rows = []
    for a in starts:
        position, velocity = (float(recording[c][a]) for c in CHANNELS)
        start = InitialSection({"p.j1": position}, {"p.j1": velocity})
        rows.append(simulation.run(start, time[a : a + length], CHANNELS, commands))
    return np.concatenate(rows), starts


def made_by_hand(scene_path, recording_path) -> GapResult:
    """What the workflow would find in the small case."""
    scene = read_scene(scene_path)
    [recording] = read_recordings([recording_path])
    before, starts = simulated(scene, recording)
    after, _ = simulated(replace(scene, effects=[COULOMB]), recording)
    measured = np.column_stack([recording[c] for c in CHANNELS])
    errors = [(measured - x) / NOISE for x in (before, after)]
    rms = [np.sqrt(np.mean(e**2, axis=0)) for e in errors]
    total = [float(np.sqrt(np.mean(e**2))) for e in errors]
    series = [
        Series(
            c, recording.name, 0, recording.time, measured[:, i], before[:, i],
            after[:, i], starts, NOISE[i],
        )
        for i, c in enumerate(CHANNELS)
    ]  # fmt: skip
    where = []
    for k, a in enumerate(starts):
        b = min(a + round(WINDOW / 0.01), len(recording.time)) - 1
        for i, c in enumerate(CHANNELS):
            score = float(np.sqrt(np.mean(errors[0][a : b + 1, i] ** 2)))
            if score > 3.0:
                span = recording.time[[a, b]].tolist()
                region = "reversing" if k % 2 else "moving"
                where.append(Where(c, *span, 0, recording.name, region, score))
    says = sentence(COULOMB, KINDS[COULOMB.kind], {"coulomb": 0.01})
    effect = NamedEffect(
        COULOMB.kind,
        ("p.j1",),
        {"coulomb": Estimate(0.35, 0.01, "N m")},
        says,
        Evidence(total[0], total[1], "joint_viscous_damping at p.j1", 0.62),
    )
    return GapResult(
        "gap_named",
        says,
        where,
        [effect],
        GapMeasure(
            *total, 1.2, WINDOW,
            {
                c: {"before": float(rms[0][i]), "after": float(rms[1][i])}
                for i, c in enumerate(CHANNELS)
            },
        ),
        [],
        {"mass of p.rod": 0.4, "centre of mass of p.rod, z": -0.9},
        [
            Finding("noise", "run", CHANNELS[0], 1e-3, "rad", "info", "Noise: 1 mrad."),
            Finding("lag", "run", CHANNELS[1], 4e-3, "s", "warning", "It lags 4 ms."),
        ],
        series,
        [
            Considered("joint_coulomb_friction", ("p.j1",), 0.31, {"coulomb": 0.35}),
            Considered("joint_viscous_damping", ("p.j1",), 0.52, {"damping": 0.2}),
        ],
        {"read": 0.1, "fit": 2.3},
    )  # fmt: skip


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("case")
    paths = small_case(folder)
    return (*paths, made_by_hand(*paths))


def written(case, folder, result=None, **more):
    scene_path, recording_path, made = case
    recordings = read_recordings([recording_path])
    write_report(
        result or made, read_scene(scene_path), folder, recordings, scene_path, **more
    )
    return (folder / "report.html").read_text()


def text_of(page: str) -> str:
    """What a reader sees."""
    page = re.sub(r"<(style|script)>.*?</\1>", "", page, flags=re.S)
    page = re.sub(r"<[^>]*>", " ", page)
    page = (
        page.replace("&plusmn;", "+-")
        .replace("&nbsp;", " ")
        .replace("&#x27;", "'")
        .replace("&gt;", ">")
    )
    return " ".join(page.split())


def test_the_small_case_is_one(case):
    """The hidden friction shows, and with it the model is good to the noise of the
    first row, from which its windows start."""
    gap = case[2].gap
    assert gap.before > 5.0 and 1.0 < gap.after < 3.0


def test_the_page_stands_alone_and_says_it_first(case, tmp_path):
    page = written(case, tmp_path)
    assert page.count("data:image/png;base64,") == 3
    outside = re.findall(r'(?:src|href)="(?!data:)([^"]*)"', page)
    assert outside == []
    text = text_of(page)
    first = text[: text.index(" Where ")]
    assert "joint p.j1 has Coulomb friction of 0.350 +- 0.010 N m" in first.replace(
        "Joint", "joint"
    )
    assert f"{case[2].gap.before:.3g}" in first and f"{case[2].gap.after:.3g}" in first
    assert "0.350 +- 0.010 N m" in first
    assert "Next best: joint_viscous_damping at p.j1, error 62 % larger." in first
    assert "It lags 4 ms." in text and "1 note Noise" in text
    assert f"makebreak gap {tmp_path / 'scene.yaml'} {case[1]}" in text
    assert "--export urdf,sdf,mjcf" in text
    # Only the model of a run is one that an experiment can be run with.
    assert "makebreak run" not in text
    write_report(
        case[2], read_scene(case[0]), tmp_path, scene_path=tmp_path / "model.yaml"
    )
    page = text_of((tmp_path / "report.html").read_text())
    assert f"makebreak run EXPERIMENT --model {tmp_path / 'scene.yaml'}" in page


def test_the_plot_holds_what_was_measured_and_simulated_with_breaks_between_windows(
    case,
):
    series = case[2].series
    shown = shown_series(series)
    assert {each.channel for each in shown} == set(CHANNELS)
    figure = _figure(shown, {CHANNELS[0]: "rad"})
    assert figure["layout"]["annotations"][0]["text"].startswith(shown[0].channel)
    left = [t for t in figure["data"] if t["xaxis"] == "x" and "name" in t]
    assert [t["name"] for t in left] == ["measured", "before", "after"]
    for trace in left[1:]:
        # A break before each of the twenty windows but the first.
        breaks = [i for i, y in enumerate(trace["y"]) if y is None]
        assert len(breaks) == len(trace["y"]) - len(series[0].time) == 19
        value = getattr(shown[0], trace["name"])
        y = [y for y in trace["y"] if y is not None]
        np.testing.assert_allclose(y, value, rtol=1e-5)  # Of six digits.
    # The expected error: a closed band, there along its top and back along its bottom.
    (band,) = [t for t in figure["data"] if t.get("fill") and t["xaxis"] == "x2"][:1]
    first = band["x"].index(None)
    time, edge = np.array(band["x"][:first]), np.array(band["y"][:first], dtype=float)
    np.testing.assert_array_equal(time, time[::-1])
    np.testing.assert_array_equal(edge, -edge[::-1])
    half = first // 2
    np.testing.assert_allclose(time[:half], shown[0].time[:half], atol=1e-9)
    np.testing.assert_allclose(
        edge[:half], 2.0 * expected_of(shown[0])[:half], rtol=1e-5
    )
    # The errors: what is left fits in, of what was before only a part.
    low, high = figure["layout"]["yaxis2"]["range"]
    assert np.abs(shown[0].measured - shown[0].after).max() < high == -low
    assert np.abs(shown[0].measured - shown[0].before).max() > high


def test_a_long_recording_is_shown_about_its_worst_window(case):
    """Ten thousand rows in windows of 30; the largest error is near the end."""
    n = 10_000
    time, measured = np.arange(n) * 0.01, np.zeros(n)
    measured[9_000] = 1.0
    zero = np.zeros(n)
    starts = np.arange(0, n, 30)
    long = Series("p.j1.position", "r", 0, time, measured, zero, zero, starts, 1e-3)
    [shown] = shown_series([long])
    assert len(shown.time) <= 2000 and shown.measured.max() == 1.0


@pytest.mark.skipif(not any(map(which, BROWSERS)), reason="no browser")
def test_a_browser_unpacks_the_plot_and_shows_the_worst_window_when_it_is_clicked(
    case, tmp_path
):
    written(case, tmp_path)
    with Browser(limit_sec=30.0) as browser:
        browser.open((tmp_path / "report.html").as_uri())
        plotted = "document.documentElement.dataset.plotted"
        browser.run(
            "new Promise((done) => { const wait = () => "
            f"{plotted} ? done() : setTimeout(wait, 50); wait(); }})"
        )
        assert browser.run("document.querySelectorAll('#series .main-svg').length")
        assert browser.run("document.querySelectorAll('#series img').length") == 0
        row = browser.run(
            "(() => { const row = document.querySelector('a[data-axis]'); row.click();"
            "return [row.dataset.axis, +row.dataset.from, +row.dataset.to]; })()"
        )
        layout = f"document.getElementById('series').layout.xaxis{row[0]}.range"
        assert browser.run(f"{layout}.map(Number)") == row[1:]


def test_effects_are_ranked_by_what_is_lost_without_them(case):
    """3 over 1 and 9 over 1: half the length on a logarithmic scale."""
    [one] = case[2].effects
    less = replace(one, evidence=replace(one.evidence, held_out_before=3.0))
    more = replace(one, kind="rotor_inertia")
    two = [
        replace(e, evidence=replace(e.evidence, held_out_before=x, held_out_after=1.0))
        for e, x in ((less, 3.0), (more, 9.0))
    ]
    page = evidence(replace(case[2], effects=two))
    assert page.index("rotor_inertia") < page.index(one.kind)
    assert re.findall(r"width:([\d.]+)%", page) == ["100.0", "50.0"]
    assert "9 times" in page and "3 times" in page
    unknown = replace(one, evidence=replace(one.evidence, held_out_before=np.nan))
    assert evidence(replace(case[2], effects=[unknown])) == ""


def test_windows_are_listed_by_the_error_that_is_left(case):
    """Of three windows of a channel the second is 5 times as far off as expected."""
    time = np.arange(30) * 0.1
    zero, measured = np.zeros(30), np.repeat([1e-3, 5e-3, 2e-3], 10)
    measured[10] = np.nan  # Not measured.
    before = measured - np.repeat([9e-3, 6e-3, 7e-3], 10)
    starts = np.array([0, 10, 20])
    one = Series("p.j1.position", "r", 0, time, measured, before, zero, starts, 1e-3)
    page = series(replace(case[2], series=[one]), {}, [one])
    rows = re.findall(r"<td><a .*?>(.*?)</a>.*?<td>([\d.]+)</td></tr>", page)
    assert rows == [
        ("1.00 - 1.90 s", "5"), ("2.00 - 2.90 s", "2"), ("0.00 - 0.90 s", "1"),
    ]  # fmt: skip


def test_correlations_of_parameters_are_shown_both_ways(case, tmp_path):
    def of(name, value, other):
        return Trust(
            "joint_coulomb_friction", ("p.j1",), name, "N m", 1.0, 0.1, {}, (), (),
            correlation={f"{other} of joint_coulomb_friction at p.j1": value},
        )  # fmt: skip

    both = [of("coulomb", -0.93, "offset"), of("offset", -0.93, "coulomb")]
    page = written(case, tmp_path, replace(case[2], trust=both))
    table = page[page.index("Correlation of their errors") :]
    cells = re.findall(r"<td class=n[^>]*>(.*?)</td>", table.partition("</table>")[0])
    assert cells == ["1", "-0.93", "-0.93", "1"]
    written_json = json.loads((tmp_path / "result.json").read_text())
    assert list(written_json["trust"][0]["correlation"].values()) == [-0.93]
    alone = written(case, tmp_path / "b", replace(case[2], trust=both[:1]))
    assert "Correlation of their errors" not in alone


def test_stamps_that_count_from_a_date_are_shown_from_the_start(case, tmp_path):
    scene_path, recording_path, made = case
    [recording] = read_recordings([recording_path])
    first = 1.7e9
    dated = replace(recording, time=recording.time + first)
    where = [
        replace(w, from_s=w.from_s + first, to_s=w.to_s + first) for w in made.where
    ]
    series = [replace(s, time=s.time + first) for s in made.series]
    result = replace(made, where=where, series=series)
    pages = {}
    for name, r, rec in (("plain", made, recording), ("dated", result, dated)):
        write_report(r, read_scene(scene_path), tmp_path / name, [rec], scene_path)
        pages[name] = text_of((tmp_path / name / "report.html").read_text())
    note = " Times count from the start of a recording."
    assert note in pages["dated"] and note not in pages["plain"]
    again = pages["dated"].replace(note, "").replace("/dated/", "/plain/")
    assert again.replace("/dated", "/plain") == pages["plain"]
    written = json.loads((tmp_path / "dated" / "result.json").read_text())
    assert written["where"][0]["from_s"] >= first  # As the recording has it.


def test_the_next_best_is_said_with_its_error():
    def words(margin):
        return next_best(Evidence(9.0, 1.0, "payload at p.rod", margin))

    assert words(0.62) == "payload at p.rod, error 62 % larger"
    said = "payload at p.rod, the same error: the data do not prefer it"
    assert words(0.001) == words(-0.001) == said
    known = Evidence(9.0, 1.0, "payload at p.rod", 0.0, "it needs 4 parameters")
    assert next_best(known) == "payload at p.rod, the same error: it needs 4 parameters"
    assert words(-0.03).endswith(", error 3 % smaller: too little to prefer it")
    assert words(np.nan) == "payload at p.rod"
    assert next_best(Evidence(9.0, 1.0, "", np.nan)) == ""


def test_the_files_are_those_of_the_design(case, tmp_path):
    written(case, tmp_path, comparison="<html>moving</html>")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == set(
        "result.json scene.yaml report.html compare.html channels.png where.png "
        "series.png".split()
    )
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["verdict"] == "gap_named"
    assert result["effects"][0]["at"] == "p.j1"
    assert read_scene(tmp_path / "scene.yaml").effects == [COULOMB]
    page = (tmp_path / "report.html").read_text()
    assert 'href="compare.html"' in page and 'src="compare.html#small"' in page


def test_each_effect_is_told_once(case):
    """Four joints of which one sentence tells, and an actuator: on the first screen of
    the page, and in the terminal."""
    [one] = case[2].effects
    values = [Estimate(0.1 * k, 0.01, "N m") for k in range(1, 5)]
    effects = [
        replace(one, at=(f"p.j{k}",), parameters={"coulomb": value})
        for k, value in enumerate(values, 1)
    ]
    gain = Estimate(0.8234, 0.0003, "")
    words = f"The actuator of p.j1 gives {gain.text()} times its torque."
    gains = {"gain": gain}
    lone = replace(one, kind="actuator_gain", parameters=gains, says=words)
    effects.append(lone)
    told = says("gap_named", effects, case[2].gap)
    assert "Each of 4 joints" in told and "p.j3" not in told
    result = replace(case[2], effects=effects, says=told)
    page = text_of(_first_screen(result, {}, False))
    table = effects_table(result, told).to_text()
    for each in values:
        assert page.count(each.text()) == table.count(each.text()) == 1
    # A column with a value for some effects has one for all: no cell is empty.
    assert (page.count(gain.text()), table.count(gain.text())) == (1, 2)
    assert page.count("that the model lacks") == table.count("that the model lacks")
    assert page.count("that the model lacks") == 1
    assert "errors in units of the expected error" in table
    alone = replace(case[2], effects=[lone], says=words)
    assert "parameters" not in effects_table(alone, alone.says).columns
    assert "parameters" in effects_table(alone).columns


def test_effects_that_the_scene_had_are_kept_before_the_new(case, tmp_path):
    scene = replace(read_scene(case[0]), effects=[VISCOUS])
    write_report(case[2], scene, tmp_path)
    assert read_scene(tmp_path / "scene.yaml").effects == [VISCOUS, COULOMB]


def test_a_tie_is_said_with_what_tells_it_apart(case, tmp_path):
    effect = replace(
        case[2].effects[0],
        indistinguishable_from=(VISCOUS,),
        tell_apart="move the joint at two speeds",
    )
    result = replace(case[2], verdict="ambiguous", effects=[effect])
    text = text_of(written(case, tmp_path, result))
    assert "These data cannot distinguish it from: " in text
    assert "Joint p.j1 has 0.2 N m s/rad of viscous damping" in text
    assert "To distinguish them: Move the joint at two speeds" in text
    assert "    to distinguish them: move the joint at two speeds" in summary_lines(
        result
    )


def test_a_tie_at_a_joint_that_slides_is_in_its_units(case, tmp_path):
    effect = replace(
        case[2].effects[0], indistinguishable_from=(VISCOUS,),
        sliding=frozenset(VISCOUS.at),
    )  # fmt: skip
    result = replace(case[2], verdict="ambiguous", effects=[effect])
    says = "p.j1 has 0.2 N s/m of viscous damping"
    assert says in text_of(written(case, tmp_path, result))
    assert any(says in line for line in summary_lines(result))


def test_a_runner_up_that_is_ahead_is_said_to_be(case, tmp_path):
    """A bigger model that is not enough better to be taken."""
    evidence = replace(case[2].effects[0].evidence, margin=-0.08)
    effect = replace(case[2].effects[0], evidence=evidence)
    text = text_of(written(case, tmp_path, replace(case[2], effects=[effect])))
    assert "error 8 % smaller: too little to prefer it." in text


def test_the_other_candidates_are_listed_with_what_each_would_have_left(case):
    result = case[2]
    assert result.candidates
    for each in result.candidates:
        assert each.kind in considered(result)
    assert considered(replace(result, candidates=())) == ""


def test_no_gap_and_no_name_are_said_and_nothing_is_added(case, tmp_path):
    nothing = replace(
        case[2], verdict="no_gap", says="Nothing is missing.", effects=[], where=[],
        gap=GapMeasure(1.02, 1.02, 1.0, WINDOW), series=[], candidates=[],
    )  # fmt: skip
    text = text_of(written(case, tmp_path / "none", nothing))
    assert "No gap Nothing is missing." in text and "Nothing was added" in text
    assert read_scene(tmp_path / "none" / "scene.yaml").effects == []
    left = Unexplained("p.j1.velocity", "near q = 0.3", 12.3, "position of p.j1")
    unnamed = replace(
        nothing, verdict="gap_unnamed", says="Something is left.", unexplained=[left]
    )
    text = text_of(written(case, tmp_path / "left", unnamed))
    assert "none is named" in text
    assert (
        "near q = 0.3: 12.3 times the expected error; correlates with position of p.j1"
        in text
    )


def test_numbers_that_are_none_do_not_break_it(case, tmp_path):
    nan = float("nan")
    effect = replace(
        case[2].effects[0],
        parameters={"coulomb": Estimate(0.35, nan, "N m")},
        evidence=Evidence(nan, nan, "", nan),
    )
    gap = GapMeasure(nan, nan, nan, WINDOW, {"p.j1.position": {"before": nan}})
    empty = replace(case[2].series[0], before=np.full(600, nan))
    result = replace(case[2], effects=[effect], gap=gap, series=[empty])
    page = written(case, tmp_path, result)
    assert "nan" not in text_of(page)
    json.loads((tmp_path / "result.json").read_text(), parse_constant=pytest.fail)


def test_a_parameter_that_was_not_fitted_has_no_deviation(case, tmp_path):
    """Neither in the page nor in result.json; nor does it make an effect sure."""
    values = {
        "x": Estimate(0.015, 1e-3, "m"),
        "z": Estimate(0.0, 0.0, "m", False, False),
    }
    effect = replace(case[2].effects[0], parameters=values)
    page = written(case, tmp_path, replace(case[2], effects=[effect]))
    assert "0 (as modelled)" in text_of(page)
    found = json.loads((tmp_path / "result.json").read_text())["effects"][0]
    assert found["parameters"]["z"]["std"] is None
    assert [p["fitted"] for p in found["parameters"].values()] == [True, False]
    assert _surest(effect) == pytest.approx(1e-3 / 0.015)


def test_text_of_a_recording_is_no_html(case, tmp_path):
    where = replace(case[2].where[0], region="<script>alert(1)</script>", score=1e9)
    bad = replace(case[2].series[0], channel="</script><script>alert(1)</script>")
    page = written(case, tmp_path, replace(case[2], where=[where], series=[bad]))
    assert "<script>alert" not in page and page.count("<script>") == 1


def test_the_heat_map_shows_a_stretch_where_it_was(case):
    """Episodes of 1 s and 3 s side by side: 600 columns, so 150 a second."""
    extents = {("run", 0): (0.0, 1.0), ("run", 1): (10.0, 13.0)}
    where = [Where("p.j1.position", 11.0, 12.0, 1, "run", "moving", 5.0)]
    figure = picture_of_where(replace(case[2], where=where), extents)
    [image] = figure.axes[0].images
    shown = np.flatnonzero(np.isfinite(image.get_array().filled(np.nan)[0]))
    assert (shown[0], shown[-1]) == (300, 449)


def test_many_channels_episodes_and_findings_stay_readable(case, tmp_path):
    names = [f"p.j{i}.position" for i in range(60)]
    where = [
        Where(name, e + 0.1, e + 0.2, e, "run", "moving", 4.0 + e)
        for name in names
        for e in range(40)
    ]
    finding = case[2].checks[1]
    result = replace(
        case[2],
        where=where,
        gap=replace(
            case[2].gap, per_channel={n: {"before": 9.0, "after": 2.0} for n in names}
        ),
        checks=[finding] * 500,
    )
    page = written(case, tmp_path, result)
    # Pictures hardly grow with the channels, and long tables are folded and cut.
    assert len(page) - len(_library()) < 800_000
    assert "<details>" in page


def test_a_folder_that_cannot_be_written_is_named(case, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match='--out: got ".*file"'):
        write_report(case[2], read_scene(case[0]), tmp_path / "file")


def test_extents_are_those_of_the_episodes(case):
    recordings = read_recordings([case[1]])
    assert extents_of(recordings) == {("run", 0): (0.0, 5.99)}


def test_the_comparison_moves_all_three_and_says_what_is_shown(case):
    page = comparison_html(case[2], read_scene(case[0]), read_recordings([case[1]]))
    assert page is not None
    legend = text_of(page[page.index("position:fixed;left:14px") :])
    assert "measured" in legend and "with the named effects" in legend
    assert "0.00 - 5.99 s of run, episode 0, at 0.29 times real time" in legend
    assert "starts again from the measured state 20 times" in legend


def test_without_an_effect_or_a_series_there_is_less_to_compare(case):
    recordings, scene = read_recordings([case[1]]), read_scene(case[0])
    alone = replace(case[2], effects=[], verdict="gap_unnamed")
    page = comparison_html(alone, scene, recordings)
    assert page is not None and "with the named effects" not in page
    assert comparison_html(replace(case[2], series=[]), scene, recordings) is None


def test_errors_of_a_channel_with_rows_of_its_own_are_one_line_in_each_window():
    """Every third row is a camera's; between two of them others have rows."""
    n = 90
    measured = np.where(np.arange(n) % 3 == 0, 0.5, np.nan)
    series = Series(
        "p.j1.position", "log", 0, 0.01 * np.arange(n), measured, np.zeros(n),
        np.zeros(n), np.array([0, 45]), 0.1,
    )  # fmt: skip
    figure = picture_of_series([series])
    line = figure.axes[1].lines[0].get_ydata()
    np.testing.assert_allclose(line[np.isfinite(line)], 0.5)
    # Thirty rows, and one break: where the second window begins.
    assert np.isfinite(line).sum() == 30 and np.isnan(line).sum() == 1
    assert np.flatnonzero(np.isnan(line)).tolist() == [15]


def test_a_long_text_is_no_heading():
    short = "Joint a.b has Coulomb friction of 0.5 N m. The rest is noise."
    assert headline(short).count("<h1>") == 1 and "<p>" not in headline(short)
    parts = [f"joint a.j{i} has Coulomb friction of 0.{i} N m" for i in range(1, 10)]
    html = headline(f"Out of time. It is off by 2.5 times: {'; '.join(parts)}. Wait.")
    assert html.startswith("<h1>Out of time.</h1><p>It is off by 2.5 times:</p><ul>")
    assert re.findall(r"<li>Joint a\.j(\d) [^<]*N&nbsp;m</li>", html) == list(
        "123456789"
    )
    assert html.endswith("</ul><p>Wait.</p>")


def test_a_sentence_that_begins_with_a_name_keeps_it():
    assert sentence_html("robot.a to robot.b: each.") == "robot.a to robot.b: each."
    assert sentence_html("each of 4 joints.") == "Each of 4 joints."

"""report.html of a run, a sweep or a reproduction."""

import json
import re

import numpy as np

from makebreak.scripts.cli.commands import _of_targets
from makebreak.scripts.runner.result_page import result_page
from makebreak.scripts.runner.table import Table


def test_what_was_missed_comes_first_and_text_is_no_html():
    rows = [("<b>x</b>", float("nan")), ("y", 0.25)]
    table = Table("spring_mass", ("result", "value"), rows, [None, False], ["a note"])
    says = ["met     rests: yes", "MISSED  error: 3 < 2"]
    page = result_page("makebreak run spring_mass", [table], False, says)
    assert "Goals missed" in page and "<iframe" not in page
    assert '<li class="error"><b>MISSED</b>: error: 3 &lt; 2</li>' in page
    assert "<li><b>met</b>: rests: yes</li>" in page
    assert '<td class="error">MISSED</td>' in page
    cells = re.findall(r"<td.*?>(.*?)</td>", page)
    assert cells == ["&lt;b&gt;x&lt;/b&gt;", "-", "", "y", "0.25", "MISSED"]
    assert "a note" in page and "<pre>" not in page


def test_plots_and_the_animation_are_in_it_and_long_tables_are_folded():
    table = Table("t", ("n",), [(k,) for k in range(42)])
    page = result_page(
        "t", [table], True, pictures={"a.png": b"png"}, is_moving=True, command="go"
    )
    assert "Goals met" in page and 'alt="a.png" src="data:image/png;base64,' in page
    assert 'src="meshcat.html#small"' in page and "<pre>go</pre>" in page
    shown, _, folded = page.partition("<details>")
    assert "18 more" in folded and ">23<" in shown and ">24<" in folded


def test_few_cases_of_many_values_stand_side_by_side():
    columns = ("case", *"abcdefgh")
    rows = [(name, *range(8)) for name in ("adapt=true", "adapt=false")]
    page = result_page("t", [Table("t", columns, rows)])
    assert re.findall(r"<th>(.*?)</th>", page) == ["case", "adapt=true", "adapt=false"]
    assert page.count("<tr>") == 9
    assert 'class="two"' not in page  # Nothing to stand in it.


def test_a_reproduction_says_which_targets_are_missed():
    rows = [("force", "8 N", "9 N", "run"), ("time", "3 s", "2 s", "run")]
    heads = ("what", "paper", "ours", "command")
    both = Table("Walls", heads, rows, [False, True])
    none = Table("Others", heads, rows)
    page = result_page("t", *_of_targets([both, none]))
    assert "Goals missed" in page and "Walls: 1 of 2 targets met" in page
    assert '<li class="error"><b>MISSED</b>: force: paper 8 N, ours 9 N</li>' in page
    assert "Goals" not in result_page("t", *_of_targets([none]))
    met = Table("Walls", heads, rows, [True, True])
    assert "Goals met" in result_page("t", *_of_targets([met]))


def test_a_recording_can_be_zoomed():
    """Rows by quantity, a line a place; a line ends where an episode does."""
    t = np.array([0.0, 0.5, 1.0, 0.0, 0.5])
    columns = {
        "time": t, "episode": np.array([0, 0, 0, 1, 1]), "arm.j1.position": t,
        "arm.j2.position": 2.0 * t, "box.box.x": -t, "box.box.y": t,
        "box.box.vx": np.full(5, np.nan),
    }  # fmt: skip
    assert "Plotly" not in result_page("t", [])
    page = result_page("t", [], recorded=columns)
    figure = json.loads(re.search(r"const figure = (.*);\n", page)[1])
    titles = [each["text"] for each in figure["layout"]["annotations"]]
    assert titles == ["position [rad or m]", "place x, y, z [m]"]
    lines = {each["name"]: each for each in figure["data"]}
    assert list(lines) == [*columns][2:6]
    assert lines["arm.j2.position"]["y"] == [0.0, 1.0, 2.0, None, 0.0, 1.0]
    assert lines["box.box.x"]["xaxis"] == "x2"
    assert figure["layout"]["xaxis2"]["matches"] == "x"
    long = {"time": np.arange(5000.0), "arm.j1.position": np.arange(5000.0)}
    page = result_page("t", [], recorded=long)
    figure = json.loads(re.search(r"const figure = (.*);\n", page)[1])
    assert 400 < len(figure["data"][0]["x"]) <= 800

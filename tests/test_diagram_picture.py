"""The picture of a diagram: what is shown, and in which column."""

import pytest

from makebreak.diagrams.cartpole_walls import CartpoleWallsConfig, make_cartpole_walls
from makebreak.scripts.cli import main
from makebreak.scripts.runner.diagram_picture import (
    columns,
    draw_diagram,
    shown_edges,
    shown_systems,
)


def test_columns_follow_the_data_and_a_loop_is_cut_where_it_closes():
    edges = [("a", "b"), ("b", "c"), ("a", "c"), ("c", "a"), ("c", "d"), ("d", "b")]
    assert columns(list("abcd"), edges) == {"a": 0, "b": 1, "c": 2, "d": 3}
    assert columns(["x", "y"], []) == {"x": 0, "y": 0}
    assert columns(["x"], [("x", "x")]) == {"x": 0}


def test_systems_of_the_project_are_shown_and_what_passes_between_them():
    diagram = make_cartpole_walls(CartpoleWallsConfig())
    assert {s.get_name() for s in shown_systems(diagram)} == {"plant", "c3", "learner"}
    edges = shown_edges(diagram)
    assert edges["plant", "c3"] == ["x"]
    assert edges["learner", "c3"] == ["r_comp"]
    assert "u" in edges["c3", "plant"]


@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_the_picture_is_written_with_all_names_inside(tmp_path, suffix):
    path = tmp_path / f"diagram{suffix}"
    draw_diagram(make_cartpole_walls(CartpoleWallsConfig()), path)
    if suffix == ".svg":
        for name in ("plant", "c3", "learner", "r_comp"):
            assert f">{name}<" in path.read_text()
    else:
        assert path.read_bytes().startswith(b"\x89PNG")


def test_run_draws_it_and_refuses_a_format_that_it_does_not_know(tmp_path, capsys):
    path = tmp_path / "d.svg"
    words = ["run", "cartpole_walls", "--no-meshcat", "--duration", "0.1"]
    words += ["--out", str(tmp_path / "out"), "--diagram"]
    assert main([*words, str(path)]) in (0, 1)
    # The run without adaptation comes first; the richest diagram is drawn.
    assert "learner" in path.read_text()
    assert main([*words, str(tmp_path / "d.gif")]) == 2
    assert "expected a file .svg, .png, .pdf" in capsys.readouterr().err

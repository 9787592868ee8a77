"""makebreak export-tests: tests of single systems, from what they did in a run."""

import dataclasses
import runpy
import shutil
import subprocess
import sys
from enum import IntEnum
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from pydrake.systems.sensors import ImageRgba8U

from makebreak.diagrams.cartpole_walls import CartpoleWallsConfig
from makebreak.scripts.cli import main
from makebreak.scripts.experiments import cartpole_walls
from makebreak.scripts.runner import export_tests as export_module
from makebreak.scripts.runner.export_tests import export_tests
from makebreak.scripts.runner.replay import (
    StoredTrack,
    Track,
    Unsupported,
    flatten,
    rebuild,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    ContactBelief,
    ExpectedContact,
)
from makebreak.systems.contact_mpc import c3_mpc, residual_learner
from makebreak.systems.contact_mpc.c3_mpc import C3Status

SECONDS = 0.4


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The folder of two of cartpole_walls' systems, made once."""
    out = tmp_path_factory.mktemp("exported") / "tests"
    config = CartpoleWallsConfig()
    wanted = ["c3", "learner"]
    done, left_out = export_tests(
        "cartpole_walls", cartpole_walls, config, out, wanted, SECONDS
    )
    assert not left_out
    return out, done


def failing(out):
    """Which exported tests fail, by the name of their system."""
    failed = set()
    for path in sorted(out.glob("test_*.py")):
        module = runpy.run_path(str(path))
        [test] = [f for name, f in module.items() if name.startswith("test_")]
        try:
            test()
        except AssertionError:
            failed.add(path.stem.removeprefix("test_"))
    return failed


def test_each_system_replays_alone_what_it_did(exported):
    out, done = exported
    # One update each 10 ms from the offset on.
    assert done == {"c3": 40, "learner": 40}
    assert failing(out) == set()


def test_exactly_the_system_that_was_changed_fails(exported, monkeypatch):
    out, _ = exported
    plain = c3_mpc.solve_c3

    def stronger(*args):
        plan, warm = plain(*args)
        return dataclasses.replace(plan, u=1.001 * plan.u), warm

    with monkeypatch.context() as patch:
        patch.setattr(c3_mpc, "solve_c3", stronger)
        assert failing(out) == {"c3"}
    spread = residual_learner.spread
    with monkeypatch.context() as patch:
        patch.setattr(residual_learner, "spread", lambda *args: -spread(*args))
        assert failing(out) == {"learner"}


def test_a_system_of_another_rate_fails(exported, tmp_path):
    out, _ = exported
    copy = shutil.copytree(out, tmp_path / "copy")
    path = copy / "test_c3.py"
    text = path.read_text()
    assert "0.01, " in text
    path.write_text(text.replace("0.01, ", "0.02, "))
    assert "c3" in failing(copy)


def test_the_folder_runs_with_pytest_alone(exported):
    out, _ = exported
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(out)],
        capture_output=True,
        text=True,
        cwd=out,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "2 passed" in run.stdout


class Colour(IntEnum):
    RED = 2


@pytest.mark.parametrize(
    "value",
    [
        1.5,
        7,
        True,
        None,
        "text",
        np.arange(6.0).reshape(2, 3),
        [1, (2.0, None), {"a": np.array([1, 2])}],
        C3Status.BAD_X,
        ContactBelief((ExpectedContact(np.ones(3), np.eye(3), [0, 0, -1.0]),)),
    ],
)
def test_a_value_survives_being_taken_apart(value):
    leaves: list = []
    spec = flatten(value, leaves)
    again = rebuild(spec, [leaf.copy() for leaf in leaves])
    assert type(again) is type(value)
    other: list = []
    assert flatten(again, other) == spec
    for a, b in zip(leaves, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_image_survives_and_other_things_are_refused():
    image = ImageRgba8U(4, 3)
    image.mutable_data[:] = np.arange(48, dtype=np.uint8).reshape(3, 4, 4)
    leaves: list = []
    again = rebuild(flatten(image, leaves), leaves)
    np.testing.assert_array_equal(again.data, image.data)
    for value in (lambda: 0, np.array([object()]), {1: 2}):
        with pytest.raises(Unsupported):
            flatten(value, [])


def test_equal_values_in_a_row_are_kept_once():
    track = Track()
    for value in (np.zeros(3), np.zeros(3), np.ones(3), "a", "a", np.zeros(3)):
        track.append(value)
    arrays = track.arrays("x")
    assert arrays["x/0/0"].shape == (3, 3)
    stored = StoredTrack(arrays, "x")
    got = [rebuild(*stored[k]) for k in range(6)]
    assert got[3] == got[4] == "a"
    np.testing.assert_array_equal(got[2], np.ones(3))
    assert [stored.is_new(k) for k in range(6)] == [
        True,
        False,
        True,
        True,
        False,
        True,
    ]


def run_main(*words):
    return main(["export-tests", *words])


def test_an_unknown_system_of_a_single_simulation_is_refused_before_it_runs(tmp_path):
    builder = DiagramBuilder()
    builder.AddNamedSystem("learner", ConstantVectorSource([1.0]))
    diagram = builder.Build()

    def run(config, session):
        session.simulate(diagram, 5.0, record=None)  # It would fail if it ran.

    with pytest.raises(ValueError, match="has no system lerner; did you mean learner"):
        export_tests(
            "own", SimpleNamespace(run=run), None, tmp_path / "out", ["lerner"]
        )


def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    (tmp_path / "out.part").mkdir()  # The user's own.

    def refused(*words):
        assert run_main("cartpole_walls", "--out", str(out), *words) == 2
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert line.startswith("makebreak: ")
        assert [path.name for path in tmp_path.iterdir()] == ["out.part"]
        return line

    assert "has no system lerner; did you mean learner" in refused(
        "--systems", "c3,lerner", "--seconds", "0.1"
    )
    assert "cannot be exported: it has no periodic update" in refused(
        "--systems", "no_residual", "--seconds", "0.1"
    )
    assert "--seconds" in refused("--seconds", "0")

    def broken(*_):
        raise RuntimeError("the arm fell off")

    with monkeypatch.context() as patch:
        patch.setattr(cartpole_walls, "make_cartpole_walls", broken)
        assert (
            "failed while it was recorded: RuntimeError: the arm fell off" in refused()
        )

    calls = []
    plain = c3_mpc.solve_c3

    def breaking(*args):
        calls.append(1)
        if len(calls) > 3:
            raise ZeroDivisionError("after three updates")
        return plain(*args)

    with monkeypatch.context() as patch:
        patch.setattr(c3_mpc, "solve_c3", breaking)
        line = refused("--systems", "c3", "--seconds", "0.1")
        assert "failed while it was recorded" in line and "after three" in line
        assert len(calls) == 4

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(export_module.np, "savez_compressed", full)
        assert "cannot be written: No space left" in refused(
            "--systems", "c3", "--seconds", "0.1"
        )
    out.mkdir()
    (out / "mine.txt").write_text("keep")
    assert run_main("cartpole_walls", "--out", str(out)) == 2
    assert "holds mine.txt, which makebreak did not write" in capsys.readouterr().err
    assert (out / "mine.txt").read_text() == "keep"


def test_an_export_may_be_repeated_into_its_folder(tmp_path):
    out = str(tmp_path / "out")
    words = ["cartpole_walls", "--out", out, "--seconds", "0.1", "--systems"]
    assert run_main(*words, "c3,learner") == 0
    assert run_main(*words, "c3") == 0
    names = {path.name for path in (tmp_path / "out").iterdir()} - {"models"}
    assert names == {"test_c3.py", "c3.npz", ".makebreak.json"}
    assert failing(tmp_path / "out") == set()

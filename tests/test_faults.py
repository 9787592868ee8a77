"""What fails ends with one line and a status; the traceback is in a file."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
import spring_mass

from makebreak.scripts import experiments
from makebreak.scripts.cli import arguments
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.cli.faults import on_purpose


@pytest.fixture(autouse=True)
def _registered(monkeypatch, tmp_path):
    monkeypatch.setattr(experiments, "EXPERIMENTS", {"spring_mass": "spring_mass"})
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.delenv("MAKEBREAK_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)


def run(*args):
    return cli.main(["run", "spring_mass", "--no-meshcat", "--out", "out", *args])


def the_file(said: str) -> Path:
    """What the only line says has the traceback."""
    assert said.startswith("makebreak: ") and said.count("\n") == 1
    found = re.search(r"the traceback is in (\S+)\)", said)
    assert found is not None
    return Path(found[1])


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("Drake says\nno"),
        SystemExit("Failure at x.cc:1: condition 'a > 0' failed."),
        KeyError("ball.ball"),
        MemoryError("37 GiB"),
        RecursionError("too deep"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_what_fails_before_anything_was_simulated_is_bad_input(
    error, monkeypatch, capsys
):
    def fails(config, session):
        raise error

    monkeypatch.setattr(spring_mass, "run", fails)
    assert run() == 2
    said = capsys.readouterr().err
    assert "the input cannot be used" in said
    assert "Traceback" in the_file(said).read_text()


@pytest.mark.parametrize(
    "slip",
    [lambda: undefined, lambda: len(), lambda: Path.nothing],  # noqa: F821
    ids=["NameError", "TypeError", "AttributeError"],
)
def test_what_no_input_can_cause_is_a_fault_whenever_it_happens(
    slip, monkeypatch, capsys
):
    monkeypatch.setattr(spring_mass, "run", lambda *_: slip())
    assert run() == 3
    said = capsys.readouterr().err
    assert "a fault of makebreak itself" in said
    assert "in <lambda>" in the_file(said).read_text()


@pytest.mark.parametrize(
    "slip", [lambda: np.zeros(2) + np.zeros(3), lambda: np.linalg.inv(np.zeros((2, 2)))]
)
def test_a_slip_of_numpy_is_told_with_its_traceback(slip, monkeypatch, capsys):
    monkeypatch.setattr(spring_mass, "run", lambda *_: slip())
    assert run() == 2
    assert "in <lambda>" in the_file(capsys.readouterr().err).read_text()


@pytest.mark.parametrize(
    "setting",
    ["noise=.inf", "noise=1e308", "spring.stiffness=1e-320", "steps=100000000000"],
)
def test_a_number_that_no_experiment_can_mean_is_refused(setting, capsys):
    assert run("--set", setting) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"makebreak: --set {setting.split('=')[0]}: got")
    assert "the traceback" not in said


def test_a_refusal_has_no_traceback_and_no_file(capsys):
    assert run("--set", "spring.stiffness=-1") == 2
    assert capsys.readouterr().err == (
        "makebreak: spring.stiffness: got -1.0, expected > 0\n"
    )
    assert not list(Path().glob("makebreak-error-*"))


@pytest.mark.parametrize(
    "error", [KeyError("x"), SystemExit("Failure at a.cc"), RuntimeError("shapes")]
)
def test_a_fault_of_any_command_is_one_line_and_a_file(error, monkeypatch, capsys):
    def fails(args):
        raise error

    monkeypatch.setitem(cli._COMMANDS, "list", fails)
    assert cli.main(["list"]) == 3
    said = capsys.readouterr().err
    assert "a fault of makebreak itself" in said
    assert "fails" in the_file(said).read_text()


def test_the_traceback_is_shown_when_asked_for(monkeypatch, capsys):
    def fails(args):
        raise KeyError("x")

    monkeypatch.setitem(cli._COMMANDS, "list", fails)
    monkeypatch.setenv("MAKEBREAK_DEBUG", "1")
    assert cli.main(["list"]) == 3
    assert "Traceback" in capsys.readouterr().err


def test_leaving_the_help_is_no_fault(capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(["--help"])
    assert left.value.code == 0 and "usage" in capsys.readouterr().out


def test_only_a_raise_of_our_own_is_a_refusal():
    def caught(call):
        try:
            call()
        except ValueError as error:
            return on_purpose(error)

    assert caught(lambda: arguments.number("x", "--seed", 0.0))
    assert not caught(lambda: np.zeros(2) + np.zeros(3))
    assert not caught(lambda: int("x"))


def test_a_package_option_holds_for_one_command(monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(
        spring_mass, "run", lambda *_: seen.append(os.environ["MAKEBREAK_PACKAGES"])
    )
    run("--package", f"hand={tmp_path}")
    assert seen == [f"hand={tmp_path}"]
    assert "MAKEBREAK_PACKAGES" not in os.environ
    assert run("--package", "hand=nowhere") == 2

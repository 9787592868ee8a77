"""When systems are compiled, and that a second process begins from the other end."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.scripts.runner import compile_ahead
from makebreak.scripts.runner.session import Session
from makebreak.systems.numerics.first_calls import deferred, first_call


def test_first_calls_are_made_at_once_or_wait_in_their_order():
    made = []
    first_call(made.append, 1)
    assert made == [1]
    with deferred() as outer:
        first_call(made.append, 2)
        with deferred() as inner:
            first_call(made.append, 3)
        first_call(made.append, 4)
    assert made == [1] and (len(outer), len(inner)) == (2, 1)
    for call in outer:
        call()
    assert made == [1, 2, 4]
    first_call(made.append, 5)
    assert made == [1, 2, 4, 5]


def test_what_fails_while_it_is_deferred_leaves_nothing_deferred():
    with pytest.raises(KeyError), deferred():
        raise KeyError
    made = []
    first_call(made.append, 1)
    assert made == [1]


def nothing():
    builder = DiagramBuilder()
    builder.AddSystem(ConstantVectorSource([1.0]))
    return builder.Build()


def test_a_session_compiles_before_it_simulates_and_only_once(tmp_path):
    made = []
    with Session(tmp_path / "out", progress=False) as own:
        first_call(made.append, 1)
        first_call(made.append, 2)
        assert made == []
        seen = []

        def until(t, sample):
            seen.append(list(made))
            return False

        own.simulate(nothing(), 0.1, {}, until=until)
        assert seen[0] == [1, 2]
        own.simulate(nothing(), 0.1, {})
        assert made == [1, 2]
    first_call(made.append, 3)
    assert made == [1, 2, 3]


def test_what_is_compiled_is_no_time_of_the_simulation(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("makebreak.scripts.runner.session.perf_counter", lambda: now[0])
    monkeypatch.setattr("makebreak.scripts.runner.session.process_time", lambda: now[0])

    def compiles():
        now[0] += 100.0

    def until(t, sample):
        now[0] += 0.5
        return False

    with Session(tmp_path / "out", progress=False) as own:
        first_call(compiles)
        own.simulate(nothing(), 0.1, {}, period_sec=0.05, until=until)
        own.finish()
    timing = json.loads((tmp_path / "out/timing.json").read_text())
    assert timing["wall_s"] == timing["cpu_s"] == 1.5  # Three samples.


EXPERIMENT = """
from dataclasses import dataclass
from makebreak.systems.numerics.first_calls import first_call
from tests.test_first_calls import nothing

@dataclass
class Config:
    seed: int = 0

def run(config, session):
    for k in range(3):
        first_call(print, config.seed + k)
    session.simulate(nothing(), 0.1, {}, until=lambda *_: print("simulated"))
    return {"success": True}
"""


def test_the_second_process_begins_with_the_last_and_simulates_nothing(
    monkeypatch, capsys, tmp_path
):
    (tmp_path / "made_up_experiment.py").write_text(EXPERIMENT)
    (tmp_path / "config.yaml").write_text("seed: 7\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent))
    experiments = {"made_up": "made_up_experiment"}
    monkeypatch.setattr("makebreak.scripts.experiments.EXPERIMENTS", experiments)
    words = ["compile_ahead", "made_up", str(tmp_path / "config.yaml")]
    monkeypatch.setattr(sys, "argv", words)
    compile_ahead.main()
    assert capsys.readouterr().out.split() == ["9", "8", "7"]


@pytest.mark.parametrize(("cores", "started"), [(1, 0), (2, 1)])
def test_there_is_no_second_process_for_one_core(monkeypatch, tmp_path, cores, started):
    monkeypatch.setattr("joblib.cpu_count", lambda: cores)
    commands = []
    monkeypatch.setattr(subprocess, "Popen", lambda c, **_: commands.append(c))
    compile_ahead.start("ball_rolling", tmp_path / "config.yaml")
    assert len(commands) == started
    for command in commands:
        assert command[1:] == [
            "-m", "makebreak.scripts.runner.compile_ahead", "ball_rolling",
            str(tmp_path / "config.yaml"),
        ]  # fmt: skip

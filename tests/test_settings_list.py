"""`makebreak list EXPERIMENT` shows every setting as `--set` takes it."""

from dataclasses import dataclass, field

import pytest

from makebreak.scripts import cli
from makebreak.scripts.experiments import EXPERIMENTS, load_experiment
from makebreak.scripts.settings import apply_settings, field_types, to_plain
from makebreak.scripts.settings_list import comments_of, settings_rows


@dataclass
class Config:
    gain: float = 2.0  # On its line [N/m].
    # Above it,
    # in two lines.
    rounds: int = 3
    bare: bool = True
    several: list[float] = field(  # On the first of its lines.
        default_factory=lambda: [1.0]  # Not this one.
    )


def test_a_comment_is_the_one_on_its_line_or_those_above():
    assert comments_of(Config) == {
        "gain": "On its line [N/m].",
        "rounds": "Above it, in two lines.",
        "bare": "",
        "several": "On the first of its lines.",
    }


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_setting_is_there_and_its_default_changes_nothing(experiment):
    config = load_experiment(experiment).Config()
    rows = settings_rows(config)
    keys = [key for key, _, _ in rows]
    parents = {key.rpartition(".")[0] for key in field_types(type(config))}
    assert {k for k in field_types(type(config)) if k not in parents} == set(keys)
    given = [f"{k}={v}" for k, v, _ in rows if not v.endswith(".yaml") and v]
    assert to_plain(apply_settings(config, given)) == to_plain(config)


def test_a_word_selects_settings_and_a_wrong_one_is_refused(capsys):
    assert cli.main(["list", "cartpole_walls", "Learning_Rate"]) == 0
    out = capsys.readouterr().out
    assert "learning.learning_rate  0.003" in out and "gap_error" not in out
    assert cli.main(["list", "cartpole_walls", "xyz"]) == 2
    assert 'no setting has "xyz" in its name' in capsys.readouterr().err
    assert cli.main(["list", "cartpol"]) == 2
    assert "cartpole_walls" in capsys.readouterr().err

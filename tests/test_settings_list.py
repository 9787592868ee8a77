"""`makebreak list EXPERIMENT` shows every setting as `--set` takes it."""

import re
from dataclasses import dataclass, field

import pytest

from makebreak.models.typed_yaml import field_types
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.cli.settings_list import (
    comments_of,
    settings_rows,
    settings_text,
)
from makebreak.scripts.experiments import EXPERIMENTS, load_experiment
from makebreak.scripts.runner.settings import apply_settings, to_plain


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
    assert "learning.adam.learning_rate=0.003 " in out and "gap_error" not in out
    assert cli.main(["list", "cartpole_walls", "xyz"]) == 2
    assert 'no setting has "xyz" in its name' in capsys.readouterr().err
    assert cli.main(["list", "cartpol"]) == 2
    assert "cartpole_walls" in capsys.readouterr().err


def test_meanings_are_wrapped_to_the_terminal_and_otherwise_one_line_each():
    config = load_experiment("cartpole_walls").Config()
    one_each = settings_text("x", config).splitlines()
    assert len(one_each) == 2 + len(settings_rows(config))
    wrapped = settings_text("x", config, width=80).splitlines()
    assert all(len(line) <= 80 or " " not in line.strip() for line in wrapped)
    assert any(len(line) > 80 for line in one_each)
    assert " ".join("\n".join(wrapped).split()) == " ".join("\n".join(one_each).split())


# How a meaning may begin: a capital letter or a digit (also of the paper's symbols,
# K_free, Q_d), a quote, or a symbol that the papers write in lower case.
BEGINS = re.compile(r"[A-Z0-9\"'(]|(lam|eta|eps|rho|gamma|delta|mu)\b")
# With these begins what only completes the setting's name: "Of the ball."
COMPLETES = {"Of", "Or", "And", "But", "At", "By", "From", "To", "In", "On", "Between"}


def is_meaning(text: str) -> bool:
    """Whether a setting's comment can be understood without its neighbours: two words
    or more beside the units in brackets, and no second half of a sentence."""
    words = re.findall(r"[A-Za-z][\w']*", re.sub(r"\[[^\]]*\]", "", text))
    if len(words) < 2 or words[0] in COMPLETES or "..." in text:
        return False
    return BEGINS.match(text) is not None


def test_a_unit_half_a_sentence_or_nothing_is_no_meaning():
    for text in ("", "[m]", "Off.", "[N/m] x 3, [N m/rad] x 3", "1e-3 [s].",
                 "of both contacts [N].", "Of both contacts [N].", "The longest, ...",
                 "... and above the surface [m]."):  # fmt: skip
        assert not is_meaning(text), text
    for text in ("Radius of the circle [m].", "K_free of eq. 4b [N/m].",
                 "0: no reflex at all.", '"vtk" or "drawn".'):  # fmt: skip
        assert is_meaning(text), text


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_setting_has_a_meaning_that_stands_alone(experiment):
    rows = settings_rows(load_experiment(experiment).Config())
    assert [(key, text) for key, _, text in rows if not is_meaning(text)] == []

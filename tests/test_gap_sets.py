"""Two effects for which two others could stand, and two of which one goes."""

from dataclasses import replace

import numpy as np
import pytest
from test_gap_forward import Columns, directions

from makebreak.gap.fit import fit_effects
from makebreak.gap.search import drop
from makebreak.gap.search.choice import Choice
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.rivals import still_tied, with_rivals_of_pairs
from makebreak.models.effects.kind import Effect

GAIN, MASS = ("actuator_bias", "arm.joint1"), ("link_mass", "arm.hand")


def chosen(kind: str, at: str, **parameters) -> Choice:
    effect = Effect(kind, [at], parameters)
    std = dict.fromkeys(parameters, 0.01)
    return Choice(effect, std, 10.0, 1.0, "", np.inf, (), (), 1)


@pytest.mark.parametrize("certain", [GAIN[0], MASS[0]])
def test_of_two_rivals_the_better_one_stays_whichever_is_certain(monkeypatch, certain):
    """Two discs, in MuJoCo: a mass stayed where a friction was hidden, because beside
    the mass the friction could have been anything."""
    a, b, _ = directions(3).T[:, :, None]
    of = {GAIN: a, MASS: 0.9 * a + np.sqrt(1.0 - 0.9**2) * b}
    it = Columns(of, {GAIN: 4.0})
    monkeypatch.setattr(it, "weighed_by", lambda effects, every_row=False: it)
    search = Comparison(it, lambda text: None)
    effects = [Effect(GAIN[0], [GAIN[1]], {"bias": 3.9}),
               Effect(MASS[0], [MASS[1]], {"mass": 0.1})]  # fmt: skip
    fitted = fit_effects(it, search.screen(it.residual(effects)), effects)
    both = [
        Choice(e, s, 10.0, 1.0, "", np.inf, (), (), 1, of_two=True)
        for e, s in zip(fitted.effects, fitted.std, strict=True)
    ]

    def is_certain(search, chosen, current, k):
        return len(chosen) == 1 or chosen[k].effect.kind == certain

    monkeypatch.setattr(drop, "_is_certain", is_certain)
    monkeypatch.setattr(drop, "consistency", lambda *of: np.full(1, 9.0))
    monkeypatch.setattr(drop, "scatter", lambda *of: [{}])
    monkeypatch.setattr(drop, "_as_reported", lambda *of: 9.0)
    (stays,), _ = drop.keep_certain(search, both, fitted)
    assert (stays.effect.kind, stays.effect.at[0]) == GAIN
    assert stays.effect.parameters["bias"] == pytest.approx(4.0, abs=0.02)
    assert not stays.of_two


@pytest.mark.parametrize("needed", [True, False])
def test_what_is_left_of_two_that_were_added_at_once_is_compared_anew(needed):
    """But not with the other of them where it is needed beside that."""
    a, b, _ = directions(3).T[:, :, None]
    it = Columns({GAIN: a, MASS: a + 1e-3 * b}, {GAIN: 4.0})
    search = Comparison(it, lambda text: None)
    effects = [Effect(GAIN[0], [GAIN[1]], {"bias": 3.9})]
    fitted = fit_effects(it, search.screen(it.residual(effects)), effects)
    (effect,), (std,) = fitted.effects, fitted.std
    beside = ((MASS[0], (MASS[1],)),) if needed else ()
    left = Choice(
        effect, std, 40.0, 1.0, "", np.inf, (), (), 1, paired=True, needed_beside=beside
    )
    (choice,) = with_rivals_of_pairs(search, [left], fitted)
    assert [e.kind for e in choice.ties] == ([] if needed else [MASS[0]])
    assert still_tied(search, [choice], fitted, 0) == choice.ties


def test_what_leaves_more_is_no_tie_of_what_is_left_of_two():
    a, b, _ = directions(3).T[:, :, None]
    it = Columns({GAIN: a, MASS: b}, {GAIN: 4.0})
    search = Comparison(it, lambda text: None)
    effects = [Effect(GAIN[0], [GAIN[1]], {"bias": 4.0})]
    fitted = fit_effects(it, search.screen(it.residual(effects)), effects)
    mass = Effect(MASS[0], [MASS[1]], {"mass": 0.1})
    left = replace(chosen(*GAIN, bias=4.0), paired=True, ties=(mass,))
    assert still_tied(search, [left], fitted, 0) == ()

"""Two effects for which two others could stand, and two of which one goes."""

from dataclasses import replace

import numpy as np
import pytest
from test_gap_forward import Columns, directions

from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import Outcome
from makebreak.gap.result import GapMeasure, RivalSet
from makebreak.gap.search import drop
from makebreak.gap.search.choice import Choice, Selection
from makebreak.gap.search.chosen_by_simulation import preferred_by_simulation
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.rivals import still_tied, with_rivals_of_pairs
from makebreak.gap.search.select import select
from makebreak.gap.verdict import Facts, decide, named, says
from makebreak.models.effects.kind import Effect

GAIN, MASS = ("actuator_bias", "arm.joint1"), ("link_mass", "arm.hand")
ONE, OTHER = ("joint_coulomb_friction", "arm.joint1"), ("rotor_inertia", "arm.joint2")


def problem(mass: float) -> Columns:
    """A gain of 4 and a mass are hidden, each in two of four directions; two others
    cross them, and together take off a gain and a mass of one size."""
    u = directions(4).T[:, :, None] / np.sqrt(2.0)
    of = {GAIN: u[0] + u[1], MASS: u[2] + u[3], ONE: u[0] + u[2], OTHER: u[1] + u[3]}
    return Columns(of, {GAIN: 4.0, MASS: mass})


def test_two_for_which_two_others_could_stand_are_a_tie():
    selection = select(problem(4.0))
    assert len(selection.choices) == 2
    first, second = selection.choices
    assert not first.ties and not second.ties
    (rival,) = first.sets
    assert rival.beside == (second.effect,)
    here = {(c.effect.kind, c.effect.at[0]) for c in selection.choices}
    there = {(e.kind, e.at[0]) for e in rival.instead}
    assert here | there == {GAIN, MASS, ONE, OTHER}
    assert decide(Facts(selection.choices, 40.0, 1.0))[0] == "ambiguous"


@pytest.mark.parametrize("by_evidence", [True, False])
def test_two_others_that_leave_more_are_no_tie(monkeypatch, by_evidence):
    if not by_evidence:
        monkeypatch.setattr(Comparison, "is_worse", lambda *of: False)
    selection = select(problem(3.7))
    assert {c.effect.kind for c in selection.choices} == {GAIN[0], MASS[0]}
    assert not any(c.sets for c in selection.choices)
    assert decide(Facts(selection.choices, 40.0, 1.0))[0] == "gap_named"


def chosen(kind: str, at: str, **parameters) -> Choice:
    effect = Effect(kind, [at], parameters)
    std = dict.fromkeys(parameters, 0.01)
    return Choice(effect, std, 10.0, 1.0, "", np.inf, (), (), 1)


def test_a_tie_of_two_goes_with_either_of_them():
    mass = chosen("object_mass", "disc.disc", mass=0.5)
    gain = chosen("actuator_gain", "rig.x", gain=0.8)
    rival = Effect("contact_friction", ["disc.disc~table.table"], {"friction": 0.4})
    tied = replace(gain, sets=(RivalSet((mass.effect,), (rival,)),))
    both = Selection((tied, mass), None, None, None)  # type: ignore[arg-type]
    assert both.choices[0].sets == tied.sets
    assert replace(both, choices=(tied,)).choices[0].sets == ()


def test_a_tie_of_two_is_said():
    rival = Effect("contact_friction", ["a.a~b.b"], {"friction": 0.4})
    mass = Effect("object_mass", ["disc.disc"], {"mass": 0.5})
    gain = chosen("constant_force", "rig.hand", fx=0.8, fy=0.0, fz=0.0)
    gain = replace(gain, sets=(RivalSet((mass,), (rival,)),))
    effect = named(gain, None)  # type: ignore[arg-type]
    text = says("ambiguous", [effect], GapMeasure(10.0, 1.0, 1.0, 0.5))
    assert (
        "cannot distinguish constant_force at rig.hand together with object_mass at "
        "disc.disc from contact_friction at a.a~b.b."
    ) in text
    assert effect.tell_apart


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


@pytest.mark.parametrize(
    ("here", "there", "named", "tied"),
    [
        (3.6, 2.1, "instead", False), (1.4, 0.5, "as before", True),
        (1.4, 2.1, "as before", False), (3.6, 3.1, "as before", True),
    ],
)  # fmt: skip
def test_simulated_windows_decide_between_two_and_two(
    monkeypatch, here, there, named, tied
):
    """A tool that was dragged: two frictions, or half of a drive's force and a lighter
    sled, do the same but where it sets out."""
    it = problem(4.0)
    selection = select(it)
    was = {c.effect.kind for c in selection.choices}

    def outcome(effects, *of, jobs=1):
        left = here if {e.kind for e in effects} == was else there
        return Outcome(GapMeasure(20.0, left, 1.0, 0.6))

    monkeypatch.setattr(it, "outcome", outcome)
    monkeypatch.setattr(it, "plan", replace(it.plan, simulation_agrees=True))
    before = outcome(selection.effects())
    after, _ = preferred_by_simulation(it, selection, before, 1)
    now = {c.effect.kind for c in after.choices}
    assert (now != was) == (named == "instead") and len(now) == 2
    assert any(c.sets for c in after.choices) == tied
    assert all(c.std and abs(c.margin) < 0.05 for c in after.choices if now != was)

"""Forward selection: step by step, all at once, and parameters that are added later."""

import numpy as np
import pytest
from test_gap_statistics import TwoChannels

from makebreak.gap.problem import Candidate, SearchPlan
from makebreak.gap.search.all_at_once import all_at_once
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.select import select
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect


class Columns(TwoChannels):
    """Candidates that are columns: {(kind, place): (600, k)}, of which the residual is
    a sum, with noise of 1."""

    plan = SearchPlan(least_gain=0.1, most_effects=2)

    def __init__(self, of, hidden):
        self._channel, self._block = np.zeros(600, int), np.arange(600) // 20
        self.of = of
        self._base = np.random.default_rng(0).normal(size=600)
        for key, values in hidden.items():
            self._base += of[key] @ np.atleast_1d(values)

    def residual(self, effects=()):
        r = np.array(self._base)
        for each in effects:
            r -= self.of[each.kind, each.at[0]] @ list(each.parameters.values())
        return r

    def candidates(self, nuisances, current):
        return [
            Candidate(
                kind, (at,), columns.shape[1], (columns,),
                (
                    lambda c, kind=kind: {
                        p.name: float(x)
                        for p, x in zip(KINDS[kind].parameters, c, strict=False)
                    },
                ),
            )
            for (kind, at), columns in self.of.items()
        ]  # fmt: skip


def directions(n):
    """(600, n) columns of rms 10, perpendicular to each other."""
    q, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(600, n)))
    return 10.0 * q * np.sqrt(600.0)


MASS, FRICTION = "link_mass", "joint_coulomb_friction"
TRUTH = {(MASS, "arm.hand"): 4.0, (FRICTION, "arm.joint6"): 1.2}


def where_a_mass_is(like_friction, wrong):
    """A hand that is missing, and friction. A mass at the wrist takes off what the hand
    does and a part of what friction does, and adds something else."""
    hand, friction, more = directions(3).T
    of = {
        (MASS, "arm.wrist"): hand + like_friction * friction + wrong * more,
        (MASS, "arm.hand"): hand,
        (FRICTION, "arm.joint6"): friction,
    }
    return Columns({key: column[:, None] for key, column in of.items()}, TRUTH)


def named(problem):
    return {(c.effect.kind, c.effect.at[0]): c for c in select(problem).choices}


def test_rows_are_weighed_in_the_end_by_what_is_named(monkeypatch):
    """And not as with an effect that was dropped."""
    problem = where_a_mass_is(0.0, wrong=0.02)
    weighed: list[set] = []

    def reweigh(fitted):
        weighed.append({(e.kind, e.at[0]) for e in fitted.effects})
        return False

    def without_last(search, chosen, current):
        return chosen[:-1], search.refit(chosen[:-1], current)

    problem.reweigh = reweigh
    monkeypatch.setattr("makebreak.gap.search.select.keep_certain", without_last)
    found = named(problem)
    assert len(found) == 1 and weighed[-1] == set(found)


def test_progress_is_said_after_the_last_effect_was_added_too():
    """Whether each effect is needed, and whether a tie is still one, are fits as well,
    which take most of the time where an arm has many contacts."""
    problem = where_a_mass_is(0.0, wrong=0.02)
    problem._base += 3.0 * np.random.default_rng(2).normal(size=600)
    said: list[str] = []
    select(problem, said.append)
    for words in ("  without joint_coulomb_friction at arm.joint6", ", as a tie: "):
        assert any(words in text for text in said), words


JOINT = ["arm.joint6"]


class OfAJoint(Columns):
    """A joint with friction, damping and a rotor that the model lacks; a bias does most
    of what all three do together. `at_once`: kinds from which a search may start."""

    plan = SearchPlan(least_gain=0.1, most_effects=2)

    def __init__(self, hidden, at_once):
        *three, more = directions(4).T
        self.at_once = at_once
        kinds = ("joint_coulomb_friction", "joint_viscous_damping", "rotor_inertia")
        of = {(k, *JOINT): x[:, None] for k, x in zip(kinds, three, strict=True)}
        of["actuator_bias", JOINT[0]] = (sum(three) + 0.3 * more)[:, None]
        super().__init__(of, {(kind, *JOINT): x for kind, x in hidden.items()})

    def rich(self):
        return [
            Effect(kind, JOINT, {KINDS[kind].parameters[0].name: 0.1})
            for kind in self.at_once
        ]


ALL = {"joint_coulomb_friction": 1.0, "joint_viscous_damping": 1.2, "rotor_inertia": 1}


def test_effects_that_another_one_stands_for_are_found_when_fitted_at_once():
    found = named(OfAJoint(ALL, list(ALL)))
    assert {kind for kind, _ in found} == set(ALL)
    for (kind, _), choice in found.items():
        (value,) = choice.effect.parameters.values()
        assert value == pytest.approx(ALL[kind], abs=0.02)
    # One after another the bias is added first, and two more are not enough.
    assert "actuator_bias" in {kind for kind, _ in named(OfAJoint(ALL, []))}


def test_of_what_is_fitted_at_once_only_what_is_needed_stays():
    hidden = dict(list(ALL.items())[:2])
    search = Comparison(OfAJoint(hidden, list(ALL)), lambda text: None)
    choices, fitted = all_at_once(search)
    assert {c.effect.kind for c in choices} == set(hidden)
    assert fitted.score == pytest.approx(1.0, abs=0.1)
    assert all_at_once(Comparison(OfAJoint({}, list(ALL)), print))[0] == []


class WideLoad(Columns):
    """A load whose extent k adds k^2 times a further column."""

    plan = SearchPlan(least_gain=0.1, most_effects=3)

    def __init__(self, extent: float, heavier: str = "arm.wrist"):
        *load, self.wide, other = directions(6).T
        hand, link = ("payload", "arm.hand"), (MASS, heavier)
        # A heavier wrist does nearly what the extent does, a heavier hand all but what
        # the place of the load does.
        mass = self.wide + (load[0] if heavier == "arm.hand" else 0.3 * other)
        columns = {hand: np.stack(load, axis=1), link: mass[:, None]}
        super().__init__(columns, {hand: (0.8, 0.05, 0.04, 0.15)})
        self._base += 100.0 * extent**2 * self.wide

    def residual(self, effects=()):
        r = np.array(self._base)
        for each in effects:
            values = dict(each.parameters)
            k = values.pop("gyration_radius", 0.0)
            r -= self.of[each.kind, each.at[0]] @ list(values.values())
            r -= 100.0 * k**2 * self.wide
        return r


def test_a_load_gets_a_size_before_another_effect_stands_for_it():
    (choice,) = select(WideLoad(0.09)).choices
    assert choice.effect.kind == "payload" and choice.size == 5
    found = choice.effect.parameters
    assert found["gyration_radius"] == pytest.approx(0.09, abs=0.002)
    assert found["mass"] == pytest.approx(0.8, abs=0.02)
    assert 0.0 < choice.std["gyration_radius"] < 0.002


def test_a_load_with_a_size_takes_the_place_of_a_heavier_link():
    (choice,) = select(WideLoad(0.09, "arm.hand")).choices
    assert choice.effect.kind == "payload" and choice.size == 5
    assert choice.effect.parameters["mass"] == pytest.approx(0.8, abs=0.02)
    assert choice.runner_up == f"{MASS} at arm.hand"
    # By how much more the heavier link leaves; with one as good it would be zero.
    assert choice.margin == pytest.approx(0.97, abs=0.1)


def test_a_load_without_a_size_that_shows_is_a_point_mass():
    (choice,) = select(WideLoad(0.01)).choices
    assert "gyration_radius" not in choice.effect.parameters

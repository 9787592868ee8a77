"""What data held out for the report do to the effects that a search has chosen."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_gap_forward import Columns, directions

from makebreak.gap.confirm import acts_on, confirmed, is_worse, judge_of
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Nuisances, Outcome
from makebreak.gap.result import GapMeasure, InUnits
from makebreak.gap.search import drop
from makebreak.gap.search.choice import Choice, Selection, is_sure
from makebreak.gap.search.chosen_by_simulation import above_step
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.drop import drop_needless, with_errors
from makebreak.gap.verdict import Facts, decide, too_weak
from makebreak.gap.workflow import _withdrawn
from makebreak.models.effects.kind import Effect

KIND, JOINTS = "joint_coulomb_friction", ("arm.j1", "arm.j2", "arm.j3")


class Held(Columns):
    """Frictions at three joints, each with a column of its own, and what held-out
    windows show at each joint with and without them: {joint: (without, with)}."""

    def __init__(self, shown, tie: float | None = None):
        columns = directions(3).T[:, :, None]
        of = {(KIND, j): x for j, x in zip(JOINTS, columns, strict=True)}
        super().__init__(of, {key: 4.0 for key in of})
        self.shown, self.tie, self.calls = shown, tie, 0

    def outcome(self, effects, start, end, nuisances, recordings=None, jobs=1):
        self.calls += 1
        there = {at for e in effects for at in e.at}
        per, windows = {}, {}
        for joint, (without, with_) in self.shown.items():
            after = with_ if joint in there else without
            if any(e.kind != KIND for e in effects):
                after = self.tie if self.tie is not None else after
            per[f"{joint}.position"] = {"before": without, "after": after}
            squares = np.array([[without**2] * 9, [after**2] * 9])
            windows[f"{joint}.position"] = np.stack([squares, squares])
        a, b = (
            float(np.sqrt(np.mean([p[when] ** 2 for p in per.values()])))
            for when in ("before", "after")
        )
        gap = GapMeasure(a, b, 1.0, 0.3, per, n_windows=9, by_window=windows)
        return Outcome(gap)


def selection_of(problem: Held, joints=JOINTS, **more) -> Selection:
    effects = [Effect(KIND, [j], {"coulomb": 4.0}) for j in joints]
    none = problem.nuisances()
    screen = Screen(problem.base(), none.columns, none.prior, problem.train())
    start, end = (fit_effects(problem, screen, e) for e in ([], effects))
    choices = tuple(
        Choice(e, s, 9.0, 1.0, "", 1.0, (), (), 1, in_group=True, **more)
        for e, s in zip(end.effects, end.std, strict=True)
    )
    return Selection(choices, start, end, none)


def confirm(problem: Held, selection: Selection):
    return confirmed(problem, selection, judge_of(problem, ["held out"]))


def test_a_selection_is_simulated_once_however_often_it_is_asked_for():
    """A run asks again after each veto; a simulation takes most of its time."""
    problem = Held({"arm.j1": (9.0, 1.0), "arm.j2": (4.8, 8.6), "arm.j3": (9.0, 1.0)})
    judge = judge_of(problem, ["held out"])
    found = confirmed(problem, selection_of(problem), judge)
    calls = problem.calls
    again = confirmed(problem, found.selection, judge)
    assert again.outcome is found.outcome and problem.calls == calls
    fewer = replace(found.selection, choices=found.selection.choices[:1])
    assert judge(fewer).gap.after > found.outcome.gap.after
    assert problem.calls == calls + 1


@pytest.mark.parametrize("seed", range(30))
def test_what_stays_makes_held_out_data_no_worse_as_a_whole_and_at_each_joint(seed):
    rng = np.random.default_rng(seed)
    shown = {j: tuple(np.exp(rng.uniform(0.0, 3.0, 2))) for j in JOINTS}
    problem = Held(shown)
    found = confirm(problem, selection_of(problem))
    gap, stays = found.outcome.gap, found.selection.effects()
    # The figures are those of what stays, and nothing is lost on the way.
    again = problem.outcome(stays, None, None, None)
    assert (gap.before, gap.after) == (again.gap.before, again.gap.after)
    assert len(stays) + len(found.vetoed) == 3
    assert found.selection.end.effects == tuple(stays)
    # A twentieth is chance, and 1.15 times the noise is no error.
    assert gap.after <= 1.05 * max(gap.before, 1.15)
    for effect in stays:
        without, with_ = shown[effect.at[0]]
        assert with_ <= 1.05 * max(without, 1.15)
    for choice, why in found.vetoed:
        assert why and "nan" not in why and "inf" not in why
        without, with_ = shown[choice.effect.at[0]]
        assert with_ > without or gap.reduction < 0.5


def test_one_joint_of_a_group_goes_and_the_others_stay():
    problem = Held({"arm.j1": (9.0, 1.0), "arm.j2": (4.8, 8.6), "arm.j3": (9.0, 1.0)})
    found = confirm(problem, selection_of(problem))
    assert [e.at for e in found.selection.effects()] == [["arm.j1"], ["arm.j3"]]
    ((choice, why),) = found.vetoed
    assert choice.effect.at == ["arm.j2"] and "from 4.8 to 8.6" in why


def test_what_closes_half_of_its_own_joints_gap_is_confirmed_beside_a_larger_one():
    problem = Held({"arm.j1": (9.0, 1.0), "arm.j2": (20.0, 19.0), "arm.j3": (9.0, 8.0)})
    found = confirm(problem, selection_of(problem))
    assert found.outcome.gap.reduction < 0.5
    assert [e.at for e in found.selection.effects()] == [["arm.j1"]]
    assert [c.effect.at for c, _ in found.vetoed] == [["arm.j2"], ["arm.j3"]]


@pytest.mark.parametrize("others, gone", [(2.0, ["arm.j2"]), (18.0, [])])
def test_of_a_group_goes_what_is_needless_unless_other_joints_are_worse_without(
    others, gone
):
    """j2 is better without the group, but j1 is not; `others`: its error where j2 alone
    goes without."""
    every = {j: Effect(KIND, [j], {"coulomb": 4.0}) for j in JOINTS}

    def judge(some):
        there = {at for e in some.effects() for at in e.at}
        after = {"arm.j1": 18.0 if "arm.j1" not in there else 2.0, "arm.j2": 3.9,
                 "arm.j3": 2.0 if "arm.j3" in there else 9.0}  # fmt: skip
        if "arm.j2" not in there:
            after |= {"arm.j2": 3.4, "arm.j1": max(others, after["arm.j1"])}
        shown = Held({j: (20.0, x) for j, x in after.items()})
        return shown.outcome(list(every.values()), None, None, None)

    problem = Held({j: (20.0, 2.0) for j in JOINTS})
    selection = selection_of(problem)
    *group, alone = selection.choices
    choices = (*group, replace(alone, in_group=False))
    found = confirmed(problem, replace(selection, choices=choices), judge)
    assert [c.effect.at[0] for c, _ in found.vetoed] == gone
    assert all("from 3.4 to 3.9" in why for _, why in found.vetoed)


def test_a_joint_s_own_equation_vetoes_too():
    class WithEquations(Held):
        def outcome(self, effects, *of, **more):
            found = super().outcome(effects, *of, **more)
            there = any("arm.j2" in e.at for e in effects)
            of_j2 = InUnits("N m", 4.8, 8.6 if there else 4.8, 0.1)
            return replace(
                found, gap=replace(found.gap, equations={"arm.j2.effort": of_j2})
            )

    problem = WithEquations(
        {"arm.j1": (9.0, 1.0), "arm.j2": (2.0, 1.9), "arm.j3": (9.0, 1.0)}
    )
    found = confirm(problem, selection_of(problem))
    ((choice, why),) = found.vetoed
    assert choice.effect.at == ["arm.j2"] and "4.8 to 8.6 N m" in why


@pytest.mark.parametrize("with_tie, kept", [(38.0, False), (1.1, True)])
def test_a_tie_that_leaves_the_gap_in_simulation_is_none(with_tie, kept):
    problem = Held({j: (40.0, 1.0) for j in JOINTS[:1]}, tie=with_tie)
    tie = Effect("actuator_bias", ["arm.j1"], {"bias": 1.0})
    selection = selection_of(problem, JOINTS[:1])
    (choice,) = selection.choices
    tied = replace(selection, choices=(replace(choice, ties=(tie,)),))
    (choice,) = confirm(problem, tied).selection.choices
    assert bool(choice.ties) == kept


def test_a_little_more_in_every_window_is_worse_and_in_some_is_chance():
    rng = np.random.default_rng(0)
    before = 4.0 + rng.normal(size=40) * 0.1
    surely, maybe = before + 0.1, before + rng.normal(size=40)
    maybe += np.mean(before) + 0.1 - np.mean(maybe)
    assert is_worse(2.0, 2.02, np.stack([before, surely]))
    assert not is_worse(2.0, 2.02, np.stack([before, maybe]))
    few = np.stack([before, surely + 0.01 * rng.normal(size=40)])
    assert is_worse(2.0, 2.02, few[:, :5]) and not is_worse(2.0, 2.02, few[:, :2])
    # Two windows, or copies of one, have no scatter to set a difference beside.
    assert not is_worse(2.0, 2.02, np.array([[4.0, 4.0], [4.08, 4.08001]]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not is_worse(2.0, 2.02, np.array([[4.0] * 9, [4.08] * 9]))
    assert is_worse(2.0, 2.2)
    assert not is_worse(0.6, 1.1)  # What a right model may leave.


def test_an_effect_acts_on_its_joint_its_model_and_its_pair():
    problem = Held({})
    for at, place, acts in (
        ("arm.j1", "arm.j1", True), ("arm.j1", "arm.j10", False),
        ("arm.j1.velocity", "arm.j1", True), ("arm", "arm.j2", True),
        ("a.a~b.b", "b.b", True), ("world", "arm.j1", True),
    ):  # fmt: skip
        assert acts_on(problem, Effect(KIND, [at]), place) == acts


def test_a_simulation_that_stopped_is_no_evidence():
    stopped = GapMeasure(np.nan, np.nan, 1.0, 0.0, failure="It stopped: why.")
    facts = Facts((), 1.0, 1.0, chosen_on=stopped, asks_simulation=True)
    assert decide(facts)[0] == "not_judged"
    assert decide(replace(facts, asks_simulation=False))[0] == "no_gap"


@pytest.mark.parametrize(
    ("in_simulation", "in_equations", "why"),
    [
        (0.3, 0.9, "It closes 30% of the gap, too little to be named."),
        (0.9, 0.3, "It closes 30% of the gap, too little to be named."),
        (0.9, 0.9, ""),
        # Three quarters of what is left at the effect's own joint.
        (0.3, 0.9, "own"),
    ],
)
def test_half_of_the_gap_must_be_closed_in_simulation_and_in_equations(
    in_simulation, in_equations, why
):
    effect = Effect(KIND, ["arm.j1"], {"coulomb": 4.0})
    choice = Choice(effect, {}, 9.0, 1.0, "", 1.0, (), (), 1)
    shown = GapMeasure(11.0, 11.0 - 10.0 * in_simulation, 1.0, 0.3)
    shown = replace(
        shown, per_channel={"arm.j1.position": {"before": 9.0, "after": 3.0}}
    )
    facts = Facts((choice,), 11.0, 8.0, far=True, chosen_on=shown)
    assert decide(facts)[0] == "gap_unnamed"
    weak = too_weak(facts, in_equations, lambda c, channel: why == "own")
    assert weak == ([(choice, why)] if why not in ("", "own") else [])


@pytest.mark.parametrize(
    ("step", "kept"),
    [
        ({}, JOINTS),  # A continuous plant errs by nothing.
        # Windows of the joint itself: sqrt(1.2^2 - 1) = 0.66 for the second one, and
        # 0.50 for the third; without the first one they are 1.9 times off.
        (dict.fromkeys(JOINTS, 0.4), JOINTS),
        (dict.fromkeys(JOINTS, 0.6), JOINTS[:2]),
        (dict.fromkeys(JOINTS, 5.0), JOINTS[:1]),
        # What it errs by at other joints says nothing of these.
        ({"arm.j1": 5.0}, JOINTS),
    ],
)
def test_what_moves_windows_less_than_the_scenes_step_is_not_named(step, kept):
    problem = Held({"arm.j1": (3.0, 1.0), "arm.j2": (1.2, 1.0), "arm.j3": (1.12, 1.0)})
    step = {f"{joint}.position": by for joint, by in step.items()}
    selection = selection_of(problem)
    outcome = problem.outcome(selection.effects(), None, None, None)
    # A group is one: without it windows are off.
    assert above_step(problem, selection, outcome, step, 1)[0] is selection
    alone = tuple(replace(c, in_group=False) for c in selection.choices)
    selection = replace(selection, choices=alone)
    left, after, small, below = above_step(problem, selection, outcome, step, 1)
    assert tuple(c.effect.at[0] for c in left.choices) == kept
    assert [c.effect.at[0] for c, _ in small] == [*reversed(JOINTS[len(kept) :])]
    assert all("time step" in why for _, why in small)
    if small:
        assert below == pytest.approx(problem.error(selection.end))
        assert below < problem.error(left.end)
        shown = problem.outcome(left.effects(), None, None, None).gap
        assert after is not None and after.gap.after == pytest.approx(shown.after)
    else:
        assert below == np.inf


@pytest.mark.parametrize(("alone", "kept"), [(1.02, []), (9.0, JOINTS[:1])])
def test_what_others_stand_in_for_is_named_where_it_moves_windows(alone, kept):
    """An encoder's zero, in whose place links within their tolerance leave as little:
    with all else as it was fitted windows are far off without it."""

    class StoodIn(Held):
        def outcome(self, effects, start, end, nuisances, recordings=None, jobs=1):
            there, fitted = (len(list(x)) for x in (effects, end.effects))
            after = alone if there < fitted else 1.0
            per = {"arm.j1.position": {"before": 9.0, "after": after}}
            return Outcome(GapMeasure(9.0, after, 1.0, 0.3, per))

    problem = StoodIn({"arm.j1": (9.0, 1.0)})
    selection = selection_of(problem, JOINTS[:1])
    selection = replace(
        selection, choices=(replace(selection.choices[0], in_group=False),)
    )
    outcome = problem.outcome(selection.effects(), None, selection.end, None)
    left, *_ = above_step(problem, selection, outcome, {"arm.j1.position": 3.0}, 1)
    assert [c.effect.at[0] for c in left.choices] == [*kept]


def test_where_no_window_can_be_simulated_without_an_effect_all_others_stay():
    """Of two effects that move windows as little."""

    class Stops(Held):
        def outcome(self, effects, start, end, nuisances, recordings=None, jobs=1):
            there = [e.at[0] for e in effects]
            fitted = there == [e.at[0] for e in end.effects]
            after = np.nan if fitted and there == [JOINTS[0]] else 1.0
            per = {"arm.j1.position": {"before": 1.2, "after": after}}
            return Outcome(GapMeasure(1.2, after, 1.0, 0.3, per))

    problem = Stops({"arm.j1": (1.2, 1.0), "arm.j2": (1.2, 1.0)})
    selection = selection_of(problem, JOINTS[:2])
    alone = tuple(replace(c, in_group=False) for c in selection.choices)
    selection = replace(selection, choices=alone)
    outcome = problem.outcome(selection.effects(), None, selection.end, None)
    left, *_ = above_step(problem, selection, outcome, {"arm.j1.position": 3.0}, 1)
    assert left is selection


def test_where_no_window_can_be_simulated_with_an_effect_the_step_says_nothing():
    problem = Held({"arm.j1": (3.0, 1.0)})
    selection = selection_of(problem, JOINTS[:1])
    nothing = Outcome(GapMeasure(3.0, 1.0, 1.0, 0.3))
    step = {"arm.j1.position": 5.0}
    left, after, small, _ = above_step(problem, selection, nothing, step, 1)
    assert left is selection and after is nothing and not small


def test_nothing_is_simulated_for_the_step_where_no_window_was_measured(monkeypatch):
    problem = Held({"arm.j1": (3.0, 1.0)})
    selection = selection_of(problem)
    nothing = Outcome(GapMeasure(np.nan, np.nan, 1.0, 0.0))
    assert not nothing.gap.is_measured
    monkeypatch.setattr(problem, "outcome", lambda *_, **__: pytest.fail("simulated"))
    left, after, small, _ = above_step(
        problem, selection, nothing, {"arm.j1.position": 5.0}, 1
    )
    assert left is selection and after is nothing and not small


def test_what_the_scenes_step_errs_by_is_no_gap():
    """Where windows agree, equations may show the world's own step, and no more."""
    agrees = GapMeasure(0.9, 0.9, 1.0, 0.3)
    facts = Facts((), 2.4, 2.4, chosen_on=agrees)
    assert decide(facts)[0] == "gap_unnamed"
    assert decide(replace(facts, below=1.2))[0] == "no_gap"
    assert decide(replace(facts, below=2.2))[0] == "gap_unnamed"
    assert decide(replace(facts, below=1.2, far=True))[0] == "gap_unnamed"


def test_why_an_effect_goes_is_said_by_what_it_makes_worse():
    """Windows get worse at a joint that nothing acts at; equations say the reverse."""

    class Elsewhere(Held):
        def outcome(self, effects, *of, **more):
            after = 1.4 if effects else 1.05
            per = {"arm.j9.position": {"before": 1.05, "after": after}}
            both = (5.9, 0.7 if effects else 5.9)
            gap = GapMeasure(1.05, after, 1.0, 0.3, per, n_windows=9, in_equations=both)
            return Outcome(gap)

    problem = Elsewhere({})
    found = confirm(problem, selection_of(problem))
    assert found.vetoed and not found.selection.choices
    assert all("simulated error from 1.05 to 1.4" in why for _, why in found.vetoed)


def test_what_an_effect_explains_is_asked_beside_all_that_stays():
    """The figures of the report: errors with all effects, and without each."""
    problem = Held({j: (9.0, 1.0) for j in JOINTS})
    stale = selection_of(problem)
    selection = with_errors(problem, stale)
    screen = selection.screen(problem)
    assert {c.after for c in selection.choices} == {stale.end.score}
    for k, choice in enumerate(selection.choices):
        rest = [e for i, e in enumerate(selection.effects()) if i != k]
        exact = fit_effects(problem, screen, rest).score
        assert choice.before == pytest.approx(exact, rel=1e-6) and exact > choice.after


def test_needless_effects_do_not_go_together_where_nuisances_cannot_be_so_far_off():
    """Each of two is within what a nuisance may be; both of these together are not."""

    class Nuisanced(Held):
        def nuisances(self):
            own = [self.of[KIND, joint][:, 0] for joint in JOINTS[1:]]
            return Nuisances(np.stack(own, axis=1), np.full(2, 1.25), ("one", "two"))

    problem = Nuisanced({j: (9.0, 1.0) for j in JOINTS})
    selection = selection_of(problem)
    search = Comparison(problem, lambda text: None)
    chosen, fitted = drop_needless(search, list(selection.choices), selection.end)
    assert [c.effect.at[0] for c in chosen][:1] == [JOINTS[0]] and len(chosen) == 2
    assert not search.is_strained(fitted)


@pytest.mark.parametrize("std, sure", [(30.0, False), (15.0, True), (np.inf, False)])
def test_a_number_that_is_three_deviations_off_what_says_nothing_is_sure(std, sure):
    """Below the noise nothing but the fit speaks for an effect."""
    parameters = {"stiffness": 53.0, "damping": 0.3}
    effect = Effect("joint_elasticity", ["arm.j1"], parameters)
    choice = Choice(
        effect, {"stiffness": std, "damping": 2.0}, 1.0, 0.99, "", 1.0, (), (), 1
    )
    assert is_sure(choice) == sure
    problem = SimpleNamespace(other_gravity=lambda end: ("", False), by_equations=False)
    selection = Selection((choice,), None, None, Nuisances.none(1), [])
    facts = Facts(
        (choice,), 1.0, 0.99, far=False, chosen_on=GapMeasure(1.0, 0.99, 1.0, 0.3)
    )
    found = _withdrawn(problem, selection, facts)
    assert [c for c, _ in found] == ([] if sure else [choice])
    loud = replace(facts, start=9.0, chosen_on=GapMeasure(9.0, 0.99, 1.0, 0.3))
    assert not _withdrawn(problem, selection, loud)


@pytest.mark.parametrize("alone, kept", [(1.0, "spring"), (3.9, None)])
def test_of_two_that_stand_for_each_other_one_is_asked_again(monkeypatch, alone, kept):
    """Without both much is left; without either of them nothing, or as much."""
    friction, bias, spring = (
        Choice(Effect(kind, ["arm.j1"], {}), {}, 9.0, 1.0, "", 1.0, (), (), 1)
        for kind in (KIND, "actuator_bias", "joint_spring")
    )
    left = {(2,): 1.1 * alone, (1,): alone, (1, 2): 4.0}
    monkeypatch.setattr(
        drop, "_by_columns", lambda *args: (left[tuple(args[-1])], None)
    )
    search = SimpleNamespace(
        slopes=lambda chosen, current: None, error=lambda score: score, problem=None,
        plan=SimpleNamespace(least_gain=0.1),
    )  # fmt: skip
    chosen = [friction, bias, spring]
    found = drop._with_the_most_needed(search, chosen, None, [friction])
    assert found == ([friction, spring] if kept else [friction])

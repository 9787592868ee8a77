"""Steps by the blocks of time in which columns are right, and candidates by simulation
(gap/numerics/agreed_step.py, gap/search/by_simulation.py)."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from makebreak.gap.fit import MOST_FREE, fit_effects, search_by_blocks
from makebreak.gap.numerics.agreed_step import agreed_step
from makebreak.gap.problem import GapProblem, Nuisances, SearchPlan, rms
from makebreak.gap.residuals.impacts import candidates_of
from makebreak.gap.search import add, trials
from makebreak.gap.search.by_simulation import ranked_by_simulation
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.rivals import Rivals
from makebreak.gap.search.screen import rank
from makebreak.gap.search.select import select
from makebreak.gap.search.trials import fit_each
from makebreak.gap.thresholds import (
    BESIDE_NOISE_EVIDENCE,
    EVIDENCE_MIN,
    NOISE_RMS_MAX,
)
from makebreak.models.effects.kind import Effect

ROWS, BLOCKS = 200, 9


def blocks() -> np.ndarray:
    return np.repeat(np.arange(BLOCKS), ROWS)


@pytest.mark.parametrize("seed", range(5))
def test_all_blocks_are_fitted_where_columns_are_right(seed):
    """Least squares of all rows (an independent solver) is what comes out."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(ROWS * BLOCKS, 3)) * [1.0, 1e-6, 1e4]
    r = X @ [2.0, -3e6, 1e-4] + 0.1 * rng.normal(size=len(X))
    c, gained = agreed_step(X, r, blocks())
    exact = np.linalg.lstsq(X, r, rcond=None)[0]
    np.testing.assert_allclose(c, exact, rtol=1e-4)
    assert gained == pytest.approx(np.sum(r**2) - np.sum((r - X @ exact) ** 2))


@pytest.mark.parametrize("seed", range(5))
def test_blocks_that_bend_do_not_count(seed):
    """In a third of the blocks columns are fifty times as large as the change that they
    stand for, and point elsewhere: least squares finds next to nothing there."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(ROWS * BLOCKS, 2))
    r = X @ [1.5, -0.5] + 0.1 * rng.normal(size=len(X))
    bent = blocks() % 3 == 0
    X[bent] = 50.0 * rng.normal(size=(bent.sum(), 2))
    c, _ = agreed_step(X, r, blocks())
    assert np.abs(np.linalg.lstsq(X, r, rcond=None)[0]).max() < 0.2
    np.testing.assert_allclose(c, [1.5, -0.5], atol=0.05)


def test_what_does_not_show_does_not_move():
    r = np.ones(ROWS * BLOCKS)
    c, gained = agreed_step(np.zeros((len(r), 2)), r, blocks())
    assert gained == 0.0 and not c.any()


class Bends(GapProblem):
    """Two joints' dampings: a third of the blocks is far from linear in a joint's own,
    of which one (`a`) is hidden. size: of that, over the noise of a row."""

    plan = SearchPlan(jumps=True, least_gain=0.05, counts_evidence=True)
    by_equations = False
    sizes = None
    dynamics = SimpleNamespace(
        now=lambda kind, at: {"damping": 0.0}, least=lambda kind, at: {}
    )
    joints = "ab"

    def __init__(self, size: float, hidden: float = 2.0):
        self.hidden, rng = hidden, np.random.default_rng(1)
        self.X = size * rng.normal(size=(2, ROWS * BLOCKS))
        self.bent = self.blocks() % 3 == 0
        self._noise = rng.normal(size=ROWS * BLOCKS)

    def residual(self, effects=()):
        there = {e.at[0]: e.parameters["damping"] for e in effects}
        r = np.array(self._noise)
        for joint, x, true in zip(self.joints, self.X, (self.hidden, 0.0), strict=True):
            off = true - there.get(joint, 0.0)
            r += x * np.where(self.bent, np.sin(40.0 * off), off)
        return r

    def base(self):
        return self.residual()

    def train(self):
        return self.blocks() % 4 != 1

    def blocks(self):
        return blocks()

    def channel_of_rows(self):
        return np.zeros(ROWS * BLOCKS, int)

    def nuisances(self):
        return Nuisances.none(ROWS * BLOCKS)

    def candidates(self, nuisances, current):
        kind, name, step = "joint_viscous_damping", "damping", 0.01
        return candidates_of(
            self,
            [(kind, joint, name, [(step, step)]) for joint in self.joints],
            current,
        )

    def least(self, kind, at):
        return {}

    def where(self, left):
        return []

    def outcome(self, *_, **__):
        return None


def ranked_of(problem: Bends):
    search = Comparison(problem, lambda text: None)
    screen = search.screen(search.start.r)
    found = rank(screen, problem.candidates(search.nuisances, search.start))
    return (
        search,
        screen,
        found,
        ranked_by_simulation(search, screen, found, (), search.start),
    )


def test_candidates_are_ranked_by_what_simulations_leave():
    """Below the noise of a row: columns, of which the bent third decides, take nothing
    off; simulated at the size that the other blocks ask for, the right one has evidence
    beyond doubt and the other has none."""
    problem = Bends(0.22)
    assert rms(problem.base()) < NOISE_RMS_MAX
    search, screen, by_columns, by_simulation = ranked_of(problem)
    assert all(search.evidence_of(screen, r.columns) < EVIDENCE_MIN for r in by_columns)
    (most, best), (least, _) = by_simulation
    assert best.candidate.at == ("a",) and most > BESIDE_NOISE_EVIDENCE
    assert least < EVIDENCE_MIN
    assert best.effects[0].parameters["damping"] == pytest.approx(2.0, abs=0.4)


def test_what_is_below_the_noise_is_named_by_evidence_alone(monkeypatch):
    """And the best are searched by blocks, as they are above the noise."""
    problem, searched = Bends(0.2), []
    search = Comparison(problem, lambda text: None)
    assert not search.needs_more(search.start)
    monkeypatch.setattr(
        trials, "search_by_blocks",
        lambda *args: searched.append(args) or search_by_blocks(*args),
    )  # fmt: skip
    chosen = select(problem).choices
    assert [c.effect.at for c in chosen] == [["a"]]
    assert chosen[0].effect.parameters["damping"] == pytest.approx(2.0, abs=0.4)
    assert searched


def test_a_size_that_does_well_is_doubled_while_that_does_better():
    """What a column says is a quarter of what is hidden."""
    problem = Bends(3.0)
    plain, problem.bent = problem.residual, np.zeros(ROWS * BLOCKS, bool)
    asked = []

    def residual(effects=()):
        asked.append([e.parameters["damping"] for e in effects])
        return plain(effects)

    problem.residual = residual
    search = Comparison(problem, lambda text: None)
    screen = search.screen(search.start.r)
    (first, *_) = rank(screen, problem.candidates(search.nuisances, search.start))
    column = 4.0 * first.columns
    less = replace(
        first, candidate=replace(first.candidate, columns=(column,)),
        fit=replace(first.fit, c=first.fit.c / 4.0),
    )  # fmt: skip
    asked.clear()
    ((_, found), *_) = ranked_by_simulation(search, screen, [less], (), search.start)
    assert found.effects[0].parameters["damping"] == pytest.approx(2.0, abs=0.1)
    assert max(x for (x,) in asked) == pytest.approx(4.0, abs=0.2)


def test_nothing_is_named_where_nothing_is_hidden():
    problem = Bends(0.25, hidden=0.0)
    assert not select(problem).choices


def test_a_search_by_blocks_goes_where_slopes_mislead():
    problem = Bends(5.0)
    search = Comparison(problem, lambda text: None)
    start = [Effect("joint_viscous_damping", ["a"], {"damping": 0.3})]
    screen = search.screen(search.start.r)
    stuck = fit_effects(problem, screen, start).effects[0].parameters["damping"]
    assert abs(stuck - 2.0) > 0.5
    (found,) = search_by_blocks(problem, screen, start, [()]) or ()
    assert found.parameters["damping"] == pytest.approx(2.0, abs=0.02)


def test_of_many_parameters_no_search_is_made():
    problem = Bends(5.0)
    screen = Comparison(problem, lambda text: None).screen(problem.base())
    many = [
        Effect("joint_viscous_damping", [f"j{k}"], {"damping": 0.1})
        for k in range(MOST_FREE + 1)
    ]
    assert search_by_blocks(problem, screen, many, [()] * len(many)) is None


def test_many_parameters_are_not_fitted_after_few_that_leave_clearly_less():
    """One joint leaves the noise; what has many parameters, and leaves ten times as
    much by what is known of it, is not simulated again."""
    problem = Bends(5.0)
    search, screen, found, _ = ranked_of(problem)
    good = replace(
        found[0],
        effects=(Effect("joint_viscous_damping", ["a"], {"damping": 1.99}),),
        fit=replace(found[0].fit, score=1.2),
    )
    many = replace(
        found[1], candidate=replace(found[1].candidate, size=MOST_FREE + 1),
        fit=replace(found[1].fit, score=10.0),
    )  # fmt: skip
    few = replace(many, candidate=replace(many.candidate, size=1))
    asked = []
    problem_residual = problem.residual
    problem.residual = lambda effects=(): (
        asked.append([e.at[0] for e in effects]), problem_residual(effects)
    )[1]  # fmt: skip
    fit_each(search, screen, (), [good, many])
    assert ["b"] not in asked
    fit_each(search, screen, (), [good, few])
    assert ["b"] in asked


@pytest.mark.parametrize("counts", [True, False])
def test_nothing_is_added_where_groups_lose_all_members(counts, monkeypatch):
    """What ranks candidates may leave none."""
    problem = Bends(5.0)
    problem.plan = replace(problem.plan, counts_evidence=counts)
    monkeypatch.setattr(add, "with_pruned_groups", lambda *args: [])
    search = Comparison(problem, lambda text: None)
    found = problem.candidates(search.nuisances, search.start)
    step = add.add_next(search, Rivals(search), found, (), search.start)
    assert step.fitted is None and not step.added

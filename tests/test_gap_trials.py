"""Candidates of one parameter, by what a trial of it does to simulated windows."""

from types import SimpleNamespace

import numpy as np
import pytest

from makebreak.gap.problem import SearchPlan
from makebreak.gap.residuals.impacts import candidates_of
from makebreak.gap.residuals.in_mujoco import MujocoProblem, _by_parabola
from makebreak.gap.search.trials import pick_simplest
from makebreak.models.effects.kind import Effect


def test_a_trial_takes_off_what_it_explains():
    """Windows lack a damping of 3; one step of 0.5 is tried, and one is refused."""

    def residual(effects):
        total = sum(e.parameters["damping"] for e in effects)
        if total < 0.0:
            raise ValueError("no such damping")
        return (3.0 - total) * np.array([1.0, -2.0, 0.5])

    model = SimpleNamespace(residual=residual, least=lambda kind, at: {})
    current = SimpleNamespace(effects=(), r=residual(()))
    trials = [("joint_viscous_damping", "a.b", "damping", [(0.5, 0.5), (-0.5, -0.5)])]
    (found,) = candidates_of(model, trials, current)
    (column,) = found.columns
    np.testing.assert_allclose(current.r - 3.0 * column[:, 0], 0.0, atol=1e-12)
    (effect,) = found.effects(0, np.array([1.0]))
    assert effect.parameters["damping"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("evidence", "expected"),
    # The third has one parameter less than the second; the first is held out best.
    [((0.0, 100.0, 80.0), 1), ((0.0, 100.0, 95.0), 2), ((50.0, 20.0, 45.0), 2)],
)
def test_evidence_picks_where_it_counts(evidence, expected):
    trials = [
        SimpleNamespace(
            fit=SimpleNamespace(score=score, says=e),
            ranked=SimpleNamespace(
                candidate=SimpleNamespace(size=n, fixed=(), at=("a.b",), members=())
            ),
        )
        for score, e, n in zip((1.0, 2.0, 3.0), evidence, (2, 2, 1), strict=True)
    ]
    search = SimpleNamespace(
        plan=SearchPlan(counts_evidence=True),
        evidence=lambda one, other, more: one.says - other.says,
    )
    assert pick_simplest(search, trials, (), 4.0) == expected  # type: ignore[arg-type]


def test_a_parabola_says_how_far_a_parameter_may_be_off():
    """By one in the sum of squares about its bottom, and by where that is; more where
    the sum is rough; no bottom, no deviation."""
    steps = 0.1 * np.arange(-4.0, 5.0)
    at_bottom = _by_parabola(steps, 7.0 + (steps / 0.2) ** 2, 1.0)
    assert at_bottom == pytest.approx(0.2)
    aside = _by_parabola(steps, ((steps - 0.15) / 0.2) ** 2, 1.0)
    assert aside == pytest.approx(0.25)
    rough = 8.0 * np.cos(np.pi * np.arange(9))
    assert _by_parabola(steps, (steps / 0.2) ** 2 + rough, 1.0) > 2.0 * at_bottom
    assert _by_parabola(steps, -(steps**2), 1.0) == np.inf


def test_an_interval_is_asked_of_the_sum_of_squares_about_its_value():
    """One deviation of 0.1 about 1.2, where the scene has 0.7."""
    effect = Effect("joint_viscous_damping", ["a.b"], {"damping": 1.2})
    problem = SimpleNamespace(
        dynamics=SimpleNamespace(now=lambda kind, at: {"damping": 0.7}),
        nuisances=lambda: SimpleNamespace(columns=np.zeros((1, 0))),
        _try_at=lambda end, k, name, value, calm: ((value - 1.2) / 0.1) ** 2,
    )
    end = SimpleNamespace(effects=[effect], std=[{"damping": 1e-4}], b=np.zeros(0))
    std, _ = MujocoProblem.widened(problem, end, 0)  # type: ignore[arg-type]
    assert std["damping"] == pytest.approx(0.1)

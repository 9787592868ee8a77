"""Candidates of one parameter, by what a trial of it does to simulated windows."""

from types import SimpleNamespace

import numpy as np
import pytest

from makebreak.gap.residuals.impacts import candidates_of


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

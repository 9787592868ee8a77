"""C3 with bounds where an object is light: multipliers are millions of times as large
as the weights. And the interior point method in any units."""

from dataclasses import replace

import numpy as np
import pytest

from makebreak.benchmarks.c3_light import problem_at, row
from makebreak.benchmarks.plants import OF_MASS, diagram_of, held_box
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs
from makebreak.systems.contact_mpc.numerics.c3_active_set import MET, solve_active
from makebreak.systems.contact_mpc.numerics.c3_admm import compiled_once
from makebreak.systems.contact_mpc.numerics.c3_bounds import within
from makebreak.systems.contact_mpc.numerics.c3_interior import (
    IPM_STARTS,
    solve_interior,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import solve_c3
from makebreak.systems.contact_mpc.numerics.c3_qp import factor, new_factor, solve


@pytest.mark.parametrize("plus", [True, False])
@pytest.mark.parametrize("mass", [0.01, 0.05])
def test_bounds_around_a_motion_of_a_light_box_are_met(mass, plus):
    """A plan exists: the simulated motion, 1 mm or 1 um from all bounds."""
    text, pairs = held_box(mass)
    model = AnitescuLcs(diagram_of(text)[0], pairs, 0.05)
    rng = np.random.default_rng(0)
    for _ in range(12):
        p = problem_at(model, mass, plus, rng, rng.choice([1e-6, 1e-3]))
        plan, _ = solve_c3(p.lcs, p.x0, p.x_desired, p.c3)
        (low, high), (u_low, u_high) = p.states, p.inputs
        assert np.isfinite(low).any() and (high - low > 0.0).all()
        assert (plan.x[1:] >= low - 1e-6).all() and (plan.x[1:] <= high + 1e-6).all()
        assert (plan.u >= u_low).all() and (plan.u <= u_high).all()
        assert p.holds(plan)
        # A plan that leaves a bound does not hold.
        i = np.flatnonzero(np.isfinite(high))[0]
        x = plan.x.copy()
        x[-1, i] = high[i] + 1e-5
        assert not p.holds(replace(plan, x=x))
        assert not p.holds(replace(plan, u=u_high + 1e-9 + 0.0 * plan.u))


def test_the_bench_counts_plans_and_those_outside_their_bounds():
    found = row(0.05, (0.05,), True, (1e-3,), 1)
    assert found["value"] == len(OF_MASS) and found["outside_bounds"] == 0
    assert found["unit"] == f"plans of {len(OF_MASS)}" and found["met"]
    assert "no bounds, 1 ms" in row(0.05, (1e-3,), False, (np.inf,), 1)["what"]


def test_the_interior_point_method_agrees_with_the_active_set_in_any_units():
    """Entries in units from 1e-3 to 1e3 of their own, weights from 1e-6 to 1e6 times;
    a simulated motion is a millionth to a tenth of its size within the bounds."""
    rng, none = np.random.default_rng(5), np.empty(0)
    solved = 0
    for _ in range(60):
        n_x, n_v, N = rng.integers(2, 8), rng.integers(1, 8), int(rng.choice([1, 3, 8]))
        n = n_x + n_v
        A = np.eye(n_x) + 0.05 * rng.normal(size=(n_x, n_x))
        B = rng.normal(size=(n_x, n_v))
        motion, v = [0.1 * rng.normal(size=n_x)], rng.normal(size=(N, n_v))
        for each in v:
            motion.append(A @ motion[-1] + B @ each)
        y = np.hstack([v, motion[1:]])
        wide = 10.0 ** rng.uniform(-6, -1) * np.abs(y).max(axis=0)
        lower, upper = y.min(axis=0) - wide, y.max(axis=0) + wide
        free = rng.random(n) < 0.4
        lower[free], upper[free] = -np.inf, np.inf
        units, weight = 10.0 ** rng.uniform(-3, 3, n), 10.0 ** rng.uniform(-6, 6)
        T = weight * np.diag(10.0 ** rng.uniform(-2, 1, n) / units**2)
        T_N = np.ascontiguousarray(T[n_v:, n_v:])
        h = weight * rng.normal(size=(N + 1, n)) / units
        AB = units[n_v:, None] * np.hstack([B, A]) / units
        lower, upper, x0 = lower * units, upper * units, motion[0] * units[n_v:]
        # Read-only where qp_step's are: what may be written is compiled by itself.
        T_N, upper = compiled_once(T_N), compiled_once(upper)
        fac = new_factor(AB[None], np.zeros((1, n_x)), N)
        assert factor(fac, T[None], T_N, np.zeros((0, 0)), 0)
        x, v = np.empty((N + 1, n_x)), np.empty((N, n_v))
        solve(fac, h, x0, none, x, v)
        if within(x, v, lower, upper):
            continue
        ours, sides = (x.copy(), v.copy()), np.zeros(h.shape, np.int64)
        start = IPM_STARTS[0]
        assert solve_interior(fac, T[None], T_N, h, none, lower, upper, start, *ours)
        assert solve_active(fac, h, x0, none, lower, upper, sides, x, v) == MET
        for a, b, unit in ((ours[0], x, units[n_v:]), (ours[1], v, units[:n_v])):
            np.testing.assert_allclose(a / unit, b / unit, atol=1e-4 * (1 + wide.max()))
        solved += 1
    assert solved > 40

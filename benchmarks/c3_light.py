"""Whether C3 finds a plan within bounds where an object is light.

Half of the states, and all inputs, are bounded to within 1 mm or 1 um (SI units for
velocities and inputs alike) of a simulated motion of random inputs, so that a plan
exists. The last rows have no bounds.
"""

from dataclasses import dataclass

import numpy as np

from makebreak.benchmarks.plants import OF_MASS, diagram_of
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs
from makebreak.systems.contact_mpc.numerics.c3_admm import C3Failure
from makebreak.systems.contact_mpc.numerics.c3_mpc import (
    C3Bounds,
    C3Options,
    C3Problem,
    C3Weights,
    Plan,
    solve_c3,
)
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    PlusProjection,
    QpProjection,
)
from makebreak.systems.contact_mpc.numerics.lcs import LCS, simulate

MASSES = (0.001, 0.01, 0.05, 1.0)  # [kg]
STEPS = (0.05, 0.01)  # [s]
MET = 2e-6  # By how much a bounded state may be outside [SI]; inputs not at all.
FREE_STEP = 1e-3  # Of the problems without bounds [s].


@dataclass(frozen=True)
class Problem:
    """A C3 problem: x0 (n_x,), x_desired (N + 1, n_x), and the bounds of states and
    inputs, each lower and upper; infinite: none."""

    lcs: LCS
    x0: np.ndarray
    x_desired: np.ndarray
    c3: C3Problem
    states: tuple[np.ndarray, np.ndarray]
    inputs: tuple[np.ndarray, np.ndarray]

    def holds(self, plan: Plan) -> bool:
        """Whether the plan is within the bounds."""
        (low, high), (u_low, u_high) = self.states, self.inputs
        x = plan.x[1:]
        inside = (low - MET <= x) & (x <= high + MET)
        return bool(inside.all() and ((u_low <= plan.u) & (plan.u <= u_high)).all())


def problem_at(
    model: AnitescuLcs, mass: float, plus: bool, rng, margin: float
) -> Problem:
    """A problem at random velocities.

    Args:
        model, mass: builder of the LCS, and mass of the object in it [kg].
        plus: C3+; else the QP projection.
        rng: of the velocities, the inputs of the motion and the choice of bounds.
        margin: of the bounds to the motion [SI]; infinite: no bounds.
    """
    N, n_x, n_u = int(rng.choice([1, 3, 8])), model.n_x, model.n_u
    x0 = model.x_default.copy()
    x0[model.n_q :] = 0.1 * rng.normal(size=n_x - model.n_q)
    lcs = model.build(x0, np.zeros(n_u))
    u = 3.0 * mass * rng.normal(size=(N, n_u))
    motion = [x0]
    for each in u:
        motion.append(simulate(lcs, motion[-1], each)[0])
    bounded = rng.random(n_x) < 0.5
    states = (
        np.where(bounded, np.min(motion[1:], axis=0) - margin, -np.inf),
        np.where(bounded, np.max(motion[1:], axis=0) + margin, np.inf),
    )
    inputs = u.min(axis=0) - margin, u.max(axis=0) + margin
    sizes, G, U = [n_x, model.n_lam, n_u], [0.01, 1.0, 0.01], [1.0] * 3
    if plus:
        sizes, G, U = [*sizes, model.n_lam], [*G, 1.0], [*U, 10.0]
    weights = C3Weights(
        np.ones(n_x), np.full(n_u, 1e-3), np.repeat(G, sizes), np.repeat(U, sizes)
    )
    c3 = C3Problem(
        weights,
        PlusProjection() if plus else QpProjection(0.01),
        C3Options(N=N, scale_lam=margin < np.inf),
        C3Bounds(*inputs, *states) if margin < np.inf else None,
    )
    return Problem(lcs, x0, np.tile(x0 + 0.1, (N + 1, 1)), c3, states, inputs)


def row(mass, steps, plus: bool, margins, repeats: int) -> dict:
    """The row of a mass [kg] and a projection: for how many problems there is a plan.

    A plan outside the bounds misses the target.
    """
    rng = np.random.default_rng(0)
    n = plans = wrong = 0
    for make in OF_MASS.values():
        text, pairs = make(mass)
        for dt in steps:
            model = AnitescuLcs(diagram_of(text)[0], pairs, dt)
            for _ in range(repeats):
                p = problem_at(model, mass, plus, rng, rng.choice(margins))
                n += 1
                try:
                    plan, _ = solve_c3(p.lcs, p.x0, p.x_desired, p.c3)
                except C3Failure:
                    continue
                plans += 1
                wrong += not p.holds(plan)
    free = f", no bounds, {1e3 * steps[0]:g} ms" if np.isinf(margins).all() else ""
    return {
        "what": f"{'C3+' if plus else 'C3, QP'}, object of {1e3 * mass:g} g{free}",
        "value": plans,
        "unit": f"plans of {n}",
        "outside_bounds": wrong,
        "met": wrong == 0,
    }


def rows(masses=MASSES, repeats: int = 20) -> list[dict]:
    """Each mass and projection within bounds, and the lightest without."""
    cases: list[tuple] = [(mass, STEPS, (1e-6, 1e-3)) for mass in masses]
    cases.append((masses[0], (FREE_STEP,), (np.inf,)))
    return [
        row(mass, steps, plus, margins, repeats)
        for mass, steps, margins in cases
        for plus in (True, False)
    ]

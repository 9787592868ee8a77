"""Time to score 16 contact candidates around an object, in a batch and one by one.

The plans are equal up to rounding: 19 states, 16 forces, 5 knots. One by one means
AnitescuLcs.build and solve_c3 for each candidate, with the analytic LCS and with the
general one. The batch uses all cores; its gain is given for one thread and for all.
"""

from functools import partial
from time import perf_counter

import numba
import numpy as np

from makebreak.benchmarks.bench import median_call_ms
from makebreak.diagrams.push_object_config import (
    PushPlannerConfig,
    c3_config,
    contact_pairs,
)
from makebreak.models.pushed_object import (
    PushedObject,
    make_tip_and_object,
    parts,
    rest_height,
)
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs
from makebreak.systems.contact_mpc.numerics.ball_state import P_BALL
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Problem, solve_c3
from makebreak.systems.contact_mpc.numerics.c3_plan import WarmStart
from makebreak.systems.contact_mpc.numerics.outline import (
    inward,
    outline_of,
    places_around,
)
from makebreak.systems.contact_mpc.numerics.plan_scores import score_plans
from makebreak.systems.contact_mpc.numerics.push_task import PushConfig, look_ahead

PLACES = 16
RATE_MIN, GAIN_MIN = 10.0, 4.0  # Targets of the rate [Hz] and of the speed-up.


def rows() -> list[dict]:
    """Time of a round [ms], its rate on one core, and the speed-up by the batch."""
    spec = PushedObject("t")
    diagram, pairs = make_tip_and_object(spec)[0], contact_pairs(spec, 0.5)
    model = AnitescuLcs(diagram, pairs, 0.1)
    general = AnitescuLcs(diagram, pairs, 0.1, analytic=False)
    c3 = c3_config(PushPlannerConfig(), model.n_lam)
    problem = C3Problem(c3.weights, c3.projection, c3.options)
    N = problem.options.N
    object_at = np.array([0.5, 0.0, rest_height(spec)])
    outline = outline_of([part.points for part in parts(spec)], np.eye(3), object_at)
    places = places_around(outline, 0.0235, PLACES)
    x = np.tile(model.x_default, (PLACES, 1))
    x[:, :2], x[:, 2], x[:, P_BALL] = places, 0.024, object_at
    x_desired = look_ahead(
        PushConfig(), x[0], np.array([0.55, 0.03, 0.3]), 0.024, N + 1
    )
    guess = np.zeros((PLACES, N, 3))
    guess[:, :, :2] = 4.0 * inward(places, outline)[:, None]
    no_force, zero = np.zeros(3), np.zeros((N, problem.n_z))

    def batch():
        lcs = model.build_many(x, no_force)
        return score_plans(lcs, x, x_desired, problem, guess)

    def one_by_one(builder):
        for i in range(PLACES):
            lcs = builder.build(x[i], no_force)
            warm = WarmStart(guess[i], zero, zero)
            solve_c3(lcs, x[i], x_desired, problem, warm)

    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        batches = [("one thread", median_call_ms(batch, 30))]
    finally:
        numba.set_num_threads(threads)
    if threads > 1:  # Wall time, as CPU time would add up over cores.
        on_all = median_call_ms(batch, 30, perf_counter)
        batches.append((f"{threads} threads (elapsed)", on_all))
    rate = 1e3 / batches[0][1]
    what = f"{PLACES} places scored, n_x {model.n_x}, n_lam {model.n_lam}, one batch"
    found: list[dict] = [
        {"what": f"{what}, {cores}", "value": value, "unit": "ms"}
        for cores, value in batches
    ]
    found.append(
        {
            "what": "rounds a second on one core", "value": rate, "unit": "Hz",
            "target": RATE_MIN, "met": rate >= RATE_MIN,
        }
    )  # fmt: skip
    for builder, path in ((general, "general"), (model, "analytic")):
        alone = median_call_ms(partial(one_by_one, builder), 10)
        what = f"one after another, {path} LCS"
        found.append({"what": what, "value": alone, "unit": "ms"})
        found += [
            {"what": f"{what}, over {cores}", "value": alone / value}
            for cores, value in batches
        ]
        if path == "general":  # What was there before; on every core that there is.
            gain = found[-1]
            gain |= {"target": GAIN_MIN, "met": gain["value"] >= GAIN_MIN}
    return found

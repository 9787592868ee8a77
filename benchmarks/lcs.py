"""Time to build one LCS of the tip, the ball and the table (19 states, 8 forces)."""

from functools import partial

import numpy as np

from makebreak.benchmarks.bench import median_call_ms
from makebreak.models.tip_and_ball import TipAndBall, make_tip_and_ball
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs, ContactPair


def rows() -> list[dict]:
    """Milliseconds per build, analytic and by AutoDiff."""
    diagram, _, _ = make_tip_and_ball(TipAndBall())
    pairs = [
        ContactPair("tip::tip", "ball::ball"),
        ContactPair("ball::ball", "table::table"),
    ]
    found = []
    for analytic in (True, False):
        model = AnitescuLcs(diagram, pairs, dt_sec=0.05, analytic=analytic)
        x = model.x_default.copy()
        x[:3], x[7:10] = [0.0, 0.0, 0.1], [0.01, 0.0, 0.04]  # A generic configuration.
        u = np.zeros(model.n_u)
        path = "analytic" if model.is_analytic else "AutoDiff"
        what = f"LCS build, {path}, n_x {model.n_x}, n_lam {model.n_lam}"
        value = median_call_ms(partial(model.build, x, u))
        found.append({"what": what, "value": value, "unit": "ms"})
    return found

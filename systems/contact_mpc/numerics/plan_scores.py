"""What a C3+ plan costs from each of many states of one object.

All LCS have the same object, so they and their solves are made in compiled batches.
Each is what AnitescuLcs.build and solve_c3 give, one by one.
"""

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from os import getpid
from time import perf_counter

import numpy as np
from numba import get_num_threads, njit

from makebreak.systems.contact_mpc.numerics.c3_admm import (
    admm_plus,
    compiled_once,
    scaled_model,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Problem
from makebreak.systems.contact_mpc.numerics.c3_polish import polish
from makebreak.systems.contact_mpc.numerics.lcp import SOLVED, solve_lcp_kernel

# Of a place that is not wanted, or whose plan failed.
NO_PLAN = np.inf


@njit(cache=True, nogil=True)
def _score(
    first, last, lcs, x, x_desired, weights, bounds, polish_bounds, U, guess, options,
    found,
):  # fmt: skip
    """The places first .. last - 1 into found, as solve_c3's C3+ plans them.

    Args: lcs: A, B, D, d, E, F, H, c, each of n; x (n, n_x); weights: Q, Q_N, R, G, h;
        bounds as of admm_plus, polish_bounds as of polish; guess (n, N, n_u); options:
        rounds, rho, scale_lam, start_at_x0, polish; found: cost (n,), NO_PLAN where it
        stays as it is; u (n, N, n_u); x (n, N + 1, n_x).
    """
    Q, Q_N, R, G, h = weights
    rounds, rho, scale_lam, start_at_x0, evaluations = options
    _, N, n_u = guess.shape
    cost_of, u_of, x_of = found
    for i in range(first, last):
        one = slice(i, i + 1)
        A, B, D, d = lcs[0][one], lcs[1][one], lcs[2][one], lcs[3][one]
        E, F, H, c = lcs[4][one], lcs[5][one], lcs[6][one], lcs[7][one]
        if not (np.isfinite(c).all() and np.isfinite(F).all()):
            continue
        scale = 1.0
        if scale_lam:
            scale = np.sqrt((A[0] ** 2).sum()) / np.sqrt((D[0] ** 2).sum())
        model, E_s, F_s, _, pushes = scaled_model(A, B, D, d, E, F, H, c, scale)
        AB, d_s, C, c_s = model
        lam0 = np.empty(0)
        if not pushes:
            lam0, status = solve_lcp_kernel(F_s[0], E_s[0] @ x[i] + c_s[0])
            if status != SOLVED:
                continue
        delta, w = np.zeros((N, G.size)), np.zeros((N, G.size))
        if start_at_x0:
            delta[:, : x.shape[1]] = x[i]
        status, _, _, _, _, inputs = admm_plus(
            AB, d_s, C, c_s, Q, R, Q_N, G, bounds, U, h, x[i], lam0, delta, w, rounds,
            rho,
        )  # fmt: skip
        if status != SOLVED:
            continue
        starts = np.empty((rounds + 3, N, n_u))
        starts[: rounds + 1] = inputs
        starts[rounds + 1] = guess[i]
        starts[rounds + 2, : N - 1], starts[rounds + 2, N - 1] = (
            guess[i, 1:],
            guess[i, -1],
        )
        plan, u, _, cost = polish(
            (A, B, D, d, E, F, H, c), x[i], starts, x_desired, np.zeros((N, n_u)),
            (Q, R, Q_N), polish_bounds, evaluations,
        )[:4]  # fmt: skip
        cost_of[i], u_of[i], x_of[i] = cost, u, plan


@cache
def _threads(number, process):
    """A pool for this process: one that was forked has none of its parent's threads."""
    return ThreadPoolExecutor(number, f"plan_scores_{process}")


def _score_side_by_side(first, last, *args):
    """_score on as many threads as numba uses; no place knows of another, so that their
    number changes no bit. Threads, not numba's prange: that compiles for a minute."""
    threads = min(get_num_threads(), last - first)
    if threads <= 1:
        _score(first, last, *args)
        return
    ends = np.linspace(first, last, threads + 1).round().astype(int).tolist()
    parts = [
        _threads(get_num_threads() - 1, getpid()).submit(_score, i, j, *args)
        for i, j in zip(ends[1:-1], ends[2:], strict=True)
    ]
    _score(ends[0], ends[1], *args)
    for part in parts:
        part.result()


def score_plans(lcs, x, x_desired, problem: C3Problem, guess=None, first=0, last=None):
    """The plan from each of many states, as solve_c3 makes it, and what it costs.

    Args:
        lcs: A, B, D, d, E, F, H, c, ... of n states (AnitescuLcs.build_many).
        x: (n, n_x) the states, which have the same quaternions.
        x_desired: (N + 1, n_x). problem: with C3+.
        guess: (n, N, n_u) inputs that the polish may start from, as WarmStart.u; None:
            zeros.
        first, last: of which states; the others cost NO_PLAN.

    Returns: cost (n,), NO_PLAN where there is no plan: of the rollout on the state's
        own LCS, to second order in the orientation; u (n, N, n_u); x (n, N + 1, n_x).
    """
    p, o = problem, problem.options
    if not p.is_plus or o.penalise_input_change or o.warm_start:
        raise ValueError(
            "score_plans: expected a problem with PlusProjection, without "
            "penalise_input_change and warm_start"
        )
    Q, Q_N, x_goal = p.state_cost(x[0], x_desired)
    h = np.zeros((o.N + 1, p.n_x + p.n_u + p.n_lam))
    for k in range(o.N + 1):
        h[k, p.n_lam + p.n_u :] = (Q_N if k == o.N else Q[k % len(Q)]) @ x_goal[k]
    unbounded = np.isinf(p.lower).all() and np.isinf(p.upper).all()
    (u_lower, x_lower), (u_upper, x_upper) = (
        np.split(bound[p.n_lam :], [p.n_u]) for bound in (p.lower, p.upper)
    )
    guess = np.zeros((len(x), o.N, p.n_u)) if guess is None else guess
    n = len(x)
    found = np.full(n, NO_PLAN), np.zeros((n, o.N, p.n_u)), np.zeros((n, *x_goal.shape))
    first, last, _ = slice(first, last).indices(n)
    _score_side_by_side(
        first,
        last,
        tuple(compiled_once(np.ascontiguousarray(a)) for a in lcs[:8]),
        np.ascontiguousarray(x),
        np.ascontiguousarray(x_goal),
        (Q, Q_N, p.R, p.G, h),
        None if unbounded else (p.lower, p.upper),
        (u_lower, u_upper, x_lower, x_upper),
        p.U,
        guess,
        (o.rounds, o.rho, o.scale_lam, o.start_at_x0, o.polish),
        found,
    )
    return found


def score_within(budget_sec, lcs, x, x_desired, problem, guess=None, at_once=None):
    """score_plans of as many states as the budget has time for, the first ones first.

    Args: budget_sec: wall-clock time [s]; infinite: all, in one go, which repeats
        whatever the computer does. at_once: states between two looks at the clock;
        None: 4, or as many as there are threads.
    Returns: as score_plans.
    """
    if np.isinf(budget_sec):
        return score_plans(lcs, x, x_desired, problem, guess)
    start, n = perf_counter(), len(x)
    at_once = max(4, get_num_threads()) if at_once is None else at_once
    parts = []
    for first in range(0, n, at_once):
        spent = perf_counter() - start
        # Of a part that would not be done in time as far as the last ones tell.
        if first and spent * (1.0 + at_once / first) > budget_sec:
            break
        parts.append(
            score_plans(lcs, x, x_desired, problem, guess, first, first + at_once)
        )
    cost = np.min([part[0] for part in parts], axis=0)
    return cost, *(np.sum([part[i] for part in parts], axis=0) for i in (1, 2))

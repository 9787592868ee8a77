"""How far a parameter goes where its columns are right in some blocks of time only."""

import numpy as np

MOST_STARTS, MOST_ROUNDS = 6, 6


def agreed_step(X, r, block) -> tuple[np.ndarray, float]:
    """The coefficients c (k,) of columns X (m, k) that explain a residual r (m,) in the
    blocks that they explain at all, and what they take off the squares there.

    Where a thing is hit, or a leg walks, motion bends so soon that columns of a small
    step say nothing of a larger one: a block that gets worse by them does not count.

    Args: block (m,): number of the block of each row.

    Source: least trimmed squares by concentration steps, of blocks in the place of rows
    (Rousseeuw, Van Driessen, Data Min. Knowl. Discov. 12, 2006).
    """
    numbers, of = np.unique(block, return_inverse=True)
    n, k = len(numbers), X.shape[1]
    size = np.linalg.norm(X, axis=0)
    size[size == 0.0] = np.inf
    X = X / size
    G, g = np.zeros((n, k, k)), np.zeros((n, k))
    for i in range(n):
        some = X[of == i]
        G[i], g[i] = some.T @ some, some.T @ r[of == i]

    def solve(some) -> np.ndarray:
        return np.linalg.lstsq(G[some].sum(axis=0), g[some].sum(axis=0), rcond=1e-6)[0]

    def gains(c) -> np.ndarray:
        return 2.0 * g @ c - np.einsum("i,nij,j->n", c, G, c)

    own = [gains(solve([i]))[i] for i in range(n)]
    starts = [np.arange(n), *([i] for i in np.argsort(own)[::-1][:MOST_STARTS])]
    best, most = np.zeros(k), 0.0
    for some in starts:
        c = solve(some)
        for _ in range(MOST_ROUNDS):
            better = np.flatnonzero(gains(c) > 0.0)
            if not len(better):
                break
            c = solve(better)
        gained = float(np.maximum(gains(c), 0.0).sum())
        if gained > most:
            best, most = c, gained
    return best / size, most

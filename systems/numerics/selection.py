"""Which of many candidate explanations a residual needs: fitted here, judged there.

A residual in units of its noise, r = X c + N b + e, with candidates X, and nuisances N
whose size is known to within a tolerance. Coefficients come from training rows and the
error from rows held out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2, wilcoxon

SAME = 0.05  # Within this share of the best error, data cannot tell two models apart.
NESTED_GAIN = 0.10  # What a bigger model must take off the error of one inside it.


@dataclass(frozen=True, eq=False)
class LinearFit:
    """c (k,), b (n_b,) coefficients of candidate and nuisances; c_std (k,).

    score: held-out error, the cost of the nuisances included. held_out: the rms of the
    residual alone. train: rms over the training rows.
    """

    c: np.ndarray
    c_std: np.ndarray
    b: np.ndarray
    score: float
    held_out: float
    train: float


class Columns:
    """Columns of one candidate, with the products that fits need.

    Args: X (m, k); nuisance (m, n_b); train (m,).
    """

    def __init__(self, X, nuisance, train):
        self.X = np.asarray(X, float)
        T, H = self.X[train], self.X[~train]
        self.TT, self.HH = T.T @ T, H.T @ H
        self.TN, self.HN = T.T @ nuisance[train], H.T @ nuisance[~train]


class Screen:
    """Fits one candidate after another to one residual.

    Args: r (m,) residual over its noise; nuisance (m, n_b) in the same units; prior
        (n_b,) standard deviations of b; train (m,) booleans, the others are held out;
        scale: what is left unexplained, in units of noise: with it a nuisance is
        weighed against its prior.
    """

    def __init__(self, r, nuisance, prior, train, scale: float = 1.0):
        self.r, self._N = np.asarray(r, float), np.asarray(nuisance, float)
        self._prior, self._train = np.asarray(prior, float), np.asarray(train, bool)
        self._s2 = max(float(scale), 1.0) ** 2
        T, H = self._N[self._train], self._N[~self._train]
        self._NN = T.T @ T + self._s2 * np.diag(self._prior**-2)
        self._L = cho_factor(self._NN) if len(self._prior) else None
        self._HH = H.T @ H
        self._set(self.r)

    def _set(self, r) -> None:
        T, H = r[self._train], r[~self._train]
        self._rr, self._hh = T @ T, H @ H
        self._Nr, self._Hr = self._N[self._train].T @ T, self._N[~self._train].T @ H

    def fit(self, columns: "Columns | None" = None) -> LinearFit:
        """With a candidate's columns, or with the nuisances alone."""
        if columns is None:
            columns = Columns(np.zeros((len(self.r), 0)), self._N, self._train)
        t = self._train
        Xr, Xh = columns.X[t].T @ self.r[t], columns.X[~t].T @ self.r[~t]
        G, g = columns.TT, Xr
        if self._L is not None:
            G = G - columns.TN @ cho_solve(self._L, columns.TN.T)
            g = g - columns.TN @ cho_solve(self._L, self._Nr)
        c = c_std = np.zeros(len(g))
        if len(g):
            size = np.sqrt(np.diag(columns.TT))
            # What hardly shows, beside the other columns, is round-off.
            size[size <= 1e-9 * size.max()] = np.inf
            w, u = np.linalg.eigh(G / size[:, None] / size)
            good = w > 1e-11 * max(w[-1], 1e-300)
            inverse = np.where(good, 1.0 / np.where(good, w, 1.0), 0.0)
            c = u @ (inverse * (u.T @ (g / size))) / size
            c_std = np.sqrt(self._s2 * np.sum(u**2 * inverse, axis=1)) / size
        b = np.zeros(0)
        if self._L is not None:
            b = cho_solve(self._L, self._Nr - columns.TN.T @ c)
        held = (
            self._hh - 2 * c @ Xh - 2 * b @ self._Hr + c @ columns.HH @ c
            + 2 * c @ columns.HN @ b + b @ self._HH @ b
        )  # fmt: skip
        NN = self._NN - self._s2 * np.diag(self._prior**-2)
        seen = (
            self._rr - 2 * c @ Xr - 2 * b @ self._Nr + c @ columns.TT @ c
            + 2 * c @ columns.TN @ b + b @ NN @ b
        )  # fmt: skip
        return self._fit(c, c_std, b, held, seen)

    def judge(self, r, c=(), c_std=()) -> LinearFit:
        """For another residual (m,): with the nuisances that its training rows want."""
        b, left = self.settle(r)
        t = self._train
        return self._fit(
            np.array(c), np.array(c_std), b, left[~t] @ left[~t], left[t] @ left[t]
        )

    def settle(self, r) -> tuple[np.ndarray, np.ndarray]:
        """The nuisances' coefficients for a residual (m,), and what they leave."""
        if self._L is None:
            return np.zeros(0), r
        b = cho_solve(self._L, self._N[self._train].T @ r[self._train])
        return b, r - self._N @ b

    def cost_rows(self, r) -> np.ndarray:
        """Training rows of what the nuisances leave of r (m,), over the scale, and
        their own cost: what a least-squares fit of other parameters minimises."""
        b, left = self.settle(r)
        return np.concatenate([left[self._train] / np.sqrt(self._s2), b / self._prior])

    def _fit(self, c, c_std, b, held, seen) -> LinearFit:
        n, m = int((~self._train).sum()), int(self._train.sum())
        held, seen = max(held, 0.0) / max(n, 1), max(seen, 0.0) / max(m, 1)
        if n == 0:
            held = seen  # Too little data to hold any out.
        cost = self._s2 * float(np.sum((b / self._prior) ** 2)) / (n + m)
        return LinearFit(
            c, c_std, b, float(np.sqrt(held + cost)), float(np.sqrt(held)),
            float(np.sqrt(seen)),
        )  # fmt: skip


def is_plausible(b, prior, rate: float = 1e-4) -> bool:
    """Whether nuisances b (n_b,), normal with standard deviations prior (n_b,), are
    not farther from zero than all but `rate` of all draws."""
    squares = float(np.sum((np.asarray(b) / np.asarray(prior)) ** 2))
    return not len(b) or bool(chi2.sf(squares, len(b)) >= rate)


def benjamini_hochberg(p, rate: float = 0.05) -> np.ndarray:
    """Which of the hypotheses with p-values (n,) are rejected, so that of those
    rejected wrongly the expected share is at most `rate`.

    Source: Benjamini, Hochberg, J. R. Stat. Soc. B 57(1), 1995, equation 1.
    """
    p = np.asarray(p, float)
    order = np.argsort(p)
    below = p[order] <= rate * np.arange(1, len(p) + 1) / max(len(p), 1)
    rejected = np.zeros(len(p), bool)
    if below.any():
        rejected[order[: np.flatnonzero(below)[-1] + 1]] = True
    return rejected


def paired(one, two, train) -> float:
    """p-value of two models being equally good: Wilcoxon's signed ranks of how their
    squared residuals (m,) differ over blocks of time, which are the stretches of rows
    that `train` (m,) has in one piece. 1 if there are fewer than 6.

    Source: Wilcoxon, Biometrics 1(6), 1945; the pairing as in Vuong, Econometrica
    57(2), 1989.
    """
    train = np.asarray(train, bool)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(train.astype(int))) + 1])
    difference = np.add.reduceat(np.asarray(one) ** 2 - np.asarray(two) ** 2, starts)
    if len(starts) < 6 or not np.abs(difference).max() > 0.0:
        return 1.0
    return float(wilcoxon(difference).pvalue)


def simplest(errors: Sequence[float], sizes: Sequence[int], same: float = SAME) -> int:
    """Index of the model with the fewest parameters whose error is within `same` of
    the least; of equally many the one with the least error."""
    least = np.nanmin(errors)
    near = [i for i in range(len(errors)) if errors[i] <= (1.0 + same) * least]
    return min(near, key=lambda i: (sizes[i], errors[i]))


def spread_by_blocks(J, r, block, draws: int = 200) -> np.ndarray:
    """(k,) standard deviations of least squares whose errors go together within a block
    (of time, an episode): the blocks are drawn anew with replacement, each time with
    one Gauss-Newton step. Zeros for fewer than six blocks.

    Args: J (m, k), r (m,): rows and their derivatives at the solution; block (m,): a
        number of each; negative: rows that are always there, once (a prior's).
    Source: Efron, Tibshirani, An Introduction to the Bootstrap, 1993, ch. 8-9.
    """
    J, r, block = np.asarray(J, float), np.asarray(r, float), np.asarray(block)
    names, group = np.unique(block, return_inverse=True)
    k, free = J.shape[1], names >= 0
    if free.sum() < 6 or k == 0:
        return np.zeros(k)
    size = np.linalg.norm(J, axis=0)
    size[size == 0.0] = 1.0
    J = J / size
    H, s = np.zeros((len(names), k, k)), np.zeros((len(names), k))
    for g in range(len(names)):
        mine = J[group == g]
        H[g], s[g] = mine.T @ mine, mine.T @ r[group == g]
    n = int(free.sum())
    weights = np.ones((draws, len(names)))
    weights[:, free] = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), draws)
    steps = [
        np.linalg.lstsq(np.tensordot(w, H, 1), -(w @ s), rcond=1e-10)[0]
        for w in weights
    ]
    # Of n blocks a sum's variance comes out (n - 1)/n of what it is.
    return np.std(steps, axis=0) * np.sqrt(n / (n - 1)) / size

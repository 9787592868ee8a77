"""Which of many candidate explanations a residual needs: fitted here, judged there.

A residual in units of its noise, r = X c + N b + e, with candidates X, and nuisances N
whose size is known to within a tolerance. Coefficients come from training rows and the
error from rows held out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dpotrf, dpotrs
from scipy.stats import chi2, norm, wilcoxon
from scipy.stats import t as student_t

from makebreak.gap.numerics.runs import starts_of_runs

# Blocks that tell a parameter, of which a scatter is taken (one draw in 400 has none of
# six), or this share of few: those that say more than others count as fewer.
FEWEST_TELL, LEAST_TELL = 6.0, 0.25
# Two models say other things of a block of time where the squares of their difference
# are so many times what is left of a row (two deviations); fewest such blocks.
TOUCHED, FEWEST_TOUCHED = 4.0, 3
NEW = 1e-6  # Of a column's squares, what no sum of others may have.
_PENALTIES = 10.0 ** np.arange(-4.0, 2.0)  # Of a ridge, times the number of rows.


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


class Screen:
    """Fits one candidate after another to one residual.

    Args: r (m,) residual over its noise; nuisance (m, n_b) in the same units; prior
        (n_b,) standard deviations of b; train (m,) booleans, the others are held out;
        scale: what is left unexplained, in units of noise, times the root of how many
        neighbouring rows say the same: with it a nuisance is weighed against its
        prior; reach: |b| <= reach prior.
    """

    def __init__(self, r, nuisance, prior, train, scale: float = 1.0, reach=np.inf):
        self._given = r, nuisance, prior, train, scale, reach
        self.r, self._N = np.asarray(r, float), np.asarray(nuisance, float)
        self._prior, self._train = np.asarray(prior, float), np.asarray(train, bool)
        self._s2 = max(float(scale), 1.0) ** 2
        self._limit = float(reach) * self._prior
        self._T, self._H = self._N[self._train], self._N[~self._train]
        self._NN = self._T.T @ self._T + self._s2 * np.diag(self._prior**-2)
        # Candidates differ little in which nuisances are at their limits.
        self._factor = Factors(self._NN)
        self._Nr = self._T.T @ self.r[self._train]
        self._side = np.zeros(len(self._prior), int)
        if len(self._prior):
            b = self.fit_nuisances(self.r)[0]
            held = np.abs(b) >= self._limit * (1.0 - 1e-9)
            self._side = np.where(held, np.sign(b), 0).astype(int)

    def without(self, some) -> "Screen":
        """The same, but nuisances of which `some` (n_b,) is true explain nothing."""
        r, nuisance, *rest = self._given
        return Screen(r, np.where(np.asarray(some, bool), 0.0, nuisance), *rest)

    def fit(self, columns=None) -> LinearFit:
        """With a candidate's columns (m, k), or with the nuisances alone."""
        if columns is None or columns.shape[1] == 0:
            return self.evaluate(self.r)
        t = self._train
        X = columns[t]
        size = np.linalg.norm(X, axis=0)
        # What hardly shows, beside the other columns, is round-off.
        size[size <= 1e-9 * size.max()] = np.inf
        X = X / size
        XX, XN, Xr = X.T @ X, X.T @ self._T, X.T @ self.r[t]
        Nr = self._Nr
        inverse, c = np.zeros_like(XX), np.zeros(len(size))

        def solve(free, b):
            """Nuisances that are free, and the pull on those that are held at b."""
            nonlocal inverse, c
            g, G = Xr - XN[:, ~free] @ b[~free], XX
            if free.any():
                L = self._factor(free)
                some = XN[:, free]
                rest = Nr[free] - self._NN[np.ix_(free, ~free)] @ b[~free]
                G = XX - some @ dpotrs(L, some.T)[0]
                g = g - some @ dpotrs(L, rest)[0]
            inverse = _pseudo_inverse(G)
            c = inverse @ g
            if free.any():
                b[free] = dpotrs(L, rest - some.T @ c)[0]
            return b, Nr - XN.T @ c - self._NN @ b

        b = np.zeros(len(self._prior))
        if len(b):
            b = _within(solve, self._limit, np.diag(self._NN), self._side)
        else:
            solve(np.zeros(0, bool), b)
        spread = np.sqrt(self._s2 * np.maximum(np.diag(inverse), 0.0))
        left = self.r - columns @ (c / size) - self._N @ b
        return self._fit(c / size, spread / size, b, left)

    def beside(self, columns, known_to: float) -> "Screen":
        """The same, with further columns (m, k) as nuisances of this deviation."""
        r, nuisance, prior, *rest = self._given
        prior = np.append(prior, np.full(columns.shape[1], known_to))
        return Screen(r, np.hstack([nuisance, columns]), prior, *rest)

    def without_each(self, columns, of) -> np.ndarray:
        """(n, m) what columns (m, k) leave but for those of one of n things, all others
        and the nuisances free; nuisances that are at their limits with all of them
        stay. of (k,): the thing that each column is of."""
        t, fit, k = self._train, self.fit(columns), columns.shape[1]
        free = np.abs(fit.b) < self._limit * (1.0 - 1e-9)
        Z = np.hstack([columns, self._N[:, free]])
        prior = np.append(np.full(k, np.inf), self._prior[free])
        known = self._s2 / prior**2
        size = np.sqrt(np.sum(Z[t] ** 2, axis=0) + known)
        size[size <= 1e-9 * size[:k].max(initial=0.0)] = np.inf  # As in fit.
        Z = Z / size
        P = _pseudo_inverse(Z[t].T @ Z[t] + np.diag(known / size**2))
        c = np.where(np.isfinite(size[:k]), fit.c * size[:k], 0.0)
        left = self.r - columns @ fit.c - self._N @ fit.b
        found = []
        for number in range(int(of.max(initial=-1)) + 1):
            mine = np.flatnonzero(of == number)
            back = np.linalg.lstsq(P[np.ix_(mine, mine)], c[mine], rcond=1e-10)[0]
            found.append(left + Z @ (P[:, mine] @ back))
        return np.array(found)

    def evaluate(self, r, c=(), c_std=()) -> LinearFit:
        """For another residual (m,): with the nuisances that its training rows want."""
        b, left = self.fit_nuisances(r)
        return self._fit(np.array(c), np.array(c_std), b, left)

    def fit_nuisances(self, r) -> tuple[np.ndarray, np.ndarray]:
        """The nuisances' coefficients for a residual (m,), and what they leave."""
        if not len(self._prior):
            return np.zeros(0), r
        g = self._T.T @ r[self._train]
        b = boxed_minimum(self._NN, g, self._limit, self._factor)
        return b, r - self._N @ b

    def wanted(self, r) -> np.ndarray:
        """(n_b,) each nuisance in units of its prior; one that is at its limit as far
        as it would go alone beyond it."""
        b, _ = self.fit_nuisances(r)
        out = b / self._prior
        held = np.abs(b) >= self._limit * (1.0 - 1e-9)
        for i in np.flatnonzero(held):
            limit = np.array(self._limit)
            limit[i] = np.inf
            g = self._T.T @ r[self._train]
            out[i] = boxed_minimum(self._NN, g, limit)[i] / self._prior[i]
        return out

    def cost_rows(self, r) -> np.ndarray:
        """Training rows of what the nuisances leave of r (m,), over the scale, and
        their own cost: what a least-squares fit of other parameters minimises."""
        b, left = self.fit_nuisances(r)
        return np.concatenate([left[self._train] / np.sqrt(self._s2), b / self._prior])

    def _fit(self, c, c_std, b, left) -> LinearFit:
        t = self._train
        n, m = int((~t).sum()), int(t.sum())
        seen = float(left[t] @ left[t]) / max(m, 1)
        held = float(left[~t] @ left[~t]) / max(n, 1)
        if n == 0:
            held = seen  # Too little data to hold any out.
        cost = self._s2 * float(np.sum((b / self._prior) ** 2)) / (n + m)
        return LinearFit(
            c, c_std, b, float(np.sqrt(held + cost)), float(np.sqrt(held)),
            float(np.sqrt(seen)),
        )  # fmt: skip


def in_place_of_others(columns, r, scale: float) -> tuple[np.ndarray, float]:
    """The coefficients (k,) of the few columns (m, k) that explain r (m,) with the
    first of them, which is not below 0; 0 for the others; and the evidence for the
    first: how much less these cost than the few that explain r without it. 0 where more
    are needed with it: then others are there to undo what it does.

    Args: scale: of what is left of a row.
    """
    c, with_it = _few(columns, r, scale)
    d, without = _few(columns * (np.arange(columns.shape[1]) > 0), r, scale)
    more = np.count_nonzero(c) > np.count_nonzero(d)
    return c, 0.0 if more else without - with_it


def cost_of_few(columns, r, scale: float) -> float:
    """Of what the few columns (m, k) that explain r (m,) leave, and of these.

    Args: scale: of what is left of a row.
    """
    return _few(np.column_stack([np.zeros(len(r)), columns]), r, scale)[1]


def _few(columns, r, scale: float) -> tuple[np.ndarray, float]:
    """The coefficients (k,) of the few columns (m, k) that explain r (m,), 0 for the
    others, and their cost: one after another, the most telling first, while each gains
    more than the logarithm of m, which it costs; the first one not below 0.

    Source: orthogonal matching pursuit (Pati, Rezaiifar, Krishnaprasad, Asilomar 1993),
    stopped by BIC (Schwarz, Ann. Stat. 6(2), 1978).
    """
    size = np.linalg.norm(columns, axis=0)
    X = columns / np.where(size > 0.0, size, np.inf)
    left, chosen = np.array(r, float), np.zeros(len(size), bool)
    each = float(np.log(len(left)))
    while not chosen.all():
        own = np.sum(X**2, axis=0)
        own[chosen | (own < NEW)] = np.inf
        along = X.T @ left
        along[0] = max(along[0], 0.0)
        gained = along**2 / own / scale**2
        best = int(np.argmax(gained))
        if not gained[best] > each:
            break
        x = X[:, best] / np.sqrt(own[best])
        left -= x * (x @ left)
        X = X - np.outer(x, x @ X)
        chosen[best] = True
    c = np.zeros(len(size))
    c[chosen] = np.linalg.lstsq(columns[:, chosen], r, rcond=None)[0]
    return c, float(left @ left) / scale**2 + each * int(chosen.sum())


def _pseudo_inverse(A: np.ndarray) -> np.ndarray:
    """Of a symmetric matrix (k, k) with a diagonal of one or less, without directions
    that are round-off."""
    w, u = np.linalg.eigh(A)
    good = w > 1e-11 * max(w[-1], 1e-300)
    return (u * np.where(good, 1.0 / np.where(good, w, 1.0), 0.0)) @ u.T


class Factors:
    """Cholesky's factors (upper) of blocks of a symmetric positive definite matrix
    (n, n), kept: the same few come again and again."""

    def __init__(self, H: np.ndarray):
        self._H = H
        self._known: dict[bytes, np.ndarray] = {}

    def __call__(self, free: np.ndarray) -> np.ndarray:
        """Of the rows and columns that are free (n,)."""
        key = free.tobytes()
        if key not in self._known:
            c, failed = dpotrf(self._H[np.ix_(free, free)])
            if failed:
                raise LinAlgError(f"row {failed} of a matrix makes it not definite")
            self._known[key] = c
        return self._known[key]


def boxed_minimum(H, g, limit, factor: Factors | None = None) -> np.ndarray:
    """b (n,) with |b| <= limit (n,) at which b'Hb/2 - g'b is least; H (n, n) positive
    definite; factor: of H, where it is used more than once.

    Source: the primal-dual active set of Hintermueller, Ito, Kunisch, SIAM J. Optim.
    13(3), 2002.
    """
    H, g = np.asarray(H, float), np.asarray(g, float)
    limit = np.broadcast_to(np.asarray(limit, float), g.shape)
    factor = factor or Factors(H)

    def solve(free, b):
        if free.any():
            rest = g[free] - H[np.ix_(free, ~free)] @ b[~free]
            b[free] = dpotrs(factor(free), rest)[0]
        return b, g - H @ b

    return _within(solve, limit, np.diag(H))


def _within(
    solve, limit: np.ndarray, stiffness: np.ndarray, guess: np.ndarray | None = None
) -> np.ndarray:
    """The solution b (n,) of a least-squares problem with |b| <= limit (n,).

    Args: solve(free (n,) booleans, b): b with those that are free put to their best,
        and how hard all of them are pulled. stiffness (n,): of each, a typical pull
        over a typical step. guess (n,): -1, 0, 1 where a limit is expected to hold.
    """
    side, b = np.zeros(len(limit), int), np.zeros(len(limit))
    side = side if guess is None else np.array(guess)
    for _ in range(40):
        free = side == 0
        b, pull = solve(free, np.where(free, 0.0, side * np.where(free, 0.0, limit)))
        at = np.where(free, b, b + pull / stiffness)
        new = np.where(at > limit, 1, np.where(at < -limit, -1, 0))
        if (new == side).all():
            return b
        side = new
    # It goes in circles. From a point within, one limit after another is met or left:
    # slower, and it ends (the least always falls).
    side, b = np.zeros(len(limit), int), np.zeros(len(limit))
    for _ in range(20 * len(limit) + 20):
        free = side == 0
        to, pull = solve(free, np.where(free, 0.0, side * np.where(free, 0.0, limit)))
        step = to - b
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(free & (step != 0.0), (np.sign(step) * limit - b) / step,
                             np.inf)  # fmt: skip
        k = int(np.argmin(reach))
        if reach[k] < 1.0:
            b = b + max(reach[k], 0.0) * step
            side[k] = int(np.sign(step[k]))
            continue
        b = to
        inward = np.where(free, 0.0, -side * pull / np.sqrt(stiffness))
        k = int(np.argmax(inward))
        if inward[k] <= 1e-9 * np.abs(pull / np.sqrt(stiffness)).max(initial=1e-300):
            break
        side[k] = 0
    return b


def predictable_share(y, X, block, folds: int = 5) -> float:
    """How much of y (m,) features X (m, k) predict where they were not fitted: one less
    the ratio of the squared errors with and without them, by cross-validation over
    blocks of time. Ridge regression, of the penalties that which predicts best; 0 where
    none predicts better than nothing at all.

    Args: block (m,): a number of each row; blocks are left out whole.
    Source: Hoerl, Kennard, Technometrics 12(1), 1970; cross-validation as in Hastie,
    Tibshirani, Friedman, The Elements of Statistical Learning, section 7.10.
    """
    y, X, block = np.asarray(y, float), np.asarray(X, float), np.asarray(block)
    names = np.unique(block)
    total = float(y @ y)
    if len(names) < folds or not total > 0.0:
        return 0.0
    size = np.std(X, axis=0)
    X = X[:, size > 1e-12 * max(size.max(initial=0.0), 1e-300)]
    X = (X - X.mean(axis=0)) / np.std(X, axis=0)
    X = np.column_stack([X, np.ones(len(y))])
    left = np.zeros(len(_PENALTIES))
    for some in np.array_split(names, folds):
        out = np.isin(block, some)
        w, u = np.linalg.eigh(X[~out].T @ X[~out])
        g = u.T @ (X[~out].T @ y[~out])
        for i, penalty in enumerate(_PENALTIES):
            c = u @ (g / (np.maximum(w, 0.0) + penalty * len(y)))
            left[i] += np.sum((y[out] - X[out] @ c) ** 2)
    return max(1.0 - float(left.min()) / total, 0.0)


def is_predicted(y, X, block, least: float, shifts: int = 60) -> bool:
    """Whether features X (m, k) predict at least a share `least` of y (m,), and no
    chance does it: more than of any y that is shifted in time against them, forwards
    or backwards in time. (What goes together over a while is followed by chance by
    whatever else does.)

    Args: y, X, block: as predictable_share, in the order of time.
    """
    share = predictable_share(y, X, block)
    if share < least:
        return False
    n = len(y)
    steps = np.linspace(0.1 * n, 0.9 * n, shifts).astype(int)
    return all(
        share > predictable_share(np.roll(other, k), X, block)
        for other in (y, y[::-1])
        for k in steps
    )


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


def by_block(x, train) -> np.ndarray:
    """Sums of x (m,) over blocks of time: the stretches of rows that `train` (m,) has
    in one piece."""
    train = np.asarray(train, bool)
    starts = starts_of_runs(train)
    return np.add.reduceat(np.asarray(x, float), starts)


def paired(one, two, train) -> float:
    """p-value of two models being equally good: Wilcoxon's signed ranks of how their
    squared residuals (m,) differ over blocks of time (by_block). 1 if there are fewer
    than 6.

    Source: Wilcoxon, Biometrics 1(6), 1945; the pairing as in Vuong, Econometrica
    57(2), 1989.
    """
    difference = by_block(np.asarray(one) ** 2 - np.asarray(two) ** 2, train)
    if len(difference) < 6 or not np.abs(difference).max() > 0.0:
        return 1.0
    return float(wilcoxon(difference).pvalue)


def paired_t(one, two, train, channel) -> float:
    """Student's t of how much less two (m,) leaves than one (m,), over held-out blocks
    of time (the stretches of rows that are not `train`): of each block the mean over
    channels of the log of the ratio of their rms. 0 for fewer than four blocks.

    What shows in three of twelve blocks has t < 2 however sure it is, since zeros
    scatter against gains. So it is also asked of those blocks alone in which the two
    differ by what noise lets one see (TOUCHED; whichever of them is better there), and
    of both the larger is given; of few blocks as the deviate of a normal distribution
    with the same p-value. (On noise alone that adds 0.2 % of the trials to the 2 % of
    all blocks.)
    """
    train, channel = np.asarray(train, bool), np.asarray(channel)
    starts = starts_of_runs(train)
    ends = [*starts[1:], len(train)]
    gains, changes = [], []
    for a, b in zip(starts, ends, strict=True):
        if train[a]:
            continue
        each, change = [], 0.0
        for k in np.unique(channel[a:b]):
            mine = channel[a:b] == k
            r, s = one[a:b][mine], two[a:b][mine]
            x, y = np.sum(r**2), np.sum(s**2)
            if x > 0.0 and y > 0.0:
                each.append(0.5 * np.log(x / y))
                change += len(r) * float(np.sum((r - s) ** 2) / x)
        if each:
            gains.append(float(np.mean(each)))
            changes.append(change)
    if len(gains) < 4:
        return 0.0
    whole = _student_t(np.array(gains))
    touched = np.array(gains)[np.array(changes) >= TOUCHED]
    if not FEWEST_TOUCHED <= len(touched) < len(gains):
        return whole
    p_value = student_t.sf(_student_t(touched), len(touched) - 1)
    return max(whole, float(norm.isf(p_value)))


def _student_t(x: np.ndarray) -> float:
    """Of a mean of (n,)."""
    return float(np.mean(x) / max(np.std(x, ddof=1), 1e-12) * len(x) ** 0.5)


def simplest(errors: Sequence[float], sizes: Sequence[int], same: float) -> int:
    """Index of the model with the fewest parameters whose error is within `same` of
    the least; of equally many the one with the least error."""
    least = np.nanmin(errors)
    near = [i for i in range(len(errors)) if errors[i] <= (1.0 + same) * least]
    return min(near, key=lambda i: (sizes[i], errors[i]))


def spread_by_blocks(J, r, block, draws: int = 200) -> np.ndarray:
    """(k,) standard deviations of least squares whose errors go together within a block
    (of time, an episode): the blocks are drawn anew with replacement, each time with
    one Gauss-Newton step. Zeros for fewer than six blocks, and of a parameter that
    fewer than FEWEST_TELL of many blocks tell: draws would be without them.

    Args: J (m, k), r (m,): rows and their derivatives at the solution; block (m,): a
        number of each; negative: rows that are always there, once (a prior's).
    Source: Efron, Tibshirani, An Introduction to the Bootstrap, 1993, ch. 8-9; the
        number of blocks that tell: Kish, Survey Sampling, 1965.
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
    told = np.einsum("gkk->gk", H)[free]
    many = told.sum(axis=0) ** 2 >= min(FEWEST_TELL, LEAST_TELL * n) * np.sum(
        told**2, axis=0
    )
    H, s = H[:, many][:, :, many], s[:, many]
    weights = np.ones((draws, len(names)))
    weights[:, free] = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), draws)
    steps = [
        np.linalg.lstsq(np.tensordot(w, H, 1), -(w @ s), rcond=1e-10)[0]
        for w in weights
    ]
    out = np.zeros(k)
    # Of n blocks a sum's variance comes out (n - 1)/n of what it is.
    out[many] = np.std(steps, axis=0) * np.sqrt(n / (n - 1))
    return out / size


def std_of_shared_errors(columns, errors, prior) -> float:
    """What a parameter's standard deviation has, beside noise, from an unknown factor
    of each channel that acts on all rows of it: the difference of its variances with
    the factors fitted along, and with these known.

    Args: columns (m, n): how rows of n channels change with the parameter; errors
        (m, n): with their factors; prior (n,): standard deviation of each factor.
    """
    a, b, s = (np.asarray(x, float) for x in (columns, errors, prior))
    known = np.sum(a**2)
    if not known > 0.0:
        return 0.0
    both = np.sum(a * b, axis=0)
    own = np.sum(b**2, axis=0) + 1.0 / np.maximum(s, 1e-150) ** 2
    left = known - np.sum(both**2 / own)
    return float(np.sqrt(max(1.0 / left - 1.0 / known, 0.0))) if left > 0.0 else np.inf


def random_effects(x, variance) -> tuple[float, float]:
    """Mean of one quantity that was measured several times, where it may truly differ
    from time to time, and the mean's standard deviation.

    Args: x (n,), variance (n,): values and their own variances, n >= 2.
    Source: DerSimonian, Laird, Meta-analysis in clinical trials, 1986.
    """
    x = np.asarray(x, dtype=float)
    variance = np.maximum(np.asarray(variance, dtype=float), 1e-300)
    w = 1.0 / (variance + between_parts(x, variance))
    return float(w @ x / w.sum()), float(1.0 / np.sqrt(w.sum()))


def between_parts(x, variance) -> float:
    """The variance by which values (n,) differ beyond their own variances (n,); 0 where
    one of them has all of the weight. Source: as of random_effects."""
    x = np.asarray(x, dtype=float)
    w = 1.0 / np.maximum(np.asarray(variance, dtype=float), 1e-300)
    spare = w.sum() - np.sum(w**2) / w.sum()
    if not spare > 1e-12 * w.sum():
        return 0.0
    Q = np.sum(w * (x - w @ x / w.sum()) ** 2)
    return float(max(Q - (len(x) - 1), 0.0) / spare)

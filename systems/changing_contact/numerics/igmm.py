"""Incremental Gaussian mixture over joint vectors, and regression from it.

A sample x joins the components by their posteriors p(j|x), or becomes a component of
its own if it is far from all of them:

    novel:    exp(-1/2 (x - mu_j)' inv(C_j) (x - mu_j)) < tau_nov for all j
    update:   v_j += 1,  sp_j += p(j|x),  w = p(j|x) / sp_j,  e = x - mu_j (old)
              mu_j += w e,   C_j <- C_j - (w e)(w e)' + w (e e' - C_j)
                                  = (1 - w) (C_j + w e e')
    prune:    v_j > v_min and sp_j < sp_min
    weight:   p(j) = sp_j / sum sp

With one component this is the exact batch mean and covariance, the latter with one
sample of covariance sigma_ini^2 added. With the *new* mean in e, as it is often
written, C_j loses positive definiteness as soon as w > 0.38.

C_j is kept as its lower Cholesky factor: the update is one of rank one, which cannot
lose positive definiteness, and the regression of the last entries on the first ones
needs no other matrix:

    L = [L_ii 0; L_oi L_oo]:   x_o | x_i, j  ~  N(mu_o + L_oi inv(L_ii) (x_i - mu_i),
                                                  L_oo L_oo')

Source: Engel and Heinen, "Incremental learning of multivariate Gaussian mixture
models" (2010); Sung, "Gaussian mixture regression and classification" (2004);
"Changing-contact manipulation" (CC) section 3.1, eq. 5 and 6.
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit

# What became of a sample.
UPDATED, CREATED, REFUSED = range(3)

# A sample beyond this many sigma_ini from zero is refused: squares of it stay finite,
# and its difference from a mean is still known to a small part of sigma_ini.
SIGMAS_MAX = 1e9


@dataclass
class IgmmConfig:
    """Units are those of the samples. The defaults but for sigma_ini fit most uses."""

    # Standard deviations (d,) of a component made from one sample [as the samples].
    sigma_ini: list[float] = field(default_factory=list)
    # Likelihood, relative to a component's peak, below which a sample is novel and
    # makes a component of its own.
    tau_nov: float = 1e-3
    # Age after which a component with less support than sp_min is removed [samples].
    v_min: float = 50.0
    sp_min: float = 3.0  # Support that a component needs at the age v_min [samples].
    # Largest number of components; one more takes the place of the least supported.
    n_max: int = 20
    # Least standard deviation of each entry, given those before it, as a fraction of
    # sigma_ini: a constant stream does not make a component that nothing else fits.
    floor: float = 0.01
    # Largest support of a component, so that it forgets older samples [samples].
    sp_max: float = 1e6


@dataclass(frozen=True, eq=False)
class Mixture:
    """A Gaussian mixture: a value, of fixed size whatever it has learned."""

    mean: np.ndarray  # (n_max, d) mu_j.
    factor: np.ndarray  # (n_max, d, d) L_j, lower, C_j = L_j L_j'.
    support: np.ndarray  # (n_max,) sp_j.
    age: np.ndarray  # (n_max,) v_j.
    count: int  # How many components there are; rows beyond are zero.

    def __post_init__(self):
        for array in (self.mean, self.factor, self.support, self.age):
            array.setflags(write=False)

    def __copy__(self):  # It never changes, so a Context may share it.
        return self

    def __deepcopy__(self, _):
        return self

    @property
    def covariance(self) -> np.ndarray:
        """(count, d, d) C_j."""
        L = self.factor[: self.count]
        return L @ L.transpose(0, 2, 1)

    @property
    def weight(self) -> np.ndarray:
        """(count,) p(j)."""
        sp = self.support[: self.count]
        return sp / sp.sum()


@dataclass(frozen=True, eq=False)
class IgmmTuning:
    """A checked config, as the kernels take it."""

    sigma_ini: np.ndarray  # (d,)
    numbers: tuple[float, float, float, float, float]
    n_max: int


def igmm_tuning(config: IgmmConfig) -> IgmmTuning:
    """The config, checked.

    Raises: ValueError that names what is wrong.
    """
    c = config
    sigma = np.array(c.sigma_ini, dtype=float)
    if sigma.ndim != 1 or sigma.size < 1 or not _positive(sigma):
        raise ValueError(f"sigma_ini is {c.sigma_ini}, expected positive numbers")
    for name, low, high in (("tau_nov", 0.0, 1.0), ("floor", 0.0, 1.0)):
        if not low < getattr(c, name) < high:
            raise ValueError(
                f"{name} is {getattr(c, name)}, expected a number in ({low}, {high})"
            )
    if not c.v_min >= 1.0 or not 0.0 <= c.sp_min <= c.v_min:
        raise ValueError(
            f"v_min is {c.v_min} and sp_min {c.sp_min}, expected v_min >= 1 and "
            "0 <= sp_min <= v_min"
        )
    if not c.sp_max > max(c.sp_min, 1.0):
        raise ValueError(f"sp_max is {c.sp_max}, expected more than sp_min and 1")
    if c.n_max != int(c.n_max) or c.n_max < 1:
        raise ValueError(f"n_max is {c.n_max}, expected a whole number of 1 or more")
    numbers = (c.tau_nov, c.v_min, c.sp_min, c.floor, c.sp_max)
    return IgmmTuning(sigma, tuple(float(n) for n in numbers), int(c.n_max))  # type: ignore[arg-type]


def _positive(values) -> bool:
    return bool(np.all(np.isfinite(values)) and np.all(values > 0.0))


def empty_mixture(tuning: IgmmTuning) -> Mixture:
    """A mixture that has seen nothing."""
    n, d = tuning.n_max, tuning.sigma_ini.size
    return Mixture(np.zeros((n, d)), np.zeros((n, d, d)), np.zeros(n), np.zeros(n), 0)


def learned(mixture: Mixture, x, tuning: IgmmTuning) -> tuple[Mixture, int]:
    """The mixture after one more sample.

    Args: x (d,).
    Returns: the mixture, and UPDATED, CREATED, or REFUSED (x is not finite or absurdly
        large; the mixture is the one that came).
    """
    mean, factor = mixture.mean.copy(), mixture.factor.copy()
    support, age = mixture.support.copy(), mixture.age.copy()
    x = np.array(x, dtype=float)
    if x.shape != tuning.sigma_ini.shape:
        raise ValueError(f"x is {x.shape}, expected {tuning.sigma_ini.shape}")
    count, status = _learn(
        mean,
        factor,
        support,
        age,
        mixture.count,
        x,
        tuning.sigma_ini,
        *tuning.numbers,
    )
    if status == REFUSED:
        return mixture, status
    return Mixture(mean, factor, support, age, count), status


def regress(mixture: Mixture, x) -> tuple[np.ndarray, np.ndarray]:
    """The last entries of a joint vector, given the first ones.

    Args: x (n_in,), 0 < n_in < d, finite.
    Returns: their mean (d - n_in,) and covariance. Of an empty mixture, or of an x that
        is not finite or absurdly large: zeros and infinite variances.
    """
    x = np.array(x, dtype=float)
    if x.ndim != 1 or not 0 < x.size < mixture.mean.shape[1]:
        raise ValueError(
            f"x is {x.shape}, expected between 1 and {mixture.mean.shape[1] - 1} "
            "entries of the joint vector"
        )
    return _regress(mixture.mean, mixture.factor, mixture.support, mixture.count, x)


def log_likelihood(mixture: Mixture, x) -> float:
    """log p(x) of a joint vector x (d,), eq. 5; -inf for an empty mixture."""
    terms = [
        np.log(w)
        - 0.5 * np.sum(np.linalg.solve(L, np.asarray(x) - mu) ** 2)
        - np.log(np.diag(L)).sum()
        for w, mu, L in zip(
            mixture.weight if mixture.count else [],
            mixture.mean,
            mixture.factor,
            strict=False,
        )
    ]
    constant = 0.5 * mixture.mean.shape[1] * np.log(2.0 * np.pi)
    return float(np.logaddexp.reduce(terms) - constant) if terms else -np.inf


def as_vector(mixture: Mixture) -> np.ndarray:
    """All of it as one vector, for a Context's discrete state or a file."""
    arrays = (mixture.mean, mixture.factor, mixture.support, mixture.age)
    return np.concatenate([*(a.ravel() for a in arrays), [mixture.count]])


def from_vector(vector, tuning: IgmmTuning) -> Mixture:
    """What as_vector made.

    Raises: ValueError if the vector is of another size, not finite, or no mixture.
    """
    vector = np.array(vector, dtype=float)
    n, d = tuning.n_max, tuning.sigma_ini.size
    sizes = [n * d, n * d * d, n, n, 1]
    if vector.shape != (sum(sizes),) or not np.all(np.isfinite(vector)):
        raise ValueError(
            f"a mixture of {n} components over {d} entries has {sum(sizes)} finite "
            f"numbers, got {vector.shape}"
        )
    mean, factor, support, age, count = np.split(vector, np.cumsum(sizes)[:-1])
    factor, k = factor.reshape(n, d, d), int(count[0])
    if not 0 <= k <= n or not _positive(support[:k]):
        raise ValueError(f"a mixture has {k} components of support {support[:k]}")
    if np.any(np.triu(factor, 1)) or not _positive(
        np.diagonal(factor[:k], axis1=1, axis2=2)
    ):
        raise ValueError("a mixture's covariance is not positive definite")
    return Mixture(mean.reshape(n, d).copy(), factor.copy(), support, age, k)


def warm_up(tuning: IgmmTuning, n_in: int) -> None:
    """Compiles both kernels now, not at the first sample."""
    d = tuning.sigma_ini.size
    mixture, _ = learned(empty_mixture(tuning), np.zeros(d), tuning)
    mixture, _ = learned(mixture, np.zeros(d), tuning)
    regress(mixture, np.zeros(n_in))


@njit(cache=True)
def _forward_solve(L, b, n):
    """In place: the first n entries of b become inv(L) b."""
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * b[k]
        b[i] = s / L[i, i]


@njit(cache=True)
def _add_rank_one(L, v, first):
    """In place: L of L L' + v v', v (d,) zero before `first`; v is overwritten."""
    d = v.size
    for k in range(first, d):
        r = np.sqrt(L[k, k] ** 2 + v[k] ** 2)
        c, s = r / L[k, k], v[k] / L[k, k]
        L[k, k] = r
        for i in range(k + 1, d):
            L[i, k] = (L[i, k] + s * v[i]) / c
            v[i] = c * v[i] - s * L[i, k]


@njit(cache=True)
def _learn(
    mean, factor, support, age, count, x, sigma, tau_nov, v_min, sp_min, floor, sp_max
):
    """In place, as in the module. Returns: count, status."""
    d = x.size
    for i in range(d):
        if not abs(x[i]) <= SIGMAS_MAX * sigma[i]:
            return count, REFUSED
    log_p = np.empty(count)
    e = np.empty(d)
    nearest = np.inf
    for j in range(count):
        for i in range(d):
            e[i] = x[i] - mean[j, i]
        _forward_solve(factor[j], e, d)
        d2, log_det = 0.0, 0.0
        for i in range(d):
            d2 += e[i] * e[i]
            log_det += np.log(factor[j, i, i])
        nearest = min(nearest, d2)
        log_p[j] = np.log(support[j]) - 0.5 * d2 - log_det
    if not 0.5 * nearest <= -np.log(tau_nov):
        j = count
        if count == mean.shape[0]:
            j = int(np.argmin(support[:count]))
        else:
            count += 1
        mean[j] = x
        factor[j] = 0.0
        for i in range(d):
            factor[j, i, i] = sigma[i]
        support[j] = age[j] = 1.0
        return count, CREATED
    log_p -= log_p.max()
    p = np.exp(log_p)
    p /= p.sum()
    for j in range(count):
        age[j] += 1.0
        if p[j] < 1e-12:
            continue
        support[j] += p[j]
        w = p[j] / support[j]
        support[j] = min(support[j], sp_max)
        root = np.sqrt(1.0 - w)
        for i in range(d):
            e[i] = x[i] - mean[j, i]
            mean[j, i] += w * e[i]
            e[i] *= np.sqrt(w) * root
            for k in range(i + 1):
                factor[j, i, k] *= root
        _add_rank_one(factor[j], e, 0)
        for i in range(d):
            low = floor * sigma[i]
            if factor[j, i, i] < low:
                e[:] = 0.0
                e[i] = np.sqrt(low * low - factor[j, i, i] ** 2)
                _add_rank_one(factor[j], e, i)
    kept = 0
    for j in range(count):
        if age[j] > v_min and support[j] < sp_min and kept + count - j > 1:
            continue
        if kept < j:
            mean[kept], factor[kept] = mean[j], factor[j]
            support[kept], age[kept] = support[j], age[j]
        kept += 1
    for j in range(kept, count):
        mean[j], factor[j] = 0.0, 0.0
        support[j] = age[j] = 0.0
    return kept, UPDATED


@njit(cache=True)
def _regress(mean, factor, support, count, x):
    """As regress()."""
    d, n_in = mean.shape[1], x.size
    n_out = d - n_in
    y, C = np.zeros(n_out), np.zeros((n_out, n_out))
    if count == 0 or not np.all(np.isfinite(x)):
        for i in range(n_out):
            C[i, i] = np.inf
        return y, C
    each = np.empty((count, n_out))
    log_h = np.empty(count)
    e = np.empty(n_in)
    for j in range(count):
        for i in range(n_in):
            e[i] = x[i] - mean[j, i]
        _forward_solve(factor[j], e, n_in)
        log_h[j] = np.log(support[j])
        for i in range(n_in):
            log_h[j] -= 0.5 * e[i] * e[i] + np.log(factor[j, i, i])
        for o in range(n_out):
            each[j, o] = mean[j, n_in + o]
            for i in range(n_in):
                each[j, o] += factor[j, n_in + o, i] * e[i]
    if not log_h.max() > -np.inf:  # So far off that the squares overflow.
        for i in range(n_out):
            C[i, i] = np.inf
        return y, C
    log_h -= log_h.max()
    h = np.exp(log_h)
    h /= h.sum()
    for j in range(count):
        for o in range(n_out):
            y[o] += h[j] * each[j, o]
    for j in range(count):
        for o in range(n_out):
            for q in range(n_out):
                C[o, q] += h[j] * (each[j, o] - y[o]) * (each[j, q] - y[q])
                for k in range(n_out):
                    L_o = factor[j, n_in + o, n_in + k]
                    C[o, q] += h[j] * L_o * factor[j, n_in + q, n_in + k]
    return y, C

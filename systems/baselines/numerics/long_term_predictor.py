"""Long-term prediction of contact-rich motion, learned offline: modes, a support vector
machine that predicts them, Gaussian processes (GP) within and between them, and the
propagation of a distribution over many steps.

    modes        Dirichlet process Gaussian mixture over features of the training trials
    gating       SVM: (x_t, u_t) -> mode of t + 1
    experts      one GP per mode and output:            x_{t+1} - x_t, or x_{t+1}
    transitions  one GP per seen pair of modes and output: the same, at the change
    prediction   a track per (mode before, mode): mean, covariance, probability. Samples
                 of a track vote through the SVM; each vote's share goes its own way, by
                 unscented transform through policy and expert, or transition; tracks
                 that meet are merged by their moments, tracks below 1 % are dropped.

u is what acts on the system: known beforehand, or given by a policy u(t, x), through
which the distribution of x passes too.

Source: Khader, Yin, Falco, Kragic, "Data-efficient model learning and prediction for
contact-rich manipulation tasks", IEEE RA-L 5 (2020), as far as its abstract and public
code describe the method. Rasmussen and Williams, "Gaussian processes for machine
learning" (2006), eq. 2.25, 2.26, 5.8, 5.9.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.mixture import BayesianGaussianMixture
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.svm import SVC

# Bounds of the hyperparameters, for inputs and outputs of unit variance.
SIGNAL_BOUNDS = (1e-3, 1e3)
LENGTH_BOUNDS = (1e-1, 1e3)
NOISE_BOUNDS = (1e-6, 1e1)
SVM_GRID = {"C": [1.0, 8.0, 64.0, 512.0], "gamma": [2.0**-8, 2.0**-6, 2.0**-4, 0.25]}
KAPPA = 2.0  # Of the unscented transform, with alpha 1 and beta 0.
SAMPLES_PER_DIMENSION = 3  # Samples that vote for the next mode.
# With fewer changes between two modes the step is that of the expert of the new mode,
# not of a transition GP. (A GP of 20 inputs from a dozen changes throws the state far
# outside the data of the experts, which then do not recover.)
POINTS_MIN = 30
JITTER = 1e-9


@dataclass
class TrainingBudget:
    # Largest number of training points of a Gaussian process (GP).
    points_per_mode: int = 200
    # Largest number of training points of the support vector machine.
    svm_points: int = 2000
    # Number of components of the mixture of modes, some of which may stay empty.
    modes_max: int = 10
    # Length below which a segment gets the mode of the one before [samples].
    segment_min: int = 10
    # Number of random restarts of the likelihood maximisation of each GP.
    restarts: int = 1
    # Whether GPs predict x_{t+1} - x_t; false: x_{t+1}. For one_step of wall_friction
    # both are trained.
    predict_change: bool = True
    # Seed of the clustering, the choice of training points and the restarts.
    seed: int = 0


class TrainingTrial(NamedTuple):
    """One training trial; row t is taken at time t dt."""

    x: np.ndarray  # (T, n_x) predicted quantities.
    u: np.ndarray  # (T, n_u) quantities that are known beforehand, or measured.
    features: np.ndarray  # (T, n_f) features that distinguish the modes.


@dataclass(frozen=True, eq=False)
class GaussianProcesses:
    """One GP per output, over the same n inputs: squared exponential and noise.

    k(a, b) = signal exp(-1/2 sum_i ((a_i - b_i) / length_i)^2) + noise [a is b], on
    inputs less x_mean over x_scale, outputs less y_mean over y_scale.
    """

    X: np.ndarray  # (n, d) standardised.
    signal: np.ndarray  # (m,)
    length: np.ndarray  # (m, d)
    noise: np.ndarray  # (m,)
    weights: np.ndarray  # (m, n) inv(K + noise I) y
    factor: np.ndarray  # (m, n, n) inverse of the lower factor of K + noise I.
    x_mean: np.ndarray  # (d,)
    x_scale: np.ndarray  # (d,)
    y_mean: np.ndarray  # (m,)
    y_scale: np.ndarray  # (m,)

    def _kernels(self, X):
        """(m, k, n) between k standardised inputs and the n known ones."""
        for j in range(len(self.signal)):
            A, B = X / self.length[j], self.X / self.length[j]
            square = (A**2).sum(1)[:, None] + (B**2).sum(1) - 2.0 * A @ B.T
            yield self.signal[j] * np.exp(-0.5 * np.maximum(square, 0.0))

    def mean(self, X) -> np.ndarray:
        """(k, m) expected outputs at X (k, d)."""
        X = (X - self.x_mean) / self.x_scale
        columns = [K @ w for K, w in zip(self._kernels(X), self.weights, strict=True)]
        return self.y_mean + self.y_scale * np.stack(columns, axis=1)

    def predict(self, X) -> tuple[np.ndarray, np.ndarray]:
        """(k, m) means and (k, m) variances of the outputs, their noise included."""
        Z = (X - self.x_mean) / self.x_scale
        means, variances = [], []
        for j, K in enumerate(self._kernels(Z)):
            means.append(K @ self.weights[j])
            explained = ((self.factor[j] @ K.T) ** 2).sum(0)
            variances.append(self.signal[j] - explained + self.noise[j])
        variance = np.maximum(np.stack(variances, axis=1), JITTER)
        mean = self.y_mean + self.y_scale * np.stack(means, axis=1)
        return mean, variance * self.y_scale**2


def log_marginal_likelihood(theta, X, y, ard: bool):
    """Of data X (n, d), y (n,) and its gradient.

    The gradient's n^2 d terms are two matrix products, where the general formula has
    an (n, n, d) array: about ten times faster at n = 200, d = 20.

    Args: theta: logarithms of [signal, length (d, or 1 if not ard), noise].
    Returns: the value, the gradient by theta. -inf, 0 where K is not positive definite.
    """
    signal, noise = np.exp(theta[0]), np.exp(theta[-1])
    A = X / np.exp(theta[1:-1])
    norm = (A**2).sum(1)
    square = np.maximum(norm[:, None] + norm - 2.0 * A @ A.T, 0.0)
    K = signal * np.exp(-0.5 * square)
    try:
        L = cholesky(K + (noise + JITTER) * np.eye(len(y)), lower=True)
    except np.linalg.LinAlgError:
        return -np.inf, np.zeros_like(theta)
    alpha = cho_solve((L, True), y)
    value = (
        -0.5 * y @ alpha - np.log(np.diag(L)).sum() - 0.5 * len(y) * np.log(2 * np.pi)
    )
    # d value = 1/2 tr(G dK), G = alpha alpha' - inv(K + noise I).
    G = np.outer(alpha, alpha) - cho_solve((L, True), np.eye(len(y)))
    W = G * K
    lengths = (
        (W.sum(1) @ A**2 - (A * (W @ A)).sum(0)) if ard else 0.5 * (W * square).sum()
    )
    gradient = np.concatenate(
        [[0.5 * W.sum()], np.atleast_1d(lengths), [0.5 * noise * np.trace(G)]]
    )
    return value, gradient


def fit_gp(X, Y, x_mean, x_scale, restarts=1, ard=True, seed=0) -> GaussianProcesses:
    """GPs of the columns of Y (n, m) over X (n, d), hyperparameters by the largest
    marginal likelihood.

    The regression is scikit-learn's; what it is given in place of its own optimiser
    evaluates the same likelihood faster.

    Args: x_mean, x_scale (d,) that standardise the inputs; restarts, from random
        hyperparameters, beside the first; ard: a length for each input, or one for all.
    Raises: ValueError for data that are not finite, or of other shapes.
    """
    X, Y = np.asarray(X, dtype=float), np.asarray(Y, dtype=float)
    if X.ndim != 2 or Y.ndim != 2 or len(X) != len(Y) or len(X) < 2:
        raise ValueError(
            f"GP data are {X.shape} and {Y.shape}, expected (n, d) and (n, m), n >= 2"
        )
    if not (np.isfinite(X).all() and np.isfinite(Y).all()):
        raise ValueError("GP data have a NaN or an infinity, expected finite numbers")
    Z = (X - x_mean) / x_scale
    y_mean, y_scale = Y.mean(0), Y.std(0)
    y_scale = np.where(y_scale > 1e-12, y_scale, 1.0)
    n, d = Z.shape
    signal, length, noise, weights, factor = [], [], [], [], []
    for j in range(Y.shape[1]):
        y = (Y[:, j] - y_mean[j]) / y_scale[j]

        def maximise(_, start, bounds, y=y):
            def cost(theta):
                value, gradient = log_marginal_likelihood(theta, Z, y, ard)
                return (-value, -gradient) if np.isfinite(value) else (1e25, gradient)

            found = minimize(
                cost,
                start,
                jac=True,
                method="L-BFGS-B",
                bounds=bounds,
                options={"maxiter": 60},
            )
            return found.x, found.fun

        lengths = np.full(d if ard else 1, 1.0)
        kernel = ConstantKernel(1.0, SIGNAL_BOUNDS) * RBF(
            lengths if ard else 1.0, LENGTH_BOUNDS
        ) + WhiteKernel(0.1, NOISE_BOUNDS)
        gp = GaussianProcessRegressor(
            kernel,
            alpha=JITTER,
            optimizer=maximise,
            n_restarts_optimizer=restarts,
            random_state=seed,
        )
        with warnings.catch_warnings():
            # A length at its bound is an input that does not matter.
            warnings.simplefilter("ignore", ConvergenceWarning)
            gp.fit(Z, y)
        best = np.exp(gp.kernel_.theta)
        signal.append(best[0])
        length.append(np.broadcast_to(best[1:-1], d))
        noise.append(best[-1])
        weights.append(gp.alpha_)
        factor.append(solve_triangular(gp.L_, np.eye(n), lower=True))
    return GaussianProcesses(
        Z,
        np.array(signal),
        np.array(length),
        np.array(noise),
        np.array(weights),
        np.array(factor),
        np.asarray(x_mean, dtype=float),
        np.asarray(x_scale, dtype=float),
        y_mean,
        y_scale,
    )


def find_modes(features: Sequence[np.ndarray], budget: TrainingBudget):
    """The mode of each sample of each trial, by unsupervised clustering.

    Args: features: one (T, n_f) per trial.
    Returns: one (T,) of integers 0, 1, ... per trial, numbered by first appearance.
    """
    flat = np.concatenate(features)
    scale = flat.std(0)
    flat = (flat - flat.mean(0)) / np.where(scale > 1e-12, scale, 1.0)
    rng = np.random.default_rng(budget.seed)
    some = rng.permutation(len(flat))[:8000]  # More do not change the mixture.
    mixture = BayesianGaussianMixture(
        n_components=min(budget.modes_max, len(flat) // 2),
        weight_concentration_prior_type="dirichlet_process",
        weight_concentration_prior=0.1,
        n_init=2,
        max_iter=200,
        reg_covar=1e-4,
        random_state=budget.seed,
    )
    with warnings.catch_warnings():
        # It stops at max_iter, as unused components fade slowly.
        warnings.simplefilter("ignore", ConvergenceWarning)
        mixture.fit(flat[some])
    labels, start = [], 0
    for trial in features:
        found = mixture.predict(flat[start : start + len(trial)])
        labels.append(without_short_stays(found, budget.segment_min))
        start += len(trial)
    order = list(dict.fromkeys(np.concatenate(labels)))  # By first appearance.
    return [np.array([order.index(m) for m in trial]) for trial in labels]


def without_short_stays(labels, shortest: int) -> np.ndarray:
    """labels (T,) in which segments shorter than `shortest` have the mode before them
    (the first ones: the mode after them)."""
    labels = np.array(labels)
    edges = np.flatnonzero(np.diff(labels)) + 1
    starts, ends = [0, *edges], [*edges, len(labels)]
    kept = None
    for start, end in zip(starts, ends, strict=True):
        if end - start >= shortest:
            if kept is None:
                labels[:start] = labels[start]
            kept = labels[start]
        elif kept is not None:
            labels[start:end] = kept
    return labels


@dataclass(frozen=True, eq=False)
class LongTermPredictor:
    """The trained models."""

    svm: Any  # Its predict((k, n_x + n_u) standardised) gives (k,) modes.
    experts: dict[int, Any]  # mode -> GaussianProcesses
    transitions: dict[tuple[int, int], Any]  # (from, to) -> the same; None: the expert.
    gp_inputs: tuple[int, ...]  # Columns of [x, u] that the GPs are given.
    mean: np.ndarray  # (n_x + n_u,) standardises [x, u] for the SVM.
    scale: np.ndarray  # (n_x + n_u,)
    predict_change: bool
    n_x: int

    def __copy__(self):
        return self

    def __deepcopy__(self, _):
        return self

    def next_modes(self, xu) -> np.ndarray:
        """(k,) the SVM's modes one step after [x, u] (k, n_x + n_u)."""
        return np.asarray(self.svm.predict((xu - self.mean) / self.scale), dtype=int)

    def model(self, before: int, after: int):
        """The GPs of a step from one mode to another, or within one."""
        if before != after:
            found = self.transitions.get((before, after))
            if found is not None:
                return found
        return self.experts[after]

    def reachable(self, before: int, after: int) -> bool:
        """Whether training has seen this change, or it is none."""
        return before == after or (before, after) in self.transitions


def one_of_each_stratum(n: int, wanted: int, rng) -> np.ndarray:
    """At most `wanted` of the indices 0 .. n-1, one at random from each of as many
    equal intervals, so that all trials and times are represented."""
    if n <= wanted:
        return np.arange(n)
    edges = np.linspace(0, n, wanted + 1).astype(int)
    return rng.integers(edges[:-1], edges[1:])


def train(
    trials: Sequence[TrainingTrial],
    budget: TrainingBudget,
    gp_inputs: Sequence[int] | None = None,
) -> tuple[LongTermPredictor, list[np.ndarray]]:
    """Learns modes, gating, experts and transitions.

    Args: trials, all of one kind; gp_inputs: columns of [x, u] that the GPs are given,
        None: all.
    Returns: the predictor; the modes of each trial, (T,) each.
    Raises: ValueError for trials that do not fit together or are not finite.
    """
    if len(trials) < 3:
        raise ValueError(f"trials: got {len(trials)}, expected 3 or more")
    n_x, n_u = trials[0].x.shape[1], trials[0].u.shape[1]
    for i, trial in enumerate(trials):
        T = len(trial.x)
        if trial.x.shape != (T, n_x) or trial.u.shape != (T, n_u) or T < 3:
            raise ValueError(
                f"trial {i} has x {trial.x.shape} and u {trial.u.shape}, expected "
                f"(T, {n_x}) and (T, {n_u}), T >= 3"
            )
        if not all(np.isfinite(values).all() for values in trial):
            raise ValueError(f"trial {i} has a NaN or an infinity")
    columns = tuple(range(n_x + n_u) if gp_inputs is None else gp_inputs)
    labels = find_modes([trial.features for trial in trials], budget)
    rng = np.random.default_rng(budget.seed)

    before = np.concatenate([m[:-1] for m in labels])
    after = np.concatenate([m[1:] for m in labels])
    xu = np.concatenate([np.hstack([t.x, t.u])[:-1] for t in trials])
    out = np.concatenate([t.x[1:] for t in trials])
    if budget.predict_change:
        out = out - xu[:, :n_x]
    group = np.concatenate([np.full(len(t.x) - 1, i) for i, t in enumerate(trials)])
    mean, scale = xu.mean(0), xu.std(0)
    scale = np.where(scale > 1e-12, scale, 1.0)

    def learn(chosen, ard):
        chosen = chosen[one_of_each_stratum(len(chosen), budget.points_per_mode, rng)]
        x_mean, x_scale = mean[list(columns)], scale[list(columns)]
        return fit_gp(
            xu[np.ix_(chosen, columns)],
            out[chosen],
            x_mean,
            x_scale,
            budget.restarts,
            ard,
            budget.seed,
        )

    experts, transitions = {}, {}
    for mode in np.unique(np.concatenate(labels)):
        within = np.flatnonzero((before == mode) & (after == mode))
        experts[int(mode)] = learn(within, ard=True)
    changed = before != after
    for a, b in sorted(set(zip(before[changed], after[changed], strict=True))):
        between = np.flatnonzero((before == a) & (after == b))
        enough = len(between) >= POINTS_MIN
        transitions[int(a), int(b)] = learn(between, ard=False) if enough else None
    svm = _fit_svm((xu - mean) / scale, after, changed, group, budget, rng)
    gps = LongTermPredictor(
        svm, experts, transitions, columns, mean, scale, budget.predict_change, n_x
    )
    return gps, labels


class _OneMode:
    """The gating where training has seen one mode only."""

    def __init__(self, mode: int):
        self._mode = mode

    def predict(self, xu):
        return np.full(len(xu), self._mode)


def _fit_svm(xu, after, changed, group, budget: TrainingBudget, rng):
    """SVM of the next mode, its C and gamma by cross-validation over whole trials."""
    if len(np.unique(after)) < 2:
        return _OneMode(int(after[0]))
    # All samples around a change are kept: they say where it happens.
    near = np.convolve(changed, np.ones(11), mode="same") > 0.5
    near_indices, far = np.flatnonzero(near), np.flatnonzero(~near)
    half = budget.svm_points // 2
    chosen = near_indices[one_of_each_stratum(len(near_indices), half, rng)]
    rest = far[one_of_each_stratum(len(far), budget.svm_points - len(chosen), rng)]
    chosen = np.concatenate([chosen, rest])
    search = GridSearchCV(SVC(kernel="rbf"), SVM_GRID, cv=GroupKFold(3))
    search.fit(xu[chosen], after[chosen], groups=group[chosen])
    return search.best_estimator_


def known(u):
    """A policy that is the sequence u (T, n_u), whatever x is."""
    return lambda t, x: np.broadcast_to(u[t], (len(x), np.shape(u)[1]))


class Prediction(NamedTuple):
    """Distribution over time, row 0 the start: moments of the mixture of all tracks."""

    mean: np.ndarray  # (T + 1, n_x)
    std: np.ndarray  # (T + 1, n_x)
    mode: np.ndarray  # (T + 1,) the most probable one.


def sigma_points(mean, covariance):
    """(2 n + 1, n) points and their weights (2 n + 1,), the mean first."""
    n = len(mean)
    L = np.linalg.cholesky((n + KAPPA) * (covariance + JITTER * np.eye(n)))
    points = np.vstack([mean, mean + L.T, mean - L.T])
    weights = np.full(2 * n + 1, 0.5 / (n + KAPPA))
    weights[0] = KAPPA / (n + KAPPA)
    return points, weights


def through(model, points, weights, u, gp_inputs, predict_change):
    """Moments (n_x,), (n_x, n_x) of x_{t+1}, from sigma points (k, n_x) of x_t and
    their u (k, n_u)."""
    xu = np.hstack([points, u])[:, list(gp_inputs)]
    y = model.mean(xu)
    _, variance = model.predict(xu[:1])
    if predict_change:
        y = y + points
    mean = weights @ y
    spread = y - mean
    covariance = (weights[:, None] * spread).T @ spread + np.diag(variance[0])
    return mean, 0.5 * (covariance + covariance.T)


def predict_long_term(
    predictor: LongTermPredictor,
    mean,
    covariance,
    policy: Callable[[int, np.ndarray], np.ndarray],
    T: int,
    mode: int = 0,
    seed: int = 0,
    probability_min: float = 0.01,
) -> Prediction:
    """Where x will be, without any further measurement.

    Args: mean (n_x,), covariance (n_x, n_x) of x_0; policy(t, x (k, n_x)) gives the u
        (k, n_u) of step t; T, steps; mode, of x_0; seed of the samples that vote;
        probability_min, of a track that is followed.
    Returns: for x_0 ... x_T.
    """
    rng = np.random.default_rng(seed)
    p = predictor
    n_x = p.n_x
    n_votes = SAMPLES_PER_DIMENSION * len(p.mean)
    # (mode before, mode) -> probability, mean, covariance.
    tracks = {(mode, mode): (1.0, np.array(mean, float), np.array(covariance, float))}
    means, stds, modes = np.empty((T + 1, n_x)), np.empty((T + 1, n_x)), np.empty(T + 1)

    def note(t):
        total = sum(share for share, _, _ in tracks.values())
        m = sum(share * m for share, m, _ in tracks.values()) / total
        second = sum(
            share * (np.diag(C) + (mu - m) ** 2) for share, mu, C in tracks.values()
        )
        means[t], stds[t] = m, np.sqrt(np.maximum(second / total, 0.0))
        by_mode: dict[int, float] = {}
        for (_, now), (share, _, _) in tracks.items():
            by_mode[now] = by_mode.get(now, 0.0) + share
        modes[t] = max(by_mode, key=lambda key: by_mode[key])

    note(0)
    for t in range(T):
        arriving: dict[tuple[int, int], list] = {}
        for (earlier, now), (share, mu, C) in tracks.items():
            samples = rng.multivariate_normal(mu, C, n_votes, method="eigh")
            votes = p.next_modes(np.hstack([samples, policy(t, samples)]))
            allowed = np.array([p.reachable(now, int(v)) for v in votes])
            samples, votes = samples[allowed], votes[allowed]
            goals, counts = (
                np.unique(votes, return_counts=True) if len(votes) else ([now], [1])
            )
            for goal, count in zip(goals, counts, strict=True):
                goal, part = int(goal), share * count / np.sum(counts)
                if part < probability_min:
                    continue
                start = (mu, C) if goal == now else moments(samples[votes == goal])
                points, weights = sigma_points(*start)
                after = through(
                    p.model(now, goal),
                    points,
                    weights,
                    policy(t, points),
                    p.gp_inputs,
                    p.predict_change,
                )
                key = (earlier if goal == now else now, goal)
                arriving.setdefault(key, []).append((part, *after))
        if arriving:
            tracks = {key: merged(parts) for key, parts in arriving.items()}
        note(t + 1)
    return Prediction(means, stds, modes.astype(int))


def moments(samples):
    """Mean (n,) and covariance (n, n) of the samples (k, n) that voted for a change."""
    spread = samples - samples.mean(0)
    return samples.mean(0), spread.T @ spread / len(samples)


def merged(parts):
    """One (probability, mean, covariance) with the moments of several."""
    total = sum(share for share, _, _ in parts)
    mean = sum(share * mu for share, mu, _ in parts) / total
    covariance = sum(
        share * (C + np.outer(mu - mean, mu - mean)) for share, mu, C in parts
    )
    return total, mean, covariance / total


def predict_one_step(predictor: LongTermPredictor, x, u, mode: int):
    """x_{t+1} from what was measured at t.

    Args: x (n_x,), u (n_u,); mode, of t.
    Returns: mean (n_x,), standard deviation (n_x,), the mode of t + 1.
    """
    xu = np.concatenate([x, u])[None]
    after = int(predictor.next_modes(xu)[0])
    if not predictor.reachable(mode, after):
        # With feedback the measurement counts more than the transitions in training.
        mode = after
    model = predictor.model(mode, after)
    mean, variance = model.predict(xu[:, list(predictor.gp_inputs)])
    out = mean[0] + x if predictor.predict_change else mean[0]
    return out, np.sqrt(variance[0]), after

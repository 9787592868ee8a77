"""A Gaussian mixture fitted once, to all samples at once, and never updated."""

import numpy as np
from sklearn.mixture import GaussianMixture

from makebreak.systems.changing_contact.numerics.igmm import Mixture


def fit_mixture(samples, n_min: int = 1, n_max: int = 10, seed: int = 0) -> Mixture:
    """Expectation maximisation, with as many components as the Bayesian information
    criterion chooses.

    Args:
        samples: (n, d) joint vectors, as an incremental mixture would learn.
        n_min, n_max: the fewest and the most components that are tried.
        seed: of the initial guesses.
    Returns: a mixture for the same regression as the incremental one's.
    Raises: ValueError for samples that are too few or not finite.
    Source: "Changing-contact manipulation" (CC) section 4.1: the model pretrained on
        the same data.
    """
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or not np.isfinite(samples).all():
        raise ValueError(f"samples is {samples.shape}, expected (n, d), finite")
    if not 1 <= n_min <= n_max:
        raise ValueError(
            f"n_min is {n_min}, n_max {n_max}; expected 1 <= n_min <= n_max"
        )
    if len(samples) < 10 * n_max:
        raise ValueError(
            f"{len(samples)} samples, expected at least {10 * n_max} for {n_max} "
            "components"
        )
    # Entries of different units: scaled, so that the guesses (k-means) are fair.
    scale = samples.std(axis=0) + 1e-12
    fits = [
        GaussianMixture(n, random_state=seed, reg_covar=1e-6).fit(samples / scale)
        for n in range(n_min, n_max + 1)
    ]
    best = min(fits, key=lambda fit: fit.bic(samples / scale))
    C = best.covariances_ * scale[:, None] * scale[None, :]
    support = best.weights_ * len(samples)
    return Mixture(
        best.means_ * scale,
        np.linalg.cholesky(C),
        support,
        support.copy(),
        best.n_components,
    )

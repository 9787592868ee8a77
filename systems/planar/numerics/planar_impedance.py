"""Adaptive variable impedance in the plane: stiff where the force model is bad.

    u      = m a_d + K (p_d - p) + D (v_d - v) - lambda F_pred                (4a)
    K      = K_free + (1 - lambda) (K_max - K_free)                           (4b)
    lambda = 1 - 1 / (1 + exp(-r (eps - eps_0)))                              (4c)

F_pred is the predicted force of the world on the effector, so the feed-forward is its
negative. D = 2 zeta sqrt(K m): zeta = 1 is critical damping. The paper's D = sqrt(K)/4,
in SI units and for 1 kg, is zeta = 1/8, far from the critical damping that the paper
names; damping_ratio = 0.125 gives it.

The model is an incremental Gaussian mixture over [S, D']
(changing_contact/numerics/igmm.py), with S measured now and D' the force one model
period later. Either S = [v, F] and D' = F' as vectors, because a spring's force does
not depend on the direction of motion; or, as in eq. 2 and 3, S = [|v|, f] and D' = f'
with f the force against the motion. S = [p, v, F] can predict forces that change at
certain places of a repeated path.

Source: "Changing-contact manipulation" (CC) section 3.1, eq. 2 to 4, 6.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from makebreak.systems.changing_contact.numerics.igmm import (
    IgmmTuning,
    Mixture,
    empty_mixture,
    learned,
    regress,
)
from makebreak.systems.planar.numerics.planar_world import limited

# Weight of the newest prediction error; at 200 Hz a low-pass filter of 14 ms.
ERROR_WEIGHT = 0.3
SPEED_MIN = 1e-3  # Below this speed a motion has no direction [m/s].


def trust(error, steepness, midpoint):
    """lambda of eq. 4c, in (0, 1).

    Args: error, eps [N]; steepness, r [1/N]; midpoint, eps_0 [N].
    """
    # Beyond 700 the exponential leaves the range of floating-point numbers.
    return 1.0 / (1.0 + np.exp(min(steepness * (error - midpoint), 700.0)))


@njit(cache=True)
def stiffness_of(trust, stiffness_free, stiffness_max):
    """K of eq. 4b [N/m]."""
    return stiffness_free + (1.0 - trust) * (stiffness_max - stiffness_free)


@njit(cache=True)
def force_command(
    state, target, trust, stiffness, predicted, mass, damping_ratio, force_max
):
    """u of eq. 4a, within the limit.

    Args:
        state: (4,) p, v [m], [m/s].
        target: (6,) p, v, a [m], [m/s], [m/s2].
        trust: lambda; stiffness: K [N/m]; predicted: F_pred (2,) [N].
        mass [kg]; damping_ratio: zeta; force_max [N].
    Returns: u (2,) [N].
    """
    D = 2.0 * damping_ratio * np.sqrt(stiffness * mass)
    u = np.empty(2)
    for i in range(2):
        u[i] = mass * target[4 + i] - trust * predicted[i]
        u[i] += stiffness * (target[i] - state[i])
        u[i] += D * (target[2 + i] - state[2 + i])
    return limited(u, force_max)


@dataclass(frozen=True, eq=False)
class ForceModel:
    """State of the forward model: what it has learned, and its last prediction."""

    mixture: Mixture
    features: np.ndarray | None  # S of the last sample; None: there was none.
    measured: np.ndarray  # D of the last sample [N].
    predicted: np.ndarray  # Predicted D of the next sample [N].
    error: float  # |measured - predicted| of the last sample [N]; NaN: no prediction.
    filtered: float  # The error, low-pass filtered; infinite: no prediction yet [N].

    def __copy__(self):  # Every part is immutable, so a Context may share it.
        return self

    def __deepcopy__(self, _):
        return self


def new_model(tuning: IgmmTuning, mixture: Mixture | None, along_motion: bool):
    """A model before its first sample. Args: mixture: learned earlier; None: empty."""
    n = 1 if along_motion else 2
    zero = _frozen(np.zeros(n))
    mixture = empty_mixture(tuning) if mixture is None else mixture
    return ForceModel(mixture, None, zero, zero, np.nan, np.inf)


def _frozen(array) -> np.ndarray:
    array.setflags(write=False)
    return array


def features_of(state, force, along_motion: bool, position: bool = False):
    """S and D of one sample.

    Args: state (4,); force (2,): measured, of the world on the effector [N]; position:
        whether S contains the position (not with along_motion).
    Returns: S (n,), D (m,).
    """
    if not along_motion:
        return np.concatenate([state if position else state[2:], force]), force
    against = np.array([-force @ direction_of(state)])
    return np.concatenate([[np.hypot(state[2], state[3])], against]), against


def direction_of(state):
    """Unit vector of the velocity, (2,); zero at rest."""
    speed = np.hypot(state[2], state[3])
    return state[2:] / speed if speed > SPEED_MIN else np.zeros(2)


def predicted_force(model: ForceModel, state, along_motion: bool):
    """F_pred as a vector (2,) [N]. Args: state (4,): gives the direction of motion."""
    if along_motion:
        return -model.predicted[0] * direction_of(state)
    return model.predicted.copy()


def after_sample(
    model: ForceModel,
    tuning: IgmmTuning,
    state,
    force,
    along_motion: bool,
    learn: bool,
    position: bool = False,
) -> ForceModel:
    """The model after one more sample, with its prediction of the next one.

    A sample that is not finite is dropped, with the pair that it belongs to.

    Args: as features_of; learn: whether the mixture learns from the sample.
    """
    S, D = features_of(state, force, along_motion, position)
    mixture, error, filtered = model.mixture, np.nan, model.filtered
    if not (np.isfinite(S).all() and np.isfinite(D).all()):
        nothing = _frozen(np.zeros_like(model.predicted))
        return ForceModel(mixture, None, model.measured, nothing, np.nan, np.inf)
    if model.features is not None:
        if mixture.count > 0:
            error = float(np.sqrt(np.sum((D - model.predicted) ** 2)))
            known = np.isfinite(filtered)
            filtered += ERROR_WEIGHT * (error - filtered) if known else 0.0
            filtered = filtered if known else error
        if learn:
            mixture, _ = learned(mixture, np.concatenate([model.features, D]), tuning)
    predicted = _frozen(regress(mixture, S)[0])
    return ForceModel(
        mixture, _frozen(S), _frozen(D.copy()), predicted, error, filtered
    )


def persistence(n_in: int, n_out: int) -> Mixture:
    """A mixture that predicts persistence: the next D is the D in S.

    For comparison: the performance of a controller from the measured force alone.

    Args: n_in: entries of S; n_out: how many of them, the last ones, are D.
    """
    n, wide, narrow = n_in + n_out, 1e3, 1e-3
    factor = np.zeros((1, n, n))
    factor[0, :n_in, :n_in] = wide * np.eye(n_in)
    factor[0, n_in:, n_in - n_out : n_in] = wide * np.eye(n_out)
    factor[0, n_in:, n_in:] = narrow * np.eye(n_out)
    return Mixture(np.zeros((1, n)), factor, np.ones(1), np.ones(1), 1)

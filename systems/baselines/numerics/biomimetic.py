"""Biomimetic adaptive control: force and impedance learned over trials.

    e = x - x_d,   eps = de/dt + kappa e
    u = M a_d - F - (K_0 + K) e - (D_0 + D) de/dt

F, K, D hold at one time step of the motion; after trial i

    F += Q_F eps - g F,   K += Q_K eps e' - g K,   D += Q_D eps (de/dt)' - g D
    g  = a / (1 + b |eps|^2)

so that little is forgotten where the error is large. K_0, D_0 are the impedance that
is never unlearned (the minimal feedback). F, K and D of a time step learn from the
error at that very step; that it came from what was done before is not in the law.
The source has the three Q outside brackets that contain g too; g is written as here,
so that one forgetting factor is a fraction per trial for all three.

Source: Yang, Ganesh, Haddadin, Parusel, Albu-Schaeffer, Burdet, "Human-like adaptation
of force and impedance in stable and unstable interactions", IEEE Transactions on
Robotics 27(5), 2011.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from makebreak.systems.planar.numerics.planar_world import limited


@dataclass(frozen=True, eq=False)
class LearnedGains:
    """What was learned for each of n time steps: a value, kept between trials."""

    force: np.ndarray  # (n, 2) F [N].
    stiffness: np.ndarray  # (n, 2, 2) K [N/m].
    damping: np.ndarray  # (n, 2, 2) D [N s/m].

    def __post_init__(self):
        n = len(self.force)
        shapes = dict(force=(n, 2), stiffness=(n, 2, 2), damping=(n, 2, 2))
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), dtype=float)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(
                    f"LearnedGains.{name} is {value.shape}, expected {shape}, finite"
                )
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def save(self, path) -> None:
        """Writes it as an npz file."""
        np.savez(path, **vars(self))

    @staticmethod
    def load(path) -> "LearnedGains":
        """What save wrote. Raises: ValueError if it is not that."""
        with np.load(path) as file:
            missing = {"force", "stiffness", "damping"} - set(file)
            if missing:
                raise ValueError(f"{path} has no {sorted(missing)}")
            return LearnedGains(*(file[k] for k in ("force", "stiffness", "damping")))


def no_gains(n: int) -> LearnedGains:
    """Before the first trial of n time steps."""
    return LearnedGains(np.zeros((n, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2, 2)))


def after_trial(gains: LearnedGains, e, e_dot, kappa, rates, forget, b):
    """What a trial taught.

    Args:
        gains: those of the trial.
        e, e_dot: (n, 2) x - x_d and its derivative at each time step [m], [m/s].
        kappa [1/s]; rates: (3,) Q_F, Q_K, Q_D; forget: a; b [s2/m2].
    Returns: the gains of the next trial. Where an error is not finite they stay.
    """
    e, e_dot = np.asarray(e, dtype=float), np.asarray(e_dot, dtype=float)
    good = np.isfinite(e).all(axis=1) & np.isfinite(e_dot).all(axis=1)
    e, e_dot = np.where(good[:, None], e, 0.0), np.where(good[:, None], e_dot, 0.0)
    eps = e_dot + kappa * e
    g = np.where(good, forget / (1.0 + b * np.sum(eps**2, axis=1)), 0.0)
    G = g[:, None, None]
    return LearnedGains(
        gains.force * (1.0 - g[:, None]) + rates[0] * eps,
        gains.stiffness * (1.0 - G) + rates[1] * eps[:, :, None] * e[:, None, :],
        gains.damping * (1.0 - G) + rates[2] * eps[:, :, None] * e_dot[:, None, :],
    )


@njit(cache=True)
def force_command(state, target, force, stiffness, damping, fixed, mass, force_max):
    """u of one time step, within the limit.

    Args:
        state: (4,) p, v; target: (6,) p, v, a.
        force (2,), stiffness (2, 2), damping (2, 2): F, K, D of this time step.
        fixed: (2,) K_0 [N/m] and D_0 [N s/m]; mass: M [kg]; force_max [N].
    Returns: u (2,) [N], whether the force is at its limit.
    """
    u = np.empty(2)
    for i in range(2):
        u[i] = mass * target[4 + i] - force[i]
        u[i] -= fixed[0] * (state[i] - target[i])
        u[i] -= fixed[1] * (state[2 + i] - target[2 + i])
        for k in range(2):
            u[i] -= stiffness[i, k] * (state[k] - target[k])
            u[i] -= damping[i, k] * (state[2 + k] - target[2 + k])
    limit = u[0] * u[0] + u[1] * u[1] > force_max * force_max
    return limited(u, force_max), limit

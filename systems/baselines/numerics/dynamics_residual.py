"""The usual residual learning: a constant on the dynamics, not on the contact.

    x_next = A x + B u + D lam + d + r_dyn,  contact as the model has it.

Over a buffer of measured steps the r_dyn of least squared error is the mean of what the
model's steps, taken with its own contact forces, miss.

Source: ACI-MPC, section VI, eq. 9 and 10.
"""

from dataclasses import replace

import numpy as np

from makebreak.systems.contact_mpc.numerics.lcs import LCS, simulate


def step_error(lcs: LCS, x, u, x_next) -> np.ndarray:
    """x_next (n_x,) minus what the LCS makes of x (n_x,) and u (n_u,).

    Raises: ValueError if the LCS has no contact force there.
    """
    return x_next - simulate(lcs, x, u)[0]


def with_dynamics_residual(lcs: LCS, r_dyn) -> LCS:
    """The LCS with d + r_dyn, r_dyn (n_x,) [x per step]."""
    return replace(lcs, d=lcs.d + r_dyn)

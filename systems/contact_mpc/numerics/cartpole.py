"""Cart-pole between two soft walls, as an LCS about the upright pole at rest.

x = [cart position [m], pole angle [rad], and their velocities]; u = [force on the cart]
[N]. The pole is a point mass on a weightless rod; a positive angle leans it towards -x,
so that its tip is at  cart - length angle. Wall 0 stands at +x, wall 1 at -x. A wall is
a spring, so its gap depends on the force:

    0 <= lam_i  perp  gap_i(x) + lam_i / stiffness >= 0,

and here the contact equation is in metres: F = 1/stiffness [m/N], and a residual on it
is the error of the walls' distance [m].

Source: ACI-MPC, section VII-A; Aydinoglu, Wei, Huang, Posa, arXiv:2304.11259, section
VI (explicit Euler); the parameters are identified from those public matrices.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are

from makebreak.systems.contact_mpc.numerics.lcs import LCS


@dataclass
class CartPole:
    cart_mass: float = 0.978  # [kg]
    pole_mass: float = 0.411  # [kg]
    mass_height: float = 0.4267  # Of the pole's point mass over the pivot [m].
    length: float = 0.6  # Of the pole, from the pivot to its tip [m].
    wall_distance: float = 0.35  # Of each wall from the middle [m].
    wall_stiffness: float = 100.0  # [N/m]
    gravity: float = 9.81  # [m/s2]


def cartpole_lcs(p: CartPole, dt: float) -> LCS:
    """The LCS with time step dt [s]."""
    h = p.mass_height
    both, turn = p.cart_mass + p.pole_mass, p.pole_mass * h
    M = np.array([[both, -turn], [-turn, turn * h]])
    J = np.array([[-1.0, p.length], [1.0, -p.length]])  # Of the gaps.
    acceleration = np.linalg.inv(M)
    A = np.eye(4)
    A[:2, 2:] = dt * np.eye(2)
    A[2:, 1] = dt * acceleration @ [0.0, p.pole_mass * p.gravity * h]
    B, D = np.zeros((4, 1)), np.zeros((4, 2))
    B[2:] = dt * acceleration[:, :1]
    D[2:] = dt * acceleration @ J.T
    E, F = np.hstack([J, np.zeros((2, 2))]), np.eye(2) / p.wall_stiffness
    c = np.full(2, p.wall_distance)
    return LCS(A, B, D, np.zeros(4), E, F, np.zeros((2, 1)), c, dt)


def cost_to_go(lcs: LCS, Q, R) -> np.ndarray:
    """Q_N (n_x, n_x): what staying without contact costs under the best linear law.

    Args: Q (n_x, n_x), R (n_u, n_u) as in the cost x'Q x + u'R u.
    """
    return solve_discrete_are(lcs.A, lcs.B, Q, R)

"""What each contact force pushes along: the rows of contacts, friction edges, tangents.

With n_f friction directions (2 n_f edges) a contact has these rows:

    Anitescu          per edge:    J_n + mu J_t, with the gap
    Stewart-Trinkle   normal:      J_n, with the gap
                      per edge:    J_t + gamma, without the gap
                      cone:        w = mu lam_n - sum lam_t, lam = gamma, the speed at
                                   which the contact slides

Anitescu's contact is convex, and opens while it slides, by dt mu |v_t|.
Stewart-Trinkle's does not; its F is not symmetric. A contact with a stiffness k is a
spring: lam_n = k max(0, -gap after the step), which adds 1 / (k dt) to F between its
normal forces. eps_c keeps the other forces apart. lam is in newtons (gamma in m/s, and
its w in newtons).

Source: Anitescu, Math. Programming 105 (2006); Stewart, Trinkle, Int. J. Numerical
Methods in Engineering 39 (1996).
"""

from dataclasses import dataclass
from math import cos, pi, sin, sqrt

import numpy as np
from numba import njit


def friction_edges(n_f):
    """The 2 n_f friction edges (2 n_f, 2) of a contact, unit vectors (cos, sin) in the
    tangent basis: theta = 0, pi, pi/n_f, pi/n_f + pi, ... as in c3_reference."""
    edges = []
    for k in range(n_f):
        direction = np.array([cos(pi * k / n_f), sin(pi * k / n_f)])
        edges += [direction, -direction]
    return np.array(edges).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class ContactRows:
    """What each entry of lam is: row i of J_c is normal J_n + weight (edge' J_t)."""

    contact: np.ndarray  # (n_lam,) index of its contact
    normal: np.ndarray  # (n_lam,) 1.0, or 0.0: a row without normal and gap
    edge: np.ndarray  # (n_lam, 2) in the tangent basis; 0: none
    along_mu: np.ndarray  # (n_lam,) whether the edge counts mu times (Anitescu)
    cone: np.ndarray  # (n_lam, n_lam) constant part of F
    cone_mu: np.ndarray  # (n_lam, n_lam) of F, times mu
    regular: np.ndarray  # (n_lam, n_lam) of F, times eps_c
    compressed: np.ndarray  # (n_lam, n_lam) of F, times 1 / (stiffness dt)
    names: list[str]  # Of each row within its contact.

    def weight(self, mu):
        """(n_lam,) of the rows' edges, for the contacts' friction mu (n_contacts,)."""
        return np.where(self.along_mu, mu[self.contact], 1.0)

    def F_0(self, mu, compliance, dt, eps_c):
        """(n_lam, n_lam), for mu (n_contacts,) and compliance (n_contacts,) [m/N]."""
        of_row, soft = mu[self.contact][:, None], compliance[self.contact][:, None]
        F_0 = self.cone + of_row * self.cone_mu + eps_c * self.regular
        return F_0 + soft / dt * self.compressed


def contact_rows(kinds) -> ContactRows:
    """The rows of contacts, one after the other.

    Args: kinds: per contact (is_anitescu, edges (2 n_f, 2), has friction, is
        compliant). Without friction a Stewart-Trinkle contact is its normal row alone.
    """
    sizes = [
        len(edges) if anitescu else (len(edges) + 2 if friction else 1)
        for anitescu, edges, friction, _ in kinds
    ]
    n = sum(sizes)
    normal, edge, along_mu = np.zeros(n), np.zeros((n, 2)), np.zeros(n, bool)
    cone, cone_mu, regular, compressed = np.zeros((4, n, n))
    names, start = [], 0
    for (anitescu, edges, friction, compliant), size in zip(kinds, sizes, strict=True):
        own = slice(start, start + size)
        if anitescu:
            normal[own], edge[own], along_mu[own] = 1.0, edges, True
            regular[own, own] = np.eye(size)
            names += [f"{k}" for k in range(size)]
            if compliant:  # The sum of the forces meets the spring, and only that.
                compressed[own, own] = 1.0
                regular[own, own] -= 1.0 / size
        else:
            normal[start] = 1.0
            (compressed if compliant else regular)[start, start] = 1.0
            names.append("normal")
            if friction:
                tangent, last = slice(start + 1, start + size - 1), start + size - 1
                edge[tangent] = edges
                regular[tangent, tangent] = np.eye(size - 2)
                cone[tangent, last], cone[last, tangent] = 1.0, -1.0
                cone_mu[last, start] = 1.0
                names += [f"edge {k}" for k in range(size - 2)] + ["sliding speed"]
        start += size
    contact = np.repeat(np.arange(len(sizes)), sizes)
    return ContactRows(
        contact, normal, edge, along_mu, cone, cone_mu, regular, compressed, names
    )


def nearest_contacts(phi, groups):
    """Which contacts of each group are nearest: indices, in their order in the group.

    Args: phi (n,) gaps [m]; groups: pairs of (indices (m,), how many of them to take).
    """
    chosen = []
    for of_group, count in groups:
        nearest = np.argsort(phi[of_group], kind="stable")[:count]
        chosen.append(of_group[np.sort(nearest)])
    return np.concatenate(chosen)


@njit(cache=True)
def nearest_of_groups(phi, members, ends, counts):
    """nearest_contacts for compiled callers: groups one after the other in members,
    each up to its end (exclusive), of which so many are taken."""
    chosen = np.empty(counts.sum(), np.int64)
    start, n = 0, 0
    for g in range(len(ends)):
        of_group = members[start : ends[g]]
        start = ends[g]
        taken = np.zeros(of_group.size, np.bool_)
        for _ in range(counts[g]):
            best = -1
            for i in range(of_group.size):
                if not taken[i] and (
                    best < 0 or phi[of_group[i]] < phi[of_group[best]]
                ):
                    best = i
            taken[best] = True
        for i in range(of_group.size):
            if taken[i]:
                chosen[n] = of_group[i]
                n += 1
    return chosen


@njit(cache=True)
def tangent_basis(n, reference):
    """Two unit tangents t1, t2 with t1 x t2 = n, for a unit normal n (3,).

    reference (3,): t1 is its projection on the tangent plane. If it is zero (or along
    n): t1 = e x n, where e is the axis along which n is smallest, the basis of Drake's
    RotationMatrix.MakeFromOneVector. That one jumps by 90 degrees where two entries of
    n change places in size; a reference direction does not jump.
    """
    along = reference @ n
    t1 = reference - along * n
    length = sqrt(t1 @ t1)
    if length < 1e-6:
        i = 0
        if abs(n[1]) < abs(n[i]):
            i = 1
        if abs(n[2]) < abs(n[i]):
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        t1[i], t1[j], t1[k] = 0.0, -n[k], n[j]
        length = sqrt(n[j] * n[j] + n[k] * n[k])
    t1 /= length
    t2 = np.empty(3)
    t2[0] = n[1] * t1[2] - n[2] * t1[1]
    t2[1] = n[2] * t1[0] - n[0] * t1[2]
    t2[2] = n[0] * t1[1] - n[1] * t1[0]
    return t1, t2

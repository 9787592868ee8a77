"""The contacts of an LCS and their rows: how many forces lam has, in which order."""

import numpy as np

from makebreak.systems.contact_mpc.multibody.contact_pair import (
    Contact,
    checked_count,
    contacts_of,
)
from makebreak.systems.contact_mpc.numerics.contact_rows import (
    contact_rows,
    nearest_contacts,
)
from makebreak.systems.contact_mpc.numerics.lcs import LCS, is_finite


class ContactLayout:
    """All contacts that pairs may have, those that the LCS has, and the rows of lam.

    Args:
        pairs, plant, inspector: as contacts_of.
        closest: number of contacts over all pairs; None: as each pair says.
        dt_sec: time step [s]; eps_c [m/s per N], as of AnitescuLcs.

    Attributes, one entry for each combination of geometries (n,):
        geometries, names, mu, reference, planar: as of Contact.
        every: (n,) 0, 1, ..., n - 1; first: those whose place in the LCS is known.
    Others:
        n_pairs, n_lam: sizes; mu_of_pairs (n_pairs,), as configured. chooses: whether
            the LCS has only the nearest contacts.
        groups_in_arrays: for compiled callers (nearest_of_groups); None where friction
            may differ within a group.
        rows: ContactRows; lam_names: of each row.

    Raises: ValueError naming a pair and what is wrong with it.
    """

    def __init__(self, pairs, plant, inspector, closest, dt_sec: float, eps_c: float):
        contacts, groups = contacts_of(pairs, plant, inspector)
        if not contacts:
            raise ValueError("no contact pairs came, expected at least one")
        if closest is not None:
            groups = _one_group(contacts, pairs, closest)
        self._dt_sec, self._eps_c = dt_sec, eps_c
        self.n_pairs = len(pairs)
        self.geometries = [contact.geometries for contact in contacts]
        self.names = [contact.name for contact in contacts]
        self.mu = np.array([contact.mu for contact in contacts])
        self.mu_of_pairs = np.zeros(len(pairs))  # As configured.
        for contact in contacts:
            self.mu_of_pairs[contact.pair] = contact.mu
        self.reference = np.array([contact.reference for contact in contacts])
        self.planar = np.array([contact.planar for contact in contacts])
        self.every = np.arange(len(contacts))
        self._compliance = np.array([contact.compliance for contact in contacts])
        self._pair_of = np.array([contact.pair for contact in contacts])
        self._frictionless = np.array(
            [not (contact.anitescu or contact.mu > 0.0) for contact in contacts]
        )
        self._groups = groups
        self.chooses = any(count < len(of_group) for of_group, count in groups)
        self.groups_in_arrays = None
        if closest is None:
            self.groups_in_arrays = (
                np.concatenate([of_group for of_group, _ in groups]),
                np.cumsum([len(of_group) for of_group, _ in groups]),
                np.array([count for _, count in groups]),
            )
        # The contacts of a group have the same rows, so its first ones stand for any.
        self.first = first = np.concatenate([of[:count] for of, count in groups])
        self.rows = contact_rows([contacts[i].kind for i in first])
        self.n_lam = len(self.rows.contact)
        self.weight, self.F_0 = self._rows_for(self.mu[first], self._compliance[first])
        self.lam_names = self._names_of_rows(first)

    def nearest(self, gaps: np.ndarray) -> np.ndarray:
        """Indices of the contacts that the LCS has, from all gaps (n,) [m]."""
        return nearest_contacts(gaps, self._groups)

    def rows_of(self, chosen: np.ndarray, mu: np.ndarray):
        """Weights (n_lam,) and F_0 (n_lam, n_lam) of the rows (ContactRows), for the
        contacts `chosen` and the friction mu (n,) of all."""
        if mu is self.mu and chosen is self.every:
            return self.weight, self.F_0
        return self._rows_for(mu[chosen], self._compliance[chosen])

    def _rows_for(self, mu, compliance):
        F_0 = self.rows.F_0(mu, compliance, self._dt_sec, self._eps_c)
        return self.rows.weight(mu), F_0

    def of_contacts(self, of_pairs) -> np.ndarray:
        """(n,) of each contact, what (n_pairs,) of its pair is."""
        return np.asarray(of_pairs)[self._pair_of]

    def friction_of(self, friction) -> np.ndarray:
        """(n,) friction of each contact, from that of the pairs (n_pairs,).

        Raises: ValueError on a wrong size, a value below 0, or friction for a
            Stewart-Trinkle contact that was made without.
        """
        friction = np.array(friction, dtype=float)
        if friction.shape != (self.n_pairs,) or not (
            is_finite(friction) and (friction >= 0.0).all()
        ):
            raise ValueError(
                f"friction is {friction}, expected ({self.n_pairs},) of at least 0"
            )
        mu = friction[self._pair_of]
        for i in np.flatnonzero(self._frictionless & (mu > 0.0)):
            raise ValueError(
                f"{self.names[i]}: friction {mu[i]:g} came for a contact that "
                "was made without"
            )
        return mu

    def with_gap(self, lcs: LCS, gap) -> LCS:
        """The LCS with gap (n_pairs,) [m] added to its contacts' distances.

        Raises: ValueError on a wrong size or a value that is not finite.
        """
        gap = np.array(gap, dtype=float)
        if gap.shape != (self.n_pairs,) or not is_finite(gap):
            raise ValueError(f"gap is {gap}, expected ({self.n_pairs},), finite [m]")
        of_row = self._pair_of[np.asarray(lcs.contact, dtype=int)]
        further = np.where(self.rows.normal > 0.0, gap[of_row], 0.0)
        return lcs.with_residual(further / self._dt_sec, further)

    def _names_of_rows(self, first) -> list[str]:
        names = [self.names[i] for i in first]
        if self.chooses:
            names = [
                self.names[of_group[k]]
                if count == len(of_group)
                else f"nearest {k} of {self.names[of_group[0]]}..."
                for of_group, count in self._groups
                for k in range(count)
            ]
        return [
            f"{names[i]} {of_contact}"
            for i, of_contact in zip(self.rows.contact, self.rows.names, strict=True)
        ]


def _one_group(contacts: list[Contact], pairs, closest):
    """All contacts as one group, of which the `closest` nearest are taken."""
    n = len(contacts)
    groups = [(np.arange(n), checked_count("closest", closest, n))]
    if any(pair.closest is not None for pair in pairs):
        raise ValueError(
            "closest came for all pairs and for one of them, expected one of the two"
        )
    _check_alike(contacts)
    return groups


def _check_alike(contacts) -> None:
    """Raises: ValueError unless each contact can take any other's rows."""
    first = contacts[0].kind
    for contact in contacts:
        kind = contact.kind
        same_edges = np.array_equal(kind[1], first[1])
        if not (same_edges and kind[0] == first[0] and kind[2:] == first[2:]):
            raise ValueError(
                f"closest: {contact.name} and {contacts[0].name} differ in contact "
                "model, friction directions or in having friction or stiffness, "
                "expected one kind"
            )

"""What C3 gives and remembers: the plan, and the warm start of the next solve."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Plan:
    """What C3 intends; u obeys its bounds exactly, x to 1e-6 of their size.

    A polished plan is the LCS's own rollout of u, of which C3 knew an approximation:
    lam is exact, and x breaches its bounds where that approximation hid it.
    """

    x: np.ndarray  # (N + 1, n_x) [SI]
    u: np.ndarray  # (N, n_u) [N]
    lam: np.ndarray  # (N, n_lam) [N]; complementary only as far as ADMM got.
    status: int = 0  # 0: of this tick. Else the reason why it is an older one.
    time: float | None = None  # Of x[0] [s]; None: unknown, or no plan has been made.
    dt: float = 0.0  # Between knots [s].
    # Of all rounds' knots, those whose exact projection ended at its nodes_max.
    cut_projections: int = 0

    def __post_init__(self):
        for name in ("x", "u", "lam"):
            getattr(self, name).setflags(write=False)

    def at(self, times):
        """x (n, n_x) and u (n, n_u) at times (n,) [s]: x linear between the knots and
        still beyond the last, u held from each knot to the next and beyond the last.

        Raises: ValueError where the plan has no time.
        """
        if self.time is None or not self.dt > 0.0:
            raise ValueError(
                f"Plan: time is {self.time} and dt {self.dt}, expected a plan in time"
            )
        N = len(self.u)
        # Times are sums of periods: their rounding must not delay a knot by one.
        knots = (np.asarray(times, float) - self.time) / self.dt + 1e-6
        before = np.clip(np.floor(knots).astype(int), 0, N - 1)
        share = np.clip(knots - before, 0.0, 1.0)[:, None]
        x = (1.0 - share) * self.x[before] + share * self.x[before + 1]
        return x, self.u[before]


@dataclass(frozen=True, eq=False)
class WarmStart:
    """A solve's memory; the lam and eta parts are in newtons and m/s, not scaled."""

    u: np.ndarray  # (N, n_u) last inputs, for the input-change penalty [N]
    delta: np.ndarray  # (N, n_z)
    w: np.ndarray  # (N, n_z)

    def shifted(self, knots: float, contacts=None) -> "WarmStart":
        """delta and w moved ahead in time by knots (0 .. 1), linear between knots.

        Args: contacts: (of, to, starts). The contacts that the forces belonged to at
            each knot and belong to now, (N, n_lam) each, and where in z the entries per
            force begin. What is known of a force goes with its contact; of a contact
            that is new it is zero. None: they are the same.
        """

        def ahead(a):
            after = np.vstack([a[1:], a[-1:]])
            if contacts is not None:
                of, to, starts = contacts
                a = moved_with_contacts(a, of, to, starts)
                of_after = np.vstack([of[1:], of[-1:]])
                after = moved_with_contacts(after, of_after, to, starts)
            return (1.0 - knots) * a + knots * after

        return WarmStart(self.u, ahead(self.delta), ahead(self.w))


def moved_with_contacts(a, of, to, starts):
    """a (N, n_z), whose rows' entries per force belong to the contacts of (N, n_lam),
    for the contacts to (N, n_lam); starts: where these entries begin in a row.

    The forces of a contact keep their order in it.
    """
    if (of == to).all():
        return a
    moved, n_lam = a.copy(), of.shape[1]
    for k in np.flatnonzero((of != to).any(axis=1)):
        old = {key: i for i, key in enumerate(_in_their_contacts(of[k]))}
        came_from = [old.get(key, -1) for key in _in_their_contacts(to[k])]
        for start in starts:
            entries = np.append(a[k, start : start + n_lam], 0.0)
            moved[k, start : start + n_lam] = entries[came_from]
    return moved


def _in_their_contacts(contact):
    """(its contact, its place in it) of each force."""
    seen: dict = {}
    for number in contact.tolist():
        seen[number] = seen.get(number, -1) + 1
        yield number, seen[number]

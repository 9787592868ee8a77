"""Walls that what moves freely meets before it is where the scene has them.

A body that is inside a wall, as the scene has it, touches that wall. One that stops in
front of it may touch nothing: that it does is told by the forces there.
"""

from collections.abc import Sequence

import numpy as np

from makebreak.gap.numerics.permitted_forces import explain
from makebreak.gap.residuals.contact_dynamics import ContactDynamics
from makebreak.gap.residuals.touching import BESIDE, FAR, NEAR
from makebreak.gap.simulation.contact_shapes import APPROACH, MEETS
from makebreak.models.effects.kind import Effect

FEWEST_ROWS = 5  # In which it stays at the wall.
SAME = 5e-4  # Over which distances at the wall scatter [m].
FEWEST_SEEN = 3  # Test functions in which a face is pressed on.
# Of the mean square of what is left where a wall is met, what is left away from it at
# most, but for a tenth of the test functions; and what a wall may leave of it.
ELSEWHERE, MOST, LESS = 0.25, 0.9, 0.5


class FeltWalls(ContactDynamics):
    """The same, with walls touched where they are met."""

    def _prepare(self) -> None:
        super()._prepare()
        if not self.bodies:
            return
        distance = self._least_distances()
        for key, phi in distance.items():
            if key[2:] != (BESIDE,) or self._touching[key].any():
                continue
            pair = key[0], key[1]
            off = _kept(phi)
            if not MEETS < off < NEAR:
                continue
            left = self._mean_squares()
            if not self._may_be_felt(left, phi, off):
                continue
            rows = (phi < off + MEETS) & (np.abs(self._rate(phi)) < APPROACH)
            before = left[self._wholly(rows[self._rows])].mean()
            kept = self._touching[key]
            self._touching[key], self._met_at[pair] = rows, off
            self._find_again()
            at = self._wholly(rows[self._rows])
            seen = at.sum() >= FEWEST_SEEN
            if not seen or self._mean_squares()[at].mean() > LESS * before:
                self._touching[key] = kept
                del self._met_at[pair]
                self._find_again()

    def _find_again(self) -> None:
        self.means = self._all_means()
        self._find_contacts()
        self._told.clear()
        self._inertial_of.clear()
        self._last = None
        super()._prepare()

    def _wholly(self, on: np.ndarray) -> np.ndarray:
        """(K,) test functions all of whose nodes are among (n_nodes,) these."""
        return np.asarray(self._W @ on.astype(float)).ravel() > 0.999

    def _may_be_felt(self, left: np.ndarray, phi: np.ndarray, off: float) -> bool:
        """Whether more is left (K,) where the nearest points are as far from a wall as
        they ever come than farther away: a friction or a mass that is wrong would be
        wrong there, too."""
        phi = phi[self._rows]
        at = self._wholly(phi < off + MEETS)
        away = self._wholly(phi > off + 2.0 * MEETS)
        if min(at.sum(), away.sum()) < FEWEST_SEEN:
            return False
        return bool(np.quantile(left[away], MOST) < ELSEWHERE * left[at].mean())

    def _mean_squares(self, displaced: Sequence[Effect] = ()) -> np.ndarray:
        """(K,) of what equations and wrenches leave with bodies displaced."""
        needs = self._all_needs(())
        G, there, _, _, sharing = self._generators(displaced)
        left = np.zeros_like(needs)
        explain(
            needs, G, there, self.root, sharing, left,
            np.zeros((len(left), there.shape[1])), np.zeros(len(left), np.int64),
        )  # fmt: skip
        return np.mean(left**2, axis=1)


def _kept(phi: np.ndarray) -> float:
    """The least distance (n_rows,) that was kept [m]; FAR: none was."""
    least = np.sort(phi)[FEWEST_ROWS - 1 :]
    return float(np.median(least[least < least[0] + SAME])) if len(least) else FAR

"""The rows of a contact problem: which there are, and which of them are fitted.

A row is one equation, wrench or distance of one test function, over its noise.
"""

from collections.abc import Sequence

import numpy as np

from makebreak.gap.residuals.contact_dynamics import ContactDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect

BLOCK_SEC = 0.6  # In which a tool goes a few centimetres.
ONE_BLOCK = 0.5  # Of the squares that are left: more, and it is most of them.


class ContactRows(ContactDynamics):
    """Rows (m,) out of the table (K, n) of ContactDynamics.left()."""

    # Which of the table are rows (K, n); which test functions are fitted, and the block
    # of time of each (K,).
    _shown: np.ndarray
    _train: np.ndarray
    _block: np.ndarray
    _base: np.ndarray | None
    # The model whose noise weighs all others'; None: each is weighed by its own.
    _weights: Sequence[Effect] | None

    def _flat(self, r: np.ndarray) -> np.ndarray:
        return r[self._shown]

    def _of_rows(self, value: np.ndarray) -> np.ndarray:
        """A value of each test function, for each row."""
        return np.broadcast_to(value[:, None], self._shown.shape)[self._shown]

    def _of_moments(self) -> np.ndarray:
        """(m,) number of each row's test function."""
        return self._of_rows(np.arange(len(self.means.time)))

    def residual(self, effects: Sequence[Effect] = ()) -> np.ndarray:
        return self._left_by(effects, self._weights)

    def _left_by(
        self, effects: Sequence[Effect], weights: Sequence[Effect] | None = None
    ) -> np.ndarray:
        """(m,) residual by the weights of a model; None: by those of its own. However
        large: clipped rows have no slopes, and of what fits alike that which one tries
        with the larger steps would be the only one to be seen."""
        return self._flat(self.left(effects, weighed_as=weights))

    def _in_table(self, rows: np.ndarray) -> np.ndarray:
        """(K, n) of values of rows (m,), 0 where there is none."""
        table = np.zeros(self._shown.shape)
        table[self._shown] = rows
        return table

    def weighed_alike(self, one: Sequence[Effect], other: Sequence[Effect]):
        """A heavier body makes more noise of the same accelerations: by its own weights
        each of two models that are both below the noise seems better the heavier it is.
        Not so where a drive's gain is another: all forces are in another unit then, the
        noise with them, and by the weights of one model the one with the smaller forces
        would leave less. Of these each is weighed by its own. So is the equation of a
        joint that nothing drives, of which the size of all its terms is free: half of
        an inertia is no better than twice the damping for being less.
        """
        if _gains(one) != _gains(other):
            return [(self._left_by(one), self._left_by(other))]
        passive = [i for j, (_, i) in self.joints.items() if self.by[j] == "passive"]
        free = np.isin(self.channel_of_rows(), passive)
        both = [[self._left_by(each, w) for each in (one, other)] for w in (one, other)]
        own = both[0][0], both[1][1]
        return [
            tuple(np.where(free, x, y) for x, y in zip(own, each, strict=True))
            for each in both
        ]

    def base(self) -> np.ndarray:
        if self._base is None:
            self._base = self.residual()
        return self._base

    def _share_out(self, left: np.ndarray) -> None:
        """Which blocks are fitted, by what the scene leaves (rows as `_shown`). What is
        seen at one place alone (a patch, a wall) is seen in few blocks, and must be in
        both parts: so of each three blocks of which about as much is left, the middle
        one is held out. Blocks are shorter, but hold two test functions side by side,
        where one has most of it."""
        size = np.sum(np.where(self._shown, left**2, 0.0), axis=1)
        seconds = BLOCK_SEC
        while True:
            block = _blocks(self.means.time, self.means.episode, seconds)
            _, order = np.unique(block, return_inverse=True)
            total = np.bincount(order, weights=size)
            # One push may be all that a log has.
            seconds *= 0.5
            if total.max() < ONE_BLOCK * total.sum() or seconds < 4.0 * self.half:
                break
        self._block = block
        rank = np.empty(len(total), int)
        rank[np.argsort(-total, kind="stable")] = np.arange(len(total))
        self._train = rank[order] % 3 != 1

    def train(self) -> np.ndarray:
        return self._of_rows(self._train)

    def blocks(self) -> np.ndarray:
        return self._of_rows(self._block)

    def channel_of_rows(self) -> np.ndarray:
        index = np.arange(self._shown.shape[1])
        return np.broadcast_to(index, self._shown.shape)[self._shown]

    def parts(self) -> np.ndarray:
        number = np.array([t.recording for t in self.tracks])
        return self._of_rows(number[self.means.episode])


def _blocks(time: np.ndarray, episode: np.ndarray, seconds: float) -> np.ndarray:
    """(K,) number of the block, so long, of each test function: its time (K,) and the
    number of its episode (K,)."""
    block, first = np.zeros(len(time), int), 0
    for number in np.unique(episode):
        mine = episode == number
        block[mine] = first + ((time[mine] - time[mine].min()) / seconds).astype(int)
        first = int(block[mine].max()) + 1
    return block


def _gains(effects: Sequence[Effect]) -> set[tuple[tuple[str, ...], float]]:
    """(drives, gain) of all effects that make drives stronger or weaker."""
    return {
        (tuple(e.at), e.parameters["gain"])
        for e in effects if KINDS[e.kind].path == "gain"
    }  # fmt: skip

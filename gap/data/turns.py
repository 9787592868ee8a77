"""Positions of joints that jump by a whole turn, as absolute encoders give them."""

import numpy as np

TURN = 2.0 * np.pi
_NEAR, _STEP = 0.3, 1.0  # [rad] Of a jump to a turn; of any other step.


def without_turns(q: np.ndarray, turn: float = TURN) -> tuple[np.ndarray, int]:
    """Positions (n,) without jumps by a turn, and how many there were; as they are
    where other steps are so large that no jump stands out. NaN are missing.

    Args: turn: in the unit of q.
    """
    there = np.flatnonzero(np.isfinite(q))
    step = np.diff(q[there]) / turn * TURN
    jumps = np.abs(np.abs(step) - TURN) < _NEAR
    if not jumps.any() or np.abs(step[~jumps]).max(initial=0.0) > _STEP:
        return q, 0
    turns = np.cumsum(np.where(jumps, -np.sign(step), 0.0))
    out = q.copy()
    out[there[1:]] += turn * turns
    return out, int(jumps.sum())

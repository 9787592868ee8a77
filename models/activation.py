"""Drives that do not follow their command itself: they add it up, or lag behind it."""

import math
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Activation:
    """What a drive follows in place of its command u: act, with act' = u (lag 0: the
    command is a rate), or act' = (u - act)/lag, lag in s. It begins at start and stays
    between low and high.

    Source: MuJoCo, Computation, Activation dynamics (integrator, filter)."""

    lag: float = 0.0
    start: float = 0.0
    low: float = -np.inf
    high: float = np.inf

    def over(self, gear: float) -> "Activation":
        """At the joint, of commands that are divided by a gear."""
        low, high = sorted((self.low / gear, self.high / gear))
        return replace(self, start=self.start / gear, low=low, high=high)

    def of(self, u: np.ndarray, time: np.ndarray, mean: bool = False) -> np.ndarray:
        """(n,) act at each row of commands u (n,), each of which holds until the next
        row, at time (n,) [s]. What is not there (NaN) is as before; where time goes
        back, as from one episode to the next, act begins again.

        Args: mean: from each row to the next, in place of at each.
        """
        out, act, held = np.full(len(u), np.nan), self.start, 0.0
        step = np.diff(time, append=np.nan)
        step = np.where(np.isfinite(step), step, np.nanmedian(step))
        for k, (x, dt) in enumerate(zip(u.tolist(), step.tolist(), strict=True)):
            held = x if x == x else held
            new = self.start if dt < 0.0 else self._after(act, held, dt)
            out[k] = 0.5 * (act + new) if mean and dt > 0.0 else act
            act = new
        return out

    def _after(self, act: float, u: float, dt: float) -> float:
        """act, dt [s] later, under a command u that holds."""
        act += (u - act) * -math.expm1(-dt / self.lag) if self.lag else u * dt
        return min(max(act, self.low), self.high)

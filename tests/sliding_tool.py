"""A tool that slides over surfaces: wrench and velocity from a model of friction."""

from dataclasses import dataclass, field

import numpy as np

DOWN = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
TOOL_MASS = 0.3  # [kg]


@dataclass
class Slide:
    """Motion to and fro along a line in the plane, with given speed and normal force.

    The friction is `friction[k]` from `seams[k - 1]` to `seams[k]`. From a seam on it
    changes over `ramp` [m]: linearly, or, with `rows`, in two equal steps, as for a
    block on four corners.
    """

    friction: list[float]
    seams: list[float]  # [m], increasing.
    length: float = 0.6  # Of the line, which is followed to and fro [m].
    speed: float = 0.1  # [m/s]
    normal: float = 8.0  # [N]
    ramp: float = 0.03  # [m]
    rows: bool = False
    noise: float = 0.1  # [N]
    seed: int = 0
    angle: float = 0.0  # Of the line in the plane [rad].
    accelerate_sec: float = 0.15
    touch_sec: float = 0.1  # Time at which the contact begins; free space before it.
    period: float = 0.005
    rng: np.random.Generator = field(init=False)

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)

    def friction_at(self, s):
        mu = self.friction[0]
        for k, seam in enumerate(self.seams):
            share = np.clip((s - seam) / self.ramp, 0.0, 1.0) if self.ramp else s > seam
            if self.rows:
                share = 0.5 * (s > seam) + 0.5 * (s > seam + self.ramp)
            mu += share * (self.friction[k + 1] - self.friction[k])
        return mu

    def surface_at(self, s):
        """Index of the surface below the whole tool; -1 where it is on two."""
        k = int(np.searchsorted(self.seams, s))
        on_two = k > 0 and s < self.seams[k - 1] + self.ramp
        return -1 if on_two else k

    def samples(self, seconds, normal=None):
        """Yields time, wrench, velocity, direction and place s of each sample.

        Args: normal: function of time [N] instead of the constant.
        """
        axis = np.array([np.cos(self.angle), np.sin(self.angle), 0.0])
        s, v, sign = 0.0, 0.0, 1.0
        for k in range(round(seconds / self.period)):
            time = k * self.period
            touching = time >= self.touch_sec
            stop = self.accelerate_sec * self.speed / 2.0  # Braking distance [m].
            if sign > 0.0 and s > self.length - stop:
                sign = -1.0
            elif sign < 0.0 and s < stop:
                sign = 1.0
            target = sign * self.speed if touching else 0.0
            most = self.speed / self.accelerate_sec * self.period
            dv = float(np.clip(target - v, -most, most))
            v += dv
            s += v * self.period
            R = (normal(time) if normal else self.normal) if touching else 0.0
            # Stiction is regularised below some mm/s, as Drake's is.
            F = -self.friction_at(s) * R * v / np.hypot(v, 1e-3)
            wrench = np.zeros(6)
            wrench[:3] = (F - TOOL_MASS * dv / self.period) * axis
            wrench[2] = R
            wrench[3:] = 0.015 * F * np.array([axis[1], -axis[0], 0.0])
            scale = np.repeat([1.0, 0.1], 3)
            wrench += self.noise * scale * self.rng.normal(size=6)
            velocity = np.concatenate([v * axis, np.zeros(3)])
            velocity += 7e-4 * self.rng.normal(size=6)
            direction = sign * axis if abs(target) > 0.0 else np.zeros(3)
            yield time, wrench, velocity, direction, s

"""Motions that people record: sums of sines, pick and place, slow ramps, a path shown
by hand and replayed. Each is a table on an even grid of time."""

from dataclasses import dataclass

import numpy as np

from gap_benchmark.robots import Robot


@dataclass(frozen=True)
class Motion:
    """time (k,) [s]; q, v, a (k, n) [rad, or m]."""

    time: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


def _grid(seconds: float, step: float) -> np.ndarray:
    return step * np.arange(round(seconds / step) + 1)


def multisine(robot: Robot, seconds: float, step: float, rng) -> Motion:
    n, k = len(robot.middle), 5
    t = _grid(seconds, step)[:, None, None]
    w = 2 * np.pi * rng.uniform(0.1, 0.7, (n, k))
    w[:, 0] = 2 * np.pi * rng.uniform(0.08, 0.15, n)
    phase = rng.uniform(0, 2 * np.pi, (n, k))
    size = rng.uniform(0.5, 1.0, (n, k))
    size *= robot.reach[:, None] / size.sum(axis=1, keepdims=True)
    fast = (size * w).sum(axis=1) / robot.fastest
    w /= np.maximum(1.0, fast / 1.3)[:, None]
    sin, cos = np.sin(w * t + phase), np.cos(w * t + phase)
    q = robot.middle + (size * sin).sum(axis=2)
    v, a = (size * w * cos).sum(axis=2), -(size * w**2 * sin).sum(axis=2)
    return Motion(t[:, 0, 0], q, v, a)


def _from_velocity(t, v, start) -> Motion:
    step = t[1] - t[0]
    area = np.cumsum(0.5 * step * (v[1:] + v[:-1]), axis=0)
    q = start + np.vstack([np.zeros(v.shape[1]), area])
    return Motion(t, q, v, np.gradient(v, step, axis=0))


def pick_and_place(robot: Robot, seconds: float, step: float, rng) -> Motion:
    """From place to place with trapezoids of velocity, all joints in the same time."""
    t = _grid(seconds, step)
    n = len(robot.middle)
    v = np.zeros((len(t), n))
    here = robot.middle + robot.reach * rng.uniform(-0.8, 0.8, n)
    start, now = here.copy(), 0.3
    while now < seconds:
        there = robot.middle + robot.reach * rng.uniform(-1.0, 1.0, n)
        way = there - here
        ramp = rng.uniform(0.15, 0.3)
        speed = robot.fastest * rng.uniform(0.35, 0.9)
        cruise = max(float((np.abs(way) / speed).max()), ramp)
        s = t - now
        profile = np.clip(np.minimum(s, cruise + ramp - s) / ramp, 0.0, 1.0)
        v += profile[:, None] * way / cruise
        now += cruise + ramp + rng.uniform(0.1, 0.5)
        here = there
    return _from_velocity(t, v, start)


def slow_ramps(robot: Robot, seconds: float, step: float, rng) -> Motion:
    """Each joint to and fro at constant speeds, some very slow: for friction."""
    t = _grid(seconds, step)
    n = len(robot.middle)
    v = np.zeros((len(t), n))
    for i in range(n):
        now, q = rng.uniform(0.1, 0.4), 0.0
        while now < seconds:
            speed = robot.fastest[i] * 10 ** rng.uniform(-1.3, -0.2)
            way = (
                robot.reach[i] * rng.uniform(0.4, 0.95) * (-1.0 if q >= 0 else 1.0) - q
            )
            ramp = 0.12
            cruise = max(abs(way) / speed, ramp)
            if cruise > 6.0:
                cruise, way = 6.0, np.sign(way) * speed * 6.0
            s = t - now
            v[:, i] += (
                way
                / cruise
                * np.clip(np.minimum(s, cruise + ramp - s) / ramp, 0.0, 1.0)
            )
            now += cruise + ramp + rng.uniform(0.05, 0.25)
            q += way
    return _from_velocity(t, v, robot.middle.copy())


def hand_guided(robot: Robot, seconds: float, step: float, rng) -> Motion:
    """A path that somebody showed, replayed: uneven, with pauses, a tremor in it."""
    t = _grid(seconds, step)
    n = len(robot.middle)
    v = np.zeros((len(t), n))
    here = robot.middle.copy()
    now = 0.2
    while now < seconds:
        there = robot.middle + robot.reach * np.clip(
            0.5 * rng.normal(size=n), -1.0, 1.0
        )
        way = there - here
        longest = max(float((1.9 * np.abs(way) / robot.fastest).max()), 0.4)
        longest *= rng.uniform(1.0, 1.8)
        s = np.clip((t - now) / longest, 0.0, 1.0)[:, None]
        v += 30.0 * s**2 * (1 - s) ** 2 * way / longest
        now += longest * rng.uniform(0.7, 1.0) + rng.choice([0.0, 0.0, 0.5])
        here = there
    tremor = 2 * np.pi * rng.uniform(2.0, 4.0, n)
    v += 0.01 * robot.fastest * np.sin(tremor * t[:, None] + rng.uniform(0, 6.28, n))
    return _from_velocity(t, v, robot.middle.copy())


MOTIONS = {"multisine": multisine, "pick": pick_and_place, "ramps": slow_ramps,
           "guided": hand_guided}  # fmt: skip

"""How a ball spins whose orientation nobody measures, from how it moves.

While it touches a plane, friction f acts at one point alone: m dv/dt = m g_t + f and
I dw/dt = -r n x f, so that its slip, the velocity of the point of contact, changes by
(1 + kappa) (dv/dt - a) with kappa = m r^2/I and a = g_t kappa/(1 + kappa), the
acceleration of a ball that rolls. Where it rolls in the end, its slip before follows
from its velocities, whatever friction there is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.gap.numerics.free_body import FreeBody, nearest
from makebreak.gap.numerics.runs import runs_of

TOUCHES = 0.03  # Of its radius: a ball that is so near to a plane is on it.
# A ball may slide whose acceleration differs from that of one that rolls by more than
# this [m/s2] and so many deviations. One that goes on so to the end may also be slowed
# by the ground it rolls on: to slide it takes this share of what friction can do.
LEAST, SURE, SHARE = 0.3, 3.0, 0.25


@dataclass(frozen=True, eq=False)
class Rolling:
    """rolled (3,): velocity with which it would roll already, of one that slides, and
    its deviation std (3,); none: it rolls. more (3,): its slip is more by this times 0
    to 1, where it still slides when it is seen last; none: it does not."""

    rolled: np.ndarray | None = None
    std: np.ndarray | None = None
    more: np.ndarray | None = None

    def drawn(self, rng: np.random.Generator) -> "Rolling":
        """One that it may be as well."""
        if self.rolled is None or self.std is None:
            return self
        rolled = self.rolled + self.std * rng.normal(size=3)
        more = None if self.more is None else 2.0 * float(rng.random()) * self.more
        return Rolling(rolled, self.std, more)

    def spin(self, body: FreeBody, velocity, normal) -> np.ndarray:
        """(3,) [rad/s]. Args: velocity (3,), of the ball, and normal (3,) of the
        plane."""
        slip = np.zeros(3)
        if self.rolled is not None:
            slip = (1.0 + _kappa(body)) * (velocity - self.rolled)
        if self.more is not None:
            slip = slip + 0.5 * self.more
        return np.cross(normal, velocity - slip) / body.spheres[0, 3]


def rolling(body: FreeBody, time, place, std) -> Sequence[Rolling]:
    """Of each row of a stretch without impacts.

    Args: time (n,); place (n, 3, 3): x, y and z with two derivatives, smoothed; std
        (n, 2, 3): deviations of velocities and accelerations.
    """
    n = len(time)
    slides, on = np.zeros(n, bool), np.zeros(n, bool)
    a_roll, off, grip = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
    kappa = _kappa(body)
    for k, x in enumerate(place):
        gap, normal, ground = nearest(body, np.array([1.0, 0, 0, 0, *x[:, 0]]))
        on[k] = ground >= 0 and gap < TOUCHES * body.spheres[0, 3]
        if not on[k]:
            continue
        g, a = (y - normal * (normal @ y) for y in (body.gravity, x[:, 2]))
        a_roll[k] = kappa / (1.0 + kappa) * g
        off[k] = a - a_roll[k]
        grip[k] = body.pairs[0, ground, 3] * -float(normal @ body.gravity)
        slides[k] = _exceeds(off[k], LEAST, std[k, 1])
    found = [Rolling()] * n
    for a, b in runs_of(slides):
        ends = b < n and on[b]
        last = min(b, n - 1)
        for k in range(a, b):
            size = float(np.linalg.norm(off[k]))
            if not ends and size < SHARE * grip[k]:
                continue
            more = None
            if not ends:  # It slips against its acceleration.
                more = -float(np.linalg.norm(place[k, :, 1])) / size * off[k]
            rolled = place[last, :, 1] - a_roll[k] * (time[last] - time[k])
            found[k] = Rolling(rolled, std[last, 0], more)
    # Where no single acceleration is sure, the mean of all that follow may be.
    last = n - 1
    for k in range(last):
        if found[k].rolled is not None or not on[k:].all():
            continue
        seconds = time[last] - time[k]
        mean = (place[last, :, 1] - place[k, :, 1]) / seconds - a_roll[k]
        size = float(np.linalg.norm(mean))
        sure = np.linalg.norm(std[[k, last], 0], axis=0) / seconds
        if _exceeds(mean, max(LEAST, SHARE * grip[k]), sure):
            more = -float(np.linalg.norm(place[k, :, 1])) / size * mean
            rolled = place[last, :, 1] - a_roll[k] * seconds
            found[k] = Rolling(rolled, std[last, 0], more)
    return found


def _exceeds(a, least: float, std) -> bool:
    """Whether an acceleration (3,) is more than `least`, and than SURE deviations of it
    along itself; std (3,)."""
    size = float(np.linalg.norm(a))
    along = float(np.linalg.norm(a * std))  # NaN where the start is too vague.
    return size > least and size**2 > SURE * along


def _kappa(body: FreeBody) -> float:
    radius = float(body.spheres[0, 3])
    return float(body.mass) * radius**2 / float(np.trace(body.inertia) / 3.0)

"""How fast a tip may go where it may meet an object, learned touch by touch.

The contact is anticipated where the model has the object's side, and a little nearer or
farther: a Gaussian over the distance between tip and side at which a touch is felt,
which every touch corrects. Far from there the tip goes at full speed; in the region of
anticipated contact it goes at the speed at which the last touches say that the impact
has the desired force. Between the two its speed falls with the distance that is left,
smooth in all orders.

Source: Sidhik, Sridharan, Ruiken, "An adaptive framework for trajectory following in
changing-contact robot manipulation tasks": sections 3.3 (Kalman filter), 3.4.1 (speed
of approach; here by regression, numerics/contact_anticipator.py) and 3.5.2 (eq. 11).
There a trial is a motion along one line that is repeated; here it is any touch of any
side, so that what is learned is a distance, not a place.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from makebreak.systems.changing_contact.numerics.contact_anticipator import (
    capped,
    speed_by_regression,
)
from makebreak.systems.changing_contact.numerics.velocity_profile import unit_step

KEPT = 5  # Impacts that are remembered.
# So late is a touch felt, at the most: by then the tip is slower than it came [s].
LATE_SEC = 0.03
# A touch that is felt so many deviations from where it is anticipated is of something
# else (the table); then where the side is, is known less well.
GATE = 4.0


@dataclass
class TouchSpeedConfig:
    """Speeds before a touch, and how the one in the region of anticipated contact is
    learned."""

    first: float = 0.05  # Speed in the region before any touch was felt [m/s].
    least: float = 0.01  # Least speed in the region [m/s].
    # Largest speed of a tip that has not touched, in the region and before it [m/s].
    most: float = 0.15
    # Largest factor of the speed in the region from one touch to the next.
    growth: float = 1.4
    # Standard deviation, in proportion, by which the force of a touch at one speed
    # changes from one touch to the next; sides and places differ.
    force_drift: float = 0.1
    # Length before the region over which the speed falls to that in the region [m].
    brake: float = 0.01


@dataclass
class TouchPlaceConfig:
    """The region of anticipated contact: the distance between tip and side at which a
    touch is felt."""

    std_first: float = 0.004  # Standard deviation before any touch [m].
    std_measured: float = 0.0015  # Standard deviation of one measurement [m].
    std_drift: float = 0.001  # Standard deviation of the change between touches [m].
    sigmas: float = 2.0  # Half width of the region, in standard deviations.


@dataclass
class TouchDownConfig:
    """How fast a tip comes down, and what it learns from each touch."""

    # Desired peak force of a touch, as the arm feels it [N].
    force_desired: float = 8.0
    speed: TouchSpeedConfig = field(default_factory=TouchSpeedConfig)
    place: TouchPlaceConfig = field(default_factory=TouchPlaceConfig)
    touch_force: float = 1.0  # Force from which on a touch is felt [N].
    # Time after the touch within which its peak force comes [s].
    peak_sec: float = 0.08
    # Time without a felt force after which the next touch counts as another one [s].
    apart_sec: float = 0.05


@dataclass(frozen=True)
class TouchDownState:
    """Memory between two ticks."""

    speed: float  # v_a, in the region [m/s].
    mean: float = 0.0  # Of the distance at which a touch is felt [m].
    variance: float = 0.0  # [m2]
    impacts: tuple[tuple[float, float], ...] = ()  # (speed, peak force), oldest first.
    apart_sec: float = np.inf  # For how long nothing was felt,
    since_sec: float = np.inf  # and how long ago the last touch began.
    at: float = 0.0  # The speed when it did [m/s].
    peak: float = 0.0  # Of the force since [N].
    recent: tuple[float, ...] = ()  # The tip's speed, over LATE_SEC, oldest first.

    def __deepcopy__(self, memo) -> "TouchDownState":
        return self


def first_state(config: TouchDownConfig) -> TouchDownState:
    return TouchDownState(config.speed.first, variance=config.place.std_first**2)


def next_touch(
    config: TouchDownConfig,
    state: TouchDownState,
    dt: float,
    distance: float,
    speed: float,
    force: float,
    pushing: bool,
) -> TouchDownState:
    """One tick.

    Args: dt [s]; distance of tip and side as the model has it [m]; speed of the tip
        [m/s]; force on it [N]; pushing: whether it is to touch; else what it feels is
        its own acceleration.
    """
    c, s, place = config, state, config.place
    s = replace(s, since_sec=s.since_sec + dt)
    if s.since_sec <= c.peak_sec:
        s = replace(s, peak=max(s.peak, force))
    elif s.peak > 0.0:  # The touch is over: v_a of the next one.
        slow = s.at < 0.5 * c.speed.least  # It leaned on it; that was no impact.
        impacts = s.impacts if slow else (*s.impacts, (s.at, s.peak))[-KEPT:]
        drift, bounds = c.speed.force_drift, (c.speed.least, c.speed.most)
        wanted = speed_by_regression(impacts, c.force_desired, drift=drift)
        if wanted is not None:
            wanted = capped(wanted, s.speed, c.speed.growth, *bounds)
            s = replace(s, speed=wanted)
        s = replace(s, impacts=impacts, peak=0.0)
    felt = force >= c.touch_force
    if felt and pushing and s.apart_sec >= c.apart_sec:
        predicted = s.variance + place.std_drift**2
        spread = np.sqrt(predicted + place.std_measured**2)
        gain = predicted / spread**2
        if abs(distance - s.mean) > GATE * spread:
            s = replace(s, variance=min(2.0 * predicted, place.std_first**2))
        else:
            s = replace(
                s,
                mean=s.mean + gain * (distance - s.mean),
                variance=(1.0 - gain) * predicted,
                since_sec=0.0,
                at=max(s.recent, default=speed),
                peak=force,
            )
    apart = 0.0 if felt else s.apart_sec + dt
    recent = (*s.recent, speed)[-max(1, round(LATE_SEC / dt)) :]
    return replace(s, apart_sec=apart, recent=recent)


def allowed_speed(config: TouchDownConfig, state: TouchDownState, distance) -> float:
    """[m/s] of a tip at a distance [m] from the side that has not touched it yet."""
    c, place, s = config.speed, config.place, state
    variance = s.variance + place.std_drift**2 + place.std_measured**2
    ahead = distance - s.mean - place.sigmas * np.sqrt(variance)
    return float(s.speed + (c.most - s.speed) * unit_step(ahead / c.brake)[0])

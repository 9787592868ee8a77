"""The motions between two pushes of a ball, in a frame that moves with the ball.

In that frame the ball lies still, so a motion needs no new plan as it rolls, and a
contact with it is at the same place push after push. The frame has the world's axes and
height; its origin is under the ball.

    BALL   lift, pass over the ball, come down behind it; ends in a contact
    TABLE  lift, go ahead of the ball, come down on the table, slide sideways on it

Segments tell what is met: the ball in segment BALL_SEGMENT of the one, the table in
TABLE_SEGMENT of the other.
"""

from dataclasses import dataclass, field

import numpy as np

from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    Segment,
    least_time,
    segment_time,
)

BALL, TABLE = 0, 1
BALL_SEGMENT, TABLE_SEGMENT = 0, 1
DOWN = np.array([0.0, 0.0, -1.0])
N_FRAME = 7  # Origin (3) [m], its velocity (3) [m/s], when it was there [s].


@dataclass
class TableConfig:
    """How the tip touches the table ahead of the ball."""

    press: float = 2.5  # Force on it [N].
    # Distance ahead of the ball's centre at which the tip lands [m].
    land_ahead: float = 0.075
    slide: float = 0.04  # Length of the sideways slide [m].
    # Number of slides to and fro, into the circle, each from rest; 0: one slide out of
    # the circle, as soon as the table is felt.
    survey: int = 0


@dataclass
class PushConfig:
    """The shape of the motions."""

    # Time to lift the tip, pass over the ball and land, if nothing slows it; more for a
    # long distance [s].
    reposition_sec: float = 0.4
    # Clearance over the modelled ball while the tip passes over it [m].
    lift: float = 0.015
    # Distance behind the ball's centre at which the tip lands, seen from above [m].
    land_behind: float = 0.018
    press: float = 1.0  # Force on the ball from the touch until the push begins [N].
    table: TableConfig = field(default_factory=TableConfig)


SLIDE_SPEED = 0.08  # [m/s]
# Of a survey: the finger hardly moves until the landing has calmed down.
REST_WAY, REST_SEC = 0.001, 0.25  # [m], [s]
SURVEY_ACCELERATION = 1.0  # [m/s2]
REFERENCE_WAY = 0.11  # [m] A way that is longer takes longer.
BEYOND = 0.02  # [m] A motion into a contact is planned so far behind the model's.
PRESS_WAY, PRESS_SEC = 0.002, 0.2  # Along the contact, where force decides.
HOP_SPEED = 0.3  # From the ball to over the table, and down on it [m/s].


def frame_at(frame, t):
    """Origin (3,) [m] at time t [s] of a frame (N_FRAME,)."""
    return frame[:3] + (t - frame[6]) * frame[3:6]


def moved_frame(frame, t, p_ball, v_ball, follow_sec):
    """The frame from time t on: it goes on from where it is, with a velocity that
    brings it under the ball within about follow_sec.

    Args: p_ball, v_ball (3,), as estimated, of which x and y count.
    Returns: (N_FRAME,).
    """
    p = frame_at(frame, t)
    v = v_ball + (p_ball - p) / follow_sec
    v = frame[3:6] + 0.5 * (v - frame[3:6])
    v[2] = 0.0
    return np.concatenate([p, v, [t]])


def frame_under(p_ball, v_ball, t):
    """A frame (N_FRAME,) under the ball, with its velocity."""
    return np.array([*p_ball[:2], 0.0, *v_ball[:2], 0.0, t])


def _segment(kind, points, start, seconds, targets=(), n=DOWN):
    return Segment(
        kind,
        np.array(points),
        np.array([start, start + seconds]),
        force_directions=np.array([n] * len(targets)).reshape(-1, 3),
        force_targets=np.array(targets),
    )


def ball_pattern(config, start, heading, radius_ball, radius_tip, a_max):
    """Over the ball and down behind it.

    Args: start (3,) in the frame [m]; heading (2,) unit vector in which the ball is to
        be pushed; the radii as modelled [m]; a_max [m/s2].
    """
    centre, reach = radius_ball, radius_ball + radius_tip
    top = centre + reach + config.lift
    surface = centre + np.sqrt(reach**2 - config.land_behind**2)
    land = np.append(-config.land_behind * heading, surface)
    top = max(top, start[2] + 0.005)
    rise = start + [0.0, 0.0, 0.6 * (top - start[2])]
    over = np.append(0.5 * (start[:2] + land[:2]), top)
    fall = land + [0.0, 0.0, 0.5 * (top - land[2])]
    end = land + BEYOND * DOWN
    n = np.array([0.0, 0.0, centre]) - land
    n /= np.linalg.norm(n)
    points = np.array([start, rise, over, fall, end])
    way = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    over_it = _segment("spline", points, 0.0, 1.0)
    seconds = max(
        config.reposition_sec * max(1.0, way / REFERENCE_WAY),
        least_time(over_it, a_max, stops=False),
    )
    return MotionPattern(
        (
            _segment("spline", points, 0.0, seconds),
            _segment(
                "line", [end, end + PRESS_WAY * n], seconds, PRESS_SEC,
                [config.press], n,
            ),
        ),
        a_max,
    )  # fmt: skip


def table_pattern(config, start, heading, radius_ball, radius_tip, a_max):
    """Ahead of the ball and down on the table, then sideways. Args: as ball_pattern."""
    side = np.array([heading[1], -heading[0], 0.0])  # Out of a circle run to the left.
    table = config.table
    ahead = np.append(table.land_ahead * heading, 2.0 * radius_ball + radius_tip)
    down = np.append(table.land_ahead * heading, radius_tip - BEYOND)
    hop = segment_time(float(np.linalg.norm(ahead - start)), HOP_SPEED, a_max)
    fall = segment_time(ahead[2] - down[2], HOP_SPEED, a_max, stops=False)
    if table.survey > 0:
        return _survey(table, [start, ahead, down], [hop, fall], -side, a_max)
    slide = segment_time(table.slide, SLIDE_SPEED, a_max)
    return MotionPattern(
        (
            _segment("line", [start, ahead], 0.0, hop),
            _segment("line", [ahead, down], hop, fall),
            _segment(
                "line", [down, down + table.slide * side], hop + fall, slide,
                [table.press],
            ),
        ),
        a_max,
    )  # fmt: skip


def _survey(table, points, seconds, side, a_max):
    """Down on the table, a rest there, and then to and fro along side (3,)."""
    near, far = points[-1] + REST_WAY * side, points[-1] + table.slide * side
    targets = [table.press]
    segments, time = [], 0.0
    for k, duration in enumerate(seconds):
        segments.append(_segment("line", points[k : k + 2], time, duration))
        time += duration
    ways = [(points[-1], near, REST_SEC)]
    duration = segment_time(table.slide - REST_WAY, SLIDE_SPEED, SURVEY_ACCELERATION)
    for k in range(table.survey):
        ways.append((near, far, duration) if k % 2 == 0 else (far, near, duration))
    for begin, end, duration in ways:
        segments.append(_segment("line", [begin, end], time, duration, targets))
        time += duration
    return MotionPattern(tuple(segments), a_max)

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.timing import timed
from makebreak.systems.perception.numerics import constant_velocity
from makebreak.systems.perception.numerics.ball_tracker import strength_weights
from makebreak.systems.perception.numerics.pinhole import Pinhole
from makebreak.systems.perception.numerics.pose_tracker import (
    Shape,
    find_marker,
    find_pose,
    nearest_yaw,
    rolling_turn,
)

# Values of the status port.
TRACKED, NOT_FOUND, OUTLIER, WRONG_IMAGE = 0.0, 1.0, 2.0, 3.0

GATE = 8.0  # [standard deviations] A measurement that is further off is not believed,
PATIENCE = 3  # unless this many in a row are: then it was moved, start afresh.
HOLD_SEC = 0.1  # Unseen for longer: velocities zero, and look everywhere.
START_SPEED, START_RATE = 0.3, 2.0  # [m/s], [rad/s] Deviations at a fresh start.
P_MAX = 1.0  # [m2, rad2] A variance grows no further.

# Layout of the state: pose and its rate, covariances of place and yaw, and memory.
_POSE, _RATE, _P, _P_YAW = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_UNSEEN_SEC, _N_OUTLIERS, _STATUS = 12, 13, 14
# The last measurement that was believed, and when that was [s].
_READ, _READ_AT, _SIZE = slice(15, 18), 18, 19


@dataclass
class PoseTrackerConfig:
    z: float = 0.02  # [m] height of the object's frame.
    hue: float = 0.41  # [rad] of its colour: 0 red, 2.09 green, 4.19 blue.
    position_std: float = 1e-3  # [m] of one measurement, each way.
    yaw_std: float = 0.01  # [rad]
    # How freely it moves [m^2/s^3] and turns [rad^2/s^3].
    acceleration_density: float = 0.01
    turning_density: float = 2.0
    # Of an object that rolls on the table, in its frame; empty: it slides.
    rolling_axis: list[float] = field(default_factory=list)
    period_sec: float = 0.0125
    offset_sec: float = 0.0


@dataclass
class Marker:
    """An ArUco marker (4X4_50) on top of the object, which it is found by."""

    number: int = 0
    side: float = 0.04  # [m]
    center: tuple[float, float, float] = (0.0, 0.0, 0.02)  # [m] in the object's frame.
    yaw: float = 0.0  # [rad] of its upper edge from the object's x axis.

    def corners(self) -> np.ndarray:
        """(4, 3) [m] in the object's frame, as numbered by OpenCV."""
        square = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        xy = self.side / 2.0 * square @ np.array([[c, s], [-s, c]])
        return np.hstack([xy, np.zeros((4, 1))]) + self.center


class PoseTracker(LeafSystem):
    """Where a flat object lies on a table, how it is turned, and how fast it moves and
    turns, from an overhead camera's pictures.

    Each period the picture is asked for, the object is found in it (numerics/
    pose_tracker.py) and Kalman filters of constant velocity are corrected (numerics/
    constant_velocity.py), one for its place and one for its yaw. It is taken to lie
    flat: z is as configured, roll and pitch are 0. One that rolls is taken to roll
    without slipping: about its axis it turns as fast as its place says.

    Inputs:  image, abstract ImageRgba8U of the camera model's size.
    Outputs: p_WB (3,) [m]; q_WB (4,) = [w, x, y, z]; yaw (1,) [rad], without jumps;
             v_WB (3,) [m/s]; w_WB (3,) [rad/s]; seen (1,): 1 if the last picture showed
             the object where it can be, else 0; status (1,): TRACKED, NOT_FOUND,
             OUTLIER or WRONG_IMAGE; std (2,): of p_WB each way [m], of yaw [rad];
             reading (8,): time, place and quaternion of the last measurement that was
             believed, as it was measured; the time is -1 before the first.

    Of an outline that some turn leaves as it is (a box: half a turn), yaw is that one
    which is nearest to the last. A disc's yaw stays as it was at first.

    An object that is not seen is not guessed: its pose is held, its velocities are held
    for HOLD_SEC and zero from then on, and std grows. Before the first sight it is at
    the point below the camera, with yaw 0.
    """

    def __init__(
        self,
        config: PoseTrackerConfig,
        camera: Pinhole,
        shape: Shape,
        marker: Marker | None = None,
    ):
        """Args: shape: of numerics.pose_tracker.make_shape; marker: what the object is
        found by in place of its outline."""
        super().__init__()
        for name in (
            "position_std",
            "yaw_std",
            "acceleration_density",
            "turning_density",
            "period_sec",
        ):
            if not 0.0 < getattr(config, name) < np.inf:
                raise ValueError(f"{name} is {getattr(config, name)}, expected above 0")
        if not np.isfinite(config.hue):
            raise ValueError(f"hue is {config.hue}, expected a number")
        top = config.z + float(shape.whole.points[:, 2].max())
        if not top < camera.p_WC[2]:
            raise ValueError(
                f"the camera at height {camera.p_WC[2]} must be above the object, "
                f"whose top is at {top}"
            )
        if marker is not None and not (0.0 < marker.side and 0 <= marker.number < 50):
            raise ValueError(
                f"marker has number {marker.number} and side {marker.side}, expected "
                "0 to 49 (of the dictionary 4X4_50) and a side above 0"
            )
        if len(config.rolling_axis) not in (0, 3):
            raise ValueError(
                f"rolling_axis is {config.rolling_axis}, expected 3 numbers or none"
            )
        self._config, self._camera, self._shape = config, camera, shape
        self._axis = np.array(config.rolling_axis or np.zeros(3), dtype=float)
        self._weights = strength_weights(config.hue)
        self._marker = marker
        self._size = (camera.height, camera.width, 4)
        self._image = self.DeclareAbstractInputPort("image", Value(ImageRgba8U()))
        start: Any = np.zeros(_SIZE)
        start[_POSE.start : _POSE.start + 2] = camera.p_WC[:2]
        start[_P], start[_P_YAW] = self._fresh()
        start[_UNSEEN_SEC], start[_STATUS] = 2.0 * HOLD_SEC, NOT_FOUND
        start[_READ], start[_READ_AT] = start[_POSE], -1.0
        self._state = self.DeclareDiscreteState(start)
        ticket = {self.discrete_state_ticket(self._state)}
        for name, size, calc in (
            ("p_WB", 3, self._position),
            ("q_WB", 4, self._quaternion),
            ("yaw", 1, self._yaw),
            ("v_WB", 3, self._velocity),
            ("w_WB", 3, self._angular_velocity),
            ("seen", 1, self._seen),
            ("status", 1, self._status),
            ("std", 2, self._std),
            ("reading", 8, self._reading),
        ):
            self.DeclareVectorOutputPort(name, size, calc, prerequisites_of_calc=ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )
        first_call(self._first_call, shape)

    def _first_call(self, shape: Shape):
        blank = np.zeros(self._size, np.uint8)
        middle = (self._camera.width // 2, self._camera.height // 2)
        cv2.circle(blank, middle, 40, (200, 0, 0, 255), -1)
        pose = np.array([*self._camera.p_WC[:2], 0.0])
        for hue in (0.0, np.pi):
            for guess in (pose, None):
                find_pose(blank, self._camera, strength_weights(hue), shape, 0.0, guess)

    @timed
    def _update(self, context, discrete_state):
        c = self._config
        state = context.get_discrete_state(self._state).value()
        pose, rate, P, P_yaw = state[_POSE], state[_RATE], state[_P], state[_P_YAW]
        lost = state[_UNSEEN_SEC] > HOLD_SEC
        dt = c.period_sec
        ahead, _, P_next = constant_velocity.predict(
            pose, rate, P, dt, c.acceleration_density
        )
        _, _, P_yaw_next = constant_velocity.predict(
            pose, rate, P_yaw, dt, c.turning_density
        )
        picture: Any = self._image.Eval(context)
        image = picture.data
        measured: Any = None
        status = WRONG_IMAGE
        if image.shape == self._size:
            # Where it should be; where it was seen last, if it was not there.
            near = ahead if state[_STATUS] == TRACKED else pose
            measured = self._find(image, None if lost else near)
            status = NOT_FOUND if measured is None else TRACKED
        n_outliers = 0
        afresh = lost
        if measured is None:
            n_outliers = state[_N_OUTLIERS]
        else:
            measured[2] = nearest_yaw(measured[2], self._shape.fold, ahead[2])
            if not lost and self._off(measured - ahead, P_next, P_yaw_next) > GATE:
                n_outliers, status = state[_N_OUTLIERS] + 1, OUTLIER
                if n_outliers >= PATIENCE:
                    n_outliers, status, afresh = 0, TRACKED, True
        if status == TRACKED and afresh:
            pose, rate, unseen_sec = measured, np.zeros(3), 0.0
            P, P_yaw = self._fresh()
        elif status == TRACKED:
            pose, rate, unseen_sec = ahead.copy(), rate.copy(), 0.0
            for at, var, sigma in (
                (slice(0, 2), P_next, c.position_std),
                (slice(2, 3), P_yaw_next, c.yaw_std),
            ):
                pose[at], rate[at], after = constant_velocity.correct(
                    ahead[at], rate[at], var, measured[at], sigma
                )
                if at.start == 0:
                    P = after
                else:
                    P_yaw = after
        else:
            # Held where it was, and less and less sure.
            unseen_sec = min(state[_UNSEEN_SEC] + dt, 2.0 * HOLD_SEC)
            rate = rate if unseen_sec <= HOLD_SEC else np.zeros(3)
            P = P_next if P_next[0] < P_MAX else P
            P_yaw = P_yaw_next if P_yaw_next[0] < P_MAX else P_yaw
        read, read_at = state[_READ], state[_READ_AT]
        if status == TRACKED:
            read, read_at = measured, context.get_time()
        memory = [unseen_sec, n_outliers, status, *read, read_at]
        state = np.concatenate([pose, rate, P, P_yaw, memory])
        if np.isfinite(state).all():
            discrete_state.set_value(self._state, state)

    def _find(self, image, near):
        """x, y, yaw (3,) of the object in a picture, near a pose or anywhere."""
        z = self._config.z
        if self._marker is not None:
            found = find_marker(
                image, self._camera, self._marker.number, self._marker.corners(), z
            )
        else:
            found = find_pose(image, self._camera, self._weights, self._shape, z, near)
        return None if found is None else found.pose.copy()

    def _off(self, error, P, P_yaw):
        """How far off a measurement is, in standard deviations of its prediction."""
        c = self._config
        of_place = np.hypot(*error[:2]) / np.sqrt(P[0] + c.position_std**2)
        return max(of_place, abs(error[2]) / np.sqrt(P_yaw[0] + c.yaw_std**2))

    def _fresh(self):
        c = self._config
        return (
            np.array([c.position_std**2, 0.0, START_SPEED**2]),
            np.array([c.yaw_std**2, 0.0, START_RATE**2]),
        )

    def _get(self, context):
        return context.get_discrete_state(self._state).value()

    def _position(self, context, output):
        output.SetFromVector([*self._get(context)[_POSE][:2], self._config.z])

    def _reading(self, context, output):
        state = self._get(context)
        x, y, yaw = state[_READ]
        output.SetFromVector([state[_READ_AT], x, y, self._config.z, *_upright(yaw)])

    def _quaternion(self, context, output):
        output.SetFromVector(_upright(self._get(context)[_POSE][2]))

    def _yaw(self, context, output):
        output.SetAtIndex(0, self._get(context)[_POSE][2])

    def _velocity(self, context, output):
        output.SetFromVector([*self._get(context)[_RATE][:2], 0.0])

    def _angular_velocity(self, context, output):
        state = self._get(context)
        output.SetFromVector(
            rolling_turn(state[_RATE], state[_POSE][2], self._axis, self._config.z)
        )

    def _seen(self, context, output):
        output.SetAtIndex(0, float(self._get(context)[_STATUS] == TRACKED))

    def _status(self, context, output):
        output.SetAtIndex(0, self._get(context)[_STATUS])

    def _std(self, context, output):
        state = self._get(context)
        output.SetFromVector(np.sqrt([state[_P][0], state[_P_YAW][0]]))


def _upright(yaw: float) -> list[float]:
    """Quaternion [w x y z] of a turn about the vertical [rad]."""
    return [np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)]

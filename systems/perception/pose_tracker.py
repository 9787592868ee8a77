"""Pose and velocity of a flat object from images (numerics/pose_tracker.py)."""

from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import cv2
import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed
from makebreak.systems.perception.numerics import constant_velocity
from makebreak.systems.perception.numerics.aruco_marker import find_marker
from makebreak.systems.perception.numerics.ball_tracker import strength_weights
from makebreak.systems.perception.numerics.object_outline import Shape, nearest_yaw
from makebreak.systems.perception.numerics.pinhole import Pinhole
from makebreak.systems.perception.numerics.pose_tracker import find_pose, rolling_turn

# Values of the status port.
TRACKED, NOT_FOUND, OUTLIER, WRONG_IMAGE = 0.0, 1.0, 2.0, 3.0

GATE = 8.0  # A measurement farther from its prediction is an outlier [std].
PATIENCE = 3  # Consecutive outliers that restart the filter: the object was moved.
HOLD_SEC = 0.1  # Unseen for longer: velocities zero, and the whole image is searched.
START_SPEED, START_RATE = 0.3, 2.0  # Std of velocities after a restart [m/s], [rad/s].
P_MAX = 1.0  # Bound of the variances [m2], [rad2].

# Layout of the state: pose and its rate, covariances of position and yaw, and memory.
_POSE, _RATE, _P, _P_YAW = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_UNSEEN_SEC, _N_OUTLIERS, _STATUS = 12, 13, 14
# The last accepted measurement, and its time [s].
_READ, _READ_AT, _SIZE = slice(15, 18), 18, 19


@dataclass
class SlidingMotionConfig:
    """How the object may move, in the filter."""

    # Spectral density of the white acceleration of its position [m^2/s^3].
    acceleration_density: float = 0.01
    turning_density: float = 2.0  # The same of its yaw [rad^2/s^3].


@dataclass
class PoseTrackerConfig:
    """Settings of PoseTracker: the colour, the noises of the filter."""

    z: float = 0.02  # Height of the object's frame [m]; the diagram sets it.
    # Hue of the object's colour [rad]: 0 red, 2.09 green, 4.19 blue; the diagram sets
    # it.
    hue: float = 0.41
    # Standard deviation of one measured position, along x and y [m].
    position_std: float = 1e-3
    yaw_std: float = 0.01  # Standard deviation of one measured yaw [rad].
    motion: SlidingMotionConfig = field(default_factory=SlidingMotionConfig)
    # Axis in the object's frame about which it rolls; empty: it slides. The diagram
    # sets it.
    rolling_axis: list[float] = field(default_factory=list)
    period_sec: float = 0.0125  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


@dataclass
class Marker:
    """An ArUco marker (4X4_50) on top of the object, by which it is found."""

    number: int = 0
    side: float = 0.04  # [m]
    center: tuple[float, float, float] = (0.0, 0.0, 0.02)  # In the object's frame [m].
    yaw: float = 0.0  # Of its upper edge from the object's x axis [rad].

    def corners(self) -> np.ndarray:
        """(4, 3) [m] in the object's frame, in OpenCV's order."""
        square = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        xy = self.side / 2.0 * square @ np.array([[c, s], [-s, c]])
        return np.hstack([xy, np.zeros((4, 1))]) + self.center


class PoseTracker(LeafSystem):
    """Pose and velocity of a flat object on a table from an overhead camera's images.

    Each period the object is found in the image (numerics/pose_tracker.py) and corrects
    constant-velocity Kalman filters (numerics/constant_velocity.py), one for position
    and one for yaw. The object is assumed to lie flat: z is as configured, roll and
    pitch are 0. One that rolls is assumed to roll without slipping, so that its turn
    about its axis follows from its velocity.

    Inputs:  image (abstract ImageRgba8U) of the camera model's size.
    Outputs: p_WB (3,) [m]; q_WB (4,) = [w, x, y, z]; yaw (1,) [rad], without jumps;
             v_WB (3,) [m/s]; w_WB (3,) [rad/s]; seen (1,): 1 if the last image showed
             the object at a plausible place, else 0; status (1,): TRACKED, NOT_FOUND,
             OUTLIER or WRONG_IMAGE; std (2,): of x and y [m], of yaw [rad];
             reading (8,): time [s], position and quaternion of the last accepted
             measurement; the time is -1 before the first.

    Where a turn leaves the outline unchanged (a box: half a turn), yaw is the one
    nearest to the last yaw. A disc's yaw keeps its initial value.

    While the object is not seen, its pose is held, its velocities are held for HOLD_SEC
    and then zero, and std grows. Before it is seen for the first time its pose is the
    point below the camera, with yaw 0.
    """

    def __init__(
        self,
        config: PoseTrackerConfig,
        camera: Pinhole,
        shape: Shape,
        marker: Marker | None = None,
    ):
        """Args: camera: its pinhole model; shape: of object_outline.make_shape;
        marker: by which the object is found instead of its outline.

        Raises: ValueError for a setting out of range.
        """
        super().__init__()
        check_settings(config)
        for name in (
            "position_std",
            "yaw_std",
            "motion.acceleration_density",
            "motion.turning_density",
            "period_sec",
        ):
            value = attrgetter(name)(config)
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} is {value}, expected above 0")
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
        start[_P], start[_P_YAW] = self._initial_covariances()
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
            pose, rate, P, dt, c.motion.acceleration_density
        )
        _, _, P_yaw_next = constant_velocity.predict(
            pose, rate, P_yaw, dt, c.motion.turning_density
        )
        image_in: Any = self._image.Eval(context)
        image = image_in.data
        measured: Any = None
        status = WRONG_IMAGE
        if image.shape == self._size:
            # Search near the prediction, or near the last pose if it was not tracked.
            near = ahead if state[_STATUS] == TRACKED else pose
            measured = self._find(image, None if lost else near)
            status = NOT_FOUND if measured is None else TRACKED
        n_outliers = 0
        restart = lost
        if measured is None:
            n_outliers = state[_N_OUTLIERS]
        else:
            measured[2] = nearest_yaw(measured[2], self._shape.fold, ahead[2])
            if not lost and self._off(measured - ahead, P_next, P_yaw_next) > GATE:
                n_outliers, status = state[_N_OUTLIERS] + 1, OUTLIER
                if n_outliers >= PATIENCE:
                    n_outliers, status, restart = 0, TRACKED, True
        if status == TRACKED and restart:
            pose, rate, unseen_sec = measured, np.zeros(3), 0.0
            P, P_yaw = self._initial_covariances()
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
            # The pose is held while its variances grow.
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
        """x, y [m], yaw [rad] (3,) of the object in an image; None: not found. Args:
        near: pose near which it is searched, None: everywhere."""
        z = self._config.z
        if self._marker is not None:
            found = find_marker(
                image, self._camera, self._marker.number, self._marker.corners(), z
            )
        else:
            found = find_pose(image, self._camera, self._weights, self._shape, z, near)
        return None if found is None else found.pose.copy()

    def _off(self, error, P, P_yaw):
        """Error of a measurement in standard deviations of its prediction."""
        c = self._config
        distance = np.hypot(*error[:2]) / np.sqrt(P[0] + c.position_std**2)
        return max(distance, abs(error[2]) / np.sqrt(P_yaw[0] + c.yaw_std**2))

    def _initial_covariances(self):
        """Covariances (3,) of position and of yaw after a restart."""
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

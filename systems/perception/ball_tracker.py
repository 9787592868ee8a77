"""Position and velocity of a ball from images (numerics/ball_tracker.py)."""

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
from makebreak.systems.perception.numerics import constant_velocity, interacting_models
from makebreak.systems.perception.numerics.ball_tracker import (
    find_ball,
    search_half_px,
    strength_weights,
)
from makebreak.systems.perception.numerics.pinhole import Pinhole

# Values of the status port.
TRACKED, NOT_FOUND, OUTLIER, WRONG_IMAGE = 0.0, 1.0, 2.0, 3.0

GATE = 8.0  # A measurement farther from its prediction is an outlier [std].
PATIENCE = 3  # Consecutive outliers that restart the filter: the ball was moved.
HOLD_SEC = 0.1  # Unseen for longer: velocity zero, and the whole image is searched.
START_SPEED = 0.3  # Standard deviation of the velocity after a restart [m/s].

# Layout of the state; then, per motion model, its mean, covariance and probability.
_P, _V, _COVARIANCE = slice(0, 2), slice(2, 4), slice(4, 7)
_UNSEEN_SEC, _N_OUTLIERS, _STATUS, _READING, _MODELS = 7, 8, 9, slice(10, 13), 13
_PER_MODEL = 4 + 3 + 1


@dataclass
class BallMotionConfig:
    """How the ball may move, in the filter: one model of motion, or two."""

    # Spectral density of the white acceleration of a ball that rolls [m^2/s^3].
    acceleration_density: float = 0.03
    # The same of one that is driven (a push, a bump that it rolls off) [m^2/s^3]; 0:
    # only one model.
    driven_density: float = 0.0
    # Mean time for which the ball rolls freely until it is driven [s].
    free_sec: float = 1.0
    driven_sec: float = 0.1  # Mean time for which the ball is driven [s].


@dataclass
class BallTrackerConfig:
    """Settings of BallTracker: the ball, its colour, its motion."""

    # Radius of the ball in the model [m]; the diagram sets it.
    ball_radius: float = 0.0315
    table_z: float = 0.0  # Height of the table [m].
    # Hue of the ball's colour [rad]: 0 red, 2.09 green, 4.19 blue; a fruit has its own.
    hue: float = 0.41
    position_std: float = 1e-3  # Standard deviation of one measured position [m].
    motion: BallMotionConfig = field(default_factory=BallMotionConfig)
    period_sec: float = 0.0125  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


class BallTracker(LeafSystem):
    """Position and velocity of a ball from the images of an overhead camera.

    Each period the ball is found in the image (numerics/ball_tracker.py) and corrects a
    constant-velocity Kalman filter (numerics/constant_velocity.py), or two of them, the
    second one for a ball that is driven (numerics/interacting_models.py). The ball is
    assumed to lie on the table: p_WB has z = table height plus the model's radius, v_WB
    z = 0.

    Inputs:  image (abstract ImageRgba8U) of the camera model's size; radius_error (1,)
             [m], optional: the model's radius minus the learned one. A smaller ball
             lies lower, and so at another point of the ray on which it is seen.
    Outputs: p_WB (3,) [m]; v_WB (3,) [m/s]; seen (1,): 1 if the last image showed the
             ball at a plausible place, else 0; status (1,): TRACKED, NOT_FOUND, OUTLIER
             or WRONG_IMAGE; position_std (1,) [m]: of x and y of p_WB; reading (8,):
             the last one that was tracked, as measured: time [s], p (3,), and the
             identity for q, which nobody sees; time -1 before the first; region (3,) of
             the next image that is looked at: centre and half its side [px], not a
             number: all of it.

    While the ball is not seen, p_WB is held, v_WB is held for HOLD_SEC and then zero,
    and position_std grows. Before the ball is seen for the first time p_WB is the point
    below the camera.

    Args: config; camera: its pinhole model.
    Raises: ValueError for a setting out of range.
    """

    def __init__(self, config: BallTrackerConfig, camera: Pinhole):
        super().__init__()
        check_settings(config)
        for name in (
            "ball_radius",
            "position_std",
            "motion.acceleration_density",
            "motion.free_sec",
            "motion.driven_sec",
            "period_sec",
        ):
            value = attrgetter(name)(config)
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} must be positive, got {value}")
        motion = config.motion
        if not 0.0 <= motion.driven_density < np.inf:
            raise ValueError(
                f"motion.driven_density is {motion.driven_density}, expected 0 or more"
            )
        if not np.isfinite(config.hue):
            raise ValueError(f"hue must be finite, got {config.hue}")
        if not config.table_z + config.ball_radius < camera.p_WC[2]:
            raise ValueError(
                f"the camera at height {camera.p_WC[2]} must be above the ball, whose "
                f"centre is at {config.table_z + config.ball_radius}"
            )
        self._config, self._camera = config, camera
        self._weights = strength_weights(config.hue)
        self._shape = (camera.height, camera.width, 4)
        self._image = self.DeclareAbstractInputPort("image", Value(ImageRgba8U()))
        self._radius_error = self.DeclareVectorInputPort("radius_error", 1)
        densities, dwell = [motion.acceleration_density], [motion.free_sec]
        if motion.driven_density > 0.0:
            densities.append(motion.driven_density)
            dwell.append(motion.driven_sec)
        self._densities = np.array(densities)
        self._chances = interacting_models.transition(dwell, config.period_sec)
        start: Any = np.zeros(_MODELS + _PER_MODEL * len(densities))
        start[_P] = camera.p_WC[:2]
        start[_COVARIANCE] = 1.0, 0.0, START_SPEED**2
        start[_UNSEEN_SEC], start[_STATUS] = 2.0 * HOLD_SEC, NOT_FOUND
        start[_READING] = -1.0, 0.0, 0.0
        at, speed, P = camera.p_WC[:2], np.zeros(2), start[_COVARIANCE]
        start[_MODELS:] = _flat(interacting_models.start(at, speed, P, len(densities)))
        self._state = self.DeclareDiscreteState(start)
        ticket = {self.discrete_state_ticket(self._state)}
        for name, size, calc in (
            ("p_WB", 3, self._position),
            ("v_WB", 3, self._velocity),
            ("seen", 1, self._seen),
            ("status", 1, self._status),
            ("position_std", 1, self._position_std),
            ("reading", 8, self._last_reading),
            ("region", 3, self._region),
        ):
            self.DeclareVectorOutputPort(name, size, calc, prerequisites_of_calc=ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )
        first_call(self._first_call, camera, config.ball_radius)

    def _first_call(self, camera: Pinhole, ball_radius: float):
        blank = np.zeros(self._shape, np.uint8)
        cv2.circle(blank, (camera.width // 2, camera.height // 2), 20, (255,) * 4, -1)
        blank[:, :, 0] //= 2
        for hue in (0.0, np.pi):
            find_ball(blank, camera, strength_weights(hue), ball_radius, 0.0)

    @timed
    def _update(self, context, discrete_state):
        c = self._config
        state = context.get_discrete_state(self._state).value()
        v, P = state[_V], state[_COVARIANCE]
        lost = state[_UNSEEN_SEC] > HOLD_SEC
        estimate: interacting_models.Estimate = self._predict(_unflat(state[_MODELS:]))
        p_next, _, P_next = interacting_models.combined(*estimate)
        image_in: Any = self._image.Eval(context)
        image = image_in.data
        measured, status = None, WRONG_IMAGE
        if image.shape == self._shape:
            status = NOT_FOUND
            z = c.table_z + c.ball_radius
            near = state[_STATUS] == TRACKED  # Otherwise search the whole image.
            guess = np.array([*p_next, z]) if near else None
            found = find_ball(
                image, self._camera, self._weights, c.ball_radius, c.table_z, guess
            )
            if found is not None:
                measured, status = self._lowered(context, found.p_WB), TRACKED
        n_outliers = 0
        if measured is None:
            n_outliers = state[_N_OUTLIERS]
        elif lost:
            estimate = self._restarted(measured)
        elif (
            constant_velocity.distance_in_sigmas(
                p_next, P_next, measured, c.position_std
            )
            <= GATE
        ):
            estimate = interacting_models.correct(*estimate, measured, c.position_std)
        elif state[_N_OUTLIERS] + 1 >= PATIENCE:
            estimate = self._restarted(measured)
        else:
            n_outliers, status = state[_N_OUTLIERS] + 1, OUTLIER
        reading = state[_READING]
        if status == TRACKED:
            unseen_sec = 0.0
            reading = np.append(context.get_time(), np.array(measured, dtype=float))
        else:
            # The position is held while its variance grows.
            unseen_sec = min(state[_UNSEEN_SEC] + c.period_sec, 2.0 * HOLD_SEC)
            v = v if unseen_sec <= HOLD_SEC else np.zeros(2)
            P = P_next if P_next[0] < 1.0 else P
            estimate = interacting_models.start(state[_P], v, P, len(self._densities))
        p, v, P = interacting_models.combined(*estimate)
        state = np.concatenate(
            [p, v, P, [unseen_sec, n_outliers, status], reading, _flat(estimate)]
        )
        if np.isfinite(state).all():
            discrete_state.set_value(self._state, state)

    def _lowered(self, context, p_WB):
        """x, y (2,) of the centre that is seen at p_WB (3,), corrected along its ray
        for a ball that is smaller than its model and so lies lower."""
        error = 0.0
        if self._radius_error.HasValue(context):
            error = float(self._radius_error.Eval(context)[0])
        if not abs(error) < self._config.ball_radius:  # Too large, or not finite.
            error = 0.0
        p_WC = self._camera.p_WC
        return p_WC[:2] + (p_WB - p_WC)[:2] * (1.0 + error / (p_WC[2] - p_WB[2]))

    def _predict(self, estimate: interacting_models.Estimate):
        return interacting_models.predict(
            *estimate, self._chances, self._config.period_sec, self._densities
        )

    def _restarted(self, measured):
        P = np.array([self._config.position_std**2, 0.0, START_SPEED**2])
        return interacting_models.start(measured, np.zeros(2), P, len(self._densities))

    def _get(self, context):
        return context.get_discrete_state(self._state).value()

    def _position(self, context, output):
        z = self._config.table_z + self._config.ball_radius
        output.SetFromVector([*self._get(context)[_P], z])

    def _velocity(self, context, output):
        output.SetFromVector([*self._get(context)[_V], 0.0])

    def _seen(self, context, output):
        output.SetAtIndex(0, float(self._get(context)[_STATUS] == TRACKED))

    def _status(self, context, output):
        output.SetAtIndex(0, self._get(context)[_STATUS])

    def _position_std(self, context, output):
        output.SetAtIndex(0, np.sqrt(self._get(context)[_COVARIANCE][0]))

    def _last_reading(self, context, output):
        z = self._config.table_z + self._config.ball_radius
        output.SetFromVector([*self._get(context)[_READING], z, 1.0, 0.0, 0.0, 0.0])

    def _region(self, context, output):
        state, c = self._get(context), self._config
        p_next, _, _ = interacting_models.combined(
            *self._predict(_unflat(state[_MODELS:]))
        )
        p_C = self._camera.to_camera([*p_next, c.table_z + c.ball_radius])
        if state[_STATUS] != TRACKED or not p_C[2] > 0.0:
            output.SetFromVector(np.full(3, np.nan))
            return
        center = self._camera.project(p_C[None])[0]
        half = search_half_px(self._camera.focal * c.ball_radius / p_C[2])
        output.SetFromVector([*center, half])


def _flat(estimate):
    """An estimate of interacting_models as one vector."""
    return np.concatenate([part.ravel() for part in estimate])


def _unflat(numbers):
    m = len(numbers) // _PER_MODEL
    return (
        numbers[: 4 * m].reshape(m, 4),
        numbers[4 * m : 7 * m].reshape(m, 3),
        numbers[7 * m :],
    )

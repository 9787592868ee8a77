"""The pose of an object from a motion capture system: delayed, noisy, filtered."""

from dataclasses import dataclass, field
from operator import attrgetter

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem

from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed
from makebreak.systems.perception.numerics import interacting_models
from makebreak.systems.perception.numerics.pose_filter import (
    PoseEstimate,
    corrected,
    first_pose,
    on_the_table,
    predicted,
    turned,
)


@dataclass
class ObjectMotionConfig:
    """How the object may move, in the filter; one that rolls, in two ways."""

    # Spectral densities of the white acceleration: of the position [m2/s3], of the
    # orientation [rad2/s3].
    density: list[float] = field(default_factory=lambda: [0.02, 2.0])
    # The same of the position of an object that rolls freely
    # (numerics/interacting_models.py) [m2/s3].
    free_density: float = 1e-5
    # Mean time for which an object rolls freely until it is driven [s].
    free_sec: float = 2.0
    driven_sec: float = 0.3  # Mean time for which a rolling object is driven [s].


@dataclass
class PoseSensorConfig:
    """Settings of PoseSensor: noise, delay, rate, and the object's motion."""

    # Standard deviations of the measured position [m] and orientation [rad], each axis.
    noise: list[float] = field(default_factory=lambda: [1e-3, 1e-2])
    # Delay of a reading from its measurement to its arrival [s].
    delay_sec: float = 1.0 / 30.0
    period_sec: float = 1.0 / 30.0  # Period of the readings [s].
    motion: ObjectMotionConfig = field(default_factory=ObjectMotionConfig)
    # Height of the object's origin in the model [m]; the diagram sets it.
    height: float = 0.02
    # Axis in the object's frame about which it rolls; empty: it lies flat. The diagram
    # sets it.
    rolling_axis: list[float] = field(default_factory=list)
    offset_sec: float = 0.0  # Time of the first reading [s]; the diagram sets it.


@dataclass(frozen=True, eq=False)
class _Memory:
    """One value, that Drake's copies of the state share; in tuples of arrays they would
    copy each array."""

    late: tuple = ()  # Readings that have not arrived yet, oldest first.
    known: tuple | None = None  # The last one that has.
    pose: PoseEstimate | None = None  # The filter's at the last of them.
    # Of a rolling object.
    rolling: interacting_models.Estimate | tuple[()] = ()

    def __deepcopy__(self, memo):
        return self  # Nothing in it is changed once it is there.


class PoseSensor(LeafSystem):
    """Measures a body's pose and estimates its present pose and velocity.

    A reading is taken at the start of each period, arrives delay_sec later, and has
    Gaussian noise about each axis. The filter's pose is predicted to the present time
    and laid on the table (numerics/pose_filter.py). A rolling object keeps its speed
    while nothing drives it, which makes its velocity five times more accurate.

    Inputs:  body_poses (abstract) of a MultibodyPlant.
    Outputs: p_WB (3,) [m]; q_WB (4,) [w x y z]; v_WB (3,) [m/s]; w_WB (3,) [rad/s];
             seen (1,): 1 after the first reading; reading (8,): the last one that has
             arrived, as measured: time [s], p (3,), q (4,); time -1 before the first.

    Args: config; body: its index in body_poses; seed: of the noise.
    Raises: ValueError for a setting out of range.
    """

    def __init__(self, config: PoseSensorConfig, body: int, seed: int = 0):
        super().__init__()
        check_settings(config)
        for name in ("noise", "motion.density"):
            values = attrgetter(name)(config)
            if len(values) != 2 or not all(v >= 0.0 for v in values):
                raise ValueError(
                    f"pose.{name} is {values}, expected two numbers of at least 0"
                )
        if not (config.delay_sec >= 0.0 and config.period_sec > 0.0):
            raise ValueError(
                f"pose: delay_sec is {config.delay_sec} and period_sec "
                f"{config.period_sec}, expected at least 0 and more than 0"
            )
        self._config, self._body, self._seed = config, int(body), int(seed)
        motion = config.motion
        for name in ("free_density", "free_sec", "driven_sec"):
            value = getattr(motion, name)
            if not 0.0 < value < np.inf:
                raise ValueError(f"pose.motion.{name} is {value}, expected > 0")
        self._axis = np.array(config.rolling_axis or [0.0, 0.0, 0.0], dtype=float)
        self._densities = np.array([motion.free_density, motion.density[0]])
        self._chances = interacting_models.transition(
            [motion.free_sec, motion.driven_sec], config.period_sec
        )
        zero = np.zeros(3)
        self._unknown = zero, zero, np.array([1.0, 0.0, 0.0, 0.0]), zero
        first_call(on_the_table, 0.0, *self._unknown, config.height, self._axis)
        self._poses = self.DeclareAbstractInputPort(
            "body_poses", AbstractValue.Make([RigidTransform()])
        )
        self._memory = self.DeclareAbstractState(Value[object](_Memory()))
        read = {self.abstract_state_ticket(self._memory)}
        for i, (name, size) in enumerate(
            (("p_WB", 3), ("v_WB", 3), ("q_WB", 4), ("w_WB", 3))
        ):
            now = read | {self.time_ticket()}
            self.DeclareVectorOutputPort(name, size, self._calc(i), now)
        self.DeclareVectorOutputPort("seen", 1, self._calc_seen, read)
        self.DeclareVectorOutputPort("reading", 8, self._calc_reading, read)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context, state):
        c, t = self._config, context.get_time()
        X_WB = self._poses.Eval(context)[self._body]
        sample = round(t / c.period_sec)
        noise = np.random.default_rng([self._seed, sample]).normal(size=6)
        q = X_WB.rotation().ToQuaternion().wxyz()
        reading = (
            t,
            X_WB.translation() + c.noise[0] * noise[:3],
            turned(np.array(q), c.noise[1] * noise[3:]),
        )
        memory = self._memory_of(context)
        late, known = (*memory.late, reading), memory.known
        pose, rolling = memory.pose, memory.rolling
        std = np.maximum(c.noise, 1e-6)  # The filter divides by it.
        while late and late[0][0] <= t - c.delay_sec + 1e-9:
            known, late = late[0], late[1:]
            at, p, q = known
            if pose is None:
                pose = first_pose(at, p, q, std, (0.1, 1.0))
            else:
                pose = corrected(predicted(pose, at, c.motion.density), p, q, std)
            if c.rolling_axis:
                rolling = self._corrected_rolling(rolling, p[:2], std[0])
                (x, y), v, _ = interacting_models.combined(*rolling)
                pose = pose._replace(
                    p=np.array([x, y, pose.p[2]]), v=np.array([*v, 0.0])
                )
        memory = _Memory(late, known, pose, rolling)
        state.get_mutable_abstract_state(int(self._memory)).set_value(memory)

    def _corrected_rolling(
        self, rolling: interacting_models.Estimate | tuple[()], measured, std
    ) -> interacting_models.Estimate:
        """The estimate of a rolling object, predicted by a period and corrected with a
        measurement (2,) [m]; a new one if there was none."""
        if not rolling:
            P = np.array([std**2, 0.0, 0.1**2])
            return interacting_models.start(measured, np.zeros(2), P, 2)
        means, covariances, chances = interacting_models.predict(
            *rolling, self._chances, self._config.period_sec, self._densities
        )
        return interacting_models.correct(means, covariances, chances, measured, std)

    def _memory_of(self, context) -> _Memory:
        return context.get_abstract_state(int(self._memory)).get_value()

    def _calc(self, i):
        def calc(context, output):
            pose = self._memory_of(context).pose
            if pose is None:
                output.SetFromVector(self._unknown[i])
                return
            dt = max(context.get_time() - pose.t, 0.0)
            now = on_the_table(
                dt, pose.p, pose.v, pose.q, pose.w, self._config.height, self._axis
            )
            output.SetFromVector(now[i])

        return calc

    def _calc_reading(self, context, output):
        none = -1.0, np.zeros(3), [1.0, 0.0, 0.0, 0.0]
        t, p, q = self._memory_of(context).known or none
        output.SetFromVector([t, *p, *q])

    def _calc_seen(self, context, output):
        output.SetFromVector([float(self._memory_of(context).pose is not None)])

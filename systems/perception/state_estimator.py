"""State and input of the LCS from sensors (numerics/state_estimator.py)."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from pydrake.systems.framework import LeafSystem

from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.serial_chain import SerialChain
from makebreak.systems.arm.numerics.tip_state import tip_pose
from makebreak.systems.contact_mpc.numerics.ball_state import pack
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed
from makebreak.systems.perception.numerics.state_estimator import estimate


@dataclass
class StateEstimatorConfig:
    """Settings of StateEstimator."""

    ball_radius: float = 0.0315  # Of the model [m].
    tip_mass: float = 1.0  # Of the tip in the LCS [kg].
    window_sec: float = 0.05  # Over which the force is averaged: the learner's period.
    period_sec: float = 0.0125 / 3.0  # Divides the periods of C3 and of the learner.
    force_bandwidth: float = 60.0  # Of the tip force observer [1/s].
    offset_sec: float = 0.0


class StateEstimator(LeafSystem):
    """State and input of the LCS from joint sensors and an object's tracker.

    In the LCS the arm is a point with a mass; u_measured is the force on this point
    that explains the tip's motion (numerics/state_estimator.py), averaged over the
    window, as the residual learner needs it. It makes of a contact force the one that
    would push the point so. Who learns masses and friction needs the real one, and
    takes u_with_force.

    Inputs:  q (7,) [rad], v (7,) [rad/s], torque (7,): of the motors [N m]; p_ball (3,)
             [m], v_ball (3,) [m/s], seen (1,): of a tracker; optional, both for an
             object of known orientation: q_object (4,) [w x y z], w_object (3,)
             [rad/s]. Without them the object is a rolling ball.
    Outputs: x (19,) of contact_mpc/numerics/ball_state.py; u_measured (3,) [N];
             valid (1,): 1 if all readings but torque are finite and the object is seen,
             0 if it is not seen, -1 if one is not finite; window_valid (1,): 1 if valid
             was 1 and torque finite during the whole window; tip_force (3,) [N]:
             estimated contact force on the tip, from joint torques and velocities;
             u_with_force (3,) [N]: the input that explains the tip's motion beside the
             contact force on the real tip, averaged over the window, and
             u_with_force_now (3,), over the last period; not a number where a reading
             was missing.

    x, u_measured and tip_force are held while a reading is not finite. While torque
    alone is not, x goes on, and only the forces are held.
    """

    def __init__(self, config: StateEstimatorConfig, chain: SerialChain, q_default):
        """Args: chain: model of the arm with its tool; q_default (n,) [rad]: gives x
        before the first reading.

        Raises: ValueError for a setting out of range.
        """
        super().__init__()
        check_settings(config)
        if not config.ball_radius > 0.0 or not config.tip_mass > 0.0:
            raise ValueError(
                "ball_radius and tip_mass must be positive, got "
                f"{config.ball_radius}, {config.tip_mass}"
            )
        self._numbers = tuple(
            float(number)
            for number in (
                config.tip_mass,
                config.ball_radius,
                config.force_bandwidth,
                config.period_sec,
            )
        )
        self._chain = packed(chain)
        n = len(chain.mass)
        self.q_default = q_default = np.array(q_default, dtype=float)
        p_tip = tip_pose(self._chain, q_default)[:3]
        n_window = max(1, round(config.window_sec / config.period_sec))
        self._readings = [
            self.DeclareVectorInputPort(name, size)
            for name, size in (
                ("q", n),
                ("v", n),
                ("torque", n),
                ("p_ball", 3),
                ("v_ball", 3),
                ("seen", 1),
            )
        ]
        self._pose = [
            self.DeclareVectorInputPort(name, size)
            for name, size in (("q_object", 4), ("w_object", 3))
        ]
        self._no_pose = [np.zeros(0), np.zeros(0)]
        x0 = pack(p_tip, np.zeros(3), [0, 0, config.ball_radius], np.zeros(3), 1.0)
        self._x = self.DeclareDiscreteState(x0)
        # The forces of the window, and the number of valid readings in a row. At the
        # start all readings count as valid.
        self._window = self.DeclareDiscreteState(
            np.append(np.zeros(3 * n_window), n_window)
        )
        self._valid = self.DeclareDiscreteState(1)
        self._observer = self.DeclareDiscreteState(7)
        self._with_force = self.DeclareDiscreteState(3 * n_window)
        # What `estimate` takes and returns, in its order.
        self._states = [self._x, self._window, self._observer, self._with_force]
        self.DeclareStateOutputPort("x", self._x)
        self.DeclareVectorOutputPort(
            "u_measured",
            3,
            self._mean_force,
            prerequisites_of_calc={self.discrete_state_ticket(self._window)},
        )
        self._n_window = n_window
        self.DeclareVectorOutputPort(
            "tip_force",
            3,
            self._tip_force,
            prerequisites_of_calc={self.discrete_state_ticket(self._observer)},
        )
        ticket = {self.discrete_state_ticket(self._with_force)}
        for name, last in (("u_with_force", n_window), ("u_with_force_now", 1)):
            self.DeclareVectorOutputPort(
                name, 3, partial(self._mean_with_force, last), ticket
            )
        self.DeclareStateOutputPort("valid", self._valid)
        self.DeclareVectorOutputPort(
            "window_valid",
            1,
            self._all_valid,
            prerequisites_of_calc={self.discrete_state_ticket(self._window)},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )
        first_call(self._first_call)

    def _first_call(self):
        readings = [np.zeros(port.size()) for port in self._readings]
        states = [np.zeros(n) for n in (19, 3 * self._n_window + 1, 7)]
        states.append(np.zeros(3 * self._n_window))
        for state in states:
            state.setflags(write=False)  # As a Context's state is.
        estimate(self._chain, *readings, *self._no_pose, *self._numbers, *states)

    def _mean_force(self, context, output):
        window = context.get_discrete_state(self._window).value()
        output.SetFromVector(window[:-1].reshape(-1, 3).mean(axis=0))

    def _mean_with_force(self, last, context, output):
        window = context.get_discrete_state(self._with_force).value()
        output.SetFromVector(window.reshape(-1, 3)[-last:].mean(axis=0))

    def _tip_force(self, context, output):
        output.SetFromVector(context.get_discrete_state(self._observer).value()[3:6])

    def _all_valid(self, context, output):
        n_valid = context.get_discrete_state(self._window).value()[-1]
        output.SetFromVector([1.0 if n_valid >= self._n_window else 0.0])

    def start_at(self, context) -> None:
        """Resets the state in a Context of this system: the window is valid again only
        after window_sec."""
        window = np.zeros(3 * self._n_window + 1)
        context.SetDiscreteState(self._window, window)
        context.SetDiscreteState(self._observer, np.zeros(7))
        context.SetDiscreteState(self._with_force, np.zeros(window.size - 1))

    @timed
    def _update(self, context, discrete_state):
        pose = self._no_pose
        if all(port.HasValue(context) for port in self._pose):
            pose = [port.Eval(context) for port in self._pose]
        *states, valid = estimate(
            self._chain,
            *[port.Eval(context) for port in self._readings],
            *pose,
            *self._numbers,
            *[context.get_discrete_state(state).value() for state in self._states],
        )
        for state, value in zip(self._states, states, strict=True):
            discrete_state.set_value(state, value)
        discrete_state.set_value(self._valid, [valid])

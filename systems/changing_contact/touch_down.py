"""How fast a tip may touch an object, as a system: see numerics/touch_down.py."""

from dataclasses import is_dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from makebreak.systems.changing_contact.numerics.touch_down import (
    TouchDownConfig,
    allowed_speed,
    first_state,
    next_touch,
)
from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    P_TIP,
    Q_BALL,
    V_TIP,
)
from makebreak.systems.contact_mpc.numerics.contact_sampling import ObjectShape
from makebreak.systems.contact_mpc.numerics.lcs import is_finite
from makebreak.systems.contact_mpc.numerics.object_frame import rotation_of
from makebreak.systems.contact_mpc.numerics.outline import (
    distance_to_outline,
    outline_of,
)
from makebreak.systems.contact_mpc.numerics.push_task import CONTACT
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


class TouchDown(LeafSystem):
    """The second paper's gentle touch, for a tip that pushes an object.

    Inputs:  x (19,) of numerics/ball_state.py; valid (1,): above 0.5 where it can be
             trusted; phase (1,) of PushTask; tip_force (3,) on the tip [N].
    Outputs: touch_speed (1,) [m/s], for ArmReference: how fast the tip may go as long
             as it feels nothing; belief (2,): mean and standard deviation of the
             distance to the object's side at which a touch is felt [m].

    Where an input is not finite all stays as it is; of an object that is not seen
    nothing is learned.

    Args: config; shape of the object and the tip; period_sec, offset_sec.
    Raises: ValueError for a setting out of range, by name.
    """

    def __init__(
        self,
        config: TouchDownConfig,
        shape: ObjectShape,
        period_sec: float,
        offset_sec: float = 0.0,
    ):
        super().__init__()
        check_settings(config, "touch")
        _check(config)
        self._config, self._shape, self._dt = config, shape, period_sec
        self._x = self.DeclareVectorInputPort("x", N_X)
        self._valid = self.DeclareVectorInputPort("valid", 1)
        self._phase = self.DeclareVectorInputPort("phase", 1)
        self._tip_force = self.DeclareVectorInputPort("tip_force", 3)
        self._touch = self.DeclareAbstractState(Value[object](first_state(config)))
        self._speed = self.DeclareDiscreteState([config.speed.first])
        self._belief = self.DeclareDiscreteState([0.0, config.place.std_first])
        self.DeclareStateOutputPort("touch_speed", self._speed)
        self.DeclareStateOutputPort("belief", self._belief)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            period_sec, offset_sec, self._update
        )

    @timed
    def _update(self, context, state):
        x, valid, phase, force = (
            np.asarray(port.Eval(context))
            for port in (self._x, self._valid, self._phase, self._tip_force)
        )
        if not (is_finite(x) and is_finite(force)):
            return
        try:
            outline = outline_of(self._shape.parts, rotation_of(x[Q_BALL]), x[P_BALL])
        except ValueError:  # An object on edge has no outline.
            return
        distance = distance_to_outline(x[P_TIP][None, :2], outline)[0]
        distance = float(distance) - self._shape.tip_radius
        touch = next_touch(
            self._config,
            context.get_abstract_state(int(self._touch)).get_value(),
            self._dt,
            distance,
            float(np.linalg.norm(x[V_TIP])),
            float(np.linalg.norm(force)),
            phase[0] == CONTACT and valid[0] > 0.5,
        )
        state.get_mutable_abstract_state(int(self._touch)).set_value(touch)
        discrete = state.get_mutable_discrete_state()
        discrete.set_value(
            int(self._speed), [allowed_speed(self._config, touch, distance)]
        )
        discrete.set_value(int(self._belief), [touch.mean, np.sqrt(touch.variance)])


def _check(config: TouchDownConfig) -> None:
    speed = config.speed
    for within, part in (
        ("touch", config), ("touch.speed", speed), ("touch.place", config.place)
    ):  # fmt: skip
        for name, value in vars(part).items():
            if not is_dataclass(value) and not 0.0 < value < np.inf:
                raise ValueError(f"{within}.{name} is {value}, expected > 0")
    if not speed.least <= speed.first <= speed.most:
        raise ValueError(
            f"touch.speed.first is {speed.first}, expected between touch.speed.least "
            f"{speed.least} and touch.speed.most {speed.most}"
        )
    if speed.growth < 1.0:
        raise ValueError(f"touch.speed.growth is {speed.growth}, expected at least 1")

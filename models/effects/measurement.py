"""Effects on the measurement, not on the motion.

    measured(t) = scale true((t - delay) / (1 + skew)) + bias

A sensor_lag is a first-order low-pass of the true value: T dy/dt = true - y. An offset
is in a joint's encoder, so that the drive of a position-controlled joint sees it as
well. All others are in the recorded channel alone.
"""

from dataclasses import dataclass, replace

import numpy as np

from makebreak.models.effects.kind import Effect, EffectKind, Parameter
from makebreak.models.effects.measured_channels import acts_on
from makebreak.models.effects.signature import Signature, without_momentum


@dataclass
class _Error:
    """Derivative of the measured motion by the coefficient, (n, n_v) each; that of the
    positions as a velocity times 1 s."""

    q: np.ndarray
    v: np.ndarray
    vd: np.ndarray
    effort: np.ndarray


def _signature(step: str, unknown: str, to_parameters):
    """The signature of a measurement error, to first order.

    The residual r = effort - ID(measured motion) changes by
    error of effort - dID/d(q, v, vd) error of (q, v, vd). A channel `position` gives
    q, `velocity` gives v and, by differences, vd.
    """

    def signature(effect: Effect, model, motion, grid=None) -> list[Signature]:
        error = _Error(*(np.zeros_like(motion.v) for _ in range(4)))
        jerk = motion.jerk
        if jerk is None and len(motion.time) > 1:
            jerk = np.gradient(motion.vd, motion.time, axis=0)
        elif jerk is None:
            jerk = np.zeros_like(motion.vd)
        channels: dict[str, np.ndarray] = {}
        for channel in model.channels():
            if not acts_on(effect, step, channel):
                continue
            what, i = model.coordinates(channel)
            if what == "q":
                value, rate = model.value(motion, channel), motion.v[:, i]
            elif what == "v":
                value, rate = motion.v[:, i], motion.vd[:, i]
            else:
                value = motion.effort[:, i]
                rate = np.gradient(value, motion.time) if len(value) > 1 else 0 * value
            add = _derivative(step, motion.time, value, rate)
            channels[channel] = add[:, None]
            getattr(error, what)[:, i] = add
            if what == "v" and step in ("delay", "skew", "scale", "lag"):
                error.vd[:, i] = _derivative(
                    step, motion.time, motion.vd[:, i], jerk[:, i]
                )
        columns = _through_dynamics(model, motion, error)
        found = without_momentum(
            effect,
            [unknown],
            columns,
            to_parameters=to_parameters,
            exact=False,
            channels=channels,
        )
        if not error.v.any() and not error.vd.any() and step in ("offset", "bias"):

            def weak():
                momentum = -_difference(
                    model, motion, error, lambda q, v, t: model.momentum(q, v)
                )
                rest = error.effort[:, :, None] - _difference(
                    model, motion, error, model.rest
                )
                return momentum, rest

            return [replace(found, weak=weak)]
        return [found]

    return signature


def _derivative(step, time, value, rate):
    if step in ("offset", "bias"):
        return np.ones_like(value)
    if step in ("delay", "lag"):  # To first order a lag is a delay.
        return -rate
    if step == "skew":
        return -time * rate
    return value


def _step(*errors) -> float:
    """A step for central differences with a relative error of about 1e-8."""
    greatest = max(abs(error).max(initial=0.0) for error in errors)
    return 1e-4 / max(greatest, 1e-3)


def _through_dynamics(model, motion, error) -> np.ndarray:
    h = _step(error.q, error.v, error.vd)

    def ID(s):
        q = model.shifted(motion.q, error.q, s)
        v, vd = motion.v + s * error.v, motion.vd + s * error.vd
        return model.inverse_dynamics(q, v, vd, motion.time)

    columns = error.effort - (ID(h) - ID(-h)) / (2.0 * h)
    return columns[:, :, None]


def _difference(model, motion, error, function) -> np.ndarray:
    h = _step(error.q)
    after, before = (
        function(model.shifted(motion.q, error.q, s), motion.v, motion.time)
        for s in (h, -h)
    )
    return ((after - before) / (2.0 * h))[:, :, None]


KINDS = {
    "joint_offset": EffectKind(
        at="joint",
        parameters=(Parameter("offset", "rad", -0.2, 0.2),),
        says="the measured position of {at} is {offset} more than the true one",
        says_less="the measured position of {at} is {offset} less than the true one",
        confused_with=("gravity_tilt", "object_com"),
        tell_apart="measure the end's position, or move the joint through its range",
        channel="offset",
        signature=_signature("offset", "offset", lambda c: {"offset": float(c[0])}),
    ),
    "sensor_delay": EffectKind(
        at="channel",
        parameters=(Parameter("delay", "s", 0.0, 0.1, valid=">= 0"),),
        says="{at} is measured {delay} late",
        confused_with=("input_delay", "actuator_lag", "clock_skew", "sensor_lag"),
        tell_apart="record when commands are received, or a second channel of the same "
        "motion",
        channel="delay",
        signature=_signature("delay", "delay", lambda c: {"delay": float(c[0])}),
    ),
    "sensor_lag": EffectKind(
        at="channel",
        # Negative: a shorter lag than the recording's sidecar declares.
        parameters=(Parameter("time_constant", "s", -0.05, 0.2),),
        says="{at} is low-passed, first order, with a time constant of {time_constant} "
        "beyond what is declared",
        says_less="the filter of {at} has a time constant {time_constant} shorter than "
        "is declared",
        confused_with=("sensor_delay",),
        tell_apart="move faster: near 1/(2 pi time constant) a low-pass makes swings "
        "smaller, a delay does not",
        channel="lag",
        signature=_signature(
            "lag", "time_constant", lambda c: {"time_constant": float(c[0])}
        ),
    ),
    "clock_skew": EffectKind(
        at="channel",
        parameters=(Parameter("skew", "s/s", -0.05, 0.05),),
        says="the clock of {at} runs fast by {skew}",
        says_less="the clock of {at} runs slow by {skew}",
        confused_with=("sensor_delay",),
        tell_apart="record for longer: a skew grows with time, a delay stays",
        channel="skew",
        signature=_signature("skew", "skew", lambda c: {"skew": float(c[0])}),
    ),
    "sensor_bias": EffectKind(
        at="channel",
        parameters=(Parameter("bias", "(unit of the channel)", -20.0, 20.0),),
        says="{at} is measured {bias} too high",
        says_less="{at} is measured {bias} too low",
        confused_with=("actuator_bias", "joint_offset"),
        tell_apart="compare with a channel of the same motion: integral of velocity "
        "with position, effort with command",
        channel="bias",
        signature=_signature("bias", "bias", lambda c: {"bias": float(c[0])}),
    ),
    "length_scale": EffectKind(
        at="length",
        parameters=(Parameter("scale", "", 0.9, 1.1, 1.0, valid="> 0"),),
        says="lengths of {at} are measured {scale} times their true size",
        confused_with=("object_size", "plane_height", "clock_skew"),
        tell_apart="measure a known length, or a second object with the same cameras",
        channel="scale",
        signature=_signature(
            "scale", "scale_minus_1", lambda c: {"scale": 1.0 + float(c[0])}
        ),
    ),
}

"""Effects between a command and the torque on the joint, outside of the plant:
load_scene adds them in front of its actuation port (actuation_path.py)."""

import numpy as np

from makebreak.models.effects.kind import EffectKind, Parameter, find_joints
from makebreak.models.effects.signature import (
    Signature,
    at_joints,
    filtered,
    lagged,
    without_momentum,
)

# For these kinds the residual has to use the commanded effort: r = commanded - applied.
DELAYS = (0.002, 0.005, 0.01, 0.02, 0.04)  # [s]
LIMITS = (0.3, 0.5, 0.7, 0.85, 0.95)  # Over the largest effort.


def _gain_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)
    return [
        at_joints(
            effect,
            ["gain_minus_1"],
            motion,
            joints,
            [lambda q, v, u: -u],
            to_parameters=lambda c: {"gain": 1.0 + float(c[0])},
        )
    ]


def _bias_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)
    entries = [lambda q, v, u: -np.ones_like(u)]
    return [at_joints(effect, ["bias"], motion, joints, entries)]


def _saturation_signature(effect, model, motion, grid=None) -> list[Signature]:
    """Each alternative holds a limit; its coefficient is 1 for the right limit."""
    joints = find_joints(effect, model.plant)
    greatest = max(abs(motion.effort[:, j.velocity_start()]).max() for j in joints)
    limits = (grid or {}).get("limit", [part * greatest for part in LIMITS])
    return [
        at_joints(
            effect,
            ["share"],
            motion,
            joints,
            [lambda q, v, u, limit=limit: u - np.clip(u, -limit, limit)],
            {"limit": float(limit)},
            lambda c, limit=limit: {"limit": float(limit)},
            exact=False,
        )
        for limit in limits
        if limit > 0.0
    ]


def _limits_to_try(effect, plant, motions) -> dict[str, list[float]]:
    """Fractions of the largest effort; and quantiles, as a controller whose joint does
    not follow commands far more than the limit."""
    i = find_joints(effect, plant)[0].velocity_start()
    u = np.concatenate([np.abs(m.effort[:, i]) for m in motions])
    often = np.quantile(u, np.linspace(0.3, 0.98, 14))
    return {"limit": [*(np.linspace(0.4, 0.97, 15) * u.max()), *often]}


def _shifted(effect, model, motion, name, values, late) -> list[Signature]:
    """Alternatives for values of a delay or lag: columns (u - late(u, value)) / value,
    so that the coefficient is the value."""
    found = []
    for value in values:
        columns = np.zeros((*motion.v.shape, 1))
        for joint in find_joints(effect, model.plant):
            u = motion.effort[:, joint.velocity_start()]
            columns[:, joint.velocity_start(), 0] = (u - late(u, value)) / value
        found.append(without_momentum(effect, [name], columns, exact=False))
    return found


def _delay_signature(effect, model, motion, grid=None) -> list[Signature]:
    values = (grid or {}).get("delay", DELAYS)
    return _shifted(
        effect, model, motion, "delay", values, lambda u, d: lagged(motion.time, u, d)
    )


def _lag_signature(effect, model, motion, grid=None) -> list[Signature]:
    values = (grid or {}).get("time_constant", DELAYS)
    return _shifted(
        effect,
        model,
        motion,
        "time_constant",
        values,
        lambda u, T: filtered(motion.time, u, T),
    )


def _kp_signature(effect, model, motion, grid=None) -> list[Signature]:
    """For a drive below its limit and at low speed, where the effort is proportional to
    the gain. (gap uses the drive's law itself.)"""
    joints = find_joints(effect, model.plant)
    kp = model.now(effect.kind, effect.at)["kp"]
    return [
        at_joints(
            effect,
            ["kp_change"],
            motion,
            joints,
            [lambda q, v, u: -u / kp],
            to_parameters=lambda c: {"kp": kp + float(c[0])},
            exact=False,
        )
    ]


KINDS = {
    "actuator_gain": EffectKind(
        at="actuator",
        parameters=(Parameter("gain", "", 0.5, 1.5, 1.0),),
        says="{at} gives {gain} times the torque that it is commanded",
        confused_with=("payload", "rotor_inertia", "actuator_saturation"),
        tell_apart="repeat the motion with a known mass attached",
        path="gain",
        signature=_gain_signature,
    ),
    "actuator_bias": EffectKind(
        at="actuator",
        parameters=(Parameter("bias", "N m", -1.0, 1.0, of_size=True),),
        says="{at} adds a constant {bias} to the torque that it is commanded",
        says_less="{at} takes a constant {bias} away from the torque that it is "
        "commanded",
        confused_with=("joint_coulomb_friction", "gravity_tilt", "constant_force"),
        tell_apart="move the joint both ways, and in several poses",
        path="bias",
        signature=_bias_signature,
    ),
    "actuator_saturation": EffectKind(
        at="actuator",
        parameters=(
            Parameter("limit", "N m", 0.0, 4.0, None, valid="> 0", of_size=True),
        ),
        says="{at} gives no more than {limit}",
        confused_with=("actuator_gain", "input_delay"),
        tries=_limits_to_try,
        tell_apart="command less than the limit, and slowly more",
        path="saturation",
        now=lambda effect, plant, scene_graph: {"limit": 1e30},
        signature=_saturation_signature,
    ),
    "input_delay": EffectKind(
        at="actuator",
        parameters=(Parameter("delay", "s", 0.0, 0.1, valid=">= 0"),),
        says="commands reach {at} {delay} late",
        exported="delay",
        confused_with=("sensor_delay", "actuator_lag", "joint_viscous_damping"),
        tell_apart="excite above 1/(2 pi delay), and record when commands are received",
        path="delay",
        signature=_delay_signature,
    ),
    "actuator_lag": EffectKind(
        at="actuator",
        parameters=(Parameter("time_constant", "s", 0.0, 0.2, valid=">= 0"),),
        says="the torque of {at} follows its command with a lag of {time_constant}",
        confused_with=("input_delay", "sensor_delay"),
        tell_apart="excite above 1/(2 pi time constant): a lag weakens what a delay "
        "only shifts",
        path="lag",
        signature=_lag_signature,
    ),
    "servo_gain": EffectKind(
        at="drive",
        parameters=(
            Parameter("kp", "N m/rad", 0.0, 200.0, None, valid="> 0", of_size=True),
        ),
        says="the drive of {at} pulls towards its command with {kp}",
        confused_with=("actuator_gain", "payload", "joint_elasticity", "joint_spring"),
        exported="kp",
        tell_apart="hold known loads: the error of position is load over gain, "
        "and measure the torque",
        path="kp",
        drive="kp",
        signature=_kp_signature,
    ),
}

"""Effects that are forces on a body: constant, sinusoidal, drags."""

import math

import numpy as np

from makebreak.models.effects.kind import (
    Effect,
    EffectKind,
    Parameter,
    find_bodies,
)
from makebreak.models.effects.signature import Signature, without_momentum
from makebreak.systems.numerics.body_laws import (
    constant_law,
    drag_law,
    quadratic_drag_law,
    sinusoidal_law,
)

AXES = ("fx", "fy", "fz")
FREQUENCIES = tuple(np.round(np.geomspace(0.1, 20.0, 60), 4))  # [Hz]


def _numbers(*names):
    return lambda effect: [effect.parameters[name] for name in names]


def _jacobians(effect: Effect, model, motion):
    """Jacobian (n, 6, n_v) and velocity (n, 6) of each body of `at`."""
    for body in find_bodies(effect, model.plant):
        J, V, _, _ = model.body_motion(body, motion.q, motion.v, motion.vd)
        yield J, V


def _constant_signature(effect, model, motion, grid=None) -> list[Signature]:
    columns = sum(
        -J[:, 3:].swapaxes(1, 2) for J, _ in _jacobians(effect, model, motion)
    )
    return [without_momentum(effect, AXES, columns)]


def _sinusoidal_signature(effect, model, motion, grid=None) -> list[Signature]:
    """A force along a line of free direction, with one phase. Each alternative holds a
    frequency; its coefficients are sine and cosine along each axis, and to_parameters
    takes the direction of the greatest power."""
    columns = sum(
        -J[:, 3:].swapaxes(1, 2) for J, _ in _jacobians(effect, model, motion)
    )
    found = []
    for f in (grid or {}).get("frequency", FREQUENCIES):
        angle = 2.0 * np.pi * f * motion.time[:, None, None]
        both = np.concatenate(
            [columns * np.sin(angle), columns * np.cos(angle)], axis=2
        )
        names = [f"{axis}_{part}" for part in ("sin", "cos") for axis in AXES]

        def to_parameters(c, f=f):
            # c = [a cos(phase), a sin(phase)] for the amplitude's vector a.
            a, b = np.reshape(c, (2, 3))
            u, s, w = np.linalg.svd(np.stack([a, b], axis=1))
            # Of the two equal solutions the one whose largest component is positive.
            sign = 1.0 if u[abs(u[:, 0]).argmax(), 0] >= 0.0 else -1.0
            amplitude = sign * u[:, 0] * s[0]
            phase = math.atan2(sign * w[0, 1], sign * w[0, 0])
            return {
                **{name: float(x) for name, x in zip(AXES, amplitude, strict=True)},
                "frequency": float(f),
                "phase": phase,
            }

        found.append(
            without_momentum(effect, names, both, {"frequency": f}, to_parameters)
        )
    return found


def _sinusoidal_added(effect, model, motion) -> np.ndarray:
    p = effect.parameters
    (one,) = _sinusoidal_signature(
        effect, model, motion, {"frequency": [p["frequency"]]}
    )
    force = np.array([p[axis] for axis in AXES])
    return one.columns @ np.concatenate(
        [np.cos(p["phase"]) * force, np.sin(p["phase"]) * force]
    )


def _drag_signature(effect, model, motion, grid=None) -> list[Signature]:
    columns = np.zeros((*motion.v.shape, 2))
    for J, V in _jacobians(effect, model, motion):
        columns[:, :, 0] += np.einsum("nij,ni->nj", J[:, 3:], V[:, 3:])
        columns[:, :, 1] += np.einsum("nij,ni->nj", J[:, :3], V[:, :3])
    return [without_momentum(effect, ["linear", "angular"], columns)]


def _quadratic_drag_signature(effect, model, motion, grid=None) -> list[Signature]:
    columns = np.zeros((*motion.v.shape, 1))
    for J, V in _jacobians(effect, model, motion):
        v = V[:, 3:]
        squares = np.linalg.norm(v, axis=1, keepdims=True) * v
        columns[:, :, 0] += np.einsum("nij,ni->nj", J[:, 3:], squares)
    return [without_momentum(effect, ["coefficient"], columns)]


TRIED_FREQUENCIES = list(np.arange(0.4, 5.01, 0.03))  # [Hz]

KINDS = {
    "constant_force": EffectKind(
        at="body",
        parameters=tuple(
            Parameter(axis, "N", -2.0, 2.0, of_size=True) for axis in AXES
        ),
        says="a constant force of ({fx}, {fy}, {fz}) in world pulls at {at}, which the "
        "model lacks",
        confused_with=("payload", "gravity_tilt", "actuator_bias"),
        tell_apart="turn the body into other poses and accelerate it: a payload's "
        "force changes with acceleration",
        body_law=constant_law,
        body_numbers=_numbers(*AXES),
        signature=_constant_signature,
    ),
    "sinusoidal_force": EffectKind(
        at="body",
        parameters=(
            *(Parameter(axis, "N", -2.0, 2.0, of_size=True) for axis in AXES),
            Parameter("frequency", "Hz", 0.05, 50.0, None, valid="> 0"),
            Parameter("phase", "rad", -math.pi, math.pi, None),
        ),
        says="a force of amplitude ({fx}, {fy}, {fz}) shakes {at} at {frequency} "
        "(phase {phase} at time 0), which the model lacks",
        confused_with=("torque_ripple",),
        contains=("constant_force",),
        tries=lambda effect, plant, motions: {"frequency": TRIED_FREQUENCIES},
        tell_apart="start the same motion at another time: the force stays with the "
        "clock, a ripple with the position",
        body_law=sinusoidal_law,
        body_numbers=_numbers(*AXES, "frequency", "phase"),
        signature=_sinusoidal_signature,
        added=_sinusoidal_added,
    ),
    "body_drag": EffectKind(
        at="body",
        parameters=(
            Parameter("linear", "N s/m", 0.0, 5.0, valid=">= 0", of_size=True),
            Parameter("angular", "N m s/rad", 0.0, 1.0, valid=">= 0", of_size=True),
        ),
        says="{at} is slowed by drag of {linear} and {angular} that the model lacks",
        confused_with=(
            "joint_viscous_damping",
            "joint_quadratic_drag",
            "body_quadratic_drag",
        ),
        tell_apart="move several joints at once: drag acts along the body's velocity",
        body_law=drag_law,
        body_numbers=_numbers("linear", "angular"),
        signature=_drag_signature,
        may_lack=("angular",),  # Few bodies show that turning slows them.
    ),
    "body_quadratic_drag": EffectKind(
        at="body",
        parameters=(
            Parameter("coefficient", "N s2/m2", 0.0, 5.0, valid=">= 0", of_size=True),
        ),
        says="{at} is slowed by drag that grows with the square of its speed, "
        "{coefficient}, that the model lacks",
        confused_with=("body_drag", "joint_quadratic_drag", "constant_force"),
        tell_apart="move the body at speeds that differ by a factor of three or more",
        body_law=quadratic_drag_law,
        body_numbers=_numbers("coefficient"),
        signature=_quadratic_drag_signature,
    ),
}

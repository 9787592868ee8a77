"""Effects in a joint: damping, dry friction, drag, rotor, ripple, spring."""

import math

import numba
import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint

from makebreak.models.effects.kind import (
    Effect,
    EffectKind,
    Parameter,
    actuator_of,
    find_joints,
    velocity_unit,
)
from makebreak.models.effects.signature import Signature, at_joints
from makebreak.models.effects.transmission import motor_joint

# ----- What they do


def _add_damping(effect: Effect, plant: MultibodyPlant, scene_graph) -> None:
    for joint in find_joints(effect, plant):
        joint.set_default_damping_vector(
            joint.default_damping_vector() + effect.parameters["damping"]
        )


def _change_damping(old: Effect, new: Effect, plant: MultibodyPlant, context) -> None:
    change = new.parameters["damping"] - old.parameters["damping"]
    for joint in find_joints(new, plant):
        # Not below 0 by rounding: Drake would throw.
        damping = np.maximum(joint.GetDampingVector(context) + change, 0.0)
        joint.SetDampingVector(context, damping)


def _add_rotor(effect: Effect, plant: MultibodyPlant, scene_graph) -> None:
    """On the actuator: reflected inertia = rotor inertia x gear ratio^2. A joint
    without one gets an actuator that nobody drives."""
    for joint in find_joints(effect, plant):
        actuator = actuator_of(plant, joint)
        if actuator is None:
            actuator = plant.AddJointActuator(f"{joint.name()}_rotor", joint)
        if actuator.default_gear_ratio() == 0.0:
            raise ValueError(
                f"effect rotor_inertia at {effect.at}: the gear ratio of "
                f"{actuator.name()} is 0"
            )
        added = effect.parameters["inertia"] / actuator.default_gear_ratio() ** 2
        actuator.set_default_rotor_inertia(actuator.default_rotor_inertia() + added)


def _change_rotor(old: Effect, new: Effect, plant: MultibodyPlant, context) -> None:
    change = new.parameters["inertia"] - old.parameters["inertia"]
    for joint in find_joints(new, plant):
        actuator = actuator_of(plant, motor_joint(plant, joint) or joint)
        inertia = actuator.rotor_inertia(context)
        inertia += change / actuator.gear_ratio(context) ** 2
        actuator.SetRotorInertia(context, max(inertia, 0.0))


def fade_velocity(plant: MultibodyPlant, joint: Joint, friction: float) -> float:
    """Speed below which dry friction fades, c tanh(v / fade): 0.005 rad/s or 0.001 m/s.

    In a discrete plant the force acts a step late. There it fades where one step of it
    would change the joint's speed by half the fading speed, so that it never turns the
    motion round: fade >= 2 c dt / J, with J the joint's inertia alone at the default
    positions, all other joints free (which is when it is smallest).
    """
    slowest = velocity_unit(joint)
    dt = plant.time_step()
    if dt == 0.0:
        return slowest
    context = plant.CreateDefaultContext()
    mobility = np.linalg.inv(plant.CalcMassMatrix(context))
    i = joint.velocity_start()
    return max(slowest, 2.0 * friction * dt * mobility[i, i])


def _coulomb_numbers(effect, plant, joint):
    c = effect.parameters["coulomb"]
    return [c, fade_velocity(plant, joint, c)]


def _stribeck_numbers(effect, plant, joint):
    p = effect.parameters
    fade = fade_velocity(plant, joint, max(p["coulomb"], p["static"]))
    return [p["coulomb"], p["static"], p["stribeck_velocity"], fade]


def _numbers(*names):
    return lambda effect, plant, joint: [effect.parameters[name] for name in names]


@numba.njit(cache=True)
def coulomb_law(q, v, t, p):
    return -p[0] * math.tanh(v / p[1])


@numba.njit(cache=True)
def stribeck_law(q, v, t, p):
    peak = (p[1] - p[0]) * math.exp(-((v / p[2]) ** 2))
    return -(p[0] + peak) * math.tanh(v / p[3])


@numba.njit(cache=True)
def drag_law(q, v, t, p):
    return -p[0] * v * abs(v)


@numba.njit(cache=True)
def ripple_law(q, v, t, p):
    return p[0] * math.sin(p[1] * q + p[2])


@numba.njit(cache=True)
def spring_law(q, v, t, p):
    return -p[0] * (q - p[1])


# ----- How they show: the residual is minus the effect's force.

STRIBECK_VELOCITIES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)  # [rad/s]
PERIODS = (*range(1, 31), 36, 40, 48, 50, 60, 72, 80, 90, 100)


def _damping_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)
    return [at_joints(effect, ["damping"], motion, joints, [lambda q, v, u: v])]


def _coulomb_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)
    slow = velocity_unit(joints[0])
    return [
        at_joints(
            effect, ["coulomb"], motion, joints, [lambda q, v, u: np.tanh(v / slow)]
        )
    ]


def _stribeck_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)
    slow = velocity_unit(joints[0])
    found = []
    for v_s in (grid or {}).get("stribeck_velocity", STRIBECK_VELOCITIES):
        entries = [
            lambda q, v, u, v_s=v_s: (
                (1 - np.exp(-((v / v_s) ** 2))) * np.tanh(v / slow)
            ),
            lambda q, v, u, v_s=v_s: np.exp(-((v / v_s) ** 2)) * np.tanh(v / slow),
        ]
        held = {"stribeck_velocity": v_s}
        names = ["coulomb", "static"]
        found.append(at_joints(effect, names, motion, joints, entries, held))
    return found


def _drag_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)
    entries = [lambda q, v, u: v * np.abs(v)]
    return [at_joints(effect, ["coefficient"], motion, joints, entries)]


def _rotor_signature(effect, model, motion, grid=None) -> list[Signature]:
    columns, momentum = (np.zeros((*motion.v.shape, 1)) for _ in range(2))
    for joint in find_joints(effect, model.plant):
        i = joint.velocity_start()
        columns[:, i, 0] = motion.vd[:, i]
        momentum[:, i, 0] = motion.v[:, i]
    return [
        Signature(
            effect,
            ("inertia",),
            columns,
            lambda: (momentum, np.zeros_like(columns)),
            lambda c: {"inertia": float(c[0])},
        )
    ]


def _ripple_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)
    found = []
    for N in (grid or {}).get("periods_per_rev", PERIODS):
        entries = [
            lambda q, v, u, N=N: -np.sin(N * q),
            lambda q, v, u, N=N: -np.cos(N * q),
        ]

        def to_parameters(c, N=N):
            return {
                "amplitude": float(np.hypot(*c)),
                "periods_per_rev": float(N),
                "phase": float(np.arctan2(c[1], c[0])),
            }

        found.append(
            at_joints(
                effect,
                ["amplitude_sin", "amplitude_cos"],
                motion,
                joints,
                entries,
                {"periods_per_rev": N},
                to_parameters,
            )
        )
    return found


def _spring_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)

    def to_parameters(c):
        rest = c[1] / c[0] if abs(c[0]) > 1e-12 else 0.0
        return {"stiffness": float(c[0]), "rest": float(rest)}

    return [
        at_joints(
            effect,
            ["stiffness", "stiffness_times_rest"],
            motion,
            joints,
            [lambda q, v, u: q, lambda q, v, u: -np.ones_like(q)],
            to_parameters=to_parameters,
        )
    ]


def _ripple_added(effect, model, motion) -> np.ndarray:
    p = effect.parameters
    grid = {"periods_per_rev": [p["periods_per_rev"]]}
    (one,) = _ripple_signature(effect, model, motion, grid)
    phase = np.array([np.cos(p["phase"]), np.sin(p["phase"])])
    return one.columns @ (p["amplitude"] * phase)


def _spring_added(effect, model, motion) -> np.ndarray:
    p = effect.parameters
    (one,) = _spring_signature(effect, model, motion)
    return one.columns @ (p["stiffness"] * np.array([1.0, p["rest"]]))


KINDS = {
    "joint_viscous_damping": EffectKind(
        at="joint",
        parameters=(Parameter("damping", "N m s/rad", 0.0, 50.0, valid=">= 0"),),
        says="{at} has {damping} of viscous damping that the model lacks",
        confused_with=(
            "joint_coulomb_friction",
            "joint_quadratic_drag",
            "input_delay",
            "body_drag",
        ),
        tell_apart="move the joint at speeds a decade apart, with reversals",
        before_finalize=_add_damping,
        set_in_context=_change_damping,
        signature=_damping_signature,
    ),
    "joint_coulomb_friction": EffectKind(
        at="joint",
        parameters=(Parameter("coulomb", "N m", 0.0, 50.0, valid=">= 0"),),
        says="{at} has Coulomb friction of {coulomb} that the model lacks",
        confused_with=(
            "joint_viscous_damping",
            "joint_stribeck_friction",
            "actuator_bias",
            "joint_backlash",
        ),
        tell_apart="move the joint both ways through the same positions, at two speeds",
        joint_law=coulomb_law,
        joint_numbers=_coulomb_numbers,
        signature=_coulomb_signature,
    ),
    "joint_stribeck_friction": EffectKind(
        at="joint",
        parameters=(
            Parameter("coulomb", "N m", 0.0, 50.0, valid=">= 0"),
            Parameter("static", "N m", 0.0, 100.0, valid=">= 0"),
            Parameter("stribeck_velocity", "rad/s", 0.005, 1.0, None, valid="> 0"),
        ),
        says="{at} has dry friction that the model lacks: {static} when it starts, "
        "{coulomb} well above {stribeck_velocity}",
        confused_with=("joint_coulomb_friction", "joint_viscous_damping"),
        tell_apart="reverse the joint slowly, below 0.1 rad/s, and fast as well",
        joint_law=stribeck_law,
        joint_numbers=_stribeck_numbers,
        signature=_stribeck_signature,
    ),
    "joint_quadratic_drag": EffectKind(
        at="joint",
        parameters=(Parameter("coefficient", "N m s2/rad2", 0.0, 20.0, valid=">= 0"),),
        says="{at} has drag that grows with the square of its speed, {coefficient}, "
        "that the model lacks",
        confused_with=("joint_viscous_damping", "body_drag"),
        tell_apart="move the joint at speeds that differ by a factor of three or more",
        joint_law=drag_law,
        joint_numbers=_numbers("coefficient"),
        signature=_drag_signature,
    ),
    "rotor_inertia": EffectKind(
        at="joint",
        parameters=(Parameter("inertia", "kg m2", 0.0, 2.0, valid=">= 0"),),
        says="{at} turns a rotor with {inertia} (reflected at the joint) that the "
        "model lacks",
        confused_with=("object_inertia", "payload", "actuator_gain"),
        tell_apart="move the other joints fast while this one rests, and know on which "
        "side of the gear the torque is measured",
        before_finalize=_add_rotor,
        set_in_context=_change_rotor,
        signature=_rotor_signature,
    ),
    "torque_ripple": EffectKind(
        at="joint",
        parameters=(
            Parameter("amplitude", "N m", 0.0, 10.0),
            Parameter("periods_per_rev", "periods a turn", 1.0, 100.0, None),
            Parameter("phase", "rad", -math.pi, math.pi, None),
        ),
        says="{at} has a torque ripple of {amplitude} with {periods_per_rev} (phase "
        "{phase}) that the model lacks",
        confused_with=("sinusoidal_force", "joint_spring"),
        tell_apart="move through the same positions at two speeds: the frequency of a "
        "ripple goes with the speed",
        joint_law=ripple_law,
        joint_numbers=_numbers("amplitude", "periods_per_rev", "phase"),
        signature=_ripple_signature,
        added=_ripple_added,
    ),
    "joint_spring": EffectKind(
        at="joint",
        parameters=(
            Parameter("stiffness", "N m/rad", 0.0, 200.0),
            Parameter("rest", "rad", -math.pi, math.pi, None),
        ),
        says="a spring or a cable of {stiffness} pulls {at} to {rest}, which the model "
        "lacks",
        confused_with=("torque_ripple", "gravity_tilt", "payload"),
        tell_apart="move through the joint's whole range, in several poses of the "
        "other joints",
        joint_law=spring_law,
        joint_numbers=_numbers("stiffness", "rest"),
        signature=_spring_signature,
        added=_spring_added,
    ),
}

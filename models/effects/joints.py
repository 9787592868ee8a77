"""Effects in a joint: damping, dry friction, drag, rotor, ripple, spring."""

import math

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint

from makebreak.models.effects.actuation_path import FASTEST
from makebreak.models.effects.kind import (
    Effect,
    EffectKind,
    Parameter,
    actuator_of,
    find_joints,
    full_name,
    velocity_unit,
)
from makebreak.models.effects.signature import (
    Signature,
    at_joints,
    without_momentum,
)
from makebreak.models.effects.transmission import motor_joint
from makebreak.systems.numerics.joint_laws import (
    coulomb_law,
    direction_law,
    drag_law,
    position_law,
    ripple_law,
    spring_law,
    stribeck_law,
)

# ----- How they act on the plant


def _left(effect: Effect, has: float, change: float) -> float:
    """has + change, at least 0. Raises: ValueError if it is negative."""
    # Rounding below 0 is clipped, as Drake would throw.
    if not has + change >= -1e-6 * abs(has):
        ((name, value),) = effect.parameters.items()
        raise ValueError(
            f"effect {effect.kind} at {effect.at}: {name} {value:g} leaves "
            f"{has + change:g}, expected 0 or more with the {has:g} that the model has"
        )
    return max(has + change, 0.0)


def _add_damping(effect: Effect, plant: MultibodyPlant, scene_graph) -> None:
    for joint in find_joints(effect, plant):
        (has,) = joint.default_damping_vector()
        left = _left(effect, has, effect.parameters["damping"])
        joint.set_default_damping_vector([left])


def _least_damping(effect, plant: MultibodyPlant, effects, damped) -> dict[str, float]:
    has = [joint.default_damping_vector()[0] for joint in find_joints(effect, plant)]
    return {"damping": -min(has)}


def _change_damping(old: Effect, new: Effect, plant: MultibodyPlant, context) -> None:
    change = new.parameters["damping"] - old.parameters["damping"]
    for joint in find_joints(new, plant):
        (has,) = joint.GetDampingVector(context)
        joint.SetDampingVector(context, [_left(new, has, change)])


def _add_rotor(effect: Effect, plant: MultibodyPlant, scene_graph) -> None:
    """Sets the actuator's rotor inertia: reflected inertia / gear ratio^2. A joint
    without an actuator gets one that is never commanded."""
    for joint in find_joints(effect, plant):
        actuator = actuator_of(plant, joint)
        if actuator is None:
            actuator = plant.AddJointActuator(f"{joint.name()}_rotor", joint)
        if actuator.default_gear_ratio() == 0.0:
            raise ValueError(
                f"effect rotor_inertia at {effect.at}: the gear ratio of "
                f"{actuator.name()} is 0"
            )
        has = actuator.default_reflected_inertia()
        left = _left(effect, has, effect.parameters["inertia"])
        actuator.set_default_rotor_inertia(left / actuator.default_gear_ratio() ** 2)


def _least_rotor(effect, plant: MultibodyPlant, effects, damped) -> dict[str, float]:
    """A joint that its drive damps keeps enough inertia for a stable time step."""
    context = plant.CreateDefaultContext()
    mobility = np.linalg.inv(plant.CalcMassMatrix(context))
    low = []
    for joint in find_joints(effect, plant):
        actuator = actuator_of(plant, motor_joint(plant, joint) or joint)
        has = 0.0 if actuator is None else actuator.default_reflected_inertia()
        i = joint.velocity_start()
        needed = damped.get(full_name(plant, joint), 0.0) / FASTEST
        low.append(max(-has, min(needed - 1.0 / mobility[i, i], 0.0)))
    return {"inertia": max(low)}


def _change_rotor(old: Effect, new: Effect, plant: MultibodyPlant, context) -> None:
    change = new.parameters["inertia"] - old.parameters["inertia"]
    for joint in find_joints(new, plant):
        actuator = actuator_of(plant, motor_joint(plant, joint) or joint)
        ratio_squared = actuator.gear_ratio(context) ** 2
        left = _left(new, actuator.rotor_inertia(context) * ratio_squared, change)
        actuator.SetRotorInertia(context, left / ratio_squared)


def rotor(joint: str, inertia: float) -> Effect:
    """A rotor [kg m2] at a joint, as an effect."""
    return Effect(ROTOR, [joint], {"inertia": inertia})


# Effects of these kinds may be negative where their sum at a joint is not.


def _totals(effect: Effect, effects, plant, name: str) -> dict[str, float]:
    """{joint: sum of a parameter over the scene's effects of this kind}."""
    totals: dict[str, float] = {}
    for each in effects:
        if each.kind == effect.kind:
            value = each.parameters[name]
            for joint in find_joints(each, plant):
                at = full_name(plant, joint)
                totals[at] = totals.get(at, 0.0) + value
    return totals


def _least_total(name: str):
    def least(effect, plant: MultibodyPlant, effects, damped) -> dict[str, float]:
        totals = _totals(effect, effects, plant, name)
        has = [totals.get(full_name(plant, j), 0.0) for j in find_joints(effect, plant)]
        return {name: -max(min(has), 0.0)}

    return least


def _check_total(effect: Effect, plant: MultibodyPlant, effects) -> None:
    ((name, value),) = effect.parameters.items()
    totals = _totals(effect, effects, plant, name)
    for joint in find_joints(effect, plant):
        _left(effect, totals[full_name(plant, joint)] - value, value)


def fade_velocity(plant: MultibodyPlant, joint: Joint, friction: float) -> float:
    """Speed `fade` below which dry friction c tanh(v / fade) fades: 0.005 rad/s or
    0.001 m/s, and more where a discrete plant needs it.

    In a discrete plant the force acts one step late. There fade >= 2 c dt / J, so that
    one step of friction changes the speed by at most half of fade and never reverses
    the motion. J is the joint's effective inertia at the default positions with all
    other joints free, which is its smallest.
    """
    fade_min = velocity_unit(joint)
    dt = plant.time_step()
    if dt == 0.0:
        return fade_min
    context = plant.CreateDefaultContext()
    mobility = np.linalg.inv(plant.CalcMassMatrix(context))
    i = joint.velocity_start()
    return max(fade_min, 2.0 * friction * dt * mobility[i, i])


def _coulomb_numbers(effect, plant, joint):
    c = effect.parameters["coulomb"]
    return [c, fade_velocity(plant, joint, c)]


def _direction_numbers(effect, plant, joint):
    c = [effect.parameters[name] for name in ("coulomb_plus", "coulomb_minus")]
    return [*c, fade_velocity(plant, joint, max(c))]


def _stribeck_numbers(effect, plant, joint):
    p = effect.parameters
    fade = fade_velocity(plant, joint, max(p["coulomb"], p["static"]))
    return [p["coulomb"], p["static"], p["stribeck_velocity"], fade]


def _position_numbers(effect, plant, joint):
    p = effect.parameters
    c = [p[name] for name in ("coulomb_low", "coulomb_high")]
    return [*c, p["low"], p["high"], fade_velocity(plant, joint, max(c))]


def _check_range(effect: Effect) -> None:
    p = effect.parameters
    if not p["low"] < p["high"]:
        raise ValueError(
            f"effect {effect.kind} at {effect.at}: low is {p['low']:g} and high "
            f"{p['high']:g}, expected low below high"
        )


def _range_of(effect, plant, motions) -> dict[str, list[float]]:
    """Between which positions a joint is for nine tenths of the time."""
    (joint,) = find_joints(effect, plant)
    q = np.concatenate([m.q[:, joint.position_start()] for m in motions])
    low, high = (float(x) for x in np.quantile(q, (0.05, 0.95)))
    return {"low": [low], "high": [high]} if low < high else {"low": [], "high": []}


def _numbers(*names):
    return lambda effect, plant, joint: [effect.parameters[name] for name in names]


# ----- Their signatures: the residual is minus the effect's force.

STRIBECK_VELOCITIES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)  # [rad/s]
TRIED_SPEEDS = (0.03, 0.06, 0.1, 0.2)
TRIED_PERIODS = tuple(float(n) for n in range(2, 25)) + (30.0, 36.0, 48.0, 60.0)
PERIODS = (*range(1, 31), 36, 40, 48, 50, 60, 72, 80, 90, 100)


def _damping_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)
    return [at_joints(effect, ["damping"], motion, joints, [lambda q, v, u: v])]


def _coulomb_signature(effect, model, motion, grid=None) -> list[Signature]:
    columns = np.zeros((*motion.v.shape, 1))
    for joint in find_joints(effect, model.plant):
        i = joint.velocity_start()
        share = np.tanh(motion.v[:, i] / velocity_unit(joint))
        columns[:, i, 0] = share if motion.dry is None else motion.dry[:, i]
    return [without_momentum(effect, ["coulomb"], columns)]


def _direction_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)
    slow = velocity_unit(joints[0])
    entries = [
        lambda q, v, u: np.tanh(np.maximum(v, 0.0) / slow),
        lambda q, v, u: np.tanh(np.minimum(v, 0.0) / slow),
    ]
    names = ["coulomb_plus", "coulomb_minus"]
    return [at_joints(effect, names, motion, joints, entries)]


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


def _position_signature(effect, model, motion, grid=None) -> list[Signature]:
    joints = find_joints(effect, model.plant)
    slow = velocity_unit(joints[0])
    if not grid or "low" not in grid:
        grid = _range_of(effect, model.plant, [motion])
    found = []
    for low, high in zip(grid["low"], grid["high"], strict=True):

        def share(q, low=low, high=high):
            return np.clip((q - low) / (high - low), 0.0, 1.0)

        entries = [
            lambda q, v, u, share=share: (1.0 - share(q)) * np.tanh(v / slow),
            lambda q, v, u, share=share: share(q) * np.tanh(v / slow),
        ]
        names, held = ["coulomb_low", "coulomb_high"], {"low": low, "high": high}
        found.append(at_joints(effect, names, motion, joints, entries, held))
    return found


def _load_signature(effect, model, motion, grid=None) -> list[Signature]:
    """Linear in the share of the torque that the joint needs without the effect."""
    needed = model.inverse_dynamics(motion.q, motion.v, motion.vd, motion.time)
    columns = _load_column(effect, model, motion, needed)[:, :, None]
    return [without_momentum(effect, ["share"], columns)]


def _load_column(effect, model, motion, needed) -> np.ndarray:
    column = np.zeros_like(motion.v)
    for joint in find_joints(effect, model.plant):
        i = joint.velocity_start()
        direction = np.tanh(motion.v[:, i] / velocity_unit(joint))
        column[:, i] = np.abs(needed[:, i]) * direction
    return column


def _load_on_top(effect, model, motion, needed) -> np.ndarray:
    return effect.parameters["share"] * _load_column(effect, model, motion, needed)


def _load_added(effect, model, motion) -> np.ndarray:
    needed = model.inverse_dynamics(motion.q, motion.v, motion.vd, motion.time)
    return _load_on_top(effect, model, motion, needed)


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


ROTOR = "rotor_inertia"
KINDS = {
    "joint_viscous_damping": EffectKind(
        at="joint",
        parameters=(Parameter("damping", "N m s/rad", -2.0, 2.0, of_size=True),),
        says="{at} has {damping} of viscous damping that the model lacks",
        says_less="{at} has {damping} less of viscous damping than the model says",
        confused_with=(
            "joint_coulomb_friction",
            "joint_quadratic_drag",
            "input_delay",
            "body_drag",
        ),
        exported="inertia",
        tell_apart="move the joint at speeds a decade apart, with reversals",
        before_finalize=_add_damping,
        least=_least_damping,
        set_in_context=_change_damping,
        signature=_damping_signature,
    ),
    "joint_coulomb_friction": EffectKind(
        at="joint",
        parameters=(Parameter("coulomb", "N m", -1.0, 1.0, of_size=True),),
        says="{at} has Coulomb friction of {coulomb} that the model lacks",
        says_less="{at} has {coulomb} less of Coulomb friction than the model says",
        confused_with=(
            "joint_viscous_damping",
            "joint_stribeck_friction",
            "joint_position_friction",
            "actuator_bias",
            "joint_backlash",
        ),
        exported="friction",
        tell_apart="move the joint both ways through the same positions, at two speeds",
        possible=_check_total,
        least=_least_total("coulomb"),
        joint_law=coulomb_law,
        joint_numbers=_coulomb_numbers,
        signature=_coulomb_signature,
    ),
    "joint_direction_friction": EffectKind(
        at="joint",
        parameters=(
            Parameter("coulomb_plus", "N m", 0.0, 1.0, valid=">= 0", of_size=True),
            Parameter("coulomb_minus", "N m", 0.0, 1.0, valid=">= 0", of_size=True),
        ),
        says="{at} has Coulomb friction that the model lacks: {coulomb_plus} where its "
        "position grows, {coulomb_minus} where it falls",
        confused_with=(
            "joint_coulomb_friction",
            "actuator_bias",
            "joint_load_friction",
            "gravity_tilt",
        ),
        contains=("joint_coulomb_friction", "actuator_bias"),
        tell_apart="let the joint rest: a bias goes on pulling, friction does not; and "
        "move it both ways with and without load",
        joint_law=direction_law,
        joint_numbers=_direction_numbers,
        signature=_direction_signature,
    ),
    "joint_position_friction": EffectKind(
        at="joint",
        parameters=(
            Parameter("coulomb_low", "N m", 0.0, 1.0, valid=">= 0", of_size=True),
            Parameter("coulomb_high", "N m", 0.0, 1.0, valid=">= 0", of_size=True),
            Parameter("low", "rad", -1e3, 1e3, None, given=True),
            Parameter("high", "rad", -1e3, 1e3, None, given=True),
        ),
        says="{at} has Coulomb friction that the model lacks: {coulomb_low} at {low}, "
        "{coulomb_high} at {high}, linear between",
        confused_with=(
            "joint_coulomb_friction",
            "joint_load_friction",
            "joint_spring",
        ),
        contains=("joint_coulomb_friction",),
        tries=_range_of,
        tell_apart="move the joint both ways through its whole range, at one speed, in "
        "several poses of the other joints",
        check=_check_range,
        joint_law=position_law,
        joint_numbers=_position_numbers,
        signature=_position_signature,
    ),
    "joint_load_friction": EffectKind(
        at="actuator",
        parameters=(Parameter("share", "", 0.0, 0.9, valid="share"),),
        says="{at} loses {share} of the torque that it transmits to friction",
        confused_with=(
            "joint_coulomb_friction",
            "joint_direction_friction",
            "actuator_gain",
            "servo_gain",
        ),
        contains=("joint_coulomb_friction",),
        tell_apart="move the joint both ways, at one speed, with and without a load",
        path="load friction",
        signature=_load_signature,
        added=_load_added,
        on_top=_load_on_top,
    ),
    "joint_stribeck_friction": EffectKind(
        at="joint",
        parameters=(
            Parameter("coulomb", "N m", 0.0, 1.0, valid=">= 0", of_size=True),
            Parameter("static", "N m", 0.0, 2.0, valid=">= 0", of_size=True),
            Parameter("stribeck_velocity", "rad/s", 0.005, 1.0, None, valid="> 0"),
        ),
        says="{at} has dry friction that the model lacks: {static} when it starts, "
        "{coulomb} well above {stribeck_velocity}",
        confused_with=("joint_coulomb_friction", "joint_viscous_damping"),
        contains=("joint_coulomb_friction", "joint_viscous_damping"),
        plausible=lambda e: e.parameters["static"] >= e.parameters["coulomb"],
        tries=lambda effect, plant, motions: {"stribeck_velocity": TRIED_SPEEDS},
        tell_apart="reverse the joint slowly, below 0.1 rad/s, and fast as well",
        joint_law=stribeck_law,
        joint_numbers=_stribeck_numbers,
        signature=_stribeck_signature,
    ),
    "joint_quadratic_drag": EffectKind(
        at="joint",
        parameters=(Parameter("coefficient", "N m s2/rad2", -1.0, 1.0, of_size=True),),
        says="{at} has drag that grows with the square of its speed, {coefficient}, "
        "that the model lacks",
        says_less="{at} has {coefficient} less of the drag that grows with the square "
        "of its speed than the model says",
        confused_with=("joint_viscous_damping", "body_drag"),
        tell_apart="move the joint at speeds that differ by a factor of three or more",
        possible=_check_total,
        least=_least_total("coefficient"),
        joint_law=drag_law,
        joint_numbers=_numbers("coefficient"),
        signature=_drag_signature,
    ),
    ROTOR: EffectKind(
        at="joint",
        parameters=(Parameter("inertia", "kg m2", -2.0, 2.0, of_size=True),),
        says="{at} turns a rotor with {inertia} (reflected at the joint) that the "
        "model lacks",
        says_less="the rotor of {at} has {inertia} less (reflected at the joint) than "
        "the model says",
        confused_with=("object_inertia", "payload", "actuator_gain"),
        exported="inertia",
        tell_apart="move the other joints fast while this one rests, and know on which "
        "side of the gear the torque is measured",
        before_finalize=_add_rotor,
        least=_least_rotor,
        set_in_context=_change_rotor,
        signature=_rotor_signature,
    ),
    "torque_ripple": EffectKind(
        at="joint",
        parameters=(
            Parameter("amplitude", "N m", 0.0, 0.2, of_size=True),
            Parameter("periods_per_rev", "periods a turn", 2.0, 100.0, None),
            Parameter("phase", "rad", -math.pi, math.pi, None),
        ),
        says="{at} has a torque ripple of {amplitude} with {periods_per_rev} (phase "
        "{phase}) that the model lacks",
        confused_with=("sinusoidal_force", "joint_spring"),
        tries=lambda effect, plant, motions: {"periods_per_rev": TRIED_PERIODS},
        # Once a turn is the weight of a mass off the axis, less is a spring.
        plausible=lambda e: e.parameters["periods_per_rev"] >= 2.0,
        tell_apart="move through the same positions at two speeds: the frequency of a "
        "ripple is proportional to the speed",
        joint_law=ripple_law,
        joint_numbers=_numbers("amplitude", "periods_per_rev", "phase"),
        signature=_ripple_signature,
        added=_ripple_added,
    ),
    "joint_spring": EffectKind(
        at="joint",
        parameters=(
            Parameter("stiffness", "N m/rad", 0.0, 2.0, of_size=True),
            Parameter("rest", "rad", -math.pi, math.pi, None),
        ),
        says="a spring or a cable of {stiffness} pulls {at} to {rest}, which the model "
        "lacks",
        confused_with=("torque_ripple", "gravity_tilt", "payload"),
        contains=("actuator_bias",),
        tell_apart="move through the joint's whole range, in several poses of the "
        "other joints",
        least=_least_total("stiffness"),
        joint_law=spring_law,
        joint_numbers=_numbers("stiffness", "rest"),
        signature=_spring_signature,
        added=_spring_added,
    ),
}

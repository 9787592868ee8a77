"""What an effect asks of the motors along a known motion: our own equations, to
tell by computation which effects a recording can tell apart, and to test the worlds.
"""

import mujoco
import numpy as np

from gap_benchmark.mechanism import quaternion, rotation
from gap_benchmark.robot_world import Inverse, Track, joints_of, loaded
from gap_benchmark.robots import G, Robot

LOADS = ("payload", "link_mass", "link_com")
FORCES = ("body_drag", "constant_force", "sinusoidal_force")


def added_effort(robot: Robot, effect: dict, track: Track) -> np.ndarray:
    """(k, n) effort [N m, or N] that the motors give more with the effect than without
    it, for the same motion.

    Raises: ValueError for a kind that acts otherwise.
    """
    kind, at, p = effect["kind"], effect["at"], effect["parameters"]
    q, v, a, t = track.q, track.v, track.a, track.time
    out = np.zeros_like(q)
    if kind in LOADS:
        return Inverse(loaded(robot, effect))(q, v, a) - Inverse(robot)(q, v, a)
    if kind == "gravity_tilt":
        R = rotation(quaternion((p["roll"], p["pitch"], 0.0)))
        tilted = tuple(R.T @ np.array([0.0, 0.0, -G]))
        return Inverse(robot, tilted)(q, v, a) - Inverse(robot)(q, v, a)
    if kind in FORCES:
        jac_p, jac_r, origin = jacobians(robot, at, q)
        if kind == "body_drag":
            linear = np.einsum("kij,kj->ki", jac_p, v)
            angular = np.einsum("kij,kj->ki", jac_r, v)
            return p["linear"] * np.einsum("kij,ki->kj", jac_p, linear) + p[
                "angular"
            ] * np.einsum("kij,ki->kj", jac_r, angular)
        force = np.array([p["fx"], p["fy"], p["fz"]])
        size = np.ones(len(t))
        if kind == "sinusoidal_force":
            size = np.sin(2 * np.pi * p["frequency"] * t + p["phase"])
        return -size[:, None] * np.einsum("kij,i->kj", jac_p, force)
    i = joints_of(robot, at)
    w = v[:, i]
    if kind == "joint_viscous_damping":
        out[:, i] = p["damping"] * w
    elif kind == "joint_coulomb_friction":
        out[:, i] = p["coulomb"] * np.sign(w)
    elif kind == "joint_direction_friction":
        out[:, i] = np.where(w > 0, p["coulomb_plus"], -p["coulomb_minus"])
    elif kind == "joint_load_friction":
        load = Inverse(robot)(q, v, a)
        out[:, i] = p["share"] * np.abs(load[:, i]) * np.sign(w)
    elif kind == "joint_stribeck_friction":
        peak = (p["static"] - p["coulomb"]) * np.exp(
            -((w / p["stribeck_velocity"]) ** 2)
        )
        out[:, i] = (p["coulomb"] + peak) * np.sign(w)
    elif kind == "joint_quadratic_drag":
        out[:, i] = p["coefficient"] * w * np.abs(w)
    elif kind == "rotor_inertia":
        out[:, i] = p["inertia"] * a[:, i]
    elif kind == "torque_ripple":
        out[:, i] = -p["amplitude"] * np.sin(
            p["periods_per_rev"] * q[:, i] + p["phase"]
        )
    elif kind == "joint_spring":
        out[:, i] = p["stiffness"] * (q[:, i] - p["rest"])
    elif kind == "actuator_bias":
        out[:, i] = -p["bias"]
    elif kind == "actuator_gain":
        # What is measured is what was asked for: the motors give gain times it.
        out[:, i] = track.motor[:, i] * (1.0 / p["gain"] - 1.0)
    else:
        raise ValueError(f"{kind} is no law of effort")
    return out


def jacobians(robot: Robot, at: str, q) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(k, 3, n) of the origin of a body and of its rotation; (k, 3) where it is."""
    inverse = Inverse(robot)
    m, d = inverse.model, inverse.data
    body = m.body(at.split(".")[1]).id
    n = m.nv
    jac_p, jac_r = np.zeros((len(q), 3, n)), np.zeros((len(q), 3, n))
    origin = np.zeros((len(q), 3))
    for k in range(len(q)):
        d.qpos[:] = q[k]
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mj_jac(m, d, jac_p[k], jac_r[k], d.xpos[body], body)
        origin[k] = d.xpos[body]
    return jac_p, jac_r, origin

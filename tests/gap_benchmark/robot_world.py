"""A robot under control, simulated in MuJoCo, with what its scene does not have.

Damping, dry friction, rotors, springs and gaps in a joint are MuJoCo's own (its dry
friction is a constraint: it sticks); what MuJoCo lacks is written from the definitions
of the kinds and applied before each step.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from gap_benchmark.mechanism import quaternion, rotation
from gap_benchmark.motions import Motion
from gap_benchmark.robots import G, Robot, to_mjcf, with_point

STEP = 0.0005  # [s], RK4.


@dataclass(frozen=True)
class Drive:
    """How the robot is driven.

    type: effort (computed torque about the motion, by the robot that its maker knows,
        each `period` [s]); servo (kp [N m/rad] on the commanded place, a ceiling, what
        the supply's voltage leaves, a dead band; back-EMF brakes it); velocity
        (kd [N m s/rad] on the commanded speed, a ceiling).
    """

    type: str = "effort"
    period: float = 0.001
    kp: np.ndarray = field(default_factory=lambda: np.zeros(0))
    kd: np.ndarray = field(default_factory=lambda: np.zeros(0))
    limit: float = np.inf  # [N m]
    voltage: float = 12.0  # [V]
    kt: float = 0.0  # [N m/A], at the joint.
    resistance: float = 1.0  # [ohm]
    dead_band: float = 0.0  # [rad]
    resolution: float = 0.0  # [rad] of the commands that it receives.


@dataclass(frozen=True)
class Push:
    """A person pushes a body from start_sec on for `seconds`: force [N] at its peak, on
    the body's origin, in world."""

    body: str
    start_sec: float
    seconds: float
    force: tuple[float, float, float]


@dataclass
class Track:
    """What happened, on a grid of 1 ms: q, v, a of the motors' side (n,) each; link_q,
    that of the links; motor, what the drive gave; link, what came out of the gear;
    commands by name."""

    time: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    link_q: np.ndarray
    motor: np.ndarray
    link: np.ndarray
    commands: dict[str, np.ndarray]


def joints_of(robot: Robot, at) -> list[int]:
    names = robot.joints
    places = [at] if isinstance(at, str) else at
    if places == [robot.model]:
        return list(range(len(names)))
    return [names.index(name) for name in places]


class RobotWorld:
    """nominal: what its maker knows; true: the numbers that it has; effects: [{kind,
    at, parameters}] beside them. Kinds that concern what is measured alone are left to
    robot_log.py."""

    def __init__(
        self,
        nominal: Robot,
        true: Robot,
        effects: Sequence[dict],
        drive: Drive,
        push: Push | None = None,
    ):
        self.nominal, self.drive, self.push = nominal, drive, push
        n = len(nominal.joints)
        self.n = n
        self.gain, self.bias, self.limit = np.ones(n), np.zeros(n), np.full(n, np.inf)
        self.lag, self.delay, self.offset = np.zeros(n), 0.0, np.zeros(n)
        self.kp = drive.kp.copy()
        damping, dry = np.zeros(n), np.zeros(n)
        self.share, self.uneven = np.zeros(n), np.zeros(n)
        self.stribeck: list[tuple[int, dict]] = []
        self.laws: list[tuple[str, list[int], str, dict]] = []
        play: dict[int, str] = {}
        gravity = np.array([0.0, 0.0, -G])
        for effect in effects:
            kind, at, p = effect["kind"], effect["at"], effect["parameters"]
            if kind in ("payload", "link_mass", "link_com"):
                true = loaded(true, effect)
                continue
            if kind in ("body_drag", "constant_force", "sinusoidal_force"):
                self.laws.append((kind, [], at, p))
                continue
            if kind == "gravity_tilt":
                R = rotation(quaternion((p["roll"], p["pitch"], 0.0)))
                gravity = R.T @ gravity
                continue
            if kind in ("sensor_lag", "sensor_delay", "sensor_bias", "clock_skew"):
                continue
            joints = joints_of(nominal, at)
            if kind == "joint_viscous_damping":
                damping[joints] += p["damping"]
            elif kind == "joint_coulomb_friction":
                dry[joints] += p["coulomb"]
            elif kind == "joint_direction_friction":
                dry[joints] += 0.5 * (p["coulomb_plus"] + p["coulomb_minus"])
                self.uneven[joints] += 0.5 * (p["coulomb_plus"] - p["coulomb_minus"])
            elif kind == "joint_load_friction":
                self.share[joints] += p["share"]
            elif kind == "joint_stribeck_friction":
                self.stribeck += [(i, p) for i in joints]
                dry[joints] += p["coulomb"]
            elif kind == "rotor_inertia":
                for i in joints:
                    body = true.moving[i]
                    true = true.with_body(
                        f"{true.model}.{body.name}", rotor=body.rotor + p["inertia"]
                    )
            elif kind == "actuator_gain":
                self.gain[joints] = p["gain"]
            elif kind == "actuator_bias":
                self.bias[joints] = p["bias"]
            elif kind == "actuator_saturation":
                self.limit[joints] = p["limit"]
            elif kind == "actuator_lag":
                self.lag[joints] = p["time_constant"]
            elif kind == "input_delay":
                self.delay = p["delay"]
            elif kind == "joint_offset":
                self.offset[joints] = p["offset"]
            elif kind == "servo_gain":
                self.kp[joints] = p["kp"]
            elif kind == "joint_elasticity":
                for i in joints:
                    play[i] = f'stiffness="{p["stiffness"]}" damping="{p["damping"]}"'
            elif kind == "joint_backlash":
                # Stiff sides, about 100 Hz of the rotor against its link, that give
                # back some of what hits them: it bounces.
                for i in joints:
                    half = 0.5 * p["gap"]
                    play[i] = (
                        f'limited="true" range="{-half} {half}" '
                        'solreflimit="0.003 0.25" solimplimit="0.99 0.99 0.001"'
                    )
            elif kind in ("joint_quadratic_drag", "torque_ripple", "joint_spring"):
                self.laws.append((kind, joints, "", p))
            else:
                raise ValueError(f"no law for {kind}")
        self.true, self.dry = true, dry
        self.model = mujoco.MjModel.from_xml_string(
            to_mjcf(true, gravity, damping, dry, play)
        )
        self.model.opt.timestep = STEP
        self.data = mujoco.MjData(self.model)
        names = [body.joint for body in nominal.moving]
        self.dof = np.array([self.model.joint(name).dofadr[0] for name in names])
        self.play = {i: self.model.joint(f"{names[i]}_play").dofadr[0] for i in play}
        self.inverse = Inverse(nominal)

    def run(self, motion: Motion) -> Track:
        m, d, drive = self.model, self.data, self.drive
        mujoco.mj_resetData(m, d)
        every = round(drive.period / STEP)
        per_ms = round(0.001 / STEP)
        n_steps = round((motion.time[-1] - motion.time[0]) / STEP) - every
        step_of_motion = motion.time[1] - motion.time[0]
        stride = drive.period / step_of_motion
        feed = self.inverse(motion.q, motion.v, motion.a)
        d.qpos[self.dof] = motion.q[0] - self.offset
        d.qvel[self.dof] = motion.v[0]
        M = self.inverse.mass_diagonal(motion.q[0])
        kp, kd = 100.0 * M, 14.0 * M
        limits = np.array([body.effort for body in self.nominal.moving])
        rows: list[list[np.ndarray]] = [[], [], [], []]
        commands: list[np.ndarray] = []
        queue: list[tuple[float, np.ndarray]] = []
        effort = feed[0].copy()
        command = feed[0]
        stepwise = bool(
            self.laws or self.stribeck or self.share.any() or self.lag.any()
            or self.push or drive.type != "effort" or self.delay
        )  # fmt: skip
        if self.share.any():
            self.load = Inverse(self.true)
        small = 1 if stepwise else per_ms
        k = 0
        while k < n_steps:
            if k % every == 0:
                i = round(k // every * stride)
                q = d.qpos[self.dof] + self.offset
                if drive.type == "effort":
                    command = np.clip(
                        feed[i] + kp * (motion.q[i] - q)
                        + kd * (motion.v[i] - d.qvel[self.dof]), -limits, limits,
                    )  # fmt: skip
                elif drive.type == "velocity":
                    command = motion.v[i] + 2.0 * (motion.q[i] - q)
                else:
                    command = motion.q[i]
                commands.append(command)
                queue.append((d.time, command))
            now = command
            if self.delay:
                while len(queue) > 1 and queue[1][0] + self.delay <= d.time + 1e-9:
                    queue.pop(0)
                now = queue[0][1]
            q, v = d.qpos[self.dof] + self.offset, d.qvel[self.dof]
            if drive.type == "effort":
                wanted = now
            elif drive.type == "servo":
                wanted = self._servo(now, q, v)
            else:
                error = now - v
                wanted = np.clip(drive.kd * error, -drive.limit, drive.limit)
            wanted = np.clip(self.gain * wanted + self.bias, -self.limit, self.limit)
            if self.lag.any():
                lag = np.maximum(self.lag, 1e-9)
                x = STEP / lag
                mean = wanted + (effort - wanted) * -np.expm1(-x) / x
                effort = wanted + (effort - wanted) * np.exp(-x)
                applied = np.where(self.lag > 0, mean, wanted)
            else:
                effort = applied = wanted
            if k % per_ms == 0:
                rows[0].append(d.qpos[self.dof].copy())
                rows[1].append(d.qvel[self.dof].copy())
                rows[2].append(effort.copy())
                link = d.qpos[self.dof].copy()
                for i, dof in self.play.items():
                    link[i] += d.qpos[dof]
                rows[3].append(link)
            if stepwise:
                d.qfrc_applied[:] = 0.0
                d.qfrc_applied[self.dof] = applied - self.uneven
                self._apply_laws()
            else:
                d.qfrc_applied[self.dof] = applied - self.uneven
            mujoco.mj_step(m, d, small)
            k += small
        if not np.isfinite(d.qpos).all():
            raise RuntimeError("the simulation went wrong")
        q, v, motor, link_q = (np.array(r) for r in rows)
        time = 0.001 * np.arange(len(q))
        a = np.gradient(v, 0.001, axis=0)
        bodies = tuple(replace(body, rotor=0.0) for body in self.true.bodies)
        link = Inverse(replace(self.true, bodies=bodies))(q, v, a)
        per_command = round(drive.period / 0.001)
        sent = np.repeat(np.array(commands), per_command, axis=0)[: len(time)]
        name = {"effort": "effort_command", "velocity": "velocity_command"}
        return Track(time, q, v, a, link_q, motor, link,
                     {name.get(drive.type, "position_command"): sent})  # fmt: skip

    def _servo(self, command, q, v):
        d = self.drive
        if d.resolution:
            command = d.resolution * np.round(command / d.resolution)
        error = command - q
        error = np.sign(error) * np.maximum(np.abs(error) - d.dead_band, 0.0)
        brake = d.kt**2 / d.resistance * v
        ceiling = d.kt / d.resistance * d.voltage  # Less the braking: what is left.
        u = np.clip(self.kp * error, -d.limit, d.limit) - brake
        return np.clip(u, -ceiling - brake, ceiling - brake)

    def _apply_laws(self) -> None:
        m, d = self.model, self.data
        q, v, t = d.qpos[self.dof], d.qvel[self.dof], d.time
        out = d.qfrc_applied
        for i, p in self.stribeck:
            peak = (p["static"] - p["coulomb"]) * np.exp(
                -((v[i] / p["stribeck_velocity"]) ** 2)
            )
            m.dof_frictionloss[self.dof[i]] = p["coulomb"] + peak
        if self.share.any():
            load = self.load(q[None], v[None], d.qacc[self.dof][None])[0]
            m.dof_frictionloss[self.dof] = self.dry + self.share * np.abs(load)
        if self.push is not None:
            s = (t - self.push.start_sec) / self.push.seconds
            if 0.0 < s < 1.0:
                force = np.sin(np.pi * s) ** 0.5 * np.array(self.push.force)
                self._push_body(self.push.body, force, np.zeros(3))
        for kind, joints, at, p in self.laws:
            if kind == "joint_quadratic_drag":
                out[self.dof[joints]] -= p["coefficient"] * v[joints] * abs(v[joints])
            elif kind == "torque_ripple":
                angle = p["periods_per_rev"] * q[joints] + p["phase"]
                out[self.dof[joints]] += p["amplitude"] * np.sin(angle)
            elif kind == "joint_spring":
                out[self.dof[joints]] -= p["stiffness"] * (q[joints] - p["rest"])
            else:
                body = m.body(at.split(".")[1]).id
                force, torque = np.zeros(3), np.zeros(3)
                if kind == "body_drag":
                    jac_p, jac_r = np.zeros((3, m.nv)), np.zeros((3, m.nv))
                    mujoco.mj_jac(m, d, jac_p, jac_r, d.xpos[body], body)
                    force = -p["linear"] * (jac_p @ d.qvel)
                    torque = -p["angular"] * (jac_r @ d.qvel)
                else:
                    force = np.array([p["fx"], p["fy"], p["fz"]])
                    if kind == "sinusoidal_force":
                        angle = 2 * np.pi * p["frequency"] * t + p["phase"]
                        force = force * np.sin(angle)
                self._push_body(at, force, torque)

    def _push_body(self, at: str, force, torque) -> None:
        m, d = self.model, self.data
        body = m.body(at.split(".")[1]).id
        mujoco.mj_applyFT(m, d, force, torque, d.xpos[body], body, d.qfrc_applied)


def loaded(robot: Robot, effect: dict) -> Robot:
    """The robot with a payload, or with a body of other mass or centre of mass."""
    p, at = effect["parameters"], effect["at"]
    body = robot.bodies[robot.body(at)]
    if effect["kind"] == "payload":
        new = with_point(body, p["mass"], (p["com_x"], p["com_y"], p["com_z"]))
    elif effect["kind"] == "link_mass":
        f = 1.0 + p["mass"] / body.mass  # Of the same shape, so of more density.
        new = replace(body, mass=f * body.mass,
                      inertia=tuple(f * np.array(body.inertia)))  # fmt: skip
    else:
        move = np.array([p["x"], p["y"], p["z"]])
        new = replace(body, com=tuple(np.array(body.com) + move))
    return robot.with_body(at, mass=new.mass, com=new.com, inertia=new.inertia)


class Inverse:
    """Inverse dynamics of a robot without friction; see effort_laws.py for effects."""

    def __init__(self, robot: Robot, gravity=(0.0, 0.0, -G)):
        zero = np.zeros(len(robot.joints))
        self.model = mujoco.MjModel.from_xml_string(to_mjcf(robot, gravity, zero, zero))
        self.data = mujoco.MjData(self.model)

    def __call__(self, q, v, a) -> np.ndarray:
        """(k, n) effort [N m, or N] of the motion q, v, a (k, n)."""
        m, d = self.model, self.data
        out = np.empty(np.shape(q))
        for k in range(len(q)):
            d.qpos[:], d.qvel[:], d.qacc[:] = q[k], v[k], a[k]
            mujoco.mj_inverse(m, d)
            out[k] = d.qfrc_inverse
        return out

    def mass_diagonal(self, q) -> np.ndarray:
        d = self.data
        d.qpos[:] = q
        mujoco.mj_forward(self.model, d)
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, d, full)
        return np.diag(full).copy()

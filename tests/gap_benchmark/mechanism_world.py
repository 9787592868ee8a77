"""A mechanism under control, simulated in MuJoCo, with what its scene does not have.

The nominal mechanism is what the controller and the scene know. What happens has the
background's inertias and the effects; every law here is written from the definitions
of the kinds alone.
"""

from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from gap_benchmark.mechanism import (
    Mechanism,
    quaternion,
    rotation,
    to_mjcf,
    with_payload,
)

STEP = 0.0005  # [s], RK4.
G = 9.81


@dataclass(frozen=True)
class Sampling:
    """How it is controlled and recorded. time_scatter [share of the period]."""

    rate_hz: float = 200.0
    time_scatter: float = 0.0
    lost_rows: float = 0.0
    position_noise: float = 3e-5
    velocity_noise: float = 3e-3
    effort_noise: float = 0.03


@dataclass
class Track:
    """What truly happened, densely: rows of time, q, v; and the ticks' commands."""

    time: np.ndarray
    q: np.ndarray
    v: np.ndarray
    effort: np.ndarray  # What the motors gave.
    tick: np.ndarray
    commands: dict[str, np.ndarray] = field(default_factory=dict)


class Reference:
    """A multisine for each joint: position, velocity, acceleration at a time."""

    def __init__(self, mechanism: Mechanism, rng, calm: float = 1.0):
        n, k = len(mechanism.links), 5
        self.w = 2 * np.pi * rng.uniform(0.08, mechanism.fastest_hz * calm, (n, k))
        self.w[:, 0] = 2 * np.pi * rng.uniform(0.08, 0.15, n)  # Slow reversals too.
        self.phase = rng.uniform(0, 2 * np.pi, (n, k))
        size = rng.uniform(0.5, 1.0, (n, k))
        size *= np.array(mechanism.reach)[:, None] / size.sum(axis=1, keepdims=True)
        self.size, self.middle = size, np.array(mechanism.middle)

    def at(self, t):
        angle = self.w * t + self.phase
        q = self.middle + (self.size * np.sin(angle)).sum(axis=1)
        v = (self.size * self.w * np.cos(angle)).sum(axis=1)
        return q, v, -(self.size * self.w**2 * np.sin(angle)).sum(axis=1)


class MechanismWorld:
    """Builds the true model and runs episodes.

    effects: [{kind, at, parameters}]; kinds that only concern what is measured are
    left to sensing.py, except joint_offset, which the controller sees as well.
    """

    def __init__(self, nominal: Mechanism, true: Mechanism, effects, drive="effort"):
        self.nominal, self.drive = nominal, drive
        self.n = n = len(nominal.links)
        self.index = {name: i for i, name in enumerate(nominal.joints)}
        self.bodies = {
            f"{nominal.model}.{link.name}": i for i, link in enumerate(nominal.links)
        }
        one, zero = np.ones(n), np.zeros(n)
        self.gain, self.bias, self.limit = one.copy(), zero.copy(), np.full(n, np.inf)
        self.lag, self.offset = zero.copy(), zero.copy()
        self.delay = 0.0
        self.laws = []  # Of passive forces: (kind, where, parameters).
        self.motor: dict[int, dict] = {}
        gravity = np.array([0.0, 0.0, -G])
        links = list(true.links)
        joint_laws: list = []
        for effect in effects:
            kind, p = effect["kind"], effect["parameters"]
            where = effect["at"]
            for at in [where] if isinstance(where, str) else where:
                joints = (
                    list(nominal.driven)
                    if at == nominal.model
                    else [self.index.get(at)]
                )
                if kind == "payload":
                    i = self.bodies[at]
                    place = (p["com_x"], p["com_y"], p["com_z"])
                    links[i] = with_payload(links[i], p["mass"], place)
                elif kind == "rotor_inertia":
                    for i in joints:
                        links[i] = replace(
                            links[i], rotor=links[i].rotor + p["inertia"]
                        )
                elif kind == "gravity_tilt":
                    R = rotation(quaternion((p["roll"], p["pitch"], 0.0)))
                    gravity = R.T @ gravity
                elif kind == "actuator_gain":
                    self.gain[joints] = p["gain"]
                elif kind == "actuator_bias":
                    self.bias[joints] = p["bias"]
                elif kind == "actuator_saturation":
                    self.limit[joints] = p["limit"]
                elif kind == "input_delay":
                    self.delay = p["delay"]
                elif kind == "actuator_lag":
                    self.lag[joints] = p["time_constant"]
                elif kind == "joint_offset":
                    self.offset[joints] = p["offset"]
                elif kind in ("joint_elasticity", "joint_backlash"):
                    for i in joints:
                        self.motor[i] = effect
                elif kind in ("joint_viscous_damping", "joint_coulomb_friction"):
                    joint_laws.append((kind, joints, p))
                elif kind not in ("sensor_delay", "clock_skew", "sensor_bias"):
                    body = self.bodies.get(at)
                    self.laws.append((kind, joints if body is None else body, dict(p)))
        self.true = replace(true, links=tuple(links))
        motors = {i: links[i].rotor for i in self.motor}
        text = to_mjcf(self.true, gravity, STEP, motors)
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        names = [link.joint for link in nominal.links]
        self.dof = np.array([self.model.joint(name).dofadr[0] for name in names])
        self.motor_dof = self.dof.copy()
        for i in self.motor:
            self.motor_dof[i] = self.model.joint(f"motor_{names[i]}").dofadr[0]
        for kind, joints, p in joint_laws:
            for i in joints:
                if kind == "joint_viscous_damping":
                    # Element-wise: the row may be a scalar or a vector.
                    self.model.dof_damping[self.dof[i]] += p["damping"]
                else:
                    self.model.dof_frictionloss[self.dof[i]] += p["coulomb"]
        plain = to_mjcf(nominal, (0.0, 0.0, -G), STEP)
        self.plain_model = mujoco.MjModel.from_xml_string(plain)
        self.plain = mujoco.MjData(self.plain_model)
        self._controlling = False
        self._held: dict = {}
        self.kp, self.kd = (np.array(nominal.extra.get(k, [])) for k in ("kp", "kd"))
        self.hysteresis = np.zeros(n)  # State of the Bouc-Wen element.
        self.body_ids = [self.model.body(link.name).id for link in nominal.links]

    def inverse_dynamics(self, q, v, a) -> np.ndarray:
        d = self.plain
        d.qpos[:], d.qvel[:], d.qacc[:] = q, v, a
        self._controlling = True
        mujoco.mj_inverse(self.plain_model, d)
        self._controlling = False
        return d.qfrc_inverse.copy()

    def _passive(self, model, data):
        """Adds the forces that MuJoCo does not know; called in each stage of RK4."""
        if self._controlling:  # The callback is one for all models.
            return
        q, v, t = data.qpos, data.qvel, data.time
        out = data.qfrc_passive
        if self.drive == "pd":  # Analog: it knows no period.
            out[self.motor_dof] += self._effort(self._held, q, v)
        for kind, where, p in self.laws:
            if kind == "joint_stribeck_friction":
                for i in where:
                    w = v[self.dof[i]]
                    peak = (p["static"] - p["coulomb"]) * np.exp(
                        -((w / p["stribeck_velocity"]) ** 2)
                    )
                    out[self.dof[i]] -= (p["coulomb"] + peak) * np.tanh(w / 2e-3)
            elif kind == "joint_quadratic_drag":
                for i in where:
                    w = v[self.dof[i]]
                    out[self.dof[i]] -= p["coefficient"] * w * abs(w)
            elif kind == "torque_ripple":
                for i in where:
                    angle = p["periods_per_rev"] * q[self.dof[i]] + p["phase"]
                    out[self.dof[i]] += p["amplitude"] * np.sin(angle)
            elif kind == "joint_spring":
                for i in where:
                    out[self.dof[i]] -= p["stiffness"] * (q[self.dof[i]] - p["rest"])
            elif kind == "bouc_wen":
                for i in where:
                    out[self.dof[i]] -= p["force"] * self.hysteresis[i]
            else:
                self._body_law(kind, where, p, model, data, t, out)
        for i, effect in self.motor.items():
            p, a, b = effect["parameters"], self.motor_dof[i], self.dof[i]
            twist, rate = q[a] - q[b], v[a] - v[b]
            if effect["kind"] == "joint_elasticity":
                force = p["stiffness"] * twist + p["damping"] * rate
            else:
                # A gear that is stiff once a tooth touches: 200 Hz of the rotor.
                beyond = np.sign(twist) * max(abs(twist) - 0.5 * p["gap"], 0.0)
                k = self.true.links[i].rotor * (2 * np.pi * 100.0) ** 2
                force = k * beyond
                if beyond:
                    force += 0.3 * np.sqrt(k * self.true.links[i].rotor) * rate
                    force = force if force * beyond > 0 else 0.0
            out[a] -= force
            out[b] += force

    def _body_law(self, kind, body, p, model, data, t, out):
        number = self.body_ids[body]
        origin = data.xpos[number]
        force, torque = np.zeros(3), np.zeros(3)
        if kind == "constant_force":
            force[:] = p["fx"], p["fy"], p["fz"]
        elif kind == "sinusoidal_force":
            size = np.sin(2 * np.pi * p["frequency"] * t + p["phase"])
            force[:] = p["fx"] * size, p["fy"] * size, p["fz"] * size
        elif kind == "magnetic_pull":
            away = np.array([p["x"], p["y"], p["z"]]) - origin
            r2 = away @ away + p["core"] ** 2
            force[:] = p["strength"] / r2 * away / np.sqrt(r2)
        elif kind == "body_drag":
            jac_p, jac_r = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jac_p, jac_r, origin, number)
            force[:] = -p["linear"] * (jac_p @ data.qvel)
            torque[:] = -p["angular"] * (jac_r @ data.qvel)
        else:
            raise ValueError(f"no law for {kind}")
        mujoco.mj_applyFT(model, data, force, torque, origin, number, out)

    def run(self, seconds, reference: Reference, sampling: Sampling, rng) -> Track:
        """One episode. The clock starts at 0; commands change at the ticks."""
        m, d, n = self.model, self.data, self.n
        mujoco.mj_resetData(m, d)
        q0, v0, _ = reference.at(0.0)
        free = [i for i in range(n) if i not in self.nominal.driven]
        q0[free] += rng.uniform(-0.8, 0.8, len(free))
        v0[free] = 0.0
        d.qpos[self.dof] = d.qpos[self.motor_dof] = q0 - self.offset
        d.qvel[self.dof] = d.qvel[self.motor_dof] = v0
        if self.drive == "effort":  # The link hangs behind its motor from the start.
            load = self.inverse_dynamics(*reference.at(0.0))
            for i, effect in self.motor.items():
                p = effect["parameters"]
                twist = np.sign(load[i]) * 0.5 * p.get("gap", 0.0)
                if "stiffness" in p:
                    twist = load[i] / p["stiffness"]
                d.qpos[self.dof[i]] -= twist
        self._controlling = True
        mujoco.mj_forward(m, d)
        self._controlling = False
        self.hysteresis[:] = 0.0
        period = 1.0 / sampling.rate_hz
        n_ticks = int(seconds / period)
        ticks = period * (
            np.arange(n_ticks) + np.clip(rng.normal(size=n_ticks), -2.5, 2.5)
            * min(sampling.time_scatter, 0.15)
        )  # fmt: skip
        ticks[0] = 0.0
        lost = rng.uniform(size=n_ticks) < sampling.lost_rows
        lost[: max(int(self.delay / period) + 2, 3)] = False
        ticks = ticks[~lost]  # Nobody sends a command then: the last one goes on.
        rows_t, rows_q, rows_v, rows_u = [], [], [], []
        sent: list = []  # (time, command)
        log: dict[str, list] = {}
        motor_effort = np.zeros(n)
        if self.laws or self.motor or self.drive == "pd":
            mujoco.set_mjcb_passive(self._passive)
        try:
            for k, t in enumerate(ticks):
                command = self._command(t, reference, sampling, rng)
                for key, value in command.items():
                    log.setdefault(key, []).append(value)
                sent.append((t, command))
                end = ticks[k + 1] if k + 1 < len(ticks) else t + period
                motor_effort = self._advance(
                    t, end, sent, motor_effort, (rows_t, rows_q, rows_v, rows_u)
                )
        finally:
            mujoco.set_mjcb_passive(None)
        commands = {key: np.array(value) for key, value in log.items()}
        return Track(
            *(np.array(r) for r in (rows_t, rows_q, rows_v, rows_u)), ticks, commands
        )

    def _command(self, t, reference, sampling, rng):
        q_ref, v_ref, a_ref = reference.at(t)
        if self.drive == "pd":
            return {"position_command": q_ref, "velocity_command": v_ref}
        d, n = self.data, self.n
        q = d.qpos[self.motor_dof] + self.offset
        q = q + sampling.position_noise * rng.normal(size=n)
        v = d.qvel[self.motor_dof] + sampling.velocity_noise * rng.normal(size=n)
        driven = list(self.nominal.driven)
        u = np.zeros(n)
        if len(driven) < n:  # The cart: a stiff spring to its reference.
            link = self.nominal.links[driven[0]]
            e, de = (q_ref - q)[driven], (v_ref - v)[driven]
            mass = link.mass + link.rotor
            u[driven] = mass * (a_ref[driven] + 60.0 * e + 12.0 * de)
        else:
            a = a_ref + 64.0 * (q_ref - q) + 14.0 * (v_ref - v)
            u = self.inverse_dynamics(q, v, a)
        limits = np.array([link.effort for link in self.nominal.links])
        return {"effort_command": np.clip(u, -limits, limits)}

    def _advance(self, start, end, sent, effort, rows):
        """Simulates from one tick to the next. Returns the motors' last effort."""
        m, d = self.model, self.data
        drive = self.drive == "pd"
        edges = {start, end}
        for t, _ in sent[-1 - int(self.delay * 400 + 3) :]:
            if start < t + self.delay < end:
                edges.add(t + self.delay)
        longest = 0.001 if drive or self.lag.any() else 0.0025
        edges = sorted(edges)
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            if b - a < 1e-9:
                continue
            # The command that has arrived by now; before any has, the first one.
            arrived = [c for t, c in sent[-40:] if t + self.delay <= a + 1e-9]
            command = arrived[-1] if arrived else sent[0][1]
            pieces = int(np.ceil((b - a) / longest - 1e-6))
            for piece in range(pieces):
                d.time = a + (b - a) * piece / pieces
                self._held = command
                wanted = self._effort(command, d.qpos, d.qvel)
                h = (b - a) / pieces
                n_steps = max(int(np.ceil(h / STEP - 1e-6)), 1)
                m.opt.timestep = h / n_steps
                rows[0].append(d.time)
                rows[1].append(d.qpos[self.motor_dof].copy())
                rows[2].append(d.qvel[self.motor_dof].copy())
                for _ in range(n_steps if self.lag.any() else 1):
                    # A first-order lag, by its mean over the step.
                    lag = np.maximum(self.lag, 1e-12)
                    x = m.opt.timestep / lag
                    mean = wanted + (effort - wanted) * np.minimum(-np.expm1(-x) / x, 1)
                    effort = wanted + (effort - wanted) * np.exp(-x)
                    d.qfrc_applied[:] = 0.0
                    applied = np.where(self.lag > 0, mean, wanted)
                    d.qfrc_applied[self.motor_dof] = 0.0 if drive else applied
                    mujoco.mj_step(m, d, 1 if self.lag.any() else n_steps)
                rows[3].append(np.where(self.lag > 0, effort, wanted))
                self._step_hysteresis(h)
        return effort

    def _effort(self, command, q, v):
        if self.drive == "pd":
            q, v = q[self.motor_dof] + self.offset, v[self.motor_dof]
            u = self.kp * (command["position_command"] - q)
            u += self.kd * (command["velocity_command"] - v)
        else:
            u = command["effort_command"]
        driven = np.zeros(self.n)
        driven[list(self.nominal.driven)] = 1.0
        return driven * np.clip(self.gain * u + self.bias, -self.limit, self.limit)

    def _step_hysteresis(self, h):
        for kind, where, p in self.laws:
            if kind != "bouc_wen":
                continue
            for i in where:
                z, v = self.hysteresis[i], self.data.qvel[self.dof[i]]
                # z' = (v - |v| z)/reach: a friction that remembers its path.
                rate = v - abs(v) * z
                self.hysteresis[i] = np.clip(z + h * rate / p["reach"], -1.0, 1.0)

"""Robots that follow commands, simulated in MuJoCo over a whole log, many at once.

Beside the log, what the robot's drives and joints may have: `Values`.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.signal import savgol_filter

WORLD_STEP_SEC = 0.0005  # Of the benchmark's world.
START_SEC = 0.1  # Of the cubic fit to the positions about a start.


@dataclass
class Log:
    """A robot's commands and positions. goal, rate, q: (k, n); rate_hz: of commands,
    each of which holds until the next."""

    time: np.ndarray
    q: np.ndarray
    goal: np.ndarray
    rate: np.ndarray
    rate_hz: float

    def __post_init__(self):
        # A row shows a command that may have come before it.
        sent = np.arange(int(self.time[-1] * self.rate_hz + 1e-6) + 1) / self.rate_hz
        row = np.searchsorted(self.time, sent - 1e-6).clip(max=len(self.time) - 1)
        held = np.hstack([self.goal, self.rate])[row]
        self._at = np.r_[-1.0, sent, sent[-1] + 1.0]
        pieces = np.vstack([held[:1], held]) * np.diff(self._at)[:, None]
        self._sum = np.vstack([0.0 * held[:1], np.cumsum(pieces, axis=0)])

    def controls(self, times: np.ndarray) -> np.ndarray:
        """(k - 1, 2 n) means of the goals and rates between times (k,) [s]."""
        total = [np.interp(times, self._at, column) for column in self._sum.T]
        return np.diff(total, axis=1).T / np.diff(times)[:, None]

    def motion(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Smoothed q, v and v' (k, n)."""
        dt = float(np.median(np.diff(self.time)))
        n = max(5, 2 * round(0.5 * START_SEC / dt) + 1)
        q, v, a = (
            savgol_filter(self.q, n, 3, deriv=d, delta=dt, axis=0) for d in range(3)
        )
        return q, v, a

    def first(self, rows: int) -> "Log":
        """The log without its later rows."""
        cut = {k: getattr(self, k)[:rows] for k in ("time", "q", "goal", "rate")}
        return replace(self, **cut)


@dataclass(frozen=True)
class Values:
    """friction [N m], damping [N m s/rad], rotor [kg m2], offset of the command [rad]
    and kp [N m/rad]: (n,) each; delay of the commands (1,) [s]."""

    friction: np.ndarray
    damping: np.ndarray
    rotor: np.ndarray
    offset: np.ndarray
    kp: np.ndarray
    delay: np.ndarray

    def vector(self) -> np.ndarray:
        """(5 n + 1,), in this order."""
        return np.concatenate([getattr(self, f.name) for f in fields(self)])

    @classmethod
    def of(cls, vector: np.ndarray) -> "Values":
        """The values of such a vector."""
        n = (len(vector) - 1) // 5
        return cls(*np.split(vector, n * np.arange(1, 6)))


class Rig:
    """A robot under its drives in MuJoCo: effort = kp (goal + offset - q) + kd (rate -
    v), with a goal and a rate that are late by the delay.

    spec: an MjSpec of the robot, without actuators. joints: the names in it. kp, kd
    (n,). dry: solref (2,) and solimp (5,) of dry friction, of the solver.
    """

    def __init__(self, spec, joints, kp, kd, delay=0.0, dry=None):
        import mujoco

        for kind, gains in (("position", kp), ("velocity", kd)):
            for joint, gain in zip(joints, gains, strict=True):
                each = spec.add_actuator(name=f"{joint}.{kind}", target=joint)
                each.trntype = mujoco.mjtTrn.mjTRN_JOINT
                if kind == "position":
                    each.set_to_position(kp=gain)
                else:
                    each.set_to_velocity(kv=gain)
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        self.model = model = spec.compile()
        self._dof = np.array([model.joint(joint).dofadr[0] for joint in joints])
        if dry is not None:
            model.dof_solref[:], model.dof_solimp[:] = dry
        at = self._dof
        self.kd = np.array(kd)
        self.values = Values(
            model.dof_frictionloss[at].copy(), model.dof_damping[at].copy(),
            model.dof_armature[at].copy(), np.zeros(len(at)), np.array(kp),
            np.array([delay]),
        )  # fmt: skip

    def inertia(self, q) -> np.ndarray:
        """(n,) of each joint at q (n,), with its rotor [kg m2]."""
        import mujoco

        data, full = mujoco.MjData(self.model), np.zeros((self.model.nv,) * 2)
        data.qpos[self._dof] = q
        mujoco.mj_forward(self.model, data)
        mujoco.mj_fullM(self.model, data, full)
        return np.diag(full)[self._dof]

    def simulate(
        self, values: Sequence[Values], log: Log, first: int = 0,
        step: float = WORLD_STEP_SEC,
    ) -> np.ndarray:  # fmt: skip
        """(len(values), k - first, n) positions at the log's rows from `first` on, of
        one open run from the measured state."""
        import mujoco
        from mujoco import rollout

        model, at, n = self.model, self._dof, len(self._dof)
        model.opt.timestep = step
        data = mujoco.MjData(model)
        q, v, _ = log.motion()
        data.qpos[at], data.qvel[at] = q[first], v[first]
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.empty(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, data, start, kind)
        begin = log.time[first]
        grid = begin + step * np.arange(np.ceil((log.time[-1] - begin) / step) + 1.0)
        # Euler's step moves with the speed of its end, so half a step early: a longer
        # one gets its commands later by that, less what the world's has of it.
        middle = 0.5 * (step - WORLD_STEP_SEC)
        models, controls = [], []
        for each in values:
            one = copy.copy(model)
            one.dof_frictionloss[at] = each.friction
            one.dof_damping[at] = each.damping
            one.dof_armature[at] = each.rotor
            one.actuator_gainprm[:n, 0] = each.kp
            one.actuator_biasprm[:n, 1] = -each.kp
            models.append(one)
            late = log.controls(grid - each.delay[0] - middle)
            controls.append(late + np.r_[each.offset, np.zeros(n)])
        states, _ = rollout.rollout(
            models, data, np.tile(start, (len(models), 1)), np.array(controls)
        )
        there = np.concatenate(
            [np.broadcast_to(q[first], (len(models), 1, n)), states[:, :, 1 + at]],
            axis=1,
        )
        at_row = (log.time[first:] - begin) / step
        before = np.floor(at_row + 1e-6).astype(int).clip(max=there.shape[1] - 2)
        after = (at_row - before)[:, None]
        return (1.0 - after) * there[:, before] + after * there[:, before + 1]


def scales(rig: Rig, log: Log) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """({field of Values: (n,) by how much effort changes with it}, effort), rms over
    the log by the rig's law [N m]."""
    q, v, a = log.motion()
    off = log.goal - q

    def rms(x):
        return np.sqrt(np.mean(np.square(x), axis=0))

    effort = rms(rig.values.kp * off + rig.kd * (log.rate - v))
    by = {"friction": np.ones(len(effort)), "damping": rms(v), "rotor": rms(a),
          "offset": rig.values.kp, "kp": rms(off),
          "delay": rms(rig.values.kp * v + rig.kd * a)}  # fmt: skip
    return by, effort

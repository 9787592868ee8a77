"""Two links in a vertical plane, by Lagrange's equations in closed form: a world that
shares nothing with MuJoCo's, nor with Drake's.

Both joints turn about y. With planar vectors p = (x, z), R(q) p the vector turned by q,
and S p = (z, -x) its derivative's direction, c_i the centre of mass of link i, l the
elbow in the upper link, h = l . R(q2) c2 and w = q1' + q2':

    M = [[m1 c1^2 + I1 + J1 + m2 (l^2 + c2^2 + 2 h) + I2,  m2 (c2^2 + h) + I2],
         [.,                                               m2 c2^2 + I2 + J2]]
    C = m2 h' (2 q1' q2' + q2'^2,  -q1'^2)
    G = -g (m1 x1 + m2 (xl + x2),  m2 x2),   x of the turned vectors in world

Integrated by the classical Runge-Kutta method at 0.1 ms.
"""

import numpy as np
from numba import njit

from gap_benchmark.motions import Motion
from gap_benchmark.robot_world import Inverse, Track, loaded
from gap_benchmark.robots import G, Robot

_STEP = 1e-4
_FADE = 1e-3  # [rad/s] over which dry friction turns round.


@njit(cache=True)
def _terms(q1, q2, v1, v2, p):
    m1, c1x, c1z, i1, j1, m2, c2x, c2z, i2, j2, lx, lz, g = p[:13]
    s1, k1 = np.sin(q1), np.cos(q1)
    s12, k12 = np.sin(q1 + q2), np.cos(q1 + q2)
    s2, k2 = np.sin(q2), np.cos(q2)
    rx, rz = c2x * k2 + c2z * s2, -c2x * s2 + c2z * k2  # R(q2) c2.
    h = lx * rx + lz * rz
    dh = lx * rz - lz * rx
    c2 = c2x * c2x + c2z * c2z
    m11 = m1 * (c1x**2 + c1z**2) + i1 + j1 + m2 * (lx**2 + lz**2 + c2 + 2 * h) + i2
    m12 = m2 * (c2 + h) + i2
    m22 = m2 * c2 + i2 + j2
    x1 = c1x * k1 + c1z * s1
    xl = lx * k1 + lz * s1
    x2 = c2x * k12 + c2z * s12
    n1 = m2 * dh * (2 * v1 * v2 + v2 * v2) - g * (m1 * x1 + m2 * (xl + x2))
    n2 = -m2 * dh * v1 * v1 - g * m2 * x2
    return m11, m12, m22, n1, n2


@njit(cache=True)
def _acceleration(x, u1, u2, p):
    m11, m12, m22, n1, n2 = _terms(x[0], x[1], x[2], x[3], p)
    t1 = u1 - n1 - p[13] * np.tanh(x[2] / _FADE) - p[15] * x[2]
    t2 = u2 - n2 - p[14] * np.tanh(x[3] / _FADE) - p[16] * x[3]
    t1 -= p[17] * x[2] * abs(x[2])
    t2 -= p[18] * x[3] * abs(x[3])
    det = m11 * m22 - m12 * m12
    out = np.empty(4)
    out[0], out[1] = x[2], x[3]
    out[2] = (m22 * t1 - m12 * t2) / det
    out[3] = (m11 * t2 - m12 * t1) / det
    return out


@njit(cache=True)
def _hold(x, u1, u2, p, steps, h):
    """The state after `steps` under a constant effort."""
    for _ in range(steps):
        a = _acceleration(x, u1, u2, p)
        b = _acceleration(x + 0.5 * h * a, u1, u2, p)
        c = _acceleration(x + 0.5 * h * b, u1, u2, p)
        d = _acceleration(x + h * c, u1, u2, p)
        x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return x


class TwoLinkWorld:
    """`planar` of robots.py, under computed torque each millisecond."""

    def __init__(self, nominal: Robot, true: Robot, effects):
        p = np.zeros(19)
        for effect in effects:
            if effect["kind"] in ("payload", "link_mass", "link_com"):
                true = loaded(true, effect)
        for k, body in enumerate(true.bodies):
            place = (body.com[0], body.com[2])
            p[5 * k : 5 * k + 5] = body.mass, *place, body.inertia[1], body.rotor
        p[10], p[11], p[12] = true.bodies[1].xyz[0], true.bodies[1].xyz[2], G
        rows = {"joint_coulomb_friction": (13, "coulomb"),
                "joint_viscous_damping": (15, "damping"),
                "joint_quadratic_drag": (17, "coefficient")}  # fmt: skip
        for effect in effects:
            if effect["kind"] in rows:
                row, name = rows[effect["kind"]]
                joint = nominal.joint(effect["at"])
                p[row + joint] += effect["parameters"][name]
            elif effect["kind"] not in ("payload", "link_mass", "link_com"):
                raise ValueError(f"no law for {effect['kind']}")
        self.numbers, self.nominal = p, nominal

    def mass_and_rest(self, q, v) -> tuple[np.ndarray, np.ndarray]:
        """M (2, 2) and the effort (2,) of no acceleration, without friction."""
        m11, m12, m22, n1, n2 = _terms(*map(float, (*q, *v)), self.numbers)
        return np.array([[m11, m12], [m12, m22]]), np.array([n1, n2])

    def energy(self, q, v) -> float:
        """[J], zero where both centres are at the shoulder's height."""
        M, _ = self.mass_and_rest(q, v)
        m1, c1x, c1z, _, _, m2, c2x, c2z, _, _, lx, lz, g = self.numbers[:13]

        def height(x, z, angle):
            return -x * np.sin(angle) + z * np.cos(angle)

        z = m1 * height(c1x, c1z, q[0]) + m2 * height(lx, lz, q[0])
        z += m2 * height(c2x, c2z, q[0] + q[1])
        return float(0.5 * np.asarray(v) @ M @ np.asarray(v) + g * z)

    def coast(self, q, v, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """q and v (2,) after `seconds` without any effort."""
        x = _hold(np.r_[q, v].astype(float), 0.0, 0.0, self.numbers,
                  round(seconds / _STEP), _STEP)  # fmt: skip
        return x[:2], x[2:]

    def run(self, motion: Motion) -> Track:
        inverse = Inverse(self.nominal)
        feed = inverse(motion.q, motion.v, motion.a)
        M = inverse.mass_diagonal(motion.q[0])
        x = np.r_[motion.q[0], motion.v[0]]
        n = len(motion.time) - 1
        rows = np.empty((n, 6))
        for k in range(n):
            u = feed[k] + 100.0 * M * (motion.q[k] - x[:2])
            u += 14.0 * M * (motion.v[k] - x[2:])
            rows[k] = *x, *u
            x = _hold(x, u[0], u[1], self.numbers, round(0.001 / _STEP), _STEP)
        time = 0.001 * np.arange(n)
        q, v, motor = rows[:, :2], rows[:, 2:4], rows[:, 4:]
        a = np.gradient(v, 0.001, axis=0)
        rotors = np.array([body.rotor for body in self.nominal.bodies])
        sent = {"effort_command": motor}
        return Track(time, q, v, a, q, motor, motor - rotors * a, sent)

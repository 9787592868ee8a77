"""Free rigid bodies with spheres, which touch fixed boxes, half-spaces and each other.

The law is that of Drake's continuous point contact, so that what is fitted here holds
there; it is stepped a hundred times as fast, for searches over thousands of windows:

    f_n = k depth (1 + d depth_rate)+,    f_t = -mu(|v_t|) f_n v_t/|v_t|
    or f_n = (k depth + c depth_rate)+ where a linear damper c stands in for d

with mu(v) rising smoothly to the static value at the speed v_s and falling to the
dynamic one at 3 v_s. Source: Hunt, Crossley, J. Appl. Mech. 42(2), 1975; Drake's
documentation of MultibodyPlant, "Modeling of compliant contact" and
"Continuous approximation of Coulomb friction". Steps: Bogacki, Shampine, Appl. Math.
Lett. 2(4), 1989.
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit

EDGE, FACE = 1.0, 2.0
# Sine of the angle from a cylinder's axis to the normal of what it touches, between
# which its face gives way to its edge; and that of the side's angle to it below which
# the edges of both ends begin to share the load.
LEAN, SIDE = (0.1, 0.3), 0.1
MOST_STEPS = 40_000  # Of one run: beyond it the parameters are given up.


@dataclass(frozen=True, eq=False)
class FreeBody:
    """The body, what it touches, and what acts on it.

    spheres (n, 4): centre in the body's frame and radius [m]. fixed (m, 15): rotation
    (9, by rows) and centre (3) in world, half sizes (3) [m]; a half-space has its
    origin on its surface and a first half size of -1. pairs (n, m, 6): stiffness [N/m],
    dissipation [s/m], static and dynamic friction, the share of the contact point that
    lies on the sphere's surface, and a linear damper [N s/m]. levers (n, m): of rolling
    resistance [m].
    forces (p, 6): fx, fy, fz [N, world, on the body's origin], frequency [Hz] (0:
    constant), phase, 0. patches (k, 6): number of a fixed shape, and the friction there
    where x and y of the world are within x_min, x_max, y_min, y_max. rims (n, 5): of
    the spheres that stand in for a cylinder: its axis (3), the radius of a circle about
    the sphere's centre [m], and what the sphere is: EDGE touches with the point of the
    circle that is farthest along a normal which is across the axis, FACE where the
    normal is along the axis; 0: a sphere as it is.
    """

    mass: float
    com: np.ndarray  # (3,) in the body's frame [m]
    inertia: np.ndarray  # (3, 3) about the centre of mass, body's axes [kg m2]
    gravity: np.ndarray  # (3,)
    spheres: np.ndarray
    fixed: np.ndarray
    pairs: np.ndarray
    levers: np.ndarray
    forces: np.ndarray
    drag: np.ndarray  # (3,) linear [N s/m], angular [N m s/rad], quadratic [N s2/m2]
    slip: float = 1e-3  # v_s [m/s]
    fade: float = 0.05  # Below this rate rolling resistance fades [rad/s].
    patches: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    rims: np.ndarray | None = None

    def __post_init__(self):
        shape = (len(self.spheres), len(self.fixed), 6)
        if self.pairs.shape != shape:  # Compiled steps would read beyond its end.
            raise ValueError(f"FreeBody.pairs is {self.pairs.shape}, expected {shape}")
        if self.drag.shape != (3,):
            raise ValueError(f"FreeBody.drag is {self.drag.shape}, expected (3,)")


@dataclass(frozen=True, eq=False)
class FreeBodies:
    """Bodies that touch the same fixed shapes, under one gravity, and each other.

    mutual (n, n, 6): of two spheres of different bodies, all bodies' spheres in a row,
    the first one before the second: as FreeBody.pairs has them, with the share of the
    contact point that lies on the first one's surface; 0 where they do not touch.
    """

    each: tuple[FreeBody, ...]
    mutual: np.ndarray

    def __post_init__(self):
        n = sum(len(body.spheres) for body in self.each)
        if self.mutual.shape != (n, n, 6):
            raise ValueError(
                f"FreeBodies.mutual is {self.mutual.shape}, expected {(n, n, 6)}"
            )


def alone(body: FreeBody) -> FreeBodies:
    """One body, which touches nothing but what is fixed."""
    return FreeBodies((body,), np.zeros((len(body.spheres),) * 2 + (6,)))


def simulate(
    body: FreeBody, start, times, max_step: float = 0.01, tol: float = 1e-5
) -> np.ndarray:
    """(n, 13) at the times (n,), the first of which is that of `start`.

    Args: start (13,): quaternion wxyz, position of the body's origin, its angular
        velocity and velocity, all in world, as a Drake state. tol: error of a step, of
        velocities [m/s], and a tenth of it of positions [m].
    Returns: NaN from where the steps became too short.
    """
    start = np.asarray(start, float)[None]
    return simulate_all(alone(body), start, times, max_step, tol)[:, 0]


def simulate_all(
    bodies: FreeBodies, start, times, max_step: float = 0.01, tol: float = 1e-5
) -> np.ndarray:
    """(n, n_bodies, 13); start (n_bodies, 13), the rest as of simulate()."""
    each = bodies.each
    count = [len(body.spheres) for body in each]

    def owned(rows, width: int) -> np.ndarray:
        """Rows of all bodies, with the number of the body in a last column."""
        own = [np.column_stack([x, np.full(len(x), k)]) for k, x in enumerate(rows)]
        return np.concatenate(own).reshape(-1, width + 1)

    return _run(
        np.array(start, float), np.asarray(times, float),
        np.array([float(body.mass) for body in each]),
        np.array([body.com for body in each]),
        np.array([body.inertia for body in each]),
        np.array([np.linalg.inv(body.inertia) for body in each]),
        each[0].gravity, np.concatenate([body.spheres for body in each]),
        np.repeat(np.arange(len(each)), count), each[0].fixed,
        np.concatenate([body.pairs for body in each]),
        np.concatenate([body.levers for body in each]),
        np.concatenate([_rims(body) for body in each]), bodies.mutual,
        owned([body.forces for body in each], 6),
        np.array([body.drag for body in each]), each[0].slip, each[0].fade,
        owned([body.patches for body in each], 6), max_step, tol,
    )  # fmt: skip


def _rims(body: FreeBody) -> np.ndarray:
    return np.zeros((len(body.spheres), 5)) if body.rims is None else body.rims


def placed(pose, points) -> np.ndarray:
    """(n, 3) points of the body's frame (n, 3) in world; pose (7,) as in `start`."""
    return np.asarray(pose[4:7]) + points @ _matrix(np.asarray(pose[:4], float)).T


def lowest_gap(body: FreeBody, pose) -> float:
    """Least distance of a sphere to what is fixed [m]; pose (7,) as in `start`."""
    return nearest(body, pose)[0]


def gaps(body: FreeBody, pose) -> np.ndarray:
    """(m,) least distance of a sphere to each fixed shape [m]; pose (7,)."""
    return gaps_and_normals(body, pose)[:, :, 0].min(axis=0)


def nearest(body: FreeBody, pose) -> tuple[float, np.ndarray, int]:
    """Least distance of a sphere to what is fixed [m], the normal there (3,), out of
    what is fixed, and which of the fixed shapes it is (-1: there is none)."""
    found = gaps_and_normals(body, pose)
    if not found.size:
        return np.inf, np.array([0.0, 0.0, 1.0]), -1
    i, k = np.unravel_index(np.argmin(found[:, :, 0]), found.shape[:2])
    return float(found[i, k, 0]), found[i, k, 1:], int(k)


def gaps_and_normals(body: FreeBody, pose) -> np.ndarray:
    """(n, m, 4) distance [m] and normal of each sphere to each fixed shape."""
    R, p = _matrix(np.asarray(pose[:4], float)), np.asarray(pose[4:7], float)
    centres = p + body.spheres[:, :3] @ R.T
    return _gaps(centres, body.spheres[:, 3], body.fixed)


@njit(cache=True)
def _gaps(centres, radii, fixed):
    out = np.empty((len(centres), len(fixed), 4))
    for j in range(len(centres)):
        c0, c1, c2 = centres[j]
        for m in range(len(fixed)):
            out[j, m] = _gap(c0, c1, c2, radii[j], fixed[m])
    return out


@njit(cache=True)
def _matrix(q):
    w, x, y, z = q[0], q[1], q[2], q[3]
    s = 2.0 / (w * w + x * x + y * y + z * z)
    R = np.empty((3, 3))
    R[0, 0], R[0, 1] = 1 - s * (y * y + z * z), s * (x * y - w * z)
    R[0, 2], R[1, 0] = s * (x * z + w * y), s * (x * y + w * z)
    R[1, 1], R[1, 2] = 1 - s * (x * x + z * z), s * (y * z - w * x)
    R[2, 0], R[2, 1] = s * (x * z - w * y), s * (y * z + w * x)
    R[2, 2] = 1 - s * (x * x + y * y)
    return R


@njit(cache=True)
def _is_apart(c0, c1, c2, radius, fixed):
    """Whether a sphere is outside of a fixed shape: beyond one of its faces. What is
    near an edge is left to _gap."""
    d0, d1, d2 = c0 - fixed[9], c1 - fixed[10], c2 - fixed[11]
    a2 = fixed[2] * d0 + fixed[5] * d1 + fixed[8] * d2
    if fixed[12] < 0.0:
        return a2 - radius >= 0.0
    if abs(a2) - fixed[14] >= radius:
        return True
    if abs(fixed[0] * d0 + fixed[3] * d1 + fixed[6] * d2) - fixed[12] >= radius:
        return True
    return abs(fixed[1] * d0 + fixed[4] * d1 + fixed[7] * d2) - fixed[13] >= radius


@njit(cache=True)
def _gap(c0, c1, c2, radius, fixed):
    """Distance of a sphere to a fixed shape, and the normal (3) out of the shape."""
    d0, d1, d2 = c0 - fixed[9], c1 - fixed[10], c2 - fixed[11]
    # In the shape's axes.
    a0 = fixed[0] * d0 + fixed[3] * d1 + fixed[6] * d2
    a1 = fixed[1] * d0 + fixed[4] * d1 + fixed[7] * d2
    a2 = fixed[2] * d0 + fixed[5] * d1 + fixed[8] * d2
    if fixed[12] < 0.0:
        return a2 - radius, fixed[2], fixed[5], fixed[8]
    h0, h1, h2 = fixed[12], fixed[13], fixed[14]
    o0 = a0 - min(max(a0, -h0), h0)
    o1 = a1 - min(max(a1, -h1), h1)
    o2 = a2 - min(max(a2, -h2), h2)
    out = np.sqrt(o0 * o0 + o1 * o1 + o2 * o2)
    if out > 1e-12:
        l0, l1, l2, gap = o0 / out, o1 / out, o2 / out, out
    else:  # The centre is inside: the nearest face.
        e0, e1, e2 = h0 - abs(a0), h1 - abs(a1), h2 - abs(a2)
        l0 = l1 = l2 = 0.0
        if e2 <= e0 and e2 <= e1:
            l2, gap = (1.0 if a2 >= 0 else -1.0), -e2
        elif e1 <= e0:
            l1, gap = (1.0 if a1 >= 0 else -1.0), -e1
        else:
            l0, gap = (1.0 if a0 >= 0 else -1.0), -e0
    n0 = fixed[0] * l0 + fixed[1] * l1 + fixed[2] * l2
    n1 = fixed[3] * l0 + fixed[4] * l1 + fixed[5] * l2
    n2 = fixed[6] * l0 + fixed[7] * l1 + fixed[8] * l2
    return gap - radius, n0, n1, n2


@njit(cache=True)
def _friction(speed, slip, mu_s, mu_d):
    x = speed / slip
    if x >= 3.0:
        return mu_d
    if x >= 1.0:
        y = 0.5 * (x - 1.0)
        return mu_s - (mu_s - mu_d) * y**3 * (10.0 + y * (6.0 * y - 15.0))
    return mu_s * x**3 * (10.0 + x * (6.0 * x - 15.0))


@njit(cache=True)
def _normal_force(stiffness, dissipation, damper, depth, un):
    """At a velocity un out of the depth."""
    return stiffness * depth * (1.0 - dissipation * un) - damper * un


@njit(cache=True)
def _slip(u0, u1, u2, un, n0, n1, n2):
    """A velocity less its part un along the normal, and how fast that is."""
    u0, u1, u2 = u0 - un * n0, u1 - un * n1, u2 - un * n2
    return u0, u1, u2, np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)


@njit(cache=True)
def _push(F, T, b, a0, a1, a2, f0, f1, f2):
    """Adds a force at an arm from the centre of mass of body b."""
    F[b, 0] += f0
    F[b, 1] += f1
    F[b, 2] += f2
    T[b, 0] += a1 * f2 - a2 * f1
    T[b, 1] += a2 * f0 - a0 * f2
    T[b, 2] += a0 * f1 - a1 * f0


@njit(cache=True, inline="always")
def _press(F, T, s, b, p0, p1, p2, depth, n0, n1, n2, radius, share_of, j, m, pairs,
           levers, slip, fade, patches):  # fmt: skip
    """Contact of sphere j of body b, centred at p, with the fixed shape m."""
    w0, w1, w2 = s[b, 7], s[b, 8], s[b, 9]
    reach = radius - (1.0 - pairs[j, m, 4]) * depth
    a0 = p0 - s[b, 4] - reach * n0
    a1 = p1 - s[b, 5] - reach * n1
    a2 = p2 - s[b, 6] - reach * n2
    u0 = s[b, 10] + w1 * a2 - w2 * a1
    u1 = s[b, 11] + w2 * a0 - w0 * a2
    u2 = s[b, 12] + w0 * a1 - w1 * a0
    un = u0 * n0 + u1 * n1 + u2 * n2
    fn = (
        _normal_force(pairs[j, m, 0], pairs[j, m, 1], pairs[j, m, 5], depth, un)
        * share_of
    )
    if fn <= 0.0:
        return
    u0, u1, u2, speed = _slip(u0, u1, u2, un, n0, n1, n2)
    share = 0.0
    if speed > 1e-14:
        mu_s, mu_d = pairs[j, m, 2], pairs[j, m, 3]
        for k in range(len(patches)):
            if (
                patches[k, 0] == m
                and patches[k, 6] == b
                and patches[k, 2] < p0 < patches[k, 3]
                and patches[k, 4] < p1 < patches[k, 5]
            ):
                mu_s = mu_d = patches[k, 1]
        share = _friction(speed, slip, mu_s, mu_d) * fn / speed
    f0, f1, f2 = fn * n0 - share * u0, fn * n1 - share * u1, fn * n2 - share * u2
    _push(F, T, b, a0, a1, a2, f0, f1, f2)
    lever = levers[j, m]
    if lever > 0.0:
        wn = w0 * n0 + w1 * n1 + w2 * n2
        t0, t1, t2 = w0 - wn * n0, w1 - wn * n1, w2 - wn * n2
        turn = max(np.sqrt(t0 * t0 + t1 * t1 + t2 * t2), fade)
        T[b, 0] -= lever * fn / turn * t0
        T[b, 1] -= lever * fn / turn * t1
        T[b, 2] -= lever * fn / turn * t2


@njit(cache=True, inline="always")
def _push_apart(F, T, s, a, b, a0, a1, a2, b0, b1, b2, depth, n0, n1, n2, law,
                slip):  # fmt: skip
    """Bodies a and b, which meet at the levers a0.. and b0.. from their centres of
    mass, with the normal out of b: what they do to each other."""
    u0 = s[a, 10] + s[a, 8] * a2 - s[a, 9] * a1
    u1 = s[a, 11] + s[a, 9] * a0 - s[a, 7] * a2
    u2 = s[a, 12] + s[a, 7] * a1 - s[a, 8] * a0
    u0 -= s[b, 10] + s[b, 8] * b2 - s[b, 9] * b1
    u1 -= s[b, 11] + s[b, 9] * b0 - s[b, 7] * b2
    u2 -= s[b, 12] + s[b, 7] * b1 - s[b, 8] * b0
    un = u0 * n0 + u1 * n1 + u2 * n2
    fn = _normal_force(law[0], law[1], law[5], depth, un)
    if fn <= 0.0:
        return
    u0, u1, u2, speed = _slip(u0, u1, u2, un, n0, n1, n2)
    share = 0.0
    if speed > 1e-14:
        share = _friction(speed, slip, law[2], law[3]) * fn / speed
    f0, f1, f2 = fn * n0 - share * u0, fn * n1 - share * u1, fn * n2 - share * u2
    _push(F, T, a, a0, a1, a2, f0, f1, f2)
    _push(F, T, b, b0, b1, b2, -f0, -f1, -f2)


@njit(cache=True)
def _meet(F, T, s, c, spheres, owner, i, j, law, slip):
    """Contact of the spheres i and j of two bodies."""
    n0, n1, n2 = c[i, 0] - c[j, 0], c[i, 1] - c[j, 1], c[i, 2] - c[j, 2]
    apart = n0 * n0 + n1 * n1 + n2 * n2
    reach = spheres[i, 3] + spheres[j, 3]
    if apart >= reach * reach or apart < 1e-24:
        return
    apart = np.sqrt(apart)
    depth = reach - apart
    n0, n1, n2 = n0 / apart, n1 / apart, n2 / apart
    ri = spheres[i, 3] - (1.0 - law[4]) * depth
    rj = apart - ri
    a, b = owner[i], owner[j]
    a0, a1, a2 = (
        c[i, 0] - s[a, 4] - ri * n0,
        c[i, 1] - s[a, 5] - ri * n1,
        c[i, 2] - s[a, 6] - ri * n2,
    )
    b0, b1, b2 = (
        c[j, 0] - s[b, 4] + rj * n0,
        c[j, 1] - s[b, 5] + rj * n1,
        c[j, 2] - s[b, 6] + rj * n2,
    )
    _push_apart(F, T, s, a, b, a0, a1, a2, b0, b1, b2, depth, n0, n1, n2, law, slip)


@njit(cache=True)
def _rate(t, s, mass, com, inertia, inverse, gravity, spheres, owner, fixed, pairs,
          levers, rims, mutual, forces, drag, slip, fade, patches,
          dx):  # fmt: skip
    """State s (n_bodies, 13): quaternion (4), centre of mass (3), w in world (3), its
    velocity (3)."""
    N = len(mass)
    turned = np.empty((N, 3, 3))
    F = np.empty((N, 3))
    T = np.empty((N, 3))
    f = np.empty((N, 3))  # On the origin.
    o = np.empty((N, 3))  # The origin from the centre of mass.
    for b in range(N):
        R = _matrix(s[b, :4])
        turned[b] = R
        w0, w1, w2 = s[b, 7], s[b, 8], s[b, 9]
        for i in range(3):
            F[b, i] = mass[b] * gravity[i]
            o[b, i] = -(R[i, 0] * com[b, 0] + R[i, 1] * com[b, 1] + R[i, 2] * com[b, 2])
        v0 = s[b, 10] + w1 * o[b, 2] - w2 * o[b, 1]
        v1 = s[b, 11] + w2 * o[b, 0] - w0 * o[b, 2]
        v2 = s[b, 12] + w0 * o[b, 1] - w1 * o[b, 0]
        slowed = drag[b, 0] + drag[b, 2] * np.sqrt(v0**2 + v1**2 + v2**2)
        f[b, 0], f[b, 1], f[b, 2] = -slowed * v0, -slowed * v1, -slowed * v2
    for j in range(len(forces)):
        size = 1.0
        if forces[j, 3] > 0.0:
            size = np.sin(2.0 * np.pi * forces[j, 3] * t + forces[j, 4])
        for i in range(3):
            f[int(forces[j, 6]), i] += size * forces[j, i]
    for b in range(N):
        for i in range(3):
            T[b, i] = -drag[b, 1] * s[b, 7 + i]
        _push(F, T, b, o[b, 0], o[b, 1], o[b, 2], f[b, 0], f[b, 1], f[b, 2])
    c = np.empty((len(spheres), 3))
    axis = np.empty(3)
    b, R = -1, turned[0]
    for j in range(len(spheres)):
        if owner[j] != b:
            b = owner[j]
            R = turned[b]
        b0, b1, b2 = (
            spheres[j, 0] - com[b, 0],
            spheres[j, 1] - com[b, 1],
            spheres[j, 2] - com[b, 2],
        )
        for i in range(3):
            c[j, i] = s[b, 4 + i] + R[i, 0] * b0 + R[i, 1] * b1 + R[i, 2] * b2
        radius, what = spheres[j, 3], rims[j, 4]
        for m in range(len(fixed)):
            p0, p1, p2, share_of = c[j, 0], c[j, 1], c[j, 2], 1.0
            if _is_apart(p0, p1, p2, radius + rims[j, 3], fixed[m]):
                continue
            gap, n0, n1, n2 = _gap(p0, p1, p2, radius, fixed[m])
            if what > 0.0:
                for i in range(3):
                    axis[i] = 0.0
                    for k in range(3):
                        axis[i] += R[i, k] * rims[j, k]
                along = n0 * axis[0] + n1 * axis[1] + n2 * axis[2]
                lean = np.sqrt(max(1.0 - along * along, 0.0))
                x = min(max((lean - LEAN[0]) / (LEAN[1] - LEAN[0]), 0.0), 1.0)
                x *= x * (3.0 - 2.0 * x)
                share_of = x if what == EDGE else 1.0 - x
                if share_of <= 0.0:
                    continue
                if what == EDGE:
                    share_of *= 0.5 + 0.5 * min(abs(along) / SIDE, 1.0)
                    far = rims[j, 3] / lean
                    p0 -= far * (n0 - along * axis[0])
                    p1 -= far * (n1 - along * axis[1])
                    p2 -= far * (n2 - along * axis[2])
                    gap, n0, n1, n2 = _gap(p0, p1, p2, radius, fixed[m])
            if gap >= 0.0:
                continue
            _press(F, T, s, b, p0, p1, p2, -gap, n0, n1, n2, radius, share_of,
                   j, m, pairs, levers, slip, fade, patches)  # fmt: skip
        for i in range(j):
            if owner[i] == b:  # So are all that follow.
                break
            if mutual[i, j, 0] > 0.0:
                _meet(F, T, s, c, spheres, owner, i, j, mutual[i, j], slip)
    wb, tb, h = np.empty(3), np.empty(3), np.empty(3)
    for b in range(N):
        R = turned[b]
        w0, w1, w2 = s[b, 7], s[b, 8], s[b, 9]
        dx[b, 0] = 0.5 * (-s[b, 1] * w0 - s[b, 2] * w1 - s[b, 3] * w2)
        dx[b, 1] = 0.5 * (s[b, 0] * w0 + w1 * s[b, 3] - w2 * s[b, 2])
        dx[b, 2] = 0.5 * (s[b, 0] * w1 + w2 * s[b, 1] - w0 * s[b, 3])
        dx[b, 3] = 0.5 * (s[b, 0] * w2 + w0 * s[b, 2] - w1 * s[b, 1])
        for i in range(3):
            dx[b, 4 + i] = s[b, 10 + i]
            dx[b, 10 + i] = F[b, i] / mass[b]
        # Euler's equation in the body's axes.
        for i in range(3):
            wb[i] = R[0, i] * w0 + R[1, i] * w1 + R[2, i] * w2
            tb[i] = R[0, i] * T[b, 0] + R[1, i] * T[b, 1] + R[2, i] * T[b, 2]
        for i in range(3):
            h[i] = (
                inertia[b, i, 0] * wb[0]
                + inertia[b, i, 1] * wb[1]
                + inertia[b, i, 2] * wb[2]
            )
        tb[0] -= wb[1] * h[2] - wb[2] * h[1]
        tb[1] -= wb[2] * h[0] - wb[0] * h[2]
        tb[2] -= wb[0] * h[1] - wb[1] * h[0]
        for i in range(3):
            h[i] = (
                inverse[b, i, 0] * tb[0]
                + inverse[b, i, 1] * tb[1]
                + inverse[b, i, 2] * tb[2]
            )
        for i in range(3):
            dx[b, 7 + i] = R[i, 0] * h[0] + R[i, 1] * h[1] + R[i, 2] * h[2]


@njit(cache=True)
def _run(start, times, mass, com, inertia, inverse, gravity, spheres, owner, fixed,
         pairs, levers, rims, mutual, forces, drag, slip, fade, patches,
         max_step, tol):  # fmt: skip
    n, N = len(times), len(mass)
    out = np.full((n, N, 13), np.nan)
    s = start.copy()
    for b in range(N):
        s[b, :4] /= np.sqrt(np.sum(s[b, :4] ** 2))
        a = _matrix(s[b, :4]) @ com[b]
        s[b, 4:7] += a
        s[b, 10] += s[b, 8] * a[2] - s[b, 9] * a[1]
        s[b, 11] += s[b, 9] * a[0] - s[b, 7] * a[2]
        s[b, 12] += s[b, 7] * a[1] - s[b, 8] * a[0]
    scale = np.empty(13)
    scale[:4], scale[4:7], scale[7:10], scale[10:] = tol, 0.1 * tol, 20 * tol, tol
    k1, k2 = np.empty((N, 13)), np.empty((N, 13))
    k3, k4 = np.empty((N, 13)), np.empty((N, 13))
    t, h, steps = times[0], 1e-4, 0
    new = np.empty((N, 13))
    _rate(t, s, mass, com, inertia, inverse, gravity, spheres, owner, fixed, pairs,
          levers, rims, mutual, forces, drag, slip, fade, patches,
          k1)  # fmt: skip
    for i in range(n):
        while t < times[i] - 1e-12:
            steps += 1
            if steps > MOST_STEPS:
                return out
            h = min(h, max_step)
            step = min(h, times[i] - t)
            for b in range(N):
                for j in range(13):
                    new[b, j] = s[b, j] + 0.5 * step * k1[b, j]
            _rate(t + 0.5 * step, new, mass, com, inertia, inverse, gravity, spheres,
                  owner, fixed, pairs, levers, rims, mutual, forces,
                  drag, slip, fade, patches, k2)  # fmt: skip
            for b in range(N):
                for j in range(13):
                    new[b, j] = s[b, j] + 0.75 * step * k2[b, j]
            _rate(t + 0.75 * step, new, mass, com, inertia, inverse, gravity, spheres,
                  owner, fixed, pairs, levers, rims, mutual, forces,
                  drag, slip, fade, patches, k3)  # fmt: skip
            for b in range(N):
                for j in range(13):
                    new[b, j] = s[b, j] + step * (
                        2.0 / 9.0 * k1[b, j] + 1.0 / 3.0 * k2[b, j]
                        + 4.0 / 9.0 * k3[b, j]
                    )  # fmt: skip
            _rate(t + step, new, mass, com, inertia, inverse, gravity, spheres, owner,
                  fixed, pairs, levers, rims, mutual, forces, drag,
                  slip, fade, patches, k4)  # fmt: skip
            worst = 0.0
            for b in range(N):
                for j in range(13):
                    e = step * abs(
                        -5.0 / 72.0 * k1[b, j] + 1.0 / 12.0 * k2[b, j]
                        + 1.0 / 9.0 * k3[b, j] - 0.125 * k4[b, j]
                    ) / scale[j]  # fmt: skip
                    if not np.isfinite(e):
                        return out
                    worst = max(worst, e)
            if worst <= 1.0 or step < 1e-7:
                t += step
                s[:] = new
                k1[:] = k4
                if step == h or worst > 1.0:
                    h = step
                if step >= 0.99 * h:
                    h = step * min(3.0, 0.9 / max(worst, 1e-6) ** (1.0 / 3.0))
            else:
                h = step * max(0.2, 0.9 / worst ** (1.0 / 3.0))
        for b in range(N):
            s[b, :4] /= np.sqrt(np.sum(s[b, :4] ** 2))
            a = _matrix(s[b, :4]) @ com[b]
            w0, w1, w2 = s[b, 7], s[b, 8], s[b, 9]
            out[i, b] = s[b]
            out[i, b, 4:7] = s[b, 4:7] - a
            out[i, b, 10] = s[b, 10] - (w1 * a[2] - w2 * a[1])
            out[i, b, 11] = s[b, 11] - (w2 * a[0] - w0 * a[2])
            out[i, b, 12] = s[b, 12] - (w0 * a[1] - w1 * a[0])
    return out

"""Which effects a recording can tell apart, by computation and not by opinion.

Two effects are compared by what they ask of the motors along the recorded motion. The
distance of a rival from what is hidden is, squared,

    d^2 = min |A(p) + N n + O o - D|^2 dt / S  +  |n|^2   over p, n, o

with D the effort that the hidden effect adds, A(p) that of the rival, N what a standard
deviation of each link's mass and centre of mass adds (within the scene's tolerance they
are free), O what else is hidden (which is fitted along), and S the spectral density of
the effort's noise near zero frequency. It is the expected log-likelihood ratio, times
two, with the noise known: the square of the number of standard deviations.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from gap_benchmark.effort_laws import LOADS, added_effort, jacobians
from gap_benchmark.robot_log import Filter, Logging
from gap_benchmark.robot_world import Inverse, Track
from gap_benchmark.robots import Robot

SAME = 9.0  # d^2: three standard deviations, which nobody takes for a difference.
CLEAR = 36.0  # Six: who does not see it has missed it. Between, either may be said.
_SPACING = 0.06  # [s] of the instants at which effects are compared.

LINEAR = {
    "joint_viscous_damping": ("damping",),
    "joint_coulomb_friction": ("coulomb",),
    "joint_quadratic_drag": ("coefficient",),
    "rotor_inertia": ("inertia",),
    "joint_load_friction": ("share",),
    "joint_direction_friction": ("coulomb_plus", "coulomb_minus"),
    "link_mass": ("mass",),
    "constant_force": ("fx", "fy", "fz"),
    "body_drag": ("linear", "angular"),
    "actuator_bias": ("bias",),
    "actuator_gain": ("gain",),
    "joint_spring": ("stiffness", "rest"),
}
JOINT_KINDS = ("joint_viscous_damping", "joint_coulomb_friction",
               "joint_quadratic_drag", "rotor_inertia", "joint_load_friction",
               "joint_direction_friction", "actuator_gain", "joint_spring",
               "actuator_bias")  # fmt: skip
BODY_KINDS = ("link_mass", "payload", "link_com", "constant_force", "body_drag")


@dataclass(frozen=True)
class Rival:
    kind: str
    at: str
    parameters: dict
    distance: float  # d^2.


def sample(track: Track) -> Track:
    """The track at the instants that are compared, while something moves or not."""
    rows = slice(20, len(track.time) - 20, round(_SPACING / 0.001))
    parts = (
        track.time,
        track.q,
        track.v,
        track.a,
        track.link_q,
        track.motor,
        track.link,
    )
    return Track(*(part[rows] for part in parts), {})


def noise_density(robot: Robot, track: Track, how: Logging) -> np.ndarray:
    """(n,) two-sided density near zero frequency of the effort's noise [(N m)^2 s]: the
    sensor's, and what the positions' noise makes of the acceleration at 3 Hz."""
    n = len(robot.joints)
    dt = 1.0 / how.rate_hz
    effort = np.broadcast_to(how.effort_noise, n) ** 2 * dt
    effort = effort + 2.0 * np.broadcast_to(how.wander, n) ** 2 * how.memory
    if not how.side:
        effort = np.zeros(n)
    still = max(how.position_noise, how.quantum / np.sqrt(12.0))
    M = Inverse(robot).mass_diagonal(np.median(track.q, axis=0))
    return effort + (M * (2 * np.pi * 3.0) ** 2 * still) ** 2 * dt


def _nuisances(robot: Robot, track: Track, mass: float, com: float) -> np.ndarray:
    """(columns, k, n)."""
    out = []
    for body in robot.bodies:
        at = f"{robot.model}.{body.name}"
        ways = [("link_mass", {"mass": mass * body.mass})]
        for axis in range(3):
            move = dict(zip("xyz", com * np.eye(3)[axis], strict=True))
            ways.append(("link_com", move))
        for kind, p in ways:
            effect = {"kind": kind, "at": at, "parameters": p}
            out.append(added_effort(robot, effect, track))
    return np.array(out)


def _columns(robot: Robot, kind: str, at: str, track: Track):
    """(columns, k, n) of a kind that is linear in its parameters; None: it is not."""
    if kind not in LINEAR:
        return None
    if kind == "actuator_gain":  # Of 1/gain - 1.
        effect = {"kind": kind, "at": at, "parameters": {"gain": 0.5}}
        return added_effort(robot, effect, track)[None]
    if kind == "joint_spring":  # Of stiffness, and of -stiffness x rest.
        p = {"stiffness": 1.0, "rest": 0.0}
        effect = {"kind": kind, "at": at, "parameters": p}
        along = added_effort(robot, effect, track)
        still = np.zeros_like(along)
        still[:, robot.joint(at)] = 1.0
        return np.array([along, still])
    out = []
    for name in LINEAR[kind]:
        p = dict.fromkeys(LINEAR[kind], 0.0)
        p[name] = 0.01 if kind == "link_mass" else 1.0
        effect = {"kind": kind, "at": at, "parameters": p}
        out.append(added_effort(robot, effect, track) / p[name])
    return np.array(out)


def _values(kind: str, p) -> dict[str, float]:
    """The parameters of the columns' factors."""
    if kind == "actuator_gain":
        return {"gain": 1.0 / max(1.0 + float(p[0]), 0.01)}
    if kind == "joint_spring":
        return {"stiffness": float(p[0]), "rest": float(-p[1] / (p[0] or 1.0))}
    return dict(zip(LINEAR[kind], map(float, p), strict=True))


def _vector(name: str) -> str:
    """What belongs together: com_x with com_y, x with y, fx with fy."""
    if name in ("x", "y", "z", "roll", "pitch"):
        return "vector"
    return name[:-1] if name in ("com_x", "com_y", "com_z", "fx", "fy", "fz") else name


class Comparison:
    """A robot along a motion, its noise, and what is hidden in it."""

    def __init__(self, robot: Robot, track: Track, how: Logging, mass, com):
        self.robot, self.track = robot, sample(track)
        # Where a joint rests, dry friction may be anything: nobody can judge by it.
        moves = np.abs(self.track.v) > 0.01 * robot.fastest
        density = noise_density(robot, self.track, how)
        self.weight = np.where(moves, 1.0, 1e-3) * np.sqrt(_SPACING / density)
        n = _nuisances(robot, self.track, mass, com)
        self.nuisances = self._flat(n)
        self._known: dict = {}

    def _columns(self, kind: str, at: str):
        key = (kind, at)
        if key not in self._known:
            self._known[key] = _columns(self.robot, kind, at, self.track)
        return self._known[key]

    def _flat(self, efforts) -> np.ndarray:
        """(k n, columns), in units of noise."""
        efforts = np.asarray(efforts) * self.weight
        return efforts.reshape(len(efforts), self.weight.size).T

    def _projector(self, others: np.ndarray):
        """Of a vector to what is left of it, and what that costs, as one vector."""
        N = np.hstack([self.nuisances, others])
        prior = np.r_[np.ones(self.nuisances.shape[1]), np.full(others.shape[1], 1e-6)]
        left = np.linalg.solve(N.T @ N + np.diag(prior), N.T)

        def project(x):
            n = left @ x
            return np.vstack([x - N @ n, np.sqrt(prior)[:, None] * n])

        return project

    def of_others(self, effects) -> np.ndarray:
        """(k n, columns) of hidden effects that are fitted along."""
        found = [np.zeros((0, *self.track.q.shape))]
        for e in effects:
            for at in [e["at"]] if isinstance(e["at"], str) else e["at"]:
                columns = self._columns(e["kind"], at)
                if columns is None:  # About its value.
                    columns = added_effort(self.robot, e, self.track)[None]
                found.append(columns)
        return self._flat(np.concatenate(found))

    def size(self, effort: np.ndarray, others=()) -> float:
        """d^2 of saying nothing."""
        project = self._projector(self.of_others(others))
        return float((project(self._flat(effort[None])) ** 2).sum())

    def loose(self, effect: dict, others=()) -> list[str]:
        """The parameters that the recording does not tell to 30 %, of the vector that
        they belong to: a centre of mass along an axis that is always vertical."""
        p = effect["parameters"]
        if len(p) == 1:  # As well known as the effect is seen.
            return []
        columns = []
        for name, value in p.items():
            step = 1e-3 * max(abs(value), 0.01)
            up, down = (effect | {"parameters": p | {name: value + side * step}}
                        for side in (1.0, -1.0))  # fmt: skip
            columns.append(
                added_effort(self.robot, up, self.track)
                - added_effort(self.robot, down, self.track)
            )
            columns[-1] = columns[-1] / (2.0 * step)
        J = self._projector(self.of_others(others))(self._flat(np.array(columns)))
        u, size, v = np.linalg.svd(J, full_matrices=False)
        size = np.maximum(size, 1e-9 * size.max())
        std = np.sqrt((v**2 / size[:, None] ** 2).sum(axis=0))
        whole = {}
        for name in p:
            vector = [abs(p[k]) for k in p if _vector(k) == _vector(name)]
            whole[name] = float(np.linalg.norm(vector)) or 1.0
        return [k for k, s in zip(p, std, strict=True) if s > 0.3 * whole[k]]

    def rivals(self, effort, places, others=(), near=CLEAR) -> list[Rival]:
        """Effects of `places` [(kind, at)] whose d^2 from `effort` (k, n) is below
        `near`, the nearest first, with the parameters that come nearest."""
        project = self._projector(self.of_others(others))
        target = project(self._flat(effort[None]))
        found = []
        for kind, at in places:
            columns = self._columns(kind, at)
            if columns is not None:
                A = project(self._flat(columns))
                p, *_ = np.linalg.lstsq(A, target[:, 0], rcond=None)
                distance = float(((A @ p - target[:, 0]) ** 2).sum())
                values = _values(kind, p)
            elif kind == "payload" and self._least(at, project, target) > near:
                continue
            else:
                values, distance = self._curved(kind, at, project, target)
            if distance < near:
                found.append(Rival(kind, at, values, distance))
        return sorted(found, key=lambda r: r.distance)

    def _least(self, at, project, target) -> float:
        """The least d^2 that a payload could have if its inertia were as free as its
        mass: ten points span what a body can be."""
        key = ("ten points", at)
        if key not in self._known:
            places = 0.1 * np.vstack(
                [np.zeros(3), np.eye(3), -np.eye(3), 1 - np.eye(3)]
            )
            self._known[key] = np.array([
                added_effort(
                    self.robot,
                    {"kind": "payload", "at": at,
                     "parameters": {"mass": 0.1, "com_x": x, "com_y": y, "com_z": z}},
                    self.track,
                )
                for x, y, z in places
            ])  # fmt: skip
        A = project(self._flat(self._known[key]))
        p, *_ = np.linalg.lstsq(A, target[:, 0], rcond=None)
        return float(((A @ p - target[:, 0]) ** 2).sum())

    def _curved(self, kind, at, project, target):
        robot, track = self.robot, self.track
        body = None
        if kind in LOADS:
            body = robot.bodies[robot.body(at)]
            names = ("mass", "com_x", "com_y", "com_z")
            start = [0.3, *body.com]
            if kind == "link_com":
                names, start = ("x", "y", "z"), [0.0, 0.0, 0.0]
            steps = np.array([0.1, 0.05, 0.05, 0.05][: len(names)])
        else:
            return self._sine(at, project, target)

        def effect_of(x):
            p = dict(zip(names, map(float, x), strict=True))
            return {"kind": kind, "at": at, "parameters": p}

        def residual(x):
            try:
                effort = added_effort(robot, effect_of(x), track)
            except ValueError:  # No body has such an inertia.
                return np.full(len(target), 1e3)
            return project(self._flat(effort[None]))[:, 0] - target[:, 0]

        starts = [start]
        if kind == "payload":  # It may be too much as well.
            starts.append([-0.3 * min(body.mass, 1.0), *body.com])
        fits = [
            least_squares(residual, x, x_scale=steps, diff_step=1e-3, max_nfev=25)
            for x in starts
        ]
        best = min(fits, key=lambda fit: fit.cost)
        return effect_of(best.x)["parameters"], 2.0 * float(best.cost)

    def _sine(self, at, project, target):
        """At the frequency that is hidden; its phases by axis may differ here."""
        jac_p, _, _ = jacobians(self.robot, at, self.track.q)
        angle = 2 * np.pi * self.frequency * self.track.time
        waves = [np.sin(angle), np.cos(angle)]
        columns = [-w[:, None] * jac_p[:, i] for w in waves for i in range(3)]
        A = project(self._flat(np.array(columns)))
        p, *_ = np.linalg.lstsq(A, target[:, 0], rcond=None)
        distance = float(((A @ p - target[:, 0]) ** 2).sum())
        in_, out = p[:3], p[3:]
        way = np.linalg.svd(np.array([in_, out]))[2][0]
        a, b = float(way @ in_), float(way @ out)
        force, phase = np.hypot(a, b) * way, float(np.arctan2(b, a))
        values = dict(zip(("fx", "fy", "fz"), map(float, force), strict=True))
        return values | {"frequency": self.frequency, "phase": phase}, distance

    frequency = 1.0


def places_of(robot: Robot, kind: str) -> list[tuple[str, str]]:
    """Where and what a rival of an effect of this kind may be."""
    joints = robot.joints
    if kind == "servo_gain":
        kind = "actuator_gain"
    bodies = [f"{robot.model}.{body.name}" for body in robot.bodies]
    if kind in JOINT_KINDS:
        return [(k, at) for k in JOINT_KINDS for at in joints]
    if kind == "sinusoidal_force":
        return [(kind, at) for at in bodies]
    if kind in BODY_KINDS:  # What acts on a link near the base may be one joint's.
        return [(k, at) for k in BODY_KINDS for at in bodies] + [
            (k, at) for k in JOINT_KINDS for at in joints
        ]
    return []


def velocity_rivals(filter_: Filter, declared: float, track: Track, how: Logging):
    """[Rival] of kinds sensor_lag and sensor_delay for velocities that are filtered,
    beyond a filter that is declared to have a delay of `declared` [s]: how far the best
    lag and the best delay are from what the filter does to this motion."""
    v = track.v
    true = filter_(v)
    grid = np.linspace(0.3, 1.7, 57) * (filter_.delay() - declared)
    density = how.velocity_noise**2 / how.rate_hz
    known = Filter("first order", 1 / (2 * np.pi * declared)) if declared > 0 else None
    base = known(v) if known else v
    out = []
    for kind in ("sensor_lag", "sensor_delay"):
        best = (np.inf, 0.0)
        for size in grid:
            if kind == "sensor_lag" and size > 0:
                seen = Filter("first order", 1 / (2 * np.pi * size))(base)
            else:
                at = track.time - size
                seen = np.column_stack(
                    [np.interp(at, track.time, column) for column in base.T]
                )
            d = float(((seen - true) ** 2).sum() * 0.001 / density)
            best = min(best, (d, float(size)))
        name = "time_constant" if kind == "sensor_lag" else "delay"
        out.append(Rival(kind, "", {name: best[1]}, best[0]))
    return sorted(out, key=lambda r: r.distance)


def without_rotors(robot: Robot) -> Robot:
    return replace(robot, bodies=tuple(replace(b, rotor=0.0) for b in robot.bodies))

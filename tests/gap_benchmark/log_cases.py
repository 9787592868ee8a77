"""Logs as a stranger would bring them: which robot, what is hidden, how it is logged.

    python tests/gap_benchmark/log_cases.py --set logs-final --out DIR --truth FILE

writes a folder for each case (scene.yaml, the robot's URDF, recording.csv, mostly a
sidecar) under DIR, and what is hidden into FILE, which must lie elsewhere. The sets
logs-development and logs-final have the same sorts of cases; robot, sizes, places,
rates, filters and motions are drawn, from seeds that they do not share.
"""

import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml

if __name__ == "__main__":  # The package is found beside the tests.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gap_benchmark.effort_laws import added_effort
from gap_benchmark.maker import make_cases
from gap_benchmark.mechanism import quaternion, rotation
from gap_benchmark.motions import MOTIONS
from gap_benchmark.robot_log import Filter, Logging, write_log
from gap_benchmark.robot_world import (
    Drive,
    Inverse,
    Push,
    RobotWorld,
    Track,
)
from gap_benchmark.robots import ROBOTS, Robot, to_urdf, within_tolerance
from gap_benchmark.ties import (
    CLEAR,
    JOINT_KINDS,
    SAME,
    Comparison,
    Rival,
    places_of,
    velocity_rivals,
    without_rotors,
)
from gap_benchmark.two_link import TwoLinkWorld

SEEDS = {"logs-development": 210_000, "logs-final": 530_000}
_QUANTUM = 2 * np.pi / 4096  # [rad], of such servos.
LINK_MASS, LINK_COM = 0.03, 0.002  # The scene's tolerance, one sigma [-], [m].

# Of each joint: Coulomb friction [N m, or N], and viscous [N m s/rad] as its share of
# that at 1 rad/s.
COULOMB = {
    "panda": [(0.15, 0.9)] * 4 + [(0.1, 0.5)] * 3,
    "six": [(6.0, 14.0)] * 3 + [(1.5, 4.0)] * 3,
    "scara": [(0.6, 1.5), (0.4, 1.0), (4.0, 9.0), (0.06, 0.15)],
    "servo": [(0.03, 0.08)] * 5,
    "planar": [(0.15, 0.4), (0.1, 0.3)],
}
NOISE = {"panda": 0.04, "six": 0.6, "scara": 0.08, "servo": 0.01, "planar": 0.02}
SECONDS = {"panda": 24.0, "six": 30.0, "scara": 24.0, "servo": 30.0, "planar": 20.0}


@dataclass(frozen=True)
class Recipe:
    """A sort of case. hide: names of HIDE. log: what Logging has other than drawn.
    hand: in the nominal robot. options: see _draw."""

    name: str
    robots: str
    motions: str = "multisine pick guided"
    hide: str = ""
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class LogCase:
    name: str
    seed: int
    recipe: Recipe

    @property
    def folder(self) -> str:
        """A name that does not tell."""
        return f"log_{self.seed}"


@dataclass
class Drawn:
    """What a case is made of, while it is drawn."""

    rng: np.random.Generator
    sort: str  # Of robot.
    nominal: Robot
    true: Robot
    drive: Drive
    how: Logging
    effects: list[dict] = field(default_factory=list)
    replaced: Callable[[Robot], Robot] | None = None  # Instead of simulating effects.
    declared: Filter | None = None  # In the sidecar.
    push: Push | None = None
    ode: bool = False  # The world of two_link.py.


@dataclass(frozen=True)
class WrittenLog:
    columns: dict[str, np.ndarray]
    scene: str
    urdf: str
    sidecar: dict
    truth: dict
    track: Track


RECIPES = [
    # ----- Nothing is hidden: links within tolerance, and what a log is like.
    Recipe("none_clean", "panda"),
    Recipe("none_held_jitter", "panda six", options=("held",)),
    Recipe("none_wandering_noise", "panda six", options=("wander",)),
    Recipe("none_first_order_declared", "panda planar", options=("first order",)),
    Recipe("none_butterworth_declared", "six scara", options=("Butterworth",)),
    Recipe("none_average_declared", "panda planar", options=("moving average",)),
    Recipe("none_difference_declared", "scara six", options=("backward difference",)),
    Recipe("none_coarse_servo", "servo", options=("coarse",)),
    Recipe("none_push", "panda six", options=("push",)),
    Recipe("none_ramps", "six scara", "ramps"),
    # ----- All joints at once.
    Recipe("friction_all", "panda", hide="friction"),
    Recipe("friction_all_held", "panda", hide="friction", options=("held",)),
    Recipe("friction_all_wandering", "panda", "pick guided", "friction", ("wander",)),
    Recipe("friction_all_current", "six", hide="friction"),
    Recipe("friction_all_ramps", "scara panda", "ramps", "friction"),
    Recipe("friction_all_servo", "servo", hide="friction", options=("coarse",)),
    Recipe("friction_all_declared", "panda", hide="friction", options=("first order",)),
    Recipe("rotors_missing_friction", "six", hide="rotors friction", options=("bare",)),
    Recipe("rotors_missing", "planar scara", hide="rotors", options=("bare",)),
    Recipe("rotors_link_side", "panda scara", hide="no_rotors", options=("link side",)),
    # ----- A hand, a load, a link.
    Recipe("hand_missing", "panda", hide="hand_missing friction", options=("hand",)),
    Recipe("hand_missing_plain", "six scara", hide="hand_missing", options=("hand",)),
    Recipe("hand_unknown", "panda", hide="hand_unknown friction", options=("held",)),
    Recipe("hand_unknown_plain", "scara six", hide="hand_unknown"),
    Recipe("link_mass", "panda", hide="link_mass"),
    Recipe("link_mass_industrial", "six", hide="link_mass"),
    Recipe("link_com", "panda six", hide="link_com"),
    Recipe("payload_any_link", "panda", hide="payload"),
    Recipe("payload_any_link_coarse", "six scara", hide="payload", options=("coarse",)),
    # ----- Forces on any link.
    Recipe("drag_any_link", "panda scara", "multisine pick", "body_drag"),
    Recipe("drag_any_link_held", "six planar", "multisine", "body_drag", ("held",)),
    Recipe("force_any_link", "panda six", hide="constant_force"),
    Recipe("sine_any_link", "panda six", hide="sinusoidal_force"),
    Recipe("sine_any_link_slow", "scara six", "ramps guided", "sinusoidal_force"),
    # ----- Sensors.
    Recipe("lag_undeclared", "panda planar", options=("first order", "undeclared")),
    Recipe("butterworth_undeclared", "six panda",
           options=("Butterworth", "undeclared")),
    Recipe("average_undeclared", "scara panda",
           options=("moving average", "undeclared")),
    Recipe("declared_too_fast", "panda six", options=("first order", "too fast")),
    Recipe("declared_in_vain", "planar panda", options=("first order", "in vain")),
    Recipe("lag_undeclared_held", "panda",
           options=("first order", "undeclared", "held")),
    # ----- A push in the middle of something else.
    Recipe("push_friction", "panda", hide="friction", options=("push",)),
    Recipe("push_payload", "six panda", hide="payload", options=("push",)),
    # ----- Drives, gears, one joint.
    Recipe("current_gain", "six", hide="gain"),
    Recipe("current_gain_friction", "six panda", hide="gain friction"),
    Recipe("coulomb_one_joint", "planar panda", hide="coulomb"),
    Recipe("direction_friction", "six panda", hide="direction_friction"),
    Recipe("ripple_one_joint", "panda scara", hide="ripple"),
    Recipe("spring_one_joint", "planar panda", hide="spring"),
    # ----- Servos.
    Recipe("servo_gain", "servo", hide="servo_gain", options=("coarse",)),
    Recipe("servo_backlash", "servo", hide="backlash", options=("coarse",)),
    Recipe("servo_load_friction", "servo", hide="load_friction", options=("coarse",)),
    Recipe("servo_payload", "servo", hide="payload", options=("coarse",)),
    Recipe("servo_gain_friction", "servo", "multisine pick", "servo_gain friction",
           ("coarse",)),
    # ----- Commanded speeds.
    Recipe("none_velocity_drive", "scara six", options=("velocity drive",)),
    Recipe("friction_velocity_drive", "scara six", hide="friction",
           options=("velocity drive",)),
    # ----- Gears.
    Recipe("load_friction", "six panda", hide="load_friction"),
    Recipe("elasticity", "scara panda", "multisine pick", "elasticity"),
    Recipe("backlash", "scara planar", "multisine pick", "backlash"),
    # ----- Commands beside what was measured.
    Recipe("effort_sensor_bias", "panda scara", hide="effort_bias",
           options=("commands",)),
    Recipe("saturation", "planar scara", "multisine pick", "saturation",
           ("commands", "unmeasured")),
    Recipe("clocks_apart", "planar panda", "multisine pick", "skew",
           ("commands", "unmeasured")),
    Recipe("late_states", "scara panda", "multisine pick", "late",
           ("commands", "unmeasured")),
    # ----- Lagrange's equations instead of MuJoCo.
    Recipe("ode_none", "planar", options=("ode",)),
    Recipe("ode_friction", "planar", hide="friction", options=("ode",)),
    Recipe("ode_quadratic_drag", "planar", "multisine pick", "quadratic_drag",
           ("ode",)),
    Recipe("ode_load", "planar", hide="payload", options=("ode",)),
]  # fmt: skip


def cases(which: str, seed: int | None = None) -> list[LogCase]:
    """All cases of a set; seed: of the first one, where it is not the set's own."""
    first = SEEDS[which] if seed is None else seed
    return [
        LogCase(f"{i:02d}_{r.name}", first + 7 * i, r) for i, r in enumerate(RECIPES)
    ]


# ----- Sizes


@dataclass(frozen=True)
class Demand:
    """Of the nominal robot on its motion (n,): rms and peak of effort, rms of v."""

    effort: np.ndarray
    most: np.ndarray
    v: np.ndarray


def _hidden(name: str, d: Drawn, s: Demand) -> list[dict]:
    """Effects of a name of a recipe, with sizes that such robots have."""
    rng, robot = d.rng, d.nominal
    joints, n = robot.joints, len(robot.joints)
    low, high = np.array(COULOMB[d.sort]).T

    def one(kind, at, **p):
        values = {k: float(x) for k, x in p.items()}
        return {"kind": kind, "at": at, "parameters": values}

    def any_joint():
        return int(rng.integers(n))

    def any_body():
        return f"{robot.model}.{rng.choice([b.name for b in robot.bodies])}"

    sign = float(rng.choice([-1.0, 1.0]))
    if name == "friction":
        c = low * (high / low) ** rng.uniform(size=n)
        b = c * rng.uniform(0.3, 1.2, n)
        return [one("joint_coulomb_friction", joints[i], coulomb=c[i])
                for i in range(n)] + [
                one("joint_viscous_damping", joints[i], damping=b[i])
                for i in range(n)]  # fmt: skip
    if name == "rotors":  # d.true has them, the scene has not.
        return [one("rotor_inertia", joints[i], inertia=body.rotor)
                for i, body in enumerate(d.true.moving)]  # fmt: skip
    if name == "no_rotors":
        return [one("rotor_inertia", joints[i], inertia=-body.rotor)
                for i, body in enumerate(robot.moving)]  # fmt: skip
    if name == "hand_missing":
        at = f"{robot.model}.hand"
        mass = robot.bodies[robot.body(at)].mass
        d.replaced = lambda true: true.without_body(at)
        return [one("link_mass", at, mass=-mass)]
    if name == "hand_unknown":
        donor = ROBOTS[d.sort](rng, True)
        hand = donor.bodies[-1]
        at = f"{robot.model}.{robot.bodies[-1].name}"
        R = rotation(quaternion(hand.rpy))
        place = np.array(hand.xyz) + R @ np.array(hand.com)
        d.replaced = lambda true: replace(true, bodies=(*true.bodies, hand))
        return [one("payload", at, mass=hand.mass, com_x=place[0], com_y=place[1],
                    com_z=place[2])]  # fmt: skip
    if name == "link_mass":
        at = any_body()
        f = rng.choice([rng.uniform(-0.5, -0.3), rng.uniform(0.3, 0.6)])
        return [one(name, at, mass=f * robot.bodies[robot.body(at)].mass)]
    if name == "link_com":
        way = rng.normal(size=3)
        way *= rng.uniform(0.02, 0.04) / np.linalg.norm(way)
        return [one(name, any_body(), x=way[0], y=way[1], z=way[2])]
    if name == "payload":
        place = rng.uniform(-0.06, 0.06, 3)
        if d.sort == "planar":
            place[1] = 0.0
        scale = {"panda": 1.2, "six": 3.0, "scara": 0.5, "planar": 0.3, "servo": 0.15}[
            d.sort
        ]
        return [one(name, any_body(), mass=scale * rng.uniform(0.6, 1.4),
                    com_x=place[0], com_y=place[1], com_z=place[2])]  # fmt: skip
    if name == "body_drag":
        scale = {"panda": 5.0, "six": 30.0, "scara": 4.0, "planar": 0.6}[d.sort]
        return [one(name, any_body(), linear=scale * rng.uniform(0.7, 1.6),
                    angular=0.0)]  # fmt: skip
    if name in ("constant_force", "sinusoidal_force"):
        scale = {"panda": 6.0, "six": 25.0, "scara": 5.0}[d.sort]
        force = rng.normal(size=3)
        force *= scale * rng.uniform(0.7, 1.4) / np.linalg.norm(force)
        p = dict(zip(("fx", "fy", "fz"), force, strict=True))
        if name == "sinusoidal_force":
            p |= {"frequency": rng.uniform(0.7, 3.0), "phase": rng.uniform(0, 6.28)}
        return [one(name, any_body(), **p)]
    i = any_joint()
    if name == "gain":
        i = int(rng.choice([1, 2])) if d.sort == "six" else int(rng.choice([1, 3]))
        gain = 1.0 + sign * rng.uniform(0.1, 0.2)
        d.how = replace(d.how, effort_gain=1.0 + (gain - 1.0) * np.eye(n)[i])
        return [one("actuator_gain", joints[i], gain=gain)]
    f = rng.uniform(1.0, 1.6) * high[i]
    if name == "coulomb":
        return [one("joint_coulomb_friction", joints[i], coulomb=f)]
    if name == "direction_friction":
        return [one("joint_direction_friction", joints[i], coulomb_plus=f,
                    coulomb_minus=f * rng.uniform(0.35, 0.6))]  # fmt: skip
    if name == "ripple":
        return [one("torque_ripple", joints[i], amplitude=0.7 * f,
                    periods_per_rev=float(rng.integers(6, 17)),
                    phase=rng.uniform(0, 6.28))]  # fmt: skip
    if name == "spring":
        return [one("joint_spring", joints[i], stiffness=1.5 * f / robot.reach[i],
                    rest=robot.middle[i] + rng.uniform(-0.3, 0.3))]  # fmt: skip
    if name == "quadratic_drag":
        return [one("joint_quadratic_drag", joints[i],
                    coefficient=0.25 * s.effort[i] / s.v[i] ** 2)]  # fmt: skip
    if name == "load_friction":
        i = int(np.argsort(-s.effort)[rng.integers(2)])
        return [one("joint_load_friction", joints[i], share=rng.uniform(0.12, 0.3))]
    if name == "servo_gain":
        f = rng.choice([rng.uniform(0.7, 0.85), rng.uniform(1.2, 1.4)])
        return [one(name, joints[i], kp=f * d.drive.kp[i])]
    if name == "saturation":
        i = int(rng.integers(2))
        peak = rng.uniform(0.6, 0.8) * s.most[i]
        return [one("actuator_saturation", joints[i], limit=peak)]
    if name == "effort_bias":
        d.how = replace(d.how, effort_bias=sign * f * np.eye(n)[i])
        at = f"{joints[i]}.effort_measured"
        return [one("sensor_bias", at, bias=sign * f)]
    if name == "skew":
        skew = sign * rng.uniform(1e-3, 3e-3)
        d.how = replace(d.how, skew=skew)
        return [one("clock_skew", robot.model, skew=skew)]
    if name == "late":
        d.how = replace(d.how, delay=float(rng.uniform(0.012, 0.03)))
        return [one("sensor_delay", robot.model, delay=d.how.delay)]
    if name == "backlash":
        i = int(rng.integers(2)) if d.sort != "servo" else int(rng.integers(1, 3))
        gap = rng.uniform(0.03, 0.06) if d.sort == "servo" else rng.uniform(0.015, 0.04)
        return [one("joint_backlash", joints[i], gap=gap)]
    if name == "elasticity":
        i = int(rng.integers(2))
        beyond = Inverse(without_rotors(robot)).mass_diagonal(robot.middle)[i]
        w = 2 * np.pi * rng.uniform(4.0, 8.0)
        return [one("joint_elasticity", joints[i], stiffness=beyond * w**2,
                    damping=0.1 * beyond * w)]  # fmt: skip
    raise ValueError(f"no size for {name}")


# ----- How it is logged


def _logging(d: Drawn, options: tuple[str, ...]) -> None:
    rng = d.rng
    panda = d.sort == "panda"
    rate = float(rng.choice([1000.0, 500.0] if panda else [100.0, 125.0, 200.0, 500.0]))
    if d.sort == "servo":
        rate = 50.0
    if d.sort == "six" and "first order" not in options:
        rate = float(rng.choice([100.0, 125.0]))
    if "held" in options:
        rate = 1000.0 if panda else rate
    size = np.array([high for _, high in COULOMB[d.sort]])
    effort_noise = NOISE[d.sort] * rng.uniform(0.6, 1.5) * size / size.max()
    d.how = replace(
        d.how,
        rate_hz=rate,
        position_noise=float(10 ** rng.uniform(-5.0, -4.3)),
        velocity_noise=float(10 ** rng.uniform(-2.8, -2.2)),
        effort_noise=effort_noise,
    )
    if "held" in options:
        d.how = replace(d.how, held=0.06, jitter=float(rng.uniform(1e-4, 3e-4)))
    elif rng.uniform() < 0.3:
        d.how = replace(d.how, jitter=float(rng.uniform(0.5e-4, 2e-4)))
    if "wander" in options:
        d.how = replace(
            d.how, wander=effort_noise * rng.uniform(1.0, 2.5),
            memory=float(rng.uniform(0.1, 0.5)),
        )  # fmt: skip
    if "coarse" in options:
        d.how = replace(d.how, quantum=_QUANTUM if d.sort == "servo" else 3e-4)
    if "link side" in options:
        d.how = replace(d.how, side="link")
    kinds = ("first order", "Butterworth", "moving average", "backward difference")
    for kind in kinds:
        if kind not in options:
            continue
        size = round(float(rng.uniform(8.0, 30.0)), 1)
        order = 1
        if kind == "Butterworth":
            order = int(rng.choice([2, 4]))
            size = round(float(rng.uniform(12.0, 35.0)), 1)
        elif kind == "moving average":
            size = float(rng.choice([0.01, 0.02, 0.03]))
        actual = declared = Filter(kind, size, order)
        if "undeclared" in options:
            declared = None
        elif "too fast" in options:
            declared = Filter(
                kind, round(size * float(rng.uniform(2.5, 4.0)), 1), order
            )
        elif "in vain" in options:
            actual = Filter()
        d.how, d.declared = replace(d.how, filter=actual), declared


def _draw(case: LogCase) -> tuple[Drawn, object]:
    recipe = case.recipe
    rng = np.random.default_rng(case.seed)
    sort = str(rng.choice(recipe.robots.split()))
    nominal = ROBOTS[sort](rng, "hand" in recipe.options)
    true = nominal
    if "bare" in recipe.options:  # As its URDF came: without motors.
        nominal = without_rotors(nominal)
    n = len(nominal.joints)
    drive = Drive()
    if sort == "servo":
        # A hobby servo at 12 V: back-EMF brakes it, its ceiling falls with speed.
        kt, resistance = float(rng.uniform(1.0, 1.4)), float(rng.uniform(3.5, 5.0))
        drive = Drive(
            "servo", 0.02, np.full(n, float(rng.uniform(7.0, 12.0))), np.zeros(n),
            float(rng.uniform(2.0, 2.9)), 12.0, kt, resistance,
            float(rng.choice([0.0, 0.003])), _QUANTUM,
        )  # fmt: skip
    elif "velocity drive" in recipe.options:
        M = Inverse(nominal).mass_diagonal(nominal.middle)
        limit = 2.0 * max(body.effort for body in nominal.moving)
        drive = Drive("velocity", 0.01, np.zeros(n), 60.0 * M, limit)
    d = Drawn(rng, sort, nominal, true, drive, Logging())
    _logging(d, recipe.options)
    if sort == "servo":
        d.how = replace(d.how, side="", with_command=True)
    elif drive.type == "velocity":
        d.how = replace(d.how, side="", with_command=True, rate_hz=100.0)
    elif "commands" in recipe.options:
        rate = float(rng.choice([200.0, 250.0]))
        side = "" if "unmeasured" in recipe.options else "motor"
        d.how = replace(d.how, side=side, with_command=True, rate_hz=rate, jitter=0.0)
        drive = d.drive = replace(drive, period=1.0 / rate)
    d.ode = "ode" in recipe.options
    motion = MOTIONS[str(rng.choice(recipe.motions.split()))](
        nominal, SECONDS[sort], 0.001, rng
    )
    still = slice(0, None, 40)
    effort = Inverse(nominal)(motion.q[still], motion.v[still], motion.a[still])

    def rms(x):
        return np.sqrt(np.mean(x**2, axis=0))

    stats = Demand(rms(effort), np.abs(effort).max(axis=0), rms(motion.v))
    for name in recipe.hide.split():
        d.effects += _hidden(name, d, stats)
    if "push" in recipe.options:
        bodies = nominal.bodies[len(nominal.bodies) // 2 :]
        force = rng.normal(size=3)
        force *= {"panda": 25.0, "six": 60.0}[sort] / np.linalg.norm(force)
        d.push = Push(
            f"{nominal.model}.{rng.choice([b.name for b in bodies])}",
            float(rng.uniform(0.3, 0.6) * SECONDS[sort]), float(rng.uniform(0.8, 1.3)),
            tuple(map(float, force)),
        )  # fmt: skip
    d.true = within_tolerance(d.true, rng, LINK_MASS, LINK_COM)
    return d, motion


def _simulated(d: Drawn, motion) -> Track:
    """Rotors and hands are in the numbers of the true robot, all else in the world."""
    effects = [e for e in d.effects if e["kind"] != "rotor_inertia"]
    true = d.true
    if d.replaced is not None:
        true = d.replaced(true)
        effects = [e for e in effects if e["kind"] not in ("payload", "link_mass")]
    if d.ode:
        return TwoLinkWorld(d.nominal, true, effects).run(motion)
    return RobotWorld(d.nominal, true, effects, d.drive, d.push).run(motion)


def _difference(d: Drawn, effect: dict, track: Track) -> np.ndarray:
    """(k, n) what a hidden effect adds to the effort."""
    if effect["kind"] == "servo_gain":  # Beside what the drive's law says.
        i = d.nominal.joint(effect["at"])
        brake = d.drive.kt**2 / d.drive.resistance * track.v[:, i]
        out = np.zeros_like(track.q)
        has = effect["parameters"]["kp"]
        out[:, i] = (d.drive.kp[i] / has - 1.0) * (track.motor[:, i] + brake)
        return out
    if d.replaced is not None and effect["kind"] in ("payload", "link_mass"):
        q, v, a = track.q, track.v, track.a
        return Inverse(d.replaced(d.nominal))(q, v, a) - Inverse(d.nominal)(q, v, a)
    return added_effort(d.nominal, effect, track)


# Not laws of effort along the motion that was measured.
_BEYOND = ("joint_elasticity", "joint_backlash", "actuator_saturation", "sensor_bias",
           "sensor_delay", "clock_skew")  # fmt: skip


def _known_rivals(effect: dict, d: Drawn) -> list[dict]:
    """What says the same by definition."""
    if effect["kind"] == "sensor_delay":  # Nobody but the robot's own loop sees them.
        return [{"kind": "input_delay", "at": effect["at"],
                 "parameters": effect["parameters"], "d2": 0.0}]  # fmt: skip
    return []


def _as_payload(robot: Robot, hidden: dict) -> list[Rival]:
    """A hand that is not there, as a negative payload on it or on what it is welded to:
    one rigid body. (That its mass is no point is told by a tenth of a sigma or by ten,
    and a payload has no inertia of its own to say it with.)"""
    hand = robot.bodies[-1]
    R = rotation(quaternion(hand.rpy))
    before = robot.bodies[-2].name
    flange = np.array(hand.xyz) + R @ np.array(hand.com)
    places = {hidden["at"]: np.array(hand.com), f"{robot.model}.{before}": flange}
    return [
        Rival(
            "payload", at,
            {"mass": -hand.mass} | dict(
                zip(("com_x", "com_y", "com_z"), map(float, place), strict=True)
            ), 0.0,
        )
        for at, place in places.items()
    ]  # fmt: skip


def _judged(d: Drawn, track: Track) -> dict:
    """What is hidden with what cannot be told from it, and the right verdicts."""
    how = d.how
    if not how.side:
        # The drive's law tells the effort, with the noise of what it is told by.
        step = max(how.position_noise, how.quantum / np.sqrt(12.0))
        noise = d.drive.kp * step + d.drive.kd * how.velocity_noise
        how = replace(how, side="motor", effort_noise=noise if noise.size else 1e-3)
    judge = Comparison(d.nominal, track, how, LINK_MASS, LINK_COM)
    few = judge.track
    effects: list[dict] = []
    tied, maybe = 0, False
    of_effort = [e for e in d.effects if e["kind"] not in _BEYOND]
    for effect in d.effects:
        if effect not in of_effort:
            effects.append(
                effect | {"needed": True, "equivalents": _known_rivals(effect, d)}
            )
            continue
        others = [e for e in of_effort if e is not effect and e["kind"] != "servo_gain"]
        effort = _difference(d, effect, few)
        size = judge.size(effort, others)
        if effect["kind"] == "sinusoidal_force":
            judge.frequency = effect["parameters"]["frequency"]
        places = places_of(d.nominal, effect["kind"])
        # Friction, rotors: rivals only where they act; each joint has its own equation.
        if len(d.effects) > 3 and isinstance(effect["at"], str):
            at = effect["at"]
            places = [p for p in places if p[1] == at or p[0] not in JOINT_KINDS]
        same = [(effect["kind"], effect["at"])]
        places = [p for p in places if p not in same]
        # A rival may not be what is hidden beside it.
        hidden = [(e["kind"], e["at"]) for e in others]
        places = [p for p in places if p not in hidden]
        rivals = judge.rivals(effort, places, others)
        mine = len(effect["parameters"])
        # One with more parameters contains it, and is no rival but a detour.
        close = [r for r in rivals if len(r.parameters) <= mine and r.distance < CLEAR]
        tied += any(r.distance < SAME for r in close)
        maybe |= bool(close)
        if d.replaced is not None and effect["kind"] == "link_mass":
            known = {(r.kind, r.at) for r in rivals}
            same = _as_payload(d.nominal, effect)
            rivals += [r for r in same if (r.kind, r.at) not in known]
        if effect["kind"] == "joint_direction_friction":
            # The mean of both with a bias of half their difference is the same.
            plus, minus = effect["parameters"].values()
            half = {"bias": -0.5 * (plus - minus)}
            rivals += [
                Rival("joint_coulomb_friction", effect["at"],
                      {"coulomb": 0.5 * (plus + minus)}, 0.0),
                Rival("actuator_bias", effect["at"], half, 0.0),
            ]  # fmt: skip
            maybe = True
        effects.append(
            effect
            | {
                "d2": size,
                "needed": size > CLEAR,
                "loose": judge.loose(effect, others),
                "equivalents": [
                    {"kind": r.kind, "at": r.at, "parameters": r.parameters,
                     "d2": r.distance}
                    for r in rivals
                ],
            }
        )  # fmt: skip
    verdicts = {"no_gap"}
    needed = sum(e["needed"] for e in effects)
    if needed:
        # All that is hidden has a rival, or some of it, or nothing.
        verdicts = {"ambiguous"} if tied == needed else {"gap_named"}
        if maybe:
            verdicts |= {"ambiguous"}
    elif effects:  # Hidden, and hardly to be seen.
        verdicts |= {"gap_named", "ambiguous"}
    if any(e["kind"] == "sensor_delay" for e in d.effects):
        verdicts = {"ambiguous"}
    optional: list[dict] = []
    if d.push is not None:
        verdicts |= {"gap_unnamed"}
    lag = 0.0 if d.declared is None else d.declared.delay()
    left = d.how.filter.delay() - lag
    if abs(left) > 1e-9 and d.how.with_velocity:
        at = [f"{joint}.velocity" for joint in d.nominal.joints]
        lagging = [
            {"kind": r.kind, "at": at, "parameters": r.parameters, "d2": r.distance}
            for r in velocity_rivals(d.how.filter, lag, track, d.how)
        ]
        first, second = lagging
        verdicts = {"gap_named", "ambiguous"}
        if second["d2"] - first["d2"] < SAME:
            verdicts = {"ambiguous"}
        if left < 0.0 or first["d2"] > CLEAR:  # No kind says it quite.
            verdicts |= {"gap_named", "gap_unnamed"}
        effects.append(first | {"needed": left > 0.0, "equivalents": [second]})
    return {"effects": effects, "verdicts": sorted(verdicts), "optional": optional}


def _crossed(d: Drawn, track: Track) -> bool:
    """Whether each gap is crossed, both ways."""
    for effect in d.effects:
        if effect["kind"] == "joint_backlash":
            i = d.nominal.joint(effect["at"])
            side = (track.link_q - track.q)[:, i] / (0.5 * effect["parameters"]["gap"])
            sides = np.sign(side[np.abs(side) > 0.8])
            if np.count_nonzero(np.diff(sides)) < 4:
                return False
    return True


def make(case: LogCase) -> WrittenLog:
    """Draws, simulates, judges and records a case. A place where the recording would
    not show what is hidden is drawn again."""
    for attempt in range(30):
        d, motion = _draw(replace(case, seed=case.seed + 1_000_000 * attempt))
        track = _simulated(d, motion)
        judged = _judged(d, track)
        if not d.effects or (judged["effects"][0]["needed"] and _crossed(d, track)):
            break
    else:
        raise RuntimeError(f"{case.name}: nothing to be seen in 30 draws")
    offset = np.zeros(len(d.nominal.joints))
    columns, noise = write_log(track, d.nominal.joints, d.how, offset, d.rng)
    given = d.rng.uniform() < 0.3
    sidecar: dict = {"provenance": f"rig {int(d.rng.integers(1, 9))}"}
    if given:
        sidecar["noise"] = noise
    if d.declared is not None:
        says = d.declared.says()
        sidecar["filters"] = {f"{j}.velocity": says for j in d.nominal.joints}
    if d.rng.uniform() < 0.25:
        columns, sidecar["columns"] = _foreign(columns, d)
    truth = {
        "name": case.name,
        "verdict": judged["verdicts"][0],
        "verdicts": judged["verdicts"],
        "effects": judged["effects"],
        "optional": judged["optional"],
        "ties": [],
        "robot": d.sort,
        "world": "ode" if d.ode else "mujoco",
        "kinds": sorted({e["kind"] for e in d.effects}),
        "rate_hz": d.how.rate_hz,
        "seconds": float(columns[next(iter(columns))][-1]),
    }
    urdf = to_urdf(d.nominal)
    return WrittenLog(columns, _scene(d, track), urdf, sidecar, truth, track)


def _foreign(columns: dict, d: Drawn) -> tuple[dict, dict]:
    """In degrees, with the names of somebody's driver, and the map that tells."""
    named, map_ = {}, {}
    short = {"position": "q", "velocity": "dq", "effort_measured": "tau",
             "position_command": "q_des", "velocity_command": "dq_des",
             "effort_command": "tau_des"}  # fmt: skip
    joints = d.nominal.joints
    for key, values in columns.items():
        if key == "time":
            name, scale = "t_us", 1e-6
        else:
            joint, quantity = key.rsplit(".", 1)
            i = joints.index(joint)
            turns = not d.nominal.moving[i].sliding and "effort" not in quantity
            scale = np.pi / 180 if turns else 1.0
            name = f"{short.get(quantity, quantity)}_{i}"
        named[name] = values / scale
        map_[name] = {"channel": key, "scale": float(scale)}
    return named, map_


def _scene(d: Drawn, track: Track) -> str:
    robot = d.nominal
    joints = ", ".join(robot.joints)
    drive = d.drive
    actuation = f"  type: {drive.type}\n  joints: [{joints}]\n"
    if drive.type == "servo":
        actuation += (
            f"  kp: {drive.kp.tolist()}\n  limit: [{drive.limit}]\n"
            f"  supply: {{voltage: {drive.voltage}, kt: {drive.kt}, "
            f"resistance: {drive.resistance}}}\n"
            f"  dead_band: {drive.dead_band}\n  resolution: {drive.resolution!r}\n"
        )
    elif drive.type == "velocity":
        actuation += f"  kd: {drive.kd.tolist()}\n  limit: [{drive.limit}]\n"
    start = "".join(
        f"    {j}: {float(q):.6f}\n"
        for j, q in zip(robot.joints, track.q[0], strict=True)
    )
    return (
        "directives:\n"
        f"  - add_model: {{name: {robot.model}, file: {robot.model}.urdf}}\n"
        f"  - add_weld: {{parent: world, child: {robot.model}::base}}\n"
        "plant:\n  time_step: 0.0\n  gravity: [0, 0, -9.81]\n"
        f"actuation:\n{actuation}  hold: zero_order\n  rate_hz: {d.how.rate_hz:g}\n"
        f"initial:\n  positions:\n{start}"
        f"tolerance:\n  link_mass: {LINK_MASS}\n  link_com_m: {LINK_COM}\n"
        "effects: []\n"
    )


def write(case: LogCase, folder: Path, made: WrittenLog | None = None) -> dict:
    """Writes the case's folder. Returns: its truth, which is not in the folder."""
    made = made or make(case)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.yaml").write_text(made.scene)
    name = made.urdf.split('robot name="')[1].split('"')[0]
    (folder / f"{name}.urdf").write_text(made.urdf)
    table = np.column_stack(list(made.columns.values()))
    with (folder / "recording.csv").open("w") as file:
        file.write(",".join(made.columns) + "\n")
        np.savetxt(file, table, fmt="%.10g", delimiter=",")
    text = yaml.safe_dump(made.sidecar, sort_keys=False)
    (folder / "recording.yaml").write_text(text)
    return made.truth


def write_whole(case: LogCase, folder: Path) -> dict:
    """As write. Raises: ValueError as check."""
    truth = write(case, folder)
    check(folder)
    return truth


def check(folder: Path) -> None:
    """Raises: ValueError for a case's folder that is not whole. It opens the files that
    the workflow gets, and nothing else."""
    scene = yaml.safe_load((folder / "scene.yaml").read_text())
    sidecar = yaml.safe_load((folder / "recording.yaml").read_text())
    [model] = [d["add_model"] for d in scene["directives"] if "add_model" in d]
    root = ElementTree.parse(folder / model["file"]).getroot()
    moving = [j.get("name") for j in root.iter("joint") if j.get("type") != "fixed"]
    joints = {f"{model['name']}.{name}" for name in moving if name}
    with (folder / "recording.csv").open() as file:
        names = file.readline().strip().split(",")
        table = np.loadtxt(file, delimiter=",")
    named = sidecar.get("columns", {})
    channels = [named[name]["channel"] if named else name for name in names]
    for bad, what in (
        (table.shape[1] != len(names) or len(table) < 500, "rows or columns are lost"),
        (not np.isfinite(table).all(), "a number is missing"),
        (channels[0] != "time" or (np.diff(table[:, 0]) <= 0).any(), "time goes back"),
        ({c.rsplit(".", 1)[0] for c in channels[1:]} != joints, "joints differ"),
        (set(scene["actuation"]["joints"]) != joints, "drives differ"),
        ((table.std(axis=0) == 0).any(), "a channel never changes"),
        (np.abs(table).max() > 1e8, "a number is absurd"),
        (not set(sidecar) <= {"provenance", "noise", "filters", "columns"}, "sidecar"),
    ):
        if bad:
            raise ValueError(f"{folder.name}: {what}")


if __name__ == "__main__":
    make_cases("logs with hidden effects", list(SEEDS), cases, write_whole)

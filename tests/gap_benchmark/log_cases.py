"""Logs as a stranger would bring them: which robot, what is hidden, how it is logged.

    python tests/gap_benchmark/log_cases.py --set logs-final --out DIR --truth FILE

writes a folder for each case (scene.yaml, the robot's URDF, recording.csv, mostly a
sidecar) under DIR, and what is hidden into FILE, which must lie elsewhere. The sets
logs-development and logs-final have the same sorts of cases; robot, sizes, places,
rates, filters and motions are drawn, from seeds that they do not share.
"""

import argparse
import json
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml

if __name__ == "__main__":  # The package is found beside the tests.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gap_benchmark.effort_laws import added_effort
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
    places_of,
    velocity_rivals,
    without_rotors,
)

SEEDS = {"logs-development": 210_000, "logs-final": 370_000}
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
]  # fmt: skip


def cases(which: str) -> list[LogCase]:
    """All cases of a set."""
    return [
        LogCase(f"{i:02d}_{r.name}", SEEDS[which] + 7 * i, r)
        for i, r in enumerate(RECIPES)
    ]


# ----- Sizes


@dataclass(frozen=True)
class Motion1:
    """What the nominal robot needs and does on the motion: rms of effort, velocity and
    acceleration (n,)."""

    effort: np.ndarray
    v: np.ndarray
    a: np.ndarray


def _hidden(name: str, d: Drawn, s: Motion1) -> list[dict]:
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
        scale = {"panda": 1.2, "six": 3.0, "scara": 0.5, "planar": 0.3}[d.sort]
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
        return [
            one("actuator_gain", joints[i], gain=1.0 + sign * rng.uniform(0.1, 0.2))
        ]
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
        d.how = replace(d.how, quantum=2 * np.pi / 4096 if d.sort == "servo" else 3e-4)
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
        # Kicks of a proportional servo: 8 N m/rad, and a motor's back-EMF.
        drive = Drive("pd", 0.02, np.full(n, float(rng.uniform(7.0, 12.0))),
                      np.full(n, float(rng.uniform(0.35, 0.6))))  # fmt: skip
    d = Drawn(rng, sort, nominal, true, drive, Logging())
    _logging(d, recipe.options)
    if sort == "servo":
        d.how = replace(d.how, side="", with_command=True)
    motion = MOTIONS[str(rng.choice(recipe.motions.split()))](
        nominal, SECONDS[sort], 0.001, rng
    )
    still = slice(0, None, 40)
    effort = Inverse(nominal)(motion.q[still], motion.v[still], motion.a[still])

    def rms(x):
        return np.sqrt(np.mean(x**2, axis=0))

    stats = Motion1(rms(effort), rms(motion.v), rms(motion.a))
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
    return RobotWorld(d.nominal, true, effects, d.drive, d.push).run(motion)


def _difference(d: Drawn, effect: dict, track: Track) -> np.ndarray:
    """(k, n) what a hidden effect adds to the effort."""
    if d.replaced is not None and effect["kind"] in ("payload", "link_mass"):
        q, v, a = track.q, track.v, track.a
        return Inverse(d.replaced(d.nominal))(q, v, a) - Inverse(d.nominal)(q, v, a)
    return added_effort(d.nominal, effect, track)


def _judged(d: Drawn, track: Track) -> dict:
    """What is hidden with what cannot be told from it, and the right verdicts."""
    how = d.how
    if d.drive.type in ("pd", "servo"):
        # Known: the drive's law. Its noise is that of the encoders.
        step = max(how.position_noise, how.quantum / np.sqrt(12.0))
        how = replace(how, side="motor", effort_noise=d.drive.kp * step)
    judge = Comparison(d.nominal, track, how, LINK_MASS, LINK_COM)
    few = judge.track
    effects, tied = [], False
    maybe = False
    for effect in d.effects:
        others = [e for e in d.effects if e is not effect]
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
        for rival in rivals:
            # One with more parameters contains it, and is no rival but a detour.
            if len(rival.parameters) <= mine:
                tied |= rival.distance < SAME
                maybe = True
        effects.append(
            effect
            | {
                "d2": size,
                "needed": size > CLEAR,
                "equivalents": [
                    {"kind": r.kind, "at": r.at, "parameters": r.parameters,
                     "d2": r.distance}
                    for r in rivals
                ],
            }
        )  # fmt: skip
    verdicts = {"no_gap"}
    if any(e["needed"] for e in effects):
        verdicts = {"ambiguous"} if tied else {"gap_named"}
        if maybe:
            verdicts |= {"ambiguous"}
            if not tied:
                verdicts |= {"gap_named"}
    elif effects:  # Hidden, and hardly to be seen.
        verdicts |= {"gap_named", "ambiguous"}
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


def make(case: LogCase) -> WrittenLog:
    """Draws, simulates, judges and records a case. A place where the recording would
    not show what is hidden is drawn again."""
    for attempt in range(30):
        d, motion = _draw(replace(case, seed=case.seed + 1_000_000 * attempt))
        track = _simulated(d, motion)
        judged = _judged(d, track)
        if not d.effects or judged["effects"][0]["needed"]:
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
        "world": "mujoco",
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
             "position_command": "q_des", "effort_command": "tau_des"}  # fmt: skip
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
    if d.drive.type == "pd":
        actuation = f"  type: pd\n  joints: [{joints}]\n  kp: {d.drive.kp.tolist()}\n"
        actuation += f"  kd: {d.drive.kd.tolist()}\n"
    else:
        actuation = f"  type: effort\n  joints: [{joints}]\n"
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


def main() -> None:
    parser = argparse.ArgumentParser(description="Writes logs with hidden effects.")
    parser.add_argument("--set", choices=sorted(SEEDS), required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder of the cases")
    parser.add_argument("--truth", type=Path, required=True, help="file, elsewhere")
    parser.add_argument("--only", default="", help="cases whose name has this in it")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    args = parser.parse_args()
    if args.out.resolve() in args.truth.resolve().parents:
        parser.error("--truth must not lie in --out: the workflow could read it")
    wanted = [case for case in cases(args.set) if args.only in case.name]
    truths = {}
    args.truth.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(args.jobs) as pool:
        written = pool.map(write, wanted, [args.out / case.folder for case in wanted])
        for case, truth in zip(wanted, written, strict=True):
            truths[case.folder] = truth
            args.truth.write_text(json.dumps(truths, indent=1) + "\n")
            print(case.folder, case.name, flush=True)


if __name__ == "__main__":
    main()

"""Robots that follow commands, held by their base: legs, arms, hands, humanoids.

    python tests/gap_benchmark/driven_cases.py --set driven --out DIR --truth FILE

writes a folder for each case (scene.yaml, robot.urdf, recording.csv, recording.yaml)
under DIR, and what is hidden into FILE. The world is MuJoCo, where dry friction is a
constraint: stiff, or with the solver's own settings, with which a joint creeps. Sizes,
masses, gains, rates, motions and what is hidden are drawn from seeds that the two sets
do not share.
"""

import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import yaml

if __name__ == "__main__":  # The package is found beside the tests.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gap_benchmark.log_cases import COULOMB
from gap_benchmark.maker import make_cases
from gap_benchmark.motions import MOTIONS, Motion
from gap_benchmark.robot_world import Drive, loaded
from gap_benchmark.robots import (
    HARD,
    Body,
    G,
    Robot,
    panda,
    rod,
    six,
    to_mjcf,
    to_urdf,
    within_tolerance,
)

SEEDS = {"driven": 100, "driven-final": 70_000}
STEP = 0.0005  # [s]
X, Y, Z = ((1.0, 0.0, 0.0),), ((0.0, 1.0, 0.0),), ((0.0, 0.0, 1.0),)
LINK_MASS = 0.02  # The scene's tolerance, one sigma.
MOST_KP = 4000.0  # [N m/rad]
SHOWN = 3.0  # Times the noise by which what is hidden moves its joint, to be needed.

# Of each robot: drive, what is hidden, and: torques (measured), shapes (which can
# touch), known (friction that the scene has), fast (commands of up to 1 kHz).
RECIPES = {
    "leg3": "servo:none servo:friction pd:friction,damping:shapes velocity:damping "
            "effort:friction:fast servo:friction_one:known pd:gains_one:fast,shapes "
            "servo:friction,rotors,gains:shapes",
    "legs12": "servo:none:shapes servo:friction:shapes pd:none:known "
              "pd:friction,rotors pd:delay:fast velocity:friction "
              "pd:friction,damping,payload:torques",
    "arm6": "servo:none servo:friction pd:friction,payload velocity:none "
            "velocity:damping_one effort:friction,damping:torques,fast",
    "arm7": "pd:none:known pd:friction servo:gains pd:rotors:torques pd:payload:fast "
            "effort:friction,payload,damping:fast servo:friction,delay",
    "hand16": "servo:none servo:friction pd:friction,damping servo:gains_one:known "
              "pd:rotors,friction,gains",
    "humanoid23": "pd:none pd:friction servo:friction,payload",
    "humanoid29": "pd:none:known pd:friction servo:damping_one "
                  "pd:friction,damping,rotors,payload:torques",
}  # fmt: skip


@dataclass(frozen=True)
class DrivenCase:
    name: str
    seed: int
    robot: str
    drive: str
    hide: tuple[str, ...]
    options: tuple[str, ...]

    @property
    def folder(self) -> str:
        """A name that does not tell."""
        return f"log_{self.seed}"


def cases(which: str, seed: int | None = None) -> list[DrivenCase]:
    """All cases of a set; seed: of the first one, where it is not the set's own."""
    first = SEEDS[which] if seed is None else seed
    every = [(kind, word) for kind, words in RECIPES.items() for word in words.split()]
    found = []
    for i, (kind, word) in enumerate(every):
        drive, hide, options = (*word.split(":"), "")[:3]
        name = f"{i:02d}_{kind}_{drive}_{hide.replace(',', '_')}"
        hides = tuple(each for each in hide.split(",") if each != "none")
        of = tuple(options.split(","))
        found.append(DrivenCase(name, first + 7 * i, kind, drive, hides, of))
    return found


# ----- Robots


def _limb(rng, name: str, at, on: str, axes, lengths, masses) -> list[Body]:
    """A chain that hangs down on a body: lengths [m] and masses [kg] of its links; one
    without a length is a joint's housing."""
    bodies, below = [], np.array(at, float)
    for k, (axis, length, mass) in enumerate(zip(axes, lengths, masses, strict=True)):
        m, size = float(mass * rng.uniform(0.8, 1.2)), max(length, 0.25 * max(lengths))
        com = 0.1 * size * rng.uniform(-1.0, 1.0, 3) - [0.0, 0.0, 0.45 * length]
        bodies.append(
            Body(f"{name}{k}", f"{name}{k}_joint", tuple(map(float, below)), (0, 0, 0),
                 m, tuple(map(float, com)), rod(m, size, 0.2 * size), axis=axis, on=on)
        )  # fmt: skip
        on, below = f"{name}{k}", np.array([0.0, 0.0, -length])
    return bodies


def robot_of(kind: str, rng) -> Robot:
    """All joints are named robot.*; rotors are 0 where its maker does not say."""
    if kind in ("arm6", "arm7"):
        return replace((six if kind == "arm6" else panda)(rng), model="robot")
    s = rng.uniform(0.9, 1.1)
    leg = (X + Y + Y, s * np.array([0.0, 0.21, 0.21]), (0.7, 1.1, 0.25))
    finger = (X + 3 * Y, s * np.array([0.01, 0.05, 0.035, 0.03]),
              (0.02, 0.05, 0.035, 0.025))  # fmt: skip
    reach, fastest = 0.4, 3.0
    if kind == "leg3":
        limbs = [("leg", (0, 0.1, 1), "", *leg)]
    elif kind == "legs12":
        limbs = [(f"leg{k}_", (0.2 - 0.4 * (k // 2), 0.1 - 0.2 * (k % 2), 1.0), "",
                  *leg) for k in range(4)]  # fmt: skip
    elif kind == "hand16":
        limbs = [(f"finger{k}_", (0, 0.04 * k, 1), "", *finger) for k in range(4)]
    else:  # A humanoid, held by its pelvis.
        big, fastest = kind == "humanoid29", 2.5
        waist, n = (Z + X + Y, 7) if big else (Z, 5)
        leg = (Y + X + Z + Y + Y + X, s * np.array([0.0, 0.05, 0.25, 0.3, 0.0, 0.05]),
               (1.3, 1.5, 1.7, 1.9, 0.1, 0.6))  # fmt: skip
        arm = ((Y + X + Z + Y + Z + X + Y)[:n],
               s * np.array([0.03, 0.1, 0.1, 0.1, 0.1, 0.04, 0.06])[:n],
               (0.7, 0.6, 0.7, 0.6, 0.3, 0.2, 0.25)[:n])  # fmt: skip
        k = len(waist) - 1
        limbs = [("waist", (0, 0, 1), "", waist, (1e-3,) * (k + 1), (*(0.5,) * k, 7.0))]
        for side, y in (("left", 1.0), ("right", -1.0)):
            limbs.append((f"{side}_leg", (0, 0.09 * y, 0.95), "", *leg))
            limbs.append((f"{side}_arm", (0, 0.2 * y, 0.3), f"waist{k}", *arm))
    bodies = [body for each in limbs for body in _limb(rng, *each)]
    n = len(bodies)
    return Robot("robot", tuple(bodies), rng.uniform(-0.2, 0.2, n),
                 reach * rng.uniform(0.7, 1.0, n), fastest * rng.uniform(0.7, 1.0, n),
                 )  # fmt: skip


# ----- The world


def mjcf_of(robot: Robot, damping=0.0, friction=0.0, dry: str = HARD) -> str:
    n = len(robot.joints)
    return to_mjcf(robot, (0, 0, -G), np.full(n, damping), np.full(n, friction), None,
                   f'timestep="{STEP}"', dry)  # fmt: skip


def model_of(robot: Robot, text: str):
    """(model, data, (n,) index of each joint) of the robot that is written so."""
    model = mujoco.MjModel.from_xml_string(text)
    at = [model.joint(body.joint).dofadr[0] for body in robot.moving]
    return model, mujoco.MjData(model), np.array(at)


def inertias(robot: Robot) -> np.ndarray:
    """(n,) of each joint, rotors with them [kg m2], about the middle of its motion."""
    model, data, at = model_of(robot, mjcf_of(robot))
    data.qpos[at] = robot.middle
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return np.diag(full)[at]


def with_effects(true: Robot, drives: Drive, dry: str, effects, known):
    """The robot as MJCF, its gains kp (n,) and its delay [s], with what is hidden.
    known (n,): friction that the scene has."""
    kp, delay = drives.kp.copy(), 0.0
    damping, friction = np.zeros(len(true.joints)), known.copy()
    for e in effects:
        x = next(iter(e["parameters"].values()))
        if e["kind"] == "input_delay":
            delay = x
        elif e["kind"] == "payload":
            true = loaded(true, e)
        else:
            i = true.joint(e["at"])
            if e["kind"] == "joint_coulomb_friction":
                friction[i] += x
            elif e["kind"] == "joint_viscous_damping":
                damping[i] += x
            elif e["kind"] == "servo_gain":
                kp[i] = x
            else:
                body = true.moving[i]
                true = true.with_body(f"robot.{body.name}", rotor=body.rotor + x)
    return mjcf_of(true, damping, friction, dry), kp, delay


def run(
    true: Robot, nominal: Robot, drives: Drive, dry: str, effects, known, motion: Motion
):
    """(time, q, v, effort, commands {name: (k, n)}), each 1 ms. known (n,): friction
    that the scene has. Raises: RuntimeError where bodies touch."""
    text, kp, delay = with_effects(true, drives, dry, effects, known)
    m, d, dof = model_of(true, text)
    model, plain, at = model_of(nominal, mjcf_of(nominal))
    d.qpos[dof], d.qvel[dof] = motion.q[0], motion.v[0]
    every, late = round(drives.period / STEP), round(delay / STEP)
    queue: list[tuple] = []
    rows: list[tuple] = []
    for k in range(2 * (len(motion.time) - 1)):
        q, v = d.qpos[dof], d.qvel[dof]
        if k % every == 0:
            goal, rate = motion.q[k // 2], motion.v[k // 2]
            if drives.type == "velocity":
                rate = rate + 2.0 * (goal - q)
            elif drives.type == "effort":  # By the robot that its maker knows.
                plain.qpos[at], plain.qvel[at] = goal, rate
                plain.qacc[at] = motion.a[k // 2]
                mujoco.mj_inverse(model, plain)
                goal = plain.qfrc_inverse[at] + drives.kp * (goal - q)
                goal += drives.kd * (rate - v)
            elif drives.type == "servo":
                rate = 0.0 * rate
            queue.append((k + late, goal, rate))
        while len(queue) > 1 and queue[1][0] <= k:
            queue.pop(0)
        _, goal, rate = queue[0]
        effort = goal
        if drives.type != "effort":
            effort = kp * (goal - q) + drives.kd * (rate - v)
        d.qfrc_applied[dof] = effort
        if k % 2 == 0:
            rows.append((q.copy(), v.copy(), effort, *queue[-1][1:]))
        mujoco.mj_step(m, d)
        if d.ncon:
            raise RuntimeError("bodies touch")
    if not np.isfinite(d.qpos).all() or np.abs(d.qvel).max() > 100.0:
        raise RuntimeError("the simulation went wrong")
    q, v, effort, goal, rate = (np.array(x) for x in zip(*rows, strict=True))
    sent = {"effort_command": goal, "position_command": goal, "velocity_command": rate}
    names = {"servo": ["position_command"], "velocity": ["velocity_command"],
             "effort": ["effort_command"]}.get(drives.type, list(sent)[1:])  # fmt: skip
    return 0.001 * np.arange(len(q)), q, v, effort, {key: sent[key] for key in names}


# ----- What is hidden, and the log


def hidden(case: DrivenCase, robot: Robot, drives: Drive, rng) -> list[dict]:
    """Effects with sizes that robots have: like joints have like ones."""
    found, M = [], inertias(robot)
    roles = [re.sub(r"^(leg|finger|left|right)\d*_", "", b.name) for b in robot.moving]
    dry = _dry(robot, drives)
    wet = np.minimum(0.6 * drives.kd, 2.0 * dry / robot.fastest)
    size = {"friction": ("joint_coulomb_friction", "coulomb", dry, 1.0),
            "damping": ("joint_viscous_damping", "damping", wet, 1.0),
            "rotors": ("rotor_inertia", "inertia", np.minimum(M, 10.0), 0.8),
            "gains": ("servo_gain", "kp", drives.kp, 0.8)}  # fmt: skip
    for name in case.hide:
        if name == "payload":
            on = {b.on for b in robot.bodies} if robot.bodies[1].on else {
                b.name for b in robot.bodies[:-1]}  # fmt: skip
            ends = [b for b in robot.bodies if b.name not in on]
            b = ends[int(rng.integers(len(ends)))]
            spot = np.array(b.com) + 0.5 * np.linalg.norm(b.com) * rng.uniform(-1, 1, 3)
            p = dict(zip(("com_x", "com_y", "com_z"), spot, strict=True))
            p = {"mass": b.mass * rng.uniform(0.6, 1.2)} | p
            found.append((name, f"robot.{b.name}", p))
        elif name == "delay":
            found.append(("input_delay", "robot", {"delay": rng.uniform(0.006, 0.02)}))
        else:
            kind, key, of, most = size[name.removesuffix("_one")]
            like = {role: most * rng.uniform(0.4, 1.0) for role in dict.fromkeys(roles)}
            every = range(len(roles))
            for i in [int(rng.choice(every))] if name.endswith("_one") else every:
                x = of[i] * like[roles[i]] * rng.uniform(0.9, 1.1)
                found.append((kind, robot.joints[i], {key: x}))
    return [{"kind": k, "at": at, "parameters": {a: float(x) for a, x in p.items()}}
            for k, at, p in found]  # fmt: skip


def _dry(robot: Robot, drives: Drive) -> np.ndarray:
    """(n,) friction of a worn joint [N m]: of an arm as its maker's gears have it, else
    what its drive gives for an error of 0.04 rad, or of a tenth of its speed."""
    known = {6: COULOMB["six"], 7: COULOMB["panda"]}.get(len(robot.joints))
    if known is not None:
        return np.array([most for _, most in known])
    return 0.04 * drives.kp if drives.kp.any() else 0.1 * drives.kd * robot.fastest


def _drawn(case: DrivenCase, rng) -> tuple[Robot, Drive]:
    robot = robot_of(case.robot, rng)
    touch = 0.004 if "shapes" in case.options else 0.0
    for b, of_link in zip(robot.moving, inertias(robot), strict=True):
        rotor = b.rotor or float(of_link * rng.uniform(0.3, 1.0))
        robot = robot.with_body(f"robot.{b.name}", rotor=rotor, touch=touch)
    n, M, w = len(robot.joints), inertias(robot), 2 * np.pi * rng.uniform(3.0, 6.0)
    kp = np.minimum(M * w**2, MOST_KP)
    kd = 2.0 * rng.uniform(0.4, 0.9) * np.sqrt(kp * M)
    if case.drive == "velocity":
        kp, kd = np.zeros(n), 60.0 * M
    fast = "fast" in case.options or case.drive in ("velocity", "effort")
    hz = float(rng.choice([200, 500, 1000] if fast else [20, 50, 100, 200]))
    drives = Drive(case.drive, 1.0 / hz, kp, kd)
    for b, dry in zip(robot.moving, _dry(robot, drives), strict=True):
        robot = robot.with_body(f"robot.{b.name}", effort=float(100.0 * dry))
    return robot, drives


def make(case: DrivenCase, attempt: int = 0):
    """(columns, scene, urdf, sidecar, truth). Where bodies touch it is drawn again."""
    rng = np.random.default_rng([case.seed, attempt])
    robot, drives = _drawn(case, rng)
    joints, hz = robot.joints, round(1.0 / drives.period)
    known = np.zeros(len(joints))
    if "known" in case.options:
        known = _dry(robot, drives) * rng.uniform(0.2, 0.5, len(joints))
    effects = hidden(case, robot, drives, rng)
    com = 0.01 * max(float(np.linalg.norm(b.com)) for b in robot.bodies)
    how = MOTIONS[str(rng.choice(["multisine", "pick", "guided"]))]
    motion = how(robot, float(rng.choice([18.0, 24.0, 30.0])), 0.001, rng)
    soft = "known" not in case.options and rng.uniform() < 0.5
    world = within_tolerance(robot, rng, LINK_MASS, com), robot, drives
    world += ("" if soft else HARD,)
    try:
        time, q, _, effort, commands = run(*world, effects, known, motion)
    except RuntimeError:
        if attempt > 20:
            raise
        return make(case, attempt + 1)
    noise = float(10 ** rng.uniform(-4.3, -3.5))
    for kind in dict.fromkeys(e["kind"] for e in effects):
        rest = [e for e in effects if e["kind"] != kind]
        off = run(*world, rest, known, motion)[1] - q
        moved = dict(zip(joints, np.sqrt(np.mean(off**2, axis=0)) / noise, strict=True))
        for e in effects:
            if e["kind"] == kind:
                e["shows"] = float(moved.get(e["at"], max(moved.values())))
                e["needed"] = e["shows"] > SHOWN
    log_hz = int(rng.choice([r for r in (50, 100, 200, 250, 500, 1000) if r >= hz]))
    rows = np.arange(0, len(time), 1000 // log_hz)
    columns, told = {"time": time[rows]}, {}
    for i, joint in enumerate(joints):
        told[f"{joint}.position"] = noise
        columns[f"{joint}.position"] = q[rows, i] + noise * rng.normal(size=len(rows))
        if "torques" in case.options:
            s = told[f"{joint}.effort_measured"] = 0.02 * float(effort[:, i].std())
            u = effort[rows, i] + s * rng.normal(size=len(rows))
            columns[f"{joint}.effort_measured"] = u
        for name, x in commands.items():
            columns[f"{joint}.{name}"] = x[rows, i]
    sidecar = {"noise": told} if rng.uniform() < 0.3 else {"provenance": "rig"}
    shown = {e["kind"] for e in effects if e["needed"]}
    verdicts = ["gap_named"] if shown else ["no_gap"]
    if shown & {"payload", "input_delay"}:  # A load has neighbours, a delay, too.
        verdicts.append("ambiguous")
    truth = dict(name=case.name, verdict=verdicts[0], verdicts=verdicts, ties=[],
                 effects=effects, robot=case.robot, rate_hz=log_hz, commands_hz=hz,
                 kinds=sorted({e["kind"] for e in effects}),
                 world=with_effects(world[0], drives, world[3], effects, known)[0],
                 )  # fmt: skip
    scene = _scene(robot, drives, known, com)
    return columns, scene, to_urdf(robot), sidecar, truth


def _scene(robot: Robot, drives: Drive, known, com: float) -> str:
    drive: dict = {"type": drives.type, "joints": robot.joints}
    drive["rate_hz"] = round(1.0 / drives.period)
    if drives.type != "effort":
        drive["kd"] = drives.kd.tolist()
        drive |= {"kp": drives.kp.tolist()} if drives.kp.any() else {}
    return yaml.safe_dump({
        "directives": [{"add_model": {"name": "robot", "file": "robot.urdf"}},
                       {"add_weld": {"parent": "world", "child": "robot::base"}}],
        "actuation": drive, "tolerance": {"link_mass": LINK_MASS, "link_com_m": com},
        "effects": [{"kind": "joint_coulomb_friction", "at": [joint],
                     "parameters": {"coulomb": float(c)}}
                    for joint, c in zip(robot.joints, known, strict=True) if c],
    }, sort_keys=False)  # fmt: skip


def write(case: DrivenCase, folder: Path) -> dict:
    """Writes the case's folder. Returns: its truth, which is not in the folder."""
    columns, scene, urdf, sidecar, truth = make(case)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.yaml").write_text(scene)
    (folder / "robot.urdf").write_text(urdf)
    np.savetxt(
        folder / "recording.csv", np.column_stack(list(columns.values())), "%.9g", ",",
        header=",".join(columns), comments="",
    )  # fmt: skip
    (folder / "recording.yaml").write_text(yaml.safe_dump(sidecar))
    return truth


if __name__ == "__main__":
    make_cases("robots that follow commands", list(SEEDS), cases, write)

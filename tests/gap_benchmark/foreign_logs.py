r"""Logs of robots that no other benchmark has, as another program writes them.

    python tests/gap_benchmark/foreign_logs.py ROBOT HIDE SEED FOLDER

writes robot.urdf and log.csv into FOLDER, nothing else, and prints what is hidden. The
log has units in its columns' names, degrees, stamps in whole milliseconds, decimals as
a display shows them, and lost rows.
"""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

if __name__ == "__main__":  # The package is found beside the tests.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gap_benchmark.motions import MOTIONS
from gap_benchmark.robot_log import Logging, write_log
from gap_benchmark.robot_world import Drive, RobotWorld
from gap_benchmark.robots import Body, Robot, rod, to_urdf, within_tolerance

LOST = 0.03  # Of the rows.
Y = (0.0, 1.0, 0.0)


def palletiser(rng) -> Robot:
    """Four joints of a packing robot: a column that turns, two arms, a head."""
    a, b = rng.uniform(0.5, 0.8, 2)
    m = np.array([22.0, 14.0, 9.0, 3.0]) * rng.uniform(0.85, 1.15, 4)
    bodies = (
        Body("column", "turntable", (0, 0, 0.2), (0, 0, 0), float(m[0]),
             (0.03, 0.0, 0.2), rod(m[0], 0.5, 0.12), rotor=2.5, effort=400.0),
        Body("boom", "luffing", (0.1, 0, 0.5), (0, 0, 0), float(m[1]),
             (0.0, 0.02, 0.5 * a), rod(m[1], a, 0.06), axis=Y, rotor=3.0, effort=600.0),
        Body("stick", "knuckle", (0, 0, a), (0, 0, 0), float(m[2]),
             (0.45 * b, 0.0, 0.0), rod(m[2], b, 0.05, 0), axis=Y, rotor=1.5,
             effort=300.0),
        Body("head", "swivel", (b, 0, 0), (0, 0, 0), float(m[3]), (0.02, 0.01, -0.06),
             rod(m[3], 0.15, 0.06), rotor=0.08, effort=60.0),
    )  # fmt: skip
    middle, reach = np.array([0.2, 0.1, 0.2, 0.0]), np.array([1.2, 0.45, 0.5, 1.5])
    return Robot("packer", bodies, middle, reach, np.array([1.4, 0.9, 1.1, 2.5]))


def lift_first(rng) -> Robot:
    """A SCARA whose lift carries its arms, as in laboratories."""
    a, b = rng.uniform(0.2, 0.35, 2)
    m = np.array([4.0, 2.0, 1.2, 0.4]) * rng.uniform(0.85, 1.15, 4)
    bodies = (
        Body("carriage", "mast", (0, 0, 0.4), (0, 0, 0), float(m[0]),
             (0.02, 0.0, 0.0), rod(m[0], 0.15, 0.06), sliding=True, rotor=6.0,
             effort=300.0),
        Body("inner", "humerus", (0.06, 0, 0), (0, 0, 0), float(m[1]),
             (0.5 * a, 0.01, 0.0), rod(m[1], a, 0.04, 0), rotor=0.05, effort=25.0),
        Body("outer", "ulna", (a, 0, 0), (0, 0, 0), float(m[2]), (0.5 * b, 0.0, 0.02),
             rod(m[2], b, 0.03, 0), rotor=0.03, effort=15.0),
        Body("gripper", "carpus", (b, 0, 0), (0, 0, 0), float(m[3]),
             (0.03, 0.0, -0.03), rod(m[3], 0.08, 0.03), rotor=0.004, effort=4.0),
    )  # fmt: skip
    middle, reach = np.array([0.0, 0.4, 0.8, 0.0]), np.array([0.12, 1.1, 1.1, 1.4])
    return Robot("labarm", bodies, middle, reach, np.array([0.3, 2.0, 2.4, 3.0]))


ROBOTS: dict[str, Callable] = {"palletiser": palletiser, "lift_first": lift_first}
EFFORT_NOISE = {"palletiser": 0.8, "lift_first": 0.08}


def hidden(name: str, robot: Robot, rng) -> list[dict]:
    """At one joint, or on one of the last two links."""
    k = int(rng.integers(len(robot.joints)))
    joint, effort = robot.joints[k], robot.moving[k].effort
    fast = float(robot.fastest[k])
    if name == "drag":
        kind, p = "joint_quadratic_drag", {"coefficient": 0.05 * effort / fast**2}
    elif name == "friction":
        kind, p = "joint_coulomb_friction", {"coulomb": 0.03 * effort}
    elif name == "damping":
        kind, p = "joint_viscous_damping", {"damping": 0.06 * effort / fast}
    elif name == "gain":
        up = rng.choice([-1.0, 1.0])
        kind, p = "actuator_gain", {"gain": 1.0 + up * float(rng.uniform(0.1, 0.2))}
    elif name == "backlash":
        kind, p = "joint_backlash", {"gap": float(rng.uniform(0.01, 0.02))}
        p["gap"] *= 0.1 if robot.moving[k].sliding else 1.0
    elif name == "payload":
        at = f"{robot.model}.{robot.bodies[-1].name}"
        mass = float(rng.uniform(0.8, 1.6)) * robot.bodies[-1].mass
        x, y, z = map(float, rng.uniform(-0.05, 0.05, 3))
        p = {"mass": mass, "com_x": x, "com_y": y, "com_z": z - 0.05}
        return [{"kind": "payload", "at": at, "parameters": p}]
    else:
        raise ValueError(f"no law for {name}")
    p = {key: float(x * (1.0 if key in ("gain", "gap") else rng.uniform(0.7, 1.4)))
         for key, x in p.items()}  # fmt: skip
    return [{"kind": kind, "at": joint, "parameters": p}]


def write(name: str, hide: str, seed: int, folder: Path) -> list[dict]:
    """Writes robot.urdf and log.csv. Returns: what is hidden."""
    rng = np.random.default_rng(seed)
    robot = ROBOTS[name](rng)
    effects = hidden(hide, robot, rng) if hide else []
    true = within_tolerance(robot, rng, 0.02, 0.0015)
    which = str(rng.choice(["multisine", "pick", "guided"]))
    motion = MOTIONS[which](robot, 24.0, 0.001, rng)
    track = RobotWorld(robot, true, effects, Drive()).run(motion)
    hz = float(rng.choice([100.0, 200.0, 250.0]))
    how = Logging(
        rate_hz=hz, position_noise=3e-5, velocity_noise=2e-3,
        effort_noise=EFFORT_NOISE[name],
    )  # fmt: skip
    gain = next((e for e in effects if e["kind"] == "actuator_gain"), None)
    columns, _ = write_log(track, robot.joints, how, np.zeros(4), rng)
    if gain:  # What is logged is what was asked for.
        columns[f"{gain['at']}.effort_measured"] /= gain["parameters"]["gain"]
    keep = rng.uniform(size=len(columns["time"])) >= LOST
    lines = ["Timestamp [ms]"]
    table = [np.round(1000.0 * columns["time"] + 1_700_000.0)]
    digits = ["%d"]
    words = {"position": "actual position", "velocity": "actual speed",
             "effort_measured": "motor torque"}  # fmt: skip
    for body in robot.moving:
        for quantity, says in words.items():
            y = columns[f"{robot.model}.{body.joint}.{quantity}"]
            unit, scale = {
                "position": ("mm", 1e3) if body.sliding else ("deg", 180 / np.pi),
                "velocity": ("mm/s", 1e3) if body.sliding else ("deg/s", 180 / np.pi),
                "effort_measured": ("N", 1.0) if body.sliding else ("Nm", 1.0),
            }[quantity]
            lines.append(f"{body.joint} {says} [{unit}]")
            table.append(scale * y)
            digits.append("%.4f" if quantity == "position" else "%.3f")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.urdf").write_text(to_urdf(robot))
    with (folder / "log.csv").open("w") as file:
        file.write(";".join(lines) + "\n")
        np.savetxt(file, np.column_stack(table)[keep], fmt=digits, delimiter=";")
    return effects


def main() -> None:
    parser = argparse.ArgumentParser(description="Writes a robot and its log.")
    parser.add_argument("robot", choices=list(ROBOTS))
    parser.add_argument("hide", help="what is hidden, or none")
    parser.add_argument("seed", type=int)
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    hide = "" if args.hide == "none" else args.hide
    print(json.dumps(write(args.robot, hide, args.seed, args.folder)))


if __name__ == "__main__":
    main()

"""Logs with one wrong thing each, as they come to the front door of `makebreak gap`.

    python tests/front_doors.py --seed 3 --count 120

A robot, an exact log of it (one joint may have friction that the model lacks), and one
thing wrong with the log. `seen` reads, proposes and checks as `makebreak gap ROBOT LOG`
does before it computes; a log is right where what is wrong is said by its name and the
channels hold what the robot did: then no mass has to make up for anything.
"""

import argparse
import json
import re
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from makebreak.gap.data.checks import check_recordings
from makebreak.gap.data.content import check_contents
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.robot import propose_scene, read_log, read_robot
from makebreak.gap.data.scene_facts import scene_facts
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import read_scene

RATE = 100.0
LINK = """<link name="l{k}"><inertial><origin xyz="0 0 {c}"/><mass value="{m}"/>
<inertia ixx="{i}" iyy="{i}" izz="{z}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{name}" type="{type}"><parent link="{parent}"/><child link="l{k}"/>
<origin xyz="0 0 {z0}"/><axis xyz="{axis}"/>
<limit lower="{low}" upper="{high}" effort="500" velocity="20"/></joint>"""
ROBOTS = {
    "planar": [("revolute", "0 1 0", 3.0), ("revolute", "0 1 0", 3.0)],
    "three": [("revolute", "0 0 1", 2.9), ("revolute", "0 1 0", 2.5),
              ("revolute", "0 1 0", 2.8)],
    "six": [("revolute", "0 0 1", 3.1), ("revolute", "0 1 0", 3.1),
            ("revolute", "0 1 0", 3.1), ("revolute", "0 1 0", 3.1),
            ("revolute", "1 0 0", 3.1), ("revolute", "0 1 0", 3.1)],
    "cart": [("prismatic", "1 0 0", 0.8), ("revolute", "0 1 0", 3.1)],
    "scara": [("revolute", "0 0 1", 2.8), ("revolute", "0 0 1", 2.6),
              ("prismatic", "0 0 1", 0.7), ("revolute", "0 0 1", 3.1)],
    "gantry": [("prismatic", "1 0 0", 1.2), ("prismatic", "0 1 0", 0.9),
               ("prismatic", "0 0 1", 0.7)],
    "hand": [("revolute", "0 1 0", 2.5), ("revolute", "0 1 0", 2.6),
             ("revolute", "1 0 0", 2.5), ("revolute", "1 0 0", 2.6)],
    "wrist6": [("revolute", "0 0 1", 6.2), ("revolute", "0 1 0", 2.1),
               ("revolute", "0 1 0", 3.9), ("revolute", "1 0 0", 6.2),
               ("revolute", "0 1 0", 3.1), ("revolute", "1 0 0", 6.2)],
    "gripper": [("revolute", "0 0 1", 2.9), ("revolute", "0 1 0", 2.4),
                ("revolute", "0 1 0", 2.6), ("prismatic", "1 0 0", 0.8),
                ("prismatic", "-1 0 0", 0.8)],
    "hexapod": [("revolute", "0 0 1", 2.2), ("revolute", "0 1 0", 2.4),
                ("revolute", "0 1 0", 2.7)],
}  # fmt: skip
# Where a link does not hang from the one before.
PARENTS = {"hand": {3: "base"}, "gripper": {5: "l3"}}
LATER = ("gripper", "scara", "wrist6", "hexapod")  # Robots of the latest kinds.
TILT = Rotation.from_euler("xyz", [35.0, -25.0, 20.0], degrees=True)


def urdf(name: str, rng) -> str:
    links = []
    for k, (kind, axis, limit) in enumerate(ROBOTS[name], start=1):
        m = 3.0 * 0.7**k * rng.uniform(0.8, 1.2)
        links.append(
            LINK.format(
                k=k, c=-0.12, m=m, i=m * 0.012, z=m * 0.003, name=f"joint{k}",
                type=kind,
                parent=PARENTS.get(name, {}).get(k, f"l{k - 1}" if k > 1 else "base"),
                z0=-0.3 if k > 1 else 0.5, axis=axis, low=-limit, high=limit,
            )
        )  # fmt: skip
    return f'<robot name="arm"><link name="base"/>{"".join(links)}</robot>'


@dataclass
class Log:
    """What is written: names, columns (n,) and how. truth: {channel: (n,)}."""

    time: np.ndarray
    columns: dict[str, np.ndarray]
    truth: dict[str, np.ndarray]
    joints: int
    limits: list[float]
    slides: list[bool]
    weight: np.ndarray
    tilted: np.ndarray  # Its weight on a base that is turned by TILT.
    rng: np.random.Generator
    write: Callable[[Path, dict], Path] | None = None


def exact(name: str, folder: Path, rng) -> tuple[Path, Log]:
    path = folder / "arm.urdf"
    path.write_text(urdf(name, rng))
    robot = read_robot(path)
    n = len(robot.joints)
    t = np.arange(0.0, 12.0, 1.0 / RATE)
    q, v, a = (np.zeros((len(t), n)) for _ in range(3))
    slides = [j.prismatic for j in robot.joints]
    for i in range(n):
        size = 0.25 if slides[i] else 0.6
        for _ in range(3):
            w, phase = 2.0 * np.pi * rng.uniform(0.15, 0.8), rng.uniform(0.0, 6.3)
            s = size * rng.uniform(0.5, 1.0)
            q[:, i] += s * np.sin(w * t + phase)
            v[:, i] += s * w * np.cos(w * t + phase)
            a[:, i] -= s * w * w * np.sin(w * t + phase)
    plant, tau = robot.plant, np.zeros_like(q)
    context, forces = plant.CreateDefaultContext(), MultibodyForces(plant)
    weight, tilted = np.zeros_like(q), np.zeros_like(q)
    turned = _load_tilted(path, robot)
    for k in range(len(t)):
        plant.SetPositions(context, q[k])
        plant.SetVelocities(context, v[k])
        plant.CalcForceElementsContribution(context, forces)
        tau[k] = plant.CalcInverseDynamics(context, a[k], forces)
        weight[k] = -plant.CalcGravityGeneralizedForces(context)
        turned[0].SetPositions(turned[1], q[k])
        tilted[k] = -turned[0].CalcGravityGeneralizedForces(turned[1])
    if rng.random() < 0.5:
        i = int(rng.integers(n))
        tau[:, i] += 0.15 * np.std(tau[:, i]) * np.sign(v[:, i])
    truth, columns = {}, {}
    for i in range(n):
        noisy = (("position", q, 1e-5), ("velocity", v, 1e-3),
                 ("effort_measured", tau, 2e-3 * np.std(tau[:, i])))  # fmt: skip
        for what, y, noise in noisy:
            truth[f"arm.joint{i + 1}.{what}"] = y[:, i]
            short = what.split("_")[0]
            columns[f"joint{i + 1}_{short}"] = y[:, i] + rng.normal(0.0, noise, len(t))
    limits = [j.upper for j in robot.joints]
    return path, Log(t, columns, truth, n, limits, slides, weight, tilted, rng)


def _load_tilted(path: Path, robot):
    """The robot under gravity as its base feels it where it is turned by TILT."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(path))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName([*robot.bases][0]))
    down = TILT.inv().apply([0.0, 0.0, -9.81])
    plant.mutable_gravity_field().set_gravity_vector(down)
    plant.Finalize()
    return plant, plant.CreateDefaultContext()


def names(log: Log, what: str) -> list[str]:
    return [f"joint{i + 1}_{what}" for i in range(log.joints)]


# ----- What may be wrong: each changes a log in place, and returns words of which one
# must be said; "" where nothing need be said as it is simply right.


def scaled(what, factor, *words):
    def wrong(log: Log):
        for name in names(log, what):
            log.columns[name] = log.columns[name] / factor
        return words

    return wrong


def each_gear(log: Log):
    gears = log.rng.choice([30.0, 50.0, 80.0, 100.0, 120.0], log.joints)
    for name, gear in zip(names(log, "effort"), gears, strict=True):
        log.columns[name] = log.columns[name] / gear
    return ("smaller than the model needs",)


def noisy_gear(log: Log):
    """Noise as large as the signal, which makes a factor of least squares too small."""
    for k, name in enumerate(names(log, "effort")):
        y = log.columns[name]
        y = y + np.std(y) * log.rng.normal(size=len(y))
        log.truth[f"arm.joint{k + 1}.effort_measured"] = y
        log.columns[name] = y / 50.0
    return ("smaller than the model needs",)


def without_weight(log: Log):
    """As a controller commands that carries the robot's weight by itself."""
    for k, name in enumerate(names(log, "effort")):
        log.columns[name] = log.columns[name] - log.weight[:, k]
        log.truth[f"arm.joint{k + 1}.effort_measured"] -= log.weight[:, k]
    # A weight that is always the same looks like a bias.
    return ("gravity: [0.0, 0.0, 0.0]" if np.ptp(log.weight, axis=0).any() else "",)


def signs(log: Log):
    for name in names(log, "effort"):
        log.columns[name] = -log.columns[name]
    return ("other sign",)


def one_sign(log: Log):
    name = names(log, "effort")[-1]
    log.columns[name] = -log.columns[name]
    return ("other sign",)


def swapped(*whats):
    def wrong(log: Log):
        for what in whats:
            a, b = names(log, what)[-2:]
            log.columns[a], log.columns[b] = log.columns[b], log.columns[a]
        return ("swapped",)

    return wrong


def shifted(*whats):
    def wrong(log: Log):
        for what in whats:
            mine = names(log, what)
            values = [log.columns[name] for name in mine]
            for k, name in enumerate(mine):
                log.columns[name] = values[(k + 1) % len(mine)]
        return ("one off", "swapped")

    return wrong


def decoy(name, make, *words):
    """Another column before the right one."""

    def wrong(log: Log):
        own = {}
        for i in range(log.joints):
            of = {w: log.columns[f"joint{i + 1}_{w}"]
                  for w in ("position", "velocity", "effort")}  # fmt: skip
            own[name.format(i + 1)] = make(log, of)
        log.columns = own | log.columns
        return words

    return wrong


def dead_command(value):
    def wrong(log: Log):
        for i in range(log.joints):
            y = np.full(len(log.time), value)
            log.columns[f"joint{i + 1}_effort_command"] = y
        return ("throughout while", "empty", "no sample")

    return wrong


def other_effort(log: Log):
    """A column with a good name that has nothing to do with the effort."""
    own = {f"joint{i + 1}_torque": log.rng.normal(0.0, 1.0, len(log.time))
           for i in range(log.joints)}  # fmt: skip
    renamed = {k.replace("effort", "torque_sensor"): y for k, y in log.columns.items()}
    log.columns = own | renamed
    return ("explains",)


def currents(log: Log):
    gains = log.rng.uniform(0.5, 12.0, log.joints)
    for i in range(log.joints):
        y = log.columns.pop(f"joint{i + 1}_effort")
        log.columns[f"joint{i + 1}_current"] = y / gains[i]
    log.truth = {"gains": gains}
    return ("currents",)


def turns(log: Log):
    i = next((k for k in range(log.joints) if not log.slides[k]), None)
    if i is None:
        return ("",)
    name = f"joint{i + 1}_position"
    q = log.columns[name]
    q = q + (np.pi - np.quantile(q, 0.8))
    log.columns[name] = np.mod(q + np.pi, 2.0 * np.pi) - np.pi
    log.truth.clear()  # Where it stands is another matter; only the jumps are judged.
    log.truth["turns"] = np.array([i])
    return ("whole turn",)


def from_zero(log: Log):
    """0 to 360 degrees of joints that count from -180."""
    for i, name in enumerate(names(log, "position")):
        if not log.slides[i]:
            log.columns[name] = np.mod(np.rad2deg(log.columns[name]), 360.0)
    return ("turn", "degrees")


def degrees(what):
    def wrong(log: Log):
        for i, name in enumerate(names(log, what)):
            if not log.slides[i]:
                log.columns[name] = np.rad2deg(log.columns[name])
        return ("deg",)

    return wrong


def rates(factor, *words):
    def wrong(log: Log):
        for i, name in enumerate(names(log, "velocity")):
            if not log.slides[i]:
                log.columns[name] = log.columns[name] * factor
        return words if not all(log.slides) else ("",)

    return wrong


def late(what, seconds, *words):
    def wrong(log: Log):
        for name in names(log, what):
            y = log.columns[name]
            log.columns[name] = np.interp(log.time - seconds, log.time, y)
        log.truth = {k: y for k, y in log.truth.items() if "velocity" not in k}
        return words

    return wrong


def stamps(make, *words, key="time"):
    def wrong(log: Log):
        log.columns = {key: make(log)} | log.columns
        return words

    return wrong


def pause(log: Log):
    t = log.time.copy()
    t[len(t) // 2 :] += 5.0
    log.columns = {"time": t} | log.columns
    log.truth = {}
    return ("hole",)


def back(log: Log):
    t = log.time.copy()
    t[500] = t[480]
    log.columns = {"time": t} | log.columns
    return ("step back",)


def twice(log: Log):
    k = np.sort(np.append(np.arange(len(log.time)), np.arange(100, 1000, 90)))
    log.columns = {"time": log.time[k]} | {n: y[k] for n, y in log.columns.items()}
    log.truth = {}
    return ("row before once more",)


def iso(log: Log):
    start = np.datetime64("2026-11-27T22:00:00", "us")
    stamps = start + np.rint(1e6 * log.time).astype("timedelta64[us]")
    text = [str(s).replace("T", " ") for s in stamps]

    def write(folder: Path, columns: dict) -> Path:
        path = folder / "log.csv"
        table = np.stack(list(columns.values()), axis=1)
        rows = [",".join([s, *(f"{x:.9g}" for x in row)])
                for s, row in zip(text, table, strict=True)]  # fmt: skip
        path.write_text("\n".join([",".join(["timestamp", *columns]), *rows]) + "\n")
        return path

    log.write = write
    return ("time",)


def semicolons(log: Log):
    def write(folder: Path, columns: dict) -> Path:
        path = folder / "log.csv"
        rows = [";".join(f"{x:.9g}".replace(".", ",") for x in row)
                for row in zip(*columns.values(), strict=True)]  # fmt: skip
        path.write_text("\n".join([";".join(columns), *rows]) + "\n")
        return path

    log.columns = {"time": log.time} | log.columns
    log.write = write
    return ("",)


def noisy_column(name, value, *words):
    def wrong(log: Log):
        own = {name.format(i + 1): value + log.rng.normal(0.0, 0.01, len(log.time))
               for i in range(log.joints)}  # fmt: skip
        log.columns = own | log.columns
        return words

    return wrong


def as_npz(log: Log):
    """As Isaac Lab and PACE have it: arrays of rows, dt, joints' names."""

    def write(folder: Path, columns: dict) -> Path:
        path = folder / "log.npz"
        arrays = {
            array: np.stack([columns[n] for n in names(log, what)], axis=1)
            for array, what in (("dof_pos", "position"), ("dof_vel", "velocity"),
                                ("applied_torque", "effort"))
        }  # fmt: skip
        named = np.array([f"joint{i + 1}" for i in range(log.joints)])
        np.savez(path, **arrays, dof_names=named, step_dt=1.0 / RATE, env="lab")
        return path

    log.write = write
    return ("dt",)


def as_mat(log: Log):
    def write(folder: Path, columns: dict) -> Path:
        path = folder / "log.mat"
        savemat(path, {"meas": {
            "t": log.time, **{key: np.stack([columns[n] for n in names(log, what)])
                              for key, what in (("q", "position"), ("dq", "velocity"),
                                                ("tau", "effort"))},
        }})  # fmt: skip
        return path

    log.write = write
    return ("",)


def text_file(separator, above="", below="", missing="", every=0, suffix=".csv"):
    """A table as other programs write it."""

    def wrong(log: Log):
        def write(folder: Path, columns: dict) -> Path:
            path = folder / f"log{suffix}"
            rows = []
            for k, row in enumerate(zip(*columns.values(), strict=True)):
                cells = [f"{x:.9g}" for x in row]
                if every and k % every == 5:
                    cells[-1] = missing
                rows.append(separator.join(cells))
            head = [above, separator.join(columns)]
            if below:
                unit = {"position": "rad", "velocity": "rad/s", "effort": "Nm"}
                head.append(separator.join(
                    ["s", *(unit[name.split("_")[1]] for name in list(columns)[1:])]
                ))  # fmt: skip
            path.write_text("\n".join([*filter(None, head), *rows]) + "\n")
            return path

        log.columns = {"time": log.time} | log.columns
        log.write = write
        if every:
            log.truth.pop(f"arm.joint{log.joints}.effort_measured")
        return ("",)

    return wrong


def rows_in(order, *words):
    """Rows in another order, or with other stamps: order(log) gives rows and times."""

    def wrong(log: Log):
        rows, time = order(log)
        log.columns = {"time": time[rows]} | {
            n: y[rows] for n, y in log.columns.items()
        }
        return words

    return wrong


def restarted(log: Log):
    half = len(log.time) // 2
    t = np.where(np.arange(len(log.time)) < half, log.time, log.time - log.time[half])
    log.columns = {"time": t} | log.columns
    log.truth = {}
    return ("starts again",)


def shuffled(log: Log):
    rows = np.arange(len(log.time))
    for k in range(100, 1000, 40):
        rows[k : k + 6] = log.rng.permutation(rows[k : k + 6])
    return rows, log.time


def cycled(what):
    """Columns of three joints in another order."""

    def wrong(log: Log):
        mine = names(log, what)
        if len(mine) < 3:
            return swapped(what)(log)
        a, b, c = mine[0], mine[1], mine[2]
        cols = log.columns
        cols[a], cols[b], cols[c] = cols[c], cols[a], cols[b]
        return ("another order", "one off", "swapped")

    return wrong


def position_sign(log: Log):
    """An encoder that counts the other way, while the velocity is right."""
    name = names(log, "position")[0]
    log.columns[name] = -log.columns[name]
    return ("other sign",)


def in_turns(log: Log):
    for i in range(log.joints):
        if not log.slides[i]:
            for what in ("position", "velocity"):
                log.columns[f"joint{i + 1}_{what}"] /= 2.0 * np.pi
    return ("turns", "revolutions") if not all(log.slides) else ("",)


def hung(log: Log):
    """An IMU of the base, which stands level."""
    n = len(log.time)
    off = Rotation.from_rotvec(log.rng.normal(0.0, 1e-3, (n, 3))).as_quat()
    own = {f"imu_orientation_{k}": off[:, i] for i, k in enumerate("xyzw")}
    log.columns |= own
    return ("at the pose that the log has",)


def lost_rows(log: Log):
    kept = np.flatnonzero(log.rng.random(len(log.time)) > 0.15)
    kept[0] = 0
    return kept, log.time


def sign_and_gear(log: Log):
    for name in names(log, "effort"):
        log.columns[name] = log.columns[name] / -64.0
    return ("in another unit, and of the other sign",)


def renamed(position, velocity, effort, time="time"):
    """Columns as other loggers call them; {} is the joint's number."""

    def wrong(log: Log):
        new = {"position": position, "velocity": velocity, "effort": effort}
        own = {}
        for name, y in log.columns.items():
            joint, what = name.split("_")
            own[new[what].format(joint.removeprefix("joint"))] = y
        log.columns = {time: log.time} | own
        log.write = lambda folder, columns: csv_of(folder / "log.csv", columns)
        return ("",)

    return wrong


def csv_of(path: Path, columns: dict, header=None, text=None) -> Path:
    """A csv with its first column as text, if given."""
    rows = []
    for k, row in enumerate(zip(*columns.values(), strict=True)):
        cells = [f"{x:.12g}" for x in row]
        if text is not None:
            cells[0] = text[k]
        rows.append(",".join(cells))
    path.write_text("\n".join([",".join(header or columns), *rows]) + "\n")
    return path


def with_text_times(write):
    """Times as text, by what writes one [s]."""

    def wrong(log: Log):
        text = [write(t) for t in log.time]
        log.columns = {"time": log.time} | log.columns
        log.write = lambda to, columns: csv_of(to / "log.csv", columns, text=text)
        return ("",)

    return wrong


clock_text = with_text_times(lambda t: f"22:{int(t // 60):02d}:{t % 60:09.6f}")
# As pandas writes the time since a start.
timedeltas = with_text_times(lambda t: f"0 days 00:00:{t:09.6f}")


def with_index(log: Log):
    """As pandas writes a frame, with a column of row numbers that has no name."""
    log.columns = {"": np.arange(len(log.time)), "time": log.time} | log.columns
    log.write = lambda folder, columns: csv_of(folder / "log.csv", columns)
    return ("",)


def twice_named(log: Log):
    """Two columns of one name, as of two sources in one frame."""
    log.columns = {"time": log.time} | log.columns
    own = [*log.columns, "joint1_effort"]

    def write(folder: Path, columns: dict) -> Path:
        more = columns | {"again": columns["joint1_effort"]}
        return csv_of(folder / "log.csv", more, header=own)

    log.write = write
    return ("(again)",)


def hundredths(log: Log):
    """Of a degree, as whole numbers."""
    for i, name in enumerate(names(log, "position")):
        if not log.slides[i]:
            log.columns[name] = np.rint(100.0 * np.rad2deg(log.columns[name]))
    return ("deg",) if not all(log.slides) else ("",)


def swapped_and_sign(log: Log):
    signs(log)
    swapped("effort")(log)
    return ("swapped",)


def missing_effort(log: Log):
    name = names(log, "effort")[-1]
    del log.columns[name]
    log.truth = {k: y for k, y in log.truth.items()
                 if not k.startswith(f"arm.joint{log.joints}.effort")}  # fmt: skip
    return ("effort",)


def empty_velocity(log: Log):
    name = names(log, "velocity")[0]
    log.columns[name] = np.full(len(log.time), np.nan)
    log.truth.pop("arm.joint1.velocity")
    return ("no sample",)


def noise(log, of):
    return 0.1 * np.std(of["effort"]) * log.rng.normal(size=len(log.time))


# ----- A third time: further wrong things, for robots of LATER.


def tilted_base(log: Log):
    """A base that stands tilted, its quaternion as an array with w first."""
    n = len(log.time)
    off = Rotation.from_rotvec(log.rng.normal(0.0, 1e-3, (n, 3)))
    turned = (TILT * off).as_quat(scalar_first=True)
    log.columns |= {f"base_orientation[{k}]": turned[:, k] for k in range(4)}
    for k in range(log.joints):
        more = log.tilted[:, k] - log.weight[:, k]
        log.truth[f"arm.joint{k + 1}.effort_measured"] += more
        log.columns[f"joint{k + 1}_effort"] += more
    return ("at the pose that the log has",)


def two_robots(log: Log):
    """The columns of another arm of this kind, which moved otherwise, come after."""
    later = {f"right/{name}": np.roll(y, 377) for name, y in log.columns.items()}
    log.columns = {f"left/{name}": y for name, y in log.columns.items()} | later
    return ("is another column", "right/")


def all_in_another_order(log: Log):
    """As a simulator that sorts its joints gives arrays without names."""
    order = log.rng.permutation(log.joints)
    if (order == np.arange(log.joints)).all():
        order = np.roll(order, 1)
    own = {}
    for what in ("position", "velocity", "effort"):
        mine = names(log, what)
        own |= {f"{what}[{i}]": log.columns[mine[k]] for i, k in enumerate(order)}
    log.columns = own
    return ("order", "swapped", "one off")


def backward_differences(log: Log):
    step = log.time[1] - log.time[0]
    for i, name in enumerate(names(log, "velocity")):
        q = log.truth[f"arm.joint{i + 1}.position"]
        log.columns[name] = np.diff(q, prepend=q[0]) / step
    log.truth = {k: y for k, y in log.truth.items() if "velocity" not in k}
    return ("backward difference",)


def quarter_turn(log: Log):
    """Another zero of one joint that carries weight."""
    load = np.std(log.weight, axis=0) * ~np.array(log.slides)
    i = int(np.argmax(load))
    log.columns[f"joint{i + 1}_position"] += 0.5 * np.pi
    if load[i] == 0.0:  # Nothing shows it.
        log.truth.pop(f"arm.joint{i + 1}.position")
    return ("-90 deg",) if load[i] > 0.0 else ("",)


def one_in_degrees(log: Log):
    if all(log.slides):
        return ("",)
    i = max(k for k in range(log.joints) if not log.slides[k])
    name = f"joint{i + 1}_position"
    log.columns[name] = np.rad2deg(log.columns[name])
    return ("deg",)


def ticks(log: Log):
    """Of an encoder with 4096 in a turn, whose middle is 2048."""
    for i, name in enumerate(names(log, "position")):
        if not log.slides[i]:
            turns = log.columns[name] / (2.0 * np.pi)
            log.columns[name] = np.rint(2048.0 + 4096.0 * turns)
    return ("steps of",) if not all(log.slides) else ("",)


def as_text(edit, *words):
    """The csv's lines, edited."""

    def wrong(log: Log):
        def write(folder: Path, columns: dict) -> Path:
            path = csv_of(folder / "log.csv", columns)
            path.write_bytes(edit(path.read_text()).encode())
            return path

        log.columns = {"time": log.time} | log.columns
        log.write = write
        return words

    return wrong


def nan_at_start(log: Log):
    """The first readings are not there yet, of all but the time."""
    for name in log.columns:
        log.columns[name][:60] = np.nan
    log.columns = {"time": log.time} | log.columns
    log.truth = {}

    def write(folder: Path, columns: dict) -> Path:
        return csv_of(folder / "log.csv", columns)

    log.write = write
    return ("",)


def commands_in_degrees(log: Log):
    """Goals in degrees beside positions in rad, and nothing else."""
    own = {}
    for i in range(log.joints):
        q = log.columns[f"joint{i + 1}_position"]
        at = f"arm.joint{i + 1}"
        goal = np.interp(log.time + 0.04, log.time, log.truth[f"{at}.position"])
        log.truth[f"{at}.position_command"] = goal
        own |= {
            f"joint{i + 1}_position": q,
            f"joint{i + 1}_goal": goal if log.slides[i] else np.rad2deg(goal),
        }
    log.columns = own
    log.truth = {k: y for k, y in log.truth.items() if "position" in k}
    return ("deg",) if not all(log.slides) else ("",)


def zeros_before_power(log: Log):
    for y in log.columns.values():
        y[:200] = 0.0
    log.truth = {"after": np.array([2.0]), **log.truth}
    return ("stand still", "power", "zero")


def block_twice(log: Log):
    """A part of the file was written a second time, at its end."""
    k = np.append(np.arange(len(log.time)), np.arange(300, 500))
    log.columns = {"time": log.time[k]} | {n: y[k] for n, y in log.columns.items()}
    log.truth = {}
    return ("once more", "step back", "starts again")


def zero_to_two_pi(log: Log):
    for i, name in enumerate(names(log, "position")):
        if not log.slides[i]:
            log.columns[name] = np.mod(log.columns[name], 2.0 * np.pi)
    return ("turn",)


def two_part_stamps(log: Log):
    at = 1_764_280_000.25 + log.time
    sec = np.floor(at)
    nsec = np.rint(1e9 * (log.time + 0.25 - np.floor(log.time + 0.25)))
    stamps = {"header.stamp.sec": sec, "header.stamp.nanosec": nsec}
    log.columns = stamps | log.columns
    log.write = lambda folder, columns: csv_of(folder / "log.csv", columns)
    return ("nanosec",)


def mm_and_degrees(log: Log):
    for i in range(log.joints):
        factor = 1e3 if log.slides[i] else 180.0 / np.pi
        for what in ("position", "velocity"):
            log.columns[f"joint{i + 1}_{what}"] *= factor
    return ("deg", "mm")


def date_with_comma(log: Log):
    """As Python's logging writes it, in a file of semicolons."""
    start = np.datetime64("2026-11-27T22:00:00", "ms")
    stamps = start + np.rint(1e3 * log.time).astype("timedelta64[ms]")
    text = [str(s).replace("T", " ").replace(".", ",") for s in stamps]

    def write(folder: Path, columns: dict) -> Path:
        rows = [";".join([s, *(f"{x:.9g}" for x in row)])
                for s, row in zip(text, zip(*columns.values(), strict=True),
                                  strict=True)]  # fmt: skip
        path = folder / "log.csv"
        path.write_text("\n".join([";".join(["asctime", *columns]), *rows]) + "\n")
        return path

    log.write = write
    return ("",)


def header_again(text: str) -> str:
    """The logger was started a second time with the same file."""
    head, *rows = text.splitlines()
    return "\n".join([head, *rows[:700], head, *rows[700:]]) + "\n"


def one_velocity_sign(log: Log):
    name = names(log, "velocity")[-1]
    log.columns[name] = -log.columns[name]
    return ("other sign",)


def rows_of_their_own(log: Log):
    """Topics written as they come: each row has one topic's numbers."""
    n = len(log.time)
    for name, y in log.columns.items():
        k = ("position", "velocity", "effort").index(name.split("_")[1])
        y[np.arange(n) % 3 != k] = np.nan
    log.columns = {"time": log.time} | log.columns
    log.truth = {}
    return ("",)


def with_status(log: Log):
    """Text and flags beside the numbers."""
    n = len(log.time)

    def write(folder: Path, columns: dict) -> Path:
        head = [*columns, "state", "enabled", "fault"]
        rows = [
            ",".join(
                [
                    *(f"{x:.12g}" for x in row),
                    "RUN" if k < n // 2 else "HOLD",
                    "TRUE",
                    "None",
                ]
            )
            for k, row in enumerate(zip(*columns.values(), strict=True))
        ]
        path = folder / "log.csv"
        path.write_text("\n".join([",".join(head), *rows]) + "\n")
        return path  # fmt: skip

    log.columns = {"time": log.time} | log.columns
    log.write = write
    return ("",)


def tabs_and_commas(text: str) -> str:
    return text.replace(",", "\t").replace(".", ",")


def bad_cells(text: str) -> str:
    """As a C++ program for Windows prints what is no number."""
    head, *rows = text.splitlines()
    for k in range(5, len(rows), 45):
        rows[k] = ",".join([*rows[k].split(",")[:-1], "-nan(ind)"])
    return "\n".join([head, *rows]) + "\n"


# ----- A fourth time.


def one_factor(what, factor, *words):
    """One joint's column alone, in another unit."""

    def wrong(log: Log):
        load = np.std([log.columns[n] for n in names(log, "effort")], axis=1)
        i = int(np.argmax(load * ~np.array(log.slides)))
        name = f"joint{i + 1}_{what}"
        log.columns[name] = log.columns[name] / factor
        return words if not all(log.slides) else ("",)

    return wrong


def half_turn(log: Log):
    load = np.std(log.weight, axis=0) * ~np.array(log.slides)
    i = int(np.argmax(load))
    log.columns[f"joint{i + 1}_position"] += np.pi
    log.truth.pop(f"arm.joint{i + 1}.position")  # A turn is none.
    return ("180 deg",) if load[i] > 0.0 else ("",)


def newest_first(log: Log):
    log.columns = {"time": log.time} | log.columns
    log.columns = {name: y[::-1] for name, y in log.columns.items()}
    return ("order of their stamps", "newest")


def in_cm(log: Log):
    for i in range(log.joints):
        if log.slides[i]:
            log.columns[f"joint{i + 1}_position"] *= 100.0
    return ("cm",) if any(log.slides) else ("",)


def per_cent(log: Log):
    """Of a rating of each motor."""
    ratings = log.rng.uniform(5.0, 40.0, log.joints)
    for name, rating in zip(names(log, "effort"), ratings, strict=True):
        log.columns[name] = 100.0 * log.columns[name] / rating
    return ("larger than the model needs",)


def goals_late(log: Log):
    """Goals beside efforts, which are not what drives the joints here."""
    for i in range(log.joints):
        q = log.truth[f"arm.joint{i + 1}.position"]
        goal = np.interp(log.time + 0.1, log.time, q)
        log.columns[f"joint{i + 1}_goal_position"] = goal
    return ("effort_measured is taken",)


KINDS = {
    "effort in N mm": scaled("effort", 1e-3, "N mm"),
    "effort in N cm": scaled("effort", 1e-2, "N cm"),
    "effort in kN m": scaled("effort", 1e3, "kN m"),
    "effort in kgf cm": scaled("effort", 0.0980665, "kgf cm"),
    "effort before one gear": scaled("effort", 50.0, "smaller than the model needs"),
    "effort before gears": each_gear,
    "noisy effort before a gear": noisy_gear,
    "effort without weight": without_weight,
    "effort with a constant": scaled("effort", 3.7, "smaller than the model needs"),
    "effort of other sign": signs,
    "one effort of other sign": one_sign,
    "two efforts swapped": swapped("effort"),
    "efforts one off": shifted("effort"),
    "two velocities swapped": swapped("velocity"),
    "velocities one off": shifted("velocity"),
    "two positions swapped": swapped("position"),
    "external torque first": decoy("joint{}_torque_external", noise, "external"),
    "gravity first": decoy(
        "joint{}_tau_gravity", lambda log, of: 0.7 * of["effort"], "gravity"
    ),
    "feedforward first": decoy(
        "joint{}_torque_ff", lambda log, of: 0.8 * of["effort"], "ff"
    ),
    "error first": decoy("joint{}_position_error", noise, "position_error"),
    "lower limits first": noisy_column("joint{}_position_min", -2.0, "position_min"),
    "temperatures first": noisy_column("joint{}_temperature", 35.0, "temperature"),
    "motor position first": decoy(
        "motor_position_joint{}",
        lambda log, of: 100.0 * of["position"],
        "is another column",
    ),
    "raw position first": decoy(
        "joint{}_position_raw",
        lambda log, of: 651.9 * of["position"] + 2048.0,
        "is another column",
    ),
    "command of zeros": dead_command(0.0),
    "command that stays": dead_command(1.7),
    "command that is empty": dead_command(np.nan),
    "effort that is none": other_effort,
    "currents alone": currents,
    "effort missing at one joint": missing_effort,
    "velocity that is empty": empty_velocity,
    "position jumps by a turn": turns,
    "positions from 0 to 360": from_zero,
    "positions in degrees": degrees("position"),
    "velocities in degrees": rates(180.0 / np.pi, "deg/s"),
    "velocities in rpm": rates(60.0 / (2.0 * np.pi), "rpm"),
    "velocities of other sign": rates(-1.0, "other sign"),
    "velocities late": late("velocity", 0.02, "after position"),
    "time in ns": stamps(lambda log: 1.7e18 + np.rint(1e9 * log.time), "as ns"),
    "time in us": stamps(lambda log: np.rint(1e6 * log.time), "as us", key="utime"),
    "time in ms": stamps(lambda log: 1e3 * log.time, "as ms"),
    "time as text": iso,
    "a pause": pause,
    "a stamp that steps back": back,
    "rows twice": twice,
    "semicolons and commas": semicolons,
    # Written before anything was seen of them, for robots that are not above either.
    "npz with names and dt": as_npz,
    "mat with a struct": as_mat,
    "blanks and comments": text_file("  ", "# rig 2\n# run 7", suffix=".txt"),
    "tabs": text_file("\t", suffix=".tsv"),
    "a row of units": text_file(",", below="units"),
    "lines above the header": text_file(",", "Robot: rig 2\nDate: Friday"),
    "missing cells as N/A": text_file(",", missing="N/A", every=40),
    "missing cells as null": text_file(",", missing="null", every=40),
    "missing cells as -": text_file(";", missing="-", every=40),
    "time starts again": restarted,
    "rows shuffled": rows_in(shuffled, "order of their stamps"),
    "rows lost": rows_in(lost_rows, ""),
    "a stamp far ahead": rows_in(
        lambda log: (np.arange(len(log.time)),
                     np.where(np.arange(len(log.time)) == 300, 1e6, log.time)),
        "step back",
    ),
    "coarse stamps": rows_in(
        lambda log: (np.arange(len(log.time)), np.floor(log.time * 25.0) / 25.0),
        "coarser",
    ),
    "time in ticks of 0.1 ms": stamps(lambda log: np.rint(1e4 * log.time), "time"),
    "time in minutes": stamps(lambda log: log.time / 60.0, "min", key="t_min"),
    "efforts in another order": cycled("effort"),
    "positions in another order": cycled("position"),
    "one position of other sign": position_sign,
    "positions in turns": in_turns,
    "effort in lbf in": scaled("effort", 0.112985, "lbf in"),
    "effort of other sign before a gear": sign_and_gear,
    "torque limits first": noisy_column("joint{}_torque_limit", 80.0, "torque_limit"),
    "velocity error first": decoy("joint{}_velocity_error", noise, "velocity_error"),
    "an IMU on the base": hung,
    # A second time.
    "names of a controller": renamed("actualPos{}", "actualVel{}", "actualTorque{}"),
    "names of a topic": renamed(
        "/arm/joint{}/pos", "/arm/joint{}/vel", "/arm/joint{}/eff", "/arm/stamp"
    ),
    "names in German": renamed(
        "Winkel {} [rad]", "Geschw {} [rad/s]", "Moment {} [Nm]", "Zeit [s]"
    ),
    "seconds since 1970": stamps(lambda log: 1.7e9 + log.time, ""),
    "time of day": clock_text,
    "a frame's index": with_index,
    "a name that comes twice": twice_named,
    "positions in hundredths of a degree": hundredths,
    "efforts swapped and of other sign": swapped_and_sign,
    # A third time.
    "a tilted base": tilted_base,
    "two robots in one log": two_robots,
    "all columns in another order": all_in_another_order,
    "velocities as backward differences": backward_differences,
    "one position off by 90 degrees": quarter_turn,
    "one joint in degrees": one_in_degrees,
    "steps of encoders from 2048": ticks,
    "a header behind a hash": as_text(lambda text: f"# {text}", ""),
    "tabs and decimal commas": as_text(tabs_and_commas, ""),
    "trailing commas": as_text(lambda text: text.replace("\n", ",\n"), ""),
    "a byte order mark and CRLF": as_text(
        lambda text: "\ufeff" + text.replace("\n", "\r\n"), ""
    ),
    "nothing at the start": nan_at_start,
    "commands in degrees": commands_in_degrees,
    "zeros before power": zeros_before_power,
    "a block of rows twice": block_twice,
    "positions from 0 to 2 pi": zero_to_two_pi,
    "stamps in two parts": two_part_stamps,
    "velocities in turns": rates(1.0 / (2.0 * np.pi), "rev", "turn"),
    "mm and degrees": mm_and_degrees,
    "dates with a comma": date_with_comma,
    "the last row cut": as_text(lambda text: text[:-40], "cut", "last row"),
    "the header again": as_text(header_again, "header"),
    "cells of nan(ind)": as_text(bad_cells, ""),
    "time in days": stamps(lambda log: 46_000.25 + log.time / 86_400.0, "time"),
    "one velocity of other sign": one_velocity_sign,
    "topics on rows of their own": rows_of_their_own,
    "a status beside": with_status,
}  # fmt: skip
KINDS |= {
    # A fourth time.
    "one velocity in degrees": one_factor("velocity", np.pi / 180.0, "deg/s"),
    "one effort in N mm": one_factor("effort", 1e-3, "N mm"),
    "times since a start": timedeltas,
    "one position off by 180 degrees": half_turn,
    "the newest row first": newest_first,
    "slides in cm": in_cm,
    "efforts in per cent": per_cent,
    "time in hours": stamps(lambda log: log.time / 3600.0, "3600 s"),
    "quoted cells": as_text(
        lambda text: "".join(
            ",".join(f'"{x}"' for x in row.split(",")) + "\n"
            for row in text.splitlines()
        ), ""
    ),
    "goals beside efforts": goals_late,
}  # fmt: skip


def joint_state(text: str) -> str:
    """As `ros2 topic echo --csv` writes it: joints by name, and no header."""
    head, *rows = text.splitlines()
    order = sorted(range(1, len(head.split(","))),
                   key=lambda k: ["position", "velocity", "effort"].index(
                       head.split(",")[k].split("_")[1]))  # fmt: skip
    named = ",".join(f"joint{i + 1}" for i in range(len(order) // 3))
    out = []
    for row in rows:
        cells = row.split(",")
        stamp = (
            f"{1_764_300_000 + int(float(cells[0]))},{round(float(cells[0]) % 1 * 1e9)}"
        )
        out.append(f"{stamp},base,{named},{','.join(cells[k] for k in order)}\n")
    return "".join(out)


def long(text: str) -> str:
    """A row for each joint."""
    head, *rows = (line.split(",") for line in text.splitlines())
    n = (len(head) - 1) // 3
    out = ["time,joint,position,velocity,effort"]
    for row in rows:
        for i in range(n):
            out.append(f"{row[0]},joint{i + 1},{','.join(row[3 * i + 1 : 3 * i + 4])}")
    return "\n".join(out) + "\n"


def json_lines(log: Log):
    def write(folder: Path, columns: dict) -> Path:
        path = folder / "log.jsonl"
        each = [[columns[n] for n in names(log, w)] for w in ("position", "effort")]
        path.write_text("".join(
            json.dumps({"t": t, "q": [y[k] for y in each[0]],
                        "tau": [y[k] for y in each[1]]}) + "\n"
            for k, t in enumerate(log.time)
        ))  # fmt: skip
        return path

    log.truth = {k: y for k, y in log.truth.items() if "velocity" not in k}
    log.write = write
    return ("",)


def with_units(text: str) -> str:
    """Of SI, behind each number, and in a name without brackets."""
    head, *rows = (line.split(",") for line in text.splitlines())
    unit = {"position": "rad", "velocity": "rad/s", "effort": "Nm", "time": "s"}
    units = [unit[name.split("_")[-1]] for name in head]
    out = [",".join(f"{n} {u}" for n, u in zip(head, units, strict=True))]
    for row in rows:
        out.append(",".join(f"{x} {u}" for x, u in zip(row, units, strict=True)))
    return re.sub(r"_(position|velocity|effort)", "", "\n".join(out)) + "\n"


def in_tuples(log: Log):
    def write(folder: Path, columns: dict) -> Path:
        path = folder / "log.csv"
        rows = ["time,q,dq,tau"]
        for k, t in enumerate(log.time):
            lists = [tuple(float(columns[n][k]) for n in names(log, w))
                     for w in ("position", "velocity", "effort")]  # fmt: skip
            rows.append(f"{t:.6f}," + ",".join(f'"{each}"' for each in lists))
        path.write_text("\n".join(rows) + "\n")
        return path

    log.write = write
    return ("",)


def after_a_base(log: Log):
    """All coordinates, as MuJoCo and pinocchio have them."""
    still = {f"qpos_{k}": np.full(len(log.time), float(k == 3)) for k in range(7)}
    still |= {f"qvel_{k}": np.zeros(len(log.time)) for k in range(6)}
    own = {}
    for what, name, n in (("position", "qpos", 7), ("velocity", "qvel", 6),
                          ("effort", "ctrl", 0)):  # fmt: skip
        for k, column in enumerate(names(log, what)):
            own[f"{name}_{k + n}"] = log.columns[column]
    log.columns = still | own
    log.truth = {k.replace("_measured", "_command"): y for k, y in log.truth.items()}
    return ("a list of all coordinates",)


def at_the_motor(log: Log):
    """Everything on the motor's side of one gear."""
    for i in range(log.joints):
        if not log.slides[i]:
            log.columns[f"joint{i + 1}_position"] *= 64.0
            log.columns[f"joint{i + 1}_velocity"] *= 64.0
            log.columns[f"joint{i + 1}_effort"] /= 64.0
    return ("64 times as large as at the joint", "smaller than the model needs")


def listed_beside(text: str) -> str:
    """A text in quotes that has commas, as of a list."""
    head, *rows = text.splitlines()
    more = "\"['a', 'b', 'c']\","
    return "\n".join([f"name,{head}", *(more + row for row in rows)]) + "\n"


KINDS |= {
    # A fifth time: of public robots, as tools write their logs.
    "a message without names": as_text(joint_state, ""),
    "a row for each joint": as_text(long, ""),
    "durations": as_text(lambda text: re.sub(r"(?m)^([\d.]+),", r"\1 sec,", text), ""),
    "lines of JSON": json_lines,
    "coordinates after a base's": after_a_base,
    "all at the motor": at_the_motor,
    "a time in another language": as_text(
        lambda text: text.replace("time", "Zeit", 1), ""
    ),
    "a list of texts beside": as_text(listed_beside, ""),
    "dates of another order": as_text(
        lambda text: re.sub(
            r"(?m)^([\d.]+),",
            lambda m: f"11/27/2026 22:00:{float(m[1]):09.6f},",
            text,
        ),
        "",
    ),
    "cells in round brackets": in_tuples,
    "units in cells and names": as_text(with_units, ""),
}


def gears_of_their_own(log: Log):
    for i, gear in enumerate(log.rng.choice([50.0, 80.0, 101.0, 121.0], log.joints)):
        if not log.slides[i]:
            log.columns[f"joint{i + 1}_position"] *= gear
            log.columns[f"joint{i + 1}_velocity"] *= gear
            log.columns[f"joint{i + 1}_effort"] /= gear
    return ("on the motor's side of a gear",)


def reversed_encoder(log: Log):
    """Position and velocity count the other way, and the effort does not."""
    i = int(np.argmax(np.std(log.weight, axis=0) * ~np.array(log.slides)))
    for what in ("position", "velocity"):
        log.columns[f"joint{i + 1}_{what}"] *= -1.0
    if not np.std(log.weight[:, i]) > 0.0:  # Nothing tells it from a reversed effort.
        log.truth = {}
    return ("counts the other way", "other sign")


def tared(log: Log):
    """Efforts begin at 0, whatever the robot weighs there."""
    for name in names(log, "effort"):
        log.columns[name] = log.columns[name] - log.columns[name][0]
    return ("was taken from them",)


KINDS |= {
    # A sixth time.
    "a gear for each joint": gears_of_their_own,
    "an encoder reversed": reversed_encoder,
    "efforts tared": tared,
}
UNSEEN = list(KINDS)[list(KINDS).index("one velocity in degrees") :]


@dataclass(frozen=True)
class Seen:
    """words: all that is said. refused: it is an error of one line. right: whether all
    channels are what they were."""

    words: str
    refused: bool
    right: bool


def seen(robot_path: Path, log_path: Path, log: Log) -> Seen:
    try:
        robot, read = read_robot(robot_path), read_log(log_path)
        proposal = propose_scene(robot, [read])
        sidecars = {}
        for path, text in proposal.sidecars.items():
            sidecars[path] = path.with_name("proposed.yaml")
            sidecars[path].write_text(text)
        slides = [j.name for j in robot.joints if j.prismatic]
        recordings = read_recordings([log_path], sidecars=sidecars, slides=slides)
    except ValueError as error:
        told = str(error)
        gains = log.truth.get("gains")
        right = False
        if gains is not None:
            each = re.findall(r"_current: ([\d.]+)", told)
            right = len(each) == len(gains) and np.allclose(
                np.array(each, float), gains, rtol=0.05
            )
        return Seen(told, True, right)
    scene = log_path.with_name("proposed_scene.yaml")
    scene.write_text(proposal.scene)
    plant = SceneDynamics(read_scene(scene)).plant
    findings = [*proposal.findings(),
                *check_recordings(recordings, scene_facts(plant)),
                *check_contents(plant, recordings)]  # fmt: skip
    words = [*(f"{f.kind} {f.says}" for f in findings), *proposal.notes,
             *proposal.sidecars.values(), proposal.scene]  # fmt: skip
    (recording,) = recordings
    errors = [f for f in findings if f.severity == "error"]
    right = not errors
    after = float(log.truth.pop("after", [-np.inf])[0])
    shift = log.time[-1] - recording.time[-1] if after > 0.0 else 0.0
    for name, true in log.truth.items():
        if name == "turns":
            q = recording[f"arm.joint{true[0] + 1}.position"]
            right &= bool(np.abs(np.diff(q)).max() < 1.0)
            continue
        if name not in recording:
            right = False
            continue
        mine = recording[name]
        if len(mine) != len(true):  # Rows were left out.
            true = np.interp(recording.time + shift, log.time, true)
        # A factor's digits are those that the data tell; friction is what it is.
        scale = np.std(true) or 1.0
        kept = (recording.time + shift > after) & np.isfinite(mine)
        true, mine = true[kept[: len(true)]], mine[kept]
        turn = 0.0
        if name.endswith(".position"):
            turn = np.round(np.median(true - mine) / (2 * np.pi)) * 2 * np.pi
        right &= bool(np.sqrt(np.mean((mine + turn - true) ** 2)) < 0.06 * scale)
    return Seen("\n".join(words), False, right)


def one(kind: str, robot: str, seed: int, folder: Path) -> tuple[bool, bool, Seen]:
    """Whether what is wrong was said, whether the channels are right, and all."""
    rng = np.random.default_rng(seed)
    path, log = exact(robot, folder, rng)
    words = KINDS[kind](log)
    if log.write is None:
        if not any(key in log.columns for key in ("time", "utime")):
            log.columns = {"time": log.time} | log.columns
        file = folder / "log.csv"
        rows = [",".join("" if x != x else f"{x:.12g}" if k else repr(float(x))
                         for k, x in enumerate(row))
                for row in zip(*log.columns.values(), strict=True)]  # fmt: skip
        file.write_text("\n".join([",".join(log.columns), *rows]) + "\n")
    else:
        file = log.write(folder, log.columns)
    found = seen(path, file, log)
    return any(word in found.words for word in words), found.right, found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=120)
    parser.add_argument("--unseen", action="store_true", help="the later kinds alone")
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    kinds = UNSEEN if args.unseen else list(KINDS)
    good, n = [0, 0], 0
    for k in range(args.count):
        kind = kinds[k % len(kinds)]
        robots = LATER if args.unseen else list(ROBOTS)
        robot = robots[int(rng.integers(len(robots)))]
        seed = int(rng.integers(1 << 30))
        with tempfile.TemporaryDirectory() as folder:
            try:
                said, right, found = one(kind, robot, seed, Path(folder))
            except Exception as error:  # A crash is what is looked for.
                said, right = False, False
                found = Seen(f"CRASH {error!r}", True, False)
        n, good = n + 1, [good[0] + said, good[1] + right]
        if not (said and right):
            text = " ".join(found.words.split())[:400] if found.refused else ""
            print(f"{kind} | {robot} {seed} | said {said} right {right} {text}")
    print(f"{n} logs: said {good[0]}, channels right {good[1]}")


if __name__ == "__main__":
    sys.exit(main())

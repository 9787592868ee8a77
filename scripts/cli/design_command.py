"""`makebreak design-log`: the motion to record, as a table to play on the robot."""

import json
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from makebreak.gap.data.robot import directives_of, read_robot
from makebreak.gap.data.table import write_recording
from makebreak.gap.design import DesignedLog, LogDesign, LogPlan
from makebreak.models.fixed_joints import followers_in
from makebreak.models.scene import Scene, read_scene
from makebreak.scripts.cli.arguments import number
from makebreak.scripts.cli.gap_command import StageBar, name_from
from makebreak.scripts.runner.outputs import OutputFolder
from makebreak.scripts.runner.table import Table, json_value


def limits_of(text: str | None, option: str) -> dict[str, float]:
    """{joint: limit} of "3", for all joints, or "arm.j1=2,arm.j2=3".

    Raises: ValueError for what is no number above 0.
    """
    found = {}
    for part in (text or "").split(","):
        if part:
            joint, _, value = part.rpartition("=")
            found[joint] = number(value, option, 0.0)
    return found


def design_log(
    scene_path: Path, named: Sequence[str], plan: LogPlan, out_dir: Path
) -> tuple[Table, list[Path]]:
    """Designs a log and writes it. Returns: what it will tell; the files.

    Raises: ValueError for a scene, parameters or limits that cannot be used.
    """
    with OutputFolder(out_dir, "design-log", [scene_path]) as out:
        with StageBar() as progress:
            progress("reading the scene")
            robot = scene_path.suffix.lower() in (".urdf", ".sdf", ".xml", ".xacro")
            scene = (
                _scene_of_robot(scene_path, out) if robot else read_scene(scene_path)
            )
            found = LogDesign(scene, named, plan).solve(progress)
        write_recording(out.file("design.csv"), found.columns())
        _draw(found, out.file("design.png"))
        table = _table(found, scene)
        told = [
            json_value(dict(vars(p))) | {"told": p.is_told} for p in found.predicted
        ]
        text = json.dumps({"parameters": told}, indent=2)
        out.file("result.json").write_text(text + "\n")
        if robot:
            name_from(out_dir, scene_path, out.file("scene.yaml"))
        return table, out.commit()


def _scene_of_robot(path: Path, out: OutputFolder) -> Scene:
    """The robot upright on the world, its joints driven by efforts. Those that others
    follow, as a gripper's fingers, stand still with these."""
    robot, file = read_robot(path), out.file("scene.yaml")
    lines, copies, _ = directives_of(robot)
    for name, text in copies.items():
        out.file(name).write_text(text)
    follows = followers_in(robot.file.text)
    tied = dict.fromkeys([*(law.joint for law in follows.values()), *follows])
    limits = {joint.name.partition(".")[2]: joint for joint in robot.joints}

    def stands(name: str) -> float:
        if name in follows:
            law = follows[name]
            return law.factor * stands(law.joint) + law.offset
        home = robot.file.home.get(name, 0.0)
        return float(np.clip(home, limits[name].lower, limits[name].upper))

    if tied:
        where = ", ".join(f"{robot.model}.{name}: {stands(name):.6g}" for name in tied)
        lines.append(f"fixed_joints: {{{where}}}  # They move together (mimic).")
    moving = [joint.name for name, joint in limits.items() if name not in tied]
    lines.append(f"actuation: {{type: effort, joints: [{', '.join(moving)}]}}")
    file.write_text("\n".join(lines) + "\n")
    return read_scene(file)


def _table(found: DesignedLog, scene: Scene) -> Table:
    rows: list[tuple] = []
    for p in found.predicted:
        after = p.after if p.is_told else "not told by efforts"
        rows.append((f"{p.kind} {p.name}", p.at, after, p.unit))
    at_start = found.excitation.at(np.zeros(1))[0][0]
    pairs = zip(found.joints, at_start, strict=True)
    start = ", ".join(f"{joint} {q:.4g}" for joint, q in pairs)
    plan = found.plan
    notes = [
        f"Standard deviations for white noise of {plan.noise:.2%} of each joint's "
        f"limit of effort in measured efforts, {plan.rate_hz:g} a second, and for "
        "masses and centres of mass that are known within the scene's tolerance.",
        f"Drive the robot to the start first ({start}); the motion begins and ends "
        "there, at rest.",
        "Collisions of the robot with itself and its surroundings are not looked at: "
        "play it slowly first.",
    ]
    if scene.fixed_joints:
        still = ", ".join(f"{joint} {q:.4g}" for joint, q in scene.fixed_joints.items())
        notes.insert(2, f"These stand still throughout: {still}.")
    return Table(
        "What the log will tell", ("parameter", "at", "standard deviation", "unit"),
        rows, notes=notes,
    )  # fmt: skip


def _draw(found: DesignedLog, file: Path) -> None:
    """Positions, velocities and efforts over a period, as shares of their limits."""
    time = np.linspace(0.0, found.plan.period, 500)
    q, v, vd = found.excitation.at(time)
    limits = found.limits
    middle = 0.5 * (limits.upper + limits.lower)
    half = 0.5 * (limits.upper - limits.lower)
    parts = {
        "position": (q - middle) / half,
        "velocity": v / limits.velocity,
        "acceleration": vd / limits.acceleration,
        "effort of the model": found.model(q, v, vd) / limits.effort,
    }
    if not np.isfinite(limits.acceleration).any():
        del parts["acceleration"]
    size = (8.0, 2.0 * len(parts))
    figure, axes = plt.subplots(
        len(parts), 1, sharex=True, figsize=size, layout="constrained"
    )
    for axis, (name, share) in zip(axes, parts.items(), strict=True):
        for j, joint in enumerate(found.joints):
            axis.plot(time, share[:, j], label=joint)
        axis.axhline(1.0, color="0.5", lw=0.8, ls="--")
        axis.axhline(-1.0, color="0.5", lw=0.8, ls="--")
        axis.set_ylabel(f"{name}\n/ limit")
    axes[0].legend(fontsize=7, ncols=4, loc="lower right")
    axes[-1].set_xlabel("time [s]")
    figure.savefig(file, dpi=110)
    plt.close(figure)

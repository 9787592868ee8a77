"""A robot's own file, and the scene and sidecars that a log of it would need."""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from makebreak.gap.data.arrays import is_time, words_of
from makebreak.gap.data.bags import MotorRange, is_dataset, motor_ranges
from makebreak.gap.data.base_pose import BasePose, base_pose, listed_pose
from makebreak.gap.data.content import (
    CLEARER,
    EXPLAINS,
    FROM_A_START,
    NOTHING,
    UNEXPLAINED,
    WITHOUT_WEIGHT,
    Contents,
    Said,
    by_content,
    left_by,
    told_by,
    turned_gravity,
)
from makebreak.gap.data.coordinates import OF_ACTUATORS, by_lists
from makebreak.gap.data.findings import (
    FIXED,
    GUESSED_GAINS,
    MODEL_FILE,
    NO_COLUMN,
    NO_DRIVE,
    Finding,
)
from makebreak.gap.data.joined import read_joined
from makebreak.gap.data.late_velocities import with_late_velocities
from makebreak.gap.data.match import AS_SAID, JointName, Match
from makebreak.gap.data.nameless import BY_CONTENT, layouts
from makebreak.gap.data.own_contacts import overlapping
from makebreak.gap.data.proposal import (
    CURRENT,
    UNKNOWN_JOINT,
    of_one_drive,
    propose,
    said_of,
    sidecar_text,
)
from makebreak.gap.data.recording import QUATERNION
from makebreak.gap.data.servo_gains import (
    ServoGains,
    ServoLog,
    effort_shares,
    gains_of_efforts,
    go_in_lines,
    servo_gains,
)
from makebreak.gap.data.sidecar import Found, read_sidecars, sidecar_for
from makebreak.gap.data.table import (
    COMMANDS,
    JOINT_QUANTITIES,
    RecordingTable,
    is_channel,
    stem_of,
)
from makebreak.gap.data.units import DEG, FULL_RANGE, in_units, said_of_units
from makebreak.models.activation import Activation
from makebreak.models.effects import KINDS
from makebreak.models.effects.joints import ROTOR
from makebreak.models.effects.kind import actuator_of, one_dof_joints, unit_at
from makebreak.models.fixed_joints import couplings_in, fix_joints, followers_in
from makebreak.models.model_files import checked_inertias, without_lost_collisions
from makebreak.models.model_inertias import ModelText, mended
from makebreak.models.robot_file import FileDrive, RobotFile
from makebreak.models.scene_reader import given_packages

GUESSED_KP = 10.0  # [N m/rad], where the log does not show it.
# [1/s] Of a loop of speed: it settles in a few hundredths of a second. Its gain is this
# times what the joint moves: one number for all joints would be too stiff to simulate
# at a wrist, or too soft to hold a shoulder.
SPEED_LOOP = 50.0
SERVO_DAMPING_SEC = 0.07  # Of kd to kp, of a small geared servo's back-EMF.
ROTOR_SEC = 0.05  # Of its inertia at the joint to kd.
GAINS_KNOWN_TO = 0.05  # Of those that motion tells; the masses alone are off by 3 %.
LEAST_ROTOR = 0.05  # Of what a joint moves: less is left out of a proposal.
DRIVEN_SHARE = 0.5  # Of its weight and motion, the effort that a driven joint needs.
BEYOND = 1.05  # Of a drive's limit: more than noise of an effort at it.
FEW = 0.25  # Of all joints: so many may have other gains than their file has.
LEAST_LOAD = 0.05  # Of a joint's rms gravity torque [N m], to tell its servo by.


@dataclass(frozen=True, eq=False)
class Robot:
    """joints: in the order of the robot's coordinates. bases: bodies that nothing
    holds, {name: where the file has it}. plant: finalized, with the bases welded to the
    world, where a log says, poses, or where the file has them. free: bases that a scene
    leaves free; carriers: those that carry joints, so no objects. numbered: joints in
    the order in which a log counts them, if that is another. order: (joint or base, its
    number of positions), as lists have them."""

    path: Path
    model: str
    joints: tuple[JointName, ...]
    bases: Mapping[str, RigidTransform]
    effort_limits: dict[str, float]
    plant: MultibodyPlant
    file: RobotFile
    poses: Mapping[str, BasePose] = field(default_factory=dict)
    free: tuple[str, ...] = ()
    carriers: tuple[str, ...] = ()
    numbered: tuple[JointName, ...] = ()
    order: tuple[tuple[str, int], ...] = ()


def read_robot(path: Path) -> Robot:
    """Raises: ValueError, one line, for a file that holds no one robot."""
    floating = _load(path)
    free = [floating.get_body(i) for i in floating.GetFloatingBaseBodies()]
    bases = {b.name(): floating.GetDefaultFloatingBaseBodyPose(b) for b in free}
    plant = _load(path, bases)
    model = re.sub(r"\W", "_", plant.GetModelInstanceName(_instance(plant)))
    file = without_lost_collisions(path, given_packages())
    joints, limits = [], {}
    for joint in sorted(one_dof_joints(plant), key=lambda j: j.position_start()):
        name = f"{model}.{joint.name()}"
        actuator = actuator_of(plant, joint)
        limits[name] = np.inf if actuator is None else actuator.effort_limit()
        joints.append(
            JointName(
                name,
                joint.type_name() == "prismatic",
                float(joint.position_lower_limits()[0]),
                float(joint.position_upper_limits()[0]),
                min(limits[name], file.limits.get(joint.name(), np.inf)),
            )
        )
    if not joints and not bases:
        raise ValueError(f"robot {path} has no joint that turns or slides")
    at = [(j.position_start(), j.name(), 1) for j in one_dof_joints(floating)]
    at += [(b.floating_positions_start(), b.name(), 7) for b in free]
    order = file.order or tuple((name, n) for _, name, n in sorted(at))
    moved = {
        b.name(): set(floating.GetBodiesKinematicallyAffectedBy([j.index()]))
        for j in map(floating.get_joint, floating.GetJointIndices())
        for b in free if j.child_body().index() == b.index()
    }  # fmt: skip
    carriers = tuple(
        name for name, own in moved.items()
        if any(j.child_body().index() in own for j in one_dof_joints(floating))
    )  # fmt: skip
    return Robot(
        path, model, tuple(joints), bases, limits, plant, file, carriers=carriers,
        order=order,
    )  # fmt: skip


def _load(
    path: Path,
    welded: Mapping[str, RigidTransform] | None = None,
    fixed: Mapping[str, float] | None = None,
    gravity: tuple[float, ...] | None = None,
) -> MultibodyPlant:
    """welded: {body: its pose in world}; fixed: {joint, without the model's name: where
    it stands}; gravity [m/s2]: in place of the file's."""
    file = without_lost_collisions(path, given_packages())
    if gravity is not None:
        file = replace(file, gravity=gravity)

    def of(text: str) -> MultibodyPlant:
        return _plant(path, file, text, welded or {}, fixed)

    plant = of(file.text)
    if file.suffix != ".xml":
        own = ModelText(plant.GetModelInstanceName(_instance(plant)), file.text)
        try:  # Drake has 1 kg in place of an inertia that cannot be.
            [after], _ = mended([own], lambda: plant)
        except ValueError:  # Of one that matters the scene says it.
            return plant
        plant = plant if after is own else of(after.text)
    return plant


def _plant(path: Path, file: RobotFile, text: str, welded, fixed):
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector(file.gravity)
    try:
        with checked_inertias():
            # Without a scene graph no mesh is looked for.
            parser = Parser(plant)
            models = parser.AddModelsFromString(text, file.suffix[1:])
        if len(models) != 1:
            raise ValueError(f"it holds {len(models)} models, expected one")
        for base, X in welded.items():
            plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(base), X)
        model = plant.GetModelInstanceName(models[0])
        there = {f"{model}.{name}": q for name, q in (fixed or {}).items()}
        fix_joints(plant, there, len(couplings_in(file.text)))
        for effect in file.effects:
            add = KINDS[effect.kind].before_finalize
            if add is not None and effect.at[0] not in (fixed or {}):
                add(replace(effect, at=[f"{model}.{effect.at[0]}"]), plant, None)
        plant.Finalize()
    except (RuntimeError, ValueError) as error:
        why = " ".join(str(error).split())
        raise ValueError(f"robot {path} cannot be read: {why[:1000]}") from None
    return plant


def _poses(robot: Robot) -> dict[str, RigidTransform]:
    """Of its bases, as logs have them or else its file."""
    return {
        name: X if (pose := robot.poses.get(name)) is None
        else RigidTransform(RotationMatrix(pose.rotation.as_matrix()), pose.position)
        for name, X in robot.bases.items()
    }  # fmt: skip


def _instance(plant: MultibodyPlant):
    return ModelInstanceIndex(plant.num_model_instances() - 1)  # World, default, it.


# ----- Joints that stand still


def _standing(robot: Robot, every, logs, some_unknown: bool) -> dict[str, float]:
    """{<model>.<joint>: position} of joints that a scene takes to stand still: those
    that follow one another (mimic), where they were in the middle of a log, and those
    that no log has a column of, neither of which may carry others, as a gripper's
    fingers; and those of which nothing that a log has ever changes.

    Args: some_unknown: whether there are columns of unknown joints, maybe theirs.
    Raises: ValueError for coupled joints that carry others.
    """
    coupled = {
        f"{robot.model}.{one}": replace(of, joint=f"{robot.model}.{of.joint}")
        for one, of in followers_in(robot.file.text).items()
    }
    scaled = [_scaled(log, every[log.path]) for log in logs]
    seen = {name.rpartition(".")[0] for channels in scaled for name in channels}
    follow = {*coupled, *(of.joint for of in coupled.values())}
    found = {}
    for joint in robot.joints:
        own = [y[np.isfinite(y)] for channels in scaled
               for name, y in channels.items() if name.rpartition(".")[0] == joint.name
        ]  # fmt: skip
        still = joint.name in seen and all(np.ptp(y) == 0.0 for y in own if len(y))
        if still and not any(map(len, own)):
            still = False
        if joint.name in seen and joint.name not in follow and not still:
            continue
        carried = _carried_by(robot, joint.name) - follow
        if joint.name in follow and carried:
            raise ValueError(
                f"robot {robot.path.name}: joint {joint.name} is coupled to another "
                f"(mimic) and carries {', '.join(sorted(carried))}; coupled joints are "
                "covered only at the end of a robot, as a gripper's fingers"
            )
        known = still or joint.name in follow
        if not known and (carried & seen or some_unknown):
            continue  # Where it stands would be a guess.
        q = [c[f"{joint.name}.position"] for c in scaled
             if f"{joint.name}.position" in c]  # fmt: skip
        home = robot.file.home.get(joint.name.partition(".")[2], 0.0)
        middle = float(np.nanmedian(np.concatenate(q))) if q else home
        found[joint.name] = middle
    for name, of in coupled.items():  # Where its leader has it, if nobody saw it.
        if name in found and name not in seen and of.joint in found:
            found[name] = of.factor * found[of.joint] + of.offset
    limits = {joint.name: (joint.lower, joint.upper) for joint in robot.joints}
    found = {
        name: float(f"{np.clip(np.nan_to_num(q), *limits[name]):.6g}")
        for name, q in found.items()
    }
    return found if len(found) < len(robot.joints) else {}


def _carried_by(robot: Robot, name: str) -> set[str]:
    """Joints that another one carries."""
    plant = robot.plant
    joints = {f"{robot.model}.{j.name()}": j for j in one_dof_joints(plant)}
    bodies = plant.GetBodiesKinematicallyAffectedBy([joints[name].index()])
    return {
        each for each, joint in joints.items()
        if each != name and joint.child_body().index() in bodies
    }  # fmt: skip


def _with_fixed(robot: Robot, fixed: Mapping[str, float]) -> Robot:
    """The robot with joints that do not move."""
    names = {name.partition(".")[2]: q for name, q in fixed.items()}
    return replace(
        robot,
        joints=tuple(j for j in robot.joints if j.name not in fixed),
        plant=_load(robot.path, _poses(robot), names),
    )


# ----- A log, and what is proposed for it


@dataclass(frozen=True, eq=False)
class Log:
    """A log as it is: the table of its numbers, columns of text with what is in all
    their cells, what its sidecar says, and which that is; ranges of its motors by
    their calibration."""

    path: Path
    table: RecordingTable
    text: Mapping[str, str] = field(default_factory=dict)
    own: Mapping[str, Any] = field(default_factory=dict)
    sidecar: Found = Found({})
    ranges: Mapping[str, MotorRange] = field(default_factory=dict)


def read_log(
    path: Path, sidecar: Path | None = None, folders: Sequence[Path] = ()
) -> Log:
    """Args: sidecar: in place of the one beside it; folders: where else sidecars of
        other logs may lie.
    Raises: ValueError, one line, for a file that cannot be read, or a sidecar that does
        not fit it.
    """
    own = read_sidecars(path, None) if sidecar is None else {}
    table, text = read_joined(path, own, with_text=True)
    unused = [k for k, to in (own.get("columns") or {}).items() if to is None]
    found = sidecar_for(path, [*table.columns, *text, *unused], sidecar, folders)
    return Log(
        path, table, text, found.sections, found, motor_ranges(path, own)
    )  # fmt: skip


def matches_of(log: Log, robot: Robot | None) -> list[Match]:
    joints = () if robot is None else robot.numbered or robot.joints
    said = said_of(log.own.get("columns") or {})
    if robot is not None:
        columns, file = log.table.columns, robot.file
        said = by_lists(columns, robot.model, robot.order, file.actuators) | said
    return propose(log.table.columns, joints, log.text, said, log.ranges)


_STEPS = "it does not increase from row to row, as of too few digits"
BASE_MOVES, UNNAMED = "base_moves", "columns_unnamed"
NO_ACTUATION = ["actuation: {type: none}"]
FROM_SAG = "from how far joints sag below their commands"
FROM_MOTION = "from how joints followed their commands"
FROM_EFFORTS = "from the measured efforts, which are what such servos give"


@dataclass(frozen=True)
class Proposal:
    """A scene and a sidecar for each log, as texts. notes: what was guessed.
    joints: of the scene. gains_of: how drives' gains were guessed, in words; ""
    where none had to be, or where motion tells them. is_driven: whether a column
    says what drives the joints. without: of joints that have no column of a
    position; unused: columns of quantities of unknown joints. fixed: joints that
    are taken to stand still. first: the first log's name. copies: {name beside the
    scene: text} of models that are not used as they are. unread: what of the
    robot's file is not used. said: what columns' contents say beside their
    names."""

    scene: str
    sidecars: dict[Path, str]
    notes: tuple[str, ...]
    joints: tuple[str, ...] = ()
    gains_of: str = ""
    is_driven: bool = True
    without: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    first: str = ""
    copies: Mapping[str, str] = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    said: tuple[Said, ...] = ()

    def findings(self) -> list[Finding]:
        """What a result must not forget."""
        name = self.first
        found = [
            Finding(
                each.kind,
                name,
                each.channel,
                each.size,
                "",
                "error" if each.kind == BASE_MOVES else "warning",
                each.says,
            )
            for each in self.said
        ]
        if self.gains_of:
            says = (
                f"The gains of the drives in this proposed scene are {self.gains_of}: "
                "they are not known."
            )
            found.append(Finding(GUESSED_GAINS, name, "time", 0, "", "warning", says))
        for note in self.unread:
            says = f"The model's file: {note}."
            found.append(Finding(MODEL_FILE, name, "time", 0, "", "warning", says))
        if self.fixed:
            says = (
                f"{', '.join(self.fixed)} {_stands(self.fixed)} (fixed_joints of the "
                "proposed scene), as the log has no column of it or the model couples "
                "it to another joint: what it does is not compared."
            )
            found.append(Finding(FIXED, name, "time", 0, "", "warning", says))
        if not self.is_driven and self.joints:
            says = (
                "No column is an effort or a command, so no torque acts on the joints "
                "of this proposed scene. If the log has one, name its column in the "
                "sidecar; without it, effects may only stand for the missing torque."
            )
            found.append(Finding(NO_DRIVE, name, "time", 0, "", "warning", says))
        if self.without:
            says = self._says_what_is_missing()
            found.append(Finding(NO_COLUMN, name, "time", 0, "", "warning", says))
        return found

    def _says_what_is_missing(self) -> str:
        says = f"No column is taken for the position of {', '.join(self.without)}"
        if self.unused:
            shown = ", ".join(self.unused[:6]) + (", ..." if self.unused[6:] else "")
            says += f"; columns of unknown joints are left out: {shown}"
        return says + ". If the log has these positions, name them in the sidecar."


@dataclass(frozen=True)
class Judged:
    """Logs' columns by their names and by what is in them. robot: without joints that
    are taken to stand still, fixed {joint: where}. unused: columns of quantities of
    unknown joints. said: what contents say beside names. servos: {joint: gains} where
    the measured efforts are what position servos give. in_lines: whether, by these,
    commands are samples of a faster loop. most: {joint: the largest effort that was
    measured or commanded}."""

    robot: Robot
    every: dict[Path, list[Match]]
    fixed: dict[str, float]
    unused: tuple[str, ...]
    said: tuple[Said, ...]
    servos: Mapping[str, ServoGains] = field(default_factory=dict)
    in_lines: bool = False
    most: Mapping[str, float] = field(default_factory=dict)


def judge_logs(robot: Robot, logs: Sequence[Log]) -> Judged:
    """Raises: ValueError for coupled joints that carry others."""
    said: list[Said] = []
    robot = _numbered(robot, logs, said)
    every = {log.path: _named(log, robot, said) for log in logs}
    robot = _with_poses(robot, logs, every)
    every = {path: _of_bodies(robot, own) for path, own in every.items()}
    unused = dict.fromkeys(m.column for matches in every.values() for m in matches
                           if m.why.endswith(UNKNOWN_JOINT))  # fmt: skip
    every = {
        log.path: _through_drives(robot, log, every[log.path], said) for log in logs
    }
    for base, pose in robot.poses.items():
        if base in robot.free or pose.is_still:
            continue
        says = (
            f"{base}, the base, moves by {_moves(pose)} in the log, and the "
            "proposed scene holds it where it was on average: what its motion does to "
            "the joints is not in the model. Use logs of it on a stand, or a scene in "
            "which it is free, with what it stands on."
        )
        said.append(Said(BASE_MOVES, base, pose.turned, says))
    said += _maybe_of_a_range(logs, every)
    for matches in every.values():
        said += [Said(*each) for each in said_of_units(matches)]
    fixed = _standing(robot, every, logs, bool(unused))
    if fixed:
        robot = _with_fixed(robot, fixed)
        every = {path: _left_out(matches, fixed) for path, matches in every.items()}
    for log in logs if robot.joints else ():
        columns, named = log.table.columns, every[log.path]
        matches, more = by_content(robot.plant, robot.joints, columns, named)
        others = {each.kind for each in more} - {UNEXPLAINED, FROM_A_START}
        if not others and not robot.poses:  # Nothing else says why.
            g = turned_gravity(robot.plant, robot.joints, columns, named)
            if g is not None:
                robot = _hung(robot, g, fixed, said)
                matches, more = by_content(robot.plant, robot.joints, columns, named)
        every[log.path] = matches
        # What objects push back with is in the efforts, and not in the model's motion.
        said += [
            each for each in more
            if each not in said
            and not (robot.free and each.kind in (FROM_A_START, UNEXPLAINED))
        ]  # fmt: skip
    servos, in_lines = _servos_of_efforts(robot, every, logs, said)
    in_lines |= any(m.activation for matches in every.values() for m in matches)
    most: dict[str, float] = {}
    for name, y in (x for log in logs for x in _scaled(log, every[log.path]).items()):
        joint, _, what = name.rpartition(".")
        if what.startswith("effort"):
            own = float(np.nanmax(np.abs(y), initial=0.0))
            most[joint] = max(own, most.get(joint, 0.0))
    given = [f"{joint}.effort_measured" for joint in servos]
    unexplained = any(each.kind == UNEXPLAINED for each in said)
    every = {path: of_one_drive(own, given, unexplained) for path, own in every.items()}
    for log in logs:
        every[log.path], late = with_late_velocities(
            log.table.columns, every[log.path], log.own.get("filters") or {}
        )
        said += [Said("velocity_lag", *each) for each in late]
    return Judged(
        robot, every, fixed, tuple(unused), tuple(said), servos, in_lines, most
    )


def _hung(robot: Robot, g: np.ndarray, fixed, said: list[Said]) -> Robot:
    """With gravity g [m/s2] as the efforts have it, where its base hangs."""
    gravity = tuple(float(f"{x:.4g}") for x in g)
    says = (
        "The efforts do not go with the motion of a base that stands as the file has "
        f"it, and do with gravity of ({', '.join(f'{x:.3g}' for x in g)}) m/s2: the "
        "base hangs or is tilted. The proposed scene has that gravity."
    )
    said.append(Said("base_tilted", robot.joints[0].name, 9.81, says))
    names = {name.partition(".")[2]: q for name, q in fixed.items()}
    plant = _load(robot.path, _poses(robot), names, gravity)
    return replace(robot, file=replace(robot.file, gravity=gravity), plant=plant)


def _servos_of_efforts(
    robot: Robot, every, logs, said: list[Said]
) -> tuple[dict[str, ServoGains], bool]:
    """{joint: gains} where all measured efforts are what position servos give: these
    tell what acts between the rows, too, where a step of a command has its effect. And
    whether, by these, commands go in lines from row to row. Of few joints whose efforts
    are a multiple of what the file's gains give, which all others have, that is said: a
    drive that is weaker shows in the motion, too."""
    motions, drives = _motions(robot, every, logs), robot.file.drives
    if not motions:
        return {}, False
    of_file = [drives.get(j.name.partition(".")[2]) for j in robot.joints]
    known = [
        (own.kp, own.kd) if own is not None and own.kp else None for own in of_file
    ]
    found, late = gains_of_efforts(motions, known)
    out = {joint.name: own for joint, own in zip(robot.joints, found, strict=True)
           if own is not None}  # fmt: skip
    if len(out) < len(found):
        return {}, False
    in_lines = go_in_lines(motions, late)
    other = {
        name: gains for (name, own), gains in zip(out.items(), known, strict=True)
        if gains is not None and own.kp != gains[0]
    }  # fmt: skip
    if None in known or len(other) > FEW * len(out):
        return out, in_lines
    for name, gains in other.items():
        times = out[name].kp / gains[0]
        says = (
            f"{name}: measured efforts are {times:.2g} times what the servo of "
            f"{robot.path.name} gives, those of the other joints just that: they are "
            "taken for measured wrongly (a torque constant), and are not used; the "
            "motion tells whether the drive is weaker (servo_gain)"
        )
        said.append(Said("effort_of_other_gains", name, times, says))
        out[name] = ServoGains(*gains, 0.0, 0.0)
    return out, in_lines


def _numbered(robot: Robot, logs: Sequence[Log], said: list[Said]) -> Robot:
    """With joints counted as columns without names do, if the efforts say so: along the
    robot (as MuJoCo and Drake count), limb by limb in the order of their names (as
    pinocchio), as its file has them (as PyBullet), or by names (as ROS)."""
    at = {
        f"{robot.model}.{j.name()}": int(j.index()) for j in one_dof_joints(robot.plant)
    }
    branches = _limb_by_limb(robot.plant)
    orders = {
        "as the robot's file has its joints": sorted(
            robot.joints, key=lambda joint: at[joint.name]
        ),
        "limb by limb, limbs by their names": sorted(
            robot.joints, key=lambda joint: branches.index(at[joint.name])
        ),
        "by its joints' names": sorted(robot.joints, key=lambda joint: joint.name),
    }

    def left(other: Robot) -> dict[str, float]:
        each = [
            left_by(
                robot.plant, robot.joints, log.table.columns, matches_of(log, other)
            )
            for log in logs
        ]
        return {name: float(np.mean([x.get(name, 0.0) for x in each]))
                for name in set().union(*each)}  # fmt: skip

    first = [m.channel for m in matches_of(logs[0], robot)]
    others = {
        word: replace(robot, numbered=tuple(order)) for word, order in orders.items()
    }
    others = {word: other for word, other in others.items()
              if [m.channel for m in matches_of(logs[0], other)] != first}  # fmt: skip
    if not others or not robot.joints:
        return robot
    # Of mirrored limbs few joints tell whose columns they are: some are told clearly
    # better, and none clearly worse.
    own, told = left(robot), dict[str, float]()
    for word, other in others.items():
        then = left(other)
        gains = {name: own.get(name, 0.0) - x for name, x in then.items()}
        is_told = any(
            gain > np.log(CLEARER) and then[name] < np.log(1.0 - EXPLAINS)
            for name, gain in gains.items()
        )
        if is_told and min(gains.values()) > -np.log(CLEARER):
            told[word] = sum(gains.values())
    best = max(told, key=lambda word: told[word], default="")
    if not best or told[best] <= 0.0:
        return robot
    says = f"By what is in them, columns without names are counted {best}."
    said.append(Said("columns_mixed", robot.joints[0].name, len(robot.joints), says))
    return others[best]


def _limb_by_limb(plant: MultibodyPlant) -> list[int]:
    """Joints, each followed by all that it carries; of those at one body, by name."""
    joints = [plant.get_joint(k) for k in plant.GetJointIndices()]
    carried = {int(joint.child_body().index()) for joint in joints}
    bodies = [int(joint.parent_body().index()) for joint in joints]
    found: list[int] = []

    def follow(body: int) -> None:
        own = [j for j, at in zip(joints, bodies, strict=True) if at == body]
        for joint in sorted(own, key=lambda joint: joint.name()):
            found.append(int(joint.index()))
            follow(int(joint.child_body().index()))

    for root in dict.fromkeys(bodies):
        if root not in carried:
            follow(root)
    return found


def _named(log: Log, robot: Robot, said: list[Said]) -> list[Match]:
    """matches_of, of a table without names by what is in its columns."""
    matches, columns = matches_of(log, robot), log.table.columns
    tried = []
    for first, own in layouts(columns, matches, robot.joints):
        by_column = {m.column: m for m in own}
        own = [*in_units(columns, robot.joints, by_column, log.ranges).values()]
        each = left_by(robot.plant, robot.joints, columns, own).values()
        left = float(np.mean([*each])) if each else 0.0
        tried.append((left if left < np.log(NOTHING) else 0.0, first, own))
    left, first, best = min(tried, key=lambda each: each[0], default=(0.0, {}, []))
    if left == 0.0 and "velocity" not in first and [*first] != ["position"]:
        return matches
    shown = ", ".join(f"{what} ({column} and on)" for what, column in first.items())
    says = (
        f"{log.path.name} does not name its columns, or in words that are not known. "
        f"By what is in them they are {shown}."
    )
    used = {m.column for m in best if m.channel}
    also = [
        other["effort_measured"] for share, other, own in tried
        if share < 0.0 and "effort_measured" in other
        and used.isdisjoint(m.column for m in own if m.why == BY_CONTENT
                            and str(m.channel).endswith("effort_measured"))
    ]  # fmt: skip
    if also:
        says += f" What begins with {', '.join(also)} could be the efforts as well."
    said.append(Said(UNNAMED, robot.joints[0].name, float(len(first)), says))
    return best


def _maybe_of_a_range(logs: Sequence[Log], every) -> list[Said]:
    """Of LeRobot's positions in degrees, which may be per cent of a range."""
    said = []
    for log in logs:
        mine = [m for m in every[log.path] if m.scale == DEG and m.told]
        most = [np.nanmax(np.abs(log.table.columns[m.column])) for m in mine]
        if is_dataset(log.path) and mine and not log.ranges and max(most) <= FULL_RANGE:
            says = (
                f"{mine[0].column} and others are read as degrees; they may be -100 to "
                "100 of each joint's range: then put the arm's calibration file "
                "(.json) into the dataset's folder, or name it in the sidecar: "
                "calibration: FILE."
            )
            said.append(Said("units", str(mine[0].channel), 0.0, says))
    return said


def _of_no_joint(log: Log, matches: Sequence[Match]) -> dict[str, np.ndarray]:
    """Columns of which the log's sidecar says nothing, and that do not have the whole
    name of a joint (Left_Shoulder_Roll is no roll of a base)."""
    said = set(log.own.get("columns") or {})
    for m in matches:
        at, _, what = (m.channel or "").rpartition(".")
        joint = at.partition(".")[2] if what in JOINT_QUANTITIES else ""
        if joint and {*words_of(joint)} <= {*words_of(m.column)}:
            said.add(m.column)
    return {k: y for k, y in log.table.columns.items() if k not in said}


def _with_poses(robot: Robot, logs: Sequence[Log], every) -> Robot:
    """With its bases where logs have them. Free are objects whose poses are in all
    logs, and a robot's base that moves on what its file has for it to stand on."""
    columns = [_of_no_joint(log, every[log.path]) for log in logs]
    poses, free = dict[str, BasePose](), list[str]()
    for base in robot.bases:
        at = f"{robot.model}.{base}"
        told = {m.channel: m.column for m in every[logs[0].path] if m.channel}
        place, turn = (
            [told[f"{at}.{part}"] for part in parts if f"{at}.{part}" in told]
            for parts in ("xyz", QUATERNION)
        )
        carries = base in robot.carriers
        pose: BasePose | None
        if len(place) == 3 and len(turn) == 4:
            pose = listed_pose([log.table.columns for log in logs], place, turn)
        else:
            others = [other for other in robot.bases if other != base]
            pose = base_pose(columns, [base], others, carries)
        if pose is None:
            continue
        poses[base] = pose
        whole = pose.channels and all({*pose.columns} <= {*log.table.columns}
                                      for log in logs)  # fmt: skip
        if whole and (not carries or robot.file.has_ground and not pose.is_still):
            free.append(base)
    if not poses:
        return robot
    robot = replace(robot, poses=poses, free=tuple(free))
    return replace(robot, plant=_load(robot.path, _poses(robot)))


def _of_bodies(robot: Robot, matches: Sequence[Match]) -> list[Match]:
    """With columns of poses as those of bodies that are free, and without those of what
    is welded."""
    of = {
        column: (base, part, scale)
        for base, pose in robot.poses.items()
        for column, part, scale in pose.channels or [(c, "", 1.0) for c in pose.columns]
    }
    out = []
    for match in matches:
        base, part, scale = of.get(match.column, ("", "", 1.0))
        if base and match.why != AS_SAID:
            why = "the base's pose: it is welded there"
            channel = None
            if base in robot.free:
                why, channel = f"the pose of {base}", f"{robot.model}.{base}.{part}"
            match = Match(match.column, channel, scale, why=why)
        out.append(match)
    return out


def propose_scene(robot: Robot, logs: Sequence[Log]) -> Proposal:
    """Base welded, columns matched by name, actuation by the commands there are.
    Collision meshes that are not there are left out, as the robot touches nothing.

    Raises: ValueError where no joint's position or no time is found.
    """
    judged = judge_logs(robot, logs)
    robot, every, fixed = judged.robot, judged.every, judged.fixed
    kinds: dict[str, list[str]] = {}
    for log in logs:
        path, matches = log.path, every[log.path]
        channels = {m.channel for m in matches if m.channel}
        if "time" not in channels:
            named = [name for name in log.table.columns if is_time(name)]
            says = f" ({', '.join(named)}: {_STEPS})" if named else ""
            raise ValueError(
                f"recording {path}: no column looks like a time{says}; name it in "
                f"{stem_of(path)}.yaml: columns: {{NAME: time}}, or say there how many "
                "rows a second has: rate_hz: 100"
            )
        if not robot.free and not any(c.endswith(".position") for c in channels):
            shown = ", ".join(m.column for m in matches[:8])
            names = ", ".join(j.name.split(".", 1)[1] for j in robot.joints)
            what = (
                f"position of a joint of {robot.path.name} ({names})" if names else
                f"pose of a body of {robot.path.name} ({', '.join(robot.bases)})"
            )  # fmt: skip
            raise ValueError(
                f"recording {path}: no column looks like the {what}, it has {shown}; "
                "write it in a sidecar"
            )
        for channel in sorted(channels):
            at, _, what = channel.rpartition(".")
            if at and at not in kinds.setdefault(what, []):
                kinds[what].append(at)
    lines, copies, notes = directives_of(robot)
    lines.insert(
        0, "# A proposal, to be corrected. docs/station.md, docs/recordings.md"
    )
    if fixed:
        where = ", ".join(f"{name}: {q:g}" for name, q in fixed.items())
        lines.append(
            f"fixed_joints: {{{where}}}  # Not in the log, or coupled (mimic)."
        )
        notes.append(f"{', '.join(fixed)} {_stands(fixed)}")
    actuation, gains = _actuation(judged, kinds, logs, notes)
    if actuation == NO_ACTUATION:
        _check_currents(every, robot, logs)
    gravity = list(robot.file.gravity)
    if any(each.kind == WITHOUT_WEIGHT for each in judged.said):
        gravity = [0.0, 0.0, 0.0]
    own = "" if gravity == [0.0, 0.0, -9.81] else f", gravity: {gravity}"
    lines += [f"plant: {{time_step: {_time_step(robot, actuation)}{own}}}", *actuation]
    lines += _effects_of_file(robot, fixed, lines)
    said = judged.said
    apart = overlapping("\n".join(lines) + "\n", copies, [
        {name.rpartition(".")[0]: y for name, y in _scaled(log, every[log.path]).items()
         if name.endswith(".position")}
        for log in logs
    ], [base for base in robot.bases if base not in robot.poses])  # fmt: skip
    if apart:
        groups = [
            f"- add_collision_filter_group: {{name: overlap_{k}, members: "
            f"{json.dumps(pair)}, ignored_collision_filter_groups: [overlap_{k}]}}"
            for k, pair in enumerate(apart)
        ]
        last = max(k for k, line in enumerate(lines) if line.startswith("- add_"))
        lines[last + 1 : last + 1] = groups
        says = (
            f"{', '.join(f'{a} and {b}' for a, b in apart)} lie in each other in poses "
            "of the log: their collision shapes are larger than the parts. They pass "
            "through each other in the proposed scene (add_collision_filter_group)."
        )
        said += (Said("parts_overlap", robot.model, len(apart), says),)
    notes += [says for log in logs for says in log.sidecar.notes]
    notes += [f"{robot.path.name}: {note}" for note in robot.file.notes]
    sidecars = {
        log.path: sidecar_text(every[log.path], log.own)
        for log in logs
        if not _says_all(log)
    }
    is_driven = actuation != NO_ACTUATION
    seen = kinds.get("position", ())
    without = tuple(j.name for j in robot.joints if j.name not in seen)
    return Proposal(
        "\n".join(lines) + "\n",
        sidecars,
        tuple(notes),
        tuple(j.name for j in robot.joints),
        gains,
        is_driven,
        without,
        judged.unused,
        tuple(fixed),
        stem_of(logs[0].path),
        copies,
        robot.file.notes,
        said,
    )


def directives_of(robot: Robot) -> tuple[list[str], dict[str, str], list[str]]:
    """Lines of a scene with the robot on the world; {name: text} of files beside it,
    where the robot's own cannot be used as it is; notes for the user."""
    lines = [
        "directives:",
        f"- add_model: {{name: {robot.model}, file: {json.dumps(_file(robot))}}}",
    ]
    copies, notes = {}, []
    if left_out := robot.file.left_out:
        name = f"{robot.path.stem}_without_meshes{robot.file.suffix}"
        lines[-1] = f"- add_model: {{name: {robot.model}, file: {name}}}"
        lines[-1] += "  # A copy: collision meshes are not there."
        copies = {name: robot.file.text}
        notes.append(
            f"{left_out} collision meshes of {robot.path.name} are not there and left "
            "out, so it touches nothing (--package NAME=PATH says where they are)"
        )
    more, said_of_base = _welds(robot)
    return [*lines, *more], copies, [*notes, *said_of_base]


def _welds(robot: Robot) -> tuple[list[str], list[str]]:
    """Lines that hold the robot's bases, and what is to be said of it."""
    lines, notes = [], []
    for base, X in _poses(robot).items():
        if base in robot.free:
            notes.append(f"{base} moves freely: its pose is in the log")
            continue
        weld, pose = f"- add_weld: {{parent: world, child: {robot.model}::{base}", ""
        known = robot.poses.get(base)
        if not X.IsExactlyIdentity():
            turn = X.rotation().ToAngleAxis()
            angle = float(np.rad2deg(turn.angle()))
            axis = [float(f"{x:.6g}") for x in turn.axis()]
            pose = (
                f", X_PC: {{translation: {[float(x) for x in X.translation()]}, "
                f"rotation: !AngleAxis {{angle_deg: {angle:.5g}, axis: {axis}}}}}"
            )
        if known is None:
            lines.append(f"{weld}{pose}}}  # As the robot's file has it.")
            notes.append(
                f"{base} is welded to the world, level, as no column has its pose: if "
                "it was tilted, hung over or moved, turn it in the scene's add_weld "
                "(X_PC)"
            )
            continue
        lines.append(f"{weld}{pose}}}  # As in the log.")
        notes.append(
            f"{base} is welded to the world at the pose that the log has of it, turned "
            f"by {np.rad2deg(known.rotation.magnitude()):.3g} deg ({known.says}); it "
            f"moves by {_moves(known)} there"
        )
    return lines, notes


def _moves(pose: BasePose) -> str:
    return f"{np.rad2deg(pose.turned):.2g} deg and {1e3 * pose.moved:.3g} mm"


def _effects_of_file(robot: Robot, fixed, lines: Sequence[str]) -> list[str]:
    """Lines of what the file says of joints and Drake has no place for."""
    out = []
    for effect in robot.file.effects:
        at = f"{robot.model}.{effect.at[0]}"
        said = any(f"kind: {effect.kind}, at: {at}," in line for line in lines)
        if at in fixed or said:
            continue
        values = ", ".join(f"{key}: {x!r}" for key, x in effect.parameters.items())
        out.append(
            f"- {{kind: {effect.kind}, at: {at}, parameters: {{{values}}}}}"
            "  # From the file."
        )
    for *two, friction in robot.file.frictions:
        if set(two) & set(robot.free):
            two.sort(key=lambda body: body not in robot.free)
            ends = (f"{robot.model}.{body}" for body in two)
            out.append(
                f'- {{kind: contact_friction, at: "{"~".join(ends)}", parameters: '
                f"{{friction: {friction!r}}}}}  # From the file: MuJoCo's larger one."
            )
    if out and not any(line.startswith("effects:") for line in lines):
        out.insert(0, "effects:")
    return out


def _through_drives(
    robot: Robot, log: Log, matches: Sequence[Match], said: list[Said]
) -> list[Match]:
    """Commands of a file's own actuators (MJCF's ctrl) as efforts, positions and
    velocities of the joints, by what each actuator takes, an effort times the gear or a
    servo's command over it, and makes of it (Activation)."""
    out, of = [], {m.channel: m for m in matches if m.channel}
    clock, file = of.get("time"), robot.path.name
    for match in matches:
        at, _, what = (match.channel or "").rpartition(".")
        drive = robot.file.drives.get(at.partition(".")[2])
        if match.why == AS_SAID:
            drive = None
        scale, act = 1.0, None
        if drive is not None and not drive.gear and "ctrl" in words_of(match.column):
            why = f"what {file}'s actuator makes of it is not known"
            match, drive = replace(match, channel=None, why=why), None
        if drive is not None and what in COMMANDS:
            is_own = what == "effort_command" and (
                match.why == OF_ACTUATORS or "ctrl" in words_of(match.column)
            )
            act, servo = drive.activation, drive.kp or drive.kd
            adds_up = act is not None and not act.lag
            if is_own and servo or adds_up and drive.kp and what == "velocity_command":
                what = "position_command" if drive.kp else "velocity_command"
                why = f"what {file}'s own actuator takes"
                match = replace(match, channel=f"{at}.{what}", why=why)
            elif adds_up and not is_own:  # What it is added up to.
                act = None
            if what == "effort_command" and not servo:
                scale = drive.gear
            elif what == ("position_command" if drive.kp else "velocity_command"):
                scale = 1.0 / drive.gear
        if drive is not None and scale != 1.0:
            why = f"{match.why}; by the gear {drive.gear:g} of {file}"
            match = replace(match, scale=match.scale * scale, why=why)
        if act is not None:
            act = act.over(1.0 / scale)
            if what == "position_command" and clock and f"{at}.position" in of:
                position = of[f"{at}.position"].values(log.table.columns)
                act = _begun(replace(match, clock=clock), act, position, log)
            how = f"lags behind it by {act.lag:g} s" if act.lag else "adds it up"
            says = (
                f"{match.column}: {file}'s actuator of {at} {how}, from {act.start:g} "
                "on, as the proposed sidecar has it"
            )
            said.append(Said("activation", at, act.start, says))
            why = f"{match.why}, which {how}"
            match = replace(match, activation=act, why=why)
        if match.activation is not None:
            match = replace(match, clock=clock)
        out.append(match)
    return out


def _begun(
    match: Match, activation: Activation, position: np.ndarray, log: Log
) -> Activation:
    """From the file's start, or from where the joint is at first: with that from which
    the command is nearer to its position (n,)."""
    there = position[np.isfinite(position)]
    tries = [replace(activation, start=start)
             for start in (activation.start, *there[:1].tolist())]  # fmt: skip
    commands = [replace(match, activation=one).values(log.table.columns)
                for one in tries]  # fmt: skip
    off = [np.nanmean((command - position) ** 2) for command in commands]
    return tries[int(np.argmin(off))]


def _check_currents(
    every: Mapping[Path, Sequence[Match]], robot: Robot, logs: Sequence[Log]
) -> None:
    """Raises: ValueError where motors' currents, or efforts in a unit that says too
    little, are all that says what drives a robot: no effect could be told from the
    torques that are missing."""
    for log in logs:
        matches = every[log.path]
        currents = [
            m for m in matches if m.channel is None and m.may
            and m.why.startswith((f"{CURRENT}: ", "in "))
        ]  # fmt: skip
        if not currents:
            continue
        try:
            contents = Contents(robot.plant, robot.joints, log.table.columns, matches)
            told = told_by(contents, matches)
        except ValueError:
            told = {}
        first = currents[0]
        scale = f"{told[first.column].factor:.3g}" if first.column in told else "0.11"
        shown = [f"{m.column}: {told[m.column].factor:.3g}" for m in currents
                 if m.column in told]  # fmt: skip
        more = f" (and {len(currents) - 1} more)" if len(currents) > 1 else ""
        if shown:
            more += f"; by the masses of the model it is {', '.join(shown)}"
        raise ValueError(
            f"recording {log.path}: motors' currents are all that says what drives the "
            f"joints; give their N m/A at the joint in {stem_of(log.path)}.yaml beside "
            f'it: columns: {{"{first.column}": {{channel: {first.may}, scale: {scale}}}'
            f"}}{more}"
        )


def _says_all(log: Log) -> bool:
    """Whether a log's own sidecar needs no proposal beside it."""
    said = log.own.get("columns") or {}
    return (
        bool(log.own)
        and log.sidecar.is_own
        and all(name in said or is_channel(name) for name in log.table.columns)
    )


def _stands(fixed: Collection[str]) -> str:
    return "is taken to stand still" if len(fixed) == 1 else "are taken to stand still"


def _left_out(matches: Sequence[Match], fixed: Collection[str]) -> list[Match]:
    return [
        Match(m.column, None, why=f"{m.channel}: taken to stand still")
        if (m.channel or "").rpartition(".")[0] in fixed else m
        for m in matches
    ]  # fmt: skip


def _file(robot: Robot) -> str:
    return f"file://{robot.path.resolve()}"


def _actuation(judged: Judged, kinds, logs, notes: list[str]) -> tuple[list[str], str]:
    """Lines of the scene, and how drives' gains were guessed ("": there are none)."""
    robot, servos, every = judged.robot, judged.servos, judged.every

    def named(what: str) -> list[str]:
        return [j.name for j in robot.joints if j.name in kinds.get(what, ())]

    for what in ("effort_command", "effort_measured"):
        joints = [] if servos else named(what)
        if joints:
            notes.append(f"the joints are driven by the recorded {what}")
            untold, passive = _untold(robot, every, logs, joints)
            if passive:
                notes.append(
                    f"nothing drives {', '.join(passive)}, as {robot.path.name} gives "
                    f"{'it' if len(passive) == 1 else 'them'} no drive"
                )
            joints = [j.name for j in robot.joints if j.name in (*joints, *untold)]
            limits = {j: robot.effort_limits.get(j, np.inf) for j in joints}
            more = _limits(limits, judged.most, notes, False)
            keys = ["type: effort", f"joints: [{', '.join(joints)}]", *more]
            return [f"actuation: {{{', '.join(key.strip() for key in keys)}}}"], ""
    joints = named("position_command") or named("velocity_command")
    rest = [name for name in named("position") if name not in joints]
    if joints and rest:
        notes.append(
            f"no column says what drives {', '.join(rest)}: in this scene nothing does"
        )
    if joints := named("position_command"):
        held = []
        if judged.in_lines:
            held = ["  hold: first_order  # Commands between rows."]
            notes.append("commands go in straight lines from row to row")
        gains = servos or _gains_by_motion(robot, every, logs)
        stiff = {} if servos else _stiffness(robot, every, logs)
        stiff |= {joint: own.kp for joint, own in gains.items()}
        file = {f"{robot.model}.{j}": d for j, d in robot.file.drives.items() if d.kp}
        drives: Mapping[str, ServoGains | FileDrive] = servos or file
        if all(j in file and drives[j].kp == file[j].kp for j in joints):
            lines = _servos_of_file(robot, joints, file, notes)
            limits = {j: file[j].limit for j in joints}
            return [*lines, *held, *_limits(limits, judged.most, notes)], ""
        known = [k for k in stiff.values() if k > 0.0]
        guess = float(np.median(known)) if known else GUESSED_KP
        kp = [float(f"{stiff.get(j, 0.0) or guess:.3g}") for j in joints]
        kd = [
            float(f"{gains[j].kd if j in gains else SERVO_DAMPING_SEC * k:.3g}")
            for j, k in zip(joints, kp, strict=True)
        ]
        every_one = all(joint in gains for joint in joints)
        by_motion = FROM_EFFORTS if servos else FROM_MOTION
        told = by_motion if every_one else FROM_SAG if known else "a guess"
        of_kp, of_kd = _units(robot, joints)
        notes.append(f"drives are position servos of kp {kp} {of_kp} ({told})")
        lines = [
            "actuation:",
            "  type: servo  # Gains are guessed: correct them.",
            f"  joints: [{', '.join(joints)}]",
            f"  kp: {kp}  # [{of_kp}], {told}.",
            f"  kd: {kd}  # [{of_kd}], {by_motion if every_one else 'a guess'}.",
        ]
        limits = {j: robot.effort_limits.get(j, np.inf) for j in joints}
        most = {j: max(gains[j].most if j in gains else 0.0, judged.most.get(j, 0.0))
                for j in joints}  # fmt: skip
        lines += held + _limits(limits, most, notes)
        if every_one and not servos:
            lines.append(f"tolerance: {{drive_gains: {GAINS_KNOWN_TO}}}")
        # A geared motor's own inertia is what its back-EMF and its spring work on.
        rotors, shown, moved = [], [], _inertia(robot)
        slides = {j.name: j.prismatic for j in robot.joints}
        for joint, k in zip(joints, kd, strict=True):
            inertia = gains[joint].rotor if joint in gains else ROTOR_SEC * k
            own = (ROTOR, [joint.partition(".")[2]])
            if any((e.kind, e.at) == own for e in robot.file.effects):
                continue
            if joint not in gains or inertia > LEAST_ROTOR * moved[joint]:
                unit, inertia = unit_at("kg m2", slides[joint]), float(f"{inertia:.2g}")
                rotors.append(
                    f"- {{kind: rotor_inertia, at: {joint}, "
                    f"parameters: {{inertia: {inertia}}}}}  # [{unit}]"
                )
                if joint in gains:
                    shown.append(f"{inertia} {unit} at {joint}")
        if rotors:
            lines += ["effects:  # Rotors of the servos' motors, a guess.", *rotors]
        if shown:
            notes.append(
                f"{robot.path.name} lacks inertia of their motors that the motion "
                f"shows: {', '.join(shown)}"
            )
        return lines, "" if every_one else told
    if joints := named("velocity_command"):
        file = {f"{robot.model}.{j}": d for j, d in robot.file.drives.items()}
        if all(j in file and file[j].kd and not file[j].kp for j in joints):
            lines = _servos_of_file(robot, joints, file, notes, "velocity")
            return [*lines, *_limits({j: file[j].limit for j in joints}, judged.most,
                                     notes)], ""  # fmt: skip
        notes.append("drives follow velocities, with gains that are a guess")
        moved = _inertia(robot)
        kd = [float(f"{SPEED_LOOP * moved[j]:.2g}") for j in joints]
        return [
            "actuation:",
            "  type: velocity  # The gains are guessed: correct them.",
            f"  joints: [{', '.join(joints)}]",
            f"  kd: {kd}  # [{_units(robot, joints)[1]}].",
        ], "a guess"
    notes.append(
        "the log has no command and no effort, so no torque acts on the joints"
    )
    return NO_ACTUATION, ""


def _servos_of_file(
    robot: Robot, joints, drives, notes: list[str], kind: str = "servo"
) -> list[str]:
    """Lines of servos of position, or of velocity, whose gains are in the file."""
    what = "position" if kind == "servo" else "velocity"
    notes.append(f"drives are the {what} servos of {robot.path.name}")
    of_kp, of_kd = _units(robot, joints)
    kp = f"  kp: {[float(drives[j].kp) for j in joints]}  # [{of_kp}]"
    return [
        "actuation:",
        f"  type: {kind}  # From the file.",
        f"  joints: [{', '.join(joints)}]",
        *([kp] if kind == "servo" else []),
        f"  kd: {[float(drives[j].kd) for j in joints]}  # [{of_kd}]",
    ]


def _units(robot: Robot, joints: Sequence[str]) -> list[str]:
    """Of kp and kd, both units where some of the joints turn and some slide."""
    slides = dict.fromkeys(j.prismatic for j in robot.joints if j.name in joints)
    return [
        " or ".join(unit_at(unit, each) for each in slides)
        for unit in ("N m/rad", "N m s/rad")
    ]


def _limits(limits, most, notes: list[str], every: bool = True) -> list[str]:
    """The line of the drives' limits, without those that efforts are beyond: a world
    without them was logged. every: also where there are none such."""
    beyond = [j for j, limit in limits.items() if most.get(j, 0.0) > BEYOND * limit]
    if beyond:
        notes.append(
            f"efforts of {', '.join(beyond)} are beyond the limits of the robot's "
            "file, which are left out there"
        )
    own = [1e9 if j in beyond or not 0.0 < x < 1e6 else float(x)
           for j, x in limits.items()]  # fmt: skip
    told = beyond or every and min(own, default=1e9) < 1e9
    return [f"  limit: {own}"] if told else []


def _time_step(robot: Robot, actuation: Sequence[str]) -> float:
    """[s] A millisecond, or less where a drive stops its joint faster than that."""
    drives = yaml.safe_load("\n".join(actuation))["actuation"]
    moved, step = _inertia(robot), 1e-3
    for joint, kd in zip(drives.get("joints", ()), drives.get("kd", ()), strict=False):
        while moved[joint] < kd * step:
            step *= 0.5
    return step


def _inertia(robot: Robot) -> dict[str, float]:
    """{joint: inertia [kg m2], or mass [kg], that it moves in the pose of zeros while
    all other joints are free}. Raises: ValueError where it moves nothing of a mass."""
    plant = robot.plant
    M = plant.CalcMassMatrix(plant.CreateDefaultContext())
    own = {
        f"{robot.model}.{j.name()}": j.velocity_start() for j in one_dof_joints(plant)
    }
    if bare := [name for name, i in own.items() if not M[i, i] > 0.0]:
        raise ValueError(
            f"robot {robot.path}: what {', '.join(bare)} moves has no mass "
            "(<inertial>); a xacro may have it with other arguments: expand it first"
        )
    mobility = np.linalg.inv(M)
    return {name: float(1.0 / mobility[i, i]) for name, i in own.items()}


def _scaled(log: Log, matches: Sequence[Match]) -> dict[str, np.ndarray]:
    """{channel: its samples in SI units}."""
    return {m.channel: m.values(log.table.columns) for m in matches if m.channel}


def _untold(
    robot: Robot, every, logs, told: Collection[str]
) -> tuple[list[str], list[str]]:
    """Of joints without a column of what drives them those that do not move as one that
    nothing drives, and those that nothing drives by the robot's file."""
    rest = [j.name for j in robot.joints if j.name not in told]
    passive = [n for n in rest if n.partition(".")[2] in robot.file.passive]
    if len(passive) == len(rest):
        return [], passive
    motions = _motions(robot, every, logs)
    if robot.plant.num_positions() != len(robot.joints) or not motions:
        return [], passive
    shares = effort_shares(robot.plant, motions)
    names = [j.name for j in robot.joints]
    return [
        name for name in rest
        if name not in passive and shares[names.index(name)] > DRIVEN_SHARE
    ], passive  # fmt: skip


def _motions(robot: Robot, every, logs) -> list[ServoLog]:
    """Of each log in which all joints are measured."""
    motions = []
    for log in logs if robot.joints else ():
        channels = _scaled(log, every[log.path])
        if not {"time", *(f"{j.name}.position" for j in robot.joints)} <= {*channels}:
            continue
        time = channels["time"]
        q = np.stack([channels[f"{j.name}.position"] for j in robot.joints], axis=1)
        none = np.full(len(time), np.nan)
        told, effort, v = (
            np.stack([read(channels.get(f"{j.name}.{what}", none))
                      for j in robot.joints], axis=1)
            for what, read in (("position_command", _held),
                               ("effort_measured", np.asarray),
                               ("velocity", np.asarray))
        )  # fmt: skip
        good = np.isfinite(q).all(axis=1) & np.isfinite(time)
        good &= np.diff(time, prepend=-np.inf) > 0.0
        motions.append(ServoLog(time[good], q[good], told[good], effort[good], v[good]))
    return motions


def _held(y: np.ndarray) -> np.ndarray:
    """A command (n,) that may be on rows of its own, until the next one."""
    last = np.maximum.accumulate(np.where(np.isfinite(y), np.arange(len(y)), -1))
    return np.where(last < 0, np.nan, y[last])


def _gains_by_motion(robot: Robot, every, logs) -> dict[str, ServoGains]:
    """{joint: gains} of position servos, where the logs say them."""
    motions = _motions(robot, every, logs)
    if robot.plant.num_positions() != len(robot.joints) or not motions:
        return {}
    found = servo_gains(robot.plant, motions)
    return {
        joint.name: own
        for joint, own in zip(robot.joints, found, strict=True)
        if own is not None
    }


def _stiffness(robot: Robot, every, logs) -> dict[str, float]:
    """Of a position servo [N m/rad]: gravity's torque over how far a joint is from its
    command, by least squares; 0 where gravity hardly loads it."""
    plant = robot.plant
    context = plant.CreateDefaultContext()
    up: dict[str, list] = {}
    for log in logs:
        scaled = _scaled(log, every[log.path])
        names = [f"{j.name}.position" for j in robot.joints]
        if not all(name in scaled for name in names):
            continue
        q = np.stack([scaled[name] for name in names], axis=1)
        good = np.flatnonzero(np.isfinite(q).all(axis=1))
        good = good[:: max(len(good) // 400, 1)]
        torque = np.empty((len(good), len(names)))
        for k, row in enumerate(good):
            plant.SetPositions(context, q[row])
            torque[k] = -plant.CalcGravityGeneralizedForces(context)
        for i, joint in enumerate(robot.joints):
            command = scaled.get(f"{joint.name}.position_command")
            if command is not None:
                # A command may be on rows of its own.
                there = np.isfinite(command)
                if there.any():
                    held = np.interp(good, np.flatnonzero(there), command[there])
                    up.setdefault(joint.name, []).append(
                        (torque[:, i], held - q[good, i])
                    )
    out = {}
    for name, parts in up.items():
        load, off = (np.concatenate(x) for x in zip(*parts, strict=True))
        kp = float(load @ off / (off @ off)) if off.any() else 0.0
        loaded = float(np.sqrt(np.mean(load**2))) > LEAST_LOAD
        out[name] = kp if kp > 0.0 and loaded else 0.0
    return out

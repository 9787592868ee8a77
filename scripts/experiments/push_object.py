"""Pushes an object to goal poses; the planner chooses where to touch it."""

from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.signal import lfilter
from scipy.spatial import ConvexHull

from makebreak.diagrams.camera import describe_camera
from makebreak.diagrams.learned_parameters import what_was_learned
from makebreak.diagrams.push_object import READING_COLUMNS, make_push_object
from makebreak.diagrams.push_object_config import (
    LEARN,
    N_TIP,
    OBJECT,
    PushObjectConfig,
    rolling_axis,
)
from makebreak.diagrams.push_object_scenes import (
    model_object,
    model_scene,
    outline_fold,
    poses_of,
)
from makebreak.diagrams.recorder import recorded
from makebreak.diagrams.scene_facts import actuators_of
from makebreak.diagrams.station import ARM, TIP_FRAME, TORQUE_RATE_MAX
from makebreak.models.pushed_object import hull_obj, object_sdf, parts, rest_height
from makebreak.scripts.runner.comparison import Rows
from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.sweep import rate_text
from makebreak.scripts.runner.table import Table
from makebreak.scripts.runner.trials import run_many
from makebreak.systems.contact_mpc.numerics.push_task import WAIT
from makebreak.systems.perception.numerics.pose_filter import on_the_table

SUMMARY = "a Panda pushes an object to poses; the planner chooses where to touch"
Config = PushObjectConfig

SAMPLE = 0.05  # Period at which the end of a run is checked [s].
TOLERANCE = (0.02, 0.1)  # Errors within which a goal is reached [m], [rad].
LOOSE = (0.05, 0.4)  # The same of arXiv:2505.13350.
LIMIT_SEC = 60.0  # Time limit for a goal.
FALLEN = -0.2  # Height below which the object is off the table [m].
FORCE_MAX = 40.0  # Greatest contact force on arm and finger together, at 1 kHz [N].
STOP_MAX = 0.995  # Greatest distance from the middle of a joint's half range.
FORCE_HZ = 100.0  # Cutoff of the low-passed force on the finger, which is reported.
REACHED, REACHED_LOOSE = 0.95, 0.99  # Fractions of goals to be reached.
# Settings whose real-time factor `makebreak bench diagrams` measures.
BENCH = {
    "pose by a sensor": {},
    "pose by a camera, drawn 320x240": {
        "pose_from": "camera",
        "camera.renderer": "drawn",
    },
}
OBJECT_FILE, MESH_FILE = "object.sdf", "object.obj"


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of a run, with a row for each tick; used for scoring only."""

    time: np.ndarray  # (n,) [s]
    pose: np.ndarray  # (n, 3) x, y [m], yaw [rad] of the object.
    tilt: np.ndarray  # (n,) of the object's z axis [rad].
    p_tip: np.ndarray  # (n, 3) [m]
    q: np.ndarray  # (n, 7) of the joints [rad],
    speed: np.ndarray  # (n, 7) and their speeds [rad/s].
    goal: np.ndarray  # (n,) number of the goal.


@dataclass(frozen=True, eq=False)
class Goal:
    """The outcome of one goal."""

    pose: np.ndarray  # (3,) x, y [m], yaw [rad].
    begin: float  # [s]
    end: float  # Start of the next goal, or end of the run [s].
    error: np.ndarray  # (2,) at its end: [m], [rad].
    reached: bool
    loose_sec: float  # Time until it was within LOOSE; NaN if never.


def off_goal(pose, goal, fold):
    """(n, 2) distance [m] and angle [rad] of poses (n, 3) to a goal (3,), up to the
    symmetry of the outline (`fold`: numerics/object_outline.py)."""
    distance = np.hypot(*(pose[:, :2] - goal[:2]).T)
    if fold == 0:
        return np.column_stack([distance, np.zeros(len(pose))])
    period = 2.0 * np.pi / fold
    turn = (pose[:, 2] - goal[2] + period / 2.0) % period - period / 2.0
    return np.column_stack([distance, abs(turn)])


def score_goals(truth: Truth, goals, fold: int) -> list[Goal]:
    """Scores goals (m, 3). A goal is reached if the object is truly there when the next
    goal is given, and within the time limit; one that was never given is missed."""
    found = []
    for k, pose in enumerate(goals):
        own = np.flatnonzero(truth.goal == k)
        if len(own) == 0:
            nan = float("nan")
            found.append(Goal(pose, nan, nan, np.full(2, np.nan), False, nan))
            continue
        last = min(own[-1] + 1, len(truth.time) - 1)
        off = off_goal(truth.pose[own[0] : last + 1], pose, fold)
        begin, end = float(truth.time[own[0]]), float(truth.time[last])
        in_time = end - begin <= LIMIT_SEC + 1e-6
        near = np.flatnonzero((off <= LOOSE).all(axis=1))
        loose = float(truth.time[own[0] + near[0]]) - begin if len(near) else np.nan
        reached = bool((off[-1] <= TOLERANCE).all() and in_time)
        loose = loose if loose <= LIMIT_SEC else np.nan
        found.append(Goal(pose, begin, end, off[-1], reached, loose))
    return found


def run(config, session):
    """Pushes the object to all goals, one after the other.

    `success`: 95 % of the goals reached within 2 cm, 0.1 rad and 60 s, 99 % within 5 cm
    and 0.4 rad, the forces of all contacts on arm and finger together at most 40 N, and
    the arm's limits kept, with no joint at its stop.
    """
    diagram = make_push_object(config, session.meshcat)
    system = diagram.GetSubsystemByName
    ports = {
        "goal": system("push_goals").GetOutputPort("log"),
        "x": system("state_estimator").GetOutputPort("x"),
        "state": system("station").GetOutputPort("state"),
    }
    plant = system("station").GetSubsystemByName("plant")
    height = plant.GetBodyByName(OBJECT).floating_positions_start() + 6
    if diagram.HasSubsystemNamed("residual_learner"):
        ports["r"] = system("residual_learner").GetOutputPort("r_comp")
    if diagram.HasSubsystemNamed("parameter_learner"):
        ports["r"] = system("learned_residual").get_output_port()

    def done(t, sample) -> str:
        if sample["state"][height] < FALLEN:
            return "the object fell off the table"
        return "all goals are done" if sample["goal"][0] >= config.n_goals else ""

    duration = config.n_goals * config.goals.limit_sec + 1.0
    log = session.simulate(diagram, duration, ports, SAMPLE, until=done)
    truth = the_truth(diagram, log.context)
    fold = outline_fold(config)
    goals = score_goals(truth, poses_of(config)[1:], fold)
    load = diagram.GetSubsystemByName("load_log").FindLog(log.context)
    result = score(config, diagram, log, truth, goals)
    write_recording(session, log, config)
    plot_paths(session, config, truth, goals)
    plot_errors(
        session, truth, goals, fold, load.sample_times(), load.data().sum(axis=0), log
    )
    return result


def the_truth(diagram, context) -> Truth:
    """The true poses of object and tip."""
    system = diagram.GetSubsystemByName
    plant = system("station").GetSubsystemByName("plant")
    found = system("state_log").FindLog(context)
    time, states = found.sample_times(), found.data().T
    body, tip = plant.GetBodyByName(OBJECT), plant.GetFrameByName(TIP_FRAME)
    own, n = plant.CreateDefaultContext(), len(time)
    pose, p_tip, tilt = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
    for i, state in enumerate(states):
        plant.SetPositionsAndVelocities(own, state)
        X = plant.EvalBodyPoseInWorld(own, body)
        R = X.rotation().matrix()
        pose[i] = [*X.translation()[:2], np.arctan2(R[1, 0], R[0, 0])]
        tilt[i] = np.arccos(np.clip(R[2, 2], -1.0, 1.0))
        p_tip[i] = tip.CalcPoseInWorld(own).translation()
    joint = plant.GetJointByName("panda_joint1")
    at, first = joint.position_start(), plant.num_positions() + joint.velocity_start()
    goal = system("goal_log").FindLog(context)
    row = np.searchsorted(goal.sample_times(), time + 1e-9) - 1
    number = goal.data()[0, row.clip(0)]
    q, speed = states[:, at : at + 7], states[:, first : first + 7]
    return Truth(time, pose, tilt, p_tip, q, speed, number)


def force_on_finger(diagram, context):
    """(n,) magnitude of the contact force on the finger at 1 kHz, after a first-order
    low-pass of FORCE_HZ [N]."""
    log = diagram.GetSubsystemByName("touch_log").FindLog(context)
    pole = np.exp(-2.0 * np.pi * FORCE_HZ * 1e-3)
    filtered = lfilter([1.0 - pole], [1.0, -pole], log.data(), axis=1)
    return np.linalg.norm(filtered, axis=0)


def score(config, diagram, log, truth, goals):
    """The entries of result.json; NaN (null in the file) for what did not occur."""
    system = diagram.GetSubsystemByName
    n = len(goals)
    reached = [goal.reached for goal in goals]
    loose = [not np.isnan(goal.loose_sec) for goal in goals]
    times = [g.end - g.begin if g.reached else float("nan") for g in goals]
    of_reached = [t for t in times if not np.isnan(t)]
    torque = system("torque_log").FindLog(log.context).data()
    plant = system("station").GetSubsystemByName("plant")
    actuators = actuators_of(plant, ARM)
    effort = np.array([each.effort_limit() for each in actuators])
    fastest = np.array([each.joint().velocity_upper_limits()[0] for each in actuators])
    lower = np.array([each.joint().position_lower_limits()[0] for each in actuators])
    upper = np.array([each.joint().position_upper_limits()[0] for each in actuators])
    middle, half = (lower + upper) / 2.0, (upper - lower) / 2.0
    rate = abs(np.diff(torque, axis=1)).max() / (1e-3 * TORQUE_RATE_MAX)
    touches = system("command_log").FindLog(log.context).data()[0]
    criteria = Criteria()
    for key, what, value, bound in (
        ("reached", "goals reached within 2 cm, 0.1 rad, 60 s", reached, REACHED),
        ("loose", "goals reached within 5 cm, 0.4 rad, 60 s", loose, REACHED_LOOSE),
    ):
        criteria.at_least(key, what, sum(value) / n, bound)
    load = system("load_log").FindLog(log.context)
    force = load.data().sum(axis=0)
    slow_force = force_on_finger(diagram, log.context)
    worst_at = int(np.argmax(force))  # The first NaN, if there is one.
    peak = float(force[worst_at])
    criteria.at_most("force", "contact forces on the arm, peak", peak, FORCE_MAX, "N")
    shares = {
        "torque": float((abs(torque).max(axis=1) / effort).max()),
        "torque_rate": float(rate),
        "joint_speed": float((abs(truth.speed).max(axis=0) / fastest).max()),
        "joint_range": float((abs(truth.q - middle) / half).max()),
    }
    worst = float(np.max(list(shares.values())))  # NaN, if one is.
    criteria.at_most("limits", "arm's limits, largest fraction used", worst, 1.0 + 1e-6)
    # A simulated joint cannot pass its stop, so the limit is a little below 1.
    stop = shares["joint_range"]
    criteria.at_most(
        "stops", "half of a joint's range, largest fraction used", stop, STOP_MAX
    )
    r = log["r"][-1, :N_TIP].mean() * LEARN if "r" in log and len(log.time) else 0.0
    return criteria.result() | {
        "n_goals": n,
        "goals_reached": sum(reached),
        "goals_reached_loose": sum(loose),
        "time_median_s": float(np.median(of_reached)) if of_reached else float("nan"),
        "time_s": times,
        "time_loose_s": [goal.loose_sec for goal in goals],
        "position_error_m": [float(goal.error[0]) for goal in goals],
        "yaw_error_rad": [float(goal.error[1]) for goal in goals],
        "places_chosen": int(touches.max()) if touches.size else 0,
        "contact_force_peak_N": peak,
        "contact_force_peak_time_s": float(load.sample_times()[worst_at]),
        "contact_force_peak_off_object_N": float(load.data()[1].max()),
        "finger_force_below_100hz_N": float(slow_force.max()),
        **{f"{name}_share_max": value for name, value in shares.items()},
        "tilt_max_rad": float(truth.tilt.max()),
        "r_gap_m": float(r),
        "simulated_s": float(log.time[-1]) if len(log.time) else 0.0,
        "camera": describe_camera(config.camera) if sees(config) else "none",
        "seed": config.seed,
        "adapt": config.adapt,
        "shape": config.object.shape,
        **what_was_learned(diagram, log.context),
    }


def sees(config) -> bool:
    return config.pose_from == "camera"


def write_recording(session, log, config):
    """Writes a recording as of a real robot, and the controllers' scene with a file of
    the object beside it."""
    session.write_text(OBJECT_FILE, object_sdf(config.object, MESH_FILE))
    if config.object.shape == "mesh":
        session.write_text(MESH_FILE, hull_obj(config.object))
    # Times from which the object's pose is known.
    phases = log.diagram.GetSubsystemByName("phase_log").FindLog(log.context)
    known = np.flatnonzero(phases.data()[0] != WAIT)
    begin = phases.sample_times()[known[0]] if len(known) else -np.inf
    columns = recorded(log.diagram, log.context, begin)
    read = np.column_stack([columns[name] for name in READING_COLUMNS])
    read = read[np.isfinite(read[:, 0])]
    # The object where it was seen first; if it never was, at the centre of the goals.
    p, q = np.array([*config.goals.center, 0.0]), [1.0, 0.0, 0.0, 0.0]
    if len(read):
        p, q = read[0, :3], read[0, 3:]
    height = rest_height(model_object(config)[0])
    axis = np.array(rolling_axis(config.object) or np.zeros(3))
    zero = np.zeros(3)
    p, _, q, _ = on_the_table(0.0, p, zero, np.array(q), zero, height, axis)
    pose = [*map(float, q), *map(float, p)]
    file = Path(session.out_dir).resolve() / OBJECT_FILE
    session.write_recording(columns, model_scene(config, file, pose))


# ----- Plots.

SHOWN_MAX = 12  # Goals that are drawn.


def outlines(spec):
    """Corners (n, 2) of each part from above, in the object's frame."""
    plans = [part.points[:, :2] for part in parts(spec)]
    return [plan[ConvexHull(plan).vertices] for plan in plans]


def draw_outline(ax, plans, pose, **style):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for plan in plans:
        at = plan @ np.array([[c, s], [-s, c]]) + pose[:2]
        at = np.vstack([at, at[:1]])
        ax.plot(at[:, 1], at[:, 0], **style)
        style.pop("label", None)


def plot_paths(session, config, truth, goals):
    """One plot for each goal, from above as the camera sees it (x up, y left)."""
    plans = outlines(config.object)
    shown = [goal for goal in goals if not np.isnan(goal.begin)][:SHOWN_MAX]
    columns = min(4, max(1, len(shown)))
    rows = max(1, -(-len(shown) // columns))
    fig, axes = plt.subplots(
        rows,
        columns,
        figsize=(3.2 * columns + 0.6, 2.9 * rows + 0.7),
        squeeze=False,
        layout="constrained",
    )
    for ax in axes.flat[len(shown) :]:
        ax.axis("off")
    for k, (ax, goal) in enumerate(zip(axes.flat, shown, strict=False)):
        within = (truth.time >= goal.begin - 1e-9) & (truth.time <= goal.end + 1e-9)
        pose, tip = truth.pose[within], truth.p_tip[within]
        ax.plot(tip[:, 1], tip[:, 0], color="0.75", lw=0.6, label="tip")
        ax.plot(pose[:, 1], pose[:, 0], color="tab:orange", lw=1.2, label="path")
        draw_outline(ax, plans, pose[0], color="tab:orange", ls=":", label="start")
        draw_outline(ax, plans, pose[-1], color="tab:orange", label="end")
        draw_outline(ax, plans, goal.pose, color="tab:green", ls="--", label="goal")
        took = f"{goal.end - goal.begin:.1f} s"
        title = f"{k + 1}: {took}" if goal.reached else f"{k + 1}: missed, {took}"
        ax.set_title(title, fontsize=9)
        ax.set_aspect("equal")
        ax.invert_xaxis()
        ax.tick_params(labelsize=7)
    if shown:
        fig.legend(
            *axes.flat[0].get_legend_handles_labels(),
            loc="outside upper center",
            ncols=5,
            fontsize=8,
        )
    fig.supxlabel("y [m]", fontsize=9)
    fig.supylabel("x [m]", fontsize=9)
    session.save_plot(fig, "paths")


def plot_errors(session, truth, goals, fold, force_time, force, log):
    """Distance and angle to the goal, contact forces, and learned residuals."""
    rows = 4 if "r" in log else 3
    fig, axes = plt.subplots(
        rows, 1, figsize=(7, 1.9 * rows), sharex=True, layout="constrained"
    )
    for goal in goals:
        if np.isnan(goal.begin):
            continue
        within = (truth.time >= goal.begin - 1e-9) & (truth.time < goal.end)
        off = off_goal(truth.pose[within], goal.pose, fold)
        for ax, value in zip(axes, off.T, strict=False):
            ax.semilogy(truth.time[within], np.maximum(value, 1e-4), color="C0", lw=0.9)
            ax.axvline(goal.begin, color="0.85", lw=0.6, zorder=0)
    for ax, tight, loose, name in zip(
        axes, TOLERANCE, LOOSE, ("distance [m]", "turn [rad]"), strict=False
    ):
        ax.axhline(tight, color="tab:green", lw=0.8, label="reached")
        ax.axhline(loose, color="tab:green", lw=0.8, ls=":", label="loosely")
        ax.set_ylabel(name)
    axes[0].legend(loc="upper right", fontsize=8)
    axes[2].plot(force_time, force, lw=0.6)
    axes[2].set_ylabel("force [N]")
    if "r" in log:
        axes[3].plot(log.time, 1e3 * LEARN * log["r"][:, :N_TIP].mean(axis=1), lw=0.8)
        axes[3].set_ylabel("learned gap [mm]")
    axes[-1].set_xlabel("time [s]")
    session.save_plot(fig, "errors")


# ----- reproduce

# Consecutive goals of a run: with 10 seeds 100 for the T, 50 for the others.
GOALS = {"t": 10, "box": 5, "l": 5}
DEMANDED = {"T, model right": 100, "box, model right": 50, "L, model right": 50}
GOALS_WRONG, GOALS_OTHER = 5, 2
FRICTION = 0.5  # Of the world in the cases with a wrong model.
WRONG: dict[str, dict] = {
    "friction halved": {"model.friction": 0.25},
    "friction doubled": {"model.friction": 1.0},
    "size 10 % less": {"model.scale": 0.9},
    "size 10 % more": {"model.scale": 1.1},
    "centre of mass 15 mm off": {"model.com_offset": [0.015, 0.0]},
}
NAMES = {"t": "T", "l": "L"}
CAMERA = {"pose_from": "camera", "camera.renderer": "drawn"}
PAPER = {  # Published results, with other robots and objects.
    "reached": "98 % of 33 objects (Push Anything)",
    "loose": "73 of 73 (arXiv:2505.13350)",
    "time": "0.5 min per object (Push Anything)",
}


def cases() -> dict[str, dict]:
    """{name: settings} of the runs that are made with each seed."""
    found: dict[str, dict] = {}
    for shape, n in GOALS.items():
        name = f"{NAMES.get(shape, shape)}, model right"
        found[name] = {"object.shape": shape, "n_goals": n}
    for shape in ("disc", "cylinder"):
        found[f"{shape}, model right"] = {
            "object.shape": shape,
            "n_goals": GOALS_OTHER,
        }
    found["T, model right, camera"] = {"n_goals": GOALS_OTHER} | CAMERA
    found["T, model right, no adaptation"] = {"adapt": False, "n_goals": GOALS_WRONG}
    for what, settings in WRONG.items():
        for adapt in (True, False):
            name = f"T, {what}, {'adapt' if adapt else 'no adaptation'}"
            found[name] = settings | {
                "adapt": adapt,
                "friction": FRICTION,
                "n_goals": GOALS_WRONG,
            }
    return found


def totals(runs, n_goals: int) -> dict:
    """Number of goals, goals reached, and times, over several results. A run that
    failed counts as n_goals missed."""
    good = [run for run in runs if "error" not in run]
    lost = n_goals * (len(runs) - len(good))
    # A goal that was missed counts with the whole time limit.
    times = [LIMIT_SEC if t is None else t for run in good for t in run["time_s"]]
    times += [LIMIT_SEC] * lost
    return {
        "n": sum(run["n_goals"] for run in good) + lost,
        "reached": sum(run["goals_reached"] for run in good),
        "loose": sum(run["goals_reached_loose"] for run in good),
        "time": float(np.median(times)) if times else float("nan"),
        "force": max((run["contact_force_peak_N"] for run in good), default=np.nan),
        "slow_force": max(
            (run["finger_force_below_100hz_N"] for run in good), default=np.nan
        ),
    }


def won_back(right: float, without: float, adapted: float) -> float:
    """The fraction of a loss that the learner wins back; NaN without a loss."""
    lost = right - without
    return (adapted - without) / lost if abs(lost) > 1e-9 else float("nan")


def reproduce(session, seeds, jobs) -> Table:
    """Consecutive random goals, with a right and a wrong model, with and without the
    learner."""
    named = cases()
    trials = [(settings, s) for settings in named.values() for s in range(seeds)]
    results = run_many(
        "push_object", trials, jobs, session.out_dir, reuse=session.reuse
    )
    return table_of(
        {n: results[i * seeds : (i + 1) * seeds] for i, n in enumerate(named)}
    )


def table_of(group: dict[str, list[dict]]) -> Table:
    """The table of `reproduce` from {case: results}; a case may lack runs."""
    named = cases()
    table = Rows("makebreak reproduce push_object")
    add = table.row
    found = {}
    for name, runs in group.items():
        t = found[name] = totals(runs, named[name]["n_goals"])
        # Fewer goals than demanded do not count.
        demanded = t["n"] >= DEMANDED.get(name, np.inf)
        for key, what, share in (
            ("reached", "2 cm, 0.1 rad, 60 s", REACHED),
            ("loose", "5 cm, 0.4 rad, 60 s", REACHED_LOOSE),
        ):
            goal = t[key] >= share * t["n"] if demanded else None
            published = PAPER[key] if demanded else "-"
            add(f"{name}: {what}", published, rate_text(t[key], t["n"]), goal)
        add(
            f"{name}: median time, {LIMIT_SEC:.0f} s where missed",
            PAPER["time"] if demanded else "-",
            f"{t['time']:.1f} s",
        )
        add(f"{name}: peak of all contact forces on the arm, 1 kHz", "-",
            f"{t['force']:.1f} N", bool(t["force"] <= FORCE_MAX))  # fmt: skip
        add(f"{name}: peak force on the finger, below {FORCE_HZ:.0f} Hz", "-",
            f"{t['slow_force']:.1f} N")  # fmt: skip
    right = found["T, model right"]
    for what in WRONG:
        with_it, without = (
            found[f"T, {what}, {way}"] for way in ("adapt", "no adaptation")
        )
        share, time = (
            won_back(*(of(t) for t in (right, without, with_it)))
            for of in (lambda t: t["reached"] / t["n"], lambda t: t["time"])
        )
        for name, value, loss in (
            ("success", share, right["reached"] / right["n"]
             - without["reached"] / without["n"]),
            ("time", time, without["time"] - right["time"]),
        ):  # fmt: skip
            lost = loss > (0.05 if name == "success" else 0.1 * right["time"])
            text = f"{100 * value:.0f} % of what was lost" if lost else "nothing lost"
            add(f"T, {what}: the learner wins back, {name}", "-", text,
                bool(value >= 0.5) if lost else None)  # fmt: skip
    notes = [
        f"Goals in a row of one run: {GOALS['t']} of the T, {GOALS['box']} of box and "
        f"L, {GOALS_WRONG} where the model is wrong, {GOALS_OTHER} of the others; the "
        "start and the goals are drawn by the seed.",
        "Rates with Wilson's 95 % interval. Published: runs on hardware, other objects "
        "and tolerances; Push Anything's is per object.",
        "Nothing lost: without the learner less than 5 % of the goals, or 10 % of the "
        "time, is lost.",
    ]
    notes += [
        f"{name}, seed {run['seed']} failed: {run['error']}"
        for name, runs in group.items()
        for run in runs
        if "error" in run
    ]
    return table.to_table(
        "Pushing an object to poses, the planner choosing where to touch it",
        notes,
        "published",
    )

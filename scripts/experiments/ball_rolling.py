"""Adaptive rolling of a ball that is modelled wrongly (ACI-MPC VII-B, Fig. 5, 6)."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from makebreak.diagrams.ball_rolling import BALL_CHANNELS, make_ball_rolling, task_name
from makebreak.diagrams.ball_rolling_config import (
    LEARN,
    BallRollingConfig,
    controller_model,
)
from makebreak.diagrams.fault_kinds import read_fault
from makebreak.diagrams.lcm_station import make_lcm_station
from makebreak.diagrams.learned_parameters import what_was_learned
from makebreak.diagrams.recorder import recorded
from makebreak.diagrams.replay_station import joint_columns, make_replay_station
from makebreak.diagrams.station import TIP_FRAME, TORQUE_RATE_MAX, make_control_plant
from makebreak.gap.data.table import read_table
from makebreak.scripts.experiments.papers import rolling_paper
from makebreak.scripts.experiments.papers.rolling_score import (
    CIRCLES,
    DURATION_SEC,
    ERROR_MAX,
    SAMPLE,
    Progress,
    contact_truth,
    first_time,
    ground_truth,
    plot_path,
    plot_residual,
    progress_of,
    score,
    speed_at_the_end,
    write_recording,
)
from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.lcm_loop import drive
from makebreak.systems.contact_mpc.numerics.ball_state import P_BALL

SUMMARY = "a Panda rolls a ball around a circle with a wrong model (ACI-MPC VII-B)"
Config = BallRollingConfig
reproduce = rolling_paper.reproduce

GIVE_UP_SEC = 60.0  # A run in which nothing rolls by then ends.
# The tip of a real arm, of where the scene has it at first [m]: the circle, and where
# the task withdraws to.
START_WITHIN = 0.3
ALIKE = 3.0  # Commands of a replay that differ by less are alike [N m].
LOST = 0.1  # So far outside the circle the ball is out of reach [m].
# What `makebreak bench diagrams` takes the real-time factor of.
BENCH = {
    "drawn 320x240": {"camera.renderer": "drawn"},
    "VTK 320x240": {"camera.renderer": "vtk"},
}


def run(config, session):
    """Rolls until four circles are done, the time is over or nothing rolls.

    `success`: four circles within 240 s with a mean distance to the path of at most
    4 mm after the first quarter.
    """
    diagram = make_ball_rolling(config, session.meshcat)
    system = diagram.GetSubsystemByName
    station, plant = system("station"), system("station").GetSubsystemByName("plant")
    record = {
        "state": station.GetOutputPort("state"),
        "x": system("state_estimator").GetOutputPort("x"),
        "gap": system("learned_gap").get_output_port(),
        "seen": system("ball_tracker").GetOutputPort("seen"),
        "c3_status": system("c3_mpc").GetOutputPort("status"),
        "phase": system(task_name(diagram)).GetOutputPort("phase"),
    }
    if diagram.HasSubsystemNamed("residual_learner"):
        learner = system("residual_learner")
        record["loss"] = learner.GetOutputPort("loss")
        record["r_std"] = learner.GetOutputPort("r_std")
    if diagram.HasSubsystemNamed("parameter_learner"):
        learner = system("parameter_learner")
        record["loss"] = learner.GetOutputPort("loss")
        record["r_std"] = system("learned_std").get_output_port()
    at = plant.GetBodyByName("ball").floating_positions_start() + 4
    center = np.array(config.task.circle.center)
    progress = Progress(center, config.task.circle.radius)
    taken = any(read_fault(text).kind.on == "ball" for text in config.faults)

    def done(t, sample):
        p = sample["state"][at : at + 2]
        angle = progress.went_to(p)
        stuck = t >= GIVE_UP_SEC and angle < np.pi / 2
        # Out of reach for good, that is: not in a hand.
        lost = np.hypot(*(p - center)) > config.task.circle.radius + LOST and not taken
        return ending(angle, stuck, lost)

    log = session.simulate(diagram, DURATION_SEC, record, SAMPLE, until=done)
    track = ground_truth(config, log, plant)
    contact = contact_truth(config, diagram, log, plant)
    result = score(config, log, track, contact)
    result |= what_was_learned(diagram, log.context)
    torque = system("torque_log").FindLog(log.context).data()
    result["torque_peak_Nm"] = float(abs(torque).max())
    at_limit = abs(np.diff(torque, axis=1)) >= TORQUE_RATE_MAX * 1e-3 * (1.0 - 1e-9)
    result["torque_rate_limited_share"] = float(at_limit.any(axis=0).mean())
    if config.faults:  # For `reproduce faults`: how far it had come, each second.
        second = np.searchsorted(track.time, np.arange(0.0, track.time[-1]) - 1e-9)
        result["angle_by_second_rad"] = track.progress[second].round(4).tolist()
        result["tip_speed_end_m_s"] = speed_at_the_end(track)
    write_recording(session, log, config)
    plot_path(session, config, track)
    plot_residual(session, log, track)
    return result


def run_on_lcm(config, session, url: str) -> dict:
    """Rolls with a robot behind LCM, until four circles are done, as the camera sees
    them, or the time is over. There is no ground truth: errors are those of the
    estimated ball.

    Raises: ValueError for faults, which the robot's side has, and if no robot answers.
    """
    if config.faults:
        raise ValueError("--fault: the robot's side has the faults: makebreak station")
    if config.contact_sequence != "cycle":
        raise ValueError(
            f"--robot lcm: contact_sequence is {config.contact_sequence}, expected "
            "cycle"
        )
    arm = make_control_plant(controller_model(config)[1])
    diagram = make_ball_rolling(config, station=make_lcm_station(arm))
    system = diagram.GetSubsystemByName
    ports = {
        "x": system("state_estimator").GetOutputPort("x"),
        "gap": system("learned_gap").get_output_port(),
        "seen": system("ball_tracker").GetOutputPort("seen"),
    }
    if diagram.HasSubsystemNamed("residual_learner"):
        ports["r_std"] = system("residual_learner").GetOutputPort("r_std")
    center, radius = np.array(config.task.circle.center), config.task.circle.radius
    rolled = Progress(center, radius)

    def done(t, sample) -> str:
        if sample["seen"][0] < 0.5:
            return ""
        p = sample["x"][P_BALL][:2]
        lost = np.hypot(*(p - center)) > radius + LOST
        return ending(rolled.went_to(p), False, lost)

    def begin(_, context, q):
        start_where_it_is(diagram, context, q, arm)

    log, report = drive(session, diagram, ports, begin, url, DURATION_SEC, SAMPLE, done)
    seen = log["seen"][:, 0] > 0.5 if len(log.time) else np.zeros(0, bool)
    if not seen.any():
        raise ValueError("--robot lcm: the ball was never seen")
    p_ball = log["x"][seen][:, P_BALL]
    progress = progress_of(p_ball, center, radius)
    off = abs(np.linalg.norm(p_ball[:, :2] - center, axis=1) - radius)
    after = off[int(np.argmax(progress >= np.pi / 2)) :]
    circles = float(progress.max() / (2.0 * np.pi))
    mean = float(after.mean()) if circles > 0.25 else float("nan")
    criteria = Criteria()
    criteria.at_least("circles", "circles completed, as seen", circles, CIRCLES)
    criteria.at_most("error", "tracking error as seen, mean", mean, ERROR_MAX, "m")
    columns = recorded(diagram, log.context)
    row = np.searchsorted(log.time, columns["time"] - 1e-9).clip(0, len(log.time) - 1)
    for name in BALL_CHANNELS:
        columns[name] = np.where(seen[row], columns[name], np.nan)
    session.write_recording(columns, controller_model(config)[1])
    torque = system("torque_log").FindLog(log.context).data()
    return criteria.result() | {
        "circles_completed_seen": circles,
        "tracking_error_mean_seen_m": mean,
        "r_gap_m": float(log["gap"][-1, 0]),
        "r_gap_std_m": LEARN * float(log["r_std"][-1, 0]) if "r_std" in log else 0.0,
        "seen_share": float(seen.mean()),
        "torque_peak_Nm": float(abs(torque).max()),
        "controlled_s": float(log.time[-1]),
        **report.result(),
        "seed": config.seed,
        "adapt": config.adapt,
        "radius_error_m": config.radius_error_m,
    }


def run_on_recording(config, session, recording: Path) -> dict:
    """The controllers with the sensors of a recording in place of the world, open loop:
    what they command beside what was commanded.

    `success`: every command is finite. How far they may differ depends on what was
    changed since.

    Raises: ValueError for faults of what is not there.
    """
    for text in config.faults:
        if read_fault(text).kind.on != "planner":
            raise ValueError(f"--fault {text}: a recording has no robot that it meets")
    columns = read_table(recording).columns
    model, scene = controller_model(config)
    station = make_replay_station(columns, BALL_CHANNELS, model.ball_radius)
    diagram = make_ball_rolling(config, session.meshcat, station)
    system = diagram.GetSubsystemByName
    record = {
        "gap": system("learned_gap").get_output_port(),
        "phase": system(task_name(diagram)).GetOutputPort("phase"),
    }
    time = columns["time"]
    log = session.simulate(diagram, float(time[-1]), record, SAMPLE)
    again = recorded(diagram, log.context)
    names = joint_columns("effort_command")
    # Rows begin with the same instant; those of the recording may be closer together.
    row = np.searchsorted(time, again["time"] - 1e-6).clip(0, len(time) - 1)
    there = np.column_stack([columns[name] for name in names])[row]
    here = np.column_stack([again[name] for name in names])
    session.write_recording(again, scene)
    fig, axes = plt.subplots(len(names), sharex=True, figsize=(7, 9))
    for k, ax in enumerate(axes):
        ax.plot(again["time"], there[:, k], lw=0.8, label="recorded")
        ax.plot(again["time"], here[:, k], lw=0.8, label="now")
        ax.set_ylabel(f"joint {k + 1} [N m]")
    axes[0].legend(loc="upper right")
    axes[-1].set_xlabel("time [s]")
    session.save_plot(fig, "commands")
    criteria = Criteria()
    lost = float((~np.isfinite(here)).sum())
    criteria.at_most("finite", "commands that are not finite", lost, 0.0)
    return criteria.result() | {
        "replayed_s": float(again["time"][-1]),
        **differences(again["time"], there, here),
        "r_gap_m": float(log["gap"][-1, 0]),
        "seed": config.seed,
        "adapt": config.adapt,
        "radius_error_m": config.radius_error_m,
    }


def differences(time, recorded, now) -> dict:
    """How far the commands of a replay are from the recorded ones.

    Args: time (n,) [s]; recorded, now (n, 7) [N m]. What is not finite is not alike.
    """
    off = abs(now - recorded)
    worst = off.max(axis=1)
    spread = recorded - recorded.mean(axis=0)
    return {
        "command_difference_rms_Nm": np.sqrt((off**2).mean(axis=0)).tolist(),
        "command_spread_rms_Nm": np.sqrt((spread**2).mean(axis=0)).tolist(),
        "commands_alike_until_s": first_time(time, ~(worst <= ALIKE)),
        "command_difference_max_Nm": float(worst.max()),
        "command_difference_max_at_s": float(time[int(np.argmax(worst))]),
    }


def start_where_it_is(diagram, context, q, arm) -> None:
    """The controllers begin with the arm at q (7,) [rad], in the diagram's root context
    `context`; what was learned stays. Args: arm: the control plant.

    Raises: ValueError if the tip is too far away for the task.
    """
    plant_context = arm.CreateDefaultContext()
    tip = arm.GetFrameByName(TIP_FRAME)
    home = tip.CalcPoseInWorld(plant_context).translation()
    arm.SetPositions(plant_context, q)
    p_tip = tip.CalcPoseInWorld(plant_context).translation()
    if not np.linalg.norm(p_tip - home) <= START_WITHIN:
        raise ValueError(
            f"--robot lcm: the tip is at {p_tip.round(3).tolist()}, expected within "
            f"{START_WITHIN} m of {home.round(3).tolist()}"
        )

    def own(name):
        system = diagram.GetSubsystemByName(name)
        return system, system.GetMyMutableContextFromRoot(context)

    for name in ("ball_tracker", "c3_mpc", "state_estimator", "rolling_task"):
        system, at = own(name)
        at.SetStateAndParametersFrom(system.CreateDefaultContext())
    for name, place in (
        ("rolling_task", p_tip),
        ("arm_reference", p_tip),
        ("impedance_controller", q),
    ):
        system, at = own(name)
        system.start_at(at, place)
    system, at = own("state_estimator")
    system.start_at(at)


def ending(angle: float, stuck: bool, lost: bool) -> str:
    """Why the run is over; empty while it is not. Args: angle, gone around [rad]."""
    if angle >= 2.0 * np.pi * CIRCLES:
        return f"{CIRCLES} circles are done"
    if lost:
        return f"the ball is out of reach, {LOST} m or more outside the circle"
    return "the ball has not been rolled on for too long" if stuck else ""

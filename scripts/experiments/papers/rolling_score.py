"""Scores of `ball_rolling` and `gentle_rolling`: ground truth of ball and tip, the
entries of result.json, the recording and the plots."""

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from pydrake.systems.framework import DiagramBuilder
from scipy.signal import lfilter

from makebreak.diagrams.ball_rolling import BALL_CHANNELS
from makebreak.diagrams.ball_rolling_config import LEARN, controller_model, world_scene
from makebreak.diagrams.camera import describe_camera
from makebreak.diagrams.realism import draw_errors, with_errors
from makebreak.diagrams.recorder import recorded
from makebreak.diagrams.scene_facts import sphere_radius, spheres_of
from makebreak.diagrams.station import ARM, TIP_FRAME, TOOL, make_control_plant
from makebreak.models.scene import load_scene, read_scene
from makebreak.scripts.runner.criteria import Criteria
from makebreak.systems.arm.impedance_controller import serial_chain_of
from makebreak.systems.arm.numerics.contact_force import contact_forces
from makebreak.systems.arm.numerics.serial_chain import SerialChain, tip_kinematics
from makebreak.systems.contact_mpc.numerics.ball_state import P_BALL, P_TIP
from makebreak.systems.contact_mpc.numerics.rolling_task import ROLL

DURATION_SEC = 240.0
CIRCLES = 4
ERROR_MAX = 0.004  # Greatest mean distance to the path of a success [m].
SAMPLE = 0.0125  # [s]
SETTLED_SEC = 10.0  # Time from which the learned gap is scored.
Z_90 = 1.645  # Half width of a 90 % interval [standard deviations].


@dataclass(frozen=True, eq=False)
class Track:
    """Ground truth of a run, with a row for each sample."""

    time: np.ndarray  # (n,) [s]
    p_ball: np.ndarray  # (n, 3) [m]
    p_tip: np.ndarray  # (n, 3) [m]
    progress: np.ndarray  # (n,) angle covered along the circle [rad].
    error: np.ndarray  # (n,) distance to the path [m].
    gap: np.ndarray  # (n,) learned residual as a length [m].
    gap_true: np.ndarray  # (n,) true minus modelled distance of tip and ball [m].
    gap_std: np.ndarray  # (n,) standard deviation of gap [m]; 0: not estimated.
    rolling: np.ndarray  # (n,) whether the task is pushing.


def turned(before, after, radius):
    """Angle(s) [rad] about the origin from points before, (2,) or (n, 2), to after; 0
    further than half a radius from the circle, as near the centre a large angle is a
    short way."""
    before, after = np.asarray(before), np.asarray(after)
    angle = np.arctan2(after[..., 1], after[..., 0])
    angle = angle - np.arctan2(before[..., 1], before[..., 0])
    off = abs(np.hypot(after[..., 0], after[..., 1]) - radius)
    return np.where(off <= 0.5 * radius, (angle + np.pi) % (2.0 * np.pi) - np.pi, 0.0)


def progress_of(p, center, radius):
    """Angle (n,) [rad] that the points p (n, 3) have covered around the circle."""
    off = p[:, :2] - center
    return np.append(0.0, np.cumsum(turned(off[:-1], off[1:], radius)))


class Progress:
    """progress_of, place by place, while a run goes on."""

    def __init__(self, center, radius):
        self._center, self._radius = np.array(center), radius
        self._last = None
        self.angle = 0.0  # [rad]

    def went_to(self, p) -> float:
        """How far it has gone around with the ball at p (2,) or (3,) [rad]."""
        off = np.asarray(p)[:2] - self._center
        if self._last is not None:
            self.angle += float(turned(self._last, off, self._radius))
        self._last = off
        return self.angle


def speed_at_the_end(track: Track) -> float:
    """The tip's largest speed within the last second [m/s], over 0.1 s each."""
    step = round(0.1 / SAMPLE)
    p_tip = track.p_tip[track.time >= track.time[-1] - 1.0][::step]
    if len(p_tip) < 2:
        return float("nan")
    moved = np.linalg.norm(np.diff(p_tip, axis=0), axis=1)
    return float(moved.max() / (step * SAMPLE))


def first_time(time, condition):
    """The first time at which the condition (n,) holds; NaN if never."""
    return float(time[np.argmax(condition)]) if condition.any() else float("nan")


def ground_truth(config, log, plant) -> Track:
    """True positions of ball and tip, for scoring only."""
    context = plant.CreateDefaultContext()
    tip, ball = plant.GetFrameByName(TIP_FRAME), plant.GetBodyByName("ball")
    p_tip, p_ball = np.zeros((2, len(log.time), 3))
    R_ball = np.zeros((len(log.time), 3, 3))
    for i, state in enumerate(log["state"]):
        plant.SetPositionsAndVelocities(context, state)
        p_tip[i] = tip.CalcPoseInWorld(context).translation()
        X_ball = plant.EvalBodyPoseInWorld(context, ball)
        p_ball[i], R_ball[i] = X_ball.translation(), X_ball.rotation().matrix()
    center = np.array(config.task.circle.center)
    model, _ = controller_model(config)
    world = load_scene(world_scene(config), DiagramBuilder())
    r_tip = sphere_radius(world.plant, world.scene_graph, TOOL)
    centers, radii = spheres_of(world.plant, world.scene_graph, "ball")
    reach_model = model.tip_radius + model.ball_radius
    x = log["x"]
    # The tip's centre in the ball's frame; a fruit is many spheres.
    inside = np.einsum("nji,nj->ni", R_ball, p_tip - p_ball)
    to_each = np.linalg.norm(inside[:, None] - centers, axis=2) - radii
    distance = to_each.min(axis=1) - r_tip
    modelled = np.linalg.norm(x[:, P_TIP] - x[:, P_BALL], axis=1) - reach_model
    return Track(
        time=log.time,
        p_ball=p_ball,
        p_tip=p_tip,
        progress=progress_of(p_ball, center, config.task.circle.radius),
        error=abs(
            np.linalg.norm(p_ball[:, :2] - center, axis=1) - config.task.circle.radius
        ),
        gap=log["gap"][:, 0],
        gap_true=distance - modelled,
        gap_std=LEARN * log["r_std"][:, 0] if "r_std" in log else 0.0 * log.time,
        rolling=log["phase"][:, 0] == ROLL,
    )


def true_arm(config) -> SerialChain:
    """The arm and its tool as they are in the world, with the station's errors."""
    errors = draw_errors(config.realism, config.seed)
    scene = with_errors(read_scene(config.world), errors, ARM, TOOL)
    return serial_chain_of(make_control_plant(scene), TIP_FRAME)


def contact_truth(config, diagram, log, plant):
    """Time (n,) [s] and normal force (n,) [N] of the ball on the tip, each ms."""
    system = diagram.GetSubsystemByName
    state = system("state_log").FindLog(log.context)
    torque = system("contact_log").FindLog(log.context).data().T
    arm, ball = plant.GetModelInstanceByName(ARM), plant.GetBodyByName("ball")
    q_first = plant.GetJointByName("panda_joint1").position_start()
    q = state.data()[q_first : q_first + plant.num_positions(arm)].T
    at = ball.floating_positions_start() + 4
    p_ball = state.data()[at : at + 3].T
    chain = true_arm(config)
    q = np.ascontiguousarray(q)
    p_tip = np.array([tip_kinematics(chain, row)[0] for row in q])
    away = p_tip - p_ball
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    world = load_scene(config.world, DiagramBuilder())
    radius = sphere_radius(world.plant, world.scene_graph, TOOL)
    force = contact_forces(
        chain, q, np.ascontiguousarray(torque), np.ascontiguousarray(-radius * away)
    )
    return state.sample_times(), (force * away).sum(axis=1)


def score(config, log, track, contact):
    """The entries of result.json; NaN (null in the file) for events that did not occur.

    Args: track: ground truth; contact: (time, force) of contact_truth.
    """
    circles = track.progress.max() / (2.0 * np.pi)
    initiated = bool(track.progress.max() >= np.pi / 2)
    after = slice(int(np.argmax(track.progress >= np.pi / 2)), None)
    error = track.error[after] if initiated else np.array([np.nan])
    last = track.progress >= track.progress.max() - 2.0 * np.pi
    settled = circles >= 1.0
    gap_error = float("nan")
    if settled:
        gap_error = float((track.gap[last] - track.gap_true[last]).mean())
    mean = float(error.mean())
    loss = log["loss"][:, 0] if "loss" in log else np.array([])
    # After the learner's first pushes, where it gives a standard deviation.
    judged = (track.time > SETTLED_SEC) & (track.gap_std > 0.0)
    off = track.gap - track.gap_true
    covered = rms = float("nan")
    if judged.any():
        covered = float((abs(off[judged]) <= Z_90 * track.gap_std[judged]).mean())
        rms = float(np.sqrt((off[judged] ** 2).mean()))
    started = np.flatnonzero(np.diff(track.rolling.astype(int)) > 0) + 1
    quarter = first_time(track.time, track.progress >= np.pi / 2)
    pushes = int((track.time[started] < quarter).sum()) if initiated else None
    learned = loss[loss > 0.0]
    time, force = contact
    # First-order low-pass of 100 Hz at 1 kHz.
    pole = np.exp(-2.0 * np.pi * 100.0 * 1e-3)
    filtered = lfilter([1.0 - pole], [1.0, -pole], force)
    # Means over 6 s at either end, as single samples are noisy.
    span = round(6.0 / SAMPLE)
    criteria = Criteria()
    criteria.at_least("circles", "circles completed", float(circles), CIRCLES)
    criteria.at_most("error", "tracking error, mean", mean, ERROR_MAX, "m")
    limit = DURATION_SEC + SAMPLE
    criteria.at_most("time", "simulated time", float(track.time[-1]), limit, "s")
    return criteria.result() | {
        "initiated": initiated,
        "one_circle": bool(circles >= 1.0),
        "circles_completed": float(circles),
        "time_to_first_contact_s": first_time(time, force > 0.05),
        "time_to_quarter_circle_s": quarter,
        "pushes_to_quarter_circle": pushes,
        "time_to_circles_s": first_time(
            track.time, track.progress >= 2.0 * np.pi * CIRCLES
        ),
        "tracking_error_mean_m": mean,
        "tracking_error_p95_m": float(np.percentile(error, 95)),
        "tracking_error_max_m": float(error.max()),
        "r_gap_m": float(track.gap[last].mean()) if settled else float(track.gap[-1]),
        "r_gap_error_m": gap_error,
        "r_gap_error_rms_m": rms,
        "r_gap_std_m": float(track.gap_std[last].mean()),
        "r_gap_covered_share": covered,
        "residual_loss_first": float(learned[:span].mean()) if learned.size else None,
        "residual_loss_last": float(learned[-span:].mean()) if learned.size else None,
        "contact_force_peak_N": float(filtered.max()),
        "seen_share": float((log["seen"] > 0.5).mean()),
        "c3_held_share": float((log["c3_status"] > 0.5).mean()),
        "simulated_s": float(track.time[-1]),
        "camera": describe_camera(config.camera),
        "seed": config.seed,
        "adapt": config.adapt,
        "contact_sequence": config.contact_sequence,
        "radius_error_m": config.radius_error_m,
    }


def write_recording(session, log, config):
    """Writes a recording as of a real robot (the ball only while the camera sees it),
    and the controllers' scene."""
    columns = recorded(log.diagram, log.context)
    row = np.searchsorted(log.time, columns["time"] - 1e-9).clip(0, len(log.time) - 1)
    seen = log["seen"][row, 0] > 0.5
    for name in BALL_CHANNELS:
        columns[name] = np.where(seen, columns[name], np.nan)
    session.write_recording(columns, controller_model(config)[1])


def plot_path(session, config, track):
    """Fig. 5: the ball's track beside the target path."""
    fig, ax = plt.subplots(figsize=(5, 5), layout="constrained")
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    x, y = config.task.circle.center
    radius = config.task.circle.radius
    ax.plot(
        x + radius * np.cos(angle), y + radius * np.sin(angle), "k--", label="target"
    )
    ax.plot(track.p_ball[:, 0], track.p_ball[:, 1], color="tab:orange", label="ball")
    ax.plot(*track.p_ball[0, :2], "o", color="tab:orange", label="start")
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="Track of the ball")
    ax.legend(loc="center")
    session.save_plot(fig, "path")


def plot_residual(session, log, track):
    """Fig. 6: residual and loss over time, and the tracking error."""
    fig, axes = plt.subplots(3, 1, figsize=(7, 7), sharex=True, layout="constrained")
    true = np.where(log["seen"][:, 0] > 0.5, 1e3 * track.gap_true, np.nan)
    axes[0].plot(track.time, true, lw=0.4, color="0.7", label="true")
    axes[0].plot(track.time, 1e3 * track.gap, label="learned r_comp dt")
    if track.gap_std.any():
        reach = Z_90 * track.gap_std
        low, high = 1e3 * (track.gap - reach), 1e3 * (track.gap + reach)
        axes[0].fill_between(
            track.time, low, high, color="C0", alpha=0.2, lw=0, label="its 90 %"
        )
    axes[0].set_ylabel("gap, true - modelled [mm]")
    fig.legend(
        *axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3
    )
    if "loss" in log:
        loss = log["loss"][:, 0]
        axes[1].semilogy(track.time, np.where(loss > 0.0, loss, np.nan), lw=0.8)
    else:
        axes[1].text(0.5, 0.5, "no adaptation", transform=axes[1].transAxes)
    axes[1].set_ylabel("loss")
    axes[2].plot(track.time, 1e3 * track.error, lw=0.8)
    axes[2].set(ylabel="distance to the path [mm]", xlabel="time [s]")
    session.save_plot(fig, "residual")

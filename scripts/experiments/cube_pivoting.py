"""Two fingers tip a cube over an edge, by 90 degrees, in a plane.

C3+ plans which finger pushes, presses or lets go; the reference only gives the cube's
rate of turn and the faces beside which the fingers should be. The seed draws the start
of cube and fingers, and the friction of all pairs.

Criterion, set beforehand: over the last half second the angle is within 0.1 rad of 90
degrees, the cube is at rest on the platform, and its place is within 2 cm of where pure
pivoting leads from its place at the start; and in the whole run no two bodies press on
each other with more than 40 N. (The two corners on the platform count as one.)
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, Polygon

from makebreak.diagrams.cube_pivoting import (
    TOUCHES,
    logged_forces,
    make_cube_pivoting,
    start,
)
from makebreak.diagrams.cube_pivoting_config import (
    CubePivotingConfig,
    initial_state,
    model_cube,
    scene_with,
    world_cube,
)
from makebreak.diagrams.recorder import recorded, with_noise
from makebreak.scripts.runner.comparison import Comparison
from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.session import Log, Session
from makebreak.scripts.runner.sweep import rate_text
from makebreak.scripts.runner.table import Table
from makebreak.systems.contact_mpc.c3_mpc import C3Status
from makebreak.systems.contact_mpc.numerics.pivot_target import (
    LEFT,
    N_X,
    RIGHT,
    THETA,
    corners,
)
from makebreak.systems.contact_mpc.pivot_target import PivotTargetConfig

SUMMARY = "two fingers tip a cube by 90 degrees; C3+ plans the contacts"
Config = CubePivotingConfig

DURATION, SAMPLE = 6.0, 0.02  # [s]
GOAL = PivotTargetConfig().goal  # [rad]
LAST = 0.5  # Time at the end over which the criteria hold [s].
ANGLE_BOUND, PLACE_BOUND = 0.1, 0.02  # [rad], [m]
SPEED_BOUND, TURN_BOUND = 0.02, 0.2  # Of a cube at rest [m/s], [rad/s].
FORCE_BOUND = 40.0  # [N]
LOST = 0.4  # x of the platform's end [m].
# The bodies whose residual is reported: fingers on the cube, corners on the platform.
RESIDUALS = ("left", "right", "corners")


def run(config: CubePivotingConfig, session: Session) -> dict:
    """Runs one start; see the module for the criterion."""
    x0 = initial_state(config)
    diagram = make_cube_pivoting(config, session.meshcat)
    log = session.simulate(
        diagram,
        DURATION,
        {
            name: diagram.GetOutputPort(name)
            for name in ("x", "u", "c3_status", "r_comp")
        },
        period_sec=SAMPLE,
        until=lambda t, values: (
            "the cube has left the platform" if abs(values["x"][0]) > LOST else ""
        ),
        context=start(diagram, x0),
    )
    time, force = logged_forces(diagram, log.context)
    side = world_cube(config).side
    result = score(log, time, force, side)
    result["friction"] = world_cube(config).friction
    gap = config.planner.period_sec * log["r_comp"][:, ::2]  # [m]
    for i, name in enumerate(RESIDUALS):
        result[f"residual_{name}_m"] = float(gap[-1, i])
    session.save_plot(
        plot_run(log, time, force, gap if config.adapt else None), "pivot"
    )
    session.save_plot(plot_motion(log, side), "motion")
    columns = with_noise(recorded(diagram, log.context), config.seed)
    session.write_recording(columns, scene_with(config.world, model_cube(config)))
    return result


def score(log: Log, time, force, side: float) -> dict:
    """The criteria and the other results of a run.

    Args: time (n,) [s], force (n, 6) [N] from logged_forces; side of the cube [m].
    """
    x = log["x"]
    last = x[log.time >= log.time[-1] - LAST]
    error = abs(x[:, THETA] - GOAL)
    place = last[:, 0] - (standing_place(x[0], side) + side)
    speed = np.hypot(last[:, N_X // 2], last[:, N_X // 2 + 1])
    rest = bool(
        speed.max() <= SPEED_BOUND
        and abs(last[:, N_X // 2 + THETA]).max() <= TURN_BOUND
    )
    peak = force.max(axis=0)
    result = {
        "success": False,
        "angle_error_rad": float(error[-len(last) :].max()),
        "place_error_m": float(abs(place).max()),
        "time_to_goal_s": time_to_stay(log.time, error, ANGLE_BOUND),
        "force_max_N": float(peak.max()),
        "finger_force_max_N": float(peak[:2].max()),
        "platform_force_max_N": float(peak[2]),
        "plans_failed": int((log["c3_status"][1:] != C3Status.SOLVED).sum()),
        "u_max_N": float(abs(log["u"]).max()),
    }
    criteria = Criteria()
    end = f"in the last {LAST} s"
    criteria.at_most(
        "angle", f"distance to 90 degrees {end}", result["angle_error_rad"],
        ANGLE_BOUND, "rad",
    )  # fmt: skip
    criteria.at_most(
        "place", f"distance to where it should stand {end}", result["place_error_m"],
        PLACE_BOUND, "m",
    )  # fmt: skip
    criteria.holds("rest", f"at rest {end}", rest)
    criteria.at_most(
        "force", "largest force between two bodies", result["force_max_N"],
        FORCE_BOUND, "N",
    )  # fmt: skip
    return result | criteria.result()


def standing_place(x, side: float) -> float:
    """x of a tilted cube's centre after it has fallen back on its face [m]."""
    lowest = corners(x, side)[:2]
    pivot = int(np.argmin(lowest[:, 1]))  # Lower left or lower right.
    return float(lowest[pivot, 0] + (0.5 - pivot) * side)


def time_to_stay(time, error, bound) -> float | None:
    """The time from which error (n,) stays below bound [s]; None if it ends above."""
    above = np.flatnonzero(error > bound)
    if above.size == 0:
        return float(time[0])
    return float(time[above[-1] + 1]) if above[-1] + 1 < len(time) else None


def plot_run(log: Log, time, force, gap=None):
    """Angle, inputs and forces over time, and the learned gaps (n, 3 or more) [m]."""
    rows = 3 if gap is None else 4
    figure, axes = plt.subplots(
        rows, 1, figsize=(8, 2.7 * rows), sharex=True, layout="constrained"
    )
    axes[0].plot(log.time, np.degrees(log["x"][:, THETA]))
    axes[0].axhline(np.degrees(GOAL), color="0.5", ls=":")
    axes[0].set(ylabel="cube [degrees]")
    for i, name in enumerate(("left x", "left z", "right x", "right z")):
        axes[1].step(log.time, log["u"][:, i], where="post", label=name)
    axes[1].set(ylabel="asked of the fingers [N]")
    names = [
        f"{other.split('.')[1] if i else other.split('.')[0]} ~ {first.split('.')[1]}"
        for i, (first, others) in enumerate(TOUCHES)
        for other in others
    ]
    for i, name in enumerate(names):
        if force[:, i].any():
            axes[2].plot(time, force[:, i], label=name)
    axes[2].axhline(FORCE_BOUND, color="0.5", ls=":")
    axes[2].set(ylabel="force [N]")
    if gap is not None:
        for i, name in enumerate(RESIDUALS):
            axes[3].plot(log.time, 1e3 * gap[:, i], label=name)
        axes[3].set(ylabel="learned gap [mm]")
    axes[-1].set(xlabel="time [s]")
    for ax in axes[1:]:
        ax.legend()
    return figure


def plot_motion(log: Log, side: float):
    """Cube and fingers at several instants."""
    n = 8
    end = time_to_stay(log.time, abs(log["x"][:, THETA] - GOAL), 0.01)
    instants = np.linspace(0.0, log.time[-1] if end is None else end, n)
    figure, axes = plt.subplots(
        2, n // 2, figsize=(12, 5), sharex=True, sharey=True, layout="constrained"
    )
    radius = PivotTargetConfig().finger_radius
    for ax, t in zip(axes.flat, instants, strict=True):
        x = log["x"][np.searchsorted(log.time, t - 1e-9)]
        outline = corners(x, side)
        ax.add_patch(Polygon(outline, fc="#dd8452", ec="0.2"))
        ax.plot(*outline[2:].T, color="0.1", lw=3)  # The face that was on top.
        for finger, color in ((LEFT, "C0"), (RIGHT, "C2")):
            ax.add_patch(Circle(tuple(x[finger]), radius, fc=color))
        ax.axhline(0.0, color="0.3")
        ax.set(title=f"{t:.2f} s", aspect=1, ylim=(-0.02, 2.2 * side))
    for ax in axes[1]:
        ax.set_xlabel("x [m]")
    for ax in axes[:, 0]:
        ax.set_ylabel("z [m]")
    middle = np.median(log["x"][:, 0])
    axes[0, 0].set_xlim(middle - 2.3 * side, middle + 2.3 * side)
    return figure


def _variants() -> dict[str, dict]:
    """{name: settings} of the runs that are compared."""
    found: dict[str, dict] = {
        "as it is": {},
        "adapting": {"adapt": True},
        "QP projection in place of C3+": {"planner.projection": "qp"},
        "polished with 3 rollouts, not 10": {"planner.options.polish": 3},
        "not polished": {"planner.options.polish": 0},
        "an LCS for each knot along the plan": {"planner.lcs_along_plan": True},
        "6 knots": {"planner.options.N": 6},
        "15 knots": {"planner.options.N": 15},
        "twice as heavy": {"mass": 0.8},
        "half as heavy": {"mass": 0.2},
        "0.8 of the size": {"size": 0.8},
        "friction 0.3": {"start.friction": [0.3, 0.3]},
    }
    for what, settings in {
        "10 % too small": {"model.size_error": 0.9},
        "10 % too large": {"model.size_error": 1.1},
        "half as heavy": {"model.mass_error": 0.5},
        "twice as heavy": {"model.mass_error": 2.0},
        "with half the friction": {"model.friction_error": 0.5},
        "with twice the friction": {"model.friction_error": 2.0},
    }.items():
        found[f"modelled {what}"] = settings
        found[f"modelled {what}, adapting"] = {**settings, "adapt": True}
    return found


VARIANTS = _variants()


def reproduce(session: Session, seeds: int, jobs: int) -> Table:
    """Number of starts that succeed, as configured and with each variant."""
    comparison = Comparison("cube_pivoting", session, jobs)
    for what, results in comparison.runs_of(VARIANTS, seeds).items():
        settings = VARIANTS[what]
        count = sum(bool(r.get("success")) for r in results)
        times = [r["time_to_goal_s"] for r in results if r.get("success")]
        forces = [r["force_max_N"] for r in results if "force_max_N" in r]
        text = rate_text(count, len(results))
        if times:
            text += f"; {np.median(times):.1f} s"
        if forces:
            text += f"; at most {max(forces):.0f} N"
        good = None if settings else count == len(results)
        comparison.row(what, "-", text, good, comparison.with_settings(settings))
    return comparison.to_table(
        "A cube tipped by 90 degrees: starts that succeed, median time, largest force"
    )

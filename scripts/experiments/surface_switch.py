"""Surfaces that change under the tool, anticipated: CC 4.5.2, figures 19 and 20.

Down on a table, along it to a wall, along the wall, back to a stop. In the second and
in the fourth segment the surface changes, to more friction and to less. The contacts
are known to 3 cm at first, the surfaces not at all. In the second trial the places of
both seams are expected, and what begins there; in the third they are known better.

In the region of an expected seam the arm is as stiff as it may be. That alone does not
take the spikes away, for it is the old model's feed-forward that causes them: at the
place itself the model of the mode that begins there takes over. `anticipation` leaves
out the one (models=false) or both (places=false), for comparison.

Velocity spike: the most by which the tip's velocity along the motion differs from the
desired one while the tool crosses the seam, 30 Hz. Peak error: of the tip's position,
in the surface. a10 as in numerics/impact_score.py. All from 20 mm before the first
foot is across to 20 mm after the last one.

Criterion, set beforehand. A run is a success if every trial comes to its end, each seam
is recognised in every trial, in trial 2 the velocity spike and the peak error of the
two seams (the larger of both) are at most half of trial 1's, and in trial 3 the region
and the time in the transition controller are smaller than in trial 2.

See docs/modes.md.
"""

from dataclasses import dataclass, replace

import matplotlib.pyplot as plt
import numpy as np

from makebreak.diagrams.changing_contact import Knowledge, learned, telemetry
from makebreak.diagrams.recorder import episodes, recorded
from makebreak.diagrams.surface_switch import (
    CROSSINGS,
    SEAM_Y,
    SurfaceSwitchConfig,
    SwitchTask,
    make_surface_switch,
    make_task,
)
from makebreak.scripts.experiments.runs.contact_runs import rehearsed, simulate_motion
from makebreak.scripts.runner.comparison import Comparison
from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.table import Table
from makebreak.systems.changing_contact.numerics.contact_task import (
    CHANGE_TIME,
    COUNT,
    DONE,
    ENTER,
    IMPACTLESS,
    PHASE_KIND,
    PHASE_SEGMENT,
    PHASE_STAGE,
    REGION,
    SETTLE,
)
from makebreak.systems.changing_contact.numerics.impact_score import low_pass

SUMMARY = "a block meets a change of surface, later expects it (CC fig. 19, 20)"
Config = SurfaceSwitchConfig

DURATION_SEC = 120.0  # Of a trial, at most.
MARGIN = 0.02  # [m]
VELOCITY_CUTOFF, ACCELERATION_CUTOFF = 30.0, 10.0  # [Hz]
SHARE = 0.5  # Of trial 1's spike and error, in trial 2.
MATCH_SEC = 0.3  # A change reported so near to the first foot's crossing is its.
N = len(CROSSINGS)


@dataclass(frozen=True, eq=False)
class SwitchTrial:
    """One trial's log and its scores, (2,) for the two seams; nan: not reached."""

    log: dict[str, np.ndarray]
    done: bool
    rows: list[np.ndarray]  # Of the log, for each seam.
    spike: np.ndarray  # [m/s]
    error: np.ndarray  # [m]
    a10: np.ndarray  # [m/s2]
    place_error: np.ndarray  # Of the reported change, along the motion [m].
    region: np.ndarray  # Length gone inside the region [m],
    handling: np.ndarray  # and time in the transition controller [s].
    stiff: np.ndarray  # Mean stiffness in the window [N/m].


def run(config: SurfaceSwitchConfig, session: Session) -> dict:
    """config.trials trials in a row, scored; see the module for the criterion."""
    task = make_task(config)
    knowledge = Knowledge(contacts=task.prior)

    def simulate(knowledge, k, label, config=config, task=task):
        diagram = make_surface_switch(config, task, knowledge, k, session.meshcat)
        return simulate_motion(session, diagram, DURATION_SEC, label)

    knowledge = rehearsed(config, task, simulate, knowledge)
    trials: list[SwitchTrial] = []
    recordings = []
    for k in range(config.trials):
        log = simulate(knowledge, k, f"trial_{k + 1}")
        knowledge = learned(log.diagram, log.context)
        recordings.append(recorded(log.diagram, log.context))
        trial = scored(telemetry(log.diagram, log.context), task.feet)
        # The telemetry's last row is from before the events of its instant.
        done = log["phase"][-1, PHASE_STAGE] == DONE
        trials.append(replace(trial, done=bool(done)))
    session.save_plot(plot_trials(trials, task), "trials")
    knowledge.contacts.save(session.path("contacts.json"))
    session.write_recording(episodes(recordings), task.model)
    return summary(trials, task)


def sign_of(segment: int) -> float:
    """Of the motion along y in a segment that crosses the seam."""
    return 1.0 if segment == CROSSINGS[0] else -1.0


def scored(log: dict[str, np.ndarray], feet: float) -> SwitchTrial:
    """A trial, from its log and the truth."""
    time, stage = log["time"], log["phase"][:, PHASE_STAGE]
    segment, kind = log["phase"][:, PHASE_SEGMENT], log["phase"][:, PHASE_KIND]
    dt = time[1] - time[0]
    y = log["ee_pose"][:, 1] - SEAM_Y
    v = log["ee_velocity"][:, :3]
    off = low_pass(v[:, 1] - log["x_desired"][:, 8], VELOCITY_CUTOFF, dt)
    a = low_pass(np.gradient(v, dt, axis=0), ACCELERATION_CUTOFF, dt)
    away = np.linalg.norm(log["x_desired"][:, :2] - log["ee_pose"][:, :2], axis=1)
    handling = (kind == IMPACTLESS) & np.isin(stage, (ENTER, REGION, SETTLE))
    inside = (kind == IMPACTLESS) & (stage == REGION)
    transition = log["transition"]
    events = np.flatnonzero(np.diff(transition[:, COUNT]) > 0) + 1
    names = "spike error a10 place_error region handling stiff".split()
    values = {name: np.full(N, np.nan) for name in names}
    windows = []
    for i, number in enumerate(CROSSINGS):
        sign = sign_of(number)
        here = segment == number
        rows = np.flatnonzero(here & (abs(y) < feet + MARGIN))
        windows.append(rows)
        crossed = np.flatnonzero(here & (sign * y > -feet))
        if not rows.size or not crossed.size:
            continue
        values["spike"][i] = abs(off[rows]).max()
        values["error"][i] = away[rows].max()
        values["a10"][i] = np.linalg.norm(a[rows], axis=1).max()
        values["region"][i] = abs(v[here & inside, 1]).sum() * dt
        values["handling"][i] = (here & handling).sum() * dt
        values["stiff"][i] = log["stiffness"][rows, 0].mean()
        first = time[crossed[0]]
        mine = [
            e for e in events if abs(transition[e, CHANGE_TIME] - first) < MATCH_SEC
        ]
        if len(mine) == 1:
            at = time.searchsorted(transition[mine[0], CHANGE_TIME])
            values["place_error"][i] = sign * y[min(at, len(y) - 1)] + feet
    return SwitchTrial(
        log=log, done=bool((stage == DONE).any()), rows=windows, **values
    )


def summary(trials: list[SwitchTrial], task: SwitchTask) -> dict:
    """result.json: one list per trial, for each seam."""
    result: dict = {"success": False, "friction": task.friction.tolist()}
    for key, name in (
        ("velocity_spike_mps", "spike"),
        ("tracking_error_max_m", "error"),
        ("acceleration_a10_peak_mps2", "a10"),
        ("place_error_m", "place_error"),
        ("region_length_m", "region"),
        ("transition_time_s", "handling"),
        ("stiffness_mean_Npm", "stiff"),
    ):
        for i in range(N):
            result[f"{key}_seam_{i + 1}"] = [float(getattr(t, name)[i]) for t in trials]
    criteria = Criteria()
    criteria.holds("done", "every trial is carried out", all(t.done for t in trials))
    seen = sum(int(np.isfinite(t.place_error).sum()) for t in trials)
    criteria.at_least("recognised", "changes recognised once", seen, N * len(trials))
    if len(trials) >= 2:
        one, two = trials[:2]
        for name in ("spike", "error"):
            share = getattr(two, name).max() / getattr(one, name).max()
            result[f"{name}_share_of_trial_1"] = float(share)
            what = "velocity spike" if name == "spike" else "tracking error"
            what += ", greatest: trial 2 over trial 1"
            criteria.at_most(name, what, float(share), SHARE)
    if len(trials) >= 3:
        for name in ("region", "handling"):
            before, after = (getattr(t, name).sum() for t in trials[1:3])
            what = "length of the region" if name == "region" else "time of handling"
            what += " in trial 3"
            criteria.holds(
                f"smaller_{name}", what, after < before, after, f"below {before:.4g}"
            )
    return result | criteria.result()


def plot_trials(trials: list[SwitchTrial], task: SwitchTask):
    """Figures 19 and 20: velocity, acceleration and force at both seams."""
    figure, axes = plt.subplots(
        4, N * len(trials), figsize=(4.2 * N * len(trials), 9.5), sharey="row",
        squeeze=False, layout="constrained",
    )  # fmt: skip
    for k, trial in enumerate(trials):
        log = trial.log
        dt = log["time"][1] - log["time"][0]
        v = log["ee_velocity"][:, :3]
        a = low_pass(np.gradient(v, dt, axis=0), ACCELERATION_CUTOFF, dt)
        velocity = low_pass(v, VELOCITY_CUTOFF, dt)
        for i, number in enumerate(CROSSINGS):
            ax, rows = axes[:, N * k + i], trial.rows[i]
            ax[0].set_title(f"trial {k + 1}, segment {number + 1}")
            if not rows.size:
                continue
            sign = sign_of(number)
            x = 1e3 * sign * (log["ee_pose"][rows, 1] - SEAM_Y)
            ax[0].plot(x, 1e3 * sign * velocity[rows, 1], label="tip")
            ax[0].plot(x, 1e3 * sign * log["x_desired"][rows, 8], ":", color="0.3",
                       label="desired")  # fmt: skip
            ax[1].plot(x, sign * a[rows, 1])
            felt = -sign * log["wrench"][rows, 1]
            fed = sign * log["wrench_feedforward"][rows, 1]
            ax[2].plot(x, felt, lw=0.5, color="0.6", label="felt")
            ax[2].plot(x, fed, color="C1", label="fed forward")
            away = (log["x_desired"][rows, 1] - log["ee_pose"][rows, 1]) * sign
            ax[3].plot(x, 1e3 * away)
            stiff = ax[3].twinx()
            stiff.plot(x, log["stiffness"][rows, 0], color="C3", lw=0.8)
            stiff.set(ylim=(0, 2200), yticks=[0, 1000])
            region = (log["phase"][rows, PHASE_STAGE] == REGION) & (
                log["phase"][rows, PHASE_KIND] == IMPACTLESS
            )
            for one in ax:
                one.fill_between(
                    x, 0, 1, where=region, color="C2", alpha=0.15, lw=0,
                    transform=one.get_xaxis_transform(),
                )  # fmt: skip
                for foot in {-task.feet, task.feet}:
                    one.axvline(1e3 * foot, color="0.5", lw=0.7, ls="--")
            ax[3].set_xlabel("tip, from the seam [mm]")
    for row, label in enumerate((
        "velocity, 30 Hz [mm/s]",
        "acceleration, 10 Hz [m/s2]",
        "force along the motion [N]",
        "error [mm]; red: stiffness [N/m]",
    )):  # fmt: skip
        axes[row, 0].set_ylabel(label)
    axes[0, 0].legend(fontsize=8)
    axes[2, 0].legend(fontsize=8)
    mu = task.friction
    figure.suptitle(
        f"friction {mu[0]:.2f} -> {mu[1]:.2f} (left of each pair) and back; dashed: a "
        "row of feet is across; green: region of anticipated change"
    )
    return figure


VARIANTS: dict[str, dict] = {
    "K_max alone": {"anticipation.models": False},
    "nothing anticipated": {"anticipation.places": False},
    "sphere": {"tool": "sphere"},
    "one model for all modes": {"control.forward_model.per_mode": False},
}


def reproduce(session: Session, seeds: int, jobs: int) -> Table:
    """Figures 19 and 20 beside ours, over seeds; less anticipation; another tool."""
    comparison = Comparison("surface_switch", session, jobs)
    row = comparison.row

    def many(settings, n):
        results = comparison.runs(settings, n)
        return results, [r for r in results if "met_done" in r]

    def of(key, runs):
        """(runs, seams, trials)."""
        return np.array(
            [[r[f"{key}_seam_{i + 1}"] for i in range(N)] for r in runs], dtype=float
        )

    def means(values, scale, unit, digits=1):
        texts = [f"{scale * x:.{digits}f}" for x in np.nanmean(values, axis=0)]
        return " / ".join(texts) + f" {unit}"

    main, ended = many({}, seeds)
    if not ended:
        raise RuntimeError(f"no run ended: {main[0].get('error')}")
    n_seams = sum(len(r["place_error_m_seam_1"]) * N for r in ended)
    place = of("place_error_m", ended)
    found = int(np.isfinite(place).sum())
    row(
        "seams recognised",
        "both, in three trials",
        f"{found} of {n_seams}",
        found == n_seams and len(ended) == len(main),
    )
    row(
        "place of the change, most off",
        "-",
        f"{1e3 * np.nanmax(abs(place)):.1f} mm",
    )
    for i, label in enumerate(("to more friction", "to less")):
        for key, what, scale, unit, digits in (
            ("velocity_spike_mps", "velocity spike", 1e3, "mm/s", 1),
            ("tracking_error_max_m", "peak error", 1e3, "mm", 2),
            ("acceleration_a10_peak_mps2", "a10", 1.0, "m/s2", 2),
        ):
            text = means(of(key, ended)[:, i], scale, unit, digits)
            row(f"fig. 19, 20: {what} {label}, trial 1 / 2 / 3", "falls", text)
    for name_, what in (("spike", "velocity spike"), ("error", "peak error")):
        share = np.array([r[f"{name_}_share_of_trial_1"] for r in ended])
        row(
            f"{what} of trial 2, share of trial 1's (larger of both seams)",
            "smaller",
            f"{100 * share.mean():.0f} % (most {100 * share.max():.0f} %)",
            bool(np.all(share <= SHARE)),
        )
    for key, what, scale, unit, digits in (
        ("region_length_m", "region", 1e3, "mm", 1),
        ("transition_time_s", "time in the transition controller", 1.0, "s", 3),
    ):
        values = of(key, ended).sum(axis=1) / N
        row(
            f"fig. 20: {what} per seam, trial 1 / 2 / 3",
            "smaller in trial 3",
            means(values, scale, unit, digits),
            bool(np.all(values[:, 2] < values[:, 1])),
        )
    for label, settings in VARIANTS.items():
        _, runs = many(settings, max(1, seeds // 2))
        its = comparison.with_settings(settings)
        if not runs:
            row(label, "-", "no run ended", False, command=its)
            continue
        for key, what, scale, unit, digits in (
            ("velocity_spike_mps", "velocity spike", 1e3, "mm/s", 1),
            ("tracking_error_max_m", "peak error", 1e3, "mm", 2),
        ):
            values = of(key, runs).max(axis=1)
            row(
                f"{label}: {what}, trial 1 / 2 / 3",
                "-",
                means(values, scale, unit, digits),
                command=its,
            )
    return comparison.to_table(
        "Surfaces that change, anticipated (CC 4.5.2, figures 19 and 20)",
        [
            "The paper shows one run on a robot, as pictures. Its trial 1 has K_free "
            "until a change is felt, as ours.",
        ],
    )

"""`makebreak reproduce wall_friction`: figures 11 to 14 of CC, and ours."""

import json
from pathlib import Path

import numpy as np

from makebreak.diagrams.wall_friction import WallFrictionConfig
from makebreak.scripts.experiments.papers.wall_friction_score import (
    EACH_FILE,
    FED,
    ONE_STEP,
    SETS,
    TIMES_FILE,
    without_noise,
)
from makebreak.scripts.runner.comparison import Comparison
from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.table import Table

# As many training trials as in the paper; no joints, which take most of the time.
IN_LOOP = {"training.trials": 40, "training.tested": 5, "training.joints": False}


def reproduce(session: Session, seeds: int, jobs: int) -> Table:
    """Figures 11 to 14 beside ours; each seed has its own training."""
    comparison = Comparison("wall_friction", session, jobs)
    row, results = comparison.row, comparison.runs({}, seeds)
    done = [r for r in results if "error" not in r]

    def mean(key):
        return float(np.mean([r[key] for r in done])) if done else float("nan")

    def error(key):
        values = [r[key] for r in done]
        if not values:
            return "-"
        return f"{np.mean(values):.3f} N ({min(values):.3f} to {max(values):.3f})"

    def joint(name):
        # Now and then a prediction diverges: a mean would show nothing else.
        errors = [1e3 * r[f"joint_{name}_rmse_rad"] for r in done]
        bands = [1e3 * r[f"joint_{name}_band_rad"] for r in done]
        if not done:
            return "-"
        return (
            f"{np.median(errors):.1f} mrad rms ({min(errors):.1f} to "
            f"{max(errors):.1f}), band {np.median(bands):.1f}, "
            f"{100 * mean(f'joint_{name}_in_band'):.0f} % in it"
        )

    row("fig. 11a: joint 1, learned at 0.6", "true one lags", joint("same"))
    row("fig. 11b: learned at 0.1 to 0.7", "the same, wider band", joint("varied"))
    row("fig. 12: the same, stiff", "narrow band, better", joint("stiff"))
    ahead = f"{error('task_long_rmse_N')}, {100 * mean('task_long_in_band'):.0f} % in"
    row("fig. 13: force, from the start", "not in the band", ahead + " band")
    row("fig. 14a: one step, next force", "not accurate", error("one_step_rmse_N"))
    row("one step, change of force", "-", error("one_step_change_rmse_N"))
    row("the last force, unchanged", "-", error("persistence_rmse_N"))

    def below(key):
        variants = [f"{name}_rmse_N" for name in (*ONE_STEP, "task_long")]
        wins = sum(r[key] < min(r[v] for v in variants) for r in done)
        return f"{error(key)}; below all: {wins} of {len(results)}", (
            bool(results) and wins == len(results)
        )

    row("fig. 14b: our forward models", "reliable", *below("ours_rmse_N"))
    row("the same, from nothing", "-", *below("ours_from_scratch_rmse_N"))
    seconds, online = times(done)
    joints = [seconds.get(f"joint_{name}_training_s", np.nan) for name in SETS]
    row("training, joint space", "55 min, 40 trials", f"{np.mean(joints):.0f} s")
    row(
        "training, one step", "-", f"{seconds.get('one_step_training_s', np.nan):.0f} s"
    )
    joints = [seconds.get(f"joint_{name}_prediction_s", np.nan) for name in SETS]
    row("prediction of a trial, joints", "20 min", f"{np.mean(joints):.1f} s")
    for name, label in (
        ("forward_model_bank", "our learning and prediction, a sample"),
        ("mode_detector", "our mode detection, a sample"),
        ("predictor_one_step", "the baseline's prediction, a sample"),
    ):
        row(label, "-", f"{online.get(name, np.nan):.2f} ms")
    _loop_rows(comparison, comparison.runs(IN_LOOP, seeds))
    training = WallFrictionConfig().training
    return comparison.to_table(
        "A wall of unknown friction (CC 4.4)",
        [
            "Errors along the wall, rms, mean (joints: median) over seeds (least to "
            "greatest); the sensor's noise alone is 0.1 N. Band: two standard "
            "deviations.",
            "The baseline's GPs are given "
            f"{training.one_step.points_per_mode} points per mode of "
            f"{training.trials} trials; the paper's 55 min are for all points "
            "of 40 trials.",
        ],
    )


def _loop_rows(comparison: Comparison, results) -> None:
    """What predictions that are fed forward do to the tracking error, over the tested
    trials of all runs, beside their errors, with the sensor's noise and without."""
    each: dict[str, list[float]] = {}
    for result in results:
        if "error" not in result:
            path = Path(result["out_dir"]) / EACH_FILE
            for key, values in json.loads(path.read_text()).items():
                each.setdefault(key, []).extend(values)
    its = comparison.with_settings(IN_LOOP)
    n = len(each.get("tracking_error_none_m", []))
    for label, what in FED.items():
        x = 1e3 * np.array(each.get(f"tracking_error_{label}_m", [np.nan]))
        text = f"{np.mean(x):.2f} mm ({np.min(x):.2f} to {np.max(x):.2f})"
        if label != "none":
            error = float(np.mean(each.get(f"{label}_fed_rmse_N", [np.nan])))
            text += f"; predicts to {error:.3f} N, {without_noise(error):.3f} N of it "
            text += "not the sensor's noise"
        row = f"fed forward: {what}; tracking error, {n} trials"
        comparison.row(row, "-", text, None, its)


def times(results) -> tuple[dict, dict]:
    """Means over runs: seconds of training and prediction; ms per sample, p50."""
    seconds: dict[str, list[float]] = {}
    online: dict[str, list[float]] = {}
    for result in results:
        folder = Path(result["out_dir"])
        for key, value in json.loads((folder / TIMES_FILE).read_text()).items():
            seconds.setdefault(key, []).append(value)
        timing = json.loads((folder / "timing.json").read_text())
        for key, value in timing["simulations"]["ours"]["systems"].items():
            online.setdefault(key, []).append(value["p50_ms"])
    return (
        {key: float(np.mean(values)) for key, values in seconds.items()},
        {key: float(np.mean(values)) for key, values in online.items()},
    )

"""A block along a wall of unknown friction: CC 4.4, figures 11 to 14.

A Panda presses a block on a table (friction 0.3) and slides it to a wall and along it,
under an impedance controller of constant stiffness. The baseline (Khader et al. 2020)
learns offline, from three sets of trials: wall friction 0.6; 0.1 to 0.7; 0.1 to 0.7
with a stiff controller. Everything is tested at friction 0.9. It predicts the joints
over the whole trial (figures 11, 12), the force over the whole trial (13), and the
force one sample of 5 ms ahead with feedback (14a), by GPs of the next force, as in CC,
and of its change. Our mode detector and forward models (14b) see the same samples; they
too have been through the trials of 0.1 to 0.7, one after the other, and learn on; once
more they start with nothing.

Scores are over the way along the wall, the motion's 3 s: along y, the rms error [N]
against the measured force of that sample, with its noise of 0.1 N, below which nobody
can be; and the share of samples in the predicted band of two standard deviations.

Criterion, set beforehand: our one-step error, with and without earlier trials, is below
that of every variant of the baseline.

Ours: everything that figure 1b does not show; docs/wall_friction.md says it all.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import matplotlib.pyplot as plt
import numpy as np
from pydrake.systems.analysis import Simulator

from makebreak.diagrams.recorder import recorded
from makebreak.diagrams.tabletop import TABLETOP_WALLS
from makebreak.diagrams.wall_friction import (
    DURATION,
    LAST,
    OURS,
    TIMES,
    WallFrictionConfig,
    learned,
    make_wall_friction,
    plan_of,
    policy,
    telemetry,
    tip_states,
)
from makebreak.diagrams.wiring import refuse_unused
from makebreak.models.scene import read_scene
from makebreak.scripts.comparison import Comparison
from makebreak.scripts.criteria import Criteria
from makebreak.scripts.session import Session
from makebreak.scripts.table import Table
from makebreak.systems.baselines.numerics.long_term_predictor import (
    LongTermPredictor,
    Prediction,
    TrainingTrial,
    known,
    predict_long_term,
    train,
)

SUMMARY = "a block slides along a wall: forward models and a GP baseline (CC 4.4)"
Config = WallFrictionConfig
# As little training as is accepted: what is timed is the trial.
BENCH = {
    "wall_friction": {
        "training.trials": 7,
        "training.every": 40,
        "training.one_step.points_per_mode": 20,
        "training.long_term.points_per_mode": 20,
    }
}

BENCH_SEC = DURATION  # The plan's, of which all predictions are.

VARIED = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]
# name -> frictions of the wall, stiff controller, figure.
SETS = {
    "same": ([0.6], False, "11a"),
    "varied": (VARIED, False, "11b"),
    "stiff": (VARIED, True, "12"),
}
# One step ahead: name -> whether the GPs' output is the change of force.
ONE_STEP = {"one_step": False, "one_step_change": True}
FORCE_INPUTS = range(6)  # F and velocity; the position is for the SVM.
Y = 1  # The axis along the wall.
TIMES_FILE = "training_times.json"
EACH_FILE = "tested_trials.json"  # Scores of each tested trial; the result has means.
NOISE = 0.1  # Of the force sensor [N].
# As many training trials as in the paper; no joints, which take most of the time.
IN_LOOP = {"training.trials": 40, "training.tested": 5, "training.joints": False}
FED = {
    "none": "nothing",
    "last": "the last force",
    "one_step": "GP of the next force",
    "one_step_change": "GP of its change",
    "ours": "our forward models",
    "ours_from_scratch": "ours, from nothing",
}
CONTACT_FORCE = 3.0  # [N] of the wall, by which pictures mark the contact.


def run(config: WallFrictionConfig, session: Session) -> dict:
    """Trains, predicts, scores; see the module."""
    make_wall_friction(config)  # Bad settings are refused at once.
    if config.training.trials < len(VARIED):
        raise ValueError(
            f"training.trials is {config.training.trials}, expected {len(VARIED)} or "
            "more: one of each friction"
        )
    if config.training.every < 1:
        raise ValueError(
            f"training.every is {config.training.every}, expected 1 or more"
        )
    if session.duration_sec not in (None, DURATION):
        raise ValueError(
            f"--duration: got {session.duration_sec:g}, but a trial takes {DURATION:g} "
            "s, for which everything is predicted"
        )
    if config.training.tested < 1:
        raise ValueError(f"training.tested is {config.training.tested}, expected > 0")
    _refuse_unused(config)
    if config.station_seed is None:  # All trials have the same station.
        config = replace(config, station_seed=config.seed)
    seconds: dict[str, float] = {}  # Not of the result: they differ from run to run.
    trials, knowledge = collect(config, seconds)
    predictors = one_step_predictors(config, trials["varied"], seconds)
    result: dict = {"success": False}
    each: dict[str, list[float]] = {}  # Scores of each tested trial.
    for i in range(config.training.tested):
        tested = replace(config, seed=config.seed * config.training.tested + i)
        logs = one_step_ahead(tested, session, predictors, knowledge, i, each)
        in_the_loop(tested, predictors, knowledge, logs[0], each)
        if i == 0:
            data, scratch, recording = logs
            force = force_from_the_start(tested, trials["varied"], data, seconds, each)
            if config.training.joints:
                joints = joints_from_the_start(tested, trials, data, seconds, result)
                session.save_plot(plot_joints(joints), "joint_prediction")
    result |= {key: float(np.mean(values)) for key, values in each.items()}
    ours = [result["ours_rmse_N"], result["ours_from_scratch_rmse_N"]]
    best = min(result[f"{name}_rmse_N"] for name in (*ONE_STEP, "task_long"))
    result["ours_to_best_baseline"] = ours[0] / best
    criteria = Criteria()
    for key, what, value in (
        ("ours", "our models", ours[0]),
        ("from_scratch", "our models, beginning with nothing", ours[1]),
    ):
        criteria.holds(
            key, f"prediction error of {what}, rms [N]", value < best, value,
            f"below {best:.4g}, the best baseline's",
        )  # fmt: skip
    result |= criteria.result()
    session.write_json(TIMES_FILE, seconds)
    session.write_json(EACH_FILE, each)
    session.save_plot(plot_forces(data, scratch, force), "force_prediction")
    session.write_recording(recording, read_scene(TABLETOP_WALLS))
    return result


def _refuse_unused(config: WallFrictionConfig) -> None:
    """Raises: ValueError for settings that nothing reads."""
    plain = WallFrictionConfig()
    unused = {"training.one_step.predict_change": "both are trained"}
    if not config.training.joints:
        unused["stiffness_high"] = "not used with training.joints=false"
    if config.realism == "none":
        unused["station_seed"] = "not used with realism=none"
    for name, why in unused.items():
        refuse_unused(config, plain, name, why)


def one_step_predictors(config, trials, seconds) -> dict:
    """The one-step baselines, trained: {name of ONE_STEP: LongTermPredictor}."""
    measured = [force_trial(data) for _, data in trials]
    predictors = {}
    for name, change in ONE_STEP.items():
        budget = replace(config.training.one_step, predict_change=change)
        start = perf_counter()
        predictors[name], _ = train(measured, budget, FORCE_INPUTS)
        seconds[f"{name}_training_s"] = perf_counter() - start
    return predictors


def one_step_ahead(config, session, predictors, knowledge, number, each):
    """Figure 14: simulates the `number`th tested trial with all predictors watching,
    and scores them. Nothing is fed forward.

    Returns: its log, that of the same trial where our models begin with nothing, and
        what is recorded.
    """
    logs = []
    for label, known_before in (("ours", knowledge), ("ours_from_scratch", None)):
        diagram = make_wall_friction(config, session.meshcat, predictors, known_before)
        log = session.simulate(
            diagram,
            DURATION,
            {"wrench": diagram.GetOutputPort("wrench")},
            period_sec=0.02,
            label=f"{label}_{number + 1}" if number else label,
        )
        if len(log.time) < DURATION / 0.02:
            raise ValueError(f"the trial takes {DURATION:.1f} s, got {log.time[-1]} s")
        data = telemetry(diagram, log.context, tuple(predictors))
        logs.append(data)
        window = along_the_wall(data["time"])
        force = data["wrench"][window, Y]
        error = rms(data["wrench_predicted"][window, Y] - force)
        _add(each, f"{label}_rmse_N", error)
        _add(each, f"{label}_modes", len(np.unique(data["mode"][window])))
    for name in predictors:
        mean = data[f"{name}.wrench_predicted"][window, Y]
        std = data[f"{name}.std"][window, Y]
        _add(each, f"{name}_rmse_N", rms(mean - force))
        _add(each, f"{name}_in_band", share_in_band(force, mean, std))
    last = rms(np.diff(data["wrench"][:, Y])[window[1:]])
    _add(each, "persistence_rmse_N", last)
    return *logs, recorded(diagram, log.context)


def in_the_loop(config, predictors, knowledge, watched, each) -> None:
    """The same trial with the prediction of one after the other fed forward: how far
    the tip is from the plan along the wall, and how well the fed one predicts.

    Args: watched, the log without any.
    """
    _add(each, "tracking_error_none_m", tracking_error(watched, config))
    for label, known_before, source in (
        ("last", knowledge, LAST),
        *((name, knowledge, name) for name in ONE_STEP),
        ("ours", knowledge, OURS),
        ("ours_from_scratch", None, OURS),
    ):
        chosen = {name: one for name, one in predictors.items() if name == source}
        data, _ = simulated(config, known_before, chosen, source)
        window = along_the_wall(data["time"])
        force = data["wrench"][:, Y]
        if source == LAST:
            error = rms(np.diff(force)[window[1:]])
        else:
            column = f"{source}." * (source in chosen) + "wrench_predicted"
            error = rms((data[column][:, Y] - force)[window])
        _add(each, f"{label}_fed_rmse_N", error)
        _add(each, f"tracking_error_{label}_m", tracking_error(data, config))


def tracking_error(data, config) -> float:
    """Distance of the tip from the plan along the wall, rms over the way there [m]."""
    window = along_the_wall(data["time"])
    plan = plan_of(config)["x_desired"][: len(data["time"])]
    return rms((tip_states(data)[0][:, Y] - plan[:, Y])[window])


def _add(each: dict[str, list[float]], key: str, value) -> None:
    each.setdefault(key, []).append(float(value))


def force_from_the_start(config, trials, data, seconds, each):
    """Figure 13: the force over the whole trial, from the plan alone.

    Returns: time (n,), mean (n,) and standard deviation (n,) of the force along y.
    """
    every = config.training.every

    def thinned(data, config):
        return TrainingTrial(*(values[::every] for values in force_trial(data, config)))

    planned = [thinned(data, one) for one, data in trials]
    start = perf_counter()
    predictor, modes = train(planned, config.training.long_term, FORCE_INPUTS)
    seconds["task_long_training_s"] = perf_counter() - start
    tested = thinned(data, config)
    start = perf_counter()
    ahead = from_the_start(
        predictor, planned, modes, known(tested.u), len(tested.x) - 1, config.seed
    )
    seconds["task_long_prediction_s"] = perf_counter() - start
    time = data["time"][::every]
    mean, std, w = ahead.mean[:, Y], ahead.std[:, Y], along_the_wall(time)
    _add(each, "task_long_rmse_N", rms((mean - tested.x[:, Y])[w]))
    _add(each, "task_long_in_band", share_in_band(tested.x[w, Y], mean[w], std[w]))
    return time, mean, std


def joints_from_the_start(config, trials, data, seconds, result):
    """Figures 11 and 12: the joints over the whole trial, with the controller known.

    Returns: {set: time (n,), joint 1 (n,), its mean and standard deviation (n,), time
        of the contact with the wall}.
    """
    every = config.training.every
    stiff = replace(config, stiffness=config.stiffness_high)
    out = {}
    for name, (_, is_stiff, _) in SETS.items():
        # The stiff controller has a tested trial of its own.
        tested_config = stiff if is_stiff else config
        truth = simulated(stiff)[0] if is_stiff else data
        joints = [joint_trial(d, one, every) for one, d in trials[name]]
        start = perf_counter()
        predictor, modes = train(joints, config.training.long_term)
        seconds[f"joint_{name}_training_s"] = perf_counter() - start
        tested = joint_trial(truth, tested_config, every)
        u = policy(tested_config, every)
        start = perf_counter()
        ahead = from_the_start(
            predictor, joints, modes, u, len(tested.x) - 1, config.seed
        )
        seconds[f"joint_{name}_prediction_s"] = perf_counter() - start
        time = truth["time"][::every]
        q, mean, std = tested.x[:, 0], ahead.mean[:, 0], ahead.std[:, 0]
        w = along_the_wall(time)
        result[f"joint_{name}_rmse_rad"] = rms((mean - q)[w])
        result[f"joint_{name}_lead_at_end_rad"] = float((mean - q)[w][-1])
        result[f"joint_{name}_band_rad"] = float(np.mean(2.0 * std[w]))
        result[f"joint_{name}_in_band"] = share_in_band(q[w], mean[w], std[w])
        out[name] = (time, q, mean, std, contact_time(truth))
    return out


def collect(config: WallFrictionConfig, seconds: dict):
    """All training trials: {set: [(config, data)]}, and what our models learned in
    those of `varied`, one after the other."""
    trials: dict[str, list] = {}
    knowledge = None
    start = perf_counter()
    for k, (name, (frictions, is_stiff, _)) in enumerate(SETS.items()):
        if name != "varied" and not config.training.joints:
            continue
        trials[name] = []
        before = None
        for i in range(config.training.trials):
            one = replace(
                config,
                friction=frictions[i % len(frictions)],
                stiffness=config.stiffness_high if is_stiff else config.stiffness,
                # Apart from those of all tested trials.
                seed=10_000 * (config.seed + 1) + 1000 * k + i,
            )
            data, before = simulated(one, before)
            trials[name].append((one, data))
        if name == "varied":
            knowledge = before
    seconds["training_trials_simulation_s"] = perf_counter() - start
    return trials, knowledge


def simulated(
    config: WallFrictionConfig,
    knowledge: tuple | None = None,
    predictors: Mapping[str, LongTermPredictor] | None = None,
    feedforward: str = "",
):
    """The log of one trial, and what our models know after it; the rest as of
    make_wall_friction."""
    predictors = predictors or {}
    diagram = make_wall_friction(config, None, predictors, knowledge, feedforward)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(DURATION)
    context = simulator.get_context()
    return telemetry(diagram, context, tuple(predictors)), learned(diagram, context)


def features(data) -> np.ndarray:
    """(n, 9) position, velocity, force at the tip: what the modes are found from."""
    return np.hstack([*tip_states(data), data["wrench"][:, :3]])


def joint_trial(data, config: WallFrictionConfig, every: int) -> TrainingTrial:
    """x = [q, v], u of the controller."""
    x = np.hstack([data["q"], data["v"]])[::every]
    u = policy(config, every)
    u_all = np.concatenate([u(t, x[t : t + 1]) for t in range(len(x))])
    return TrainingTrial(x, u_all, features(data)[::every])


def force_trial(data, config: WallFrictionConfig | None = None) -> TrainingTrial:
    """x = the force, u = [velocity, position]: planned in config, or measured."""
    position, velocity = tip_states(data)
    if config is not None:
        plan = plan_of(config)["x_desired"][: len(position)]
        position, velocity = plan[:, :3], plan[:, 7:10]
    return TrainingTrial(
        data["wrench"][:, :3], np.hstack([velocity, position]), features(data)
    )


def from_the_start(predictor, trials, modes, u, T, seed) -> Prediction:
    """The whole tested trial of T steps, from how training trials begin."""
    starts = np.array([trial.x[0] for trial in trials])
    covariance = np.cov(starts.T) + 1e-12 * np.eye(starts.shape[1])
    first = int(np.bincount([m[0] for m in modes]).argmax())
    return predict_long_term(predictor, starts.mean(0), covariance, u, T, first, seed)


def along_the_wall(time) -> np.ndarray:
    """Which samples are of the way along the wall."""
    return (time >= TIMES[4]) & (time <= TIMES[5])


def rms(values) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def share_in_band(truth, mean, std) -> float:
    """Share of the samples that are within two standard deviations of the mean."""
    return float(np.mean(abs(truth - mean) <= 2.0 * std))


def contact_time(data) -> float:
    """When the wall is felt first [s]."""
    felt = (data["wrench"][:, 0] < -CONTACT_FORCE) & (data["time"] > TIMES[2])
    return float(data["time"][np.argmax(felt)])


def plot_joints(ahead: dict[str, tuple]):
    """Figures 11 and 12: joint 1, true and predicted from the start."""
    figure, axes = plt.subplots(
        1, 3, figsize=(15, 4.2), sharey=True, layout="constrained"
    )
    for ax, (name, values) in zip(axes, ahead.items(), strict=True):
        time, q, mean, std, contact = values
        frictions, is_stiff, number = SETS[name]
        ax.fill_between(
            time, mean - 2 * std, mean + 2 * std, alpha=0.3, label="2 std", color="C0"
        )
        ax.plot(time, mean, color="C0", label="predicted")
        ax.plot(time, q, "k--", label="true")
        ax.axvline(contact, color="0.4", ls=":")
        learned_from = f"{frictions[0]} to {frictions[-1]}" if frictions[1:] else "0.6"
        ax.set(
            title=f"fig. {number}: learned at {learned_from}"
            + (", stiff" if is_stiff else ""),
            xlabel="time [s]",
        )
    axes[0].set_ylabel("joint 1 [rad]")
    axes[0].legend(loc="upper left")
    return figure


def plot_forces(data, scratch, ahead):
    """Figures 13 and 14: the force along the wall, true and predicted."""
    figure, axes = plt.subplots(
        2, 3, figsize=(15, 7.5), sharex=True, height_ratios=(2, 1), layout="constrained"
    )
    time, force = data["time"], data["wrench"][:, Y]
    window, contact = along_the_wall(time), contact_time(data)
    mean, std = (np.interp(time, ahead[0], values) for values in ahead[1:])
    one = data["one_step.wrench_predicted"][:, Y], data["one_step.std"][:, Y]
    panels: tuple = (
        ("fig. 13: baseline, from the start", mean, std),
        ("fig. 14a: baseline, one step with feedback", *one),
        ("fig. 14b: our forward models", data["wrench_predicted"][:, Y], None),
    )
    for k, (title, mean, std) in enumerate(panels):
        ax, below = axes[:, k]
        for a, centre in ((ax, mean), (below, mean - force)):
            if std is not None:
                a.fill_between(
                    time, centre - 2 * std, centre + 2 * std, alpha=0.3, label="2 std"
                )
            a.axvline(contact, color="0.4", ls=":")
        ax.plot(time, force, "k", lw=0.6, label="measured")
        ax.plot(time, mean, color="C0", label="predicted")
        below.plot(time[window], (mean - force)[window], color="C0", lw=0.7)
        ax.set(title=title, ylim=(-14.0, 6.0))
        below.set(xlabel="time [s]", ylim=(-1.0, 1.0) if k else (-7.0, 7.0))
        below.axhline(0.0, color="0.4", lw=0.6)
    predicted = scratch["wrench_predicted"][:, Y]
    axes[1, 2].plot(
        time[window],
        (predicted - force)[window],
        color="C1",
        lw=0.7,
        zorder=1,
        label="nothing known before",
    )
    axes[1, 2].legend(loc="lower right")
    axes[0, 0].legend(loc="lower left")
    axes[0, 0].set_ylabel("force along the wall [N]")
    axes[1, 0].set_ylabel("error along the wall [N]")
    return figure


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
    return comparison.to_table(
        "A wall of unknown friction (CC 4.4)",
        [
            "Errors along the wall, rms, mean (joints: median) over seeds (least to "
            "greatest); the sensor's noise alone is 0.1 N. Band: two standard "
            "deviations.",
            "The baseline's GPs are given "
            f"{Config().training.one_step.points_per_mode} points per mode of "
            f"{Config().training.trials} trials; the paper's 55 min are for all points "
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


def without_noise(error: float) -> float:
    """What is left of a prediction's rms error against a measured force when the
    sensor's noise, which is independent of the prediction, is taken out [N]."""
    return float(np.sqrt(max(error**2 - NOISE**2, 0.0)))


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

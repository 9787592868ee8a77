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

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter

import numpy as np
from pydrake.systems.analysis import Simulator

from makebreak.diagrams.recorder import recorded
from makebreak.diagrams.tabletop import TABLETOP_WALLS
from makebreak.diagrams.wall_friction import (
    DURATION,
    LAST,
    OURS,
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
from makebreak.scripts.experiments.papers import wall_friction_paper
from makebreak.scripts.experiments.papers.wall_friction_plots import (
    plot_forces,
    plot_joints,
)
from makebreak.scripts.experiments.papers.wall_friction_score import (
    EACH_FILE,
    ONE_STEP,
    SETS,
    TIMES_FILE,
    VARIED,
    Y,
    along_the_wall,
    contact_time,
    rms,
    share_in_band,
)
from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.session import Session
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
FORCE_INPUTS = range(6)  # F and velocity; the position is for the SVM.

reproduce = wall_friction_paper.reproduce


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

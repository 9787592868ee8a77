"""Wall friction (CC 4.4): the diagram, the baseline as a system, the scores."""

import json
from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.diagrams.wall_friction import (
    BEYOND,
    DURATION,
    LAST,
    TABLE_Z,
    TIMES,
    WALL_X,
    WallFrictionConfig,
    make_wall_friction,
    motion,
    plan_of,
    policy,
    telemetry,
    tip_states,
)
from makebreak.scripts.experiments import wall_friction
from makebreak.scripts.experiments.papers.wall_friction_paper import _loop_rows
from makebreak.scripts.experiments.papers.wall_friction_score import (
    FED,
    along_the_wall,
    contact_time,
    share_in_band,
    without_noise,
)
from makebreak.scripts.experiments.wall_friction import (
    force_trial,
    run,
    simulated,
    tracking_error,
)
from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.settings import apply_settings
from makebreak.systems.baselines.long_term_predictor import OneStepPredictor
from makebreak.systems.baselines.numerics.long_term_predictor import (
    LongTermPredictor,
    TrainingBudget,
    predict_one_step,
    train,
)

START = np.array([0.42, -0.16, 0.195])


class Affine:
    """Stands for a GP and for an SVM: the force grows by 1 N along x."""

    def mean(self, X):
        return X[:, :3] + [1.0, 0.0, 0.0]

    def predict(self, X):
        if X.shape[1] == 9:  # As the SVM.
            return np.where(X[:, 0] > 5.0, 1, 0)
        return self.mean(X), np.full((len(X), 3), 0.04)


def stand_in():
    model = Affine()
    return LongTermPredictor(
        model,
        {0: model, 1: model},
        {},
        tuple(range(6)),
        np.zeros(9),
        np.ones(9),
        False,
        3,
    )


def one_step(wrench, predictor=None):
    builder = DiagramBuilder()
    system = builder.AddNamedSystem("p", OneStepPredictor(predictor or stand_in()))
    for name, value in (
        ("wrench", wrench),
        ("ee_velocity", np.zeros(6)),
        ("ee_pose", [0.5, 0, 0, 1, 0, 0, 0]),
    ):
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), system.GetInputPort(name))
    for name in ("wrench_predicted", "std", "mode", "status"):
        builder.ExportOutput(system.GetOutputPort(name), name)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.02)
    context = simulator.get_context()
    return {
        name: diagram.GetOutputPort(name).Eval(context)
        for name in ("wrench_predicted", "std", "mode", "status")
    }


def test_one_step_system_gives_what_its_numerics_give():
    out = one_step([8.0, 1.0, 2.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(out["wrench_predicted"], [9.0, 1.0, 2.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(out["std"], 0.2)
    assert out["mode"] == 1 and out["status"] == 0


def test_one_step_system_holds_when_the_sensor_fails():
    out = one_step([np.nan] * 6)
    assert out["status"] == 1
    np.testing.assert_array_equal(out["wrench_predicted"], 0.0)


def test_a_predictor_over_other_numbers_is_refused():
    wrong = replace(stand_in(), mean=np.zeros(20))
    with pytest.raises(ValueError, match="over 3 of 20 numbers, expected 3 of 9"):
        OneStepPredictor(wrong)


def test_the_motion_is_continuous_and_its_velocity_is_its_slope():
    plan = motion(WallFrictionConfig(), START)
    time, x = plan["time"], plan["x_desired"]
    # Second differences: 6 s^5 polynomials over 2 s, a third derivative below 3 m/s3.
    slope = np.gradient(x[:, :3], time, axis=0)
    free = plan["force_directions"].reshape(-1, 2, 3).any(axis=1)
    # Where stiffness fades, the reference's speed along the normal fades with it.
    inner = slice(1, -1)
    error = np.where(free, 0.0, slope - x[:, 7:10])[inner]
    assert abs(error).max() < 1e-4
    np.testing.assert_allclose(x[0, :3], START, atol=1e-12)
    assert x[-1, 2] == pytest.approx(TABLE_Z - BEYOND)
    assert x[-1, 0] == pytest.approx(WALL_X + BEYOND)


def test_stiffness_gives_way_to_force_where_there_is_a_surface():
    config = WallFrictionConfig(normal_force=6.0)
    plan = motion(config, START)
    at = {name: plan[name][np.searchsorted(plan["time"], TIMES[4])] for name in plan}
    np.testing.assert_allclose(at["stiffness"][:3], [0.0, 300.0, 0.0])
    np.testing.assert_allclose(at["push"], [6.0, 0.0, -6.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(at["force_directions"], [0, 0, -1, 1, 0, 0])
    before = plan["time"] < TIMES[1] - 0.3
    assert not plan["push"][before].any()
    assert np.all(plan["stiffness"][before, :3] == 300.0)


@pytest.fixture(scope="module")
def trial():
    config = WallFrictionConfig(friction=0.6, seed=3)
    diagram = make_wall_friction(config, predictors={"one": stand_in()})
    simulator = Simulator(diagram)
    simulator.AdvanceTo(DURATION)
    return config, telemetry(diagram, simulator.get_context(), ["one"])


def test_friction_along_the_wall_is_coulombs(trial):
    config, data = trial
    late = along_the_wall(data["time"]) & (data["time"] > TIMES[4] + 1.5)
    force = data["wrench"][late].mean(axis=0)
    # 0.3 on the table and 0.6 on the wall, 8 N each: friction opposes the motion.
    # Normal forces are pushed, not controlled: within 0.2 N.
    np.testing.assert_allclose(force[0], -8.0, atol=0.2)
    np.testing.assert_allclose(force[2], 8.0, atol=0.2)
    np.testing.assert_allclose(force[1], -0.3 * 8.0 - 0.6 * 8.0, atol=0.25)


def test_a_row_of_the_log_is_a_measurement_and_what_was_predicted_for_it(trial):
    _, data = trial
    n = len(data["time"])
    np.testing.assert_allclose(data["time"], 0.005 * np.arange(n), atol=1e-9)
    for mean in data["one.wrench_predicted"][1:, :3], data["one.std"][1:]:
        assert np.isfinite(mean).all()
    expected = data["wrench"][:-1, :3] + [1.0, 0.0, 0.0]
    np.testing.assert_allclose(data["one.wrench_predicted"][1:, :3], expected)


def test_the_block_meets_the_wall_where_it_stands(trial):
    _, data = trial
    position, velocity = tip_states(data)
    touched = np.searchsorted(data["time"], contact_time(data))
    # Half a millimetre: contact at 8e4 N/m, and a sample at up to 0.05 m/s.
    assert abs(position[touched, 0] - WALL_X) < 5e-4
    slope = np.gradient(position[:, 1], data["time"])
    # Noise: 1e-5 rad / 5 ms, and 1e-3 rad/s, at 0.6 m.
    np.testing.assert_allclose(velocity[5:-5, 1], slope[5:-5], atol=0.02)


def test_the_policy_is_the_force_of_the_impedance(trial):
    config, data = trial
    t = 700  # On the table, on the way to the wall.
    x = np.hstack([data["q"][t], data["v"][t]])[None]
    position, velocity = tip_states(
        {"q": data["q"][t : t + 1], "v": data["v"][t : t + 1]}
    )
    plan = plan_of(config)
    reference = plan["x_desired"][t]
    expected = plan["stiffness"][t, :3] * (reference[:3] - position[0])
    expected += plan["damping"][t, :3] * (reference[7:10] - velocity[0])
    expected += plan["push"][t, :3]
    np.testing.assert_allclose(policy(config, 1)(t, x)[0, :3], expected, atol=1e-9)
    # It carries friction, 0.3 x 8 N, and accelerates 5 kg or so.
    assert expected[0] == pytest.approx(2.4, abs=1.5)


def test_watching_changes_nothing(trial):
    config, data = trial
    diagram = make_wall_friction(config)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.0)
    alone = telemetry(diagram, simulator.get_context())
    n = len(alone["time"])
    np.testing.assert_array_equal(alone["wrench"], data["wrench"][:n])


def test_one_step_of_a_predictor_trained_on_a_trial_follows_the_force(trial):
    """Trained and tested on the same friction: the easy case, which must work."""
    _, data = trial
    thirds = [{k: v[i::3] for k, v in data.items()} for i in range(3)]
    budget = TrainingBudget(points_per_mode=40, svm_points=300, modes_max=5)
    trials = [force_trial(third) for third in thirds]
    predictor, _ = train(trials, budget, range(6))
    x, u = trials[0].x, trials[0].u
    mode, errors = 0, []
    for k in range(400, len(x) - 1):
        mean, _, mode = predict_one_step(predictor, x[k], u[k], mode)
        errors.append(mean[1] - x[k + 1, 1])
    # Noise of 0.1 N in both samples, at three times the step.
    assert np.sqrt(np.mean(np.square(errors))) < 0.35


def test_the_share_in_the_band_counts_two_standard_deviations():
    truth = np.array([0.0, 1.9, 2.1, -1.9])
    assert share_in_band(truth, np.zeros(4), np.ones(4)) == 0.75


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"stiffness": 0.0}, "stiffness is 0.0, expected > 0"),
        ({"normal_force": np.nan}, "normal_force is nan, expected > 0"),
        ({"friction": 2.0}, "friction of blue_wall is 2.0"),
        ({"start_spread": -1.0}, "start_spread is -1.0, expected >= 0"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_bad_settings_are_refused_by_name(change, says):
    with pytest.raises(ValueError, match=says):
        make_wall_friction(replace(WallFrictionConfig(), **change))


@pytest.mark.slow
def test_a_fed_forward_prediction_takes_the_lag_off(trial):
    config, watched = trial
    before = tracking_error(watched, config)
    # 7.2 N of friction against 300 N/m: 24 mm, less while it builds up.
    assert 0.015 < before < 0.025
    data, _ = simulated(config, feedforward=LAST)
    assert tracking_error(data, config) < 0.1 * before
    # The friction is what it was.
    late = along_the_wall(data["time"]) & (data["time"] > TIMES[4] + 1.5)
    force = data["wrench"][late, 1].mean()
    assert force == pytest.approx(watched["wrench"][late, 1].mean(), abs=0.3)


def made_up_log(config):
    """A tip that stands, and predictions that are 0.3, 0.4 and 0.5 N off."""
    plan = plan_of(config)
    n = len(plan["time"])
    q = np.tile([-0.36, -0.11, 0.0, -2.53, 0.0, 2.42, -0.36], (n, 1))
    log = {"time": plan["time"], "q": q, "v": 0.0 * q}
    log["wrench"] = np.tile([-8.0, -9.0, 8.0, 0, 0, 0], (n, 1))
    for name, off in (("", 0.3), ("one_step.", 0.4), ("one_step_change.", 0.5)):
        log[f"{name}wrench_predicted"] = log["wrench"] + off
    return log


def test_each_prediction_is_fed_forward_in_turn_and_scored(monkeypatch):
    config, seen = WallFrictionConfig(seed=5), []

    def simulate(config, knowledge, predictors, source):
        seen.append((source, knowledge, tuple(predictors)))
        return made_up_log(config), None

    monkeypatch.setattr(wall_friction, "simulated", simulate)
    each = {}
    names = {"one_step": 1, "one_step_change": 2}
    wall_friction.in_the_loop(config, names, "known", made_up_log(config), each)
    assert seen == [
        ("last", "known", ()),
        ("one_step", "known", ("one_step",)),
        ("one_step_change", "known", ("one_step_change",)),
        ("ours", "known", ()),
        ("ours", None, ()),
    ]
    fed = {name: each[f"{name}_fed_rmse_N"] for name in FED if name != "none"}
    expected = dict(
        last=0.0, one_step=0.4, one_step_change=0.5, ours=0.3, ours_from_scratch=0.3
    )
    assert fed == {name: [pytest.approx(x)] for name, x in expected.items()}
    assert all(len(each[f"tracking_error_{name}_m"]) == 1 for name in FED)


def test_reproduce_has_a_row_for_each_that_was_fed_forward(tmp_path):
    each = {f"tracking_error_{name}_m": [0.001, 0.003] for name in FED}
    each |= {f"{name}_fed_rmse_N": [0.2, 0.2] for name in FED}
    (tmp_path / "tested_trials.json").write_text(json.dumps(each))
    rows = []

    class Comparison:
        def with_settings(self, settings):
            return "its"

        def row(self, *row):
            rows.append(row)

    results = [{"out_dir": str(tmp_path)}, {"error": "failed"}]
    _loop_rows(Comparison(), results)
    assert len(rows) == len(FED)
    assert rows[1][2].startswith("2.00 mm (1.00 to 3.00); predicts to 0.200 N, 0.173 N")
    assert "2 trials" in rows[0][0]


def test_noise_that_is_independent_is_taken_out_of_an_error():
    rng = np.random.default_rng(0)
    error, noise = 0.2 * rng.normal(size=200_000), 0.1 * rng.normal(size=200_000)
    both = np.sqrt(np.mean((error + noise) ** 2))
    assert without_noise(both) == pytest.approx(0.2, rel=0.01)
    assert without_noise(0.05) == 0.0


def test_too_few_trials_are_refused_by_name(tmp_path):
    config = WallFrictionConfig()
    config.training.trials = 3
    with pytest.raises(ValueError, match="training.trials is 3, expected 7 or more"):
        run(config, Session(tmp_path, progress=False))


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (["training.one_step.predict_change=true"], "both are trained"),
        (["training.joints=false", "stiffness_high=900"], "training.joints=false"),
        (["station_seed=3"], "station_seed is 3, expected None: not used with realism"),
    ],
)
def test_settings_that_nothing_reads_are_refused(tmp_path, settings, says):
    config = apply_settings(WallFrictionConfig(), settings)
    with pytest.raises(ValueError, match=says):
        run(config, Session(tmp_path, progress=False))


@pytest.mark.slow
def test_a_whole_run_meets_its_criterion(tmp_path):
    config = WallFrictionConfig(seed=1)
    config.training.trials = 7
    config.training.long_term.points_per_mode = 80
    result = run(config, Session(tmp_path, progress=False))
    assert result["success"]
    assert result["joint_same_in_band"] < 0.5  # Figure 11a: it is surprised.
    times = json.loads((tmp_path / "training_times.json").read_text())
    assert times["one_step_training_s"] > 0.0
    for name in ("joint_prediction", "force_prediction"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000

"""The experiments porridge and multi_spring, run short."""

import json
from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from makebreak.diagrams import multi_spring as diagrams
from makebreak.diagrams.multi_spring import MultiSpringConfig
from makebreak.diagrams.planar import knowledge_of
from makebreak.diagrams.planar_tuned import SETTINGS, TUNED_FILE, tuned_biomimetic
from makebreak.diagrams.porridge import PorridgeConfig
from makebreak.scripts.cli import main
from makebreak.scripts.experiments import multi_spring, porridge
from makebreak.scripts.experiments.papers import planar_loops as loops
from makebreak.scripts.experiments.papers import tune_planar
from makebreak.scripts.experiments.runs.planar_runs import median_range, with_count
from makebreak.scripts.runner import comparison
from makebreak.scripts.runner.session import Session
from makebreak.systems.baselines.numerics.mrac import error_weights
from makebreak.systems.planar.numerics.planar_impedance import persistence
from makebreak.systems.planar.numerics.planar_world import compensated


def run_main(name, folder, *settings):
    status = main(["run", name, "--no-meshcat", "--out", str(folder), *settings])
    return status, json.loads((folder / "result.json").read_text())


SHORT = ["--seed", "3", "--duration", "0.4", "--set", "trials=2"]


@pytest.fixture(scope="module")
def springs(tmp_path_factory):
    """Folder, exit status and result of a short run."""
    folder = tmp_path_factory.mktemp("springs")
    return folder, *run_main("multi_spring", folder, *SHORT)


@pytest.fixture(scope="module")
def stirred(tmp_path_factory):
    folder = tmp_path_factory.mktemp("porridge")
    return folder, *run_main("porridge", folder, "--seed", "2")


def test_multi_spring_writes_scores_and_figures_and_repeats_itself(springs, tmp_path):
    folder, _, result = springs
    error = result["tracking_error_rms_m"]
    for name in ("mrac", "active_inference"):
        ratio = result[f"{name}_error_rms_m"] / error
        assert result[f"ratio_{name}"] == pytest.approx(ratio)
    curve = result["biomimetic_error_rms_m"]
    assert len(curve) == 2 and len(result["tracking_error_rms_by_trial_m"]) == 2
    assert result["ratio_biomimetic_last"] == pytest.approx(curve[-1] / error)
    share = result["stiffness_mean_Npm"] / result["stiffness_share"]
    assert share == pytest.approx(500.0)
    n = len(multi_spring.OMEGAS)
    assert len(result["mrac_omega_error_rms_m"]) == n
    for figure in ("mrac", "active_inference", "biomimetic", "adaptive"):
        assert (folder / f"{figure}.png").stat().st_size > 10_000
    header = (folder / "recording.csv").read_text().splitlines()[0]
    assert "effector.x.position" in header and "effector.tip.fy" in header
    _, again = run_main("multi_spring", tmp_path, *SHORT)
    assert again == result


def test_multi_springs_criterion_is_the_stated_one(springs):
    """Success needs all four ratios and the stiffness; here from what the run wrote."""
    _, status, result = springs
    met = all(
        result[f"ratio_{name}"] >= bound
        for name, bound in (
            ("mrac", 3.0),
            ("active_inference", 3.0),
            ("biomimetic_first", 3.0),
        )
    )
    met = met and result["ratio_biomimetic_last"] > 1.0
    met = met and result["stiffness_share"] <= 0.25
    assert result["success"] == met and status == (0 if met else 1)


def test_porridge_compares_models_on_the_same_samples(stirred):
    folder, status, result = stirred
    ratio = (
        result["fixed_prediction_error_outside_N"]
        / result["incremental_prediction_error_outside_N"]
    )
    assert result["fixed_over_incremental"] == pytest.approx(ratio)
    assert result["success"] == (ratio >= 5.0) and status == (0 if ratio >= 5.0 else 1)
    # The last measured force is off by two draws of the noise, one per sample, and by
    # what the force changes in 5 ms: at most 0.15 N here.
    expected = np.sqrt(2.0) * 0.2
    found = result["measured_force_prediction_error_outside_N"]
    assert expected * 0.9 < found < np.hypot(expected, 0.15) * 1.1
    # No prediction beats the noise of the sensor that it is compared with.
    for name in porridge.MODELS:
        assert result[f"{name}_prediction_error_outside_N"] > 0.18, name
    assert 0.2 < result["outside_share"] < 0.7
    assert len(result["fixed_sizes_error_outside_N"]) == len(porridge.SIZES)
    for figure in ("prediction", "tracking"):
        assert (folder / f"{figure}.png").stat().st_size > 10_000


def test_regression_error_of_no_model_is_the_difference_of_forces():
    samples = np.array([[0.3, 4.0, 5.0], [0.2, 5.0, 3.0]])
    error = porridge.regression_error(persistence(2, 1), samples, 2)
    assert error == pytest.approx(np.sqrt((1.0 + 4.0) / 2.0), rel=1e-5)
    assert np.isnan(porridge.regression_error(persistence(2, 1), samples[:0], 2))


@pytest.mark.parametrize(
    "name, setting, message",
    [
        ("multi_spring", "trials=0", "trials is 0"),
        ("multi_spring", "setting=outdoors", "outdoors"),
        ("multi_spring", "baselines.mrac.omega=0", "omega is 0"),
        ("multi_spring", "impedance.stiffness_max=1", "stiffness_max is 1"),
        ("multi_spring", "setting=porridge", "which has no springs"),
        ("porridge", "viscosity=[80,20]", "viscosity is"),
        ("porridge", "model.mixture.tau_nov=2", "tau_nov is 2"),
    ],
)
def test_bad_settings_are_one_line_and_status_2(
    tmp_path, capsys, name, setting, message
):
    arguments = ["run", name, "--no-meshcat", "--out", str(tmp_path), "--set", setting]
    assert main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert message in lines[-1] and not any("Traceback" in line for line in lines)


@pytest.mark.parametrize(
    "module, done",
    [
        pytest.param(multi_spring, "springs", marks=pytest.mark.slow),
        (porridge, "stirred"),
    ],
)
def test_reproduce_says_met_only_if_every_seed_ran_and_met(
    tmp_path, monkeypatch, module, done, request
):
    """From results as run writes them; one seed's run is made to fail."""
    result = request.getfixturevalue(done)[2]
    good = dict(result)
    for key in result:
        if key.startswith("ratio_") or key.endswith("_over_incremental"):
            good[key] = 50.0
    if module is multi_spring:  # One seed of it is simulated, and that once.
        one = module.compare(1)
        assert all(len(found) > 5 for found in one.values())

        def compare(seeds):
            return {s: {c: e * seeds for c, e in of.items()} for s, of in one.items()}

        monkeypatch.setattr(module, "compare", compare)
    for results, everything_met in (
        ([good, good], True),
        ([good, {"success": False, "error": "exit status 3"}], False),
    ):
        monkeypatch.setattr(comparison, "run_many", lambda *a, r=results, **k: r)
        table = module.reproduce(Session(tmp_path / "r"), 2, 1)
        targets = [m for m in table.met if m is not None]
        assert targets and all(targets) == everything_met
        assert table.to_text()


def test_median_and_range_of_what_is_there():
    assert median_range([1.0, None, 3.0, 2.0], 10.0, "mm") == "20 (10 to 30) mm"
    assert median_range([None]) == "-"
    assert with_count([4.0, 5.0, 9.0], 5.0) == "5 (4 to 9); 2 of 3 reach 5"


@pytest.mark.parametrize("setting", SETTINGS)
def test_every_search_space_makes_a_controller_that_stays_within_its_bounds(setting):
    """At random settings: the gains that the tuning may not exceed."""
    rng, setting = np.random.default_rng(0), SETTINGS[setting]
    K, D = setting.stiffness_max, setting.damping_max * (1 + 1e-9)
    assert D == pytest.approx(4.0 * np.sqrt(K))
    checked = set()
    for name, space in tune_planar.spaces(setting).items():
        for _ in range(20):
            p = {
                key: float(np.exp(rng.uniform(*np.log(pair))))
                for key, pair in space.items()
            }
            config = tune_planar.config_of(name, p, setting)
            if name in ("mrac", "mrac+force"):
                p2, p3 = error_weights(config.omega, config.zeta, config.rate_weight)
                most = config.force_gains[0] + 2 * 0.25**2 * config.position_gains[0]
                most += 2 * 0.49**2 * config.velocity_gains[0]
                assert p2 * most <= K * (1 + 1e-9) and p3 * most <= D
            elif name.startswith("biomimetic"):
                assert config.stiffness <= K and config.damping <= D
            elif name in ("active_inference", "active_inference+force"):
                stiffness = config.k_action / config.variance[1]
                assert stiffness <= K * (1 + 1e-9) and config.goal_moves
            elif name in ("adaptive", "adaptive_position", "measured_force"):
                law, _ = config
                assert law.stiffness_free < law.stiffness_max == K
                assert 2.0 * law.damping_ratio * np.sqrt(K) <= D
            else:
                continue
            checked.add(name)
    assert len(checked) >= (2 if setting.world == "porridge" else 8)


# Edges that are none: bounds that all share; MRAC's reference model, of which only p2
# and p3 count, two numbers made of three; and where a term has gone.
SHARED = {
    "stiffness",
    "stiffness_free",
    "damping_ratio",
    "omega",
    "zeta",
    "rate_weight",
}
NOTHING_BELOW = {"position_now", "position_summed", "velocity_now", "velocity_summed"}
NOTHING_BELOW |= {"rate_force", "rate_stiffness", "rate_damping", "forget"}
NOTHING_ABOVE = {"variance_velocity", "variance_belief", "variance_rate", "forget_less"}


@pytest.mark.parametrize("setting", SETTINGS)
def test_no_baseline_was_tuned_to_an_edge_of_its_range(setting):
    found = json.loads(TUNED_FILE.read_text())[setting]
    spaces = tune_planar.spaces(SETTINGS[setting])
    assert set(found) == set(spaces)
    for name, one in found.items():
        if name.startswith(("adaptive", "measured_force")):
            continue
        for key in set(one["at_bound"]) - SHARED:
            low, high = spaces[name][key]
            is_low = one["parameters"][key] < np.sqrt(low * high)
            assert key in (NOTHING_BELOW if is_low else NOTHING_ABOVE), (name, key)


def diagram_error(diagram):
    """RMS tracking error [m], and what the controller learned, if it does."""
    simulator = Simulator(diagram)
    context = simulator.get_context()
    errors = []
    for k in range(1, 1201):
        simulator.AdvanceTo(0.005 * k)
        x, goal = (
            diagram.GetOutputPort(name).Eval(context)[:2]
            for name in ("state", "x_desired")
        )
        errors.append((x - goal) @ (x - goal))
    learns = hasattr(diagram.GetSubsystemByName("controller"), "knowledge")
    known = knowledge_of(diagram, context) if learns else None
    return np.sqrt(np.mean(errors)), known


@pytest.mark.parametrize(
    "setting",
    [
        "springs",
        *(pytest.param(s, marks=pytest.mark.slow) for s in ("springs_lab", "engaging")),
    ],  # fmt: skip
)
def test_the_plain_loops_are_the_diagrams(setting):
    """Tick for tick, with noise and delay: only the sum of the errors is taken in
    another order."""
    springs = diagrams.as_tuned(MultiSpringConfig(seed=7, setting=setting))
    task = tune_planar.task_of(SETTINGS[setting], 7)
    c = springs.baselines

    def error_in_diagram(controller, feedforward=False):
        diagram = diagrams.make_multi_spring(springs, controller, None, feedforward)
        return diagram_error(diagram)

    for force in (False, True):
        error, _ = error_in_diagram(diagrams.mrac(c.mrac), force)
        plain = loops.mrac_error(c.mrac, task, force)
        assert error == pytest.approx(plain, rel=1e-9)
        controller = diagrams.active_inference(c.active_inference)
        error, _ = error_in_diagram(controller, force)
        plain = loops.active_inference_error(c.active_inference, task, force)
        assert error == pytest.approx(plain, rel=1e-9)
    controller = diagrams.impedance(springs.impedance, springs.model)
    error, _ = error_in_diagram(controller)
    plain = loops.adaptive_error(springs.impedance, springs.model, task)[0]
    assert error == pytest.approx(plain, rel=1e-9)
    known, errors = None, []
    for _ in range(3):
        controller = diagrams.biomimetic(c.biomimetic, known)
        error, known = error_in_diagram(controller)
        errors.append(error)
    curve = loops.learning_curve(c.biomimetic, 3 * [task])
    np.testing.assert_allclose(errors, curve, rtol=1e-9)


def test_the_plain_loops_of_porridge_are_the_diagrams():
    stirring = PorridgeConfig(seed=7)
    for training in (True, False):
        controller = diagrams.impedance(stirring.impedance, stirring.model)
        diagram = porridge.make_porridge(stirring, controller, training)
        task = tune_planar.task_of(SETTINGS["porridge"], 7, training)
        plain = loops.adaptive_error(stirring.impedance, stirring.model, task)
        assert diagram_error(diagram)[0] == pytest.approx(plain[0], rel=1e-12)


def test_a_measured_force_that_is_fed_forward_cancels_the_springs():
    """Without noise and delay only u's period of 1 ms is left of them."""
    config = MultiSpringConfig(seed=1)
    soft = diagrams.impedance(
        replace(config.impedance, adapt=False, stiffness_max=110.0), config.model
    )
    without, _ = diagram_error(diagrams.make_multi_spring(config, soft))
    soft = diagrams.impedance(
        replace(config.impedance, adapt=False, stiffness_max=110.0), config.model
    )
    fed, _ = diagram_error(
        diagrams.make_multi_spring(config, soft, None, feedforward=True)
    )
    assert fed < 0.02 * without


def test_a_force_that_is_not_finite_is_not_fed_forward():
    u, force = np.array([3.0, 4.0]), np.array([1.0, np.nan])
    np.testing.assert_array_equal(compensated(u, force, 100.0), u)
    np.testing.assert_allclose(compensated(u, np.array([-3, -4.0]), 5.0), [3.0, 4.0])


def test_what_is_left_at_its_default_is_as_tuned_for_the_setting():
    config = MultiSpringConfig(setting="engaging")
    mine = replace(config.baselines.mrac, omega=2.5)
    config = replace(config, baselines=replace(config.baselines, mrac=mine))
    tuned = diagrams.as_tuned(config)
    assert tuned.impedance.stiffness_max == 50.0
    assert tuned.baselines.mrac == mine
    assert tuned.baselines.biomimetic == tuned_biomimetic("engaging")


def test_porridges_noise_and_viscosity_are_settings():
    config = PorridgeConfig(seed=1, spread=0.0, viscosity=[10.0, 20.0])
    world, _, _ = porridge.draw(config, training=False)
    assert world.viscosity == [0.0, 20.0]

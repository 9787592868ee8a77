"""Logs as robots write them, from files to verdict: of the benchmark's sorts, with
seeds of their own."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

pytest.importorskip("mujoco", reason="the logs are simulated in MuJoCo")

from gap_benchmark.log_cases import LogCase, Recipe, write  # noqa: E402
from gap_benchmark.robot_log import wandering  # noqa: E402

from makebreak.gap.data.reading import read_recording  # noqa: E402
from makebreak.gap.residuals.inverse import InverseModel  # noqa: E402
from makebreak.gap.workflow import run_gap  # noqa: E402
from makebreak.models.effects.kind import Effect  # noqa: E402
from makebreak.models.scene import read_scene  # noqa: E402


def found_in(folder, recipe, seed):
    """The truth, and what is found."""
    truth = write(LogCase("log", seed, recipe), folder)
    return truth, run_gap(folder / "scene.yaml", [folder / "recording.csv"])


@pytest.mark.parametrize(
    "robot, option",
    [
        pytest.param("planar", "first order", marks=pytest.mark.slow),
        ("planar", "wander"),
        pytest.param("planar", "moving average", marks=pytest.mark.slow),
        pytest.param("six", "velocity drive", marks=pytest.mark.slow),
    ],
)
def test_what_sensors_and_drives_do_is_no_gap(tmp_path, robot, option):
    """Noise that goes together over some samples, or over tenths of a second: as it is
    not known where an effort's noise is made, it must not repeat with the motion. And a
    drive's loop that holds its effort for half a millisecond."""
    recipe = Recipe("none", robot, "multisine guided", options=(option,))
    _, result = found_in(tmp_path, recipe, 77)
    assert (result.verdict, result.effects) == ("no_gap", [])
    assert ("is taken for noise of the sensors" in result.says) == (option == "wander")


@pytest.mark.slow
def test_slow_noise_of_one_effort_does_not_hide_what_is_missing_at_another(tmp_path):
    """As in a log of a real double pendulum: the equation of the shoulder is not met,
    by more than its sensor could make; windows that expect what is left of the elbow's
    effort as its noise agree all the same, because joints move each other."""
    recipe = Recipe("friction", "planar", "multisine", "friction", ("ode",))
    write(LogCase("log", 78, recipe), tmp_path)
    log = tmp_path / "recording.csv"
    with log.open() as file:
        names = file.readline().strip().split(",")
        table = np.loadtxt(file, delimiter=",")
    rng, step = np.random.default_rng(1), np.median(np.diff(table[:, 0]))
    stirred = gaussian_filter1d(rng.normal(size=len(table)), 0.1 / step)
    added = {
        "shoulder": 0.2 * stirred / np.std(stirred),  # [N m]
        "elbow": 0.1 * wandering(len(table), step, 0.5, (1,), rng)[:, 0],
    }
    for joint, effort in added.items():
        table[:, names.index(f"planar.{joint}.effort_measured")] += effort
    np.savetxt(log, table, "%.9g", ",", header=",".join(names), comments="")
    result = run_gap(tmp_path / "scene.yaml", [log])
    assert result.verdict == "gap_unnamed"
    assert result.gap.after > 3.0
    assert "is taken for noise" not in result.says


def test_weights_of_two_links_add_up_and_those_of_one_do_not(tmp_path):
    """What a fit adds up from the parts that it kept, against Drake with all in it."""
    write(LogCase("log", 79, Recipe("none", "scara", "multisine")), tmp_path)
    scene = read_scene(tmp_path / "scene.yaml")
    recordings = [read_recording(tmp_path / "recording.csv")]
    model = InverseModel(scene, recordings)
    load = Effect(
        "payload", ["scara.flange"],
        {"mass": 0.4, "com_x": 0.03, "com_y": -0.02, "com_z": 0.05},
    )  # fmt: skip
    mass = {"mass": 0.3}
    damping = Effect("joint_viscous_damping", ["scara.elbow"], {"damping": 0.2})
    for link, more in (("scara.fore", {}), ("scara.flange", {"x": 0.02, "y": 0.01})):
        hidden = [load, Effect("link_mass", [link], mass)]
        if more:
            hidden.append(Effect("link_com", [link], {**more, "z": 0.0}))
        direct = InverseModel(replace(scene, effects=hidden), recordings)
        expected = direct.residual([damping])
        found = model.residual([*hidden, damping])
        # Both divide by the noise of a model that has other masses.
        found, expected = model.in_units(found), direct.in_units(expected)
        np.testing.assert_allclose(found, expected, atol=1e-9)
        assert np.abs(found - model.in_units(model.residual())).max() > 0.01


@pytest.mark.slow
def test_one_joint_among_quiet_ones_is_not_what_models_are_off_by(tmp_path):
    """Ripple is in no rich model: what is left of a joint must not become its noise."""
    recipe = Recipe("ripple", "scara", "multisine", "ripple")
    truth, result = found_in(tmp_path, recipe, 81)
    (hidden,), (named,) = truth["effects"], result.effects
    assert result.verdict == "gap_named"
    assert (named.kind, *named.at) == (hidden["kind"], hidden["at"])
    found, expected = named.parameters["amplitude"], hidden["parameters"]["amplitude"]
    np.testing.assert_allclose(found.value, expected, rtol=0.05)


def test_friction_of_both_joints_is_named_by_its_own_kinds(tmp_path):
    """Not by Stribeck's law for Coulomb's, and not by drag of a link for damping."""
    recipe = Recipe("friction", "planar", "multisine", "friction", ("ode",))
    truth, result = found_in(tmp_path, recipe, 78)
    assert result.verdict == "gap_named"
    hidden = {(e["kind"], e["at"]): e["parameters"] for e in truth["effects"]}
    named = {(e.kind, *e.at): e.parameters for e in result.effects}
    assert set(named) == set(hidden)
    for key, parameters in hidden.items():
        for name, value in parameters.items():
            estimate = named[key][name]
            # Five deviations: of four intervals none is this far off by chance.
            np.testing.assert_allclose(estimate.value, value, atol=5.0 * estimate.std)
            assert estimate.std < 0.1 * value

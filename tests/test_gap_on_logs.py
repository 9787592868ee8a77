"""Logs as robots write them, from files to verdict: of the benchmark's sorts, with
seeds of their own."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the logs are simulated in MuJoCo")

from gap_benchmark.log_cases import LogCase, Recipe, write  # noqa: E402

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
        ("planar", "first order"),
        ("planar", "moving average"),
        ("planar", "wander"),
        ("six", "velocity drive"),
    ],
)
def test_what_sensors_and_drives_do_is_no_gap(tmp_path, robot, option):
    """Noise that goes together over some samples, or over tenths of a second: as it is
    not known where an effort's noise is made, it must not repeat with the motion. And a
    drive's loop that holds its effort for half a millisecond."""
    recipe = Recipe("none", robot, "multisine guided", options=(option,))
    _, result = found_in(tmp_path, recipe, 77)
    assert (result.verdict, result.effects) == ("no_gap", [])


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

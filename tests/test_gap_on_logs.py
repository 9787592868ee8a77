"""Logs as robots write them, from files to verdict: of the benchmark's sorts, with
seeds of their own."""

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the logs are simulated in MuJoCo")

from gap_benchmark.log_cases import LogCase, Recipe, write  # noqa: E402

from makebreak.gap.workflow import run_gap  # noqa: E402


def found_in(folder, recipe, seed):
    """The truth, and what is found."""
    truth = write(LogCase("log", seed, recipe), folder)
    return truth, run_gap(folder / "scene.yaml", [folder / "recording.csv"])


@pytest.mark.parametrize("option", ["first order", "moving average", "wander"])
def test_filtered_velocities_and_wandering_efforts_are_no_gap(tmp_path, option):
    """Noise that goes together over some samples, or over tenths of a second: as it is
    not known where an effort's noise is made, it must not repeat with the motion."""
    recipe = Recipe("none", "planar", "multisine guided", options=(option,))
    _, result = found_in(tmp_path, recipe, 77)
    assert (result.verdict, result.effects) == ("no_gap", [])


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

"""Where an effort is measured, and as what: on the motor's or the link's side, or as a
current."""

import numpy as np
import pytest
from effect_scenes import LENGTH, MASS, G, J, pendulum, with_effects

from makebreak.gap.data.channel_noise import in_newton_metres
from makebreak.gap.data.reading import read_recording
from makebreak.gap.residuals.inverse import InverseModel
from makebreak.models.effects.measured_channels import torque_constant
from makebreak.models.scene_schema import check_scene

ROTOR, CONSTANT = 0.4, 0.11  # [kg m2], [N m/A]


def recorded(folder, rotor_in_effort: float, scale: float = 1.0):
    """A pendulum driven along a known motion; measured: its position and effort."""
    t = np.arange(0.0, 8.0, 0.005)
    w, size = np.array([1.1, 3.7]), np.array([0.7, 0.3])
    angle = w * t[:, None]
    q, a = np.sin(angle) @ size, -np.sin(angle) @ (size * w * w)
    effort = (J + rotor_in_effort) * a + MASS * G * LENGTH * np.sin(q)
    rng = np.random.default_rng(0)
    table = {
        "time": t,
        "p.j1.position": q + 1e-5 * rng.normal(size=len(t)),
        "p.j1.effort_measured": (effort + 1e-3 * rng.normal(size=len(t))) / scale,
    }
    rows = np.stack(list(table.values()), axis=1)
    np.savetxt(
        folder / "a.csv", rows, "%.12g", ",", header=",".join(table), comments=""
    )
    return read_recording(folder / "a.csv")


@pytest.mark.parametrize("side", ["link side", "motor side"])
@pytest.mark.parametrize("in_effort", [0.0, ROTOR], ids=["at the link", "at the motor"])
def test_a_rotor_is_in_efforts_of_the_motors_side_alone(tmp_path, side, in_effort):
    scene = with_effects(
        pendulum(tmp_path), ("rotor_inertia", "p.j1", dict(inertia=ROTOR))
    )
    scene.channels = {"effort_measured": side}
    model = InverseModel(scene, [recorded(tmp_path, in_effort)])
    error = float(np.sqrt(np.mean(model.base() ** 2)))
    right = (side == "link side") == (in_effort == 0.0)
    assert error < 1.5 if right else error > 50.0


def test_a_current_becomes_a_torque(tmp_path):
    recording = recorded(tmp_path, 0.0, CONSTANT)
    words = {"effort_measured": f"current, {CONSTANT} N m/A"}
    (out,) = in_newton_metres([recording], words)
    np.testing.assert_allclose(
        out["p.j1.effort_measured"], CONSTANT * recording["p.j1.effort_measured"]
    )
    ours, theirs = (r.channels["p.j1.effort_measured"] for r in (out, recording))
    assert ours.noise == pytest.approx(CONSTANT * theirs.noise, rel=1e-6)
    assert in_newton_metres([recording], {})[0] is recording


@pytest.mark.parametrize("words", ["current", "current, N m/A", "current, 0 N m/A"])
def test_a_current_without_its_constant_is_refused(tmp_path, words):
    scene = pendulum(tmp_path)
    scene.channels = {"p.j1.effort_measured": words}
    with pytest.raises(ValueError, match="expected a torque constant, as in"):
        check_scene(scene)


def test_a_constant_may_be_negative_and_written_with_an_exponent():
    words = {"effort_measured": "current -2.5e-1 Nm/A"}
    assert torque_constant(words, "p.j1.effort_measured") == -0.25

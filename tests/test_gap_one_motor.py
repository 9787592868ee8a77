"""One motor that turns a wheel: its gain, and the wheel's inertia."""

from pathlib import Path

import numpy as np
import pytest

from makebreak.gap.data.channel_noise import in_newton_metres
from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.workflow import run_gap
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

INERTIA, RATE, KT = 0.0045, 500.0, 0.062
GAIN = {"gain": 1.0}
URDF = (
    '<robot name="rig"><link name="frame"/><link name="wheel"><inertial><mass '
    f'value="0.8"/><inertia ixx="0.003" iyy="0.003" izz="{INERTIA}" ixy="0" ixz="0" '
    'iyz="0"/></inertial></link><joint name="axle" type="continuous"><parent '
    'link="frame"/><child link="wheel"/><axis xyz="0 0 1"/></joint></robot>'
)
SCENE = f"""\
directives:
  - add_model: {{name: rig, file: rig.urdf}}
  - add_weld: {{parent: world, child: "rig::frame"}}
actuation: {{type: effort, joints: [rig.axle]}}
channels: {{effort_measured: "current, {KT} N m/A"}}
"""


def turned(folder: Path, torque_constant: float, inertia: float) -> tuple[Path, Path]:
    """A wheel that swings in six sines, its current measured to 10 mA."""
    rng, t = np.random.default_rng(4), np.arange(0.0, 20.0, 1.0 / RATE)
    w, phase, size = (rng.uniform(*each, 6) for each in ((1, 9), (0, 6), (0.5, 2)))
    angle = w * t[:, None] + phase
    q = (size * np.sin(angle)).sum(axis=1)
    v = (size * w * np.cos(angle)).sum(axis=1)
    current = -inertia * (size * w**2 * np.sin(angle)).sum(axis=1) / torque_constant
    rows = np.column_stack([t, q, v, current])
    rows[:, 1:] += np.array([1e-4, 0.02, 0.01]) * rng.normal(size=(len(t), 3))
    names = ("position", "velocity", "effort_measured")
    header = ",".join(["time", *(f"rig.axle.{name}" for name in names)])
    np.savetxt(
        folder / "log.csv", rows, delimiter=",", header=header, comments="", fmt="%.9g"
    )
    (folder / "rig.urdf").write_text(URDF)
    (folder / "scene.yaml").write_text(SCENE)
    return folder / "scene.yaml", folder / "log.csv"


def problem_of(scene: Path, log: Path) -> MechanismProblem:
    read = read_scene(scene)
    recordings = in_newton_metres(read_recordings([log]), read.channels)
    return MechanismProblem(read, condition(recordings, True)[0])


@pytest.mark.parametrize("factor", [0.88, 1.15])
def test_a_motors_gain_is_as_it_is_and_as_well_as_the_mass_is_known(tmp_path, factor):
    """A lighter wheel with less gain leaves less of the noise: both at once shrank, by
    three times the mass's tolerance."""
    problem = problem_of(*turned(tmp_path, factor * KT, INERTIA))
    n = problem.nuisances()
    screen = Screen(problem.base(), n.columns, n.prior, problem.train(), reach=n.reach)
    fit = fit_effects(problem, screen, [Effect("actuator_gain", ["rig.axle"], GAIN)])
    assert fit.effects[0].parameters["gain"] == pytest.approx(factor, rel=0.005)
    std, _ = problem.widened(fit, 0)
    assert std["gain"] == pytest.approx(0.03 * factor, rel=0.05)  # 3 %, of the mass.


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.88, 1.15])
def test_a_gain_and_another_inertia_are_a_tie_of_one_motor(tmp_path, factor):
    scene, log = turned(tmp_path, factor * KT, INERTIA)
    result = run_gap(scene, [log])
    (effect,) = result.effects
    assert result.verdict == "ambiguous"
    both = {effect.kind, *(tie.kind for tie in effect.indistinguishable_from)}
    assert "actuator_gain" in both
    assert both & {"rotor_inertia", "link_mass", "payload"}


def test_the_tie_of_a_gain_has_the_inertia_that_takes_as_much(tmp_path):
    problem = problem_of(*turned(tmp_path, KT, INERTIA))
    tie = problem.inseparable(Effect("actuator_gain", ["rig.axle"], {"gain": 0.8}))
    assert tie.kind == "rotor_inertia"
    assert tie.parameters["inertia"] == pytest.approx(INERTIA / 4.0)
    for effect in (tie, Effect("link_mass", ["rig.wheel"], {"mass": 0.2})):
        back = problem.inseparable(effect)  # A quarter more, both.
        assert back.kind == "actuator_gain" and back.at == ["rig.axle"]
        assert back.parameters["gain"] == pytest.approx(0.8)

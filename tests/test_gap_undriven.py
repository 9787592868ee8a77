"""Mechanisms that nothing drives: masses are known up to a factor alone."""

from pathlib import Path

import numpy as np
import pytest

from makebreak.gap.workflow import run_gap

G, MASS, LENGTH, INERTIA = 9.81, 0.45, 0.32, 0.002
NOISE = 4e-4

URDF = (
    '<robot name="pendulum"><link name="base"/><link name="bob"><inertial>'
    f'<origin xyz="0 0 -{LENGTH}"/><mass value="{MASS}"/>'
    f'<inertia ixx="{INERTIA}" iyy="{INERTIA}" izz="{INERTIA}" ixy="0" ixz="0" '
    'iyz="0"/></inertial></link><joint name="hinge" type="continuous">'
    '<parent link="base"/><child link="bob"/><axis xyz="0 1 0"/></joint></robot>'
)
SCENE = """\
directives:
  - add_model: {name: pendulum, file: pendulum.urdf}
  - add_weld: {parent: world, child: "pendulum::base"}
plant: {time_step: 0.001}
"""


def released(folder: Path, coulomb: float, drag: float) -> tuple[Path, Path]:
    """Four releases of a pendulum with an encoder, and its scene without friction."""
    rng, dt, rows = np.random.default_rng(3), 1e-3, []

    def rate(x):
        effort = -MASS * G * LENGTH * np.sin(x[0]) - coulomb * np.tanh(x[1] / 5e-3)
        effort -= drag * x[1] * abs(x[1])
        return np.array([x[1], effort / (INERTIA + MASS * LENGTH**2)])

    for episode in range(4):
        x = np.array([rng.uniform(0.7, 1.4) * rng.choice([-1.0, 1.0]), 0.0])
        for k in range(6000):
            if k % 10 == 0:
                rows.append([k * dt, episode, x[0] + NOISE * rng.normal()])
            a = rate(x)
            b = rate(x + 0.5 * dt * a)
            c = rate(x + 0.5 * dt * b)
            x = x + dt / 6.0 * (a + 2.0 * b + 2.0 * c + rate(x + dt * c))
    (folder / "pendulum.urdf").write_text(URDF)
    (folder / "scene.yaml").write_text(SCENE)
    header = "time,episode,pendulum.hinge.position"
    np.savetxt(
        folder / "log.csv", rows, delimiter=",", header=header, comments="", fmt="%.9g"
    )
    return folder / "scene.yaml", folder / "log.csv"


@pytest.mark.parametrize(
    ("coulomb", "drag", "kind", "name"),
    [
        (0.025, 0.0, "joint_coulomb_friction", "coulomb"),
        (0.0, 0.006, "joint_quadratic_drag", "coefficient"),
    ],
)
def test_what_slows_a_free_pendulum_is_named(tmp_path, coulomb, drag, kind, name):
    """Without a mass its equation would leave nothing, so that a lighter bob, or a load
    of as much less than nothing, once explained all, and then nothing."""
    scene, log = released(tmp_path, coulomb, drag)
    result = run_gap(scene, [log])
    assert result.verdict == "gap_named"
    (effect,) = result.effects
    assert effect.kind == kind
    assert effect.parameters[name].value == pytest.approx(coulomb + drag, rel=0.06)
    assert not [n for n in result.background if "mass" in n]  # Nothing gives its size.


def test_a_free_pendulum_without_friction_is_no_gap(tmp_path):
    scene, log = released(tmp_path, 0.0, 0.0)
    assert run_gap(scene, [log]).verdict == "no_gap"

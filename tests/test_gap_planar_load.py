"""A load and dry friction at once, on an arm that moves in a plane."""

from pathlib import Path

import numpy as np
import pytest

from makebreak.gap.workflow import run_gap

G, L1 = 9.81, 0.35
# Of each link: mass, distance of its centre, moment of inertia about that.
LINKS = ((2.4, 0.17, 0.03), (1.5, 0.16, 0.02))
FRICTION = (0.3, 0.2)


def urdf() -> str:
    text = '<robot name="arm"><link name="base"/>'
    for name, (mass, along, inertia) in zip(("upper", "fore"), LINKS, strict=True):
        text += (
            f'<link name="{name}"><inertial><origin xyz="{along} 0 0"/><mass value='
            f'"{mass}"/><inertia ixx="0.003" iyy="{inertia}" izz="{inertia}" ixy="0" '
            'ixz="0" iyz="0"/></inertial></link>'
        )
    for name, parent, child, at in (
        ("shoulder", "base", "upper", 0.0), ("elbow", "upper", "fore", L1)
    ):  # fmt: skip
        text += (
            f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child '
            f'link="{child}"/><origin xyz="{at} 0 0"/><axis xyz="0 -1 0"/></joint>'
        )
    return text + "</robot>"


def efforts(q, v, a, load: float, at: float) -> np.ndarray:
    """(n, 2) by Lagrange's equations, with a point mass on the second link."""
    (m1, a1, i1), (m2, a2, i2) = LINKS
    m, s = m2 + load, (m2 * a2 + load * at) / (m2 + load)
    i = i2 + m2 * (a2 - s) ** 2 + load * (at - s) ** 2
    c, h = np.cos(q[:, 1]), m * L1 * s * np.sin(q[:, 1])
    m12 = i + m * (s**2 + L1 * s * c)
    m11 = i1 + i + m1 * a1**2 + m * (L1**2 + s**2 + 2.0 * L1 * s * c)
    far = m * s * G * np.cos(q.sum(axis=1))
    near = (m1 * a1 + m * L1) * G * np.cos(q[:, 0])
    first = m11 * a[:, 0] + m12 * a[:, 1] - h * v[:, 1] * (2.0 * v[:, 0] + v[:, 1])
    second = m12 * a[:, 0] + (i + m * s**2) * a[:, 1] + h * v[:, 0] ** 2
    return np.column_stack([first + near + far, second + far])


def recorded(folder: Path, load: float) -> tuple[Path, Path]:
    rng, t = np.random.default_rng(18), np.arange(0.0, 16.0, 0.004)
    q, v, a = (np.zeros((len(t), 2)) for _ in range(3))
    for joint in range(2):
        for _ in range(4):
            size, w, phase = rng.uniform(0.1, 0.3), rng.uniform(1, 6), rng.uniform(0, 6)
            q[:, joint] += size * np.sin(w * t + phase)
            v[:, joint] += size * w * np.cos(w * t + phase)
            a[:, joint] -= size * w**2 * np.sin(w * t + phase)
    u = efforts(q, v, a, load, 0.33) + np.array(FRICTION) * np.tanh(v / 5e-3)
    rows = np.column_stack([t, q, v, u])
    rows[:, 1:] += np.repeat([5e-5, 3e-3, 0.02], 2) * rng.normal(size=(len(t), 6))
    names = [
        f"arm.{joint}.{what}"
        for what in ("position", "velocity", "effort_measured")
        for joint in ("shoulder", "elbow")
    ]
    np.savetxt(
        folder / "log.csv", rows, delimiter=",", comments="", fmt="%.9g",
        header=",".join(["time", *names]),
    )  # fmt: skip
    (folder / "arm.urdf").write_text(urdf())
    (folder / "scene.yaml").write_text(
        "directives:\n  - add_model: {name: arm, file: arm.urdf}\n"
        "  - add_weld: {parent: world, child: 'arm::base'}\n"
        "actuation: {type: effort, joints: [arm.shoulder, arm.elbow]}\n"
    )
    return folder / "scene.yaml", folder / "log.csv"


def test_a_load_and_friction_are_named_together_and_no_gains_in_their_place(tmp_path):
    """Gains of both drives took first place, as gains below one make all that is left
    smaller; and where the load is across the plane, which nothing tells, went to 500
    m, so that it was dropped."""
    scene, log = recorded(tmp_path, 0.35)
    result = run_gap(scene, [log])
    assert result.verdict == "gap_named"
    load, *frictions = sorted(result.effects, key=lambda e: e.kind != "payload")
    assert load.kind == "payload" and load.at == ("arm.fore",)
    assert load.parameters["mass"].value == pytest.approx(0.35, abs=0.06)  # Links: 3 %.
    assert load.parameters["com_x"].value == pytest.approx(0.33, abs=0.03)
    assert load.parameters["com_y"].value == 0.0
    assert [e.kind for e in frictions] == 2 * ["joint_coulomb_friction"]
    found = {e.at[0]: e.parameters["coulomb"].value for e in frictions}
    assert found["arm.shoulder"] == pytest.approx(FRICTION[0], rel=0.02)
    assert found["arm.elbow"] == pytest.approx(FRICTION[1], rel=0.02)

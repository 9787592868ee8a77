"""The recording that `makebreak bench gap` is timed with."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from makebreak.benchmarks import sysid as bench_sysid
from makebreak.benchmarks.gap import (
    FRICTION,
    FRICTION_JOINT,
    POSITION_NOISE,
    RATE_HZ,
    record,
    sum_of_sines,
)
from makebreak.gap.data.reading import check_against_scene, read_recordings
from makebreak.gap.data.scene_facts import scene_names
from makebreak.models.scene import load_scene, read_scene


def test_the_arm_follows_its_sines_and_its_efforts_hold_friction(tmp_path):
    scene, path = record(tmp_path, seed=3, duration=2.0)
    [recording] = read_recordings([path])
    plant = load_scene(read_scene(scene), DiagramBuilder()).plant
    check_against_scene(recording, *scene_names(plant))
    names = [f"panda.panda_joint{i}" for i in range(1, 8)]
    q = np.stack([recording[f"{n}.position"] for n in names], axis=1)
    u = np.stack([recording[f"{n}.effort_command"] for n in names], axis=1)
    assert len(q) == 2.0 * RATE_HZ
    wanted = sum_of_sines(np.random.default_rng(3))
    time = recording.time
    q_d, v_d, vd_d = (np.stack(x) for x in zip(*map(wanted, time), strict=True))
    # Held back by friction over inertia over stiffness: 1.8/0.5/100 rad at most.
    assert abs(q - q_d)[:, FRICTION_JOINT].max() < 0.05
    others = [i for i in range(7) if i != FRICTION_JOINT]
    assert abs(q - q_d)[:, others].max() < 0.02
    # Its efforts along the way, less those of the wanted motion in a plant without
    # friction: in the mean friction, where the joint moves one way and fast.
    context = plant.CreateDefaultContext()
    extra = []
    for k in np.flatnonzero(abs(v_d[:, FRICTION_JOINT]) > 0.2):
        plant.SetPositions(context, q_d[k])
        plant.SetVelocities(context, v_d[k])
        forces = -plant.CalcGravityGeneralizedForces(context)
        forces += plant.CalcMassMatrix(context) @ vd_d[k]
        forces += plant.CalcBiasTerm(context)
        sign = np.sign(v_d[k, FRICTION_JOINT])
        extra.append(sign * (u[k] - forces)[FRICTION_JOINT])
    # It lags by 0.03 rad, so that it accelerates otherwise and gravity pulls otherwise.
    np.testing.assert_allclose(np.mean(extra[len(extra) // 3 :]), FRICTION, rtol=0.15)
    assert recording.channels[f"{names[0]}.position"].noise < 2.0 * POSITION_NOISE


NOMINAL = {"j1.damping": 0.02, "j1.friction": 0.02, "j1.rotor": 0.1,
           "b.load.mass": 0.01, "b.load.x": 0.2}  # fmt: skip
INTERVALS = dict.fromkeys(NOMINAL, 0.01)


def found(**values):
    names = {name.replace(".", "_"): name for name in NOMINAL}
    all_values = {"j1.damping": 0.0, "j1.friction": 0.0, "j1.rotor": 0.1,
                  "b.load.mass": 0.0, "b.load.x": 9.0}  # fmt: skip
    all_values |= {names[key]: value for key, value in values.items()}
    return bench_sysid.Fit(all_values, INTERVALS, NOMINAL, 1.0)


def hidden(kind, at, **parameters):
    return {"effects": [{"kind": kind, "at": at, "parameters": parameters}]}


def test_what_the_toolbox_finds_is_held_against_what_was_hidden():
    friction = hidden("joint_coulomb_friction", "a.j1", coulomb=0.5)
    errors, off, others = bench_sysid.compare(found(j1_friction=0.45), friction)
    # Damping, rotor and the load's mass; where a load of nothing sits is no question.
    assert errors == {"j1.friction": pytest.approx(0.1)} and (off, others) == (0, 3)
    _, off, _ = bench_sysid.compare(
        found(j1_friction=0.5, j1_damping=0.02, j1_rotor=0.08), friction
    )
    assert off == 2
    rotor = hidden("rotor_inertia", "a.j1", inertia=0.05)
    errors, off, _ = bench_sysid.compare(found(j1_rotor=0.16), rotor)
    assert errors == {"j1.rotor": pytest.approx(0.2)} and off == 0
    none = {"effects": []}
    assert bench_sysid.compare(found(), none) == ({}, 0, 4)
    assert bench_sysid.compare(found(b_load_mass=-0.02), none) == ({}, 1, 4)


def test_without_the_toolbox_one_row_says_so(monkeypatch):
    monkeypatch.setattr(bench_sysid, "available", lambda: False)
    monkeypatch.setattr(bench_sysid, "check", lambda which: None)
    [row] = bench_sysid.rows()
    assert "makebreak[sysid]" in row["note"] and "value" not in row


SMALL = """<robot name="a"><link name="base"/><link name="b"><inertial>
<origin xyz="0 0 -0.2"/><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.001"
ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j1" type="revolute">
<parent link="base"/><child link="b"/><axis xyz="0 1 0"/>
<limit lower="-6" upper="6" effort="50" velocity="50"/></joint>
<transmission name="t"><joint name="j1"/><actuator name="j1">
<drake:rotor_inertia value="0.02"/></actuator></transmission></robot>"""


def test_the_toolbox_finds_friction_in_a_pendulum_of_closed_form(tmp_path):
    """One joint that follows a sine: its effort is known without any simulator."""
    if not bench_sysid.available():
        pytest.skip("needs makebreak[sysid]")
    t = np.arange(0.0, 4.0, 0.005)
    q, v = np.sin(3 * t), 3 * np.cos(3 * t)
    # A held effort acts half a row late.
    late = t + 0.0025
    q_h, v_h, a_h = np.sin(3 * late), 3 * np.cos(3 * late), -9 * np.sin(3 * late)
    effort = (0.01 + 0.04 + 0.02) * a_h + 9.81 * 0.2 * np.sin(q_h)
    effort += 0.3 * np.sign(v_h) + 0.1 * v_h
    rows = {"time": t, "q": q[:, None], "v": v[:, None], "effort": effort[:, None],
            "measured_v": np.array([True])}  # fmt: skip
    problem = bench_sysid.Problem(SMALL, ["a.j1"], [rows], (3e-5, 3e-3), False, "b")
    got = bench_sysid.fit(problem).values
    assert got["j1.friction"] == pytest.approx(0.3, rel=0.05)
    assert got["j1.damping"] == pytest.approx(0.1, rel=0.1)

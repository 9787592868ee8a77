"""The benchmark of robots that follow commands (gap_benchmark/driven_cases.py)."""

import numpy as np
import pytest
import yaml

pytest.importorskip("mujoco")

from gap_benchmark.driven_cases import (  # noqa: E402
    LINK_MASS,
    SEEDS,
    _drawn,
    cases,
    inertias,
    make,
    mjcf_of,
    model_of,
    robot_of,
    run,
    write,
)
from gap_benchmark.motions import Motion  # noqa: E402
from gap_benchmark.robots import HARD  # noqa: E402

from makebreak.benchmarks.gap_scoring import score  # noqa: E402
from makebreak.gap.data.reading import check_against_scene, read_recording  # noqa: E402
from makebreak.gap.data.scene_facts import scene_names  # noqa: E402
from makebreak.models.dynamics import SceneDynamics  # noqa: E402
from makebreak.models.scene import read_scene  # noqa: E402

JOINTS = {"leg3": 3, "legs12": 12, "arm6": 6, "arm7": 7, "hand16": 16,
          "humanoid23": 23, "humanoid29": 29}  # fmt: skip


def of(part):
    return next(c for c in cases("driven") if part in c.name)


def test_there_are_enough_cases_of_each_robot_and_drive_and_seeds_are_apart():
    development, final = cases("driven"), cases("driven-final")
    assert len(development) == len(final) >= 40
    assert not {c.seed for c in development} & {c.seed for c in final}
    assert {c.robot for c in final} == set(JOINTS)
    assert {c.drive for c in final} == {"servo", "pd", "velocity", "effort"}
    hidden = [len(c.hide) for c in final]
    assert hidden.count(0) >= 8 and max(hidden) == 4
    assert abs(SEEDS["driven"] - SEEDS["driven-final"]) > 7 * len(final)


@pytest.mark.parametrize("kind", JOINTS)
def test_robots_have_their_joints_and_hang_together(kind):
    robot = robot_of(kind, np.random.default_rng(0))
    assert len(robot.joints) == JOINTS[kind]
    assert (inertias(robot) > 0.0).all()
    model, _, _ = model_of(robot, mjcf_of(robot))
    limbs = {"legs12": 4, "hand16": 4, "humanoid23": 3, "humanoid29": 3}.get(kind, 1)
    assert np.count_nonzero(model.body_parentid[1:] == 0) == limbs


def test_the_scene_is_the_world_but_for_what_is_hidden(tmp_path):
    # Drake's mass matrix of what was written, and MuJoCo's of what was drawn.
    case = of("legs12_pd_none")
    truth = write(case, tmp_path)
    dynamics = SceneDynamics(read_scene(tmp_path / "scene.yaml"))
    recording = read_recording(tmp_path / "recording.csv")
    check_against_scene(recording, *scene_names(dynamics.plant))
    robot, drive = _drawn(case, np.random.default_rng([case.seed, 0]))
    context = dynamics.plant.CreateDefaultContext()
    dynamics.plant.SetPositions(context, robot.middle)
    M = np.diag(dynamics.plant.CalcMassMatrix(context))
    np.testing.assert_allclose(M, inertias(robot), rtol=1e-6)
    scene = yaml.safe_load((tmp_path / "scene.yaml").read_text())
    np.testing.assert_allclose(scene["actuation"]["kp"], drive.kp)
    assert scene["tolerance"]["link_mass"] == LINK_MASS
    assert truth["verdicts"] == ["no_gap"]
    assert len(scene["effects"]) == 12  # The friction that is known.


def test_dry_friction_holds_a_joint_and_a_payload_pulls_it_down():
    case = of("leg3_servo_friction")
    robot, drive = _drawn(case, np.random.default_rng([case.seed, 0]))
    n, time = 3, 0.001 * np.arange(1500)
    still = np.zeros((len(time), n))
    goal = np.tile(robot.middle, (len(time), 1))
    goal[500:] += 0.02  # kp times this is less than the friction.
    motion = Motion(time, goal, still, still)
    friction = [{"kind": "joint_coulomb_friction", "at": joint,
                 "parameters": {"coulomb": float(kp)}}
                for joint, kp in zip(robot.joints, drive.kp, strict=True)]  # fmt: skip
    world = robot, robot, drive, HARD

    def moved(effects):
        q = run(*world, effects, np.zeros(n), motion)[1]
        return np.abs(q[-1] - q[490])

    assert (moved(friction) < 1e-3).all()
    assert (moved([]) > 0.015).all()
    load = {
        "kind": "payload",
        "at": "robot.leg2",
        "parameters": {"mass": 2.0, "com_x": 0.1, "com_y": 0.0, "com_z": -0.2},
    }
    held, free = (run(*world, e, np.zeros(n), motion)[1][-1] for e in ([load], []))
    assert np.abs(held - free).max() > 0.01


def test_a_case_is_a_function_of_its_seed():
    case = of("leg3_pd_friction")
    one, two = make(case), make(case)
    assert one[1:] == two[1:]
    for name, values in one[0].items():
        np.testing.assert_array_equal(values, two[0][name])
    assert all(e["needed"] for e in one[-1]["effects"])


def test_an_effect_at_a_model_counts_at_each_of_its_joints():
    hidden = [
        {"kind": "joint_coulomb_friction", "at": joint, "parameters": {"coulomb": 1.0}}
        for joint in ("r.a", "r.b")
    ]
    truth = {"name": "x", "verdict": "gap_named", "effects": hidden, "ties": []}
    found = {
        "kind": "joint_coulomb_friction",
        "at": "r",
        "parameters": {"coulomb": {"value": 1.1, "std": 0.1}},
    }
    result = {"verdict": "gap_named", "effects": [found]}
    got = score(truth, result, ["r.a", "r.b"])
    assert (got.named, got.extra, len(got.errors)) == (2, 0, 2)
    delay = {"kind": "input_delay", "at": "r", "parameters": {"delay": 0.01}}
    found = {**delay, "parameters": {"delay": {"value": 0.01, "std": 0.001}}}
    got = score({**truth, "effects": [delay]}, {**result, "effects": [found]}, ["r.a"])
    assert (got.named, got.extra) == (1, 0)

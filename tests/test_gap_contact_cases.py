"""The contact half of the benchmark: its cases, and that its worlds obey physics."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from gap_benchmark import log_cases
from gap_benchmark.cases import cases as one_by_one
from gap_benchmark.contact_cases import (
    RECIPES,
    SCENES,
    SEEDS,
    Recipe,
    block,
    contact_cases,
    dampers,
    height,
    hide,
    lying,
    table,
    write,
)
from gap_benchmark.contact_scenes import (
    DRAKE_STEP,
    STUCK,
    WORLDS,
    MujocoWorld,
    Setting,
    Thing,
    pair,
    pair_friction,
)
from scipy.integrate import solve_ivp

from makebreak.gap.data.reading import check_against_scene, read_recordings
from makebreak.gap.data.scene_facts import scene_names
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import read_scene
from makebreak.scripts.cli import main

G = 9.81


def nothing(t, q, v):
    return np.zeros(0)


def slid(world: str, friction: float, **changes) -> tuple[float, Thing]:
    """How far a block slides that starts at 0.4 m/s, and the block."""
    box = replace(block(np.random.default_rng(0)), **changes)
    feet = tuple(replace(x, friction=friction) for x in box.shapes)
    s = Setting((table(friction), replace(box, shapes=feet)))
    simulated = WORLDS[world](s)
    x = np.concatenate([lying(s.things[1], s, (0.0, 0.0), 0.0), [0.4, *np.zeros(5)]])
    simulated.reset(np.zeros(0), {"block.block": x})
    simulated.advance(nothing, 0.5)
    return float(simulated.pose("block.block")[0]), s.things[1]


def full_mass(m, d) -> np.ndarray:
    M = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, M)
    return M


def test_there_are_enough_cases_and_their_seeds_are_apart():
    development, final = (contact_cases(which) for which in SEEDS)
    every = development + final
    assert len(every) == 2 * len(RECIPES) >= 80
    assert len({c.seed for c in every}) == len({c.folder for c in every}) == len(every)
    assert len({c.name for c in final}) == len(RECIPES)
    scenes = {c.recipe.scene for c in final}
    assert scenes >= set(SCENES) and len(scenes) >= 8
    calm = {c.recipe.scene for c in final if not c.recipe.hide}
    assert calm >= set(SCENES)  # One of each with nothing hidden.
    assert {c.recipe.world for c in final} == {"mujoco", "ode", "drake"}
    options = {o for c in final for o in c.recipe.options}
    assert options >= {"camera30", "camera60", "no_wrench", "effort"}
    assert any(c.recipe.ties for c in final)
    assert any(len(c.recipe.hide.split()) == 2 for c in final)


def test_a_name_that_no_case_has_is_told_with_those_that_there_are(capsys):
    words = ["reproduce", "gap", "--set", "contact-final", "--only", "no_such_case"]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "--only: got no_such_case, expected part of: 00_push_mujoco_mass; " in said


def test_a_set_can_be_drawn_anew_from_another_seed():
    drawn = contact_cases("contact-final", 30)
    assert [c.seed for c in drawn] == list(range(30, 30 + len(RECIPES)))
    assert [c.recipe for c in drawn] == RECIPES
    logs = log_cases.cases("logs-final", 5), log_cases.cases("logs-final")
    assert [a.seed - 5 for a in logs[0]] == [b.seed - logs[1][0].seed for b in logs[1]]
    assert [c.seed for c in one_by_one("standard", 7)][:2] == [7, 8]


@pytest.mark.parametrize(
    "world",
    [pytest.param(w, marks=[pytest.mark.slow] * (w in ("drake_damped", "drake_lagged")))
     for w in sorted(WORLDS)],
)  # fmt: skip
def test_a_block_slides_as_far_as_friction_says(world):
    far, _ = slid(world, 0.3)
    assert far == pytest.approx(0.4**2 / (2.0 * 0.3 * G), rel=0.02)


@pytest.mark.parametrize("world", sorted(set(WORLDS) - {"mujoco"}))
def test_what_slides_in_drake_is_lifted_as_its_dissipation_says(world):
    """SAP takes the depth of what slides at v for larger by mu (tau + dt) v (Castro et
    al., IEEE Trans. Robotics 38(6), 2022, section V), other solvers do not. A ball
    that is soft as hydroelastic ones are carries (z^2 + 2 z mu (tau + dt) v) at a depth
    of z."""
    mu, v, seconds = 0.3, 0.4, 0.1
    box = block(np.random.default_rng(0))
    feet = tuple(replace(x, friction=mu) for x in box.shapes)
    s = Setting((table(mu), replace(box, shapes=feet)))

    def height_after(world: str, v: float, seconds: float) -> float:
        simulated = WORLDS[world](s)
        x = np.append(lying(s.things[1], s, (0.0, 0.0), 0.0), [v, *[0.0] * 5])
        simulated.reset(np.zeros(0), {"block.block": x})
        simulated.advance(nothing, seconds)
        return float(simulated.pose("block.block")[2])

    # How deep it lies at rest has nothing to do with what it dissipates.
    rest = height_after("drake" if world == "drake_damped" else world, 0.0, 0.3)
    depth = height(box) - rest
    # The scene's dissipation, 2 s/m, at a depth of 0.5 mm is a tau of 1 ms.
    tau = {"drake": 1e-3, "drake_damped": 0.2}.get(world)
    a = 0.0 if tau is None else mu * (tau + DRAKE_STEP) * (v - mu * G * seconds)
    lift = depth - (np.hypot(a, depth) - a)
    # By a fifth, as it was faster a while (tau) ago, and by how it still sinks in.
    assert height_after(world, v, seconds) - rest == pytest.approx(
        lift, rel=0.2, abs=2e-5
    )


def test_friction_of_a_tip_in_drake_is_what_was_hidden():
    """By Coulomb's law on the tool's and the object's own coefficients together."""
    rng = np.random.default_rng(1)
    s, _ = SCENES["push"](Recipe("push", "drake"), rng)
    true, (effect,) = hide(s, ["tip_friction"], rng)
    world = WORLDS["drake"](true).s
    value = effect["parameters"]["friction"]
    assert pair_friction(world.tool, world.free[0].shapes[0]) == pytest.approx(value)
    assert world.things == s.things


def test_a_block_that_lies_sinks_in_by_its_weight_and_stays():
    box = block(np.random.default_rng(1))
    s = Setting((table(0.3), box), stiffness=2e4)
    simulated = MujocoWorld(s)
    start = lying(box, s, (0.0, 0.0), 0.3)
    simulated.reset(np.zeros(0), {"block.block": start})
    simulated.advance(nothing, 0.4)
    np.testing.assert_allclose(simulated.pose("block.block"), start, atol=2e-6)


def test_on_a_tilted_table_a_smooth_block_slides_downhill():
    box = block(np.random.default_rng(1))
    box = replace(box, shapes=tuple(replace(x, friction=0.0) for x in box.shapes))
    s = Setting((replace(table(0.0), pitch=0.03), box))
    simulated = MujocoWorld(s)
    start = lying(box, s, (0.0, 0.0), 0.0)
    simulated.reset(np.zeros(0), {"block.block": start})
    simulated.advance(nothing, 0.4)
    moved = simulated.pose("block.block")[:3] - start[:3]
    along = np.array([np.cos(0.03), 0.0, -np.sin(0.03)])
    expected = 0.5 * G * np.sin(0.03) * 0.4**2 * along
    np.testing.assert_allclose(moved, expected, atol=2e-5)


def test_a_cart_leaves_a_wall_as_a_spring_throws_it():
    """Half a period of the true pair's spring, not of the scene's."""
    rng = np.random.default_rng(3)
    s, _ = SCENES["cart"](RECIPES[2], rng)
    s = replace(s, dissipation=0.0, springs={pair("cart.cart", "wall.wall"): 5e3})
    simulated = MujocoWorld(s)
    assert s.robot is not None and s.tool is not None
    gap = s.things[0].shapes[1].place[0] - 0.1 - s.tool.size[0]
    simulated.reset(np.array([gap]), {})
    simulated.data.qvel[simulated.v_at] = 0.3
    half = np.pi * np.sqrt(s.robot.bodies[0].mass / 5e3)
    simulated.advance(lambda t, q, v: np.zeros(1), 0.5 * half)
    q, v = simulated.state()
    assert q[0] - gap == pytest.approx(0.3 * half / np.pi, rel=0.02)
    assert abs(v[0]) < 0.01
    simulated.advance(lambda t, q, v: np.zeros(1), half)
    assert simulated.state()[1][0] == pytest.approx(-0.3, rel=0.03)


@pytest.mark.parametrize("scene", ["cart", "pendulum"])
def test_a_wall_is_the_spring_and_damper_that_it_is_said_to_be(scene):
    """MuJoCo has factors of its own for both, and takes the velocity of half a step
    ago: what a wall does is within 0.2 % of what the benchmark calls the truth."""
    rng = np.random.default_rng(12)
    s, _ = SCENES[scene](Recipe(scene, "mujoco"), rng)
    simulated = MujocoWorld(s)
    m, d = simulated.model, simulated.data
    k, c, six = s.stiffness, dampers(s), np.zeros(6)

    def touch(q, v):
        """(1,) how the distance changes with the joint; the distance; the force."""
        d.qpos[simulated.q_at], d.qvel[simulated.v_at] = q, v
        mujoco.mj_forward(m, d)
        mujoco.mj_contactForce(m, d, 0, six)
        return d.efc_J.reshape(-1, m.nv)[0, simulated.v_at], d.contact[0].dist, six[0]

    met = np.linspace(0.0, 1.0, 100001)
    for q0 in met:
        d.qpos[simulated.q_at] = q0
        mujoco.mj_fwdPosition(m, d)
        if d.ncon:
            break
    lever, dist, force = touch(q0 + 2e-3, np.array([0.3]))
    np.testing.assert_allclose(force, -k * dist - c * lever * 0.3, rtol=1e-3)
    # Thrown back: as an exact integration of the same spring and damper.
    simulated.reset(np.array([q0]), {})
    d.qvel[simulated.v_at] = 1.0
    mujoco.mj_forward(m, d)
    mass = 1.0 / float(np.linalg.inv(full_mass(m, d))[0, 0])
    (weight,) = d.qfrc_bias  # As it meets the wall.

    def motion(t, x):
        depth, rate = abs(lever[0]) * (x[0] - q0), abs(lever[0]) * x[1]
        push = max(k * depth + c * rate, 0.0) if depth > 0.0 else 0.0
        return [x[1], -(abs(lever[0]) * push + weight) / mass]

    seconds = 1.5 * np.pi * np.sqrt(mass / k) / abs(lever[0])
    simulated.advance(lambda t, q, v: np.zeros(1), seconds)
    x = solve_ivp(motion, (0, seconds), [q0, 1.0], rtol=1e-9, max_step=1e-5).y[:, -1]
    _, v = simulated.state()
    assert v[0] < -0.5 and v[0] == pytest.approx(x[1], rel=2e-3)


def test_what_is_hidden_changes_the_world_by_what_is_said():
    rng = np.random.default_rng(4)
    s, _ = SCENES["push"](RECIPES[0], rng)
    for name, value in {
        "mass": lambda t: t.thing("block").mass,
        "friction": lambda t: t.friction[pair("block.block", "table.table")],
        "drag": lambda t: t.drag["block.block"],
    }.items():
        true, (effect,) = hide(s, [name], rng)
        assert value(true) == pytest.approx(next(iter(effect["parameters"].values())))
    box, ground = s.thing("block"), s.thing("table")
    assert pair_friction(box.shapes[-1], ground.shapes[0]) == pytest.approx(
        box.shapes[-1].friction
    )


def test_a_force_sensor_shows_what_the_drive_holds():
    """A tip rests against a block that sticks: no net force. From one step of MuJoCo to
    the next friction alternates by far more, which no sensor would show."""
    rng = np.random.default_rng(710_003)
    s, episodes = SCENES["push"](Recipe("push", "mujoco"), rng)
    e = episodes(s, rng)[0]
    simulated = MujocoWorld(s)
    simulated.reset(e.q, e.poses)
    for t in np.arange(0.0, 1.4, 0.004):
        command = e.command(t, None, None)

        def effort(_, q, v, command=command):
            return s.kp * (command[:2] - q) + s.kd * (command[2:] - v)

        simulated.advance(effort, t + 0.004)
    q, v = simulated.state()
    holds = effort(0.0, q, v)
    assert np.abs(v).max() < 1e-3 and np.linalg.norm(holds) > 2.0
    np.testing.assert_allclose(simulated.wrench()[:2], -holds, atol=0.03)
    assert np.abs(simulated._wrench_now()[:2] + holds).max() > 0.3


def test_a_tool_that_adheres_holds_on_and_lets_go():
    rng = np.random.default_rng(5)
    s, _ = SCENES["push"](RECIPES[0], rng)
    s = replace(s, adhesion=2.0)
    simulated = MujocoWorld(s)
    box = s.thing("block")
    reach = box.shapes[0].size[0] + 0.012
    pose = {"block.block": lying(box, s, (0.0, 0.0), 0.0)}
    for gap, holds in ((-1e-5, True), (2 * STUCK, False)):
        simulated.reset(np.array([reach + gap, 0.0]), pose)
        simulated.data.qpos[simulated.q_at[0]] += 0.5 * STUCK if holds else 0.0
        mujoco.mj_forward(simulated.model, simulated.data)
        simulated._stuck = holds
        simulated._forces()
        pull = simulated.data.xfrc_applied[simulated.model.body("tip").id, 0]
        assert bool(pull < -1.9) is holds


@pytest.fixture
def short(monkeypatch):
    """One episode of each scene."""
    for name, make in dict(SCENES).items():

        def shorter(recipe, rng, make=make):
            s, episodes = make(recipe, rng)
            return s, lambda true, rng: [
                replace(e, seconds=0.3) for e in episodes(true, rng)[:1]
            ]

        monkeypatch.setitem(SCENES, name, shorter)


@pytest.mark.parametrize("scene", sorted(SCENES))
def test_a_case_is_a_function_of_its_seed_and_holds_no_truth(short, tmp_path, scene):
    case = next(c for c in contact_cases("contact-development")
                if c.recipe.scene == scene and c.recipe.world == "mujoco"
                and c.recipe.hide)  # fmt: skip
    truth = write(case, tmp_path / "one")
    assert truth == write(case, tmp_path / "two")
    texts = {p.name: p.read_text() for p in (tmp_path / "one").iterdir()}
    assert texts == {p.name: p.read_text() for p in (tmp_path / "two").iterdir()}
    assert json.loads(json.dumps(truth)) == truth
    for text in texts.values():
        for effect in truth["effects"]:
            assert case.name not in text
            for value in effect["parameters"].values():
                assert repr(value)[:12] not in text
    recording = read_recordings([tmp_path / "one/recording.csv"])[0]
    plant = SceneDynamics(read_scene(tmp_path / "one/scene.yaml")).plant
    check_against_scene(recording, *scene_names(plant))

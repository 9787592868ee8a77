"""Equations of motion with permitted contact forces, on pushes of another simulator."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from gap_benchmark import contact_cases, contact_scenes, push_world
from gap_benchmark.contact_scenes import Sensing, record, write_scene
from gap_benchmark.push_world import BLOCK, TABLE
from push_problems import pushed_problem, screen_of
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame
from scipy.optimize import least_squares
from scipy.sparse import eye_array
from scipy.spatial.transform import Rotation

from makebreak.gap import confirm
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.fit import _Free, fit_effects
from makebreak.gap.numerics import permitted_forces
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Outcome, SearchPlan, is_sane
from makebreak.gap.residuals import touching
from makebreak.gap.residuals.contact_candidates import _best_rectangles
from makebreak.gap.residuals.contact_dynamics import ContactDynamics
from makebreak.gap.residuals.contact_means import ContactMeans, variance_of_means
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.permitted_contacts import Shift
from makebreak.gap.residuals.wrench_sensor import felt_motion
from makebreak.gap.result import Considered, GapMeasure
from makebreak.gap.search import chosen_by_simulation
from makebreak.gap.search.choice import Choice, Selection
from makebreak.gap.simulation import contact_windows
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.contact_shapes import _Point, _Surface
from makebreak.gap.simulation.contact_windows import PushWindows, led_as_measured
from makebreak.gap.simulation.windows import WindowModel
from makebreak.gap.workflow import problem_for, run_gap
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, check_parameters
from makebreak.models.scene import read_scene

PAIR = f"{BLOCK}~{TABLE}"


def pushed(folder, seed, kinds, sign=None, episodes=3, **how):
    """The scene, recordings and truth of a few pushes."""
    rng = np.random.default_rng(seed)
    world = push_world.a_world(rng)
    truth = push_world.with_hidden(world, kinds, rng, sign)
    table, noise = push_world.record(truth, rng, episodes=episodes, **how)
    scene = push_world.write(folder, world, table, noise)
    return read_scene(scene), read_recordings([folder / "recording.csv"]), truth


def fitted(model: ContactDynamics, kind: str, at: str, start: dict, names) -> dict:
    """The parameters that leave least, and how much is left before and after."""
    scale = np.array([max(abs(start[n]), 0.01) for n in names])

    def cost(z):
        p = start | dict(zip(names, map(float, z * scale), strict=True))
        return model.left([Effect(kind, [at], p)]).ravel()

    x0 = np.array([start[n] for n in names]) / scale
    found = least_squares(cost, x0, diff_step=1e-3, max_nfev=8)
    left = np.sqrt(np.mean(cost(x0) ** 2)), np.sqrt(np.mean(found.fun**2))
    return dict(zip(names, found.x * scale, strict=True)), left


@pytest.mark.parametrize("sign", [pytest.param(-1.0, marks=pytest.mark.slow), 1.0])
@pytest.mark.parametrize("wrench", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_friction_is_measured_by_what_forces_cannot_explain(tmp_path, sign, wrench):
    scene, recordings, truth = pushed(
        tmp_path, 11, ["contact_friction"], sign, wrench=wrench
    )
    model = ContactDynamics(scene, recordings)
    start = {
        "friction": SceneDynamics(scene).now("contact_friction", [PAIR])["friction"]
    }
    found, (before, after) = fitted(
        model, "contact_friction", PAIR, start, ["friction"]
    )
    assert found["friction"] == pytest.approx(truth.friction, rel=0.02)
    assert after < 0.6 * before


@pytest.mark.parametrize("sign", [-1.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_mass_is_measured(tmp_path, sign):
    scene, recordings, truth = pushed(tmp_path, 12, ["object_mass"], sign)
    model = ContactDynamics(scene, recordings)
    mass = SceneDynamics(scene).now("object_mass", [BLOCK])
    found, (before, after) = fitted(model, "object_mass", BLOCK, mass, ["mass"])
    assert found["mass"] == pytest.approx(truth.mass, rel=0.04)
    assert after < 0.7 * before


def test_tilt_of_the_table_is_measured(tmp_path):
    scene, recordings, truth = pushed(tmp_path, 13, ["plane_tilt"])
    model = ContactDynamics(scene, recordings)
    zero = {"roll": 0.0, "pitch": 0.0}
    found, (before, after) = fitted(model, "plane_tilt", TABLE, zero, list(zero))
    tenth = np.deg2rad(0.1)
    assert found["roll"] == pytest.approx(truth.roll, abs=tenth)
    assert found["pitch"] == pytest.approx(truth.pitch, abs=tenth)
    assert after < 0.6 * before


@pytest.mark.slow
def test_camera_noise_does_not_pull_the_mass_down(tmp_path, monkeypatch):
    """Noise of the pose is in what the mass multiplies. With the expected acceleration
    in its place (regression calibration), and rows weighed by the mass that is tried,
    mass and friction, fitted together, are right to 1 %; without either not."""
    scene, recordings, truth = pushed(tmp_path, 14, ["object_mass"], 1.0)
    dynamics = SceneDynamics(scene)
    mass = dynamics.now("object_mass", [BLOCK])["mass"]
    mu = dynamics.now("contact_friction", [PAIR])["friction"]

    def off() -> float:
        model = ContactDynamics(scene, recordings)

        def cost(z):
            return model.left([
                Effect("object_mass", [BLOCK], {"mass": float(z[0] * mass)}),
                Effect("contact_friction", [PAIR], {"friction": float(z[1] * mu)}),
            ]).ravel()  # fmt: skip

        both = least_squares(cost, [1.0, 1.0], diff_step=1e-3, max_nfev=8).x
        return both[0] * mass / truth.mass - 1.0

    def as_measured(self, v):
        var = self.means.acceleration_var
        return self.means.acceleration.copy(), var[:, :, None] * np.eye(var.shape[1])

    assert abs(off()) < 0.01
    own = ContactDynamics._root
    monkeypatch.setattr(ContactDynamics, "_root", lambda self, effects: own(self, ()))
    assert off() < -0.03
    monkeypatch.setattr(ContactDynamics, "_root", own)
    monkeypatch.setattr(ContactDynamics, "_expected_acceleration", as_measured)
    assert off() < -0.015


def test_rows_are_weighed_by_the_noise_of_the_model_that_is_tried(tmp_path):
    """A mass times 1.5 makes the same noise of the camera 1.5 times the force; a drive
    that gives two thirds of its effort errs by two thirds of it. With other weights the
    one that makes all forces smaller would win."""
    scene, recordings, _ = pushed(tmp_path, 12, [], episodes=3)
    model = ContactDynamics(scene, recordings)
    mass = SceneDynamics(scene).now("object_mass", [BLOCK])["mass"]

    def covariance(effects):
        inverse = np.linalg.inv(model._root(effects))
        return inverse @ inverse.transpose(0, 2, 1)

    plain = covariance(())
    heavy = covariance([Effect("object_mass", [BLOCK], {"mass": 1.5 * mass})])
    weak = covariance([Effect("actuator_gain", ["tip.x"], {"gain": 2.0 / 3.0})])
    i = [k for k, c in enumerate(model.coordinates) if c.startswith(BLOCK)]
    j = model.coordinates.index("tip.x")
    every = np.ix_(range(len(plain)), i, i)
    np.testing.assert_allclose(heavy[every], 1.5**2 * plain[every], rtol=1e-6)
    np.testing.assert_allclose(heavy[:, j, j], plain[:, j, j])
    moves = (model._M @ model._a_covariance @ model._M.transpose(0, 2, 1))[:, j, j]
    np.testing.assert_allclose(
        weak[:, j, j] - moves, (2.0 / 3.0) ** 2 * (plain[:, j, j] - moves), rtol=1e-6
    )


def test_where_nothing_is_hidden_nothing_is_left(tmp_path):
    scene, recordings, _ = pushed(tmp_path, 15, [])
    problem, _ = problem_for(scene, recordings, SceneDynamics(scene))
    assert isinstance(problem, ContactProblem)
    assert problem.noise_error(problem.base()) < 1.15
    judged = problem.judged()
    for recording in recordings:
        for channel in recording.measured():
            assert judged[channel.name] != "not"


def test_a_table_that_is_elsewhere_shows_in_the_distance_and_not_in_forces(tmp_path):
    scene, recordings, _ = pushed(tmp_path, 15, [])
    model = ContactDynamics(scene, recordings)
    names = model.row_names()
    k = names.index(f"{PAIR}.distance")
    plain = model.left()
    moved = model.left([Effect("plane_height", [TABLE], {"height": 2e-3})])
    shown = plain[:, k] != 0.0
    change = moved[shown, k] - plain[shown, k]
    # 2 mm over what shape (0.2 mm) and pose (half of 0.3 mm) are known to.
    np.testing.assert_allclose(np.abs(change), 2e-3 / np.hypot(2e-4, 1.5e-4), rtol=0.05)
    forces = slice(0, len(model.coordinates))
    np.testing.assert_allclose(moved[:, forces], plain[:, forces], atol=0.05)


def test_a_camera_s_error_moves_what_touches(tmp_path):
    scene, recordings, _ = pushed(tmp_path, 15, [], episodes=2)
    model = ContactDynamics(scene, recordings)
    _, plain = model._slots(())
    (body,) = [k for k, name in model.shapes.names.items() if name == BLOCK]
    R, p = plain[body]
    _, i_v, *_ = model.bodies[BLOCK]
    place, turn, late = (2e-3, -1e-3, 3e-3), (0.0, 0.0, 0.02), 0.004
    shift = Shift(BLOCK, place, turn, late)
    slots, moved = model._slots((), shift)
    v = model._node_v[:, i_v + 3 : i_v + 6]
    assert np.abs(v).max() > 0.05
    np.testing.assert_allclose(moved[body][1], p + place + late * v, atol=1e-12)
    # A turn in world comes after the body's own.
    np.testing.assert_allclose(
        moved[body][0], Rotation.from_rotvec(turn).as_matrix() @ R, atol=1e-12
    )
    # Up by 3 mm: so much further from the table. The others stay.
    before = {s.key: s.phi for s in model._slots(())[0]}
    on_table = [s for s in slots if model.pair_name(model._pair_of(s)) == PAIR]
    assert on_table
    for s in on_table:
        up = s.phi - before[s.key]
        np.testing.assert_allclose(up, 3e-3 + late * v[:, 2], atol=1e-4)
    for k, (turned, at) in moved.items():
        if k != body:
            np.testing.assert_array_equal(turned, plain[k][0])
            np.testing.assert_array_equal(at, plain[k][1])


def test_a_pose_without_orientation_is_refused(tmp_path):
    scene, recordings, _ = pushed(tmp_path, 15, [], episodes=2)
    (recording,) = recordings
    blind = replace(recording, channels={
        name: c for name, c in recording.channels.items() if not name.endswith(".qw")
    })  # fmt: skip
    with pytest.raises(ValueError, match="expected the whole pose of block.block"):
        ContactDynamics(scene, [blind])


@pytest.mark.slow
def test_a_side_of_a_patch_that_nothing_crosses_is_said_not_to_be_known(tmp_path):
    """The patch reaches far beyond where the block is pushed on one side."""
    rng = np.random.default_rng(18)
    world = push_world.a_world(rng)
    sides = {"x_min": 0.0, "x_max": 0.6, "y_min": -0.05, "y_max": 0.04}
    mu = 1.7 * world.friction
    truth = replace(world, patch=(mu, *sides.values()))
    problem = pushed_problem(tmp_path, world, truth, rng, 5)
    screen = screen_of(problem)
    patch = Effect("friction_patch", [PAIR], {"friction": mu, **sides})
    end = fit_effects(problem, screen, [patch], [tuple(sides)])
    assert problem.reweigh(end)  # As the search does with what it has chosen.
    std, _ = problem.widened(end, 0)
    assert std["x_max"] == np.inf
    # No foot comes near this one, as these pushes go; across the others they do.
    assert 0.004 <= std["x_min"] < np.inf
    assert max(std["y_min"], std["y_max"]) <= 0.002
    # A fit that has wandered off comes back to where something slid.
    places = problem._slid_over(next(p for p in problem._pairs_met
                                     if problem.pair_name(p) == PAIR))  # fmt: skip
    far = replace(patch, parameters={**patch.parameters, "x_max": 40.0})
    assert problem.prior_rows([patch]).max() < 0.1 * problem.prior_rows([far]).max()
    (back,) = fit_effects(problem, screen, [far]).effects
    assert places[:, 0].max() < back.parameters["x_max"] < places[:, 0].max() + 0.2
    assert back.parameters["y_min"] == pytest.approx(sides["y_min"], abs=0.004)


def free_patch(friction: float) -> _Free:
    """What a fit may move of a patch."""
    return _Free(
        SimpleNamespace(least=lambda kind, at: {}),
        [Effect("friction_patch", [PAIR], {"friction": friction, "x_min": 0.0,
                "x_max": 0.1, "y_min": 0.0, "y_max": 0.1})], [()],
    )  # fmt: skip


def test_no_fit_goes_where_a_parameter_is_refused():
    """Nothing shows where a patch's side is that nothing slid across."""
    free = free_patch(0.4)
    (far,) = free.effects(free.x0 / free.scale + np.array([0.0, -1e9, 1e9, 0.0, 0.0]))
    check_parameters(far, KINDS["friction_patch"])
    assert far.parameters["x_max"] == KINDS["friction_patch"].parameter("x_max").most


def test_of_a_friction_s_deviation_held_out_rows_are_asked(tmp_path, monkeypatch):
    """A fitted row that the friction alone would explain makes it no better known."""
    scene, recordings, _ = pushed(tmp_path, 15, [], episodes=2)
    problem = ContactProblem(scene, recordings)
    screen = screen_of(problem)
    friction = Effect("contact_friction", [PAIR], {"friction": 0.5})
    end = fit_effects(problem, screen, [friction], [("friction",)])
    # Less than the scene's: more than that might be known from below.
    best = 0.9 * problem.dynamics.now("contact_friction", [PAIR])["friction"]
    friction = replace(friction, parameters={"friction": best})
    fitted, end = problem.train(), replace(end, effects=[friction])
    assert fitted.any() and not fitted.all()
    calm = problem.nuisances().columns @ end.b

    def deviation(rows) -> float:
        """Where the rows (n,) want the friction as it is, and others nothing."""

        def residual(effects):
            off = effects[0].parameters["friction"] - best
            return calm + 1e4 * off * rows / np.sqrt(rows.sum())

        monkeypatch.setattr(problem, "residual", residual)
        return problem.widened(end, 0)[0]["friction"]

    assert deviation(fitted) == np.inf
    assert deviation(~fitted) < 0.01
    monkeypatch.setattr(problem, "_train", np.ones_like(problem._train))
    assert deviation(fitted) < 0.01  # Nothing is held out: what there is is asked.


def test_a_patch_of_all_that_was_slid_over_is_friction_and_is_known_to_be(tmp_path):
    """Else it is named in place of the friction with another effect beside it."""
    scene, recordings, _ = pushed(tmp_path, 15, [], episodes=3)
    model = ContactDynamics(scene, recordings)
    wide = {"x_min": -1.0, "x_max": 1.0, "y_min": -1.0, "y_max": 1.0}
    patch = model.left([Effect("friction_patch", [PAIR], {"friction": 0.5, **wide})])
    plain = model.left([Effect("contact_friction", [PAIR], {"friction": 0.5})])
    np.testing.assert_allclose(patch, plain, atol=1e-6)
    assert "contact_friction" in KINDS["friction_patch"].contains


def test_rectangles_of_cells_are_those_of_brute_force():
    rng = np.random.default_rng(0)
    cells, r = rng.normal(size=(4, 3, 50)), rng.normal(size=50)
    r += 0.3 * cells[1:3, 0:2].sum(axis=(0, 1))
    (c, box), *_ = _best_rectangles(cells, r, 0.5)
    assert box == (1, 3, 0, 2)
    x = cells[1:3, 0:2].sum(axis=(0, 1))
    assert c == pytest.approx(x @ r / (x @ x))


def test_a_place_that_explains_less_is_among_the_rectangles_too():
    """Of feet in a fixed pattern one is over another place whenever one is over the
    patch. Where the wrong place does better in the fitted rows, many rectangles about
    it do so, and the right one must still be tried."""
    rng = np.random.default_rng(1)
    cells, r = 0.05 * rng.normal(size=(12, 12, 400)), 0.1 * rng.normal(size=400)
    wrong, right = rng.normal(size=(2, 400))
    cells[7:11, 7:11] += wrong / 16
    cells[1:3, 1:3] += right / 4
    r += 0.3 * wrong - 0.15 * right
    boxes = [box for _, box in _best_rectangles(cells, r, 0.5)]
    assert boxes[0][0] >= 6 and boxes[0][2] >= 6
    assert any(box[1] <= 4 and box[3] <= 4 for box in boxes)


def test_a_patch_s_friction_ends_where_surfaces_do():
    """A corner of a patch with friction of 45 leaves as little in few rows."""
    free = free_patch(45.0)
    assert free.x0[0] <= free.high[0] == 1.5
    assert np.isinf(free.high[1:]).all()


@pytest.mark.parametrize(("mass", "friction"), [(4.0, 1.6), (4.0, 3.9), (1.2, 0.5)])
def test_simulation_decides_between_what_equations_find_alike(
    monkeypatch, mass, friction
):
    """The rival is taken where the chosen effect still leaves a gap in simulation and
    the rival clearly less."""
    chosen = Effect("object_mass", [BLOCK], {"mass": 1.0})
    rival = Considered("contact_friction", (PAIR,), 0.21, {"friction": 0.2})
    worse = Considered("actuator_gain", ("tip.x",), 0.9, {"gain": 1.1})
    first = Considered("object_mass", (BLOCK,), 0.2, {"mass": 1.0})
    asked = []

    def outcome(effects, *_, **__):
        asked.append(effects[0].kind)
        left = mass if effects[0].kind == "object_mass" else friction
        return Outcome(GapMeasure(60.0, left, 1.0, 0.6))

    def fit(problem, screen, start, *_):
        return SimpleNamespace(effects=tuple(start), std=({},), score=1.1)

    monkeypatch.setattr(chosen_by_simulation, "fit_effects", fit)
    problem = SimpleNamespace(
        plan=SearchPlan(simulation_agrees=True), outcome=outcome, softer=list,
        sizes=None,
    )  # fmt: skip
    choice = Choice(chosen, {}, 5.0, 1.0, "", 0.0, (), (), 1)
    nothing = SimpleNamespace()
    selection = Selection(
        (choice,), nothing, nothing, nothing, (first, rival, worse)
    )  # fmt: skip
    monkeypatch.setattr(Selection, "screen", lambda self, problem: None)
    got, after = chosen_by_simulation.chosen_by_simulation(problem, selection, 1)
    taken = got.choices[0].effect.kind
    if mass > 1.5 and friction < 0.8 * mass:
        assert (taken, after.gap.after) == ("contact_friction", friction)
    else:
        assert (taken, after.gap.after) == ("object_mass", mass)
    assert asked[1:] == (["contact_friction"] if mass > 1.5 else [])


@pytest.mark.slow
def test_a_force_sensor_that_is_read_with_the_commands_sees_their_ripple(
    tmp_path, monkeypatch
):
    """Each command is a step of the drive's effort, and the sensor is read just after
    it. Taken for the mean, that is a lighter block."""
    monkeypatch.setattr(contact_scenes, "FELT_STEPS", 2)  # With hardly a filter.
    truth = contact_cases.write(contact_cases.contact_cases("contact-development")[0],
                                tmp_path)  # fmt: skip
    (hidden,) = truth["effects"]
    scene = read_scene(tmp_path / "scene.yaml")
    recordings = read_recordings([tmp_path / "recording.csv"])

    def off() -> float:
        problem = ContactProblem(scene, recordings)
        n = problem.nuisances()
        rows = (problem.base(), n.columns, n.prior, problem.train())
        start = Effect(hidden["kind"], [hidden["at"]], dict(hidden["parameters"]))
        fit = fit_effects(problem, Screen(*rows, reach=n.reach), [start])
        return fit.effects[0].parameters["mass"] / start.parameters["mass"] - 1.0

    assert abs(off()) < 0.004
    monkeypatch.setattr(ContactProblem, "_ripple", lambda self, welded: np.zeros(
        (len(self.means.time), 3)))  # fmt: skip
    assert off() < -0.005


@pytest.mark.slow
def test_a_rail_s_friction_is_that_of_a_joint_that_moves(tmp_path, monkeypatch):
    """While a motion sets in or ends within a mean, the mean of the friction is not
    the friction at the mean velocity; and at rest friction is anything. Each taken
    otherwise makes the friction 0.6 to 5 % wrong."""
    case = contact_cases.contact_cases("contact-development", 1016000)[31]
    (hidden,) = contact_cases.write(case, tmp_path)["effects"]
    problem = ContactProblem(
        read_scene(tmp_path / "scene.yaml"),
        read_recordings([tmp_path / "recording.csv"]),
    )
    true = hidden["parameters"]["coulomb"]

    def off(model: ContactProblem) -> float:
        n = model.nuisances()
        rows = (model.base(), n.columns, n.prior, model.train())
        start = Effect(hidden["kind"], [hidden["at"]], {"coulomb": 0.9 * true})
        fit = fit_effects(model, Screen(*rows, reach=n.reach), [start])
        return fit.effects[0].parameters["coulomb"] / true - 1.0

    with_rest = off(problem)
    monkeypatch.setattr(ContactProblem, "_held", lambda self, effects: np.zeros(
        self.means.acceleration.shape))  # fmt: skip
    assert abs(with_rest) < 0.004 and off(problem) > 0.005


@pytest.mark.slow
def test_a_robot_without_commands_is_led_as_it_was_measured(tmp_path, monkeypatch):
    """Its measured efforts, at 250 Hz, miss what an impact does between two rows: with
    them as the input the robot is soon elsewhere, and the object with it."""
    rng = np.random.default_rng(61)
    scene, episodes = contact_cases.pushed(contact_cases.RECIPES[3], rng)
    true = replace(scene, smooth=True)
    look = Sensing(effort=0.05, wrench=None)
    table, noise = record(true, "mujoco", episodes(true, rng)[:2], look, rng)
    write_scene(tmp_path, replace(scene, drive="effort"), table, noise, 0.0005, {})
    scene = read_scene(tmp_path / "scene.yaml")
    recordings = read_recordings([tmp_path / "recording.csv"])

    def errors() -> float:
        windows = PushWindows(scene, recordings)
        assert {c.rsplit(".", 1)[0] for c in windows.channels} >= {"block.block"}
        rows = windows.errors(windows.simulate(()))
        k = [c.startswith("block") for c in windows.channels]
        return float(np.sqrt(np.nanmean(np.concatenate(rows)[:, k] ** 2)))

    assert errors() < 1.2
    assert led_as_measured(scene, recordings)[1] == ["pusher.x", "pusher.y"]
    monkeypatch.setattr(contact_windows, "led_as_measured", lambda s, r: (s, []))
    monkeypatch.setattr(PushWindows, "_given", WindowModel._given)
    assert errors() > 2.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "kind", "parameter", "tolerance"),
    [(31, "contact_friction", "friction", 0.02), (32, "object_mass", "mass", 0.04)],
)
def test_from_files_to_the_effect_by_name(tmp_path, seed, kind, parameter, tolerance):
    _, _, truth = pushed(tmp_path, seed, [kind], episodes=10)
    result = run_gap(tmp_path / "scene.yaml", [tmp_path / "recording.csv"])
    assert result.verdict == "gap_named"
    (effect,) = result.effects
    assert effect.kind == kind
    assert effect.parameters[parameter].value == pytest.approx(
        truth.hidden[0]["parameters"][parameter], rel=tolerance
    )


@pytest.mark.slow
def test_from_files_to_no_gap(tmp_path):
    pushed(tmp_path, 33, [], episodes=10)
    result = run_gap(tmp_path / "scene.yaml", [tmp_path / "recording.csv"])
    assert (result.verdict, result.effects) == ("no_gap", [])


@pytest.mark.parametrize("seed", range(5))
def test_the_side_of_a_cylinder_is_met_where_it_is_nearest(seed):
    """Upright beside a box, both turned anyhow about the vertical: in the plane a
    circle and a rectangle."""
    rng = np.random.default_rng(seed)
    r, h, half = rng.uniform(0.03, 0.08), 0.03, np.array([0.06, 0.05, 0.04])
    up, zero = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    rim = _Point(1, "disc", h * up, 0.0, 0.3, 1e4, axis=up, rim=r)
    fixed = _Point(1, "disc", h * up + [r, 0.0, 0.0], 0.0, 0.3, 1e4, axis=up)
    box = _Surface(2, "box", "box", np.eye(3), zero, (half,), 0.3, 1e4)
    yaw, turn = rng.uniform(-np.pi, np.pi, (2, 6))
    angle = rng.uniform(-np.pi, np.pi, 6)
    p = 0.15 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    of_box, of_disc = (
        Rotation.from_euler("z", each[:, None]).as_matrix() for each in (yaw, turn)
    )
    place, phi, normal, may = rim.near(box, of_disc, p, of_box, np.zeros((6, 3)))
    local = np.einsum("nji,nj->ni", of_box, p)[:, :2]
    nearest = np.clip(local, -half[:2], half[:2])
    gap = np.linalg.norm(local - nearest, axis=1)
    outside = gap > r  # Else how deep depends on which side it is asked from.
    np.testing.assert_allclose(phi[outside], (gap - r)[outside], atol=1e-12)
    out = np.einsum("nij,nj->ni", of_box[:, :2, :2], (local - nearest) / gap[:, None])
    np.testing.assert_allclose(place[:, :2], p[:, :2] - r * out, atol=1e-12)
    np.testing.assert_allclose(normal[:, :2], out, atol=1e-12)
    assert may.all() and not fixed.near(box, of_disc, p, of_box, 0 * p)[3].any()
    # Standing on it, the fixed points of its rim carry it.
    on = np.tile([0.0, 0.0, 0.1], (6, 1))
    assert not rim.near(box, of_disc, on, of_box, 0 * on)[3].any()
    assert fixed.near(box, of_disc, on, of_box, 0 * on)[3].all()


class _Logged(dict):
    """Channels by name, as a Recording gives them."""

    channels = {f"tip.tip.{a}": SimpleNamespace(noise=0.07) for a in ("fx", "fy", "fz")}


def test_a_tool_that_leans_on_something_with_little_is_felt(monkeypatch):
    """0.4 N is less than six times a sample's noise."""
    rng = np.random.default_rng(0)
    time = np.arange(400) / 250.0
    log = _Logged(
        {f"tip.tip.{a}": 0.07 * rng.normal(size=400) for a in ("fx", "fy", "fz")}
    )
    log["tip.tip.fx"][200:] += 0.4
    log["tip.tip.fy"][::7] = np.nan
    track = SimpleNamespace(
        recording=0, time=time, episode=SimpleNamespace(rows=slice(0, 400))
    )
    own = np.zeros((400, 6))
    monkeypatch.setattr(touching, "felt_motion", lambda *args: own)
    model = SimpleNamespace(
        tracks=[track], recordings=[log], _offset=[0, 400], dynamics=None,
        _q=None, _v=None, _vd=None,
    )  # fmt: skip
    sensor = SimpleNamespace(place="tip.tip", frame=None)
    size = ContactDynamics._force_size(model, sensor, np.zeros((1, 3)))
    assert size[:190].max() == 0.0
    np.testing.assert_allclose(size[210:390], 0.4, atol=0.15)  # Five deviations.
    # What the tool's own motion makes in a sensor in its mount is no touch.
    own[200:300, 1] = -0.5
    size = ContactDynamics._force_size(model, sensor, np.zeros((1, 3)))
    assert size[210:295].max() == 0.0 and size[305:390].min() > 0.2


ARM_WITH_TOOL = """<robot name="arm">
<link name="one"><inertial><mass value="1.0"/><origin xyz="0.1 0 0"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="two"><inertial><mass value="0.7"/><origin xyz="0.05 0 0.1"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tool"><inertial><mass value="0.3"/><origin xyz="0.02 0.03 0.06"/>
<inertia ixx="1e-3" iyy="2e-3" izz="1.5e-3" ixy="2e-4" ixz="-1e-4" iyz="0"/></inertial>
</link><link name="world"/>
<joint name="j1" type="revolute"><parent link="world"/><child link="one"/>
<axis xyz="0 0 1"/></joint>
<joint name="j2" type="revolute"><parent link="one"/><child link="two"/>
<origin xyz="0.3 0 0"/><axis xyz="0 1 0"/></joint>
<joint name="mount" type="fixed"><parent link="two"/><child link="tool"/>
<origin xyz="0.1 0 0.2" rpy="0.3 0.2 0.1"/></joint></robot>"""


def test_what_a_tool_s_motion_adds_to_its_sensor_is_what_its_mount_carries():
    """Against Drake's reaction in the mount, with the weight taken off."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(ARM_WITH_TOOL, "urdf")
    tool, mount = plant.GetBodyByName("tool"), plant.GetJointByName("mount")
    p_tip = np.array([0.05, -0.02, 0.15])
    tip = plant.AddFrame(
        FixedOffsetFrame("point", tool.body_frame(), RigidTransform(p_tip))
    )
    plant.Finalize()
    context = plant.CreateDefaultContext()
    rng = np.random.default_rng(3)
    q, v = rng.normal(size=(4, 2)), 3.0 * rng.normal(size=(4, 2))
    acceleration, expected = [], []
    for k in range(4):
        plant.SetPositions(context, q[k])
        plant.SetVelocities(context, v[k])
        dx = plant.EvalTimeDerivatives(context)
        acceleration.append(dx.get_generalized_velocity().CopyToVector())
        felt = plant.get_reaction_forces_output_port().Eval(context)[mount.index()]
        X = mount.frame_on_child().CalcPoseInWorld(context)
        R, p = X.rotation().matrix(), X.translation()
        weight = tool.default_mass() * plant.gravity_field().gravity_vector()
        com = tool.EvalPoseInWorld(context) @ tool.default_com()
        at = tip.CalcPoseInWorld(context).translation()
        force = -R @ felt.translational() - weight
        moment = -R @ felt.rotational() - np.cross(p - at, R @ felt.translational())
        expected.append([*force, *(moment - np.cross(com - at, weight))])
    own = SimpleNamespace(
        plant=plant, _context=plant.CreateDefaultContext(), _tree=None
    )
    dynamics = SimpleNamespace(body_motion=partial(SceneDynamics.body_motion, own))
    found = felt_motion(dynamics, tip, q, v, acceleration)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(found[:, 3:]).max() > 0.05


def test_a_touch_that_is_lost_for_a_moment_goes_on():
    time = np.arange(200) / 200.0
    felt = np.ones(200, bool)
    felt[20:32] = False  # 60 ms,
    felt[80:101] = False  # and 110 ms, of half a test function of 0.2 s,
    felt[150:] = False  # and for good: these are losses.
    track = SimpleNamespace(time=time)
    model = SimpleNamespace(tracks=[track], _offset=[0, 200], half=0.2)
    found = ContactDynamics._without_short_losses(model, felt)
    expected = felt.copy()
    expected[20:32] = True
    np.testing.assert_array_equal(found, expected)
    # One episode's last touch is not held on to in the next one.
    two = SimpleNamespace(
        tracks=[SimpleNamespace(time=time[:100])] * 2, _offset=[0, 100, 200], half=0.2
    )
    felt = np.ones(200, bool)
    felt[95:105] = False
    np.testing.assert_array_equal(
        ContactDynamics._without_short_losses(two, felt), felt
    )


def test_where_a_force_may_be_felt_it_is_not_known_whether_they_touch():
    off = np.zeros(40, bool)
    touching = off.copy()
    touching[30:] = True
    sensor = SimpleNamespace(forces=slice(0, 3), welded=[1])
    distance = np.full(40, 1e-3)
    distance[10:20] = 0.1
    model = SimpleNamespace(
        sensors=[sensor], _touching={(0, 1): touching, (0, 2): off},
        _apart={(0, 1): distance},
    )  # fmt: skip
    # Near and felt; far; near and not felt; touching.
    first, last = np.array([0, 10, 20, 30]), np.array([10, 20, 30, 40])
    wrench = np.array([[0.1, 0, 0], [0.1, 0, 0], [0.02, 0, 0], [0.1, 0, 0]])
    var = np.full((4, 3), 1e-4)
    got = ContactDynamics._maybe_felt(model, first, last, slice(0, 40), wrench, var)
    assert got.tolist() == [True, False, False, False]


def test_what_is_seen_in_two_blocks_is_fitted_and_held_out():
    time = np.arange(0.0, 18.0, 0.05)
    r = np.ones((len(time), 2))
    loud = ((time > 3.0) & (time < 3.6)) | ((time > 4.8) & (time < 5.4))
    r[loud, 1] = 9.0
    model = SimpleNamespace(
        means=SimpleNamespace(time=time, episode=np.zeros(len(time), int)),
        _shown=np.ones(r.shape, bool),
        half=0.05,
    )
    ContactProblem._share_out(model, r)
    train = model._train
    assert train.mean() == pytest.approx(2 / 3, abs=0.05)
    assert train[loud].mean() == pytest.approx(0.5, abs=0.1)
    for block in np.unique(model._block):  # Neighbours err together.
        assert len(set(train[model._block == block])) == 1
    # Of one push, less than a block long, too.
    r[:] = 1.0
    loud = (time > 3.0) & (time < 3.6)
    r[loud, 1] = 50.0
    ContactProblem._share_out(model, r)
    assert model._train[loud].mean() == pytest.approx(0.5, abs=0.1)
    assert model._train.mean() == pytest.approx(2 / 3, abs=0.05)


@pytest.mark.slow
def test_blocks_that_are_loud_by_what_was_learned_are_shared_out_again(
    tmp_path, monkeypatch
):
    """And not those of which less is left: first touches are in few blocks, too."""
    scene, recordings, _ = pushed(tmp_path, 15, [], episodes=3)
    plain = ContactProblem(scene, recordings)
    fitted_blocks = np.unique(plain.blocks()[plain.train()])[:2]
    for size, shared in ((4.0, True), (2.0, False)):

        def left(model, size=size):
            loud = np.isin(model.blocks(), fitted_blocks)
            noise = np.random.default_rng(2).normal(size=len(loud))
            return np.where(loud, size, 0.5) * noise

        monkeypatch.setattr(ContactProblem, "_without_nuisances", left)
        model = ContactProblem(scene, recordings)
        train = [model.train()[model.blocks() == k].all() for k in fitted_blocks]
        assert sorted(train) == ([False, True] if shared else [True, True])


def test_a_loud_block_is_told_though_it_is_fitted(tmp_path):
    """`no_gap` asks held-out rows, and what is met once may be in none of them."""
    scene, recordings, _ = pushed(tmp_path, 15, [], episodes=3)
    model = ContactProblem(scene, recordings)
    number = int(model.blocks()[model.train()][0])
    noise = np.random.default_rng(2).normal(size=len(model.blocks()))
    left = np.where(model.blocks() == number, 4.0, 0.5) * noise
    name, size = model.loudest(SimpleNamespace(left=left))
    assert size == pytest.approx(4.0, rel=0.15)
    time = model.means.time[model._block == number]
    assert f"from {time.min():.3g} to {time.max():.3g} s" in name
    # An equation that is louder goes first.
    louder = np.where(model.channel_of_rows() == 0, 9.0, left)
    assert model.loudest(SimpleNamespace(left=louder)) == (model.row_names()[0], 9.0)
    # One moment in which an equation is far off makes it no louder; two do.
    alone, twice = 0.5 * noise, 0.5 * noise
    mine = np.flatnonzero(model.channel_of_rows() == 0)
    alone[mine[:1]] = twice[mine[:2]] = 200.0
    assert model.loudest(SimpleNamespace(left=alone))[1] < 2.0
    assert model.loudest(SimpleNamespace(left=twice))[1] > 5.0
    # A row that is far off makes no stretch of time loud; one in ten off by 18 does, as
    # a patch that is crossed once.
    rows = np.flatnonzero(model.blocks() == number)
    glitch, crossed = 0.5 * noise, 0.5 * noise
    glitch[rows[0]] = 90.0
    crossed[rows[: len(rows) // 10]] = 18.0
    loud = model.plan.loud
    assert (
        max(model._blocks_left(glitch))[0] < loud < max(model._blocks_left(crossed))[0]
    )


def test_a_patch_s_side_that_nothing_crossed_may_be_anywhere():
    """A fit leaves it where it likes: that is no reason to refuse the patch."""
    sides = {"x_min": -0.1, "x_max": 2.5, "y_min": -9.0, "y_max": 0.2}
    assert is_sane(Effect("friction_patch", [PAIR], {"friction": 0.4} | sides), None)
    assert not is_sane(
        Effect("friction_patch", [PAIR], {"friction": 3.0} | sides), None
    )


@pytest.mark.parametrize(
    "before, after, good",
    [(0.9, 0.8, True), (0.9, 2.1, False), (8.0, 2.0, True), (8.0, 5.0, False)],
)
def test_effects_that_make_a_gap_in_simulation_are_not_confirmed(before, after, good):
    assert confirm.is_confirmed(GapMeasure(before, after, 1.0, 0.6), bool) == good


def test_a_signal_that_jumps_between_samples_is_known_less_well():
    """Means of samples against integrals: of noise alone, and of jumps at any time."""
    rng = np.random.default_rng(0)
    t, fine = np.arange(60) / 250.0, np.arange(24_000) / 1e5
    w, _ = permitted_forces.test_functions(t, [0.1], 0.064)
    dense, _ = permitted_forces.test_functions(fine, [0.1], 0.064)
    off, said, noise = [], [], 0.04
    for _ in range(400):
        at = rng.uniform(0.08, 0.12)
        y = np.where(t < at, 0.7, -2.2) + noise * rng.normal(size=len(t))
        off.append(float((w @ y - dense @ np.where(fine < at, 0.7, -2.2))[0]))
        said.append(variance_of_means(w, y, noise)[0])
    quiet = variance_of_means(w, 0.0 * t, noise)[0]
    assert quiet == pytest.approx(noise**2 * w.power(2).sum())
    assert np.mean(np.square(off)) > 4.0 * quiet
    assert np.mean(np.square(off)) == pytest.approx(np.mean(said), rel=0.15)


def test_a_rate_that_jumps_between_samples_is_known_less_well():
    """A joint that is struck: the mean of its measured rate was 20 times the noise off
    the rate of its position."""
    period, noise, rng = 0.004, 3e-3, np.random.default_rng(0)
    time, centres, half = period * np.arange(60), np.array([0.1]), np.array([0.05])
    ratios = []
    for at in rng.uniform(0.08, 0.12, 100):
        rate = np.where(time < at, 1.5, -17.0) + noise * rng.normal(size=60)
        # The smoothed rate, of which the mean over a test function is right.
        true = -17.0 + 18.5 * np.clip((at - time) / period + 0.5, 0.0, 1.0)
        recording = SimpleNamespace(
            channels={"a.velocity": SimpleNamespace(noise=noise)}
        )
        track = SimpleNamespace(time=time, v=true[:, None])
        weights, dd = permitted_forces.test_functions(time, centres, half)
        phi = SimpleNamespace(
            of=lambda name, y=rate, w=weights, d=dd: (w, d, y, np.ones(60, bool)),
            recording=recording, track=track, centres=centres,
        )  # fmt: skip
        model = SimpleNamespace(extra=[("a.velocity", 0)])
        off, var = ContactMeans._extra_means(model, phi, np.zeros((1, 1)))  # type: ignore
        ratios.append(off[0, 0] / np.sqrt(var[0, 0]))
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.3


def test_a_body_at_rest_does_not_say_how_one_that_moves_is_accelerated():
    """What is expected is right on average of what moves (a regression of the truth on
    it has slope 1), and next to nothing of what rests; whatever share rests."""
    rng = np.random.default_rng(0)
    n, noise = 4000, 0.15
    true, v = np.zeros((n, 6)), np.zeros((n, 6))
    moves = np.arange(n) < n // 4
    true[moves, 3] = 0.3 * rng.normal(size=n // 4)
    v[moves, 3] = 0.1
    model = SimpleNamespace(
        means=SimpleNamespace(
            acceleration=true + noise * rng.normal(size=(n, 6)),
            acceleration_var=np.full((n, 6), noise**2),
        ),
        joints={}, bodies={"body": (0, 0)}, _W=eye_array(n, format="csr"), _node_v=v,
        dynamics=SimpleNamespace(gravity=np.array([0.0, 0.0, -9.81])),
    )  # fmt: skip
    a, covariance = ContactDynamics._expected_acceleration(model, v)  # type: ignore[arg-type]
    slope = true[moves, 3] @ a[moves, 3] / (a[moves, 3] @ a[moves, 3])
    assert slope == pytest.approx(1.0, abs=0.05)
    off = np.mean((a - true)[moves, 3] ** 2)
    assert off == pytest.approx(covariance[moves, 3, 3].mean(), rel=0.1)
    assert np.sqrt(np.mean(a[~moves, 3] ** 2)) < 0.1 * noise


def test_windows_expect_what_the_noise_of_measured_efforts_makes(monkeypatch):
    """Where a foot may stick or slip no slope tells it: efforts are drawn, too, with
    what jumps leave unknown. A leg that slid away in one draw turned at 100 rad/s."""
    monkeypatch.setattr(contact_windows, "DRAWS", 400)
    time, noise = 0.004 * np.arange(30), 0.03
    y = np.where(np.arange(30) < 15, 0.0, 2.0)

    class Windows(PushWindows):
        def __init__(self):
            act = SimpleNamespace(type="effort", joints=["a"])
            self.scene = SimpleNamespace(actuation=act, effects=[])
            channel = SimpleNamespace(name="a.effort_measured", noise=noise)
            episode = SimpleNamespace(first=0, rows=slice(0, 30))
            self.recordings = [Recorded(time, {channel.name: (channel, y)}, [episode])]
            given = Commands(time, {"a.effort_command": y})
            self._commands = {(0.0,): [{0: given}]}
            self._draw, self._led, self._pairs, self.windows = None, [], (), []
            self._creep = 0.0
            self.channels = ["a.position", "a.velocity"]

        def simulate(self, effects, chosen=None, twists=None):
            u = self.commands(effects)[0][0].columns["a.effort_command"]
            return [np.column_stack([u, 400.0 * u])]

    windows = Windows()
    plain, (wide,) = windows._spread(())
    np.testing.assert_array_equal(plain[0][:, 0], y)
    np.testing.assert_array_equal(windows.simulate(())[0], plain[0])
    quiet = np.delete(np.arange(30), [13, 14, 15, 16])
    np.testing.assert_allclose(wide[quiet, 0], noise**2, rtol=0.3)
    np.testing.assert_allclose(wide[quiet, 1], (400.0 * noise) ** 2, rtol=0.3)
    assert wide[14:16, 0].min() > 0.5 * 2.0**2 / 24.0


class Recorded:
    """A recording of a few measured channels: {name: (channel, values)}."""

    def __init__(self, time, channels, episodes):
        self.time, self._of, self.episodes = time, channels, episodes
        self.channels = {name: channel for name, (channel, _) in channels.items()}

    def __contains__(self, name):
        return name in self._of

    def __getitem__(self, name):
        return self._of[name][1]

    def commands(self):
        return []


@pytest.mark.slow
def test_what_a_planar_camera_says_of_the_height_is_not_compared(tmp_path):
    """Height and tilt that are the same number in all rows: windows judge the rest,
    which is at the noise with the true friction."""
    scene, recordings, truth = pushed(tmp_path, 203, ["contact_friction"], 1.0, 2)
    (recording,) = recordings
    said = {"z": np.nanmean(recording[f"{BLOCK}.z"]), "qx": 0.0, "qy": 0.0}
    channels = dict(recording.channels)
    for a, value in said.items():
        c = channels[f"{BLOCK}.{a}"]
        same = np.where(np.isnan(c.values), np.nan, value)
        channels[c.name] = replace(c, values=same, noise=0.0)
    windows = PushWindows(scene, [replace(recording, channels=channels)])
    left = {f"{BLOCK}.{a}" for a in said} & set(windows.channels)
    assert not left and f"{BLOCK}.x" in windows.channels
    (hidden,) = truth.hidden
    effect = Effect(hidden["kind"], [hidden["at"]], dict(hidden["parameters"]))

    errors = np.concatenate(windows.errors(windows.simulate([effect])))
    assert np.sqrt(np.mean(errors**2)) < 1.2


@pytest.mark.parametrize(
    "measured", [True, pytest.param(False, marks=pytest.mark.slow)]
)
def test_noise_of_an_effort_is_that_of_positions_and_of_velocities(tmp_path, measured):
    """Of a drive that damps: kd times a velocity is most of what noise makes of it."""
    scene, recordings, _ = pushed(tmp_path, 16, [], episodes=2)
    (recording,) = recordings
    rng = np.random.default_rng(0)
    joints = "tip.x", "tip.y"

    def channels(add: float):
        out = {}
        for name, c in recording.channels.items():
            if name.endswith(".velocity") and not measured:
                continue
            if name in [f"{j}.{of}" for j in joints for of in ("position", "velocity")]:
                noise = add * c.noise * rng.normal(size=len(c.values))
                c = replace(c, values=c.values + noise)
            out[name] = c
        return out

    efforts = []
    for add in (0.0, 1.0, 1.0, 1.0, 1.0):
        noisy = replace(recording, channels=channels(add))
        means = ContactDynamics(scene, [noisy]).means
        efforts.append({
            (i, round(t, 6)): u
            for i, t, u in zip(means.episode, means.time, means.effort, strict=True)
        })  # fmt: skip
    said = np.sqrt(np.mean(means.effort_var[:, :2]))
    off = [
        efforts[k][at][:2] - efforts[0][at][:2]
        for k in range(1, 5)
        for at in efforts[k].keys() & efforts[0].keys()
    ]
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(said, rel=0.15)

"""The cart-pole between soft walls: its LCS, its MultibodyPlant, the experiment."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.diagrams.cartpole_walls import (
    DT,
    SCENE,
    CartpoleWallsConfig,
    initial_state,
    make_cartpole_walls,
    model_lcs,
    refuse_unused_settings,
    start,
    true_lcs,
)
from makebreak.models.scene import load_scene
from makebreak.scripts.cli import main
from makebreak.scripts.experiments import cartpole_walls as experiment
from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.settings import apply_settings
from makebreak.systems.contact_mpc.numerics.cartpole import (
    CartPole,
    cartpole_lcs,
    cost_to_go,
)
from makebreak.systems.contact_mpc.numerics.lcs import simulate
from makebreak.systems.views.walls_view import WallsView, WallsViewConfig

REFERENCE = Path(__file__).parent / "reference"
TRUTH = np.array([-0.15, 0.15])  # gap_error of the paper [m].


def test_lcs_is_the_public_one():
    data = np.load(REFERENCE / "c3_cartpole.npz")
    lcs = cartpole_lcs(CartPole(), float(data["dt"]))
    for name in ("A", "B", "D", "d", "E", "F", "H", "c"):
        # The public A and D carry seven digits.
        np.testing.assert_allclose(getattr(lcs, name), data[name], atol=2e-8)
    Q_N = cost_to_go(lcs, data["Q"], data["R"])
    np.testing.assert_allclose(Q_N, data["QN"], rtol=1e-4)


def test_multibody_model_has_the_parameters_of_the_lcs():
    builder = DiagramBuilder()
    plant = load_scene(SCENE, builder).plant
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant_context = plant.GetMyContextFromRoot(context)
    dt = 1e-3  # The plant's; its position update is semi-implicit, the LCS's is not.
    lcs = cartpole_lcs(CartPole(), dt)
    force = plant.get_actuation_input_port()

    def step(x, u):
        plant.SetPositionsAndVelocities(plant_context, x)
        force.FixValue(plant_context, [u])
        return plant.EvalUniquePeriodicDiscreteUpdate(plant_context).value()

    h = 1e-4  # Small enough for the sine's cubic term, h^2/6 = 2e-9.
    for i in range(4):
        x = np.zeros(4)
        x[i] = h
        velocity = step(x, 0.0)[2:] / h
        np.testing.assert_allclose(velocity, lcs.A[2:, i], atol=1e-6)
    np.testing.assert_allclose(step(np.zeros(4), 1.0)[2:], lcs.B[2:, 0], rtol=1e-6)


@pytest.mark.parametrize("wall, sign", [(0, 1.0), (1, -1.0)])
def test_multibody_walls_push_as_the_lcs_walls(wall, sign):
    builder = DiagramBuilder()
    plant = load_scene(SCENE, builder).plant
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant_context = plant.GetMyContextFromRoot(context)
    results = plant.get_contact_results_output_port()
    for penetration in (-1e-3, 0.01, 0.05):
        x = np.array([sign * (0.35 + penetration), 0.0, 0.0, 0.0])
        plant.SetPositionsAndVelocities(plant_context, x)
        contacts = results.Eval(plant_context)
        _, lam = simulate(true_lcs(), x, [0.0])
        if penetration < 0.0:
            assert contacts.num_point_pair_contacts() == 0 and lam[wall] == 0.0
            continue
        force = contacts.point_pair_contact_info(0).contact_force()
        # Drake's is the force at the end of the 1 ms step: the tip, pushed at 100 N/m
        # and 5.8 m/s2 per N, has then moved back by 6e-4 of the penetration.
        np.testing.assert_allclose(abs(force[0]), lam[wall], rtol=1e-3)
        np.testing.assert_allclose(force[1:], 0.0, atol=1e-9)
        assert lam[1 - wall] == 0.0


def simulated(config, multibody=False, duration=8.0, x=None):
    """x (n, 4), u (n, 1) and r_comp (n, 2) at every period; ends when the pole lies."""
    diagram = make_cartpole_walls(config, multibody)
    x = initial_state(config) if x is None else x
    simulator = Simulator(diagram, start(diagram, x))
    context = simulator.get_context()
    rows = []
    for k in range(round(duration / DT) + 1):
        simulator.AdvanceTo(k * DT)
        ports = ("x", "u", "r_comp")
        rows.append([diagram.GetOutputPort(p).Eval(context) for p in ports])
        if abs(rows[-1][0][1]) > experiment.FALLEN:
            break
    return [np.array(column) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))]
)
def test_learns_both_walls_and_settles(seed):
    config = CartpoleWallsConfig(seed=seed)
    x, _, r = simulated(config)
    assert abs(x[-100:]).max() < experiment.SETTLED_BOUND
    np.testing.assert_allclose(r[-1], TRUTH, atol=experiment.RESIDUAL_BOUND)
    assert (r[0] == 0.0).all()


@pytest.mark.parametrize("multibody", [False, True])
def test_without_adaptation_it_does_not_settle_but_with_known_walls_it_does(multibody):
    config = CartpoleWallsConfig(adapt=False)
    x, _, r = simulated(config, multibody)
    assert abs(x[-100:]).max() > 1.0 and (r == 0.0).all()
    x, _, _ = simulated(replace(config, gap_error=[0.0, 0.0]), multibody)
    assert abs(x[-100:]).max() < experiment.SETTLED_BOUND


def test_multibody_learns_the_walls_too():
    x, _, r = simulated(CartpoleWallsConfig(), multibody=True)
    assert abs(x[-100:]).max() < experiment.SETTLED_BOUND
    # The model is linear and steps 10 ms by explicit Euler: sin(0.3) is 4 mm short of
    # 0.3 in the tip's place. 2 cm leaves room for the rest.
    np.testing.assert_allclose(r[-1], TRUTH, atol=0.02)


def test_no_period_of_delay_between_x_and_u_and_none_lost_in_a_pair():
    """The loop is x_1 = simulate(x_0, u(x_0)), and the learner's pairs are just that:
    with the right walls its loss stays zero, contact or not."""
    config = CartpoleWallsConfig(gap_error=[0.0, 0.0], x_spread=[0.0] * 4)
    x0 = np.array([0.1, -0.5, 0.5, -0.4])  # In contact with wall 0.
    diagram = make_cartpole_walls(config)
    simulator = Simulator(diagram, start(diagram, x0))
    context = simulator.get_context()
    truth, x = true_lcs(), x0
    touched = 0.0
    for k in range(1, 30):
        # Events at a multiple of DT come after it: AdvanceTo stops before them.
        simulator.AdvanceTo(k * DT)
        u = diagram.GetOutputPort("u").Eval(context)
        x, lam = simulate(truth, x, u)
        touched = max(touched, lam.max())
        ours = diagram.GetOutputPort("x").Eval(context)
        np.testing.assert_allclose(ours, x, atol=1e-12)
        loss = diagram.GetOutputPort("loss").Eval(context)
        np.testing.assert_allclose(loss, 0.0, atol=1e-15)
    assert touched > 1.0


def test_only_the_agreement_on_no_contact_never_teaches():
    config = CartpoleWallsConfig()
    _, shares = experiment.gradient_map(config)
    assert shares["gradient_zero_share_agreed_free"] == 1.0
    assert shares["gradient_zero_share_agreed_contact"] == 0.0
    assert shares["gradient_zero_share_false_contact"] == 0.0
    # A contact too light to explain by the model's wide gap: see the next test.
    assert 0.0 < shares["gradient_zero_share_missed_contact"] < 0.25


def test_a_missed_contact_teaches_from_a_force_on_that_the_theory_gives():
    """With lam = 0 the slope of the loss in lam_0 is eps D_0'Qd (z) + eta_0, and
    z = -D_0 lam_true: no gradient unless eps |D_0|^2 lam_true exceeds the gap."""
    config = CartpoleWallsConfig()
    lcs = true_lcs()
    gap = 0.05  # Modelled; the contact is missed by as much.
    lam = gap / (config.learning.eps * lcs.D[:, 0] @ lcs.D[:, 0])
    for factor, expected in ((0.99, False), (1.01, True)):
        penetration = factor * lam * lcs.F[0, 0]
        x = np.array([[0.35 + penetration, 0.0, 0.0, 0.0]])
        error = [-gap - penetration, 0.0]
        happened, predicted, force = experiment.contact_and_gradient(config, error, x)
        assert happened[0, 0] and not predicted[0, 0]
        assert (force[0, 0] > 1e-9) == expected


def test_seed_draws_the_start_and_only_the_start():
    config = CartpoleWallsConfig()
    a, b = initial_state(config), initial_state(replace(config, seed=1))
    assert (a != b).all()
    assert (abs(a - config.x_initial) <= 0.02).all()
    np.testing.assert_array_equal(initial_state(config), a)


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(x_initial=[0.0]), r"x_initial is \[0.0\], expected 4"),
        (dict(x_spread=[0.0, -1.0, 0.0, 0.0]), "x_spread"),
        (dict(gap_error=[0.1]), r"gap_error is \[0.1\], expected 2"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    config = CartpoleWallsConfig(**changes)
    with pytest.raises(ValueError, match=message):
        make_cartpole_walls(config)
        initial_state(config)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["learning.slip_noise=0.1"], "slip_noise is 0.1, .* have no friction"),
        (["learner=none", "learning.r_max=0.3"], "not used with learner=none"),
        (["learner=r_dyn", "learning.adam.n_steps=2"], "not used with learner=r_dyn"),
        (
            ["adapt=false", "learning.adam.n_b=5"],
            "n_b is 5, expected 10: .* adapt=false",
        ),
        (["adapt=false", "learner=both"], "learner is both"),
    ],
)
def test_settings_that_the_learner_does_not_read_are_refused(
    settings, message, tmp_path
):
    config = apply_settings(CartpoleWallsConfig(), settings)
    with pytest.raises(ValueError, match=message), Session(tmp_path) as session:
        experiment.run(config, session)


@pytest.mark.parametrize(
    "settings",
    [
        ["learning.gamma=0.005", "learning.adam.n_b=5"],
        ["learner=both", "learning.adam.n_steps=2"],
        ["learner=r_dyn", "learning.adam.n_b=5"],
        ["learner=none", "learning.eps=10"],  # Of the map of gradients.
    ],
)
def test_settings_that_are_read_are_accepted(settings):
    refuse_unused_settings(apply_settings(CartpoleWallsConfig(), settings))


@pytest.mark.parametrize("learner", ["none", "r_comp", "r_dyn", "both"])
def test_each_learner_is_wired_to_what_it_corrects(learner):
    diagram = make_cartpole_walls(CartpoleWallsConfig(learner=learner))
    names = {system.get_name() for system in diagram.GetSystems()}
    assert ("learner" in names) == (learner in ("r_comp", "both"))
    assert ("dynamics_learner" in names) == (learner in ("r_dyn", "both"))


@pytest.mark.parametrize("projection", ["exact", "plus"])
def test_the_walls_are_learned_with_the_other_projections(projection):
    config = CartpoleWallsConfig(projection=projection)
    _, _, r = simulated(config, duration=4.0)
    # Both walls are touched within 4 s, and then known to a centimetre.
    np.testing.assert_allclose(r[-1], TRUTH, atol=0.01)


def test_gamma_beyond_its_bound_is_refused_by_the_command_line(tmp_path, capsys):
    arguments = ["run", "cartpole_walls", "--no-meshcat", "--out", str(tmp_path)]
    assert main([*arguments, "--set", "learning.gamma=0.03"]) == 2
    error = capsys.readouterr().err.strip()
    assert "gamma is 0.03, expected 0 < gamma < 0.02" in error.splitlines()[-1]


def test_model_is_wrong_by_the_gap_error_alone():
    model, truth = model_lcs(CartpoleWallsConfig()), true_lcs()
    np.testing.assert_allclose(model.c + TRUTH, truth.c, rtol=1e-15)
    for name in ("A", "B", "D", "d", "E", "F", "H"):
        np.testing.assert_array_equal(getattr(model, name), getattr(truth, name))


class Recorder:
    """Stands for Meshcat, and remembers where each object was put last."""

    def __init__(self):
        self.x = {}

    def SetObject(self, path, *_):
        self.x[path] = None

    def SetTransform(self, path, X, *_):
        self.x[path] = X.translation()[0]


def test_modelled_walls_are_shown_at_the_modelled_gap_plus_the_residual():
    builder, recorder = DiagramBuilder(), Recorder()
    config = WallsViewConfig(gap=[0.5, 0.2], tip_radius=0.02)
    view = builder.AddSystem(WallsView(config, recorder))
    r_comp = builder.AddSystem(ConstantVectorSource(TRUTH))
    builder.Connect(r_comp.get_output_port(), view.GetInputPort("r_comp"))
    # The boxes are 1 cm thick and stand outside the face, a tip radius farther out.
    assert list(recorder.x.values()) == pytest.approx([0.525, -0.225])
    Simulator(builder.Build()).AdvanceTo(0.1)
    assert list(recorder.x.values()) == pytest.approx([0.375, -0.375])


def test_a_meshcat_shows_cart_pole_and_walls():
    meshcat = Meshcat()
    config = CartpoleWallsConfig()
    diagram = make_cartpole_walls(config, multibody=True, meshcat=meshcat)
    simulator = Simulator(diagram, start(diagram, initial_state(config)))
    simulator.AdvanceTo(0.05)
    for path in ("/makebreak/model_wall_1", "/drake/visualizer/cartpole/pole"):
        assert meshcat.HasPath(path), path
    for path in ("/Grid", "/Axes"):  # Not seen; as MessagePack writes false.
        assert meshcat._GetPackedProperty(path, "visible").endswith(b"\xc2")


def test_command_line_writes_the_result(tmp_path, capsys):
    arguments = ["run", "cartpole_walls", "--no-meshcat", "--seed", "4"]
    assert main([*arguments, "--out", str(tmp_path / "a")]) == 0
    result = json.loads((tmp_path / "a/result.json").read_text())
    assert result["success"] and result["settled"] and result["multibody_settled"]
    assert not result["settled_without_adaptation"]
    assert result["residual_error_max"] < 0.01
    assert (tmp_path / "a/gradient_map.png").stat().st_size > 10_000
    assert (tmp_path / "a/stabilisation.png").stat().st_size > 10_000
    plain = [*arguments, "--set", "adapt=false", "--out", str(tmp_path / "b")]
    assert main(plain) == 1
    result = json.loads((tmp_path / "b/result.json").read_text())
    assert not (result["success"] or result["settled"] or result["multibody_settled"])
    assert result["residual_error_max"] == pytest.approx(0.15)

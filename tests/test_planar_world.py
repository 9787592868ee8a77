"""The planar worlds against closed forms, scipy and Drake's own springs."""

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    LinearSpringDamper,
    PrismaticJoint,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from scipy.integrate import solve_ivp
from scipy.special import erf

from makebreak.diagrams.multi_spring import (
    MultiSpringConfig,
    active_inference,
    draw,
    make_multi_spring,
)
from makebreak.diagrams.porridge import PorridgeConfig, make_porridge
from makebreak.diagrams.porridge import draw as draw_porridge
from makebreak.systems.baselines.active_inference import ActiveInferenceConfig
from makebreak.systems.planar.numerics.planar_world import (
    circle_target,
    external_force,
    limited,
    step,
)
from makebreak.systems.planar.planar_world import (
    CircleTarget,
    CircleTargetConfig,
    PlanarWorld,
    PlanarWorldConfig,
    SpringConfig,
    springs_of,
)

DT = 1e-3
NONE = (np.zeros((0, 2)), np.zeros((0, 3)))
THIN, RAMP = np.zeros(2), 6.0
ANCHORS = np.array([[0.0, 0.75], [-0.65, -0.4], [0.65, -0.4]])
SPRINGS = np.array([[20.0, 0.3, np.inf], [40.0, 0.3, np.inf], [60.0, 0.3, np.inf]])


def simulated(x, seconds, u=(0.0, 0.0), mass=1.0, world=(THIN, RAMP, *NONE)):
    """The states after each millisecond, u constant."""
    states, u = [np.array(x, dtype=float)], np.array(u, dtype=float)
    for k in range(round(seconds / DT)):
        states.append(step(states[-1], k * DT, u, DT, mass, *world))
    return np.array(states)


def test_a_steady_push_through_constant_viscosity_is_the_closed_form():
    c, mass, u = 180.0, 1.3, np.array([20.0, -7.0])
    world = (np.array([c, c]), RAMP, *NONE)
    x = simulated([0.1, 0.2, 0.5, -0.3], 0.5, u, mass, world)
    t = DT * np.arange(len(x))[:, None]
    decay, end = np.exp(-c * t / mass), u / c
    v = end + (np.array([0.5, -0.3]) - end) * decay
    p = np.array([0.1, 0.2]) + end * t + (v[0] - end) * mass / c * (1.0 - decay)
    # Fourth order with c h / m = 0.035: (0.035)^5 / 120 per step, about 4e-10.
    np.testing.assert_allclose(x, np.hstack([p, v]), atol=1e-8)


def test_coasting_in_thickening_porridge_is_the_closed_form():
    # dv/dt = -(c1 t / T) v / m: v = v0 exp(-a t^2), a = c1 / (2 m T), p by erf.
    c1, T, mass, v0 = 150.0, 6.0, 1.0, 0.4
    x = simulated(
        [0.0, 0.0, v0, 0.0], 1.0, mass=mass, world=(np.array([0, c1]), T, *NONE)
    )
    t, a = DT * np.arange(len(x)), c1 / (2.0 * mass * T)
    np.testing.assert_allclose(x[:, 2], v0 * np.exp(-a * t**2), atol=1e-10)
    p = v0 * np.sqrt(np.pi / a) / 2.0 * erf(np.sqrt(a) * t)
    np.testing.assert_allclose(x[:, 0], p, atol=1e-10)


def test_a_circle_at_constant_speed_needs_the_centripetal_and_the_viscous_force():
    """The external force along a given circle: -c v, and nothing else."""
    for t in (0.5, 3.0, 7.0):
        target = circle_target(t, 0.25, 6.0, 0.3, -1.0)
        c = 80.0 * min(t / 6.0, 1.0)
        F = external_force(target[:4], t, np.array([0.0, 80.0]), 6.0, *NONE)
        np.testing.assert_allclose(F, -c * target[2:4], atol=1e-12)


def test_effector_comes_to_rest_where_spring_and_push_balance():
    k, rest, push = 40.0, 0.3, np.array([0.0, -6.0])
    world = (
        np.array([15.0, 15.0]),
        RAMP,
        np.array([[0.0, 1.0]]),
        np.array([[k, rest, np.inf]]),
    )
    x = simulated([0.1, 0.4, 0.0, 0.0], 20.0, push, world=world)[-1]
    # The spring pulls up with k (l - rest) = 6 N: it is 0.45 m long, straight down.
    np.testing.assert_allclose(x, [0.0, 1.0 - 0.45, 0.0, 0.0], atol=1e-7)


def test_a_spring_pulls_within_its_reach_alone():
    anchor, spring = np.array([[0.5, 0.0]]), np.array([[40.0, 0.3, 0.4]])
    for x, expected in [(0.101, 40.0 * 0.099), (0.099, 0.0), (0.899, -40.0 * 0.099)]:
        F = external_force(np.array([x, 0, 0, 0]), 0.0, THIN, RAMP, anchor, spring)
        np.testing.assert_allclose(F, [expected, 0.0], atol=1e-12)
    # It catches an effector that comes near, and then does not let go: no friction.
    world = (THIN, RAMP, anchor, spring)
    x = simulated([0.0, 0.0, 0.3, 0.0], 1.0, world=world)
    caught = np.flatnonzero(x[:, 0] > 0.1)[0]
    np.testing.assert_allclose(x[:caught, 2], 0.3)
    stored = 0.5 * 40.0 * (np.abs(0.5 - x[caught + 1 :, 0]) - 0.3) ** 2
    energy = stored + 0.5 * x[caught + 1 :, 2] ** 2
    np.testing.assert_allclose(energy[:100], 0.5 * 40 * 0.1**2 + 0.045, rtol=1e-2)


def test_springs_alone_keep_the_energy():
    def energy(x):
        length = np.linalg.norm(ANCHORS - x[:2], axis=1)
        stored = 0.5 * SPRINGS[:, 0] @ (length - SPRINGS[:, 1]) ** 2
        return 0.5 * x[2:] @ x[2:] + stored

    x = simulated([0.2, 0.1, -0.3, 0.5], 6.0, world=(THIN, RAMP, ANCHORS, SPRINGS))
    energies = [energy(row) for row in x[::50]]
    # omega h is 0.0027: fourth order leaves 1e-13 per step, 24 000 steps.
    np.testing.assert_allclose(energies, energies[0], rtol=1e-9)


def test_a_held_force_with_springs_and_porridge_agrees_with_scipy():
    rng = np.random.default_rng(0)
    viscosity, mass = np.array([0.0, 150.0]), 1.0
    x = y = np.array([0.25, 0.0, 0.0, 0.0])

    def slope(t, s, u):
        F = -150.0 * min(t / 6.0, 1.0) * s[2:]
        for anchor, (k, rest, _) in zip(ANCHORS, SPRINGS, strict=True):
            d = anchor - s[:2]
            F = F + k * (1.0 - rest / np.linalg.norm(d)) * d
        return [*s[2:], *((u + F) / mass)]

    for k in range(300):
        u, t = rng.uniform(-50.0, 50.0, 2), 3.0 + k * DT
        x = step(x, t, u, DT, mass, viscosity, 6.0, ANCHORS, SPRINGS)
        options = dict(method="DOP853", rtol=1e-12, atol=1e-14)
        y = solve_ivp(slope, (t, t + DT), y, args=(u,), **options).y[:, -1]
    np.testing.assert_allclose(x, y, atol=1e-9)


def test_springs_agree_with_drakes_multibody_plant():
    """Two prismatic joints and LinearSpringDampers, continuous, integrated finely."""
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    light = SpatialInertia(0.0, np.zeros(3), UnitInertia(0.0, 0.0, 0.0))
    point = SpatialInertia(1.0, np.zeros(3), UnitInertia.SolidSphere(0.02))
    slide, tip = plant.AddRigidBody("slide", light), plant.AddRigidBody("tip", point)
    world = plant.world_frame()
    plant.AddJoint(PrismaticJoint("x", world, slide.body_frame(), [1, 0, 0]))
    plant.AddJoint(PrismaticJoint("y", slide.body_frame(), tip.body_frame(), [0, 1, 0]))
    for anchor, (k, rest, _) in zip(ANCHORS, SPRINGS, strict=True):
        at = [*anchor, 0.0]
        plant.AddForceElement(
            LinearSpringDamper(plant.world_body(), at, tip, [0, 0, 0], rest, k, 0.0)
        )
    plant.Finalize()
    simulator = Simulator(plant)
    simulator.get_mutable_integrator().set_target_accuracy(1e-10)
    simulator.get_mutable_integrator().set_maximum_step_size(1e-3)
    context = simulator.get_mutable_context()
    x = np.array([0.2, 0.1, -0.3, 0.5])
    plant.SetPositionsAndVelocities(context, x)
    simulator.AdvanceTo(1.0)
    ours = simulated(x, 1.0, world=(THIN, RAMP, ANCHORS, SPRINGS))[-1]
    # Drake's accuracy is per step; 1000 steps of 1e-10 at most.
    drakes = plant.GetPositionsAndVelocities(context)
    np.testing.assert_allclose(ours, drakes, atol=1e-7)


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_target_goes_once_around_from_rest_to_rest(turn):
    t = np.linspace(0.0, 6.0, 6001)
    x = np.array([circle_target(s, 0.25, 6.0, 0.7, turn) for s in t])
    np.testing.assert_allclose(np.linalg.norm(x[:, :2], axis=1), 0.25, rtol=1e-12)
    start = 0.25 * np.array([np.cos(0.7), np.sin(0.7)])
    np.testing.assert_allclose(x[[0, -1], :2], [start, start], atol=1e-12)
    np.testing.assert_allclose(x[[0, -1], 2:], 0.0, atol=1e-12)
    # Central differences: h^2 / 6 times the third derivative, about 1e-6 here.
    for values, rates in ((x[:, :2], x[:, 2:4]), (x[:, 2:4], x[:, 4:])):
        slope = (values[2:] - values[:-2]) / (t[2] - t[0])
        np.testing.assert_allclose(slope, rates[1:-1], atol=5e-6)
    speed = np.linalg.norm(x[:, 2:4], axis=1)
    assert speed.max() == pytest.approx(1.875 * 2 * np.pi * 0.25 / 6.0, rel=1e-6)
    angle = np.unwrap(np.arctan2(x[:, 1], x[:, 0]))
    assert angle[-1] - angle[0] == pytest.approx(turn * 2 * np.pi)
    np.testing.assert_allclose(
        circle_target(9.0, 0.25, 6.0, 0.7, turn), x[-1], atol=1e-12
    )


def test_force_limit_keeps_the_direction():
    np.testing.assert_allclose(limited(np.array([30.0, 40.0]), 5.0), [3.0, 4.0])
    np.testing.assert_array_equal(limited(np.array([3.0, 4.0]), 5.0), [3.0, 4.0])


def test_who_reads_at_t_reads_the_state_of_t_and_u_acts_from_then_on():
    builder = DiagramBuilder()
    config = PlanarWorldConfig(viscosity=[0.0, 60.0], ramp_sec=2.0)
    world = builder.AddSystem(PlanarWorld(config, [0.1, 0.0, 0.2, 0.0]))
    u = builder.AddSystem(ConstantVectorSource([3.0, -1.0]))
    builder.Connect(u.get_output_port(), world.GetInputPort("u"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = world.GetMyContextFromRoot(simulator.get_context())
    expected = simulated(
        [0.1, 0.0, 0.2, 0.0],
        0.05,
        (3.0, -1.0),
        world=(np.array([0.0, 60.0]), 2.0, *NONE),
    )
    for k in range(1, 51):
        simulator.AdvanceTo(k * DT)
        state = world.GetOutputPort("state").Eval(context)
        np.testing.assert_array_equal(state, expected[k])
        force = world.GetOutputPort("external_force").Eval(context)
        # Not just any time: the viscosity of this very k.
        np.testing.assert_allclose(force, -60.0 * k * DT / 2.0 * state[2:], rtol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_the_drawn_springs_pull_with_moderate_forces(seed):
    world, target = draw(MultiSpringConfig(seed=seed))
    anchors, springs = springs_of(world)
    circle = (target.radius, target.duration_sec, target.phase, float(target.turn))
    forces = [
        external_force(
            circle_target(t, *circle)[:4],
            t,
            THIN,
            RAMP,
            anchors,
            springs,
        )
        for t in np.linspace(0.0, 6.0, 100)
    ]
    sizes = np.linalg.norm(forces, axis=1)
    # Nominally 7 to 40 N; stiffness and distance each within 20 %.
    assert 20.0 < sizes.max() < 75.0
    k = np.array([spring.stiffness for spring in world.springs])
    assert (abs(k / [20.0, 40.0, 60.0] - 1.0) <= 0.2).all()


def test_training_and_test_share_the_circle_but_neither_viscosity_nor_noise():
    config = PorridgeConfig(seed=4)
    (train, circle, noise), (test, same, other) = (
        draw_porridge(config, training) for training in (True, False)
    )
    assert circle == same and noise != other
    assert train.viscosity == [0.0, 80.0] and 120.0 <= test.viscosity[1] <= 180.0
    assert draw_porridge(config, False) == (test, same, other)


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(mass=0.0), "mass is 0.0, expected > 0"),
        (dict(ramp_sec=-1.0), "ramp_sec is -1.0"),
        (dict(viscosity=[0.0, -1.0]), "viscosity is"),
        (dict(viscosity=[0.0]), "viscosity is"),
        (
            dict(springs=[SpringConfig([0.0], 1.0, 0.1)]),
            r"springs\[0\].anchor is \[0.0\]",
        ),
        (
            dict(springs=[SpringConfig([0.0, 1.0], 1.0, -0.1)]),
            r"springs\[0\] is .*rest_length=-0.1.* expected numbers >= 0",
        ),
    ],
)
def test_wrong_worlds_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        PlanarWorld(PlanarWorldConfig(**changes), np.zeros(4))


def test_other_bad_input_is_refused_by_name():
    with pytest.raises(ValueError, match="state is"):
        PlanarWorld(PlanarWorldConfig(), [0.0, np.nan, 0.0, 0.0])
    with pytest.raises(ValueError, match="turn is 2"):
        CircleTarget(CircleTargetConfig(turn=2))
    with pytest.raises(ValueError, match="radius is 0"):
        CircleTarget(CircleTargetConfig(radius=0.0))
    with pytest.raises(ValueError, match="trials is 0"):
        draw(MultiSpringConfig(trials=0))
    with pytest.raises(ValueError, match="spread is 1.5"):
        draw(MultiSpringConfig(spread=1.5))
    with pytest.raises(ValueError, match="viscosity is"):
        draw_porridge(PorridgeConfig(viscosity=[80.0, 50.0]), True)
    with pytest.raises(ValueError, match="force_noise is -1"):
        draw_porridge(PorridgeConfig(force_noise=-1.0), True)


def test_a_meshcat_shows_effector_springs_path_and_viscosity():
    meshcat = Meshcat()
    controller = active_inference(ActiveInferenceConfig())
    diagram = make_multi_spring(MultiSpringConfig(), controller, meshcat)
    Simulator(diagram).AdvanceTo(0.2)
    for name in ("effector", "target", "spring_2/coil", "spring_0_anchor", "trace/3"):
        assert meshcat.HasPath(f"/makebreak/planar/{name}"), name
    assert not meshcat.HasPath("/makebreak/planar/viscosity")
    meshcat = Meshcat()
    controller = active_inference(ActiveInferenceConfig())
    diagram = make_porridge(PorridgeConfig(), controller, meshcat=meshcat)
    Simulator(diagram).AdvanceTo(0.1)
    assert meshcat.HasPath("/makebreak/planar/viscosity")
    assert not meshcat.HasPath("/makebreak/planar/spring_0")

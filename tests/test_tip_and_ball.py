"""What the planner knows of an arm that rolls a ball."""

import numpy as np
import pytest

from makebreak.models.tip_and_ball import TipAndBall, make_tip_and_ball
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs, ContactPair
from makebreak.systems.contact_mpc.numerics.ball_state import (
    P_BALL,
    P_TIP,
    V_BALL,
    V_TIP,
    W_BALL,
    pack,
    rolling_velocity,
)
from makebreak.systems.contact_mpc.numerics.lcs import simulate

MODEL = TipAndBall(tip_mass=1.5, tip_radius=0.02, ball_mass=0.1, ball_radius=0.04)
PAIRS = [
    ContactPair("tip::tip", "ball::ball", 1.0),
    ContactPair("ball::ball", "table::table", 1.0),
]


@pytest.fixture(scope="module")
def made():
    return make_tip_and_ball(MODEL)


def test_state_is_laid_out_as_the_estimator_packs_it(made):
    _, plant, _ = made
    context = plant.CreateDefaultContext()
    p_tip, v_tip = [0.1, 0.2, 0.3], [0.4, 0.5, 0.6]
    p_ball, v_ball = [0.7, 0.8, 0.9], [1.0, 1.1, 0.0]
    x = pack(p_tip, v_tip, p_ball, v_ball, MODEL.ball_radius)
    plant.SetPositionsAndVelocities(context, x)
    tip, ball = plant.GetBodyByName("tip"), plant.GetBodyByName("ball")
    for body, p, v in ((tip, p_tip, v_tip), (ball, p_ball, v_ball)):
        X = plant.EvalBodyPoseInWorld(context, body)
        V = plant.EvalBodySpatialVelocityInWorld(context, body)
        np.testing.assert_allclose(X.translation(), p, atol=1e-15)
        np.testing.assert_allclose(V.translational(), v, atol=1e-15)
        np.testing.assert_allclose(X.rotation().matrix(), np.eye(3), atol=1e-15)
    omega = rolling_velocity(v_ball, MODEL.ball_radius)
    np.testing.assert_allclose(V.rotational(), omega, atol=1e-15)
    assert (x[W_BALL] == omega).all()


def test_lcs_of_it_is_built_on_the_fast_path_and_agrees_with_the_general_one(made):
    diagram = made[0]
    fast = AnitescuLcs(diagram, PAIRS, 0.1)
    slow = AnitescuLcs(diagram, PAIRS, 0.1, analytic=False)
    assert fast.is_analytic and not slow.is_analytic
    x = pack([0.5, 0.1, 0.1], [0.1, 0, 0], [0.51, 0.1, 0.04], [0, 0.1, 0], 0.04)
    a, b = (model.build(x, np.array([1.0, 2.0, 3.0])) for model in (fast, slow))
    for name in "ABDdEFHc":
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-9)


def test_force_moves_a_weightless_tip_of_the_given_mass_and_no_ball(made):
    dt, u = 0.1, np.array([0.3, -0.6, 0.9])
    x = pack([0.5, 0.0, 0.3], np.zeros(3), [0.5, 0.1, 0.04], np.zeros(3), 0.04)
    model = AnitescuLcs(made[0], PAIRS, dt)
    x_next, _ = simulate(model.build(x, u), x, u)
    np.testing.assert_allclose(x_next[V_TIP], dt * u / 1.5, atol=1e-12)
    moved = x_next[P_TIP] - x[P_TIP]
    np.testing.assert_allclose(moved, dt**2 * u / 1.5, atol=1e-12)
    # It lies on the table; eps_c lets it sink by eps_c m g dt, some 0.1 mm.
    np.testing.assert_allclose(x_next[P_BALL], x[P_BALL], atol=2e-4)
    np.testing.assert_allclose(x_next[V_BALL], 0.0, atol=2e-3)


def test_gap_is_the_distance_less_both_radii(made):
    x = pack([0.5, 0.0, 0.13], np.zeros(3), [0.5, 0.0, 0.045], np.zeros(3), 0.04)
    phi = AnitescuLcs(made[0], PAIRS, 0.1).build(x, np.zeros(3)).phi
    np.testing.assert_allclose(np.unique(phi.round(12)), [0.005, 0.025], atol=1e-12)


@pytest.mark.parametrize("name", ["tip_mass", "tip_radius", "ball_mass", "ball_radius"])
@pytest.mark.parametrize("value", [0.0, -0.1, np.nan])
def test_what_is_not_positive_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"^{name} is {value}, expected > 0$"):
        make_tip_and_ball(TipAndBall(**{name: value}))

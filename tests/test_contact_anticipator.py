from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from scipy.stats import chi2

from makebreak.systems.changing_contact.contact_anticipator import (
    ApproachSpeedConfig,
    ContactAnticipatorConfig,
    ContactFilterConfig,
    FirstApproachConfig,
    KalmanContactAnticipator,
    KnownReflexConfig,
)
from makebreak.systems.changing_contact.numerics.contact_anticipator import (
    BEND,
    FORCE_STD,
    REPEATS,
    capped,
    contact_stiffness,
    impact_speed,
    is_expected,
    measurement_covariance,
    next_impact,
    place_at,
    predict,
    semi_axes,
    speed_by_error,
    speed_by_regression,
    spread_along,
    update,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    BAD_INPUT,
    BROKEN,
    CHANGE_TIME,
    COUNT,
    DIRECTION,
    FOUND,
    FROM_MODE,
    IMPACT,
    IMPACTLESS,
    MADE,
    MEASURED,
    N_CONTACT,
    N_PHASE,
    N_TOUCH_MODE,
    N_TRANSITION,
    PEAK_FORCE,
    PHASE_SEGMENT,
    PHASE_SPEED,
    POSITION,
    SPEED,
    TIME,
    TO_MODE,
    TOUCH_MODE,
    ContactBelief,
    ExpectedContact,
)

DOWN, RIGHT = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])


def random_covariance(rng, size=1.0):
    A = rng.normal(size=(3, 3))
    return size**2 * (A @ A.T + 0.1 * np.eye(3))


def random_direction(rng):
    d = rng.normal(size=3)
    return d / np.linalg.norm(d)


# Kalman's filter.


def test_updates_give_the_batch_least_squares_answer():
    rng = np.random.default_rng(0)
    for _ in range(20):
        mean, P = rng.normal(size=3), random_covariance(rng)
        seen = [(rng.normal(size=3), random_covariance(rng, 0.3)) for _ in range(6)]
        information, vector = np.linalg.inv(P), np.linalg.solve(P, mean)
        for p, R in seen:
            information = information + np.linalg.inv(R)
            vector = vector + np.linalg.solve(R, p)
        x, C = mean, P
        for p, R in seen:
            x, C = update(x, C, p, R)
        # Condition numbers up to 1e3, so 1e-16 grows to 1e-12 at most.
        np.testing.assert_allclose(C, np.linalg.inv(information), atol=1e-11)
        np.testing.assert_allclose(x, np.linalg.solve(information, vector), atol=1e-11)


def textbook(mean, P, A, B, u, Q, p, R):
    """Predict and update, written out from Kalman's equations, with H = I."""
    x = A @ mean + B @ u
    P = A @ P @ A.T + Q
    S = P + R
    K = P @ np.linalg.inv(S)
    return x + K @ (p - x), (np.eye(3) - K) @ P


def test_a_moving_contact_is_filtered_as_in_the_textbook():
    rng = np.random.default_rng(1)
    x, P = rng.normal(size=3), random_covariance(rng)
    A, B = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    expected = x, P
    for _ in range(30):
        u, p = rng.normal(size=2), rng.normal(size=3)
        Q, R = random_covariance(rng, 0.2), random_covariance(rng, 0.5)
        expected = textbook(*expected, A, B, u, Q, p, R)
        x, P = update(*predict(x, P, Q, A, B, u), p, R)
        np.testing.assert_allclose(x, expected[0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(P, expected[1], rtol=1e-9, atol=1e-9)


def test_the_filter_is_consistent():
    # Truth drawn from the model: the normalised innovation squared of each step is
    # chi2(3) and independent of the others, so its sum over n is chi2(3 n).
    rng = np.random.default_rng(2)
    d = random_direction(rng)
    R, Q = measurement_covariance(d, 7e-4, 5e-3), 3e-4**2 * np.eye(3)
    total, n = 0.0, 0
    for _ in range(400):
        x, P = np.zeros(3), 0.08**2 * np.eye(3)
        truth = rng.multivariate_normal(x, P)
        for _ in range(5):
            p = rng.multivariate_normal(truth, R)
            innovation = p - x
            total += innovation @ np.linalg.solve(P + R, innovation)
            n += 1
            x, P = predict(*update(x, P, p, R), Q)
            truth = truth + rng.multivariate_normal(np.zeros(3), Q)
    low, high = chi2.ppf([0.001, 0.999], 3 * n)
    assert low < total < high


def test_many_updates_keep_the_covariance_positive_definite():
    # 1e5 apart in size along and across, 2000 times.
    rng = np.random.default_rng(3)
    x, P = np.zeros(3), 0.1**2 * np.eye(3)
    for _ in range(2000):
        R = measurement_covariance(random_direction(rng), 1e-6, 0.1)
        x, P = update(x, P, rng.normal(scale=1e-3, size=3), R)
        np.testing.assert_array_equal(P, P.T)
        np.linalg.cholesky(P)


def test_a_contact_informs_along_the_motion_and_weakly_across():
    d, P = DOWN, 0.08**2 * np.eye(3)
    R = measurement_covariance(d, 7e-4, 0.5)
    x, C = update(np.zeros(3), P, np.array([0.05, 0.05, 0.12]), R)
    np.testing.assert_allclose(spread_along(C, d), 7e-4, rtol=1e-3)
    np.testing.assert_allclose(spread_along(C, RIGHT), 0.08, rtol=0.02)
    np.testing.assert_allclose(x[2], 0.12, rtol=1e-3)
    assert abs(x[1]) < 0.003


def test_contacts_are_told_apart_along_the_motion_alone():
    contact = ExpectedContact(np.zeros(3), 1e-3**2 * np.eye(3), RIGHT)
    far_across = np.array([0.3, 0.0, -0.2])
    assert is_expected(contact, far_across, RIGHT, 1e-3, 3.0)
    # Sigma of the innovation: sqrt(2) mm; 3 of them: 4.24 mm.
    assert is_expected(contact, [0, 0.0042, 0], RIGHT, 1e-3, 3.0)
    assert not is_expected(contact, [0, 0.0043, 0], RIGHT, 1e-3, 3.0)
    assert not is_expected(contact, np.zeros(3), DOWN, 1e-3, 3.0)


# The region.


def test_the_semi_axes_are_on_the_surface():
    rng = np.random.default_rng(6)
    for _ in range(10):
        C, radius = random_covariance(rng), rng.uniform(0.5, 3.0)
        lengths, rotation = semi_axes(C, radius)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
        for length, axis in zip(lengths, rotation.T, strict=True):
            at = length * axis
            np.testing.assert_allclose(at @ np.linalg.solve(C, at), radius**2)


# The speed.


def impact_force(v, k, m, rng, noise=0.0):
    """Of a mass on a spring, F = v sqrt(k m), measured with noise [N]."""
    return v * np.sqrt(k * m) + (noise * rng.normal() if noise else 0.0)


@pytest.mark.parametrize("stiffness", 10.0 ** np.arange(3.0, 7.0, 0.5))
@pytest.mark.parametrize("first", [0.05, 0.003])
def test_regression_reaches_the_desired_force_at_any_stiffness(stiffness, first):
    rng = np.random.default_rng(7)
    s = ApproachSpeedConfig(first=FirstApproachConfig(first))
    v, impacts, forces = first, [], []
    for _ in range(20):
        forces.append(impact_force(v, stiffness, 5.0, rng, 0.2))
        impacts.append((v, max(forces[-1], 0.0)))
        new = speed_by_regression(impacts, 8.0)
        v = v if new is None else capped(new, v, s.growth, 1e-4, 1.0)
    # Noise of 0.2 N, less by the mean over some trials: 0.6 N is three sigma.
    np.testing.assert_allclose(forces[-5:], 8.0, atol=0.8)
    # Never more than the first: the cap keeps one noisy small impact from misleading.
    assert max(forces) <= max(forces[0], 8.0 + 0.8)


def test_the_error_rule_converges_while_beta_is_below_twice_dv_by_df():
    rng = np.random.default_rng(8)
    for gain, converges in ((0.2, True), (1.0, True), (1.9, True), (2.1, False)):
        slope = np.sqrt(2e4 * 5.0)  # dF/dv [N s/m].
        v = 0.05
        for _ in range(200):
            v = speed_by_error(v, 8.0, impact_force(v, 2e4, 5.0, rng), gain / slope)
        assert (abs(v * slope - 8.0) < 1e-6) == converges


def test_with_a_reflex_one_small_impact_gives_the_speed_of_the_wanted_one():
    # F of v by bisection, from the energy that spring and brake take.
    def force(v, k, m, gain, least):
        low, high = 0.0, 1e3
        for _ in range(60):
            F = 0.5 * (low + high)
            work = F**2 / (2 * k) + gain * max(F - least, 0.0) ** 2 / (2 * k)
            low, high = (F, high) if work < 0.5 * m * v**2 else (low, F)
        return low

    for k in (5e3, 2e5):
        small = force(0.01, k, 6.0, 4.0, 2.0)
        v = speed_by_regression([[0.01, small]], 8.0, 4.0, 2.0)
        np.testing.assert_allclose(force(v, k, 6.0, 4.0, 2.0), 8.0, rtol=1e-9)


@pytest.mark.parametrize("gain", [0.0, 4.0])
def test_what_was_never_felt_is_met_as_the_stiffest_surface_asks(gain):
    def mass(p, d):
        return 9.0 if abs(d[2]) > 0.5 else 4.0

    speed = ApproachSpeedConfig(
        first=FirstApproachConfig(stiffness_most=1e5, force=6.0),
        reflex=KnownReflexConfig(gain, 2.0),
    )
    wall = ExpectedContact([0.5, 0.3, 0], 0.08**2 * np.eye(3), RIGHT, segment=1)
    config = ContactAnticipatorConfig(speed=speed)
    trial = Trial(ContactBelief((prior(0.0), wall)), config, effective_mass=mass)
    v = [c.approach_speed for c in trial.belief().contacts]
    unbraked = 6.0 if gain == 0.0 else 10.0  # sqrt(36 + 4 * 16)
    np.testing.assert_allclose(v, unbraked / np.sqrt([9e5, 4e5]))
    # One that nobody expected is met again at that speed, too.
    trial.step([0.5, 0, 0.3], 3)
    trial.impact([0.7, 0.1, 0.3], RIGHT, 0.0, 0.0)
    np.testing.assert_allclose(
        trial.belief().contacts[2].approach_speed, unbraked / np.sqrt(4e5)
    )
    fast = replace(speed, most=0.004)
    slow = replace(config, speed=fast)
    trial = Trial(ContactBelief((wall,)), slow, effective_mass=mass)
    assert trial.belief().contacts[0].approach_speed == 0.004


def test_regression_is_the_conditional_mean_of_all_impacts():
    # log z_i = a_i + b x_i + noise with a walk a_i, b ~ N(1, BEND^2) and nothing known
    # of a_1: a joint Gaussian, conditioned at once.
    rng = np.random.default_rng(9)
    for drift in np.tile([0.01, 0.1], 10):
        v = 0.02 * np.exp(0.3 * rng.normal(size=6))
        F = 400.0 * v * np.exp(0.02 * rng.normal(size=6))
        x, n = np.log(v), np.arange(6)
        prior = drift**2 * np.minimum.outer(n, n) + 1e4  # Of a.
        noise = np.diag(REPEATS**2 + (FORCE_STD / F) ** 2)
        x_0 = x[0]
        S = prior + BEND**2 * np.outer(x - x_0, x - x_0) + noise
        innovation = np.linalg.solve(S, np.log(F) - (x - x_0))
        a = prior[-1] @ innovation
        b = 1.0 + BEND**2 * (x - x_0) @ innovation
        expected = np.exp(x_0 + (np.log(8.0) - a) / b)
        # 1e4 beside 1e-3 costs seven digits.
        np.testing.assert_allclose(
            speed_by_regression(np.c_[v, F], 8.0, drift=drift), expected, rtol=1e-6
        )
    assert speed_by_regression(np.zeros((0, 2)), 8.0) is None
    wrong = [[0.0, 5.0], [np.nan, 3.0], [0.1, -1.0]]
    assert speed_by_regression(wrong, 8.0) is None
    assert speed_by_regression([[0.02, 6.0]], 8.0) == pytest.approx(0.08 / 3)


def test_impacts_that_scatter_are_averaged_and_a_new_surface_is_followed_at_once():
    rng = np.random.default_rng(10)
    slope, v, forces, speeds = 400.0, 0.01, [], []
    impacts: list = []
    for _ in range(20):
        forces.append(slope * v * np.exp(0.04 * rng.normal()))
        impacts.append((v, forces[-1]))
        v = speed_by_regression(impacts, 8.0)
        speeds.append(v)
    # The speed varies by less than half of what a single impact does.
    assert np.std(np.log(speeds[4:])) < 0.02
    np.testing.assert_allclose(speeds[-1], 8.0 / slope, rtol=0.03)
    impacts.append((v, 2.0 * slope * v))  # Four times as stiff.
    assert speed_by_regression(impacts, 8.0) == pytest.approx(4.0 / slope, rel=1e-6)


def test_a_force_that_is_not_proportional_to_speed_is_met_by_the_third_impact():
    # F = 2 N + s v: a push that the arm adds while the impact lasts.
    v, impacts = 0.01, []
    for _ in range(3):
        impacts.append((v, 2.0 + 260.0 * v))
        v = speed_by_regression(impacts, 8.0)
    np.testing.assert_allclose(2.0 + 260.0 * v, 8.0, atol=0.3)


def test_the_first_impact_is_braked_otherwise_than_those_on_a_known_contact():
    k_m = 500.0  # sqrt(k m)
    F = 4.0
    first = np.sqrt(F**2 + 4.0 * (F - 2.0) ** 2) / k_m  # Braked from 2 N on.
    v = speed_by_regression([(first, F)], 8.0, 4.0, 2.0, 8.0)
    np.testing.assert_allclose(v, 8.0 / k_m)  # Not braked up to 8 N.
    np.testing.assert_allclose(
        speed_by_regression([(first, F), (v, 8.0)], 8.0, 4.0, 2.0, 8.0), v
    )


def test_stiffness_of_one_contact_gives_the_speed_at_another_mass():
    k = contact_stiffness(0.05, impact_force(0.05, 3e4, 7.0, None), 7.0)
    np.testing.assert_allclose(k, 3e4)
    v = impact_speed(8.0, k, 4.0)
    np.testing.assert_allclose(impact_force(v, 3e4, 4.0, None), 8.0)


# The past, and what is next.


def test_a_past_place_is_found_between_two_samples():
    t = np.arange(0.0, 1.0, 0.01)
    places = np.outer(t, [0.1, 0.2, 0.0])
    p, d = place_at(t, places, 0.4567)
    np.testing.assert_allclose(p, np.array([0.1, 0.2, 0.0]) * 0.4567)
    np.testing.assert_allclose(d, np.array([1.0, 2.0, 0.0]) / np.sqrt(5.0))
    assert place_at(t, places, 1.5) is None
    assert place_at(t, 0.0 * places, 0.5) is None


def test_the_next_impact_is_the_nearest_ahead_in_this_segment():
    C = 1e-3**2 * np.eye(3)
    contacts = [
        ExpectedContact([0, 0.3, 0], C, RIGHT, segment=1),
        ExpectedContact([0, 0.1, 0], C, RIGHT, segment=1),
        ExpectedContact([0, 0.2, 0], C, RIGHT, segment=1, kind=IMPACTLESS),
        ExpectedContact([0, 0.15, 0], C, RIGHT, segment=2),
    ]
    assert next_impact(contacts, IMPACT, 1, np.zeros(3)) == 1
    assert next_impact(contacts, IMPACT, 1, np.array([0, 0.15, 0])) == 0
    assert next_impact(contacts, IMPACT, 1, np.array([0, 0.4, 0])) is None
    assert next_impact(contacts, IMPACT, 0, np.zeros(3)) is None


# The system.


class Trial:
    """The anticipator with inputs that a test sets, at 100 Hz."""

    def __init__(self, knowledge=None, config=None, **arguments):
        builder = DiagramBuilder()
        self.system = builder.AddSystem(
            KalmanContactAnticipator(
                config or ContactAnticipatorConfig(), knowledge, **arguments
            )
        )
        self.sources = {}
        for name, size in (
            ("ee_pose", 7),
            ("contact", N_CONTACT),
            ("transition", N_TRANSITION),
            ("touch_mode", N_TOUCH_MODE),
            ("phase", N_PHASE),
        ):
            source = builder.AddSystem(ConstantVectorSource(np.zeros(size)))
            builder.Connect(source.get_output_port(), self.system.GetInputPort(name))
            self.sources[name] = source
        self.simulator = Simulator(builder.Build())
        self.root = self.simulator.get_mutable_context()
        self.context = self.system.GetMyContextFromRoot(self.root)
        self.values = {
            n: np.zeros(s.get_output_port().size()) for n, s in self.sources.items()
        }
        self.ticks = 0

    def step(self, p=None, segment=None):
        if p is not None:
            self.values["ee_pose"][:3] = p
        if segment is not None:
            self.values["phase"][PHASE_SEGMENT] = segment
        for name, source in self.sources.items():
            value = source.get_mutable_source_value(
                source.GetMyMutableContextFromRoot(self.root)
            )
            value.SetFromVector(self.values[name])
        self.simulator.AdvanceTo(0.01 * self.ticks + 0.005)
        self.ticks += 1

    @property
    def time(self):
        return 0.01 * (self.ticks - 1)

    def impact(self, p, d, speed=0.05, force=10.0, late=0.02):
        c = self.values["contact"]
        c[MADE] += 1
        c[TIME], c[POSITION], c[DIRECTION], c[SPEED] = self.time - late, p, d, speed
        self.step()
        c[PEAK_FORCE], c[MEASURED] = force, c[MEASURED] + 1
        self.step()

    def change(self, when, before, after):
        t = self.values["transition"]
        t[COUNT] += 1
        t[CHANGE_TIME], t[FROM_MODE], t[TO_MODE] = when, before, after
        self.step()

    def out(self, port):
        return float(self.system.GetOutputPort(port).Eval(self.context)[0])

    def belief(self):
        belief = self.system.GetOutputPort("contacts").Eval(self.context)
        assert belief is self.system.knowledge(self.context)
        return belief

    def walk(self, start, d, speed, seconds, segment):
        """Moves the tip along a line; returns where it ends."""
        for k in range(round(100 * seconds)):
            p = start + d * speed * 0.01 * k
            self.step(p, segment)
        return p


def prior(error=0.12, sigma=0.08, **changes):
    return ExpectedContact(
        [0.5, 0.0, error], sigma**2 * np.eye(3), DOWN, segment=0, **changes
    )


def test_five_trials_learn_place_and_speed():
    rng = np.random.default_rng(0)
    belief = ContactBelief((prior(),))
    truth, slope, sigmas = np.array([0.5, 0.0, 0.0]), 350.0, []
    for _ in range(5):
        trial = Trial(belief)
        trial.walk(truth - 0.1 * DOWN, DOWN, 0.1, 1.0, 0)
        v = trial.out("approach_speed")
        noise = 3e-4 * rng.normal(size=3) + 3e-3 * RIGHT * rng.normal()
        trial.impact(truth + noise, DOWN, v, slope * v)
        belief = trial.belief()
        sigmas.append(spread_along(belief.contacts[0].covariance, DOWN))
    (contact,) = belief.contacts
    assert contact.seen == 5 and contact.impacts.shape == (5, 2)
    assert abs(contact.mean[2]) < 1e-3 and np.all(np.diff(sigmas) < 0.0)
    # Steady state of the scalar filter: P = (-Q + sqrt(Q^2 + 4 Q R))/2 + ... > this.
    assert sigmas[-1] < 7e-4 / np.sqrt(2.0)
    np.testing.assert_allclose(contact.approach_speed * slope, 8.0, rtol=1e-9)


def test_a_contact_tells_where_another_of_known_distance_is_until_it_is_felt(tmp_path):
    top = ExpectedContact(
        [0.6, 0.2, 0.09], 0.015**2 * np.eye(3), DOWN, segment=6,
        known_from=(0, -0.06, 0.002),
    )  # fmt: skip
    wall = ExpectedContact([0.6, 0.2, 0.09], 0.015**2 * np.eye(3), RIGHT, segment=2,
                           known_from=(0, 0.0, 0.002))  # fmt: skip
    belief = ContactBelief((prior(0.02, 0.015), top, wall))
    belief.save(tmp_path / "belief.json")
    trial = Trial(ContactBelief.load(tmp_path / "belief.json"))
    truth = np.array([0.5, 0.0, 0.01])
    trial.walk(truth - 0.1 * DOWN, DOWN, 0.1, 1.0, 0)
    trial.impact(truth, DOWN)
    _, there, other = trial.belief().contacts
    # The gain is 1 - (2.1/15)^2, so the estimate of 20 mm too much leaves 0.4 mm.
    assert there.mean[2] == pytest.approx(0.01 + 0.06, abs=5e-4)
    np.testing.assert_allclose(there.mean[:2], [0.6, 0.2], atol=1e-9)
    sigma = spread_along(there.covariance, DOWN)
    assert sigma == pytest.approx(np.hypot(0.002, 0.0007), rel=0.02)
    assert spread_along(there.covariance, RIGHT) == pytest.approx(0.015, rel=1e-6)
    assert there.seen == 0 and len(there.impacts) == 0  # Its stiffness is not known.
    np.testing.assert_allclose(other.mean, wall.mean)  # Another direction.
    # Once it was felt, its own position counts.
    trial.walk([0.6, 0.2, 0.1], DOWN, 0.05, 0.6, 6)
    trial.impact([0.6, 0.2, 0.0715], DOWN)
    again = Trial(trial.belief())
    again.walk(truth - 0.1 * DOWN, DOWN, 0.1, 1.0, 0)
    before = again.belief().contacts[1]
    again.impact(truth, DOWN)
    np.testing.assert_array_equal(again.belief().contacts[1].mean, before.mean)


def test_from_trial_to_trial_a_contact_that_was_felt_drifts():
    told, felt = prior(0.0, 1e-3), replace(prior(0.0, 1e-3), seen=1)
    first, second = Trial(ContactBelief((told, felt))).belief().contacts
    np.testing.assert_array_equal(first.covariance, told.covariance)
    expected = (1e-3**2 + 3e-4**2) * np.eye(3)
    np.testing.assert_allclose(second.covariance, expected)


def test_speed_by_eq_9_and_its_caps():
    config = ContactAnticipatorConfig(speed=ApproachSpeedConfig(regression=False))
    trial = Trial(ContactBelief((prior(0.0),)), config)
    trial.walk(np.array([0.5, 0, 0.1]), DOWN, 0.1, 1.0, 0)
    trial.impact([0.5, 0, 0], DOWN, 0.05, 10.0)
    expected = 0.05 + 0.002 * (8.0 - 10.0)
    assert trial.belief().contacts[0].approach_speed == pytest.approx(expected)
    trial = Trial(ContactBelief((prior(0.0),)), config)
    trial.walk(np.array([0.5, 0, 0.1]), DOWN, 0.1, 1.0, 0)
    trial.impact([0.5, 0, 0], DOWN, 0.05, 80.0)  # Would be negative.
    assert trial.belief().contacts[0].approach_speed == pytest.approx(0.001)
    trial = Trial(ContactBelief((prior(0.0),)))
    trial.step(np.array([0.5, 0, 0.1]), 0)
    trial.impact([0.5, 0, 0], DOWN, 0.05, 1.0)  # Would be eight times as fast.
    assert trial.belief().contacts[0].approach_speed == pytest.approx(0.07)


def test_an_impact_counts_with_the_speed_that_was_planned_where_there_was_one():
    # A tip that lags behind will lag again.
    for planned, expected in ((0.0, 0.04), (0.05, 0.05)):
        trial = Trial(ContactBelief((prior(0.0),)))
        trial.values["phase"][PHASE_SPEED] = planned
        trial.walk(np.array([0.5, 0, 0.1]), DOWN, 0.1, 0.5, 0)
        assert trial.out("impact_known") == 0.0
        trial.impact([0.5, 0, 0], DOWN, 0.04, 8.0)
        impacts = trial.belief().contacts[0].impacts
        np.testing.assert_allclose(impacts, [[expected, 8.0]])
        assert trial.out("impact_known") == 1.0


def test_the_first_stiffness_is_carried_over_to_contacts_not_felt():
    config = ContactAnticipatorConfig(
        speed=ApproachSpeedConfig(first=FirstApproachConfig(carry_over=True))
    )
    wall = ExpectedContact([0.5, 0.3, 0], 0.08**2 * np.eye(3), RIGHT, segment=1)

    def mass(p, d):
        return 7.0 if abs(d[2]) > 0.5 else 4.0

    trial = Trial(ContactBelief((prior(0.0), wall)), config, effective_mass=mass)
    trial.step([0.5, 0, 0.1], 0)
    trial.impact([0.5, 0, 0], DOWN, 0.05, 0.05 * np.sqrt(2e4 * 7.0))
    speed = trial.belief().contacts[1].approach_speed
    np.testing.assert_allclose(speed * np.sqrt(2e4 * 4.0), 8.0)
    assert len(trial.belief().contacts[1].impacts) == 0


def test_an_unknown_contact_is_added_and_expected_next_time():
    trial = Trial()
    trial.walk(np.array([0.5, 0, 0]), RIGHT, 0.1, 1.0, 3)
    trial.impact([0.5, 0.1, 0], RIGHT)
    (contact,) = trial.belief().contacts
    assert (contact.kind, contact.segment, contact.seen) == (IMPACT, 3, 1)
    np.testing.assert_allclose(contact.mean, [0.5, 0.1, 0])
    np.testing.assert_allclose(spread_along(contact.covariance, RIGHT), 7e-4)
    again = Trial(trial.belief())
    again.walk(np.array([0.5, 0, 0]), RIGHT, 0.1, 0.5, 3)
    assert again.out("approach_speed") == contact.approach_speed
    again.step(segment=2)
    assert again.out("approach_speed") == 0.0


def test_a_contact_beyond_the_gate_is_another_one():
    known = replace(prior(0.0, 1e-3), seen=2)
    trial = Trial(ContactBelief((known,)))
    trial.walk(np.array([0.5, 0, 0.1]), DOWN, 0.1, 0.5, 0)
    trial.impact([0.5, 0.0, 0.03], DOWN)
    first, second = trial.belief().contacts
    np.testing.assert_allclose(first.mean, known.mean)
    assert second.seen == 1


def test_the_segment_of_a_contact_is_that_before_it():
    # The motion has gone on to segment 1 by the time the contact is reported.
    trial = Trial(ContactBelief((prior(0.0),)))
    trial.walk(np.array([0.5, 0, 0.05]), DOWN, 0.1, 0.5, 0)
    trial.step(segment=1)
    trial.impact([0.5, 0, 0], DOWN, late=0.03)
    (contact,) = trial.belief().contacts
    assert contact.segment == 0 and contact.seen == 1


def test_two_detections_of_one_contact_count_once():
    trial = Trial(ContactBelief((prior(0.0),)))
    trial.walk(np.array([0.5, 0, 0.05]), DOWN, 0.1, 0.5, 0)
    trial.impact([0.5, 0, 0], DOWN, 0.05, 17.0)
    once = trial.belief()
    trial.impact([0.5, 0, 0.0005], DOWN, 0.01, 3.0)
    trial.step(segment=1)
    trial.step()
    trial.impact([0.5, 0.001, 0.0005], DOWN, 0.01, 3.0, late=0.0)
    assert trial.belief() is once
    # Further away, but within the gate of a poor sensor: the same, too.
    config = ContactAnticipatorConfig(filter=ContactFilterConfig(std_along=0.005))
    trial = Trial(ContactBelief((prior(0.0),)), config)
    trial.walk(np.array([0.5, 0, 0.05]), DOWN, 0.1, 0.5, 0)
    trial.impact([0.5, 0, 0], DOWN, 0.05, 17.0)
    once = trial.belief()
    trial.impact([0.5, 0, -0.012], DOWN, 0.01, 3.0)
    assert trial.belief() is once


def test_a_passed_contact_becomes_uncertain_and_is_given_up():
    belief = ContactBelief((replace(prior(0.0, 7e-4), seen=1),))
    sigmas = []
    for _ in range(8):
        trial = Trial(belief)
        trial.walk(np.array([0.5, 0, 0.05]), DOWN, 0.2, 0.8, 0)
        belief = trial.belief()
        if not belief.contacts:
            break
        sigmas.append(spread_along(belief.contacts[0].covariance, DOWN))
    assert not belief.contacts and 3 <= len(sigmas) <= 6
    np.testing.assert_allclose(np.diff(np.log2(sigmas)), 1.0, atol=0.2)
    # One that was only told, not felt, stays.
    trial = Trial(ContactBelief((prior(0.0, 7e-4),)))
    trial.walk(np.array([0.5, 0, 0.05]), DOWN, 0.2, 0.8, 0)
    np.testing.assert_allclose(
        trial.belief().contacts[0].covariance, 7e-4**2 * np.eye(3)
    )


def slid(belief=None, when=0.7, confirmed=0.85, modes=(1, 2), segment=1):
    """A trial in which the surface changes at y = 0.07 and is known at y = 0.085."""
    trial = Trial(belief)
    for k in range(120):
        y = 0.1 * 0.01 * k
        trial.step([0.5, y, 0.0], segment)
        if abs(trial.time - confirmed) < 1e-6:
            trial.change(when, *modes)
    return trial


def test_a_change_without_impact_is_placed_at_its_change_time():
    trial = slid()
    (contact,) = trial.belief().contacts
    assert (contact.kind, contact.segment) == (IMPACTLESS, 1)
    assert (contact.from_mode, contact.to_mode) == (1, 2)
    np.testing.assert_allclose(contact.mean, [0.5, 0.07, 0.0], atol=1e-9)
    np.testing.assert_allclose(contact.direction, RIGHT, atol=1e-9)
    again = slid(trial.belief(), when=0.705, confirmed=0.8)
    (contact,) = again.belief().contacts
    assert contact.seen == 2 and abs(contact.mean[1] - 0.07) < 5e-4
    assert spread_along(contact.covariance, RIGHT) < 0.0016


@pytest.mark.parametrize(
    "changes",
    [
        {"modes": (0, 1)},  # From free motion.
        {"modes": (-1, 2)},
        {"modes": (2, 2)},
        {"when": 0.1, "confirmed": 0.2},  # The beginning of the segment.
        {"when": -5.0},  # Longer ago than anyone remembers.
    ],
)
def test_other_changes_of_mode_are_no_contacts(changes):
    assert slid(**changes).belief().contacts == ()


def test_the_mode_is_hinted_from_the_expected_place_on():
    known = slid().belief()
    trial, hints = Trial(known), []
    for k in range(150):
        trial.step([0.5, 0.001 * k, 0.0], 1)
        hints.append(trial.out("mode_hint"))
    at = np.flatnonzero(np.array(hints) == 2.0)
    sigma = spread_along(known.contacts[0].covariance, RIGHT)
    assert at[0] in (70, 71) and np.all(np.diff(at) == 1)
    assert abs(at[-1] - (70 + 1e3 * (3.0 * sigma + 0.02))) < 2
    assert set(hints) == {-1.0, 2.0}
    # In another segment, at the same place, nothing changes.
    trial = Trial(known)
    trial.step([0.5, 0.072, 0.0], 2)
    assert trial.out("mode_hint") == -1.0


def touched(trial, mode):
    """A touch whose mode is found out a while after; hints before and after that."""
    hints = [trial.out("touch_hint")]
    trial.impact([0.5, 0.0, 0.0], DOWN)
    hints.append(trial.out("touch_hint"))
    trial.values["contact"][BROKEN] += 1  # A bounce.
    trial.step()
    hints.append(trial.out("touch_hint"))
    trial.values["touch_mode"][[FOUND, TOUCH_MODE]] += [1, mode]
    trial.step()
    return [*hints, trial.out("touch_hint")]


def test_the_mode_that_a_contact_brought_is_told_when_it_is_felt_again():
    first = Trial()
    first.step([0.5, 0.0, 0.01], 0)
    assert touched(first, 2) == [-1.0] * 4
    assert first.belief().contacts[0].to_mode == 2
    again = Trial(first.belief())
    again.step([0.5, 0.0, 0.01], 0)
    # Until it is found out: then the mode detector knows better.
    assert touched(again, 3) == [-1.0, 2.0, 2.0, -1.0]
    assert again.belief().contacts[0].to_mode == 3


def test_a_hint_may_lead_by_a_time():
    known = slid().belief()
    config = ContactAnticipatorConfig(hint_lead_sec=0.05)
    trial, hints = Trial(known, config), []
    for k in range(150):  # 0.1 m/s: 5 mm ahead.
        trial.step([0.5, 0.001 * k, 0.0], 1)
        hints.append(trial.out("mode_hint"))
    assert np.flatnonzero(np.array(hints) == 2.0)[0] in (65, 66)
    with pytest.raises(ValueError, match="hint_lead_sec is -1"):
        Trial(known, ContactAnticipatorConfig(hint_lead_sec=-1.0))


@pytest.mark.parametrize("port", ["ee_pose", "contact", "transition", "phase"])
def test_a_bad_input_holds_the_belief_and_is_said(port):
    trial = Trial(ContactBelief((prior(),)))
    trial.walk(np.array([0.5, 0, 0.3]), DOWN, 0.1, 0.3, 0)
    before = trial.belief()
    good = trial.values[port].copy()
    trial.values[port][0] = np.nan
    trial.values["contact"][MADE] += 1
    trial.step()
    assert trial.out("status") == BAD_INPUT and trial.belief() is before
    trial.values[port] = good
    trial.values["contact"][MADE] = 0
    trial.step()
    assert trial.out("status") == 0


def test_a_contact_without_direction_is_not_believed():
    trial = Trial(ContactBelief((prior(),)))
    trial.step([0.5, 0, 0.3], 0)
    before = trial.belief()
    trial.impact([0.5, 0, 0.2], np.zeros(3))
    assert trial.belief() is before


def test_the_memory_is_in_the_context():
    trial = Trial(ContactBelief((prior(0.0),)))
    trial.walk(np.array([0.5, 0, 0.05]), DOWN, 0.1, 0.5, 0)
    saved = trial.root.Clone()
    trial.impact([0.5, 0, 0], DOWN)
    assert trial.belief().contacts[0].seen == 1
    old = trial.system.knowledge(trial.system.GetMyContextFromRoot(saved))
    assert old.contacts[0].seen == 0


def test_a_belief_is_saved_and_read_as_it_was(tmp_path):
    trial = slid()
    trial.step(segment=2)
    trial.impact([0.5, 0.1, 0], RIGHT, late=0.0)
    belief = trial.belief()
    belief.save(tmp_path / "belief.json")
    read = ContactBelief.load(tmp_path / "belief.json")
    assert len(read.contacts) == len(belief.contacts) == 2
    for a, b in zip(read.contacts, belief.contacts, strict=True):
        for name, value in vars(b).items():
            np.testing.assert_array_equal(getattr(a, name), value, err_msg=name)


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "belief.json"),
        ("{}", "contacts"),
        ('{"contacts": [{"mean": [0, 0, 0]}]}', "belief.json"),
        (
            '{"contacts": [{"mean": [0, 0, 0], "direction": [0, 0, 1], "covariance": '
            "[[1, 0, 0], [0, 1, 0], [0, 0, -1]]}]}",
            "positive definite",
        ),
    ],
)
def test_a_file_that_is_no_belief_is_refused(tmp_path, text, words):
    (tmp_path / "belief.json").write_text(text)
    with pytest.raises(ValueError, match=words):
        ContactBelief.load(tmp_path / "belief.json")
    with pytest.raises(ValueError, match="missing.json"):
        ContactBelief.load(tmp_path / "missing.json")


@pytest.mark.parametrize(
    "config, words",
    [
        (
            ContactAnticipatorConfig(filter=ContactFilterConfig(std_along=0.0)),
            "std_along is 0.0, expected a positive",
        ),
        (
            ContactAnticipatorConfig(
                speed=ApproachSpeedConfig(first=FirstApproachConfig(np.nan))
            ),
            "first.speed is nan",
        ),
        (
            ContactAnticipatorConfig(speed=ApproachSpeedConfig(growth=0.5)),
            "growth is 0.5, expected 1 or more",
        ),
    ],
)
def test_bad_configs_are_refused(config, words):
    with pytest.raises(ValueError, match=words):
        KalmanContactAnticipator(config)

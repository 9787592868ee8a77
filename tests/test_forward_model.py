"""Forward models: the bank's maths, then the system in a small diagram."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from makebreak.systems.changing_contact.forward_model import (
    ForwardModelBank,
    ForwardModelConfig,
    HandoverConfig,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    FREE_MODE,
    UNKNOWN_MODE,
)
from makebreak.systems.changing_contact.numerics.forward_model import (
    BAD_WRENCH,
    NO_MODEL,
    OK,
    BankMemory,
    BankTuning,
    ModelBank,
    against_motion,
    bank_tuning,
    load_ahead,
    observe,
    speed_along,
)
from makebreak.systems.changing_contact.numerics.igmm import (
    as_vector,
    empty_mixture,
    learned,
    regress,
)
from makebreak.systems.changing_contact.numerics.motion_feature import (
    magnitudes,
    motion_wrench,
)

DOWN = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])


def tuning(**changes):
    values = dict(
        mixtures=bank_tuning(changes.get("with_torque", True)),
        with_torque=True,
        learns=True,
        smoothing=0.3,
        wrench_limit=200.0,
        error_unknown=10.0,
    )
    return BankTuning(**(values | changes))


class Slide:
    """A tool that slides in a circle over a surface: Coulomb friction and noise."""

    def __init__(self, seed=0, noise=0.1, R=8.0, speed=0.1):
        self.rng = np.random.default_rng(seed)
        self.noise, self.R, self.speed, self.k = noise, R, speed, 0

    def sample(self, mu):
        """wrench, velocity, direction."""
        d = np.array([np.cos(0.004 * self.k), np.sin(0.004 * self.k), 0.0])
        self.k += 1
        wrench = np.zeros(6)
        wrench[:3] = -mu * self.R * d
        wrench[2] = self.R
        wrench[3:] = 0.015 * mu * self.R * np.array([-d[1], d[0], 0.0])
        wrench += self.noise * self.rng.normal(size=6) * np.repeat([1.0, 0.1], 3)
        velocity = np.concatenate([self.speed * d, np.zeros(3)])
        velocity += 1e-3 * self.rng.normal(size=6)
        return wrench, velocity, d


def feed(memory, t, slide, mu, mode, n):
    """Memories after each of n samples."""
    memories = []
    for _ in range(n):
        memory = observe(memory, t, *slide.sample(mu), DOWN, mode)
        memories.append(memory)
    return memories


def test_motion_wrench_is_the_projection_of_numpy():
    rng = np.random.default_rng(0)
    for rows in (0, 1, 2):
        for _ in range(20):
            wrench, n = rng.normal(size=6), np.zeros((2, 3))
            n[:rows] = rng.normal(size=(rows, 3))
            out = motion_wrench(wrench, n.ravel())
            basis = n[:rows].T
            F_t = wrench[:3] - basis @ np.linalg.pinv(basis) @ wrench[:3]
            unit = n[:rows] / np.linalg.norm(n[:rows], axis=1)[:, None]
            np.testing.assert_allclose(out[:3], F_t, atol=1e-12)
            np.testing.assert_array_equal(out[3:6], wrench[3:])
            R = np.maximum(-unit @ wrench[:3], 0.0).sum()
            np.testing.assert_allclose(out[6:], [R, rows], atol=1e-12)


def test_a_row_given_twice_counts_once():
    wrench, n = np.array([1.0, 2.0, 8.0, 0, 0, 0]), np.tile([0.0, 0.0, -2.0], 2)
    expected = [1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 8.0, 1.0]
    np.testing.assert_allclose(motion_wrench(wrench, n), expected, atol=1e-12)


def test_magnitudes_leave_out_what_presses():
    wrench = np.array([-3.0, 4.0, 9.0, 0.3, 0.0, 0.4])
    velocity = np.array([0.3, 0.4, -0.7, 0.0, 2.0, 0.0])
    out = magnitudes(wrench, velocity, DOWN)
    np.testing.assert_allclose(out, [0.5, 2.0, 5.0, 0.5, 9.0], rtol=1e-12)


def test_a_bank_is_the_mixture_over_eq_2_and_3_and_its_regression():
    """The same by hand: X_t = [S_{t-1}, D_t], f(S_t), eps low-passed."""
    t, slide = tuning(), Slide()
    memory, mixture, S, eps = BankMemory(ModelBank()), None, None, 0.0
    predicted = np.zeros(2)
    mixture = empty_mixture(t.mixtures)
    for k in range(200):
        wrench, velocity, d = slide.sample(0.4)
        memory = observe(memory, t, wrench, velocity, d, DOWN, 1)
        F = np.hypot(wrench[0], wrench[1])
        D = np.array([F, np.linalg.norm(wrench[3:])])
        eps += 0.3 * (abs(F - predicted[0]) - eps)
        np.testing.assert_allclose(memory.error, eps, atol=1e-12)
        if S is not None:
            mixture, _ = learned(mixture, [*S, *D], t.mixtures)
        v, w = np.hypot(*velocity[:2]), np.linalg.norm(velocity[3:])
        S = [v, w, *D]
        predicted = regress(mixture, S)[0] if k else D
        # The same operations but for the order of sums under the roots.
        np.testing.assert_allclose(memory.predicted, predicted, rtol=1e-9)
        np.testing.assert_allclose(memory.wrench[:3], -predicted[0] * d, rtol=1e-9)


@pytest.mark.parametrize("with_torque", [True, False])
@pytest.mark.parametrize("correction", [0.0, 0.05])
def test_prediction_comes_as_near_as_the_noise_lets_it(with_torque, correction):
    mixtures = bank_tuning(with_torque)
    t = tuning(with_torque=with_torque, mixtures=mixtures, correction=correction)
    slide = Slide()
    memories = feed(BankMemory(ModelBank()), t, slide, 0.4, 1, 2000)
    raw = [abs(m.predicted[0] - 3.2) for m in memories[500:]]
    # Of white noise 0.1 N nothing can be foretold; the mean can: to a fraction of it.
    assert np.mean(raw) < 0.03
    # E|noise| = 0.1 sqrt(2/pi) = 0.080 N.
    errors = [m.error for m in memories[500:]]
    np.testing.assert_allclose(np.mean(errors), 0.080, atol=0.01)


def test_a_small_offset_that_stays_is_corrected():
    """0.16 N more than the mixture has learned, less than a new component needs."""
    left = {}
    for correction in (0.0, 0.05):
        t, slide = tuning(correction=correction), Slide()
        memory = feed(BankMemory(ModelBank()), t, slide, 0.4, 1, 2000)[-1]
        memories = feed(memory, t, slide, 0.42, 1, 300)
        left[correction] = np.mean([3.36 - m.predicted[0] for m in memories[100:]])
    assert left[0.0] > 0.05 and abs(left[0.05]) < 0.02, left


def test_an_impact_is_no_offset():
    t, slide = tuning(correction=0.05), Slide()
    memory = feed(BankMemory(ModelBank()), t, slide, 0.4, 1, 400)[-1]
    before = memory.offset[0]
    memories = feed(memory, t, slide, 1.4, 1, 4)  # 8 N more, for 20 ms.
    assert abs(memories[-1].offset[0] - before) < 0.05


def test_the_offset_of_one_mode_is_not_that_of_the_next():
    t, slide = tuning(correction=0.05), Slide()
    memory = feed(BankMemory(ModelBank()), t, slide, 0.2, 1, 400)[-1]
    memory = feed(memory, t, slide, 0.3, 1, 60)[-1]
    assert memory.offset[0] != 0.0
    (memory,) = feed(memory, t, slide, 0.5, 2, 1)
    np.testing.assert_array_equal(memory.offset, 0.0)


def test_an_announced_mode_s_model_begins_without_an_offset():
    for memory in across(tuning(handover=10, correction=0.05), announced=True)[60:70]:
        np.testing.assert_array_equal(memory.offset, 0.0)
        np.testing.assert_allclose(memory.predicted[0], 4.0, atol=0.1)


def test_each_mode_keeps_its_own_model_and_uses_it_again():
    t, slide = tuning(), Slide()
    memory = feed(BankMemory(ModelBank()), t, slide, 0.2, 1, 400)[-1]
    first = as_vector(memory.bank.get(1))
    memories = feed(memory, t, slide, 0.5, 2, 400)
    memory = memories[-1]
    np.testing.assert_array_equal(as_vector(memory.bank.get(1)), first)
    np.testing.assert_allclose(memory.predicted[0], 4.0, atol=0.1)
    # Back on surface 1 the force falls by 2.4 N; its model knows where to.
    memories = feed(memory, t, slide, 0.2, 1, 5)
    assert all(abs(m.predicted[0] - 1.6) < 0.15 for m in memories)


def test_a_new_model_starts_from_the_force_that_is_there():
    t, slide = tuning(), Slide()
    memory = feed(BankMemory(ModelBank()), t, slide, 0.5, 1, 1)[0]
    np.testing.assert_allclose(memory.predicted[0], 4.0, atol=0.5)
    assert memory.status == OK


def test_without_learning_the_models_stay_and_unknown_modes_predict_zero():
    memory = feed(BankMemory(ModelBank()), tuning(), Slide(), 0.3, 1, 300)[-1]
    before = as_vector(memory.bank.get(1))
    fixed = tuning(learns=False)
    memories = feed(BankMemory(memory.bank), fixed, Slide(1), 0.6, 1, 100)
    np.testing.assert_array_equal(as_vector(memories[-1].bank.get(1)), before)
    # Trained on 2.4 N it does not come up to the 4.8 N that are there.
    assert memories[-1].error > 1.0
    last = feed(memories[-1], fixed, Slide(2), 0.6, 2, 3)[-1]
    np.testing.assert_array_equal(last.wrench, 0.0)
    assert last.status == NO_MODEL


@pytest.mark.parametrize("mode", [FREE_MODE, UNKNOWN_MODE])
def test_without_a_mode_it_predicts_nothing_and_says_what_that_misses(mode):
    t = tuning(smoothing=1.0)
    memory = feed(BankMemory(ModelBank()), t, Slide(noise=0.0), 0.5, mode, 3)[-1]
    np.testing.assert_array_equal(memory.wrench, 0.0)
    np.testing.assert_allclose(memory.error, 4.0, rtol=1e-12)
    assert memory.status == NO_MODEL and not memory.bank.models


@pytest.mark.parametrize("bad", [np.nan, np.inf, 200.0, -250.0])
def test_a_wrench_that_cannot_be_used_is_said_and_teaches_nothing(bad):
    t, slide = tuning(), Slide()
    memory = feed(BankMemory(ModelBank()), t, slide, 0.4, 1, 300)[-1]
    wrench, velocity, d = slide.sample(0.4)
    wrench[1] = bad
    held = observe(memory, t, wrench, velocity, d, DOWN, 1)
    assert held.bank is memory.bank and held.status == BAD_WRENCH
    np.testing.assert_array_equal(held.wrench, 0.0)
    assert held.error == 10.0
    after = feed(held, t, slide, 0.4, 1, 20)
    # The pair of the gap is not learned, and the next sample predicts again.
    assert after[0].bank is memory.bank
    np.testing.assert_allclose(after[0].predicted[0], 3.2, atol=0.1)
    assert after[-1].error < 0.3


def test_the_force_is_against_the_motion_in_the_motion_subspace():
    rng = np.random.default_rng(0)
    for _ in range(20):
        n, d = rng.normal(size=3), rng.normal(size=3)
        w = rng.normal(size=3)
        velocity = np.concatenate([d, w])
        out = against_motion([2.0, 0.5], d, velocity, np.r_[n, 0, 0, 0])
        tangent = d - n * (n @ d) / (n @ n)
        expected = -2.0 * tangent / np.linalg.norm(tangent)
        np.testing.assert_allclose(out[:3], expected, atol=1e-12)
        np.testing.assert_allclose(out[3:], -0.5 * w / np.linalg.norm(w), atol=1e-12)
    # At rest, and straight into the surface, there is no direction.
    for d in ([0.0, 0.0, 0.0], [0.0, 0.0, -1.0]):
        np.testing.assert_array_equal(
            against_motion([2.0, 0.5], d, np.zeros(6), DOWN), np.zeros(6)
        )


def test_a_bank_comes_back_from_its_file(tmp_path):
    t = tuning()
    memory = feed(BankMemory(ModelBank()), t, Slide(), 0.3, 1, 200)[-1]
    bank = feed(memory, t, Slide(1), 0.6, 4, 200)[-1].bank
    bank.save(tmp_path / "models.json")
    again = ModelBank.load(tmp_path / "models.json")
    assert [mode for mode, _ in again.models] == [1, 4]
    for mode in (1, 4):
        np.testing.assert_array_equal(
            as_vector(again.get(mode)), as_vector(bank.get(mode))
        )
        np.testing.assert_array_equal(again.ratios(mode), bank.ratios(mode))
    (tmp_path / "models.json").write_text('{"with_torque": true}')
    with pytest.raises(ValueError, match="forward models .*models.json"):
        ModelBank.load(tmp_path / "models.json")
    with pytest.raises(ValueError, match="forward models .*absent"):
        ModelBank.load(tmp_path / "absent.json")


# The system.


class Surface(LeafSystem):
    """Slide.sample as ports, a function of time; mode 1 before t = 0.5 s, 2 after."""

    def __init__(self, period=0.005):
        super().__init__()

        def sample(time):
            slide = Slide(seed=int(round(time / period)))
            slide.k = int(round(time / period))
            return (*slide.sample(0.3 if time < 0.5 else 0.6), DOWN)

        for i, (name, size) in enumerate(
            (("wrench", 6), ("ee_velocity", 6), ("direction", 3), ("rows", 6))
        ):
            self.DeclareVectorOutputPort(
                name,
                size,
                lambda c, out, i=i: out.SetFromVector(sample(c.get_time())[i]),
                {self.time_ticket()},
            )
        self.DeclareVectorOutputPort(
            "mode",
            1,
            lambda c, out: out.SetFromVector([1.0 if c.get_time() < 0.5 else 2.0]),
            {self.time_ticket()},
        )


def small_diagram(config=None, knowledge=None):
    builder = DiagramBuilder()
    surface = builder.AddSystem(Surface())
    bank = builder.AddSystem(
        ForwardModelBank(config or ForwardModelConfig(), knowledge, 0.005, 1e-4)
    )
    for port in ("wrench", "ee_velocity", "direction", "mode"):
        builder.Connect(surface.GetOutputPort(port), bank.GetInputPort(port))
    builder.Connect(
        surface.GetOutputPort("rows"), bank.GetInputPort("force_directions")
    )
    simulator = Simulator(builder.Build())
    return simulator, bank


def outputs(simulator, bank):
    context = bank.GetMyContextFromRoot(simulator.get_context())
    names = ("wrench_predicted", "prediction_error", "status")
    return np.concatenate([bank.GetOutputPort(n).Eval(context) for n in names])


def test_the_system_predicts_for_the_mode_it_is_told():
    simulator, bank = small_diagram()
    np.testing.assert_array_equal(outputs(simulator, bank), [0] * 7 + [NO_MODEL])
    for time, force in ((0.45, 2.4), (1.0, 4.8)):
        simulator.AdvanceTo(time)
        out = outputs(simulator, bank)
        np.testing.assert_allclose(np.linalg.norm(out[:3]), force, atol=0.15)
        assert out[6] < 0.3 and out[7] == OK
    context = bank.GetMyContextFromRoot(simulator.get_context())
    assert [mode for mode, _ in bank.knowledge(context).models] == [1, 2]


def test_one_model_for_all_modes_learns_in_each_of_them():
    simulator, bank = small_diagram(ForwardModelConfig(per_mode=False))
    simulator.AdvanceTo(1.0)
    context = bank.GetMyContextFromRoot(simulator.get_context())
    [(mode, mixture)] = bank.knowledge(context).models
    assert mode == 1
    # Of both surfaces, 200 samples in a second but for the first ones.
    seen = dict(small_diagram_models())
    assert mixture.support.sum() > 1.5 * seen[1].support.sum()
    np.testing.assert_allclose(
        np.linalg.norm(outputs(simulator, bank)[:3]), 4.8, atol=0.3
    )


def small_diagram_models():
    simulator, bank = small_diagram()
    simulator.AdvanceTo(1.0)
    return bank.knowledge(bank.GetMyContextFromRoot(simulator.get_context())).models


def test_a_restored_context_replays_and_knowledge_starts_the_next_trial():
    simulator, bank = small_diagram()
    simulator.AdvanceTo(0.4)
    saved = simulator.get_context().Clone()
    simulator.AdvanceTo(0.7)
    expected = outputs(simulator, bank)
    simulator.reset_context(saved)
    simulator.AdvanceTo(0.7)
    np.testing.assert_array_equal(outputs(simulator, bank), expected)
    known = bank.knowledge(bank.GetMyContextFromRoot(simulator.get_context()))
    simulator, bank = small_diagram(ForwardModelConfig(learns=False), known)
    simulator.AdvanceTo(0.01)
    assert abs(np.linalg.norm(outputs(simulator, bank)[:3]) - 2.4) < 0.15


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(smoothing=0.0), "smoothing is 0.0"),
        (dict(correction=1.0), "correction is 1.0"),
        (dict(wrench_limit=np.nan), "wrench_limit is nan"),
        (dict(error_unknown=-1.0), "error_unknown is -1.0"),
        (dict(tau_nov=2.0), "tau_nov is 2.0"),
        (dict(handover=HandoverConfig(rows=-1.0)), "handover.rows is -1.0"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        ForwardModelBank(ForwardModelConfig(**changes))


def test_knowledge_over_other_entries_is_refused():
    memory = feed(BankMemory(ModelBank()), tuning(), Slide(), 0.3, 1, 5)[-1]
    with pytest.raises(ValueError, match="over 6 entries, expected 20 over 3"):
        ForwardModelBank(ForwardModelConfig(with_torque=False), memory.bank)
    with pytest.raises(ValueError, match="period_sec is 0"):
        ForwardModelBank(ForwardModelConfig(), period_sec=0.0)


# Hand-over.


def known_bank(t):
    """Mode 1 with friction 0.2, mode 2 with 0.5."""
    memory = feed(BankMemory(ModelBank()), t, Slide(), 0.2, 1, 400)[-1]
    return feed(memory, t, Slide(1), 0.5, 2, 400)[-1].bank


def across(t, announced, n_before=60, n_after=40):
    """Slides on 0.2 in mode 1, then mode 2 while the friction is 0.2 still."""
    slide, memories = Slide(seed=3), []
    memory = BankMemory(known_bank(t))
    for k in range(n_before + n_after):
        mode = 1 if k < n_before else 2
        changes = 0.0 if announced else float(mode)
        memory = observe(memory, t, *slide.sample(0.2), DOWN, mode, changes)
        memories.append(memory)
    return memories


def test_an_announced_mode_is_asked_without_the_last_force():
    t = tuning(handover=10)
    memories = across(t, announced=True)
    before = memories[59]
    for memory in memories[60:70]:
        # 0.5 x 8 N, though the force is 1.6 N still; and nothing is learned of it.
        np.testing.assert_allclose(memory.predicted[0], 4.0, atol=0.1)
        assert memory.bank is before.bank
        assert memory.error == before.error
    # Then what is felt counts again: no change has come.
    assert abs(memories[75].predicted[0] - 1.6) < 0.3


def test_a_confirmed_mode_is_not_handed_over():
    t = tuning(handover=10)
    memories = across(t, announced=False)
    assert memories[60].before is None and memories[62].bank is not memories[60].bank
    # As without the port.
    alone = observe(memories[59], t, *Slide().sample(0.5), DOWN, 2)
    assert alone.before is None


def test_two_rows_of_feet_are_handed_over_in_two_steps():
    t = tuning(handover=10, rows=0.024)
    memories = across(t, announced=True, n_after=80)
    half = [m.predicted[0] for m in memories[60:70]]
    np.testing.assert_allclose(half, 2.8, atol=0.15)  # Between 1.6 and 4 N.
    # The second row is 24 mm or 48 samples behind at 0.1 m/s.
    whole = [k for k, m in enumerate(memories[60:]) if m.left and m.way >= 0.024]
    assert abs(whole[0] - 48) <= 1 and len(whole) == 10
    for k in whole:
        np.testing.assert_allclose(memories[60 + k].predicted[0], 4.0, atol=0.1)
    assert memories[-1].before is None


def block(N_1, N_2, mu_1, mu_2, d, rows=0.024, height=0.015):
    """The wrench at the tip of a tool on a row of feet ahead and one behind: the sum of
    r x f over both, naively."""
    wrench = np.zeros(6)
    for N, mu, ahead in ((N_1, mu_1, rows / 2), (N_2, mu_2, -rows / 2)):
        r = ahead * d + height * DOWN[:3]
        f = -N * DOWN[:3] - mu * N * d
        wrench += [*f, *np.cross(r, f)]
    return wrench


def test_the_moment_tells_what_the_first_row_carries():
    rng = np.random.default_rng(0)
    for _ in range(20):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        d = np.array([np.cos(angle), np.sin(angle), 0.0])
        N_1, N_2 = rng.uniform(0.5, 8.0, size=2)
        wrench = block(N_1, N_2, *rng.uniform(0.1, 0.6, size=2), d)
        share = load_ahead(wrench, d, DOWN, 0.024, 0.015)
        np.testing.assert_allclose(share, N_1 / (N_1 + N_2), rtol=1e-9)
    # Free, at rest, in a corner, and a moment that no two rows could have.
    corner = DOWN + [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    x = np.array([1.0, 0.0, 0.0])
    for rows, direction in ((np.zeros(6), x), (DOWN, np.zeros(3)), (corner, x)):
        wrench = block(6.0, 2.0, 0.2, 0.2, x)
        assert load_ahead(wrench, direction, rows, 0.024, 0.015) == 0.5
    assert load_ahead(block(6.0, -2.0, 0.2, 0.2, x), x, DOWN, 0.024, 0.015) == 1.0


def test_the_first_step_of_two_is_what_the_first_row_carries():
    """Three quarters of the load are on the first row: the friction goes from 1.6 N to
    3.4 N and, when the second row is across, to 4 N."""
    t = tuning(handover=10, rows=0.024, height=0.015)
    memory = BankMemory(known_bank(t))
    d, velocity = np.array([1.0, 0.0, 0.0]), np.array([0.1, 0, 0, 0, 0, 0])
    said = []
    for k in range(200):
        mu_1 = 0.5 if k >= 60 else 0.2
        mu_2 = 0.5 if k >= 108 else 0.2
        wrench = block(6.0, 2.0, mu_1, mu_2, d)
        mode = 1 if k < 59 else 2  # Announced a sample ahead.
        memory = observe(memory, t, wrench, velocity, d, DOWN, mode, 0.0)
        said.append(memory)
    # Before each step is felt. The models were learned with a noise of 0.1 N; half of
    # the load on each row would be 2.8 N.
    np.testing.assert_allclose(said[59].predicted[0], 3.4, atol=0.1)
    np.testing.assert_allclose(said[107].predicted[0], 4.0, atol=0.1)
    # On two surfaces: the force that is felt, of which no mode learns anything.
    for memory in said[90:106]:
        np.testing.assert_allclose(memory.predicted[0], 3.4, atol=0.01)
        assert memory.bank is said[59].bank


def test_a_model_that_has_seen_little_is_not_handed_over():
    t = tuning(handover=10)
    memory = feed(BankMemory(ModelBank()), t, Slide(), 0.2, 1, 100)[-1]
    memory = feed(memory, t, Slide(1), 0.5, 2, 10)[-1]
    memory = feed(BankMemory(memory.bank), t, Slide(2), 0.2, 1, 3)[-1]
    memory = observe(memory, t, *Slide(4).sample(0.2), DOWN, 2, 0.0)
    assert memory.before is None


@pytest.mark.parametrize("announced", [True, False])
def test_the_port_says_while_a_model_is_handed_over(announced):
    config = ForwardModelConfig(handover=HandoverConfig(duration_sec=0.05))
    knowledge = known_bank(tuning())
    simulator, bank = small_diagram(config, knowledge)
    context = bank.GetMyContextFromRoot(simulator.get_mutable_context())
    transition = bank.GetInputPort("transition")
    said = []
    for k in range(1, 61):
        time = 0.4 + 0.005 * k
        count = 0.0 if announced or time < 0.502 else 1.0
        transition.FixValue(context, [count, 0.0, 0.0, 0.0, 0.0, 0.0])
        simulator.AdvanceTo(time - 0.002)
        said.append(bank.GetOutputPort("handing_over").Eval(context)[0])
    begins = 20 if announced else None
    assert (said.index(1.0) if 1.0 in said else None) == begins
    assert sum(said) == (10 if announced else 0)


# From rest.


def test_the_friction_of_a_mode_is_the_mean_share_of_the_normal_force():
    t = tuning()
    memory = feed(BankMemory(ModelBank()), t, Slide(R=8.0), 0.3, 1, 100)[-1]
    memory = feed(memory, t, Slide(1, R=12.0), 0.3, 1, 100)[-1]
    # The torque's lever is 15 mm; 100 samples of 0.1 N over 8 N are good to 1e-3.
    ratios = memory.bank.ratios(1)
    np.testing.assert_allclose(ratios, [0.3, 0.015 * 0.3], atol=3e-3)
    # On two surfaces at once it is the mean of both, which is kept apart.
    both = DOWN + [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    two = memory
    for _ in range(100):
        two = observe(two, t, *Slide(2).sample(0.5), both, 1)
    np.testing.assert_array_equal(two.bank.ratios(1), ratios)
    # While it may be another surface, nothing is learned of it.
    for _ in range(100):
        sample = Slide(2).sample(0.6)
        memory = observe(memory, t, *sample, DOWN, 1, undecided=True)
    np.testing.assert_array_equal(memory.bank.ratios(1), ratios)
    assert memory.bank.ratios(2) is None


def at_rest(memory, t, normal, n, speed_desired=0.0):
    """The memory after n samples of a tool that presses and does not move."""
    wrench, still = np.array([0.0, 0.0, normal, 0.0, 0.0, 0.0]), np.zeros(6)
    d = np.array([1.0, 0.0, 0.0]) if speed_desired else np.zeros(3)
    for _ in range(n):
        memory = observe(
            memory, t, wrench, still, d, DOWN, 2, speed_desired=speed_desired
        )
    return memory


def test_a_motion_that_begins_has_its_friction_before_it_is_felt():
    t = tuning(from_rest=True)
    rest = at_rest(BankMemory(known_bank(t)), t, 12.0, 40)
    # Half the speed at which it slides, half the friction of 0.5 x 12 N.
    for speed, force in ((0.004, 3.0), (0.008, 6.0), (0.1, 6.0)):
        memory = at_rest(rest, t, 12.0, 1, speed)
        np.testing.assert_allclose(memory.wrench[:3], [-force, 0, 0], atol=0.1)
        assert memory.ahead and memory.error == rest.error
    # Nothing of that where it is not asked for: the last force is 0.
    plain = at_rest(rest, tuning(), 12.0, 2, 0.1)
    assert abs(plain.predicted[0]) < 1.0 and not plain.ahead


def test_once_it_slides_the_mixture_predicts_again():
    t = tuning(from_rest=True)
    memory = at_rest(BankMemory(known_bank(t)), t, 8.0, 10)
    memory = at_rest(memory, t, 8.0, 3, 0.1)
    slide, ahead = Slide(6), []
    for _ in range(20):
        memory = observe(memory, t, *slide.sample(0.2), DOWN, 2, speed_desired=0.1)
        ahead.append(memory.ahead)
    assert ahead[:5] == [True] * 5 and not any(ahead[6:])
    assert abs(memory.predicted[0] - 1.6) < 0.4  # What is felt, not 0.5 x 8 N.


def test_a_mode_that_is_not_known_has_the_last_force():
    t = tuning(from_rest=True)
    memory = feed(BankMemory(ModelBank()), t, Slide(noise=0.0), 0.5, UNKNOWN_MODE, 60)
    np.testing.assert_allclose(memory[-1].predicted[0], 4.0, rtol=1e-9)
    assert memory[-1].error < 0.1 and not memory[-1].bank.models
    free = feed(BankMemory(ModelBank()), t, Slide(noise=0.0), 0.5, FREE_MODE, 3)[-1]
    np.testing.assert_array_equal(free.wrench, 0.0)


def test_a_hand_over_has_the_normal_force_of_now():
    t = tuning(handover=10, from_rest=True)
    memory = BankMemory(known_bank(t))  # Learned at 8 N.
    slide = Slide(3, R=12.0)
    for k in range(65):
        mode = 1 if k < 60 else 2
        memory = observe(memory, t, *slide.sample(0.2), DOWN, mode, 0.0)
    np.testing.assert_allclose(memory.predicted[0], 6.0, atol=0.15)


def test_the_speed_of_a_reference_is_along_its_direction_and_a_moment_ahead():
    x = np.zeros(19)
    x[7:10], x[13:16] = [0.03, 0.04, 0.2], [0.0, 1.0, 0.0]
    d = np.array([0.6, 0.8, 0.0])
    np.testing.assert_allclose(speed_along(x, d, 0.01), 0.058, rtol=1e-12)
    assert speed_along(x, np.zeros(3), 0.01) == 0.0
    assert speed_along(np.full(19, np.nan), d, 0.01) == 0.0

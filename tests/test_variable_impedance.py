import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from makebreak.systems.arm.numerics.variable_impedance import (
    N_MEMORY,
    tick,
    trust,
)
from makebreak.systems.arm.variable_impedance import (
    StiffnessConfig,
    TrustConfig,
    VariableImpedance,
    VariableImpedanceConfig,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    DONE,
    ENTER,
    HOLD,
    IMPACT,
    IMPACTLESS,
    MOVE,
    N_PHASE,
    PHASE_KIND,
    PHASE_STAGE,
    REGION,
    SETTLE,
)

W = np.array([-3.0, 1.0, 0.5, 0.1, -0.2, 0.0])
FREE, MAX, LOW = 200.0, 1000.0, 150.0


def phase(stage=MOVE, kind=IMPACT):
    row = np.zeros(N_PHASE)
    row[PHASE_STAGE], row[PHASE_KIND] = stage, kind
    return row


def law_of(**changes):
    config = VariableImpedanceConfig(trust=TrustConfig(filter_sec=0.0))
    for name, value in changes.items():
        setattr(config, name, value)
    return VariableImpedance(config)._law


def run(law, inputs, memory=None):
    """Outputs (n, N_OUTPUT) of ticks over (error, predicted, collecting, phase)."""
    memory = np.zeros(N_MEMORY) if memory is None else memory.copy()
    rows = []
    for one in inputs:
        rows.append(tick(law, memory, *one))
    return np.array(rows)


@pytest.mark.parametrize("error", [0.0, 0.3, 0.8, 1.1, 5.0])
def test_stiffness_and_feed_forward_are_equation_4(error):
    weight = 1.0 - 1.0 / (1.0 + np.exp(-8.0 * (error - 0.8)))
    out = run(law_of(), [(error, W, 0.0, phase())])[0]
    # 1 - 1/(1 + e^..) above loses digits where lambda is near 0.
    np.testing.assert_allclose(out[18], weight, atol=1e-15)
    K = FREE + (1.0 - weight) * (MAX - FREE)
    np.testing.assert_allclose(out[:6], [K, K, K, 40, 40, 40], rtol=1e-12)
    np.testing.assert_allclose(out[6:9], K, rtol=1e-12)  # Damped as it is stiff.
    np.testing.assert_allclose(out[12:18], -weight * W, rtol=1e-12, atol=1e-14)


def test_trust_stays_in_its_range_and_falls_with_the_error():
    errors = np.concatenate([np.linspace(0.0, 10.0, 200), [1e3, 1e6, 1e300]])
    values = np.array([trust(e, 8.0, 0.8) for e in errors])
    assert np.all(np.isfinite(values)) and np.all((values >= 0) & (values <= 1))
    assert np.all(np.diff(values) <= 0.0)
    assert trust(0.8, 8.0, 0.8) == 0.5


def test_while_a_batch_is_collected_the_stiffness_is_the_highest():
    out = run(law_of(), [(0.0, W, 1.0, phase())])[0]
    np.testing.assert_allclose(out[:3], MAX)


def test_what_is_handed_over_is_fed_forward_with_a_filter_of_5_ms():
    law = law_of(trust=TrustConfig(filter_sec=0.02))
    zero = np.zeros(6)
    for handing_over, tau in ((0.0, 0.02), (1.0, 0.005), (np.nan, 0.02)):
        rest = [(0.0, zero, 0.0, phase(), 0.0)]
        out = run(law, rest + [(0.0, W, 0.0, phase(), handing_over)] * 10)[1:]
        t = 1e-3 * np.arange(1, 11)[:, None]
        expected = -out[0, 18] * W * (1.0 - np.exp(-t / tau))
        np.testing.assert_allclose(out[:, 12:18], expected, rtol=1e-9, atol=1e-12)
    # A filter that is faster still stays as it is.
    out = run(law_of(), [(0.0, zero, 0.0, phase(), 0.0), (0.0, W, 0.0, phase(), 1.0)])
    np.testing.assert_allclose(out[1, 12:18], -out[1, 18] * W, rtol=1e-12)


@pytest.mark.parametrize("kind, K_2", [(IMPACT, LOW), (IMPACTLESS, MAX)])
def test_the_blend_is_linear_over_T_both_ways(kind, K_2):
    law = law_of()
    inward = [(0.0, W, 0.0, phase(ENTER, kind))] * 100
    stay = [(0.0, W, 0.0, phase(REGION, kind))] * 30
    outward = [(0.0, W, 0.0, phase(SETTLE, kind))] * 120
    out = run(law, inward + stay + outward)
    K_1 = run(law, [(0.0, W, 0.0, phase())])[0, 0]
    t = np.concatenate([np.arange(1, 101), [100] * 30, np.arange(99, -21, -1)])
    alpha = np.clip(t / 100.0, 0.0, 1.0)
    np.testing.assert_allclose(out[:, 0], (1 - alpha) * K_1 + alpha * K_2, rtol=1e-9)
    # D = 2 zeta sqrt(K m) of both controllers, blended: the second has K_max's.
    D = (1 - alpha) * np.sqrt(K_1) + alpha * np.sqrt(MAX)
    np.testing.assert_allclose(np.sqrt(out[:, 6]), D, rtol=1e-9)
    # The feed-forward is the same in both: it stays.
    np.testing.assert_allclose(out[:, 12:18], np.tile(out[0, 12:18], (250, 1)))


def test_the_blend_is_the_blend_of_the_two_commands():
    # CC eq. 10 on u itself, at a random error and velocity.
    rng = np.random.default_rng(0)
    law, m = law_of(), 4.0
    e, v = rng.normal(size=3), rng.normal(size=3)

    def u(out):
        return out[:3] * e + 2 * 0.9 * np.sqrt(out[6:9] * m) * v + out[12:15]

    out = run(law, [(0.4, W, 0.0, phase(ENTER))] * 100)
    base = run(law, [(0.4, W, 0.0, phase())])[0]
    for k in (0, 30, 71, 99):
        alpha = (k + 1) / 100.0
        expected = (1 - alpha) * u(base) + alpha * u(out[99])
        np.testing.assert_allclose(u(out[k]), expected, rtol=1e-9)


def test_outputs_never_jump():
    # Random inputs at a random pace: K changes by at most what the filter and the blend
    # allow in a millisecond.
    rng = np.random.default_rng(1)
    law = law_of(trust=TrustConfig())
    inputs = []
    for _ in range(60):
        one = (
            rng.choice([0.0, 0.8, 3.0, np.nan]),
            rng.normal(size=6),
            float(rng.integers(2)),
            phase(rng.choice([MOVE, ENTER, REGION, SETTLE, DONE, HOLD]),
                  rng.choice([IMPACT, IMPACTLESS])),
        )  # fmt: skip
        inputs += [one] * int(rng.integers(1, 200))
    out = run(law, inputs)
    assert np.all(np.isfinite(out))
    filtered = (MAX - FREE) * (1.0 - np.exp(-1.0 / 20.0))
    blended = (MAX - LOW) / 100.0
    assert np.abs(np.diff(out[:, 0])).max() <= filtered + blended
    assert out[:, 0].min() >= LOW and out[:, 0].max() <= MAX
    # The largest feed-forward there is, reversed.
    most = 2 * max(abs(w).max() for _, w, *_ in inputs) * (1.0 - np.exp(-1.0 / 20.0))
    assert np.abs(np.diff(out[:, 12:18], axis=0)).max() <= most


def test_the_filter_is_first_order():
    law = law_of(trust=TrustConfig(filter_sec=0.02))
    out = run(law, [(0.0, W, 0.0, phase())] * 2000 + [(9.0, W, 0.0, phase())] * 60)
    K_1 = out[1999, 0]
    expected = MAX + (K_1 - MAX) * np.exp(-np.arange(1, 61) / 20.0)
    np.testing.assert_allclose(out[2000:, 0], expected, rtol=1e-9)


def test_another_kind_comes_after_the_way_back():
    law = law_of()
    first = [(0.0, W, 0.0, phase(REGION, IMPACT))] * 100
    out = run(law, first + [(0.0, W, 0.0, phase(ENTER, IMPACTLESS))] * 200)[:, 0]
    K_1 = run(law, [(0.0, W, 0.0, phase())])[0, 0]
    np.testing.assert_allclose(out[[99, 199, 299]], [LOW, K_1, MAX], rtol=1e-9)


def test_constant_stiffness_is_constant_whatever_happens():
    constant = StiffnessConfig(free=600.0, maximum=600.0, impact=600.0)
    law = law_of(stiffness=constant, feedforward=False)
    inputs = [
        (error, W, collecting, phase(stage, kind))
        for error in (0.0, 5.0)
        for collecting in (0.0, 1.0)
        for stage in (MOVE, ENTER, REGION, SETTLE)
        for kind in (IMPACT, IMPACTLESS)
    ]
    out = run(law, inputs)
    np.testing.assert_allclose(out[:, :3], 600.0)
    np.testing.assert_array_equal(out[:, 12:18], 0.0)


def test_without_transition_control_the_base_controller_goes_on():
    law = law_of(transition=False)
    out = run(law, [(0.2, W, 0.0, phase(REGION, IMPACT))] * 200)
    base = run(law, [(0.2, W, 0.0, phase())] * 200)
    np.testing.assert_array_equal(out, base)


@pytest.mark.parametrize("which", range(4))
def test_nan_is_safe_and_said(which):
    good = [0.1, W, 0.0, phase(REGION, IMPACT)]
    bad = list(good)
    bad[which] = np.full_like(good[which], np.nan) if which in (1, 3) else np.nan
    law = law_of()
    out = run(law, [good] * 150 + [bad] * 150)
    assert np.all(np.isfinite(out))
    assert out[149, 19] == 0 and np.all(out[150:, 19] == 1)
    expected = {0: LOW, 1: LOW, 2: LOW, 3: run(law, [(0.1, W, 0.0, phase())])[0, 0]}
    np.testing.assert_allclose(out[-1, 0], expected[which], rtol=1e-9)
    if which in (0, 1):
        np.testing.assert_array_equal(out[-1, 12:18], 0.0)
    # Of K_1, seen outside of a transition.
    outside = [*bad[:3], phase()]
    K_1 = run(law, [outside] * 5)[-1, 0]
    if which in (0, 2):
        assert K_1 == MAX


def test_the_system_is_the_tick_and_its_memory_is_in_the_context():
    config = VariableImpedanceConfig()
    system = VariableImpedance(config)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    values = {
        "prediction_error": [0.5],
        "wrench_predicted": W,
        "collecting": [0.0],
        "phase": phase(ENTER, IMPACT),
    }
    for name, value in values.items():
        system.GetInputPort(name).FixValue(context, value)
    np.testing.assert_allclose(
        system.GetOutputPort("stiffness").Eval(context), [MAX] * 3 + [40.0] * 3
    )
    simulator.AdvanceTo(0.0495)  # 50 ticks, the first at 0.
    saved = context.Clone()
    simulator.AdvanceTo(0.0995)
    expected = run(system._law, [(0.5, W, 0.0, phase(ENTER, IMPACT))] * 100)[-1]

    def outputs(of):
        return np.concatenate([
            system.GetOutputPort(name).Eval(of)
            for name in ("stiffness", "damping_stiffness", "wrench_feedforward",
                         "trust", "status")
        ])  # fmt: skip

    np.testing.assert_array_equal(outputs(context), expected)
    again = Simulator(system, saved)
    again.AdvanceTo(0.0995)
    np.testing.assert_array_equal(outputs(again.get_context()), expected)


def test_the_paper_s_damping_is_a_port_of_its_own_and_light():
    config = VariableImpedanceConfig(stiffness=StiffnessConfig(paper_damping=True))
    system = VariableImpedance(config)
    assert not system.HasOutputPort("damping_stiffness")
    D = system.GetOutputPort("damping").Eval(system.CreateDefaultContext())
    np.testing.assert_allclose(D, np.sqrt([MAX] * 3 + [40.0] * 3) / 4.0)
    # Damping ratio of lambda s^2 + D s + K for the 4 kg of the tip, whatever K.
    pole = np.roots([4.0, D[0], MAX])[0]
    np.testing.assert_allclose(-pole.real / abs(pole), 1.0 / 16.0, rtol=1e-9)


@pytest.mark.parametrize(
    "config, message",
    [
        (dict(stiffness=StiffnessConfig(free=2000.0)), "stiffness.free is 2000.0"),
        (dict(stiffness=StiffnessConfig(impact=0.0)), "stiffness.impact is 0.0"),
        (dict(trust=TrustConfig(steepness=np.nan)), "trust.steepness is nan"),
        (dict(trust=TrustConfig(filter_sec=-0.1)), "trust.filter_sec is -0.1"),
        (dict(blend_sec=0.0), "blend_sec is 0.0"),
    ],
)
def test_bad_settings_are_refused(config, message):
    with pytest.raises(ValueError, match=message):
        VariableImpedance(VariableImpedanceConfig(**config))


@pytest.mark.parametrize(
    "stage, kind, transition, held",
    [
        (REGION, IMPACT, True, True),
        (REGION, IMPACTLESS, True, False),
        (ENTER, IMPACT, True, False),
        (SETTLE, IMPACT, True, False),
        (REGION, IMPACT, False, False),
    ],
)
def test_feed_forward_is_held_where_an_impact_is_expected(
    stage, kind, transition, held
):
    """A model that follows the impact must not push on against it."""
    law = law_of(transition=transition)
    before = (0.0, W, 0.0, phase())
    after = (0.0, 4.0 * W, 0.0, phase(stage, kind))
    out = run(law, [before, after, after])
    np.testing.assert_allclose(out[-1, 12:18], out[0, 12:18] * (1.0 if held else 4.0))
    blind = (0.0, np.full(6, np.nan), 0.0, phase(stage, kind))
    out = run(law, [before, blind])
    np.testing.assert_allclose(out[-1, 12:18], out[0, 12:18] * (1.0 if held else 0.0))

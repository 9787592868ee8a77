"""The bias of the force-torque sensor: found in free space, taken off for all."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.systems.arm.numerics.wrench_tare import (
    BAD_WRENCH,
    NOT_TARED,
    REFUSED,
    SLOPE,
    STATUS,
    TARED,
    TareLaw,
    bias_of,
    new_memory,
    sloped,
    tared,
    tared_mean,
    tick,
)
from makebreak.systems.arm.wrench_tare import WrenchTare, WrenchTareConfig

LAW = TareLaw()
TRUE_BIAS = np.array([0.4, -0.3, 0.5, 0.01, -0.02, 0.005])
FREE, REST = np.zeros(6), np.zeros(6)
DOWN = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
STD = np.array([0.1] * 3 + [0.01] * 3)


def after(wrenches, velocities=REST, rows=FREE, memory=None, law=LAW):
    """The memory after a sample per row of wrenches (n, 6)."""
    memory = new_memory() if memory is None else memory.copy()
    n = len(wrenches)
    velocities, rows = (
        np.broadcast_to(velocities, (n, 6)),
        np.broadcast_to(rows, (n, 6)),
    )
    for sample in zip(wrenches, velocities, rows, strict=True):
        tick(law, memory, *(np.array(value) for value in sample))
    return memory


def noisy(n, seed=0, bias=TRUE_BIAS):
    return bias + STD * np.random.default_rng(seed).normal(size=(n, 6))


def test_the_bias_is_the_mean_in_free_space_and_is_taken_off():
    wrench = noisy(115)
    early = after(wrench[:60])
    assert early[STATUS] == NOT_TARED
    np.testing.assert_array_equal(tared(LAW, early, wrench[0]), wrench[0])
    memory = after(wrench)
    assert memory[STATUS] == TARED
    # The first 10 ms are left out, then 100 samples: naively.
    np.testing.assert_allclose(bias_of(memory), wrench[9:109].mean(axis=0), atol=0.02)
    # 4 x 0.1/sqrt(100).
    np.testing.assert_allclose(bias_of(memory), TRUE_BIAS, atol=0.04)
    force = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(
        tared(LAW, memory, force + bias_of(memory)), force, atol=1e-12
    )


def test_a_run_that_starts_in_contact_is_not_tared():
    pressing = noisy(500) + [0.0, 0.0, 8.0, 0.0, 0.0, 0.0]
    told = after(pressing, rows=DOWN)  # The motion says that it presses.
    assert told[STATUS] == NOT_TARED and not np.any(bias_of(told))
    untold = after(pressing)
    assert untold[STATUS] == REFUSED and not np.any(bias_of(untold))
    free = after(noisy(300, 1), memory=untold)  # Later it comes free.
    assert free[STATUS] == TARED
    np.testing.assert_allclose(bias_of(free), TRUE_BIAS, atol=0.04)


def test_a_motion_that_speeds_up_or_turns_is_no_time_to_tare():
    t = 1e-3 * np.arange(400)
    a, mass = 0.5, 0.3
    wrench = noisy(400) - np.array([mass * a, 0.0, 0.0, 0.0, 0.0, 0.0])
    faster = np.zeros((400, 6))
    faster[:, 0] = a * t
    assert after(wrench, faster)[STATUS] == NOT_TARED
    turning = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.2])
    assert after(noisy(400), turning)[STATUS] == NOT_TARED
    steady = np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert after(noisy(400), steady)[STATUS] == TARED


def test_a_tip_that_follows_something_is_tared_too():
    """A finger above a ball that rolls is steady over half a second, not over 0.1 s."""
    t = 1e-3 * np.arange(600)
    mass, swing, w = 0.3, 0.02, 2.0 * np.pi * 2.3  # [kg], [m/s], [rad/s]
    follows = np.zeros((600, 6))
    follows[:, 0] = 0.05 + swing * np.sin(w * t)
    wrench = noisy(600)
    wrench[:, 0] -= mass * swing * w * np.cos(w * t)  # Up to 0.09 N.
    windows = follows[100:, 0] - follows[:-100, 0]
    assert np.median(abs(windows)) > 0.005  # STEADY over 0.1 s.
    memory = after(wrench, follows)
    assert memory[STATUS] == TARED
    # The inertia of STEADY, and 3 x 0.1/sqrt(100).
    np.testing.assert_allclose(bias_of(memory), TRUE_BIAS, atol=0.015 + 0.03)


def zigzag(n):
    """(n, 6) velocities: +-0.02 m/s in ramps of 0.2 s, so that no window of 0.1 s that
    begins with a ramp or in its middle is steady, and one of 0.4 s is."""
    velocity = np.zeros((n, 6))
    velocity[:, 0] = np.interp(np.arange(n) % 400, [0, 200, 400], [-0.02, 0.02, -0.02])
    return velocity


def test_a_first_window_that_never_is_steady_begins_anew_after_a_second():
    """It began while the tip was still fast: 0.3 m/s are 6 s of STEADY."""
    stops = np.zeros((109, 6))
    stops[:, 0] = np.interp(np.arange(109), [9, 109], [0.3, -0.02])
    velocity = np.concatenate([stops, zigzag(1900)])
    wrench = noisy(len(velocity))
    assert after(wrench[:1000], velocity[:1000])[STATUS] == NOT_TARED
    assert after(wrench, velocity)[STATUS] == TARED


def test_a_bad_wrench_ends_every_window():
    velocity = zigzag(429)
    velocity[9:] = zigzag(420)  # The first samples are left out.
    wrench = noisy(429)
    assert after(wrench, velocity)[STATUS] == TARED
    wrench[309] = np.nan
    assert after(wrench, velocity)[STATUS] == NOT_TARED


def test_only_the_first_window_may_be_longer():
    memory = after(noisy(309))  # Its last window ends here.
    known = bias_of(memory).copy()
    moving = after(noisy(1200, 1) + 0.3, zigzag(1200), memory=memory)
    np.testing.assert_array_equal(bias_of(moving), known)


def test_drift_is_followed_in_free_space_and_kept_under_pressure():
    rate = np.array([0.02, -0.01, 0.0, 0.0, 0.0, 0.0])
    t = 1e-3 * np.arange(20000)[:, None]
    memory = after(noisy(20000) + rate * t)
    # A window late, and its noise of 10 mN a few times over.
    np.testing.assert_allclose(bias_of(memory), TRUE_BIAS + 20.0 * rate, atol=0.04)
    kept = bias_of(memory).copy()
    pressed = after(noisy(3000, 2) + 5.0, rows=DOWN, memory=memory)
    np.testing.assert_array_equal(bias_of(pressed), kept)


DRIFT = np.array([0.008, -0.006, 0.009])
TRUE_SLOPE = np.array([0.006, -0.007, 0.0])  # Half a degree [rad].


def sliding(seconds=24.0, slope=TRUE_SLOPE, drift=DRIFT, seed=3):
    """Wrenches and velocities (n, 6) of a tool that slides in pieces of 2 s, each in
    another direction and with another force, over surfaces of friction 0.2 and 0.5."""
    t = 1e-3 * np.arange(round(1e3 * seconds))
    piece = (t // 2.0).astype(int)
    rng = np.random.default_rng(seed)
    R = rng.uniform(6.0, 12.0, 50)[piece]
    angle = 1.9 * piece
    velocities = np.zeros((len(t), 6))
    speed = 0.1 * np.minimum(1.0, 5.0 * (t % 2.0))  # From rest.
    velocities[:, 0], velocities[:, 1] = speed * np.cos(angle), speed * np.sin(angle)
    mu = np.where(t % 2.0 < 1.0, 0.2, 0.5)
    along = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * t])
    wrenches = noisy(len(t), seed)
    wrenches[:, :3] += drift * t[:, None] - (mu * R)[:, None] * along
    wrenches[:, :3] += R[:, None] * (slope - DOWN[:3])
    return wrenches, velocities


def test_sliding_tells_drift_from_slope():
    known = after(noisy(115))
    memory = after(*sliding(), DOWN, known)
    off = (bias_of(memory) - TRUE_BIAS)[:2]  # Within the surface; nothing tells of z.
    # It drifts by 0.19 and 0.14 N, which would be left without the force across.
    np.testing.assert_allclose(off, 24.0 * DRIFT[:2], atol=0.04)
    # 30 mN that the forces of 6 to 12 N tell apart poorly are 3 mrad.
    np.testing.assert_allclose(memory[SLOPE], TRUE_SLOPE, atol=0.004)
    across = off - 24.0 * DRIFT[:2] + 9.0 * (memory[SLOPE] - TRUE_SLOPE)[:2]
    np.testing.assert_allclose(across, 0.0, atol=0.02)  # What it is all for [N].
    turned = sloped(memory, DOWN)[:3]
    normal = DOWN[:3] - TRUE_SLOPE
    np.testing.assert_allclose(turned, normal / np.linalg.norm(normal), atol=0.004)
    assert np.linalg.norm(turned) == pytest.approx(1.0)
    # Off: the bias is kept, and the direction as it was.
    law = TareLaw(sideways=False)
    kept = after(*sliding(), DOWN, known, law)
    np.testing.assert_array_equal(bias_of(kept), bias_of(known))
    np.testing.assert_array_equal(sloped(kept, DOWN), DOWN)


def test_sliding_on_a_level_surface_invents_little():
    known = after(noisy(115))
    memory = after(*sliding(slope=0.0, drift=0.0), DOWN, known)
    np.testing.assert_allclose(bias_of(memory), bias_of(known), atol=0.03)
    np.testing.assert_allclose(memory[SLOPE], 0.0, atol=0.004)


def test_what_sliding_found_stays_where_it_belongs():
    memory = after(*sliding(), DOWN, after(noisy(115)))
    free = after(noisy(1), memory=memory)  # No jump as the tool lifts off.
    np.testing.assert_allclose(bias_of(free), bias_of(memory), atol=1e-12)
    wall = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(sloped(memory, wall), wall)  # Another surface.
    wrenches, velocities = sliding(1.0)
    back = after(wrenches[:10], velocities[:10], DOWN, free)
    np.testing.assert_allclose(back[SLOPE], memory[SLOPE], atol=1e-4)
    other = after(wrenches[:10], velocities[:10], wall, free)
    np.testing.assert_array_equal(other[SLOPE], 0.0)


def test_blows_rest_and_a_second_surface_teach_no_drift():
    known = after(noisy(115))
    wrenches, velocities = sliding(2.0)
    blow = wrenches + [0.0, 3.0, 0.0, 0.0, 0.0, 0.0]  # Across the first piece.
    corner = DOWN + [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    for memory in (
        after(blow, velocities, DOWN, known),
        after(wrenches, 0.1 * velocities, DOWN, known),
        after(wrenches, velocities, corner, known),
        after(wrenches, np.full(6, np.nan), DOWN, known),
    ):
        np.testing.assert_allclose(bias_of(memory), bias_of(known), atol=1e-12)
        np.testing.assert_array_equal(memory[SLOPE], 0.0)


def test_what_touches_unknown_is_hardly_taken_for_a_bias():
    memory = after(noisy(200))
    weak = np.array([0.0, 0.0, 0.8, 0.0, 0.0, 0.0])
    leaning = after(noisy(1000, 1) + weak, memory=memory)
    # A second of it moves the bias by what a sensor may drift in that time.
    moved = bias_of(leaning) - bias_of(memory)
    assert 0.03 < moved[2] < LAW.drift_max * 1.01 + 0.005
    strong = after(noisy(1000, 1) + 10.0 * weak, memory=memory)
    # But for the window that was free space at first: one step.
    np.testing.assert_allclose(
        bias_of(strong), bias_of(memory), atol=0.1 * LAW.drift_max
    )


def test_bad_wrenches_pass_and_teach_nothing():
    memory = after(noisy(200))
    nan, limit = np.full(6, np.nan), np.full(6, 200.0)
    for bad in (nan, limit):
        np.testing.assert_array_equal(tared(LAW, memory, bad), bad)
        now = after(bad[None].repeat(300, axis=0), memory=memory)
        assert now[STATUS] == BAD_WRENCH
        np.testing.assert_array_equal(bias_of(now), bias_of(memory))
        assert after(noisy(1), memory=now)[STATUS] == TARED
        assert after(bad[None])[STATUS] == BAD_WRENCH
        assert after(noisy(1), memory=after(bad[None]))[STATUS] == NOT_TARED
    stuck = noisy(1)[0] + 0.5
    now = after(stuck[None].repeat(1000, axis=0), memory=memory)
    np.testing.assert_allclose(bias_of(now), bias_of(memory), atol=1e-12)
    lost = np.full(6, np.nan)
    assert after(noisy(400), velocities=lost)[STATUS] == NOT_TARED
    assert after(noisy(400), rows=lost)[STATUS] == NOT_TARED


def test_the_mean_is_that_of_five_samples_and_of_good_ones_alone():
    rows = noisy(120)
    memory = after(rows[:119])
    expected = rows[115:].mean(axis=0) - bias_of(memory)
    # Sums of six numbers below 1 in another order.
    np.testing.assert_allclose(tared_mean(LAW, memory, rows[119]), expected, atol=1e-14)
    first = new_memory()
    np.testing.assert_array_equal(tared_mean(LAW, first, rows[0]), rows[0])
    lost = after(np.full((1, 6), np.nan), memory=memory)
    two = after(rows[:1], memory=lost)
    expected = rows[:2].mean(axis=0) - bias_of(memory)
    np.testing.assert_allclose(tared_mean(LAW, two, rows[1]), expected, atol=1e-14)
    nan = np.full(6, np.nan)
    np.testing.assert_array_equal(tared_mean(LAW, memory, nan), nan)


def test_the_system_does_what_the_numerics_do_and_a_context_replays():
    builder = DiagramBuilder()
    tare = builder.AddSystem(WrenchTare(WrenchTareConfig()))
    for name, value in (("ee_velocity", REST), ("force_directions", FREE)):
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), tare.GetInputPort(name))
    builder.ExportInput(tare.GetInputPort("wrench"), "wrench")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    own = tare.GetMyContextFromRoot(root)
    port = diagram.GetInputPort("wrench")
    rows = noisy(300)

    def advance(simulator, steps):
        root = simulator.get_mutable_context()
        for k in steps:
            port.FixValue(root, rows[k])
            simulator.AdvanceTo(1e-3 * k + 5e-4)

    advance(simulator, range(200))
    expected = after(rows[:200])
    np.testing.assert_array_equal(
        tare.GetOutputPort("bias").Eval(own), bias_of(expected)
    )
    assert tare.GetOutputPort("status").Eval(own) == TARED
    port.FixValue(root, rows[0])  # Without delay.
    np.testing.assert_array_equal(
        tare.GetOutputPort("wrench").Eval(own), rows[0] - bias_of(expected)
    )
    copy = Simulator(diagram, root.Clone())
    for one in (simulator, copy):
        advance(one, range(200, 300))
    for one in (simulator, copy):
        its = tare.GetMyContextFromRoot(one.get_context())
        np.testing.assert_array_equal(
            tare.GetOutputPort("bias").Eval(its), bias_of(after(rows))
        )


@pytest.mark.parametrize("name, value", [("bias_max", -1.0), ("period_sec", 0.0)])
def test_settings_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}, expected"):
        WrenchTare(WrenchTareConfig(**{name: value}))

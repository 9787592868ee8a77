import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from makebreak.systems.changing_contact.numerics.touch_down import (
    TouchDownConfig,
    TouchPlaceConfig,
    TouchSpeedConfig,
    allowed_speed,
    first_state,
    next_touch,
)
from makebreak.systems.changing_contact.touch_down import TouchDown
from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL, V_TIP
from makebreak.systems.contact_mpc.numerics.contact_sampling import ObjectShape

C, DT = TouchDownConfig(), 1.0 / 240.0
PUSH, RADIUS = 0, 0.01


def touches(n, side, slope, config=C, mass_force=0.0, start=0.03):
    """A tip that goes to a side n times, as fast as it may.

    side: the distance of the model at which it truly is [m], or a function of the
    touch's number; slope: peak force per speed [N s/m].
    Returns: states after each touch, speeds at them.
    """
    state, states, speeds = first_state(config), [], []
    for k in range(n):
        at = side(k) if callable(side) else side
        d = start
        while d > at:  # Free.
            v = allowed_speed(config, state, d)
            state = next_touch(config, state, DT, d, v, mass_force, True)
            d -= v * DT
        speeds.append(v)
        for force in slope * v * np.sin(np.linspace(0.2, np.pi, 12)):
            state = next_touch(config, state, DT, at, 0.0, force, True)
        for _ in range(40):  # Away again, over the air.
            state = next_touch(config, state, DT, 0.05, 0.3, 3.0, False)
        states.append(state)
    return states, np.array(speeds)


@pytest.mark.parametrize("slope", [60.0, 160.0, 500.0])
def test_impacts_have_the_desired_force_after_some_touches(slope):
    _, speeds = touches(12, 0.0, slope)
    assert speeds[0] == pytest.approx(C.speed.first, rel=0.02)
    peaks = slope * speeds * np.sin(np.linspace(0.2, np.pi, 12)).max()
    expected = min(C.force_desired, slope * C.speed.most)
    np.testing.assert_allclose(peaks[-3:], expected, rtol=0.05)
    assert (speeds[1:] <= C.speed.growth * speeds[:-1] + 1e-9).all()
    assert (speeds >= C.speed.least).all() and (speeds <= C.speed.most + 1e-12).all()


@pytest.mark.parametrize("side", [-0.006, 0.0, 0.004])
def test_the_distance_of_a_touch_is_learned_and_the_region_shrinks(side):
    states, _ = touches(10, side, 160.0)
    means = np.array([s.mean for s in states])
    # A tick of the way: the touch is felt up to 0.6 mm late.
    assert abs(means[-1] - side) < 1e-3
    assert states[0].variance < C.place.std_first**2
    assert states[-1].variance < states[0].variance
    # It is Kalman's steady state: P+ = P R / (P + R), P = P+ + Q.
    Q, R = C.place.std_drift**2, C.place.std_measured**2
    posterior = 0.5 * (-Q + np.sqrt(Q**2 + 4.0 * Q * R))
    assert states[-1].variance == pytest.approx(posterior, rel=1e-3)


def test_speed_falls_before_the_region_and_not_after_it():
    state = first_state(C)
    place = C.place
    variance = place.std_first**2 + place.std_drift**2 + place.std_measured**2
    half = place.sigmas * np.sqrt(variance)
    distance = np.linspace(-0.02, 0.04, 601)
    speed = np.array([allowed_speed(C, state, d) for d in distance])
    assert (np.diff(speed) >= 0.0).all()
    np.testing.assert_allclose(speed[distance <= half], C.speed.first)
    np.testing.assert_allclose(speed[distance >= half + C.speed.brake], C.speed.most)
    middle = allowed_speed(C, state, half + 0.5 * C.speed.brake)
    assert middle == pytest.approx(0.5 * (C.speed.first + C.speed.most))


def test_what_a_travelling_tip_feels_is_no_touch():
    state = first_state(C)
    for _ in range(100):
        state = next_touch(C, state, DT, 0.01, 0.3, 20.0, False)
    assert state.impacts == () and state.mean == 0.0 and state.speed == C.speed.first
    # And a push that goes on is one touch, however long.
    for force in (0.0,) * 20 + (5.0,) * 100:
        state = next_touch(C, state, DT, 0.0, 0.1, force, True)
    assert len(state.impacts) == 1


def test_only_a_touch_after_a_while_without_one_is_another():
    state = first_state(C)
    ticks = {"short": round(0.5 * C.apart_sec / DT), "long": round(0.2 / DT)}
    for name, expected in (("short", 1), ("long", 2)):
        found = state
        for gap in (200, ticks[name]):
            for _ in range(gap):
                found = next_touch(C, found, DT, 0.0, 0.05, 0.0, True)
            for _ in range(40):
                found = next_touch(C, found, DT, 0.0, 0.0, 4.0, True)
        assert len(found.impacts) == expected, name


@pytest.mark.parametrize("elsewhere", [0.06, -0.03])
def test_a_touch_of_something_else_teaches_nothing(elsewhere):
    """As of the table: far from where the object's side is anticipated."""
    states, _ = touches(6, 0.001, 160.0)
    state = states[-1]
    for force in (0.0,) * 40 + (10.0,) * 40:
        state = next_touch(C, state, DT, elsewhere, 0.05, force, True)
    assert state.mean == states[-1].mean and state.impacts == states[-1].impacts
    assert state.variance > states[-1].variance  # It is less sure.


def test_a_push_that_was_interrupted_is_no_other_touch():
    state = first_state(C)
    for _ in range(40):
        state = next_touch(C, state, DT, 0.0, 0.05, 0.0, True)
    for pushing in (True,) * 40 + (False,) * 40 + (True,) * 40:  # It presses all along.
        state = next_touch(C, state, DT, 0.0, 0.0, 5.0, pushing)
    assert len(state.impacts) == 1
    # Leaning on it from rest is no impact.
    for force in (0.0,) * 40 + (5.0,) * 40:
        state = next_touch(C, state, DT, 0.0, 1e-3, force, True)
    assert len(state.impacts) == 1


SQUARE = ObjectShape(
    [
        np.array(
            [[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (0, 1)]
        )
    ],
    RADIUS,
    0.04,
)


def system_outputs(x, valid=1.0, force=(0.0, 0.0, 0.0), phase=PUSH, t_end=0.0042):
    touch = TouchDown(C, SQUARE, DT)
    context = touch.CreateDefaultContext()
    for name, value in dict(x=x, valid=[valid], phase=[phase], tip_force=force).items():
        touch.GetInputPort(name).FixValue(context, value)
    Simulator(touch, context).AdvanceTo(t_end)
    return [touch.GetOutputPort(n).Eval(context) for n in ("touch_speed", "belief")]


def state_at(gap, speed=0.1):
    x = np.zeros(N_X)
    x[3] = 1.0
    x[P_BALL] = [0.5, 0.1, 0.02]
    x[0:3] = [0.5 - 0.05 - RADIUS - gap, 0.1, 0.024]
    x[V_TIP] = [speed, 0.0, 0.0]
    return x


def test_the_system_measures_from_the_tips_side_to_the_objects():
    for gap in (-0.002, 0.012, 0.03):
        (speed,), _ = system_outputs(state_at(gap))
        assert speed == pytest.approx(allowed_speed(C, first_state(C), gap))
    (speed,), (mean, std) = system_outputs(state_at(0.003), force=[0.0, -3.0, 0.0])
    assert 0.002 < mean < 0.003 and std < C.place.std_first


def test_bad_input_leaves_all_as_it_is():
    for change in (
        dict(x=np.full(N_X, np.nan)),
        dict(force=[np.nan, 0.0, 3.0]),
    ):
        settings = dict(x=state_at(0.002), force=[3.0, 0.0, 0.0]) | change
        (speed,), belief = system_outputs(**settings)
        assert speed == C.speed.first
        np.testing.assert_array_equal(belief, [0.0, C.place.std_first])
    # Of what is not seen nothing is learned.
    for valid, learned in ((0.0, False), (1.0, True)):
        _, belief = system_outputs(state_at(0.002), valid=valid, force=[3.0, 0.0, 0.0])
        assert (belief[0] != 0.0) == learned


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"force_desired": 0.0}, "touch.force_desired is 0.0, expected > 0"),
        ({"speed": TouchSpeedConfig(first=0.2)}, "speed.first is 0.2, expected betw"),
        ({"speed": TouchSpeedConfig(growth=0.5)}, "speed.growth is 0.5, expected at"),
        ({"place": TouchPlaceConfig(std_first=np.nan)}, "touch.place.std_first is nan"),
    ],
)
def test_a_setting_out_of_range_is_named(change, says):
    with pytest.raises(ValueError, match=says):
        TouchDown(TouchDownConfig(**change), SQUARE, DT)

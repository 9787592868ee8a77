import numba
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.systems.changing_contact.contact_detector import (
    ContactDetector,
    ContactDetectorConfig,
)
from makebreak.systems.changing_contact.numerics.contact_detector import (
    Thresholds,
    detect,
    new_memory,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    BROKEN,
    BROKEN_ROW,
    DIRECTION,
    HOLD,
    MADE,
    MEASURED,
    MOVE,
    N_CONTACT,
    PEAK_FORCE,
    PHASE_STAGE,
    POSITION,
    SPEED,
    STATUS,
    TIME,
)
from makebreak.systems.changing_contact.numerics.impact_score import impact

# A block on an arm of one direction: what the tool would feel.
#   (mass) a = K (x_d - x) + D (v_d - v) - friction - contact
# Integrated at 20 kHz, sampled at 1 kHz. Friction is Coulomb's, rounded below 0.5 mm/s.


@numba.njit(cache=True)
def slide(x_d, v_d, mass, K, D, normal, friction_x, friction_mu, wall, stiffness):
    """Position, speed, acceleration, friction and contact force, each (n,), of the tip
    for the reference x_d, v_d (n,) and the normal force (n,).

    friction_x, friction_mu: friction over the place, interpolated.
    """
    n, sub = len(x_d), 20
    h = 1e-3 / sub
    x, v = x_d[0], 0.0
    out = np.zeros((5, n))
    for i in range(n):
        a = rub = push = 0.0
        for _ in range(sub):
            mu = np.interp(x, friction_x, friction_mu)
            rub = mu * normal[i] * np.tanh(v / 5e-4)
            depth = x - wall
            push = stiffness * depth * (1.0 + 0.5 * v) if depth > 0.0 else 0.0
            push = max(push, 0.0)
            a = (K * (x_d[i] - x) + D * (v_d[i] - v) - rub - push) / mass
            v += h * a
            x += h * v
        out[0, i], out[1, i], out[2, i], out[3, i], out[4, i] = x, v, a, rub, push
    return out


def smooth_reference(speed, seconds, start_sec=0.15, rise_sec=0.2):
    """x_d, v_d (n,) at rest, then at `speed`, reached at about 1 m/s2."""
    t = np.arange(round(seconds / 1e-3)) * 1e-3
    s = np.clip((t - start_sec) / rise_sec, 0.0, 1.0)
    v = speed * s**2 * (3.0 - 2.0 * s)
    return np.cumsum(v) * 1e-3, v


class World:
    """A motion along d, as streams for the detector."""

    def __init__(
        self,
        speed,
        seconds,
        rng,
        normal=0.0,
        friction=((0.0, 0.0),),
        wall=np.inf,
        stiffness=2e4,
        mass=6.0,
        noise=0.1,
        reference=None,
        d=(0.0, 1.0, 0.0),
        tool_mass=0.3,
        stops=True,
    ):
        x_d, v_d = reference or smooth_reference(speed, seconds)
        n, v_target = len(x_d), v_d.copy()
        pressed = normal * (1.0 + 0.2 * np.sin(2 * np.pi * 3.0 * np.arange(n) * 1e-3))
        places, mu = np.array(friction, dtype=float).T
        K = 600.0
        D = 2 * 0.9 * np.sqrt(K * mass)
        arm = (mass, K, D, pressed, places, mu, wall, stiffness)
        x, v, a, rub, push = slide(x_d, v_d, *arm)
        if stops and np.any(push > 3.0):  # The reference stays soon after the touch.
            stop = int(np.argmax(push > 3.0)) + 50
            x_d[stop:], v_d[stop:] = x_d[min(stop, n - 1)], 0.0
            x, v, a, rub, push = slide(x_d, v_d, *arm)
        self.d, down = np.array(d), np.array([0.0, 0.0, -1.0])
        self.x, self.v, self.push, self.wall = x, v, push, wall
        # The sensor sits behind the tool: what accelerates the tool is missing.
        f = -(rub + push + tool_mass * a)[:, None] * self.d - pressed[:, None] * down
        f += np.array([0.3, -0.2, 0.4]) + noise * rng.normal(size=(n, 3))
        self.wrench = np.hstack([f, 0.01 * rng.normal(size=(n, 3))])
        self.pose = np.zeros((n, 7))
        self.pose[:, :3] = x[:, None] * self.d
        self.pose[:, 3] = 1.0
        self.velocity = np.zeros((n, 6))
        self.velocity[:, :3] = v[:, None] * self.d + 3e-4 * rng.normal(size=(n, 3))
        sign = np.sign(v_target)
        self.direction = sign[:, None] * self.d
        self.n = np.zeros((n, 6))
        # Pressed from the start: no bias is taken, so there must be none.
        if normal > 0.0:
            self.n[:, :3] = down
            self.wrench[:, :3] -= [0.3, -0.2, 0.4]
        self.phase = np.zeros((n, 6))

    def touch(self):
        """First index at which the wall is felt; -1: never."""
        touched = np.flatnonzero(self.push > 0.0)
        return int(touched[0]) if touched.size else -1


def run(world, limits=None):
    """(n, 14) the contact vector after each sample."""
    limits = limits or Thresholds()
    memory, contact, rows = new_memory(), np.zeros(N_CONTACT), []
    for i in range(len(world.pose)):
        detect(
            limits,
            memory,
            contact,
            1e-3 * i,
            world.wrench[i],
            world.pose[i],
            world.velocity[i],
            world.direction[i],
            world.n[i],
            world.phase[i],
        )
        rows.append(contact.copy())
    return np.array(rows)


def random_impacts(rng, count, free):
    """Worlds with one impact of 2.5 to 60 N, in free space or while sliding."""
    made = 0
    while made < count:
        mass, stiffness = rng.uniform(3.0, 15.0), 10 ** rng.uniform(np.log10(5e3), 5.0)
        force = np.exp(rng.uniform(np.log(2.5), np.log(60.0)))
        speed = force / np.sqrt(stiffness * mass)
        if not 0.004 < speed < 0.25:
            continue
        mu = 0.0 if free else rng.uniform(0.1, 0.6)
        lag = mu * 14.0 / 600.0 / speed  # Friction stretches the arm's spring first.
        sliding = rng.uniform(0.5, 1.0)  # Time before the contact.
        world = World(
            speed,
            0.35 + sliding + lag + 0.5,
            rng,
            normal=0.0 if free else rng.uniform(6.0, 14.0),
            friction=((0.0, mu),),
            wall=speed * (0.1 + sliding),
            stiffness=stiffness,
            mass=mass,
            noise=rng.uniform(0.1, 0.5 if force > 4.0 else 0.2),
            d=(1.0, 0.0, 0.0) if rng.random() < 0.5 else (0.0, -1.0, 0.0),
        )
        # Friction on a pressure that varies makes the arm's speed vary, and at times
        # stop: what counts is the speed that is left at the wall.
        touch = world.touch()
        if touch > 0 and world.v[touch] * np.sqrt(stiffness * mass) > 2.5:
            made += 1
            yield world


@pytest.mark.parametrize("free", [True, False])
def test_many_impacts_are_each_felt_once_at_their_place(free):
    rng = np.random.default_rng(1)
    place, late, speed, error = [], [], [], []
    for world in random_impacts(rng, 60, free):
        rows, touch = run(world), world.touch()
        assert rows[touch - 1, MADE] == 0
        assert rows[-1, MADE] == 1 and rows[-1, MEASURED] == 1
        assert rows[-1, BROKEN] == 0 and not rows[:, STATUS].any()
        np.testing.assert_array_equal(rows[-1, DIRECTION], world.d)
        place.append(rows[-1, POSITION] @ world.d - world.wall)
        late.append(rows[-1, TIME] - 1e-3 * touch)
        speed.append(rows[-1, SPEED] / world.v[touch - 5 : touch].mean())
        highest = world.push[touch : touch + 75].max()
        error.append((rows[-1, PEAK_FORCE] - highest) / (1.0 + highest))
    # Sampled at 1 kHz, a tip at 0.25 m/s moves 0.25 mm; two samples are the filter's.
    assert np.abs(place).max() < 0.6e-3
    assert np.percentile(np.abs(late), 90) <= 5e-3
    # Friction and spring change the speed over the 12 samples of its mean.
    np.testing.assert_allclose(speed, 1.0, atol=0.1)
    # 100 Hz cuts the stiffest, up to 20 %; the tool's inertia is 2 to 10 % of it.
    assert np.percentile(error, 5) > -0.2 and np.percentile(error, 95) < 0.15


def test_friction_never_counts_as_an_impact():
    # Steps, ramps of 5 to 30 mm and reversals, friction 0.1 to 0.6, at 30 to 250 mm/s.
    rng = np.random.default_rng(0)
    for k in range(60):
        speed = np.exp(rng.uniform(np.log(0.03), np.log(0.25)))
        a, b = (0.1, 0.6) if k % 4 == 0 else rng.uniform(0.1, 0.6, 2)
        width = (1e-5, 1e-5, rng.uniform(0.005, 0.03))[k % 3]
        x1 = speed * rng.uniform(0.5, 1.0)
        x2 = x1 + width + speed * rng.uniform(0.5, 0.8)
        seconds, reference = 0.8 + 0.1 / speed + x2 / speed, None
        if k % 3 == 0:
            t = np.arange(5000) * 1e-3 - 0.15
            v = speed * np.sin(2 * np.pi * t / rng.uniform(1.0, 2.5)) * (t > 0.0)
            reference = (np.cumsum(v) * 1e-3, v)
        places = (0.0, x1, x1 + width, x2, x2 + width)
        world = World(
            speed,
            min(seconds, 5.0),
            rng,
            normal=rng.uniform(6.0, 12.0),
            friction=tuple(zip(places, (a, a, b, b, a), strict=True)),
            mass=rng.uniform(3.0, 15.0),
            noise=rng.uniform(0.1, 0.5),
            reference=reference,
        )
        assert run(world)[-1, MADE] == 0, (k, speed, a, b)


def test_an_impact_within_the_learning_time_is_felt():
    # 0.2 s after the start friction is not known yet: 20 N are more than it can be.
    rng = np.random.default_rng(3)
    for _ in range(20):
        world = World(
            0.1,
            1.0,
            rng,
            normal=rng.uniform(6.0, 10.0),
            friction=((0.0, rng.uniform(0.1, 0.6)),),
            wall=0.004,
        )
        touch = world.touch()
        assert 0 < touch < 370
        rows = run(world)
        assert rows[touch - 1, MADE] == 0 and rows[-1, MADE] == 1


def shuttle(acceleration, seconds=2.0):
    """x_d, v_d (n,) to and fro with the given acceleration [m/s2] at its ends."""
    t = np.arange(round(1e3 * seconds)) * 1e-3 - 0.15
    rate = 2.0 * np.pi * 2.0
    x = acceleration / rate**2 * (1.0 - np.cos(rate * t)) * (t > 0.0)
    v = acceleration / rate * np.sin(rate * t) * (t > 0.0)
    return x, v


def test_the_inertia_of_the_tool_is_no_contact():
    # 1 kg at 4 m/s2 are 4 N; it is an impact to whom does not know the tool.
    rng = np.random.default_rng(0)
    world = World(
        0.0, 0.0, rng, reference=shuttle(4.0), tool_mass=1.0, mass=3.0, noise=0.1
    )
    assert run(world, Thresholds(tool_mass=1.0))[-1, MADE] == 0
    # Thrice the threshold: without the compensation it is a contact.
    assert run(world, Thresholds(tool_mass=0.0, impact_force=0.7))[-1, MADE] > 0
    assert run(world, Thresholds(tool_mass=1.0, impact_force=1.2))[-1, MADE] == 0


def test_gentle_contacts_are_felt_with_a_lower_threshold():
    # Impacts of 1 to 3 N with a quieter sensor.
    rng = np.random.default_rng(0)
    for force in np.linspace(1.0, 3.0, 20):
        world = World(
            force / np.sqrt(5e3 * 4.0),
            1.6,
            rng,
            wall=0.8 * force / np.sqrt(5e3 * 4.0),
            stiffness=5e3,
            mass=4.0,
            noise=0.05,
        )
        touch, rows = world.touch(), run(world, Thresholds(impact_force=0.5))
        assert touch > 0 and rows[touch - 1, MADE] == 0 and rows[-1, MADE] == 1
        np.testing.assert_allclose(rows[-1, PEAK_FORCE], force, rtol=0.2, atol=0.15)


def test_the_peak_is_the_impact_s_and_not_of_the_push_after_it():
    # 0.02 m/s into 2e4 N/m is 7 N; a push to 12 N begins 45 ms after the touch.
    rng = np.random.default_rng(5)
    world = World(0.02, 1.6, rng, wall=0.02, stiffness=2e4)
    touch, impact = world.touch(), world.push.max()
    push = 12.0 * np.clip((np.arange(len(world.x)) - touch - 45) / 30.0, 0.0, 1.0)
    world.wrench[:, :3] -= push[:, None] * world.d
    rows = run(world)
    assert (world.push + push)[touch : touch + 80].max() > 1.25 * impact
    np.testing.assert_allclose(rows[-1, PEAK_FORCE], impact, rtol=0.1)


@pytest.mark.parametrize("stiffness", [1e4, 5e4, 2e5])
def test_the_peak_is_the_one_that_impacts_are_scored_by(stiffness):
    rng = np.random.default_rng(6)
    speed = 9.0 / np.sqrt(stiffness * 4.0)
    world = World(speed, 1.6, rng, wall=0.9 * speed, stiffness=stiffness, mass=4.0)
    rows, time = run(world), 1e-3 * np.arange(len(world.x))
    touch = 1e-3 * world.touch()
    F100 = impact(time, world.wrench[:, :3], world.velocity[:, :3], world.d, touch).peak
    # The mean before the contact is taken over other samples.
    np.testing.assert_allclose(rows[-1, PEAK_FORCE], F100, atol=0.1)


def test_the_bias_of_the_wrench_is_taken_off():
    # World adds (0.3, -0.2, 0.4) N; along an axis with a bias of 5 N nothing is felt.
    rng = np.random.default_rng(0)
    world = World(0.1, 1.5, rng)
    world.wrench[:, 1] -= 5.0
    assert run(world)[-1, MADE] == 0
    world.direction[:] = world.d  # In motion from the first sample: no time to zero it.
    world.velocity[:, 1] += 0.05
    assert run(world)[-1, MADE] > 0


def test_a_contact_is_felt_again_after_the_tip_has_turned_back():
    rng = np.random.default_rng(0)
    t = np.arange(4000) * 1e-3 - 0.15
    v = 0.06 * np.sin(2 * np.pi * t / 2.0) * (t > 0.0)
    world = World(0, 0, rng, wall=0.03, reference=(np.cumsum(v) * 1e-3, v), stops=False)
    rows = run(world)
    assert rows[-1, MADE] == 2 and rows[-1, MEASURED] == 2


def pressing(n, seconds=1.0, force=8.0, noise=0.1):
    """A tool at rest that presses along n (3,): a world to change."""
    rng = np.random.default_rng(0)
    world = World(0.0, seconds, rng, noise=noise)
    world.wrench[:, :3] = noise * rng.normal(size=(len(world.pose), 3)) - force * n
    world.n[:, 3:] = n
    return world


def test_a_lost_contact_is_said_once_and_when():
    n = np.array([1.0, 0.0, 0.0])
    world = pressing(n)
    world.wrench[500:, :3] += 8.0 * n
    rows = run(world)
    assert rows[-1, BROKEN] == 1 and rows[-1, BROKEN_ROW] == 1
    when = int(np.argmax(rows[:, BROKEN] > 0))
    # 8 samples below 1 N, after a filter that takes 1.6 ms x ln 8 to get there.
    assert 508 <= when <= 513


@pytest.mark.parametrize("gap", [3, 5])
def test_a_short_bounce_is_no_loss(gap):
    n = np.array([0.0, 0.0, -1.0])
    world = pressing(n)
    world.wrench[500 : 500 + gap, :3] += 8.0 * n
    assert run(world)[-1, BROKEN] == 0


def test_a_contact_that_never_was_is_not_lost():
    n = np.array([0.0, 0.0, -1.0])
    world = pressing(n, force=0.3)
    assert run(world)[-1, BROKEN] == 0
    world = pressing(n)
    world.n[500:] = 0.0  # Let go on purpose.
    world.wrench[500:, :3] += 8.0 * n
    assert run(world)[-1, BROKEN] == 0


@pytest.mark.parametrize("fault", ["nan", "stuck", "limit", "pose", "phase"])
def test_a_bad_sensor_is_said_and_reports_nothing(fault):
    rng = np.random.default_rng(0)
    world = World(0.05, 2.0, rng, wall=0.06)
    touch = world.touch()
    bad = slice(touch - 200, touch + 100)
    if fault == "nan":
        world.wrench[bad, 2] = np.nan
    elif fault == "stuck":
        world.wrench[bad] = world.wrench[bad.start - 1]
    elif fault == "limit":
        world.wrench[bad, 0] = -250.0
    elif fault == "pose":
        world.pose[bad, 1] = np.nan
    else:
        world.phase[bad, 1] = np.inf
    rows = run(world)
    assert np.all(np.isfinite(rows))
    assert not rows[: bad.stop, MADE].any() and not rows[:, BROKEN].any()
    first = 50 if fault == "stuck" else 0  # It takes 50 ms to see that it is stuck.
    assert rows[bad, STATUS][first:].all() and not rows[bad.stop :, STATUS].any()
    assert not rows[: bad.start, STATUS].any()


def test_after_a_drop_out_the_next_impact_is_felt():
    rng = np.random.default_rng(0)
    world = World(
        0.05, 2.0, rng, normal=8.0, friction=((0.0, 0.4),), wall=0.07, noise=0.2
    )
    touch = world.touch()
    world.wrench[touch - 500 : touch - 300] = np.nan
    rows = run(world)
    assert rows[touch - 1, MADE] == 0 and rows[-1, MADE] == 1
    assert abs(rows[-1, POSITION] @ world.d - world.wall) < 3e-4


def test_a_motion_on_hold_reports_no_contact():
    rng = np.random.default_rng(0)
    world = World(0.05, 1.5, rng, wall=0.04)
    assert run(world)[-1, MADE] == 1
    world.phase[:, PHASE_STAGE] = HOLD
    assert run(world)[-1, MADE] == 0
    world.phase[:, PHASE_STAGE] = MOVE
    world.n[:, :3] = world.d  # Force-controlled along d: what is felt is wanted.
    assert run(world)[-1, MADE] == 0


# The system.


def test_the_system_gives_what_the_kernel_gives():
    rng = np.random.default_rng(0)
    world = World(0.1, 1.0, rng, wall=0.05)
    expected = run(world)
    builder = DiagramBuilder()
    detector = builder.AddSystem(ContactDetector(ContactDetectorConfig()))
    ports = ("wrench", "ee_pose", "ee_velocity", "direction")
    ports += ("force_directions", "phase")
    sources = {}
    for name in ports:
        port = detector.GetInputPort(name)
        sources[name] = builder.AddSystem(ConstantVectorSource(np.zeros(port.size())))
        builder.Connect(sources[name].get_output_port(), port)
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    context = detector.GetMyContextFromRoot(root)
    streams = (world.wrench, world.pose, world.velocity, world.direction)
    streams += (world.n, world.phase)
    for i in range(len(world.pose)):
        for name, stream in zip(ports, streams, strict=True):
            source = sources[name]
            value = source.get_mutable_source_value(
                source.GetMyMutableContextFromRoot(root)
            )
            value.SetFromVector(stream[i])
        simulator.AdvanceTo(1e-3 * i + 5e-4)
        # Times are sums of 1 ms in one, products in the other: equal to 1e-12 s.
        contact = detector.GetOutputPort("contact").Eval(context)
        np.testing.assert_allclose(contact, expected[i], atol=1e-12)
    assert expected[-1, MADE] == 1
    along = detector.GetOutputPort("along").Eval(context)
    assert along.shape == (2,) and np.all(np.isfinite(along))


@pytest.mark.parametrize(
    "change, words",
    [
        ({"impact_force": 0.0}, "impact_force is 0.0, expected a positive"),
        ({"loss_force": np.nan}, "loss_force is nan"),
        ({"tool_mass": -0.1}, "tool_mass is -0.1"),
        ({"period_sec": 0.01}, "period_sec is 0.01, expected 0.002 s or less"),
        ({"offset_sec": -1.0}, "offset_sec is -1.0"),
    ],
)
def test_bad_configs_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        ContactDetector(ContactDetectorConfig(**change))

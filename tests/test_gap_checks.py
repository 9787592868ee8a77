"""Checks of a recording: planted faults are found and sized, clean data are not."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.station import BALL_ROLLING
from makebreak.gap.data.check_motion import excitation, free_flight_gravity
from makebreak.gap.data.checks import check_recordings
from makebreak.gap.data.findings import JointFacts, SceneFacts
from makebreak.gap.data.pieces import without_stops
from makebreak.gap.data.reading import check_against_scene, read_recording
from makebreak.gap.data.scene_facts import scene_facts, scene_names
from makebreak.gap.data.table import write_recording
from makebreak.gap.numerics.signal_relation import angular_velocity, relate
from makebreak.models.scene import load_scene

RATE = 200.0  # [Hz]
N = 4000


class Motion:
    """A multisine: exact position and velocity at any time."""

    def __init__(self, rng):
        self.w = 2 * np.pi * rng.uniform(0.1, 1.2, 6)
        self.phase = rng.uniform(0, 2 * np.pi, 6)
        self.size = rng.uniform(0.1, 0.5, 6)

    def q(self, t):
        return (self.size * np.sin(np.outer(t, self.w) + self.phase)).sum(axis=1)

    def v(self, t):
        a = self.size * self.w
        return (a * np.cos(np.outer(t, self.w) + self.phase)).sum(axis=1)


def arm(seed, joints=1, n=N, lag=0.0, skew=0.0, scale=1.0, bias=0.0, u_lag=0.0):
    """Columns of a clean arm, but for what is planted in the velocity and effort."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE
    columns = {"time": t}
    for j in range(joints):
        m, u = Motion(rng), Motion(rng)
        columns[f"arm.j{j}.position"] = m.q(t) + 3e-5 * rng.normal(size=n)
        late = t - lag - skew * t
        columns[f"arm.j{j}.velocity"] = (
            scale * m.v(late) + bias + 5e-3 * rng.normal(size=n)
        )
        held = 5.0 * u.q(np.floor(t * RATE + 1e-6) / RATE)
        columns[f"arm.j{j}.effort_command"] = held
        columns[f"arm.j{j}.effort_measured"] = 5.0 * u.q(
            np.floor((t - u_lag) * RATE + 1e-6) / RATE
        ) + 0.03 * rng.normal(size=n)
    return columns


def findings(tmp_path, columns, facts=None):
    path = tmp_path / "r.npz"
    write_recording(path, columns)
    return check_recordings([read_recording(path)], facts)


def one(found, kind):
    of_kind = [f for f in found if f.kind == kind]
    assert len(of_kind) == 1, found
    return of_kind[0]


@pytest.mark.parametrize(
    "block", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 5))]
)
def test_clean_recordings_of_100_seeds_raise_no_finding(tmp_path, block):
    facts = SceneFacts({f"arm.j{j}": JointFacts(False, -4, 4, 60) for j in range(2)})
    for seed in range(20 * block, 20 * block + 20):
        assert findings(tmp_path, arm(seed, joints=2, n=2000), facts) == []


def falling(seed, g=9.81, episodes=6, scale=1.0, body_axes=False, flip=False):
    """A tumbling body thrown several times: columns of pose and twist."""
    rng = np.random.default_rng(seed)
    n, dt = 120, 1 / 200
    parts = []
    for k in range(episodes):
        t = np.arange(n) * dt
        v0 = np.array([*rng.uniform(-0.5, 0.5, 2), 2.0])
        p = v0 * t[:, None] + np.outer(t**2, [0, 0, -g / 2]) + [0, 0, 0.5]
        v = v0 + np.outer(t, [0, 0, -g])
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        # Turns about an axis fixed in world, from an orientation of its own.
        start = rng.normal(size=4)
        start /= np.linalg.norm(start)
        rate = 6.0
        half = 0.5 * rate * t
        a0, a = np.cos(half), np.sin(half)[:, None] * axis
        b0, b = start[0], start[1:]
        q = np.column_stack(
            [a0 * b0 - a @ b, a0[:, None] * b + b0 * a + np.cross(a, b)]
        )
        w = np.tile(rate * axis, (n, 1))
        if body_axes:
            R = rotation(q)
            w = np.einsum("nji,nj->ni", R, w)
        q += 2e-4 * rng.normal(size=q.shape)
        q /= np.linalg.norm(q, axis=1)[:, None]
        if flip:
            q[n // 2 :] *= -1.0
        part = {"time": t, "episode": np.full(n, k)}
        for i, x in enumerate("xyz"):
            part[f"c.c.{x}"] = scale * (p[:, i] + 5e-5 * rng.normal(size=n))
            part[f"c.c.v{x}"] = scale * (v[:, i] + 5e-3 * rng.normal(size=n))
            part[f"c.c.w{x}"] = w[:, i] + 0.02 * rng.normal(size=n)
        for i, x in enumerate("wxyz"):
            part[f"c.c.q{x}"] = q[:, i]
        parts.append(part)
    return {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}


def rotation(q):
    w, x, y, z = q.T
    R = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(R).transpose(2, 0, 1)


def test_clean_flights_of_10_seeds_raise_no_finding(tmp_path):
    for seed in range(10):
        assert findings(tmp_path, falling(seed)) == []


@pytest.mark.parametrize("lag", [-0.012, 0.0012, 0.004, 0.05])
def test_a_lag_of_velocity_is_found_and_sized(tmp_path, lag):
    found = one(findings(tmp_path, arm(1, lag=lag)), "velocity_lag")
    assert found.size == pytest.approx(lag, abs=1e-4)
    assert found.channel == "arm.j0.velocity" and found.severity == "warning"


def test_a_backward_difference_is_recognised(tmp_path):
    columns = arm(2)
    q = columns["arm.j0.position"]
    columns["arm.j0.velocity"] = np.diff(q, prepend=q[0]) * RATE
    found = one(findings(tmp_path, columns), "velocity_lag")
    assert found.size == pytest.approx(0.5 / RATE, rel=0.05)
    assert "backward difference" in found.says


@pytest.mark.parametrize("skew", [1e-4, -5e-4])
def test_a_clock_that_runs_apart_is_found_and_sized(tmp_path, skew):
    found = one(findings(tmp_path, arm(3, skew=skew)), "clock_skew")
    assert found.size == pytest.approx(skew, rel=0.1)


def test_scale_and_bias_of_velocity_are_found_and_sized(tmp_path):
    found = findings(tmp_path, arm(4, scale=1.03, bias=-0.05))
    assert one(found, "velocity_scale").size == pytest.approx(1.03, abs=2e-3)
    assert one(found, "velocity_bias").size == pytest.approx(-0.05, abs=2e-3)
    assert len(found) == 2


@pytest.mark.parametrize("scale", [180 / np.pi, np.pi / 180, 1e3])
def test_a_ratio_that_is_a_unit_is_called_so(tmp_path, scale):
    found = one(findings(tmp_path, arm(5, scale=scale)), "units")
    assert found.severity == "error"
    assert one(findings(tmp_path, arm(5, scale=-1.0)), "sign").severity == "error"


def test_degrees_are_suspected_from_the_joint_limits(tmp_path):
    columns = arm(6)
    del columns["arm.j0.velocity"]
    columns["arm.j0.position"] *= 180 / np.pi
    facts = SceneFacts({"arm.j0": JointFacts(False, -2.9, 2.9)})
    found = one(findings(tmp_path, columns, facts), "units")
    assert "deg" in found.says and found.severity == "error"


def test_millimetres_are_suspected_from_the_fall(tmp_path):
    columns = falling(0, scale=1000.0)
    assert any("mm" in f.says for f in findings(tmp_path, columns) if f.kind == "units")


@pytest.mark.parametrize("lag", [0.01, 0.03])
def test_effort_that_follows_late_is_found(tmp_path, lag):
    found = one(findings(tmp_path, arm(7, u_lag=lag)), "effort_lag")
    assert found.size == pytest.approx(lag, abs=0.5 / RATE)


def test_an_effort_at_its_ceiling_and_a_clipped_command_are_found(tmp_path):
    columns = arm(8)
    u = columns["arm.j0.effort_command"]
    limit = 0.6 * np.abs(u).max()
    noise = columns["arm.j0.effort_measured"] - u
    columns["arm.j0.effort_measured"] = np.clip(u, -limit, limit) + noise
    found = one(findings(tmp_path, columns), "effort_ceiling")
    assert found.size == pytest.approx(limit, rel=0.01)
    columns["arm.j0.effort_command"] = np.clip(u, -limit, limit)
    found = findings(tmp_path, columns)
    assert abs(one(found, "command_ceiling").size) == pytest.approx(limit)
    facts = SceneFacts({"arm.j0": JointFacts(effort_limit=0.5 * limit)})
    assert one(findings(tmp_path, columns, facts), "beyond_limit").size == limit


def test_jitter_lost_rows_and_lost_samples_are_counted(tmp_path):
    rng = np.random.default_rng(0)
    columns = arm(9)
    columns["time"] = columns["time"] + 3e-4 * rng.normal(size=N)
    found = findings(tmp_path, columns)
    assert one(found, "clock_jitter").size == pytest.approx(3e-4, rel=0.1)
    columns = arm(9)
    kept = rng.uniform(size=N) > 0.02
    lost = N - kept[: np.flatnonzero(kept)[-1]].sum() - 1
    found = findings(tmp_path, {k: v[kept] for k, v in columns.items()})
    assert one(found, "rows_lost").size == pytest.approx(lost / N, rel=0.02)
    columns = arm(9)
    columns["arm.j0.position"][rng.uniform(size=N) < 0.1] = np.nan
    found = one(findings(tmp_path, columns), "samples_lost")
    assert found.size == pytest.approx(0.1, rel=0.2) and found.severity == "warning"


def test_a_slow_channel_is_not_called_lossy(tmp_path):
    columns = arm(10)
    slow = np.full(N, np.nan)
    slow[::4] = columns["arm.j0.velocity"][::4]
    columns["arm.j0.velocity"] = slow
    assert findings(tmp_path, columns) == []


@pytest.mark.parametrize("every", [33.3e-3, 1.7e-3])
def test_channels_at_instants_of_their_own_lack_nothing(tmp_path, every):
    """As in a bag: each message is a row, of the joints' or of another sensor's."""
    columns = arm(10)
    own = columns["time"][0] + 4.07e-4 + every * np.arange(int(2.0 / every))
    time = np.concatenate([columns["time"], own])
    order = np.argsort(time)
    table = {}
    for name, y in columns.items():
        both = np.concatenate([y, np.full(len(own), np.nan)])
        table[name] = both[order]
    other = 5e-3 * np.random.default_rng(3).normal(size=len(own))
    slow = np.concatenate([np.full(N, np.nan), np.sin(own) + other])
    table["arm.j0.velocity"] = slow[order]
    table["time"] = time[order]
    found = findings(tmp_path, table)
    assert not [f for f in found if f.kind in ("samples_lost", "rows_lost")]
    # What one of them does lack is counted.
    there = np.flatnonzero(~np.isnan(table["arm.j0.velocity"]))
    table["arm.j0.velocity"][there[3::10]] = np.nan
    lost = [f for f in findings(tmp_path, table) if f.kind == "samples_lost"]
    assert [f.channel for f in lost] == ["arm.j0.velocity"]
    assert lost[0].size == pytest.approx(0.1, rel=0.1)


def test_resolution_and_a_stuck_channel_are_found(tmp_path):
    columns = arm(11)
    columns["arm.j0.position"] = np.round(columns["arm.j0.position"] / 2e-3) * 2e-3
    found = findings(tmp_path, columns)
    assert one(found, "resolution").size == pytest.approx(2e-3)
    assert not [f for f in found if f.kind == "stuck"]
    columns["arm.j0.position"][1000:1100] = columns["arm.j0.position"][1000]
    assert one(findings(tmp_path, columns), "stuck").size == pytest.approx(0.5, abs=0.1)
    columns = arm(11)
    columns["arm.j0.velocity"][50:70] = columns["arm.j0.velocity"][50]
    assert one(findings(tmp_path, columns), "stuck").size == pytest.approx(19 / RATE)


def test_an_encoder_that_turns_slowly_is_not_stuck(tmp_path):
    """Noise of a third of its steps, which a slow turn takes far apart."""
    columns = arm(11)
    t, step = np.arange(N) / RATE, 4e-4
    noisy = np.sin(0.9 * t) + 0.3 * step * np.random.default_rng(2).normal(size=N)
    columns["arm.j0.position"] = np.round(noisy / step) * step
    columns["arm.j0.velocity"] = 0.9 * np.cos(0.9 * t)
    found = findings(tmp_path, columns)
    assert not [f for f in found if f.kind == "stuck"]


def test_a_channel_that_swings_from_sample_to_sample_is_no_noise(tmp_path):
    columns = arm(12)
    columns["arm.j0.velocity"][N // 3 :: 2] += 20.0
    assert one(findings(tmp_path, columns), "hunting").channel == "arm.j0.velocity"
    # A joint that stands still measures noise, and no more than that.
    columns = arm(12)
    columns["arm.j0.velocity"] = 5e-3 * np.random.default_rng(1).normal(size=N)
    assert not [f for f in findings(tmp_path, columns) if f.kind == "hunting"]


def test_a_twist_in_body_axes_is_called_so_and_flips_are_counted(tmp_path):
    found = findings(tmp_path, falling(1, body_axes=True, flip=True))
    assert one(found, "body_axes").severity == "error"
    assert one(found, "quaternion_flips").size == 6


def test_apparent_gravity_of_flights(tmp_path):
    found = one(findings(tmp_path, falling(2, g=9.65)), "apparent_gravity")
    assert found.size == pytest.approx(9.65, abs=0.03)
    write_recording(tmp_path / "r.npz", falling(3))
    g, std = free_flight_gravity(read_recording(tmp_path / "r.npz"), "c.c")
    assert g == pytest.approx(9.81, abs=5 * std) and std < 0.03


def test_angular_velocity_agrees_with_the_planted_one():
    columns = falling(4, episodes=1)
    q = np.column_stack([columns[f"c.c.q{x}"] for x in "wxyz"])
    w = np.column_stack([columns[f"c.c.w{x}"] for x in "xyz"])
    _, world, _ = angular_velocity(columns["time"], q)
    # 120 steps, each off by 2e-4 sqrt(2) 2 / 5 ms = 0.11 rad/s, telescoping.
    np.testing.assert_allclose(world.mean(axis=0), w.mean(axis=0), atol=0.02)


def test_excitation_tells_a_joint_that_never_turns_back(tmp_path):
    t = np.arange(N) / RATE
    rng = np.random.default_rng(0)
    columns = {"time": t, "arm.j0.position": 0.3 * t + 3e-5 * rng.normal(size=N)}
    columns["arm.j1.position"] = 3e-5 * rng.normal(size=N)
    found = findings(tmp_path, columns)
    kinds = {(f.kind, f.channel) for f in found}
    assert kinds == {
        ("few_reversals", "arm.j0.position"),
        ("one_speed", "arm.j0.position"),
        ("no_motion", "arm.j1.position"),
    }
    columns = {
        "time": t,
        "arm.j0.position": np.sin(2 * t) + 3e-5 * rng.normal(size=N),
    }
    write_recording(tmp_path / "r.npz", columns)
    e = excitation(read_recording(tmp_path / "r.npz"), "arm.j0")
    assert e.reversals == 13  # cos 2t has 12.7 half periods in 20 s.
    assert e.speed_max == pytest.approx(2.0, rel=0.01)
    assert e.range == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize("upper", [0.8, 1.1])
def test_a_joint_that_lies_at_a_limit_is_told(tmp_path, upper):
    t, rng = np.arange(N) / RATE, np.random.default_rng(0)
    y = np.minimum(np.sin(2.0 * t), upper) + 3e-5 * rng.normal(size=N)
    write_recording(tmp_path / "r.npz", {"time": t, "arm.j0.position": y})
    facts = SceneFacts(joints={"arm.j0": JointFacts(lower=-3.0, upper=upper)})
    recording = read_recording(tmp_path / "r.npz")
    (less,), found = without_stops([recording], facts)
    share = np.mean(np.sin(2.0 * t) > upper)  # A fifth, or none.
    sizes = [f.size for f in found]
    assert sizes == pytest.approx([share] if share else [], abs=0.005)
    assert (less is recording) == (not share)
    assert np.nanmax(less["arm.j0.position"]) < upper
    # A limit that a joint goes beyond stops nothing.
    far = SceneFacts(joints={"arm.j0": JointFacts(lower=-3.0, upper=0.5)})
    assert without_stops([recording], far) == ([recording], [])
    # Where it lies there, all that is left is said.
    low = SceneFacts(joints={"arm.j0": JointFacts(lower=-3.0, upper=-0.95)})
    lies = np.minimum(y, -0.95)
    write_recording(tmp_path / "l.npz", {"time": t, "arm.j0.position": lies})
    recording = read_recording(tmp_path / "l.npz")
    out, (said,) = without_stops([recording], low)
    assert out == [recording] and said.severity == "warning"


def test_nothing_is_told_of_too_little_or_of_a_constant():
    t = np.arange(30.0)
    assert relate(t, t, t, t) is None
    t = np.arange(500.0)
    assert relate(t, np.ones(500), t, np.ones(500)) is None


def test_facts_and_names_come_from_a_plant(tmp_path):
    builder = DiagramBuilder()
    plant = load_scene(BALL_ROLLING, builder).plant
    facts = scene_facts(plant)
    assert facts.free == {"ball.ball"} and facts.gravity == pytest.approx(9.81)
    joint = facts.joints["panda.panda_joint4"]
    assert joint.effort_limit == 87.0 and joint.upper < 0.0 and not joint.prismatic
    names = [f"panda.panda_joint{i}" for i in range(1, 8)]
    zero = dict.fromkeys(names, 0.0)
    q = zero | {"panda.panda_joint2": -np.pi / 4, "panda.panda_joint4": -2.0}
    gravity, inertial = facts.torques(q, zero, zero)
    assert abs(gravity["panda.panda_joint1"]) < 1e-9  # A vertical axis.
    assert inertial["panda.panda_joint2"] == 0.0
    # Work against gravity, by a finite difference of the potential energy.
    context = plant.CreateDefaultContext()
    energy = []
    for step in (-1e-6, 1e-6):
        for name, value in q.items():
            joint = plant.GetJointByName(name.split(".")[1])
            moved = value + step * (name == "panda.panda_joint4")
            joint.set_angle(context, moved)
        energy.append(plant.CalcPotentialEnergy(context))
    expected = (energy[1] - energy[0]) / 2e-6
    assert gravity["panda.panda_joint4"] == pytest.approx(expected, abs=1e-6)
    joints, bodies = scene_names(plant)
    columns = arm(0)
    columns = {k.replace("arm.j0", "panda.panda_joint1"): v for k, v in columns.items()}
    columns["ball.ball.x"] = np.random.default_rng(0).normal(size=N)
    write_recording(tmp_path / "r.npz", columns)
    recording = read_recording(tmp_path / "r.npz")
    check_against_scene(recording, joints, bodies)
    with pytest.raises(ValueError, match="no body or frame"):
        check_against_scene(recording, joints, bodies - {"ball.ball"})
    assert replace(JointFacts(), prismatic=True).prismatic

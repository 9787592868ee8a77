"""The logs with hidden effects are what they say, and do not tell what is hidden."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

pytest.importorskip("mujoco", reason="the logs are simulated in MuJoCo")

from gap_benchmark import log_cases  # noqa: E402
from gap_benchmark.effort_laws import added_effort, jacobians  # noqa: E402
from gap_benchmark.log_cases import (  # noqa: E402
    LINK_COM,
    LINK_MASS,
    RECIPES,
    SEEDS,
    LogCase,
    Recipe,
    cases,
    make,
    write,
)
from gap_benchmark.motions import MOTIONS  # noqa: E402
from gap_benchmark.robot_log import (  # noqa: E402
    Filter,
    Logging,
    wandering,
    write_log,
)
from gap_benchmark.robot_world import (  # noqa: E402
    Drive,
    Inverse,
    Push,
    RobotWorld,
    Track,
)
from gap_benchmark.robots import ROBOTS, with_point  # noqa: E402
from gap_benchmark.ties import CLEAR, SAME, Comparison, velocity_rivals  # noqa: E402
from gap_benchmark.two_link import TwoLinkWorld  # noqa: E402
from pydrake.systems.framework import DiagramBuilder  # noqa: E402

from makebreak.gap.data.reading import check_against_scene, read_recording  # noqa: E402
from makebreak.gap.data.scene_facts import scene_names  # noqa: E402
from makebreak.models.scene import load_scene  # noqa: E402


def effect(kind, at, **parameters):
    return {"kind": kind, "at": at, "parameters": parameters}


def robot_and_motion(
    name="planar", motion="multisine", seconds=2.0, seed=0, hand=False
):
    rng = np.random.default_rng(seed)
    robot = ROBOTS[name](rng, hand)
    return robot, MOTIONS[motion](robot, seconds, 0.001, rng)


# ----- The worlds


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_weighs_the_same_in_its_urdf_and_in_mujoco(name, tmp_path):
    """Drake's inverse dynamics of the URDF that a case gives away, against MuJoCo's of
    the numbers: what a case without an effect is without."""
    from gap_benchmark.robots import to_urdf
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import MultibodyForces

    robot, motion = robot_and_motion(name, hand=name != "planar")
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(to_urdf(robot), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    rows = [0, 700, 1500]
    ours = Inverse(robot)(motion.q[rows], motion.v[rows], motion.a[rows])
    for k, row in enumerate(rows):
        plant.SetPositions(context, motion.q[row])
        plant.SetVelocities(context, motion.v[row])
        gravity = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, gravity)
        drake = plant.CalcInverseDynamics(context, motion.a[row], gravity)
        # The URDF has ten digits; places of 1 m and forces of 100 N.
        np.testing.assert_allclose(drake, ours[k], atol=1e-6)


def test_the_ode_and_mujoco_move_alike():
    robot, motion = robot_and_motion("planar")
    damping = [effect("joint_viscous_damping", robot.joints[1], damping=0.2)]
    one = TwoLinkWorld(robot, robot, damping).run(motion)
    two = RobotWorld(robot, robot, damping, Drive()).run(motion)
    n = min(len(one.time), len(two.time))
    # Both by Runge and Kutta, 0.1 and 0.5 ms: fourth order in 0.5 ms at 10 rad/s.
    np.testing.assert_allclose(one.q[:n], two.q[:n], atol=1e-8)
    np.testing.assert_allclose(one.motor[:n], two.motor[:n], atol=1e-5)


def test_the_ode_keeps_its_energy_and_swings_as_a_pendulum():
    robot, _ = robot_and_motion("planar")
    world = TwoLinkWorld(robot, robot, [])
    q, v = np.array([0.8, -0.5]), np.array([1.0, 3.0])
    before = world.energy(q, v)
    after = world.energy(*world.coast(q, v, 2.0))
    assert after == pytest.approx(before, abs=1e-7)
    # Small swings with the elbow's rotor locking it: one body about the shoulder.
    stiff = robot.with_body("planar.lower", rotor=1e9)
    stiff = stiff.with_body("planar.upper", rotor=0.0)
    upper, lower = robot.bodies
    l1 = -lower.xyz[2]
    c1, c2 = -upper.com[2], l1 - lower.com[2]
    inertia = upper.inertia[1] + upper.mass * c1**2
    inertia += lower.inertia[1] + lower.mass * c2**2
    weight = 9.81 * (upper.mass * c1 + lower.mass * c2)
    period = 2 * np.pi * np.sqrt(inertia / weight)
    q, v = TwoLinkWorld(stiff, stiff, []).coast(
        np.array([1e-3, 0.0]), np.zeros(2), period
    )
    # A whole swing, to the square of 1e-3 and the lock's 1e-9.
    np.testing.assert_allclose([q[0], v[0]], [1e-3, 0.0], atol=1e-6)


def mean_of_steps(track):
    """The motors' effort before and after each instant: what the central difference of
    velocity answers to."""
    return 0.5 * (track.motor + np.vstack([track.motor[:1], track.motor[:-1]]))


LAWS = [
    ("joint_viscous_damping", "joint", {"damping": 0.3}),
    ("joint_coulomb_friction", "joint", {"coulomb": 0.4}),
    ("joint_direction_friction", "joint", {"coulomb_plus": 0.5, "coulomb_minus": 0.2}),
    ("joint_load_friction", "joint", {"share": 0.2}),
    ("joint_stribeck_friction", "joint",
     {"coulomb": 0.3, "static": 0.5, "stribeck_velocity": 0.1}),
    ("joint_quadratic_drag", "joint", {"coefficient": 1.0}),
    ("torque_ripple", "joint",
     {"amplitude": 0.3, "periods_per_rev": 8.0, "phase": 1.0}),
    ("joint_spring", "joint", {"stiffness": 1.0, "rest": 0.2}),
    ("rotor_inertia", "joint", {"inertia": 0.1}),
    ("payload", "body", {"mass": 0.7, "com_x": 0.02, "com_y": -0.03, "com_z": 0.05}),
    ("link_mass", "body", {"mass": -0.3}),
    ("link_com", "body", {"x": 0.02, "y": 0.01, "z": -0.02}),
    ("body_drag", "body", {"linear": 3.0, "angular": 0.1}),
    ("constant_force", "body", {"fx": 3.0, "fy": -2.0, "fz": 4.0}),
    ("sinusoidal_force", "body",
     {"fx": 3.0, "fy": -2.0, "fz": 4.0, "frequency": 1.5, "phase": 0.4}),
    ("gravity_tilt", "model", {"roll": 0.03, "pitch": -0.04}),
]  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "where", "parameters"), LAWS, ids=[x[0] for x in LAWS]
)
def test_the_motors_give_what_an_effect_asks(kind, where, parameters):
    """Forward simulation against inverse dynamics: two ways to the same effort."""
    robot, motion = robot_and_motion("scara", seconds=1.5)
    at = {"joint": robot.joints[1], "body": "scara.fore", "model": "scara"}[where]
    hidden = effect(kind, at, **parameters)
    track = RobotWorld(robot, robot, [hidden], Drive()).run(motion)
    given = mean_of_steps(track) - Inverse(robot)(track.q, track.v, track.a)
    asked = added_effort(robot, hidden, track)
    # Where friction turns round it is anything between; the acceleration is a
    # difference over 1 ms, of commands that change each 1 ms.
    moving = (np.abs(track.v) > 0.02).all(axis=1)
    moving[:3] = moving[-3:] = False
    size = np.abs(asked).max()
    assert size > 0.02
    error = np.abs(given - asked)[moving]
    assert np.median(error) < 0.01 * size and np.quantile(error, 0.98) < 0.05 * size


def test_gain_bias_and_ceiling_of_a_drive():
    robot, motion = robot_and_motion("planar")
    j = robot.joints[0]
    hidden = [
        effect("actuator_gain", j, gain=1.2),
        effect("actuator_bias", j, bias=0.3),
        effect("actuator_saturation", j, limit=2.0),
    ]
    track = RobotWorld(robot, robot, hidden, Drive()).run(motion)
    sent = track.commands["effort_command"]
    np.testing.assert_allclose(
        track.motor[:, 0], np.clip(1.2 * sent[:, 0] + 0.3, -2.0, 2.0), atol=1e-12
    )
    np.testing.assert_array_equal(track.motor[:, 1], sent[:, 1])


def test_a_hidden_gain_is_between_what_is_logged_and_what_acts(tmp_path):
    """Inverse dynamics of the true robot over the logged efforts, joint by joint."""
    made = make(LogCase("gain", 91, Recipe("gain", "six", "multisine", hide="gain")))
    (hidden,) = made.truth["effects"]
    columns, track = made.columns, made.track
    efforts = [n for n in columns if "effort" in n or n.startswith("tau")]
    logged = np.stack([columns[n] for n in efforts], axis=1)
    rows = np.linspace(0, len(track.time) - 1, len(logged) + 2).round()[1:-1]
    given = track.motor[rows.astype(int)]
    ratio = np.sum(given**2, axis=0) / np.sum(given * logged, axis=0)
    joint = int(hidden["at"][-1]) - 1
    expected = np.ones(6)
    expected[joint] = hidden["parameters"]["gain"]
    # Noise, of up to a third of small efforts, in a thousand rows and more.
    np.testing.assert_allclose(ratio, expected, atol=0.03)


def test_a_servo_is_a_spring_with_a_brake_and_a_ceiling():
    robot, motion = robot_and_motion("servo")
    n = 5
    drive = Drive("servo", 0.02, np.full(n, 9.0), np.zeros(n), 0.3, 12.0, 1.2, 4.0,
                  0.004, 0.002)  # fmt: skip
    track = RobotWorld(robot, robot, [], drive).run(motion)
    sent = 0.002 * np.round(track.commands["position_command"] / 0.002)
    error = sent - track.q
    error = np.sign(error) * np.maximum(np.abs(error) - 0.004, 0.0)
    effort = np.clip(9.0 * error, -0.3, 0.3) - 1.2**2 / 4.0 * track.v
    np.testing.assert_allclose(track.motor, effort, atol=1e-12)
    weak = replace(drive, voltage=0.5)  # Its stall torque, 0.15 N m, is the ceiling.
    track = RobotWorld(robot, robot, [], weak).run(motion)
    assert np.abs(track.motor + 0.36 * track.v).max() == pytest.approx(0.15)


def test_what_comes_out_of_a_gear_lacks_the_rotor():
    robot, motion = robot_and_motion("scara")
    track = RobotWorld(robot, robot, [], Drive()).run(motion)
    rotors = np.array([body.rotor for body in robot.moving])
    left = track.motor - rotors * track.a - track.link
    assert np.quantile(np.abs(left), 0.98) < 2e-3 * np.abs(track.motor).max()


def test_a_gap_is_crossed_and_bounced_in():
    robot, motion = robot_and_motion("scara", seconds=4.0)
    gap = effect("joint_backlash", robot.joints[1], gap=0.04)
    track = RobotWorld(robot, robot, [gap], Drive()).run(motion)
    twist = (track.link_q - track.q)[:, 1]
    assert np.abs(track.link_q - track.q)[:, 0].max() == 0.0
    # It lies on both sides, and goes beyond them by little.
    assert twist.min() == pytest.approx(-0.02, abs=2e-3)
    assert twist.max() == pytest.approx(0.02, abs=2e-3)
    assert (np.abs(twist) < 0.015).any()


def test_a_push_acts_for_its_time_alone():
    robot, motion = robot_and_motion("scara")
    push = Push("scara.fore", 0.8, 0.5, (5.0, 3.0, 0.0))
    track = RobotWorld(robot, robot, [], Drive(), push).run(motion)
    given = mean_of_steps(track) - Inverse(robot)(track.q, track.v, track.a)
    during = (track.time > 0.85) & (track.time < 1.25)
    before = track.time < 0.79
    assert np.abs(given[during]).max() > 0.5 > 100 * np.abs(given[before][3:]).max()
    jac, _, _ = jacobians(robot, "scara.fore", track.q)
    s = np.clip((track.time - 0.8) / 0.5, 0.0, 1.0)
    force = np.sqrt(np.sin(np.pi * s))[:, None] * np.array(push.force)
    asked = -np.einsum("kij,ki->kj", jac, force)
    np.testing.assert_allclose(given[during], asked[during], atol=0.05)


@pytest.mark.parametrize("name", MOTIONS)
def test_motions_are_smooth_enough_to_be_their_own_derivatives(name):
    _, motion = robot_and_motion("panda", name, 8.0)
    np.testing.assert_allclose(
        np.gradient(motion.q, 0.001, axis=0)[2:-2], motion.v[2:-2], atol=2e-3
    )
    robot, _ = robot_and_motion("panda")
    assert (np.abs(motion.v).max(axis=0) > 0.02).all()
    assert (np.abs(motion.v) < 2.5 * robot.fastest).all()


# ----- The log


def still_track(n=4000, joints=2):
    t = 0.001 * np.arange(n)
    q = np.column_stack([np.sin(3.0 * t), np.cos(2.0 * t)])[:, :joints]
    v = np.column_stack([3.0 * np.cos(3.0 * t), -2.0 * np.sin(2.0 * t)])[:, :joints]
    zero = np.zeros_like(q)
    return Track(t, q, v, zero, q, 10.0 * q, zero, {"effort_command": 2.0 * q})


CLEAN = Logging(1000.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def log_of(how, track=None, seed=0, names=("a.x", "a.y")):
    rng, zero = np.random.default_rng(seed), np.zeros(len(names))
    return write_log(track or still_track(), list(names), how, zero, rng)[0]


def test_a_clean_log_is_the_track():
    log = log_of(replace(CLEAN, rate_hz=100.0, with_command=True))
    t = log["time"]
    np.testing.assert_allclose(np.diff(t), 0.01, atol=1e-12)
    np.testing.assert_allclose(log["a.x.position"], np.sin(3 * t), atol=1e-12)
    np.testing.assert_allclose(log["a.y.velocity"], -2 * np.sin(2 * t), atol=1e-12)
    np.testing.assert_allclose(
        log["a.x.effort_measured"], 10 * np.sin(3 * t), atol=1e-12
    )
    np.testing.assert_allclose(log["a.x.effort_command"], 2 * np.sin(3 * t), atol=1e-12)


@pytest.mark.parametrize("side", ["motor", "link"])
@pytest.mark.parametrize("name", ["planar", "scara"])
def test_a_log_hides_nothing_that_its_truth_does_not_name(name, side):
    """Without noise and effects, what is left of the logged effort follows nothing that
    an effect would make: no delay, friction, inertia or bias."""
    robot, motion = robot_and_motion(name, seconds=6.0)
    track = RobotWorld(robot, robot, [], Drive()).run(motion)
    log = log_of(replace(CLEAN, rate_hz=500.0, side=side), track, names=robot.joints)
    known = robot
    if side == "link":
        known = replace(
            robot, bodies=tuple(replace(b, rotor=0.0) for b in robot.bodies)
        )
    rows = slice(200, -200)  # The start's swing dies away.

    def of(quantity):
        return np.column_stack([log[f"{j}.{quantity}"] for j in robot.joints])

    q, v, u = of("position"), of("velocity"), of("effort_measured")
    a = np.gradient(v, 0.002, axis=0)
    left = (u - Inverse(known)(q, v, a))[rows]
    rate = np.gradient(u, 0.002, axis=0)
    for i in range(len(robot.joints)):
        columns = np.column_stack(
            [
                rate[rows, i],
                v[rows, i],
                np.sign(v[rows, i]),
                a[rows, i],
                left[:, i] * 0 + 1,
            ]
        )
        found = np.linalg.lstsq(columns, left[:, i], rcond=None)[0]
        size = np.abs(columns * found).max(axis=0)
        assert abs(found[0]) < 2e-5, "a delay [s]"
        assert size.max() < 1e-3 * np.abs(u[:, i]).max(), (i, found)


def test_rows_are_held_stamps_jitter_and_encoders_are_coarse():
    log = log_of(replace(CLEAN, held=0.06, jitter=2e-4))
    same = np.diff(log["a.x.position"]) == 0.0
    assert same.mean() == pytest.approx(0.06, abs=0.015)
    assert (np.diff(log["a.y.velocity"])[same] == 0.0).all()
    assert (np.diff(log["time"]) > 0.0).all()
    scatter = log["time"] - np.round(log["time"], 3)
    assert scatter.std() == pytest.approx(2e-4, rel=0.1)
    steps = log_of(replace(CLEAN, quantum=0.0015))["a.x.position"] / 0.0015
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


def test_clocks_that_differ_and_late_states():
    t = log_of(CLEAN)["time"]
    late = log_of(replace(CLEAN, delay=0.02, with_command=True))
    np.testing.assert_allclose(
        late["a.x.position"][50:], np.sin(3 * (t - 0.02))[50:], atol=1e-9
    )
    np.testing.assert_allclose(late["a.x.effort_command"], 2 * np.sin(3 * t), atol=1e-9)
    fast = log_of(replace(CLEAN, skew=0.01))
    np.testing.assert_allclose(fast["a.x.position"], np.sin(3 * t / 1.01), atol=1e-9)


def test_noise_that_wanders_has_its_size_and_its_memory():
    x = wandering(400_000, 0.001, 0.2, (1,), np.random.default_rng(0))[:, 0]
    # 400 s are 1000 independent stretches of two memories: 5 %.
    assert x.std() == pytest.approx(1.0, abs=0.06)
    assert np.corrcoef(x[:-200], x[200:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.06)


@pytest.mark.parametrize(
    ("which", "gain"),
    [
        (Filter("first order", 20.0), lambda s: 1 / (1 + s / (2 * np.pi * 20.0))),
        (Filter("Butterworth", 15.0, 2),
         lambda s: 1 / (1 + np.sqrt(2) * s / (30 * np.pi) + (s / (30 * np.pi)) ** 2)),
        (Filter("moving average", 0.03),
         lambda s: (1 - np.exp(-0.03 * s)) / (0.03 * s)),
    ],
    ids=lambda x: x.kind if isinstance(x, Filter) else "",
)  # fmt: skip
@pytest.mark.parametrize("hz", [0.5, 3.0, 10.0])
def test_filters_have_the_gain_and_phase_of_their_kind(which, gain, hz):
    t = 0.001 * np.arange(8000)
    s = 2j * np.pi * hz
    y = which(np.exp(s * t).real[:, None])[4000:, 0]
    basis = np.column_stack([np.exp(s * t).real, np.exp(s * t).imag])[4000:]
    a, b = np.linalg.lstsq(basis, y, rcond=None)[0]
    # Digital filters of 1 kHz bend by (w T)^2/12: 3e-4 at 10 Hz.
    assert complex(a, -b) == pytest.approx(gain(s), abs=2e-3)
    slow = 2j * np.pi * 0.01
    assert which.delay() == pytest.approx(-np.angle(gain(slow)) / 0.0628319, rel=1e-3)


def test_a_backward_difference_is_the_mean_velocity_of_the_last_row():
    log = log_of(replace(CLEAN, rate_hz=50.0, filter=Filter("backward difference")))
    q, t = log["a.x.position"], log["time"]
    np.testing.assert_allclose(
        log["a.x.velocity"][1:], np.diff(q) / np.diff(t), rtol=1e-9
    )


@pytest.mark.parametrize(
    "which", [Filter(), Filter("first order", 20.0), Filter("backward difference")],
    ids=lambda f: f.kind,
)  # fmt: skip
def test_the_noise_that_a_sidecar_gives_is_what_is_in_the_channel(which):
    zero = np.zeros((20_000, 2))
    rest = replace_track(still_track(20_000), q=zero, v=zero, motor=zero)
    how = replace(CLEAN, rate_hz=500.0, position_noise=1e-4, velocity_noise=2e-2,
                  filter=which, effort_noise=0.1, wander=0.2, memory=0.01)  # fmt: skip
    rng = np.random.default_rng(0)
    log, noise = write_log(rest, ["a.x", "a.y"], how, np.zeros(2), rng)
    for name, std in noise.items():
        assert np.std(log[name]) == pytest.approx(std, rel=0.08), name


# ----- Ties, by computation


def compared(name, hidden, places, seconds=6.0, hand=False, others=()):
    robot, motion = robot_and_motion(name, seconds=seconds, hand=hand)
    n = len(motion.time)
    a = motion
    track = Track(a.time, a.q, a.v, a.a, a.q, np.ones((n, 1)) * a.q, a.q, {})
    judge = Comparison(robot, track, Logging(), LINK_MASS, LINK_COM)
    effort = added_effort(robot, hidden, judge.track)
    return judge, effort, judge.rivals(effort, places(robot), others)


def test_an_effect_is_at_no_distance_from_itself():
    for hidden in (
        effect("body_drag", "scara.fore", linear=3.0, angular=0.1),
        effect("payload", "scara.flange", mass=0.5, com_x=0.1, com_y=0.02, com_z=0.0),
        effect("joint_spring", "scara.elbow", stiffness=2.0, rest=0.3),
    ):
        at = [(hidden["kind"], hidden["at"])]
        judge, effort, [rival] = compared("scara", hidden, lambda r, at=at: at)
        assert rival.distance < 1e-3
        loose = judge.loose(hidden)
        # Nothing turns about another axis than the vertical.
        assert loose == (["com_z"] if hidden["kind"] == "payload" else [])
        for name, value in hidden["parameters"].items():
            if name in loose:
                continue
            assert rival.parameters[name] == pytest.approx(value, rel=0.01, abs=3e-3)
        assert judge.size(effort) > CLEAR


def test_a_force_on_bodies_with_their_origins_on_one_axis_has_one_place():
    hidden = effect("constant_force", "scara.flange", fx=2.0, fy=1.0, fz=3.0)

    def bodies(robot):
        return [("constant_force", f"scara.{b.name}") for b in robot.bodies]

    _, _, rivals = compared("scara", hidden, bodies, hand=True)
    near = {r.at for r in rivals if r.distance < SAME}
    # The wrist turns about the axis that all three origins lie on.
    assert near == {"scara.quill", "scara.flange", "scara.hand"}
    assert "scara.fore" not in {r.at for r in rivals}


def test_a_weight_is_no_force_where_it_is_thrown_about():
    hidden = effect(
        "payload", "planar.lower", mass=0.3, com_x=0.0, com_y=0.0, com_z=-0.2
    )
    force = [("constant_force", "planar.lower")]
    _, _, rivals = compared("planar", hidden, lambda r: force)
    assert rivals == []
    # Where nothing accelerates they are one: at rest only its weight shows.
    robot, motion = robot_and_motion("scara", seconds=6.0)
    still = replace(motion, v=0.05 + 0 * motion.v, a=0 * motion.a)
    a = still
    track = Track(a.time, a.q, a.v, a.a, a.q, a.q, a.q, {})
    judge = Comparison(robot, track, Logging(), LINK_MASS, LINK_COM)
    hidden = effect("payload", "scara.quill", mass=0.1, com_x=0.0, com_y=0.0, com_z=0.0)
    effort = added_effort(robot, hidden, judge.track)
    [rival] = judge.rivals(effort, [("constant_force", "scara.quill")])
    assert rival.distance < SAME
    assert rival.parameters["fz"] == pytest.approx(-0.981, rel=0.05)


def test_a_link_within_its_tolerance_is_nothing_to_be_seen():
    robot, _ = robot_and_motion("scara")
    mass = robot.bodies[1].mass
    for factor, seen in ((1.0, False), (10.0, True)):
        hidden = effect("link_mass", "scara.fore", mass=factor * LINK_MASS * mass)
        judge, effort, _ = compared("scara", hidden, lambda r: [])
        # At most what the prior asks for it: the square of its standard deviations.
        assert judge.size(effort) <= factor**2 * (1 + 1e-6)
        assert (judge.size(effort) > CLEAR) is seen


def test_more_noise_brings_effects_together_and_more_data_part_them():
    hidden = effect("joint_viscous_damping", "scara.elbow", damping=0.5)
    robot, motion = robot_and_motion("scara", seconds=8.0)
    a = motion
    track = Track(a.time, a.q, a.v, a.a, a.q, a.q, a.q, {})
    sizes = []
    for how, rows in ((Logging(), slice(None)), (Logging(), slice(4000)),
                      (Logging(effort_noise=0.3), slice(None)),
                      (Logging(wander=0.1, memory=0.3), slice(None))):  # fmt: skip
        part = Track(*(x[rows] for x in (track.time, a.q, a.v, a.a, a.q, a.q, a.q)), {})
        judge = Comparison(robot, part, how, LINK_MASS, LINK_COM)
        sizes.append(judge.size(added_effort(robot, hidden, judge.track)))
    assert sizes[0] > sizes[1] > sizes[2] and sizes[0] > sizes[3]


def test_a_lag_and_a_delay_part_where_the_motion_is_fast():
    how = Logging(velocity_noise=3e-3)
    lag = Filter("first order", 15.0)
    slow, fast = still_track(), still_track()
    w = 40.0
    fast = replace_track(fast, v=np.column_stack([np.sin(w * fast.time)] * 2))
    slow = replace_track(slow, v=0.2 * slow.v)
    for track, apart in ((slow, False), (fast, True)):
        first, second = velocity_rivals(lag, 0.0, track, how)
        assert first.distance < SAME and first.kind == "sensor_lag"
        assert first.parameters["time_constant"] == pytest.approx(lag.delay(), rel=0.05)
        assert (second.distance > CLEAR) is apart


def replace_track(track, **changes):
    parts = vars(track) | changes
    return Track(**parts)


# ----- The cases


def test_there_are_enough_logs_of_enough_kinds_and_their_seeds_are_apart():
    development, final = cases("logs-development"), cases("logs-final")
    assert len(development) == len(final) == len(RECIPES) >= 40
    assert len({c.folder for c in development + final}) == 2 * len(RECIPES)
    # Draws that show nothing are repeated with seeds a million apart.
    seeds = [c.seed + 1_000_000 * k for c in development + final for k in range(30)]
    assert len(set(seeds)) == len(seeds)
    assert abs(SEEDS["logs-development"] - SEEDS["logs-final"]) > 7 * len(RECIPES)
    calm = [c for c in final if not c.recipe.hide and "undeclared" not in
            c.recipe.options and "too fast" not in c.recipe.options]  # fmt: skip
    assert len(calm) >= 10
    robots = {name for c in final for name in c.recipe.robots.split()}
    assert robots == set(ROBOTS)


SHORT = [
    LogCase("a", 11, Recipe("held", "scara", "pick", "friction", ("held",))),
    LogCase("b", 12, Recipe("filter", "planar", options=("first order", "undeclared"))),
    LogCase("c", 13, Recipe("servo", "servo", "pick", "servo_gain", ("coarse",))),
]  # fmt: skip


# Of options and recipes; a declared filter stands in the sidecar of course.
_TELLING = ("undeclared", "in vain", "too fast", "held", "coarse", "jitter", "hidden")


@pytest.fixture
def short(monkeypatch):
    every = dict.fromkeys(log_cases.SECONDS, 4.0)
    monkeypatch.setattr(log_cases, "SECONDS", every)


@pytest.mark.parametrize("case", SHORT, ids=lambda c: c.recipe.name)
def test_a_log_is_a_function_of_its_seed_and_its_folder_holds_no_truth(
    case, short, tmp_path
):
    made = make(case)
    again = make(case)
    for name, values in made.columns.items():
        np.testing.assert_array_equal(values, again.columns[name])
    assert (made.truth, made.scene, made.sidecar) == (
        again.truth, again.scene, again.sidecar,
    )  # fmt: skip
    truth = write(case, tmp_path / case.folder, made)
    assert json.loads(json.dumps(truth)) == truth
    names = {p.name for p in (tmp_path / case.folder).iterdir()}
    urdf = f"{yaml.safe_load(made.scene)['directives'][0]['add_model']['name']}.urdf"
    assert names == {"scene.yaml", "recording.csv", "recording.yaml", urdf}
    assert truth["effects"]
    for path in (tmp_path / case.folder).iterdir():
        text = path.read_text()
        assert case.recipe.name not in text.replace("servo", "")
        assert not any(word in text for word in _TELLING)
        for each in truth["effects"]:
            assert each["kind"] not in text
            for value in each["parameters"].values():
                assert repr(value)[:8] not in text, (path.name, each)
    recording = read_recording(tmp_path / case.folder / "recording.csv")
    plant = load_scene(tmp_path / case.folder / "scene.yaml", DiagramBuilder()).plant
    check_against_scene(recording, *scene_names(plant))


def test_hidden_links_are_off_by_no_more_than_the_scene_says(short):
    for seed in range(5):
        d, _ = log_cases._draw(LogCase("x", seed, Recipe("x", "panda six")))
        for a, b in zip(d.nominal.bodies, d.true.bodies, strict=True):
            assert abs(b.mass / a.mass - 1.0) <= 2 * LINK_MASS + 1e-12
            assert np.abs(np.subtract(b.com, a.com)).max() <= 2 * LINK_COM + 1e-12
        assert d.nominal.bodies != d.true.bodies


def test_a_hand_that_is_not_there_is_its_mass_less_at_the_hand(short):
    recipe = Recipe("x", "scara", "pick", "hand_missing", ("hand",))
    made = make(LogCase("x", 3, recipe))
    [hidden] = made.truth["effects"]
    assert (hidden["kind"], hidden["at"]) == ("link_mass", "scara.hand")
    assert hidden["parameters"]["mass"] < -0.25 and "hand" in made.urdf
    # The weld's other side is as good: a payload that pulls upwards at the flange.
    rivals = {(r["kind"], r["at"]): r["parameters"] for r in hidden["equivalents"]}
    there = rivals["payload", "scara.flange"]
    assert there["mass"] == pytest.approx(hidden["parameters"]["mass"])
    # Its place in the flange: the hand is turned by an eighth about z, 50 mm below.
    own = rivals["payload", "scara.hand"]
    assert there["com_z"] == pytest.approx(own["com_z"] - 0.05)
    c = np.sqrt(0.5)
    assert there["com_x"] == pytest.approx(c * (own["com_x"] + own["com_y"]))
    assert there["com_y"] == pytest.approx(c * (own["com_y"] - own["com_x"]))


def test_a_point_mass_moves_the_centre_and_adds_its_inertia():
    robot, _ = robot_and_motion("scara")
    body = replace(
        robot.bodies[1], mass=2.0, com=(0.1, 0.0, 0.0), inertia=(1e-2,) * 3 + (0.0,) * 3
    )
    new = with_point(body, 2.0, (0.3, 0.0, 0.0))
    assert new.mass == 4.0 and new.com == pytest.approx((0.2, 0.0, 0.0))
    # Two kilograms 0.1 m on either side, across x.
    assert new.inertia[:3] == pytest.approx((1e-2, 5e-2, 5e-2))
    back = with_point(new, -2.0, (0.3, 0.0, 0.0))
    assert back.com == pytest.approx(body.com)
    assert back.inertia == pytest.approx(body.inertia)

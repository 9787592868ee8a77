"""Columns of effects in the residual, and the residual itself."""

from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import (
    LENGTH,
    MASS,
    G,
    J,
    double,
    on_ground,
    pendulum,
    smooth_motion,
    with_effects,
)
from scipy.integrate import solve_ivp

from makebreak.gap.numerics.weak_form import make_bumps
from makebreak.gap.search.choice import Choice
from makebreak.gap.verdict import named
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, sentence, with_deviation
from makebreak.models.effects.signature import Motion, added_effort
from makebreak.models.scene import ActuationSection
from makebreak.systems.numerics.smoother import smooth

# Effects on the double pendulum whose columns are exact, with parameters to find.
EXACT = {
    "joint_viscous_damping": ("d.j2", dict(damping=0.4)),
    "joint_coulomb_friction": ("d.j1", dict(coulomb=0.7)),
    "joint_direction_friction": ("d.j1", dict(coulomb_plus=0.3, coulomb_minus=0.8)),
    "joint_stribeck_friction": (
        "d.j2",
        dict(coulomb=0.5, static=0.9, stribeck_velocity=0.2),
    ),
    "joint_position_friction": (
        "d.j1",
        dict(coulomb_low=0.3, coulomb_high=0.8, low=-0.3, high=0.4),
    ),
    "joint_quadratic_drag": ("d", dict(coefficient=0.2)),
    "rotor_inertia": ("d.j1", dict(inertia=0.15)),
    "torque_ripple": ("d.j1", dict(amplitude=0.6, periods_per_rev=5.0, phase=-0.8)),
    "joint_spring": ("d.j2", dict(stiffness=2.5, rest=-0.3)),
    # Across the axis of the first joint no force at the second one's origin shows.
    "constant_force": ("d.lower", dict(fx=2.0, fy=0.0, fz=0.5)),
    "sinusoidal_force": (
        "d.lower",
        dict(fx=2.0, fy=0.0, fz=0.5, frequency=1.5, phase=0.4),
    ),
    "body_drag": ("d.lower", dict(linear=0.8, angular=0.05)),
    "body_quadratic_drag": ("d.lower", dict(coefficient=0.6)),
    "object_mass": ("d.lower", dict(mass=1.1)),
    "object_inertia": ("d.lower", dict(ixx=0.03, iyy=0.035, izz=0.02)),
    "link_mass": ("d.lower", dict(mass=-0.3)),
}
GRID = {
    "stribeck_velocity": [0.1, 0.2],
    "periods_per_rev": [4, 5],
    "frequency": [1.0, 1.5],
    "low": [-0.3],
    "high": [0.4],
}
# Linearised: small, and the error goes with the square.
SMALL = {
    "payload": ("d.lower", dict(mass=0.2, com_x=0.05, com_y=-0.04, com_z=-0.1)),
    "gravity_tilt": ("d", dict(roll=0.02, pitch=-0.015)),
    "object_com": ("d.lower", dict(x=0.004, y=0.036, z=-0.205)),
    "link_com": ("d.lower", dict(x=0.004, y=-0.006, z=0.005)),
}


def motion_of(dynamics, n=81):
    n_v = dynamics.plant.num_velocities()
    time, q, v, vd = smooth_motion(n_v, n)
    return Motion(time, q, v, vd, dynamics.inverse_dynamics(q, v, vd, time))


def explained(signature, residual, coefficients=None):
    """Least-squares coefficients, and what they leave of the residual, relative."""
    A = signature.columns.reshape(-1, signature.columns.shape[2])
    b = residual.ravel()
    if coefficients is None:
        coefficients = np.linalg.lstsq(A, b, rcond=None)[0]
    left = np.linalg.norm(b - A @ coefficients) / np.linalg.norm(b)
    return coefficients, left


@pytest.mark.parametrize("kind", [k for k in EXACT | SMALL if "object" not in k])
def test_what_an_effect_adds_is_what_a_model_with_it_needs_more(tmp_path, kind):
    at, parameters = (EXACT | SMALL)[kind]
    scene = double(tmp_path)
    without = SceneDynamics(scene)
    motion = motion_of(without)
    true = SceneDynamics(with_effects(scene, (kind, at, parameters)))
    more = -true.residual(motion)
    added = added_effort(Effect(kind, [at], parameters), KINDS[kind], without, motion)
    np.testing.assert_allclose(added, more, atol=1e-9 * np.abs(more).max())


def test_a_load_of_some_size_adds_what_a_model_with_it_needs_more(tmp_path):
    scene, (at, parameters) = double(tmp_path), SMALL["payload"]
    wide = parameters | {"gyration_radius": 0.09}
    without = SceneDynamics(scene)
    motion = motion_of(without)
    more = -SceneDynamics(with_effects(scene, ("payload", at, wide))).residual(motion)
    added = added_effort(
        Effect("payload", [at], wide), KINDS["payload"], without, motion
    )
    np.testing.assert_allclose(added, more, atol=1e-9 * np.abs(more).max())


def test_what_is_missing_is_what_a_model_with_it_needs_more(tmp_path):
    # 0.2 kg less at the lower link's own centre of mass.
    scene, kind = double(tmp_path), "payload"
    parameters = dict(mass=-0.2, com_x=0.0, com_y=0.03, com_z=-0.2)
    without = SceneDynamics(scene)
    motion = motion_of(without)
    more = -SceneDynamics(with_effects(scene, (kind, "d.lower", parameters))).residual(
        motion
    )
    effect = Effect(kind, ["d.lower"], parameters)
    added = added_effort(effect, KINDS[kind], without, motion)
    np.testing.assert_allclose(added, more, atol=1e-9 * np.abs(more).max())
    assert without.least(kind, ["d.lower"]) == {"mass": -0.8}
    much = Effect(kind, ["d.lower"], {**parameters, "mass": -0.9})
    with pytest.raises(ValueError, match="no body is left"):
        added_effort(much, KINDS[kind], without, motion)


def test_inverse_dynamics_of_the_pendulum_is_the_closed_form(tmp_path):
    dynamics = SceneDynamics(
        with_effects(
            pendulum(tmp_path), ("joint_spring", "p.j1", dict(stiffness=2, rest=1))
        )
    )
    time, q, v, vd = smooth_motion(1)
    expected = J * vd + MASS * G * LENGTH * np.sin(q) + 2.0 * (q - 1.0)
    np.testing.assert_allclose(dynamics.inverse_dynamics(q, v, vd), expected, atol=1e-9)


def test_inverse_dynamics_is_the_rate_of_momentum_and_the_rest(tmp_path):
    dynamics = SceneDynamics(double(tmp_path))
    time, q, v, vd = smooth_motion(2, 4001)
    rate = np.gradient(dynamics.momentum(q, v), time, axis=0)[1:-1]
    rest = dynamics.rest(q, v)[1:-1]
    effort = dynamics.inverse_dynamics(q, v, vd)[1:-1]
    # Differences over 0.25 ms of motion at up to 9 rad/s: (9 x 2.5e-4)^2/6 = 1e-6
    # of the greatest effort of 30 N m.
    np.testing.assert_allclose(rate + rest, effort, atol=1e-4)


@pytest.mark.parametrize("kind", EXACT)
def test_columns_explain_the_effect_and_give_its_parameters(tmp_path, kind):
    at, parameters = EXACT[kind]
    scene = double(tmp_path)
    truth = SceneDynamics(with_effects(scene, (kind, at, parameters)))
    model, motion = SceneDynamics(scene), motion_of(truth)
    residual = model.residual(motion)
    grid = {k: v for k, v in GRID.items() if k in parameters}
    found = model.signatures(kind, [at], motion, grid or None)
    fits = [explained(signature, residual) for signature in found]
    best = int(np.argmin([left for _, left in fits]))
    coefficients, left = fits[best]
    assert left < 1e-7  # Finite differences and rounding.
    assert found[best].exact
    for name, value in found[best].to_parameters(coefficients).items():
        np.testing.assert_allclose(
            value, parameters[name], rtol=1e-5, atol=1e-9, err_msg=name
        )


def test_columns_of_a_payload_are_exact_with_its_moments_of_inertia(tmp_path):
    at, parameters = SMALL["payload"]
    scene = double(tmp_path)
    truth = SceneDynamics(with_effects(scene, ("payload", at, parameters)))
    motion = motion_of(truth)
    model = SceneDynamics(scene)
    (signature,) = model.signatures("payload", [at], motion)
    m, com = parameters["mass"], np.array([parameters[f"com_{a}"] for a in "xyz"])
    x, y, z = com
    moments = [y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z]
    coefficients = m * np.array([1.0, x, y, z, *moments])
    assert explained(signature, model.residual(motion), coefficients)[1] < 1e-9
    found = signature.to_parameters(coefficients)
    assert found == pytest.approx(parameters, rel=1e-9)


def test_moments_tell_the_mass_of_a_load_on_a_link_about_a_fixed_axis(
    tmp_path,
):
    """Its weight acts on no joint but by mass times place; the moment of inertia about
    the axis, m (x^2 + z^2), tells the mass. Where along the axis it is not shown."""
    scene = pendulum(tmp_path)
    parameters = dict(mass=0.3, com_x=0.1, com_y=0.0, com_z=-0.25)
    truth = SceneDynamics(with_effects(scene, ("payload", "p.rod", parameters)))
    motion, model = motion_of(truth), SceneDynamics(scene)
    (signature,) = model.signatures("payload", ["p.rod"], motion)
    A = signature.columns.reshape(-1, 10)
    assert np.abs(A[:, 0]).max() < 1e-9
    coefficients = np.linalg.lstsq(A, model.residual(motion).ravel(), rcond=1e-9)[0]
    found = signature.to_parameters(coefficients)
    assert found == pytest.approx(parameters, rel=1e-5, abs=1e-9)
    # A load that is missing has less of all of them.
    assert signature.to_parameters(-coefficients)["mass"] == pytest.approx(-0.3)
    # Without moments of inertia nothing tells its mass.
    assert signature.to_parameters(np.array([0.0, 0.1, 0, 0]))["mass"] == 0.0


@pytest.mark.parametrize("kind", [k for k in SMALL if k != "payload"])
def test_linearised_columns_are_right_to_first_order(tmp_path, kind):
    at, parameters = SMALL[kind]
    scene = double(tmp_path)
    model = SceneDynamics(scene)
    now = model.now(kind, [at])
    left = []
    for share in (1.0, 0.5):
        # Half the effect: half way from what it is now.
        part = {
            name: now[name] + share * (value - now[name])
            for name, value in parameters.items()
        }
        truth = SceneDynamics(with_effects(scene, (kind, at, part)))
        motion = motion_of(truth)
        residual = model.residual(motion)
        (signature,) = model.signatures(kind, [at], motion)
        coefficients = np.array([part[name] - now.get(name, 0) for name in part])
        left.append(explained(signature, residual, coefficients)[1])
        for name, value in signature.to_parameters(coefficients).items():
            np.testing.assert_allclose(value, part[name], atol=1e-12, err_msg=name)
    assert left[0] < 0.05
    np.testing.assert_allclose(left[1] / left[0], 0.5, atol=0.1)


@pytest.mark.parametrize("kind", [*EXACT, *SMALL, "joint_offset"])
def test_columns_are_the_rate_of_their_momentum_and_the_rest(tmp_path, kind):
    at = {**EXACT, **SMALL}.get(kind, ("d.j2", {}))[0]
    model = SceneDynamics(double(tmp_path))
    time, q, v, vd = smooth_motion(2, 1001, duration=0.25)
    motion = Motion(time, q, v, vd, model.inverse_dynamics(q, v, vd))
    grid = {"stribeck_velocity": [0.2], "periods_per_rev": [5], "frequency": [1.5]}
    (signature,) = model.signatures(kind, [at], motion, grid)
    rate = np.gradient(signature.momentum, time, axis=0)[1:-1]
    whole = signature.columns[1:-1]
    scale = abs(whole).max(axis=(0, 1)) + 1e-12
    # As above: 1e-6 of the greatest; differences of differences in joint_offset.
    np.testing.assert_allclose(
        (rate + signature.rest[1:-1]) / scale, whole / scale, atol=1e-4
    )


@pytest.mark.parametrize(
    "kind, at, parameters, applied",
    [
        ("actuator_gain", "d.j1", dict(gain=0.9), lambda t, u: 0.9 * u),
        ("actuator_bias", "d.j2", dict(bias=-1.5), lambda t, u: u - 1.5),
        ("actuator_saturation", "d.j1", dict(limit=8.0), lambda t, u: u.clip(-8, 8)),
    ],
)
def test_actuator_columns_explain_what_the_command_does_not(
    tmp_path, kind, at, parameters, applied
):
    model = SceneDynamics(double(tmp_path))
    motion = motion_of(model)
    j = int(at[-1]) - 1
    # The motion is that of the applied effort; told is the command.
    command = np.array(motion.effort)
    if kind == "actuator_gain":
        command[:, j] = motion.effort[:, j] / 0.9
    elif kind == "actuator_bias":
        command[:, j] = motion.effort[:, j] + 1.5
    else:
        # The pendulum is moved by what the limit leaves: an effort made for the test.
        command[:, j] *= 1.4
        effort = np.array(command)
        effort[:, j] = applied(motion.time, command[:, j])
        residual = command - effort
        told = replace(motion, effort=command)
        found = model.signatures(kind, [at], told, {"limit": [6.0, 8.0]})
        left = [explained(s, residual)[1] for s in found]
        assert np.argmin(left) == 1 and left[1] < 1e-12
        assert found[1].to_parameters(np.ones(1)) == parameters
        return
    told = replace(motion, effort=command)
    (signature,) = model.signatures(kind, [at], told)
    coefficients, left = explained(signature, model.residual(told))
    assert left < 1e-9
    found = signature.to_parameters(coefficients)
    np.testing.assert_allclose(list(found.values()), list(parameters.values()))


@pytest.mark.parametrize(
    "kind, name", [("input_delay", "delay"), ("actuator_lag", "time_constant")]
)
def test_delay_and_lag_columns_find_a_small_delay(tmp_path, kind, name):
    # u = sin(5 t) late by d, or lagging with T: the sine's own closed form.
    model = SceneDynamics(double(tmp_path))
    t = np.linspace(0.0, 4.0, 4001)
    u, d = np.sin(5.0 * t), 0.004
    if kind == "input_delay":
        applied = np.sin(5.0 * (t - d))
    else:
        applied = (np.sin(5 * t) - 5 * d * np.cos(5 * t)) / (1 + (5 * d) ** 2)
    both = np.stack([u, 0 * u], axis=1)
    zero = np.zeros_like(both)
    motion = Motion(t, zero, zero, zero, both)
    (signature,) = model.signatures(kind, ["d.j1"], motion, {name: [0.005]})
    residual = np.stack([u - applied, 0 * u], axis=1)
    since = t > 0.1  # What was before the recording nobody knows.
    part = replace(signature, columns=signature.columns[since])
    coefficients, left = explained(part, residual[since])
    # Linearised: (5 rad/s x 5 ms) is the relative error; samples every ms, held.
    np.testing.assert_allclose(signature.to_parameters(coefficients)[name], d, rtol=0.2)
    assert left < 0.05


@pytest.mark.parametrize(
    "kind, at, parameters",
    [
        ("joint_offset", "d.j2", dict(offset=1e-3)),
        ("sensor_bias", "d.j1.velocity", dict(bias=1e-3)),
        ("sensor_bias", "d.j1.effort_measured", dict(bias=0.3)),
        ("sensor_delay", "d.j2.velocity", dict(delay=1e-4)),
        ("clock_skew", "d.j2.velocity", dict(skew=1e-4)),
        ("sensor_delay", "d", dict(delay=1e-4)),
        ("clock_skew", "d", dict(skew=1e-4)),
    ],
)
def test_measurement_columns_explain_what_the_true_motion_does_not(
    tmp_path, kind, at, parameters
):
    model = SceneDynamics(double(tmp_path))
    motion = motion_of(model, 4001)
    (value,) = parameters.values()
    q, v, vd, effort = (
        np.array(x) for x in (motion.q, motion.v, motion.vd, motion.effort)
    )
    if kind == "joint_offset":
        q[:, 1] += value
    elif at == "d.j1.velocity":
        v[:, 0] += value
    elif at.endswith("effort_measured"):
        effort[:, 0] += value
    else:
        late = value if kind == "sensor_delay" else value * motion.time[:, None]
        jerk = np.gradient(vd, motion.time, axis=0)
        if at == "d":
            effort = effort - late * np.gradient(effort, motion.time, axis=0)
            q, v, vd = q - late * v, v - late * vd, vd - late * jerk
        else:  # Velocity alone, and the acceleration that is got from it.
            one = [0.0, 1.0]
            v, vd = v - late * vd * one, vd - late * jerk * one
    measured = Motion(motion.time, q, v, vd, effort)
    residual = model.residual(measured)
    (signature,) = model.signatures(kind, [at], measured)
    coefficients, left = explained(signature, residual)
    if at == "d":
        # All channels late together: nothing shows, and the columns say so.
        scale = abs(effort).max()
        assert abs(residual).max() < 1e-3 * scale
        assert (
            abs(signature.columns * value - residual[:, :, None]).max() < 1e-3 * scale
        )
        return
    np.testing.assert_allclose(coefficients[0], value, rtol=2e-2)
    assert left < 2e-2


def test_a_free_bodys_rows_are_the_wrench_that_is_unknown(tmp_path):
    # A ball in flight with drag: the residual is the drag, force after torque.
    scene = on_ground(tmp_path, "ball", 0.0)
    model = SceneDynamics(scene)
    n = 5
    q = np.tile([1.0, 0, 0, 0, 0, 0, 1.0], (n, 1))
    v = np.random.default_rng(0).normal(size=(n, 6))
    k = 0.3 / 0.07
    vd = np.hstack([np.zeros((n, 3)), [0, 0, -G] - k * v[:, 3:]])
    motion = Motion(np.arange(n) * 0.1, q, v, vd, np.zeros((n, 6)))
    residual = model.residual(motion)
    np.testing.assert_allclose(residual[:, 3:], 0.3 * v[:, 3:], atol=1e-12)
    (signature,) = model.signatures("body_drag", ["b.ball"], motion)
    np.testing.assert_allclose(signature.columns @ [0.3, 0.0], residual, atol=1e-12)


def test_every_kind_tells_its_columns_or_that_it_has_none(tmp_path):
    scenes = {
        "arm": SceneDynamics(double(tmp_path)),
        "servo": SceneDynamics(
            replace(
                double(tmp_path),
                actuation=ActuationSection(
                    type="servo", joints=["d.j1", "d.j2"], kp=[20.0]
                ),
            )
        ),
        "block": SceneDynamics(on_ground(tmp_path, "cube", 0.0)),
        "ball": SceneDynamics(on_ground(tmp_path, "ball", 0.0)),
    }
    simulated_only = set()
    for name, kind in KINDS.items():
        on = "block" if kind.at in ("pair", "ground", "length", "free body") else "arm"
        on = "servo" if kind.at == "drive" else on
        model = scenes["ball" if name == "rolling_resistance" else on]
        places = model.places(name)
        assert places, name
        n_v = model.plant.num_velocities()
        if n_v == 6:
            q = np.tile([1.0, 0, 0, 0, 0, 0, 1.0], (4, 1))
            zero = np.zeros((4, 6))
            motion = Motion(np.arange(4.0), q, zero, zero, zero)
        else:
            motion = motion_of(model, 11)
        found = model.signatures(name, [places[0]], motion)
        if not found:
            simulated_only.add(name)
        for signature in found:
            k = len(signature.unknowns)
            assert signature.columns.shape == (len(motion.time), n_v, k)
            assert signature.momentum.shape == signature.rest.shape
            parameters = signature.to_parameters(np.full(k, 0.5))
            needed = {p.name for p in kind.parameters if not p.optional}
            assert needed <= set(parameters) <= {p.name for p in kind.parameters}
    assert simulated_only == {
        "contact_friction",
        "friction_patch",
        "rolling_resistance",
        "contact_stiffness",
        "contact_dissipation",
        "contact_damping",
        "plane_height",
        "plane_tilt",
        "wall_position",
        "object_size",
        "corner_radius",
    }


def motor_and_link(force, n=2401, rotor=0.05):
    """Motion of a motor with a drive of its own, which carries the pendulum through
    force(twist, rate); an ODE, sampled at 200 Hz."""

    def torque(t, q, v):
        w, a = np.array([1.9, 4.3]), np.array([0.7, 0.25])
        wanted, rate = a @ np.sin(w * t), (a * w) @ np.cos(w * t)
        return 60.0 * (wanted - q) + 6.0 * (rate - v)

    def rates(t, x):
        tau = force(x[0] - x[1], x[2] - x[3])
        link = (tau - MASS * G * LENGTH * np.sin(x[1])) / J
        return [x[2], x[3], (torque(t, x[0], x[2]) - tau) / rotor, link]

    time = np.arange(n) * 0.005
    x = solve_ivp(
        rates, (0.0, time[-1]), np.zeros(4), "LSODA", time, rtol=1e-8, atol=1e-9
    ).y.T
    q, v, vd = (each[:, None] for each in smooth(time, x[:, 0], 1e-6).x.T)
    u = [torque(t, *each) for t, each in zip(time, x[:, [0, 2]], strict=True)]
    return Motion(time, q, v, vd, np.array(u)[:, None])


def driven_pendulum(tmp_path, rotor=0.05):
    scene = pendulum(tmp_path)
    return SceneDynamics(
        with_effects(scene, ("rotor_inertia", "p.j1", dict(inertia=rotor)))
    )


def test_friction_that_goes_with_the_load_is_a_share_of_what_all_else_needs(tmp_path):
    # By the definition: a motor gives tau + share |tau| where the joint gets tau.
    base = with_effects(
        double(tmp_path), ("joint_coulomb_friction", "d.j2", dict(coulomb=0.3))
    )
    model = SceneDynamics(base)
    motion = motion_of(model)
    tau, direction = motion.effort[:, 1], np.tanh(motion.v[:, 1] / 0.005)
    more = 0.2 * np.abs(tau) * direction
    effort = motion.effort + np.outer(more, [0.0, 1.0])
    measured = replace(motion, effort=effort)
    (signature,) = model.signatures("joint_load_friction", ["d.j2"], measured)
    assert signature.exact
    coefficients, left = explained(signature, model.residual(measured))
    assert coefficients[0] == pytest.approx(0.2, rel=1e-9) and left < 1e-9
    # A joint that carries a payload besides loses a share of what that needs, too.
    heavy = ("payload", "d.lower", dict(mass=0.5, com_x=0.1, com_y=0, com_z=-0.3))
    loaded = SceneDynamics(with_effects(base, *[
        (e.kind, e.at, e.parameters) for e in base.effects], heavy))  # fmt: skip
    needed = -loaded.residual(replace(motion, effort=0.0 * effort))
    effect = Effect("joint_load_friction", ["d.j2"], {"share": 0.2})
    on_top = KINDS[effect.kind].on_top(effect, model, motion, needed)
    np.testing.assert_allclose(
        on_top[:, 1], 0.2 * np.abs(needed[:, 1]) * direction, atol=1e-12
    )
    assert not on_top[:, 0].any()


def test_a_spring_between_motor_and_link_is_found_from_the_motor_alone(tmp_path):
    k = J * (2.0 * np.pi * 5.0) ** 2
    d = 2.0 * 0.05 * np.sqrt(k * J)
    motion = motor_and_link(lambda twist, rate: k * twist + d * rate)
    model = driven_pendulum(tmp_path)
    # As the workflow does: means over 0.2 s.
    w = make_bumps(motion.time, np.full(len(motion.time), 0.005), 0.2, 0.1)
    residual = w.mean(model.residual(motion)[:, 0])
    (signature,) = model.signatures("joint_elasticity", ["p.j1"], motion)
    columns = w.mean(signature.columns[:, 0])
    c = np.linalg.lstsq(columns, residual, rcond=None)[0]
    found = signature.to_parameters(c)
    assert np.linalg.norm(residual - columns @ c) < 0.1 * np.linalg.norm(residual)
    assert found["stiffness"] == pytest.approx(k, rel=0.02)
    assert found["damping"] == pytest.approx(d, rel=0.25)
    effect = Effect("joint_elasticity", ["p.j1"], dict(stiffness=k, damping=d))
    added = w.mean(added_effort(effect, KINDS[effect.kind], model, motion)[:, 0])
    assert np.linalg.norm(residual - added) < 0.1 * np.linalg.norm(residual)


def test_a_gap_between_motor_and_link_is_found_from_the_motor_alone(tmp_path):
    gap, rotor = 0.03, 0.05
    k = rotor * (2.0 * np.pi * 60.0) ** 2

    def force(twist, rate):
        pressed = np.sign(twist) * max(abs(twist) - 0.5 * gap, 0.0)
        tau = k * pressed + 0.5 * np.sqrt(k * rotor) * rate * (pressed != 0.0)
        return tau if tau * pressed > 0.0 else 0.0

    motion = motor_and_link(force)
    model = driven_pendulum(tmp_path)
    residual = model.residual(motion)
    # Over 0.2 s an impact is an impulse.
    w = make_bumps(motion.time, np.full(len(motion.time), 0.005), 0.2, 0.1)
    left = {}
    for signature in model.signatures("joint_backlash", ["p.j1"], motion):
        x, y = w.mean(signature.columns[:, 0, 0]), w.mean(residual[:, 0])
        c = x @ y / (x @ x)
        left[c] = np.linalg.norm(y - c * x) / np.linalg.norm(y)
    best = min(left, key=left.get)
    assert left[best] < 0.4
    assert best == pytest.approx(gap, rel=0.15)


def test_places_are_those_that_fit(tmp_path):
    arm = SceneDynamics(double(tmp_path))
    assert arm.places("rotor_inertia") == ["d.j1", "d.j2"]
    assert arm.places("actuator_gain") == ["d.j1", "d.j2"]
    assert arm.places("payload") == ["d.upper", "d.lower"]
    assert arm.places("gravity_tilt") == ["d", "world"]
    assert arm.places("contact_friction") == []
    ball = SceneDynamics(on_ground(tmp_path, "ball"))
    assert ball.places("contact_friction") == ["b.ball~g.plate"]
    assert ball.places("friction_patch") == ["b.ball~g.plate"]
    assert ball.places("rolling_resistance") == ["b.ball~g.plate"]
    cube = SceneDynamics(on_ground(tmp_path, "cube"))
    assert cube.places("rolling_resistance") == []  # It is no sphere.
    assert ball.places("plane_height") == ["g.plate"]
    assert ball.places("object_size") == ["b.ball"]
    assert ball.places("corner_radius") == []  # It has no corners.
    assert ball.places("joint_spring") == []


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_is_complete(name):
    kind = KINDS[name]
    at = {"pair": "a.b~c.d", "channel": "a.b.position"}.get(kind.at, "a.b")
    parameters = {p.name: 0.5 for p in kind.parameters}
    says = sentence(Effect(name, [at], parameters), kind, {"damping": 0.01})
    assert "{" not in says and "[" not in says
    assert ("a.b" in says) and len(says) < 200
    for p in kind.parameters:
        assert p.low < p.high, p.name
        if p.valid != "any":
            assert p.low >= 0.0, p.name
    assert kind.confused_with and kind.tell_apart
    assert set(kind.confused_with) <= set(KINDS)
    assert set(kind.contains) <= set(KINDS)
    assert (kind.static_deflection is not None) == kind.hidden_state


@pytest.mark.parametrize(
    ("name", "more", "less"),
    [
        ("plane_height", "lies 0.01 m higher than", "lies 0.01 m lower than"),
        ("joint_offset", "is 0.01 rad more than the", "is 0.01 rad less than the"),
        ("clock_skew", "runs fast by 0.01 s/s", "runs slow by 0.01 s/s"),
        ("actuator_bias", "adds a constant 0.01 N m", "takes a constant 0.01 N m away"),
        ("sensor_bias", "0.01 (unit of the channel) too high", "channel) too low"),
    ],
)
def test_a_sentence_has_a_word_for_either_sign(name, more, less):
    kind = KINDS[name]
    [parameter] = kind.parameters
    for sign, words in ((0.01, more), (-0.01, less)):
        says = sentence(Effect(name, ["a.b"], {parameter.name: sign}), kind)
        assert words in says and "-" not in says


def test_no_sentence_has_a_minus_before_what_it_calls_more():
    """A kind of one number that may be below zero needs a sentence for it."""
    for name, kind in KINDS.items():
        first = kind.parameters[0]
        if len(kind.parameters) == 1 and first.low < 0.0:
            value = {first.name: 0.1 * first.low}
            assert "-" not in sentence(Effect(name, ["a.b"], value), kind), name


def test_a_sentence_reads_as_in_the_report():
    def says(kind, at, **parameters):
        return sentence(Effect(kind, at, parameters), KINDS[kind])

    assert says("joint_coulomb_friction", ["panda.j4"], coulomb=1.8) == (
        "joint panda.j4 has Coulomb friction of 1.8 N m that the model lacks"
    )
    assert says("joint_viscous_damping", ["a"], damping=2.0).startswith(
        "each joint of a has 2 N m s/rad"
    )
    assert says("contact_friction", ["b~g"], friction=0.32) == (
        "the friction coefficient of b on g is 0.32"
    )
    assert says("object_size", ["ball"], scale=0.9, radius=0.03) == (
        "body ball has a wrong size in the model; it really is 0.9 times as large; "
        "its radius really is 0.03 m"
    )
    assert says("object_size", ["box"], scale=0.9) == (
        "body box has a wrong size in the model; it really is 0.9 times as large"
    )
    assert says("object_com", ["box"], x=0.01) == (
        "the centre of mass of body box is at x = 0.01 m in its frame"
    )
    assert says("link_mass", ["panda.hand"], mass=-0.73) == (
        "body panda.hand is 0.73 kg lighter than in the model"
    )
    assert says("link_mass", ["panda.hand"], mass=0.2) == (
        "body panda.hand is 0.2 kg heavier than in the model"
    )
    assert says(
        "payload", ["panda.link8"], mass=-0.73, com_x=0, com_y=0, com_z=-0.1
    ) == (
        "body panda.link8 carries 0.73 kg less than the model says, missing at (0 m, "
        "0 m, -0.1 m) in its frame"
    )
    assert says("rotor_inertia", ["a.b"], inertia=-0.05).startswith(
        "the rotor of joint a.b has 0.05 kg m2 less"
    )
    kind = KINDS["joint_coulomb_friction"]
    less = Effect("joint_coulomb_friction", ["a.b"], {"coulomb": -0.4})
    assert sentence(less, kind, {"coulomb": 0.1}) == (
        "joint a.b has 0.40 +- 0.10 N m less of Coulomb friction than the model says"
    )
    effect = Effect("joint_coulomb_friction", ["a.b"], {"coulomb": 1.8})
    assert "1.80 +- 0.10 N m" in sentence(effect, kind, {"coulomb": 0.1})


def test_a_joint_that_slides_has_its_own_units(tmp_path):
    spring = Effect("joint_spring", ["p.j1"], {"stiffness": 3.0, "rest": 0.1})
    says = sentence(spring, KINDS["joint_spring"], slides=True)
    assert "3 N/m" in says and "0.1 m" in says and "rad" not in says
    assert "N m/rad" in sentence(spring, KINDS["joint_spring"])
    vague = sentence(spring, KINDS["joint_spring"], {"rest": float("inf")})
    assert "0.1 rad (not identifiable from these data)" in vague


def test_a_parameter_that_was_not_fitted_is_said_to_be_as_modelled():
    com = Effect("object_com", ["b.b"], {"x": 0.015, "y": -0.01, "z": 0.0})
    choice = Choice(
        com, {"x": 1e-4, "y": 1e-4}, 2.0, 0.8, "", 1.0, (), fixed=("z",), size=2
    )
    found = named(choice, None)  # type: ignore[arg-type]
    says = found.says
    assert "x = 0.01500 +- 0.00010 m y = -0.01000 +- 0.00010 m" in says
    assert "z = 0 m (as modelled)" in says and says.count("as modelled") == 1
    assert found.parameters["z"].text() == "0 (as modelled)"
    assert found.parameters["x"].text() == "0.01500 +- 0.00010"


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (0.031494, 1.2e-5, "0.031494 +- 0.000012"),
        (2.5831, 0.0387, "2.58 +- 0.04"),
        (12.34, 0.7, "12.3 +- 0.7"),
        (-0.4, 0.1, "-0.40 +- 0.10"),
        (0.003, 50.0, "0.003 +- 5e+01"),  # Its own digits would leave nothing.
        (1.8, 1e-12, "1.8 +- 1e-12"),
        (0.5, 0.0, "0.5"),
        (0.5, np.inf, "0.5"),
        (0.01, 4e8, "0.01 (the data do not show it)"),
        (3e8, 2e7, "3e+08 +- 2e+07"),
    ],
)
def test_a_value_has_the_digits_that_its_deviation_leaves(value, std, text):
    assert with_deviation(value, std) == text


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        ("payload", dict(mass=0.02, com_x=0.01, com_y=-0.03, com_z=0.04)),
        ("link_mass", dict(mass=-0.02)),
        ("link_com", dict(x=0.003, y=-0.002, z=0.004)),
    ],
)
def test_responses_to_probes_add_up_to_that_of_any_small_effect(
    tmp_path, kind, parameters
):
    """The effort that a motion needs: from shares of the probes, and from the effect
    with the parameters that these shares are read as."""
    model = SceneDynamics(double(tmp_path))
    motion = motion_of(model)
    probes, read = KINDS[kind].probes(0.01)

    def added(values):
        effect = Effect(kind, ["d.lower"], values)
        return added_effort(effect, KINDS[kind], model, motion).ravel()

    columns = np.stack([added(p) for p in probes], axis=1)
    wanted = added(parameters)
    shares = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    off = np.linalg.norm(columns @ shares - wanted) / np.linalg.norm(wanted)
    assert off < 0.02  # Of second order in how far off the load is.
    for name, value in read(shares).items():
        assert value == pytest.approx(parameters[name], abs=0.1 * np.abs(value) + 2e-3)


def test_a_load_of_which_only_the_moment_shows_starts_from_a_mass_that_can_be():
    _, read = KINDS["payload"].probes(0.01)
    found = read([-4.0, 4.0, 0.0, 0.0])  # No mass, and 2 g m along x.
    assert found["mass"] == pytest.approx(0.02) and found["com_x"] == pytest.approx(0.1)

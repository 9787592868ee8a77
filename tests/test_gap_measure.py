"""What windows that start from measured states say of a model."""

from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import pendulum

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.residuals.inverse import InverseModel
from makebreak.gap.residuals.mechanism_measure import measure, widen
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.simulation.windows import WindowModel
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect, one_dof_joints
from makebreak.models.effects.transmission import twist_deviations, twists
from makebreak.models.scene import InitialSection

CHANNELS = ("p.j1.position", "p.j1.velocity")
NOISE = (1e-5, 2e-3, 0.05)


def spring(stiffness: float) -> Effect:
    parameters = {"stiffness": stiffness, "damping": 0.3}
    return Effect("joint_elasticity", ["p.j1"], parameters)


@pytest.fixture(scope="module")
def elastic(tmp_path_factory):
    """A pendulum behind a spring of 60 N m/rad, of which the scene does not know, and
    a noisy torque sensor in the place of commands; with the torque through the spring
    at each time."""
    folder = tmp_path_factory.mktemp("elastic")
    rotor = Effect("rotor_inertia", ["p.j1"], {"inertia": 0.15})
    scene = replace(pendulum(folder), effects=[rotor])
    rng = np.random.default_rng(3)
    time = np.arange(2000) * 0.002
    effort = 2.5 * np.sin(3.0 * time) + 1.5 * np.sin(7.0 * time)
    commands = Commands(time, {"p.j1.effort_command": effort})
    world = SceneSimulation(replace(scene, effects=[rotor, spring(60.0)]))
    start = InitialSection(positions={"p.j1": 0.4})
    measured = np.column_stack([world.run(start, time, CHANNELS, commands), effort])
    through = effort - 0.15 * np.gradient(measured[:, 1], time)
    measured += rng.normal(size=measured.shape) * NOISE
    names = (*CHANNELS, "p.j1.effort_measured")
    columns = {"time": time} | dict(zip(names, measured.T, strict=True))
    write_recording(
        folder / "run.csv", columns, noise=dict(zip(names, NOISE, strict=True))
    )
    recordings = read_recordings([folder / "run.csv"])
    return scene, InverseModel(scene, recordings), (time, through)


def test_a_window_may_start_with_any_twist_that_the_noise_of_the_torque_allows(elastic):
    scene, motion, _ = elastic
    gap, *_ = measure(scene, [spring(60.0)], [], motion, every=True)
    assert gap.after < 1.2  # Noise levels are known to 10-20 %.
    assert gap.before > 10.0


def test_that_freedom_does_not_hide_a_wrong_spring(elastic):
    scene, motion, _ = elastic
    gap, *_ = measure(scene, [spring(85.0)], [], motion, every=True)
    assert gap.after > 3.0


def test_a_twist_is_as_uncertain_as_the_smoothed_torque_over_the_stiffness(elastic):
    _, motion, (time, through) = elastic
    (each,) = motion.motions()
    t, stiff = each.time, spring(1e5)
    z, dz, _ = twists(stiff, motion.dynamics, each)["p.j1"]
    tau, rate = (np.interp(t, time, y) for y in (through, np.gradient(through, time)))
    error = z - (tau / 1e5 - 0.3 / 1e10 * rate), dz - rate / 1e5
    inner = slice(100, -100)  # Smoothing is worse at the ends.
    rms = [np.sqrt(np.mean(e[inner] ** 2)) for e in error]
    found = twist_deviations(stiff, motion.dynamics, each)["p.j1"]
    assert np.all(found < 2.0 * np.array(rms)) and np.all(found > 0.5 * np.array(rms))
    gap = Effect("joint_backlash", ["p.j1"], {"gap": 0.02})
    assert twist_deviations(gap, motion.dynamics, each) == {}


def test_windows_are_no_surer_than_without_the_damping_that_a_file_has_in_vain(elastic):
    scene, motion, _ = elastic
    damped = replace(scene, effects=[
        *scene.effects, Effect("joint_viscous_damping", ["p.j1"], {"damping": 9.0})
    ])  # fmt: skip

    def std(*effects) -> np.ndarray:
        model = WindowModel(damped, motion.recordings, 0.3, most=20)
        widen(model, effects, None)
        return np.concatenate([w.std for w in model.windows])

    less = Effect("joint_viscous_damping", ["p.j1"], {"damping": -9.0})
    more = Effect("joint_viscous_damping", ["p.j1"], {"damping": 9.0})
    assert np.all(std(less) >= std()) and std(less).max() > 1.2 * std().max()
    np.testing.assert_array_equal(std(more), std())


@pytest.mark.parametrize("kind", ["object_mass", "object_com", "object_inertia"])
def test_what_a_body_has_now_changes_nothing_beside_what_was_added_to_it(
    tmp_path, kind
):
    """A repaired scene has a heavier link and a load: its own mass is set before these
    are added, so the mass of both is not what it has."""
    scene = pendulum(tmp_path)
    plant = SceneDynamics(scene).plant
    (joint,) = one_dof_joints(plant)
    body = f"p.{joint.child_body().name()}"
    added = [
        Effect("link_mass", [body], {"mass": 0.3}),
        Effect(
            "payload", [body], {"mass": 0.4, "com_x": 0.1, "com_y": 0.0, "com_z": 0.2}
        ),
    ]
    repaired = replace(scene, effects=added)
    now = Effect(kind, [body], SceneDynamics(repaired).now(kind, [body]))
    beside = replace(scene, effects=[*added, now])
    q, v, vd = np.random.default_rng(1).normal(size=(3, 5, 1))
    np.testing.assert_allclose(
        SceneDynamics(beside).inverse_dynamics(q, v, vd),
        SceneDynamics(repaired).inverse_dynamics(q, v, vd),
        rtol=1e-9,
    )

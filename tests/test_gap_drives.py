"""Recordings of joints whose drives have a loop of their own, and what they lack."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from effect_scenes import at_rest_but, double, with_effects

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.residuals.inverse import InverseModel
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.workflow import run_gap
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import ActuationSection
from makebreak.models.scene_file import write_scene
from makebreak.models.scene_schema import SupplySection

JOINTS = ("d.j1", "d.j2")
NOISE = 1e-4  # [rad] of positions.
ACTUATION = {
    "servo": ActuationSection(
        type="servo", joints=list(JOINTS), kp=[60.0], limit=[25.0, 12.0],
        supply=SupplySection(voltage=[24.0], kt=[2.0], resistance=[1.0]),
    ),
    "velocity": ActuationSection(
        type="velocity", joints=list(JOINTS), kd=[10.0], limit=[25.0, 12.0]
    ),
}  # fmt: skip
ROTORS = ("rotor_inertia", "d", dict(inertia=0.05))


def targets(time):
    """Smooth goals, another for each joint, that reach the drives' limits."""
    waves = [(0.9, 2.3, 0.0), (0.3, 6.1, 1.0)], [(0.7, 3.1, 1.0), (0.3, 7.3, 0.3)]
    return np.stack(
        [sum(a * np.sin(w * time + p) for a, w, p in each) for each in waves]
    )


def recorded(folder, drive, hidden, seconds=16.0, effort=False, bias=0.0):
    """A scene and a recording of it at 100 Hz in which `hidden` acts as well."""
    scene = with_effects(replace(double(folder), actuation=ACTUATION[drive]), ROTORS)
    truth = replace(scene, effects=[*scene.effects, *(Effect(*h) for h in hidden)])
    time = np.arange(0.0, seconds, 0.01)
    what = "position_command" if drive == "servo" else "velocity_command"
    goals = targets(time)
    start = goals[:, 0] if drive == "servo" else [0.0, 0.0]
    commands = {f"{j}.{what}": u for j, u in zip(JOINTS, goals, strict=True)}
    channels = [f"{j}.position" for j in JOINTS]
    channels += [f"{j}.effort_measured" for j in JOINTS] if effort else []
    rows = SceneSimulation(truth).run(
        at_rest_but(dict(zip(JOINTS, start, strict=True))),
        time,
        channels,
        Commands(time, commands),
    )
    rng = np.random.default_rng(5)
    std = np.array([NOISE, NOISE, 0.02, 0.02])[: rows.shape[1]]
    rows = rows + std * rng.normal(size=rows.shape)
    if effort:
        rows[:, 3] += bias
    file = folder / "recording.csv"
    np.savetxt(
        file, np.column_stack([time, rows, *goals]), delimiter=",", comments="",
        header=",".join(["time", *channels, *commands]), fmt="%.9g",
    )  # fmt: skip
    write_scene(scene, folder / "scene.yaml")
    return scene, file


HIDDEN = {
    "nothing": [],
    "gain": [("servo_gain", ["d.j2"], {"kp": 48.0})],
    "load": [("joint_load_friction", ["d.j1"], {"share": 0.15})],
    "direction": [
        ("joint_direction_friction", ["d.j2"],
         {"coulomb_plus": 0.2, "coulomb_minus": 0.6})
    ],
    "load and more": [
        ("joint_load_friction", ["d.j1"], {"share": 0.15}),
        ("payload", ["d.lower"],
         {"mass": 0.3, "com_x": 0.0, "com_y": 0.02, "com_z": -0.3}),
        ("input_delay", ["d"], {"delay": 0.012}),
    ],
}  # fmt: skip


def rms(r):
    return float(np.sqrt(np.mean(r**2)))


QUICK = (
    ("servo", "load and more"),
    ("velocity", "load and more"),
)


@pytest.mark.parametrize(
    "drive, hidden",
    [pytest.param(*each, marks=[pytest.mark.slow] * (each not in QUICK))
     for each in product(("servo", "velocity"), HIDDEN)],
)  # fmt: skip
def test_equations_of_driven_joints_are_met_by_the_truth_alone(tmp_path, drive, hidden):
    effects = HIDDEN[hidden]
    scene, file = recorded(tmp_path, drive, effects, seconds=8.0)
    model = InverseModel(scene, read_recordings([file]))
    truth = [Effect(*each) for each in effects]
    # Noise is known to a third; a stiff drive's answer to each new command is smoothed
    # away: half a percent of the torques that cancel in it, more of them where a
    # position is held (4.9 at most) than where a speed is (2.1).
    assert rms(model.residual(truth)) < {"servo": 5.5, "velocity": 2.4}[drive]
    if effects:
        assert rms(model.residual()) > 2.0 * rms(model.residual(truth))


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden, name, tolerance",
    [("gain", "kp", 0.03), ("load", "share", 0.1)],
)
def test_what_a_servo_hides_is_named(tmp_path, hidden, name, tolerance):
    _, file = recorded(tmp_path, "servo", HIDDEN[hidden])
    result = run_gap(tmp_path / "scene.yaml", [file])
    ((kind, at, parameters),) = HIDDEN[hidden]
    (found,) = result.effects
    assert (found.kind, list(found.at)) == (kind, at)
    assert found.parameters[name].value == pytest.approx(
        parameters[name], rel=tolerance
    )

"""A person's push is found and told, and bends nothing; what comes back is no push."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from effect_scenes import at_rest_but, double, with_effects

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.residuals.pushes import find_pushes
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.workflow import run_gap
from makebreak.models.scene_file import write_scene

JOINTS = ("d.j1", "d.j2")
SECONDS, RATE = 16.0, 200.0
FRICTION = [("joint_coulomb_friction", "d.j1", dict(coulomb=0.4)),
            ("joint_coulomb_friction", "d.j2", dict(coulomb=0.25))]  # fmt: skip
PUSH = (9.0, 10.1, 3.0)  # From, to [s], [N m] on the first joint.


def goals(time):
    """Another sum of sines for each joint, which come back many times."""
    return np.stack(
        [0.7 * np.sin(1.9 * time) + 0.3 * np.sin(4.3 * time + 1.0),
         0.6 * np.sin(2.7 * time + 0.5) + 0.2 * np.sin(5.9 * time)]
    )  # fmt: skip


def recorded(folder, hidden=(), push=None, gaps=(1.0, 1.0)):
    """Efforts that follow the goals, as commanded, and what the joints do; the push is
    in no command."""
    scene = double(folder)
    truth = with_effects(scene, *hidden)
    simulation = SceneSimulation(truth)
    time = np.arange(0.0, SECONDS, 1.0 / RATE)
    want = goals(time)
    gain, damping = np.array([60.0, 25.0]) * gaps, np.array([8.0, 3.0])
    rate = np.gradient(want, time, axis=1)
    state = np.concatenate([want[:, 0], rate[:, 0]])
    channels = [f"{j}.{what}" for what in ("position", "velocity") for j in JOINTS]
    told, seen = np.empty((2, len(time))), np.empty((4, len(time)))
    for k, t in enumerate(time):  # A controller, a row at a time.
        seen[:, k] = state
        u = gain * (want[:, k] - state[:2]) + damping * (rate[:, k] - state[2:])
        told[:, k] = u
        acts = u.copy()
        if push is not None and push[0] <= t < push[1]:
            acts[0] += push[2]
        start = at_rest_but(
            dict(zip(JOINTS, state[:2], strict=True)),
            dict(zip(JOINTS, state[2:], strict=True)),
        )
        columns = {
            f"{j}.effort_command": [x] for j, x in zip(JOINTS, acts, strict=True)
        }
        rows = simulation.run(
            start, [t, t + 1.0 / RATE], channels,
            Commands(np.array([t]), {n: np.array(x) for n, x in columns.items()}),
        )  # fmt: skip
        state = rows[-1]
    rng = np.random.default_rng(2)
    measured = seen[:2] + 5e-5 * rng.normal(size=(2, len(time)))
    header = ["time", *(f"{j}.position" for j in JOINTS),
              *(f"{j}.effort_command" for j in JOINTS)]  # fmt: skip
    file = folder / "recording.csv"
    np.savetxt(
        file, np.column_stack([time, *measured, *told]), delimiter=",", comments="",
        header=",".join(header), fmt="%.9g",
    )  # fmt: skip
    write_scene(scene, folder / "scene.yaml")
    return scene, file


def test_a_push_is_told_with_its_time_joint_and_size(tmp_path):
    scene, file = recorded(tmp_path, FRICTION, PUSH)
    problem = MechanismProblem(scene, read_recordings([file]))
    (push,) = problem.pushes
    assert push.start == pytest.approx(PUSH[0], abs=0.4)
    assert push.end == pytest.approx(PUSH[1], abs=0.4)
    (joint, effort), *_ = push.efforts
    # The rms over a stretch that begins and ends a little outside of it.
    assert joint == "d.j1" and 0.6 * PUSH[2] < effort < 1.2 * PUSH[2]
    (told,) = problem.push_findings()
    assert "as a person's push would" in told.says and "N m at d.j1" in told.says
    # Next to no weight: no row of its joint is more than a deviation off.
    rows = problem.base().reshape(-1, 2)
    assert np.abs(rows[list(push.rows), 0]).max() < 1.0 < np.median(np.abs(rows[:, 0]))


def test_where_all_is_pushed_no_window_is_simulated(tmp_path):
    _, file = recorded(tmp_path, FRICTION, PUSH)
    problem = MechanismProblem(double(tmp_path), read_recordings([file]))
    n = problem.nuisances()
    base = problem.base()
    fitted = SimpleNamespace(b=np.zeros(len(n.prior)), left=base, r=base)
    assert problem.outcome([], fitted, fitted, n) is not None
    (push,) = problem.pushes
    problem.pushes = [replace(push, start=-1.0, end=SECONDS + 1.0)]
    assert problem.outcome([], fitted, fitted, n) is None


COMES_BACK = {
    "friction": FRICTION,
    "saturation": [("actuator_saturation", "d.j1", dict(limit=4.5))],
    "wave": [("sinusoidal_force", "d.lower",
              dict(fx=1.5, fy=0.0, fz=0.0, frequency=0.4, phase=0.3))],
    "spring": [("joint_spring", "d.j2", dict(stiffness=3.0, rest=-1.5))],
}  # fmt: skip


@pytest.mark.parametrize(
    "hidden",
    [
        name if name == "saturation" else pytest.param(name, marks=pytest.mark.slow)
        for name in COMES_BACK
    ],
)
def test_what_acts_rarely_and_comes_back_is_no_push(tmp_path, hidden):
    scene, file = recorded(tmp_path, COMES_BACK[hidden])
    problem = MechanismProblem(scene, read_recordings([file]))
    assert problem.pushes == []


@pytest.mark.slow
def test_a_push_bends_no_friction_and_no_force_is_invented_for_it(tmp_path):
    _, file = recorded(tmp_path, FRICTION, PUSH)
    result = run_gap(tmp_path / "scene.yaml", [file])
    found = {(e.kind, *e.at): e.parameters for e in result.effects}
    assert {(kind, at) for kind, at, _ in FRICTION} <= set(found)
    # Its sudden ends make all smoothed motion rougher, and a delay of less than half a
    # row may be named beside (without a push it is not); nothing else is.
    for name in set(found) - {(kind, at) for kind, at, _ in FRICTION}:
        assert set(found[name]) == {"delay"}
        assert found[name]["delay"].value < 0.5 / RATE
    for kind, at, p in FRICTION:
        value = found[kind, at]["coulomb"].value
        assert value == pytest.approx(p["coulomb"], rel=0.05)
    assert [c.kind for c in result.checks if c.severity == "warning"].count("push") == 1


def stretches(*spans, beyond=None, joint=0):
    """Pushes in 24 s of two joints that swing many times: 1 N m is left over by all and
    60 N m within the spans of test functions; `beyond`: q or v, which goes far out
    there."""
    rng = np.random.default_rng(3)
    centre = 0.1 * np.arange(240)
    left, noise = rng.normal(size=(240, 2)), np.full((240, 2), 0.1)
    q = np.stack([np.sin(1.9 * centre), np.cos(2.7 * centre)], axis=1)
    v = np.gradient(q, centre, axis=0)
    for first, last in spans:
        left[first:last, joint] += 60.0
        if beyond is not None:
            {"q": q, "v": v}[beyond][first:last, joint] = -1.5 if beyond == "q" else 4.0
    track = SimpleNamespace(
        recording="run", episode=0, grid=centre, q=q, v=v,
        bumps=SimpleNamespace(centre=centre, width=0.2),
    )  # fmt: skip
    needed = np.array([50.0, 50.0])
    return find_pushes([track], ("a", "b"), left, noise, needed)  # type: ignore[list-item]


@pytest.mark.parametrize("joint", [0, 1])
def test_a_stretch_that_comes_back_nowhere_is_a_push(joint):
    [push] = stretches((100, 111), joint=joint)
    assert (push.start, push.end) == (pytest.approx(9.7), pytest.approx(11.3))
    assert [j for j, _ in push.efforts] == ["ab"[joint]]
    assert set(range(100, 111)) <= set(push.rows)


@pytest.mark.parametrize("beyond", ["q", "v"])
def test_what_shows_only_at_the_end_of_the_range_is_no_push(beyond):
    """An end stop acts where a joint is never else, drag where it is never as fast."""
    assert stretches((100, 111), beyond=beyond) == []


def test_what_comes_back_or_is_short_or_long_is_no_push():
    assert len(stretches((40, 50), (160, 170))) == 2
    assert stretches((40, 50), (100, 110), (160, 170)) == []
    assert stretches((100, 103)) == []
    assert stretches((100, 150)) == []

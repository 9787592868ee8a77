"""What people's recordings of pushes have that a benchmark's may lack: objects that lie
on a face, force sensors with a bias, cameras that nobody knows to be late."""

import numpy as np
import pytest
from gap_benchmark import push_world
from gap_benchmark.push_world import BLOCK, TABLE
from push_problems import screen_of

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.residuals import late_poses
from makebreak.gap.residuals.contact_problem import LAW, ContactProblem
from makebreak.gap.residuals.lying_on_faces import lying_on_faces, point_on_face
from makebreak.gap.residuals.pose_times import earlier
from makebreak.gap.simulation.contact_windows import PushWindows
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

PAIR = f"{BLOCK}~{TABLE}"
LATE, BIAS = 0.032, {"fx": 0.4, "fy": -0.3}  # [s]: four of the camera's periods; [N].


def written(folder, change=None):
    """Pushes with nothing hidden, their table changed before it is written."""
    rng = np.random.default_rng(61)
    world = push_world.a_world(rng)
    table, noise = push_world.record(world, rng, episodes=4)
    if change is not None:
        table = change(table)
    return world, push_world.write(folder, world, table, noise)


def late(table):
    """The block's poses by LATE, in each episode."""
    rows = round(LATE * 250)
    out = dict(table)
    for name in table:
        if name.startswith(BLOCK + "."):
            y = np.full(len(table["time"]), np.nan)
            for number in np.unique(table["episode"]):
                mine = np.flatnonzero(table["episode"] == number)
                y[mine[rows:]] = table[name][mine[:-rows]]
                y[mine[0]] = table[name][mine[0]]
            out[name] = y
    return out


def biased(table):
    out = dict(table)
    for name in table:
        if name.rpartition(".")[2] in BIAS:
            out[name] = table[name] + BIAS[name.rpartition(".")[2]]
    return out


def problem_of(folder, scene) -> ContactProblem:
    return ContactProblem(
        read_scene(scene), read_recordings([folder / "recording.csv"])
    )


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    folder = tmp_path_factory.mktemp("right")
    return problem_of(folder, written(folder)[1])


@pytest.mark.slow
def test_a_block_on_feet_needs_no_stand_ins_and_one_on_its_face_does(right, tmp_path):
    assert lying_on_faces(right) == [] and point_on_face(right, []) == []
    world, scene = written(tmp_path)
    # The same block without its feet: as high as they had lifted it.
    flat = (tmp_path / "block.sdf").read_text()
    first, last = flat.index('<collision name="foot0"'), flat.rindex("</link>")
    half = world.half[2]
    flat = flat[:first] + flat[last:]
    flat = flat.replace(f"{2 * half!r}</size>", f"{2 * (half + world.foot)!r}</size>")
    (tmp_path / "block.sdf").write_text(flat)
    problem = problem_of(tmp_path, scene)
    [one] = lying_on_faces(problem)
    names = problem.shapes.names
    assert (names[one.body], names[one.ground]) == (BLOCK, TABLE) and not one.on_side
    [finding] = point_on_face(problem, [one])
    assert finding.severity == "warning" and PAIR in finding.says
    # With stand-ins it is pushed in simulation as it was measured to be.
    windows = PushWindows(problem.scene, problem.recordings, None, [one])
    errors = np.concatenate([e.ravel() for e in windows.errors(windows.simulate(()))])
    assert float(np.sqrt(np.nanmean(errors**2))) < 1.0


def test_a_bias_of_a_force_sensor_is_seen_while_nothing_is_touched(right, tmp_path):
    assert right.biased == {}
    problem = problem_of(tmp_path, written(tmp_path, biased)[1])
    for axis, bias in BIAS.items():
        # A twentieth of a newton: the sensor's noise over some hundred rows.
        assert problem.biased[f"tip.tip.{axis}"] == pytest.approx(bias, abs=0.02)
    # It touches when it did without the bias.
    for key, on in right._touching.items():
        assert (problem._touching[key] == on).mean() > 0.99
    there = [
        Effect("sensor_bias", [f"tip.tip.{axis}"], {"bias": bias})
        for axis, bias in BIAS.items()
    ]
    kinds = {(c.kind, c.at[0]) for c in problem._plain_candidates(problem.base(), ())}
    assert {("sensor_bias", f"tip.tip.{axis}") for axis in BIAS} <= kinds
    screen = screen_of(problem)
    before, after = (
        screen.evaluate(problem.residual(effects)).score for effects in ((), there)
    )
    assert after < 1.1 and before > 1.5 * after
    with pytest.raises(ValueError, match="sensor_bias: of forces"):
        problem.residual([Effect("sensor_bias", ["tip.x.position"], {"bias": 1.0})])


@pytest.mark.slow
def test_poses_that_come_late_are_put_where_they_belong(right, tmp_path):
    _, scene = written(tmp_path, late)
    recordings = read_recordings([tmp_path / "recording.csv"])
    problem = late_poses.contact_problem(read_scene(scene), recordings)
    # To a row, of 4 ms.
    assert problem.late == {BLOCK: pytest.approx(LATE, abs=0.004)}
    [found] = problem.found_before()
    assert (found.effect.kind, found.effect.at) == ("sensor_delay", [BLOCK])
    assert found.effect.parameters["delay"] == pytest.approx(LATE, abs=0.002)
    assert found.after < 0.9 * found.before
    left = screen_of(problem).evaluate(problem.base()).score
    assert left < 1.15


def test_poses_in_time_are_left_where_they_are(right):
    assert late_poses.wanted(right) == {}


def test_samples_are_moved_to_the_rows_at_which_they_were_true(right):
    [recording] = right.recordings
    name = f"{BLOCK}.x"
    [moved] = earlier([recording], {BLOCK: 0.008})  # Two rows.
    for episode in recording.episodes:
        y, was = moved[name][episode.rows], recording[name][episode.rows]
        np.testing.assert_array_equal(y[:-2], was[2:])
        assert np.isnan(y[-2:]).all()
    joint = "tip.x.position"
    assert moved[joint] is recording[joint]
    assert earlier([recording], {})[0] is recording


@pytest.mark.parametrize(
    ("kind", "at", "name", "small"),
    [
        ("contact_friction", PAIR, "friction", True),
        ("contact_friction", PAIR, "friction", False),
        ("object_mass", BLOCK, "mass", True),
        ("object_mass", BLOCK, "mass", False),
    ],
)
def test_less_than_laws_of_contact_are_good_for_is_no_effect(
    right, kind, at, name, small
):
    if kind == "contact_friction":
        pair = next(p for p in right._pairs_met if right.pair_name(p) == PAIR)
        now = right._friction_now(pair)
    else:
        now = right.dynamics.now(kind, [at])[name]
    factor = 1.0 + (0.9 if small else 1.1) * LAW
    assert right.is_within_law(Effect(kind, [at], {name: factor * now})) == small
    assert not right.is_within_law(Effect("body_drag", [BLOCK], {"linear": 1e-9}))

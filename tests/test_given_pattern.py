"""A user's own motion: what is expected along it, where the arm begins, which files are
refused, how a run is scored; and the commands that docs/shaping.md has for it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from makebreak.diagrams.arm_reach import ArmReach, joint_positions_along
from makebreak.diagrams.given_pattern import (
    expected_contacts,
    segment_paths,
    start_at_pattern,
)
from makebreak.diagrams.multiple_collisions import (
    IMPACTS,
    MultipleCollisionsConfig,
    make_pattern,
    make_task,
    surfaces,
)
from makebreak.diagrams.scene_facts import PANDA_JOINTS
from makebreak.diagrams.station import make_control_plant
from makebreak.diagrams.tabletop import TABLETOP_WALLS, TOOL, read_model
from makebreak.gap.data.table import write_recording
from makebreak.models.scene import read_scene
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.experiments import changing_surface
from makebreak.scripts.experiments.runs.pattern_file import read_pattern
from makebreak.scripts.experiments.runs.pattern_runs import scored, summary
from makebreak.systems.changing_contact.numerics.contact_task import (
    CONTACT_MISSING,
    DIRECTION,
    DONE,
    MADE,
    N_CONTACT,
    PHASE_SEGMENT,
    PHASE_STAGE,
    PHASE_STATUS,
    SPEED,
    TIME,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    Segment,
    save_pattern,
)

DOCS = Path(__file__).resolve().parent.parent / "docs"
DOWN, LEFT = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def model():
    return read_model("", TABLETOP_WALLS, "sphere")


@pytest.fixture(scope="module")
def arm(model):
    return make_control_plant(model, TOOL)


def down_and_along(start=(0.45, -0.1, 0.15), end=0.14):
    """Down to z = 0.02, along the table to y = end, a little back along the wall."""
    x, y, _ = start
    low, corner = (x, y, 0.02), (x, end, 0.02)
    on = dict(force_directions=[DOWN], force_targets=[5.0])
    both = dict(force_directions=[DOWN, LEFT], force_targets=[5.0, 4.0])
    return MotionPattern((
        Segment("line", [start, low], (0.2, 2.2)),
        Segment("line", [low, corner], (2.2, 5.0), **on),
        Segment("line", [corner, (x + 0.1, end, 0.02)], (5.0, 7.0), **both),
    ))  # fmt: skip


def demonstration(seed=0):
    """{column: (n,)} of that motion, at 200 Hz: pose of the tip and force on it, with
    noise, and the constant bias of the sensor."""
    pattern, rng = down_and_along(), np.random.default_rng(seed)
    time = np.arange(0.0, 7.5, 0.005)
    pose = np.array([pattern.pose(t)[:7] for t in time])
    force = np.zeros((len(time), 3))
    for i, t in enumerate(time):
        directions, targets = pattern.forces(t)
        if t > 0.2:
            force[i] = -targets @ directions if len(targets) else 0.0
    force += rng.normal(scale=0.1, size=force.shape) + [0.3, -0.4, 0.2]
    pose[:, :3] += rng.normal(scale=2e-5, size=(len(time), 3))
    names = [f"tool.tip.{q}" for q in "x y z qw qx qy qz fx fy fz".split()]
    return {"time": time} | dict(zip(names, np.hstack([pose, force]).T, strict=True))


# --- What is expected, and where the arm begins.


def test_contacts_are_expected_where_a_segment_ends_and_the_next_presses_anew():
    belief = expected_contacts(down_and_along(), 0.015)
    assert [c.segment for c in belief.contacts] == [0, 1]
    for contact, d, place in zip(
        belief.contacts, (DOWN, LEFT), ([0.45, -0.1, 0.02], [0.45, 0.14, 0.02]),
        strict=True,
    ):  # fmt: skip
        np.testing.assert_allclose(contact.direction, d)
        np.testing.assert_allclose(contact.mean, place, atol=1e-12)
        np.testing.assert_allclose(contact.covariance, 0.015**2 * np.eye(3))
    # Of the shipped motion the same impacts as its own experiment expects.
    shipped = expected_contacts(make_pattern(MultipleCollisionsConfig(), 0.02), 0.01)
    assert [c.segment for c in shipped.contacts] == [k for *_, k in IMPACTS]


def test_a_segment_that_does_not_lead_into_its_contact_is_refused():
    low, corner = (0.45, -0.1, 0.02), (0.45, 0.14, 0.02)
    wrong = MotionPattern((
        Segment("line", [low, corner], (0.0, 3.0)),
        Segment("line", [corner, (0.5, 0.14, 0.02)], (3.0, 5.0),
                force_directions=[DOWN], force_targets=[5.0]),
    ))  # fmt: skip
    with pytest.raises(ValueError, match=r"segment 0 .* along \(0.00, 0.00, -1.00\)"):
        expected_contacts(wrong, 0.01)


def test_the_arm_of_world_and_model_begins_at_the_first_pose(model):
    world, mine = (read_model("", TABLETOP_WALLS, "sphere") for _ in range(2))
    pattern = down_and_along()
    start_at_pattern(pattern, world, mine, TOOL)
    assert world.initial.positions == mine.initial.positions
    reach = ArmReach(make_control_plant(mine, TOOL))
    p, R = reach.pose(reach.q_default)
    np.testing.assert_allclose(p, pattern.pose(0.2)[:3], atol=1e-6)
    # Tool down: then the tip's axes are the world's.
    np.testing.assert_allclose(R.matrix(), np.eye(3), atol=1e-5)


def test_joint_positions_bring_the_tip_along_the_pattern(arm):
    pattern, reach = down_and_along(), ArmReach(arm)
    q = joint_positions_along(pattern, arm)
    times = np.linspace(0.2, 7.0, len(q))
    for each, t in zip(q[::20], times[::20], strict=True):
        np.testing.assert_allclose(reach.pose(each)[0], pattern.pose(t)[:3], atol=1e-5)


def line(a, b, seconds, **more):
    return MotionPattern((Segment("line", [a, b], (0.0, seconds)),), **more)


@pytest.mark.parametrize(
    "pattern, message",
    [
        (line((0.45, 0, 0.2), (1.2, 0, 0.2), 5.0), r"segment 0 at .*cannot reach"),
        (line((0.3, -0.45, 0.3), (0.3, 0.45, 0.3), 0.62, acceleration_max=20.0),
         r"too fast, panda_joint\d would turn at .* at most 2.\d\d rad/s"),
        (line((0.45, 0, -0.005), (0.45, 0, 0.2), 3.0), "mm inside table::worktop"),
        (line((0.45, 0, 0.2), (0.05, 0, 0.2), 9.0), "cannot reach|would be at"),
    ],
)  # fmt: skip
def test_what_the_arm_cannot_follow_is_refused(pattern, message):
    world, mine = (read_model("", TABLETOP_WALLS, "sphere") for _ in range(2))
    with pytest.raises(ValueError, match=message):
        start_at_pattern(pattern, world, mine, TOOL)


def test_the_world_is_the_seed_s_whatever_moves_in_it():
    config = MultipleCollisionsConfig(seed=3)
    own = make_task(config)
    given = make_task(
        MultipleCollisionsConfig(seed=3, pattern="p.yaml"), down_and_along()
    )
    assert given.friction == own.friction and given.stiffness == own.stiffness
    for scene in (own.world, given.world):
        scene.initial.positions.clear()
    np.testing.assert_array_equal(
        surfaces(own.world, 0.02), surfaces(given.world, 0.02)
    )
    assert len(given.prior.contacts) == 2
    with pytest.raises(ValueError, match="expected the motion of that file"):
        make_task(MultipleCollisionsConfig(pattern="p.yaml"))


def test_the_drawn_path_has_a_line_for_each_segment_from_start_to_end():
    pattern = down_and_along()
    for piece, segment in zip(segment_paths(pattern), pattern.segments, strict=True):
        np.testing.assert_allclose(piece[[0, -1]], segment.positions, atol=1e-12)


# --- Files.


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
def test_a_recorded_demonstration_becomes_its_motion(tmp_path, model, suffix):
    path = tmp_path / f"demonstration{suffix}"
    write_recording(path, demonstration())
    pattern = read_pattern(path, model)
    assert [len(s.force_directions) for s in pattern.segments] == [0, 1, 2]
    # Smoothing at 3 Hz cuts a corner by a few millimetres.
    for found, true in zip(pattern.segments, down_and_along().segments, strict=True):
        np.testing.assert_allclose(found.positions, true.positions, atol=6e-3)
    np.testing.assert_allclose(pattern.segments[1].force_targets, 5.0, atol=0.1)
    assert len(expected_contacts(pattern, 0.01).contacts) == 2


def test_joints_in_place_of_a_pose_and_flipped_quaternions_give_the_same_motion(
    tmp_path, model, arm
):
    columns = demonstration()
    write_recording(tmp_path / "pose.csv", columns)
    pattern = down_and_along()
    q = joint_positions_along(pattern, arm)
    times = np.linspace(0.2, 7.0, len(q))
    joints = {
        f"panda.{name}.position": np.interp(columns["time"], times, values)
        for name, values in zip(PANDA_JOINTS, q.T, strict=True)
    }
    forces = {n: x for n, x in columns.items() if n == "time" or n[-2:-1] == "f"}
    write_recording(tmp_path / "joints.csv", forces | joints)
    flipped = dict(columns)
    for name in columns:
        if name[-2:-1] == "q":
            flipped[name] = columns[name] * np.where(columns["time"] % 0.5 < 0.2, 1, -1)
    write_recording(tmp_path / "flipped.csv", flipped)
    # An earlier episode does not count.
    both = {n: np.concatenate([x[:400], x]) for n, x in columns.items()}
    both["episode"] = np.repeat([0, 1], [400, len(columns["time"])])
    write_recording(tmp_path / "episodes.csv", both)
    one = read_pattern(tmp_path / "pose.csv", model)
    for name in ("joints", "flipped", "episodes"):
        other = read_pattern(tmp_path / f"{name}.csv", model)
        assert len(other) == len(one), name
        for a, b in zip(one.segments, other.segments, strict=True):
            np.testing.assert_allclose(a.positions, b.positions, atol=1e-3)
            np.testing.assert_array_equal(a.force_directions, b.force_directions)


def test_a_slow_approach_along_a_surface_is_no_contact(tmp_path, model):
    # Friction of 2 N against a tip that creeps at 10 mm/s, a twentieth of the fastest.
    columns = demonstration()
    time = np.arange(0.0, 15.0, 0.005)
    n = len(columns["time"])
    slow = {name: np.full(len(time), x[n // 2]) for name, x in columns.items()}
    rng = np.random.default_rng(1)
    for name in ("fx", "fy", "fz"):
        slow[f"tool.tip.{name}"] = rng.normal(scale=0.1, size=len(time))
    slow["time"] = time
    down, creep = time < 2.0, (time >= 3.0) & (time < 13.0)
    slow["tool.tip.x"] = np.full(len(time), 0.45)
    slow["tool.tip.z"] = np.where(down, 0.22 - 0.1 * time, 0.02)
    slow["tool.tip.y"] = np.clip(0.01 * (time - 3.0), 0.0, 0.1)
    slow["tool.tip.fz"] += np.where(down, 0.0, 5.0)
    slow["tool.tip.fy"] -= np.where(creep, 2.0, 0.0)
    write_recording(tmp_path / "slow.csv", slow)
    pattern = read_pattern(tmp_path / "slow.csv", model)
    assert not any((s.force_directions @ LEFT > 0.9).any() for s in pattern.segments)


def with_change(**change):
    columns = demonstration()
    for name, value in change.items():
        columns[f"tool.tip.{name}"] = value
    return columns


def without(*quantities):
    return {
        n: x for n, x in demonstration().items() if n.split(".")[-1] not in quantities
    }


def bad_files():
    """{name: (what makes the file, the message)}"""

    def recording(columns):
        def write(path):
            table = {n: np.asarray(x, dtype=float) for n, x in columns.items()}
            rows = np.stack(list(table.values()), axis=1)
            text = [",".join(table), *(",".join(map(repr, r.tolist())) for r in rows)]
            path.write_text("\n".join(text) + "\n")

        return write

    full = demonstration()
    nan, back, still = dict(full), dict(full), dict(full)
    nan["tool.tip.fy"] = np.where(
        np.arange(len(full["time"])) == 500, np.nan, full["tool.tip.fy"]
    )
    back["time"] = full["time"].copy()
    back["time"][300] = 0.1
    twice = full | {"time": full["time"].copy()}
    twice["time"][300] = twice["time"][299]
    for q in "xyz":
        still[f"tool.tip.{q}"] = np.full(len(full["time"]), 0.3)
    two = without("fx") | {
        f"{a}.{q}": full["time"] for a in ("a.b", "c.d") for q in ("fx", "fy", "fz")
    }
    return {
        "none.csv": (None, "does not exist, expected a motion pattern"),
        "folder.csv": (lambda path: path.mkdir(), "is a folder, expected"),
        "notes.txt": (lambda path: path.write_text("up"), 'the name ends in ".txt"'),
        "empty.csv": (lambda path: path.write_text(""), "is empty"),
        "forces.csv": (recording(without("qw")), "no pose of the tool, expected"),
        "poses.csv": (recording(without("fx")), "no columns of the force on the tool"),
        "two.csv": (recording(two), "2 columns of the force .*, or one named tool.tip"),
        "nan.csv": (recording(nan), "force of row .* is not finite"),
        "back.csv": (recording(back), "time 0.1 follows 1.495 in row 301, expected"),
        "twice.csv": (recording(twice), "time 1.495 follows 1.495 in row 301"),
        "short.csv": (recording({n: x[:15] for n, x in full.items()}), "n >= 20"),
        "still.csv": (recording(still), "hardly moved"),
        "long.csv": (recording(full | {"time": 100 * full["time"]}), "at most 600 s"),
        "quaternion.csv": (recording(with_change(qw=0.5 * full["tool.tip.qw"])),
                           "quaternion of row 1 has length 0.5, expected 1"),
        "text.yaml": (lambda path: path.write_text("segments: up"), "expected a list"),
    }  # fmt: skip


def test_a_bad_file_is_refused_in_one_line_that_names_it(tmp_path, model):
    for name, (make, message) in bad_files().items():
        path = tmp_path / name
        if make is not None:
            make(path)
        with pytest.raises(ValueError, match=message) as error:
            read_pattern(path, model)
        assert name in str(error.value) and "\n" not in str(error.value)


def test_the_command_line_refuses_a_motion_out_of_reach_in_one_line(tmp_path, capsys):
    path = tmp_path / "far.yaml"
    save_pattern(line((0.45, 0, 0.2), (1.2, 0, 0.2), 5.0), path)
    for experiment in ("multiple_collisions", "changing_surface"):
        status = cli.main([
            "run", experiment, "--no-meshcat", "--set", f"pattern={path}",
            "--out", str(tmp_path / "out"),
        ])  # fmt: skip
        (said,) = capsys.readouterr().err.strip().splitlines()
        assert status == 2 and "far.yaml: segment 0" in said and "reach" in said


def test_a_motion_that_crosses_no_seam_is_refused_by_changing_surface(tmp_path):
    path = tmp_path / "short.yaml"
    save_pattern(down_and_along((0.36, -0.2, 0.15), end=-0.1), path)
    config = changing_surface.Config(pattern=str(path))
    with pytest.raises(ValueError, match="crosses no seam"):
        changing_surface.task_of(config)


def test_what_a_motion_of_ones_own_replaces_is_refused(tmp_path):
    with pytest.raises(ValueError, match="known_heights is False, .* of your own"):
        make_task(
            MultipleCollisionsConfig(pattern="p.yaml", known_heights=False),
            down_and_along(),
        )
    path = tmp_path / "p.yaml"
    save_pattern(down_and_along(), path)
    for change in (dict(speed=0.05), dict(normal_force=5.0)):
        config = changing_surface.Config(pattern=str(path), **change)
        with pytest.raises(ValueError, match="the pattern of your own has it"):
            changing_surface.task_of(config)
    changing_surface.task_of(changing_surface.Config(pattern=str(path)))


# --- The score.


def made_up_log(task, come=2, status=0):
    time = np.arange(0.0, 8.0, 0.001)
    n = len(time)
    contact, phase = np.zeros((n, N_CONTACT)), np.zeros((n, 6))
    wrench = np.zeros((n, 6))
    for i, expected in enumerate(task.prior.contacts[:come]):
        at, d = 2.0 * (i + 1), expected.direction
        after, begin = time >= at, round(1000 * at)
        pulse = 6.0 * np.sin(np.pi * np.arange(40) / 40.0)
        wrench[begin : begin + 40, :3] -= pulse[:, None] * d
        contact[after, MADE] = i + 1
        contact[after, DIRECTION], contact[after, TIME] = d, at
        contact[after, SPEED] = 0.02
        phase[time >= at + 0.001, PHASE_SEGMENT] = i + 1
    phase[time > 7.0, PHASE_STAGE] = DONE if come == 2 else 0
    phase[:, PHASE_STATUS] = status
    velocity = np.zeros((n, 6))
    return dict(
        time=time, contact=contact, phase=phase, wrench=wrench, ee_velocity=velocity
    )


@pytest.fixture(scope="module")
def task():
    return make_task(MultipleCollisionsConfig(pattern="p.yaml"), down_and_along())


def test_a_made_up_trial_has_the_scores_that_it_was_made_with(task):
    trial = scored(made_up_log(task), task)
    np.testing.assert_allclose(trial.touched, [2.0, 4.0])
    np.testing.assert_allclose(trial.force, 6.0, rtol=0.03)  # The filter takes 2 %.
    np.testing.assert_allclose(trial.speed, 0.02)
    assert trial.whole and trial.completion == pytest.approx(7.001 - 0.2, abs=2e-3)
    short = scored(made_up_log(task, come=1, status=CONTACT_MISSING), task)
    assert not short.whole and np.isnan(short.force[1]) and len(short.troubles) == 1


def test_success_asks_for_the_whole_motion_with_gentle_contacts(task):
    def result(**change):
        good, other = (scored(made_up_log(task), task) for _ in range(2))
        vars(other).update(change)
        out = summary({"baseline": good, "trial_1": other, "trial_2": good}, task)
        json.dumps(out, allow_nan=True)
        return out["success"]

    assert result()
    assert not result(force=np.array([1.0, 10.1]))
    assert not result(force=np.array([1.0, np.nan]))
    assert not result(done=False)
    assert not result(a10=np.array([0.1, 1.1]))


# --- Whole runs.


@pytest.mark.slow
def test_the_commands_of_the_documents_record_a_motion_and_follow_it(
    tmp_path, monkeypatch
):
    text = (DOCS / "shaping.md").read_text()
    commands = re.findall(r"^    makebreak (run .*runs/demonstration.*)$", text, re.M)
    assert len(commands) == 2
    monkeypatch.chdir(tmp_path)
    for command, out in zip(commands, ("runs/demonstration", "followed"), strict=True):
        words = command.split("#")[0].split()
        if "--out" not in words:
            words += ["--out", out]
        assert cli.main([*words, "--no-meshcat"]) in (0, 1)
    first, second = (
        json.loads((tmp_path / out / "result.json").read_text())
        for out in ("runs/demonstration", "followed")
    )
    assert first["chain_complete"]
    assert second["success"], second["criteria"]
    assert second["contacts_expected"] == second["contacts_made"] == 4
    # Contacts are where they were: the second trial is fast.
    assert second["extra_time_known_s"] < 0.5 * second["extra_time_s"]
    assert max(second["impact_force_peak_N"]) < 0.5 * max(
        second["impact_force_peak_baseline_N"]
    )


def test_a_scene_s_start_is_left_alone_without_a_given_motion():
    shipped = read_scene(TABLETOP_WALLS).initial.positions
    assert make_task(MultipleCollisionsConfig()).world.initial.positions == shipped

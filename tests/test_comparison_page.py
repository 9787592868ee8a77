"""compare.html moves as the report's windows do, and its numbers are theirs."""

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from effect_scenes import double, on_ground, pendulum
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.report.comparison import (
    _side,
    comparison_html,
    errors_of,
    shown_motion,
)
from makebreak.gap.report.files import write_report
from makebreak.gap.residuals.objects import FlightProblem
from makebreak.gap.result import Estimate, Evidence, GapResult, NamedEffect, plain
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.measure import gap_measure, series_of, unseen_series
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.simulation.windows import WindowModel
from makebreak.gap.verdict import says
from makebreak.models.effects.kind import Effect
from makebreak.models.meshes import coarse
from makebreak.models.scene import InitialSection, load_scene
from makebreak.models.scene_schema import ActuationSection
from makebreak.scripts.cli.gap_command import effects_table, write_comparison

COULOMB = Effect("joint_coulomb_friction", ["p.j1"], {"coulomb": 0.35})
TIME = np.arange(300) * 0.01
SWING = 0.5 * np.sin(3.0 * TIME)
EFFORT = ActuationSection("effort", ["p.j1"])
PUSHED = 2.5 * np.sin(3.0 * TIME)
# {kind of input: (drives, the channel that is recorded, its values)}
INPUTS = {
    "effort command": (EFFORT, "effort_command", PUSHED),
    "effort measured": (EFFORT, "effort_measured", PUSHED),
    "pd": (
        ActuationSection("pd", ["p.j1"], kp=[20.0], kd=[1.0]),
        "position_command",
        SWING,
    ),
    "servo": (
        ActuationSection("servo", ["p.j1"], kp=[20.0], kd=[1.0]),
        "position_command",
        SWING,
    ),
    "velocity": (
        ActuationSection("velocity", ["p.j1"], kd=[3.0]),
        "velocity_command",
        3.0 * SWING,
    ),
    "undriven": (ActuationSection("none"), "", None),
}


def result_of(model, effects, scene) -> GapResult:
    """What a run shows of windows that were simulated without and with effects."""
    held = [True] * len(model.windows)
    before, after = model.simulate(()), model.simulate(effects)
    series = series_of(model, before, after, held)
    if isinstance(model, WindowModel):
        series += unseen_series(model, effects, held)
    gap = gap_measure(model, before, after, held)
    return GapResult("gap_named", "", [], [], gap, [], {}, [], series)


def recorded(folder, columns):
    write_recording(folder / "run.csv", {"time": TIME} | columns)
    return read_recordings([folder / "run.csv"])


def swung(folder, what):
    """A pendulum with friction that its scene lacks, driven by one kind of input."""
    drive, channel, told = INPUTS[what]
    scene = replace(pendulum(folder), actuation=drive)
    given = channel.replace("effort_measured", "effort_command")
    inputs = {} if told is None else {f"p.j1.{given}": told}
    world = SceneSimulation(replace(scene, effects=[COULOMB]))
    start = InitialSection({"p.j1": 0.4}, {"p.j1": 2.0})
    y = world.run(start, TIME, ["p.j1.position"], Commands(TIME, inputs))[:, 0]
    rng = np.random.default_rng(0)
    columns = {"p.j1.position": y + 1e-4 * rng.normal(size=len(y))}
    columns |= {} if told is None else {f"p.j1.{channel}": told}
    return scene, recorded(folder, columns)


@pytest.mark.parametrize("what", INPUTS)
def test_a_driven_joint_moves_as_with_its_input(tmp_path, what):
    """With what its scene lacked it goes where it was measured, at each window's end;
    without, it does not. An effort that is measured is a line between its rows and not
    held: it is off by half a row."""
    scene, recordings = swung(tmp_path, what)
    model = WindowModel(scene, recordings, 0.3)
    result = result_of(model, [COULOMB], scene)
    plant = load_scene(scene, DiagramBuilder()).plant
    motion = shown_motion(result, plant, recordings)
    [(unit, after)] = errors_of(motion, "after").values()
    [(_, before)] = errors_of(motion, "before").values()
    assert unit == "rad"
    allowed = 1e-2 if what == "effort measured" else 3e-3
    assert after.max() < allowed
    assert before.max() > 5.0 * allowed
    # As in the report's table, where all windows are in it.
    if len(model.windows) == len(motion.starts):
        table = result.gap.in_units["p.j1.position"]
        assert np.sqrt(np.mean(after**2)) == pytest.approx(table.after)
        assert np.sqrt(np.mean(before**2)) == pytest.approx(table.before)


@pytest.mark.parametrize(
    "what", [pytest.param("effort measured", marks=pytest.mark.slow), "servo"]
)
def test_sentence_table_page_animation_and_json_say_the_same(tmp_path, what):
    """All against rms errors that are computed here from the windows' samples."""
    scene, recordings = swung(tmp_path, what)
    result = result_of(WindowModel(scene, recordings, 0.3), [COULOMB], scene)
    [series] = result.series
    before, after = (
        np.sqrt(np.mean((series.measured - y) ** 2))
        for y in (series.before, series.after)
    )
    expected = np.sqrt(np.mean(series.expected**2))
    named = NamedEffect(
        "joint_coulomb_friction", ("p.j1",), {"coulomb": Estimate(0.35, 0.01, "N m")},
        "Joint p.j1 has friction.", Evidence(9.0, 1.0, "", np.nan),
    )  # fmt: skip
    text = says("gap_named", [named], result.gap)
    result = replace(result, says=text, effects=[named])
    folder = tmp_path / "out"
    write_report(
        result, scene, folder, recordings,
        comparison=comparison_html(result, scene, recordings),
    )  # fmt: skip
    found = json.loads((folder / "result.json").read_text())
    units = found["gap"]["in_units"]["p.j1.position"]
    for name, size in (("before", before), ("after", after), ("expected", expected)):
        assert units[name] == pytest.approx(size)
        words = plain(size, "rad")
        assert words in found["says"] and words in text
        page = re.sub(r"<[^>]*>", " ", (folder / "report.html").read_text())
        assert page.count(words) >= 2  # In the sentence and in the table.
        if name != "expected":
            moving = (folder / "compare.html").read_text()
            assert f"rms over all that is shown {words}" in moving
    table = effects_table(result).to_text()
    assert text in table
    for size in (found["gap"]["before"], found["gap"]["after"]):
        assert f"{size:.3g}" in table and f"{size:.3g}" in text


def tossed(folder, names="xyz", height=0.6):
    """A ball in free flight: what it does is known in closed form."""
    scene = on_ground(folder, "ball")
    time = TIME[:30]
    p = {
        "x": 0.5 * time,
        "y": -0.2 * time,
        "z": height + 2.0 * time - 0.5 * 9.81 * time**2,
    }
    rng = np.random.default_rng(0)
    columns = {"time": time} | {
        f"b.ball.{a}": p[a] + 1e-4 * rng.normal(size=len(time)) for a in names
    }
    write_recording(folder / "run.csv", columns)
    return scene, read_recordings([folder / "run.csv"])


def test_a_free_body_falls_as_in_its_windows(tmp_path):
    scene, recordings = tossed(tmp_path)
    problem = FlightProblem(scene, recordings)
    result = result_of(problem, [], scene)
    plant = load_scene(scene, DiagramBuilder()).plant
    motion = shown_motion(result, plant, recordings)
    time = motion.time
    fall = 0.6 + 2.0 * time - 0.5 * 9.81 * time**2
    np.testing.assert_allclose(motion.columns["before"]["b.ball.z"], fall, atol=2e-3)
    errors = errors_of(motion, "before")
    assert errors["b.ball place"][0] == "m"
    assert errors["b.ball place"][1].max() < 2e-3


def test_a_body_that_is_metres_off_is_so_in_the_table(tmp_path):
    """A ball that hardly falls: fits cap its error at its size, 32 mm; the table has
    what the figure shows."""
    scene, recordings = tossed(tmp_path)
    force = Effect("constant_force", ["b.ball"], {"fx": 0.0, "fy": 0.0, "fz": 3.0})
    result = result_of(FlightProblem(scene, recordings), [force], scene)
    [z] = [s for s in result.series if s.channel == "b.ball.z"]
    off = np.sqrt(np.mean((z.measured - z.after) ** 2))
    assert off > 0.05
    assert result.gap.in_units["b.ball.z"].after == pytest.approx(off)


def test_a_coordinate_that_is_not_measured_is_as_it_was_simulated(tmp_path):
    """A camera from above: the ball rolls on the ground, at the height of its radius,
    and is not drawn where the scene has it by default."""
    scene, _ = tossed(tmp_path)
    columns = {"time": TIME, "b.ball.x": 0.1 * TIME, "b.ball.y": 0.0 * TIME}
    rng = np.random.default_rng(0)
    for name in ("b.ball.x", "b.ball.y"):
        columns[name] = columns[name] + 1e-4 * rng.normal(size=len(TIME))
    write_recording(tmp_path / "run.csv", columns)
    recordings = read_recordings([tmp_path / "run.csv"])
    model = WindowModel(scene, recordings, 0.3, most=3)
    motion = shown_motion(
        result_of(model, [], scene), load_scene(scene, DiagramBuilder()).plant,
        recordings,
    )  # fmt: skip
    z = motion.columns["before"]["b.ball.z"]
    assert np.isfinite(z).all() and np.ptp(z) < 1e-3
    assert "b.ball.z" not in motion.led
    assert 0.0 < z[0] < 0.2


def test_a_joint_that_windows_lead_is_drawn_as_measured_and_said(tmp_path):
    """Problems of contact lead joints along what was measured: they are no series."""
    scene = double(tmp_path)
    names = ["d.j1.position", "d.j2.position"]
    scene = replace(scene, actuation=ActuationSection("none"))
    start = InitialSection({"d.j1": 0.4, "d.j2": -0.3})
    y = SceneSimulation(scene).run(start, TIME, names)
    recordings = recorded(tmp_path, dict(zip(names, y.T, strict=True)))
    result = result_of(WindowModel(scene, recordings, 0.3), [], scene)
    result = replace(result, series=[s for s in result.series if s.channel == names[1]])
    plant = load_scene(scene, DiagramBuilder()).plant
    motion = shown_motion(result, plant, recordings)
    assert motion.led == ["d.j1"]
    for who in ("measured", "before", "after"):
        expected = np.interp(motion.time, TIME, y[:, 0])
        np.testing.assert_allclose(motion.columns[who][names[0]], expected, atol=1e-12)
    assert list(errors_of(motion, "before")) == ["d.j2"]
    page = comparison_html(result, scene, recordings)
    assert "Prescribed as measured: d.j1." in page


def test_what_a_window_could_not_be_simulated_through_is_left_out_and_said(tmp_path):
    scene, recordings = swung(tmp_path, "effort command")
    result = result_of(WindowModel(scene, recordings, 0.3), [COULOMB], scene)
    [series] = result.series
    before = np.array(series.before)
    a, b = series.starts[1:3]
    before[a + 3 : b] = np.inf
    result = replace(result, series=[replace(series, before=before)])
    plant = load_scene(scene, DiagramBuilder()).plant
    motion = shown_motion(result, plant, recordings)
    assert motion.left_out == 1 and len(motion.starts) == len(series.starts) - 1
    assert not set(series.time[a + 1 : b - 1]) & set(motion.time)
    page = comparison_html(result, scene, recordings)
    assert "Left out: 1 that could not be simulated to their end." in page
    assert "inf" not in re.search(r"says: (\{.*?\]\}), order", page).group(1)


def test_the_page_says_the_error_of_each_frame_and_draws_the_measured_last(tmp_path):
    scene, recordings = swung(tmp_path, "effort measured")
    result = result_of(WindowModel(scene, recordings, 0.3), [COULOMB], scene)
    page = comparison_html(result, scene, recordings)
    [(play, says, order)] = re.findall(
        r"play: (\[.*?\]), says: (\{.*?\]\}), order: (\[.*?\])", page
    )
    assert json.loads(order)[-1] == "measured"
    play, says = np.array(json.loads(play)), json.loads(says)
    assert (np.diff(play) > 0.0).all()
    [series] = result.series
    off = np.abs(series.measured - series.before)
    for text, error in zip(says["shown_time"], says["error_before"], strict=True):
        first = series.starts[int(re.search(r"start (\d+) of", text).group(1)) - 1]
        late = np.abs(series.time[first:] - float(text.split(" s")[0]))
        row = first + np.argmin(late)
        value, unit = re.match(r"([\d.e-]+) (m?rad) \(p.j1\)", error).groups()
        shown = float(value) * (1e-3 if unit == "mrad" else 1.0)
        assert shown == pytest.approx(off[row], rel=6e-3)
    # What moves: the animation's frames hold the simulated angle at that time.
    parts = re.findall(r"base64,([A-Za-z0-9+/=]+)", page)
    blob = b"".join(base64.b64decode(each) for each in parts)
    assert blob.find(b"/before/") < blob.find(b"/measured/")


@pytest.mark.parametrize("at", [(0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.2, -0.2)])
def test_what_stands_still_does_not_hide_what_moves(at):
    """A leg beside its base is seen from its own side of it."""
    target = np.array([*at, -0.2])
    side = _side(target, [np.array([0.05, 0.0, 0.0]), np.array([-0.05, 0.0, 0.1])])
    assert side[:2] @ np.array(at) > 0.6 * np.linalg.norm(at) * np.linalg.norm(side[:2])
    assert side[2] > 0.0
    np.testing.assert_array_equal(_side(target, []), _side(target, [target]))


def test_what_the_page_shows_is_written_as_mcap_too(tmp_path):
    from mcap.reader import make_reader
    from test_mcap_file import messages  # Skips without the libraries.

    scene, recordings = swung(tmp_path, "servo")
    result = result_of(WindowModel(scene, recordings, 0.3), [COULOMB], scene)
    named = NamedEffect(
        "joint_coulomb_friction", ("p.j1",), {"coulomb": Estimate(0.35, 0.01, "N m")},
        "Joint p.j1 has friction.", Evidence(9.0, 1.0, "", np.nan),
    )  # fmt: skip
    result = replace(result, effects=[named])
    assert write_comparison(result, scene, recordings, tmp_path / "c.mcap") == []
    found = messages(tmp_path / "c.mcap")
    with open(tmp_path / "c.mcap", "rb") as file:
        stamps = [
            message.log_time
            for _, _, message in make_reader(file).iter_messages(log_time_order=False)
        ]
    assert stamps == sorted(stamps)  # A player reads it as it is written.
    [series] = result.series
    for who in ("measured", "before", "after"):
        times, states = found[f"/{who}/joint_states"]
        y = getattr(series, who)
        there = np.isfinite(y)
        np.testing.assert_array_equal([m.position[0] for m in states], y[there])
        np.testing.assert_allclose(
            1e-9 * np.array(times), series.time[there], atol=1e-9
        )
        (shapes,) = found[f"/{who}/shapes"][1]
        assert {m.header.frame_id.split("/")[0] for m in shapes.markers} == {who}
    still = replace(result, series=[])
    (note,) = write_comparison(still, scene, recordings, tmp_path / "no.mcap")
    assert "no motion was simulated" in note


def test_a_large_mesh_is_shown_by_a_coarse_one(tmp_path):
    ball = trimesh.creation.icosphere(6, 0.1)
    ball.apply_translation([0.0, 0.0, -0.3])
    ball.export(tmp_path / "ball.obj")
    vertices, faces = coarse(tmp_path / "ball.obj")
    assert len(faces) < 0.25 * len(ball.faces)
    far = np.linalg.norm(vertices - [0.0, 0.0, -0.3], axis=1)
    assert (np.abs(far - 0.1) < 0.2 / 48).all()
    left = trimesh.Trimesh(vertices, faces)
    assert abs(left.area / ball.area - 1.0) < 0.1  # No holes.
    scene, recordings = swung(tmp_path, "effort command")
    model = WindowModel(scene, recordings, 0.3)
    plain_page = comparison_html(result_of(model, [], scene), scene, recordings)
    file = next(tmp_path.glob("*.urdf"))
    shape = '<visual><geometry><mesh filename="ball.obj"/></geometry></visual></link>'
    file.write_text(file.read_text().replace("</link>", shape))
    page = comparison_html(result_of(model, [], scene), scene, recordings)
    more = len(page) - len(plain_page)
    assert 0 < more < (tmp_path / "ball.obj").stat().st_size

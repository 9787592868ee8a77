"""Walls that free bodies run against and that stand elsewhere, in closed form."""

from pathlib import Path

import numpy as np
import pytest
from ball_table import write_ball_table

from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.numerics.free_body import FreeBody
from makebreak.gap.residuals.contact import _patches
from makebreak.gap.simulation.free_windows import FreeBodyModel
from makebreak.gap.simulation.met_faces import met_faces
from makebreak.gap.workflow import run_gap
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

MASS, RADIUS, STIFFNESS, G, NOISE = 0.1, 0.04, 2e5, 9.81, 2e-4
SPRING = "drake:point_contact_stiffness"  # Two in series.
WALL = 0.5  # Of its face, along x.


def write_scene(folder: Path) -> Path:
    """A ball on a table, in front of a wall; no friction, nothing is lost."""
    surface = (
        '<drake:proximity_properties xmlns:drake="drake.mit.edu">'
        "<drake:mu_static>0</drake:mu_static><drake:mu_dynamic>0</drake:mu_dynamic>"
        f"<{SPRING}>{2 * STIFFNESS}</{SPRING}>"
        "<drake:hunt_crossley_dissipation>0</drake:hunt_crossley_dissipation>"
        "</drake:proximity_properties>"
    )
    i = 0.4 * MASS * RADIUS**2
    moments = f"<ixx>{i}</ixx><iyy>{i}</iyy><izz>{i}</izz>"
    inertial = f"<inertial><mass>{MASS}</mass><inertia>{moments}</inertia></inertial>"
    shapes = {
        "ball": (inertial, "0 0 0", f"<sphere><radius>{RADIUS}</radius></sphere>"),
        "table": ("", "0 0 -0.1", "<box><size>4 4 0.2</size></box>"),
        "wall": ("", f"{WALL + 0.05} 0 0.2", "<box><size>0.1 4 0.4</size></box>"),
    }
    for name, (mass, place, shape) in shapes.items():
        (folder / f"{name}.sdf").write_text(
            f'<sdf version="1.9"><model name="{name}"><link name="{name}">{mass}'
            f'<collision name="c"><pose>{place} 0 0 0</pose><geometry>{shape}'
            f"</geometry>{surface}</collision></link></model></sdf>"
        )
    lines = ["directives:"]
    for name in ("table", "wall"):
        lines.append(f"  - add_model: {{name: {name}, file: {name}.sdf}}")
        lines.append(f"  - add_weld: {{parent: world, child: {name}::{name}}}")
    lines += ["  - add_model: {name: ball, file: ball.sdf}", "plant: {time_step: 0.0}"]
    scene = folder / "scene.yaml"
    scene.write_text("\n".join(lines) + "\n")
    return scene


def write_log(folder: Path, off: float) -> Path:
    """Eight balls slide into the wall, which stands `off` farther. It pushes each back
    for half a period of the ball on its spring, and gives back all of its speed."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 1.2, 1.0 / 120.0)
    omega, rows = np.sqrt(STIFFNESS / MASS), []
    for episode in range(8):
        v, start = rng.uniform(0.4, 1.2), rng.uniform(0.05, 0.25)
        face = WALL + off - RADIUS
        since = t - (face - start) / v
        x = np.where(
            since < 0.0, start + v * t,
            np.where(
                since < np.pi / omega, face + v / omega * np.sin(omega * since),
                face - v * (since - np.pi / omega),
            ),
        )  # fmt: skip
        y = 0.1 * rng.normal() + 0.1 * rng.normal() * t
        z = np.full(len(t), RADIUS - MASS * G / STIFFNESS)
        place = np.column_stack([x, y, z]) + NOISE * rng.normal(size=(len(t), 3))
        rows.append(np.column_stack([t, np.full(len(t), episode), place]))
    return write_ball_table(folder / "log.csv", rows)


@pytest.mark.slow
@pytest.mark.parametrize("off", [0.012, -0.06])
def test_a_wall_that_a_ball_meets_elsewhere_is_named_with_how_far(tmp_path, off):
    result = run_gap(write_scene(tmp_path), [write_log(tmp_path, off)])
    (effect,) = result.effects
    assert (effect.kind, list(effect.at)) == ("wall_position", ["wall.wall"])
    # Of some twenty samples beside each of five impacts.
    assert effect.parameters["x"].value == pytest.approx(off, abs=1.5e-4)
    # Lower or higher it would stand in the ball's way as before.
    assert not effect.indistinguishable_from
    assert result.verdict == "gap_named"


def test_a_wall_that_is_run_against_is_not_searched_for_patches_of_friction(tmp_path):
    """Patches are of level ground; their search takes most of the time."""
    log = write_log(tmp_path, 0.0)
    recordings, _ = condition(read_recordings([log]), False)
    model = FreeBodyModel(read_scene(write_scene(tmp_path)), recordings)
    assert {at for at, _ in model.met} == {"wall.wall"}
    mu = Effect("contact_friction", ["ball.ball~wall.wall"], {"friction": 0.3})
    runs = model.runs
    assert _patches(model, "ball.ball~wall.wall", [mu], np.ones(3)) == []
    assert model.runs == runs


def test_a_wall_where_the_scene_has_it_is_no_gap(tmp_path):
    result = run_gap(write_scene(tmp_path), [write_log(tmp_path, 0.0)])
    assert (result.verdict, result.effects) == ("no_gap", [])


@pytest.mark.slow
def test_a_friction_of_which_the_scene_has_none_is_found(tmp_path):
    """Balls are set down with a speed and no spin: mu g slows each until it rolls, with
    5/7 of the speed. In a scene without friction it would go on as it was."""
    rng, t, mu = np.random.default_rng(0), np.arange(0.0, 1.2, 1.0 / 120.0), 0.08
    rows = []
    for episode in range(8):
        v, way = rng.uniform(0.6, 1.2), rng.uniform(0.5, 1.5) * np.pi
        ends = 2.0 / 7.0 * v / (mu * G)
        slides = np.minimum(t, ends)
        far = v * slides - 0.5 * mu * G * slides**2 + 5.0 / 7.0 * v * (t - slides)
        place = far[:, None] * [np.cos(way), np.sin(way), 0.0]
        place[:, 2] = RADIUS - MASS * G / STIFFNESS
        place += NOISE * rng.normal(size=place.shape)
        rows.append(np.column_stack([t, np.full(len(t), episode), place]))
    result = run_gap(
        write_scene(tmp_path), [write_ball_table(tmp_path / "log.csv", rows)]
    )
    (effect,) = result.effects
    assert effect.kind == "contact_friction"
    # The last fifth of each is held out.
    assert effect.parameters["friction"].value == pytest.approx(mu, rel=0.05)


def test_a_face_is_where_the_nearest_approach_ended_unless_it_stayed_there():
    fixed = np.array([[*np.eye(3).ravel(), 1.0, 0.0, 0.0, 0.2, 2.0, 2.0]])
    body = FreeBody(
        1.0, np.zeros(3), np.eye(3), np.zeros(3), np.array([[0.0, 0.0, 0.0, 0.1]]),
        fixed, np.zeros((1, 1, 6)), np.zeros((1, 1)), np.zeros((0, 6)), np.zeros(3),
    )  # fmt: skip

    def path(x) -> np.ndarray:
        pose = np.zeros((len(x), 7))
        pose[:, 0], pose[:, 4] = 1.0, x
        return pose

    there, back = np.linspace(0.0, 0.65, 30), np.linspace(0.65, 0.4, 10)
    deeper = np.concatenate([np.linspace(0.0, 0.73, 30), np.linspace(0.73, 0.5, 9)])
    stops = np.concatenate([there, np.full(10, 0.65)])
    bounces = np.concatenate([there, back])
    # The face at 0.8 looks along -x: what comes to 0.65 with 0.1 ends 5 cm before it.
    assert met_faces(body, ["wall"], [path(stops)]) == {}
    found = met_faces(body, ["wall"], [path(bounces)])
    assert found == {("wall", "x"): pytest.approx(-0.05)}
    found = met_faces(body, ["wall"], [path(bounces), path(deeper)])
    assert found == {("wall", "x"): pytest.approx(0.03)}

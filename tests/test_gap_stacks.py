"""One box on another: the fast steps against Drake's, and who carries whom."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.free_body import simulate_all
from makebreak.gap.residuals import contact
from makebreak.gap.residuals.objects import FlightProblem
from makebreak.gap.simulation.free_bodies import FreeBodiesScene
from makebreak.gap.simulation.free_body import AT_CORNERS, REST_DEPTH
from makebreak.gap.simulation.scene_simulation import SceneSimulation, SimulationConfig
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import InitialSection, read_scene

LOW, TOP, G = "low.low", "top.top", 9.81
HALF = {"low": (0.2, 0.18, 0.03), "top": (0.04, 0.03, 0.025)}
MASS = {"low": 0.9, "top": 0.3}
MU, MU_TABLE = 0.25, 0.3  # Of top on low; of low on the table.
NOISE = 3e-4


def write_scene(folder: Path, top: str = "", mu: float = MU) -> Path:
    """top: another shape of what lies on the lower box."""

    def write(name: str, shape: str, friction: float, inside: str = "") -> None:
        (folder / f"{name}.sdf").write_text(
            f'<sdf version="1.9"><model name="{name}"><link name="{name}">{inside}'
            f'<collision name="c"><geometry>{shape}</geometry>'
            '<drake:proximity_properties xmlns:drake="drake.mit.edu">'
            f"<drake:mu_static>{friction}</drake:mu_static>"
            f"<drake:mu_dynamic>{friction}</drake:mu_dynamic>"
            "<drake:point_contact_stiffness>4e4</drake:point_contact_stiffness>"
            "<drake:hunt_crossley_dissipation>1</drake:hunt_crossley_dissipation>"
            "</drake:proximity_properties></collision></link></model></sdf>"
        )

    def size(half) -> str:
        return f"<box><size>{' '.join(str(2.0 * x) for x in half)}</size></box>"

    write("table", size((3.0, 3.0, 0.1)), MU_TABLE)
    # Of a pair it is the harmonic mean.
    own = {"low": MU_TABLE, "top": mu * MU_TABLE / (2.0 * MU_TABLE - mu)}
    for name, half in HALF.items():
        a, b, c = (x * x for x in half)
        m = MASS[name]
        moments = zip("xyz", (b + c, a + c, a + b), strict=True)
        inertia = "".join(f"<i{k}{k}>{m * v / 3.0}</i{k}{k}>" for k, v in moments)
        shape = top if top and name == "top" else size(half)
        write(
            name, shape, own[name],
            f"<inertial><mass>{m}</mass><inertia>{inertia}</inertia></inertial>",
        )  # fmt: skip
    at = [0.0, 0.0, -0.1]
    scene = {
        "directives": [
            {"add_model": {"name": "table", "file": "table.sdf"}},
            {"add_weld": {"parent": "world", "child": "table::table",
                          "X_PC": {"translation": at}}},
            {"add_model": {"name": "low", "file": "low.sdf"}},
            {"add_model": {"name": "top", "file": "top.sdf"}},
        ],
        "plant": {"time_step": 0.0},
    }  # fmt: skip
    file = folder / "scene.yaml"
    file.write_text(yaml.safe_dump(scene))
    return file


def slid(folder: Path, mu: float = MU, start: float = 0.0):
    """Boxes at rest, of which the upper one is nudged along x: it slides until friction
    has stopped it, and the lower one, which the table holds, stays. Places are those of
    contact that gives nothing. start: of the upper one [m]."""
    rng, t, rows = np.random.default_rng(0), np.arange(0.0, 1.0, 1.0 / 120.0), []
    for episode in range(6):
        v = rng.uniform(0.2, 0.4)
        moves = np.minimum(t, v / mu / G)
        x = start + v * moves - 0.5 * mu * G * moves**2
        poses = np.zeros((len(t), 2, 7))
        poses[:, :, 3] = 1.0  # x, y, z, qw, qx, qy, qz.
        poses[:, 0, 2] = HALF["low"][2]
        poses[:, 1, 0] = x
        poses[:, 1, 2] = 2.0 * HALF["low"][2] + HALF["top"][2]
        poses += NOISE * rng.normal(size=poses.shape)
        own = np.column_stack([np.full(len(t), episode), t])
        rows.append(np.column_stack([own, poses.reshape(len(t), 14)]))
    names = [f"{b}.{a}" for b in (LOW, TOP) for a in "x y z qw qx qy qz".split()]
    file = folder / "log.csv"
    header = ",".join(["episode", "time", *names])
    np.savetxt(file, np.concatenate(rows), delimiter=",", header=header, comments="")
    recordings, _ = condition(read_recordings([file]), False)
    return recordings


def test_a_ball_is_thrown_onto_a_box_that_flies_as_in_drakes_plant(tmp_path):
    """Both are in the air, turned and turning; Drake's point of a ball and a box is the
    same as that of a sphere of a face."""
    radius = 0.03
    ball = f"<sphere><radius>{radius}</radius></sphere>"
    scene = read_scene(write_scene(tmp_path, ball))
    names = "qw qx qy qz x y z wx wy wz vx vy vz".split()
    c, s = np.cos(0.2), np.sin(0.2)
    up = np.array([0.0, -np.sin(0.4), np.cos(0.4)])  # The box's, turned about x.
    at = np.array([0.02, 0.0, 1.0]) + up * (HALF["low"][2] + radius + 0.01)
    start = np.array(
        [[c, s, 0, 0, 0.0, 0.0, 1.0, 0.3, -0.5, 0.4, 0.1, 0.0, 0.2],
         [1.0, 0, 0, 0, *at, 5.0, -8.0, 3.0, 0.3, 0.6, -1.2]]
    )  # fmt: skip
    initial = InitialSection(
        poses={LOW: list(start[0, :7]), TOP: list(start[1, :7])},
        body_velocities={LOW: list(start[0, 7:]), TOP: list(start[1, 7:])},
    )
    times = np.linspace(0.0, 0.15, 16)
    drake = SceneSimulation(scene, SimulationConfig(accuracy=1e-7, least_step_sec=1e-9))
    channels = [f"{body}.{n}" for body in (LOW, TOP) for n in names]
    want = drake.run(initial, times, channels).reshape(-1, 2, 13)
    assert not drake.failure
    numbers = FreeBodiesScene(scene)
    numbers.carries(TOP, LOW)
    got = simulate_all(numbers.bodies(), start, times, tol=1e-8)
    bounced = want[-1, 1, 12] - want[0, 1, 12] + G * times[-1]
    assert bounced > 0.5  # [m/s]
    assert np.abs(want[-1, 0, 7:10] - want[0, 0, 7:10]).max() > 0.5  # And turned it.
    # Of 0.2 m, and of a stiff contact of some milliseconds that both step to 1e-7.
    np.testing.assert_allclose(got[:, :, 4:7], want[:, :, 4:7], atol=5e-5)
    np.testing.assert_allclose(got[:, :, 10:], want[:, :, 10:], atol=2e-3)
    # A contact point that is off by the depth would be 1 % of the 5 rad/s it changes.
    np.testing.assert_allclose(got[:, :, 7:10], want[:, :, 7:10], atol=0.02)


def test_a_stack_is_at_the_noise_with_its_own_friction(tmp_path):
    scene = read_scene(write_scene(tmp_path))
    model = FlightProblem(scene, slid(tmp_path))
    assert model._numbers.rides(TOP, LOW) and not model._numbers.rides(LOW, TOP)
    left = [np.sqrt(np.mean(model.residual(e) ** 2)) for e in (
        [], [Effect("contact_friction", [f"{TOP}~{LOW}"], {"friction": 0.1})],
    )]  # fmt: skip
    assert left[0] < 1.15 and left[1] > 2.0


@pytest.mark.slow
def test_the_friction_of_a_pair_is_that_of_the_one_on_top(tmp_path, monkeypatch):
    """Of the lower one it would change how that slides on the table, too."""
    monkeypatch.setattr(contact, "_patches", lambda *_: [])  # They take minutes.
    scene = read_scene(write_scene(tmp_path, mu=0.2))
    model = FlightProblem(scene, slid(tmp_path))
    found = contact.contact_candidates(model, (), model.base())
    pairs = {c.at[0] for c in found if c.kind == "contact_friction"}
    assert f"{TOP}~{LOW}" in pairs and f"{LOW}~{TOP}" not in pairs
    # Nor that of the upper one and the table, which is the table's.
    assert model.never_met == {f"{TOP}~table.table"} and not pairs & model.never_met
    true = Effect("contact_friction", [f"{TOP}~{LOW}"], {"friction": MU})
    assert np.sqrt(np.mean(model.residual([true]) ** 2)) < 1.15
    bodies = model._numbers.bodies([true])
    assert bodies.carried[-1, 0, 3] == pytest.approx(MU)
    assert bodies.each[0].pairs[0, 0, 3] == pytest.approx(MU_TABLE)
    # Of a face's load its corners carry their share, on a box as on the ground; and a
    # stack that nothing hits is no stiffer than it need be.
    law = bodies.carried[-32:, 0, 0]  # 8 corners, and 4 within each of 6 faces.
    assert law[0] / (law[0] + law[-1]) == pytest.approx(AT_CORNERS)
    assert 0.5 * law.sum() == pytest.approx(MASS["top"] * G / REST_DEPTH)


def test_corners_beyond_an_edge_are_left_to_drake(tmp_path):
    scene = read_scene(write_scene(tmp_path))
    with pytest.raises(DoesNotFit, match="come near each other"):
        FlightProblem(scene, slid(tmp_path, start=HALF["low"][0] - 0.02))

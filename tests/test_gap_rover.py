"""A rover that drives and turns on wheels, which are cylinders in its model."""

import csv
from types import SimpleNamespace

import numpy as np
import pytest

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.lying_on_faces import lying_on_faces, point_on_face
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.contact_windows import PushWindows
from makebreak.gap.simulation.face_supports import LiesOn
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.scene import read_scene
from makebreak.models.scene_schema import InitialSection

RADIUS, WIDTH, TRACK, SEC = 0.06, 0.03, 0.3, 5.0
JOINTS = tuple(f"rover.{side}_joint" for side in ("left", "right"))
POSE = ("qw", "qx", "qy", "qz", "x", "y", "z")
SCENE = """\
directives:
- add_model: {name: floor, file: floor.sdf}
- add_weld: {parent: world, child: floor::floor}
- add_model: {name: rover, file: rover.sdf}
plant: {time_step: 0.0005}
actuation: {type: effort, joints: [rover.left_joint, rover.right_joint]}
"""


def sdf(name: str, inner: str) -> str:
    return (
        '<?xml version="1.0"?><sdf version="1.9" xmlns:drake="http://drake.mit.edu">'
        f'<model name="{name}">{inner}</model></sdf>'
    )


def collision(name: str, shape: str, pose: str, mu: float) -> str:
    return (
        f'<collision name="{name}"><pose>{pose}</pose><geometry>{shape}</geometry>'
        f"<drake:proximity_properties><drake:mu_dynamic>{mu}</drake:mu_dynamic>"
        f"<drake:mu_static>{mu}</drake:mu_static><drake:point_contact_stiffness>4e4"
        "</drake:point_contact_stiffness><drake:hunt_crossley_dissipation>1"
        "</drake:hunt_crossley_dissipation></drake:proximity_properties></collision>"
    )


def inertial(mass: float, x: float, y: float, z: float) -> str:
    return (
        f"<inertial><mass>{mass}</mass><inertia><ixx>{x}</ixx><iyy>{y}</iyy>"
        f"<izz>{z}</izz></inertia></inertial>"
    )


def rover(wheel: str) -> str:
    """With wheels of these collision shapes, and a ball that slides before them."""
    ball = f"<sphere><radius>{0.5 * RADIUS}</radius></sphere>"
    ball = collision("ball", ball, f"0.15 0 {-0.5 * RADIUS} 0 0 0", 0.05)
    parts = f'<link name="base">{inertial(5.0, 0.03, 0.07, 0.09)}{ball}</link>'
    for side, y in (("left", TRACK / 2.0), ("right", -TRACK / 2.0)):
        parts += (
            f'<link name="{side}"><pose>0 {y} 0 0 0 0</pose>'
            f'{inertial(0.4, 4e-4, 7e-4, 4e-4)}{wheel}</link><joint name="{side}_joint"'
            f' type="revolute"><parent>base</parent><child>{side}</child><axis><xyz>0 1'
            " 0</xyz><limit><effort>5</effort></limit></axis></joint>"
        )
    return sdf("rover", parts)


@pytest.fixture(scope="module")
def problem(tmp_path_factory) -> ContactProblem:
    """Driven in a world whose wheels touch at both ends of their width."""
    folder = tmp_path_factory.mktemp("rover")
    box = "<box><size>9 9 0.2</size></box>"
    floor = (
        f'<link name="floor">{collision("floor", box, "0 0 -0.1 0 0 0", 0.8)}</link>'
    )
    (folder / "floor.sdf").write_text(sdf("floor", floor))
    (folder / "scene.yaml").write_text(SCENE)
    shape = f"<sphere><radius>{RADIUS}</radius></sphere>"
    ends = "".join(
        collision(f"end{k}", shape, f"0 {y} 0 0 0 0", 0.8)
        for k, y in enumerate((-WIDTH / 2.0, WIDTH / 2.0))
    )
    (folder / "rover.sdf").write_text(rover(ends))
    time = 0.005 * np.arange(int(SEC / 0.005))
    # Ahead, and about itself: wheels that turn are dragged along their width.
    ahead, turn = 0.2 * np.sin(3.0 * time), 0.28 * np.cos(2.0 * time)
    given = {
        f"{joint}.effort_command": ahead + sign * turn
        for joint, sign in zip(JOINTS, (-1.0, 1.0), strict=True)
    }
    places = [f"{joint}.position" for joint in JOINTS]
    poses = [f"rover.base.{name}" for name in POSE]
    world = SceneSimulation(folder / "scene.yaml")
    start = InitialSection(
        {}, {}, {"rover.base": [1.0, 0, 0, 0, 0, 0, RADIUS - 2e-4]}, {}
    )
    seen = world.run(start, time, [*places, *poses], Commands(time, given))
    assert not world.failure
    # Drake lets the length of its quaternions drift.
    seen[:, 2:6] /= np.linalg.norm(seen[:, 2:6], axis=1)[:, None]
    rng = np.random.default_rng(5)
    seen += rng.normal(size=seen.shape) * ([2e-4] * 2 + [5e-4] * 4 + [3e-4] * 3)
    with (folder / "log.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["time", *places, *poses, *given])
        for k, row in enumerate(seen):
            pose = [f"{x:.7g}" if k % 2 == 0 else "" for x in row[2:]]
            efforts = [f"{u[k]:.7g}" for u in given.values()]
            table.writerow(
                [f"{time[k]:.4f}", *(f"{x:.7g}" for x in row[:2]), *pose, *efforts]
            )
    shape = f"<cylinder><radius>{RADIUS}</radius><length>{WIDTH}</length></cylinder>"
    wheel = collision("wheel", shape, "0 0 0 1.5707963267949 0 0", 0.8)
    (folder / "rover.sdf").write_text(rover(wheel))
    return ContactProblem(
        read_scene(folder / "scene.yaml"), read_recordings([folder / "log.csv"])
    )


def rms(windows: PushWindows) -> float:
    errors = windows.errors(windows.simulate(()))
    return float(np.sqrt(np.mean(np.concatenate([e.ravel() for e in errors]) ** 2)))


@pytest.mark.slow
def test_wheels_touch_along_their_width(problem):
    lying, names = problem.lying(), problem.shapes.names
    assert {(names[k.body], names[k.ground]) for k in lying} == {
        ("rover.left", "floor.floor"), ("rover.right", "floor.floor")
    }  # fmt: skip
    assert all(k.on_side for k in lying)
    says = [f.says for f in point_on_face(problem, lying)]
    assert len(says) == 2 and all("two spheres of its own radius" in x for x in says)
    # A point of Drake's that jumps from one end to the other turns it otherwise.
    given = problem.scene, problem.recordings, None
    assert rms(PushWindows(*given, lying)) < 1.2
    assert rms(PushWindows(*given, ())) > 2.0


@pytest.mark.parametrize("fixed, stands", [({2}, True), (set(), False)])
def test_only_on_what_is_fixed_links_touch_with_corners(fixed, stands):
    """A link that a corner of another moving body meets is pushed, and lies on none."""
    corner = SimpleNamespace(is_corner=True, rim=False, geometry=None)
    slot = SimpleNamespace(a=1, b=2, key=(0, 0))
    contacts = SimpleNamespace(
        shapes=SimpleNamespace(
            anchored=fixed, points=[corner], surfaces=[SimpleNamespace(geometry=None)]
        ),
        slots=[slot], _masks=[np.ones(3, bool)], _pairs_met=[],
        _pair_of=lambda s: (s.a, s.b), _is_of_a_free_body=lambda pair: False,
        scene=SimpleNamespace(plant=SimpleNamespace(contact_model="point")),
    )  # fmt: skip
    found = lying_on_faces(contacts)
    assert found == [LiesOn(1, 2, is_tool=True)] * stands

"""What slides on joints of its own, and is pushed: a block on a rail, in closed form.

No force but the effort of the finger's drive is measured.
"""

from pathlib import Path

import numpy as np
import pytest

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.impacts import walls_of
from makebreak.gap.residuals.pressing import push_each_other
from makebreak.gap.workflow import problem_for, run_gap
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

FINGER, MASS, DAMPING, STIFFNESS = 0.3, 0.5, 8.0, 1e5
RADIUS, HALF = 0.01, 0.03
NOISE = {"position": 1e-5, "effort": 0.02}
LINK = """<link name="{0}"><pose>{1} 0 0 0 0 0</pose><inertial><mass>{2}</mass><inertia>
<ixx>1e-3</ixx><iyy>1e-3</iyy><izz>1e-3</izz></inertia></inertial>{3}</link>"""
SHAPE = """<collision name="{0}"><geometry>{1}</geometry><drake:proximity_properties>
<drake:mu_static>0.5</drake:mu_static><drake:mu_dynamic>0.5</drake:mu_dynamic>
<drake:point_contact_stiffness>2e5</drake:point_contact_stiffness>
<drake:hunt_crossley_dissipation>0</drake:hunt_crossley_dissipation>
</drake:proximity_properties></collision>"""
JOINT = """<joint name="x" type="prismatic"><parent>{0}</parent><child>{1}</child>
<axis><xyz>1 0 0</xyz><dynamics><damping>{2}</damping></dynamics>{3}</axis></joint>"""
SDF = (
    '<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="{0}">{1}</model></sdf>'
)
SCENE = """directives:
  - add_model: {name: finger, file: finger.sdf}
  - add_weld: {parent: world, child: 'finger::base'}
  - add_model: {name: block, file: block.sdf}
  - add_weld: {parent: world, child: 'block::base'}
plant: {time_step: 0.001, contact_model: point, discrete_contact_approximation: lagged}
actuation: {type: effort, joints: [finger.x]}
"""


def write_scene(folder: Path, mass: float) -> Path:
    """A finger with a drive, and a block of this mass on a rail that damps."""
    tip = SHAPE.format("tip", f"<sphere><radius>{RADIUS}</radius></sphere>")
    box = SHAPE.format("box", f"<box><size>{2 * HALF} 0.06 0.06</size></box>")
    # A sheet on the block is one rigid body with it.
    sheet = LINK.format("sheet", 0.0, 1e-6, "")
    weld = (
        '<joint name="glue" type="fixed"><parent>body</parent><child>sheet</child>'
        "</joint>"
    )
    free = "<limit><effort>0</effort></limit>"
    finger = LINK.format("tip", 0.0, FINGER, tip) + JOINT.format("base", "tip", 0.0, "")
    block = (
        LINK.format("body", 0.0, mass, "") + sheet.replace("</link>", box + "</link>")
        + weld + JOINT.format("base", "body", DAMPING, free)
    )  # fmt: skip
    base = '<link name="base"/>'
    (folder / "finger.sdf").write_text(SDF.format("finger", base + finger))
    (folder / "block.sdf").write_text(SDF.format("block", base + block))
    scene = folder / "scene.yaml"
    scene.write_text(SCENE)
    return scene


def write_log(folder: Path, rng: np.random.Generator, touching: bool = True) -> Path:
    """The finger pushes the block along, now faster, now slower, and never lets go; in
    every third episode, or all, it moves alone, which tells its own mass."""
    rows = []
    for episode in range(6):
        pushes = touching and episode % 3 != 2
        t = np.arange(0.0, 2.0, 0.002)
        w, phase = rng.uniform(6.0, 10.0), rng.uniform(0.0, 6.0)
        v = 0.3 + 0.22 * np.sin(w * t + phase)
        a = 0.22 * w * np.cos(w * t + phase)
        x = 0.3 * t - 0.22 / w * np.cos(w * t + phase)
        force = MASS * a + DAMPING * v
        assert force.min() > 0.0
        block = (
            x + RADIUS + HALF - force / STIFFNESS if pushes else np.full(len(t), 2.0)
        )
        y = np.column_stack([x, block, FINGER * a + force * pushes])
        noise = np.array([NOISE["position"], NOISE["position"], NOISE["effort"]])
        y += noise * rng.normal(size=y.shape)
        rows.append(np.column_stack([np.full(len(t), episode), t, y]))
    header = "episode,time,finger.x.position,block.x.position,finger.x.effort_measured"
    file = folder / "log.csv"
    np.savetxt(file, np.concatenate(rows), delimiter=",", header=header, comments="")
    return file


@pytest.fixture
def rng():
    return np.random.default_rng(61)


def test_a_block_on_a_rail_is_an_object_that_is_pushed(tmp_path, rng):
    scene = read_scene(write_scene(tmp_path, MASS))
    recordings = read_recordings([write_log(tmp_path, rng)])
    dynamics = SceneDynamics(scene)
    assert push_each_other(dynamics, recordings)
    problem, _ = problem_for(scene, recordings, dynamics)
    assert isinstance(problem, ContactProblem)
    # Its rigid body has one mass, and the finger, which a drive moves, is a robot's.
    ((body, (slides, turns)),) = problem.objects.items()
    index = problem.joints["block.x"][1]
    assert (body, list(slides), list(turns)) == ("block.body", [index], [])
    assert not any("block." in name for name in problem.nuisances().names)
    # It has no motor, and on a rail it does not matter where its centre of mass is.
    tried = {(kind, at) for kind, at, *_ in problem._trials()}
    assert ("rotor_inertia", "finger.x") in tried
    assert not {("rotor_inertia", "block.x"), ("object_com", "block.body")} & tried
    # Noise of its acceleration counts by the mass that is tried.
    heavy = Effect("object_mass", ["block.body"], {"mass": 4.0 * MASS})
    other = problem.joints["finger.x"][1]
    for k, ratio in ((index, 0.25), (other, 1.0)):
        own, weighed = (problem._root(e)[:, k, k] for e in ((), [heavy]))
        np.testing.assert_allclose(weighed / own, ratio, rtol=0.01)
    # Apart from each other they push nothing.
    apart = read_recordings([write_log(tmp_path, rng, touching=False)])
    assert not push_each_other(dynamics, apart)
    # And of its own equation each mass is weighed by its own noise: that of a lighter
    # body is smaller as a whole.
    rows = problem.channel_of_rows() == index
    pairs = problem.weighed_alike((), [heavy])
    assert len(pairs) == 2 and rows.any()
    for pair in pairs:
        for left, effects in zip(pair, ((), [heavy]), strict=True):
            own = problem.residual(effects)
            np.testing.assert_array_equal(left[rows], own[rows])
    assert any((two != problem.residual([heavy])).any() for _, two in pairs)


def test_a_block_of_the_modelled_mass_is_no_gap(tmp_path, rng):
    scene = write_scene(tmp_path, MASS)
    result = run_gap(scene, [write_log(tmp_path, rng)])
    assert result.verdict == "no_gap", result.says


@pytest.mark.parametrize("factor", [pytest.param(0.75, marks=pytest.mark.slow), 1.3])
def test_the_mass_of_a_block_on_a_rail_is_named(tmp_path, rng, factor):
    scene = write_scene(tmp_path, factor * MASS)
    result = run_gap(scene, [write_log(tmp_path, rng)])
    assert result.verdict in ("gap_named", "ambiguous"), result.says
    (effect,) = result.effects
    assert (effect.kind, effect.at) == ("object_mass", ("block.body",))
    assert effect.parameters["mass"].value == pytest.approx(MASS, rel=0.03)


@pytest.mark.parametrize(
    ("seconds", "motors", "counts"),
    [(0.02, "finger.x", True), (0.0, "finger.x", False),
     (0.02, "finger.x, block.x", False)],
)  # fmt: skip
def test_one_short_push_of_an_object_counts(tmp_path, seconds, motors, counts):
    """What has a motor of its own is no object: limbs pass close by each other."""
    scene = write_scene(tmp_path, MASS)
    scene.write_text(SCENE.replace("[finger.x]", f"[{motors}]"))
    t = np.arange(0.0, 10.0, 0.002)
    apart = np.where((t > 5.0) & (t < 5.0 + seconds), 0.0, 0.05)
    x = np.column_stack([t, np.zeros(len(t)), RADIUS + HALF + apart])
    file = tmp_path / "log.csv"
    header = "time,finger.x.position,block.x.position"
    np.savetxt(file, x, delimiter=",", header=header, comments="")
    dynamics = SceneDynamics(read_scene(scene))
    assert push_each_other(dynamics, read_recordings([file])) is counts


def test_the_ground_in_a_robots_own_file_is_no_part_of_its_base(tmp_path):
    """A pedestal is, on which a joint's parent is welded."""
    box = SHAPE.format("box", "<box><size>0.1 0.1 0.1</size></box>")
    fixed = (
        '<joint name="{1}_at" type="fixed"><parent>{0}</parent><child>{1}</child>'
        "</joint>"
    )
    for parent, is_wall in (("world", True), ("base", False)):
        text = (
            '<link name="base"/>' + LINK.format("arm", 0.0, 1.0, box)
            + LINK.format("other", 1.0, 1.0, box) + JOINT.format("base", "arm", 0, "")
            + fixed.format("world", "base") + fixed.format(parent, "other")
        )  # fmt: skip
        (tmp_path / "robot.sdf").write_text(SDF.format("robot", text))
        scene = tmp_path / "scene.yaml"
        scene.write_text(
            "directives:\n  - add_model: {name: robot, file: robot.sdf}\n"
            "actuation: {type: effort, joints: [robot.x]}\n"
        )
        walls = walls_of(SceneDynamics(read_scene(scene)))
        assert (walls is not None) is is_wall


def test_shapes_of_links_that_one_joint_moves_often_overlap(tmp_path, rng):
    """And are no push: here the block's rail is mounted on the finger."""
    scene = write_scene(tmp_path, MASS)
    recordings = read_recordings([write_log(tmp_path, rng)])
    assert push_each_other(SceneDynamics(read_scene(scene)), recordings)
    text = scene.read_text().replace(
        "{parent: world, child: 'block::base'}",
        "{parent: 'finger::tip', child: 'block::base'}",
    )
    scene.write_text(text)
    file = tmp_path / "log.csv"
    head, *rows = file.read_text().split("\n")
    x = np.array([row.split(",") for row in rows if row], float)
    x[:, 3] -= x[:, 2]  # As far ahead as before.
    np.savetxt(file, x, delimiter=",", header=head, comments="")
    dynamics = SceneDynamics(read_scene(scene))
    assert not push_each_other(dynamics, read_recordings([file]))

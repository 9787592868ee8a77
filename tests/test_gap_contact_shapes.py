"""Shapes that touch, against Drake's own distances and its own scaled shapes."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.simulation.contact_shapes import ContactShapes
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import load_scene, read_scene

SHAPES = {
    "sphere": "<sphere><radius>0.03</radius></sphere>",
    "box": "<box><size>0.08 0.06 0.04</size></box>",
    "cylinder": "<cylinder><radius>0.03</radius><length>0.1</length></cylinder>",
    "capsule": "<capsule><radius>0.01</radius><length>0.12</length></capsule>",
    "hull": "<mesh><uri>hull.obj</uri><drake:declare_convex/></mesh>",
}


def scene_of(folder, effects=(), **shapes):
    """{body: text of its shape}, each off its body's origin and turned."""
    corners = np.random.default_rng(0).normal(size=(12, 3)) * 0.03
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += ["f 1 2 3", "f 4 5 6", "f 7 8 9", "f 10 11 12"]
    (folder / "hull.obj").write_text("\n".join(lines))
    text = "directives:\n"
    for name, shape in shapes.items():
        (folder / f"{name}.sdf").write_text(
            f'<sdf version="1.9" xmlns:drake="d"><model name="{name}">'
            f'<link name="{name}"><inertial><mass>1</mass><inertia><ixx>1e-3</ixx>'
            "<iyy>1e-3</iyy><izz>1e-3</izz></inertia></inertial>"
            f'<collision name="c"><pose>0.01 -0.02 0.03 0.3 0.2 0.1'
            f"</pose><geometry>{shape}</geometry></collision></link></model></sdf>"
        )
        text += f"  - add_model: {{name: {name}, file: {name}.sdf}}\n"
    (folder / "scene.yaml").write_text(text)
    scene = read_scene(folder / "scene.yaml")
    scene.effects.extend(effects)
    builder = DiagramBuilder()
    loaded = load_scene(scene, builder)
    return loaded, builder


def random_poses(rng, n: int, size: float):
    R = np.stack([RotationMatrix(_quaternion(rng)).matrix() for _ in range(n)])
    return R, rng.uniform(-size, size, (n, 3))


def _quaternion(rng):
    from pydrake.common.eigen_geometry import Quaternion

    q = rng.normal(size=4)
    return Quaternion(q / np.linalg.norm(q))


def test_what_stays_away_is_left_out_and_nothing_else(tmp_path, monkeypatch):
    """One pose at a time, so that what comes nearest counts alone; near to the limit,
    too."""
    loaded, _ = scene_of(tmp_path, **SHAPES)
    shapes = ContactShapes(loaded)
    rng = np.random.default_rng(4)
    poses = [
        {k: random_poses(rng, 1, 0.12) for k in shapes.bodies()} for _ in range(40)
    ]
    left_out = []
    point = type(shapes.points[0])
    stays_away = point.stays_away

    def noted(*args):
        left_out.append(stays_away(*args))
        return left_out[-1]

    monkeypatch.setattr(point, "stays_away", noted)
    some = [shapes.slots(each, 0.02) for each in poses]
    assert 0.5 < np.mean(left_out) < 1.0
    monkeypatch.setattr(point, "stays_away", lambda *_: False)
    for each, found in zip(poses, some, strict=True):
        every = shapes.slots(each, 0.02)
        assert [s.key for s in found] == [s.key for s in every]
        for one, other in zip(found, every, strict=True):
            np.testing.assert_array_equal(one.phi, other.phi)
            np.testing.assert_array_equal(one.best, other.best)


@pytest.mark.parametrize("other", ["box", "sphere", "hull"])
def test_a_capsule_is_as_far_from_a_shape_as_drake_says(tmp_path, other):
    loaded, builder = scene_of(tmp_path, one=SHAPES["capsule"], two=SHAPES[other])
    shapes = ContactShapes(loaded)
    number = {name.split(".")[0]: k for k, name in shapes.names.items()}
    rng = np.random.default_rng(3)
    R, p = random_poses(rng, 60, 0.12)
    poses = {
        number["one"]: (R, p),
        number["two"]: (np.tile(np.eye(3), (60, 1, 1)), np.zeros((60, 3))),
    }
    nearest = np.min([s.phi for s in shapes.slots(poses, np.inf)], axis=0)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant, graph = loaded.plant, loaded.scene_graph
    of = plant.GetMyMutableContextFromRoot(context)
    compared = 0
    for n in range(60):
        for k in number.values():
            X = RigidTransform(RotationMatrix(poses[k][0][n]), poses[k][1][n])
            plant.SetFreeBodyPose(of, plant.get_body(BodyIndex(k)), X)
        query = graph.get_query_output_port().Eval(graph.GetMyContextFromRoot(context))
        (pair,) = query.ComputeSignedDistancePairwiseClosestPoints(1.0)
        if pair.distance > 1e-3:
            compared += 1
            near = 3e-5 if other == "hull" else 1e-5  # Drake's own error, of hulls.
            assert nearest[n] == pytest.approx(pair.distance, abs=near)
    assert compared > 20


@pytest.mark.parametrize("scale", [0.8, 1.3])
@pytest.mark.parametrize("shape", list(SHAPES))
def test_scaled_shapes_are_those_of_the_scene_with_the_effect(tmp_path, shape, scale):
    things = {"one": SHAPES[shape], "two": SHAPES["box"]}
    effect = Effect("object_size", ["one"], {"scale": scale})
    plain = ContactShapes(scene_of(tmp_path, **things)[0])
    changed = ContactShapes(scene_of(tmp_path, [effect], **things)[0])
    number = {name.split(".")[0]: k for k, name in plain.names.items()}
    R, p = random_poses(np.random.default_rng(5), 40, 0.1)
    poses = {
        number["one"]: (R, p),
        number["two"]: (np.tile(np.eye(3), (40, 1, 1)), np.zeros((40, 3))),
    }
    found, expected = (
        {s.key: s for s in shapes.slots(poses, np.inf)}
        for shapes in (plain.scaled(number["one"], scale), changed)
    )
    assert found.keys() == expected.keys() and found
    for key, s in found.items():
        np.testing.assert_allclose(s.phi, expected[key].phi, atol=1e-9)
        np.testing.assert_allclose(s.place, expected[key].place, atol=1e-9)
        np.testing.assert_allclose(s.normal, expected[key].normal, atol=1e-7)


@pytest.mark.parametrize("fixed", ["box", "cylinder"])
def test_an_upright_cylinder_meets_a_box_where_it_is_nearest(tmp_path, fixed):
    """Beside faces and vertical edges, of one height and of others: what may touch has
    the normal and the distance of a circle and a rectangle."""
    rng = np.random.default_rng(7)
    half, r, n = np.array([0.04, 0.03, 0.02]), 0.03, 80
    upright = "<pose>0 0 0 0 0 0</pose>"
    scene_of(tmp_path, box=SHAPES["box"], cylinder=SHAPES["cylinder"])
    for name in ("box", "cylinder"):
        text = (tmp_path / f"{name}.sdf").read_text()
        text = text.replace("<pose>0.01 -0.02 0.03 0.3 0.2 0.1</pose>", upright)
        (tmp_path / f"{name}.sdf").write_text(text.replace("0.1</len", "0.04</len"))
    loaded = load_scene(read_scene(tmp_path / "scene.yaml"), DiagramBuilder())
    shapes = ContactShapes(loaded)
    number = {name.split(".")[0]: k for k, name in shapes.names.items()}
    angle = rng.uniform(-np.pi, np.pi, n)
    out = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    foot = np.sign(out) * half * [1, 1, 0]  # At an edge, or along a face.
    faces = rng.uniform(size=n) < 0.5
    axis = rng.integers(0, 2, n)
    for i in np.flatnonzero(faces):
        out[i] = np.eye(3)[axis[i]] * rng.choice([-1.0, 1.0])
        other = 1 - axis[i]
        foot[i] = out[i] * half
        foot[i, other] = rng.uniform(-0.9, 0.9) * half[other]
    dz = rng.choice([0.0, 3e-4, -3e-4, 0.01, -0.012], n)
    p = foot + (r + 1e-4) * out + dz[:, None] * [0.0, 0.0, 1.0]
    yaw = rng.uniform(-np.pi, np.pi)
    turn = RotationMatrix.MakeZRotation(yaw).matrix()
    R = np.tile(turn, (n, 1, 1))
    poses = {number["box"]: (R, np.zeros((n, 3))), number["cylinder"]: (R, p @ turn.T)}
    if fixed == "cylinder":
        poses = {k: (R, x - p @ turn.T) for k, (R, x) in poses.items()}
    best = [np.inf] * n
    for s in shapes.slots(poses, 0.02):
        sign = 1.0 if s.a == number["cylinder"] else -1.0
        # A corner of the box may be nearest to the rim of a lower cylinder.
        most = 5e-4 if s.a == number["cylinder"] else 1.5e-4
        for i in np.flatnonzero(s.best & (np.abs(s.phi) < most)):
            normal = sign * turn.T @ s.normal[i]
            assert normal @ out[i] > np.cos(np.deg2rad(4.0)), (i, normal, out[i], dz[i])
            assert s.phi[i] > 5e-5
            best[i] = min(best[i], s.phi[i])
    np.testing.assert_allclose(best, 1e-4, atol=2e-5)

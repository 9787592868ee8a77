import logging

import numpy as np
import pytest
from pydrake.geometry import PerceptionProperties, Role
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.camera import CameraConfig, add_camera
from makebreak.diagrams.station import BALL_ROLLING, MODELS, make_control_plant
from makebreak.models.scene import load_scene, read_scene
from makebreak.systems.arm.impedance_controller import (
    ImpedanceConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.arm.numerics.impedance_controller import posture_step
from makebreak.systems.arm.numerics.serial_chain import tip_kinematics

ROTOR = np.array([0.606, 0.606, 0.462, 0.462, 0.206, 0.206, 0.206])
CAMERA = np.array([0.5, 0.0, 0.8])


@pytest.fixture(scope="module")
def panda():
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(MODELS / "panda.urdf"))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("panda_link0"))
    plant.Finalize()
    return plant


@pytest.fixture(scope="module")
def postures():
    """Where the controller's posture goes for tips all over the workspace."""
    plant = make_control_plant()
    law = ImpedanceController(ImpedanceConfig(), plant)._law
    chain = serial_chain_of(plant, "tip")
    rows = []
    for radius in (0.0, 0.1, 0.13):
        for angle in np.arange(0.0, 2.0 * np.pi, np.pi / 6.0)[: None if radius else 1]:
            for height in (0.03, 0.08, 0.14, 0.2):
                tip = [0.5 + radius * np.cos(angle), radius * np.sin(angle), height]
                q = law.q_nominal
                for _ in range(150):
                    q = posture_step(chain, law, q, np.array(tip))
                rows.append((np.array(tip), q))
    return plant, chain, rows


def test_panda_and_finger_parse_without_a_warning(caplog):
    caplog.set_level(logging.INFO)
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 1e-3)
    for name in ("panda.urdf", "finger.sdf", "table.sdf", "ball.sdf", "pushed_t.sdf"):
        Parser(plant).AddModels(str(MODELS / name))
    plant.Finalize()
    assert [r.message for r in caplog.records if r.name.startswith("drake")] == []


def test_panda_weighs_and_carries_what_was_published(panda):
    # Checks of Gaz et al.'s parameters, given to the digits shown.
    context = panda.CreateDefaultContext()
    q = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
    panda.SetPositions(context, q)
    np.testing.assert_allclose(panda.CalcTotalMass(context), 16.69, atol=0.005)
    gravity = -panda.CalcGravityGeneralizedForces(context)
    expected = [0.0, -1.77, -0.64, 18.57, 0.63, 1.69, 0.0]
    np.testing.assert_allclose(gravity, expected, atol=0.005)
    links_alone = np.diag(panda.CalcMassMatrix(context)) - ROTOR
    expected = [0.46, 1.45, 0.88, 0.79, 0.03, 0.03, 0.005]
    np.testing.assert_allclose(links_alone, expected, atol=0.006)


def test_panda_has_the_documented_limits(panda):
    effort, velocity = np.repeat([87.0, 12.0], [4, 3]), np.repeat([2.175, 2.61], [4, 3])
    np.testing.assert_array_equal(panda.GetEffortUpperLimits(), effort)
    np.testing.assert_array_equal(panda.GetEffortLowerLimits(), -effort)
    np.testing.assert_array_equal(panda.GetVelocityUpperLimits(), velocity)
    upper = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    np.testing.assert_array_equal(panda.GetPositionUpperLimits(), upper)
    lower = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    np.testing.assert_array_equal(panda.GetPositionLowerLimits(), lower)


def test_panda_reaches_the_documented_flange_pose(panda):
    # Straight up: .333 + .316 + .384 - .107 above the base, .088 in front, flange down.
    context = panda.CreateDefaultContext()
    panda.SetPositions(context, np.zeros(7))
    X = panda.GetFrameByName("panda_link8").CalcPoseInWorld(context)
    np.testing.assert_allclose(X.translation(), [0.088, 0.0, 0.926], atol=1e-12)
    np.testing.assert_allclose(X.rotation().matrix(), np.diag([1, -1, -1]), atol=1e-12)


def test_finger_inertia_is_that_of_its_shapes():
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(MODELS / "finger.sdf"))
    plant.Finalize()
    tip, plate = np.array([0.065, -0.13 * np.sin(np.pi / 3), 0.19]), [0, 0, 0.006]
    length = np.linalg.norm(tip - plate)
    axis = (tip - plate) / length
    parts = [  # Volume, centre, unit inertia.
        (
            np.pi * 0.032**2 * 0.012,
            plate,
            UnitInertia.SolidCylinder(0.032, 0.012, [0, 0, 1]),
        ),
        (
            np.pi * 0.008**2 * length,
            (tip + plate) / 2,
            UnitInertia.SolidCylinder(0.008, length, axis),
        ),
        (4 / 3 * np.pi * 0.0195**3, tip, UnitInertia.SolidSphere(0.0195)),
    ]
    density = 0.12 / sum(volume for volume, _, _ in parts)
    total = SpatialInertia.Zero()
    for volume, centre, unit in parts:
        mass = density * volume
        moments = unit.ShiftFromCenterOfMass(-np.asarray(centre))
        total += SpatialInertia(mass, centre, moments)
    body = plant.GetBodyByName("finger").default_spatial_inertia()
    np.testing.assert_allclose(  # The file has six digits.
        body.CopyToFullMatrix6(), total.CopyToFullMatrix6(), atol=2e-8
    )


@pytest.mark.parametrize("radius", [0.0315, 0.036, 0.04])
def test_rod_does_not_touch_a_ball_under_the_tip(radius):
    # Ball of any size on the table's height or below the tip, all around.
    rod = np.array([-0.065, -0.13 * np.sin(np.pi / 3), 0.184])  # From the tip, up.
    assert rod[2] / np.linalg.norm(rod[:2]) > 1.0  # Steeper than 45 degrees.
    for below in np.linspace(0.0, np.pi / 2, 20):
        for yaw in np.linspace(0.0, 2 * np.pi, 60):
            d = radius + 0.0195
            ball = d * np.array(
                [
                    np.cos(below) * np.cos(yaw),
                    np.cos(below) * np.sin(yaw),
                    -np.sin(below),
                ]
            )
            along = np.clip(ball @ rod / (rod @ rod), 0.0, 1.0)
            if along > 0.0:
                assert np.linalg.norm(ball - along * rod) - radius > 0.008


def test_arm_starts_upright_with_the_tip_above_the_circle():
    plant = make_control_plant()
    X = plant.GetFrameByName("tip").CalcPoseInWorld(plant.CreateDefaultContext())
    # The scene's angles have six digits: 1e-6 rad over an arm's length of 0.7 m.
    expected = RigidTransform(RotationMatrix(), [0.5, 0.0, 0.1])
    assert X.IsNearlyEqualTo(expected, 2e-6)


def test_workspace_is_within_the_joint_limits(postures):
    plant, chain, rows = postures
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    for tip, q in rows:
        p, R, _ = tip_kinematics(chain, q)
        np.testing.assert_allclose(p, tip, atol=1e-4)
        assert R[2, 2] > np.cos(np.radians(0.1))
        assert min((q - lower).min(), (upper - q).min()) > 0.08  # [rad]
        assert min(q[6] - lower[6], upper[6] - q[6]) > 2.0


def test_arm_hides_the_ball_from_the_camera_nowhere(postures):
    # Rays from the camera to a ball within 20 mm of the tip, as cones of its size; link
    # shapes as their collision geometry. The finger itself may be in between.
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    Parser(plant).AddModels(str(MODELS / "panda.urdf"))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("panda_link0"))
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    nearest_ray, nearest_camera = np.inf, np.inf
    for tip, q in postures[2]:
        plant.SetPositions(plant.GetMyMutableContextFromRoot(context), q)
        query = scene_graph.get_query_output_port().Eval(
            scene_graph.GetMyContextFromRoot(context)
        )
        for found in query.ComputeSignedDistanceToPoint(CAMERA, 1.0):
            nearest_camera = min(nearest_camera, found.distance)
        if tip[2] > 0.09 or np.hypot(tip[0] - 0.5, tip[1]) > 0.105:
            continue
        for offset in ([0, 0], [0.02, 0], [-0.02, 0], [0, 0.02], [0, -0.02]):
            ball = np.array([tip[0] + offset[0], tip[1] + offset[1], 0.0315])
            for s in np.linspace(0.1, 0.9, 17):
                p = ball + s * (CAMERA - ball)
                for found in query.ComputeSignedDistanceToPoint(p, 0.2):
                    nearest_ray = min(nearest_ray, found.distance - 0.0315 * (1 - s))
    assert nearest_ray > 0.002  # [m]
    assert nearest_camera > 0.15  # [m]


def test_ball_and_table_and_finger_meet_with_the_stated_friction():
    # 2 mu1 mu2/(mu1 + mu2) of the scene's files is 0.5 for both of the ball's pairs.
    builder = DiagramBuilder()
    loaded = load_scene(read_scene(BALL_ROLLING), builder)
    inspector = loaded.scene_graph.model_inspector()
    mu = {}
    for name in ("ball", "table", "finger"):
        body = loaded.plant.GetBodyByName(name)
        for g in loaded.plant.GetCollisionGeometriesForBody(body):
            properties = inspector.GetProximityProperties(g)
            friction = properties.GetProperty("material", "coulomb_friction")
            mu[name] = friction.dynamic_friction()
    for other in ("table", "finger"):
        pair = 2 * mu["ball"] * mu[other] / (mu["ball"] + mu[other])
        np.testing.assert_allclose(pair, 0.5, rtol=1e-12)


def test_a_camera_sees_the_ball_as_past_the_arm_on_display(postures):
    # The same pictures once with what a camera is shown and once with all that is on
    # display, for a ball within 20 mm of the tip.
    pictures = []
    for on_display in (False, True):
        builder = DiagramBuilder()
        loaded = load_scene(read_scene(BALL_ROLLING), builder)
        plant, scene_graph = loaded.plant, loaded.scene_graph
        source, inspector = plant.get_source_id(), scene_graph.model_inspector()
        n_shown = 0
        for index in plant.GetBodyIndices(plant.GetModelInstanceByName("panda")):
            frame = plant.GetBodyFrameIdOrThrow(index)
            for g in inspector.GetGeometries(frame):
                shown = inspector.GetIllustrationProperties(g)
                seen = inspector.GetPerceptionProperties(g)
                n_shown += shown is not None
                if on_display and seen is not None and shown is None:
                    scene_graph.RemoveRole(source, g, Role.kPerception)
                if on_display and seen is None and shown is not None:
                    properties = PerceptionProperties(shown)
                    scene_graph.AssignRole(source, g, properties)
        assert n_shown == 36
        config = CameraConfig(renderer="drawn", position=CAMERA.tolist())
        port = add_camera(builder, scene_graph, plant, config, seed=0)
        builder.ExportOutput(port, "image")
        diagram = builder.Build()
        context = diagram.CreateDefaultContext()
        rng, balls, arms = np.random.default_rng(0), [], []
        for tip, q in postures[2]:
            if tip[2] < 0.05:  # The tip would be in the ball.
                continue
            ball = [*(tip[:2] + rng.uniform(-0.014, 0.014, 2)), 0.0315]
            plant.SetPositions(
                plant.GetMyMutableContextFromRoot(context), [*q, 1, 0, 0, 0, *ball]
            )
            rgb = diagram.GetOutputPort("image").Eval(context).data[:, :, :3]
            balls.append(np.ptp(rgb, axis=2) > 40)
            arms.append(rgb.min(axis=2) > 230)
        pictures.append((np.array(balls), np.array(arms)))
    (ball, arm), (ball_before, arm_before) = pictures
    sizes, sizes_before = ball.sum(axis=(1, 2)), ball_before.sum(axis=(1, 2))
    assert (sizes <= sizes_before).all()
    assert (sizes >= 0.98 * sizes_before).all()
    # Nothing of the arm but a few blended pixels of its edge is missing.
    assert (arm_before & ~arm).sum(axis=(1, 2)).max() <= 10
    assert arm.sum() < 1.2 * arm_before.sum()


def test_cameras_see_the_tables_top_alone():
    """Its legs are under it; drawing them would cost time in every image."""
    loaded = load_scene(BALL_ROLLING, DiagramBuilder())
    inspector = loaded.scene_graph.model_inspector()
    table = loaded.plant.GetBodyByName("table")
    frame = loaded.plant.GetBodyFrameIdOrThrow(table.index())
    seen = inspector.GetGeometries(frame, Role.kPerception)
    assert [inspector.GetName(g) for g in seen] == ["table::top"]
    assert len(inspector.GetGeometries(frame, Role.kIllustration)) == 5

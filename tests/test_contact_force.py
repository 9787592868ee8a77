"""The force at the tip from the torque of the contacts on the joints."""

import numpy as np
import pytest
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.station import (
    BALL_ROLLING,
    TIP_FRAME,
    SensorNoise,
    StationConfig,
    make_control_plant,
    make_station,
)
from makebreak.models.scene import read_scene
from makebreak.systems.arm.impedance_controller import (
    ImpedanceConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.arm.numerics.contact_force import contact_forces

R_TIP = 0.0195


@pytest.fixture(scope="module")
def arm():
    return make_control_plant()


@pytest.fixture(scope="module")
def chain(arm):
    return serial_chain_of(arm, TIP_FRAME)


def test_a_known_force_at_a_known_point_is_found_again(arm, chain):
    rng = np.random.default_rng(0)
    n = 12
    context, world = arm.CreateDefaultContext(), arm.world_frame()
    tip = arm.GetFrameByName(TIP_FRAME)
    q = arm.GetPositions(context) + rng.uniform(-0.4, 0.4, (n, 7))
    force, offset = rng.normal(0.0, 5.0, (n, 3)), rng.uniform(-0.02, 0.02, (n, 3))
    force[3] = 0.0
    torque = np.zeros((n, 7))
    for k in range(n):
        arm.SetPositions(context, q[k])
        in_tip = tip.CalcPoseInWorld(context).rotation().matrix().T @ offset[k]
        J = arm.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, tip, in_tip, world, world
        )
        torque[k] = J.T @ force[k]
    found = contact_forces(chain, q, torque, offset)
    np.testing.assert_allclose(found, force, atol=1e-9)
    assert (found[3] == 0.0).all()


def test_pressed_on_the_ball_it_is_the_force_that_drake_reports(chain):
    """0.1 s of the station, the tip sent into the ball from above and off its top."""
    scene = read_scene(BALL_ROLLING)
    scene.initial.poses["ball.ball"] = [1, 0, 0, 0, 0.5, 0.0, 0.0315]
    builder = DiagramBuilder()
    config = StationConfig(noise=SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0))
    station = builder.AddSystem(make_station(config, scene=scene))
    control_plant = make_control_plant()
    controller = builder.AddSystem(
        ImpedanceController(ImpedanceConfig(offset_sec=5e-4), control_plant)
    )
    for port, name in (("position", "q"), ("velocity", "v")):
        builder.Connect(
            station.GetOutputPort(f"panda.{port}_measured"),
            controller.GetInputPort(name),
        )
    builder.Connect(
        controller.GetOutputPort("tau"), station.GetInputPort("panda.torque_commanded")
    )
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    reference = np.zeros(19)
    reference[:4] = 0.495, 0.003, 0.04, 1.0
    controller.GetInputPort("x_desired").FixValue(
        controller.GetMyMutableContextFromRoot(root), reference
    )
    context = station.GetMyContextFromRoot(root)
    n_touching = 0
    for k in range(1, 61):
        # Just before a step: torque and contact belong to each other.
        simulator.AdvanceTo(0.01 * k + 0.0007)
        results = station.GetOutputPort("contact_results").Eval(context)
        pairs = [
            results.point_pair_contact_info(i)
            for i in range(results.num_point_pair_contacts())
        ]
        plant = station.GetSubsystemByName("plant")
        finger = plant.GetFrameByName(TIP_FRAME).body().index()
        touching = [i for i in pairs if finger in (i.bodyA_index(), i.bodyB_index())]
        if not touching:
            continue
        (info,) = touching  # One sphere on one sphere.
        plant_context = plant.GetMyContextFromRoot(root)
        p_tip = plant.GetFrameByName(TIP_FRAME).CalcPoseInWorld(plant_context)
        p_tip = p_tip.translation()
        p_ball = plant.EvalBodyPoseInWorld(
            plant_context, plant.GetBodyByName("ball")
        ).translation()
        sign = 1.0 if info.bodyB_index() == finger else -1.0  # It is the force on B.
        expected = sign * info.contact_force()
        q = station.GetOutputPort("panda.position_measured").Eval(context)[None]
        torque = station.GetOutputPort("panda.contact_torque").Eval(context)[None]
        away = (p_tip - p_ball) / np.linalg.norm(p_tip - p_ball)
        at_point = contact_forces(
            chain, q, torque, (info.contact_point() - p_tip)[None]
        )
        scale = np.linalg.norm(expected)
        # One force at one point, and the same point: round-off.
        np.testing.assert_allclose(at_point[0], expected, atol=1e-9 * max(scale, 1.0))
        # The scoring takes the point on the tip's own surface, half the penetration
        # (below 0.2 mm) off, on levers of 0.1 m and more between joint axes and force.
        at_surface = contact_forces(chain, q, torque, (-R_TIP * away)[None])
        np.testing.assert_allclose(at_surface[0], expected, atol=2e-3 * scale)
        assert at_surface[0] @ away > 0.0  # It pushes the tip away from the ball.
        n_touching += scale > 0.5
    assert n_touching >= 3

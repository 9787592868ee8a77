"""What is sent to a robot that carries its own weight."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.station import TIP_FRAME, make_control_plant
from makebreak.systems.arm.gravity_left_out import GravityLeftOut
from makebreak.systems.arm.impedance_controller import serial_chain_of

Q = np.array([0.1, -0.5, 0.2, -2.0, 0.3, 1.6, 0.4])


def test_gravity_is_left_out_also_while_encoders_fail():
    plant = make_control_plant()
    builder = DiagramBuilder()
    system = builder.AddSystem(GravityLeftOut(serial_chain_of(plant, TIP_FRAME)))
    simulator = Simulator(builder.Build())
    own = system.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    tau, q = system.GetInputPort("tau"), system.GetInputPort("q")
    tau.FixValue(own, np.zeros(7))
    q.FixValue(own, np.full(7, np.nan))
    torque = system.GetOutputPort("torque")
    np.testing.assert_array_equal(torque.Eval(own), 0.0)  # Nothing is known yet.
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, Q)
    carried = -plant.CalcGravityGeneralizedForces(context)
    tau.FixValue(own, carried + 0.25)
    q.FixValue(own, Q)
    np.testing.assert_allclose(torque.Eval(own), 0.25, atol=1e-9)
    simulator.AdvanceTo(0.001)
    q.FixValue(own, np.full(7, np.nan))
    np.testing.assert_allclose(torque.Eval(own), 0.25, atol=1e-9)

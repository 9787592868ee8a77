"""Time of a tick of the impedance controller, and of the station under it."""

from time import process_time
from typing import Literal, get_args

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.benchmarks.bench import median_call_ms
from makebreak.diagrams.station import (
    BALL_ROLLING,
    StationConfig,
    make_control_plant,
    make_station,
)
from makebreak.models.scene import read_scene
from makebreak.systems.arm.impedance_controller import (
    HybridConfig,
    ImpedanceConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.arm.numerics.serial_chain import chain_state

SIMULATED_SEC = 2.0


def _x_desired() -> np.ndarray:
    x_d = np.zeros(19)
    x_d[:4] = [0.5, 0.0, 0.1, 1.0]
    return x_d


Approximation = Literal["lagged", "similar"]


def _loop_us(approximation: Approximation) -> float:
    """CPU time of one simulated millisecond of station and controller [us]."""
    scene = read_scene(BALL_ROLLING)
    scene.plant.discrete_contact_approximation = approximation
    builder = DiagramBuilder()
    station = builder.AddSystem(make_station(StationConfig(), scene=scene))
    config = ImpedanceConfig(offset_sec=0.0007)
    controller = builder.AddSystem(ImpedanceController(config, make_control_plant()))
    for port, name in (("position", "q"), ("velocity", "v")):
        builder.Connect(
            station.GetOutputPort(f"panda.{port}_measured"),
            controller.GetInputPort(name),
        )
    builder.Connect(
        controller.GetOutputPort("tau"), station.GetInputPort("panda.torque_commanded")
    )
    simulator = Simulator(builder.Build())
    context = controller.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    controller.GetInputPort("x_desired").FixValue(context, _x_desired())
    simulator.AdvanceTo(0.1)
    start = process_time()
    simulator.AdvanceTo(0.1 + SIMULATED_SEC)
    return 1e3 * (process_time() - start) / SIMULATED_SEC


def _station_us(approximation: Approximation) -> float:
    """The same for the station alone, under a fixed torque."""
    scene = read_scene(BALL_ROLLING)
    scene.plant.discrete_contact_approximation = approximation
    station = make_station(StationConfig(), scene=scene)
    arm = make_control_plant()
    tau = -arm.CalcGravityGeneralizedForces(arm.CreateDefaultContext())
    simulator = Simulator(station)
    station.GetInputPort("panda.torque_commanded").FixValue(
        simulator.get_mutable_context(), tau
    )
    simulator.AdvanceTo(0.1)
    start = process_time()
    simulator.AdvanceTo(0.1 + SIMULATED_SEC)
    return 1e3 * (process_time() - start) / SIMULATED_SEC


def rows() -> list[dict]:
    """Microseconds per tick, the station's real-time factor, the tip's mass."""
    arm = make_control_plant()
    found: list[dict] = []
    for what in ("position only", "full pose", "full pose and two forces"):
        config = ImpedanceConfig(control_orientation=what != "position only")
        controller = ImpedanceController(
            config, arm, hybrid=HybridConfig(damping_ratio=0.9)
        )
        context = controller.CreateDefaultContext()
        q = arm.GetPositions(arm.CreateDefaultContext())
        values = {"q": q, "v": np.full(7, 0.05), "x_desired": _x_desired()}
        if what.endswith("forces"):
            values["force_directions"] = np.array([0.0, 0, -1, 0, 1, 0])
            values["force_targets"] = np.array([8.0, 8.0])
            values["wrench_measured"] = np.array([0.0, -8, 8, 0, 0, 0])
        for name, value in values.items():
            controller.GetInputPort(name).FixValue(context, value)

        def tick(controller=controller, context=context):
            context.SetTime(context.get_time() + 0.001)  # Invalidates cached outputs.
            controller.EvalUniquePeriodicDiscreteUpdate(context)

        found.append(
            {
                "what": f"impedance tick, {what}",
                "value": 1e3 * median_call_ms(tick, 2000),
                "unit": "us",
            }
        )
    for approximation in get_args(Approximation):
        for label, measure in (
            ("station alone", _station_us),
            ("station and impedance", _loop_us),
        ):
            us = measure(approximation)
            found.append(
                {
                    "what": f"{label}, {approximation}, per simulated ms",
                    "value": us,
                    "unit": "us",
                    "note": f"{1e3 / us:.1f} x real time",
                }
            )
    chain = serial_chain_of(arm, "tip")
    q = arm.GetPositions(arm.CreateDefaultContext())
    state = chain_state(chain, q, np.zeros(7))
    mobility = state.J @ np.linalg.solve(state.M, state.J.T)
    fixed = np.linalg.inv(np.linalg.inv(mobility)[:3, :3])
    for label, of in (("free to turn", mobility[:3, :3]), ("held upright", fixed)):
        for axis, mass in zip("xyz", 1.0 / np.diag(of), strict=True):
            found.append(
                {
                    "what": f"mass of the tip along {axis}, {label}",
                    "value": float(mass),
                    "unit": "kg",
                }
            )
    return found

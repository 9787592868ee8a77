"""A tool slides from a smooth surface to a rough one and back; both are recognised."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak import ModeDetector, ModeDetectorConfig

builder = DiagramBuilder()
detector = builder.AddSystem(ModeDetector(ModeDetectorConfig()))
still = dict(
    ee_velocity=[0.1, 0, 0, 0, 0, 0],  # Along x at 0.1 m/s ...
    direction=[1, 0, 0],
    force_directions=[0, 0, -1, 0, 0, 0],  # ... and pressed down.
)
for name, value in still.items():
    source = builder.AddSystem(ConstantVectorSource(np.array(value, float)))
    builder.Connect(source.get_output_port(), detector.GetInputPort(name))
builder.ExportInput(detector.GetInputPort("wrench"), "wrench")
builder.ExportOutput(detector.GetOutputPort("mode"), "mode")
simulator = Simulator(builder.Build())
diagram, context = simulator.get_system(), simulator.get_mutable_context()
rng, seen = np.random.default_rng(0), []
for tick in range(1200):
    friction = 0.4 if 400 <= tick < 800 else 0.15
    force = np.array([-10.0 * friction, 0, 10.0]) + 0.1 * rng.normal(size=3)
    diagram.GetInputPort("wrench").FixValue(context, [*force, 0, 0, 0])
    simulator.AdvanceTo(0.005 * (tick + 1))
    mode = int(diagram.GetOutputPort("mode").Eval(context)[0])
    if mode > 0 and (not seen or seen[-1] != mode):
        seen.append(mode)
        print(f"mode {mode} from {context.get_time():.2f} s")

"""A gantry comes down on a table twice; the second time it is gentle."""

import pydrake.all as drake

import makebreak as mb


class Gantry(drake.LeafSystem):  # 2 kg on a vertical servo axis; a table of 20 kN/m.
    def __init__(self):
        super().__init__()
        self.x = self.DeclareVectorInputPort("x_desired", 19)
        self.F = self.DeclareVectorInputPort("force_targets", 2)
        for name in ("ee_velocity", "wrench", "transition", "ee_pose"):
            value = [0, 0, 0.1, 1.0, 0, 0, 0] if name == "ee_pose" else [0.0] * 6
            self.DeclareStateOutputPort(name, self.DeclareDiscreteState(value))
        self.DeclarePeriodicDiscreteUpdateEvent(2.5e-4, 0.0, self.step)

    def step(self, context, state):
        velocity, wrench, _, pose = (state.get_mutable_vector(i) for i in range(4))
        z, v, x, F = pose[2], velocity[2], self.x.Eval(context), self.F.Eval(context)[0]
        force = -F - 80 * v if F else 800 * (x[2] - z) + 80 * (x[9] - v)
        wrench[2] = max(0.0, -2e4 * z - 50 * v) * (z < 0) + 1e-6 * z  # Never still.
        velocity[2], pose[2] = v + 2.5e-4 * (force + wrench[2]) / 2, z + 2.5e-4 * v


knowledge, p = None, [[0, 0, 0.1], [0, 0, -0.01], [0.01, 0, -0.01]]
for builder in (drake.DiagramBuilder(), drake.DiagramBuilder()):
    down = mb.Segment("line", p[:2], [0.5, 1.5])  # And hold it there with 2 N.
    hold = mb.Segment("line", p[1:], [1.5, 2.5], [1, 0, 0, 0], [[0, 0, -1]], [2.0])
    shape = mb.VelocityShaper(mb.VelocityShaperConfig(), mb.MotionPattern((down, hold)))
    felt = mb.ContactDetector(mb.ContactDetectorConfig(tool_mass=0.0))
    expect = mb.KalmanContactAnticipator(mb.ContactAnticipatorConfig(), knowledge)
    systems = [builder.AddSystem(s) for s in (Gantry(), felt, shape, expect)]
    outs = [s.get_output_port(i) for s in systems for i in range(s.num_output_ports())]
    ins = [s.get_input_port(i) for s in systems for i in range(s.num_input_ports())]
    for a, b in ((a, b) for a in outs for b in ins if a.get_name() == b.get_name()):
        builder.Connect(a, b)  # Ports of one name belong together.
    (simulator := drake.Simulator(builder.Build())).AdvanceTo(4.0)
    knowledge = expect.knowledge(expect.GetMyContextFromRoot(simulator.get_context()))
print("speeds [m/s], peak forces [N]:", knowledge.contacts[0].impacts.round(3).tolist())

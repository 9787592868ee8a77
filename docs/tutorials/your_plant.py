"""
Your plant under C3, with a learner
===================================

C3 (consensus complementarity control) plans motions in which things touch. Nobody
tells it when. Here it moves a plant of your own, first with the right model, then with
a wrong one, and then with a learner that corrects the model while the plant moves.
"""

# %%
# A plant
# -------
#
# Any plant that Drake reads can be used, from URDF, SDF or MJCF. This one is a finger
# on a motor-driven rail, and a puck on a rail in front of it. The finger can push,
# but it cannot pull. The model of the controller and the simulated world are two
# plants, so that the world may differ: its puck gets a radius of its own.

import matplotlib.pyplot as plt
import numpy as np
from pydrake.all import (
    AddMultibodyPlantSceneGraph,
    DiagramBuilder,
    LogVectorOutput,
    Parser,
    Simulator,
)

import makebreak as mb

link = """
<link name="{0}"><pose>{1} 0 0 0 0 0</pose><inertial><mass>{2}</mass></inertial>
  <collision name="{0}"><geometry><sphere><radius>{3}</radius></sphere></geometry>
    <surface><friction><ode><mu>0.3</mu><mu2>0.3</mu2></ode></friction></surface>
  </collision></link>
<joint name="{0}_rail" type="prismatic"><parent>world</parent><child>{0}</child>
  <axis><xyz>1 0 0</xyz><dynamics><damping>5</damping></dynamics>
    <limit><effort>{4}</effort></limit></axis></joint>"""


def add_plant(builder, time_step, radius):
    sdf = '<sdf version="1.7"><model name="push">'
    sdf += link.format("finger", 0.0, 1.0, 0.05, 20)
    sdf += link.format("puck", 0.2, 0.5, radius, 0) + "</model></sdf>"
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    Parser(plant).AddModelsFromString(sdf, "sdf")
    plant.Finalize()
    return plant


# %%
# The contact model
# -----------------
#
# A linear complementarity system (LCS) predicts one time step of a plant with
# contact:
#
# .. code-block:: none
#
#     x_next = A x + B u + D lam + d
#     0 <= lam  perp  E x + F lam + H u + c >= 0
#
# A contact force lam is not negative, a distance is not negative, and one of both is
# zero. All that is needed is which bodies may touch, and with which friction.

pairs = [mb.ContactPair("finger", "puck", friction=0.3)]
builder = DiagramBuilder()
add_plant(builder, 0.0, radius=0.05)
model = builder.Build()  # The controller's, with a time step of zero: continuous.
contacts = mb.AnitescuLcs(model, pairs, dt_sec=0.05)
lcs = contacts.at_default()
print("x:", contacts.x_names)
print("lam:", contacts.lam_names)
w = lcs.E @ contacts.x_default + lcs.c
print("E x + F lam + H u + c at rest [m/s]:", w.round(3))

# %%
# The finger starts 0.1 m away from the puck, surface to surface: with a time step of
# 0.05 s that is a speed of 2 m/s, which is what the last line shows.
#
# The loop
# --------
#
# ``make_contact_mpc`` is C3 on the LCS about the present state. The goal is the puck
# at 0.5 m, at rest. Its ports connect like those of any Drake system. The learner
# compares what the LCS predicted with what came, and gives C3 a correction ``r_comp``
# of the distance.

goal = [0.4, 0.5, 0.0, 0.0]  # Finger, puck [m], their velocities [m/s].
config = mb.ContactMpcConfig(
    pairs, Q=[0, 200, 1, 20], R=[0.01], x_desired=goal, period_sec=0.05
)


def run(radius, learns):
    """Times, the finger and the puck over time, and what was learned [m]."""
    builder = DiagramBuilder()
    plant = add_plant(builder, 0.001, radius)
    mpc = builder.AddSystem(mb.make_contact_mpc(model, config))
    state = plant.get_state_output_port()
    builder.Connect(state, mpc.GetInputPort("x"))
    builder.Connect(mpc.GetOutputPort("u"), plant.get_actuation_input_port())
    seen = LogVectorOutput(state, builder)
    if learns:
        weights = [0, 0, 1e4, 1e4]  # Velocities are predicted to 1 cm/s.
        how = mb.ResidualLearnerConfig(Q_d=weights, eps=1e-3, groups=[[0, 1, 2, 3]])
        how.posterior = mb.PosteriorConfig()
        learner = mb.ResidualLearner(how, lcs, period_sec=0.05, offset_sec=5e-5)
        builder.AddSystem(learner)
        builder.Connect(state, learner.GetInputPort("x"))
        builder.Connect(mpc.GetOutputPort("u"), learner.GetInputPort("u_measured"))
        builder.Connect(mpc.GetOutputPort("lcs"), learner.GetInputPort("lcs"))
        builder.Connect(learner.GetOutputPort("r_comp"), mpc.GetInputPort("r_comp"))
        learned = LogVectorOutput(learner.GetOutputPort("r_comp"), builder, 0.05)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(4.0)
    log = seen.FindLog(simulator.get_context())
    if not learns:
        return log.sample_times(), log.data()[:2], None
    r = learned.FindLog(simulator.get_context())
    return log.sample_times(), log.data()[:2], (r.sample_times(), 0.05 * r.data()[0])


runs = {
    "right model": run(0.05, learns=False),
    "puck 8 mm smaller than modelled": run(0.042, learns=False),
    "the same, with the learner": run(0.042, learns=True),
}
for name, (_, places, _) in runs.items():
    print(f"{name}: the puck ends at {places[1, -1]:.3f} m")

# %%
# With the wrong radius the plan has its contact where there is none, and the puck
# stops short of the goal. With the learner it arrives. What is learned comes near the
# true distance within a second. Later both hardly move, so that the small force between
# them tells little: it ends 1 to 2 mm too large, which does no harm at rest.

figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
for name, (t, places, _) in runs.items():
    axes[0].plot(t, places[1], label=name)
axes[0].axhline(0.5, color="0.6", ls="--", label="goal")
axes[0].set(xlabel="time [s]", ylabel="puck [m]")
axes[0].legend(fontsize=8)
t, gap = runs["the same, with the learner"][2]
axes[1].step(t, 1e3 * gap, where="post", label="learned")
axes[1].axhline(8.0, color="0.6", ls="--", label="true")
axes[1].set(xlabel="time [s]", ylabel="distance beyond the model's [mm]")
axes[1].legend(fontsize=8)
plt.show()

# %%
# What to change for your plant: the SDF, the pairs that may touch, the weights ``Q``
# of the state and ``R`` of the input, and the goal. Larger plants want more knots
# (``options=mb.C3Options(N=10)``) and only the nearest contacts (``closest=4``).

np.testing.assert_allclose(runs["the same, with the learner"][1][1, -1], 0.5, atol=0.01)

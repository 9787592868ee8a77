"""A force-torque sensor between flange and tool."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.serial_chain import SerialChain
from makebreak.systems.arm.numerics.tool_wrench import external_wrench
from makebreak.systems.numerics.first_calls import first_call


class ToolWrench(LeafSystem):
    """The external wrench on the tool: the reaction in its mount minus its weight.

    The tool's inertial force (m a, some 0.1 N for a light finger) is not removed, as on
    a robot without accelerometer.

    Inputs:  reaction_forces (abstract) of the plant, state (2 n,) of its arm.
    Outputs: wrench (6,): on the tool at its tip, in world axes, force first [N], [N m].

    Without a period it is computed when evaluated, from the torques and the state of
    that instant: for a discrete plant, the reaction in a step that starts with them.
    With a period it is sampled as the plant steps and is the reaction in that step,
    without a contact solution of its own.

    Args: plant: finalized; joint: name of the weld that mounts the tool, with the tool
        as its child; tip: name of a frame on the tool; chain: of the arm in the plant,
        up to this frame; period_sec: the plant's time step, or None.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        joint: str,
        tip: str,
        chain: SerialChain,
        period_sec: float | None = None,
    ):
        super().__init__()
        mount = plant.GetJointByName(joint)
        self._ordinal = int(mount.index())  # Equal where no joint was removed.
        context = plant.CreateDefaultContext()
        tool, C = mount.child_body(), mount.frame_on_child()
        inertia = tool.CalcSpatialInertiaInBodyFrame(context)
        X_BC = C.CalcPoseInBodyFrame(context)
        X_CE = plant.CalcRelativeTransform(context, C, plant.GetFrameByName(tip))
        self._n = len(chain.mass)
        self._constants = (
            packed(chain),
            X_CE.rotation().matrix(),
            inertia.get_mass() * np.array(plant.gravity_field().gravity_vector()),
            X_BC.inverse() @ np.array(inertia.get_com()),
            X_CE.translation(),
        )
        zero = np.zeros(3)  # Read-only, as the arrays that Drake gives.
        zero.setflags(write=False)
        first_call(external_wrench, zero, zero, np.zeros(self._n), *self._constants)
        self._reactions = self.DeclareAbstractInputPort(
            "reaction_forces", AbstractValue.Make([SpatialForce.Zero()])
        )
        self._x = self.DeclareVectorInputPort("state", 2 * self._n)
        if period_sec is None:
            self.DeclareVectorOutputPort("wrench", 6, self._calc)
        else:
            self._sampled = self.DeclareDiscreteState(6)
            self.DeclareStateOutputPort("wrench", self._sampled)
            self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._sample)

    def _calc(self, context: Context, output: BasicVector):
        output.SetFromVector(self._wrench(context))

    def _sample(self, context: Context, discrete_state):
        discrete_state.set_value(self._sampled, self._wrench(context))

    def _wrench(self, context: Context) -> np.ndarray:
        reaction = self._reactions.Eval(context)[self._ordinal]
        return external_wrench(
            reaction.translational(),
            reaction.rotational(),
            self._x.Eval(context)[: self._n],
            *self._constants,
        )

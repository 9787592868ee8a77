"""A force-torque sensor between flange and tool."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.numerics.tool_wrench import external_wrench


class ToolWrench(LeafSystem):
    """The wrench from outside on the tool, from the reaction in its mount.

    What the mount carries, less the tool's weight. The tool's inertia stays in it
    (m a, some 0.1 N for a light finger), as on a robot without accelerometer.

    Inputs:  reaction_forces (abstract) and state (n_x,) of the plant.
    Outputs: wrench (6,) on the tool at its tip, world axes, force first [N], [N m].

    Args: plant, finalized; joint, name of the weld that mounts the tool, the tool its
        child; tip, name of a frame on the tool.
    """

    def __init__(self, plant: MultibodyPlant, joint: str, tip: str):
        super().__init__()
        self._plant = plant
        mount = plant.GetJointByName(joint)
        self._ordinal = int(mount.index())  # Equal where no joint was removed.
        self._mount = mount.frame_on_child()
        self._plant_context = plant.CreateDefaultContext()
        inertia = mount.child_body().CalcSpatialInertiaInBodyFrame(self._plant_context)
        self._weight = inertia.get_mass() * np.array(
            plant.gravity_field().gravity_vector()
        )
        X_BC = self._mount.CalcPoseInBodyFrame(self._plant_context)
        self._p_CM = X_BC.inverse() @ np.array(inertia.get_com())
        self._p_CE = plant.CalcRelativeTransform(
            self._plant_context, self._mount, plant.GetFrameByName(tip)
        ).translation()
        zero = np.zeros(3)  # Compiles it, for arrays of the kind that Drake gives.
        zero.setflags(write=False)
        R = self._mount.CalcRotationMatrixInWorld(self._plant_context).matrix()
        external_wrench(zero, zero, R, self._weight, self._p_CM, self._p_CE)
        self._reactions = self.DeclareAbstractInputPort(
            "reaction_forces", AbstractValue.Make([SpatialForce.Zero()])
        )
        self._x = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self.DeclareVectorOutputPort("wrench", 6, self._calc)

    def _calc(self, context: Context, output: BasicVector):
        self._plant.SetPositionsAndVelocities(
            self._plant_context, self._x.Eval(context)
        )
        reaction = self._reactions.Eval(context)[self._ordinal]
        output.SetFromVector(
            external_wrench(
                reaction.translational(),
                reaction.rotational(),
                self._mount.CalcRotationMatrixInWorld(self._plant_context).matrix(),
                self._weight,
                self._p_CM,
                self._p_CE,
            )
        )

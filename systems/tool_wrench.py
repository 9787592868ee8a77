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
        self._tip = plant.GetFrameByName(tip)
        self._plant_context = plant.CreateDefaultContext()
        inertia = mount.child_body().CalcSpatialInertiaInBodyFrame(self._plant_context)
        gravity = plant.gravity_field().gravity_vector()
        self._weight = inertia.get_mass() * np.array(gravity)
        self._tool = mount.child_body().body_frame()
        self._com = np.array(inertia.get_com())
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
        X_WC = self._mount.CalcPoseInWorld(self._plant_context)
        output.SetFromVector(
            external_wrench(
                reaction.translational(),
                reaction.rotational(),
                X_WC.rotation().matrix(),
                X_WC.translation(),
                self._weight,
                self._tool.CalcPoseInWorld(self._plant_context) @ self._com,
                self._tip.CalcPoseInWorld(self._plant_context).translation(),
            )
        )

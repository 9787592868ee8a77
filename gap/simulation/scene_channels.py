"""The channels that a scene's plant can show, and their true values."""

from typing import NamedTuple

import numpy as np
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody

from makebreak.models.effects.kind import full_name, is_added, one_dof_joints
from makebreak.models.effects.transmission import motor_joint
from makebreak.models.scene import LoadedScene, actuators_of_model

POSE = "qw qx qy qz x y z".split()
TWIST = "wx wy wz vx vy vz".split()


class _Effort(NamedTuple):
    """Of a motor: entry i of its model's efforts, up to its limit [N m]."""

    model: str
    i: int
    limit: float


class _Motion(NamedTuple):
    """Of a body that joints move: a column of its pose and twist."""

    body: RigidBody
    column: int


class SceneChannels:
    """The channels of a scene's plant by name; `<model>.<element>.<quantity>`.

    joints: {name: joint} with one degree of freedom, without motors' own; bodies:
    {name: body} that can move.
    """

    def __init__(self, loaded: LoadedScene):
        self._loaded, self._plant = loaded, loaded.plant
        self._scratch = loaded.plant.CreateDefaultContext()
        self._places: dict[str, int | _Effort | _Motion] = {}  # int: in the state.
        self._index_joints()
        self._index_bodies()
        self._index_motors()

    def __contains__(self, channel: str) -> bool:
        return channel in self._places

    def names(self) -> list[str]:
        """All of them."""
        return list(self._places)

    def state_index(self, channel: str) -> int | None:
        """Where in the state (n_x,) the channel is; None if it is no part of it."""
        place = self._places.get(channel)
        return place if isinstance(place, int) else None

    def is_effort(self, channel: str) -> bool:
        """Whether it is a motor's effort."""
        return isinstance(self._places[channel], _Effort)

    def true_values(
        self,
        channel: str,
        x: np.ndarray,
        efforts: dict[str, np.ndarray],
        motions: dict,
    ) -> np.ndarray:
        """(n,) true values of a channel [SI].

        Args: x (n, n_x): states; efforts: {model: (n, n_u)}, where they are asked for;
            motions: memory for the calls with the same states, empty at first.
        """
        place = self._places[channel]
        if isinstance(place, int):
            return x[:, place]
        if isinstance(place, _Effort):
            if self._loaded.is_link_side(channel):
                raise ValueError(
                    f"channel {channel!r} is a torque on the link's side (the scene's "
                    "channels say so); only the motor's side is simulated"
                )
            effort = efforts[place.model][:, place.i]
            return np.clip(effort, -place.limit, place.limit)
        if place.body.index() not in motions:
            motions[place.body.index()] = self._motion_of(place.body, x)
        return motions[place.body.index()][:, place.column]

    def _index_joints(self) -> None:
        plant = self._plant
        n_q = plant.num_positions()
        self.joints = {}
        for joint in one_dof_joints(plant):
            name = full_name(plant, joint)
            if not is_added(name):
                self.joints[name] = joint
            motor = motor_joint(plant, joint)
            for what in ("position", "velocity"):
                channel = f"{name}.{what}"
                own = joint
                if motor is not None and not self._loaded.is_link_side(channel):
                    own = motor
                self._places[channel] = (
                    own.position_start()
                    if what == "position"
                    else n_q + own.velocity_start()
                )

    def _index_bodies(self) -> None:
        plant = self._plant
        n_q = plant.num_positions()
        self.bodies = {}
        for i in range(plant.num_model_instances()):
            instance = ModelInstanceIndex(i)
            model = plant.GetModelInstanceName(instance)
            for index in plant.GetBodyIndices(instance):
                body = plant.get_body(index)
                if plant.IsAnchored(body) or is_added(model):
                    continue
                name = f"{model}.{body.name()}"
                self.bodies[name] = body
                for k, suffix in enumerate((*POSE, *TWIST)):
                    self._places[f"{name}.{suffix}"] = _Motion(body, k)
                if body.is_floating_base_body() and body.has_quaternion_dofs():
                    q = body.floating_positions_start()
                    v = n_q + body.floating_velocities_start_in_v()
                    for k, suffix in enumerate(POSE):
                        self._places[f"{name}.{suffix}"] = q + k
                    for k, suffix in enumerate(TWIST):
                        self._places[f"{name}.{suffix}"] = v + k

    def _index_motors(self) -> None:
        plant = self._plant
        for i in range(plant.num_model_instances()):
            model = plant.GetModelInstanceName(ModelInstanceIndex(i))
            if is_added(model):
                continue
            for k, actuator in enumerate(actuators_of_model(plant, model)):
                name = f"{full_name(plant, actuator.joint())}.effort_measured"
                self._places[name] = _Effort(model, k, actuator.effort_limit())

    def _motion_of(self, body: RigidBody, x: np.ndarray) -> np.ndarray:
        """(n, 13) pose and twist in world."""
        out = np.empty((len(x), len(POSE) + len(TWIST)))
        for k, each in enumerate(x):
            if not np.isfinite(each).all():
                out[k] = np.nan
                continue
            self._plant.SetPositionsAndVelocities(self._scratch, each)
            X_WB = self._plant.EvalBodyPoseInWorld(self._scratch, body)
            V_WB = self._plant.EvalBodySpatialVelocityInWorld(self._scratch, body)
            out[k, :4] = X_WB.rotation().ToQuaternion().wxyz()
            out[k, 4:7] = X_WB.translation()
            out[k, 7:] = V_WB.get_coeffs()
        return out

"""A real Panda behind Drake's LCM messages, with the ports of the simulated station.

    status message --> panda_status_receiver --> q, v, torques
    image message --> images --> overhead.rgb_image
    torque_commanded --> gravity_left_out --> panda_command_sender --> command message

The channels are those of drake-franka-driver, and one for images. Source: Drake's
pydrake.manipulation, drake::lcmt_panda_status, lcmt_panda_command; the driver's README
(RobotLocomotion/drake-franka-driver).
"""

import numpy as np
from drake import lcmt_image_array, lcmt_panda_command, lcmt_panda_status
from pydrake.common.value import AbstractValue
from pydrake.manipulation import (
    PandaCommandSender,
    PandaControlMode,
    PandaStatusReceiver,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, System
from pydrake.systems.lcm import _Serializer_  # What use_cpp_serializer=True takes.
from pydrake.systems.primitives import Gain, PassThrough
from pydrake.systems.sensors import LcmImageArrayToImages

from makebreak.diagrams.scene_facts import N_JOINTS
from makebreak.diagrams.station import ARM, DELAY, TIP_FRAME
from makebreak.systems.arm.gravity_left_out import GravityLeftOut
from makebreak.systems.arm.impedance_controller import serial_chain_of

STATUS, COMMAND, IMAGES = "PANDA_STATUS", "PANDA_COMMAND", "OVERHEAD_IMAGES"
URL = "udpm://239.255.76.67:7671?ttl=0"  # Packets do not leave this machine.
TORQUE_MODE = int(PandaControlMode.kTorque)
STATUS_PORT, IMAGES_PORT = "lcmt_panda_status", "lcmt_image_array"
COMMAND_PORT = "lcmt_panda_command"
_ARRAYS = (
    "joint_position", "joint_position_desired", "joint_velocity",
    "joint_velocity_desired", "joint_acceleration_desired", "joint_torque",
    "joint_torque_desired", "joint_torque_external",
)  # fmt: skip


def empty_status() -> lcmt_panda_status:
    """The status message of an arm at rest with all joints at zero."""
    status = lcmt_panda_status()
    status.num_joints = N_JOINTS
    for name in _ARRAYS:
        setattr(status, name, [0.0] * N_JOINTS)
    return status


def make_lcm_station(arm: MultibodyPlant) -> Diagram:
    """The ports of a station, made from LCM messages.

    Inputs:  lcmt_panda_status, lcmt_image_array (abstract): the newest messages;
             delay (1,) [s]: from a status to the time when its command acts;
             panda.torque_commanded (7,) [N m], gravity's torque included.
    Outputs: panda.position_measured, panda.velocity_measured (7,) [rad], [rad/s];
             panda.torque_measured (7,) [N m]: of the joint sensors, gravity included;
             panda.torque_external (7,) [N m]: of contacts on the joints (the driver
             sends the negative); overhead.rgb_image; panda.delay: the input;
             lcmt_panda_command (abstract): torque control, without gravity's torque,
             stamped with the Context's time.

    Args: arm: the control plant; the driver compensates its gravity.
    """
    builder = DiagramBuilder()
    receiver = builder.AddNamedSystem(
        "panda_status_receiver", PandaStatusReceiver(N_JOINTS)
    )
    builder.ExportInput(receiver.get_input_port(), STATUS_PORT)
    for name in ("position_measured", "velocity_measured", "torque_measured"):
        builder.ExportOutput(receiver.GetOutputPort(name), f"{ARM}.{name}")
    external = builder.AddNamedSystem("external", Gain(-np.ones(N_JOINTS)))
    builder.Connect(
        receiver.GetOutputPort("torque_external"), external.get_input_port()
    )
    builder.ExportOutput(external.get_output_port(), f"{ARM}.torque_external")

    images = builder.AddNamedSystem("images", LcmImageArrayToImages())
    builder.ExportInput(images.get_input_port(), IMAGES_PORT)
    builder.ExportOutput(images.GetOutputPort("color_image"), "overhead.rgb_image")

    passed = builder.AddNamedSystem("delay", PassThrough(1))
    builder.ExportInput(passed.get_input_port(), "delay")
    builder.ExportOutput(passed.get_output_port(), DELAY)

    left_out = builder.AddNamedSystem(
        "gravity_left_out", GravityLeftOut(serial_chain_of(arm, TIP_FRAME))
    )
    builder.ExportInput(left_out.GetInputPort("tau"), f"{ARM}.torque_commanded")
    builder.Connect(
        receiver.GetOutputPort("position_measured"), left_out.GetInputPort("q")
    )
    sender = builder.AddNamedSystem(
        "panda_command_sender", PandaCommandSender(N_JOINTS, TORQUE_MODE)
    )
    builder.Connect(left_out.GetOutputPort("torque"), sender.GetInputPort("torque"))
    builder.ExportOutput(sender.get_output_port(), COMMAND_PORT)
    diagram = builder.Build()
    diagram.set_name("station")
    return diagram


class Messages:
    """Converts LCM messages between bytes and the C++ messages in a Context's ports,
    which Python cannot read or write otherwise."""

    def __init__(self):
        self._kinds = {
            STATUS_PORT: _Serializer_[lcmt_panda_status](),
            IMAGES_PORT: _Serializer_[lcmt_image_array](),
            COMMAND_PORT: _Serializer_[lcmt_panda_command](),
        }

    def fix(self, diagram: Diagram, context: Context, port: str, data: bytes) -> None:
        """Sets the exported input `port` of a diagram to a message."""
        value = self._kinds[port].CreateDefaultValue()
        self._kinds[port].Deserialize(data, value)
        diagram.GetInputPort(port).FixValue(context, value)

    def read(self, system: System, context: Context, port: str) -> bytes:
        """The message at the output `port` of a system. Args: context: the system's."""
        return self.encode(port, system.GetOutputPort(port).EvalAbstract(context))

    def encode(self, port: str, value: AbstractValue) -> bytes:
        """The bytes of a C++ message of the type of `port`."""
        return self._kinds[port].Serialize(value)


def no_images() -> bytes:
    """An image message without an image."""
    message = lcmt_image_array()
    message.num_images, message.images = 0, []
    return message.encode()

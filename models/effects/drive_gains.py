"""Changes of a drive's own gains, as effects."""

from makebreak.models.effects.kind import Effect


def other_kp(joint: str, kp: float) -> Effect:
    """A position servo with this stiffness [N m/rad, N/m]."""
    return Effect("servo_gain", [joint], {"kp": kp})


def other_gain(joint: str, gain: float) -> Effect:
    """A drive that gives so many times what it should."""
    return Effect("actuator_gain", [joint], {"gain": gain})


def more_damping(joint: str, damping: float) -> Effect:
    """A drive that damps by so much more [N m s/rad, N s/m]."""
    return Effect("joint_viscous_damping", [joint], {"damping": damping})

"""Adaptive control for robots that make and break contact, on Drake."""

from importlib import import_module
from pathlib import Path

__version__ = "0.1.0"

# What users import, and where it is; imported when asked for, so that `import
# makebreak` alone is cheap.
_EXPORTS = {
    "ContactMpcConfig": "diagrams.contact_mpc",
    "make_contact_mpc": "diagrams.contact_mpc",
    "AnitescuLcs": "systems.contact_mpc.lcs_builder",
    "AnitescuLcsBuilder": "systems.contact_mpc.lcs_builder",
    "ContactPair": "systems.contact_mpc.lcs_builder",
    "LcsBuilderConfig": "systems.contact_mpc.lcs_builder",
    "C3Config": "systems.contact_mpc.c3_mpc",
    "C3Mpc": "systems.contact_mpc.c3_mpc",
    "C3Bounds": "systems.contact_mpc.numerics.c3_mpc",
    "C3Options": "systems.contact_mpc.numerics.c3_mpc",
    "C3Problem": "systems.contact_mpc.numerics.c3_mpc",
    "C3Weights": "systems.contact_mpc.numerics.c3_mpc",
    "solve_c3": "systems.contact_mpc.numerics.c3_mpc",
    "ExactProjection": "systems.contact_mpc.numerics.c3_projections",
    "PlusProjection": "systems.contact_mpc.numerics.c3_projections",
    "QpProjection": "systems.contact_mpc.numerics.c3_projections",
    "LCS": "systems.contact_mpc.numerics.lcs",
    "simulate": "systems.contact_mpc.numerics.lcs",
    "LcsPlant": "systems.contact_mpc.lcs_plant",
    "PosteriorConfig": "systems.contact_mpc.residual_learner",
    "ResidualLearner": "systems.contact_mpc.residual_learner",
    "ResidualLearnerConfig": "systems.contact_mpc.residual_learner",
    "ContactDetector": "systems.changing_contact.contact_detector",
    "ContactDetectorConfig": "systems.changing_contact.contact_detector",
    "MotionPattern": "systems.changing_contact.numerics.motion_pattern",
    "Segment": "systems.changing_contact.numerics.motion_pattern",
    "Anitescu": "systems.contact_mpc.lcs_builder",
    "StewartTrinkle": "systems.contact_mpc.lcs_builder",
    "OrientationWeight": "systems.contact_mpc.numerics.c3_mpc",
    "ModeDetector": "systems.changing_contact.mode_detector",
    "ModeDetectorConfig": "systems.changing_contact.mode_detector",
    "KalmanContactAnticipator": "systems.changing_contact.contact_anticipator",
    "ContactAnticipatorConfig": "systems.changing_contact.contact_anticipator",
    "VelocityShaper": "systems.changing_contact.velocity_shaper",
    "VelocityShaperConfig": "systems.changing_contact.velocity_shaper",
    "ContactSampler": "systems.contact_mpc.contact_sampler",
    "ContactSamplerConfig": "systems.contact_mpc.contact_sampler",
    "PoseTracker": "systems.perception.pose_tracker",
    "PoseTrackerConfig": "systems.perception.pose_tracker",
    "Marker": "systems.perception.pose_tracker",
    "PushedObject": "models.pushed_object",
    "make_tip_and_object": "models.pushed_object",
    "ImpedanceController": "systems.arm.impedance_controller",
    "ImpedanceConfig": "systems.arm.impedance_controller",
    "serial_chain_of": "systems.arm.impedance_controller",
    "TipState": "systems.arm.tip_state",
}
__all__ = ["model_path", *_EXPORTS]


def __getattr__(name: str):
    if name not in _EXPORTS:
        raise AttributeError(f"module 'makebreak' has no attribute {name!r}")
    return getattr(import_module(f"makebreak.{_EXPORTS[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_EXPORTS]


def model_path(name: str) -> str:
    """The path of a model file that comes with makebreak, as "puck.sdf".

    Raises: ValueError, with the names that there are.
    """
    folder = Path(__file__).parent / "models"
    if not (folder / name).is_file():
        there = sorted(p.name for p in folder.glob("*.[su]*df"))
        raise ValueError(f"no model file is named {name!r}, expected one of {there}")
    return str(folder / name)

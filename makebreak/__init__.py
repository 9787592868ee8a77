"""Adaptive control for robots that make and break contact, on Drake."""

from importlib import import_module
from pathlib import Path

__version__ = "0.1.0"

# What users import, and where it is; imported when asked for, so that `import
# makebreak` alone is cheap.
_EXPORTS = {
    "ContactMpcConfig": "diagrams.contact_mpc",
    "make_contact_mpc": "diagrams.contact_mpc",
    "AnitescuLcs": "systems.lcs_builder",
    "AnitescuLcsBuilder": "systems.lcs_builder",
    "ContactPair": "systems.lcs_builder",
    "LcsBuilderConfig": "systems.lcs_builder",
    "C3Config": "systems.c3_mpc",
    "C3Mpc": "systems.c3_mpc",
    "C3Bounds": "systems.numerics.c3_mpc",
    "C3Options": "systems.numerics.c3_mpc",
    "C3Problem": "systems.numerics.c3_mpc",
    "C3Weights": "systems.numerics.c3_mpc",
    "solve_c3": "systems.numerics.c3_mpc",
    "ExactProjection": "systems.numerics.c3_projections",
    "PlusProjection": "systems.numerics.c3_projections",
    "QpProjection": "systems.numerics.c3_projections",
    "LCS": "systems.numerics.lcs",
    "simulate": "systems.numerics.lcs",
    "LcsPlant": "systems.lcs_plant",
    "ResidualLearner": "systems.residual_learner",
    "ResidualLearnerConfig": "systems.residual_learner",
    "ContactDetector": "systems.contact_detector",
    "ContactDetectorConfig": "systems.contact_detector",
    "MotionPattern": "systems.numerics.motion_pattern",
    "Segment": "systems.numerics.motion_pattern",
    "Anitescu": "systems.lcs_builder",
    "StewartTrinkle": "systems.lcs_builder",
    "OrientationWeight": "systems.numerics.c3_mpc",
    "ModeDetector": "systems.mode_detector",
    "ModeDetectorConfig": "systems.mode_detector",
    "KalmanContactAnticipator": "systems.contact_anticipator",
    "ContactAnticipatorConfig": "systems.contact_anticipator",
    "VelocityShaper": "systems.velocity_shaper",
    "VelocityShaperConfig": "systems.velocity_shaper",
    "ContactSampler": "systems.contact_sampler",
    "ContactSamplerConfig": "systems.contact_sampler",
    "PoseTracker": "systems.pose_tracker",
    "PoseTrackerConfig": "systems.pose_tracker",
    "Marker": "systems.pose_tracker",
    "PushedObject": "models.pushed_object",
    "make_tip_and_object": "models.pushed_object",
    "ImpedanceController": "systems.impedance_controller",
    "ImpedanceConfig": "systems.impedance_controller",
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

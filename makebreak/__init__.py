"""Adaptive control for robots that make and break contact, on Drake."""

from pathlib import Path
from typing import TYPE_CHECKING

from makebreak.lazy import offered

__version__ = "0.1.0"

# What users import; imported when asked for, so that `import makebreak` alone is cheap.
if TYPE_CHECKING:
    from makebreak.diagrams.contact_mpc import (
        ContactMpcConfig as ContactMpcConfig,
        KnotWeights as KnotWeights,
        make_contact_mpc as make_contact_mpc,
        tuned as tuned,
    )
    from makebreak.models.pushed_object import (
        PushedObject as PushedObject,
        make_tip_and_object as make_tip_and_object,
    )
    from makebreak.systems.arm.impedance_controller import (
        ImpedanceConfig as ImpedanceConfig,
        ImpedanceController as ImpedanceController,
        serial_chain_of as serial_chain_of,
    )
    from makebreak.systems.arm.tip_state import TipState as TipState
    from makebreak.systems.changing_contact.contact_anticipator import (
        ContactAnticipatorConfig as ContactAnticipatorConfig,
        KalmanContactAnticipator as KalmanContactAnticipator,
    )
    from makebreak.systems.changing_contact.contact_detector import (
        ContactDetector as ContactDetector,
        ContactDetectorConfig as ContactDetectorConfig,
    )
    from makebreak.systems.changing_contact.mode_detector import (
        ModeDetector as ModeDetector,
        ModeDetectorConfig as ModeDetectorConfig,
    )
    from makebreak.systems.changing_contact.numerics.motion_pattern import (
        MotionPattern as MotionPattern,
        Segment as Segment,
    )
    from makebreak.systems.changing_contact.velocity_shaper import (
        VelocityShaper as VelocityShaper,
        VelocityShaperConfig as VelocityShaperConfig,
    )
    from makebreak.systems.contact_mpc.c3_mpc import (
        C3Config as C3Config,
        C3Mpc as C3Mpc,
    )
    from makebreak.systems.contact_mpc.contact_sampler import (
        ContactSampler as ContactSampler,
        ContactSamplerConfig as ContactSamplerConfig,
    )
    from makebreak.systems.contact_mpc.lcs_builder import (
        Anitescu as Anitescu,
        AnitescuLcs as AnitescuLcs,
        AnitescuLcsBuilder as AnitescuLcsBuilder,
        ContactPair as ContactPair,
        LcsBuilderConfig as LcsBuilderConfig,
        StewartTrinkle as StewartTrinkle,
    )
    from makebreak.systems.contact_mpc.lcs_plant import LcsPlant as LcsPlant
    from makebreak.systems.contact_mpc.numerics.c3_linear import (
        LinearBound as LinearBound,
    )
    from makebreak.systems.contact_mpc.numerics.c3_mpc import (
        C3Bounds as C3Bounds,
        C3Options as C3Options,
        C3Problem as C3Problem,
        C3Weights as C3Weights,
        OrientationWeight as OrientationWeight,
        solve_c3 as solve_c3,
    )
    from makebreak.systems.contact_mpc.numerics.c3_projections import (
        ExactProjection as ExactProjection,
        PlusProjection as PlusProjection,
        QpProjection as QpProjection,
    )
    from makebreak.systems.contact_mpc.numerics.lcs import (
        LCS as LCS,
        simulate as simulate,
    )
    from makebreak.systems.contact_mpc.multibody.model_parameters import (
        Parameter as Parameter,
    )
    from makebreak.systems.contact_mpc.parameter_learner import (
        ParameterLearner as ParameterLearner,
        ParameterLearnerConfig as ParameterLearnerConfig,
    )
    from makebreak.systems.contact_mpc.residual_learner import (
        AdamConfig as AdamConfig,
        FreeStatesConfig as FreeStatesConfig,
        PosteriorConfig as PosteriorConfig,
        ResidualLearner as ResidualLearner,
        ResidualLearnerConfig as ResidualLearnerConfig,
        WalkConfig as WalkConfig,
    )
    from makebreak.systems.perception.pose_tracker import (
        Marker as Marker,
        PoseTracker as PoseTracker,
        PoseTrackerConfig as PoseTrackerConfig,
    )
else:
    __getattr__, __dir__, __all__ = offered(__name__)
    __all__.append("model_path")


def model_path(name: str) -> str:
    """The path of a model file that comes with makebreak, as "puck.sdf".

    Raises: ValueError, with the names that there are.
    """
    folder = Path(__file__).parent / "models"
    if not (folder / name).is_file():
        there = sorted(p.name for p in folder.glob("*.[su]*df"))
        raise ValueError(f"no model file is named {name!r}, expected one of {there}")
    return str(folder / name)

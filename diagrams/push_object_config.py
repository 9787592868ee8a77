"""The settings of push_object, and those of its planner and learner made from them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from makebreak.diagrams.camera import CameraConfig
from makebreak.diagrams.learned_parameters import to_learn
from makebreak.models.model_files import MODELS
from makebreak.models.pushed_object import PushedObject, support_spheres
from makebreak.systems.arm.arm_reference import (
    ArmReferenceConfig,
    ReferenceLimits,
    TouchConfig,
)
from makebreak.systems.arm.impedance_controller import ImpedanceConfig
from makebreak.systems.changing_contact.touch_down import TouchDownConfig
from makebreak.systems.contact_mpc.c3_mpc import C3Config
from makebreak.systems.contact_mpc.contact_sampler import ContactSamplerConfig
from makebreak.systems.contact_mpc.lcs_builder import ContactPair
from makebreak.systems.contact_mpc.multibody.model_parameters import Parameter
from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    Q_BALL,
    V_BALL,
    V_TIP,
    W_BALL,
    plus_weights,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import (
    C3Options,
    C3Weights,
    OrientationWeight,
)
from makebreak.systems.contact_mpc.numerics.contact_sampling import (
    ReachConfig,
    SamplingConfig,
)
from makebreak.systems.contact_mpc.parameter_learner import ParameterLearnerConfig
from makebreak.systems.contact_mpc.push_goals import PushGoalsConfig
from makebreak.systems.contact_mpc.push_task import PushTaskConfig
from makebreak.systems.contact_mpc.residual_learner import (
    FreeStatesConfig,
    PosteriorConfig,
    ResidualLearnerConfig,
    WalkConfig,
)
from makebreak.systems.perception.pose_sensor import PoseSensorConfig
from makebreak.systems.perception.pose_tracker import PoseTrackerConfig

PUSH_OBJECT = str(MODELS / "push_object.scene.yaml")
OBJECT = "object"  # Name of the object's model instance and of its body.
# Periods of planner and task, state estimator, learner, impedance controller [s].
CONTROL = 0.0125
ESTIMATE, LEARN, ARM_TICK = CONTROL / 3.0, 0.05, 0.001
# Phase of each system's events [s]. As in ball_rolling, each system runs a little after
# those whose outputs it reads, within the millisecond between two steps of the plant.
# Only the sampler's choice and the residual are used one period late.
OFFSET = dict(
    sensor=1e-4, estimator=2e-4, goals=2.5e-4, past=2.5e-4, task=3e-4, lcs=3e-4,
    touch=3.2e-4,
    learner=3.5e-4, sampler=3.5e-4, c3=4e-4, reference=4.5e-4, impedance=7e-4,
)  # fmt: skip
PLAN_DT = 0.1  # Time step of the planner's LCS [s].
TIP_MASS = 1.0  # Mass of the point that stands for the arm in the planner's model [kg].
# Friction of tip and object along the vertical over that across it, for the learner of
# parameters. A finger that leans touches the object's upper edge, whose normal is
# tilted by up to half a right angle, and presses or lifts more than the tip's sphere,
# which alone is modelled, could by friction.
LEANING = 4.0
# Radius of gyration added against tilting in the model of the learner [m]. The height
# at which the tip touches is not known (LEANING), and so is not the moment of its force
# about a horizontal axis: 2 N that are 16 mm higher turn this by a third of what counts
# as noise. A press on the object's edge was taken for a mass that keeps it down.
STEADY = 0.2
# Weight of an object that slides in the planner's model over its own, whose friction
# with the table is as much lower, so that it takes the same force to slide it.
# Anitescu's contact throws what slides upwards with mu |v_t|: past the tip, whose
# friction then holds it down, and so fast that its inertia is 1 + mu^2 times its own.
WEIGHT = 4.0
N_TIP = 4  # The first entries of lam: the contact of tip and object.
# Settings of the systems that make_push_object computes, so that users cannot.
SET_BY_DIAGRAM = {
    "goals": ("period_sec", "offset_sec"),
    "task": ("height", "clearance", "period_sec", "offset_sec"),
    "sampler": ("angle_radius", "residual_dt_sec", "offset_sec"),
    "reference": ("height", "nearest", "wrist", "period_sec", "offset_sec"),
    "impedance": ("period_sec", "offset_sec"),
    "pose": ("height", "rolling_axis", "offset_sec"),
    "tracker": ("z", "hue", "rolling_axis", "period_sec", "offset_sec"),
}


@dataclass
class PushPlannerConfig:
    """Horizon and cost of C3+; forces in newtons."""

    # Knots of the plan are 0.1 s (PLAN_DT) apart.
    options: C3Options = field(
        default_factory=lambda: C3Options(N=5, rounds=2, rho=2.2, polish=6)
    )
    position: float = 5000.0  # Weight of the object's position on the table [1/m2].
    # Radius at which an angle of the object costs as much as its arc as a distance [m].
    angle_radius: float = 0.12
    # Weight of the object's pose at the last knot over that at the others.
    last: float = 5.0
    tip_height: float = 1e4  # Weight of the tip's height [1/m2].
    tip_speed: float = 10.0  # Weight of the tip's velocity [s2/m2].
    # Time for which a rolling object rolls on after the plan's end: its speed there
    # costs as much as the distance in this time [s].
    coast_sec: float = 1.0


@dataclass
class PushLearnerConfig:
    """The residual of the contact of tip and object, learned as in ball_rolling.

    The weights Q_d are inverse variances of velocity changes over a step of 50 ms: v_x
    and v_y of the object and of the tip (a wrong gap changes the tip's velocity too).
    The pose at a past time (PastState) is accurate to 0.8 mm, which is 16 mm/s. The
    present pose, the only one with a camera, is a few hundredths of a second old when a
    push begins: the tip then seems to be up to 5 mm inside the object, 0.08 m/s.
    """

    # Q_d of v_x and v_y of object and tip, with past poses [s2/m2].
    weight: float = 4e3
    # Q_d of the same velocities, with present poses (pose_from=camera) [s2/m2].
    weight_late: float = 150.0
    # Weight eps of the dynamics against the contact equation [m/s N].
    eps: float = 1e-3
    gamma: float = 5e-4  # Softness gamma of the contact equation [m/s per N].
    # Largest magnitude of the residual [m/s]; 0.3 is a gap of 15 mm.
    r_max: float = 0.3
    # Noise of the measured gap speed mu |v_t| of a sliding contact; what exceeds it is
    # not taken for a gap [m/s].
    slip_noise: float = 0.03
    posterior: PosteriorConfig = field(
        default_factory=lambda: PosteriorConfig(
            prior_std=0.16,
            walk=WalkConfig(drift=0.02),
            spacing=0.01,
            misfit_sec=None,  # `trust` was chosen for this model's errors.
            free=FreeStatesConfig([V_BALL.start, V_BALL.start + 1]),
        )
    )


@dataclass
class PushParametersConfig:
    """What learner=parameters learns, and how well the model knows it: standard
    deviations; 0: not learned."""

    mass: float = 0.5  # Deviation of the logarithm of the object's mass.
    # Deviation of the logarithm of the friction of tip and object, and of object and
    # table.
    friction: float = 0.5
    gap: float = 0.004  # Deviation of the distance of tip and object [m].
    # Deviation of the object's centre of mass along x and along y [m].
    com: float = 0.0
    # Weights Q_d of the tip's velocities, and of the object's [s2/m2].
    weight: float = 4e3
    # Radius at which the object's turning counts with the same weight [m].
    turn_radius: float = 0.05
    # Deviation of the gap speed of a closed contact [m/s].
    contact_std: float = 0.02


@dataclass
class PushModelConfig:
    """In what the controllers' model differs from the world."""

    # Scene file of the model's arm and table; null: the world's without its effects,
    # which stand for what no model knows.
    scene: str | None = None
    # Coefficient of friction of the object with tip and table in the model; null: the
    # world's.
    friction: float | None = None
    scale: float = 1.0  # Size of the object in the model over that in the world.
    mass: float = 1.0  # Mass of the object in the model over that in the world.
    # Error in x and y of the centre of mass in the model, added to the world's [m].
    com_offset: list[float] = field(default_factory=lambda: [0.0, 0.0])


@dataclass
class PushObjectConfig:
    """World and model start from the same object; `model` holds the model's errors."""

    adapt: bool = True  # Whether anything is learned; false: as learner=none.
    # What is learned: r_comp (residual of the contact of tip and object), parameters
    # (mass, friction and gap; settings parameters), or none.
    learner: Literal["none", "r_comp", "parameters"] = "r_comp"
    object: PushedObject = field(default_factory=PushedObject)
    # Coefficient of friction of the object with tip and table in the world.
    friction: float = 0.5
    # Rolling resistance of a cylinder in the world, as lever arm over radius, which no
    # model knows; null: 0.005, as of the ball of ball_rolling.
    rolling_resistance: float | None = None
    model: PushModelConfig = field(default_factory=PushModelConfig)
    scene: str = PUSH_OBJECT  # Scene file of the simulated world.
    # Errors of the station that the model lacks: none, lab or poor.
    realism: str = "none"
    # Seed of the initial pose, the goals, the station's errors and the sensors' noise.
    seed: int = 0
    n_goals: int = 1  # Number of goals in a row, drawn by the seed.
    # Initial pose of the object, [x, y, yaw] [m], [rad]; empty: drawn by the seed.
    start: list[float] = field(default_factory=list)
    goals: PushGoalsConfig = field(default_factory=PushGoalsConfig)
    # What measures the object's pose: sensor (such as motion capture) or camera.
    pose_from: Literal["sensor", "camera"] = "sensor"
    pose: PoseSensorConfig = field(default_factory=PoseSensorConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    tracker: PoseTrackerConfig = field(default_factory=PoseTrackerConfig)
    sampler: ContactSamplerConfig = field(
        default_factory=lambda: ContactSamplerConfig(
            SamplingConfig(reach=ReachConfig([0.32, 0.78]))
        )
    )
    task: PushTaskConfig = field(default_factory=PushTaskConfig)
    planner: PushPlannerConfig = field(default_factory=PushPlannerConfig)
    learning: PushLearnerConfig = field(default_factory=PushLearnerConfig)
    parameters: PushParametersConfig = field(default_factory=PushParametersConfig)
    # Whether the speed before a touch is learned, and reduced where a touch is
    # expected.
    gentle: bool = False
    touch: TouchDownConfig = field(default_factory=TouchDownConfig)
    reference: ArmReferenceConfig = field(
        default_factory=lambda: ArmReferenceConfig(
            tip_mass=TIP_MASS,
            limits=ReferenceLimits(force_max=8.0, acceleration_max=3.0, push_speed=0.2),
            touch=TouchConfig(speed=0.15),
        )
    )
    impedance: ImpedanceConfig = field(
        default_factory=lambda: ImpedanceConfig(force_max=20.0)
    )
    # Faults of sensors, motors and arm to inject, each NAME[:from=S,for=S] as of
    # --fault.
    faults: list[str] = field(default_factory=list)


def rolling_axis(spec: PushedObject) -> list[float]:
    """Axis (3,) in the object's frame about which it rolls; empty: it does not roll."""
    return [1.0, 0.0, 0.0] if spec.shape == "cylinder" else []


def contact_pairs(
    spec: PushedObject, friction: float, weight: float = 1.0
) -> list[ContactPair]:
    """Contacts of an LCS: tip and object, then each support of the object with the
    table, for an object of so many times its weight."""
    n = len(support_spheres(spec)[0])
    # Friction edges along the vertical do not jump as the normal turns about it.
    tip = ContactPair(
        "tip::tip", f"{OBJECT}::{OBJECT}", friction, tangent=[0.0, 0.0, 1.0], closest=1
    )
    return [tip] + [
        ContactPair(f"{OBJECT}::support_{i}", "table::table", friction / weight)
        for i in range(n)
    ]


def c3_config(
    planner: PushPlannerConfig, n_lam: int, axis: Sequence[float] = ()
) -> C3Config:
    """Weights and options of C3+.

    Args: n_lam: forces of the LCS; axis: about which the object rolls (rolling_axis). A
        turn about it costs nothing, and the final speed costs (coast_sec).
    Raises: ValueError for a weight out of range.
    """
    p = planner
    if not 0.0 <= p.coast_sec < np.inf:
        raise ValueError(f"planner.coast_sec is {p.coast_sec}, expected >= 0")
    for name in ("position", "angle_radius", "last", "tip_height", "tip_speed"):
        if not getattr(p, name) > 0.0:
            raise ValueError(f"planner.{name} is {getattr(p, name)}, expected > 0")
    Q = np.zeros(N_X)
    Q[2], Q[V_TIP] = p.tip_height, p.tip_speed
    Q[P_BALL.start : P_BALL.start + 2], Q[V_BALL] = p.position, 20.0
    Q_N = Q.copy()
    Q_N[P_BALL.start : P_BALL.start + 2] *= p.last
    if axis:
        Q_N[V_BALL] += p.last * p.position * p.coast_sec**2
    G = plus_weights(force=5.0, n_lam=n_lam, n_tip=N_TIP)
    turn = p.position * p.angle_radius**2
    return C3Config(
        weights=C3Weights(
            Q, np.full(3, 0.01), G, G, Q_N=Q_N,
            orientation=[
                OrientationWeight(
                    Q_BALL.start, turn, p.last * turn, list(axis) if axis else None
                )
            ],
        ),
        options=p.options,
        residual_dt_sec=LEARN,
        sliding_command=True,
    )  # fmt: skip


def learner_config(learner: PushLearnerConfig, late: bool) -> ResidualLearnerConfig:
    """Config of the learner.

    Args: late: whether the learner uses present poses instead of past ones.
    Raises: ValueError for a negative weight.
    """
    weight = learner.weight_late if late else learner.weight
    if not weight >= 0.0:
        name = "weight_late" if late else "weight"
        raise ValueError(f"learning.{name} is {weight}, expected >= 0")
    Q_d = np.zeros(N_X)
    Q_d[[V_TIP.start, V_TIP.start + 1, V_BALL.start, V_BALL.start + 1]] = weight
    return ResidualLearnerConfig(
        Q_d=Q_d.tolist(),
        eps=learner.eps,
        gamma=learner.gamma,
        groups=[list(range(N_TIP))],
        r_max=learner.r_max,
        slip_noise=learner.slip_noise,
        posterior=learner.posterior,
    )


def learned_parameters(config: PushObjectConfig) -> list[Parameter]:
    """Those of learner=parameters; the pairs are those of contact_pairs.

    Raises: ValueError for none, or a negative deviation.
    """
    if not config.adapt or config.learner != "parameters":
        return []
    own = config.parameters
    n = len(support_spheres(config.object)[0])
    table = list(range(1, n + 1))
    return to_learn(own, ("mass", "friction", "gap", "com"), lambda: [
        Parameter("mass", own.mass, OBJECT),
        Parameter("com_x", own.com, OBJECT),
        Parameter("com_y", own.com, OBJECT),
        Parameter("friction", own.friction, pairs=[0], caution=1.0),
        Parameter("friction", own.friction, pairs=table),
        Parameter("gap", own.gap, pairs=[0]),
    ])  # fmt: skip


def parameter_learner_config(
    own: PushParametersConfig, pairs: list[ContactPair], items: list[Parameter]
) -> ParameterLearnerConfig:
    """Config of the learner of these parameters of contact_pairs."""
    pairs = [replace(pairs[0], anisotropy=LEANING), *pairs[1:]]
    Q_d = np.zeros(N_X)
    Q_d[V_TIP] = Q_d[V_BALL] = own.weight  # It stays on the table, too.
    Q_d[W_BALL] = own.weight * own.turn_radius**2
    return ParameterLearnerConfig(pairs, items, Q_d.tolist(), own.contact_std)

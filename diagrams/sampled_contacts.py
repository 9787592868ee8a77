"""ball_rolling with ContactSampler instead of a hand-written sequence of touches.

    state_estimator --x--> path_target --x_desired--> c3_mpc, contact_sampler
    path_target --goal (the next point on the circle)--> contact_sampler, push_task
    contact_sampler --command (where to touch)--> push_task, --guess--> c3_mpc
    c3_mpc (contact), push_task (travel) --> arm_reference

The tip pushes the ball from the side, at constant height. All else is as in
ball_rolling.
"""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from makebreak.diagrams import wiring
from makebreak.diagrams.wiring import refuse_changed
from makebreak.models.tip_and_ball import TipAndBall
from makebreak.systems.arm.arm_reference import ArmReferenceConfig, ReferenceLimits
from makebreak.systems.contact_mpc.c3_mpc import C3Config
from makebreak.systems.contact_mpc.contact_sampler import (
    ContactSampler,
    ContactSamplerConfig,
)
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs
from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    V_BALL,
    V_TIP,
    W_BALL,
    plus_weights,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import (
    C3Options,
    C3Problem,
    C3Weights,
)
from makebreak.systems.contact_mpc.numerics.contact_sampling import (
    ChangeConfig,
    ObjectShape,
    ReachConfig,
    SamplingConfig,
)
from makebreak.systems.contact_mpc.numerics.push_task import (
    PushConfig,
    TravelConfig,
    UnseenConfig,
)
from makebreak.systems.contact_mpc.numerics.rolling_task import CircleConfig
from makebreak.systems.contact_mpc.path_target import PathTarget, PathTargetConfig
from makebreak.systems.contact_mpc.push_task import PushTask, PushTaskConfig

CORNERS = 24  # Of the polygon inscribed in the ball's outline; error below 0.3 mm.


@dataclass
class SampledPlannerConfig:
    """Weights of C3+, with forces in newtons."""

    # Knots of the plan are 0.1 s apart.
    options: C3Options = field(
        default_factory=lambda: C3Options(N=5, rounds=2, rho=2.2, polish=6)
    )
    position: float = 5000.0  # Q of the ball's x and y [1/m2].
    # Q of the ball's velocity v, and of w R with its angular velocity w [s2/m2].
    velocity: float = 100.0
    # Q of the tip's x and y [1/m2]. Its target is beside the ball, on the side from
    # which it is pushed next: without contact nothing else places the tip.
    tip: float = 3000.0
    tip_height: float = 1e4  # Q of the tip's z [1/m2].
    tip_speed: float = 10.0  # Q of the tip's velocity [s2/m2].
    # Consensus weight G of lam of tip and ball; that of eta is 1/10 of it.
    force: float = 5.0
    # Coefficient of friction of both contacts in the model, for planning and learning.
    friction: float = 0.5


@dataclass
class SampledContactsConfig:
    """Settings of ball_rolling where the planner samples where to touch."""

    path: PathTargetConfig = field(default_factory=PathTargetConfig)
    planner: SampledPlannerConfig = field(default_factory=SampledPlannerConfig)
    sampler: ContactSamplerConfig = field(
        default_factory=lambda: ContactSamplerConfig(
            SamplingConfig(
                height=0.038,
                reach=ReachConfig([0.35, 0.78], cost=0.0),
                change=ChangeConfig(travel=5.0, hysteresis=[0.3, 1.0], keep_sec=0.5),
                push=0.5,
                follow=True,
            )
        )
    )
    push: PushConfig = field(
        default_factory=lambda: PushConfig(
            TravelConfig(around=True),
            unseen=UnseenConfig(believed_sec=0.5),
            follow=True,
            place_change=0.0,
        )
    )
    # Q_d of the ball's v_x and v_y [s2/m2]; 2e4: a standard deviation of 7 mm/s. The
    # tip has none, as the arm hardly feels a ball beside it.
    learning_weight: float = 2e4
    # Weight eps of the learner, in place of learning.eps [m/s N]: pushing from the side
    # takes far less force than from above, so a force over a gap has to cost more.
    learning_eps: float = 1e-4
    # Drift of the learner's posterior, in place of posterior.walk.drift [m/s /
    # sqrt(s)]: at constant height the contact normal's slope is constant, and so is the
    # gap residual.
    learning_drift: float = 0.005
    # Length that is subtracted from the learned gap [m]: the camera's delay makes it
    # 1.5 to 3 mm too large, and the tip would strike the ball.
    gap_allowance: float = 0.003
    reference: ArmReferenceConfig = field(
        default_factory=lambda: ArmReferenceConfig(
            limits=ReferenceLimits(force_max=8.0, acceleration_max=3.0)
        )
    )


def check_contacts(config: SampledContactsConfig) -> None:
    """Raises: ValueError for values out of range, or that the diagram sets itself."""
    p = config.planner
    for name in (
        "position",
        "velocity",
        "tip",
        "tip_height",
        "tip_speed",
        "force",
        "friction",
    ):
        if not getattr(p, name) > 0.0:
            raise ValueError(
                f"contacts.planner.{name} is {getattr(p, name)}, expected > 0"
            )
    for name in ("learning_weight", "learning_drift", "gap_allowance"):
        if not 0.0 <= getattr(config, name) < np.inf:
            raise ValueError(
                f"contacts.{name} is {getattr(config, name)}, expected >= 0"
            )
    if not config.learning_eps > 0.0:
        raise ValueError(
            f"contacts.learning_eps is {config.learning_eps}, expected > 0"
        )
    refuse_changed(
        "contacts.path", config.path,
        ("height", "period_sec", "offset_sec"),
    )  # fmt: skip
    refuse_changed("contacts.path.circle", config.path.circle, ("center", "radius"))
    refuse_changed(
        "contacts.sampler", config.sampler,
        ("angle_radius", "residual_dt_sec", "offset_sec"),
    )  # fmt: skip
    refuse_changed(
        "contacts.reference", config.reference,
        ("tip_mass", "height", "period_sec", "offset_sec"),
    )  # fmt: skip
    for name in ("push", "sampler.sampling"):
        part = config.push if name == "push" else config.sampler.sampling
        if not part.follow:
            raise ValueError(f"contacts.{name}.follow is false, expected true")


def beside(model: TipAndBall, height: float) -> float:
    """Horizontal distance [m] from the ball's centre to the surface of a tip that
    touches the ball, with the tip's centre at `height` [m]; negative if it cannot."""
    R, r = model.ball_radius, model.tip_radius
    return float(np.sqrt(max((R + r) ** 2 - (height - R) ** 2, 0.0)) - r)


def ball_shape(model: TipAndBall, height: float) -> ObjectShape:
    """The ball as an outline in the plane, for a tip with its centre at `height` [m]:
    the horizontal distances of tip and outline are those of tip and ball.

    Raises: ValueError for a height at which the tip does not touch the ball's side.
    """
    R, r = model.ball_radius, model.tip_radius
    radius = beside(model, height)
    if not r < height < 2.0 * R:
        raise ValueError(
            f"contacts.sampler.sampling.height is {height:g}, expected above the tip's "
            f"radius, {r:g}, and below the ball's top, {2.0 * R:g} m"
        )
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    ring = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    return ObjectShape([ring], r, 2.0 * R)


def sampled_c3_config(
    planner: SampledPlannerConfig, n_lam: int, n_tip: int, radius: float, residual_dt
) -> C3Config:
    """C3's settings. Args: n_tip: number of forces of tip and ball, the first of n_lam;
    radius: of the ball [m]; residual_dt: time step of r_comp [s]."""
    p = planner
    Q = np.zeros(N_X)
    Q[0:2], Q[2], Q[V_TIP] = p.tip, p.tip_height, p.tip_speed
    Q[P_BALL], Q[V_BALL], Q[W_BALL] = p.position, p.velocity, p.velocity * radius**2
    G = plus_weights(p.force, n_lam, n_tip)
    return C3Config(
        weights=C3Weights(Q, np.full(3, 0.01), G, G),
        options=p.options,
        residual_dt_sec=residual_dt,
        sliding_command=True,
    )


@dataclass(frozen=True, eq=False)
class SampledContacts:
    """The systems that replace the RollingTask of ball_rolling."""

    target: PathTarget
    task: PushTask
    sampler: ContactSampler


def add_sampled_contacts(
    builder: DiagramBuilder,
    config: SampledContactsConfig,
    circle: CircleConfig,
    model: TipAndBall,
    lcs: AnitescuLcs,
    c3: C3Config,
    p_tip,
    n_tip: int,
    period: float,
    offset: dict[str, float],
    estimator: LeafSystem,
) -> SampledContacts:
    """Adds and connects them, except for r_comp and the inputs of C3 and the arm.

    Args: circle: its centre and radius; lcs: that of C3; p_tip (3,): initial
        position of the tip [m]; n_tip: number of forces of tip and ball; period: of the
        task [s]; offset: {"target", "task", "sampler": first update [s]}.
    """
    sampling = config.sampler.sampling
    shape = ball_shape(model, sampling.height)
    target = builder.AddNamedSystem(
        "path_target",
        PathTarget(
            replace(
                config.path,
                circle=replace(
                    config.path.circle, center=circle.center, radius=circle.radius
                ),
                height=sampling.height, period_sec=period, offset_sec=offset["target"],
            ),
            c3.options.N + 1,
            lcs.dt_sec,
            model.ball_radius,
            beside(model, sampling.height) + model.tip_radius,
            lcs.n_lam,
            n_tip,
            c3.residual_dt_sec,
        ),
    )  # fmt: skip
    task = builder.AddNamedSystem(
        "push_task",
        PushTask(
            PushTaskConfig(
                config.push, sampling.height, sampling.clearance, period,
                offset["task"],
            ),
            c3.options.N + 1,
            shape,
            p_tip,
        ),
    )  # fmt: skip
    sampler = builder.AddNamedSystem(
        "contact_sampler",
        ContactSampler(
            replace(
                config.sampler,
                residual_dt_sec=c3.residual_dt_sec,
                offset_sec=offset["sampler"],
            ),
            lcs,
            C3Problem(c3.weights, c3.projection, c3.options),
            shape,
        ),
    )

    connect = partial(wiring.connect, builder)
    for system in (target, task, sampler):
        connect(estimator, "x", system, "x")
        connect(estimator, "valid", system, "valid")
    for system in (task, sampler):
        connect(target, "goal", system, "goal")
    connect(target, "x_desired", sampler, "x_desired")
    connect(task, "phase", sampler, "phase")
    connect(sampler, "command", task, "command")
    return SampledContacts(target, task, sampler)

"""ball_rolling without a hand-written cycle: ContactSampler says where to touch.

    state_estimator --x--> path_target --x_desired--> c3_mpc, contact_sampler
    path_target --goal (the next point on the circle)--> contact_sampler, push_task
    contact_sampler --command (where to touch)--> push_task
    c3_mpc (contact), push_task (travel) --> arm_reference

The tip pushes from beside the ball, at one height. Everything else is ball_rolling's.
"""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from makebreak.diagrams import wiring
from makebreak.diagrams.wiring import refuse_changed
from makebreak.models.tip_and_ball import TipAndBall
from makebreak.systems.arm.arm_reference import ArmReferenceConfig
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
    ObjectShape,
    SamplingConfig,
)
from makebreak.systems.contact_mpc.numerics.push_task import PushConfig
from makebreak.systems.contact_mpc.path_target import PathTarget, PathTargetConfig
from makebreak.systems.contact_mpc.push_task import PushTask, PushTaskConfig

CORNERS = 24  # Of the ball's outline: it is 0.3 mm within the circle at most.


@dataclass
class SampledPlannerConfig:
    """Costs of C3+; forces in newtons."""

    N: int = 5  # Knots of 0.1 s.
    rounds: int = 2
    polish: int = 6
    position: float = 5000.0  # Of the ball, across the table [1/m2].
    velocity: float = 100.0  # Of the ball; its turning counts as much [s2/m2].
    # Of the tip beside the ball, on the side from which it is to be pushed next: where
    # nothing touches, the plan else does not care where the tip is [1/m2].
    tip: float = 3000.0
    tip_height: float = 1e4  # [1/m2]
    tip_speed: float = 10.0  # [s2/m2]
    force: float = 5.0  # G of lam of tip and ball; eta's is 1/10 of it.
    friction: float = 0.5  # Of both contacts, for planning and learning.


@dataclass
class SampledContactsConfig:
    path: PathTargetConfig = field(default_factory=PathTargetConfig)
    planner: SampledPlannerConfig = field(default_factory=SampledPlannerConfig)
    sampler: ContactSamplerConfig = field(
        default_factory=lambda: ContactSamplerConfig(
            SamplingConfig(
                height=0.038,
                reach=[0.35, 0.78],
                out_of_reach=0.0,
                travel=5.0,
                hysteresis=[0.3, 1.0],
                push=0.5,
                follow=True,
                keep_sec=0.5,
            )
        )
    )
    push: PushConfig = field(
        default_factory=lambda: PushConfig(
            believed_sec=0.5, follow=True, place_change=0.0, around=True
        )
    )
    # Q_d of the learner on the ball's v_x, v_y, as from above: 7 mm/s. The arm that
    # moves the tip hardly feels a ball beside it.
    learning_weight: float = 2e4
    # As learning.eps: a ball beside the tip is pushed with far less than the newtons of
    # a tip on top of it, so a force over a gap has to cost more.
    learning_eps: float = 1e-4
    # As posterior.drift of the learner [m/s / sqrt(s)]: a tip at one height touches the
    # ball at one angle, where the gap stays what it is.
    learning_drift: float = 0.005
    # The gap is learned too large by 1.5 to 3 mm, for the ball is seen late; a tip that
    # believes it strikes the ball. So much is taken off what is learned [m].
    gap_allowance: float = 0.003
    reference: ArmReferenceConfig = field(
        default_factory=lambda: ArmReferenceConfig(force_max=8.0, acceleration_max=3.0)
    )


def check_contacts(config: SampledContactsConfig) -> None:
    """Raises: ValueError for a setting that the diagram sets, or out of range."""
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
        ("center", "radius", "height", "period_sec", "offset_sec"),
    )  # fmt: skip
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
    """How far beside the ball's centre, seen from above, a tip's surface is that
    touches the ball with its centre at a height [m]; negative: it does not."""
    R, r = model.ball_radius, model.tip_radius
    return float(np.sqrt(max((R + r) ** 2 - (height - R) ** 2, 0.0)) - r)


def ball_shape(model: TipAndBall, height: float) -> ObjectShape:
    """The ball for a tip whose centre stays at a height [m]: its outline is as far from
    the tip, seen from above, as the ball is.

    Raises: ValueError for a height at which the tip does not touch the ball's side.
    """
    R, r = model.ball_radius, model.tip_radius
    far = beside(model, height)
    if not r < height < 2.0 * R:
        raise ValueError(
            f"contacts.sampler.sampling.height is {height:g}, expected above the tip's "
            f"radius, {r:g}, and below the ball's top, {2.0 * R:g} m"
        )
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    ring = far * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    return ObjectShape([ring], r, 2.0 * R)


def sampled_c3_config(
    planner: SampledPlannerConfig, n_lam: int, n_tip: int, radius: float, residual_dt
) -> C3Config:
    """Args: n_tip: forces of tip and ball, the first of n_lam; radius: of the ball [m];
    residual_dt [s]."""
    p = planner
    Q = np.zeros(N_X)
    Q[0:2], Q[2], Q[V_TIP] = p.tip, p.tip_height, p.tip_speed
    Q[P_BALL], Q[V_BALL], Q[W_BALL] = p.position, p.velocity, p.velocity * radius**2
    G = plus_weights(p.force, n_lam, n_tip)
    return C3Config(
        weights=C3Weights(Q, np.full(3, 0.01), G, G),
        options=C3Options(N=p.N, rounds=p.rounds, rho=2.2, polish=p.polish),
        residual_dt_sec=residual_dt,
        sliding_command=True,
    )


@dataclass(frozen=True, eq=False)
class SampledContacts:
    """The systems that take the task's place."""

    target: PathTarget
    task: PushTask
    sampler: ContactSampler


def add_sampled_contacts(
    builder: DiagramBuilder,
    config: SampledContactsConfig,
    path: PathTargetConfig,
    model: TipAndBall,
    lcs: AnitescuLcs,
    c3: C3Config,
    p_tip,
    n_tip: int,
    period: float,
    offset: dict[str, float],
    estimator: LeafSystem,
) -> SampledContacts:
    """Adds and connects them, but for r_comp and what leads to C3 and the arm.

    Args: path: where the circle is; lcs: of the plan; p_tip (3,) where the tip is at
        first [m]; n_tip: forces of tip and ball; period of the task [s]; offset of
        `target`, `task`, `sampler` [s].
    """
    sampling = config.sampler.sampling
    shape = ball_shape(model, sampling.height)
    target = builder.AddNamedSystem(
        "path_target",
        PathTarget(
            replace(
                config.path, center=path.center, radius=path.radius,
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

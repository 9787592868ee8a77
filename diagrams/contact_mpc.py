"""A controller that plans through contact for any plant: LCS builder and C3."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.systems.contact_mpc.c3_mpc import C3Config, C3Mpc
from makebreak.systems.contact_mpc.careful_goal import CarefulGoal, CarefulGoalConfig
from makebreak.systems.contact_mpc.lcs_builder import (
    AnitescuLcsBuilder,
    ContactPair,
    LcsBuilderConfig,
)
from makebreak.systems.contact_mpc.multibody.model_parameters import Parameter
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Bounds, C3Options, C3Weights


@dataclass
class KnotWeights:
    """Weights of the state in place of Q [1/SI^2]: at the plan's end, (n_x,) or a
    matrix, row by row, and at the knots before it, (N, n_x); None: Q."""

    Q_N: list[Any] | None = None
    Q_knots: list[list[float]] | None = None


@dataclass
class ContactMpcConfig:
    """What make_contact_mpc plans with: contacts, cost, goal, rates, C3's options."""

    contacts: list[ContactPair] = field(default_factory=list)
    # Weights of the state [1/SI^2], (n_x,), and of the input [1/N^2], (n_u,).
    Q: list[float] = field(default_factory=list)
    R: list[float] = field(default_factory=list)
    # (n_x,) [SI]; empty: the input port x_desired has the goal of each knot.
    x_desired: list[float] = field(default_factory=list)
    dt_sec: float = 0.05  # Between the knots of a plan [s].
    period_sec: float = 0.0125  # Between two plans [s].
    options: C3Options = field(
        default_factory=lambda: C3Options(N=10, rounds=5, polish=3)
    )
    bounds: C3Bounds = field(default_factory=C3Bounds)
    closest: int | None = None  # Only so many contacts, the nearest ones; None: all.
    # Each knot has its own LCS, taken along the last plan; else all have the LCS about
    # the present state.
    lcs_along_plan: bool = False
    # Those that a ParameterLearner learns; the plan is for its values of them.
    parameters: list[Parameter] = field(default_factory=list)
    # Positions whose x_desired is approached with care while the parameters are not
    # known: of what is pushed and coasts.
    careful: CarefulGoalConfig = field(default_factory=CarefulGoalConfig)
    weights: KnotWeights = field(default_factory=KnotWeights)


def tuned(
    config: ContactMpcConfig,
    plant: MultibodyPlant,
    moved: Sequence[tuple[int, int]],
    length: float,
    speed: float,
    force: float,
    coast_sec: float,
) -> ContactMpcConfig:
    """The config with weights and time step for pushing something over a length.

    C3's other weights are for forces of some newtons, so those of the state grow with
    the force. What is pushed cannot be pulled back: the plan's end is weighed by where
    it comes to rest, and the way there hardly.

    Args:
        plant: the model's.
        moved: index in q and in v of each coordinate that is to get somewhere.
        length: how far [m] or [rad]; speed: how fast, about [m/s] or [rad/s].
        force: what it takes [N]: 4 mass speed^2 / length of all that moves, and
            friction and damping (for a turn, over the lever arm).
        coast_sec: distance over speed in which it comes to rest alone: mass over
            damping, or speed / (2 friction g).
    Raises: ValueError for a number that is not positive, or a plant without actuators.
    """
    for name, value in (("length", length), ("speed", speed), ("force", force)):
        if not 0.0 < value < np.inf:
            raise ValueError(f"tuned: {name} is {value}, expected a positive number")
    if not 0.0 <= coast_sec < np.inf:
        raise ValueError(f"tuned: coast_sec is {coast_sec}, expected >= 0")
    n_q, n_v = plant.num_positions(), plant.num_velocities()
    driven = plant.MakeActuationMatrix().any(axis=1)
    Q = np.zeros((n_q + n_v, n_q + n_v))
    for j in n_q + np.flatnonzero(driven):
        Q[j, j] = 0.06 * (force / speed) ** 2
    for i, j in moved:
        Q[i, i], Q[n_q + j, n_q + j] = (
            12.0 * (force / length) ** 2, 1.2 * (force / speed) ** 2,
        )  # fmt: skip
    Q_N = Q.copy()
    for i, j in moved:
        ends = np.array([1.0, coast_sec])
        at = np.ix_([i, n_q + j], [i, n_q + j])
        Q_N[at] += Q[i, i] * (np.outer(ends, ends) - np.diag([1.0, 0.0]))
    return replace(
        config,
        Q=(0.03 * np.diag(Q)).tolist(),
        weights=KnotWeights(Q_N.tolist()),
        R=[0.01] * int(driven.sum()),
        dt_sec=length / (20.0 * speed),
        period_sec=length / (20.0 * speed),
    )


def make_contact_mpc(model: Diagram, config: ContactMpcConfig) -> Diagram:
    """C3+ on the LCS about the present state.

    Inputs:  x (n_x,), the state [q, v] of the model's plant; r_comp (n_lam,),
             optional, of a ResidualLearner whose period is dt_sec; parameters (n,),
             with config.parameters only, and unknown (1,), with careful.positions
             only, of a ParameterLearner; x_desired ((N + 1) n_x,), without
             config.x_desired only: where the state is to be at each knot, dt_sec
             apart, row by row.
    Outputs: u (n_u,) [N, N m]; status (1,), a C3Status; plan, a Plan (abstract); lcs,
             what the plan is for (abstract; a tuple with lcs_along_plan), about the x
             of each multiple of period_sec.

    The LCS is updated at that time, and u 0.1 ms later: a learner between both reads
    the new LCS and the input that has acted since its last sample, if period_sec is
    dt_sec.

    Args: model: a diagram of the controller's own plant and scene graph (AnitescuLcs).
    Raises: ValueError for weights or a goal of another size, a plant without actuators.
    """
    c, builder = config, DiagramBuilder()
    lcs = builder.AddNamedSystem(
        "lcs",
        AnitescuLcsBuilder(
            model,
            LcsBuilderConfig(
                c.contacts,
                c.dt_sec,
                period_sec=c.period_sec,
                closest=c.closest,
                knots=c.options.N if c.lcs_along_plan else 0,
                parameters=c.parameters,
            ),
        ),
    )
    n_x, n_u, n_lam = lcs.model.n_x, lcs.model.n_u, lcs.model.n_lam
    if n_u == 0:
        raise ValueError(
            "the model's plant has no actuators, expected at least one to plan for (a "
            "free body is moved by what touches it)"
        )
    for name, values, n in (("Q", c.Q, n_x), ("R", c.R, n_u)):
        if len(values) != n:
            raise ValueError(
                f"ContactMpcConfig.{name} has {len(values)} entries, expected {n}"
            )
    if c.x_desired and len(c.x_desired) != n_x:
        raise ValueError(
            f"ContactMpcConfig.x_desired has {len(c.x_desired)} entries, expected "
            f"{n_x}: {lcs.model.x_names}"
        )
    # Consensus weights of [x, lam, u, eta]: forces and gaps have to agree between C3's
    # two steps, x and u hardly.
    G = np.repeat([0.01, 1.0, 0.01, 1.0], [n_x, n_lam, n_u, n_lam])
    U = np.repeat([1.0, 1.0, 1.0, 10.0], [n_x, n_lam, n_u, n_lam])
    weights = C3Weights(
        np.array(c.Q), np.array(c.R), G, U,
        Q_N=None if c.weights.Q_N is None else np.array(c.weights.Q_N),
        Q_knots=None if c.weights.Q_knots is None else np.array(c.weights.Q_knots),
    )  # fmt: skip
    c3 = builder.AddNamedSystem(
        "c3",
        C3Mpc(
            C3Config(
                weights, options=c.options, bounds=c.bounds, residual_dt_sec=c.dt_sec
            ),
            c.period_sec,
            offset_sec=1e-4,  # After the builder, so that the LCS is about this state.
        ),
    )
    careful = None
    if c.careful.positions:
        if not c.x_desired:
            raise ValueError("ContactMpcConfig.careful came without x_desired")
        careful = builder.AddNamedSystem(
            "careful_goal", CarefulGoal(c.careful, c.x_desired, c.options.N + 1)
        )
        builder.Connect(careful.get_output_port(), c3.GetInputPort("x_desired"))
        builder.ExportInput(careful.GetInputPort("unknown"), "unknown")
    elif c.x_desired:
        goal = builder.AddSystem(
            ConstantVectorSource(np.tile(c.x_desired, c.options.N + 1))
        )
        builder.Connect(goal.get_output_port(), c3.GetInputPort("x_desired"))
    else:
        builder.ExportInput(c3.GetInputPort("x_desired"), "x_desired")
    no_force = builder.AddSystem(ConstantVectorSource(np.zeros(n_u)))
    builder.Connect(no_force.get_output_port(), lcs.GetInputPort("u"))
    builder.Connect(lcs.GetOutputPort("lcs"), c3.GetInputPort("lcs"))
    if c.lcs_along_plan:
        builder.Connect(c3.GetOutputPort("plan"), lcs.GetInputPort("plan"))
    builder.ExportInput(lcs.GetInputPort("x"), "x")
    builder.ConnectInput("x", c3.GetInputPort("x"))
    if careful is not None:
        builder.ConnectInput("x", careful.GetInputPort("x"))
    builder.ExportInput(c3.GetInputPort("r_comp"), "r_comp")
    if c.parameters:
        builder.ExportInput(lcs.GetInputPort("parameters"), "parameters")
    for name in ("u", "status", "plan"):
        builder.ExportOutput(c3.GetOutputPort(name), name)
    builder.ExportOutput(lcs.GetOutputPort("lcs"), "lcs")
    diagram = builder.Build()
    diagram.set_name("contact_mpc")
    return diagram

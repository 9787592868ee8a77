"""The wiring of learners: what they learn from, and of a ParameterLearner beside
planners that know gaps as a residual."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    OutputPort,
)
from pydrake.systems.primitives import MatrixGain

from makebreak.diagrams import wiring
from makebreak.systems.contact_mpc.multibody.model_parameters import Parameter
from makebreak.systems.contact_mpc.parameter_learner import ParameterLearner
from makebreak.systems.perception.past_state import PastState, PastStateConfig

LONGEST = 1.0  # Age of the oldest reading in use [s].


def past_config(
    height: float, offset_sec: float, reading_sec: float, delay_sec: float = 0.0
) -> PastStateConfig:
    """Config of PastState: how far back a learner looks, so that all readings about
    that time have arrived.

    Args: height: of the object's frame [m]; reading_sec: period of the readings [s];
        delay_sec: by which they are late [s].
    Raises: ValueError for readings that are too rare or too late.
    """
    plain = PastStateConfig(height=height, offset_sec=offset_sec)
    # A parabola needs two readings on either side, and one is lost between ticks.
    half_width = max(plain.half_width, 2.5 * reading_sec)
    wait = delay_sec + reading_sec + half_width
    if wait + half_width > LONGEST:
        raise ValueError(
            f"pose: period_sec {reading_sec:g}, delay_sec {delay_sec:g} are too long "
            "to learn from; expected less, or adapt=false"
        )
    ticks = max(plain.ticks, int(np.ceil(wait / plain.period_sec - 1e-9)))
    return replace(plain, ticks=ticks, half_width=half_width)


def add_past_state(
    builder: DiagramBuilder, past: PastState, sensor: LeafSystem, estimator: LeafSystem
) -> PastState:
    """Adds `past_state`: of a sensor's readings beside the estimator's tip."""
    builder.AddNamedSystem("past_state", past)
    for source, name, port in (
        (estimator, "x", "x"), (estimator, "u_with_force_now", "u"),
        (sensor, "reading", "reading"),
    ):  # fmt: skip
        wiring.connect(builder, source, name, past, port)
    return past


def u_and_ready(state: LeafSystem) -> tuple[str, str]:
    """Ports of what gives samples, a PastState or a StateEstimator: the input, and
    whether the sample is known."""
    if isinstance(state, PastState):
        return "u_measured", "ready"
    return "u_with_force", "window_valid"


def to_learn(
    own, names: Sequence[str], items: Callable[[], list[Parameter]]
) -> list[Parameter]:
    """Those of the items whose deviation is not 0.

    Args: own: an experiment's settings `parameters`, whose `names` are deviations.
    Raises: ValueError for one below 0, or none above.
    """
    for name in names:
        if not getattr(own, name) >= 0.0:
            raise ValueError(
                f"parameters.{name} is {getattr(own, name)}, expected >= 0"
            )
    learned = [item for item in items() if item.std > 0.0]
    if not learned:
        raise ValueError("parameters has no deviation above 0, expected one to learn")
    return learned


def add_parameter_learner(
    builder: DiagramBuilder,
    learner: ParameterLearner,
    state: LeafSystem,
    users: Sequence[LeafSystem],
    rows: int,
    dt_sec: float,
    scale: Sequence[float] = (),
) -> OutputPort:
    """Adds `parameter_learner`, and gives what it learns but the gap to the users.

    Args: state: of u_and_ready; users: their port `parameters` has all but the gap, in
        order, and the first one builds the LCS; rows: the first ones of it, whose gap
        is learned; dt_sec: time step over which a residual is a velocity [s]; scale
        (n,): of the users' values over the learner's; empty: the same.
    Returns: the gap as r_comp (n_lam,) [m/s], of the system `learned_residual`.
    """
    builder.AddNamedSystem("parameter_learner", learner)
    u, ready = u_and_ready(state)
    for name, port in (
        ("x", "x"), (u, "u_measured"), (ready, "enable"),
    ):  # fmt: skip
        wiring.connect(builder, state, name, learner, port)
    items = learner.model.parameters.items
    is_gap = np.array([p.kind == "gap" for p in items])
    if not is_gap.all():
        own = np.diag(scale) if len(scale) else np.eye(len(items))
        values = _gain(builder, "learned_values", learner, own[~is_gap])
        for user in users:
            builder.Connect(values, user.GetInputPort("parameters"))
    residual = np.zeros((users[0].model.n_lam, len(items)))
    residual[:rows, is_gap] = 1.0 / dt_sec
    return _gain(builder, "learned_residual", learner, residual)


def add_gap_std(
    builder: DiagramBuilder, learner: ParameterLearner, dt_sec: float
) -> OutputPort:
    """(1,) standard deviation of the learned gap as a velocity [m/s]."""
    items = learner.model.parameters.items
    scale = [[p.std / dt_sec if p.kind == "gap" else 0.0 for p in items]]
    return _gain(builder, "learned_std", learner, np.array(scale), "std")


def what_was_learned(diagram: Diagram, context: Context) -> dict[str, float]:
    """Each parameter's learned value and the ends of its 90 % interval, as keys of a
    result; empty without a `parameter_learner`."""
    found: dict[str, float] = {}
    if not diagram.HasSubsystemNamed("parameter_learner"):
        return found
    learner = diagram.GetSubsystemByName("parameter_learner")
    assert isinstance(learner, ParameterLearner)
    for row in learner.learned(learner.GetMyContextFromRoot(context)):
        key = "_".join(re.findall(r"\w+", f"learned_{row.name}"))
        found |= {key: row.learned, f"{key}_low": row.low, f"{key}_high": row.high}
    return found


def _gain(builder, name, learner, matrix, port="parameters") -> OutputPort:
    gain = builder.AddNamedSystem(name, MatrixGain(matrix))
    builder.Connect(learner.GetOutputPort(port), gain.get_input_port())
    return gain.get_output_port()

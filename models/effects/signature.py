"""Signatures: how a kind of effect appears in the residual of measured motion.

The residual of inverse dynamics is r = effort - ID(q, v, vd): generalized forces [N m]
or [N] in the order of the plant's velocities, with the recorded effort and the model's
inverse dynamics at the measured motion. An effect that the model lacks appears as
r = columns @ coefficients. For a free body the rows of r are the unmodelled wrench on
it: torque, then force, at its origin in world axes.

The weak form needs no vd: columns = d/dt momentum + rest, so with a test function w
that is zero at both ends of a window, integral(w columns) = integral(w rest - w'
momentum); and ID = d/dt (M v) + Dynamics.rest in the same way.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from scipy.linalg import solve_banded

from makebreak.models.effects.kind import Effect, EffectKind

Grid = Mapping[str, Sequence[float]]


@dataclass(frozen=True, eq=False)
class Motion:
    """Measured motion in the plant's order: n samples of one episode.

    effort: recorded effort of the actuators, commanded or measured as the caller
        decides; 0 at joints without an actuator.
    jerk: d/dt vd, for kinds that shift time; None: differences of vd.
    dry: share of dry friction that acts, positive as v; None: all but where a joint is
        slower than its friction's law says.
    """

    time: np.ndarray  # (n,) [s]
    q: np.ndarray  # (n, n_q)
    v: np.ndarray  # (n, n_v)
    vd: np.ndarray  # (n, n_v)
    effort: np.ndarray  # (n, n_v) [N m] or [N]
    jerk: np.ndarray | None = None  # (n, n_v)
    dry: np.ndarray | None = None  # (n, n_v)

    def __post_init__(self):
        n = np.size(self.time)
        for name in ("q", "v", "vd", "effort"):
            value = getattr(self, name)
            if value.ndim != 2 or len(value) != n:
                raise ValueError(
                    f"Motion.{name} is {value.shape}, expected ({n}, ...) as time"
                )
        if not self.v.shape == self.vd.shape == self.effort.shape:
            raise ValueError(
                f"Motion.v is {self.v.shape}, vd {self.vd.shape}, effort "
                f"{self.effort.shape}: expected one shape"
            )


@dataclass(frozen=True, eq=False)
class Signature:
    """Columns of one effect at one place, with nonlinear parameters held.

    columns: (n, n_v, k).
    weak(): momentum and rest, of the same shape: columns = d/dt momentum + rest.
    unknowns: names of the k coefficients, for tables.
    held: the nonlinear parameters.
    to_parameters(coefficients (k,)): the effect's parameters, with the held ones.
    exact: whether the residual is linear in the coefficients; otherwise it is
        linearised at zero effect.
    channels: {channel: (n, k) change of the channel per unit of each coefficient}, for
        kinds that change the measurement instead of the motion.
    """

    effect: Effect  # kind and at.
    unknowns: tuple[str, ...]
    columns: np.ndarray
    weak: Callable[[], tuple[np.ndarray, np.ndarray]]
    to_parameters: Callable[[np.ndarray], dict[str, float]]
    held: Mapping[str, float] = field(default_factory=dict)
    exact: bool = True
    channels: Mapping[str, np.ndarray] = field(default_factory=dict)

    @cached_property
    def _weak(self) -> tuple[np.ndarray, np.ndarray]:
        return self.weak()

    @property
    def momentum(self) -> np.ndarray:
        return self._weak[0]

    @property
    def rest(self) -> np.ndarray:
        return self._weak[1]


class Dynamics(Protocol):
    """The interface of the model that a signature uses (models/dynamics.py)."""

    plant: MultibodyPlant
    gravity: np.ndarray  # (3,) [m/s2]

    def inverse_dynamics(self, q, v, vd, time=None) -> np.ndarray: ...
    def momentum(self, q, v) -> np.ndarray: ...
    def rest(self, q, v, time=None) -> np.ndarray: ...
    def body_motion(self, body: RigidBody, q, v, vd) -> Any: ...
    def mass_times_com_jacobian(self, q) -> np.ndarray: ...
    def shifted(self, q, dq, step: float) -> np.ndarray: ...
    def coordinates(self, channel: str) -> tuple[str, int]: ...
    def channels(self) -> list[str]: ...


def added_effort(
    effect: Effect, kind: EffectKind, model: Dynamics, motion: Motion
) -> np.ndarray | None:
    """Contribution (n, n_v) of an effect to the inverse dynamics of a model without it,
    from its signature; None if only a model with the effect gives it."""
    if kind.added is not None:
        return kind.added(effect, model, motion)
    one = linear_signature(effect, kind, model, motion)
    if one is None:
        return None
    return one.columns @ np.array([effect.parameters[n] for n in one.unknowns])


def linear_signature(
    effect: Effect, kind: EffectKind, model: Dynamics, motion: Motion
) -> Signature | None:
    """The signature of which an effect's contribution is a sum, its unknowns times the
    parameters of these names; None if it is no such sum."""
    if kind.added is not None or kind.signature is None:
        return None
    grid = {name: [value] for name, value in effect.parameters.items()}
    one, *more = kind.signature(effect, model, motion, grid)
    if more or not one.exact or any(n not in effect.parameters for n in one.unknowns):
        return None
    return one


def at_joints(
    effect: Effect,
    unknowns: Sequence[str],
    motion: Motion,
    joints: Sequence,
    entries: Sequence[Callable],
    held: Mapping[str, float] | None = None,
    to_parameters: Callable | None = None,
    exact: bool = True,
) -> Signature:
    """A signature without momentum, with the same coefficients for all joints of `at`:
    column i at joint j is entries[i](q_j, v_j, effort_j)."""
    columns = np.zeros((*motion.v.shape, len(unknowns)))
    for joint in joints:
        i_q, i_v = joint.position_start(), joint.velocity_start()
        for k, entry in enumerate(entries):
            columns[:, i_v, k] = entry(
                motion.q[:, i_q], motion.v[:, i_v], motion.effort[:, i_v]
            )
    return without_momentum(effect, unknowns, columns, held, to_parameters, exact)


def without_momentum(
    effect: Effect,
    unknowns: Sequence[str],
    columns: np.ndarray,
    held: Mapping[str, float] | None = None,
    to_parameters: Callable | None = None,
    exact: bool = True,
    channels: Mapping[str, np.ndarray] | None = None,
) -> Signature:
    """A signature whose columns contain no derivative: momentum 0, rest = columns."""
    held = dict(held or {})
    names = tuple(unknowns)

    def named(coefficients):
        return {
            **{n: float(c) for n, c in zip(names, coefficients, strict=True)},
            **held,
        }

    return Signature(
        effect,
        names,
        columns,
        lambda: (np.zeros_like(columns), columns),
        to_parameters or named,
        held,
        exact,
        channels or {},
    )


def lagged(time: np.ndarray, u: np.ndarray, delay: float) -> np.ndarray:
    """u (n, ...) delayed by `delay` [s], linear between samples and constant before the
    first one."""
    flat = u.reshape(len(time), -1)
    out = [np.interp(time - delay, time, column) for column in flat.T]
    return np.stack(out, axis=1).reshape(u.shape)


def filtered(time: np.ndarray, u: np.ndarray, time_constant: float) -> np.ndarray:
    """u (n,) or (n, k) after a first-order lag, with values held between samples."""
    keep = np.exp(-np.diff(time) / time_constant)
    u = np.asarray(u, dtype=float)
    given = (u[:-1].T * (1.0 - keep)).T
    # out[i + 1] - keep[i] out[i] = (1 - keep[i]) u[i]: a matrix of two diagonals.
    two = np.stack([np.ones(len(u)), np.append(-keep, 0.0)])
    return solve_banded((1, 0), two, np.concatenate([u[:1], given]))

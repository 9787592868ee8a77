"""The learner of named parameters as a system (numerics/parameter_posterior.py)."""

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.multibody.anitescu_lcs import AnitescuLcs
from makebreak.systems.contact_mpc.multibody.contact_pair import ContactPair
from makebreak.systems.contact_mpc.multibody.model_parameters import (
    POSITIVE,
    Parameter,
)
from makebreak.systems.contact_mpc.numerics.parameter_posterior import (
    BEYOND_NOISE,
    Belief,
    Explained,
    Loss,
    Sample,
    Scale,
    acting,
    certain_part,
    changes_by,
    error_weights,
    explain,
    impact_part,
    lacks_of,
    less_certain,
    nearest,
    normals,
    prior,
    pushes,
    scatter,
    tangent_edges,
    tangents,
    updated,
)
from makebreak.systems.contact_mpc.numerics.residual_learner import gamma_bound
from makebreak.systems.numerics.settings import check_settings, check_times
from makebreak.systems.numerics.timing import timed

DIFFERENCE = 1e-6  # Of a parameter of pairs, for its derivatives.
NINETY = 1.645  # Deviations of a 90 % interval.
SURELY = 4.0  # Deviations: a model may well be wrong by two or three.
# Least number of friction directions of a contact, but in a plane. A friction cone of
# two holds a force between its edges that is up to 29 %, on average 10 %, less than the
# largest, and friction would be learned as that much larger; four: 8 %, on average 3 %.
DIRECTIONS = 4


class ParameterStatus(IntEnum):
    """What happened to the newest step."""

    LEARNED = 0
    WAITING = 1  # No step yet: it takes two good samples in a row.
    DISABLED = 2  # enable was 0.
    NOT_FINITE = 3  # x or u_measured was not finite, or too large.
    NOT_SOLVED = 4  # No LCS about x, or a QP was not solved.


@dataclass
class ParameterLearnerConfig:
    """Settings of ParameterLearner: what is learned, from what, trusted how far."""

    contacts: list[ContactPair] = field(default_factory=list)
    parameters: list[Parameter] = field(default_factory=list)
    # Inverse variances (n_x,) of the one-step errors [1/SI^2]; empty: 1e4 for each
    # velocity (1 cm/s), 0 for the positions.
    Q_d: list[float] = field(default_factory=list)
    # Standard deviation of a closed contact's gap speed [m/s].
    contact_std: float = 0.02
    # Standard deviation of a step's error, in parts of what contact forces and other
    # things that free motion lacks have changed in it.
    error_share: float = 0.1
    impact_share: float = 0.5  # The same of impacts, of which no law is exact.
    trust: float = 0.5  # Factor on the loss of a step: errors of steps are correlated.
    # Noise of the measured sliding speed [m/s]; within twice of it a contact may stick.
    slip_noise: float = 0.02
    closest: int | None = None  # As of AnitescuLcs.


@dataclass(frozen=True)
class LearnedParameter:
    """The model's value, the learned one, and the ends of its 90 % interval, in the
    parameter's unit."""

    name: str
    model: float
    learned: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class _Memory:
    sample: np.ndarray | None
    belief: Belief
    loss: float
    status: ParameterStatus

    def __deepcopy__(self, memo):
        return self  # Every part is immutable.


class ParameterLearner(LeafSystem):
    """Learns masses, damping, friction, gaps and forces while the robot works.

    Inputs:  x (n_x,): measured state; u_measured (n_u,): mean of the input over the
             period that ends now; enable (1,), optional: 0 drops the steps that this
             sample belongs to.
    Outputs: parameters (n,): values to plan with, each as far from the model's as it is
             certain, less its caution; estimate (n,): the most probable values; std
             (n,): of z, so of the logarithm times the parameter's std for masses,
             damping and friction, else in units of it; unknown (1,): deviation of the
             logarithm of all masses, damping and friction together, for CarefulGoal;
             loss (1,): of the newest step; status (1,): a ParameterStatus.

    The learner builds its own LCS about each measured state, with dt = period_sec, so
    its rate does not depend on the planner's.

    Args: diagram: the controller's plant and scene graph (AnitescuLcs); config.
    Raises: ValueError for a parameter that the model does not have.
    """

    def __init__(
        self,
        diagram,
        config: ParameterLearnerConfig,
        period_sec: float,
        offset_sec: float = 0.0,
    ):
        super().__init__()
        check_settings(config)
        check_times("ParameterLearner", period_sec, offset_sec)
        c = config
        if not c.parameters:
            raise ValueError("ParameterLearnerConfig.parameters is empty")
        for name, least, what in (
            ("contact_std", 1e-300, "a positive number"),
            ("trust", 1e-300, "a positive number"),
            ("error_share", 0.0, "0 or more"),
            ("impact_share", 0.0, "0 or more"),
        ):
            if not getattr(c, name) >= least:
                raise ValueError(
                    f"ParameterLearnerConfig.{name} is {getattr(c, name)}, expected "
                    f"{what}"
                )
        self.model = m = AnitescuLcs(
            diagram,
            [_finer(pair) for pair in c.contacts],
            period_sec,
            closest=c.closest,
            parameters=c.parameters,
        )
        Q_d = np.array(c.Q_d or [0.0] * m.n_q + [1e4] * m.n_v, dtype=float)
        if Q_d.shape != (m.n_x,) or not (Q_d >= 0.0).all():
            raise ValueError(
                f"ParameterLearnerConfig.Q_d is {c.Q_d}, expected {m.n_x} numbers of "
                "at least 0"
            )
        gamma = min(m.eps_c, 0.5 * gamma_bound(m.at_default().F))
        self._Q_d = Q_d
        # A step has the noise of both its ends.
        self._noise = 0.5 / np.maximum(Q_d[m.n_q :], 1e-12)
        # The loss has |gap speed|^2 / (2 eps gamma) of a closed contact.
        self._loss = Loss(np.diag(Q_d), c.contact_std**2 / gamma, gamma)
        self._scale = Scale(
            m.parameters.nominal,
            np.array([p.std for p in c.parameters]),
            m.parameters.is_log,
        )
        self._friction = np.array([pair.friction for pair in c.contacts])
        self._high = np.array([pair.anisotropy for pair in c.contacts])
        self._gap_std = m.parameters.of_pairs(
            "gap", self._scale.std, np.zeros(len(c.contacts))
        )
        # A closed contact's gap may be off by the same in each step.
        deep = np.array([c.contact_std * period_sec if p.kind == "gap" else 0.0
                         for p in c.parameters])  # fmt: skip
        self._constant = (deep / self._scale.std) ** 2
        self._drift = np.array([p.drift for p in c.parameters]) ** 2 * period_sec
        self._config, n = c, len(c.parameters)
        self._x = self.DeclareVectorInputPort("x", m.n_x)
        self._u = self.DeclareVectorInputPort("u_measured", m.n_u)
        self._enable = self.DeclareVectorInputPort("enable", 1)
        first = _Memory(None, prior(n), 0.0, ParameterStatus.WAITING)
        self._memory = self.DeclareAbstractState(Value(first))
        ticket = {self.abstract_state_ticket(self._memory)}

        def output(name, size, value):
            def calc(context, out):
                out.set_value(np.atleast_1d(value(self._memory_of(context))))

            self.DeclareVectorOutputPort(name, size, calc, ticket)

        values = self._scale.values
        # No plan for a friction that drives.
        lowest = [0.0 if p.kind in POSITIVE else -np.inf for p in c.parameters]

        caution = np.array([p.caution for p in c.parameters])

        def known(memory):
            return less_certain(memory.belief, self._constant)

        def to_plan_with(memory):
            belief = known(memory)
            z = certain_part(belief) - caution * belief.std
            return np.maximum(values(z), lowest)

        output("parameters", n, to_plan_with)
        output("estimate", n, lambda m: values(m.belief.mean))
        output("std", n, lambda m: known(m).std)
        spread = np.where(self._scale.is_log, self._scale.std, 0.0)
        output("unknown", 1, lambda m: np.linalg.norm(spread * m.belief.std))
        output("loss", 1, lambda m: m.loss)
        output("status", 1, lambda m: float(m.status))
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            period_sec, offset_sec, self._update
        )

    def learned(self, context) -> list[LearnedParameter]:
        """What is known of each parameter, in a context of this system."""
        belief, scale = self._memory_of(context).belief, self._scale
        reach = NINETY * less_certain(belief, self._constant).std
        rows = zip(
            self.model.parameters.names,
            scale.nominal,
            scale.values(belief.mean),
            scale.values(belief.mean - reach),
            scale.values(belief.mean + reach),
            strict=True,
        )
        return [LearnedParameter(name, *map(float, row)) for name, *row in rows]

    def _memory_of(self, context) -> _Memory:
        return context.get_abstract_state(int(self._memory)).get_value()

    @timed
    def _update(self, context, state):
        memory = self._memory_of(context)
        x, u = self._x.Eval(context).copy(), self._u.Eval(context)
        enable: Any = [1.0]
        if self._enable.HasValue(context):
            enable = self._enable.Eval(context)
        state.get_mutable_abstract_state(int(self._memory)).set_value(
            self._after(memory, x, u, bool(enable[0] > 0.5))
        )

    def _after(self, memory: _Memory, x, u, enabled) -> _Memory:
        """The memory after the sample x with the input u since the last one."""
        if not enabled:
            return replace(memory, sample=None, status=ParameterStatus.DISABLED)
        if not np.isfinite(x).all():
            return replace(memory, sample=None, status=ParameterStatus.NOT_FINITE)
        x.setflags(write=False)
        if memory.sample is None:
            return replace(memory, sample=x, status=ParameterStatus.WAITING)
        if not np.isfinite(u).all():
            return replace(memory, sample=x, status=ParameterStatus.NOT_FINITE)
        sample = Sample(memory.sample, u, x, *self.model.between(memory.sample, x))
        belief, found = self._learned(memory.belief, sample)
        if found is None:
            return replace(memory, sample=x, status=ParameterStatus.NOT_SOLVED)
        return _Memory(x, belief, found.loss, ParameterStatus.LEARNED)

    def _learned(self, belief: Belief, sample: Sample):
        c, scale, model = self._config, self._scale, self.model
        is_gap = np.array([p.kind == "gap" for p in c.parameters])
        built: dict[bytes, Any] = {}  # By the values of all but the gaps.

        def build_of(values):
            rest = np.where(is_gap, 0.0, values)
            key = rest.tobytes()
            if key not in built:
                built[key] = model.build(sample.x, sample.u, parameters=rest)
            return model.with_gaps(built[key], values)

        def build(z):
            return build_of(scale.values(z))

        def changes(z, lcs, lam):
            values = scale.values(z)
            dx, dw = model.step_changes(sample.x, sample.u, lcs, lam, values)
            for i in np.flatnonzero(~model.parameters.is_dynamic):
                other = values.copy()
                other[i] += DIFFERENCE
                both = changes_by(lcs, build_of(other), sample, lam)
                dx[:, i], dw[:, i] = both[0] / DIFFERENCE, both[1] / DIFFERENCE
            one_sided = model.sticks(lcs, slides)
            slopes = np.where(rests, 0.0, scale.slopes(values))
            return dx * slopes, dw * slopes, one_sided

        try:
            loss, slides, rests = self._loss_of(belief, sample, build)
        except (ValueError, RuntimeError):  # No LCS about these states.
            return belief, None
        starts = self._touching(belief, sample, build)
        belief = less_certain(belief, self._drift)
        after, found = updated(belief, sample, loss, c.trust, build, changes, starts)
        # What no value explains within the noise is something that the model lacks, or
        # a gap is believed that is none: of ground that gave way where a foot landed.
        if found is not None and 2.0 * found.loss > _noise_of(found, loss):
            room = BEYOND_NOISE**2 * self._constant - belief.std**2
            doubted = np.clip(room, 0.0, self._constant)
            return less_certain(belief, doubted * self._pushing(found, sample)), found
        return after, found

    def _pushing(self, found: Explained, sample: Sample) -> np.ndarray:
        """(n,) bool: of which parameters a pair pushes where it touches as measured."""
        far = nearest(found.lcs, sample) > BEYOND_NOISE * self._config.contact_std
        pair = self.model.of_rows(found.lcs, np.arange(self.model.n_pairs))
        pushing = set(pair[(found.lam > 0.0) & ~far])
        return np.array([bool(pushing & set(p.pairs)) for p in self._config.parameters])

    def _touching(self, belief: Belief, sample: Sample, build) -> list[np.ndarray]:
        """The mean (n,) with each gap in turn as it is if its pairs touch in the step,
        a deviation deep: the loss is flat where a contact is missed."""
        lcs, starts = build(belief.mean), []
        apart = nearest(lcs, sample) + self._config.contact_std
        pair = self.model.of_rows(lcs, np.arange(self.model.n_pairs))
        for i, p in enumerate(self._config.parameters):
            mine = np.isfinite(lcs.phi) & np.isin(pair, p.pairs)
            if p.kind == "gap" and mine.any():
                start = belief.mean.copy()
                start[i] -= self.model.dt_sec * apart[mine].min() / p.std
                starts.append(start)
        return starts

    def _loss_of(self, belief: Belief, sample: Sample, build) -> tuple[Loss, Any, Any]:
        """The step's loss, by what slides and what the forces under the belief do;
        which of the LCS's rows slide, (n_lam,) bool; and of which parameters nothing is
        told, as a pair that resists rolling may rest, (n,) bool."""
        c, model = self._config, self.model
        lcs = build(belief.mean)
        values = self._scale.values(belief.mean)
        friction = model.parameters.of_pairs("friction", values, self._friction)
        friction, high = (model.of_rows(lcs, of) for of in (friction, self._high))
        # A contact that is apart for all that is known of its gap has no force.
        unsure = model.parameters.of_pairs(
            "gap", self._scale.std * belief.std, np.zeros(model.n_pairs)
        )
        unsure = np.hypot(c.contact_std, model.of_rows(lcs, unsure) / model.dt_sec)
        apart = nearest(lcs, sample) > SURELY * unsure
        acts = acting(lcs, sample, friction, c.slip_noise, high, None, apart)
        loss = replace(self._loss, acting=acts)
        lacks = lacks_of(lcs, sample)
        further = model.parameters.unknown_at_rest(
            values, self._scale.slopes(values) * belief.std,
            sample.x_now[-model.n_v :], sample.x_next[-model.n_v :],
            sample.M, model.dt_sec,
        )  # fmt: skip
        found, of_normals = explain(lcs, sample, loss), np.zeros_like(lacks)
        rests = np.zeros(len(values), bool)
        if found is not None and found.lam.any():
            if np.any(high != 1.0):  # Else no force tilts a normal.
                acts = acting(
                    lcs, sample, friction, c.slip_noise, high, found.lam, apart
                )
                loss = replace(loss, acting=acts)
                found = explain(lcs, sample, loss) or found
            # Forces may act at the step's end instead of its beginning.
            before, after = (
                pushes(model.build(x, sample.u, parameters=values))[0]
                for x in (sample.x_now, sample.x_next)
            )
            impulse = model.dt_sec * (after - before).T @ found.lam
            turned = np.linalg.solve(sample.M, impulse)
            further += np.outer(turned, turned) / 12.0
            further += self._elsewhere(sample, lcs, friction, high, found.lam)
            for errors in acts.errors:
                astray = (lcs.D @ (errors * found.f))[-model.n_v :]
                further += astray @ astray.T
            std = self._scale.slopes(values) * belief.std
            unknown, rests = model.unknown_rolling(
                sample, lcs, found.lam, np.hypot(values, std), self._noise
            )
            further += unknown
            # A normal force errs along itself alone: where a surface is, is above.
            by = (normals(lcs) * found.lam[:, None]).sum(axis=0)
            of_normals[-model.n_v :] = model.dt_sec * np.linalg.solve(sample.M, by)
        lam = np.zeros(lcs.n_lam) if found is None else found.lam
        # What only a contact that is apart could have changed tells of nothing, however
        # wrong it is: an arm that swings back from what it has pushed.
        dx, _ = model.step_changes(sample.x, sample.u, lcs, lam, values)
        told = (lcs.D @ acts.ways).any(axis=1) | dx.any(axis=1)
        alone = lcs.D[:, apart].any(axis=1) & ~told
        lacks, of_normals = np.where(alone, 0.0, [lacks, of_normals])
        further += scatter(c.error_share, lacks + of_normals, sample.M)
        impacts = c.impact_share * np.sqrt(impact_part(lcs, sample, lacks, apart))
        further += scatter(impacts, lacks, sample.M)
        W, of_model = error_weights(np.where(alone, 0.0, self._Q_d), further)
        return replace(loss, W=W, of_model=of_model), acts.slides, rests

    def _elsewhere(self, sample: Sample, lcs, friction, high, lam) -> np.ndarray:
        """(n_v, n_v) covariance of a step's velocities from where contacts are: a
        surface whose gap is not known is as far from where the model has it along
        itself, too, and at a corner or on a ball the normal is then another one."""
        model, found = self.model, np.zeros_like(sample.M)
        off, (J, _, contact) = model.of_rows(lcs, self._gap_std), pushes(lcs)
        n_of_rows = normals(lcs)
        for one in np.unique(contact[(off > 0.0) & (lam > 0.0)]):
            mine = contact == one
            T = tangents(J - n_of_rows, friction, mine, high[mine][0])
            n = n_of_rows[mine][0]
            force = tangent_edges(friction, mine, high[mine][0]).T @ lam[mine]
            ways = np.linalg.solve(sample.M, T.T).T
            reach = np.maximum((T * ways).sum(axis=1), 1e-300)
            ways *= off[mine][0] / reach[:, None]
            turns = model.normals_beside(sample.x, [*ways, *-ways])[:, mine][:, 0]
            for turn in turns:
                change = lam[mine].sum() * turn @ T - force @ turn * n
                change = model.dt_sec * np.linalg.solve(sample.M, change)
                found += 0.5 * np.outer(change, change)
        return found


def _noise_of(found: Explained, loss: Loss) -> float:
    """The most that twice a step's loss may be by noise: of a chi-square of as many
    degrees as what is weighed has more than the forces that are free."""
    rows = np.diag(loss.W) > 0.0
    forces = np.linalg.matrix_rank(found.D[np.ix_(rows, found.f > 0.0)])
    n = np.count_nonzero(rows) - forces
    return n + BEYOND_NOISE * np.sqrt(2.0 * n)


def _finer(pair: ContactPair) -> ContactPair:
    if pair.plane_normal or pair.friction_directions >= DIRECTIONS:
        return pair
    return replace(pair, friction_directions=DIRECTIONS)

"""Adaptive variable impedance for a point effector in the plane."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.changing_contact.numerics.igmm import (
    IgmmConfig,
    Mixture,
    igmm_tuning,
    warm_up,
)
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed
from makebreak.systems.planar.numerics.planar_impedance import (
    ForceModel,
    after_sample,
    force_command,
    new_model,
    predicted_force,
    stiffness_of,
    trust,
)

HELD, AT_LIMIT, NO_MODEL = 1, 2, 4  # Status, a sum.


@dataclass
class PlanarImpedanceConfig:
    """Settings of PlanarImpedance."""

    # K_free of eq. 4b: stiffness where the force model predicts well [N/m].
    stiffness_free: float = 50.0
    # K_max of eq. 4b: stiffness where the force model predicts badly [N/m].
    stiffness_max: float = 500.0
    # Damping ratio; 1: critical; the paper's sqrt(K)/4 is 0.125.
    damping_ratio: float = 1.0
    # Steepness r of the trust in the force model over its error (eq. 4c) [1/N].
    steepness: float = 8.0
    # Error eps_0 of the force model at which the trust is 1/2 (eq. 4c) [N].
    error_mid: float = 1.0
    learn: bool = True  # Whether the mixture of the force model learns.
    # Whether stiffness and feed-forward depend on the force model; false: the stiffness
    # is stiffness_max, without feed-forward.
    adapt: bool = True


def _default_model() -> IgmmConfig:
    return IgmmConfig(sigma_ini=[0.05, 0.05, 1.0, 1.0, 1.0, 1.0])


@dataclass
class ForceModelConfig:
    """Settings of the model that predicts the force in the plane."""

    # Mixture over [v 2, F 2, next F 2]; with `position` over [p 2, v 2, F 2, next F 2];
    # with `along_motion` over [|v|, f, next f].
    mixture: IgmmConfig = field(default_factory=_default_model)
    # Whether the mixture is over [|v|, f, next f], with f the force against the motion;
    # false: over the vectors [v 2, F 2, next F 2].
    along_motion: bool = False
    # Period of the force model's updates, over which it predicts [s].
    period_sec: float = 0.005
    # Whether the mixture has the position too, [p 2, v 2, F 2, next F 2]; not with
    # along_motion.
    position: bool = False


class PlanarImpedance(LeafSystem):
    """Impedance control that is stiff while its force model predicts badly, and soft
    with feed-forward while it predicts well (numerics/planar_impedance.py).

    The model is updated at its own rate, u at 1 kHz; at a common instant the model is
    first. While state or x_desired is not finite, u is held; while force is not finite,
    the stiffness is full, without feed-forward.

    Inputs:  state (4,) p, v; x_desired (6,) p, v, a; force (2,): measured, of the world
             on the effector [N].
    Outputs: u (2,) [N]; stiffness (1,) [N/m]; force_predicted (2,): for the model's
             next sample, along the present motion [N]; prediction_error (1,): |error|
             of the newest sample [N], -1 without a prediction; trust (1,): lambda;
             status (1,), a sum: 1 u held, 2 u at its limit, 4 no model yet.

    Args: config; model; mass [kg]; force_max: limit of |u| [N]; knowledge: a mixture
        learned earlier; period_sec, offset_sec: of u [s].
    Raises: ValueError that names a setting out of range.
    """

    def __init__(
        self,
        config: PlanarImpedanceConfig,
        model: ForceModelConfig,
        mass: float = 1.0,
        force_max: float = 100.0,
        knowledge: Mixture | None = None,
        period_sec: float = 0.001,
        offset_sec: float = 0.0,
    ):
        super().__init__()
        check_settings(config)
        c = config
        for name, number in (
            ("stiffness_free", c.stiffness_free),
            ("damping_ratio", c.damping_ratio),
            ("steepness", c.steepness),
            ("error_mid", c.error_mid),
            ("mass", mass),
            ("force_max", force_max),
            ("period_sec", period_sec),
        ):
            if not 0.0 < number < np.inf:
                raise ValueError(f"{name} is {number}, expected > 0")
        if not c.stiffness_free <= c.stiffness_max < np.inf:
            raise ValueError(
                f"stiffness_max is {c.stiffness_max}, expected at least "
                f"stiffness_free, {c.stiffness_free}"
            )
        every = model.period_sec / period_sec
        if every < 1.0 or abs(every - round(every)) > 1e-9:
            raise ValueError(
                f"the model's period_sec is {model.period_sec}, expected a multiple "
                f"of {period_sec}"
            )
        self._tuning = igmm_tuning(model.mixture)
        if model.along_motion and model.position:
            raise ValueError("a model is along_motion or has the position, not both")
        n_in, n_out = (2, 1) if model.along_motion else (6 if model.position else 4, 2)
        n = self._tuning.sigma_ini.size
        if n != n_in + n_out:
            raise ValueError(f"sigma_ini has {n} entries, expected {n_in + n_out}")
        if knowledge is not None and knowledge.mean.shape[1] != n:
            raise ValueError(
                f"knowledge is over {knowledge.mean.shape[1]} entries, expected {n}"
            )
        first_call(warm_up, self._tuning, n_in)
        self._config = config
        self._along_motion, self._position = model.along_motion, model.position
        self._mass, self._force_max = float(mass), float(force_max)
        self._state = self.DeclareVectorInputPort("state", 4)
        self._target = self.DeclareVectorInputPort("x_desired", 6)
        self._force = self.DeclareVectorInputPort("force", 2)
        # u, K, status
        self._command = self.DeclareDiscreteState([0.0, 0.0, c.stiffness_max, 0.0])
        first = new_model(self._tuning, knowledge, model.along_motion)
        self._model = self.DeclareAbstractState(Value(first))
        ticket = {self.discrete_state_ticket(self._command)}
        self.DeclareVectorOutputPort("u", 2, self._calc_u, ticket)
        self.DeclareVectorOutputPort("stiffness", 1, self._calc_stiffness, ticket)
        self.DeclareVectorOutputPort("status", 1, self._calc_status, ticket)
        ticket = {self.abstract_state_ticket(self._model)}
        self.DeclareVectorOutputPort("prediction_error", 1, self._calc_error, ticket)
        self.DeclareVectorOutputPort("trust", 1, self._calc_trust, ticket)
        ticket = ticket | {self.input_port_ticket(self._state.get_index())}
        self.DeclareVectorOutputPort("force_predicted", 2, self._calc_force, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            model.period_sec, offset_sec, self._update_model
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, offset_sec, self._update)
        zero = np.zeros(2)
        force_command(
            np.zeros(4), np.zeros(6), 0.0, 1.0, zero, self._mass, 1.0, self._force_max
        )
        stiffness_of(0.0, float(c.stiffness_free), float(c.stiffness_max))

    def knowledge(self, context: Context) -> Mixture:
        """The learned mixture, for the constructor in the next trial."""
        return self._model_of(context).mixture

    def _model_of(self, context) -> Any:
        return context.get_abstract_state(self._model).get_value()

    def _trust(self, model: ForceModel) -> float:
        return trust(model.filtered, self._config.steepness, self._config.error_mid)

    def _update_model(self, context: Context, state):
        model = after_sample(
            self._model_of(context),
            self._tuning,
            self._state.Eval(context),
            self._force.Eval(context),
            self._along_motion,
            self._config.learn,
            self._position,
        )
        state.get_mutable_abstract_state(self._model).set_value(model)

    @timed
    def _update(self, context: Context, discrete_state):
        model = self._model_of(context)
        state, target = self._state.Eval(context), self._target.Eval(context)
        last = context.get_discrete_state(self._command).value()
        c = self._config
        lam = self._trust(model) if c.adapt else 0.0
        K = stiffness_of(lam, float(c.stiffness_free), float(c.stiffness_max))
        status = NO_MODEL if np.isinf(model.filtered) else 0
        u = force_command(
            state,
            target,
            lam,
            K,
            predicted_force(model, state, self._along_motion),
            self._mass,
            float(c.damping_ratio),
            self._force_max,
        )
        if np.isfinite(u[0] + u[1]):
            if u[0] ** 2 + u[1] ** 2 >= (1.0 - 1e-12) * self._force_max**2:
                status |= AT_LIMIT
        else:
            u, status = last[:2], status | HELD
        discrete_state.set_value(self._command, [u[0], u[1], K, status])

    def _calc_u(self, context: Context, output: BasicVector):
        output.SetFromVector(context.get_discrete_state(self._command).value()[:2])

    def _calc_stiffness(self, context: Context, output: BasicVector):
        output.SetFromVector(context.get_discrete_state(self._command).value()[2:3])

    def _calc_status(self, context: Context, output: BasicVector):
        output.SetFromVector(context.get_discrete_state(self._command).value()[3:])

    def _calc_force(self, context: Context, output: BasicVector):
        model, state = self._model_of(context), self._state.Eval(context)
        output.SetFromVector(predicted_force(model, state, self._along_motion))

    def _calc_error(self, context: Context, output: BasicVector):
        error = self._model_of(context).error
        output.SetFromVector([error if np.isfinite(error) else -1.0])

    def _calc_trust(self, context: Context, output: BasicVector):
        output.SetFromVector([self._trust(self._model_of(context))])

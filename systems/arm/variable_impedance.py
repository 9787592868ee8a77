"""Variable stiffness and feed-forward as a system (numerics/variable_impedance.py)."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from makebreak.systems.arm.numerics.variable_impedance import (
    N_MEMORY,
    StiffnessLaw,
    tick,
    warm_up,
)
from makebreak.systems.changing_contact.numerics.contact_task import N_PHASE
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

# Filter of the feed-forward while a learned model is handed over [s]: its prediction
# has no measurement noise, so the filter only has to bound the torque's rate.
HANDOVER_FILTER_SEC = 0.005


@dataclass
class StiffnessConfig:
    """Along each axis [N/m]; free = maximum = impact gives a constant stiffness."""

    # K_free: stiffness where the forward model predicts well [N/m].
    free: float = 200.0
    # K_max: stiffness where the forward model predicts badly, or the mode is being
    # identified [N/m].
    maximum: float = 1000.0
    impact: float = 150.0  # K_impact: stiffness where an impact is expected [N/m].
    rotational: float = 40.0  # Stiffness about each axis, which is constant [N m/rad].
    # Whether the damping is the paper's, D = sqrt(K)/4 (docs/impedance.md); without
    # effect in gentle_rolling, whose blend sets the damping.
    paper_damping: bool = False


@dataclass
class TrustConfig:
    """Trust in the forward model as a function of its error (CC eq. 4c)."""

    # Steepness r of the trust in the forward model over its error (CC eq. 4c) [1/N].
    steepness: float = 8.0
    # Error eps_0 of the forward model at which the trust is 1/2 (CC eq. 4c) [N].
    midpoint: float = 0.8
    # Time constant of the filter of stiffness and feed-forward [s]; 0: none.
    filter_sec: float = 0.02


@dataclass
class VariableImpedanceConfig:
    """Settings of VariableImpedance: how stiffness follows the tracking error."""

    stiffness: StiffnessConfig = field(default_factory=StiffnessConfig)
    trust: TrustConfig = field(default_factory=TrustConfig)
    # Time T of the blend between base and transition-phase controller (CC eq. 10) [s].
    blend_sec: float = 0.1
    feedforward: bool = True  # Whether the predicted wrench is fed forward.
    # Whether expected changes of contact have a controller of their own; false: the
    # base controller alone.
    transition: bool = True
    period_sec: float = 0.001  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


class VariableImpedance(LeafSystem):
    """Stiffness, damping and feed-forward of the base controller, the transition-phase
    controllers, and the blend of both. This is what is asked for: ImpedanceController
    lets the stiffness rise as far as its energy tank can pay for it.

    Inputs:  prediction_error (1,) [N]; wrench_predicted (6,): on the tool [N], [N m];
             collecting (1,): 1 while the mode detector collects a batch; phase (6,) of
             VelocityShaper; handing_over (1,), optional: 1 while a model of an earlier
             trial takes over: its prediction is fed forward with a filter of 5 ms.
    Outputs (all state): stiffness (6,) [N/m] x 3, [N m/rad] x 3;
             damping_stiffness (6,): the stiffness from which the damping is computed
             (in an impact the tip is damped as for K_max); with paper_damping instead
             damping (6,) [N s/m] x 3, [N m s/rad] x 3;
             wrench_feedforward (6,) [N], [N m]; trust (1,): lambda of CC eq. 4c;
             status (1,): 1 while an input is NaN; then K_max, no feed-forward, or the
             base controller is used.

    Raises: ValueError for a setting out of range.
    Source: CC eq. 4b, 4c, 8, 10.
    """

    def __init__(self, config: VariableImpedanceConfig):
        super().__init__()
        check_settings(config)
        stiffness = config.stiffness
        for name in ("free", "maximum", "impact", "rotational"):
            if not 0.0 < getattr(stiffness, name) < np.inf:
                raise ValueError(
                    f"stiffness.{name} is {getattr(stiffness, name)}, expected > 0"
                )
        if stiffness.free > stiffness.maximum:
            raise ValueError(
                f"stiffness.free is {stiffness.free}, expected at most the maximum, "
                f"{stiffness.maximum}"
            )
        for name, number, least in (
            ("trust.steepness", config.trust.steepness, "> 0"),
            ("trust.midpoint", config.trust.midpoint, ">= 0"),
            ("trust.filter_sec", config.trust.filter_sec, ">= 0"),
            ("blend_sec", config.blend_sec, "> 0"),
            ("period_sec", config.period_sec, "> 0"),
        ):
            if not (number > 0.0 or (number == 0.0 and least == ">= 0")):
                raise ValueError(f"{name} is {number}, expected {least}")
        filter_sec = config.trust.filter_sec
        self._law = StiffnessLaw(
            free=float(stiffness.free),
            maximum=float(stiffness.maximum),
            impact=float(stiffness.impact),
            rotational=float(stiffness.rotational),
            steepness=float(config.trust.steepness),
            midpoint=float(config.trust.midpoint),
            decay=float(np.exp(-config.period_sec / filter_sec)) if filter_sec else 0.0,
            blend_ticks=max(1.0, config.blend_sec / config.period_sec),
            feedforward=bool(config.feedforward),
            transition=bool(config.transition),
            decay_handover=float(np.exp(-config.period_sec / HANDOVER_FILTER_SEC)),
        )
        first_call(warm_up, self._law)
        self._paper = stiffness.paper_damping
        self._error = self.DeclareVectorInputPort("prediction_error", 1)
        self._predicted = self.DeclareVectorInputPort("wrench_predicted", 6)
        self._collecting = self.DeclareVectorInputPort("collecting", 1)
        self._phase = self.DeclareVectorInputPort("phase", N_PHASE)
        self._handing_over = self.DeclareVectorInputPort("handing_over", 1)
        # Before the first update: K_max, no feed-forward.
        first = np.repeat([stiffness.maximum, stiffness.rotational], 3)
        self._memory = self.DeclareDiscreteState(N_MEMORY)
        self._stiffness = self.DeclareDiscreteState(first)
        self._damping = self.DeclareDiscreteState(
            np.sqrt(first) / 4.0 if self._paper else first
        )
        self._wrench = self.DeclareDiscreteState(6)
        self._trust = self.DeclareDiscreteState(1)
        self._status = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("stiffness", self._stiffness)
        self.DeclareStateOutputPort(
            "damping" if self._paper else "damping_stiffness", self._damping
        )
        self.DeclareStateOutputPort("wrench_feedforward", self._wrench)
        self.DeclareStateOutputPort("trust", self._trust)
        self.DeclareStateOutputPort("status", self._status)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context: Context, discrete_state):
        handing_over = 0.0
        if self._handing_over.HasValue(context):
            handing_over = self._handing_over.Eval(context)[0]
        output = tick(
            self._law,
            discrete_state.get_mutable_value(self._memory),
            self._error.Eval(context)[0],
            self._predicted.Eval(context),
            self._collecting.Eval(context)[0],
            self._phase.Eval(context),
            handing_over,
        )
        discrete_state.set_value(self._stiffness, output[:6])
        damping = output[6:12]
        discrete_state.set_value(
            self._damping, np.sqrt(damping) / 4.0 if self._paper else damping
        )
        discrete_state.set_value(self._wrench, output[12:18])
        discrete_state.set_value(self._trust, output[18:19])
        discrete_state.set_value(self._status, output[19:20])

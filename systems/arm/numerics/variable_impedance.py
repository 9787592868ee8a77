"""Variable stiffness and feed-forward: adaptive, and at changes of contact.

The base controller is stiff while the forward model predicts badly, and feeds its
prediction forward while it predicts well:

    lambda = 1 - 1 / (1 + exp(-r (eps - eps_0)))                            (CC 4c)
    K_1    = K_free + (1 - lambda) (K_max - K_free),  f_ff = -lambda W      (CC 4b, 4a)

K_1 is K_max while the mode detector collects a batch. The transition-phase controller
(CC 3.4) has K_2 = K_impact, low, with the damping of K_max, where an impact is
expected, and K_2 = K_max where the contact changes without one. The two are blended,

    u = (1 - alpha) u_1 + alpha u_2                                         (CC 10)

with alpha linear in time over T, in both directions. Both laws are linear in K, D and
f_ff with the same errors, so blending K and D is enough. D = 2 zeta sqrt(lambda_i K)
with a mass lambda_i that is not known here; blending D is blending sqrt(K), so the
damping is computed from the stiffness ((1 - alpha) sqrt(K_1) + alpha sqrt(K_max))^2.

Source: CC sections 3.1, 3.2 (Algorithm 1), 3.4 and 3.5.1.
"""

from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.contact_task import (
    ENTER,
    IMPACT,
    IMPACTLESS,
    N_PHASE,
    NO_CONTACT,
    PHASE_KIND,
    PHASE_STAGE,
    REGION,
)

# Memory: filtered K_1 [N/m], filtered feed-forward (6), alpha, the kind of contact that
# alpha belongs to, whether there was a tick.
N_MEMORY = 10
STIFFNESS, FEEDFORWARD, ALPHA, KIND, STARTED = 0, slice(1, 7), 7, 8, 9
# Output: K (6), the stiffness for the damping (6), f_ff (6), lambda, status.
N_OUTPUT = 20
BAD_INPUT = 1


class StiffnessLaw(NamedTuple):
    """Constants; stiffness along each axis [N/m], about each axis [N m/rad]."""

    free: float  # K_free
    maximum: float  # K_max
    impact: float  # K_2 where an impact is expected.
    rotational: float
    steepness: float  # r [1/N]
    midpoint: float  # eps_0 [N]
    decay: float  # First-order filter of K_1 and f_ff: factor per tick, in [0, 1).
    blend_ticks: float  # T in ticks.
    feedforward: bool
    transition: bool  # False: the base controller alone.
    decay_handover: float = 0.0  # Filter of f_ff while a model is handed over.


@numba.njit(cache=True)
def trust(error, steepness, midpoint):
    """lambda of CC eq. 4c, from 0 to 1.

    Args: error: eps, of the forward model's prediction [N]; steepness: r [1/N];
        midpoint: eps_0 [N].
    """
    exponent = steepness * (error - midpoint)
    # Beyond 700 the exponential leaves the range of floating-point numbers.
    return 1.0 / (1.0 + np.exp(min(exponent, 700.0)))


@numba.njit(cache=True)
def tick(law, memory, error, predicted, collecting, phase, handing_over=0.0):
    """One tick, which changes the memory in place.

    Args:
        law: StiffnessLaw. memory (N_MEMORY,), zero at first.
        error: prediction error eps [N].
        predicted: W (6,), predicted wrench on the tool [N], [N m].
        collecting: 1 while a batch is collected, else 0.
        phase: (N_PHASE,).
        handing_over: 1 while W is the mean of an earlier model for the place that is
            reached now, which is filtered less than a single noisy prediction.
        NaN in an input gives K_max, no feed-forward, or the base controller.
    Returns: output (N_OUTPUT,).
    """
    output = np.empty(N_OUTPUT)
    status = 0
    weight = 0.0
    if np.isfinite(error):
        weight = trust(error, law.steepness, law.midpoint)
    else:
        status = BAD_INPUT
    K_1 = law.free + (1.0 - weight) * (law.maximum - law.free)
    if not np.isfinite(collecting):
        status = BAD_INPUT
    if not collecting < 0.5:
        K_1 = law.maximum
    usable = np.all(np.isfinite(predicted))
    if not usable:
        status = BAD_INPUT

    keep = law.decay if memory[STARTED] > 0.0 else 0.0
    memory[STARTED] = 1.0
    memory[STIFFNESS] = K_1 + keep * (memory[STIFFNESS] - K_1)
    phase_known = np.all(np.isfinite(phase))
    if not phase_known:
        status = BAD_INPUT
    # A one-step model follows the force of an impact as it follows friction: fed
    # forward, its prediction would push harder against the new surface. So it is held
    # where an impact is expected.
    waiting = (
        law.transition
        and phase_known
        and phase[PHASE_STAGE] == REGION
        and phase[PHASE_KIND] == IMPACT
    )
    keep_force = keep
    if handing_over > 0.5:
        keep_force = min(keep, law.decay_handover)
    if not waiting:
        for i in range(6):
            force = -weight * predicted[i] if law.feedforward and usable else 0.0
            at = FEEDFORWARD.start + i
            memory[at] = force + keep_force * (memory[at] - force)

    kind = NO_CONTACT
    if (
        phase_known
        and law.transition
        and (phase[PHASE_STAGE] == ENTER or phase[PHASE_STAGE] == REGION)
    ):
        kind = int(phase[PHASE_KIND])
    step = 1.0 / law.blend_ticks
    if memory[ALPHA] <= 0.0:
        memory[KIND] = kind
    if kind != NO_CONTACT and memory[KIND] == kind:
        memory[ALPHA] = min(memory[ALPHA] + step, 1.0)
    else:  # Blend back to the base controller before blending to another kind.
        memory[ALPHA] = max(memory[ALPHA] - step, 0.0)
    if memory[ALPHA] < 1e-9:
        memory[ALPHA] = 0.0

    alpha, K_1 = memory[ALPHA], memory[STIFFNESS]
    K_2 = law.impact if memory[KIND] == IMPACT else law.maximum
    root = (1.0 - alpha) * np.sqrt(K_1) + alpha * np.sqrt(law.maximum)
    output[:3] = (1.0 - alpha) * K_1 + alpha * K_2
    output[3:6] = law.rotational
    output[6:9] = root**2
    output[9:12] = law.rotational
    output[12:18] = memory[FEEDFORWARD]
    output[18] = weight
    output[19] = status
    return output


def warm_up(law: StiffnessLaw) -> None:
    """Compiles the tick."""
    memory = np.zeros(N_MEMORY)
    phase = np.zeros(N_PHASE)
    phase[PHASE_KIND] = IMPACTLESS
    tick(law, memory, 0.0, np.zeros(6), 0.0, phase, 0.0)

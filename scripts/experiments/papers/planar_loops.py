"""Trials of the planar experiments as compiled loops, for tuning and comparisons.

tests/test_planar_experiments.py checks them against the diagrams, tick for tick.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from makebreak.diagrams.planar import (
    FORCE_MAX,
    MASS,
    PERIOD,
    PlanarSensing,
    state_noise_seed,
)
from makebreak.systems.baselines.active_inference import ActiveInferenceConfig
from makebreak.systems.baselines.biomimetic import BiomimeticConfig
from makebreak.systems.baselines.mrac import MracConfig
from makebreak.systems.baselines.numerics import active_inference, mrac
from makebreak.systems.baselines.numerics.biomimetic import (
    after_trial,
    force_command,
    no_gains,
)
from makebreak.systems.baselines.numerics.mrac import error_weights
from makebreak.systems.changing_contact.numerics.igmm import Mixture, igmm_tuning
from makebreak.systems.perception.numerics.sensor_noise import add_noise
from makebreak.systems.planar.numerics.planar_impedance import (
    after_sample,
    new_model,
    predicted_force,
    stiffness_of,
    trust,
)
from makebreak.systems.planar.numerics.planar_impedance import (
    force_command as impedance_command,
)
from makebreak.systems.planar.numerics.planar_world import (
    circle_target,
    compensated,
    external_force,
    step,
)
from makebreak.systems.planar.planar_impedance import (
    ForceModelConfig,
    PlanarImpedanceConfig,
)
from makebreak.systems.planar.planar_world import (
    CircleTargetConfig,
    PlanarWorldConfig,
    springs_of,
)

_EVERY = 5  # Ticks between samples of the error.


@dataclass(frozen=True, eq=False)
class PlanarTrial:
    """A world, a circle and sensor errors, as arguments of compiled loops.

    n is the number of ticks.
    """

    world: tuple  # Arguments of numerics.planar_world.step after the mass.
    circle: tuple  # Arguments of circle_target after t.
    state_noise: np.ndarray  # (n, 4) [m], [m/s]
    force_noise: np.ndarray  # (n, 2) [N]
    delay: int  # Of the measurements [ticks].

    @property
    def start(self) -> np.ndarray:
        """(4,): at rest on the circle."""
        radius, _, phase, _ = self.circle
        return np.array([radius * np.cos(phase), radius * np.sin(phase), 0.0, 0.0])

    @property
    def sensing(self) -> tuple:
        return self.state_noise, self.force_noise, self.delay


def trial_of(
    world: PlanarWorldConfig,
    target: CircleTargetConfig,
    sensing: PlanarSensing,
    seed: int,
) -> PlanarTrial:
    """The trial that make_planar builds from the same arguments."""
    n = round(target.duration_sec / PERIOD)
    state_noise = _noise(np.array(sensing.state_std()), state_noise_seed(seed), n)
    force_noise = _noise(np.full(2, sensing.force_noise), seed, n)
    viscosity = np.array(world.viscosity, dtype=float)
    return PlanarTrial(
        (viscosity, float(world.ramp_sec), *springs_of(world)),
        (target.radius, target.duration_sec, target.phase, float(target.turn)),
        state_noise,
        force_noise,
        sensing.delay_ticks,
    )


@njit(cache=True)
def _noise(std, seed, n):
    """(n, len(std)) noise that a NoisySensor adds at each tick."""
    out, zero = np.empty((n, std.shape[0])), np.zeros(std.shape[0])
    for k in range(n):
        out[k] = add_noise(zero, std, seed, k)
    return out


@njit(cache=True)
def _target(k, circle):
    """(6,) circle_target at the start of tick k."""
    return circle_target(k * PERIOD, circle[0], circle[1], circle[2], circle[3])


@njit(cache=True)
def _squared_error(state, k, circle):
    """Squared error at the end of tick k [m2], for one tick in _EVERY; else 0."""
    if (k + 1) % _EVERY != 0:
        return 0.0
    goal = _target(k + 1, circle)
    return (state[0] - goal[0]) ** 2 + (state[1] - goal[1]) ** 2


@njit(cache=True)
def _world_step(state, k, u, w):
    return step(state, k * PERIOD, u, PERIOD, MASS, w[0], w[1], w[2], w[3])


@njit(cache=True)
def _world_force(state, k, w):
    return external_force(state, k * PERIOD, w[0], w[1], w[2], w[3])


@njit(cache=True)
def _seen(values, noise, delay, k):
    """The measurement at tick k of values (n, m), which are known up to k."""
    late = max(k - delay, 0)
    return values[late] + noise[late]


@njit(cache=True)
def _total(u, forces, k, sensing, feedforward):
    """u minus the measured force, if that is fed forward."""
    if not feedforward:
        return u
    return compensated(u, _seen(forces, sensing[1], sensing[2], k), FORCE_MAX)


@njit(cache=True)
def _biomimetic_trial(
    force, stiffness, damping, fixed, circle, state, world, sensing, feedforward
):
    """e, de/dt at each time step, and the RMS error."""
    n, steps = round(circle[1] / PERIOD), force.shape[0]
    states, forces = np.empty((n, 4)), np.empty((n, 2))
    errors, total = np.empty((steps, 4)), 0.0
    for k in range(n):
        states[k], forces[k] = state, _world_force(state, k, world)
        seen = _seen(states, sensing[0], sensing[2], k)
        target = _target(k, circle)
        j = k * steps // n
        if k == 0 or j != (k - 1) * steps // n:
            errors[j] = seen - target[:4]
        u, _ = force_command(
            seen, target, force[j], stiffness[j], damping[j], fixed, MASS, FORCE_MAX
        )
        u = _total(u, forces, k, sensing, feedforward)
        state = _world_step(state, k, u, world)
        total += _squared_error(state, k, circle)
    return errors, np.sqrt(total / (n // _EVERY))


@njit(cache=True)
def _mrac_trial(
    omega, zeta, p2, p3, gains, lag, circle, state, world, sensing, feedforward
):
    n = round(circle[1] / PERIOD)
    states, forces = np.empty((n, 4)), np.empty((n, 2))
    memory, held, total = np.zeros(mrac.MEMORY), np.zeros(2), 0.0
    for k in range(n):
        states[k], forces[k] = state, _world_force(state, k, world)
        u, after, _ = mrac.tick(
            memory,
            _seen(states, sensing[0], sensing[2], k),
            _target(k, circle),
            omega,
            zeta,
            p2,
            p3,
            gains,
            lag,
            PERIOD,
            FORCE_MAX,
        )
        if np.isfinite(u.sum()) and np.isfinite(after.sum()):
            memory, held = after, u
        u = _total(held, forces, k, sensing, feedforward)
        state = _world_step(state, k, u, world)
        total += _squared_error(state, k, circle)
    return np.sqrt(total / (n // _EVERY))


@njit(cache=True)
def _active_inference_trial(
    moves, precision, k_belief, k_action, circle, state, world, sensing, feedforward
):
    n = round(circle[1] / PERIOD)
    states, forces = np.empty((n, 4)), np.empty((n, 2))
    memory, total = np.zeros(active_inference.MEMORY), 0.0
    for k in range(n):
        states[k], forces[k] = state, _world_force(state, k, world)
        _, after, _ = active_inference.tick(
            memory,
            _seen(states, sensing[0], sensing[2], k),
            _target(k, circle),
            moves,
            precision,
            k_belief,
            k_action,
            PERIOD,
            FORCE_MAX,
        )
        if np.isfinite(after.sum()):
            memory = after
        u = _total(memory[6:8], forces, k, sensing, feedforward)
        state = _world_step(state, k, u, world)
        total += _squared_error(state, k, circle)
    return np.sqrt(total / (n // _EVERY))


def mrac_error(
    config: MracConfig, trial: PlanarTrial, feedforward: bool = False
) -> float:
    """RMS tracking error of a trial [m]."""
    p2, p3 = error_weights(config.omega, config.zeta, config.rate_weight)
    gains = np.array(
        config.force_gains + config.position_gains + config.velocity_gains, dtype=float
    )
    law = (config.omega, config.zeta, p2, p3, gains, bool(config.lag))
    world = (trial.circle, trial.start, trial.world, trial.sensing)
    return float(_mrac_trial(*law, *world, feedforward))


def active_inference_error(
    config: ActiveInferenceConfig, trial: PlanarTrial, feedforward: bool = False
) -> float:
    """RMS tracking error of a trial [m]."""
    precision = 1.0 / np.array(config.variance)
    law = (bool(config.goal_moves), precision, config.k_belief, config.k_action)
    world = (trial.circle, trial.start, trial.world, trial.sensing)
    return float(_active_inference_trial(*law, *world, feedforward))


def learning_curve(
    config: BiomimeticConfig, trials: Sequence[PlanarTrial], feedforward: bool = False
) -> list[float]:
    """RMS tracking error of each of consecutive trials [m].

    Gains are learned for time steps of the first trial; in a trial of other duration
    they are those of the same place on the path.
    """
    gains = no_gains(round(trials[0].circle[1] / config.step_sec))
    fixed = np.array([config.stiffness, config.damping])
    curve = []
    for trial in trials:
        world = (trial.circle, trial.start, trial.world, trial.sensing)
        learned = (gains.force, gains.stiffness, gains.damping)
        errors, rms = _biomimetic_trial(*learned, fixed, *world, feedforward)
        curve.append(float(rms))
        gains = after_trial(
            gains,
            errors[:, :2],
            errors[:, 2:],
            config.kappa,
            config.rates,
            config.forget,
            config.forget_less,
        )
    return curve


def adaptive_error(
    law: PlanarImpedanceConfig,
    config: ForceModelConfig,
    trial: PlanarTrial,
    knowledge: Mixture | None = None,
) -> tuple[float, Mixture]:
    """RMS tracking error of a trial [m], and the model after it."""
    tuning, along = igmm_tuning(config.mixture), config.along_motion
    model = new_model(tuning, knowledge, along)
    state, total, every = trial.start, 0.0, round(config.period_sec / PERIOD)
    n = len(trial.state_noise)
    states, forces = np.empty((n, 4)), np.empty((n, 2))
    state_noise, force_noise, delay = trial.sensing
    for k in range(n):
        states[k], forces[k] = state, _world_force(state, k, trial.world)
        seen = _seen(states, state_noise, delay, k)
        if k % every == 0:
            F = _seen(forces, force_noise, delay, k)
            model = after_sample(
                model, tuning, seen, F, along, law.learn, config.position
            )
            lam = 0.0
            if law.adapt:
                lam = trust(model.filtered, law.steepness, law.error_mid)
            K = stiffness_of(lam, law.stiffness_free, law.stiffness_max)
        u = impedance_command(
            seen,
            _target(k, trial.circle),
            lam,
            K,
            predicted_force(model, seen, along),
            MASS,
            law.damping_ratio,
            FORCE_MAX,
        )
        state = _world_step(state, k, u, trial.world)
        total += _squared_error(state, k, trial.circle)
    return float(np.sqrt(total / (n // _EVERY))), model.mixture

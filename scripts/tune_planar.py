"""Tunes every controller of the planar experiments with one and the same budget.

    python -m makebreak.scripts.tune_planar [CONTROLLER ...] [--scale S] [--out FILE]

Random search: 200 settings drawn log-uniformly, then 100 drawn around the best one so
far, each tried on seeds 100 to 102 and scored by the mean RMS tracking error; the best
five are tried on seeds 100 to 113, and the one with the least median wins. A trial of
the biomimetic controller is a whole learning run of 30 trials, scored by the last; for
it --scale 0.3 was enough, ten times the trials of the others.

All are as compliant as the adaptive controller is at its stiffest: proportional
stiffness at most stiffness_max, proportional damping at most twice critical there.
(Else a high gain does what adaptation is to do; `mrac_free` and `active_inference_free`
show it.) Active inference integrates its error of velocity, k_a P_y' int de/dt dt: that
factor is its proportional stiffness. What was found is in docs/planar.md and is the
default of diagrams/multi_spring.py and diagrams/porridge.py.

Trials run as plain loops here, without a diagram; tests/test_planar_experiments.py
holds them against the diagrams, tick for tick.
"""

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numba import njit
from tqdm import tqdm

from makebreak.diagrams import multi_spring, porridge
from makebreak.diagrams.planar import FORCE_MAX, MASS, PERIOD
from makebreak.systems.baselines.active_inference import ActiveInferenceConfig
from makebreak.systems.baselines.biomimetic import BiomimeticConfig
from makebreak.systems.baselines.mrac import MracConfig
from makebreak.systems.numerics import active_inference, mrac
from makebreak.systems.numerics.biomimetic import after_trial, force_command, no_gains
from makebreak.systems.numerics.igmm import IgmmConfig, Mixture, igmm_tuning
from makebreak.systems.numerics.mrac import error_weights
from makebreak.systems.numerics.planar_impedance import (
    after_sample,
    new_model,
    predicted_force,
    stiffness_of,
    trust,
)
from makebreak.systems.numerics.planar_impedance import (
    force_command as impedance_command,
)
from makebreak.systems.numerics.planar_world import (
    circle_target,
    external_force,
    step,
)
from makebreak.systems.numerics.sensor_noise import add_noise
from makebreak.systems.planar_impedance import ForceModelConfig, PlanarImpedanceConfig

SEARCH_SEEDS, FINAL_SEEDS = (100, 101, 102), tuple(range(100, 114))
RANDOM, AROUND, FINALISTS = 200, 100, 5
_EVERY = 5  # Ticks from one sample of the error to the next.
K_MAX = PlanarImpedanceConfig().stiffness_max
D_MAX = 2.0 * 2.0 * float(np.sqrt(K_MAX * MASS))  # [N s/m]
# On the circle, at most: |x| [m], |v| [m/s].
X_MAX, V_MAX = 0.25, 0.49
TRIALS = 30

_MIXTURE = {
    "stiffness_free": (20.0, 0.22 * K_MAX),
    "sigma_v": (0.001, 0.5),
    "sigma_force": (0.2, 5.0),
    "tau_nov": (1e-6, 0.1),
    "sp_max": (20.0, 1e5),
    "damping_ratio": (0.3, 2.0),
    "steepness": (3.0, 30.0),
    "error_mid": (0.4, 3.0),
}
_MRAC = {
    "omega": (0.3, 30.0),
    "zeta": (0.3, 2.0),
    "rate_weight": (1e-3, 10.0),
    "stiffness": (5.0, K_MAX),
    "integral_rate": (0.1, 100.0),
    "position_now": (0.01, 1e4),
    "position_summed": (0.01, 1e4),
    "velocity_now": (0.01, 1e4),
    "velocity_summed": (0.01, 1e4),
}
# The best of _MRAC lies at the edge of its integral gains: without that edge.
_WIDE = {
    "integral_rate": (0.1, 1e4),
    "position_now": (0.01, 1e6),
    "position_summed": (0.01, 1e9),
    "velocity_now": (0.01, 1e6),
    "velocity_summed": (0.01, 1e9),
}
_ACTIVE_INFERENCE = {
    "variance_velocity": (0.1, 100.0),
    "variance_belief": (1e-4, 100.0),
    "variance_rate": (1e-4, 100.0),
    "k_belief": (0.05, 200.0),
    "stiffness": (5.0, K_MAX),  # k_a / variance_velocity.
}
_BIOMIMETIC = {
    "kappa": (1.0, 50.0),
    "rate_force": (0.1, 1e3),
    "rate_stiffness": (0.1, 1e5),
    "rate_damping": (0.1, 1e4),
    "stiffness": (20.0, K_MAX),
    "damping_ratio": (0.3, 2.0),
    "forget": (1e-3, 0.5),
    "forget_less": (0.01, 1e3),
}
# Controller -> {parameter: (lowest, highest)}.
SPACES = {
    "adaptive": _MIXTURE,
    "porridge_adaptive": _MIXTURE,
    "mrac": _MRAC,
    "mrac_wide": _MRAC | _WIDE,
    "mrac_free": _MRAC | {"stiffness": (5.0, 1e5)},
    "porridge_mrac": _MRAC,
    "porridge_mrac_wide": _MRAC | _WIDE,
    "active_inference": _ACTIVE_INFERENCE,
    "active_inference_free": _ACTIVE_INFERENCE | {"stiffness": (5.0, 1e5)},
    "biomimetic": _BIOMIMETIC,
    "biomimetic_first": _BIOMIMETIC,
}


def config_of(name: str, p: dict[str, float]):
    """The configs of a controller with the parameters p."""
    if name.endswith("adaptive"):
        law = PlanarImpedanceConfig(
            stiffness_free=p["stiffness_free"],
            damping_ratio=p["damping_ratio"],
            steepness=p["steepness"],
            error_mid=p["error_mid"],
        )
        one = name == "porridge_adaptive"
        sigma = [p["sigma_v"]] * (1 if one else 2)
        sigma += [p["sigma_force"]] * (2 if one else 4)
        mixture = IgmmConfig(sigma_ini=sigma, tau_nov=p["tau_nov"], sp_max=p["sp_max"])
        return law, ForceModelConfig(mixture, one, 0.005 if one else 0.001)
    if "mrac" in name:
        p2, p3 = error_weights(p["omega"], p["zeta"], p["rate_weight"])
        alpha = p["stiffness"] / p2
        now = np.array([alpha, p["position_now"], p["velocity_now"]])
        if name != "mrac_free":
            # What multiplies q at once, at most: K0 x, Q0 x_m, K1 v and Q1 v_m too.
            most = now @ [1.0, 2.0 * X_MAX**2, 2.0 * V_MAX**2]
            now *= min(1.0, K_MAX / (p2 * most), D_MAX / (p3 * most))
        return MracConfig(
            p["omega"],
            p["zeta"],
            p["rate_weight"],
            [float(now[0]), float(now[0]) * p["integral_rate"]],
            [float(now[1]), p["position_summed"]],
            [float(now[2]), p["velocity_summed"]],
        )
    if name.startswith("active_inference"):
        variance = [p[f"variance_{key}"] for key in ("velocity", "belief", "rate")]
        k_action = p["stiffness"] * p["variance_velocity"]
        return ActiveInferenceConfig([1.0, *variance], p["k_belief"], k_action)
    return BiomimeticConfig(
        p["kappa"],
        [p["rate_force"], p["rate_stiffness"], p["rate_damping"]],
        p["stiffness"],
        2.0 * p["damping_ratio"] * float(np.sqrt(p["stiffness"] * MASS)),
        p["forget"],
        p["forget_less"],
    )


@dataclass(frozen=True)
class Task:
    """A world and a circle of one seed, as the compiled loops take them."""

    world: tuple  # Of numerics.planar_world.step, after the mass.
    circle: tuple  # Of circle_target, after t.
    noise: float  # Of the force sensor [N].
    noise_seed: int


def task_of(seed: int, stirring: bool = False, training: bool = False) -> Task:
    """Springs, or porridge (in training or in the test), with the default settings."""
    if stirring:
        config = porridge.PorridgeConfig(seed=seed)
        world, target, noise_seed = porridge.draw(config, training)
        noise = config.force_noise
    else:
        task = multi_spring.MultiSpringConfig(seed=seed)
        world, target = multi_spring.draw(task)
        noise, noise_seed = task.force_noise, task.seed
    springs = np.column_stack([world.stiffness, world.rest_length]).reshape(-1, 2)
    anchors = np.array(world.anchors, dtype=float).reshape(-1, 2)
    circle = (target.radius, target.duration_sec, target.phase, float(target.turn))
    arrays = (np.array(world.viscosity), float(world.ramp_sec), anchors, springs)
    return Task(arrays, circle, noise, noise_seed)


def _start(task: Task):
    state = np.zeros(4)
    state[0] = task.circle[0] * np.cos(task.circle[2])
    state[1] = task.circle[0] * np.sin(task.circle[2])
    return state


@njit(cache=True)
def _squared_error(state, k, circle):
    """At the end of tick k, every fifth; else 0 [m2]."""
    if (k + 1) % _EVERY != 0:
        return 0.0
    t = (k + 1) * PERIOD
    goal = circle_target(t, circle[0], circle[1], circle[2], circle[3])
    return (state[0] - goal[0]) ** 2 + (state[1] - goal[1]) ** 2


@njit(cache=True)
def _world_step(state, k, u, w):
    return step(state, k * PERIOD, u, PERIOD, MASS, w[0], w[1], w[2], w[3])


@njit(cache=True)
def _biomimetic_trial(force, stiffness, damping, fixed, every, circle, state, world):
    """e, de/dt at each time step, and the RMS error."""
    n = round(circle[1] / PERIOD)
    errors, total = np.empty((force.shape[0], 4)), 0.0
    for k in range(n):
        target = circle_target(k * PERIOD, circle[0], circle[1], circle[2], circle[3])
        j = min(k // every, force.shape[0] - 1)
        if k % every == 0:
            errors[j] = state - target[:4]
        u, _ = force_command(
            state, target, force[j], stiffness[j], damping[j], fixed, MASS, FORCE_MAX
        )
        state = _world_step(state, k, u, world)
        total += _squared_error(state, k, circle)
    return errors, np.sqrt(total / (n // _EVERY))


@njit(cache=True)
def _mrac_trial(omega, zeta, p2, p3, gains, circle, state, world):
    n = round(circle[1] / PERIOD)
    memory, held, total = np.zeros(mrac.MEMORY), np.zeros(2), 0.0
    for k in range(n):
        target = circle_target(k * PERIOD, circle[0], circle[1], circle[2], circle[3])
        u, after, _ = mrac.tick(
            memory,
            state,
            target,
            omega,
            zeta,
            p2,
            p3,
            gains,
            False,
            PERIOD,
            FORCE_MAX,
        )
        if np.isfinite(u.sum()) and np.isfinite(after.sum()):
            memory, held = after, u
        state = _world_step(state, k, held, world)
        total += _squared_error(state, k, circle)
    return np.sqrt(total / (n // _EVERY))


@njit(cache=True)
def _active_inference_trial(precision, k_belief, k_action, circle, state, world):
    n = round(circle[1] / PERIOD)
    memory, total = np.zeros(active_inference.MEMORY), 0.0
    for k in range(n):
        target = circle_target(k * PERIOD, circle[0], circle[1], circle[2], circle[3])
        _, after, _ = active_inference.tick(
            memory,
            state,
            target[:2],
            precision,
            k_belief,
            k_action,
            PERIOD,
            FORCE_MAX,
        )
        if np.isfinite(after.sum()):
            memory = after
        state = _world_step(state, k, memory[6:8], world)
        total += _squared_error(state, k, circle)
    return np.sqrt(total / (n // _EVERY))


def mrac_error(config: MracConfig, task: Task) -> float:
    """RMS tracking error of a trial [m]."""
    p2, p3 = error_weights(config.omega, config.zeta, config.rate_weight)
    gains = np.array(
        config.force_gains + config.position_gains + config.velocity_gains, dtype=float
    )
    omega, zeta, start = config.omega, config.zeta, _start(task)
    return float(
        _mrac_trial(omega, zeta, p2, p3, gains, task.circle, start, task.world)
    )


def active_inference_error(config: ActiveInferenceConfig, task: Task) -> float:
    """RMS tracking error of a trial [m]."""
    law = (1.0 / np.array(config.variance), config.k_belief, config.k_action)
    return float(_active_inference_trial(*law, task.circle, _start(task), task.world))


def learning_curve(config: BiomimeticConfig, task: Task, trials: int) -> list[float]:
    """RMS tracking error of each trial [m]."""
    gains = no_gains(round(task.circle[1] / config.step_sec))
    fixed = np.array([config.stiffness, config.damping])
    every, curve = round(config.step_sec / PERIOD), []
    for _ in range(trials):
        learned = (gains.force, gains.stiffness, gains.damping)
        errors, rms = _biomimetic_trial(
            *learned, fixed, every, task.circle, _start(task), task.world
        )
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
    task: Task,
    knowledge: Mixture | None = None,
) -> tuple[float, Mixture]:
    """RMS tracking error of a trial [m], and what the model knows after it."""
    tuning, along = igmm_tuning(config.mixture), config.along_motion
    model = new_model(tuning, knowledge, along)
    state, total, every = _start(task), 0.0, round(config.period_sec / PERIOD)
    n, std = round(task.circle[1] / PERIOD), np.full(2, task.noise)
    for k in range(n):
        if k % every == 0:
            F = external_force(state, k * PERIOD, *task.world)
            F = add_noise(F, std, task.noise_seed, k)
            model = after_sample(model, tuning, state, F, along, law.learn)
            lam = 0.0
            if law.adapt:
                lam = trust(model.filtered, law.steepness, law.error_mid)
            K = stiffness_of(lam, law.stiffness_free, law.stiffness_max)
        u = impedance_command(
            state,
            circle_target(k * PERIOD, *task.circle),
            lam,
            K,
            predicted_force(model, state, along),
            MASS,
            law.damping_ratio,
            FORCE_MAX,
        )
        state = _world_step(state, k, u, task.world)
        total += _squared_error(state, k, task.circle)
    return float(np.sqrt(total / (n // _EVERY))), model.mixture


def rms_of(name: str, config, seed: int) -> float:
    """The score of one setting on one seed [m]."""
    task = task_of(seed, stirring=name.startswith("porridge"))
    if name.startswith("biomimetic"):
        return learning_curve(config, task, 1 if name.endswith("first") else TRIALS)[-1]
    if name.startswith("active_inference"):
        return active_inference_error(config, task)
    if "mrac" in name:
        return mrac_error(config, task)
    law, model = config
    known = None
    if name.startswith("porridge"):
        stiff, training = replace(law, adapt=False), task_of(seed, True, True)
        known = adaptive_error(stiff, model, training)[1]
    return adaptive_error(law, model, task, known)[0]


def tune(name: str, scale: float = 1.0) -> dict:
    """The best setting of a controller; scale shrinks the budget, to try it out."""
    space = SPACES[name]
    low, high = np.log([list(pair) for pair in space.values()]).T
    rng = np.random.default_rng(0)

    def parameters(z) -> dict[str, float]:
        values = np.exp(low + z * (high - low))
        return {k: float(f"{v:.3g}") for k, v in zip(space, values, strict=True)}

    def score(z, seeds) -> np.ndarray:
        config = config_of(name, parameters(z))
        return np.array([rms_of(name, config, seed) for seed in seeds])

    tried: list[tuple[float, np.ndarray]] = []
    n_random, n_around = round(RANDOM * scale), round(AROUND * scale)
    for i in tqdm(range(n_random + n_around), desc=name, mininterval=10.0):
        z = rng.uniform(size=len(space))
        if i >= n_random:
            best = min(tried, key=lambda pair: pair[0])[1]
            z = np.clip(best + 0.08 * rng.normal(size=len(space)), 0.0, 1.0)
        tried.append((float(score(z, SEARCH_SEEDS).mean()), z))
    tried.sort(key=lambda pair: pair[0])
    finals = [(score(z, FINAL_SEEDS), z) for _, z in tried[:FINALISTS]]
    scores, z = min(finals, key=lambda pair: float(np.median(pair[0])))
    config = config_of(name, parameters(z))
    parts = config if isinstance(config, tuple) else (config,)
    return {
        "controller": name,
        "parameters": parameters(z),
        "at_bound": [k for k, v in zip(space, z, strict=True) if not 0.01 < v < 0.99],
        "median_rms_m": float(np.median(scores)),
        "worst_rms_m": float(scores.max()),
        "trials": len(tried) * len(SEARCH_SEEDS) + FINALISTS * len(FINAL_SEEDS),
        "settings_above_quarter_metre": sum(s > 0.25 for s, _ in tried),
        "config": [asdict(part) for part in parts],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("controllers", nargs="*", help=", ".join(SPACES))
    parser.add_argument("--scale", type=float, default=1.0, help="of the budget")
    parser.add_argument("--out", type=Path, help="JSON, one entry per controller")
    arguments = parser.parse_args()
    unknown = set(arguments.controllers) - set(SPACES)
    if unknown:
        parser.error(f"{sorted(unknown)}, expected some of {', '.join(SPACES)}")
    found = []
    for name in arguments.controllers or SPACES:
        found.append(tune(name, arguments.scale))
        print(json.dumps(found[-1], indent=2), flush=True)
        if arguments.out:
            arguments.out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()

"""Tunes every controller of the planar experiments with one and the same budget.

    python -m makebreak.scripts.tune_planar [CONTROLLER ...] [--scale S] [--out FILE]

Random search: 200 settings drawn log-uniformly, then 100 drawn around the best one so
far, each tried on seeds 100 to 102 and scored by the mean RMS tracking error; the best
five are tried on seeds 100 to 113, and the one with the least median wins. A trial of
the biomimetic controller is a whole learning run of 30 trials, scored by the last.

No setting may have more proportional stiffness than the adaptive controller's
stiffness_max; `mrac_free` shows what MRAC does without that bound. What was found is in
docs/planar.md and is the default of diagrams/multi_spring.py and porridge.py.
"""

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numba import njit
from pydrake.systems.analysis import Simulator
from tqdm import tqdm

from makebreak.diagrams import multi_spring, porridge
from makebreak.diagrams.planar import FORCE_MAX, MASS, PERIOD, knowledge_of
from makebreak.systems.baselines.active_inference import ActiveInferenceConfig
from makebreak.systems.baselines.biomimetic import BiomimeticConfig
from makebreak.systems.baselines.mrac import MracConfig
from makebreak.systems.numerics.biomimetic import after_trial, force_command, no_gains
from makebreak.systems.numerics.igmm import IgmmConfig
from makebreak.systems.numerics.mrac import error_weights
from makebreak.systems.numerics.planar_world import circle_target, step
from makebreak.systems.planar_impedance import ForceModelConfig, PlanarImpedanceConfig

SEARCH_SEEDS, FINAL_SEEDS = (100, 101, 102), tuple(range(100, 114))
RANDOM, AROUND, FINALISTS = 200, 100, 5
DURATION, SAMPLE = 6.0, 0.005  # [s]
K_MAX = PlanarImpedanceConfig().stiffness_max
TRIALS = 30

_MIXTURE = {
    "sigma_v": (0.01, 0.5),
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
    "stiffness": (5.0, K_MAX),
    "integral_rate": (0.1, 30.0),
    "position_now": (0.01, 1e4),
    "position_summed": (0.01, 1e4),
    "velocity_now": (0.01, 1e4),
    "velocity_summed": (0.01, 1e4),
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
    "mrac_free": _MRAC | {"stiffness": (5.0, 1e5)},
    "porridge_mrac": _MRAC,
    "active_inference": {
        "variance_velocity": (0.1, 100.0),
        "variance_belief": (0.01, 100.0),
        "variance_rate": (0.01, 100.0),
        "k_belief": (1.0, 200.0),
        "k_action": (10.0, 1e5),
    },
    "biomimetic": _BIOMIMETIC,
    "biomimetic_first": _BIOMIMETIC,
}


def config_of(name: str, p: dict[str, float]):
    """The configs of a controller with the parameters p."""
    if name.endswith("adaptive"):
        law = PlanarImpedanceConfig(
            damping_ratio=p["damping_ratio"],
            steepness=p["steepness"],
            error_mid=p["error_mid"],
        )
        one = name == "porridge_adaptive"
        sigma = [p["sigma_v"]] * (1 if one else 2)
        sigma += [p["sigma_force"]] * (2 if one else 4)
        mixture = IgmmConfig(sigma_ini=sigma, tau_nov=p["tau_nov"], sp_max=p["sp_max"])
        return law, ForceModelConfig(mixture, along_motion=one)
    if "mrac" in name:
        alpha = p["stiffness"] / error_weights(p["omega"], p["zeta"])[0]
        return MracConfig(
            p["omega"],
            p["zeta"],
            [alpha, alpha * p["integral_rate"]],
            [p["position_now"], p["position_summed"]],
            [p["velocity_now"], p["velocity_summed"]],
        )
    if name == "active_inference":
        variance = [p[f"variance_{key}"] for key in ("velocity", "belief", "rate")]
        return ActiveInferenceConfig([1.0, *variance], p["k_belief"], p["k_action"])
    return BiomimeticConfig(
        p["kappa"],
        [p["rate_force"], p["rate_stiffness"], p["rate_damping"]],
        p["stiffness"],
        2.0 * p["damping_ratio"] * float(np.sqrt(p["stiffness"] * MASS)),
        p["forget"],
        p["forget_less"],
    )


def tracked(diagram) -> tuple[float, object]:
    """RMS tracking error of one trial [m], and what the controller learned."""
    simulator = Simulator(diagram)
    context = simulator.get_context()
    state, target = (diagram.GetOutputPort(name) for name in ("state", "x_desired"))
    total = 0.0
    n = round(DURATION / SAMPLE)
    for k in range(1, n + 1):
        simulator.AdvanceTo(k * SAMPLE)
        total += np.sum((state.Eval(context)[:2] - target.Eval(context)[:2]) ** 2)
    controller = diagram.GetSubsystemByName("controller")
    learns = hasattr(controller, "knowledge")
    return float(np.sqrt(total / n)), knowledge_of(diagram, context) if learns else None


@njit(cache=True)
def _trial(force, stiffness, damping, fixed, every, circle, first, world):
    """One trial of the biomimetic controller, and e, de/dt at each time step. It is the
    diagram's, tick for tick."""
    n = round(circle[1] / PERIOD)
    errors = np.empty((force.shape[0], 4))
    state, total = first, 0.0
    for k in range(n):
        target = circle_target(k * PERIOD, circle[0], circle[1], circle[2], circle[3])
        j = min(k // every, force.shape[0] - 1)
        if k % every == 0:
            errors[j] = state - target[:4]
        u, _ = force_command(
            state, target, force[j], stiffness[j], damping[j], fixed, MASS, FORCE_MAX
        )
        state = step(
            state, k * PERIOD, u, PERIOD, MASS, world[0], world[1], world[2], world[3]
        )
        if (k + 1) % 5 == 0:
            goal = circle_target(
                (k + 1) * PERIOD, circle[0], circle[1], circle[2], circle[3]
            )
            total += (state[0] - goal[0]) ** 2 + (state[1] - goal[1]) ** 2
    return errors, np.sqrt(total / (n // 5))


def learning_curve(config: BiomimeticConfig, seed: int, trials: int) -> list[float]:
    """RMS tracking error of each trial [m]."""
    world, target = multi_spring.draw(multi_spring.MultiSpringConfig(seed=seed))
    circle = (target.radius, target.duration_sec, target.phase, float(target.turn))
    first = circle_target(0.0, *circle)[:4].copy()
    springs = np.column_stack([world.stiffness, world.rest_length])
    arrays = (np.array(world.viscosity), 6.0, np.array(world.anchors), springs)
    gains = no_gains(round(DURATION / config.step_sec))
    curve = []
    for _ in range(trials):
        errors, rms = _trial(
            gains.force,
            gains.stiffness,
            gains.damping,
            np.array([config.stiffness, config.damping]),
            round(config.step_sec / PERIOD),
            circle,
            first,
            arrays,
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


def rms_of(name: str, config, seed: int) -> float:
    """The score of one setting on one seed [m]."""
    if name.startswith("biomimetic"):
        return learning_curve(config, seed, 1 if name.endswith("first") else TRIALS)[-1]
    if name.startswith("porridge"):
        stirring = porridge.PorridgeConfig(seed=seed)
        if name == "porridge_mrac":
            controller = multi_spring.mrac(config)
            return tracked(porridge.make_porridge(stirring, controller))[0]
        law, model = config
        trainer = multi_spring.impedance(replace(law, adapt=False), model)
        _, known = tracked(porridge.make_porridge(stirring, trainer, training=True))
        controller = multi_spring.impedance(law, model, known)
        return tracked(porridge.make_porridge(stirring, controller))[0]
    task = multi_spring.MultiSpringConfig(seed=seed)
    if name == "adaptive":
        controller = multi_spring.impedance(*config)
    elif name == "active_inference":
        controller = multi_spring.active_inference(config)
    else:
        controller = multi_spring.mrac(config)
    return tracked(multi_spring.make_multi_spring(task, controller))[0]


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

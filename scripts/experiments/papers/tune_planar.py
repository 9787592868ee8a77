"""Tunes the controllers of the planar experiments by random search.

    python -m makebreak.scripts.experiments.papers.tune_planar \
        SETTING [CONTROLLER ...] [--scale S]

A setting is a world with its sensors and the greatest stiffness (SETTINGS). Parameters
of a controller are drawn log-uniformly, then as many more around the best ones so far,
ever closer. Each is tried on seeds 100 to 102 and scored by the mean RMS tracking
error; the best five are tried on seeds 100 to 113, and the one with the least median
wins. 160 are tried for the adaptive controller, and 1200 for MRAC and active inference,
whose trials are quick. For the biomimetic one 160 are tried, each in a learning run of
30 trials, which is scored by the last. The result goes to diagrams/planar_tuned.json,
which the experiments read.

The ranges are so wide that the optimum is inside, apart from bounds that all
controllers share: proportional stiffness is at most stiffness_max, and proportional
damping at most twice critical at that stiffness, as otherwise high gain would replace
adaptation. Active inference integrates the velocity error, k_a P_y' int de/dt dt, so
that this factor is its proportional stiffness.

"+force" marks a controller with feedforward of the measured force, which the adaptive
one has in its law. `measured_force` is the adaptive law without a model, whose
prediction is the last measured force.

Trials run as plain loops (planar_loops.py), without a diagram.
"""

import argparse
import json
from dataclasses import asdict, replace
from functools import cache

import numpy as np
from tqdm import tqdm

from makebreak.diagrams import multi_spring, porridge
from makebreak.diagrams.planar import MASS
from makebreak.diagrams.planar_tuned import SETTINGS, TUNED_FILE, Setting
from makebreak.scripts.experiments.papers.planar_loops import (
    PlanarTrial,
    active_inference_error,
    adaptive_error,
    learning_curve,
    mrac_error,
    trial_of,
)
from makebreak.systems.baselines.active_inference import ActiveInferenceConfig
from makebreak.systems.baselines.biomimetic import BiomimeticConfig
from makebreak.systems.baselines.mrac import MracConfig
from makebreak.systems.baselines.numerics.mrac import error_weights
from makebreak.systems.changing_contact.numerics.igmm import IgmmConfig
from makebreak.systems.planar.numerics.planar_impedance import persistence
from makebreak.systems.planar.planar_impedance import (
    ForceModelConfig,
    PlanarImpedanceConfig,
)

SEARCH_SEEDS, FINAL_SEEDS = (100, 101, 102), tuple(range(100, 114))
# Number of parameter sets tried for controllers with slow and with quick trials, half
# of them around the best; and of finalists.
SLOW, QUICK, FINALISTS = 160, 1200, 5
# Greatest |x| [m] and |v| [m/s] on the circle.
X_MAX, V_MAX = 0.25, 0.49
TRIALS = 30
FAST = 2.0 / 3.0  # Duration of the fast trials with springs, over the usual one.
FORCE = "+force"


def spaces(setting: Setting) -> dict[str, dict[str, tuple[float, float]]]:
    """{controller: {parameter: (lowest, highest)}}."""
    K = setting.stiffness_max
    law = {
        "stiffness_free": (0.02 * K, 0.22 * K),  # Compliant, as is compared here.
        "damping_ratio": (0.1, 4.0),
        "steepness": (1.0, 100.0),
        "error_mid": (0.1, 20.0),
    }
    mixture = {
        "sigma_v": (0.0003, 1.0),
        "sigma_force": (0.05, 20.0),
        "tau_nov": (1e-12, 0.3),
        "sp_max": (5.0, 1e5),
        "model_ticks": (0.6, 20.0),
    }
    mrac = {
        "omega": (0.1, 100.0),
        "zeta": (0.05, 10.0),
        "rate_weight": (1e-5, 100.0),
        "stiffness": (0.01 * K, K),
        "integral_rate": (0.01, 1e5),
        "position_now": (1e-4, 1e9),
        "position_summed": (1e-3, 1e14),
        "velocity_now": (1e-4, 1e9),
        "velocity_summed": (1e-3, 1e14),
    }
    active = {
        "variance_velocity": (1e-6, 1e9),
        "variance_belief": (1e-6, 1e10),
        "variance_rate": (1e-6, 1e10),
        "k_belief": (1e-3, 1e5),
        "stiffness": (0.01 * K, K),  # k_a / variance_velocity.
    }
    biomimetic = {
        "kappa": (0.1, 300.0),
        "rate_force": (1e-2, 1e5),
        "rate_stiffness": (1e-3, 1e7),
        "rate_damping": (1e-3, 1e6),
        "stiffness": (0.01 * K, K),
        "damping_ratio": (0.1, 10.0),
        "forget": (1e-6, 0.9),
        "forget_less": (1e-3, 1e5),
    }
    found = {"adaptive": law | mixture, "measured_force": law}
    if setting.world == "engaging":
        found["adaptive_position"] = law | mixture | {"sigma_p": (0.0003, 0.3)}
    found |= {"mrac": mrac, "active_inference": active, "biomimetic": biomimetic}
    others = ("mrac", "active_inference", "biomimetic")
    found |= {f"{name}{FORCE}": found[name] for name in others}
    if setting == SETTINGS["springs"]:
        found["active_inference_fixed_goal"] = active
    if setting.world == "porridge":
        found = {"mrac": mrac, f"mrac{FORCE}": mrac}
    return found


def config_of(name: str, p: dict[str, float], setting: Setting):
    """The config (or both configs) of a controller with the parameters p."""
    name, K_max = name.removesuffix(FORCE), setting.stiffness_max
    if name in ("adaptive", "adaptive_position", "measured_force"):
        law = PlanarImpedanceConfig(
            stiffness_free=p["stiffness_free"],
            stiffness_max=K_max,
            damping_ratio=p["damping_ratio"],
            steepness=p["steepness"],
            error_mid=p["error_mid"],
        )
        # Damping at most that of the others at the greatest stiffness.
        critical = 2.0 * float(np.sqrt(K_max * MASS))
        ratio = min(law.damping_ratio, setting.damping_max / critical)
        law = replace(law, damping_ratio=ratio)
        if name == "measured_force":
            law = replace(law, learn=False)
            return law, ForceModelConfig(IgmmConfig(6 * [1.0]), False, 0.001)
        position = name == "adaptive_position"
        sigma = 2 * [p["sigma_p"]] if position else []
        sigma += 2 * [p["sigma_v"]] + 4 * [p["sigma_force"]]
        mixture = IgmmConfig(sigma_ini=sigma, tau_nov=p["tau_nov"], sp_max=p["sp_max"])
        period = 0.001 * max(round(p["model_ticks"]), 1)
        return law, ForceModelConfig(mixture, False, period, position)
    if name.startswith("mrac"):
        p2, p3 = error_weights(p["omega"], p["zeta"], p["rate_weight"])
        alpha = p["stiffness"] / p2
        now = np.array([alpha, p["position_now"], p["velocity_now"]])
        # The greatest gain on q at any time, of K0 x, Q0 x_m, K1 v and Q1 v_m.
        most = now @ [1.0, 2.0 * X_MAX**2, 2.0 * V_MAX**2]
        now *= min(1.0, K_max / (p2 * most), setting.damping_max / (p3 * most))
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
        moves = not name.endswith("fixed_goal")
        return ActiveInferenceConfig([1.0, *variance], p["k_belief"], k_action, moves)
    damping = 2.0 * p["damping_ratio"] * float(np.sqrt(p["stiffness"] * MASS))
    return BiomimeticConfig(
        p["kappa"],
        [p["rate_force"], p["rate_stiffness"], p["rate_damping"]],
        p["stiffness"],
        min(damping, setting.damping_max),
        p["forget"],
        p["forget_less"],
    )


@cache
def task_of(setting: Setting, seed: int, training: bool = False) -> PlanarTrial:
    """The seed's world: springs, or porridge (in training or in the test)."""
    if setting.world == "porridge":
        # With the default MRAC, as the tuned one may not exist yet.
        stirred = porridge.PorridgeConfig(seed=seed, mrac=MracConfig())
        world, target, noise_seed = porridge.draw(stirred, training)
        return trial_of(world, target, setting.sensing, noise_seed)
    world, target = multi_spring.draw_springs(
        seed, engaging=setting.world == "engaging"
    )
    return trial_of(world, target, setting.sensing, seed)


@cache
def path_again(setting: Setting, seed: int, trials: int) -> tuple[PlanarTrial, ...]:
    """A number of trials in the seed's world, each with its own noise; with springs,
    every second one is faster."""
    world, target = multi_spring.draw_springs(
        seed, engaging=setting.world == "engaging"
    )
    quick = replace(target, duration_sec=FAST * target.duration_sec)
    targets = [target, quick if setting.world == "engaging" else target]
    return tuple(
        trial_of(world, targets[i % 2], setting.sensing, seed + 1000 * i)
        for i in range(trials)
    )


def errors_of(name: str, config, setting: Setting, seed: int, trials: int):
    """RMS tracking errors of a number of trials on one path [m]; controllers that learn
    between trials keep their gains."""
    each, force = path_again(setting, seed, trials), name.endswith(FORCE)
    if name.startswith("biomimetic"):
        return learning_curve(config, each, force)
    if name.startswith("active_inference"):
        return [active_inference_error(config, trial, force) for trial in each]
    if name.startswith("mrac"):
        return [mrac_error(config, trial, force) for trial in each]
    (law, model), found, known = config, [], None
    if name == "measured_force":
        known = persistence(4, 2)
    for trial in each:
        error, after = adaptive_error(law, model, trial, known)
        known = after if law.learn else known
        found.append(error)
    return found


def rms_of(name: str, config, setting: Setting, seed: int) -> float:
    """The score of one parameter set on one seed: RMS tracking error [m].

    With springs that of the fifth and the sixth trial, one at each speed (for the
    biomimetic controller the last two); else that of the first trial (for the
    biomimetic one the last).
    """
    if setting.world == "engaging":
        n = TRIALS if name.startswith("biomimetic") else 6
        if name.startswith(("mrac", "active_inference", "measured_force")):
            n = 2  # They do not learn between trials.
        errors = errors_of(name, config, setting, seed, n)[-2:]
        return float(np.sqrt(np.mean(np.square(errors))))
    if setting.world == "porridge":
        return mrac_error(config, task_of(setting, seed), name.endswith(FORCE))
    n = TRIALS if name.removesuffix(FORCE) == "biomimetic" else 1
    return errors_of(name, config, setting, seed, n)[-1]


def tune(name: str, setting: Setting, scale: float = 1.0) -> dict:
    """The best parameters of a controller; scale: of the budget, below 1 for tests."""
    space = spaces(setting)[name]
    low, high = np.log([list(pair) for pair in space.values()]).T
    rng = np.random.default_rng(0)

    def parameters(z) -> dict[str, float]:
        values = np.exp(low + z * (high - low))
        return {k: float(f"{v:.3g}") for k, v in zip(space, values, strict=True)}

    def score(z, seeds) -> np.ndarray:
        config = config_of(name, parameters(z), setting)
        rms = np.array([rms_of(name, config, setting, seed) for seed in seeds])
        return np.where(np.isfinite(rms), rms, np.inf)

    tried: list[tuple[float, np.ndarray]] = []
    quick = name.startswith(("mrac", "active_inference"))
    half = round(0.5 * scale * (QUICK if quick else SLOW))
    for i in tqdm(range(2 * half), desc=name, mininterval=10.0):
        z = rng.uniform(size=len(space))
        if i >= half:
            best = min(tried, key=lambda pair: pair[0])[1]
            width = 0.15 * 0.1 ** ((i - half) / half)
            z = np.clip(best + width * rng.normal(size=len(space)), 0.0, 1.0)
        tried.append((float(score(z, SEARCH_SEEDS).mean()), z))
    tried.sort(key=lambda pair: pair[0])
    finals = [(score(z, FINAL_SEEDS), z) for _, z in tried[:FINALISTS]]
    scores, z = min(finals, key=lambda pair: float(np.median(pair[0])))
    config = config_of(name, parameters(z), setting)
    parts = config if isinstance(config, tuple) else (config,)
    return {
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
    parser.add_argument("setting", choices=SETTINGS)
    parser.add_argument("controllers", nargs="*", help="all, if none is named")
    parser.add_argument("--scale", type=float, default=1.0, help="of the budget")
    arguments = parser.parse_args()
    setting = SETTINGS[arguments.setting]
    names = list(spaces(setting))
    unknown = set(arguments.controllers) - set(names)
    if unknown:
        parser.error(f"{sorted(unknown)}, expected some of {', '.join(names)}")
    for name in arguments.controllers or names:
        found = tune(name, setting, arguments.scale)
        print(name, json.dumps(found, indent=2), flush=True)
        known = json.loads(TUNED_FILE.read_text()) if TUNED_FILE.is_file() else {}
        known.setdefault(arguments.setting, {})[name] = found
        TUNED_FILE.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()

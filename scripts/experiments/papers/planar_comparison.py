"""Compares all tuned controllers on springs, in every setting of tune_planar.py, over
many seeds. Trials are plain loops, which are equal to the diagrams tick for tick."""

import numpy as np

from makebreak.diagrams.planar_tuned import (
    SETTINGS,
    Setting,
    tuned_active_inference,
    tuned_biomimetic,
    tuned_impedance,
    tuned_mrac,
)
from makebreak.scripts.experiments.papers.tune_planar import FORCE, TRIALS, errors_of

OUR_TRIALS = 6  # Number of trials of all controllers but the biomimetic one.


def compare(seeds: int) -> dict[str, dict[str, list[float]]]:
    """{setting: {controller: [RMS tracking error of each seed] [m]}}, ours first."""
    springs = {n: s for n, s in SETTINGS.items() if s.world != "porridge"}
    found: dict[str, dict[str, list[float]]] = {}
    for name, setting in springs.items():
        each = [errors_in(name, setting, seed) for seed in range(seeds)]
        found[name] = {key: [one[key] for one in each] for key in each[0]}
    return found


def errors_in(name: str, setting: Setting, seed: int) -> dict[str, float]:
    """{controller: RMS tracking error [m]} of one seed.

    "first": of the first trial, at the usual speed; "later": of the last two trials
    together, which with springs are one at each speed.
    """

    def later(errors) -> float:
        return float(np.sqrt(np.mean(np.square(errors[-2:]))))

    found: dict[str, float] = {}
    ours = ["adaptive"]
    if setting.world == "engaging":
        ours.append("adaptive_position")
    for controller in [*ours, "measured_force"]:
        config = tuned_impedance(name, controller)
        errors = errors_of(controller, config, setting, seed, OUR_TRIALS)
        found[f"{controller}, trial 1"] = errors[0]
        found[f"{controller}, trials 5 and 6"] = later(errors)
    for force in ("", FORCE):
        known: dict[str, object] = {
            f"mrac{force}": tuned_mrac(name, f"mrac{force}"),
            f"active_inference{force}": tuned_active_inference(
                name, f"active_inference{force}"
            ),
        }
        for controller, its_config in known.items():
            errors = errors_of(controller, its_config, setting, seed, 2)
            found[f"{controller}, trial 1"] = errors[0]
            if setting.world == "engaging":
                found[f"{controller}, both speeds"] = later(errors)
        bac = tuned_biomimetic(name, f"biomimetic{force}")
        errors = errors_of(f"biomimetic{force}", bac, setting, seed, TRIALS)
        found[f"biomimetic{force}, trial 1"] = errors[0]
        found[f"biomimetic{force}, last two of {TRIALS}"] = later(errors)
    return found

"""Scores of `wall_friction`, and the names of what is compared."""

import numpy as np

from makebreak.diagrams.wall_friction import TIMES

VARIED = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]
# name -> frictions of the wall, stiff controller, figure.
SETS = {
    "same": ([0.6], False, "11a"),
    "varied": (VARIED, False, "11b"),
    "stiff": (VARIED, True, "12"),
}
# One step ahead: name -> whether the GPs' output is the change of force.
ONE_STEP = {"one_step": False, "one_step_change": True}
# What is fed forward: name -> in words.
FED = {
    "none": "nothing",
    "last": "the last force",
    "one_step": "GP of the next force",
    "one_step_change": "GP of its change",
    "ours": "our forward models",
    "ours_from_scratch": "ours, from nothing",
}
Y = 1  # The axis along the wall.
NOISE = 0.1  # Of the force sensor [N].
CONTACT_FORCE = 3.0  # [N] of the wall, by which pictures mark the contact.
# Files of a run.
TIMES_FILE = "training_times.json"
EACH_FILE = "tested_trials.json"  # Scores of each tested trial; the result has means.


def along_the_wall(time) -> np.ndarray:
    """Which samples are of the way along the wall."""
    return (time >= TIMES[4]) & (time <= TIMES[5])


def rms(values) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def share_in_band(truth, mean, std) -> float:
    """Share of the samples that are within two standard deviations of the mean."""
    return float(np.mean(abs(truth - mean) <= 2.0 * std))


def contact_time(data) -> float:
    """When the wall is felt first [s]."""
    felt = (data["wrench"][:, 0] < -CONTACT_FORCE) & (data["time"] > TIMES[2])
    return float(data["time"][np.argmax(felt)])


def without_noise(error: float) -> float:
    """What is left of a prediction's rms error against a measured force when the
    sensor's noise, which is independent of the prediction, is taken out [N]."""
    return float(np.sqrt(max(error**2 - NOISE**2, 0.0)))

"""Closes the loop with changing contacts: trials with a wrong model, `makebreak gap` on
their recording, and a first trial with the repaired model.

    makebreak close-the-loop contact_learning --seed 0

The shipped scene is the model; in the simulated world walls are displaced, or surfaces
have other frictions, as the seed draws them. Before each run the motion is rehearsed in
the model, so that the first real trial shows the model's quality. Only the recording
and the scenes pass from one step to the next; the truth is used for the table alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from makebreak.diagrams import changing_surface, contact_learning, multiple_collisions
from makebreak.diagrams.tabletop import position
from makebreak.scripts.runner.close_the_loop import take_step, write_loop
from makebreak.scripts.runner.outputs import OutputFolder
from makebreak.scripts.runner.settings import apply_settings
from makebreak.scripts.runner.table import Table

# Goals: greatest error of displacements [m] and relative error of frictions; tracking
# error in the first trial after the repair over that before.
PLACE_M, FRICTION_SHARE = 5e-4, 0.05
ERROR_SHARE = 1 / 3
# Least and largest impact force in the first trial after the repair [N], as in each
# experiment: contact_learning wants 8 N; multiple_collisions at most 8, and aims at 7.
FORCES = {"contact_learning": (7.4, 8.6), "multiple_collisions": (0.0, 8.0)}
WALLS = ["spread=0.03", "stiffness=[8e4,8e4]", "rehearse=2"]
# Settings of both runs of each experiment.
SETTINGS: dict[str, list[str]] = {
    "contact_learning": WALLS,
    "multiple_collisions": ["tool=block", *WALLS],
    "changing_surface": ["baselines=false", "rehearse=1"],
}
TRIALS = {"contact_learning": (5, 1), "multiple_collisions": (4, 1)}
# Points of the plate at which the friction of each of three surfaces is compared [m].
PROBES = ((0.45, -0.08), (0.45, 0.08), (0.57, 0.0))
MODULES: dict[str, Any] = {
    "contact_learning": contact_learning,
    "multiple_collisions": multiple_collisions,
    "changing_surface": changing_surface,
}
CONFIGS: dict[str, Any] = {
    "contact_learning": contact_learning.ContactLearningConfig,
    "multiple_collisions": multiple_collisions.MultipleCollisionsConfig,
    "changing_surface": changing_surface.ChangingSurfaceConfig,
}
AXES = "xyz"


def close_contact_loop(
    experiment: str, out: Path, seed: int, settings: Sequence[str] = (), jobs: int = 1
) -> Table:
    """Runs all three steps, each in a subfolder of `out`, and writes loop.json and
    result.json.

    Args: experiment: a key of SETTINGS; others as in close_the_loop.
    Raises: as close_the_loop.
    """
    command = f"close-the-loop {experiment}"
    with OutputFolder(out, command) as outputs:
        words = [*SETTINGS[experiment], *settings]
        config = apply_settings(CONFIGS[experiment](), words)
        task = MODULES[experiment].make_task(replace(config, seed=seed))

        def run(folder: str, says: str, trials: int, *more: str) -> dict:
            own = [f"trials={trials}"] if trials else []
            return take_step(
                out, folder, says, "run", experiment, "--no-meshcat", "--seed",
                str(seed), *more, "--set", *words, *own,
            )  # fmt: skip

        first_trials, later = TRIALS.get(experiment, (0, 0))
        first = run("1_wrong_model", "Trials with the shipped model", first_trials)
        model, recording = (
            out / "1_wrong_model" / name for name in ("model.yaml", "recording.csv")
        )
        found = take_step(
            out, "2_gap", "gap, on what the robot recorded",
            "gap", str(model), str(recording), "--jobs", str(jobs),
        )  # fmt: skip
        scene = str(out / "2_gap" / "scene.yaml")
        says = "A trial with the repaired model"
        second = run("3_repaired_model", says, later, "--model", scene)
        rows: list[tuple] = [
            ("effects named", "", ", ".join(e["kind"] for e in found["effects"]), "")
        ]
        met: list[bool | None] = [None]

        def row(what, before, after, wanted="", good=None):
            rows.append((what, before, after, wanted))
            met.append(good)

        if experiment == "changing_surface":
            _frictions(row, task, found["effects"])
            key = "tracking_error_rms_m_adaptive"
            bound = ERROR_SHARE * first[key]
            row(key, first[key], second[key], f"<= {bound:.3g}", second[key] <= bound)
        else:
            _places(row, task, found["effects"])
            for key, before in first.items():
                if key.startswith(("impact_force_peak_N", "completion_time")):
                    _first_trial(row, key, before, second[key], FORCES[experiment])
        columns = ("result", "wrong model", "repaired model", "wanted")
        title = f"The loop closed: {experiment}, seed {seed}"
        table = Table(title, columns, rows, met, [found["says"]])
        results = {"first": first, "gap": found, "second": second}
        write_loop(outputs, table, results)
    return table


def _first_trial(row, key: str, before, after, forces: tuple[float, float]) -> None:
    """Adds rows for a result of the first trial, or of each of its impacts.

    Args: forces: the least and the largest impact force that are wanted [N].
    """
    a, b = (np.atleast_1d(np.array(x, dtype=float)) for x in (before, after))
    if "contact" in key or "time" in key:
        a, b = a[:1], b[:1]
    text = [" ".join(f"{x:.2f}" for x in each) for each in (a, b)]
    if "force" not in key:
        row(f"{key}, first trial", *text)
        return
    least, most = forces
    wanted = f"{least:g} to {most:g}" if least else f"<= {most:g}"
    good = bool(np.all((b >= least) & (b <= most)))
    row(f"{key}, first trial", *text, wanted, good)


def _places(row, task, effects: Sequence[Mapping]) -> None:
    """Adds a row for the displacement of each surface along its normal."""
    for name, axis in (("table", 2), ("red_block", 1), ("blue_wall", 0)):
        off = float((position(task.world, name) - position(task.model, name))[axis])
        moved = displacement(effects, name, AXES[axis])
        good = abs(moved - off) <= PLACE_M
        wanted = f"{1e3 * off:.2f} +- {1e3 * PLACE_M:.1f}"
        row(
            f"{name}, displaced along {AXES[axis]} [mm]", 0.0, 1e3 * moved, wanted, good
        )


def displacement(effects: Sequence[Mapping], model: str, axis: str) -> float:
    """Displacement of a model along an axis by the effects of a result [m]."""
    total = 0.0
    for effect in effects:
        names = {"wall_position": axis, "plane_height": "height" if axis == "z" else ""}
        name = names.get(effect["kind"])
        at = [effect["at"]] if isinstance(effect["at"], str) else effect["at"]
        if name and any(each.split(".")[0] == model for each in at):
            total += effect["parameters"].get(name, {"value": 0.0})["value"]
    return total


def _frictions(row, task, effects: Sequence[Mapping]) -> None:
    for k, (place, truth) in enumerate(zip(PROBES, task.friction, strict=True)):
        mu = friction_at(effects, place, 0.3)
        good = abs(mu / truth - 1.0) <= FRICTION_SHARE
        what, wanted = f"friction of surface {k + 1}", f"{truth:.4f} +- 5 %"
        row(what, 0.3, mu, wanted, good)


def friction_at(effects: Sequence[Mapping], place, own: float) -> float:
    """The friction at a place (2,) [m] of a plate with the effects of a result: that of
    the last patch there, else of the pair, else `own`."""
    found = own
    for effect in effects:
        if effect["kind"] == "contact_friction":
            found = effect["parameters"]["friction"]["value"]
    for effect in effects:
        if effect["kind"] == "friction_patch":
            p = {name: each["value"] for name, each in effect["parameters"].items()}
            inside = p["x_min"] <= place[0] < p["x_max"]
            if inside and p["y_min"] <= place[1] < p["y_max"]:
                found = p["friction"]
    return float(found)

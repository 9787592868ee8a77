"""A block on its face, its edge and its corner: contact modes by force and torque.

The block slides over one plate, six strokes of 8 cm: flat, on an edge, on a corner,
and all of that once more. The friction is the same in all of them, so |F_t|/R does not
distinguish them; |tau|/R does. A mode has to be found in each of the first three
strokes, and recognised in the others. Friction (0.1 to 0.6) and the sensors' noise
depend on the seed.

Criterion: the whole motion; in each stroke one mode, the right one: a new one the first
time, the same one the second time. (With only the mode at the stroke's end, as it was
set beforehand, a face that was two modes by turns went through.)

See docs/modes.md.
"""

import matplotlib.pyplot as plt
import numpy as np

from makebreak.diagrams.changing_contact import learned, telemetry
from makebreak.diagrams.contact_types import (
    TYPES,
    ContactTypesConfig,
    TypesTask,
    make_contact_types,
    make_task,
)
from makebreak.diagrams.recorder import recorded
from makebreak.scripts.experiments.runs.contact_runs import simulate_motion
from makebreak.scripts.runner.comparison import Comparison
from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.table import Table
from makebreak.systems.changing_contact.numerics.contact_task import (
    DONE,
    PHASE_SEGMENT,
    PHASE_STAGE,
)

SUMMARY = "a block slides on face, edge, corner: modes by force and torque (CC 3.2)"
Config = ContactTypesConfig
DURATION_SEC = 120.0  # At most.
BENCH: dict[str, dict] = {"contact_types": {}}
LAST_SEC = 0.3  # At the end of a stroke, over which the feature is averaged.


def run(config: ContactTypesConfig, session: Session) -> dict:
    """One motion, scored."""
    task = make_task(config)
    diagram = make_contact_types(config, task, session.meshcat)
    log = simulate_motion(session, diagram, DURATION_SEC, "")
    data = telemetry(log.diagram, log.context)
    known = learned(log.diagram, log.context)
    if known.modes is not None:
        known.modes.save(session.path("modes.json"))
    session.write_recording(recorded(log.diagram, log.context), task.model)
    arm = config.control.modes.torque_arm
    session.save_plot(plot_modes(data, task, arm), "modes")
    return summary(data, task, arm)


def strokes_of(log, task: TypesTask) -> list[dict]:
    """What each stroke that was begun gave.

    Returns: for each its type `kind`, `mode` at its end, how many `modes` it had, the
        `delay` from the touch to the first sample in the last one [s], and the
        `feature` without torque arm: |F_t|/R and |tau|/R [m], means over the last
        LAST_SEC.
    """
    time, segment = log["time"], log["phase"][:, PHASE_SEGMENT]
    mode = log["mode"][:, 0]
    R = np.maximum(log["wrench"][:, 2], 0.5)
    force = np.linalg.norm(log["wrench"][:, :2], axis=1) / R
    torque = np.linalg.norm(log["wrench"][:, 3:], axis=1) / R
    found = []
    for k, kind in task.strokes:
        rows = np.flatnonzero(segment == k)
        if not rows.size:
            continue
        # Until the motion stops: there is no feature at rest.
        moving = rows[np.any(log["direction"][rows] != 0.0, axis=1)]
        end = moving[-1] if moving.size else rows[-1]
        its = int(mode[end])
        had = rows[(mode[rows] == its) & (rows <= end)]
        modes = np.unique(mode[rows[rows <= end]])
        last = (time >= time[end] - LAST_SEC) & (time <= time[end])
        found.append(
            {
                "kind": kind,
                "mode": its,
                "modes": int(np.sum(modes >= 1)),
                "delay": float(time[had[0]] - time[rows[0]]) if its >= 1 else np.nan,
                "feature": (float(force[last].mean()), float(torque[last].mean())),
            }
        )
    return found


def right_modes(strokes: list[dict]) -> list[bool]:
    """Whether each stroke has one mode alone: that of its type's first stroke, which no
    other type has."""
    first: dict[str, int] = {}
    for one in strokes:
        first.setdefault(one["kind"], one["mode"])
    shared = list(first.values())
    return [
        one["mode"] >= 1
        and one["mode"] == first[one["kind"]]
        and shared.count(one["mode"]) == 1
        and one["modes"] == 1
        for one in strokes
    ]


def summary(log, task: TypesTask, arm: float) -> dict:
    """result.json."""
    strokes = strokes_of(log, task)
    right = right_modes(strokes)
    delays = [one["delay"] for one in strokes]
    result: dict = {
        "success": False,
        "friction": task.friction,
        "strokes": len(task.strokes),
        "strokes_right": sum(right),
        "modes_of_strokes": [one["mode"] for one in strokes],
        "modes_in_strokes": [one["modes"] for one in strokes],
        "delays_s": delays,
    }
    for i, name in enumerate(("force", "torque_arm")):
        unit = "_m" * i
        for kind in TYPES:
            values = [s["feature"][i] for s in strokes if s["kind"] == kind]
            result[f"{name}_{kind}{unit}"] = float(np.mean(values or [np.nan]))
    done = bool(np.any(log["phase"][:, PHASE_STAGE] == DONE))
    criteria = Criteria()
    criteria.holds("done", "the motion is carried out", done)
    criteria.at_least(
        "right", "strokes with the right mode", sum(right), len(task.strokes)
    )
    return result | criteria.result()


COLORS = {"face": "#86a57f", "edge": "#6f8fb8", "corner": "#b98b5e"}


def plot_modes(log, task: TypesTask, arm: float):
    """The feature and the mode over time; the strokes in the colours of their types."""
    figure, axes = plt.subplots(
        2, 1, figsize=(11, 6), sharex=True, layout="constrained"
    )
    time, segment = log["time"], log["phase"][:, PHASE_SEGMENT]
    R = np.maximum(log["wrench"][:, 2], 1.0)
    pressed = log["wrench"][:, 2] > 1.0
    keep = slice(None, None, 5)
    for signal, scale, label in (
        (log["wrench"][:, :2], 1.0, "|F_t| / R"),
        (log["wrench"][:, 3:], arm or 1.0, "|tau| / (R arm)"),
    ):
        value = np.where(pressed, np.linalg.norm(signal, axis=1) / (R * scale), np.nan)
        axes[0].plot(time[keep], value[keep], lw=0.7, label=label)
    axes[1].plot(time, log["mode"][:, 0], color="C0")
    named = set()
    for k, kind in task.strokes:
        for ax in axes:
            ax.fill_between(
                time, 0, 1, where=segment == k, color=COLORS[kind], alpha=0.3, lw=0,
                transform=ax.get_xaxis_transform(),
                label=None if kind in named or ax is axes[1] else kind,
            )  # fmt: skip
        named.add(kind)
    axes[0].set(ylabel="feature", ylim=(0, 1.0))
    axes[0].legend(loc="upper right", ncols=5)
    axes[1].set(ylabel="mode (-1: not known yet, 0: free)", xlabel="time [s]")
    return figure


VARIANTS: dict[str, dict] = {
    "force and torque": {},
    "force alone": {"control.modes.torque_arm": 0.0},
}


def reproduce(session: Session, seeds: int, jobs: int) -> Table:
    """Strokes with the right mode, with the torque in the feature and without."""
    comparison = Comparison("contact_types", session, jobs)
    for label, results in comparison.runs_of(VARIANTS, seeds).items():
        ended = [r for r in results if "strokes" in r]
        n = sum(r["strokes"] for r in ended)
        right = sum(r["strokes_right"] for r in ended)
        good = bool(n) and right == n and len(ended) == len(results)
        its = comparison.with_settings(VARIANTS[label])
        comparison.row(
            f"{label}: strokes with the right mode", "distinguished", f"{right} of {n}",
            good if label == "force and torque" else None, its,
        )  # fmt: skip
        if ended and label == "force and torque":
            for kind in TYPES:
                x = [1e3 * r[f"torque_arm_{kind}_m"] for r in ended]
                text = f"{min(x):.1f} to {max(x):.1f} mm"
                comparison.row(f"|tau|/R, {kind}", "-", text, None, its)
    return comparison.to_table(
        "Face, edge and corner (CC 3.2)",
        ["A mode is right if it is new in a type's first stroke, the same later on."],
    )

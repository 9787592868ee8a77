"""The trials of a motion with contacts: one without handling of contacts, then those
with it, each with what the one before has learned."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from makebreak.diagrams.changing_contact import Knowledge, learned, telemetry
from makebreak.diagrams.multiple_collisions import (
    CollisionTask,
    MultipleCollisionsConfig,
    make_multiple_collisions,
)
from makebreak.diagrams.recorder import episodes, recorded
from makebreak.scripts.experiments.papers.contact_plots import plot_path, plot_trials
from makebreak.scripts.experiments.runs.contact_runs import rehearsed, simulate_motion
from makebreak.scripts.runner.session import Session
from makebreak.systems.views.contact_view import ContactViewConfig


def run_trials(
    config: MultipleCollisionsConfig,
    task: CollisionTask,
    session: Session,
    duration: float,
    scored: Callable[..., Any],
) -> dict[str, Any]:
    """Simulates all trials and writes their plots, contacts and recording.

    Args: duration: of a trial, at most [s]. scored: of a trial's telemetry and the
        task, a score with `force`, the impact force of each contact [N].
    Returns: the scores by label: "baseline", "trial_1", ...
    """
    trials: dict[str, Any] = {}
    recordings = []
    peaks: list[list[float]] = []

    def simulate(knowledge, k, label, config=config, task=task):
        view = ContactViewConfig(peaks=peaks)
        diagram = make_multiple_collisions(
            config, knowledge, k, session.meshcat, task, view
        )
        return simulate_motion(session, diagram, duration, label)

    def keep(log, label):
        trials[label] = scored(telemetry(log.diagram, log.context), task)
        recordings.append(recorded(log.diagram, log.context))
        peaks.append(list(trials[label].force))

    if config.handling:
        plain = replace(config, handling=False)
        keep(simulate(None, 0, "baseline", plain), "baseline")
    knowledge: Knowledge | None = None
    if config.rehearse:
        knowledge = rehearsed(config, task, simulate, Knowledge(task.model_prior))
    for k in range(config.trials if config.handling else 1):
        name = f"trial_{k + 1}" if config.handling else "baseline"
        log = simulate(knowledge, k, name)
        knowledge = learned(log.diagram, log.context)
        keep(log, name)
    session.save_plot(plot_trials(trials), "profiles")
    session.save_plot(plot_path(trials, task.prior), "path")
    if knowledge is not None:
        knowledge.contacts.save(session.path("contacts.json"))
    session.write_recording(episodes(recordings), task.model)
    return trials

"""Common parts of the experiments with changing contacts: simulating a motion to its
end, and rehearsing trials on the model before the first real one."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from pydrake.systems.framework import Diagram

from makebreak.diagrams.changing_contact import Knowledge, learned
from makebreak.scripts.runner.criteria import motion_ended
from makebreak.scripts.runner.session import Log, Session
from makebreak.systems.changing_contact.numerics.contact_task import (
    PHASE_SPEED,
    PHASE_STAGE,
)


def simulate_motion(
    session: Session,
    diagram: Diagram,
    duration_sec: float,
    label: str,
    wait_sec: float = 0.0,
) -> Log:
    """Simulates a diagram until its velocity shaper has stopped the motion, complete or
    held.

    Args:
        duration_sec: limit.
        label: of the simulation, as in Session.simulate.
        wait_sec: time that is simulated after the end of the motion.
    """
    shaper = diagram.GetSubsystemByName("velocity_shaper")
    ended: list[tuple[float, str]] = []

    def over(t, values):
        phase = values["phase"]
        why = motion_ended(phase[PHASE_STAGE]) if phase[PHASE_SPEED] == 0.0 else ""
        if why and not ended:
            ended.append((t, why))
        return ended[0][1] if ended and t >= ended[0][0] + wait_sec else ""

    return session.simulate(
        diagram,
        duration_sec,
        {"phase": shaper.GetOutputPort("phase")},
        period_sec=0.01,
        until=over,
        label=label,
    )


def rehearsed(
    config: Any, task: Any, simulate: Callable[..., Log], knowledge: Knowledge
) -> Knowledge:
    """The knowledge after config.rehearse trials on the model, without faults and
    without scores.

    Args:
        simulate: function of (knowledge, number, label, config=, task=) that runs a
            trial.
        knowledge: before the first one.
    """
    config = replace(config, control=replace(config.control, faults=[]))
    task = replace(task, world=task.model)
    for k in range(config.rehearse):
        log = simulate(knowledge, k, f"rehearsal_{k + 1}", config=config, task=task)
        knowledge = learned(log.diagram, log.context)
    return knowledge

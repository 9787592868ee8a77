"""Follows a user's own motion in the world of multiple_collisions: first without
handling of contacts, then with it, for a number of trials.

Scores are computed from the motion and the sensors alone: the contacts made in the
order of the motion, their forces, and the time taken. Impact force and acceleration are
those of multiple_collisions (numerics/impact_score.py).
"""

from dataclasses import dataclass

import numpy as np

from makebreak.diagrams.multiple_collisions import (
    CollisionTask,
    MultipleCollisionsConfig,
    make_task,
)
from makebreak.diagrams.tabletop import TABLETOP_WALLS, read_model
from makebreak.scripts.experiments.runs.collision_trials import run_trials
from makebreak.scripts.experiments.runs.pattern_file import read_pattern
from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.session import Session
from makebreak.systems.changing_contact.numerics.contact_task import (
    BAD_INPUT,
    CONTACT_MISSING,
    CONTACT_UNEXPECTED,
    DIRECTION,
    DONE,
    MADE,
    PHASE_SEGMENT,
    PHASE_STAGE,
    PHASE_STATUS,
    SPEED,
    TIME,
)
from makebreak.systems.changing_contact.numerics.impact_score import impact
from makebreak.systems.changing_contact.numerics.motion_pattern import save_pattern

LONGER_SEC = 60.0  # Time by which a trial may be longer than the motion.
FIRST_MAX, KNOWN_MAX, A10_MAX = 10.0, 8.0, 1.0  # [N], [N], [m/s2]
TROUBLES = {
    CONTACT_MISSING: "a contact did not come, or was lost and not found again",
    CONTACT_UNEXPECTED: "a contact came where the motion has none",
    BAD_INPUT: "the force sensor failed",
}


@dataclass(frozen=True, eq=False)
class PatternTrial:
    """The log and the scores of one trial, with an entry for each contact of the
    motion; nan for contacts that were not made."""

    log: dict[str, np.ndarray]
    done: bool
    completion: float  # From the motion's start to its end [s].
    touched: np.ndarray  # (n,) [s]
    force: np.ndarray  # (n,) F100 [N]
    speed: np.ndarray  # (n,) into each contact [m/s]
    a10: np.ndarray  # (n,) at each contact, as the motion between them is the user's.
    troubles: list[str]  # Problems reported by the velocity shaper.

    @property
    def whole(self) -> bool:
        """Whether the motion was completed, with all of its contacts."""
        return self.done and bool(np.isfinite(self.force).all())


def follow_pattern(config: MultipleCollisionsConfig, session: Session) -> dict:
    """Follows the motion of config.pattern, and scores it.

    Raises: ValueError in one line for a file that is no motion, or a motion that the
        arm cannot follow.
    """
    model = read_model(config.model, TABLETOP_WALLS, config.tool)
    pattern = read_pattern(config.pattern, model)
    try:
        task = make_task(config, pattern)
    except ValueError as error:
        raise ValueError(f"pattern {config.pattern}: {error}") from None
    save_pattern(pattern, session.path("pattern.yaml"))
    duration = pattern.duration + LONGER_SEC
    trials = run_trials(config, task, session, duration, scored)
    return summary(trials, task)


def scored(log: dict[str, np.ndarray], task: CollisionTask) -> PatternTrial:
    """Scores a trial by its log; a contact is the one that ended its segment."""
    time, contact = log["time"], log["contact"]
    segment, stage = log["phase"][:, PHASE_SEGMENT], log["phase"][:, PHASE_STAGE]
    made = np.flatnonzero(np.diff(contact[:, MADE]) > 0) + 1
    n = len(task.prior.contacts)
    touched, force, speed, a10 = np.full((4, n), np.nan)
    for i, expected in enumerate(task.prior.contacts):
        after = np.flatnonzero(segment > expected.segment)
        mine = made[segment[np.maximum(made - 1, 0)] == expected.segment]
        if not after.size or not mine.size:
            continue
        event = contact[mine[-1]]
        touched[i], speed[i] = event[TIME], event[SPEED]
        score = impact(
            time, log["wrench"][:, :3], log["ee_velocity"][:, :3],
            event[DIRECTION], event[TIME],
        )  # fmt: skip
        force[i], a10[i] = score.peak, score.a10
    ended = np.flatnonzero(stage == DONE)
    begins = task.pattern.segments[0].times[0]
    status = log["phase"][:, PHASE_STATUS].astype(int)
    seen = int(np.bitwise_or.reduce(status)) if len(status) else 0
    return PatternTrial(
        log=log,
        done=bool(ended.size),
        completion=float(time[ended[0]] - begins) if ended.size else np.nan,
        touched=touched,
        force=force,
        speed=speed,
        a10=a10,
        troubles=[text for flag, text in TROUBLES.items() if seen & flag],
    )


def summary(trials: dict[str, PatternTrial], task: CollisionTask) -> dict:
    """result.json."""
    names = [name for name in trials if name != "baseline"]
    baseline = trials.get("baseline")
    which = {"baseline": "_baseline"} if baseline is not None else {}
    if names:
        which |= {names[0]: ""}
        if len(names) > 1:
            which |= {names[-1]: "_known"}
    result: dict = {
        "success": False,
        "segments": len(task.pattern),
        "contacts_expected": len(task.prior.contacts),
    }
    for name, end in which.items():
        one = trials[name]
        result |= {
            f"contacts_made{end}": int(np.isfinite(one.force).sum()),
            f"impact_force_peak{end}_N": one.force.tolist(),
            f"impact_speed{end}_mps": one.speed.tolist(),
            f"acceleration_10Hz{end}_mps2": one.a10.tolist(),
            f"completion_time{end}_s": one.completion,
            f"motion_complete{end}": one.done,
            f"troubles{end}": "; ".join(one.troubles) or "none",
        }
        if name != "baseline" and baseline is not None:
            result[f"extra_time{end}_s"] = one.completion - baseline.completion
    criteria = Criteria()
    if not names:
        what = "judged (only with handling: true, beside a trial without)"
        criteria.holds("compared", what, False)
        return result | criteria.result()
    whole = sum(trials[name].whole for name in names)
    what = "trials with the whole motion and all of its contacts"
    criteria.at_least("whole", what, whole, len(names))
    for key, text, name, bound in (
        ("first", "first", names[0], FIRST_MAX),
        ("known", "last", names[-1], KNOWN_MAX),
    ):
        most = float(np.max(trials[name].force, initial=0.0))
        what = f"impact force in the {text} trial, greatest"
        if name != names[0] or key == "first":  # A single trial is a first one.
            criteria.at_most(f"force_{key}", what, most, bound, "N")
    most = max(float(np.max(trials[name].a10, initial=0.0)) for name in names)
    what = "acceleration at contacts, below 10 Hz"
    criteria.at_most("a10", what, most, A10_MAX, "m/s2")
    return result | criteria.result()

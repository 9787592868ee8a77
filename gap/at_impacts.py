"""What is said where free bodies agree with the scene but for what impacts do.

A contact's law is Drake's: a stiffness and a dissipation, or a linear damper. Where the
world has another (one that sinks in deeply and hardly bounces, or in which what slides
presses more), no value of these explains an impact, and other effects, a friction say,
would be named for it. What lies between impacts can be judged all the same.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.problem import Outcome, rms
from makebreak.gap.residuals.objects import FlightProblem
from makebreak.gap.result import AGREES, GapResult
from makebreak.gap.said import figure
from makebreak.gap.thresholds import AGREEMENT_RMS_MAX
from makebreak.models.effects.kind import Effect

EXPLAINED = (*AGREES, "gap_named", "ambiguous")


def impacts_differ(
    problem: FlightProblem, between: GapResult, outcome: Outcome | None
) -> GapResult | None:
    """The result of windows between impacts, with what impacts do beside it; None where
    these do not differ, or what lies between is not explained either.

    Args: outcome: of whole windows, with the effects that `between` names.
    """
    effects = [each.effect() for each in between.effects]
    found = _at_impacts(problem, effects)
    if between.verdict not in EXPLAINED or not found or outcome is None:
        return None
    if not outcome.gap.is_measured or outcome.gap.after > outcome.gap.before:
        return None  # Whole windows get worse with what is named between impacts.
    gap = replace(outcome.gap, data=between.gap.data)
    return replace(
        between, verdict="gap_unnamed", says=f"Between impacts: {between.says} {found}",
        gap=gap, where=problem.where(np.zeros(0)),
        unexplained=outcome.unexplained, series=outcome.series,
    )  # fmt: skip


def _at_impacts(problem: FlightProblem, effects: Sequence[Effect]) -> str:
    """Which channel is off most after which impacts, as a sentence; empty: none is."""
    errors = problem.errors(problem.simulate(effects))
    struck, off = 0, []
    for w, e in zip(problem.windows, errors, strict=True):
        if w.hit >= len(e):
            continue
        struck += 1
        each = [rms(x) for x in e[w.hit :].T]
        worst = int(np.argmax(each))
        if each[worst] > AGREEMENT_RMS_MAX:
            recording = problem.recordings[w.recording]
            at = float(recording.time[w.rows][w.hit])
            off.append((each[worst], problem.channels[worst], w.episode, at))
    if not off:
        return ""
    size, channel, episode, at = max(off)
    return (
        f"In the {problem.after_sec:g} s after {len(off)} of {struck} impacts the "
        f"simulation is off, most in {channel}: {figure(size, 2)} times its noise in "
        f"episode {episode}, after {at:.3g} s. No stiffness, dissipation or linear "
        "damper of the contact explains it, nor any other effect: the law of contact "
        "is another, and nothing was concluded from what follows an impact."
    )

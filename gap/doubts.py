"""What the checks of the data take back of a result."""

from dataclasses import replace

from makebreak.gap.data.findings import GUESSED_GAINS, NO_COLUMN, NO_DRIVE, TOOL_WEIGHT
from makebreak.gap.result import AGREES, GapResult, Tried
from makebreak.gap.thresholds import UNEXPLAINED_RMS


def unless_doubtful(result: GapResult) -> GapResult:
    """Without effects where units, signs, axes or drives' gains are wrong, as they
    would explain that; and without agreement where a channel's motion was taken for
    noise."""
    hunting = [c.says for c in result.checks if c.kind == "hunting"]
    if result.verdict in AGREES and hunting:
        return replace(
            result,
            verdict="gap_unnamed",
            says=f"These recordings are inconclusive: {hunting[0]}",
        )
    undriven = [c.says for c in result.checks if c.kind == NO_DRIVE]
    if not result.effects:
        kinds = (NO_DRIVE, NO_COLUMN, TOOL_WEIGHT)
        missing = " ".join(c.says for c in result.checks if c.kind in kinds)
        if result.verdict == "gap_unnamed" and missing:
            return replace(result, says=f"{result.says} {missing}")
        return result
    guessed = any(c.kind == GUESSED_GAINS for c in result.checks)
    if any(c.severity == "error" for c in result.checks):
        says = (
            "The scene and the recordings disagree, but units, signs or axes of what "
            "was measured are wrong (see the checks): put that right first, for until "
            "then nothing can be named."
        )
    elif undriven and not result.gap.after <= UNEXPLAINED_RMS:
        # Whatever is named makes up for torques that are not in the log.
        says = (
            "The scene and the recordings disagree, and no effect explains all of it. "
            f"{undriven[0]}"
        )
    elif guessed and not result.gap.after <= UNEXPLAINED_RMS:
        # Whatever else is free makes up for a gain that is wrong.
        says = (
            "The scene and the recordings disagree, but the gains of the drives are a "
            "guess, and no effect explains all of it: write the gains into the scene, "
            "or record what the motors give, for until then nothing can be named."
        )
    else:
        heavy = " ".join(c.says for c in result.checks if c.kind == TOOL_WEIGHT)
        return replace(result, says=f"{result.says} {heavy}") if heavy else result
    per_channel = {
        name: {"before": each["before"], "after": each["before"]}
        for name, each in result.gap.per_channel.items()
    }
    gap = replace(result.gap, after=result.gap.before, per_channel=per_channel)
    return replace(
        result,
        verdict="gap_unnamed",
        says=says,
        effects=[],
        tried=[
            *result.tried,
            *(Tried(e.kind, e.at, e.parameters, e.says, says) for e in result.effects),
        ],
        differs=(),
        gap=gap,
        series=[replace(each, after=each.before) for each in result.series],
    )

"""When commands of a mechanism that runs against walls act.

A loop that is twice as fast as the log has given another command half a row later: held
from row to row, what is logged acts a quarter of a row late. A driver may keep commands
back for part of a row. Neither is an effect on the robot, and both look like a damping
or an inertia. So all commands are moved together, by up to a row to either side, if
windows of free motion ask for it beside whatever else joints may have.
"""

import numpy as np

from makebreak.gap.data.findings import Finding
from makebreak.gap.data.sampled_commands import finding_of_moved
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.residuals.impacts import REACH, TIMING, ImpactProblem
from makebreak.gap.thresholds import EVIDENCE_MIN

ROUNDS = 3
ENOUGH = 0.02  # Of a row: a smaller move is the last.
AT_LIMIT = 0.98  # Of a row: what asks for more is no timing of rows.


def set_command_times(problem: ImpactProblem) -> list[Finding]:
    """Moves the problem's commands to where free motion says that they act; what was
    done."""
    if not problem.has_commands():
        return []
    row = problem.row_sec()
    for _ in range(ROUNDS):
        move = _wanted(problem)
        late = problem.commands_late + move
        if abs(late) > AT_LIMIT * row:  # A delay: an effect, which is searched.
            problem.set_commands_late(0.0)
            return []
        problem.set_commands_late(late)
        if abs(move) < ENOUGH * row:
            break
    late = problem.commands_late
    if abs(late) < ENOUGH * row:
        problem.set_commands_late(0.0)
        return []
    return [finding_of_moved(problem.recordings[0].name, late, row)]


def _wanted(problem: ImpactProblem) -> float:
    """By how much later the commands fit [s], beside what is not certain of the links
    and whatever joints may have; 0 without evidence for it."""
    n, rows = problem.nuisances(), problem.free_rows()
    train, r, joints = problem.train()[rows], problem.base()[rows], problem.of_joints()
    if not train.any():
        return 0.0
    is_timing = np.array([name == TIMING for name in n.names])
    left, late = [], 0.0
    for used in (~is_timing, is_timing | True):
        N, prior = n.columns[rows][:, used], n.prior[used]
        found = Screen(r, N, prior, train, reach=REACH).fit(joints[rows])
        left.append(float(train.sum() * found.train**2))
        late = found.b[-1]
    noise = max(left[1] / train.sum(), 1.0)
    return float(late) if left[0] - left[1] > EVIDENCE_MIN * noise else 0.0

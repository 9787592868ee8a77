"""Velocities that come after their positions, or before, as a proposed sidecar has it.

Drivers take velocities from differences of positions, or filter them; a simulator that
steps its velocities first logs what moved a joint within the step before. That is known
of the log alone, and is no matter of the robot.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.data.check_relations import (
    is_late,
    is_rate,
    run_apart,
    says_late,
    width_of,
)
from makebreak.gap.data.match import Match
from makebreak.gap.numerics.signal_relation import Relation, relate

MOST_ROWS = 30_000  # That are looked at.
DIFFERENCE = "backward difference"


def with_late_velocities(
    columns: Mapping[str, np.ndarray],
    matches: Sequence[Match],
    filters: Mapping[str, object],
) -> tuple[list[Match], list[tuple[str, float, str]]]:
    """Matches with the filters that the times of positions and velocities tell of; and
    of each (channel, lag [s], sentence).

    Args: columns {name: (n,)}; filters: what the log's own sidecar says of channels.
    """
    of = {m.channel: m for m in matches if m.channel}
    if "time" not in of:
        return list(matches), []
    rows = _longest(of["time"].values(columns))
    t = of["time"].values(columns)[rows]
    told: dict[str, str] = {}
    alike: dict[tuple[bool, bool], list[tuple[str, Relation]]] = {}
    for name in of:
        at, _, what = name.rpartition(".")
        position = f"{at}.position"
        if what != "velocity" or position not in of or {name, position} & {*filters}:
            continue
        v, q = (of[each].values(columns)[rows] for each in (name, position))
        good_v, good_q = np.isfinite(v), np.isfinite(q)
        width = width_of(min(good_v.sum(), good_q.sum()))
        r = relate(t[good_v], v[good_v], t[good_q], q[good_q], 1, width=width)
        if r is None or not is_rate(r) or not is_late(r) or run_apart(r, t[-1] - t[0]):
            continue
        text = f"delay, {1e3 * abs(r.lag):.3g} ms"
        if r.of_a_difference():
            text = DIFFERENCE
        told[name if r.lag > 0.0 or text == DIFFERENCE else position] = text
        alike.setdefault((text == DIFFERENCE, r.lag > 0.0), []).append((name, r))
    said = []
    for some in alike.values():
        names, each = zip(*some, strict=True)
        says = f"{says_late(names, each)} The proposed sidecar declares that."
        said.append((names[0], float(each[0].lag), says))
    return [replace(m, filter=told.get(str(m.channel), "")) for m in matches], said


def _longest(t: np.ndarray) -> slice:
    """The longest rows in which time increases, of an episode."""
    ends = np.flatnonzero(~(np.diff(t) > 0.0)) + 1
    starts, ends = np.r_[0, ends], np.r_[ends, len(t)]
    k = int(np.argmax(ends - starts))
    return slice(starts[k], min(ends[k], starts[k] + MOST_ROWS))

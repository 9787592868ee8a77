"""Lists of all coordinates of a model (qpos, qvel, q, state), or of all its actuators
(ctrl): which entry is what.

Simulators log them as they count: MuJoCo and pinocchio have the place of a free body
before its quaternion, Drake behind it. Unit length tells which of the seven it is.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.data.arrays import words_of
from makebreak.gap.data.base_pose import are_quaternion
from makebreak.gap.data.match import Match

OF_ACTUATORS = "a list of all actuators"
_VELOCITIES = {7: 6, 4: 3, 1: 1}  # Of a free body, a ball joint, a joint.
_STATE = set("q qpos pos position positions x state states column conf".split())
_SPEED = set("v qvel vel velocity velocities dq qd qdot".split())
_GIVEN = set("ctrl u control controls action actions".split())


def by_lists(
    columns: Mapping[str, np.ndarray],
    model: str,
    order: Sequence[tuple[str, int]],
    actuators: Sequence[tuple[str, float]],
) -> dict[str, Match]:
    """{column: match} of lists as long as a model with bodies that nothing holds has
    coordinates, or a model actuators.

    Args: columns {name: (n,)}; order: (joint or free body, its number of positions), as
        they are counted; actuators: (joint, gear) of each, "" of one of no joint.
    """
    found: dict[str, Match] = {}
    n_q = sum(n for _, n in order)
    n_v = sum(_VELOCITIES[n] for _, n in order)
    for stem, names in _lists(columns):
        words, told = {*words_of(stem)}, list[str | None]()
        if n_q > len(order) and len(names) in (n_q, n_q + n_v) and words & _STATE:
            told = _positions(order, [columns[name] for name in names[:n_q]])
            told += _velocities(order) if told and len(names) > n_q else []
        elif n_q > len(order) and len(names) == n_v and words & _SPEED:
            told = _velocities(order)
        for name, at in zip(names, told, strict=False):
            channel = None if at is None else f"{model}.{at}"
            found[name] = Match(name, channel, why="a list of all coordinates")
        force = {"actuator", "force"} <= words
        if actuators and len(names) == len(actuators) and (force or words & _GIVEN):
            what = "effort_measured" if force else "effort_command"
            for name, (joint, gear) in zip(names, actuators, strict=True):
                if not joint:
                    why = f"{OF_ACTUATORS}: of no joint"
                    found[name] = Match(name, None, why=why)
                    continue
                own = Match(name, f"{model}.{joint}.{what}", why=OF_ACTUATORS)
                found[name] = replace(own, scale=gear) if force else own
    return found


def _lists(columns: Mapping[str, np.ndarray]) -> Iterator[tuple[str, list[str]]]:
    """Names that differ in the number at their end, which counts on; or one that has
    none, and says nothing but what an actuator is given."""
    lists: dict[str, list[tuple[int, str]]] = {}
    yield from ((name, [name]) for name in columns if {*words_of(name)} <= _GIVEN)
    for name in columns:
        if parts := re.fullmatch(r"(.*?)(\d+)\W*", name):
            lists.setdefault(parts[1], []).append((int(parts[2]), name))
    for stem, own in lists.items():
        own.sort()
        first = own[0][0]
        if first in (0, 1) and [k for k, _ in own] == [*range(first, first + len(own))]:
            yield stem, [name for _, name in own]


def _positions(order, columns: Sequence[np.ndarray]) -> list[str | None]:
    """<joint>.position, or <body>.x and so on; [] where a body has no quaternion."""
    told: list[str | None] = []
    for name, n in order:
        seven = columns[len(told) : len(told) + n]
        if n == 1:
            told.append(f"{name}.position")
        elif n == 4:
            told += [None] * 4
        elif are_quaternion(seven[3:]):
            told += [f"{name}.{part}" for part in ("x", "y", "z", *_order(seven[3:]))]
        elif are_quaternion(seven[:4]):
            told += [f"{name}.{part}" for part in (*_order(seven[:4]), "x", "y", "z")]
        else:
            return []
    return told


def _velocities(order) -> list[str | None]:
    """Of free bodies none: simulators have them in other axes."""
    each = [(name, _VELOCITIES[n]) for name, n in order]
    return [
        f"{name}.velocity" if n == 1 else None for name, n in each for _ in range(n)
    ]


def _order(four: Sequence[np.ndarray]) -> tuple[str, ...]:
    """Scalar last where so the body begins turned less: models begin nearly upright."""
    last = abs(four[3][0]) > abs(four[0][0]) + 1e-6
    return ("qx", "qy", "qz", "qw") if last else ("qw", "qx", "qy", "qz")

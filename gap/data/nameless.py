"""Tables without names: which columns are positions, velocities, commands, efforts.

Files of numbers alone have a column for each joint and quantity, as blocks (q1 q2 q3 v1
v2 v3) or joint by joint (q1 v1 q2 v2). A velocity is known by its position, of which it
is the rate; a command by what follows it; an effort by the model, which needs it.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from makebreak.gap.data.match import JointName, Match
from makebreak.gap.data.proposal import UNKNOWN_JOINT

ALIKE = 0.97  # Squared correlation of a position with its velocity's integral.
LATE, LIKE_IT = 50, 0.7  # Rows that a joint is behind its command; correlation.
FOLLOWS = 0.05  # Of a joint's range, how far it stays behind its command.
BY_CONTENT = "the file has no names; by what is in it"

Layout = dict[str, tuple[int, int]]  # {quantity: its first column, from joint to joint}


def layouts(
    columns: Mapping[str, np.ndarray],
    matches: Sequence[Match],
    joints: Sequence[JointName],
) -> list[tuple[dict[str, str], list[Match]]]:
    """{quantity: its first column}, and matches of all columns, for each way in which
    columns that are numbered (column_1, state[0]) may be laid out; none where others
    are unknown, too, or numbers are no more than joints. Where commands are known, as
    many columns as joints that go after these are the positions.

    Args: columns {name: (n,)} and their matches; joints in the robot's order.
    """
    if not joints:
        return []
    n, stems = len(joints), [_stem(m.column) for m in matches]
    states = {s for m, s in zip(matches, stems, strict=True)
              if m.why.endswith(UNKNOWN_JOINT) and stems.count(s) >= 2 * n}  # fmt: skip
    matches = [replace(m, channel=None) if s in states else m
               for m, s in zip(matches, stems, strict=True)]  # fmt: skip
    time = next((m for m in matches if m.channel == "time"), None)
    names = [m.column for m in matches if m.channel is None]
    is_known = any((m.channel or "").endswith(".position") for m in matches)
    numbered = n == 1 or all(map(_stem, names))
    if time is None or is_known or len(names) < n or not numbered:
        return []
    X = np.stack([columns[name] for name in names], axis=1)
    t = time.scale * columns[time.column]
    good = np.isfinite(X).all(axis=1) & np.isfinite(t)
    found = []
    commands = [columns[m.column][good] for j in joints for m in matches
                if m.channel in (f"{j.name}.position_command",
                                 f"{j.name}.effort_command")]  # fmt: skip
    only = len(names) == n == len(commands) and all(
        _goes_after(*pair) for pair in zip(commands, X[good].T, strict=True)
    )
    each = [{"position": (0, 1)}] if only else _layouts(t[good], X[good], n)
    for layout in each:
        channel = {
            names[first + k * step]: f"{joint.name}.{quantity}"
            for quantity, (first, step) in layout.items()
            for k, joint in enumerate(joints)
        }
        own = [
            Match(m.column, channel[m.column], why=BY_CONTENT)
            if m.column in channel
            else m
            for m in matches
        ]
        found.append(({what: names[at] for what, (at, _) in layout.items()}, own))
    return found


def _stem(name: str) -> str:
    """Of a name that ends with a number, what is before that; else nothing."""
    found = re.fullmatch(r"(.*?)\d+\W*", name)
    return found.group(1) if found else ""


def _goes_after(command: np.ndarray, y: np.ndarray) -> bool:
    """Whether y (m,) is like a command so many rows before, of up to LATE."""

    def alike(late: int) -> float:
        one, other = command[: len(y) - late], y[late:]
        size = np.std(one) * np.std(other)
        return float(np.mean((one - one.mean()) * (other - other.mean())) / size)

    if not (np.ptp(y) > 0.0 and np.ptp(command) > 0.0):
        return False
    return max(map(alike, range(min(LATE, len(y) // 2)))) > LIKE_IT


def _layouts(t: np.ndarray, X: np.ndarray, n: int) -> Iterator[Layout]:
    """Of the columns X (m, w) of n joints at times t (m,)."""
    width = X.shape[1]
    moves = np.ptp(X, axis=0) > 1e-9 * np.abs(X).max(axis=0, initial=1e-300)
    blocks = [
        (first, step)
        for step in sorted({1, width // n})
        for first in range(width - (n - 1) * step)
        if first < step or step == 1
    ]
    columns = {b: b[0] + b[1] * np.arange(n) for b in blocks}
    rates = _is_rate(t, X)

    def is_rate(a, b) -> bool:
        one, two = columns[a], columns[b]
        moving = moves[one] & moves[two]
        return bool(moving.any() and (rates[one, two][moving] > ALIKE).all())

    pairs = [(a, b) for a, b in product(blocks, blocks) if a[1] == b[1]]
    of_rates = [(a, b) for a, b in pairs if is_rate(a, b)]
    # What is a rate itself is no position: its own rate is an acceleration.
    of_rates = [(a, b) for a, b in of_rates if not any(a == c for _, c in of_rates)]
    starts: list[Layout] = [{"position": a, "velocity": b} for a, b in of_rates]
    for start in starts or [{"position": a} for a in blocks]:
        rest = [
            b for b in blocks
            if b[1] == start["position"][1]
            and not _overlap(b, start.values(), columns)
            and not any(is_rate(a, b) for a in start.values())  # Accelerations.
        ]  # fmt: skip
        told = dict(start)
        for what, command in (("position", "position_command"),
                              ("velocity", "velocity_command")):  # fmt: skip
            follows = [
                b
                for b in rest
                if what in start
                and _follows(X[:, columns[start[what]]], X[:, columns[b]])
            ]
            if follows:
                told[command] = follows[0]
                rest = [b for b in rest if not _overlap(b, follows, columns)]
        if starts:
            yield told
        for effort in rest:
            yield told | {"effort_measured": effort}


def _overlap(block, others, columns) -> bool:
    return any(np.intersect1d(columns[block], columns[b]).size for b in others)


def _is_rate(t: np.ndarray, X: np.ndarray) -> np.ndarray:
    """(w, w) squared correlation of each column with the integral of each other one,
    both without a line."""
    whole = np.concatenate([np.zeros((1, X.shape[1])), np.cumsum(
        0.5 * (X[1:] + X[:-1]) * np.diff(t)[:, None], axis=0)])  # fmt: skip
    line = np.stack([np.ones_like(t), t - t.mean()], axis=1)
    a, b = (Y - line @ np.linalg.lstsq(line, Y, rcond=None)[0] for Y in (X, whole))
    size = np.linalg.norm(a, axis=0)[:, None] * np.linalg.norm(b, axis=0)
    return np.clip(a.T @ b / np.maximum(size, 1e-300), 0.0, 1.0) ** 2


def _follows(measured: np.ndarray, command: np.ndarray) -> bool:
    """Whether columns (m, n) stay near others."""
    off = np.abs(measured - command).mean(axis=0)
    return bool((off <= FOLLOWS * np.ptp(measured, axis=0) + 1e-6).all())

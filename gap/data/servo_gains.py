"""The gains of position servos, from how joints moved and what they were told.

A servo gives kp (command - position) - kd velocity. Where measured efforts are just
that, they tell the gains. Else the robot needs what inverse dynamics says. Both are
averaged by one kernel and compared by least squares, with dry friction free, and, where
there is evidence for it, rotors of all joints, and by how much commands act later, or
earlier, than in their rows: none of these is then taken for a gain. (A joint that
nothing weighs on moves alike with twice the gains and twice the inertia; and commands
that are late look like damping and a rotor.)
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces
from scipy.ndimage import minimum_filter1d
from scipy.optimize import minimize_scalar, nnls

from makebreak.models.effects.kind import one_dof_joints

KERNEL_SEC = 0.2  # Slower than sensors' noise, faster than most motions.
LEAST_SAMPLES = 9  # Of that kernel.
MOST_SAMPLES = 3000  # At which inverse dynamics is computed.
MOVES = 0.05  # Of its fastest: slower, a joint may be held by friction.
PARTS = 5  # Of the data: each is predicted from the others,
LARGEST_SPREAD = 0.15  # whose stiffnesses differ by less than this share (1 sigma),
LEAST_EXPLAINED = 0.8  # and of what the rest leaves the stiffness explains this.
LAW_LEAVES = 0.01  # Of the variance of an effort that is what its servo gives.
# Commands are late, and joints have rotors, where the laws' evidence (half a
# chi-square; rows KERNEL_SEC apart count as independent) grows by so much; at most so
# late [s].
LATE_EVIDENCE, MOST_LATE = 10.0, 0.1
BETWEEN = 0.1  # Of a row: commands that are so much later than one do not hold for it.
FINE = 0.02  # Of the kernel: a cost changes little with how late commands are by this.
NOTHING = 1e-12  # Of a variance: rounding leaves so much,
WITHIN_ROWS = 0.01  # and what happens within a row this, times (row / KERNEL_SEC)^2.
LAW_OFF = 0.03  # Of the gains of a file, which are rather taken than those of a fit.


@dataclass(frozen=True)
class ServoGains:
    """kp [N m/rad], kd [N m s/rad] with a joint's damping in it, rotor [kg m2], Coulomb
    friction [N m]; of a joint that slides [N/m], [N s/m], [kg], [N]. most: effort that
    the motion needed, with these."""

    kp: float
    kd: float
    rotor: float
    friction: float
    most: float = 0.0


@dataclass(frozen=True, eq=False)
class ServoLog:
    """One log: time (n,) [s], positions q (n, n_q) and position commands (n, n_q), NaN
    where there is none, as each is held from its row on. effort, velocity: (n, n_q)
    measured."""

    time: np.ndarray
    q: np.ndarray
    command: np.ndarray
    effort: np.ndarray | None = None
    velocity: np.ndarray | None = None


def servo_gains(
    plant: MultibodyPlant, motions: Sequence[ServoLog]
) -> list[ServoGains | None]:
    """Of each joint, in the order of the plant's coordinates; None where the data do
    not say: parts of them differ, or the stiffness explains too little.

    A joint that needs next to no effort, as a light one with a rotor that the plant
    lacks, shows only how its numbers compare: it gets the median stiffness of the
    others that turn, or slide, as it does.

    Args: plant: a finalized mechanism, all of whose coordinates are in `motions`.
    """
    moving: list[list[_Moving]] = [[] for _ in range(plant.num_positions())]
    for motion in motions:
        for each, one in zip(moving, _moving(plant, motion), strict=True):
            each.append(one)
    way = _most_likely(moving)
    parts = [[one.rows(way) for one in each] for each in moving]
    found = [_fitted(own) for own in parts]
    slides = [j.type_name() == "prismatic" for j in _joints(plant)]
    for i, own in enumerate(parts):
        alike = [
            each.kp for each, s in zip(found, slides, strict=True)
            if each is not None and s == slides[i]
        ]  # fmt: skip
        if found[i] is None and alike:
            found[i] = _fitted_at(float(np.median(alike)), own)
    return found


class _Way(NamedTuple):
    """How commands act: so late [s], held from their rows on or in lines from each row
    to the next; and whether joints have rotors that the plant lacks."""

    with_rotors: bool = False
    in_lines: bool = False
    late: float = 0.0


@dataclass(frozen=True, eq=False)
class _Moving:
    """Of one joint, while it moves, at times t (m,) [s]: means by the kernel of its
    position (m,), rate (m,) and acceleration (m,), and the effort that the robot needs
    (m,). told (n, 3): times and means of its command, held and in lines; step [s]
    between t."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    vd: np.ndarray
    needed: np.ndarray
    told: np.ndarray
    step: float

    def rows(self, way: _Way) -> tuple[np.ndarray, np.ndarray]:
        """Regressors (m, 4) of kp, kd, friction and rotor, and effort (m,)."""
        told = np.interp(
            self.t - way.late, self.told[:, 0], self.told[:, 2 if way.in_lines else 1]
        )
        v, vd = self.v, self.vd if way.with_rotors else 0.0 * self.vd
        return np.stack([told - self.q, -v, -np.sign(v), -vd], axis=1), self.needed


def _most_likely(moving: Sequence[Sequence[_Moving]]) -> _Way:
    """How commands act, and whether there are rotors: held from their rows on, and
    none, without evidence."""
    joints = [[one for one in own if len(one.t)] for own in moving]
    joints = [own for own in joints if own]
    if not joints:
        return _Way()
    row = min(float(np.diff(one.told[:2, 0])[0]) for own in joints for one in own)
    step = max(row, FINE * KERNEL_SEC)

    def cost(way: _Way, least: float = NOTHING) -> float:
        total = 0.0
        for own in joints:
            every = [one.rows(way) for one in own]
            X, y = (np.concatenate(each) for each in zip(*every, strict=True))
            left = nnls(X / _size(X), y)[1] ** 2
            share = max(left / max(float(y @ y), 1e-300), least)
            seconds = sum(len(one.t) * one.step for one in own)
            total += 0.5 * seconds / KERNEL_SEC * float(np.log(share))
        return total

    ways = []
    for rotors, lines in product((False, True), (False, True)):
        by_late = partial(_Way, rotors, lines)
        some = np.arange(-row if lines else 0.0, MOST_LATE, step)
        late = min(some, key=lambda late: cost(by_late(late)))
        found = minimize_scalar(
            lambda late: cost(by_late(late)),  # noqa: B023
            bounds=(max(late - step, some[0]), late + step), method="bounded",
        )  # fmt: skip
        ways += [by_late(float(found.x))] + [by_late(0.0)] * (not lines)

    def against(way: _Way) -> float:
        free = way.with_rotors + (way.in_lines or way.late != 0.0)
        return cost(way, WITHIN_ROWS * (row / KERNEL_SEC) ** 2) + LATE_EVIDENCE * free

    return min(sorted(ways), key=against)


def gains_of_efforts(
    motions: Sequence[ServoLog], known: Sequence[tuple[float, float] | None]
) -> tuple[list[ServoGains | None], float]:
    """Of each joint, where its measured effort is kp (command - position) - kd velocity
    and nothing else, as of simulated servos and of motors that report what they were
    told to give, from where they take their zero and however late commands reach all of
    them. None of the others. And how late that is [s]: of commands that are samples,
    with a straight line from one to the next.

    Args: known: kp and kd of the robot's file: they are taken where they fit as well.
    """
    found: list[ServoGains | None] = [None] * len(known)
    late = 0.0
    averaged = [averaged_motion(motion) for motion in motions]
    steps = [each[1] for each in averaged if each is not None]
    efforts = [motion.effort is not None for motion in motions]
    if not (known and motions and all(efforts) and len(steps) == len(motions)):
        return found, late
    independent = sum(float(np.ptp(m.time)) for m in motions) / KERNEL_SEC
    # By rows, where these tell it: means over rows are of something else (below).
    if all(motion.velocity is not None for motion in motions):
        rows = [partial(_law_of_rows, motion) for motion in motions]
        found, late = _laws_of(rows, known, min(steps), independent)
    if not all(found):
        rows = [partial(_law_rows, *each)
                for each in zip(motions, averaged, strict=True)]  # fmt: skip
        found, late = _laws_of(rows, known, min(steps), independent)
    return found, late


def _laws_of(
    rows_of, known, step: float, independent: float
) -> tuple[list[ServoGains | None], float]:
    """The laws from what gives, of each log, each joint's rows for commands that are so
    late [s]; and how late they are."""

    def laws(late: float) -> list[tuple[float, ServoGains | None]]:
        each = zip(*(rows(late) for rows in rows_of), strict=True)
        return [_law(*one) for one in zip(each, known, strict=True)]

    def cost(late: float) -> float:
        left = sum(float(np.log(left)) for left, _ in laws(late))
        return 0.5 * independent * left

    now = [gains for _, gains in laws(0.0)]
    some = np.arange(0.0, MOST_LATE, step)
    costs = [cost(late) for late in some]
    k = int(np.argmin(costs))
    if not costs[0] - costs[k] > LATE_EVIDENCE:
        return now, 0.0
    around = (some[k] - step, some[k] + step)
    found = minimize_scalar(cost, bounds=around, method="bounded")
    # Where commands hold from row to row it is a whole number of these.
    late = float(found.x) if found.fun < costs[k] else float(some[k])
    return [gains for _, gains in laws(late)], late


def go_in_lines(motions: Sequence[ServoLog], late: float) -> bool:
    """Whether commands that are so late [s] are samples of a faster loop: they change
    in most rows, and act between two of these."""
    row = min(float(np.median(np.diff(m.time))) for m in motions)
    changes = np.concatenate([(np.diff(m.command, axis=0) != 0.0).any(axis=1)
                              for m in motions])  # fmt: skip
    return bool(abs(late / row - round(late / row)) > BETWEEN and changes.mean() > 0.5)


def _law_of_rows(motion: ServoLog, late: float):
    """As _law_rows, of efforts and velocities that are of the instants of their rows:
    between two of these a stiff loop has done most of what a step of its command makes
    it do, so that means over rows are of something else."""
    assert motion.effort is not None and motion.velocity is not None
    t = motion.time
    rows = t - late >= t[0]
    for told, q, v, effort in zip(
        motion.command.T, motion.q.T, motion.velocity.T, motion.effort.T, strict=True
    ):
        error = np.interp(t - late, t, told) - q
        yield np.column_stack([error, -v])[rows], effort[rows]


def _law_rows(motion: ServoLog, averaged, late: float):
    """Of each joint error and rates (m, 3), the row before's and the one's after, and
    effort (m,), of commands that act so late [s]."""
    even, step, _, (kernel, *_), (mean, rate, rate2) = averaged
    assert motion.effort is not None
    for i in range(mean.shape[1]):
        # Both as they are in their rows: between these a step of the command changes
        # them alike. A row's rate may be that of a row before or after.
        told, effort = (
            np.convolve(np.interp(even - by, motion.time, y[:, i]), kernel, "valid")
            for y, by in ((motion.command, late), (motion.effort, 0.0))
        )
        rates = rate[:, i, None] + [-step, step] * rate2[:, i, None]
        yield np.column_stack([told - mean[:, i], -rates]), effort


def _law(
    parts: Sequence[tuple[np.ndarray, np.ndarray]], known
) -> tuple[float, ServoGains | None]:
    """The share of its effort's variance that a law leaves, and the law. From error and
    one rate or two (m, 2 or 3), and effort (m,), of each log."""
    X, y = (np.concatenate(each) for each in zip(*parts, strict=True))
    if not (np.isfinite(X).all() and np.isfinite(y).all() and np.ptp(y) > 0.0):
        return 1.0, None
    X, y = X - X.mean(axis=0), y - y.mean()  # A zero that is another is no other law.
    whole = float(y @ y)
    if known is not None:
        kp, kd = known
        other = kd * (X[:, -1] - X[:, 1])  # Of so much of its rate the row after.
        rest = y - kp * X[:, 0] - kd * X[:, 1]
        share = np.clip(rest @ other / max(other @ other, 1e-300), 0.0, 1.0)
        left = float(np.sum((rest - share * other) ** 2))
        # Where its parts nearly cancel, as at a light joint, efforts tell no size.
        parted = LAW_OFF**2 * kp**2 * np.sum(X[:, 0] ** 2)
        if left < max(LAW_LEAVES * whole, parted):
            return max(left / whole, NOTHING), ServoGains(kp, kd, 0.0, 0.0)
    size = _size(X)
    c, root = nnls(X / size, y)
    kp, *rates = c / size
    left = max(float(root**2) / whole, NOTHING)
    if not (kp > 0.0 and left < LAW_LEAVES):
        return left, None
    if known is not None and abs(kp - known[0]) < LAW_OFF * known[0]:
        return left, ServoGains(known[0], known[1], 0.0, 0.0)
    return left, ServoGains(float(kp), float(sum(rates)), 0.0, 0.0)


def _joints(plant: MultibodyPlant) -> list:
    return sorted(one_dof_joints(plant), key=lambda joint: joint.position_start())


def _moving(plant: MultibodyPlant, motion: ServoLog) -> Iterator[_Moving]:
    """Of each joint what it did while it moved; nothing where a log is too short, or no
    command was given."""
    t, averaged = motion.time, averaged_motion(motion)
    if averaged is None:
        none = np.zeros(0)
        for _ in motion.command.T:
            yield _Moving(none, none, none, none, none, np.zeros((1, 3)), np.inf)
        return
    even, step, width, kernels, (mean, rate, rate2) = averaged
    at = even[width // 2 : width // 2 + len(mean)]
    stride = max(len(mean) // MOST_SAMPLES, 1)
    some = np.arange(len(mean))[::stride]
    needed = needed_efforts(plant, mean[some], rate[some], rate2[some])
    for i, command in enumerate(motion.command.T):
        there = np.flatnonzero(np.isfinite(command))
        told = np.zeros((2, len(at)))
        moves = np.zeros(len(at), bool)
        if len(there) > 1:
            every = (_mean_held(t[there], command[there], even, step),
                     np.interp(even, t[there], command[there]))  # fmt: skip
            told = np.stack([np.convolve(x, kernels[0], "valid") for x in every])
            v = np.abs(rate[:, i])
            moves = v > MOVES * np.quantile(v, 0.95)
            moves = minimum_filter1d(moves, width)
            # Commands from before the first row are not known.
            moves &= (at > at[0] + MOST_LATE) & (at < at[-1] - step)
        own = moves[some]
        k = some[own]
        yield _Moving(
            at[k], mean[k, i], rate[k, i], rate2[k, i], needed[own, i],
            np.column_stack([at, *told]), step * stride,
        )  # fmt: skip


def averaged_motion(motion: ServoLog):
    """Even times (m,), their step, a kernel's width, the kernels, and the joints' mean
    positions, rates and accelerations by them; None where a log is too short."""
    t = motion.time
    step = float(np.median(np.diff(t))) if len(t) > 1 else np.inf
    width = max(int(round(KERNEL_SEC / step)), LEAST_SAMPLES) + 6 | 1
    even = np.arange(t[0], t[-1], step) if np.isfinite(step) else t[:0]
    if len(even) < 4 * width:
        return None
    kernels = _bump(width, step)
    q = np.stack([np.interp(even, t, x) for x in motion.q.T], axis=1)
    states = [
        np.stack([np.convolve(x, kernel, "valid") for x in q.T], axis=1)
        for kernel in kernels
    ]
    return even, step, width, kernels, states


def effort_shares(plant: MultibodyPlant, motions: Sequence[ServoLog]) -> np.ndarray:
    """(n,) rms of the effort that each joint needs, over that of its parts, weight and
    motion: next to 0 where they cancel, as of a joint that nothing drives; about 1 of a
    driven one. NaN where the logs are too short.

    Args: as of servo_gains.
    """
    squares = np.zeros((2, plant.num_positions()))
    for motion in motions:
        averaged = averaged_motion(motion)
        if averaged is None:
            continue
        states = averaged[-1]
        some = slice(None, None, max(len(states[0]) // MOST_SAMPLES, 1))
        q, v, vd = (x[some] for x in states)
        needed = needed_efforts(plant, q, v, vd)
        weight = needed_efforts(plant, q, np.zeros_like(v), np.zeros_like(vd))
        squares[0] += np.sum(needed**2, axis=0)
        squares[1] += np.sum(weight**2 + (needed - weight) ** 2, axis=0)
    with np.errstate(invalid="ignore"):
        return np.sqrt(squares[0] / squares[1])


def _mean_held(t, command, at, width: float) -> np.ndarray:
    """(m,) means over intervals of this width [s] about `at` (m,) of a command (n,)
    that holds from its time (n,) until the next. Sampled at its rows it would seem half
    a row early, which is damping."""
    total = np.append(0.0, np.cumsum(command[:-1] * np.diff(t)))
    edges = np.append(at - 0.5 * width, at[-1] + 0.5 * width)
    past = np.clip(edges, None, t[0]) - t[0], np.clip(edges, t[-1], None) - t[-1]
    whole = np.interp(edges, t, total) + past[0] * command[0] + past[1] * command[-1]
    return np.diff(whole) / width


def _bump(width: int, step: float) -> list[np.ndarray]:
    """(width,) weights of a mean over a smooth bump, and of its two derivatives: what
    is averaged by one and the same kernel stays an equation. The derivatives are
    differences of sixth order of the mean, so that this holds at all frequencies that
    the mean lets through."""
    b = (1.0 - np.linspace(-1.0, 1.0, width - 6 + 2)[1:-1] ** 2) ** 4
    mean = b / b.sum()
    first = np.array([1.0, -9.0, 45.0, 0.0, -45.0, 9.0, -1.0]) / (60.0 * step)
    second = np.array([2.0, -27.0, 270.0, -490.0, 270.0, -27.0, 2.0])
    second /= 180.0 * step**2
    rates = (np.convolve(mean, each) for each in (first, second))
    return [np.pad(mean, 3), *rates]


def needed_efforts(plant: MultibodyPlant, q, v, vd) -> np.ndarray:
    """(m, n) efforts by inverse dynamics at states (m, n)."""
    context, out = plant.CreateDefaultContext(), np.empty(q.shape)
    forces = MultibodyForces(plant)
    for k in range(len(q)):
        plant.SetPositions(context, q[k])
        plant.SetVelocities(context, v[k])
        plant.CalcForceElementsContribution(context, forces)
        out[k] = plant.CalcInverseDynamics(context, vd[k], forces)
    return out


def _size(X: np.ndarray) -> np.ndarray:
    return np.maximum(np.sqrt(np.mean(X**2, axis=0)), 1e-12)


def _fitted(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> ServoGains | None:
    """From equations (m, 4), (m,) of each log, if parts of them agree."""
    X, y = (np.concatenate(each) for each in zip(*parts, strict=True))
    if len(y) < 10 * PARTS:
        return None
    size = _size(X)

    def fit(rows: np.ndarray, columns: Sequence[int]) -> np.ndarray:
        c = np.zeros(X.shape[1])
        c[columns] = nnls(X[rows][:, columns] / size[columns], y[rows])[0]
        return c / size

    every, others = [0, 1, 2, 3], [1, 2, 3]
    part = np.arange(len(y)) * PARTS // len(y)
    stiff, left, without = [], 0.0, 0.0
    for k in range(PARTS):
        mine = part == k
        c = fit(~mine, every)
        stiff.append(c[0])
        left += float(np.sum((y[mine] - X[mine] @ c) ** 2))
        without += float(np.sum((y[mine] - X[mine] @ fit(~mine, others)) ** 2))
    kp, kd, friction, rotor = fit(np.full(len(y), True), every)
    agree = float(np.std(stiff)) <= LARGEST_SPREAD * kp
    if not kp > 0.0 or not agree or left > (1.0 - LEAST_EXPLAINED) * without:
        return None
    most = np.abs(y - X[:, 2:] @ (friction, rotor)).max()
    return ServoGains(float(kp), float(kd), float(rotor), float(friction), float(most))


def _fitted_at(kp: float, parts: Sequence[tuple[np.ndarray, np.ndarray]]):
    """What goes with a given stiffness, if it explains the joint's error."""
    X, y = (np.concatenate(each) for each in zip(*parts, strict=True))
    if len(y) < 10 * PARTS:
        return None
    given = kp * X[:, 0] - y
    size = _size(X[:, 1:])
    c, left = nnls(-X[:, 1:] / size, given)
    if left**2 > (1.0 - LEAST_EXPLAINED) * float(given @ given):
        return None
    kd, friction, rotor = c / size
    most = np.abs(y - X[:, 2:] @ (friction, rotor)).max()
    return ServoGains(kp, float(kd), float(rotor), float(friction), float(most))

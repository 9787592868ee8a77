"""Which contact mode the tool is in, from a feature of the wrench on it.

    feature = |F_t| / R   or   [|F_t| / R, |tau| / (R arm)]

F_t is the force in the motion subspace minus the tool's own inertia, R the sum of the
normal forces. Neither the direction of motion nor the normal force changes the feature
(CC eq. 7). Wrench and velocity are averaged over WINDOW samples before magnitudes are
taken. While the tool does not slide, friction is undetermined and there is no feature.

`detect` takes one sample and returns the new memory. The stages are

    FREE        no normal force
    TOUCHED     a contact has begun, or a direction of pressing has changed: the mode is
                identified after a short run-in
    TRACKING    the feature stays near its reference
    COLLECTING  the feature has departed from it: the mode is identified again
    HINTED      a mode was announced and is in use, but not yet confirmed

A *departure* is a difference from the reference of TRIGGER force_noise / R in
SUSTAINED samples in a row, or of half of that in the mean over about 50 ms. The change
is dated to the first departing sample. Nothing is decided before the tool has moved on
by `crossing`, the length that it needs to cross a seam: while it stands on both sides,
the feature is a mixture and belongs to no mode. Then the mode is

  known   if EARLY samples in a row are near its centroid, or a share CONFIDENT of a
          batch belongs to it (mode_table.py);
  new     if a whole batch is stationary and belongs to none.

A batch that is not stationary waits.

Two modes can be assumed before they are identified: the one that a touch brought
before (`touch_hint`), and, when a direction of pressing is dropped, the one before it
was added.

The arm is to be stiff (`collecting`) for STIFF_SEC after a departure, in which the
forward model follows it, and while a batch is collected; after a touch and a hint until
the mode is identified. While a tool merely crosses a seam it may be soft.

Source: CC section 3.2, algorithm 1. What departure, crossing, stationary and hint mean
is ours.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.contact_task import (
    FREE_MODE,
    N_TOUCH_MODE,
    N_TRANSITION,
    UNKNOWN_MODE,
)
from makebreak.systems.changing_contact.numerics.mode_table import BAND, ModeTable
from makebreak.systems.changing_contact.numerics.motion_feature import motion_wrench

FREE, TOUCHED, TRACKING, COLLECTING, HINTED = range(5)
# Status.
OK, BAD_WRENCH, NO_FEATURE = range(3)

WINDOW = 4  # Samples in an average.
SUSTAINED = 3
EARLY = 6  # Samples in a row near a centroid that confirm a known mode.
NEAR = 0.75  # Thresholds from a centroid that are near.
CONFIDENT = 0.6
SPEED_MIN = 0.008  # Slower than this it does not slide [m/s].
SLOW = 0.1  # Share of a sample in the slow mean.
TRACK = 0.01  # Share of a sample in the reference.
RUN_IN_SEC, RUN_IN_WAY = 0.1, 0.002  # Of sliding after a touch.
TOUCH_SAMPLES, LOST_SAMPLES = 2, 4
# In standard deviations of a sample of the wrench:
TRIGGER = 3.0  # a departure,
TOLERANCE = 1.8  # what keeps an averaged sample in its mode,
DRIFT_NOISE = 1.2  # and how far a stationary batch's halves may be apart.
# In thresholds, where that is more:
TRIGGER_BAND, DRIFT_BAND = 0.6, 0.3
R_CHANGE = 0.25  # Of R between the halves of the batch of a new mode.
HINT_WAY = 0.015  # Beyond a crossing, until a hint must have come true [m].
STIFF_SEC = 0.1  # After a departure, while the models follow the change.
BATCH_MAX = 64
TURNED = 0.98  # Cosine: another direction of pressing.


class ModeTuning(NamedTuple):
    """Constants of the detection."""

    threshold: float = 0.04  # BIRCH's, in units of the feature.
    force_noise: float = 0.1  # Standard deviation of a sample of the wrench [N].
    crossing: float = 0.0  # [m]
    batch: int = 15  # Samples.
    normal_force_min: float = 1.0  # Less is no contact [N].
    torque_arm: float = 0.0  # 0: the feature has no torque [m].
    tool_mass: float = 0.3  # [kg]
    period: float = 0.005  # [s]
    wrench_limit: float = 200.0  # At which the sensor saturates [N], [N m].

    @property
    def n_features(self) -> int:
        return 2 if self.torque_arm > 0.0 else 1


def _zeros(shape) -> Any:
    return field(default_factory=lambda: np.zeros(shape))


@dataclass(frozen=True, eq=False)
class ModeMemory:
    """All that the detector remembers, as a value."""

    table: ModeTable
    stage: int = FREE
    mode: int = FREE_MODE
    ring: np.ndarray = _zeros((0, 9))  # (<= WINDOW + 1, 9) wrench, v; newest last.
    rows: np.ndarray = _zeros(6)  # The force directions of the last sample.
    # The force directions and the mode before they were others.
    before_turn: tuple[np.ndarray, int] = (np.zeros(6), UNKNOWN_MODE)
    touching: int = 0  # Samples with normal force, negative: without.
    reference: np.ndarray = _zeros(0)  # (d,) What the feature was, empty: unknown.
    slow: float = 0.0  # Slow mean of the departure [N].
    over: int = 0  # Samples in a row that depart.
    strays: int = 0  # Samples in a row that are nearest to another mode.
    quiet_time: float = 0.0  # Of the last sample that did not depart at all [s].
    change_time: float = 0.0  # Of the first one that did.
    way: float = 0.0  # Gone since then, or since the touch [m],
    slid: int = 0  # and samples of sliding,
    across: int = 0  # and those of them after the crossing.
    features: np.ndarray = _zeros((0, 2))  # (n, d) The batch, newest last,
    forces: np.ndarray = _zeros(0)  # (n,) and R of each.
    hint: int = UNKNOWN_MODE  # The last one given.
    hint_from: int = UNKNOWN_MODE  # The mode before it.
    departed: bool = False  # Since a hint: the change has been felt.
    confidence: tuple[float, float] = (0.0, 0.0)
    is_new: bool = False
    transition: tuple[float, ...] = (0.0,) * N_TRANSITION
    touch_mode: tuple[float, ...] = (0.0,) * N_TOUCH_MODE
    collecting: bool = False
    status: int = NO_FEATURE

    @property
    def undecided(self) -> bool:
        """Whether the mode may be another one than `mode`."""
        return self.stage in (TOUCHED, COLLECTING, HINTED)

    def __post_init__(self):
        for name in ("ring", "rows", "reference", "features", "forces"):
            getattr(self, name).setflags(write=False)

    def __copy__(self):
        return self

    def __deepcopy__(self, _):
        return self


def replace(memory: ModeMemory, **changes) -> ModeMemory:
    """As dataclasses.replace, whose call of the constructor takes ten times as long."""
    new = object.__new__(ModeMemory)
    vars(new).update(vars(memory), **changes)
    for value in changes.values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
    return new


@numba.njit(cache=True)
def contact_feature(ring, rows, tool_mass, torque_arm, period):
    """The feature of averaged samples, with R and the speed.

    Args: ring (n, 9) wrench and velocity v of successive samples, 2 or more; rows (6,)
        as motion_wrench; tool_mass [kg], whose inertia the sensor feels; torque_arm
        [m]; period between samples [s].
    Returns: (4,) |F_t| / R, |tau| / (R arm) (0 without an arm), R [N], |v| of the
        newest sample, in the motion subspace [m/s].
    """
    n = ring.shape[0]
    mean = np.zeros(6)
    for k in range(1, n):
        for i in range(6):
            mean[i] += ring[k, i] / (n - 1)
    v = np.zeros(6)
    for i in range(3):
        # The mean acceleration over just these samples.
        mean[i] += (
            tool_mass * (ring[n - 1, 6 + i] - ring[0, 6 + i]) / (period * (n - 1))
        )
        v[i] = ring[n - 1, 6 + i]
    split, moving = motion_wrench(mean, rows), motion_wrench(v, rows)
    F, tau, speed = 0.0, 0.0, 0.0
    for i in range(3):
        F += split[i] ** 2
        tau += split[3 + i] ** 2
        speed += moving[i] ** 2
    out = np.zeros(4)
    out[2], out[3] = split[6], np.sqrt(speed)
    R = max(split[6], 1e-6)
    out[0] = np.sqrt(F) / R
    if torque_arm > 0.0:
        out[1] = np.sqrt(tau) / (R * torque_arm)
    return out


def is_turned(rows, before) -> bool:
    """Whether the directions of pressing (6,) are others than before."""
    for k in (0, 3):
        a, b = rows[k : k + 3], before[k : k + 3]
        length = np.sqrt((a @ a) * (b @ b))
        if length > 0.0 and a @ b < TURNED * length:
            return True
        if length == 0.0 and (a @ a) + (b @ b) > 0.0:
            return True
    return False


def detect(
    memory: ModeMemory,
    tuning: ModeTuning,
    time: float,
    wrench,
    velocity,
    direction,
    force_directions,
    hint: float = UNKNOWN_MODE,
    touch_hint: float = UNKNOWN_MODE,
) -> ModeMemory:
    """The memory after one sample.

    Args: time [s]; wrench (6,) on the tool, force first [N], [N m]; velocity (6,)
        [m/s], [rad/s]; direction (3,) of the target motion, zero at rest;
        force_directions (6,); hint: the number of the mode that begins here,
        UNKNOWN_MODE: none; touch_hint: of the mode that a touch here brings.

    A wrench that is not finite or at its limit changes nothing but the status, and the
    averages start again after it.
    """
    rows = np.array(force_directions, dtype=float)
    values = np.concatenate([wrench, velocity[:3], rows, direction])
    in_range = np.max(np.abs(wrench)) < tuning.wrench_limit
    if not (np.all(np.isfinite(values)) and in_range):
        return replace(
            memory, ring=memory.ring[:0], over=0, strays=0, slow=0.0, status=BAD_WRENCH
        )
    ring = np.concatenate([memory.ring[-WINDOW:], values[None, :9]])
    if is_turned(rows, memory.rows):
        # Pressed as before the last such change, it is likely to slide on what it did.
        earlier, mode = memory.before_turn
        if is_turned(rows, earlier):
            mode = memory.mode
        if memory.stage in (TRACKING, COLLECTING, HINTED):
            memory = replace(memory, before_turn=(memory.rows, memory.mode))
        memory = replace(memory, ring=ring[:0], rows=rows, status=NO_FEATURE)
        if memory.stage != FREE:
            memory = _touched(memory, time, mode)
        return memory
    memory = _hinted(replace(memory, ring=ring, rows=rows), hint)
    memory = _contact(memory, tuning, time, float(motion_wrench(ring[-1, :6], rows)[6]))
    if memory.stage == TOUCHED:
        hinted = int(touch_hint) if np.isfinite(touch_hint) else UNKNOWN_MODE
        if 1 <= hinted <= len(memory.table):
            memory = replace(memory, mode=hinted)
    if memory.stage == FREE or len(ring) <= WINDOW:
        return replace(memory, status=NO_FEATURE)
    f = contact_feature(ring, rows, tuning.tool_mass, tuning.torque_arm, tuning.period)
    sliding = f[3] >= SPEED_MIN and np.any(values[15:] != 0.0)
    if not sliding or f[2] < tuning.normal_force_min:
        # What was averaged up to here belongs to another motion than what comes.
        return replace(
            memory,
            ring=ring[-1:],
            over=0,
            strays=0,
            features=memory.features[:0],
            forces=memory.forces[:0],
            collecting=memory.collecting and memory.stage in (COLLECTING, HINTED),
            status=NO_FEATURE,
        )
    feature, R = f[: tuning.n_features].copy(), float(f[2])
    memory = replace(
        memory,
        way=memory.way + float(f[3]) * tuning.period,
        slid=memory.slid + 1,
        status=OK,
    )
    if memory.stage == TRACKING:
        return _tracked(memory, tuning, time, feature, R)
    if memory.stage == HINTED and not memory.departed:
        memory = _verified(memory, tuning, time, feature, R)
        if not memory.departed:
            return memory
    return _collected(memory, tuning, time, feature, R)


def _hinted(memory: ModeMemory, hint: float) -> ModeMemory:
    """The memory after a hint: a known mode is used at once, once per hint."""
    hinted = int(hint) if np.isfinite(hint) else UNKNOWN_MODE
    if hinted == memory.hint:
        return memory
    memory = replace(memory, hint=hinted)
    known = 1 <= hinted <= len(memory.table)
    if not known or hinted == memory.mode or memory.mode < 1:
        return memory
    if memory.stage == TRACKING:
        return replace(
            memory,
            stage=HINTED,
            hint_from=memory.mode,
            mode=hinted,
            departed=False,
            way=0.0,
            slid=0,
            features=memory.features[:0],
            forces=memory.forces[:0],
            collecting=True,
            is_new=False,
        )
    if memory.stage == COLLECTING:
        return replace(
            memory,
            stage=HINTED,
            hint_from=memory.mode,
            mode=hinted,
            departed=True,
            collecting=True,
            is_new=False,
        )
    return memory


def _contact(memory: ModeMemory, tuning: ModeTuning, time, R) -> ModeMemory:
    """The memory after the normal force R [N] of a sample: contact made or lost."""
    count = memory.touching
    if R > tuning.normal_force_min:
        count = max(count, 0) + 1
    elif R < 0.5 * tuning.normal_force_min:
        count = min(count, 0) - 1
    memory = replace(memory, touching=count)
    if memory.stage == FREE and count >= TOUCH_SAMPLES:
        return _touched(memory, time, UNKNOWN_MODE)
    if memory.stage != FREE and count <= -LOST_SAMPLES:
        return replace(
            memory,
            stage=FREE,
            mode=FREE_MODE,
            is_new=False,
            collecting=False,
            confidence=(0.0, 0.0),
            status=NO_FEATURE,
        )
    return memory


def _touched(memory: ModeMemory, time, mode) -> ModeMemory:
    """The memory when a contact begins or a direction of pressing changes."""
    return replace(
        memory,
        stage=TOUCHED,
        mode=mode,
        change_time=time,
        way=0.0,
        slid=0,
        features=memory.features[:0],
        forces=memory.forces[:0],
        collecting=False,
        is_new=False,
    )


def _departure(memory: ModeMemory, tuning: ModeTuning, feature, R):
    """The distance of the feature from its reference, signed, and the least distance
    that is a departure, both as forces [N]."""
    difference = float(np.sqrt(np.sum((feature - memory.reference) ** 2))) * R
    # The mean of a magnitude would never vanish: the sign of its change is kept.
    sign = 1.0 if feature[0] >= memory.reference[0] else -1.0
    least = max(TRIGGER * tuning.force_noise, TRIGGER_BAND * tuning.threshold * R)
    return sign * difference, least


def _watched(memory: ModeMemory, tuning: ModeTuning, time, feature, R):
    """Counts the samples that depart. Returns: the memory; whether the feature has
    departed."""
    departure, least = _departure(memory, tuning, feature, R)
    slow = memory.slow + SLOW * (departure - memory.slow)
    over = memory.over + 1 if abs(departure) > least else 0
    quiet = memory.quiet_time
    if abs(departure) < 0.5 * least:
        quiet = time
    memory = replace(memory, slow=slow, over=over, quiet_time=quiet)
    departed = over >= SUSTAINED or abs(slow) > 0.5 * least
    if departed:
        # A step shows in the first average that it enters: it came between the two.
        change = min(quiet + 0.5 * tuning.period, time)
        memory = replace(memory, change_time=change, over=0, slow=0.0)
    return memory, departed


def _tracked(memory: ModeMemory, tuning: ModeTuning, time, feature, R) -> ModeMemory:
    """TRACKING: the reference follows the feature slowly until it departs."""
    memory, departed = _watched(memory, tuning, time, feature, R)
    if memory.quiet_time == time:
        memory = replace(memory, way=0.0)  # The way counts from the change on.
    nearest, _ = memory.table.nearest(feature)
    strays = memory.strays + 1 if nearest != memory.mode else 0
    if departed or strays >= 2 * tuning.batch:
        return replace(
            memory,
            stage=COLLECTING,
            change_time=memory.change_time if departed else time,
            strays=0,
            way=memory.way if departed else 0.0,
            slid=0,
            features=feature[None],
            forces=np.array([R]),
            collecting=True,
        )
    reference = memory.reference + TRACK * (feature - memory.reference)
    centroid = memory.table.centroids[memory.mode - 1]
    offset = reference - centroid
    size = np.sqrt(np.sum(offset**2))
    if size > BAND * tuning.threshold:  # It does not drift out of its mode.
        reference = centroid + offset * (BAND * tuning.threshold / size)
    return replace(memory, reference=reference, strays=strays)


def _verified(memory: ModeMemory, tuning: ModeTuning, time, feature, R) -> ModeMemory:
    """HINTED: the change must be felt within `crossing` + HINT_WAY, else the mode is
    again the one before the hint."""
    memory, departed = _watched(memory, tuning, time, feature, R)
    if departed:
        return replace(
            memory,
            departed=True,
            way=0.0,
            slid=0,
            features=memory.features[:0],
            forces=memory.forces[:0],
        )
    if memory.way < tuning.crossing + HINT_WAY:
        return memory
    # It was not, or the two modes are too near to each other for a departure.
    nearest, _ = memory.table.nearest(feature)
    if nearest == memory.mode:
        return replace(memory, departed=True, change_time=time)
    return replace(
        memory,
        stage=TRACKING,
        mode=memory.hint_from,
        over=0,
        slow=0.0,
        collecting=False,
    )


def _collected(memory: ModeMemory, tuning: ModeTuning, time, feature, R) -> ModeMemory:
    """COLLECTING, TOUCHED, and HINTED after the departure: decides when it can."""
    features = np.concatenate([
        memory.features.reshape(-1, feature.size)[-BATCH_MAX + 1 :], feature[None]
    ])  # fmt: skip
    forces = np.append(memory.forces[-BATCH_MAX + 1 :], R)
    needed, delay = tuning.crossing, WINDOW
    if memory.stage == TOUCHED:
        needed, delay = RUN_IN_WAY, max(WINDOW, round(RUN_IN_SEC / tuning.period))
    across = memory.across + 1 if memory.way >= needed else 0
    memory = replace(memory, across=across)
    if memory.slid <= delay or across <= WINDOW:
        # Still on both sides, or in the average of both: none of it counts.
        return replace(
            memory,
            features=features[:0],
            forces=forces[:0],
            collecting=memory.stage != COLLECTING
            or time - memory.change_time < STIFF_SEC,
        )
    memory = replace(memory, features=features, forces=forces, collecting=True)
    noise = TOLERANCE * tuning.force_noise / R
    if len(features) >= EARLY:
        last = features[-EARLY:]
        mode, distance = memory.table.nearest(last.mean(axis=0))
        fractions = memory.table.fractions(last, noise)
        if (
            distance <= max(NEAR * tuning.threshold, 0.5 * noise)
            and fractions[mode - 1] >= 1.0
            and is_stationary(last, forces[-EARLY:], tuning)
        ):
            return _decided(memory, tuning, time, mode, fractions, last)
    if len(features) < tuning.batch:
        return memory
    last, forces = features[-tuning.batch :], forces[-tuning.batch :]
    if not is_stationary(last, forces, tuning):
        return memory
    fractions = memory.table.fractions(last, noise)
    if len(fractions) and fractions.max() >= CONFIDENT:
        mode = int(np.argmax(fractions)) + 1
        return _decided(memory, tuning, time, mode, fractions, last)
    half = len(forces) // 2
    change = abs(forces[-half:].mean() - forces[:half].mean())
    if change > R_CHANGE * forces.mean():
        return memory
    return _decided(memory, tuning, time, len(memory.table) + 1, fractions, last)


def is_stationary(features, forces, tuning: ModeTuning) -> bool:
    """Whether the halves of a batch (n, d) have the same mean, within the noise."""
    half = len(features) // 2
    difference = features[-half:].mean(axis=0) - features[:half].mean(axis=0)
    bound = max(
        DRIFT_NOISE * tuning.force_noise / forces.mean(),
        DRIFT_BAND * tuning.threshold,
    )
    return bool(np.sqrt(np.sum(difference**2)) <= bound)


def _decided(memory, tuning, time, mode, fractions, batch) -> ModeMemory:
    """The memory after the decision that the batch (n, d) belongs to `mode`."""
    is_new = mode > len(memory.table)
    if is_new:
        # What the new cluster holds of its own batch; the best of the others beside it.
        second = float(fractions.max()) if len(fractions) else 0.0
        confidence = (1.0 - float(fractions.sum()), second)
    else:
        others = np.delete(fractions, mode - 1)
        second = float(others.max()) if len(others) else 0.0
        confidence = (float(fractions[mode - 1]), second)
    before = memory.hint_from if memory.stage == HINTED else memory.mode
    transition = memory.transition
    # Making contact is the contact detector's to tell: a transition is a change of
    # what the tool slides on.
    if memory.stage != TOUCHED and before >= 1 and mode != before:
        transition = (
            transition[0] + 1.0,
            memory.change_time,
            float(before),
            float(mode),
            float(is_new),
            time,
        )
    touch_mode = memory.touch_mode
    if memory.stage == TOUCHED:
        touch_mode = (touch_mode[0] + 1.0, float(mode))
    return replace(
        memory,
        table=memory.table.learned(batch, mode),
        stage=TRACKING,
        mode=mode,
        reference=batch.mean(axis=0),
        slow=0.0,
        over=0,
        strays=0,
        quiet_time=time,
        features=memory.features[:0],
        forces=memory.forces[:0],
        hint_from=UNKNOWN_MODE,
        departed=False,
        confidence=confidence,
        is_new=is_new,
        transition=transition,
        touch_mode=touch_mode,
        collecting=False,
    )


def warm_up(tuning: ModeTuning) -> None:
    """Compiles the feature, for arrays as `detect` makes them."""
    ring, rows = np.zeros((WINDOW + 1, 9)), np.zeros(6)
    ring.setflags(write=False)
    rows.setflags(write=False)
    motion_wrench(ring[-1, :6], rows)
    contact_feature(ring, rows, tuning.tool_mass, tuning.torque_arm, tuning.period)

"""Forward models of contact, one per mode: what wrench the next sample will bring.

    S_t = [|v|, |w|, |F_t|, |tau|]   D_t = [|F_t|, |tau|]   X_t = [S_{t-1}, D_t]

of which an incremental Gaussian mixture is learned (igmm.py), and f: S_t -> D_{t+1} is
the regression from it. F_t is the force without its parts along the directions of force
control: with the normal force in it the feed-forward would be several times too large.
Magnitudes do not depend on the direction of motion; the wrench that is predicted acts
against it.

A model that sees the last force says, in the main, that nothing will change. So where a
mode was announced before it begins, its model is asked without the last force, which is
still the old surface's: E[D | |v|, |w|]. That is a *hand-over*. It lasts for a short
time, in which nothing is learned. A tool that stands on two rows of feet crosses a seam
in two steps: at first the share of the difference that the first row carries is handed
over, the whole when it has gone from one row to the other. In between it stands on two
surfaces, of which no mode's model is true: the force that is felt is predicted, and
nothing is learned.

The same holds for a motion that begins from rest (`from_rest`): there the last force is
that of the tool at rest. So the friction of the commanded motion is predicted before it
is felt, mu R min(1, v/SLIDING) against the motion, with mu the mean |F_t|/R of the mode
so far, R the normal force and v the commanded speed. In a mode that is not known yet,
the last force is predicted.

Source: CC section 3.1, eq. 2, 3, 5, 6.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from makebreak.systems.changing_contact.numerics.contact_task import UNKNOWN_MODE
from makebreak.systems.changing_contact.numerics.igmm import (
    IgmmConfig,
    IgmmTuning,
    Mixture,
    as_vector,
    empty_mixture,
    from_vector,
    igmm_tuning,
    learned,
    regress,
)
from makebreak.systems.changing_contact.numerics.motion_feature import (
    magnitudes,
    motion_wrench,
)

# Status.
OK, BAD_WRENCH, NO_MODEL = range(3)

# sigma_ini and entries of [|v|, |w|, |F_t|, |tau|, |F_t|', |tau|'].
_SIGMA = np.array([0.02, 0.05, 0.3, 0.05, 0.3, 0.05])
_WITH_TORQUE, _FORCE_ONLY = [0, 1, 2, 3, 4, 5], [0, 2, 4]


@dataclass(frozen=True, eq=False)
class ModelBank:
    """One mixture per mode, numbered from 1: what a ForwardModelBank knows."""

    models: tuple[tuple[int, Mixture], ...] = ()
    with_torque: bool = True
    # Of each mode and number of surfaces pressed (3,): mean |F_t|/R, |tau|/R [m], and
    # the samples that they rest on. Pressed on a table and a wall, a tool has the mean
    # friction of both, in the mode of the table if that is much the same.
    friction: tuple[tuple[tuple[int, int], np.ndarray], ...] = ()

    def __copy__(self):
        return self

    def __deepcopy__(self, _):
        return self

    def get(self, mode: int) -> Mixture | None:
        """The model of a mode, None if it has none."""
        for known, mixture in self.models:
            if known == mode:
                return mixture
        return None

    def put(self, mode: int, mixture: Mixture) -> "ModelBank":
        """The bank with the model of one mode replaced or added."""
        models = [(k, mixture if k == mode else m) for k, m in self.models]
        if self.get(mode) is None:
            models.append((mode, mixture))
        return replace(self, models=tuple(models))

    def ratios(self, mode: int, surfaces: int = 1) -> np.ndarray | None:
        """(2,) mean |F_t|/R and |tau|/R [m] of a mode with so many surfaces pressed;
        None: too few samples."""
        mean = dict(self.friction).get((mode, surfaces))
        return mean[:2] if mean is not None and mean[2] >= SUPPORT_MIN else None

    def with_sample(self, mode: int, surfaces: int, ratios) -> "ModelBank":
        """The bank after a sample of ratios (2,) in a mode."""
        known, key = dict(self.friction), (mode, surfaces)
        mean = known.get(key, np.zeros(3))
        n = min(mean[2] + 1.0, FRICTION_SAMPLES)
        new = np.append(mean[:2] + (ratios - mean[:2]) / n, n)
        new.setflags(write=False)
        return replace(self, friction=tuple({**known, key: new}.items()))

    def save(self, path: str | Path) -> None:
        """Writes it as JSON."""
        friction = [[*key, *mean.tolist()] for key, mean in self.friction]
        rows = {str(mode): as_vector(mixture).tolist() for mode, mixture in self.models}
        n_max = self.models[0][1].mean.shape[0] if self.models else 0
        Path(path).write_text(
            json.dumps(
                {
                    "with_torque": self.with_torque,
                    "n_max": n_max,
                    "models": rows,
                    "friction": friction,
                }
            )
            + "\n"
        )

    @staticmethod
    def load(path: str | Path) -> "ModelBank":
        """What `save` wrote.

        Raises: ValueError if the file is missing or is no bank.
        """
        try:
            data = json.loads(Path(path).read_text())
            with_torque = bool(data["with_torque"])
            tuning = bank_tuning(with_torque, n_max=max(int(data["n_max"]), 1))
            return ModelBank(
                tuple(
                    (int(mode), from_vector(vector, tuning))
                    for mode, vector in data["models"].items()
                ),
                with_torque,
                tuple(
                    ((int(mode), int(n)), np.array(mean, dtype=float).reshape(3))
                    for mode, n, *mean in data.get("friction", [])
                ),
            )
        except (OSError, KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(
                f"forward models {path}: {' '.join(str(error).split())}"
            ) from None


def bank_tuning(with_torque: bool, **changes) -> IgmmTuning:
    """Constants of the mixtures of a bank. Args: changes of IgmmConfig's defaults."""
    entries = _WITH_TORQUE if with_torque else _FORCE_ONLY
    settings = {"floor": 0.1, "sp_max": 2000.0} | changes
    return igmm_tuning(IgmmConfig(sigma_ini=_SIGMA[entries].tolist(), **settings))


@dataclass(frozen=True, eq=False)
class BankMemory:
    """All that a ForwardModelBank remembers, as a value."""

    bank: ModelBank
    mode: int = UNKNOWN_MODE
    # S_t of the last good sample, None after a gap.
    state: np.ndarray | None = None
    # (2,) predicted |F_t|, |tau| for the next sample [N], [N m].
    predicted: np.ndarray = None  # type: ignore[assignment]
    error: float = 0.0  # eps_t, low-passed [N].
    wrench: np.ndarray = None  # type: ignore[assignment]
    status: int = NO_MODEL
    # A hand-over: |F_t|, |tau| before it, None: there is none; the way since [m], and
    # the samples that the step of now is still handed over for.
    before: np.ndarray | None = None
    way: float = 0.0
    left: int = 0
    count: float = 0.0  # Of mode changes that were confirmed.
    # (2,) what the model has been off by of late, in `predicted` already [N], [N m].
    offset: np.ndarray = None  # type: ignore[assignment]
    normal: float = 0.0  # R, low-passed [N].
    load: float = 0.5  # Share of R on the first row of feet, low-passed.
    starting: int = 0  # Samples for which friction is predicted from the command.
    ahead: bool = False  # What is predicted has not been felt yet.

    def __post_init__(self):
        for name, size in (("predicted", 2), ("wrench", 6), ("offset", 2)):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.zeros(size))
            getattr(self, name).setflags(write=False)

    def __copy__(self):
        return self

    def __deepcopy__(self, _):
        return self


@dataclass(frozen=True, eq=False)
class BankTuning:
    """Constants of a bank."""

    mixtures: IgmmTuning
    with_torque: bool
    learns: bool  # False: the models stay as they were given.
    smoothing: float  # Of the error, per sample: 1 is none.
    wrench_limit: float  # At which the sensor saturates [N], [N m].
    error_unknown: float  # What the error is said to be without a wrench [N].
    handover: int = 10  # Samples for which a step is handed over; 0: never.
    rows: float = 0.0  # From the first row of feet to the second; 0: one point [m].
    height: float = 0.0  # Of the tip above the feet; 0: both rows carry half [m].
    period: float = 0.005  # [s]
    correction: float = 0.0  # Of the offset, per sample; 0: there is none.
    from_rest: bool = False  # The friction of a motion that begins is predicted.


def observe(
    memory: BankMemory,
    tuning: BankTuning,
    wrench,
    velocity,
    direction,
    force_directions,
    mode: int,
    changes: float | None = None,
    speed_desired: float = 0.0,
    undecided: bool = False,
) -> BankMemory:
    """The memory after one sample: the last prediction's error, learning, the next one.

    Args: wrench (6,), velocity (6,), direction (3,) of the target motion, zero at rest,
        force_directions (6,) as motion_wrench; mode, of contact_task.py; changes: how
        many changes of mode were confirmed so far. A mode that changes without one was
        announced; None: none is; speed_desired, of the tip along direction, when what
        is predicted now reaches the arm [m/s]; undecided: whether the mode may be
        another one.

    A mode without a model gets an empty one, which predicts that nothing will change
    until it has learned (if nothing is learned: zero). In FREE_MODE and UNKNOWN_MODE
    the prediction is zero, and the error the force that is there; with from_rest, in
    UNKNOWN_MODE the prediction is the last force. A wrench that is not
    finite or at its limit teaches nothing: the prediction is zero, and the error
    error_unknown.
    """
    finite = np.all(np.isfinite(wrench)) and np.all(np.isfinite(velocity))
    if not finite or np.max(np.abs(wrench)) >= tuning.wrench_limit:
        error = tuning.error_unknown
        return BankMemory(memory.bank, mode, error=error, status=BAD_WRENCH)
    size = magnitudes(wrench, velocity, force_directions)
    actual = size[2:4]
    # The error of the prediction that was made for this sample.
    error = abs(actual[0] - memory.predicted[0])
    if memory.status == BAD_WRENCH:
        smoothed = error
    else:
        smoothed = memory.error + tuning.smoothing * (error - memory.error)
    normal = memory.normal + tuning.smoothing * (size[4] - memory.normal)
    starting = _starting(memory, tuning, size[0], speed_desired)
    load = memory.load
    if memory.before is None and tuning.rows > 0.0 and tuning.height > 0.0:
        ahead = load_ahead(
            wrench, direction, force_directions, tuning.rows, tuning.height
        )
        load += LOAD_SMOOTHING * (ahead - load)
    if mode < 1:
        predicted, acting = np.zeros(2), np.zeros(6)
        if tuning.from_rest and mode == UNKNOWN_MODE:
            predicted = actual.copy()
            acting = against_motion(predicted, direction, velocity, force_directions)
        return BankMemory(
            memory.bank, mode, predicted=predicted, error=smoothed, wrench=acting,
            normal=normal, load=load, starting=starting,
        )  # fmt: skip
    bank = memory.bank
    mixture = bank.get(mode)
    if mixture is None:
        mixture = empty_mixture(tuning.mixtures)
        bank = bank.put(mode, mixture)
    state = size[:4].copy() if tuning.with_torque else size[[0, 2]]
    offset = np.zeros(2)
    if mode == memory.mode and memory.state is not None and memory.left == 0:
        # One step ahead a model returns towards its mean by a share of what the force
        # is off by: a small offset that stays, where the force does.
        off = actual - (memory.predicted - memory.offset)
        off = np.clip(off, -OFFSET_MOST, OFFSET_MOST)
        offset = memory.offset + tuning.correction * (off - memory.offset)
    memory = _handing_over(memory, tuning, mixture, actual, size[0], mode, changes)
    surfaces = int(motion_wrench(wrench, force_directions)[7])
    ratios = bank.ratios(mode, surfaces)
    begins = starting > 0 and speed_desired > 0.0 and ratios is not None
    if memory.left > 0 or begins:
        # What is fed forward belongs to a place that the tool is about to reach, or to
        # a motion that is about to begin: it cannot be judged by what the sensor says
        # meanwhile.
        smoothed = memory.error
    crossing = memory.before is not None
    if tuning.learns and memory.state is not None and not crossing:
        x = np.concatenate([memory.state, actual if tuning.with_torque else actual[:1]])
        mixture, _ = learned(mixture, x, tuning.mixtures)
        bank = bank.put(mode, mixture)
        if not starting and not undecided and size[0] > SLIDING and size[4] > PRESSED:
            bank = bank.with_sample(mode, surfaces, actual / size[4])
    predicted = np.zeros(2)
    if mixture.count:
        n = 2 if tuning.with_torque else 1
        predicted[:n] = regress(mixture, state)[0]
    elif tuning.learns:
        predicted[:] = actual  # Nothing is known but this.
    if memory.left == 0 and mixture.count:
        predicted = predicted + offset
    else:
        offset = np.zeros(2)
    if crossing and memory.left == 0:
        # On two surfaces at once: the force that is felt, with less of its noise.
        predicted = memory.predicted + BETWEEN_SMOOTHING * (actual - memory.predicted)
        offset = np.zeros(2)
    if memory.before is not None and memory.left > 0:
        whole = memory.way >= tuning.rows
        predicted = _without_force(mixture, state, tuning.with_torque)
        if tuning.from_rest and ratios is not None:
            predicted = ratios * normal
        predicted = memory.before + (1.0 if whole else load) * (
            predicted - memory.before
        )
    if begins and memory.left == 0:
        predicted = ratios * normal * min(1.0, speed_desired / SLIDING)
        offset = np.zeros(2)
    # A magnitude; and an extrapolation is not to be trusted beyond what the sensor can
    # feel.
    predicted = np.clip(predicted, 0.0, tuning.wrench_limit)
    return BankMemory(
        bank,
        mode,
        state,
        predicted,
        smoothed,
        against_motion(predicted, direction, velocity, force_directions),
        OK if mixture.count or tuning.learns else NO_MODEL,
        memory.before,
        memory.way,
        memory.left,
        memory.count,
        offset,
        normal,
        load,
        starting,
        begins or memory.left > 0,
    )


# Slower than this the tool does not slide [m/s]; less is no normal force [N].
SLIDING, PRESSED = 0.008, 1.0
# After so many samples of sliding a motion has begun: the 30 ms in which the force of
# rest has left the filters.
START_SAMPLES = 6
FRICTION_SAMPLES = 200.0  # That the mean |F_t|/R of a mode rests on, at most.


def _starting(memory, tuning, speed, speed_desired) -> int:
    """For how many samples more the motion is one that begins from rest."""
    if not tuning.from_rest:
        return 0
    if speed < SLIDING and memory.starting == START_SAMPLES:
        return START_SAMPLES
    if speed < SLIDING and speed_desired < SLIDING:
        return START_SAMPLES
    return max(memory.starting - 1, 0)


# More than that of |F_t|, |tau| in one sample is a change or an impact, which the model
# follows by itself, and no offset [N], [N m].
OFFSET_MOST = np.array([0.3, 0.03])
# Weights of the newest sample in the share of load (100 ms) and in the force between
# the two rows, which does not change (25 ms).
LOAD_SMOOTHING, BETWEEN_SMOOTHING = 0.05, 0.2
# A model that has seen fewer samples than this is not handed over.
SUPPORT_MIN = 20.0


def _handing_over(memory, tuning, mixture, actual, speed, mode, changes) -> BankMemory:
    """The memory with the state of the hand-over: begun, gone on, or over."""
    confirmed = changes is None or changes != memory.count
    count = memory.count if changes is None else changes
    if (
        not confirmed
        and tuning.handover > 0
        and mode != memory.mode
        and memory.mode >= 1
        and mixture.support.sum() >= SUPPORT_MIN
    ):
        # The mean of what was said and what is: less noise than either.
        before = 0.5 * (actual + memory.predicted)
        return replace(
            memory, before=before, way=0.0, left=tuning.handover, count=count
        )
    if memory.before is None:
        return replace(memory, count=count)
    way = memory.way + speed * tuning.period
    left = max(memory.left - 1, 0)
    before = memory.before
    if memory.way < tuning.rows <= way:
        left = tuning.handover
    elif left == 0 and way >= tuning.rows or mode != memory.mode:
        before, left = None, 0
    return replace(memory, before=before, way=way, left=left, count=count)


def load_ahead(wrench, direction, force_directions, rows, height) -> float:
    """The share of the normal force on the first of two rows of feet, 0 to 1.

    Rows at height h below the tip, a before and behind it, with normal forces N_1, N_2
    and a friction F against the motion d. About the tip, with the pressing n,

        tau . (d x n) = h F - a (N_1 - N_2)

    Args: wrench (6,), direction (3,), force_directions (6,) as motion_wrench; rows: 2 a
        [m]; height: h [m].
    Returns: 1/2 where the tool is pressed in no direction, or in two.
    """
    split = motion_wrench(wrench, force_directions)
    d = motion_part(direction, force_directions)
    length = np.sqrt(d @ d)
    if split[7] != 1.0 or split[6] < PRESSED or length < 1e-6:
        return 0.5
    d = d / length
    n = force_directions[:3] if force_directions[:3].any() else force_directions[3:]
    about = np.cross(d, n / np.sqrt(n @ n))
    friction, moment = -float(split[:3] @ d), float(split[3:6] @ about)
    difference = 2.0 * (height * friction - moment) / rows
    return float(np.clip(0.5 + 0.5 * difference / split[6], 0.0, 1.0))


def _without_force(mixture, state, with_torque) -> np.ndarray:
    """(2,) |F_t|, |tau| that a model has at this speed, whatever the last force was."""
    n = 2 if with_torque else 1
    j = int(np.argmax(mixture.support[: mixture.count]))
    k = slice(j, j + 1)
    best = Mixture(
        mixture.mean[k], mixture.factor[k], mixture.support[k], mixture.age[k], 1
    )
    # The best supported component: a mean of all would be drawn by rare events, such as
    # the impacts that end a motion.
    mean = regress(best, state[:n])[0]  # Of [|F_t|, |tau|, |F_t|', |tau|'].
    out = np.zeros(2)
    out[:n] = mean[n:]
    return out


# Slower than this, a direction of turning is noise [rad/s].
TURNING_MIN = 0.05


def against_motion(predicted, direction, velocity, force_directions) -> np.ndarray:
    """The wrench (6,) of magnitudes predicted (2,) against the motion.

    The force is along -direction (3,), without its parts along force_directions; the
    torque against the measured turning, zero where that is slower than TURNING_MIN.
    """
    wrench = np.zeros(6)
    d = motion_part(direction, force_directions)
    length = np.sqrt(np.sum(d * d))
    if length > 1e-6:
        wrench[:3] = -predicted[0] / length * d
    w = np.asarray(velocity)[3:]
    turning = np.sqrt(np.sum(w * w))
    if turning > TURNING_MIN:
        wrench[3:] = -predicted[1] / turning * w
    return wrench


def motion_part(direction, force_directions) -> np.ndarray:
    """direction (3,) without its parts along the rows of force_directions (6,)."""
    wrench = np.zeros(6)
    wrench[:3] = direction
    d = motion_wrench(wrench, force_directions)[:3]
    return d if np.all(np.isfinite(d)) else np.zeros(3)


def speed_along(x_desired, direction, lead_sec) -> float:
    """The speed of a reference (19,) along direction (3,), lead_sec from now [m/s].

    At rest, where direction is zero, 0.
    """
    v = x_desired[7:10] + lead_sec * x_desired[13:16]
    speed = float(v @ np.asarray(direction))
    return speed if np.isfinite(speed) else 0.0


def warm_up(tuning: BankTuning) -> None:
    """Compiles what a sample calls, for writeable arrays as a port gives them."""
    zero, n = np.zeros(6), np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    memory = BankMemory(ModelBank((), tuning.with_torque))
    for _ in range(3):
        memory = observe(memory, tuning, zero, zero, np.ones(3), n, 1)

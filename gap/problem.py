"""The contract between a kind of data and the search: what is asked of a problem.

A mechanism whose joints are measured (gap/residuals/mechanism.py), a tool that touches
an object (touch.py) and windows of free bodies (objects.py) are three such problems;
gap/search/select.py searches any of them, gap/workflow.py concludes from what it finds.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from makebreak.gap.data.recording import Recording
from makebreak.gap.numerics.selection import LinearFit
from makebreak.gap.result import GapMeasure, Series, Unexplained, Where
from makebreak.gap.thresholds import NESTED_GAIN, UNEXPLAINED_RMS, UNEXPLAINED_SHARE
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, check_parameters
from makebreak.models.effects.sizes import Sizes, range_of
from makebreak.models.scene import Scene

DISTANCES = "distances"  # A channel is judged by these alone: not its motion.
FEWEST_BLOCKS = 4  # Of time, of which one may be left out.
BEYOND = 1.5  # Times what a model can lose at most is taken for all of it.


@dataclass(frozen=True)
class SearchPlan:
    """How a problem is searched.

    evaluations: Gauss-Newton steps of a fit. diff_step: relative, of differences.
    jumps: whether errors jump with the parameters, so that searches without slopes are
    needed. least_gain: what an effect must take off the error, as a share of it.
    least_error: below it nothing tells two models apart. most_effects: that are named.
    shortlist: candidates that are fitted exactly before one is taken.
    alike: whether joints of a robot are: what all have is no less likely than what one
        has.
    simulation_agrees: whether agreement also needs simulated windows that agree.
    loud: rms over noise of one channel that is a gap, whatever the others leave.
    counts_evidence: whether evidence counts below the noise, too: rows are over the
        covariance that they have, and the law of contact is that of the data; or
        simulations show a gap where rows agree.
    evidence_alone: whether evidence is then enough for an effect, as it is of rows
        that do not jump.
    """

    evaluations: int = 8
    diff_step: float = 1e-4
    jumps: bool = False
    least_gain: float = NESTED_GAIN
    least_error: float = 0.0
    most_effects: int = 4
    by_channel: bool = False
    shortlist: int = 8
    alike: bool = False
    simulation_agrees: bool = False
    loud: float = 3.0
    counts_evidence: bool = False
    evidence_alone: bool = False


@dataclass(frozen=True, eq=False)
class Nuisances:
    """What may be slightly wrong in any model. columns (m, n_b), over the noise; prior
    (n_b,) standard deviations; reach: a coefficient is at most so many of them."""

    columns: np.ndarray
    prior: np.ndarray
    names: tuple[str, ...]
    reach: float = np.inf

    @staticmethod
    def none(m: int) -> "Nuisances":
        return Nuisances(np.zeros((m, 0)), np.zeros(0), ())


@dataclass(frozen=True, eq=False)
class Candidate:
    """A kind at a place: alternatives of linear columns, and how they are read.

    columns: (m, k) each, over the noise. size: parameters that a fit chooses. fixed:
    parameters that a fit leaves at neutral. least: what the model allows.
    members: of a group, which is fitted as one; its columns are theirs side by side.
    """

    kind: str
    at: tuple[str, ...]
    size: int
    columns: tuple[np.ndarray, ...]
    to_parameters: tuple[Callable, ...]
    fixed: tuple[str, ...] = ()
    least: Mapping[str, float] = field(default_factory=dict)
    members: tuple["Candidate", ...] = ()

    @property
    def name(self) -> str:
        if self.members:
            kinds = ", ".join(dict.fromkeys(m.kind for m in self.members))
            return f"{kinds} at {len(self.members)} places"
        return f"{self.kind} at {', '.join(self.at)}"

    def effects(self, alternative: int, c: np.ndarray) -> tuple[Effect, ...]:
        """What coefficients (k,) of an alternative say."""
        if not self.members:
            parameters = dict(self.to_parameters[alternative](c))
            for name, least in self.least.items():
                # Columns take what the model has for a little more than it is.
                if BEYOND * least <= parameters[name] < least:
                    parameters[name] = least
            return (Effect(self.kind, list(self.at), parameters),)
        found: list[Effect] = []
        first = 0
        for each in self.members:
            k = each.columns[0].shape[1]
            found += each.effects(0, c[first : first + k])
            first += k
        return tuple(found)

    def is_sane(self, effects: Sequence[Effect], sizes: Sizes | None) -> bool:
        """Whether effects of it are allowed, and of a size that robots have."""
        each = zip(effects, self.members or (self,), strict=True)
        return all(is_sane(e, sizes, c.least) for e, c in each)

    def fixed_of_each(self) -> tuple[tuple[str, ...], ...]:
        """Of each effect, the parameters that a fit leaves as they are."""
        return tuple(m.fixed for m in self.members) if self.members else (self.fixed,)


def rms(x: np.ndarray) -> float:
    """Root mean square; 0 of nothing."""
    return float(np.sqrt(np.mean(x**2))) if len(x) else 0.0


def is_sane(
    effect: Effect, sizes: Sizes | None, least: Mapping[str, float] | None = None
) -> bool:
    """Whether the parameters are allowed, and of a size that robots have.

    Args: sizes: of the scene, without which those that go with them may be any; least:
        what the model allows (SceneDynamics.least).
    """
    entry = KINDS[effect.kind]
    try:
        check_parameters(effect, entry)
    except ValueError:
        return False
    for each in entry.parameters:
        value = effect.parameters.get(each.name)
        if value is None or each.name == "phase" or each.endless:
            continue
        if value < (least or {}).get(each.name, -np.inf):
            return False
        low, high = range_of(each, effect.at, sizes)
        width = high - low
        if not low - 0.01 * width <= value <= high + 0.01 * width:
            return False
    return entry.plausible is None or entry.plausible(effect)


def share_left(before: float, after: float) -> float:
    """Of what is beyond the noise before, the share that is there after; errors are in
    units of the noise."""
    return max(after - 1.0, 0.0) / max(before - 1.0, 1e-9)


def leaves_gap(start: float, end: float) -> bool:
    """Whether effects that take an error from start to end leave more than laws that
    are approximations do. Errors are in units of the noise."""
    return end > max(UNEXPLAINED_RMS, UNEXPLAINED_SHARE * start)


@dataclass(frozen=True, eq=False)
class Fitted:
    """Effects with their best parameters. std: of each effect's parameters. r (m,):
    what they leave, before nuisances. left (m,): after them, of which b (n_b,) are the
    coefficients. rows (n,), J (n, k): training rows over the scale and the nuisances'
    own cost, and how they change with each parameter; names (k)."""

    effects: tuple[Effect, ...]
    std: tuple[dict[str, float], ...]
    r: np.ndarray
    left: np.ndarray
    b: np.ndarray
    fit: LinearFit
    J: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    rows: np.ndarray = field(default_factory=lambda: np.zeros(0))
    names: tuple[tuple[int, str], ...] = ()

    @property
    def score(self) -> float:
        return self.fit.score


@dataclass(frozen=True, eq=False)
class Outcome:
    """What the decided effects are worth on some data, by simulation where there is
    one, and what is left. expects: what counts as noise in it beside that of sensors,
    as sentences; "": nothing. where: windows without the effects stand out, of data
    that are reported on."""

    gap: GapMeasure
    series: Sequence[Series] = ()
    unexplained: Sequence[Unexplained] = ()
    expects: str = ""
    where: Sequence[Where] = ()


@dataclass(frozen=True, eq=False)
class Found:
    """An effect that a problem has found, and taken off the recordings, before the
    search; std of its parameters, and the error before and after."""

    effect: Effect
    std: dict[str, float]
    before: float
    after: float


class GapProblem(ABC):
    """Residuals of recordings under effects that a scene may lack.

    Rows are of the part of the recordings on which is decided: `train` of them are
    fitted, the others choose between models. The part that is reported on comes to
    `outcome` alone.
    """

    scene: Scene
    recordings: list[Recording]
    dynamics: SceneDynamics
    plan: SearchPlan
    # Whether rows are equations of motion; else they are samples of simulated windows,
    # or distances.
    by_equations: bool = True
    # Root of how many neighbouring rows say the same: their errors go together.
    correlation: float = 1.0

    @property
    def sizes(self) -> Sizes | None:
        """How large the scene is; None: not known, and no range goes with it."""
        return self.dynamics.sizes

    @abstractmethod
    def residual(self, effects: Sequence[Effect] = ()) -> np.ndarray:
        """(m,) over its noise, of the scene with these effects added.

        Raises: ValueError, RuntimeError for effects that the scene cannot have.
        """

    @abstractmethod
    def base(self) -> np.ndarray:
        """residual() of the scene as it came, kept."""

    @abstractmethod
    def train(self) -> np.ndarray:
        """(m,) which rows are fitted."""

    @abstractmethod
    def blocks(self) -> np.ndarray:
        """(m,) number of the block of time, window or touch of each row."""

    @abstractmethod
    def channel_of_rows(self) -> np.ndarray:
        """(m,) number of the channel, or of the joint's equation, of each row."""

    @abstractmethod
    def nuisances(self) -> Nuisances: ...

    def least(self, kind: str, at: Sequence[str]) -> dict[str, float]:
        """Lower bounds of parameters: what the model allows, and what the data do."""
        return self.dynamics.least(kind, at)

    def prior_rows(self, effects: Sequence[Effect]) -> np.ndarray:
        """(n,) what is known of parameters beforehand, in deviations: of those that
        data may leave open."""
        return np.zeros(0)

    def replaced(self, effects: Sequence[Effect]) -> np.ndarray | None:
        """(n_b,) which nuisances mean nothing beside these effects, which stand in the
        place of what they change; None: all go on."""
        return None

    @abstractmethod
    def candidates(self, nuisances: Nuisances, current: Fitted) -> Sequence[Candidate]:
        """Every effect that could be added to what is there."""

    @abstractmethod
    def where(self, left: np.ndarray) -> list[Where]:
        """Where residuals (m,) stand out."""

    @abstractmethod
    def outcome(
        self,
        effects: Sequence[Effect],
        start: Fitted,
        end: Fitted,
        nuisances: Nuisances,
        recordings: Sequence[Recording] | None = None,
        jobs: int = 1,
    ) -> Outcome | None:
        """What effects are worth.

        Args: start, end: the fits without and with them. recordings: the part that is
            reported on; None: the rows that were chosen on.
        Returns: None where these recordings hold nothing to compare.
        """

    def in_noise(self, left: np.ndarray) -> np.ndarray:
        """Rows (m,) over the sensors' noise alone, without what models are off by."""
        return left

    def noise_error(self, left: np.ndarray) -> float:
        """Rms of the rows (m,) that choose, over the sensors' noise alone."""
        held = self.in_noise(left)[~self.train()]
        held = held if len(held) else self.in_noise(left)
        return float(np.sqrt(np.mean(held**2)))

    def loudest(self, fitted: Fitted) -> tuple[str, float]:
        """The channel, or equation, of which all rows together leave most of the noise,
        and how many times that; no name where it is not asked."""
        return "", 0.0

    def found_before(self) -> list[Found]:
        """Effects that were found, and taken off the recordings, before the search."""
        return []

    def is_within_law(self, effect: Effect) -> bool:
        """Whether an effect is so small that the laws by which it was found are no
        better: beside an error that is no gap it is then none."""
        return False

    def is_within_tolerance(self, effect: Effect) -> bool:
        """Whether an effect is one number so near to neutral that what the scene itself
        may be off by could stand for it: among others it must then show by itself."""
        return False

    def softer(self) -> list[tuple[Effect, tuple[str, ...]]]:
        """Stiffnesses of contacts that press, as the scene has them, each with kinds of
        effects that stand for it in the equations; simulated windows are asked."""
        return []

    def hint(self, end: Fitted) -> str:
        """Where to look for what no effect explains, as sentences; "": not known."""
        return ""

    def other_gravity(self, end: Fitted) -> tuple[str, bool]:
        """That another direction of gravity explains as much as what is named, as a
        sentence ("": it does not), and whether it explains clearly more."""
        return "", False

    def reweigh(self, fitted: Fitted) -> bool:
        """Weighs rows by what a fit leaves, where that is clearly less than what models
        were taken to be off by, and by the noise in the fitted model. Returns: whether
        anything changed; then residuals, columns and nuisances are others."""
        return False

    def permitted(self, effects: Sequence[Effect]) -> list[Effect]:
        """The same effects, where residuals exist for them by the weights of now: what
        was fitted by others may be refused."""
        return list(effects)

    def rich(self) -> Sequence[Effect]:
        """Effects of one parameter at many joints, fitted roughly, from which a search
        starts; none: from nothing."""
        return ()

    def apart(
        self, effects: Sequence[Effect], names: Sequence[tuple[int, str]]
    ) -> list[list[int]]:
        """Parameters, (number of its effect, name), in sets that are moved at once to
        see what each does to rows that only it moves (`moved_by`); none where each is
        moved by itself."""
        return []

    def moved_by(self, effect: Effect) -> np.ndarray:
        """(m,) which rows an effect moves, where sets are moved at once."""
        return np.ones(len(self.train()), bool)

    def weighed_alike(
        self, one: Sequence[Effect], other: Sequence[Effect]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Residuals (m,) of two models, both by the weights of the one and both by
        those of the other; none where weights do not depend on the model."""
        return []

    def change(self, effect: Effect) -> float:
        """How far an effect is from the scene as it came, in any unit of its kind."""
        return 0.0

    def weighed_by(
        self, effects: Sequence[Effect], every_row: bool = False
    ) -> "GapProblem | None":
        """The same rows, of which every model is weighed as one with these effects;
        None where weights do not depend on the model. every_row: all are fitted."""
        return None

    def is_one_place(self, one: Sequence[str], other: Sequence[str]) -> bool:
        """Whether two places are one rigid body."""
        return False

    def inseparable(self, effect: Effect) -> Effect | None:
        """Another effect that no recording of these channels could tell from it."""
        return None

    def clock_of(self, effect: Effect) -> str:
        """Beside what an effect makes channels late, in words; "": it says so."""
        return ""

    def widened(self, end: Fitted, k: int) -> tuple[dict[str, float], tuple[str, ...]]:
        """Deviations of effect k of a fit, wider where slopes say too little; and the
        parameters that may as well be any larger."""
        return dict(end.std[k]), ()

    def error(self, fitted: Fitted) -> float:
        """What the verdict goes by: held-out error in units of the noise."""
        return fitted.score

    def steady_error(self, fitted: Fitted) -> float:
        """Held-out error over the noise without the block of time that leaves most;
        of few blocks, with it."""
        held = ~self.train()
        square = self.in_noise(fitted.left)[held] ** 2
        _, block = np.unique(self.blocks()[held], return_inverse=True)
        sums, counts = np.bincount(block, square), np.bincount(block)
        if len(sums) < FEWEST_BLOCKS:
            return self.error(fitted)
        k = int(np.argmax(sums))
        return float(np.sqrt((sums.sum() - sums[k]) / (counts.sum() - counts[k])))

    def closed(self, start: Fitted, end: Fitted) -> float:
        """Share of the gap, beyond the noise, that the effects of `end` close where
        most is closed: of all rows, or of the part of them that they act on."""
        return 1.0 - share_left(self.error(start), self.error(end))

    def judged(self) -> dict[str, str]:
        """{channel: by what it is judged}, of all that are (gap/result.py); of one of
        which it is not asked how it goes on in time, DISTANCES."""
        return {}

    def nuisance_effects(self, nuisances: Nuisances, b: np.ndarray) -> list[Effect]:
        """The nuisances at b (n_b,), as effects of a scene file, as far as they can be
        said there."""
        return []

    def parts(self) -> np.ndarray:
        """(m,) number of the recording of each row."""
        return np.zeros(len(self.train()), int)

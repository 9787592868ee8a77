"""What the gap workflow finds: the values that its files and pictures are made from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from makebreak.gap.data.findings import Finding
from makebreak.models.effects.kind import Effect, with_deviation

VERDICTS = ("no_gap", "not_judged", "gap_named", "ambiguous", "gap_unnamed")
# Those that find no gap, as far as anything was compared.
AGREES = ("no_gap", "not_judged")


def plain(size: float, unit: str) -> str:
    """A size in a unit that its number is short in: 1.2 mrad, 0.31 m, 43 N m."""
    if not np.isfinite(size):
        return "-"
    if unit in ("rad", "m", "rad/s", "m/s") and abs(size) < 0.1:
        size, unit = 1e3 * size, f"m{unit}"
    return f"{float(f'{size:.3g}'):g} {unit}"


@dataclass(frozen=True)
class Where:
    """A stretch in which a channel's disagreement stands out.

    region: what the mechanism did there, in words. score: rms of the residual in units
    of what noise would give. held_out: it is in the part that is reported on, looked at
    after all was decided.
    """

    channel: str
    from_s: float
    to_s: float
    episode: int
    recording: str
    region: str
    score: float
    held_out: bool = False


@dataclass(frozen=True)
class Estimate:
    """A parameter's value, and how sure it is. or_more: it may as well be any larger;
    the deviation is then that of the least that it can be. fitted: if not, the value
    is the model's own, which these data do not tell."""

    value: float
    std: float
    unit: str
    or_more: bool = False
    fitted: bool = True

    def text(self) -> str:
        """ "0.350 +- 0.010", "0 (as modelled)": without the unit."""
        as_it_was = "" if self.fitted else " (as modelled)"
        return with_deviation(self.value, self.std, self.or_more) + as_it_was


@dataclass(frozen=True)
class Evidence:
    """Held-out error without and with an effect, all others being in the model.

    runner_up: the best other explanation, "kind at place". margin: its held-out error
    over that of the effect, less one. why: it was not chosen, beside its error.
    """

    held_out_before: float
    held_out_after: float
    runner_up: str
    margin: float
    why: str = ""


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the model lacks.

    indistinguishable_from: others that explain these data as well, with the parameters
    that they would have. identifiable: "identifiable", "weak" or "not". recordings: in
    which it is, where it is not in all of them. sliding: which of these others' joints
    slide.
    """

    kind: str
    at: tuple[str, ...]
    parameters: Mapping[str, Estimate]
    says: str
    evidence: Evidence
    indistinguishable_from: tuple[Effect, ...] = ()
    tell_apart: str = ""
    identifiable: str = "identifiable"
    recordings: tuple[str, ...] = ()
    sliding: frozenset[str] = frozenset()

    def effect(self) -> Effect:
        """As a scene file lists it."""
        return Effect(
            self.kind,
            list(self.at),
            {name: each.value for name, each in self.parameters.items()},
        )


@dataclass(frozen=True)
class Tried:
    """An effect that was tried and that the data do not confirm, so that it is not in
    the scene: with its value, and why not, in words."""

    kind: str
    at: tuple[str, ...]
    parameters: Mapping[str, Estimate]
    says: str
    why: str


@dataclass(frozen=True)
class InUnits:
    """Rms error of a channel, or of a joint's equation, before and after, in its own
    unit. noise: standard deviation of a sample, as used. expected: what a perfect model
    would leave, of noise and of how uncertain the windows' starts are; of an equation
    this is its noise."""

    unit: str
    before: float
    after: float
    noise: float
    expected: float = float("nan")


@dataclass(frozen=True)
class Considered:
    """A kind at a place, by its columns alone, beside nothing. score: held-out error as
    a share of that without it; parameters of the (first) effect that it comes to."""

    kind: str
    at: tuple[str, ...]
    score: float
    parameters: Mapping[str, float]


@dataclass(frozen=True)
class Trust:
    """A parameter on parts of the data: by recording, over stretches of time, and
    fitted from other starts. NaN where a part does not show it. ridge_with: another
    parameter of which only a sum with this one shows; "" if there is none. correlation:
    of its error with those of the others that were fitted with it, by their names
    ("coulomb of joint_coulomb_friction at arm.j1")."""

    kind: str
    at: tuple[str, ...]
    parameter: str
    unit: str
    value: float
    std: float
    recordings: Mapping[str, float]
    stretches: Sequence[float]
    starts: Sequence[float]
    ridge_with: str = ""
    correlation: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Differs:
    """A parameter of an effect that is not the same in all recordings, by recording."""

    kind: str
    at: tuple[str, ...]
    parameter: str
    recordings: Mapping[str, Estimate]
    says: str


@dataclass(frozen=True)
class JudgedChannel:
    """How a measured channel was judged: "equations", "simulation", both, "not", or
    "distances": only that shapes meet was compared, and no motion.
    noise: as used; noise_from: "given" or "estimated"."""

    channel: str
    unit: str
    noise: float
    noise_from: str
    judged: str


@dataclass(frozen=True)
class GapMeasure:
    """Rms over held-out windows of (measured - simulated) over the noise.

    noise_floor: what a perfect model would leave. The noise that an error is divided
        by has in it how unsure its window's start is, so that this is 1.
    per_channel: {channel: {"before": , "after": }}, the same for each channel.
    in_units: the same in the channels' own units. equations: of each equation of
        motion, where there are any: what the model leaves of its effort or force.
    in_equations: rms of the equations of motion over the noise, before and after, in
        recordings that nothing was decided on; None where none was kept for that.
    n_windows: that were compared, failed: of them those that could not be simulated to
        their end, before and after; failure: which one that was and why, as a sentence.
        data: "reported" if neither a fit nor a choice saw them, "chosen on" else.
    by_window: {channel: (2, 2, n) mean squares over the expected error and over a
        sample's noise, before and after, of each window}; NaN where one does not count.
    by_block: {joint: (2, n) mean squares over the noise of its equation of motion,
        before and after, of each block of time}.
    """

    before: float
    after: float
    noise_floor: float
    window_s: float
    per_channel: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    in_units: Mapping[str, InUnits] = field(default_factory=dict)
    equations: Mapping[str, InUnits] = field(default_factory=dict)
    n_windows: int = 0
    failed: tuple[int, int] = (0, 0)
    data: str = "reported"
    seconds: float = 0.0  # Of recording that were compared.
    in_equations: tuple[float, float] | None = None
    failure: str = ""
    by_window: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    by_block: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def is_measured(self) -> bool:
        """Whether anything was compared: a simulation that failed says nothing."""
        return bool(np.isfinite(self.before) and np.isfinite(self.after))

    @property
    def stops_with_effects(self) -> bool:
        """Whether every window can be simulated without the effects, and none with."""
        before, after = self.failed
        return before == 0 and 0 < self.n_windows == after

    @property
    def reduction(self) -> float:
        """Share of what simulated windows show above the floor that is closed."""
        return self._closed(self.before, self.after)

    @property
    def reduction_in_equations(self) -> float:
        """The same of the equations of motion; nan where they were not asked."""
        return self._closed(*self.in_equations) if self.in_equations else float("nan")

    def _closed(self, before: float, after: float) -> float:
        """(before - after)/(before - floor); 0 where nothing was above the floor, and
        below the floor nothing counts."""
        above = before - self.noise_floor
        closed = before - max(after, self.noise_floor)
        return closed / above if above > 1e-9 else 0.0


@dataclass(frozen=True)
class Unexplained:
    """What is left that no kind explains. size: rms in units of noise. since: where it
    goes with time, and jumps once, when that is [s]."""

    channel: str
    region: str
    size: float
    correlates_with: str
    since: float | None = None


@dataclass(frozen=True, eq=False)
class Series:
    """One channel over neighbouring held-out windows of one episode, for a plot.

    Windows follow one another and each starts anew from a measured state; starts: rows
    at which one begins.
    """

    channel: str
    recording: str
    episode: int
    time: np.ndarray  # (n,) [s]
    measured: np.ndarray  # (n,)
    before: np.ndarray  # (n,) Simulated by the scene as it came.
    after: np.ndarray  # (n,) Simulated with the effects added.
    starts: np.ndarray
    noise: float
    # (n,) What a perfect model would leave, as a standard deviation: of noise and of
    # how uncertain a window's start is. None: the noise alone.
    expected: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class GapResult:
    """All that a run of the workflow found.

    background: {what: value in units of its tolerance}, of the nuisance terms.
    seconds: wall-clock time of each step; not in to_json, which is a function of the
        inputs alone.
    """

    verdict: str
    says: str  # The first screen's sentence.
    where: Sequence[Where]
    effects: Sequence[NamedEffect]
    gap: GapMeasure
    unexplained: Sequence[Unexplained]
    background: Mapping[str, float]
    checks: Sequence[Finding]
    series: Sequence[Series] = ()
    candidates: Sequence[Considered] = ()  # Of the first round, best first.
    seconds: Mapping[str, float] = field(default_factory=dict)
    trust: Sequence[Trust] = ()
    channels: Sequence[JudgedChannel] = ()
    nuisance_scene: Sequence[Effect] = ()  # The links as the nuisances have them.
    differs: Sequence[Differs] = ()
    unfinished: Sequence[str] = ()  # What a budget or an interrupt left undone.
    tried: Sequence[Tried] = ()

    def __post_init__(self):
        if self.verdict not in VERDICTS:
            raise ValueError(f"verdict is {self.verdict!r}, expected one of {VERDICTS}")

    def scene_effects(self) -> list[Effect]:
        """The effects to add to the scene: of the robot in all recordings."""
        return [each.effect() for each in self.effects if not each.recordings]

    def effects_in(self, recording: str) -> list[Effect]:
        """The effects to add to the scene for one recording."""
        return [
            each.effect()
            for each in self.effects
            if not each.recordings or recording in each.recordings
        ]

    def to_json(self) -> dict[str, Any]:
        """What result.json holds (docs/gap.md)."""
        return {
            "verdict": self.verdict,
            "says": self.says,
            "unfinished": list(self.unfinished),
            "where": [dict(vars(each)) for each in self.where],
            "effects": [_effect_json(each) for each in self.effects],
            "tried": [
                {
                    **_place_json(each.kind, each.at),
                    "parameters": _parameters_json(each.parameters),
                    "says": each.says,
                    "why": each.why,
                }
                for each in self.tried
            ],
            "gap": {
                "before": _number(self.gap.before),
                "after": _number(self.gap.after),
                "noise_floor": _number(self.gap.noise_floor),
                "reduction": _number(self.gap.reduction),
                "metric": "rms over held-out windows of (measured - simulated)/"
                "expected; expected: what noise and uncertain starts leave",
                "window_s": _number(self.gap.window_s),
                "held_out": self.gap.data == "reported" and self.gap.seconds > 0.0,
                "data": self.gap.data,
                "seconds": _number(self.gap.seconds),
                "windows": self.gap.n_windows,
                "windows_failed": list(self.gap.failed),
                "failure": self.gap.failure,
                "in_units": {k: _plain(v) for k, v in self.gap.in_units.items()},
                "equations": {k: _plain(v) for k, v in self.gap.equations.items()},
                "in_equations": _in_equations_json(self.gap),
                "per_channel": {
                    name: {k: _number(v) for k, v in each.items()}
                    for name, each in self.gap.per_channel.items()
                },
            },
            "unexplained": [dict(vars(each)) for each in self.unexplained],
            "background": {k: _number(v) for k, v in self.background.items()},
            "trust": [_plain(each) for each in self.trust],
            "differs": [
                {
                    **_plain(each),
                    "recordings": {
                        name: _plain(of) for name, of in each.recordings.items()
                    },
                }
                for each in self.differs
            ],
            "channels": [_plain(each) for each in self.channels],
            "checks": [dict(vars(each)) for each in self.checks],
        }

    def with_seconds(self, seconds: Mapping[str, float]) -> "GapResult":
        """The result with the times that its stages took [s]."""
        return replace(self, seconds=dict(seconds))


def _in_equations_json(gap: GapMeasure) -> dict[str, Any] | None:
    if gap.in_equations is None:
        return None
    before, after = map(_number, gap.in_equations)
    reduction = _number(gap.reduction_in_equations)
    return {"before": before, "after": after, "reduction": reduction}


def _effect_json(each: NamedEffect) -> dict[str, Any]:
    return {
        **_place_json(each.kind, each.at),
        "parameters": _parameters_json(each.parameters),
        "says": each.says,
        "recordings": list(each.recordings),
        "evidence": {
            "held_out_before": _number(each.evidence.held_out_before),
            "held_out_after": _number(each.evidence.held_out_after),
            "runner_up": each.evidence.runner_up,
            "margin": _number(each.evidence.margin),
            "why": each.evidence.why,
        },
        "identifiable": each.identifiable,
        "indistinguishable_from": [_of(e) for e in each.indistinguishable_from],
        "tell_apart": each.tell_apart,
    }


def _place_json(kind: str, at: Sequence[str]) -> dict[str, Any]:
    return {"kind": kind, "at": at[0] if len(at) == 1 else list(at)}


def _parameters_json(parameters: Mapping[str, Estimate]) -> dict[str, Any]:
    return {
        name: {
            "value": _number(p.value),
            "std": _number(p.std) if p.fitted else None,
            "unit": p.unit,
            "or_more": p.or_more,
            "fitted": p.fitted,
        }
        for name, p in parameters.items()
    }


def _of(effect: Effect) -> dict[str, Any]:
    return {
        **_place_json(effect.kind, effect.at),
        "parameters": {k: _number(v) for k, v in effect.parameters.items()},
    }


def _plain(each) -> dict[str, Any]:
    """A dataclass of numbers and words, as JSON may hold it."""

    def of(value):
        if isinstance(value, float):
            return _number(value)
        if isinstance(value, Mapping):
            return {k: of(v) for k, v in value.items()}
        return [of(v) for v in value] if isinstance(value, (tuple, list)) else value

    return {k: of(v) for k, v in vars(each).items()}


def _number(value: float) -> float | None:
    """JSON has no infinity and no NaN."""
    value = float(value)
    return value if np.isfinite(value) else None

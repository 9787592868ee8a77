"""Scores results of `makebreak gap` against the hidden effects."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.scripts.runner.table import Table

VERDICTS = ("no_gap", "not_judged", "gap_named", "ambiguous", "gap_unnamed")


@dataclass(frozen=True)
class Goals:
    """The project's goals for a set of cases."""

    verdict: float = 0.9  # Fraction of right verdicts.
    first: float = 0.85  # Fraction of cases with a hidden effect named first.
    error: float = 0.1  # Median relative error of the parameters.
    closed: float = 0.85  # Mean fraction of the reducible gap that is closed.
    covered: float | None = None  # Fraction of intervals that hold the true value.


STANDARD = Goals()
CONTACT = Goals(verdict=0.9, first=0.88, error=0.05, closed=0.9)
LOGS = Goals(verdict=0.92, first=0.9, error=0.05, covered=0.85)
DRIVEN = Goals(verdict=0.93, first=0.95, error=0.05, covered=0.88)

_DRIVES = ("actuator_", "input_delay")
_ONE_CHANNEL = ("sensor_bias", "sensor_delay", "sensor_lag")
# Error of simulated windows, over the noise, below which the gap does not show in them.
_SHOWN = 1.5
_INTERVAL = 2.0  # Half width of an interval [standard deviations].


@dataclass(frozen=True)
class Score:
    """The score of one case; None where a question does not apply to it.

    first: whether the first effect is a hidden one, or one that the benchmark's own
        computation cannot distinguish from it; first_or_tied: the same, or whether the
        result says that it is indistinguishable from one of them.
    errors: relative errors of the parameters of the hidden effects that were named;
        inside: for each parameter, whether its interval holds the true value.
    before: error of simulated windows before the repair, over the noise. closed: share
        of that, above the noise, which the repair closes; by_equations: the same in the
        equations of motion of held-out data, where these show a gap.
    named, needed: number of hidden effects that were named, and that show in the data.
    """

    name: str
    verdict: str  # The right one; several, joined by " or ", if the data allow them.
    found: str  # The verdict of the result; "failed" without one.
    first: bool | None
    first_or_tied: bool | None
    errors: tuple[float, ...]
    closed: float | None
    extra: int  # Number of effects that are not hidden.
    seconds: float
    says: str  # The effects that were named, or the error.
    inside: tuple[bool, ...] = ()
    named: int = 0
    needed: int = 0
    before: float = float("nan")
    by_equations: float | None = None

    @property
    def right(self) -> bool:
        """Whether the verdict is right."""
        return self.found in self.verdict.split(" or ")


def score(
    truth: Mapping,
    result: Mapping,
    driven: Sequence[str] = (),
    seconds: float = float("nan"),
) -> Score:
    """Scores the result of one case.

    Args: truth: of the benchmark: `effects`, each perhaps with `equivalents` (effects,
        with parameters, that the recording cannot distinguish from it), `needed`
        (whether it shows in the data) and `loose` (parameters that are not
        identifiable); `verdict` or `verdicts`; `ties`, sets of kinds that count as one;
        result: a result.json, or a dictionary with an `error`; driven: the joints that
        the scene drives.
    """
    verdicts = truth.get("verdicts") or [truth["verdict"]]
    hidden = [] if verdicts == ["gap_unnamed"] else truth["effects"]
    whole = {h["kind"] for h in hidden if "." not in str(h["at"])}
    found = members(result.get("effects") or [], driven, whole)
    asked = any(h.get("needed", True) for h in hidden)
    first = tied = None
    if asked:
        first = bool(found) and (
            any(_match(found[0], h, driven) is not None for h in hidden)
            or _in_tie(found[0]["kind"], truth)
        )
        others = found[0].get("indistinguishable_from", []) if found else []
        tied = first or any(
            _match(o, h, driven) is not None for o in others for h in hidden
        )
    errors: list[float] = []
    inside: list[bool] = []
    extra = 0
    left = list(range(len(hidden)))
    loose = [h.get("loose", ()) for h in hidden]
    for each in found:
        every = ((i, _match(each, h, driven)) for i, h in enumerate(hidden))
        match = [(i, p) for i, p in every if p is not None]
        if match:
            # Of several matches, prefer one that no other effect has been matched to.
            i, parameters = min(match, key=lambda m: m[0] not in left)
            left = [k for k in left if k != i]
            # A parameter that is not identifiable has no error, but an interval.
            known = {k: v for k, v in parameters.items() if k not in loose[i]}
            errors += parameter_errors(each["parameters"], known)
            inside += parameters_inside(each["parameters"], parameters)
        elif not _in_tie(each["kind"], truth):
            extra += 1
    gap = result.get("gap") or {}
    in_equations = gap.get("in_equations") or {}
    closed = by_equations = None
    if asked:
        closed = gap.get("reduction") or 0.0
        if (in_equations.get("before") or 0.0) > _SHOWN:
            by_equations = in_equations.get("reduction") or 0.0
    before = gap.get("before")
    needed = [i for i, h in enumerate(hidden) if h.get("needed", True)]
    says = result.get("error") or ", ".join(
        f"{e['kind']} at {e['at']}" for e in result.get("effects") or []
    )
    return Score(
        truth["name"],
        " or ".join(verdicts),
        result.get("verdict", "failed"),
        first,
        tied,
        tuple(errors),
        closed,
        extra,
        seconds,
        says or "nothing",
        tuple(inside),
        sum(i not in left for i in needed),
        len(needed),
        float("nan") if before is None else float(before),
        by_equations,
    )


# Kinds whose value for several joints is that of each of them.
_EACH = ("joint_", "rotor_inertia", "servo_gain", "actuator_gain", "actuator_bias")


def members(
    effects: Sequence[Mapping], driven: Sequence[str], whole: Collection[str] = ()
) -> list[Mapping]:
    """The effects, with one on several joints, or on all of a model, as one on each of
    them; kinds of `whole` stay at all of a model."""
    out: list[Mapping] = []
    for each in effects:
        at = [each["at"]] if isinstance(each["at"], str) else list(each["at"])
        if len(at) == 1 and "." not in at[0] and each["kind"] not in whole:
            at = [name for name in driven if name.startswith(f"{at[0]}.")] or at
        if each["kind"].startswith(_EACH) and len(at) > 1:
            out += [{**each, "at": [one]} for one in at]
        else:
            out.append(each)
    return out


def _match(found: Mapping, hidden: Mapping, driven: Sequence[str]) -> Mapping | None:
    """The true parameters of `found` if it is the hidden effect or an equivalent."""
    for each in (hidden, *hidden.get("equivalents", ())):
        if same_effect(found, each, driven):
            return each["parameters"]
    return None


def same_effect(one: Mapping, two: Mapping, driven: Sequence[str] = ()) -> bool:
    """Whether two effects are of one kind at one place."""
    return one["kind"] == two["kind"] and same_place(
        one["at"], two["at"], one["kind"], driven
    )


def same_place(one, two, kind: str, driven: Sequence[str] = ()) -> bool:
    """Whether two `at` name the same place: a model stands for all of its joints or for
    its only body, and a pair has no order."""
    a, b = _places(one, kind, driven), _places(two, kind, driven)
    if a == b:
        return True
    for whole, parts in ((a, b), (b, a)):
        if len(whole) == 1 and "." not in (model := next(iter(whole))):
            if kind in _ONE_CHANNEL:
                return False
            if all(part.startswith(f"{model}.") for part in parts):
                return len(parts) > 1 or parts == {f"{model}.{model}"}
    return False


def _places(at, kind: str, driven: Sequence[str]) -> set[str]:
    places = set()
    for each in [at] if isinstance(at, str) else at:
        if "~" in each:
            sides = sorted(_body(side.strip()) for side in each.split("~"))
            places.add("~".join(sides))
        elif "." not in each and kind.startswith(_DRIVES):
            of_model = [name for name in driven if name.startswith(f"{each}.")]
            places |= set(of_model or [each])
        else:
            places.add(each)
    return places


def _body(name: str) -> str:
    """The full name of a body; that of a model with one body is `model.model`."""
    return name if "." in name or name == "world" else f"{name}.{name}"


def _in_tie(kind: str, truth: Mapping) -> bool:
    return any(kind in tie for tie in truth["ties"])


def parameter_errors(found: Mapping, hidden: Mapping) -> list[float]:
    """Relative errors of parameters. Components of a vector give one error; a phase is
    relative to half a turn, the rest angle of a spring to one radian, an edge of a
    patch to the patch's size. Scalars whose true value is zero are omitted.

    Args: found: {name: {value, ...}} as in result.json; hidden: {name: value}.
    """
    value = {name: float(found[name]["value"]) for name in found if name in hidden}
    if "phase" not in value:
        return _errors(value, hidden)
    # F sin(wt + phase) and -F sin(wt + phase + half a turn) are the same.
    sizes = ("fx", "fy", "fz", "amplitude")
    other = {k: -v if k in sizes else v for k, v in value.items()}
    other["phase"] += np.pi
    return min(_errors(value, hidden), _errors(other, hidden), key=sum)


def _errors(value: dict[str, float], hidden: Mapping) -> list[float]:
    if "radius" in value and "scale" in value:
        del value["radius"]  # It follows from the scale.
    errors: list[float] = []
    vectors: tuple[tuple[str, ...], ...] = (
        ("com_x", "com_y", "com_z"), ("x", "y", "z"), ("fx", "fy", "fz"),
        ("roll", "pitch"), ("ixx", "iyy", "izz"),
    )  # fmt: skip
    for names in vectors:
        names = tuple(name for name in names if name in value)
        if len(names) > 1:
            there = np.array([hidden[name] for name in names])
            off = np.array([value.pop(name) for name in names]) - there
            if np.linalg.norm(there) > 0.0:
                errors.append(float(np.linalg.norm(off) / np.linalg.norm(there)))
    for name, each in value.items():
        off, size = each - hidden[name], abs(hidden[name])
        if name == "phase":
            off, size = (off + np.pi) % (2.0 * np.pi) - np.pi, np.pi
        elif name == "rest":
            size = 1.0
        elif name[:2] in ("x_", "y_"):
            size = abs(hidden[f"{name[:2]}max"] - hidden[f"{name[:2]}min"])
        elif name in ("gain", "scale"):
            size = abs(hidden[name] - 1.0)  # Relative to the change.
        if size > 0.0:
            errors.append(float(abs(off) / size))
    return errors


def parameters_inside(found: Mapping, hidden: Mapping) -> list[bool]:
    """For each parameter that was fitted, whether the true value lies within two
    standard deviations; False for a standard deviation that is not finite."""
    options = [hidden]
    if "phase" in hidden:  # The same force, half a turn later.
        sizes = ("fx", "fy", "fz", "amplitude")
        other = {k: -v if k in sizes else v for k, v in hidden.items()}
        options.append(other | {"phase": hidden["phase"] + np.pi})
    answers: list[list[bool]] = []
    for option in options:
        now = []
        for name in found:
            if name not in option or not found[name].get("fitted", True):
                continue
            off = float(found[name]["value"]) - option[name]
            if name == "phase":
                off = (off + np.pi) % (2.0 * np.pi) - np.pi
            std = found[name].get("std")
            std = np.nan if std is None else float(std)
            now.append(bool(np.isfinite(std) and abs(off) <= _INTERVAL * std))
        answers.append(now)
    return max(answers, key=sum)


def table_of(
    scores: Sequence[Score], which: str = "standard", goals: Goals = STANDARD
) -> Table:
    """The benchmark's table, with a note for each case that went wrong."""
    command = "makebreak reproduce gap"
    if which != "standard":
        command += f" --set {which}"
    rows: list[tuple] = []
    met: list[bool | None] = []

    def add(what, goal, ours, good=None):
        rows.append((what, goal, ours, command))
        met.append(good)

    def share(values) -> tuple[float, str]:
        n, k = len(values), sum(map(bool, values))
        return (k / n if n else 0.0), f"{k} of {n}" + (f" ({k / n:.0%})" if n else "")

    value, text = share([s.right for s in scores])
    add("right verdict", f"{goals.verdict:.0%}", text, value >= goals.verdict)
    value, text = share([s.first for s in scores if s.first is not None])
    add("right effect first", f"{goals.first:.0%}", text, value >= goals.first)
    _, text = share([s.first_or_tied for s in scores if s.first_or_tied is not None])
    add("right effect first, or said to be tied with it", "-", text)
    errors = [error for s in scores for error in s.errors]
    middle = float(np.median(errors)) if errors else float("nan")
    add(
        "parameter error, median", f"{goals.error:.0%}",
        f"{middle:.1%} of {len(errors)}" if errors else "-", middle <= goals.error,
    )  # fmt: skip
    closed = [s.closed for s in scores if s.closed is not None]
    mean = float(np.mean(closed)) if closed else float("nan")
    text = f"{mean:.0%} ({np.median(closed):.0%})" if closed else "-"
    what = "share of the reducible gap closed, mean (median)"
    add(what, f"{goals.closed:.0%}", text, mean >= goals.closed)
    shown = [s.closed for s in scores if s.closed is not None and s.before > _SHOWN]
    text = f"{np.mean(shown):.0%} ({np.median(shown):.0%}) of " if shown else "- of "
    what = f"the same where windows show more than {_SHOWN:g} times the noise"
    add(what, "-", f"{text}{len(shown)} cases")
    # A heavier object goes where it is pushed all the same: forces show it.
    either = [
        s.closed if s.before > _SHOWN or s.by_equations is None else s.by_equations
        for s in scores if s.closed is not None
    ]  # fmt: skip
    text = f"{np.mean(either):.0%} ({np.median(either):.0%})" if either else "-"
    what = "the same, by held-out equations of motion where windows show less"
    add(what, "-", text)
    within = [good for s in scores for good in s.inside]
    value, text = share(within)
    goal = "-" if goals.covered is None else f"{goals.covered:.0%}"
    met_covered = None if goals.covered is None else value >= goals.covered
    add("named intervals that hold the truth", goal, text, met_covered)
    needed = sum(s.needed for s in scores)
    named = sum(s.named for s in scores)
    add("hidden effects that were named", "-", f"{named} of {needed}")
    calm = [s for s in scores if not s.needed and "no_gap" in s.verdict]
    invented = sum(s.extra for s in calm)
    add(
        "effects invented where nothing is hidden", "0",
        f"{invented} in {len(calm)} cases", invented == 0 if calm else None,
    )  # fmt: skip
    extra = sum(s.extra for s in scores) - invented
    others = len(scores) - len(calm)
    add("effects invented in the other cases", "-", f"{extra} in {others} cases")
    for verdict in dict.fromkeys([*VERDICTS, *(s.verdict for s in scores)]):
        of_it = [s.found for s in scores if s.verdict == verdict]
        if of_it:
            counts = {v: of_it.count(v) for v in (*VERDICTS, "failed")}
            text = ", ".join(f"{v} {n}" for v, n in counts.items() if n)
            add(f"right verdict {verdict} ({len(of_it)})", "-", text)
    times = [s.seconds for s in scores if np.isfinite(s.seconds)]
    if times:
        add("seconds a case, median (most)", "-", f"{np.median(times):.0f} "
            f"({max(times):.0f})")  # fmt: skip
    notes = [
        f"{s.name}: {s.verdict} -> {s.found}: {s.says}"
        for s in scores
        if not s.right or s.first is False or s.extra
    ]
    title = f"Hidden effects, {which} set: {len(scores)} cases"
    return Table(title, ("what", "goal", "ours", "command"), rows, met, notes)

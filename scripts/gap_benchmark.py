"""`makebreak reproduce gap`: the workflow on recordings with hidden effects, scored.

The recordings are made by tests/gap_benchmark, in other simulators than Drake, and are
there in a checkout only. Each case is a `makebreak gap` in a process of its own, which
gets the scene and the recording; what was hidden is read here, when all have ended.

    python -m makebreak.scripts.gap_benchmark --set development --only pendulum
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import yaml
from tqdm import tqdm

import makebreak
from makebreak.scripts.session import Session
from makebreak.scripts.table import Table, json_value
from makebreak.scripts.trials import makebreak_command, run_commands

MAKER = (
    Path(makebreak.__file__).resolve().parent.parent / "tests/gap_benchmark/cases.py"
)
COMMAND = "makebreak reproduce gap"
VERDICTS = ("no_gap", "gap_named", "ambiguous", "gap_unnamed")
# Goals of the project.
VERDICT_SHARE, FIRST_SHARE, PARAMETER_ERROR, CLOSED = 0.9, 0.85, 0.1, 0.85

_DRIVES = ("actuator_", "input_delay")
_ONE_CHANNEL = ("sensor_bias", "sensor_delay")


@dataclass(frozen=True)
class Score:
    """How one case went. None: not asked of this case.

    first: whether the first effect is a hidden one (of a declared tie: any of it);
    first_or_tied: or says that it cannot be told from one.
    errors: relative errors of the parameters of the hidden effects that were named.
    """

    name: str
    verdict: str  # What it is.
    found: str  # What was said; "failed" if nothing was.
    first: bool | None
    first_or_tied: bool | None
    errors: tuple[float, ...]
    closed: float | None  # Share of the reducible gap, on held-out data.
    extra: int  # Effects that are not hidden.
    seconds: float
    says: str


def check() -> None:
    """Raises: ValueError where the benchmark cannot be run."""
    if not MAKER.is_file():
        raise ValueError(
            "reproduce gap needs tests/gap_benchmark, which is in a checkout of "
            "makebreak and not in an installed package"
        )
    if find_spec("mujoco") is None:
        raise ValueError(
            "reproduce gap makes its recordings with MuJoCo: "
            "pip install 'makebreak[dev]'"
        )


def reproduce(session: Session, seeds: int, jobs: int) -> Table:
    """The standard set, scored; its seeds are its own, `seeds` is not used."""
    return run_benchmark(session.out_dir, jobs, reuse=session.reuse)


def run_benchmark(
    folder: Path, jobs: int, which: str = "standard", only: str = "", reuse=False
) -> Table:
    """Makes the cases, runs the workflow on each, and scores it.

    Args: folder, of all files; which, set of cases; only, those whose name has this in
        it; reuse, whether cases and results that are there are kept.
    """
    cases, truth_file = folder / "cases", folder / "truth.json"
    if not (reuse and truth_file.is_file()):
        _make_cases(which, only, cases, truth_file)
    # Only the names, for now.
    names = sorted(path.name for path in cases.iterdir())
    folders = [folder / "results" / name for name in names]
    commands = []
    for name, out in zip(names, folders, strict=True):
        files = [str(cases / name / file) for file in ("scene.yaml", "recording.csv")]
        words = ["gap", *files, "--jobs", "1", "--out", str(out)]
        commands.append(makebreak_command(*words))

    def is_done(i: int) -> bool:
        return reuse and (folders[i] / "result.json").is_file()

    results = run_commands("gap", commands, folders, jobs, is_done)
    truths = json.loads(truth_file.read_text())
    scores = []
    for name, out, result in zip(names, folders, results, strict=True):
        scene = yaml.safe_load((cases / name / "scene.yaml").read_text())
        driven = (scene.get("actuation") or {}).get("joints") or []
        seconds = float("nan")
        if (out / "timing.json").is_file():
            seconds = json.loads((out / "timing.json").read_text())["wall_s"]
        scores.append(score(truths[name], result, driven, seconds))
    rows = [{k: json_value(v) for k, v in vars(each).items()} for each in scores]
    (folder / "scores.json").write_text(json.dumps(rows, indent=1) + "\n")
    return table_of(scores, which)


def _make_cases(which: str, only: str, cases: Path, truth_file: Path) -> None:
    for old in (*cases.glob("case_*"), *(truth_file.parent / "results").glob("case_*")):
        for path in old.iterdir():
            path.unlink()
        old.rmdir()
    truth_file.unlink(missing_ok=True)
    words = [sys.executable, str(MAKER), "--set", which, "--only", only]
    words += ["--out", str(cases), "--truth", str(truth_file)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        with tqdm(desc="recordings", unit="case", file=sys.stderr) as bar:
            for _ in process.stdout:
                bar.update()
        if process.wait() != 0:
            raise RuntimeError(f"{MAKER.name} ended with status {process.returncode}")
    finally:
        process.kill()
        process.wait()


# ----- Scoring


def score(
    truth: Mapping,
    result: Mapping,
    driven: Sequence[str] = (),
    seconds: float = float("nan"),
) -> Score:
    """How well a result tells what was hidden.

    Args: truth, of the benchmark; result, a result.json, or one with `error` in it;
        driven, the joints that the scene drives.
    """
    hidden = truth["effects"] if truth["verdict"] != "gap_unnamed" else []
    found = result.get("effects") or []
    first = tied = None
    if hidden:
        first = bool(found) and (
            any(same_effect(found[0], h, driven) for h in hidden)
            or _in_tie(found[0]["kind"], truth)
        )
        others = found[0].get("indistinguishable_from", []) if found else []
        tied = first or any(same_effect(o, h, driven) for o in others for h in hidden)
    errors: list[float] = []
    extra = 0
    for each in found:
        match = [h for h in hidden if same_effect(each, h, driven)]
        if match:
            errors += parameter_errors(each["parameters"], match[0]["parameters"])
        elif not _in_tie(each["kind"], truth):
            extra += 1
    closed = None
    if hidden:
        closed = (result.get("gap") or {}).get("reduction") or 0.0
    says = result.get("error") or ", ".join(
        f"{e['kind']} at {e['at']}" for e in found
    )  # fmt: skip
    return Score(
        truth["name"],
        truth["verdict"],
        result.get("verdict", "failed"),
        first,
        tied,
        tuple(errors),
        closed,
        extra,
        seconds,
        says or "nothing",
    )


def same_effect(one: Mapping, two: Mapping, driven: Sequence[str] = ()) -> bool:
    """Whether two effects are of one kind at one place."""
    return one["kind"] == two["kind"] and same_place(
        one["at"], two["at"], one["kind"], driven
    )


def same_place(one, two, kind: str, driven: Sequence[str] = ()) -> bool:
    """Whether two `at` mean the same: a model is all of its joints or its one body, a
    pair has no order."""
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
    """A model that is one body, by the body's name."""
    return name if "." in name or name == "world" else f"{name}.{name}"


def _in_tie(kind: str, truth: Mapping) -> bool:
    return any(kind in tie for tie in truth["ties"])


def parameter_errors(found: Mapping, hidden: Mapping) -> list[float]:
    """Relative errors; parts of one vector are taken together, a phase relative to
    half a turn, an angle at which a spring rests to one radian, a patch's sides to the
    patch. What is truly zero and alone is left out.

    Args: found {name: {value, ...}} as in result.json; hidden {name: value}.
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
        del value["radius"]  # The same thing, said twice.
    errors: list[float] = []
    vectors = (
        ("com_x", "com_y", "com_z"), ("x", "y", "z"), ("fx", "fy", "fz"),
        ("roll", "pitch"), ("ixx", "iyy", "izz"),
    )  # fmt: skip
    for names in vectors:
        if all(name in value for name in names):
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
            size = abs(hidden[name] - 1.0)  # Of what is changed.
        if size > 0.0:
            errors.append(float(abs(off) / size))
    return errors


def table_of(scores: Sequence[Score], which: str = "standard") -> Table:
    """The benchmark's table; what went wrong stands under it, a line a case."""
    rows: list[tuple] = []
    met: list[bool | None] = []

    def add(what, goal, ours, good=None):
        rows.append((what, goal, ours, COMMAND))
        met.append(good)

    def share(values) -> tuple[float, str]:
        n, k = len(values), sum(map(bool, values))
        return (k / n if n else 0.0), f"{k} of {n}" + (f" ({k / n:.0%})" if n else "")

    value, text = share([s.found == s.verdict for s in scores])
    add("right verdict", f"{VERDICT_SHARE:.0%}", text, value >= VERDICT_SHARE)
    value, text = share([s.first for s in scores if s.first is not None])
    add("right effect first", f"{FIRST_SHARE:.0%}", text, value >= FIRST_SHARE)
    _, text = share([s.first_or_tied for s in scores if s.first_or_tied is not None])
    add("right effect first, or said to be tied with it", "-", text)
    errors = [error for s in scores for error in s.errors]
    middle = float(np.median(errors)) if errors else float("nan")
    add(
        "parameter error, median", f"{PARAMETER_ERROR:.0%}",
        f"{middle:.1%} of {len(errors)}" if errors else "-", middle <= PARAMETER_ERROR,
    )  # fmt: skip
    closed = [s.closed for s in scores if s.closed is not None]
    mean = float(np.mean(closed)) if closed else float("nan")
    add(
        "share of the reducible gap closed, mean (median)", f"{CLOSED:.0%}",
        f"{mean:.0%} ({np.median(closed):.0%})" if closed else "-", mean >= CLOSED,
    )  # fmt: skip
    calm = [s for s in scores if s.verdict == "no_gap"]
    invented = sum(s.extra for s in calm)
    add(
        "effects invented where nothing is hidden", "0",
        f"{invented} in {len(calm)} cases", invented == 0 if calm else None,
    )  # fmt: skip
    extra = sum(s.extra for s in scores if s.verdict != "no_gap")
    others = len(scores) - len(calm)
    add("effects named in vain elsewhere", "-", f"{extra} in {others} cases")
    for verdict in VERDICTS:
        of_it = [s.found for s in scores if s.verdict == verdict]
        if of_it:
            counts = {v: of_it.count(v) for v in (*VERDICTS, "failed")}
            said = ", ".join(f"{v} {n}" for v, n in counts.items() if n)
            add(f"said of {verdict} ({len(of_it)})", "-", said)
    times = [s.seconds for s in scores if np.isfinite(s.seconds)]
    if times:
        add("seconds a case, median (most)", "-", f"{np.median(times):.0f} "
            f"({max(times):.0f})")  # fmt: skip
    notes = [
        f"{s.name}: {s.verdict} -> {s.found}: {s.says}"
        for s in scores
        if s.found != s.verdict or s.first is False
    ]
    title = f"Hidden effects, {which} set: {len(scores)} cases"
    return Table(title, ("what", "goal", "ours", "command"), rows, met, notes)


def main() -> int:
    parser = argparse.ArgumentParser(description="The gap workflow's benchmark.")
    parser.add_argument("--set", choices=("standard", "development"), required=True)
    parser.add_argument("--only", default="", help="cases whose name has this in it")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--reuse", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("runs/gap_benchmark"))
    args = parser.parse_args()
    try:
        check()
    except ValueError as error:
        print(f"gap_benchmark: {error}", file=sys.stderr)
        return 2
    args.out.mkdir(parents=True, exist_ok=True)
    table = run_benchmark(args.out, args.jobs, args.set, args.only, args.reuse)
    print(table.to_text())
    return 0


if __name__ == "__main__":
    sys.exit(main())

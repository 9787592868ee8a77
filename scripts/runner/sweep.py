"""`makebreak sweep`: one experiment over seeds and over ranges of its settings."""

import csv
import dataclasses
import itertools
import json
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import yaml
from matplotlib.figure import Figure
from scipy.stats import binomtest

from makebreak.models.typed_yaml import field_types
from makebreak.scripts.runner.outputs import OutputFolder
from makebreak.scripts.runner.result_page import result_page
from makebreak.scripts.runner.settings import (
    apply_settings,
    convert,
    dump_config,
    to_plain,
    unknown_key,
)
from makebreak.scripts.runner.table import Table, json_value
from makebreak.scripts.runner.trials import run_many, setting_texts

CONFIDENCE = 0.95
UNITS = ("m", "mm", "s", "N", "Nm", "rad", "deg", "kg")  # Suffixes of result keys.


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a success rate; (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    interval = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def rate_text(successes: int, trials: int) -> str:
    """`18 of 20, 70-97 %`: with Wilson's interval."""
    low, high = wilson(successes, trials)
    return f"{successes} of {trials}, {100 * low:.0f}-{100 * high:.0f} %"


@dataclass(frozen=True)
class Sweep:
    """The trials of a sweep.

    Args:
        experiment: its name.
        config: the settings that all trials share.
        vary: texts `key=lo:hi`, a range from which each trial draws uniformly (whole
            numbers for an integer key), and `key=a,b,c`, whose values are the cases.
        trials: number per case, with the seeds first_seed, first_seed + 1, ...
        duration_sec: overrides the duration of the experiment.
    Raises: ValueError for a key, a value or a range that does not fit the config.
    """

    experiment: str
    config: object
    vary: Sequence[str]
    trials: int
    first_seed: int = 0
    duration_sec: float | None = None

    def __post_init__(self):
        types_of = field_types(type(self.config))
        object.__setattr__(self, "ranges", {})
        object.__setattr__(self, "cases_of", {})
        for text in self.vary:
            key, equals, raw = text.partition("=")
            if not equals or not key or not raw:
                raise ValueError(
                    f'--vary: got "{text}", expected key=lo:hi or key=a,b,c'
                )
            if key not in types_of:
                raise unknown_key("--vary", key, type(self.config), self.experiment)
            if key in self.ranges or key in self.cases_of:
                raise ValueError(f"--vary: got {key} twice, expected once")
            if key == "seed":
                raise ValueError("--vary: got seed, expected another key: --seed N")
            if ":" in raw:
                self.ranges[key] = _range(key, raw, types_of[key])
            else:
                values = [_value(key, part, types_of[key]) for part in raw.split(",")]
                self.cases_of[key] = values

    ranges: dict[str, tuple] = dataclasses.field(init=False)
    cases_of: dict[str, list] = dataclasses.field(init=False)

    @cached_property
    def cases(self) -> list[dict]:
        """{key: value} of each case."""
        keys, values = list(self.cases_of), self.cases_of.values()
        return [
            dict(zip(keys, each, strict=True)) for each in itertools.product(*values)
        ]

    def drawn(self, seed: int) -> dict:
        """The values drawn for a seed. They depend on nothing else, so that all cases
        share them, and a sweep with more trials keeps those of the first."""
        values: dict[str, float] = {}
        for key, (low, high) in self.ranges.items():
            rng = np.random.default_rng([seed, zlib.crc32(key.encode())])
            if isinstance(low, int):
                values[key] = int(rng.integers(low, high, endpoint=True))
            else:
                values[key] = float(f"{rng.uniform(low, high):.6g}")
        return values

    def runs(self) -> list[tuple[dict, int]]:
        """(settings that differ from the experiment's own, seed) of each trial."""
        own = _differing(self.config)
        seeds = range(self.first_seed, self.first_seed + self.trials)
        return [(own | case | self.drawn(s), s) for case in self.cases for s in seeds]


def _differing(config) -> dict:
    """{dotted key: value} of the settings that differ from the defaults, without the
    seed."""
    default = to_plain(type(config)())

    def walk(now, was, prefix):
        for key, value in now.items():
            if isinstance(value, dict) and isinstance(was.get(key), dict):
                yield from walk(value, was[key], f"{prefix}{key}.")
            elif value != was.get(key):
                yield f"{prefix}{key}", value

    found = dict(walk(to_plain(config), default, ""))
    found.pop("seed", None)
    return found


def _value(key, text, hint):
    try:
        return convert(key, yaml.safe_load(text), hint, text)
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(f"--vary {' '.join(str(error).split())}") from error


def _range(key, text, hint) -> tuple:
    low, high = (_value(key, part, hint) for part in text.split(":", 1))
    for value in (low, high):
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f'--vary: got "{key}={text}", expected two numbers')
    if not low < high:
        raise ValueError(f'--vary: got "{key}={text}", expected lo below hi')
    return low, high


def run_sweep(
    sweep: Sweep,
    out_dir: Path,
    jobs: int,
    cluster: str | None = None,
    command: Sequence[str] = (),
    inputs: Iterable[str | Path] = (),
) -> tuple[Table, list[Path]]:
    """Runs the trials, and writes sweep.md, .json, .csv and plots.

    Args: out_dir: trials of an earlier sweep there with the same settings are not
        repeated; jobs, cluster, command: as in run_many; inputs: files that the trials
        read.
    Returns: the table, with a row for each case; the files written.
    Raises: ValueError for an out_dir that cannot be written to, or that holds files of
        another command.
    """
    with OutputFolder(out_dir, f"sweep {sweep.experiment}", inputs) as outputs:
        return _run(sweep, outputs, jobs, cluster, command)


def _run(sweep: Sweep, outputs: OutputFolder, jobs, cluster, command):
    runs = sweep.runs()
    for settings, seed in runs[: len(sweep.cases) * sweep.trials : sweep.trials]:
        apply_settings(type(sweep.config)(), [*setting_texts(settings), f"seed={seed}"])
    results = run_many(
        sweep.experiment, runs, jobs, outputs.path / "trials", sweep.duration_sec,
        reuse=True, command=command, cluster=cluster,
    )  # fmt: skip
    groups = [
        results[i * sweep.trials : (i + 1) * sweep.trials]
        for i in range(len(sweep.cases))
    ]
    fields = {key for key in field_types(type(sweep.config))} | {"interrupted"}
    measured = {
        key: kind
        for result in results
        if "error" not in result
        for key, value in result.items()
        if key not in fields and (kind := _kind(key, value))
    }
    table = _table(sweep, groups, measured)
    outputs.file("sweep.yaml").write_text(dump_config(sweep.config))
    files = [outputs.file(f"sweep.{end}") for end in ("md", "json", "csv")]
    files[0].write_text(table.to_markdown())
    files[1].write_text(json.dumps(_summary(sweep, groups, measured), indent=2) + "\n")
    _write_csv(files[2], runs, results, [*sweep.cases_of, *sweep.ranges])
    pictures: dict[str, bytes] = {}
    for key in [*sweep.ranges, *sweep.cases_of]:
        path = outputs.file(f"{key.replace('.', '_')}.png")
        _plot(sweep, key, runs, results, measured).savefig(path, dpi=120)
        pictures[path.name] = path.read_bytes()
    says = []
    if "success" in table.columns:
        k = list(table.columns).index("success")
        says = [f"{row[0]}: success {row[k]}" for row in table.cells()[1]]
    page = result_page(
        f"makebreak sweep {sweep.experiment}", [table], None, says, pictures
    )
    outputs.file("report.html").write_text(page)
    return table, outputs.commit()


def _numeric(sweep, key) -> bool:
    return all(
        isinstance(v, int | float) and not isinstance(v, bool)
        for v in sweep.cases_of[key]
    )


def _kind(key: str, value) -> str | None:
    """How a key of result.json is summarised: "rate" of a bool, "mean", or not."""
    if isinstance(value, bool):
        return "rate"
    if isinstance(value, int | float):
        return "mean"
    return None


def _values(group, key) -> list[float]:
    return [float(r[key]) for r in group if r.get(key) is not None]


def _is_error(key: str) -> bool:
    """Whether table and plots show a key: errors and peak forces."""
    return "error" in key or "peak_N" in key


def _table(sweep, groups, measured) -> Table:
    rates = [key for key, kind in measured.items() if kind == "rate"] or ["success"]
    means = [k for k, kind in measured.items() if kind == "mean" and _is_error(k)]
    rows, notes = [], []
    for case, group in zip(sweep.cases, groups, strict=True):
        row: list = [" ".join(setting_texts(case)) or "all"]
        for key in rates:  # A trial that failed counts as one without success.
            row.append(rate_text(sum(bool(r.get(key)) for r in group), len(group)))
        for key in means:
            values = _values(group, key)
            row.append(
                f"{np.mean(values):.4g} ({min(values):.4g} .. {max(values):.4g})"
                if values
                else None
            )
        rows.append(row)
        notes += [
            f"{row[0]}, seed {r['seed']} failed: {r['error']}"
            for r in group
            if "error" in r
        ]
    trials = f"{sweep.trials} trial{'s' if sweep.trials > 1 else ''}"
    title = f"{sweep.experiment}, {trials} per case"
    if sweep.ranges:
        drawn = ", ".join(f"{k} {lo:g}..{hi:g}" for k, (lo, hi) in sweep.ranges.items())
        title += f", drawn from {drawn}"
    return Table(title, ("case", *rates, *means), rows, notes=notes)


def _summary(sweep, groups, measured) -> dict:
    """The content of sweep.json."""
    cases = []
    for case, group in zip(sweep.cases, groups, strict=True):
        entry: dict = {"case": case, "failed": sum("error" in r for r in group)}
        for key, kind in measured.items():
            if kind == "rate":
                n = sum(bool(r.get(key)) for r in group)
                low, high = wilson(n, len(group))
                entry[key] = {"n": n, "of": len(group), "low": low, "high": high}
                continue
            values = _values(group, key)
            if values:
                entry[key] = {
                    "n": len(values), "mean": float(np.mean(values)),
                    "min": min(values), "max": max(values),
                }  # fmt: skip
        cases.append(entry)
    return {
        "experiment": sweep.experiment,
        "settings": _differing(sweep.config),
        "vary": {k: list(v) for k, v in {**sweep.cases_of, **sweep.ranges}.items()},
        "trials": sweep.trials,
        "first_seed": sweep.first_seed,
        "duration_s": sweep.duration_sec,
        "cases": json.loads(json.dumps(cases, default=json_value)),
    }


def _write_csv(path, runs, results, varied):
    keys = list(dict.fromkeys(k for r in results for k in r if k != "out_dir"))
    columns = list(dict.fromkeys(["seed", *varied, *keys]))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        for (settings, _), result in zip(runs, results, strict=True):
            row = {k: settings[k] for k in varied if k in settings}
            row |= {k: v for k, v in result.items() if k in columns}
            # Lists as JSON, where a value that was not measured is null.
            writer.writerow(
                {k: json.dumps(v) if isinstance(v, list) else v for k, v in row.items()}
            )


def _plot(sweep, key, runs, results, measured) -> Figure:
    """Success and errors over a varied setting: one colour for each case of the other
    listed settings, crosses for trials without success."""
    shown = [k for k, kind in measured.items() if kind == "mean" and _is_error(k)]
    figure = Figure(figsize=(7, 2.4 + 1.6 * len(shown)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(shown) + 1, sharex=True))
    listed = sweep.cases_of.get(key)
    is_number = listed is None or _numeric(sweep, key)
    others = [k for k in sweep.cases_of if k != key]
    groups: dict[str, list[int]] = {}
    for i, (settings, _) in enumerate(runs):
        name = " ".join(setting_texts({k: settings[k] for k in others}))
        groups.setdefault(name, []).append(i)

    def x_of(i):
        value = runs[i][0][key]
        return float(value) if is_number else float(listed.index(value))

    all_x = [x_of(i) for i in range(len(runs))]
    steps = np.diff(np.unique(all_x))
    apart = 0.15 * (steps.min() if listed and steps.size else 0.0) / len(groups)
    for at, (group, members) in enumerate(groups.items()):
        color = f"C{at % 10}"
        x = np.array([all_x[i] for i in members])
        drawn_x = x + apart * (at - 0.5 * (len(groups) - 1))
        good = np.array([bool(results[i].get("success")) for i in members])
        if listed:  # The success rate at each value, with its interval.
            places = np.unique(x)
            rates = [(good[x == place].sum(), (x == place).sum()) for place in places]
            middle = np.array([k / n for k, n in rates])
            ends = np.array([wilson(int(k), int(n)) for k, n in rates]).T
            reach = [np.maximum(middle - ends[0], 0.0), np.maximum(ends[1] - middle, 0)]
            shift = places + apart * (at - 0.5 * (len(groups) - 1))
            axes[0].errorbar(
                shift, middle, reach, fmt="o-" if is_number else "o", color=color,
                capsize=3, lw=0.8, label=group or None,
            )  # fmt: skip
        else:
            axes[0].plot(x, good + 0.04 * at, ".", color=color, label=group or None)
        for ax, name in zip(axes[1:], shown, strict=True):
            got = [results[i].get(name) for i in members]
            y = np.array([np.nan if v is None else float(v) for v in got])
            ax.plot(drawn_x[good], y[good], "o", color=color, alpha=0.6)
            ax.plot(drawn_x[~good], y[~good], "x", color=color, alpha=0.6)
    axes[0].set(ylim=(-0.08, 1.12), ylabel="success")
    for ax, name in zip(axes[1:], shown, strict=True):
        ax.set_ylabel(_label(name), fontsize=8)
        ax.ticklabel_format(axis="y", scilimits=(-2, 4))
    for ax in axes:
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel(_label(key))
    if listed:
        ticks = sorted(listed) if is_number else range(len(listed))
        axes[-1].set_xticks(
            ticks, [f"{v:g}" if is_number else _text(listed[v]) for v in ticks]
        )
    if any(groups):
        figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    marks = "; o success, x none" if shown else ""
    n = f"{sweep.trials} trial{'s' if sweep.trials > 1 else ''} per case"
    figure.suptitle(f"{sweep.experiment}: {n}{marks}", fontsize=10)
    return figure


def _text(value) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _label(name: str) -> str:
    """A label from a key and the unit in its suffix: `radius error [m]`."""
    stem, _, unit = name.rpartition("_")
    words = name.replace("_", " ")
    return f"{stem.replace('_', ' ')} [{unit}]" if stem and unit in UNITS else words

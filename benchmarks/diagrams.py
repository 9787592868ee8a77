"""The real-time factor of each experiment's diagram, without Meshcat, on one core."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

from makebreak.benchmarks.rows import failed
from makebreak.scripts.experiments import EXPERIMENTS, load_experiment
from makebreak.scripts.runner.trials import run_many

DURATION_SEC = 10.0  # Simulated time.


def rows() -> list[dict]:
    """Simulated seconds per second of process CPU time, one row per experiment and
    set of settings in its BENCH."""
    found: list[dict] = []
    for name in EXPERIMENTS:
        try:
            module = load_experiment(name)
        except ImportError as error:
            found.append(failed(name, error))
            continue
        seconds = getattr(module, "BENCH_SEC", DURATION_SEC)
        for label, values in getattr(module, "BENCH", {"as it is": {}}).items():
            what = f"{name}, {label}"
            try:
                found += _measured(name, values, what, seconds)
            except Exception as error:  # So that the others still run.
                found.append(failed(what, error))
    return found


def _measured(name: str, values: dict, what: str, seconds: float) -> list[dict]:
    with TemporaryDirectory() as folder:
        [result] = run_many(name, [(values, 0)], 1, Path(folder), seconds)
        if "error" in result:
            raise RuntimeError(result["error"])
        timing = Path(result["out_dir"]) / "timing.json"
        figures = json.loads(timing.read_text())
    value = figures["real_time_factor_cpu"]
    row = {"what": what, "unit": "x real time", "value": value}
    return [*_without_pictures(figures, what), row]


def _without_pictures(figures: dict, what: str) -> list[dict]:
    """The row without the time for rendering, for an experiment with images. That time
    is the median of an image times their number, which excludes preemption."""
    drawn = 0.0
    for name, system in figures.get("systems", {}).items():
        if name.endswith("_camera"):
            drawn += 1e-3 * system["p50_ms"] * system["updates"]
    if not drawn:
        return []
    value = figures["simulated_s"] / (figures["cpu_s"] - drawn)
    return [
        {"what": f"{what}, less the drawing", "unit": "x real time", "value": value}
    ]

"""The real-time factor of each experiment's diagram, without Meshcat, on one core."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

from makebreak.scripts.experiments import EXPERIMENTS, load_experiment
from makebreak.scripts.trials import run_many

DURATION_SEC = 10.0  # Simulated; the first second, with its compiling, counts little.


def rows() -> list[dict]:
    """Simulated seconds per second of process CPU time, one row per experiment and
    set of settings in its BENCH."""
    found: list[dict] = []
    for name in EXPERIMENTS:
        try:
            settings = getattr(load_experiment(name), "BENCH", {"as it is": {}})
        except ImportError as error:
            found.append({"what": f"{name}: {error}", "value": None})
            continue
        for label, values in settings.items():
            with TemporaryDirectory() as folder:
                runs = [(values, 0)]
                [result] = run_many(name, runs, 1, Path(folder), DURATION_SEC)
                timing = Path(result["out_dir"]) / "timing.json"
                row: dict = {"what": f"{name}, {label}", "unit": "x real time"}
                if "error" in result:
                    row |= {"value": None, "note": result["error"]}
                else:
                    figures = json.loads(timing.read_text())
                    row["value"] = figures["real_time_factor_cpu"]
                    found += _without_pictures(figures, row["what"])
                found.append(row)
    return found


def _without_pictures(figures: dict, what: str) -> list[dict]:
    """The row of what is left without the time in which pictures are drawn, for an
    experiment that draws any. The median, times their number: no preemption in it."""
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

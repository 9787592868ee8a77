"""The real-time factor of each experiment's diagram, without Meshcat, on one core, and
how many times the CPU time of the Panda station's plant alone it needs."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.benchmarks.rows import failed
from makebreak.diagrams.station import StationConfig, make_station
from makebreak.scripts.experiments import EXPERIMENTS, load_experiment
from makebreak.scripts.runner.trials import run_many

DURATION_SEC = 10.0  # Simulated time.
ALONE_SEC = 5.0  # Of the plant alone.


def rows() -> list[dict]:
    """Simulated seconds per second of process CPU time, one row per experiment and
    set of settings in its BENCH; `plants`: its time over that of the plant alone."""
    alone = plant_alone()
    found: list[dict] = [
        {"what": "the Panda's plant alone", "unit": "x real time", "value": alone}
    ]
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
    for row in found:
        if row["value"]:
            row["plants"] = alone / row["value"]
    return found


def plant_alone() -> float:
    """Simulated seconds per second of process CPU time of a station whose arm is held
    by constant torques."""
    builder = DiagramBuilder()
    station = builder.AddSystem(make_station(StationConfig()))
    plant = station.GetSubsystemByName("plant")
    port = station.GetInputPort("panda.torque_commanded")
    weight = plant.CalcGravityGeneralizedForces(plant.CreateDefaultContext())
    hold = builder.AddSystem(ConstantVectorSource(-weight[: port.size()]))
    builder.Connect(hold.get_output_port(), port)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.1)
    start = process_time()
    simulator.AdvanceTo(0.1 + ALONE_SEC)
    return ALONE_SEC / (process_time() - start)


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
    """The row without the CPU time for rendering, for an experiment with images."""
    drawn = 0.0
    for name, system in figures.get("systems", {}).items():
        if name.endswith("_camera"):
            drawn += 1e-3 * system["cpu_p50_ms"] * system["updates"]
    if not drawn:
        return []
    value = figures["simulated_s"] / (figures["cpu_s"] - drawn)
    return [
        {"what": f"{what}, less the drawing", "unit": "x real time", "value": value}
    ]

"""An experiment for the tests of the command line: a mass on a spring, with noise.

It is known to makebreak only while `registered` or the program MAIN is in use.
"""

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.table import Table
from makebreak.scripts.runner.trials import run_many
from makebreak.systems.numerics.timing import timed

SUMMARY = "A mass on a damped spring comes to rest."
BENCH = {"soft": {"spring.stiffness": 1.0}}

# Runs the command line with this experiment in it: python -c MAIN run spring_mass ...
MAIN = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from makebreak.scripts.experiments import EXPERIMENTS
EXPERIMENTS.clear()
EXPERIMENTS["spring_mass"] = "spring_mass"
from makebreak.scripts.cli import main
sys.exit(main())
"""
COMMAND = (sys.executable, "-c", MAIN)


@dataclass
class SpringConfig:
    stiffness: float = 4.0  # [N/m]
    damping: float = 2.0  # [N s/m]


@dataclass
class Config:
    spring: SpringConfig = field(default_factory=SpringConfig)
    noise: float = 0.1  # Standard deviation of a random force [N].
    steps: int = 1000
    damped: bool = True
    weights: list[float] = field(default_factory=lambda: [1.0, 1.0])
    limit: float | None = None
    world: str = ""
    whole_only: bool = False  # Whether scoring needs the whole recording.
    fail_at_sec: float = -1.0  # A fault of the program at this time.
    flown: float = 10.0  # Distance at which the mass counts as lost [m].
    seed: int = 0


class SpringMass(LeafSystem):
    """x = [q, v]; semi-implicit Euler at 100 Hz. Outputs: x (2,)."""

    def __init__(self, config: Config):
        super().__init__()
        self._config, self._rng = config, np.random.default_rng(config.seed)
        self._x = self.DeclareDiscreteState([1.0, 0.0])
        self.DeclareStateOutputPort("x", self._x)
        self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.0, self._update)

    @timed
    def _update(self, context, discrete_state):
        c = self._config
        if 0.0 <= c.fail_at_sec <= context.get_time():
            raise ValueError("a fault in the middle of the run")
        q, v = context.get_discrete_state(self._x).value()
        force = -c.spring.stiffness * q - c.damped * c.spring.damping * v
        v += 0.01 * (force + c.noise * self._rng.normal())
        discrete_state.set_value(self._x, [q + 0.01 * v, v])


def run(config, session):
    if not config.spring.stiffness > 0.0:
        raise ValueError(
            f"spring.stiffness: got {config.spring.stiffness}, expected > 0"
        )
    builder = DiagramBuilder()
    mass = builder.AddNamedSystem("mass", SpringMass(config))
    running = session.out_dir / "running"

    def until(t, sample):
        if t > 1.0 and not running.exists():
            running.write_text(str(os.getpid()))
        return "it flew away" if abs(sample["x"][0]) > config.flown else ""

    record = {"x": mass.GetOutputPort("x")}
    log = session.simulate(builder.Build(), 0.01 * config.steps, record, until=until)
    if config.whole_only and log.interrupted:
        raise IndexError("not enough to score")
    q = log["x"][:, 0]
    criteria = Criteria()
    criteria.at_most("rest", "distance from rest at the end", abs(q[-1]), 0.2, "m")
    figure = Figure()
    figure.subplots().plot(log.time, q)
    session.save_plot(figure, "position")
    session.write_recording({"time": log.time, "mass.slider.position": q}, noise={})
    return {
        **criteria.result(),
        "position_end_m": q[-1],
        "settled_s": float("inf"),
        "touched_s": float("nan"),
        "bounces_error_m": [0.5, float("nan")],
        "spring_stiffness": config.spring.stiffness,
    }


def reproduce(session, seeds, jobs):
    runs = [({"damped": d}, s) for d in (True, False) for s in range(seeds)]
    results = run_many(
        "spring_mass",
        runs,
        jobs,
        session.out_dir,
        session.duration_sec or float(os.environ.get("SPRING_MASS_SECONDS", "10")),
        reuse=session.reuse,
        command=COMMAND,
    )
    rest = [sum(r["success"] for r in part) for part in np.split(np.array(results), 2)]
    return Table(
        "A mass on a spring",
        ("what", "paper", "ours", "command"),
        [
            ("comes to rest", seeds, rest[0], "makebreak run spring_mass"),
            ("without damping", 0, rest[1], "makebreak run --set damped=false"),
        ],
        met=[rest[0] == seeds, rest[1] == seeds],
    )

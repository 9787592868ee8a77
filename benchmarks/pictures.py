"""Regenerates docs/pictures from runs; needs Debian's chromium.

python -m makebreak.benchmarks.pictures [--out docs/pictures] [PICTURE ...]
"""

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import sleep

import numpy as np
from matplotlib.figure import Figure

from makebreak.scripts.runner.outputs import STAGE
from makebreak.scripts.runner.screenshot import moving_picture, screenshot
from makebreak.scripts.runner.trials import makebreak_command
from makebreak.systems.changing_contact.numerics.velocity_profile import (
    speed_transition,
)

ROOT = Path(__file__).resolve().parent.parent
DOCS, EXAMPLES = ROOT / "docs" / "pictures", ROOT / "examples"


@dataclass(frozen=True)
class Picture:
    """The source of a picture: a page at a time of its own clock, a plot, an animation,
    or, with live_sec, the Meshcat of a run that has simulated so many seconds."""

    command: str
    file: str = ""
    wait_ms: int = 15000
    size: tuple[int, int] = (1280, 800)
    live_sec: float = 0.0
    moving_sec: float = 0.0  # Of an animation: how much of it is shown, moving.
    before: str = ""  # An example that makes the files of the command, in a folder.


def _figure(experiment: str, plot: str) -> Picture:
    return Picture(f"run {experiment} --no-meshcat", f"{plot}.png")


_LOOP = "close-the-loop --seed 2"
PICTURES = {
    "ball_rolling.webp": Picture(
        "run ball_rolling --duration 24", "meshcat.html", moving_sec=18.0
    ),
    "meshcat_live.png": Picture("run ball_rolling --seed 2", live_sec=14.0),
    "multiple_collisions.png": Picture("run multiple_collisions", "meshcat.html"),
    "push_object.png": Picture(
        "run push_object --seed 3 --set pose_from=camera model.friction=0.25 n_goals=3",
        "paths.png",
    ),
    "cube_pivoting.png": Picture("run cube_pivoting", "motion.png"),
    "gap_report.png": Picture(_LOOP, "2_gap/report.html", 5000, (1265, 725)),
    "gap_compare.png": Picture(
        "gap OUT/arm/scene.yaml OUT/arm/log.csv",
        "compare.html",
        12000,
        before="gap_of_an_arm.py OUT/arm",
    ),
    "ball_rolling_diagram.svg": Picture(
        "run ball_rolling --duration 0.1 --no-meshcat --diagram OUT/d.svg", "d.svg"
    ),
    "gentle_rolling_diagram.svg": Picture(
        "run gentle_rolling --duration 0.1 --no-meshcat --diagram OUT/d.svg", "d.svg"
    ),
    # The papers' figures, for docs/figures.md.
    "mpc_figure_3.png": _figure("cartpole_walls", "gradient_map"),
    "mpc_figure_4.png": _figure("cartpole_walls", "stabilisation"),
    "mpc_figure_6.png": _figure("ball_rolling", "residual"),
    "contact_figure_4.png": _figure("porridge", "prediction"),
    "contact_figure_5.png": _figure("multi_spring", "mrac"),
    "contact_figure_6.png": _figure("multi_spring", "active_inference"),
    "contact_figure_7.png": _figure("multi_spring", "biomimetic"),
    "contact_figure_9.png": _figure("changing_surface", "modes"),
    "contact_figure_10.png": _figure("changing_surface", "stiffness"),
    "contact_figure_12.png": _figure("wall_friction", "joint_prediction"),
    "contact_figure_14.png": _figure("wall_friction", "force_prediction"),
    "contact_figure_16.png": _figure("multiple_collisions", "profiles"),
    "contact_figure_18.png": _figure("contact_learning", "trials"),
    "contact_figure_20.png": _figure("surface_switch", "trials"),
}


def plot_speed_transition():
    """Figure 3 of the second paper: from 1.2 to 0.5 m/s in 1 s, by equation 11."""
    t = np.linspace(0.0, 1.0, 400)
    values = np.array([speed_transition(1.2, 0.5, 1.0, x) for x in t])
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    names = ("position [m]", "speed [m/s]", "acceleration [m/s2]", "jerk [m/s3]")
    for axes, name, y in zip(figure.subplots(2, 2).flat, names, values.T, strict=True):
        axes.plot(t, y)
        axes.set(xlabel="t [s]", ylabel=name)
        axes.grid(alpha=0.3)
    return figure


PLOTS = {"contact_figure_3.png": plot_speed_transition}  # Without a run.


def make_pictures(names: list[str], out: Path, work: Path) -> None:
    """Makes pictures, with one run for all that have the same command.

    Args: names: keys of PICTURES and PLOTS; out: folder for them; work: folder for
        runs.
    Raises: ValueError without a browser; RuntimeError if a run fails.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name in names:
        if name in PLOTS:
            PLOTS[name]().savefig(out / name, dpi=120)
    names = [name for name in names if name in PICTURES]
    for k, command in enumerate(dict.fromkeys(PICTURES[n].command for n in names)):
        folder = work / str(k)
        words = [word.replace("OUT", str(folder)) for word in command.split()]
        print(f"makebreak {command}", flush=True)
        pictures = [name for name in names if PICTURES[name].command == command]
        if PICTURES[pictures[0]].live_sec:
            _photograph(PICTURES[pictures[0]], folder, out / pictures[0])
            print(f"    {out / pictures[0]}", flush=True)
            continue
        if example := PICTURES[pictures[0]].before.replace("OUT", str(folder)):
            script, where = example.split(maxsplit=1)
            subprocess.run([sys.executable, EXAMPLES / script, where], check=True)
        done = subprocess.run(
            [*makebreak_command(*words), "--out", str(folder)],
            capture_output=True,
            text=True,
        )
        # Status 1: the run is complete but did not meet its goals.
        if done.returncode not in (0, 1):
            lines = done.stderr.strip().splitlines() or ["no output"]
            raise RuntimeError(f"{command}: {lines[-1]}")
        for name in pictures:
            picture = PICTURES[name]
            made = folder / picture.file
            if not made.is_file():
                raise RuntimeError(f"{command}: it made no {picture.file}")
            if picture.moving_sec:
                moving_picture(made, out / name, picture.moving_sec)
            elif made.suffix == ".html":
                screenshot(made, out / name, picture.size, picture.wait_ms)
            else:
                shutil.copy(made, out / name)
            print(f"    {out / name}", flush=True)


def _photograph(picture: Picture, folder: Path, to: Path) -> None:
    """Takes the picture of a run's Meshcat, and then ends the run.

    Raises: RuntimeError if the run ends before.
    """
    words = makebreak_command(*picture.command.split(), "--out", str(folder))
    run = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert run.stdout is not None
        lines = (line for line in run.stdout if line.startswith("Meshcat: "))
        address = next(lines, "").removeprefix("Meshcat: ").strip()
        while _last_time(folder / STAGE / "recording.csv") < picture.live_sec:
            if not address or run.poll() is not None:
                raise RuntimeError(f"{picture.command}: it ended before the picture")
            sleep(0.2)
        screenshot(address, to, picture.size, picture.wait_ms)
    finally:
        run.send_signal(signal.SIGINT)
        run.communicate()


def _last_time(recording: Path) -> float:
    """The time of the last whole row of a recording that grows [s]."""
    lines = recording.read_text().splitlines() if recording.is_file() else []
    with suppress(IndexError, ValueError):
        return float(lines[-2].split(",")[0])
    return 0.0


def main() -> int:
    parser = argparse.ArgumentParser(
        description="The pictures of docs/pictures, from runs.",
        epilog=f"pictures: {', '.join([*PICTURES, *PLOTS])}",
    )
    parser.add_argument("pictures", nargs="*", metavar="PICTURE")
    parser.add_argument("--out", type=Path, default=DOCS)
    args = parser.parse_args()
    known = [*PICTURES, *PLOTS]
    unknown = [name for name in args.pictures if name not in known]
    try:
        if unknown:
            listed = ", ".join(known)
            raise ValueError(f"unknown picture {unknown[0]}, expected some of {listed}")
        with tempfile.TemporaryDirectory() as work:
            make_pictures(args.pictures or known, args.out, Path(work))
    except (ValueError, RuntimeError) as error:
        print(f"pictures: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

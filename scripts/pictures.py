"""Makes the pictures of docs/pictures anew, from runs: needs Debian's chromium.

python -m makebreak.scripts.pictures [--out docs/pictures] [PICTURE ...]
"""

import argparse
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from makebreak.scripts.screenshot import screenshot
from makebreak.scripts.trials import makebreak_command, run_commands

DOCS = Path(__file__).resolve().parent.parent / "docs" / "pictures"


@dataclass(frozen=True)
class Picture:
    """What a picture is taken of: a page, at a time of its own clock, or a plot."""

    command: str
    file: str
    wait_ms: int = 15000
    size: tuple[int, int] = (1280, 800)


def _figure(experiment: str, plot: str) -> Picture:
    return Picture(f"run {experiment} --no-meshcat", f"{plot}.png")


_LOOP = "close-the-loop --seed 2"
PICTURES = {
    "ball_rolling.png": Picture("run ball_rolling --duration 24", "meshcat.html"),
    "multiple_collisions.png": Picture("run multiple_collisions", "meshcat.html"),
    "push_object.png": Picture("run push_object --set n_goals=3", "paths.png"),
    "cube_pivoting.png": Picture("run cube_pivoting", "motion.png"),
    "gap_report.png": Picture(_LOOP, "2_gap/report.html", 5000, (1265, 725)),
    "gap_compare.png": Picture(_LOOP, "2_gap/compare.html", 12000),
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


def make_pictures(names: list[str], out: Path, work: Path) -> None:
    """One run for all pictures that name the same command.

    Args: names: keys of PICTURES. out: where they go. work: where the runs go.
    Raises: ValueError where there is no browser; RuntimeError where a run fails.
    """
    out.mkdir(parents=True, exist_ok=True)
    for k, command in enumerate(dict.fromkeys(PICTURES[n].command for n in names)):
        folder = work / str(k)
        words = command.replace("OUT", str(folder)).split()
        print(f"makebreak {command}", flush=True)
        full = [*makebreak_command(*words), "--out", str(folder)]
        [result] = run_commands(command, [full], [folder], 1)
        for name in names:
            picture = PICTURES[name]
            if picture.command != command:
                continue
            made = folder / picture.file
            if not made.is_file():
                why = result.get("error", f"it made no {picture.file}")
                raise RuntimeError(f"{command}: {why}")
            if made.suffix == ".html":
                screenshot(made, out / name, picture.size, picture.wait_ms)
            else:
                shutil.copy(made, out / name)
            print(f"    {out / name}", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(
        description="The pictures of docs/pictures, from runs.",
        epilog=f"pictures: {', '.join(PICTURES)}",
    )
    parser.add_argument("pictures", nargs="*", metavar="PICTURE")
    parser.add_argument("--out", type=Path, default=DOCS)
    args = parser.parse_args()
    unknown = [name for name in args.pictures if name not in PICTURES]
    try:
        if unknown:
            known = ", ".join(PICTURES)
            raise ValueError(f"unknown picture {unknown[0]}, expected some of {known}")
        with tempfile.TemporaryDirectory() as work:
            make_pictures(args.pictures or list(PICTURES), args.out, Path(work))
    except (ValueError, RuntimeError) as error:
        print(f"pictures: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

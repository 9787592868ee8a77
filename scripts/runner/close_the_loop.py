"""Closes the loop: a run with a wrong model, `makebreak gap` on its recording, and a
run with the repaired model.

    makebreak close-the-loop ball_rolling --radius-error 0.005 --seed 0

The robot's scene file has a wrong radius of the ball, to which the controller adapts.
`makebreak gap` repairs the scene by the recording, and the next run uses the repaired
scene as its model. Nothing else passes from one step to the next.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path

from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.scene_facts import sphere_radius
from makebreak.diagrams.station import BALL_ROLLING
from makebreak.models.scene import load_scene, read_scene
from makebreak.models.scene_file import write_scene
from makebreak.scripts.runner.outputs import OutputFolder
from makebreak.scripts.runner.shown import say
from makebreak.scripts.runner.table import Table
from makebreak.scripts.runner.trials import makebreak_command, run_commands

COMMAND = "close-the-loop ball_rolling"
# Goals: error of the radius, error of the learned gap, and time of the first contact.
# With the right model the first push makes contact by 1.2 s; a push that ends short of
# the ball takes another second.
RADIUS_M, GAP_M, FIRST_PUSH_SEC = 1e-3, 1.5e-3, 1.2
_SHOWN = (
    "time_to_quarter_circle_s", "circles_completed", "tracking_error_mean_m", "r_gap_m",
    "residual_loss_first",
)  # fmt: skip


def write_wrong_scene(
    path: Path, error: float, place: Path | None = None
) -> tuple[float, float]:
    """Writes the shipped scene to `path` with a wrong ball beside it: a radius that is
    off by `error` [m], and the moments of inertia of that radius.

    Args: place: folder to which both files will be moved; None if they stay.
    Returns: the right radius and the wrong one [m].
    """
    place = path.parent if place is None else place
    scene = read_scene(BALL_ROLLING)
    loaded = load_scene(scene, DiagramBuilder())
    right = sphere_radius(loaded.plant, loaded.scene_graph, "ball")
    wrong = right + error
    if not wrong > 0.0:
        raise ValueError(f"--radius-error is {error}, expected > {-right}")
    for directive in scene.directives:
        add = directive.add_model
        if add is not None and add.name == "ball":
            text = Path(add.file.removeprefix("file://")).read_text()
            text = _scaled(text, "radius", wrong / right)
            for moment in ("ixx", "iyy", "izz"):
                text = _scaled(text, moment, (wrong / right) ** 2)
            (path.parent / "ball.sdf").write_text(text)
            add.file = f"file://{place.resolve() / 'ball.sdf'}"
    scene.initial.poses["ball.ball"][6] = wrong  # So that it lies on the table.
    heading = f"The model: a ball of {1e3 * wrong:.1f} mm radius."
    write_scene(scene, path, heading, place)
    return right, wrong


def _scaled(text: str, tag: str, factor: float) -> str:
    """The XML with the number in each element `tag` times the factor."""
    return re.sub(
        rf"<{tag}>([^<]*)</{tag}>",
        lambda m: f"<{tag}>{float(m[1]) * factor!r}</{tag}>",
        text,
    )


def close_the_loop(
    out: Path,
    error: float,
    seed: int,
    duration: float | None = None,
    settings: Sequence[str] = (),
    jobs: int = 1,
) -> Table:
    """Runs all three steps, each in a subfolder of `out`, and writes loop.json and
    result.json.

    Args:
        error: of the radius [m].
        seed, duration [s]: of both runs; None: those of the experiment.
        settings: key=value, of both runs.
        jobs: number of processes of `makebreak gap`.
    Raises: ValueError for a folder or a radius that cannot be used, or if a step
        refuses its input; RuntimeError if a step gives no result.
    """
    with OutputFolder(out, COMMAND) as outputs:
        table, results = _steps(out, error, seed, duration, settings, jobs)
        write_loop(outputs, table, results)
    return table


def write_loop(outputs: OutputFolder, table: Table, results: dict) -> None:
    """Writes loop.json, the results of all steps, and result.json, the table."""
    rows = table.to_dict()["rows"]
    for name, each in (
        ("loop.json", results),
        ("result.json", {"success": table.missed == 0, "rows": rows}),
    ):
        outputs.file(name).write_text(json.dumps(each, indent=2) + "\n")
    outputs.commit()


def take_step(out: Path, folder: str, says: str, *words: str) -> dict:
    """Runs a makebreak command in a subfolder of `out`, and gives its result.

    Raises: ValueError if it refuses its input, RuntimeError without a result.
    """
    say(says)
    command = makebreak_command(*words, "--out", str(out / folder))
    [result] = run_commands(folder, [command], [out / folder], 1)
    if "error" in result:
        status, _, line = result["error"].partition(": ")
        if status == "exit status 2":
            raise ValueError(f"{folder}: {line.removeprefix('makebreak: ')}")
        raise RuntimeError(
            f"{folder}: {result['error']} (all of it: {out / folder / 'log.txt'})"
        )
    return result


def _steps(out: Path, error, seed, duration, settings, jobs) -> tuple[Table, dict]:
    with OutputFolder(out / "0_model", f"{COMMAND} model") as outputs:
        right, wrong = write_wrong_scene(
            outputs.file("model.yaml"), error, outputs.path
        )
        outputs.commit()
    model = out / "0_model" / "model.yaml"

    def run(folder: str, says: str, scene: Path) -> dict:
        words = ["run", "ball_rolling", "--no-meshcat", "--seed", str(seed)]
        words += ["--model", str(scene), "--set", "radius_error_m=0", *settings]
        if duration is not None:
            words += ["--duration", repr(duration)]
        return take_step(out, folder, says, *words)

    first = run("1_wrong_model", f"A run with a ball {1e3 * error:+.3g} mm off", model)
    recording = out / "1_wrong_model" / "recording.csv"
    found = take_step(
        out, "2_gap", "gap, on what the robot recorded",
        "gap", str(model), str(recording), "--jobs", str(jobs),
    )  # fmt: skip
    repaired_scene = out / "2_gap" / "scene.yaml"
    second = run("3_repaired_model", "A run with the repaired model", repaired_scene)
    repaired = load_scene(repaired_scene, DiagramBuilder())
    radius = sphere_radius(repaired.plant, repaired.scene_graph, "ball")
    named = [each["kind"] for each in found["effects"]]
    contact_1, contact_2 = (r["time_to_first_contact_s"] for r in (first, second))
    gap_1, gap_2 = (r["r_gap_error_m"] for r in (first, second))
    rows: list[tuple] = [
        ("effects named", "", ", ".join(named) or "none", "object_size"),
        ("radius in the model [mm]", 1e3 * wrong, 1e3 * radius,
         f"{1e3 * right:.1f} +- {1e3 * RADIUS_M:.0f}"),
        ("time_to_first_contact_s", contact_1, contact_2, f"<= {FIRST_PUSH_SEC}"),
        ("r_gap_error_m", gap_1, gap_2, f"+- {GAP_M}"),
    ]  # fmt: skip
    met: list[bool | None] = [
        "object_size" in named,
        abs(radius - right) <= RADIUS_M,
        contact_2 is not None and contact_2 <= FIRST_PUSH_SEC,
        gap_2 is not None and abs(gap_2) <= GAP_M,
    ]
    rows += [(key, first[key], second[key], "") for key in _SHOWN]
    met += [None] * len(_SHOWN)
    notes = [f"The ball's radius is {1e3 * right:.1f} mm. {found['says']}"]
    if gap_2 is None:
        notes.append("r_gap_error_m needs a whole circle: a longer --duration.")
    columns = ("result", "wrong model", "repaired model", "wanted")
    title = f"The loop closed: radius {1e3 * error:+.1f} mm, seed {seed}"
    results = {
        "first": first, "gap": found, "second": second,
        "radius_right_m": right, "radius_wrong_m": wrong, "radius_m": radius,
    }  # fmt: skip
    return Table(title, columns, rows, met, notes), results

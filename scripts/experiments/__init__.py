"""The experiments that `makebreak run` knows, by name.

Each is a module with

    SUMMARY     one line for `makebreak list`
    Config      the diagram's config dataclass, with a field `seed`
    run(config, session) -> dict
                simulates and scores; flat, with at least `success`
    reproduce(session, seeds, jobs) -> Table
                optional: the paper's figure or table beside ours
    BENCH       optional: {label: {field: value}}, the settings with which
                `makebreak bench diagrams` takes its real-time factor
    BENCH_SEC   optional: the duration, of an experiment that has only this one
"""

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

# The name on the command line -> the module, imported when it is asked for.
EXPERIMENTS: dict[str, str] = {
    "ball_rolling": "makebreak.scripts.experiments.ball_rolling",
    "cartpole_walls": "makebreak.scripts.experiments.cartpole_walls",
    "changing_surface": "makebreak.scripts.experiments.changing_surface",
    "contact_learning": "makebreak.scripts.experiments.contact_learning",
    "contact_types": "makebreak.scripts.experiments.contact_types",
    "cube_pivoting": "makebreak.scripts.experiments.cube_pivoting",
    "gentle_rolling": "makebreak.scripts.experiments.gentle_rolling",
    "multi_spring": "makebreak.scripts.experiments.multi_spring",
    "multiple_collisions": "makebreak.scripts.experiments.multiple_collisions",
    "porridge": "makebreak.scripts.experiments.porridge",
    "push_object": "makebreak.scripts.experiments.push_object",
    "surface_switch": "makebreak.scripts.experiments.surface_switch",
    "wall_friction": "makebreak.scripts.experiments.wall_friction",
}


def load_experiment(name: str) -> ModuleType:
    """The module of the experiment `name`.

    Raises: KeyError if there is no experiment of that name.
    """
    return import_module(EXPERIMENTS[name])


def summary_of(name: str) -> str:
    """The SUMMARY of the experiment `name`, read without importing its module, which
    would take seconds.

    Raises: KeyError if there is no experiment of that name; ImportError if there is no
        such file, or no SUMMARY in it.
    """
    found = find_spec(EXPERIMENTS[name])
    if found is None or found.origin is None:
        raise ImportError(f"no module {EXPERIMENTS[name]}")
    for node in ast.parse(Path(found.origin).read_text(), found.origin).body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
            if any(getattr(target, "id", "") == "SUMMARY" for target in node.targets):
                return str(node.value.value)
    raise ImportError(f"{EXPERIMENTS[name]} has no SUMMARY")

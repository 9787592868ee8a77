"""Reads a scene file."""

import math
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_dump, yaml_load_typed
from pydrake.multibody.parsing import ModelDirective

from makebreak.models.drives import law_of
from makebreak.models.model_files import with_actuated_joints
from makebreak.models.scene_schema import InitialSection, Scene, check_scene
from makebreak.models.typed_yaml import (
    convert,
    hints_of,
    merge,
    nearest,
    one_line,
    read_yaml,
    shown,
)

# NAME=PATH, with os.pathsep between them: what `--package` says, for this process and
# those that it starts.
PACKAGES_VARIABLE = "MAKEBREAK_PACKAGES"
_DIRECTIVES = [each.name for each in ModelDirective.__fields__]
_FARTHEST = 1e6  # [m]; of angles, degrees: far beyond all sense.


def read_scene(path: str | Path) -> Scene:
    """The scene that a YAML or JSON file describes.

    Relative model files become absolute: they are relative to the scene's own folder.
    Where `actuation` drives joints and names none, it gets those that the models have
    actuators of.

    Raises: ValueError if the file is missing, or is not a scene.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"scene file {path} does not exist")
    try:
        scene = _scene(read_yaml(path), path.parent)
        check_scene(scene)
        scene = with_actuated_joints(scene)
        for joint in scene.actuation.joints:
            law_of(scene.actuation, joint)  # As many gains as joints.
        return scene
    except ValueError as error:
        raise ValueError(f"scene file {path}: {one_line(error)}") from None


def _scene(raw: Any, folder: Path) -> Scene:
    if raw is None:
        raise ValueError("it is empty, expected directives: [...]")
    if not isinstance(raw, dict):
        raise ValueError(f'got "{shown(raw)}", expected sections: {_sections()}')
    # Keys that begin with an underscore are for anchors and templates, as in Drake's.
    raw = {k: v for k, v in raw.items() if not str(k).startswith("_")}
    raw = {k: v for k, v in raw.items() if v is not None}
    directives = _directives(raw.pop("directives", []), folder)
    effects = raw.get("effects", [])
    if isinstance(effects, list):
        raw["effects"] = [_with_list(effect) for effect in effects]
    if isinstance(raw.get("actuation"), dict):
        _as_lists(raw["actuation"])
    initial = raw.get("initial")
    sections = {f.name for f in fields(InitialSection)}
    # A misspelt section has numbers below it, a file has episodes.
    if (
        isinstance(initial, dict)
        and initial
        and all(
            key not in sections
            and isinstance(value, dict)
            and all(isinstance(part, dict) for part in value.values())
            for key, value in initial.items()
        )
    ):
        raw["initial_of"] = raw.pop("initial")
    if isinstance(raw.get("initial_of"), dict):
        raw["initial_of"] = {
            file: {str(episode): part for episode, part in episodes.items()}
            if isinstance(episodes, dict)
            else episodes
            for file, episodes in raw["initial_of"].items()
        }
    scene = merge(Scene, raw)
    scene.directives = directives
    scene.packages = {
        name: str((folder / where).resolve()) for name, where in scene.packages.items()
    } | _given_packages()
    return scene


def _sections() -> str:
    return ", ".join(hints_of(Scene))


def _as_lists(section: dict) -> None:
    """One number for all joints becomes a list of one."""
    for key, value in section.items():
        if key == "supply" and isinstance(value, dict):
            _as_lists(value)
        elif isinstance(value, int | float) and key != "rate_hz":
            section[key] = [value]


def _with_list(effect: Any) -> Any:
    """`at` may be one name."""
    if isinstance(effect, dict) and isinstance(effect.get("at"), str):
        return effect | {"at": [effect["at"]]}
    return effect


def _directives(raw: Any, folder: Path) -> list[ModelDirective]:
    """Drake's own, with messages that name the place."""
    if not isinstance(raw, list):
        raise ValueError(
            f'directives: got "{shown(raw)}", expected a list of Drake model directives'
        )
    found = []
    for i, each in enumerate(raw):
        name = f"directives[{i}]"
        if not isinstance(each, dict) or len(each) != 1:
            raise ValueError(
                f'{name}: got "{shown(each)}", expected one of: '
                f"{', '.join(f'{d}: {{...}}' for d in _DIRECTIVES)}"
            )
        ((what, content),) = each.items()
        if what not in _DIRECTIVES:
            raise ValueError(
                f"{name}: unknown key {shown(what)}; {nearest(str(what), _DIRECTIVES)}"
            )
        _check_directive(f"{name}.{what}", what, content)
        try:
            directive = yaml_load_typed(schema=ModelDirective, data=yaml_dump(each))
        except Exception as error:  # The reader raises several kinds.
            said = one_line(error).partition(" ((<class")[0]
            if (
                not isinstance(error, RuntimeError)
                or "incompatible function arguments" in said
                or "schema sum type" in said
            ):  # No help.
                said = f'got "{shown(content)}", one of its values has a wrong form'
            raise ValueError(f"{name}.{what}: {said}") from None
        for part in (directive.add_model, directive.add_directives):
            if part is not None and "://" not in part.file:
                # Not as_uri(): Drake does not decode %20.
                part.file = f"file://{(folder / part.file).resolve()}"
        found.append(directive)
    return found


def _check_directive(name: str, what: str, content: Any) -> None:
    """What Drake's reader would say in its own words, or not at all."""
    schema = {f.name: f.type for f in ModelDirective.__fields__}[what].__args__[0]
    known = [f.name for f in schema.__fields__]
    if not isinstance(content, dict):
        raise ValueError(
            f'{name}: got "{shown(content)}", expected a mapping with: '
            f"{', '.join(known)}"
        )
    for key, value in content.items():
        if key not in known:
            raise ValueError(
                f"unknown key {name}.{shown(key)}; {nearest(str(key), known)}"
            )
        if key in ("name", "file", "parent", "child"):
            text = convert(f"{name}.{key}", value, str)
            if not text.strip() and what == "add_model":
                raise ValueError(f"{name}.{key}: it is empty")
    if what == "add_weld" and content.get("child") == "world":
        raise ValueError(f"{name}.child: got world, which is fixed; it can be parent")
    needed = {"add_model": ("name", "file"), "add_weld": ("parent", "child"),
              "add_directives": ("file",)}  # fmt: skip
    for key in needed.get(what, ()):
        if key not in content:
            raise ValueError(f"{name}: expected `{key}`")
    _check_numbers(name, content)


def _check_numbers(name: str, value: Any) -> None:
    if isinstance(value, dict):
        for key, each in value.items():
            _check_numbers(f"{name}.{key}", each)
    elif isinstance(value, list):
        for i, each in enumerate(value):
            _check_numbers(f"{name}[{i}]", each)
    elif isinstance(value, int | float):
        try:
            good = math.isfinite(value) and abs(value) <= _FARTHEST
        except OverflowError:  # An int of 400 digits.
            good = False
        if not good:
            raise ValueError(
                f'{name}: got "{shown(value)}", expected a number from '
                f"{-_FARTHEST:g} to {_FARTHEST:g}"
            )


def _given_packages() -> dict[str, str]:
    """Those of `--package`, which win over the file's."""
    said = os.environ.get(PACKAGES_VARIABLE, "")
    pairs = (each.partition("=") for each in said.split(os.pathsep) if each)
    return {name: str(Path(where).resolve()) for name, _, where in pairs}


def give_packages(settings: list[str]) -> None:
    """Takes `--package NAME=PATH` for all scenes that are read from now on.

    Raises: ValueError.
    """
    for each in settings:
        name, equals, where = each.partition("=")
        if not (name and equals and where) or os.pathsep in each:
            raise ValueError(f'--package: got "{each}", expected NAME=PATH')
        if not Path(where).is_dir():
            raise ValueError(f'--package {name}: got "{where}", expected a folder')
    if settings:
        before = os.environ.get(PACKAGES_VARIABLE, "")
        os.environ[PACKAGES_VARIABLE] = os.pathsep.join(
            [*([before] if before else []), *settings]
        )


def initial_for(scene: Scene, recording: str, episode: int | None) -> InitialSection:
    """The initial state of an episode (None: of a recording without episodes).

    Args: recording: name of its file, with or without its folder and suffix.
    """
    for name in (recording, Path(recording).name, Path(recording).stem):
        episodes = scene.initial_of.get(name, {})
        key = str(0 if episode is None else episode)
        if key in episodes:
            return episodes[key]
    return scene.initial

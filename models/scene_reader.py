"""Reads a scene file."""

import math
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_dump, yaml_load_typed
from pydrake.multibody.parsing import ModelDirective

from makebreak.models.drives import law_of
from makebreak.models.model_files import with_actuated_joints, with_what_files_say
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

# Settings NAME=PATH of `--package`, separated by os.pathsep, for this process and those
# that it starts.
PACKAGES_VARIABLE = "MAKEBREAK_PACKAGES"
_DIRECTIVES = [each.name for each in ModelDirective.__fields__]
_NUMBER_MAX = 1e6  # Bound of a directive's numbers [m], [deg].


def read_scene(path: str | Path) -> Scene:
    """Reads a scene from a YAML or JSON file.

    Paths of model files, relative to the scene's folder, become absolute. If
    `actuation` names no joints, it gets those with an actuator in the models' files.

    Raises: ValueError that names what is wrong.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"scene file {path} does not exist")
    try:
        scene = _scene(read_yaml(path), path.parent)
        check_scene(scene)
        scene = with_actuated_joints(with_what_files_say(scene))
        for joint in scene.actuation.joints:
            law_of(scene.actuation, joint)  # Checks the number of gains.
        return scene
    except ValueError as error:
        raise ValueError(f"scene file {path}: {one_line(error)}") from None


def _scene(raw: Any, folder: Path) -> Scene:
    if raw is None:
        raise ValueError("it is empty, expected directives: [...]")
    if not isinstance(raw, dict):
        raise ValueError(f'got "{shown(raw)}", expected sections: {_sections()}')
    # Keys that begin with an underscore are for anchors and templates, as in Drake.
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
    # A recording's name is followed by episodes, a misspelt section by numbers.
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
    } | given_packages()
    return scene


def _sections() -> str:
    return ", ".join(hints_of(Scene))


def _as_lists(section: dict) -> None:
    """Replaces a single number for all joints by a list of one, in place."""
    for key, value in section.items():
        if key == "supply" and isinstance(value, dict):
            _as_lists(value)
        elif isinstance(value, int | float) and key != "rate_hz":
            section[key] = [value]


def _with_list(effect: Any) -> Any:
    """The effect with `at` as a list, if it is a single name."""
    if isinstance(effect, dict) and isinstance(effect.get("at"), str):
        return effect | {"at": [effect["at"]]}
    return effect


def _directives(raw: Any, folder: Path) -> list[ModelDirective]:
    """Drake's model directives. Raises: ValueError that names the directive."""
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
        except Exception as error:  # Drake's reader raises several types.
            message = one_line(error).partition(" ((<class")[0]
            if (
                not isinstance(error, RuntimeError)
                or "incompatible function arguments" in message
                or "schema sum type" in message
            ):  # These messages do not help a user.
                message = f'got "{shown(content)}", one of its values has a wrong form'
            raise ValueError(f"{name}.{what}: {message}") from None
        for part in (directive.add_model, directive.add_directives):
            if part is not None and "://" not in part.file:
                # Not as_uri(), because Drake does not decode %20.
                part.file = f"file://{(folder / part.file).resolve()}"
        found.append(directive)
    return found


def _check_directive(name: str, what: str, content: Any) -> None:
    """Raises: ValueError where Drake's reader would give no clear message, or none."""
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
            good = math.isfinite(value) and abs(value) <= _NUMBER_MAX
        except OverflowError:  # An int of 400 digits.
            good = False
        if not good:
            raise ValueError(
                f'{name}: got "{shown(value)}", expected a number from '
                f"{-_NUMBER_MAX:g} to {_NUMBER_MAX:g}"
            )


def given_packages() -> dict[str, str]:
    """The packages of `--package`, which have priority over the file's."""
    text = os.environ.get(PACKAGES_VARIABLE, "")
    pairs = (each.partition("=") for each in text.split(os.pathsep) if each)
    return {name: str(Path(where).resolve()) for name, _, where in pairs}


def give_packages(settings: list[str]) -> None:
    """Stores settings NAME=PATH of `--package` for all scenes that are read afterwards.

    Raises: ValueError for another form, or a folder that does not exist.
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
    """The initial state of an episode.

    Args: recording: name of its file, with or without folder and suffix; episode: None
        for a recording without episodes.
    """
    for name in (recording, Path(recording).name, Path(recording).stem):
        episodes = scene.initial_of.get(name, {})
        key = str(0 if episode is None else episode)
        if key in episodes:
            return episodes[key]
    return scene.initial

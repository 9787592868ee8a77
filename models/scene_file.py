"""Writes a scene as a readable YAML file that read_scene reads back."""

import os
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load

from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, sentence
from makebreak.models.scene import ActuationSection, Scene

_WIDTH = 88
_TAG = "_tag"  # Where Drake's reader keeps a YAML tag, such as !Rpy.


def write_scene(
    scene: Scene, path: str | Path, heading: str = "", place: str | Path | None = None
) -> None:
    """Writes the scene as YAML, so that read_scene(path) gives the same scene.

    Paths of model files are relative to the file's folder, if possible; `package://`
    stays. Defaults are left out.

    Args: heading: comment lines at the top; `makebreak list` shows the first one.
        place: folder to which all files of the file's own will be moved; None: they
        stay.
    Raises: ValueError as scene_text, or if the file cannot be written.
    """
    path = Path(path)
    text = "".join(f"# {line}".rstrip() + "\n" for line in heading.splitlines())
    try:
        path.write_text(text + scene_text(scene, place or path.parent, path.parent))
    except OSError as error:
        path.unlink(missing_ok=True)
        raise ValueError(
            f"scene file {path} cannot be written: {error.strerror}"
        ) from error


def scene_text(
    scene: Scene, folder: str | Path, beside: str | Path | None = None
) -> str:
    """The scene as YAML, for a file in `folder`.

    Args: beside: folder whose files will lie in `folder` as well.
    Raises: ValueError for an effect of an unknown kind.
    """
    to, moved = Path(folder), Path(folder if beside is None else beside)
    plain: dict[str, Any] = {
        f.name: _plain(getattr(scene, f.name)) for f in fields(scene)
    }
    plain["packages"] = {
        name: _relative(where, to, moved) for name, where in scene.packages.items()
    }
    plain["directives"] = [
        yaml_load(data=yaml_dump_typed(each)) for each in scene.directives
    ]
    for directive in plain["directives"]:
        for what in ("add_model", "add_directives"):
            if what in directive:
                part = directive[what]
                file = _relative(part.pop("file"), to, moved)
                name = {"name": part.pop("name")} if "name" in part else {}
                directive[what] = name | {"file": file} | part
    effects = scene.effects
    del plain["effects"]
    if scene.actuation == ActuationSection():
        del plain["actuation"]
    of_files = plain.pop("initial_of")
    plain = _pruned(plain)
    if of_files:
        # A file's `initial` is one or the other; the reader accepts both keys together.
        plain["initial_of" if "initial" in plain else "initial"] = _pruned(of_files)
    lines = []
    for key, value in plain.items():
        if isinstance(value, dict | list):
            lines += [f"{key}:", *_block(value, 2)]
        else:
            lines.append(f"{key}: {_flow(value)}")
    lines += ["effects:"] if effects else ["effects: []"]
    for effect in effects:
        lines += _effect(effect)
    return "\n".join(lines) + "\n"


def _relative(file: str, folder: Path, beside: Path) -> str:
    """The file's path relative to the folder; unchanged if there is none. What lies in
    `beside` comes along."""
    name = file.removeprefix("file://")
    if "://" in name:
        return file
    try:
        path, moved = Path(name).resolve(), beside.resolve()
        start = moved if path.is_relative_to(moved) else folder.resolve()
        return Path(os.path.relpath(path, start)).as_posix()
    except ValueError:  # On another drive.
        return name


def _plain(value):
    """A value with dataclasses, also in lists and maps, converted to maps."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return asdict(value) if is_dataclass(value) else value  # type: ignore[arg-type]


def _effect(effect: Effect) -> list[str]:
    """Lines of an effect, with its sentence above and the units of its parameters."""
    if effect.kind not in KINDS:
        raise ValueError(f"effect kind {effect.kind!r} is unknown")
    kind = KINDS[effect.kind]
    at: Any = effect.at[0] if len(effect.at) == 1 else list(effect.at)
    lines = [f"  # {sentence(effect, kind)}"]
    lines += [f"  - kind: {effect.kind}", *_entry("at", at, 4)]
    lines.append("    parameters:" if effect.parameters else "    parameters: {}")
    units = {each.name: each.unit for each in kind.parameters}
    for name, value in effect.parameters.items():
        comment = f"  # {units[name]}" if units.get(name) else ""
        lines.append(f"      {name}: {_flow(float(value))}{comment}")
    return lines


def _pruned(value):
    """A value without empty lists and maps, which are defaults."""
    if isinstance(value, dict):
        kept = {key: _pruned(each) for key, each in value.items()}
        return {key: each for key, each in kept.items() if each not in ({}, [])}
    return [_pruned(each) for each in value] if isinstance(value, list) else value


def _flow(value) -> str:
    """A value on one line."""
    if isinstance(value, dict):
        pairs = [f"{_flow(k)}: {_flow(v)}" for k, v in value.items() if k != _TAG]
        tag = f"{value[_TAG]} " if _TAG in value else ""
        return f"{tag}{{{', '.join(pairs)}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_flow, value))}]"
    # In brackets, so that characters that are special inside brackets are quoted.
    return yaml.safe_dump([value], default_flow_style=True, width=10**9).strip()[1:-1]


def _entry(key: str, value, indent: int) -> list[str]:
    """Lines of `key: value`, one if it fits."""
    line = f"{' ' * indent}{_flow(key)}: {_flow(value)}"
    if len(line) <= _WIDTH or not isinstance(value, dict | list):
        return [line]
    tag = f" {value[_TAG]}" if isinstance(value, dict) and _TAG in value else ""
    return [f"{' ' * indent}{_flow(key)}:{tag}", *_block(value, indent + 2)]


def _block(value: dict | list, indent: int) -> list[str]:
    lines = []
    if isinstance(value, dict):
        for key, each in value.items():
            if key != _TAG:
                lines += _entry(key, each, indent)
        return lines
    for each in value:
        line = f"{' ' * indent}- {_flow(each)}"
        if isinstance(each, dict) and _TAG not in each and each:
            # A directive: `- add_model: {...}`.
            first, *rest = _block(each, indent + 2)
            lines += [f"{' ' * indent}- {first.lstrip()}", *rest]
        else:
            lines.append(line)
    return lines

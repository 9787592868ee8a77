"""Reads a scene file."""

from dataclasses import fields
from pathlib import Path

from pydrake.common.yaml import yaml_dump, yaml_load, yaml_load_typed

from makebreak.models.scene_schema import InitialSection, Scene, check_scene


def read_scene(path: str | Path) -> Scene:
    """The scene that a YAML or JSON file describes.

    Relative model files become absolute: they are relative to the scene's own folder.

    Raises: ValueError if the file is missing, or is not a scene.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"scene file {path} does not exist")
    try:
        raw = yaml_load(filename=str(path))
        for effect in raw.get("effects") or []:
            if isinstance(effect.get("at"), str):
                effect["at"] = [effect["at"]]  # The typed reader knows lists only.
        _as_lists(raw.get("actuation") or {})
        initial = raw.get("initial") or {}
        sections = {f.name for f in fields(InitialSection)}
        # A misspelt section has numbers below it, a file has episodes.
        if initial and all(
            key not in sections
            and isinstance(value, dict)
            and all(isinstance(part, dict) for part in value.values())
            for key, value in initial.items()
        ):
            raw["initial_of"] = {
                file: {str(episode): part for episode, part in episodes.items()}
                for file, episodes in raw.pop("initial").items()
            }
        scene = yaml_load_typed(schema=Scene, data=yaml_dump(raw))
    except Exception as error:  # The reader raises several kinds.
        raise ValueError(f"scene file {path}: {' '.join(str(error).split())}") from None
    for directive in scene.directives:
        for part in (directive.add_model, directive.add_directives):
            if part is not None and "://" not in part.file:
                # Not as_uri(): Drake does not decode %20.
                part.file = f"file://{(path.parent / part.file).resolve()}"
    check_scene(scene)
    return scene


def _as_lists(section: dict) -> None:
    """One number for all joints becomes a list of one: the typed reader's."""
    for key, value in section.items():
        if key == "supply" and isinstance(value, dict):
            _as_lists(value)
        elif key not in ("rate_hz", "type", "hold") and not isinstance(value, list):
            section[key] = [value]


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

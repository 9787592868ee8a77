"""Recordings that words of a command name: files, patterns, folders of logs."""

from collections.abc import Iterable
from glob import glob, has_magic
from pathlib import Path

from makebreak.gap.data.bags import BAGS, is_bag, is_dataset
from makebreak.gap.data.table import has_table

ROBOTS = (".urdf", ".sdf", ".xml", ".xacro")  # A robot's own file.


def recording_files(words: Iterable[str]) -> list[Path]:
    """Each recording, sorted where a pattern or a folder names several.

    Raises: ValueError, one line, for what is not there or holds no log.
    """
    found: list[Path] = []
    for word in words:
        path = Path(word)
        if not path.exists() and has_magic(word):
            several = [Path(each) for each in sorted(glob(word, recursive=True))]
            several = [each for each in several if is_recording(each)]
            if not several:
                raise ValueError(f"recording {word}: no log has such a name")
        elif not path.exists():
            raise ValueError(f"recording {path} does not exist")
        elif path.is_dir() and not is_recording(path):
            several = recordings_in(path)
            if not several:
                raise ValueError(
                    f"recording {path} is a folder without a log, expected a file, a "
                    "ROS bag, a LeRobot dataset or a folder of logs"
                )
        else:
            several = [path]
        found += [each for each in several if each not in found or several == [path]]
    return found


def recordings_in(folder: Path) -> list[Path]:
    """The logs that lie in a folder; files of JSON, which are calibrations and settings
    as well, only where no other file is one."""
    found = sorted(path for path in folder.iterdir() if is_recording(path))
    logs = [path for path in found if path.suffix.lower() != ".json"]
    return logs or [path for path in found if path.name != "noise.json"]


def is_recording(path: Path) -> bool:
    """Whether a name is that of a log that can be read."""
    is_file = path.is_file() and (has_table(path) or path.suffix.lower() in BAGS)
    return is_file or path.is_dir() and (is_bag(path) or is_dataset(path))

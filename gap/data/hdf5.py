"""HDF5 files as nested dictionaries of arrays: groups, their attributes, and data sets
of numbers and names. MATLAB writes its files of version 7.3 so as well."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np

HDF5 = (".h5", ".hdf5", ".hdf")
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_MATLAB_AT = 512  # Bytes of its own before a file of version 7.3.


def is_hdf5(path: Path) -> bool:
    """Whether a file begins as HDF5 does, whatever its name is."""
    with path.open("rb") as file:
        head = file.read(_MATLAB_AT + len(_SIGNATURE))
    return _SIGNATURE in (head[: len(_SIGNATURE)], head[_MATLAB_AT:])


def read_tree(path: Path, unused: frozenset[str], most_bytes: int) -> dict:
    """{name: a group's own dictionary, an array of numbers or names, a number, or None
    for data sets that are none of these, as images}.

    Args: unused: names (group/group/name) that are not read.
    Raises: ValueError, one line.
    """
    try:
        h5py = import_module("h5py")
    except ImportError:
        raise ValueError(
            f"recording {path}: HDF5 needs h5py: pip install 'makebreak[hdf5]'"
        ) from None
    try:
        with h5py.File(path, "r") as file:
            size = sum(each.nbytes for each in _tables(h5py, file))
            if size > most_bytes:
                raise ValueError(
                    f"recording {path} holds {size} bytes in its columns, expected at "
                    f"most {most_bytes}: cut it into several"
                )
            return _tree(h5py, file, "", unused)
    except (OSError, RuntimeError, KeyError) as error:
        why = " ".join(str(error).split())[:100]
        raise ValueError(f"recording {path} is no HDF5 file: {why}") from None


def _tables(h5py, group) -> Iterator:
    """The data sets below a group that may be columns."""
    for each in group.values():
        if isinstance(each, h5py.Group):
            yield from _tables(h5py, each)
        elif isinstance(each, h5py.Dataset) and each.ndim <= 2:
            yield each


def _tree(h5py, group, above: str, unused: frozenset[str]) -> dict:
    found = {k: v for k, v in group.attrs.items() if not k.startswith("MATLAB")}
    found = {k: v for k, v in found.items() if not isinstance(v, str | bytes)}
    for name, each in group.items():
        if name.startswith("#") or f"{above}{name}" in unused:  # MATLAB's own.
            continue
        is_group = isinstance(each, h5py.Group)
        found[name] = (
            _tree(h5py, each, f"{above}{name}/", unused) if is_group
            else _value(h5py, each)
        )  # fmt: skip
    return found


def _value(h5py, data):
    if data.attrs.get("MATLAB_class") in (b"char", "char"):
        return "".join(map(chr, np.ravel(data[()], "F")))
    if data.ndim > 2 or data.shape is None:
        return None
    if h5py.check_string_dtype(data.dtype) is not None:
        return np.array(data.asstr()[()], str)
    if h5py.check_ref_dtype(data.dtype) is not None:  # A cell array: of names.
        each = [_value(h5py, data.file[ref]) for ref in np.ravel(data[()], "F")]
        return np.array(each) if all(isinstance(x, str) for x in each) else None
    value = data[()]
    if value.dtype.names:
        return {name: value[name] for name in value.dtype.names}
    return value if value.dtype.kind in "iufbS" else None

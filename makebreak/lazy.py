"""Names of a package that are imported when they are asked for.

A package lists what it offers once, as imports that only type checkers and editors
carry out:

    if TYPE_CHECKING:
        from makebreak.gap.workflow import run_gap as run_gap
    else:
        __getattr__, __dir__, __all__ = offered(__name__)

(`as run_gap` is how the types of Python say that a name is offered to others.)
"""

import ast
import inspect
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any


def offered(package: str) -> tuple[Callable[[str], Any], Callable[[], list], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of the package of this name, from the
    imports of its source that say `name as name`."""
    module = sys.modules[package]
    places = {
        alias.name: node.module or ""
        for node in ast.walk(ast.parse(inspect.getsource(module)))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    }

    def get(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(places[name]), name)

    return get, lambda: [*vars(module), *places], list(places)

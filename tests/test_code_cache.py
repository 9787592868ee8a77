"""Compiled functions are found again wherever their sources are the same."""

import gc
import os
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import caching, event
from numba.core.registry import CPUDispatcher

from makebreak.systems.numerics import code_cache, filters
from makebreak.systems.numerics.code_cache import digest

ROOT = Path(__file__).parents[1]


def test_every_cached_function_of_makebreak_is_kept_by_its_source():
    seen = set()
    for room in ("systems", "gap", "models", "scripts", "diagrams"):
        for file in (ROOT / room).rglob("*.py"):
            if not re.search(r"^@(numba\.)?njit", file.read_text(), re.MULTILINE):
                continue
            dotted = ".".join(file.relative_to(ROOT).with_suffix("").parts)
            module = import_module(f"makebreak.{dotted}")
            for value in vars(module).values():
                if (
                    isinstance(value, CPUDispatcher)
                    and value.__module__ == module.__name__
                ):
                    locator = value._cache._impl.locator
                    assert isinstance(locator, code_cache.BySource), (dotted, value)
                    seen.add(dotted)
    assert len(seen) > 60


@pytest.fixture
def rooms(tmp_path):
    for name, text in {
        "a/caller": "from makebreak.b.called import f\n",
        "b/called": "from .constants import (\n    G,\n    H,\n)\n",
        "b/constants": "G = 1\nH = 2\n",
        "b/packed": "K = 0\n",
        "a/by_name": "from makebreak.b import packed\n",
        "a/inside": "def f():\n    import makebreak.b.packed\n",
        "a/above": "from ..b.packed import K\n",
        "a/alone": "import numpy\n",
    }.items():
        file = (tmp_path / name).with_suffix(".py")
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
        (file.parent / "__init__.py").touch()
    return tmp_path


@pytest.mark.parametrize(
    ("changed", "others"),
    [
        ("b/constants", {"b/called", "a/caller"}),
        ("b/packed", {"a/by_name", "a/inside", "a/above"}),
        ("a/alone", set()),
        ("b/__init__", {"a/by_name"}),
    ],
)
def test_a_digest_changes_with_all_that_is_imported_and_no_more(rooms, changed, others):
    def digests():
        digest.cache_clear()
        code_cache._read.cache_clear()
        files = sorted(rooms.rglob("*.py"))
        return {
            str(f.relative_to(rooms).with_suffix("")): digest(f, rooms) for f in files
        }

    before = digests()
    with (rooms / changed).with_suffix(".py").open("a") as file:
        file.write("# Changed.\n")
    after = digests()
    assert {n for n in before if before[n] != after[n]} == {changed, *others}


def test_another_copy_compiles_only_what_has_changed(tmp_path):
    code = (
        "from numba.core import event\n"
        "import numpy as np\n"
        "from makebreak.systems.numerics import filters\n"
        "with event.install_recorder('numba:compile') as seen:\n"
        "    one = np.ones(2)\n"
        "    filters._low_pass(np.arange(2.0), one, 1j * one, 1j * one)\n"
        "print(len(seen.buffer) > 0)"
    )

    def compiles(copy: Path) -> str:
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={
                **os.environ,
                "XDG_CACHE_HOME": str(tmp_path),
                "PYTHONPATH": str(copy),
            },
            cwd=copy,
            capture_output=True,
            text=True,
        )
        return done.stdout.strip() or done.stderr

    for name in ("one", "two"):
        for part in (
            "makebreak/__init__.py",
            "systems/__init__.py",
            "makebreak/lazy.py",
        ):
            target = tmp_path / name / part
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / part, target)
        shutil.copytree(
            ROOT / "systems/numerics",
            tmp_path / name / "systems/numerics",
            ignore=shutil.ignore_patterns("__pycache__"),
        )
        (tmp_path / name / "makebreak/systems").symlink_to("../systems")
    one, two = tmp_path / "one", tmp_path / "two"
    assert [compiles(one), compiles(one), compiles(two)] == ["True", "False", "False"]
    with (two / "systems/numerics/filters.py").open("a") as file:
        file.write("# Changed.\n")
    assert [compiles(two), compiles(one)] == ["True", "False"]


def test_code_with_checked_indices_is_other_code(monkeypatch):
    file, function = ROOT / "systems/numerics/filters.py", filters._low_pass.py_func
    plain = code_cache.BySource(function, file)
    monkeypatch.setattr(code_cache.CONFIG, "BOUNDSCHECK", 1)
    assert code_cache.BySource(function, file).get_cache_path() != (
        plain.get_cache_path()
    )


def test_what_is_long_out_of_use_is_deleted(tmp_path):
    old, recent, of_another = (tmp_path / name for name in ("m.a-1", "m.a-2", "m.ab-1"))
    for folder in (old, recent, of_another):
        code_cache._used(folder)
    for folder in (old, of_another):
        os.utime(folder, (0, 0))
    code_cache._used(tmp_path / "m.a-3")
    names = {folder.name for folder in tmp_path.iterdir()}
    assert names == {"m.a-2", "m.a-3", "m.ab-1"}


def test_code_that_cannot_be_written_serves_this_process_alone(monkeypatch, tmp_path):
    """As on a full disk: Numba's own would end in an error after the compiling."""

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(caching.IndexDataCacheFile, "save", full)
    double = numba.njit(cache=True)(_double)
    assert double(2.0) == 4.0


def _double(x):
    return 2.0 * x


def test_nothing_is_collected_while_numba_compiles():
    seen = []

    class Seen(event.Listener):
        def on_start(self, event):
            seen.append(gc.isenabled())

        def on_end(self, event):
            pass

    with event.install_listener("numba:compile", Seen()):
        assert numba.njit(_double)(2.0) == 4.0
        with pytest.raises(numba.TypingError):
            numba.njit(_double)(None)
    assert len(seen) > 1 and not any(seen)
    assert gc.isenabled()


def test_an_array_of_another_shape_is_refused_by_compiled_code():
    @numba.njit
    def head(out, values):
        out[:2] = values
        return out

    np.testing.assert_array_equal(head(np.zeros(3), np.ones(2)), [1.0, 1.0, 0.0])
    with pytest.raises(ValueError, match="slice of another shape"):
        head(np.zeros(3), np.ones(3))


@pytest.mark.parametrize(("module", "made"), [("makebreak.f", False), ("own", True)])
def test_only_what_others_compile_gets_a_wrapper_for_c(module, made):
    names = {"__name__": module}
    exec("def f(x):\n    return x + 1.0", names)
    f = numba.njit(names["f"])
    assert f(1.0) == 2.0
    (compiled,) = f.overloads.values()
    name = compiled.fndesc.llvm_cfunc_wrapper_name
    assert (name in compiled.library.get_llvm_str()) == made

"""What an index gets and people install: sdist and wheel, in a fresh environment."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from datetime import datetime
from email import message_from_bytes
from pathlib import Path

import pytest

from makebreak.systems.numerics.code_cache import user_cache

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("models", "systems", "diagrams", "gap", "scripts")
# A user's file: what is right in it, and after each `#` what a type checker must say.
USERS_FILE = """
from pathlib import Path
from makebreak import C3Config, C3Mpc, model_path
from makebreak.gap import run_gap
found = run_gap(Path("scene.yaml"), ["log.csv"], budget_min=3.0)
kinds: list[str] = [each.kind for each in found.effects]
path: str = model_path("puck.sdf")
from makebreak import C3Mpx  # has no attribute "C3Mpx"
run_gap("scene.yaml", ["log.csv"], budget=3.0)  # Unexpected keyword argument "budget"
C3Mpc(C3Config(), period="fast")  # Unexpected keyword argument "period"
found.verdict + 1  # Unsupported operand types
found.effect  # has no attribute "effect"
"""


def done(*words, cwd, **environment):
    """What a command prints. It must not see this checkout."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    kept = {key: value for key, value in os.environ.items() if key not in hidden}
    run = subprocess.run(
        [str(word) for word in words], cwd=cwd, env=kept | environment,
        capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, f"{words}: {run.stdout}{run.stderr}"
    return run.stdout


def built(what, folder, out):
    code = f"import setuptools.build_meta as b; b.build_{what}({str(out)!r})"
    done(sys.executable, "-c", code, cwd=folder)


@pytest.fixture(scope="session")
def archives(tmp_path_factory):
    """The folder of a checkout's copy; its sdist; the wheel that is built from that."""
    out, copy = tmp_path_factory.mktemp("dist"), tmp_path_factory.mktemp("of") / "copy"
    ignore = shutil.ignore_patterns("__pycache__")
    for name in ("makebreak", *ROOMS, "benchmarks", "docs", "examples"):
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=ignore)
    for each in ROOT.iterdir():
        if each.is_file() and not each.name.startswith("."):
            shutil.copy(each, copy / each.name)
    built("sdist", copy, out)
    (sdist,) = out.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(out / "unpacked", filter="data")
    (unpacked,) = (out / "unpacked").iterdir()
    built("wheel", unpacked, out)
    (wheel,) = out.glob("*.whl")
    return copy, unpacked, wheel


def test_wheel_has_every_file_of_the_rooms(archives):
    copy, _, wheel = archives
    held = {n for n in zipfile.ZipFile(wheel).namelist() if n.startswith("makebreak/")}
    files = [p for room in ROOMS for p in (copy / room).rglob("*") if p.is_file()]
    expected = {f"makebreak/{p.relative_to(copy)}" for p in files if p.suffix != ".sh"}
    own = {
        f"makebreak/{n}" for n in ("__init__.py", "__main__.py", "lazy.py", "py.typed")
    }
    assert expected | own == held


def test_sdist_has_what_its_readers_need(archives):
    copy, unpacked, _ = archives
    for pattern in ("examples/*.py", "docs/*.md", "docs/pictures/*", "*.md", "*.lock"):
        wanted = {p.relative_to(copy) for p in copy.glob(pattern)}
        assert wanted and wanted <= {
            p.relative_to(unpacked) for p in unpacked.rglob("*")
        }


def test_the_version_is_the_same_everywhere():
    found = {}
    for name in ("pyproject.toml", "makebreak/__init__.py", "CITATION.cff"):
        text = (ROOT / name).read_text()
        line = re.search(r'^_*version[_ :="]+([0-9.]+)', text, re.M)
        assert line, name
        found[name] = line[1]
    assert len(set(found.values())) == 1, found


def test_a_release_has_one_version_and_one_date():
    """Those of the changelog's newest release."""
    changes = (ROOT / "CHANGELOG.md").read_text()
    version, date = re.findall(r"^## ([\d.]+) - (\S+)$", changes, re.M)[0]
    day = datetime.strptime(date, "%Y-%m-%d")
    notes = (ROOT / "docs/release_notes.md").read_text()
    assert f"## {version} ({day.day} {day:%B %Y})" in notes
    cited = (ROOT / "CITATION.cff").read_text()
    assert f"version: {version}\ndate-released: {date}\n" in cited


def test_the_page_of_the_index_has_no_link_that_leads_nowhere(archives):
    """An index shows the page without the checkout around it."""
    _, _, wheel = archives
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith("dist-info/METADATA")]
        said = message_from_bytes(archive.read(name))
    page = said.get_payload()
    assert "pip install makebreak" in page
    links = re.findall(r"\]\((.*?)\)", page)
    assert links and all(link.startswith("https://") for link in links), links
    ranges = [r for r in said.get_all("Requires-Dist") if "extra ==" not in r]
    assert not [r for r in ranges if "==" in r.partition(";")[0]], "a pin, not a range"


def complaints(python, cwd, *options, **environment):
    """{line: what mypy says of it} of the user's file."""
    (cwd / "users.py").write_text(USERS_FILE)
    run = subprocess.run(
        [python, "-m", "mypy", *options, str(cwd / "users.py")], cwd=cwd,
        env=os.environ | environment, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 1, run.stdout + run.stderr
    found: dict[int, str] = {}
    for line, says in re.findall(r"users\.py:(\d+): error: (.*)", run.stdout):
        found[int(line)] = found.get(int(line), "") + says
    return found


def check_complaints(found):
    lines = enumerate(USERS_FILE.splitlines(), 1)
    expected = {i: line.split("  # ")[1] for i, line in lines if "  # " in line}
    assert found.keys() == expected.keys(), found
    for line, words in expected.items():
        assert words in found[line]


def test_a_type_checker_knows_what_the_package_offers(tmp_path):
    config, cache = ROOT / "pyproject.toml", user_cache() / "mypy"  # test_code.py's.
    options = (f"--config-file={config}", f"--cache-dir={cache}")
    check_complaints(complaints(sys.executable, tmp_path, *options, MYPYPATH=str(ROOT)))


def try_out(python, folder):
    """List, a run, gap on the example: what a user of a new installation does first."""
    where = done(
        python, "-c", "import makebreak; print(makebreak.__file__)", cwd=folder
    )
    assert Path(where).is_relative_to(python.parent.parent), where
    makebreak = python.with_name("makebreak")
    assert "cartpole_walls" in done(makebreak, "list", cwd=folder)
    done(
        makebreak, "run", "cartpole_walls", "--no-meshcat", "--out", "walls", cwd=folder
    )
    assert (folder / "walls" / "result.json").is_file()
    shutil.copy(ROOT / "examples" / "gap_of_an_arm.py", folder)
    said = done(python, "gap_of_an_arm.py", cwd=folder)
    assert "arm.j2" in said and "Coulomb friction" in said, said


@pytest.mark.slow  # About three minutes: it compiles anew.
def test_the_wheel_works_in_an_environment_of_its_own(archives, tmp_path):
    """With the dependencies of this environment, but not its makebreak."""
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env" / "bin" / "python"
    done(python, "-m", "pip", "install", "-q", "--no-deps", archives[2], cwd=tmp_path)
    # A path file names a folder; those in that folder (the checkout's) are not read.
    (site,) = (tmp_path / "env").glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    try_out(python, tmp_path)
    options = ("--strict", f"--python-executable={python}")
    check_complaints(complaints(sys.executable, tmp_path, *options))


@pytest.mark.slow  # Downloads half a gigabyte.
def test_the_wheel_installs_from_the_index(archives, tmp_path):
    """The newest versions that the ranges allow."""
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env" / "bin" / "python"
    done(python, "-m", "pip", "install", "-q", archives[2], cwd=tmp_path)
    done(python, "-m", "pip", "check", cwd=tmp_path)
    try_out(python, tmp_path)

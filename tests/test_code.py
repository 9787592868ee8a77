"""The code itself: style, types, the direction of imports, what the rooms promise."""

import ast
import dataclasses
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import makebreak
import makebreak.gap
from makebreak.scripts.experiments import EXPERIMENTS, load_experiment
from makebreak.systems.numerics.code_cache import user_cache

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("models", "systems", "diagrams", "gap", "scripts", "benchmarks")

# Room -> what it may import: numerics <- multibody <- systems <- diagrams <- gap <-
# runner <- experiments <- cli and benchmarks, and models <- diagrams. Systems meet at
# ports: they never import each other. runner loads an experiment by its name.
MAY_IMPORT = {
    "numerics": {"numerics"},
    "multibody": {"numerics", "multibody"},
    "systems": {"numerics", "multibody"},
    "models": {"numerics", "models"},
    "diagrams": {"numerics", "multibody", "systems", "models", "diagrams"},
    "gap numerics": {"numerics", "gap numerics"},
}
MAY_IMPORT["gap"] = MAY_IMPORT["diagrams"] | {"gap numerics", "gap"}
MAY_IMPORT["runner"] = MAY_IMPORT["gap"] | {"runner", "scripts"}
MAY_IMPORT["experiments"] = MAY_IMPORT["runner"] | {"experiments"}
MAY_IMPORT["cli"] = MAY_IMPORT["scripts"] = MAY_IMPORT["experiments"] | {"cli"}
MAY_IMPORT["benchmarks"] = MAY_IMPORT["cli"] | {"benchmarks"}
MAY_IMPORT["tests"] = MAY_IMPORT["benchmarks"]

# Wing of systems/ -> the wings of whose maths it may use beside its own; what is in
# systems/numerics all may use.
MATHS_OF = {
    "contact_mpc": set(),
    "changing_contact": {"contact_mpc"},
    "arm": {"contact_mpc", "changing_contact"},
    "perception": {"contact_mpc", "arm"},
    "planar": {"changing_contact"},
    "baselines": {"contact_mpc", "changing_contact", "planar"},
    "faults": {"contact_mpc", "perception"},
    "views": {"contact_mpc", "changing_contact", "arm"},
}

# Rooms of gap/ -> the rooms whose files they may import: data <- simulation <-
# residuals <- search, and report. What stands in gap/ itself is either shared by all of
# them (and imports data and numerics alone) or puts the rooms together.
GAP_ROOMS = {
    "shared": {"shared", "data"},
    "data": {"data"},
    "simulation": {"shared", "data", "simulation"},
    "residuals": {"shared", "data", "simulation", "residuals"},
    "search": {"shared", "data", "simulation", "residuals", "search"},
    "report": {"shared", "data", "simulation", "report"},
}
GAP_TOGETHER = (
    "__init__", "workflow", "by_recording", "verdict", "confirm",
)  # fmt: skip


def gap_room_of(parts):
    """The room of ("gap", "data", "table"): "data"; of numerics and of what puts the
    rooms together: None, "together"."""
    if parts[0] != "gap" or "numerics" in parts[1:2]:
        return None
    name = parts[1].removesuffix(".py") if len(parts) > 1 else "__init__"
    if name in GAP_TOGETHER:
        return "together"
    return name if name in GAP_ROOMS else "shared"


def room_of(parts):
    """The room of ("systems", "arm", "numerics", "packed"): "numerics"."""
    if parts[0] == "scripts":  # What lists the experiments is for all.
        return parts[1] if parts[2:3] not in ((), ("load_experiment",)) else "scripts"
    if "multibody" in parts[1:3]:
        return "multibody"
    if "numerics" not in parts[1:3]:
        return parts[0]
    return "gap numerics" if parts[0] == "gap" else "numerics"


def wing_of(parts):
    """The wing of ("systems", "arm", "numerics", "packed"): "arm"; of what all share,
    None."""
    wing = parts[1] if parts[0] == "systems" and len(parts) > 1 else None
    return None if wing == "numerics" else wing


def imported_modules(tree, package):
    """(line, dotted name) of each import anywhere in a syntax tree. `package`: dotted
    name of the package that the file is in, for relative imports. A string that is a
    dotted name in makebreak counts too: it is there to be imported."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: 1 - node.level or None]
                base = ".".join([*above, *([base] if base else [])])
            for alias in node.names:
                yield node.lineno, f"{base}.{alias.name}"
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if re.fullmatch(r"makebreak(\.\w+)+", node.value):
                yield node.lineno, node.value


def may_use(parts, other):
    """Whether maths `other` is for a file of systems/."""
    own, there = wing_of(parts), wing_of(other)
    return there in (None, own) or (own is not None and there in MATHS_OF.get(own, ()))


def breaches(root):
    """One line for each import under `root` that goes the wrong way."""
    found = []
    for path in sorted(
        p for room in (*ROOMS, "tests") for p in root.glob(f"{room}/**/*.py")
    ):
        parts = path.relative_to(root).parts
        here = room_of(parts)
        package = ".".join(("makebreak", *parts[:-1]))
        for line, name in imported_modules(ast.parse(path.read_text()), package):
            where = f"{'/'.join(parts)}:{line}: {name}"
            first, *rest = name.split(".")
            if first in (*ROOMS, "tests"):
                found.append(f"{where}: expected makebreak.{name}")
            elif first == "pydrake" and here.endswith("numerics"):
                found.append(f"{where}: numerics must not import pydrake")
            elif first == "makebreak" and rest and rest[0] in ROOMS:
                there = room_of(tuple(rest))
                if there not in MAY_IMPORT[here]:
                    found.append(f"{where}: {here} must not import {there}")
                elif (own := gap_room_of(parts)) in GAP_ROOMS and (
                    other := gap_room_of(tuple(rest))
                ) not in (None, *GAP_ROOMS[own]):
                    found.append(f"{where}: gap's {own} must not import {other}")
                elif parts[0] == "systems" and not may_use(parts, tuple(rest)):
                    own, other = wing_of(parts) or "systems/numerics", rest[1]
                    found.append(f"{where}: {own} must not use the maths of {other}")
    return found


def run_module(*arguments):
    return subprocess.run(
        [sys.executable, "-m", *arguments], cwd=ROOT, capture_output=True, text=True
    )


def test_ruff_finds_nothing():
    done = run_module("ruff", "check", "--output-format=concise", ".")
    assert done.returncode == 0, done.stdout + done.stderr


def test_code_is_formatted():
    done = run_module("ruff", "format", "--check", ".")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.skipif(
    sys.version_info < (3, 11),
    reason="arrays have other types in numpy 2.2, the last for Python 3.10",
)
def test_types_are_right():
    done = run_module("mypy", "--cache-dir", str(user_cache() / "mypy"))
    assert done.returncode == 0, done.stdout + done.stderr


def test_imports_go_one_way():
    assert breaches(ROOT) == []


@pytest.mark.parametrize(
    ("file", "code"),
    [
        ("systems/numerics/a.py", "import pydrake.math"),
        ("gap/numerics/a.py", "import pydrake.math"),
        (
            "systems/arm/numerics/a.py",
            "def f():\n    from pydrake.math import RigidTransform",
        ),
        (
            "systems/contact_mpc/numerics/a.py",
            "from makebreak.systems.contact_mpc.lcs_plant import LcsPlant",
        ),
        ("systems/contact_mpc/numerics/a.py", "from ..lcs_plant import LcsPlant"),
        ("systems/arm/a.py", "from makebreak.systems.arm.b import B"),
        ("systems/arm/a.py", "from makebreak.systems.views import b"),
        ("systems/arm/a.py", "from . import b"),
        (
            "systems/contact_mpc/multibody/a.py",
            "from makebreak.systems.contact_mpc.lcs_builder import LcsBuilderConfig",
        ),
        (
            "systems/contact_mpc/numerics/a.py",
            "from makebreak.systems.contact_mpc.multibody import anitescu_lcs",
        ),
        ("systems/arm/a.py", "from .b import B"),
        ("systems/baselines/a.py", "import makebreak.systems.arm.b as b"),
        (
            "systems/contact_mpc/a.py",
            "from makebreak.systems.arm.numerics.packed import packed",
        ),
        (
            "systems/contact_mpc/numerics/a.py",
            "from makebreak.systems.arm.numerics import packed",
        ),
        (
            "systems/numerics/a.py",
            "from makebreak.systems.contact_mpc.numerics.lcs import LCS",
        ),
        ("systems/arm/numerics/a.py", "from makebreak.gap.numerics.selection import S"),
        ("systems/arm/a.py", "from makebreak.models import scene"),
        ("systems/arm/a.py", "import_module('makebreak.diagrams.station')"),
        ("models/a.py", "from makebreak import diagrams"),
        ("diagrams/a.py", "if True:\n    import makebreak.gap.fit"),
        ("diagrams/a.py", "from makebreak.gap.numerics.free_body import FreeBody"),
        ("gap/a.py", "from makebreak.scripts.cli import main"),
        ("gap/a.py", "from makebreak.gap.residuals.inverse import InverseModel"),
        ("gap/data/a.py", "from makebreak.gap.problem import rms"),
        ("gap/simulation/a.py", "from makebreak.gap.residuals.track import Track"),
        ("gap/residuals/a.py", "from makebreak.gap.search.screen import rank"),
        ("gap/search/a.py", "from makebreak.gap.workflow import run_gap"),
        ("gap/report/a.py", "from makebreak.gap.search.screen import rank"),
        ("scripts/cli/a.py", "from systems.contact_mpc.numerics.lcs import LCS"),
        ("scripts/runner/a.py", "from makebreak.scripts.cli.arguments import number"),
        ("scripts/runner/a.py", "import makebreak.scripts.experiments.porridge"),
        ("scripts/experiments/a.py", "from makebreak.scripts.cli.faults import fault"),
        ("scripts/cli/a.py", "from makebreak.benchmarks.bench import bench"),
        ("tests/a.py", "import models"),
    ],
)
def test_a_planted_breach_is_found(tmp_path, file, code):
    path = tmp_path / file
    path.parent.mkdir(parents=True)
    path.write_text(code)
    assert len(breaches(tmp_path)) == 1, breaches(tmp_path)


@pytest.mark.parametrize(
    ("file", "code"),
    [
        (
            "systems/arm/numerics/a.py",
            "from makebreak.systems.numerics.timing import t",
        ),
        ("systems/arm/numerics/a.py", "from .packed import packed"),
        (
            "systems/arm/a.py",
            "from makebreak.systems.contact_mpc.numerics import lcs\nimport pydrake",
        ),
        ("systems/arm/a.py", "from .numerics.packed import packed"),
        ("systems/contact_mpc/a.py", "from .multibody.contact_pair import Contact"),
        ("gap/a.py", "from makebreak.systems.arm.numerics.packed import packed"),
        ("gap/numerics/a.py", "from makebreak.systems.arm.numerics.packed import p"),
        ("gap/search/a.py", "from makebreak.gap.residuals.track import Track"),
        ("gap/residuals/a.py", "from makebreak.gap.simulation.windows import Window"),
        ("gap/workflow.py", "from makebreak.gap.search.select import select"),
        ("models/a.py", "import makebreak.models.b"),
        (
            "diagrams/a.py",
            "from makebreak.systems.arm.b import B\nimport makebreak.models.c",
        ),
        ("scripts/cli/a.py", "from makebreak.scripts.runner.table import Table"),
        (
            "scripts/runner/a.py",
            "from makebreak.scripts.experiments import load_experiment",
        ),
        ("scripts/cli/a.py", "import makebreak\nimport modelsearch\nx = 'makebreak'"),
    ],
)
def test_a_right_import_is_accepted(tmp_path, file, code):
    path = tmp_path / file
    path.parent.mkdir(parents=True)
    path.write_text(code)
    assert breaches(tmp_path) == []


def test_numerics_load_without_pydrake():
    files = [p for room in ("systems", "gap") for p in ROOT.glob(f"{room}/**/*.py")]
    names = [
        ".".join(("makebreak", *p.relative_to(ROOT).with_suffix("").parts))
        for p in files
        if p.parent.name == "numerics"
    ]
    assert len(names) > 60
    code = "import importlib, sys\n"
    code += f"for name in {names}:\n"
    code += "    importlib.import_module(name)\n"
    code += "sys.exit('pydrake' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr or "numerics loads pydrake"


def test_every_wing_is_known_and_their_maths_goes_one_way():
    wings = {p.parent.name for p in ROOT.glob("systems/*/__init__.py")} - {"numerics"}
    assert wings == set(MATHS_OF)
    rest = dict(MATHS_OF)
    while rest:  # Take away what uses nothing that is left, until nothing is.
        free = [wing for wing, uses in rest.items() if not uses & set(rest)]
        assert free, f"in a circle: {sorted(rest)}"
        for wing in free:
            del rest[wing]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_experiment_has_what_the_command_line_needs(name):
    module = load_experiment(name)
    assert module.SUMMARY and "\n" not in module.SUMMARY
    assert dataclasses.is_dataclass(module.Config)
    assert "seed" in {field.name for field in dataclasses.fields(module.Config)}
    assert list(inspect.signature(module.run).parameters) == ["config", "session"]


def links():
    """(document, target) of the links to files of this project in its documents."""
    for document in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", document.read_text()):
            if "://" not in target and not target.startswith("mailto:"):
                yield document, target


def public_without_docstring(root):
    """`file: name` of each public class, function or method that has no docstring."""
    found = []

    def look(where, parent):
        for node in parent.body:
            if not isinstance(node, ast.FunctionDef | ast.ClassDef):
                continue
            if node.name.startswith("_"):
                continue
            if ast.get_docstring(node) is None:
                found.append(f"{where}: {node.name}")
            if isinstance(node, ast.ClassDef):
                look(where, node)

    for room in ROOMS:
        for path in sorted(root.glob(f"{room}/**/*.py")):
            look(path.relative_to(root).as_posix(), ast.parse(path.read_text()))
    return found


def test_what_users_import_has_docstrings_and_the_rest_gets_no_worse():
    missing = []
    for package in (makebreak, makebreak.gap):
        for name in package.__all__:
            one = getattr(package, name)
            parts = vars(one).items() if inspect.isclass(one) else ()
            missing += [
                f"{name}.{part}"
                for part, each in parts
                if not part.startswith("_")
                and (inspect.isfunction(each) or isinstance(each, property))
                and not inspect.getdoc(each)
            ]
            if not inspect.getdoc(one) or inspect.getdoc(one).startswith(f"{name}("):
                missing.append(name)  # What `dataclass` writes is none.
    assert missing == []
    # Lower this number with each one that is written.
    assert len(public_without_docstring(ROOT)) <= 194


def test_a_definition_without_a_docstring_is_found(tmp_path):
    (tmp_path / "gap").mkdir()
    code = 'class A:\n    """a"""\n    def b(self): ...\ndef _c(): ...\ndef d(): ...\n'
    (tmp_path / "gap" / "a.py").write_text(code)
    assert public_without_docstring(tmp_path) == ["gap/a.py: b", "gap/a.py: d"]


def wide_configs(root):
    """{`file: class`: how many plain settings it has} of the settings of systems and
    diagrams (dataclasses that can be changed) that have eight or more. A group, which
    is a dataclass itself, counts as none."""
    found = {}
    for path in sorted(
        p for r in ("systems", "diagrams") for p in root.glob(f"{r}/**/*.py")
    ):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.ClassDef):
                continue
            if "dataclass" not in map(ast.unparse, node.decorator_list):
                continue
            kinds = [
                ast.unparse(each.annotation)
                for each in node.body
                if isinstance(each, ast.AnnAssign)
            ]
            plain = r"(float|int|bool|str|Literal|list\[(float|int|str|bool|list)\b)"
            n = sum(bool(re.match(plain, kind)) for kind in kinds)
            if n >= 8:
                found[f"{path.relative_to(root)}: {node.name}"] = n
    return found


# Settings that read better without groups, and why. None comes to this list.
TYPED = "what --set is typed for most, with short keys beside its systems' groups"
LAW = "one law or cost: its numbers are read, and tuned, together"
FLAT = {
    "diagrams/ball_rolling_config.py: BallRollingConfig": TYPED,
    "diagrams/cartpole_walls.py: CartpoleWallsConfig": TYPED,
    "diagrams/changing_surface.py: ChangingSurfaceConfig": TYPED,
    "diagrams/contact_learning.py: ContactLearningConfig": TYPED,
    "diagrams/multiple_collisions.py: MultipleCollisionsConfig": TYPED,
    "diagrams/push_object_config.py: PushObjectConfig": TYPED,
    "diagrams/surface_switch.py: SurfaceSwitchConfig": TYPED,
    "diagrams/wall_friction.py: WallFrictionConfig": TYPED,
    "systems/changing_contact/forward_model.py: ForwardModelConfig": LAW,
    "systems/changing_contact/mode_detector.py: ModeDetectorConfig": LAW,
    "systems/contact_mpc/multibody/contact_pair.py: ContactPair": LAW,
    "systems/contact_mpc/numerics/c3_mpc.py: C3Options": LAW,
}  # fmt: skip


def test_settings_of_many_values_have_groups():
    """Each is named with its reason; lower the two numbers with each that is not."""
    wide = wide_configs(ROOT)
    assert wide.keys() == FLAT.keys()
    assert len(FLAT) <= 12 and max(wide.values()) <= 16, wide


def test_linked_files_exist():
    dead = [f"{d.name}: {t}" for d, t in links() if not (d.parent / t).exists()]
    assert dead == []


def test_each_change_is_in_a_group_of_the_changelog():
    """A merge has brought back an old list without groups, twice."""
    text = (ROOT / "CHANGELOG.md").read_text()
    for version in text.split("\n## ")[1:]:
        before_groups = version.split("\n### ")[0]
        assert "\n- " not in before_groups, version.splitlines()[0]


def test_one_person_can_hold_the_gap_method_in_the_head():
    words = (ROOT / "docs" / "gap_method.md").read_text().split()
    assert len(words) <= 2800

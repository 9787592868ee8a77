"""An effect lives in the catalogue: nothing that searches it knows a kind by name."""

import ast
from pathlib import Path

import pytest

from makebreak.models.effects import KINDS

ROOT = Path(__file__).resolve().parent.parent
# Objects and contact are described kind by kind (what a size or a mass does to a body
# of spheres); and a check of clocks has the name of what it suspects.
BY_NAME = {
    "gap/data/check_relations.py",
    "gap/residuals/contact.py",
    "gap/residuals/contact_dynamics.py",
    "gap/residuals/contact_problem.py",
    "gap/residuals/permitted_contacts.py",
    "gap/residuals/pressing.py",
    "gap/residuals/touch.py",
    "gap/simulation/free_body.py",
    "gap/simulation/free_windows.py",
    "gap/simulation/windows.py",
}


def kinds_named_in(path: Path) -> set[str]:
    """Kinds whose names are strings of a file. (The names of two nuisances begin with
    one, "sensor_delay of arm.j1.velocity, delay": no effect is looked up by these.)"""
    return {
        node.value
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and node.value in KINDS
    }


def test_no_kind_is_known_by_name_where_mechanisms_are_searched_and_judged():
    named = {}
    for path in sorted((ROOT / "gap").rglob("*.py")):
        name = str(path.relative_to(ROOT))
        if found := kinds_named_in(path):
            named[name] = found
    assert {k: v for k, v in named.items() if k not in BY_NAME} == {}
    assert set(named) == BY_NAME  # One that needs no names any more leaves the list.


@pytest.mark.parametrize("kind", [k for k, e in KINDS.items() if e.may_lack])
def test_what_a_kind_may_lack_are_parameters_with_a_neutral_value(kind):
    entry = KINDS[kind]
    for name in entry.may_lack:
        assert entry.parameter(name).neutral is not None
    assert len(entry.may_lack) < len(entry.parameters)

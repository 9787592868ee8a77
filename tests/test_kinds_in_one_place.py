"""What an effect is stands in models/effects/, and nowhere else."""

import ast
from pathlib import Path

import pytest

from makebreak.models.effects import KINDS

ROOT = Path(__file__).resolve().parent.parent
# Files of diagrams/ and gap/ that still know kinds by name, and which: what bodies in
# contact are fitted with, and scenes that experiments make. Mechanisms are searched and
# judged without.
# The list may only get shorter.
CONTACT = {
    "constant_force", "contact_dissipation", "contact_friction", "contact_stiffness",
    "corner_radius", "friction_patch", "length_scale", "object_com", "object_inertia",
    "object_mass", "object_size", "plane_height", "plane_tilt", "rolling_resistance",
}  # fmt: skip
KNOWN = {
    "diagrams/ball_rolling_config.py": {"contact_friction", "object_size"},
    "diagrams/cube_pivoting_config.py": {
        "contact_friction", "object_mass", "object_size"
    },
    "diagrams/push_object_scenes.py": {
        "contact_friction", "object_com", "object_mass", "object_size"
    },
    "diagrams/realism.py": {"joint_offset", "plane_height", "plane_tilt"},
    "diagrams/tabletop.py": {"contact_friction", "contact_stiffness"},
    "gap/simulation/free_body.py": CONTACT
    | {"body_drag", "body_quadratic_drag", "clock_skew", "gravity_tilt", "sensor_bias",
       "sensor_delay", "sinusoidal_force"},
    "gap/data/check_relations.py": {"clock_skew"},
    "gap/residuals/contact.py": CONTACT,
    "gap/residuals/contact_dynamics.py": {
        "actuator_bias", "actuator_gain", "input_delay", "object_com",
        "object_inertia", "object_mass", "object_size",
    },
    "gap/residuals/permitted_contacts.py": {
        "contact_friction", "friction_patch", "object_size", "plane_height",
        "plane_tilt",
    },
    "gap/residuals/felt_places.py": {"plane_height", "plane_tilt", "wall_position"},
    "gap/residuals/pressing.py": {
        "contact_friction", "contact_stiffness", "friction_patch", "plane_height",
        "plane_tilt", "wall_position",
    },
    "gap/residuals/contact_candidates.py": {
        "body_drag", "constant_force", "contact_friction", "friction_patch",
        "object_com", "object_inertia", "object_size", "plane_height",
        "plane_tilt",
    },
    "gap/residuals/contact_problem.py": {  # Of which the candidates were a part.
        "contact_friction", "friction_patch", "object_mass", "object_size",
    },
    "gap/simulation/free_windows.py": {"length_scale"},
    "gap/simulation/windows.py": {"length_scale"},
    "gap/residuals/touch.py": {
        "joint_offset", "length_scale", "object_size", "plane_height", "sensor_bias",
    },
}  # fmt: skip
FILES = sorted(
    str(path.relative_to(ROOT))
    for room in ("diagrams", "gap")
    for path in (ROOT / room).rglob("*.py")
)


@pytest.mark.parametrize("file", FILES)
def test_no_file_outside_the_catalogue_learns_a_kinds_name(file):
    tree = ast.parse((ROOT / file).read_text())
    names = {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and str(node.value) in KINDS
    }
    assert names <= KNOWN.get(file, set())


def test_the_list_of_those_that_do_names_files_that_are_there():
    assert set(KNOWN) <= set(FILES)


@pytest.mark.parametrize("kind", [k for k, e in KINDS.items() if e.may_lack])
def test_what_a_kind_may_lack_are_parameters_with_a_neutral_value(kind):
    entry = KINDS[kind]
    for name in entry.may_lack:
        assert entry.parameter(name).neutral is not None
    assert len(entry.may_lack) < len(entry.parameters)

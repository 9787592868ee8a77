"""docs/scenes.md says what the schema says, and its examples are scenes."""

import re
from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from pydrake.multibody.parsing import ModelDirective
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.effects.kind import Effect
from makebreak.models.friction_zones import FrictionZone
from makebreak.models.scene import load_scene
from makebreak.models.scene_schema import (
    COMMANDS_OF,
    SIDED,
    TOLERANCES,
    ActuationSection,
    InitialSection,
    PlantSection,
    Scene,
    SupplySection,
)

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "scenes.md").read_text()
SOLID = """<inertial><origin xyz="0 0 -0.2"/><mass value="1"/><inertia ixx="0.01"
 iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>"""
ARM = f"""<robot name="arm"><link name="base"/><link name="l1">{SOLID}</link>
<link name="l2">{SOLID}</link><joint name="j1" type="continuous"><parent link="base"/>
<child link="l1"/><axis xyz="0 1 0"/></joint><joint name="j2" type="continuous">
<parent link="l1"/><child link="l2"/><origin xyz="0 0 -0.4"/><axis xyz="0 1 0"/></joint>
</robot>"""
BOX = """<?xml version="1.0"?><sdf version="1.9"><model name="{0}"><link name="{0}">
<inertial><mass>1</mass><inertia><ixx>0.01</ixx><iyy>0.01</iyy><izz>0.01</izz></inertia>
</inertial><collision name="c"><geometry><box><size>{1}</size></box></geometry>
</collision></link></model></sdf>"""


def rows(section: str) -> dict[str, str]:
    """{key: the rest of its row} of the table below a heading."""
    text = PAGE.split(f"\n### {section}\n" if section != "Sections" else "## Sections")
    table = re.split(r"\n##", text[1])[0]
    return dict(re.findall(r"^\| `(\w+)` \|(.*)\|$", table, re.MULTILINE))


def names(schema) -> set[str]:
    return {f.name for f in fields(schema)}


@pytest.mark.parametrize(
    ("section", "keys"),
    [
        ("Sections", names(Scene)),
        ("plant", names(PlantSection)),
        ("actuation", names(ActuationSection)),
        ("initial", names(InitialSection)),
        ("tolerance", set(TOLERANCES)),
        ("friction_zones", names(FrictionZone)),
        ("effects", names(Effect)),
    ],
)
def test_every_key_is_on_the_page_and_every_key_there_exists(section, keys):
    assert set(rows(section)) == keys


@pytest.mark.parametrize(
    ("section", "schema"),
    [
        ("plant", PlantSection),
        ("actuation", ActuationSection),
        ("friction_zones", FrictionZone),
    ],
)
def test_the_defaults_of_the_page_are_those_of_the_schema(section, schema):
    for key, row in rows(section).items():
        said = yaml.safe_load(row.split("|")[0].strip().strip("`"))
        value = getattr(schema(), key)
        if said == "needed":
            assert not value
        elif key == "supply":
            assert said == "none" and value == SupplySection()
        else:
            assert said == value, key


def test_choices_and_nested_keys_are_named():
    for name in COMMANDS_OF:
        assert f"`{name}`" in rows("actuation")["type"]
    for name in names(SupplySection):
        assert f"`{name}`" in rows("actuation")["supply"]
    for commands in COMMANDS_OF.values():
        assert all(f"`{each}`" in rows("actuation")["type"] for each in commands)
    for each in ModelDirective.__fields__:
        assert f"`{each.name}`" in rows("Sections")["directives"]
    assert all(f"`{each}`" in PAGE.split("### channels")[1] for each in SIDED)


EXAMPLES = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)


def test_there_are_the_three_examples():
    assert len(EXAMPLES) == 3


@pytest.mark.parametrize("text", EXAMPLES)
def test_an_example_is_a_scene(text, tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "cube.sdf").write_text(BOX.format("cube", "0.1 0.1 0.1"))
    (tmp_path / "table.sdf").write_text(BOX.format("table", "2 2 0.1"))
    (tmp_path / "s.yaml").write_text(text)
    builder = DiagramBuilder()
    loaded = load_scene(tmp_path / "s.yaml", builder)
    builder.Build()
    assert loaded.plant.num_velocities() in (2, 6)

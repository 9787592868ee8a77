"""A scene that is written is the scene that is read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from effect_scenes import on_ground, pendulum
from pydrake.common.yaml import yaml_dump_typed
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import (
    InitialSection,
    Scene,
    initial_for,
    load_scene,
    read_scene,
)
from makebreak.models.scene_file import scene_text, write_scene

MODELS = Path(__file__).resolve().parent.parent / "models"
SHIPPED = sorted(MODELS.glob("*.scene.yaml"))


def same(one: Scene, two: Scene) -> None:
    """Of the directives, Drake's own dump has every field."""
    for a, b in zip(one.directives, two.directives, strict=True):
        assert yaml_dump_typed(a) == yaml_dump_typed(b)
    assert replace(one, directives=[]) == replace(two, directives=[])


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_scene_reads_back_as_it_was_from_any_folder(path, tmp_path):
    scene = read_scene(path)
    folder = tmp_path / "a folder" / "below"
    folder.mkdir(parents=True)
    write_scene(scene, folder / "scene.yaml")
    same(read_scene(folder / "scene.yaml"), scene)
    load_scene(folder / "scene.yaml", DiagramBuilder())


def test_every_kind_of_effect_survives_with_all_digits(tmp_path):
    effects = []
    for name, kind in KINDS.items():
        parameters = {p.name: float(np.pi * 1e-7) for p in kind.parameters}
        effects.append(Effect(name, ["p.j1"], parameters))
    effects.append(Effect("sensor_bias", ["p.j1.position", "p.j1.velocity"], {}))
    effects[-1].parameters["bias"] = -1e-300
    scene = pendulum(tmp_path)
    for effect in effects:
        # Alone: kinds that refuse such parameters are refused in both.
        try:
            write_scene(replace(scene, effects=[effect]), tmp_path / "scene.yaml")
            back = read_scene(tmp_path / "scene.yaml")
        except ValueError as error:
            assert effect.kind in str(error)
            continue
        assert back.effects == [effect]


def test_the_model_of_a_written_scene_is_found_after_both_moved(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    (here / "out").mkdir(parents=True)
    scene = pendulum(here)
    write_scene(scene, here / "out" / "scene.yaml")
    assert "file: ../p.urdf" in (here / "out" / "scene.yaml").read_text()
    here.rename(there)
    load_scene(there / "out" / "scene.yaml", DiagramBuilder())


def test_initial_states_of_episodes_survive(tmp_path):
    start = InitialSection(positions={"p.j1": 0.1}, velocities={"p.j1": -0.2})
    of = {"run 1.csv": {"0": start, "7": InitialSection(positions={"p.j1": 0.3})}}
    for initial in (InitialSection(), start):
        scene = replace(pendulum(tmp_path), initial=initial, initial_of=of)
        write_scene(scene, tmp_path / "scene.yaml")
        back = read_scene(tmp_path / "scene.yaml")
        same(back, scene)
        assert initial_for(back, "run 1.csv", 7).positions == {"p.j1": 0.3}


def test_rotations_with_their_tags_survive(tmp_path):
    text = """directives:
- add_model: {name: b, file: b.sdf, default_free_body_pose: {box: {translation:
    [0, 0, 1], rotation: !Rpy {deg: [10, 20, 30]}}}}
- add_model: {name: g, file: g.sdf}
- add_weld: {parent: world, child: "g::plate",
    X_PC: {translation: [0, 0, 0.1], rotation: !AngleAxis {angle_deg: 5, axis: [0, 1, 0]
    }}}
"""
    on_ground(tmp_path, "cube")  # Writes the models.
    (tmp_path / "in.yaml").write_text(text)
    scene = read_scene(tmp_path / "in.yaml")
    (tmp_path / "out").mkdir()
    write_scene(scene, tmp_path / "out" / "scene.yaml")
    assert "!Rpy" in (tmp_path / "out" / "scene.yaml").read_text()
    same(read_scene(tmp_path / "out" / "scene.yaml"), scene)


def test_a_person_can_read_it(tmp_path):
    effect = Effect("joint_coulomb_friction", ["p.j1"], {"coulomb": 1.8})
    scene = replace(pendulum(tmp_path), effects=[effect])
    write_scene(scene, tmp_path / "scene.yaml", "What it is.\n\nMore of it.")
    lines = (tmp_path / "scene.yaml").read_text().splitlines()
    assert lines[:3] == ["# What it is.", "#", "# More of it."]
    assert "  - add_model: {name: p, file: p.urdf}" in lines
    assert "      coulomb: 1.8  # N m" in lines
    [sentence] = [line for line in lines if "friction of" in line]
    assert "1.8 N m" in sentence and "p.j1" in sentence


def test_a_place_that_cannot_be_written_and_an_unknown_kind_are_named(tmp_path):
    scene = pendulum(tmp_path)
    with pytest.raises(ValueError, match="missing/scene.yaml cannot be written"):
        write_scene(scene, tmp_path / "missing" / "scene.yaml")
    with pytest.raises(ValueError, match="'no_such' is unknown"):
        scene_text(replace(scene, effects=[Effect("no_such", ["p"], {})]), tmp_path)


def test_models_beside_a_file_move_with_it(tmp_path):
    """Others stay where they are."""
    stage, place = tmp_path / "out" / ".stage", tmp_path / "out"
    stage.mkdir(parents=True)
    scene = pendulum(stage)
    (model,) = stage.glob("*.[us]*df")
    write_scene(scene, stage / "scene.yaml", place=place)
    for file in stage.iterdir():
        file.rename(place / file.name)
    load_scene(place / "scene.yaml", DiagramBuilder())
    text = scene_text(pendulum(tmp_path), place, stage)
    assert f"../{model.name}" in text

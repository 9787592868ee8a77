import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.ball_rolling_config import (
    BallRollingConfig,
    controller_model,
    world_scene,
)
from makebreak.diagrams.scene_facts import spheres_of
from makebreak.models.fruit import FRUITS, fruit_sdf, make_fruit
from makebreak.models.scene import load_scene


def reach(fruit, directions):
    """How far the envelope of the spheres reaches along unit vectors (n, 3) [m]."""
    b = directions @ fruit.centers.T
    inside = b**2 - (fruit.centers**2).sum(axis=1) + fruit.radii**2
    far = b + np.sqrt(np.maximum(inside, 0.0))
    return np.where(inside >= 0.0, far, 0.0).max(axis=1)


def directions(n=3000):
    u = np.random.default_rng(0).normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(3))
def test_an_orange_has_bumps_and_dents_of_three_percent(seed):
    fruit = make_fruit("orange", seed)
    r = reach(fruit, directions()) / FRUITS["orange"].radius
    assert 1.02 < r.max() <= 1.03 + 1e-9
    # A dent between spheres of 0.8 R is deeper than its own 3 % by 1 % at most.
    assert 0.96 < r.min() < 0.98 and r.std() > 0.008


def test_a_fruit_rolls_with_its_own_resistance_unless_told_otherwise():
    def lever(**changes):
        effects = world_scene(BallRollingConfig(**changes)).effects
        return [
            e.parameters["coefficient"] for e in effects
            if e.kind == "rolling_resistance"
        ]  # fmt: skip

    assert lever() == [0.005]
    assert lever(object="lime") == [FRUITS["lime"].rolling_resistance] == [0.01]
    assert lever(object="lime", rolling_resistance=0.02) == [0.02]
    assert lever(object="lime", rolling_resistance=0.0) == []


def test_a_lime_is_longer_by_twelve_percent():
    fruit = make_fruit("lime", 5)
    u = directions(20000)
    r = reach(fruit, u) / FRUITS["lime"].radius
    along, across = r[abs(u[:, 0]) > 0.98].mean(), r[abs(u[:, 0]) < 0.1].mean()
    assert along / across == pytest.approx(1.12, abs=0.03)


def test_a_seed_makes_one_fruit_and_another_seed_another():
    assert fruit_sdf(make_fruit("lime", 1)) == fruit_sdf(make_fruit("lime", 1))
    assert fruit_sdf(make_fruit("lime", 1)) != fruit_sdf(make_fruit("lime", 2))
    with pytest.raises(ValueError, match="object is pear, expected orange or lime"):
        make_fruit("pear", 0)


def test_the_model_that_drake_reads_is_the_fruit():
    fruit = make_fruit("orange", 0)
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 1e-3)
    Parser(plant).AddModelsFromString(fruit_sdf(fruit), "sdf")
    plant.Finalize()
    centers, radii = spheres_of(plant, scene_graph, "ball")
    order = np.lexsort(centers.T), np.lexsort(fruit.centers.T)
    np.testing.assert_allclose(centers[order[0]], fruit.centers[order[1]], atol=1e-9)
    np.testing.assert_allclose(radii, fruit.radii, rtol=1e-8)
    assert plant.GetBodyByName("ball").default_mass() == pytest.approx(fruit.mass)


def test_the_world_has_the_fruit_and_the_model_a_sphere_of_about_its_size():
    config = BallRollingConfig(object="lime", radius_error_m=0.002, seed=3)
    world = load_scene(world_scene(config), DiagramBuilder())
    fruit = make_fruit("lime", 3)
    assert len(spheres_of(world.plant, world.scene_graph, "ball")[1]) == len(
        fruit.radii
    )
    model, scene = controller_model(config)
    # The sphere of the lime's volume: 27 mm 1.12^(1/3), and 2 mm.
    assert model.ball_radius == pytest.approx(0.027 * 1.12 ** (1 / 3) + 0.002)
    loaded = load_scene(scene, DiagramBuilder())
    assert len(spheres_of(loaded.plant, loaded.scene_graph, "ball")[1]) == 1

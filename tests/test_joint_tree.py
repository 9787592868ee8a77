"""Compiled dynamics of a tree of joints against Drake's plant."""

from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import on_ground, with_effects
from pydrake.multibody.tree import BodyIndex
from test_driven_arm import LACKS, ROTORS, tree

from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.joint_tree import NoJointTree, joint_tree
from makebreak.systems.numerics.joint_laws import JointLaws, most_friction


@pytest.fixture
def two_ways(tmp_path):
    """The dynamics of a branching scene, compiled and by Drake, and a motion."""
    scene, _ = tree(tmp_path)
    lacks = *LACKS["friction"], *LACKS["links"], *LACKS["forces"]
    scene = with_effects(scene, *ROTORS, *lacks)
    compiled, drake = SceneDynamics(scene), SceneDynamics(scene)
    assert compiled._tree is not None
    drake._tree = None
    motion = np.random.default_rng(0).normal(size=(3, 20, 4))
    return compiled, drake, motion


def test_efforts_and_momenta_are_those_of_drake(two_ways):
    compiled, drake, (q, v, vd) = two_ways
    time = np.linspace(0.0, 2.0, len(q))
    np.testing.assert_allclose(
        compiled.inverse_dynamics(q, v, vd, time),
        drake.inverse_dynamics(q, v, vd, time), atol=1e-11,
    )  # fmt: skip
    np.testing.assert_allclose(
        compiled.momentum(q, v), drake.momentum(q, v), atol=1e-12
    )
    np.testing.assert_allclose(
        compiled.shifted(q, vd, 0.1), drake.shifted(q, vd, 0.1), atol=1e-15
    )


def test_motions_of_all_bodies_are_those_of_drake(two_ways):
    compiled, drake, (q, v, vd) = two_ways
    for k in range(compiled.plant.num_bodies()):
        for one, other in zip(
            compiled.body_motion(compiled.plant.get_body(BodyIndex(k)), q, v, vd),
            drake.body_motion(drake.plant.get_body(BodyIndex(k)), q, v, vd),
            strict=True,
        ):
            np.testing.assert_allclose(one, other, atol=1e-12)


def test_what_moves_freely_is_no_tree_of_joints(tmp_path):
    plant = SceneDynamics(on_ground(tmp_path, "ball")).plant
    with pytest.raises(NoJointTree, match="joints that turn or slide"):
        joint_tree(plant)


def test_friction_holds_with_the_most_of_its_laws_of_dry_friction():
    laws = JointLaws(
        np.array([1, 1, 0]), np.array([0, 2, 5]),
        np.array([[0.5, 0.01, 0, 0, 0], [0.2, 0.6, 0.1, 0.01, 0], [30.0, 0, 0, 0, 0]]),
    )  # fmt: skip
    # A Stribeck friction holds with its static one; a spring holds nothing.
    np.testing.assert_allclose(most_friction(laws, 3), [0.0, 1.1, 0.0])


def test_links_of_other_inertias_are_those_of_another_plant(tmp_path):
    scene, _ = tree(tmp_path)
    heavy = [
        Effect("link_mass", ["p.arm"], {"mass": -0.3}),
        Effect("link_com", ["p.arm"], {"x": 0.02, "y": -0.01, "z": 0.03}),
        Effect("link_mass", ["p.tool"], {"mass": 0.1}),
    ]
    built = SceneDynamics(replace(scene, effects=heavy))
    changed = SceneDynamics(scene).with_links(heavy)
    assert changed is not None
    q, v, vd = np.random.default_rng(1).normal(size=(3, 9, 4))
    want = built.inverse_dynamics(q, v, vd)
    np.testing.assert_allclose(changed.inverse_dynamics(q, v, vd), want, atol=1e-11)
    plain = SceneDynamics(scene).inverse_dynamics(q, v, vd)
    assert np.abs(plain - want).max() > 0.1

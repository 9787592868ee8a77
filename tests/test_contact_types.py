"""A block on its face, edge and corner: geometry, score, and a whole run."""

import numpy as np
import pytest

from makebreak.diagrams.contact_types import (
    FOOT,
    RADIUS,
    TYPES,
    ContactTypesConfig,
    height,
    make_pattern,
    make_task,
    orientation,
)
from makebreak.scripts.experiments import contact_types
from makebreak.scripts.experiments.contact_types import right_modes, strokes_of
from makebreak.scripts.runner.session import Session
from makebreak.systems.changing_contact.numerics.contact_task import PHASE_SEGMENT


def laid_flat(angle_deg):
    control = ContactTypesConfig().control
    control.align.angle_max_deg = angle_deg
    return control


def lowest(kind, tilt=10.0):
    """How many of the block's eight corners are lowest, and how low, from the tip."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    z = orientation(kind, tilt).apply(FOOT * signs)[:, 2]
    return int(np.sum(z < z.min() + 1e-9)), z.min()


@pytest.mark.parametrize("kind, feet", [("face", 4), ("edge", 2), ("corner", 1)])
def test_each_type_stands_on_its_number_of_corners_at_the_plate(kind, feet):
    n, z = lowest(kind)
    assert n == feet
    assert height(orientation(kind, 10.0)) + z - RADIUS == pytest.approx(0.0, abs=1e-12)


def test_the_corner_trails_and_the_edge_is_ahead_in_x():
    down = np.array([[x, y, -1.0] for x in (-1, 1) for y in (-1, 1)])
    corner = orientation("corner", 10.0).apply(down)
    edge = orientation("edge", 10.0).apply(down)
    assert np.argmin(corner[:, 2]) == 2 and down[2].tolist() == [1.0, -1.0, -1.0]
    assert sorted(np.argsort(edge[:, 2])[:2]) == [2, 3]


def test_the_motion_has_each_type_twice_and_lands_before_each_stroke():
    pattern, strokes = make_pattern(ContactTypesConfig())
    assert [kind for _, kind in strokes] == [*TYPES, *TYPES]
    for k, _ in strokes:
        assert pattern.ends_in_contact(k - 1)
        assert not pattern.ends_in_contact(k)
        assert pattern.length(k) == pytest.approx(0.08)


def test_friction_is_the_seed_s_or_the_given_one():
    drawn = {make_task(ContactTypesConfig(seed=s)).friction for s in range(3)}
    assert len(drawn) == 3 and all(0.1 <= mu <= 0.6 for mu in drawn)
    assert make_task(ContactTypesConfig(friction=0.25)).friction == 0.25


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(tilt_deg=60.0), "tilt_deg is 60"),
        (dict(tilt_deg=0.0), "tilt_deg is 0"),
        (dict(speed=0.0), "speed is 0"),
        (dict(normal_force=-1.0), "normal_force is -1"),
        (
            dict(control=laid_flat(4.0), tilt_deg=4.0),
            "angle_max_deg is 4",
        ),
    ],
)
def test_bad_settings_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        make_task(ContactTypesConfig(**change))


@pytest.mark.parametrize(
    "modes, right",
    [
        ([1, 2, 3, 1, 2, 3], [True] * 6),
        ([2, 1, 3, 2, 1, 3], [True] * 6),  # The numbers themselves do not matter.
        ([1, 1, 3, 1, 1, 3], [False, False, True, False, False, True]),
        ([1, 2, 3, 1, 2, 4], [True] * 5 + [False]),
        ([1, -1, 3, 1, 2, 3], [True, False, True, True, False, True]),
    ],
)
def test_a_mode_is_right_if_it_is_its_type_s_alone(modes, right):
    strokes = [
        {"kind": kind, "mode": mode, "modes": 1}
        for kind, mode in zip([*TYPES, *TYPES], modes, strict=True)
    ]
    assert right_modes(strokes) == right
    strokes[0]["modes"] = strokes[4]["modes"] = 2  # By turns: not one mode.
    one_each = [r and k not in (0, 4) for k, r in enumerate(right)]
    assert right_modes(strokes) == one_each


def test_a_stroke_has_the_mode_of_its_end_and_the_feature_before_it():
    task = make_task(ContactTypesConfig(seed=1))
    k, _ = task.strokes[0]
    time = np.arange(0.0, 3.0, 0.001)
    n = len(time)
    on = (time >= 1.0) & (time < 2.5)
    phase = np.zeros((n, 6))
    phase[:, PHASE_SEGMENT] = np.where(on, k, np.where(time < 1.0, k - 1, k + 1))
    mode = np.where(on & (time >= 1.2), 4.0, np.where(on, -1.0, 0.0))
    mode[(time >= 1.1) & (time < 1.15)] = 2.0
    log = {
        "time": time,
        "phase": phase,
        "mode": mode[:, None],
        "wrench": np.tile([1.8, 2.4, 10.0, 0.03, 0.04, 0.0], (n, 1)),
        # It stands for the last 0.1 s.
        "direction": np.where(on & (time < 2.4), 1.0, 0.0)[:, None] * [0.0, 1.0, 0.0],
    }
    (stroke,) = strokes_of(log, task)[:1]
    assert stroke["kind"] == "face" and stroke["mode"] == 4 and stroke["modes"] == 2
    assert stroke["delay"] == pytest.approx(0.2, abs=2e-3)
    np.testing.assert_allclose(stroke["feature"], [0.3, 0.005])


@pytest.mark.slow
@pytest.mark.parametrize("realism, seed", [("none", 0), ("lab", 3)])
def test_face_edge_and_corner_are_found_and_recognised(tmp_path, realism, seed):
    # On the table of seed 3, tilted by 0.5 deg, a block that is not laid flat stands on
    # an edge: face and edge are one mode then, and 2 of 6 strokes are right.
    result = contact_types.run(
        ContactTypesConfig(seed=seed, realism=realism),
        Session(tmp_path, progress=False),
    )
    assert result["success"], result["criteria"]
    # The edge is 9.7 mm beside the tip, and friction adds to its moment.
    assert 0.009 < result["torque_arm_edge_m"] < 0.015
    assert result["torque_arm_face_m"] < 0.005

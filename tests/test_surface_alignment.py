"""A tool that is laid flat on what it is pressed on."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from makebreak.systems.arm.numerics.surface_alignment import (
    ACCELERATION,
    N_MEMORY,
    PHI,
    AlignmentLaw,
    W,
    tick,
    turned,
)
from makebreak.systems.arm.surface_alignment import (
    SurfaceAlignment,
    SurfaceAlignmentConfig,
)

LAW = AlignmentLaw(angle_max=np.deg2rad(1.5))
DOWN = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
FORCE, FOOT = 8.0, 0.012  # Pressed with [N]; from the centre to the feet [m].
FEET_STIFFNESS = 4 * 2e4 * FOOT**2  # Of four feet against turning [N m/rad].


def moment_of_feet(tilt, phi):
    """Of a face on four springy feet, tilted against the surface by phi - tilt (3,)
    [rad]: linear as long as all stand, at most that of one row of feet."""
    return np.clip(FEET_STIFFNESS * (tilt - phi), -FORCE * FOOT, FORCE * FOOT)


def pressed(moment, seconds, memory=None, rows=DOWN):
    """The memories of a tool that is pressed, moment(phi) (3,) about its tip."""
    memory = np.zeros(N_MEMORY) if memory is None else memory
    out = []
    for _ in range(round(seconds / LAW.period)):
        wrench = np.array([0.0, 0.0, FORCE, *moment(memory[PHI])])
        memory = tick(LAW, memory, wrench, rows)
        out.append(memory)
    return np.array(out)


@pytest.mark.parametrize("direction", [0.0, 0.7, 2.5])
def test_a_face_comes_to_lie_on_a_surface_of_half_a_degree(direction):
    tilt = np.deg2rad(0.5) * np.array([np.cos(direction), np.sin(direction), 0.0])
    last = pressed(lambda phi: moment_of_feet(tilt, phi), 0.5)[-1]
    # It goes at speed_max, 0.1 rad/s, and then with FEET_STIFFNESS / damping = 11.5/s:
    # within 0.5 s to exp(-11.5 (0.5 - 0.09)) of 9 mrad.
    np.testing.assert_allclose(last[PHI], tilt, atol=2e-4)
    assert np.linalg.norm(moment_of_feet(tilt, last[PHI])) < 0.03 * FORCE * FOOT


def test_an_edge_leans_as_far_as_it_may_and_comes_back_in_the_air():
    edge = np.array([0.0, -FORCE * 0.0097, 0.0])
    memories = pressed(lambda _: edge, 1.0)
    angle = np.linalg.norm(memories[:, PHI], axis=1)
    assert angle.max() <= 1.02 * LAW.angle_max and angle[-1] > 0.9 * LAW.angle_max
    back = pressed(lambda _: edge, 1.0, memories[-1], np.zeros(6))
    assert np.linalg.norm(back[-1][PHI]) < 1e-3 * LAW.angle_max


def test_the_moment_about_the_normal_two_surfaces_and_bad_wrenches_turn_nothing():
    assert not pressed(lambda _: np.array([0.0, 0.0, 0.05]), 0.2).any()
    two = np.array([0.0, 0.0, -1.0, 1.0, 0.0, 0.0])
    assert not pressed(lambda _: np.array([0.05, 0.0, 0.0]), 0.2, rows=two).any()
    assert not pressed(lambda _: np.full(3, np.nan), 0.2).any()
    hardly = np.array([0.0, 0.0, 0.5, 0.05, 0.0, 0.0])
    assert not tick(LAW, np.zeros(N_MEMORY), hardly, DOWN).any()


def test_the_reference_turns_with_its_derivatives():
    memories = pressed(lambda _: np.array([0.03, -0.04, 0.0]), 0.1)
    planned = np.zeros(19)
    start = Rotation.from_rotvec([0.1, 0.4, -0.2])
    planned[3:7] = start.as_quat(scalar_first=True)
    planned[10:13], planned[16:19] = [0.1, 0.2, 0.3], [1.0, 2.0, 3.0]
    x = np.array([turned(memory, planned) for memory in memories])
    for row, memory in zip(x[::20], memories[::20], strict=True):
        both = Rotation.from_rotvec(memory[PHI]) * start
        expected = both.as_quat(scalar_first=True)
        np.testing.assert_allclose(row[3:7], expected, atol=1e-12)
    # The direction of turning is constant here, so that w is the derivative of phi.
    phi, w = memories[:, PHI], x[:, 10:13] - planned[10:13]
    np.testing.assert_allclose(np.diff(phi, axis=0) / LAW.period, w[1:], atol=1e-12)
    acceleration = x[:, 16:19] - planned[16:19]
    np.testing.assert_allclose(
        np.diff(w, axis=0) / LAW.period, acceleration[1:], atol=1e-10
    )
    np.testing.assert_allclose(memories[:, W], w, atol=1e-12)
    assert abs(memories[0, ACCELERATION]).max() > 0.5


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(angle_max_deg=0.0), "angle_max_deg is 0"),
        (dict(angle_max_deg=np.nan), "angle_max_deg is nan"),
        (dict(angle_max_deg=1.0, damping=0.0), "damping is 0"),
        (dict(angle_max_deg=1.0, speed_max=np.inf), "speed_max is inf"),
    ],
)
def test_bad_settings_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        SurfaceAlignment(SurfaceAlignmentConfig(**change))

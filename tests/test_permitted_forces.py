"""Forces that a contact model permits, against scipy, brute force and closed forms."""

import numpy as np
import pytest
from scipy.optimize import nnls

from makebreak.gap.numerics import permitted_forces
from makebreak.gap.numerics.permitted_forces import (
    explain,
    nonnegative,
    roots_of,
    tangential,
    tangents,
    unshared_load,
)

FREE = np.zeros((1, 0, 4))  # No load of a foot is more likely than another.


def test_slip_is_what_lies_in_the_plane_of_contact():
    rng = np.random.default_rng(0)
    u, normal = rng.normal(size=(2, 20, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    slip = tangential(u, normal)
    np.testing.assert_allclose(np.sum(slip * normal, axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(u - slip, normal), 0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(40))
def test_weights_that_are_not_negative_agree_with_scipy(seed):
    rng = np.random.default_rng(seed)
    m, k = rng.integers(3, 12), rng.integers(1, 30)
    A, y = rng.normal(size=(m, k)), rng.normal(size=m)
    if seed % 2:  # Columns that say the same, as four feet of a block do.
        A = np.hstack([A, A[:, :1] + A[:, -1:], 2.0 * A[:, :1]])
    x = np.zeros(A.shape[1])
    nonnegative(A, y, x, 400)
    assert (x >= 0.0).all()
    # The error is unique, the weights need not be.
    least = nnls(A, y)[1]
    assert np.linalg.norm(A @ x - y) == pytest.approx(least, abs=1e-6)


def uneven(rng, n=200):
    t = np.sort(rng.uniform(0.0, 1.0, n))
    return t[np.concatenate([[True], np.diff(t) > 1e-6])]


def test_test_functions_are_exact_for_cubics_on_uneven_samples():
    rng = np.random.default_rng(0)
    t, half = uneven(rng), 0.08
    centres = np.linspace(0.1, 0.9, 33)
    mean, second = permitted_forces.test_functions(t, centres, half)
    c = rng.normal(size=4)
    y = np.polynomial.polynomial.polyval(t, c)
    # The mean of (t - c)^2 under (1 - u^2)^4 is half^2/11, by integration.
    at = np.polynomial.polynomial.polyval(centres, c)
    bend = 2.0 * c[2] + 6.0 * c[3] * centres
    np.testing.assert_allclose(mean @ y, at + 0.5 * bend * half**2 / 11.0, atol=1e-10)
    np.testing.assert_allclose(second @ y, bend, atol=1e-7)


def test_mean_acceleration_of_a_sine_is_the_mean_of_its_second_derivative():
    t = np.arange(0.0, 1.0, 0.002)
    centres = np.linspace(0.1, 0.9, 20)
    mean, second = permitted_forces.test_functions(t, centres, 0.05)
    w = 2 * np.pi * 3.0
    np.testing.assert_allclose(
        second @ np.sin(w * t), mean @ (-(w**2) * np.sin(w * t)), atol=1e-3 * w**2
    )


def test_where_samples_are_missing_there_is_no_mean():
    t = np.concatenate([np.arange(0.0, 0.4, 0.01), np.arange(0.6, 1.0, 0.01)])
    mean, _ = permitted_forces.test_functions(t, [0.2, 0.5, 0.59, 0.8], 0.06)
    assert [bool(row.nnz) for row in mean] == [True, False, False, True]


def block_on_feet(mu: float, slip):
    """Generators (6, 4) of four feet at +-0.1, +-0.05, 0.04 below the centre of mass,
    that slide along slip (2,): moments about it, then forces."""
    out = []
    for a in (-1, 1):
        for b in (-1, 1):
            f = np.array([-mu * slip[0], -mu * slip[1], 1.0])
            arm = np.array([0.1 * a, 0.05 * b, -0.04])
            out.append(np.concatenate([np.cross(arm, f), f]))
    return np.array(out).T


def test_a_sliding_block_is_explained_by_its_own_friction_alone():
    """Slowed by mu g: force m a = -mu m g along the slip, weight carried by the feet.
    With a friction of 0.3 for 0.2 a tenth of the weight is left."""
    m, g, mu = 0.8, 9.81, 0.2
    slip = np.array([0.6, 0.8])
    P = np.array([[0.0, 0.0, 0.0, -mu * m * g * slip[0], -mu * m * g * slip[1], m * g]])
    root = roots_of(np.eye(6)[None] * 1e-6)
    found = {}
    for tried in (0.2, 0.3):
        G = block_on_feet(tried, slip)[None]
        left, weights = np.zeros((1, 6)), np.zeros((1, 4))
        rank = np.zeros(1, np.int64)
        explain(P, G, np.ones((1, 4), bool), root, FREE, left, weights, rank)
        found[tried] = 1e-3 * left[0], weights[0], rank[0]
    left, weights, rank = found[0.2]
    np.testing.assert_allclose(left, 0.0, atol=1e-7)
    assert weights.sum() == pytest.approx(m * g)
    # In front of the centre of mass the feet carry more: the moment of friction.
    front = np.array([-1, -1, 1, 1]) @ weights * 0.1
    assert front == pytest.approx(mu * m * g * 0.6 * 0.04, rel=1e-6)
    left = found[0.3][0]
    # Least squares gives up some of the weight for some of the friction.
    assert np.linalg.norm(left) == pytest.approx(
        0.1 * m * g / np.sqrt(1.0 + 0.3**2), rel=1e-3
    )


def test_of_loads_that_explain_alike_those_are_taken_that_share_it():
    """Four feet hold three balances; springs that are alike share the rest: the least
    sum of squares."""
    G = block_on_feet(0.0, np.zeros(2))[None]
    even = np.array([2.0, 1.5, 2.5, 2.0])  # Of which no diagonal part is left:
    diagonal = np.array([1.0, -1.0, -1.0, 1.0])
    even = even - (even @ diagonal) / 4.0 * diagonal
    P = np.einsum("nmk,k->nm", G, even + 0.7 * diagonal)
    left, weights = np.zeros((1, 6)), np.zeros((1, 4))
    rank = np.zeros(1, np.int64)
    root = roots_of(np.eye(6)[None] * 1e-4)
    feet = [(0.1 * x, 0.05 * y) for x in (-1, 1) for y in (-1, 1)]
    share = unshared_load(feet)
    np.testing.assert_allclose(np.abs(share), 0.5, atol=1e-12)
    explain(
        P, G, np.ones((1, 4), bool), root, 0.1 * share[None], left, weights, rank
    )  # fmt: skip
    # Nothing of the balance is given up for it.
    np.testing.assert_allclose(weights[0], even, atol=1e-6)
    np.testing.assert_allclose(left, 0.0, atol=1e-6)


def test_three_points_share_in_one_way_and_those_on_a_line_in_more():
    assert unshared_load([(0, 0), (1, 0), (0, 1)]).shape == (0, 3)
    assert unshared_load([(0, 0), (1, 0), (2, 0)]).shape == (1, 3)


def test_a_foot_cannot_pull():
    P = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -5.0]])
    G = block_on_feet(0.2, np.array([1.0, 0.0]))[None]
    left, weights = np.zeros((1, 6)), np.zeros((1, 4))
    rank = np.zeros(1, np.int64)
    explain(P, G, np.ones((1, 4), bool), np.eye(6)[None], FREE, left, weights, rank)
    np.testing.assert_allclose(left, P, atol=1e-12)
    assert rank[0] == 0 and (weights == 0.0).all()
    # Nor does what is not there.
    explain(-P, G, np.zeros((1, 4), bool), np.eye(6)[None], FREE, left, weights, rank)
    np.testing.assert_allclose(left, -P, atol=1e-12)


def test_roots_make_noise_of_unit_size():
    rng = np.random.default_rng(1)
    B = rng.normal(size=(3, 4, 4))
    C = B @ B.transpose(0, 2, 1) + 0.1 * np.eye(4)
    root = roots_of(C)
    np.testing.assert_allclose(
        root @ C @ root.transpose(0, 2, 1), np.broadcast_to(np.eye(4), C.shape),
        atol=1e-9,
    )  # fmt: skip


def test_means_of_a_held_signal_are_its_integral():
    rng = np.random.default_rng(2)
    t = uneven(rng, 60)
    y, centres, half = rng.normal(size=len(t)), np.linspace(0.2, 0.8, 7), 0.07
    fine = np.linspace(0.0, 1.2, 600_001)
    held = y[np.clip(np.searchsorted(t, fine, "right") - 1, 0, None)]
    expected = []
    for c in centres:
        w = np.maximum(1.0 - ((fine - c) / half) ** 2, 0.0) ** 4
        expected.append(np.sum(w * held) / np.sum(w))
    got = permitted_forces.held_means(t, centres, half) @ y
    np.testing.assert_allclose(got, expected, atol=1e-3)


def test_directions_across_a_normal_turn_with_it():
    """A cone is a mean over a while. Directions that jumped as a normal turned through
    44 degrees took the friction of a tool away for as long."""
    angle = np.radians(np.linspace(30.0, 330.0, 301))
    z = np.full(len(angle), 0.02)
    ways = [[np.cos(angle), np.sin(angle), z], [z, np.cos(angle), np.sin(angle)]]
    some = np.random.default_rng(0).normal(size=(50, 3))
    for normal in (*(np.transpose(each) for each in ways), some, np.eye(3)):
        n = normal / np.linalg.norm(normal, axis=1)[:, None]
        e1, e2 = tangents(n)
        frames = np.stack([n, e1, e2], axis=1)
        square = frames @ frames.transpose(0, 2, 1)
        np.testing.assert_allclose(
            square, np.tile(np.eye(3), (len(n), 1, 1)), atol=1e-12
        )
        if len(n) == len(angle):
            steps = np.linalg.norm(np.diff(frames, axis=0), axis=2)
            assert steps.max() < 1.1 * np.radians(1.0)
    assert tangents(np.zeros((0, 3)))[0].shape == (0, 3)

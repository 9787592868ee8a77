from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.solvers import MathematicalProgram, MobyLcpSolver
from scipy.optimize import linprog

from makebreak.systems.contact_mpc.numerics.lcp import (
    SOLVED,
    solve_lcp,
    solve_lcp_kernel,
)

REFERENCE = Path(__file__).parent / "reference"


def brute_force_lcp(F, q):
    """Tries all 2^n contact modes; a lam that satisfies the definition, or None."""
    for mode in product([False, True], repeat=len(q)):
        lam, on = np.zeros(len(q)), np.flatnonzero(mode)
        lam[on] = np.linalg.lstsq(F[np.ix_(on, on)], -q[on], rcond=None)[0]
        w = F @ lam + q
        if (lam >= -1e-9).all() and (w >= -1e-9).all() and abs(w @ lam) < 1e-9:
            return np.maximum(lam, 0.0)
    return None


def assert_solves(F, q, lam):
    """The definition, to 1e-9 of the size of the terms that are summed."""
    size = np.abs(q) + np.abs(F) @ lam + np.finfo(float).tiny
    w = F @ lam + q
    assert (lam >= 0.0).all()
    assert (w >= -1e-9 * size.max()).all()
    assert (
        np.minimum(np.abs(w) / size.max(), lam / max(lam.max(), 1e-300)) < 1e-9
    ).all()


@pytest.mark.parametrize("seed", range(20))
def test_positive_definite_F_agrees_with_brute_force(seed):
    rng = np.random.default_rng(seed)
    J, q = rng.normal(size=(6, 6)), rng.normal(size=6)
    F = J @ J.T + 0.1 * np.eye(6)  # Condition < 400, so 1e-16 grows to 1e-13 at most.
    np.testing.assert_allclose(solve_lcp(F, q), brute_force_lcp(F, q), atol=1e-11)


@pytest.mark.parametrize("seed", range(20))
def test_singular_F_agrees_with_brute_force_in_w(seed):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(8, 3))
    F = J @ J.T
    q = np.maximum(rng.normal(size=8), 0.0) - F @ np.maximum(rng.normal(size=8), 0.0)
    lam = solve_lcp(F, q)
    assert_solves(F, q, lam)
    # lam is not unique but F lam is, for symmetric F.
    np.testing.assert_allclose(F @ lam, F @ brute_force_lcp(F, q), atol=1e-8)


@pytest.mark.parametrize("seed", range(20))
def test_unsymmetric_semidefinite_F_is_solved(seed):
    rng = np.random.default_rng(seed)
    J, S = rng.normal(size=(7, 2)), rng.normal(size=(7, 7))
    F = J @ J.T + S - S.T
    q = -F @ np.maximum(rng.normal(size=7), 0.0) + np.maximum(rng.normal(size=7), 0.0)
    assert_solves(F, q, solve_lcp(F, q))


def test_it_raises_exactly_where_no_w_is_feasible():
    # For semi-definite F a solution exists if and only if some lam >= 0 has w >= 0,
    # which a linear program decides.
    rng, raised = np.random.default_rng(0), 0
    for _ in range(60):
        n = rng.integers(2, 11)
        J, q = rng.normal(size=(n, 2)), rng.normal(size=n)
        F = J @ J.T
        feasible = linprog(np.zeros(n), A_ub=-F, b_ub=q, bounds=(0, None)).status == 0
        if feasible:
            assert_solves(F, q, solve_lcp(F, q))
        else:
            raised += 1
            with pytest.raises(ValueError, match="no solution"):
                solve_lcp(F, q)
    assert 10 < raised < 50  # Both cases occurred.


def test_a_solvable_lcp_on_which_lemke_ends_in_a_ray_is_solved():
    F = np.array([[0.0, 1.0], [1.0, 0.0]])  # Copositive, not semi-definite.
    np.testing.assert_allclose(solve_lcp(F, -np.ones(2)), [1.0, 1.0], rtol=1e-12)


def any_lcp(rng, n):
    """F of no particular kind, rows and columns of mixed scales; q at random."""
    F = rng.normal(size=(n, n)) * (rng.random((n, n)) < rng.uniform(0.3, 1.0))
    F *= 10.0 ** rng.uniform(-2, 2, n)[:, None]
    return F, rng.normal(size=n)


def test_any_F_is_solved_where_enumeration_finds_a_solution():
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        F, q = any_lcp(rng, rng.integers(1, 7))
        try:
            lam = solve_lcp(F, q)
        except ValueError:
            refused += 1
            assert brute_force_lcp(F, q) is None
            continue
        assert_solves(F, q, lam)
    assert 20 < refused < 250  # Both cases occurred.


def cube_on_a_plane(rng, corners=8, edges=4):
    """The LCP of Stewart and Trinkle, unknowns [normal, friction, sliding speed], of a
    cube of random size, mass, friction, orientation, height and velocity."""
    dt, m, a = 10.0 ** rng.uniform([-3, -2, -2], [-1, 1, 0])
    mu, R = rng.uniform(0.0, 1.0), np.eye(3)
    if rng.random() < 0.5:
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    p = 0.5 * a * np.array(list(product([-1, 1], repeat=3))) @ R.T
    p = p[np.argsort(p[:, 2])[:corners]]
    M_inv = np.diag([6.0 / (m * a**2)] * 3 + [1.0 / m] * 3)
    height = rng.choice([0.0, 1e-3 * rng.normal(), 0.05 * rng.random()])
    J_n, J_t = [], []
    for x, y, z in p:
        J = np.array([[0, z, -y, 1, 0, 0], [-z, 0, x, 0, 1, 0], [y, -x, 0, 0, 0, 1.0]])
        J_n.append(J[2])
        for k in range(edges // 2):
            angle = 2.0 * np.pi * k / edges
            t = np.cos(angle) * J[0] + np.sin(angle) * J[1]
            J_t += [t, -t]
    J, n = np.array(J_n + J_t), corners
    E_t, v = np.kron(np.eye(n), np.ones((edges, 1))), rng.normal(size=6)
    v = v * rng.choice([0.0, 0.1, 1.0]) - dt * 9.81 * np.eye(6)[5]
    F, q = np.zeros((n * (edges + 2), n * (edges + 2))), np.zeros(n * (edges + 2))
    F[: len(J), : len(J)] = dt * J @ M_inv @ J.T
    F[n : len(J), len(J) :] = E_t
    F[len(J) :, :n], F[len(J) :, n : len(J)] = mu * np.eye(n), -E_t.T
    q[: len(J)] = J @ v
    q[:n] += (height + p[:, 2] - p[:, 2].min()) / dt
    return F, q


@pytest.mark.parametrize("trials", [60, pytest.param(600, marks=pytest.mark.slow)])
@pytest.mark.parametrize("corners", [4, 8])
def test_a_cube_on_a_plane_with_coulomb_friction_is_solved(corners, trials):
    rng = np.random.default_rng(0)
    for _ in range(trials):
        F, q = cube_on_a_plane(rng, corners)
        assert_solves(F, q, solve_lcp(F, q))


def pinched_cube(rng):
    """The LCP of Stewart and Trinkle of a light cube that stands on a plane between two
    fingers, each of which may touch a face and, as well, the four corners below."""
    (dt, m), a, r, eye = 10.0 ** rng.uniform([-3, -3], [-1, 0]), 0.06, 0.01, np.eye(3)
    mu, edges = rng.choice([0.01, 0.5, 3.0]), 4
    M_inv = np.diag([6.0 / (m * a**2)] * 3 + [1.0 / m] * 3 + [1.0 / 0.3] * 6)
    corners = [0.5 * a * np.array([*xy, -1]) for xy in product([-1, 1], repeat=2)]
    contacts = [(p, None, eye[2], 0.0) for p in corners]
    for finger, side in ((0, 1.0), (1, -1.0)):
        contacts.append((side * 0.5 * a * eye[0], finger, -side * eye[0], r))
        for p in corners:
            to_corner = p - side * (0.5 * a + r) * eye[0]
            distance = np.linalg.norm(to_corner)
            contacts.append((p, finger, to_corner / distance, distance - r))
    J_n, J_t = [], []
    for (x, y, z), finger, n, _ in contacts:
        J = np.zeros((3, 12))
        J[:, :6] = [[0, z, -y, 1, 0, 0], [-z, 0, x, 0, 1, 0], [y, -x, 0, 0, 0, 1]]
        if finger is not None:
            J[:, 6 + 3 * finger : 9 + 3 * finger] = -eye
        t1 = np.cross(n, eye[np.argmin(np.abs(n))])
        t1 /= np.linalg.norm(t1)
        J_n.append(n @ J)
        J_t += [t @ J for t in (t1, -t1, np.cross(n, t1), -np.cross(n, t1))]
    J, n = np.array(J_n + J_t), len(contacts)
    E_t, v = np.kron(np.eye(n), np.ones((edges, 1))), 0.5 * rng.normal(size=12)
    v[5] -= dt * 9.81
    F, q = np.zeros((n * (edges + 2), n * (edges + 2))), np.zeros(n * (edges + 2))
    F[: len(J), : len(J)] = dt * J @ M_inv @ J.T + 0.01 * dt * np.eye(len(J))
    F[n : len(J), len(J) :] = E_t
    F[len(J) :, :n], F[len(J) :, n : len(J)] = mu * np.eye(n), -E_t.T
    q[: len(J)] = J @ v
    q[:n] += np.array([gap for *_, gap in contacts]) / dt
    return F, q


def test_a_light_cube_between_two_fingers_is_solved():
    # 84 unknowns, many of one kind. Rounding over many pivots made Lemke end in a ray,
    # and the search behind it then gave 1e17 N, beside which any breach looked small.
    rng = np.random.default_rng(0)
    for _ in range(60):
        F, q = pinched_cube(rng)
        lam = solve_lcp(F, q)
        w = F @ lam + q
        size = np.abs(q).max()  # Of speeds: no breach is excused by large forces.
        assert w.min() > -1e-6 * size
        assert np.minimum(np.abs(w), lam).max() < 1e-6 * max(size, lam.max())
        assert lam.max() < 1e6 * size


def test_the_smallest_cube_problems_agree_with_drakes_moby_solver_in_motion():
    """Where Moby's answer obeys the definition (it does not check itself): for a
    frictionless cube F is semi-definite, and then F lam is unique."""
    rng, compared = np.random.default_rng(0), 0
    for _ in range(30):
        F, q = cube_on_a_plane(rng, 4)
        F, q = F[:4, :4], q[:4]
        prog = MathematicalProgram()
        z = prog.NewContinuousVariables(4)
        prog.AddLinearComplementarityConstraint(F, q, z)
        result = MobyLcpSolver().Solve(prog)
        ok, lam = result.is_success(), result.GetSolution(z)
        w = F @ lam + q
        size = np.abs(q).max()
        if not ok or w.min() < -1e-9 * size or lam.min() < 0.0 or abs(w @ lam) > 1e-9:
            continue
        compared += 1
        ours = F @ solve_lcp(F, q)
        np.testing.assert_allclose(ours, F @ lam, atol=1e-7 * size)
    assert compared > 15


def flat_body_in_a_turned_world(rng, eps_c):
    """The LCP of Stewart and Trinkle, unknowns [normal, friction, sliding speed], of a
    body that moves in a plane which is no plane of the world's axes. Across the plane
    nothing moves; what stands there in F and q is rounding. Some contacts are
    doubled."""
    (m, a, dt), n = 10.0 ** rng.uniform([-6, -2, -3], [6, 0, -1]), rng.integers(1, 6)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    across = R @ [0.0, 1.0, 0.0]
    S = np.zeros((6, 3))  # Twist [w, v] of [x, z, turn].
    S[3:, 0], S[3:, 1], S[:3, 2] = R[:, 0], R[:, 2], across
    M_inv, J_n, J_t = np.diag([1.0 / m, 1.0 / m, 6.0 / (m * a**2)]), [], []
    for _ in range(n):
        if not J_n or rng.random() < 0.7:
            p = R @ (0.5 * a * rng.choice([-1.0, 1.0], 3) * [1, 0, 1])
            angle = rng.choice([0.5 * np.pi, 2.0 * np.pi * rng.random()])
            normal = R @ [np.cos(angle), 0.0, np.sin(angle)]
            along = np.cross(across, normal)
        row = [np.concatenate([np.cross(p, e), e]) @ S for e in (normal, along, across)]
        J_n.append(row[0])
        J_t += [row[1], -row[1], row[2], -row[2]]
    J, mu = np.array(J_n + J_t), rng.choice([0.1, 0.5, 1.0])
    E_t, v = np.kron(np.eye(n), np.ones((4, 1))), rng.normal(size=3)
    v = v * rng.choice([0.0, 0.1, 1.0]) - dt * 9.81 * np.eye(3)[1]
    F, q = np.zeros((6 * n, 6 * n)), np.zeros(6 * n)
    F[: len(J), : len(J)] = dt * (J @ M_inv @ J.T + eps_c * np.eye(len(J)))
    F[n : len(J), len(J) :] = E_t
    F[len(J) :, :n], F[len(J) :, n : len(J)] = mu * np.eye(n), -E_t.T
    q[: len(J)] = J @ v
    q[:n] += rng.choice([0.0, 0.01 * a], n) / dt
    return F, q, 5 * n


@pytest.mark.parametrize("eps_c", [0.0, 0.01])
def test_directions_in_which_nothing_moves_set_no_scale(eps_c):
    # F[i, i] of 1e-32 made forces 700 times outside of the friction cone look right.
    rng, touching = np.random.default_rng(0), 0
    for _ in range(200):
        F, q, n = flat_body_in_a_turned_world(rng, eps_c)
        order = rng.permutation(q.size)
        lam = np.empty(q.size)
        lam[order] = solve_lcp(F[np.ix_(order, order)], q[order])
        w, speed = F @ lam + q, np.abs(q).max()
        force = max(lam[:n].max(), 1e-6 * speed / np.diag(F).max())
        touching += lam[:n].max() > 0.0
        assert w[:n].min() > -1e-8 * speed and w[n:].min() > -1e-8 * force
        assert np.minimum(w[:n] / speed, lam[:n] / force).max() < 1e-8
        assert np.minimum(w[n:] / force, lam[n:] / speed).max() < 1e-8
        # No force does work that nobody put in: the motion loses energy.
        v_lam = F[:n, :n] @ lam[:n]
        assert lam[:n] @ (0.5 * v_lam + q[:n]) <= 1e-8 * speed * force
    assert touching > 80


def test_friction_of_a_flat_cube_stays_within_its_cone():
    # From the contacts of a planar cube with two fingers, [sliding speeds, normals,
    # edges]; F[i, i] of the edges out of the plane is 1e-25.
    case = np.load(REFERENCE / "lcp_st_cube.npz")
    F, q = case["F"], case["q"]
    lam, mu = solve_lcp(F, q), F[[0, 1, 2], [3, 4, 5]]
    edges = lam[6:].reshape(3, 4)
    assert (edges.sum(axis=1) <= mu * lam[3:6] + 1e-9 * lam.max()).all()
    # What moves is what moves with zeros in the place of the rounding.
    exact = np.where(np.abs(F) < 1e-20, 0.0, F)
    np.testing.assert_allclose(
        F[3:, 3:] @ lam[3:], exact[3:, 3:] @ solve_lcp(exact, q)[3:], atol=1e-9
    )


@pytest.mark.parametrize("decades", [2, 6])
def test_a_light_body_beside_a_heavy_one_is_solved_on_its_own_scale(decades):
    # Two blocks, each on a table: the closed form holds for each to the same digits.
    m, dt = np.array([10.0**decades, 10.0**-decades]), 0.01
    lam = solve_lcp(np.diag(dt / m), np.full(2, -9.81 * dt))
    np.testing.assert_allclose(lam, 9.81 * m, rtol=1e-12)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(-6.0, 6.0),
    st.floats(-6.0, 6.0),
    st.floats(0.0, 6.0),
)
def test_contact_lcps_of_any_scale_are_solved(seed, of_F, of_q, spread):
    """F = J J' + eps_c, singular or nearly, in units 1e-6 to 1e6, rows of mixed ones;
    q is such that there is a solution."""
    rng = np.random.default_rng(seed)
    n = rng.integers(1, 17)
    J = rng.normal(size=(n, rng.integers(1, n + 1)))
    F = J @ J.T + rng.choice([0.0, 1e-12, 1e-9, 1e-6]) * np.eye(n)
    lam, w = (np.maximum(rng.normal(size=n), 0.0) for _ in range(2))
    q = np.where(lam > 0.0, 0.0, w) - F @ lam
    s = 10.0 ** (spread * rng.uniform(-0.5, 0.5, n))
    F, q = 10.0**of_F * s[:, None] * F * s, 10.0**of_q * s * q
    ours = solve_lcp(F, q)
    # In units in which the rows are of one size, as solve_lcp promises.
    unit = 1.0 / np.sqrt(np.diag(F))
    assert_solves(unit[:, None] * F * unit, unit * q, ours / unit)


def test_gaps_that_open_far_faster_spoil_no_small_force():
    """Steps of a motion of 1 g beside pairs that part 1e4 times as fast as it closes:
    ties among the small speeds were rounding beside the large ones. With the largest
    |q| as the only unit neither was solved."""
    with np.load(REFERENCE / "lcp_opening_gaps.npz") as case:
        for i in range(2):
            F, q = case[f"F{i}"], case[f"q{i}"]
            assert_solves(F, q, solve_lcp(F, q))


def test_friction_stops_a_block_however_slowly_it_slides():
    """A block of 1 kg that lands at 1 m/s, with eight friction edges: beside its normal
    speed all edges of a slip below 1e-12 were tied, and no answer was precise."""
    angle, rng = 0.25 * np.pi * np.arange(8), np.random.default_rng(0)
    t, F = np.column_stack([np.cos(angle), np.sin(angle)]), np.zeros((10, 10))
    F[0, 0], F[1:9, 1:9] = 1.0, t @ t.T
    F[:9, :9] += 1e-3 * np.eye(9)
    F[1:9, 9], F[9, 0], F[9, 1:9] = 1.0, 0.5, -1.0
    for decade in range(-15, 0):
        for _ in range(8):
            slip = 10.0**decade * rng.uniform(-1.0, 1.0, 2)
            lam = solve_lcp(F, np.array([-1.0, *(t @ slip), 0.0]))
            # The contact gives by 1e-3 of a force that is spread over eight edges.
            left = slip + t.T @ lam[1:9]
            assert abs(left).max() < 1e-3 * abs(slip).max() + 1e-15


def test_a_speed_that_is_rounding_decides_nothing():
    """A row whose own terms are rounding of q beside speeds of 1."""
    F = np.diag([1.0, 0.0, 2.0])
    for noise in (1e-16, 1e-15, 5e-15):
        lam = solve_lcp(F, np.array([-1.0, -noise, 0.5]))
        np.testing.assert_allclose(lam, [1.0, 0.0, 0.0], atol=1e-12)
    with pytest.raises(ValueError, match="no solution"):
        solve_lcp(F, np.array([-1.0, -1e-9, 0.5]))


@pytest.mark.parametrize("n", [4, 16])
def test_ties_do_not_cycle(n):
    # Friction edges without friction: one contact counted n times, every ratio tied.
    F, q = np.ones((n, n)), -np.ones(n)
    lam = solve_lcp(F, q)
    assert lam.sum() == pytest.approx(1.0, abs=1e-12)
    assert_solves(F, q, lam)


@pytest.mark.parametrize("exponent", [-12, -6, 6, 12])
def test_units_do_not_matter(exponent):
    rng = np.random.default_rng(0)
    J, q = rng.normal(size=(6, 6)), rng.normal(size=6)
    F, k = J @ J.T + 0.1 * np.eye(6), 10.0**exponent
    np.testing.assert_allclose(solve_lcp(k * F, q), solve_lcp(F, q) / k, rtol=1e-9)
    np.testing.assert_allclose(solve_lcp(F, k * q), solve_lcp(F, q) * k, rtol=1e-9)


def test_mixed_units_of_the_rows_do_not_matter():
    rng = np.random.default_rng(0)
    J, s = rng.normal(size=(6, 4)), 10.0 ** rng.uniform(-4, 4, 6)
    F = J @ J.T
    q = -F @ np.abs(rng.normal(size=6))
    lam = s * solve_lcp(s[:, None] * F * s, s * q)
    assert_solves(F, q, lam)


def test_a_gap_needs_no_force():
    F = np.diag([1.0, 0.0])
    np.testing.assert_array_equal(solve_lcp(F, np.array([0.0, 2.0])), [0.0, 0.0])
    assert solve_lcp(np.zeros((0, 0)), np.zeros(0)).shape == (0,)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_entries_that_are_not_finite_are_refused(bad):
    F, q = np.eye(2), np.array([-1.0, 1.0])
    with pytest.raises(ValueError, match="not finite"):
        solve_lcp(F, np.array([1.0, bad]))
    with pytest.raises(ValueError, match="not finite"):
        solve_lcp(np.array([[1.0, bad], [0.0, 1.0]]), q)


def test_wrong_shapes_are_refused_with_both_shapes():
    with pytest.raises(ValueError, match=r"F is \(2, 3\) and q is \(2,\)"):
        solve_lcp(np.ones((2, 3)), np.ones(2))
    with pytest.raises(ValueError, match=r"q is \(2, 1\)"):
        solve_lcp(np.eye(2), np.ones((2, 1)))


def test_the_compiled_kernel_gives_the_same_and_does_not_change_its_input():
    rng = np.random.default_rng(0)
    J, q = rng.normal(size=(8, 8)), rng.normal(size=8)
    F = J @ J.T + np.eye(8)
    F_before, q_before = F.copy(), q.copy()
    lam, status = solve_lcp_kernel(F, q)
    assert status == SOLVED
    np.testing.assert_array_equal(lam, solve_lcp(F, q))
    np.testing.assert_array_equal(F, F_before)
    np.testing.assert_array_equal(q, q_before)

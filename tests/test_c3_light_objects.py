"""C3 with bounds where an object is light: multipliers are millions of times as large
as the weights. And the interior point method in any units."""

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs, ContactPair
from makebreak.systems.contact_mpc.numerics.c3_bounds import (
    IPM_STARTS,
    MET,
    solve_active,
    solve_interior,
    within,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import (
    C3Bounds,
    C3Options,
    C3Problem,
    C3Weights,
    solve_c3,
)
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    PlusProjection,
    QpProjection,
)
from makebreak.systems.contact_mpc.numerics.c3_qp import factor, new_factor, solve
from makebreak.systems.contact_mpc.numerics.lcs import simulate

STEP = 0.05  # [s]


def link(name, mass, shapes="", pose="0 0 0"):
    inertia = (
        f"<ixx>{6e-4 * mass}</ixx><iyy>{6e-4 * mass}</iyy><izz>{6e-4 * mass}</izz>"
    )
    return (
        f'<link name="{name}"><pose>{pose} 0 0 0</pose><inertial><mass>{mass}</mass>'
        f"<inertia>{inertia}</inertia></inertial>{shapes}</link>"
    )


def shape(name, geometry, pose="0 0 0"):
    return (
        f'<collision name="{name}"><pose>{pose} 0 0 0</pose><geometry>{geometry}'
        "</geometry></collision>"
    )


def slide(name, parent, child, axis):
    return (
        f'<joint name="{name}" type="prismatic"><parent>{parent}</parent>'
        f"<child>{child}</child><axis><xyz>{axis}</xyz></axis></joint>"
    )


def sphere(radius):
    return f"<sphere><radius>{radius}</radius></sphere>"


def two_fingers_and_a_box(mass):
    """Two balls that slide in x, y and z, at two sides of a box of 6 cm on feet."""
    size = "<box><size>0.06 0.06 0.06</size></box>"
    feet = [(x, y) for x in (-0.03, 0.03) for y in (-0.03, 0.03)]
    text = link(
        "ground", 1.0, shape("ground", "<box><size>2 2 1</size></box>"), "0 0 -0.5"
    )
    text += '<joint name="w" type="fixed"><parent>world</parent>'
    text += "<child>ground</child></joint>"
    for name, x in (("left", -0.05), ("right", 0.05)):
        text += link(name + "_x", 0.1) + slide(
            name + "_1", "world", name + "_x", "1 0 0"
        )
        text += link(name + "_y", 0.1)
        text += slide(name + "_2", name + "_x", name + "_y", "0 1 0")
        text += link(name, 0.1, shape(name, sphere(0.01)), f"{x} 0 0.03")
        text += slide(name + "_3", name + "_y", name, "0 0 1")
    shapes = shape("sides", size) + "".join(
        shape(f"foot{i}", sphere(0.001), f"{x} {y} -0.03")
        for i, (x, y) in enumerate(feet)
    )
    text += link("box", mass, shapes, "0 0 0.031")
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    Parser(plant).AddModelsFromString(
        f'<sdf version="1.9"><model name="m">{text}</model></sdf>', "sdf"
    )
    plant.Finalize()
    pairs = [ContactPair(name, "m::sides", 0.8) for name in ("left", "right")]
    pairs += [ContactPair(f"m::foot{i}", "ground", 0.4) for i in range(4)]
    return AnitescuLcs(builder.Build(), pairs, STEP)


@pytest.mark.parametrize("projection", [PlusProjection(), QpProjection(0.01)])
@pytest.mark.parametrize("mass", [0.01, 0.05])
def test_bounds_around_a_motion_of_a_light_box_are_met(mass, projection):
    """A plan exists: the simulated motion, 1 mm or 1 um from all bounds."""
    builder = two_fingers_and_a_box(mass)
    n_x, n_u, n_lam = builder.n_x, builder.n_u, builder.n_lam
    sizes = [n_x, n_lam, n_u]
    G, U = [0.01, 1.0, 0.01], [1.0, 1.0, 1.0]
    if isinstance(projection, PlusProjection):
        sizes, G, U = [*sizes, n_lam], [*G, 1.0], [*U, 10.0]
    weights = C3Weights(
        np.ones(n_x), np.full(n_u, 1e-3), np.repeat(G, sizes), np.repeat(U, sizes)
    )
    rng = np.random.default_rng(0)
    for _ in range(12):
        N, margin = int(rng.choice([1, 3, 8])), rng.choice([1e-6, 1e-3])
        x = builder.x_default.copy()
        x[builder.n_q :] = 0.1 * rng.normal(size=n_x - builder.n_q)
        lcs = builder.build(x, np.zeros(n_u))
        u = 3.0 * mass * rng.normal(size=(N, n_u))
        motion = [x]
        for each in u:
            motion.append(simulate(lcs, motion[-1], each)[0])
        bounded = rng.random(n_x) < 0.5
        lower = np.where(bounded, np.min(motion[1:], axis=0) - margin, -np.inf)
        upper = np.where(bounded, np.max(motion[1:], axis=0) + margin, np.inf)
        u_lower, u_upper = u.min(axis=0) - margin, u.max(axis=0) + margin
        problem = C3Problem(
            weights, projection, C3Options(N=N, scale_lam=True),
            C3Bounds(u_lower, u_upper, lower, upper),
        )  # fmt: skip
        plan, _ = solve_c3(lcs, x, np.tile(x + 0.1, (N + 1, 1)), problem)
        assert (plan.x[1:] >= lower - 1e-6).all() and (plan.x[1:] <= upper + 1e-6).all()
        assert (plan.u >= u_lower).all() and (plan.u <= u_upper).all()


def test_the_interior_point_method_agrees_with_the_active_set_in_any_units():
    """Entries in units from 1e-3 to 1e3 of their own, weights from 1e-6 to 1e6 times;
    a simulated motion is a millionth to a tenth of its size within the bounds."""
    rng, none = np.random.default_rng(5), np.empty(0)
    solved = 0
    for _ in range(60):
        n_x, n_v, N = rng.integers(2, 8), rng.integers(1, 8), int(rng.choice([1, 3, 8]))
        n = n_x + n_v
        A = np.eye(n_x) + 0.05 * rng.normal(size=(n_x, n_x))
        B = rng.normal(size=(n_x, n_v))
        motion, v = [0.1 * rng.normal(size=n_x)], rng.normal(size=(N, n_v))
        for each in v:
            motion.append(A @ motion[-1] + B @ each)
        y = np.hstack([v, motion[1:]])
        wide = 10.0 ** rng.uniform(-6, -1) * np.abs(y).max(axis=0)
        lower, upper = y.min(axis=0) - wide, y.max(axis=0) + wide
        free = rng.random(n) < 0.4
        lower[free], upper[free] = -np.inf, np.inf
        units, weight = 10.0 ** rng.uniform(-3, 3, n), 10.0 ** rng.uniform(-6, 6)
        T = weight * np.diag(10.0 ** rng.uniform(-2, 1, n) / units**2)
        T_N = np.ascontiguousarray(T[n_v:, n_v:])
        h = weight * rng.normal(size=(N + 1, n)) / units
        AB = units[n_v:, None] * np.hstack([B, A]) / units
        lower, upper, x0 = lower * units, upper * units, motion[0] * units[n_v:]
        fac = new_factor(AB[None], np.zeros((1, n_x)), N)
        assert factor(fac, T[None], T_N, np.zeros((0, 0)), 0)
        x, v = np.empty((N + 1, n_x)), np.empty((N, n_v))
        solve(fac, h, x0, none, x, v)
        if within(x, v, lower, upper):
            continue
        ours, sides = (x.copy(), v.copy()), np.zeros(h.shape, np.int64)
        start = IPM_STARTS[0]
        assert solve_interior(fac, T[None], T_N, h, none, lower, upper, start, *ours)
        assert solve_active(fac, h, x0, none, lower, upper, sides, x, v) == MET
        for a, b, unit in ((ours[0], x, units[n_v:]), (ours[1], v, units[:n_v])):
            np.testing.assert_allclose(a / unit, b / unit, atol=1e-4 * (1 + wide.max()))
        solved += 1
    assert solved > 40

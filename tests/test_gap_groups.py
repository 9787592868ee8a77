"""What joints lack of several kinds, fitted at once and pruned by columns."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_gap_sticking import recorded

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.fit import _Free
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Candidate, Nuisances, SearchPlan
from makebreak.gap.residuals.contact import _of_surfaces
from makebreak.gap.residuals.drive_gains import gain_columns
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.result import Estimate, Evidence, NamedEffect
from makebreak.gap.said import said_together
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.groups import (
    _needless_member,
    groups_of,
    of_more_kinds,
    with_pruned_groups,
)
from makebreak.gap.search.screen import rank
from makebreak.models.effects.kind import Effect


@pytest.mark.parametrize("reach", [np.inf, 1e3])
def test_what_is_left_without_each_is_that_of_a_fit_without_it(reach):
    """Also where one nuisance is known a million times better than another."""
    rng = np.random.default_rng(0)
    X = rng.normal(size=(400, 6)) * [1.0, 10.0, 0.1, 1.0, 1.0, 1e-3]
    N = rng.normal(size=(400, 4)) * [1.0, 1.0, 5.0, 0.1]
    N[:, 0] += X[:, 0]
    r = X @ [1.0, 0.1, 3.0, 0.0, 0.2, 100.0] + 0.1 * rng.normal(size=400)
    train, of = np.arange(400) % 3 != 0, np.array([0, 1, 2, 2, 3, 4])
    screen = Screen(r, N, np.array([0.1, 0.3, 1e-6, 1.0]), train, 1.5, reach)
    for k, left in enumerate(screen.without_each(X, of)):
        some = X[:, of != k]
        fit = screen.fit(some)
        np.testing.assert_allclose(left, r - some @ fit.c - N @ fit.b, atol=1e-9)


def test_columns_of_a_gain_hold_however_far_it_is_off(tmp_path):
    """Equations in units of what a drive is told are linear in its reciprocal."""
    scene, file = recorded(tmp_path, "four", [])
    scene = replace(scene, actuation=replace(scene.actuation, limit=[]))
    problem = MechanismProblem(scene, read_recordings([file]))
    start = Comparison(problem, print).start
    (found,) = (
        c for c in problem.candidates(problem.nuisances(), start)
        if (c.kind, c.at) == ("servo_gain", ("p.wave",))
    )  # fmt: skip
    now = problem.dynamics.now("servo_gain", ["p.wave"])["kp"]
    for times in (0.3, 3.0):
        effect = Effect("servo_gain", ["p.wave"], {"kp": times * now})
        off = problem.base() - problem.residual([effect])
        x = found.columns[0][:, 0]
        c = float(x @ off / (x @ x))
        np.testing.assert_allclose(c * x, off, atol=1e-6 * np.abs(off).max())
        assert found.effects(0, np.array([c]))[0].parameters["kp"] == pytest.approx(
            times * now
        )
    # Friction that the scene has stops joints otherwise than at first: so it does in
    # what gains within their tolerance give.
    assert problem.stops_sec > 0.0
    n = problem.nuisances()
    columns, _, names = gain_columns(problem)
    for name, column in zip(names, columns, strict=True):
        np.testing.assert_allclose(n.columns[:, n.names.index(name)], column, atol=1e-9)


def test_pairs_of_one_surface_may_have_one_friction():
    """The box is on the floor and at the rod, alike; a second box's friction differs,
    and what the floor has with both is not alike. It slides only where both have less
    than half of it."""
    now = {"w.box~w.floor": 0.4, "w.box~w.rod": 0.4, "w.can~w.floor": 0.7}

    def now_of(kind, at):
        if at[0] not in now:
            raise ValueError("nothing there has a friction")
        return {"friction": now[at[0]]}

    def residual(effects):
        (effect,) = effects
        held = len(effect.at) < 2 or effect.parameters["friction"] > 0.2
        return np.ones(6) if held else np.zeros(6)

    model = SimpleNamespace(
        places_of=lambda kind: (
            [*now, "w.box~w.ghost"] if kind == "contact_friction" else []
        ),
        dynamics=SimpleNamespace(now=now_of),
        residual=residual,
    )
    (shared,) = _of_surfaces(model, [], np.ones(6))
    assert (shared.at, shared.size) == (("w.box~w.floor", "w.box~w.rod"), 1)
    for x, read in zip(shared.columns, shared.to_parameters, strict=True):
        c = np.linalg.lstsq(x, np.ones(6), rcond=None)[0]
        assert read(c)["friction"] < 0.2
    there = [Effect("contact_friction", ["w.box~w.rod"], {"friction": 0.3})]
    assert not _of_surfaces(model, there, np.ones(6))


KINDS = ("joint_coulomb_friction", "joint_viscous_damping", "rotor_inertia")
NAMES = ("coulomb", "damping", "inertia")


def search_of(left, train, channel):
    problem = SimpleNamespace(
        sizes=None, is_within_tolerance=lambda effect: False, by_equations=True,
        dynamics=SimpleNamespace(now=lambda kind, at: {"kp": 10.0}), correlation=1.0,
        weighed_by=lambda effects: None,
    )  # fmt: skip
    search = object.__new__(Comparison)
    search.train, search.channel, search.problem = train, channel, problem
    search.plan, search.start = SearchPlan(), SimpleNamespace(score=0.0)
    search.nuisances = Nuisances.none(len(left))
    return search


def test_what_joints_lack_of_several_kinds_is_found_at_once():
    """Friction, rotor and gain of two joints, and a load that both feel. A smaller gain
    makes all else as much smaller in what the drive is told."""
    rng = np.random.default_rng(1)
    n, gains = 3000, (0.4, 1.0)
    channel, train = np.repeat([0, 1], n), np.arange(2 * n) // 30 % 3 != 1
    v = rng.normal(size=(2, n))
    a = 0.5 * v + rng.normal(size=(2, n))
    need = np.sign(v) + 2.0 * v + 3.0 * a + rng.normal(size=(2, n))
    load = rng.normal(size=2 * n) + np.concatenate(a)
    hidden = {KINDS[0]: 0.7, KINDS[2]: 0.05}
    left = 0.01 * rng.normal(size=2 * n) + 0.3 * load
    found = [Candidate("payload", ("r.hand",), 1, (load[:, None],),
                       (lambda c: {"mass": 1.0 + c[0], "com_x": 0.0, "com_y": 0.0,
                                   "com_z": 0.0},))]  # fmt: skip
    for i, joint in enumerate(("r.j1", "r.j2")):
        mine = channel == i
        each = dict(zip(KINDS, (np.sign(v[i]), v[i], a[i]), strict=True))
        for (kind, x), name in zip(each.items(), NAMES, strict=True):
            column = np.zeros(2 * n)
            column[mine] = x
            left += hidden.get(kind, 0.0) / gains[i] * column
            read = (lambda c, name=name: {name: float(c[0])},)
            found.append(Candidate(kind, (joint,), 1, (column[:, None],), read))
        column = np.zeros(2 * n)
        column[mine] = -need[i] / 10.0
        left += 10.0 * (1.0 - 1.0 / gains[i]) * column
        read = (lambda c: {"kp": 10.0 / (1.0 - c[0] / 10.0)},)
        found.append(Candidate("servo_gain", (joint,), 1, (column[:, None],), read))
    left = left / 0.01  # In units of noise.
    found = [replace(c, columns=(c.columns[0] / 0.01,)) for c in found]
    search = search_of(left, train, channel)
    screen = Screen(left, np.zeros((2 * n, 0)), np.zeros(0), train)
    wider = of_more_kinds(search, screen, found, KINDS[0])
    truth = {(kind, f"r.j{i + 1}"): x for kind, x in hidden.items() for i in range(2)}
    truth[("servo_gain", "r.j1")] = 10.0 * gains[0]
    truth[("payload", "r.hand")] = 1.3
    ours = {(e.kind, e.at[0]): next(iter(e.parameters.values())) for e in wider.effects}
    assert ours.keys() == truth.keys()
    for key, value in truth.items():
        assert ours[key] == pytest.approx(value, rel=0.02), key


@pytest.mark.parametrize(
    "sizes, places", [((0.7, 0.7), 1), ((0.7, 0.4), 2), ((0.7, 0.0), 0)]
)
def test_what_like_joints_have_alike_is_one_number(sizes, places):
    """Of three joints the third hardly tells its friction: 0.5 +- 1. One value for all
    is no less likely there; where the two others differ, it is none of the group."""
    rng = np.random.default_rng(3)
    n = 900
    channel, train = np.repeat([0, 1, 2], n), np.arange(3 * n) // 30 % 3 != 1
    left, found = rng.normal(size=3 * n), []
    for k, (size, shows) in enumerate(
        zip((*sizes, 0.5), (3.0, 3.0, 0.04), strict=True)
    ):
        column = np.where(channel == k, shows * rng.normal(size=3 * n), 0.0)
        left += size * column
        read = (lambda c: {"coulomb": float(c[0])},)
        found.append(Candidate(KINDS[0], (f"r.j{k}",), 1, (column[:, None],), read))
    screen = Screen(left, np.zeros((3 * n, 0)), np.zeros(0), train)
    pruned = with_pruned_groups(
        search_of(left, train, channel), screen, rank(screen, groups_of(found))
    )
    effects = [e for each in pruned for e in each.effects]
    assert len(effects) == places
    if places == 1:
        assert effects[0].at == ["r.j0", "r.j1", "r.j2"]
        assert effects[0].parameters["coulomb"] == pytest.approx(0.7, rel=0.03)
    for e, size in zip(effects[:2] if places == 2 else (), sizes, strict=False):
        assert e.parameters["coulomb"] == pytest.approx(size, rel=0.05)


@pytest.mark.parametrize(
    ("kind", "sizes", "effects"),
    [(KINDS[0], (0.7, 0.4, 0.55), [3]), ("contact_friction", (0.5, 0.5, 0.5), [1])],
)
def test_a_group_of_which_all_earn_their_place_is_one_candidate(kind, sizes, effects):
    """Of three joints, a value each; of three pairs of one surface, one for all."""
    rng = np.random.default_rng(5)
    n = 900
    channel, train = np.repeat([0, 1, 2], n), np.arange(3 * n) // 30 % 3 != 1
    left, found = rng.normal(size=3 * n), []
    for k, size in enumerate(sizes):
        column = np.where(channel == k, 30.0 * rng.normal(size=3 * n), 0.0)
        left += size * column
        at = f"r.b~r.w{k}" if kind == "contact_friction" else f"r.j{k}"
        name = "friction" if kind == "contact_friction" else "coulomb"
        read = (lambda c, name=name: {name: float(c[0])},)
        found.append(Candidate(kind, (at,), 1, (column[:, None],), read))
    screen = Screen(left, np.zeros((3 * n, 0)), np.zeros(0), train)
    pruned = with_pruned_groups(
        search_of(left, train, channel), screen, rank(screen, groups_of(found))
    )
    whole = [p for p in pruned if sum(len(e.at) for e in p.effects) == 3]
    assert [len(p.effects) for p in whole] == effects


def effect_at(joint, value, ties=()):
    unit = "N m s/rad"
    return NamedEffect(
        "joint_viscous_damping", (f"r.{joint}",),
        {"damping": Estimate(value, 0.01, unit)}, f"{joint}: {value}.",
        Evidence(1.0, 0.5, "", 0.0), ties, "",
    )  # fmt: skip


def test_what_many_joints_have_is_one_sentence():
    """Those that have less, and those with a tie, are said by themselves."""
    more = [effect_at(f"j{k}", 0.1 * k) for k in range(1, 6)]
    less = [effect_at("k", -0.3)]
    tie = Effect("joint_quadratic_drag", ["r.t"], {"coefficient": 1.0})
    tied = [effect_at("t", 0.2, (tie,))]
    found = said_together([*more[:2], *less, *more[2:], *tied])
    assert found == [
        ("Each of 5 joints has 0.1 to 0.5 N m s/rad of viscous damping that the model "
         "lacks.", more),
        ("k: -0.3.", less),
        ("t: 0.2.", tied),
    ]  # fmt: skip
    assert [said for said, _ in said_together(more[:3])] == [e.says for e in more[:3]]


@pytest.mark.parametrize("least", [{}, {"coulomb": 0.0}])
def test_a_member_with_an_impossible_value_goes_however_much_it_explains(least):
    """Less friction than the model has where that has none."""
    rng = np.random.default_rng(2)
    channel, train = np.repeat([0, 1], 900), np.arange(1800) // 30 % 3 != 1
    columns = [np.where(channel == k, rng.normal(size=1800), 0.0) for k in range(2)]
    left = 0.1 * rng.normal(size=1800) - 0.7 * columns[0] + 0.5 * columns[1]
    members = [
        Candidate(KINDS[0], (f"r.j{k}",), 1, (x[:, None],),
                  (lambda c: {"coulomb": float(c[0])},), least=least)
        for k, x in enumerate(columns)
    ]  # fmt: skip
    screen = Screen(left, np.zeros((1800, 0)), np.zeros(0), train)
    gone = _needless_member(search_of(left, train, channel), screen, members)
    assert gone == (0 if least else None)


def test_several_of_a_kind_at_one_joint_take_no_more_than_the_model_has():
    """Joint a has 1 N m of friction, b has 2: what both lose alike and what b loses
    beside that add up to no more than 2 there."""
    has = {"a": 1.0, "b": 2.0}
    problem = SimpleNamespace(
        least=lambda kind, at: {"coulomb": -min(has[name] for name in at)}
    )
    start = [
        Effect("joint_coulomb_friction", ["a", "b"], {"coulomb": -0.5}),
        Effect("joint_coulomb_friction", ["b"], {"coulomb": -0.5}),
        Effect("joint_viscous_damping", ["b"], {"damping": 0.5}),
    ]
    low = _Free(problem, start, [(), (), ()]).low
    assert low[:2] == pytest.approx([-1.0, -1.0])
    assert low[2] == -np.inf

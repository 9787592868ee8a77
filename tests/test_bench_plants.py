"""The plants of `makebreak bench learner_plants`, and what its table says."""

import re

import numpy as np
import pytest
from pydrake.multibody.tree import BodyIndex

from makebreak.benchmarks import bench
from makebreak.benchmarks.learner_plants import (
    ROWS,
    Row,
    Run,
    Sensor,
    changed,
    distances,
    in_the_loop,
    run,
    runs,
    summary,
)
from makebreak.benchmarks.plants import (
    DISC,
    FREE_BOX,
    OF_MASS,
    PUCK,
    SQUEEZED,
    diagram_of,
)
from makebreak.systems.contact_mpc.residual_learner import AdamConfig

RAIL = np.array([0.02, 0.21, 0.0, 0.0])  # Finger and puck, with radii of 5 cm each.


def test_a_positive_error_is_a_larger_gap_of_the_world():
    for error in (-4e-3, 0.0, 7e-3):
        [[gap]] = distances(PUCK.world((error,)), PUCK, [RAIL])
        # Places are displacements from 0 and 0.2 m.
        assert gap == pytest.approx(0.2 + 0.21 - 0.02 - 0.1 + error, abs=1e-12)
    x = np.zeros(6)
    gaps = distances(SQUEEZED.world((2e-3, -3e-3)), SQUEEZED, [x])
    np.testing.assert_allclose(gaps, [[0.15 - 0.07 + 2e-3, 0.15 - 0.07 - 3e-3]])
    wrong, right = (
        distances(DISC.world((e, e)), DISC, [DISC.start])[0] for e in (5e-3, 0.0)
    )
    np.testing.assert_allclose(wrong - right, 5e-3, atol=1e-12)
    wrong, right = (
        distances(FREE_BOX.world((e, e)), FREE_BOX, [FREE_BOX.start])[0]
        for e in (5e-3, 0.0)
    )
    np.testing.assert_allclose(wrong - right, 5e-3, atol=1e-9)


@pytest.mark.parametrize("name", OF_MASS)
def test_an_object_has_the_mass_that_is_asked_for_spread_over_its_size(name):
    _, plant = diagram_of(OF_MASS[name](0.37)[0])
    bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    inertias = [b.default_spatial_inertia() for b in bodies]
    (M,) = [M for M in inertias if M.get_mass() == pytest.approx(0.37)]
    about = M.Shift(M.get_com()).get_unit_inertia().get_moments()
    radii = np.sqrt(about)  # Of gyration: a door is as wide as 0.8 m, the rest 26 cm.
    assert (radii > 0.01).all() and (radii < (0.8 if name == "door" else 0.13)).all()


def test_a_row_that_is_named_by_one_period_has_it():
    named = [(re.search(r"([\d.]+) ms$", row.what), row.periods) for row in ROWS]
    found = [(float(m[1]), [1e3 * dt for dt in dts]) for m, dts in named
             if m and len(dts) == 1]  # fmt: skip
    assert len(found) >= 6
    for ms, periods in found:
        assert periods == [pytest.approx(ms)]


def test_a_learner_that_finds_the_gap_has_a_small_error():
    [found] = runs(Row("", [PUCK], (5,)))
    np.testing.assert_allclose(found.truth, 5e-3, atol=1e-9)
    assert found.error.max() < 2e-3 and found.within > 0.95 and found.better > 2.0
    # The same recording with a learner that may not learn: wrong by the whole error.
    held = AdamConfig(learning_rate=1e-9)
    held = run(
        Row("", [PUCK], (5,), learner=dict(posterior=None, adam=held)),
        PUCK, [PUCK.world((5e-3,))], 0.05, Sensor(),
    )  # fmt: skip
    assert held.error.min() > 4.9e-3 and held.better < 1.1


def test_a_row_has_the_worst_of_its_runs():
    n = 8
    zero = np.zeros((n, 1))
    miss = np.full(n - 1, 0.2)
    wrong = Run(zero + 3e-3, zero + 1e-3, zero + 4e-3, miss, miss / 4.0)
    right = Run(zero, zero + 1e-3, zero, miss, 2.0 * miss)
    far = Run(zero, zero + 1e-3, zero - 5e-3, miss, miss / 100.0)
    row = summary("a", [wrong, right, far])
    assert row["value"] == pytest.approx(5.0)
    assert row["largest_mm"] == pytest.approx(5.0)
    assert (row["in_90"], row["better"], row["right_model"]) == (
        "0-100 %",
        "4-100",
        "0.5",
    )


def test_a_sensor_rounds_loses_and_disturbs_samples():
    x = np.tile(RAIL, (100, 1))
    x[:, 0] += 1e-4 * np.arange(100)
    read = Sensor(rounded=1e-3, lost=50, outlier=2.0, of=1).read(x, PUCK, 2)
    assert np.isnan(read).all(axis=1).sum() == 2
    there = read[np.isfinite(read[:, 0])]
    np.testing.assert_allclose(
        there[:, 0] * 1e3, np.round(there[:, 0] * 1e3), atol=1e-9
    )
    assert (read[5::10, 3] == 2.0).sum() == np.isfinite(read[5::10, 3]).sum() > 0
    noisy = Sensor(length_std=1e-3, velocity_std=1e-2).read(x, PUCK, 2) - x
    np.testing.assert_allclose(noisy.std(axis=0), [1e-3, 1e-3, 1e-2, 1e-2], rtol=0.3)
    still = Sensor(length_std=1.0).read(np.zeros((5, 19)), FREE_BOX, 10)
    assert not still[:, 3:7].any() and still[:, :3].all()


def test_a_face_that_moves_is_followed_and_c3_reaches_the_goal():
    half, whole = (row["value"] for row in changed())
    assert whole < half < 2.0
    assert abs(in_the_loop(8e-3, True)["value"] - 0.5) < 2e-3
    assert abs(in_the_loop(8e-3, False)["value"] - 0.5) > 0.02


def test_accuracy_benches_run_only_where_they_are_named(monkeypatch):
    ran = []

    class Module:
        def __init__(self, name):
            self.name = name

        def rows(self):
            ran.append(self.name)
            return []

    monkeypatch.setattr(bench, "import_module", Module)
    bench.bench()
    assert len(ran) == len(bench.BENCHES) - len(bench.NAMED_ONLY)
    assert not any(module.endswith(("light", "plants")) for module in ran)
    bench.bench(["learner_plants"])
    assert ran[-1].endswith(".learner_plants")
    assert len({row.what for row in ROWS}) == len(ROWS)

"""Where to look for what no effect explains, and what SAP makes of friction."""

from dataclasses import replace

import numpy as np
import pytest
from gap_benchmark import push_world
from gap_benchmark.push_world import BLOCK, TABLE
from push_problems import screen_of

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.permitted_forces import tangents
from makebreak.gap.problem import Fitted
from makebreak.gap.residuals.contact_candidates import FRICTION_SPREAD
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.sap_lift import sap_lift
from makebreak.gap.residuals.widened_contacts import (
    distances_off,
    sentence,
    widened_contacts,
    widened_slots,
)
from makebreak.gap.result import GapMeasure
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.thresholds import AGREEMENT_RMS_MAX
from makebreak.gap.verdict import two_figures
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.kind import sentence as effect_sentence
from makebreak.models.scene import read_scene


@pytest.fixture(scope="module")
def problem(tmp_path_factory) -> ContactProblem:
    """Pushes of an ODE with Coulomb's law, nothing hidden."""
    folder, rng = tmp_path_factory.mktemp("push"), np.random.default_rng(21)
    world = push_world.a_world(rng)
    table, noise = push_world.record(
        push_world.with_hidden(world, [], rng), rng, episodes=4
    )
    scene = push_world.write(folder, world, table, noise)
    return ContactProblem(
        read_scene(scene), read_recordings([folder / "recording.csv"])
    )


def started(problem: ContactProblem) -> Fitted:
    problem._base = problem._last = None
    return Comparison(problem, lambda text: None).start


def tip_pair(problem: ContactProblem) -> str:
    (name,) = [
        n for p in problem._pairs_met if TABLE not in (n := problem.pair_name(p))
    ]
    return name


def test_where_nothing_is_left_nothing_is_said(problem):
    now, found = widened_contacts(problem, started(problem), AGREEMENT_RMS_MAX)
    assert (
        now < AGREEMENT_RMS_MAX and found == [] and problem.hint(started(problem)) == ""
    )


def test_a_force_off_its_normal_is_said_of_its_pair_by_how_much(problem, monkeypatch):
    """The tip's force tilts by 7 degrees more than friction lets it."""
    wrench = problem.means.wrench.copy()
    across = np.linalg.norm(wrench[:, :2], axis=1)
    (slot,) = [s for s in problem.slots if problem.pair_name(problem._pair_of(s))
               == tip_pair(problem)][:1]  # fmt: skip
    wrench[:, 2] = across * np.tan(np.arctan(slot.friction) + np.radians(7.0))
    monkeypatch.setattr(problem.means, "wrench", wrench)
    now, found = widened_contacts(problem, started(problem), AGREEMENT_RMS_MAX)
    assert found[0].pair == tip_pair(problem) and found[0].unit == "degrees"
    # Of 2, 5, 10 and 20 degrees one that holds 7; some is left, as what the table
    # carries, and its friction, was not changed with it.
    assert found[0].size in (10.0, 20.0) and found[0].left < 0.25 * now


def test_a_force_beside_where_shapes_meet_is_said_of_its_pair(problem, monkeypatch):
    """The block's moment is that of a contact 6 mm aside."""
    push = np.linalg.norm(problem.means.wrench[:, :2], axis=1)
    needs = problem._needs.copy()
    needs[:, problem.bodies[BLOCK][1] + 2] += 6e-3 * push
    monkeypatch.setattr(problem, "_needs", needs)
    _, found = widened_contacts(problem, started(problem), AGREEMENT_RMS_MAX)
    best = [w for w in found if w.pair == tip_pair(problem) and w.unit == "mm"]
    assert best and best[0].size == 8.0 and best[0].left < AGREEMENT_RMS_MAX
    assert tip_pair(problem) in sentence(2.0, best)


def test_a_block_seen_beside_the_tip_is_said_in_millimetres(problem, monkeypatch):
    start = started(problem)
    assert distances_off(problem, start, problem.plan.loud) == []
    names, rows = problem.row_names(), problem.channel_of_rows()
    pair = next(p for p in problem._pairs_met
                if problem.pair_name(p) == tip_pair(problem))  # fmt: skip
    mine = rows == names.index(f"{tip_pair(problem)}.distance")
    left = start.left.copy()
    # Rows are what is wanted (none) less the distance, over what it is known to.
    left[mine] -= 1.5e-3 / problem.distance_std(pair)
    (said,) = distances_off(problem, replace(start, left=left), problem.plan.loud)
    assert tip_pair(problem) in said and "1.5 mm apart" in said


def test_slots_are_turned_and_moved_by_what_is_said(problem):
    slot = problem.slots[0]
    turned = widened_slots([slot], 10.0, "degrees")
    for s in turned:
        cosine = np.sum(s.normal * slot.normal, axis=1)
        np.testing.assert_allclose(cosine, np.cos(np.radians(10.0)), atol=1e-12)
    # The four lie about the old one.
    mean = np.mean([s.normal for s in turned], axis=0)
    np.testing.assert_allclose(np.cross(mean, slot.normal), 0.0, atol=1e-12)
    for s in widened_slots([slot], 3.0, "mm"):
        off = s.place - slot.place
        np.testing.assert_allclose(np.linalg.norm(off, axis=1), 3e-3, atol=1e-12)
        np.testing.assert_allclose(np.sum(off * slot.normal, axis=1), 0.0, atol=1e-12)
    for e in tangents(slot.normal):
        np.testing.assert_allclose(np.sum(e * slot.normal, axis=1), 0.0, atol=1e-12)


def test_a_gap_of_equations_alone_is_said_with_its_size():
    gap = GapMeasure(0.8, 0.8, 1.0, 0.5, {})
    assert "error is 2.5 times the expected error" in two_figures(2.5, 2.5, gap)


def test_a_scene_that_sap_lifts_gets_a_warning(problem, monkeypatch):
    assert sap_lift(problem) == []
    scene = problem.scene
    plant = replace(scene.plant, discrete_contact_approximation="sap")
    monkeypatch.setattr(problem, "scene", replace(scene, plant=plant))
    (found,) = sap_lift(problem)
    assert found.severity == "warning" and "relaxation_time" in found.says
    # mu (tau + dt) v: the block slides at up to some 0.1 m/s, tau is 0.1 + 0.1 s.
    v = np.linalg.norm(problem._node_v[:, problem.bodies[BLOCK][1] + 3 :], axis=1)
    mu = max(s.friction for s in problem.slots
             if TABLE in problem.pair_name(problem._pair_of(s)))  # fmt: skip
    expected = mu * (0.2 + plant.time_step) * np.percentile(v, 95.0)
    assert found.size == pytest.approx(expected, rel=0.3)


def test_friction_of_what_sticks_is_a_bound_and_its_deviation_says_so(problem):
    """The tip sticks, and 0.9 permits no more than 0.8 does; the block slides over the
    table, and there the cost grows with the square: a deviation is what adds one."""
    start, tip, table = started(problem), tip_pair(problem), f"{BLOCK}~{TABLE}"
    mu = problem.dynamics.now("contact_friction", [table])["friction"]
    of_tip = problem.dynamics.now("contact_friction", [tip])["friction"]

    def widened(at, value):
        end = replace(
            start, effects=[Effect("contact_friction", [at], {"friction": value})],
            std=[{"friction": 1e-6}],
        )  # fmt: skip
        std, or_more = problem.widened(end, 0)
        return std["friction"], or_more

    # What held with the scene's friction is not known at all.
    assert widened(tip, 0.9) == (np.inf, ())
    assert widened(tip, 0.95 * of_tip) == (np.inf, ())
    std, or_more = widened(table, mu)
    assert or_more == () and 1e-6 < std < 0.03 * mu


@pytest.mark.parametrize(("moments", "known"), [(40, True), (1, False)])
def test_what_holds_from_a_friction_on_is_known_from_below(
    problem, monkeypatch, moments, known
):
    """Less than twice the scene's leaves something, in many moments or in one alone."""
    start, tip = started(problem), tip_pair(problem)
    now = problem.dynamics.now("contact_friction", [tip])["friction"]
    calm = problem.nuisances().columns @ start.b
    rows = problem._of_rows(np.arange(len(problem.means.time))) < moments

    def residual(effects):
        short = max(2.0 * now - effects[0].parameters["friction"], 0.0)
        return calm + 1e3 * short * rows / np.sqrt(rows.sum())

    monkeypatch.setattr(problem, "residual", residual)
    effect = Effect("contact_friction", [tip], {"friction": 2.5 * now})
    end = replace(start, effects=[effect], std=[{"friction": 1e-6}])
    std, or_more = problem.widened(end, 0)
    assert or_more == (("friction",) if known else ())
    if known:
        # In steps of 2, 5, 10, 20, 50 %: 1.25 of 2.5 times is the first that is short.
        assert 2.5 * now - 2.0 * std["friction"] == pytest.approx(1.25 * now)
    else:
        assert std["friction"] == np.inf


def test_a_friction_that_holds_is_fitted_no_farther_off_than_it_must_be(problem):
    """All that holds explains alike: what is nearest to the scene's is taken, and the
    sentence says that it may be more."""
    tip = tip_pair(problem)
    now = problem.dynamics.now("contact_friction", [tip])["friction"]
    three = Effect("contact_friction", [tip], {"friction": 3.0 * now})
    [row] = problem.prior_rows([three])
    assert row == pytest.approx(np.log(3.0) / FRICTION_SPREAD)
    screen = screen_of(problem)
    effect = Effect("contact_friction", [tip], {"friction": 1.4})
    end = fit_effects(problem, screen, [effect])
    assert end.effects[0].parameters["friction"] == pytest.approx(now, rel=0.1)
    kind = KINDS["contact_friction"]
    said = effect_sentence(effect, kind, {"friction": 0.2}, or_more=("friction",))
    assert said.endswith("is 1.4 (at least 1)")

"""What is said of contacts beside what is named: distances, bounds of friction, SAP."""

from dataclasses import replace

import numpy as np
import pytest
from gap_benchmark import push_world
from gap_benchmark.push_world import BLOCK, TABLE
from push_problems import screen_of

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import Fitted
from makebreak.gap.residuals.contact_candidates import FRICTION_SPREAD
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.sap_lift import sap_lift
from makebreak.gap.result import GapMeasure
from makebreak.gap.search.comparison import Comparison
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


def test_a_block_seen_beside_the_tip_is_said_in_millimetres(problem, monkeypatch):
    start = started(problem)
    assert problem.hint(start) == ""
    names, rows = problem.row_names(), problem.channel_of_rows()
    pair = next(p for p in problem._pairs_met
                if problem.pair_name(p) == tip_pair(problem))  # fmt: skip
    mine = rows == names.index(f"{tip_pair(problem)}.distance")
    left = start.left.copy()
    # Rows are what is wanted (none) less the distance, over what it is known to.
    left[mine] -= 1.5e-3 / problem.distance_std(pair)
    said = problem.hint(replace(start, left=left))
    assert tip_pair(problem) in said and "1.5 mm apart" in said


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

"""What a fit leaves of the equations of motion in recordings that it has not seen."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from gap_benchmark import push_world
from gap_benchmark.push_world import BLOCK, TABLE
from push_problems import screen_of

from makebreak.gap import confirm
from makebreak.gap.data.pieces import part_of
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.recording import Episode
from makebreak.gap.fit import fit_effects
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.result import GapMeasure
from makebreak.gap.verdict import two_figures
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

PAIR = f"{BLOCK}~{TABLE}"


@pytest.fixture(scope="module")
def pushes(tmp_path_factory):
    """A problem of pushes on a table of other friction, fits without and with it, the
    true friction, and recordings of other pushes there."""
    rng = np.random.default_rng(91)
    world = push_world.a_world(rng)
    truth = push_world.with_hidden(world, ["contact_friction"], rng, 1.0)
    parts = []
    for name, episodes in (("seen", 3), ("unseen", 2)):
        folder = tmp_path_factory.mktemp(name)
        table, noise = push_world.record(truth, rng, episodes=episodes)
        scene = push_world.write(folder, world, table, noise)
        parts.append(read_recordings([folder / "recording.csv"]))
    problem = ContactProblem(read_scene(scene), parts[0])
    screen = screen_of(problem)
    friction = Effect("contact_friction", [PAIR], {"friction": world.friction})
    start = fit_effects(problem, screen, [])
    end = fit_effects(problem, screen, [friction])
    return problem, start, end, truth.friction, parts[1]


def test_the_true_friction_leaves_noise_where_nothing_was_fitted(pushes):
    problem, start, end, true, unseen = pushes
    (before, after), units = problem.unseen(unseen, start, end)
    assert end.effects[0].parameters["friction"] == pytest.approx(true, rel=0.02)
    assert before > 3.0 and after < 1.2
    # A model whose friction is as wrong the other way is as bad there.
    value = 2.0 * true - problem.dynamics.now("contact_friction", [PAIR])["friction"]
    wrong = Effect("contact_friction", [PAIR], {"friction": value})
    (_, bad), _ = problem.unseen(unseen, start, replace(end, effects=(wrong,)))
    assert bad > 3.0
    # Newtons of the block's weight that friction holds, and moments.
    along = units[f"{BLOCK}.x equation"]
    assert along.unit == "N" and along.before > 3.0 * along.after > 0.0
    assert along.after < 3.0 * along.noise
    assert units[f"{BLOCK}.rz equation"].unit == "N m"
    tip = [units[f"{joint} equation"].unit for joint in problem.joints]
    assert tip == ["N"] * len(tip)  # It slides.


@pytest.mark.slow
def test_nothing_is_learned_of_unseen_recordings(pushes, monkeypatch):
    """Not what models are off by, nor the place of the camera."""
    problem, start, end, _, unseen = pushes
    (_, after), _ = problem.unseen(unseen, start, end)
    louder = ContactProblem(problem.scene, problem.recordings)
    louder._set(3.0 * problem.allowance)
    (_, calm), _ = louder.unseen(unseen, start, end)
    assert calm < 0.8 * after
    moved = np.array(end.b)
    moved[problem.nuisances().names.index(f"place of {BLOCK}, z")] += 3.0
    (_, off), _ = problem.unseen(unseen, start, replace(end, b=moved))
    assert off != pytest.approx(after, rel=1e-3)


def test_what_sensors_feel_is_taken_off_unseen_recordings_too(pushes):
    problem, _, _, _, unseen = pushes
    places = tuple(s.place for s in problem.sensors)
    assert places
    known = {"allowance": problem.allowance, "slides": problem.slides}
    asked = SimpleNamespace(_feel_motion=places, **known)
    plain = SimpleNamespace(_feel_motion=(), **known)
    felt, other = (ContactProblem(problem.scene, unseen, x) for x in (asked, plain))
    sensor = other.sensors[0]
    own = other._motion_felt_by(sensor)
    assert np.abs(own).max() > 0.0
    np.testing.assert_allclose(
        felt.means.wrench[:, sensor.rows], other.means.wrench[:, sensor.rows] - own
    )


def test_poses_that_come_late_are_moved_in_unseen_recordings_too(pushes, monkeypatch):
    problem, start, end, _, unseen = pushes
    monkeypatch.setattr(problem, "late", {BLOCK: 0.03})
    (_, after), _ = problem.unseen(unseen, start, end)
    monkeypatch.setattr(problem, "late", {})
    assert after > 1.5 * problem.unseen(unseen, start, end)[0][1]


def test_recordings_that_are_too_short_tell_nothing(pushes):
    problem, start, end, _, unseen = pushes
    (recording,) = unseen
    short = [part_of(recording, [Episode(0, 0, 40)])]
    assert problem.unseen(short, start, end) is None


@pytest.mark.parametrize(
    ("windows", "equations", "good"),
    [
        ((0.9, 0.8), None, True),
        ((0.8, 0.8), None, True),  # A sensor's bias.
        ((0.8, 0.8 + 1e-8), None, True),  # All is at rest.
        ((0.8, 0.81), None, False),
        ((0.8, 0.81), (1.2, 1.2), False),
        ((0.8, 0.81), (9.0, 1.1), True),
        ((0.9, 0.8), (9.0, 1.1), True),
        ((0.9, 0.8), (9.0, 6.0), False),
        ((0.9, 0.8), (1.2, 1.3), True),  # They show nothing there.
        ((0.9, 0.8), (1.2, 4.0), False),
        ((8.0, 2.0), (9.0, 6.0), True),  # Windows show it, and decide.
        ((8.0, 6.0), (9.0, 1.0), False),
    ],
)
def test_equations_confirm_what_windows_do_not_show(windows, equations, good):
    gap = GapMeasure(*windows, 1.0, 0.6, in_equations=equations)
    assert confirm.is_confirmed(gap, bool) == good


def test_what_is_not_confirmed_is_said_with_the_figures_that_say_so():
    gap = GapMeasure(0.9, 0.8, 1.0, 0.6, in_equations=(9.0, 6.0))
    assert "error in the equations of motion from 9 to 6" in confirm.not_confirmed(gap)
    gap = GapMeasure(8.0, 7.0, 1.0, 0.6, in_equations=(9.0, 6.0))
    assert "simulated error from 8 to 7" in confirm.not_confirmed(gap)


def test_the_sentence_has_the_figures_of_what_was_held_out():
    gap = GapMeasure(0.9, 0.8, 1.0, 0.6, in_equations=(9.0, 1.1))
    said = two_figures(12.0, 0.7, gap)
    assert said.endswith("held out for the report the error falls from 9 to 1.1 times "
                         "the expected error.")  # fmt: skip
    # Nothing went there where the effect acts.
    said = two_figures(12.0, 0.7, replace(gap, in_equations=(1.0, 1.0)))
    assert "held out" not in said and "from 12 to 0.7" in said


def test_the_share_closed_in_equations_counts_from_the_floor():
    gap = GapMeasure(0.9, 0.8, 1.0, 0.6, in_equations=(9.0, 5.0))
    assert gap.reduction_in_equations == pytest.approx(0.5)
    assert gap.reduction == 0.0
    assert np.isnan(replace(gap, in_equations=None).reduction_in_equations)


def test_effects_that_these_recordings_refuse_tell_nothing(pushes):
    problem, start, end, _, unseen = pushes
    refused = Effect("friction_patch", [PAIR], dict(
        friction=0.4, x_min=0.1, x_max=0.0, y_min=0.0, y_max=0.1
    ))  # fmt: skip
    assert problem.unseen(unseen, start, replace(end, effects=(refused,))) is None

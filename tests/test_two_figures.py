"""The sentence that says when equations of motion and simulation disagree."""

import pytest

from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.driven import DrivenProblem
from makebreak.gap.residuals.impacts import ImpactProblem
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.residuals.objects import (
    FlightProblem,
    RolloutProblem,
    TouchProblem,
)
from makebreak.gap.residuals.pressing import PressingProblem
from makebreak.gap.result import GapMeasure, NamedEffect
from makebreak.gap.search.choice import Choice
from makebreak.gap.verdict import below_noise, says, two_figures
from makebreak.models.effects.kind import Effect


def measure(before: float, after: float, window_s: float = 0.3) -> GapMeasure:
    return GapMeasure(before, after, 1.0, window_s)


@pytest.mark.parametrize(
    ("start", "end", "gap"),
    [
        (41.0, 9.0, measure(41.0, 9.0)),  # Both: a fifth is left.
        (41.0, 9.0, measure(41.0, 16.0)),  # Less than a factor of two apart.
        # Next to nothing is left in both: how much less is no disagreement.
        (101.0, 1.0, measure(11.0, 2.5)),
        (101.0, 1.0, measure(11.0, 9.0, window_s=0.0)),  # Nothing was simulated.
        (1.2, 1.0, measure(11.0, 9.0)),  # No gap in the equations.
    ],
)
def test_figures_that_agree_need_no_sentence(start, end, gap):
    assert two_figures(start, end, gap) == ""


@pytest.mark.parametrize(
    ("start", "end", "gap", "said"),
    [
        (41.0, 9.0, measure(41.0, 25.0), "20% of the gap is left, simulation 60%"),
        (41.0, 25.0, measure(41.0, 9.0), "60% of the gap is left, simulation 20%"),
        (101.0, 1.0, measure(11.0, 4.0), "0% of the gap is left, simulation 30%"),
    ],
)
def test_figures_more_than_a_factor_of_two_apart_are_said(start, end, gap, said):
    assert said in two_figures(start, end, gap)


def test_a_gap_that_simulation_does_not_show_is_told_by_the_equations():
    said = two_figures(11.0, 0.934, measure(1.41, 0.83))
    assert "Simulated windows do not show this gap" in said
    assert "from 11 to 0.934 times the expected error" in said
    said = two_figures(11.0, 11.0, measure(1.2, 1.2))  # Nothing was named.
    assert "Simulated windows do not show this gap" in said
    assert "error is 11 times the expected error" in said


@pytest.mark.parametrize(
    ("gap", "left", "said"),
    [
        (measure(12.0, 6.0), 9.0, "error 6 times the expected error."),
        (
            measure(1.1, 1.0),
            70.0,
            "error 70 times the expected error in the equations of motion, "
            "1 in simulated windows.",
        ),
        (measure(12.0, 6.0, 0.0), 9.0, "error 6 times the expected error."),
        (measure(1.1, 1.0), 0.9, "error 1 times the expected error."),
    ],
)
def test_a_gap_without_a_name_has_the_figure_that_shows_it(gap, left, said):
    text = says("gap_unnamed", [], gap, "", left)
    assert text.endswith(f"the catalogue explains: held-out {said}")


def test_what_is_left_beside_what_is_named_has_both_figures():
    effect = NamedEffect("payload", ("a.b",), {}, "It carries 2 kg.", None)  # type: ignore[arg-type]
    said = says("gap_unnamed", [effect], measure(30.8, 0.28), "", 1.6)
    assert "It carries 2 kg. Beyond that, a gap remains" in said
    assert (
        "1.6 times the expected error in the equations of motion, 0.28 in simulated"
        in said
    )
    assert said.endswith("(30.8 without what is named).")


def test_where_all_errors_are_of_windows_the_sentence_speaks_of_their_data():
    said = two_figures(11.0, 0.934, measure(1.41, 0.83), by_equations=False)
    assert "equations" not in said
    assert "held out for the report do not show this gap" in said
    assert (
        "selected on the error falls from 11 to 0.934 times the expected error." in said
    )
    said = two_figures(41.0, 9.0, measure(41.0, 25.0), by_equations=False)
    assert "20% is left in the data that effects were selected on, 60% in" in said
    text = says("gap_unnamed", [], measure(1.1, 1.0), "", 70.0, by_equations=False)
    assert (
        "70 times the expected error in the data for selection, 1 in those for the"
        in text
    )


def test_which_problems_are_of_equations():
    windows = {ImpactProblem, FlightProblem, RolloutProblem, DrivenProblem}
    equations = {ContactProblem, PressingProblem, MechanismProblem}
    assert not any(each.by_equations for each in windows | {TouchProblem})
    assert all(each.by_equations for each in equations)


@pytest.mark.parametrize(
    ("before", "after", "goes"),
    [
        (5.28, 1.03, "falls from 5.28 to 1.03 times"),
        (1.03, 1.1, "goes from 1.03 to 1.1 times"),
        (1.031, 1.029, "stays at 1.03 times"),
    ],
)
def test_how_the_held_out_error_goes_is_said(before, after, goes):
    assert goes in says("gap_named", [], measure(before, after))


def test_what_is_below_the_noise_is_said_to_be():
    """Only where something is named, and no error is larger than it may be."""
    effect = Effect("object_mass", ["a.box"], {"mass": 1.0})
    named = Choice(effect, {}, 1.0, 0.9, "", 0.0, (), (), 1)
    below = measure(0.85, 0.78)
    assert "without it is no larger than noise" in below_noise([named], 0.96, below)
    assert "without them" in below_noise([named, named], 0.96, below)
    assert below_noise([], 0.96, below) == ""
    assert below_noise([named], 2.0, below) == ""
    assert below_noise([named], 0.96, measure(3.0, 0.78)) == ""

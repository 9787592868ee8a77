"""Which kind of problem a scene and recordings are: the next one is asked only where
one says that it is not for them."""

from functools import partial
from types import SimpleNamespace

import pytest

from makebreak.gap import workflow
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.residuals import contact_problem, driven, mechanism, objects

# Of joints alone, and beside free bodies: the order in which problems are asked.
OF_JOINTS = ["PressingProblem", "ImpactProblem", "MechanismProblem"]
OF_BODIES = ["contact_problem", "TouchProblem", "FlightProblem", "RolloutProblem"]


def with_problems(monkeypatch, first_that_fits, order, error=DoesNotFit):
    """A workflow whose problems are their own names, of which those before one do not
    fit; the one just before it raises `error`."""
    fits = order.index(first_that_fits)
    for k, name in enumerate(order):

        def make(scene, recordings, k=k, name=name, **_):
            if k < fits:
                raise (error if k == fits - 1 else DoesNotFit)("setting an element")
            return SimpleNamespace(
                name=name, is_explained=lambda: True, push_findings=list, lying=list
            )

        monkeypatch.setattr(workflow, name, make)
    for name in ("presses", "runs_against"):
        monkeypatch.setattr(workflow, name, lambda *_: True)
    monkeypatch.setattr(workflow, "push_each_other", lambda *_: False)
    is_mechanism = order is OF_JOINTS
    monkeypatch.setattr(workflow, "_is_mechanism", lambda *_: is_mechanism)
    joint = SimpleNamespace(num_velocities=lambda: 1)
    monkeypatch.setattr(workflow, "one_dof_joints", lambda plant: [joint])
    monkeypatch.setattr(workflow, "without_contact", lambda *_: ([], []))
    monkeypatch.setattr(workflow, "without_shapes", lambda scene: scene)
    monkeypatch.setattr(workflow, "_settle_step", lambda scene, *_: (scene, []))
    for name in ("sap_lift", "point_on_face", "point_on_face_of", "set_command_times"):
        monkeypatch.setattr(workflow, name, lambda *_: [])
    return workflow.problem_for(None, [], SimpleNamespace(plant=None))


@pytest.mark.parametrize("order", [OF_JOINTS, OF_BODIES])
def test_the_first_problem_that_fits_is_taken(monkeypatch, order):
    for name in order:
        problem, _ = with_problems(monkeypatch, name, order)
        assert problem.name == name


@pytest.mark.parametrize("order", [OF_JOINTS, OF_BODIES])
def test_a_defect_inside_a_problem_is_not_taken_for_one_that_does_not_fit(
    monkeypatch, order
):
    for name in order[1:]:
        with pytest.raises(ValueError, match="setting an element"):
            with_problems(monkeypatch, name, order, error=ValueError)


def outcomes(monkeypatch, error):
    """Each method that simulates other recordings, with windows that raise an error."""

    def windows(*args, **kwargs):
        raise error("setting an element")

    for module, name in (
        (contact_problem, "PushWindows"), (driven, "DrivenWindows"),
        (mechanism, "InverseModel"), (objects, "TouchModel"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, windows)
    for module in (driven, mechanism):
        monkeypatch.setattr(module, "with_moved_gains", lambda scene, *_: scene)
    windowed = SimpleNamespace(
        _model=lambda: SimpleNamespace(windows=[]), _again=windows
    )
    problem = SimpleNamespace(
        scene=None,
        slides=0.0,
        recordings=[],
        tracks=[],
        _windows=None,
        lying=list,
        pressed=list,
        _other=None,
    )
    problem._model_of = partial(mechanism.MechanismProblem._model_of, problem)
    end = SimpleNamespace(b=None)
    names = SimpleNamespace(names=())
    for kind, own, recordings in (
        (contact_problem.ContactProblem, problem, []),
        (contact_problem.ContactProblem, problem, None),
        (driven.DrivenProblem, problem, []),
        (mechanism.MechanismProblem, problem, []),
        (objects.TouchProblem, problem, []),
        (objects.WindowedProblem, windowed, []),
    ):
        yield partial(kind.outcome, own, [], None, end, names, recordings)


def test_without_a_window_there_is_no_outcome(monkeypatch):
    for outcome in outcomes(monkeypatch, DoesNotFit):
        assert outcome() is None


def test_a_defect_in_a_window_is_not_taken_for_too_little_data(monkeypatch):
    for outcome in outcomes(monkeypatch, ValueError):
        with pytest.raises(ValueError, match="setting an element"):
            outcome()

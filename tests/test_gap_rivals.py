"""Rivals of an effect: which pairs of them are compared at all."""

from types import SimpleNamespace

import pytest
from gap_benchmark import contact_cases

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.split import split
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.search import rivals
from makebreak.gap.search.choice import Trial
from makebreak.gap.search.select import select
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

FRICTION = Effect("contact_friction", ["disc.disc~table.table"], {"friction": 0.45})
MASS = Effect("object_mass", ["disc.disc"], {"mass": 0.7})


def trial(effect: Effect) -> Trial:
    candidate = SimpleNamespace(
        members=(), size=1, fixed=(), kind=effect.kind,
        effects=lambda alternative, c: (effect,),
    )  # fmt: skip
    ranked = SimpleNamespace(candidate=candidate, alternative=0)
    return Trial(SimpleNamespace(effects=(effect,)), ranked)  # type: ignore[arg-type]


def together(monkeypatch, one: Effect, other: Effect, fitted, std):
    """Two rivals as they are compared, and what their fit together is."""
    found = SimpleNamespace(fitted=SimpleNamespace(effects=fitted, std=std))
    monkeypatch.setattr(rivals, "fit_together", lambda *arguments: found)
    problem = SimpleNamespace(least=lambda kind, at: {})
    search = SimpleNamespace(problem=problem, nuisances=None)
    both = rivals.Rivals(search).together(  # type: ignore[arg-type]
        [], trial(one), trial(other)
    )
    return both, found


@pytest.mark.parametrize(
    ("friction", "std", "mass", "known"),
    [
        (0.45, 0.02, 0.7, True), (1.3, 0.1, 0.7, True), (1.45, 0.1, 0.7, False),
        (1.5, 0.0, 0.7, False), (0.45, 0.02, 0.1, True), (0.45, 0.02, 0.021, False),
        (0.45, 0.02, 1e-7, False),
    ],
)  # fmt: skip
def test_two_of_which_one_goes_to_the_end_of_its_range_are_not_compared(
    monkeypatch, friction, std, mass, known
):
    """A disc pushed at one speed, in MuJoCo, of friction 0.45: with the mass free, the
    friction went to 1.475 +- 0.094 and the mass to a third. The range ends at 1.5. And
    a ball that was rolled seemed to need no mass at all beside a drag."""
    fitted = (
        Effect(FRICTION.kind, FRICTION.at, {"friction": friction}),
        Effect(MASS.kind, MASS.at, {"mass": mass}),
    )
    std_of = {"friction": std}, {"mass": 0.02 * (mass > 1e-3)}
    both, found = together(monkeypatch, FRICTION, MASS, fitted, std_of)
    assert both is (found if known else None)


@pytest.mark.parametrize(("other", "known"), [(FRICTION, True), (MASS, False)])
def test_a_gain_and_an_inertia_are_not_fitted_together(monkeypatch, other, known):
    """Both can become small, and with them all that noise leaves: of a cart 0.27 times
    its drive's force and no mass at all left least."""
    gain = Effect("actuator_gain", ["rig.x"], {"gain": 0.8})
    (name,) = other.parameters
    std = {"gain": 0.01}, {name: 0.01}
    both, found = together(monkeypatch, gain, other, (gain, other), std)
    assert both is (found if known else None)


@pytest.mark.slow
def test_a_mass_and_a_friction_that_nearly_cancel_are_both_named(tmp_path):
    """A block that is lighter by a third on a table that is rougher by half: each alone
    changes little, and beside either alone a lower table is needed more."""
    case = contact_cases.contact_cases("contact-final", 1015000)[13]
    truth = contact_cases.write(case, tmp_path)
    scene = read_scene(tmp_path / "scene.yaml")
    recordings = split(read_recordings([tmp_path / "recording.csv"])).decided
    selection = select(ContactProblem(scene, recordings))
    found = {c.effect.kind: c.effect.parameters for c in selection.choices}
    assert set(found) == {"object_mass", "contact_friction"}
    for effect in truth["effects"]:
        for name, value in effect["parameters"].items():
            assert found[effect["kind"]][name] == pytest.approx(value, rel=0.03)

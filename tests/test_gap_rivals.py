"""Rivals of an effect: which pairs of them are compared at all."""

from types import SimpleNamespace

import pytest

from makebreak.gap.search import rivals
from makebreak.gap.search.choice import Trial
from makebreak.models.effects.kind import Effect

FRICTION = Effect("contact_friction", ["disc.disc~table.table"], {"friction": 0.45})
MASS = Effect("object_mass", ["disc.disc"], {"mass": 0.7})


def trial(effect: Effect) -> Trial:
    candidate = SimpleNamespace(
        members=(), size=1, fixed=(), effects=lambda alternative, c: (effect,)
    )
    ranked = SimpleNamespace(candidate=candidate, alternative=0)
    return Trial(SimpleNamespace(effects=(effect,)), ranked)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("friction", "std", "known"),
    [(0.45, 0.02, True), (1.3, 0.1, True), (1.45, 0.1, False), (1.5, 0.0, False)],
)
def test_two_of_which_one_goes_to_the_end_of_its_range_are_not_compared(
    monkeypatch, friction, std, known
):
    """A disc pushed at one speed, in MuJoCo, of friction 0.45: with the mass free, the
    friction went to 1.475 +- 0.094 and the mass to a third. The range ends at 1.5."""
    pair = Effect(FRICTION.kind, FRICTION.at, {"friction": friction}), MASS
    fitted = SimpleNamespace(effects=pair, std=({"friction": std}, {"mass": 0.02}))
    found = SimpleNamespace(fitted=fitted)
    monkeypatch.setattr(rivals, "fit_together", lambda *arguments: found)
    search = SimpleNamespace(problem=None, nuisances=None)
    one, other = trial(FRICTION), trial(MASS)
    together = rivals.Rivals(search).together([], one, other)  # type: ignore[arg-type]
    assert together is (found if known else None)

"""Scenes with free bodies, as problems for the search: touches, flights, rollouts."""

from collections.abc import Sequence

import numpy as np

from makebreak.gap.data.findings import Finding
from makebreak.gap.data.recording import Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.problem import (
    DISTANCES,
    Candidate,
    Fitted,
    GapProblem,
    Nuisances,
    Outcome,
    SearchPlan,
)
from makebreak.gap.residuals.contact import contact_candidates, contact_nuisances
from makebreak.gap.residuals.lying_on_faces import one_point
from makebreak.gap.residuals.touch import TouchModel, touch_candidates
from makebreak.gap.residuals.where import unexplained_in_windows, where_in_windows
from makebreak.gap.result import Where
from makebreak.gap.simulation.free_windows import FreeBodyModel, touched
from makebreak.gap.simulation.measure import (
    gap_measure,
    series_of,
    unseen_series,
    why_stopped,
)
from makebreak.gap.simulation.windows import WindowModel
from makebreak.models.effects.contact import STIFFNESS
from makebreak.models.scene import Scene

# A real object differs from its model in more ways than a mechanism.
MOST_EFFECTS = 6
# Windows of scenes that Drake has to simulate: length, and how many at most.
DRAKE_SEC, DRAKE_MOST = 0.3, 16


# What distances are computed from.
COMPARED = ("position", "x", "y", "z", "qw", "qx", "qy", "qz", "fx", "fy", "fz")


class TouchProblem(TouchModel, GapProblem):
    """A measured mechanism, and a wrench that tells when it touches an object."""

    by_equations = False
    # Two explanations that both leave less than the allowance for shapes are a tie.
    plan = SearchPlan(least_error=1.0)

    def candidates(self, nuisances: Nuisances, current: Fitted) -> list[Candidate]:
        return touch_candidates(self)

    def judged(self) -> dict[str, str]:
        """That shapes meet says nothing of how anything moves."""
        things = {touch.thing for touch in self.touches}
        tools = {touch.tool for touch in self.touches}
        return {
            c.name: DISTANCES
            for r in self.recordings
            for c in r.measured()
            if c.quantity in COMPARED
            and (c.at in things or c.at in tools or c.at in self.joints)
        }

    def outcome(
        self, effects, start: Fitted, end: Fitted, nuisances: Nuisances,
        recordings=None, jobs: int = 1,
    ) -> Outcome | None:  # fmt: skip
        if recordings is None:
            held = ~self.train()
            if not held.any():
                return None
            gap = self.measure(start.left, end.left, held)
            return Outcome(gap, self.series(start.left, end.left))
        try:
            other = TouchModel(self.scene, recordings)
        except DoesNotFit:  # Nothing is touched in them.
            return None
        there = other.nuisances()
        left = []
        for of, fitted in (((), start), (effects, end)):
            known = dict(zip(nuisances.names, fitted.b, strict=True))
            b = np.array([known.get(name, 0.0) for name in there.names])
            left.append(other.residual(of) - there.columns @ b)
        before, after = left
        gap = other.measure(before, after, np.ones(len(before), bool))
        return Outcome(gap, other.series(before, after))


class WindowedProblem(GapProblem):
    """What problems of simulated windows share."""

    by_equations = False

    def nuisances(self) -> Nuisances:
        return contact_nuisances(self._model())

    def candidates(self, nuisances: Nuisances, current: Fitted) -> list[Candidate]:
        return contact_candidates(
            self._model(), current.effects, current.r, self.plan.counts_evidence
        )

    def judged(self) -> dict[str, str]:
        return dict.fromkeys(self._model().channels, "simulation")

    def where(self, left: np.ndarray) -> list[Where]:
        model = self._model()
        simulated = model.simulate(())
        ended = [
            e if np.isfinite(y[~np.isnan(y)]).all() else e[:0]
            for e, y in zip(model.errors(simulated), simulated, strict=True)
        ]
        return where_in_windows(model, ended)

    def outcome(
        self, effects, start: Fitted, end: Fitted, nuisances: Nuisances,
        recordings=None, jobs: int = 1,
    ) -> Outcome | None:  # fmt: skip
        model = self._model()
        held = [not w.train for w in model.windows]
        if recordings is not None:
            try:
                model = self._again(recordings)
            except DoesNotFit:  # No window fits in.
                return None
            held = [True] * len(model.windows)
        if not any(held):
            return None
        before, after = model.simulate(()), model.simulate(effects)

        def why(k: int, with_effects: bool) -> str:
            if not isinstance(model, WindowModel):
                return ""
            return why_stopped(model, effects if with_effects else (), k)

        gap = gap_measure(model, before, after, held, why)
        if not gap.is_measured:
            return Outcome(gap)
        series = series_of(model, before, after, held)
        if isinstance(model, WindowModel):
            series += unseen_series(model, effects, held)
        return Outcome(
            gap,
            series,
            unexplained_in_windows(model, after),
            where=where_in_windows(model, model.errors(before)) if recordings else (),
        )

    def _model(self) -> FreeBodyModel | WindowModel:
        raise NotImplementedError

    def _again(self, recordings: Sequence[Recording]) -> FreeBodyModel | WindowModel:
        raise NotImplementedError


class FlightProblem(FreeBodyModel, WindowedProblem):
    """Free bodies that fly, bounce, slide or roll on what is fixed, or collide."""

    plan = SearchPlan(
        jumps=True,  # Where an object's spheres land in another order.
        # Errors below the noise, which is mostly how unsure a start is, tell no two
        # models apart.
        least_error=1.0,
        diff_step=2e-3,  # Smaller ones drown in the error of the steps.
        # Laws of contact leave so much that no effect but the first takes off a tenth.
        least_gain=0.05,
        most_effects=MOST_EFFECTS,
    )

    def _model(self) -> FreeBodyModel:
        return self

    def _again(self, recordings: Sequence[Recording]) -> FreeBodyModel:
        return FreeBodyModel(self.scene, recordings, dynamics=self.dynamics)


class RolloutProblem(WindowModel, WindowedProblem):
    """Anything else: windows simulated by Drake."""

    # Each residual takes seconds.
    plan = SearchPlan(evaluations=5, most_effects=MOST_EFFECTS)

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        many = sum(len(r.episodes) for r in recordings) >= 6
        super().__init__(scene, recordings, DRAKE_SEC, by_episode=many, most=DRAKE_MOST)

    def _model(self) -> WindowModel:
        return self

    def _again(self, recordings: Sequence[Recording]) -> WindowModel:
        return WindowModel(self.scene, recordings, DRAKE_SEC, most=DRAKE_MOST)


def point_on_face_of(model: FreeBodyModel) -> list[Finding]:
    """A warning where a body that has faces touches something: Drake gives it one
    point there, and here it stands on spheres."""
    found = []
    for name in model.with_faces:
        if not len(touched(model, name)):
            continue
        places = [at.split("~") for at in model.dynamics.places(STIFFNESS)]
        grounds = sorted(b for a, b in places if a == name and b not in model.bodies)
        found.append(
            one_point(
                name, f"{name} on {', '.join(grounds)}", name in model.on_side,
                model.recordings[0].name,
            )
        )  # fmt: skip
    return found

"""What a scene's free bodies feel, several of which may touch, as numbers."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.free_body import FreeBodies, alone
from makebreak.gap.simulation.free_body import (
    AT_CORNERS,
    CHANGES,
    FORCES,
    SENSORS,
    SURFACES,
    FreeBodyScene,
    Numbers,
    combined,
    drakes,
    in_order,
    load_free_bodies,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact import DAMPER
from makebreak.models.effects.kind import Effect, find_pair, full_name
from makebreak.models.scene import LoadedScene, Scene


class FreeBodiesScene:
    """A scene's free bodies; effects change their numbers without another plant.

    Bodies touch one another with spheres that are their own shapes, not with those that
    stand in for faces.

    Args: on_side: names of bodies whose cylinders lie on their sides. loaded: the
        scene, if it is loaded already.
    Raises: DoesNotFit as FreeBodyScene, for each of them.
    """

    def __init__(
        self,
        scene: Scene,
        on_side: Sequence[str] = (),
        loaded: LoadedScene | None = None,
    ):
        self.scene, self._on_side = scene, tuple(on_side)
        self._eased: tuple[np.ndarray, ...] = ()
        loaded, bodies = load_free_bodies(scene, loaded)
        plant, inspector = loaded.plant, loaded.scene_graph.model_inspector()
        self.each = [
            FreeBodyScene(scene, full_name(plant, body) in on_side, (loaded, body))
            for body in bodies
        ]
        self.names = [one.name for one in self.each]
        self._drake = drakes(plant)
        shapes = [plant.GetCollisionGeometriesForBody(body) for body in bodies]
        # Whether a pair of them may touch.
        self._touch = np.array(
            [[i < j and not any(inspector.CollisionFiltered(a, b)
                                for a in mine for b in others)
              for j, others in enumerate(shapes)]
             for i, mine in enumerate(shapes)]
        )  # fmt: skip
        n = len(bodies)
        self._damper = np.full((n, n), np.nan)
        for effect in loaded.effects:
            if effect.kind in FORCES and KINDS[effect.kind].at == "pair":
                pair = [full_name(plant, body) for body in find_pair(effect, plant)]
                if not set(pair) <= set(self.names):
                    continue
                if effect.kind != DAMPER:
                    raise DoesNotFit(f"{effect.kind} of {' and '.join(pair)}")
                a, b = sorted(self.names.index(name) for name in pair)
                self._damper[a, b] = effect.parameters["damping"]

    def meet(self, a: str, b: str) -> bool:
        """Whether two of them would touch, and with shapes that have no spheres."""
        i, j = sorted((self.names.index(a), self.names.index(b)))
        return bool(self._touch[i, j])

    def ease(self, on: Sequence[np.ndarray]) -> None:
        """FreeBodyScene.ease of each."""
        self._eased = tuple(on)
        for one, mine in zip(self.each, on, strict=True):
            one.ease(mine)

    def bodies(
        self, effects: Sequence[Effect] = (), at_corners: float = AT_CORNERS
    ) -> FreeBodies:
        """As FreeBodyScene.body.

        Raises: ValueError for effects that no body can have.
        """
        if len(self.each) == 1:
            return alone(self.each[0].body(effects, at_corners))
        if not all(e.kind in CHANGES or e.kind in SENSORS for e in effects):
            more = replace(self.scene, effects=[*self.scene.effects, *effects])
            other = FreeBodiesScene(more, self._on_side)
            if self._eased:
                other.ease(self._eased)
            return other.bodies((), at_corners)
        numbers = [one.numbers() for one in self.each]
        damper = np.array(self._damper)
        for effect in in_order(effects):
            self._change(effect, numbers, damper)
        each = tuple(
            one.body_of(now, at_corners)
            for one, now in zip(self.each, numbers, strict=True)
        )
        owner = np.repeat(np.arange(len(each)), [len(one.spheres) for one in each])
        own = np.concatenate([now.own for now in numbers])
        touch = self._touch[owner[:, None], owner[None, :]]
        damper = damper[owner[:, None], owner[None, :]]
        mutual = combined(own[:, None], own[None, :], damper, self._drake)
        return FreeBodies(each, mutual * touch[..., None])

    def _change(self, effect: Effect, numbers: list[Numbers], damper) -> None:
        """Applies an effect as models/effects does to the plant: that on a pair may
        change the surface of one body of it, and so other pairs of this body."""
        kind, p = effect.kind, effect.parameters
        whole = {name.split(".")[0]: name for name in self.names}
        places = [whole.get(place, place) for place in self.each[0].places(effect)]
        there = [k for k, one in enumerate(self.each) if one.name in places]
        on = self.each[0].grounds_in(places)
        if len(there) < 2:
            for k in there or range(len(numbers)):
                CHANGES[kind](numbers[k], p, on)
                if kind == DAMPER:
                    numbers[k].own[:, 1] = numbers[k].other[on, 1] = 0.0
            for k in there:
                for other in numbers:
                    other.other[on] = numbers[k].other[on]
            return
        # The first one named is changed, where both are free.
        i, j = sorted(there, key=lambda k: places.index(self.each[k].name))
        first, second = numbers[i], numbers[j]
        if kind == DAMPER:
            damper[min(i, j), max(i, j)] = p["damping"]
            first.own[:, 1] = second.own[:, 1] = 0.0
            return
        if kind not in SURFACES:
            raise ValueError(f"{kind} of two bodies that are free")
        pair = replace(second, other=first.own)
        CHANGES[kind](pair, p, np.ones(len(first.own), bool))

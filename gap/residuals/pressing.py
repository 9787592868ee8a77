"""A robot whose tool touches, slides along and presses on what is fixed.

The equations of motion with permitted contact forces (contact_dynamics.py), for scenes
in which joints are all that moves. What is fixed may stand elsewhere than the scene has
it (fixed_faces.py); where it does is felt (felt_places.py). Here: the rows, with the
distances of what presses, and the candidates.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from makebreak.gap.data.pieces import excerpt
from makebreak.gap.data.recording import Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.runs import runs_of
from makebreak.gap.numerics.selection import Screen, std_of_shared_errors
from makebreak.gap.problem import Candidate, Fitted, Nuisances
from makebreak.gap.residuals.contact_dynamics import THIN
from makebreak.gap.residuals.contact_means import SLIDES
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.felt_places import AXES, MOVES, SOFT, WHOLE, FeltPlaces
from makebreak.gap.residuals.fixed_faces import (
    CLEAR,
    FEWEST_ROWS,
    KNOCKED,
    LEAST_FORCE,
    PASSED,
    REACH,
)
from makebreak.gap.residuals.impacts import (
    MOST_SHARE,
    nearest,
    nearest_of,
    positions,
    walls_of,
)
from makebreak.gap.residuals.lying_on_faces import pressed_with_corners
from makebreak.gap.residuals.mechanism_candidates import loads
from makebreak.gap.residuals.permitted_contacts import Geometry, Shift
from makebreak.gap.residuals.wrench_sensor import FORCE
from makebreak.gap.simulation.contact_shapes import MEETS, ContactShapes, Slot
from makebreak.gap.simulation.face_supports import LiesOn
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.contact import STIFFNESS
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints
from makebreak.models.scene import Scene

FELT_SHARE = 0.03  # Of the rows: a wrench that is felt in more of them.
# Times the stiffness of the scene: trials. Drake's default is a hundred times that of
# a rubber tip.
SOFTER = (0.03, 0.1, 0.3, 0.6, 2.0)
LOUD = 1.5  # Times its noise: a channel for which the search goes on.
SQUEEZED = 10.0  # Times what a row needs: forces that act in it, at most.
MOST_FRICTION = 2.0  # Of what is taken for any.
MOST_PATCHES, MOST_EFFECTS = 3, 10
SMALL_SHIFT = 1e-3  # First trial of a place [m].
# What a contact may give at least, whatever stiffness the scene has [m/N]: Drake's
# default is a hundred times stiffer than a rubber tip.
COMPLIANCE, SHORT_SHIFT = 5e-5, 1e-5
INSIDE = 1.02  # Times the least stiffness: where a fit may start.
# A touch that lasts so long is no impact [s]. Of longer recordings pieces are asked.
LASTS_SEC, ASKED_SEC, ASKED_ROWS = 0.3, 60.0, 120_000


def presses(dynamics: SceneDynamics, recordings: Sequence[Recording]) -> bool:
    """Whether a mechanism rests on what is fixed: a wrench is felt for a while, shapes
    are in touch for most of the time or in touches that last, or the drives' efforts
    tell that a face is pressed on which the scene has elsewhere."""
    try:
        shapes = walls_of(dynamics)
    except DoesNotFit:
        return False
    if shapes is None:
        return False
    felt = rows = 0
    for recording in recordings:
        for place in recording.places(FORCE):
            names = [f"{place}.{a}" for a in FORCE]
            if not all(name in recording for name in names):
                continue
            size = np.linalg.norm([recording[name] for name in names], axis=0)
            noise = max(recording.channels[name].noise for name in names)
            good = np.isfinite(size)
            rows += int(good.sum())
            felt += int((size[good] > max(CLEAR * noise, LEAST_FORCE)).sum())
    if rows and felt > FELT_SHARE * rows:
        return True
    inside = lasting = close = whole = 0
    for recording in recordings:
        q = positions(dynamics, recording)
        step = max(len(q) // 4000, 1)
        apart = nearest(shapes, dynamics, q[::step], REACH)
        inside += int((apart < MEETS).sum())
        lasting += _rows_of_lasting(apart < MEETS, recording.time[::step])
        close += int((apart < REACH).sum())
        whole += len(apart)
    if inside > MOST_SHARE * whole or lasting > FELT_SHARE * whole:
        return True
    if rows or close <= FELT_SHARE * whole:
        return False
    try:
        some = excerpt(recordings, ASKED_SEC, ASKED_ROWS)
        problem = PressingProblem(dynamics.loaded.scene, some)
    except DoesNotFit:
        return False
    # What merely runs against a face goes in deeper, the harder it strikes: that is no
    # place at which the face is.
    touching, first, lasting = problem.touches_where_felt(), 0, 0
    for track in problem.tracks:
        last = first + len(track.time)
        lasting += _rows_of_lasting(touching[first:last], track.time)
        first = last
    return lasting > FELT_SHARE * len(touching)


def push_each_other(dynamics: SceneDynamics, recordings: Sequence[Recording]) -> bool:
    """Whether what moves on joints touches what moves on others: a finger an object
    that slides on a rail. An object, which no drive moves, goes only where it is
    pushed: one touch is enough. Limbs that have drives pass close by each other: theirs
    count if they go on for a while. Links that one joint moves do not count: shapes of
    one robot often overlap."""
    try:
        shapes = ContactShapes(dynamics.loaded, hulls=False)
    except DoesNotFit:
        return False
    plant = dynamics.plant
    driven, moved_by = set[int](), dict[int, set[int]]()
    motors = dynamics.loaded.scene.actuation.joints
    for joint in one_dof_joints(plant):
        for body in plant.GetBodiesKinematicallyAffectedBy([joint.index()]):
            if joint.num_velocities():
                moved_by.setdefault(int(body), set()).add(int(joint.index()))
                if full_name(plant, joint) in motors:
                    driven.add(int(body))

    def counts(a: int, b: int) -> bool:
        both = moved_by.get(a, set()), moved_by.get(b, set())
        return all(both) and not set.intersection(*both)

    lasting = whole = 0
    for recording in recordings:
        q, time = positions(dynamics, recording), recording.time
        step = max(len(q) // 4000, 1)
        q, time = q[::step], time[::step]
        pushed = nearest_of(
            shapes, dynamics, q, lambda a, b: counts(a, b) and not {a, b} <= driven
        )
        if (pushed < MEETS).any():
            return True
        apart = nearest_of(shapes, dynamics, q, counts)
        lasting += _rows_of_lasting(apart < MEETS, time)
        whole += len(apart)
    return lasting > FELT_SHARE * whole


def thinned(on: np.ndarray, force: np.ndarray, episode: np.ndarray) -> np.ndarray:
    """Of test functions (K,) in which a pair touches those that are told: none within
    THIN of another one of its episode, the hardest pressed first. So a touch is told,
    however short, but for one that follows another at once. As it begins a tool may
    still be above what it is about to touch, with a force that is another contact's
    friction.

    Args: force (K,): with which the pair is pressed; episode (K,): its number.
    """
    out = np.zeros(len(on), bool)
    for k in np.argsort(-force, kind="stable"):
        near = slice(max(k - THIN + 1, 0), k + THIN)
        if on[k] and not (out[near] & (episode[near] == episode[k])).any():
            out[k] = True
    return out


def _rows_of_lasting(touching: np.ndarray, time: np.ndarray) -> int:
    """How many rows (n,) are in touches that last."""
    return sum(b - a for a, b in runs_of(touching) if time[b - 1] - time[a] > LASTS_SEC)


class PressingProblem(FeltPlaces):
    """Raises: DoesNotFit where anything but joints moves, or as ContactDynamics."""

    moves = MOVES
    # A wall that was met for a moment shows in its own distance alone, and how soft it
    # is in a small part of that.
    plan = replace(
        ContactProblem.plan, by_channel=True, most_effects=MOST_EFFECTS, loud=LOUD
    )

    def __init__(
        self,
        scene: Scene,
        recordings: Sequence[Recording],
        learned: ContactProblem | None = None,
        slides: float = SLIDES,
    ):
        self._any_friction = False
        self._mu: float | None = None
        # How often rows were weighed; what last pressed, and for which effects.
        self._weighed = 0
        self._pressed_at: tuple[tuple | None, dict] = (None, {})
        self._not_passed: tuple = ()  # Places with which the tool went through nothing.
        super().__init__(scene, recordings, learned, slides)

    # ----- Rows

    def _limit_acting(self, needed: np.ndarray) -> None:
        # Where the scene has a tool inside a body, faces may press against each other
        # as hard as they like.
        self.acting = np.minimum(self.acting, SQUEEZED * needed)

    def allow(self, allowance: np.ndarray) -> None:
        # Which rows forces take up is asked of the scene as it came.
        kept, self._any_friction = self._any_friction, False
        try:
            super().allow(allowance)
        finally:
            self._any_friction = kept
        self._weighed += 1
        if hasattr(self, "_met"):  # Else not all is prepared.
            self._pressed, _ = self._pressing()

    def _learn_misfit(self) -> None:
        """What a model with everything ordinary leaves where bodies may really be and
        friction may be anything, other at each place."""
        self._any_friction = True
        try:
            super()._learn_misfit()
        finally:
            self._any_friction = False
        self._set(self.allowance)

    def _friction(self, s: Slot, effects: Iterable[Effect]) -> np.ndarray:
        if self._mu is not None:
            return np.full(len(s.phi), self._mu)
        return super()._friction(s, effects)

    def _generators(self, effects: Sequence[Effect], shift: Shift | None = None):
        """With any friction: of each contact a force with none and one with the most,
        so that all between them are their sums."""
        self._mu = None
        if not self._any_friction:
            return super()._generators(effects, shift)
        effects = [*effects, *self._displacing(self.off)]
        self._mu = 0.0
        least = super()._generators(effects, shift)
        self._mu = MOST_FRICTION
        most = super()._generators(effects, shift)
        self._mu = None
        G, there, of, geometry, _ = least
        made = [np.concatenate([x, y], axis=-1) for x, y in
                ((G, most[0]), (there, most[1]))]  # fmt: skip
        sharing = self._sharing(of + of, geometry.slots)
        return (*made, of + most[2], geometry, sharing)

    def left(
        self,
        effects: Sequence[Effect] = (),
        shift: Shift | None = None,
        weighed_as: Sequence[Effect] | None = None,
    ):
        self._softened = [e for e in effects if e.kind == STIFFNESS]
        self._pressed_now = self._pressed_with(effects)
        self._placed = [e for e in effects if e.kind in MOVES]
        self._refuse_passing(self._placed)
        if self._any_friction:
            self._placed += self._displacing(self.off)
        return super().left(effects, shift, weighed_as)

    def _refuse_passing(self, placed: Sequence[Effect]) -> None:
        """Raises: ValueError where a place has the tool deeper in a body than a knock
        goes, at moments at which it is not in the scene: no row would tell, since
        distances are those of moments at which the tool presses."""
        key = tuple((*e.at, *sorted(e.parameters.items())) for e in placed)
        if not placed or key == self._not_passed:
            return
        inside = self._inside(placed)
        before = self._inside(())
        for body, depth in inside.items():
            if body in self.soft:  # How deep it may be there its distances tell.
                continue
            more = (depth < -KNOCKED) & ~(before.get(body, depth + 1.0) < -KNOCKED)
            if more.sum() >= FEWEST_ROWS:
                name = self.shapes.names[body]
                raise ValueError(
                    f"{placed[0].kind}: the tool was where {name} would be"
                )
        self._not_passed = key

    def _pressed_with(self, effects: Sequence[Effect]) -> dict:
        """{pair: (K,)} as _pressing() has it; the last one is kept."""
        others = [e for e in effects if e.kind not in (*MOVES, STIFFNESS)]
        if self._any_friction or not others or not hasattr(self, "_met"):
            return self._pressed
        key = tuple((e.kind, *e.at, *sorted(e.parameters.items())) for e in others)
        if self._pressed_at[0] != (key, self._weighed):
            self._pressed_at = (key, self._weighed), self._pressing(others)[0]
        return self._pressed_at[1]

    def _prepare(self) -> None:
        super()._prepare()
        self._told = {
            pair: thinned(on, self._pressed[pair], self.means.episode)
            for pair, on in self._met.items()
        }

    def _distances(self, geometry: Geometry) -> np.ndarray:
        """(K, pairs) over what shapes are known to: of each pair, when it is felt."""
        shape = self.shape_std()
        K = len(self.means.time)
        every, _ = self._slots(self._placed)
        columns = []
        for pair in self._pairs_met:
            mine = [s for s in every if self._pair_of(s) == pair]
            on = self._told.get(pair, np.zeros(K, bool))
            if not mine or not on.any():
                columns.append(np.zeros(K))
                continue
            nearest = np.min([s.phi for s in mine], axis=0)
            stiffness = mine[0].stiffness
            pressed = self._pressed_now.get(pair, np.zeros(K))
            for e in self._softened:
                if self._at_pair(e, pair):
                    stiffness = e.parameters["stiffness"]
                    if not stiffness > self._softest(pair, mine[0].stiffness, pressed):
                        raise ValueError("contact_stiffness: a tool goes in too far")
            d = self._W @ nearest + pressed / stiffness
            columns.append(np.where(on, d / shape, 0.0))
        return -np.stack(columns, axis=1) if columns else np.zeros((K, 0))

    def _softest(self, pair, stiffness: float, pressed: np.ndarray) -> float:
        """[N/m] A stiffness has to be more, or with one parameter it would explain a
        wall that stands elsewhere. Args: stiffness: the scene's; pressed (K,) [N]."""
        least = pressed[self._told[pair]].max() / PASSED
        return min(least, stiffness / SOFT) if set(pair) & self.soft else least

    def permitted(self, effects: Sequence[Effect]) -> list[Effect]:
        """Forces that are weighed anew, or by fewer effects, may be larger."""
        slots, _ = self._slots([e for e in effects if e.kind in MOVES])
        scene = {self._pair_of(s): s.stiffness for s in reversed(slots)}
        pressed = self._pressed_with(effects)
        out = list(effects)
        for k, e in enumerate(effects):
            if e.kind != STIFFNESS:
                continue
            for pair in scene.keys() & pressed.keys() & self._told.keys():
                if not self._at_pair(e, pair) or not self._told[pair].any():
                    continue
                least = self._softest(pair, scene[pair], pressed[pair])
                if not out[k].parameters["stiffness"] > least:
                    out[k] = replace(e, parameters={"stiffness": INSIDE * least})
        return out

    def widened(self, end: Fitted, k: int) -> tuple[dict[str, float], tuple[str, ...]]:
        """A place is known no better than how deep the tool goes in there, where no
        stiffness is fitted: as far as forces of several sizes do not tell it."""
        std, or_more = super().widened(end, k)
        effect, p = end.effects[k], end.effects[k].parameters
        if effect.kind not in MOVES:
            return std, or_more

        def distances(parameters) -> np.ndarray:
            others = [*end.effects]
            others[k] = replace(effect, parameters=parameters)
            self.left(others)
            return self._distances(self._geometry(others))[self._train]

        here = distances(p)
        depths, priors = self._depths_per_compliance(end.effects)
        for name in std:
            for shift in (SHORT_SHIFT, -SHORT_SHIFT):
                try:
                    there = distances({**p, name: p[name] + shift})
                except ValueError:  # The tool was there.
                    continue
                more = std_of_shared_errors(
                    (there - here) / shift, depths[self._train], priors
                )
                std[name] = float(np.hypot(std[name], more))
                break
        return std, or_more

    def _depths_per_compliance(self, effects: Sequence[Effect]):
        """(K, pairs) how distances change with what a contact gives per newton, and
        (pairs,) how well that is known [m/N]; 0 where its stiffness is fitted."""
        slots, _ = self._slots(self._placed)
        columns, priors = [], []
        for pair in self._pairs_met:
            on = self._told.get(pair, np.zeros(len(self.means.time), bool))
            pressed = self._pressed_now.get(pair, np.zeros(len(on)))
            columns.append(np.where(on, pressed, 0.0) / self.shape_std())
            mine = [s.stiffness for s in slots if self._pair_of(s) == pair]
            fitted = any(
                e.kind == STIFFNESS and self._at_pair(e, pair) for e in effects
            )
            priors.append(0.0 if fitted or not mine else max(COMPLIANCE, 1.0 / mine[0]))
        return np.stack(columns, axis=1), np.array(priors)

    def counts(self) -> np.ndarray:
        out = super().counts()
        n = out.shape[1] - len(self._pairs_met)
        for k, pair in enumerate(self._pairs_met):
            out[:, n + k] = self._told.get(pair, False)
        return out

    # ----- What may be slightly wrong, and candidates

    def lying(self) -> list[LiesOn]:
        touching = self._geometry(self._displacing(self.off)).slots
        return pressed_with_corners(self, touching)

    def hint(self, end: Fitted) -> str:
        """None: where what is fixed stands is felt, and is fitted."""
        return ""

    def _friction_now(self, pair) -> float:
        """Wherever its bodies are."""
        for s in self.slots:
            if self._pair_of(s) == pair:
                return s.friction
        for s in self._geometry(self._displacing(self.off)).slots:
            if self._pair_of(s) == pair:
                return s.friction
        return 0.0

    def candidates(self, nuisances: Nuisances, current: Fitted) -> list[Candidate]:
        """Softer contacts, and patches of friction, which explain much at some places,
        only where no place and no friction of a whole body explains more."""
        found, is_enough = self._whole_candidates(current)
        if not is_enough:
            for pair in self._pairs_met:
                found += self._patches(pair, current)
        return found

    def _whole_candidates(self, current: Fitted) -> tuple[list[Candidate], bool]:
        """Candidates but patches, and whether a place or the friction of a body takes
        off a tenth of what is left. Then a softer contact is none: it lets a tool stay
        deeper in a body, where forces may act that in truth do not."""
        found = self._plain_candidates(current.r, current.effects)
        n, train = self.nuisances(), self.train()
        screen = Screen(current.r, n.columns, n.prior, train)
        r = screen.fit_nuisances(current.r)[1][train]
        whole = [
            X[train] for c in found if c.kind in (*MOVES, "contact_friction")
            for X in c.columns
        ]  # fmt: skip
        is_enough = any(
            np.sum((r - X @ np.linalg.lstsq(X, r, rcond=None)[0]) ** 2)
            < WHOLE * np.sum(r**2)
            for X in whole
        )
        if is_enough:
            # Where the scene's contact is as soft, a stiffness is as likely as a place.
            soft = {self.pair_name(p) for p in self._met if set(p) & self.soft}
            found = [c for c in found if c.kind != STIFFNESS or set(c.at) & soft]
        return found, is_enough

    def _plain_candidates(self, r: np.ndarray, there: Sequence[Effect]):
        found = super()._plain_candidates(r, there)
        taken = {e.at[0] for e in there if e.kind in MOVES}
        # Trials of any other size than what is felt would tell nothing.
        found = [
            self._from_what_is_felt(c) if c.kind in MOVES else c for c in found
            if c.kind not in MOVES or c.at[0] not in taken
        ]  # fmt: skip
        return found + loads(
            self.dynamics, {(e.kind, at) for e in there for at in e.at}, r,
            partial(self._try, there), lambda kind: self.dynamics.links(),
        )  # fmt: skip

    def _from_what_is_felt(self, c: Candidate) -> Candidate:
        """A candidate of which a fit starts where the body is felt. What explains most
        along a line from the scene may be a part of that: there the tool is deep in the
        body, and a fit may stay where it starts."""
        (by,) = [
            self.off.get(k, {}) for k, name in self.shapes.names.items()
            if name == c.at[0]
        ]  # fmt: skip
        if c.kind == "plane_height":
            by = {"height": by["z"]} if "z" in by else {}

        def starting(read):
            def at_felt(x) -> dict[str, float]:
                return {n: by.get(n, value) for n, value in read(x).items()}

            return at_felt

        return replace(c, to_parameters=tuple(map(starting, c.to_parameters)))

    def _acts_at(self, kind: str, at: str) -> list[str]:
        """A height is that of what stands there, too."""
        if kind != "plane_height":
            return [at]
        (body,) = [k for k, name in self.shapes.names.items() if name == at]
        return [
            at,
            *(self.shapes.names[k] for k in sorted(self._carried.get(body, ()))),
        ]

    def _may_have_patch(self, pair, there: Sequence[Effect]) -> bool:
        """Of level ground, up to MOST_PATCHES."""
        at = self.pair_name(pair)
        if (
            sum(e.kind == "friction_patch" and at in e.at for e in there)
            >= MOST_PATCHES
        ):
            return False
        try:
            self.dynamics.now("friction_patch", [at])
        except ValueError:
            return False
        return True

    def _trials(self):
        for each in super()._trials():
            if each[0] not in ("plane_tilt", "plane_height"):
                yield each
        for pair in self._met:
            # How deep a point goes under a force that is known.
            at = self.pair_name(pair)
            try:
                now = self.dynamics.now("contact_stiffness", [at])["stiffness"]
            except ValueError:
                continue
            steps = [[((f - 1.0) * now, {"stiffness": f * now})] for f in SOFTER]
            yield "contact_stiffness", at, 1, ("stiffness",), (), steps
        for body, by in self._touched_axes().items():
            at, names = self.shapes.names[body], tuple(by)
            if names == ("z",):
                step = by["z"] or SMALL_SHIFT
                yield (
                    "plane_height", at, 1, ("height",), (), [[(step, {"height": step})]]
                )  # fmt: skip
                continue
            zero = dict.fromkeys(names, 0.0)
            trial = [
                (step, {**zero, a: step})
                for a, step in ((a, by[a] or SMALL_SHIFT) for a in names)
            ]
            yield "wall_position", at, len(names), names, (), [trial]

    def softer(self) -> list[tuple[Effect, tuple[str, ...]]]:
        found: list[tuple[Effect, tuple[str, ...]]] = []
        for pair in self._met:
            at = self.pair_name(pair)
            try:
                now = self.dynamics.now(STIFFNESS, [at])
            except ValueError:
                continue
            found.append((Effect(STIFFNESS, [at], now), MOVES))
        return found

    def pressed(self) -> list[str]:
        return [self.pair_name(pair) for pair in self._met]

    def _touched_axes(self) -> dict[int, dict[str, float]]:
        """{fixed body: {axis along which it is felt: how far it is off there [m]}}."""
        found: dict[int, dict[str, float]] = {}
        geometry = self._geometry(self._displacing(self.off))
        for s in geometry.slots:
            pair = self._pair_of(s)
            if pair not in self._met:
                continue
            on = geometry.masks[s.key]
            mean = np.abs(s.normal[on]).mean(axis=0)
            axis = AXES[int(np.argmax(mean))]
            for body in set(pair) & self.shapes.anchored:  # None of a robot's own.
                known = self.off.get(body, {}).get(axis, 0.0)
                found.setdefault(body, {})[axis] = known
        return {body: {a: by[a] for a in AXES if a in by} for body, by in found.items()}

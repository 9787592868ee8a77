"""Where what is fixed is felt: which faces are off, by how far, and what presses.

A face that may be off is felt there if forces without another cause are explained by
it, or if the scene's face was passed. What touches what, and how hard, follow.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.numerics.permitted_forces import explain
from makebreak.gap.residuals.contact_dynamics import SHAPED
from makebreak.gap.residuals.fixed_faces import (
    CLEAR,
    LEAST_FORCE,
    LEVEL,
    PASSED,
    REACH,
    SAME,
    UP,
    Face,
    FixedFaces,
)
from makebreak.gap.residuals.permitted_contacts import SLACK, Geometry, Shift
from makebreak.gap.simulation.contact_shapes import MEETS, Slot
from makebreak.models.effects.kind import Effect

STILL_DEEP = 0.1  # Of the nodes at which it was: knocks go deeper, too.
FELT = 4.0  # Mean square of what is left where a face is felt,
LESS = 0.5  # and what that face may leave of it.
FEWEST_SEEN = 3  # Test functions in which a face is pressed on.
MOVES = ("wall_position", "plane_height")
WHOLE = 0.9  # Of the squares left: one more place or friction must leave less.
MOST_SLOTS = 12  # Places of a fixed body at which its distances are kept.
# Of the squares that a pressing force would take off where the tool is at a face, so
# much at most is left where it is a little above that face [m].
GONE, ABOVE = 0.25, 0.05
# Times softer than the scene has it: a contact that lets a tool in so far is softer,
# and not elsewhere.
SOFT = 5.0
AXES = "xyz"


class FeltPlaces(FixedFaces):
    """The same with `off`, {body: {axis: by how far [m]}} of what is felt elsewhere,
    and `soft`, fixed bodies that let the tool in as far as it is in them."""

    # ----- Where it touches

    def _slots(self, effects: Sequence[Effect], shift: Shift | None = None):
        if any(e.kind == "plane_tilt" for e in effects):
            raise ValueError("plane_tilt: not of what a robot presses on")
        poses = dict(self._node_poses)
        by = {k: np.zeros(3) for k in poses if k in self.shapes.anchored}
        for e in effects:
            for k in by if e.kind in MOVES else ():
                if self._is_at(e, k):
                    by[k] = by[k] + [e.parameters.get(a, 0.0) for a in AXES]
                    by[k][2] += e.parameters.get("height", 0.0)
        for k, x in by.items():
            if x.any():
                R, p = poses[k]
                poses[k] = R, p + x
        found = self._slots_with(None, np.zeros(3), poses)
        for k, x in by.items():
            found = found + self._slots_with(k, x, poses)
        return sorted(found, key=lambda s: s.key), poses

    def _slots_with(self, body: int | None, by: np.ndarray, poses) -> list[Slot]:
        """Slots of a fixed body that is displaced by (3,) [m]; None: of what moves.
        They are kept: most of a fit's parameters displace nothing, and no other one
        displaces this body."""
        key = body, *by
        if key not in self._slots_at:
            if len(self._slots_at) >= MOST_SLOTS * (1 + len(self.shapes.anchored)):
                del self._slots_at[next(iter(self._slots_at))]

            def counts(a: int, b: int) -> bool:
                fixed = {a, b} & self.shapes.anchored
                return not fixed if body is None else body in fixed

            self._slots_at[key] = [
                _where_forces_act(s) for s in self.shapes.slots(poses, REACH, counts)
            ]
        return self._slots_at[key]

    def _touches(self, slots: Sequence[Slot]) -> list[np.ndarray]:
        """Of each slot (n_nodes,) whether it may act: points nearly as near as the
        nearest of two bodies that meet."""
        of: dict[tuple[int, int], list[int]] = {}
        for k, s in enumerate(slots):
            of.setdefault(self._pair_of(s), []).append(k)
        out = [np.zeros(0, bool)] * len(slots)
        for index in of.values():
            nearest = np.min([slots[k].phi for k in index], axis=0)
            for k in index:
                s = slots[k]
                out[k] = s.best & (s.phi < nearest + SLACK) & (nearest < MEETS)
        return out

    def _geometry(self, effects: Sequence[Effect]) -> Geometry:
        return self._contacts_at(effects, None)

    def _new_geometry(self, effects: Sequence[Effect], shift: Shift | None) -> Geometry:
        slots, poses = self._slots(effects, shift)
        masks = {
            s.key: on
            for s, on in zip(slots, self._touches(slots), strict=True)
            if on.any()
        }
        slots = [s for s in slots if s.key in masks]
        return Geometry(slots, masks, self._columns(slots, poses, masks))

    def _when(self, geometry: Geometry, s: Slot) -> np.ndarray:
        """(K,) over how much of a test function a slot may act."""
        return np.asarray(self._W @ geometry.masks[s.key].astype(float)).ravel()

    def _sharing(self, made, slots) -> np.ndarray:
        return np.zeros((len(self.means.time), 1, max(len(made), 1)))

    # ----- What is felt

    def _condition(self) -> None:
        """Encoders tell accelerations; contacts would tell no more."""
        m = self.means
        a, covariance = self._expected_acceleration(self._v[m.centre])
        m.acceleration, self._a_covariance = a, covariance

    def _prepare(self) -> None:
        self.off: dict[int, dict[str, float]] = {}
        self._prepare_contacts()
        self.soft = self._soft_bodies()
        while (off := self._felt_faces(self.off)) != self.off:
            # A face that is ruled out by what is felt makes no contact that comes or
            # goes: there are more test functions, and others may be felt in them.
            self.off = off
            self._rule_out_faces()
            self.means = self._all_means()
            self._find_contacts()
            self._prepare_contacts()
        self._pressed, self._met = self._pressing()
        self._pairs_met = sorted({*self._met, *map(self._pair_of, self.slots)})

    def _prepare_contacts(self) -> None:
        geometry = self._geometry(())
        self.slots = geometry.slots
        self._masks = [geometry.masks[s.key] for s in self.slots]
        super()._prepare()

    def _rule_out_faces(self) -> None:
        """Leaves of the faces those that may still be felt beside what is, and of the
        rows in touch (`_touching`) those in the scene, where bodies are felt, and at
        these faces."""
        number_of = {f: -1 - k for k, f in enumerate(self.faces)}
        self.faces = [
            f for f in self.faces
            if self._is_of(f, self.off) and not f.is_alone
            and AXES[f.axis] not in self.off.get(f.body, {})
        ]  # fmt: skip
        ruled_out = set(number_of.values()) - {number_of[f] for f in self.faces}
        self._touching = {
            key: on for key, on in self._touching.items() if key[0] not in ruled_out
        }
        free = min((k for key in self._touching for k in key), default=0) - 1
        where_felt = self._touching_where_felt()
        self._touching |= {(free, *pair): on for pair, on in where_felt.items()}

    def _displacing(self, off: dict[int, dict[str, float]]) -> list[Effect]:
        """Effects of bodies that are off, and of what stands on them."""
        of = {k: dict(by) for k, by in off.items()}
        for body, by in off.items():
            for k in self._carried.get(body, ()) if "z" in by else ():
                of.setdefault(k, {}).setdefault("z", by["z"])
        return [
            Effect("wall_position", [self.shapes.names[k]], by) for k, by in of.items()
        ]

    def touches_where_felt(self) -> np.ndarray:
        """(n_rows,) whether a face is touched that is felt elsewhere, where it is."""
        every = [np.zeros(len(self._q), bool), *self._touching_where_felt().values()]
        return np.any(every, axis=0)

    def _touching_where_felt(self) -> dict[tuple[int, int], np.ndarray]:
        """{pair: (n_rows,) whether it touches} of bodies that are felt elsewhere."""
        poses = self._poses_at(self._q)
        moved = set()
        for e in self._displacing(self.off):
            (k,) = [k for k, name in self.shapes.names.items() if name == e.at[0]]
            moved.add(k)
            R, p = poses[k]
            poses[k] = R, p + [e.parameters.get(a, 0.0) for a in AXES]
        found: dict[tuple[int, int], np.ndarray] = {}
        for s in self.shapes.slots(poses, MEETS):
            if moved & {s.a, s.b}:
                pair = self._pair_of(s)
                now = found.get(pair, np.zeros(len(self._q), bool))
                found[pair] = now | (s.phi < MEETS)
        return found

    def _soft_bodies(self) -> set[int]:
        """Fixed bodies in which the tool is about as deep as the scene's contact lets
        it in under the forces that press there: no face of them need be elsewhere."""
        slots, _ = self._slots(())
        pressed, met = self._pressing()
        by_depth: dict[int, float] = {}
        by_force: dict[int, float] = {}
        for pair, on in met.items():
            mine = [s for s in slots if self._pair_of(s) == pair]
            depth = self._W @ np.maximum(-np.min([s.phi for s in mine], axis=0), 0.0)
            force = mine[0].stiffness * float(depth[on].sum())
            for body in set(pair) & self.shapes.anchored:  # None of a robot's own.
                by_depth[body] = by_depth.get(body, 0.0) + force
                felt = float(pressed[pair][on].sum())
                by_force[body] = by_force.get(body, 0.0) + felt
        return {k for k, force in by_depth.items() if force < SOFT * by_force[k]}

    def _felt_faces(
        self, off: dict[int, dict[str, float]]
    ) -> dict[int, dict[str, float]]:
        """{body: {axis: by how far [m]}} of faces that are off and felt, or passed,
        beside those that are known."""
        left = [
            f for f in self.faces
            if abs(f.off) > SAME and not (f.off < 0.0 and f.body in self.soft)
        ]  # fmt: skip
        left.sort(key=lambda f: -abs(f.normal @ UP))  # What others stand on first.
        return self._completed(off, left)

    def _completed(
        self,
        off: dict[int, dict[str, float]],
        left: Sequence[Face],
        looks_ahead: bool = True,
    ) -> dict[int, dict[str, float]]:
        """`off` with those of the faces left that are passed, or felt beside others.

        Args: looks_ahead: whether each way in which a body may have been passed is
            judged with all that is felt then: forces of a body that is still to be
            displaced would be put down to the wrong way.
        """
        while left:
            body, ways, rest = self._ways_passed(left, off)
            if ways:
                deep = self._deep_nodes(off)[body]
                if looks_ahead and self._may_be_lifted(body, left, off):
                    ways = [*ways, []]  # Then it was not passed.

                def quality(way: list[Face], off=off, rest=rest, body=body, deep=deep):
                    trial = self._with(off, way)
                    if looks_ahead:
                        trial = self._completed(trial, rest, looks_ahead=False)
                    still = self._deep_nodes(trial).get(body, 0) > STILL_DEEP * deep
                    places = sum(map(len, trial.values()))
                    return still, self._mean_squares(
                        self._displacing(trial)
                    ).sum() / WHOLE**places

                best = min(ways, key=quality) if len(ways) > 1 else ways[0]
                off, left = self._with(off, best), rest
                continue
            face = self._best_felt([f for f in left if not f.is_alone], off)
            if face is None:
                break
            off, left = self._with(off, [face]), [f for f in left if f is not face]
        return off

    def _ways_passed(
        self, left: Sequence[Face], off: dict[int, dict[str, float]]
    ) -> tuple[int, list[list[Face]], list[Face]]:
        """The first body that the tool is deep in; the faces of it that may have been
        passed: all that are nearest to the tool's points, one of these, or one alone;
        and the faces left beside those. No way where it is in no body."""
        passed = [f for f in left if f.off < -PASSED and self._is_of(f, off)]
        deep = self._deep_nodes(off) if passed else {}
        body = next((f.body for f in passed if f.body in deep), -1)
        mine = [f for f in passed if f.body == body]
        near = [f for f in mine if not f.is_alone]
        ways = [near] * (len(near) > 1) + [[f] for f in mine]
        return body, ways, [f for f in left if f not in mine]

    def _may_be_lifted(
        self, body: int, left: Sequence[Face], off: dict[int, dict[str, float]]
    ) -> bool:
        """Whether what a body stands on may be higher or lower, and is not yet."""
        return any(
            body in self._carried.get(f.body, ()) and "z" not in off.get(f.body, {})
            for f in left if f.normal @ UP > LEVEL
        )  # fmt: skip

    def _deep_nodes(self, off: dict[int, dict[str, float]]) -> dict[int, int]:
        """{fixed body: at how many nodes the tool is deeper in it than any contact
        lets it in}, with bodies displaced."""
        inside = self._inside(self._displacing(off))
        deep = {k: int((d < -PASSED).sum()) for k, d in inside.items()}
        return {k: n for k, n in deep.items() if n}

    def _is_of(self, face: Face, off: dict[int, dict[str, float]]) -> bool:
        """Whether a face was found at the height that its body has with others off."""
        lift = [
            by["z"] for k, by in off.items()
            if "z" in by and face.body in self._carried.get(k, ())
        ]  # fmt: skip
        return abs(face.lift - sum(lift[:1])) < SAME

    def _best_felt(
        self, left: Sequence[Face], off: dict[int, dict[str, float]]
    ) -> Face | None:
        """The face that explains most, of those that are felt."""
        before = self._mean_squares(self._displacing(off))
        best, gain = None, 0.0
        for face in left:
            if not self._is_of(face, off):
                continue
            trial = self._with(off, [face])
            geometry = self._geometry(self._displacing(trial))
            on = np.zeros(len(before), bool)
            for s in geometry.slots:
                if face.body in (s.a, s.b):
                    on |= self._when(geometry, s) > 0.999
            if on.sum() < FEWEST_SEEN:
                continue
            after = self._mean_squares(self._displacing(trial))
            is_felt = before[on].mean() >= FELT
            if not (is_felt and after[on].mean() <= LESS * before[on].mean()):
                continue
            if not self.sensors and not self._begins_at(face, trial):
                continue
            taken = float(before.sum() - after.sum())
            if taken > gain:
                best, gain = face, taken
        return best

    def _begins_at(self, face: Face, off: dict[int, dict[str, float]]) -> bool:
        """Without a wrench: whether drives give a force along the face's normal where
        the tool is at the face, with bodies displaced, and none where it is a little
        above. A load or a friction that the scene lacks would be there, too."""
        n = len(self._rows)
        apart, lever = np.full(n, np.inf), np.zeros((n, self._all_needs(()).shape[1]))
        for s in self._slots(self._displacing(off))[0]:
            if face.body not in (s.a, s.b):
                continue
            sign = -1.0 if s.a == face.body else 1.0
            nearer = (s.phi < apart) & (sign * (s.normal @ face.normal) > LEVEL)
            apart[nearer] = s.phi[nearer]
            lever[nearer] = self._felt(s, self._relative(s), s.normal)[nearer]
        pull = np.einsum("kij,kj->ki", self.root, self._W @ lever)
        needs = np.einsum("kij,kj->ki", self.root, self._all_needs(()))
        along = np.maximum(np.sum(pull * needs, axis=1), 0.0)
        taken = along**2 / np.maximum(np.sum(pull**2, axis=1), 1e-300)

        at = self._wholly(apart < MEETS)
        above = self._wholly((apart > PASSED) & (apart < ABOVE))
        if min(at.sum(), above.sum()) < FEWEST_SEEN:
            return False
        return bool(np.median(taken[above]) < GONE * np.median(taken[at]))

    def _with(
        self, off: dict[int, dict[str, float]], faces: Iterable[Face]
    ) -> dict[int, dict[str, float]]:
        """`off` with some faces more."""
        more = {k: dict(by) for k, by in off.items()}
        for face in faces:
            self._add(more, face)
        return more

    def _add(self, off: dict[int, dict[str, float]], face: Face) -> None:
        by = off.setdefault(face.body, {})
        by[AXES[face.axis]] = face.off / float(face.normal[face.axis])

    def _pressing(self, effects: Sequence[Effect] = ()):
        """Where bodies may really be: {pair: (K,) the sum of its normal forces over how
        many points share it}, {pair: (K,) when it presses}. effects: those of the model
        but places and stiffnesses: with a friction that is wrong, or a load that is
        lacking, other forces press."""
        there = self._displacing(self.off)
        needs = self._all_needs(effects)
        shaped = [e for e in effects if e.kind in SHAPED]
        G, can, of, geometry, sharing = self._generators([*shaped, *there])
        slots = geometry.slots
        weights = np.zeros(can.shape)
        explain(
            needs, G, can, self.root, sharing, np.zeros_like(needs), weights,
            np.zeros(len(needs), np.int64),
        )  # fmt: skip
        K = len(needs)
        total: dict[tuple[int, int], np.ndarray] = {}
        points: dict[tuple[int, int], np.ndarray] = {}
        whole: dict[tuple[int, int], np.ndarray] = {}
        for s in slots:
            pair, n = self._pair_of(s), self._when(geometry, s)
            points[pair] = points.get(pair, np.zeros(K)) + n
            whole[pair] = whole.get(pair, np.zeros(K, bool)) | (n > 0.999)
            total.setdefault(pair, np.zeros(K))
        for column, number in enumerate(of):
            total[self._pair_of(slots[number])] += weights[:, column]
        clear = self._clear_force()
        met = {pair: on & (total[pair] > clear) for pair, on in whole.items()}
        each = {pair: total[pair] / np.maximum(points[pair], 1.0) for pair in total}
        return each, {pair: on for pair, on in met.items() if on.any()}

    def _clear_force(self) -> float:
        """A pressing force of less may be nothing [N]."""
        var = [np.median(self.means.wrench_var[:, s.forces]) for s in self.sensors]
        return max([LEAST_FORCE, *(CLEAR * float(np.sqrt(x)) for x in var)])

    def _wholly(self, on: np.ndarray) -> np.ndarray:
        """(K,) test functions all of whose nodes are among (n_nodes,) these."""
        return np.asarray(self._W @ on.astype(float)).ravel() > 0.999

    def _mean_squares(self, displaced: Sequence[Effect]) -> np.ndarray:
        """(K,) of what equations and wrenches leave with bodies displaced."""
        needs = self._all_needs(())
        G, there, _, _, sharing = self._generators(displaced)
        left = np.zeros_like(needs)
        explain(
            needs, G, there, self.root, sharing, left,
            np.zeros((len(left), there.shape[1])), np.zeros(len(left), np.int64),
        )  # fmt: skip
        return np.mean(left**2, axis=1)

    def _inside(self, placed: Sequence[Effect]) -> dict[int, np.ndarray]:
        """{fixed body: (n_nodes,) distance of the tool from it}, where it is near."""
        found: dict[int, np.ndarray] = {}
        for s in self._slots(placed)[0]:
            for k in {s.a, s.b} & self.shapes.anchored:
                found[k] = np.minimum(found.get(k, s.phi), s.phi)
        return found


def _where_forces_act(s: Slot) -> Slot:
    """A slot with its place between the two shapes, where one is inside the other: of
    a soft contact that is not the deepest point, and friction has another lever."""
    inside = np.maximum(-s.phi, 0.0)[:, None]
    return replace(s, place=s.place + s.gives * inside * s.normal)

"""A robot whose tool touches, slides along and presses on what is fixed.

The equations of motion with permitted contact forces (contact_dynamics.py), for scenes
in which joints are all that moves. What is fixed may stand elsewhere than the scene has
it: a face that is touched is never passed, so how near the tool came to it is how far
it is off, if forces without another cause are felt there, or if the scene's face was
passed. What touches what, and its distance, follow from that.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from pydrake.multibody.tree import BodyIndex

from makebreak.gap.data.pieces import excerpt
from makebreak.gap.data.recording import Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.permitted_forces import explain
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Candidate, Fitted, Nuisances
from makebreak.gap.residuals.contact_dynamics import SHAPED, THIN
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.impacts import MOST_SHARE, nearest, positions, walls_of
from makebreak.gap.residuals.lying_on_faces import pressed_with_corners
from makebreak.gap.residuals.mechanism_candidates import loads
from makebreak.gap.residuals.permitted_contacts import SLACK, Geometry, Shift
from makebreak.gap.residuals.touching import MEETS
from makebreak.gap.residuals.wrench_sensor import FORCE
from makebreak.gap.simulation.contact_shapes import Slot
from makebreak.gap.simulation.face_supports import LiesOn
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.contact import STIFFNESS
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import Scene

REACH = 0.12  # What is fixed is no farther off than this [m].
KNOCKED = 8e-3  # A knock goes no deeper than this [m].
FEWEST_ROWS = 5  # In which a face is pressed on,
FEWEST_SEEN = 3  # and test functions.
SAME = 5e-4  # A face that is off by less is where the scene has it [m].
PASSED = 4e-3  # No contact lets a tool so far in [m].
STILL_DEEP = 0.1  # Of the nodes at which it was: knocks go deeper, too.
FELT, LESS = 4.0, 0.5  # Mean square of what is left where a face is felt; with it.
CLEAR, LEAST_FORCE, FELT_SHARE = 6.0, 0.5, 0.03  # Times noise, [N], of the rows.
MOVES = ("wall_position", "plane_height")
WHOLE = 0.9  # Of the squares left: one more place or friction must leave less.
# Times the stiffness of the scene: trials. Drake's default is a hundred times that of
# a rubber tip.
SOFTER = (0.03, 0.1, 0.3, 0.6, 2.0)
LOUD = 1.5  # Times its noise: a channel for which the search goes on.
SQUEEZED = 10.0  # Times what a row needs: forces that act in it, at most.
MOST_FRICTION = 2.0  # Of what is taken for any.
MOST_PATCHES, MOST_EFFECTS = 3, 10
MOST_SLOTS = 12  # Places of a fixed body at which its distances are kept.
SMALL_SHIFT = 1e-3  # First trial of a place [m].
# A touch that lasts so long is no impact [s]. Of the squares that a pressing force
# would take off where the tool is at a face, so much at most is left where it is a
# little above that face [m]. Of longer recordings pieces are asked [s].
LASTS_SEC, GONE, ABOVE, ASKED_SEC, ASKED_ROWS = 0.3, 0.25, 0.05, 60.0, 120_000
AXES, UP = "xyz", np.array([0.0, 0.0, 1.0])
STANDS, LEVEL = 1e-3, 0.9  # It stands on what is so near below it [m]; cosine.


@dataclass(frozen=True, eq=False)
class _Face:
    """A face of a fixed body: its normal (3,) and by how far along it the body may be
    off [m]; below zero: by so much the tool went through it as the scene has it. lift:
    how much higher the body is with what it stands on [m]. is_alone: whether no other
    face of the body was passed; else each point went through the nearest one."""

    body: int
    normal: np.ndarray
    off: float
    lift: float = 0.0
    is_alone: bool = False

    @property
    def by(self) -> np.ndarray:
        """(3,) by which the body is displaced [m]."""
        return self.off * self.normal + self.lift * UP


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
        apart = nearest(shapes, dynamics, q[::step])
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
        return bool(PressingProblem(dynamics.loaded.scene, some).off)
    except DoesNotFit:
        return False


def _rows_of_lasting(touching: np.ndarray, time: np.ndarray) -> int:
    """How many rows (n,) are in touches that last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], touching, [0]]).astype(int)))
    return sum(
        int(b - a) for a, b in zip(edges[::2], edges[1::2], strict=True)
        if time[b - 1] - time[a] > LASTS_SEC
    )  # fmt: skip


class PressingProblem(ContactProblem):
    """Raises: DoesNotFit where anything but joints moves, or as ContactDynamics."""

    moves = MOVES
    # A wall that was met for a moment shows in its own distance alone, and how soft it
    # is in a small part of that.
    plan = replace(
        ContactProblem.plan, by_channel=True, most_effects=MOST_EFFECTS, loud=LOUD
    )

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        self._any_friction = False
        self._mu: float | None = None
        # How often rows were weighed; what last pressed, and for which effects.
        self._weighed = 0
        self._pressed_at: tuple[tuple | None, dict] = (None, {})
        self._not_passed: tuple = ()  # Places with which the tool went through nothing.
        super().__init__(scene, recordings)

    # ----- What may touch

    def _read_coordinates(self) -> None:
        super()._read_coordinates()
        if self.bodies:
            raise DoesNotFit("something moves freely")

    def _evaluate_nodes(self) -> None:
        self._slots_at: dict[tuple, list[Slot]] = {}  # See _slots_with.
        super()._evaluate_nodes()

    def pair_name(self, pair: tuple[int, int]) -> str:
        """What is fixed first: its surface is the one that an effect changes."""
        a, b = sorted(pair, key=lambda k: k not in self.shapes.anchored)
        return f"{self.shapes.names[a]}~{self.shapes.names[b]}"

    def _lies(self, pair: tuple[int, int]) -> bool:
        """Nothing lies there by its own weight."""
        return False

    def _touching_rows(self):
        """As the scene has it, and as it might be: no contact may come or go within a
        test function."""
        poses = self._poses_at(self._q)
        self._carried = self._find_carried(poses)
        self._sink_what_stands(poses)
        self.faces = self._possible_faces(poses)
        found = super()._touching_rows()
        for number, face in enumerate(self.faces):
            R, p = poses[face.body]
            moved = poses | {face.body: (R, p + face.by)}
            for s in self.shapes.slots(moved, MEETS):
                if face.body in (s.a, s.b):
                    key = (-1 - number, s.a if s.b == face.body else s.b)
                    now = found.get(key, np.zeros(len(self._q), bool))
                    found[key] = now | (s.phi < MEETS)
        for k, on in enumerate(self._felt_along(poses)):
            found[-1 - len(self.faces) - k, -1] = on
        return found

    def _felt_along(self, poses) -> list[np.ndarray]:
        """(n_rows,) whether a sensor is pressed away from a face that is near, of each
        direction of such faces. In a hole all walls are near all the time: that one of
        them is met, or left, is told by the force alone."""
        near: dict[tuple[float, ...], np.ndarray] = {}
        for s in self.shapes.slots(poses, MEETS):
            if not {s.a, s.b} & self.shapes.anchored:
                continue
            sign = -1.0 if s.a in self.shapes.anchored else 1.0
            rows = s.phi < MEETS
            normals = np.round(sign * s.normal[rows], 1) + 0.0
            for normal in np.unique(normals, axis=0):
                on = np.zeros(len(rows), bool)
                on[rows] = (normals == normal).all(axis=1)
                key = tuple(map(float, normal))
                near[key] = near.get(key, np.zeros(len(rows), bool)) | on
        opposite = [n for n in near if tuple(-x + 0.0 for x in n) in near]
        found = []
        for sensor in self.sensors:
            noise = max(r.channels[n].noise for r in self.recordings
                        for n in sensor.names[: len(FORCE)])  # fmt: skip
            least = max(CLEAR * noise, LEAST_FORCE)
            for normal in opposite:
                f = self._force_along(sensor.place, np.array(normal))
                found.append(near[normal] & (f > least))
        return found

    def _find_carried(self, poses) -> dict[int, set[int]]:
        """{fixed body: those that stand on it, or on one that does, in the scene}."""
        robots = {
            self.plant.get_body(BodyIndex(k)).model_instance()
            for k in self.shapes.bodies() if k not in self.shapes.anchored
        }  # fmt: skip
        fixed = {
            k: (poses[k][0][:1], poses[k][1][:1]) for k in self.shapes.anchored
            if k in poses
            and self.plant.get_body(BodyIndex(k)).model_instance() not in robots
        }  # fmt: skip
        on: dict[int, set[int]] = {k: set() for k in fixed}
        for point in self.shapes.points:
            for s in self.shapes.surfaces:
                if point.body == s.body or not {point.body, s.body} <= set(fixed):
                    continue
                _, d, normal, _ = point.near(s, *fixed[point.body], *fixed[s.body])
                if abs(d[0]) < STANDS and normal[0] @ UP > LEVEL:
                    on[s.body].add(point.body)
                elif abs(d[0]) < STANDS and normal[0] @ UP < -LEVEL:
                    on[point.body].add(s.body)
        for _ in on:  # What stands on what stands on it.
            for k, mine in on.items():
                on[k] = mine.union(*(on[each] for each in mine)) - {k}
        return on

    def _sink_what_stands(self, poses) -> None:
        """A box whose whole bottom is on another box, or a half-space, goes on into
        that. Its lower edge would push down a tool that is a little too deep in what it
        stands on, and a place that is wrong by so much would explain forces by that."""
        stands = {k for own in self._carried.values() for k in own}
        for number, s in enumerate(self.shapes.surfaces):
            if s.kind != "box" or s.body not in stands:
                continue
            R_b, p_b = poses[s.body][0][0], poses[s.body][1][0]
            R = R_b @ s.R_BG
            axis = int(np.argmax(np.abs(R[2])))
            down = -np.sign(R[2, axis])
            (half,) = s.size
            corners = np.array(list(product((-1.0, 1.0), repeat=3))) * half
            bottom = corners[corners[:, axis] * down > 0.0]
            places = p_b + (s.p_BG + bottom @ s.R_BG.T) @ R_b.T
            below = self._thickness_below(places, s.body, poses)
            if abs(R[2, axis]) > LEVEL and below:
                longer = np.eye(3)[axis] * 0.5 * below
                self.shapes.surfaces[number] = replace(
                    s, size=(half + longer,), p_BG=s.p_BG + s.R_BG @ (down * longer)
                )

    def _thickness_below(self, places, body: int, poses) -> float:
        """How thick the box or half-space is on which all places (n, 3) of a body are,
        REACH at most [m]; 0 where they are on none."""
        for s in self.shapes.surfaces:
            is_flat = s.kind in ("box", "half_space")
            if not is_flat or body not in self._carried.get(s.body, ()):
                continue
            R, p = poses[s.body][0][0], poses[s.body][1][0]
            d, _ = s.distance((places - p) @ R)
            if (np.abs(d) < STANDS).all():
                if s.kind == "half_space":
                    return REACH
                thick = 2.0 * np.abs((R @ s.R_BG)[2]) @ s.size[0]
                return min(float(thick), REACH)
        return 0.0

    def _possible_faces(self, poses) -> list[_Face]:
        """Faces of fixed boxes over which the tool came, with how near it kept to them:
        so far they may be off, if it pressed on them there. Of what stands on another
        body also those that it has where that body may be."""
        found = self._faces_at(poses, self.shapes.anchored)
        for below in list(found):
            carried = self._carried.get(below.body, set())
            if not carried or below.normal @ UP < LEVEL or abs(below.off) < SAME:
                continue
            by = {k: (poses[k][0], poses[k][1] + below.off * UP) for k in carried}
            faces = self._faces_at(poses | by, carried)
            found += [
                replace(f, lift=below.off) for f in faces
                if abs(f.normal @ UP) < LEVEL
            ]  # fmt: skip
        return found

    def _faces_at(self, poses, bodies: Collection[int]) -> list[_Face]:
        """Those of some bodies."""
        moving = [p for p in self.shapes.points
                  if p.body not in self.shapes.anchored and not p.rim]  # fmt: skip
        found = []
        for s in self.shapes.surfaces:
            if s.body not in bodies or s.kind != "box":
                continue
            R_b, p_b = poses[s.body][0][0], poses[s.body][1][0]
            R, centre = R_b @ s.R_BG, p_b + R_b @ s.p_BG
            (half,) = s.size
            # From each face with its normals -x, x, ...: where a point inside went
            # through the nearest face, and where all of them went through one.
            nearest, alone = np.full((2, 6, len(self._q)), np.inf)
            deepest = np.full(len(self._q), np.inf)
            for point in moving:
                if self.shapes.never_touch(point, s):
                    continue
                R_a, p_a = poses[point.body]
                local = (p_a + R_a @ point.p_B - centre) @ R
                out = np.abs(local) - half
                deepest = np.minimum(deepest, out.max(axis=1) - point.radius)
                for axis in range(3):
                    others = np.delete(out, axis, axis=1).max(axis=1)
                    for k, sign in ((2 * axis, -1.0), (2 * axis + 1, 1.0)):
                        x = sign * local[:, axis]
                        d = x - half[axis] - point.radius
                        over = others < 0.0
                        alone[k] = np.minimum(alone[k], np.where(over, d, np.inf))
                        over &= (x >= 0.0) & (out[:, axis] > others)
                        nearest[k] = np.minimum(nearest[k], np.where(over, d, np.inf))
            is_deep = np.sum(deepest < -PASSED) >= FEWEST_ROWS
            for k in range(6):
                normal = (-1.0, 1.0)[k % 2] * R[:, k // 2]
                off = self._kept_distance(nearest[k], normal)
                if abs(off) < REACH:
                    found.append(_Face(s.body, normal, off))
                if not is_deep:
                    continue
                more = self._kept_distance(alone[k], normal)
                if -REACH < more < min(-PASSED, off - SAME):
                    found.append(_Face(s.body, normal, more, is_alone=True))
        return found

    def _kept_distance(self, d: np.ndarray, normal: np.ndarray) -> float:
        """Of distances (n_rows,) from a face the one that was kept longest where the
        tool came nearest to it and, with a wrench, felt it; inf: none. A hard knock
        goes deeper for a moment."""
        near = d < REACH
        for sensor in self.sensors:
            near &= self._force_along(sensor.place, normal) > LEAST_FORCE
        if near.sum() < FEWEST_ROWS:
            return np.inf
        values = np.sort(d[near & (d < d[near].min() + KNOCKED)])
        count = np.searchsorted(values, values + SAME) - np.arange(len(values))
        first = int(np.argmax(count))
        return float(np.median(values[first : first + count[first]]))

    def _force_along(self, place: str, normal: np.ndarray) -> np.ndarray:
        """(n_rows,) of a measured force, lines over what is missing [N]."""
        out = []
        for t in self.tracks:
            recording, rows = self.recordings[t.recording], t.episode.rows
            total = np.zeros(len(t.time))
            for n, a in zip(normal, FORCE, strict=True):
                y = recording[f"{place}.{a}"][rows]
                good = np.isfinite(y)
                if good.any():
                    total += n * np.interp(t.time, t.time[good], y[good])
            out.append(total)
        return np.concatenate(out)

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

            self._slots_at[key] = self.shapes.slots(poses, REACH, counts)
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
        geometry = self._geometry(())
        self.slots = geometry.slots
        self._masks = [geometry.masks[s.key] for s in self.slots]
        super()._prepare()
        self.off = self._felt_faces()
        self._pressed, self._met = self._pressing()
        self._pairs_met = sorted({*self._met, *map(self._pair_of, self.slots)})

    def _displacing(self, off: dict[int, dict[str, float]]) -> list[Effect]:
        """Effects of bodies that are off, and of what stands on them."""
        of = {k: dict(by) for k, by in off.items()}
        for body, by in off.items():
            for k in self._carried.get(body, ()) if "z" in by else ():
                of.setdefault(k, {}).setdefault("z", by["z"])
        return [
            Effect("wall_position", [self.shapes.names[k]], by) for k, by in of.items()
        ]

    def _felt_faces(self) -> dict[int, dict[str, float]]:
        """{body: {axis: by how far [m]}} of faces that are off and felt, or passed."""
        left = [f for f in self.faces if abs(f.off) > SAME]
        left.sort(key=lambda f: -abs(f.normal @ UP))  # What others stand on first.
        return self._completed({}, left)

    def _completed(
        self,
        off: dict[int, dict[str, float]],
        left: Sequence[_Face],
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

                def quality(way: list[_Face], off=off, rest=rest, body=body, deep=deep):
                    trial = self._with(off, way)
                    if looks_ahead:
                        trial = self._completed(trial, rest, looks_ahead=False)
                    still = self._deep_nodes(trial).get(body, 0) > STILL_DEEP * deep
                    places = sum(map(len, trial.values()))
                    return still, self._mean_squares(trial).sum() / WHOLE**places

                best = min(ways, key=quality) if len(ways) > 1 else ways[0]
                off, left = self._with(off, best), rest
                continue
            face = self._best_felt([f for f in left if not f.is_alone], off)
            if face is None:
                break
            off, left = self._with(off, [face]), [f for f in left if f is not face]
        return off

    def _ways_passed(
        self, left: Sequence[_Face], off: dict[int, dict[str, float]]
    ) -> tuple[int, list[list[_Face]], list[_Face]]:
        """The first body that the tool is deep in; the faces of it that may have been
        passed: all that are nearest to the tool's points, or one alone; and the faces
        left beside those. No way where it is in no body."""
        passed = [f for f in left if f.off < -PASSED and self._is_of(f, off)]
        deep = self._deep_nodes(off) if passed else {}
        body = next((f.body for f in passed if f.body in deep), -1)
        mine = [f for f in passed if f.body == body]
        near = [f for f in mine if not f.is_alone]
        ways = [near] * bool(near) + [[f] for f in mine if f.is_alone]
        return body, ways, [f for f in left if f not in mine]

    def _may_be_lifted(
        self, body: int, left: Sequence[_Face], off: dict[int, dict[str, float]]
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

    def _is_of(self, face: _Face, off: dict[int, dict[str, float]]) -> bool:
        """Whether a face was found at the height that its body has with others off."""
        lift = [
            by["z"] for k, by in off.items()
            if "z" in by and face.body in self._carried.get(k, ())
        ]  # fmt: skip
        return abs(face.lift - sum(lift[:1])) < SAME

    def _best_felt(
        self, left: Sequence[_Face], off: dict[int, dict[str, float]]
    ) -> _Face | None:
        """The face that explains most, of those that are felt."""
        before = self._mean_squares(off)
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
            after = self._mean_squares(trial)
            is_felt = before[on].mean() >= FELT
            if not (is_felt and after[on].mean() <= LESS * before[on].mean()):
                continue
            if not self.sensors and not self._begins_at(face, trial):
                continue
            taken = float(before.sum() - after.sum())
            if taken > gain:
                best, gain = face, taken
        return best

    def _begins_at(self, face: _Face, off: dict[int, dict[str, float]]) -> bool:
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

        def whole(rows) -> np.ndarray:
            return np.asarray(self._W @ rows.astype(float)).ravel() > 0.999

        at, above = whole(apart < MEETS), whole((apart > PASSED) & (apart < ABOVE))
        if min(at.sum(), above.sum()) < FEWEST_SEEN:
            return False
        return bool(np.median(taken[above]) < GONE * np.median(taken[at]))

    def _with(
        self, off: dict[int, dict[str, float]], faces: Iterable[_Face]
    ) -> dict[int, dict[str, float]]:
        """`off` with some faces more."""
        more = {k: dict(by) for k, by in off.items()}
        for face in faces:
            self._add(more, face)
        return more

    def _add(self, off: dict[int, dict[str, float]], face: _Face) -> None:
        axis = int(np.argmax(np.abs(face.normal)))
        by = off.setdefault(face.body, {})
        by[AXES[axis]] = face.off / float(face.normal[axis])

    def _mean_squares(self, off) -> np.ndarray:
        """(K,) of what equations and wrenches leave with bodies displaced."""
        needs = self._all_needs(())
        G, there, _, _, sharing = self._generators(self._displacing(off))
        left = np.zeros_like(needs)
        explain(
            needs, G, there, self.root, sharing, left,
            np.zeros((len(left), there.shape[1])), np.zeros(len(left), np.int64),
        )  # fmt: skip
        return np.mean(left**2, axis=1)

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
            more = (depth < -KNOCKED) & ~(before.get(body, depth + 1.0) < -KNOCKED)
            if more.sum() >= FEWEST_ROWS:
                name = self.shapes.names[body]
                raise ValueError(
                    f"{placed[0].kind}: the tool was where {name} would be"
                )
        self._not_passed = key

    def _inside(self, placed: Sequence[Effect]) -> dict[int, np.ndarray]:
        """{fixed body: (n_nodes,) distance of the tool from it}, where it is near."""
        found: dict[int, np.ndarray] = {}
        for s in self._slots(placed)[0]:
            for k in {s.a, s.b} & self.shapes.anchored:
                found[k] = np.minimum(found.get(k, s.phi), s.phi)
        return found

    def _pressed_with(self, effects: Sequence[Effect]) -> dict:
        """{pair: (K,)} as _pressing() has it; the last one is kept."""
        others = [e for e in effects if e.kind not in (*MOVES, STIFFNESS)]
        if self._any_friction or not others or not hasattr(self, "_met"):
            return self._pressed
        key = tuple((e.kind, *e.at, *sorted(e.parameters.items())) for e in others)
        if self._pressed_at[0] != (key, self._weighed):
            self._pressed_at = (key, self._weighed), self._pressing(others)[0]
        return self._pressed_at[1]

    def _distances(self, geometry: Geometry) -> np.ndarray:
        """(K, pairs) over what shapes are known to: of each pair, when it is felt."""
        shape = self.shape_std()
        K = len(self.means.time)
        thinned = np.arange(K) % THIN == 0
        every, _ = self._slots(self._placed)
        columns = []
        for pair in self._pairs_met:
            mine = [s for s in every if self._pair_of(s) == pair]
            on = self._met.get(pair, np.zeros(K, bool)) & thinned
            if not mine or not on.any():
                columns.append(np.zeros(K))
                continue
            nearest = np.min([s.phi for s in mine], axis=0)
            stiffness = mine[0].stiffness
            pressed = self._pressed_now.get(pair, np.zeros(K))
            for e in self._softened:
                if self._at_pair(e, pair):
                    stiffness = e.parameters["stiffness"]
                    if not stiffness * PASSED > pressed[on].max():
                        # Softer, and with one parameter it would explain a wall that
                        # stands elsewhere.
                        raise ValueError("contact_stiffness: a tool goes in too far")
            depth = pressed / stiffness
            d = self._W @ nearest + depth
            columns.append(np.where(on, d / shape, 0.0))
        return -np.stack(columns, axis=1) if columns else np.zeros((K, 0))

    def counts(self) -> np.ndarray:
        out = super().counts()
        n = out.shape[1] - len(self._pairs_met)
        for k, pair in enumerate(self._pairs_met):
            on = self._met.get(pair)
            out[:, n + k] = (
                False if on is None else on & (np.arange(len(on)) % THIN == 0)
            )
        return out

    # ----- What may be slightly wrong, and candidates

    def lying(self) -> list[LiesOn]:
        touching = self._geometry(self._displacing(self.off)).slots
        return pressed_with_corners(self, touching)

    def hint(self, end: Fitted) -> str:
        """None: where what is fixed stands is felt, and is not widened beside that."""
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

    def next_candidates(self, current: Fitted) -> list[Candidate]:
        return self._whole_candidates(current)[0]

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
            found = [c for c in found if c.kind != "contact_stiffness"]
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

    def _touched_axes(self) -> dict[int, dict[str, float]]:
        """{fixed body: {axis along which it is felt: how far it is off there [m]}}."""
        found: dict[int, dict[str, float]] = {}
        geometry = self._geometry(self._displacing(self.off))
        for s in geometry.slots:
            pair = self._pair_of(s)
            if pair not in self._met:
                continue
            (body,) = set(pair) & self.shapes.anchored
            on = geometry.masks[s.key]
            mean = np.abs(s.normal[on]).mean(axis=0)
            axis = AXES[int(np.argmax(mean))]
            known = self.off.get(body, {}).get(axis, 0.0)
            found.setdefault(body, {})[axis] = known
        return {body: {a: by[a] for a in AXES if a in by} for body, by in found.items()}

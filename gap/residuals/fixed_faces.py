"""Faces of fixed bodies that may stand elsewhere than the scene has them.

A face that is touched is never passed, so how near a tool came to it, while something
pressed it back, is how far it is off. What stands on another body moves with that.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from pydrake.multibody.tree import BodyIndex

from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.touching import MEETS
from makebreak.gap.residuals.wrench_sensor import FORCE
from makebreak.gap.simulation.contact_shapes import Slot
from makebreak.gap.simulation.free_body import gone_on

REACH = 0.12  # What is fixed is no farther off than this [m].
KNOCKED = 8e-3  # A knock goes no deeper than this [m].
FEWEST_ROWS = 5  # In which a face is pressed on.
SAME = 5e-4  # A face that is off by less is where the scene has it [m].
PASSED = 4e-3  # No contact lets a tool so far in [m].
SEAM = 1e-5  # So far out of a face another shape covers it [m].
CLEAR, LEAST_FORCE = 6.0, 0.5  # Times noise, [N]: a force that is felt.
UP = np.array([0.0, 0.0, 1.0])
STANDS, LEVEL = 1e-3, 0.9  # It stands on what is so near below it [m]; cosine.


@dataclass(frozen=True, eq=False)
class Face:
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
    def axis(self) -> int:
        """Of the world, along which it may be off."""
        return int(np.argmax(np.abs(self.normal)))

    @property
    def by(self) -> np.ndarray:
        """(3,) by which the body is displaced [m]."""
        return self.off * self.normal + self.lift * UP


class FixedFaces(ContactProblem):
    """A problem in which joints are all that moves, with `faces` of what is fixed.

    Raises: DoesNotFit where anything else moves, or as ContactDynamics.
    """

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
        """A box that stands on another one, or on a half-space, goes on into that. Its
        lower edge would push down a tool that is a little too deep in what it stands
        on, and a place that is wrong by so much would explain forces by that."""
        flat = [
            k for k, s in enumerate(self.shapes.surfaces)
            if s.body in self._carried and s.kind in ("box", "half_space")
        ]  # fmt: skip
        fixed = []
        for k in flat:
            s = self.shapes.surfaces[k]
            R, p = poses[s.body][0][0], poses[s.body][1][0]
            half = s.size[0] if s.kind == "box" else (-1.0, 0.0, 0.0)
            fixed.append([*(R @ s.R_BG).ravel(), *(p + R @ s.p_BG), *half])
        for k, longer in zip(flat, gone_on(np.reshape(fixed, (-1, 15))), strict=True):
            s = self.shapes.surfaces[k]
            R, p = poses[s.body][0][0], poses[s.body][1][0]
            if s.kind == "box":
                self.shapes.surfaces[k] = replace(
                    s, size=(longer[12:],), p_BG=R.T @ (longer[9:12] - p)
                )

    def _possible_faces(self, poses) -> list[Face]:
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

    def _faces_at(self, poses, bodies: Collection[int]) -> list[Face]:
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
                d = np.stack([-local, local], axis=2) - half[:, None]
                covered = self._covered(s, local)
                # A point goes out through the nearest face that nothing covers.
                out = np.where(covered & (d < 0.0), -np.inf, d)
                least = out.max(axis=(1, 2))
                deepest = np.minimum(deepest, least - point.radius)
                for axis in range(3):
                    over = np.delete(d, axis, axis=1).max(axis=(1, 2)) < 0.0
                    for side in range(2):
                        k, x = 2 * axis + side, d[:, axis, side] - point.radius
                        on = over & ~covered[:, axis, side]
                        alone[k] = np.minimum(alone[k], np.where(on, x, np.inf))
                        on &= d[:, axis, side] == least
                        nearest[k] = np.minimum(nearest[k], np.where(on, x, np.inf))
            is_deep = np.sum(deepest < -PASSED) >= FEWEST_ROWS
            for k in range(6):
                normal = (-1.0, 1.0)[k % 2] * R[:, k // 2]
                off = self._kept_distance(nearest[k], normal)
                if abs(off) < REACH:
                    found.append(Face(s.body, normal, off))
                if not is_deep:
                    continue
                more = self._kept_distance(alone[k], normal)
                if -REACH < more < min(-PASSED, off - SAME):
                    found.append(Face(s.body, normal, more, is_alone=True))
        return found

    def _covered(self, s, local: np.ndarray) -> np.ndarray:
        """(n, 3, 2) whether another shape of the body covers a box's face on either
        side of each axis, where a point (n, 3) in the box's own frame is nearest to
        it."""
        covered = np.zeros((*local.shape, 2), bool)
        (half,) = s.size
        for other in self.shapes.surfaces:
            if other.body != s.body or other is s:
                continue
            for axis in range(3):
                for side, sign in enumerate((-1.0, 1.0)):
                    there = np.array(local)
                    there[:, axis] = sign * (half[axis] + SEAM)
                    d, _ = other.distance(s.p_BG + there @ s.R_BG.T)
                    covered[:, axis, side] |= d < 0.0
        return covered

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

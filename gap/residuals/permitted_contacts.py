"""What contacts of a scene can give along a measured motion: columns of forces.

A contact that slides has one generator, pressing with mu along the slip; one that may
stick has a pyramid of them. Which points of a thing carry it is decided by how it would
come to rest where it was seen, not by distances, of which a camera makes millimetres.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.multibody.tree import BodyIndex, Frame, JacobianWrtVariable
from scipy.optimize import linprog
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation
from scipy.special import expit

from makebreak.gap.data.recording import Recording
from makebreak.gap.numerics.permitted_forces import (
    tangential,
    tangents,
    unshared_load,
)
from makebreak.gap.residuals.contact_means import FEWEST_MEANS, SLIDES, ContactMeans
from makebreak.gap.residuals.touching import BESIDE, MEETS, NEAR
from makebreak.gap.simulation.contact_shapes import Slot
from makebreak.gap.simulation.windows import TURN
from makebreak.models.effects.ground import PLACE
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.loads import rotation
from makebreak.models.scene import Scene

SLACK = 8e-4  # Points so little farther than the nearest of two bodies touch too [m].
CARRIES = 0.012  # What is fixed may carry what is measured so far above it [m],
STEEP = 0.12  # and turned by so much against how it would rest [rad].
TIPPED = 0.01  # Turned by more than as it mostly lies, it stands on an edge [rad].
EDGE = 8e-4  # Over which a patch of friction sets in [m].
UNEVEN = 2e-5  # How flat what carries is; points share a load to k times it [m].
STEADY = 0.995  # Mean of a normal within a test function, at least: 0.1 rad, rms.
ONE_WAY = 0.9  # Mean of the directions of slip within a test function, at least.
PYRAMID = 12  # Sides about a friction cone.
MOST_SHARED = 6  # Rows that share loads.
# What changes shapes, surfaces and where they are.
SURFACES = (
    "contact_friction", "friction_patch", "plane_tilt", "plane_height", PLACE,
    "object_size",
)  # fmt: skip
MOST_KEPT = 12  # Geometries.


@dataclass(frozen=True)
class Shift:
    """By what a camera may show a body wrongly: place [m], turn [rad], late [s]."""

    body: str
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    late: float = 0.0


@dataclass(frozen=True, eq=False)
class _Column:
    """A generator, pressing + mu rubbing: means (K, rows), and rubbing at the nodes
    (n_nodes, rows), of which scale (K,) times the mean counts; can (K,) act."""

    slot: int
    can: np.ndarray
    scale: np.ndarray
    pressing: np.ndarray
    rubbing: np.ndarray
    mean_rubbing: np.ndarray


@dataclass(eq=False)
class Geometry:
    """Slots that may act where effects put the shapes, {key: (n_nodes,) when}, their
    columns, and how loads are shared (K, d, columns), once that was asked."""

    slots: list[Slot]
    masks: dict[tuple[int, int], np.ndarray]
    columns: list[_Column]
    sharing: np.ndarray | None = None


class PermittedContacts(ContactMeans):
    """Generators of contact forces at the nodes of the test functions."""

    slides = SLIDES  # Slower slip may be sticking [m/s].
    # Kinds that move points and surfaces of what lies or is pushed.
    moves: tuple[str, ...] = ("plane_tilt", "plane_height", PLACE, "object_size")

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        super().__init__(scene, recordings)
        self._context = self.plant.CreateDefaultContext()
        self._find_contacts()

    # ----- Geometry at nodes

    def _find_contacts(self) -> None:
        """What may touch in the test functions that there are."""
        self._geometries: dict[tuple, Geometry] = {}
        self._lying: dict[tuple[int, int], bool] = {}
        self._find_slots()
        steady = ~self._turning()
        if not steady.all() and steady.sum() >= FEWEST_MEANS:
            self.means = self.means.of(steady)
            self._lying.clear()
            self._find_slots()
        self._pairs_met = sorted(
            {self._pair_of(s) for s, on in zip(self.slots, self._masks, strict=True)
             if on.any()}
        )  # fmt: skip

    def _find_slots(self) -> None:
        self._evaluate_nodes()
        self.slots, _ = self._slots(())
        self._masks = self._touches(self.slots)

    def _turning(self) -> np.ndarray:
        """(K,) where a normal turns so far in a test function that a force that comes
        or goes meanwhile is along none of its mean."""
        out = np.zeros(len(self.means.time), bool)
        for s, on in zip(self.slots, self._masks, strict=True):
            weight = np.asarray(self._W @ on.astype(float)).ravel()
            mean = np.linalg.norm(self._W @ (s.normal * on[:, None]), axis=1)
            out |= mean < STEADY * weight
        return out

    def _evaluate_nodes(self) -> None:
        m, plant = self.means, self.plant
        self._rows = np.unique(m.weights.indices)
        self._W = csr_matrix(m.weights[:, self._rows])
        q, v = self._q[self._rows], self._v[self._rows]
        self._node_poses = self._poses_at(q)
        moving = [k for k in self.shapes.bodies() if k not in self.shapes.anchored]
        n_v, W = plant.num_velocities(), plant.world_frame()
        self._J = {k: np.empty((len(q), 6, n_v)) for k in moving}
        wrt = JacobianWrtVariable.kV
        for n, row in enumerate(q):
            plant.SetPositions(self._context, row)
            for k in moving:
                frame = plant.get_body(BodyIndex(k)).body_frame()
                self._J[k][n] = plant.CalcJacobianSpatialVelocity(
                    self._context, wrt, frame, np.zeros(3), W, W
                )
        self._node_v, self._node_v_off = v, self._v_off[self._rows]
        # Where wrenches are measured (n_nodes, 3) [m].
        self._felt_at = [self._places_of(sensor.frame, q) for sensor in self.sensors]
        # The equations of the smoothed motion, and the mass matrix in the middle for
        # what the mean of the acceleration differs from the smoothed one by: where
        # links turn fast the mean of a product is not that of means.
        rows = np.unique(m.whole.indices)
        vd = self._vd[rows]
        effort = self.dynamics.inverse_dynamics(self._q[rows], self._v[rows], vd)
        self._needed_smoothed = m.whole[:, rows] @ effort
        self._mean_vd = m.whole[:, rows] @ vd
        self._M = np.empty((len(m.time), n_v, n_v))
        for k, row in enumerate(m.centre):
            plant.SetPositions(self._context, self._q[row])
            self._M[k] = plant.CalcMassMatrix(self._context)

    def _places_of(self, frame: Frame, q: np.ndarray) -> np.ndarray:
        """(n, 3) a frame's origin in the world at positions q (n, n_q)."""
        out = np.empty((len(q), 3))
        for n, row in enumerate(q):
            self.plant.SetPositions(self._context, row)
            out[n] = frame.CalcPoseInWorld(self._context).translation()
        return out

    def _slots(self, effects: Sequence[Effect], shift: Shift | None = None):
        """Slots at the nodes, and the poses that they are of."""
        poses, shapes = dict(self._node_poses), self.shapes
        for e in effects:
            if e.kind == "object_size":
                for k in poses:
                    if self._is_at(e, k):
                        shapes = shapes.scaled(k, self._scale_of(e, k))
            if e.kind not in ("plane_tilt", "plane_height", PLACE):
                continue
            for k in poses:
                if k in self.shapes.anchored and self._is_at(e, k):
                    R, p = poses[k]
                    if e.kind == "plane_height":
                        poses[k] = R, p + [0.0, 0.0, e.parameters["height"]]
                    elif e.kind == PLACE:
                        poses[k] = R, p + [e.parameters.get(a, 0.0) for a in "xyz"]
                    else:
                        poses[k] = rotation(e).matrix() @ R, p
        for k in poses if shift else ():
            assert shift is not None
            if self.shapes.names.get(k) == shift.body:
                R, p = poses[k]
                late = 0.0
                if shift.late:
                    i_v = self.bodies[shift.body][1]
                    late = shift.late * self._node_v[:, i_v + 3 : i_v + 6]
                turn = Rotation.from_rotvec(shift.turn).as_matrix()
                poses[k] = turn @ R, p + np.array(shift.place) + late
        return shapes.slots(poses, NEAR), poses

    def _scale_of(self, effect: Effect, body: int) -> float:
        """By an effect that gives a scale, or the radius of the body's only sphere."""
        p = effect.parameters
        radii = [x.radius for x in self.shapes.points if x.body == body and x.is_sphere]
        scale = p.get("scale", 0.0)
        if "scale" not in p and "radius" in p and len(radii) == 1:
            scale = p["radius"] / radii[0]
        if not scale > 0.0:
            raise ValueError(f"object_size: {p} is no size of {effect.at}")
        return float(scale)

    def _is_at(self, effect: Effect, body: int) -> bool:
        name = self.shapes.names.get(body, "")
        return any(at in (name, name.split(".")[0]) for at in effect.at)

    def pair_name(self, pair: tuple[int, int]) -> str:
        """As an effect names it: the free body first."""
        a, b = (self.shapes.names[k] for k in pair)
        return f"{a}~{b}" if a in self.bodies or b not in self.bodies else f"{b}~{a}"

    def _at_pair(self, effect: Effect, pair: tuple[int, int]) -> bool:
        names = {self.shapes.names[k] for k in pair}
        short = {n.split(".")[0] for n in names}
        for at in effect.at:
            two = {x.strip() for x in at.split("~")}
            if two == names or two == short:
                return True
        return False

    def _lies(self, pair: tuple[int, int]) -> bool:
        """Whether something free lies on what is fixed: not if that is a wall."""
        if not self._is_of_a_free_body(pair):
            return bool(set(pair) & self.shapes.anchored)
        if pair not in self._lying:
            mine = [s for s in self.slots if self._pair_of(s) == pair]
            self._lying[pair] = any(
                (self.carries(s) & (s.phi < CARRIES)).any() for s in mine
            )
        return self._lying[pair]

    def _touches(self, slots: Sequence[Slot]) -> list[np.ndarray]:
        """Of each slot (n_nodes,) whether it may act. What lies on something fixed is
        carried by the points on which it would come to rest there, however far its
        measured pose is from that: distances are judged apart from forces."""
        of: dict[tuple[int, int], list[int]] = {}
        for k, s in enumerate(slots):
            of.setdefault(self._pair_of(s), []).append(k)
        out = [np.zeros(len(s.phi), bool) for s in slots]
        for pair, index in of.items():
            phi = np.stack([slots[k].phi for k in index], axis=1)
            best = np.stack([slots[k].best for k in index], axis=1)
            touching = self._touching.get(pair)
            if self._lies(pair) and self._is_of_a_free_body(pair):
                below = np.stack([self.carries(slots[k]) for k in index], axis=1)
                may = self._carrying([slots[k] for k in index], best & below)
                # What stands beside it is touched or not, by its distance.
                beside = self._touching.get((*pair, BESIDE))
                if beside is not None:
                    far = np.where(below, np.inf, phi)
                    close = far < far.min(axis=1)[:, None] + SLACK
                    may |= close & best & ~below & beside[self._rows][:, None]
                for column, k in enumerate(index):
                    out[k] = may[:, column]
                continue
            nearest = phi.min(axis=1)
            close = phi < nearest[:, None] + SLACK
            may = np.logical_and(best, close)
            if touching is not None:
                may &= touching[self._rows][:, None]
            else:
                may &= nearest[:, None] < MEETS
            for column, k in enumerate(index):
                out[k] = may[:, column]
        return out

    def _carrying(self, slots: Sequence[Slot], best: np.ndarray) -> np.ndarray:
        """(n_nodes, n_slots) which points carry a body on what is below it, of those
        that are (n_nodes, n_slots) best."""
        phi = np.where(best, np.stack([s.phi for s in slots], axis=1), np.inf)
        nearest = phi.min(axis=1)
        may = best & (phi < nearest[:, None] + SLACK)
        rests = self._at_rest_on(slots, best)
        rested = np.any(rests, axis=1, keepdims=True)
        may = np.where(rested, rests & best, may)
        return may & (nearest[:, None] < CARRIES)

    def _at_rest_on(self, slots: Sequence[Slot], best: np.ndarray) -> np.ndarray:
        """(n_nodes, n_slots) which points would touch once the body has come to rest on
        a plane below it as it is: the highest plane under all points at the body's
        middle (a linear program). None where the plane would be steep, or is not as it
        mostly is: the body has been tipped."""
        n = len(slots[0].phi)
        out = np.zeros((n, len(slots)), bool)
        if len(slots) < 3:
            return out
        place = np.stack([s.place for s in slots], axis=1)
        phi = np.stack([s.phi for s in slots], axis=1)
        up = self._up()
        slope = np.full((n, 2), np.nan)
        known: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}
        for k in range(n):
            some = np.flatnonzero(best[k])
            if len(some) < 3:
                continue
            e3 = up
            e1 = np.cross(e3, [1.0, 0.0, 0.0] if abs(e3[0]) < 0.9 else [0.0, 1.0, 0.0])
            e1 /= np.linalg.norm(e1)
            at = place[k, some] - place[k, some].mean(axis=0)
            x, y, z = at @ e1, at @ np.cross(e3, e1), phi[k, some]
            # Poses that differ little rest alike.
            key = tuple(np.round([*(phi[k, some] - phi[k, some].min())], 4))
            if key not in known:
                A = np.column_stack([np.ones(len(some)), x, y])
                found = linprog(
                    [-1.0, 0.0, 0.0], A_ub=A, b_ub=z,
                    bounds=[(None, None), (-STEEP, STEEP), (-STEEP, STEEP)],
                )  # fmt: skip
                rests = np.zeros(len(some), bool)
                steep = np.full(2, np.nan)
                if found.success and np.abs(found.x[1:]).max() < 0.999 * STEEP:
                    rests, steep = z - A @ found.x < SLACK, found.x[1:]
                known[key] = rests, steep
            out[k, some], slope[k] = known[key]
        if np.isfinite(slope).any():
            off = np.linalg.norm(slope - np.nanmedian(slope, axis=0), axis=1)
            out[off > max(TIPPED, 6.0 * self._turn_noise())] = False
        return out

    def _turn_noise(self) -> float:
        """Of the noisiest pose [rad]."""
        every = [2.0 * r.channels[f"{body}.{a}"].noise for r in self.recordings
                 for body in self.bodies for a in TURN]  # fmt: skip
        return max(every, default=0.0)

    def _relative(self, s: Slot, poses=None) -> np.ndarray:
        """(n_nodes, 3, n_v): how the point of a moves against that of b, with v."""
        poses = poses or self._node_poses
        n = len(s.phi)
        out = np.zeros((n, 3, self.plant.num_velocities()))
        for k, sign in ((s.a, 1.0), (s.b, -1.0)):
            if k not in self._J:
                continue
            arm = s.place - poses[k][1]
            J = self._J[k]
            out += sign * (J[:, 3:] - np.cross(arm[:, :, None], J[:, :3], axis=1))
        return out

    # ----- Columns

    def _friction(self, s: Slot, effects: Iterable[Effect]) -> np.ndarray:
        """(n_nodes,) of a slot's contact."""
        mu = np.full(len(s.phi), s.friction)
        for e in effects:
            if e.kind == "contact_friction" and self._at_pair(e, self._pair_of(s)):
                if e.parameters["friction"] < 0.0:
                    raise ValueError("contact_friction: below zero")
                mu[:] = e.parameters["friction"]
        for e in effects:
            if e.kind == "friction_patch" and self._at_pair(e, self._pair_of(s)):
                p = e.parameters
                if not (p["x_min"] < p["x_max"] and p["y_min"] < p["y_max"]):
                    raise ValueError("friction_patch: the patch is empty")
                if p["friction"] < 0.0:
                    raise ValueError("friction_patch: below zero")
                x, y = s.place[:, 0], s.place[:, 1]
                inside = _between(x, p["x_min"], p["x_max"])
                inside = inside * _between(y, p["y_min"], p["y_max"])
                mu = mu + inside * (p["friction"] - mu)
        return mu

    def _generators(self, effects: Sequence[Effect], shift: Shift | None = None):
        """G (K, rows, columns), which can act (K, columns), slot of each column; the
        geometry; how loads are shared."""
        geometry = self._contacts_at(effects, shift)
        slots, made = geometry.slots, geometry.columns
        K, n = len(self.means.time), len(self.coordinates) + self.n_wrench
        frictions = {
            number: self._friction(slots[number], effects)
            for number in {c.slot for c in made}
        }
        G = np.zeros((K, n, max(len(made), 1)))
        there = np.zeros((K, max(len(made), 1)), bool)
        for k, c in enumerate(made):
            mu = frictions[c.slot]
            if np.ptp(mu) == 0.0:
                G[:, :, k] = c.pressing + mu[0] * c.mean_rubbing
            else:
                rubbing = self._W @ (mu[:, None] * c.rubbing)
                G[:, :, k] = c.pressing + c.scale[:, None] * rubbing
            there[:, k] = c.can
        if geometry.sharing is None:
            geometry.sharing = self._sharing(made, slots)
        return G, there, [c.slot for c in made], geometry, geometry.sharing

    def _contacts_at(self, effects: Sequence[Effect], shift: Shift | None) -> Geometry:
        """Where effects put the shapes; the last few are kept."""
        moved = [e for e in effects if e.kind in self.moves]
        if shift is not None:
            return self._new_geometry(moved, shift)
        key = tuple((e.kind, *e.at, *sorted(e.parameters.items())) for e in moved)
        if key not in self._geometries:
            if len(self._geometries) > MOST_KEPT:  # The one as it came is the first.
                del self._geometries[list(self._geometries)[1]]
            self._geometries[key] = self._new_geometry(moved, None)
        return self._geometries[key]

    def _new_geometry(self, effects: Sequence[Effect], shift: Shift | None) -> Geometry:
        """What carries a thing carries it still."""
        masks = dict(zip((s.key for s in self.slots), self._masks, strict=True))
        if not effects and shift is None:
            columns = self._columns(self.slots, self._node_poses, masks)
            return Geometry(self.slots, masks, columns)
        slots, poses = self._slots(effects, shift)
        if any(e.kind == "object_size" for e in effects):
            # Another part of what is pushed may be the nearest one.
            beside = [s for s in slots if not self._lies(self._pair_of(s))]
            masks = {
                s.key: masks[s.key] for s in self.slots if self._lies(self._pair_of(s))
            } | {
                s.key: on
                for s, on in zip(beside, self._touches(beside), strict=True)
                if on.any()
            }
        slots = [s for s in slots if s.key in masks]
        return Geometry(slots, masks, self._columns(slots, poses, masks))

    def _columns(self, slots: Sequence[Slot], poses, masks) -> list[_Column]:
        """Of each slot the force along its slip, and where it may stick those of a
        pyramid, as generalized forces and on the sensors."""
        W, found = self._W, list[_Column]()
        for number, s in enumerate(slots):
            mine = masks[s.key]
            weight = np.asarray(W @ mine.astype(float)).ravel()
            acts = weight > 0.5
            if not acts.any():
                continue
            J = self._relative(s, poses)
            u = np.einsum("nij,nj->ni", J, self._node_v)
            slip = tangential(u, s.normal)
            speed = np.linalg.norm(slip, axis=1)
            # Of what just set in or stopped the smoothed slip is not known.
            off = tangential(np.einsum("nij,nj->ni", J, self._node_v_off), s.normal)
            sure = speed >= np.maximum(self.slides, np.linalg.norm(off, axis=1))
            fast = np.asarray(W @ (sure & mine).astype(float)).ravel()
            slides = fast >= 0.999 * weight  # Slower in any part: it may stick.
            along = slip / np.maximum(speed, 1e-9)[:, None]
            one_way = np.linalg.norm(W @ (along * mine[:, None]), axis=1)
            slides &= one_way >= ONE_WAY * weight  # Turning round, it may stick.
            e1, e2 = tangents(s.normal)
            ways = [(-along, acts)]
            may = acts & ~slides
            for k in range(PYRAMID if may.any() else 0):
                angle = 2.0 * np.pi * k / PYRAMID
                way = np.cos(angle) * e1 + np.sin(angle) * e2
                ways.append((way / np.cos(np.pi / PYRAMID), may))
            scale = np.where(weight > 0.0, 1.0 / np.maximum(weight, 1e-9), 0.0)
            pressing = scale[:, None] * (W @ self._felt(s, J, s.normal * mine[:, None]))
            for way, can in ways:
                rubbing = self._felt(s, J, way * mine[:, None])
                found.append(
                    _Column(number, can, scale, pressing, rubbing,
                            scale[:, None] * (W @ rubbing))
                )  # fmt: skip
        return found

    def _felt(self, s: Slot, J: np.ndarray, f: np.ndarray) -> np.ndarray:
        """(n_nodes, rows) a force f (n_nodes, 3) on the slot's a, and back on its b."""
        n_v = self.plant.num_velocities()
        out = np.zeros((len(f), n_v + self.n_wrench))
        out[:, :n_v] = np.einsum("nij,ni->nj", J, f)
        felt = out[:, n_v:]
        for sensor, at in zip(self.sensors, self._felt_at, strict=True):
            sign = float(s.a in sensor.welded) - float(s.b in sensor.welded)
            felt[:, sensor.forces] = sign * f
            if sensor.feels_moments:
                felt[:, sensor.moments] = sign * np.cross(s.place - at, f)
        return out

    def _sharing(self, made: Sequence[_Column], slots: Sequence[Slot]) -> np.ndarray:
        """(K, d, columns) what makes the points of a thing that lies share its load, as
        springs on ground that is even to UNEVEN would: rows of unshared_load."""
        K = len(self.means.time)
        out = np.zeros((K, MOST_SHARED, max(len(made), 1)))
        there = np.stack([c.can for c in made], axis=1) if made else np.zeros((K, 0))
        of = np.array([c.slot for c in made], int)
        row = np.zeros(K, int)
        for pair in self._pairs_met:
            mine = [k for k in dict.fromkeys(of) if self._pair_of(slots[k]) == pair
                    and self.carries(slots[k]).any()]  # fmt: skip
            if not self._lies(pair) or len(mine) < 4:
                continue
            ease = 1.0 / (slots[mine[0]].stiffness * UNEVEN)
            places = np.stack([self._W @ slots[k].place[:, :2] for k in mine], axis=1)
            acts = np.stack([there[:, of == k].any(axis=1) for k in mine], axis=1)
            for i in range(K):
                some = np.flatnonzero(acts[i])
                if len(some) < 4:
                    continue
                loads = unshared_load(places[i, some])[: MOST_SHARED - row[i]]
                for one in loads:
                    for k, x in zip(some, one, strict=True):
                        out[i, row[i], of == mine[k]] = ease * x
                    row[i] += 1
        return out


def _between(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """1 within, 0 without; over EDGE about the ends it is in between, so that a search
    has slopes."""
    return expit((x - low) / EDGE) * expit((high - x) / EDGE)

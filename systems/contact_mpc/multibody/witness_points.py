"""Distances of two geometries, their witness points, and the contact Jacobian."""

from typing import Any

import numpy as np
from pydrake.geometry import Convex, GeometryId, Mesh, QueryObject, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from makebreak.systems.contact_mpc.multibody.contact_layout import ContactLayout
from makebreak.systems.contact_mpc.numerics.contact_rows import tangent_basis
from makebreak.systems.contact_mpc.numerics.convex_hull import point_on_hull

GRAVITY = 9.81  # [m/s2]
TOUCHING = 1e-7  # Distances below this one are too short for a direction [m].


class WitnessPoints:
    """Drake's signed distances of the contacts of a layout, and the Jacobians of their
    witness points.

    Args: plant; inspector: its scene graph's; layout: the contacts.

    Attributes: frames: {geometry: (its body's frame, its pose in that frame)}.
    """

    def __init__(self, plant: MultibodyPlant, inspector, layout: ContactLayout):
        self._plant, self._layout = plant, layout
        self._query_port = plant.get_geometry_query_input_port()
        self.frames = {}
        self._radius: dict[GeometryId, float] = {}
        self._hull: dict[GeometryId, tuple[np.ndarray, np.ndarray]] = {}
        for id in {id for ids in layout.geometries for id in ids}:
            body = plant.GetBodyFromFrameId(inspector.GetFrameId(id))
            self.frames[id] = (body.body_frame(), inspector.GetPoseInFrame(id))
            shape = inspector.GetShape(id)
            if isinstance(shape, Sphere):
                self._radius[id] = shape.radius()
            elif isinstance(shape, (Mesh, Convex)):
                self._hull[id] = _hull_faces(inspector.GetConvexHull(id))

    def check(self, context: Context) -> None:
        """Raises: ValueError naming a contact for which Drake has no distance, or whose
        normal leaves the plane of its plane_normal, at the state of the context."""
        query: Any = self._query_port.Eval(context)
        for i, (id_A, id_B) in enumerate(self._layout.geometries):
            try:
                _, n, _, _ = self.distance(query, id_A, id_B)
            except RuntimeError as error:
                shapes = [
                    type(query.inspector().GetShape(g)).__name__ for g in (id_A, id_B)
                ]
                raise ValueError(
                    f"{self._layout.names[i]}: Drake has no signed distance of "
                    f"{shapes[0]} and {shapes[1]}, expected convex shapes (a "
                    "half-space only with a sphere)"
                ) from error
            self._check_plane(i, n)

    def jacobians(self, context: Context) -> tuple[np.ndarray, ...]:
        """Of the contacts that the LCS has at the state of the plant's context.

        Returns: phi (n_contacts,) gaps [m]; J (n_contacts, 3, n_v), velocity of A's
            witness point relative to B's along n, t1 and t2; the contacts' indices.
        Raises: ValueError naming a contact without a unique normal.
        """
        plant, layout = self._plant, self._layout
        world, wrt = plant.world_frame(), JacobianWrtVariable.kV
        found = self._distances(context)
        chosen = layout.every
        if layout.chooses:
            chosen = layout.nearest(np.array([gap for gap, *_ in found]))
        phi = np.empty(len(chosen))
        J = np.empty((len(chosen), 3, plant.num_velocities()))
        for k, i in enumerate(chosen):
            (id_A, id_B), (phi[k], n, p_A, p_B) = layout.geometries[i], found[i]
            if not _is_unit(n):
                raise ValueError(f"{layout.names[i]}: no unique normal at {n}")
            self._check_plane(i, n)
            (frame_A, X_A), (frame_B, X_B) = self.frames[id_A], self.frames[id_B]
            J_w = plant.CalcJacobianTranslationalVelocity(
                context, wrt, frame_A, X_A @ p_A, world, world
            ) - plant.CalcJacobianTranslationalVelocity(
                context, wrt, frame_B, X_B @ p_B, world, world
            )
            t1, t2 = tangent_basis(n, layout.reference[i])
            J[k] = np.stack([n, t1, t2]) @ J_w
        return phi, J, chosen

    def normals(self, context: Context) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) in the world, of the contacts that the LCS has at the state of the
        plant's context, and their indices (n,)."""
        found, layout = self._distances(context), self._layout
        chosen = layout.every
        if layout.chooses:
            chosen = layout.nearest(np.array([gap for gap, *_ in found]))
        return np.array([found[i][1] for i in chosen]), chosen

    def against_rolling(self, context: Context, chosen, lever, J_n, M, dt):
        """(n_contacts, n_v) generalized force of the resistance to rolling, for a
        normal force of 1 in each contact, at the state of the plant's context.

        The torque is the lever arm (n_contacts,) [m] against the rolling part of the
        bodies' relative angular velocity. It fades where a weight of what the normal
        J_n (n_contacts, n_v) moves would stop the rolling in a step of dt [s].
        """
        v, out = self._plant.GetVelocities(context), np.zeros((len(chosen), len(M)))
        for k, i in enumerate(chosen):
            if lever[k] == 0.0:
                continue
            J = self.rolling(context, i)
            rate = J @ v
            speed = np.linalg.norm(rate)
            along = rate / speed if speed > 0.0 else np.zeros(3)
            mobility = along @ J @ np.linalg.solve(M, J.T @ along)
            moved = J_n[k] @ np.linalg.solve(M, J_n[k])
            stopped = dt * abs(lever[k]) * GRAVITY * mobility / moved
            out[k] = lever[k] * min(speed / max(stopped, 1e-300), 1.0) * (along @ J)
        return out

    def rolling(self, context: Context, i: int) -> np.ndarray:
        """(3, n_v) Jacobian of how the bodies of a contact roll on each other."""
        plant, world = self._plant, self._plant.world_frame()
        query: Any = self._query_port.Eval(context)
        id_A, id_B = self._layout.geometries[i]
        n = self.distance(query, id_A, id_B)[1]
        J_A, J_B = (
            plant.CalcJacobianAngularVelocity(
                context, JacobianWrtVariable.kV, self.frames[of][0], world, world
            )
            for of in (id_A, id_B)
        )
        return (np.eye(3) - np.outer(n, n)) @ (J_A - J_B)

    def _distances(self, context: Context):
        """distance() of all contacts. Where two geometries just touch, Drake's normal
        is 0/0; it is then that of a state which is moved by about TOUCHING."""
        query: Any = self._query_port.Eval(context)
        found = [self.distance(query, *ids) for ids in self._layout.geometries]
        touching = [
            i for i, (gap, n, *_) in enumerate(found)
            if abs(gap) < TOUCHING and not _is_unit(n, 1e-9)
        ]  # fmt: skip
        if not touching:
            return found
        plant = self._plant
        q = plant.GetPositions(context).copy()
        # A direction that is not along any surface but by chance.
        aside = np.cos(1.0 + np.arange(plant.num_velocities()))
        nearby = q + TOUCHING * plant.MapVelocityToQDot(context, aside)
        plant.SetPositions(context, nearby)
        query = self._query_port.Eval(context)
        for i in touching:
            gap, _, *points = found[i]
            n = self.distance(query, *self._layout.geometries[i])[1]
            found[i] = gap, n, *points
        plant.SetPositions(context, q)
        return found

    def distance(self, query: QueryObject, id_A: GeometryId, id_B: GeometryId):
        """Distance [m], normal from B to A in the world (3,), and the witness points
        (3,) on A and B, each in its geometry's frame."""
        for sphere, other, sign in ((id_A, id_B, 1.0), (id_B, id_A, -1.0)):
            if sphere in self._radius and other in self._hull:
                # Drake's iteration does not converge with the centre near a vertex.
                X_WS, X_WH = query.GetPoseInWorld(sphere), query.GetPoseInWorld(other)
                centre = X_WH.inverse() @ X_WS.translation()
                distance, n_H, p_H = point_on_hull(*self._hull[other], centre)
                n, r = X_WH.rotation() @ n_H, self._radius[sphere]
                p_S = X_WS.rotation().inverse() @ (-r * n)
                points = (p_S, p_H) if sign > 0.0 else (p_H, p_S)
                return distance - r, sign * n, *points
        pair = query.ComputeSignedDistancePairClosestPoints(id_A, id_B)
        n_BA: Any = pair.nhat_BA_W  # (3,); the stubs say float.
        if pair.id_A != id_A:
            return pair.distance, -n_BA, pair.p_BCb, pair.p_ACa
        return pair.distance, n_BA, pair.p_ACa, pair.p_BCb

    def _check_plane(self, i, n: np.ndarray) -> None:
        layout = self._layout
        if layout.planar[i] and abs(n @ layout.reference[i]) > 0.1:
            raise ValueError(
                f"{layout.names[i]}: the contact normal {n} leaves the plane of "
                f"plane_normal {layout.reference[i]}"
            )


def _is_unit(n: np.ndarray, tolerance=1e-6) -> bool:
    return bool(abs(n @ n - 1.0) < tolerance)


def _hull_faces(hull) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals (n, 3) of a hull's faces, and their offsets (n,) [m]."""
    faces = range(hull.num_faces())
    normals = np.array([hull.face_normal(f) for f in faces])
    on_face = [hull.vertex(hull.element(f).vertex(0)) for f in faces]
    return normals, np.einsum("fi,fi->f", normals, np.array(on_face))

"""LCS of any MultibodyPlant with named contacts: AnitescuLcs and its LeafSystem.

The caller makes a diagram of a plant and its scene graph and hands it over; nothing is
added to it:

    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    Parser(plant).AddModels("ball_on_table.sdf")
    plant.Finalize()
    lcs = AnitescuLcs(builder.Build(), [ContactPair("finger_link", "ball_link", 0.5)])

See docs/lcs.md for the state's layout, quaternions, units and limits.
"""

from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from enum import IntEnum
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, InitializeAutoDiff
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import (
    Box,
    Convex,
    Cylinder,
    GeometryId,
    HalfSpace,
    Mesh,
    SceneGraph,
    Sphere,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    JacobianWrtVariable,
    MultibodyForces,
    MultibodyForces_,
)
from pydrake.systems.framework import Diagram, LeafSystem

from makebreak.systems.contact_mpc.numerics.c3_plan import Plan
from makebreak.systems.contact_mpc.numerics.convex_hull import point_on_hull
from makebreak.systems.contact_mpc.numerics.lcs import LCS, is_finite
from makebreak.systems.contact_mpc.numerics.lcs_builder import (
    BOX,
    CYLINDER,
    HALF_SPACE,
    SPHERE,
    ConstantMassModel,
    assemble_lcs,
    build_many_constant_mass,
    contact_rows,
    friction_edges,
    nearest_contacts,
    tangent_basis,
    velocity_maps,
)
from makebreak.systems.numerics.timing import timed

_LCS_FIELDS = ("A", "B", "D", "d", "E", "F", "H", "c", "phi")


@dataclass
class Anitescu:
    """Convex contact: 2 n_f forces. A contact that slides opens by dt mu |v_t|."""


@dataclass
class StewartTrinkle:
    """Coulomb's cone as a polyhedron: 2 n_f + 2 entries of lam (1 without friction).

    They are the normal force, 2 n_f friction forces, and the sliding speed.
    """


@dataclass
class ContactPair:
    """Two bodies or collision geometries that may touch.

    A body is named "model::body", or "body" where that is unique; a geometry by its
    name in the scene graph ("ball::ball_collision"). A body stands for all of its
    collision geometries: every combination is a contact of its own, or the `closest`
    of them are.
    """

    a: str = ""
    b: str = ""
    friction: float = 1.0  # Coulomb coefficient mu.
    friction_directions: int = 2  # n_f; 2 n_f friction edges, so 2 n_f forces.
    # World direction that the first friction edge follows (its projection); empty: the
    # basis of Drake's MakeFromOneVector, which jumps as the normal turns.
    tangent: list[float] = field(default_factory=list)
    # Of a plant that moves in a plane: the plane's normal, in the world. The edges then
    # start in the plane; with friction_directions = 1 they are its two.
    plane_normal: list[float] = field(default_factory=list)
    # In YAML `contact_model: !StewartTrinkle {}`.
    contact_model: Anitescu | StewartTrinkle = field(default_factory=Anitescu)
    # Normal force over penetration [N/m], without damping; None: rigid, but for eps_c.
    stiffness: float | None = None
    # How many of the pair's combinations are contacts, the nearest; None: all.
    closest: int | None = None


class AnitescuLcs:
    """Builds the LCS of a plant's contacts about any state (ACI-MPC eq. 5-8).

    Args:
        diagram: holds one finalized MultibodyPlant connected to a SceneGraph.
        pairs: the contacts; their order is the order of the forces.
        dt_sec: time step [s].
        eps_c: added to F's diagonal, for lam in newtons [m/s per N]; None: 0.01 dt_sec,
            the paper's 0.01 for lam as an impulse. It softens no normal force of a
            pair that has a stiffness.
        closest: how many of all combinations of all pairs are contacts, the nearest at
            each state; None: all. The pairs must have the same kind of contact.
        analytic: use the fast path where the model allows it; False: never.

    Attributes:
        n_q, n_v, n_x, n_u, n_lam, n_pairs: sizes; x = [q, v] in the plant's order.
        x_default: (n_x,) the plant's default state.
        x_names, lam_names: of each state, and of each entry of lam, "geometry~geometry
            edge" (where the nearest are taken: "nearest k of geometry~... edge").
        is_analytic: which of the two paths `build` takes.

    Raises: ValueError naming a pair that does not exist, a body without collision
        geometry, shapes without a distance, or a parameter out of range.
    """

    def __init__(
        self, diagram, pairs, dt_sec=0.1, eps_c=None, analytic=True, closest=None
    ):
        self._plant, scene_graph = _plant_and_scene_graph(diagram)
        plant, pairs = self._plant, list(pairs)
        if not (np.isfinite(dt_sec) and dt_sec > 0.0):
            raise ValueError(f"dt_sec is {dt_sec}, expected a positive time [s]")
        self.dt_sec = float(dt_sec)
        self.eps_c = 0.01 * self.dt_sec if eps_c is None else float(eps_c)
        if not (np.isfinite(self.eps_c) and self.eps_c >= 0.0):
            raise ValueError(f"eps_c is {eps_c}, expected at least 0 [m/s per N]")
        self.n_q, self.n_v = plant.num_positions(), plant.num_velocities()
        self.n_x, self.n_u = self.n_q + self.n_v, plant.num_actuated_dofs()
        self.x_names = list(plant.GetStateNames())
        self._check_model()
        self._resolve(scene_graph.model_inspector(), pairs, closest)

        # Scratch: overwritten before each read.
        self._context = diagram.CreateDefaultContext()
        self._plant_context = plant.GetMyContextFromRoot(self._context)
        self._forces = MultibodyForces(plant)
        self._plant_ad = plant.ToAutoDiffXd()
        self._context_ad = self._plant_ad.CreateDefaultContext()
        self._forces_ad = MultibodyForces_[AutoDiffXd](self._plant_ad)

        self._B_tau = plant.MakeActuationMatrix()
        self._query_port = plant.get_geometry_query_input_port()
        self._plain, self._floating, self._maps_known = self._velocity_layout()
        self.x_default = plant.GetPositionsAndVelocities(self._plant_context).copy()
        self._check_distances()
        self._model = self._constant_mass_model(scene_graph) if analytic else None
        self.is_analytic = self._model is not None
        self.at_default()  # Compiles, and proves it works.

    def at_default(self) -> LCS:
        """The LCS about the plant's default state, without input."""
        return self.build(self.x_default, np.zeros(self.n_u))

    def build(self, x, u, friction=None, gap=None) -> LCS:
        """The LCS about the state x = [q, v] (n_x,) and the input u (n_u,).

        Quaternions in x are normalised first; the LCS's d and c refer to the
        normalised state.

        Args: friction (n_pairs,): of each pair, None: as it was given; gap (n_pairs,)
            [m]: added to each pair's distances, None: nothing.
        Raises: ValueError on a wrong size, an entry that is not finite, a quaternion
            whose norm is not between 0.5 and 2, geometry without a unique normal,
            friction below 0, or friction for a Stewart-Trinkle pair that has none.
        """
        x, u = np.array(x, dtype=float), np.array(u, dtype=float)
        if x.shape != (self.n_x,) or u.shape != (self.n_u,):
            raise ValueError(
                f"x is {x.shape} and u is {u.shape}, "
                f"expected ({self.n_x},) and ({self.n_u},)"
            )
        if not (is_finite(x) and is_finite(u)):
            raise ValueError("x or u holds an entry that is not finite")
        for start, _ in self._floating:
            norm = np.linalg.norm(x[start : start + 4])
            if not 0.5 <= norm <= 2.0:
                raise ValueError(
                    f"the quaternion x[{start}:{start + 4}] has norm {norm:.3g}, "
                    "expected 1"
                )
            x[start : start + 4] /= norm
        mu = self._mu if friction is None else self._friction_of(friction)
        if self._model is not None:
            chosen = self._every
            if self._groups is not None:
                gaps = self._model.gaps(x[: self.n_q])
                chosen = nearest_contacts(gaps, self._groups)
            lcs = self._model.build(
                x, u, self.dt_sec, self._rows, *self._rows_of(chosen, mu),
                None if self._groups is None else chosen,
            )  # fmt: skip
        else:
            lcs = self._build_general(x, u, mu)
        return lcs if gap is None else self._moved_apart(lcs, gap)

    def _friction_of(self, friction):
        """(n_contacts,) of the frictions (n_pairs,)."""
        friction = np.array(friction, dtype=float)
        if friction.shape != (self.n_pairs,) or not (
            is_finite(friction) and (friction >= 0.0).all()
        ):
            raise ValueError(
                f"friction is {friction}, expected ({self.n_pairs},) of at least 0"
            )
        mu = friction[self._pair_of]
        for i in np.flatnonzero(self._without_friction & (mu > 0.0)):
            raise ValueError(
                f"{self._pair_names[i]}: friction {mu[i]:g} came for a contact that "
                "was made without"
            )
        return mu

    def _moved_apart(self, lcs: LCS, gap) -> LCS:
        gap = np.array(gap, dtype=float)
        if gap.shape != (self.n_pairs,) or not is_finite(gap):
            raise ValueError(f"gap is {gap}, expected ({self.n_pairs},), finite [m]")
        of_row = self._pair_of[np.asarray(lcs.contact, dtype=int)]
        further = np.where(self._rows.normal > 0.0, gap[of_row], 0.0)
        return replace(lcs, c=lcs.c + further / self.dt_sec, phi=lcs.phi + further)

    def build_many(self, x, u) -> tuple[np.ndarray, ...]:
        """The LCS about each of many states x (n, n_x) and one input u (n_u,).

        Returns: A, B, D, d, E, F, H, c and phi (LCS), each with the n states first;
            not a number in those of a state that has no LCS.
        Raises: ValueError on a wrong size.
        """
        x, u = np.array(x, dtype=float), np.array(u, dtype=float)
        if x.ndim != 2 or x.shape[1] != self.n_x or u.shape != (self.n_u,):
            raise ValueError(
                f"x is {x.shape} and u is {u.shape}, expected (n, {self.n_x}) and "
                f"({self.n_u},)"
            )
        n, n_x, n_u, n_lam = len(x), self.n_x, self.n_u, self.n_lam
        shapes = ((n_x, n_x), (n_x, n_u), (n_x, n_lam), (n_x,), (n_lam, n_x),
                  (n_lam, n_lam), (n_lam, n_u), (n_lam,), (n_lam,))  # fmt: skip
        out = tuple(np.full((n, *shape), np.nan) for shape in shapes)
        if self._model is None or self._groups_in_arrays is None:
            for i in range(n):
                try:
                    lcs = self.build(x[i], u)
                except (ValueError, RuntimeError):
                    continue
                for array, name in zip(out, _LCS_FIELDS, strict=True):
                    array[i] = getattr(lcs, name)
            return out
        good = np.isfinite(x).all(axis=1) & np.isfinite(u).all()
        for start, _ in self._floating:
            norm = np.linalg.norm(x[:, start : start + 4], axis=1)
            good &= (norm >= 0.5) & (norm <= 2.0)
            x[good, start : start + 4] /= norm[good, None]
        if good.any():
            rows = self._rows
            finite = build_many_constant_mass(
                x[good], u, self.dt_sec, tuple(vars(self._model).values()),
                (rows.contact, rows.normal, self._weight, rows.edge, self._F_0),
                self._groups_in_arrays, part := tuple(a[good] for a in out),
            )  # fmt: skip
            for array, of_good in zip(out, part, strict=True):
                of_good[~finite] = np.nan
                array[good] = of_good
        return out

    def _rows_of(self, chosen, mu):
        """The rows' weight and F_0 for the friction mu (n_contacts,) and stiffness of
        these contacts."""
        if mu is self._mu and chosen is self._every:
            return self._weight, self._F_0
        mu, compliance = mu[chosen], self._compliance[chosen]
        F_0 = self._rows.F_0(mu, compliance, self.dt_sec, self.eps_c)
        return self._rows.weight(mu), F_0

    # The general path: AutoDiff for the smooth dynamics, witness points for contact.

    def _build_general(self, x, u, mu):
        f, J_q, J_v, J_u, M = self._smooth(x, u)
        phi, J_n, J_c, F_0, chosen = self._contact(mu)
        N, N_plus = self._velocity_maps(x[: self.n_q])
        return assemble_lcs(
            x, f, J_q, J_v, J_u, u, M, N, N_plus, phi, J_n, J_c, self._rows.contact,
            self._rows.normal, F_0, self.dt_sec, chosen,
        )  # fmt: skip

    def _smooth(self, x, u):
        """f, its derivatives in q, v and u, and M; leaves the plant's context at x.

        M f = tau(u) - r(q, v), so M df = dtau - d(M(q) f* + r) at the fixed f*: one
        inverse dynamics in AutoDiff, and no derivative of a factorised M.
        """
        plant, context = self._plant, self._plant_context
        plant.SetPositionsAndVelocities(context, x)
        M = plant.CalcMassMatrix(context)
        plant.CalcForceElementsContribution(context, self._forces)
        r = plant.CalcInverseDynamics(context, np.zeros(self.n_v), self._forces)
        try:
            f = np.linalg.solve(M, self._B_tau @ u - r)
        except np.linalg.LinAlgError as error:
            raise ValueError("the mass matrix is singular (a massless body)") from error

        plant_ad, context_ad = self._plant_ad, self._context_ad
        plant_ad.SetPositionsAndVelocities(context_ad, InitializeAutoDiff(x)[:, 0])
        plant_ad.CalcForceElementsContribution(context_ad, self._forces_ad)
        f_ad = np.array([AutoDiffXd(value) for value in f])
        tau = plant_ad.CalcInverseDynamics(context_ad, f_ad, self._forces_ad)
        dtau: Any = ExtractGradient(tau)  # The stubs' array shapes are wrong.
        if dtau.shape[1] == 0:  # Nothing depends on the state.
            dtau = np.zeros((self.n_v, self.n_x))
        J = np.linalg.solve(M, np.hstack([-dtau, self._B_tau]))
        J_q, J_v, J_u = np.split(J, [self.n_q, self.n_x], axis=1)
        return f, J_q, J_v, J_u, M

    def _contact(self, mu):
        """phi, J_n, J_c, F_0 and the numbers of the contacts, at the state that the
        plant's context is at, for the friction mu (n_contacts,)."""
        plant, context, rows = self._plant, self._plant_context, self._rows
        world, wrt = plant.world_frame(), JacobianWrtVariable.kV
        query = self._query_port.Eval(context)
        found = [self._distance(query, *ids) for ids in self._geometries]
        chosen = self._every
        if self._groups is not None:
            gaps = np.array([gap for gap, *_ in found])
            chosen = nearest_contacts(gaps, self._groups)
        weight, F_0 = self._rows_of(chosen, mu)
        phi, J = np.empty(len(chosen)), np.empty((len(chosen), 3, self.n_v))
        for k, i in enumerate(chosen):
            (id_A, id_B), (phi[k], n, p_A, p_B) = self._geometries[i], found[i]
            if not abs(n @ n - 1.0) < 1e-6:
                raise ValueError(f"{self._pair_names[i]}: no unique normal at {n}")
            self._check_plane(i, n)
            (frame_A, X_A), (frame_B, X_B) = self._frames[id_A], self._frames[id_B]
            J_w = plant.CalcJacobianTranslationalVelocity(
                context, wrt, frame_A, X_A @ p_A, world, world
            ) - plant.CalcJacobianTranslationalVelocity(
                context, wrt, frame_B, X_B @ p_B, world, world
            )
            t1, t2 = tangent_basis(n, self._reference[i])
            J[k] = np.stack([n, t1, t2]) @ J_w
        on = rows.contact
        J_t = (rows.edge[:, :, None] * J[on, 1:]).sum(axis=1)
        J_c = rows.normal[:, None] * J[on, 0] + weight[:, None] * J_t
        return phi, J[:, 0], J_c, F_0, chosen

    def _check_plane(self, i, n):
        if self._planar[i] and abs(n @ self._reference[i]) > 0.1:
            raise ValueError(
                f"{self._pair_names[i]}: the contact normal {n} leaves the plane of "
                f"plane_normal {self._reference[i]}"
            )

    def _distance(self, query, id_A, id_B):
        """Gap, normal from B to A in the world, and witness points in each geometry."""
        for sphere, other, sign in ((id_A, id_B, 1.0), (id_B, id_A, -1.0)):
            if sphere in self._radius and other in self._hull:
                # Drake's iteration does not end where the centre is near a vertex.
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

    def _velocity_maps(self, q):
        if self._maps_known:
            return velocity_maps(q, self._plain, self._floating, self.n_v)
        N = self._plant.MakeVelocityToQDotMap(self._plant_context).toarray()
        return N, self._plant.MakeQDotToVelocityMap(self._plant_context).toarray()

    # Construction.

    def _check_model(self):
        plant = self._plant
        if plant.num_constraints() > 0:
            raise ValueError(
                f"the plant has {plant.num_constraints()} constraints, expected none "
                "(an LCS cannot hold them)"
            )
        for index in plant.GetJointActuatorIndices():
            actuator = plant.get_joint_actuator(index)
            if actuator.has_controller():
                raise ValueError(
                    f"actuator {actuator.name()} has a PD controller, expected none "
                    "(the LCS's u is effort)"
                )

    def _resolve(self, inspector, pairs, closest):
        """Names to geometries: fills what `_contact` reads."""
        plant = self._plant
        bodies, ambiguous = {}, set()
        collision = {}
        for i in range(plant.num_bodies()):
            body = plant.get_body(BodyIndex(i))
            geometries = plant.GetCollisionGeometriesForBody(body)
            bodies[body.scoped_name().get_full()] = geometries
            if body.name() in bodies:
                ambiguous.add(body.name())
            bodies[body.name()] = geometries
            for geometry in geometries:
                collision[inspector.GetName(geometry)] = geometry
        self._geometries: list[tuple[GeometryId, GeometryId]] = []
        self._pair_names: list[str] = []
        self._frames = {}
        self._radius: dict[GeometryId, float] = {}
        self._hull: dict[GeometryId, tuple[np.ndarray, np.ndarray]] = {}
        mu, compliance, kinds, reference, planar, pair_of = [], [], [], [], [], []
        groups: list[tuple[np.ndarray, int]] = []
        for number, pair in enumerate(pairs):
            a = _geometries_named(pair.a, bodies, ambiguous, collision)
            b = _geometries_named(pair.b, bodies, ambiguous, collision)
            name = f"{pair.a}~{pair.b}"
            if not (np.isfinite(pair.friction) and pair.friction >= 0.0):
                raise ValueError(
                    f"{name}: friction is {pair.friction}, expected at least 0"
                )
            if pair.friction_directions != int(pair.friction_directions) or not (
                pair.friction_directions >= 1
            ):
                raise ValueError(
                    f"{name}: friction_directions is {pair.friction_directions}, "
                    "expected an integer of at least 1"
                )
            tangent = _direction(f"{name}: tangent", pair.tangent)
            plane_normal = _direction(f"{name}: plane_normal", pair.plane_normal)
            in_plane = plane_normal.any()
            if in_plane and tangent.any():
                raise ValueError(
                    f"{name}: tangent and plane_normal came, expected one of them"
                )
            one_direction = pair.friction_directions == 1 and pair.friction > 0.0
            if one_direction and not (in_plane or tangent.any()):
                raise ValueError(
                    f"{name}: friction_directions is 1 without a direction, expected "
                    "a plane_normal (of a plant in a plane) or a tangent"
                )
            if not isinstance(pair.contact_model, (Anitescu, StewartTrinkle)):
                raise ValueError(
                    f"{name}: contact_model is {pair.contact_model!r}, expected "
                    "Anitescu() or StewartTrinkle()"
                )
            if pair.stiffness is not None and not 0.0 < pair.stiffness < np.inf:
                raise ValueError(
                    f"{name}: stiffness is {pair.stiffness}, expected a positive "
                    "number [N/m], or None for a rigid contact"
                )
            edges = friction_edges(int(pair.friction_directions))
            if in_plane:  # t1 follows the plane's normal, so the edges start at t2.
                edges = edges[:, ::-1] * [-1.0, 1.0]
            first = len(self._geometries)
            for one in a:
                for other in b:
                    # As in c3_reference: A is the geometry that was registered first.
                    id_A, id_B = sorted([one, other], key=lambda g: g.get_value())
                    if inspector.GetFrameId(id_A) == inspector.GetFrameId(id_B):
                        raise ValueError(f"{name}: both are on the same body")
                    self._geometries.append((id_A, id_B))
                    self._pair_names.append(
                        f"{inspector.GetName(id_A)}~{inspector.GetName(id_B)}"
                    )
                    mu.append(float(pair.friction))
                    pair_of.append(number)
                    compliance.append(
                        0.0 if pair.stiffness is None else 1.0 / pair.stiffness
                    )
                    anitescu = isinstance(pair.contact_model, Anitescu)
                    kinds.append(
                        (anitescu, edges, pair.friction > 0.0, compliance[-1] > 0.0)
                    )
                    reference.append(plane_normal if in_plane else tangent)
                    planar.append(in_plane)
            combinations = np.arange(first, len(self._geometries))
            count = combinations.size
            if pair.closest is not None:
                count = _how_many(f"{name}: closest", pair.closest, count)
            groups.append((combinations, count))
        for id in {id for ids in self._geometries for id in ids}:
            body = plant.GetBodyFromFrameId(inspector.GetFrameId(id))
            self._frames[id] = (body.body_frame(), inspector.GetPoseInFrame(id))
            shape = inspector.GetShape(id)
            if isinstance(shape, Sphere):
                self._radius[id] = shape.radius()
            elif isinstance(shape, (Mesh, Convex)):
                hull = inspector.GetConvexHull(id)
                faces = range(hull.num_faces())
                normals = np.array([hull.face_normal(f) for f in faces])
                on_face = [hull.vertex(hull.element(f).vertex(0)) for f in faces]
                offsets = np.einsum("fi,fi->f", normals, np.array(on_face))
                self._hull[id] = normals, offsets
        if not self._geometries:
            raise ValueError("no contact pairs came, expected at least one")
        if closest is not None:
            n = len(self._geometries)
            groups = [(np.arange(n), _how_many("closest", closest, n))]
            if any(pair.closest is not None for pair in pairs):
                raise ValueError(
                    "closest came for all pairs and for one of them, expected one of "
                    "the two"
                )
            self._check_alike(kinds)
        # None: every combination is a contact at every state.
        fixed = all(count == len(of_group) for of_group, count in groups)
        self._groups = None if fixed else groups
        # For compiled callers; None where friction differs within a group.
        self._groups_in_arrays = None
        if closest is None:
            self._groups_in_arrays = (
                np.concatenate([of_group for of_group, _ in groups]),
                np.cumsum([len(of_group) for of_group, _ in groups]),
                np.array([count for _, count in groups]),
            )
        self._mu, self._reference = np.array(mu), np.array(reference).reshape(-1, 3)
        self._compliance, self._planar = np.array(compliance), np.array(planar)
        self._pair_of, self._every = np.array(pair_of), np.arange(len(pair_of))
        self._without_friction = np.array([not (k[0] or k[2]) for k in kinds])
        self.n_pairs = len(pairs)
        slots = np.concatenate([of_group[:count] for of_group, count in groups])
        self._rows = contact_rows([kinds[i] for i in slots])
        self._weight = self._rows.weight(self._mu[slots])
        self._F_0 = self._rows.F_0(
            self._mu[slots], self._compliance[slots], self.dt_sec, self.eps_c
        )
        self.n_lam = len(self._rows.contact)
        names = [self._pair_names[i] for i in slots]
        if not fixed:
            names = [
                self._pair_names[of_group[k]]
                if count == len(of_group)
                else f"nearest {k} of {self._pair_names[of_group[0]]}..."
                for of_group, count in groups
                for k in range(count)
            ]
        self.lam_names = [
            f"{names[i]} {of_contact}"
            for i, of_contact in zip(self._rows.contact, self._rows.names, strict=True)
        ]

    def _check_alike(self, kinds):
        """Raises: ValueError unless one contact can take the other's rows."""
        first = kinds[0]
        for name, kind in zip(self._pair_names, kinds, strict=True):
            same_edges = np.array_equal(kind[1], first[1])
            if not (same_edges and kind[0] == first[0] and kind[2:] == first[2:]):
                raise ValueError(
                    f"closest: {name} and {self._pair_names[0]} differ in contact "
                    "model, friction directions or in having friction or stiffness, "
                    "expected one kind"
                )

    def _check_distances(self):
        query = self._query_port.Eval(self._plant_context)
        for i, (id_A, id_B) in enumerate(self._geometries):
            try:
                _, n, _, _ = self._distance(query, id_A, id_B)
            except RuntimeError as error:
                shapes = [
                    type(query.inspector().GetShape(g)).__name__ for g in (id_A, id_B)
                ]
                raise ValueError(
                    f"{self._pair_names[i]}: Drake has no signed distance of "
                    f"{shapes[0]} and {shapes[1]}, expected convex shapes (a "
                    "half-space only with a sphere)"
                ) from error
            self._check_plane(i, n)

    def _velocity_layout(self):
        """Where qdot = v, where quaternions are, and whether that is all there is."""
        plant, plain, floating, known = self._plant, [], [], True
        for index in plant.GetJointIndices():
            joint = plant.get_joint(index)
            q, v = joint.position_start(), joint.velocity_start()
            if joint.type_name() == "quaternion_floating":
                floating.append((q, v))
            elif joint.type_name() in ("prismatic", "revolute"):
                plain.append((q, v))
            else:
                known = known and joint.num_velocities() == 0
        as_pairs = [
            np.array(p, dtype=np.int64).reshape(-1, 2) for p in (plain, floating)
        ]
        return *as_pairs, known

    def _constant_mass_model(self, scene_graph):
        """The fast path's data; None where it does not apply: ConstantMassModel."""
        plant, inspector = self._plant, scene_graph.model_inspector()
        if plant.num_force_elements() != 1:  # Gravity is always there, and constant.
            return None
        floating_bodies = {}
        turning: list[tuple[int, int]] = []
        inertias: list[np.ndarray] = []
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        for joint in joints:
            if joint.type_name() == "quaternion_floating":
                child = joint.child_body()
                I_B = child.default_spatial_inertia()
                inertia = I_B.CalcRotationalInertia().CopyToFullMatrix3()
                at_origin = not I_B.get_com().any()
                unlike = np.abs(inertia - inertia[0, 0] * np.eye(3)).max()
                isotropic = unlike <= 1e-12 * inertia[0, 0]
                frames = joint.frame_on_parent(), joint.frame_on_child()
                if not (
                    frames[0] == plant.world_frame() and frames[1] == child.body_frame()
                ):
                    return None
                floating_bodies[child.index()] = joint
                if not (at_origin and isotropic):
                    turning.append((joint.position_start(), joint.velocity_start()))
                    centre, mass = I_B.get_com(), I_B.get_mass()
                    about = I_B.Shift(centre).CalcRotationalInertia()
                    inertias.append(
                        np.vstack([about.CopyToFullMatrix3(), centre, np.full(3, mass)])
                    )
            elif joint.type_name() not in ("prismatic", "weld"):
                return None
        if any(joint.parent_body().index() in floating_bodies for joint in joints):
            return None

        f, J_q, J_v, J_u, M = self._smooth(self.x_default, np.zeros(self.n_u))
        f_0 = f - J_v @ self.x_default[self.n_q :]
        ids = list(self._frames)
        rows: dict[str, list] = dict(shape=[], size=[], quaternion=[], omega=[])
        R, p_0, P, J_p = [], [], [], []
        for id in ids:
            shape = inspector.GetShape(id)
            frame, X_BG = self._frames[id]
            if isinstance(shape, Sphere):
                rows["shape"].append(SPHERE)
                rows["size"].append([shape.radius()] * 3)
            elif isinstance(shape, Box):
                rows["shape"].append(BOX)
                rows["size"].append([0.5 * length for length in np.array(shape.size())])
            elif isinstance(shape, Cylinder):
                rows["shape"].append(CYLINDER)
                half = 0.5 * shape.length()
                rows["size"].append([shape.radius(), half, half])
            elif isinstance(shape, HalfSpace):
                rows["shape"].append(HALF_SPACE)
                rows["size"].append([0.0] * 3)
            else:
                return None
            P_G, J_G = np.zeros((3, self.n_q)), np.zeros((3, self.n_v))
            joint = floating_bodies.get(frame.body().index())
            if joint is not None:
                rows["quaternion"].append(joint.position_start())
                rows["omega"].append(joint.velocity_start())
                X = X_BG
            else:
                rows["quaternion"].append(-1)
                rows["omega"].append(-1)
                X = frame.CalcPoseInWorld(self._plant_context) @ X_BG
                world = plant.world_frame()
                J_G = plant.CalcJacobianTranslationalVelocity(
                    self._plant_context, JacobianWrtVariable.kV, frame, np.zeros(3),
                    world, world,
                )  # fmt: skip
                P_G[:, self._plain[:, 0]] = J_G[:, self._plain[:, 1]]
            R.append(X.rotation().matrix())
            p_0.append(X.translation() - P_G @ self.x_default[: self.n_q])
            P.append(P_G)
            J_p.append(J_G)
        number = {id: i for i, id in enumerate(ids)}
        ab = [(number[a], number[b]) for a, b in self._geometries]
        if not all(SPHERE in (rows["shape"][a], rows["shape"][b]) for a, b in ab):
            return None

        def array(values, dtype=float):
            return np.ascontiguousarray(np.array(values, dtype=dtype))

        return ConstantMassModel(
            M_inv=array(np.linalg.inv(M)), f_0=array(f_0), J_v=array(J_v),
            J_u=array(J_u), plain=self._plain, floating=self._floating,
            turning=array(turning, np.int64).reshape(-1, 2),
            body=array(inertias).reshape(-1, 5, 3),
            shape=array(rows["shape"], np.int64), size=array(rows["size"]),
            quaternion=array(rows["quaternion"], np.int64),
            omega=array(rows["omega"], np.int64), R=array(R), p_0=array(p_0),
            P=array(P), J_p=array(J_p), pairs=array(ab, np.int64),
            reference=self._reference,
        )  # fmt: skip


@dataclass
class LcsBuilderConfig:
    contacts: list[ContactPair] = field(default_factory=list)
    dt_sec: float = 0.1  # Time step of the LCS [s].
    eps_c: float | None = None  # [m/s per N]; None: 0.01 dt_sec.
    period_sec: float = 0.0125  # Between two linearisations [s].
    offset_sec: float = 0.0  # Of the first one [s].
    closest: int | None = None  # So many contacts, the nearest of all; None: all.
    # 0: one LCS, about x. N: a tuple of N, one per knot along the plan at `plan`.
    knots: int = 0


class LcsBuilderStatus(IntEnum):
    """The `status` port of AnitescuLcsBuilder."""

    HELD = 0  # The last LCS: x or u was not usable.
    BUILT = 1
    # Some state of the plan was not usable; the LCS about x stands in for its knot.
    BUILT_IN_PART = 2


class AnitescuLcsBuilder(LeafSystem):
    """The LCS about the present state, held between updates.

    Inputs:  x (n_x,) state [q, v] of the model plant; u (n_u,) its actuation;
             friction (n_pairs,) of the pairs and gap (n_pairs,), added to their
             distances [m]: where they are not connected, all is as configured;
             plan (abstract, Plan), with config.knots > 0 only: the last plan, along
             which the LCS of all knots but the first are taken. Where there is none
             yet, all are about x.
    Outputs: lcs (abstract, LCS with dt and phi; with config.knots > 0 a tuple of
             them); status (1,): an LcsBuilderStatus.

    Before the first update: the LCS about the plant's default state with u = 0.

    Args: diagram, see AnitescuLcs; config.
    """

    def __init__(self, diagram, config: LcsBuilderConfig):
        super().__init__()
        c = config
        if c.knots != int(c.knots) or c.knots < 0:
            raise ValueError(
                f"LcsBuilderConfig.knots is {c.knots}, expected an integer of at least "
                "0"
            )
        self.model = AnitescuLcs(
            diagram, c.contacts, c.dt_sec, c.eps_c, closest=c.closest
        )
        initial = self.model.at_default()
        self._knots = int(c.knots)
        self._x = self.DeclareVectorInputPort("x", self.model.n_x)
        self._u = self.DeclareVectorInputPort("u", self.model.n_u)
        self._changes = [
            self.DeclareVectorInputPort(name, self.model.n_pairs)
            for name in ("friction", "gap")
        ]
        if self._knots:
            self._plan = self.DeclareAbstractInputPort(
                "plan", AbstractValue.Make(object())
            )
        self._lcs = self.DeclareAbstractState(
            Value[object]((initial,) * self._knots if self._knots else initial)
        )
        status: Any = [float(LcsBuilderStatus.BUILT)]  # The stubs know no list.
        self._status = self.DeclareDiscreteState(status)
        self.DeclareStateOutputPort("lcs", self._lcs)
        self.DeclareStateOutputPort("status", self._status)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            c.period_sec, c.offset_sec, self._update
        )

    @timed
    def _update(self, context, state):
        x, u = self._x.Eval(context), self._u.Eval(context)
        status = LcsBuilderStatus.BUILT
        try:
            lcs = self.model.build(x, u, *self._changed(context))
        except (ValueError, RuntimeError):
            status, lcs = LcsBuilderStatus.HELD, None
        if lcs is not None and self._knots:
            lcs, status = self._along_plan(context, lcs)
        if lcs is not None:
            state.get_mutable_abstract_state(int(self._lcs)).set_value(lcs)
        state.get_mutable_discrete_state(self._status).set_value([float(status)])

    def _changed(self, context):
        """friction and gap, of AnitescuLcs.build."""
        return (
            port.Eval(context) if port.HasValue(context) else None
            for port in self._changes
        )

    def _along_plan(self, context, first):
        """The LCS of all knots, the first given; and a status."""
        models, status = [first] * self._knots, LcsBuilderStatus.BUILT
        plan: Any = self._plan.Eval(context) if self._plan.HasValue(context) else None
        if not isinstance(plan, Plan) or plan.time is None:
            return tuple(models), status
        x, u = plan.at(
            context.get_time() + self.model.dt_sec * np.arange(1, self._knots)
        )
        changed = list(self._changed(context))
        for k in range(1, self._knots):
            try:
                models[k] = self.model.build(x[k - 1], u[k - 1], *changed)
            except (ValueError, RuntimeError):
                status = LcsBuilderStatus.BUILT_IN_PART
        return tuple(models), status


def _how_many(name, value, most) -> int:
    """An integer from 1 to most. Raises: ValueError."""
    if value != int(value) or not 1 <= value <= most:
        raise ValueError(
            f"{name} is {value}, expected an integer from 1 to {most}, the "
            "combinations of geometries"
        )
    return int(value)


def _direction(name, value) -> np.ndarray:
    """A unit vector (3,), or zero where none came. Raises: ValueError."""
    direction = np.array(value or [0.0, 0.0, 0.0], dtype=float)
    if direction.shape != (3,) or not np.isfinite(direction).all():
        raise ValueError(f"{name} is {value}, expected (3,)")
    length = np.linalg.norm(direction)
    return direction / length if length > 0.0 else direction


def _plant_and_scene_graph(diagram):
    if not isinstance(diagram, Diagram):
        raise ValueError(
            f"diagram is a {type(diagram).__name__}, expected the Diagram that holds "
            "the plant and its scene graph"
        )
    systems = diagram.GetSystems()
    plants = [s for s in systems if isinstance(s, MultibodyPlant)]
    graphs = [s for s in systems if isinstance(s, SceneGraph)]
    if len(plants) != 1 or len(graphs) != 1:
        raise ValueError(
            f"diagram holds {len(plants)} MultibodyPlants and {len(graphs)} "
            "SceneGraphs, expected one of each"
        )
    if not plants[0].is_finalized():
        raise ValueError("the plant is not finalized, expected plant.Finalize() before")
    return plants[0], graphs[0]


def _geometries_named(name, bodies, ambiguous, collision):
    if name in ambiguous:
        scoped = sorted(n for n in bodies if n.endswith(f"::{name}"))
        raise ValueError(f"body {name!r} is not unique, expected one of {scoped}")
    if name in bodies:
        if not bodies[name]:
            raise ValueError(f"body {name!r} has no collision geometry")
        return bodies[name]
    if name in collision:
        return [collision[name]]
    names = [*bodies, *collision]
    near = get_close_matches(name, names, n=3, cutoff=0.3) or sorted(names)
    raise ValueError(f"no body or geometry is named {name!r}; nearest: {near}")

"""Linear complementarity systems (LCS) of any MultibodyPlant with named contacts.

AnitescuLcs linearises a plant and its contacts about a state; AnitescuLcsBuilder is its
LeafSystem. The caller hands over a diagram of a plant and its scene graph, to which
nothing is added:

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
    """Convex contact: 2 n_f entries of lam. As an artefact of the relaxation, a sliding
    contact opens by dt mu |v_t|."""


@dataclass
class StewartTrinkle:
    """Polyhedral friction cone: 2 n_f + 2 entries of lam, which are the normal force,
    2 n_f friction forces and the sliding speed; without friction only the first."""


@dataclass
class ContactPair:
    """Two bodies or collision geometries that may touch.

    A body is named "model::body", or "body" where that is unique; a geometry by its
    name in the scene graph ("ball::ball_collision"). A body stands for all of its
    collision geometries: every combination of two geometries is a contact of its own,
    unless `closest` limits them to the nearest ones.
    """

    a: str = ""
    b: str = ""
    friction: float = 1.0  # Coulomb coefficient mu.
    friction_directions: int = 2  # n_f; 2 n_f friction edges, so 2 n_f forces.
    # World direction (3,) onto whose projection the first friction edge is aligned;
    # empty: the basis of Drake's MakeFromOneVector, which jumps as the normal turns.
    tangent: list[float] = field(default_factory=list)
    # For a plant that moves in a plane: the plane's normal in the world (3,). The first
    # edge is then in the plane; with friction_directions = 1 both edges are.
    plane_normal: list[float] = field(default_factory=list)
    # In YAML `contact_model: !StewartTrinkle {}`.
    contact_model: Anitescu | StewartTrinkle = field(default_factory=Anitescu)
    # Normal force over penetration [N/m], without damping; None: rigid, but for eps_c.
    stiffness: float | None = None
    # Number of contacts, the nearest combinations of geometries; None: all.
    closest: int | None = None


class AnitescuLcs:
    """Builds the LCS of a plant's contacts about any state (ACI-MPC eq. 5-8).

    Args:
        diagram: holds one finalized MultibodyPlant connected to a SceneGraph.
        pairs: the contacts; their order is the order of the forces.
        dt_sec: time step [s].
        eps_c: regularisation on F's diagonal, for lam in newtons [m/s per N]; None:
            0.01 dt_sec, which is the paper's 0.01 for lam as an impulse. It is not
            added to the normal force of a pair that has a stiffness.
        closest: number of contacts over all pairs, the nearest combinations of
            geometries at each state; None: all. The pairs must then have the same kind
            of contact.
        analytic: whether the fast path is used where the model allows it.

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

        # Scratch memory, which every method sets before it reads it.
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
        self.at_default()  # Compile now, and fail now if anything is wrong.

    def at_default(self) -> LCS:
        """The LCS about the plant's default state, without input."""
        return self.build(self.x_default, np.zeros(self.n_u))

    def build(self, x, u, friction=None, gap=None) -> LCS:
        """The LCS about the state x = [q, v] (n_x,) and the input u (n_u,).

        Quaternions in x are normalised first; the LCS's d and c refer to the
        normalised state.

        Args: friction (n_pairs,): coefficient of each pair; None: as configured;
            gap (n_pairs,) [m]: added to the distances of each pair; None: zero.
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
        """(n_contacts,) friction of each contact, from that of the pairs (n_pairs,)."""
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
        """The LCS with gap (n_pairs,) [m] added to its contacts' distances."""
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
        """Friction weights and F_0 of the rows, for the contacts `chosen` with the
        friction mu (n_contacts,)."""
        if mu is self._mu and chosen is self._every:
            return self._weight, self._F_0
        mu, compliance = mu[chosen], self._compliance[chosen]
        F_0 = self._rows.F_0(mu, compliance, self.dt_sec, self.eps_c)
        return self._rows.weight(mu), F_0

    # The general path: smooth dynamics by AutoDiff, contacts from Drake's queries.

    def _build_general(self, x, u, mu):
        f, J_q, J_v, J_u, M = self._smooth(x, u)
        phi, J_n, J_c, F_0, chosen = self._contact(mu)
        N, N_plus = self._velocity_maps(x[: self.n_q])
        return assemble_lcs(
            x, f, J_q, J_v, J_u, u, M, N, N_plus, phi, J_n, J_c, self._rows.contact,
            self._rows.normal, F_0, self.dt_sec, chosen,
        )  # fmt: skip

    def _smooth(self, x, u):
        """f(x, u), its derivatives by q, v and u, and M; sets the plant's context to x.

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
        """phi, J_n, J_c and F_0 at the state of the plant's context, for the friction
        mu (n_contacts,), and the indices of the contacts chosen."""
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
        """Finds the geometries of the pairs, and lays out the contacts and rows."""
        contacts, groups = _contacts_of(pairs, _NamedGeometries(self._plant, inspector))
        if not contacts:
            raise ValueError("no contact pairs came, expected at least one")
        self.n_pairs = len(pairs)
        self._geometries = [contact.geometries for contact in contacts]
        self._pair_names = [contact.name for contact in contacts]
        if closest is not None:
            n = len(contacts)
            groups = [(np.arange(n), _how_many("closest", closest, n))]
            if any(pair.closest is not None for pair in pairs):
                raise ValueError(
                    "closest came for all pairs and for one of them, expected one of "
                    "the two"
                )
            _check_alike(contacts)
        self._read_shapes(inspector)
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
        self._mu = np.array([contact.mu for contact in contacts])
        self._compliance = np.array([contact.compliance for contact in contacts])
        self._reference = np.array([contact.reference for contact in contacts])
        self._planar = np.array([contact.planar for contact in contacts])
        self._pair_of = np.array([contact.pair for contact in contacts])
        self._every = np.arange(len(contacts))
        self._without_friction = np.array(
            [not (contact.anitescu or contact.mu > 0.0) for contact in contacts]
        )
        slots = np.concatenate([of_group[:count] for of_group, count in groups])
        self._rows = contact_rows([contacts[i].kind for i in slots])
        self._weight = self._rows.weight(self._mu[slots])
        self._F_0 = self._rows.F_0(
            self._mu[slots], self._compliance[slots], self.dt_sec, self.eps_c
        )
        self.n_lam = len(self._rows.contact)
        self.lam_names = self._names_of_rows(slots, groups)

    def _read_shapes(self, inspector):
        """Frame and pose of each geometry; radii of spheres and faces of hulls."""
        self._frames = {}
        self._radius: dict[GeometryId, float] = {}
        self._hull: dict[GeometryId, tuple[np.ndarray, np.ndarray]] = {}
        for id in {id for ids in self._geometries for id in ids}:
            body = self._plant.GetBodyFromFrameId(inspector.GetFrameId(id))
            self._frames[id] = (body.body_frame(), inspector.GetPoseInFrame(id))
            shape = inspector.GetShape(id)
            if isinstance(shape, Sphere):
                self._radius[id] = shape.radius()
            elif isinstance(shape, (Mesh, Convex)):
                self._hull[id] = _hull_faces(inspector.GetConvexHull(id))

    def _names_of_rows(self, slots, groups):
        names = [self._pair_names[i] for i in slots]
        if self._groups is not None:
            names = [
                self._pair_names[of_group[k]]
                if count == len(of_group)
                else f"nearest {k} of {self._pair_names[of_group[0]]}..."
                for of_group, count in groups
                for k in range(count)
            ]
        return [
            f"{names[i]} {of_contact}"
            for i, of_contact in zip(self._rows.contact, self._rows.names, strict=True)
        ]

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
        """(index in q, index in v) of coordinates with qdot = v, and of the start of
        floating joints; whether these are all coordinates of the plant."""
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
        """The data of the fast path; None where it does not apply (ConstantMassModel):
        other joints than floating, prismatic and weld, bodies on floating ones, other
        force elements than gravity, shapes without a closed-form distance."""
        plant, inspector = self._plant, scene_graph.model_inspector()
        if plant.num_force_elements() != 1:  # Gravity is always there, and constant.
            return None
        floating = self._floating_joints()
        if floating is None:
            return None
        joint_of, turning, inertias = floating
        ids = list(self._frames)
        shapes = []
        for id in ids:
            shape = _shape_and_size(inspector.GetShape(id))
            if shape is None:
                return None
            shapes.append(shape)
        number = {id: i for i, id in enumerate(ids)}
        pairs = [(number[a], number[b]) for a, b in self._geometries]
        if not all(SPHERE in (shapes[a][0], shapes[b][0]) for a, b in pairs):
            return None

        f, J_q, J_v, J_u, M = self._smooth(self.x_default, np.zeros(self.n_u))
        f_0 = f - J_v @ self.x_default[self.n_q :]
        joints = [joint_of.get(self._frames[id][0].body().index()) for id in ids]
        q_of = [-1 if joint is None else joint.position_start() for joint in joints]
        v_of = [-1 if joint is None else joint.velocity_start() for joint in joints]
        R, p_0, P, J_p = zip(
            *(
                self._geometry_motion(*self._frames[id], joint is not None)
                for id, joint in zip(ids, joints, strict=True)
            ),
            strict=True,
        )

        def array(values, dtype=float):
            return np.ascontiguousarray(np.array(values, dtype=dtype))

        return ConstantMassModel(
            M_inv=array(np.linalg.inv(M)), f_0=array(f_0), J_v=array(J_v),
            J_u=array(J_u), plain=self._plain, floating=self._floating,
            turning=array(turning, np.int64).reshape(-1, 2),
            body=array(inertias).reshape(-1, 5, 3),
            shape=array([shape for shape, _ in shapes], np.int64),
            size=array([size for _, size in shapes]),
            quaternion=array(q_of, np.int64), omega=array(v_of, np.int64),
            R=array(R), p_0=array(p_0), P=array(P), J_p=array(J_p),
            pairs=array(pairs, np.int64), reference=self._reference,
        )  # fmt: skip

    def _floating_joints(self):
        """{body index: its floating joint}; (q, v) and (5, 3) inertia of the bodies
        whose angular acceleration depends on the state (not isotropic about their
        origin). None where a joint rules out the fast path."""
        plant = self._plant
        joint_of, turning, inertias = {}, [], []
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
                joint_of[child.index()] = joint
                if not (at_origin and isotropic):
                    turning.append((joint.position_start(), joint.velocity_start()))
                    centre, mass = I_B.get_com(), I_B.get_mass()
                    about = I_B.Shift(centre).CalcRotationalInertia()
                    inertias.append(
                        np.vstack([about.CopyToFullMatrix3(), centre, np.full(3, mass)])
                    )
            elif joint.type_name() not in ("prismatic", "weld"):
                return None
        if any(joint.parent_body().index() in joint_of for joint in joints):
            return None
        return joint_of, turning, inertias

    def _geometry_motion(self, frame, X_BG, floats):
        """R (3, 3) and p_0 (3,) of a geometry, P (3, n_q) and J_p (3, n_v).

        On a floating body its pose in the body, P and J_p zero. Otherwise R is its
        rotation in the world, its position is p_0 + P q, and its velocity J_p v.
        """
        P, J_p = np.zeros((3, self.n_q)), np.zeros((3, self.n_v))
        X = X_BG
        if not floats:
            X = frame.CalcPoseInWorld(self._plant_context) @ X_BG
            world = self._plant.world_frame()
            J_p = self._plant.CalcJacobianTranslationalVelocity(
                self._plant_context, JacobianWrtVariable.kV, frame, np.zeros(3),
                world, world,
            )  # fmt: skip
            P[:, self._plain[:, 0]] = J_p[:, self._plain[:, 1]]
        p_0 = X.translation() - P @ self.x_default[: self.n_q]
        return X.rotation().matrix(), p_0, P, J_p


@dataclass
class LcsBuilderConfig:
    contacts: list[ContactPair] = field(default_factory=list)
    dt_sec: float = 0.1  # Time step of the LCS [s].
    eps_c: float | None = None  # [m/s per N]; None: 0.01 dt_sec.
    period_sec: float = 0.0125  # Between two linearisations [s].
    offset_sec: float = 0.0  # Time of the first one [s].
    closest: int | None = None  # Number of contacts, the nearest ones; None: all.
    # 0: one LCS about x. N: a tuple of N, one for each knot along the input `plan`.
    knots: int = 0


class LcsBuilderStatus(IntEnum):
    """Values of the `status` port of AnitescuLcsBuilder."""

    HELD = 0  # The last LCS is held, as x or u is not usable.
    BUILT = 1
    # Some states of the plan are not usable; their knots have the LCS about x.
    BUILT_IN_PART = 2


class AnitescuLcsBuilder(LeafSystem):
    """The LCS about the present state, held between updates.

    Inputs:  x (n_x,) state [q, v] of the model plant; u (n_u,) its actuation;
             friction (n_pairs,) of the pairs, optional; gap (n_pairs,) added to their
             distances [m], optional;
             plan (abstract, Plan), with config.knots > 0 only: the last plan, about
             whose states the LCS of all knots but the first are built. Before the
             first plan, all are about x.
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
        status: Any = [float(LcsBuilderStatus.BUILT)]  # The stubs expect an array.
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
        """The arguments friction and gap of AnitescuLcs.build."""
        return (
            port.Eval(context) if port.HasValue(context) else None
            for port in self._changes
        )

    def _along_plan(self, context, first):
        """The LCS of all knots, with `first` at the first one, and a status."""
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


class _NamedGeometries:
    """The collision geometries of a plant by the names of bodies and geometries."""

    def __init__(self, plant: MultibodyPlant, inspector):
        self.inspector = inspector
        self._of_body: dict[str, list[GeometryId]] = {}
        self._by_name: dict[str, GeometryId] = {}
        self._ambiguous = set()
        for i in range(plant.num_bodies()):
            body = plant.get_body(BodyIndex(i))
            geometries = plant.GetCollisionGeometriesForBody(body)
            self._of_body[body.scoped_name().get_full()] = geometries
            if body.name() in self._of_body:
                self._ambiguous.add(body.name())
            self._of_body[body.name()] = geometries
            for geometry in geometries:
                self._by_name[inspector.GetName(geometry)] = geometry

    def find(self, name: str) -> list[GeometryId]:
        """Those of a body, or the one of that name. Raises: ValueError."""
        if name in self._ambiguous:
            scoped = sorted(n for n in self._of_body if n.endswith(f"::{name}"))
            raise ValueError(f"body {name!r} is not unique, expected one of {scoped}")
        if name in self._of_body:
            if not self._of_body[name]:
                raise ValueError(f"body {name!r} has no collision geometry")
            return self._of_body[name]
        if name in self._by_name:
            return [self._by_name[name]]
        names = [*self._of_body, *self._by_name]
        near = get_close_matches(name, names, n=3, cutoff=0.3) or sorted(names)
        raise ValueError(f"no body or geometry is named {name!r}; nearest: {near}")


@dataclass
class _Contact:
    """One combination of two geometries of a pair."""

    geometries: tuple[GeometryId, GeometryId]  # The one registered first is A.
    name: str
    pair: int  # Number of its pair.
    mu: float
    compliance: float  # [m/N]
    anitescu: bool
    edges: np.ndarray  # (2 n_f, 2), friction_edges.
    reference: np.ndarray  # (3,) for tangent_basis.
    planar: bool  # Whether `reference` is the normal of the plant's plane.

    @property
    def kind(self) -> tuple:
        """What decides the contact's rows: contact_rows."""
        return self.anitescu, self.edges, self.mu > 0.0, self.compliance > 0.0


def _contacts_of(pairs, named: _NamedGeometries):
    """All contacts, and of each pair (numbers of its contacts, how many of them count).

    Raises: ValueError that names the pair and what is wrong.
    """
    contacts: list[_Contact] = []
    groups: list[tuple[np.ndarray, int]] = []
    inspector = named.inspector
    for number, pair in enumerate(pairs):
        of_a, of_b = named.find(pair.a), named.find(pair.b)
        name = f"{pair.a}~{pair.b}"
        reference, planar = _check_pair(name, pair)
        edges = friction_edges(int(pair.friction_directions))
        if planar:  # t1 follows the plane's normal, so the edges start at t2.
            edges = edges[:, ::-1] * [-1.0, 1.0]
        first = len(contacts)
        for one in of_a:
            for other in of_b:
                # As in c3_reference: A is the geometry that was registered first.
                id_A, id_B = sorted([one, other], key=lambda g: g.get_value())
                if inspector.GetFrameId(id_A) == inspector.GetFrameId(id_B):
                    raise ValueError(f"{name}: both are on the same body")
                contacts.append(
                    _Contact(
                        geometries=(id_A, id_B),
                        name=f"{inspector.GetName(id_A)}~{inspector.GetName(id_B)}",
                        pair=number,
                        mu=float(pair.friction),
                        compliance=0.0
                        if pair.stiffness is None
                        else 1.0 / pair.stiffness,
                        anitescu=isinstance(pair.contact_model, Anitescu),
                        edges=edges,
                        reference=reference,
                        planar=planar,
                    )
                )
        combinations = np.arange(first, len(contacts))
        count = combinations.size
        if pair.closest is not None:
            count = _how_many(f"{name}: closest", pair.closest, count)
        groups.append((combinations, count))
    return contacts, groups


def _check_pair(name: str, pair: ContactPair) -> tuple[np.ndarray, bool]:
    """The pair's reference direction (3,) and whether it is a plane's normal.

    Raises: ValueError for a parameter out of range.
    """
    if not (np.isfinite(pair.friction) and pair.friction >= 0.0):
        raise ValueError(f"{name}: friction is {pair.friction}, expected at least 0")
    if pair.friction_directions != int(pair.friction_directions) or not (
        pair.friction_directions >= 1
    ):
        raise ValueError(
            f"{name}: friction_directions is {pair.friction_directions}, "
            "expected an integer of at least 1"
        )
    tangent = _direction(f"{name}: tangent", pair.tangent)
    plane_normal = _direction(f"{name}: plane_normal", pair.plane_normal)
    planar = bool(plane_normal.any())
    if planar and tangent.any():
        raise ValueError(f"{name}: tangent and plane_normal came, expected one of them")
    one_direction = pair.friction_directions == 1 and pair.friction > 0.0
    if one_direction and not (planar or tangent.any()):
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
    return (plane_normal if planar else tangent), planar


def _check_alike(contacts) -> None:
    """Raises: ValueError unless each contact can take any other's rows."""
    first = contacts[0].kind
    for contact in contacts:
        kind = contact.kind
        same_edges = np.array_equal(kind[1], first[1])
        if not (same_edges and kind[0] == first[0] and kind[2:] == first[2:]):
            raise ValueError(
                f"closest: {contact.name} and {contacts[0].name} differ in contact "
                "model, friction directions or in having friction or stiffness, "
                "expected one kind"
            )


def _hull_faces(hull) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals (n, 3) of a hull's faces, and their offsets (n,) [m]."""
    faces = range(hull.num_faces())
    normals = np.array([hull.face_normal(f) for f in faces])
    on_face = [hull.vertex(hull.element(f).vertex(0)) for f in faces]
    return normals, np.einsum("fi,fi->f", normals, np.array(on_face))


def _shape_and_size(shape) -> tuple[int, list[float]] | None:
    """A shape of ConstantMassModel: its number and size (3,) [m]; None: no such."""
    if isinstance(shape, Sphere):
        return SPHERE, [shape.radius()] * 3
    if isinstance(shape, Box):
        return BOX, [0.5 * length for length in np.array(shape.size())]
    if isinstance(shape, Cylinder):
        half = 0.5 * shape.length()
        return CYLINDER, [shape.radius(), half, half]
    if isinstance(shape, HalfSpace):
        return HALF_SPACE, [0.0] * 3
    return None


def _how_many(name, value, most) -> int:
    """The value as an integer from 1 to `most`. Raises: ValueError."""
    if value != int(value) or not 1 <= value <= most:
        raise ValueError(
            f"{name} is {value}, expected an integer from 1 to {most}, the "
            "combinations of geometries"
        )
    return int(value)


def _direction(name, value) -> np.ndarray:
    """The value as a unit vector (3,), or zeros if it is empty. Raises: ValueError."""
    direction = np.array(value or [0.0, 0.0, 0.0], dtype=float)
    if direction.shape != (3,) or not np.isfinite(direction).all():
        raise ValueError(f"{name} is {value}, expected (3,)")
    length = np.linalg.norm(direction)
    return direction / length if length > 0.0 else direction


def _plant_and_scene_graph(diagram):
    """The one plant and scene graph of a diagram. Raises: ValueError."""
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

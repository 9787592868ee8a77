"""The LCS of any MultibodyPlant with named contacts, about any state.

The caller hands over a diagram of a plant and its scene graph, to which nothing is
added:

    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    Parser(plant).AddModels("ball_on_table.sdf")
    plant.Finalize()
    lcs = AnitescuLcs(builder.Build(), [ContactPair("finger_link", "ball_link", 0.5)])

See docs/lcs.md for the state's layout, quaternions, units and limits.
"""

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram

from makebreak.systems.contact_mpc.multibody.constant_mass import (
    constant_mass_model,
    with_masses,
)
from makebreak.systems.contact_mpc.multibody.contact_layout import ContactLayout
from makebreak.systems.contact_mpc.multibody.model_parameters import (
    NOT_IN_PLANTS,
    ModelParameters,
)
from makebreak.systems.contact_mpc.multibody.smooth_dynamics import SmoothDynamics
from makebreak.systems.contact_mpc.multibody.witness_points import WitnessPoints
from makebreak.systems.contact_mpc.numerics.constant_mass import (
    ConstantMassModel,
    build_many_constant_mass,
)
from makebreak.systems.contact_mpc.numerics.contact_rows import tangent_basis
from makebreak.systems.contact_mpc.numerics.lcs import LCS, is_finite
from makebreak.systems.contact_mpc.numerics.lcs_builder import assemble_lcs

_LCS_FIELDS = ("A", "B", "D", "d", "E", "F", "H", "c", "phi")


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
        parameters: those that `build` may be given values of (Parameter).

    Attributes:
        n_q, n_v, n_x, n_u, n_lam, n_pairs: sizes; x = [q, v] in the plant's order.
        x_default: (n_x,) the plant's default state.
        x_names, lam_names: of each state, and of each entry of lam, "geometry~geometry
            edge" (where the nearest are taken: "nearest k of geometry~... edge").
        is_analytic: which of the two paths `build` takes; with parameters that Drake's
            plants do not have the general one.
        parameters: their names and nominal values (ModelParameters).

    Raises: ValueError naming a pair that does not exist, a body without collision
        geometry, shapes without a distance, or a parameter out of range.
    """

    def __init__(
        self,
        diagram,
        pairs,
        dt_sec=0.1,
        eps_c=None,
        analytic=True,
        closest=None,
        parameters=(),
    ):
        self._plant, scene_graph = _plant_and_scene_graph(diagram)
        plant, inspector = self._plant, scene_graph.model_inspector()
        if not (np.isfinite(dt_sec) and dt_sec > 0.0):
            raise ValueError(f"dt_sec is {dt_sec}, expected a positive time [s]")
        self.dt_sec = float(dt_sec)
        self.eps_c = 0.01 * self.dt_sec if eps_c is None else float(eps_c)
        if not (np.isfinite(self.eps_c) and self.eps_c >= 0.0):
            raise ValueError(f"eps_c is {eps_c}, expected at least 0 [m/s per N]")
        self.n_q, self.n_v = plant.num_positions(), plant.num_velocities()
        self.n_x, self.n_u = self.n_q + self.n_v, plant.num_actuated_dofs()
        self.x_names = list(plant.GetStateNames())

        # Scratch memory, which every method sets before it reads it.
        self._context = diagram.CreateDefaultContext()
        self._plant_context = plant.GetMyContextFromRoot(self._context)
        self.x_default = plant.GetPositionsAndVelocities(self._plant_context).copy()
        self._dynamics = SmoothDynamics(plant, self._plant_context)
        self._contacts = ContactLayout(
            list(pairs), plant, inspector, closest, self.dt_sec, self.eps_c
        )
        self.n_pairs, self.n_lam = self._contacts.n_pairs, self._contacts.n_lam
        self.lam_names = self._contacts.lam_names
        self._points = WitnessPoints(plant, inspector, self._contacts)
        self._points.check(self._plant_context)
        self.parameters = ModelParameters(
            parameters, plant, self._plant_context, self._contacts.mu_of_pairs
        )
        self._values = self.parameters.nominal
        self.is_analytic = False
        self._inspector = inspector
        self._model = None
        if analytic and not self.parameters.has(*NOT_IN_PLANTS):
            self._model = self._closed_form()
        self.is_analytic = self._model is not None
        self.at_default()  # Compile now, and fail now if anything is wrong.

    def _closed_form(self, last=None) -> ConstantMassModel | None:
        """Args: last: the model with other values of the parameters; None: there is
        none."""
        plant, context = self._plant, self._plant_context
        plant.SetPositionsAndVelocities(context, self.x_default)
        if last is not None and not self.parameters.has("damping"):
            return with_masses(last, plant, context, self._dynamics)
        return constant_mass_model(
            plant, context, self._inspector, self._dynamics, self._contacts,
            self._points.frames,
        )  # fmt: skip

    def at_default(self) -> LCS:
        """The LCS about the plant's default state, without input."""
        return self.build(self.x_default, np.zeros(self.n_u))

    def build(self, x, u, friction=None, gap=None, parameters=None) -> LCS:
        """The LCS about the state x = [q, v] (n_x,) and the input u (n_u,).

        Quaternions in x are normalised first; the LCS's d and c refer to the
        normalised state.

        Args: friction (n_pairs,): coefficient of each pair; None: as configured;
            gap (n_pairs,) [m]: added to the distances of each pair; None: zero;
            parameters (n,): values of all parameters, in their order and units; None:
            the nominal ones.
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
        for start, _ in self._dynamics.floating:
            norm = np.linalg.norm(x[start : start + 4])
            if not 0.5 <= norm <= 2.0:
                raise ValueError(
                    f"the quaternion x[{start}:{start + 4}] has norm {norm:.3g}, "
                    "expected 1"
                )
            x[start : start + 4] /= norm
        contacts = self._contacts
        if len(self.parameters):
            friction, gap = self._use(parameters, friction, gap)
        elif parameters is not None and np.size(parameters):
            raise ValueError(
                f"{np.size(parameters)} parameters came, expected none: AnitescuLcs "
                "was made without"
            )
        mu = contacts.mu if friction is None else contacts.friction_of(friction)
        if self._model is None:
            lcs = self._build_general(x, u, mu)
        else:
            lcs = self._build_analytic(self._model, x, u, mu)
        return lcs if gap is None else contacts.with_gap(lcs, gap)

    def _use(self, values, friction, gap):
        """Sets the parameters' values; returns the pairs' friction and gaps."""
        p = self.parameters
        values = p.nominal if values is None else np.array(values, dtype=float)
        if values.shape != p.nominal.shape or not is_finite(values):
            raise ValueError(
                f"parameters is {values}, expected ({len(p)},), finite: {p.names}"
            )
        if not np.array_equal(values[p.is_dynamic], self._values[p.is_dynamic]):
            self._dynamics.set_parameters(p, values)
            if self.is_analytic:
                self._model = self._closed_form(self._model)
        self._values = values
        if friction is None:
            friction = self._contacts.mu_of_pairs
        gap = np.zeros(self.n_pairs) if gap is None else gap
        friction = p.of_pairs("friction", values, friction)
        return friction, p.of_pairs("gap", values, gap)

    def with_gaps(self, lcs: LCS, parameters) -> LCS:
        """An LCS of this model whose gaps are not yet those of the parameters (n,)."""
        gap = self.parameters.of_pairs("gap", parameters, np.zeros(self.n_pairs))
        return self._contacts.with_gap(lcs, gap) if gap.any() else lcs

    def of_rows(self, lcs: LCS, of_pairs) -> np.ndarray:
        """(n_lam,) of each row of an LCS, what (n_pairs,) of its pair is."""
        return self._contacts.of_contacts(of_pairs)[np.asarray(lcs.contact, dtype=int)]

    def sticks(self, lcs: LCS, slips) -> np.ndarray:
        """(n,) whether a parameter is the friction of pairs of which none slips.

        Args: slips (n_lam,) bool, of the LCS's rows.
        """
        slipping = set(self.of_rows(lcs, np.arange(self.n_pairs))[slips])
        return np.array([
            p.kind == "friction" and not slipping & set(p.pairs)
            for p in self.parameters.items
        ])  # fmt: skip

    def between(self, x, x_next) -> tuple[np.ndarray, np.ndarray]:
        """The constant velocity (n_v,) that leads from x to x_next, both (n_x,), in one
        time step, and the mass matrix (n_v, n_v) half-way."""
        q, q_next = x[: self.n_q], x_next[: self.n_q]
        middle = 0.5 * (q + q_next)
        self._plant.SetPositions(self._plant_context, middle)
        _, N_plus = self._dynamics.velocity_maps(middle)
        M = self._plant.CalcMassMatrix(self._plant_context)
        return N_plus @ (q_next - q) / self.dt_sec, M

    def normals_beside(self, x, ways) -> np.ndarray:
        """(m, n_lam, 2) parts along the tangents of each row's contact at x (n_x,) of
        its normal after a second of each of the velocities ways (m, n_v). The tangents
        are those of the friction edges, in a plane t2 and -t1."""
        plant, context, layout = self._plant, self._plant_context, self._contacts
        q, found = x[: self.n_q], []
        plant.SetPositions(context, q)
        N, _ = self._dynamics.velocity_maps(q)
        for way in (np.zeros(self.n_v), *ways):
            plant.SetPositions(context, q + N @ way)
            found.append(self._points.normals(context))
        (n, chosen), *beside = found
        basis = np.array(list(map(tangent_basis, n, layout.reference[chosen])))
        parts = np.einsum("nik,mnk->mni", basis, [normal for normal, _ in beside])
        planar = np.asarray(layout.planar)[chosen, None]
        parts = np.where(planar, parts[..., ::-1] * [1.0, -1.0], parts)
        return parts[:, layout.rows.contact]

    def unknown_rolling(self, sample, lcs: LCS, lam, most, variance):
        """What is not known of a step, as pairs may rest in it that resist rolling.

        A pair rests if it rolls at either end of the step within two deviations of
        none, or of what the resistance stops; its torque may be any up to that.

        Args: sample: of the step, with which lcs was built; lam (n_lam,) [N]; most
            (n,): of the parameters, the largest that is believed; variance (n_v,) of
            the measured velocities.
        Returns: (n_v, n_v) covariance of the change of velocity, and (n,) whether a
            parameter is the resistance of pairs of which one rests.
        """
        p, n_v, dt = self.parameters, self.n_v, self.dt_sec
        covariance, resting = np.zeros((n_v, n_v)), set()
        if not p.has("rolling"):
            return covariance, np.zeros(len(p), bool)
        lever = p.of_pairs("rolling", most, np.zeros(self.n_pairs))
        lever, contact = self.of_rows(lcs, lever), np.asarray(lcs.contact, dtype=int)
        pair = self.of_rows(lcs, np.arange(self.n_pairs))
        self._plant.SetPositions(self._plant_context, sample.x[: self.n_q])
        for one in np.unique(contact[lever > 0.0]):
            mine = contact == one
            J = self._points.rolling(self._plant_context, one)
            torque = lever[mine][0] * lam[mine].sum() * J
            change = dt * np.linalg.solve(sample.M, torque.T)
            now, after = J @ sample.x_now[-n_v:], J @ sample.x_next[-n_v:]
            along = now + after
            along = along / max(np.linalg.norm(along), 1e-300)
            noise = (J**2 @ variance).max()
            stopped = np.linalg.norm(J @ change, 2)
            if min(now @ along, after @ along) <= 2.0 * np.sqrt(noise) + stopped:
                covariance += change @ change.T
                resting.add(pair[mine][0])
        return covariance, np.array([
            p.kind == "rolling" and bool(resting & set(p.pairs)) for p in p.items
        ])  # fmt: skip

    def step_changes(self, x, u, lcs: LCS, lam, parameters):
        """How a step changes with the parameters of bodies and joints, at the forces
        lam (n_lam,) [N].

        Args: x, u, parameters: what `lcs` was built with.
        Returns: of x_next (n_x, n) and of the gap velocities w (n_lam, n), zero for
            parameters of pairs. M f = tau - r and M dv = dt J' lam have the same
            derivative as the torque of the whole step's acceleration.
        """
        p, dt, n_q = self.parameters, self.dt_sec, self.n_q
        x_next = lcs.A @ x + lcs.B @ u + lcs.D @ lam + lcs.d
        dx = np.zeros((self.n_x, len(p)))
        plant, context = self._plant, self._plant_context
        plant.SetPositionsAndVelocities(context, x)
        torque = p.torque_changes(context, parameters, (x_next - x)[n_q:] / dt, dt)
        dv = -dt * np.linalg.solve(plant.CalcMassMatrix(context), torque)
        N, _ = self._dynamics.velocity_maps(x[:n_q])
        dx[n_q:], dx[:n_q] = dv, dt * (N @ dv)
        return dx, np.asarray(lcs.J) @ dv

    def _build_analytic(self, model: ConstantMassModel, x, u, mu) -> LCS:
        contacts, chosen = self._contacts, None
        if contacts.chooses:
            chosen = contacts.nearest(model.gaps(x[: self.n_q]))
        weight, F_0 = contacts.rows_of(contacts.every if chosen is None else chosen, mu)
        return model.build(x, u, self.dt_sec, contacts.rows, weight, F_0, chosen)

    def _build_general(self, x, u, mu) -> LCS:
        """Smooth dynamics by AutoDiff, contacts from Drake's distance queries."""
        rows = self._contacts.rows
        p, context = self.parameters, self._plant_context

        def further(M):
            return p.further_forces(context, self._values, M, self.dt_sec)

        # Sets the context to x.
        f, J_q, J_v, J_u, M = self._dynamics.linearise(x, u, further if p else None)
        phi, J, chosen = self._points.jacobians(self._plant_context)
        weight, F_0 = self._contacts.rows_of(chosen, mu)
        J_n, on = J[:, 0], rows.contact
        J_t = (rows.edge[:, :, None] * J[on, 1:]).sum(axis=1)
        J_c = rows.normal[:, None] * J[on, 0] + weight[:, None] * J_t
        N, N_plus = self._dynamics.velocity_maps(x[: self.n_q])
        J_push = None
        if p.has("rolling"):
            lever = p.of_pairs("rolling", self._values, np.zeros(self.n_pairs))
            lever = self._contacts.of_contacts(lever)[chosen]
            against = self._points.against_rolling(
                self._plant_context, chosen, lever, J_n, M, self.dt_sec
            )
            J_push = J_c - rows.normal[:, None] * against[on]
        return assemble_lcs(
            x, f, J_q, J_v, J_u, u, M, N, N_plus, phi, J_n, J_c, rows.contact,
            rows.normal, F_0, self.dt_sec, chosen, J_push,
        )  # fmt: skip

    def build_many(self, x, u, parameters=None) -> tuple[np.ndarray, ...]:
        """The LCS about each of many states x (n, n_x) and one input u (n_u,), with
        the values (n,) of all parameters, or the nominal ones.

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
        if (
            self._model is None
            or self._contacts.groups_in_arrays is None
            or self.parameters.has("gap")
        ):
            self._fill_one_by_one(x, u, parameters, out)
        else:
            self._fill_compiled(x, u, parameters, out)
        return out

    def _fill_one_by_one(self, x, u, parameters, out) -> None:
        for i in range(len(x)):
            try:
                lcs = self.build(x[i], u, parameters=parameters)
            except (ValueError, RuntimeError):
                continue
            for array, name in zip(out, _LCS_FIELDS, strict=True):
                array[i] = getattr(lcs, name)

    def _fill_compiled(self, x, u, parameters, out) -> None:
        """The same in one compiled loop; normalises the quaternions in x."""
        good = np.isfinite(x).all(axis=1) & np.isfinite(u).all()
        for start, _ in self._dynamics.floating:
            norm = np.linalg.norm(x[:, start : start + 4], axis=1)
            good &= (norm >= 0.5) & (norm <= 2.0)
            x[good, start : start + 4] /= norm[good, None]
        if not good.any():
            return
        contacts, rows = self._contacts, self._contacts.rows
        weight, F_0 = contacts.weight, contacts.F_0
        if len(self.parameters):
            mu = contacts.friction_of(self._use(parameters, None, None)[0])
            # The contacts of a group have the same friction.
            weight, F_0 = contacts.rows_of(contacts.first, mu)
        part = tuple(array[good] for array in out)
        finite = build_many_constant_mass(
            x[good], u, self.dt_sec, tuple(vars(self._model).values()),
            (rows.contact, rows.normal, weight, rows.edge, F_0),
            contacts.groups_in_arrays, part,
        )  # fmt: skip
        for array, of_good in zip(out, part, strict=True):
            of_good[~finite] = np.nan
            array[good] = of_good


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

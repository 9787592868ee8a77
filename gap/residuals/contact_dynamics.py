"""Equations of motion of robots and objects that touch, and what contact cannot give.

For a mean over a short while (a test function of numerics/permitted_forces.py) the
measured motion needs the generalized force ID(q, v, vd), of which the drives give u;
what is left, P, must be contact forces that the model permits: none that pulls, none
outside the friction cone, along the slip where something slides, and only where shapes
are near. What they do not explain of P is the residual. Nothing is simulated.

How noise is kept out: positions alone are differentiated, within the test function;
while two bodies stay in touch their distance does not accelerate, which tells the
seen body's acceleration along the normal from the robot's encoders (conditioning on
that constraint, a Kalman update); the effort is what the drive's law makes of commands
and encoders, so that its ripple between rows does not matter.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.data.recording import Recording
from makebreak.gap.numerics.permitted_forces import explain, roots_of
from makebreak.gap.residuals.contact_means import HOP, MODELLED, SLIDES
from makebreak.gap.residuals.permitted_contacts import (
    SURFACES,
    Geometry,
    PermittedContacts,
    Shift,
)
from makebreak.gap.residuals.touching import LEAST_FELT
from makebreak.gap.residuals.whitened_rows import REST_SPEED
from makebreak.gap.simulation.windows import TURN
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact import CONTACT_LAW
from makebreak.models.effects.inertia import SIX, central_inertia, inertial_columns
from makebreak.models.effects.kind import Effect, find_bodies, find_joints, full_name
from makebreak.models.effects.signature import Motion, added_effort
from makebreak.models.scene import Scene

HOLDS = 0.03  # Known of the distance's acceleration where bodies stay in touch [m/s2].
SHAPES = 2e-4  # How well shapes are known where the scene does not say [m].
PRESSED = 4.0  # Times a body's noise [N]: a force that tells that it is touched.
ROUNDING = 1e-11  # Of a column, per newton [-], [m].
THIN = 4  # Distances change slowly: every so many test functions are told.
WRENCHED = 0.05  # A wrench sampled amid a drive's ripple is off by as much.
SHAPED = (*SURFACES, *CONTACT_LAW)
# What changes a free body's inertial parameters.
INERTIAL = ("object_mass", "object_com", "object_inertia", "object_size")
# What changes the mass matrix of a robot.
OF_ROBOTS = frozenset(
    name for name, kind in KINDS.items()
    if kind.is_inertia and kind.at in ("joint", "body") and name not in INERTIAL
)  # fmt: skip


class ContactDynamics(PermittedContacts):
    """Residuals (K, rows) of a scene's equations of motion with permitted forces.

    Raises: DoesNotFit where the recordings do not tell the whole motion (a position of
        every joint, a whole pose of every free body), no effort, or nothing touches.
    """

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        super().__init__(scene, recordings)
        self._last: tuple | None = None
        self._told: dict[tuple[int, int], np.ndarray] = {}
        self._inertial_of: dict[str, np.ndarray] = {}
        self._prepare()

    def _prepare(self) -> None:
        """Accelerations with what lasting contacts tell, what the motion needs, and
        what its rows are divided by; all in the scene as it came."""
        m = self.means
        self._condition()
        q, v = self._q[m.centre], self._W @ self._node_v
        self.motion = Motion(m.time, q, v, m.acceleration, m.effort)
        still = np.zeros_like(self._node_v)  # Laws of joints are of q and v alone.
        order, q = np.arange(float(len(still))), self._q[self._rows]
        self._node_motion = Motion(order, q, self._node_v, still, still)
        more = m.acceleration - self._mean_vd
        needs = self._needed_smoothed + np.einsum("kij,kj->ki", self._M, more)
        self._needs = needs - m.effort
        self._weigh()

    def _condition(self) -> None:
        """While two bodies stay in touch the distance does not accelerate."""
        m = self.means
        touch = self._masks
        q, v = self._q[m.centre], self._v[m.centre]
        vd = self._vd[m.centre]
        a, covariance = self._expected_acceleration(v)
        middle = np.searchsorted(self._rows, m.centre)
        middle = np.clip(middle, 0, len(self._rows) - 1)
        h = 0.004  # [s] The distance along the smoothed motion, by differences.
        moved = []
        for sign in (-1.0, 0.0, 1.0):
            at = self.dynamics.shifted(q, v + 0.5 * sign * h * vd, sign * h)
            for i_q, _ in self.bodies.values():
                size = np.linalg.norm(at[:, i_q : i_q + 4], axis=1)
                at[:, i_q : i_q + 4] /= size[:, None]
            moved.append(
                {s.key: s for s in self.shapes.slots(self._poses_at(at), np.inf)}
            )
        for s, mine in zip(self.slots, touch, strict=True):
            whole = np.asarray(self._W @ mine.astype(float)).ravel() > 0.999
            whole &= mine[middle]
            if not whole.any():
                continue
            J = np.einsum("nj,njk->nk", s.normal, self._relative(s))[middle]
            before, now, after = (each[s.key].phi for each in moved)
            bend = (after - 2.0 * now + before) / h**2
            rest = bend - np.sum(J * vd, axis=1)
            for k in np.flatnonzero(whole):
                e = -rest[k] - J[k] @ a[k]
                S = J[k] @ covariance[k] @ J[k] + HOLDS**2
                gain = covariance[k] @ J[k] / S
                a[k] += gain * e
                covariance[k] -= np.outer(gain, J[k] @ covariance[k])
        self.means.acceleration = a
        self._a_covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))

    def _expected_acceleration(self, v: np.ndarray):
        """Of each test function the acceleration that is expected (K, n_v), and its
        covariance: the measured mean, shrunk by how noise compares with what bodies
        do (along their path, across it, upright, in turning). What is left off by is
        then not correlated with it, else a mass would be found too small (regression
        calibration: Carroll et al., Measurement Error in Nonlinear Models, 2006,
        chapter 4).
        """
        m = self.means
        a, var = m.acceleration.copy(), m.acceleration_var
        K, n_v = a.shape
        covariance = np.zeros((K, n_v, n_v))
        i = np.arange(n_v)
        covariance[:, i, i] = var
        for _, k in self.joints.values():
            true = max(
                float(np.mean(a[:, k] ** 2 - var[:, k])), 0.05 * var[:, k].mean()
            )
            share = true / (true + var[:, k])
            a[:, k] *= share
            covariance[:, k, k] = share * var[:, k]
        up = -self.dynamics.gravity
        up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.0 else np.eye(3)[2]
        for _, i_v in self.bodies.values():
            along = v[:, i_v + 3 : i_v + 6]
            along = along - (along @ up)[:, None] * up
            size = np.linalg.norm(along, axis=1)
            # What is at rest throughout says nothing of what moves, or begins to.
            speed = np.linalg.norm(self._node_v[:, i_v + 3 : i_v + 6], axis=1)
            moves = np.asarray(self._W @ (speed > SLIDES).astype(float)).ravel() > 0.0
            spare = np.cross(
                up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0]
            )
            spare /= np.linalg.norm(spare)
            e1 = np.where(size[:, None] > 1e-6, along / np.maximum(size, 1e-6)[:, None],
                          spare)  # fmt: skip
            R = np.stack([e1, np.cross(up, e1), np.broadcast_to(up, e1.shape)], axis=1)
            for first, turn in ((i_v, None), (i_v + 3, R)):
                index = slice(first, first + 3)
                axes = np.broadcast_to(np.eye(3), (K, 3, 3)) if turn is None else turn
                y = np.einsum("kij,kj->ki", axes, a[:, index])
                noise = np.einsum("kij,kj->ki", axes**2, var[:, index])
                share = np.empty_like(y)
                for some in (moves, ~moves):
                    share[some] = _signal_share(y[some], noise[some])
                a[:, index] = np.einsum("kji,kj->ki", axes, share * y)
                covariance[:, index, index] = np.einsum(
                    "kji,kj,kjl->kil", axes, share * noise, axes
                )
        return a, covariance

    # ----- Weights

    def _weigh(self) -> None:
        """What rows are divided by: noise of accelerations, efforts and wrenches, and
        to begin with MODELLED of the forces that act in a row."""
        m = self.means
        K, n_v = m.acceleration.shape
        n = n_v + m.wrench.shape[1]
        self._sensors_alone = self._sensor_covariance(np.ones(n_v), np.ones(n_v))
        needs = self._all_needs(())
        G, there, of, _, sharing = self._generators(())
        rough = np.array(self._sensors_alone)
        size = np.sqrt(np.mean(needs**2, axis=0))
        rough[:, np.arange(n), np.arange(n)] += (0.1 * size + 1e-6) ** 2
        weights = np.zeros(there.shape)
        explain(
            needs, G, there, roots_of(rough), sharing, np.zeros_like(needs),
            weights, np.zeros(K, np.int64),
        )  # fmt: skip
        acting = np.abs(G * weights[:, None, :]).sum(axis=2) + np.abs(needs)
        self.acting = np.sqrt(np.mean(acting**2, axis=0))
        self._limit_acting(size)
        share = np.append(np.full(n_v, MODELLED), np.full(n - n_v, WRENCHED))
        self.allow(share * self.acting)

    def _limit_acting(self, needed: np.ndarray) -> None:
        """Hook: forces that act in rows (rows,), beside what these need."""

    def allow(self, allowance: np.ndarray) -> None:
        """Weighs rows anew. allowance (rows,): what models are off by, in N and N m."""
        self.allowance = np.asarray(allowance, float)
        self._root_of: dict[tuple, np.ndarray] = {}
        self.root, self._last = self._root(()), None
        needs = self._all_needs(())
        G, there, of, _, sharing = self._generators(())
        weights = np.zeros(there.shape)
        left, rank = np.zeros_like(needs), np.zeros(len(needs), np.int64)
        explain(needs, G, there, self.root, sharing, left, weights, rank)
        # Of n rows those are free that no force takes up.
        n = needs.shape[1]
        self.free = np.sqrt(n / np.maximum(n - rank, 1))
        # How hard each pair presses: the distance is that much less.
        self._pressed: dict[tuple[int, int], np.ndarray] = {}
        for column, number in enumerate(of):
            pair = self._pair_of(self.slots[number])
            f = self._pressed.setdefault(pair, np.zeros(len(needs)))
            f += weights[:, column]

    def _sensor_covariance(self, inertia, gain, more=0.0) -> np.ndarray:
        """(K, rows, rows) of what sensors' noise makes of the rows, with the inertia in
        each row and the effort of each drive (n_v,) times so much, and a mass matrix
        that is by `more` (K, n_v, n_v) larger."""
        m = self.means
        n_v = m.acceleration.shape[1]
        n = n_v + m.wrench.shape[1]
        C = np.zeros((len(m.time), n, n))
        M = inertia[:, None] * self._M + more
        C[:, :n_v, :n_v] = M @ self._a_covariance @ M.transpose(0, 2, 1)
        i, j = np.arange(n_v), np.arange(n_v, n)
        C[:, i, i] += gain**2 * m.effort_var
        C[:, j, j] += m.wrench_var
        return C

    def _root(self, effects: Sequence[Effect]) -> np.ndarray:
        """(K, rows, rows) what weighs the rows of a model with these effects.

        Noise of an acceleration errs by the inertia of that model, of an effort by the
        gain of its drive. With the scene's own inertia in its place, of two models that
        differ by a common factor (a mass times 1.5; a drive that gives 1/1.5 of what
        it should) the one with the smaller forces would err less, and win. So it is
        with a robot's links: of a cart that is heavier and a motor that gives less,
        each explains what the other does.
        """
        n_v = len(self.coordinates)
        inertia, gain = np.ones(n_v), np.ones(n_v)
        bodies: dict[str, list[Effect]] = {}
        for e in effects:
            if e.kind in INERTIAL:
                for body in find_bodies(e, self.plant):
                    bodies.setdefault(full_name(self.plant, body), []).append(e)
            elif e.kind == "actuator_gain":
                for joint in find_joints(e, self.plant):
                    gain[joint.velocity_start()] = e.parameters["gain"]
        for body, own in bodies.items():
            if body in self.bodies:
                i_v = self.bodies[body][1]
                slides, turns = np.arange(i_v + 3, i_v + 6), np.arange(i_v, i_v + 3)
            elif body in self.objects:
                slides, turns = self.objects[body]
            else:
                continue  # A link as a nuisance: its mass is off by little.
            before, more = self._ten(body), self._more_inertia(body, own)
            inertia[slides] = 1.0 + more[0] / before[0]
            trace = slice(4, 7)  # Of the inertia: it has no axes.
            inertia[turns] = 1.0 + more[trace].sum() / before[trace].sum()
        held = self._held(effects)
        links = [e for e in effects if e.kind in OF_ROBOTS]
        of_links = tuple((e.kind, *e.at, *sorted(e.parameters.items())) for e in links)
        key = (*inertia, *gain, held.tobytes() if held.any() else None, of_links)
        if key not in self._root_of:
            more = self._more_mass(links)
            C = self._sensor_covariance(inertia, gain, more)
            scale = np.append(inertia * np.abs(gain), np.ones(C.shape[1] - n_v))
            for joint, (_, i) in self.joints.items():
                if self.by[joint] == "passive":  # Its inertia takes all that acts.
                    M = self._M[:, i, i].sum()
                    scale[i] *= (M + more[:, i, i].sum()) / M
            k = np.arange(C.shape[1])
            off = self.allowance + 1e-9 + 1e-6 * self.acting
            C[:, k, k] += (scale * off) ** 2
            i = np.arange(n_v)
            # Evenly in between; of one rest all rows err together.
            C[:, i, i] += held**2 / 3.0 * np.maximum(np.sum(held > 0.0, axis=0), 1)
            kept = [(*(1.0,) * (2 * n_v), None, ())]  # The scene's own, and the last.
            self._root_of = {k: r for k, r in self._root_of.items() if k in kept}
            self._root_of[key] = roots_of(C)
        return self._root_of[key]

    def _more_mass(self, effects: Sequence[Effect]) -> np.ndarray:
        """(K, n_v, n_v) by which the mass matrix is larger with effects on a robot's
        joints and links: what they need for each acceleration alone, beyond what they
        need at rest."""
        m = self.motion
        still, out = np.zeros_like(m.v), np.zeros_like(self._M)
        for e in effects:
            at_rest = self._added(e, replace(m, v=still, vd=still))
            for i in range(m.v.shape[1]):
                vd = np.zeros_like(still)
                vd[:, i] = 1.0
                out[:, :, i] += self._added(e, replace(m, v=still, vd=vd)) - at_rest
        return out

    def in_newtons(self, left: np.ndarray) -> np.ndarray:
        """Rows (K, rows) of equations as left() gives them, in N and N m."""
        return np.linalg.solve(self.root, left[:, :, None])[:, :, 0]

    def sensor_std(self) -> np.ndarray:
        """(rows,) rms of what sensors' noise alone makes of each row [N, N m]."""
        k = np.arange(self._sensors_alone.shape[1])
        return np.sqrt(np.mean(self._sensors_alone[:, k, k], axis=0))

    # ----- Residuals

    def _all_needs(self, effects: Sequence[Effect]) -> np.ndarray:
        """(K, rows): generalized forces that contact must give, measured wrenches."""
        m = self.means
        P = self._needs.copy()
        inertial: dict[str, list[Effect]] = {}
        for e in effects:
            kind = KINDS[e.kind]
            if e.kind in INERTIAL:
                for body in find_bodies(e, self.plant):
                    inertial.setdefault(full_name(self.plant, body), []).append(e)
                continue
            if e.kind in SHAPED or kind.channel == "bias":
                continue
            if kind.path:
                P -= self._driven_more(e)
                continue
            if kind.at not in ("body", "free body", "joint", "actuator"):
                raise ValueError(
                    f"effect {e.kind} is not one of equations with contact"
                )
            # Friction turns, and ends, within a test function: the mean of its force is
            # not its force at the mean velocity.
            law = kind.joint_law is not None
            motion = self._node_motion if law else self.motion
            more = self._added(e, motion)
            P += self._W @ more if law else more
        for body, own in inertial.items():
            P += self._inertial(body) @ self._more_inertia(body, own)
        return np.hstack([P, self._unbiased(m.wrench, effects)])

    def _added(self, effect: Effect, motion: Motion) -> np.ndarray:
        """(n, n_v) what the motion needs more with an effect."""
        more = added_effort(effect, KINDS[effect.kind], self.dynamics, motion)
        if more is None:
            raise ValueError(f"effect {effect.kind}: its equations are not known")
        return more

    def _held(self, effects: Sequence[Effect]) -> np.ndarray:
        """(K, n_v) by how much friction of the joints, the scene's and that of effects,
        may be off its law: at rest it is anything between what it is while they move
        one way and the other."""
        motion, found = self._node_motion, np.zeros_like(self._node_v)
        slow = np.full_like(motion.v, REST_SPEED)
        for e in (*self.scene.effects, *effects):
            if KINDS[e.kind].joint_law is not None:
                ways = (self._added(e, replace(motion, v=v)) for v in (slow, -slow))
                found += 0.5 * np.subtract(*ways)
        return self._W @ (np.abs(found) * (np.abs(motion.v) < REST_SPEED))

    def _unbiased(self, wrench: np.ndarray, effects: Sequence[Effect]) -> np.ndarray:
        """(K, n_wrench) wrenches without the biases that effects give their sensors."""
        names = [name for sensor in self.sensors for name in sensor.names]
        for e in effects:
            if KINDS[e.kind].channel != "bias":
                continue
            if not set(e.at) <= set(names):
                raise ValueError(f"{e.kind}: of forces and moments alone")
            wrench = wrench - e.parameters["bias"] * np.isin(names, e.at)
        return wrench

    def _driven_more(self, effect: Effect) -> np.ndarray:
        """(K, n_v) what drives give more with an effect on their path."""
        out = np.zeros_like(self.means.effort)
        for joint in find_joints(effect, self.plant):
            i = joint.velocity_start()
            if effect.kind == "actuator_gain":
                out[:, i] = (effect.parameters["gain"] - 1.0) * self.means.effort[:, i]
            elif effect.kind == "actuator_bias":
                out[:, i] = effect.parameters["bias"]
            elif effect.kind == "input_delay":
                out[:, i] = effect.parameters["delay"] * self.means.effort_slope[:, i]
            else:
                raise ValueError(f"effect {effect.kind}: its equations are not known")
        return out

    def _inertial(self, body: str) -> np.ndarray:
        """(K, n_v, 10) of a free body's inertial parameters."""
        if body not in self._inertial_of:
            (found,) = find_bodies(Effect("", [body], {}), self.plant)
            self._inertial_of[body] = inertial_columns(
                self.dynamics, self.motion, found
            )[0]
        return self._inertial_of[body]

    def _ten(self, body: str) -> np.ndarray:
        """(10,) the body's inertial parameters."""
        (found,) = find_bodies(Effect("", [body], {}), self.plant)
        M = found.default_spatial_inertia()
        return _ten(M.get_mass(), np.array(M.get_com()), central_inertia(M))

    def _more_inertia(self, body: str, effects: Sequence[Effect]) -> np.ndarray:
        """(10,) by which the body's inertial parameters change: kinds in the order of
        their rank, as on a plant."""
        (found,) = find_bodies(Effect("", [body], {}), self.plant)
        M = found.default_spatial_inertia()
        mass, com = M.get_mass(), np.array(M.get_com())
        central = central_inertia(M)
        for e in sorted(effects, key=lambda e: KINDS[e.kind].rank):
            p = e.parameters
            if e.kind == "object_mass":
                if not p["mass"] > 0.0:
                    raise ValueError("object_mass: not above zero")
                central, mass = central * (p["mass"] / mass), p["mass"]
            elif e.kind == "object_size":  # The same mass, farther out.
                scale = self._scale_of(e, int(found.index()))
                com, central = scale * com, scale**2 * central
            elif e.kind == "object_com":
                com = np.array([p.get(a, x) for a, x in zip("xyz", com, strict=True)])
            else:
                for i, a in enumerate(("ixx", "iyy", "izz")):
                    central[i, i] = p.get(a, central[i, i])
                w = np.linalg.eigvalsh(central)
                if not (w[0] > 0.0 and w[0] + w[1] >= w[2]):
                    raise ValueError(f"object_inertia: no body has {p}")
        return _ten(mass, com, central) - self._ten(body)

    def left(
        self,
        effects: Sequence[Effect] = (),
        shift: Shift | None = None,
        weighed_as: Sequence[Effect] | None = None,
    ):
        """What permitted forces leave over the noise, (K, n): equations and wrenches,
        then channels that tell the same twice, then distances. weighed_as: the model
        whose noise divides the rows, if it is not that of `effects`."""
        needs = self._all_needs(effects)
        shaped = [e for e in effects if e.kind in SHAPED]
        G, there, _, geometry, sharing = self._generators(shaped, shift)
        root = self._root(effects if weighed_as is None else weighed_as)
        r = self._explained(needs, G, there, sharing, root)
        r = r * self.free[:, None]
        more = self.means.extra / np.sqrt(np.maximum(self.means.extra_var, 1e-300))
        return np.hstack([r, more, self._distances(geometry)])

    def _explained(self, needs, G, there, sharing, root) -> np.ndarray:
        """What permitted forces leave; only where anything is other than the last time
        is it computed."""
        new = np.ones(len(needs), bool)
        r = np.zeros_like(needs)
        if self._last is not None and self._last[1].shape == G.shape:
            P_last, G_last, there_last, root_last, r_last = self._last
            # A sum that was taken in another order is no other column.
            moved = np.abs(G - G_last).max(axis=(1, 2))
            new = (needs != P_last).any(axis=1) | (moved > ROUNDING)
            new |= (there != there_last).any(axis=1) | (root is not root_last)
            r[:] = r_last
        if new.any():
            some = np.zeros((int(new.sum()), needs.shape[1]))
            explain(
                needs[new], G[new], there[new], root[new], sharing[new], some,
                np.zeros((len(some), there.shape[1])), np.zeros(len(some), np.int64),
            )  # fmt: skip
            r[new] = some
        self._last = (needs, G, there, root, r)
        return r

    def _distances(self, geometry: Geometry) -> np.ndarray:
        """(K, n) over what shapes and poses are known to, and their numbers: of each
        pair that lies, height and slopes; of each other one, the distance."""
        slots, masks = geometry.slots, geometry.masks
        shape = self.shape_std()
        K = len(self.means.time)
        columns = []
        for pair in self._pairs_met:
            mine = [s for s in slots if self._pair_of(s) == pair and s.key in masks]
            if not mine:
                raise ValueError(
                    f"{self.pair_name(pair)}: not near each other any more"
                )
            mask = np.stack([masks[s.key] for s in mine]).astype(float)
            free = self._is_of_a_free_body(pair)
            if self._lies(pair) and free:
                mask *= np.stack([self.carries(s) for s in mine])
            phi = np.stack([s.phi for s in mine])
            n = mask.sum(axis=0)
            some = n > 0.0
            there = np.asarray(self._W @ some.astype(float)).ravel()
            good = there > 0.999
            _, turn = self._pose_noise(pair)
            stiffness = mine[0].stiffness
            mean = np.sum(mask * phi, axis=0) / np.maximum(n, 1.0)
            pressed = self._pressed.get(pair, np.zeros(K)) / stiffness
            if self._lies(pair):
                xy = np.stack([s.place[:, :2] for s in mine])
                middle = np.einsum("sn,snj->nj", mask, xy) / np.maximum(n, 1.0)[:, None]
                off = (xy - middle) * mask[:, :, None]
                A = np.einsum("snj,snk->njk", off, off) + 1e-12 * np.eye(2)
                b = np.einsum("snj,sn->nj", off, mask * (phi - mean))
                slope = np.linalg.solve(A, b[:, :, None])[:, :, 0]
                arm = float(np.sqrt(np.median(A[some].trace(axis1=1, axis2=2)) / 4.0))
                # Each of several points carries its share.
                h = self._W @ mean + pressed / np.maximum(self._W @ n, 1.0)
                good = self._thinned(pair, good)
                columns.append(np.where(good, h / self.distance_std(pair), 0.0))
                std = np.sqrt((shape / max(arm, 1e-3)) ** 2 + turn**2 + 1e-6)
                spread = np.asarray(self._W @ (n >= 3).astype(float)).ravel() > 0.999
                for k in range(2):
                    columns.append(
                        np.where(good & spread, (self._W @ slope[:, k]) / std, 0.0)
                    )
            else:
                least = np.where(mask > 0.0, phi, np.inf).min(axis=0)
                least = np.where(some, least, 0.0)
                d = self._W @ least + pressed
                if not self.shapes.anchored & set(pair) or free:
                    # Seen near each other, but known to touch by a force alone.
                    good = good & self._is_pressed(pair)
                good = self._thinned(pair, good)
                columns.append(np.where(good, d / self.distance_std(pair), 0.0))
        return -np.stack(columns, axis=1) if columns else np.zeros((K, 0))

    def _thinned(self, pair: tuple[int, int], good: np.ndarray) -> np.ndarray:
        """(K,) of the test functions that are good those that tell a distance: the
        first, and after each the next one that is so much later. They are chosen once:
        what a model makes of them chooses no others."""
        if pair in self._told:
            return good & self._told[pair]
        m, out = self.means, np.zeros(len(good), bool)
        apart = (THIN - 0.5) * HOP * self.half
        last = (-1, -np.inf)
        for k in np.flatnonzero(good):
            if m.episode[k] != last[0] or m.time[k] - last[1] > apart:
                out[k], last = True, (m.episode[k], m.time[k])
        self._told[pair] = out
        return out

    def shape_std(self) -> float:
        """[m] to which shapes are known."""
        return float(self.scene.tolerance.get("shape_m", SHAPES))

    def distance_std(self, pair: tuple[int, int]) -> float:
        """[m] to which shapes and poses of a pair are known."""
        return float(np.hypot(self.shape_std(), self._pose_noise(pair)[0]))

    def _is_pressed(self, pair: tuple[int, int]) -> np.ndarray:
        """(K,) whether two bodies press on each other, beyond what noise may feign."""
        K = len(self.means.time)
        if pair in self._apart:  # A sensor tells.
            return np.ones(K, bool)
        least = np.full(K, LEAST_FELT)
        for k in pair:
            if self.shapes.names[k] in self.bodies:
                i = self.bodies[self.shapes.names[k]][1] + 3 + np.arange(3)
                noise = np.sqrt(self._sensors_alone[:, i, i].max(axis=1))
                least = np.maximum(least, PRESSED * noise)
        return self._pressed.get(pair, np.zeros(K)) > least

    def _pose_noise(self, pair: tuple[int, int]) -> tuple[float, float]:
        """Of a smoothed place [m] and turn [rad] of a pair's seen bodies."""
        place = turn = 0.0
        for k in pair:
            body = self.shapes.names[k]
            if body in self.bodies:
                every = [r.channels[f"{body}.{a}"].noise for r in self.recordings
                         for a in "xyz"]  # fmt: skip
                place = max(place, *every)
                every = [2.0 * r.channels[f"{body}.{a}"].noise for r in self.recordings
                         for a in TURN]  # fmt: skip
                turn = max(turn, *every)
        return 0.5 * place, 0.5 * turn

    def row_names(self) -> list[str]:
        names = [f"{c} equation" for c in self.coordinates]
        names += [name for sensor in self.sensors for name in sensor.names]
        names += [name for name, _ in self.extra]
        for pair in self._pairs_met:
            name = self.pair_name(pair)
            names.append(f"{name}.distance")
            if self._lies(pair):
                names += [f"{name}.slope_x", f"{name}.slope_y"]
        return names

    def counts(self) -> np.ndarray:
        """(K, n) which entries of left() are there."""
        r = self.left()
        out = np.ones(r.shape, bool)
        n = len(self.coordinates) + self.means.wrench.shape[1]
        out[:, n : n + len(self.extra)] = self.means.extra_var < 1e11
        known = [i for j, (_, i) in self.joints.items() if self.by[j] == ""]
        out[:, known] = False
        out[:, n + len(self.extra) :] = r[:, n + len(self.extra) :] != 0.0
        return out


def _signal_share(y: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(n, k) of measured y (n, k) with variances noise (n, k) the part that is expected
    to be true, if what is true is spread alike in all rows."""
    if not len(y):
        return np.zeros_like(y)
    true = np.mean(y**2 - noise, axis=0)
    true = np.maximum(true, 0.05 * np.mean(noise, axis=0))
    return true / (true + noise)


def _ten(mass: float, com: np.ndarray, central: np.ndarray) -> np.ndarray:
    """Mass, mass times centre, inertia about the origin, as inertial_columns has it."""
    about = central + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.array([mass, *(mass * com), *(about[at] for at in SIX)])

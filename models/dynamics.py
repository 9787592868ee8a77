"""A scene's rigid-body dynamics on arrays of samples, for residuals and signatures.

    effort = ID(q, v, vd) = d/dt (M v) + rest(q, v)

with gravity, damping, rotors and the effects of the scene. Not included: contact, the
actuation path (the effort is what acts on the joints), and effects with hidden states,
which no channel measures (elasticity, backlash).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    JacobianWrtVariable,
    MultibodyForces,
    RigidBody,
)
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.drives import law_of
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact import FRICTION
from makebreak.models.effects.kind import (
    Effect,
    find_body,
    full_name,
    is_added,
    model_names,
    model_of,
    one_dof_joints,
)
from makebreak.models.effects.signature import Grid, Motion, Signature
from makebreak.models.effects.sizes import sizes_of
from makebreak.models.joint_tree import (
    NoJointTree,
    carrier,
    changed_context,
    joint_tree,
)
from makebreak.models.scene import (
    LoadedScene,
    Scene,
    body_laws,
    forces_on_bodies,
    joint_laws,
    load_scene,
    read_scene,
)
from makebreak.models.scene_schema import COMMANDS_OF
from makebreak.systems.numerics import joint_tree as tree_dynamics
from makebreak.systems.numerics.joint_laws import coulomb_of
from makebreak.systems.numerics.joint_tree import JointTree

SLOPE_STEPS = (1e-4, 0.05)  # Of positions and velocities, for slopes of accelerations.


class SceneDynamics:
    """Residuals of a scene's model, and signatures of effects in them.

    It owns one Context, so it must be used by one thread only.

    friction_of: of a pair, where another simulator mixes its surfaces; None: as Drake.
    """

    friction_of: Callable[[str], float | None] = staticmethod(lambda pair: None)

    def __init__(self, scene: Scene | str | Path):
        if not isinstance(scene, Scene):
            scene = read_scene(scene)
        measured = [
            effect
            for effect in scene.effects
            if effect.kind not in KINDS or not KINDS[effect.kind].hidden_state
        ]
        self.loaded: LoadedScene = load_scene(
            replace(scene, effects=measured), DiagramBuilder()
        )
        self.plant: MultibodyPlant = self.loaded.plant
        self.sizes = sizes_of(self.plant)
        self.gravity = np.array(self.plant.gravity_field().gravity_vector())
        self._context = self.plant.CreateDefaultContext()
        self._forces = MultibodyForces(self.plant)
        self._joint_numbers, self._body_laws = _laws(self.loaded)
        try:  # Compiled: some ten times as fast.
            self._tree: JointTree | None = joint_tree(self.plant)
            self._tree_laws = joint_laws(self.loaded.effects, self.plant)
            self._tree_pulls = body_laws(self.loaded.effects, self.plant)
        except NoJointTree:
            self._tree = None
        self._coulombs = coulomb_of(joint_laws(self.loaded.effects, self.plant))
        self._carriers: dict = {}
        self._plain: SceneDynamics | None = None
        self._coordinates = _coordinates(self.plant)

    # ----- The model

    def with_links(self, effects: Sequence[Effect]) -> "SceneDynamics | None":
        """That of the same motions with links of other inertias (is_of_link), for
        inverse dynamics alone; None where the scene is no tree of joints.

        Raises: ValueError for effects that the scene cannot have.
        """
        if self._tree is None:
            return None
        other = object.__new__(SceneDynamics)
        other.__dict__.update(self.__dict__)
        ranked = sorted(effects, key=lambda e: KINDS[e.kind].rank)
        other._context = changed_context(self.plant, ranked)
        other._tree = joint_tree(self.plant, other._context)
        return other

    def inverse_dynamics(self, q, v, vd, time=None) -> np.ndarray:
        """Effort (n, n_v) for the motion q (n, n_q), v, vd (n, n_v) at the times (n,)
        [s], which are only needed for time-dependent forces."""
        if self._tree is not None:
            return tree_dynamics.inverse_dynamics(
                self._tree, q, v, vd, self._tree_laws, time, self._tree_pulls
            )
        plant, context, forces = self.plant, self._context, self._forces
        n = len(v)
        time = np.zeros(n) if time is None else time
        effort = np.empty((n, plant.num_velocities()))
        joint_forces = self.loaded.joint_forces
        both = np.hstack([q, v])
        for k in range(n):
            plant.SetPositionsAndVelocities(context, both[k])
            plant.CalcForceElementsContribution(context, forces)
            if self._body_laws:
                self._add_body_forces(time[k])
            effort[k] = plant.CalcInverseDynamics(context, vd[k], forces)
            if joint_forces is not None:
                effort[k] -= joint_forces.force(
                    both[k].tolist(), time[k], self._joint_numbers
                )
        return effort

    def momentum(self, q, v) -> np.ndarray:
        """M(q) v, (n, n_v) [kg m2/s] or [kg m/s]."""
        if self._tree is not None:
            return tree_dynamics.momentum(self._tree, q, v)
        out = np.empty_like(v)
        for k in range(len(v)):
            self.plant.SetPositions(self._context, q[k])
            out[k] = self.plant.CalcMassMatrix(self._context) @ v[k]
        return out

    def rest(self, q, v, time=None) -> np.ndarray:
        """ID(q, v, 0) - dM/dt v, (n, n_v): the effort minus d/dt (M v)."""
        step = 1e-5  # Of the central difference [s]; its error is of order step^2.
        after = self.momentum(self.shifted(q, v, step), v)
        before = self.momentum(self.shifted(q, v, -step), v)
        still = self.inverse_dynamics(q, v, np.zeros_like(v), time)
        return still - (after - before) / (2.0 * step)

    def slopes(self, q, v, vd) -> tuple[np.ndarray, np.ndarray]:
        """How accelerations change about a motion (m, n_v), without free bodies:
        d(acceleration)/d(q, v) at given efforts (m, n_v, 2 n_v); M^-1 (m, n_v, n_v).

        A step of SLOPE_STEPS in velocity crosses the fade of dry friction: it damps a
        joint that moves little, and does not hold it."""
        n = v.shape[1]
        slopes, mobility = np.empty((len(v), n, 2 * n)), np.empty((len(v), n, n))
        for k in range(len(v)):
            self.plant.SetPositions(self._context, q[k])
            mobility[k] = np.linalg.inv(self.plant.CalcMassMatrix(self._context))
            moved = np.zeros((2, 2 * n, n)) + np.stack([q[k], v[k]])[:, None]
            moved[0, :n] += SLOPE_STEPS[0] * np.eye(n)
            moved[1, n:] += SLOPE_STEPS[1] * np.eye(n)
            back = 2.0 * np.stack([q[k], v[k]])[:, None] - moved
            same = np.tile(vd[k], (2 * n, 1))
            effort = self.inverse_dynamics(moved[0], moved[1], same)
            effort -= self.inverse_dynamics(back[0], back[1], same)
            effort /= 2.0 * np.repeat(SLOPE_STEPS, n)[:, None]
            slopes[k] = -mobility[k] @ effort.T
        return slopes, mobility

    def residual(self, motion: Motion) -> np.ndarray:
        """effort - ID, (n, n_v)."""
        q, v = motion.q, motion.v
        r = motion.effort - self.inverse_dynamics(q, v, motion.vd, motion.time)
        if motion.dry is not None:
            for i, most, slow in self._coulombs:
                r[:, i] += most * (np.tanh(v[:, i] / slow) - motion.dry[:, i])
        return r

    def body_motion(self, body: RigidBody, q, v, vd):
        """Motion of a body's origin in the world, rotation first: Jacobian (n, 6, n_v),
        velocity (n, 6), acceleration (n, 6); and the body's rotation (n, 3, 3)."""
        plant, context, W = self.plant, self._context, self.plant.world_frame()
        if self._tree is not None:
            index = body.index()
            if index not in self._carriers:
                self._carriers[index] = carrier(plant, body)
            link, p_L, R_L = self._carriers[index]
            return tree_dynamics.point_motion(self._tree, link, p_L, R_L, q, v, vd)
        n, n_v = len(v), plant.num_velocities()
        J, V, A = np.empty((n, 6, n_v)), np.empty((n, 6)), np.empty((n, 6))
        R = np.empty((n, 3, 3))
        wrt, B, zero = JacobianWrtVariable.kV, body.body_frame(), np.zeros(3)
        both = np.hstack([q, v])
        for k in range(n):
            plant.SetPositionsAndVelocities(context, both[k])
            J[k] = plant.CalcJacobianSpatialVelocity(context, wrt, B, zero, W, W)
            bias = plant.CalcBiasSpatialAcceleration(context, wrt, B, zero, W, W)
            V[k], A[k] = J[k] @ v[k], J[k] @ vd[k] + bias.get_coeffs()
            R[k] = plant.EvalBodyPoseInWorld(context, body).rotation().matrix()
        return J, V, A, R

    def mass_times_com_jacobian(self, q) -> np.ndarray:
        """Total mass times the Jacobian of the centre of mass (n, 3, n_v); gravity's
        generalized force is its transpose times gravity."""
        plant, context, W = self.plant, self._context, self.plant.world_frame()
        out = np.zeros((len(q), 3, plant.num_velocities()))
        if plant.num_velocities() == 0:
            return out
        mass = plant.CalcTotalMass(context)
        for k in range(len(q)):
            plant.SetPositions(context, q[k])
            out[k] = mass * plant.CalcJacobianCenterOfMassTranslationalVelocity(
                context, JacobianWrtVariable.kV, W, W
            )
        return out

    def shifted(self, q, dq, step: float) -> np.ndarray:
        """q (n, n_q) moved by step times the velocities dq (n, n_v)."""
        out = np.array(q, dtype=float)
        if self._tree is not None:
            return out + step * np.asarray(dq)
        for k in range(len(out)):
            self.plant.SetPositions(self._context, q[k])
            out[k] += step * self.plant.MapVelocityToQDot(self._context, dq[k])
        return out

    # ----- Channels

    def channels(self) -> list[str]:
        """The channels of joints and free bodies that measure coordinates of the
        plant."""
        return list(self._coordinates)

    def coordinates(self, channel: str) -> tuple[str, int]:
        """What a channel measures ("q", "v" or "effort"), and its index in v."""
        return self._coordinates[channel][:2]

    def value(self, motion: Motion, channel: str) -> np.ndarray:
        """The values (n,) of a channel in a motion."""
        what, i_v, i_q = self._coordinates[channel]
        return (
            motion.q[:, i_q]
            if what == "q"
            else (motion.v if what == "v" else motion.effort)[:, i_v]
        )

    # ----- Effects

    def signatures(
        self, kind: str, at: Sequence[str], motion: Motion, grid: Grid | None = None
    ) -> list[Signature]:
        """Signatures of a kind of effect at a place in the residual.

        Args: grid: values at which nonlinear parameters are held, instead of the kind's
            own ({"periods_per_rev": [6, 12]}).
        Returns: alternatives, one for each held value; empty if the kind is only
            visible in simulation (contact, shapes, elasticity).
        Raises: ValueError if `at` is not in the scene.
        """
        signature = KINDS[kind].signature
        if signature is None:
            return []
        return signature(Effect(kind, list(at), {}), self, motion, grid)

    def places(self, kind: str) -> list[str]:
        """All `at` at which a kind could act in this scene.

        Channels: all of this model; a recording may have fewer. Pairs: a free body and
        another body with shapes, whether they ever touch or not.
        """
        found = places(self.loaded, KINDS[kind].at, self.channels())
        return [at for at in found if self._fits(kind, at)]

    def links(self) -> dict[str, float]:
        """{body that moves and has a mass: its mass [kg]}, from the base outwards."""
        bodies = {
            at: find_body(Effect("", [at], {}), self.plant, at)
            for at in places(self.loaded, "body", ())
        }
        masses = {
            at: float(body.default_spatial_inertia().get_mass())
            for at, body in bodies.items()
        }
        return {at: mass for at, mass in masses.items() if mass > 0.0}

    def _fits(self, kind: str, at: str) -> bool:
        """Whether the model has there what the kind changes (such as a box for
        corner_radius)."""
        try:
            self.now(kind, [at])
        except ValueError:
            return False
        return True

    def now(self, kind: str, at: Sequence[str]) -> dict[str, float]:
        """The parameters at which the effect changes nothing, where a search starts;
        without those that then have no meaning."""
        entry = KINDS[kind]
        if entry.drive:
            actuation = self.loaded.scene.actuation
            if "." not in at[0]:  # All drives of a model: where they differ, nothing.
                joints = [j for j in actuation.joints if j.startswith(f"{at[0]}.")]
                each = [self.now(kind, [joint]) for joint in joints]
                return each[0] if each and each.count(each[0]) == len(each) else {}
            law = law_of(actuation, at[0])
            if law is None:
                raise ValueError(f"no drive at {at[0]}")
            # Effects of the scene may have set it; the last one counts.
            (name,) = (each.name for each in entry.parameters)
            value = float(getattr(law, entry.drive))
            for effect in self.loaded.effects:
                if effect.kind == kind and set(effect.at) & set(at):
                    value = effect.parameters[name]
            return {name: value}
        if entry.now is not None:
            if entry.at == "pair":  # Several are alike.
                at = at[:1]
                mu = self.friction_of(at[0]) if kind == FRICTION else None
                if mu is not None:
                    return {"friction": mu}
            plain = self._before_loads() if entry.absolute else self
            effect = Effect(kind, list(at), {})
            return dict(entry.now(effect, plain.plant, plain.loaded.scene_graph))
        return {
            each.name: each.neutral
            for each in entry.parameters
            if each.neutral is not None
        }

    def _before_loads(self) -> "SceneDynamics":
        """That of the scene without effects that add to bodies: what sets a body's own
        mass is applied before them."""
        scene = self.loaded.scene
        kept = [
            e for e in scene.effects
            if KINDS[e.kind].absolute or not KINDS[e.kind].weighs
        ]  # fmt: skip
        if len(kept) == len(scene.effects):
            return self
        if self._plain is None:
            self._plain = SceneDynamics(replace(scene, effects=kept))
        return self._plain

    def least(self, kind: str, at: Sequence[str]) -> dict[str, float]:
        """Lower bounds of parameters from the model: an effect cannot remove more
        damping, friction, rotor inertia or mass than the model has."""
        entry = KINDS[kind]
        if entry.least is None:
            return {}
        effect = Effect(kind, list(at), {})
        damped = {}
        for joint in self.loaded.scene.actuation.joints:
            law = law_of(self.loaded.scene.actuation, joint)
            if law is not None:
                damped[joint] = float(law.kd + law.emf)
        return dict(entry.least(effect, self.plant, self.loaded.effects, damped))

    def _add_body_forces(self, time: float) -> None:
        assert self.loaded.body_forces is not None
        for law, body, p in self._body_laws:
            V = self.plant.EvalBodySpatialVelocityInWorld(self._context, body)
            F = np.zeros(6)
            law(np.array(V.get_coeffs()), time, p, F)
            body.AddInForceInWorld(self._context, SpatialForce(F), self._forces)


def _depth(plant: MultibodyPlant, body: RigidBody) -> int:
    """Joints and welds between a body and the world."""
    inner = {
        joint.child_body().index(): joint.parent_body().index()
        for joint in (plant.get_joint(i) for i in plant.GetJointIndices())
    }
    depth, at = 0, body.index()
    while at in inner:
        depth, at = depth + 1, inner[at]
    return depth


def places(loaded: LoadedScene, at: str, channels: Sequence[str]) -> list[str]:
    """All places in a scene for an effect that acts on `at` (EffectKind.at)."""
    plant = loaded.plant
    joints = [
        joint
        for joint in one_dof_joints(plant)
        if joint.num_velocities() and not is_added(model_of(plant, joint))
    ]
    bodies = [
        plant.get_body(i)
        for model in model_names(plant)
        for i in plant.GetBodyIndices(plant.GetModelInstanceByName(model))
        if plant.get_body(i).index() != plant.world_body().index()
        and not is_added(model)
    ]
    bodies.sort(key=lambda body: _depth(plant, body))  # From the base outwards.
    moving = [body for body in bodies if not plant.IsAnchored(body)]
    free = [body for body in bodies if body.is_floating_base_body()]
    shaped = [body for body in bodies if plant.GetCollisionGeometriesForBody(body)]

    def named(elements) -> list[str]:
        return [full_name(plant, each) for each in elements]

    if at == "joint":
        return named(joints)
    if at == "actuator":
        driven = {
            plant.get_joint_actuator(i).joint().index()
            for i in plant.GetJointActuatorIndices()
        }
        return named(joint for joint in joints if joint.index() in driven)
    if at == "drive":
        act = loaded.scene.actuation
        looped = "position_command" in COMMANDS_OF[act.type]
        return [name for name in named(joints) if looped and name in act.joints]
    if at == "body":
        return named(moving)
    if at == "ground":
        return named(body for body in shaped if plant.IsAnchored(body))
    if at == "pair":
        return [
            f"{a}~{b}"
            for i, a in enumerate(named(shaped))
            for j, b in enumerate(named(shaped))
            if shaped[i] in free and (shaped[j] not in free or i < j)
        ]
    if at == "channel":
        return list(channels)
    if at in ("length", "free body"):
        return named(free)
    # base: models that have joints, and the world.
    models = {plant.GetModelInstanceName(joint.model_instance()) for joint in joints}
    return [*sorted(models), "world"]


def _laws(loaded: LoadedScene):
    """Numbers of the joint laws, and body laws with their bodies and numbers."""
    joint_numbers = np.zeros(0)
    if loaded.joint_forces is not None:
        context = loaded.joint_forces.CreateDefaultContext()
        joint_numbers = np.array(context.get_numeric_parameter(0).value())
    return joint_numbers, [
        (law, body, np.array(p, float))
        for law, body, p in forces_on_bodies(loaded.effects, loaded.plant)
    ]


def _coordinates(plant: MultibodyPlant) -> dict[str, tuple[str, int, int]]:
    """{channel: ("q", "v" or "effort", index in v, index in q of positions)}."""
    found: dict[str, tuple[str, int, int]] = {}
    driven = {
        plant.get_joint_actuator(i).joint().index()
        for i in plant.GetJointActuatorIndices()
    }
    for joint in one_dof_joints(plant):
        name, i_v = full_name(plant, joint), joint.velocity_start()
        found[f"{name}.position"] = ("q", i_v, joint.position_start())
        found[f"{name}.velocity"] = ("v", i_v, -1)
        if joint.index() in driven:
            found[f"{name}.effort_measured"] = ("effort", i_v, -1)
    for i in range(plant.num_bodies()):
        body = plant.get_body(BodyIndex(i))
        if not body.is_floating_base_body() or not body.has_quaternion_dofs():
            continue
        name = full_name(plant, body)
        start = body.floating_velocities_start_in_v()
        for k, suffix in enumerate("wx wy wz vx vy vz".split()):
            found[f"{name}.{suffix}"] = ("v", start + k, -1)
        for k, suffix in enumerate("xyz"):
            i_q = body.floating_positions_start() + 4 + k
            found[f"{name}.{suffix}"] = ("q", start + 3 + k, i_q)
    return found

"""Effect rolling_resistance: the torque that slows a ball or cylinder that rolls."""

import numba
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Cylinder, SceneGraph, Sphere
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort

from makebreak.models.effects.kind import Effect, find_pair, parameter

# Rate of rolling below which the torque fades to zero [rad/s]: it acts one step late
# and would chatter otherwise. For a ball of 30 mm radius 0.05 rad/s is 1.5 mm/s.
FADE_RATE = 0.05
# Cylinders and spheres whose radii differ by no more than this fraction roll as one.
RADIUS_TOLERANCE = 0.02


class RollingResistance(LeafSystem):
    """The torque that resists the rolling of a free ball, or of a cylinder on its side,
    on another body.

        tau = -coefficient R f_n omega_t / max(|omega_t|, fade rate)

    with the ball's radius R [m], the normal force f_n [N] of each contact and omega_t
    [rad/s], the tangential part of the ball's angular velocity relative to the other
    body. The reaction acts on the other body. A ball that rolls freely on a level table
    decelerates by coefficient g (5/7), a solid cylinder by coefficient g (2/3).

    Force and rate are those of the step before, as the contact force of this step
    depends on the torque itself.

    Inputs:  contact_results (abstract), state (n_x,) of the plant.
    Outputs: generalized_force (n_v,).
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        ball: RigidBody,
        other: RigidBody,
        radius: float,
        coefficient: float,
    ):
        super().__init__()
        self._lever = coefficient * radius
        self._pair = (int(ball.index()), int(other.index()))
        ours, theirs = (
            set(plant.GetCollisionGeometriesForBody(body)) for body in (ball, other)
        )
        self._geometries = (ours, theirs)
        # Start of each body's angular velocity (and torque) in v, in world axes; -1
        # for an anchored body, which has none.
        self._at = np.array(
            [
                body.floating_velocities_start_in_v()
                if body.is_floating_base_body()
                else -1
                for body in (ball, other)
            ]
        )
        self._n_q, self._n_v = plant.num_positions(), plant.num_velocities()
        self._results = self.DeclareAbstractInputPort(
            "contact_results", AbstractValue.Make(ContactResults())
        )
        self._x = self.DeclareVectorInputPort("state", self._n_q + self._n_v)
        self._force = self.DeclareDiscreteState(self._n_v)
        self.DeclareStateOutputPort("generalized_force", self._force)
        self.DeclarePeriodicDiscreteUpdateEvent(
            plant.time_step() or 0.001, 0.0, self._update
        )
        # Compile it now, for the (partly read-only) arrays that Drake gives.
        self._none = np.zeros(self._n_v)
        x, up = np.zeros(self._n_q + self._n_v), np.ones(3)
        up.setflags(write=False)
        rolling_torque(
            self._none, x, np.ones(3), up, 0.0, self._at, self._n_q, FADE_RATE
        )

    def _update(self, context, discrete_state):
        generalized = self._none
        results = self._results.Eval(context)
        ball, other = self._pair
        for i in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(i)
            a, b = int(contact.bodyA_index()), int(contact.bodyB_index())
            if (a == ball and b == other) or (a == other and b == ball):
                generalized = rolling_torque(
                    generalized,
                    self._x.Eval(context),
                    contact.contact_force(),
                    contact.point_pair().nhat_BA_W,
                    self._lever,
                    self._at,
                    self._n_q,
                    FADE_RATE,
                )
        for i in range(results.num_hydroelastic_contacts()):
            contact = results.hydroelastic_contact_info(i)
            surface = contact.contact_surface()
            of = surface.id_M(), surface.id_N()
            ours, theirs = self._geometries
            if not any(a in ours and b in theirs for a, b in (of, of[::-1])):
                continue
            normal = sum(
                surface.area(k) * surface.face_normal(k)
                for k in range(surface.num_faces())
            )
            generalized = rolling_torque(
                generalized,
                self._x.Eval(context),
                contact.F_Ac_W().translational(),
                normal / np.linalg.norm(normal),
                self._lever,
                self._at,
                self._n_q,
                FADE_RATE,
            )
        discrete_state.set_value(self._force, generalized)


@numba.njit(cache=True)
def rolling_torque(generalized, x, force, normal, lever, at, n_q, fade_rate):
    """A copy of generalized (n_v,) with the torque of rolling resistance added.

    Args: x (n_q + n_v,) state; force (3,) of the contact [N]; normal (3,), its unit
        normal with either sign; lever, coefficient times radius [m]; at (2,), start of
        the angular velocity of ball and other body in v, or -1; fade_rate [rad/s].
    """
    generalized, v = generalized.copy(), x[n_q:]
    f_n = np.abs(np.sum(force * normal))
    omega = np.zeros(3)
    for body in range(2):
        if at[body] >= 0:
            omega += (1 - 2 * body) * v[at[body] : at[body] + 3]
    omega = omega - np.sum(omega * normal) * normal
    rate = np.sqrt(np.sum(omega * omega))
    torque = (-lever * f_n / np.maximum(rate, fade_rate)) * omega
    for body in range(2):
        if at[body] >= 0:
            generalized[at[body] : at[body] + 3] += (1 - 2 * body) * torque
    return generalized


def _ball(effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph):
    """The rolling free body of the pair, the other body, and the rolling radius [m].

    Raises: ValueError if no body is free and round, or the other is part of a
        mechanism.
    """
    ball, other = find_pair(effect, plant)
    if not ball.is_floating_base_body():
        ball, other = other, ball
    at = effect.at[0]
    if not ball.is_floating_base_body():
        raise ValueError(f"effect rolling_resistance at {at!r}: neither body is free")
    if not (other.is_floating_base_body() or plant.IsAnchored(other)):
        raise ValueError(
            f"effect rolling_resistance at {at!r}: {other.scoped_name()} is a link of "
            "a mechanism; expected a free or an anchored body"
        )
    radius = _rolling_radius(plant, scene_graph.model_inspector(), ball)
    if radius is None:
        raise ValueError(
            f"effect rolling_resistance at {at!r}: expected {ball.scoped_name()} to "
            "have spheres as collision geometry, or cylinders (and spheres) of one "
            "radius"
        )
    return ball, other, radius


def _rolling_radius(plant, inspector, body: RigidBody) -> float | None:
    """The radius on which a body rolls [m]; None if it is not round."""
    geometries = plant.GetCollisionGeometriesForBody(body)
    shapes = [inspector.GetShape(g) for g in geometries]
    if not shapes or not all(isinstance(s, (Sphere, Cylinder)) for s in shapes):
        return None
    radii = [shape.radius() for shape in shapes]
    if any(isinstance(s, Cylinder) for s in shapes):
        # On its side: all its shapes have to reach equally far from the axis.
        alike = max(radii) <= (1.0 + RADIUS_TOLERANCE) * min(radii)
        return max(radii) if alike else None
    # Several spheres form a bumpy object: the mean distance to which they reach.
    poses = [inspector.GetPoseInFrame(g).translation() for g in geometries]
    return float(np.mean(np.linalg.norm(poses, axis=1) + radii))


def rolls_against(pair: str, coefficient: float) -> Effect:
    """The rolling resistance of a pair; coefficient: lever arm over radius."""
    return Effect("rolling_resistance", [pair], {"coefficient": coefficient})


def rolling_values(effect: Effect, plant: MultibodyPlant, scene_graph) -> dict:
    _ball(effect, plant, scene_graph)
    return {"coefficient": 0.0}


def add_rolling_resistance(
    effect: Effect,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    builder: DiagramBuilder,
) -> OutputPort:
    coefficient = parameter(effect, "coefficient")
    ball, other, radius = _ball(effect, plant, scene_graph)
    at = effect.at[0]
    system = builder.AddNamedSystem(
        f"rolling_resistance_{at.replace('.', '_').replace('~', '_')}",
        RollingResistance(plant, ball, other, radius, coefficient),
    )
    builder.Connect(
        plant.get_contact_results_output_port(), system.GetInputPort("contact_results")
    )
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("state"))
    return system.GetOutputPort("generalized_force")

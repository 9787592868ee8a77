"""Effects in the contact of two bodies: friction, rolling resistance."""

import numba
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import ProximityProperties, Role, RoleAssign, SceneGraph, Sphere
from pydrake.multibody.plant import ContactResults, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort

from makebreak.models.effects.kind import Effect, EffectKind, find_pair, parameter

# Below this rate of rolling [rad/s] the resistance fades to zero (2 mm/s at the rim of
# a ball of 30 mm): it acts one step late, and without fading it would chatter.
FADE_RATE = 0.05


def _set_friction(
    effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Gives the pair its value by the surface of one of the two bodies alone.

    Drake combines two surfaces to mu = 2 mu1 mu2/(mu1 + mu2), so mu1 becomes
    mu mu2/(2 mu2 - mu). It is put on the body that is not free to move, so that a
    free ball's friction with table and with finger are set apart; if both or neither
    are free, on the first one named. Its pairs with third bodies change with it.
    """
    mu = parameter(effect, "friction")
    if not mu >= 0.0:
        raise ValueError(f"effect contact_friction: friction is {mu}, expected >= 0")
    changed, other = find_pair(effect, plant)
    if _is_free(plant, changed) and not _is_free(plant, other):
        changed, other = other, changed
    others = {
        _friction(scene_graph, g) for g in plant.GetCollisionGeometriesForBody(other)
    }
    if len(others) != 1:
        raise ValueError(
            f"effect contact_friction at {effect.at[0]!r}: {other.scoped_name()} has "
            f"surfaces of different friction, {sorted(others)}"
        )
    mu_other = others.pop()
    if not 2.0 * mu_other > mu:
        raise ValueError(
            f"effect contact_friction at {effect.at[0]!r}: friction {mu} needs a "
            f"surface of {other.scoped_name()} above {mu / 2.0}, it has {mu_other}"
        )
    mu_changed = mu * mu_other / (2.0 * mu_other - mu)
    for geometry in plant.GetCollisionGeometriesForBody(changed):
        properties = ProximityProperties(
            scene_graph.model_inspector().GetProximityProperties(geometry)
        )
        properties.UpdateProperty(
            "material", "coulomb_friction", CoulombFriction(mu_changed, mu_changed)
        )
        scene_graph.AssignRole(
            plant.get_source_id(), geometry, properties, RoleAssign.kReplace
        )


def _friction(scene_graph, geometry) -> float:
    inspector = scene_graph.model_inspector()
    properties = inspector.GetProperties(geometry, Role.kProximity)
    return properties.GetProperty("material", "coulomb_friction").dynamic_friction()


def _is_free(plant: MultibodyPlant, body: RigidBody) -> bool:
    """Before the plant is finalized: in no joint at all."""
    return not any(
        body.index() in (joint.child_body().index(), joint.parent_body().index())
        for joint in (plant.get_joint(i) for i in plant.GetJointIndices())
    )


class RollingResistance(LeafSystem):
    """The torque that resists the rolling of a free ball on another body.

        tau = -coefficient R f_n omega_t / max(|omega_t|, fade rate)

    with the ball's radius R [m], the normal force f_n [N] of the contact and the ball's
    rate of turn relative to the other body, along the surface, omega_t. The reaction
    acts on the other body. So a ball that rolls freely on a level table under its
    weight is slowed by coefficient g (5/7).

    Force and rate are those of the step before: the contact force of this step depends
    on the torque itself.

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
        # Where each body's torque is in v, and its rate of turn in the state after
        # the n_q positions, both in the world's axes. -1: anchored, it has neither.
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
        # Compiles it, for arrays of the kind that Drake gives.
        zero, up = np.zeros(self._n_v), np.ones(3)
        up.setflags(write=False)
        add_rolling_torque(zero, zero, np.ones(3), up, 0.0, self._at, FADE_RATE)

    def _update(self, context, discrete_state):
        generalized = np.zeros(self._n_v)
        results = self._results.Eval(context)
        ball, other = self._pair
        for i in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(i)
            a, b = int(contact.bodyA_index()), int(contact.bodyB_index())
            if (a == ball and b == other) or (a == other and b == ball):
                add_rolling_torque(
                    generalized,
                    self._x.Eval(context)[self._n_q :],
                    contact.contact_force(),
                    contact.point_pair().nhat_BA_W,
                    self._lever,
                    self._at,
                    FADE_RATE,
                )
        discrete_state.set_value(self._force, generalized)


@numba.njit(cache=True)
def add_rolling_torque(generalized, v, force, normal, lever, at, fade_rate):
    """Adds the torque of rolling resistance to generalized (n_v,), in place.

    Args: v (n_v,); force (3,) of the contact [N] and its unit normal (3,), either sign;
        lever [m]; at (2,): where ball and other body turn in v, or -1; fade_rate
        [rad/s].
    """
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


def _add_rolling_resistance(
    effect: Effect,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    builder: DiagramBuilder,
) -> OutputPort:
    coefficient = parameter(effect, "coefficient")
    if not coefficient >= 0.0:
        raise ValueError(
            f"effect rolling_resistance: coefficient is {coefficient}, expected >= 0"
        )
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
    inspector = scene_graph.model_inspector()
    shapes = [inspector.GetShape(g) for g in plant.GetCollisionGeometriesForBody(ball)]
    if len(shapes) != 1 or not isinstance(shapes[0], Sphere):
        raise ValueError(
            f"effect rolling_resistance at {at!r}: expected {ball.scoped_name()} to "
            "have one collision geometry, a sphere"
        )
    system = builder.AddNamedSystem(
        f"rolling_resistance_{at.replace('.', '_').replace('~', '_')}",
        RollingResistance(plant, ball, other, shapes[0].radius(), coefficient),
    )
    builder.Connect(
        plant.get_contact_results_output_port(), system.GetInputPort("contact_results")
    )
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("state"))
    return system.GetOutputPort("generalized_force")


KINDS = {
    "contact_friction": EffectKind(
        parameters=("friction",), before_finalize=_set_friction
    ),
    "rolling_resistance": EffectKind(
        parameters=("coefficient",), after_finalize=_add_rolling_resistance
    ),
}

"""Effects in the contact of two bodies: friction, stiffness, rolling resistance."""

import numba
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    ProximityProperties,
    RoleAssign,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import Joint, RigidBody
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort

from makebreak.models.effects.change_shape import (
    change_shape,
    keep_apart,
    not_colliding_with,
)
from makebreak.models.effects.contact_damper import ContactDamper
from makebreak.models.effects.kind import (
    Effect,
    EffectKind,
    Parameter,
    find_pair,
    full_name,
    parameter,
)

# Below this rate of rolling [rad/s] the resistance fades to zero (2 mm/s at the rim of
# a ball of 30 mm): it acts one step late, and without fading it would chatter.
FADE_RATE = 0.05


ALIKE = 0.02  # Shapes whose radii differ by no more than this share roll as one.
STANDS = 1e-3  # Of shapes that reach down to within this a body stands on all [m].

# What Drake takes where a shape has none of its own [N/m], [s/m]: MultibodyPlant's
# contact parameters of its defaults.
DEFAULT_DISSIPATION = 50.0


def _set_friction(
    effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Gives the pair its value by the surface of one of the two bodies alone.

    Drake combines two surfaces to mu = 2 mu1 mu2/(mu1 + mu2), so mu1 becomes
    mu mu2/(2 mu2 - mu). It is put on the body that is not free to move, so that a
    free ball's friction with table and with finger are set apart; if both or neither
    are free, on the first one named. Its pairs with third bodies change with it.
    A value of twice mu2 or more cannot be had so: then both surfaces become mu. Of a
    body with surfaces of several frictions those count that meet the other
    (_shapes_that_meet).
    """
    mu = parameter(effect, "friction")
    changed, other = _changed_and_other(effect, plant)
    mu_other = _friction_against(effect, plant, scene_graph, other, changed)
    if 2.0 * mu_other > mu or mu == 0.0:
        mu_changed = mu * mu_other / (2.0 * mu_other - mu) if mu > 0.0 else 0.0
    else:
        mu_changed = mu
        only = _shapes_that_meet(effect, plant, scene_graph, other, changed)
        _set_surface(plant, scene_graph, other, "coulomb_friction", _coulomb(mu), only)
    _set_surface(plant, scene_graph, changed, "coulomb_friction", _coulomb(mu_changed))


def _coulomb(mu: float) -> CoulombFriction:
    return CoulombFriction(mu, mu)


def _changed_and_other(effect: Effect, plant) -> tuple[RigidBody, RigidBody]:
    changed, other = find_pair(effect, plant)
    if _is_free(plant, changed) and not _is_free(plant, other):
        changed, other = other, changed
    return changed, other


def _shapes(plant, scene_graph, body):
    """Ids and properties of the shapes of a body that can be touched."""
    inspector = scene_graph.model_inspector()
    for geometry in plant.GetCollisionGeometriesForBody(body):
        properties = inspector.GetProximityProperties(geometry)
        if properties is not None:
            yield geometry, properties


def _set_surface(plant, scene_graph, body, name: str, value, only=None) -> None:
    """Of all shapes of a body, or of those in `only`."""
    for geometry, old in list(_shapes(plant, scene_graph, body)):
        if only is not None and geometry not in only:
            continue
        properties = ProximityProperties(old)
        properties.UpdateProperty("material", name, value)
        scene_graph.AssignRole(
            plant.get_source_id(), geometry, properties, RoleAssign.kReplace
        )


def _only(effect, plant, scene_graph, body, read, what: str) -> float:
    """The one value that all shapes of a body have. Raises: ValueError."""
    values = {read(properties) for _, properties in _shapes(plant, scene_graph, body)}
    if len(values) != 1:
        raise ValueError(
            f"effect {effect.kind} at {effect.at[0]!r}: {body.scoped_name()} has "
            f"surfaces of different {what}, {sorted(values)}"
        )
    return values.pop()


def _friction(properties: ProximityProperties) -> float:
    return properties.GetProperty("material", "coulomb_friction").dynamic_friction()


def _friction_against(effect, plant, scene_graph, body, other) -> float:
    """The one friction that a body has where it meets another. Raises: ValueError."""
    meets = _shapes_that_meet(effect, plant, scene_graph, body, other)
    return {g: _friction(p) for g, p in _shapes(plant, scene_graph, body)}[meets[0]]


def _shapes_that_meet(effect, plant, scene_graph, body, other) -> list:
    """The shapes of a body that count for its friction with another: all, if they are
    alike. Of a free body with several frictions those on which it stands as it was
    modelled, along z, meet what does not move; the others meet what does.

    Raises: ValueError if even these differ.
    """
    frictions = {g: _friction(p) for g, p in _shapes(plant, scene_graph, body)}
    if len(set(frictions.values())) <= 1:
        return list(frictions)
    inspector = scene_graph.model_inspector()
    reach = {g: _lowest(inspector, g) for g in frictions}
    low = {g: z for g, z in reach.items() if z is not None}
    found = list(frictions)
    if _is_free(plant, body) and len(low) == len(frictions):
        least = min(low.values())
        stands = [g for g in frictions if low[g] < least + STANDS]
        fixed = not _is_free(plant, other) and not _moves(plant, other)
        found = stands if fixed else [g for g in frictions if g not in stands]
    if len({frictions[g] for g in found}) != 1:
        raise ValueError(
            f"effect {effect.kind} at {effect.at[0]!r}: {body.scoped_name()} has "
            f"surfaces of different friction, {sorted(set(frictions.values()))}"
        )
    return found


def _lowest(inspector, geometry) -> float | None:
    """How far down its body's z a shape reaches [m]; None if that is not known."""
    shape, X = inspector.GetShape(geometry), inspector.GetPoseInFrame(geometry)
    z, down = X.translation()[2], abs(X.rotation().matrix()[2])
    if isinstance(shape, Sphere):
        return z - shape.radius()
    if isinstance(shape, Box):
        return z - down @ shape.size() / 2.0
    if isinstance(shape, (Cylinder, Capsule)):
        side = shape.radius()
        if isinstance(shape, Cylinder):
            side *= np.sqrt(max(1.0 - down[2] ** 2, 0.0))
        return z - down[2] * shape.length() / 2.0 - side
    return None


def _joints_above(plant: MultibodyPlant, body: RigidBody) -> list[Joint]:
    """Those that carry the body; none: it floats, if it is not the world."""
    joints = (plant.get_joint(i) for i in plant.GetJointIndices())
    return [j for j in joints if j.child_body().index() == body.index()]


def _moves(plant: MultibodyPlant, body: RigidBody) -> bool:
    """Whether a joint that can move lies between a body and the world."""
    here = body
    while here.index() != plant.world_body().index():
        up = _joints_above(plant, here)
        if not up or up[0].num_velocities() > 0:
            return True
        here = up[0].parent_body()
    return False


def _stiffness(properties: ProximityProperties) -> float:
    """inf where the shape has none of its own: Drake guesses it from the weights."""
    return properties.GetPropertyOrDefault(
        "material", "point_contact_stiffness", np.inf
    )


def _dissipation(properties: ProximityProperties) -> float:
    return properties.GetPropertyOrDefault(
        "material", "hunt_crossley_dissipation", DEFAULT_DISSIPATION
    )


def _set_stiffness(
    effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Drake combines two surfaces as springs in a row, k = k1 k2/(k1 + k2). Both are
    scaled alike, so that the point of contact stays where it is between them."""
    k = parameter(effect, "stiffness")
    changed, other = _changed_and_other(effect, plant)
    k1 = _only(effect, plant, scene_graph, changed, _stiffness, "stiffness")
    k2 = _only(effect, plant, scene_graph, other, _stiffness, "stiffness")
    if np.isfinite([k1, k2]).all():
        scale = k * (k1 + k2) / (k1 * k2)
        k1, k2 = scale * k1, scale * k2
    else:
        k1 = k2 = 2.0 * k
    _set_surface(plant, scene_graph, changed, "point_contact_stiffness", k1)
    _set_surface(plant, scene_graph, other, "point_contact_stiffness", k2)


def _set_dissipation(
    effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Drake weighs two surfaces by their stiffness, the softer one counts more:
    d = (k2 d1 + k1 d2)/(k1 + k2). As with friction one is changed if that will do, else
    both become d."""
    if (
        plant.get_discrete_contact_approximation().name == "kSap"
        and plant.time_step() > 0.0
    ):
        raise ValueError(
            "effect contact_dissipation: the approximation `sap` has no Hunt-Crossley "
            "dissipation; expected `lagged`, `similar` or `tamsi`"
        )
    d = parameter(effect, "dissipation")
    changed, other = _changed_and_other(effect, plant)
    k1 = _only(effect, plant, scene_graph, changed, _stiffness, "stiffness")
    k2 = _only(effect, plant, scene_graph, other, _stiffness, "stiffness")
    d2 = _only(effect, plant, scene_graph, other, _dissipation, "dissipation")
    d1 = -1.0
    if np.isfinite([k1, k2]).all():
        d1 = (d * (k1 + k2) - k1 * d2) / k2
    if d1 < 0.0:
        d1 = d
        _set_surface(plant, scene_graph, other, "hunt_crossley_dissipation", d)
    _set_surface(plant, scene_graph, changed, "hunt_crossley_dissipation", d1)


def _now(effect: Effect, plant: MultibodyPlant, scene_graph) -> dict[str, float]:
    """The pair's values as Drake combines them."""
    a, b = find_pair(effect, plant)

    def both(read, what):
        return (_only(effect, plant, scene_graph, body, read, what) for body in (a, b))

    if effect.kind == "contact_friction":
        mu1 = _friction_against(effect, plant, scene_graph, a, b)
        mu2 = _friction_against(effect, plant, scene_graph, b, a)
        return {"friction": _both(mu1, mu2)}
    k1, k2 = both(_stiffness, "stiffness")
    if effect.kind == "contact_stiffness":
        # What Drake guesses where none is given it does not say: a stiff value.
        finite = [k for k in (k1, k2) if np.isfinite(k)]
        stiffness = 1.0 / sum(1.0 / k for k in finite) if finite else 1e6
        return {"stiffness": stiffness}
    d1, d2 = both(_dissipation, "dissipation")
    if not np.isfinite([k1, k2]).all():
        return {"dissipation": (d1 + d2) / 2.0}
    return {"dissipation": (k2 * d1 + k1 * d2) / (k1 + k2)}


def _both(mu1: float, mu2: float) -> float:
    """As Drake combines two surfaces' friction."""
    return 2.0 * mu1 * mu2 / (mu1 + mu2) if mu1 + mu2 > 0.0 else 0.0


# ----- friction_patch

FAR = 100.0  # Half width of what a half-space becomes, and a box's depth [m].


def _level_ground(effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph):
    """The ground's shapes, flush on top: their ids, shapes, and poses in the world.

    Raises: ValueError if they are not one level box or half-space, or level boxes that
        are flush, such as an earlier patch leaves.
    """
    ground, _ = _changed_and_other(effect, plant)
    where = f"effect friction_patch at {effect.at[0]!r}"
    X_WB = anchored_pose(effect, plant, ground)
    inspector = scene_graph.model_inspector()
    found = []
    for geometry, _ in _shapes(plant, scene_graph, ground):
        X_WG = X_WB @ inspector.GetPoseInFrame(geometry)
        found.append((geometry, inspector.GetShape(geometry), X_WG))
    kinds = {type(shape) for _, shape, _ in found}
    if kinds != {Box} and not (kinds == {HalfSpace} and len(found) == 1):
        raise ValueError(
            f"{where}: expected {full_name(plant, ground)} to have one collision shape,"
            " a box or a half-space"
        )
    tops = []
    for _, shape, X_WG in found:
        R = X_WG.rotation().matrix()
        level = abs(R[2, 2]) > 1.0 - 1e-9
        square = np.allclose(np.sort(abs(R), axis=0)[:2], 0.0, atol=1e-6)
        if not level or (isinstance(shape, Box) and not square):
            raise ValueError(
                f"{where}: expected {full_name(plant, ground)} level, its sides along "
                "x, y"
            )
        tops.append(_span(shape, X_WG)[1][2])
    if np.ptp(tops) > 1e-9:
        raise ValueError(
            f"{where}: expected the shapes of {full_name(plant, ground)} to be flush"
        )
    return found


def _span(shape: Box | HalfSpace, X_WG: RigidTransform):
    """(3,) from and to, in the world; of a half-space FAR about the world's origin."""
    centre = X_WG.translation()
    if isinstance(shape, Box):
        half = abs(X_WG.rotation().matrix()) @ (shape.size() / 2.0)
        return centre - half, centre + half
    return np.array([-FAR, -FAR, centre[2] - FAR]), np.array([FAR, FAR, centre[2]])


def _patch_now(effect: Effect, plant: MultibodyPlant, scene_graph) -> dict[str, float]:
    """No values are neutral. Raises: ValueError where there can be no patch."""
    _level_ground(effect, plant, scene_graph)
    return {}


def _patch(effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Cuts each shape of the ground into its part of the patch and what is around it.

    Tops are flush. A friction that needs a rougher thing makes it so, and what is
    around the patch smoother; the thing's pairs with third bodies change with it. What
    slides over the edge touches both for a moment: a sphere of radius R that sinks in
    by s does so for sqrt(8 R s). Of patches that overlap the later one counts.
    """
    p = effect.parameters
    where = f"effect friction_patch at {effect.at[0]!r}"
    if p["x_min"] >= p["x_max"] or p["y_min"] >= p["y_max"]:
        raise ValueError(f"{where}: the patch is empty: {p}")
    ground, thing = _changed_and_other(effect, plant)
    shapes = _level_ground(effect, plant, scene_graph)
    X_BW = anchored_pose(effect, plant, ground).inverse()
    inspector = scene_graph.model_inspector()
    mu = p["friction"]
    mu_thing = _friction_against(effect, plant, scene_graph, thing, ground)
    # Only a rougher thing can have more: then the ground around becomes smoother.
    rougher = mu if not 2.0 * mu_thing > mu else mu_thing
    mu_patch = mu * rougher / (2.0 * rougher - mu) if mu > 0.0 else 0.0
    source, met, more = plant.get_source_id(), False, []
    for number, (geometry, shape, X_WG) in enumerate(shapes):
        low, high = _span(shape, X_WG)
        # A copy: the original will have changed.
        old = ProximityProperties(inspector.GetProximityProperties(geometry))
        apart = not_colliding_with(scene_graph, geometry)
        around = _both(_friction(old), mu_thing)
        mu_ground = around * rougher / (2.0 * rougher - around)
        x = np.clip([low[0], p["x_min"], p["x_max"], high[0]], low[0], high[0])
        y = np.clip([low[1], p["y_min"], p["y_max"], high[1]], low[1], high[1])
        inside = x[1] < x[2] and y[1] < y[2]
        met |= bool(inside)
        # Its part of the patch; strips left and right; strips before and behind it.
        pieces = [
            (x[1], x[2], y[1], y[2]),
            (x[0], x[1], y[0], y[3]),
            (x[2], x[3], y[0], y[3]),
            (x[1], x[2], y[0], y[1]),
            (x[1], x[2], y[2], y[3]),
        ]
        if not inside:
            pieces = [(low[0], high[0], low[1], high[1])]
        pieces = [each for each in pieces if each[0] < each[1] and each[2] < each[3]]
        for i, (x0, x1, y0, y1) in enumerate(pieces):
            box = Box(x1 - x0, y1 - y0, high[2] - low[2])
            middle = [(x0 + x1) / 2.0, (y0 + y1) / 2.0, (low[2] + high[2]) / 2.0]
            X_BG = X_BW @ RigidTransform(middle)
            mu_piece = _coulomb(mu_patch if inside and i == 0 else mu_ground)
            properties = ProximityProperties(old)
            properties.UpdateProperty("material", "coulomb_friction", mu_piece)
            if i == 0:
                change_shape(plant, scene_graph, geometry, box, X_BG)
                scene_graph.AssignRole(
                    source, geometry, properties, RoleAssign.kReplace
                )
            else:
                name = f"{ground.name()}_of_{len(shapes)}_{number}_around_patch_{i}"
                more.append((apart, X_BG, box, name, properties))
    for apart, *piece in more:  # After the rest: Drake's ids of the shapes end here.
        keep_apart(
            scene_graph, [plant.RegisterCollisionGeometry(ground, *piece)], apart
        )
    if not met:
        raise ValueError(f"{where}: the patch is off {full_name(plant, ground)}")
    if rougher != mu_thing:
        only = _shapes_that_meet(effect, plant, scene_graph, thing, ground)
        _set_surface(plant, scene_graph, thing, "coulomb_friction", _coulomb(mu), only)


def anchored_pose(
    effect: Effect, plant: MultibodyPlant, body: RigidBody
) -> RigidTransform:
    """Pose in the world of a body that welds hold there, before the plant is finalized.

    Raises: ValueError if something moves it.
    """
    X = RigidTransform()  # From the body's frame to the frame reached.
    here = body
    while here.index() != plant.world_body().index():
        up = _joints_above(plant, here)
        if not up or up[0].num_velocities() > 0:
            raise ValueError(
                f"effect {effect.kind} at {effect.at}: expected "
                f"{full_name(plant, body)} to be welded to the world"
            )
        (weld,) = up
        X_PF = weld.frame_on_parent().GetFixedPoseInBodyFrame()
        X_CM = weld.frame_on_child().GetFixedPoseInBodyFrame()
        X = X_PF @ weld.X_FM() @ X_CM.inverse() @ X
        here = weld.parent_body()
    return X


def _is_free(plant: MultibodyPlant, body: RigidBody) -> bool:
    """In no joint at all, but for the one that Finalize gives to each free body."""
    return not any(
        body.index() in (joint.child_body().index(), joint.parent_body().index())
        for joint in (plant.get_joint(i) for i in plant.GetJointIndices())
        if not joint.is_ephemeral()
    )


class RollingResistance(LeafSystem):
    """The torque that resists the rolling of a free ball, or a cylinder that lies, on
    another body.

        tau = -coefficient R f_n omega_t / max(|omega_t|, fade rate)

    with the ball's radius R [m], the normal force f_n [N] of each contact and the
    ball's rate of turn relative to the other body, along the surface, omega_t. The
    reaction acts on the other body. So a ball that rolls freely on a level table under
    its weight is slowed by coefficient g (5/7), a full cylinder by coefficient g (2/3).

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
        discrete_state.set_value(self._force, generalized)


@numba.njit(cache=True)
def rolling_torque(generalized, x, force, normal, lever, at, n_q, fade_rate):
    """generalized (n_v,) with the torque of rolling resistance added, a new array.

    Args: x (n_q + n_v,) state; force (3,) of the contact [N] and its unit normal (3,),
        either sign; lever [m]; at (2,): where ball and other body turn in v, or -1;
        fade_rate [rad/s].
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
    """The free body of the pair that rolls, the other one, and the radius [m].

    Raises: ValueError if it is no such pair.
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
    """On which a body rolls [m]; None: it is not round."""
    geometries = plant.GetCollisionGeometriesForBody(body)
    shapes = [inspector.GetShape(g) for g in geometries]
    if not shapes or not all(isinstance(s, (Sphere, Cylinder)) for s in shapes):
        return None
    radii = [shape.radius() for shape in shapes]
    if any(isinstance(s, Cylinder) for s in shapes):
        # One that lies: its spheres and cylinders reach equally far from its axis.
        return max(radii) if max(radii) <= (1.0 + ALIKE) * min(radii) else None
    # Several spheres make a bumpy object, about as large as they reach on average.
    poses = [inspector.GetPoseInFrame(g).translation() for g in geometries]
    return float(np.mean(np.linalg.norm(poses, axis=1) + radii))


def rolls_against(pair: str, coefficient: float) -> Effect:
    """The rolling resistance of a pair, for a scene. Args: coefficient: lever arm over
    radius."""
    return Effect("rolling_resistance", [pair], {"coefficient": coefficient})


def _rolling_now(effect: Effect, plant: MultibodyPlant, scene_graph) -> dict:
    _ball(effect, plant, scene_graph)
    return {"coefficient": 0.0}


def _add_rolling_resistance(
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


def _undamp(effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Hunt and Crossley's damping of the pair makes room for the linear damper."""
    for body in find_pair(effect, plant):
        _set_surface(plant, scene_graph, body, "hunt_crossley_dissipation", 0.0)


def _add_damper(
    effect: Effect,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    builder: DiagramBuilder,
) -> OutputPort:
    stiffness, friction = (
        _now(Effect(kind, effect.at, {}), plant, scene_graph)[name]
        for kind, name in ((STIFFNESS, "stiffness"), ("contact_friction", "friction"))
    )
    damper = builder.AddNamedSystem(
        f"contact_damper_{effect.at[0].replace('.', '_').replace('~', '_')}",
        ContactDamper(
            plant,
            find_pair(effect, plant),
            stiffness,
            parameter(effect, "damping"),
            friction,
        ),
    )
    builder.Connect(plant.get_state_output_port(), damper.GetInputPort("state"))
    builder.Connect(scene_graph.get_query_output_port(), damper.GetInputPort("query"))
    return damper.GetOutputPort("generalized_force")


# How hard two shapes are to each other, and what a touch of theirs loses.
CONTACT_LAW = (STIFFNESS, DISSIPATION) = ("contact_stiffness", "contact_dissipation")
DAMPER = "contact_damping"  # In the place of the dissipation.

KINDS = {
    "contact_friction": EffectKind(
        at="pair",
        # What holds may be any larger: there a fit ends.
        parameters=(
            Parameter("friction", "", 0.01, 1.5, None, valid=">= 0", ends=True),
        ),
        says="the friction coefficient of {at} is {friction}",
        confused_with=("plane_tilt", "contact_dissipation", "object_com"),
        tell_apart="let it slide both ways, and look at windows of 0.1 s or longer",
        before_finalize=_set_friction,
        now=_now,
    ),
    "friction_patch": EffectKind(
        at="pair",
        several=True,
        parameters=(
            # With ever more of it a patch shrinks to a point.
            Parameter("friction", "", 0.01, 1.5, None, valid=">= 0", ends=True),
            *(
                Parameter(f"{a}_{end}", "m", -2.0, 2.0, None, endless=True)
                for a in "xy"
                for end in ("min", "max")
            ),
        ),
        says="where x is {x_min} to {x_max} and y is {y_min} to {y_max}, the friction "
        "coefficient of {at} is {friction}",
        confused_with=("contact_friction", "plane_tilt"),
        tell_apart="slide over the place in another direction, and beside it",
        contains=("contact_friction",),  # A patch of all that was slid over.
        rank=1,
        before_finalize=_patch,
        now=_patch_now,
    ),
    "rolling_resistance": EffectKind(
        at="pair",
        parameters=(Parameter("coefficient", "", 0.0, 0.1, valid=">= 0"),),
        says="{at} rolls against a resistance of {coefficient} (times the radius: the "
        "lever arm) that the model lacks",
        confused_with=("body_drag", "plane_tilt"),
        tell_apart="roll at two speeds, and both ways: the resistance slows evenly",
        after_finalize=_add_rolling_resistance,
        now=_rolling_now,
    ),
    "contact_stiffness": EffectKind(
        at="pair",
        parameters=(Parameter("stiffness", "N/m", 300.0, 1e6, None, valid="> 0"),),
        says="the contact of {at} has a stiffness of {stiffness}",
        confused_with=("plane_height", "object_size", "contact_dissipation"),
        tell_apart="compare impacts with how deep it lies at rest",
        before_finalize=_set_stiffness,
        now=_now,
    ),
    "contact_dissipation": EffectKind(
        at="pair",
        parameters=(Parameter("dissipation", "s/m", 0.0, 100.0, None, valid=">= 0"),),
        says="the contact of {at} has a dissipation of {dissipation}",
        confused_with=("contact_stiffness", "contact_friction", "corner_radius"),
        tell_apart="let it hit at two speeds",
        rank=1,
        before_finalize=_set_dissipation,
        now=_now,
    ),
    "contact_damping": EffectKind(
        at="pair",
        parameters=(Parameter("damping", "N s/m", 0.0, 1e4, None, valid=">= 0"),),
        says="the contact of {at} is damped by a linear damper of {damping}, not by "
        "Hunt and Crossley's",
        confused_with=("contact_dissipation", "contact_stiffness"),
        tell_apart="let it hit at several speeds: a linear damper takes the same share "
        "of each",
        rank=2,  # Behind the dissipation, in whose place it is.
        before_finalize=_undamp,
        after_finalize=_add_damper,
        now=lambda effect, plant, scene_graph: {},
    ),
}

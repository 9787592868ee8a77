"""Friction that depends on the place, on one flat body without seams.

Drake's friction belongs to a shape. Two boxes side by side are no flat surface: where a
rounded foot stands over the seam it touches both, and is held up twice. So one body
has the smallest friction, which Drake's solver knows, and where there is more the
rest is a force on what slides:

    f = -(mu(p) - mu_0) f_n v_t / max(|v_t|, FADE_SPEED)

at each point p of contact, f_n [N] its normal force and v_t [m/s] the velocity there
along the surface. The normal force is that of the step before, as in Drake's own
`lagged` contact. Below FADE_SPEED this part is viscous: at rest only mu_0 holds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numba
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import (
    ContactResults,
    ExternallyAppliedSpatialForce,
    MultibodyPlant,
)
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import LeafSystem

# It acts explicitly: 0.5 times 12 N over 5 mm/s is 1200 N s/m, which takes a mass of
# 4 kg 30 % of its speed in a step of 1 ms.
FADE_SPEED = 0.005  # [m/s]
MOST_FRICTION = 1e3
N_POINTS = 16  # Of contact that are remembered; a block's face has 4.
_POINT = 7  # Of each: p_WC, the normal, (mu(p) - mu_0) f_n.


@dataclass
class FrictionZone:
    """Where a pair's friction is greater than its bodies' own.

    at: contact pair `<a>~<b>`, one of them welded to the world. x, y: from, to, in the
    world [m]; `to` belongs to the next zone. Of zones that overlap the first counts.
    """

    at: str = ""
    friction: float = 0.0
    x: list[float] = field(default_factory=lambda: [-1e3, 1e3])
    y: list[float] = field(default_factory=lambda: [-1e3, 1e3])


def check_zones(zones: Sequence[FrictionZone]) -> None:
    """Raises: ValueError for a zone that is none, and for zones of several pairs."""
    for zone in zones:
        where = f"friction zone at {zone.at!r}"
        if not 0.0 <= zone.friction <= MOST_FRICTION:
            raise ValueError(
                f"{where}: friction is {zone.friction}, expected >= 0 and at most "
                f"{MOST_FRICTION:g}"
            )
        for name in "xy":
            span = getattr(zone, name)
            if len(span) != 2 or not -1e6 <= span[0] < span[1] <= 1e6:
                raise ValueError(f"{where}: {name} is {span}, expected [from, to]")
        if zone.at != zones[0].at:
            raise ValueError(
                f"{where}: the first is at {zones[0].at!r}, expected one pair"
            )


class FrictionZones(LeafSystem):
    """The friction of zones beyond that of the pair's own surfaces.

    Inputs:
        contact_results, body_poses, body_spatial_velocities of the plant (abstract).
        spatial_forces (list[ExternallyAppliedSpatialForce]), optional: others', which
            are passed on.
    Outputs: spatial_forces (list[ExternallyAppliedSpatialForce]).

    The points of contact and their normal forces are discrete state.

    Args: thing, the body that slides on the anchored body ground; friction, of the pair
        as Drake combines it; zones.
    Raises: ValueError if a zone has less than `friction`.
    """

    def __init__(
        self,
        thing: RigidBody,
        ground: RigidBody,
        friction: float,
        zones: Sequence[FrictionZone],
        period_sec: float,
    ):
        super().__init__()
        self._thing, self._pair = thing.index(), {thing.index(), ground.index()}
        rows = [[*z.x, *z.y, z.friction - friction] for z in zones]
        self._zones = np.array(rows, dtype=float)
        if (self._zones[:, 4] < -1e-9).any():
            raise ValueError(
                f"a friction zone at {zones[0].at!r} has less than the pair's own "
                f"friction, {friction:g}; expected that or more"
            )
        self._results = self.DeclareAbstractInputPort(
            "contact_results", AbstractValue.Make(ContactResults())
        )
        self._poses = self.DeclareAbstractInputPort(
            "body_poses", AbstractValue.Make([RigidTransform()])
        )
        self._velocities = self.DeclareAbstractInputPort(
            "body_spatial_velocities", AbstractValue.Make([SpatialVelocity.Zero()])
        )
        none = AbstractValue.Make([ExternallyAppliedSpatialForce()])
        self._others = self.DeclareAbstractInputPort("spatial_forces", none)
        points = self.DeclareDiscreteState(N_POINTS * _POINT)
        self._points = points
        # Without the contact results: they depend on these forces.
        self.DeclareAbstractOutputPort(
            "spatial_forces",
            lambda: none.Clone(),
            self._calc,
            {
                self.discrete_state_ticket(points),
                self._poses.ticket(),
                self._velocities.ticket(),
                self._others.ticket(),
            },
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._update)
        read_only = np.zeros(N_POINTS * _POINT)
        read_only.setflags(write=False)
        zone_force(read_only, np.zeros(3), np.zeros(3), np.zeros(3))  # Compiles it.

    def _update(self, context, discrete_state):
        points, n = np.zeros((N_POINTS, _POINT)), 0
        results = self._results.Eval(context)
        for i in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(i)
            if {contact.bodyA_index(), contact.bodyB_index()} != self._pair:
                continue
            p = contact.contact_point()
            more = friction_at(self._zones, p)
            if more > 0.0 and n < N_POINTS:
                normal = np.array(contact.point_pair().nhat_BA_W)
                points[n, :3], points[n, 3:6] = p, normal
                points[n, 6] = more * abs(contact.contact_force() @ normal)
                n += 1
        discrete_state.set_value(self._points, points.ravel())

    def _calc(self, context, output):
        V_WB = self._velocities.Eval(context)[self._thing]
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = self._thing
        applied.p_BoBq_B = np.zeros(3)
        applied.F_Bq_W = SpatialForce(
            zone_force(
                context.get_discrete_state(self._points).value(),
                np.array(self._poses.Eval(context)[self._thing].translation()),
                np.array(V_WB.translational()),
                np.array(V_WB.rotational()),
            )
        )
        others = self._others.Eval(context) if self._others.HasValue(context) else []
        output.set_value([*others, applied])


def friction_at(zones, p) -> float:
    """What the zones (n, 5) = [x, x, y, y, friction], from and to, have at p (2 or 3,);
    0 outside of them."""
    for x0, x1, y0, y1, friction in zones:
        if x0 <= p[0] < x1 and y0 <= p[1] < y1:
            return float(friction)
    return 0.0


@numba.njit(cache=True)
def zone_force(points, p_WB, v, w):
    """(6,) spatial force on the body at its origin, torque first, world axes.

    Args: points (N_POINTS * 7,), of each its place p_WC [m], normal, and the friction
        force that it has when it slides [N]; p_WB (3,) [m], v (3,) [m/s] and w (3,)
        [rad/s] of the body's origin.
    """
    F = np.zeros(6)
    rows = points.reshape(-1, 7)
    for i in range(rows.shape[0]):
        if rows[i, 6] <= 0.0:
            continue
        r = rows[i, :3] - p_WB
        n = rows[i, 3:6]
        v_C = v + np.cross(w, r)
        slip = v_C - np.sum(v_C * n) * n
        speed = np.sqrt(np.sum(slip * slip))
        f = (-rows[i, 6] / max(speed, FADE_SPEED)) * slip
        F[:3] += np.cross(r, f)
        F[3:] += f
    return F


def add_friction_zones(zones, pair, friction, plant: MultibodyPlant, builder, before):
    """Adds the system of a scene's zones to its plant.

    Args: pair of bodies; friction, of that pair; before: a port with spatial forces
        that the plant gets already, or None.
    Raises: ValueError if neither body is welded to the world, or both are.
    """
    ground, thing = pair
    if not plant.IsAnchored(ground):
        ground, thing = thing, ground
    if not plant.IsAnchored(ground) or plant.IsAnchored(thing):
        raise ValueError(
            f"friction zone at {zones[0].at!r}: expected one body welded to the world, "
            "and one that moves"
        )
    system = builder.AddNamedSystem(
        "friction_zones",
        FrictionZones(thing, ground, friction, zones, plant.time_step() or 0.001),
    )
    for port, name in (
        (plant.get_contact_results_output_port(), "contact_results"),
        (plant.get_body_poses_output_port(), "body_poses"),
        (plant.get_body_spatial_velocities_output_port(), "body_spatial_velocities"),
    ):
        builder.Connect(port, system.GetInputPort(name))
    target = plant.get_applied_spatial_force_input_port()
    if before is not None:
        builder.Disconnect(before, target)
        builder.Connect(before, system.GetInputPort("spatial_forces"))
    builder.Connect(system.get_output_port(), target)
    return system

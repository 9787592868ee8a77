"""Friction that depends on the place, on one flat body without seams.

In Drake friction belongs to a shape, and two boxes side by side are no flat surface: a
rounded foot over the seam touches both and is supported twice. So one body has the
smallest friction mu_0 in Drake's solver, and additional friction is a force on the
sliding body:

    f = -(mu(p) - mu_0) f_n v_t / max(|v_t|, FADE_SPEED)

at each contact point p, with the normal force f_n [N] and the tangential velocity v_t
[m/s]. The normal force is that of the step before, as in Drake's `lagged` contact.
Below FADE_SPEED this part is viscous: at rest only mu_0 acts.
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

import makebreak.systems.numerics.code_cache  # noqa: F401  (before its functions)

# The force is explicit in time: 0.5 times 12 N over 5 mm/s is 1200 N s/m, which takes
# 30 % of the speed of 4 kg in a step of 1 ms.
FADE_SPEED = 0.005  # [m/s]
FRICTION_MAX = 1e3
N_POINTS = 16  # Largest number of contact points in the state; a block's face has 4.
_POINT = 7  # Numbers of a point: p_WC, the normal, (mu(p) - mu_0) f_n.


@dataclass
class FrictionZone:
    """A rectangle in which a pair's friction is greater than its bodies' own.

    at: contact pair `<a>~<b>`, one of them welded to the world. x, y: [from, to) in the
    world [m]. Where zones overlap the first one counts.
    """

    at: str = ""
    friction: float = 0.0
    x: list[float] = field(default_factory=lambda: [-1e3, 1e3])
    y: list[float] = field(default_factory=lambda: [-1e3, 1e3])


def check_zones(zones: Sequence[FrictionZone]) -> None:
    """Raises: ValueError for a zone out of range, or zones of several pairs."""
    for zone in zones:
        where = f"friction zone at {zone.at!r}"
        if not 0.0 <= zone.friction <= FRICTION_MAX:
            raise ValueError(
                f"{where}: friction is {zone.friction}, expected >= 0 and at most "
                f"{FRICTION_MAX:g}"
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
    """The force of the zones' friction beyond that of the pair's own surfaces.

    Inputs:  contact_results, body_poses, body_spatial_velocities (abstract) of the
             plant; spatial_forces (list[ExternallyAppliedSpatialForce]), optional:
             further forces, which are passed on.
    Outputs: spatial_forces (list[ExternallyAppliedSpatialForce]).
    State:   contact points and their normal forces.

    Args: thing: the body that slides; ground: the anchored body; friction: of the pair
        as Drake combines it; zones; period_sec: of the plant.
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
        # Not on the contact results, which depend on these forces.
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
    """Friction at p (2 or 3,) of zones (n, 5) = [x from, x to, y from, y to, friction];
    0 outside of them."""
    for x0, x1, y0, y1, friction in zones:
        if x0 <= p[0] < x1 and y0 <= p[1] < y1:
            return float(friction)
    return 0.0


@numba.njit(cache=True)
def zone_force(points, p_WB, v, w):
    """Spatial force (6,) on the body at its origin, torque first, in world axes.

    Args: points (N_POINTS * 7,): of each p_WC [m], normal, and its sliding friction
        force [N]; p_WB (3,) [m], v (3,) [m/s], w (3,) [rad/s]: of the body's origin.
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
    """Adds a FrictionZones system to a plant.

    Args: pair: of bodies; friction: of that pair; before: the port that is connected to
        the plant's spatial forces so far, or None.
    Raises: ValueError unless exactly one body is welded to the world.
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

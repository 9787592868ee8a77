"""The planner's model of an arm that rolls a ball: a point mass that a force moves, and
a free ball on a table. It has no arm: the impedance controller makes the arm's tip act
like the point mass."""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    MultibodyPlant,
)
from pydrake.multibody.tree import (
    PrismaticJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.framework import DiagramBuilder

from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    P_TIP,
    V_BALL,
    V_TIP,
)

UNUSED_FRICTION = CoulombFriction(1.0, 1.0)  # An LCS has the friction of its pairs.


@dataclass
class TipAndBall:
    """The plant of a tip and a ball, for a planner."""

    tip_mass: float = 1.0  # [kg]
    tip_radius: float = 0.0195  # [m]
    ball_mass: float = 0.07  # [kg]
    ball_radius: float = 0.0315  # [m]


def make_tip_and_ball(config: TipAndBall):
    """The planner's model.

    Returns: (diagram, plant, scene_graph) with the bodies `tip` and `ball`, spheres,
        and `table`, a wide box with its top at z = 0. u (3,) is the force on the tip
        [N], which has no weight (the arm carries it). The state is that of
        contact_mpc/numerics/ball_state.py.
    Raises: ValueError for a setting out of range.
    """
    for name in ("ball_mass", "ball_radius"):
        _check_positive(config, name)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    add_tip(plant, config)
    ball = plant.AddRigidBody(
        "ball",
        plant.AddModelInstance("ball"),
        SpatialInertia.SolidSphereWithMass(config.ball_mass, config.ball_radius),
    )
    plant.RegisterCollisionGeometry(
        ball,
        RigidTransform.Identity(),
        Sphere(config.ball_radius),
        "ball",
        UNUSED_FRICTION,
    )
    add_table(plant)
    plant.Finalize()
    check_layout(plant, ball)
    return builder.Build(), plant, scene_graph


def _check_positive(config: TipAndBall, name: str) -> None:
    if not getattr(config, name) > 0.0:
        raise ValueError(f"{name} is {getattr(config, name)}, expected > 0")


def add_tip(plant: MultibodyPlant, config: TipAndBall) -> None:
    """Adds the body `tip`, a sphere with mass but without weight, moved by a force (3,)
    [N]."""
    for name in ("tip_mass", "tip_radius"):
        _check_positive(config, name)
    arm = plant.AddModelInstance("tip")
    no_mass = SpatialInertia(
        0.0, np.zeros(3), UnitInertia(0.0, 0.0, 0.0), skip_validity_check=True
    )
    tip_inertia = SpatialInertia.SolidSphereWithMass(config.tip_mass, config.tip_radius)
    parent = plant.world_body()
    for axis, name in enumerate("xyz"):
        last = name == "z"
        body = plant.AddRigidBody(
            "tip" if last else f"tip_{name}", arm, tip_inertia if last else no_mass
        )
        joint = plant.AddJoint(
            PrismaticJoint(
                f"tip_{name}", parent.body_frame(), body.body_frame(), np.eye(3)[axis]
            )
        )
        plant.AddJointActuator(f"tip_{name}", joint)
        parent = body
    plant.RegisterCollisionGeometry(
        parent,
        RigidTransform.Identity(),
        Sphere(config.tip_radius),
        "tip",
        UNUSED_FRICTION,
    )
    plant.set_gravity_enabled(arm, False)


def add_table(plant: MultibodyPlant) -> None:
    """Adds the body `table`, a wide box with its top at z = 0."""
    table = plant.AddRigidBody("table", plant.AddModelInstance("table"))
    plant.WeldFrames(plant.world_frame(), table.body_frame())
    below = RigidTransform([0.0, 0.0, -0.5])
    plant.RegisterCollisionGeometry(
        table, below, Box(10.0, 10.0, 1.0), "table", UNUSED_FRICTION
    )


def check_layout(plant: MultibodyPlant, body: RigidBody) -> None:
    """Raises: RuntimeError unless the state of tip and free body has the layout of
    contact_mpc/numerics/ball_state.py."""
    nq = plant.num_positions()
    starts = (
        plant.GetJointByName("tip_x").position_start(),
        body.floating_positions_start() + 4,
        nq + plant.GetJointByName("tip_x").velocity_start(),
        body.floating_velocities_start_in_v() + nq + 3,
    )
    expected = tuple(part.start for part in (P_TIP, P_BALL, V_TIP, V_BALL))
    if starts != expected or nq + plant.num_velocities() != N_X:
        raise RuntimeError(f"state starts {starts}, expected {expected}")

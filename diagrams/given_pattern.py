"""A user's motion pattern: the contacts expected along it, and the arm's start.

A segment ends in a contact if the next segment has a force direction that it lacks. The
contact is expected at the end of the segment's path, along the new force direction.
"""

from dataclasses import replace

import numpy as np
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.arm_reach import joint_positions_along
from makebreak.diagrams.scene_facts import PANDA_JOINTS
from makebreak.diagrams.station import ARM, make_control_plant
from makebreak.models.scene import Scene, load_scene
from makebreak.systems.changing_contact.numerics.contact_task import (
    ContactBelief,
    ExpectedContact,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import MotionPattern

# Least cosine between a segment's final direction and the new force direction: only a
# motion into a contact is felt.
INTO_CONTACT = 0.5
DEPTH = 2e-4  # Penetration that is accepted at the start [m].


def expected_contacts(pattern: MotionPattern, std: float) -> ContactBelief:
    """The contacts in which the pattern's segments end.

    Args: std: standard deviation of each place, along and across the motion [m].
    Raises: ValueError for a segment that ends in a contact but does not move into it.
    """
    found = []
    for k, (segment, after) in enumerate(
        zip(pattern.segments[:-1], pattern.segments[1:], strict=True)
    ):
        if not pattern.ends_in_contact(k):
            continue
        here = segment.force_directions
        end = pattern.geometry(k, pattern.length(k))
        new = [n for n in after.force_directions if not any(here @ n > 1.0 - 1e-6)]
        n = max(new, key=lambda n: n @ end[1])
        if n @ end[1] < INTO_CONTACT:
            raise ValueError(
                f"segment {k} is to end in a contact along {_shown(n)}, but moves "
                f"along {_shown(end[1])} there, expected a motion into the contact"
            )
        found.append(ExpectedContact(end[0], std**2 * np.eye(3), n, segment=k))
    return ContactBelief(tuple(found))


def start_at_pattern(
    pattern: MotionPattern, world: Scene, model: Scene, tool: str
) -> None:
    """Sets the initial arm positions of both scenes, in place, to the pattern's start.

    Raises: ValueError if the arm cannot follow the pattern, or if tool or arm would
        penetrate something in the world at the start.
    """
    q = joint_positions_along(pattern, make_control_plant(model, tool))[0]
    positions = {
        f"{ARM}.{name}": float(x) for name, x in zip(PANDA_JOINTS, q, strict=True)
    }
    for scene in (world, model):
        scene.initial = replace(
            scene.initial, positions=scene.initial.positions | positions
        )
    builder = DiagramBuilder()
    loaded = load_scene(world, builder)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    query = loaded.scene_graph.get_query_output_port().Eval(
        loaded.scene_graph.GetMyContextFromRoot(context)
    )
    inspector = loaded.scene_graph.model_inspector()
    for pair in query.ComputePointPairPenetration():
        if pair.depth <= DEPTH:
            continue
        names = [
            inspector.GetName(inspector.GetFrameId(each))
            for each in (pair.id_A, pair.id_B)
        ]
        raise ValueError(
            f"the pattern begins with {names[0]} {1e3 * pair.depth:.1f} mm inside "
            f"{names[1]}, expected a beginning in free space"
        )


def segment_paths(pattern: MotionPattern) -> list[np.ndarray]:
    """The path of each segment, (n, 3) positions [m], for drawing."""
    return [
        np.array([pattern.geometry(k, s)[0] for s in np.linspace(0.0, length, n)])
        for k, segment in enumerate(pattern.segments)
        for length, n in [(pattern.length(k), 2 if segment.kind == "line" else 60)]
    ]


def _shown(v) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in np.asarray(v) + 0.0) + ")"

"""A motion pattern that a user gives: what is expected along it, and where the arm
begins.

Contacts are expected where the pattern says that the tool will press: a segment ends in
a contact if the next one has a force direction that it lacks. It is expected at the end
of that segment's path, along the new force direction. Nothing is expected elsewhere.
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

# A contact is felt only by a motion that leads into it: so much of the motion's
# direction has to be along the new force direction (60 degrees).
LEADS_INTO = 0.5
DEPTH = 2e-4  # [m] that the tool may be inside something at the beginning.


def expected_contacts(pattern: MotionPattern, std: float) -> ContactBelief:
    """The contacts in which the pattern's segments end.

    Args: std, how far off each place may be: one standard deviation, along and across
        the motion [m].
    Raises: ValueError for a segment that is to end in a contact and does not lead into
        it.
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
        if n @ end[1] < LEADS_INTO:
            raise ValueError(
                f"segment {k} is to end in a contact along {_shown(n)}, but moves "
                f"along {_shown(end[1])} there, expected a motion into the contact"
            )
        found.append(ExpectedContact(end[0], std**2 * np.eye(3), n, segment=k))
    return ContactBelief(tuple(found))


def begin_there(pattern: MotionPattern, world: Scene, model: Scene, tool: str) -> None:
    """Sets the arm of both scenes, in place, to where the pattern begins.

    Raises: ValueError if the arm cannot follow the pattern, or if tool or arm would
        begin inside something in the world.
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


def drawn(pattern: MotionPattern) -> list[np.ndarray]:
    """The path of each segment, (n, 3) positions [m], for the eye."""
    return [
        np.array([pattern.geometry(k, s)[0] for s in np.linspace(0.0, length, n)])
        for k, segment in enumerate(pattern.segments)
        for length, n in [(pattern.length(k), 2 if segment.kind == "line" else 60)]
    ]


def _shown(v) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in np.asarray(v) + 0.0) + ")"

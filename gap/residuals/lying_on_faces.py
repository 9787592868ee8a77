"""What lies on faces in a scene whose contacts are points, and what to say of it."""

from collections.abc import Iterable, Sequence

from makebreak.gap.data.findings import Finding
from makebreak.gap.residuals.permitted_contacts import PermittedContacts
from makebreak.gap.simulation.contact_shapes import Slot
from makebreak.gap.simulation.face_supports import LiesOn


def lying_on_faces(contacts: PermittedContacts) -> list[LiesOn]:
    """The pairs of which Drake's point contact makes one point, though an area or a
    line touches: a box, a cylinder or a hull on something fixed. Not where it also
    hangs over an edge of that (its corners alone would not carry it there), where it
    touches with spheres too, or where both shapes are hydroelastic. Of a robot's links
    those that pressed_with_corners() has: wheels, feet."""
    anchored = contacts.shapes.anchored
    of_links = [
        s
        for s, on in zip(contacts.slots, contacts._masks, strict=True)
        if on.any()
        and anchored & set(contacts._pair_of(s))
        and not contacts._is_of_a_free_body(contacts._pair_of(s))
    ]
    found = pressed_with_corners(contacts, of_links)
    points, surfaces = contacts.shapes.points, contacts.shapes.surfaces
    for pair in contacts._pairs_met:
        if not contacts._lies(pair) or not contacts._is_of_a_free_body(pair):
            continue
        carrying = [
            s
            for s, on in zip(contacts.slots, contacts._masks, strict=True)
            if contacts._pair_of(s) == pair and (on & contacts.carries(s)).any()
        ]
        if not carrying or any(s.key[0] < 0 for s in carrying):
            continue
        of_points = [points[s.key[0]] for s in carrying]
        if any(p.is_sphere or p.along is not None or p.body in anchored
               for p in of_points):  # fmt: skip
            continue
        on_side = {bool(p.rim) for p in of_points}
        if len(on_side) > 1:  # It stands at times, and lies at others.
            continue
        if all(
            _meets_in_an_area(contacts, points[s.key[0]].geometry,
                              surfaces[s.key[1]].geometry)
            for s in carrying
        ):  # fmt: skip
            continue
        ground, body = sorted(pair, key=lambda k: k not in anchored)
        found.append(LiesOn(body, ground, on_side.pop()))
    return found


def pressed_with_corners(
    contacts: PermittedContacts, touching: Sequence[Slot]
) -> list[LiesOn]:
    """The same of a robot's links, which touch something fixed with corners of boxes
    alone, or with sides of cylinders: on an edge there are two points, of which Drake's
    point contact makes one. Not where the link also hangs over an edge of what is
    fixed, or both are hydroelastic.

    Args: touching: slots that touch.
    """
    found, shapes = [], contacts.shapes
    for pair in sorted({contacts._pair_of(s) for s in touching}):
        mine = [s for s in touching if contacts._pair_of(s) == pair]
        body, ground = sorted(pair, key=lambda k: k in shapes.anchored)
        if any(s.key[0] < 0 or s.a != body for s in mine):
            continue
        of_points = [shapes.points[s.key[0]] for s in mine]
        corners = all(p.is_corner for p in of_points)
        on_side = all(p.rim for p in of_points)
        if (corners or on_side) and not all(
            _meets_in_an_area(contacts, shapes.points[s.key[0]].geometry,
                              shapes.surfaces[s.key[1]].geometry)
            for s in mine
        ):  # fmt: skip
            found.append(LiesOn(body, ground, on_side, is_tool=corners))
    return found


def _meets_in_an_area(contacts: PermittedContacts, a, b) -> bool:
    """Whether Drake makes a contact surface of two shapes, and not a point."""
    if contacts.scene.plant.contact_model == "point":
        return False
    inspector = contacts.dynamics.loaded.scene_graph.model_inspector()
    return all(
        inspector.GetProximityProperties(g).HasProperty(
            "hydroelastic", "compliance_type"
        )
        for g in (a, b)
    )


def point_on_face(
    contacts: PermittedContacts, lying: Iterable[LiesOn]
) -> list[Finding]:
    """A warning for each pair of lying_on_faces() or pressed_with_corners()."""
    found = []
    for one in lying:
        pair = contacts.pair_name((one.body, one.ground))
        name = contacts.shapes.names[one.body]
        recording = contacts.recordings[0].name
        found.append(one_point(name, pair, one.on_side, recording, one.is_tool))
    return found


def one_point(
    name: str, pair: str, on_side: bool, recording: str, is_tool: bool = False
) -> Finding:
    """The warning for a body that lies on something with an area or a line.

    Args: name, pair: of the body, and of it with what it lies on; on_side: of a
        cylinder; recording: in which it does; is_tool: it presses with its corners.
    """
    how = "lies on its side" if on_side else "lies on a face"
    how = "presses with edges or a face" if is_tool else how
    says = (
        f"{name} {how}, and Drake's point contact gives {pair} a single "
        "point, which jumps about: in the scene's own simulation it rocks, slides "
        "and turns wrongly. Here it was simulated standing on "
        + (
            "two spheres of its own radius"
            if on_side
            else "small spheres at its corners"
            if is_tool
            else "small spheres at the corners of that face"
        )
        + ". Give it such spheres in its model, or use hydroelastic contact, "
        "before you simulate with the scene."
    )
    return Finding("point_on_face", recording, pair, 1.0, "1", "warning", says)

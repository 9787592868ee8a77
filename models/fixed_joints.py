"""Joints that are held where they stand, and joints that a model's file couples.

The fingers of a gripper are often not logged, or move together by a `mimic`. Equations
of motion of the arm need to know only where they stand.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.dom import expatbuilder, minidom
from xml.parsers.expat import ExpatError

from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, PrismaticJoint, WeldJoint

from makebreak.models.effects.kind import actuator_of, full_name, one_dof_joints
from makebreak.models.effects.model_text import children, text


def fix_joints(
    plant: MultibodyPlant, fixed: Mapping[str, float], couplings: int = 0
) -> None:
    """Welds joints at these positions, before Finalize. Couplings, which must be of
    joints that are fixed, are removed with them.

    Args: fixed: {<model>.<joint>: position [rad] or [m]}. couplings: how many of the
        plant's constraints are couplings; Drake does not tell what a constraint holds.
    Raises: ValueError for a joint that there is not, or for other constraints, as of a
        closed loop: they would be lost.
    """
    if not fixed:
        return
    joints = {full_name(plant, joint): joint for joint in one_dof_joints(plant)}
    for name in fixed:
        if name not in joints:
            raise ValueError(
                f"fixed_joints: no joint {name}, the scene has {', '.join(joints)}"
            )
    if plant.num_constraints() > couplings:
        raise ValueError(
            f"fixed_joints: the models have {plant.num_constraints()} constraints, of "
            f"which {couplings} are couplings of joints (mimic); expected no others: "
            "closed loops are not covered beside fixed joints"
        )
    for constraint in plant.GetConstraintIds():
        plant.RemoveConstraint(constraint)
    for name, position in fixed.items():
        _weld(plant, joints[name], position)


def _weld(plant: MultibodyPlant, joint: Joint, position: float) -> None:
    actuator = actuator_of(plant, joint)
    if actuator is not None:
        plant.RemoveJointActuator(actuator)
    if isinstance(joint, PrismaticJoint):
        X = RigidTransform(position * joint.translation_axis())
    else:
        turn = AngleAxis(angle=position, axis=joint.revolute_axis())
        X = RigidTransform(RotationMatrix(turn))
    name, parent, child = joint.name(), joint.frame_on_parent(), joint.frame_on_child()
    plant.RemoveJoint(joint)
    plant.AddJoint(WeldJoint(name, parent, child, X))


def coupled_joints(path: Path) -> dict[str, str]:
    """{joint: the one that it follows} of a URDF, SDF or MJCF; none where it cannot be
    read, which a parser says better."""
    try:
        return couplings_in(path.read_text(errors="replace"))
    except (ExpatError, OSError):
        return {}


@dataclass(frozen=True)
class Follows:
    """A joint that is at factor times another one's position, plus offset [rad, m]."""

    joint: str
    factor: float
    offset: float


def couplings_in(text: str) -> dict[str, str]:
    """{joint: the one that it follows} of a model's text."""
    return {joint: follows.joint for joint, follows in followers_in(text).items()}


def followers_in(source: str) -> dict[str, Follows]:
    """{joint: how it follows another} of a model's text."""
    # Drake knows `drake:` without a declaration of it.
    return dict(_couplings(expatbuilder.parseString(source.encode(), namespaces=False)))


def _couplings(document: minidom.Document) -> Iterator[tuple[str, Follows]]:
    for mimic in document.getElementsByTagName("mimic"):
        joint, said = mimic.parentNode, {}
        for tag, default in (("multiplier", "1"), ("offset", "0")):
            inside = [text(e) for e in children(mimic, tag)]  # SDF.
            said[tag] = float(mimic.getAttribute(tag) or (*inside, default)[0])
        if isinstance(joint, minidom.Element) and joint.tagName == "axis":  # SDF.
            joint = joint.parentNode
        if isinstance(joint, minidom.Element):
            other = mimic.getAttribute("joint")
            yield joint.getAttribute("name"), Follows(other, *said.values())
    for equality in document.getElementsByTagName("equality"):  # MJCF.
        for pair in equality.getElementsByTagName("joint"):
            if pair.hasAttribute("joint2"):
                law = [*map(float, pair.getAttribute("polycoef").split()), 0.0, 1.0]
                other = pair.getAttribute("joint2")
                yield pair.getAttribute("joint1"), Follows(other, law[1], law[0])

"""Robots as plain numbers, written as URDF for the scene and as MJCF for MuJoCo.

Each is a chain; its sizes and masses are drawn, so that no two cases have the same one.
Lengths, masses and gear sizes are those of arms that people have.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gap_benchmark.mechanism import quaternion

_PANDA = Path(__file__).resolve().parents[2] / "models/panda.urdf"
_H = np.pi / 2
_SIX = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
G = 9.81  # [m/s2]


@dataclass(frozen=True)
class Body:
    """A body and the joint that carries it; joint "" is a weld to the body before.

    xyz [m], rpy [rad]: of the joint in the body before. com [m]. inertia: about the
    centre of mass, in the body's axes, ixx iyy izz ixy ixz iyz [kg m2]. rotor: at the
    joint [kg m2, or kg]. effort: the drive's limit [N m, or N]. on: the body that it is
    on, None: the one before it, "": the base. touch: radius of what can touch [m].
    """

    name: str
    joint: str
    xyz: tuple[float, ...]
    rpy: tuple[float, ...]
    mass: float
    com: tuple[float, ...]
    inertia: tuple[float, ...]
    axis: tuple[float, ...] = (0.0, 0.0, 1.0)
    sliding: bool = False
    rotor: float = 0.0
    effort: float = 100.0
    on: str | None = None
    touch: float = 0.0


@dataclass(frozen=True)
class Robot:
    """middle, reach, fastest: of its motion: what each joint moves about, by how much
    [rad, or m], and its highest speed [rad/s, or m/s]."""

    model: str
    bodies: tuple[Body, ...]
    middle: np.ndarray
    reach: np.ndarray
    fastest: np.ndarray

    @property
    def moving(self) -> list[Body]:
        return [body for body in self.bodies if body.joint]

    @property
    def joints(self) -> list[str]:
        return [f"{self.model}.{body.joint}" for body in self.moving]

    def joint(self, name: str) -> int:
        return self.joints.index(name)

    def body(self, name: str) -> int:
        return [f"{self.model}.{b.name}" for b in self.bodies].index(name)

    def with_body(self, name: str, **changes) -> "Robot":
        """The robot with other numbers of the body `model.name`."""
        bodies = list(self.bodies)
        i = self.body(name)
        bodies[i] = replace(bodies[i], **changes)
        return replace(self, bodies=tuple(bodies))

    def without_body(self, name: str) -> "Robot":
        i = self.body(name)
        return replace(self, bodies=self.bodies[:i] + self.bodies[i + 1 :])


def rod(mass, length, radius, along=2) -> tuple[float, ...]:
    """Central inertia of a cylinder; along: 0, 1, 2 for x, y, z."""
    moments = np.full(3, mass * (3 * radius**2 + length**2) / 12)
    moments[along] = 0.5 * mass * radius**2
    return (*map(float, moments), 0.0, 0.0, 0.0)


def _hand(mass: float, z: float, rng) -> Body:
    """A gripper at the flange, about as the Panda's: off its axis, twice as wide."""
    com = (float(rng.uniform(-0.015, 0.015)), float(rng.uniform(-0.015, 0.015)),
           float(rng.uniform(0.03, 0.06)))  # fmt: skip
    return Body("hand", "", (0, 0, z), (0, 0, -_H / 2), mass, com,
                rod(mass, 0.18, 0.035, along=1))  # fmt: skip


def panda(rng, hand: bool = False) -> Robot:
    """Seven joints: the Panda of models/panda.urdf with other masses, up to 8 %."""
    tree = ElementTree.parse(_PANDA).getroot()
    bodies = []
    rotors = (0.61, 0.61, 0.46, 0.46, 0.21, 0.21, 0.21)
    efforts = (87.0,) * 4 + (12.0,) * 3

    def numbers(element, name):
        return tuple(float(x) for x in element.get(name, "0 0 0").split())

    for i in range(1, 8):
        inertial = tree.find(f"link[@name='panda_link{i}']/inertial")
        joint = tree.find(f"joint[@name='panda_joint{i}']/origin")
        inertia = inertial.find("inertia")
        six = [float(inertia.get(k)) for k in _SIX]
        f = rng.uniform(0.92, 1.08)
        com = numbers(inertial.find("origin"), "xyz")
        mass = f * float(inertial.find("mass").get("value"))
        bodies.append(
            Body(f"link{i}", f"joint{i}", numbers(joint, "xyz"), numbers(joint, "rpy"),
                 mass, com, tuple(f * x for x in six), rotor=rotors[i - 1],
                 effort=efforts[i - 1])
        )  # fmt: skip
    if hand:
        bodies.append(_hand(float(rng.uniform(0.62, 0.85)), 0.107, rng))
    middle = np.array([0.0, -0.4, 0.0, -1.9, 0.0, 1.7, 0.6])
    reach = np.array([0.8, 0.5, 0.7, 0.6, 0.9, 0.7, 1.0])
    fastest = np.array([1.2, 0.9, 1.2, 1.1, 1.6, 1.5, 1.8])
    return Robot("arm", tuple(bodies), middle, reach, fastest)


def six(rng, hand: bool = False) -> Robot:
    """Six joints, as an industrial arm of 1.2 m."""
    s = rng.uniform(0.9, 1.1, 6)
    d1, a2, a3, d4, d5, d6 = np.array([0.18, 0.61, 0.57, 0.17, 0.12, 0.117]) * s
    m = np.array([7.4, 13.0, 4.0, 2.1, 2.0, 0.62]) * rng.uniform(0.9, 1.1, 6)
    where = [(0, 0, d1), (0, 0, 0), (-a2, 0, 0), (-a3, 0, d4), (0, -d5, 0), (0, d6, 0)]
    turns = [(0, 0, 0), (_H, 0, 0), (0, 0, 0), (0, 0, 0), (_H, 0, 0), (-_H, 0, 0)]
    coms = [(0.021, 0.0, 0.027), (-0.62 * a2, 0.0, 0.158), (-0.56 * a3, 0.0, 0.068),
            (0.0, 0.007, 0.018), (0.0, 0.007, 0.018), (0.0, 0.0, -0.026)]  # fmt: skip
    shapes = [
        (m[0], 0.2, 0.09, 2),
        (m[1], a2, 0.07, 0),
        (m[2], a3, 0.05, 0),
        (m[3], 0.12, 0.05, 2),
        (m[4], 0.12, 0.05, 2),
        (m[5], 0.05, 0.045, 2),
    ]
    efforts = (330.0, 330.0, 150.0, 56.0, 56.0, 56.0)
    # Motors by their gears, squared: more than the links of the wrist.
    rotors = np.array([3.0, 3.0, 1.6, 0.35, 0.3, 0.3]) * rng.uniform(0.8, 1.2, 6)
    bodies = [
        Body(f"link{i + 1}", f"joint{i + 1}", tuple(map(float, where[i])), turns[i],
             float(m[i]), tuple(map(float, coms[i])), rod(*shapes[i][:3], shapes[i][3]),
             rotor=float(rotors[i]), effort=efforts[i])
        for i in range(6)
    ]  # fmt: skip
    if hand:
        bodies.append(_hand(float(rng.uniform(0.8, 1.2)), 0.02, rng))
    middle = np.array([0.2, -1.3, 1.3, -0.4, -1.2, 0.0])
    reach = np.array([1.0, 0.6, 0.8, 1.0, 1.0, 1.3])
    fastest = np.array([1.3, 1.0, 1.4, 1.8, 1.8, 2.0])
    return Robot("six", tuple(bodies), middle, reach, fastest)


def scara(rng, hand: bool = False) -> Robot:
    """Two joints about the vertical, a lift, a wrist."""
    l1, l2 = rng.uniform(0.25, 0.4, 2)
    m = np.array([3.2, 2.3, 1.1, 0.5]) * rng.uniform(0.85, 1.15, 4)
    bodies = [
        Body("upper", "shoulder", (0, 0, 0.5), (0, 0, 0), float(m[0]),
             (0.5 * l1, 0.0, 0.0), rod(m[0], l1, 0.06, 0), rotor=0.15, effort=60.0),
        Body("fore", "elbow", (l1, 0, 0), (0, 0, 0), float(m[1]),
             (0.5 * l2, 0.0, 0.0), rod(m[1], l2, 0.05, 0), rotor=0.08, effort=40.0),
        Body("quill", "lift", (l2, 0, 0), (0, 0, 0), float(m[2]), (0.01, 0.0, -0.1),
             rod(m[2], 0.3, 0.02), sliding=True, rotor=0.8, effort=150.0),
        Body("flange", "wrist", (0, 0, -0.2), (0, 0, 0), float(m[3]),
             (0.02, 0.0, -0.03), rod(m[3], 0.08, 0.03), rotor=0.01, effort=8.0),
    ]  # fmt: skip
    if hand:
        bodies.append(_hand(float(rng.uniform(0.3, 0.5)), -0.05, rng))
    middle, reach = np.array([0.3, 0.6, 0.0, 0.0]), np.array([1.0, 1.0, 0.08, 1.3])
    return Robot("scara", tuple(bodies), middle, reach, np.array([2.0, 2.2, 0.25, 3.0]))


def servo_arm(rng, hand: bool = False) -> Robot:
    """Five joints of toy servos, about the size of the SO-101; gears of 1:345, whose
    motors weigh more at the joint than the links do."""
    l1, l2, l3 = np.array([0.113, 0.135, 0.06]) * rng.uniform(0.9, 1.1, 3)
    m = np.array([0.1, 0.103, 0.104, 0.079, 0.087]) * rng.uniform(0.9, 1.2, 5)
    rotor = float(rng.uniform(0.022, 0.03))
    bodies = [
        Body("turret", "pan", (0, 0, 0.06), (0, 0, 0), float(m[0]), (0.0, 0.02, 0.03),
             rod(m[0], 0.06, 0.03), rotor=rotor, effort=2.9),
        Body("upper", "lift", (0, 0.03, 0.05), (0, -_H, 0), float(m[1]),
             (0.6 * l1, 0.0, 0.01), rod(m[1], l1, 0.02, 0), axis=(0.0, 1.0, 0.0),
             rotor=rotor, effort=2.9),
        Body("fore", "elbow", (l1, 0, 0), (0, _H, 0), float(m[2]),
             (0.55 * l2, 0.0, -0.01), rod(m[2], l2, 0.02, 0), axis=(0.0, 1.0, 0.0),
             rotor=rotor, effort=2.9),
        Body("palm", "flex", (l2, 0, 0), (0, 0, 0), float(m[3]), (0.4 * l3, 0.0, 0.0),
             rod(m[3], l3, 0.02, 0), axis=(0.0, 1.0, 0.0), rotor=rotor, effort=2.9),
        Body("claw", "roll", (l3, 0, 0), (0, 0, 0), float(m[4]), (0.035, 0.01, 0.005),
             rod(m[4], 0.1, 0.02, 0), axis=(1.0, 0.0, 0.0), rotor=rotor, effort=2.9),
    ]  # fmt: skip
    return Robot("servo", tuple(bodies), np.array([0.0, 0.3, 0.3, 0.5, 0.0]),
                 np.array([1.0, 0.7, 0.8, 0.8, 1.2]),
                 np.array([2.0, 1.6, 2.0, 2.2, 2.5]))  # fmt: skip


def planar(rng, hand: bool = False) -> Robot:
    """Two links in a vertical plane; joint axes along y. two_link.py has its equations
    in closed form, which expect the centres of mass on the links' own lines."""
    l1, l2 = rng.uniform(0.25, 0.4, 2)
    m1, m2 = rng.uniform(0.6, 1.4, 2)
    y = (0.0, 1.0, 0.0)
    bodies = (
        Body("upper", "shoulder", (0, 0, 1), (0, 0, 0), float(m1),
             (0.0, 0.0, -0.55 * l1), rod(m1, l1, 0.03), axis=y, rotor=0.01,
             effort=30.0),
        Body("lower", "elbow", (0, 0, -l1), (0, 0, 0), float(m2),
             (0.0, 0.0, -0.6 * l2), rod(m2, l2, 0.025), axis=y, rotor=0.006,
             effort=20.0),
    )  # fmt: skip
    return Robot("planar", bodies, np.array([0.3, 0.4]), np.array([1.0, 1.3]),
                 np.array([4.0, 5.0]))  # fmt: skip


ROBOTS = {"panda": panda, "six": six, "scara": scara, "servo": servo_arm,
          "planar": planar}  # fmt: skip


def tensor(body: Body) -> np.ndarray:
    """(3, 3) inertia about the centre of mass."""
    xx, yy, zz, xy, xz, yz = body.inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def within_tolerance(robot: Robot, rng, mass: float, com: float) -> Robot:
    """Each link's mass off by `mass` (one standard deviation, as a fraction), its
    centre of mass by `com` [m]; none by more than two standard deviations."""
    bodies = []
    for body in robot.bodies:
        f = 1.0 + mass * float(np.clip(rng.normal(), -2, 2))
        move = com * np.clip(rng.normal(size=3), -2, 2)
        bodies.append(
            replace(body, mass=f * body.mass, com=tuple(np.array(body.com) + move),
                    inertia=tuple(f * np.array(body.inertia)))
        )  # fmt: skip
    return replace(robot, bodies=tuple(bodies))


def with_point(body: Body, mass: float, place) -> Body:
    """The body with a point mass, which may be negative, fixed at `place`."""
    total = body.mass + mass
    a, b = np.array(body.com), np.array(place)
    com = (body.mass * a + mass * b) / total
    sum_ = tensor(body)
    for m, p in ((body.mass, a - com), (mass, b - com)):
        sum_ = sum_ + m * (p @ p * np.eye(3) - np.outer(p, p))
    numbers = sum_[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return replace(body, mass=total, com=tuple(com), inertia=tuple(numbers))


def to_urdf(robot: Robot) -> str:
    """What a user has of the robot: no friction, and rotors where the numbers have."""

    def three(values) -> str:
        return " ".join(f"{float(v):.10g}" for v in values)

    out = [f'<?xml version="1.0"?>\n<robot name="{robot.model}" '
           'xmlns:drake="http://drake.mit.edu">', '<link name="base"/>']  # fmt: skip
    parent = "base"
    for body in robot.bodies:
        inertia = " ".join(
            f'{k}="{v:.10g}"' for k, v in zip(_SIX, body.inertia, strict=True)
        )
        out.append(
            f'<link name="{body.name}"><inertial><origin xyz="{three(body.com)}"/>'
            f'<mass value="{body.mass:.10g}"/><inertia {inertia}/></inertial>'
            f'<visual><origin xyz="{three(body.com)}"/><geometry><sphere '
            'radius="0.03"/></geometry></visual>'
            + (
                f'<collision><origin xyz="{three(body.com)}"/><geometry><sphere '
                f'radius="{body.touch:g}"/></geometry></collision>'
                if body.touch
                else ""
            )
            + "</link>"
        )
        parent = parent if body.on is None else body.on or "base"
        name = body.joint or f"{body.name}_weld"
        kind = ("prismatic" if body.sliding else "revolute") if body.joint else "fixed"
        out.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{body.name}"/><origin xyz="{three(body.xyz)}" '
            f'rpy="{three(body.rpy)}"/>'
            + (
                f'<axis xyz="{three(body.axis)}"/><limit lower="-6.3" upper="6.3" '
                f'effort="{body.effort}" velocity="20"/>'
                if body.joint
                else ""
            )
            + "</joint>"
        )
        if body.joint:
            out.append(
                f'<transmission name="{name}_t"><type>SimpleTransmission</type>'
                f'<joint name="{name}"/><actuator name="{name}">'
                f'<drake:rotor_inertia value="{body.rotor:.10g}"/><drake:gear_ratio '
                'value="1"/></actuator></transmission>'
            )
        parent = body.name
    return "\n".join([*out, "</robot>\n"])


EXACT = 'integrator="RK4" iterations="50" tolerance="1e-12"'
HARD = 'solreffriction="0.002 1" solimpfriction="0.9999 0.9999 0.001"'


def to_mjcf(
    robot: Robot,
    gravity,
    damping: np.ndarray,
    friction: np.ndarray,
    play: Mapping[int, str] | None = None,
    option: str = EXACT,
    dry: str = HARD,
) -> str:
    """damping (n,) and friction (n,): of each joint. play: {joint: attributes} of
    joints with a second one behind the motor's, a spring or a gap: the rotor sits on
    the first, the link's angle is the sum of both. option, dry: of the solver, and of
    how dry friction is solved for."""
    play = play or {}

    def text(values) -> str:
        return " ".join(f"{float(v):.17g}" for v in values)

    on: dict[str, list[Body]] = {}
    before = ""
    for body in robot.bodies:
        on.setdefault(before if body.on is None else body.on, []).append(body)
        before = body.name
    number = {body.name: i for i, body in enumerate(robot.moving)}

    def nested(body: Body) -> str:
        joint, shape = "", ""
        if body.joint:
            i = number[body.name]
            kind = f'type="{"slide" if body.sliding else "hinge"}" '
            kind += f'axis="{text(body.axis)}"'
            joint = (
                f'<joint name="{body.joint}" {kind} armature="{body.rotor:.17g}" '
                f'damping="{damping[i]:.17g}" frictionloss="{friction[i]:.17g}" {dry}/>'
            )
            if i in play:
                joint += f'<joint name="{body.joint}_play" {kind} {play[i]}/>'
        if body.touch:
            shape = f'<geom size="{body.touch:g}" pos="{text(body.com)}" mass="0"/>'
        return (
            f'<body name="{body.name}" pos="{text(body.xyz)}" '
            f'quat="{text(quaternion(body.rpy))}"><inertial pos="{text(body.com)}" '
            f'mass="{body.mass:.17g}" fullinertia="{text(body.inertia)}"/>'
            + joint
            + shape
            + "".join(map(nested, on.get(body.name, ())))
            + "</body>"
        )

    return (
        '<mujoco><compiler angle="radian" inertiafromgeom="false"/>'
        f'<option gravity="{text(gravity)}" {option}/><worldbody>'
        + "".join(map(nested, on[""]))
        + "</worldbody></mujoco>"
    )

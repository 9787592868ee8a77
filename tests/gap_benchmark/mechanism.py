"""Mechanisms as plain numbers, written as URDF for Drake and as MJCF for MuJoCo."""

from dataclasses import dataclass, field, replace

import numba
import numpy as np


@dataclass(frozen=True)
class Link:
    """A body, and the joint that carries it. Inertia about the centre of mass, in the
    body's axes: ixx iyy izz [kg m2]. The joint's axis is the body's z unless said."""

    joint: str
    name: str
    xyz: tuple[float, float, float]  # [m] in the body before.
    rpy: tuple[float, float, float]  # [rad]
    mass: float  # [kg]
    com: tuple[float, float, float]  # [m]
    inertia: tuple[float, float, float]
    sliding: bool = False
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    rotor: float = 0.0  # [kg m2 or kg], reflected at the joint.
    limit: float = 3.0  # [rad or m], either way.
    effort: float = 100.0  # [N m or N]


@dataclass(frozen=True)
class Mechanism:
    """A chain from the world on. driven: indices of the joints with an actuator.
    reach: amplitude of each joint's motion; middle: what it moves about."""

    model: str
    links: tuple[Link, ...]
    driven: tuple[int, ...]
    middle: tuple[float, ...]
    reach: tuple[float, ...]
    fastest_hz: float = 0.8
    extra: dict = field(default_factory=dict)

    @property
    def joints(self) -> list[str]:
        return [f"{self.model}.{link.joint}" for link in self.links]


def quaternion(rpy) -> np.ndarray:
    """Of roll, pitch, yaw about fixed axes, as URDF has them."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.array(rpy) / 2), np.sin(np.array(rpy) / 2)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


@numba.njit(cache=True)
def rotation(q) -> np.ndarray:
    w, x, y, z = q[0], q[1], q[2], q[3]
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _rod(mass, length, radius):
    """Central inertia of a rod along z, and across."""
    across = mass * (3 * radius**2 + length**2) / 12
    return across, across, 0.5 * mass * radius**2


def pendulum(rng) -> Mechanism:
    """Two links that swing in a vertical plane, both driven; joint axes along y."""
    l1, l2 = rng.uniform(0.22, 0.4, 2)
    m1, m2 = rng.uniform(0.4, 1.0, 2)
    down = (0.0, 1.0, 0.0)
    links = (
        Link("shoulder", "upper", (0, 0, 1), (0, 0, 0), m1, (0, 0, -0.6 * l1),
             _rod(m1, l1, 0.02), axis=down, rotor=0.004, limit=6.3, effort=20.0),
        Link("elbow", "lower", (0, 0, -l1), (0, 0, 0), m2, (0, 0, -0.7 * l2),
             _rod(m2, l2, 0.02), axis=down, rotor=0.003, limit=6.3, effort=15.0),
    )  # fmt: skip
    return Mechanism("pendulum", links, (0, 1), (0.0, 0.0), (1.1, 1.4), 1.0)


def arm(rng) -> Mechanism:
    """Seven joints, alternately along and across the links."""
    s = rng.uniform(0.85, 1.15, 8)
    m = np.array([3.4, 3.3, 2.9, 2.6, 2.2, 1.5, 0.8]) * s[:7]
    l1, l2, l3, l4 = 0.32 * s[0], 0.31 * s[1], 0.37 * s[2], 0.09 * s[7]
    h = np.pi / 2
    places = [(0, 0, l1), (0, 0, 0), (0, -l2, 0), (0.06, 0, 0), (-0.06, l3, 0),
              (0, 0, 0), (l4, 0, 0)]  # fmt: skip
    turns = [(0, 0, 0), (-h, 0, 0), (h, 0, 0), (h, 0, 0), (-h, 0, 0), (h, 0, 0),
             (h, 0, 0)]  # fmt: skip
    coms = [(0.003, -0.03, -0.09), (-0.004, -0.10, 0.03), (0.03, 0.02, -0.08),
            (-0.04, 0.09, 0.02), (-0.01, 0.04, -0.11), (0.05, -0.01, -0.01),
            (0.01, 0.0, 0.07)]  # fmt: skip
    rods = [(0.25, 0.06), (0.28, 0.06), (0.2, 0.055), (0.25, 0.055), (0.25, 0.05),
            (0.12, 0.05), (0.1, 0.04)]  # fmt: skip
    rotors = (0.35, 0.35, 0.25, 0.25, 0.1, 0.1, 0.08)
    efforts = (120.0, 120.0, 100.0, 100.0, 40.0, 40.0, 30.0)
    links = tuple(
        Link(f"joint{i + 1}", f"link{i + 1}", places[i], turns[i], float(m[i]),
             coms[i], _rod(m[i], *rods[i]), rotor=rotors[i], effort=efforts[i])
        for i in range(7)
    )  # fmt: skip
    middle = (0.0, -0.5, 0.0, -1.9, 0.0, 1.6, 0.5)
    reach = (0.8, 0.5, 0.7, 0.6, 0.9, 0.7, 1.0)
    return Mechanism("arm", links, tuple(range(7)), middle, reach, 0.7)


def cartpole(rng) -> Mechanism:
    """A driven cart, and a pole that hangs from it and swings freely."""
    length, mass = rng.uniform(0.3, 0.6), rng.uniform(0.1, 0.3)
    links = (
        Link("slide", "cart", (0, 0, 1), (0, 0, 0), rng.uniform(0.6, 1.5), (0, 0, 0),
             (1e-3, 1e-3, 1e-3), True, (1.0, 0.0, 0.0), limit=2.0, effort=60.0,
             rotor=0.1),
        Link("hinge", "pole", (0, 0, 0), (0, 0, 0), mass, (0, 0, -0.55 * length),
             _rod(mass, length, 0.01), axis=(0.0, 1.0, 0.0), limit=20.0),
    )  # fmt: skip
    return Mechanism("cartpole", links, (0,), (0.0, 0.0), (0.35, 0.0), 1.2)


def scara(rng) -> Mechanism:
    """Two joints about the vertical, a lift, a wrist; drives with position control."""
    l1, l2 = rng.uniform(0.25, 0.4, 2)
    m = np.array([3.0, 2.2, 1.0, 0.4]) * rng.uniform(0.8, 1.2, 4)
    inertia = [(0.01, m[0] * l1**2 / 10, m[0] * l1**2 / 10),
               (0.008, m[1] * l2**2 / 10, m[1] * l2**2 / 10),
               (0.004, 0.004, 0.001), (6e-4, 6e-4, 5e-4)]  # fmt: skip
    links = (
        Link("shoulder", "upper", (0, 0, 0.5), (0, 0, 0), float(m[0]),
             (0.5 * l1, 0, 0), inertia[0], rotor=0.15, effort=60.0),
        Link("elbow", "fore", (l1, 0, 0), (0, 0, 0), float(m[1]), (0.5 * l2, 0, 0),
             inertia[1], rotor=0.08, effort=40.0),
        Link("lift", "quill", (l2, 0, 0), (0, 0, 0), float(m[2]), (0.01, 0, -0.1),
             inertia[2], True, rotor=0.8, limit=0.4, effort=150.0),
        Link("wrist", "flange", (0, 0, -0.2), (0, 0, 0), float(m[3]),
             (0.015, 0, -0.03), inertia[3], rotor=0.01, effort=8.0),
    )  # fmt: skip
    gains = {"kp": [900.0, 600.0, 6000.0, 40.0], "kd": [40.0, 25.0, 250.0, 1.2]}
    return Mechanism("scara", links, (0, 1, 2, 3), (0.3, 0.6, 0.0, 0.0),
                     (1.0, 1.0, 0.08, 1.2), 0.8, gains)  # fmt: skip


MECHANISMS = {"pendulum": pendulum, "arm": arm, "cartpole": cartpole, "scara": scara}


def with_background(mechanism: Mechanism, rng, mass=0.035, com=0.0025) -> Mechanism:
    """Each link's mass off by a few per cent, its centre by a few mm (1 sigma)."""
    links = []
    for link in mechanism.links:
        factor = 1.0 + mass * np.clip(rng.normal(), -2, 2)
        moved = np.array(link.com) + com * np.clip(rng.normal(size=3), -2, 2)
        inertia = tuple(factor * np.array(link.inertia))
        links.append(
            replace(link, mass=link.mass * factor, com=tuple(moved), inertia=inertia)
        )
    return replace(mechanism, links=tuple(links))


def with_payload(link: Link, mass: float, place) -> Link:
    """The link with a point mass at `place`; its axes of inertia are kept by MJCF's
    full tensor, so the tensor is returned in `extra` form: six numbers."""
    total = link.mass + mass
    a, b = np.array(link.com), np.array(place)
    com = (link.mass * a + mass * b) / total
    tensor = np.diag(link.inertia)
    for m, p in ((link.mass, a - com), (mass, b - com)):
        tensor = tensor + m * (p @ p * np.eye(3) - np.outer(p, p))
    six = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return replace(link, mass=total, com=tuple(com), inertia=tuple(six))


def to_urdf(mechanism: Mechanism) -> str:
    def three(values) -> str:
        return " ".join(f"{float(v):.10g}" for v in values)

    out = [f'<?xml version="1.0"?>\n<robot name="{mechanism.model}" '
           'xmlns:drake="http://drake.mit.edu">', '<link name="base"/>']  # fmt: skip
    parent = "base"
    for i, link in enumerate(mechanism.links):
        ixx, iyy, izz = link.inertia[:3]
        kind = "prismatic" if link.sliding else "revolute"
        out.append(
            f'<link name="{link.name}"><inertial><origin xyz="{three(link.com)}"/>'
            f'<mass value="{link.mass:.10g}"/><inertia ixx="{ixx:.10g}" '
            f'iyy="{iyy:.10g}" izz="{izz:.10g}" ixy="0" ixz="0" iyz="0"/></inertial>'
            f'<visual><origin xyz="{three(link.com)}"/><geometry><sphere '
            'radius="0.03"/></geometry></visual></link>\n'
            f'<joint name="{link.joint}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{link.name}"/><origin xyz="{three(link.xyz)}" '
            f'rpy="{three(link.rpy)}"/><axis xyz="{three(link.axis)}"/><limit '
            f'lower="{-link.limit}" upper="{link.limit}" effort="{link.effort}" '
            'velocity="50"/></joint>'
        )
        if i in mechanism.driven:
            out.append(
                f'<transmission name="{link.joint}_t"><type>SimpleTransmission</type>'
                f'<joint name="{link.joint}"/><actuator name="{link.joint}">'
                f'<drake:rotor_inertia value="{link.rotor}"/><drake:gear_ratio '
                'value="1"/></actuator></transmission>'
            )
        parent = link.name
    return "\n".join([*out, "</robot>\n"])


def to_mjcf(
    mechanism: Mechanism, gravity, step: float, motors: dict[int, float] | None = None
) -> str:
    """motors: {joint: rotor inertia} of joints of which the motor turns by itself: a
    second body on the same axis, the joint then carries no rotor."""
    motors = motors or {}

    def text(values) -> str:
        return " ".join(f"{float(v):.17g}" for v in values)

    out, close = [], []
    for i, link in enumerate(mechanism.links):
        inertia = text(
            link.inertia if len(link.inertia) == 6 else (*link.inertia, 0, 0, 0)
        )
        kind = "slide" if link.sliding else "hinge"
        place = f'pos="{text(link.xyz)}" quat="{text(quaternion(link.rpy))}"'
        joint = f'type="{kind}" axis="{text(link.axis)}"'
        if i in motors:
            out.append(
                f'<body {place}><inertial pos="0 0 0" mass="1e-9" '
                f'diaginertia="1e-12 1e-12 1e-12"/><joint name="motor_{link.joint}" '
                f'{joint} armature="{motors[i]}"/></body>'
            )
        rotor = 0.0 if i in motors else link.rotor if i in mechanism.driven else 0.0
        out.append(
            f'<body name="{link.name}" {place}><inertial pos="{text(link.com)}" '
            f'mass="{link.mass:.17g}" fullinertia="{inertia}"/>'
            f'<joint name="{link.joint}" {joint} armature="{rotor}" '
            'solreffriction="0.002 1" solimpfriction="0.9999 0.9999 0.001"/>'
        )
        close.append("</body>")
    return (
        '<mujoco><compiler angle="radian" inertiafromgeom="false"/>'
        f'<option timestep="{step}" integrator="RK4" gravity="{text(gravity)}" '
        'iterations="50" tolerance="1e-12"/><worldbody>'
        + "".join(out + close)
        + "</worldbody></mujoco>"
    )

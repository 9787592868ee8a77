"""Small plants for which nothing was tuned: objects that fingers push, press or hold.

Each is SDF text, and the contact pairs of its LCS. `makebreak bench c3_light` varies
the mass of an object, `makebreak bench learner_plants` its size.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder

from makebreak.systems.contact_mpc.lcs_builder import ContactPair

G = 9.81  # [m/s2]


def diagram_of(text: str, time_step: float = 0.0) -> tuple[Diagram, MultibodyPlant]:
    """The plant and its scene graph in a diagram; time_step [s], 0: continuous."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    Parser(plant).AddModelsFromString(text, "sdf")
    plant.Finalize()
    return builder.Build(), plant


# Parts of SDF text: lengths in m, masses in kg.


def sdf(*parts: str) -> str:
    text = "".join(parts)
    return (
        f'<?xml version="1.0"?><sdf version="1.9"><model name="m">{text}</model></sdf>'
    )


def sphere(radius: float) -> str:
    return f"<sphere><radius>{radius}</radius></sphere>"


def box(x: float, y: float, z: float) -> str:
    return f"<box><size>{x} {y} {z}</size></box>"


def cylinder(radius: float, length: float, kind: str = "cylinder") -> str:
    return f"<{kind}><radius>{radius}</radius><length>{length}</length></{kind}>"


def shape(name: str, geometry: str, at: str = "0 0 0", mu: float = 0.5) -> str:
    return (
        f'<collision name="{name}"><pose>{at} 0 0 0</pose><geometry>{geometry}'
        f"</geometry><surface><friction><ode><mu>{mu}</mu><mu2>{mu}</mu2></ode>"
        "</friction></surface></collision>"
    )


def link(name: str, mass: float, shapes: str = "", at="0 0 0", arm=0.025) -> str:
    """Args: arm: radius of gyration about each axis [m]."""
    moment = mass * arm**2
    inertia = "".join(f"<{i}>{moment}</{i}>" for i in ("ixx", "iyy", "izz"))
    return (
        f'<link name="{name}"><pose>{at} 0 0 0</pose><inertial><mass>{mass}</mass>'
        f"<inertia>{inertia}</inertia></inertial>{shapes}</link>"
    )


def fixed(name: str, geometry: str, at: str, mu: float = 0.5) -> str:
    """A link of one shape that does not move."""
    return (
        link(name, 1.0, shape(name, geometry, mu=mu), at)
        + f'<joint name="{name}_joint" type="fixed"><parent>world</parent>'
        f"<child>{name}</child></joint>"
    )


def joint(
    child: str, axis: str, parent="world", kind="prismatic", driven=True, damping=0.0
) -> str:
    effort = "" if driven else "<limit><effort>0</effort></limit>"
    return (
        f'<joint name="{child}_joint" type="{kind}"><parent>{parent}</parent>'
        f"<child>{child}</child><axis><xyz>{axis}</xyz><dynamics>"
        f"<damping>{damping}</damping></dynamics>{effort}</axis></joint>"
    )


def ground(mu: float = 0.5) -> str:
    return fixed("ground", box(4, 4, 1), "0 0 -0.5", mu)


def finger(name: str, axes: dict[str, str], at: str, radius=0.01, mass=0.1, **more):
    """A ball on driven sliding joints, one of each axis: {suffix: axis}. The last link
    is `name`, and the others are `name` and the suffix."""
    text, parent = "", "world"
    for i, (suffix, axis) in enumerate(axes.items()):
        last = i == len(axes) - 1
        child = name if last else f"{name}_{suffix}"
        ball = shape(name, sphere(radius)) if last else ""
        text += link(child, mass, ball, at if last else "0 0 0")
        text += joint(child, axis, parent, **more)
        parent = child
    return text


X, XY, XZ = {"x": "1 0 0"}, {"x": "1 0 0", "y": "0 1 0"}, {"x": "1 0 0", "z": "0 0 1"}
XYZ = XY | {"z": "0 0 1"}


def feet(size: float, z: float, radius: float, mu: float = 0.5) -> str:
    """Four small balls, foot0 to foot3, at the corners of a square."""
    half = 0.5 * size
    places = [(x, y) for x in (-half, half) for y in (-half, half)]
    return "".join(
        shape(f"foot{i}", sphere(radius), f"{x} {y} {z}", mu)
        for i, (x, y) in enumerate(places)
    )


def on_feet(mu: float = 0.4) -> list[ContactPair]:
    return [ContactPair(f"m::foot{i}", "ground", mu) for i in range(4)]


def in_plane(a: str, b: str, mu: float) -> ContactPair:
    """A pair of a plant that moves in x and z."""
    return ContactPair(a, b, mu, 1, plane_normal=[0.0, 1.0, 0.0])


# Objects of a given mass [kg], for planning.


def door(mass: float) -> tuple[str, list[ContactPair]]:
    """A finger in the plane before a door on a hinge."""
    panel = shape("panel", box(0.8, 0.04, 1.0), "0.4 0 0")
    text = link("door", mass, panel, arm=0.4)
    text += joint("door", "0 0 1", kind="revolute", driven=False, damping=0.8)
    text += finger("tip", XY, "0.6 0.05 0", 0.02)
    return sdf(text), [ContactPair("tip", "door", 0.5)]


def peg(mass: float) -> tuple[str, list[ContactPair]]:
    """A peg that slides and tilts between two walls; 1 mm of play at each side."""
    text = "".join(
        fixed(name, box(0.1, 0.2, 0.4), f"{x} 0 0")
        for name, x in (("left", -0.081), ("right", 0.081))
    )
    text += link("px", 0.05) + joint("px", "1 0 0")
    text += link("pz", 0.05) + joint("pz", "0 0 1", "px")
    capsule = shape("capsule", cylinder(0.03, 0.2, "capsule"))
    text += link("peg", mass, capsule, "0 0 0.1", arm=0.06)
    text += joint("peg", "0 1 0", "pz", "revolute")
    return sdf(text), [in_plane("peg", wall, 0.3) for wall in ("left", "right")]


def can(mass: float) -> tuple[str, list[ContactPair]]:
    """A can on four feet, and a finger beside it."""
    shapes = shape("can", cylinder(0.05, 0.096)) + feet(0.068, -0.048, 0.002)
    text = ground() + finger("tip", XY, "-0.1 0 0.05", 0.02)
    text += link("can", mass, shapes, "0 0 0.05", arm=0.037)
    return sdf(text), [ContactPair("tip", "m::can", 0.4), *on_feet()]


def held_box(mass: float) -> tuple[str, list[ContactPair]]:
    """A box of 6 cm on four feet between two fingers that move in x, y and z."""
    shapes = shape("sides", box(0.06, 0.06, 0.06)) + feet(0.06, -0.03, 0.001)
    text = ground() + finger("left", XYZ, "-0.05 0 0.03")
    text += finger("right", XYZ, "0.05 0 0.03")
    text += link("box", mass, shapes, "0 0 0.031")
    pairs = [ContactPair(name, "m::sides", 0.8) for name in ("left", "right")]
    return sdf(text), [*pairs, *on_feet()]


OF_MASS = {"door": door, "peg": peg, "can": can, "box": held_box}


# Objects of a given error of size [m], for learning.


@dataclass(frozen=True, eq=False)
class Pushed:
    """A plant with objects of which the model's size is wrong, and how it is moved.

    Args:
        world: (error in m of each contact that is learned, further settings) -> SDF
            text; a positive error is a larger gap: a smaller object.
        pairs: contact pairs of the LCS; the first ones are learned.
        bodies: the two bodies of each pair that is learned.
        weighted: velocities that contact changes, as indices of v.
        drive: (time [s], x) -> u.
        seconds: duration of a recording.
        start: x at the start; None: the plant's default.
        turned: positions that are no lengths, as indices of q.
    """

    world: Callable[..., str]
    pairs: list[ContactPair]
    bodies: list[tuple[str, str]]
    weighted: list[int]
    drive: Callable[[float, np.ndarray], np.ndarray]
    seconds: float
    start: np.ndarray | None = None
    turned: tuple[int, ...] = ()


def _puck_world(error, damping=5.0):
    rails = [finger("tip", X, "0 0 0", 0.05, 1.0, damping=5.0)]
    rails += [link("puck", 0.5, shape("puck", sphere(0.05 - error[0])), "0.2 0 0")]
    return sdf(*rails, joint("puck", "1 0 0", driven=False, damping=damping))


def _to_and_fro(t, x):
    """The finger follows a place that goes to and fro, and forwards at 4 cm/s."""
    place = 0.04 * t + 0.03 * np.sin(np.pi * t)
    speed = 0.04 + 0.03 * np.pi * np.cos(np.pi * t)
    return np.array([200.0 * (place - x[0]) + 20.0 * (speed - x[2]) + 5.0 * x[2]])


PUCK = Pushed(
    _puck_world, [ContactPair("tip", "puck", 0.3)], [("tip", "puck")], [0, 1],
    _to_and_fro, 8.0,
)  # fmt: skip


def _squeezed_world(error):
    left, right = 0.05 - error[0], 0.05 - error[1]
    sides = shape("sides", box(left + right, 0.1, 0.1), f"{0.5 * (right - left)} 0 0")
    text = finger("left", X, "-0.15 0 0", 0.02, 1.0, damping=5.0)
    text += finger("right", X, "0.15 0 0", 0.02, 1.0, damping=5.0)
    return sdf(text, link("box", 0.5, sides),
               joint("box", "1 0 0", driven=False, damping=5.0))  # fmt: skip


def _squeeze(t, x):
    """Two fingers press, and push the box to and fro."""
    sway = 3.0 * np.sin(2.0 * np.pi * t / 3.0)
    return np.array([3.0 + sway, -3.0 + sway])


SQUEEZED = Pushed(
    _squeezed_world, [ContactPair(name, "box", 0.3) for name in ("left", "right")],
    [("left", "box"), ("right", "box")], [0, 1, 2], _squeeze, 12.0,
)  # fmt: skip


def _disc_world(error):
    text = ground() + finger("tip", XZ, "0 0 0", 0.02, 0.4, damping=2.0)
    text += link("dx", 0.001) + joint("dx", "1 0 0", driven=False)
    text += link("dz", 0.001) + joint("dz", "0 0 1", "dx", driven=False)
    text += link("disc", 0.3, shape("disc", sphere(0.05 - error[0])), arm=0.03)
    turn = dict(kind="revolute", driven=False, damping=1e-3)
    return sdf(text, joint("disc", "0 1 0", "dz", **turn))


def _press(t, x):
    """The finger comes from above, then presses and lets go, and sways sideways."""
    z = 0.15 - 0.025 * t if t < 2.0 else 0.10 - (0.02 if t % 4.0 < 2.0 else -0.01)
    off = np.array([x[2] + 0.01 * np.sin(np.pi * t), z]) - x[:2]
    return 100.0 * off - 15.0 * x[5:7] + np.array([0.0, 0.4 * G])


DISC = Pushed(
    _disc_world,
    [in_plane("tip", "disc", 0.5), in_plane("disc", "ground", 0.5)],
    [("tip", "disc"), ("disc", "ground")], [0, 1, 2, 3], _press, 12.0,
    np.array([0.0, 0.15, 0.0, 0.06, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
)  # fmt: skip


def _free_world(geometry):
    def world(error, mass=0.4, mu=0.4):
        shapes = shape("sides", geometry(error[0]), mu=mu)
        shapes += feet(0.06, -0.021, 0.004, mu)
        text = ground(mu) + finger("tip", XYZ, "0 0 0", 0.02, 0.3, damping=2.0)
        return sdf(text, link("object", mass, shapes, arm=0.027))

    return world


def _sweep(t, x):
    """The finger pushes along x at 3.5 cm/s, to and fro and swaying."""
    sway = [0.012 * np.sin(np.pi * t), 0.004 * np.sin(2.0 * np.pi * t / 3.0)]
    place = np.array([-0.09 + 0.035 * t + sway[0], sway[1], 0.025])
    return 300.0 * (place - x[:3]) - 30.0 * x[10:13] + np.array([0.0, 0.0, 0.3 * G])


def _free(geometry) -> Pushed:
    """q: the finger's, quaternion and place of the object."""
    start = np.zeros(19)
    start[[0, 2, 3, 9]] = [-0.09, 0.025, 1.0, 0.0251]
    return Pushed(
        _free_world(geometry),
        [ContactPair("tip", "m::sides", 0.4), *on_feet()],
        [("tip", "object")], [0, 1, 6, 7], _sweep, 5.0, start, (3, 4, 5, 6),
    )  # fmt: skip


FREE_BOX = _free(lambda e: box(0.08 - 2.0 * e, 0.08 - 2.0 * e, 0.05))
FREE_CYLINDER = _free(lambda e: cylinder(0.04 - e, 0.05))

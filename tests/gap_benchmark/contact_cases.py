r"""The benchmark's contact half: what is hidden where robots touch things.

    python tests/gap_benchmark/contact_cases.py --set contact-final --out DIR \
        --truth FILE

writes a folder for each case (scene.yaml, its models, recording.csv, noise.json) under
DIR, and what is hidden into FILE, which must lie elsewhere. contact-development and
contact-final have the same recipes; shapes, masses, motions, sizes and signs are drawn,
from seeds that they do not share. Recipes stand in the order of how likely a user
brings them, so that a run that is cut short has the likely ones.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

if __name__ == "__main__":  # The package is found beside the tests.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gap_benchmark import cart_world, cases, push_world
from gap_benchmark.contact_scenes import (
    Episode,
    MujocoWorld,
    Sensing,
    Setting,
    Shape,
    Thing,
    pair,
    pair_friction,
    record,
    write_scene,
)
from gap_benchmark.maker import make_cases
from gap_benchmark.mechanism import quaternion, rotation
from gap_benchmark.robots import Body, Robot, panda, rod

SEEDS = {"contact-development": 710_000, "contact-final": 940_000}
G = 9.81
BACK = 0.03  # A tip that adheres goes back so far [m].
TIE_SLOW = (("object_mass", "contact_friction"),)
TIE_SIZE = (("object_size", "plane_height"),)


@dataclass(frozen=True)
class Recipe:
    """scene: a key of SCENES. world: a key of WORLDS, or ode. hide: names of hide().
    options: camera30, camera60, no_wrench, effort, slow. ties: of kinds."""

    scene: str
    world: str
    hide: str = ""
    options: tuple[str, ...] = ()
    ties: tuple[tuple[str, ...], ...] = ()

    @property
    def name(self) -> str:
        words = [self.scene, self.world, *(self.hide.split() or ["none"])]
        return "_".join([*words, *self.options])


RECIPES = [
    Recipe("push", "mujoco", "mass"),
    Recipe("push", "mujoco", "friction", ("no_wrench",)),
    Recipe("cart", "mujoco", "stiffness"),
    Recipe("push", "mujoco"),
    Recipe("arm", "mujoco", "friction", ("effort",)),
    Recipe("push", "ode", "patch"),
    Recipe("bounce", "ode", "size"),
    Recipe("push", "mujoco", "friction tilt"),
    Recipe("cart", "ode", "stiffness coulomb"),
    Recipe("disc", "mujoco", "friction", ("camera60",)),
    Recipe("arm", "mujoco", "", ("effort",)),
    Recipe("cube", "ode", "height"),
    Recipe("pendulum", "mujoco", "stiffness"),
    Recipe("push", "mujoco", "mass friction"),
    Recipe("arm", "mujoco", "mass", ("no_wrench",)),
    Recipe("push", "mujoco", "tilt", ("camera30",)),
    Recipe("cart", "ode"),
    Recipe("two", "mujoco", "friction"),
    Recipe("disc", "mujoco"),
    Recipe("push", "drake", "mass", ("no_wrench",)),
    Recipe("push", "mujoco", "mass", ("slow",), TIE_SLOW),
    Recipe("cart", "ode", "dissipation"),
    Recipe("push", "mujoco", "adhesion"),
    Recipe("ball", "mujoco", "rolling"),
    Recipe("push", "mujoco", "patch"),
    Recipe("push", "mujoco", "gain"),
    Recipe("push", "ode", "tip_friction"),
    Recipe("disc", "mujoco", "mass", ("no_wrench",)),
    Recipe("bounce", "ode"),
    Recipe("pendulum", "mujoco"),
    Recipe("push", "drake", "friction"),
    Recipe("push", "mujoco", "rail"),
    Recipe("cube", "ode", "friction"),
    Recipe("two", "mujoco"),
    Recipe("push", "ode", "com"),
    Recipe("pendulum", "mujoco", "coulomb"),
    Recipe("push", "drake"),
    Recipe("roll", "mujoco", "mass"),
    Recipe("cart", "mujoco", "coulomb"),
    Recipe("two", "mujoco", "mass"),
    Recipe("ball", "mujoco", "tilt"),
    Recipe("roll", "mujoco"),
    Recipe("push", "mujoco", "drag"),
    Recipe("cube", "ode"),
]


@dataclass(frozen=True)
class ContactCase:
    name: str
    seed: int
    recipe: Recipe

    @property
    def folder(self) -> str:
        """A name that does not tell."""
        return f"case_{self.seed}"


def contact_cases(which: str, seed: int | None = None) -> list[ContactCase]:
    """All cases of a set; seed: of the first one, where it is not the set's own."""
    first = SEEDS[which] if seed is None else seed
    return [
        ContactCase(f"{i:02d}_{recipe.name}", first + i, recipe)
        for i, recipe in enumerate(RECIPES)
    ]


# ----- What is hidden


def hide(s: Setting, names, rng) -> tuple[Setting, list[dict]]:
    """The truth, of which `s` is the scene, and the effects that `s` lacks. What is on
    an object is on the last free thing."""
    found = []
    thing = s.free[-1] if s.free else None
    for name in names:
        up = rng.choice([-1.0, 1.0])
        if name in ("friction", "tip_friction"):
            assert thing is not None
            ground = next(t for t in s.things if not t.mass)
            two = (thing.body, ground.body if name == "friction" else s.tool_body)
            touching = ground.shapes[0] if name == "friction" else s.tool
            mine = thing.shapes[-1] if name == "friction" else thing.shapes[0]
            assert touching is not None
            f = 1.0 + up * rng.uniform(0.25, 0.5)
            value = f * pair_friction(mine, touching)
            s = replace(s, friction={**s.friction, pair(*two): value})
            kind, at, p = "contact_friction", "~".join(two), {"friction": value}
        elif name in ("stiffness",):
            wall = next(t for t in s.things if not t.mass)
            value = s.stiffness * rng.choice(
                [rng.uniform(0.4, 0.6), rng.uniform(1.7, 2.5)]
            )
            s = replace(s, springs={pair(s.tool_body, wall.body): value})
            kind, at = "contact_stiffness", f"{s.tool_body}~{wall.body}"
            p = {"stiffness": value}
        elif name == "mass":
            assert thing is not None
            f = 1.0 + up * rng.uniform(0.2, 0.4)
            inertia = tuple(f * np.array(thing.inertia))
            s = s.with_thing(thing.name, mass=f * thing.mass, inertia=inertia)
            kind, at, p = "object_mass", thing.body, {"mass": f * thing.mass}
        elif name == "tilt":
            ground = next(t for t in s.things if not t.mass)
            roll, pitch = rng.uniform(0.012, 0.03, 2) * rng.choice([-1.0, 1.0], 2)
            s = s.with_thing(ground.name, roll=float(roll), pitch=float(pitch))
            kind, at = "plane_tilt", ground.body
            p = {"roll": float(roll), "pitch": float(pitch)}
        elif name == "patch":
            assert thing is not None
            ground = next(t for t in s.things if not t.mass)
            half = 0.25 * np.array(rng.uniform(0.1, 0.16, 2))
            middle = rng.uniform(-0.04, 0.04, 2)
            value = pair_friction(thing.shapes[-1], ground.shapes[0])
            value *= rng.uniform(1.6, 2.0)
            sides = np.stack([middle - half, middle + half], axis=1).ravel()
            s = replace(s, patch=(value, *map(float, sides)))
            words = ("friction", "x_min", "x_max", "y_min", "y_max")
            kind, at = "friction_patch", f"{thing.body}~{ground.body}"
            p = dict(zip(words, s.patch, strict=True))
        elif name in ("rail", "coulomb", "gain"):
            assert s.robot is not None
            k = int(rng.integers(len(s.robot.joints)))
            at, values = (
                s.robot.joints[k],
                s.of_joints("gain" if name == "gain" else "coulomb"),
            )
            if name == "gain":
                values[k] = 1.0 + up * rng.uniform(0.12, 0.25)
                s, kind = replace(s, gain=tuple(values)), "actuator_gain"
                p = {"gain": float(values[k])}
            else:
                values[k] = rng.uniform(0.3, 0.6) * _usual_effort(s)
                s, kind = replace(s, coulomb=tuple(values)), "joint_coulomb_friction"
                p = {"coulomb": float(values[k])}
        elif name == "drag":
            assert thing is not None
            value = thing.mass * rng.uniform(4.0, 7.0)
            s = replace(s, drag={thing.body: value})
            kind, at = "body_drag", thing.body
            p = {"linear": value, "angular": 0.0}
        elif name == "adhesion":
            assert thing is not None
            # More than friction holds: what is pulled comes along.
            ground = next(t for t in s.things if not t.mass)
            mu = pair_friction(thing.shapes[-1], ground.shapes[0])
            s = replace(s, adhesion=rng.uniform(1.4, 1.9) * mu * thing.mass * G)
            kind, at, p = "adhesion", thing.body, {"force": s.adhesion}
        else:
            raise ValueError(f"no law for {name}")
        found.append(
            {"kind": kind, "at": at, "parameters": {k: float(x) for k, x in p.items()}}
        )
    return s, found


def _usual_effort(s: Setting) -> float:
    """[N or N m] that the drives give now and then."""
    if s.free:
        return 0.4 * s.free[-1].mass * G
    assert s.robot is not None
    return 1.2 if s.robot.model == "cart" else 0.3


# ----- Scenes: (setting, episodes of a true setting)


def block(rng, name="block", half=None) -> Thing:
    """A box on four feet; the box is met by tools, the feet by the ground."""
    if half is None:
        half = (
            rng.uniform(0.05, 0.09),
            rng.uniform(0.04, 0.07),
            rng.uniform(0.03, 0.045),
        )
    foot, mu = 0.006, rng.uniform(0.2, 0.45)
    feet = [(a * (half[0] - foot), b * (half[1] - foot), -half[2])
            for a in (-1, 1) for b in (-1, 1)]  # fmt: skip
    m = rng.uniform(0.5, 1.6)
    x, y, z = half
    inertia = tuple(m / 3.0 * np.array([y * y + z * z, x * x + z * z, x * x + y * y]))
    shapes = (Shape("box", tuple(half), rng.uniform(0.1, 0.3)),
              *(Shape("sphere", (foot,), mu, at) for at in feet))  # fmt: skip
    return Thing(name, shapes, m, inertia)


def disc(rng, name="disc") -> Thing:
    """A cylinder on three feet."""
    r, h = rng.uniform(0.05, 0.08), rng.uniform(0.025, 0.04)
    foot, mu, m = 0.006, rng.uniform(0.2, 0.45), rng.uniform(0.5, 1.4)
    feet = [(0.8 * r * np.cos(a), 0.8 * r * np.sin(a), -h)
            for a in 2 * np.pi / 3 * np.arange(3)]  # fmt: skip
    i = m * (3 * r * r + 4 * h * h) / 12
    shapes = (
        Shape("cylinder", (r, h), rng.uniform(0.1, 0.3)),
        *(Shape("sphere", (foot,), mu, tuple(map(float, at))) for at in feet),
    )
    return Thing(name, shapes, m, (i, i, 0.5 * m * r * r))  # fmt: skip


def round_ball(rng, name="ball") -> Thing:
    r, m = rng.uniform(0.04, 0.06), rng.uniform(0.3, 0.9)
    shape = Shape("sphere", (r,), rng.uniform(0.3, 0.6))
    return Thing(name, (shape,), m, (0.4 * m * r * r,) * 3)


def table(friction: float) -> Thing:
    return Thing("table", (Shape("ground", (), friction),))


def height(t: Thing) -> float:
    """Of the origin of a thing that lies [m]; it sinks in by its weight."""
    lowest = min(x.place[2] - (x.size[0] if x.kind == "sphere" else x.size[-1])
                 for x in t.shapes)  # fmt: skip
    return -lowest


def lying(t: Thing, s: Setting, xy, yaw: float) -> np.ndarray:
    """(7,) origin and orientation of a thing that lies on the true ground."""
    ground = next(u for u in s.things if not u.mass)
    q_tilt = quaternion((ground.roll, ground.pitch, 0.0))
    n = rotation(q_tilt)[:, 2]
    feet = sum(x.kind == "sphere" for x in t.shapes)
    up = height(t) - t.mass * G / feet / s.stiffness
    flat = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    w, x = q_tilt[0], q_tilt[1:]
    vector = w * flat[1:] + flat[0] * x + np.cross(x, flat[1:])
    q = np.concatenate([[w * flat[0] - x @ flat[1:]], vector])
    p = np.array([*xy, -(np.array(xy) @ n[:2]) / n[2]])
    return np.concatenate([p + up * n, q])


def tip_robot(rng, z: float) -> Robot:
    """Two slides that carry a tip at height z."""
    m = rng.uniform(0.4, 1.0)
    small = (1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0)
    bodies = (
        Body("slide", "x", (0, 0, z), (0, 0, 0), 0.05, (0.0, 0.0, 0.0), small,
             axis=(1.0, 0.0, 0.0), sliding=True),
        Body("tip", "y", (0, 0, 0), (0, 0, 0), float(m), (0.0, 0.0, 0.0), small,
             axis=(0.0, 1.0, 0.0), sliding=True),
    )  # fmt: skip
    two = np.zeros(2)
    return Robot("pusher", bodies, two, two, two)


def pushed(recipe: Recipe, rng):
    """A tip pushes a block, a disc, a ball, or a block into a disc."""
    things: tuple[Thing, ...]
    if recipe.scene == "disc":
        things = (disc(rng),)
    elif recipe.scene == "roll":
        things = (round_ball(rng),)
    elif recipe.scene == "two":
        things = (block(rng), disc(rng))
        # The block must meet the disc's side, well below both tops.
        top = min(height(t) + t.shapes[0].size[-1] for t in things)
        assert top > 0.04
    else:
        things = (block(rng),)
    first = things[0]
    mu = first.shapes[-1].friction
    h = 0.85 * height(first) if recipe.scene != "roll" else height(first)
    robot = tip_robot(rng, h)
    drive = "effort" if "effort" in recipe.options else "pd"
    s = Setting(
        (table(mu), *things), robot, Shape("sphere", (0.012,), rng.uniform(0.1, 0.3)),
        drive, tuple(rng.uniform(2500.0, 5000.0, 1)) * 2,
        tuple(rng.uniform(80.0, 200.0, 1)) * 2,
    )  # fmt: skip
    slow = "slow" in recipe.options

    def episodes(true: Setting, rng) -> list[Episode]:
        found = []
        for _ in range(5):
            seconds = 2.4
            t, way, speed = push_world._path(rng, seconds, s.rate)
            if slow:  # One constant speed, with soft ends.
                v = 0.03 * np.clip(np.minimum(t - 0.2, seconds - 0.2 - t) / 0.3, 0, 1)
                way, speed = np.concatenate([[0], np.cumsum(v)[:-1] / s.rate]), v
            if true.adhesion:  # It shows where the tip pulls.
                back = (
                    0.5 * BACK * (1 - np.cos(np.linspace(0, np.pi, int(0.6 * s.rate))))
                )
                way = np.concatenate([way, way[-1] - back])
                speed = np.gradient(way) * s.rate
                t, seconds = np.arange(len(way)) / s.rate, seconds + 0.6
            yaw = rng.uniform(-np.pi, np.pi)
            reach, across = _sides(first, rng)
            angle = yaw + reach[1]
            heading = np.array([np.cos(angle + np.pi), np.sin(angle + np.pi)])
            aside = np.array([-heading[1], heading[0]])
            middle = -0.5 * way[-1] * heading + rng.uniform(-0.02, 0.02, 2)
            beside = rng.uniform(-0.25, 0.25) * across
            gap = rng.uniform(0.004, 0.012)
            start = middle - heading * (reach[0] + 0.012 + gap) + beside * aside
            poses = {first.body: lying(true.thing(first.name), true, middle, yaw)}
            if len(things) == 2:
                other = true.thing(things[1].name)
                far = reach[0] + other.shapes[0].size[0] + rng.uniform(0.01, 0.02)
                at = middle + far * heading + rng.uniform(-0.01, 0.01) * aside
                poses[other.body] = lying(other, true, at, rng.uniform(-3, 3))

            def command(at, q, v, t=t, way=way, speed=speed, start=start,
                        heading=heading):  # fmt: skip
                k = int(np.clip(np.searchsorted(t, at + 1e-9) - 1, 0, len(t) - 1))
                return np.concatenate([start + way[k] * heading, speed[k] * heading])

            found.append(Episode(seconds, start, poses, command))
        return found

    return s, episodes


def _sides(t: Thing, rng):
    """((half of the side that is met, its angle), half of the side across)."""
    x = t.shapes[0]
    if x.kind != "box":
        return (x.size[0], 0.0), 0.6 * x.size[0]
    face = int(rng.integers(4))
    return (x.size[face % 2], 0.5 * np.pi * face), x.size[1 - face % 2]


def arm_pushes(recipe: Recipe, rng):
    """A Panda with a rod in its hand pushes a box over a table."""
    robot = panda(rng)
    rod_length = 0.16
    m = rng.uniform(0.3, 0.6)
    hand = Body("rod", "", (0, 0, 0.107), (0, 0, 0), float(m),
                (0.0, 0.0, 0.5 * rod_length), rod(m, rod_length, 0.012))  # fmt: skip
    robot = replace(robot, bodies=(*robot.bodies, hand))
    box = block(rng)
    mu = box.shapes[-1].friction
    tool = Shape("sphere", (0.012,), rng.uniform(0.1, 0.3), (0.0, 0.0, rod_length))
    measured = "effort" in recipe.options
    kp, kd = (6000.0,) * 4 + (2500.0,) * 3, (300.0,) * 4 + (60.0,) * 3
    s = Setting((table(mu), box), robot, tool, "pd", kp, kd)

    def episodes(true: Setting, rng) -> list[Episode]:
        world = MujocoWorld(s)  # For its geometry.
        found = []
        for _ in range(4):
            seconds = 2.4
            t, way, speed = push_world._path(rng, seconds, s.rate)
            way = 0.7 * way
            yaw = rng.uniform(-np.pi, np.pi)
            reach, across = _sides(box, rng)
            heading = -np.array([np.cos(yaw + reach[1]), np.sin(yaw + reach[1])])
            aside = np.array([-heading[1], heading[0]])
            middle = np.array([0.5, 0.0]) - 0.5 * way[-1] * heading
            middle = middle + rng.uniform(-0.03, 0.03, 2)
            start = middle - heading * (reach[0] + 0.012 + rng.uniform(0.004, 0.012))
            start = start + rng.uniform(-0.25, 0.25) * across * aside
            z = 0.85 * height(box)
            path = np.column_stack([
                start[0] + way * heading[0], start[1] + way * heading[1],
                np.full(len(t), z),
            ])  # fmt: skip
            q, sag = _joints_along(world, s, path)
            rate = np.gradient(q, t, axis=0)
            poses = {box.body: lying(true.thing("block"), true, middle, yaw)}

            asked = np.hstack([q + sag, rate])

            def command(at, now, v, asked=asked):
                k, part = divmod(min(at * s.rate + 1e-9, len(asked) - 1.001), 1.0)
                k = int(k)
                return asked[k] + part * (asked[k + 1] - asked[k])

            found.append(Episode(seconds, q[0], poses, command))
        return found

    # Measured efforts stand in for commands.
    return (replace(s, drive="effort") if measured else s), episodes


def _joints_along(world: MujocoWorld, s: Setting, path):
    """(n, 7) joints that take the tool along path (n, 3), pointing down, and (n, 7) by
    how much a drive sags under the arm's weight."""
    import mujoco

    m, d = world.model, world.data
    geom = m.geom(f"{s.tool_body}/0").id
    body, at = m.geom_bodyid[geom], world.v_at
    q = np.array([0.0, 0.3, 0.0, -2.2, 0.0, 2.5, 0.8])
    found, sag = [], []
    for k, x in enumerate(path):
        for _ in range(200 if k == 0 else 4):
            d.qpos[world.q_at], d.qvel[:] = q, 0.0
            mujoco.mj_forward(m, d)
            J, Jr = np.zeros((3, m.nv)), np.zeros((3, m.nv))
            mujoco.mj_jac(m, d, J, Jr, d.geom_xpos[geom], body)
            down = d.xmat[body].reshape(3, 3)[:, 2]
            e = np.concatenate(
                [x - d.geom_xpos[geom], np.cross(down, [0.0, 0.0, -1.0])]
            )
            e = np.clip(e, -0.05, 0.05)
            A = np.vstack([J, Jr])[:, at]
            q = q + A.T @ np.linalg.solve(A @ A.T + 1e-6 * np.eye(6), e)
        found.append(q)
        sag.append(d.qfrc_bias[at] / np.array(s.kp))
    if np.linalg.norm(path[-1] - d.geom_xpos[geom]) > 1e-3:
        raise RuntimeError("the arm does not reach its path")
    return np.array(found), np.array(sag)


def against_walls(recipe: Recipe, rng):
    """A cart on a rail between two walls, or a pendulum between two."""
    r = 0.02
    ball = Shape("sphere", (r,), 0.0)
    stiffness = rng.uniform(8e3, 2.5e4)
    if recipe.scene == "cart":
        m, reach = rng.uniform(0.8, 2.0), rng.uniform(0.12, 0.2)
        body = Body("cart", "rail", (0, 0, 0), (0, 0, 0), float(m), (0.0, 0.0, 0.0),
                    (1e-3, 1e-3, 1e-3, 0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0),
                    sliding=True)  # fmt: skip
        robot = Robot("cart", (body,), np.zeros(1), np.zeros(1), np.zeros(1))
        at, push = (0.0, 0.0, 0.0), (1.5, 4.0)
        walls = [(side * (reach + r + 0.1), 0.0, 0.0) for side in (-1, 1)]
        scale = reach
    else:
        m, length = rng.uniform(0.3, 0.8), rng.uniform(0.25, 0.4)
        body = Body("rod", "hinge", (0, 0, 0), (0, 0, 0), float(m),
                    (0.0, 0.0, -0.6 * length), rod(m, length, 0.02),
                    axis=(0.0, -1.0, 0.0), rotor=0.002)  # fmt: skip
        robot = Robot("pendulum", (body,), np.zeros(1), np.zeros(1), np.zeros(1))
        at, push = (0.0, 0.0, -length), (0.4, 1.1)
        scale = rng.uniform(0.25, 0.4)
        walls = [(side * (length * np.sin(scale) + r + 0.1), 0.0, -length)
                 for side in (-1, 1)]  # fmt: skip
    wall = Thing("wall", tuple(Shape("box", (0.1, 0.2, 0.2), 0.0, w) for w in walls))
    s = Setting(
        (wall,), robot, replace(ball, place=at), "effort", stiffness=stiffness,
        dissipation=rng.uniform(0.3, 1.0), rate=500.0,
    )  # fmt: skip

    def episodes(true: Setting, rng) -> list[Episode]:
        state = {"side": 1.0, "push": rng.uniform(*push), "since": 0.0}

        def command(t, q, v):
            side = state["side"]
            # Pushed to one side until a while after the wall was met.
            met = side * q[0] > 0.97 * scale and side * v[0] < -0.1 * scale
            if met or t - state["since"] > 1.5:
                state.update(side=-side, push=rng.uniform(*push), since=t)
            strength = state["push"] * (
                1.0 if recipe.scene == "cart" else m * length * 8
            )
            return np.array([state["side"] * strength - 0.4 * m * scale * v[0]])

        return [Episode(9.0, np.zeros(1), {}, command)]

    return s, episodes


def dampers(true: Setting) -> float:
    """The linear damper of MuJoCo's contacts, all alike [N s/m]."""
    world = MujocoWorld(true)
    m = world.model
    found = []
    for k in range(m.npair):
        bodies = [m.geom_bodyid[g] for g in (m.pair_geom1[k], m.pair_geom2[k])]
        ease = sum(float(m.body_invweight0[b, 0]) for b in bodies)
        found.append(-float(m.pair_solref[k][1]) / ease)
    assert np.allclose(found, found[0])
    return found[0]


SCENES: dict[str, Callable] = {
    "push": pushed, "disc": pushed, "roll": pushed, "two": pushed,
    "arm": arm_pushes, "cart": against_walls, "pendulum": against_walls,
}  # fmt: skip


# ----- Cases


def sensing(recipe: Recipe) -> Sensing:
    hz = {"camera30": 30.0, "camera60": 60.0}
    camera = next((hz[o] for o in recipe.options if o in hz), 125.0)
    robot = recipe.scene
    wrench = None if {"no_wrench"} & set(recipe.options) else 0.05
    if robot in ("cart", "pendulum"):
        return Sensing(wrench=None)
    effort = 0.04 if robot == "arm" and "effort" in recipe.options else None
    encoder = 2e-5 if robot == "arm" else 1e-5
    return Sensing(camera, encoder=encoder, wrench=wrench, effort=effort)


def write(case: ContactCase, folder: Path) -> dict:
    """Writes the case's folder. Returns: its truth, which is not in the folder."""
    recipe, rng = case.recipe, np.random.default_rng(case.seed)
    names = recipe.hide.split()
    if recipe.scene in ("ball", "bounce", "cube"):
        effects = _write_object(case, folder)
    elif recipe.world == "ode":
        effects = _write_ode(recipe, folder, rng)
    else:
        s, episodes = SCENES[recipe.scene](recipe, rng)
        truth, effects = hide(s, names, rng)
        # What drives the true robot is the same, whatever is measured of it.
        if truth.kp and truth.drive == "effort":
            truth = replace(truth, drive="pd", smooth=True)
        columns, noise = record(
            truth, recipe.world, episodes(truth, rng), sensing(recipe), rng
        )
        mujoco_ = recipe.world == "mujoco"
        tolerance = {
            "contact_stiffness": 0.1,
            "contact_dissipation": 1.0 if mujoco_ else 0.5,
        }
        if recipe.scene in ("cart", "pendulum"):
            tolerance = {"link_mass": 0.01} | (
                {"contact_dissipation": 1.0} if mujoco_ else {}
            )
        write_scene(folder, s, columns, noise, 0.0005, tolerance)
        if mujoco_ and recipe.scene in ("cart", "pendulum"):
            # MuJoCo's damper is linear, Hunt-Crossley's is not.
            at = f"{s.tool_body}~wall.wall"
            effects.append({"kind": "contact_damping", "at": at,
                            "parameters": {"damping": dampers(truth)}})  # fmt: skip
    outside = "adhesion" in names
    verdict = (
        "gap_unnamed" if outside else "ambiguous" if recipe.ties
        else "gap_named" if any(e.get("needed", True) for e in effects) else "no_gap"
    )  # fmt: skip
    return {
        "name": case.name, "verdict": verdict, "effects": effects,
        "ties": [list(tie) for tie in recipe.ties], "world": recipe.world,
    }  # fmt: skip


def _write_ode(recipe: Recipe, folder: Path, rng) -> list[dict]:
    """By the equations of push_world.py and cart_world.py."""
    names = recipe.hide.split()
    if recipe.scene == "push":
        kinds = {"friction": "contact_friction", "mass": "object_mass",
                 "tilt": "plane_tilt", "com": "object_com",
                 "patch": "friction_patch", "tip_friction": "tip_friction"}  # fmt: skip
        world = push_world.a_world(rng)
        true = push_world.with_hidden(world, [kinds[n] for n in names], rng)
        look = sensing(recipe)
        columns, noise = push_world.record(
            true, rng, episodes=6, seconds=2.4, camera=look.camera_hz,
            wrench=look.wrench is not None,
        )  # fmt: skip
        push_world.write(folder, world, columns, noise)
        return [dict(e) for e in true.hidden]
    cart = cart_world.Cart(
        mass=rng.uniform(0.8, 2.0), stiffness=rng.uniform(8e3, 3e4),
        dissipation=rng.uniform(0.3, 1.2),
    )  # fmt: skip
    changes, effects = {}, []
    for name in names:
        if name == "coulomb":
            changes[name], kind = rng.uniform(0.3, 0.6), "joint_coulomb_friction"
        else:
            f = rng.choice([rng.uniform(0.4, 0.6), rng.uniform(1.7, 2.5)])
            changes[name], kind = f * getattr(cart, name), f"contact_{name}"
        at = "cart.rail" if name == "coulomb" else cart_world.PAIR
        effects.append(
            {"kind": kind, "at": at, "parameters": {name: float(changes[name])}}
        )
    columns, noise = cart_world.record(replace(cart, **changes), rng, 10.0)
    cart_world.write(folder, cart, columns, noise)
    return effects


def _write_object(case: ContactCase, folder: Path) -> list[dict]:
    """Free objects, as the older benchmark draws them."""
    kinds = {"size": "object_size", "height": "plane_height", "tilt": "plane_tilt",
             "rolling": "rolling_resistance", "friction": "contact_friction",
             }  # fmt: skip
    hidden = tuple(kinds[n] for n in case.recipe.hide.split())
    old = cases.Case(case.name, case.seed, case.recipe.scene, hidden, False)
    return cases.write(old, folder)["effects"]


if __name__ == "__main__":
    make_cases("recordings of contact", list(SEEDS), contact_cases, write)

r"""The same in the large: scenes that nobody had in mind when the method was written.

    python tests/gap_benchmark/large_scenes.py SCENE HIDE SEED FOLDER [--camera HZ] \
        [--no-wrench]

writes a scene and its recording into FOLDER and prints what is hidden. The world is
MuJoCo: its contact law is not the one of the scene.
"""

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

if __name__ == "__main__":  # The package is found beside the tests.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gap_benchmark.contact_cases import (
    block,
    height,
    hide,
    lying,
    round_ball,
    table,
    tip_robot,
)
from gap_benchmark.contact_scenes import (
    Episode,
    Sensing,
    Setting,
    Shape,
    Thing,
    pair,
    pair_friction,
    record,
    write_scene,
)
from gap_benchmark.robots import Body, Robot

G = 9.81
TIP = 0.012  # Radius [m].


# ----- Motions of a tip


def path_along(stops, speed: float, rate: float, rest: float = 0.25):
    """(n, k) places and (n, k) rates of commands: at rest, from stop to stop (m, k)
    with soft ends, and `rest` [s] at each."""
    stops = np.asarray(stops, float)
    places, n_rest = [np.tile(stops[0], (int(rest * rate), 1))], int(rest * rate)
    for a, b in zip(stops, stops[1:], strict=False):
        n = max(int(1.5 * np.linalg.norm(b - a) / speed * rate), 8)
        s = np.arange(1, n + 1) / n
        places.append(a + (3 * s**2 - 2 * s**3)[:, None] * (b - a))
        places.append(np.tile(b, (n_rest, 1)))
    way = np.vstack(places)
    return way, np.gradient(way, 1.0 / rate, axis=0)


def follows(way, rate_of_way, poses, rate: float) -> Episode:
    def command(at, q, v):
        k = min(int(at * rate + 1e-6), len(way) - 1)
        return np.concatenate([way[k], rate_of_way[k]])

    return Episode(len(way) / rate, way[0], poses, command)


def _driven(rng, things, z: float, robot=None, tool=None, kp=None) -> Setting:
    robot = robot or tip_robot(rng, z)
    n = len(robot.joints)
    kp = float(rng.uniform(2500.0, 5000.0)) if kp is None else kp
    kd = float(rng.uniform(80.0, 160.0))
    tool = tool or Shape("sphere", (TIP,), float(rng.uniform(0.1, 0.3)))
    return Setting(things, robot, tool, "pd", (kp,) * n, (kd,) * n, rate=240.0)


def standing(t: Thing, s: Setting, xy, yaw: float) -> np.ndarray:
    """(7,) pose of a box on level ground, as deep in it as its weight presses it."""
    up = t.shapes[0].size[2] - t.mass * G / 4.0 / s.stiffness
    return np.array([*xy, up, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def turned(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


# ----- Scenes: (setting, episodes of the true setting)


def two_free(rng, second: Callable):
    """A tip pushes a block, and the block something else."""
    one, other = block(rng), second(rng)
    s = _driven(rng, (table(one.shapes[-1].friction), one, other), 0.85 * height(one))

    def episodes(true: Setting, rng) -> list[Episode]:
        found = []
        for _ in range(5):
            R = turned(rng.uniform(-np.pi, np.pi))
            hx, hy, _ = one.shapes[0].size
            far = other.shapes[0].size[0]
            gap = rng.uniform(0.008, 0.02)
            start = np.array([-hx - TIP - 0.008, rng.uniform(-0.2, 0.2) * hy])
            aside = rng.uniform(-0.2, 0.2) * hy
            at = np.array([hx + far + gap, aside])
            yaw = float(np.arctan2(R[1, 0], R[0, 0]))
            poses = {
                one.body: lying(true.thing(one.name), true, (0.0, 0.0), yaw),
                other.body: lying(true.thing(other.name), true, R @ at, yaw),
            }
            end = start + [rng.uniform(0.12, 0.2), 0.0]
            middle = start + [rng.uniform(0.5, 0.7) * (end - start)[0], 0.0]
            speed = rng.uniform(0.07, 0.14)
            stops = np.array([start, middle, end]) @ R.T
            found.append(follows(*path_along(stops, speed, s.rate), poses, s.rate))
        return found

    return s, episodes


def second_block(rng) -> Thing:
    return block(rng, "second")


def corner(rng):
    """A tip pushes a block to one wall, and along it to another."""
    one = block(rng)
    hx, hy, _ = one.shapes[0].size
    mu = float(rng.uniform(0.15, 0.35))
    walls = (
        Thing("east", (Shape("box", (0.02, 0.3, 0.05), mu),), place=(0.22, 0.0, 0.05)),
        Thing("north", (Shape("box", (0.3, 0.02, 0.05), mu),), place=(0.0, 0.2, 0.05)),
    )
    things = (table(one.shapes[-1].friction), one, *walls)
    s = _driven(rng, things, 0.85 * height(one))

    def episodes(true: Setting, rng) -> list[Episode]:
        found = []
        x_end = true.thing("east").place[0] - 0.02
        y_end = true.thing("north").place[1] - 0.02
        for _ in range(5):
            gap = rng.uniform(0.02, 0.04)
            x, y = rng.uniform(-0.02, 0.02), y_end - hy - gap
            poses = {one.body: lying(true.thing(one.name), true, (x, y), 0.0)}
            off = 0.15 * rng.uniform(-1.0, 1.0) * hx
            press = rng.uniform(0.001, 0.003)
            south = np.array([x + off, y - hy - TIP - 0.01])
            met = np.array([x + off, y_end - 2 * hy - TIP + press])
            back = np.array([x + off, y - hy - TIP - 0.02])
            west = np.array([x - hx - TIP - 0.015, back[1]])
            beside = np.array([west[0], y_end - hy + rng.uniform(-0.3, 0.1) * hy])
            end = np.array([x_end - 2 * hx - TIP + press, beside[1]])
            far = np.array([beside[0], beside[1]])
            stops = [south, met, back, west, beside, end, far]
            speed = rng.uniform(0.08, 0.14)
            found.append(follows(*path_along(stops, speed, s.rate), poses, s.rate))
        return found

    return s, episodes


def peg(rng):
    """A position-driven peg, soft, is put into a square hole and moved about in it."""
    half, clear, depth = 0.012, float(rng.uniform(4e-4, 8e-4)), 0.03
    mu = float(rng.uniform(0.1, 0.25))
    m, small = float(rng.uniform(0.4, 0.9)), (1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0)
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    bodies = tuple(
        Body(f"stage_{a}", a, (0, 0, 0), (0, 0, 0), 0.3 if a != "z" else m,
             (0.0, 0.0, 0.0), small, axis=axis, sliding=True)
        for a, axis in zip("xyz", axes, strict=True)
    )  # fmt: skip
    robot = Robot("gantry", bodies, np.zeros(3), np.zeros(3), np.zeros(3))
    wide, w = half + clear, 0.02
    sides = tuple(
        Shape("box", size, mu, at)
        for size, at in (
            ((w, wide + 2 * w, depth / 2), (wide + w, 0.0, depth / 2)),
            ((w, wide + 2 * w, depth / 2), (-wide - w, 0.0, depth / 2)),
            ((wide, w, depth / 2), (0.0, wide + w, depth / 2)),
            ((wide, w, depth / 2), (0.0, -wide - w, depth / 2)),
            ((wide, wide, w), (0.0, 0.0, -w)),
        )
    )
    tool = Shape("box", (half, half, 0.03), mu)
    s = _driven(rng, (Thing("socket", sides),), 0.0, robot, tool, 2000.0)

    def episodes(true: Setting, rng) -> list[Episode]:
        hole, found = np.array(true.thing("socket").place), []
        for _ in range(5):
            top, low = hole[2] + depth + 0.04, hole[2] + 0.03
            stops = [[*hole[:2], top], [*(hole[:2] + rng.uniform(-2e-4, 2e-4, 2)), low]]
            for _ in range(6):  # Against the walls, and down.
                aside = rng.uniform(-0.004, 0.004, 2)
                stops.append([*(hole[:2] + aside), low + rng.uniform(-0.003, 0.012)])
            stops += [[*hole[:2], low], [*hole[:2], top]]
            way = path_along(stops, rng.uniform(0.05, 0.08), s.rate, 0.15)
            found.append(follows(*way, {}, s.rate))
        return found

    return s, episodes


def tipped(rng):
    """A tip pushes a tall box near its top until it falls over its lower edge."""
    half = tuple(float(rng.uniform(a, b)) for a, b in ((0.03, 0.045), (0.03, 0.05),
                                                       (0.07, 0.09)))  # fmt: skip
    m, (x, y, z) = float(rng.uniform(0.4, 1.0)), half
    inertia = tuple(m / 3.0 * np.array([y * y + z * z, x * x + z * z, x * x + y * y]))
    box = Thing("box", (Shape("box", half, float(rng.uniform(0.7, 0.9))),), m, inertia)
    s = _driven(rng, (table(box.shapes[0].friction), box), 1.7 * z)

    def episodes(true: Setting, rng) -> list[Episode]:
        found = []
        for k in range(6):
            R = turned(rng.uniform(-np.pi, np.pi))
            start = np.array([-x - TIP - 0.01, rng.uniform(-0.1, 0.1) * y])
            # Each other one stands up again.
            goes = (0.7 if k % 2 else 1.5) * 2 * x
            stops = np.array([start, start + [goes + 0.01, 0.0], start]) @ R.T
            yaw = float(np.arctan2(R[1, 0], R[0, 0]))
            p = standing(true.thing(box.name), s, (0.0, 0.0), yaw)
            way = path_along(stops, rng.uniform(0.06, 0.1), s.rate, 0.3)
            found.append(follows(*way, {box.body: p}, s.rate))
        return found

    return s, episodes


def over_the_table(rng):
    """A tip pushes a box over the edge of a table until it tips, and drops."""
    half = (0.08, float(rng.uniform(0.04, 0.06)), float(rng.uniform(0.02, 0.03)))
    m, (x, y, z) = float(rng.uniform(0.4, 1.0)), half
    inertia = tuple(m / 3.0 * np.array([y * y + z * z, x * x + z * z, x * x + y * y]))
    mu = float(rng.uniform(0.25, 0.45))
    box = Thing("box", (Shape("box", half, mu),), m, inertia)
    top = Thing("table", (Shape("box", (0.3, 0.3, 0.05), mu, (0.0, 0.0, -0.05)),))
    s = _driven(rng, (top, box), z)

    def episodes(true: Setting, rng) -> list[Episode]:
        found = []
        for _ in range(5):
            out = 0.3 - x - rng.uniform(0.02, 0.05)
            yaw = rng.uniform(-0.1, 0.1)
            p = standing(true.thing(box.name), s, (out, rng.uniform(-0.1, 0.1)), yaw)
            start = p[:2] + [-x - TIP - 0.015, rng.uniform(-0.1, 0.1) * y]
            far = rng.uniform(0.12, 0.16)
            way, rates = path_along(
                [start, start + [far, 0.0]], rng.uniform(0.06, 0.1), s.rate, 0.3
            )
            found.append(follows(way, rates, {box.body: p}, s.rate))
        return found

    return s, episodes


SCENES: dict[str, Callable] = {
    "two_blocks": lambda rng: two_free(rng, second_block),
    "block_ball": lambda rng: two_free(rng, round_ball),
    "corner": corner, "peg": peg, "tipped": tipped, "over_the_table": over_the_table,
}  # fmt: skip


# ----- What is hidden, beside what contact_cases hides


def hidden(s: Setting, name: str, rng) -> tuple[Setting, list[dict]]:
    if name in ("wall", "hole"):
        fixed = [t for t in s.things if not t.mass]
        t = fixed[-1]
        size = (0.002, 0.006) if name == "hole" else (0.003, 0.01)
        by = rng.uniform(*size, 2) * rng.choice([-1.0, 1.0], 2)
        by = by if name == "hole" else by * [0.0, 1.0]
        place = tuple(float(x) for x in np.array(t.place) + [*by, 0.0])
        p = {a: float(x) for a, x in zip("xy", by, strict=True) if x}
        effect = {"kind": "wall_position", "at": t.body, "parameters": p}
        return s.with_thing(t.name, place=place), [effect]
    if name in ("wall_friction", "contact"):
        # Of what is fixed last: with the tool if nothing is free.
        t = [t for t in s.things if not t.mass][-1]
        mine = s.free[-1].shapes[0] if s.free else s.tool
        body = s.free[-1].body if s.free else s.tool_body
        assert mine is not None
        value = pair_friction(mine, t.shapes[0])
        value *= rng.choice([rng.uniform(0.4, 0.6), rng.uniform(1.5, 2.0)])
        s = replace(s, friction={**s.friction, pair(t.body, body): float(value)})
        at = f"{body}~{t.body}" if s.free else f"{t.body}~{body}"
        p = {"friction": float(value)}
        return s, [{"kind": "contact_friction", "at": at, "parameters": p}]
    return hide(s, [name], rng)


# ----- Cases


def write(
    scene: str, name: str, seed: int, folder: Path, hz=120.0, wrench=True, most=None
) -> list[dict]:
    """Writes scene and recording, of so many episodes at most. Returns: what is hidden,
    which is not in the folder."""
    rng = np.random.default_rng(seed)
    s, episodes = SCENES[scene](rng)
    truth, effects = hidden(s, name, rng) if name else (s, [])
    sense = Sensing(hz, wrench=0.05 if wrench else None)
    columns, noise = record(truth, "mujoco", episodes(truth, rng)[:most], sense, rng)
    tolerance = {"contact_stiffness": 0.1, "contact_dissipation": 1.0}
    write_scene(folder, s, columns, noise, 0.0005, tolerance)
    return effects


def main() -> None:
    parser = argparse.ArgumentParser(description="Writes a scene and its recording.")
    parser.add_argument("scene", choices=[*SCENES])
    parser.add_argument("hide", help="what is hidden, or none")
    parser.add_argument("seed", type=int)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--camera", type=float, default=120.0, help="[Hz]")
    parser.add_argument("--no-wrench", action="store_true")
    args = parser.parse_args()
    name = "" if args.hide == "none" else args.hide
    found = write(args.scene, name, args.seed, args.folder, args.camera,
                  not args.no_wrench)  # fmt: skip
    print(json.dumps(found))


if __name__ == "__main__":
    main()

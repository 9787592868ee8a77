"""A driven tip that pushes a block over a table: by an ODE of our own.

The tip slides along x and y at a fixed height, each joint driven by its own loop,
kp (command - x) + kd (velocity command - v), whose commands hold between rows. The
block stands on four feet (spheres) and is met by the tip at its box. Each contact is

    f_n = k depth (1 + d depth_rate)+,    f_t = -mu f_n v_t/sqrt(|v_t|^2 + v_s^2),

stepped by RK4. No code in common with what is tested.
"""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numba
import numpy as np

from gap_benchmark.mechanism import quaternion, rotation

G, STEP = 9.81, 5e-5  # [m/s2], [s]
BLOCK, TABLE, TIP = "block.block", "table.table", "tip.tip"


@dataclass(frozen=True)
class World:
    """half (3,) of the box [m]; foot, radius of the feet [m]; patch: (mu, x0, x1, y0,
    y1) of the table; com (3,) in the block's frame, which is at the box's middle."""

    half: tuple[float, float, float]
    mass: float
    friction: float  # Feet and table.
    foot: float = 0.006
    tip_radius: float = 0.012
    tip_mass: float = 0.6
    tip_friction: float = 0.2  # Tip and box.
    tip_height: float = 0.03
    kp: float = 4000.0
    kd: float = 150.0
    stiffness: float = 4e4  # [N/m] of a foot, and of the tip.
    dissipation: float = 2.0  # [s/m]
    roll: float = 0.0
    pitch: float = 0.0
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    patch: tuple[float, ...] = ()
    rail: float = 0.0  # [N] dry friction of the tip's joints.
    hidden: tuple[dict, ...] = field(default=(), compare=False)

    @property
    def feet(self) -> np.ndarray:
        """(4, 3) centres in the block's frame; they reach below the box."""
        x, y, z = self.half
        return np.array([(a * (x - self.foot), b * (y - self.foot), -z)
                         for a in (-1, 1) for b in (-1, 1)])  # fmt: skip

    @property
    def inertia(self) -> np.ndarray:
        x, y, z = self.half
        return self.mass / 3.0 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])


def a_world(rng) -> World:
    half = (rng.uniform(0.05, 0.09), rng.uniform(0.04, 0.07), rng.uniform(0.03, 0.045))
    return World(
        half, rng.uniform(0.5, 1.6), rng.uniform(0.2, 0.45),
        tip_height=half[2] * rng.uniform(0.7, 1.0),
        tip_friction=rng.uniform(0.1, 0.3), kp=rng.uniform(2500.0, 5000.0),
        kd=rng.uniform(80.0, 200.0), tip_mass=rng.uniform(0.4, 1.0),
    )  # fmt: skip


def with_hidden(world: World, kinds, rng, sign: float | None = None) -> World:
    """The truth, of which `world` is what the scene says."""
    found = []
    pair = f"{BLOCK}~{TABLE}"
    for kind in kinds:
        up = rng.choice([-1.0, 1.0]) if sign is None else sign
        at: str = BLOCK
        if kind == "contact_friction":
            value = world.friction * (1.0 + up * rng.uniform(0.2, 0.45))
            world, at, p = replace(world, friction=value), pair, {"friction": value}
        elif kind == "tip_friction":
            value = world.tip_friction * (1.0 + up * rng.uniform(0.5, 0.9))
            world = replace(world, tip_friction=value)
            kind, at, p = "contact_friction", f"{BLOCK}~tip.tip", {"friction": value}
        elif kind == "object_mass":
            value = world.mass * (1.0 + up * rng.uniform(0.15, 0.35))
            world, p = replace(world, mass=value), {"mass": value}
        elif kind == "plane_tilt":
            angle = rng.uniform(0.6, 2.0, 2) * np.pi / 180.0
            roll, pitch = angle * rng.choice([-1.0, 1.0], 2)
            world = replace(world, roll=float(roll), pitch=float(pitch))
            at, p = TABLE, {"roll": float(roll), "pitch": float(pitch)}
        elif kind == "object_com":
            com = np.array([rng.uniform(0.15, 0.3) * h * rng.choice([-1.0, 1.0])
                            for h in world.half])  # fmt: skip
            world = replace(world, com=tuple(map(float, com)))
            p = dict(zip("xyz", map(float, com), strict=True))
        elif kind == "friction_patch":
            size = np.array(world.half[:2])  # Half as large as the block.
            centre = rng.uniform(-0.05, 0.05, 2)
            lo, hi = centre - 0.5 * size, centre + 0.5 * size
            value = world.friction * (1.0 + up * rng.uniform(0.5, 0.8))
            sides = (lo[0], hi[0], lo[1], hi[1])
            world = replace(world, patch=(value, *map(float, sides)))
            names = ("x_min", "x_max", "y_min", "y_max")
            p = {"friction": value} | dict(zip(names, map(float, sides), strict=True))
            at = pair
        else:
            raise ValueError(f"no law for {kind}")
        found.append({"kind": kind, "at": at, "parameters": p})
    return replace(world, hidden=tuple(found))


@numba.njit(cache=True)
def _contact(k, d, mu, depth, n, u, slip):
    """Force (3,) on a body whose point moves with u (3,) against a fixed one."""
    un = u[0] * n[0] + u[1] * n[1] + u[2] * n[2]
    fn = max(k * depth * (1.0 - d * un), 0.0)
    ut = u - un * n
    speed = np.sqrt(ut[0] ** 2 + ut[1] ** 2 + ut[2] ** 2 + slip * slip)
    return fn * n - mu * fn / speed * ut


@numba.njit(cache=True)
def _cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
                     a[0] * b[1] - a[1] * b[0]])  # fmt: skip


@numba.njit(cache=True)
def _rate(s, command, feet, half, inertia, com, n, p, dx, force_on_tip):
    """State: block's com p (3), q (4), v (3), w in body (3); tip x y, vx vy.

    p: mass, mu, foot, k, d, tip: radius, mass, mu, height, kp, kd, patch 5, rail."""
    mass, mu, foot, k, d = p[0], p[1], p[2], p[3], p[4]
    radius, tip_mass, tip_mu, height, kp, kd = p[5], p[6], p[7], p[8], p[9], p[10]
    qw, qx, qy, qz = s[3], s[4], s[5], s[6]
    R = rotation(s[3:7])
    v, wb = s[7:10], s[10:13]
    w = np.zeros(3)
    for i in range(3):
        for j in range(3):
            w[i] += R[i, j] * wb[j]
    force, torque = np.zeros(3), np.zeros(3)
    force[2] = -mass * 9.81
    for i in range(len(feet)):
        a = np.zeros(3)
        for j in range(3):
            for m in range(3):
                a[j] += R[j, m] * (feet[i, m] - com[m])
        c = s[0:3] + a
        depth = foot - (n[0] * c[0] + n[1] * c[1] + n[2] * c[2])
        if depth <= 0.0:
            continue
        a = a - (foot - 0.5 * depth) * n
        u = v + _cross(w, a)
        here = mu
        if p[12] < c[0] < p[13] and p[14] < c[1] < p[15]:
            here = p[11]
        f = _contact(k, d, here, depth, n, u, 4e-4)
        force += f
        torque += _cross(a, f)
    # The tip, in the box's frame.
    at = np.array([s[13], s[14], height])
    rel = np.zeros(3)
    for j in range(3):
        for m in range(3):
            rel[j] += R[m, j] * (at[m] - s[m])
    rel += com  # From the box's middle.
    near = np.minimum(np.maximum(rel, -half), half)
    off = rel - near
    gap = np.sqrt(off[0] ** 2 + off[1] ** 2 + off[2] ** 2)
    force_on_tip[:] = 0.0
    if 0.0 < gap < radius:
        out = np.zeros(3)  # From the box to the tip, in world.
        arm = np.zeros(3)
        for j in range(3):
            for m in range(3):
                out[j] += R[j, m] * off[m] / gap
                arm[j] += R[j, m] * (near[m] - com[m])
        u = np.array([s[15], s[16], 0.0]) - (v + _cross(w, arm))
        f = _contact(k, d, tip_mu, radius - gap, out, u, 4e-4)
        force_on_tip[:] = f
        force -= f
        torque -= _cross(arm, f)
    dx[0:3] = v
    dx[3] = 0.5 * (-qx * wb[0] - qy * wb[1] - qz * wb[2])
    dx[4] = 0.5 * (qw * wb[0] + qy * wb[2] - qz * wb[1])
    dx[5] = 0.5 * (qw * wb[1] + qz * wb[0] - qx * wb[2])
    dx[6] = 0.5 * (qw * wb[2] + qx * wb[1] - qy * wb[0])
    dx[7:10] = force / mass
    for i in range(3):
        tb = R[0, i] * torque[0] + R[1, i] * torque[1] + R[2, i] * torque[2]
        j, m = (i + 1) % 3, (i + 2) % 3
        dx[10 + i] = (tb + (inertia[j] - inertia[m]) * wb[j] * wb[m]) / inertia[i]
    for i in range(2):
        u = kp * (command[i] - s[13 + i]) + kd * (command[2 + i] - s[15 + i])
        u -= p[16] * np.tanh(s[15 + i] / 1e-3)
        dx[13 + i] = s[15 + i]
        dx[15 + i] = (u + force_on_tip[i]) / tip_mass


@numba.njit(cache=True)
def _run(s, times, commands, step, feet, half, inertia, com, n, p):
    out, forces = np.empty((len(times), 17)), np.zeros((len(times), 3))
    k1, k2, k3, k4 = np.empty(17), np.empty(17), np.empty(17), np.empty(17)
    f = np.zeros(3)
    for i in range(len(times)):
        _rate(s, commands[i], feet, half, inertia, com, n, p, k1, f)
        out[i], forces[i] = s, f
        if i + 1 == len(times):
            break
        count = max(int(np.ceil((times[i + 1] - times[i]) / step)), 1)
        h = (times[i + 1] - times[i]) / count
        for _ in range(count):
            c = commands[i]
            _rate(s, c, feet, half, inertia, com, n, p, k1, f)
            _rate(s + h / 2 * k1, c, feet, half, inertia, com, n, p, k2, f)
            _rate(s + h / 2 * k2, c, feet, half, inertia, com, n, p, k3, f)
            _rate(s + h * k3, c, feet, half, inertia, com, n, p, k4, f)
            s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            s[3:7] /= np.sqrt(np.sum(s[3:7] ** 2))
    return out, forces


def simulate(world: World, start, times, commands, step=STEP):
    """start (13,) origin p, q wxyz, and the tip's x, y at [13:15] of (15,), all at
    rest. commands (n, 4): x, y and their rates, held.

    Returns: (n, 7) the block's origin and q; (n, 4) tip x y vx vy; (n, 3) force on the
    tip [N].
    """
    com = np.array(world.com)
    R = rotation(start[3:7])
    s = np.zeros(17)
    s[:7] = start[:7]
    s[:3] += R @ com
    s[13:15] = start[7:9]
    patch = world.patch or (0.0, 1.0, 0.0, 1.0, 0.0)
    p = np.array([
        world.mass, world.friction, world.foot, world.stiffness, world.dissipation,
        world.tip_radius, world.tip_mass, world.tip_friction, world.tip_height,
        world.kp, world.kd, *patch, world.rail,
    ])  # fmt: skip
    n = rotation(quaternion((world.roll, world.pitch, 0.0)))[:, 2]
    x, f = _run(s, np.asarray(times, float), np.asarray(commands, float), step,
                world.feet, np.array(world.half), world.inertia, com, n, p)  # fmt: skip
    block = x[:, :7].copy()
    for row in block:
        row[:3] -= rotation(row[3:7]) @ com
    return block, x[:, 13:], f


def _path(rng, seconds: float, rate: float):
    """(n,) times, way [m] and speed along it: rest, then forward at a speed that
    changes and comes to rest, twice."""
    t = np.arange(int(seconds * rate)) / rate
    fine = np.arange(int(seconds * 2000) + 1) / 2000
    v = np.zeros(len(fine))
    begin = 0.15
    for length in rng.uniform(0.4, 0.6) * seconds, seconds:
        end = length - 0.15
        s = np.clip((fine - begin) / (end - begin), 0.0, 1.0)
        top = rng.uniform(0.08, 0.2)
        ripple = 1.0 + rng.uniform(0.2, 0.5) * np.sin(
            2 * np.pi * rng.uniform(1.0, 2.0) * fine + rng.uniform(0, 2 * np.pi)
        )
        inside = (fine >= begin) & (fine < end)
        v += np.where(inside, top * np.sin(np.pi * s) ** 0.7 * ripple, 0.0)
        begin = length + 0.1
    way = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) / 2000)])
    return t, np.interp(t, fine, way), np.interp(t, fine, v)


def record(truth: World, rng, episodes=10, seconds=2.6, rate=250.0, camera=125.0,
           place=3e-4, turn=1.5e-3, wrench=True, encoder=1e-5):  # fmt: skip
    """A table {column: (n,)} and {channel: noise} of what would be recorded."""
    tables = []
    n_hat = rotation(quaternion((truth.roll, truth.pitch, 0.0)))[:, 2]
    for number in range(episodes):
        t, way, speed = _path(rng, seconds, rate)
        yaw = rng.uniform(-np.pi, np.pi)
        face = rng.integers(4)
        angle = yaw + 0.5 * np.pi * face
        half = truth.half[face % 2]
        across = truth.half[1 - face % 2]
        # It is pushed through the middle of where patches are.
        heading = np.array([np.cos(angle + np.pi), np.sin(angle + np.pi)])
        middle = -0.5 * way[-1] * heading + rng.uniform(-0.02, 0.02, 2)
        beside = rng.uniform(-0.3, 0.3) * across
        aside = np.array([-heading[1], heading[0]])
        gap = rng.uniform(0.004, 0.012)
        from_here = middle - heading * (half + truth.tip_radius + gap) + beside * aside
        q_tilt = quaternion((truth.roll, truth.pitch, 0.0))
        flat = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        w, x = q_tilt[0], q_tilt[1:]
        vector = w * flat[1:] + flat[0] * x + np.cross(x, flat[1:])
        q = np.concatenate([[w * flat[0] - x @ flat[1:]], vector])
        sink = truth.mass * G / 4.0 / truth.stiffness
        up = truth.half[2] + truth.foot - sink
        p = np.array([*middle, 0.0])
        p[2] = -(p[:2] @ n_hat[:2]) / n_hat[2]
        commands = np.column_stack([from_here + way[:, None] * heading,
                                    speed[:, None] * heading])  # fmt: skip
        start = np.concatenate([p + up * n_hat, q, from_here])
        block, tip, force = simulate(truth, start, t, commands)
        table = {"time": t, "episode": np.full(len(t), number)}
        for i, axis in enumerate("xy"):
            joint = f"tip.{axis}"
            table[f"{joint}.position"] = tip[:, i] + encoder * rng.normal(size=len(t))
            table[f"{joint}.velocity"] = tip[:, 2 + i] + 2e-3 * rng.normal(size=len(t))
            table[f"{joint}.position_command"] = commands[:, i]
            table[f"{joint}.velocity_command"] = commands[:, 2 + i]
        seen = np.arange(len(t)) % max(round(rate / camera), 1) == 0
        for i, axis in enumerate("xyz"):
            y = block[:, i] + place * rng.normal(size=len(t))
            table[f"{BLOCK}.{axis}"] = np.where(seen, y, np.nan)
        half_turn = 0.5 * turn * rng.normal(size=(len(t), 3))
        w, x = block[:, 3:4], block[:, 4:7]
        vector = x + w * half_turn + np.cross(half_turn, x)
        turned = np.column_stack([w[:, 0] - np.sum(half_turn * x, axis=1), vector])
        turned /= np.linalg.norm(turned, axis=1)[:, None]
        for i, axis in enumerate("wxyz"):
            table[f"{BLOCK}.q{axis}"] = np.where(seen, turned[:, i], np.nan)
        if wrench:
            for i, axis in enumerate("xyz"):
                table[f"{TIP}.f{axis}"] = force[:, i] + 0.05 * rng.normal(size=len(t))
        tables.append(table)
    table = {k: np.concatenate([e[k] for e in tables]) for k in tables[0]}
    noise = {f"tip.{a}.position": encoder for a in "xy"}
    noise |= {f"tip.{a}.velocity": 2e-3 for a in "xy"}
    noise |= {f"{BLOCK}.{a}": place for a in "xyz"}
    noise |= {f"{BLOCK}.q{a}": 0.5 * turn for a in "wxyz"}
    if wrench:
        noise |= {f"{TIP}.f{a}": 0.05 for a in "xyz"}
    return table, noise


def write_table(folder: Path, table, noise=None) -> None:
    """recording.csv and, where it is known, noise.json; the folder is made."""
    folder.mkdir(parents=True, exist_ok=True)
    names = list(table)
    np.savetxt(
        folder / "recording.csv", np.column_stack([table[n] for n in names]),
        delimiter=",", header=",".join(names), comments="", fmt="%.10g",
    )  # fmt: skip
    if noise is not None:
        (folder / "noise.json").write_text(json.dumps(noise))


def write(folder: Path, world: World, table, noise=None, step=0.0005) -> Path:
    """The scene as `world` has it, with its models, and the recording beside it."""
    write_table(folder, table, noise)
    (folder / "block.sdf").write_text(_block(world))
    (folder / "table.sdf").write_text(_model(
        "table", '<collision name="top"><pose>0 0 -0.25 0 0 0</pose><geometry><box>'
        f"<size>4 4 0.5</size></box></geometry>{_surface(world.friction, world)}"
        "</collision>",
    ))  # fmt: skip
    (folder / "tip.sdf").write_text(_tip(world))
    w = world
    (folder / "scene.yaml").write_text(
        "directives:\n"
        "  - add_model: {name: table, file: table.sdf}\n"
        "  - add_weld: {parent: world, child: table::table}\n"
        "  - add_model: {name: block, file: block.sdf}\n"
        "  - add_model: {name: tip, file: tip.sdf}\n"
        "  - add_weld: {parent: world, child: tip::base}\n"
        f"plant:\n  time_step: {step}\n  contact_model: point\n"
        "  discrete_contact_approximation: lagged\n  gravity: [0, 0, -9.81]\n"
        f"actuation:\n  type: pd\n  joints: [tip.x, tip.y]\n  kp: [{w.kp!r}]\n"
        f"  kd: [{w.kd!r}]\n  hold: zero_order\n  rate_hz: 250\n"
        f"initial:\n  poses:\n    {BLOCK}: [1, 0, 0, 0, 0.3, 0, "
        f"{w.half[2] + w.foot!r}]\n"
        "tolerance:\n  contact_stiffness: 0.1\n  contact_dissipation: 0.5\n"
        "effects: []\n"
    )
    return folder / "scene.yaml"


def _block(w: World) -> str:
    i = w.inertia
    feet = "".join(
        f'<collision name="foot{k}"><pose>{c[0]!r} {c[1]!r} {c[2]!r} 0 0 0</pose>'
        f"<geometry><sphere><radius>{w.foot}</radius></sphere></geometry>"
        f"{_surface(w.friction, w)}</collision>".replace("np.float64", "")
        for k, c in enumerate(w.feet.tolist())
    )
    box = (
        '<collision name="box"><geometry><box><size>'
        f"{2 * w.half[0]!r} {2 * w.half[1]!r} {2 * w.half[2]!r}</size></box></geometry>"
        f"{_surface(w.tip_friction, w)}</collision>"
    )
    return _model(
        "block",
        f"<inertial><mass>{w.mass!r}</mass><inertia><ixx>{float(i[0])!r}</ixx><iyy>"
        f"{float(i[1])!r}</iyy><izz>{float(i[2])!r}</izz></inertia></inertial>"
        f"{box}{feet}",
    )


def _tip(w: World) -> str:
    def link(name, mass, more="", z=0.0):
        return (
            f'<link name="{name}"><pose>0 0 {z!r} 0 0 0</pose><inertial><mass>{mass!r}'
            "</mass><inertia><ixx>1e-4</ixx><iyy>1e-4</iyy><izz>1e-4</izz></inertia>"
            f"</inertial>{more}</link>"
        )

    shape = (
        '<collision name="ball"><geometry><sphere><radius>'
        f"{w.tip_radius!r}</radius></sphere></geometry>{_surface(w.tip_friction, w)}"
        "</collision>"
    )

    def joint(name, parent, child, axis):
        return (
            f'<joint name="{name}" type="prismatic"><parent>{parent}</parent><child>'
            f"{child}</child><axis><xyz>{axis}</xyz><limit><lower>-2</lower><upper>2"
            "</upper><effort>1000</effort></limit></axis></joint>"
        )

    # All of the mass is at the tip, so that both joints carry the same.
    return (
        '<?xml version="1.0"?>\n<sdf version="1.9" xmlns:drake="http://drake.mit.edu">'
        '<model name="tip"><link name="base"/>'
        + link("cart", 1e-6, z=w.tip_height)
        + link("tip", w.tip_mass, shape, w.tip_height)
        + joint("x", "base", "cart", "1 0 0") + joint("y", "cart", "tip", "0 1 0")
        + "</model></sdf>\n"
    )  # fmt: skip


def _surface(friction: float, w: World) -> str:
    """Two alike are a pair of this friction and dissipation, stiffnesses in a row."""
    return (
        f"<drake:proximity_properties><drake:mu_static>{friction!r}</drake:mu_static>"
        f"<drake:mu_dynamic>{friction!r}</drake:mu_dynamic>"
        f"<drake:point_contact_stiffness>{2 * w.stiffness!r}"
        "</drake:point_contact_stiffness><drake:hunt_crossley_dissipation>"
        f"{w.dissipation!r}</drake:hunt_crossley_dissipation>"
        "</drake:proximity_properties>"
    )


def _model(name: str, inside: str) -> str:
    return (
        '<?xml version="1.0"?>\n<sdf version="1.9" xmlns:drake="http://drake.mit.edu">'
        f'<model name="{name}"><link name="{name}">{inside}</link></model></sdf>\n'
    )

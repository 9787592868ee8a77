"""A cart on a rail that runs against a wall at each end: by an ODE of our own.

    m x'' = u - coulomb tanh(x'/1e-3) - b x' + f_left - f_right,
    f = k depth (1 + d depth_rate)+; with a linear damper (k depth + c depth_rate)+,

stepped by RK4 at 10 us; commands of effort hold between rows.
"""

from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np

from gap_benchmark.push_world import write_table

STEP = 1e-5  # [s]
PAIR = "cart.cart~wall.wall"


@dataclass(frozen=True)
class Cart:
    mass: float = 1.2
    half: float = 0.05  # Of the cart, along the rail [m].
    reach: float = 0.25  # From the middle to each wall's face [m].
    stiffness: float = 2e4  # [N/m] of cart and wall together.
    dissipation: float = 0.6  # [s/m]
    coulomb: float = 0.0  # [N]
    damping: float = 0.3  # [N s/m]
    damper: float | None = None  # [N s/m] In the place of the dissipation.


@numba.njit(cache=True)
def _run(x, v, times, u, step, m, gap, k, d, c, coulomb, damping):
    out = np.empty((len(times), 2))
    for i in range(len(times)):
        out[i, 0], out[i, 1] = x, v
        if i + 1 == len(times):
            break
        n = max(int(np.ceil((times[i + 1] - times[i]) / step)), 1)
        h = (times[i + 1] - times[i]) / n
        for _ in range(n):
            a1 = a2 = a3 = a4 = 0.0
            x1, v1 = x, v
            for stage in range(4):
                f = u[i] - coulomb * np.tanh(v1 / 1e-3) - damping * v1
                right, left = x1 - gap, -gap - x1
                if right > 0.0:
                    f -= max(k * right * (1.0 + d * v1) + c * v1, 0.0)
                if left > 0.0:
                    f += max(k * left * (1.0 - d * v1) - c * v1, 0.0)
                a = f / m
                if stage == 0:
                    a1 = a
                    x1, v1 = x + 0.5 * h * v, v + 0.5 * h * a1
                elif stage == 1:
                    a2, w2 = a, v1
                    x1, v1 = x + 0.5 * h * v1, v + 0.5 * h * a2
                elif stage == 2:
                    a3, w3 = a, v1
                    x1, v1 = x + h * v1, v + h * a3
                else:
                    a4, w4 = a, v1
            x += h / 6.0 * (v + 2.0 * w2 + 2.0 * w3 + w4)
            v += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    return out


def record(cart: Cart, rng, seconds=16.0, rate=500.0, encoder=1e-5, wave=0.0):
    """A table {column: (n,)} and noise: the cart is driven to and fro, against both
    walls at several speeds, and by a wave of 5 Hz [N] besides."""
    t = np.arange(int(seconds * rate)) / rate
    u, x, v = np.zeros(len(t)), 0.0, 0.0
    out = np.empty((len(t), 2))
    side, push = 1.0, rng.uniform(1.5, 4.0)
    gap = cart.reach - cart.half
    law = (cart.dissipation, 0.0) if cart.damper is None else (0.0, cart.damper)
    for i in range(len(t)):
        out[i] = x, v
        # A simple controller: push to one side until a while after the wall was met.
        if side * x > gap - 0.01 and side * v < -0.02:
            side, push = -side, rng.uniform(1.5, 4.0)
        u[i] = side * push - 2.0 * v + wave * np.sin(10.0 * np.pi * t[i])
        if i + 1 < len(t):
            row = _run(
                x, v, t[i : i + 2], u[i : i + 2], STEP, cart.mass, gap, cart.stiffness,
                *law, cart.coulomb, cart.damping,
            )[-1]  # fmt: skip
            x, v = float(row[0]), float(row[1])
    table = {
        "time": t,
        "cart.rail.position": out[:, 0] + encoder * rng.normal(size=len(t)),
        "cart.rail.velocity": out[:, 1] + 2e-3 * rng.normal(size=len(t)),
        "cart.rail.effort_command": u,
    }
    return table, {"cart.rail.position": encoder, "cart.rail.velocity": 2e-3}


def write(folder: Path, cart: Cart, table, noise) -> Path:
    """The scene as `cart` has it, and the recording."""
    write_table(folder, table, noise)
    surface = (
        "<drake:proximity_properties><drake:mu_static>0</drake:mu_static>"
        "<drake:mu_dynamic>0</drake:mu_dynamic><drake:point_contact_stiffness>"
        f"{2 * cart.stiffness!r}</drake:point_contact_stiffness>"
        f"<drake:hunt_crossley_dissipation>{cart.dissipation!r}"
        "</drake:hunt_crossley_dissipation></drake:proximity_properties>"
    )
    # A ball at each end, so that it is met at one point.
    r = 0.02
    balls = "".join(
        f'<collision name="b{k}"><pose>{s * (cart.half - r)!r} 0 0 0 0 0</pose>'
        f"<geometry><sphere><radius>{r}</radius></sphere></geometry>{surface}"
        "</collision>"
        for k, s in enumerate((-1, 1))
    )
    boxes = "".join(
        f'<collision name="w{k}"><pose>{s * (cart.reach + 0.1)!r} 0 0 0 0 0</pose>'
        f"<geometry><box><size>0.2 0.4 0.4</size></box></geometry>{surface}</collision>"
        for k, s in enumerate((-1, 1))
    )
    head = (
        '<?xml version="1.0"?>\n<sdf version="1.9" xmlns:drake="http://drake.mit.edu">'
    )
    (folder / "cart.sdf").write_text(
        f'{head}<model name="cart"><link name="base"/><link name="cart"><inertial>'
        "<mass>"
        f"{cart.mass!r}</mass><inertia><ixx>1e-3</ixx><iyy>1e-3</iyy><izz>1e-3</izz>"
        f'</inertia></inertial>{balls}</link><joint name="rail" type="prismatic">'
        "<parent>base</parent><child>cart</child><axis><xyz>1 0 0</xyz><dynamics>"
        f"<damping>{cart.damping!r}</damping></dynamics><limit><lower>-2</lower><upper>2"
        "</upper><effort>100</effort></limit></axis></joint></model></sdf>\n"
    )
    (folder / "wall.sdf").write_text(
        f'{head}<model name="wall"><link name="wall">{boxes}</link></model></sdf>\n'
    )
    (folder / "scene.yaml").write_text(
        "directives:\n"
        "  - add_model: {name: wall, file: wall.sdf}\n"
        "  - add_weld: {parent: world, child: wall::wall}\n"
        "  - add_model: {name: cart, file: cart.sdf}\n"
        "  - add_weld: {parent: world, child: cart::base}\n"
        "plant:\n  time_step: 0.0005\n  contact_model: point\n"
        "  discrete_contact_approximation: lagged\n  gravity: [0, 0, -9.81]\n"
        "actuation:\n  type: effort\n  joints: [cart.rail]\n  hold: zero_order\n"
        "  rate_hz: 500\ntolerance:\n  link_mass: 0.01\neffects: []\n"
    )
    return folder / "scene.yaml"

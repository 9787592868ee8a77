"""Fruits to roll: nearly round, bumpy and a little soft, generated from a seed.

The surface is the outer envelope of many spheres that are a little smaller than the
fruit. Their outermost points lie within 3 % of the radius of a sphere (for a lime: of
an ellipsoid), which makes bumps and dents.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

N_SPHERES = 48
SPHERE = 0.8  # Radius of a sphere over the fruit's.


@dataclass(frozen=True)
class FruitKind:
    radius: float  # Mean, across the long axis [m].
    elongation: float  # Length of the long axis over the others.
    bump: float  # Largest height of bumps and depth of dents over the radius.
    density: float  # [kg/m3]
    stiffness: float  # Of a point contact [N/m].
    dissipation: float  # Hunt-Crossley [s/m].
    rolling_resistance: float  # Lever arm over radius.
    color: tuple[float, float, float]
    hue: float  # [rad] of that colour, for a camera.


FRUITS = {
    "orange": FruitKind(
        0.037, 1.0, 0.03, 950.0, 2e4, 2.0, 0.01, (0.95, 0.4, 0.05), 0.41
    ),
    "lime": FruitKind(0.027, 1.12, 0.03, 950.0, 2e4, 2.0, 0.01, (0.3, 0.8, 0.05), 1.8),
}


@dataclass(frozen=True, eq=False)
class Fruit:
    kind: FruitKind
    centers: np.ndarray  # (n, 3) [m] in the fruit's frame; x is the long axis.
    radii: np.ndarray  # (n,) [m]
    mass: float  # [kg]

    @property
    def mean_radius(self) -> float:
        """Radius of the sphere with the same volume, without bumps [m]."""
        return self.kind.radius * self.kind.elongation ** (1.0 / 3.0)


def make_fruit(name: str, seed: int) -> Fruit:
    """The fruit of that name and seed. Raises: ValueError for an unknown name."""
    if name not in FRUITS:
        raise ValueError(f"object is {name}, expected {' or '.join(FRUITS)}")
    kind = FRUITS[name]
    rng = np.random.default_rng([seed, 2])
    # Directions evenly over the sphere: a Fibonacci lattice, randomly rotated.
    i = np.arange(N_SPHERES) + 0.5
    z, angle = 1.0 - 2.0 * i / N_SPHERES, np.pi * (1.0 + 5.0**0.5) * i
    ring = np.sqrt(1.0 - z**2)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    directions = directions @ turn
    height = 1.0 + rng.uniform(-kind.bump, kind.bump, N_SPHERES)
    sphere = SPHERE * kind.radius
    stretch = np.array([kind.elongation, 1.0, 1.0])
    normals = directions / stretch
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    surface = kind.radius * directions * stretch * height[:, None]
    volume = 4.0 / 3.0 * np.pi * kind.radius**3 * kind.elongation
    return Fruit(
        kind,
        surface - sphere * normals,
        np.full(N_SPHERES, sphere),
        kind.density * volume,
    )


def fruit_sdf(fruit: Fruit) -> str:
    """The fruit as a model `ball` with the body `ball`, in SDFormat."""
    k = fruit.kind
    a, b = k.radius * k.elongation, k.radius
    inertia = [fruit.mass / 5.0 * s for s in (2 * b * b, a * a + b * b, a * a + b * b)]
    shapes = []
    for i, (p, r) in enumerate(zip(fruit.centers, fruit.radii, strict=True)):
        pose = " ".join(f"{x:.9g}" for x in p)
        shape = (
            f"<pose>{pose} 0 0 0</pose><geometry><sphere><radius>{r:.9g}</radius>"
            "</sphere></geometry>"
        )
        color = " ".join(map(str, k.color))
        shapes.append(
            f'<visual name="v{i}">{shape}<material><diffuse>{color} 1</diffuse>'
            f'</material></visual><collision name="c{i}">{shape}'
            "<drake:proximity_properties><drake:mu_static>1</drake:mu_static>"
            "<drake:mu_dynamic>1</drake:mu_dynamic>"
            f"<drake:point_contact_stiffness>{k.stiffness:g}"
            "</drake:point_contact_stiffness>"
            f"<drake:hunt_crossley_dissipation>{k.dissipation:g}"
            "</drake:hunt_crossley_dissipation></drake:proximity_properties>"
            "</collision>"
        )
    return (
        '<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="ball">'
        f'<link name="ball"><inertial><mass>{fruit.mass:.9g}</mass><inertia>'
        f"<ixx>{inertia[0]:.9g}</ixx><iyy>{inertia[1]:.9g}</iyy>"
        f"<izz>{inertia[2]:.9g}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia>"
        f"</inertial>{''.join(shapes)}</link></model></sdf>"
    )


@cache
def _folder() -> TemporaryDirectory:
    return TemporaryDirectory(prefix="makebreak-fruit-")


@cache
def fruit_file(name: str, seed: int) -> str:
    """Path of a temporary file of fruit_sdf, deleted when this process ends."""
    path = Path(_folder().name) / f"{name}-{seed}.sdf"
    path.write_text(fruit_sdf(make_fruit(name, seed)))
    return str(path)

"""Scene and recording of measured tosses of a cube, from their npz, and the judge.

    python tests/measured/cube_tosses.py DATA.npz OUT
    makebreak gap OUT/scene.yaml OUT/fit.csv --out OUT/gap
    python tests/measured/cube_tosses.py DATA.npz OUT --judge OUT/gap/scene.yaml

The first writes scene.yaml with the published values and no effects, and fit.csv of 40
tosses: time and poses alone, as the velocities of the data are filtered differences.
The last simulates 200 others in Drake, from states fitted to their free flight, and
prints the rms over the 8 corners and the first 100 ms after touch, each error capped at
60 mm, of the published scene and of the one given.
"""

import argparse
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

HALF, MASS, INERTIA, FRICTION = 0.0524, 0.37, 0.00081, 0.18
STIFFNESS, DISSIPATION, RADIUS = 1e5, 50.0, 0.001
RATE = 148.29  # [Hz] What velocities and positions of the files give; 148 is stated.
N_FIT, N_JUDGED = 40, 200
AFTER_SEC, CAP = 0.1, 0.06
FEWEST = 8  # Samples of free flight.
CORNERS = HALF * np.array(list(product((-1.0, 1.0), repeat=3)))
NAME = "cube.cube"
POSE = [f"{NAME}.{k}" for k in ("qw", "qx", "qy", "qz", "x", "y", "z")]


def tosses(data: Path):
    """Time (n,), quaternions wxyz (n, 4), positions (n, 3) of each toss."""
    d = np.load(data)
    for first, n in zip(d["toss_start"], d["toss_len"], strict=True):
        rows = slice(int(first), int(first + n))
        q = np.array(d["q_WB_wxyz"][rows], float)
        sign = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0)
        q[1:] *= np.cumprod(sign)[:, None]
        yield np.arange(n) / RATE, q, np.array(d["p_WB"][rows], float)


def corners(q, p) -> np.ndarray:
    """(n, 8, 3) [m]"""
    R = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()
    return p[:, None] + np.einsum("nij,kj->nki", R, CORNERS)


def touch_row(q, p) -> int:
    """The first sample at which a corner is at the board's nominal height."""
    return int(np.argmax(corners(q, p)[:, :, 2].min(axis=1) <= 0.0))


def split(data: Path) -> tuple[list[int], list[int]]:
    """Which tosses are for the fit, and which are judged: drawn once, of those with
    enough free flight to tell a start."""
    good = [i for i, (_, q, p) in enumerate(tosses(data)) if touch_row(q, p) >= FEWEST]
    drawn = np.random.default_rng(0).permutation(good)
    return sorted(drawn[:N_FIT].tolist()), sorted(
        drawn[N_FIT : N_FIT + N_JUDGED].tolist()
    )


def _surface() -> str:
    return (
        f"<drake:proximity_properties><drake:mu_static>{FRICTION}</drake:mu_static>"
        f"<drake:mu_dynamic>{FRICTION}</drake:mu_dynamic>"
        f"<drake:point_contact_stiffness>{2 * STIFFNESS}"
        f"</drake:point_contact_stiffness><drake:hunt_crossley_dissipation>{DISSIPATION}"
        "</drake:hunt_crossley_dissipation></drake:proximity_properties>"
    )


def _model(name: str, inside: str) -> str:
    return (
        '<?xml version="1.0"?>\n<sdf version="1.9" xmlns:drake="drake.mit.edu">'
        f'<model name="{name}"><link name="{name}">{inside}</link></model></sdf>\n'
    )


def convert(data: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    inner = CORNERS * (1.0 - RADIUS / HALF)
    shapes = "".join(
        f'<collision name="s{i}"><pose>{x:.9g} {y:.9g} {z:.9g} 0 0 0</pose><geometry>'
        f"<sphere><radius>{RADIUS}</radius></sphere></geometry>{_surface()}</collision>"
        for i, (x, y, z) in enumerate(inner)
    )
    moments = "".join(
        f"<{k}>{INERTIA if k[1] == k[2] else 0}</{k}>"
        for k in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    size = f"{2 * HALF} {2 * HALF} {2 * HALF}"
    (out / "cube.sdf").write_text(
        _model(
            "cube",
            f"<inertial><mass>{MASS}</mass><inertia>{moments}</inertia></inertial>"
            f'<visual name="seen"><geometry><box><size>{size}</size></box></geometry>'
            f"</visual>{shapes}",
        )
    )
    (out / "board.sdf").write_text(
        _model(
            "board",
            '<collision name="top"><pose>0 0 -0.25 0 0 0</pose><geometry><box>'
            f"<size>4 4 0.5</size></box></geometry>{_surface()}</collision>",
        )
    )
    (out / "scene.yaml").write_text(
        "directives:\n  - add_model: {name: board, file: board.sdf}\n"
        "  - add_weld: {parent: world, child: board::board}\n"
        "  - add_model: {name: cube, file: cube.sdf}\n"
        "plant:\n  time_step: 0.0002\n  contact_model: point\n"
        "  discrete_contact_approximation: lagged\n  gravity: [0, 0, -9.81]\n"
        "actuation: {type: none}\n"
        f"initial: {{poses: {{{NAME}: [1, 0, 0, 0, 0, 0, 0.3]}}}}\neffects: []\n"
    )
    fit, _ = split(data)
    rows = []
    for number, (t, q, p) in enumerate(tosses(data)):
        if number in fit:
            episode = np.full(len(t), number)
            rows.append(np.column_stack([t, episode, q, p]))
    header = ",".join(["time", "episode", *POSE])
    np.savetxt(
        out / "fit.csv", np.concatenate(rows), delimiter=",", header=header,
        comments="", fmt="%.9g",
    )  # fmt: skip


def start_of(t, q, p):
    """Pose (7,) and velocity (6,: world) at the first sample, of a parabola through the
    positions and a steady turn through the orientations of free flight."""
    place = np.polynomial.polynomial.polyfit(t, p, 2)
    first = Rotation.from_quat(q[0, [1, 2, 3, 0]])
    turned = (Rotation.from_quat(q[:, [1, 2, 3, 0]]) * first.inv()).as_rotvec()
    spin = np.polynomial.polynomial.polyfit(t, turned, 1)
    x, y, z, w = (Rotation.from_rotvec(spin[0]) * first).as_quat()
    return [w, x, y, z, *place[0]], [*spin[1], *place[1]]


def judge(data: Path, scene_file: Path) -> float:
    """Rms [m] over all judged tosses."""
    from makebreak.gap.simulation.scene_simulation import SceneSimulation
    from makebreak.models.scene import InitialSection, read_scene

    simulation = SceneSimulation(read_scene(scene_file))
    _, judged = split(data)
    squares = []
    for number, (t, q, p) in enumerate(tosses(data)):
        if number not in judged:
            continue
        k = touch_row(q, p)
        end = int(np.searchsorted(t, t[k] + AFTER_SEC, "right"))
        pose, twist = start_of(t[:k], q[:k], p[:k])
        initial = InitialSection(poses={NAME: pose}, body_velocities={NAME: twist})
        x = simulation.run(initial, t[:end], POSE)
        off = corners(x[k:, :4], x[k:, 4:]) - corners(q[k:end], p[k:end])
        size = np.linalg.norm(off, axis=2)
        squares.append(np.minimum(np.where(np.isfinite(size), size, CAP), CAP) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--judge", type=Path, metavar="SCENE")
    args = parser.parse_args()
    if args.judge is None:
        convert(args.data, args.out)
        return
    for name, file in (("published", args.out / "scene.yaml"), ("given", args.judge)):
        print(f"scene {name}: {1e3 * judge(args.data, file):.2f} mm")


if __name__ == "__main__":
    main()

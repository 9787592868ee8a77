"""What truly acts at the tip in Drake's worlds, beside what Coulomb's law permits.

    python tests/gap_benchmark/contact_forces.py drake_damped 850701

A block is pushed with nothing hidden; of each row the force at the tip is split along
the normal of the face that it meets, and across. Printed are the friction that surfaces
have, the one that forces show, where a patch lies, and what slip adds.
"""

import sys
from pathlib import Path

import numpy as np

if __name__ == "__main__":  # The package is found beside the tests.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gap_benchmark.contact_cases import SCENES, Recipe
from gap_benchmark.contact_scenes import WORLDS, DrakeWorld, pair_friction
from gap_benchmark.mechanism import rotation

LEAST = 0.3  # [N] A smaller force has no direction.
SLIPS = (1e-4, 3e-4, 1e-3, 2e-3, 4e-3)  # [m/s]


def patch(world: DrakeWorld) -> tuple[np.ndarray, np.ndarray]:
    """Mean normal (3,) of the tip's hydroelastic surface, either way, and its middle
    (3,); nan where there is none."""
    plant, own = world.plant, world.own
    tip = plant.GetBodyByName("tip", world.robot).index()
    inspector = plant.EvalSceneGraphInspector(own)
    results = plant.get_contact_results_output_port().Eval(own)
    for k in range(results.num_hydroelastic_contacts()):
        s = results.hydroelastic_contact_info(k).contact_surface()
        frames = [inspector.GetFrameId(g) for g in (s.id_M(), s.id_N())]
        if tip not in [plant.GetBodyFromFrameId(f).index() for f in frames]:
            continue
        mesh = s.tri_mesh_W() if s.is_triangle() else s.poly_mesh_W()
        areas = [mesh.area(i) for i in range(s.num_faces())]
        normals = np.array([mesh.face_normal(i) for i in range(s.num_faces())])
        mean = np.array(areas) @ normals
        return mean / np.linalg.norm(mean), s.centroid()
    return np.full(3, np.nan), np.full(3, np.nan)


def forces(name: str, seed: int, episodes: int):
    """The setting, and rows (n, 7): normal force [N], force across over it, slip [m/s],
    angle of the patch [degrees], its middle off the nearest point of the face [m],
    depth [m] of the sphere in the box, height [m] of the block."""
    rng = np.random.default_rng(seed)
    s, made = SCENES["push"](Recipe("push", name), rng)
    world, rows = WORLDS[name](s), []
    assert s.tool is not None
    radius, half = s.tool.size[0], np.array(s.free[0].shapes[0].size)
    kp, kd, plant = np.array(s.kp), np.array(s.kd), world.plant
    block = plant.GetBodyByName("block")
    tip = plant.GetBodyByName("tip", world.robot)
    for e in made(s, rng)[:episodes]:
        world.reset(e.q, e.poses)
        for t in np.arange(int(e.seconds * s.rate)) / s.rate:
            q, v = world.state()
            c = np.asarray(e.command(t, q, v), float)
            f, x = -world.wrench(), world.pose("block.block")
            if np.linalg.norm(f) > LEAST:
                R, centre = rotation(x[3:]), plant.EvalBodyPoseInWorld(world.own, tip)
                local = R.T @ (centre.translation() - x[:3])
                k = int(np.argmax(np.abs(local) - half))
                n = -np.sign(local[k]) * R[:, k]  # Into the block.
                apart = abs(local[k]) - half[k]
                at = centre.translation() + apart * n
                V = plant.EvalBodySpatialVelocityInWorld(world.own, block)
                slip = plant.EvalBodySpatialVelocityInWorld(world.own, tip)
                u = slip.translational() - V.translational()
                u = u - np.cross(V.rotational(), at - x[:3])
                mean, middle = patch(world)
                angle = np.degrees(np.arccos(min(abs(mean @ n), 1.0)))
                off = middle - at
                push = max(f @ n, 1e-9)
                rows.append([
                    push, np.linalg.norm(f - push * n) / push,
                    np.linalg.norm(u - (u @ n) * n), angle,
                    np.linalg.norm(off - (off @ n) * n), radius - apart, x[2],
                ])  # fmt: skip

            def effort(at, q, v, c=c):
                return kp * (c[:2] - q) + kd * (c[2:] - v)

            world.advance(effort, t + 1.0 / s.rate)
    return s, np.array(rows)


def main(name: str, seed: str, episodes: str = "1") -> None:
    s, rows = forces(name, int(seed), int(episodes))
    assert s.tool is not None
    mu = pair_friction(s.tool, s.free[0].shapes[0])
    _, ratio, slip, angle, off, depth, height = rows.T

    def at(x, *percent) -> str:
        return ", ".join(f"{v:.4g}" for v in np.nanpercentile(x, percent))

    print(f"{name} {seed}: friction of the tip {mu:.4f}")
    print(f"force across / pressing, 50, 95, 99 %: {at(ratio, 50, 95, 99)}")
    print(f"rows beyond friction by 2 %: {np.mean(ratio > 1.02 * mu):.1%}")
    if np.isfinite(angle).any():
        print(f"patch turned, 50, 99 %: {at(angle, 50, 99)} degrees")
        print(f"patch aside, 50, 99 %: {at(1e3 * off, 50, 99)} mm")
    print(f"depth, 5, 50, 95 %: {at(1e3 * depth, 5, 50, 95)} mm")
    print(f"height of the block, 5, 50, 95 %: {at(1e3 * height, 5, 50, 95)} mm")
    for low, high in zip(SLIPS, SLIPS[1:], strict=False):
        some = (slip >= low) & (slip < high)
        if some.sum() > 3:
            more, v = np.median(ratio[some]) - mu, np.median(slip[some])
            print(f"slip {1e3 * v:.2g} mm/s: {more:+.4f} beyond friction; tau v / R "
                  f"of 0.2 s: {0.2 * v / s.tool.size[0]:.4f}")  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:])

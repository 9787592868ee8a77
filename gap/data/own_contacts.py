"""Parts of a robot that lie in one another in a log: shapes larger than the parts are.

Collision shapes are hulls and boxes around what is there. Where two of them overlap in
poses that the robot was in, contact would push joints that nothing pushed. Two trees of
bodies, as a finger and a door are, or a tool and the ground, may touch.
"""

import tempfile
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.effects.kind import full_name, one_dof_joints
from makebreak.models.scene import load_scene

POSES = 300  # Of a log, that are looked at.
TOUCHES = 1e-3  # [m] Parts that press on each other are no deeper.


def overlapping(
    scene: str, copies: Mapping[str, str],
    positions: Iterable[Mapping[str, np.ndarray]], guessed: Collection[str] = (),
) -> list[tuple[str, str]]:  # fmt: skip
    """(one, other) `<model>::<body>` of each pair of bodies that lie in each other.

    Args: scene: a scene's file; copies: {name: text} of files beside it; positions: of
        each log {joint: (n,)} [rad], [m]; guessed: bodies that are where nobody knows,
        so that what they carry touches nothing.
    """
    builder = DiagramBuilder()
    with tempfile.TemporaryDirectory() as folder:
        for name, text in {"scene.yaml": scene, **copies}.items():
            (Path(folder) / name).write_text(text)
        try:
            loaded = load_scene(Path(folder) / "scene.yaml", builder)
        except ValueError:  # The scene itself says it.
            return []
    plant, diagram = loaded.plant, builder.Build()
    root = diagram.CreateDefaultContext()
    context = plant.GetMyContextFromRoot(root)
    found: dict[tuple[str, str], None] = {}
    carrier = _roots(plant)
    for log in positions:
        joints = [j for j in one_dof_joints(plant)
                  if j.num_positions() and full_name(plant, j) in log]  # fmt: skip
        if not joints:
            continue
        q = np.stack([log[full_name(plant, j)] for j in joints], axis=1)
        q = q[np.isfinite(q).all(axis=1)]
        for row in q[:: max(len(q) // POSES, 1)]:
            state = plant.GetPositions(context)
            state[[j.position_start() for j in joints]] = row
            plant.SetPositions(context, state)
            query = plant.get_geometry_query_input_port().Eval(context)
            inspector = query.inspector()
            for pair in query.ComputePointPairPenetration():
                if pair.depth > TOUCHES:
                    frames = (inspector.GetFrameId(g) for g in (pair.id_A, pair.id_B))
                    bodies = [plant.GetBodyFromFrameId(frame) for frame in frames]
                    roots = {carrier[int(body.index())] for body in bodies}
                    if len(roots) > 1 and roots.isdisjoint(guessed):
                        continue  # What does not hang together may touch.
                    one, other = sorted(b.scoped_name().get_full() for b in bodies)
                    found[one, other] = None
    return list(found)


def _roots(plant: MultibodyPlant) -> dict[int, str]:
    """{body: the name of the one on the world, or floating, that carries it}."""
    carried_by = {
        int(j.child_body().index()): int(j.parent_body().index())
        for j in map(plant.get_joint, plant.GetJointIndices())
    }
    world, found = int(plant.world_body().index()), {}
    for body in range(plant.num_bodies()):
        at = body
        while carried_by.get(at, world) != world:
            at = carried_by[at]
        found[body] = plant.get_body(BodyIndex(at)).name()
    return found

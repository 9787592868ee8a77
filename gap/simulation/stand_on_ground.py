"""How high a free body lies on what is fixed below it."""

import numpy as np
from pydrake.multibody.tree import BodyIndex

from makebreak.models.effects.kind import full_name

MOST_MOVES = 4  # One is enough for a flat ground.
UPWARDS = 0.5  # Cosine of a normal and the vertical: less, and it carries nothing.
STANDS = 1e-9  # A move that is shorter is the last [m].


def stand_on_ground(plant, context, scene_graph, graph_context, thing) -> float:
    """Moves a free body up or down until it just touches what is fixed below it.

    Args: context, graph_context: of the plant and of the scene graph, in one diagram.
    Returns: the height of its origin [m]. Raises: ValueError if nothing is below it.
    """
    at = thing.floating_positions_start() + 6
    fixed = [
        geometry
        for i in range(plant.num_bodies())
        if plant.IsAnchored(plant.get_body(BodyIndex(i)))
        for geometry in plant.GetCollisionGeometriesForBody(
            plant.get_body(BodyIndex(i))
        )
    ]
    mine = plant.GetCollisionGeometriesForBody(thing)
    q = plant.GetPositions(context)
    for _ in range(MOST_MOVES):
        query = scene_graph.get_query_output_port().Eval(graph_context)
        down = np.inf
        for a in mine:
            for b in fixed:
                pair = query.ComputeSignedDistancePairClosestPoints(a, b)
                up = pair.nhat_BA_W[2] * (1.0 if pair.id_A == a else -1.0)
                if up > UPWARDS:
                    down = min(down, pair.distance / up)
        if not np.isfinite(down):
            name = full_name(plant, thing)
            raise ValueError(f"put_down: nothing fixed is below {name!r}")
        q[at] -= down
        plant.SetPositions(context, q)
        if abs(down) < STANDS:
            break
    return float(q[at])

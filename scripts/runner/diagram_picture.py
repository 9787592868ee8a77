"""Draws the top level of a Drake diagram, without Graphviz, which pip cannot install.

Columns follow the data flow, starting at the station; feedback edges run below.
"""

import math
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, System

WIDTH, HEIGHT, GAP_X, GAP_Y = 2.2, 0.62, 1.5, 0.6  # Size of boxes and gaps.
LETTER, LINE = 0.085, 0.18  # Width of a letter and height of a line of a label.
FORMATS = (".svg", ".png", ".pdf")
COLORS = ("#4c72b0", "#dd8452", "#55a868", "#c44e52", "#8172b3", "#937860", "#da8bc3")


def shown_systems(diagram: Diagram) -> list[System]:
    """The systems that are drawn: subdiagrams, plants and systems of this project."""
    return [
        system
        for system in diagram.GetSystems()
        if system.num_output_ports() > 0
        and (
            isinstance(system, Diagram | MultibodyPlant)
            or type(system).__module__.startswith("makebreak.")
        )
    ]


def shown_edges(diagram: Diagram) -> dict[tuple[str, str], list[str]]:
    """{(from, to): names of the output ports connected} among the systems shown.

    A connection through a system that is not shown (a gain, an adder) counts as one
    from the system before it.
    """
    shown = [system.get_name() for system in shown_systems(diagram)]
    into: dict[str, list[tuple[str, str]]] = {}
    for (system, _), (source, output) in _wires(diagram):
        into.setdefault(system, []).append((source, output))
    edges: dict[tuple[str, str], list[str]] = {}

    def sources(name: str, seen: frozenset) -> list[tuple[str, str]]:
        found = []
        for source, output in into.get(name, []):
            if source in shown:
                found.append((source, output))
            elif source not in seen:
                found += sources(source, seen | {source})
        return found

    for name in shown:
        for source, output in sources(name, frozenset()):
            ports = edges.setdefault((source, name), [])
            if output not in ports:
                ports.append(output)
    return edges


def _wires(diagram: Diagram):
    """((system, input port), (system, output port)) names of each connection."""
    for (target, i), (source, o) in diagram.connection_map().items():
        yield (
            (target.get_name(), target.get_input_port(i).get_name()),
            (source.get_name(), source.get_output_port(o).get_name()),
        )


def columns(names: list[str], edges) -> dict[str, int]:
    """Column of each system: one more than the greatest of its inputs' columns.

    Loops are cut by a depth-first search in the order of `names`, which skips edges
    back to a system on its present path.
    """
    after: dict[str, list[str]] = {name: [] for name in names}
    for source, target in edges:
        after[source].append(target)
    order: list[str] = []
    state: dict[str, int] = {}
    forward: list[tuple[str, str]] = []

    def walk(name: str) -> None:
        state[name] = 1
        for target in sorted(after[name], key=names.index):
            if state.get(target) != 1 and target != name:
                forward.append((name, target))
                if target not in state:
                    walk(target)
        state[name] = 2
        order.append(name)

    for name in names:
        if name not in state:
            walk(name)
    column = dict.fromkeys(names, 0)
    for name in reversed(order):
        for source, target in forward:
            if source == name:
                column[target] = max(column[target], column[name] + 1)
    return column


def draw_diagram(diagram: Diagram, path: Path) -> None:
    """Writes the picture in the format that the suffix names.

    Raises: ValueError for a file that cannot be written.
    """
    names = [system.get_name() for system in shown_systems(diagram)]
    edges = shown_edges(diagram)
    column = columns(names, edges)
    chains = _chains(edges, column)
    x, y = _places(names, chains, column)
    back = [pair for pair in sorted(edges) if column[pair[1]] <= column[pair[0]]]
    top, bottom = max(y.values(), default=0.0), min(y.values(), default=0.0) - HEIGHT
    wide = max(x.values(), default=0.0) + 2.0 * WIDTH
    tall = top - bottom + 1.5 * HEIGHT + 0.35 * max(len(back) - 1, 0)
    figure, ax = plt.subplots(
        figsize=(0.75 * wide, 0.75 * tall + 0.4), layout="constrained"
    )
    taken = [(x[name], y[name], WIDTH, HEIGHT) for name in names]
    for pair, chain in sorted(chains.items()):
        color = COLORS[names.index(pair[0]) % len(COLORS)]
        points = [(x[chain[0]] + WIDTH / 2, y[chain[0]] + _spread(chain, chains, y, 0))]
        for one in chain[1:-1]:  # Horizontal within a column, clear of its boxes.
            points += [(x[one] - WIDTH / 2, y[one]), (x[one] + WIDTH / 2, y[one])]
        end = (x[chain[-1]] - WIDTH / 2, y[chain[-1]] + _spread(chain, chains, y, 1))
        _arrow(ax, [*points, end], color)
        _label(ax, [*points, end], edges[pair], color, taken)
    for k, pair in enumerate(back):
        color = COLORS[names.index(pair[0]) % len(COLORS)]
        low = bottom - 0.35 * k
        start = (x[pair[0]] + 0.3 * WIDTH, y[pair[0]] - HEIGHT / 2)
        end = (x[pair[1]] - 0.3 * WIDTH, y[pair[1]] - HEIGHT / 2)
        _arrow(ax, [start, (start[0], low), (end[0], low), end], color)
        _label(ax, [(start[0], low), (end[0], low)], edges[pair], color, taken)
    for name in names:
        whole = isinstance(diagram.GetSubsystemByName(name), Diagram)
        ax.add_patch(
            FancyBboxPatch(
                (x[name] - WIDTH / 2, y[name] - HEIGHT / 2), WIDTH, HEIGHT,
                boxstyle="round,pad=0.02", fc="#dfe7f1" if whole else "w",
                ec=COLORS[names.index(name) % len(COLORS)], lw=1.5, zorder=3,
            )
        )  # fmt: skip
        ax.text(x[name], y[name], name, ha="center", va="center", fontsize=9, zorder=4)
    ax.set_xlim(-0.6 * WIDTH, wide - 1.4 * WIDTH)
    ax.set_ylim(top + HEIGHT - tall, top + HEIGHT)
    ax.set_title(diagram.get_name() or "diagram", fontsize=11)
    ax.axis("off")
    ax.set_aspect("equal")
    is_text = path.suffix == ".svg"
    try:
        with plt.rc_context({"svg.fonttype": "none"}):  # Keeps text searchable.
            figure.savefig(path, metadata={"Date": None} if is_text else None)
    except OSError as error:
        raise ValueError(
            f'--diagram: "{path}" cannot be written: {error.strerror}'
        ) from error
    finally:
        plt.close(figure)


def _chains(edges, column) -> dict[tuple[str, str], list]:
    """{edge: its boxes and free slots, one in each column} of the forward edges."""
    return {
        (a, b): [a, *((a, b, c) for c in range(column[a] + 1, column[b])), b]
        for a, b in edges
        if column[b] > column[a]
    }


def _places(names, chains, column):
    """x and y of each box and slot: near the middle of its neighbours."""
    rows: list[list] = [[] for _ in range(max(column.values(), default=0) + 1)]
    for name in names:
        rows[column[name]].append(name)
    near: dict = {name: [] for name in names}
    for chain in chains.values():
        for slot in chain[1:-1]:
            rows[slot[2]].append(slot)
            near[slot] = []
        for one, other in zip(chain, chain[1:], strict=False):
            near[one].append(other)
            near[other].append(one)

    def height(one) -> float:
        return HEIGHT + GAP_Y if isinstance(one, str) else 0.45

    y: dict = {}
    for row in rows:
        for i, one in enumerate(row):
            y[one] = -float(i)
    for _ in range(40):
        for row in rows:
            middle = {
                one: sum(y[o] for o in near[one]) / len(near[one])
                if near[one]
                else y[one]
                for one in row
            }
            row.sort(key=middle.__getitem__, reverse=True)
            total = sum(map(height, row))
            at = total / 2.0 + sum(middle.values()) / max(len(row), 1)
            for one in row:
                y[one] = at - height(one) / 2.0
                at -= height(one)
    x = {one: i * (WIDTH + GAP_X) for i, row in enumerate(rows) for one in row}
    return x, y


def _spread(chain, chains, y, end) -> float:
    """Offset of an edge's end on its side of the box, in the order of height."""
    box, step = (chain[-1], -2) if end else (chain[0], 1)
    others = sorted(
        (c[step] for c in chains.values() if c[-1 if end else 0] == box),
        key=lambda one: (y[one], str(one)),
    )
    if len(others) < 2:
        return 0.0
    return (others.index(chain[step]) / (len(others) - 1) - 0.5) * HEIGHT * 0.8


def _arrow(ax, points, color) -> None:
    xs, ys = zip(*points, strict=True)
    ax.plot(xs, ys, color=color, lw=1.0, zorder=1)
    ax.annotate(
        "", points[-1], points[-2], zorder=1,
        arrowprops=dict(arrowstyle="-|>", color=color, lw=1.0, shrinkA=0, shrinkB=0),
    )  # fmt: skip


def _label(ax, route, ports, color, taken) -> None:
    """Labels a route with its ports, at the first spot with the most room.

    `taken` are occupied rectangles (x, y, width, height), to which the label is added.
    """
    lines = [port.removeprefix("panda.") for port in ports]
    w, h = LETTER * max(map(len, lines)) + 0.1, LINE * len(lines)
    spots = _along(route, 0.1)

    def covered(at) -> float:
        across = ((abs(at[0] - X), abs(at[1] - Y), W, H) for X, Y, W, H in taken)
        return sum(
            max((w + W) / 2 - dx, 0.0) * max((h + H) / 2 - dy, 0.0)
            for dx, dy, W, H in across
        )

    x, y = min(spots, key=lambda at: round(covered(at), 3))  # The first of equals.
    taken.append((x, y, w, h))
    ax.text(
        x, y, "\n".join(lines), fontsize=8, ha="center", va="center", color=color,
        zorder=2, bbox=dict(fc="w", ec="none", pad=0.5),
    )  # fmt: skip


def _along(route, step) -> list[tuple[float, float]]:
    """Points on a polyline, `step` apart on each of its pieces."""
    out = []
    for (x0, y0), (x1, y1) in zip(route, route[1:], strict=False):
        n = max(round(math.hypot(x1 - x0, y1 - y0) / step), 1)
        out += [(x0 + k / n * (x1 - x0), y0 + k / n * (y1 - y0)) for k in range(n + 1)]
    return out

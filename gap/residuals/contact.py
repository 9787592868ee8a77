"""Effects of free bodies and their contacts, by trying values.

Each kind is tried at a few values; what a value changes in all windows, over the noise,
is its column.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from makebreak.gap.problem import Candidate, Nuisances
from makebreak.gap.simulation.free_windows import FreeBodyModel, touched
from makebreak.gap.simulation.windows import WindowModel
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact import CONTACT_LAW, DAMPER, STIFFNESS
from makebreak.models.effects.ground import PLACE
from makebreak.models.effects.kind import Effect

# What a value is multiplied by, or what is added to it.
_TIMES = {
    "contact_friction": (0.5, 0.9, 1.7),
    "contact_stiffness": (0.1, 0.4, 0.9, 2.5),
    "contact_dissipation": (0.05, 0.4, 1.1, 2.5),
    "object_mass": (0.7, 0.97, 1.4),
}
# The same of a surface: what stands on much friction shows nothing until it is little.
_FAR_TIMES = np.array([0.9, 0.75, 0.6, 0.5, 0.42, 0.35, 0.29, 0.24, 0.2, 1.3, 2.0, 4.0])
# Values tried where the scene has none.
_FROM_NONE = {
    "contact_friction": (0.05, 0.2, 0.6),
    "contact_dissipation": (0.05, 0.3, 1.5),
}
_PLUS: dict[str, dict[str, tuple[float, ...]]] = {
    "rolling_resistance": {"coefficient": (0.002, 0.006, 0.015)},
    "plane_height": {"height": (-0.004, -0.0005, 0.004)},
    "plane_tilt": dict.fromkeys(("roll", "pitch"), (0.003, 0.02)),
    "corner_radius": {"radius": (0.002, 0.005)},
    "object_com": dict.fromkeys("xyz", (0.001, 0.006)),
    "constant_force": dict.fromkeys(("fx", "fy", "fz"), (0.01, 0.3)),
}
_POSITIVE = dict.fromkeys(
    ("friction", "stiffness", "dissipation", "mass", "radius", "scale", "ixx", "iyy",
     "izz"), True,
)  # fmt: skip
_SIZES = (0.95, 0.99, 1.05)
_FAR_SIZES = (0.87, 1.15)  # Where what is off by so much is off at once.
_DAMPED = (0.02, 0.06, 0.12, 0.25, 0.5)  # Of critical damping: a linear damper's.
_INERTIAS = (0.97, 1.2)
PLACES = (-0.02, -0.008, -0.003, 0.003, 0.008, 0.02)  # Of a face that is met [m].
# Cells a side of the ground that was touched, in search of a patch; their least size.
CELLS, LEAST_CELL = 6, 0.01  # [m]
# A side is moved by so many steps of so much of a cell, most often so many times.
PATCH_ROUNDS, PATCH_STEPS, PATCH_REACH = 12, (0.25, 0.05), 20
# Kinds that an unmeasured force on a mechanism would show as; those of free bodies.
_OF_BODIES = (*(k for k, e in KINDS.items() if e.body_law), "object_mass", "object_com",
              "object_inertia", "length_scale")  # fmt: skip
# Of a force that grows with a body's speed: tried for each kilogram of it.
_DRAGS = {"N s/m": 0.3, "N m s/rad": 3e-4, "N s2/m2": 0.1}


def contact_nuisances(model: FreeBodyModel | WindowModel) -> Nuisances:
    """Contact stiffness and dissipation within the scene's tolerance (relative)."""
    columns, prior, names = [], [], []
    for kind in CONTACT_LAW:
        share = float(model.scene.tolerance.get(kind, 0.0))
        if share <= 0.0:
            continue
        for at in model.dynamics.places(kind):
            try:
                ((name, now),) = model.dynamics.now(kind, [at]).items()
            except ValueError:  # Its shapes are not alike.
                continue
            step = min(0.3 * share, 0.2)
            r = _residual(model, Effect(kind, [at], {name: now * (1.0 + step)}))
            if r is None or not np.abs(model.base() - r).max() > 1e-6:
                continue
            columns.append((model.base() - r) / step)
            prior.append(share)
            names.append(f"{kind} of {at}")
    if not columns:
        return Nuisances.none(len(model.train()))
    return Nuisances(np.stack(columns, axis=1), np.array(prior), tuple(names))


def contact_candidates(
    model: FreeBodyModel | WindowModel,
    there: Sequence[Effect],
    r: np.ndarray,
    one_size: bool = False,
) -> list[Candidate]:
    """All kinds that free bodies and their contacts may show.

    Args: there, effects that are in the model already, and what they leave, r (m,).
        one_size: whether one size of a pair's values is tried, as others are where it
        is ranked: so all pairs can be a group.
    """
    found: list[Candidate] = []
    for kind in KINDS:
        for at in model.places_of(kind):
            if kind == "length_scale" and at == "world":
                continue
            if kind in _OF_BODIES and at not in model.bodies:
                continue
            if kind == "object_mass" and _is_alone(model):
                continue  # No force is measured: it only shows as stiffness over mass.
            if any(e.kind == kind and at in e.at for e in there):
                continue
            if kind == "plane_tilt" and any(e.kind == "friction_patch" for e in there):
                continue
            if kind == "friction_patch":
                found += _patches(model, at, there, r)
                continue
            for trials, names, fixed in _trials(model, kind, at):
                pairs = one_size and KINDS[kind].at == "pair"
                most = 1 if pairs else len(trials)
                each = _of(model, kind, [at], trials, names, fixed, there, r, most)
                if each is not None:
                    found.append(each)
    return found + (_of_surfaces(model, there, r) if one_size else [])


def _of_surfaces(model, there: Sequence[Effect], r: np.ndarray) -> list[Candidate]:
    """One value for all pairs of a body that have the same value now, tried at all of
    them together: what stands on four feet does not slip on one of them."""
    by: dict[tuple, list[str]] = {}
    taken = {(e.kind, at) for e in there for at in e.at}
    for kind in (k for k in _TIMES if KINDS[k].at == "pair"):
        for at in model.places_of(kind):
            now = _now(model, kind, at)
            if now is None or (kind, at) in taken:
                continue
            ((name, value),) = now.items()
            for body in at.split("~") if value else ():
                by.setdefault((kind, name, value, body), []).append(at)
    found = {}
    for (kind, name, value, _), some in by.items():
        key = (kind, *some)
        if len(some) > 1 and key not in found:
            trials = [[(v - value, {name: v})] for v in value * _FAR_TIMES]
            args = (trials, (name,), (), there, r, len(trials))
            found[key] = _of(model, kind, some, *args)
    return [each for each in found.values() if each is not None]


def _is_alone(model: FreeBodyModel | WindowModel) -> bool:
    """Whether one body touches what is fixed and nothing else."""
    return isinstance(model, FreeBodyModel) and len(model.bodies) == 1


def _met_axes(model: FreeBodyModel | WindowModel, at: str) -> dict[str, float]:
    """{axis of the world: where a face of a body is met along it}."""
    return {axis: off for (name, axis), off in model.met.items() if name == at}


def _now(model, kind: str, at: str) -> dict[str, float] | None:
    """What a kind changes, as it is; None where the place has no such thing."""
    try:
        return dict(model.dynamics.now(kind, [at]))
    except ValueError:
        return None


def _trials(model, kind: str, at: str):
    """Of each candidate of a kind at a place: alternatives, each a list of (step,
    parameters), one for each unknown; the unknowns; and what stays as it is."""
    now = _now(model, kind, at)
    if now is None:
        return
    if kind == "object_size":
        name = "radius" if "radius" in now else "scale"
        far = () if isinstance(model, FreeBodyModel) else _FAR_SIZES
        values = [now[name] * s for s in (*_SIZES, *far)]
        yield [[(v - now[name], {name: v})] for v in values], (name,), ()
    elif kind == "length_scale":
        yield [[(s, {"scale": 1.0 + s})] for s in (-0.02, 0.02)], ("scale",), ()
    elif kind == "object_inertia":
        names = ("ixx", "iyy", "izz")
        yield (
            [[((f - 1.0) * now[n], _moments(now, n, f)) for n in names]
             for f in _INERTIAS],
            names, (),
        )  # fmt: skip
    elif KINDS[kind].body_law and all(p.unit in _DRAGS for p in KINDS[kind].parameters):
        mass = model.dynamics.now("object_mass", [at])["mass"]
        none = {p.name: 0.0 for p in KINDS[kind].parameters}
        for p in KINDS[kind].parameters:
            step, others = _DRAGS[p.unit] * mass, tuple(n for n in none if n != p.name)
            yield [[(step, {**none, p.name: step})]], (p.name,), others
    elif kind == DAMPER:
        if not isinstance(model, FreeBodyModel):
            return  # Drake's steps bound it, and are too long.
        stiffness = model.dynamics.now(STIFFNESS, [at])["stiffness"]
        critical = 2.0 * np.sqrt(stiffness * model.body(at).mass)
        values = [share * critical for share in _DAMPED]
        yield [[(c, {"damping": c})] for c in values], ("damping",), ()
    elif kind == PLACE or (kind == "plane_height" and _met_axes(model, at)):
        # Which of the two it is depends on where the face that is met looks.
        for axis, off in _met_axes(model, at).items():
            if (axis == "z") == (kind == PLACE):
                continue
            name = axis if kind == PLACE else "height"
            values = [*PLACES] if kind == PLACE else [*_PLUS[kind]["height"]]
            if abs(off) > max(values):
                values.append(off)
            yield [[(d, {name: d})] for d in values], (name,), ()
    elif kind in _TIMES:
        ((name, value),) = now.items()
        near = [f * value for f in _TIMES[kind]] if value else _FROM_NONE.get(kind, ())
        offered = [[(v - value, {name: v})] for v in near]
        if kind == "contact_friction" and isinstance(model, FreeBodyModel):
            # Not what also changes others: a wall's would stand for the ground's.
            offered = [
                t for t in offered if not model.rubs_others(Effect(kind, [at], t[0][1]))
            ]
        yield offered, (name,), ()
    elif kind in _PLUS:
        steps = _PLUS[kind]
        base = {p.name: now.get(p.name, 0.0) for p in KINDS[kind].parameters}
        if len(steps) == 1:
            ((name, tried),) = steps.items()
            yield ([[(d, {**base, name: base[name] + d})] for d in tried], (name,), ())
        else:
            each = [tuple(d for d, _ in steps.values())]
            if isinstance(model, FreeBodyModel):
                # Large ones too, in all directions: its errors are far from linear.
                large = [d for _, d in steps.values()]
                for signs in itertools.product((1.0, -1.0), repeat=len(steps)):
                    each.append(tuple(s * d for s, d in zip(signs, large, strict=True)))
            yield (
                [[(d, {**base, n: base[n] + d}) for n, d in zip(steps, e, strict=True)]
                 for e in each],
                tuple(steps), (),
            )  # fmt: skip


def _patches(model, at: str, there, r) -> list[Candidate]:
    """A rectangle of other friction: cells of the ground that was touched are tried one
    by one, and a rectangle is the sum of its cells."""
    if not isinstance(model, FreeBodyModel):
        return []
    axes = _met_axes(model, at.split("~")[1])
    if axes and "z" not in axes:
        return []
    try:
        mu = model.dynamics.now("contact_friction", [at])["friction"]
        model.dynamics.now("friction_patch", [at])  # Whether there can be one.
    except ValueError:
        return []
    for effect in there:
        if effect.kind == "plane_tilt":
            return []  # Only level ground is cut into a patch.
        if effect.kind == "contact_friction" and at in effect.at:
            mu = effect.parameters["friction"]
    places = touched(model, at)
    if mu <= 0.0 or len(places) < 2 * CELLS:
        return []
    grid = [np.linspace(c.min() - 1e-3, c.max() + 1e-3, CELLS + 1) for c in places.T]
    if min(x[1] - x[0] for x in grid) < LEAST_CELL:
        return []
    train, step = model.train(), -0.3 * mu

    def patch(friction: float, sides) -> dict[str, float]:
        names = ("x_min", "x_max", "y_min", "y_max")
        sides = dict(zip(names, map(float, sides), strict=True))
        return {"friction": friction} | sides

    def moved(friction: float, sides) -> np.ndarray | None:
        effect = Effect("friction_patch", [at], patch(friction, sides))
        return _residual(model, *there, effect)

    # Cell by cell; of a rectangle, to first order, the sum of its cells.
    sums = np.zeros((CELLS + 1, CELLS + 1, len(r)))
    for i, j in itertools.product(range(CELLS), repeat=2):
        new = moved(mu + step, (*grid[0][i : i + 2], *grid[1][j : j + 2]))
        if new is not None:
            sums[i + 1, j + 1] = (r - new) / step
    sums = sums.cumsum(axis=0).cumsum(axis=1)
    least, start = float(np.sum(r[train] ** 2)), None
    pairs = list(itertools.combinations(range(CELLS + 1), 2))
    for (i0, i1), (j0, j1) in itertools.product(pairs, repeat=2):
        x = (sums[i1, j1] - sums[i0, j1] - sums[i1, j0] + sums[i0, j0])[train]
        size = float(x @ x)
        c = float(x @ r[train]) / size if size > 0.0 else 0.0
        c = max(c, -0.9 * mu)
        error = float(np.sum((r[train] - c * x) ** 2))
        if error < least:
            least, start = error, (mu + c, np.array([i0, i1, j0, j1]))
    if start is None:
        return []
    friction, sides = _patch_search(moved, train, grid, *start)
    new = moved(friction, sides)
    if new is None or friction == mu:
        return []
    column = ((r - new) / (friction - mu))[:, None]

    def read(c) -> dict[str, float]:
        return patch(float(np.clip(mu + c[0], 0.1 * mu, max(1.5, 2.0 * mu))), sides)

    return [Candidate("friction_patch", (at,), 5, (column,), (read,))]


def _patch_search(moved, train, grid, friction: float, corner: np.ndarray):
    """The patch that no other place of one side, with another friction or the same,
    makes better: simulated, not to first order. As windows cross a side or not, the
    error has steps and narrow valleys; all places of a side are tried, not the next.

    Args: moved(friction, sides): residual or None; grid: of x and of y; corner (4,):
        numbers in it of the sides. Returns: friction, sides.
    """
    cells = np.arange(CELLS + 1)

    def sides(at) -> list[float]:
        return [float(np.interp(k, cells, grid[i // 2])) for i, k in enumerate(at)]

    def error(mu: float, at) -> float:
        if not (at[0] < at[1] and at[2] < at[3]) or min(at) < 0 or max(at) > CELLS:
            return np.inf
        r = moved(mu, sides(at))
        return np.inf if r is None else float(np.sum(r[train] ** 2))

    at = np.array(corner, float)
    now = error(friction, at)
    for step in PATCH_STEPS:
        for _ in range(PATCH_ROUNDS):
            before = now
            for side in np.eye(4):
                trials = [
                    (friction * share, at + k * step * side)
                    for share in (0.9, 1.0, 1.1)
                    for k in range(-PATCH_REACH, PATCH_REACH + 1)
                ]
                errors = [error(*each) for each in trials]
                best = int(np.argmin(errors))
                if errors[best] < now:
                    now, (friction, at) = errors[best], trials[best]
            if not now < 0.99 * before:
                break
    return friction, sides(at)


def _moments(now: dict, name: str, factor: float) -> dict[str, float]:
    """One moment of inertia changed, so that a body can still have the three."""
    out = {n: now[n] for n in ("ixx", "iyy", "izz")}
    out[name] *= factor
    return out


def _of(model, kind, at, trials, names, fixed, there, r, most) -> Candidate | None:
    """With the first `most` of the trials that do something, at all these places."""
    now = {p.name: p.neutral or 0.0 for p in KINDS[kind].parameters}
    now |= model.dynamics.now(kind, at)
    columns, readers = [], []
    reach = _reach(trials, names, now)
    known: dict[tuple, np.ndarray | None] = {}
    for trial in trials:
        made = []
        for step, parameters in trial:
            key = tuple(parameters.items())
            if key not in known:
                known[key] = _residual(model, *there, Effect(kind, at, parameters))
            moved = known[key]
            if moved is None:
                break
            made.append((r - moved) / step)
        if len(made) < len(trial) or not any(np.abs(x).max() > 1e-3 for x in made):
            continue
        columns.append(np.stack(made, axis=1))
        readers.append(_reader(kind, now, trial[0][1], names, reach))
        if len(columns) == most:
            break
    if not columns:
        return None
    return Candidate(kind, (*at,), len(names), tuple(columns), tuple(readers), fixed)


def _reach(trials, names, now) -> dict[str, tuple[float, float]]:
    """How far a line through a trial is trusted: three times as far as it was tried,
    and no farther than a fifth of a value that cannot be negative."""
    reach = {}
    for k, name in enumerate(names):
        steps = [trial[k][0] for trial in trials]
        far = 3.0 * max(max(steps), -min(steps))
        low = now[name] - far
        if _POSITIVE.get(name):
            low = max(low, 0.2 * min(t[k][1][name] for t in trials))
        reach[name] = (low, now[name] + far)
    return reach


def _reader(kind: str, now: dict, like: dict, names: Sequence[str], reach):
    bounded = len(names) == 1 or kind == "object_inertia"

    def read(c) -> dict[str, float]:
        out = {name: now[name] for name in like}
        for name, value in zip(names, c, strict=True):
            out[name] = now[name] + float(value)
            if bounded:
                out[name] = float(np.clip(out[name], *reach[name]))
        for p in KINDS[kind].parameters:
            if p.valid != "any" and p.name in out:
                out[p.name] = max(out[p.name], 0.0)
        return out

    return read


def _residual(model, *effects: Effect) -> np.ndarray | None:
    try:
        return model.residual(list(effects))
    except (ValueError, RuntimeError):
        return None

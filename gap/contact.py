"""Effects that only a simulation shows: contact, shapes, elasticity, backlash.

Each is tried at a few values; what a value changes in all windows, over the noise, is
its column.
"""

from collections.abc import Callable, Sequence

import numpy as np

from makebreak.gap.screen import Candidate
from makebreak.gap.windows import WindowModel
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.systems.numerics.selection import Columns

BOUNCE_SEC, ROLL_SEC = 0.12, 0.3  # Windows: beyond the second impact all is chaos.
# What a value is multiplied by, or what is added to it.
_TIMES = {
    "contact_friction": (0.5, 0.75, 1.4, 1.9),
    "contact_stiffness": (0.3, 0.6, 1.8, 3.5),
    "contact_dissipation": (0.3, 0.6, 1.8, 3.0),
    "object_mass": (0.6, 0.8, 1.25, 1.6),
    "object_inertia": (1.05,),
}
_PLUS: dict[str, dict[str, tuple[float, ...]]] = {
    "rolling_resistance": {"coefficient": (0.01,)},
    "plane_height": {"height": (-0.006, -0.003, 0.003, 0.006)},
    "plane_tilt": {"roll": (0.01,), "pitch": (0.01,)},
    "corner_radius": {"radius": (0.003, 0.006, 0.009)},
    "object_com": {"x": (0.002,), "y": (0.002,), "z": (0.002,)},
    "body_drag": {"linear": (0.1,)},
    "constant_force": {"fx": (0.02,), "fy": (0.02,), "fz": (0.02,)},
}
_SIZES = (0.92, 0.96, 1.04, 1.08)


def contact_model(scene, recordings) -> WindowModel:
    """Windows short enough for what the recordings hold: bounces or rolling."""
    whole = WindowModel(scene, recordings, ROLL_SEC, by_episode=_many(recordings))
    if not _bounces(whole):
        return whole
    return WindowModel(scene, recordings, BOUNCE_SEC, by_episode=_many(recordings))


def _many(recordings) -> bool:
    return sum(len(r.episodes) for r in recordings) >= 6


def _bounces(model: WindowModel) -> bool:
    """Whether bodies hit hard: accelerations of more than five times gravity."""
    return any(
        np.abs(path[name][:, 2]).max() > 50.0
        for path in model._paths.values()
        for name in path
        if name.endswith(".z")
    )


def contact_candidates(
    model: WindowModel, nuisance: np.ndarray, say: Callable[[str], None]
) -> list[Candidate]:
    """All kinds that free bodies and their contacts may show."""
    found: list[Candidate] = []
    dynamics = model.dynamics
    for kind, entry in KINDS.items():
        known = kind in _TIMES or kind in _PLUS
        if not known and kind not in ("object_size", "length_scale"):
            continue
        for at in dynamics.places(kind):
            if kind == "length_scale" and at == "world":
                continue
            if kind in ("constant_force", "body_drag", "object_mass", "object_com",
                        "object_inertia") and at not in model.bodies:  # fmt: skip
                continue
            each = _of(model, nuisance, kind, at, entry)
            if each is not None:
                found.append(each)
                say(f"  {kind} at {at}")
    return found


def _of(model: WindowModel, nuisance, kind: str, at: str, entry) -> Candidate | None:
    try:
        now = dict(model.dynamics.now(kind, [at]))
    except ValueError:
        return None
    names: tuple[str, ...]
    trials: list[list[tuple[str, float, dict]]] = []  # Alternatives of columns.
    if kind == "object_size":
        trials = [[("scale", s - 1.0, _sized(now, s))] for s in _SIZES]
        names = ("scale",)
    elif kind == "length_scale":
        trials, names = [[("scale", 0.01, {"scale": 1.01})]], ("scale",)
    elif kind == "object_inertia":
        names = ("ixx", "iyy", "izz")
        trials = [[(n, 0.05 * now[n], {**now, n: 1.05 * now[n]}) for n in names]]
    elif kind in _TIMES:
        (name,) = [p.name for p in entry.parameters]
        names = (name,)
        trials = [
            [(name, (f - 1.0) * now[name], {name: f * now[name]})] for f in _TIMES[kind]
        ]
    else:
        steps = _PLUS[kind]
        names = tuple(steps)
        base = {p.name: now.get(p.name, 0.0) for p in entry.parameters}
        if len(names) == 1:
            (name,) = names
            trials = [[(name, d, {**base, name: base[name] + d})] for d in steps[name]]
        else:
            trials = [[(n, d, {**base, n: base[n] + d}) for n, (d,) in steps.items()]]
    columns, readers = [], []
    for trial in trials:
        made = []
        for _, step, parameters in trial:
            r = _residual(model, Effect(kind, [at], parameters))
            if r is None:
                break
            made.append((model.base() - r) / step)
        if len(made) < len(trial) or not any(np.abs(x).max() > 0.0 for x in made):
            continue
        columns.append(Columns(np.stack(made, axis=1), nuisance, model.train()))
        readers.append(_reader(kind, now, names, entry))
    if not columns:
        return None
    fixed: tuple[str, ...] = ("angular",) if kind == "body_drag" else ()
    size = len(names)
    return Candidate(kind, (at,), size, tuple(columns), tuple(readers), fixed)


def _sized(now: dict, scale: float) -> dict[str, float]:
    out = {"scale": scale}
    if "radius" in now:
        out["radius"] = now["radius"] * scale
        if KINDS["object_size"].parameter("scale").optional:
            out.pop("scale")
    return out


def _reader(kind: str, now: dict, names: Sequence[str], entry):
    def read(c) -> dict[str, float]:
        if kind == "object_size":
            return _sized(now, float(np.clip(1.0 + c[0], 0.5, 2.0)))
        out = {p.name: now.get(p.name, 0.0) for p in entry.parameters}
        for name, value in zip(names, c, strict=True):
            out[name] = now.get(name, 0.0) + float(value)
        for p in entry.parameters:
            if p.valid != "any" and p.name in out:
                # A line laid through a bend may end beyond zero: then start near it.
                out[p.name] = max(out[p.name], 0.1 * abs(now.get(p.name, 0.0)))
        return out

    return read


def _residual(model: WindowModel, effect: Effect) -> np.ndarray | None:
    try:
        return model.residual([effect])
    except (ValueError, RuntimeError):
        return None


def hidden_candidates(
    model: WindowModel, nuisance: np.ndarray, joints: Sequence[str]
) -> list[Candidate]:
    """Elasticity and backlash of these joints, where driven, at a few values each."""
    found = []
    driven = set(model.scene.actuation.joints)
    for joint in (j for j in joints if j in driven):
        inertia = _inertia(model, joint)
        trials = []
        for hz in (3.0, 5.0, 8.0):
            k = inertia * (2.0 * np.pi * hz) ** 2
            p = {"stiffness": k, "damping": 2.0 * 0.05 * np.sqrt(k * inertia)}
            trials.append(("joint_elasticity", p))
        trials += [("joint_backlash", {"gap": g}) for g in (0.015, 0.03)]
        for kind in ("joint_elasticity", "joint_backlash"):
            columns, readers = [], []
            for p in (p for k, p in trials if k == kind):
                r = _residual(model, Effect(kind, [joint], p))
                if r is None:
                    continue
                column = (model.base() - r)[:, None]
                columns.append(Columns(column, nuisance, model.train()))
                readers.append(lambda c, p=p: dict(p))
            if columns:
                size = len(KINDS[kind].parameters)
                found.append(
                    Candidate(kind, (joint,), size, tuple(columns), tuple(readers))
                )
    return found


def _inertia(model: WindowModel, joint: str) -> float:
    """Of a joint, all others held, at the first window [kg m2] or [kg]."""
    plant = model.dynamics.plant
    context = model.dynamics._context
    _, i = model.dynamics.coordinates(f"{joint}.velocity")
    for other in model.joints:
        at = model.dynamics._coordinates[f"{other}.position"][2]
        q = plant.GetPositions(context)
        q[at] = model.windows[0].state[f"{other}.position"][0]
        plant.SetPositions(context, q)
    return float(plant.CalcMassMatrix(context)[i, i])

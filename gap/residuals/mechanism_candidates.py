"""What could act in a mechanism, and its nuisances, as columns of its equations."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Candidate, Nuisances, share_left
from makebreak.gap.residuals.drive_gains import gain_columns
from makebreak.gap.residuals.inverse import InverseModel
from makebreak.gap.simulation.channel_effects import SENSED
from makebreak.gap.thresholds import SINGLE_SHARE_OF_GROUP
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.joints import rotor
from makebreak.models.effects.kind import (
    Effect,
    find_joints,
    full_name,
)
from makebreak.models.effects.objects import MASS
from makebreak.models.effects.signature import added_effort
from makebreak.models.scene import Scene

# The limit of a nuisance, in tolerances: a link that is off by more is wrong, and not
# known too little. Of 28 normally distributed nuisances one in 14 sets has one beyond.
NUISANCE_LIMIT = 3.0
_DELAYS = (0.004, 0.01, 0.02, 0.04)  # [s] at which a delay's column is taken.
# Relative or absolute steps of other parameters of sensors.
_STEPS = {"offset": (1e-3,), "bias": (1e-3,), "skew": (1e-4,)}
_VELOCITY_DELAYS = (0.01,)
LESS_GAIN = 0.2  # Share of a drive's gain by which its column is taken.
_WAVES = 12  # Frequencies of a force that are tried on links other than the last.
ALL_OF_IT = 1e-6  # Of equations that masses alone make: so much is rounding.
LOAD = 0.1  # First trial of a load, of what a link weighs on average.
_HIDDEN_STATE_JOINTS = 3  # Joints at which a spring or a gap is tried: the worst ones.


@dataclass(frozen=True)
class KnownTo:
    """A standard deviation, as a share of the value where `relative`."""

    size: float
    relative: bool

    def of(self, value: float) -> float:
        return self.size * value if self.relative else self.size


def tolerances(scene: Scene) -> dict[str, "KnownTo"]:
    """{kind: how well the scene knows what it changes}."""
    return {
        kind: KnownTo(float(scene.tolerance.get(t.key, t.default)), t.relative)
        for kind, entry in KINDS.items()
        if (t := entry.tolerance) is not None
    }


def candidates(
    model: InverseModel, nuisances: Nuisances, left: np.ndarray
) -> list[Candidate]:
    """All that can be seen in the equations of motion.

    Args: left (m,): what the nuisances leave of the scene as it came.
    """
    dynamics, motions = model.dynamics, model.motions()
    worst = _worst_joints(model, left)
    # A joint that has such an element in the scene can have no second one.
    elastic = {
        full_name(dynamics.plant, joint)
        for e in model.scene.effects if KINDS[e.kind].hidden_state
        for joint in find_joints(e, dynamics.plant)
    }  # fmt: skip
    screen = Screen(left, nuisances.columns, nuisances.prior, model.train())
    unit = unit_of_mass(model)
    found: list[Candidate] = []
    for kind, entry in KINDS.items():
        of_things = entry.at in ("free body", "length", "pair", "ground")
        if entry.absolute or of_things:
            continue
        if kind in SENSED:
            found += _of_sensors(model, kind, screen)
            continue
        if entry.path in ("delay", "lag"):
            found += _of_delays(model, kind)
            continue
        if entry.drive:
            found += of_drives(model, kind)
            continue
        if entry.signature is None:
            continue
        waves: list | None = None
        places, first = dynamics.places(kind), len(found)
        is_wave = any(p.name == "frequency" for p in entry.parameters)
        for at in reversed(places) if is_wave else places:
            if entry.at == "base" and at == "world":
                continue
            if entry.path == "saturation" and not _driven(model, at):
                continue
            if entry.hidden_state and (at not in worst or at in elastic):
                continue
            if at == unit and _is_mass_alone(kind):
                continue
            columns, readers = [], []
            grids = [
                {name: [value] for name, value in tried.items()} or None
                for tried in values_tried(kind, at, dynamics.plant, motions)
            ]
            if is_wave:
                grids = waves if waves is not None else grids
            # One value of a grid after the other: all at once would be gigabytes.
            for grid in grids:
                groups = [dynamics.signatures(kind, [at], m, grid) for m in motions]
                for same in zip(*groups, strict=True):
                    columns.append(model.columns_of([s.columns for s in same]))
                    readers.append(same[0].to_parameters)
            if not columns:
                continue
            if not any(np.abs(x).max(initial=0.0) > 0.0 for x in columns):
                continue
            if unit is not None and _is_all_of_it(model, columns[0]):
                continue
            if is_wave and waves is None:
                # All frequencies at the last link, and the best of them elsewhere.
                fits = [screen.fit(x).train for x in columns]
                best = np.argsort(fits)[:_WAVES]
                waves = [grids[k] for k in best]
                columns = [columns[k] for k in best]
                readers = [readers[k] for k in best]
            size = sum(not (p.optional or p.given) for p in entry.parameters)
            if entry.may_lack:
                kept = [
                    k for k, p in enumerate(entry.parameters)
                    if p.name not in entry.may_lack
                ]  # fmt: skip
                found.append(
                    Candidate(
                        kind, (at,), len(kept), (columns[0][:, kept],),
                        (_some_of(readers[0], kept, size),), entry.may_lack,
                    )
                )  # fmt: skip
            found.append(
                Candidate(
                    kind, (at,), size, tuple(columns), tuple(readers),
                    least=model.least(kind, [at]),
                )
            )  # fmt: skip
        if is_wave:
            found[first:] = reversed(found[first:])  # From the base outwards, as all.
    return found


def rich_columns(
    model: InverseModel, found: Sequence[Candidate]
) -> tuple[np.ndarray, list[Candidate]]:
    """(m, k) of all kinds with one parameter at all of their places, and a load at the
    last link: what a model that lacks nothing ordinary would have; and whose they are.

    A gain multiplies what the model needs: as a factor on the measured effort it would
    cancel all of that, and with it what anything is off by; as a drive's own stiffness
    would, beside it: that is no column.
    """
    last = list(model.dynamics.links())[-1:]
    columns: list[np.ndarray] = []
    whose: list[Candidate] = []
    for c in found:
        before = len(columns)
        if KINDS[c.kind].path == "kp":
            continue
        if KINDS[c.kind].path == "gain":
            each = [
                model.dynamics.signatures(c.kind, list(c.at), m)[0].columns
                for m in model.needed_motions()
            ]
            columns.append(model.columns_of(each))
        elif c.columns[0].shape[1] == 1 and KINDS[c.kind].at != "base":
            columns.append(c.columns[0])
        elif KINDS[c.kind].at == "body" and list(c.at) == last and len(c.columns) == 1:
            columns.append(c.columns[0])
        if len(columns) > before:
            whose += columns[-1].shape[1] * [c]
    return np.hstack(columns or [np.zeros((len(model.train()), 0))]), whose


def nuisances(model: InverseModel, effects: Sequence[Effect] = ()) -> Nuisances:
    """The links' masses and centres of mass, instants of sampling, gains of drives.

    Args: effects: that the scene has beside its own; a mass shows where its centre is
        and as gravity is in them.
    """
    dynamics, motions = model.dynamics, model.motions()
    moved, gains = model.model_with(effects, True), model.gains_with(effects)
    columns, prior, names = [], [], []
    unit = unit_of_mass(model)
    for kind, tolerance in tolerances(model.scene).items():
        for at in dynamics.links():
            if at == unit and _is_mass_alone(kind):
                continue
            groups = [moved.signatures(kind, [at], m) for m in motions]
            for same in zip(*groups, strict=True):
                x = model.columns_of([s.columns / gains[:, None] for s in same])
                now = list(dynamics.now(kind, [at]).values())
                for k, unknown in enumerate(same[0].unknowns):
                    if not np.abs(x[:, k]).max(initial=0.0) > 0.0:
                        continue
                    columns.append(x[:, k])
                    prior.append(tolerance.of(now[k]))
                    names.append(f"{kind} of {at}, {unknown}")
    more, std, of_what = of_no_scene(model)
    columns, prior, names = columns + more, prior + std, names + of_what
    if not columns:
        return Nuisances.none(len(model.train()))
    return Nuisances(
        np.stack(columns, axis=1), np.array(prior), tuple(names), NUISANCE_LIMIT
    )


def of_no_scene(
    model: InverseModel,
) -> tuple[list[np.ndarray], list[float], list[str]]:
    """Columns (m,), standard deviations and names of nuisances that are no effects of
    a scene: instants of sampling, and gains of drives."""
    columns, prior, names = gain_columns(model)
    for more, std, of_what in (model.loop_timing(), model.filter_timing()):
        columns, prior, names = more + columns, std + prior, of_what + names
    return columns, prior, names


def unit_of_mass(model: InverseModel) -> str | None:
    """The heaviest link, where all masses are known up to a common factor alone:
    nothing drives the mechanism, and no force acts that does not grow with them.
    Without masses at all such equations would leave nothing, whatever the motion is;
    so the masses of the others are found in units of this one. None where something
    gives their size."""
    if any(model.commanded) or any(model.by_measured):
        return None
    links = model.dynamics.links()
    whole = np.zeros((len(model.train()), 1))
    for at, mass in links.items():
        groups = [model.dynamics.signatures(MASS, [at], m) for m in model.motions()]
        for same in zip(*groups, strict=True):
            whole += mass * model.columns_of([s.columns for s in same])
    return max(links, key=lambda at: links[at]) if _is_all_of_it(model, whole) else None


def _is_all_of_it(model: InverseModel, columns: np.ndarray) -> bool:
    """Whether some multiple of columns (m, k) is what the scene as it came leaves of
    the equations, whatever the motion is."""
    of_efforts = [k for k, (what, _) in enumerate(model.names()) if what == "effort"]
    mine = np.isin(model.channel_of_rows(), of_efforts)
    base, X = model.base()[mine], columns[mine]
    size = np.linalg.norm(X, axis=0)
    X = X[:, size > 0.0] / size[size > 0.0]
    left = base - X @ np.linalg.lstsq(X, base, rcond=1e-12)[0]
    return bool(np.linalg.norm(left) < ALL_OF_IT * np.linalg.norm(base))


def is_mass_of(thing: Candidate | Effect, link: str) -> bool:
    """Whether it is the mass of this link."""
    return _is_mass_alone(thing.kind) and list(thing.at) == [link]


def _is_mass_alone(kind: str) -> bool:
    entry = KINDS[kind]
    return entry.weighs and [p.name for p in entry.parameters] == ["mass"]


def loads(
    dynamics: SceneDynamics,
    taken: Collection[tuple[str, str]],
    r: np.ndarray,
    left: Callable[[Effect], np.ndarray | None],
    places: Callable[[str], Iterable[str]],
) -> list[Candidate]:
    """Loads, and masses that are otherwise than in the model, by small ones.

    Args: taken: (kind, place) of effects that are there. r (m,): what these leave.
        left: what one more leaves, None where there can be no such. places: of a kind.
    """
    small = LOAD * float(np.mean(list(dynamics.links().values())))
    found = []
    for kind, entry in KINDS.items():
        if entry.probes is None:
            continue
        probes, reader = entry.probes(small)
        for at in places(kind):
            if (kind, at) in taken:
                continue
            moved = [each for p in probes
                     if (each := left(Effect(kind, [at], p))) is not None]  # fmt: skip
            if len(moved) < len(probes):
                continue
            columns = np.stack([r - each for each in moved], axis=1)
            found.append(
                Candidate(kind, (at,), columns.shape[1], (columns,), (reader,),
                          least=dynamics.least(kind, [at]))
            )  # fmt: skip
    return found


def _driven(model: InverseModel, joint: str) -> bool:
    return model.commanded[model.joints.index(joint)]


def _motor_seen(model: InverseModel, joint: str) -> bool:
    """Whether what the motor gives is known: it is commanded, or measured before the
    gear."""
    i = model.joints.index(joint)
    return model.commanded[i] or (model.by_measured[i] and model.is_motor_side(i))


def _worst_joints(model: InverseModel, left: np.ndarray) -> list[str]:
    """Those whose equations are met least, after the nuisances: left (m,)."""
    names = model.names()
    size = {
        joint: float(np.mean(left[k :: len(names)] ** 2))
        for k, (what, joint) in enumerate(names)
        if what == "effort" and _motor_seen(model, joint)
    }
    return sorted(size, key=lambda joint: -size[joint])[:_HIDDEN_STATE_JOINTS]


def _some_of(reader: Callable, kept: Sequence[int], n: int) -> Callable:
    """A reader of n coefficients, for those that are kept; the others are zero."""

    def read(c):
        every = np.zeros(n)
        every[kept] = c
        return reader(every)

    return read


def values_tried(kind: str, at: str, plant, motions) -> list[dict[str, float]]:
    """The nonlinear parameters that a search tries, one set after the other."""
    tries = KINDS[kind].tries
    if tries is None:
        return [{}]
    grid = tries(Effect(kind, [at], {}), plant, motions)
    return [
        dict(zip(grid, values, strict=True))
        for values in zip(*grid.values(), strict=True)
    ]


def _of_delays(model: InverseModel, kind: str) -> list[Candidate]:
    """Of commands: by the difference that a delay makes, for a few delays."""
    name = KINDS[kind].parameters[0].name
    models = dict.fromkeys(j.split(".")[0] for j in model.joints)
    driven = [j for j in model.joints if _driven(model, j)]
    places = [(m,) for m in models if any(j.startswith(f"{m}.") for j in driven)]
    if len(driven) > 1:
        places += [(j,) for j in driven]
    return [c for at in places if (c := _secant(model, kind, at, name)) is not None]


def of_drives(model: InverseModel, kind: str) -> list[Candidate]:
    """Of drives' own numbers: by the difference that one less makes. Equations are in
    units of what drives are told, so they are linear in the reciprocal of a gain."""
    found = []
    for at in model.dynamics.places(kind):
        if not _driven(model, at):
            continue
        ((name, now),) = model.dynamics.now(kind, [at]).items()
        step = LESS_GAIN * now
        moved = model.residual([Effect(kind, [at], {name: now - step})])
        columns = ((moved - model.base()) / step)[:, None]

        def read(c, name=name, now=now):
            share = 1.0 - float(c[0]) / now / (1.0 - LESS_GAIN)
            return {name: now / share if share > 0.0 else np.inf}

        found.append(Candidate(kind, (at,), 1, (columns,), (read,)))
    return found


def _of_sensors(model: InverseModel, kind: str, screen: Screen) -> list[Candidate]:
    joints = model.joints
    models = tuple(dict.fromkeys(j.split(".")[0] for j in joints))
    what, name = KINDS[kind].channel, KINDS[kind].parameters[0].name
    velocities = tuple(
        f"{j}.velocity" for i, j in enumerate(joints) if model.has["velocity"][i]
    )
    efforts = tuple(
        f"{j}.effort_measured"
        for i, j in enumerate(joints)
        if model.has["effort_measured"][i] and not model.by_measured[i]
    )
    positions = tuple(f"{j}.position" for j in joints)
    places: list[tuple[str, ...]]
    if what == "offset":
        places = [(j,) for j in joints]
    elif what == "bias":
        places = [(c,) for c in (*velocities, *efforts)]
    elif what == "skew":
        places = [models]
    else:
        places = [positions, velocities, *((c,) for c in velocities)]
        places += [efforts, *((c,) for c in efforts)]
        if what == "delay":
            places.append(models)
    unique = [p for p in dict.fromkeys(places) if p]
    found = [_secant(model, kind, at, name) for at in unique]
    if what == "delay":
        found.append(_late_efforts(model, kind, name, screen))
    return [c for c in found if c is not None]


def _late_efforts(
    model: InverseModel, kind: str, name: str, screen: Screen
) -> Candidate | None:
    """All efforts that stand in for commands are late, if nearly all of the gap is just
    that. A late effort looks like damping where friction is most of what motors give,
    so beside other effects it would be named in the place of it."""
    given = tuple(
        f"{j}.effort_measured"
        for i, j in enumerate(model.joints) if model.by_measured[i]
    )  # fmt: skip
    if not given or (found := _secant(model, kind, given, name)) is None:
        return None
    before = screen.evaluate(screen.r).score
    after = min(screen.fit(x).score for x in found.columns)
    return found if share_left(before, after) <= 1.0 - SINGLE_SHARE_OF_GROUP else None


def inseparable(effect: Effect, model: InverseModel) -> Effect | None:
    """What no recording of commands and joints can tell from an effect: commands that
    act late, and all channels that show late (a measured effort would tell); of one
    driven joint that lifts nothing, a gain and another inertia."""
    if (alike := _inertia_for_gain(effect, model)) is not None:
        return alike
    models = sorted({joint.split(".")[0] for joint in model.joints})
    sensed = {
        f"{joint}.{what}"
        for k, joint in enumerate(model.joints)
        for what in ("position", "velocity")
        if what == "position" or model.has[what][k]
    }
    driven = {joint for joint in model.joints if _driven(model, joint)}
    if not driven or any(model.has["effort_measured"]):
        return None
    at, entry = set(effect.at), KINDS[effect.kind]
    (late_command,) = (k for k, each in KINDS.items() if each.path == "delay")
    (late_sensor,) = (k for k, each in KINDS.items() if each.channel == "delay")
    if entry.path == "delay" and (at == set(models) or at >= driven):
        return Effect(late_sensor, models, dict(effect.parameters))
    if entry.channel == "delay" and (at == set(models) or at >= sensed):
        return Effect(late_command, models, dict(effect.parameters))
    return None


def _inertia_for_gain(effect: Effect, model: InverseModel) -> Effect | None:
    """What stands for a gain g where a single joint's effort does nothing but
    accelerate one constant inertia J: J/g - J of more inertia. For more inertia, a
    gain."""
    entry = KINDS[effect.kind]
    is_gain = entry.path == "gain"
    is_rotor = effect.kind == rotor(model.joints[0], 0.0).kind
    if len(model.joints) != 1 or not (is_gain or is_rotor or entry.weighs):
        return None
    if not (_driven(model, model.joints[0]) or model.by_measured[0]):
        return None
    motions = model.needed_motions()
    vd = np.concatenate([m.vd[:, 0] for m in motions])

    def inertia_of(efforts) -> float | None:
        need = np.concatenate([each[:, 0] for each in efforts])
        inertia = float(vd @ need) / float(vd @ vd)
        rest = np.abs(need - inertia * vd).max()
        return inertia if rest < ALL_OF_IT * np.abs(need).max() else None

    inertia = inertia_of([m.effort for m in motions])
    if inertia is None:
        return None
    if is_gain:
        more_of_it = inertia / effect.parameters["gain"] - inertia
        return rotor(model.joints[0], more_of_it)
    added = [added_effort(effect, entry, model.dynamics, m) for m in motions]
    more = inertia_of([each for each in added if each is not None])
    if more is None or not inertia + more > 0.0:
        return None
    (gain,) = (kind for kind, each in KINDS.items() if each.path == "gain")
    return Effect(gain, list(model.joints), {"gain": inertia / (inertia + more)})


def _secant(model: InverseModel, kind: str, at, name: str) -> Candidate | None:
    steps = _STEPS.get(name, _DELAYS)
    what = KINDS[kind].channel
    if what == "delay" and all(c.endswith(".velocity") for c in at):
        steps = _VELOCITY_DELAYS
    base, columns = model.base(), []
    least = -np.inf
    if what == "lag":  # It can take from a declared filter what that has.
        least = -0.9 * min(model.declared_lag(c) for c in at)
    for step in steps:
        moved = model.residual([Effect(kind, list(at), {name: step})])
        columns.append(((base - moved) / step)[:, None])

    def read(c):
        return {name: max(float(c[0]), least)}

    if not any(np.abs(x).max(initial=0.0) > 0.0 for x in columns):
        return None
    readers = (read,) * len(columns)
    return Candidate(kind, tuple(at), 1, tuple(columns), readers)

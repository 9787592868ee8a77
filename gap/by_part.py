"""A robot whose limbs do not move each other, limb by limb.

The legs of a robot that is held by its base, the fingers of a hand: no equation of
motion of one has a joint of another in it. Each is searched and judged as a robot of
its own, in a fraction of the time, and one that is not explained spoils no other one's
verdict.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.data.recording import Recording
from makebreak.gap.data.split import Split
from makebreak.gap.result import AGREES, GapMeasure, GapResult, InUnits, NamedEffect
from makebreak.gap.said import called
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import full_name, one_dof_joints, sentence
from makebreak.models.scene import ActuationSection, Scene

SAME_Z = 3.0  # Deviations of both, within which one value is that of all limbs.


def limbs_of(
    dynamics: SceneDynamics, recordings: Sequence[Recording]
) -> list[list[str]]:
    """Joints that hang together, from the base outwards; one list of all joints where
    limbs cannot be told apart: something else is measured, or coupled."""
    plant = dynamics.plant
    joints = [j for j in one_dof_joints(plant) if j.num_velocities()]
    names = [full_name(plant, joint) for joint in joints]
    scene = dynamics.loaded.scene
    whole = plant.num_velocities() != len(joints) or plant.num_constraints()
    whole = whole or scene.initial_of or scene.friction_zones or scene.channels
    if whole or not {c.at for r in recordings for c in r.channels.values()} <= {*names}:
        return [names]
    moved = [
        frozenset(map(int, plant.GetBodiesKinematicallyAffectedBy([j.index()])))
        for j in joints
    ]
    roots = [m for m in moved if not any(m < other for other in moved)]
    return [
        [name for name, m in zip(names, moved, strict=True) if m <= root]
        for root in dict.fromkeys(roots)
    ]


def only(joints: Sequence[str], scene: Scene, parts: Split) -> tuple[Scene, Split]:
    """The scene in which all but these joints are welded where they are, and what was
    recorded of these."""
    others = [j for j in dict.fromkeys(_places(parts)) if j not in joints]
    act, said = scene.actuation, scene.initial
    kept = [k for k, joint in enumerate(act.joints) if joint in joints]

    def some(values: Sequence[float]) -> list[float]:
        return [values[k] for k in kept] if len(values) > 1 else list(values)

    supply = replace(act.supply, **{k: some(v) for k, v in vars(act.supply).items()})
    effects = []
    for effect in scene.effects:
        at = [a for a in effect.at if a not in others]
        if at:
            effects.append(replace(effect, at=at))
    scene = replace(
        scene,
        actuation=ActuationSection() if not kept else replace(
            act, joints=[act.joints[k] for k in kept], supply=supply,
            kp=some(act.kp), kd=some(act.kd), limit=some(act.limit),
            dead_band=some(act.dead_band), resolution=some(act.resolution),
        ),
        fixed_joints={**scene.fixed_joints,
                      **{j: said.positions.get(j, 0.0) for j in others}},
        initial=replace(
            said,
            positions={j: q for j, q in said.positions.items() if j not in others},
            velocities={j: v for j, v in said.velocities.items() if j not in others},
        ),
        effects=effects,
    )  # fmt: skip

    def of(recordings: Sequence[Recording]) -> list[Recording]:
        return [
            replace(r, channels={n: c for n, c in r.channels.items() if c.at in joints})
            for r in recordings
        ]

    return scene, Split(of(parts.decided), of(parts.reported))


def _places(parts: Split) -> list[str]:
    return [at for r in (*parts.decided, *parts.reported) for at in r.places()]


def joined(limbs: Sequence[Sequence[str]], results: Sequence[GapResult]) -> GapResult:
    """One result of all limbs: what each lacks, and which are not explained."""
    verdicts = [r.verdict for r in results]
    verdict = next(
        (v for v in ("gap_unnamed", "ambiguous", "gap_named", "not_judged")
         if v in verdicts), "no_gap",
    )  # fmt: skip
    results = _said_alike(results)
    effects = _effects(limbs, results)
    agree = [k for k, r in enumerate(results)
             if verdicts[k] in AGREES and r.gap.is_measured]  # fmt: skip
    words = [
        f"{_called(limbs[k])}: {r.says}"
        for k, r in enumerate(results) if k not in agree
    ]  # fmt: skip
    gap = pooled([r.gap for r in results])
    if agree:
        beyond = f"{gap.before:.3g}" if not words else ", ".join(
            f"{results[k].gap.before:.3g}" for k in agree
        )  # fmt: skip
        names = "; ".join(_called(limbs[k]) for k in agree)
        words.append(
            f"{names}: scene and recordings agree to within noise and tolerance "
            f"(held-out error {beyond} times the expected error)."
        )
    first = results[0]

    def all_of(what: str) -> list:
        return [each for r in results for each in getattr(r, what)]

    return replace(
        first, verdict=verdict, says=" ".join(words), effects=effects, gap=gap,
        background={k: v for r in results for k, v in r.background.items()},
        seconds={
            k: sum(r.seconds.get(k, 0.0) for r in results) for k in first.seconds
        },
        unfinished=tuple(dict.fromkeys(all_of("unfinished"))),
        checks=list(dict.fromkeys(all_of("checks"))),
        **{
            what: all_of(what)
            for what in ("where", "unexplained", "series", "candidates", "trust",
                         "channels", "nuisance_scene", "differs", "tried")
        },
    )  # fmt: skip


def _said_alike(results: Sequence[GapResult]) -> list[GapResult]:
    """The results, in which what limbs cannot tell apart is what most of them say, and
    of what as many say the first."""
    told = Counter((e.kind, e.at) for r in results for e in r.effects)
    rank = {name: (n, -k) for k, (name, n) in enumerate(told.items())}

    def alike(effect: NamedEffect) -> NamedEffect:
        ties = {(t.kind, tuple(t.at)): t for t in effect.indistinguishable_from}
        names = [(effect.kind, effect.at), *ties]
        most = max(names, key=lambda name: rank.get(name, (0, 0)))
        if most not in ties:
            return effect
        instead = ties.pop(most)
        others = (*ties.values(), effect.effect())
        if {len(effect.parameters), len(instead.parameters)} != {1}:
            return effect  # How sure the other one is was not asked.
        ((name, value),) = instead.parameters.items()
        (old,) = effect.parameters.values()
        unit = KINDS[instead.kind].parameter(name).unit
        if unit != old.unit:
            return effect
        estimate = replace(old, value=value)
        return _said(replace(
            effect, kind=instead.kind, at=tuple(instead.at),
            parameters={name: estimate}, indistinguishable_from=others,
        ))  # fmt: skip

    found = []
    for r in results:
        effects, words = [alike(e) for e in r.effects], r.says
        for old, new in zip(r.effects, effects, strict=True):
            words = words.replace(old.says, new.says)
            it, other = (called(e.effect()) for e in (old, new))
            for a, b in (("it", "it"), (it, other)):
                words = words.replace(f"distinguish {a} from {new.kind}",
                                      f"distinguish {b} from {old.kind}")  # fmt: skip
        found.append(replace(r, effects=effects, says=words))
    return found


def _called(limb: Sequence[str]) -> str:
    return limb[0] if len(limb) == 1 else f"{limb[0]} to {limb[-1]}"


def _effects(
    limbs: Sequence[Sequence[str]], results: Sequence[GapResult]
) -> list[NamedEffect]:
    """What is named of each limb: at all joints of a model where all limbs say the
    same, else at those of the limb."""
    found: list[NamedEffect] = []
    for k, result in enumerate(results):
        for effect in result.effects:
            model = effect.at[0]
            if len(effect.at) > 1 or "." in model or model == "world":
                alike = [o for o in found if _is_alike(effect, o)]
                if alike:
                    at = (*alike[0].at, *effect.at)
                    one = replace(_mean([alike[0], effect]), at=at)
                    found[found.index(alike[0])] = _said(one)
                elif not any(_is_same(effect, other) for other in found):
                    found.append(effect)
                continue
            like = [
                e for r in results for e in r.effects
                if (e.kind, e.at) == (effect.kind, effect.at) and _agrees(e, effect)
            ]  # fmt: skip
            if len(like) == len(results):
                if k == 0:
                    found.append(_mean(like))
            else:
                at = tuple(j for j in limbs[k] if j.startswith(f"{model}."))
                found.append(_said(replace(effect, at=at)))
    return found


def _is_same(one: NamedEffect, other: NamedEffect) -> bool:
    """Whether both are one thing that two limbs show (how gravity points)."""
    return (one.kind, one.at) == (other.kind, other.at)


def _is_alike(one: NamedEffect, other: NamedEffect) -> bool:
    """Whether joints of two limbs have, to within deviations, one value of a kind that
    the joints of each have alike."""
    many = min(len(one.at), len(other.at)) > 1 and one.kind == other.kind
    return many and KINDS[one.kind].at == "joint" and _agrees(one, other)


def _agrees(one: NamedEffect, other: NamedEffect) -> bool:
    return all(
        abs(p.value - q.value) <= SAME_Z * float(np.hypot(p.std, q.std))
        for p, q in zip(one.parameters.values(), other.parameters.values(), strict=True)
    )


def _mean(like: Sequence[NamedEffect]) -> NamedEffect:
    """Weighted by how sure each is."""
    parameters = {}
    for name, first in like[0].parameters.items():
        each = [e.parameters[name] for e in like]
        w = np.array([1.0 / max(p.std, 1e-300) ** 2 for p in each])
        w /= w.sum()
        parameters[name] = replace(
            first, value=float(w @ [p.value for p in each]),
            std=float(np.sqrt(w**2 @ np.square([p.std for p in each]))),
        )  # fmt: skip
    return _said(replace(like[0], parameters=parameters))


def _said(effect: NamedEffect) -> NamedEffect:
    """With the sentence of what it is now."""
    std = {name: p.std for name, p in effect.parameters.items()}
    says = sentence(effect.effect(), KINDS[effect.kind], std)
    return replace(effect, says=says[:1].upper() + says[1:] + ".")


def pooled(gaps: Sequence[GapMeasure]) -> GapMeasure:
    """One measure of windows that are not compared with each other: of recordings, or
    of limbs. Of a channel, those count that have it."""
    gaps = [g for g in gaps if g.is_measured] or list(gaps)
    weight = np.array([max(g.n_windows, 1) for g in gaps], float)

    def pool(some: Sequence[tuple[float, float]]) -> float:
        w, x = np.array(some, float).T
        return float(np.sqrt(np.sum(w * x**2) / w.sum()))

    def names(what: str) -> list[str]:
        return list(dict.fromkeys(n for g in gaps for n in getattr(g, what)))

    def of(what: str, name: str, when: str) -> float:
        known = []
        for w, g in zip(weight, gaps, strict=True):
            each = getattr(g, what).get(name)
            if each is not None:
                x = each[when] if isinstance(each, dict) else getattr(each, when)
                known.append((w, x))
        return pool(known)

    def in_units(what: str) -> dict[str, InUnits]:
        return {
            name: replace(
                next(getattr(g, what)[name] for g in gaps if name in getattr(g, what)),
                before=of(what, name, "before"), after=of(what, name, "after"),
            )
            for name in names(what)
        }  # fmt: skip

    return replace(
        gaps[0],
        before=pool([(w, g.before) for w, g in zip(weight, gaps, strict=True)]),
        after=pool([(w, g.after) for w, g in zip(weight, gaps, strict=True)]),
        per_channel={
            c: {w: of("per_channel", c, w) for w in ("before", "after")}
            for c in names("per_channel")
        },
        in_units=in_units("in_units"),
        equations=in_units("equations"),
        n_windows=sum(g.n_windows for g in gaps),
        failed=(sum(g.failed[0] for g in gaps), sum(g.failed[1] for g in gaps)),
        data="reported" if all(g.data == "reported" for g in gaps) else "chosen on",
        seconds=sum(g.seconds for g in gaps),
    )

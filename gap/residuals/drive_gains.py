"""Gains of drives that are known to a share only: nuisances, like masses of links.

A scene's `tolerance: {drive_gains: 0.05}` says how well they are known. What a drive's
stiffness and damping give may then be off by that share, and is no effect. Where it
does not say, they are known to KNOWN_TO.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from makebreak.models.drives import law_of
from makebreak.models.effects.drive_gains import more_damping, other_gain, other_kp
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import Scene

KEY = "drive_gains"  # Of a scene's `tolerance`.
# As masses of links: torque constants, and what loops at other rates make of a gain,
# differ by that much, and long logs show a fraction of it.
KNOWN_TO = 0.02
_STEP = 1e-3  # Of a gain, to see what it gives.


def gain_changes(
    scene: Scene, joints: Sequence[str]
) -> Iterator[tuple[str, Effect, float]]:
    """(name, effect, size) of each joint's stiffness and damping, more by the share
    `size` that they are known to; none where the scene has no such tolerance."""
    share = gains_known_to(scene)
    for joint in joints if share else ():
        yield from _changes(scene, joint, share)


def gains_known_to(scene: Scene) -> float:
    """The share of a gain to which it is taken to be known."""
    return float(scene.tolerance.get(KEY, KNOWN_TO))


def with_moved_gains(scene: Scene, names: Sequence[str], values) -> Scene:
    """The scene with its drives as nuisances `names` have them; values (n_b,) in shares
    of a gain."""
    found = dict(zip(names, values, strict=True))
    if not any(name.startswith(KEY) for name in found):
        return scene
    actuation = scene.actuation
    kp, kd = [], []
    for joint in actuation.joints:
        law = law_of(actuation, joint)
        if law is None:
            return scene
        more_kp, more_kd = (
            float(found.get(gain_name(joint, gain), 0.0)) for gain in ("kp", "kd")
        )
        kp.append(max(float(law.kp) * (1.0 + more_kp), 0.0))
        more = more_kd * float(law.kd + law.emf)
        kd.append(max(float(law.kd) + more, 0.0))
    return replace(scene, actuation=replace(actuation, kp=kp, kd=kd))


def gain_columns(model) -> tuple[list[np.ndarray], list[float], list[str]]:
    """Columns (m,) of the residual of an InverseModel, standard deviations and names:
    what each gain gives, per share of it.

    Equations are in units of what drives are told (InverseModel.gains_with). Else with
    gains and masses a tenth smaller all of an equation would be, and so would what no
    effect explains, noise included: a fit would take that for a gain, and frictions
    would come out as much too small.
    """
    columns, prior, names = [], [], []
    share = gains_known_to(model.scene)
    joints = [j for j, told in zip(model.joints, model.commanded, strict=True) if told]
    for joint in joints if share else ():
        i = model.joints.index(joint)
        for name, effect, size in _changes(model.scene, joint, _STEP):
            column = (model.base() - model.residual([effect])) / size
            if "damping" in effect.parameters and model.has["velocity_command"][i]:
                given = []  # Of a gain, not of damping: what follows the command.
                for track in model.tracks:
                    told = track.commands[f"{joint}.velocity_command"]
                    less = np.zeros((len(track.middle), len(model.joints), 1))
                    less[:, i, 0] = model.laws[i].kd * track.mean_held(told, 0.0)
                    given.append(less)
                column = column - model.columns_of(given)[:, 0]
            columns.append(column)
            prior.append(share)
            names.append(name)
    return columns, prior, names


def gain_name(joint: str, gain: str = "kp") -> str:
    """Of the nuisance."""
    return f"{KEY} of {joint}, {gain}"


def _changes(
    scene: Scene, joint: str, more: float
) -> Iterator[tuple[str, Effect, float]]:
    """(name, effect, more) of a joint's stiffness and damping, more by this share."""
    law = law_of(scene.actuation, joint)
    if law is None:
        return
    if not law.kp > 0.0:  # It follows velocities: all that it gives is by its damping.
        yield gain_name(joint, "kd"), other_gain(joint, 1.0 + more), more
        return
    stiffer = other_kp(joint, float(law.kp) * (1.0 + more))
    yield gain_name(joint, "kp"), stiffer, more
    if (damping := float(law.kd + law.emf)) > 0.0:
        yield gain_name(joint, "kd"), more_damping(joint, more * damping), more

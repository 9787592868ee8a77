"""compare.html: what was measured and both models, moving, in one page."""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    Cylinder,
    HalfSpace,
    Meshcat,
    MeshcatAnimation,
    Rgba,
    Role,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, DiagramBuilder

from makebreak.gap.data.recording import Episode, Recording
from makebreak.gap.report.clock import zero_of
from makebreak.gap.result import GapResult, Series
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.free_bodies import moved_on_smooth
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.effects.kind import full_name, one_dof_joints
from makebreak.models.scene import (
    InitialSection,
    LoadedScene,
    Scene,
    initial_for,
    load_scene,
)
from makebreak.systems.numerics.smoother import smooth_filtered

_LEAST_SEC = 1.5  # Of motion; a window alone is too short for the eye.
_WHOLE_SEC = 3.0  # An episode that is no longer is shown from its start.
_SHOWN_SEC = 4.0  # What is shorter is slowed down to last so long.
_FRAMES = 120
_SMOOTHED_SEC = 0.25  # On either side of the start.
_QUATERNION = ("qw", "qx", "qy", "qz")
_COLOURS = {
    "measured": Rgba(0.62, 0.66, 0.72, 0.45),
    "before": Rgba(0.85, 0.50, 0.20, 0.9),
    "after": Rgba(0.17, 0.42, 0.69, 0.9),
}
_STILL = Rgba(0.82, 0.82, 0.80, 1.0)


@dataclass(frozen=True, eq=False)
class Motion:
    """Joint positions and free bodies' poses, a row a frame; NaN where unknown.

    columns: {`<model>.<joint>.position` or `<model>.<body>.qw`, ...: (n,)}.
    """

    time: np.ndarray  # (n,) [s]
    columns: Mapping[str, np.ndarray]


def comparison_html(
    result: GapResult, scene: Scene, recordings: Sequence[Recording]
) -> str | None:
    """The page: measured as a ghost, the scene as it came, and with the effects.

    Shown is a stretch that holds the worst held-out window, simulated in one go from
    the measured state at its start.

    Returns: None if there is nothing to show, or no place for Drake's viewer.
    """
    found = _stretch(result, recordings)
    if found is None:
        return None
    recording, episode, start, end = found
    said = initial_for(scene, str(recording.path), episode.number)
    scene = replace(scene, initial=said, initial_of={})
    repaired = replace(scene, effects=[*scene.effects, *result.scene_effects()])
    scenes = {"before": scene} | ({"after": repaired} if result.effects else {})
    times = np.linspace(start, end, _FRAMES)
    loaded = {name: load_scene(s, DiagramBuilder()) for name, s in scenes.items()}
    names = _position_channels(loaded["before"].plant)
    measured = _measured(recording, episode, times, names)
    if not any(np.isfinite(v).any() for v in measured.columns.values()):
        return None
    initial = measured_state(recording, episode, start, loaded["before"].plant)
    motions = {
        name: _rolled(loaded[name], initial, times)
        or _simulated(s, recording, episode, initial, times, names)
        for name, s in scenes.items()
    }
    best = motions.get("after", motions["before"])
    filled = {
        name: np.where(np.isfinite(value), value, best.columns[name])
        for name, value in measured.columns.items()
    }
    loaded = {"measured": loaded.get("after", loaded["before"])} | loaded
    motions = {"measured": Motion(times, filled)} | motions
    meshcat = _quiet_meshcat()
    if meshcat is None:
        return None
    slow = max(1.0, _SHOWN_SEC / (end - start))
    _draw(meshcat, loaded, motions, slow)
    page = meshcat.StaticHtml()
    zero = zero_of(float(recording.time[0]))
    where = f"{start - zero:.2f} - {end - zero:.2f} s of {recording.name}, "
    where += f"episode {episode.number}"
    return _with_legend(page, list(scenes), where, slow)


def measured_state(
    recording: Recording, episode: Episode, time: float, plant: MultibodyPlant
) -> InitialSection:
    """The measured state at a time, smoothed; what is not measured is left out."""
    initial = InitialSection()
    for joint in one_dof_joints(plant):
        name = full_name(plant, joint)
        found = _value_and_rate(recording, episode, f"{name}.position", time)
        if found is not None:
            initial.positions[name] = found[0]
            initial.velocities[name] = found[1]
    for index in plant.GetFloatingBaseBodies():
        name = full_name(plant, plant.get_body(index))
        xyz = [_value_and_rate(recording, episode, f"{name}.{a}", time) for a in "xyz"]
        if f"{name}.z" not in recording:  # A camera from above sees no height.
            at = plant.get_body(index).floating_positions_start() + 6
            xyz[2] = (float(plant.GetPositions(plant.CreateDefaultContext())[at]), 0.0)
        if any(each is None for each in xyz):
            continue
        p = [each[0] for each in xyz if each is not None]
        v = [each[1] for each in xyz if each is not None]
        q, w = _turning(recording, episode, name, time)
        initial.poses[name] = [*q, *p]
        initial.body_velocities[name] = [*w, *v]
    return initial


def _stretch(
    result: GapResult, recordings: Sequence[Recording]
) -> tuple[Recording, Episode, float, float] | None:
    """The recording, its episode and the times from and to which it is shown."""
    worst: tuple[float, Series | None, float] = (-1.0, None, 0.0)
    for each in result.series:
        cuts = [0, *sorted({int(s) for s in each.starts if s > 0}), len(each.time)]
        error = (each.measured - each.before) / max(each.noise, 1e-300)
        for a, b in zip(cuts[:-1], cuts[1:], strict=True):
            part = error[a:b][np.isfinite(error[a:b])]
            size = float(np.mean(part**2)) if part.size else -1.0
            if size > worst[0]:
                worst = (size, each, float(each.time[a]))
    _, series, start = worst
    if series is None:
        return None
    for recording in recordings:
        for episode in recording.episodes:
            time = recording.time[episode.rows]
            if (recording.name, episode.number) != (series.recording, series.episode):
                continue
            if not time[0] <= start < time[-1]:
                continue
            first, last = float(time[0]), float(time[-1])
            if last - first <= _WHOLE_SEC:
                return recording, episode, first, last
            length = max(_LEAST_SEC, 2.0 * result.gap.window_s)
            start = max(min(start, last - length), first)
            return recording, episode, start, min(start + length, last)
    return None


def _position_channels(plant: MultibodyPlant) -> list[str]:
    names = [
        f"{full_name(plant, joint)}.position"
        for joint in one_dof_joints(plant)
        if not full_name(plant, joint).startswith("motor_of_")
    ]
    for index in sorted(plant.GetFloatingBaseBodies(), key=int):
        name = full_name(plant, plant.get_body(index))
        names += [f"{name}.{each}" for each in (*_QUATERNION, *"xyz")]
    return names


def _measured(
    recording: Recording, episode: Episode, times: np.ndarray, names: Sequence[str]
) -> Motion:
    columns = {}
    for name in names:
        columns[name] = np.full(len(times), np.nan)
        if name in recording:
            t, value = recording.samples(name, episode)
            if len(t):
                columns[name] = np.interp(times, t, value)
    return Motion(times, columns)


def _rolled(
    loaded: LoadedScene, initial: InitialSection, times: np.ndarray
) -> Motion | None:
    """Of free bodies on a smooth surface that plates stand for, as they were judged:
    Drake's knock at the edges. None: there is no such surface."""
    poses = moved_on_smooth(loaded, initial, times)
    if poses is None:
        return None
    columns = {
        f"{name}.{c}": pose[:, k]
        for name, pose in poses.items()
        for k, c in enumerate((*_QUATERNION, *"xyz"))
    }
    return Motion(times, columns)


def _simulated(scene, recording, episode, initial, times, names) -> Motion:
    rows = episode.rows
    columns = {c.name: c.values[rows] for c in recording.commands()}
    commands = Commands(recording.time[rows], columns)
    simulation = SceneSimulation(scene)
    for body in initial.poses:
        if f"{body}.z" not in recording:
            initial = simulation.put_down(initial, body)
    values = simulation.run(initial, times, names, commands)
    for column in values.T:  # Before a delayed channel shows anything; after a failure.
        good = np.isfinite(column)
        if good.any() and not good.all():
            known = np.flatnonzero(good)
            column[:] = np.interp(np.arange(len(column)), known, column[good])
    return Motion(times, dict(zip(names, values.T, strict=True)))


def _value_and_rate(
    recording: Recording, episode: Episode, channel: str, time: float
) -> tuple[float, float] | None:
    if channel not in recording:
        return None
    t, value = recording.samples(channel, episode)
    near = np.flatnonzero(np.abs(t - time) <= _SMOOTHED_SEC)
    if len(near) < 8:  # Slow sensors: as many as it takes.
        near = np.sort(np.argsort(np.abs(t - time))[:8])
    t, value = t[near], value[near]
    if len(t) < 6:
        return None
    at = np.unique(np.append(t, time))
    samples = np.full(len(at), np.nan)
    samples[np.searchsorted(at, t)] = value
    own = recording.channels[channel]
    found = smooth_filtered(at, samples, max(own.noise, 1e-12), own.stages or ())
    k = int(np.searchsorted(at, time))
    return float(found.x[k, 0]), float(found.x[k, 1])


def _turning(recording, episode, name, time) -> tuple[list[float], list[float]]:
    """Orientation [qw qx qy qz] and angular velocity, world axes [rad/s]."""
    found = [_value_and_rate(recording, episode, f"{name}.{c}", time)
             for c in _QUATERNION]  # fmt: skip
    if any(each is None for each in found):
        return [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    q = np.array([each[0] for each in found if each is not None])
    rate = np.array([each[1] for each in found if each is not None])
    size = np.linalg.norm(q)
    if size < 0.5:  # The signs of neighbouring samples differ.
        return [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    q, rate = q / size, rate / size
    rate -= (rate @ q) * q
    # w = 2 dq/dt conj(q).
    w = 2.0 * (-rate[0] * q[1:] + q[0] * rate[1:] - np.cross(rate[1:], q[1:]))
    return q.tolist(), w.tolist()


# ----- Drawing


def _quiet_meshcat() -> Meshcat | None:
    log = logging.getLogger("drake")
    level = log.level
    log.setLevel(logging.WARNING)  # It would tell an address that is soon gone.
    try:
        return Meshcat()
    except RuntimeError:
        return None
    finally:
        log.setLevel(level)


def _draw(
    meshcat: Meshcat,
    loaded: Mapping[str, LoadedScene],
    motions: Mapping[str, Motion],
    slow: float,
) -> None:
    start = next(iter(motions.values())).time[0]
    meshcat.SetProperty("/Background", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Grid", "visible", False)  # From below it hides what moves.
    meshcat.StartRecording(
        frames_per_second=_FRAMES / _SHOWN_SEC, set_visualizations_while_recording=False
    )
    seen: list[np.ndarray] = []
    for who, one in loaded.items():
        moving, still = _shapes(one)
        if who == "measured":
            for path, body, pose, shape in still:
                _put(meshcat, f"/scene/{path}", shape, _STILL, pose)
                meshcat.SetTransform(f"/scene/{path}", body @ pose)
        for path, _, pose, shape in moving:
            _put(meshcat, f"/{who}/{path}", shape, _COLOURS[who], pose)
        plant, context = one.plant, one.plant.CreateDefaultContext()
        bodies = {path.split("/")[0]: body for path, body, _, _ in moving}
        for row, now in enumerate(motions[who].time):
            _set_positions(plant, context, motions[who].columns, row)
            for path, body in bodies.items():
                X_WB = plant.EvalBodyPoseInWorld(context, body)
                meshcat.SetTransform(f"/{who}/{path}", X_WB, (now - start) * slow)
                if who == "measured":
                    seen += [
                        X_WB @ pose.translation()
                        for other, _, pose, _ in moving
                        if other.split("/")[0] == path
                    ]
    animation = meshcat.get_mutable_recording()
    animation.set_autoplay(True)
    animation.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    animation.set_repetitions(10_000)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    if seen:
        low, high = np.min(seen, axis=0), np.max(seen, axis=0)
        target = 0.5 * (low + high)
        away = 0.9 * max(float(np.linalg.norm(high - low)), 0.4)
        meshcat.SetCameraPose(target + away * np.array([0.9, -1.1, 0.6]), target)


def _put(meshcat: Meshcat, path: str, shape, colour: Rgba, pose: RigidTransform):
    try:
        meshcat.SetObject(path, shape, colour)
    except RuntimeError:  # A mesh that cannot be read: the rest is still worth it.
        return
    meshcat.SetTransform(path, pose)


def _shapes(loaded: LoadedScene) -> tuple[list, list]:
    """(path, body, pose in it, shape) of what moves, and of what stands still (with
    the body's pose in world in place of the body). A body without a shape to be seen
    shows those it touches with; a mechanism of balls, or of nothing, has rods."""
    plant = loaded.plant
    inspector = loaded.scene_graph.model_inspector()
    context = plant.CreateDefaultContext()
    moving: list = []
    still: list = []
    for i in range(1, plant.num_bodies()):
        body = plant.get_body(BodyIndex(i))
        frame = plant.GetBodyFrameIdIfExists(body.index())
        if frame is None:
            continue
        geometries = inspector.GetGeometries(frame, Role.kIllustration)
        geometries = geometries or inspector.GetGeometries(frame, Role.kProximity)
        name = _path(full_name(plant, body))
        for k, geometry in enumerate(geometries):
            shape = inspector.GetShape(geometry)
            if isinstance(shape, HalfSpace):
                continue
            pose = inspector.GetPoseInFrame(geometry)
            path = f"{name}/{k}"
            if plant.IsAnchored(body):
                X_WB = plant.EvalBodyPoseInWorld(context, body)
                still.append((f"{name}_{k}", X_WB, pose, shape))
            else:
                moving.append((path, body, pose, shape))
    # Balls alone hang in the air: a mechanism is seen by what joins them.
    if all(isinstance(shape, Sphere) for *_, shape in moving):
        sticks = _sticks(plant, context)
        moving += [s for s in sticks if not (s[1].is_floating_base_body() and moving)]
    return moving, still


def _sticks(plant: MultibodyPlant, context: Context) -> list:
    """Of each body that moves: rods from its origin to the joints that it carries, or
    to its centre of mass, and a ball there."""
    found = []
    joints = [plant.get_joint(i) for i in plant.GetJointIndices()]
    for i in range(1, plant.num_bodies()):
        body = plant.get_body(BodyIndex(i))
        name = full_name(plant, body)
        if plant.IsAnchored(body) or name.startswith(("motor_of_", "payload_on_")):
            continue
        ends = [
            joint.frame_on_parent().GetFixedPoseInBodyFrame().translation()
            for joint in joints
            if joint.parent_body().index() == body.index()
        ]
        ends = [end for end in ends if np.linalg.norm(end) > 1e-3]
        if not ends:
            ends = [body.CalcCenterOfMassInBodyFrame(context)]
        size = max(float(np.linalg.norm(end)) for end in ends)
        for k, end in enumerate(ends):
            length = float(np.linalg.norm(end))
            thick = 0.03 * max(size, 0.05)
            if length > 1e-3:
                z = RotationMatrix.MakeFromOneVector(end, 2)
                rod = Cylinder(thick, length)
                pose = RigidTransform(z, 0.5 * end)
                found.append((f"{_path(name)}/rod_{k}", body, pose, rod))
            ball = Sphere(2.0 * thick)
            found.append((f"{_path(name)}/end_{k}", body, RigidTransform(end), ball))
    return found


def _set_positions(plant, context, columns: Mapping[str, np.ndarray], row: int):
    q = plant.GetPositions(context)
    for joint in one_dof_joints(plant):
        value = columns.get(f"{full_name(plant, joint)}.position")
        if value is not None and np.isfinite(value[row]):
            q[joint.position_start()] = value[row]
    for index in plant.GetFloatingBaseBodies():
        body = plant.get_body(index)
        name, at = full_name(plant, body), body.floating_positions_start()
        turn = np.array([columns[f"{name}.{c}"][row] for c in _QUATERNION])
        if np.isfinite(turn).all() and np.linalg.norm(turn) > 1e-3:
            q[at : at + 4] = Quaternion(turn / np.linalg.norm(turn)).wxyz()
        place = np.array([columns[f"{name}.{a}"][row] for a in "xyz"])
        if np.isfinite(place).all():
            q[at + 4 : at + 7] = place
    plant.SetPositions(context, q)


def _path(name: str) -> str:
    return re.sub(r"[^\w]", "_", name)


def _with_legend(page: str, models: Sequence[str], where: str, slow: float) -> str:
    says = {"before": "the given model", "after": "with the named effects"}

    def dot(who: str) -> str:
        c = _COLOURS[who]
        rgb = ",".join(str(round(255 * x)) for x in (c.r(), c.g(), c.b()))
        return f'<span style="color:rgb({rgb})">&#9679;</span>'

    lines = [f"{dot('measured')} measured"]
    lines += [f"{dot(who)} {who}: {says[who]}" for who in models]
    pace = "" if slow == 1.0 else f", at {1.0 / slow:.2g} times real time"
    lines.append(f"{where}{pace}. All start from the measured state.")
    box = (
        '<div style="position:fixed;left:14px;top:12px;z-index:10;padding:8px 12px;'
        "font:14px/1.5 system-ui,sans-serif;background:rgba(255,255,255,.88);"
        f'border-radius:4px">{"<br>".join(lines)}</div>'
    )
    return page.replace("</body>", f"{box}</body>", 1)

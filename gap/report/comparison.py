"""compare.html: what was measured and both models, moving, in one page.

What moves are the windows of the report (GapResult.series): nothing is simulated here.
"""

import json
import logging
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    Cylinder,
    HalfSpace,
    Mesh,
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

from makebreak.gap.data.recording import Recording
from makebreak.gap.report.clock import zero_of
from makebreak.gap.result import GapResult, Series, plain
from makebreak.models.effects.kind import (
    full_name,
    is_added,
    model_of,
    one_dof_joints,
    sliding_joints,
)
from makebreak.models.meshes import coarse
from makebreak.models.scene import LoadedScene, Scene, initial_for, load_scene

_WINDOW_SEC = 1.0  # What is shorter is slowed down to last so long, on average.
_HELD_SEC = 0.4  # At a window's end, where models are farthest from what was measured.
_JUMP_SEC = 1e-3  # From there to the start of the next one.
_FRAMES = 360
_QUATERNION = ("qw", "qx", "qy", "qz")
COLOURS = {
    "measured": Rgba(0.62, 0.66, 0.72, 0.45),
    "before": Rgba(0.85, 0.50, 0.20, 0.9),
    "after": Rgba(0.17, 0.42, 0.69, 0.9),
}
STILL = Rgba(0.82, 0.82, 0.80, 1.0)
_SAYS = {"before": "the given model", "after": "with the named effects"}


@dataclass(frozen=True, eq=False)
class Motion:
    """Coordinates in the windows that are shown, a row a sample.

    time (n,) [s]; starts: rows at which a window begins; columns: {"measured",
    "before", "after": {`<model>.<joint>.position`, `<model>.<body>.qw`, ...: (n,)}},
    NaN where not known; led: joints whose measured motion was prescribed. left_out:
    windows that a model could not be simulated through.
    """

    recording: str
    episode: int
    time: np.ndarray
    starts: np.ndarray
    columns: Mapping[str, Mapping[str, np.ndarray]]
    led: Sequence[str]
    left_out: int


def comparison(
    result: GapResult, scene: Scene, recordings: Sequence[Recording]
) -> tuple[Motion, dict[str, LoadedScene]] | None:
    """What moves in the windows of the report, and {"before", "after" (if anything was
    named), "measured": the scene in which it does}; None if no motion was simulated."""
    own = load_scene(scene, DiagramBuilder())
    motion = shown_motion(result, own.plant, recordings)
    if motion is None:
        return None
    path = {r.name: str(r.path) for r in recordings}.get(motion.recording, "")
    said = initial_for(scene, path, motion.episode)
    scene = replace(scene, initial=said, initial_of={})
    loaded = {"before": load_scene(scene, DiagramBuilder())}
    if result.effects:
        effects = [*scene.effects, *result.effects_in(motion.recording)]
        repaired = replace(scene, effects=effects)
        loaded["after"] = load_scene(repaired, DiagramBuilder())
    return motion, {**loaded, "measured": loaded.get("after", loaded["before"])}


def comparison_html(
    result: GapResult, scene: Scene, recordings: Sequence[Recording]
) -> str | None:
    """The page: measured as a ghost, the scene as it came, and with the effects, in the
    windows of the report, with their error as a number.

    Returns: None if no motion was simulated, or there is no place for Drake's viewer.
    """
    compared = comparison(result, scene, recordings)
    if compared is None:
        return None
    motion, drawn = compared
    meshcat = _quiet_meshcat()
    if meshcat is None:
        return None
    rows, play, slow = _frames(motion)
    _draw(meshcat, drawn, motion, rows, play)
    zeros = {r.name: zero_of(float(r.time[0])) for r in recordings}
    zero = zeros.get(motion.recording, 0.0)
    sliding = sliding_joints(drawn["before"].plant)
    errors = {who: errors_of(motion, who, sliding) for who in drawn if who in _SAYS}
    return _with_numbers(meshcat.StaticHtml(), motion, errors, rows, play, zero, slow)


def shown_motion(
    result: GapResult, plant: MultibodyPlant, recordings: Sequence[Recording]
) -> Motion | None:
    """The coordinates of a plant in the report's windows, of the recording whose
    windows are farthest off; None where no coordinate was simulated. Limbs may have
    windows of their own: what moves in others is shown as it was measured."""
    wanted = _position_channels(plant)
    groups: dict[tuple[str, int, bytes], list[Series]] = {}
    for each in result.series:
        if each.channel in wanted:
            key = each.recording, each.episode, each.time.tobytes()
            groups.setdefault(key, []).append(each)
    if not groups or result.gap.window_s <= 0.0:
        return None
    some = max(groups.values(), key=lambda g: max(map(_off, g)))
    first = some[0]
    n = len(first.time)
    cuts = [0, *sorted({int(s) for s in first.starts if 0 < s < n}), n]
    kept: list[np.ndarray] = []
    starts, left_out = [], 0
    for a, b in zip(cuts[:-1], cuts[1:], strict=True):
        both = [y[a:b] for each in some for y in (each.before, each.after)]
        if any(np.isinf(y).any() or not np.isfinite(y).any() for y in both):
            left_out += 1
            continue
        starts.append(sum(len(rows) for rows in kept))
        kept.append(np.arange(a, b))
    if not kept:
        return None
    rows = np.concatenate(kept)
    time = first.time[rows]
    columns: dict[str, dict[str, np.ndarray]] = {w: {} for w in COLOURS}
    for each in some:
        for who, of in columns.items():
            of[each.channel] = getattr(each, who)[rows]
    led = []
    for name in wanted:
        if name not in columns["measured"]:
            value = _measured(recordings, first, name, time)
            if np.isfinite(value).any():
                led.append(name)
                for of in columns.values():
                    of[name] = value
    joints = [
        name.removesuffix(".position") for name in led if name[-9:] == ".position"
    ]
    return Motion(
        first.recording, first.episode, time, np.array(starts), columns, joints,
        left_out,
    )  # fmt: skip


def errors_of(
    motion: Motion, who: str, sliding: Collection[str] = ()
) -> dict[str, tuple[str, np.ndarray]]:
    """{joint, `<body> place` or `<body> turn`: (unit, (n,) size of measured minus
    simulated)} of a model; NaN where nothing was measured. sliding: joints in metres.
    """
    seen, simulated = motion.columns["measured"], motion.columns[who]
    led = {f"{joint}.position" for joint in motion.led}
    off = {c: seen[c] - simulated[c] for c in simulated if c not in led}
    found = {}
    for at in dict.fromkeys(c.rsplit(".", 1)[0] for c in off):
        if f"{at}.position" in off:
            unit = "m" if at in sliding else "rad"
            found[at] = unit, np.abs(off[f"{at}.position"])
            continue
        place = [off[f"{at}.{a}"] for a in "xyz" if f"{at}.{a}" in off]
        if place:
            found[f"{at} place"] = "m", np.linalg.norm(place, axis=0)
        if all(f"{at}.{c}" in off for c in _QUATERNION):
            q, p = (
                np.stack([of[f"{at}.{c}"] for c in _QUATERNION])
                for of in (seen, simulated)
            )
            q, p = (x / np.linalg.norm(x, axis=0) for x in (q, p))
            apart = np.minimum(
                np.linalg.norm(q - p, axis=0), np.linalg.norm(q + p, axis=0)
            )
            found[f"{at} turn"] = "rad", 4.0 * np.arcsin(np.minimum(0.5 * apart, 1.0))
    return {k: e for k, e in found.items() if np.isfinite(e[1]).any()}


def _off(each: Series) -> float:
    """Rms error before, over the noise of a sample."""
    error = (each.measured - each.before) / max(each.noise, 1e-300)
    good = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(good**2))) if good.size else -1.0


def _position_channels(plant: MultibodyPlant) -> list[str]:
    names = [
        f"{full_name(plant, joint)}.position"
        for joint in one_dof_joints(plant)
        if not is_added(model_of(plant, joint))
    ]
    for index in sorted(plant.GetFloatingBaseBodies(), key=int):
        name = full_name(plant, plant.get_body(index))
        names += [f"{name}.{each}" for each in (*_QUATERNION, *"xyz")]
    return names


def _measured(
    recordings: Sequence[Recording], like: Series, name: str, time: np.ndarray
) -> np.ndarray:
    for recording in recordings:
        for episode in recording.episodes:
            same = (recording.name, episode.number) == (like.recording, like.episode)
            if same and name in recording:
                t, value = recording.samples(name, episode)
                if len(t):
                    return np.interp(time, t, value)
    return np.full(len(time), np.nan)


def _frames(motion: Motion) -> tuple[np.ndarray, np.ndarray, float]:
    """(m,) rows, (m,) when each is shown [s], and how many times slower than it was:
    a window after the other, each held at its end."""
    ends = [*motion.starts[1:], len(motion.time)]
    spans = list(zip(motion.starts, ends, strict=True))
    seconds = sum(motion.time[b - 1] - motion.time[a] for a, b in spans)
    slow = max(1.0, _WINDOW_SEC * len(spans) / max(seconds, 1e-9))
    most = max(_FRAMES // len(spans), 2)
    rows, play, now = [], [], 0.0
    for a, b in spans:
        mine = np.unique(np.linspace(a, b - 1, min(most, b - a)).round().astype(int))
        at = now + slow * (motion.time[mine] - motion.time[a])
        rows += [*mine, b - 1]
        play += [*at, at[-1] + _HELD_SEC]
        now = play[-1] + _JUMP_SEC
    return np.array(rows), np.array(play), slow


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
    motion: Motion,
    rows: np.ndarray,
    play: np.ndarray,
) -> None:
    """Args: loaded: who is shown, what was measured last. rows (m,), play (m,): as of
    _frames."""
    meshcat.SetProperty("/Background", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Grid", "visible", False)  # From below it hides what moves.
    meshcat.StartRecording(
        frames_per_second=1.0 / _JUMP_SEC, set_visualizations_while_recording=False
    )
    seen: list[np.ndarray] = []
    behind: list[np.ndarray] = []
    for who, one in loaded.items():
        moving, still = shapes_of(one)
        if who == "measured":
            for path, body, pose, shape in still:
                _put(meshcat, f"/scene/{path}", shape, STILL, pose)
                meshcat.SetTransform(f"/scene/{path}", body @ pose)
                behind.append((body @ pose).translation())
        for path, _, pose, shape in moving:
            _put(meshcat, f"/{who}/{path}", shape, COLOURS[who], pose)
        plant, context = one.plant, one.plant.CreateDefaultContext()
        bodies = {path.split("/")[0]: body for path, body, _, _ in moving}
        columns = {
            name: between_samples(value, motion)
            for name, value in motion.columns[who].items()
        }
        for row, now in zip(rows, play, strict=True):
            set_positions(plant, context, columns, row)
            for path, body in bodies.items():
                X_WB = plant.EvalBodyPoseInWorld(context, body)
                meshcat.SetTransform(f"/{who}/{path}", X_WB, float(now))
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
        away = 0.75 * max(float(np.linalg.norm(high - low)), 0.4)
        meshcat.SetCameraPose(target + away * _side(target, behind), target)


def _side(target: np.ndarray, behind: list[np.ndarray]) -> np.ndarray:
    """(3,) From where to look at target (3,) [m]: what stands still, about the points
    behind, is not to hide what moves."""
    way = np.zeros(2) if not behind else (target - np.mean(behind, axis=0))[:2]
    angles = np.deg2rad(-50.0 + 45.0 * np.array([0, 1, -1, 2, -2, 3, -3, 4]))
    sides = np.column_stack([np.cos(angles), np.sin(angles)])
    free = sides @ way
    # The first of those that are about as free.
    best = sides[np.argmax(free > free.max() - 0.3 * np.linalg.norm(way) - 1e-9)]
    return np.array([*(1.42 * best), 0.6])


def _put(meshcat: Meshcat, path: str, shape, colour: Rgba, pose: RigidTransform):
    try:
        if isinstance(shape, Mesh) and shape.source().is_path():
            # As it is, it would be in the page several times, with all its texts.
            vertices, faces = coarse(shape.source().path())
            meshcat.SetTriangleMesh(
                path, np.asfortranarray((vertices * shape.scale3()).T),
                np.asfortranarray(faces.T.astype(np.int32)), colour,
            )  # fmt: skip
        else:
            meshcat.SetObject(path, shape, colour)
    except (RuntimeError, ValueError):  # A mesh that cannot be read: not the page.
        return
    meshcat.SetTransform(path, pose)


def shapes_of(loaded: LoadedScene) -> tuple[list, list]:
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
        if plant.IsAnchored(body) or is_added(name):
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


def between_samples(value: np.ndarray, motion: Motion) -> np.ndarray:
    """(n,) with a line between what is known in a window: slow sensors have few rows,
    and before a delayed channel shows anything it stands still."""
    out = np.array(value)
    for a, b in zip(motion.starts, [*motion.starts[1:], len(out)], strict=True):
        good = np.flatnonzero(np.isfinite(out[a:b]))
        if len(good):
            out[a:b] = np.interp(np.arange(b - a), good, out[a:b][good])
    return out


def set_positions(plant, context, columns: Mapping[str, np.ndarray], row: int):
    q = plant.GetPositions(context)
    for joint in one_dof_joints(plant):
        value = columns.get(f"{full_name(plant, joint)}.position")
        if value is not None and np.isfinite(value[row]):
            q[joint.position_start()] = value[row]
    for index in plant.GetFloatingBaseBodies():
        body = plant.get_body(index)
        name, at = full_name(plant, body), body.floating_positions_start()
        unknown = np.full(row + 1, np.nan)
        turn = np.array([columns.get(f"{name}.{c}", unknown)[row] for c in _QUATERNION])
        if np.isfinite(turn).all() and np.linalg.norm(turn) > 1e-3:
            q[at : at + 4] = Quaternion(turn / np.linalg.norm(turn)).wxyz()
        for k, a in enumerate("xyz"):
            if np.isfinite(value := columns.get(f"{name}.{a}", unknown)[row]):
                q[at + 4 + k] = value
    plant.SetPositions(context, q)


def _path(name: str) -> str:
    return re.sub(r"[^\w]", "_", name)


def _with_numbers(
    page: str,
    motion: Motion,
    errors: Mapping[str, Mapping[str, tuple[str, np.ndarray]]],
    rows: np.ndarray,
    play: np.ndarray,
    zero: float,
    slow: float,
) -> str:
    """The page with a legend, and with the error of each model as it is at the time
    that the player shows."""

    def dot(who: str) -> str:
        c = COLOURS[who]
        rgb = ",".join(str(round(255 * x)) for x in (c.r(), c.g(), c.b()))
        return f'<span style="color:rgb({rgb})">&#9679;</span>'

    n = len(motion.starts)
    start, end = motion.time[0] - zero, motion.time[-1] - zero
    lines = [f"{dot('measured')} measured"]
    lines += [
        f"{dot(who)} {who}: {_SAYS[who]}<br>&emsp;error <b id=error_{who}></b>; "
        f"rms over all that is shown {_rms(of)}"
        for who, of in errors.items()
    ]
    pace = "" if slow == 1.0 else f", at {1.0 / slow:.2g} times real time"
    lines.append("<span id=shown_time></span>")
    lines.append(
        f"{start:.2f} - {end:.2f} s of {motion.recording}, episode {motion.episode}"
        f"{pace}: the report's windows of held-out data. Each model starts again from "
        f"the measured state {'once' if n == 1 else f'{n} times'}."
    )
    if motion.led:
        lines.append(f"Prescribed as measured: {', '.join(motion.led)}.")
    if motion.left_out:
        lines.append(
            f"Left out: {motion.left_out} that could not be simulated to their end."
        )
    window = np.searchsorted(motion.starts, rows, "right")
    since = motion.time[rows] - motion.time[motion.starts[window - 1]]
    says = {
        f"error_{who}": [_largest(of, motion, row) for row in rows]
        for who, of in errors.items()
    }
    says["shown_time"] = [
        f"{motion.time[row] - zero:.3f} s: {ago:.3f} s after start {k} of {n}"
        for row, k, ago in zip(rows, window, since, strict=True)
    ]
    order = [*errors, "measured"]  # As they are drawn: what was measured last.
    script = _SCRIPT % {
        "play": json.dumps([round(float(t), 6) for t in play]),
        "says": json.dumps(says),
        "order": json.dumps(order),
    }
    box = (
        '<div id="numbers" style="position:fixed;left:14px;bottom:12px;z-index:10;'
        "padding:8px 12px;"
        "max-width:46em;font:14px/1.5 system-ui,sans-serif;"
        "font-variant-numeric:tabular-nums;background:rgba(255,255,255,.88);"
        f'border-radius:4px">{"<br>".join(lines)}</div>'
    )
    return page.replace("</body>", f"{box}<script>{script}</script></body>", 1)


# At one place surfaces of several models would flicker through each other: each is
# moved a little towards the eye before the one that is drawn before it.
_SCRIPT = """
const shown = {play: %(play)s, says: %(says)s, order: %(order)s};
const small = location.hash == "#small";  // Inside the report: the motion alone.
if (small) {
  document.getElementById("numbers").style.display = "none";
  viewer.gui.hide();
}
function show() {
  if (small && viewer.animator.time >= viewer.animator.duration) {
    viewer.animator.seek(0);
    viewer.animator.play();
  }
  const now = viewer.animator.time + 1e-6;
  let k = shown.play.length - 1;
  while (k > 0 && shown.play[k] > now) k -= 1;
  for (const [id, texts] of Object.entries(shown.says))
    document.getElementById(id).textContent = texts[k];
  shown.order.forEach((who, place) => {
    viewer.scene_tree.find([who]).object.traverse((each) => {
      each.renderOrder = place + 1;
      for (const m of each.material ? [each.material].flat() : []) {
        m.polygonOffset = true;
        m.polygonOffsetFactor = m.polygonOffsetUnits = -2 * place;
      }
    });
  });
  requestAnimationFrame(show);
}
show();
"""


def _largest(of: Mapping[str, tuple[str, np.ndarray]], motion: Motion, row: int) -> str:
    """The largest error of each unit at a row, or at the last one before it in its
    window at which it was measured."""
    first = motion.starts[np.searchsorted(motion.starts, row, "right") - 1]
    best: dict[str, tuple[float, str]] = {}
    for name, (unit, error) in of.items():
        past = error[first : row + 1]
        past = past[np.isfinite(past)]
        if past.size and past[-1] >= best.get(unit, (-1.0, ""))[0]:
            best[unit] = float(past[-1]), name
    return (
        ", ".join(
            f"{plain(size, unit)} ({name})" for unit, (size, name) in best.items()
        )
        or "-"
    )


def _rms(of: Mapping[str, tuple[str, np.ndarray]]) -> str:
    """Of each unit, of the joint or body that is farthest off."""
    best: dict[str, float] = {}
    for unit, error in of.values():
        size = float(np.sqrt(np.nanmean(error**2)))
        best[unit] = max(size, best.get(unit, 0.0))
    return ", ".join(plain(size, unit) for unit, size in best.items())

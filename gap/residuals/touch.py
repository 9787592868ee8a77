"""Where a robot touches an object: their shapes, at the measured poses, must meet.

While the wrench at a tool says that it touches, the distance between tool and object is
-f/k and nothing else. That needs no simulation, and no force of the robot's to be
known: sizes, heights and offsets show in it at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.data.recording import Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.selection import benjamini_hochberg
from makebreak.gap.problem import Candidate, Nuisances, rms
from makebreak.gap.result import GapMeasure, InUnits, Series, Where
from makebreak.gap.simulation.stand_on_ground import stand_on_ground
from makebreak.gap.simulation.windows import LARGEST
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact_surface import stiffness_of
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints
from makebreak.models.scene import Scene, load_scene
from makebreak.systems.numerics.filters import mean_delay

SHAPES = 2e-4  # How well shapes are known where the scene does not say [m].
# And a camera: its place [m], its scale; its clock to a sample.
PLACED, SCALED = 1e-3, 0.005
CLEAR = 6.0  # A force is one beyond so many times its noise,
LEAST_FORCE = 0.5  # and beyond this [N].
COMPLIANCE = 1e-6  # Of shapes that say nothing of it, in all [m/N].
NEAR = 0.03  # Farther apart than this the tool touches something else [m].
BLOCK_SEC, MOST = 1.2, 300
_FORCE = ("fx", "fy", "fz")
_POSE = ("qw", "qx", "qy", "qz", "x", "y", "z")
_STEPS = {"object_size": 1e-3, "plane_height": 1e-3, "joint_offset": 1e-3,
          "length_scale": 1e-3, "sensor_bias": 1e-3}  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Touch:
    """Rows of a recording in which a tool may touch an object. force: (n,) [N]."""

    recording: int
    tool: str
    thing: str
    rows: np.ndarray
    force: np.ndarray

    @property
    def name(self) -> str:
        return f"{self.tool}~{self.thing}.distance"


class TouchModel:
    """The distances (n,) over their noise, while something is touched: the questions
    that InverseModel answers, for a mechanism that touches free bodies.

    Raises: DoesNotFit if the recordings hold no such touch: they need the joints'
        positions, a force at a body of the mechanism, and x and y of a free body.
    """

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        self.scene, self.recordings = scene, list(recordings)
        self.dynamics = SceneDynamics(scene)
        plant = self.dynamics.plant
        self.joints = [
            full_name(plant, j) for j in one_dof_joints(plant) if j.num_velocities()
        ]
        self.bodies = [
            full_name(plant, plant.get_body(i))
            for i in sorted(plant.GetFloatingBaseBodies())
        ]
        self.runs = 0
        self._loaded_of: tuple = ()
        self.touches = self._find(plant)
        if not sum(len(touch.rows) for touch in self.touches) >= 20:
            raise DoesNotFit("the recordings hold no touch that a wrench tells of")
        self._slope = [self._slopes(touch) for touch in self.touches]
        self._stds = [
            self._std(touch, slopes)
            for touch, slopes in zip(self.touches, self._slope, strict=True)
        ]
        self.std = np.concatenate(self._stds)
        self._base: np.ndarray | None = None

    # ----- Which rows

    def _find(self, plant: MultibodyPlant) -> list[_Touch]:
        found = []
        for i, recording in enumerate(self.recordings):
            if not all(f"{j}.position" in recording for j in self.joints):
                continue
            for frame, tool in _frames(plant):
                names = [f"{frame}.{f}" for f in _FORCE]
                if not all(name in recording for name in names):
                    continue
                f = np.stack([recording[name] for name in names], axis=1)
                noise = max(recording.channels[name].noise for name in names)
                size = np.linalg.norm(f, axis=1)
                clear = size > max(CLEAR * noise, LEAST_FORCE)
                for thing in self.bodies:
                    if thing == tool or f"{thing}.x" not in recording:
                        continue
                    rows = np.flatnonzero(clear & self._is_measured(recording, thing))
                    if len(rows) == 0:
                        continue
                    rows = rows[
                        np.unique(np.linspace(0, len(rows) - 1, 3 * MOST).astype(int))
                    ]
                    touch = _Touch(i, tool, thing, rows, size[rows])
                    gap = self._distances(touch, ())
                    near = np.abs(gap) < NEAR
                    keep = np.flatnonzero(near)
                    if len(keep) > MOST:
                        keep = keep[np.linspace(0, len(keep) - 1, MOST).astype(int)]
                    touch = _Touch(i, tool, thing, rows[keep], size[rows[keep]])
                    if len(keep):
                        found.append(touch)
        return found

    def _is_measured(self, recording: Recording, thing: str) -> np.ndarray:
        names = [f"{j}.position" for j in self.joints]
        names += [f"{thing}.{p}" for p in _POSE if f"{thing}.{p}" in recording]
        return np.all([np.isfinite(recording[name]) for name in names], axis=0)

    def _slopes(self, touch: _Touch) -> dict[str, np.ndarray]:
        """Of the distance by each measured position, (n,) each."""
        recording = self.recordings[touch.recording]
        names = [f"{j}.position" for j in self.joints]
        names += [c for a in "xyz" if (c := f"{touch.thing}.{a}") in recording]
        plain, step = self._distances(touch, ()), 1e-4
        return {
            name: (self._distances(touch, (), {name: step}) - plain) / step
            for name in names
        }

    def _std(self, touch: _Touch, slopes) -> np.ndarray:
        """Noise of the positions, as distances, and what shapes are off by."""
        recording = self.recordings[touch.recording]
        shapes = float(self.scene.tolerance.get("shape_m", SHAPES))
        variance = np.full(len(touch.rows), shapes**2)
        for name, slope in slopes.items():
            variance += (slope * recording.channels[name].noise) ** 2
        return np.sqrt(variance)

    def nuisances(self) -> Nuisances:
        """Of each object that is seen: where the camera is, its scale and its clock."""
        things = dict.fromkeys(touch.thing for touch in self.touches)
        columns, prior, names = [], [], []
        for thing in things:
            axes = sorted(
                {c for s in self._slope for c in s if c.rsplit(".", 1)[0] == thing}
            )
            parts: dict[str, list[np.ndarray]] = {}
            for touch, slopes, std in zip(
                self.touches, self._slope, self._stds, strict=True
            ):
                none = np.zeros(len(touch.rows))
                mine = touch.thing == thing
                recording = self.recordings[touch.recording]
                late, larger = none, none
                for c in axes:
                    slope = slopes[c] / std if mine and c in slopes else none
                    parts.setdefault(f"bias of {c}", []).append(slope)
                    if mine and c in slopes:
                        late = late + slope * _rate(recording, c)[touch.rows]
                        y = recording[c]
                        larger = larger + slope * (y - np.nanmean(y))[touch.rows]
                parts.setdefault(f"delay of {thing}", []).append(late)
                parts.setdefault(f"scale of {thing}", []).append(larger)
            period = max(float(np.median(np.diff(r.time))) for r in self.recordings)
            sizes = {"bias": PLACED, "delay": period, "scale": SCALED}
            for name, each in parts.items():
                columns.append(np.concatenate(each))
                prior.append(sizes[name.split(" ")[0]])
                names.append(name)
        return Nuisances(np.stack(columns, axis=1), np.array(prior), tuple(names))

    # ----- Distances

    def _plant(self, effects: Sequence[Effect]):
        """A plant with these effects, built anew where the shapes are others."""
        shown = [e for e in effects if KINDS[e.kind].before_finalize is not None]
        key = repr(shown)
        if not self._loaded_of or self._loaded_of[0] != key:
            builder = DiagramBuilder()
            scene = self.scene
            loaded = load_scene(
                type(scene)(**{**vars(scene), "effects": [*scene.effects, *shown]}),
                builder,
            )
            diagram = builder.Build()
            self._loaded_of = (key, loaded, diagram, diagram.CreateDefaultContext())
        return self._loaded_of[1:]

    def _distances(self, touch: _Touch, effects, moved=None) -> np.ndarray:
        """(n,) [m], what the force presses in added. moved: {channel: by how much}."""
        self.runs += 1
        loaded, _, root = self._plant(effects)
        plant, scene_graph = loaded.plant, loaded.scene_graph
        context = plant.GetMyMutableContextFromRoot(root)
        query_context = scene_graph.GetMyContextFromRoot(root)
        port = scene_graph.get_query_output_port()
        recording = self.recordings[touch.recording]
        effects = [*self.scene.effects, *effects]

        def value(channel: str) -> np.ndarray:
            y = np.array(recording[channel][touch.rows])
            # A touch is slow: behind a filter it shows late, and no more.
            late = mean_delay(recording.channels[channel].stages or ())
            if late:
                y += late * _rate(recording, channel)[touch.rows]
            body = channel.rsplit(".", 1)[0]
            y += (moved or {}).get(channel, 0.0)
            for e in effects:
                if e.kind == "joint_offset" and f"{body}.position" == channel:
                    if body in e.at or body.split(".")[0] in e.at:
                        y -= e.parameters["offset"]
                elif e.kind == "sensor_bias" and channel in e.at:
                    y -= e.parameters["bias"]
                elif e.kind == "length_scale" and channel[-2:] in (".x", ".y", ".z"):
                    if {"world", body, body.split(".")[0]} & set(e.at):
                        y /= e.parameters["scale"]
            return y

        q = np.tile(plant.GetPositions(context), (len(touch.rows), 1))
        for joint in one_dof_joints(plant):
            name = f"{full_name(plant, joint)}.position"
            if name in recording:
                q[:, joint.position_start()] = value(name)
        thing, tool = (_body(plant, name) for name in (touch.thing, touch.tool))
        start = thing.floating_positions_start()
        for k, part in enumerate(_POSE):
            if f"{touch.thing}.{part}" in recording:
                q[:, start + k] = value(f"{touch.thing}.{part}")
        q[:, start : start + 4] /= np.linalg.norm(q[:, start : start + 4], axis=1)[
            :, None
        ]
        lies = f"{touch.thing}.z" not in recording
        mine = plant.GetCollisionGeometriesForBody(thing)
        theirs = plant.GetCollisionGeometriesForBody(tool)
        inspector = scene_graph.model_inspector()
        soft = {
            shape: 1.0 / stiffness_of(inspector.GetProximityProperties(shape))
            for shape in (*mine, *theirs)
        }
        out, compliance = np.empty(len(q)), np.empty(len(q))
        for n, row in enumerate(q):
            plant.SetPositions(context, row)
            if lies:
                stand_on_ground(plant, context, scene_graph, query_context, thing)
            query = port.Eval(query_context)
            # Of a body whose shapes are not equally stiff, the one that is met counts.
            out[n], compliance[n] = min(
                (query.ComputeSignedDistancePairClosestPoints(a, b).distance,
                 soft[a] + soft[b] or COMPLIANCE)
                for a in theirs
                for b in mine
            )  # fmt: skip
        return out + touch.force * compliance

    # ----- As InverseModel

    def residual(self, effects: Sequence[Effect] = ()) -> np.ndarray:
        """(n,) what the distance should be, zero, less what it is, over its noise."""
        gap = np.concatenate([self._distances(t, effects) for t in self.touches])
        return np.clip(-gap / self.std, -LARGEST, LARGEST)

    def base(self) -> np.ndarray:
        if self._base is None:
            self._base = self.residual()
        return self._base

    def train(self) -> np.ndarray:
        """Every third block of 1.2 s is held out."""
        kept = []
        for touch in self.touches:
            time = self.recordings[touch.recording].time[touch.rows]
            kept.append((time / BLOCK_SEC).astype(int) % 3 != 1)
        return np.concatenate(kept)

    def blocks(self) -> np.ndarray:
        """(m,) number of the touch and its block of time of each row."""
        numbers, first = [], 0
        for touch in self.touches:
            time = self.recordings[touch.recording].time[touch.rows]
            number = (time / BLOCK_SEC).astype(int)
            numbers.append(first + number - number.min(initial=0))
            first = int(numbers[-1].max(initial=first)) + 1
        return np.concatenate(numbers)

    # ----- Told

    def _parts(self, *arrays: np.ndarray):
        first = 0
        for touch in self.touches:
            last = first + len(touch.rows)
            yield touch, *(x[first:last] for x in arrays)
            first = last

    def channel_of_rows(self) -> np.ndarray:
        """(m,) number of the touch of each row."""
        sizes = [len(touch.rows) for touch in self.touches]
        return np.repeat(np.arange(len(sizes)), sizes)

    def measure(
        self, before: np.ndarray, after: np.ndarray, held: np.ndarray
    ) -> GapMeasure:
        """Args: residuals (n,), and which of them count (n,)."""
        names: dict[str, list] = {}
        for touch, h, a, b, std in self._parts(held, before, after, self.std):
            names.setdefault(touch.name, []).append((a[h], b[h], std[h]))
        per_channel, in_units = {}, {}
        for name, pairs in names.items():
            a, b, std = (np.concatenate(each) for each in zip(*pairs, strict=True))
            per_channel[name] = {"before": rms(a), "after": rms(b)}
            in_units[name] = InUnits("m", rms(a * std), rms(b * std), rms(std))
        return GapMeasure(
            rms(before[held]), rms(after[held]), 1.0, 0.0, per_channel, in_units,
            n_windows=int(held.sum()), seconds=self._seconds(held),
        )  # fmt: skip

    def _seconds(self, held: np.ndarray) -> float:
        """How long of a recording the rows (n,) stand for."""
        total = 0.0
        for touch, h in self._parts(held):
            time = self.recordings[touch.recording].time[touch.rows][h]
            steps = np.diff(time)
            total += float(steps[steps < BLOCK_SEC].sum())
        return total

    def series(self, before: np.ndarray, after: np.ndarray) -> list[Series]:
        out = []
        for touch, a, b, std in self._parts(before, after, self.std):
            recording = self.recordings[touch.recording]
            time = recording.time[touch.rows]
            starts = np.flatnonzero(np.diff(time, prepend=-np.inf) > 0.1)
            out.append(
                Series(
                    touch.name, recording.name, recording.episodes[0].number, time,
                    np.zeros(len(time)), -a * std, -b * std, starts,
                    float(np.median(std)),
                )
            )  # fmt: skip
        return out

    def where(self, left: np.ndarray) -> list[Where]:
        """Touches, half a second apart at least, in which the shapes do not meet."""
        found, p = [], []
        for touch, r in self._parts(left):
            recording = self.recordings[touch.recording]
            time = recording.time[touch.rows]
            starts = np.flatnonzero(np.diff(time, prepend=-np.inf) > 0.5)
            for a, b in zip(starts, [*starts[1:], len(time)], strict=True):
                score = rms(r[a:b])
                number = recording.episode_at(touch.rows[a]).number
                # Samples of one touch err together: they count as one.
                p.append(float(np.exp(-0.5 * (score / 1.3) ** 2)))
                found.append(
                    Where(touch.name, float(time[a]), float(time[b - 1]), number,
                          recording.name, "touching", score)
                )  # fmt: skip
        out = benjamini_hochberg(p, 0.01)
        kept = [w for w, is_out in zip(found, out, strict=True) if is_out]
        return sorted(kept, key=lambda w: -w.score)[:40]


def touch_candidates(model: TouchModel) -> list[Candidate]:
    """Sizes, heights, offsets and biases that distances show."""
    found = []
    things = {touch.thing for touch in model.touches}
    channels = {
        f"{touch.thing}.{a}"
        for touch in model.touches
        for a in "xyz"
        if f"{touch.thing}.{a}" in model.recordings[touch.recording]
    }
    for kind, step in _STEPS.items():
        for at in model.dynamics.places(kind):
            if KINDS[kind].at in ("free body", "length") and at not in things:
                continue
            if kind == "sensor_bias" and at not in channels:
                continue
            now = dict(model.dynamics.now(kind, [at]))
            if kind == "object_size" and "radius" in now:
                now = {"radius": now["radius"]}
            (name,) = list(now)
            r = model.residual([Effect(kind, [at], {name: now[name] + step})])
            column = ((model.base() - r) / step)[:, None]
            if not np.abs(column).max() > 1e-3:
                continue

            def read(c, name=name, start=now[name]):
                return {name: start + float(c[0])}

            # What stands elsewhere stands there for all that it carries: of a tie an
            # object's own size is the simpler.
            size = 1 if KINDS[kind].at == "free body" else 2
            found.append(Candidate(kind, (at,), size, (column,), (read,)))
    return found


def _rate(recording: Recording, channel: str) -> np.ndarray:
    time, y = recording.time, recording[channel]
    good = np.isfinite(y)
    return np.gradient(np.interp(time, time[good], y[good]), time)


def _frames(plant: MultibodyPlant):
    """`<model>.<frame>` of all bodies of mechanisms with shapes, and the body."""
    for m in range(plant.num_model_instances()):
        for i in plant.GetFrameIndices(ModelInstanceIndex(m)):
            body = plant.get_frame(i).body()
            moves = not plant.IsAnchored(body) and not body.is_floating_base_body()
            if moves and plant.GetCollisionGeometriesForBody(body):
                model = plant.GetModelInstanceName(plant.get_frame(i).model_instance())
                yield f"{model}.{plant.get_frame(i).name()}", full_name(plant, body)


def _body(plant: MultibodyPlant, name: str):
    for i in range(plant.num_bodies()):
        if full_name(plant, plant.get_body(BodyIndex(i))) == name:
            return plant.get_body(BodyIndex(i))
    raise ValueError(f"the scene has no body {name!r}")

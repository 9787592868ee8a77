"""Windows through contact, simulated by Drake with the scene's own law.

A window begins where the robot does not touch what it is about to push, and what it
pushes is at rest: the object's place is then the mean of many samples, and nothing is
pressed into anything. From the middle of a push a tenth of a millimetre, which noise
is, would be newtons. Where there is no such start, windows begin as elsewhere; in a
long episode, in which an object is pushed, left and pushed again, they begin so, too.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from makebreak.gap.data.recording import Episode, Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.runs import runs_of
from makebreak.gap.simulation.contact_shapes import (
    APPROACH,
    MEETS,
    ContactShapes,
    Slot,
    poses_of,
)
from makebreak.gap.simulation.face_supports import LiesOn, add_supports
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.simulation.windows import (
    BESIDE,
    TURN,
    Window,
    WindowModel,
    drawn,
)
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact import FRICTION
from makebreak.models.effects.contact_damper import STICTION
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints
from makebreak.models.scene import Scene
from makebreak.models.scene_schema import COMMANDS_OF, ActuationSection
from makebreak.systems.numerics.smoother import smooth_filtered

WINDOW_SEC = 0.6  # Reaches into the sliding.
BEFORE_SEC = 0.04  # It begins so long before the object moves,
REST_SEC = 0.1  # after as much rest, or more.
RESTS = 3e-3  # Slower is at rest [m/s], [rad/s] over ten.
# A longer episode has a window in so long, at most, and as many before pushes; all long
# ones together this many.
LONG_SEC, EVERY_SEC, MOST_OF_LONG = 4.5, 1.5, 24
APART = 5e-3  # What is so far from all that could push it is left alone [m],
GOES, SEEMS = 3e-3, 4.0  # It is pushed if it goes so far [m], times its noise.
SEEN_APART, COMES_SEC = 0.02, 0.2  # asked every so often, and no longer before a push.
DRAWS = 3  # Of uncertain starts.
FARTHEST, FARTHEST_RATE = 1.0, 100.0  # That draws may be apart [m], [rad]; a second.
LAW = 0.02  # How exact friction, a mass or a gain can be known by laws of contact.
# Laws of contact are approximations: of how far an object moves, and a driven joint.
BLUR, BLUR_DRIVEN = 0.005, 0.0005
MOST = 4
# How fast joints that are led follow their measured motion [rad/s], told so often [s].
LED_RATE, LED_SEC = 300.0, 1e-3


class PushWindows(WindowModel):
    """Args: episodes: (recording, number) of those that count, else all. lying: bodies
    that lie on faces, which are carried by face_supports. pairs: those of which windows
    expect no friction to be known better than LAW. creep: slip of contacts that hold
    [m/s], where it is more than Drake's.

    Raises: DoesNotFit where no window fits in.
    """

    def __init__(
        self,
        scene: Scene,
        recordings: Sequence[Recording],
        episodes: set[tuple[int, int]] | None = None,
        lying: Sequence[LiesOn] = (),
        pairs: Sequence[str] = (),
        creep: float = STICTION,
    ):
        self._only, self._pairs, self._creep = episodes, tuple(pairs), creep
        self._draw: np.random.Generator | None = None  # Of efforts, while it is there.
        scene, led = led_as_measured(scene, recordings)
        self._led = led
        every = [_most_of(r, e) for r in recordings for e in r.episodes]
        most = max(MOST, min(2 * sum(n for n in every if n > 2), MOST_OF_LONG))
        simulation = SceneSimulation(
            scene, before_finalize=partial(add_supports, lying) if lying else None
        )
        super().__init__(
            scene, recordings, WINDOW_SEC, by_episode=True, most=most,
            simulation=simulation,
        )  # fmt: skip
        keep = [
            k for k, c in enumerate(self.channels)
            if c.rsplit(".", 1)[0] not in led and varies(recordings, c)
        ]  # fmt: skip
        if not keep:
            raise DoesNotFit("nothing but joints that are led as they were measured")
        self.channels = [self.channels[k] for k in keep]
        self.noise = self.noise[keep]
        self.windows = [replace(w, std=w.std[:, keep]) for w in self.windows]
        self._add_spread()

    def _given(self, recording: Recording, episode: Episode, i: int, late):
        """times and columns of commands: the smoothed motion, where joints are led."""
        if not self._led:
            return super()._given(recording, episode, i, late)
        path = self._paths.get((i, episode.first))
        if path is None:  # No window begins here.
            return recording.time[episode.rows], {}
        rows = path["time"]
        count = int((rows[-1] - rows[0]) / LED_SEC) + 1
        time = rows[0] + LED_SEC * np.arange(count)
        columns = {}
        for joint in self.scene.actuation.joints:
            if f"{joint}.position" in path:
                x, v, _ = path[f"{joint}.position"].T
                now = np.interp(time + 0.5 * LED_SEC, rows, x)
                columns[f"{joint}.position_command"] = now
                columns[f"{joint}.velocity_command"] = np.interp(time, rows, v)
        return time, columns

    def _cut(self, i, recording: Recording, episode: Episode, hop, block, number):
        if self._only is not None and (i, episode.number) not in self._only:
            return
        before, most = len(self.windows), _most_of(recording, episode)
        found = self._from_rest(i, recording, episode)
        if not found or most > 2:
            super()._cut(i, recording, episode, hop, block, number)
            others = self.windows[before:]
            self.windows[before:] = _evenly(others, most) if most > 2 else others[:2]
        self.windows += _evenly(found, most) if most > 2 else found[:2]

    def _from_rest(self, i, recording: Recording, episode: Episode) -> list[Window]:
        time = recording.time[episode.rows]
        if len(time) < 24 or not self.bodies:
            return []
        states, spreads = {}, {}
        for name in self._signals():
            y = recording[name][episode.rows]
            channel = recording.channels[name]
            if np.isfinite(y).sum() < 12:
                return []
            s = smooth_filtered(time, y, channel.noise, channel.stages or ())
            states[name], spreads[name] = s.x, s.P
        self._paths[i, episode.first] = {"time": time, **states}
        rests = np.ones(len(time), bool)
        for body in self.bodies:
            for axis in (*TURN, "x", "y", "z"):
                if (name := f"{body}.{axis}") in states:
                    limit = RESTS * (10.0 if axis in TURN else 1.0)
                    rests &= np.abs(states[name][:, 1]) < limit
        # Stretches of rest that end in motion.
        found = []
        for a, b in runs_of(rests):
            if b >= len(time) or time[b] - time[a] < REST_SEC + BEFORE_SEC:
                continue
            k = int(np.searchsorted(time, time[b] - BEFORE_SEC))
            if a > 0:  # It has come to rest, against what pushed it perhaps.
                if _most_of(recording, episode) <= 2:
                    continue
                first = int(np.searchsorted(time, time[b] - COMES_SEC))
                k = self._last_apart(time, states, max(a, first), k)
                if k < 0 or time[k] - time[a] < REST_SEC:
                    continue
                if not self._goes(recording, states, time, k):
                    continue
            window = self._window_at(i, recording, episode, time, states, spreads, a, k)
            if window is not None:
                found.append(window)
        return found

    def _goes(self, recording: Recording, states, time, k: int) -> bool:
        """Whether a body goes farther in a window from row k on than noise seems to."""
        end = int(np.searchsorted(time, time[k] + self.window_sec))
        for body in self.bodies:
            for name in (f"{body}.{axis}" for axis in "xyz"):
                if name in states:
                    least = max(GOES, SEEMS * recording.channels[name].noise)
                    if np.ptp(states[name][k:end, 0]) > least:
                        return True
        return False

    def _last_apart(self, time, states, first: int, last: int) -> int:
        """The last of some rows at which no robot is near what it pushes; -1: none."""
        free = set(map(int, self.dynamics.plant.GetFloatingBaseBodies()))
        asked = np.arange(time[last], time[first] - 1e-9, -SEEN_APART)
        rows = np.unique(np.searchsorted(time, asked).clip(first, last))
        near = np.zeros(len(rows), bool)
        for s in self._slots(states, rows, APART):
            pair = {s.a, s.b}
            if pair & free and pair - free - self._shapes.anchored:
                near |= s.phi < APART
        return int(rows[~near][-1]) if not near.all() else -1

    def _best_start(self, time, states, row: int) -> int:
        """The nearest row at which nothing is just about to touch, or to part: the
        smoothed speed there is a mean of those before and after."""
        rows = np.flatnonzero(np.abs(time - time[row]) < 0.25 * self.window_sec)
        lands = np.zeros(len(rows), bool)
        for s in self._slots(states, rows, MEETS):
            rate = np.gradient(s.phi, time[rows])
            lands |= (s.phi < MEETS) & (np.abs(rate) > APPROACH)
        beside = np.convolve(lands, np.ones(2 * BESIDE + 1), "same") > 0.5
        calm = rows[~beside & (rows < len(time) - 3)]
        return int(calm[np.argmin(np.abs(calm - row))]) if len(calm) else row

    @cached_property
    def _shapes(self) -> ContactShapes:
        return ContactShapes(self.dynamics.loaded)

    def _slots(self, states, rows: np.ndarray, near: float) -> list[Slot]:
        """Of shapes that come so near to each other in these rows [m]."""
        plant = self.dynamics.plant
        q = np.tile(plant.GetPositions(plant.CreateDefaultContext()), (len(rows), 1))
        for j in one_dof_joints(plant):
            if (name := f"{full_name(plant, j)}.position") in states:
                q[:, j.position_start()] = states[name][rows, 0]
        for k in plant.GetFloatingBaseBodies():
            body = plant.get_body(k)
            for n, axis in enumerate((*TURN, "x", "y", "z")):
                if (name := f"{full_name(plant, body)}.{axis}") in states:
                    q[:, body.floating_positions_start() + n] = states[name][rows, 0]
        return self._shapes.slots(poses_of(plant, q, self._shapes), near)

    def _window_at(self, i, recording, episode, time, states, spreads, a, k):
        end = int(np.searchsorted(time, time[k] + self.window_sec, "right"))
        if end - k < 12 or time[end - 1] - time[k] < 0.5 * self.window_sec:
            return None
        state = {n: np.array(x[k]) for n, x in states.items()}
        spread = {n: np.array(P[k, :2, :2]) for n, P in spreads.items()}
        for body in self.bodies:
            for axis in (*TURN, "x", "y", "z"):
                if (name := f"{body}.{axis}") not in states:
                    continue
                y = recording[name][episode.rows][a:k]
                y = y[np.isfinite(y)]
                state[name] = np.array([float(np.mean(y)), 0.0, 0.0])
                var = recording.channels[name].noise ** 2 / len(y)
                spread[name] = np.diag([var, 1e-12])
        std = np.empty((end - k, len(self.channels)))
        std[:] = self.noise
        return Window(
            i, episode.number, float(time[k]),
            slice(episode.first + k, episode.first + end), state, std, True, spread,
        )  # fmt: skip

    def with_spread_of(self, effects: Sequence[Effect]) -> "PushWindows":
        """The same windows, each no surer than it is with these effects, too: one that
        is chaotic in either model tells nothing of the other."""
        other = copy(self)
        _, wide = self._spread(effects)
        other.windows = [
            replace(w, std=np.sqrt(w.std**2 + np.maximum(more - known, 0.0)))
            for w, more, known in zip(self.windows, wide, self._wide, strict=True)
        ]
        return other

    def _spread(self, effects: Sequence[Effect]):
        """Of each window what it does, and the variance that uncertain starts make, the
        noise of measured efforts, and frictions that are off by LAW: an arm that pushes
        along a wall may stick or slip by them, and where it does not hold itself a
        little becomes much. What dry friction holds creeps by its law, as fast as it
        fades below, and nowhere else: twice as fast it goes twice as far. A contact
        that creeps, if any does, may creep or not."""
        rng = np.random.default_rng(0)
        plain = self.simulate(effects)
        wide = [np.zeros_like(y) for y in plain]
        rates = ("velocity", "vx", "vy", "vz", "wx", "wy", "wz")
        most = np.square([
            FARTHEST_RATE if c.rsplit(".", 1)[1] in rates else FARTHEST
            for c in self.channels
        ])  # fmt: skip

        def add(other: Sequence[np.ndarray], share: float) -> None:
            for total, y, y0 in zip(wide, other, plain, strict=True):
                off = np.minimum((y - y0) ** 2, most)
                total += np.where(np.isfinite(off), off, most) * share

        kept = self.windows
        try:
            for _ in range(DRAWS):
                self.windows = [drawn(w, rng) for w in kept]
                self._draw = rng
                add(self.simulate(effects), 1.0 / DRAWS)
        finally:
            self.windows, self._draw = kept, None
        if any(KINDS[e.kind].joint_law for e in (*self.scene.effects, *effects)):
            self.simulation.fades = 2.0
            try:
                add(self.simulate(effects), 1.0)
            finally:
                self.simulation.fades = 1.0
        if self._creep > STICTION:
            self.simulation.creeps = self._creep
            try:
                add(self.simulate(effects), 1.0)
            finally:
                self.simulation.creeps = STICTION
        for by in (LAW, -LAW) if self._pairs else ():
            add(self.simulate(self._with_frictions(effects, 1.0 + by)), 0.5)
        return plain, wide

    def _with_frictions(self, effects: Sequence[Effect], by: float) -> list[Effect]:
        """The effects, with frictions of pairs times so much."""
        others = [e for e in effects if e.kind != FRICTION]
        now = {pair: self.dynamics.now(FRICTION, [pair]) for pair in self._pairs}
        now |= {at: e.parameters for e in effects if e.kind == FRICTION for at in e.at}
        return others + [
            Effect(FRICTION, [pair], {name: by * x for name, x in p.items()})
            for pair, p in now.items()
        ]

    def _add_spread(self) -> None:
        """Noise, what uncertain starts do in the scene as it is, and a share
        of how far each channel goes."""
        plain, self._wide = self._spread(())
        far = np.zeros(len(self.channels))
        for y in plain:
            y = np.where(np.isfinite(y), y, np.nanmean(y, axis=0))
            far = np.maximum(far, np.ptp(y, axis=0))
        far *= [
            BLUR_DRIVEN if c.rsplit(".", 1)[0] in self.joints else BLUR
            for c in self.channels
        ]
        self.windows = [
            replace(w, std=np.sqrt(w.std**2 + v + far**2))
            for w, v in zip(self.windows, self._wide, strict=True)
        ]


def _most_of(recording: Recording, episode: Episode) -> int:
    """Windows of an episode, at most."""
    length = float(np.ptp(recording.time[episode.rows]))
    return 2 if length < LONG_SEC else int(length / EVERY_SEC)


def _evenly(windows: list[Window], most: int) -> list[Window]:
    if len(windows) <= most:
        return windows
    return [windows[k] for k in np.linspace(0, len(windows) - 1, most).astype(int)]


def varies(recordings: Sequence[Recording], channel: str) -> bool:
    """Whether a channel is ever other than one value: height and tilt by a camera that
    sees a plane alone are said, not measured, and no simulation agrees with them to the
    last digit."""
    values = np.concatenate([r[channel] for r in recordings])
    values = values[np.isfinite(values)]
    return bool(len(values)) and bool(np.ptp(values) > 0.0)


def led_as_measured(
    scene: Scene, recordings: Sequence[Recording]
) -> tuple[Scene, list[str]]:
    """The scene with joints led along their measured motion, and these joints, where
    efforts were measured and no command: with these efforts as an input a robot drifts
    by their noise, and by what an impact does between two rows. What the joints do is
    then judged by the equations alone, what objects do in simulation. Else, and where
    nothing but joints moves, the scene as it is, and none."""
    act = scene.actuation
    takes = COMMANDS_OF[act.type]
    commanded = any(f"{j}.{what}" in r for r in recordings for j in act.joints
                    for what in takes)  # fmt: skip
    known = [
        j for j in act.joints
        if all(f"{j}.{what}" in r for r in recordings
               for what in ("position", "effort_measured"))
    ]  # fmt: skip
    if commanded or not known or len(known) < len(act.joints):
        return scene, []
    plant = SceneDynamics(scene).plant
    if not plant.GetFloatingBaseBodies():
        return scene, []
    context = plant.CreateDefaultContext()
    of = {full_name(plant, j): j for j in one_dof_joints(plant)}
    q = plant.GetPositions(context)
    for joint in known:
        y = recordings[0][f"{joint}.position"]
        q[of[joint].position_start()] = y[np.isfinite(y)][0]
    plant.SetPositions(context, q)
    ease = np.diag(np.linalg.inv(plant.CalcMassMatrix(context)))
    inertia = [1.0 / ease[of[joint].velocity_start()] for joint in known]
    drive = ActuationSection(
        "pd", list(known), kp=[float(m * LED_RATE**2) for m in inertia],
        kd=[float(2.0 * m * LED_RATE) for m in inertia], rate_hz=act.rate_hz,
    )  # fmt: skip
    return replace(scene, actuation=drive), known

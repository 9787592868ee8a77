"""Windows through contact, simulated by Drake with the scene's own law.

A window begins where the robot does not touch what it is about to push, and what it
pushes is at rest: the object's place is then the mean of many samples, and nothing is
pressed into anything. From the middle of a push a tenth of a millimetre, which noise
is, would be newtons. Where there is no such start, windows begin as elsewhere.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.recording import Episode, Recording
from makebreak.gap.windows import TURN, Window, WindowModel
from makebreak.models.scene import Scene
from makebreak.systems.numerics.smoother import smooth_filtered

WINDOW_SEC = 0.6  # Reaches into the sliding.
BEFORE_SEC = 0.04  # It begins so long before the object moves,
REST_SEC = 0.1  # after as much rest, or more.
RESTS = 3e-3  # Slower is at rest [m/s], [rad/s] over ten.
DRAWS = 3  # Of uncertain starts.
# Laws of contact are approximations: of how far an object moves, and a driven joint.
BLUR, BLUR_DRIVEN = 0.005, 0.0005
MOST = 4


class PushWindows(WindowModel):
    """Args: episodes: (recording, number) of those that count, else all.

    Raises: ValueError where no window fits in.
    """

    def __init__(
        self,
        scene: Scene,
        recordings: Sequence[Recording],
        episodes: set[tuple[int, int]] | None = None,
    ):
        self._only = episodes
        super().__init__(scene, recordings, WINDOW_SEC, by_episode=True, most=MOST)
        self._add_spread()

    def _cut(self, i, recording: Recording, episode: Episode, hop, block, number):
        if self._only is not None and (i, episode.number) not in self._only:
            return
        before = len(self.windows)
        found = self._from_rest(i, recording, episode)
        if not found:
            super()._cut(i, recording, episode, hop, block, number)
            self.windows[before + 2 :] = []
            return
        self.windows += found[:2]

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
            for a in (*TURN, "x", "y", "z"):
                if (name := f"{body}.{a}") in states:
                    limit = RESTS * (10.0 if a in TURN else 1.0)
                    rests &= np.abs(states[name][:, 1]) < limit
        # Stretches of rest that end in motion.
        edges = np.flatnonzero(np.diff(np.concatenate([[0], rests, [0]]).astype(int)))
        found = []
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if b >= len(time) or time[b] - time[a] < REST_SEC + BEFORE_SEC:
                continue
            if a > 0:  # It has come to rest, against what pushed it perhaps.
                continue
            k = int(np.searchsorted(time, time[b] - BEFORE_SEC))
            window = self._window_at(i, recording, episode, time, states, spreads, a, k)
            if window is not None:
                found.append(window)
        return found

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

    def _add_spread(self) -> None:
        """Noise, what uncertain starts do in the scene as it is, and a share
        of how far each channel goes."""
        rng = np.random.default_rng(0)
        plain = self.simulate(())
        wide = [np.zeros_like(y) for y in plain]
        kept = self.windows
        try:
            for _ in range(DRAWS):
                self.windows = [_drawn(w, rng) for w in kept]
                for total, y, y0 in zip(wide, self.simulate(()), plain, strict=True):
                    off = np.minimum((y - y0) ** 2, 1.0)
                    total += np.where(np.isfinite(off), off, 1.0) / DRAWS
        finally:
            self.windows = kept
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
            for w, v in zip(self.windows, wide, strict=True)
        ]


def _drawn(w: Window, rng) -> Window:
    """The window from another start that its measurements allow."""
    state = {}
    for name, x in w.state.items():
        P = w.spread[name]
        values, u = np.linalg.eigh(P)
        state[name] = np.array(x)
        state[name][:2] += u @ (np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=2))
    return replace(w, state=state)

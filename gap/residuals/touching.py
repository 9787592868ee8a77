"""When bodies touch: by their distance, or by a force sensor on one of them."""

from collections.abc import Sequence

import numpy as np

from makebreak.gap.data.recording import Recording
from makebreak.gap.residuals.scene_motion import SceneMotion, SmoothedEpisode
from makebreak.gap.residuals.wrench_sensor import FORCE, WrenchSensor, felt_motion
from makebreak.gap.simulation.contact_shapes import APPROACH, MEETS, Slot
from makebreak.gap.simulation.free_windows import IMPACT_ACCELERATION
from makebreak.models.scene import Scene

BESIDE = -1  # Marks what a body touches beside what carries it.
FAR = 1.0  # Of what is not there [m].
UPRIGHT = 0.7  # Cosine of normal and vertical: less, and it is a wall.
NEAR = 0.02  # Shapes that never come so near do not matter [m].
ROBUST = 1.4826  # Standard deviation over median deviation, of normal noise.
# A force is felt where the mean of so many samples is clear of noise, and at least this
# [N]; where one may be felt, the mean over a test function is so many times its noise.
FELT_SAMPLES, LEAST_FELT, MAYBE_FELT = 9, 0.2, 4.0
SHORT = 0.5  # Of half a test function: a contact that is lost for less goes on.
# A tool farther than this from everything touches nothing [m]. The farthest share of
# such rows, if they last so long in an episode, and in all [s], show what its force
# sensor reads then: a bias, if it is this large [N] and so many times what these rows
# scatter by.
FREE, FARTHEST, FREE_SEC, ALL_FREE_SEC = 4e-3, 0.5, 0.1, 0.3
LEAST_BIAS, STEADY_BIAS = 0.1, 1.5


class Touching(SceneMotion):
    """The rows of a scene's recordings in which bodies touch.

    Attributes: biased: {channel of a force sensor: its bias [N]}.
    """

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        super().__init__(scene, recordings)
        # {bodies: how far apart (n_rows,) [m]} of contacts that a sensor feels.
        self._apart: dict[tuple[int, ...], np.ndarray] = {}
        self.biased: dict[str, float] = {}
        # {bodies: (n_rows,) whether they meet or part just then}, of what moves.
        self._lands: dict[tuple[int, ...], np.ndarray] = {}
        self._touching = self._touching_rows()

    def _pair_of(self, s: Slot) -> tuple[int, int]:
        return min(s.a, s.b), max(s.a, s.b)

    def _up(self) -> np.ndarray:
        """(3,) against gravity; of weightless scenes z."""
        g = self.dynamics.gravity
        size = np.linalg.norm(g)
        return -g / size if size > 0.0 else np.array([0.0, 0.0, 1.0])

    def carries(self, s: Slot) -> np.ndarray:
        """(n,) whether what is fixed is below what moves, at each pose of a slot."""
        sign = -1.0 if s.a in self.shapes.anchored else 1.0
        return sign * (s.normal @ self._up()) > UPRIGHT

    def _is_of_a_free_body(self, pair: tuple[int, int]) -> bool:
        """Whether something free touches what is fixed."""
        return bool(set(pair) & self.shapes.anchored) and any(
            self.shapes.names[k] in self.bodies for k in pair
        )

    def _touching_rows(self) -> dict[tuple[int, ...], np.ndarray]:
        """{bodies: (n_rows,) whether they touch}; with BESIDE behind them, of what a
        free body touches that does not carry it. By the force where a sensor feels it,
        else by the distance."""
        distance = self._least_distances()
        found: dict[tuple[int, ...], np.ndarray] = {}
        for key, phi in distance.items():
            near, lasts = phi < MEETS, np.abs(self._rate(phi)) < APPROACH
            found[key] = near & lasts
            if not self.shapes.anchored & set(key):  # That may stand elsewhere.
                self._lands[key] = near & ~lasts
        for sensor in self.sensors:
            welded = set(sensor.welded)
            keys = [key for key in distance if set(key) & welded]
            apart = np.min([distance[key] for key in keys], axis=0) if keys else None
            size = self._force_size(sensor, self._biases(sensor, apart))
            if not np.isfinite(size).all():
                continue
            for key in keys:
                partner = key[0] if key[1] in welded else key[1]
                if partner not in self.shapes.anchored:
                    felt = (size > 0.0) & (distance[key] < NEAR)
                    found[key] = self._without_short_losses(felt)
                    self._apart[key] = distance[key]
                    self._lands.pop(key, None)
        return found

    def _rate(self, phi: np.ndarray) -> np.ndarray:
        """(n_rows,) of a distance (n_rows,) in each episode [m/s]."""
        of_each = zip(self._offset, self._offset[1:], self.tracks, strict=False)
        return np.concatenate([np.gradient(phi[a:b], t.time) for a, b, t in of_each])

    def _least_distances(self) -> dict[tuple[int, ...], np.ndarray]:
        """{bodies, as of _touching_rows: (n_rows,) distance of their nearest points
        [m]}; FAR where none of these is there."""
        slots = self.shapes.slots(self._poses_at(self._q), NEAR)
        least: dict[tuple[int, ...], np.ndarray] = {}

        def add(key: tuple[int, ...], phi: np.ndarray) -> None:
            least[key] = np.minimum(least.get(key, np.full(len(phi), FAR)), phi)

        for s in slots:
            pair = self._pair_of(s)
            if not self._is_of_a_free_body(pair):
                add(pair, s.phi)
                continue
            below = self.carries(s)
            if below.any():
                add(pair, np.where(below, s.phi, FAR))
            if not below.all():
                add((*pair, BESIDE), np.where(below | ~s.best, FAR, s.phi))
        return least

    def _without_short_losses(self, felt: np.ndarray) -> np.ndarray:
        """(n_rows,) felt too where it is lost for little of a test function: a tip that
        hardly presses is felt now and then, and a contact that may act need not."""
        out = felt.copy()
        for a, b, t in zip(self._offset, self._offset[1:], self.tracks, strict=False):
            on = np.flatnonzero(felt[a:b])
            lost = np.diff(t.time[on]) < SHORT * self.half
            for k in np.flatnonzero(lost & (np.diff(on) > 1)):
                out[a + on[k] : a + on[k + 1]] = True
        return out

    def _biases(self, sensor: WrenchSensor, apart: np.ndarray | None) -> np.ndarray:
        """(n_tracks, 3) what a force sensor reads while its tool touches nothing, in
        each episode, for a bias may drift [N]; noted in `biased`. 0 where it reads next
        to nothing, or where that is not known.

        Args: apart (n_rows,): how far the tool is from all that it could touch [m].
        """
        none = np.zeros((len(self.tracks), 3))
        if apart is None or not self.bodies:  # Of walls it is not known where they are.
            return none
        forces, owner, known = [], [], 0.0
        for number, t in enumerate(self.tracks):
            rows = slice(self._offset[number], self._offset[number + 1])
            f = np.stack(
                [self.recordings[t.recording][f"{sensor.place}.{a}"][t.episode.rows]
                 for a in FORCE], axis=1,
            )  # fmt: skip
            free = np.isfinite(f).all(axis=1) & (apart[rows] > FREE)
            if free.any():
                far = apart[rows][free]
                free[free] = far >= np.quantile(far, 1.0 - FARTHEST)
            if (lasts := float(free.sum()) * self._row_of(t)) >= FREE_SEC:
                forces.append(f[free])
                owner.append(number)
                known += lasts
        if known < ALL_FREE_SEC:
            return none
        every = np.vstack(forces)
        bias = np.median(every, axis=0)
        scatter = ROBUST * np.median(np.abs(every - bias), axis=0)
        clear = np.maximum(LEAST_BIAS, STEADY_BIAS * scatter)
        if not (np.abs(bias) > clear).any():
            return none
        self.biased |= {
            f"{sensor.place}.{a}": float(b)
            for a, b in zip(FORCE, bias, strict=True)
            if abs(b) > 0.5 * LEAST_BIAS
        }
        none[:] = bias
        none[owner] = [np.median(f, axis=0) for f in forces]
        return none

    @staticmethod
    def _row_of(t: SmoothedEpisode) -> float:
        """[s] from one row to the next."""
        return float(np.median(np.diff(t.time)))

    def _force_size(self, sensor: WrenchSensor, bias: np.ndarray) -> np.ndarray:
        """(n_rows,) of the measured force, less the sensor's bias (n_tracks, 3), where
        it is clear of noise and of what the tool's own motion makes, else 0; of few
        newtons too, as of a tool that leans on something at rest."""
        out, place = [], sensor.place
        own = felt_motion(self.dynamics, sensor.frame, self._q, self._v, self._vd)
        own = np.linalg.norm(own[:, :3], axis=1)
        for first, t, off in zip(self._offset, self.tracks, bias, strict=False):
            recording = self.recordings[t.recording]
            f = np.stack(
                [recording[f"{place}.{a}"][t.episode.rows] for a in FORCE], axis=1
            ) - off  # fmt: skip
            noise = max(recording.channels[f"{place}.{a}"].noise for a in FORCE)
            good = np.isfinite(f).all(axis=1)
            if good.sum() < 2:
                return np.full(self._offset[-1], np.nan)
            n = min(FELT_SAMPLES, int(good.sum()))
            f = np.apply_along_axis(
                np.convolve, 0, f[good], np.full(n, 1.0 / n), "same"
            )
            size = np.interp(t.time, t.time[good], np.linalg.norm(f, axis=1))
            least = max(6.0 * noise / np.sqrt(n), LEAST_FELT)
            least = least + own[first : first + len(t.time)]
            out.append(np.where(size > least, size, 0.0))
        return np.concatenate(out)

    def _with_short_touches(self, t: SmoothedEpisode, rows: slice, centres):
        """Centres (K,), sorted, and half widths (K,) of test functions: those that are
        given, and one for each touch that is felt and holds none of them, as wide as
        the touch lasts. A push often takes less than a slow camera's test function."""
        halves = np.full(len(centres), self.half)
        felt = np.zeros(len(t.time), bool)
        changes = np.zeros(len(t.time), bool)
        for key, touching in self._touching.items():
            own = touching[rows]
            changes[1:] |= own[1:] != own[:-1]
            if key in self._apart:
                felt |= own
        struck = self._is_struck(rows)
        changes |= struck
        changes[1:] |= struck[:-1]
        edges = np.flatnonzero(np.concatenate([[True], changes[1:], [True]]))
        added, widths = [], []
        for a, b in zip(edges, edges[1:], strict=False):
            start, end = t.time[a], t.time[b - 1]
            half = min(0.5 * (end - start), self.half)
            inside = (centres > start) & (centres < end)
            if felt[a] and half >= self._least_half and not inside.any():
                added.append(0.5 * (start + end))
                widths.append(half)
        centres = np.concatenate([centres, added])
        order = np.argsort(centres)
        return centres[order], np.concatenate([halves, widths])[order]

    def _maybe_felt(self, first, last, rows: slice, wrench, wrench_var) -> np.ndarray:
        """(K,) whether a sensor near something free feels a force that is too small to
        say from when to when: then it is not known whether they touch.

        Args: first, last: rows of each test function within the episode, whose rows
            among all are `rows`; wrench, wrench_var (K, n_wrench).
        """
        maybe = np.zeros(len(first), bool)
        for sensor in self.sensors:
            size = np.linalg.norm(wrench[:, sensor.forces], axis=1)
            noise = np.sqrt(np.max(wrench_var[:, sensor.forces], axis=1, initial=0.0))
            near = np.zeros(len(first), bool)
            on = np.zeros(len(first), bool)
            for pair, touching in self._touching.items():
                if not set(pair) & set(sensor.welded):
                    continue
                distance = self._apart.get(pair)
                for k, (a, b) in enumerate(zip(first, last, strict=True)):
                    on[k] |= bool(touching[rows][a:b].any())
                    near[k] |= distance is not None and bool(
                        (distance[rows][a:b] < NEAR).any()
                    )
            maybe |= near & ~on & (size > MAYBE_FELT * noise)
        return maybe

    def _is_struck(self, rows: slice) -> np.ndarray:
        """(n,) whether something lands at a row: of what is free, other points carry it
        then; and the force is over before it is seen."""
        struck = np.any(
            [
                np.zeros(rows.stop - rows.start, bool),
                *(lands[rows] for lands in self._lands.values()),
            ],
            axis=0,
        )
        for _, i in self.bodies.values():
            size = np.linalg.norm(self._vd[rows, i + 3 : i + 6], axis=1)
            struck |= size > IMPACT_ACCELERATION
        return struck

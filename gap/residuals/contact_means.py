"""Means of what was measured, over short test functions in which no contact changes.

Positions alone are differentiated, within the test function of each mean
(numerics/permitted_forces.py); an effort is what the drive's law makes of commands and
encoders, so that its ripple between rows does not matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_diag, csr_matrix
from scipy.spatial.transform import Rotation

from makebreak.gap.data.recording import Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.permitted_forces import (
    RATE_OF_MEAN,
    held_means,
    test_functions,
)
from makebreak.gap.numerics.signal_noise import jump_variance
from makebreak.gap.residuals.scene_motion import SmoothedEpisode
from makebreak.gap.residuals.touching import Touching
from makebreak.gap.simulation.windows import TURN
from makebreak.models.drives import law_of
from makebreak.models.scene import Scene
from makebreak.models.scene_schema import COMMANDS_OF

HOP = 0.75  # From one test function to the next, in half widths.
NODES = 5  # Rows of a test function at which geometry and dynamics are evaluated.
MOST = 420  # Test functions at most, and how many of them without a moving object.
STILL = 80
FEWEST_MEANS = 30
BETWEEN_ROWS = 1.5  # Commands from one row to the next: more, and some are not known.
SLIDES = 0.01  # Slower slip may be sticking [m/s].
MODELLED = 0.02  # What models are off by, as a share of the forces in a row.
UNKNOWN = 1e12  # Variance of what is not known.


@dataclass(eq=False)
class Means:
    """Means over K test functions; n_v coordinates, rows as of all episodes."""

    episode: np.ndarray  # (K,) index among the tracks.
    time: np.ndarray  # (K,) of the middle [s].
    acceleration: np.ndarray  # (K, n_v)
    acceleration_var: np.ndarray  # (K, n_v)
    effort: np.ndarray  # (K, n_v)
    effort_var: np.ndarray  # (K, n_v)
    effort_slope: np.ndarray  # (K, n_v) by a delay of all commands [N/s].
    centre: np.ndarray  # (K,) row of the middle.
    weights: csr_matrix  # (K, n_rows) of the rows at which things are evaluated.
    whole: csr_matrix  # (K, n_rows) of all rows.
    wrench: np.ndarray  # (K, n_wrench), forces and moments of all sensors
    wrench_var: np.ndarray
    extra: np.ndarray  # (K, n_extra) measured rates and efforts less what they must be.
    extra_var: np.ndarray

    def of(self, some: np.ndarray) -> "Means":
        """Of some (K,) test functions."""
        return Means(**{name: x[some] for name, x in vars(self).items()})


@dataclass(frozen=True, eq=False)
class _TestFunctions:
    """K test functions in an episode: middles (K,) and half widths (K,) [s], the first
    row (K,) of each and the one after its last (K,)."""

    track: SmoothedEpisode
    recording: Recording
    centres: np.ndarray
    half: np.ndarray
    first: np.ndarray
    last: np.ndarray

    def of(self, name: str):
        """Of a channel: the test functions over its samples, (K, n) weights of a mean
        and of a mean second derivative; the samples (n,); in which rows they are."""
        y = self.recording[name][self.track.episode.rows]
        there = np.isfinite(y)
        w, dd = test_functions(self.track.time[there], self.centres, self.half)
        return w, dd, y[there], there

    def middle_rows(self) -> np.ndarray:
        """(K,) within the episode."""
        time = self.track.time
        return np.clip(np.searchsorted(time, self.centres), 0, len(time) - 1)

    def nodes(self) -> csr_matrix:
        """(K, n_rows) weights of NODES rows spread over each test function."""
        rows, columns, values = [], [], []
        time = self.track.time
        for k, (b, e) in enumerate(zip(self.first, self.last, strict=True)):
            some = np.unique(np.linspace(b, e - 1, NODES + 2).astype(int))[1:-1]
            u = (time[some] - self.centres[k]) / self.half[k]
            weight = np.maximum(1.0 - u * u, 0.0) ** 4
            rows.append(np.full(len(some), k))
            columns.append(some)
            values.append(weight / weight.sum())
        index = (np.concatenate(rows), np.concatenate(columns))
        return csr_matrix(
            (np.concatenate(values), index), (len(self.centres), len(time))
        )


class ContactMeans(Touching):
    """The recordings of a scene as means over test functions.

    Raises: DoesNotFit where the recordings lack a part of the motion (a position of
        every joint, a whole pose of every free body), or hold too little of it.
    """

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        super().__init__(scene, recordings)
        self.means = self._all_means()
        if len(self.means.time) < FEWEST_MEANS:
            raise DoesNotFit("the recordings hold too little motion")

    def _all_means(self) -> Means:
        of_each = [self._means_of(number) for number in range(len(self.tracks))]
        parts = [part for part in of_each if part is not None]
        if not parts:
            raise DoesNotFit("no test function fits between changes of contact")
        joined = {
            name: np.concatenate([getattr(p, name) for p in parts])
            for name, x in vars(parts[0]).items()
            if not isinstance(x, csr_matrix)
        }
        columns = np.concatenate(
            [self._offset[p.episode[0]] + np.arange(len(self.tracks[p.episode[0]].time))
             for p in parts]
        )  # fmt: skip

        def of_all(each: list[csr_matrix]) -> csr_matrix:
            own = csr_matrix(block_diag(each, format="csr"))
            shape = own.shape[0], self._offset[-1]
            return csr_matrix((own.data, columns[own.indices], own.indptr), shape)

        joined["weights"] = of_all([p.weights for p in parts])
        joined["whole"] = of_all([p.whole for p in parts])
        keep = self._kept(joined)
        return Means(**{name: x[keep] for name, x in joined.items()})

    def _kept(self, joined) -> np.ndarray:
        """Which test functions: where an object moves first, few of the others."""
        v = self._v[joined["centre"]]
        moves = np.zeros(len(v), bool)
        for _, i in self.bodies.values():
            moves |= np.linalg.norm(v[:, i + 3 : i + 6], axis=1) > SLIDES
        if not self.bodies:
            moves[:] = True

        def thinned(which, most):
            index = np.flatnonzero(which)
            if len(index) <= most:
                return index
            return index[np.unique(np.linspace(0, len(index) - 1, most).astype(int))]

        return np.sort(np.concatenate([thinned(moves, MOST), thinned(~moves, STILL)]))

    def _means_of(self, number: int) -> Means | None:
        """The means over an episode; None: no test function fits between changes."""
        track = self.tracks[number]
        rows = slice(self._offset[number], self._offset[number + 1])
        centres, half = self._with_short_touches(
            track, rows, self._steady_centres(track, rows)
        )
        if not len(centres):
            return None
        phi = _TestFunctions(
            track, self.recordings[track.recording], centres, half,
            np.searchsorted(track.time, centres - half),
            np.searchsorted(track.time, centres + half),
        )  # fmt: skip
        acceleration, acceleration_var, full = self._accelerations(phi)
        effort, effort_var, slope = self._efforts(phi)
        wrench, wrench_var = self._wrench_means(phi)
        extra, extra_var = self._extra_means(phi, effort)
        full &= ~self._maybe_felt(phi.first, phi.last, rows, wrench, wrench_var)
        part = Means(
            np.full(len(centres), number), centres, acceleration, acceleration_var,
            effort, effort_var, slope, self._offset[number] + phi.middle_rows(),
            phi.nodes(), test_functions(track.time, centres, half)[0],
            wrench, wrench_var, extra, extra_var,
        )  # fmt: skip
        if not full.all():
            part = part.of(full)
        return part if len(part.time) else None

    def _steady_centres(self, track: SmoothedEpisode, rows: slice) -> np.ndarray:
        """Middles (K,) of test functions of the whole width in an episode, in which no
        contact comes or goes and nothing lands."""
        whole, time = self.half, track.time
        centres = np.arange(time[0] + whole, time[-1] - whole, HOP * whole)
        good = np.ones(len(centres), bool)
        first = np.searchsorted(time, centres - whole)
        last = np.searchsorted(time, centres + whole)
        for touching in self._touching.values():
            total = np.concatenate([[0], np.cumsum(touching[rows].astype(int))])
            inside = total[last] - total[first]
            good &= (inside == 0) | (inside == last - first)
        total = np.concatenate([[0], np.cumsum(self._is_struck(rows))])
        good &= total[last] == total[first]
        return centres[good]

    def _accelerations(self, phi: _TestFunctions):
        """Mean accelerations (K, n_v), their variances, and (K,) whether there are
        samples of every position."""
        K, n_v = len(phi.centres), self.plant.num_velocities()
        a, a_var, full = np.zeros((K, n_v)), np.zeros((K, n_v)), np.ones(K, bool)
        places = [(f"{j}.position", *index) for j, index in self.joints.items()]
        places += [
            (f"{body}.{axis}", i_q + 4 + k, i_v + 3 + k)
            for body, (i_q, i_v) in self.bodies.items()
            for k, axis in enumerate("xyz")
        ]
        for name, i_q, i_v in places:
            channel = phi.recording.channels[name]
            _, dd, y, there = phi.of(name)
            full &= np.diff(dd.indptr) > 0
            if channel.stages:  # Filtered: the smoothed position has no such delay.
                y = phi.track.q[there, i_q]
            a[:, i_v] = dd @ y
            a_var[:, i_v] = _squared(dd) * channel.noise**2
        for body, (_, i_v) in self.bodies.items():
            own = slice(i_v, i_v + 3)
            a[:, own], a_var[:, own], there = self._angular(phi, body)
            full &= there
        return a, a_var, full

    @staticmethod
    def _angular(phi: _TestFunctions, body: str):
        """Mean angular accelerations (K, 3) of a free body, their variances (K, 1), and
        (K,) whether there are samples of its orientation."""
        track, K = phi.track, len(phi.centres)
        names = [f"{body}.{c}" for c in TURN]
        q = np.stack([phi.recording[n][track.episode.rows] for n in names], axis=1)
        there = np.isfinite(q).all(axis=1)
        q = q[there] / np.linalg.norm(q[there], axis=1)[:, None]
        _, dd = test_functions(track.time[there], phi.centres, phi.half)
        noise = np.mean([phi.recording.channels[n].noise for n in names])
        a, var, middle = np.zeros((K, 3)), np.zeros((K, 1)), phi.middle_rows()
        for k in range(K):
            row = dd[[k]]
            some = row.indices
            if not len(some):
                continue
            # Small turns from the smoothed orientation at the middle.
            back = Rotation.from_quat(np.roll(track.turn[body][middle[k]], -1)).inv()
            turned = Rotation.from_quat(np.roll(q[some], -1, axis=1)) * back
            a[k] = row.data @ turned.as_rotvec()
            var[k] = 4.0 * noise**2 * np.sum(row.data**2)
        return a, var, np.diff(dd.indptr) > 0

    def _efforts(self, phi: _TestFunctions):
        """Mean efforts of the drives (K, n_v), their variances, and their slopes by a
        delay of all commands."""
        K, n_v = len(phi.centres), self.plant.num_velocities()
        effort, var, slope = (np.zeros((K, n_v)) for _ in range(3))
        held = held_means(phi.track.time, phi.centres, phi.half)
        for joint, (_, i_v) in self.joints.items():
            found = self._effort(joint, phi, held)
            effort[:, i_v], var[:, i_v], slope[:, i_v] = found
        return effort, var, slope

    def _effort(self, joint: str, phi: _TestFunctions, held: csr_matrix):
        """Mean effort (K,) of a drive, its variance, its slope by a delay of commands.

        Args: held (K, n_rows): the means of what holds from row to row.
        """
        K = len(phi.centres)
        how = self.by[joint]
        if how == "measured":
            name = f"{joint}.effort_measured"
            w, _, y, _ = phi.of(name)
            noise = phi.recording.channels[name].noise
            unknown = jump_variance(y, noise)
            return w @ y, variance_of_means(w, y, noise, unknown), np.zeros(K)
        if how == "command":
            return self._commanded_effort(joint, phi, held)
        if how == "law":
            return self._effort_by_law(joint, phi, held)
        # A passive joint has none; an effort that is not known explains nothing.
        return np.zeros(K), np.full(K, UNKNOWN if how == "" else 0.0), np.zeros(K)

    def _commanded_effort(self, joint: str, phi: _TestFunctions, held: csr_matrix):
        rows, time = phi.track.episode.rows, phi.track.time
        u = np.nan_to_num(phi.recording.held(f"{joint}.effort_command")[rows])
        K, rate_hz = len(phi.centres), self.scene.actuation.rate_hz
        rate = np.gradient(held @ u, phi.centres) if K > 1 else np.zeros(K)
        var = np.zeros(K)
        if rate_hz and rate_hz * np.median(np.diff(time)) > BETWEEN_ROWS:
            var = variance_of_means(held, u, 0.0)
        return held @ u, var, rate

    def _effort_by_law(self, joint: str, phi: _TestFunctions, held: csr_matrix):
        """Of a drive that computes its effort from commands and positions (law_of)."""
        track, recording = phi.track, phi.recording
        law = law_of(self.scene.actuation, joint)
        assert law is not None  # by[joint] says so.
        takes = COMMANDS_OF[self.scene.actuation.type]
        i_q, i_v = self.joints[joint]
        x, v = track.q[:, i_q], track.v[:, i_v]

        def column(what):
            name = f"{joint}.{what}"
            if what not in takes or name not in recording:
                return np.zeros(len(x))
            return np.nan_to_num(recording.held(name)[track.episode.rows])

        p, dp = column("position_command"), column("velocity_command")
        has_p = "position_command" in takes
        p = law.received(p)

        def effort(at):
            """With the commands of each row and the state at the rows `at`."""
            error = p - x[at] if has_p else np.zeros(len(x))
            return law.effort(error, dp, v[at])

        now = np.arange(len(x))
        u = 0.5 * (effort(now) + effort(np.minimum(now + 1, len(x) - 1)))
        kp = float(law.kp) if has_p else 0.0
        noise = recording.channels[f"{joint}.position"].noise
        w = phi.of(f"{joint}.position")[0]
        # Velocities are smoothed ones: known by positions, and better if measured too.
        v_var = RATE_OF_MEAN / phi.half**2 * noise**2
        velocity = recording.channels.get(f"{joint}.velocity")
        if velocity is not None and velocity.noise > 0.0:  # 0: it is not known.
            v_var = v_var * velocity.noise**2 / (v_var + velocity.noise**2)
        damping = float(law.kd + law.emf)
        var = _squared(w) * ((kp * noise) ** 2 + damping**2 * v_var)
        # Commands that act later by a while: less of what they ask by their rate.
        rate = np.gradient(p, track.time) if has_p else np.zeros(len(x))
        late = -(kp * rate + float(law.kd) * np.gradient(dp, track.time))
        return held @ u, var, held @ late

    def _wrench_means(self, phi: _TestFunctions):
        """Mean forces and moments (K, n_wrench) of all sensors, and their variances."""
        columns, variances = [], []
        for sensor in self.sensors:
            for name in sensor.names:
                w, _, y, _ = phi.of(name)
                columns.append(w @ y)
                # A knock is over between two samples: its force is hardly known.
                var = variance_of_means(w, y, phi.recording.channels[name].noise)
                # Where there are no samples, nothing is known.
                variances.append(np.where(var > 0.0, var, UNKNOWN))
        return _side_by_side(columns, phi), _side_by_side(variances, phi)

    def _extra_means(self, phi: _TestFunctions, effort: np.ndarray):
        """Means (K, n_extra) of redundant channels less what positions and commands say
        of them, and their variances. Args: effort (K, n_v)."""
        columns, variances, v = [], [], phi.track.v
        for name, i in self.extra:
            w, _, y, there = phi.of(name)
            if name.endswith(".effort_measured"):
                other, off = effort[:, i], MODELLED * float(np.std(effort[:, i]))
            else:
                other, off = w @ v[there, i], 0.01 * float(np.std(v[:, i])) + 1e-4
            size, noise = _squared(w), phi.recording.channels[name].noise
            columns.append(np.where(size > 0.0, w @ y - other, 0.0))
            # Where a joint is struck its smoothed rate changes over several samples.
            jumps = w.multiply(w) @ jump_variance(y, noise)
            variances.append(size * noise**2 + jumps + off**2)
        return _side_by_side(columns, phi), _side_by_side(variances, phi)


def _side_by_side(columns: list[np.ndarray], phi: _TestFunctions) -> np.ndarray:
    """(K, n) of n columns (K,)."""
    return np.stack(columns, axis=1) if columns else np.zeros((len(phi.centres), 0))


def _squared(w: csr_matrix) -> np.ndarray:
    """(K,) sums of the squares of each row: the variance of w @ y, of y's."""
    return np.asarray(w.multiply(w).sum(axis=1)).ravel()


def variance_of_means(
    w: csr_matrix, y: np.ndarray, noise: float, unknown: np.ndarray | float = 0.0
) -> np.ndarray:
    """(K,) of the means w @ y of samples y (n,): of their noise, and of what the signal
    does between them. Where it goes by d from one sample to the next its mean there is
    anything between the two, uniform: d^2/12. (An effort that jumps by 3 N m within a
    tenth of a second was off by six times its noise.) unknown: (n,) variance that the
    signal has between its samples, if that is more."""
    steps = np.maximum(np.diff(y) ** 2 - 2.0 * noise**2, 0.0)
    between = 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps)) / 12.0
    between = np.maximum(between, unknown)
    return np.asarray(w.multiply(w) @ (noise**2 + between)).ravel()

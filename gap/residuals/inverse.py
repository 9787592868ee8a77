"""Measured motion of a mechanism, and what any effects leave of its equations unmet.

For each episode the joints' positions are smoothed; the residual effort - ID(q, v, vd)
of the scene with given effects is tested with bumps and divided by the noise that the
positions have. What the other channels show of the same motion is tested beside it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from makebreak.gap.data.filters import FILTERED_SEC
from makebreak.gap.data.recording import Episode, Recording
from makebreak.gap.numerics.weak_form import Bumps, make_bumps
from makebreak.models.drives import law_of
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.actuation_path import OWN
from makebreak.models.effects.kind import (
    Effect,
    actuator_of,
    full_name,
    one_dof_joints,
)
from makebreak.models.effects.measured_channels import acts_on, is_link_side
from makebreak.models.effects.signature import Motion, added_effort
from makebreak.models.scene import Scene
from makebreak.systems.numerics.filters import (
    LowPass,
    Stage,
    filtered,
    mean_delay,
    subdivided,
    with_lag,
)
from makebreak.systems.numerics.smoother import smooth_filtered

SENSED = tuple(name for name, kind in KINDS.items() if kind.channel)
# Between command and motor; a gear's loss is in the equations.
PATH = tuple(n for n, kind in KINDS.items() if kind.path and kind.on_top is None)
# A joint that stands still may be held by any friction: what its equation says then is
# given this share of its rms effort as uncertainty, by the share of time at rest.
REST_SPEED, REST_SHARE, REST_EFFORT = 0.005, 0.04, 0.3
# Sampled at the very instants at which a stiff drive gets new commands, a velocity is
# off by a share of itself.
DRIVE_VELOCITY = 0.01
# Loops of drives run at a kilohertz or more: what they hold is late by half a period.
LOOP_SEC = 2.5e-4
MOST_MOTIONS, MOST_MEANS, MOST_DYNAMICS = 40, 1500, 8  # That are kept in memory.
MODEL_ERROR = 2e-4  # Of a joint's rms effort: what smoothing and sampling leave.


@dataclass(frozen=True, eq=False)
class Track:
    """One episode as measured. Rows: the table's; middles: of the intervals between.

    q, v, vd: smoothed positions on `grid` (rows and middles), (n_grid, n_v).
    """

    recording: str
    episode: int
    time: np.ndarray  # (n,) [s]
    middle: np.ndarray  # (n_mid,) Where the equations are evaluated [s].
    step: np.ndarray  # (n_mid,) How long each of these stands for [s].
    row: np.ndarray  # (n_mid,) Whose command holds there.
    grid: np.ndarray
    dense: np.ndarray  # (n_dense,) [s] The grid, for signals before a filter.
    q: np.ndarray
    v: np.ndarray
    vd: np.ndarray
    commands: dict[str, np.ndarray]  # Held, (n,).
    samples: dict[str, np.ndarray]  # Measured, (n,), NaN where missing.
    stages: dict[str, tuple[Stage, ...]]  # Declared filters of measured channels.
    bumps: Bumps  # On the middles.
    row_bumps: Bumps  # On the rows.
    block: np.ndarray  # (n_bumps,) Number of the block of time.
    train: np.ndarray  # (n_bumps,)


class _Dynamics(SceneDynamics):
    """Remembers how bodies moved: a dozen kinds ask for it."""

    def __init__(self, scene: Scene):
        super().__init__(scene)
        self._moved: dict = {}

    def body_motion(self, body, q, v, vd):
        key = (int(body.index()), id(q), id(v), id(vd))
        if key not in self._moved:
            # The arrays are kept as well, so that no other gets their id.
            self._moved[key] = (super().body_motion(body, q, v, vd), q, v, vd)
        return self._moved[key][0]

    def mass_times_com_jacobian(self, q):
        key = (-1, id(q))
        if key not in self._moved:
            self._moved[key] = (super().mass_times_com_jacobian(q), q)
        return self._moved[key][0]

    def forget(self) -> None:
        """Of all motions."""
        self._moved.clear()


class InverseModel:
    """Residuals of a mechanism all of whose joints have measured positions.

    Args: bump_sec: width of the test functions. block_sec: every third block of time
        of this length is held out.
    """

    def __init__(
        self,
        scene: Scene,
        recordings: Sequence[Recording],
        bump_sec: float = 0.2,
        block_sec: float = 1.2,
        most_sec: float = 60.0,
    ):
        self.scene = scene
        self._remembering = _Dynamics(scene)
        self.dynamics: SceneDynamics = self._remembering
        plant = self.dynamics.plant
        self.joints = [
            full_name(plant, j)
            for j in sorted(one_dof_joints(plant), key=lambda j: j.velocity_start())
        ]
        self.recordings = list(recordings)
        # Effects that the scene has already and its dynamics do not know.
        self._own = [
            e for e in scene.effects
            if e.kind in SENSED + PATH
            or KINDS[e.kind].hidden_state
            or KINDS[e.kind].on_top is not None
        ]  # fmt: skip
        self.noise = self._noise("position")
        self.velocity_noise = self._noise("velocity")
        # Root of how many neighbouring samples of a velocity err together.
        self._together = np.sqrt(
            [
                max((r.channels[c].together for r in recordings if c in r), default=1.0)
                for c in (f"{joint}.velocity" for joint in self.joints)
            ]
        )
        self.effort_noise = self._noise("effort_measured")
        self.has = {
            what: [all(f"{j}.{what}" in r for r in recordings) for j in self.joints]
            for what in (
                "velocity", "effort_measured", "effort_command", "position_command",
                "velocity_command",
            )
        }  # fmt: skip
        # Drives with a loop of their own, and which joints are commanded.
        self.laws = [law_of(scene.actuation, joint) for joint in self.joints]
        self.commanded = [
            self.has["effort_command"][i]
            or self.has["position_command"][i]
            or (self.laws[i] is not None and self.has["velocity_command"][i])
            for i in range(len(self.joints))
        ]
        # Of a joint without a command the measured effort stands in for it.
        self.by_measured = [
            measured and not commanded
            for measured, commanded in zip(
                self.has["effort_measured"], self.commanded, strict=True
            )
        ]
        # What turns the rotor is in no torque that is measured at the link.
        self._link_rotor = np.array(
            [rotor_before(scene, plant, joint) for joint in self.joints]
        )
        self._unseen_rotor = self._link_rotor * np.array(self.by_measured)
        self.tracks: list[Track] = []
        seconds = 0.0
        for recording in recordings:
            for episode in recording.episodes:
                if seconds > most_sec:
                    break
                track = self._track(recording, episode, bump_sec, block_sec)
                if track is not None:
                    self.tracks.append(track)
                    seconds += track.time[-1] - track.time[0]
        if not self.tracks:
            raise ValueError(
                f"no episode of the recordings is long enough for windows of "
                f"{bump_sec} s"
            )
        self.period = float(
            np.median(np.concatenate([np.diff(t.time) for t in self.tracks]))
        )
        self._noises = self._noise_of_rows()
        # What models are off by, beside noise [N m, rad/s].
        self.model_error = {
            what: np.zeros(len(self.joints))
            for what in ("effort", "velocity", "effort_measured")
        }
        self._plain = self._whitened_by(self.model_error)
        self._whiteners = self._plain
        self._base: np.ndarray | None = None
        self._motions: list[Motion] | None = None
        # Of a track and what moves it: the motion, and the effort that it needs.
        self._needed: dict[tuple, tuple[Motion, np.ndarray]] = {}
        # Means over bumps that come again and again in a fit.
        self._means: dict = {}
        self._heavier: dict[tuple, SceneDynamics] = {}

    def is_motor_side(self, i: int) -> bool:
        """Whether a joint's measured effort is the motor's, before its gear."""
        return not is_link_side(
            self.scene.channels, f"{self.joints[i]}.effort_measured"
        )

    def base(self) -> np.ndarray:
        """The residual of the scene as it came."""
        if self._base is None:
            self._base = self.residual()
        return self._base

    # ----- What was measured

    def _noise(self, what: str) -> np.ndarray:
        out = np.zeros(len(self.joints))
        for i, joint in enumerate(self.joints):
            found = [
                r.channels[f"{joint}.{what}"].noise
                for r in self.recordings
                if f"{joint}.{what}" in r
            ]
            out[i] = max(found, default=0.0)
        return out

    def _track(
        self, recording: Recording, episode: Episode, bump_sec, block_sec
    ) -> Track | None:
        time = recording.time[episode.rows]
        if time[-1] - time[0] < 2.0 * bump_sec:
            return None
        period = float(np.median(np.diff(time)))
        step = np.append(np.diff(time), period)
        middle = time + 0.5 * step
        grid = np.concatenate([time, middle])
        order = np.argsort(grid)
        grid = grid[order]
        n = len(self.joints)
        q, v, vd = (np.empty((len(grid), n)) for _ in range(3))
        for i, joint in enumerate(self.joints):
            y = recording[f"{joint}.position"][episode.rows]
            if np.isfinite(y).sum() < 6:
                return None
            seen = np.concatenate([y, np.full(len(time), np.nan)])[order]
            stages = recording.channels[f"{joint}.position"].stages or ()
            x = smooth_filtered(grid, seen, self.noise[i], stages).x
            q[:, i], v[:, i], vd[:, i] = x.T
        held = {}
        for channel in recording.commands():
            held[channel.name] = recording.held(channel.name)[episode.rows]
        samples = {c.name: c.values[episode.rows] for c in recording.measured()}
        stages_of = {c.name: c.stages or () for c in recording.measured()}
        late = max(mean_delay(stages_of[f"{j}.position"]) for j in self.joints)
        # Nothing is known before the first command, and little at the ends.
        known = np.ones(len(time), bool)
        for value in held.values():
            known &= np.isfinite(value)
        holes = [(time[k], time[k] + step[k]) for k in np.flatnonzero(~known)]
        long = np.flatnonzero(step > max(4.0 * period, 0.1 * bump_sec))
        holes += [(time[k], time[k] + step[k]) for k in long]
        holes.append((time[0] - 1.0, time[0] + 0.05))
        holes.append((time[-1] - 0.05 - late, time[-1] + 1.0))
        fine = _around_reversals(time, step, grid, v)
        row = np.searchsorted(time, fine[:-1] + 1e-12, "right") - 1
        middle, step = 0.5 * (fine[1:] + fine[:-1]), np.diff(fine)
        bumps = make_bumps(middle, step, bump_sec, 0.5 * bump_sec, holes)
        about = np.append(np.diff(time, prepend=time[0])[1:], period)
        row_bumps = make_bumps(time, about, bump_sec, 0.5 * bump_sec, holes)
        m = min(len(bumps.centre), len(row_bumps.centre))
        if m < 2:
            return None
        bumps, row_bumps = _first(bumps, m), _first(row_bumps, m)
        block = ((bumps.centre - time[0]) / block_sec).astype(int)
        return Track(
            recording.name, episode.number, time, middle, step, row, grid,
            subdivided(grid, FILTERED_SEC), q, v, vd, held, samples, stages_of,
            bumps, row_bumps, block, block % 3 != 1,
        )  # fmt: skip

    # ----- Residuals

    def motions(self) -> list[Motion]:
        """Of each track, as measured."""
        if self._motions is None:
            self._motions = [self.motion(track) for track in self.tracks]
        return self._motions

    def motion(self, track: Track, effects: Sequence[Effect] = ()) -> Motion:
        """The true motion at the middles, if the effects on measurement are these
        beside the scene's own."""
        t = track.middle
        effects = [*self._own, *effects]
        n = len(self.joints)
        q, v, vd = (np.empty((len(t), n)) for _ in range(3))
        for i, joint in enumerate(self.joints):
            scale, late, bias = _sensing(effects, f"{joint}.position")
            at = t * scale + late
            q[:, i], v[:, i], vd[:, i] = self._at(track, i, at)
            q[:, i] -= bias
            lag = _lag(effects, f"{joint}.position")
            if lag:  # What a low-pass took: true = measured + T d/dt measured.
                with_lag(track.stages[f"{joint}.position"], lag)  # Or it is refused.
                jerk = np.gradient(vd[:, i], t)
                q[:, i], v[:, i], vd[:, i] = (
                    q[:, i] + lag * v[:, i],
                    v[:, i] + lag * vd[:, i],
                    vd[:, i] + lag * jerk,
                )
            v[:, i] *= scale
            vd[:, i] *= scale**2
        effort = self._effort(track, effects[len(self._own) :], q, v)
        effort += self._unseen_rotor * vd
        jerk = np.asarray(np.gradient(vd, t, axis=0))
        return Motion(t, q, v, vd, effort, jerk)

    def _at(self, track: Track, i: int, t: np.ndarray):
        """Smoothed state of a joint at any times, as cubics between the grid's."""
        grid = track.grid
        k = np.clip(np.searchsorted(grid, t, "right") - 1, 0, len(grid) - 2)
        h = grid[k + 1] - grid[k]
        s = np.clip((t - grid[k]) / h, 0.0, 1.0)
        a, b = track.vd[k, i], track.vd[k + 1, i]
        d = s * h
        vd = a + (b - a) * s
        v = track.v[k, i] + a * d + 0.5 * (b - a) / h * d**2
        q = track.q[k, i] + track.v[k, i] * d + 0.5 * a * d**2 + (b - a) / h * d**3 / 6
        return q, v, vd

    def _effort(self, track: Track, effects, q, v) -> np.ndarray:
        """(n, n_v) mean effort over each interval, after the path."""
        effects = [*self._own, *effects]
        out = np.zeros_like(q)
        for i, joint in enumerate(self.joints):
            delay, gain, bias, limit, lag, kp = _path(effects, joint)
            law = self.laws[i]
            if law is not None and self.commanded[i]:
                law = law.with_kp(kp)
                error, rate = np.zeros_like(v[:, i]), np.zeros_like(v[:, i])
                if f"{joint}.position_command" in track.commands:
                    wanted = law.received(track.commands[f"{joint}.position_command"])
                    seen = q[:, i] + _sensing(effects, f"{joint}.position")[2]
                    error = _mean_held(track, wanted, delay) - seen
                if f"{joint}.velocity_command" in track.commands:
                    told = track.commands[f"{joint}.velocity_command"]
                    rate = _mean_held(track, told, delay)
                u = law.effort(error, rate, v[:, i])
            elif self.has["effort_command"][i]:
                u = _mean_held(track, track.commands[f"{joint}.effort_command"], delay)
            elif self.by_measured[i]:
                y = track.samples[f"{joint}.effort_measured"]
                good = np.isfinite(y)
                name = f"{joint}.effort_measured"
                late = mean_delay(track.stages[name]) + given_late(effects, name)
                t = track.middle - delay + late
                u = np.interp(t, track.time[good], y[good])
            else:
                continue
            u = np.clip(gain * u + bias, -limit, limit)
            if lag > 0.0:
                u = _mean_lagged(track.step, u, lag)
            out[:, i] = u
        return out

    def _noise_of_rows(self) -> list[dict[str, np.ndarray]]:
        """For each track: the covariance of each bump's residual efforts, and standard
        deviations of the other channels', as the sensors' noise gives them."""
        size = np.concatenate([self._effort(t, (), *self._qv(t)) for t in self.tracks])
        rms = _rms(size)
        rms = np.maximum(rms, 0.1 * rms.max())
        kp, kd = np.zeros(len(self.joints)), np.zeros(len(self.joints))
        for i, law in enumerate(self.laws):
            if law is not None:
                kp[i], kd[i] = law.kp, law.kd + law.emf
        out = []
        for track in self.tracks:
            q, v = self._qv(track)
            rest = track.bumps.mean((np.abs(v) < REST_SPEED).astype(float))
            held = np.where(rest > REST_SHARE, rest, 0.0) * REST_EFFORT * rms
            centre = np.clip(
                np.searchsorted(track.middle, track.bumps.centre), 0, len(q) - 1
            )
            period = _spacing(track, [f"{j}.position" for j in self.joints])
            g2 = track.bumps.position_noise_gain(period)
            g0 = track.bumps.noise_gain(period)
            g_v, g_e = (
                np.array([
                    track.bumps.noise_gain(_spacing(track, [f"{j}.{what}"]))
                    if has else g0
                    for j, has in zip(self.joints, self.has[what], strict=True)
                ])
                for what in ("velocity", "effort_measured")
            )  # fmt: skip
            eye = np.eye(len(self.joints))
            C = np.empty((len(centre), *eye.shape))
            # When within a period an effort was sampled is not known.
            effort = self._effort(track, (), q, v)
            mean = track.bumps.mean(effort)
            rate = np.gradient(mean, track.bumps.centre, axis=0)
            raw = min(r.period_sec() for r in self.recordings)
            e_std = np.hypot(MODEL_ERROR * rms, 0.5 * raw * _rms(rate))
            direct = (kp * self.noise * g0) ** 2 + (MODEL_ERROR * rms) ** 2
            direct += np.array(self.by_measured) * (self.effort_noise * g_e) ** 2
            for b, k in enumerate(centre):
                M = self._mass_matrix(q[k])
                C[b] = (M * (g2 * self.noise) ** 2) @ M.T
                C[b] += np.diag(direct + held[b] ** 2)
            # The smoothed velocity's own error, as over one bump.
            own = self.noise * np.sqrt(period * 12.0 / track.bumps.width**3)
            v_std = np.hypot(self.velocity_noise * g_v * self._together, own)
            v_std = np.hypot(v_std, np.where(kd > 0.0, DRIVE_VELOCITY * _rms(v), 0.0))
            out.append(
                {
                    "effort": C,
                    "velocity": np.maximum(v_std, 1e-12),
                    "effort_measured": np.maximum(
                        np.hypot(self.effort_noise * g_e, e_std), 1e-12
                    ),
                }
            )
        return out

    def _whitened_by(self, error) -> list[dict[str, np.ndarray]]:
        """For each track: inverse square roots of the efforts' covariance with what
        models are off by, and standard deviations of the other channels'."""
        out = []
        for noise in self._noises:
            C = noise["effort"] + np.diag(error["effort"] ** 2)
            each = {"effort": np.linalg.inv(np.linalg.cholesky(C))}
            for what in ("velocity", "effort_measured"):
                each[what] = np.hypot(noise[what], error[what])
            out.append(each)
        return out

    def allow(
        self, error: dict[str, np.ndarray], more: np.ndarray | None = None
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Takes models to be off by so much, {what: (n_joints,)} [N m, rad/s], beside
        noise. Returns: what gives rows (m, ...) of before in the new units.

        Args: more (n_bumps, n_joints): further noise of the joints' equations [N m].
        """
        old = self._whiteners
        if more is not None:
            first = 0
            for noise in self._noises:
                C = noise["effort"]
                each = more[first : first + len(C)]
                first += len(C)
                C += np.eye(C.shape[1]) * each[:, None] ** 2
            self._plain = self._whitened_by({w: 0.0 * x for w, x in error.items()})
        self.model_error = error
        self._whiteners = self._whitened_by(error)
        self._base = None
        new = self._whiteners
        return lambda rows: self._rewhitened(rows, old, new)

    def in_noise(self, left: np.ndarray) -> np.ndarray:
        """Rows (m,) over the sensors' noise alone."""
        return self._rewhitened(left, self._whiteners, self._plain)

    def in_units(self, left: np.ndarray) -> np.ndarray:
        """(n_bumps, n_names) of rows (m,): [N m] or [N], and units of channels."""
        return self._rewhitened(left, self._whiteners, None).reshape(
            -1, len(self.names())
        )

    def noise_in_units(self) -> np.ndarray:
        """(n_bumps, n_names) standard deviations that the sensors' noise gives."""
        others = self._other_names()
        found = []
        for noise in self._noises:
            C = noise["effort"]
            std = np.sqrt(np.einsum("bii->bi", C))
            row = [noise[what][self.joints.index(joint)] for what, joint in others]
            found.append(np.hstack([std, np.tile(row, (len(C), 1))]))
        return np.concatenate(found)

    def _rewhitened(self, rows: np.ndarray, old, new) -> np.ndarray:
        """Rows (m, ...) in the units of other whiteners; None: in the channels' own."""
        k, n = len(self.names()), len(self.joints)
        others = self._other_names()
        parts, first = [], 0
        for i, track in enumerate(self.tracks):
            size = len(track.bumps.centre)
            mine = np.array(rows[first : first + size * k])
            first += size * k
            mine = mine.reshape(size, k, *rows.shape[1:])
            T = np.linalg.inv(old[i]["effort"])
            if new is not None:
                T = new[i]["effort"] @ T
            mine[:, :n] = np.einsum("bij,bj...->bi...", T, mine[:, :n])
            for c, (what, joint) in enumerate(others):
                j = self.joints.index(joint)
                by = 1.0 if new is None else new[i][what][j]
                mine[:, n + c] *= old[i][what][j] / by
            parts.append(mine.reshape(size * k, *rows.shape[1:]))
        return np.concatenate(parts)

    def channel_of_rows(self) -> np.ndarray:
        """(m,) index in names() of each row."""
        n = sum(len(t.bumps.centre) for t in self.tracks)
        return np.tile(np.arange(len(self.names())), n)

    def _qv(self, track):
        both = [self._at(track, i, track.middle)[:2] for i in range(len(self.joints))]
        return tuple(np.stack(x, axis=1) for x in zip(*both, strict=True))

    def _mass_matrix(self, q) -> np.ndarray:
        plant, context = self.dynamics.plant, self.dynamics._context
        plant.SetPositions(context, q)
        return plant.CalcMassMatrix(context)

    def residual(self, effects: Sequence[Effect] = ()) -> np.ndarray:
        """(m,) residual over its noise, of the scene with these effects added."""
        hidden = [
            e for e in self._own
            if KINDS[e.kind].hidden_state or KINDS[e.kind].on_top is not None
        ]  # fmt: skip
        ours = [*hidden, *(e for e in effects if e.kind not in SENSED + PATH)]
        moving = [
            e for e in effects
            if e.kind in SENSED
            and any(acts_on(e, KINDS[e.kind].channel, f"{j}.position")
                    for j in self.joints)
        ]  # fmt: skip
        dynamics: SceneDynamics = self.dynamics
        heavy = [e for e in ours if KINDS[e.kind].weighs]
        if not _adds_up(heavy):
            dynamics = self._with(heavy)
            ours = [e for e in ours if e not in heavy]
        on_top = [e for e in ours if KINDS[e.kind].on_top is not None]
        parts = []
        for k, (track, white) in enumerate(
            zip(self.tracks, self._whiteners, strict=True)
        ):
            if on_top or any(self.has["effort_measured"]) and not all(self.by_measured):
                r, motion = self._unmet(k, dynamics, effects, ours, moving)
            else:
                r, motion = self._unmet_sum(k, dynamics, effects, heavy, ours, moving)
            others = self._other_rows(k, effects, motion)
            parts.append(self._stacked(track, white, r, others))
        return np.concatenate(parts)

    def _with(self, heavy: Sequence[Effect]) -> SceneDynamics:
        """Of the scene with these effects too."""
        key = tuple(e.key for e in heavy)
        if key not in self._heavier:
            if len(self._heavier) > MOST_DYNAMICS:
                self._heavier.clear()
            scene = replace(self.scene, effects=[*self.scene.effects, *heavy])
            self._heavier[key] = SceneDynamics(scene)
        return self._heavier[key]

    def _unmet(self, k: int, dynamics, effects, ours, moving):
        """(n_bumps, n_v) means over bumps of what a track's equations leave, and its
        motion with the effort that acts."""
        motion, needed = self._moved_by(k, moving)
        if dynamics is not self.dynamics:
            needed = motion.effort - dynamics.residual(motion)
        # A gear's loss goes with what all the others need.
        for effect in sorted(ours, key=lambda e: KINDS[e.kind].on_top is not None):
            on_top = KINDS[effect.kind].on_top
            if on_top is not None:
                needed = needed + on_top(effect, dynamics, motion, needed)
                continue
            needed = needed + _added(effect, dynamics, motion)
        motion = self._driven_by(k, motion, effects)
        return self.tracks[k].bumps.mean(motion.effort - needed), motion

    def _unmet_sum(self, k: int, dynamics, effects, heavy, ours, moving):
        """The same where effects add up: what each of them adds is kept, as a fit
        changes one parameter at a time."""
        bumps = self.tracks[k].bumps
        motion, _ = self._moved_by(k, moving)
        weights = () if dynamics is self.dynamics else tuple(e.key for e in heavy)
        where = (k, tuple(e.key for e in moving), weights)

        def rest() -> np.ndarray:
            needed = self._moved_by(k, moving)[1]
            if dynamics is not self.dynamics:
                needed = motion.effort - dynamics.residual(motion)
            return bumps.mean(self._driven_by(k, motion, effects).effort - needed)

        path = tuple(e.key for e in effects if e.kind in SENSED + PATH)
        r = self._kept((where, path), rest)
        for effect in ours:
            r = r - self._kept(
                (where, effect.key),
                partial(_added_mean, effect, dynamics, motion, bumps),
            )
        return r, motion

    def _driven_by(self, k: int, motion: Motion, effects) -> Motion:
        """A motion with the effort that acts under these effects."""
        effort = self._effort(self.tracks[k], effects, motion.q, motion.v)
        return replace(motion, effort=effort + self._unseen_rotor * motion.vd)

    def _kept(self, key, compute: Callable[[], np.ndarray]) -> np.ndarray:
        """What was computed for a key before, or now."""
        if key not in self._means:
            if len(self._means) > MOST_MEANS:
                self._means.clear()
            self._means[key] = compute()
        return self._means[key]

    def _moved_by(self, k: int, moving: Sequence[Effect]) -> tuple[Motion, np.ndarray]:
        """A track's motion, and the effort that the scene as it came needs for it."""
        names = [f"{joint}.position" for joint in self.joints]
        sensed = tuple((*_sensing(moving, n), _lag(moving, n)) for n in names)
        key = (k, *sensed) if moving else (k,)
        if key not in self._needed:
            motion = (
                self.motion(self.tracks[k], moving) if moving else self.motions()[k]
            )
            if len(self._needed) > MOST_MOTIONS + len(self.tracks):
                self._needed = {i: x for i, x in self._needed.items() if len(i) == 1}
                self._remembering.forget()
            needed = motion.effort - self.dynamics.residual(motion)
            self._needed[key] = (motion, needed)
        return self._needed[key]

    def needed_motions(self) -> list[Motion]:
        """Of each track, as measured, with the effort that the scene needs for it."""
        both = [self._moved_by(k, ()) for k in range(len(self.tracks))]
        return [replace(motion, effort=needed) for motion, needed in both]

    def columns_of(self, efforts: Sequence[np.ndarray]) -> np.ndarray:
        """(m, k) from columns of the residual effort at the middles of each track,
        (n, n_v, k)."""
        parts = []
        for track, white, columns in zip(
            self.tracks, self._whiteners, efforts, strict=True
        ):
            mean = track.bumps.mean(columns)
            parts.append(self._stacked(track, white, mean, None))
        return np.concatenate(parts)

    def _other_rows(self, k: int, effects, motion) -> dict[str, np.ndarray]:
        out, track = {}, self.tracks[k]
        effects = [*self._own, *effects]
        sensing = [e for e in effects if e.kind in SENSED]
        key = (k, "rates", *(e.key for e in sensing))
        for i, joint in enumerate(self.joints):
            if self.has["velocity"][i]:
                out[f"{joint}.velocity"] = self._kept(
                    (*key, i), partial(self._velocity_row, track, sensing, i)
                )
            if self.has["effort_measured"][i] and not self.by_measured[i]:
                name = f"{joint}.effort_measured"
                scale, late, bias = _sensing(effects, name)
                stages = with_lag(track.stages[name], _lag(effects, name))
                u = motion.effort[:, i] - self._link_rotor[i] * motion.vd[:, i]
                at = (track.time - late) / scale
                u = filtered(stages, track.middle, u, np.minimum(at, track.middle[-1]))
                out[name] = _masked(track, track.samples[name] - u - bias)
        return out

    def _velocity_row(self, track: Track, effects, i: int) -> np.ndarray:
        """(n_bumps,) what a velocity shows beside the rate of the joint's position."""
        joint = self.joints[i]
        name = f"{joint}.velocity"
        scale, late, bias = _sensing(effects, name)
        p_scale, p_late, _ = _sensing(effects, f"{joint}.position")
        true = (track.time - late) / scale
        stages = with_lag(track.stages[name], _lag(effects, name))
        p_lag = _lag(effects, f"{joint}.position")

        def rate(t):
            _, v, vd = self._at(track, i, t * p_scale + p_late)
            return p_scale * (v + p_lag * vd)

        if stages:
            seen = filtered(stages, track.dense, rate(track.dense), true)
        else:
            seen = rate(true)
        return _masked(track, track.samples[name] - seen - bias)

    def declared_lag(self, channel: str) -> float:
        """Time constant [s] of the slowest first-order filter that is declared; 0 where
        there is none."""
        slow = [
            1.0 / s.cutoff
            for s in self.tracks[0].stages[channel]
            if isinstance(s, LowPass) and s.order == 1
        ]
        return max(slow, default=0.0)

    def filter_timing(self) -> tuple[list[np.ndarray], list[float], list[str]]:
        """Columns (m,) of the residual, standard deviations [s] and names of what is
        not known of declared filters of velocities: at which instant of a row's period
        they were computed. Three tolerances are half a period."""
        columns, prior, names = [], [], []
        for i, joint in enumerate(self.joints):
            name = f"{joint}.velocity"
            if not self.has["velocity"][i] or not any(
                track.stages[name] for track in self.tracks
            ):
                continue
            parts = []
            for track, white in zip(self.tracks, self._whiteners, strict=True):
                none = np.zeros((len(track.bumps.centre), len(self.joints)))
                others = {f"{j}.{what}": none[:, 0] for what, j in self._other_names()}
                _, _, vd = self._at(track, i, track.dense)
                stages = track.stages[name]
                rate = filtered(stages, track.dense, vd, track.time)
                there = np.where(np.isfinite(track.samples[name]), rate, np.nan)
                others[name] = _masked(track, -there)
                parts.append(self._stacked(track, white, none, others))
            columns.append(np.concatenate(parts))
            prior.append(min(r.period_sec() for r in self.recordings) / 6.0)
            names.append(f"sensor_delay of {name}, delay")
        return columns, prior, names

    def loop_timing(self) -> tuple[list[np.ndarray], list[float], list[str]]:
        """Columns (m,) of the residual, standard deviations [s] and names of what is
        not known of drives' own loops: by how much the velocity that they feed back is
        late. (A late position is damping, which is looked for.)"""
        columns, names = [], []
        for i, law in enumerate(self.laws):
            if law is None or not self.commanded[i] or not law.kd > 0.0:
                continue
            efforts = []
            for motion in self.motions():
                late = np.zeros((*motion.v.shape, 1))
                late[:, i, 0] = law.kd * motion.vd[:, i]
                efforts.append(late)
            columns.append(self.columns_of(efforts)[:, 0])
            names.append(f"input_delay of {self.joints[i]}, loop")
        return columns, [LOOP_SEC] * len(columns), names

    def _stacked(self, track, white, efforts, others) -> np.ndarray:
        """Rows of one track: bump by bump, efforts of all joints, then the others."""
        shape = efforts.shape[2:]
        e = np.einsum("bij,bj...->bi...", white["effort"], efforts)
        parts = [e]
        for what in ("velocity", "effort_measured"):
            for i, joint in enumerate(self.joints):
                if (what, joint) not in self._other_names():
                    continue
                if others is None:
                    parts.append(np.zeros((len(e), 1, *shape)))
                else:
                    y = others[f"{joint}.{what}"] / white[what][i]
                    parts.append(y[:, None])
        return np.concatenate(parts, axis=1).reshape(-1, *shape)

    def _other_names(self) -> list[tuple[str, str]]:
        v = [("velocity", j) for i, j in enumerate(self.joints)
             if self.has["velocity"][i]]  # fmt: skip
        u = [
            ("effort_measured", j)
            for i, j in enumerate(self.joints)
            if self.has["effort_measured"][i] and not self.by_measured[i]
        ]
        return v + u

    # ----- Rows

    def names(self) -> list[tuple[str, str]]:
        """(what, joint) of the entries of one bump."""
        return [("effort", joint) for joint in self.joints] + self._other_names()

    def train(self) -> np.ndarray:
        """(m,) booleans."""
        k = len(self.names())
        return np.concatenate([np.repeat(t.train, k) for t in self.tracks])

    def blocks(self) -> np.ndarray:
        """(m,) number of the block of time of each row."""
        k, first, numbers = len(self.names()), 0, []
        for track in self.tracks:
            numbers.append(np.repeat(first + track.block, k))
            first += int(track.block.max(initial=-1)) + 1
        return np.concatenate(numbers)


def _adds_up(heavy: Sequence[Effect]) -> bool:
    """Whether what weights and gravity change is the sum of what each does: gravity
    changes all weights, a link's mass the moment of where its centre is, and masses on
    two links add up, as inverse dynamics is linear in them."""
    if any(KINDS[e.kind].added is None for e in heavy):
        return False
    places = [at for e in heavy for at in e.at]
    tilted = any(KINDS[e.kind].at == "base" for e in heavy)
    return len(heavy) < 2 or (not tilted and len(set(places)) == len(places))


def _added_mean(effect: Effect, dynamics, motion: Motion, bumps) -> np.ndarray:
    return bumps.mean(_added(effect, dynamics, motion))


def _added(effect: Effect, dynamics: SceneDynamics, motion: Motion) -> np.ndarray:
    add = added_effort(effect, KINDS[effect.kind], dynamics, motion)
    if add is None:
        raise ValueError(f"{effect.kind} is seen in simulation alone")
    return add


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, axis=0))


def _first(bumps: Bumps, m: int) -> Bumps:
    return Bumps(bumps.w[:m], bumps.dw[:m], bumps.centre[:m], bumps.width)


def _masked(track: Track, difference: np.ndarray) -> np.ndarray:
    """Means over bumps of what is there; 0 where next to nothing is, beside what that
    channel usually has: it may be slower than the table."""
    good = np.isfinite(difference)
    weight = track.row_bumps.mean(good.astype(float))
    total = track.row_bumps.mean(np.where(good, difference, 0.0))
    least = 0.3 * max(float(np.median(weight)), 1e-9)
    return np.where(weight > least, total / np.maximum(weight, least), 0.0)


def _spacing(track: Track, channels: Sequence[str]) -> float:
    """Usual time between samples [s] of the slowest of the channels."""
    steps = [
        np.median(np.diff(track.time[np.isfinite(track.samples[c])]))
        for c in channels
        if np.isfinite(track.samples[c]).sum() > 1
    ]
    return float(max(steps, default=np.median(np.diff(track.time))))


def _sensing(effects: Sequence[Effect], channel: str) -> tuple[float, float, float]:
    """(1 + skew, delay, bias) of a channel."""
    scale, late, bias = 1.0, 0.0, 0.0
    for effect in effects:
        if effect.kind not in SENSED or not acts_on(
            effect, KINDS[effect.kind].channel, channel
        ):
            continue
        p = effect.parameters
        late += p.get("delay", 0.0)
        scale += p.get("skew", 0.0)
        bias += p.get("bias", 0.0) + p.get("offset", 0.0)
    return scale, late, bias


def given_late(effects: Sequence[Effect], channel: str) -> float:
    """By how much [s] a measured effort that stands in for a command is late: by the
    effects that name this very channel. Those of a whole joint or model say how late
    its other channels are beside the commands, and so beside what stands in for them.
    """
    return sum(
        effect.parameters["delay"]
        for effect in effects
        if KINDS[effect.kind].channel == "delay" and channel in effect.at
    )


def rotor_before(scene: Scene, plant: MultibodyPlant, joint: str) -> float:
    """Inertia [kg m2], at the joint, of a rotor before the sensor of effort, where the
    scene's `channels` say that it measures on the link's side; else 0."""
    if not is_link_side(scene.channels, f"{joint}.effort_measured"):
        return 0.0
    (own,) = [j for j in one_dof_joints(plant) if full_name(plant, j) == joint]
    actuator = actuator_of(plant, own)
    return 0.0 if actuator is None else float(actuator.default_reflected_inertia())


def _lag(effects: Sequence[Effect], channel: str) -> float:
    """Time constants [s] of a channel's low-passes, added up."""
    return sum(
        effect.parameters["time_constant"]
        for effect in effects
        if KINDS[effect.kind].channel == "lag" and acts_on(effect, "lag", channel)
    )


def _path(effects: Sequence[Effect], joint: str):
    delay, gain, bias, limit, lag, kp = 0.0, 1.0, 0.0, np.inf, 0.0, OWN
    for effect in effects:
        if effect.kind not in PATH:
            continue
        if joint not in effect.at and joint.split(".")[0] not in effect.at:
            continue
        p = effect.parameters
        delay += p.get("delay", 0.0)
        gain *= p.get("gain", 1.0)
        bias += p.get("bias", 0.0)
        limit = min(limit, p.get("limit", np.inf))
        lag += p.get("time_constant", 0.0)
        kp = p.get("kp", kp)
    return delay, gain, bias, limit, lag, kp


def _mean_held(track: Track, command: np.ndarray, delay: float) -> np.ndarray:
    """(n_mid,) mean over each interval of a command that arrives late."""
    u = np.where(np.isfinite(command), command, 0.0)[track.row]
    if delay == 0.0:
        return u
    edges = np.append(track.time[0], track.time[0] + np.cumsum(track.step))
    total = np.concatenate([[0.0], np.cumsum(u * track.step)])
    # Before the first command: that command.
    at = edges - delay
    value = np.interp(at, edges, total) + np.minimum(at - edges[0], 0.0) * u[0]
    return np.diff(value) / track.step


def _around_reversals(time, step, grid, v) -> np.ndarray:
    """Edges of intervals: the rows' own, in eight parts where a joint reverses, so that
    the instant at which friction turns round is known well."""
    edges = np.append(time, time[-1] + step[-1])
    speed = np.stack([np.interp(edges, grid, each) for each in v.T], axis=1)
    turns = (np.sign(speed[1:]) != np.sign(speed[:-1])).any(axis=1)
    turns |= np.append(turns[1:], False) | np.append(False, turns[:-1])
    parts = [
        edges[k] + (edges[k + 1] - edges[k]) * np.arange(8) / 8.0
        for k in np.flatnonzero(turns)
    ]
    return np.unique(np.concatenate([edges, *parts]))


def _mean_lagged(step: np.ndarray, u: np.ndarray, lag: float) -> np.ndarray:
    """(n,) means of y' = (u - y)/lag over the intervals, u held in each."""
    keep = np.exp(-step / lag)
    y = np.empty(len(u) + 1)
    y[0] = u[0]
    for k in range(len(u)):
        y[k + 1] = keep[k] * y[k] + (1.0 - keep[k]) * u[k]
    return u - lag * np.diff(y) / step

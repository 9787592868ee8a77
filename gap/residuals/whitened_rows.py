"""Residuals of a mechanism as rows over their noise, one for each test function.

A row is the mean over a test function of a joint's equation, or of what another channel
shows of the same motion: the noise of positions, twice differentiated, goes through the
mass matrix into all joints' equations.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.data.recording import Recording
from makebreak.gap.numerics.signal_noise import jump_variance
from makebreak.gap.residuals.mechanism_motion import MechanismMotion
from makebreak.gap.residuals.track import Track
from makebreak.gap.simulation.driven_arm import LEAD, STOPS
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.signature import Motion
from makebreak.models.scene import Scene, joint_laws
from makebreak.systems.numerics.joint_laws import most_friction

OTHERS = ("velocity", "effort_measured")  # Channels that are compared beside.
# A joint that stands still, slower than this [rad/s], or [m/s], may be held by any
# friction: what its equation says then is given that, or this share of its rms effort
# where no friction is known, as uncertainty, by the share of time at rest.
REST_SPEED, REST_SHARE, REST_EFFORT = 0.005, 0.04, 0.3
# Sampled at the very instants at which a stiff drive gets new commands, a velocity is
# off by a share of itself; means over more samples by less.
DRIVE_VELOCITY = 0.01
MODEL_ERROR = 2e-4  # Of a joint's rms effort: what smoothing and sampling leave.
LEAST_EFFORT = 0.1  # Of a joint, as a share of the largest joint's: rms.
LEAST_STD = 1e-12  # Of a channel that has no noise.
# Of the largest friction that holds a joint: less is none other. Of a friction that
# holds softly, what its law may be off by.
SAME_HOLD, LAW = 0.01, 0.1


class WhitenedRows(MechanismMotion):
    """The rows of all tracks, track by track and test function by test function: the
    joints' equations, then the other channels, in the order of names().

    Arguments: as of MechanismMotion.
    """

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        super().__init__(scene, recordings)
        # Through which the noise of positions goes into equations: the scene's, or that
        # of a model with effects, divided by its drives' gains.
        self._weighed_by, self._divided_by = self.dynamics, np.ones(len(self.joints))
        self._more: list[np.ndarray] = []
        # (n_joints,) What the scene's own dry friction holds [N m], and all that may
        # hold; NaN: that is not known.
        self._dry = most_friction(
            joint_laws(self.dynamics.loaded.effects, self.dynamics.plant),
            len(self.joints),
        )
        self._hold = np.full(len(self.joints), np.nan)
        zero = np.zeros(self.dynamics.plant.num_positions())
        self._mobility = np.diag(np.linalg.inv(self._mass_matrix(zero)))
        self._noises = self._noise_of_rows()
        # What models are off by, beside noise [N m, rad/s].
        self.model_error = {
            what: np.zeros(len(self.joints)) for what in ("effort", *OTHERS)
        }
        self._plain = self._whitened_by(self.model_error)
        self._whiteners = self._plain

    def _noise_of_rows(self) -> list[dict[str, np.ndarray]]:
        """For each track: the covariance of each bump's residual efforts, and standard
        deviations of the other channels', as the sensors' noise gives them."""
        efforts = [self._effort(t, (), *t.motion_at_middles()[:2]) for t in self.tracks]
        rms = rms_of(np.concatenate(efforts))
        rms = np.maximum(rms, LEAST_EFFORT * rms.max())
        kp, kd = np.zeros(len(self.joints)), np.zeros(len(self.joints))
        for i, law in enumerate(self.laws):
            if law is not None:
                kp[i], kd[i] = law.kp, law.kd + law.emf
        return [self._noise_of(track, rms, kp, kd) for track in self.tracks]

    def _noise_of(self, track: Track, rms, kp, kd) -> dict[str, np.ndarray]:
        """The same of one track; rms (n_v,) of the efforts, kp, kd (n_v,) of drives'
        own loops."""
        q, v, vd = track.motion_at_middles()
        period = track.spacing([f"{j}.position" for j in self.joints])
        g2 = track.bumps.position_noise_gain(period)
        g0 = track.bumps.noise_gain(period)
        g_v, g_e = (self._gains(track, what, g0) for what in OTHERS)
        # When within a period an effort was sampled is not known.
        mean = track.bumps.mean(self._effort(track, (), q, v))
        rate = np.gradient(mean, track.bumps.centre, axis=0)
        raw = min(r.period_sec() for r in self.recordings)
        e_std = np.hypot(MODEL_ERROR * rms, 0.5 * raw * rms_of(rate))
        direct = (kp * self.noise * g0) ** 2 + (MODEL_ERROR * rms) ** 2
        direct += np.array(self.by_measured) * (self.effort_noise * g_e) ** 2
        direct = direct + self._unknown_jumps(track) ** 2
        rest = self.at_rest(track, self.stops_sec, self._hold)
        untold = np.where(rest > REST_SHARE, rest, 0.0) * REST_EFFORT * rms
        held = np.maximum(rest * self._dry, untold)
        held = np.where(np.isnan(self._hold), held, rest * self._hold)
        # The smoothed velocity's own error, as over one bump.
        own = self.noise * np.sqrt(period * 12.0 / track.bumps.width**3)
        if self.stops_sec:  # Of what that law gives, and by the velocity's noise.
            held *= LAW * track.bumps.mean(np.abs(self._ramp(v, vd)))
            held = np.hypot(held, rest * own / (self.stops_sec * self._mobility))
        centre = np.clip(
            np.searchsorted(track.middle, track.bumps.centre), 0, len(q) - 1
        )
        C = np.empty((len(centre), len(self.joints), len(self.joints)))
        # What friction holds softly has more inertia.
        more = LEAD * rest / self._mobility if self.stops_sec else 0.0 * rest
        for b, k in enumerate(centre):
            M = self._mass_matrix(q[k]) + np.diag(more[b])
            M = M / self._divided_by[:, None]
            C[b] = (M * (g2 * self.noise) ** 2) @ M.T
            C[b] += np.diag(direct[b])
        v_std = np.hypot(self.velocity_noise * g_v * self._together, own)
        swing = DRIVE_VELOCITY * rms_of(v) / self._averaged
        v_std = np.hypot(v_std, np.where(kd > 0.0, swing, 0.0))
        return {
            "effort": C,
            "held": held,
            "velocity": np.maximum(v_std, LEAST_STD),
            "effort_measured": np.maximum(
                np.hypot(self.effort_noise * g_e, e_std), LEAST_STD
            ),
        }

    @property
    def stops_sec(self) -> float:
        """As of DrivenArmScene."""
        return float(self.scene.tolerance.get(STOPS, 0.0))

    def at_rest(self, track: Track, stops_sec: float, dry: np.ndarray) -> np.ndarray:
        """(n_bumps, n_v) share of each bump in which dry friction (n_v,), which stops a
        joint so [s], may hold it: the scene's own where it is NaN."""
        _, v, vd = track.motion_at_middles()
        by_all = self._most(dry) * self._mobility
        slow = np.maximum(REST_SPEED, stops_sec * (by_all + LEAD * np.abs(vd)))
        return track.bumps.mean((np.abs(v) < slow).astype(float))

    def _most(self, dry: np.ndarray) -> np.ndarray:
        return np.where(np.isnan(dry), self._dry, dry)

    def motion(self, track: Track, effects: Sequence[Effect] = ()) -> Motion:
        """As of MechanismMotion, with the share of dry friction that acts where it is
        not all at once."""
        motion = super().motion(track, effects)
        if not self.stops_sec:
            return motion
        return replace(motion, dry=self._ramp(motion.v, motion.vd))

    def _ramp(self, v: np.ndarray, vd: np.ndarray) -> np.ndarray:
        """(n, n_v) share of dry friction that acts where it is not all at once."""
        by_all = self.stops_sec * np.maximum(self._most(self._hold), LEAST_STD)
        y = v + LEAD * self.stops_sec * vd
        return np.clip(y / (by_all * self._mobility), -1.0, 1.0)

    def _unknown_jumps(self, track: Track) -> np.ndarray:
        """(n_bumps, n_v) standard deviations of means of measured efforts that jump
        between two samples."""
        out = np.zeros((len(track.bumps.centre), len(self.joints)))
        for i, joint in enumerate(self.joints):
            if self.by_measured[i]:
                y = track.samples[f"{joint}.effort_measured"]
                variance = jump_variance(y, self.effort_noise[i])
                out[:, i] = np.sqrt(track.row_bumps.w.power(2) @ variance)
        return out

    def _gains(self, track: Track, what: str, otherwise: float) -> np.ndarray:
        """(n_v,) how much of a channel's noise a mean over a bump has."""
        return np.array([
            track.bumps.noise_gain(track.spacing([f"{j}.{what}"])) if has else otherwise
            for j, has in zip(self.joints, self.has[what], strict=True)
        ])  # fmt: skip

    def _whitened_by(self, error) -> list[dict[str, np.ndarray]]:
        """For each track: inverse square roots of the efforts' covariance with what
        models are off by, and standard deviations of the other channels'."""
        out = []
        for noise in self._noises:
            more = noise["held"] ** 2 + error["effort"] ** 2
            C = noise["effort"] + np.eye(len(self.joints)) * more[:, None]
            # An equation whose effort is not told says nothing, of others neither.
            C[:, self.untold] = C[:, :, self.untold] = 0.0
            C[:, self.untold, self.untold] = 1.0
            each = {"effort": np.linalg.inv(np.linalg.cholesky(C))}
            for what in OTHERS:
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
        if more is not None:
            self._more.append(more)
            self._add_noise(more)
        return self._whitened_anew(error)

    def weigh_by(
        self, dynamics: SceneDynamics, gains: np.ndarray
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Takes the noise that positions have in another model's equations. Returns: as
        of allow.

        Args: dynamics: of a scene with effects. gains (n_joints,): of its drives.
        """
        self._weighed_by, self._divided_by = dynamics, gains
        return self._noises_anew()

    def hold(self, stops_sec: float, most: np.ndarray):
        """Takes joints for held by any effort up to most (n_joints,) [N m], by friction
        that stops them so [s]. Returns: as of allow; None where it is none other."""
        small = SAME_HOLD * np.max(np.append(most[np.isfinite(most)], 0.0))
        is_same = np.allclose(
            most, self._hold, rtol=SAME_HOLD, atol=small, equal_nan=True
        )
        if stops_sec == self.stops_sec and is_same:
            return None
        self._hold, known = most, self.scene.tolerance
        self.scene = replace(self.scene, tolerance={**known, STOPS: stops_sec})
        return self._noises_anew()

    def _noises_anew(self) -> Callable[[np.ndarray], np.ndarray]:
        self._noises = self._noise_of_rows()
        for more in self._more:
            self._add_noise(more)
        return self._whitened_anew(self.model_error)

    def _add_noise(self, more: np.ndarray) -> None:
        """Further noise (n_bumps, n_joints) of the joints' equations."""
        first = 0
        for noise in self._noises:
            C = noise["effort"]
            each = more[first : first + len(C)]
            first += len(C)
            C += np.eye(C.shape[1]) * each[:, None] ** 2

    def _whitened_anew(self, error) -> Callable[[np.ndarray], np.ndarray]:
        old = self._whiteners
        self._plain = self._whitened_by({w: 0.0 * x for w, x in error.items()})
        self.model_error, self._whiteners = error, self._whitened_by(error)
        return self._between(old, self._whiteners)

    def in_noise(self, left: np.ndarray) -> np.ndarray:
        """Rows (m,) over the sensors' noise alone."""
        return self._between(self._whiteners, self._plain)(left)

    def in_units(self, left: np.ndarray) -> np.ndarray:
        """(n_bumps, n_names) of rows (m,): [N m] or [N], and units of channels."""
        in_units = self._between(self._whiteners, None)(left)
        return in_units.reshape(-1, len(self.names()))

    def noise_in_units(self, held: bool = True) -> np.ndarray:
        """(n_bumps, n_names) standard deviations that the sensors' noise gives, and,
        where `held`, friction of joints at rest."""
        others = self._other_names()
        found = []
        for noise in self._noises:
            C = noise["effort"]
            std = np.sqrt(np.einsum("bii->bi", C))
            if held:
                std = np.hypot(std, noise["held"])
            row = [noise[what][self.joints.index(joint)] for what, joint in others]
            found.append(np.hstack([std, np.tile(row, (len(C), 1))]))
        return np.concatenate(found)

    def _between(self, old, new) -> Callable[[np.ndarray], np.ndarray]:
        """Gives rows (m, ...) in the units of other whiteners; None: in the channels'
        own."""
        others = [(w, self.joints.index(joint)) for w, joint in self._other_names()]
        n = len(self.joints)
        turns = [np.linalg.inv(white["effort"]) for white in old]
        if new is not None:
            turns = [to["effort"] @ T for to, T in zip(new, turns, strict=True)]
        sizes = [
            [old[i][w][j] / (1.0 if new is None else new[i][w][j]) for w, j in others]
            for i in range(len(old))
        ]

        def moved(rows: np.ndarray) -> np.ndarray:
            out, first = np.array(rows, order="C"), 0
            for T, size in zip(turns, sizes, strict=True):
                m = len(T) * (n + len(size))
                mine = out[first : first + m].reshape(len(T), -1, *rows.shape[1:])
                first += m
                efforts = mine[:, :n]
                efforts[:] = (T @ efforts.reshape(len(T), n, -1)).reshape(efforts.shape)
                for c, by in enumerate(size):
                    mine[:, n + c] *= by
            return out

        return moved

    def _mass_matrix(self, q) -> np.ndarray:
        plant, context = self._weighed_by.plant, self._weighed_by._context
        plant.SetPositions(context, q)
        return plant.CalcMassMatrix(context)

    def _stacked(self, track, white, efforts, others) -> np.ndarray:
        """Rows of one track: bump by bump, efforts of all joints, then the others."""
        shape = efforts.shape[2:]
        if self.untold.any():
            efforts = np.array(efforts)
            efforts[:, self.untold] = 0.0
        e = np.einsum("bij,bj...->bi...", white["effort"], efforts)
        parts = [e]
        for what in OTHERS:
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

    def channel_of_rows(self) -> np.ndarray:
        """(m,) index in names() of each row."""
        n = sum(len(t.bumps.centre) for t in self.tracks)
        return np.tile(np.arange(len(self.names())), n)

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


def rms_of(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, axis=0))

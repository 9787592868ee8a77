"""What any effects leave unmet of the equations of a mechanism's measured motion.

For each episode the joints' positions are smoothed (track.py); the residual effort -
ID(q, v, vd) of the scene with given effects is tested with bumps and divided by the
noise that the positions have (whitened_rows.py). What the other channels show of the
same motion is tested beside it.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from makebreak.gap.budget import go_on
from makebreak.gap.data.recording import Recording
from makebreak.gap.residuals.track import Track
from makebreak.gap.residuals.whitened_rows import REST_SPEED, WhitenedRows
from makebreak.gap.simulation.channel_effects import (
    PATH,
    SENSED,
    lag_of,
    path_of,
    sensing,
)
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.measured_channels import acts_on
from makebreak.models.effects.signature import Motion, added_effort, linear_signature
from makebreak.models.joint_tree import is_of_link
from makebreak.models.scene import Scene
from makebreak.systems.numerics.filters import LowPass, filtered, with_lag

# Loops of drives run at a kilohertz or more: what they hold is late by half a period.
LOOPS, LOOP_SEC = "loop_sec", 2.5e-4  # Key of a scene's `tolerance`.
VELOCITIES_LATE = "sensor_delay of velocities, delay"  # A nuisance.
LEAST_GAIN = 0.05  # That equations are divided by.
# That are kept in memory; efforts by row are large, and few come again.
MOST_MOTIONS, MOST_MEANS, MOST_DYNAMICS, MOST_EFFORTS = 40, 1500, 8, 100


class InverseModel(WhitenedRows):
    """Residuals of a mechanism all of whose joints have measured positions."""

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        super().__init__(scene, recordings)
        self._base: np.ndarray | None = None
        self._motions: list[Motion] | None = None
        # Of a track and what moves it: the motion, and the effort that it needs.
        self._needed: dict[tuple, tuple[Motion, np.ndarray]] = {}
        # Means over bumps that come again and again in a fit.
        self._means: dict = {}
        self._efforts: dict = {}  # The same of efforts by row, the last used last.
        self._heavier: dict[tuple, SceneDynamics] = {}
        # {kind: parameters that its effects are linear in; None: they are not}.
        self._unknowns: dict[str, tuple[str, ...] | None] = {}

    def base(self) -> np.ndarray:
        """The residual of the scene as it came."""
        if self._base is None:
            self._base = self.residual()
        return self._base

    def allow(
        self, error: dict[str, np.ndarray], more: np.ndarray | None = None
    ) -> Callable[[np.ndarray], np.ndarray]:
        """As of WhitenedRows; the base is then in the new units."""
        self._base = None
        return super().allow(error, more)

    def hold(self, stops_sec: float, most: np.ndarray):
        """As of WhitenedRows; what was computed with another friction is forgotten."""
        to_new = super().hold(stops_sec, most)
        if to_new is not None:
            self._base = self._motions = None
            for known in (self._needed, self._means, self._efforts):
                known.clear()
            self._remembering.forget()
        return to_new

    def weigh_by(
        self, dynamics: SceneDynamics, gains: np.ndarray
    ) -> Callable[[np.ndarray], np.ndarray]:
        """As of WhitenedRows; the base is then in the new units."""
        self._base = None
        return super().weigh_by(dynamics, gains)

    def model_with(
        self, effects: Sequence[Effect], weights_only: bool = False
    ) -> SceneDynamics:
        """The scene with those of these effects that change masses, gravity, or, unless
        `weights_only`, anything else of its plant."""
        mine = [
            e for e in effects
            if KINDS[e.kind].weighs or
            (not weights_only and KINDS[e.kind].before_finalize is not None
             and not KINDS[e.kind].hidden_state)
        ]  # fmt: skip
        return self._with(mine) if mine else self.dynamics

    def gains_with(self, effects: Sequence[Effect]) -> np.ndarray:
        """(n_joints,) of the drives, over what the scene has, by which their equations
        are divided: a small gain would make all that is left small, whatever it is."""
        gains = np.ones(len(self.joints))
        for i, (joint, law) in enumerate(zip(self.joints, self.laws, strict=True)):
            path = path_of(effects, joint)
            gains[i] = path.gain
            if law is not None and law.kp > 0.0:
                gains[i] *= float(law.with_kp(path.kp).kp / law.kp)
        return np.maximum(gains, LEAST_GAIN)

    def motions(self) -> list[Motion]:
        """Of each track, as measured."""
        if self._motions is None:
            self._motions = [self.motion(track) for track in self.tracks]
        return self._motions

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
            if all(is_of_link(e.kind) for e in heavy):
                dynamics = self.dynamics.with_links(heavy) or self._with(heavy)
            else:
                dynamics = self._with(heavy)
            ours = [e for e in ours if e not in heavy]
        on_top = [e for e in ours if KINDS[e.kind].on_top is not None]
        gains = self.gains_with(effects)  # In units of what is commanded or measured.
        parts = []
        for k, (track, white) in enumerate(
            zip(self.tracks, self._whiteners, strict=True)
        ):
            if on_top:
                r, motion = self._unmet(k, dynamics, effects, ours, moving)
            else:
                r, motion = self._unmet_sum(k, dynamics, effects, heavy, ours, moving)
            r = r / gains
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
        where = (k, tuple(e.key for e in moving), dynamics)
        if dynamics is not self.dynamics:
            needed = self._effort_of(
                where, lambda: motion.effort - dynamics.residual(motion)
            )
        # A gear's loss goes with what all the others need.
        for effect in sorted(ours, key=lambda e: KINDS[e.kind].on_top is not None):
            on_top = KINDS[effect.kind].on_top
            if on_top is not None:
                needed = needed + on_top(effect, dynamics, motion, needed)
                continue
            needed = needed + self._effort_of(
                (where, effect.key), partial(_added, effect, dynamics, motion)
            )
        path = tuple(e.key for e in effects if e.kind in SENSED + PATH)
        driven = self._effort_of(
            (where, path), lambda: self._driven_by(k, motion, effects).effort
        )
        motion = replace(motion, effort=driven)
        return self.tracks[k].bumps.mean(driven - needed), motion

    def _unmet_sum(self, k: int, dynamics, effects, heavy, ours, moving):
        """The same where effects add up: what each of them adds is kept, as a fit
        changes one parameter at a time."""
        bumps = self.tracks[k].bumps
        motion, _ = self._moved_by(k, moving)
        weights = () if dynamics is self.dynamics else tuple(e.key for e in heavy)
        where = (k, tuple(e.key for e in moving), weights)

        path = tuple(e.key for e in effects if e.kind in SENSED + PATH)

        def driven() -> np.ndarray:
            return self._effort_of(
                (where, path), lambda: self._driven_by(k, motion, effects).effort
            )

        def rest() -> np.ndarray:
            needed = self._moved_by(k, moving)[1]
            if dynamics is not self.dynamics:
                needed = motion.effort - dynamics.residual(motion)
            return bumps.mean(driven() - needed)

        r = self._kept((where, path), rest)
        for effect in ours:
            r = r - self._added_mean(where, effect, dynamics, motion, bumps)
        if any(name == "effort_measured" for name, _ in self._other_names()):
            motion = replace(motion, effort=driven())
        return r, motion

    def _added_mean(self, where, effect: Effect, dynamics, motion: Motion, bumps):
        """(n_bumps, n_v) means over bumps of what an effect adds. Where that is a sum
        of columns times parameters, the columns' means are kept."""
        unknowns, p = self._unknowns.get(effect.kind), effect.parameters
        if effect.kind not in self._unknowns:
            one = linear_signature(effect, KINDS[effect.kind], dynamics, motion)
            unknowns = self._unknowns[effect.kind] = one.unknowns if one else None
        if unknowns is None:
            return self._kept(
                (where, effect.key),
                lambda: bumps.mean(_added(effect, dynamics, motion)),
            )

        def columns() -> np.ndarray:
            one = linear_signature(effect, KINDS[effect.kind], dynamics, motion)
            assert one is not None
            return bumps.mean(one.columns)

        held = tuple(x for name, x in p.items() if name not in unknowns)
        kept = self._kept((where, effect.kind, tuple(effect.at), held), columns)
        return kept @ np.array([p[name] for name in unknowns])

    def _driven_by(self, k: int, motion: Motion, effects) -> Motion:
        """A motion with the effort that acts under these effects."""
        effort = self._effort(self.tracks[k], effects, motion.q, motion.v)
        return replace(motion, effort=effort + self._unseen_rotor * motion.vd)

    def _kept(self, key, compute: Callable[[], np.ndarray]) -> np.ndarray:
        """What was computed for a key before, or now."""
        if key not in self._means:
            go_on()
            if len(self._means) > MOST_MEANS:
                self._means.clear()
            self._means[key] = compute()
        return self._means[key]

    def _effort_of(self, key, compute: Callable[[], np.ndarray]) -> np.ndarray:
        """The same of efforts by row: those that are used least go first."""
        found = self._efforts.pop(key) if key in self._efforts else compute()
        self._efforts[key] = found
        if len(self._efforts) > MOST_EFFORTS:
            del self._efforts[next(iter(self._efforts))]
        return found

    def _moved_by(self, k: int, moving: Sequence[Effect]) -> tuple[Motion, np.ndarray]:
        """A track's motion, and the effort that the scene as it came needs for it."""
        names = [f"{joint}.position" for joint in self.joints]
        sensed = tuple((*sensing(moving, n), lag_of(moving, n)) for n in names)
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

    def _other_rows(self, k: int, effects, motion) -> dict[str, np.ndarray]:
        out, track = {}, self.tracks[k]
        effects = [*self._own, *effects]
        sensed = [e for e in effects if e.kind in SENSED]
        key = (k, "rates", *(e.key for e in sensed))
        for i, joint in enumerate(self.joints):
            if self.has["velocity"][i]:
                out[f"{joint}.velocity"] = self._kept(
                    (*key, i), partial(self._velocity_row, track, sensed, i)
                )
            if self.has["effort_measured"][i] and not self.by_measured[i]:
                name = f"{joint}.effort_measured"
                out[name] = self._kept(
                    (k, name, *(e.key for e in effects if e.kind in SENSED + PATH)),
                    partial(self._effort_row, track, motion, sensed, i),
                )
        return out

    def _velocity_row(self, track: Track, effects, i: int) -> np.ndarray:
        """(n_bumps,) what a velocity shows beside the rate of the joint's position."""
        joint = self.joints[i]
        name = f"{joint}.velocity"
        scale, late, bias = sensing(effects, name)
        p_scale, p_late, _ = sensing(effects, f"{joint}.position")
        true = (track.time - late) / scale
        stages = with_lag(track.stages[name], lag_of(effects, name))
        p_lag = lag_of(effects, f"{joint}.position")

        def rate(t):
            _, v, vd = track.at(i, t * p_scale + p_late)
            return p_scale * (v + p_lag * vd)

        if stages:
            seen = filtered(stages, track.dense, rate(track.dense), true)
        else:
            seen = rate(true)
        return track.mean_over_rows(track.samples[name] - seen - bias)

    def _effort_row(self, track: Track, motion: Motion, effects, i: int) -> np.ndarray:
        """(n_bumps,) what a measured effort shows beside the one that acts."""
        name = f"{self.joints[i]}.effort_measured"
        scale, late, bias = sensing(effects, name)
        stages = with_lag(track.stages[name], lag_of(effects, name))
        u = motion.effort[:, i] - self._link_rotor[i] * motion.vd[:, i]
        at = (track.time - late) / scale
        u = filtered(stages, track.middle, u, np.minimum(at, track.middle[-1]))
        return track.mean_over_rows(track.samples[name] - u - bias)

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
        not known of velocities: at which instant of a row's period they were computed,
        those with a filter of their own each by itself, all others together.
        (Differences of positions are half a row late, a simulator's velocities half a
        step.) Three tolerances are half a period."""
        columns, names = [], []
        filtered_too: list[int] = []
        others: list[int] = []
        for i, joint in enumerate(self.joints):
            if self.has["velocity"][i]:
                has_own = any(
                    track.stages[f"{joint}.velocity"]
                    != track.stages[f"{joint}.position"]
                    for track in self.tracks
                )
                (filtered_too if has_own else others).append(i)
        for some in (*([i] for i in filtered_too), others):
            if not some:
                continue
            parts = []
            for track, white in zip(self.tracks, self._whiteners, strict=True):
                none = np.zeros((len(track.bumps.centre), len(self.joints)))
                rows = {f"{j}.{what}": none[:, 0] for what, j in self._other_names()}
                for i in some:
                    name = f"{self.joints[i]}.velocity"
                    _, _, vd = track.at(i, track.dense)
                    rate = filtered(track.stages[name], track.dense, vd, track.time)
                    there = np.where(np.isfinite(track.samples[name]), rate, np.nan)
                    rows[name] = track.mean_over_rows(-there)
                parts.append(self._stacked(track, white, none, rows))
            columns.append(np.concatenate(parts))
            own = f"sensor_delay of {self.joints[some[0]]}.velocity, delay"
            names.append(VELOCITIES_LATE if some == others else own)
        row = min(r.period_sec() for r in self.recordings)
        return columns, [row / 6.0] * len(columns), names

    def loop_timing(self) -> tuple[list[np.ndarray], list[float], list[str]]:
        """Columns (m,) of the residual, standard deviations [s] and names of what is
        not known of fast loops: by how much a position and a velocity that a drive
        feeds back are late, and efforts that were commanded at a row, and hold until
        the loop gives the next."""
        columns, names = [], []
        efforts = []
        sampled = [
            i
            for i, joint in enumerate(self.joints)
            if self.by_measured[i]
            and any(r.channels[f"{joint}.effort_measured"].sampled
                    for r in self.recordings)
        ]  # fmt: skip
        if sampled:
            for motion in self.motions():
                late = np.zeros((*motion.v.shape, 1))
                given = motion.effort[:, sampled]
                late[:, sampled, 0] = -np.gradient(given, motion.time, axis=0)
                efforts.append(late)
            columns.append(self.columns_of(efforts)[:, 0])
            names.append("input_delay of all joints, loop")
        for i in range(len(self.joints)):
            stiffness, damping = self._loop(i)
            # A simulator's steps have a joint's own damping as early or late.
            damping += float(self._damping[i])
            for fed_back, size in (("position", stiffness), ("velocity", damping)):
                if size > 0.0:
                    columns.append(self._fed_back_late(fed_back, {i: size}))
                    names.append(loop_name(self.joints[i], fed_back))
        known_to = float(self.scene.tolerance.get(LOOPS, LOOP_SEC))
        return columns, [known_to] * len(columns), names

    def _loop(self, i: int) -> tuple[float, float]:
        """Gains of a joint's own loop, of position and velocity."""
        law = self.laws[i]
        if law is None or not self.commanded[i]:
            return 0.0, 0.0
        return float(law.kp), float(law.kd)

    def late_velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """(m,) each: what it does per second that all velocities are late that drives
        act on, and that bearings damp."""
        drives = {i: self._loop(i)[1] for i in range(len(self.joints))}
        bearings = dict(enumerate(self._damping))
        a, b = (self._fed_back_late("velocity", gains) for gains in (drives, bearings))
        return a, b

    def _fed_back_late(self, what: str, gains: dict[int, float]) -> np.ndarray:
        """(m,) what it does to the residual, per second, that this is fed back late to
        joints {index: gain}."""
        efforts = []
        for motion in self.motions():
            late = np.zeros((*motion.v.shape, 1))
            rate = motion.v if what == "position" else motion.vd
            for i, gain in gains.items():
                late[:, i, 0] = gain * rate[:, i]
            efforts.append(late)
        return self.columns_of(efforts)[:, 0]

    def least(self, kind: str, at: Sequence[str]) -> dict[str, float]:
        """Lower bounds of parameters: what the model allows; and a drive that follows
        positions gives what its law asks for most of the time that its joint moves.
        (With next to no limit, light links need nothing and are given nothing.)"""
        found = self.dynamics.least(kind, at)
        if KINDS[kind].path != "saturation":
            return found
        for i, joint in enumerate(self.joints):
            if joint not in at or self.laws[i] is None:
                continue
            asked = np.concatenate([
                np.abs(m.effort[:, i])[np.abs(m.v[:, i]) > REST_SPEED]
                for m in self.motions()
            ])  # fmt: skip
            if len(asked):
                found["limit"] = max(found.get("limit", 0.0), float(np.median(asked)))
        return found


def loop_name(joint: str, fed_back: str) -> str:
    """Of the nuisance: how late a position or velocity is fed back."""
    return f"input_delay of {joint}, loop of its {fed_back}"


def _adds_up(heavy: Sequence[Effect]) -> bool:
    """Whether what weights and gravity change is the sum of what each does: gravity
    changes all weights, a link's mass the moment of where its centre is, and masses on
    two links add up, as inverse dynamics is linear in them."""
    if any(KINDS[e.kind].added is None for e in heavy):
        return False
    places = [at for e in heavy for at in e.at]
    tilted = any(KINDS[e.kind].at == "base" for e in heavy)
    return len(heavy) < 2 or (not tilted and len(set(places)) == len(places))


def _added(effect: Effect, dynamics: SceneDynamics, motion: Motion) -> np.ndarray:
    add = added_effort(effect, KINDS[effect.kind], dynamics, motion)
    if add is None:
        raise ValueError(f"{effect.kind} is seen in simulation alone")
    return add

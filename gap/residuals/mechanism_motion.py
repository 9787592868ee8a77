"""How a mechanism moved, and the efforts that acted on it, as measured."""

from collections.abc import Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from makebreak.gap.data.check_drives import untold_joints
from makebreak.gap.data.recording import Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.residuals.track import Track, track_of
from makebreak.gap.simulation.channel_effects import (
    PATH,
    SENSED,
    CommandPath,
    given_late,
    lag_of,
    path_of,
    rotor_before,
    sensing,
)
from makebreak.models.drives import law_of
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints
from makebreak.models.effects.measured_channels import is_link_side
from makebreak.models.effects.signature import Motion, filtered
from makebreak.models.scene import Scene
from makebreak.systems.numerics.filters import mean_delay, with_lag

BUMP_SEC = 0.2  # Width of the test functions.
BLOCK_SEC = 1.2  # Every third block of time of this length is held out.
MOST_SEC = 60.0  # Of the recordings that are looked at.


class RememberingDynamics(SceneDynamics):
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


class MechanismMotion:
    """The motion of a mechanism all of whose joints have measured positions.

    Raises: ValueError where no episode is long enough.
    """

    def __init__(self, scene: Scene, recordings: Sequence[Recording]):
        self.scene = scene
        self._remembering = RememberingDynamics(scene)
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
        self._read_noise()
        self._read_drives()
        self._read_tracks()

    def is_motor_side(self, i: int) -> bool:
        """Whether a joint's measured effort is the motor's, before its gear."""
        return not is_link_side(
            self.scene.channels, f"{self.joints[i]}.effort_measured"
        )

    # ----- What was measured

    def _read_noise(self) -> None:
        recordings = self.recordings
        self.noise = self._noise("position")
        self.velocity_noise = self._noise("velocity")
        # Root of how many neighbouring samples of a velocity err together.
        rates = [
            [r.channels[c] for r in recordings if c in r]
            for c in (f"{joint}.velocity" for joint in self.joints)
        ]
        self._together = np.sqrt(
            [max((c.together for c in some), default=1.0) for some in rates]
        )
        # In each value of a velocity, as a mean.
        self._averaged = np.array(
            [min((c.averaged for c in some), default=1.0) for some in rates]
        )
        self.effort_noise = self._noise("effort_measured")

    def _noise(self, what: str) -> np.ndarray:
        """(n_v,) the largest of all recordings."""
        out = np.zeros(len(self.joints))
        for i, joint in enumerate(self.joints):
            found = [
                r.channels[f"{joint}.{what}"].noise
                for r in self.recordings
                if f"{joint}.{what}" in r
            ]
            out[i] = max(found, default=0.0)
        return out

    def _read_drives(self) -> None:
        """How the effort of each joint is known."""
        scene, recordings = self.scene, self.recordings
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
        # What drives a joint that has a drive is not zero where no column says it.
        untold = untold_joints(scene, recordings)
        self.untold = np.array([joint in untold for joint in self.joints])
        # What turns the rotor is in no torque that is measured at the link.
        self._link_rotor = np.array(
            [rotor_before(scene, self.dynamics.plant, joint) for joint in self.joints]
        )
        self._unseen_rotor = self._link_rotor * np.array(self.by_measured)
        self._damping = bearings_of(self.dynamics.plant)

    def _read_tracks(self) -> None:
        self.tracks: list[Track] = []
        seconds = 0.0
        for recording in self.recordings:
            for episode in recording.episodes:
                if seconds > MOST_SEC:
                    break
                track = track_of(
                    recording, episode, self.joints, self.noise, BUMP_SEC, BLOCK_SEC
                )
                if track is not None:
                    self.tracks.append(track)
                    seconds += track.time[-1] - track.time[0]
        if not self.tracks:
            raise DoesNotFit(
                f"no episode of the recordings is long enough for windows of "
                f"{BUMP_SEC} s"
            )
        self.period = float(
            np.median(np.concatenate([np.diff(t.time) for t in self.tracks]))
        )

    # ----- Motion and effort

    def motion(self, track: Track, effects: Sequence[Effect] = ()) -> Motion:
        """The true motion at the middles, if the effects on measurement are these
        beside the scene's own."""
        t = track.middle
        effects = [*self._own, *effects]
        n = len(self.joints)
        q, v, vd = (np.empty((len(t), n)) for _ in range(3))
        for i, joint in enumerate(self.joints):
            scale, late, bias = sensing(effects, f"{joint}.position")
            at = t * scale + late
            q[:, i], v[:, i], vd[:, i] = track.at(i, at)
            q[:, i] -= bias
            lag = lag_of(effects, f"{joint}.position")
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

    def _effort(self, track: Track, effects, q, v) -> np.ndarray:
        """(n, n_v) mean effort over each interval, after the path."""
        effects = [*self._own, *effects]
        out = np.zeros_like(q)
        for i, joint in enumerate(self.joints):
            path = path_of(effects, joint)
            u = self._at_motor(track, effects, path, i, q, v)
            if u is None:
                continue
            u = np.clip(path.gain * u + path.bias, -path.limit, path.limit)
            if path.lag > 0.0:
                u = _mean_lagged(track.step, u, path.lag)
            out[:, i] = u
        return out

    def _at_motor(
        self, track: Track, effects, path: CommandPath, i: int, q, v
    ) -> np.ndarray | None:
        """(n,) what arrives at a joint's motor, or was measured in its stead; None
        where it has none."""
        joint = self.joints[i]
        law = self.laws[i]
        if law is not None and self.commanded[i]:
            law = law.with_kp(path.kp)
            error, rate = np.zeros_like(v[:, i]), np.zeros_like(v[:, i])
            if f"{joint}.position_command" in track.commands:
                wanted = law.received(track.commands[f"{joint}.position_command"])
                seen = q[:, i] + sensing(effects, f"{joint}.position")[2]
                error = track.mean_held(wanted, path.delay) - seen
            if f"{joint}.velocity_command" in track.commands:
                told = track.commands[f"{joint}.velocity_command"]
                rate = track.mean_held(told, path.delay)
            return law.effort(error, rate, v[:, i])
        if self.has["effort_command"][i]:
            told = track.commands[f"{joint}.effort_command"]
            return track.mean_held(told, path.delay)
        if self.by_measured[i]:
            name = f"{joint}.effort_measured"
            y = track.samples[name]
            good = np.isfinite(y)
            late = mean_delay(track.stages[name]) + given_late(effects, name)
            t = track.middle - path.delay + late
            return np.interp(t, track.time[good], y[good])
        return None


def bearings_of(plant: MultibodyPlant) -> np.ndarray:
    """(n_joints,) what brakes each joint by its own bearing, per speed [N m s/rad]."""
    joints = sorted(one_dof_joints(plant), key=lambda j: j.velocity_start())
    return np.array([float(j.default_damping_vector()[0]) for j in joints])


def _mean_lagged(step: np.ndarray, u: np.ndarray, lag: float) -> np.ndarray:
    """(n,) means of y' = (u - y)/lag over the intervals, u held in each."""
    ends = np.concatenate([[0.0], np.cumsum(step)])
    y = filtered(ends, np.append(u, u[-1]), lag)
    return u - lag * np.diff(y) / step

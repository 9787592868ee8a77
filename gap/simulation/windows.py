"""Episodes cut into windows that start from measured states, and simulated anew.

A window's first state is smoothed from the positions around it; how uncertain that is
grows with time in the window and counts as noise. Which windows are held out is fixed
by their block of time before anything is fitted.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from makebreak.gap.data.check_drives import untold_joints
from makebreak.gap.data.recording import Episode, Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.growth import spread_along
from makebreak.gap.numerics.signal_noise import jump_variance
from makebreak.gap.numerics.stairs import beside_line
from makebreak.gap.numerics.struck import struck_rows
from makebreak.gap.simulation.channel_effects import (
    given_late,
    lag_of,
    rotor_before,
    sensing,
)
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.drives import law_of
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints
from makebreak.models.scene import InitialSection, Scene, initial_for
from makebreak.models.scene_schema import COMMANDS_OF
from makebreak.systems.numerics.filters import Stage, mean_delay, memory, with_lag
from makebreak.systems.numerics.smoother import Smoothed, smooth_filtered

_POSITIONS = ("x", "y", "z")
TURN = ("qw", "qx", "qy", "qz")
_G = 9.81
BESIDE = 4  # Rows beside an impact that a smoothed state would mix with it.
PARTS = 3  # Of a window, in each of which the equations of motion are linear once.
MARGIN_SEC = 0.1  # Before the first window of an episode.
MEASURED_SEC = 0.005  # Between rows a measured effort is given in steps of this.
LARGEST = 200.0  # An error beyond so many standard deviations counts as this: after a
# bounce the other way, how much farther it goes says nothing.


@dataclass(frozen=True, eq=False)
class Window:
    """rows: of the recording. state: {signal: (value, rate, accel.)} at the start."""

    recording: int
    episode: int
    start: float  # [s]
    rows: slice
    state: dict[str, np.ndarray]
    std: np.ndarray  # (n, n_channels) Of a measured sample about the simulated one.
    train: bool
    # {signal: (2, 2)} covariance of the state's value and rate.
    spread: dict[str, np.ndarray] = field(default_factory=dict)


class WindowedResidual:
    """The residual of a model compared window by window, and which of it is
    fitted: what a fit asks of a model (gap/fit.py).

    A model has `channels`, `windows` (each with `rows` and `train`),
    `simulate(effects)` and `errors(simulated)`, a list of (n, channels) per window.
    """

    recordings: list[Recording]
    channels: list[str]
    windows: Sequence[Any]
    _base: np.ndarray | None = None
    _kept: np.ndarray | None = None

    def simulate(self, effects: Sequence[Effect]) -> Sequence[np.ndarray]:
        raise NotImplementedError

    def errors(self, simulated: Sequence[np.ndarray]) -> list[np.ndarray]:
        raise NotImplementedError

    def residual(self, effects: Sequence[Effect] = ()) -> np.ndarray:
        e = self.errors(self.simulate(effects))
        return np.concatenate([x.ravel() for x in e])[self.measured()]

    def measured(self) -> np.ndarray:
        """(n,) which entries of all windows were measured: rows are of these."""
        if self._kept is None:
            self._kept = np.concatenate(
                [np.isfinite(seen_in(self, w)).ravel() for w in self.windows]
            )
        return self._kept

    def _by_row(self, of_window: Sequence) -> np.ndarray:
        """A window's value for each of its rows, (m,)."""
        k = len(self.channels)
        each = [
            np.full(n_rows(w) * k, x)
            for w, x in zip(self.windows, of_window, strict=True)
        ]
        return np.concatenate(each)[self.measured()]

    def base(self) -> np.ndarray:
        if self._base is None:
            self._base = self.residual()
        return self._base

    def train(self) -> np.ndarray:
        return self._by_row([w.train for w in self.windows])

    def blocks(self) -> np.ndarray:
        """(m,) number of the window of each row."""
        return self._by_row(range(len(self.windows)))

    def channel_of_rows(self) -> np.ndarray:
        """(m,) index of the channel of each row."""
        k = len(self.channels)
        n = sum(map(n_rows, self.windows))
        return np.tile(np.arange(k), n)[self.measured()]


# Of a recording, as models of the same windows are made again and again.
_states: WeakKeyDictionary[Recording, dict[tuple[str, int], Smoothed]]
_states = WeakKeyDictionary()


def _smoothed(recording: Recording, episode: Episode, name: str) -> Smoothed:
    """The states of a signal of an episode."""
    known = _states.setdefault(recording, {})
    if (name, episode.first) not in known:
        channel = recording.channels[name]
        known[name, episode.first] = smooth_filtered(
            recording.time[episode.rows], recording[name][episode.rows], channel.noise,
            channel.stages or (),
        )  # fmt: skip
    return known[name, episode.first]


def _most_seen(seen: np.ndarray, every: int) -> int:
    """The first of every so many rows from which most was measured, seen (n,): a sensor
    that is slower than the log tells nothing in the rows between its samples."""
    offsets = range(min(every, len(seen)))
    return max(offsets, key=lambda at: float(np.mean(seen[at::every])))


def moved(w: Window, by: np.ndarray) -> Window:
    """The window from another start: by (2 k,), in deviations, along the axes of the
    uncertainty of each of k signals' value and rate."""
    state = dict(w.state)
    for d, (name, x) in zip(by.reshape(-1, 2), w.state.items(), strict=True):
        if d.any():
            values, u = np.linalg.eigh(w.spread[name])
            state[name] = x = np.array(x)
            x[:2] += u @ (d * np.sqrt(np.maximum(values, 0.0)))
    return replace(w, state=state)


def drawn(w: Window, rng) -> Window:
    """The window from another start that its measurements allow."""
    return moved(w, rng.normal(size=2 * len(w.state)))


def n_rows(window) -> int:
    rows = window.rows
    return len(range(rows.start, rows.stop, rows.step or 1))


def seen_in(model, window) -> np.ndarray:
    """(n, n_channels) what was measured in a window; NaN where nothing was."""
    recording = model.recordings[window.recording]
    return np.stack([recording[c][window.rows] for c in model.channels], axis=1)


class WindowModel(WindowedResidual):
    """Residuals of simulated windows: the same questions as InverseModel answers, for
    scenes with free bodies and contact, and for judging any scene.

    Args: window_sec, hop_sec: length, and from one start to the next. most: windows at
        most; a larger number is thinned evenly. simulation: of the scene, if not by
        Drake's steps. slow_noise: {joint: noise of its measured effort [N m] that goes
        together for longer than a window}, beside that of a sample.
    """

    commands_late = 0.0
    _draw: np.random.Generator | None = None  # Of errors of measured efforts.
    rows_sec = 0.0  # Rows closer than this are left out.

    def __init__(
        self,
        scene: Scene,
        recordings: Sequence[Recording],
        window_sec: float = 0.3,
        hop_sec: float | None = None,
        block_sec: float = 1.2,
        most: int = 400,
        by_episode: bool = False,
        simulation: SceneSimulation | None = None,
        slow_noise: Mapping[str, float] | None = None,
    ):
        self.scene, self.recordings = scene, list(recordings)
        self.window_sec = window_sec
        self._slow_noise = slow_noise or {}
        self.simulation = simulation or SceneSimulation(scene)
        self.dynamics = SceneDynamics(scene)
        plant = self.dynamics.plant
        self.joints = [
            full_name(plant, j)
            for j in one_dof_joints(plant)
            if j.num_velocities()
            and all(f"{full_name(plant, j)}.position" in r for r in recordings)
        ]
        self.bodies = [
            full_name(plant, plant.get_body(i))
            for i in sorted(plant.GetFloatingBaseBodies())
            if all(f"{full_name(plant, plant.get_body(i))}.x" in r for r in recordings)
        ]
        self._untold = untold_joints(scene, recordings)
        known = set(self.simulation.channels())
        self.channels = [
            name
            for name in recordings[0].channels
            if name in known
            and all(name in r for r in recordings)
            and not recordings[0].channels[name].is_command
            and not name.endswith(".effort_measured")
            and name.rsplit(".", 1)[0] in (*self.joints, *self.bodies)
            and name.rsplit(".", 1)[0] not in self._untold
        ]
        if not self.channels:
            raise DoesNotFit(
                "no measured channel of the recordings can be simulated: expected "
                "positions of joints or poses of free bodies"
            )
        self.noise = np.array(
            [max(r.channels[c].noise for r in recordings) for c in self.channels]
        )
        self.noise = np.maximum(self.noise, 1e-9)
        # What recordings say of their sensors.
        self._filters: list[dict[str, tuple[Stage, ...]]] = [
            {c: stages for c in self.channels if (stages := r.channels[c].stages)}
            for r in recordings
        ]
        self.windows: list[Window] = []
        self._paths: dict[tuple[int, int], dict[str, np.ndarray]] = {}
        number = 0
        for i, recording in enumerate(recordings):
            for episode in recording.episodes:
                self._cut(
                    i, recording, episode, hop_sec or window_sec, block_sec,
                    number if by_episode else None,
                )  # fmt: skip
                number += 1
        if len(self.windows) > most:
            keep = np.unique(np.linspace(0, len(self.windows) - 1, most).astype(int))
            self.windows = [self.windows[k] for k in keep]
        if not self.windows:
            raise DoesNotFit(
                f"no episode of the recordings holds a window of {window_sec} s"
            )
        self._commands: dict[tuple, list[dict[int, Commands]]] = {}
        self.runs = 0

    @property
    def met(self) -> Mapping[tuple[str, str], float]:
        """{(fixed body, axis of the world): where it is met}, where that is asked."""
        return {}

    def set_commands_late(self, seconds: float) -> None:
        """By how much later than their rows commands act from now on [s]."""
        self.commands_late = seconds
        self._commands, self._base = {}, None

    def has_commands(self) -> bool:
        """Whether any recording has commands that the scene's drives take."""
        return any(commanded(self.scene, recording) for recording in self.recordings)

    def row_sec(self) -> float:
        """Period of the rows [s]: the shortest of the recordings'."""
        return min(recording.period_sec() for recording in self.recordings)

    def of_unmeasured(self) -> "WindowModel | None":
        """The same windows, which simulate the coordinates that were not measured; None
        where all were."""
        other, plant = copy(self), self.dynamics.plant
        names = [f"{full_name(plant, j)}.position" for j in one_dof_joints(plant)]
        for i in sorted(plant.GetFloatingBaseBodies()):
            body = full_name(plant, plant.get_body(i))
            names += [f"{body}.{axis}" for axis in (*TURN, *_POSITIONS)]
        other.channels = [
            c for c in names if not any(c in r for r in self.recordings)
        ]  # fmt: skip
        n = len(other.channels)
        other.noise, other._filters = np.ones(n), [{} for _ in self.recordings]
        other.windows = [replace(w, std=np.ones((len(w.std), n))) for w in self.windows]
        return other if n else None

    # ----- Cutting

    def _signals(self) -> list[str]:
        names = [f"{joint}.position" for joint in self.joints]
        for body in self.bodies:
            # x there is; a camera from above, say, sees no height.
            names += [
                f"{body}.{axis}" for axis in _POSITIONS
                if all(f"{body}.{axis}" in r for r in self.recordings)
            ]  # fmt: skip
            names += [
                f"{body}.{q}" for q in TURN
                if all(f"{body}.{q}" in r for r in self.recordings)
            ]  # fmt: skip
        return names

    def _cut(self, i, recording: Recording, episode: Episode, hop, block, number):
        time = recording.time[episode.rows]
        if len(time) < 12 or time[-1] - time[0] < 0.6 * self.window_sec:
            return
        states, spreads = {}, {}
        rough = np.zeros(len(time), bool)
        for name in self._signals():
            y = recording[name][episode.rows]
            if np.isfinite(y).sum() < 8:
                return
            stages = recording.channels[name].stages or ()
            s = _smoothed(recording, episode, name)
            states[name] = s.x
            spreads[name] = s.P
            if name.rsplit(".", 1)[0] in self.bodies and name[-2:] in (
                ".x",
                ".y",
                ".z",
            ):
                noise = recording.channels[name].noise
                rough |= struck_rows(time, y, noise, stages, 2.0 * _G, BESIDE)
        self._paths[i, episode.first] = {"time": time, **states}
        if rough.any():  # No start amid an impact, where the smoothed state is a mean.
            at = np.flatnonzero(rough)
            for k in at:
                rough[max(k - BESIDE, 0) : k + BESIDE + 1] = True
        commands = [recording.held(c.name)[episode.rows] for c in recording.commands()]
        jumps = self._unknown_jumps(recording, episode)
        add_stairs = self._stairs(recording, episode)
        # At an end a smoothed state is less sure than it knows, and what was commanded
        # before is not known.
        margin = min(MARGIN_SEC, 0.1 * (time[-1] - time[0]))
        every = max(int(self.rows_sec / float(np.median(np.diff(time))) + 1e-6), 1)
        seen = np.isfinite([recording[c][episode.rows] for c in self.channels]).sum(0)
        start_row = int(np.searchsorted(time, time[0] + margin))
        while start_row < len(time) - 3:
            start_row = self._best_start(time, states, start_row)
            start_row += _most_seen(seen[start_row:], every)
            t0 = time[start_row]
            last = int(np.searchsorted(time, t0 + self.window_sec, "right"))
            if time[-1] - t0 < 0.6 * self.window_sec:
                break
            ok = not rough[start_row] and all(
                np.isfinite(u[start_row]) for u in commands
            )
            if ok:
                rows = slice(start_row, last, every)
                after = time[rows] - t0
                std = np.empty((len(after), len(self.channels)))
                state = {n: x[start_row] for n, x in states.items()}
                add_stairs(t0, state)
                grown = self._grown(recording, states, spreads, rows, after, jumps)
                # No less than along a straight line: behind filters a smoothed state is
                # less sure than it knows, also where the motion makes little of it.
                for c, name in enumerate(self.channels):
                    std[:, c] = self._std(name, c, spreads, start_row, after)
                    if name in grown:
                        own = np.sqrt(self.noise[c] ** 2 + grown[name])
                        std[:, c] = np.maximum(std[:, c], own)
                block_number = number
                if number is None:
                    block_number = int((t0 - time[0]) / block)
                self.windows.append(
                    Window(
                        i, episode.number, float(t0),
                        slice(episode.first + start_row, episode.first + last, every),
                        state, std,
                        block_number % 3 != 1,
                        {n: P[start_row, :2, :2] for n, P in spreads.items()},
                    )
                )  # fmt: skip
            start_row = max(int(np.searchsorted(time, t0 + hop)), start_row + 1)

    def _stairs(self, recording: Recording, episode: Episode):
        """Adds to a window's start {signal: (value, rate, accel.)}, at a time [s], what
        a smoothed motion does not show of drives that get commands in stairs."""
        plant = self.dynamics.plant
        laws = {
            j: law for j in self.joints
            if f"{j}.position_command" in recording
            and (law := law_of(self.scene.actuation, j)) is not None
        }  # fmt: skip
        joints = _velocity_starts(plant)
        n = plant.num_positions()  # Of a mechanism whose motion is known, not a base.
        if not laws or n != len(joints) or set(joints) != set(self.joints):
            return lambda t0, state: None
        kp, kd = np.zeros(n), np.zeros(n)
        time = recording.time[episode.rows]
        held = np.zeros((len(time), n))
        for name, law in laws.items():
            i = joints[name]
            kp[i], kd[i] = float(law.kp), float(law.kd)
            held[:, i] = recording.held(f"{name}.position_command")[episode.rows]
        moves = np.ones(len(time), bool)
        moves[1:] = np.any(held[1:] != held[:-1], axis=1)
        steps = moves & np.isfinite(held).all(axis=1)
        since, held = time[steps], held[steps]

        def add(t0: float, state: dict[str, np.ndarray]) -> None:
            q = np.zeros(n)
            for name, i in joints.items():
                q[i] = state[f"{name}.position"][0]
            mass = self.dynamics.momentum(np.tile(q, (n, 1)), np.eye(n))
            dq, dv = beside_line(np.linalg.inv(mass), kp, kd, since, held, t0)
            for name, i in joints.items():
                key = f"{name}.position"
                state[key] = state[key] + np.array([dq[i], dv[i], 0.0])

        return add

    def _best_start(self, time, states, row: int) -> int:
        """The row at or soon after one at which a window begins."""
        return row

    def _std(self, name, c, spreads, k, after) -> np.ndarray:
        """Noise of a sample, and of where a window's start is, carried along."""
        at, quantity = name.rsplit(".", 1)
        extra = np.zeros(len(after))
        if quantity in ("position", "x", "y", "z", *TURN) and name in spreads:
            P = spreads[name][k]
            extra = P[0, 0] + 2.0 * after * P[0, 1] + after**2 * P[1, 1]
        elif quantity == "velocity":
            extra += spreads[f"{at}.position"][k][1, 1]
        elif quantity in ("vx", "vy", "vz"):
            extra += spreads[f"{at}.{quantity[1]}"][k][1, 1]
        elif quantity in ("wx", "wy", "wz") and f"{at}.qw" in spreads:
            extra += 4.0 * np.mean([spreads[f"{at}.{q}"][k][1, 1] for q in TURN])
        return np.sqrt(self.noise[c] ** 2 + np.maximum(extra, 0.0))

    def commands(self, effects: Sequence[Effect]) -> list[dict[int, Commands]]:
        """Of each recording and episode; efforts that stand in for commands when they
        were given, if effects make their measurement late."""
        late = {
            joint: given_late(effects, f"{joint}.effort_measured")
            for joint in _driven(self.scene, "effort_command")
        }
        key = (*late.values(), *(e.key for e in effects if self._untold))
        if key not in self._commands:
            self._commands[key] = self._commands_with(effects, late)
        if self._draw is None:
            return self._commands[key]
        return [
            {e.first: self._other(r, e, given[e.first], self._draw) for e in r.episodes}
            for r, given in zip(self.recordings, self._commands[key], strict=True)
        ]

    def _commands_with(self, effects, late) -> list[dict[int, Commands]]:
        dynamics = None
        if self._untold:
            dynamics = SceneDynamics(replace(self.scene, effects=list(effects)))
        out = []
        for i, recording in enumerate(self.recordings):
            names = commanded(self.scene, recording)
            of: dict[int, Commands] = {}
            for episode in recording.episodes:
                time = recording.time[episode.rows]
                columns = {n: recording.held(n)[episode.rows] for n in names}
                if not names:  # What the motors gave stands in for it.
                    time, columns = self._given(recording, episode, i, late)
                else:
                    time = time + self.commands_late
                if dynamics is not None:
                    path = self._paths[i, episode.first]
                    columns |= self._untold_efforts(dynamics, path, time)
                of[episode.first] = Commands(time, columns)
            out.append(of)
        return out

    def _other(self, recording: Recording, episode: Episode, given: Commands, rng):
        """Other efforts that their measurements allow, where these stand in for
        commands: where a tip may stick or slip, no slope tells what noise does."""
        rows = recording.time[episode.rows]
        now = np.searchsorted(rows, given.time, "right") - 1
        columns = dict(given.columns)
        for joint in by_measured(self.scene, recording):
            channel = recording.channels[f"{joint}.effort_measured"]
            jumps = jump_variance(recording[channel.name][episode.rows], channel.noise)
            off = np.sqrt(channel.noise**2 + jumps) * rng.normal(size=len(rows))
            columns[f"{joint}.effort_command"] = (
                columns[f"{joint}.effort_command"] + off[now]
            )
        return Commands(given.time, columns)

    def _given(self, recording: Recording, episode: Episode, i: int, late):
        """times and columns of commands that give what the motors gave: measured
        efforts, as a line between rows, in steps of MEASURED_SEC or shorter. late:
        {joint: by how much its effort is measured late [s]}, beside its filters."""
        rows = recording.time[episode.rows]
        period = float(np.median(np.diff(rows)))
        parts = max(int(np.ceil(period / MEASURED_SEC - 1e-6)), 1)
        time = np.interp(
            np.arange(parts * (len(rows) - 1) + 1) / parts, np.arange(len(rows)), rows
        )
        middle = time + 0.5 * np.diff(time, append=time[-1])
        columns = {}
        for joint in _driven(self.scene, "effort_command"):
            key = f"{joint}.effort_measured"
            if key not in recording:
                continue
            y = recording[key][episode.rows]
            good = np.isfinite(y)
            stages = recording.channels[key].stages or ()
            shown = middle + mean_delay(stages) + late[joint]
            y = np.interp(shown, rows[good], y[good])
            rotor = rotor_before(self.scene, self.dynamics.plant, joint)
            path = self._paths.get((i, episode.first), {})
            if rotor and f"{joint}.position" in path:
                # What turned the rotor was not measured.
                rate = np.interp(middle, rows, path[f"{joint}.position"][:, 2])
                y = y + rotor * rate
            columns[f"{joint}.effort_command"] = y
        return time, columns

    def _untold_efforts(self, dynamics, path, time) -> dict[str, np.ndarray]:
        """{effort_command: (n,) [N m]} of joints whose efforts are not told: what a
        scene needs to move along a path as was measured."""
        joints = _velocity_starts(dynamics.plant)
        n = dynamics.plant.num_velocities()
        if len(joints) != n or not joints.keys() <= set(self.joints):
            raise DoesNotFit(
                f"what drives {', '.join(self._untold)} is not recorded, and not all "
                "that moves with it is measured"
            )
        middle = time + 0.5 * np.diff(time, append=time[-1])
        motion = np.zeros((3, len(time), n))
        for joint, k in joints.items():
            for of, x in zip(motion, path[f"{joint}.position"].T, strict=True):
                of[:, k] = np.interp(middle, path["time"], x)
        q, v, vd = motion
        effort = dynamics.inverse_dynamics(q, v, vd, middle)
        return {
            f"{joint}.effort_command": effort[:, joints[joint]]
            for joint in self._untold
        }

    def _grown(
        self, recording: Recording, states, spreads, rows: slice, after, jumps
    ) -> dict[str, np.ndarray]:
        """{channel of a joint: (m,) variance} that the uncertain start of a window, and
        noise of measured efforts that stand in for commands, have made of it: along
        the measured motion, as a joint that stands on its head, or is light beside its
        load, turns a small error into a large one. Empty where the scene has drives
        that act against errors, free bodies, or joints that were not measured."""
        plant = self.dynamics.plant
        joints = _velocity_starts(plant)
        n = plant.num_velocities()
        if not (
            self.scene.actuation.type in ("effort", "none")
            and plant.num_positions() == n == len(joints)
            and set(joints) == set(self.joints)
        ):
            return {}
        parts = np.array_split(np.arange(rows.start, rows.stop), PARTS)
        q, v, vd = (np.zeros((PARTS, n)) for _ in range(3))
        start = np.zeros((2 * n, 2 * n))
        for name, i in joints.items():
            key = f"{name}.position"
            # Means: one row's acceleration may be noise, and no joint falls by that.
            of_parts = [states[key][part].mean(axis=0) for part in parts]
            q[:, i], v[:, i], vd[:, i] = np.transpose(of_parts)
            start[np.ix_([i, n + i], [i, n + i])] = spreads[key][rows.start, :2, :2]
        white, steady = self._effort_noise(recording, joints, n)
        for name in self._untold:  # Of a smoothed acceleration, an effort's own.
            own = self.dynamics.momentum(q[:1], np.eye(n)[joints[name]][None])[0]
            of = spreads[f"{name}.position"][rows, 2, 2]
            steady[joints[name]] += own[joints[name]] ** 2 * float(np.mean(of))
        impulses = np.zeros((len(after), n))
        for name, variance in jumps.items():
            impulses[:, joints[name]] = variance[rows]
        slopes, mobility = self.dynamics.slopes(q, v, vd)
        made = spread_along(slopes, mobility, start, white, steady, after, impulses)
        return {
            f"{name}.{what}": made[:, i + k * n]
            for name, i in joints.items()
            for k, what in enumerate(("position", "velocity"))
        }

    def _effort_noise(self, recording: Recording, joints, n: int):
        """Noise of measured efforts where these stand in for commands: (n,) the density
        of what is white [(N m)^2 s], and (n,) the variance of what is the same
        throughout a window [(N m)^2]."""
        white, steady = np.zeros(n), np.zeros(n)
        for name in by_measured(self.scene, recording):
            channel = recording.channels[f"{name}.effort_measured"]
            i = joints[name]
            white[i] = channel.noise**2 / max(channel.rate_hz, 1e-6)
            steady[i] = self._slow_noise.get(name, 0.0) ** 2
        return white, steady

    def _unknown_jumps(self, recording: Recording, episode: Episode):
        """{joint: (n,) variance of its impulse, by row [(N m s)^2]} that jumps of an
        effort leave unknown, which is drawn as a line between its samples."""
        found = {}
        period = np.gradient(recording.time[episode.rows])
        for joint in by_measured(self.scene, recording):
            channel = recording.channels[f"{joint}.effort_measured"]
            y = recording[channel.name][episode.rows]
            found[joint] = jump_variance(y, channel.noise) * period**2
        return found

    def places_of(self, kind: str) -> list[str]:
        """Where a kind may act."""
        return self.dynamics.places(kind)

    # ----- Simulating

    def simulate(
        self, effects: Sequence[Effect], chosen=None, twists=None
    ) -> list[np.ndarray]:
        """(n, n_channels) of each window, in the scene with these effects added; NaN
        where a delayed sample shows what was before the window, infinite where Drake
        could not go on.

        Args: chosen: which windows, else all. twists: gives {joint: (twist, rate)} of a
            window's start, for joints behind an elastic element or a gap.
        """
        every = [*self.scene.effects, *effects]
        self.simulation.set_effects(every)
        commands = self.commands(every)
        self.runs += 1

        def of(w: Window) -> np.ndarray:
            recording = self.recordings[w.recording]
            episode = recording.episode_at(w.rows.start)
            y = self.simulation.run(
                self._initial(w, episode, effects),
                recording.time[w.rows],
                self.channels,
                commands[w.recording][episode.first],
                start_sec=w.start,
                initial_is_true=True,
                twists=twists(w) if twists else None,
                filters=self._filters[w.recording],
                before=self._before(w, episode, every),
            )
            if self.simulation.failure:
                y[np.isnan(y)] = np.inf
            return y

        none = np.zeros((0, len(self.channels)))
        some = [w for k, w in enumerate(self.windows) if chosen is None or chosen[k]]
        done = iter(self.simulation.each([partial(of, w) for w in some]))
        return [
            next(done) if chosen is None or chosen[k] else none
            for k in range(len(self.windows))
        ]

    def _before(self, w: Window, episode: Episode, effects):
        """{channel: (times, true values)} of what filters remember."""
        filters = {}
        for channel in self.channels:
            own = self._filters[w.recording].get(channel, ())
            if stages := with_lag(own, lag_of(effects, channel)):
                filters[channel] = stages
        if not filters:
            return None
        path = self._paths[w.recording, episode.first]
        time, end = path["time"], w.rows.start - episode.first + 1
        found = {}
        for channel, stages in filters.items():
            since = int(np.searchsorted(time, w.start - memory(stages))) - 1
            rows = slice(max(since, 0), end)
            value = self._true_path(channel, path, rows)
            if value is not None:
                found[channel] = (time[rows], value)
        return found

    def _true_path(self, channel: str, path, rows: slice) -> np.ndarray | None:
        at, what = channel.rsplit(".", 1)
        if channel in path:
            return path[channel][rows, 0]
        if what == "velocity":
            return path[f"{at}.position"][rows, 1]
        if what in ("vx", "vy", "vz") and f"{at}.{what[1]}" in path:
            return path[f"{at}.{what[1]}"][rows, 1]
        if what in ("wx", "wy", "wz") and f"{at}.qw" in path:
            q, dq = (
                np.stack([path[f"{at}.{a}"][rows, k] for a in TURN]) for k in (0, 1)
            )
            return spin_of(q.T, dq.T)[:, "xyz".index(what[1])]
        return None

    def _initial(self, w: Window, episode: Episode, effects) -> InitialSection:
        """The true state at the start, if the effects on measurement are these beside
        the scene's own."""
        said = self._said(w, episode)
        initial = InitialSection(
            dict(said.positions), dict(said.velocities),
            dict(said.poses), dict(said.body_velocities),
        )  # fmt: skip
        path = self._paths[w.recording, episode.first]
        measured = [e for e in (*self.scene.effects, *effects) if KINDS[e.kind].channel]

        def state(name: str) -> np.ndarray:
            scale, late, bias = sensing(measured, name)
            if scale == 1.0 and late == 0.0:
                x = w.state[name]
            else:
                at = w.start * scale + late
                x = np.array([np.interp(at, path["time"], y) for y in path[name].T])
                x = x * np.array([1.0, scale, scale**2])
            lag = lag_of(measured, name)
            if lag:  # What a low-pass took: true = measured + T d/dt measured.
                x = x + lag * np.array([x[1], x[2], 0.0])
            return x - np.array([bias, 0.0, 0.0])

        for joint in self.joints:
            x = state(f"{joint}.position")
            initial.positions[joint] = float(x[0])
            initial.velocities[joint] = float(x[1])
        for body in self.bodies:
            length = _length_scale(measured, body)
            place = np.zeros((3, 3))
            for i, axis in enumerate(_POSITIONS):
                if f"{body}.{axis}" in w.state:
                    place[i] = state(f"{body}.{axis}") / length
                elif body in said.poses:
                    place[i, 0] = said.poses[body][4 + i]
                    place[i, 1] = said.body_velocities.get(body, [0.0] * 6)[3 + i]
            q, dq = np.array([1.0, 0, 0, 0]), np.zeros(4)
            if body in said.poses:
                q = np.array(said.poses[body][:4])
                q = q / np.linalg.norm(q)
            if f"{body}.qw" in w.state:
                turn = np.array([state(f"{body}.{a}") for a in TURN])
                size = np.linalg.norm(turn[:, 0])
                q, dq = turn[:, 0] / size, turn[:, 1] / size
            spin = spin_of(q, dq)
            if f"{body}.qw" not in w.state:
                spin = np.array(said.body_velocities.get(body, [0.0] * 6)[:3])
            initial.poses[body] = [*map(float, q), *map(float, place[:, 0])]
            initial.body_velocities[body] = [
                *map(float, spin),
                *map(float, place[:, 1]),
            ]
            if f"{body}.z" not in w.state:  # It lies, and rolls, on what is below it.
                initial = self.simulation.put_down(initial, body)
        return initial

    def _said(self, w: Window, episode: Episode) -> InitialSection:
        """What the scene says of an episode's start: it holds for what is not measured;
        velocities only in the episode's first window."""
        path = str(self.recordings[w.recording].path)
        said = initial_for(self.scene, path, episode.number)
        if not (said.velocities or said.body_velocities):
            return said
        before = (x for x in self.windows if x.recording == w.recording)
        if episode.is_start and not any(
            episode.first <= x.rows.start < w.rows.start for x in before
        ):
            return said
        return replace(said, velocities={}, body_velocities={})

    def errors(self, simulated: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(measured - simulated)/std of each window, clipped as fits need it; 0 where
        nothing was measured or simulated."""
        each = self.errors_over(simulated, [w.std for w in self.windows])
        return [np.clip(e, -LARGEST, LARGEST) for e in each]

    def errors_over(
        self, simulated: Sequence[np.ndarray], std: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """(measured - simulated)/std of each window, as it is."""
        out = []
        for w, y, size in zip(self.windows, simulated, std, strict=True):
            e = (seen_in(self, w) - y) / size if len(y) else y
            out.append(np.where(np.isnan(e), 0.0, e))
        return out


def by_measured(scene: Scene, recording: Recording) -> list[str]:
    """Joints of which a measured effort stands in for the command."""
    if commanded(scene, recording):
        return []
    driven = _driven(scene, "effort_command")
    return [joint for joint in driven if f"{joint}.effort_measured" in recording]


def commanded(scene: Scene, recording: Recording) -> list[str]:
    """Names of the commands that the scene's drives take."""
    return [
        c.name for c in recording.commands()
        if c.name.rsplit(".", 1)[0] in _driven(scene, c.quantity)
    ]  # fmt: skip


def _driven(scene: Scene, quantity: str) -> list[str]:
    act = scene.actuation
    return act.joints if quantity in COMMANDS_OF[act.type] else []


def _velocity_starts(plant: MultibodyPlant) -> dict[str, int]:
    """{joint that moves: index of its velocity}."""
    return {
        full_name(plant, j): j.velocity_start()
        for j in one_dof_joints(plant)
        if j.num_velocities()
    }


def with_step(scene: Scene, time_step: float) -> Scene:
    """The scene with another time step [s]; 0 is continuous."""
    return replace(scene, plant=replace(scene.plant, time_step=time_step))


def _length_scale(effects, body: str) -> float:
    scale = 1.0
    for effect in effects:
        if effect.kind == "length_scale" and any(
            at in ("world", body, body.split(".")[0]) for at in effect.at
        ):
            scale *= effect.parameters["scale"]
    return scale


def spin_of(q, dq) -> np.ndarray:
    """(..., 3) rate of turn in the world [rad/s], of a unit quaternion (..., 4) wxyz
    and its rate: the vector part of 2 dq q*. What of dq lies along q does not count."""
    v, dv = q[..., 1:], dq[..., 1:]
    return 2.0 * (q[..., :1] * dv - dq[..., :1] * v - np.cross(dv, v))

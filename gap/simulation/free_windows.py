"""Windows of free bodies that fly, bounce, slide or roll on what is fixed, and collide.

A window starts from a state smoothed on one side of an impact, never across it, at the
row from which the next impact is told best. It ends 0.1 s after that impact: beyond the
second one all is chaos. How an uncertain start grows through the contact is simulated
and counts as noise.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from makebreak.gap.budget import go_on
from makebreak.gap.data.recording import Episode, Recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.free_body import (
    FreeBodies,
    FreeBody,
    gaps,
    lowest_gap,
    nearest,
    placed,
    simulate_all,
)
from makebreak.gap.numerics.free_flight import fit_flight, turned_by
from makebreak.gap.numerics.runs import runs_of
from makebreak.gap.numerics.struck import struck_rows
from makebreak.gap.simulation.free_bodies import FreeBodiesScene
from makebreak.gap.simulation.free_body import FreeBodyScene
from makebreak.gap.simulation.met_faces import met_faces
from makebreak.gap.simulation.unseen_spin import TOUCHES, Rolling, rolling
from makebreak.gap.simulation.windows import TURN, WindowedResidual, spin_of
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import Scene
from makebreak.systems.numerics.filters import Stage, filtered, mean_delay
from makebreak.systems.numerics.smoother import smooth_filtered

AFTER_SEC = 0.1  # Of a window after its impact.
LONG_SEC, LEAST_SEC = 2.0, 0.25  # Windows in which nothing hits: a tilt of 0.01
# degree moves a ball by 2 mm in 2 s, and by a twentieth of a millimetre in 0.3 s.
# A body that is accelerated by more [m/s2] is struck; gravity's is half of it.
IMPACT_ACCELERATION = 20.0
BESIDE = 3  # Rows beside an impact that a smoothed state would mix with it.
BLUR = 0.02  # Laws of contact are approximations, which noise alone does not tell.
DRAWS = 12  # Of uncertain starts.
ENOUGH = 30  # Windows up to the first impact: then later ones are not needed.
FEWEST_ROWS, FEWEST_IN_FLIGHT = 8, 6
AT_CORNERS_BETWEEN = (0.15, 1.0)  # Of the load of a face.
# Cosine of a cylinder's axis to the vertical below which it lies on its side; share of
# the rows that say so.
ACROSS, MOSTLY = 0.3, 0.95
SURE = 5.0  # Deviations by which a flight is bent otherwise than gravity bends it.
FLIES = 1.5  # Times the noise that a fit of free flight may leave, to be one.
UNEVEN = 0.5  # Of the error of all windows: what is held out must have as much of it.
NEAR = 2e-3  # [m] So near it is taken to touch.
FAR = 0.01  # [m] So far from it, it never meets it.
DENSE = 4  # Parts of a row's period at which a signal before a filter is simulated.
_PLACE = ("x", "y", "z")
_STATE = (*TURN, *_PLACE, "wx", "wy", "wz", "vx", "vy", "vz")


@dataclass(frozen=True, eq=False)
class FreeWindow:
    """state (7 n_bodies, 3): orientation and place with two derivatives, of one body
    after the other; spread (7 n_bodies, 2, 2): the covariances of the first two. std
    (n, n_channels) of measured minus simulated."""

    recording: int
    episode: int
    start: float  # [s]
    rows: slice
    state: np.ndarray
    spread: np.ndarray
    std: np.ndarray
    block: int
    train: bool  # Every third block is held out.
    after_hits: int  # Impacts of the episode before it.
    hit: int  # Its row at which the impact that ends it is; if none does, their number.
    # Of each body whose orientation is not measured, as it rolls or slides.
    rolling: tuple[Rolling | None, ...] = ()


class FreeBodyModel(WindowedResidual):
    """Residuals of windows of free bodies, as InverseModel gives those of mechanisms.

    Args: dynamics: of the scene, which takes long to load if it has many shapes.
    Raises: DoesNotFit where scene or recordings hold anything else (FreeBodiesScene),
        or bodies with faces come near one another; the bodies' x, y and z must be
        measured.
    """

    def __init__(
        self,
        scene: Scene,
        recordings: Sequence[Recording],
        most: int = 48,
        dynamics: SceneDynamics | None = None,
    ):
        self.scene, self.recordings = scene, list(recordings)
        self.dynamics = dynamics or SceneDynamics(scene)
        loaded = self.dynamics.loaded
        self._numbers = FreeBodiesScene(scene, (), loaded)
        self.on_side = [
            one.name for one in self._numbers.each if lies_on_side(one, recordings)
        ]
        if self.on_side:
            self._numbers = FreeBodiesScene(scene, self.on_side, loaded)
        self.with_faces = [one.name for one in self._numbers.each if one.has_faces]
        self._bodies = self._numbers.bodies()
        self.bodies, self.joints = self._numbers.names, list[str]()
        self._turns = []  # Whether the orientation of a body is measured.
        for name, body in zip(self.bodies, self._bodies.each, strict=True):
            if not all(f"{name}.{a}" in r for a in _PLACE for r in recordings):
                raise DoesNotFit(f"expected x, y and z of {name} in all recordings")
            turns = all(f"{name}.{a}" in r for a in TURN for r in recordings)
            if not turns and (len(body.spheres) > 1 or body.com.any()):
                raise DoesNotFit(f"expected the orientation of {name}")
            if name in self.with_faces:
                _check_edges(body, name, recordings)
            self._turns.append(turns)
        self._check_pairs()
        self.channels, sizes = list[str](), []
        for name, body in zip(self.bodies, self._bodies.each, strict=True):
            own = [f"{name}.{a}" for a in _STATE]
            own = [c for c in own if all(c in r for r in recordings)]
            self.channels += own
            sizes += [_size(body)] * len(own)
        self.noise = np.array(
            [max(r.channels[c].noise for r in recordings) for c in self.channels]
        )
        self.noise = np.maximum(self.noise, 1e-9)
        self._sizes = np.array(sizes)
        # Errors beyond the body's size, or a radian, say no more than these.
        self._cap = np.array(
            [self._most(c, x) for c, x in zip(self.channels, sizes, strict=True)]
        )
        # What recordings say of their sensors.
        self._filters: list[dict[str, tuple[Stage, ...]]] = [
            {c: stages for c in self.channels if (stages := r.channels[c].stages)}
            for r in recordings
        ]
        # Of each flight, and how much a curvature of its path that gravity does not
        # make takes off its squared residuals.
        self._curvatures: list[float] = []
        self._falls_freely = True
        self._cut_all()
        if self.with_faces:
            each = zip(self._bodies.each, self.bodies, strict=True)
            self._numbers.ease(
                [self._lies_on(body, name) | (not self.is_struck)
                 for body, name in each]
            )  # fmt: skip
            self._bodies = self._numbers.bodies()
        if _is_beyond_chance(self._curvatures):
            # Drag, say: a start fitted by gravity alone would be wrong, and the effect
            # that is looked for would make it worse.
            self._falls_freely = False
            self._cut_all()
        first = [w for w in self.windows if w.after_hits == 0]
        if len(first) >= ENOUGH and len(first) < len(self.windows):
            self.windows = first  # Later ones start from states that are less sure.
        if len(self.windows) > most:  # Those before and at early impacts say most.
            order = np.argsort([w.after_hits for w in self.windows], kind="stable")
            self.windows = [self.windows[k] for k in sorted(order[:most])]
        if not self.windows:
            raise DoesNotFit(
                f"no episode holds {FEWEST_ROWS} samples of "
                f"{' and '.join(self.bodies)} between impacts"
            )
        self._seen = [self._measured(w) for w in self.windows]
        self._add_spread()
        self.runs = 0
        self._share_out()
        self.window_sec = float(
            np.median([recordings[w.recording].time[w.rows][-1] - w.start
                       for w in self.windows])
        )  # fmt: skip

    def _most(self, channel: str, size: float) -> float:
        what = channel.rsplit(".", 1)[-1]
        if what in _PLACE:
            return size
        return 0.5 if what in TURN else (20.0 * size if what[0] == "v" else 20.0)

    def body(self, at: str) -> FreeBody:
        """The scene's, without further effects, that `at` (a body or a pair) names."""
        return self._bodies.each[self.bodies.index(first_of(self, at))]

    def places_of(self, kind: str) -> list[str]:
        """Where a kind may act."""
        return self.dynamics.places(kind)

    def _lies_on(self, body: FreeBody, name: str) -> np.ndarray:
        """(m,) on which of the fixed shapes a body lies nearly all the time, so that it
        never hits them."""
        near = [each < NEAR for each in self._gaps_seen(body, name)]
        share = np.mean(near, axis=0) if near else np.zeros(len(body.fixed))
        return share > MOSTLY

    def _gaps_seen(self, body: FreeBody, name: str) -> list[np.ndarray]:
        """gaps() at poses that are evenly spread over the recordings, 500 at most."""
        poses = np.concatenate([_poses(name, r) for r in self.recordings])
        return [gaps(body, pose) for pose in poses[:: len(poses) // 500 + 1]]

    @cached_property
    def met(self) -> dict[tuple[str, str], float]:
        """met_faces() of all bodies, the nearest of each face."""
        found: dict[tuple[str, str], float] = {}
        grounds = self._numbers.each[0].grounds
        for name, body in zip(self.bodies, self._bodies.each, strict=True):
            paths = [_window_poses(self, name, w) for w in self.windows]
            for key, off in met_faces(body, grounds, paths).items():
                if key not in found or abs(off) < abs(found[key]):
                    found[key] = off
        return found

    def rubs_others(self, friction: Effect) -> bool:
        """Whether a friction of a pair is so high that the surfaces of both change, and
        with them the friction of a body of it with third ones (models/effects/
        contact.py)."""
        now, then = self._bodies, self._numbers.bodies([friction])
        at = self._numbers.each[0].places(friction)
        ground = self._numbers.each[0].grounds_in(at)
        return any(
            not np.allclose(one.pairs[:, ~ground, 3], other.pairs[:, ~ground, 3])
            for one, other in zip(now.each, then.each, strict=True)
            if ground.any()
        )

    def _check_pairs(self) -> None:
        """Raises: DoesNotFit where two bodies come near each other, one of which would
        touch the other with spheres that stand in for faces."""
        for (i, a), (j, b) in itertools.combinations(enumerate(self.bodies), 2):
            if not {a, b} & {*self.with_faces} or not self._numbers.meet(a, b):
                continue
            reach = _size(self._bodies.each[i]) + _size(self._bodies.each[j]) + NEAR
            least = 9e9
            for recording in self.recordings:
                one, other = (
                    np.stack([recording[f"{n}.{c}"] for c in _PLACE], 1) for n in (a, b)
                )
                apart = np.linalg.norm(one - other, axis=1)
                least = min(least, np.nanmin(apart, initial=9e9))
            if least < reach:
                raise DoesNotFit(f"{a} and {b} come near each other")

    # ----- Cutting

    def _signals(self) -> list[str]:
        return [
            f"{name}.{a}"
            for name, turns in zip(self.bodies, self._turns, strict=True)
            for a in ((*TURN, *_PLACE) if turns else _PLACE)
        ]

    def _cut_all(self) -> None:
        self.windows: list[FreeWindow] = []
        self.is_struck = False
        number = 0
        total = sum(len(r.episodes) for r in self.recordings)
        for i, recording in enumerate(self.recordings):
            for episode in recording.episodes:
                self._cut(i, recording, episode, number if total >= 6 else None)
                number += 1

    def _cut(self, i: int, recording: Recording, episode: Episode, number) -> None:
        time = recording.time[episode.rows]
        values = {n: recording[n][episode.rows] for n in self._signals()}
        if any(np.isfinite(y).sum() < FEWEST_ROWS for y in values.values()):
            return
        rough = np.zeros(len(time), bool)
        for c in values:
            if c.rsplit(".", 1)[-1] not in _PLACE:
                continue
            stages = recording.channels[c].stages or ()
            noise = recording.channels[c].noise
            rough |= struck_rows(
                time, values[c], noise, stages, IMPACT_ACCELERATION, BESIDE
            )
        self.is_struck |= bool(rough.any())
        hit = np.flatnonzero(rough)
        near = np.zeros(len(time), bool)
        late = max(mean_delay(recording.channels[c].stages or ()) for c in values)
        for k in hit:  # What a filter remembers of it is gone after a while.
            gone = int(np.searchsorted(time, time[k] + 4.0 * late))
            near[max(k - BESIDE, 0) : gone + BESIDE + 1] = True
        for a, b in runs_of(~near):
            before = int(np.sum(np.diff(rough[:a].astype(int), prepend=0) == 1))
            self._cut_segment(
                i, recording, episode, time, values, a, b, rough, number, before
            )

    def _cut_segment(
        self, i, recording, episode, time, values, a, b, rough, number, before
    ):
        before_hit = b < len(time) and rough[b : b + BESIDE + 1].any()
        may_fly = before_hit and not self._filters[i]
        rows = min(np.isfinite(y[a:b]).sum() for y in values.values())
        if rows < (FEWEST_IN_FLIGHT if may_fly else FEWEST_ROWS):
            return
        n = b - a
        many = len(self.bodies)
        states = np.zeros((n, 7 * many, 3))
        spreads = np.zeros((n, 7 * many, 2, 2))
        deviation = np.zeros((n, 2, 7 * many))  # Of rate and acceleration.
        names = [f"{x}.{a}" for x in self.bodies for a in (*TURN, *_PLACE)]
        for k, c in enumerate(names):
            if k % 7 == 0:
                states[:, k, 0] = 1.0
            if c in values:
                stages = recording.channels[c].stages or ()
                noise = recording.channels[c].noise
                s = smooth_filtered(time[a:b], values[c][a:b], noise, stages)
                states[:, k], spreads[:, k] = s.x, s.P[:, :2, :2]
                square = np.diagonal(s.P, axis1=1, axis2=2)[:, 1:3]
                deviation[:, :, k] = np.sqrt(np.maximum(square, 0.0))
                # Where the acceleration jumps (it comes to rest, say) a smoothed state
                # is wrong by more than it knows.
                row, beside = np.arange(n), 4
                late = s.x[np.minimum(row + beside, n - 1), 2]
                jump = np.abs(late - s.x[np.maximum(row - beside, 0), 2])
                reach = beside * float(np.median(np.diff(time[a:b])))
                spreads[:, k, 1, 1] += (0.25 * jump * reach) ** 2
                spreads[:, k, 0, 0] += (0.06 * jump * reach**2) ** 2
        of = [slice(7 * k, 7 * k + 7) for k in range(many)]
        flights = []
        for k, o in enumerate(of if may_fly else ()):
            path = states[:, o], spreads[:, o]
            flights.append(self._fly(k, recording, time[a:b], values, a, *path))
        flies = may_fly and all(flights)
        rolls: list[Sequence[Rolling | None]] = []
        for k, (o, body) in enumerate(zip(of, self._bodies.each, strict=True)):
            each: Sequence[Rolling | None] = [None] * n
            if not self._turns[k]:
                place = states[:, o][:, 4:]
                each = rolling(body, time[a:b], place, deviation[:, :, o][:, :, 4:])
            rolls.append(each)
        if rows < FEWEST_ROWS and not flies:
            return
        spans = []
        if before_hit:
            first = b + int(np.argmax(rough[b:]))
            end = int(np.searchsorted(time, time[first] + AFTER_SEC, "right"))
            end = min(end, len(time))
            spans.append((a, b, time[first], end, first))
        if time[b - 1] - time[a] >= LEAST_SEC:
            starts = np.arange(time[a], time[b - 1] - LEAST_SEC, LONG_SEC)
            for t in starts:
                k = int(np.searchsorted(time, t))
                end = min(int(np.searchsorted(time, t + LONG_SEC, "right")), b)
                late = min(int(np.searchsorted(time, t + 0.15)), end)
                spans.append((k, max(late, k + 1), time[end - 1], end, end))
        for k0, k1, aim, end, struck in spans:
            tau = aim - time[k0:k1]
            P = spreads[k0 - a : k1 - a, np.arange(7 * many) % 7 >= 4]
            wide = np.sum(
                P[:, :, 0, 0]
                + 2 * tau[:, None] * P[:, :, 0, 1]
                + tau[:, None] ** 2 * P[:, :, 1, 1],
                axis=1,
            )
            # A vague start's round-off may leave a covariance that is none.
            sound = (P[..., 0, 0] > 0.0) & (
                P[..., 0, 0] * P[..., 1, 1] > P[..., 0, 1] ** 2
            )
            wide = np.where(sound.all(axis=1), wide, np.inf)
            k = k0 + int(np.argmin(wide))
            if end - k < 4:
                continue
            block = len(self.windows) if number is None else number
            self.windows.append(
                FreeWindow(
                    i, episode.number, float(time[k]),
                    slice(episode.first + k, episode.first + end), states[k - a],
                    spreads[k - a], np.zeros(0), block, block % 3 != 1, before,
                    min(struck, end) - k, tuple(each[k - a] for each in rolls),
                )
            )  # fmt: skip

    def _fly(self, number, recording, time, values, first, states, spreads) -> bool:
        """Where a body touches nothing before an impact, the states (n, 7, 3) and their
        covariances (n, 7, 2, 2) that all poses of the flight together tell. Returns:
        whether they are of a flight. Args: number: of the body."""
        name, body = self.bodies[number], self._bodies.each[number]
        turns = self._turns[number]
        signals = [f"{name}.{a}" for a in (*TURN, *_PLACE)]
        n = len(time)
        pose, noise = np.full((n, 7), np.nan), np.ones(7)
        for k, c in enumerate(signals):
            if c in values:
                pose[:, k] = values[c][first : first + n]
                noise[k] = recording.channels[c].noise
        if not turns:
            pose[:, :4] = [1.0, 0.0, 0.0, 0.0]
        at = [lowest_gap(body, x) for x in pose[np.isfinite(pose).all(axis=1)]]
        if np.mean(np.array(at) < NEAR) > 0.5:  # It slides or rolls.
            return False
        q, dq = states[n // 2, :4, 0], states[n // 2, :4, 1]
        q = q / np.linalg.norm(q)
        guess = np.concatenate(
            [states[0, :4, 0], states[0, 4:, 0], spin_of(q, dq - q * (q @ dq)),
             states[n // 2, 4:, 1]]
        )  # fmt: skip
        guess[12] -= body.gravity[2] * (time[n // 2] - time[0])
        flight = fit_flight(body, time, pose, noise, guess)
        if flight is None or flight.rms > FLIES:
            return False
        path, covariance = flight.path(body, time - time[0])
        if not np.isfinite(path).all() or not np.isfinite(covariance).all():
            return False
        covariance *= max(flight.rms, 1.0) ** 2
        self._curvatures.append(
            _curvature(time, (pose[:, 4:] - path[:, 4:7]) / noise[4:])
            / max(flight.rms, 1.0) ** 2
        )
        for k, (x, C) in enumerate(zip(path, covariance, strict=True)):
            if self._falls_freely:
                states[k, 4:] = np.stack([x[4:7], x[10:], body.gravity], axis=1)
                for i in range(3):
                    of = np.ix_([3 + i, 9 + i], [3 + i, 9 + i])
                    spreads[k, 4 + i] = C[of]
            if turns:
                x[:4] *= np.sign(x[:4] @ states[k, :4, 0])
                states[k, :4, 0], states[k, :4, 1] = x[:4], turned_by(x[:4], x[7:10])
                G = np.stack([turned_by(x[:4], e) for e in np.eye(3)], axis=1)
                both = np.zeros((8, 6))
                both[:4, :3] = both[4:, 3:] = G
                P = both @ C[np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])] @ both.T
                for i in range(4):
                    spreads[k, i] = P[np.ix_([i, 4 + i], [i, 4 + i])]
        return True

    def _measured(self, w: FreeWindow) -> np.ndarray:
        recording = self.recordings[w.recording]
        return np.stack([recording[c][w.rows] for c in self.channels], axis=1)

    def _add_spread(self) -> None:
        """Noise, and what uncertain starts do in the scene as it is."""
        rng = np.random.default_rng(0)
        whole = np.ones(len(self.bodies))
        plain = [self._simulate(self._bodies, w, w.state, whole) for w in self.windows]
        stds = []
        for w, y in zip(self.windows, plain, strict=True):
            wide = np.zeros_like(y)
            roots = [_root(P) for P in w.spread]
            for _ in range(DRAWS):
                state = np.array(w.state)
                for k, L in enumerate(roots):
                    state[k, :2] += L @ rng.normal(size=2)
                unseen = self._unseen_spins(w, rng)
                bodies = self._bodies
                if self.with_faces:  # Nobody knows where a face presses.
                    at_corners = rng.uniform(*AT_CORNERS_BETWEEN)
                    bodies = self._numbers.bodies((), at_corners)
                off = self._simulate(bodies, w, state, whole, unseen) - y
                off[~np.isfinite(off)] = 1e3
                wide += np.minimum(off**2, self._cap**2) / DRAWS
            stds.append(np.sqrt(self.noise**2 + wide))
        ones = [np.ones_like(std) for std in stds]
        off = np.concatenate(self.errors_over(plain, ones))
        # A gap is not measured to better than a share of itself.
        place = [k for k, c in enumerate(self.channels) if c[-2:] in (".x", ".y", ".z")]
        square = np.sum(off[:, place] ** 2, axis=1) / len(self.bodies)
        floor = BLUR * float(np.sqrt(np.mean(square))) * self._cap / self._sizes
        self.windows = [
            replace(w, std=np.sqrt(std**2 + floor**2))
            for w, std in zip(self.windows, stds, strict=True)
        ]

    def _unseen_spins(self, w: FreeWindow, rng: np.random.Generator):
        """Of each body, (3,) as a ball may spin [rad/s] while it flies, and how it may
        roll or slide; None where its orientation is measured.

        In flight it spins about as fast as one that rolls. What friction makes of it in
        a bounce, nobody knows."""
        found: list[tuple[np.ndarray, Rolling] | None] = []
        for k, rolls in enumerate(w.rolling):
            if rolls is None:
                found.append(None)
                continue
            speed = float(np.linalg.norm(w.state[7 * k + 4 : 7 * k + 7, 1]))
            spin = speed / self._bodies.each[k].spheres[0, 3] * rng.normal(size=3)
            found.append((spin, rolls.drawn(rng)))
        return found

    def _share_out(self) -> None:
        """Other blocks are held out if those that are hold next to nothing of the gap:
        then they could not tell any two models apart."""
        off = self.errors(self.simulate())
        size = np.array([np.mean(e**2) for e in off])
        third = np.array([w.block % 3 for w in self.windows])

        def held(k: int) -> float:
            return (
                float(np.sqrt(size[third == k].mean())) if (third == k).any() else 0.0
            )

        whole = float(np.sqrt(size.mean()))
        if held(1) >= UNEVEN * whole or not (third == 1).any():
            return
        best = min(range(3), key=lambda k: abs(np.log((held(k) + 1e-9) / whole)))
        if (third != best).any():
            self.windows = [replace(w, train=w.block % 3 != best) for w in self.windows]

    # ----- Simulating

    def _simulate(
        self, bodies: FreeBodies, w: FreeWindow, state, lengths, unseen=None
    ) -> np.ndarray:
        """(n, n_channels) of a window. Args: lengths (n_bodies,): that a camera sees of
        a metre. unseen: as of _unseen_spins()."""
        go_on()
        start = np.empty((len(self.bodies), 13))
        for k, (body, length) in enumerate(zip(bodies.each, lengths, strict=True)):
            own = state[7 * k : 7 * k + 7]
            q = own[:4, 0] / np.linalg.norm(own[:4, 0])
            dq = own[:4, 1] - q * (q @ own[:4, 1])
            place, velocity = own[4:, 0] / length, own[4:, 1] / length
            spin = spin_of(q, dq)
            rolls = w.rolling[k]
            if rolls is not None:
                if unseen and unseen[k]:
                    spin, rolls = unseen[k]
                gap, normal, _ = nearest(body, np.concatenate([q, place]))
                if gap < TOUCHES * body.spheres[0, 3]:
                    spin = rolls.spin(body, velocity, normal)
            start[k] = np.concatenate([q, place, spin, velocity])
        times = self.recordings[w.recording].time[w.rows]
        filters = self._filters[w.recording]
        n = DENSE if filters and len(times) > 1 else 1
        rows = np.arange(len(times))
        dense = np.interp(np.arange(n * (len(times) - 1) + 1) / n, rows, times)
        x = simulate_all(bodies, start, dense)
        x[:, :, 4:7] *= np.asarray(lengths)[:, None]
        x[:, :, 10:] *= np.asarray(lengths)[:, None]
        y = np.empty((len(dense), len(self.channels)))
        for k, channel in enumerate(self.channels):
            name, what = channel.rsplit(".", 1)
            y[:, k] = x[:, self.bodies.index(name), _STATE.index(what)]
            if channel in filters and n > 1:
                y[:, k] = filtered(filters[channel], dense, y[:, k])
        return y[::n]

    def simulate(self, effects: Sequence[Effect] = ()) -> list[np.ndarray]:
        """(n, n_channels) of each window, in the scene with these effects added."""
        bodies = self._numbers.bodies(effects) if effects else self._bodies
        lengths = np.ones(len(self.bodies))
        for e in (*self.scene.effects, *effects):
            if e.kind == "length_scale":
                for k, name in enumerate(self.bodies):
                    if {"world", name, name.split(".")[0]} & set(e.at):
                        lengths[k] *= e.parameters["scale"]
        self.runs += 1
        each = [self._simulate(bodies, w, w.state, lengths) for w in self.windows]
        return [np.where(np.isnan(y), np.inf, y) for y in each]

    def errors(self, simulated: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(measured - simulated)/std of each window, no more than the cap; 0 where
        nothing was measured."""
        return self.errors_over(simulated, [w.std for w in self.windows])

    def errors_over(
        self, simulated: Sequence[np.ndarray], stds: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """The same over given deviations."""
        out = []
        quaternions = [f"{name}.{a}" for name in self.bodies for a in TURN]
        turns = [[k for k, c in enumerate(self.channels) if c in quaternions[i : i + 4]]
                 for i in range(0, len(quaternions), 4)]  # fmt: skip
        for std, y, seen in zip(stds, simulated, self._seen, strict=True):
            for turn in filter(None, turns):  # q and -q are one orientation.
                same = np.sign(np.nansum(y[:, turn] * seen[:, turn], axis=1))
                y = np.array(y)
                y[:, turn] *= np.where(same < 0, -1.0, 1.0)[:, None]
            e = np.where(np.isfinite(y), seen - y, 1e3)
            e = e / np.sqrt(1.0 + (e / self._cap) ** 2)
            out.append(np.where(np.isfinite(seen), e / std, 0.0))
        return out


def lies_on_side(body: FreeBodyScene, recordings: Sequence[Recording]) -> bool:
    """Whether a body's cylinders lie on their sides in all that was measured.

    Raises: DoesNotFit where they lie at times and stand at others: what they touch with
        is not the same then.
    """
    across = []
    for recording in recordings:
        pose = _poses(body.name, recording)
        for axis in body.axes:
            up = [
                placed(x, axis[None])[0, 2] - x[6]
                for x in pose[:: len(pose) // 500 + 1]
            ]
            across.append(np.abs(up) < ACROSS)
    known = np.concatenate([np.zeros(0), *across])
    share = float(known.mean()) if len(known) else 0.0
    if 1.0 - MOSTLY < share < MOSTLY:
        raise DoesNotFit(f"{body.name} lies and stands")
    return share >= MOSTLY


def _check_edges(body: FreeBody, name: str, recordings: Sequence[Recording]) -> None:
    """Raises: DoesNotFit where a body whose corners stand in for its faces comes to the
    edge of a fixed box, which would be between them."""
    size = _size(body)
    for recording in recordings:
        place = _poses(name, recording)[:, 4:]
        for each in body.fixed:
            if each[12] < 0.0:
                continue
            R, half = each[:9].reshape(3, 3), each[12:]
            beyond = np.abs((place - each[9:12]) @ R) - half
            near = (beyond < size).all(axis=1)
            # Of a face, what it stands on, the body is farther beyond than of others.
            sides = np.sort(beyond[near], axis=1)[:, :2]
            if (sides > -size).any():
                raise DoesNotFit(f"{name} is near an edge of what it touches")


def _size(body: FreeBody) -> float:
    """How far it reaches from its origin [m]."""
    reach = np.linalg.norm(body.spheres[:, :3], axis=1) + body.spheres[:, 3]
    return float(reach.max())


def _poses(name: str, recording: Recording) -> np.ndarray:
    """(n, 7) quaternion wxyz and place of a body, of rows that have all of it."""
    channels = [f"{name}.{a}" for a in (*TURN, *_PLACE)]
    if not all(c in recording for c in channels):
        return np.zeros((0, 7))
    pose = np.stack([recording[c] for c in channels], axis=1)
    return pose[np.isfinite(pose).all(axis=1)]


def first_of(model: FreeBodyModel, at: str) -> str:
    """The first body that a place, `<body>` or `<body>~<body>`, names."""
    return next(name for name in at.split("~") if name in model.bodies)


def touched(model: FreeBodyModel, at: str) -> np.ndarray:
    """(n, 2) where in x and y the spheres of the first body that `at` names touched
    what is fixed, as measured."""
    body, found = model.body(at), [np.zeros((0, 2))]
    name = first_of(model, at)
    for w in model.windows:
        pose = _window_poses(model, name, w)
        for row in pose[:: max(len(pose) // 20, 1)]:
            if lowest_gap(body, row) < NEAR:
                feet = placed(row, body.spheres[:, :3])
                low = feet[:, 2] - body.spheres[:, 3]
                found.append(feet[low < low.min() + NEAR, :2])
    return np.concatenate(found)


def _window_poses(model: FreeBodyModel, name: str, w: FreeWindow) -> np.ndarray:
    """(n, 7) as _poses, of a window; upright where no orientation is measured."""
    recording = model.recordings[w.recording]
    pose = np.zeros((w.rows.stop - w.rows.start, 7))
    pose[:, 0] = 1.0
    for i, a in enumerate((*TURN, *_PLACE)):
        if f"{name}.{a}" in recording:
            pose[:, i] = recording[f"{name}.{a}"][w.rows]
    return pose[np.isfinite(pose).all(axis=1)]


def _curvature(time: np.ndarray, left: np.ndarray) -> float:
    """How much a parabola in each column takes off the squares of what a flight left,
    (n, 3) over the noise, NaN where there was no sample. 3 is expected by chance."""
    found = 0.0
    for column in left.T:
        good = np.isfinite(column)
        t = time[good] - time[good].mean()
        bend = t**2 - np.polyval(np.polyfit(t, t**2, 1), t)
        found += float(bend @ column[good]) ** 2 / max(float(bend @ bend), 1e-30)
    return found


def _is_beyond_chance(curvatures: Sequence[float]) -> bool:
    """Whether so many values of _curvature() are no chance (five deviations of a
    chi-squared one of three degrees of freedom each)."""
    n = 3.0 * len(curvatures)
    return sum(curvatures) > n + SURE * np.sqrt(2.0 * n)


def _root(P: np.ndarray) -> np.ndarray:
    """L with L L' = P (2, 2), also where P is singular."""
    w, u = np.linalg.eigh(P)
    return u * np.sqrt(np.maximum(w, 0.0))

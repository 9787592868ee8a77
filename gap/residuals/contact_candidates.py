"""What a scene in which robots touch things may lack: candidates, by trying each.

A candidate's column is what a small (or a far) trial changes in the rows. A patch of
other friction is looked for in cells of the ground, then searched on exactly.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.optimize import minimize

from makebreak.gap.problem import (
    Candidate,
    Fitted,
    Nuisances,
)
from makebreak.gap.residuals.contact_rows import ContactRows
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.ground import PLACE
from makebreak.models.effects.joints import ROTOR
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.objects import MASS

CELL, MOST_CELLS = 0.015, 20  # A side of the cells in which a patch is looked for [m].
LEAST_CELLS = 4
APART = 0.25  # Of rectangles, what they may have in common.
PATCH_RUNS, PATCH_STARTS, PATCHES = 120, 8, 3
# A friction that sticks may be anything larger: its logarithm is known to be off the
# scene's by about so much.
FRICTION_SPREAD = 1.0
# A side of a patch that is so far beyond what was slid over is as good as nearer, which
# is taken, with this deviation [m].
BESIDE, BEYOND = 0.01, 0.05
# Of what the scene has, tried: small steps, and far ones, for what a friction changes
# ends where the contact holds.
FRICTIONS, MASSES = (0.85, 1.3, 0.5, 2.0), (0.85, 1.2, 0.6, 1.6)
SIZES = (0.03, -0.03, 0.1, -0.1)  # Likewise, and added to 1.
OFFSETS = (2e-3, 0.01, -0.01)  # Of a centre of mass [m].
SHIFT = 1e-3  # Of a wall [m].
(BIAS,) = (name for name, kind in KINDS.items() if kind.channel == "bias")
SMALL = 0.1  # First trial of an effect on joints, of the efforts there.


class ContactCandidates(ContactRows):
    """The kinds of a ContactProblem, with columns."""

    _scalable: dict[str, bool]

    def change(self, effect: Effect) -> float:
        """Of a patch by how much its friction is another: a small one with much does
        nearly what a larger one with less does, if few things slid over it."""
        if effect.kind != "friction_patch":
            return 0.0
        now = [
            self._friction_now(p) for p in self._pairs_met if self._at_pair(effect, p)
        ]
        return abs(effect.parameters["friction"] - (now[0] if now else 0.0))

    def candidates(self, nuisances: Nuisances, current: Fitted) -> list[Candidate]:
        found = self._plain_candidates(current.r, current.effects)
        for pair in self._pairs_met:
            found += self._patches(pair, current)
        return found

    def _plain_candidates(self, r: np.ndarray, there: Sequence[Effect]):
        """All but patches, each by the difference that a trial makes."""
        found: list[Candidate] = []
        taken = {(e.kind, at) for e in there for at in e.at}
        for kind, at, size, names, fixed, trials in self._trials():
            if (kind, at) in taken:
                continue
            columns, readers = [], []
            places = self._acts_at(kind, at)
            for trial in trials:
                made = []
                for step, parameters in trial:
                    moved = self._try(there, Effect(kind, places, parameters))
                    if moved is None:
                        break
                    made.append((r - moved) / step)
                if len(made) < len(names):
                    continue
                X = np.stack(made, axis=1)
                if not np.isfinite(X).all() or not np.abs(X).max() > 1e-6:
                    continue
                columns.append(X)
                readers.append(reader_of_trial(kind, names, trial))
            if columns:
                least = self.dynamics.least(kind, [at])
                found.append(
                    Candidate(kind, tuple(places), size, tuple(columns),
                              tuple(readers), fixed, least=least)
                )  # fmt: skip
        return found

    def _acts_at(self, kind: str, at: str) -> list[str]:
        """All places of an effect that is tried at one."""
        return [at]

    def _try(self, there: Sequence[Effect], effect: Effect) -> np.ndarray | None:
        """With the weights of what is there: columns are then as linear as can be."""
        try:
            return self._left_by([*there, effect], there)
        except (ValueError, RuntimeError):
            return None

    def _trials(self):
        """(kind, place, size, names of what is fitted, names of what stays, trials);
        a trial is (step, parameters) for each of the names."""
        for pair in self._pairs_met:
            at = self.pair_name(pair)
            mu = self._friction_now(pair)
            if mu > 0.0:
                steps = [[((f - 1.0) * mu, {"friction": f * mu})] for f in FRICTIONS]
                yield "contact_friction", at, 1, ("friction",), (), steps
        for body in self.bodies:
            yield from self._of_body(body)
        for body in self.objects:
            yield from self._mass_of(body)
            com = self.dynamics.now("object_com", [body])
            moved = {a: {**com, a: com[a] + OFFSETS[0]} for a in com}
            axes = tuple(a for a in com if self._shows("object_com", body, moved[a]))
            rest = tuple(a for a in com if a not in axes)
            steps = [[(d, {**com, a: com[a] + d}) for a in axes] for d in OFFSETS]
            if axes:
                yield "object_com", body, len(axes), axes, rest, steps
        for at in self.dynamics.places("plane_tilt"):
            zero = {"roll": 0.0, "pitch": 0.0}
            steps = [[(0.004, {**zero, a: 0.004}) for a in zero]]
            yield "plane_tilt", at, 2, ("roll", "pitch"), (), steps
        for at in self.dynamics.places("plane_height"):
            yield "plane_height", at, 1, ("height",), (), [[(1e-3, {"height": 1e-3})]]
        for wall, axes in self._walls_met().items():
            zero = dict.fromkeys(axes, 0.0)
            steps = [[(SHIFT, {**zero, a: SHIFT}) for a in axes]]
            yield PLACE, self.shapes.names[wall], len(axes), axes, (), steps
        for at, bias in self.biased.items():
            yield BIAS, at, 1, ("bias",), (), [[(bias, {"bias": bias})]]
        yield from self._of_mechanism()

    def _walls_met(self) -> dict[int, tuple[str, ...]]:
        """{fixed body: axes of the world along which what moves freely meets it}, but
        for what carries it."""
        found: dict[int, set[str]] = {}
        for s, on in zip(self.slots, self._masks, strict=True):
            pair = self._pair_of(s)
            if on.any() and self._is_of_a_free_body(pair) and not self._lies(pair):
                (body,) = set(pair) & self.shapes.anchored
                axis = int(np.argmax(np.abs(s.normal[on]).mean(axis=0)))
                found.setdefault(body, set()).add("xyz"[axis])
        return {k: tuple(sorted(axes)) for k, axes in found.items()}

    def _friction_now(self, pair) -> float:
        """Of the slots that act."""
        for s, on in zip(self.slots, self._masks, strict=True):
            if self._pair_of(s) == pair and on.any():
                return s.friction
        return 0.0

    def _shows(self, kind: str, at: str, parameters: dict[str, float]) -> bool:
        """Whether a single effect changes anything."""
        r = self._try((), Effect(kind, [at], parameters))
        return r is not None and bool(np.abs(r - self.base()).max() > 1e-3)

    def _mass_of(self, body: str):
        mass = self.dynamics.now(MASS, [body])["mass"]
        steps = [[((f - 1.0) * mass, {"mass": f * mass})] for f in MASSES]
        yield MASS, body, 1, ("mass",), (), steps

    def _of_body(self, body: str):
        yield from self._mass_of(body)
        mass = self.dynamics.now(MASS, [body])["mass"]
        com = self.dynamics.now("object_com", [body])
        steps = [[(d, {**com, a: com[a] + d}) for a in "xy"] for d in OFFSETS]
        yield "object_com", body, 2, ("x", "y"), ("z",), steps
        if self._can_be_scaled(body):
            steps = [[(d, {"scale": 1.0 + d})] for d in SIZES]
            yield "object_size", body, 1, ("scale",), (), steps
        inertia = self.dynamics.now("object_inertia", [body])
        mid = {k: inertia[k] for k in ("ixx", "iyy", "izz")}
        for f in (0.9,):
            each = {**mid, "izz": f * mid["izz"]}
            yield (
                "object_inertia", body, 1, ("izz",), ("ixx", "iyy"),
                [[((f - 1.0) * mid["izz"], each)]],
            )  # fmt: skip
        size = 0.05 * mass * 9.81
        zero = {"fx": 0.0, "fy": 0.0, "fz": 0.0}
        steps = [[(size, {**zero, a: size}) for a in ("fx", "fy")]]
        yield "constant_force", body, 2, ("fx", "fy"), ("fz",), steps
        zero = {"linear": 0.0, "angular": 0.0}
        step = mass
        yield (
            "body_drag", body, 1, ("linear",), ("angular",),
            [[(step, {**zero, "linear": step})]],
        )  # fmt: skip

    def _can_be_scaled(self, body: str) -> bool:
        """Whether Drake can, with all that is seen of it (not a mesh)."""
        if body not in self._scalable:
            effect = Effect("object_size", [body], {"scale": 1.01})
            more = replace(self.scene, effects=[*self.scene.effects, effect])
            try:
                SceneDynamics(more)
                self._scalable[body] = True
            except (ValueError, RuntimeError):
                self._scalable[body] = False
        return self._scalable[body]

    def _of_mechanism(self):
        """Kinds with one parameter at joints and links of the robot."""
        m = self.means
        effort = np.sqrt(np.mean(m.effort**2, axis=0))
        speed = np.sqrt(np.mean(self.motion.v**2, axis=0))
        index = {joint: i for joint, (_, i) in self.joints.items()}
        inertia = np.mean(self._M[:, range(len(effort)), range(len(effort))], axis=0)
        for kind, entry in KINDS.items():
            if entry.at not in ("joint", "actuator") or len(entry.parameters) != 1:
                continue
            if entry.path and entry.path not in ("gain", "bias"):
                continue
            if not entry.path and entry.signature is None and entry.added is None:
                continue
            (p,) = entry.parameters
            for at in self.dynamics.places(kind):
                i = index.get(at)
                if i is None or self.by[at] == "":
                    continue
                if self.by[at] == "passive" and (entry.path or kind == ROTOR):
                    continue  # It has no motor.
                now = self.dynamics.now(kind, [at]).get(p.name, 0.0)
                force = SMALL * max(effort[i], 1e-3 * effort.max() + 1e-9)
                step = {
                    "N m": force,
                    "N m s/rad": force / max(speed[i], 1e-3),
                    "N m s2/rad2": force / max(speed[i], 1e-3) ** 2,
                    "kg m2": 0.2 * inertia[i],
                    "": 0.05,
                }.get(p.unit)
                if step is not None and np.isfinite(now):
                    yield kind, at, 1, (p.name,), (), [[(step, {p.name: now + step})]]

    # ----- A patch of other friction

    def _patches(self, pair, current: Fitted) -> list[Candidate]:
        """A rectangle: cells of the ground that was slid over are tried one by one, a
        rectangle is the sum of its cells; the best is searched on exactly."""
        at = self.pair_name(pair)
        there = list(current.effects)
        if not self._may_have_patch(pair, there):
            return []
        mu = self._friction_now(pair)
        for e in there:
            if e.kind == "contact_friction" and at in e.at:
                mu = e.parameters["friction"]
        places = self._slid_over(pair)
        if mu <= 0.0 or len(places) < 40:
            return []
        grid = []
        for c in places.T:
            low, high = float(c.min()) - 1e-3, float(c.max()) + 1e-3
            n = int(np.clip(round((high - low) / CELL), 1, MOST_CELLS))
            if n < LEAST_CELLS:
                return []
            grid.append(np.linspace(low, high, n + 1))
        r, train = current.r, self.train()

        def patch(friction, sides) -> dict[str, float]:
            names = ("x_min", "x_max", "y_min", "y_max")
            named = dict(zip(names, map(float, sides), strict=True))
            return {"friction": float(friction)} | named

        def moved(friction, sides) -> np.ndarray | None:
            effect = Effect("friction_patch", [at], patch(friction, sides))
            return self._try(there, effect)

        nx, ny = len(grid[0]) - 1, len(grid[1]) - 1
        count, _, _ = np.histogram2d(places[:, 0], places[:, 1], bins=grid)
        rectangles = []
        # More friction is not less of it turned round: other forces are at limits.
        for step in (-0.2 * mu, 0.2 * mu):
            cells = np.zeros((nx, ny, int(train.sum())))
            for i, j in np.argwhere(count):
                new = moved(mu + step, (*grid[0][i : i + 2], *grid[1][j : j + 2]))
                if new is not None:
                    cells[i, j] = ((r - new) / step)[train]
            rectangles += _best_rectangles(cells, r[train], mu)
        # Less steep than 1.5 is what surfaces are: a corner of a patch with more of it
        # does in few rows what the patch does in many.
        most = KINDS["friction_patch"].parameter("friction").high
        found = []
        for c, (i0, i1, j0, j1) in rectangles:
            box = np.array([grid[0][i0], grid[0][i1], grid[1][j0], grid[1][j1]])
            for f in dict.fromkeys((mu + c, 0.5 * mu, 1.6 * mu)):
                new = moved(f, box)
                if new is not None:
                    found.append((float(np.mean(new[train] ** 2)), f, box))
        found.sort(key=lambda each: each[0])
        best: list[tuple] = []
        for _, f, box in found:  # Of each rectangle the best, and few of them.
            if len(best) < PATCH_STARTS and not any(box is b[3] for b in best):
                best.append((*self._search_patch(moved, f, box, train, 60, most), box))
        # What passes over one place passes over others with its other feet: rows that
        # are held out say which it is.
        best.sort(key=lambda each: each[0])
        columns, readers = [], []
        for _, friction, sides, _ in best[:PATCHES]:
            _, friction, sides = self._search_patch(
                moved, friction, sides, train, PATCH_RUNS, most
            )
            new = moved(friction, sides)
            if new is None or abs(friction - mu) < 1e-6:
                continue
            columns.append(((r - new) / (friction - mu))[:, None])

            def read(c, sides=sides) -> dict[str, float]:
                return patch(np.clip(mu + c[0], 0.05 * mu, most), sides)

            readers.append(read)
        return [
            Candidate("friction_patch", (at,), 5, (column,), (read,))
            for column, read in zip(columns, readers, strict=True)
        ]

    def _may_have_patch(self, pair, there: Sequence[Effect]) -> bool:
        at = self.pair_name(pair)
        if not self._lies(pair) or at not in self.dynamics.places("friction_patch"):
            return False
        return not any(e.kind in ("plane_tilt", "friction_patch") for e in there)

    def _search_patch(
        self, moved: Callable, friction, sides, train, runs: int, most: float
    ):
        """The error, friction (at most `most`) and sides from which no small move takes
        off more."""
        scale = np.array([0.1 * friction, 0.01, 0.01, 0.01, 0.01])

        def cost(z) -> float:
            f, box = friction + scale[0] * z[0], sides + scale[1:] * z[1:]
            if not (0.0 < f <= most and box[0] < box[1] and box[2] < box[3]):
                return 1e9
            r = moved(f, box)
            return 1e9 if r is None else float(np.mean(r[train] ** 2))

        corners = np.vstack([np.zeros(5), np.eye(5)])
        found = minimize(
            cost, np.zeros(5), method="Nelder-Mead",
            options={"initial_simplex": corners, "maxfev": runs, "xatol": 0.01,
                     "fatol": 1e-5},
        )  # fmt: skip
        x = scale * found.x
        return float(found.fun), friction + x[0], sides + x[1:]

    def prior_rows(self, effects: Sequence[Effect]) -> np.ndarray:
        """Where something sticks all friction that is enough explains alike: what is
        nearest to the scene's is taken. So do all sides of a patch that are beyond what
        was slid over: there a fit would go on for kilometres."""
        rows: list[float] = []
        for e in effects:
            if e.kind == "contact_friction":
                for pair in self._pairs_met:
                    now = self._friction_now(pair)
                    if now > 0.0 and self._at_pair(e, pair):
                        off = np.log(max(e.parameters["friction"], 1e-3) / now)
                        rows.append(off / FRICTION_SPREAD)
            elif e.kind == "friction_patch":
                rows += self._sides_beyond(e)
        return np.array(rows)

    def _sides_beyond(self, patch: Effect) -> list[float]:
        """By how much sides are beyond what was slid over, over BEYOND."""
        slid = [self._slid_over(p) for p in self._pairs_met if self._at_pair(patch, p)]
        places = np.vstack([*slid, np.zeros((0, 2))])
        if not len(places):
            return []
        off = []
        for axis, c in zip("xy", places.T, strict=True):
            sides = [patch.parameters[f"{axis}_{end}"] for end in ("min", "max")]
            off += [c.min() - BESIDE - side for side in sides]
            off += [side - c.max() - BESIDE for side in sides]
        return [float(max(each, 0.0) / BEYOND) for each in off]

    def _now_at(self, effect: Effect) -> float:
        """Friction in the scene, of the pair that an effect is of."""
        return next(
            (
                self._friction_now(p)
                for p in self._pairs_met
                if self._at_pair(effect, p)
            ),
            np.inf,
        )

    def _slid_over(self, pair) -> np.ndarray:
        """(n, 2) places of the ground over which a point of the pair slid."""
        out = []
        for s, on in zip(self.slots, self._masks, strict=True):
            if self._pair_of(s) == pair and on.any():
                v = np.einsum("nij,nj->ni", self._relative(s), self._node_v)
                slides = on & (np.linalg.norm(v, axis=1) > 0.01)
                out.append(s.place[slides, :2])
        return np.vstack(out) if out else np.zeros((0, 2))


def reader_of_trial(kind: str, names: Sequence[str], trial) -> Callable:
    """From coefficients to parameters."""
    start = dict(trial[0][1])
    for name, (step, parameters) in zip(names, trial, strict=True):
        start[name] = parameters[name] - step

    def read(c) -> dict[str, float]:
        out = dict(start)
        for name, x in zip(names, c, strict=True):
            out[name] = start[name] + float(x)
        for p in KINDS[kind].parameters:
            if p.valid in (">= 0", "> 0") and p.name in out:
                low = 0.1 * abs(start[p.name]) if p.valid == "> 0" else 0.0
                out[p.name] = max(out[p.name], low)
        return out

    return read


def _best_rectangles(cells: np.ndarray, r: np.ndarray, mu: float, most: int = 8):
    """Rectangles of cells, each with what is added to their friction, that take most
    off r (n,) to first order, none of which has much in common with another. cells
    (nx, ny, n).
    Returns: [(c, (i0, i1, j0, j1))]."""
    nx, ny, n = cells.shape
    sums = np.zeros((nx + 1, ny + 1, n))
    sums[1:, 1:] = cells.cumsum(axis=0).cumsum(axis=1)
    found = []
    for i0, i1 in combinations(range(nx + 1), 2):
        strip = sums[i1] - sums[i0]  # (ny + 1, n)
        # Of all j0 < j1 at once: x = strip[j1] - strip[j0].
        gram, pull = strip @ strip.T, strip @ r
        d = np.diag(gram)
        size = d[:, None] + d[None, :] - 2.0 * gram
        dot = pull[None, :] - pull[:, None]  # [j0, j1]
        c = np.where(size > 1e-12, dot / np.maximum(size, 1e-12), 0.0)
        c = np.clip(c, -0.8 * mu, 1.5 * mu)
        gain = 2.0 * c * dot - c * c * size
        gain[np.tril_indices(ny + 1)] = 0.0
        for flat in np.argsort(gain, axis=None)[::-1][:4]:
            j0, j1 = np.unravel_index(int(flat), gain.shape)
            if gain[j0, j1] > 0.0:
                corners = (i0, i1, int(j0), int(j1))
                found.append((float(gain[j0, j1]), float(c[j0, j1]), corners))
    found.sort(key=lambda each: -each[0])
    kept: list[tuple[float, tuple[int, int, int, int]]] = []
    for _, added, box in found:
        if len(kept) < most and all(_overlap(box, other) < APART for _, other in kept):
            kept.append((added, box))
    return kept


def _overlap(a, b) -> float:
    """What two rectangles have in common, as a share of what they cover together."""
    x = max(min(a[1], b[1]) - max(a[0], b[0]), 0)
    y = max(min(a[3], b[3]) - max(a[2], b[2]), 0)
    area = (a[1] - a[0]) * (a[3] - a[2]) + (b[1] - b[0]) * (b[3] - b[2])
    return x * y / (area - x * y)

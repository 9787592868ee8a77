"""How a contact would have to press otherwise for what is left to be explained.

Not an effect, and no name: of each pair that meets, forces may turn away from where its
shapes face, or act beside where they meet, by ever more. A tip that is worn, or a
simulator's coarse mesh of it, shows as one of the two.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from makebreak.gap.numerics.permitted_forces import explain, tangents
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Fitted, rms
from makebreak.gap.residuals.contact_dynamics import SHAPED, ContactDynamics
from makebreak.gap.simulation.contact_shapes import Slot
from makebreak.models.effects.kind import Effect

TURNED = (2.0, 5.0, 10.0, 20.0)  # [degrees] that a force may turn away,
BESIDE = (1.0, 2.0, 4.0, 8.0)  # and [mm] that it may act aside.
WORTH = 0.5  # What is left then, of what is left now, at most.
ENOUGH = 1.1  # Of what the largest size leaves, for a smaller one to be said.
ALIKE = 0.9  # More of what is left now is no less of it.
MOST_SAID = 2
FEWEST = 8  # Rows of a distance.


@dataclass(frozen=True)
class Widened:
    """A pair of bodies, how far it would have to press otherwise (unit: degrees or mm),
    and what is left then (times the noise)."""

    pair: str
    size: float
    unit: str
    left: float

    @property
    def says(self) -> str:
        if self.unit == "mm":
            return (
                f"if {self.pair} met up to {self.size:g} mm beside where its shapes do"
            )
        return (
            f"if the forces of {self.pair} were up to {self.size:g} degrees away from "
            "what its shapes and its friction permit"
        )


def widened_slots(slots: Sequence[Slot], size: float, unit: str) -> list[Slot]:
    """Each slot four times: its normal turned by size [degrees], or its place moved by
    size [mm], either way along either tangent. What lies between is sums of these."""
    found = []
    for s in slots:
        for e in tangents(s.normal):
            for sign in (-1.0, 1.0):
                if unit == "mm":
                    found.append(replace(s, place=s.place + sign * 1e-3 * size * e))
                else:
                    a = sign * np.radians(size)
                    turned = np.cos(a) * s.normal + np.sin(a) * e
                    found.append(replace(s, normal=turned))
    return found


def left_if_widened(
    problem: ContactDynamics, effects: Sequence[Effect], pair, size: float, unit: str
) -> np.ndarray:
    """(K, rows) of equations and wrenches, over the noise: what forces leave if those
    of a pair of bodies are permitted so much more; size 0: as they are."""
    shaped = [e for e in effects if e.kind in SHAPED]
    G, there, _, geometry, sharing = problem._generators(shaped)
    if size:
        masks = geometry.masks
        own = [s for s in geometry.slots if problem._pair_of(s) == pair]
        more = widened_slots(own, size, unit)
        # What is fixed may have been moved by an effect: arms are of what moves.
        made = problem._columns(more, problem._node_poses, masks)
        columns = []
        for c in made:
            mu = problem._friction(more[c.slot], shaped)
            rubbing = problem._W @ (mu[:, None] * c.rubbing)
            columns.append(c.pressing + c.scale[:, None] * rubbing)
        if columns:
            G = np.concatenate([G, np.stack(columns, axis=2)], axis=2)
            there = np.hstack([there, np.stack([c.can for c in made], axis=1)])
            nothing = np.zeros((*sharing.shape[:2], len(made)))
            sharing = np.concatenate([sharing, nothing], axis=2)
    needs, root = problem._all_needs(effects), problem._root(effects)
    r, rank = np.zeros_like(needs), np.zeros(len(needs), np.int64)
    explain(needs, G, there, root, sharing, r, np.zeros(there.shape), rank)
    # More forces take up more of what is free.
    n = needs.shape[1]
    return r * np.sqrt(n / np.maximum(n - rank, 1))[:, None]


def widened_contacts(problem, end: Fitted, most: float) -> tuple[float, list[Widened]]:
    """What is left in equations (times the noise), and what would explain it, the least
    left first: what takes it below WORTH of that, or below `most`.

    Args: problem: a ContactProblem; end: with all that was named.
    """
    n = len(problem.coordinates) + problem.n_wrench
    judged = np.flatnonzero(problem.channel_of_rows() < n)
    nuisances = problem.nuisances()

    def left_of(pair, size: float, unit: str) -> float:
        r = np.zeros(problem._shown.shape)
        r[problem._shown] = end.r
        r[:, :n] = left_if_widened(problem, end.effects, pair, size, unit)
        flat = r[problem._shown]
        screen = Screen(flat, nuisances.columns, nuisances.prior, problem.train())
        return rms(screen.fit_nuisances(flat)[1][judged])

    now = left_of(None, 0.0, "")
    found: list[Widened] = []
    if now <= most:
        return now, found
    for pair in problem._pairs_met:
        for unit, sizes in (("degrees", TURNED), ("mm", BESIDE)):
            least = left_of(pair, sizes[-1], unit)
            if least > max(WORTH * now, min(most, ALIKE * now)):
                continue
            for size in sizes:
                left = least if size == sizes[-1] else left_of(pair, size, unit)
                if left <= max(ENOUGH * least, 1.0):
                    break
            found.append(Widened(problem.pair_name(pair), size, unit, left))
    return now, sorted(found, key=lambda w: w.left)


def distances_off(problem, end: Fitted, most: float) -> list[str]:
    """Of pairs whose shapes are apart, or in one another, by more than `most` times
    what that is known to: how much, in words."""
    said = []
    names, of_rows = problem.row_names(), problem.channel_of_rows()
    for pair in problem._pairs_met:
        name = problem.pair_name(pair)
        left = end.left[of_rows == names.index(f"{name}.distance")]
        if len(left) < FEWEST or rms(left) <= most:
            continue
        d = -1e3 * float(np.median(left)) * problem.distance_std(pair)
        how = "apart" if d > 0.0 else "inside one another"
        said.append(
            f" Where {name} press on each other, the scene's shapes are "
            f"{abs(d):.2g} mm {how}."
        )
    return said


def sentence(now: float, found: Sequence[Widened]) -> str:
    """now: what is left in equations, times the noise; none found: nothing is said."""
    if not found:
        return ""
    each = [f"{w.says} ({w.left:.2g})" for w in found[:MOST_SAID]]
    return (
        f" Of {now:.2g} times the noise in the equations less would be left "
        f"{', or '.join(each)}: that is no name, but where to look."
    )

"""Which bodies or geometries may touch: ContactPair, and the contacts that it means."""

from dataclasses import dataclass, field
from difflib import get_close_matches

import numpy as np
from pydrake.geometry import GeometryId
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from makebreak.systems.contact_mpc.numerics.contact_rows import friction_edges
from makebreak.systems.numerics.settings import check_settings


@dataclass
class Anitescu:
    """Convex contact: 2 n_f entries of lam. As an artefact of the relaxation, a sliding
    contact opens by dt mu |v_t|."""


@dataclass
class StewartTrinkle:
    """Polyhedral friction cone: 2 n_f + 2 entries of lam, which are the normal force,
    2 n_f friction forces and the sliding speed; without friction only the first."""


@dataclass
class ContactPair:
    """Two bodies or collision geometries that may touch.

    A body is named "model::body", or "body" where that is unique; a geometry by its
    name in the scene graph ("ball::ball_collision"). A body stands for all of its
    collision geometries: every combination of two geometries is a contact of its own,
    unless `closest` limits them to the nearest ones.
    """

    a: str = ""
    b: str = ""
    friction: float = 1.0  # Coulomb coefficient mu.
    friction_directions: int = 2  # n_f; 2 n_f friction edges, so 2 n_f forces.
    # World direction (3,) onto whose projection the first friction edge is aligned;
    # empty: the basis of Drake's MakeFromOneVector, which jumps as the normal turns.
    tangent: list[float] = field(default_factory=list)
    # For a plant that moves in a plane: the plane's normal in the world (3,). The first
    # edge is then in the plane; with friction_directions = 1 both edges are.
    plane_normal: list[float] = field(default_factory=list)
    # In YAML `contact_model: !StewartTrinkle {}`.
    contact_model: Anitescu | StewartTrinkle = field(default_factory=Anitescu)
    # Normal force over penetration [N/m], without damping; None: rigid, but for eps_c.
    stiffness: float | None = None
    # Number of contacts, the nearest combinations of geometries; None: all.
    closest: int | None = None
    # Friction along `tangent` over that across it.
    anisotropy: float = 1.0


@dataclass
class Contact:
    """One combination of two geometries of a pair."""

    geometries: tuple[GeometryId, GeometryId]  # The one registered first is A.
    name: str
    pair: int  # Number of its pair.
    mu: float
    compliance: float  # [m/N]
    anitescu: bool
    edges: np.ndarray  # (2 n_f, 2), friction_edges.
    reference: np.ndarray  # (3,) for tangent_basis.
    planar: bool  # Whether `reference` is the normal of the plant's plane.

    @property
    def kind(self) -> tuple:
        """What decides the contact's rows: contact_rows."""
        return self.anitescu, self.edges, self.mu > 0.0, self.compliance > 0.0


def contacts_of(
    pairs: list[ContactPair], plant: MultibodyPlant, inspector
) -> tuple[list[Contact], list[tuple[np.ndarray, int]]]:
    """All contacts of the pairs, and of each pair (indices of its contacts, how many of
    them, the nearest, the LCS has).

    Args: inspector: the scene graph's.
    Raises: ValueError that names the pair and what is wrong.
    """
    named = _NamedGeometries(plant, inspector)
    contacts: list[Contact] = []
    groups: list[tuple[np.ndarray, int]] = []
    for number, pair in enumerate(pairs):
        if not isinstance(pair, ContactPair):
            raise ValueError(f"pairs[{number}] is {pair!r}, expected a ContactPair")
        check_settings(pair, f"ContactPair {pair.a}~{pair.b}")
        first = len(contacts)
        contacts += _combinations(number, pair, named)
        indices = np.arange(first, len(contacts))
        count = indices.size
        if pair.closest is not None:
            count = checked_count(f"{pair.a}~{pair.b}: closest", pair.closest, count)
        groups.append((indices, count))
    return contacts, groups


def _combinations(number: int, pair: ContactPair, named: "_NamedGeometries"):
    """The contacts of one pair: every combination of a geometry of a and one of b."""
    of_a, of_b = named.find(pair.a), named.find(pair.b)
    name = f"{pair.a}~{pair.b}"
    reference, planar = _check_pair(name, pair)
    edges = friction_edges(int(pair.friction_directions)) * [pair.anisotropy, 1.0]
    if planar:  # t1 follows the plane's normal, so the edges start at t2.
        edges = edges[:, ::-1] * [-1.0, 1.0]
    compliance = 0.0 if pair.stiffness is None else 1.0 / pair.stiffness
    anitescu = isinstance(pair.contact_model, Anitescu)
    inspector, found = named.inspector, []
    for one in of_a:
        for other in of_b:
            # As in c3's LcsFactory: A is the geometry that was registered first.
            id_A, id_B = sorted([one, other], key=lambda g: g.get_value())
            if inspector.GetFrameId(id_A) == inspector.GetFrameId(id_B):
                raise ValueError(f"{name}: both are on the same body")
            names = f"{inspector.GetName(id_A)}~{inspector.GetName(id_B)}"
            found.append(
                Contact(
                    (id_A, id_B),
                    names,
                    number,
                    float(pair.friction),
                    compliance,
                    anitescu,
                    edges,
                    reference,
                    planar,
                )  # fmt: skip
            )
    return found


def checked_count(name, value, most) -> int:
    """The value as an integer from 1 to `most`. Raises: ValueError."""
    if value != int(value) or not 1 <= value <= most:
        raise ValueError(
            f"{name} is {value}, expected an integer from 1 to {most}, the "
            "combinations of geometries"
        )
    return int(value)


def _check_pair(name: str, pair: ContactPair) -> tuple[np.ndarray, bool]:
    """The pair's reference direction (3,) and whether it is a plane's normal.

    Raises: ValueError for a parameter out of range.
    """
    if not (np.isfinite(pair.friction) and pair.friction >= 0.0):
        raise ValueError(f"{name}: friction is {pair.friction}, expected at least 0")
    if not pair.friction_directions >= 1:
        raise ValueError(
            f"{name}: friction_directions is {pair.friction_directions}, "
            "expected an integer of at least 1"
        )
    tangent = _direction(f"{name}: tangent", pair.tangent)
    plane_normal = _direction(f"{name}: plane_normal", pair.plane_normal)
    planar = bool(plane_normal.any())
    if planar and tangent.any():
        raise ValueError(f"{name}: tangent and plane_normal came, expected one of them")
    one_direction = pair.friction_directions == 1 and pair.friction > 0.0
    if one_direction and not (planar or tangent.any()):
        raise ValueError(
            f"{name}: friction_directions is 1 without a direction, expected "
            "a plane_normal (of a plant in a plane) or a tangent"
        )
    if not 0.0 < pair.anisotropy < np.inf or (
        pair.anisotropy != 1.0 and not pair.tangent
    ):
        raise ValueError(
            f"{name}: anisotropy is {pair.anisotropy}, expected a positive number, and "
            "1 without a tangent"
        )
    if pair.stiffness is not None and not 0.0 < pair.stiffness < np.inf:
        raise ValueError(
            f"{name}: stiffness is {pair.stiffness}, expected a positive "
            "number [N/m], or None for a rigid contact"
        )
    return (plane_normal if planar else tangent), planar


def _direction(name, value) -> np.ndarray:
    """The value as a unit vector (3,), or zeros if it is empty. Raises: ValueError."""
    direction = np.array(value or [0.0, 0.0, 0.0], dtype=float)
    if direction.shape != (3,) or not np.isfinite(direction).all():
        raise ValueError(f"{name} is {value}, expected (3,)")
    length = np.linalg.norm(direction)
    return direction / length if length > 0.0 else direction


class _NamedGeometries:
    """The collision geometries of a plant by the names of bodies and geometries."""

    def __init__(self, plant: MultibodyPlant, inspector):
        self.inspector = inspector
        self._of_body: dict[str, list[GeometryId]] = {}
        self._by_name: dict[str, GeometryId] = {}
        self._ambiguous = set()
        for i in range(plant.num_bodies()):
            body = plant.get_body(BodyIndex(i))
            geometries = plant.GetCollisionGeometriesForBody(body)
            self._of_body[body.scoped_name().get_full()] = geometries
            if body.name() in self._of_body:
                self._ambiguous.add(body.name())
            self._of_body[body.name()] = geometries
            for geometry in geometries:
                self._by_name[inspector.GetName(geometry)] = geometry

    def find(self, name: str) -> list[GeometryId]:
        """Those of a body, or the one of that name. Raises: ValueError."""
        if name in self._ambiguous:
            scoped = sorted(n for n in self._of_body if n.endswith(f"::{name}"))
            raise ValueError(f"body {name!r} is not unique, expected one of {scoped}")
        if name in self._of_body:
            if not self._of_body[name]:
                raise ValueError(f"body {name!r} has no collision geometry")
            return self._of_body[name]
        if name in self._by_name:
            return [self._by_name[name]]
        names = [*self._of_body, *self._by_name]
        near = get_close_matches(name, names, n=3, cutoff=0.3) or sorted(names)
        raise ValueError(f"no body or geometry is named {name!r}; nearest: {near}")

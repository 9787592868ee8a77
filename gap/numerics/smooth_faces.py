"""Faces of what is fixed that together stand for one curved surface.

A bowl or a bump is modelled by many plates, or triangles, each turned a little against
the next. What rolls over them would knock at every edge, as it does on no bowl. So
where neighbouring faces bend by little and keep near to a smooth surface, that surface
is touched instead. It is fitted about each point of contact: the algebraic sphere that
has the faces' normals at their middles, which weigh the less the farther off they are.
Middles and normals of a sphere give that sphere, those of a plane that plane, however
coarse the faces are.

A sphere of radius r touches where its centre is on the surface at r from it; middles
and normals at r tell that surface as well, and about the centre itself.

Source: Guennebaud, Gross, "Algebraic point set surfaces", SIGGRAPH 2007; the sphere
from normals: Guennebaud, Germann, Gross, "Dynamic sampling and rendering of algebraic
point set surfaces", Eurographics 2008, eq. 3.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

BEND = np.cos(np.radians(15.0))  # Neighbours whose normals differ by more make an edge.
OFF = 1e-3  # [m] A smooth surface keeps nearer than this to its faces, or is none.
APART = 0.1  # Of its half size: so far a face may be from its neighbour.
FEWEST = 6  # Faces of a surface that is curved; fewer are meant as they are.
WIDE = 1.5  # Times the distance of neighbours: so far a middle counts.
MESH = -2.0  # In the place of a half size: a mesh, of which middles are all there is.
TIGHT = 0.3  # Of its own radius a hollow has left once a sphere of that radius is in it
LONGEST = 8  # Middles along a face that is longer than wide.


@dataclass(frozen=True, eq=False)
class SmoothFaces:
    """Middles of faces of fixed shapes, and the surface that each face is of.

    of (S,): fixed shape; place, normal (S, 3), in its frame; surface (S,); spacing
    (S,): how far the neighbours are [m]; bend (S,): curvature, positive where it is a
    bump [1/m]. surfaces (m, 6): of the faces -x, x, -y, ... of each fixed box; -1: of
    none. angle [rad], off [m] (S,): the largest between neighbours, and by how much the
    smooth surface is off the faces at most. is_edge (S,): where a mesh's ends.
    """

    of: np.ndarray
    place: np.ndarray
    normal: np.ndarray
    surface: np.ndarray
    spacing: np.ndarray
    bend: np.ndarray
    surfaces: np.ndarray
    angle: np.ndarray
    off: np.ndarray
    is_edge: np.ndarray

    def placed(self, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Middles (S, 3) and normals (S, 3) in world, of fixed shapes (m, 15)."""
        R = fixed[self.of, :9].reshape(-1, 3, 3)
        x = fixed[self.of, 9:12] + np.einsum("nij,nj->ni", R, self.place)
        return x, np.einsum("nij,nj->ni", R, self.normal)

    def moved_out(self, by: float) -> "SmoothFaces":
        """With all surfaces moved along their normals [m]."""
        return replace(self, place=self.place + by * self.normal)

    def of_surface(self, numbers: Collection[int]) -> np.ndarray:
        """(S,) which middles are of these surfaces."""
        return np.isin(self.surface, list(numbers))


def none() -> SmoothFaces:
    """No face is of a smooth surface."""
    whole, real = np.zeros(0, np.int64), np.zeros(0)
    return SmoothFaces(
        whole, np.zeros((0, 3)), np.zeros((0, 3)), whole, real, real,
        np.full((0, 6), -1), real, real, np.zeros(0, bool),
    )  # fmt: skip


def together(each: Sequence[SmoothFaces], count: int) -> SmoothFaces:
    """All of them, of so many fixed shapes."""
    surfaces, number, numbers = np.full((count, 6), -1), 0, []
    for one in each:
        boxes = one.surfaces >= 0
        surfaces[: len(boxes)][boxes] = one.surfaces[boxes] + number
        numbers.append(one.surface + number)
        number += int(one.surface.max(initial=-1)) + 1
    return SmoothFaces(
        np.concatenate([one.of for one in each]),
        np.concatenate([one.place for one in each]),
        np.concatenate([one.normal for one in each]), np.concatenate(numbers),
        np.concatenate([one.spacing for one in each]),
        np.concatenate([one.bend for one in each]), surfaces,
        np.concatenate([one.angle for one in each]),
        np.concatenate([one.off for one in each]),
        np.concatenate([one.is_edge for one in each]),
    )  # fmt: skip


def smooth_faces(fixed: np.ndarray, body: Sequence) -> SmoothFaces:
    """Of fixed shapes (m, 15), as of FreeBody. body (m,): what each is of; only the
    boxes of one body make a surface."""
    boxes = np.flatnonzero(fixed[:, 12] >= 0.0) if len(fixed) else np.zeros(0, int)
    if len(boxes) < FEWEST:
        return none()
    of = np.repeat(boxes, 6)
    face = np.tile([(axis, side) for axis in range(3) for side in (-1, 1)],
                   (len(boxes), 1))  # fmt: skip
    _, of_body = np.unique(np.asarray(body), return_inverse=True)
    R = fixed[of, :9].reshape(-1, 3, 3)
    place, local = _on_faces(fixed, of, face, np.zeros((len(of), 2)))
    middle = fixed[of, 9:12] + np.einsum("nij,nj->ni", R, place)
    normal = np.einsum("nij,nj->ni", R, local)
    out = ~_is_covered(fixed, boxes, middle, of)
    of, face, middle, normal = of[out], face[out], middle[out], normal[out]
    sides = _Rectangles(fixed, of, face, middle, normal)
    i, j = sides.neighbours(of_body[of])
    if not len(i):
        return none()
    angle, far, bend = _between(middle, normal, i, j)
    number = _surfaces_of(len(of), i, j, angle)
    kept = number[i] >= 0
    i, j, angle, far, bend = i[kept], j[kept], angle[kept], far[kept], bend[kept]
    if not len(i):
        return none()
    surfaces = np.full((len(fixed), 6), -1)
    surfaces[of, 2 * face[:, 0] + (face[:, 1] > 0)] = number
    parts, across = sides.parts()
    place, local = _on_faces(fixed, of[parts], face[parts], across)
    R = fixed[of[parts], :9].reshape(-1, 3, 3)
    points = fixed[of[parts], 9:12] + np.einsum("nij,nj->ni", R, place)
    spacing = _most(len(of), i, _nearest_of(parts, points, i, j))
    spacing = np.maximum(spacing, sides.along())
    sharpest, most = _largest(len(of), i, bend), _most(len(of), i, angle)
    off = _most(len(of), i, _sag(far, angle))
    some = number[parts] >= 0
    parts, place, local = parts[some], place[some], local[some]
    return SmoothFaces(
        of[parts], place, local, number[parts], spacing[parts], sharpest[parts],
        surfaces, most[parts], off[parts], np.zeros(len(parts), bool),
    )  # fmt: skip


def smooth_mesh(vertices: np.ndarray, triangles: np.ndarray, shape: int) -> SmoothFaces:
    """The same of a mesh, whose vertices are on the surface: middles are vertices, with
    the normals of the triangles about them, weighed by their angles. shape: its number.

    Args: vertices (V, 3) in the shape's frame [m]; triangles (T, 3), of which normals
        point out.
    """
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    triangles, corners = triangles[size > 0.0], corners[size > 0.0]
    normal = normal[size > 0.0] / size[size > 0.0, None]
    i, j = _sharing_an_edge(triangles)
    middle = corners.mean(axis=1)
    angle, far, _ = _between(middle, normal, i, j)
    far *= 1.5  # A triangle is that much longer than its middle is off the edge.
    good = (np.cos(angle) >= BEND) & (_sag(far, angle) <= OFF)
    i, j, angle, far = i[good], j[good], angle[good], far[good]
    number = _surfaces_of(len(triangles), i, j, None)
    if not (number >= 0).any():
        return none()
    # A vertex on an edge between surfaces is one of each.
    on = np.flatnonzero(number >= 0)
    key = np.column_stack([np.repeat(number[on], 3), triangles[on].ravel()])
    own, index = np.unique(key, axis=0, return_inverse=True)
    index = np.ravel(index).reshape(-1, 3)
    mean = np.zeros((len(own), 3))
    for k in range(3):
        a = corners[on, (k + 1) % 3] - corners[on, k]
        b = corners[on, (k + 2) % 3] - corners[on, k]
        cosine = np.sum(a * b, axis=1) / np.linalg.norm(a, axis=1)
        weight = np.arccos(np.clip(cosine / np.linalg.norm(b, axis=1), -1.0, 1.0))
        np.add.at(mean, index[:, k], weight[:, None] * normal[on])
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    x, count = vertices[own[:, 1]], len(own)
    a = index.ravel()
    b = np.roll(index, -1, axis=1).ravel()
    a, b = np.concatenate([a, b]), np.concatenate([b, a])
    _, long, bend = _between(x, mean, a, b)
    of_vertex = {int(t): row for t, row in zip(on, index, strict=True)}
    most, off = np.zeros(count), np.zeros(count)
    per = _most(len(triangles), i, angle), _most(len(triangles), i, _sag(far, angle))
    for t, row in of_vertex.items():
        most[row] = np.maximum(most[row], per[0][t])
        off[row] = np.maximum(off[row], per[1][t])
    return SmoothFaces(
        np.full(count, shape), x, mean, own[:, 0], _most(count, a, long),
        _largest(count, a, bend), np.full((0, 6), -1), most, off,
        np.isin(own[:, 1], _where_it_ends(triangles, number)),
    )  # fmt: skip


def _where_it_ends(triangles: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Vertices of edges with another surface, or none, beyond them. number (T,): the
    surface of each triangle."""
    pairs = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    key = np.column_stack([np.sort(pairs), np.repeat(number, 3)])
    edges, count = np.unique(key, axis=0, return_counts=True)
    return np.unique(edges[count == 1, :2])


def _sharing_an_edge(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of triangles (n,), (n,), both ways round."""
    edges = np.sort(
        np.concatenate(
            [triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]
        )
    )
    of = np.tile(np.arange(len(triangles)), 3)
    order = np.lexsort(edges.T)
    edges, of = edges[order], of[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    a, b = of[:-1][same], of[1:][same]
    return np.concatenate([a, b]), np.concatenate([b, a])


def _between(x, normal, i, j) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles of normals (n,), distances and curvatures between places i and j."""
    apart = x[j] - x[i]
    far = np.maximum(np.linalg.norm(apart, axis=1), 1e-12)
    angle = np.arccos(np.clip(np.sum(normal[i] * normal[j], axis=1), -1.0, 1.0))
    return angle, far, np.sum((normal[j] - normal[i]) * apart, axis=1) / far**2


def _most(count: int, i, values) -> np.ndarray:
    """(count,) the largest of the values at each index i, 0 where there is none."""
    out = np.zeros(count)
    np.maximum.at(out, i, values)
    return out


def _largest(count: int, i, values) -> np.ndarray:
    """The same of their sizes, with its sign."""
    out, order = np.zeros(count), np.argsort(np.abs(values), kind="stable")
    out[i[order]] = values[order]
    return out


def _sag(far: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[m] by which an arc is off its chords, or tangents, of these lengths [m] that
    turn by these angles [rad] each."""
    return far * angle / 8.0


def _surfaces_of(count: int, i, j, angle) -> np.ndarray:
    """(count,) number of the surface of each face, of neighbours i and j; -1: of none
    that has enough faces, or is curved (angle None: of a mesh flat ones count, too)."""
    graph = coo_matrix((np.ones(len(i)), (i, j)), (count, count))
    _, number = connected_components(graph, directed=False)
    good = np.bincount(number, minlength=1) >= FEWEST
    if angle is not None:
        good &= _most(len(good), number[i], angle) > 1e-4
    order = np.where(good, np.cumsum(good) - 1, -1)
    return order[number]


def _on_faces(fixed, of, face, across) -> tuple[np.ndarray, np.ndarray]:
    """Places and normals (n, 3) on faces of boxes, in their frames. face (n, 2): axis
    and side (-1, 1); across (n, 2): along the next two axes, over the half sizes."""
    row, (axis, side) = np.arange(len(of)), face.T
    place, normal = np.zeros((2, len(of), 3))
    normal[row, axis] = side
    place[row, axis] = side * fixed[of, 12 + axis]
    for k in range(2):
        next_one = (axis + 1 + k) % 3
        place[row, next_one] = across[:, k] * fixed[of, 12 + next_one]
    return place, normal


def _nearest_of(parts, points, i, j) -> np.ndarray:
    """(n,) the least distance of a middle of face i to one of face j. parts (S,): face
    of each of points (S, 3)."""
    first = np.searchsorted(parts, np.arange(parts.max() + 2))
    if len(parts) == len(first) - 1:  # One each.
        return np.linalg.norm(points[i] - points[j], axis=1)
    own = [points[a:b] for a, b in zip(first, first[1:], strict=False)]
    return np.array([
        np.linalg.norm(own[a][:, None] - own[b], axis=2).min()
        for a, b in zip(i, j, strict=True)
    ])  # fmt: skip


def _is_covered(fixed, boxes, middle, of) -> np.ndarray:
    """(n,) whether the middle (n, 3) of a face of box `of` is deeper than OFF in
    another box: where plates lap over one another it is less."""
    out = np.zeros(len(middle), bool)
    reach = np.linalg.norm(fixed[boxes, 12:], axis=1)
    near = cKDTree(middle).query_ball_point(fixed[boxes, 9:12], reach)
    for m, some in zip(boxes, near, strict=True):
        k = np.array([each for each in some if of[each] != m], int)
        local = (middle[k] - fixed[m, 9:12]) @ fixed[m, :9].reshape(3, 3)
        out[k] |= (np.abs(local) <= fixed[m, 12:] - OFF).all(axis=1)
    return out


class _Rectangles:
    """Faces of boxes: middle, normal (n, 3), two axes across (n, 3) and half sizes."""

    def __init__(self, fixed, of, face, middle, normal):
        self.of, self.middle, self.normal = of, middle, normal
        R = fixed[of, :9].reshape(-1, 3, 3)
        row = np.arange(len(of))
        next_two = [(face[:, 0] + k) % 3 for k in (1, 2)]
        self.axes = np.stack([R[row, :, k] for k in next_two], axis=1)
        self.half = np.stack([fixed[of, 12 + k] for k in next_two], axis=1)

    def neighbours(self, body) -> tuple[np.ndarray, np.ndarray]:
        """Pairs i, j, both ways round, that bend little where they meet and keep near
        to a smooth surface through their middles. body (n,): of each."""
        reach = np.linalg.norm(self.half, axis=1)
        near = cKDTree(self.middle).query_ball_point(self.middle, 2.2 * reach)
        i = np.repeat(np.arange(len(near)), [len(each) for each in near])
        j = np.concatenate([np.asarray(each, int) for each in near])
        i, j = np.concatenate([i, j]), np.concatenate([j, i])
        i, j = np.unique(np.column_stack([i, j]), axis=0).T
        alike = np.sum(self.normal[i] * self.normal[j], axis=1)
        good = (self.of[i] != self.of[j]) & (body[i] == body[j]) & (alike >= BEND)
        i, j, alike = i[good], j[good], alike[good]
        # Midway between where each comes nearest to the other's middle.
        between = 0.5 * (self._onto(i, self.middle[j]) + self._onto(j, self.middle[i]))
        gap = np.linalg.norm(self._onto(i, between) - self._onto(j, between), axis=1)
        far = np.linalg.norm(self.middle[j] - self.middle[i], axis=1)
        sag = _sag(far, np.arccos(np.clip(alike, -1.0, 1.0)))
        step = np.abs(
            np.sum(self.normal[i] * (between - self.middle[i]), axis=1)
            - np.sum(self.normal[j] * (between - self.middle[j]), axis=1)
        )
        least = np.minimum(self.half[i].min(axis=1), self.half[j].min(axis=1))
        good = (gap <= APART * least) & (sag <= OFF) & (step <= sag + 1e-6)
        good &= far > 1e-9  # No two in one place.
        return i[good], j[good]

    def _onto(self, k, x) -> np.ndarray:
        """(n, 3) of faces k what is nearest to x (n, 3)."""
        local = np.einsum("nij,nj->ni", self.axes[k], x - self.middle[k])
        local = np.clip(local, -self.half[k], self.half[k])
        return self.middle[k] + np.einsum("ni,nij->nj", local, self.axes[k])

    def _counts(self) -> np.ndarray:
        """(n, 2) middles along each axis."""
        ratio = self.half / np.maximum(self.half.min(axis=1, keepdims=True), 1e-9)
        return np.clip(np.round(ratio), 1, LONGEST).astype(int)

    def parts(self) -> tuple[np.ndarray, np.ndarray]:
        """Face of each middle (S,), and its place over the half sizes (S, 2)."""
        parts, across = [], []
        for k, (a, b) in enumerate(self._counts()):
            u = (2.0 * np.arange(a) + 1.0 - a) / a
            v = (2.0 * np.arange(b) + 1.0 - b) / b
            across.append(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
            parts.append(np.full(a * b, k))
        return np.concatenate(parts), np.concatenate(across)

    def along(self) -> np.ndarray:
        """(n,) how far middles of one face are from each other [m]."""
        counts = self._counts()
        return np.where(counts > 1, 2.0 * self.half / counts, 0.0).max(axis=1)


# ----- At one point


@njit(cache=True)
def width(spacing, bend, radius):
    """How far a middle counts at a distance `radius` from the surface [m]."""
    return WIDE * spacing * max(1.0 + radius * bend, TIGHT)


@njit(cache=True)
def fit(c0, c1, c2, radius, middles, of, some, found):
    """Writes u, l (3) and a of a smooth surface about the centre of a sphere that may
    touch it: u + l p + a p^2 = 0 at a place p from there. Returns: whether it is one:
    not where nothing is near, or the sphere hardly fits in.

    Args: middles (S, 8): place, normal, spacing and bend, of (S, 2): surface, and fixed
        shape, as of SmoothFaces. some: how many may count, and which. found (7,):
        number of the surface, and whatever; then what is written.
    """
    W = pp = pn = 0.0
    P0 = P1 = P2 = N0 = N1 = N2 = 0.0
    for k in range(some[0]):
        i = some[1 + k]
        if of[i, 0] != found[0]:
            continue
        n0, n1, n2 = middles[i, 3], middles[i, 4], middles[i, 5]
        p0 = middles[i, 0] + radius * n0 - c0
        p1 = middles[i, 1] + radius * n1 - c1
        p2 = middles[i, 2] + radius * n2 - c2
        square = p0 * p0 + p1 * p1 + p2 * p2
        h = width(middles[i, 6], middles[i, 7], radius)
        w = 1.0 - square / (h * h)
        if w <= 0.0:
            continue
        w = w * w * w
        W += w
        P0, P1, P2 = P0 + w * p0, P1 + w * p1, P2 + w * p2
        N0, N1, N2 = N0 + w * n0, N1 + w * n1, N2 + w * n2
        pp += w * square
        pn += w * (p0 * n0 + p1 * n1 + p2 * n2)
    if W <= 0.0:
        return False
    spread = pp - (P0 * P0 + P1 * P1 + P2 * P2) / W
    a = 0.0
    if spread > 1e-9 * pp:
        a = 0.5 * (pn - (P0 * N0 + P1 * N1 + P2 * N2) / W) / spread
    found[3] = (N0 - 2.0 * a * P0) / W
    found[4] = (N1 - 2.0 * a * P1) / W
    found[5] = (N2 - 2.0 * a * P2) / W
    found[2] = -(found[3] * P0 + found[4] * P1 + found[5] * P2 + a * pp) / W
    found[6] = a
    square = found[3] ** 2 + found[4] ** 2 + found[5] ** 2
    if square < 1e-12:  # Normals that point any way.
        return False
    # Of a hollow, what is left of its radius.
    left = (
        -0.5 * np.sqrt(max(square - 4.0 * found[2] * a, 0.0)) / a if a < 0 else np.inf
    )
    return left * (1.0 - TIGHT) >= TIGHT * radius


@njit(cache=True)
def distance(p0, p1, p2, found):
    """Signed distance of a place from a surface of fit(), and its normal (3) there."""
    a = found[6]
    l0, l1, l2 = found[3] + 2 * a * p0, found[4] + 2 * a * p1, found[5] + 2 * a * p2
    u = found[2] + found[3] * p0 + found[4] * p1 + found[5] * p2
    u += a * (p0 * p0 + p1 * p1 + p2 * p2)
    g = np.sqrt(l0 * l0 + l1 * l1 + l2 * l2)
    root = np.sqrt(max(g * g - 4.0 * u * a, 0.0))
    return 2.0 * u / (g + root), l0 / g, l1 / g, l2 / g

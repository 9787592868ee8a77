"""What a scene's one free body feels, as numbers for the fast stepping of it."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    Sphere,
)
from pydrake.math import RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.free_body import EDGE, FACE, FreeBody
from makebreak.gap.simulation.face_supports import (
    INNER,
    POINT,
    RIM,
    centres_of,
    within_faces,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact import DAMPER
from makebreak.models.effects.contact_surface import DEFAULT_DISSIPATION
from makebreak.models.effects.ground import PLACE
from makebreak.models.effects.kind import Effect, check_parameters, full_name
from makebreak.models.effects.rolling_resistance import FADE_RATE
from makebreak.models.scene import LoadedScene, Scene, load_scene

# What a sphere is: the body's own, or stands in for a corner, a face or a round edge;
# or it is an end of a rod (a capsule), of which no other point is the first to meet a
# face.
SPHERE, CORNER, WITHIN, ROUND, ROD = range(5)
# [m] As far a box may be above what it stands on; it goes on below a half-space.
STANDS, BELOW = 1e-3, 1.0
REST_DEPTH = 2e-5  # [m] Of a body on a face that is not stiffer than it need be.
AT_CORNERS = 0.4  # Of a face's load; it is 0.16 (a disc's rim: 0.33) if pressed evenly.
# Forces that have their own numbers here; what changes shapes, inertias and surfaces is
# read off the plant.
FORCES = (*(k for k, e in KINDS.items() if e.body_law), "rolling_resistance", DAMPER)
SURFACES = ("contact_friction", "contact_stiffness", "contact_dissipation")
SENSORS = ("length_scale", "sensor_delay", "sensor_bias", "clock_skew")
_PLANT = ("object_size", "corner_radius", "object_mass", "object_com", "object_inertia",
          "contact_friction", "contact_stiffness", "contact_dissipation",
          "friction_patch", "plane_height", "plane_tilt", PLACE,
          "gravity_tilt")  # fmt: skip


def load_free_bodies(
    scene: Scene, loaded: LoadedScene | None = None
) -> tuple[LoadedScene, list[RigidBody]]:
    """The scene, if it is not loaded yet, and its free bodies.

    Raises: DoesNotFit where anything else moves, or contact is not that of points.
    """
    for effect in scene.effects:
        if effect.kind not in (*FORCES, "length_scale", *_PLANT):
            raise DoesNotFit(f"effect {effect.kind} is not one of a free body")
    if scene.friction_zones:
        raise DoesNotFit("friction zones are Drake's alone")
    loaded = loaded or load_scene(scene, DiagramBuilder())
    plant = loaded.plant
    bodies = [plant.get_body(i) for i in sorted(plant.GetFloatingBaseBodies())]
    if not bodies or plant.num_velocities() != 6 * len(bodies):
        raise DoesNotFit("expected free bodies and nothing else that moves")
    if scene.plant.contact_model != "point":
        raise DoesNotFit("hydroelastic contact is Drake's alone")
    return loaded, bodies


def in_order(effects: Sequence[Effect]) -> list[Effect]:
    """Those that change a body, as they are applied.

    Raises: ValueError for parameters that no effect of the kind can have.
    """
    for effect in effects:
        check_parameters(effect, KINDS[effect.kind])
    ranked = sorted(effects, key=lambda e: KINDS[e.kind].rank)
    return [effect for effect in ranked if effect.kind in CHANGES]


class FreeBodyScene:
    """A scene's one free body, read off its plant once; effects change its numbers
    without another plant, which would take longer than all windows' steps.

    A box, a cylinder or a hull of the body touches with spheres at its corners and
    within its faces (face_supports.py), as an area would and Drake's point does not; a
    capsule with its two ends.

    Args: on_side: whether a cylinder of it lies on its side. of: the loaded scene, and
        which of its free bodies, if there are several.
    Raises: DoesNotFit where the scene has anything else that moves, shapes that have no
        such spheres, anything fixed but boxes and half-spaces, or effects of other
        kinds.
    """

    def __init__(
        self,
        scene: Scene,
        on_side: bool = False,
        of: tuple[LoadedScene, RigidBody] | None = None,
    ):
        self.scene, self._on_side = scene, on_side
        self._eased = np.ones(1)  # Of each fixed shape.
        if of is None:
            loaded, bodies = load_free_bodies(scene)
            if len(bodies) != 1:
                raise DoesNotFit("expected one free body and nothing else that moves")
            of = loaded, bodies[0]
        self.name = full_name(of[0].plant, of[1])
        self._read(*of)

    @property
    def grounds(self) -> list[str]:
        """The bodies that the fixed shapes are of."""
        return list(self._grounds)

    @property
    def has_faces(self) -> bool:
        """Whether spheres stand in for its shapes."""
        return bool((self._numbers.role != SPHERE).any())

    def ease(self, on: np.ndarray | None = None) -> None:
        """Makes faces no stiffer than what lies on them needs to be carried. Of what
        never hits anything, a stiffness shows nowhere but in how short steps are.

        Args: on (m,): on which of the fixed shapes; none: on all.
        """
        faces = np.isin(self._numbers.role, (CORNER, WITHIN))
        stiffness = self.body().pairs[faces, :, 0].sum(axis=0)
        weight = float(self._numbers.mass) * float(np.linalg.norm(self._gravity))
        carries = np.maximum(0.5 * stiffness, 1e-9)
        eased = np.minimum(1.0, weight / REST_DEPTH / carries)
        self._eased = eased if on is None else np.where(on, eased, 1.0)

    def body(
        self, effects: Sequence[Effect] = (), at_corners: float = AT_CORNERS
    ) -> FreeBody:
        """Its numbers with these effects added to the scene's own.

        Args: at_corners: share of a face's load that its corners carry.
        Raises: ValueError for effects that no body can have.
        """
        if not all(e.kind in CHANGES or e.kind in SENSORS for e in effects):
            more = replace(self.scene, effects=[*self.scene.effects, *effects])
            other = FreeBodyScene(more, self._on_side)
            other._eased = self._eased
            return other.body((), at_corners)
        now = self.numbers()
        for effect in in_order(effects):
            places = self.places(effect)
            on = self.grounds_in(places)
            if self.name in places or on.any():
                CHANGES[effect.kind](now, effect.parameters, on)
        return self.body_of(now, at_corners)

    def numbers(self) -> "Numbers":
        """A copy of the scene's own."""
        return Numbers(**{k: np.array(v) for k, v in vars(self._numbers).items()})

    def places(self, effect: Effect) -> list[str]:
        """Full names of the bodies that it is at."""
        at = [place.strip() for each in effect.at for place in each.split("~")]
        return [self._whole_name.get(place, place) for place in at]

    def grounds_in(self, places: Sequence[str]) -> np.ndarray:
        """(m,) which of the fixed shapes are of these bodies."""
        return np.array([ground in places for ground in self._grounds], bool)

    def body_of(self, now: "Numbers", at_corners: float = AT_CORNERS) -> FreeBody:
        pairs = _pairs(now, self._drake) * self._touch[:, :, None]
        pairs[..., [0, 5]] *= shares(now, at_corners)[:, None, None]
        pairs[now.role != SPHERE, :, 0] *= self._eased
        return FreeBody(
            float(now.mass), now.com, now.inertia, self._gravity, now.spheres,
            now.fixed, pairs,
            now.rolling[None, :] * now.spheres[:, 3:], now.forces, now.drag,
            fade=FADE_RATE, patches=now.patches, rims=now.rims,
        )  # fmt: skip

    def _read(self, loaded: LoadedScene, body: RigidBody) -> None:
        plant, inspector = loaded.plant, loaded.scene_graph.model_inspector()
        mine = plant.GetCollisionGeometriesForBody(body)
        if not mine:
            raise DoesNotFit(f"{self.name} has nothing to touch with")
        self.axes: list[np.ndarray] = []  # Of its cylinders, in the body's frame.
        spheres, rims, role, of = [], [], list[int](), list[int]()
        inner = 0.0
        for i, g in enumerate(mine):
            shape, X = inspector.GetShape(g), inspector.GetPoseInFrame(g)
            if isinstance(shape, Sphere):
                each = [(SPHERE, [0.0, 0.0, 0.0, shape.radius()])]
            elif isinstance(shape, Capsule):
                ends = (-0.5 * shape.length(), 0.5 * shape.length())
                each = [(ROD, [0.0, 0.0, z, shape.radius()]) for z in ends]
            else:
                corners = centres_of(shape, self._on_side, POINT)
                if corners is None:
                    raise DoesNotFit(f"a {type(shape).__name__} of a free body")
                each = [(CORNER, [*p, corners[1]]) for p in corners[0]]
                if not (self._on_side and isinstance(shape, Cylinder)):
                    each += [(WITHIN, list(s)) for s in within_faces(shape, POINT)]
                    inner = RIM / INNER if isinstance(shape, Cylinder) else 1.0
            axis, rim, stands = X.rotation().col(2), 0.0, False
            if isinstance(shape, Cylinder):
                self.axes.append(axis)
                stands, rim = not self._on_side, shape.radius() - POINT
                h = 0.5 * shape.length() - POINT
            if stands:
                # Its rims are round: the spheres along them carry its faces alone.
                each += [(ROUND, [0.0, 0.0, z, POINT]) for z in (-h, h)]
            for what, (*p, radius) in each:
                spheres.append([*(X @ np.array(p)), radius])
                edge = what == ROUND
                kind = (EDGE if edge else FACE) if stands else 0.0
                rims.append([*axis, rim if edge else 0.0, kind])
                role.append(what)
                of.append(i)
        context = plant.CreateDefaultContext()
        fixed: list[list[float]] = []
        others, origins = [], []
        self._grounds: list[str] = []
        self._whole_name = {self.name.split(".")[0]: self.name}
        for i in range(plant.num_bodies()):
            ground = plant.get_body(BodyIndex(i))
            if not plant.IsAnchored(ground):
                continue
            X_WB = plant.EvalBodyPoseInWorld(context, ground)
            for g in plant.GetCollisionGeometriesForBody(ground):
                shape = inspector.GetShape(g)
                X = X_WB @ inspector.GetPoseInFrame(g)
                if isinstance(shape, Box):
                    half = shape.size() / 2.0
                elif isinstance(shape, HalfSpace):
                    half = np.array([-1.0, 0.0, 0.0])
                else:
                    raise DoesNotFit(f"a {type(shape).__name__} that is fixed")
                fixed.append([*X.rotation().matrix().ravel(), *X.translation(), *half])
                others.append(g)
                origins.append(X_WB.translation())
                name = full_name(plant, ground)
                self._grounds.append(name)
                self._whole_name[name.split(".")[0]] = name
        M = body.default_spatial_inertia()
        mass, com = M.get_mass(), np.array(M.get_com())
        about = M.CalcRotationalInertia().CopyToFullMatrix3()
        central = about - mass * (com @ com * np.eye(3) - np.outer(com, com))
        self._gravity = np.array(plant.gravity_field().gravity_vector())
        self._drake = drakes(plant)
        own = np.array([_surface(inspector, g) for g in mine])
        other = np.array([_surface(inspector, g) for g in others]).reshape(-1, 4)
        self._touch = np.array(
            [[not inspector.CollisionFiltered(a, b) for b in others] for a in mine],
            float,
        ).reshape(len(mine), len(others))[of]
        self._numbers = Numbers(
            np.array(mass), com, central, np.array(spheres),
            gone_on(np.array(fixed).reshape(-1, 15)),
            np.array(origins).reshape(-1, 3),
            own[of], other,
            np.zeros(len(others)), np.zeros((0, 6)), np.zeros(3), np.zeros((0, 6)),
            np.full(len(others), np.nan), np.array(role), np.array(inner),
            np.array(rims),
        )  # fmt: skip
        for effect in loaded.effects:
            if effect.kind in FORCES:
                at = [p.strip() for each in effect.at for p in each.split("~")]
                at = [self._whole_name.get(place, place) for place in at]
                on = np.array([ground in at for ground in self._grounds], bool)
                if self.name in at:
                    CHANGES[effect.kind](self._numbers, effect.parameters, on)


@dataclass(eq=False)
class Numbers:
    """What effects change. own (n, 4), other (m, 4): stiffness (inf: Drake's guess),
    dissipation, static and dynamic friction of each surface; rolling (m,); damper (m,):
    in the place of the dissipation, NaN where there is none; role (n,) of each sphere;
    inner: corners of a face for each sphere within it; rims (n, 5) as of FreeBody."""

    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    spheres: np.ndarray
    fixed: np.ndarray
    origins: np.ndarray
    own: np.ndarray
    other: np.ndarray
    rolling: np.ndarray
    forces: np.ndarray
    drag: np.ndarray
    patches: np.ndarray
    damper: np.ndarray
    role: np.ndarray
    inner: np.ndarray
    rims: np.ndarray


def shares(now: Numbers, at_corners: float) -> np.ndarray:
    """(n,) of the pair's spring and damper that each sphere has: a corner all of it,
    what stands within a face so much that its corners carry their share."""
    within = now.inner * (1.0 / at_corners - 1.0)
    return np.where(now.role == WITHIN, within, 1.0)


def gone_on(fixed: np.ndarray) -> np.ndarray:
    """Fixed shapes (m, 15) as of FreeBody, in which a box that stands on another shape
    with a whole face goes on into it, to its far end.

    What runs against such a box meets its foot, where the face that it stands on would
    be the nearest to a corner that is a little deep, and would push it down.
    """
    out = np.array(fixed)
    for i, box in enumerate(fixed):
        if box[12] < 0.0:  # A half-space.
            continue
        for axis, side in itertools.product(range(3), (-1.0, 1.0)):
            deep = _on_the_way_out(fixed, i, axis, side)
            out[i, 9:12] += 0.5 * deep * side * box[:9].reshape(3, 3)[:, axis]
            out[i, 12 + axis] += 0.5 * deep
    return out


@njit(cache=True)
def _on_the_way_out(fixed, i, axis, side):
    """How far all corners of a face of box i can go along its normal within another
    fixed shape, at most; 0 if one of them is more than STANDS above it."""
    box, most = fixed[i], 0.0
    u, v = (axis + 1) % 3, (axis + 2) % 3
    for m in range(len(fixed)):
        if m == i:
            continue
        shape, left, inside = fixed[m], np.inf, True
        for corner in range(4):
            s = 1.0 if corner % 2 else -1.0
            t = 1.0 if corner // 2 else -1.0
            for k in range(3):  # In the axes of the shape.
                a = d = 0.0
                for x in range(3):
                    way = side * box[3 * x + axis]
                    at = (
                        box[9 + x] + way * (box[12 + axis] + STANDS)
                        + s * box[12 + u] * box[3 * x + u]
                        + t * box[12 + v] * box[3 * x + v]
                    )  # fmt: skip
                    a += shape[3 * x + k] * (at - shape[9 + x])
                    d += shape[3 * x + k] * way
                if shape[12] < 0.0:
                    if k == 2 and (a > 0.0 or d >= -1e-9):
                        inside = False
                elif abs(a) > shape[12 + k] + 1e-9:
                    inside = False
                elif abs(d) > 1e-9:
                    left = min(left, (shape[12 + k] - np.sign(d) * a) / abs(d))
            if not inside:
                break
        if inside:
            most = max(most, BELOW if shape[12] < 0.0 else STANDS + left)
    return most


def _surface(inspector, geometry) -> list[float]:
    properties = inspector.GetProximityProperties(geometry)
    k = properties.GetPropertyOrDefault("material", "point_contact_stiffness", np.inf)
    d = properties.GetPropertyOrDefault(
        "material", "hunt_crossley_dissipation", DEFAULT_DISSIPATION
    )
    mu = properties.GetProperty("material", "coulomb_friction")
    return [k, d, mu.static_friction(), mu.dynamic_friction()]


@dataclass(frozen=True)
class Drakes:
    """What Drake adds to two surfaces. stiffness: of one that has none [N/m]: at twice
    it in each of two, the heaviest body would rest a millimetre deep. is_middle:
    whether the contact point is midway between them, as a continuous plant has it;
    else it lies as springs in series would."""

    stiffness: float
    is_middle: bool


def drakes(plant: MultibodyPlant) -> Drakes:
    heaviest = max(
        plant.get_body(BodyIndex(i)).default_mass()
        for i in range(1, plant.num_bodies())
    )
    g = float(np.linalg.norm(plant.gravity_field().gravity_vector()))
    return Drakes(2.0 * heaviest * g / 1e-3, plant.time_step() == 0.0)


def _pairs(now: Numbers, drake: Drakes) -> np.ndarray:
    """(n, m, 6) of spheres and what is fixed."""
    return combined(now.own[:, None], now.other[None, :], now.damper, drake)


def combined(own, other, damper, drake: Drakes) -> np.ndarray:
    """(..., 6) numbers of a contact, as Drake combines two surfaces (..., 4).

    Args: damper: that stands in for the dissipation, NaN where there is none.
    """
    k1 = np.where(np.isfinite(own[..., 0]), own[..., 0], drake.stiffness)
    k2 = np.where(np.isfinite(other[..., 0]), other[..., 0], drake.stiffness)
    mu = [
        2.0 * own[..., i] * other[..., i]
        / np.maximum(own[..., i] + other[..., i], 1e-300)
        for i in (2, 3)
    ]  # fmt: skip
    d = (k2 * own[..., 1] + k1 * other[..., 1]) / (k1 + k2)
    d = np.where(np.isfinite(damper), 0.0, d)
    damper = np.broadcast_to(np.nan_to_num(damper), d.shape)
    share = np.full(d.shape, 0.5) if drake.is_middle else k1 / (k1 + k2)
    return np.stack([k1 * k2 / (k1 + k2), d, *mu, share, damper], axis=-1)


# ----- Effects: the same as in models/effects, on these numbers.


def _size(now: Numbers, p, on) -> None:
    scale = p["scale"] if "scale" in p else p["radius"] / now.spheres[0, 3]
    now.spheres *= scale
    now.rims[:, 3] *= scale
    now.com *= scale
    now.inertia *= scale**2


def _corners(now: Numbers, p, on) -> None:
    if (now.role == CORNER).sum() == 8:  # A box becomes spheres, which have no faces.
        now.spheres[now.role == WITHIN] = now.spheres[now.role == CORNER][0]
        now.inner[...] = 0.0
        corners = now.role == CORNER
    else:
        corners = now.role == SPHERE
    of = now.spheres[corners]
    middle = of[:, :3].mean(axis=0)
    half = abs(of[:, :3] - middle).mean(axis=0) + of[0, 3]
    if len(of) != 8 or not 0.0 < p["radius"] <= half.min():
        raise ValueError(f"corner_radius: radius is {p['radius']}, half size {half}")
    sign = np.sign(of[:, :3] - middle)
    now.spheres[corners, :3] = middle + sign * (half - p["radius"])
    now.spheres[corners, 3] = p["radius"]


def _mass(now: Numbers, p, on) -> None:
    now.inertia *= p["mass"] / now.mass
    now.mass[...] = p["mass"]


def _com(now: Numbers, p, on) -> None:
    for i, a in enumerate("xyz"):
        now.com[i] = p.get(a, now.com[i])


def _moments(now: Numbers, p, on) -> None:
    for i, a in enumerate(("ixx", "iyy", "izz")):
        now.inertia[i, i] = p.get(a, now.inertia[i, i])
    w = np.linalg.eigvalsh(now.inertia)
    if not (w[0] > 0.0 and w[0] + w[1] >= w[2]):
        raise ValueError(f"object_inertia: no body has {p}")


def _friction(now: Numbers, p, on) -> None:
    mu, own = p["friction"], now.own[0, 3]
    if 2.0 * own > mu or mu == 0.0:
        now.other[on, 2:] = mu * own / (2.0 * own - mu) if mu > 0.0 else 0.0
    else:
        now.own[:, 2:] = now.other[on, 2:] = mu


def _stiffness(now: Numbers, p, on) -> None:
    k, k1, k2 = p["stiffness"], now.other[on, 0][0], now.own[0, 0]
    if np.isfinite([k1, k2]).all():
        scale = k * (k1 + k2) / (k1 * k2)
        now.own[:, 0] *= scale
        now.other[on, 0] *= scale
    else:
        now.own[:, 0] = now.other[on, 0] = 2.0 * k


def _dissipation(now: Numbers, p, on) -> None:
    d, (k2, d2) = p["dissipation"], now.own[0, :2]
    k1 = now.other[on, 0][0]
    d1 = -1.0
    if np.isfinite([k1, k2]).all():
        d1 = (d * (k1 + k2) - k1 * d2) / k2
    if d1 < 0.0:
        d1 = now.own[:, 1] = d
    now.other[on, 1] = d1


def _damper(now: Numbers, p, on) -> None:
    now.damper[on] = p["damping"]


def _height(now: Numbers, p, on) -> None:
    now.fixed[on, 11] += p["height"]


def _displace(now: Numbers, p, on) -> None:
    now.fixed[on, 9:12] += [p.get(axis, 0.0) for axis in "xyz"]


def _tilt(now: Numbers, p, on) -> None:
    R = RollPitchYaw(p["roll"], p["pitch"], 0.0).ToRotationMatrix().matrix()
    for m in np.flatnonzero(on):
        now.fixed[m, :9] = (R @ now.fixed[m, :9].reshape(3, 3)).ravel()
        now.fixed[m, 9:12] = now.origins[m] + R @ (now.fixed[m, 9:12] - now.origins[m])


def _rolling(now: Numbers, p, on) -> None:
    now.rolling[on] += p["coefficient"]


def _force(now: Numbers, p, on) -> None:
    wave = [p.get("frequency", 0.0), p.get("phase", 0.0), 0.0]
    now.forces = np.vstack([now.forces, [p["fx"], p["fy"], p["fz"], *wave]])


def _drag(now: Numbers, p, on) -> None:
    now.drag += [p.get(name, 0.0) for name in ("linear", "angular", "coefficient")]


def _patch(now: Numbers, p, on) -> None:
    if not (p["x_min"] < p["x_max"] and p["y_min"] < p["y_max"]):
        raise ValueError(f"friction_patch: the patch is empty: {p}")
    sides = [p[k] for k in ("x_min", "x_max", "y_min", "y_max")]
    more = [[m, p["friction"], *sides] for m in np.flatnonzero(on)]
    now.patches = np.vstack([now.patches, *more])


CHANGES = {
    "friction_patch": _patch,
    "object_size": _size, "corner_radius": _corners, "object_mass": _mass,
    "object_com": _com, "object_inertia": _moments, "contact_friction": _friction,
    "contact_stiffness": _stiffness, "contact_dissipation": _dissipation,
    "plane_height": _height, "plane_tilt": _tilt, "rolling_resistance": _rolling,
    "constant_force": _force, "sinusoidal_force": _force, "body_drag": _drag,
    "body_quadratic_drag": _drag, DAMPER: _damper, PLACE: _displace,
}  # fmt: skip

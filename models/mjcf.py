"""MJCF as MuJoCo means it: compiled, and written again in plain words for Drake.

Drake's parser knows a part of MJCF: neither nested default classes nor most actuators,
and no reference positions. So MuJoCo compiles the file, and Drake gets one that has
only what it reads exactly: bodies, explicit inertias, joints, shapes.
"""

import warnings
from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from makebreak.models.activation import Activation
from makebreak.models.effects.kind import Effect
from makebreak.models.meshes import write_obj

ENDLESS = 100.0  # [m] Of a box that stands for a plane.


@dataclass(frozen=True)
class FileDrive:
    """A joint's actuators in a file, at the joint: kp [N m/rad], kd [N m s/rad], both 0
    of a motor; limit [N m]; gear: joint effort over what the command of a motor says,
    or of a servo the command over the joint's position; activation: of that command,
    where it is not what the drive follows. gear 0: what the actuators make of their
    commands is not known."""

    kp: float = 0.0
    kd: float = 0.0
    limit: float = np.inf
    gear: float = 1.0
    activation: Activation | None = None


@dataclass(frozen=True, eq=False)
class PlainMjcf:
    """text: MJCF for Drake. effects: of joints, by their names in the file, that Drake
    keeps no place for. drives, home: {joint: ...}, home of the first keyframe (or the
    joint's reference). passive: joints that nothing drives, where actuators drive
    others alone. notes: what is left out, and what that means. left_out: number
    of collision meshes that are not there. order: (joint, or body that floats, its
    number of positions) as qpos has them; actuators: (joint or "", gear) as ctrl has
    them; has_ground: whether anything is fixed that can be touched. frictions: (body,
    other one, coefficient) of pairs for which Drake makes another one of the two
    shapes' (MuJoCo takes the larger)."""

    text: str
    effects: tuple[Effect, ...] = ()
    drives: dict[str, FileDrive] = field(default_factory=dict)
    home: dict[str, float] = field(default_factory=dict)
    passive: tuple[str, ...] = ()
    gravity: tuple[float, ...] = (0.0, 0.0, -9.81)
    notes: tuple[str, ...] = ()
    left_out: int = 0
    order: tuple[tuple[str, int], ...] = ()
    actuators: tuple[tuple[str, float], ...] = ()
    has_ground: bool = False
    frictions: tuple[tuple[str, str, float], ...] = ()


def plain_mjcf(path: Path) -> PlainMjcf:
    """Raises: ValueError, one line, for what MuJoCo refuses, or where it is missing."""
    spec, model, left_out = _compiled(path)
    return _Writer(model, _name_of(spec, path), left_out).write()


def named_spec(path: Path):
    """The file as MuJoCo has it (MjSpec), all of whose bodies, joints and shapes have
    the names that they have in plain_mjcf, and what writes it.

    Raises: as plain_mjcf.
    """
    spec, model, left_out = _compiled(path)
    writer = _Writer(model, _name_of(spec, path), left_out)
    for kind, each in (
        ("body", spec.bodies[1:]), ("joint", spec.joints), ("geom", spec.geoms)
    ):  # fmt: skip
        for one in each:
            one.name = writer.name_of(kind, one.id)
    return spec, writer


def _name_of(spec, path: Path) -> str:
    name = spec.modelname
    return path.stem if name in ("", "MuJoCo Model") else name


def compiled(spec):
    """The model of a MjSpec, without MuJoCo's words on attributes that it will drop."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return spec.compile()


def _compiled(path: Path):
    """MjSpec, its compiled model, and how many collision meshes are not there."""
    try:
        import mujoco
    except ImportError:
        raise ValueError(
            f"{path.name} is MJCF, which is read with MuJoCo: expected its Python "
            "package (Python 3.11 or newer; pip install mujoco)"
        ) from None
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        left_out = _without_lost_meshes(spec, path.parent)
        try:
            model = compiled(spec)
        except ValueError:
            unreadable = _unreadable_meshes(spec, path.parent)
            if not unreadable:
                raise
            spec = mujoco.MjSpec.from_file(str(path))
            left_out = _without_lost_meshes(spec, path.parent, unreadable)
            model = compiled(spec)
    except ValueError as error:
        raise ValueError(f"{path}: MuJoCo says: {' '.join(str(error).split())}") from (
            None
        )
    _apply_flags(model)
    return spec, model, left_out


def _apply_flags(m) -> None:
    """Takes out of a compiled model what its option flags switch off."""
    import mujoco

    off, bits = int(m.opt.disableflags), mujoco.mjtDisableBit
    by_flag = {
        bits.mjDSBL_EQUALITY: [m.eq_active0],
        bits.mjDSBL_FRICTIONLOSS: [m.dof_frictionloss, m.tendon_frictionloss],
        bits.mjDSBL_LIMIT: [m.jnt_limited, m.tendon_limited],
        bits.mjDSBL_CONTACT: [m.geom_contype, m.geom_conaffinity],
        bits.mjDSBL_SPRING: [m.jnt_stiffness, m.tendon_stiffness],
        bits.mjDSBL_DAMPER: [m.dof_damping, m.tendon_damping],
        bits.mjDSBL_GRAVITY: [m.opt.gravity],
        bits.mjDSBL_CLAMPCTRL: [m.actuator_ctrllimited],
        bits.mjDSBL_ACTUATION: [m.actuator_gainprm, m.actuator_biasprm],
    }
    constraints = list(by_flag)[:4]
    for bit, arrays in by_flag.items():
        all_of_them = bit in constraints and off & int(bits.mjDSBL_CONSTRAINT)
        if off & int(bit) or all_of_them:
            for each in arrays:
                each[:] = 0


def may_touch(m) -> np.ndarray:
    """(n, n) whether MuJoCo looks for contacts of two shapes of a compiled model: it
    does for what is written as a pair, but else not of a link with the one that carries
    it, nor of what is excluded or what the bits of contype and conaffinity keep
    apart."""
    import mujoco

    bits = mujoco.mjtDisableBit
    if m.opt.disableflags & (int(bits.mjDSBL_CONTACT) | int(bits.mjDSBL_CONSTRAINT)):
        return np.zeros((m.ngeom, m.ngeom), dtype=bool)
    found = (m.geom_contype[:, None] & m.geom_conaffinity[None, :]) != 0
    found |= found.T
    weld = m.body_weldid[m.geom_bodyid]
    carrier = m.body_weldid[m.body_parentid[weld]]
    carries = (carrier[:, None] == weld[None, :]) & (weld != 0)[None, :]
    found &= ~(carries | carries.T) & (weld[:, None] != weld[None, :])
    for pair in m.exclude_signature:
        one, two = (m.geom_bodyid == k for k in (int(pair) >> 16, int(pair) & 0xFFFF))
        found[np.ix_(one, two)] = found[np.ix_(two, one)] = False
    found[m.pair_geom1, m.pair_geom2] = found[m.pair_geom2, m.pair_geom1] = True
    return found


def _unreadable_meshes(spec, folder: Path) -> set[str]:
    """Files of meshes that MuJoCo cannot load, such as pointers in their place of a
    checkout without Git LFS."""
    import mujoco

    found = set()
    for mesh in spec.meshes:
        one = mujoco.MjSpec()
        one.add_mesh(
            name="one", file=str((folder / spec.meshdir / mesh.file).resolve())
        )
        one.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="one")
        try:
            one.compile()
        except ValueError:
            found.add(mesh.file)
    return found


def _without_lost_meshes(spec, folder: Path, unreadable: Container[str] = ()) -> int:
    """Takes out meshes that are not there, with their shapes, and textures. Returns:
    how many shapes could have touched something.

    Args: unreadable: files that are as good as not there.

    Raises: ValueError where a body's inertia is that of such a shape.
    """

    def lost(file: str, where: str) -> bool:
        return bool(file) and not (folder / where / file).is_file()

    for texture in list(spec.textures):
        files = [texture.file, *texture.cubefiles]
        if any(lost(file, spec.texturedir) for file in files):
            for material in spec.materials:
                material.textures = ["" for _ in material.textures]
            spec.delete(texture)
    gone = {m.name or Path(m.file).stem: m for m in spec.meshes
            if lost(m.file, spec.meshdir) or m.file in unreadable}  # fmt: skip
    count = 0
    by_shapes = int(spec.compiler.inertiafromgeom) == 1  # mjINERTIAFROMGEOM_TRUE
    for geom in list(spec.geoms) if gone else []:
        if geom.meshname not in gone:
            continue
        body = geom.parent
        weighs = by_shapes or not body.explicitinertial
        if weighs and body.name != "world" and geom.mass != 0.0:
            raise ValueError(
                f"the mesh {gone[geom.meshname].file} of body {body.name!r} is not "
                "there, and its inertia is that of its shapes"
            )
        count += bool(geom.contype or geom.conaffinity)
        spec.delete(geom)
    for mesh in gone.values():
        spec.delete(mesh)
    return count


def _numbers(values) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(values))


class _Writer:
    """Writes one compiled model. Joints' frames are set so that a position is that of
    MuJoCo, also where a joint has a reference (ref)."""

    def __init__(self, model, name: str, left_out: int):
        import mujoco

        self.mj, self.m, self.name, self.left_out = mujoco, model, name, left_out
        self.notes: list[str] = []
        self.effects: list[Effect] = []
        self.meshes: dict[int, str] = {}
        self.named: dict[tuple[str, int], str] = {}
        self.may_touch = may_touch(model)
        # Also what in this file touches nothing, and may touch what another has.
        has_bits = (model.geom_contype | model.geom_conaffinity) != 0
        self.touches = has_bits | self.may_touch.any(axis=1)
        self.has_plane = False
        # What a motor turns along acts at the joint, by its gear squared.
        self.armature = np.array(model.dof_armature, dtype=float)
        self.damping = np.array(model.dof_damping, dtype=float)
        for a in range(len(model.actuator_trntype)):
            if (j := self._driven(a)) is not None:
                dof, gear = model.jnt_dofadr[j], model.actuator_gear[a][0]
                self.armature[dof] += gear**2 * model.actuator_armature[a]
                self.damping[dof] += gear**2 * model.actuator_damping[a]

    def _driven(self, a: int) -> int | None:
        """The joint of one degree of freedom that an actuator drives alone."""
        m, kinds = self.m, self.mj.mjtTrn
        j = int(m.actuator_trnid[a][0])
        at = (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))
        return j if m.actuator_trntype[a] in at and m.jnt_type[j] >= 2 else None

    def write(self) -> PlainMjcf:
        m = self.m
        root = ET.Element("mujoco", model=self.name)
        ET.SubElement(root, "compiler", angle="radian", autolimits="true")
        self.assets = ET.SubElement(root, "asset")
        places = {0: ET.SubElement(root, "worldbody")}
        # Each fixed shape on a body of its own: one that effects can name, and move.
        for g in range(m.body_geomnum[0]):
            at = places[0]
            if self.touches[g]:
                at = ET.SubElement(places[0], "body", name=self._fixed(g))
            self._shape(g, at)
        for body in range(1, m.nbody):
            places[body] = self._body(body, places[m.body_parentid[body]])
        self._contact(root)
        self._equality(root)
        drives, passive = self._actuators(root)
        self._left_out()
        ET.indent(root)
        return PlainMjcf(
            ET.tostring(root, encoding="unicode") + "\n", tuple(self.effects), drives,
            self._home(), passive, tuple(float(x) for x in m.opt.gravity),
            tuple(self.notes), self.left_out, self._order(),
            tuple(
                ("", 1.0) if (j := self._driven(a)) is None
                else (self.name_of("joint", j), float(m.actuator_gear[a][0]))
                for a in range(len(m.actuator_trntype))
            ),
            bool(self.may_touch[m.geom_bodyid == 0].any()),
            self._frictions(),
        )  # fmt: skip

    def _frictions(self) -> tuple[tuple[str, str, float], ...]:
        """Of a body's shapes the one with most friction counts."""
        m = self.m
        of: dict[tuple[int, str], tuple[int, float]] = {}  # Priority, friction.
        for g in np.flatnonzero(self.touches):
            body = int(m.geom_bodyid[g])
            name = self.body_of(int(g))
            own = int(m.geom_priority[g]), float(m.geom_friction[g][0])
            of[body, name] = max(own, of.get((body, name), own))
        found, beyond = list[tuple[str, str, float, bool]](), set[str]()
        for ((a, first), one), ((b, second), two) in combinations(of.items(), 2):
            if m.body_weldid[a] == m.body_weldid[b]:
                continue
            mu = max(one, two)[1] if one[0] != two[0] else max(one[1], two[1])
            total = one[1] + two[1]
            drake = 2.0 * one[1] * two[1] / total if total else 0.0
            # An effect then gives both surfaces another friction, so that what these
            # have with others has to be said, too.
            if mu >= 2.0 * min(one[1], two[1]):
                beyond |= {first, second}
            found.append((first, second, mu, not np.isclose(mu, drake)))
        return tuple(
            (a, b, mu)
            for a, b, mu, differs in sorted(found, key=lambda each: -each[2])
            if differs or {a, b} & beyond
        )

    def _order(self) -> tuple[tuple[str, int], ...]:
        m = self.m
        return tuple(
            (self.name_of("joint", j), 4 if m.jnt_type[j] == 1 else 1)
            if m.jnt_type[j]
            else (self.name_of("body", int(m.jnt_bodyid[j])), 7)
            for j in range(m.njnt)
        )

    def name_of(self, kind: str, index: int) -> str:
        """The name of a body, joint or other element, or one by its number."""
        known = self.named.get((kind, index))
        if known is None:
            known = getattr(self.m, kind)(index).name or f"{kind}_{index}"
            self.named[kind, index] = known
        return known

    # ----- Bodies

    def _body(self, i: int, parent: ET.Element) -> ET.Element:
        m, mj = self.m, self.mj
        pos, quat = m.body_pos[i].copy(), m.body_quat[i].copy()
        first, n = m.body_jntadr[i], m.body_jntnum[i]
        joints = range(first, first + n)
        free = [j for j in joints if m.jnt_type[j] == mj.mjtJoint.mjJNT_FREE]
        start = m.key_qpos[0] if m.nkey else m.qpos0
        if free:
            q = start[m.jnt_qposadr[free[0]] :][:7]
            pos, quat = q[:3], q[3:] / np.linalg.norm(q[3:])
        # X_PB at positions of 0, and the joints of the body as they then are. MuJoCo
        # turns a body by each of its joints in turn, from its reference position.
        R = rotation(quat)
        links: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for j in joints:
            X, p = np.eye(3), np.zeros(3)
            axis, anchor = m.jnt_axis[j], m.jnt_pos[j]
            if m.jnt_type[j] == mj.mjtJoint.mjJNT_HINGE:
                X = _turn(axis, -m.qpos0[m.jnt_qposadr[j]])
                p = anchor - X @ anchor
            elif m.jnt_type[j] == mj.mjtJoint.mjJNT_SLIDE:
                p = -m.qpos0[m.jnt_qposadr[j]] * axis
            links.append((X, p, anchor))
        at = parent
        if len(joints) > 1:
            # A chain of bodies without mass, one for each joint.
            for j, (X, p, _) in zip(joints, links, strict=True):
                last = j == first + n - 1
                own = self.name_of("body", i)
                name = own if last else f"{own}_{self.name_of('joint', j)}"
                at = ET.SubElement(
                    at, "body", name=name, pos=_numbers(pos + R @ p),
                    quat=_numbers(_quaternion(R @ X)),
                )  # fmt: skip
                pos, R = np.zeros(3), np.eye(3)
                self._joint(j, at)
        else:
            for X, p, _ in links:
                pos, R = pos + R @ p, R @ X
            at = ET.SubElement(
                parent, "body", name=self.name_of("body", i), pos=_numbers(pos),
                quat=_numbers(_quaternion(R)),
            )  # fmt: skip
            for j in joints:
                self._joint(j, at)
        about = rotation(m.body_iquat[i])
        central = about @ np.diag(m.body_inertia[i]) @ about.T
        six = central[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        if m.body_mass[i]:
            ET.SubElement(
                at, "inertial", pos=_numbers(m.body_ipos[i]),
                mass=_numbers(m.body_mass[i]), fullinertia=_numbers(six),
            )  # fmt: skip
        self._shapes(i, at)
        if m.body_gravcomp[i]:
            self.notes.append(
                f"body {self.name_of('body', i)}: gravcomp {m.body_gravcomp[i]:g} is "
                "left out, so all of its weight loads the joints"
            )
        return at

    def _joint(self, j: int, at: ET.Element) -> None:
        m, name = self.m, self.name_of("joint", j)
        kind = ("free", "ball", "slide", "hinge")[m.jnt_type[j]]
        dof = m.jnt_dofadr[j]
        one = kind in ("slide", "hinge")
        attributes = {"name": name, "type": kind}
        if kind != "free":
            attributes["pos"] = _numbers(m.jnt_pos[j])
            attributes["damping"] = _numbers(self.damping[dof])
        if one:
            attributes["axis"] = _numbers(m.jnt_axis[j])
            attributes["limited"] = "true" if m.jnt_limited[j] else "false"
            if m.jnt_limited[j]:
                attributes["range"] = _numbers(m.jnt_range[j])
        elif m.jnt_limited[j]:
            self.notes.append(f"joint {name}: the range of a ball is left out")
        ET.SubElement(at, "joint", attributes)
        values = {
            "armature": ("rotor_inertia", {"inertia": self.armature[dof]}),
            "frictionloss": (
                "joint_coulomb_friction", {"coulomb": m.dof_frictionloss[dof]},
            ),
            "stiffness": (
                "joint_spring",
                {"stiffness": m.jnt_stiffness[j],
                 "rest": m.qpos_spring[m.jnt_qposadr[j]]},
            ),
        }  # fmt: skip
        for word, (effect, parameters) in values.items():
            parameters = {key: float(x) for key, x in parameters.items()}
            value = next(iter(parameters.values()))
            if value and one:
                self.effects.append(Effect(effect, [name], parameters))
            elif value:
                self.notes.append(
                    f"joint {name}: {word} {value:g} of a {kind} joint is left out"
                )
        if kind == "free" and self.damping[dof]:
            self.notes.append(
                f"joint {name}: damping {self.damping[dof]:g} of a free joint is left "
                "out"
            )
        for word, poly in (("damping", m.dof_dampingpoly[dof]),
                           ("stiffness", m.jnt_stiffnesspoly[j])):  # fmt: skip
            if np.any(poly):
                self.notes.append(
                    f"joint {name}: of its {word} only the linear part is taken"
                )

    # ----- Shapes

    def _fixed(self, geom: int) -> str:
        """The name of the body that has one of the world's own shapes."""
        name = self.m.geom(geom).name or f"ground_{geom}"
        taken = {self.name_of("body", k) for k in range(1, self.m.nbody)}
        return f"{name}_fixed" if name in taken else name

    def body_of(self, geom: int) -> str:
        """The name of the body that has a shape."""
        body = int(self.m.geom_bodyid[geom])
        return self.name_of("body", body) if body else self._fixed(geom)

    def _shapes(self, body: int, at: ET.Element) -> None:
        first = self.m.body_geomadr[body]
        for g in range(first, first + self.m.body_geomnum[body]):
            self._shape(g, at)

    def _shape(self, g: int, at: ET.Element) -> None:
        """Nothing for one that is for display, or of a type that is left out."""
        m = self.m
        kind = self.mj.mjtGeom(m.geom_type[g]).name[len("mjGEOM_") :].lower()
        touches = self.touches[g]
        if kind == "mesh":
            if not touches:
                return  # For display alone.
            more = {"mesh": self._mesh(int(m.geom_dataid[g]))}
        elif kind in ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box"):
            size, pos = m.geom_size[g].copy(), m.geom_pos[g].copy()
            if kind == "plane" and touches and self.has_plane:
                # Drake ends without a word where some of what has no end may move.
                kind, size = "box", np.full(3, ENDLESS)
                pos -= ENDLESS * rotation(m.geom_quat[g])[:, 2]
            elif kind == "plane":
                size[2] = size[2] or 1.0
                self.has_plane |= bool(touches)
            more = {"size": _numbers(size), "pos": _numbers(pos)}
        else:
            if touches:
                self.notes.append(
                    f"geom {self.name_of('geom', g)}: a shape of type {kind} is left "
                    "out"
                )
            return
        attributes = {
            "name": self.name_of("geom", g), "type": kind, "mass": "0",
            "pos": _numbers(m.geom_pos[g]), **more, "quat": _numbers(m.geom_quat[g]),
            "friction": _numbers(m.geom_friction[g][:1]),
            "rgba": _numbers(m.geom_rgba[g]),
        }  # fmt: skip
        if not touches:
            attributes |= {"contype": "0", "conaffinity": "0", "group": "1"}
        ET.SubElement(at, "geom", attributes)

    def _mesh(self, i: int) -> str:
        if i not in self.meshes:
            m = self.m
            v, f = m.mesh_vertadr[i], m.mesh_faceadr[i]
            obj = write_obj(
                m.mesh_vert[v : v + m.mesh_vertnum[i]],
                m.mesh_face[f : f + m.mesh_facenum[i]],
            )
            self.meshes[i] = f"mesh_{i}"
            ET.SubElement(self.assets, "mesh", name=self.meshes[i], file=str(obj))
        return self.meshes[i]

    def _contact(self, root: ET.Element) -> None:
        """Bodies that MuJoCo has pass through each other, though both may touch others.
        (Drake looks for no contacts of a link with the one that carries it either.)"""
        m, contact = self.m, ET.SubElement(root, "contact")
        of: dict[str, list[int]] = {}
        for g in np.flatnonzero(self.touches):
            of.setdefault(self.body_of(int(g)), []).append(int(g))
        for (one, first), (two, second) in combinations(of.items(), 2):
            a, b = (int(m.body_weldid[m.geom_bodyid[x[0]]]) for x in (first, second))
            carriers = m.body_weldid[m.body_parentid[[a, b]]]
            if a == b or a and b and (carriers[0] == b or carriers[1] == a):
                continue
            found = self.may_touch[np.ix_(first, second)]
            if not found.any():
                ET.SubElement(contact, "exclude", body1=one, body2=two)
            elif not found.all():
                self.notes.append(
                    f"some shapes of {one} and {two} pass through each other by their "
                    "contype and conaffinity, and touch here"
                )

    # ----- Constraints and actuators

    def _equality(self, root: ET.Element) -> None:
        m, mj = self.m, self.mj
        lost: dict[str, int] = {}
        found = ET.SubElement(root, "equality")
        for e in np.flatnonzero(m.eq_active0):
            kind = mj.mjtEq(m.eq_type[e])
            if kind == mj.mjtEq.mjEQ_JOINT and m.eq_obj2id[e] >= 0:
                ET.SubElement(
                    found, "joint", joint1=self.name_of("joint", m.eq_obj1id[e]),
                    joint2=self.name_of("joint", m.eq_obj2id[e]),
                    polycoef=_numbers(m.eq_data[e][:5]),
                )  # fmt: skip
                continue
            word = kind.name[len("mjEQ_") :].lower()
            lost[word] = lost.get(word, 0) + 1
        for word, count in lost.items():
            self.notes.append(
                f"{count} equality constraint{'s' if count > 1 else ''} of type {word} "
                "left out, so the force in a loop that it closes is missing"
            )

    def _actuators(self, root: ET.Element):
        """One motor for each joint that has some. Returns: the drives as MuJoCo has
        them, {joint: FileDrive}, and joints without one, if all are of joints."""
        m = self.m
        drives: dict[str, FileDrive] = {}
        lost, elsewhere = [], False
        for a in range(len(m.actuator_trntype)):
            j = self._driven(a)
            elsewhere |= j is None
            if j is not None:
                drive = self._drive(a, j)
                name = self.name_of("joint", j)
                known = drives.get(name)
                if drive is None:
                    drive = FileDrive(gear=0.0)
                    lost.append(self.name_of("actuator", a))
                if known is not None:  # A position and a velocity servo together.
                    drive = FileDrive(
                        known.kp + drive.kp, known.kd + drive.kd,
                        known.limit + drive.limit, known.gear,
                        known.activation or drive.activation,
                    )  # fmt: skip
                drives[name] = drive
            else:
                lost.append(self.name_of("actuator", a))
        if lost:
            shown = ", ".join(lost[:6]) + (", ..." if lost[6:] else "")
            self.notes.append(
                f"actuators {shown}: neither motors nor servos of joints (tendons, "
                "sites, muscles, filters), so what they do is left out"
            )
        motors = ET.SubElement(root, "actuator")
        for name, drive in drives.items():
            attributes = {"name": name, "joint": name}
            if np.isfinite(drive.limit):
                attributes["ctrllimited"] = "true"
                attributes["ctrlrange"] = _numbers([-drive.limit, drive.limit])
            ET.SubElement(motors, "motor", attributes)
        joints = [self.name_of("joint", j) for j in range(m.njnt) if m.jnt_type[j] >= 2]
        return drives, tuple(
            name for name in joints if drives and not elsewhere and name not in drives
        )

    def _drive(self, a: int, j: int) -> FileDrive | None:
        """force = gain ctrl + b0 + b1 length + b2 velocity, and the joint's effort is
        gear force, with length = gear q. None for other laws."""
        m, mj = self.m, self.mj
        gear = float(m.actuator_gear[a][0])
        gain, bias = m.actuator_gainprm[a], m.actuator_biasprm[a]
        affine = m.actuator_biastype[a] == mj.mjtBias.mjBIAS_AFFINE
        plain = m.actuator_biastype[a] == mj.mjtBias.mjBIAS_NONE
        if not (
            gear
            and m.actuator_gaintype[a] == mj.mjtGain.mjGAIN_FIXED
            and int(m.actuator_dyntype[a]) in map(int, self._dynamics)
            and (affine or plain)
        ):
            return None
        b0, b1, b2 = (float(x) for x in (bias[:3] if affine else np.zeros(3)))
        g = float(gain[0])
        limits = [np.inf]
        if m.actuator_forcelimited[a]:
            limits.append(abs(gear) * float(np.abs(m.actuator_forcerange[a]).max()))
        if m.jnt_actfrclimited[j]:
            limits.append(float(np.abs(m.jnt_actfrcrange[j]).max()))
        if b0 or not g:
            return None
        act = self._activation(a)
        if b1:  # A servo of position: gain (ctrl - length).
            if not np.isclose(b1, -g, rtol=1e-6) or b1 > 0.0 or b2 > 0.0:
                return None
            return FileDrive(g * gear**2, -b2 * gear**2, min(limits), gear, act)
        if b2:  # A servo of velocity.
            if not np.isclose(b2, -g, rtol=1e-6) or b2 > 0.0:
                return None
            return FileDrive(0.0, g * gear**2, min(limits), gear, act)
        if m.actuator_ctrllimited[a]:
            most = float(np.abs(m.actuator_ctrlrange[a]).max())
            limits.append(most * abs(g * gear))
        return FileDrive(0.0, 0.0, min(limits), g * gear, act)

    @property
    def _dynamics(self):
        kinds = self.mj.mjtDyn
        return (
            kinds.mjDYN_NONE, kinds.mjDYN_INTEGRATOR, kinds.mjDYN_FILTER,
            kinds.mjDYN_FILTEREXACT,
        )  # fmt: skip

    def _activation(self, a: int) -> Activation | None:
        """What an actuator follows in place of its ctrl."""
        m, kind = self.m, self.m.actuator_dyntype[a]
        if kind == self.mj.mjtDyn.mjDYN_NONE:
            return None
        integrates = kind == self.mj.mjtDyn.mjDYN_INTEGRATOR
        lag = 0.0 if integrates else max(float(m.actuator_dynprm[a][0]), 1e-9)
        at = m.actuator_actadr[a]
        start = float(m.key_act[0][at]) if m.nkey else 0.0
        low, high = -np.inf, np.inf
        if m.actuator_actlimited[a]:
            low, high = (float(x) for x in m.actuator_actrange[a])
        return Activation(lag, start, low, high)

    def _home(self) -> dict[str, float]:
        m = self.m
        start = m.key_qpos[0] if m.nkey else m.qpos0
        return {
            self.name_of("joint", j): float(start[m.jnt_qposadr[j]])
            for j in range(m.njnt)
            if m.jnt_type[j] >= 2 and start[m.jnt_qposadr[j]]
        }

    def _left_out(self) -> None:
        m = self.m
        lost: dict[str, list[str]] = {}
        for t in range(m.ntendon):
            words = {
                "stiffness": m.tendon_stiffness[t], "damping": m.tendon_damping[t],
                "frictionloss": m.tendon_frictionloss[t],
                "armature": m.tendon_armature[t], "limits": m.tendon_limited[t],
            }  # fmt: skip
            there = [word for word, value in words.items() if np.any(value)]
            if there:
                name = self.name_of("tendon", t)
                lost.setdefault(" and ".join(there), []).append(name)
        for what, names in lost.items():
            few = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
            one = f"tendon {few}: its" if len(names) == 1 else (
                f"{len(names)} tendons ({few}): their"
            )  # fmt: skip
            self.notes.append(f"{one} {what} left out")
        if m.nflex:
            self.notes.append(f"{m.nflex} flexible bodies: their stiffness is left out")
        if m.opt.density or m.opt.viscosity:
            self.notes.append("forces of the air or water around are left out")
        if np.any(m.opt.wind):
            self.notes.append("the wind is left out")


def rotation(quat: Sequence[float] | np.ndarray) -> np.ndarray:
    """(3, 3) of a quaternion w x y z."""
    w, x, y, z = np.asarray(quat, float) / np.linalg.norm(quat)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def _quaternion(R: np.ndarray) -> np.ndarray:
    """w x y z of a rotation (3, 3): the eigenvector that it is, so exact at half turns
    as well (Bar-Itzhack, J. Guidance 23(6), 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array([
        [a + e + i, h - f, c - g, d - b], [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h], [d - b, c + g, f + h, i - a - e],
    ])  # fmt: skip
    return np.linalg.eigh(K)[1][:, -1]


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    return rotation([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])

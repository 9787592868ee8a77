"""A scene in MuJoCo: its model's own file as MuJoCo compiles it, with the scene's
drives and effects.

Contact, limits and the time step are those of the file (cone, solref, solimp, option).
What an effect changes in Drake's plant is changed in MuJoCo's model, whatever kind it
is of: inertias, damping, rotors, dry friction, gravity, shapes and their places, the
friction of pairs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any
from xml.dom import expatbuilder, minidom

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    Mesh,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import PackageMap
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.drives import drive_law, path_numbers
from makebreak.models.effects import KINDS
from makebreak.models.effects.actuation_path import (
    BIAS,
    GAIN,
    KP,
    LIMIT,
    OWN,
    SHARE,
    TIME_CONSTANT,
)
from makebreak.models.effects.contact import CONTACT_LAW, FRICTION
from makebreak.models.effects.kind import (
    Effect,
    full_name,
    is_added,
    model_of,
    one_dof_joints,
)
from makebreak.models.effects.model_text import make_mesh_paths_absolute
from makebreak.models.mjcf import compiled, named_spec, rotation
from makebreak.models.model_export import (
    Exported,
    JointNumbers,
    inertial_of,
    is_said,
    joint_numbers,
    payloads_of,
    unsaid,
)
from makebreak.models.model_files import with_what_files_say
from makebreak.models.robot_file import path_of
from makebreak.models.scene import LoadedScene, Scene, actuators_of_model, load_scene
from makebreak.models.scene_schema import COMMANDS_OF, without_shapes

MOST_KEPT = 32  # Models.
HELD = 1e10  # [kg m2], [kg]: what turns it is not seen to move.


@dataclass(frozen=True, eq=False)
class Twin:
    """model: MjModel. q (n_q,), v (n_v,): where Drake's coordinates are in qpos, qvel.
    home (nq,): qpos, with joints that the scene holds where it has them.
    spins: of each free body where its spin is in Drake's v, and its quaternion in q.
    commands: {command channel: (entry of ctrl, factor)}."""

    model: Any
    q: np.ndarray
    v: np.ndarray
    home: np.ndarray
    spins: tuple[tuple[int, int], ...]
    commands: dict[str, tuple[int, float]]


class MujocoTwin:
    """Makes MuJoCo's models of a scene, with other effects again and again.

    Raises: ValueError for a scene that is not one MJCF file, or has what MuJoCo has no
        place for; or where MuJoCo is missing.
    """

    def __init__(self, scene: Scene, for_export: bool = False):
        models = [d.add_model for d in scene.directives if d.add_model is not None]
        packages = PackageMap()
        for name, folder in scene.packages.items():
            packages.Add(name, folder)
        path = (
            path_of(models[0].file, Path("/"), packages) if len(models) == 1 else None
        )
        if path is None or path.suffix != ".xml":
            raise ValueError("MuJoCo simulates scenes of one MJCF file alone")
        self._spec, self._writer = named_spec(path)
        self._path = path
        self._file = with_what_files_say(replace(scene, effects=[]))
        self._of_file = {e.key for e in self._file.effects}
        self._plain = _Numbers(load_scene(self._file, DiagramBuilder()))
        self._made: dict[tuple, Twin] = {}
        self._free_bodies()
        if for_export:  # Of everything that the file has.
            return
        self._spec.compiler.discardvisual = True  # Meshes are not made again.
        self._drives_of(scene)

    def _free_bodies(self) -> None:
        plant = self._plain.loaded.plant
        for i in sorted(plant.GetFloatingBaseBodies()):
            body = self._spec.body(plant.get_body(i).name())
            if body is None or body.parent.id != 0:
                raise ValueError(f"{plant.get_body(i).name()} is not free in its file")
            if not list(body.joints):
                body.add_freejoint().name = f"{body.name}_free"
        kinds = [int(j.type) for j in self._spec.joints]
        if kinds.count(0) != len(plant.GetFloatingBaseBodies()) or 1 in kinds:
            raise ValueError("the scene holds bodies that are free in their file")

    def _drives_of(self, scene: Scene) -> None:
        """One actuator, clip(ctrl + b1 q + b2 v), of each joint that the scene drives
        in the place of the file's."""
        import mujoco

        law = drive_law(scene.actuation) if scene.actuation.joints else None
        if law is not None and (law.emf.any() or law.dead_band.any()
                                or law.resolution.any()):  # fmt: skip
            raise ValueError("MuJoCo has no supply, dead band or resolution of drives")
        for each in [*self._spec.actuators, *self._spec.sensors]:
            self._spec.delete(each)
        for name in scene.actuation.joints:
            drive = self._spec.add_actuator(
                name=name, target=name.partition(".")[2],
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            )  # fmt: skip
            # Whatever the file's default is.
            drive.gear, drive.gainprm[0] = [1.0, *np.zeros(5)], 1.0
            drive.ctrllimited = drive.actlimited = 0
            drive.dyntype = mujoco.mjtDyn.mjDYN_NONE
            for what in ("armature", "damping", "delay"):  # Since MuJoCo 3.6 and 4.
                if hasattr(drive, what):
                    setattr(drive, what, np.zeros_like(getattr(drive, what))[()])

    def body_of(self, shape: str) -> str:
        """The name, in the file, of the body that has a shape of this name."""
        m, writer = self._writer.m, self._writer
        names = [writer.name_of("geom", g) for g in range(m.ngeom)]
        return writer.body_of(names.index(shape))

    def with_effects(self, effects: Sequence[Effect]) -> Twin:
        """Args: effects: all of the scene's; those of sensors do not count.

        Raises: ValueError for what MuJoCo has no place for.
        """
        acting = [e for e in effects if not KINDS[e.kind].channel]
        key = tuple(e.key for e in acting)
        if key not in self._made:
            if len(self._made) >= MOST_KEPT:
                self._made.clear()
            self._made[key] = self._make(acting)
        return self._made[key]

    def _make(self, effects: Sequence[Effect]) -> Twin:
        for e in effects:
            kind = KINDS[e.kind]
            moves = kind.joint_law and kind.exported != "friction"
            if e.key not in self._of_file and (
                moves or kind.hidden_state or kind.body_law or kind.after_finalize
                or e.kind in CONTACT_LAW
            ):  # fmt: skip
                raise ValueError(f"MuJoCo has no place for {e.kind}")
        spec, now = self._with_numbers(effects)
        commands = self._set_drives(spec, now.loaded, effects)
        held = {
            name.partition(".")[2]: q for name, q in self._file.fixed_joints.items()
        }
        for name in held:
            spec.joint(name).armature = HELD
        return _indexed(compiled(spec), now.loaded.plant, held, commands)

    def _with_numbers(self, effects: Sequence[Effect]):
        # Friction of pairs is set below. Without shapes no mesh is read again.
        acting = [e for e in effects if KINDS[e.kind].at != "pair"]
        scene = without_shapes(replace(self._file, effects=acting))
        now = _Numbers(load_scene(scene, DiagramBuilder()))
        spec = self._spec.copy()
        spec.option.gravity = now.loaded.plant.gravity_field().gravity_vector()
        for joint in one_dof_joints(now.loaded.plant):
            numbers, own = joint_numbers(now.loaded, joint), spec.joint(joint.name())
            poly = np.atleast_1d(own.damping)  # A number before MuJoCo 3.6.
            poly[0] = numbers.damping
            own.damping = poly if np.ndim(own.damping) else float(poly[0])
            own.frictionloss, own.armature = numbers.friction, numbers.armature
        self._set_inertias(spec, now)
        if scene.plant.shapes:
            self._set_shapes(spec, now)
        self._set_pairs(spec, effects)
        return spec, now

    def exported(self, effects: Sequence[Effect]) -> Exported:
        """The file with these effects, and with the gains of the scene's servos in the
        places of its own; what actuators have no place for is told."""
        said = [e for e in effects if is_said(e) or e.key in self._of_file]
        spec, now = self._with_numbers(said)
        omitted = [*unsaid([e for e in effects if e.key not in self._of_file])]
        for joint in one_dof_joints(now.loaded.plant):
            drive = joint_numbers(now.loaded, joint)
            if drive.is_driven and not _set_servo(spec, joint.name(), drive):
                omitted.append(
                    f"{full_name(now.loaded.plant, joint)} is driven with kp "
                    f"{drive.kp:.4g} and kd {drive.kd:.4g}"
                )
        spec.compile()
        document = expatbuilder.parseString(spec.to_xml().encode(), namespaces=False)
        (compiler,) = document.getElementsByTagName("compiler")[:1]
        for key in ("meshdir", "texturedir"):
            if not compiler.hasAttribute(key):
                compiler.setAttribute(key, ".")
        make_mesh_paths_absolute(document, self._path.parent)
        for each in document.getElementsByTagName("general"):
            _name_servo(each)
        root = document.documentElement
        assert root is not None  # Of what MuJoCo writes.
        return Exported(root.toxml() + "\n", tuple(omitted))

    def _set_inertias(self, spec, now: "_Numbers") -> None:
        every = int(spec.compiler.inertiafromgeom) == 1  # They would win.
        spec.compiler.inertiafromgeom = 2 if every else spec.compiler.inertiafromgeom
        for name, inertial in now.inertials.items():
            if not every and np.array_equal(inertial, self._plain.inertials[name]):
                continue
            body = spec.body(name)
            body.explicitinertial, body.mass = True, inertial[0]
            body.ipos, body.inertia = inertial[1:4], np.zeros(3)
            body.fullinertia = inertial[4:]
            body.ialt.type, body.iquat = 0, [1.0, 0.0, 0.0, 0.0]

    def _set_shapes(self, spec, now: "_Numbers") -> None:
        if now.shapes.keys() != self._plain.shapes.keys():
            raise ValueError("MuJoCo has no place for other shapes")
        m = self._writer.m
        for name, (shape, X) in now.shapes.items():
            before, X_before = self._plain.shapes[name]
            size = _size(shape)
            if np.array_equal(size, _size(before)) and X.IsExactlyEqualTo(X_before):
                continue
            geom = spec.geom(name)
            if geom.meshname:
                raise ValueError(f"MuJoCo has no place for another {name}")
            k = m.geom(geom.id).id
            own = RigidTransform(
                RotationMatrix(rotation(m.geom_quat[k])), m.geom_pos[k]
            )
            moved = X @ X_before.inverse() @ own
            geom.fromto, geom.alt.type = np.full(6, np.nan), 0
            geom.pos = moved.translation()
            geom.quat = moved.rotation().ToQuaternion().wxyz()
            geom.size = [*size, *m.geom_size[k][len(size) :]]

    def _set_pairs(self, spec, effects: Sequence[Effect]) -> None:
        """What effects say of a pair's friction; all else is as MuJoCo mixes it."""
        m, writer = self._writer.m, self._writer
        pairs: dict[tuple[int, int], float] = {}
        for e in effects:  # The last one counts.
            for at in e.at if e.kind == FRICTION else ():
                pairs |= dict.fromkeys(self._geoms_of(at), e.parameters["friction"])
        for (one, other), friction in pairs.items():
            _add_pair(spec, m, writer, one, other, friction)

    def _geoms_of(self, pair: str) -> list[tuple[int, int]]:
        """The geoms with which two bodies may touch."""
        of, may_touch = dict[str, list[int]](), self._writer.may_touch
        for g in np.flatnonzero(self._writer.touches):
            of.setdefault(self._writer.body_of(int(g)), []).append(int(g))
        a, b = (name.partition(".")[2] for name in pair.split("~"))
        both = (sorted(two) for two in product(of.get(a, ()), of.get(b, ())))
        return [(one, other) for one, other in both if may_touch[one, other]]

    def _set_drives(self, spec, loaded: LoadedScene, effects: Sequence[Effect]):
        act, plant = loaded.scene.actuation, loaded.plant
        law = drive_law(act) if act.joints else None
        takes = COMMANDS_OF[act.type]
        commands: dict[str, tuple[int, float]] = {}
        numbers = dict[str, np.ndarray]()
        for model in dict.fromkeys(name.split(".")[0] for name in act.joints):
            rows, _ = path_numbers(plant, model, effects)
            for k, actuator in enumerate(actuators_of_model(plant, model)):
                name = full_name(plant, actuator.joint())
                numbers[name] = rows[:, k]
                if np.isfinite(actuator.effort_limit()):
                    numbers[name][LIMIT] = min(rows[LIMIT, k], actuator.effort_limit())
        for k, name in enumerate(act.joints):
            n = numbers[name]
            if n[SHARE] or n[TIME_CONSTANT]:
                raise ValueError("MuJoCo has no place for a lag or load friction")
            drive = spec.actuator(name)
            gain = n[GAIN]
            kp = kd = 0.0
            limit = n[LIMIT]
            if law is not None and "effort_command" not in takes:
                kp = law.kp[k] if n[KP] == OWN else n[KP]
                kd = law.kd[k]
                limit = min(limit, gain * law.limit[k])
            drive.biasprm[:3] = n[BIAS], -gain * kp, -gain * kd
            drive.forcerange = [-limit, limit]
            drive.forcelimited = bool(limit < 1e20)
            for what, factor in (
                ("position_command", kp), ("velocity_command", kd),
                ("effort_command", 1.0),
            ):  # fmt: skip
                if what in takes:
                    commands[f"{name}.{what}"] = (k, gain * factor)
        return commands


def own_mjcf(scene: Scene) -> Exported | None:
    """The scene's own MJCF with its repaired numbers: shapes, meshes, contacts, sensors
    and names are those of the file. None of a scene that is not one MJCF file, or that
    MuJoCo does not hold as its file has it."""
    try:
        # What the file lets move, as a gripper's fingers, moves in what is written.
        twin = MujocoTwin(replace(scene, fixed_joints={}), for_export=True)
        return twin.exported(scene.effects)
    except ValueError:
        return None


def _set_servo(spec, joint: str, drive: JointNumbers) -> bool:
    """Sets the gains of the joint's own servo. Whether nothing is lost of the drive:
    what takes efforts has no gains."""
    import mujoco

    if not (drive.kp or drive.kd):
        return True
    own = [
        a for a in spec.actuators
        if a.trntype == mujoco.mjtTrn.mjTRN_JOINT and a.target == joint
    ]  # fmt: skip
    if len(drive.takes) != 1 or len(own) != 1:
        return False
    if own[0].biastype != mujoco.mjtBias.mjBIAS_AFFINE:
        return False
    (servo,), by = own, own[0].gear[0] ** 2
    if bool(servo.biasprm[1]) != bool(drive.kp):
        return False  # Of a velocity, where the drive is of a position.
    servo.gainprm[0] = (drive.kp or drive.kd) / by
    servo.biasprm[:3] = 0.0, -drive.kp / by, -drive.kd / by
    if np.isfinite(drive.limit):
        servo.forcelimited, most = 1, drive.limit / abs(servo.gear[0])
        servo.forcerange = [-most, most]
    return True


def _name_servo(general: minidom.Element) -> None:
    """MuJoCo writes its servos as what they are made of; people, and its versions
    before 4, know them by their names."""
    gain, bias = (general.getAttribute(k).split() for k in ("gainprm", "biasprm"))
    if len(gain) != 1 or len(bias) != 3 or general.getAttribute("dyntype"):
        return
    g, (b0, b1, b2) = float(gain[0]), map(float, bias)
    if b0 == 0.0 and b1 == -g:
        general.tagName, gains = "position", {"kp": g, "kv": -b2}
    elif b0 == b1 == 0.0 and b2 == -g:
        general.tagName, gains = "velocity", {"kv": g}
    else:
        return
    for key in ("gainprm", "biasprm", "biastype", "input"):
        if general.hasAttribute(key):
            general.removeAttribute(key)
    for key, value in gains.items():
        general.setAttribute(key, f"{value:.6g}")


class _Numbers:
    """What of Drake's plant MuJoCo's model has too. inertials: {body: mass, centre,
    about it xx yy zz xy xz yz}; shapes: {geom: (shape, pose on its body, or in the
    world where that is fixed)}."""

    def __init__(self, loaded: LoadedScene):
        self.loaded, plant = loaded, loaded.plant
        payloads, context = payloads_of(plant), plant.CreateDefaultContext()
        has_shapes = plant.geometry_source_is_registered()
        inspector = loaded.scene_graph.model_inspector()
        self.inertials: dict[str, np.ndarray] = {}
        self.shapes: dict[str, tuple[Shape, RigidTransform]] = {}
        for k in range(1, plant.num_bodies()):
            body = plant.get_body(BodyIndex(k))
            own = inertial_of(body, payloads)
            if own.mass > 0.0 and not is_added(model_of(plant, body)):
                six = own.central[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
                self.inertials[body.name()] = np.array([own.mass, *own.com, *six])
            fixed = plant.IsAnchored(body)
            for g in plant.GetCollisionGeometriesForBody(body) if has_shapes else ():
                X = inspector.GetPoseInFrame(g)
                if fixed:
                    X = plant.EvalBodyPoseInWorld(context, body) @ X
                name = inspector.GetName(g).rpartition("::")[2]
                self.shapes[name] = inspector.GetShape(g), X


def _size(shape: Shape) -> np.ndarray:
    """As MuJoCo has it; empty of one that has none, of a mesh its scale."""
    if isinstance(shape, Sphere):
        return np.array([shape.radius()])
    if isinstance(shape, Box):
        return 0.5 * np.array(shape.size())
    if isinstance(shape, (Capsule, Cylinder)):
        return np.array([shape.radius(), 0.5 * shape.length()])
    if isinstance(shape, Ellipsoid):
        return np.array([shape.a(), shape.b(), shape.c()])
    if isinstance(shape, (Convex, Mesh)):
        return np.array(shape.scale3())
    return np.zeros(0)


def _add_pair(spec, m, writer, one: int, other: int, friction: float) -> None:
    names = [writer.name_of("geom", g) for g in (one, other)]
    both = [one, other]
    counts = m.geom_priority[both] == m.geom_priority[both].max()
    share = np.where(counts, m.geom_solmix[both], 0.0)
    share = share / share.sum() if share.sum() > 0.0 else counts / counts.sum()
    every = m.geom_friction[both][counts].max(axis=0)
    refs = m.geom_solref[both]
    solref = share @ refs if (refs[:, 0] > 0.0).all() else refs.min(axis=0)
    spec.add_pair(
        geomname1=names[0], geomname2=names[1],
        friction=[friction, friction, every[1], every[2], every[2]],
        condim=int(m.geom_condim[both][counts].max()),
        solref=solref, solimp=share @ m.geom_solimp[both],
        margin=float(m.geom_margin[both].max()), gap=float(m.geom_gap[both].max()),
    )  # fmt: skip


def _indexed(model, plant: MultibodyPlant, held, commands) -> Twin:
    """Args: held: {joint: where}, of those that do not move."""
    q = np.full(plant.num_positions(), -1)
    v = np.full(plant.num_velocities(), -1)
    spins = []
    for joint in one_dof_joints(plant):
        own = model.joint(joint.name())
        q[joint.position_start()] = own.qposadr[0]
        v[joint.velocity_start()] = own.dofadr[0]
    for i in sorted(plant.GetFloatingBaseBodies()):
        body = plant.get_body(i)
        j = model.body(body.name()).jntadr[0]
        at, to = model.jnt_qposadr[j], model.jnt_dofadr[j]
        first, turn = (
            body.floating_positions_start(),
            body.floating_velocities_start_in_v(),
        )
        q[first : first + 7] = [at + 3, at + 4, at + 5, at + 6, at, at + 1, at + 2]
        v[turn : turn + 6] = [to + 3, to + 4, to + 5, to, to + 1, to + 2]
        spins.append((int(turn), int(first)))
    if (q < 0).any() or (v < 0).any():
        raise ValueError("MuJoCo's model has other joints than the scene")
    home = np.array(model.qpos0)
    for name, at in held.items():
        home[model.joint(name).qposadr[0]] = at
    return Twin(model, q, v, home, tuple(spins), commands)

"""Robots and objects that touch: as a user has them, and as they truly are.

A `Setting` is written as a scene (URDF, SDF, scene.yaml), and the true one, which is
other by what is hidden, is run in MuJoCo, or in Drake with another law of contact
(hydroelastic, SAP) and a finer step than the scene's. The robot's drives hold their
commands from row to row; a camera sees the objects.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import mujoco
import numpy as np

from gap_benchmark.mechanism import quaternion, rotation
from gap_benchmark.push_world import write_table
from gap_benchmark.robots import Robot, to_mjcf, to_urdf

G = 9.81  # [m/s2]
STEP, DRAKE_STEP = 1e-4, 2.5e-4  # [s]
# Of mechanisms alone. MuJoCo takes the velocity of half a step ago, so that a damper c
# lacks c/2 steps of mass: 0.5 % of a rod that hits a wall, with STEP.
FINE_STEP = 1e-5
FELT_STEPS = 10  # Of MuJoCo's, which a force sensor takes the mean of.
# So small that contacts are springs of known stiffness. MuJoCo divides it by
# 1 - i + i r, where r is how much easier the point is to move than it is taken for: at
# the tip of a rod 8, so that a wall was 0.7 % softer than it was said to be. Where
# nothing slides it is as small as MuJoCo takes it.
IMPEDANCE, LEAST_IMPEDANCE = 0.001, 0.0001
MODULUS = 2e7  # [Pa] of compliant hydroelastic shapes,
DEPTH = 5e-4  # which press in by 0.3 to 0.6 mm [m].
STUCK = 1e-3  # [m] over which what adheres holds on.


@dataclass(frozen=True)
class Shape:
    """kind: sphere (radius), box (half sizes), cylinder (radius, half height), or
    ground, whose top is at z = 0 of its thing. turn: roll, pitch, yaw in its thing."""

    kind: str
    size: tuple[float, ...]
    friction: float
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Thing:
    """One rigid body with shapes; mass 0: fixed to the world, at `place`, turned by
    roll and pitch. inertia: central, diagonal."""

    name: str
    shapes: tuple[Shape, ...]
    mass: float = 0.0
    inertia: tuple[float, float, float] = (0.0, 0.0, 0.0)
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roll: float = 0.0
    pitch: float = 0.0

    @property
    def body(self) -> str:
        return f"{self.name}.{self.name}"


@dataclass(frozen=True)
class Setting:
    """Things, and a robot whose last body has the tool.

    drive: "pd" (kp, kd of each joint) or "effort". smooth: commands go on between rows,
    as from a fast controller that nobody logged, else they hold. stiffness [N/m],
    dissipation [s/m]: of each pair. The rest is of the truth alone: friction and
    stiffness of single pairs of bodies; patch (mu, x0, x1, y0, y1) of the ground; what
    the joints have; drag [N s/m] and force [N] on a thing; adhesion [N] of the tool.
    """

    things: tuple[Thing, ...]
    robot: Robot | None = None
    tool: Shape | None = None
    drive: str = "pd"
    kp: tuple[float, ...] = ()
    kd: tuple[float, ...] = ()
    stiffness: float = 4e4
    dissipation: float = 2.0
    rate: float = 250.0
    smooth: bool = False
    friction: Mapping[tuple[str, str], float] = field(default_factory=dict)
    springs: Mapping[tuple[str, str], float] = field(default_factory=dict)
    patch: tuple[float, ...] = ()
    coulomb: tuple[float, ...] = ()
    damping: tuple[float, ...] = ()
    gain: tuple[float, ...] = ()
    drag: Mapping[str, float] = field(default_factory=dict)
    force: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    adhesion: float = 0.0

    @property
    def free(self) -> list[Thing]:
        return [thing for thing in self.things if thing.mass > 0.0]

    @property
    def tool_body(self) -> str:
        assert self.robot is not None
        return f"{self.robot.model}.{self.robot.bodies[-1].name}"

    def with_thing(self, name: str, **changes) -> "Setting":
        things = [replace(t, **changes) if t.name == name else t for t in self.things]
        return replace(self, things=tuple(things))

    def thing(self, name: str) -> Thing:
        return next(t for t in self.things if t.name == name)

    def of_joints(self, what: str) -> np.ndarray:
        assert self.robot is not None
        n = len(self.robot.joints)
        return np.array(getattr(self, what) or [1.0 if what == "gain" else 0.0] * n)


def pair(a: str, b: str) -> tuple[str, str]:
    return (a, b) if a < b else (b, a)


def pair_friction(a: Shape, b: Shape) -> float:
    """As the scene's simulator combines two surfaces."""
    total = a.friction + b.friction
    return 2.0 * a.friction * b.friction / total if total else 0.0


# ----- As it truly is: MuJoCo


def _text(values) -> str:
    return " ".join(f"{float(v):.17g}" for v in values)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(4,) of two quaternions, the second acts first."""
    w = a[0] * b[0] - a[1:] @ b[1:]
    return np.append(w, a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))


def _step(s: Setting) -> float:
    return STEP if s.free else FINE_STEP


def mjcf(s: Setting) -> str:
    """Every pair of shapes that may touch is one <pair>, named <body>/<number>."""
    shaped: list[tuple[str, bool, int, Shape]] = []
    for t in s.things:
        shaped += [(t.body, t.mass > 0.0, i, x) for i, x in enumerate(t.shapes)]
    if s.tool is not None:
        shaped.append((s.tool_body, True, 0, s.tool))

    def geom(body: str, i: int, x: Shape, at="", of="") -> str:
        kind = "plane" if x.kind == "ground" else x.kind
        size = (5.0, 5.0, 1.0) if x.kind == "ground" else x.size
        of = of or f'quat="{_text(quaternion(x.turn))}"'
        return (
            f'<geom name="{body}/{i}" type="{kind}" size="{_text(size)}" '
            f'pos="{at or _text(x.place)}" {of} contype="0" conaffinity="0"/>'
        )

    world = ""
    for t in s.things:
        if t.mass > 0.0:
            inside = "".join(geom(t.body, i, x) for i, x in enumerate(t.shapes))
            world += (
                f'<body name="{t.body}"><freejoint name="{t.body}"/><inertial '
                f'pos="{_text(t.com)}" mass="{t.mass:.17g}" '
                f'diaginertia="{_text(t.inertia)}"/>{inside}</body>'
            )
        else:
            turn = quaternion((t.roll, t.pitch, 0.0))
            for i, x in enumerate(t.shapes):
                at = np.array(t.place) + rotation(turn) @ np.array(x.place)
                both = _product(turn, quaternion(x.turn))
                world += geom(t.body, i, x, _text(at), f'quat="{_text(both)}"')
    pairs, share = "", IMPEDANCE if s.free else LEAST_IMPEDANCE
    for i, (a, moves, j, x) in enumerate(shaped):
        for b, also, k, y in shaped[i + 1 :]:
            if a != b and (moves or also):
                mu = s.friction.get(pair(a, b), pair_friction(x, y))
                pairs += (
                    f'<pair geom1="{a}/{j}" geom2="{b}/{k}" condim="3" '
                    f'solimp="{share} {share} 1" friction="{mu} {mu} 0 0 0"/>'
                )
    if s.robot is None:
        text = "<mujoco><option/><worldbody></worldbody></mujoco>"
    else:
        n = len(s.robot.joints)
        text = to_mjcf(s.robot, (0, 0, -G), np.zeros(n), np.zeros(n))
        if s.tool is not None:
            last = s.robot.bodies[-1].name
            text = re.sub(
                rf'(<body name="{last}".*?<inertial [^>]*/>)',
                lambda m: m.group(1) + geom(s.tool_body, 0, s.tool), text, count=1,
            )  # fmt: skip
    text = re.sub(
        r"<option[^>]*/>",
        f'<option timestep="{_step(s)}" integrator="implicitfast" cone="elliptic" '
        f'impratio="1e4" iterations="50" tolerance="1e-12" gravity="0 0 {-G}"/>'
        '<size memory="10M"/>',
        text,
    )
    if "<compiler" not in text:
        text = text.replace("<mujoco>", '<mujoco><compiler inertiafromgeom="false"/>')
    text = text.replace(
        "</worldbody>", f"{world}</worldbody><contact>{pairs}</contact>"
    )
    return text


class MujocoWorld:
    """The true setting in MuJoCo. What acts on the joints (the drive's law, dry
    friction by a tanh over 1 mm/s or mrad/s) is added between its steps."""

    def __init__(self, s: Setting):
        self.s = s
        self.model = m = mujoco.MjModel.from_xml_string(mjcf(s))
        self.data = mujoco.MjData(m)
        self.joints = [] if s.robot is None else [b.joint for b in s.robot.moving]
        self.q_at = [m.joint(j).qposadr[0] for j in self.joints]
        self.v_at = [m.joint(j).dofadr[0] for j in self.joints]
        mujoco.mj_forward(m, self.data)
        # A negative solref is a spring over the mass that both sides have together.
        for k in range(m.npair):
            bodies = [m.geom_bodyid[g] for g in (m.pair_geom1[k], m.pair_geom2[k])]
            names = [m.geom(g).name.split("/")[0]
                     for g in (m.pair_geom1[k], m.pair_geom2[k])]  # fmt: skip
            ease = sum(m.body_invweight0[b, 0] for b in bodies)
            stiff = s.springs.get(pair(*names), s.stiffness)
            depth = 0.25 * np.sqrt(1.0 / (ease * stiff))  # At 0.5 m/s, half of it.
            m.pair_solref[k] = -stiff * ease, -stiff * s.dissipation * depth * ease
        self._patched = [
            k for k in range(m.npair)
            if s.patch and any(m.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE
                               for g in (m.pair_geom1[k], m.pair_geom2[k]))
        ]  # fmt: skip
        self._plain = m.pair_friction[:, 0].copy()
        self._stuck = False

    def reset(self, q, poses: Mapping[str, np.ndarray]) -> None:
        """At rest. poses: {body: (7,) origin, orientation}, or (13,) with velocities,
        in world."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self.q_at] = q
        for body, x in poses.items():
            joint = self.model.joint(body)
            at, v = joint.qposadr[0], joint.dofadr[0]
            self.data.qpos[at : at + 7] = x[:7]
            if len(x) == 13:
                self.data.qvel[v : v + 3] = x[7:10]
                self.data.qvel[v + 3 : v + 6] = rotation(x[3:7]).T @ x[10:13]
        self._stuck = False
        self._felt: list[np.ndarray] = []
        mujoco.mj_forward(self.model, self.data)

    def state(self):
        d = self.data
        return d.qpos[self.q_at].copy(), d.qvel[self.v_at].copy()

    def pose(self, body: str) -> np.ndarray:
        at = self.model.joint(body).qposadr[0]
        return self.data.qpos[at : at + 7].copy()

    def advance(self, effort: Callable, until: float) -> None:
        """effort (t, q, v) -> (n,) of the drives."""
        s, m, d = self.s, self.model, self.data
        n = max(round((until - d.time) / _step(s)), 1)
        m.opt.timestep = (until - d.time) / n
        hindered = s.robot is not None and (any(s.coulomb) or any(s.damping))
        self._felt = []
        for i in range(n):
            if self.joints:
                q, v = d.qpos[self.q_at], d.qvel[self.v_at]
                u = effort(d.time, q, v)
                if hindered:
                    u = u - s.of_joints("coulomb") * np.tanh(v / 1e-3)
                    u = u - s.of_joints("damping") * v
                d.qfrc_applied[self.v_at] = u
            self._forces()
            mujoco.mj_step(m, d)
            if s.tool is not None and n - i <= FELT_STEPS:
                self._felt.append(self._wrench_now())

    def _forces(self) -> None:
        s, m, d = self.s, self.model, self.data
        for body, c in s.drag.items():
            at = m.joint(body).dofadr[0]
            d.xfrc_applied[m.body(body).id, :3] = -c * d.qvel[at : at + 3]
        for body, f in s.force.items():
            d.xfrc_applied[m.body(body).id, :3] = f
        for k in self._patched:
            feet = [g for g in (m.pair_geom1[k], m.pair_geom2[k])
                    if m.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE]  # fmt: skip
            x, y, _ = d.geom_xpos[feet[0]]
            mu, x0, x1, y0, y1 = s.patch
            here = mu if x0 < x < x1 and y0 < y < y1 else self._plain[k]
            m.pair_friction[k, :2] = here
        if s.adhesion and s.tool is not None:
            self._adhere()

    def _adhere(self) -> None:
        """The tool holds on to what it touches until it is STUCK away."""
        m, d = self.model, self.data
        tip = m.geom(f"{self.s.tool_body}/0").id
        d.xfrc_applied[:] = 0.0
        for thing in self.s.free:
            segment = np.zeros(6)
            near, at = np.inf, np.zeros(6)
            for i in range(len(thing.shapes)):
                g = m.geom(f"{thing.body}/{i}").id
                far = mujoco.mj_geomDistance(m, d, tip, g, 0.02, segment)
                if far < near:
                    near, at = far, segment.copy()
            self._stuck = near < (STUCK if self._stuck else 0.0)
            if self._stuck and near > 1e-6:
                way = (at[3:] - at[:3]) / max(np.linalg.norm(at[3:] - at[:3]), 1e-9)
                for body, f in (
                    (m.geom_bodyid[tip], way),
                    (m.body(thing.body).id, -way),
                ):
                    p = d.xipos[body]
                    d.xfrc_applied[body, :3] = self.s.adhesion * f
                    d.xfrc_applied[body, 3:] = np.cross(at[:3] - p, self.s.adhesion * f)

    def wrench(self) -> np.ndarray:
        """(3,) force on the tool of all contacts, and of what it holds on to: its mean
        over the last FELT_STEPS, as no sensor shows what alternates from step to step
        (friction of what sticks, by a quarter of what presses)."""
        return np.mean(self._felt, axis=0) if self._felt else self._wrench_now()

    def _wrench_now(self) -> np.ndarray:
        m, d = self.model, self.data
        tip, six = m.geom(f"{self.s.tool_body}/0").id, np.zeros(6)
        total = d.xfrc_applied[m.geom_bodyid[tip], :3].copy()
        for k in range(d.ncon):
            c = d.contact[k]
            if tip in (c.geom1, c.geom2):
                mujoco.mj_contactForce(m, d, k, six)
                f = c.frame.reshape(3, 3).T @ six[:3]  # Of geom1 on geom2.
                total += f if c.geom2 == tip else -f
        return total


# ----- As it truly is: Drake, with another law and a finer step


@dataclass(frozen=True)
class DrakeLaw:
    """hydroelastic: else point contact. approximation: of the discrete solver. SAP
    ignores the scene's dissipation and takes relaxation times; as_in_scene: such that
    they damp as much, else those that Drake has if nobody sets them (0.1 s for each
    surface, 200 times as much)."""

    hydroelastic: bool = True
    approximation: str = "sap"
    as_in_scene: bool = True

    def relaxation(self, s: Setting) -> float | None:
        """[s] of each of two surfaces; a pair has the sum. Hunt and Crossley's
        k x (1 + d v) damps as k (x + tau v) with tau = d x, x the depth."""
        return 0.5 * s.dissipation * DEPTH if self.as_in_scene else None


class DrakeWorld:
    """As MujocoWorld, by a DrakeLaw. Friction of single pairs is that of what the
    ground, or the tool, is made of; no patch, no adhesion, no other stiffness."""

    def __init__(self, s: Setting, law: DrakeLaw | None = None):
        from pydrake.multibody.parsing import Parser
        from pydrake.multibody.plant import (
            AddMultibodyPlant,
            MultibodyPlantConfig,
        )
        from pydrake.systems.analysis import Simulator
        from pydrake.systems.framework import DiagramBuilder

        if s.patch or s.adhesion or s.springs or s.drag or s.force:
            raise ValueError("not in Drake's world")
        self.s = s = _with_ground(s)
        law = law or DrakeLaw()
        surfaces = law.hydroelastic, law.relaxation(s)
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlant(
            MultibodyPlantConfig(
                time_step=DRAKE_STEP, contact_model="hydroelastic_with_fallback",
                discrete_contact_approximation=law.approximation,
            ),
            builder,
        )  # fmt: skip
        self.plant, parser = plant, Parser(plant)
        parser.SetAutoRenaming(True)
        for t in s.things:
            (model,) = parser.AddModelsFromString(to_sdf(t, s, *surfaces), "sdf")
            if t.mass == 0.0:
                self._weld(plant, model, t)
        self.robot = None
        if s.robot is not None:
            (self.robot,) = parser.AddModelsFromString(robot_urdf(s, *surfaces), "urdf")
            base = plant.GetFrameByName("base", self.robot)
            plant.WeldFrames(plant.world_frame(), base)
        plant.Finalize()
        self.simulator = Simulator(builder.Build())
        self.context = self.simulator.get_mutable_context()
        self.own = plant.GetMyMutableContextFromRoot(self.context)
        self.joints = [] if s.robot is None else [
            plant.GetJointByName(b.joint, self.robot) for b in s.robot.moving
        ]  # fmt: skip
        self.port = plant.get_applied_generalized_force_input_port()
        self.simulator.Initialize()

    @staticmethod
    def _weld(plant, model, t: Thing) -> None:
        from pydrake.math import RigidTransform, RollPitchYaw

        body = plant.GetBodyByName(t.name, model)
        X = RigidTransform(RollPitchYaw(t.roll, t.pitch, 0.0), list(t.place))
        plant.WeldFrames(plant.world_frame(), body.body_frame(), X)

    def reset(self, q, poses) -> None:
        from pydrake.common.eigen_geometry import Quaternion
        from pydrake.math import RigidTransform
        from pydrake.multibody.math import SpatialVelocity

        self.context.SetTime(0.0)
        plant, own = self.plant, self.own
        start = plant.GetDefaultPositions()
        start[[j.position_start() for j in self.joints]] = q
        plant.SetPositions(own, start)
        plant.SetVelocities(own, np.zeros(plant.num_velocities()))
        for body, x in poses.items():
            b = plant.GetBodyByName(body.split(".")[1])
            X = RigidTransform(Quaternion(x[3:7] / np.linalg.norm(x[3:7])), x[:3])
            plant.SetFreeBodyPose(own, b, X)
            if len(x) == 13:
                V = SpatialVelocity(x[10:13], x[7:10])
                plant.SetFreeBodySpatialVelocity(own, b, V)
        self.port.FixValue(own, np.zeros(plant.num_velocities()))
        self.simulator.Initialize()

    def state(self):
        q = np.array([j.GetOnePosition(self.own) for j in self.joints])
        v = np.array([j.GetOneVelocity(self.own) for j in self.joints])
        return q, v

    def pose(self, body: str) -> np.ndarray:
        b = self.plant.GetBodyByName(body.split(".")[1])
        X = self.plant.EvalBodyPoseInWorld(self.own, b)
        return np.concatenate([X.translation(), X.rotation().ToQuaternion().wxyz()])

    def advance(self, effort, until: float) -> None:
        s, at = self.s, [j.velocity_start() for j in self.joints]
        n = max(round((until - self.context.get_time()) / DRAKE_STEP), 1)
        force = np.zeros(self.plant.num_velocities())
        hindered = s.robot is not None and (any(s.coulomb) or any(s.damping))
        begin = self.context.get_time()
        for k in range(n):
            if at:
                q, v = self.state()
                u = effort(self.context.get_time(), q, v)
                if hindered:
                    u = u - s.of_joints("coulomb") * np.tanh(v / 1e-3)
                    u = u - s.of_joints("damping") * v
                force[at] = u
                self.port.FixValue(self.own, force)
            self.simulator.AdvanceTo(begin + (k + 1) * (until - begin) / n)

    def wrench(self) -> np.ndarray:
        results = self.plant.get_contact_results_output_port().Eval(self.own)
        tool = self.plant.GetBodyByName(self.s.robot.bodies[-1].name, self.robot)
        total = np.zeros(3)
        for k in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(k)
            f = info.contact_force()
            total += f if info.bodyB_index() == tool.index() else 0.0
            total -= f if info.bodyA_index() == tool.index() else 0.0
        inspector = self.plant.EvalSceneGraphInspector(self.own)
        for k in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(k)
            f = info.F_Ac_W().translational()
            surface = info.contact_surface()
            for g, sign in ((surface.id_M(), 1.0), (surface.id_N(), -1.0)):
                frame = inspector.GetFrameId(g)
                if self.plant.GetBodyFromFrameId(frame).index() == tool.index():
                    total += sign * f
        return total


def _with_ground(s: Setting) -> Setting:
    """Friction of pairs as that of what is fixed, or of the tool that meets the first
    shape of a thing."""
    for (a, b), mu in s.friction.items():
        if s.robot is not None and s.tool is not None and s.tool_body in (a, b):
            free = [t for t in s.free if t.body in (a, b)]
            if free:
                theirs = free[0].shapes[0].friction
                s = replace(s, tool=replace(s.tool, friction=_own(mu, theirs)))
                continue
        for fixed, other in ((a, b), (b, a)):
            t = next((t for t in s.things if t.body == fixed and not t.mass), None)
            if t is None:
                continue
            # What lies on the ground are a thing's last shapes, its feet.
            feet = [u.shapes[-1].friction for u in s.things if u.body == other]
            low = feet[0] if feet else (s.tool.friction if s.tool else 0.0)
            own = _own(mu, low)
            shapes = tuple(replace(x, friction=own) for x in t.shapes)
            s = s.with_thing(t.name, shapes=shapes)
            break
        else:
            raise ValueError("Drake's world has friction of a pair with what is fixed")
    return replace(s, friction={})


def _own(mu: float, other: float) -> float:
    """The friction of a surface that makes mu with another one (pair_friction)."""
    if mu >= 2.0 * other:
        raise ValueError("no surface makes so much friction with it")
    return float(mu * other / (2.0 * other - mu))


WORLDS: dict[str, Callable] = {
    "mujoco": MujocoWorld,
    "drake": DrakeWorld,
    # Drake's own default solver, which keeps the scene's dissipation.
    "drake_lagged": partial(DrakeWorld, law=DrakeLaw(approximation="lagged")),
    "drake_point": partial(
        DrakeWorld, law=DrakeLaw(hydroelastic=False, approximation="lagged")
    ),
    "drake_damped": partial(DrakeWorld, law=DrakeLaw(as_in_scene=False)),
}


# ----- As a user has it


def _surface(
    friction: float, s: Setting, compliant=False, rigid=False,
    relaxation: float | None = None,
) -> str:  # fmt: skip
    hydro = ""
    if rigid:
        hydro = "<drake:rigid_hydroelastic/>"
    elif compliant:
        hydro = (
            "<drake:compliant_hydroelastic/><drake:hydroelastic_modulus>"
            f"{MODULUS}</drake:hydroelastic_modulus>"
        )
    if hydro:
        hydro += "<drake:mesh_resolution_hint>0.004</drake:mesh_resolution_hint>"
    if relaxation is not None:
        hydro += f"<drake:relaxation_time>{relaxation!r}</drake:relaxation_time>"
    return (
        f"<drake:proximity_properties>{hydro}<drake:mu_static>{float(friction)!r}"
        f"</drake:mu_static><drake:mu_dynamic>{float(friction)!r}</drake:mu_dynamic>"
        f"<drake:point_contact_stiffness>{2 * s.stiffness!r}"
        "</drake:point_contact_stiffness><drake:hunt_crossley_dissipation>"
        f"{s.dissipation!r}</drake:hunt_crossley_dissipation>"
        "</drake:proximity_properties>"
    )


def _geometry(x: Shape) -> tuple[str, np.ndarray]:
    place = np.array(x.place)
    if x.kind == "sphere":
        return f"<sphere><radius>{x.size[0]!r}</radius></sphere>", place
    if x.kind == "cylinder":
        return (
            f"<cylinder><radius>{x.size[0]!r}</radius><length>{2 * x.size[1]!r}"
            "</length></cylinder>"
        ), place
    if x.kind == "ground":
        return "<box><size>4 4 0.5</size></box>", place - [0.0, 0.0, 0.25]
    size = " ".join(repr(2.0 * float(h)) for h in x.size)
    return f"<box><size>{size}</size></box>", place


def to_sdf(
    t: Thing, s: Setting, compliant: bool = False, relaxation: float | None = None
) -> str:
    shapes = ""
    for i, x in enumerate(t.shapes):
        geometry, place = _geometry(x)
        at = " ".join(repr(float(p)) for p in (*place, *x.turn))
        rigid = compliant and t.mass == 0.0
        surface = _surface(x.friction, s, compliant, rigid, relaxation)
        shapes += (
            f'<collision name="shape{i}"><pose>{at}</pose><geometry>{geometry}'
            f"</geometry>{surface}</collision>"
        )
    inertial = ""
    if t.mass > 0.0:
        at = " ".join(repr(float(p)) for p in t.com)
        i = [float(x) for x in t.inertia]
        inertial = (
            f"<inertial><pose>{at} 0 0 0</pose><mass>{float(t.mass)!r}</mass><inertia>"
            f"<ixx>{i[0]!r}</ixx><iyy>{i[1]!r}</iyy><izz>{i[2]!r}</izz><ixy>0</ixy>"
            "<ixz>0</ixz><iyz>0</iyz></inertia></inertial>"
        )
    return (
        '<?xml version="1.0"?>\n<sdf version="1.9" xmlns:drake="http://drake.mit.edu">'
        f'<model name="{t.name}"><link name="{t.name}">{inertial}{shapes}</link>'
        "</model></sdf>\n"
    )


def robot_urdf(
    s: Setting, hydroelastic: bool = False, relaxation: float | None = None
) -> str:
    """The robot's URDF, its tool a shape of the last link."""
    assert s.robot is not None
    text = to_urdf(s.robot)
    if s.tool is None:
        return text
    x = s.tool
    if x.kind not in ("sphere", "box"):
        raise ValueError(f"a tool is a sphere or a box, not a {x.kind}")
    geometry = f'<sphere radius="{x.size[0]!r}"/>'
    if x.kind == "box":
        geometry = f'<box size="{_text(2.0 * np.array(x.size))}"/>'
    values = (("mu_static", x.friction), ("mu_dynamic", x.friction),
              ("point_contact_stiffness", 2 * s.stiffness),
              ("hunt_crossley_dissipation", s.dissipation))  # fmt: skip
    properties = "".join(f'<drake:{k} value="{v!r}"/>' for k, v in values)
    if hydroelastic:
        properties += (
            '<drake:rigid_hydroelastic/><drake:mesh_resolution_hint value="0.004"/>'
        )
    if relaxation is not None:
        properties += f'<drake:relaxation_time value="{relaxation!r}"/>'
    shape = (
        f'<collision name="tool"><origin xyz="{_text(x.place)}"/><geometry>'
        f"{geometry}</geometry><drake:proximity_properties>{properties}"
        "</drake:proximity_properties></collision>"
    )
    last = f'<link name="{s.robot.bodies[-1].name}">'
    head, tail = text.split(last)
    return head + last + tail.replace("</link>", shape + "</link>", 1)


def write_scene(
    folder: Path, s: Setting, table, noise, step: float, tolerance: Mapping[str, float]
) -> None:
    """scene.yaml, its models and the recording. `s` is the scene's, not the truth."""
    write_table(folder, table, noise)
    directives = ""
    for t in s.things:
        (folder / f"{t.name}.sdf").write_text(to_sdf(t, s))
        directives += f"  - add_model: {{name: {t.name}, file: {t.name}.sdf}}\n"
        if t.mass == 0.0:
            at = ", ".join(repr(float(x)) for x in t.place)
            directives += (
                f"  - add_weld:\n      parent: world\n      child: {t.name}::{t.name}\n"
                f"      X_PC: {{translation: [{at}]}}\n"
            )
    actuation = "  type: none\n"
    initial = ""
    if s.robot is not None:
        name = s.robot.model
        (folder / f"{name}.urdf").write_text(robot_urdf(s))
        directives += (
            f"  - add_model: {{name: {name}, file: {name}.urdf}}\n"
            f"  - add_weld: {{parent: world, child: {name}::base}}\n"
        )
        joints = ", ".join(s.robot.joints)
        actuation = f"  type: {s.drive}\n  joints: [{joints}]\n"
        if s.drive == "pd":
            gains = (list(map(float, x)) for x in (s.kp, s.kd))
            actuation += "  kp: {}\n  kd: {}\n".format(*gains)
        actuation += f"  hold: zero_order\n  rate_hz: {s.rate:g}\n"
        initial += "  positions:\n" + "".join(
            f"    {j}: {float(table[f'{j}.position'][0])!r}\n" for j in s.robot.joints
        )
    if s.free:
        initial += "  poses:\n"
    for t in s.free:
        first = [float(table[f"{t.body}.{a}"][0])
                 for a in ("qw", "qx", "qy", "qz", "x", "y", "z")]  # fmt: skip
        initial += f"    {t.body}: {first}\n"
    limits = "".join(f"  {k}: {v}\n" for k, v in tolerance.items())
    (folder / "scene.yaml").write_text(
        f"directives:\n{directives}plant:\n  time_step: {step}\n"
        "  contact_model: point\n  discrete_contact_approximation: lagged\n"
        f"  gravity: [0, 0, {-G}]\nactuation:\n{actuation}"
        + (f"initial:\n{initial}" if initial else "")
        + (f"tolerance:\n{limits}" if limits else "")
        + "effects: []\n"
    )


# ----- A recording


@dataclass(frozen=True)
class Sensing:
    """Noise, one sigma, and rates. effort: measured, in place of the commands."""

    camera_hz: float = 125.0
    place: float = 3e-4  # [m]
    turn: float = 1.5e-3  # [rad]
    encoder: float = 1e-5  # [rad or m]
    velocity: float = 2e-3
    wrench: float | None = 0.05  # [N]
    effort: float | None = None  # [N m or N]


@dataclass(frozen=True)
class Episode:
    """Start (q, poses of free things), and commands of a row: (t, q, v) -> (n,) of an
    effort drive, (2 n,) positions and their rates of a pd drive."""

    seconds: float
    q: np.ndarray
    poses: Mapping[str, np.ndarray]
    command: Callable


def record(s: Setting, world: str, episodes, sense: Sensing, rng):
    """A table {column: (n,)}, {channel: noise}."""
    simulated = WORLDS[world](s)
    robot, n = s.robot, 0 if s.robot is None else len(s.robot.joints)
    gain = s.of_joints("gain") if robot else np.zeros(0)
    tables = []
    for number, e in enumerate(episodes):
        t = np.arange(int(e.seconds * s.rate)) / s.rate
        simulated.reset(e.q, e.poses)
        kept: dict[str, list] = {k: [] for k in ("q", "v", "c", "u", "f")}
        poses: dict[str, list] = {thing.body: [] for thing in s.free}
        for i in range(len(t)):
            q, v = simulated.state()
            c = np.asarray(e.command(t[i], q, v), float)
            for thing in s.free:
                poses[thing.body].append(simulated.pose(thing.body))
            if n and sense.wrench is not None:
                kept["f"].append(simulated.wrench())

            def effort(at, q, v, c=c, command=e.command):
                if s.smooth:
                    c = command(at, q, v)
                if s.drive == "effort":
                    return gain * c
                return gain * (s.kp * (c[:n] - q) + s.kd * (c[n:] - v))

            for key, x in (("q", q), ("v", v), ("c", c), ("u", effort(t[i], q, v))):
                kept[key].append(x)
            if i + 1 < len(t):
                simulated.advance(effort, float(t[i + 1]))
        tables.append(_measured(s, t, number, kept, poses, sense, rng))
    table = {k: np.concatenate([e[k] for e in tables]) for k in tables[0]}
    return table, _noise(s, table, sense)


def _measured(s: Setting, t, number: int, kept, poses, sense: Sensing, rng):
    table = {"time": t, "episode": np.full(len(t), number)}
    rows = {key: np.array(x) for key, x in kept.items()}
    n = 0 if s.robot is None else len(s.robot.joints)

    def noisy(x, size):
        return x + size * rng.normal(size=len(t))

    for i in range(n):
        assert s.robot is not None
        joint = s.robot.joints[i]
        table[f"{joint}.position"] = noisy(rows["q"][:, i], sense.encoder)
        table[f"{joint}.velocity"] = noisy(rows["v"][:, i], sense.velocity)
        if sense.effort is not None:
            table[f"{joint}.effort_measured"] = noisy(rows["u"][:, i], sense.effort)
        elif s.drive == "effort":
            table[f"{joint}.effort_command"] = rows["c"][:, i]
        else:
            table[f"{joint}.position_command"] = rows["c"][:, i]
            table[f"{joint}.velocity_command"] = rows["c"][:, n + i]
    seen = np.arange(len(t)) % max(round(s.rate / sense.camera_hz), 1) == 0
    for body, each in poses.items():
        x = np.array(each)
        for i, axis in enumerate("xyz"):
            table[f"{body}.{axis}"] = np.where(
                seen, noisy(x[:, i], sense.place), np.nan
            )
        half = 0.5 * sense.turn * rng.normal(size=(len(t), 3))
        w, vector = x[:, 3:4], x[:, 4:7]
        turned = np.column_stack([
            w[:, 0] - np.sum(half * vector, axis=1),
            vector + w * half + np.cross(half, vector),
        ])  # fmt: skip
        turned /= np.linalg.norm(turned, axis=1)[:, None]
        for i, axis in enumerate("wxyz"):
            table[f"{body}.q{axis}"] = np.where(seen, turned[:, i], np.nan)
    if n and sense.wrench is not None:
        for i, axis in enumerate("xyz"):
            table[f"{s.tool_body}.f{axis}"] = noisy(rows["f"][:, i], sense.wrench)
    return table


def _noise(s: Setting, table, sense: Sensing) -> dict[str, float]:
    sizes = {"position": sense.encoder, "velocity": sense.velocity,
             "effort_measured": sense.effort or 0.0}  # fmt: skip
    sizes |= {f"f{a}": sense.wrench or 0.0 for a in "xyz"}
    sizes |= {a: sense.place for a in "xyz"}
    sizes |= {f"q{a}": 0.5 * sense.turn for a in "wxyz"}
    ends = {name: name.rsplit(".", 1)[-1] for name in table}
    return {name: sizes[end] for name, end in ends.items() if end in sizes}

"""The arm's 1 kHz controller: a Cartesian spring and damper at the tool's tip."""

import math
from dataclasses import dataclass, field
from operator import attrgetter

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JointActuator, PrismaticJoint, RevoluteJoint
from pydrake.systems.framework import Context, LeafSystem

from makebreak.systems.arm.numerics.impedance_controller import (
    SPEED_FILTER_SEC,
    ForceLaw,
    Law,
    memory_size,
    tick,
    warm_up,
)
from makebreak.systems.arm.numerics.joint_friction import NO_LAWS
from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.serial_chain import SerialChain, chain_state
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.joint_laws import JointLaws
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

# Largest damping over (mass of the tip / delay). Damping alone is unstable above pi/2;
# a third of that leaves a margin for the spring.
DELAY_DAMPING_MAX = 0.5


@dataclass
class PostureConfig:
    """What holds the posture of an arm that has more joints than its tool needs."""

    # Stiffness of the posture, in the null space, per unit of inertia [1/s2].
    stiffness: float = 100.0
    # Damping of the posture, in the null space, per unit of inertia [1/s].
    damping: float = 20.0


@dataclass
class ImpedanceConfig:
    """Settings of ImpedanceController: stiffness, damping, limits, posture."""

    # Stiffness along x, y, z [N/m] and about x, y, z [N m/rad]; not used where a
    # variable impedance is connected.
    stiffness: list[float] = field(default_factory=lambda: [1000.0] * 3 + [50.0] * 3)
    # Damping along x, y, z [N s/m] and about x, y, z [N m s/rad]; not used with a
    # damping ratio, or where another system gives the damping.
    damping: list[float] = field(default_factory=lambda: [400.0] * 3 + [15.0] * 3)
    # Whether the tool's orientation is controlled too; false: position only, and the
    # posture keeps the tool upright.
    control_orientation: bool = False
    force_max: float = math.inf  # Largest force of spring and damper together [N].
    # Energy that rises of a variable stiffness may take before the damping has taken
    # out more [J]; inf: any, the stiffness is used as it is asked for.
    energy_tank: float = 0.02
    posture: PostureConfig = field(default_factory=PostureConfig)
    period_sec: float = 0.001  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


@dataclass
class HybridConfig:
    """Force control, and damping that follows the stiffness."""

    # Damping ratio: D = 2 damping_ratio sqrt(K lambda_i), with lambda_i the tip's mass
    # along each axis; 0: the damping of ImpedanceConfig. A connected port `damping`
    # replaces both.
    damping_ratio: float = 0.0
    integral_gain: float = 0.5  # Gain k_i of the integral of the force error [1/s].
    integral_max: float = 8.0  # Largest force of the integral [N].
    # Least damping D_n along a direction of force control [N s/m].
    normal_damping: float = 200.0
    # Largest speed at which force control closes a gap: D_n is at least F_c over it
    # [m/s].
    closing_speed: float = 0.012
    ramp_sec: float = 0.1  # Time in which the force rises to its target [s].
    # Time in which a direction of force control that is dropped fades out [s].
    release_sec: float = 0.12


class ImpedanceController(LeafSystem):
    """Joint torques that make the tool's tip E a spring and damper, with force control
    along up to two directions n.

        F = S (K (x_d - x) + D (v_d - v)) + f_fc + f_ff + Lambda (S a_d - Jdot qdot)
        S = I - sum n n',  f_fc = sum n (F_c + k_i integral (F_c - F) dt - D_n n'v)
        tau = J' F + bias + posture in the dynamically consistent null space of J

    K (x_d - x) + D (v_d - v) is shortened to force_max. Two directions that are not
    orthogonal are made so, keeping the first one. F_c rises in ramp_sec;
    D_n >= F_c / closing_speed bounds the speed at which a lost contact is closed again.
    Where less than 0.5 N is measured for 0.2 s, the integral brings the tip back, no
    faster than closing_speed. It is kept if the next segment has (nearly) the same
    n. A dropped n fades out over release_sec while the stiffness along it returns.

    With `control_orientation` False the task is the tip's position; the posture keeps
    the tool's orientation as at the control plant's default positions. With True the
    task is the full pose.
    tau is the motors' torque: the mass matrix contains the rotors' inertia. The plant's
    joint damping and the forces in the joints of `laws` are compensated by the
    reference's velocity (numerics/joint_friction.py).

    A variable stiffness rises only as far as an energy tank can pay for it
    (numerics/energy_tank.py); its level is in the Context.

    tau stays within the effort limits of the control plant and changes by at most
    torque_rate_max x period per tick. Near the control plant's limits of joint speeds
    and positions the joints brake (numerics/joint_limits.py). If an entry of q or v is
    NaN, tau changes, at that rate, to the torque that carries the arm and slows it
    down, qdd = -20/s qd, with the measured entries and predictions of the others from
    their last good values.
    If the reference is NaN, the last good pose is held at rest. A stiffness or damping
    that is NaN or negative is replaced by the config's, a delay that is no time by 0.
    `status` reports these cases.

    Inputs:  q (n,) [rad], v (n,) [rad/s]; x_desired (19,) = [p_WE 3, quaternion wxyz 4,
             v 3, w 3, a 3, alpha 3] of E in the world. Optional:
             stiffness (6,), damping (6,): replace the config's;
             wrench_feedforward (6,), force first [N], [N m] (the torque acts only if
             the orientation is controlled);
             force_directions (6,): two rows n, unit vectors into the surface, zero for
             none; force_targets (2,): F_c [N]; wrench_measured (6,): on the tool [N],
             [N m]. Without it, or while it is NaN, F_c is only fed forward;
             damping_stiffness (6,): with a damping ratio, the stiffness from which the
             damping is computed, instead of `stiffness`;
             delay (1,) [s]: from a reading to the time when its torque acts. Damping d
             of a mass m with this delay is stable while d delay < pi/2 m, so the tip's
             damping is bounded to DELAY_DAMPING_MAX m / delay.
    Outputs: tau (n,) [N m], in the order of q (that of a plant's actuation port is the
             order of its actuators, which may be another); status (1,), a sum: 1
             reference held, 2 sensors held, 4 effort limit reached, 8 torque rate limit
             reached, 16 wrench not used, 32 a joint braked at its speed or range.

    Args: config; plant: finalized, the arm with its tool alone, never the simulated
        one; tip_frame: name of E; torque_rate_max [N m/s], of a prismatic joint [N/s];
        hybrid: settings of force control and damping; laws: forces in the arm's joints
        beside the plant's own damping, which are compensated too.
    Raises: ValueError for a plant that is not one chain of revolute and prismatic
        joints with a motor each, or a setting out of range.
    """

    def __init__(
        self,
        config: ImpedanceConfig,
        plant: MultibodyPlant,
        tip_frame: str = "tip",
        torque_rate_max: float = 1000.0,
        hybrid: HybridConfig | None = None,
        laws: JointLaws | None = None,
    ):
        super().__init__()
        check_settings(config)
        hybrid = HybridConfig() if hybrid is None else hybrid
        check_settings(hybrid)
        for name, number in vars(hybrid).items():
            least = name in ("closing_speed", "ramp_sec", "release_sec")
            if not (number > 0.0 if least else number >= 0.0):
                raise ValueError(
                    f"{name} is {number}, expected {'> 0' if least else '0 or more'}"
                )
        for name in ("stiffness", "damping"):
            gains = np.asarray(getattr(config, name), dtype=float)
            if gains.shape != (6,) or not np.all(gains >= 0.0):
                raise ValueError(f"{name} is {gains}, expected 6 numbers of 0 or more")
        for name in ("energy_tank", "posture.stiffness", "posture.damping"):
            if not (number := attrgetter(name)(config)) >= 0.0:
                raise ValueError(f"{name} is {number}, expected >= 0")
        for name, number in (
            ("force_max", config.force_max),
            ("period_sec", config.period_sec),
            ("torque_rate_max", torque_rate_max),
        ):
            if not number > 0.0:
                raise ValueError(f"{name} is {number}, expected > 0")
        self._chain = serial_chain_of(plant, tip_frame)
        self._tau_size = plant.num_positions()
        context = plant.CreateDefaultContext()
        n = plant.num_positions()
        q_nominal = plant.GetPositions(context)
        frame = plant.GetFrameByName(tip_frame)
        self._law = Law(
            effort_max=plant.GetEffortUpperLimits()[_actuator_order(plant)],
            step_max=np.full(n, torque_rate_max * config.period_sec),
            q_lower=plant.GetPositionLowerLimits(),
            q_upper=plant.GetPositionUpperLimits(),
            speed_max=np.minimum(
                plant.GetVelocityUpperLimits(), -plant.GetVelocityLowerLimits()
            ),
            q_nominal=q_nominal,
            R_upright=np.ascontiguousarray(
                frame.CalcPoseInWorld(context).rotation().matrix()
            ),
            stiffness=np.array(config.stiffness, dtype=float),
            damping=np.array(config.damping, dtype=float),
            force_max=float(config.force_max),
            tank=float(config.energy_tank),
            posture_stiffness=float(config.posture.stiffness),
            posture_damping=float(config.posture.damping),
            posture_every=max(1, round(0.012 / config.period_sec)),
            control_orientation=bool(config.control_orientation),
            period=float(config.period_sec),
            force=ForceLaw(
                integral_gain=float(hybrid.integral_gain),
                integral_max=float(hybrid.integral_max),
                normal_damping=float(hybrid.normal_damping),
                closing_speed=float(hybrid.closing_speed),
                ramp_sec=float(hybrid.ramp_sec),
                release_sec=float(hybrid.release_sec),
                speed_keep=float(np.exp(-config.period_sec / SPEED_FILTER_SEC)),
            ),
            laws=laws if laws is not None and len(laws.kind) else NO_LAWS,
        )
        self._ratio = float(hybrid.damping_ratio)
        self._packed = packed(self._chain), packed(self._law)
        first_call(warm_up, *self._packed, n)
        self._q = self.DeclareVectorInputPort("q", n)
        self._v = self.DeclareVectorInputPort("v", n)
        self._x_desired = self.DeclareVectorInputPort("x_desired", 19)
        self._stiffness = self.DeclareVectorInputPort("stiffness", 6)
        self._damping = self.DeclareVectorInputPort("damping", 6)
        self._wrench = self.DeclareVectorInputPort("wrench_feedforward", 6)
        self._directions = self.DeclareVectorInputPort("force_directions", 6)
        self._targets = self.DeclareVectorInputPort("force_targets", 2)
        self._measured = self.DeclareVectorInputPort("wrench_measured", 6)
        self._damped = self.DeclareVectorInputPort("damping_stiffness", 6)
        self._delay = self.DeclareVectorInputPort("delay", 1)
        at_rest = chain_state(self._chain, q_nominal, np.zeros(n))
        mobility = at_rest.J[:3] @ np.linalg.solve(at_rest.M, at_rest.J[:3].T)
        with np.errstate(divide="ignore"):  # Infinite where the arm cannot move it.
            self._mass = 1.0 / np.diag(mobility)  # Of the tip along each axis [kg].
        # The initial torque carries the arm at its nominal position.
        carrying = chain_state(self._chain, q_nominal, np.zeros(n)).bias
        self._tau = self.DeclareDiscreteState(carrying)
        self._status = self.DeclareDiscreteState(1)
        self._memory = self.DeclareDiscreteState(memory_size(n))
        self._none, self._no_targets = np.zeros(6), np.zeros(2)
        self._no_wrench = np.zeros(0)
        self.DeclareStateOutputPort("tau", self._tau)
        self.DeclareStateOutputPort("status", self._status)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def start_at(self, context: Context, q) -> None:
        """Sets the state in a Context of this system: a torque that carries the arm at
        q (n,) [rad], and an empty memory."""
        n = self._tau_size
        q = np.array(q, dtype=float)
        carrying = chain_state(self._chain, q, np.zeros(n)).bias
        context.SetDiscreteState(self._tau, carrying)
        context.SetDiscreteState(self._memory, np.zeros(memory_size(n)))

    @timed
    def _update(self, context: Context, discrete_state):
        stiffness = self._or(self._stiffness, context, self._law.stiffness)
        ratio = self._ratio
        if self._damping.HasValue(context):
            damping, ratio = self._damping.Eval(context), 0.0
        elif ratio > 0.0:
            damping = self._or(self._damped, context, stiffness)
        else:
            damping = self._law.damping
        delay = 0.0
        if self._delay.HasValue(context):
            delay = float(self._delay.Eval(context)[0])
        if ratio == 0.0 and self._law.period < delay < math.inf:  # Each tick has one.
            damping = np.array(damping)
            most = DELAY_DAMPING_MAX * self._mass / delay
            damping[:3] = np.minimum(damping[:3], most)
        directions, targets = self._none, self._no_targets
        measured = self._no_wrench
        if self._directions.HasValue(context):  # Otherwise there is no force control.
            directions = self._directions.Eval(context)
            targets = self._or(self._targets, context, self._no_targets)
            measured = self._or(self._measured, context, self._no_wrench)
        status = tick(
            *self._packed,
            discrete_state.get_mutable_value(self._tau),
            discrete_state.get_mutable_value(self._memory),
            self._q.Eval(context),
            self._v.Eval(context),
            self._x_desired.Eval(context),
            stiffness,
            damping,
            ratio,
            self._or(self._wrench, context, self._none),
            directions,
            targets,
            measured,
            delay,
        )
        discrete_state.set_value(self._status, [status])

    def _or(self, port, context, otherwise):
        return port.Eval(context) if port.HasValue(context) else otherwise


def _actuator_order(plant: MultibodyPlant) -> list[int]:
    """Index of each joint's actuator, in the order of the joints' positions."""
    by_start = {
        actuator.joint().position_start(): i
        for i, actuator in enumerate(_motors(plant))
    }
    return [by_start[i] for i in range(plant.num_positions())]


def _motors(plant: MultibodyPlant) -> list[JointActuator]:
    return [
        plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()
    ]


def serial_chain_of(plant: MultibodyPlant, tip_frame: str) -> SerialChain:
    """The constants of an arm: one chain of revolute and prismatic joints with a motor
    each.

    Args: plant: finalized; tip_frame: name of a frame on the last link or on a body
        welded to it.
    Raises: ValueError for any other plant.
    """
    moving = [
        joint
        for joint in (plant.get_joint(i) for i in plant.GetJointIndices())
        if joint.num_velocities() > 0
    ]
    moving.sort(key=lambda joint: joint.position_start())
    motors = _motors(plant)
    motor_of = {motor.joint().index(): motor for motor in motors}
    welded_to = [plant.GetBodiesWeldedTo(joint.child_body()) for joint in moving]
    before = [plant.GetBodiesWeldedTo(plant.world_body()), *welded_to[:-1]]
    for joint, parents in zip(moving, before, strict=True):
        name = joint.name()
        if not isinstance(joint, RevoluteJoint | PrismaticJoint):
            raise ValueError(
                f"joint {name!r} is {joint.type_name()}, expected a revolute or "
                "prismatic one; the law needs an arm"
            )
        if joint.parent_body() not in parents:
            raise ValueError(f"joint {name!r} does not continue the chain before it")
        if joint.index() not in motor_of:
            raise ValueError(f"joint {name!r} has no actuator")
    if not moving:
        raise ValueError("the control plant has no joint that moves")
    if not plant.HasFrameNamed(tip_frame):
        raise ValueError(f"the control plant has no frame {tip_frame!r}")
    tip = plant.GetFrameByName(tip_frame)
    if tip.body() not in welded_to[-1]:
        raise ValueError(f"frame {tip_frame!r} is not on the last link")

    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.zeros(plant.num_positions()))
    X_WJ = [joint.frame_on_child().CalcPoseInWorld(context) for joint in moving]
    R_PJ, p_PJ, mass, p_com, I_com = [], [], [], [], []
    for i, (joint, bodies) in enumerate(zip(moving, welded_to, strict=True)):
        X_PJ = X_WJ[0] if i == 0 else X_WJ[i - 1].inverse() @ X_WJ[i]
        R_PJ.append(X_PJ.rotation().matrix())
        p_PJ.append(X_PJ.translation())
        inertia = plant.CalcSpatialInertia(
            context, joint.frame_on_child(), [body.index() for body in bodies]
        )
        mass.append(inertia.get_mass())
        p_com.append(inertia.get_com())
        about_com = inertia.Shift(inertia.get_com()).CalcRotationalInertia()
        I_com.append(about_com.CopyToFullMatrix3())
    X_LE = X_WJ[-1].inverse() @ tip.CalcPoseInWorld(context)
    rotor = [
        motor_of[joint.index()].default_rotor_inertia()
        * motor_of[joint.index()].default_gear_ratio() ** 2
        for joint in moving
    ]
    return SerialChain(
        R_PJ=np.array(R_PJ),
        p_PJ=np.array(p_PJ),
        slides=np.array([float(isinstance(j, PrismaticJoint)) for j in moving]),
        axis=np.array(
            [
                joint.translation_axis()
                if isinstance(joint, PrismaticJoint)
                else joint.revolute_axis()
                for joint in moving
            ]
        ),
        mass=np.array(mass),
        p_com=np.array(p_com),
        I_com=np.array(I_com),
        rotor=np.array(rotor),
        damping=np.array([joint.default_damping() for joint in moving]),
        gravity=np.array(plant.gravity_field().gravity_vector(), dtype=float),
        R_LE=np.ascontiguousarray(X_LE.rotation().matrix()),
        p_LE=np.array(X_LE.translation()),
    )

"""Effects between a motor and its joint: elasticity, backlash.

The motor gets a degree of freedom of its own: a massless body on the joint's parent
that turns about the joint's axis, with the rotor's reflected inertia; a force couples
it to the joint. It is a separate model instance, `motor_of_<model>_<joint>`, so that
the mechanism's part of the state keeps its layout. The motor torque acts on it
(actuation_path.py), and position and velocity are measured at it, unless the scene's
channels say `link`.
"""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numba
import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Joint,
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
)
from pydrake.systems.framework import (
    BasicVector,
    DiagramBuilder,
    LeafSystem,
    OutputPort,
)
from scipy.optimize import brentq

from makebreak.models.effects.kind import (
    MOTOR_OF,
    Effect,
    EffectKind,
    Parameter,
    actuator_of,
    find_joints,
    full_name,
)
from makebreak.models.effects.signature import Signature, without_momentum
from makebreak.systems.numerics.smoother import smooth

# Rotor inertia over the joint's inertia, where the model has no rotor [-].
ROTOR_SHARE = 0.01
# Natural frequency of motor and joint against each other while a backlash gap is
# closed: radians per time step of a discrete plant, and at most [rad/s].
CONTACT_RATE, CONTACT_RATE_MAX = 0.3, 2000.0
CONTACT_DAMPING = 0.3  # Its damping ratio, where no restitution is given.


def motor_model(plant: MultibodyPlant, joint: Joint) -> str:
    """Name of the model instance of the joint's motor."""
    return f"{MOTOR_OF}{full_name(plant, joint).replace('.', '_')}"


def motor_joint(plant: MultibodyPlant, joint: Joint) -> Joint | None:
    """The joint of the motor; None unless it drives through an elastic element."""
    name = motor_model(plant, joint)
    if not plant.HasModelInstanceNamed(name):
        return None
    return plant.GetJointByName(joint.name(), plant.GetModelInstanceByName(name))


def _add_motor(effect: Effect, plant: MultibodyPlant, scene_graph) -> None:
    for joint in find_joints(effect, plant):
        name = motor_model(plant, joint)
        if plant.HasModelInstanceNamed(name):
            raise ValueError(
                f"effect {effect.kind} at {effect.at}: {full_name(plant, joint)} is "
                "driven through an elastic element already"
            )
        instance = plant.AddModelInstance(name)
        motor = plant.AddRigidBody("motor", instance, SpatialInertia.Zero())
        frames = joint.frame_on_parent(), motor.body_frame()
        if isinstance(joint, RevoluteJoint):
            own = plant.AddJoint(
                RevoluteJoint(joint.name(), *frames, joint.revolute_axis())
            )
        else:
            assert isinstance(joint, PrismaticJoint)
            own = plant.AddJoint(
                PrismaticJoint(joint.name(), *frames, joint.translation_axis())
            )
        own.set_default_positions(joint.default_positions())
        old = actuator_of(plant, joint)
        limit = np.inf if old is None else old.effort_limit()
        new = plant.AddJointActuator(f"{joint.name()}_motor", own, limit)
        if old is not None:
            new.set_default_gear_ratio(old.default_gear_ratio())
            new.set_default_rotor_inertia(old.default_rotor_inertia())
            old.set_default_rotor_inertia(0.0)
        if new.default_reflected_inertia() == 0.0:
            rotor = ROTOR_SHARE * _inertia(plant, joint)
            new.set_default_gear_ratio(1.0)
            new.set_default_rotor_inertia(rotor)


def _inertia(plant: MultibodyPlant, joint: Joint) -> float:
    """Rough inertia that the joint moves, before Finalize: that of all bodies outboard
    of it about its axis, at zero positions [kg m2]; a prismatic joint: mass [kg]."""
    children: dict = {}
    for each in (plant.get_joint(i) for i in plant.GetJointIndices()):
        children.setdefault(each.parent_body().index(), []).append(each)
    axis = (
        joint.revolute_axis()
        if isinstance(joint, RevoluteJoint)
        else joint.translation_axis()
    )
    X_MB = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
    # Outboard bodies and their poses in frame M, the joint's frame on its child.
    todo, total = [(joint.child_body(), X_MB)], 0.0
    while todo:
        body, X = todo.pop()
        M = body.default_spatial_inertia()
        if isinstance(joint, PrismaticJoint):
            total += M.get_mass()
        else:
            com = X.multiply(M.get_com())
            about = M.CalcRotationalInertia().CopyToFullMatrix3()
            mass, p = M.get_mass(), M.get_com()
            central = about - mass * (p @ p * np.eye(3) - np.outer(p, p))
            R = X.rotation().matrix()
            across = com - axis * (axis @ com)
            total += axis @ R @ central @ R.T @ axis + mass * across @ across
        for each in children.get(body.index(), []):
            X_BF = each.frame_on_parent().GetFixedPoseInBodyFrame()
            X_CM = each.frame_on_child().GetFixedPoseInBodyFrame()
            todo.append((each.child_body(), X @ X_BF @ X_CM.inverse()))
    return total


class Coupling(LeafSystem):
    """The force between motor and joint, with twist = q_motor - q_joint:

        k deadzone(twist, gap/2) + d (v_motor - v_joint) while the gap is closed

    on the joint, and its opposite on the motor. With a gap the damping fades in over
    a penetration of 0.001 gap, and the force never pulls.

    Inputs:  state (n_x,) of the plant.
    Outputs: generalized_force (n_v,).

    Numeric parameter 0 of the Context: k [N m/rad], d [N m s/rad], gap [rad].
    """

    def __init__(self, plant: MultibodyPlant, pairs, numbers):
        super().__init__()
        n_q, self._n_v = plant.num_positions(), plant.num_velocities()
        joints, motors = zip(*pairs, strict=True)
        self._q = [np.array([j.position_start() for j in x]) for x in (joints, motors)]
        self._v = [np.array([j.velocity_start() for j in x]) for x in (joints, motors)]
        self._n_q = n_q
        self._state = self.DeclareVectorInputPort("state", n_q + self._n_v)
        self._numbers = self.DeclareNumericParameter(BasicVector(np.ravel(numbers)))
        self.DeclareVectorOutputPort("generalized_force", self._n_v, self._calc)

    def set_numbers(self, context, numbers) -> None:
        context.get_mutable_numeric_parameter(self._numbers).SetFromVector(
            np.ravel(numbers)
        )

    def _calc(self, context, output):
        x = self._state.Eval(context)
        k, d, gap = (
            context.get_numeric_parameter(self._numbers).value().reshape(-1, 3).T
        )
        q, v = x[: self._n_q], x[self._n_q :]
        twist = q[self._q[1]] - q[self._q[0]]
        rate = v[self._v[1]] - v[self._v[0]]
        pressed = np.sign(twist) * np.maximum(abs(twist) - gap / 2.0, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            fade = np.where(gap > 0.0, np.minimum(abs(pressed) / (1e-3 * gap), 1.0), 1)
        force = k * pressed + d * fade * rate
        # The sides of a gap cannot pull.
        force = np.where((gap > 0.0) & (force * pressed <= 0.0), 0.0, force)
        out = np.zeros(self._n_v)
        out[self._v[0]] += force
        out[self._v[1]] -= force
        output.SetFromVector(out)


def restitution_of(damping: float) -> float:
    """Coefficient of restitution of an impact on a spring and damper that never pull,
    by their damping ratio (Schwager and Poeschel, Phys. Rev. E 78, 051304, 2008)."""
    b, w = damping, np.sqrt(max(1.0 - damping**2, 1e-12))
    turn = np.arctan2(2.0 * b * w, w**2 - b**2)
    return float(np.exp(-b / w * (np.pi - turn)))


def damping_of(restitution: float) -> float:
    """The damping ratio for a restitution: the inverse of restitution_of, at most
    0.999 (a restitution below 1/6)."""
    if restitution <= restitution_of(0.999):
        return 0.999
    return float(brentq(lambda d: restitution_of(d) - restitution, 0.0, 0.999))


def _restitution(effect: Effect) -> float:
    """Speed after over speed before an impact on the side of the gap."""
    default = restitution_of(CONTACT_DAMPING)
    return effect.parameters.get("restitution", default)


def coupling_numbers(effect: Effect, plant: MultibodyPlant) -> list[list[float]]:
    """[k, d, gap] of each joint that `at` names, as in Coupling."""
    p, numbers = effect.parameters, []
    for joint in find_joints(effect, plant):
        if effect.kind == "joint_elasticity":
            numbers.append([p["stiffness"], p["damping"], 0.0])
            continue
        # Stiff enough for the gap to dominate, soft enough for the time step.
        dt = plant.time_step()
        rate = min(CONTACT_RATE / dt, CONTACT_RATE_MAX) if dt else CONTACT_RATE_MAX
        motor = motor_joint(plant, joint)
        assert motor is not None
        context = plant.CreateDefaultContext()
        M = plant.CalcMassMatrix(context)
        i, j = joint.velocity_start(), motor.velocity_start()
        both = 1.0 / (np.linalg.inv(M)[i, i] + 1.0 / M[j, j])
        k = both * rate**2
        damping = damping_of(_restitution(effect))
        numbers.append([k, 2.0 * damping * np.sqrt(k * both), p["gap"]])
    return numbers


def coupling_name(effect: Effect) -> str:
    """Name of the Coupling system in the diagram."""
    return f"{effect.kind}_{'_'.join(effect.at)}".replace(".", "_")


def _add_coupling(
    effect: Effect, plant: MultibodyPlant, scene_graph, builder: DiagramBuilder
) -> OutputPort:
    joints = find_joints(effect, plant)
    pairs = [(joint, motor_joint(plant, joint)) for joint in joints]
    system = builder.AddNamedSystem(
        coupling_name(effect), Coupling(plant, pairs, coupling_numbers(effect, plant))
    )
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("state"))
    return system.GetOutputPort("generalized_force")


# ----- Their signatures
#
# The motor follows the measured motion theta, the joint lags behind by the twist z.
# With rotor inertia J, and ID of the model, which has the rotor on the joint,
#
#     u = ID(theta - z) + J z'',
#
# to first order in z. The element transmits tau = u - J theta''. A spring twists by
# z = tau/k - d tau'/k^2. In a gap, T = ID(theta) - J theta'' is the torque that holds
# the joint on the motor's path, and its sign gives the side that touches: z = +- gap/2.
# When T changes sign the joint moves freely, M z'' = T, until it hits the other side,
# where it bounces with the restitution or comes to rest.

RESTITUTIONS = (None, 0.1, 0.75)  # Tried values; None: that of CONTACT_DAMPING.
GAPS = tuple(0.002 * 1.15**k for k in range(29))  # Tried values [rad] or [m].
_by_motion: WeakKeyDictionary = WeakKeyDictionary()  # Intermediate results.


@dataclass(frozen=True, eq=False)
class _Linear:
    """The inverse dynamics along a motion, linearised in the twist of one joint.

    derivative (n, n_v, 3): of the effort by twist, its rate and its acceleration;
    torque (n,): T; M (n,): the joint's inertia with the other joints held.
    """

    derivative: np.ndarray
    torque: np.ndarray
    M: np.ndarray

    def effort(self, twist) -> np.ndarray:
        """(n, n_v) that a twist (3, n) with its derivatives adds."""
        return np.einsum("nik,kn->ni", self.derivative, twist)


def _elasticity_signature(effect, model, motion, grid=None) -> list[Signature]:
    columns = np.zeros((*motion.v.shape, 2))
    for joint in find_joints(effect, model.plant):
        linear = _linear(model, motion, joint)
        twist = _transmitted(model, motion, joint)
        columns[:, :, 0] += linear.effort(twist[:3])
        columns[:, :, 1] -= linear.effort(twist[1:])

    def to_parameters(c):
        k = 1.0 / max(c[0], 1e-9)  # A compliance of 0 or less: rigid.
        return {"stiffness": float(k), "damping": float(max(c[1], 0.0) * k**2)}

    unknowns = ("compliance", "damping_times_compliance2")
    return [
        without_momentum(
            effect, unknowns, columns, to_parameters=to_parameters, exact=False
        )
    ]


def _elasticity_added(effect, model, motion) -> np.ndarray:
    """Of the whole twist, not linearised."""
    k, d = effect.parameters["stiffness"], effect.parameters["damping"]
    known = _cache(model, motion)
    key = (tuple(effect.at), k, d)
    if key in known:
        return known[key]
    q, v, vd = (np.array(x) for x in (motion.q, motion.v, motion.vd))
    rotor = np.zeros_like(v)
    for joint in find_joints(effect, model.plant):
        i_q, i_v = joint.position_start(), joint.velocity_start()
        z = _twist(effect, model, motion, joint)
        q[:, i_q] -= z[0]
        v[:, i_v] -= z[1]
        vd[:, i_v] -= z[2]
        rotor[:, i_v] = _rotor(model, joint) * z[2]
    if "rigid" not in known:
        known["rigid"] = model.inverse_dynamics(
            motion.q, motion.v, motion.vd, motion.time
        )
    rigid = known["rigid"]
    known[key] = model.inverse_dynamics(q, v, vd, motion.time) + rotor - rigid
    return known[key]


def _cache(model, motion) -> dict:
    """Intermediate results for a motion, dropped with it."""
    known = _by_motion.setdefault(motion, {}).setdefault(id(model), {})
    if len(known) > 200:
        known.clear()
    return known


def _backlash_signature(effect, model, motion, grid=None) -> list[Signature]:
    """One signature for each gap and restitution tried: the effort that the gap adds,
    divided by it, so that the coefficient is the gap."""
    found = []
    grid = grid or {}
    tried = grid.get("restitution", () if "gap" in grid else RESTITUTIONS) or (None,)
    for restitution in tried:
        held = {} if restitution is None else {"restitution": float(restitution)}
        for gap in grid.get("gap", GAPS):
            one = Effect(effect.kind, effect.at, {"gap": float(gap), **held})
            columns = _backlash_added(one, model, motion)[:, :, None] / gap
            found.append(without_momentum(effect, ["gap"], columns, held, exact=False))
    return found


def _backlash_added(effect, model, motion) -> np.ndarray:
    out = np.zeros_like(motion.v)
    for joint in find_joints(effect, model.plant):
        twist = _twist(effect, model, motion, joint)
        out += _linear(model, motion, joint).effort(twist)
    return out


def twists(effect: Effect, model, motion) -> dict[str, np.ndarray]:
    """{joint: (3, n)} twist, its rate and acceleration at the times of a motion."""
    return {
        full_name(model.plant, joint): _twist(effect, model, motion, joint)
        for joint in find_joints(effect, model.plant)
    }


def twist_deviations(effect: Effect, model, motion) -> dict[str, np.ndarray]:
    """{joint: standard deviations (2,)} of the twist of an elastic joint and of its
    rate, as the noise of the torque through it makes them; empty for other kinds."""
    if effect.kind != "joint_elasticity":
        return {}
    k, d = effect.parameters["stiffness"], effect.parameters["damping"]
    found = {}
    for joint in find_joints(effect, model.plant):
        noise = _transmitted_noise(model, motion, joint)
        found[full_name(model.plant, joint)] = np.hypot(
            noise[:2] / k, d / k**2 * noise[1:]
        )
    return found


def _transmitted_noise(model, motion, joint: Joint) -> np.ndarray:
    """(3,) standard deviations of the smoothed torque of _transmitted and of two
    derivatives: half of what two halves of its samples, smoothed apart, differ by."""
    known, i = _cache(model, motion), joint.velocity_start()
    if (key := ("transmitted noise", i)) not in known:
        tau = motion.effort[:, i] - _rotor(model, joint) * motion.vd[:, i]
        one, other = (_smooth(motion.time, tau, slice(k, None, 4)) for k in (0, 2))
        known[key] = 0.5 * np.sqrt(np.mean((one - other) ** 2, axis=1))
    return known[key]


def _twist(effect: Effect, model, motion, joint: Joint) -> np.ndarray:
    """(3, n) twist of one joint, its rate and acceleration."""
    p = effect.parameters
    if effect.kind == "joint_elasticity":
        tau, k = _transmitted(model, motion, joint), p["stiffness"]
        return tau[:3] / k - p["damping"] / k**2 * tau[1:]
    linear = _linear(model, motion, joint)
    return through_gap(
        motion.time, linear.torque, linear.M, p["gap"], _restitution(effect)
    )


@numba.njit(cache=True)
def through_gap(time, torque, M, gap, restitution):
    """(3, n) twist, its rate and its acceleration (mean until the next sample).

    Args: torque (n,) that holds the joint on the motor's path; M (n,) its inertia;
        restitution of an impact on a side of the gap.
    """
    n, parts = len(time), 8
    out = np.zeros((3, n))
    z = 0.5 * gap * np.sign(torque[0])
    w = 0.0
    for k in range(n):
        out[0, k], out[1, k] = z, w
        if k + 1 == n or time[k + 1] <= time[k]:
            continue
        h = (time[k + 1] - time[k]) / parts
        before = w
        for part in range(parts):
            T = torque[k] + (torque[k + 1] - torque[k]) * part / parts
            w += h * T / M[k]
            z += h * w
            if abs(z) >= 0.5 * gap:
                z = 0.5 * gap * np.sign(z)
                # A bounce that ends within a step counts as rest.
                back = -restitution * w
                rests = T * z >= 0.0 and abs(back) < 2.0 * h * abs(T) / M[k]
                w = 0.0 if rests or w * z < 0.0 else back
        out[2, k] = (w - before) / (h * parts)
    return out


def _rotor(model, joint: Joint) -> float:
    """Reflected inertia of the model's rotor."""
    old = actuator_of(model.plant, joint)
    return 0.0 if old is None else old.default_reflected_inertia()


def _transmitted(model, motion, joint: Joint) -> np.ndarray:
    """(4, n) torque through the transmission, smoothed, and three derivatives."""
    known, i = _cache(model, motion), joint.velocity_start()
    if (key := ("transmitted", i)) not in known:
        tau = motion.effort[:, i] - _rotor(model, joint) * motion.vd[:, i]
        x = _smooth(motion.time, tau, slice(0, None, 2))
        known[key] = np.concatenate([x, [np.gradient(x[2], motion.time)]])
    return known[key]


def _smooth(time, y, of: slice) -> np.ndarray:
    """(3, n) smoothed value, first and second derivative of y, by its own noise.

    Args: of: the samples that are smoothed. (A measured effort at the middle of two
        rows is the mean of both, so that neighbouring samples err together; smoothed as
        if they did not, the rate of a noisy torque was 35 times as far off as that of
        every second sample.)
    """
    t, y = time[of], y[of]
    period = float(np.quantile(np.diff(t), 0.9))
    grid = np.arange(t[0], t[-1] + 0.5 * period, period)
    even = np.interp(grid, t, y)
    noise = float(np.sqrt(np.mean(np.diff(even, 3) ** 2) / 20.0))
    x = smooth(grid, even, max(noise, 1e-9 * (np.std(y) + 1e-12))).x
    return np.stack([np.interp(time, grid, column) for column in x.T])


def _linear(model, motion, joint: Joint) -> _Linear:
    """By forward differences of the model's inverse dynamics."""
    known = _cache(model, motion)
    i_q, i_v = joint.position_start(), joint.velocity_start()
    key = ("linear", i_v)
    if key in known:
        return known[key]
    rotor, h = _rotor(model, joint), 1e-4

    def effort(dq=0.0, dv=0.0, dvd=0.0):
        q, v, vd = (np.array(x) for x in (motion.q, motion.v, motion.vd))
        q[:, i_q] += dq
        v[:, i_v] += dv
        vd[:, i_v] += dvd
        return model.inverse_dynamics(q, v, vd, motion.time)

    if "rigid" not in known:
        known["rigid"] = effort()
    rigid = known["rigid"]
    M = effort(dvd=1.0) - rigid  # Linear in the acceleration.
    M[:, i_v] -= rotor
    derivative = np.stack(
        [-(effort(dq=h) - rigid) / h, -(effort(dv=h) - rigid) / h, -M], axis=2
    )
    torque = rigid[:, i_v] - rotor * motion.vd[:, i_v]
    known[key] = _Linear(derivative, torque, np.maximum(M[:, i_v], 1e-9))
    return known[key]


KINDS = {
    "joint_elasticity": EffectKind(
        at="joint",
        parameters=(
            Parameter(
                "stiffness", "N m/rad", 0.02, 200.0, None, valid="> 0", of_size=True
            ),
            Parameter(
                "damping", "N m s/rad", 0.0, 1.0, None, valid=">= 0", of_size=True
            ),
        ),
        says="motor and link of {at} are joined by a spring of {stiffness} (damping "
        "{damping}) that the model lacks",
        confused_with=("input_delay", "actuator_lag", "joint_backlash"),
        static_deflection=lambda e, effort: effort / e.parameters["stiffness"],
        tell_apart="sweep the frequency of the command through the resonance",
        rank=2,
        hidden_state=True,
        before_finalize=_add_motor,
        after_finalize=_add_coupling,
        signature=_elasticity_signature,
        added=_elasticity_added,
        now=lambda effect, plant, scene_graph: {"stiffness": 1e6, "damping": 0.0},
    ),
    "joint_backlash": EffectKind(
        at="joint",
        parameters=(
            Parameter("gap", "rad", 0.0, 0.1, valid=">= 0", rough=True),
            Parameter("restitution", "", 0.0, 0.95, None, valid="share", optional=True),
        ),
        says="motor and link of {at} have {gap} of backlash that the model lacks[, and "
        "bounce back from its sides with {restitution} of their speed]",
        confused_with=("joint_coulomb_friction", "joint_elasticity"),
        static_deflection=lambda e, effort: np.sign(effort) * e.parameters["gap"] / 2.0,
        tell_apart="reverse with small motions, once without load and once with "
        "gravity pressing one way",
        rank=2,
        hidden_state=True,
        before_finalize=_add_motor,
        after_finalize=_add_coupling,
        signature=_backlash_signature,
        added=_backlash_added,
    ),
}

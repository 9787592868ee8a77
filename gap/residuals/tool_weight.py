"""The weight of what is mounted beyond a force sensor, where its readings hold it.

A raw sensor feels f + m g - m a at the tool: the force from outside, the weight, and
what the tool's own motion adds. Here the weight is found, and taken off where the
sidecar says that it is there; the motion is seen to where forces are compared
(wrench_sensor.felt_motion).
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, RigidBody

from makebreak.gap.data.channel_noise import with_noise
from makebreak.gap.data.findings import TOOL_WEIGHT, Finding
from makebreak.gap.data.recording import Recording, WrenchAsLogged
from makebreak.gap.data.sidecar import sidecar_of
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.weight_in_wrench import (
    SENSOR,
    WORLD,
    HeldWeight,
    held_weight,
)
from makebreak.gap.residuals.impacts import positions
from makebreak.gap.residuals.scene_motion import POSE
from makebreak.gap.residuals.touching import FARTHEST, FREE
from makebreak.gap.residuals.wrench_sensor import FORCE, MOMENT, frame_of
from makebreak.gap.simulation.contact_shapes import ContactShapes, poses_of
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import full_name, one_dof_joints

LEAST_WEIGHT = 0.3  # Of what is beyond a sensor [N]: less is not looked for.
LOOKS = 600  # Rows of a recording that are looked at.
TOGETHER_SEC = 0.2  # Readings that are no farther apart are taken to go together.
FEWEST_FREE = 20  # Of these rows, in which nothing is touched.
EXACT = 0.2  # Of the weight: what is read is the weight that the scene has.
SHOWN = 0.1  # Of the weight: a bias that is told.


def bodies_beyond(plant: MultibodyPlant, body: RigidBody) -> list[RigidBody]:
    """A body and all that it carries: what a sensor in its mount bears."""
    carried: dict[int, list[RigidBody]] = {}
    for i in plant.GetJointIndices():
        joint = plant.get_joint(i)
        carried.setdefault(int(joint.parent_body().index()), []).append(
            joint.child_body()
        )
    found = [body]
    for each in found:  # Grows while it is gone through.
        found += carried.get(int(each.index()), [])
    return found


def as_used(
    recordings: Iterable[Recording], dynamics: SceneDynamics
) -> list[Recording]:
    """Wrenches as they are compared, from how the sidecars say that they were logged:
    on the robot, in world, without the weight of what is beyond the sensor.

    Raises: ValueError for a wrench that the scene or the recording lacks.
    """
    out = []
    for recording in recordings:
        if not recording.wrenches:
            out.append(recording)
            continue
        channels, q = dict(recording.channels), _configurations(dynamics, recording)
        for place, said in recording.wrenches.items():
            frame = frame_of(dynamics.plant, place)
            named = [[f"{place}.{a}" for a in axes] for axes in (FORCE, MOMENT)]
            if frame is None or not all(name in recording for name in named[0]):
                known = recording.places(FORCE + MOMENT)
                raise ValueError(
                    f"sidecar of {recording.path}: wrench of {place}: expected a frame "
                    "of the scene, with channels .fx .fy .fz; the recording has such "
                    f"channels of {', '.join(known) or 'nothing'}"
                )
            if _stands_unknown(dynamics.plant, recording, frame):
                raise ValueError(
                    f"sidecar of {recording.path}: wrench of {place}: the recording "
                    "lacks a position or pose that tells how the sensor stands"
                )
            R, weight = _axes_and_weight(dynamics, frame, q)
            for k, names in enumerate(named):
                if not all(name in recording for name in names):
                    continue
                y = np.stack([recording[name] for name in names], axis=1)
                y = _as_used(y, said, R, weight[:, 3 * k : 3 * k + 3])
                y = np.ascontiguousarray(y.T)
                y.setflags(write=False)
                given = [recording.channels[name].noise_given for name in names]
                for j, name in enumerate(names):
                    own = given[j] if said.axes == WORLD else max(given)
                    channels[name] = replace(
                        channels[name], values=y[j], noise_given=own
                    )
        done = replace(recording, channels=channels, wrenches={})
        out.append(with_noise(done))
    return out


def _as_used(y, said: WrenchAsLogged, R, weight) -> np.ndarray:
    """(n, 3) forces or moments as they are used; weight (n, 3): what it adds."""
    if said.acts_on == "environment":
        y = -y
    if said.axes == SENSOR:
        y = np.einsum("nij,nj->ni", R, y)
    return y - weight if said.holds_weight else y


def _axes_and_weight(dynamics: SceneDynamics, frame: Frame, q):
    """A sensor's axes in world (n, 3, 3), and the weight of what is beyond it, with its
    moment about the frame's origin, (n, 6) in world [N], [N m]."""
    plant, g = dynamics.plant, dynamics.gravity
    context = plant.CreateDefaultContext()
    beyond = [b for b in bodies_beyond(plant, frame.body()) if b.default_mass() > 0.0]
    parts = [(b, b.default_mass(), b.default_com()) for b in beyond]
    R, lever = np.empty((len(q), 3, 3)), np.zeros((len(q), 3))  # [kg m]
    for k, row in enumerate(q):
        plant.SetPositions(context, row)
        X = frame.CalcPoseInWorld(context)
        R[k] = X.rotation().matrix()
        for b, mass, com in parts:
            p = plant.EvalBodyPoseInWorld(context, b).multiply(com)
            lever[k] += mass * (p - X.translation())
    force = sum(mass for _, mass, _ in parts) * g
    return R, np.column_stack([np.tile(force, (len(q), 1)), np.cross(lever, g)])


def check_tool_weight(
    dynamics: SceneDynamics, recordings: Sequence[Recording]
) -> list[Finding]:
    """Wrenches that read the weight of what is mounted beyond the sensor while it
    touches nothing."""
    plant, found = dynamics.plant, []
    for recording in recordings:
        for place in recording.places(FORCE):
            frame = frame_of(plant, place)
            force = recording.stack(place, FORCE)
            if frame is None or force is None or plant.IsAnchored(frame.body()):
                continue
            if _stands_unknown(plant, recording, frame):
                continue
            finding = _weight_in(dynamics, recording, place, frame, force)
            found += [finding] if finding is not None else []
    return found


def _weight_in(
    dynamics: SceneDynamics, recording: Recording, place: str, frame: Frame, force
) -> Finding | None:
    beyond = bodies_beyond(dynamics.plant, frame.body())
    mass = sum(max(b.default_mass(), 0.0) for b in beyond)
    weight = mass * dynamics.gravity
    if not np.linalg.norm(weight) > LEAST_WEIGHT:
        return None
    used = np.zeros(len(force), bool)
    for episode in recording.episodes:
        used[episode.rows] = True
    rows = np.flatnonzero(used & np.isfinite(force).all(axis=1))
    rows = rows[:: max(len(rows) // LOOKS, 1)]
    if len(rows) < FEWEST_FREE:
        return None
    q = _configurations(dynamics, recording)[rows]
    free = _free(dynamics, recording, {int(b.index()) for b in beyond}, q)
    if free.sum() < FEWEST_FREE:
        return None
    every = float(np.median(np.diff(recording.time[rows])))
    independent = free.sum() * min(every / TOGETHER_SEC, 1.0)
    R, _ = _axes_and_weight(dynamics, frame, q[free])
    noise = max(recording.channels[f"{place}.{a}"].noise for a in FORCE)
    held = held_weight(force[rows[free]], R, weight, noise, independent)
    if held is None:
        return None
    times = held.ways[0][1]
    says = _says(recording, place, mass, weight, held)
    return Finding(TOOL_WEIGHT, recording.name, place, times, "1", "warning", says)


def _free(
    dynamics: SceneDynamics, recording: Recording, beyond: set[int], q
) -> np.ndarray:
    """(n,) whether what is beyond a sensor touches nothing, as far as the scene knows:
    the farther half of what is clear of everything, as the scene may have that
    elsewhere. All rows, where there is nothing to be touched."""
    plant = dynamics.plant
    free = np.ones(len(q), bool)
    try:
        shapes = ContactShapes(dynamics.loaded)
    except DoesNotFit:
        return free
    loose = {
        int(i)
        for i in plant.GetFloatingBaseBodies()
        if full_name(plant, plant.get_body(i)) in recording.places("xyz")
    }
    robot = plant.get_body(BodyIndex(min(beyond))).model_instance()

    def counts(body: int) -> bool:
        fixed = body in shapes.anchored
        fixed &= plant.get_body(BodyIndex(body)).model_instance() != robot
        return body in beyond or body in loose or fixed

    shapes.keep(counts)
    slots = shapes.slots(poses_of(plant, q, shapes), np.inf)
    apart = [s.phi for s in slots if (s.a in beyond) != (s.b in beyond)]
    if not apart:
        return free
    nearest = np.min(apart, axis=0)
    free = nearest > FREE
    if free.any():
        free &= nearest >= np.quantile(nearest[free], 1.0 - FARTHEST)
    return free


def _configurations(dynamics: SceneDynamics, recording: Recording) -> np.ndarray:
    """(n, n_q) as measured, free bodies with what is known of their poses."""
    q, plant = positions(dynamics, recording), dynamics.plant
    for i in plant.GetFloatingBaseBodies():
        body = plant.get_body(i)
        first = body.floating_positions_start()
        if not body.has_quaternion_dofs():
            continue
        for k, name in enumerate(f"{full_name(plant, body)}.{a}" for a in POSE):
            for e in recording.episodes if name in recording else ():
                t, y = recording.samples(name, e)
                if len(t):
                    q[e.rows, first + k] = np.interp(recording.time[e.rows], t, y)
    return q


def _unseen(plant: MultibodyPlant, recording: Recording) -> list[RigidBody]:
    """Bodies that move on their own and are not seen: free ones, and those of joints
    without positions."""
    free = [plant.get_body(i) for i in plant.GetFloatingBaseBodies()]
    found = [
        body for body in free
        if not all(f"{full_name(plant, body)}.{a}" in recording for a in POSE)
    ]  # fmt: skip
    return found + [
        joint.child_body()
        for joint in one_dof_joints(plant)
        if joint.num_velocities()
        and f"{full_name(plant, joint)}.position" not in recording
    ]


def _stands_unknown(plant: MultibodyPlant, recording: Recording, frame: Frame) -> bool:
    """Whether it is not known how a sensor stands."""
    own = frame.body().index()
    return any(
        b.index() == own for u in _unseen(plant, recording)
        for b in bodies_beyond(plant, u)
    )  # fmt: skip


def _says(recording: Recording, at: str, mass: float, weight, held: HeldWeight) -> str:
    """What is read, what that is, and what to do about it."""
    heavy = float(np.linalg.norm(weight))
    times, side = abs(held.ways[0][1]), sidecar_of(recording.path).name
    reads = ", ".join(f"{x:.2f}" for x in held.reads)
    says = (
        f"The wrench of {at} reads ({reads}) N while nothing is touched, {times:.2f} "
        f"times the weight of the {mass:.3g} kg that the scene has beyond the sensor: "
        "it holds the weight of its tool. "
    )
    lines = [_line(at, axes, t) for axes, t in held.ways]
    says += f"Say so in {side}: {lines[0]}"
    if len(lines) > 1:
        says += f", or, if that is how it was logged, {lines[1]}"
    says += ". "
    if abs(times - 1.0) > EXACT:
        says += (
            "Its mass in the scene is another one, or it is a payload that the scene "
            "lacks, and not the tool. "
        )
    if not held.turns:
        says += "The sensor does not turn, so a bias of it would look the same."
    elif held.constant:
        says += (
            "If these columns were in the axes of the sensor, which turns, this would "
            "be a bias of it, and no weight."
        )
    elif np.linalg.norm(held.bias) > SHOWN * heavy:
        bias = ", ".join(f"{x:.2f}" for x in held.bias)
        says += (
            f"Beside it, the sensor has a bias of ({bias}) N in its own axes, as of a "
            "zero that was set with the tool on: take it off with `offset`."
        )
    return says.strip()


def _line(at: str, axes: str, times: float) -> str:
    """The line of the sidecar."""
    said = "holds_weight: true"
    said += ", axes: sensor" if axes == SENSOR else ""
    said += ", acts_on: environment" if times < 0.0 else ""
    return f"`wrench: {{{at}: {{{said}}}}}`"

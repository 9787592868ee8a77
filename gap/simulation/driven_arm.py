"""A scene of joints alone, stepped by compiled code and not by Drake."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.driven_arm import (
    EFFORT,
    LOOP,
    NO_COMMAND,
    DrivenArm,
    rollout,
)
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.simulation.sensor_samples import SAME_SEC
from makebreak.models.drives import (
    CHANNEL_STEPS,
    actuators_of_model,
    drive_law,
    path_numbers,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.actuation_path import (
    BIAS,
    GAIN,
    KP,
    LIMIT,
    OWN,
    SHARE,
    TIME_CONSTANT,
    DriveLaw,
)
from makebreak.models.effects.joints import rotor
from makebreak.models.effects.kind import (
    Effect,
    actuator_of,
    full_name,
    model_names,
    one_dof_joints,
    velocity_unit,
)
from makebreak.models.effects.measured_channels import ChannelMap, channel_maps
from makebreak.models.joint_tree import (
    NoJointTree,
    changed_context,
    is_of_link,
    joint_tree,
    rotors_and_damping,
)
from makebreak.models.scene import Scene, body_laws, joint_laws, load_scene
from makebreak.models.scene_schema import COMMANDS_OF, as_kind
from makebreak.systems.numerics.body_laws import NO_BODY_LAWS
from makebreak.systems.numerics.joint_laws import FADES_AT, LAWS, coulomb_law
from makebreak.systems.numerics.joint_tree import JointTree, mass_and_bias

# Of the speed below which Drake's friction fades, which its steps need; these are
# implicit in what a joint's force owes to its speed. At more, a joint that should stay
# creeps by several times an encoder's noise within a second.
HOLDS = 0.1
# Key of a scene's `tolerance`; and how many of these times friction turns before the
# joint does, of such a solver (docs/gap_joints.md).
STOPS, LEAD = "friction_sec", 9.0
_MOST_KEPT = 64  # Plants whose numbers are remembered.


class DrivenArmScene:
    """A scene's joints and drives, read off its plant; effects that do not change the
    plant change the numbers without another plant.

    Contact is left out. Raises: DoesNotFit where anything moves that is no joint of
    one degree of freedom, or effects do what is not in DrivenArm.
    """

    def __init__(self, scene: Scene):
        # Time constant with which dry friction, not all of it yet, stops a joint as a
        # damper does: 0 of a robot; MuJoCo's solver, as it comes, has 1 ms.
        self.stops_sec = float(scene.tolerance.get(STOPS, 0.0))
        self.scene = scene = replace(scene, plant=replace(scene.plant, time_step=0.0))
        self._plants: dict[tuple, tuple[MultibodyPlant, JointTree]] = {}
        # Joints that nothing drives: a rotor needs an actuator there, too.
        self._passive: tuple[str, ...] = ()
        plant, _ = self._plant([e for e in scene.effects if not _of_joint(e.kind)])
        self._passive = tuple(
            full_name(plant, joint)
            for joint in one_dof_joints(plant) if actuator_of(plant, joint) is None
        )  # fmt: skip
        if self._passive:
            self._plants.clear()
        self.arm(())

    def arm(self, effects: Sequence[Effect]) -> DrivenArm:
        """Its numbers with these effects, which do not include the scene's own, added.

        Raises: ValueError for effects that the scene cannot have.
        """
        every = [as_kind(e) for e in (*self.scene.effects, *effects)]
        every.sort(key=lambda e: KINDS[e.kind].rank)
        for effect in every:
            if not can_have(effect.kind):
                raise DoesNotFit(f"effect {effect.kind} takes Drake's own steps")
        plant, tree = self._plant([e for e in every if _in_plant(e.kind)])
        links = [e for e in every if is_of_link(e.kind)]
        joints = [e for e in every if _of_joint(e.kind)]
        if links or joints:
            context = changed_context(plant, [*links, *joints])
            if links:
                tree = joint_tree(plant, context)
            else:
                tree = tree._replace(**rotors_and_damping(plant, context))
        for effect in every:
            possible = KINDS[effect.kind].possible
            if possible is not None:
                possible(effect, plant, every)
        n = len(tree.parent)
        none = np.zeros((n, 3))
        arm = DrivenArm(tree, soft=none, **self._drives(plant, every))
        M, zero = np.empty((n, n)), np.zeros(n)  # Where MuJoCo takes it.
        mass_and_bias(tree, NO_BODY_LAWS, 0.0, zero, zero, M, np.empty(n))
        return self._held(arm, np.diag(np.linalg.inv(M)))

    @property
    def has_shapes(self) -> bool:
        """Whether there is anything that could touch."""
        ((plant, _), *_) = self._plants.values()
        return plant.num_collision_geometries() > 0

    def received(self, told: np.ndarray) -> np.ndarray:
        """Position commands (..., n) as the drives have them, in whole steps."""
        return np.where(
            self._step > 0.0,
            np.round(told / np.where(self._step > 0.0, self._step, 1.0)) * self._step,
            told,
        )

    def _held(self, arm: DrivenArm, mobility: np.ndarray) -> DrivenArm:
        """With dry friction that holds: below a speed that is no more than these
        steps need, or softly."""
        laws, p, soft = arm.laws, arm.laws.p.copy(), arm.soft.copy()
        for j, (i, kind) in enumerate(zip(laws.joint, laws.kind, strict=True)):
            if int(kind) not in FADES_AT:
                continue
            p[j, FADES_AT[int(kind)]] *= HOLDS
            if self.stops_sec and LAWS[int(kind)] is coulomb_law:
                soft[i, 0] += p[j, 0]
                soft[i, 1:] = (
                    1.0 / (self.stops_sec * mobility[i]),
                    LEAD * self.stops_sec,
                )
                p[j, 0] = 0.0
        return arm._replace(laws=laws._replace(p=p), soft=soft)

    def _plant(self, effects) -> tuple[MultibodyPlant, JointTree]:
        """A plant with these effects, and what of a DrivenArm it decides."""
        key = tuple(e.key for e in effects)
        if key not in self._plants:
            if len(self._plants) >= _MOST_KEPT:
                self._plants.pop(next(iter(self._plants)))
            # Joints' own rotors come later: until then no drive is one that fits them.
            undriven = self.scene.actuation
            if COMMANDS_OF[undriven.type]:
                undriven = replace(undriven, type="effort")
            none = [rotor(joint, 0.0) for joint in self._passive]
            scene = replace(self.scene, actuation=undriven, effects=[*effects, *none])
            loaded = load_scene(scene, DiagramBuilder())
            try:
                self._plants[key] = loaded.plant, joint_tree(loaded.plant)
            except NoJointTree as error:
                raise DoesNotFit(str(error)) from None
        return self._plants[key]

    def _drives(self, plant: MultibodyPlant, effects: Sequence[Effect]) -> dict:
        n, actuation = plant.num_velocities(), self.scene.actuation
        takes = COMMANDS_OF[actuation.type]
        driven = np.full(n, NO_COMMAND)
        law, path = np.zeros((n, 6)), np.zeros((n, 5))
        law[:, 2] = path[:, 2] = np.inf
        path[:, 0], most = 1.0, np.full(n, np.inf)
        self._step = np.zeros(n)
        slow = np.full(n, 0.005)
        looped = bool(takes) and "effort_command" not in takes
        of = {name: i for i, name in enumerate(actuation.joints)}
        whole = drive_law(actuation) if looped else None
        offsets = [e for e in effects if KINDS[e.kind].channel == "offset"]
        names = [f"{name}.position" for name in of]
        maps = channel_maps(offsets, CHANNEL_STEPS, names)
        for model in model_names(plant):
            actuators = actuators_of_model(plant, model)
            if not actuators:
                continue
            numbers, _ = path_numbers(plant, model, effects)
            for k, actuator in enumerate(actuators):
                joint = actuator.joint()
                name, i = full_name(plant, joint), joint.velocity_start()
                path[i] = numbers[[GAIN, BIAS, LIMIT, TIME_CONSTANT, SHARE], k]
                slow[i], most[i] = velocity_unit(joint), actuator.effort_limit()
                if name in self._passive:
                    continue
                if not looped:
                    driven[i] = EFFORT
                elif whole is not None and name in of:
                    driven[i] = LOOP
                    own: DriveLaw = whole[of[name]]
                    kp = own.kp if numbers[KP, k] == OWN else numbers[KP, k]
                    seen = maps.get(f"{name}.position", ChannelMap()).bias
                    law[i] = kp, own.kd, own.limit, own.emf, own.dead_band, seen
                    if "position_command" not in takes:
                        law[i, 0] = 0.0
                    else:
                        self._step[i] = own.resolution
        return dict(
            driven=driven, law=law, path=path, slow=slow, most=most,
            laws=joint_laws(effects, plant), pulls=body_laws(effects, plant),
        )  # fmt: skip


class DrivenArmSimulation(SceneSimulation):
    """As SceneSimulation, by compiled code: some hundred times as fast. A plant with a
    time step is taken as a continuous one.

    Raises: DoesNotFit as DrivenArmScene.
    """

    def __init__(self, scene: Scene):
        self.arms = DrivenArmScene(scene)
        super().__init__(scene)
        self.tol = 1e-3
        self._own = len(scene.effects)
        self._arm = self.arms.arm(())

    def set_effects(self, effects: Sequence[Effect]) -> None:
        """The scene's effects from now on, of which the scene's own come first."""
        own = self.arms.scene.effects
        if list(effects[: len(own)]) != list(own):
            raise ValueError("the scene's own effects stay as they are")
        self._arm = self.arms.arm(effects[len(own) :])
        self._scene = replace(self._scene, effects=list(effects))
        self._current = tuple(sorted(effects, key=lambda e: KINDS[e.kind].rank))
        self._commands.set_effects(self._current)

    def _simulate(self, initial, start, needed, is_true, efforts, twists):
        self.failure = ""
        plant = self._plant
        self._set_state(initial, is_true)
        x = plant.GetPositionsAndVelocities(self._plant_context)
        n = plant.num_velocities()
        if not len(needed):
            return np.zeros((0, 2 * n)), {}
        events = self._commands.events
        events = events[(events > start + SAME_SEC) & (events < needed[-1])]
        times = np.union1d(np.append(needed, start), events)
        told = np.zeros((len(times) - 1, 2, n))
        index = {full_name(plant, j): j.velocity_start() for j in one_dof_joints(plant)}
        for channel, values in self._commands.columns(times[:-1]).items():
            joint, _, what = channel.rpartition(".")
            told[:, int(what == "velocity_command"), index[joint]] = values
        told[:, 0] = self.arms.received(told[:, 0])
        y = np.empty((len(times), 2 * n))
        y[0] = x
        y[1:] = rollout(self._arm, x[:n], x[n:], times, told, self.tol)
        if not np.isfinite(y[-1]).all():
            self.failure = "steps became too short"
        return y[np.searchsorted(times, needed - 1e-12)], {}


def can_have(kind: str) -> bool:
    """Whether a DrivenArm can have effects of a kind."""
    entry = KINDS[kind]
    return not (entry.hidden_state or entry.after_finalize)


def _in_plant(kind: str) -> bool:
    entry = KINDS[kind]
    elsewhere = entry.joint_law or entry.body_law or entry.path or entry.channel
    return not (elsewhere or _of_joint(kind) or is_of_link(kind))


def _of_joint(kind: str) -> bool:
    """Whether it changes a number of a joint, without another plant."""
    entry = KINDS[kind]
    numbers = [p.neutral for p in entry.parameters]
    return bool(entry.at == "joint" and entry.set_in_context and numbers == [0.0])

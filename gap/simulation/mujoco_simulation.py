"""Windows of recordings simulated by MuJoCo, with the contact of the model's file."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from threading import Lock
from typing import TypeVar

import numpy as np

from makebreak.gap.budget import go_on
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.simulation.sensor_samples import SAME_SEC, between
from makebreak.models.effects.kind import Effect, full_name, model_names
from makebreak.models.mujoco_twin import MujocoTwin
from makebreak.models.scene import InitialSection, Scene

T = TypeVar("T")

NOTED = 5  # Steps.
ROUNDS, EXACT = 25, 1e-10  # In which a start's velocities are found, and how well.


class MujocoSimulation(SceneSimulation):
    """As SceneSimulation; MuJoCo makes the steps.

    Raises: DoesNotFit for scenes that MujocoTwin does not take.
    """

    def __init__(self, scene: Scene):
        try:
            self._twins = MujocoTwin(scene)
            self._twins.with_effects(scene.effects)
        except ValueError as error:
            raise DoesNotFit(str(error)) from None
        super().__init__(scene)
        _say_nothing_of_what_grows()
        self._met: dict[str, float] | None = None
        self._lock = Lock()
        self.set_effects(scene.effects)

    def set_effects(self, effects: Sequence[Effect]) -> None:
        """The scene's effects from now on. Raises: ValueError as MujocoTwin."""
        self._twin = self._twins.with_effects(effects)
        self._current = tuple(effects)
        self._commands.set_effects(self._current)

    def each(self, calls: Sequence[Callable[[], T]]) -> list[T]:
        """In threads, of which one at a time does anything but MuJoCo's steps."""

        def in_turn(call: Callable[[], T]) -> T:
            with self._lock:
                return call()

        # No longer than the calls: a process that is copied copies no threads.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            done = [pool.submit(copy_context().run, in_turn, call) for call in calls]
            return [each.result() for each in done]

    @contextmanager
    def _lent(self) -> Iterator[None]:
        """Meanwhile another thread may have its turn."""
        if not self._lock.locked():  # There is one thread.
            yield
            return
        self._lock.release()
        try:
            yield
        finally:
            self._lock.acquire()

    @contextmanager
    def noting_pairs(self) -> Iterator[dict[str, float]]:
        """The pairs of bodies that touch in what is simulated meanwhile, the one that
        is fixed last, and their friction, the largest of several shapes."""
        self._met = {}
        try:
            yield self._met
        finally:
            self._met = None

    def _note_pairs(self, met: dict[str, float], states: np.ndarray) -> None:
        """Of states (n, n_q + n_v), one in NOTED of them."""
        import mujoco

        model, plant = self._twin.model, self._plant
        data = mujoco.MjData(model)
        fixed = {b.index() for b in plant.GetBodiesWeldedTo(plant.world_body())}
        bodies = [
            plant.get_body(i)
            for name in model_names(plant)
            for i in plant.GetBodyIndices(plant.GetModelInstanceByName(name))
        ]
        names = {b.name(): (b.index() in fixed, full_name(plant, b)) for b in bodies}
        geoms = dict[tuple[int, int], float]()
        for state in states[::NOTED]:
            data.qpos[:] = state[: model.nq]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            geoms |= {(c.geom1, c.geom2): float(c.friction[0]) for c in data.contact}
        for pair, friction in geoms.items():
            a, b = (self._twins.body_of(model.geom(g).name) for g in pair)
            if a in names and b in names and a != b:
                at = "~".join(at for _, at in sorted([names[a], names[b]]))
                met[at] = max(friction, met.get(at, 0.0))

    def channels(self) -> list[str]:
        """The measured channels that are simulated: no efforts."""
        return [c for c in super().channels() if not self._channels.is_effort(c)]

    def _simulate(
        self,
        initial: InitialSection,
        start: float,
        needed: np.ndarray,
        is_true: bool,
        want_efforts: bool,
        twists: Mapping[str, tuple[float, float]],
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        import mujoco
        from mujoco.rollout import rollout

        go_on()
        self.failure = ""
        self._set_state(initial, is_true)
        x = self._plant.GetPositionsAndVelocities(self._plant_context)
        twin, n_q = self._twin, self._plant.num_positions()
        model, dt = twin.model, self._twin.model.opt.timestep
        data = mujoco.MjData(model)
        data.qpos[:] = twin.home
        data.qpos[twin.q] = x[:n_q]
        data.qvel[twin.v] = x[n_q:]
        for spin, quat in twin.spins:
            R = np.zeros(9)
            mujoco.mju_quat2Mat(R, x[quat : quat + 4])
            data.qvel[twin.v[spin : spin + 3]] = (
                R.reshape(3, 3).T @ x[n_q + spin : n_q + spin + 3]
            )
        n = max(int(np.ceil((needed[-1] - start) / dt - 1e-6)), 1)
        time = start + dt * np.arange(n + 1)
        control = np.zeros((n, model.nu))
        for channel, values in self._commands.columns(time[:-1]).items():
            if channel in twin.commands:
                k, factor = twin.commands[channel]
                control[:, k] += factor * values
        ahead = model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
        if ahead:
            _begin_half_a_step_before(model, data, control[0])
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        first = np.zeros(mujoco.mj_stateSize(model, spec))
        mujoco.mj_getState(model, data, first, spec)
        with self._lent():
            states, _ = rollout(model, data, first[None], control[None], nstep=n)
        self.failure = ""
        every = np.vstack([first, states[0]])[:, 1:]
        if self._met is not None:
            self._note_pairs(self._met, every)
        path = np.empty((n + 1, len(x)))
        path[:, :n_q] = every[:, twin.q]
        path[:, n_q:] = every[:, model.nq + twin.v]
        for spin, quat in twin.spins:
            w, u = path[:, quat : quat + 1], path[:, quat + 1 : quat + 4]
            own = path[:, n_q + spin : n_q + spin + 3]
            # Turned into the world by the quaternion.
            path[:, n_q + spin : n_q + spin + 3] = own + 2.0 * np.cross(
                u, np.cross(u, own) + w * own
            )
        x = between(time, path, needed)
        if ahead:  # Velocities are the rates of positions, which go in lines.
            step = np.searchsorted(time, needed - SAME_SEC)
            x[:, n_q:] = path[np.minimum(step, n), n_q:]
        return x, {}


def _begin_half_a_step_before(model, data, control: np.ndarray) -> None:
    """Sets the velocities that MuJoCo, which steps them before positions, has where a
    motion has those of `data`: the mean of those before and after.

    Args: control (n_u,): of the first step.
    """
    import mujoco

    given = data.qvel.copy()
    next_one = mujoco.MjData(model)
    for _ in range(ROUNDS):
        next_one.qpos[:], next_one.qvel[:] = data.qpos, data.qvel
        next_one.ctrl[:] = control
        mujoco.mj_step(model, next_one)
        more = 0.5 * (next_one.qvel - data.qvel)
        if not np.isfinite(more).all():
            return
        change = np.abs(given - more - data.qvel).max(initial=0.0)
        data.qvel[:] = given - more
        if change < EXACT:
            return


def _say_nothing_of_what_grows() -> None:
    """What is tried may be unstable, which MuJoCo would write into a file beside the
    user's, and onto the screen."""
    import mujoco

    if getattr(mujoco, "get_mju_user_warning", lambda: True)() is None:
        mujoco.set_mju_user_warning(lambda text: None)

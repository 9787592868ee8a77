"""Time of `makebreak gap` on one minute of a Panda's motion at 200 rows per second."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces

import makebreak
from makebreak.benchmarks import driven as bench_driven
from makebreak.benchmarks import sysid as bench_sysid
from makebreak.benchmarks.rows import run_gap
from makebreak.diagrams.scene_facts import PANDA_JOINTS
from makebreak.gap.data.table import write_recording

DURATION_SEC, RATE_HZ = 60.0, 200.0
TARGET_SEC = 120.0  # Wall time on two cores.
POSITION_NOISE, VELOCITY_NOISE = 3e-5, 3e-3  # [rad], [rad/s]
FRICTION_JOINT, FRICTION = 3, 1.8  # [N m] Coulomb, of panda_joint4.
_STEP = 5e-4  # [s] of the integration; 1/_STEP is a multiple of the rate.
_MODELS = Path(makebreak.__file__).parent / "models"
_JOINTS = [f"panda.{joint}" for joint in PANDA_JOINTS]
_SCENE = """directives:
  - add_model: {{name: panda, file: {urdf}}}
  - add_weld: {{parent: world, child: panda::panda_link0}}
plant: {{time_step: 0.001}}
actuation: {{type: effort, joints: [{joints}], hold: zero_order, rate_hz: {rate}}}
"""


class _Arm:
    """The arm's equations of motion, with a friction that the scene does not have."""

    def __init__(self):
        self._plant = MultibodyPlant(0.0)
        parser = Parser(self._plant)
        parser.AddModels(str(_MODELS / "panda.urdf"))
        plant = self._plant
        base = plant.GetFrameByName("panda_link0")
        plant.WeldFrames(plant.world_frame(), base)
        plant.Finalize()
        self._context = plant.CreateDefaultContext()
        self._forces = MultibodyForces(plant)

    def mass_and_rest(self, q, v) -> tuple[np.ndarray, np.ndarray]:
        """M (7, 7), and the effort (7,) of no acceleration [N m]."""
        plant, context = self._plant, self._context
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        plant.CalcForceElementsContribution(context, self._forces)
        rest = plant.CalcInverseDynamics(context, np.zeros(7), self._forces)
        return plant.CalcMassMatrix(context), rest

    def acceleration(self, x, effort) -> np.ndarray:
        """x' (14,) of x = (q, v) under the motors' effort (7,)."""
        M, rest = self.mass_and_rest(x[:7], x[7:])
        left = effort - rest
        left[FRICTION_JOINT] -= FRICTION * np.tanh(x[7 + FRICTION_JOINT] / 2e-3)
        return np.concatenate([x[7:], np.linalg.solve(M, left)])


def sum_of_sines(rng) -> Callable[[float], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Function of time [s] to desired position, velocity, acceleration (7,)."""
    middle = np.array([0.0, -0.3, 0.0, -1.9, 0.0, 1.9, 0.0])
    reach = np.array([0.8, 0.5, 0.8, 0.6, 0.9, 0.7, 0.9])
    w = 2.0 * np.pi * rng.uniform(0.08, 0.6, (7, 5))
    phase = rng.uniform(0.0, 2.0 * np.pi, (7, 5))
    size = rng.uniform(0.5, 1.0, (7, 5))
    size *= reach[:, None] / size.sum(axis=1, keepdims=True)

    def at(t: float):
        angle = w * t + phase
        sin, cos = size * np.sin(angle), size * np.cos(angle)
        return (
            middle + sin.sum(axis=1), (w * cos).sum(axis=1), -(w**2 * sin).sum(axis=1),
        )  # fmt: skip

    return at


def record(
    folder: Path, seed: int = 0, duration: float = DURATION_SEC
) -> tuple[Path, Path]:
    """Writes a scene without friction, and a recording of an arm with friction.

    The arm follows a sum of sines by computed torque without friction compensation; its
    motion is integrated by the classical Runge-Kutta method.

    Returns: the scene, the recording.
    """
    rng = np.random.default_rng(seed)
    arm, wanted = _Arm(), sum_of_sines(rng)
    n, parts = round(duration * RATE_HZ), round(1.0 / (RATE_HZ * _STEP))
    x = np.concatenate(wanted(0.0)[:2])
    states, efforts = np.empty((n, 14)), np.empty((n, 7))
    noise = np.repeat([POSITION_NOISE, VELOCITY_NOISE], 7)
    for k in range(n):
        seen = states[k] = x + noise * rng.normal(size=14)
        q, v, vd = wanted(k / RATE_HZ)
        M, rest = arm.mass_and_rest(seen[:7], seen[7:])
        u = M @ (vd + 100.0 * (q - seen[:7]) + 20.0 * (v - seen[7:])) + rest
        efforts[k] = u
        for _ in range(parts):
            a = arm.acceleration(x, u)
            b = arm.acceleration(x + 0.5 * _STEP * a, u)
            c = arm.acceleration(x + 0.5 * _STEP * b, u)
            d = arm.acceleration(x + _STEP * c, u)
            x = x + _STEP / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    columns = {"time": np.arange(n) / RATE_HZ}
    for i, joint in enumerate(_JOINTS):
        columns[f"{joint}.position"] = states[:, i]
        columns[f"{joint}.velocity"] = states[:, 7 + i]
        columns[f"{joint}.effort_command"] = efforts[:, i]
    scene, recording = folder / "scene.yaml", folder / "recording.csv"
    urdf, joints = _MODELS.resolve() / "panda.urdf", ", ".join(_JOINTS)
    scene.write_text(_SCENE.format(urdf=urdf, joints=joints, rate=RATE_HZ))
    write_recording(recording, columns)
    return scene, recording


def rows() -> list[dict]:
    """Wall time of the command, and CPU time of all its processes [s]."""
    with TemporaryDirectory() as folder:
        scene, recording = record(Path(folder))
        result, wall, cpu = run_gap(
            str(scene), str(recording), out=Path(folder) / "out"
        )
    found = ", ".join(f"{e['kind']} at {e['at']}" for e in result["effects"])
    what = f"gap, {DURATION_SEC:.0f} s of 7 joints at {RATE_HZ:.0f} Hz"
    note = f"{result['verdict']}: {found or 'nothing'}"
    met = wall <= TARGET_SEC
    rows = [
        {"what": f"{what}, by the clock", "value": wall, "unit": "s", "note": note,
         "target": f"<= {TARGET_SEC:.0f}", "met": met},
        {"what": f"{what}, CPU time", "value": cpu, "unit": "s"},
    ]  # fmt: skip
    return rows + bench_sysid.rows() + bench_driven.rows()

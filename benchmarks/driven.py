"""Three tools on logs of robots that follow commands: `makebreak gap`, MuJoCo's toolbox
mujoco.sysid, and a CMA-ES, which legged robots are identified with.

Each gets the first two thirds of a log. Its model is then simulated over the last third
in one open run from the measured start, by MuJoCo with the step, the integrator and the
dry friction's solver of the world that the log is from.

mujoco.sysid and the CMA-ES minimise the error of all positions over the whole of their
part of the log, simulated in one run by mujoco.rollout with the scene's drives (kp, kd)
and its commands. Free are friction, damping, rotor inertia and a command's offset of
each joint, and one delay; in mujoco.sysid each kp, too. Both are given how the world
solves for dry friction, which `gap` is not.

    pip install 'makebreak[sysid]'
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import numpy as np
import yaml

from makebreak.benchmarks import sysid as bench_sysid
from makebreak.benchmarks.driven_rig import Log, Rig, Values, scales
from makebreak.benchmarks.rows import run_gap
from makebreak.benchmarks.sysid import left_out, make_case, read_robot

CASES = (
    "00_leg3_servo_none", "01_leg3_servo_friction", "09_legs12_servo_friction",
    "16_arm6_servo_friction", "23_arm7_servo_gains", "27_arm7_servo_friction_delay",
)  # fmt: skip
STEP_SEC = 0.002  # Of fits; PACE: 2.5 ms.
MATTERS = 0.03  # Of the effort of a joint (rms).
MOST_DELAY_SEC, MOST_OFFSET = 0.03, 0.1  # [s], [rad]
_KINDS = ("joint_coulomb_friction", "joint_viscous_damping", "rotor_inertia",
          "servo_gain")  # fmt: skip
# The CMA-ES starts as PACE does: in the middle of all ranges, with half of their half.
SIGMA, CMA_SEED, EVALUATIONS = 0.5, 1, 150  # Evaluations a parameter.
CMA_DONE = 1e-3  # [mrad] between the best of generations.
MOST_STEPS, SLOPE_STEP = 50, 1e-4  # Of mujoco.sysid; a share of half a range.


# ----- The tools


class Search:
    """The numbers of `Values` that a tool may change, (m,), each from -1 to 1 of its
    range, which follows from the log's efforts and speeds and the robot's inertia."""

    def __init__(self, rig: Rig, log: Log, names: Sequence[str]):
        self._rig, self._log = rig, log
        by, effort = scales(rig, log)
        n, given = len(effort), rig.values
        most = 2.0 * effort  # A joint that moves a quarter of the time has no more.
        none, inertia = np.zeros(n), rig.inertia(log.q.mean(axis=0))
        low = Values(none, none, none, none - MOST_OFFSET, 0.2 * given.kp, np.zeros(1))
        high = Values(
            most, most / by["damping"], given.rotor + 2.0 * inertia,
            none + MOST_OFFSET, 1.8 * given.kp, np.array([MOST_DELAY_SEC]),
        )  # fmt: skip
        sizes = [len(getattr(given, f.name)) for f in fields(Values)]
        self._free = np.repeat([f.name in names for f in fields(Values)], sizes)
        self._low, self._high = low.vector()[self._free], high.vector()[self._free]
        start = given.vector()[self._free]
        self.start = 2.0 * (start - self._low) / (self._high - self._low) - 1.0

    def values(self, u: np.ndarray) -> Values:
        """The values at u (m,); those that are not free are the model's."""
        vector = self._rig.values.vector()
        share = 0.5 * (1.0 + np.clip(u, -1.0, 1.0))
        vector[self._free] = self._low + (self._high - self._low) * share
        return Values.of(vector)

    def residual(self, u: np.ndarray) -> np.ndarray:
        """(k n,) errors of all positions [mrad] for u (m,); (k n, b) for (m, b)."""
        tried = [self.values(column) for column in np.atleast_2d(u.T)]
        q = self._rig.simulate(tried, self._log, step=STEP_SEC)
        off = 1e3 * (q - self._log.q)
        off = np.nan_to_num(off, nan=1e6).reshape(len(tried), -1).T
        return off if u.ndim == 2 else off[:, 0]


def by_sysid(rig: Rig, log: Log) -> Values:
    """All numbers are free, and start at the model's."""
    from mujoco import sysid

    search = Search(rig, log, [f.name for f in fields(Values)])
    free, most = sysid.ParameterDict(), np.ones(len(search.start))
    free.add(sysid.Parameter("all", search.start, -most, most))
    free["all"].move_off_bound()  # As the toolbox advises.
    best, _ = bench_sysid.optimize(
        free, lambda u, _: ([search.residual(u)], [], []), max_iters=MOST_STEPS,
        eps=SLOPE_STEP,
    )  # fmt: skip
    return search.values(best.as_vector())


def by_cma(rig: Rig, log: Log, evaluations: int = EVALUATIONS) -> Values:
    """Friction, damping, rotors, offsets and the delay are free."""
    import cma

    search = Search(rig, log, ("friction", "damping", "rotor", "offset", "delay"))
    m = len(search.start)
    options = {"bounds": [-1, 1], "seed": CMA_SEED, "maxfevals": evaluations * m,
               "tolfun": CMA_DONE, "verbose": -9}  # fmt: skip
    evolution = cma.CMAEvolutionStrategy(np.zeros(m), SIGMA, options)
    while not evolution.stop():
        tried = evolution.ask()
        off = search.residual(np.array(tried).T)
        evolution.tell(tried, np.sqrt(np.mean(off**2, axis=0)).tolist())
    return search.values(np.asarray(evolution.result.xbest))


def by_gap(case: Path, out: Path, dry) -> tuple[Rig, list[str], str, float]:
    """`makebreak gap` as it is typed. Returns: its model; effects that are none of
    `Values`; its verdict; CPU time [s]."""
    import mujoco

    files = (str(case / "scene.yaml"), str(case / "recording.csv"))
    result, _, cpu = run_gap(*files, "--jobs", "1", "--export", "mjcf", out=out)
    spec = mujoco.MjSpec.from_file(str(out / "repaired.xml"))
    gains = {a.target: float(a.gainprm[0]) for a in spec.actuators if a.biasprm[1]}
    for each in list(spec.actuators):
        spec.delete(each)
    scene = yaml.safe_load((case / "scene.yaml").read_text())["actuation"]
    kp, delay, others = [gains[joint] for joint in scene["joints"]], 0.0, []
    for e in result["effects"]:
        # Positions that are all read late are the same as commands that come late.
        tied = {e["kind"], *(o["kind"] for o in e["indistinguishable_from"])}
        if "input_delay" in tied and "delay" in e["parameters"]:
            delay += e["parameters"]["delay"]["value"]
        elif e["kind"] not in _KINDS:
            others.append(f"{e['kind']} at {e['at']}")
    rig = Rig(spec, scene["joints"], kp, scene["kd"], delay, dry)
    return rig, others, result["verdict"], cpu


# ----- The referee


def read_log(case: Path) -> Log:
    """Reads a case's files, without makebreak's own reader."""
    scene = yaml.safe_load((case / "scene.yaml").read_text())["actuation"]
    table = np.genfromtxt(
        case / "recording.csv", delimiter=",", names=True, deletechars=""
    )

    def columns(quantity):
        names = [f"{joint}.{quantity}" for joint in scene["joints"]]
        if names[0] not in (table.dtype.names or ()):
            return np.zeros((len(table), len(names)))
        return np.column_stack([table[name] for name in names])

    return Log(
        table["time"], columns("position"), columns("position_command"),
        columns("velocity_command"), scene["rate_hz"],
    )  # fmt: skip


def false_of(found: Values, rig: Rig, true: Values, log: Log) -> list[str]:
    """The numbers that are right in the rig's model, and that are changed by so much
    that it changes a joint's effort by more than MATTERS of itself."""
    by, effort = scales(rig, log)
    names = []
    for f in fields(Values):
        each, given, right = (getattr(v, f.name) for v in (found, rig.values, true))
        share = np.abs(each - given) * by[f.name] / effort
        if len(given) == 1:  # One delay of all joints.
            share = share.max(keepdims=True)
        wrong = np.isclose(given, right) & ~(share < MATTERS)
        names += [f"{f.name} {i + 1}" for i in np.flatnonzero(wrong)]
    return names


def errors_of(found: Values, given: Values, true: Values) -> np.ndarray:
    """Of each number that the given model has wrong, the error over the model's."""
    x, start, right = (v.vector() for v in (found, given, true))
    wrong = ~np.isclose(start, right)
    return np.abs(x - right)[wrong] / np.abs(start - right)[wrong]


def rows(cases: Sequence[str] = CASES) -> list[dict]:
    """Six rows for each case: three models that no tool made, three tools; or one that
    says what is missing. Value: held-out error; known_mrad: that of the rows that the
    tools had."""
    what = "gap, mujoco.sysid and CMA-ES on driven robots"
    if missing := left_out(what, "driven", available()):
        return missing
    found: list[dict] = []
    with TemporaryDirectory() as folder:
        for name in cases:
            found += _rows_of(*make_case("driven", name, Path(folder)))
    return found


def available() -> bool:
    """Whether the toolbox and the CMA-ES are installed."""
    return bench_sysid.available() and find_spec("cma") is not None


def _rows_of(case: Path, truth: Mapping) -> list[dict]:
    import mujoco

    log, scene = read_log(case), yaml.safe_load((case / "scene.yaml").read_text())
    drive = scene["actuation"]
    names = [joint.split(".")[1] for joint in drive["joints"]]
    world = mujoco.MjModel.from_xml_string(truth["world"])
    dry = world.dof_solref[0], world.dof_solimp[0]
    kp, delay = np.array(drive["kp"]), 0.0
    for e in truth["effects"]:
        if e["kind"] == "servo_gain":
            kp[drive["joints"].index(e["at"])] = e["parameters"]["kp"]
        delay += e["parameters"].get("delay", 0.0)
    spec = mujoco.MjSpec.from_string(truth["world"])
    true = Rig(spec, names, kp, drive["kd"], delay, dry)
    spec, _ = read_robot((case / "robot.urdf").read_text())
    given = Rig(spec, names, drive["kp"], drive["kd"], 0.0, dry)
    known = len(log.time) * 2 // 3
    part = log.first(known)

    def row(who: str, rig: Rig, values: Values, note: str, **more) -> dict:
        known_off, off = (
            1e3 * float(np.sqrt(np.mean((rig.simulate([values], *of) - q) ** 2)))
            for of, q in (((part,), part.q), ((log, known), log.q[known:]))
        )
        return {"what": f"{truth['name']}: {who}", "value": off, "unit": "mrad",
                "note": note, "known_mrad": known_off, **more}  # fmt: skip

    def judged(who, rig, values, cpu, note, others=()) -> dict:
        false = [*false_of(values, given, true.values, part), *others]
        errors = errors_of(values, given.values, true.values)
        if len(errors):
            note += f"values off by {np.median(errors):.1%} (most {errors.max():.1%}); "
        note += f"false: {', '.join(false) or 'nothing'}"
        return row(who, rig, values, note, false=len(false), cpu_s=cpu)

    kinds = ", ".join(truth["kinds"]) or "nothing"
    noise = "what noise and the start's error leave"
    found = [row("given model", given, given.values, f"hidden: {kinds}"),
             row("true model", true, true.values, noise),
             row("given model with the true values", given, true.values,
                 "what its masses leave")]  # fmt: skip
    cut = case.with_name(f"{case.name}_first")
    shutil.copytree(case, cut)
    lines = (case / "recording.csv").read_text().splitlines(keepends=True)
    (cut / "recording.csv").write_text("".join(lines[: 1 + known]))
    rig, others, verdict, cpu = by_gap(cut, cut / "out", dry)
    found.append(judged("makebreak gap", rig, rig.values, cpu, f"{verdict}; ", others))
    for who, fit in (("mujoco.sysid", by_sysid), ("CMA-ES", by_cma)):
        begin = process_time()
        values = fit(given, part)
        cpu = process_time() - begin
        found.append(judged(who, given, values, cpu, ""))
    return found

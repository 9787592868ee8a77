"""Compares `makebreak gap` with MuJoCo's toolbox mujoco.sysid on hidden effects.

There are six of the benchmark's mechanism cases, two of them without hidden effects.
The toolbox is set up as by an experienced user: the robot's URDF with motors and
rotors; free parameters are damping, dry friction and rotor inertia of all joints and a
load on the last link, and also mass and centre of mass of every link where the scene
declares them as known to a few per cent only; windows of 0.3 s start from smoothed
states; residuals are divided by the standard deviation of the noise, including that of
the starts; x_scale='jac'.

The toolbox gives values with intervals but does not name effects. So the number of
correct parameters that it changes by more than their interval is counted.

    pip install 'makebreak[sysid]'
"""

import csv
import json
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import numpy as np
import yaml
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.signal import savgol_filter

from makebreak.benchmarks.gap_benchmark import SETS, check
from makebreak.benchmarks.gap_scoring import score
from makebreak.benchmarks.rows import run_gap

CASES = (
    "01_arm_none", "02_pendulum_none", "13_pendulum_joint_coulomb_friction",
    "10_arm_joint_viscous_damping", "19_arm_rotor_inertia", "21_arm_payload",
)  # fmt: skip
WINDOW_SEC, STEP_SEC = 0.3, 0.0025
_SMOOTHING_ROWS = 21  # Rows of the cubic fit to a window's start: 100 ms.
# Standard deviation of the fitted start, over that of a sample.
_START = np.sqrt(9.0 / (4.0 * _SMOOTHING_ROWS))
_PARTS = ("damping", "friction", "rotor")


@dataclass(frozen=True)
class Fit:
    """{name: value} and {name: half width of the 95 % interval} of the parameters;
    their values without hidden effects; CPU time [s]."""

    values: Mapping[str, float]
    intervals: Mapping[str, float]
    nominal: Mapping[str, float]
    seconds: float


@dataclass
class Problem:
    """A case for the toolbox. rows: for each episode time (k,), q, v, effort (k, n);
    noise: standard deviations of position and velocity."""

    urdf: str
    joints: list[str]
    rows: list[dict[str, np.ndarray]] = field(default_factory=list)
    noise: tuple[float, float] = (3e-5, 3e-3)
    free_links: bool = False
    last: str = ""


def available() -> bool:
    """Whether the toolbox and its dependencies are installed."""
    if find_spec("mujoco") is None:
        return False
    import mujoco.sysid

    return hasattr(mujoco.sysid, "optimize")


def read_case(folder: Path) -> Problem:
    """Reads the files of a case, without makebreak's own reader."""
    scene = yaml.safe_load((folder / "scene.yaml").read_text())
    model = scene["directives"][0]["add_model"]
    joints = scene["actuation"]["joints"]
    with (folder / "recording.csv").open() as file:
        table = list(csv.DictReader(file))
    numbers = {
        key: np.array([float(row[key] or "nan") for row in table]) for key in table[0]
    }
    urdf = (folder / model["file"]).read_text()
    links = re.findall(r'<child link="(\w+)"', urdf)
    problem = Problem(urdf, joints, last=links[-1])
    problem.free_links = scene["tolerance"]["link_mass"] > 0.01
    for episode in np.unique(numbers["episode"]):
        rows = numbers["episode"] == episode
        time = numbers["time"][rows]

        def filled(quantity, rows=rows, time=time):
            columns = []
            for joint in joints:
                values = numbers.get(f"{joint}.{quantity}")
                if values is None:
                    return None
                there = ~np.isnan(values[rows])
                columns.append(np.interp(time, time[there], values[rows][there]))
            return np.column_stack(columns)

        q, v = filled("position"), filled("velocity")
        each = {"time": time, "q": q, "effort": filled("effort_command")}
        # The velocity is differentiated from positions if it is not measured.
        each["v"] = np.gradient(q, time, axis=0) if v is None else v
        each["measured_v"] = np.array([v is not None])
        problem.rows.append(each)
    given = folder / "noise.json"
    if given.is_file():
        noise = json.loads(given.read_text())
        first = joints[0]
        velocity = noise.get(f"{first}.velocity", problem.noise[1])
        problem.noise = noise[f"{first}.position"], velocity
    return problem


def read_robot(urdf: str):
    """The URDF's links and joints as an MjSpec, and {joint: its rotor [kg m2]}."""
    import mujoco

    plain = re.sub(r"<transmission.*?</transmission>", "", urdf, flags=re.S)
    plain = re.sub(r"<visual>.*?</visual>", "", plain, flags=re.S)
    head = '<mujoco><compiler fusestatic="false" balanceinertia="false"/></mujoco>'
    plain = plain.replace("<link", f"{head}<link", 1)
    spec = mujoco.MjSpec.from_string(plain)
    texts = re.findall(
        r'<joint name="(\w+)"/><actuator[^>]*>\s*<drake:rotor_inertia value='
        r'"([^"]+)"',
        urdf,
    )
    rotors = {joint: float(text) for joint, text in texts}
    for joint, rotor in rotors.items():
        spec.joint(joint).armature = rotor
    return spec, rotors


def _spec(problem: Problem):
    """The robot with motors, and sensors of every joint; its rotors."""
    import mujoco

    spec, rotors = read_robot(problem.urdf)
    spec.option.timestep = STEP_SEC
    # The errors of MuJoCo's first-order integrators are a hundred times the noise.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    for name in problem.joints:
        joint = name.split(".")[1]
        motor = spec.add_actuator(
            name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        motor.gainprm[0] = 1.0
    for kind in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL):
        for name in problem.joints:
            joint = name.split(".")[1]
            spec.add_sensor(
                name=f"{joint}_{int(kind)}", type=kind, objname=joint,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
            )  # fmt: skip
    return spec, rotors


def _parameters(problem: Problem, spec, rotors):
    """The free parameters, which start at the URDF's values."""
    from mujoco import sysid

    free = sysid.ParameterDict()

    def add(name, nominal, low, high, modifier):
        free.add(sysid.Parameter(name, nominal, low, high, modifier=modifier))

    def set_damping(joint):
        def modify(spec, p):
            damping = np.asarray(spec.joint(joint).damping)
            value = float(p.value[0])
            spec.joint(joint).damping = (
                value if damping.ndim == 0 else np.r_[value, np.zeros(damping.size - 1)]
            )

        return modify

    def set_friction(joint):
        def modify(spec, p):
            spec.joint(joint).frictionloss = float(p.value[0])

        return modify

    def set_rotor(joint):
        def modify(spec, p):
            spec.joint(joint).armature = float(p.value[0])

        return modify

    def set_load(body, mass, com, inertia):
        """Adds a point mass to the last link, whose own inertia is given."""

        def modify(spec, p):
            m, *place = map(float, p.value)
            total = mass + m
            centre = (mass * com + m * np.array(place)) / total
            tensor = inertia.copy()
            for each, at in ((mass, com - centre), (m, np.array(place) - centre)):
                tensor = tensor + each * (at @ at * np.eye(3) - np.outer(at, at))
            b = spec.body(body)
            b.mass, b.ipos, b.iquat = total, centre, [1, 0, 0, 0]
            b.fullinertia = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]

        return modify

    def set_link(body, mass, com, inertia):
        def modify(spec, p):
            m, *place = map(float, p.value)
            b = spec.body(body)
            b.mass, b.ipos, b.iquat = m, place, [1, 0, 0, 0]
            scaled = inertia * m / mass
            b.fullinertia = scaled[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]

        return modify

    for name in problem.joints:
        joint = name.split(".")[1]
        rotor = float(rotors.get(joint, 0.0))
        add(f"{joint}.damping", 0.02, 0.0, 20.0, set_damping(joint))
        add(f"{joint}.friction", 0.02, 0.0, 20.0, set_friction(joint))
        add(f"{joint}.rotor", max(rotor, 1e-3), 0.0, rotor + 2.0, set_rotor(joint))
    model = spec.compile()
    for i in range(2 if model.nbody > 1 else 1, model.nbody):
        body = model.body(i)
        R = _matrix(body.iquat)
        tensor = R @ np.diag(body.inertia) @ R.T
        mass, com = float(body.mass[0]), np.array(body.ipos)
        if body.name == problem.last:
            # The last link's own mass and centre of mass replace those of a load.
            start = np.array([0.01, *com])
            low, high = [0.0, *(com - 0.3)], [3.0, *(com + 0.3)]
            modify = set_load(body.name, mass, com, tensor)
            add(f"{body.name}.load", start, low, high, modify)
        elif problem.free_links:
            start = np.array([mass, *com])
            low, high = [0.5 * mass, *(com - 0.05)], [1.5 * mass, *(com + 0.05)]
            modify = set_link(body.name, mass, com, tensor)
            add(f"{body.name}.link", start, low, high, modify)
    return free


def _matrix(q) -> np.ndarray:
    import mujoco

    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(q, dtype=float))
    return out.reshape(3, 3)


def _sequences(problem: Problem, spec):
    """Windows of 0.3 s, each from its own smoothed state."""
    from mujoco import sysid

    model = spec.compile()
    starts, controls, sensors = [], [], []
    for rows in problem.rows:
        time, q, v = rows["time"], rows["q"], rows["v"]
        dt = float(np.median(np.diff(time)))
        smooth_q = savgol_filter(q, _SMOOTHING_ROWS, 3, axis=0)
        smooth_v = savgol_filter(q, _SMOOTHING_ROWS, 3, deriv=1, delta=dt, axis=0)
        if rows["measured_v"][0]:
            smooth_v = savgol_filter(v, _SMOOTHING_ROWS, 3, axis=0)
        fine = np.arange(0.0, WINDOW_SEC + STEP_SEC / 2, STEP_SEC)
        first = 10
        while time[first] + WINDOW_SEC + dt < time[-10]:
            at = time[first] + fine
            # A command holds until the next one.
            held = np.clip(np.searchsorted(time, at + 1e-9, "right") - 1, 0, None)
            there = (time > at[0] + STEP_SEC) & (time < at[-1])
            seen = np.hstack([q, v])[there]
            starts.append(
                sysid.create_initial_state(model, smooth_q[first], smooth_v[first])
            )
            controls.append(sysid.TimeSeries(fine, rows["effort"][held]))
            since = time[there] - time[first]
            sensors.append(sysid.TimeSeries.from_names(since, seen, model))
            first = int(np.searchsorted(time, time[first] + WINDOW_SEC))
    names = [f"window_{i}" for i in range(len(starts))]
    return sysid.ModelSequences("case", spec, names, starts, controls, sensors)


def optimize(free, residual, **options):
    """The toolbox's own optimiser, which prints each step whatever it is told."""
    from mujoco import sysid

    with redirect_stdout(StringIO()):
        return sysid.optimize(
            free, residual, optimizer="mujoco", verbose=False, x_scale="jac", **options
        )


def fit(problem: Problem, jobs: int = 1) -> Fit:
    """Runs the toolbox on a case."""
    from mujoco import sysid

    begin = process_time()
    spec, rotors = _spec(problem)
    free = _parameters(problem, spec, rotors)
    nominal = dict(zip(_names(free), free.as_vector(), strict=True))
    n = len(problem.joints)
    sequences = _sequences(problem, spec)
    position, velocity = problem.noise
    seen_v = problem.rows[0]["measured_v"][0]

    def std_of(t) -> np.ndarray:
        """(rows, 2 n) standard deviation of a sample and of its window's start."""
        drift = _START * velocity * t
        q = np.sqrt((1.0 + _START**2) * position**2 + drift**2)
        v = np.full_like(q, np.sqrt(1.0 + _START**2) * velocity if seen_v else np.inf)
        return np.column_stack([q] * n + [v] * n)

    def in_noise(params, predicted, measured, model, return_all, state=None, **_):
        # States after each step, as the toolbox's sensors are those before it, at the
        # times of measurements.
        t, q, v = state[:, 0], state[:, 1 : 1 + n], state[:, 1 + n : 1 + 2 * n]
        at = measured.times
        got = np.hstack([CubicHermiteSpline(t, q, v)(at), CubicSpline(t, v)(at)])
        series = [sysid.TimeSeries(at, x) for x in (got, measured.data)]
        return (got - measured.data) / std_of(at), *series

    residual = sysid.build_residual_fn(
        models_sequences=[sequences],
        modify_residual=in_noise,
        n_threads=jobs,
        resample_true=False,
    )
    best, result = optimize(free, residual, max_iters=20)
    final, _, _ = residual(best.as_vector(), best)
    _, intervals = sysid.calculate_intervals([np.ravel(r) for r in final], result.jac)
    values = dict(zip(_names(best), best.as_vector(), strict=True))
    widths = dict(zip(_names(best), np.ravel(intervals), strict=True))
    return Fit(values, widths, nominal, process_time() - begin)


def _names(free) -> list[str]:
    """The name of each free number: link.mass, link.x, ..."""
    out = []
    for p in free.values():
        parts = ("mass", "x", "y", "z")
        out += [p.name] if p.size == 1 else [f"{p.name}.{part}" for part in parts]
    return out


def compare(found: Fit, truth: Mapping) -> tuple[dict[str, float], int, int]:
    """Relative errors of the parameters of the hidden effects; the number of other
    parameters that are off by more than their interval, and of all others."""
    expected = {k: v for k, v in found.nominal.items() if not k.endswith(_PARTS)}
    own = {k: 0.0 for k in found.nominal if k.endswith(("damping", "friction"))}
    rotors = {k: v for k, v in found.nominal.items() if k.endswith("rotor")}
    expected |= own | rotors
    hidden = {}
    for effect in truth["effects"]:
        p, at = effect["parameters"], effect["at"]
        at = at if isinstance(at, str) else at[0]
        name = at.split(".")[-1]
        if effect["kind"] == "joint_coulomb_friction":
            hidden[f"{name}.friction"] = p["coulomb"]
        elif effect["kind"] == "joint_viscous_damping":
            hidden[f"{name}.damping"] = p["damping"]
        elif effect["kind"] == "rotor_inertia":
            hidden[f"{name}.rotor"] = rotors[f"{name}.rotor"] + p["inertia"]
        elif effect["kind"] == "payload":
            hidden[f"{name}.load.mass"] = p["mass"]
            for axis in "xyz":
                hidden[f"{name}.load.{axis}"] = p[f"com_{axis}"]
    errors = {}
    for name, value in hidden.items():
        change = abs(value - (expected[name] if name.endswith("rotor") else 0.0))
        errors[name] = abs(found.values[name] - value) / change if change else 0.0
    # The place of a load without mass is arbitrary.
    loose = [k for k in expected if ".load." in k and not k.endswith("mass")]
    # The true values of freed links differ from the URDF, and are not recorded.
    links = [k for k in expected if ".link." in k]
    others = [k for k in expected if k not in hidden and k not in (*loose, *links)]
    if any(k.endswith("load.mass") for k in others):
        expected |= {k: 0.0 for k in others if k.endswith("load.mass")}
    off = [k for k in others if abs(found.values[k] - expected[k]) > found.intervals[k]]
    return errors, len(off), len(others)


def rows(cases: Sequence[str] = CASES) -> list[dict]:
    """Two rows for each case, one for each tool; or one that says what is missing."""
    if missing := left_out("gap beside mujoco.sysid", "development", available()):
        return missing
    found: list[dict] = []
    with TemporaryDirectory() as folder:
        for name in cases:
            case, truth = make_case("development", name, Path(folder))
            found += _rows_of(case, Path(folder) / "out" / name, truth)
    return found


def left_out(what: str, which: str, has_tools: bool) -> list[dict]:
    """A row that says what is missing: a set's maker, or the tools; none: nothing."""
    note = "" if has_tools else "pip install 'makebreak[sysid]'"
    try:
        check(which)
    except ValueError as error:
        note = str(error)
    return [{"what": what, "note": f"left out: {note}"}] if note else []


def make_case(which: str, name: str, folder: Path) -> tuple[Path, dict]:
    """Makes one case of a set of the benchmark. Returns: its folder, what is hidden."""
    made, truth = folder / "cases", folder / f"{name}.json"
    words = [sys.executable, str(SETS[which].maker), "--set", which, "--only", name]
    words += ["--out", str(made), "--truth", str(truth)]
    subprocess.run(words, check=True, capture_output=True)
    [(there, hidden)] = json.loads(truth.read_text()).items()
    return made / there, hidden


def _rows_of(case: Path, out: Path, truth: Mapping) -> list[dict]:
    hidden = ", ".join(f"{e['kind']} at {e['at']}" for e in truth["effects"])
    what = f"{truth['name']} ({hidden or 'nothing hidden'})"
    files = (str(case / "scene.yaml"), str(case / "recording.csv"))
    result, _, seconds = run_gap(*files, "--jobs", "1", out=out)
    ours = score(truth, result)
    error = f"error {max(ours.errors):.1%}; " if ours.errors else ""
    note = f"{ours.found}: {ours.says}; {error}{ours.extra} invented"
    rows = [{"what": f"{what}: makebreak gap", "value": seconds, "unit": "s",
             "note": note}]  # fmt: skip
    found = fit(read_case(case))
    errors, off, others = compare(found, truth)
    text = f"error {max(errors.values()):.1%}; " if errors else ""
    note = f"{text}{off} of {others} others outside their intervals; names no effect"
    rows.append({"what": f"{what}: mujoco.sysid", "value": found.seconds, "unit": "s",
                 "note": note})  # fmt: skip
    return rows

"""Wrong inputs by the dozen: a run, or status 2 and one line; never a traceback, a
crash or a hang, and no input file changed.

Each input is tried in a child process of its own, forked here, so that crashes and
hangs are seen and imports are paid once. In the default suite a command ends where it
would begin to compute; the slow test goes on.
"""

import hashlib
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import makebreak.gap.workflow  # noqa: F401  (Imported before the fork.)
from makebreak.models.typed_yaml import field_types
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.cli import gap_command, run_command
from makebreak.scripts.experiments import EXPERIMENTS, load_experiment
from makebreak.scripts.runner import session

CPU_SEC, WALL_SEC = 20, 240  # The machine may be busy; a hang uses CPU or none at all.
SEARCH_SEC = 120  # A whole search of `gap`, whose bar moves, is no hang after 20 s.

URDF = """<robot name="r"><link name="base"/>
<link name="rod"><inertial><origin xyz="0 0 -0.3"/><mass value="1.2"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="package://r/rod.obj"/></geometry></visual>
<collision><geometry><sphere radius="0.05"/></geometry></collision></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="rod"/>
<origin xyz="0 0 1"/><axis xyz="0 1 0"/><dynamics damping="0.05"/>
<limit effort="20" lower="-3" upper="3" velocity="10"/></joint></robot>
"""
SCENE = {
    "directives": [
        {"add_model": {"name": "r", "file": "r.urdf"}},
        {
            "add_weld": {
                "parent": "world",
                "child": "r::base",
                "X_PC": {"translation": [0.0, 0.0, 0.5]},
            }
        },
    ],
    "plant": {
        "time_step": 0.001,
        "contact_model": "point",
        "discrete_contact_approximation": "lagged",
        "gravity": [0.0, 0.0, -9.81],
    },
    "actuation": {
        "type": "effort",
        "joints": ["r.j1"],
        "kp": [10.0],
        "kd": [1.0],
        "rate_hz": 1000.0,
    },
    "initial": {"positions": {"r.j1": 0.2}, "velocities": {"r.j1": 0.1}},
    "tolerance": {"link_mass": 0.03, "link_com_m": 0.002},
    "channels": {"position": "link side"},
    "packages": {"r": "."},
    "effects": [
        {
            "kind": "joint_coulomb_friction",
            "at": "r.j1",
            "parameters": {"coulomb": 0.1},
        },
        {"kind": "sensor_delay", "at": "r.j1", "parameters": {"delay": 0.004}},
    ],
}
SIDECAR = {
    "noise": {"r.j1.position": 1e-4},
    "columns": {"extra": None},
    "provenance": "rig 2",
}
NASTY = [
    None, True, 0, -1, 1, 3.5, 1e-320, 1e-12, 1e9, 1e308, -1e308, float("inf"),
    float("nan"), 10**400, 2**63, "", " ", "nan", ".inf", "foo", "r.j1", "r", "world",
    "\x00", "\u2028", "a" * 5000, "9" * 5000, "!Rpy", "package://x/y", "../..", "/",
    [], {}, [1], [[1]], {"a": 1}, [None], ["r.j1", "r.j1"], [1.0] * 7,
    [float("nan")] * 7,    {1: 2}, {"r.j1": None}, [{}],
]  # fmt: skip
TEXT_NASTY = [
    "", "nan", "inf", "-1", "0", "1e308", "1e-320", "1e999", "foo", "-", "'", '"', "\n",
    "\x00", "\ufeff", "é", "<", "&", "[" * 200, "{", ":", "- ", "\t",
    "9" * 400, ",", ";",
]  # fmt: skip
WORDS = [
    "run", "gap", "list", "reproduce", "export-tests", "bench", "s.yaml", "m.csv",
    "r.urdf", "--out", "out", "--seed", "1", "-1", "nan", "--dura", "0.01", "inf",
    "--set", "--config", "c.yaml", "--world", "--model", "--jobs", "--package", "r=.",
    "--realtime", "--help", "-", "--", "", "é", "cartpole_walls",
    "ball_rolling", "spring", "no.yaml", ".", "/", "--seeds", "--nope",
]  # fmt: skip


def recording() -> str:
    t = np.arange(0.0, 0.8, 0.005)
    rng = np.random.default_rng(0)
    q = 0.2 * np.cos(5.0 * t) + rng.normal(0.0, 1e-4, len(t))
    rows = np.stack([t, q, 0.1 * np.sin(7.0 * t), 0.0 * t], axis=1)
    head = "time,r.j1.position,r.j1.effort_command,extra\n"
    return head + "".join(",".join(f"{x:.6f}" for x in row) + "\n" for row in rows)


RECORDING = recording()


def paths(node, here=()):
    """Every place in nested maps and lists."""
    found = [here] if here else []
    if isinstance(node, dict):
        for key, value in node.items():
            found += paths(value, (*here, key))
    elif isinstance(node, list):
        for i, value in enumerate(node):
            found += paths(value, (*here, i))
    return found


def changed(node, place, how, value):
    """A copy with the value at a place replaced, removed, doubled or misspelt."""
    node = deepcopy(node)
    *above, last = place
    at = node
    for key in above:
        at = at[key]
    if how == "remove":
        del at[last]
    elif how == "add" and isinstance(at, dict):
        at["nope"] = value
    elif how == "misspell" and isinstance(at, dict) and isinstance(last, str):
        at[last[:-1] + "x"] = at.pop(last)
    else:
        at[last] = value
    return node


def dumped(node) -> str:
    try:
        return yaml.safe_dump(node, sort_keys=False, allow_unicode=True)
    except ValueError:  # More digits than Python writes.
        return "effects: " + "9" * 5000


@st.composite
def mapping_text(draw, base):
    """YAML of `base` with one to three mistakes, or with its text damaged."""
    if draw(st.integers(0, 4)) == 0:
        return draw(damaged(dumped(base)))
    node = base
    for _ in range(draw(st.integers(1, 3))):
        places = paths(node)
        if not places:
            break
        place = draw(st.sampled_from(places))
        how = draw(st.sampled_from(["set", "set", "set", "remove", "add", "misspell"]))
        node = changed(node, place, how, draw(st.sampled_from(NASTY)))
    return dumped(node)


@st.composite
def damaged(draw, text):
    """A text that is cut off, or in which a piece is replaced."""
    for _ in range(draw(st.integers(1, 2))):
        a = draw(st.integers(0, len(text)))
        how = draw(st.sampled_from(["cut", "replace", "replace", "word"]))
        if how == "cut":
            text = text[:a]
            continue
        b = min(a + draw(st.integers(0, 12)), len(text))
        if how == "word":  # A whole value, between what parts values.
            parts = ' \n,"<>=:[]{}'
            while a > 0 and text[a - 1] not in parts:
                a -= 1
            while b < len(text) and text[b] not in parts:
                b += 1
        text = text[:a] + draw(st.sampled_from(TEXT_NASTY)) + text[b:]
    return text


SETTINGS = {
    name: sorted(field_types(load_experiment(name).Config))
    for name in EXPERIMENTS
    if name in ("ball_rolling", "cartpole_walls", "multi_spring")
}


@st.composite
def inputs(draw, experiments):
    """Files {name: text} and the words of a command."""
    files = {
        "r.urdf": URDF,
        "s.yaml": dumped(SCENE),
        "m.csv": RECORDING,
        "m.yaml": dumped(SIDECAR),
    }
    gap = ["gap", "s.yaml", "m.csv", "--jobs", "1", "--out", "out"]
    what = draw(st.sampled_from(
        ["scene", "scene", "model", "recording", "sidecar", "world", "config", "set",
         "words"]
    ))  # fmt: skip
    run = ["run", draw(st.sampled_from(experiments)), "--no-meshcat"]
    run += ["--duration", "0.02", "--out", "out"]
    if what == "scene":
        files["s.yaml"] = draw(mapping_text(SCENE))
    elif what == "model":
        files["r.urdf"] = draw(damaged(URDF))
    elif what == "recording":
        files["m.csv"] = draw(damaged(RECORDING))
    elif what == "sidecar":
        files["m.yaml"] = draw(mapping_text(SIDECAR))
    elif what == "world":
        files["s.yaml"] = draw(mapping_text(SCENE))
        role = draw(st.sampled_from(["--world", "--model"]))
        return files, ["run", "ball_rolling", *run[2:], role, "s.yaml"]
    elif what in ("config", "set"):
        key = draw(st.sampled_from(SETTINGS[run[1]]))
        value = draw(st.sampled_from(NASTY))
        if what == "config":
            node = value
            for part in reversed(key.split(".")):
                node = {part: node}
            files["c.yaml"] = dumped(node)
            return files, [*run, "--config", "c.yaml"]
        text = dumped(value).replace("\n...", "").strip()
        if "\x00" in text:
            text = "nul"
        return files, [*run, "--set", f"{key}={text}"]
    elif what == "words":
        files["c.yaml"] = "seed: 1\n"
        return files, draw(st.lists(st.sampled_from(WORDS), max_size=8))
    return files, gap


def hashes(folder: Path, names) -> dict[str, str]:
    return {n: hashlib.sha256((folder / n).read_bytes()).hexdigest() for n in names}


def in_child(argv, folder: Path, only_reads: bool, cpu_sec: int = CPU_SEC):
    """Runs the command in a forked child. Returns: its status (negative: a signal),
    what it said on stderr, and its CPU time [s]."""
    with (folder / ".stderr").open("wb") as err, (folder / ".stdout").open("wb") as out:
        child = os.fork()
        if child == 0:
            code = 99
            try:
                os.chdir(folder)
                os.dup2(out.fileno(), 1)
                os.dup2(err.fileno(), 2)
                sys.stdout = open(1, "w", closefd=False)
                sys.stderr = open(2, "w", closefd=False)
                sys.stdin = open(os.devnull)
                tempfile.tempdir = str(folder)
                os.environ.pop("MAKEBREAK_DEBUG", None)
                if only_reads:
                    _stop_where_it_computes()
                if "--duration" not in argv:  # Mere words: nothing bounds a run.
                    run_command.run_in = cli._reproduce_in = _accepted
                    cli._COMMANDS["bench"] = _accepted
                    session.Session.simulate = _accepted
                resource.setrlimit(resource.RLIMIT_CPU, (cpu_sec, cpu_sec + 5))
                resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
                signal.signal(signal.SIGXCPU, signal.SIG_DFL)
                try:
                    code = cli.main(argv)
                except SystemExit as left:
                    code = left.code if isinstance(left.code, int) else 98
                sys.stdout.flush()
                sys.stderr.flush()
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code if code is not None else 0)
    end = time.monotonic() + WALL_SEC * max(1, cpu_sec // CPU_SEC)
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.005)
    said = (folder / ".stderr").read_text(errors="replace")
    return os.waitstatus_to_exitcode(status), said, usage.ru_utime + usage.ru_stime


def _accepted(*args, **kwargs):
    sys.stderr.flush()
    os._exit(0)


def _stop_where_it_computes() -> None:
    """In the child: an input that was accepted ends the command with status 0."""

    def told(self, text, share=None):
        if not text.startswith("checking"):
            _accepted()

    gap_command.StageBar.__call__ = told
    session.Session.simulate = _accepted


def check(files, argv, only_reads: bool) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in files.items():
            (folder / file).write_text(text, errors="surrogatepass")
        before = hashes(folder, files)
        searches = argv[:1] == ["gap"] and not only_reads
        limit = SEARCH_SEC if searches else CPU_SEC
        status, said, cpu = in_child(argv, folder, only_reads, limit)
        assert hashes(folder, files) == before, "an input file was changed"
    where = f"{argv}: status {status} after {cpu:.1f} s of CPU time: {said[-3000:]}"
    assert status >= 0, f"a signal or a hang: {where}"
    assert "Traceback" not in said, where
    assert status in (0, 1, 2), where
    if status == 2:
        lines = [line for line in said.splitlines() if line.startswith("makebreak: ")]
        assert len(lines) == 1, where
        assert "the traceback is in" not in lines[0], where


def compiled(only_reads: bool) -> None:
    """Compiles what the experiments need, so that this counts for no input."""
    for name in SETTINGS:
        argv = ["run", name, "--no-meshcat", "--duration", "0.02", "--out", "out"]
        with tempfile.TemporaryDirectory() as folder:
            status, said, _ = in_child(argv, Path(folder), only_reads, 600)
        assert status in (0, 1), said


def fuzz(examples: int, only_reads: bool, experiments):
    """A hypothesis test of so many inputs."""

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate],  # The input is small, and each try is dear.
    )
    @given(inputs(experiments))
    def tried(drawn):
        check(*drawn, only_reads)

    return tried


def test_thirty_wrong_inputs_are_runs_or_one_line():
    fuzz(30, True, ["multi_spring"])()  # The others compile for a minute.


def test_what_came_before_is_a_run():
    """The unharmed inputs are accepted: else nothing above would mean anything."""
    files = {"r.urdf": URDF, "s.yaml": dumped(SCENE), "m.csv": RECORDING,
             "m.yaml": dumped(SIDECAR)}  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        for file, text in files.items():
            Path(name, file).write_text(text)
        argv = ["gap", "s.yaml", "m.csv", "--jobs", "1", "--out", "out"]
        status, said, _ = in_child(argv, Path(name), True)
    assert status == 0, said


@pytest.mark.slow
def test_two_thousand_wrong_inputs_are_runs_or_one_line():
    compiled(False)
    fuzz(2000, False, sorted(SETTINGS))()

"""The command line: what it refuses, what it writes, how it ends."""

import fcntl
import gc
import inspect
import io
import json
import os
import pty
import re
import signal
import subprocess
import sys
import tempfile
import termios
import threading
import time
import weakref
from functools import reduce
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import spring_mass

import makebreak
from makebreak.benchmarks import bench
from makebreak.scripts import experiments
from makebreak.scripts.cli import command_inputs
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.cli.arguments import make_parser
from makebreak.scripts.runner import trials
from makebreak.scripts.runner.close_contact_loop import SETTINGS
from makebreak.scripts.runner.criteria import Criteria
from makebreak.scripts.runner.settings import apply_settings, load_config

ALL = dict(experiments.EXPERIMENTS)
PYPROJECT = Path(__file__).resolve().parent.parent / "pyproject.toml"


@pytest.fixture(autouse=True)
def _registered(monkeypatch, tmp_path):
    """Each test has the one experiment, and a folder of its own to run in."""
    monkeypatch.setattr(experiments, "EXPERIMENTS", {"spring_mass": "spring_mass"})
    monkeypatch.chdir(tmp_path)


def run(*args, out="out"):
    return cli.main(["run", "spring_mass", "--no-meshcat", "--out", out, *args])


def read(name, out="out"):
    return json.loads((Path(out) / name).read_text())


def test_json_is_one_document_and_the_rest_goes_to_stderr(capsys):
    assert run("--duration", "10", "--json") == 0
    told = capsys.readouterr()
    document = json.loads(told.out)
    assert (document["command"], document["status"]) == ("run", 0)
    assert document["result"] == read("result.json")
    assert {Path(file).name for file in document["files"]} >= {"recording.csv"}
    rows = {row["result"]: row["value"] for row in document["tables"][0]["rows"]}
    assert rows["position_end_m"] == document["result"]["position_end_m"]
    assert "position_end_m" in told.err
    assert cli.main(["list", "spring_mass", "mass", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["tables"] == document["files"] == []  # Each document has both.
    keys = [each["key"] for each in document["settings"]]
    assert keys == ["flown"]  # Whose meaning has the word.
    assert run("--set", "mess=1", "--json") == 2
    assert (
        run("--set", "spring.stiffness=-1", "--json") == 2
    )  # Found when the run has begun.
    assert capsys.readouterr().out == ""


def test_quiet_tells_errors_only(capsys):
    assert run("--duration", "10", "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert run("--set", "mess=1", "--quiet") == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.startswith("makebreak: ")


def test_every_command_has_json_and_quiet():
    words = {action.dest: action for action in make_parser(cli._COMMANDS)._actions}
    for name, command in words["==SUPPRESS=="].choices.items():
        has = {"--json", "--quiet"} <= set(command._option_string_actions)
        assert has == (name != "completion"), name


def test_a_run_writes_its_files_and_a_table(capsys):
    assert run("--seed", "3", "--duration", "10") == 0
    written = {path.name for path in Path("out").iterdir()} - {"running"}
    names = "config.yaml result.json timing.json recording.csv noise.json position.png "
    names += "report.html"
    assert written == {*names.split(), ".makebreak.json"}
    shown = capsys.readouterr()
    for name in names.split():
        assert name in shown.out
    assert "position_end_m" in shown.out and "success" in shown.out
    assert "x real time" in shown.err
    assert read("result.json")["settled_s"] is None  # Infinity is not JSON.
    assert "nan" not in shown.out and re.search(r"touched_s +-\n", shown.out)
    assert read("result.json")["touched_s"] is None
    assert read("result.json")["bounces_error_m"] == [0.5, None]
    timing = read("timing.json")
    assert timing["simulated_s"] == 10.0
    assert timing["systems"]["mass"]["updates"] == 1000
    assert timing["real_time_factor"] > 0 and timing["cpu_s"] > 0


def test_a_run_that_misses_its_criterion_exits_with_1():
    assert run("--set", "damped=false", "noise=0", "spring.stiffness=1e-6") == 1
    assert read("result.json")["success"] is False


def test_a_run_says_which_criterion_was_missed_and_why_it_ended(capsys):
    assert run("--set", "damped=false", "noise=0", "spring.stiffness=1e-6") == 1
    shown = capsys.readouterr().out
    assert (
        "success: no: 1 of 1 criteria missed\n  MISSED  distance from rest at" in shown
    )
    assert " m, wanted at most 0.2 m" in shown and "ended" not in shown
    result = read("result.json")
    assert result["met_rest"] is False and result["ended"] == []
    assert run("--duration", "20") == 0
    shown = capsys.readouterr().out
    assert "success: yes\n  met     distance from rest at the end: " in shown
    assert run("--set", "flown=0.5") == 1
    why = "ended at 0 s of 10 s: it flew away"
    assert why in capsys.readouterr().out and read("result.json")["ended"] == [why]


def test_every_experiment_names_its_criteria():
    """Whatever makes `success` has a name, a value and a bound."""
    for name, module in ALL.items():
        source = inspect.getsource(import_module(module))
        assert '"success": bool' not in source and '["success"] =' not in source, name
        assert "criteria.result()" in source or name == "gentle_rolling", name


@pytest.mark.parametrize(
    ("value", "met"), [(0.3, True), (0.4, True), (0.5, False), (np.nan, False)]
)
def test_a_number_meets_its_bound_or_not_and_nan_never_does(value, met):
    criteria = Criteria()
    criteria.at_most("a", "distance", value, 0.4, "m")
    criteria.at_least("b", "distance", -value, -0.4, "m")
    criteria.at_most("c", "number", 0, 0)
    result = criteria.result()
    assert (result["met_a"], result["met_b"], result["met_c"]) == (met, met, True)
    assert result["success"] is met
    word = "met   " if met else "MISSED"
    shown = "not measured" if np.isnan(value) else f"{value:.4g} m"
    assert result["criteria"][0] == f"{word}  distance: {shown}, wanted at most 0.4 m"
    assert Criteria().result()["success"] is False


def test_the_same_seed_gives_the_same_result_bit_for_bit():
    for out, seed in (("a", "5"), ("b", "5"), ("c", "6")):
        assert run("--seed", seed, out=out) == 0
    a, b, c = (Path(out, "result.json").read_bytes() for out in "abc")
    assert a == b and a != c
    recordings = [Path(out, "recording.csv").read_bytes() for out in "ab"]
    assert recordings[0] == recordings[1]


def test_the_written_config_runs_again_to_the_same_result():
    settings = ("spring.stiffness=5", "weights=[1, 2e-3]", "noise=1e-2", "limit=2")
    assert run("--seed", "4", "--set", *settings, out="a") == 0
    assert run("--config", "a/config.yaml", out="b") == 0
    assert Path("a/result.json").read_bytes() == Path("b/result.json").read_bytes()
    assert Path("a/config.yaml").read_text() == Path("b/config.yaml").read_text()


def test_settings_come_after_the_config_file_and_the_seed_last():
    Path("c.yaml").write_text("spring: {stiffness: 9.0}\nseed: 8\nnoise: 0.0\n")
    settings = ("--set", "spring.stiffness=7", "--seed", "2")
    assert run("--config", "c.yaml", *settings) == 0
    text = Path("out/config.yaml").read_text()
    assert "stiffness: 7.0" in text and "seed: 2" in text and "noise: 0.0" in text


def test_without_out_each_run_has_a_folder_of_its_own():
    for _ in range(2):
        assert cli.main(["run", "spring_mass", "--no-meshcat", "--duration", "1"]) < 2
    assert len(list(Path("runs").glob("spring_mass-*/result.json"))) == 2


BAD = [
    (["run", "spring_mas"], "unknown experiment spring_mas; did you mean spring_mass?"),
    (["run", "x", "--no-meshcat"], "unknown experiment x; expected one of: spring_"),
    (["runn"], "unknown command runn; did you mean run?"),
    ([], "COMMAND"),
    (["run", "spring_mass", "--sed", "1"], "option --sed; did you mean --seed?"),
    (["run", "spring_mass", "--durat=1"], "option --durat; did you mean --duration?"),
    (["run", "spring_mass", "--no-mesh"], "option --no-mesh; did you mean --no-mes"),
    (
        ["reproduce", "--seed", "1"],
        "--seed is of gap, faults, close_the_loop; did you mean --seeds?",
    ),
    (["gap", "a.yaml", "b.csv", "--job", "1"], "option --job; did you mean --jobs?"),
    (["bench", "--jobs", "1"], "unknown option --jobs; did you mean --json?"),
    (["list", "scenes"], "unknown experiment scenes"),
    (["run", "--set", "noise=1", "spring_mass"], "EXPERIMENT comes before --set"),
    (["reproduce", "spring"], "unknown experiment spring; did you mean spring_mass?"),
    (["reproduce", "--seeds", "0"], '--seeds: got "0", expected a whole number, 1'),
    (["reproduce", "--jobs", "two"], '--jobs: got "two", expected a whole number, 1'),
    (["bench", "lsc"], "unknown bench lsc; did you mean lcs?"),
]
BAD_RUN = [
    (
        ["--set", "nois=1"],
        "unknown key nois; did you mean noise? (makebreak list spring_mass lists all)",
    ),
    (["--set", "stiffness=1"], "unknown key stiffness; did you mean spring.stiffness?"),
    (["--set", "spring.stifness=1"], "did you mean spring.stiffness?"),
    (["--set", "noise"], '--set: got "noise", expected key=value'),
    (["--set", "noise=abc"], '--set noise: got "abc", expected a number'),
    (["--set", "noise=true"], '--set noise: got "true", expected a number'),
    (["--set", "noise=.nan"], '--set noise: got ".nan", expected a number'),
    (["--set", "noise="], '--set noise: got "null", expected a number'),
    (["--set", "noise=[1"], '--set noise: got "[1", not YAML'),
    (["--set", "steps=2.5"], '--set steps: got "2.5", expected an integer'),
    (["--set", "damped=1"], '--set damped: got "1", expected true or false'),
    (["--set", "weights=3"], '--set weights: got "3", expected a list'),
    (["--set", "weights=[1, a]"], '--set weights[1]: got "a", expected a number'),
    (["--set", "limit=a"], '--set limit: got "a", expected a number'),
    (["--set", "spring=4"], '--set spring: got "4", expected spring.FIELD=value'),
    (["--set", "spring={soft: 1}"], "unknown key spring.soft; expected one of: spring"),
    (["--set", "spring.stiffness=-1"], "spring.stiffness: got -1.0, expected > 0"),
    (["--config", "no.yaml"], '--config: got "no.yaml", expected a YAML file'),
    (["--config", "broken.yaml"], "--config broken.yaml: not YAML"),
    (
        ["--config", "list.yaml"],
        '--config list.yaml: got "[1, 2]", expected key: value',
    ),
    (["--config", "key.yaml"], "--config key.yaml: unknown key spring.stifness; did"),
    (["--config", "type.yaml"], 'type.yaml: noise: got "abc", expected a number'),
    (["--seed", "-1"], '--seed: got "-1", expected a whole number, 0 or more'),
    (["--seed", "1.5"], '--seed: got "1.5", expected a whole number'),
    (["--set", "seed=-1"], "seed: got -1, expected 0 or more"),
    (["--duration", "0"], '--duration: got "0", expected a number above 0'),
    (["--duration", "nan"], '--duration: got "nan", expected a number above 0'),
    (["--duration", "inf"], '--duration: got "inf", expected a number above 0'),
    (["--realtime", "fast"], '--realtime: got "fast", expected a number above 0'),
    (["--model", "scene.yaml"], "--model: spring_mass has no model scene"),
    (["--world", "no.yaml"], '--world: got "no.yaml", expected a scene file'),
    (["--out", "a_file"], '--out: got "a_file", expected a folder to write in'),
    (["--out", "a_file/sub"], '--out: got "a_file/sub", expected a folder'),
    (["--out", "/proc/nowhere"], '--out: got "/proc/nowhere", expected a folder'),
]


@pytest.mark.parametrize(
    ("args", "message"),
    BAD + [(["run", "spring_mass", "--no-meshcat", *a], m) for a, m in BAD_RUN],
)
def test_bad_input_is_one_line_on_stderr_and_status_2(args, message, capsys):
    Path("a_file").write_text("")
    Path("broken.yaml").write_text("noise: [1\nseed: 2")
    Path("list.yaml").write_text("[1, 2]")
    Path("key.yaml").write_text("spring: {stifness: 1}")
    Path("type.yaml").write_text("noise: abc")
    assert cli.main(args) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("makebreak: ")
    assert message in error


@pytest.mark.parametrize("name", ALL)
def test_an_unknown_key_is_a_short_line_that_begins_with_what_is_near(name):
    config = import_module(ALL[name]).Config()
    with pytest.raises(ValueError) as error:
        apply_settings(config, ["typo=1"], name)
    said = str(error.value)
    assert re.match("--set: unknown key typo; (nearest of|did you mean)", said), said
    assert said.endswith(f"(makebreak list {name} lists all)") and len(said) < 200


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("task.rolling.roll_sec", "task.rolling.roll.sec"),
        ("task.radius", "task.circle.radius"),
        ("contacts.path.speed", "contacts.path.circle.speed"),
        ("planner.N", "planner.options.N"),
        ("impedance.posture_damping", "impedance.posture.damping"),
        ("camera.noise_height", "camera.noise.height"),
        (
            "contacts.sampler.sampling.keep_sec",
            "contacts.sampler.sampling.change.keep_sec",
        ),
        ("task.rolling.withdraw_speed", "task.rolling.unseen.withdraw_speed"),
        ("contacts.push.unseen_sec", "contacts.push.unseen.sec"),
        ("contacts.push.room", "contacts.push.travel.room"),
        ("contacts.reference.touch_speed", "contacts.reference.touch.speed"),
        ("contacts.reference.speed_max", "contacts.reference.limits.speed_max"),
    ],
)
def test_a_setting_that_is_in_a_group_now_is_refused_with_its_new_name(
    tmp_path, old, new
):
    schema = import_module(ALL["ball_rolling"]).Config
    with pytest.raises(ValueError, match=f"unknown key {old}; did you mean {new}[? ]"):
        apply_settings(schema(), [f"{old}=1"])
    text = "1"
    for word in reversed(old.split(".")):
        text = f"{{{word}: {text}}}"
    (tmp_path / "old.yaml").write_text(text)
    with pytest.raises(ValueError, match=f"unknown key {old}; did you mean {new}[? ]"):
        load_config(schema, tmp_path / "old.yaml")


def test_infinity_is_accepted_where_it_means_that_there_is_no_limit():
    config = import_module(ALL["push_object"]).Config()
    for key in ("impedance.force_max", "reference.touch.speed", "sampler.budget_sec"):
        before = reduce(getattr, key.split("."), apply_settings(config, [f"{key}=0.5"]))
        after = reduce(getattr, key.split("."), apply_settings(config, [f"{key}=inf"]))
        assert (before, after) == (0.5, np.inf)
    for key in ("reference.limits.speed_max", "impedance.posture.damping", "friction"):
        with pytest.raises(ValueError, match=f'{key}: got ".inf", expected a number'):
            apply_settings(config, [f"{key}=inf"])
    with pytest.raises(ValueError, match="expected a number"):
        apply_settings(config, ["impedance.force_max=-inf"])


def test_a_fault_of_the_program_is_not_called_bad_input(capsys):
    assert run("--set", "fail_at_sec=1") == 3
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert said.splitlines()[-1].startswith("makebreak: a fault of makebreak itself")
    assert "the traceback is in out/error.txt" in said
    assert "a fault in the middle" in Path("out/error.txt").read_text()
    with np.load("out/partial.npz") as partial:  # Samples every 1/80 s, to 1 s.
        np.testing.assert_allclose(partial["time"][-1], 1.0, atol=1e-12)


def test_a_world_is_found_by_path_or_by_name(monkeypatch):
    models = Path("models/rooms").absolute()
    models.mkdir(parents=True)
    (models / "attic.scene.yaml").write_text("# An attic.\ndirectives: []\n")
    (models / "weights.yaml").write_text("a: 1\n")  # YAML, but no scene.
    monkeypatch.setattr(command_inputs, "MODELS", models.parent)
    assert list(command_inputs.scenes()) == ["rooms/attic"]
    for name in (
        "rooms/attic",
        "rooms/attic.scene.yaml",
        "models/rooms/attic.scene.yaml",
    ):
        assert run("--world", name, "--duration", "5") < 2
        assert (
            f"world: {models}/attic.scene.yaml" in Path("out/config.yaml").read_text()
        )


def test_list_names_experiments_and_scenes_with_a_line_each(capsys, monkeypatch):
    Path("models").mkdir()
    Path("models/attic.yaml").write_text("# An attic.\ndirectives: []\n")
    monkeypatch.setattr(command_inputs, "MODELS", Path("models"))
    assert cli.main(["list"]) == 0
    lines = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    assert ["spring_mass", spring_mass.SUMMARY] in lines
    assert ["attic", "An attic."] in lines


@pytest.fixture
def start():
    """Starts the command line in a process of its own, which the test's end ends."""
    processes = []

    def start(*args, **more):
        processes.append(
            subprocess.Popen(
                [*spring_mass.COMMAND, *args],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                stdin=subprocess.DEVNULL,
                text=True,
                env=trials.run_environment() | more,
            )
        )
        return processes[-1]

    yield start
    for process in processes:
        if process.poll() is None:
            process.terminate()  # reproduce ends its own runs when it is told so.


def wait_for(paths):
    """Until all these files have content; generous, as the machine may be busy."""
    end = time.monotonic() + 60
    while not all(p.exists() and p.read_text() for p in paths):
        assert time.monotonic() < end, f"none of {paths} came"
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("number", "whole_only"),
    [
        (signal.SIGINT, False),
        (signal.SIGINT, True),
        *(
            pytest.param(n, False, marks=pytest.mark.slow)
            for n in (signal.SIGTERM, signal.SIGHUP)
        ),
    ],
)
def test_ctrl_c_ends_a_run_cleanly_and_keeps_what_was_recorded(
    number, whole_only, start
):
    settings = ["--duration", "1e6", "--set", f"whole_only={str(whole_only).lower()}"]
    process = start("run", "spring_mass", "--no-meshcat", "--out", "out", *settings)
    wait_for([Path("out/running")])
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in error
    assert error.splitlines()[-1].startswith("makebreak: interrupted")
    assert read("timing.json")["simulated_s"] > 1.0
    if whole_only:  # It could not be scored; the samples are there all the same.
        assert not Path("out/result.json").exists()
        with np.load("out/partial.npz") as partial:
            assert partial["time"][-1] > 1.0 and len(partial["x"]) > 80
    else:
        assert read("result.json")["interrupted"] is True
        table = np.genfromtxt("out/recording.csv", delimiter=",", names=True)
        assert table["time"][-1] > 1.0


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_ends_reproduce_and_all_its_runs(number, start):
    process = start("reproduce", "--seeds", "2", "--jobs", "2", "--out", "out",
                    SPRING_MASS_SECONDS="1e6")  # fmt: skip
    folder = Path("out/spring_mass")
    marks = [folder / f"damped=true_seed={s}" / "running" for s in (0, 1)]
    wait_for(marks)
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in error
    for mark in marks:
        with pytest.raises(ProcessLookupError):
            os.kill(int(mark.read_text()), 0)


def test_a_closed_terminal_does_not_lose_the_run():
    """What is printed after SIGHUP has nowhere to go."""
    master, terminal = pty.openpty()
    words = ["run", "spring_mass", "--no-meshcat", "--out", "out"]
    process = subprocess.Popen(
        [*spring_mass.COMMAND, *words, "--duration", "1e6"],
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        env=trials.run_environment(),
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(terminal)
    try:
        wait_for([Path("out/running")])
        os.close(master)  # The kernel sends SIGHUP.
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()
    assert read("result.json")["interrupted"] is True


def test_nohup_is_respected():
    words = ["run", "spring_mass", "--no-meshcat", "--out", "out"]
    process = subprocess.Popen(
        [*spring_mass.COMMAND, *words, "--duration", "1e6"],
        stderr=subprocess.DEVNULL,
        env=trials.run_environment(),
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )
    try:
        wait_for([Path("out/running")])
        process.send_signal(signal.SIGHUP)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=1)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()


def test_reproduce_prints_and_writes_its_table_and_fails_on_a_missed_row(capsys):
    args = ["reproduce", "--seeds", "1", "--jobs", "2", "--out", "out"]
    assert cli.main(args) == 1  # The row "without damping" has a target that it misses.
    shown = capsys.readouterr().out
    assert "MISSED" in shown and "comes to rest" in shown
    [table] = read("reproduce.json").values()
    assert [row["ours"] for row in table["rows"]] == [1, 0]
    assert [row["met"] for row in table["rows"]] == [True, False]
    assert "| comes to rest | 1 | 1 |" in Path("out/reproduce.md").read_text()
    assert "<td>comes to rest</td>" in Path("out/report.html").read_text()
    assert not list(Path("out").glob("*/*/report.html"))  # Of single trials.
    # Earlier trials are kept when told so.
    path = Path("out/spring_mass/damped=true_seed=0/result.json")
    path.write_text(path.read_text().replace('"success": true', '"success": false'))
    cli.main([*args, "--reuse"])
    [table] = read("reproduce.json").values()
    assert [row["ours"] for row in table["rows"]] == [0, 0]
    cli.main(args)
    [table] = read("reproduce.json").values()
    assert [row["ours"] for row in table["rows"]] == [1, 0]


def test_meshcat_is_announced_and_stays_until_enter_at_a_terminal(capsys, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    terminal = Terminal("\nmore\n")
    monkeypatch.setattr("sys.stdin", terminal)
    assert cli.main(["run", "spring_mass", "--out", "out"]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"Meshcat: http://\S+:\d+", shown)
    assert "Meshcat stays open; press Enter to leave" in shown
    assert terminal.read() == "more\n"  # One line was waited for.
    assert "<html" in Path("out/meshcat.html").read_text()[:200].lower()
    page = Path("out/report.html").read_text()
    assert "Goals met" in page and "meshcat.html#small" in page
    monkeypatch.setattr("sys.stdin", io.StringIO("more"))  # No terminal: ends at once.
    assert cli.main(["run", "spring_mass", "--out", "out"]) == 0
    assert "press Enter" not in capsys.readouterr().out


def test_what_an_earlier_run_left_is_destroyed_by_the_main_thread(monkeypatch):
    """A Meshcat that a thread destroys ends the process."""
    left, seen = type("Left", (), {})(), []
    left.itself = left
    weakref.finalize(left, lambda: seen.append(threading.current_thread().name))
    del left

    def collects(*_):
        gc.collect()
        return 0, 0, {}

    gc.disable()
    try:
        monkeypatch.setattr(trials._Running, "run", collects)
        trials.run_many(
            "spring_mass", [({}, 0)], 2, Path("out"), 1.0, command=spring_mass.COMMAND
        )
    finally:
        gc.enable()
    assert seen == ["MainThread"]


def test_a_failing_run_is_reported_and_the_others_go_on(capsys):
    runs = [({"noise": "abc"}, 0), ({"fail_at_sec": 0.5}, 0), ({"noise": 0.0}, 1)]
    results = trials.run_many(
        "spring_mass", runs, 2, Path("out"), 10.0, command=spring_mass.COMMAND
    )
    assert [r["success"] for r in results] == [False, False, True]
    assert results[0]["error"] == (
        'exit status 2: makebreak: --set noise: got "abc", expected a number'
    )
    assert "a fault in the middle" in results[1]["error"]
    assert results[2]["seed"] == 1 and "error" not in results[2]
    assert "expected a number" in capsys.readouterr().err


def test_runs_are_reused_only_when_asked_and_only_the_same_ones():
    def go(settings, duration, reuse):
        runs = [(settings, 0)]
        command = spring_mass.COMMAND
        [result] = trials.run_many(
            "spring_mass", runs, 1, Path("out"), duration, reuse, command
        )
        return result

    first = go({"noise": 0.0}, 5.0, False)
    path = Path(first["out_dir"]) / "result.json"
    path.write_text(path.read_text().replace('"success": ', '"mark": 1, "success": '))
    assert go({"noise": 0.0}, 5.0, True)["mark"] == 1
    assert "mark" not in go({"noise": 0.0}, 6.0, True)


def test_run_many_refuses_no_jobs_and_the_same_run_twice():
    with pytest.raises(ValueError, match="jobs: got 0, expected 1 or more"):
        trials.run_many("spring_mass", [({}, 0)], 0, Path("out"))
    with pytest.raises(ValueError, match="seed=0 is there twice"):
        trials.run_many("spring_mass", [({}, 0), ({}, 0)], 1, Path("out"))


def test_compile_runs_for_a_second_and_leaves_no_files(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(trials, "_COMMAND", spring_mass.COMMAND)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert cli.main(["compile", "spring_mass", "--jobs", "1"]) == 0
    assert list(tmp_path.iterdir()) == []
    assert cli.main(["compile", "spring_mas"]) == 2
    assert "did you mean spring_mass?" in capsys.readouterr().err


def test_bench_prints_table_and_json_and_outlives_a_failing_bench(
    capsys, monkeypatch, tmp_path
):
    (tmp_path / "bench_good.py").write_text(
        "def rows():\n    return [{'what': 'a', 'value': 1.5, 'unit': 'ms'}]\n"
    )
    (tmp_path / "bench_bad.py").write_text("def rows():\n    raise ValueError('no')\n")
    monkeypatch.syspath_prepend(tmp_path)
    benches = {"good": "bench_good", "bad": "bench_bad", "gone": "bench_gone"}
    monkeypatch.setattr(bench, "BENCHES", benches)
    assert cli.main(["bench", "good"]) == 0
    text = capsys.readouterr().out
    assert json.loads(text[text.index("{") :])["rows"] == [
        {"bench": "good", "what": "a", "value": 1.5, "unit": "ms"}
    ]
    assert cli.main(["bench"]) == 1
    text = capsys.readouterr().out
    assert "failed: ValueError: no" in text and "1.5" in text
    [bad] = [r for r in json.loads(text[text.index("{") :])["rows"] if not r["value"]]
    assert bad["bench"] == "bad" and bad["note"] == "failed: ValueError: no"


def test_bench_diagrams_gives_the_real_time_factor_of_each_setting(monkeypatch):
    from makebreak.benchmarks import diagrams as bench_diagrams

    monkeypatch.setattr(trials, "_COMMAND", spring_mass.COMMAND)
    monkeypatch.setattr(bench_diagrams, "EXPERIMENTS", experiments.EXPERIMENTS)
    monkeypatch.setattr(bench_diagrams, "ALONE_SEC", 0.2)
    alone, row = bench_diagrams.rows()
    assert row["what"] == "spring_mass, soft" and row["value"] > 0
    assert alone["plants"] == 1.0
    assert row["plants"] == alone["value"] / row["value"] < 1.0  # One mass, no arm.
    monkeypatch.setattr(spring_mass, "BENCH", {"hard": {"spring.stiffness": -1.0}})
    _, row = bench_diagrams.rows()
    assert row["what"] == "spring_mass, hard" and row["value"] is None
    assert "exit status 2: makebreak: spring.stiffness: got -1.0" in row["note"]
    assert row["met"] is False


@pytest.mark.parametrize("name", ALL)
def test_the_settings_of_every_bench_are_accepted(name):
    """By the config; and by what wall_friction asks of its training."""
    module = import_module(ALL[name])
    for values in getattr(module, "BENCH", {"": {}}).values():
        config = apply_settings(module.Config(), trials.setting_texts(values))
        if name == "wall_friction":
            assert config.training.trials >= len(module.VARIED)


def test_help_explains_every_argument_and_names_what_may_be_named():
    parser = make_parser(cli._COMMANDS)
    (commands,) = (a.choices for a in parser._actions if a.choices)
    for name, command in commands.items():
        assert command.description, name
        for action in command._actions:
            assert len((action.help or "").split()) > 1, (name, action.dest)

    def said(name, dest):
        (text,) = (a.help for a in commands[name]._actions if a.dest == dest)
        return set(re.findall(r"\w+", text))

    assert set(bench.BENCHES) <= said("bench", "names")
    assert set(cli._COMPILED) <= said("compile", "experiments")
    assert {"ball_rolling", *SETTINGS} <= said("close-the-loop", "experiment")


@pytest.mark.parametrize("words", [["list"], ["--help"], ["run", "--help"]])
def test_list_and_help_import_nothing_that_is_long_to_load(words):
    code = "import sys; from makebreak.scripts.cli import main\n"
    code += f"try: main({words!r})\nexcept SystemExit: pass\n"
    code += "print([m for m in sys.modules if m in {'pydrake', 'numba', 'scipy', "
    code += "'matplotlib', 'cv2', 'sklearn', 'tqdm'}])"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=trials.run_environment(),
    )
    assert done.returncode == 0 and done.stdout.splitlines()[-1] == "[]", done.stderr


def test_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"makebreak {makebreak.__version__}\n"
    assert f'version = "{makebreak.__version__}"' in PYPROJECT.read_text()


def test_python_m_makebreak_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "makebreak", "run", "no_such_experiment"],
        capture_output=True,
        text=True,
        env=trials.run_environment(),
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("makebreak: unknown experiment no_such_experiment")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("given, taken", [(None, "1"), ("3", "3")])
def test_a_command_uses_one_thread_a_process_if_nothing_else_is_said(given, taken):
    code = """if True:
        import os, sys
        import makebreak.scripts
        assert "numpy" not in sys.modules
        import makebreak.scripts.cli
        print(os.environ["OMP_NUM_THREADS"])"""
    env = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"}
    env |= {"OMP_NUM_THREADS": given} if given else {}
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True
    )
    assert done.stdout.strip() == taken, done.stderr

import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import spring_mass

from makebreak.scripts.cli import commands as cli
from makebreak.scripts.experiments import EXPERIMENTS
from makebreak.scripts.runner import trials
from makebreak.scripts.runner.settings import apply_settings
from makebreak.scripts.runner.sweep import Sweep, _plot, run_sweep, wilson


@pytest.fixture(autouse=True)
def registered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(EXPERIMENTS, "spring_mass", "spring_mass")
    monkeypatch.setattr(trials, "_COMMAND", spring_mass.COMMAND)


def sweep(*vary, n=2, **more):
    return Sweep("spring_mass", spring_mass.Config(), vary, n, **more)


def rows_of(path):
    with Path(path).open() as file:
        return list(csv.DictReader(file))


def test_wilson_interval_has_its_closed_form():
    z = 1.959963984540054  # 97.5 % of the normal distribution.
    for k, n in ((0, 20), (7, 20), (20, 20), (1, 1)):
        p, c = k / n, z * z / n
        half = z * np.sqrt(p * (1 - p) / n + c / (4 * n))
        expected = [(p + c / 2 + sign * half) / (1 + c) for sign in (-1, 1)]
        np.testing.assert_allclose(wilson(k, n), expected, atol=1e-12)
    assert wilson(0, 0) == (0.0, 1.0)


def test_listed_values_are_cases_and_ranges_are_drawn_per_seed():
    s = sweep("noise=0.1:0.2", "damped=true,false", "steps=3:5", n=40, first_seed=7)
    assert s.cases == [{"damped": True}, {"damped": False}]
    runs = s.runs()
    assert [seed for _, seed in runs] == [*range(7, 47)] * 2
    for with_, without in zip(runs[:40], runs[40:], strict=True):
        assert with_[0] == without[0] | {"damped": True}  # The same draws in each case.
    noise = np.array([settings["noise"] for settings, _ in runs[:40]])
    assert 0.1 <= noise.min() < 0.12 < 0.18 < noise.max() <= 0.2
    assert {settings["steps"] for settings, _ in runs} == {3, 4, 5}
    # A seed's draw depends neither on the other keys nor on how many trials there are.
    alone = sweep("noise=0.1:0.2", n=3, first_seed=7).runs()
    assert [r[0]["noise"] for r in alone] == noise[:3].tolist()


@pytest.mark.parametrize(
    "vary, message",
    [
        ("noise", 'got "noise", expected key=lo:hi or key=a,b,c'),
        ("nois=0:1", "unknown key nois; did you mean noise?"),
        ("noise=1:0", 'got "noise=1:0", expected lo below hi'),
        ("noise=a:1", 'noise: got "a", expected a number'),
        ("steps=1.5,2", 'steps: got "1.5", expected an integer'),
        ("damped=false:true", "expected two numbers"),
        ("seed=1:2", "got seed, expected another key"),
    ],
)
def test_bad_ranges_are_one_line_and_status_2(vary, message, capsys):
    args = ["sweep", "spring_mass", "--trials", "1", "--vary", vary, "--out", "out"]
    assert cli.main(args) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not Path("out").exists()


def test_a_sweep_writes_table_rows_and_plots(capsys):
    args = ["sweep", "spring_mass", "--trials", "2", "--set", "steps=800"]
    args += ["--vary", "noise=0.0:0.1", "damped=true,false", "--jobs", "2"]
    args += ["--out", "out"]
    assert cli.main(args) == 0
    shown = capsys.readouterr().out
    low, high = wilson(2, 2)
    assert f"2 of 2, {100 * low:.0f}-{100 * high:.0f} %" in shown
    rows = rows_of("out/sweep.csv")
    assert (
        len(rows) == 4 and [r["damped"] for r in rows] == ["True"] * 2 + ["False"] * 2
    )
    runs = Sweep("spring_mass", apply_settings(spring_mass.Config(), ["steps=800"]),
                 ["noise=0.0:0.1", "damped=true,false"], 2).runs()  # fmt: skip
    for row, (settings, seed) in zip(rows, runs, strict=True):
        own = spring_mass.Config(**settings, seed=seed)
        assert float(row["noise"]) == own.noise and int(row["seed"]) == seed
        if own.damped:
            assert row["success"] == "True"
    summary = json.loads(Path("out/sweep.json").read_text())
    assert [case["success"]["of"] for case in summary["cases"]] == [2, 2]
    # What was not measured: "-" in the table, null or an empty cell in the files.
    assert "nan" not in shown + Path("out/sweep.md").read_text()
    page = Path("out/report.html").read_text()
    assert page.count("data:image/png") == len(list(Path("out").glob("*.png"))) > 0
    assert {row["touched_s"] for row in rows} == {""}
    assert json.loads(rows[0]["bounces_error_m"]) == [0.5, None]
    assert Path("out/noise.png").read_bytes()[:4] == b"\x89PNG"


def test_a_plot_tells_the_cases_of_another_setting_apart():
    s = sweep("noise=0.1,0.3", "damped=true,false", n=2)
    # Damped ones succeed, with an error of their noise; the others with ten times it.
    results = [
        {"success": settings["damped"],
         "error_m": settings["noise"] * (1.0 if settings["damped"] else 10.0)}
        for settings, _ in s.runs()
    ]  # fmt: skip
    figure = _plot(s, "noise", s.runs(), results, {"error_m": "mean"})
    rate, error = figure.axes
    assert [t.get_text() for t in figure.legends[0].get_texts()] == [
        "damped=true", "damped=false"]  # fmt: skip
    points = {}
    for line in error.lines:
        for x, y in zip(line.get_xdata(), line.get_ydata(), strict=True):
            points.setdefault(line.get_color(), set()).add((round(x, 1), round(y, 6)))
    assert points == {"C0": {(0.1, 0.1), (0.3, 0.3)}, "C1": {(0.1, 1.0), (0.3, 3.0)}}
    middle = [line.get_ydata().tolist() for line in rate.lines if len(line.get_xdata())]
    assert [1.0, 1.0] in middle and [0.0, 0.0] in middle
    assert error.get_ylabel() == "error [m]"
    named = _plot(s, "damped", s.runs(), results, {"error_m": "mean"})
    assert [t.get_text() for t in named.axes[-1].get_xticklabels()] == ["true", "false"]


def test_a_trial_that_crashes_is_a_failed_trial_with_its_reason():
    die = """
if '1' in sys.argv:
    import os, signal
    os.kill(os.getpid(), signal.SIGSEGV)
sys.exit(main())
"""
    crashing = spring_mass.MAIN.replace("sys.exit(main())", die)
    table, _ = run_sweep(
        sweep(n=2), Path("out"), 2, command=(sys.executable, "-c", crashing)
    )
    assert "1 of 2" in str(table.rows[0])  # --seed 1 is the one.
    [note] = table.notes
    assert "seed 1 failed: killed by SIGSEGV" in note
    [row] = [r for r in rows_of("out/sweep.csv") if r["error"]]
    assert row["seed"] == "1" and row["success"] == "False"


SLOW = """
import time
from makebreak.scripts.runner import trials
trials._COMMAND = {command!r}
import spring_mass
from pathlib import Path
from makebreak.scripts.runner.sweep import Sweep, run_sweep
config = spring_mass.Config(steps=800)
run_sweep(Sweep("spring_mass", config, ["noise=0.0:0.1"], 2), Path({out!r}), 1)
"""


def start_sweep(out):
    """A whole sweep in a process of its own."""
    main = spring_mass.MAIN.replace("from makebreak.scripts.cli import main", "")
    main = main.replace(
        "sys.exit(main())", SLOW.format(command=spring_mass.COMMAND, out=str(out))
    )
    return subprocess.Popen([sys.executable, "-c", main], env=trials.run_environment())


@pytest.mark.slow
def test_a_killed_sweep_goes_on_to_the_same_table(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert start_sweep(whole).wait(timeout=240) == 0
    process = start_sweep(killed)
    end = time.monotonic() + 120
    while not (done := list(killed.glob("trials/*/result.json"))):
        assert time.monotonic() < end
        time.sleep(0.01)
    process.kill()  # SIGKILL: it can tell nobody.
    process.wait()
    done = {path: path.read_bytes() for path in killed.glob("trials/*/result.json")}
    assert len(done) == 1
    # Its runs end with it: nothing is added once they are gone.
    time.sleep(0.5)
    now = set(killed.glob("trials/*/result.json"))
    time.sleep(3.0)
    assert set(killed.glob("trials/*/result.json")) == now
    stamps = {path: path.stat().st_mtime_ns for path in now}
    assert start_sweep(killed).wait(timeout=240) == 0
    for path, stamp in stamps.items():  # What had ended was not repeated.
        assert path.stat().st_mtime_ns == stamp
    for name in ("sweep.md", "sweep.json", "sweep.csv"):
        assert (killed / name).read_bytes() == (whole / name).read_bytes()


def test_an_unfinished_result_is_run_again():
    run_sweep(sweep(n=1), Path("out"), 1, command=spring_mass.COMMAND)
    [path] = Path("out").rglob("result.json")
    text = path.read_text()
    path.write_text(text[: len(text) // 2])  # As a kill in the middle leaves it.
    run_sweep(sweep(n=1), Path("out"), 1, command=spring_mass.COMMAND)
    assert path.read_text() == text


@pytest.mark.parametrize(
    "cluster, message",
    [
        ("localhost", 'got "localhost", expected tcp://HOST:PORT'),
        ("ray://127.0.0.1:9", "expected tcp://HOST:PORT"),
        ("tcp://127.0.0.1:9", "tcp://127.0.0.1:9"),
        ("ray:127.0.0.1:9", "ray:127.0.0.1:9"),
    ],
)
def test_a_cluster_that_is_not_there_is_one_line_and_status_2(cluster, message, capfd):
    args = ["sweep", "spring_mass", "--trials", "1", "--cluster", cluster]
    assert cli.main([*args, "--out", "out"]) == 2
    last = capfd.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("makebreak: --cluster") and message in last


def sweep_on(cluster):
    local, _ = run_sweep(
        sweep("noise=0:0.1"), Path("local"), 1, None, spring_mass.COMMAND
    )
    far, _ = run_sweep(
        sweep("noise=0:0.1"), Path("far"), 1, cluster, spring_mass.COMMAND
    )
    assert far.rows == local.rows and not far.notes
    for name in ("sweep.csv", "sweep.json"):
        assert Path("far", name).read_bytes() == Path("local", name).read_bytes()
    assert len(list(Path("far").rglob("config.yaml"))) == 2


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_results():
    distributed = pytest.importorskip("distributed", reason="the extra dask is missing")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        sweep_on(cluster.scheduler_address)


@pytest.mark.slow
def test_a_ray_cluster_gives_the_same_results():
    pytest.importorskip("ray", reason="the extra ray is missing")
    ray = [sys.executable, "-m", "ray.scripts.scripts"]
    address = "127.0.0.1:26379"
    start = [*ray, "start", "--head", "--port", "26379", "--num-cpus", "2",
             "--include-dashboard=false", "--disable-usage-stats"]  # fmt: skip
    subprocess.run(start, check=True, env=os.environ)
    try:
        sweep_on(f"ray:{address}")
    finally:
        subprocess.run([*ray, "stop"], check=True)


def test_a_sweep_does_not_write_over_another_commands_files(capsys):
    Path("out").mkdir()
    for name in ("sweep.csv", "result.json"):
        Path("out", name).write_text("of the user\n")
        assert cli.main("sweep spring_mass --trials 1 --out out".split()) == 2
        assert f"holds {name}, which makebreak did not write" in capsys.readouterr().err
        assert Path("out", name).read_text() == "of the user\n"
        Path("out", name).unlink()
    assert sorted(Path("out").iterdir()) == []
    assert cli.main("sweep spring_mass --trials 1 --jobs 1 --out out".split()) == 0
    first = Path("out/sweep.csv").read_text()
    assert cli.main("sweep spring_mass --trials 2 --jobs 1 --out out".split()) == 0
    assert len(rows_of("out/sweep.csv")) == 2
    assert Path("out/sweep.csv").read_text().startswith(first.rstrip("\n"))

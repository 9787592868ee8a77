"""The command line, `makebreak COMMAND`.

Exit status: 0 done; 1 it ran and did not meet its criterion; 2 bad input, one line on
stderr; 3 a fault of makebreak itself, one line that names the file with the traceback;
130 ended by Ctrl-C.
"""

import argparse
import dataclasses
import logging
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import partial, reduce
from importlib import import_module
from pathlib import Path

import yaml

import makebreak
from makebreak.models.typed_yaml import nearest
from makebreak.scripts.experiments import EXPERIMENTS, load_experiment, summary_of
from makebreak.scripts.faults import fault, is_drakes, on_purpose, refused
from makebreak.scripts.interrupts import interrupts
from makebreak.scripts.parent import end_with_parent
from makebreak.scripts.settings import (
    apply_settings,
    dump_config,
    field_types,
    load_config,
)

# What `reproduce` knows beside the experiments; only by its name.
_BENCHMARKS = {
    "gap": "makebreak.scripts.gap_benchmark",
    "faults": "makebreak.scripts.fault_trials",
}
_COMPILED = ("ball_rolling", "cartpole_walls")  # By `compile`, without names.
_REFUSED = "exit status 2"
_MODELS = Path(__file__).resolve().parent.parent / "models"


class _Parser(argparse.ArgumentParser):
    """argparse, but with one line on stderr where the input is wrong, and no shortened
    options: --seed of `run` is not --seeds of `reproduce`."""

    def __init__(self, **kwargs):
        kwargs["allow_abbrev"] = False
        super().__init__(**kwargs)

    def error(self, message):
        raise ValueError(f"{message} (see {self.prog} --help)")


def _number(text: str, name: str, least: float, whole: bool = False) -> float:
    """A number of the command line. Raises: ValueError below `least`, or if not one."""
    try:
        value = int(text) if whole else float(text)
    except ValueError:
        value = float("nan")
    good = value >= least if whole else least < value < float("inf")
    if not good:
        kind = f"whole number, {least} or more" if whole else f"number above {least:g}"
        raise ValueError(f'{name}: got "{text}", expected a {kind}')
    return value


def _jobs(text: str | None) -> int:
    """How many processes at once; None: one per core that may be used."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    return int(_number(str(cores) if text is None else text, "--jobs", 1, whole=True))


def _experiment(name: str):
    """The module of an experiment. Raises: ValueError for an unknown name."""
    if name not in EXPERIMENTS:
        raise ValueError(f"unknown experiment {name}; {nearest(name, EXPERIMENTS)}")
    return load_experiment(name)


def scenes() -> dict[str, Path]:
    """{name: file} of the scenes that come with makebreak."""
    found = {}
    for path in sorted(_MODELS.rglob("*.yaml")):
        try:
            content = yaml.safe_load(path.read_text())
        except yaml.YAMLError:
            continue
        if isinstance(content, dict) and "directives" in content:
            found[_scene_name(path.relative_to(_MODELS).as_posix())] = path
    return found


def _scene_name(file: str) -> str:
    return file.removesuffix(".yaml").removesuffix(".scene")


def _scene(text: str, option: str) -> str:
    """The file of a scene that is given by its path or by its name in `list`."""
    if Path(text).is_file():
        return str(Path(text).resolve())
    shipped = scenes()
    if _scene_name(text) in shipped:
        return str(shipped[_scene_name(text)])
    hint = f" ({nearest(text, shipped)})" if shipped else ""
    raise ValueError(f'{option}: got "{text}", expected a scene file{hint}')


def _config(module, args: argparse.Namespace):
    """The experiment's config: --config, then --world and --model, --set, --seed."""
    if args.config is None:
        config = module.Config()
    else:
        config = load_config(module.Config, Path(args.config))
    for option in ("world", "model"):
        text = getattr(args, option)
        if text is None:
            continue
        if not isinstance(getattr(config, option, None), str):
            raise ValueError(f"--{option}: {args.experiment} has no {option} scene")
        path = _scene(text, f"--{option}")
        config = dataclasses.replace(config, **{option: path})
    config = apply_settings(config, args.set)
    motion = getattr(config, "pattern", "")
    if isinstance(motion, str) and Path(motion).is_file():
        config = dataclasses.replace(config, pattern=str(Path(motion).resolve()))
    config = _with_faults(config, getattr(args, "fault", []), args.experiment)
    if args.seed is not None:
        seed = int(_number(args.seed, "--seed", 0, whole=True))
        config = apply_settings(config, [f"seed={seed}"])
    if getattr(config, "seed", 0) < 0:
        raise ValueError(f"seed: got {config.seed}, expected 0 or more")
    return config


def _with_faults(config, texts: Sequence[str], experiment: str):
    """The config with the faults of --fault beside its own.

    Raises: ValueError for a fault that there is not, or an experiment without an arm.
    """
    if not texts:
        return config
    from makebreak.diagrams.fault_kinds import read_fault

    keys = [k for k in field_types(type(config)) if k.rpartition(".")[2] == "faults"]
    for text in texts:
        read_fault(text)
    if not keys:
        raise ValueError(f"--fault: {experiment} has no arm that takes faults")
    there = reduce(getattr, keys[0].split("."), config)
    given = ", ".join(f"'{text}'" for text in (*there, *texts))
    return apply_settings(config, [f"{keys[0]}=[{given}]"])


def _inputs(args, config) -> list[str]:
    """The files that a run reads."""
    files = [getattr(config, name, None) for name in ("world", "model", "pattern")]
    return [path for path in (args.config, *files) if isinstance(path, str) and path]


def _default_out(name: str) -> Path:
    """runs/<name>-<time>, or with -2, -3 ... where that is taken."""
    stem = f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    path, n = Path("runs") / stem, 1
    while path.exists():
        n += 1
        path = Path("runs") / f"{stem}-{n}"
    return path


def fault_lines() -> dict[str, str]:
    """{name: what it is, with its settings} of the faults of `run --fault`."""
    from makebreak.diagrams.fault_kinds import FAULTS

    lines = {}
    for name, kind in FAULTS.items():
        own = ", ".join(f"{key}={value:g}" for key, value in kind.numbers.items())
        lines[name] = f"{kind.says} ({own})" if own else kind.says
    return lines


def _list(args) -> int:
    if args.experiment is not None:
        from makebreak.scripts.settings_list import settings_table

        config = _experiment(args.experiment).Config()
        print(settings_table(args.experiment, config, args.text).to_text())
        return 0
    names: dict[str, dict[str, str]] = {"experiments": {}, "scenes": {}}
    for name in EXPERIMENTS:
        try:
            names["experiments"][name] = summary_of(name)
        except ImportError as error:
            names["experiments"][name] = f"(cannot be loaded: {error})"
    for name, path in scenes().items():
        first = path.read_text().splitlines()[0]
        names["scenes"][name] = first.lstrip("# ") if first.startswith("#") else ""
    names["faults"] = fault_lines()
    width = max((len(n) for group in names.values() for n in group), default=0)
    for group, lines in names.items():
        print(f"{group}:")
        for name, line in lines.items():
            print(f"  {name:{width}}  {line}".rstrip())
    return 0


def _open_meshcat():
    """Drake's viewer, with the address printed.

    Raises: ValueError if it cannot be opened.
    """
    from pydrake.geometry import Meshcat

    log = logging.getLogger("drake")
    level = log.level
    log.setLevel(logging.WARNING)  # It would say the address a second time.
    try:
        meshcat = Meshcat()
    except RuntimeError as error:
        raise ValueError(f"Meshcat: {error}; --no-meshcat runs without") from error
    finally:
        log.setLevel(level)
    print(f"Meshcat: {meshcat.web_url()}", flush=True)
    return meshcat


def _run(args) -> int:
    from makebreak.scripts.diagram_picture import FORMATS
    from makebreak.scripts.session import Session

    module = _experiment(args.experiment)
    duration = None
    if args.duration is not None:
        duration = _number(args.duration, "--duration", 0.0)
    realtime = 0.0
    if args.realtime is not None:
        realtime = _number(args.realtime, "--realtime", 0.0)
    config = _config(module, args)
    run = _runner(module, args)
    out = Path(args.out) if args.out else _default_out(args.experiment)
    if args.diagram is not None and Path(args.diagram).suffix not in FORMATS:
        raise ValueError(
            f'--diagram: got "{args.diagram}", expected a file {", ".join(FORMATS)}'
        )
    with Session(
        out,
        None,
        duration,
        realtime,
        command=f"run {args.experiment}",
        inputs=_inputs(args, config),
    ) as session:
        return _run_in(session, args, run, config, duration)


def _runner(module, args):
    """What runs the experiment, (config, session) -> result, on the robot of --robot.

    Raises: ValueError for a robot that there is not, or that the experiment cannot use.
    """
    kind, *rest = args.robot
    if kind == "sim" and not rest:
        return module.run
    if kind == "lcm" and len(rest) <= 1:
        if not hasattr(module, "run_on_lcm"):
            raise ValueError(f"--robot lcm: {args.experiment} cannot be run on it yet")
        from makebreak.diagrams.lcm_station import URL

        args.no_meshcat = True  # Its pictures would cost the loop's time.
        return partial(module.run_on_lcm, url=rest[0] if rest else URL)
    if kind == "replay" and len(rest) == 1:
        if not hasattr(module, "run_on_recording"):
            raise ValueError(
                f"--robot replay: {args.experiment} cannot be replayed yet"
            )
        return partial(module.run_on_recording, recording=Path(rest[0]))
    raise ValueError(
        f"--robot: got {' '.join(args.robot)}, expected sim, lcm [URL] or replay "
        "RECORDING"
    )


def _run_in(session, args, run, config, duration) -> int:
    """Runs the experiment in the session. Returns: the exit status."""
    from makebreak.scripts import compile_ahead
    from makebreak.scripts.criteria import success_text
    from makebreak.scripts.run_buttons import StartOver
    from makebreak.scripts.table import Table
    from makebreak.scripts.trials import duration_line

    if session.outputs.salvaged is not None:
        print(
            "makebreak: an earlier run here was killed; what it had recorded is in "
            f"{session.outputs.salvaged}",
            file=sys.stderr,
        )
    session.picture = Path(args.diagram) if args.diagram is not None else None
    session.write_text("config.yaml", duration_line(duration) + dump_config(config))
    _writable(session)
    if not args.is_trial:  # Trials keep all cores busy as it is.
        config_file = session.path("config.yaml")
        session.on_first_compile = partial(
            compile_ahead.start, args.experiment, config_file
        )
    if not args.no_meshcat:
        session.meshcat = _open_meshcat()

    session.restarts = True
    result = None
    try:
        while result is None:
            try:
                result = dict(run(config, session))
            except StartOver:
                session.start_over()
    except KeyboardInterrupt:
        session.interrupted = True
    except (Exception, SystemExit) as error:
        if session.interrupted:  # Too short a recording to be scored.
            pass
        elif not session.started:  # The input does not fit.
            return refused(error)
        else:
            session.keep_partial()
            if isinstance(error, OSError):
                session.unwritten = error
                session.finish(complete=False)
                _writable(session)
            session.write_text("error.txt", traceback.format_exc())
            files = session.finish(complete=False)
            kept = [path for path in files if path.name == "error.txt"]
            return fault(error, kept[0] if kept else None)
    if result is None:
        session.keep_partial()
    else:
        result |= session.limits_kept()
        result |= {"interrupted": session.interrupted, "ended": session.endings}
        session.write_result(result)
    whole = not session.interrupted and session.unwritten is None
    files = session.finish(whole)
    if result is not None:
        rows = [(k, v) for k, v in result.items() if k not in ("criteria", "ended")]
        print(Table(args.experiment, ("result", "value"), rows).to_text())
        lines = [*session.endings, *session.too_slow(), success_text(result)]
        print("\n".join(lines), flush=True)
    _say_files(files)
    if session.compared_by:
        print(f"What the model lacks: {session.compared_by}", flush=True)
    _writable(session)
    if session.interrupted:
        print("makebreak: interrupted; what was recorded is kept", file=sys.stderr)
        return 130
    if session.meshcat is not None and sys.stdin is not None and sys.stdin.isatty():
        try:
            input("Meshcat stays open; press Enter to leave")
        except (EOFError, KeyboardInterrupt):
            print()
    return 0 if result is not None and result["success"] else 1


def _writable(session) -> None:
    """Raises: ValueError if a file could not be written."""
    if session.unwritten is not None:
        error = session.unwritten
        raise ValueError(
            f"--out: not all files could be written in {session.out_dir} "
            f"({error.strerror or error}); what could be written is kept"
        )


def _say_files(files: Sequence[Path]) -> None:
    """The line that tells what was written, and where: the folder of the first file, as
    an interrupted run may have a subfolder."""
    if files:
        folder = Path(os.path.commonpath([path.parent for path in files]))
        names = " ".join(path.relative_to(folder).as_posix() for path in files)
        print(f"Files in {folder}: {names}", flush=True)


def _station(args) -> int:
    import json

    from makebreak.diagrams.lcm_station import URL
    from makebreak.scripts.session import CatchInterrupt
    from makebreak.scripts.stand_in import StandIn, StandInConfig
    from makebreak.scripts.table import Table

    module = _experiment(args.experiment)
    if not hasattr(module, "run_on_lcm"):
        raise ValueError(f"station: {args.experiment} has no station behind LCM yet")
    rate = _number(args.rate, "--rate", 0.0)
    if rate > 1.0:
        raise ValueError(f"--rate: got {rate:g}, expected at most 1, real time")
    drop = _number(args.drop, "--drop", -1e-300)
    if not drop < 1.0:
        raise ValueError(f"--drop: got {drop:g}, expected a share from 0 to below 1")
    delay = _number(args.delay, "--delay", -1e-300)
    duration = _number(args.duration, "--duration", 0.0)
    config = _config(module, args)
    told = StandInConfig(rate, max(drop, 0.0), max(delay, 0.0), args.url or URL)
    stand_in = StandIn(config, told, config.seed)
    print(f"The station sends on {told.url}; Ctrl-C ends it", flush=True)
    with CatchInterrupt() as interrupt:
        stand_in.run(duration, lambda: interrupt.hit)
    result = stand_in.report.result()
    print(Table("station", ("result", "value"), list(result.items())).to_text())
    print(json.dumps(result), flush=True)
    return 0


def _reproduce(args) -> int:
    from makebreak.scripts.session import Session

    names = args.experiments or list(EXPERIMENTS)
    modules = {
        name: import_module(_BENCHMARKS[name])
        if name in _BENCHMARKS
        else _experiment(name)
        for name in names
    }
    if args.experiments:
        for name, module in modules.items():
            if not hasattr(module, "reproduce"):
                raise ValueError(f"{name} has nothing to reproduce")
            if hasattr(module, "check"):
                module.check(args.which)
    seeds = int(_number(args.seeds, "--seeds", 1, whole=True))
    seed = None
    if args.seed is not None:
        if any(name not in _BENCHMARKS for name in names):
            raise ValueError("--seed is of gap and faults; did you mean --seeds?")
        seed = int(_number(args.seed, "--seed", 0, whole=True))
    jobs = _jobs(args.jobs)
    out = Path(args.out) if args.out else _default_out("reproduce")
    with Session(out, reuse=args.reuse, command="reproduce") as session:
        try:
            status = _reproduce_in(session, modules, seeds, jobs, args, seed)
        except KeyboardInterrupt:
            _say_files(session.finish(complete=False))
            raise
        _say_files(session.finish(complete=status != 3))
        _writable(session)
    return status


def _reproduce_in(session, modules, seeds: int, jobs: int, args, seed) -> int:
    """The tables of all modules; seed: of benchmarks, or None. Returns: the exit
    status."""
    from makebreak.scripts.hypotheses import verdicts

    tables = {}

    def show(name, table):
        tables[name] = table
        print(table.to_text(), flush=True)
        # Written after each: an interrupted run keeps what is done.
        session.write_json(
            "reproduce.json", {n: t.to_dict() for n, t in tables.items()}
        )
        session.write_text(
            "reproduce.md", "\n".join(t.to_markdown() for t in tables.values())
        )

    for name, module in modules.items():
        if hasattr(module, "reproduce"):
            extra = (args.which, args.only, seed) if name in _BENCHMARKS else ()
            with session.child(name) as child:
                try:
                    table = module.reproduce(child, seeds, jobs, *extra)
                except (Exception, SystemExit) as error:
                    return fault(error)  # All input is checked above.
                child.finish()
            show(name, table)
    verdict = verdicts(tables)
    if verdict is not None:
        show("hypotheses", verdict)
    missed = sum(t.missed for name, t in tables.items() if name != "hypotheses")
    if missed:
        print(f"makebreak: {missed} rows miss their target", file=sys.stderr)
    return 1 if missed else 0


def _sweep(args) -> int:
    from makebreak.scripts.sweep import Sweep, run_sweep

    module = _experiment(args.experiment)
    config = _config(module, args)  # Refuses what is wrong before anything is run.
    duration = None
    if args.duration is not None:
        duration = _number(args.duration, "--duration", 0.0)
    sweep = Sweep(
        args.experiment,
        config,
        [text for group in args.vary for text in group],
        trials=int(_number(args.trials, "--trials", 1, whole=True)),
        first_seed=config.seed,
        duration_sec=duration,
    )
    out = Path(args.out) if args.out else _default_out(f"sweep-{args.experiment}")
    if args.cluster is not None and args.jobs is not None:
        raise ValueError("--jobs: got it with --cluster, expected one of the two")
    inputs = _inputs(args, config)
    table, files = run_sweep(sweep, out, _jobs(args.jobs), args.cluster, inputs=inputs)
    print(table.to_text())
    _say_files(files)
    return 1 if table.notes else 0  # A note: a trial failed.


def _gap(args) -> int:
    from makebreak.gap.data.bags import is_bag, is_dataset
    from makebreak.scripts.gap_command import effects_table, run_and_report

    recordings = [Path(text) for text in args.recordings]
    for path in recordings:
        if not (path.is_file() or is_bag(path) or is_dataset(path)):
            raise ValueError(f'RECORDING: got "{path}", expected a file, or a bag')
    robot = Path(args.scene)
    is_robot = robot.suffix.lower() in (".urdf", ".sdf", ".xml")
    scene = robot if is_robot else Path(_scene(args.scene, "SCENE"))
    out = Path(args.out) if args.out else _default_out("gap")
    export = [word for word in (args.export or "").split(",") if word]
    try:
        result, files, notes = run_and_report(
            scene, recordings, out, _jobs(args.jobs), export, is_robot,
            args.skip_bad_rows,
        )  # fmt: skip
    except (Exception, SystemExit) as error:
        if on_purpose(error) or isinstance(error, OSError):
            raise
        kept = out / "error.txt"
        return fault(error, kept) if kept.exists() else refused(error)
    print(effects_table(result).to_text())
    for note in notes:
        print(note)
    _say_files(files)
    return 0


def _inspect(args) -> int:
    from makebreak.scripts.inspect_command import run_inspect

    robot = Path(args.robot) if args.robot else None
    out = Path(args.out) if args.out else None
    table, sidecar, files = run_inspect(Path(args.log), robot, out)
    print(table.to_text())
    if out is None:
        print("\nProposed sidecar; check it (--out DIR writes it to a file):\n")
        print(sidecar, end="")
    else:
        _say_files(files)
    return 0


def _close_the_loop(args) -> int:
    from makebreak.scripts.close_contact_loop import SETTINGS, close_contact_loop
    from makebreak.scripts.close_the_loop import close_the_loop

    if args.experiment not in ("ball_rolling", *SETTINGS):
        _experiment(args.experiment)
        raise ValueError(
            f"close-the-loop: {args.experiment} cannot yet be given a wrong model; "
            f"expected one of: ball_rolling, {', '.join(SETTINGS)}"
        )
    try:
        error = float(args.radius_error)
    except ValueError:
        error = float("nan")
    if not abs(error) < float("inf"):
        raise ValueError(
            f'--radius-error: got "{args.radius_error}", expected a number [m]'
        )
    seed = int(_number(args.seed, "--seed", 0, whole=True))
    duration = None
    if args.duration is not None:
        duration = _number(args.duration, "--duration", 0.0)
        if args.experiment in SETTINGS:
            raise ValueError(f"--duration: {args.experiment} ends by itself")
    apply_settings(_experiment(args.experiment).Config(), args.set)  # Or refuses.
    out = Path(args.out) if args.out else _default_out("close-the-loop")
    try:
        jobs, settings = _jobs(args.jobs), args.set
        if args.experiment == "ball_rolling":
            table = close_the_loop(out, error, seed, duration, settings, jobs)
        else:
            table = close_contact_loop(args.experiment, out, seed, settings, jobs)
    except RuntimeError as failed:
        print(f"makebreak: {failed}", file=sys.stderr)
        return 3
    print(table.to_text())
    print(f"Files in {out}: loop.json; open {out / '2_gap' / 'report.html'}")
    return 1 if table.missed else 0


def _export_tests(args) -> int:
    from makebreak.scripts.export_tests import export_tests

    module = _experiment(args.experiment)
    config = _config(module, args)
    seconds = _number(args.seconds, "--seconds", 0.0)
    wanted = [name for name in (args.systems or "").split(",") if name]
    out = Path(args.out)
    done, left_out = export_tests(
        args.experiment, module, config, out, wanted, seconds, _inputs(args, config)
    )
    for name, updates in done.items():
        print(f"test_{name}.py  {updates} updates")
    for name, reason in left_out.items():
        print(f"left out: {name}: {reason}")
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    print(f"Files in {out}, {size / 1e6:.1f} MB; run them with: pytest {out}")
    return 0


def _compile(args) -> int:
    from tempfile import TemporaryDirectory

    from makebreak.scripts.trials import makebreak_command, run_commands

    names = args.experiments or list(_COMPILED)
    modules = {name: _experiment(name) for name in names}
    jobs = _jobs(args.jobs)
    with TemporaryDirectory() as folder:
        commands, folders = [], [Path(folder) / name for name in names]
        for (name, module), out in zip(modules.items(), folders, strict=True):
            words = ["run", name, "--no-meshcat", "--out", str(out)]
            if not hasattr(module, "BENCH_SEC"):  # Any duration will do.
                words += ["--duration", "1"]
            commands.append(makebreak_command(*words))
        results = run_commands("compile", commands, folders, jobs)
    # Whether a second of it can be scored does not matter.
    broken = [r["error"] for r in results if r.get("error", "").startswith(_REFUSED)]
    if broken:
        raise ValueError(broken[0])
    return 0


def _bench(args) -> int:
    import json

    from makebreak.scripts.bench import bench

    table = bench(args.names)
    print(table.to_text())
    print(json.dumps(table.to_dict(), indent=2))
    return 1 if table.missed else 0  # A bench that failed is a missed row.


def _completion(args) -> int:
    from makebreak.scripts.completion import completion

    print(completion(_parser(), args.shell, EXPERIMENTS))
    return 0


def _config_options(
    p: argparse.ArgumentParser,
    model: str = "scene used by the controllers",
    seed: str = "seed of all random numbers",
) -> None:
    """What _config reads. Args: model, seed: the help of these two."""
    p.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", nargs="+",
        help="settings; `makebreak list EXPERIMENT` shows them",
    )  # fmt: skip
    p.add_argument("--config", metavar="FILE", help="a YAML file of settings")
    p.add_argument("--world", metavar="SCENE", help="simulated scene")
    p.add_argument("--model", metavar="SCENE", help=model)
    p.add_argument("--seed", metavar="N", help=seed)


def _fault_option(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--fault", action="append", default=[], metavar="NAME[:from=S,for=S]",
        help="fault to inject; `list` has the names",
    )  # fmt: skip


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="makebreak",
        description="Adaptive control for robots that make and break contact.",
    )
    parser.add_argument(
        "--version", action="version", version=f"makebreak {makebreak.__version__}"
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    p = commands.add_parser(
        "list",
        help="all experiments, scenes and faults; or the settings of one experiment",
    )
    p.add_argument(
        "experiment", nargs="?", metavar="EXPERIMENT", help="list its settings"
    )
    p.add_argument(
        "text", nargs="?", default="", metavar="TEXT", help="only settings with it"
    )
    p.set_defaults(function=_list)

    p = commands.add_parser("run", help="run one experiment, with Meshcat")
    p.add_argument("experiment", nargs="?", default="ball_rolling")
    _config_options(p)
    p.add_argument("--duration", metavar="S", help="simulated seconds")
    _fault_option(p)
    p.add_argument(
        "--robot", nargs="+", default=["sim"], metavar=("sim", "RECORDING"),
        help="sim (default); lcm [URL]: a robot behind LCM; replay RECORDING",
    )  # fmt: skip
    p.add_argument(
        "--no-meshcat", action="store_true", help="no viewer, no meshcat.html"
    )
    p.add_argument("--realtime", metavar="RATE", help="speed limit; 1: real time")
    p.add_argument(
        "--diagram", metavar="FILE", help="write the diagram as .svg, .png or .pdf"
    )
    p.add_argument("--out", metavar="DIR", help="default: runs/<experiment>-<time>")
    p.set_defaults(function=_run)

    p = commands.add_parser(
        "station", help="simulate a robot behind LCM, for `run --robot lcm`"
    )
    p.add_argument("experiment", nargs="?", default="ball_rolling")
    p.add_argument(
        "--rate", default="1", metavar="R", help="simulated seconds per second (1)"
    )
    p.add_argument(
        "--drop", default="0", metavar="SHARE", help="fraction of messages lost (0)"
    )
    p.add_argument("--delay", default="0", metavar="S", help="delay of messages (0)")
    p.add_argument("--url", metavar="URL", help="of LCM; default: this machine only")
    p.add_argument(
        "--duration", default="86400", metavar="S", help="simulated seconds (86400)"
    )
    _fault_option(p)
    _config_options(p, model="not used by a station")
    p.set_defaults(function=_station)

    p = commands.add_parser(
        "reproduce", help="the papers' figures and tables beside ours"
    )
    p.add_argument(
        "experiments",
        nargs="*",
        metavar="EXPERIMENT",
        help="an experiment, gap or faults; default: all experiments",
    )
    p.add_argument("--seeds", default="10", metavar="N", help="trials per case (10)")
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")
    p.add_argument(
        "--set", dest="which", default="standard", metavar="SET",
        help="for gap: standard, development, logs-development, logs-final, "
        "contact-development or contact-final",
    )  # fmt: skip
    p.add_argument(
        "--only",
        default="",
        metavar="TEXT",
        help="for gap and faults: only cases with TEXT in the name",
    )
    p.add_argument("--seed", metavar="N", help="for gap and faults: first seed")
    p.add_argument(
        "--reuse", action="store_true", help="keep complete trials of an earlier call"
    )
    p.add_argument("--out", metavar="DIR", help="default: runs/reproduce-<time>")
    p.set_defaults(function=_reproduce)

    p = commands.add_parser(
        "sweep", help="run one experiment with many seeds and settings"
    )
    p.add_argument("experiment", metavar="EXPERIMENT")
    p.add_argument("--trials", required=True, metavar="N", help="seeds for each case")
    p.add_argument(
        "--vary", action="append", default=[], metavar="KEY=LO:HI", nargs="+",
        help="LO:HI: drawn for each trial; A,B,C: each value is a case",
    )  # fmt: skip
    _config_options(p, seed="seed of the first trial (0)")
    p.add_argument("--duration", metavar="S", help="simulated seconds")
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")
    p.add_argument(
        "--cluster", metavar="ADDRESS", help="Dask: tcp://HOST:PORT; Ray: ray:HOST:PORT"
    )
    p.add_argument(
        "--out",
        metavar="DIR",
        help="default: runs/sweep-<experiment>-<time>; an earlier sweep is continued",
    )
    p.set_defaults(function=_sweep)

    p = commands.add_parser(
        "gap", help="compare a model with recordings and name what the model lacks"
    )
    p.add_argument(
        "scene",
        metavar="SCENE",
        help="the model: a scene file, a name of `list`, or a .urdf or .sdf (a scene "
        "is then proposed)",
    )
    p.add_argument(
        "recordings",
        nargs="+",
        metavar="RECORDING",
        help=".csv, .npz, .parquet, a ROS bag, a LeRobot dataset",
    )
    p.add_argument(
        "--skip-bad-rows",
        action="store_true",
        help="skip rows that cannot be read; their number is printed",
    )
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")
    p.add_argument("--out", metavar="DIR", help="default: runs/gap-<time>")
    p.add_argument(
        "--export", metavar="FORMATS", help="also write the repaired model: urdf,mjcf"
    )
    p.set_defaults(function=_gap)

    p = commands.add_parser(
        "inspect", help="show columns or topics of a log, with rates, holes and units"
    )
    p.add_argument(
        "log", metavar="LOG", help=".csv, .npz, .parquet, a ROS bag, a LeRobot dataset"
    )
    p.add_argument(
        "--robot",
        metavar="FILE",
        help=".urdf or .sdf; columns are matched to its joints",
    )
    p.add_argument("--out", metavar="DIR", help="write the proposed sidecar there")
    p.set_defaults(function=_inspect)

    p = commands.add_parser(
        "close-the-loop",
        help="run with a wrong model, gap on it, run with the repaired model",
    )
    p.add_argument("experiment", nargs="?", default="ball_rolling")
    p.add_argument(
        "--radius-error",
        default="0.005",
        metavar="M",
        help="radius error of the ball's model (0.005 m)",
    )
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", nargs="+")
    p.add_argument("--seed", default="0", metavar="N", help="seed of both runs (0)")
    p.add_argument("--duration", metavar="S", help="simulated seconds of each run")
    p.add_argument("--jobs", metavar="N", help="processes at once in gap")
    p.add_argument("--out", metavar="DIR", help="default: runs/close-the-loop-<time>")
    p.set_defaults(function=_close_the_loop)

    p = commands.add_parser(
        "export-tests",
        help="write a test for each system, from its inputs and outputs in a run",
    )
    p.add_argument("experiment", metavar="EXPERIMENT")
    p.add_argument(
        "--systems", metavar="A,B", help="names; default: all systems with updates"
    )
    p.add_argument("--out", metavar="DIR", required=True, help="a new folder")
    p.add_argument("--seconds", metavar="S", default="5", help="recorded seconds (5)")
    _config_options(p)
    p.set_defaults(function=_export_tests)

    p = commands.add_parser(
        "compile", help="compile now what the first run would compile"
    )
    p.add_argument("experiments", nargs="*", metavar="EXPERIMENT")
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")
    p.set_defaults(function=_compile)

    p = commands.add_parser("bench", help="measure compute times, as table and JSON")
    p.add_argument("names", nargs="*", metavar="NAME")
    p.set_defaults(function=_bench)

    p = commands.add_parser("completion", help="print the script for tab completion")
    p.add_argument("shell", metavar="SHELL", help="bash, zsh, fish or tcsh")
    p.set_defaults(function=_completion)
    for name in ("run", "gap", "export-tests"):
        commands.choices[name].add_argument(
            "--package", action="append", default=[], metavar="NAME=PATH",
            help="folder of package://NAME in model files",
        )  # fmt: skip
    for each in commands.choices.values():
        each.set_defaults(options=list(each._option_string_actions))
    return parser


def _parse(argv: list[str]) -> argparse.Namespace:
    """The words as a command. Raises: ValueError in one line."""
    parser = _parser()
    args, rest = parser.parse_known_args(argv)
    if rest:
        option = next((word for word in rest if word.startswith("-")), "")
        name = option.partition("=")[0]
        if not name:
            raise ValueError(f"unexpected {rest[0]} (see makebreak --help)")
        valid = [o for o in args.options if o.startswith("--")]
        valid = [o for o in valid if o.startswith(name)] or valid  # A shortened one.
        raise ValueError(f"unknown option {name}; {nearest(name, valid)}")
    return args


def main(argv: list[str] | None = None) -> int:
    """Runs one command.

    Args:
        argv: the words after `makebreak`; None: those of the process.
    Returns: the exit status.
    """
    is_trial = end_with_parent()
    with interrupts():
        return _main(sys.argv[1:] if argv is None else argv, is_trial)


@contextmanager
def _given_packages(settings: list[str]) -> Iterator[None]:
    """While entered, scenes know the packages of `--package NAME=PATH`."""
    if not settings:
        yield
        return
    from makebreak.models.scene_reader import PACKAGES_VARIABLE, give_packages

    before = os.environ.get(PACKAGES_VARIABLE)
    give_packages(settings)
    try:
        yield
    finally:
        del os.environ[PACKAGES_VARIABLE]
        if before is not None:
            os.environ[PACKAGES_VARIABLE] = before


def _main(argv: list[str], is_trial: bool) -> int:
    try:
        args = _parse(argv)
        args.is_trial = is_trial
        if hasattr(args, "set"):
            args.set = [setting for group in args.set for setting in group]
            for setting in args.set:
                if setting in EXPERIMENTS:
                    raise ValueError(f"EXPERIMENT comes before --set, got {setting}")
        with _given_packages(getattr(args, "package", [])):
            status = args.function(args)
        sys.stdout.flush()
        return status
    except ValueError as error:
        return refused(error) if on_purpose(error) else fault(error)
    except BrokenPipeError:  # As in `makebreak list | head`: nobody reads on.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # Of the machine, as a full disk; not of the program.
        print(f"makebreak: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("makebreak: interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        return fault(error)
    except SystemExit as error:
        if not is_drakes(error):
            raise
        return fault(error)

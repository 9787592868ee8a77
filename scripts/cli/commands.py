"""The command line, `makebreak COMMAND`.

Exit status: 0 done; 1 it ran and did not meet its criterion; 2 bad input, one line on
stderr; 3 a fault of makebreak itself, one line that names the file with the traceback;
130 ended by Ctrl-C.
"""

import os
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from makebreak.scripts import experiments
from makebreak.scripts.cli.arguments import (
    make_parser,
    number,
    number_of_processes,
    parse,
)
from makebreak.scripts.cli.command_inputs import (
    benchmark_module,
    experiment_config,
    experiment_module,
    input_files,
    scene_file,
    scenes,
)
from makebreak.scripts.cli.faults import fault, is_drakes, on_purpose, refused
from makebreak.scripts.cli.run_command import run, station
from makebreak.scripts.runner.interrupts import CatchInterrupt, interrupts
from makebreak.scripts.runner.outputs import check_written, default_out
from makebreak.scripts.runner.parent import end_with_parent
from makebreak.scripts.runner.settings import apply_settings
from makebreak.scripts.runner.shown import (
    print_files,
    show,
    tell,
    telling,
    terminal_width,
)

# Benchmarks that `reproduce` runs only where they are named.
_BENCHMARKS = {
    "gap": "gap_benchmark",
    "faults": "fault_trials",
    "close_the_loop": "loop_trials",
}
_COMPILED = ("ball_rolling", "cartpole_walls")  # By `compile` without arguments.
_REFUSED = "exit status 2"


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
        from makebreak.scripts.cli.settings_list import matching_rows, settings_text

        config = experiment_module(args.experiment).Config()
        width = terminal_width()
        print(settings_text(args.experiment, config, args.text, width))
        rows = matching_rows(args.experiment, config, args.text)
        tell(
            settings=[
                dict(zip(("key", "default", "says"), r, strict=True)) for r in rows
            ]
        )
        return 0
    groups: dict[str, dict[str, str]] = {"experiments": {}, "scenes": {}}
    for name in experiments.EXPERIMENTS:
        try:
            groups["experiments"][name] = experiments.summary_of(name)
        except ImportError as error:
            groups["experiments"][name] = f"(cannot be loaded: {error})"
    for name, path in scenes().items():
        first = path.read_text().splitlines()[0]
        groups["scenes"][name] = first.lstrip("# ") if first.startswith("#") else ""
    groups["faults"] = fault_lines()
    tell(**groups)
    width = max((len(n) for group in groups.values() for n in group), default=0)
    for group, lines in groups.items():
        print(f"{group}:")
        for name, line in lines.items():
            print(f"  {name:{width}}  {line}".rstrip())
    return 0


def _reproduce(args) -> int:
    from makebreak.scripts.runner.session import Session

    names = args.experiments or list(experiments.EXPERIMENTS)
    modules = {
        name: benchmark_module(_BENCHMARKS[name])
        if name in _BENCHMARKS
        else experiment_module(name)
        for name in names
    }
    if args.experiments:
        for name, module in modules.items():
            if not hasattr(module, "reproduce"):
                raise ValueError(f"{name} has nothing to reproduce")
            if hasattr(module, "check"):
                module.check(args.which, args.only)
    seeds = int(number(args.seeds, "--seeds", 1, whole=True))
    seed = None
    if args.seed is not None:
        if any(name not in _BENCHMARKS for name in names):
            raise ValueError(
                f"--seed is of {', '.join(_BENCHMARKS)}; did you mean --seeds?"
            )
        seed = int(number(args.seed, "--seed", 0, whole=True))
    jobs = number_of_processes(args.jobs)
    out = Path(args.out) if args.out else default_out("reproduce")
    with Session(out, reuse=args.reuse, command="reproduce") as session:
        try:
            status = _reproduce_in(session, modules, seeds, jobs, args, seed)
        except KeyboardInterrupt:
            print_files(session.finish(complete=False))
            raise
        print_files(session.finish(complete=status != 3))
        check_written(session)
    return status


def _reproduce_in(session, modules, seeds: int, jobs: int, args, seed) -> int:
    """The tables of all modules; seed: of benchmarks, or None. Returns: the exit
    status."""
    from makebreak.scripts.experiments.papers.hypotheses import verdicts
    from makebreak.scripts.runner.result_page import result_page

    tables = {}

    def tell_of(name, table):
        tables[name] = table
        show(table)
        # Written after each: an interrupted run keeps what is done.
        session.write_json(
            "reproduce.json", {n: t.to_dict() for n, t in tables.items()}
        )
        session.write_text(
            "reproduce.md", "\n".join(t.to_markdown() for t in tables.values())
        )
        page = result_page("makebreak reproduce", *_of_targets(tables.values()))
        session.write_text("report.html", page)

    for name, module in modules.items():
        if hasattr(module, "reproduce"):
            extra = (args.which, args.only, seed) if name in _BENCHMARKS else ()
            with session.child(name) as child:
                try:
                    table = module.reproduce(child, seeds, jobs, *extra)
                except (Exception, SystemExit) as error:
                    return fault(error)  # All input is checked above.
                child.finish()
            tell_of(name, table)
    verdict = verdicts(tables)
    if verdict is not None:
        tell_of("hypotheses", verdict)
    missed = sum(t.missed for name, t in tables.items() if name != "hypotheses")
    if missed:
        print(f"makebreak: {missed} rows miss their target", file=sys.stderr)
    return 1 if missed else 0


def _of_targets(tables) -> tuple[list, bool | None, list[str]]:
    """The tables, whether all targets in them are met (None: there are none), and
    lines of how many are, and of each that is not."""
    tables, lines = list(tables), []
    for table in tables:
        pairs = list(zip(table.cells()[1], table.met, strict=False))
        of = [met for _, met in pairs if met is not None]
        if of:
            lines.append(
                f"{table.title}: {sum(map(bool, of))} of {len(of)} targets met"
            )
        for row, met in pairs:
            if met is not None and not met:
                named = zip(table.columns[1:3], row[1:3], strict=False)
                values = ", ".join(f"{name} {value}" for name, value in named)
                lines.append(f"MISSED {row[0]}: {values}")
    return tables, not sum(t.missed for t in tables) if lines else None, lines


def _sweep(args) -> int:
    from makebreak.scripts.runner.sweep import Sweep, run_sweep

    module = experiment_module(args.experiment)
    config = experiment_config(module, args)  # Refuses before anything is run.
    duration = None
    if args.duration is not None:
        duration = number(args.duration, "--duration", 0.0)
    sweep = Sweep(
        args.experiment,
        config,
        [text for group in args.vary for text in group],
        trials=int(number(args.trials, "--trials", 1, whole=True)),
        first_seed=config.seed,
        duration_sec=duration,
    )
    out = Path(args.out) if args.out else default_out(f"sweep-{args.experiment}")
    if args.cluster is not None and args.jobs is not None:
        raise ValueError("--jobs: got it with --cluster, expected one of the two")
    inputs = input_files(args, config)
    table, files = run_sweep(
        sweep, out, number_of_processes(args.jobs), args.cluster, inputs=inputs
    )
    show(table, table.transposed() if table.is_wide else None)
    print_files(files)
    return 1 if table.notes else 0  # A note: a trial failed.


def _gap(args) -> int:
    from makebreak.scripts.cli.drake_log import DrakeLog

    with CatchInterrupt() as interrupt, DrakeLog() as drake:
        return _gap_until(args, interrupt, drake)


def _gap_until(args, interrupt, drake) -> int:
    from makebreak.gap.data.recording_files import ROBOTS, recording_files
    from makebreak.gap.data.table import has_table
    from makebreak.scripts.cli.gap_command import effects_table, run_and_report

    recordings = recording_files(args.recordings)
    robot = Path(args.scene)
    if robot.is_file() and has_table(robot):
        raise ValueError(
            f"{robot} is a recording, expected the scene or robot first: "
            "makebreak gap SCENE RECORDING"
        )
    is_robot = robot.suffix.lower() in ROBOTS
    scene = robot if is_robot else Path(scene_file(args.scene, "SCENE"))
    out = Path(args.out) if args.out else default_out("gap")
    export = [word for word in (args.export or "").split(",") if word]
    try:
        result, files, notes, is_interrupted = run_and_report(
            scene, recordings, out, number_of_processes(args.jobs), export, is_robot,
            args.skip_bad_rows, number(args.budget, "--budget", 0.0),
            lambda: interrupt.hit, drake, Path(args.sidecar) if args.sidecar else None,
        )  # fmt: skip
    except (Exception, SystemExit) as error:
        if on_purpose(error) or isinstance(error, OSError):
            raise
        kept = out / "error.txt"
        return fault(error, kept) if kept.exists() else refused(error)
    show(effects_table(result), effects_table(result, told=result.says))
    for note in notes:
        print(note)
    drake.show()
    print_files(files)
    return 130 if is_interrupted else 0


def _convert(args) -> int:
    from makebreak.gap.data.recording_files import ROBOTS, recording_files
    from makebreak.scripts.cli.convert_command import convert

    scene = Path(args.scene)
    if scene.suffix.lower() not in ROBOTS or not scene.is_file():
        scene = Path(scene_file(args.scene, "SCENE"))
    files, notes = convert(
        scene, recording_files(args.recordings),
        Path(args.out) if args.out else default_out("convert"),
        Path(args.sidecar) if args.sidecar else None, args.skip_bad_rows,
        args.to.split(","),
    )  # fmt: skip
    for note in notes:
        print(note)
    print_files(files)
    return 0


def _judge(args) -> int:
    from makebreak.scripts.cli.judge import judge_scenes

    window = number(args.window, "--window", 0.0)
    scenes = [t if Path(t).is_file() else scene_file(t, "SCENE") for t in args.scenes]
    given = Path(args.sidecar) if args.sidecar else None
    show(judge_scenes(scenes, [Path(text) for text in args.on], window, given))
    return 0


def _design_log(args) -> int:
    from makebreak.gap.design import LogPlan
    from makebreak.scripts.cli.design_command import design_log, limits_of

    plan = LogPlan(
        number(args.seconds, "--seconds", 0.0),
        number(args.period, "--period", 0.0),
        int(number(args.harmonics, "--harmonics", 2, whole=True)),
        number(args.rate_hz, "--rate", 0.0),
        number(args.noise, "--noise", 0.0),
        limits_of(args.velocity, "--velocity"),
        limits_of(args.acceleration, "--acceleration"),
        limits_of(args.effort, "--effort"),
    )
    path = Path(args.scene)
    if not path.is_file():
        path = Path(scene_file(args.scene, "SCENE"))
    out = Path(args.out) if args.out else default_out("design-log")
    named = [name for group in args.parameters for name in group]
    table, files = design_log(path, named, plan, out)
    show(table)
    print_files(files)
    return 0


def _inspect(args) -> int:
    from makebreak.scripts.cli.inspect_command import run_inspect, run_repair

    robot = Path(args.robot) if args.robot else None
    out = Path(args.out) if args.out else None
    if args.repair:
        lines, files = run_repair(Path(args.log[0]), out)
        print("\n".join(lines))
        print_files(files)
        return 0
    given = Path(args.sidecar) if args.sidecar else None
    found, files = run_inspect(args.log, robot, out, given)
    tell(**found.to_dict())
    for table in found.tables():
        print(table.to_text(terminal_width()))
    if out is None:
        print("\nProposed sidecar; check it (--out DIR writes it to a file):\n")
        print("\n".join(found.sidecars()), end="")
    else:
        print_files(files)
    return 0


def _close_the_loop(args) -> int:
    from makebreak.scripts.runner.close_contact_loop import SETTINGS, close_contact_loop
    from makebreak.scripts.runner.close_the_loop import close_the_loop

    if args.experiment not in ("ball_rolling", *SETTINGS):
        experiment_module(args.experiment)
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
    seed = int(number(args.seed, "--seed", 0, whole=True))
    duration = None
    if args.duration is not None:
        duration = number(args.duration, "--duration", 0.0)
        if args.experiment in SETTINGS:
            raise ValueError(f"--duration: {args.experiment} ends by itself")
    right = experiment_module(args.experiment).Config()
    apply_settings(right, args.set, args.experiment)  # Or refuses.
    out = Path(args.out) if args.out else default_out("close-the-loop")
    try:
        jobs, settings = number_of_processes(args.jobs), args.set
        if args.experiment == "ball_rolling":
            table = close_the_loop(out, error, seed, duration, settings, jobs)
        else:
            table = close_contact_loop(args.experiment, out, seed, settings, jobs)
    except RuntimeError as failed:
        print(f"makebreak: {failed}", file=sys.stderr)
        return 3
    show(table)
    print(f"Files in {out}: loop.json; open {out / '2_gap' / 'report.html'}")
    return 1 if table.missed else 0


def _export_tests(args) -> int:
    from makebreak.scripts.runner.export_tests import export_tests

    module = experiment_module(args.experiment)
    config = experiment_config(module, args)
    seconds = number(args.seconds, "--seconds", 0.0)
    wanted = [name for name in (args.systems or "").split(",") if name]
    out = Path(args.out)
    done, left_out = export_tests(
        args.experiment, module, config, out, wanted, seconds, input_files(args, config)
    )
    tell(updates=done, left_out=left_out, folder=str(out))
    for name, updates in done.items():
        print(f"test_{name}.py  {updates} updates")
    for name, reason in left_out.items():
        print(f"left out: {name}: {reason}")
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    print(f"Files in {out}, {size / 1e6:.1f} MB; run them with: pytest {out}")
    return 0


def _compile(args) -> int:
    from tempfile import TemporaryDirectory

    from makebreak.scripts.runner.trials import makebreak_command, run_commands

    names = args.experiments or list(_COMPILED)
    modules = {name: experiment_module(name) for name in names}
    jobs = number_of_processes(args.jobs)
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

    table = benchmark_module("bench").bench(args.names)
    show(table)
    print(json.dumps(table.to_dict(), indent=2))
    return 1 if table.missed else 0  # A bench that failed is a missed row.


def _completion(args) -> int:
    from makebreak.scripts.cli.completion import completion

    print(completion(make_parser(_COMMANDS), args.shell, experiments.EXPERIMENTS))
    return 0


_COMMANDS: dict[str, Callable[[Namespace], int]] = {
    "list": _list,
    "run": run,
    "station": station,
    "reproduce": _reproduce,
    "sweep": _sweep,
    "gap": _gap,
    "convert": _convert,
    "judge": _judge,
    "design-log": _design_log,
    "inspect": _inspect,
    "close-the-loop": _close_the_loop,
    "export-tests": _export_tests,
    "compile": _compile,
    "bench": _bench,
    "completion": _completion,
}


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
        args = parse(make_parser(_COMMANDS), argv)
        args.is_trial = is_trial
        if hasattr(args, "set"):
            args.set = [setting for group in args.set for setting in group]
            for setting in args.set:
                if setting in experiments.EXPERIMENTS:
                    raise ValueError(f"EXPERIMENT comes before --set, got {setting}")
        with (
            _given_packages(getattr(args, "package", [])),
            telling(argv[0], args) as ended,
        ):
            status = args.function(args)
            ended(status)
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

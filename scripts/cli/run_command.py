"""`makebreak run`, and `makebreak station`, the robot that it can be run on."""

import json
import logging
import sys
import traceback
from functools import partial
from pathlib import Path

from makebreak.scripts.cli.arguments import number
from makebreak.scripts.cli.command_inputs import (
    experiment_config,
    experiment_module,
    input_files,
)
from makebreak.scripts.cli.faults import fault, refused
from makebreak.scripts.runner.outputs import check_written, default_out
from makebreak.scripts.runner.settings import dump_config
from makebreak.scripts.runner.shown import is_quiet, print_files, show


def run(args) -> int:
    """Carries out `makebreak run`. Returns: the exit status."""
    from makebreak.scripts.runner.diagram_picture import FORMATS
    from makebreak.scripts.runner.session import Session

    module = experiment_module(args.experiment)
    duration = None
    if args.duration is not None:
        duration = number(args.duration, "--duration", 0.0)
    realtime = 0.0
    if args.realtime is not None:
        realtime = number(args.realtime, "--realtime", 0.0)
    config = experiment_config(module, args)
    experiment = _runner(module, args)
    out = Path(args.out) if args.out else default_out(args.experiment)
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
        inputs=input_files(args, config),
    ) as session:
        return run_in(session, args, experiment, config, duration)


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

        args.no_meshcat = True  # Drawing would cost the loop's time.
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


def run_in(session, args, experiment, config, duration) -> int:
    """Runs the experiment, (config, session) -> result, in the session, and prints what
    came of it. Returns: the exit status."""
    from makebreak.scripts.runner.run_buttons import StartOver

    _prepare(session, args, config, duration)
    result = None
    try:
        while result is None:
            try:
                result = dict(experiment(config, session))
            except StartOver:
                session.start_over()
    except KeyboardInterrupt:
        session.interrupted = True
    except (Exception, SystemExit) as error:
        if not session.interrupted:  # Else what was recorded is too short to score.
            return _failed(session, error)
    if result is None:
        session.keep_partial()
    else:
        result |= session.limits_kept()
        result |= {"interrupted": session.interrupted, "ended": session.endings}
        session.write_result(result)
        if not args.is_trial:
            session.report = partial(_page, session, args.experiment, result)
    files = session.finish(not session.interrupted and session.unwritten is None)
    _print_outcome(session, args.experiment, result, files)
    check_written(session)
    if session.interrupted:
        print("makebreak: interrupted; what was recorded is kept", file=sys.stderr)
        return 130
    is_asked = sys.stdin is not None and sys.stdin.isatty() and not is_quiet()
    if session.meshcat is not None and is_asked:
        try:
            input("Meshcat stays open; press Enter to leave")
        except (EOFError, KeyboardInterrupt):
            print()
    return 0 if result is not None and result["success"] else 1


def _prepare(session, args, config, duration) -> None:
    """Writes config.yaml, opens Meshcat, and says what the session is to do.

    Raises: ValueError if a file cannot be written, or Meshcat not be opened.
    """
    from makebreak.scripts.runner import compile_ahead
    from makebreak.scripts.runner.trials import duration_line

    if session.outputs.salvaged is not None:
        print(
            "makebreak: an earlier run here was killed; what it had recorded is in "
            f"{session.outputs.salvaged}",
            file=sys.stderr,
        )
    session.picture = Path(args.diagram) if args.diagram is not None else None
    session.write_text("config.yaml", duration_line(duration) + dump_config(config))
    check_written(session)
    if not args.is_trial:  # Trials of a sweep keep all cores busy already.
        config_file = session.path("config.yaml")
        session.on_first_compile = partial(
            compile_ahead.start, args.experiment, config_file
        )
    if not args.no_meshcat:
        session.meshcat = _open_meshcat()
    session.restarts = True


def _failed(session, error: BaseException) -> int:
    """Keeps what was recorded, if anything was simulated. Returns: the exit status.

    Raises: ValueError if a file could not be written.
    """
    if not session.started:  # The input is unusable.
        return refused(error)
    session.keep_partial()
    if isinstance(error, OSError):
        session.unwritten = error
        session.finish(complete=False)
        check_written(session)
    session.write_text("error.txt", traceback.format_exc())
    files = session.finish(complete=False)
    kept = [path for path in files if path.name == "error.txt"]
    return fault(error, kept[0] if kept else None)


def _page(session, name: str, result: dict, pictures, is_moving: bool) -> str:
    """The text of report.html."""
    from makebreak.scripts.runner.result_page import result_page

    says = [*session.endings, *session.too_slow(), *(result.get("criteria") or [])]
    return result_page(
        f"makebreak run {name}", [_table(name, result)], result["success"], says,
        pictures, is_moving, session.compared_by, session.recorded,
    )  # fmt: skip


def _table(name: str, result: dict):
    """The result, a row a value."""
    from makebreak.scripts.runner.table import Table

    rows = [(k, v) for k, v in result.items() if k not in ("criteria", "ended")]
    return Table(name, ("result", "value"), rows)


def _print_outcome(session, name: str, result: dict | None, files) -> None:
    """The table of the result, why the run ended, and which files were written."""
    from makebreak.scripts.runner.criteria import success_text

    if result is not None:
        show(_table(name, result))
        lines = [*session.endings, *session.too_slow(), success_text(result)]
        print("\n".join(lines), flush=True)
    print_files(files)
    if session.compared_by:
        print(f"What the model lacks: {session.compared_by}", flush=True)


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


def station(args) -> int:
    """Carries out `makebreak station`. Returns: the exit status."""
    from makebreak.diagrams.lcm_station import URL
    from makebreak.scripts.runner.interrupts import CatchInterrupt
    from makebreak.scripts.runner.stand_in import StandIn, StandInConfig
    from makebreak.scripts.runner.table import Table, json_value

    module = experiment_module(args.experiment)
    if not hasattr(module, "run_on_lcm"):
        raise ValueError(f"station: {args.experiment} has no station behind LCM yet")
    rate = number(args.rate, "--rate", 0.0)
    if rate > 1.0:
        raise ValueError(f"--rate: got {rate:g}, expected at most 1, real time")
    drop = number(args.drop, "--drop", -1e-300)
    if not drop < 1.0:
        raise ValueError(f"--drop: got {drop:g}, expected a share from 0 to below 1")
    delay = number(args.delay, "--delay", -1e-300)
    duration = number(args.duration, "--duration", 0.0)
    config = experiment_config(module, args)
    told = StandInConfig(rate, max(drop, 0.0), max(delay, 0.0), args.url or URL)
    stand_in = StandIn(config, told, config.seed)
    print(f"The station sends on {told.url}; Ctrl-C ends it", flush=True)
    with CatchInterrupt() as interrupt:
        stand_in.run(duration, lambda: interrupt.hit)
    result = stand_in.report.result()
    show(Table("station", ("result", "value"), list(result.items())))
    plain = {key: json_value(value) for key, value in result.items()}
    print(json.dumps(plain, allow_nan=False), flush=True)
    return 0

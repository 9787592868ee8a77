"""From a scene and recordings of the real thing to what the scene lacks."""

import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from makebreak.gap.budget import (
    CONCLUDE,
    LESS_SURE,
    LIMBS,
    Budget,
    Stopped,
    go_on,
    present,
)
from makebreak.gap.by_part import joined, limbs_of, only
from makebreak.gap.by_recording import (
    Alone,
    Together,
    may_differ,
    with_differences,
)
from makebreak.gap.confirm import acts_on_channel, confirmed, judge_of
from makebreak.gap.data import effort_loops, sampled_commands
from makebreak.gap.data.channel_noise import in_newton_metres
from makebreak.gap.data.check_drives import (
    check_couplings,
    check_drives,
    check_initial_names,
    check_untold,
)
from makebreak.gap.data.check_meshes import check_meshes
from makebreak.gap.data.checks import check_recordings
from makebreak.gap.data.command_clock import in_lines, moved_sooner
from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.content import check_contents
from makebreak.gap.data.effort_loops import OF_LOOP, SHARES, of_loops
from makebreak.gap.data.findings import Finding
from makebreak.gap.data.pieces import excerpt, without_stops
from makebreak.gap.data.reading import check_against_scene, read_recordings
from makebreak.gap.data.recording import Recording, unit_of
from makebreak.gap.data.scene_facts import scene_facts, scene_names
from makebreak.gap.data.split import Split, split, with_noise_of
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.doubts import unless_doubtful
from makebreak.gap.parallel import side_by_side
from makebreak.gap.problem import (
    DISTANCES,
    Fitted,
    GapProblem,
    Outcome,
    is_sane,
    share_left,
)
from makebreak.gap.report.clock import zero_of
from makebreak.gap.report.summary import says_of
from makebreak.gap.residuals.command_times import set_command_times
from makebreak.gap.residuals.contact_means import SLIDES
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.driven import DrivenProblem, is_driven
from makebreak.gap.residuals.impacts import ImpactProblem, runs_against, without_contact
from makebreak.gap.residuals.in_mujoco import MujocoProblem, contacts_of_mujoco
from makebreak.gap.residuals.inverse import LOOPS
from makebreak.gap.residuals.late_poses import contact_problem
from makebreak.gap.residuals.lying_on_faces import point_on_face
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.residuals.objects import (
    FlightProblem,
    RolloutProblem,
    TouchProblem,
    point_on_face_of,
)
from makebreak.gap.residuals.pressing import PressingProblem, presses, push_each_other
from makebreak.gap.residuals.sap_lift import sap_lift
from makebreak.gap.residuals.tool_weight import as_used, check_tool_weight
from makebreak.gap.residuals.where import begins, spans_of
from makebreak.gap.result import (
    AGREES,
    GapMeasure,
    GapResult,
    JudgedChannel,
    Tried,
    Where,
)
from makebreak.gap.said import MANY_ALIKE, figure
from makebreak.gap.search.choice import Choice, Selection, is_sure
from makebreak.gap.search.chosen_by_simulation import (
    above_step,
    chosen_by_simulation,
)
from makebreak.gap.search.drop import with_errors
from makebreak.gap.search.select import select, without
from makebreak.gap.search.trust import drift_sentences, scatter, trust_in
from makebreak.gap.simulation.measure import WINDOW_SEC
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.simulation.windows import WindowModel, by_measured, with_step
from makebreak.gap.thresholds import (
    AGREEMENT_RMS_MAX,
    CLOSED_SHARE_MIN,
    SAME_EVIDENCE,
)
from makebreak.gap.verdict import (
    Facts,
    below_noise,
    decide,
    named,
    says,
    says_tried,
    shows_in_equations_alone,
    too_weak,
    tried,
    two_figures,
)
from makebreak.models.drives import TooStiff
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import (
    Effect,
    full_name,
    one_dof_joints,
    sliding_joints,
)
from makebreak.models.model_files import robot_files
from makebreak.models.scene import Scene, read_scene
from makebreak.models.scene_schema import without_shapes

ProblemOf = Callable[..., tuple[GapProblem, list[Finding]]]
# Of longer recordings of a mechanism, and of more rows of anything, pieces are used.
MOST_SEC, MOST_ROWS = 60.0, 120_000
# Windows that tell how far a step errs: where that decides which one is taken, and
# where it is only said.
ASKED, TOLD_BY = 24, 8
# Slip of soft contacts that hold [m/s]: MuJoCo's friction stops what moves within a
# hundredth of a second, of what its weight presses down by 0.5 to 1 of that.
CREEP = 0.1
# Of what is only reported on.
REPORTED_SEC, REPORTED_ROWS = 20.0, 40_000


def run_gap(
    scene_path: str | Path,
    recording_paths: Sequence[str | Path],
    jobs: int = 1,
    progress: Callable[[str], None] | None = None,
    skip_bad_rows: bool = False,
    sidecars: Mapping[Path, Path] | None = None,
    doubts: Sequence[Finding] = (),
    budget_min: float = float("inf"),
) -> GapResult:
    """Finds where a scene and recordings disagree, and names what the scene lacks.

    Args: jobs: processes at once. progress: called with a line of text now and then.
        skip_bad_rows, sidecars: as of read_recordings. doubts: what is to be said of
        the scene beforehand. budget_min: minutes after which the best answer so far is
        given, with what was left undone in `unfinished`; not asked where a budget
        (gap/budget.py) is running already.
    Raises: ValueError, one line, for a scene or recording that cannot be read or do
        not fit together.
    """
    if budget_min < float("inf"):
        with Budget(60.0 * budget_min).running():
            return run_gap(
                scene_path, recording_paths, jobs, progress, skip_bad_rows, sidecars,
                doubts,
            )  # fmt: skip
    budget, checks = present(), list(doubts)
    stage = "reading scene and recordings"

    def say(text: str) -> None:
        nonlocal stage
        if not text.startswith(" "):
            stage = text
        if progress is not None:
            progress(text)

    try:
        result = _run(
            scene_path, recording_paths, jobs, say, skip_bad_rows, sidecars, checks
        )
    except Stopped:
        budget.leave(f"{stage}, and all that follows")
        result = nothing_compared(checks)
    return as_far_as_it_went(result, budget)


def _run(
    scene_path: str | Path,
    recording_paths: Sequence[str | Path],
    jobs: int,
    say: Callable[[str], None],
    skip_bad_rows: bool,
    sidecars: Mapping[Path, Path] | None,
    checks: list[Finding],
) -> GapResult:
    """What run_gap gives where nobody stops it. checks: findings are added there."""
    budget, clock = present(), _Clock()
    seconds: dict[str, float] = {}
    scene = read_scene(scene_path)
    go_on()
    dynamics = SceneDynamics(scene)
    slides = sliding_joints(dynamics.plant)
    recordings = read_recordings(recording_paths, skip_bad_rows, sidecars, slides)
    recordings = in_newton_metres(recordings, scene.channels)
    joints, bodies = scene_names(dynamics.plant)
    for recording in recordings:
        check_against_scene(recording, joints, bodies)
        check_drives(recording, scene)
    recordings = of_loops(as_used(recordings, dynamics))
    if scene.actuation.hold == "first_order":
        recordings = [in_lines(r) for r in recordings]
    whole = recordings
    recordings, stops = without_stops(recordings, scene_facts(dynamics.plant))
    checks += stops
    check_initial_names(scene, recordings)
    check_couplings(scene, dynamics.plant)
    check_meshes(dynamics.loaded, recordings)
    # What is reported on is cut off before anything is looked at.
    parts = split(recordings)
    given, as_read = scene, parts
    say("checking the recordings")
    go_on()
    checks += check_recordings(parts.decided, scene_facts(dynamics.plant))
    checks += check_tool_weight(dynamics, parts.decided)
    is_mechanism = _is_mechanism(dynamics, recordings)
    pushes = is_mechanism and any(
        asked(dynamics, parts.decided) for asked in (push_each_other, presses)
    )
    checks += check_contents(dynamics.plant, parts.decided, pushes)
    checks += check_untold(scene, parts.decided)
    # An impact would be smeared by means over rows.
    meets = pushes or is_mechanism and runs_against(dynamics, parts.decided)
    seconds["checks"] = clock.lap()
    limbs = limbs_of(dynamics, parts.decided) if is_mechanism and not meets else []
    if limbs:
        parts, found = _with_efforts_of_loops(scene, parts, limbs, jobs, say)
        checks += found
    if len(limbs) > 1 and any(r.commands() for r in parts.decided):
        scene, parts, found = _with_commands_of_most(scene, parts, limbs, jobs)
        checks += found

    known = list(checks)
    # Of what a file has and Drake does not, too: tendons, loops, water. Measured
    # efforts, with their noise, tell more in equations than in windows.
    first = meets or not is_mechanism
    first |= any(file.notes for file in robot_files(scene).values())
    first &= not any(by_measured(scene, r) for r in parts.decided)

    def in_mujoco(*some: Split, named: Sequence[Effect] = ()) -> GapResult | None:
        """What a scene comes to whose world may be MuJoCo's: its steps, contacts and
        water; and its stops, if too little is without them. None where what is named
        explains that as well."""
        for each in some:
            decided, reported, done = _conditioned(each, dynamics, False)
            reported = excerpt(reported, REPORTED_SEC, REPORTED_ROWS)
            told = [c for c in known if each is as_read or c not in stops] + done
            ask = partial(_in_mujoco, given, decided, reported, told, jobs, say, named)
            with budget.share(1.5).running() as own:
                found = own.if_time("simulating windows with MuJoCo", ask, None)
            seconds["MuJoCo"] = seconds.get("MuJoCo", 0.0) + clock.lap()
            if found is not None:
                return unless_doubtful(found).with_seconds(seconds)
        return None

    def unless_in_mujoco(result: GapResult) -> GapResult:
        """Where nothing else explains what a robot does, or what pushes it does it in
        another way."""
        result = replace(result, seconds={**seconds, **result.seconds})
        unnamed = result.verdict in ("gap_unnamed", "not_judged")
        if not is_mechanism or not (unnamed or meets and result.effects):
            return result
        clock.lap()
        tried = () if first else (as_read,)
        named = [] if unnamed else result.scene_effects()
        with_stops = [split(whole)] if stops and unnamed else []
        return in_mujoco(*tried, *with_stops, named=named) or result

    if first:
        result = in_mujoco(as_read)
        if result is not None:
            return result
    if len(limbs) < 2:
        return unless_in_mujoco(
            _compared(scene, dynamics, parts, meets, checks, jobs, say, clock)
        )

    def of_limb(k: int) -> GapResult:
        of_scene, of_parts = only(limbs[k], scene, parts)
        of_checks, name = list(checks), f"{limbs[k][0]} and on"
        ahead = sum(map(len, limbs[k:])) / len(limbs[k])  # By their joints.
        with budget.share(1.0 if jobs > 1 else ahead).running() as own:
            try:
                result = _compared(
                    of_scene, SceneDynamics(of_scene), of_parts, False, of_checks, 1,
                    lambda text: say(text if text[0] == " " else f"{text}, {name}"),
                    _Clock(),
                )  # fmt: skip
            except Stopped:
                own.leave(f"comparing {name}")
                result = nothing_compared(of_checks)
        return replace(result, unfinished=tuple(own.undone))

    results: list[GapResult] = []

    def say_how_many() -> None:  # What copies of this process say is not heard.
        say(f"comparing limbs, {len(results)} of {len(limbs)} done")

    with budget.part(LIMBS):
        say_how_many()
        try:
            for one in side_by_side(
                [partial(of_limb, k) for k in range(len(limbs))], jobs
            ):
                results.append(one)
                say_how_many()
        except Stopped:
            for limb in limbs[len(results) :]:
                budget.leave(f"comparing {limb[0]} and on")
                results.append(nothing_compared(checks))
    result = joined(limbs, results)
    for what in result.unfinished:
        budget.leave(what)
    return unless_in_mujoco(result)


def _compared(
    scene: Scene,
    dynamics: SceneDynamics,
    parts: Split,
    meets: bool,
    checks: list[Finding],
    jobs: int,
    say: Callable[[str], None],
    clock: "_Clock",
) -> GapResult:
    """What a scene and recordings come to, of which nothing but checks is known.

    Args: meets: whether a mechanism touches something, or itself. checks: findings are
        added there.
    """
    budget, seconds = present(), {}
    is_mechanism = _is_mechanism(dynamics, parts.decided)
    decided, reported, done = _conditioned(parts, dynamics, is_mechanism and not meets)
    reported = excerpt(reported, REPORTED_SEC, REPORTED_ROWS)
    say("preparing motions and windows")
    if is_mechanism and not meets:
        scene = without_shapes(scene)
    problem, found = problem_for(scene, decided, dynamics, jobs, meets)
    acting = _with_commands_of(problem, scene, parts)
    if acting is not None:
        scene, parts, told = acting
        decided, reported, done = _conditioned(parts, dynamics, not meets)
        problem, found = problem_for(scene, decided, dynamics, jobs, meets)
        found += told
    checks += [*done, *found]
    seconds["screen"] = clock.lap()
    say("searching the catalogue")
    # Of a driven robot windows may have to be searched as well.
    searched = budget.share(2) if is_driven(scene, decided) else budget
    with searched.running():
        selection = select(problem, say)
    seconds["select"] = clock.lap()
    say("simulating held-out windows")
    with budget.part(CONCLUDE):
        try:
            result = conclude(problem, selection, reported, checks, jobs)
        except Stopped:
            budget.leave("simulating held-out windows")
            result = in_equations_alone(problem, selection, checks)
    seconds["simulate"] = clock.lap()

    def in_another_way() -> tuple[GapProblem, Selection, GapResult]:
        """What windows do not name, equations may; and the reverse."""
        first = problem, selection, result
        say("preparing another comparison")
        with budget.share(1).running() as own:
            try:
                other, found = other_problem(problem, scene, decided, dynamics, jobs)
            except DoesNotFit:
                return first
            say("searching the catalogue in another way")
            then = select(other, say)
        with budget.part(CONCLUDE):
            named = conclude(other, then, reported, [*checks, *found], jobs)
        if not explains_more(named, result):
            return first
        searched.undone[:] = own.undone
        return other, then, named

    def by_evidence() -> tuple[GapProblem, Selection, GapResult]:
        """Where equations agree, by nuisances that many have to be moved for or as
        noise of light joints is large, and simulated windows do not: what there is
        evidence for is taken."""
        first = problem, selection, result
        problem.plan = replace(problem.plan, counts_evidence=True, evidence_alone=True)
        say("searching the catalogue by evidence")
        then = select(problem, say)
        if not then.choices:
            return first
        with budget.part(CONCLUDE):
            named = conclude(problem, then, reported, checks, jobs)
        return (problem, then, named) if _agrees(named.gap.after) else first

    def with_creep() -> tuple[GapProblem, Selection, GapResult]:
        """Where friction holds softly: what creeps is no slip."""
        pressing = isinstance(problem, PressingProblem)
        made = _pressing_problem if pressing else _contact_problem
        say("preparing contacts that creep")
        other, found = made(scene, decided, CREEP)
        if other.rich_left > AGREEMENT_RMS_MAX:  # Nor does all that is ordinary then.
            return problem, selection, result
        say("searching the catalogue with contacts that creep")
        then = select(other, say)
        with budget.part(CONCLUDE):
            named = conclude(other, then, reported, [*checks, *found, creep()], jobs)
        if named.verdict in ("gap_unnamed", "not_judged"):
            return problem, selection, result
        return other, then, named

    def alone(name: str) -> Alone:
        say(f"searching {name} separately")
        mine, its = ([r for r in some if r.name == name]
                     for some in (decided, reported))  # fmt: skip
        one, _ = again(scene, mine, dynamics, jobs)
        selected = select(one, say)
        return Alone(name, one, selected, conclude(one, selected, its, checks, jobs))

    def one_by_one() -> GapResult:
        if not may_differ(problem, selection.end, result):
            return result
        return with_differences(result, Together(problem, selection), alone)

    again: ProblemOf = partial(problem_for, meets=meets)
    in_equations = isinstance(problem, MechanismProblem)
    agrees = in_equations and _agrees(problem.error(selection.end))
    if agrees and result.gap.window_s > 0.0 and not _agrees(result.gap.after):
        what, now = "searching by evidence", (problem, selection, result)
        problem, selection, result = budget.if_time(what, by_evidence, now)
        seconds["evidence"] = clock.lap()
    touching = isinstance(problem, ContactProblem)
    if result.verdict == "gap_unnamed" and touching:
        what, now = "comparing with contacts that creep", (problem, selection, result)
        problem, selection, result = budget.if_time(what, with_creep, now)
        seconds["creep"] = clock.lap()
    if result.verdict == "gap_unnamed" and is_driven(scene, decided):
        was, what = problem, "comparing in another way"
        problem, selection, result = budget.if_time(
            what, in_another_way, (problem, selection, result)
        )
        again = again if problem is was else equations_of
        seconds["other way"] = clock.lap()
    for undone in searched.undone:
        budget.leave(undone)
    if isinstance(problem, MechanismProblem):
        what = "comparing recordings one by one"
        result = budget.if_time(what, one_by_one, result)
        seconds["recordings"] = clock.lap()
    return unless_doubtful(result).with_seconds(seconds)


def _agrees(error: float) -> bool:
    return error <= AGREEMENT_RMS_MAX


def _conditioned(
    parts: Split, dynamics: SceneDynamics, average: bool
) -> tuple[list[Recording], list[Recording], list[Finding]]:
    """What is decided on, as it is compared, what is reported on, and what was done."""
    decided, done = condition(parts.decided, average)
    reported, _ = condition(parts.reported, average)
    reported = with_noise_of(reported, decided)
    decided, cut = _shortened(decided, dynamics)
    return decided, reported, [*done, *cut]


def _with_efforts_of_loops(
    scene: Scene, parts: Split, limbs: Sequence[Sequence[str]], jobs: int,
    say: Callable[[str], None],
) -> tuple[Split, list[Finding]]:  # fmt: skip
    """The recordings with measured efforts that act between their rows as their loops
    had them, and what was found: one number for all limbs, where the few effects that
    explain their motion cost less with it beyond doubt."""
    every = [c for r in parts.decided for c in r.channels.values()]
    if not any(c.noise_from == OF_LOOP for c in every):
        return parts, []
    say("asking when measured efforts act")
    ways = [partial(of_loops, share=share) for share in SHARES]

    def gained(limb: Sequence[str]) -> np.ndarray:
        mine = only(limb, scene, parts) if len(limbs) > 1 else (scene, parts)
        own, dynamics, decided, *others = _as_compared(*mine, *ways)
        try:
            return MechanismProblem(own, decided).gained_by_efforts(others)
        except DoesNotFit:  # It is too short.
            return np.zeros(len(ways))

    each = side_by_side([partial(gained, limb) for limb in limbs], jobs)
    total = np.sum(list(each), axis=0)
    k = int(np.argmax(total))
    if not total[k] > SAME_EVIDENCE:
        return parts, []
    decided, reported = (ways[k](some) for some in (parts.decided, parts.reported))
    said = effort_loops.finding(parts.decided, SHARES[k])
    return replace(parts, decided=decided, reported=reported), [said]


def _as_compared(scene: Scene, parts: Split, *ways: Callable):
    """The scene of a mechanism that nothing touches, its dynamics, and what is decided
    on as it is compared: as it is, and in other ways."""
    scene = without_shapes(scene)
    dynamics = SceneDynamics(scene)
    every = (parts.decided, *(way(parts.decided) for way in ways))
    return (
        scene,
        dynamics,
        *(
            _conditioned(replace(parts, decided=some), dynamics, True)[0]
            for some in every
        ),
    )


def _with_commands_of_most(
    scene: Scene, parts: Split, limbs: Sequence[Sequence[str]], jobs: int
) -> tuple[Scene, Split, list[Finding]]:
    """Scene and recordings with commands that act when the motion of most limbs says:
    one loop drives all, and in a single limb it may look like what its joints lack."""

    def early(limb: Sequence[str]) -> float:
        own, _, decided = _as_compared(*only(limb, scene, parts))
        try:
            return MechanismProblem(own, decided).commands_early()
        except DoesNotFit:  # It is too short.
            return 0.0

    each = list(side_by_side([partial(early, limb) for limb in limbs], jobs))
    found = [by for by in each if by > 0.0]
    if len(found) < max(2, len(each) / 2):
        return scene, parts, []
    return _with_sooner(scene, parts, float(np.median(found)))


def _with_commands_of(
    problem: GapProblem, scene: Scene, parts: Split
) -> tuple[Scene, Split, list[Finding]] | None:
    """Scene and recordings with commands that act as the motion says, and what is said
    of it; None where they act as their rows have them."""
    if not isinstance(problem, MechanismProblem):
        return None
    if problem.commands_are_samples():
        said = sampled_commands.finding(problem.recordings)
        decided, reported = map(
            sampled_commands.as_samples, (parts.decided, parts.reported)
        )
        return scene, replace(parts, decided=decided, reported=reported), [said]
    early = problem.commands_early()
    return _with_sooner(scene, parts, early) if early else None


def _with_sooner(
    scene: Scene, parts: Split, early: float
) -> tuple[Scene, Split, list[Finding]]:
    """With commands that act so much sooner [s]. Of a simulator's steps all that goes
    with velocities is half a step off, too."""
    first, row = parts.decided[0], min(r.period_sec() for r in parts.decided)
    loops = {LOOPS: max(scene.tolerance.get(LOOPS, 0.0), early)}
    decided, reported = (
        moved_sooner(x, early) for x in (parts.decided, parts.reported)
    )
    return (
        replace(scene, tolerance={**scene.tolerance, **loops}),
        replace(parts, decided=decided, reported=reported),
        [sampled_commands.finding_of_moved(first.name, -early, row)],
    )


def problem_for(
    scene: Scene,
    recordings: Sequence[Recording],
    dynamics: SceneDynamics,
    jobs: int = 1,
    meets: bool = True,
) -> tuple[GapProblem, list[Finding]]:
    """The problem that a scene and recordings are, and what was found on the way.

    Args: dynamics: of the scene. meets: whether a mechanism may touch something.
    Raises: ValueError where no kind of problem fits; and whatever else goes wrong in
        one that does.
    """
    if _is_mechanism(dynamics, recordings):
        kinds = (
            (push_each_other, _contact_problem), (presses, _pressing_problem),
            (runs_against, _impact_problem),
        )  # fmt: skip
        for touches, made_of in kinds if meets else ():
            if not touches(dynamics, recordings):
                continue
            try:
                with present().share(2).running():
                    return made_of(scene, recordings)
            except DoesNotFit:  # Too short or little motion, or it shows no contact.
                pass
            except Stopped:  # Then the stretches in which nothing touches are left.
                present().leave("what touches: its stretches are left out")
        return equations_of(scene, recordings, dynamics, jobs)
    if any(joint.num_velocities() for joint in one_dof_joints(dynamics.plant)):
        try:
            return _contact_problem(scene, recordings)
        except DoesNotFit:  # Not the whole motion is measured, or nothing touches.
            pass
        try:
            return TouchProblem(scene, recordings), []
        except DoesNotFit:  # Nothing tells when it touches.
            pass
    try:
        flight = FlightProblem(scene, recordings, dynamics=dynamics)
        return flight, point_on_face_of(flight)
    except DoesNotFit:  # More than one free body, or other shapes: by Drake's steps.
        scene, finding = _settle_step(scene, recordings, dynamics, jobs)
        return RolloutProblem(scene, recordings), finding


def equations_of(
    scene: Scene, recordings: Sequence[Recording], dynamics: SceneDynamics, jobs: int
) -> tuple[MechanismProblem, list[Finding]]:
    """A mechanism's equations of motion, as problem_for."""
    recordings, touches = without_contact(dynamics, recordings)
    scene = without_shapes(scene)  # Nor do windows know of contact.
    scene, finding = _settle_step(scene, recordings, dynamics, jobs)
    mechanism = MechanismProblem(scene, recordings)
    return mechanism, [*touches, *finding, *mechanism.push_findings()]


def other_problem(
    problem: GapProblem, scene: Scene, recordings: Sequence[Recording],
    dynamics: SceneDynamics, jobs: int,
) -> tuple[GapProblem, list[Finding]]:  # fmt: skip
    """Of a mechanism that follows commands: its equations where its windows were
    searched, else its windows. Raises: DoesNotFit."""
    if isinstance(problem, DrivenProblem):
        return equations_of(scene, recordings, dynamics, jobs)
    known = {**scene.tolerance, **problem.scene.tolerance}  # How friction stops joints.
    driven = DrivenProblem(replace(scene, tolerance=known), recordings)
    driven.learn_misfit()
    return driven, []


def _contact_problem(
    scene: Scene, recordings: Sequence[Recording], slides: float = SLIDES
) -> tuple[ContactProblem, list[Finding]]:
    contact = contact_problem(scene, recordings, slides=slides)
    return contact, sap_lift(contact) + point_on_face(contact, contact.lying())


def creep() -> Finding:
    """What is said where contacts that creep explain what others do not."""
    says = (
        f"Contacts that slip slower than {CREEP:g} m/s press back with less friction "
        "than they could, as soft contacts of a simulator do that creep (MuJoCo's, "
        "say): there any friction up to its limit was allowed. Slow slip says nothing "
        "of a friction that is smaller than the model's."
    )
    return Finding("contacts_creep", "", "time", CREEP, "m/s", "warning", says)


def _in_mujoco(
    scene: Scene, recordings: Sequence[Recording], reported: Sequence[Recording],
    checks: Sequence[Finding], jobs: int, say: Callable[[str], None],
    named: Sequence[Effect] = (),
) -> GapResult | None:  # fmt: skip
    """What a scene of one MJCF file comes to, if MuJoCo, with the contact of that file,
    does what was measured, or does with what is named; else None, as where it does so
    with what was `named` without it."""
    say("preparing windows in MuJoCo")
    try:
        problem = MujocoProblem(scene, recordings)
    except DoesNotFit:
        return None
    if named and problem.does_with(named):
        return None
    say("searching the catalogue in MuJoCo")
    selection = select(problem, say)
    with present().part(CONCLUDE):
        found = [*checks, contacts_of_mujoco(problem)]
        result = conclude(problem, selection, reported, found, jobs)
    return result if result.verdict in ("no_gap", "gap_named", "ambiguous") else None


def _pressing_problem(
    scene: Scene, recordings: Sequence[Recording], slides: float = SLIDES
):
    pressing = PressingProblem(scene, recordings, slides=slides)
    return pressing, point_on_face(pressing, pressing.lying())


def _impact_problem(scene: Scene, recordings: Sequence[Recording]):
    impacts = ImpactProblem(scene, recordings)
    return impacts, set_command_times(impacts)


def explains_more(one: GapResult, other: GapResult) -> bool:
    """Whether a result is to be taken in the place of one that leaves a gap without a
    name: it leaves none, or it closes more of what its simulated windows show."""
    if one.verdict in ("gap_unnamed", "not_judged"):
        return one.gap.reduction > other.gap.reduction
    return True


def nothing_compared(checks: Sequence[Finding]) -> GapResult:
    """Where a run ended before scene and recordings were compared."""
    nan = float("nan")
    says = "Scene and recordings were not compared."
    return GapResult("not_judged", says, [], [], _nothing(nan, nan), [], {}, checks)


def in_equations_alone(
    problem: GapProblem, selection: Selection, checks: Sequence[Finding]
) -> GapResult:
    """Where a run ended before held-out windows were simulated: nothing is named, as
    nothing is confirmed; what the search would have named is in the sentence."""
    start, end = problem.error(selection.start), problem.error(selection.end)
    by_kind: dict[str, list[Effect]] = {}
    for effect in selection.effects():
        by_kind.setdefault(effect.kind, []).append(effect)
    tried = [
        said
        for kind, same in by_kind.items()
        for said in (
            map(says_of, same) if len(same) < MANY_ALIKE
            else [f"{kind} at {len(same)} places"]
        )
    ]  # fmt: skip
    agrees = start <= AGREEMENT_RMS_MAX and not tried
    words = f"What was fitted is off by {figure(start)} times the noise"
    if tried:
        words += f", by {figure(end)} times with what follows, which no simulation "
        words += f"has confirmed: {'; '.join(tried)}"
    return GapResult(
        "not_judged" if agrees else "gap_unnamed", f"{words.rstrip('.')}.", [], [],
        replace(_nothing(start, start), data="fitted"), [], {}, checks,
        candidates=selection.table, channels=judged_channels(problem),
    )  # fmt: skip


def as_far_as_it_went(result: GapResult, budget: Budget) -> GapResult:
    """The result, with what the budget left undone: first in the sentence, and among
    the checks. What rests on everything having been tried is not said."""
    if not budget.undone:
        return result
    words = f"{budget.why}; not done: {'; '.join(budget.undone)}."
    finding = Finding("unfinished", "", "time", 0.0, "s", "warning", words)
    return replace(
        result,
        verdict=LESS_SURE.get(result.verdict, result.verdict),
        says=f"{words} {result.says}",
        checks=[*result.checks, finding],
        unfinished=tuple(budget.undone),
    )


def conclude(
    problem: GapProblem,
    selection: Selection,
    reported: Sequence[Recording],
    checks: Sequence[Finding] = (),
    jobs: int = 1,
) -> GapResult:
    """The verdict and what it rests on.

    All is chosen on the rows that were fitted and chosen on. Then the effects are
    compared with recordings that neither saw: these may veto effects (gap/confirm.py)
    and take a verdict back; they choose none.
    """
    selection = _beyond_laws(problem, selection)
    selection, chosen_on = chosen_by_simulation(problem, selection, jobs)
    steps = [c for c in checks if c.kind == "time_step"]
    step = dict(max(steps, key=lambda c: c.size).of) if steps else {}
    selection, chosen_on, vetoed, below = above_step(
        problem, selection, chosen_on, step, jobs
    )
    scattered = scatter(problem, selection.end)
    choices = [
        _with_inseparable(_widened(c, problem, selection.end, scattered), problem)
        for c in selection.choices
    ]
    selection = replace(selection, choices=tuple(choices))
    # Of what is tried, too: what changes may fail on data from another time.
    drifting = drift_sentences(problem, selection.end) if choices else ""

    def facts_of(some: Selection, outcome: Outcome | None) -> Facts:
        return Facts(
            some.choices, problem.error(some.start), problem.error(some.end), some.far,
            outcome.gap if outcome else None, below=below,
            steady=problem.steady_error(some.start),
            loud=("", 0.0) if np.isfinite(below) else problem.loudest(some.start),
            loud_max=problem.plan.loud, asks_simulation=problem.plan.simulation_agrees,
        )  # fmt: skip

    judge = judge_of(problem, reported, jobs)
    outcome: Outcome | None = None
    while True:
        facts = facts_of(selection, chosen_on)
        if selection.choices and (weak := _withdrawn(problem, selection, facts)):
            vetoed += weak
            selection = without(problem, selection, *[c.effect for c, _ in weak])
        else:
            found = confirmed(problem, selection, judge)
            outcome, vetoed = found.outcome, [*vetoed, *found.vetoed]
            if outcome is None and found.selection.choices:
                vetoed += [(c, _TOO_SHORT_TO_REPORT) for c in selection.choices]
                selection = without(problem, selection, *selection.effects())
            elif found.vetoed:
                selection = found.selection
            else:
                asked = present().if_time(
                    "what each effect explains",
                    lambda: with_errors(problem, found.selection), None,  # noqa: B023
                )  # fmt: skip
                selection = asked or found.selection
                idle = (
                    [c for c in asked.choices if c.before <= c.after] if asked else []
                )
                if not idle:
                    break
                vetoed += [(c, _IDLE) for c in idle]
                selection = without(problem, selection, *[c.effect for c in idle])
        if chosen_on is not None:
            chosen_on = problem.outcome(
                selection.effects(), selection.start, selection.end,
                selection.nuisances, jobs=jobs,
            )  # fmt: skip
    final = _reported_on(problem, selection, outcome, chosen_on)
    channels = judged_channels(problem)
    turned = problem.other_gravity(selection.end)[0] if selection.choices else ""
    facts = replace(
        facts_of(selection, chosen_on), reported=outcome.gap if outcome else None,
        turned=turned, unjudged=unjudged_channels(channels),
        found_before=bool(problem.found_before()),
    )  # fmt: skip
    verdict, near = decide(facts)
    plant = problem.dynamics.plant
    not_confirmed = [tried(choice, why, plant) for choice, why in vetoed]
    near = says_tried(not_confirmed) + near
    if verdict == "gap_unnamed" and not facts.choices and not not_confirmed:
        not_confirmed = _best_of_all(problem, selection)
    if selection.beyond:
        near += _beyond_limits(selection)
    near += _says_failure(final.gap)
    if verdict != "gap_unnamed" or not shows_in_equations_alone(final.gap):
        near += two_figures(facts.start, facts.end, final.gap, problem.by_equations)
    near += below_noise(selection.choices, facts.start, final.gap)
    near += drifting
    # Nothing was learned from it: the part that is reported on is looked at last.
    where = [] if verdict in AGREES else [
        *problem.where(selection.start.left),
        *(replace(w, held_out=True) for w in final.where),
    ]  # fmt: skip
    if verdict == "gap_unnamed":
        near += _since(where, final, problem.recordings, reported)
        near += problem.hint(selection.end)
    else:
        near += final.expects
    before = [
        Choice(f.effect, f.std, f.before, f.after, "", 0.0, (), (), 1)
        for f in problem.found_before()
    ]
    effects = [
        named(c, plant, problem.clock_of(c.effect))
        for c in (*before, *selection.choices)
    ]
    fixed = [c.fixed for c in selection.choices]
    nuisances = selection.nuisances
    prior = nuisances.prior
    return GapResult(
        verdict,
        says(verdict, effects, final.gap, near, facts.end, problem.by_equations),
        where, effects,
        final.gap, final.unexplained if verdict == "gap_unnamed" else [],
        {n: float(b / p) for n, b, p in
         zip(nuisances.names, selection.end.b, prior, strict=True)},
        checks, final.series, selection.table,
        trust=trust_in(
            problem, selection.screen(problem), selection.end, fixed,
            [c.std for c in selection.choices],
        ) if selection.choices else (),
        channels=channels,
        nuisance_scene=problem.nuisance_effects(nuisances, selection.end.b),
        tried=not_confirmed,
    )  # fmt: skip


_IDLE = (
    "Beside the other effects it takes nothing off the error of the data by which "
    "effects were chosen."
)
_TOO_SHORT_TO_REPORT = (
    "The recordings are too short to hold out a part for the report; without it "
    "nothing is named."
)
_UNSURE = (
    "The error without it is no larger than noise and an uncertain start allow, and "
    "none of its numbers is sure to three deviations."
)
_TOO_SHORT_TO_CHOOSE = (
    "The recordings are too short to hold out data for the choice of effects."
)


def _beyond_laws(problem: GapProblem, selection: Selection) -> Selection:
    """The selection; without its effects where the scene agrees without them and they
    only follow noise, or are smaller than what laws are good for."""
    agrees = problem.error(selection.start) <= AGREEMENT_RMS_MAX
    if agrees and (
        _follows_noise(problem, selection)
        or all(problem.is_within_law(c.effect) for c in selection.choices)
    ):
        return replace(selection, choices=(), end=selection.start)
    return selection


def _withdrawn(
    problem: GapProblem, selection: Selection, facts: Facts
) -> list[tuple[Choice, str]]:
    """Effects that are not named, and why, by the data that they were chosen on."""
    why = ""
    turned, is_better = problem.other_gravity(selection.end)
    if is_better:  # Forces and loads stand for a robot that hangs on a wall.
        why = "Another direction of gravity explains more."
    elif facts.chosen_on is None:
        why = _TOO_SHORT_TO_CHOOSE
    elif not facts.chosen_on.is_measured or facts.chosen_on.stops_with_effects:
        why = f"It could not be judged by simulation. {facts.chosen_on.failure}"
    if why:
        return [(choice, why) for choice in selection.choices]
    assert facts.chosen_on is not None
    if below_noise(selection.choices, facts.start, facts.chosen_on):
        # Nothing but the fit speaks for them.
        unsure = [(c, _UNSURE) for c in selection.choices if not is_sure(c)]
        if unsure:
            return unsure
    closed = 1.0  # Windows say it twice where there are no equations.
    if problem.by_equations:
        closed = problem.closed(selection.start, selection.end)
    return too_weak(
        facts, closed,
        lambda c, channel: acts_on_channel(problem, c.effect, channel),
    )  # fmt: skip


def _reported_on(
    problem: GapProblem,
    selection: Selection,
    outcome: Outcome | None,
    chosen_on: Outcome | None,
) -> Outcome:
    """What the figures are of: data held out for the report, else data that effects
    were chosen on, else the rows of the search."""
    for some, data in ((outcome, "reported"), (chosen_on, "chosen on")):
        if some is not None and some.gap.is_measured:
            return replace(some, gap=replace(some.gap, data=data))
    start, end = problem.error(selection.start), problem.error(selection.end)
    gap = replace(_nothing(start, end), data="fitted")
    for some in filter(None, (outcome, chosen_on)):
        gap = replace(
            gap, n_windows=some.gap.n_windows, failed=some.gap.failed,
            failure=some.gap.failure,
        )  # fmt: skip
        break
    return Outcome(gap)


def _best_of_all(problem: GapProblem, selection: Selection) -> list[Tried]:
    """The best candidate where none was good enough to be chosen."""
    for each in selection.table[:1]:
        effect = Effect(each.kind, list(each.at), dict(each.parameters))
        if not each.score < 1.0 or not is_sane(effect, problem.sizes):
            break
        choice = Choice(effect, {}, 1.0, each.score, "", 0.0, (), (), 1)
        why = (
            "The best candidate alone, to first order: it takes "
            f"{1.0 - each.score:.0%} off the error, too little to be named."
        )
        return [tried(choice, why, problem.dynamics.plant)]
    return []


def _says_failure(gap: GapMeasure) -> str:
    """Which windows could not be simulated and why, as sentences."""
    if not gap.failure:
        return ""
    count = max(gap.failed)
    if gap.window_s > 0.0:
        text = f"{count} of {gap.n_windows} windows could not be simulated to their end"
        return f" {text} and do not count. {gap.failure}"
    return (
        " No window could be simulated to its end, so the errors are those of what was "
        f"compared without simulation. {gap.failure}"
    )


def _since(
    where: Sequence[Where],
    outcome: Outcome,
    decided: Sequence[Recording],
    reported: Sequence[Recording],
) -> str:
    """In words, from when on something is different; "" where nothing says so: in all
    of the recordings, in the part that was decided on, or in the one that is reported
    on (of which by windows, which show other gaps)."""
    recordings = [*decided, *reported]
    parts = (
        (where, recordings),
        ([w for w in where if not w.held_out], decided),
        ([w for w in where if w.held_out], reported),
    )
    each = (begins(some, spans_of(part)) for some, part in parts)
    found = next((one for one in each if one is not None), None)
    if found is not None:
        name, _, at = found
    else:
        jumps = [u for u in outcome.unexplained if u.since is not None]
        if not jumps:
            return ""
        name, at = recordings[0].name, float(jumps[0].since or 0.0)
    first = min(float(r.time[0]) for r in recordings if r.name == name)
    place = f" of {name}" if len({r.name for r in recordings}) > 1 else ""
    at -= zero_of(first)
    return f" From about {figure(at, 2)} s{place} on something is different."


def _follows_noise(problem: GapProblem, selection: Selection) -> bool:
    """Whether effects leave most of what they were found in, and that is noise which
    goes together over a while: without it they gain nothing."""
    start, end = selection.start, selection.end
    loud, left = (problem.noise_error(fitted.left) for fitted in (start, end))
    return (
        loud > AGREEMENT_RMS_MAX
        and share_left(loud, left) > 1.0 - CLOSED_SHARE_MIN
        and problem.error(end) >= problem.error(start)
    )


def _nothing(start: float, end: float) -> GapMeasure:
    """Where nothing was held out."""
    return GapMeasure(start, end, 1.0, 0.0)


def _beyond_limits(selection: Selection) -> str:
    each = [f"{name} ({value:.2g})" for name, value in selection.beyond]
    return (
        " Nuisance parameters would have to be off by more than they may be (in "
        f"tolerances): {', '.join(each)}."
    )


def judged_channels(problem: GapProblem) -> list[JudgedChannel]:
    """Every measured channel, and by what it was judged."""
    how = problem.judged()
    sliding = sliding_joints(problem.dynamics.plant)
    found: dict[str, JudgedChannel] = {}
    for recording in problem.recordings:
        for c in recording.measured():
            unit = unit_of(c.quantity, c.at in sliding)
            old = found.get(c.name)
            noise = max(c.noise, old.noise) if old else c.noise
            found[c.name] = JudgedChannel(
                c.name, unit, noise, c.noise_from, how.get(c.name, "not")
            )
    return list(found.values())


def unjudged_channels(channels: Sequence[JudgedChannel]) -> str:
    """What was measured and not compared, as a sentence; none: nothing is left."""
    text = ""
    left = [c.channel for c in channels if c.judged == "not"]
    if left:
        text += f" Not judged: {', '.join(left)}."
    if partly := [c.channel for c in channels if c.judged == DISTANCES]:
        text += (
            f" Only that shapes meet was asked of {', '.join(partly)}: their motion was"
            " not compared."
        )
    return text


class _Clock:
    def __init__(self):
        self._last = time.perf_counter()

    def lap(self) -> float:
        now = time.perf_counter()
        self._last, took = now, now - self._last
        return took


def _is_mechanism(dynamics: SceneDynamics, recordings: Sequence[Recording]) -> bool:
    """Whether every coordinate is a joint with a measured position."""
    plant = dynamics.plant
    joints = [j for j in one_dof_joints(plant) if j.num_velocities()]
    return len(joints) == plant.num_velocities() and all(
        f"{full_name(plant, j)}.position" in r for j in joints for r in recordings
    )


def _shortened(recordings: Sequence[Recording], dynamics: SceneDynamics):
    """What of the recordings is used, and what is to be said of it."""
    seconds = MOST_SEC if _is_mechanism(dynamics, recordings) else np.inf
    used = excerpt(recordings, seconds, MOST_ROWS)
    if len(used) == len(recordings) and all(
        len(a.time) == len(b.time) for a, b in zip(used, recordings, strict=True)
    ):
        return used, []
    whole = sum(r.duration_sec() for r in recordings)
    some = sum(r.duration_sec() for r in used)
    says = (
        f"The recordings hold {whole:.4g} s; fits and simulations use {some:.4g} s of "
        f"them, in evenly spread pieces."
    )
    name = recordings[0].name
    return used, [Finding("excerpt", name, "time", some, "s", "info", says)]


def _settle_step(
    scene: Scene, recordings, dynamics, jobs
) -> tuple[Scene, list[Finding]]:
    """The scene with a step so small that its error is below the noise, and what was
    found. Without contact a continuous plant is as fast, and exact."""
    step = scene.plant.time_step
    if step == 0.0:
        return scene, []
    is_mechanism = _is_mechanism(dynamics, recordings)
    fine = with_step(scene, 0.0 if is_mechanism else step / 4.0)
    most = TOLD_BY if is_mechanism else ASKED
    try:
        coarse_model = WindowModel(scene, recordings, WINDOW_SEC, most=most)
        fine_model = copy(coarse_model)  # Of the same windows.
        fine_model.scene, fine_model.simulation = fine, SceneSimulation(fine)
    except (DoesNotFit, TooStiff):  # For a continuous plant, that is.
        return scene, []
    both = [partial(m.simulate, ()) for m in (coarse_model, fine_model)]
    a, b = side_by_side(both, jobs)
    off = [
        (x - y) / w.std
        for x, y, w in zip(a, b, coarse_model.windows, strict=True)
        if len(x)
    ]
    apart = np.clip(np.concatenate(off), -200, 200) if off else np.full((1, 1), np.nan)
    if not np.isfinite(apart).any():  # No window can be simulated with one of them.
        return scene, []
    size = float(np.sqrt(np.nanmean(apart**2)))
    if size < 1.0 and not is_mechanism:
        return scene, []  # A finer step costs four times as much.
    grave = size >= 0.3
    told = np.isfinite(apart).any(axis=0)
    each = np.sqrt(np.nanmean(apart[:, told] ** 2, axis=0))
    names = [name for name, t in zip(coarse_model.channels, told, strict=True) if t]
    return fine, [
        Finding(
            "time_step",
            recordings[0].name,
            "time",
            size,
            "noise",
            "warning" if grave else "info",
            f"The scene's time step of {step:g} s errs by {figure(size, 2)} times the "
            f"noise within {WINDOW_SEC} s; the comparison uses "
            f"{fine.plant.time_step or 'a continuous plant'}.",
            tuple(zip(names, map(float, each), strict=True)),
        )
    ]


def _widened(
    choice: Choice, problem: GapProblem, end: Fitted, scattered: Sequence[Mapping]
) -> Choice:
    """With deviations no less than data that are held out, or parts of them, say."""
    k = end.effects.index(choice.effect) if choice.effect in end.effects else -1
    if k < 0:
        return choice
    std, or_more = problem.widened(end, k)
    std = {name: max(x, scattered[k].get(name, 0.0)) for name, x in std.items()}
    return replace(choice, std=std, or_more=or_more)


def _with_inseparable(choice: Choice, problem: GapProblem) -> Choice:
    other = problem.inseparable(choice.effect)
    if other is None or any(tie.kind == other.kind for tie in choice.ties):
        return choice
    return replace(choice, ties=(*choice.ties, other))

"""All seven systems in one diagram: their motions, rates, subsets, exported tests."""

import copy
import dataclasses
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from makebreak.diagrams.ball_rolling_config import BallRollingConfig, controller_model
from makebreak.diagrams.gentle_rolling import (
    FELT,
    SEAM_Y,
    SEVEN,
    START_ANGLE,
    GentleRollingConfig,
    ball_config,
    felt_and_glass,
    make_gentle_rolling,
    on_two_surfaces,
    prior,
    telemetry,
)
from makebreak.scripts.cli import main
from makebreak.scripts.experiments import gentle_rolling as experiment
from makebreak.scripts.experiments.papers.rolling_score import progress_of, true_arm
from makebreak.scripts.runner.export_tests import export_tests
from makebreak.systems.arm import impedance_controller
from makebreak.systems.arm.numerics.serial_chain import tip_kinematics
from makebreak.systems.baselines.frozen import Frozen
from makebreak.systems.changing_contact import (
    contact_anticipator,
    mode_detector,
    velocity_shaper,
)
from makebreak.systems.changing_contact.moving_frame import MovingFrame
from makebreak.systems.changing_contact.numerics.contact_task import (
    DONE,
    MADE,
    ContactBelief,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import least_time
from makebreak.systems.changing_contact.numerics.push_motion import (
    BALL_SEGMENT,
    TABLE_SEGMENT,
    PushConfig,
    TableConfig,
    ball_pattern,
    frame_at,
    frame_under,
    moved_frame,
    table_pattern,
)
from makebreak.systems.changing_contact.numerics.reference_blend import (
    blended_reference,
    command,
    weight,
)
from makebreak.systems.changing_contact.push_motion import PushMotion, PushMotionConfig
from makebreak.systems.contact_mpc import c3_mpc, lcs_builder, residual_learner
from makebreak.systems.contact_mpc.numerics.ball_state import P_TIP, V_TIP, pack
from makebreak.systems.contact_mpc.numerics.rolling_task import (
    REPOSITION,
    ROLL,
    CirclePath,
)
from makebreak.systems.numerics.timing import UpdateTimes

DOCS = Path(__file__).parent.parent / "docs"
R_BALL, R_TIP = 0.0365, 0.0195  # As the model has them [m].
HEADING = np.array([0.6, 0.8])
IN_FRONT = np.append(0.027 * HEADING, 0.0755)


def config(**changes) -> GentleRollingConfig:
    out = GentleRollingConfig(**changes)
    out.ball.start_angle_rad = 0.5
    return out


# --- The motions.


def clearance(pattern, radius):
    """Least distance of the tip's surface to a ball under the frame, but for what lies
    within 25 mm of the ends, where it starts on the ball or lands on it [m]."""
    length = pattern.length(0)
    p = np.array([
        pattern.geometry(0, s)[0] for s in np.linspace(0.025, length - 0.045, 200)
    ])  # fmt: skip
    return np.linalg.norm(p - [0.0, 0.0, radius], axis=1).min() - radius - R_TIP


@pytest.mark.parametrize("start", [IN_FRONT, np.append(0.075 * HEADING, 0.0195)])
def test_the_way_behind_the_ball_clears_it_and_ends_straight_down(start):
    pattern = ball_pattern(PushConfig(), start, HEADING, R_BALL, R_TIP, 5.0)
    assert pattern.ends_in_contact(BALL_SEGMENT)
    assert clearance(pattern, R_BALL) > 0.0
    np.testing.assert_allclose(pattern.geometry(0, 0.0)[0], start, atol=1e-12)
    end, tangent = pattern.geometry(0, pattern.length(0))[:2]
    np.testing.assert_allclose(end[:2], -0.018 * HEADING, atol=1e-12)
    # It comes down within 15 degrees: a contact along it is one from above.
    assert tangent[2] < -np.cos(np.deg2rad(15.0))
    # It is planned to below the ball's surface, were it of half the radius.
    assert end[2] < R_BALL + np.sqrt((R_BALL + R_TIP) ** 2 - 0.018**2) - 0.015


def test_a_way_from_the_ball_takes_the_brisk_time_or_what_its_bend_needs():
    for a_max in (5.0, 10.0):
        pattern = ball_pattern(PushConfig(), IN_FRONT, HEADING, R_BALL, R_TIP, a_max)
        least = least_time(pattern.segments[0], a_max, stops=False)
        assert np.ptp(pattern.segments[0].times) == pytest.approx(max(0.4, least))
        assert (least > 0.4) == (a_max == 5.0)


def test_the_way_to_the_table_ends_ahead_of_the_ball_and_slides_away_from_it():
    pattern = table_pattern(PushConfig(), IN_FRONT, HEADING, R_BALL, R_TIP, 5.0)
    assert [pattern.ends_in_contact(k) for k in range(3)] == [False, True, False]
    down = pattern.segments[TABLE_SEGMENT]
    np.testing.assert_allclose(
        down.positions[:, :2], np.outer([1, 1], 0.075 * HEADING), atol=1e-12
    )
    assert down.positions[1][2] < R_TIP  # Into the table.
    slide = np.diff(pattern.segments[2].positions, axis=0)[0]
    assert abs(slide[:2] @ HEADING) < 1e-12 and slide[2] == 0.0
    np.testing.assert_array_equal(pattern.segments[2].force_directions, [[0, 0, -1]])


def test_a_survey_rests_and_then_goes_to_and_fro_into_the_circle():
    shape = PushConfig(table=TableConfig(survey=3, slide=0.07))
    pattern = table_pattern(shape, IN_FRONT, HEADING, R_BALL, R_TIP, 5.0)
    assert len(pattern) == 6 and pattern.ends_in_contact(TABLE_SEGMENT)
    down = pattern.segments[TABLE_SEGMENT].positions[1]
    rest, *passes = pattern.segments[2:]
    assert np.linalg.norm(np.diff(rest.positions, axis=0)) < 0.0011
    assert np.ptp(rest.times) > 0.2
    inwards = np.array([-HEADING[1], HEADING[0]])  # To the left of the way.
    ends = [segment.positions[1] - down for segment in passes]
    np.testing.assert_allclose([p[:2] @ inwards for p in ends], [0.07, 0.001, 0.07])
    np.testing.assert_allclose([p[:2] @ HEADING for p in ends], 0.0, atol=1e-12)
    for segment in (rest, *passes):
        np.testing.assert_array_equal(segment.force_directions, [[0, 0, -1]])


def motion_system(from_wrist=(0.0, -1.0), push=None, waits=1.0):
    path = CirclePath(np.array([0.5, 0.0]), 0.1)
    push = push or PushMotionConfig()
    system = PushMotion(push, path, R_BALL, R_TIP, 5.0, from_wrist)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()

    system.GetInputPort("waits").FixValue(context, [waits])

    def tick(t, task, p_tip, segment=0.0, stage=0.0, ball=(0.6, 0.0, R_BALL)):
        """Returns the outputs after an update at time t."""
        x = pack(p_tip, np.zeros(3), ball, np.zeros(3), R_BALL)
        arm = np.zeros(19)
        arm[:3] = p_tip
        phase = np.array([segment, stage, 0, 0, 0, 0.0])
        for name, value in (("x", x), ("task_phase", [task]), ("phase", phase),
                            ("arm", arm), ("shaped", arm)):  # fmt: skip
            system.GetInputPort(name).FixValue(context, value)
        simulator.AdvanceTo(t)
        return {
            name: system.GetOutputPort(name).Eval(context)[0]
            for name in ("active", "landed", "trial", "kind")
        } | {"frame": system.GetOutputPort("frame").Eval(context)}

    return tick


def test_a_push_begins_where_the_ball_was_met_and_nowhere_else():
    tick = motion_system()
    on_ball = np.array([0.6, -0.018, 0.0895])
    in_the_air = on_ball + [0.0, 0.0, 0.02]
    k = 0

    def ticks(n, *args):
        nonlocal k
        k += n
        return tick(0.0125 * k + 1e-6, *args)

    assert ticks(1, ROLL, in_the_air)["trial"] == 0
    got = ticks(1, REPOSITION, in_the_air)
    assert (got["trial"], got["active"]) == (1, 0)  # The shaper has yet to read it.
    assert ticks(1, REPOSITION, in_the_air)["active"] == 1
    # Felt, 20 mm above the ball: it was not the ball, and the motion begins anew.
    got = ticks(6, REPOSITION, in_the_air, 1.0)
    assert got["trial"] >= 2 and got["landed"] == 0
    ticks(2, REPOSITION, on_ball, 0.0)
    got = ticks(4, REPOSITION, on_ball, 1.0)
    assert got["landed"] == 1
    got = ticks(1, ROLL, on_ball, 1.0)
    assert (got["landed"], got["active"]) == (0, 0)


@pytest.mark.parametrize("waits, expected", [(1.0, [0, 0, 1, 0]), (0.0, [0, 0, 0, 0])])
def test_the_third_reposition_goes_to_the_table_if_the_ball_is_known_to_wait(
    waits, expected
):
    tick, kinds, t = motion_system(waits=waits), [], 0.0
    front = np.array([0.6, 0.027, 0.0755])
    for _ in range(4):
        tick(t + 0.02, ROLL, front)
        kinds.append(tick(t + 0.04, REPOSITION, front)["kind"])
        t += 0.06
        if kinds[-1] == 1:
            got = tick(t + 0.1, REPOSITION, front, 2.0, float(DONE))
            assert got["kind"] == 0 and got["landed"] == 0
            t += 0.1
    assert kinds == expected


def test_the_table_waits_until_the_arm_would_not_hide_the_ball():
    tick, t = motion_system(from_wrist=(0.0, 1.0)), 0.0
    # At the right of the circle the way ahead leads along +y, at the left along -y.
    for ball, kind in (((0.6, 0.0, R_BALL), 0), ((0.4, 0.0, R_BALL), 1)):
        front = np.array(ball) + [0.0, 0.027, 0.039]
        for _ in range(4):
            tick(t + 0.02, ROLL, front, ball=ball)
            got = tick(t + 0.04, REPOSITION, front, ball=ball)["kind"]
            t += 0.06
            if kind:
                break
            assert got == 0
    assert got == 1


@pytest.mark.parametrize("survey", [0, 3])
def test_a_survey_is_made_in_a_frame_that_comes_to_rest(survey):
    push = PushMotionConfig(
        shape=PushConfig(table=TableConfig(survey=survey)), table_first=1
    )
    tick, y = motion_system(push=push), []
    for k in range(1, 61):
        t = 0.0125 * k + 1e-6
        # The ball goes on with 40 mm/s; from 0.25 s on the finger is on the table.
        ball = (0.6, 0.04 * t, R_BALL)
        segment = 0.0 if t < 0.25 else TABLE_SEGMENT + 1.0
        got = tick(t, REPOSITION, np.array([0.6, 0.027, 0.0755]), segment, ball=ball)
        y.append(frame_at(got["frame"], t)[1])
    assert got["kind"] == 1
    speed = (y[-1] - y[-11]) / 0.125
    if survey:
        np.testing.assert_allclose(speed, 0.0, atol=2e-3)
    else:  # With the ball, and around it as the way ahead turns.
        np.testing.assert_allclose(speed, 0.045, atol=5e-3)


def test_the_frame_is_continuous_and_comes_under_a_ball_that_turns():
    angle = 0.0
    p = np.array([0.6, 0.0, R_BALL])
    frame = frame_under(p, np.array([0.0, 0.045, 0.0]), 0.0)
    for k in range(1, 81):  # One second, 45 mm/s on a circle of 0.1 m.
        t = 0.0125 * k
        angle = 0.45 * t
        p = np.array([0.5 + 0.1 * np.cos(angle), 0.1 * np.sin(angle), R_BALL])
        v = 0.045 * np.array([-np.sin(angle), np.cos(angle), 0.0])
        before = frame_at(frame, t)
        frame = moved_frame(frame, t, p, v, 0.15)
        np.testing.assert_allclose(frame_at(frame, t), before, atol=1e-15)
    # A velocity that turns by v w = 0.02 m/s2 is followed with about v w T^2 of error.
    assert np.linalg.norm(frame_at(frame, t)[:2] - p[:2]) < 2 * 0.02025 * 0.15**2
    assert frame[2] == frame[5] == 0.0


def test_moving_frame_takes_the_frames_motion_off():
    system = MovingFrame()
    context = system.CreateDefaultContext()
    context.SetTime(2.0)
    system.GetInputPort("frame").FixValue(context, [1, 2, 0, 0.1, -0.2, 0, 1.5])
    system.GetInputPort("ee_pose").FixValue(context, [3, 3, 0.1, 1, 0, 0, 0])
    system.GetInputPort("ee_velocity").FixValue(context, [0.1, 0, 0.3, 0, 0, 1])
    pose = system.GetOutputPort("ee_pose").Eval(context)
    np.testing.assert_allclose(pose, [1.95, 1.1, 0.1, 1, 0, 0, 0], atol=1e-15)
    velocity = system.GetOutputPort("ee_velocity").Eval(context)
    np.testing.assert_allclose(velocity, [0, 0.2, 0.3, 0, 0, 1], atol=1e-15)


def test_heights_are_all_that_is_left_of_a_contact():
    system = MovingFrame()
    context = system.CreateDefaultContext()
    contact = np.arange(14.0)
    contact[7:10] = np.array([0.1, 0.0, -1.0]) / np.sqrt(1.01)
    system.GetInputPort("contact").FixValue(context, contact)
    got = system.GetOutputPort("contact_height").Eval(context)
    wanted = contact.copy()
    wanted[4:6], wanted[7:10] = 0.0, [0.0, 0.0, -1.0]
    np.testing.assert_array_equal(got, wanted)
    # One from the side keeps its direction.
    contact[7:10] = 1.0, 0.0, 0.0
    system.GetInputPort("contact").FixValue(context, contact)
    got = system.GetOutputPort("contact_height").Eval(context)
    np.testing.assert_array_equal(got[7:10], contact[7:10])
    system.GetInputPort("ee_pose").FixValue(context, [3, 3, 0.1, 1, 0, 0, 0])
    height = system.GetOutputPort("ee_height").Eval(context)
    np.testing.assert_array_equal(height, [0, 0, 0.1, 1, 0, 0, 0])


def test_a_blend_of_two_references_is_one_motion():
    """Velocity and acceleration are the derivatives of the position, by differences."""

    def reference(t, k):
        out = np.zeros(19)
        out[:3], out[3] = k * np.array([t, t**2, 0.1]), 1.0
        out[7:10], out[13:16] = k * np.array([1, 2 * t, 0]), k * np.array([0, 2, 0])
        return out

    def at(t):
        w = weight(np.array([0.2, 1.0, 0.3]), t, 0.05)
        return blended_reference(reference(t, 1.0), reference(t, -0.5), *w)

    h = 1e-6
    for t in (0.305, 0.32, 0.34):
        slope = (at(t + h)[:3] - at(t - h)[:3]) / (2 * h)
        np.testing.assert_allclose(at(t)[7:10], slope, atol=1e-5)
        bend = (at(t + h)[7:10] - at(t - h)[7:10]) / (2 * h)
        np.testing.assert_allclose(at(t)[13:16], bend, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(at(0.36), reference(0.36, -0.5), atol=1e-15)


def test_bad_motions_are_refused_by_name():
    with pytest.raises(ValueError, match="push.shape.lift is -1.0, expected > 0"):
        PushMotion(
            PushMotionConfig(PushConfig(lift=-1.0)), None, R_BALL, R_TIP, 5.0, [1, 0]
        )
    with pytest.raises(ValueError, match="table_first, table_every are 0, 1"):
        PushMotion(
            PushMotionConfig(table_first=0, table_every=1), None, 1, 1, 5.0, [1, 0]
        )


# --- The diagram.


def updates(diagram):
    return {
        s.get_name(): s.update_times.updates
        for s in diagram.GetSystems()
        if hasattr(s, "update_times")
    }


@pytest.fixture(scope="module")
def running():
    """The first landing, and half a second of counts before."""
    diagram = make_gentle_rolling(config())
    simulator, reference = Simulator(diagram), []
    blend = diagram.GetSubsystemByName("reference_blend")
    own = blend.GetMyContextFromRoot(simulator.get_context())

    def note(context):
        tick = 1e3 * context.get_time()
        if abs(tick - round(tick)) < 1e-6:  # What it is made of is held in between.
            reference.append(blend.GetOutputPort("x_desired").Eval(own)[:3])

    simulator.set_monitor(note)
    for system in diagram.GetSystems():
        if hasattr(system, "update_times"):
            system.update_times = UpdateTimes()
    simulator.AdvanceTo(0.5)
    count = updates(diagram)
    simulator.AdvanceTo(3.2)
    return SimpleNamespace(
        reference=np.array(reference),
        diagram=diagram,
        context=simulator.get_context(),
        count=count,
        said=telemetry(diagram, simulator.get_context()),
    )


def test_all_seven_run_at_their_rates(running):
    rates = dict(
        lcs_plan=80, lcs_command=80, lcs_learn=20, c3_mpc=80, residual_learner=20,
        mode_detector=200, contact_anticipator=100, velocity_shaper=1000,
        impedance_controller=1000,
    )  # fmt: skip
    assert set(rates) == {name for names in SEVEN.values() for name in names}
    assert {name: running.count[name] for name in rates} == {
        name: rate // 2 for name, rate in rates.items()
    }


def test_the_first_landing_is_felt_where_the_ball_is_and_learned(running):
    said, made = running.said, running.said["contact"][:, MADE]
    assert made[-1] >= 1
    first = int(np.argmax(made >= 1))
    # The ball's radius is 31.5 mm: there the tip's centre is at
    # 31.5 + sqrt(51^2 - 18^2) = 79.2 mm, on a slope of 0.38 and within 3 mm of its
    # place; the model had 89.5.
    assert said["ee_pose"][first, 2] == pytest.approx(0.0792, abs=0.0015)
    anticipator = running.diagram.GetSubsystemByName("contact_anticipator")
    belief = anticipator.knowledge(anticipator.GetMyContextFromRoot(running.context))
    ball = belief.contacts[0]
    assert ball.seen >= 1 and ball.mean[2] == pytest.approx(0.0792, abs=0.0015)
    assert prior(config()).contacts[0].mean[2] == pytest.approx(0.0895, abs=1e-4)


def test_the_reference_never_steps(running):
    v = np.diff(running.reference, axis=0) / 1e-3
    assert len(v) >= 3199
    # The fastest motion is some 0.4 m/s; a step of 1 mm would be 1 m/s.
    assert np.abs(v).max() < 0.6


def test_nothing_but_what_a_robot_measures_reaches_a_controller(running):
    wires = [
        (source.get_name(), source.get_output_port(port).get_name(), to.get_name())
        for (to, _), (source, port) in running.diagram.connection_map().items()
    ]
    observers = {"state_log", "contact_log", "torque_log", "telemetry", "telemetry_log"}
    measured = {port for name, port, to in wires if name == "station"
                and to not in observers}  # fmt: skip
    assert measured == {
        "panda.position_measured", "panda.velocity_measured", "panda.torque_measured",
        "panda.external_wrench", "overhead.rgb_image",
    }  # fmt: skip
    assert not [w for w in wires if w[0] in observers and w[2] not in observers]
    # The anticipator is told of contacts, not what the learner has learned.
    assert not [w for w in wires if w[0] == "residual_learner"
                and w[2] in ("contact_anticipator", "push_motion")]  # fmt: skip


def test_a_push_is_told_what_the_wrist_feels(running):
    """Of a port that the reference can do without: a loose one fails nowhere else."""
    diagram, context = running.diagram, running.context
    felt, wrench = (
        system.GetOutputPort(port).Eval(system.GetMyContextFromRoot(context))
        for system, port in (
            (diagram.GetSubsystemByName("felt_force"), "y0"),
            (diagram.GetSubsystemByName("wrench_tare"), "wrench_mean"),
        )
    )
    np.testing.assert_array_equal(felt, wrench[:3])
    reference = diagram.GetSubsystemByName("arm_reference")
    port = reference.GetInputPort("tip_force")
    own = reference.GetMyContextFromRoot(context)
    np.testing.assert_array_equal(port.Eval(own), felt)


def test_any_half_can_be_left_out():
    for gentle in (True, False):
        for adapt in (True, False):
            diagram = make_gentle_rolling(config(gentle=gentle, adapt=adapt))
            names = {s.get_name() for s in diagram.GetSystems()}
            assert ("velocity_shaper" in names) == gentle
            assert ("residual_learner" in names) == adapt
            Simulator(diagram).AdvanceTo(0.002)


@pytest.mark.parametrize("first", [0, 1])
def test_each_of_the_seven_can_be_frozen(first):
    frozen = list(SEVEN)[first::2]  # Each beside neighbours that are at work.
    diagram = make_gentle_rolling(config(frozen=frozen))
    for name, systems in SEVEN.items():
        for own in systems:
            system = diagram.GetSubsystemByName(own)
            assert isinstance(system, Frozen) == (name in frozen)
    Simulator(diagram).AdvanceTo(0.015)


def test_a_table_of_two_surfaces_announces_the_mode_of_its_seam():
    diagram = make_gentle_rolling(GentleRollingConfig(table="felt_and_glass"))
    to, at = "mode_detector", diagram.GetSubsystemByName
    source = at("seam_anticipator").GetOutputPort("mode_hint")
    wires = diagram.connection_map()
    assert wires[at(to), at(to).GetInputPort("mode_hint").get_index()] == (
        at("seam_anticipator"), source.get_index(),
    )  # fmt: skip
    # Contacts are the other one's: this one knows changes without impact alone.
    said, _ = wires[
        at("seam_anticipator"),
        at("seam_anticipator").GetInputPort("contact").get_index(),
    ]
    assert said.get_name() == "no_contact"
    held = GentleRollingConfig(table="felt_and_glass", frozen=["contact_anticipator"])
    diagram = make_gentle_rolling(held)
    for name in ("contact_anticipator", "seam_anticipator"):
        assert isinstance(diagram.GetSubsystemByName(name), Frozen)
    assert not make_gentle_rolling(config()).HasSubsystemNamed("seam_anticipator")
    with pytest.raises(ValueError, match="table is 'ice', expected one of: plain"):
        make_gentle_rolling(config(table="ice"))


def test_felt_begins_at_the_seam_and_the_models_have_none():
    both = on_two_surfaces(GentleRollingConfig(table="felt_and_glass", seed=3))
    ball = ball_config(both)
    (zone,) = felt_and_glass(ball).friction_zones
    assert zone.at == "table~finger" and zone.friction == FELT
    assert zone.y[0] == SEAM_Y and zone.x[0] < 0.0 < 0.7 < zone.x[1]
    assert not controller_model(ball)[1].friction_zones
    # The seam is on the ball's way.
    assert abs(SEAM_Y - ball.task.circle.center[1]) < ball.task.circle.radius
    # The ball starts so that after one push the way ahead leads to the wrist's side.
    assert START_ANGLE[0] <= ball.start_angle_rad <= START_ANGLE[1]
    given = on_two_surfaces(config(table="felt_and_glass"))
    assert given.ball.start_angle_rad == 0.5


def test_settings_that_felt_and_glass_replaces_are_refused():
    changed = GentleRollingConfig()
    changed.push.shape.table.survey = 2
    with pytest.raises(
        ValueError, match="push.shape.table.survey is 2, .*the diagram sets"
    ):
        on_two_surfaces(changed)


def test_a_run_ends_by_the_circles_that_are_scored():
    """The ball cuts through 120 degrees of its fourth circle within half a radius of
    the centre, which is not scored: the run goes on until four circles are."""
    diagram = make_gentle_rolling(GentleRollingConfig())
    plant = diagram.GetSubsystemByName("station").GetSubsystemByName("plant")
    ball = ball_config(GentleRollingConfig())
    ending = experiment._Ending(ball, plant)
    angle = np.arange(0.0, 10.0 * np.pi, 0.05)
    cut = abs(angle - 7.0 * np.pi) < np.pi / 3.0
    radius = np.where(cut, 0.04, ball.task.circle.radius)
    p = np.array([*ball.task.circle.center, 0.0])
    p = p + np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle])
    at = plant.GetBodyByName("ball").floating_positions_start() + 4
    sample = {"state": np.zeros(plant.num_multibody_states())}
    for k in range(len(p)):
        sample["state"][at : at + 3] = p[k]
        if ending(0.2 * k, sample):
            break
    scored = progress_of(p[: k + 1], ball.task.circle.center, ball.task.circle.radius)
    assert scored[-1] == pytest.approx(8.0 * np.pi, abs=0.05)
    assert angle[k] == pytest.approx(8.0 * np.pi + 2.0 * np.pi / 3.0, abs=0.15)


def test_forces_are_scored_at_the_tip_that_the_world_has():
    """A laboratory's tool is 2 mm longer than modelled, and hangs straight down."""
    q = np.array([0.0, 0.3, 0.0, -2.2, 0.0, 2.5, 0.785])  # Sums to upright.
    modelled, true = (
        tip_kinematics(true_arm(BallRollingConfig(realism=level)), q)[0]
        for level in ("none", "lab")
    )
    np.testing.assert_allclose(true - modelled, [0.0, 0.0, -0.002], atol=1e-5)


def test_what_cannot_be_frozen_is_refused_by_name():
    with pytest.raises(ValueError, match="frozen has 'shaper', expected some of"):
        make_gentle_rolling(config(frozen=["shaper"]))
    with pytest.raises(ValueError, match="frozen has 'velocity_shaper'"):
        make_gentle_rolling(config(gentle=False, frozen=["velocity_shaper"]))


def test_bad_settings_are_one_line(tmp_path, capfd):
    for setting, message in (
        ("ball.seed=3", "ball.seed is 3, expected 0: seed sets it"),
        ("touch.shaper.period_sec=0.1", "VelocityShaperConfig.period_sec is 0.1"),
        ("touch.blend.period_sec=0.1", "ReferenceBlendConfig.period_sec is 0.1"),
        ("push.settle_sec=0", "push.settle_sec is 0.0, expected > 0"),
    ):
        arguments = ["run", "gentle_rolling", "--no-meshcat", "--out", str(tmp_path)]
        assert main([*arguments, "--duration", "0.01", "--set", setting]) == 2
        lines = capfd.readouterr().err.splitlines()
        assert len(lines) == 1 and message in lines[0]


# --- The score.


def test_purity_counts_each_mode_for_the_surface_that_it_is_mostly_on():
    mode = np.array([0, 1, 1, 1, 2, 2, 2, 2, -1])
    table = np.array([1, 1, 1, 0, 0, 0, 0, 1, 1], dtype=bool)
    share, known = experiment.purity(mode, table, ~table)
    assert (share, known) == (pytest.approx(5 / 7), 2)


def test_radius_by_touch_is_the_balls():
    r, behind = 0.0315, PushConfig().land_behind
    height = r + np.sqrt((r + R_TIP) ** 2 - behind**2)
    contacts = []
    for one, z in zip(prior(config()).contacts, (height, R_TIP), strict=True):
        one = copy.copy(one)
        # An arm whose zero is 7 mm off: both heights are.
        object.__setattr__(one, "mean", np.array([0.0, 0.0, z + 0.007]))
        object.__setattr__(one, "seen", 1)
        contacts.append(one)
    belief = ContactBelief(tuple(contacts))
    got = experiment.radius_by_touch(belief, config(), config().ball)
    assert got == pytest.approx(r, abs=1e-9)
    assert np.isnan(
        experiment.radius_by_touch(prior(config()), config(), config().ball)
    )


def test_the_table_says_what_a_subset_buys():
    def result(peak, seconds, success=True, **more):
        return {
            "success": success, "contact_force_peak_N": peak, "seed": 0,
            "time_to_circles_s": seconds, "circles_completed": 4.0 * success,
            "slide_error_mean_m": 7e-4 + 1e-3 * (not success),
            "reposition_mean_s": 0.6 + (not success), **more,
        }  # fmt: skip

    groups = {
        "all seven": [result(9.0, 110.0)],
        "without the second paper's": [result(20.0, 100.0)],
        "without the learner": [result(9.0, None, False)],
        "without both": [result(20.0, None, False)],
    }
    frozen = {name: [result(50.0, None, False)] for name in SEVEN}
    frozen[""] = [result(9.0, None)]
    table = experiment.table_of(groups, frozen)
    assert table.missed == 0
    text = table.to_text()
    assert "at most 60%" in text and "45%" in text
    assert "at most 125%" in text and "110%" in text
    # A peak of 19 N, a time of 140 s, and a system without which nothing changes.
    groups["all seven"] = [result(19.0, 140.0)]
    frozen["mode_detector"] = frozen[""]
    assert experiment.table_of(groups, frozen).missed == 3
    frozen["c3_mpc"] = [{"success": False, "error": "exit status 3", "seed": 0}]
    table = experiment.table_of(groups, frozen)
    assert table.missed == 3 and "the run breaks off" in table.to_text()


# --- Exported tests of the seven.

NAMES = [name for names in SEVEN.values() for name in names]
EXPORTED_SEC = 2.2  # The first landing, and what follows, is in it.


def failing(out):
    failed = set()
    for path in sorted(out.glob("test_*.py")):
        module = runpy.run_path(str(path))
        [test] = [f for name, f in module.items() if name.startswith("test_")]
        try:
            test()
        except AssertionError:
            failed.add(path.stem.removeprefix("test_"))
    return failed


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    out = tmp_path_factory.mktemp("exported") / "tests"
    _, left_out = export_tests(
        "gentle_rolling", experiment, config(), out, NAMES, EXPORTED_SEC
    )
    assert not left_out
    return out


@pytest.mark.slow
def test_exported_tests_of_the_seven_replay(exported):
    assert {p.stem.removeprefix("test_") for p in exported.glob("test_*.py")} == set(
        NAMES
    )
    assert failing(exported) == set()


def _c3(plain):
    def changed(*args):
        plan, warm = plain(*args)
        return dataclasses.replace(plan, u=1.001 * plan.u), warm

    return changed


# The system -> the module, what is altered there, and how: a gain, or a sign.
ALTERED = {
    "c3_mpc": (c3_mpc, "solve_c3", _c3),
    "residual_learner": (
        residual_learner, "spread", lambda plain: lambda *a: -plain(*a),
    ),
    "mode_detector": (
        mode_detector, "detect", lambda plain: lambda m, tuning, t, wrench, *a: plain(
            m, tuning, t, -wrench, *a),
    ),
    "contact_anticipator": (
        contact_anticipator, "update",
        lambda plain: lambda mean, C, p, R: plain(mean, C, p + 1e-5, R),
    ),
    "velocity_shaper": (
        velocity_shaper, "tick", lambda plain: lambda table, law, *a: (
            plain(table, law._replace(acceleration_max=5.005), *a)),
    ),
    "impedance_controller": (
        impedance_controller, "tick", lambda plain: lambda *a: (
            plain(*a[:7], 1.001 * a[7], *a[8:])),
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", ALTERED)
def test_exactly_the_system_that_was_altered_fails(exported, monkeypatch, name):
    module, what, change = ALTERED[name]
    monkeypatch.setattr(module, what, change(getattr(module, what)))
    assert failing(exported) == {name}


@pytest.mark.slow
def test_exactly_the_lcs_builders_fail_when_theirs_is_altered(exported, monkeypatch):
    plain = lcs_builder.AnitescuLcs.build

    def slipperier(self, x, u):
        lcs = plain(self, x, u)
        return dataclasses.replace(lcs, D=1.001 * lcs.D)

    monkeypatch.setattr(lcs_builder.AnitescuLcs, "build", slipperier)
    assert failing(exported) == set(SEVEN["lcs_builder"])


# --- Pages, and a whole run.


def test_the_page_on_own_diagrams_runs(tmp_path):
    page = (DOCS / "own_diagram.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(code.splitlines()) <= 60
    (tmp_path / "own.py").write_text(code)
    done = subprocess.run(
        [sys.executable, "own.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    height, speed = (float(word) for word in re.findall(r"[-\d.]+", done.stdout)[:2])
    assert height == pytest.approx(0.0195, abs=0.001)  # The tip's radius: the table.
    assert 0.0 < speed < 0.05


@pytest.mark.slow
def test_a_landing_is_softer_with_the_second_papers_systems(tmp_path):
    peaks = {}
    for gentle in ("true", "false"):
        out = tmp_path / gentle
        arguments = ["run", "gentle_rolling", "--no-meshcat", "--seed", "42"]
        arguments += ["--duration", "20", "--out", str(out)]
        assert main([*arguments, "--set", f"gentle={gentle}"]) == 1  # No four circles.
        result = json.loads((out / "result.json").read_text())
        assert result["initiated"]
        peaks[gentle] = result["contact_force_peak_N"]
    assert peaks["true"] < 0.8 * peaks["false"]


def test_the_arms_command_is_the_planners_or_the_shapers():
    """Where the shaper presses down, the arm is where it is along the vertical."""
    rng = np.random.default_rng(4)
    planned, shaped, x = rng.normal(size=(3, 19))
    frame, planned_wrench, fed = (rng.normal(size=n) for n in (7, 6, 6))
    rows, targets = np.array([0.0, 0, -1, 0, 0, 0]), np.array([2.0, 0.0])

    def commanded(leads):
        blend = np.array([leads, leads, 0.0])
        return np.split(
            command(
                1.0, blend, blend, 0.1, np.array([400.0, 120.0]), planned, frame,
                shaped, rows, x, planned_wrench, fed, targets,
            ),
            np.cumsum([19, 6, 6, 6]),
        )  # fmt: skip

    pose, wrench, damping, directions, forces = commanded(0.0)
    np.testing.assert_array_equal(pose, planned)
    np.testing.assert_array_equal(wrench, planned_wrench)
    assert (damping == 400.0).all() and not directions.any() and not forces.any()
    pose, wrench, damping, directions, forces = commanded(1.0)
    origin = frame[:3] + (1.0 - frame[6]) * frame[3:6]
    np.testing.assert_allclose(pose[:2], (shaped[:3] + origin)[:2])
    np.testing.assert_allclose(pose[7:9], (shaped[7:10] + frame[3:6])[:2])
    np.testing.assert_allclose(pose[[2, 9, 15]], [x[P_TIP][2], x[V_TIP][2], 0.0],
                               atol=1e-12)  # fmt: skip
    np.testing.assert_array_equal(pose[3:7], shaped[3:7])
    np.testing.assert_array_equal(wrench, fed)
    assert (damping == 120.0).all()
    np.testing.assert_array_equal(directions, rows)
    np.testing.assert_array_equal(forces, targets)

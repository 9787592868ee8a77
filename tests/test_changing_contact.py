"""The diagram of the changing-contact experiments: wiring, rates, replay, bad input."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RotationMatrix
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.solvers import Solve
from pydrake.systems.analysis import InitializeParams, Simulator

from makebreak.diagrams.changing_contact import (
    SIGNALS,
    ChangingContactConfig,
    Knowledge,
    learned,
    make_changing_contact,
    telemetry,
    tip_mass,
)
from makebreak.diagrams.realism import StationErrors
from makebreak.diagrams.station import make_control_plant
from makebreak.diagrams.tabletop import TABLETOP_WALLS, move, set_friction, set_tool
from makebreak.models.scene import read_scene
from makebreak.scripts.experiments import (
    changing_surface,
    contact_learning,
    contact_types,
    multiple_collisions,
    surface_switch,
)
from makebreak.scripts.runner.settings import apply_settings
from makebreak.systems.changing_contact.numerics.contact_task import (
    DONE,
    MADE,
    PHASE_SEGMENT,
    PHASE_STAGE,
    POSITION,
    ContactBelief,
    ExpectedContact,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    Segment,
)
from makebreak.systems.numerics.timing import UpdateTimes

START = np.array([0.42, -0.16, 0.195])  # Of the sphere's centre [m].
RAISED = 0.095  # The table, so that the way down is short [m].
TOUCH = RAISED + 0.02  # Height at which the sphere meets it [m].
DOWN, LEFT = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])


def test_the_tip_s_mass_is_drake_s_where_the_arm_would_be():
    arm = make_control_plant(read_scene(TABLETOP_WALLS), "tool")
    context = arm.CreateDefaultContext()
    default = arm.GetPositions(context)
    E, W, mass = arm.GetFrameByName("tip"), arm.world_frame(), tip_mass(arm)

    def expected(q, d):
        arm.SetPositions(context, q)
        J = arm.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, E, np.zeros(3), W, W
        )
        return 1.0 / (d @ J @ np.linalg.inv(arm.CalcMassMatrix(context)) @ J.T @ d)

    for d in np.eye(3):
        np.testing.assert_allclose(mass(START, d), expected(default, d), rtol=1e-3)
    # Elsewhere: Drake's own inverse kinematics.
    p = np.array([0.6, 0.1, 0.05])
    ik = InverseKinematics(arm)
    ik.AddPositionConstraint(E, np.zeros(3), W, p, p)
    R = RotationMatrix()
    ik.AddOrientationConstraint(W, R, E, R, 1e-4)
    ik.prog().AddQuadraticErrorCost(np.eye(7), default, ik.q())
    ik.prog().SetInitialGuess(ik.q(), default)
    found = Solve(ik.prog())
    assert found.is_success()
    for d in np.eye(3):
        right = expected(found.GetSolution(ik.q()), d)
        np.testing.assert_allclose(mass(p, d), right, rtol=0.02)
    assert abs(mass(START, d) / mass(p * [1, 1, 0], d) - 1.0) > 0.02  # It does change.
    assert np.isfinite(mass(np.array([2.0, 2.0, 2.0]), DOWN))


def pattern():
    """Down onto the table, and 0.1 m along it."""
    low = START * [1, 1, 0] + [0, 0, TOUCH - 0.005]
    return MotionPattern((
        Segment("line", [START, low], [0.0, 0.8]),
        Segment("line", [low, low + 0.1 * LEFT], [0.8, 2.0], force_directions=[DOWN],
                force_targets=[5.0]),
    ))  # fmt: skip


def scene():
    made = read_scene(TABLETOP_WALLS)
    set_tool(made, "sphere")
    set_friction(made, {"table": 0.3})
    for name in ("table", "red_block", "blue_wall"):
        move(made, name, [0.0, 0.0, RAISED])
    return made


def knowledge(error=0.015):
    mean = START * [1, 1, 0] + [0, 0, TOUCH + error]
    contact = ExpectedContact(mean, 0.015**2 * np.eye(3), DOWN, approach_speed=0.02)
    return Knowledge(ContactBelief((contact,)))


def build(**changes):
    arguments = dict(
        config=ChangingContactConfig(), world=scene(), model=scene(), pattern=pattern(),
        knowledge=knowledge(), seed=0,
    )  # fmt: skip
    return make_changing_contact(**(arguments | changes))


@pytest.fixture(scope="module")
def trial():
    """One whole motion. Returns: diagram, context at its end, telemetry, counts."""
    diagram = build()
    for system in diagram.GetSystems():
        if hasattr(system, "update_times"):
            system.update_times = UpdateTimes()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.5)
    counts = {
        s.get_name(): s.update_times.updates
        for s in diagram.GetSystems()
        if hasattr(s, "update_times")
    }
    middle = simulator.get_context().Clone()
    simulator.AdvanceTo(4.0)
    context = simulator.get_context()
    return diagram, context, telemetry(diagram, context), counts, middle


def test_the_tool_touches_slides_and_arrives(trial):
    _, _, log, _, _ = trial
    assert log["phase"][-1, PHASE_STAGE] == DONE
    assert log["contact"][-1, MADE] == 1.0
    # The contact gives by 0.05 mm per newton; it is felt within 1.5 mm.
    touched = log["contact"][-1, POSITION]
    np.testing.assert_allclose(touched[2], TOUCH, atol=2e-3)
    np.testing.assert_allclose(log["ee_pose"][-1, 1], START[1] + 0.1, atol=2e-3)
    # While sliding it presses with its target: within the sensor's noise of 0.1 N and
    # what the force control lets through.
    sliding = log["phase"][:, PHASE_SEGMENT] == 1
    late = np.flatnonzero(sliding)[-300:]
    assert abs(np.mean(log["wrench"][late, 2]) - 5.0) < 0.3


def test_every_system_runs_at_its_rate(trial):
    assert trial[3] == dict(
        contact_detector=500, mode_detector=100, forward_model_bank=100,
        contact_anticipator=50, velocity_shaper=500, variable_impedance=500,
        impedance_controller=500, wrench_tare=500,
    )  # fmt: skip


def test_no_number_is_nan_and_no_torque_is_beyond_its_limits(trial):
    log = trial[2]
    for name in SIGNALS:
        assert np.isfinite(log[name]).all(), name
    limit = np.array([87.0] * 4 + [12.0] * 3)
    assert (abs(log["tau"]) <= limit).all()
    # 1000 N m/s, a millisecond; 1e-9 for rounding.
    assert abs(np.diff(log["tau"], axis=0)).max() <= 1.0 + 1e-9


def test_a_context_replays_bit_for_bit(trial):
    diagram, _, log, _, middle = trial
    again = Simulator(diagram, middle.Clone())
    again.Initialize(InitializeParams(suppress_initialization_events=True))
    again.AdvanceTo(2.0)
    ours = telemetry(diagram, again.get_context())
    # The copied log goes on, and initialising it takes the sample at 0.5 s once more.
    _, once = np.unique(ours["time"], return_index=True)
    assert len(once) == 2001
    for name in SIGNALS:
        np.testing.assert_array_equal(ours[name][once], log[name][:2001], name)


def test_what_was_learned_makes_the_next_trial_shorter_and_as_sure(trial):
    diagram, context, log, _, _ = trial
    known = learned(diagram, context)
    assert known.contacts.contacts[0].seen == 1
    # 15 mm off before; a contact is felt within 1.5 mm of where it is.
    assert abs(known.contacts.contacts[0].mean[2] - TOUCH) < 2e-3
    again = build(knowledge=known)
    simulator = Simulator(again)
    simulator.AdvanceTo(4.0)
    later = telemetry(again, simulator.get_context())

    def end(log):
        return log["time"][np.argmax(log["phase"][:, PHASE_STAGE] == DONE)]

    assert later["contact"][-1, MADE] == 1.0
    assert end(later) < end(log) - 0.2


MEASURED = {"panda.position_measured", "panda.velocity_measured"}
MEASURED |= {"panda.external_wrench"}


def test_no_ground_truth_reaches_a_controller():
    diagram = build()
    wires = [
        (source.get_name(), source.get_output_port(port).get_name(), to.get_name())
        for (to, _), (source, port) in diagram.connection_map().items()
    ]
    logs = {"telemetry", "recorder"}
    used = {p for name, p, to in wires if name == "station" and to not in logs}
    assert used == MEASURED
    readers = {to for name, _, to in wires if name in logs}
    assert readers == {"telemetry_log"}


def test_seed_decides_a_run():
    def short(seed):
        diagram = build(seed=seed)
        simulator = Simulator(diagram)
        simulator.AdvanceTo(0.05)
        return telemetry(diagram, simulator.get_context())["tau"]

    np.testing.assert_array_equal(short(3), short(3))
    assert (short(3) != short(4)).any()


def test_periods_are_the_diagrams():
    config = ChangingContactConfig()
    config.shaper = replace(config.shaper, period_sec=0.002)
    with pytest.raises(ValueError, match="period_sec is 0.002, expected 0.001: the di"):
        build(config=config)
    with pytest.raises(ValueError, match="hammer"):
        build(tool="hammer")


def test_the_anticipator_has_the_gain_of_the_reflex_and_no_other():
    config = ChangingContactConfig()
    config.anticipator.speed.reflex.gain = 3.0
    message = "anticipator.speed.reflex.gain is 3.0, expected 0.0: the diagram sets it"
    with pytest.raises(ValueError, match=message):
        build(config=config)


def test_a_stiffness_that_the_law_never_uses_is_refused():
    config = ChangingContactConfig()
    config.impedance.stiffness = [500.0] * 3 + [50.0] * 3
    with pytest.raises(ValueError, match="impedance.stiffness is .*the diagram sets"):
        build(config=config)
    config = ChangingContactConfig()
    config.impedance.damping = [300.0] * 3 + [15.0] * 3
    with pytest.raises(ValueError, match="impedance.damping is .*the diagram sets"):
        build(config=config)
    config.hybrid.damping_ratio = 0.0  # The law then uses this damping.
    build(config=config)


def test_settings_of_a_reflex_that_is_not_there_are_refused():
    config = ChangingContactConfig()
    config.reflex.force_max = 12.0
    with pytest.raises(ValueError, match="reflex.force_max is 12.0, .*reflex.gain=0"):
        build(config=config)
    config.reflex.gain = 2.0
    build(config=config)


@pytest.mark.parametrize("mean_wrench", [False, True])
def test_all_that_read_the_wrench_read_it_without_the_sensor_s_bias(mean_wrench):
    bias = np.array([0.4, -0.3, 0.5])
    config = ChangingContactConfig(mean_wrench=mean_wrench)
    diagram = build(config=config, errors=StationErrors(force_bias=bias))
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.7)  # Above the table still.
    root = simulator.get_context()

    def value(system, port, get):
        own = diagram.GetSubsystemByName(system)
        return getattr(own, get)(port).Eval(own.GetMyContextFromRoot(root))

    tared = value("wrench_tare", "bias", "GetOutputPort")
    # The mean of 100 samples with 0.1 N, four times over, and the tool's inertia.
    np.testing.assert_allclose(tared[:3], bias, atol=0.055)
    for system, port, output in (
        ("contact_detector", "wrench", "wrench"),
        ("mode_detector", "wrench", "wrench"),
        ("forward_model_bank", "wrench", "wrench_mean" if mean_wrench else "wrench"),
        ("impedance_controller", "wrench_measured", "wrench"),
    ):
        np.testing.assert_array_equal(
            value(system, port, "GetInputPort"),
            value("wrench_tare", output, "GetOutputPort"),
        )
    # In free space: five samples of 0.1 N, and what the tare is off by.
    mean = value("wrench_tare", "wrench_mean", "GetOutputPort")
    np.testing.assert_allclose(mean[:3], 0.0, atol=4 * 0.1 / np.sqrt(5) + 0.055)


UNUSED = [
    ("anticipator.speed.beta=0.01", "anticipator.speed.regression=false"),
    ("shaper.region.margin=0.05", "shaper.region.anticipate=true"),
    ("variable_impedance.blend_sec=0.3", "variable_impedance.transition=true"),
    ("variable_impedance.stiffness.impact=99", "variable_impedance.transition=true"),
    ("forward_model.tau_nov=0.01", "forward_model.learns=true"),
]
OPPOSITE = {"true": "false", "false": "true"}


@pytest.mark.parametrize("module", [
    changing_surface, contact_learning, contact_types, multiple_collisions,
    surface_switch,
])  # fmt: skip
def test_settings_that_another_one_leaves_out_are_refused(module):
    def task(*settings):
        words = [f"control.{setting}" for setting in settings]
        return module.make_task(apply_settings(module.Config(), words))

    for setting, chosen in UNUSED:
        key, _, value = chosen.partition("=")
        without = f"{key}={OPPOSITE[value]}"
        with pytest.raises(ValueError, match=f"expected .*: not used with {without}"):
            task(setting, without)
        task(setting, chosen)
    speed = "anticipator.speed.first"
    used, other = "speed=0.02", "force=5"
    if module in (contact_learning, multiple_collisions):
        used, other = other, used
    task(f"{speed}.{used}")
    with pytest.raises(ValueError, match=f"not used with {speed}.stiffness_most"):
        task(f"{speed}.{other}")
    stiffest = "0" if used == "force=5" else "1e5"
    task(f"{speed}.{other}", f"{speed}.stiffness_most={stiffest}")

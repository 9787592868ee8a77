"""Errors of the station that its model does not have."""

from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams import contact_types
from makebreak.diagrams.ball_rolling import make_ball_rolling
from makebreak.diagrams.ball_rolling_config import BallRollingConfig
from makebreak.diagrams.camera import CameraConfig
from makebreak.diagrams.contact_types import ContactTypesConfig
from makebreak.diagrams.gentle_rolling import GentleRollingConfig, make_gentle_rolling
from makebreak.diagrams.multiple_collisions import MultipleCollisionsConfig, make_task
from makebreak.diagrams.push_object import PushObjectConfig, make_push_object
from makebreak.diagrams.realism import (
    REALISM,
    StationErrors,
    draw_errors,
    with_errors,
)
from makebreak.diagrams.station import (
    TIP_FRAME,
    SensorNoise,
    StationConfig,
    make_control_plant,
    make_station,
)
from makebreak.diagrams.tabletop import TABLETOP_WALLS, TOOL, position
from makebreak.diagrams.wall_friction import WallFrictionConfig, make_wall_friction
from makebreak.models.scene import load_scene, read_scene
from makebreak.scripts.experiments import contact_learning, multiple_collisions
from makebreak.systems.arm.impedance_controller import serial_chain_of
from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.tip_state import tip_pose

ARM = "panda"
QUIET = SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0)


def errors(**changes):
    return StationErrors(**changes)


def station(these, sampled=True):
    config = StationConfig(
        scene=TABLETOP_WALLS,
        noise=QUIET,
        tool=TOOL,
        contact=[TOOL, "table"],
        sampled=sampled,
    )
    return make_station(config, errors=these)


def test_levels_are_drawn_by_the_seed_and_none_is_nothing():
    none = draw_errors("none", 3)
    assert not any(np.any(value) for value in vars(none).values()) and none.place == 0.0
    many = [draw_errors("lab", seed) for seed in range(200)]
    lab = REALISM["lab"]
    # 1400 Gaussian numbers: their deviation within 4 sigma/sqrt(2 n).
    np.testing.assert_allclose(np.std([e.encoders for e in many]), 5e-4, rtol=0.08)
    for e in many:
        np.testing.assert_allclose(np.linalg.norm(e.tilt), np.radians(0.5))
        assert np.all(abs(e.force_bias) <= 0.5) and np.all(
            abs(e.force_drift) <= lab.drift
        )
        assert (e.tool, e.delay) == (0.002, 0.001)
    assert np.std([e.force_bias for e in many]) > 0.25
    np.testing.assert_array_equal(many[5].encoders, draw_errors("lab", 5).encoders)
    assert draw_errors("poor", 0).delay == 0.003
    with pytest.raises(ValueError, match="realism is 'labb': did you mean lab"):
        draw_errors("labb", 0)


def test_encoders_and_a_longer_tool_put_the_tip_elsewhere_than_the_arm_believes():
    offsets = np.array([1.0, -2.0, 0.5, 3.0, -1.0, 0.2, 4.0]) * 1e-3
    diagram = station(errors(encoders=offsets, tool=0.003))
    root = diagram.CreateDefaultContext()
    q = diagram.GetOutputPort(f"{ARM}.position_measured").Eval(root)
    model = make_control_plant(read_scene(TABLETOP_WALLS), TOOL)
    # A scene's initial positions are what is measured: the arm stands elsewhere.
    started = model.GetPositions(model.CreateDefaultContext())
    np.testing.assert_allclose(q, started, atol=1e-12)
    chain = packed(serial_chain_of(model, TIP_FRAME))
    believed = tip_pose(chain, q - offsets)[:3]  # By an arm without offsets.
    true = diagram.GetOutputPort(f"{TOOL}.tip_position").Eval(root)
    np.testing.assert_allclose(true - believed, [0.0, 0.0, -0.003], atol=1e-4)
    assert 5e-4 < np.linalg.norm(tip_pose(chain, q)[:3] - believed) < 5e-3


@pytest.mark.parametrize("delay", [0.001, 0.003])
def test_what_is_measured_comes_late_with_a_bias_that_drifts(delay):
    bias, drift = np.array([0.4, -0.3, 0.2]), np.array([1.0, 2.0, -3.0])
    late = errors(force_bias=bias, force_drift=drift, delay=delay)
    logs = {}
    for name, these in (("late", late), ("true", errors())):
        diagram = station(these)
        root = diagram.CreateDefaultContext()
        diagram.GetInputPort(f"{ARM}.torque_commanded").FixValue(root, np.zeros(7))
        simulator = Simulator(diagram, root)  # It falls.
        rows = []
        for k in range(60):
            simulator.AdvanceTo(1e-3 * k + 5e-4)
            rows.append([
                *diagram.GetOutputPort(f"{ARM}.position_measured").Eval(root),
                *diagram.GetOutputPort(f"{ARM}.velocity_measured").Eval(root),
                *diagram.GetOutputPort(f"{ARM}.external_wrench").Eval(root),
            ])  # fmt: skip
        logs[name] = np.array(rows)
    n = round(delay / 1e-3)
    measured, true = logs["late"][20:], logs["true"][20 - n : 60 - n]
    assert np.ptp(true[:, 7:14], axis=0).max() > 0.1
    np.testing.assert_allclose(measured[:, :14], true[:, :14], atol=1e-9)
    off = measured[:, 14:17] - true[:, 14:17]
    time = 1e-3 * np.arange(20, 60)[:, None]
    # The drift is as late as the rest: 3 N/s by at most 3.5 ms.
    np.testing.assert_allclose(off, bias + drift * time, atol=0.012)
    np.testing.assert_allclose(measured[:, 17:], true[:, 17:], atol=1e-9)


def test_the_table_is_where_drake_has_it():
    these = errors(tilt=np.array([0.006, -0.009]))
    scene = with_errors(read_scene(TABLETOP_WALLS), these, ARM, TOOL)
    builder = DiagramBuilder()
    loaded = load_scene(scene, builder)
    root = builder.Build().CreateDefaultContext()
    graph = loaded.scene_graph
    query = graph.get_query_output_port().Eval(graph.GetMyContextFromRoot(root))
    origin = position(scene, "table")
    p = np.array([[0.42, -0.16, 0.0], [0.6, 0.1, 0.0], [0.5, 0.3, 0.0]])
    rise = these.table_rise(p, origin)
    assert abs(rise).max() > 5e-4
    inspector = graph.model_inspector()
    for at, up in zip(p, rise, strict=True):
        at = at + [0.0, 0.0, up]
        (distance,) = [
            one.distance
            for one in query.ComputeSignedDistanceToPoint(at, 0.05)
            if inspector.GetName(one.id_G).startswith("table::")
        ]
        assert abs(distance) < 1e-9
    # Of an upright block's corners the first one touches.
    corners = np.array([[a, b, 0.0] for a in (-1, 1) for b in (-1, 1)]) * 0.015
    highest = these.table_rise(p[0] + corners, origin).max()
    (met,) = these.table_rise(p[:1], origin, 0.015)
    np.testing.assert_allclose(met, highest, atol=1e-8)
    assert met > rise[0] + 1e-4


def test_the_model_s_scene_is_left_as_it_is():
    scene = read_scene(TABLETOP_WALLS)
    with_errors(scene, draw_errors("poor", 0), ARM, TOOL)
    assert scene.effects == [] and all(
        d.add_weld.X_PC is None for d in scene.directives
        if d.add_weld is not None and d.add_weld.child == "tool::tool"
    )  # fmt: skip


def test_contacts_are_scored_by_the_truth():
    task = make_task(MultipleCollisionsConfig(seed=100, realism="lab"))
    p = np.array([[0.42, -0.16, 0.1]])
    rise = task.errors.table_rise(p, position(task.world, "table"), task.corner)
    assert rise.shape == (1,) and abs(rise[0]) > 1e-5
    # At the table's true height, which is not the level one's, it is touched.
    time = np.arange(0.0, 0.4, 1e-3)
    z = -task.truth[0] + rise[0] + 0.1 * np.maximum(0.2 - time, 0.0)
    n = len(time)
    tip = np.column_stack([np.full(n, 0.42), np.full(n, -0.16), z])
    log = dict(
        time=time, tip_true=tip, ee_pose=np.full((n, 7), np.nan),
        ee_velocity=np.zeros((n, 6)), wrench=np.zeros((n, 6)),
        contact=np.zeros((n, 14)), phase=np.zeros((n, 6)),
    )  # fmt: skip
    trial = multiple_collisions.scored(log, task)
    assert trial.touched[0] == pytest.approx(0.2, abs=2e-3)
    assert np.isnan(trial.touched[1:]).all() and trial.missed == 1
    assert contact_learning.Config(realism="poor").realism == "poor"


def _contact_types(config):
    return contact_types.make_contact_types(config, contact_types.make_task(config))


DRAWN = CameraConfig(renderer="drawn")
# Of each: how it is built, its settings, the tool, the table, and what stands on it.
EXPERIMENTS = {
    "contact_types": (_contact_types, ContactTypesConfig(), "tool", "surfaces", ""),
    "wall_friction": (make_wall_friction, WallFrictionConfig(), "tool", "table", ""),
    "ball_rolling": (
        make_ball_rolling, BallRollingConfig(camera=DRAWN), "finger", "table", "ball",
    ),
    "gentle_rolling": (
        make_gentle_rolling, GentleRollingConfig(), "finger", "table", "ball",
    ),
    "push_object": (
        make_push_object, PushObjectConfig(), "finger", "table", "object",
    ),
}  # fmt: skip


class Built:
    """An experiment at its first instant, and what is true of its world there."""

    def __init__(self, name, level):
        make, config, tool, table, self._stands = EXPERIMENTS[name]
        self.diagram = make(replace(config, realism=level, seed=3))
        simulator = Simulator(self.diagram)
        simulator.Initialize()  # A delayed sensor has a value from here on.
        self.root = simulator.get_context()
        self._simulator = simulator  # Owns the context.
        self.station = self.diagram.GetSubsystemByName("station")
        self._plant = self.station.GetSubsystemByName("plant")
        self._graph = self.station.GetSubsystemByName("scene_graph")
        self._context = self._plant.GetMyContextFromRoot(self.root)
        self.q = self._plant.GetPositions(
            self._context, self._plant.GetModelInstanceByName(ARM)
        )
        mount = self._plant.GetFrameByName("panda_link8")
        tip = self._plant.GetFrameByName(TIP_FRAME)
        X = tip.CalcPose(self._context, mount)
        self.p_tip = X.translation()
        body = self._plant.GetBodyIndices(self._plant.GetModelInstanceByName(table))[0]
        (self._surface,) = self._plant.GetCollisionGeometriesForBody(
            self._plant.get_body(body)
        )
        pose = self._graph.model_inspector().GetPoseInFrame(self._surface)
        self.normal = pose.rotation().matrix()[:, 2]

    def port(self, name):
        context = self.station.GetMyContextFromRoot(self.root)
        return self.station.GetOutputPort(name).Eval(context)

    def clearance(self):
        """Between the table and what stands on it [m]; 0 without it."""
        if not self._stands:
            return 0.0
        query = self._graph.get_query_output_port().Eval(
            self._graph.GetMyContextFromRoot(self.root)
        )
        body = self._plant.GetBodyByName(self._stands)
        return min(
            query.ComputeSignedDistancePairClosestPoints(self._surface, g).distance
            for g in self._plant.GetCollisionGeometriesForBody(body)
        )

    def known(self):
        """{system: all numbers that it holds}, of all systems but the station."""
        return {
            system.get_name(): list(numbers(vars(system)))
            for system in self.diagram.GetSystems()
            if system is not self.station
        }


def numbers(value, depth=0):
    """All numbers in an object and its parts."""
    if isinstance(value, (bool, int, float)):
        yield repr(value)  # As text, NaN equals NaN.
    elif isinstance(value, np.ndarray) and value.dtype != object:
        yield repr(value.tolist())
    elif isinstance(value, MultibodyPlant):
        context = value.CreateDefaultContext()
        tip = value.GetFrameByName(TIP_FRAME).CalcPoseInWorld(context)
        yield repr(tip.GetAsMatrix34().tolist())
        yield repr(value.GetPositions(context).tolist())
        yield repr(value.CalcMassMatrix(context).tolist())
    elif depth > 8:
        return
    elif isinstance(value, dict):
        for one in value.values():
            yield from numbers(one, depth + 1)
    elif isinstance(value, (tuple, list, np.ndarray)):
        for one in value:
            yield from numbers(one, depth + 1)
    elif is_dataclass(value):
        for one in fields(value):
            yield from numbers(getattr(value, one.name), depth + 1)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_world_has_the_errors_and_no_controller_knows_them(name):
    none, lab = Built(name, "none"), Built(name, "lab")
    these = draw_errors("lab", 3)
    # Read with noise of 1e-5 rad, of which six deviations are allowed.
    for built, offsets in ((none, 0.0), (lab, these.encoders)):
        measured = built.port(f"{ARM}.position_measured")
        np.testing.assert_allclose(measured - built.q, offsets, atol=6e-5)
    np.testing.assert_allclose(
        np.linalg.norm(lab.p_tip - none.p_tip), these.tool, atol=1e-12
    )
    np.testing.assert_allclose(none.normal, [0.0, 0.0, 1.0], atol=1e-12)
    tilt = np.arccos(lab.normal[2])
    # Roll, then pitch: to second order their root sum square.
    np.testing.assert_allclose(tilt, np.radians(0.5), rtol=1e-4)
    np.testing.assert_allclose(lab.clearance(), none.clearance(), atol=1e-9)
    for part in ("encoders_delay", "wrench_delay", "wrench_bias"):
        assert lab.station.HasSubsystemNamed(f"{ARM}_{part}")
        assert not none.station.HasSubsystemNamed(f"{ARM}_{part}")
    known = none.known()
    assert len(known["impedance_controller"]) > 5
    assert known == lab.known()


@pytest.mark.parametrize("name", ["gentle_rolling", "wall_friction", "contact_types"])
def test_nobody_but_the_recorder_reads_the_wrench_before_the_tare(name):
    if name == "gentle_rolling":
        config = GentleRollingConfig()
        config.ball.camera = CameraConfig(renderer="drawn")
        diagram = make_gentle_rolling(config)
    elif name == "wall_friction":
        diagram = make_wall_friction(WallFrictionConfig(), feedforward="last")
    else:
        config = ContactTypesConfig()
        diagram = contact_types.make_contact_types(
            config, contact_types.make_task(config)
        )
    wrench = diagram.GetSubsystemByName("station").GetOutputPort(
        "panda.external_wrench"
    )
    readers = {
        target[0].get_name()
        for target, (source, port) in diagram.connection_map().items()
        if source.get_name() == "station" and port == wrench.get_index()
    }
    logs = {reader for reader in readers if "record" in reader or "telem" in reader}
    assert readers - logs == {"wrench_tare"}


def test_the_bias_is_taken_off_before_the_wall_friction_block_lands():
    config = WallFrictionConfig(seed=3, realism="lab")
    simulator = Simulator(make_wall_friction(config))
    diagram, root = simulator.get_system(), simulator.get_mutable_context()
    simulator.AdvanceTo(0.5)
    wrenches = []
    for k in range(100):
        simulator.AdvanceTo(0.5 + 0.001 * k)
        wrenches.append(diagram.GetOutputPort("wrench").Eval(root)[:3])
    # 4 x 0.1/sqrt(100) of noise, and 0.3 kg times the motion's 0.2 m/s2.
    np.testing.assert_allclose(np.mean(wrenches, axis=0), 0.0, atol=0.1)
    assert np.linalg.norm(draw_errors("lab", 3).force_bias) > 0.3

from dataclasses import dataclass, field

import numpy as np
import pytest
from pydrake.common.yaml import yaml_load_typed
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

import makebreak as mb
from makebreak.diagrams.station import make_control_plant
from makebreak.systems.changing_contact.forward_model import (
    ForwardModelBank,
    ForwardModelConfig,
)
from makebreak.systems.numerics.settings import check_settings, check_times


@dataclass
class Inner:
    gain: float = 1.0


@dataclass
class Settings:
    gain: float = 1.0
    bound: float | None = None
    count: int = 3
    on: bool = False
    name: str = ""
    rows: list[list[int]] = field(default_factory=list)
    inner: Inner = field(default_factory=Inner)
    either: Inner | None = None
    weights: np.ndarray = field(default_factory=lambda: np.zeros(0))
    period_sec: float = 0.1
    offset_sec: float = 0.0


@pytest.mark.parametrize(
    "change",
    [
        {"gain": 2},
        {"gain": np.float32(0.5)},
        {"gain": np.array(0.5)},
        {"gain": np.inf},
        {"bound": None},
        {"bound": -np.inf},
        {"count": 4.0},
        {"count": np.int64(4)},
        {"on": np.True_},
        {"rows": ((1, 2), np.array([3]))},
        {"rows": np.ones((2, 3), int)},
        {"either": Inner()},
        {"weights": [1.0, 2.0]},
        {"offset_sec": 0},
    ],
)
def test_what_a_setting_may_be_is_taken(change):
    check_settings(Settings(**change))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"gain": None}, "Settings.gain is None, expected a number"),
        ({"gain": np.nan}, "Settings.gain is nan, expected a number"),
        ({"gain": "1"}, "Settings.gain is '1', expected a number"),
        ({"gain": True}, "Settings.gain is True, expected a number"),
        ({"gain": [1.0]}, r"Settings.gain is \[1.0\], expected a number"),
        ({"bound": "x"}, "Settings.bound is 'x', expected a number or None"),
        ({"count": 2.5}, "Settings.count is 2.5, expected an integer"),
        ({"count": np.inf}, "Settings.count is inf, expected an integer"),
        ({"on": 1}, "Settings.on is 1, expected true or false"),
        ({"name": 3}, "Settings.name is 3, expected a text"),
        ({"rows": [[0], [1.5]]}, r"Settings.rows\[1\]\[0\] is 1.5, expected an int"),
        ({"rows": "01"}, "Settings.rows is '01', expected a list"),
        ({"rows": [3]}, r"Settings.rows\[0\] is 3, expected a list"),
        ({"inner": 3}, r"Settings.inner is 3, expected Inner\(...\)"),
        ({"inner": Inner(np.nan)}, "Settings.inner.gain is nan, expected a number"),
        ({"either": Inner("")}, "Settings.either.gain is '', expected a number"),
        ({"period_sec": 0.0}, r"period_sec is 0.0, expected a positive time \[s\]"),
        ({"period_sec": np.inf}, "period_sec is inf, expected a positive time"),
        ({"offset_sec": -1.0}, "offset_sec is -1.0, expected a time of 0 or more"),
        ({"offset_sec": np.nan}, "offset_sec is nan, expected a number"),
    ],
)
def test_what_a_setting_may_not_be_is_refused_by_its_name(change, message):
    with pytest.raises(ValueError, match=message):
        check_settings(Settings(**change))


def test_times_that_are_arguments_are_checked_alike():
    check_times("System", 0.1, 0.0)
    for period, offset in ((0.0, 0.0), (np.nan, 0.0), (0.1, -0.1), (0.1, None)):
        with pytest.raises(ValueError, match="System.(period|offset)_sec is"):
            check_times("System", period, offset)


@pytest.fixture(scope="module")
def puck():
    plant, _ = AddMultibodyPlantSceneGraph(builder := DiagramBuilder(), 0.0)
    Parser(plant).AddModels(mb.model_path("puck.sdf"))
    plant.Finalize()
    return builder.Build()


def _systems(puck):
    """A config of each of the seven systems and others, and how the system is made."""
    pair = mb.ContactPair("finger", "puck", 0.3)
    lcs = mb.AnitescuLcs(puck, [pair], 0.05).at_default()
    n = lcs.n_x + 2 * lcs.n_lam + lcs.n_u
    weights = mb.C3Weights(*map(np.ones, (lcs.n_x, lcs.n_u, n, n)))
    pattern = mb.MotionPattern((mb.Segment("line", [[0, 0, 1], [0, 0, 0]], [0, 9]),))
    return {
        "lcs_builder": (
            mb.LcsBuilderConfig([pair], 0.05),
            lambda c: mb.AnitescuLcsBuilder(puck, c),
        ),
        "contact_pair": (pair, lambda c: mb.AnitescuLcs(puck, [c], 0.05)),
        "c3": (mb.C3Config(weights), lambda c: mb.C3Mpc(c, 0.05)),
        "learner": (
            mb.ResidualLearnerConfig(),
            lambda c: mb.ResidualLearner(c, lcs, 0.05),
        ),
        "modes": (mb.ModeDetectorConfig(), mb.ModeDetector),
        "forward_models": (ForwardModelConfig(), ForwardModelBank),
        "anticipator": (mb.ContactAnticipatorConfig(), mb.KalmanContactAnticipator),
        "shaper": (
            mb.VelocityShaperConfig(),
            lambda c: mb.VelocityShaper(c, pattern),
        ),
        "detector": (mb.ContactDetectorConfig(), mb.ContactDetector),
        "impedance": (
            mb.ImpedanceConfig(),
            lambda c: mb.ImpedanceController(c, make_control_plant()),
        ),
    }


@pytest.mark.parametrize(
    "system, setting, value",
    [
        ("lcs_builder", "dt_sec", None),
        ("lcs_builder", "knots", np.nan),
        ("lcs_builder", "contacts", 3.0),
        ("lcs_builder", "offset_sec", np.nan),
        ("contact_pair", "a", 3),
        ("contact_pair", "friction", "0.3"),
        ("contact_pair", "friction_directions", np.inf),
        ("contact_pair", "closest", np.nan),
        ("c3", "residual_dt_sec", None),
        ("c3", "clamp_command_gap", "no"),
        ("learner", "slip_noise", [0.1]),
        ("learner", "groups", 1),
        ("modes", "batch", None),
        ("forward_models", "with_torque", "no"),
        ("anticipator", "period_sec", np.inf),
        ("anticipator", "offset_sec", -1.0),
        ("shaper", "speed_min", "0.1"),
        ("shaper", "offset_sec", np.nan),
        ("detector", "tool_mass", None),
        ("impedance", "force_max", "10"),
        ("impedance", "offset_sec", np.nan),
        ("impedance", "control_orientation", None),
    ],
)
def test_each_system_says_in_one_line_which_setting_is_wrong(
    puck, system, setting, value
):
    config, make = _systems(puck)[system]
    make(config)
    setattr(config, setting, value)
    with pytest.raises(ValueError, match=setting) as error:
        make(config)
    assert len(str(error.value).splitlines()) == 1


def test_what_drake_reads_from_yaml_passes():
    data = "{filter: {gate: 3}, speed: {regression: false}, period_sec: 1}"
    config = yaml_load_typed(schema=mb.ContactAnticipatorConfig, data=data)
    check_settings(config)

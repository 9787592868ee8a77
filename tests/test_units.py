"""What a log's columns count in: the reading that contradicts the least."""

import numpy as np
import pytest

from makebreak.gap.data.match import AS_SAID, JointName, Match
from makebreak.gap.data.units import in_units, said_of_units

T = np.arange(0.0, 8.0, 0.01)
SCARA = [JointName("r.a", False, -3.0, 3.0), JointName("r.b", False, -2.6, 2.6),
         JointName("r.z", True, -0.3, 0.1)]  # fmt: skip
Q = {"a": 2.5 * np.sin(1.3 * T), "b": 0.4 * np.sin(2.1 * T),
     "z": -0.1 + 0.15 * np.sin(1.7 * T)}  # fmt: skip
V = {k: np.gradient(q, T) for k, q in Q.items()}


def read(columns, said=None):
    """{column: match} of columns `<joint>_q`, `_v` and `_goal`."""
    what = {"q": "position", "v": "velocity", "goal": "position_command"}
    matches = {"t": Match("t", "time")}
    for name in columns:
        joint, short = name.split("_")
        matches[name] = Match(name, f"r.{joint}.{what[short]}", why="by its name")
    matches |= said or {}
    return in_units({"t": T} | columns, SCARA, matches)


def columns(revolute=1.0, sliding=1.0, rate=1.0, speed=1.0):
    out = {}
    for k in Q:
        own, per_sec = (sliding, speed) if k == "z" else (revolute, rate)
        out |= {f"{k}_q": Q[k] / own, f"{k}_v": V[k] / per_sec}
    return out


DEG = np.pi / 180.0


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize(
    "units", [(1.0, 1.0, 1.0, 1.0), (DEG, 1e-3, DEG, 1e-3), (DEG, 1.0, 1.0, 1.0),
              (1.0, 1e-3, DEG, 1e-3), (1.0, 1.0, np.pi / 30.0, 1e-3)],
)  # fmt: skip
def test_a_scara_has_a_unit_for_what_turns_and_one_for_what_slides(units, velocities):
    """Joint b moves by 23 degrees alone: without velocities joint a tells its unit."""
    log = columns(*units)
    if not velocities:
        log = {name: y for name, y in log.items() if name.endswith("_q")}
    found = read(log)
    expected = dict(zip(("q", "z_q", "v", "z_v"), units, strict=True))
    for name in log:
        own = expected.get(name, expected[name[-1]])
        assert found[name].scale == pytest.approx(own), name
        assert found[name].offset == 0.0
        assert bool(found[name].told) == (own != 1.0)


def test_wheels_that_go_on_and_on_are_in_rad_and_arms_that_come_back_in_degrees():
    """Of joints without limits, by how far they turn."""
    joints = [JointName(f"r.{k}", False) for k in "abc"]
    matches = {"t": Match("t", "time")} | {
        f"{k}_q": Match(f"{k}_q", f"r.{k}.position") for k in "abc"
    }
    swing, roll = np.sin(1.3 * T), 6.0 * T + 0.3 * np.sin(2.0 * T)
    for qs, scale in (((roll, roll, swing), 1.0),
                      ((60.0 * swing, 80.0 * swing, swing), DEG),
                      ((60.0 * swing, swing, swing), 1.0)):  # fmt: skip
        log = {"t": T} | dict(zip(("a_q", "b_q", "c_q"), qs, strict=True))
        assert in_units(log, joints, matches)["a_q"].scale == pytest.approx(scale)


def test_jumps_by_a_turn_and_of_a_slide_hide_no_unit():
    """A slide that was moved by 360 mm between two rows jumps by no turn."""
    log = columns(DEG, 1e-3, DEG, 1e-3)
    far = np.rad2deg(Q["a"] + 2.0)
    log["a_q"] = np.mod(far + 180.0, 360.0) - 180.0
    log["z_q"] = np.where(T < 4.0, 0.0, -360.0) + 1e3 * 0.02 * np.sin(1.7 * T)
    log["z_v"] = 1e3 * 0.034 * np.cos(1.7 * T)
    found = read(log)
    assert np.abs(np.diff(log["a_q"])).max() > 350.0
    assert found["a_q"].scale == pytest.approx(DEG) == found["a_v"].scale
    assert found["z_q"].scale == 1e-3 == found["z_v"].scale


def test_one_joint_may_contradict_the_others():
    log = columns()
    log["b_q"] = np.rad2deg(log["b_q"])
    log["a_v"] = -log["a_v"]
    found = read(log)
    assert [found[n].scale for n in ("a_q", "b_q", "b_v", "z_q")] == [1, DEG, 1, 1]
    assert found["a_v"].scale == -1.0
    kinds = {kind for kind, *_ in said_of_units(found.values())}
    assert kinds == {"units", "sign"}


def test_a_command_is_in_the_unit_in_which_its_position_follows_it():
    goal = {f"{k}_goal": np.rad2deg(np.interp(T + 0.05, T, Q[k])) for k in "ab"}
    found = read(columns() | goal)
    assert found["a_goal"].scale == found["b_goal"].scale == DEG
    found = read(columns(revolute=DEG) | goal)
    assert found["a_goal"].scale == pytest.approx(DEG)
    assert "degrees" not in found["a_goal"].told  # It is as its position is.


def test_a_unit_of_time_is_told_where_no_unit_of_velocity_is():
    found = read(columns(rate=2.5, speed=2.5))
    assert found["t"].scale == 1.0 and found["a_v"].scale == 1.0
    found = read(columns(rate=1e-4, speed=1e-4))
    assert found["t"].scale == pytest.approx(1e-4)
    assert [found[f"{k}_v"].scale for k in Q] == [1.0, 1.0, 1.0]


def test_what_a_sidecar_says_stays():
    said = {"a_q": Match("a_q", "r.a.position", 1.0, 0.5, AS_SAID)}
    found = read(columns(revolute=DEG, rate=DEG), said)
    assert found["a_q"] == said["a_q"]
    assert found["b_q"].scale == pytest.approx(DEG)

"""Limbs that do not move each other: each is searched and judged by itself."""

from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import with_effects

from makebreak.gap import workflow
from makebreak.gap.budget import Stopped
from makebreak.gap.by_part import joined, limbs_of, only, pooled
from makebreak.gap.data.findings import Finding
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.split import split
from makebreak.gap.report.comparison import shown_motion
from makebreak.gap.residuals.inverse import LOOPS
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.result import (
    Estimate,
    Evidence,
    GapMeasure,
    GapResult,
    NamedEffect,
    Series,
)
from makebreak.gap.workflow import _with_commands_of_most, run_gap
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

LIMBS = [["r.a0", "r.a1"], ["r.b0", "r.b1"]]


def robot(folder, base="fixed"):
    """Two double pendulums on one base."""
    text = '<?xml version="1.0"?><robot name="r"><link name="base"><inertial><mass '
    text += 'value="5"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    text += "</inertial></link>"
    for name, y in (("a", 0.2), ("b", -0.2)):
        parent, place = "base", f"0 {y} 0"
        for k in range(2):
            text += (
                f'<link name="{name}_{k}"><inertial><origin xyz="0.01 0 -0.2"/><mass '
                f'value="{1.0 - 0.4 * k}"/><inertia ixx="0.02" iyy="0.02" izz="0.005" '
                'ixy="0" ixz="0" iyz="0"/></inertial></link>'
                f'<joint name="{name}{k}" type="continuous"><parent link="{parent}"/>'
                f'<child link="{name}_{k}"/><origin xyz="{place}"/><axis xyz="0 1 0"/>'
                "</joint>"
            )
            parent, place = f"{name}_{k}", "0 0 -0.4"
    (folder / "r.urdf").write_text(text + "</robot>")
    weld = "- add_weld: {parent: world, child: 'r::base'}\n" if base == "fixed" else ""
    joints = ", ".join(j for limb in LIMBS for j in limb)
    (folder / "scene.yaml").write_text(
        "directives:\n- add_model: {name: r, file: r.urdf}\n"
        + weld
        + "plant: {time_step: 0.0}\n"
        f"actuation: {{type: effort, joints: [{joints}]}}\n"
    )
    return read_scene(folder / "scene.yaml")


def recorded(folder, hidden, seconds=16.0):
    """A log of all joints, with measured torques, in which `hidden` acts."""
    scene = robot(folder)
    rng = np.random.default_rng(0)
    t = np.arange(0.0, seconds, 0.005)
    joints = [j for limb in LIMBS for j in limb]
    q, v, vd = (np.zeros((len(t), 4)) for _ in range(3))
    for k in range(4):
        for w, a in ((1.1 + 0.3 * k, 0.4), (2.7 - 0.2 * k, 0.2)):
            q[:, k] += a * np.sin(w * t + k)
            v[:, k] += a * w * np.cos(w * t + k)
            vd[:, k] -= a * w**2 * np.sin(w * t + k)
    truth = SceneDynamics(with_effects(scene, *hidden))
    effort = truth.inverse_dynamics(q, v, vd, t) + 0.01 * rng.normal(size=q.shape)
    q = q + 2e-5 * rng.normal(size=q.shape)
    header = ["time", *(f"{j}.position" for j in joints),
              *(f"{j}.effort_measured" for j in joints)]  # fmt: skip
    file = folder / "recording.csv"
    np.savetxt(file, np.column_stack([t, q, effort]), "%.9g", ",",
               header=",".join(header), comments="")  # fmt: skip
    return scene, file


def test_limbs_are_what_hangs_together(tmp_path):
    scene, file = recorded(tmp_path, [], 2.0)
    recordings = read_recordings([file])
    assert limbs_of(SceneDynamics(scene), recordings) == LIMBS
    # A base that is free moves with both.
    floating = SceneDynamics(robot(tmp_path, base="free"))
    assert len(limbs_of(floating, recordings)) == 1


def test_a_limb_alone_moves_as_it_does_among_all(tmp_path):
    scene, file = recorded(tmp_path, [], 2.0)
    scene = with_effects(
        scene, ("joint_coulomb_friction", ["r.a0", "r.b1"], dict(coulomb=0.3)),
        ("joint_viscous_damping", ["r.a1"], dict(damping=0.2)),
    )  # fmt: skip
    parts = split(read_recordings([file]))
    q, v, vd = np.random.default_rng(1).normal(size=(3, 5, 4))
    whole = SceneDynamics(scene).inverse_dynamics(q, v, vd)
    for k, limb in enumerate(LIMBS):
        own, of = only(limb, scene, parts)
        mine = slice(2 * k, 2 * k + 2)
        alone = SceneDynamics(own).inverse_dynamics(q[:, mine], v[:, mine], vd[:, mine])
        np.testing.assert_allclose(alone, whole[:, mine], rtol=1e-9, atol=1e-9)
        assert own.actuation.joints == limb
        for recording in (*of.decided, *of.reported):
            assert {c.at for c in recording.channels.values()} == set(limb)


def test_numbers_of_drives_go_with_their_joints(tmp_path):
    scene = robot(tmp_path)
    act = replace(scene.actuation, type="pd", kp=[1.0, 2.0, 3.0, 4.0], kd=[0.5])
    recordings = split(read_recordings([recorded(tmp_path, [], 2.0)[1]]))
    own, _ = only(LIMBS[1], replace(scene, actuation=act), recordings)
    assert own.actuation.kp == [3.0, 4.0] and own.actuation.kd == [0.5]
    # A limb without a drive is one that nothing drives: its scene loads.
    act = replace(act, joints=LIMBS[0], kp=[1.0, 2.0])
    own, _ = only(LIMBS[1], replace(scene, actuation=act), recordings)
    assert not SceneDynamics(own).loaded.scene.actuation.joints


def test_the_gain_of_all_drives_of_a_model_is_known_where_they_are_alike(tmp_path):
    scene = robot(tmp_path)
    act = replace(scene.actuation, type="servo", kp=[20.0], kd=[1.0])
    one = SceneDynamics(replace(scene, actuation=act))
    assert one.now("servo_gain", ["r"]) == {"kp": 20.0}
    act = replace(act, kp=[1.0, 2.0, 3.0, 4.0])
    assert SceneDynamics(replace(scene, actuation=act)).now("servo_gain", ["r"]) == {}


def test_one_limb_is_named_and_the_other_agrees(tmp_path):
    hidden = [("joint_coulomb_friction", ["r.b0"], dict(coulomb=0.5)),
              ("joint_coulomb_friction", ["r.b1"], dict(coulomb=0.3))]  # fmt: skip
    recorded(tmp_path, hidden)
    result = run_gap(tmp_path / "scene.yaml", [tmp_path / "recording.csv"])
    assert result.verdict == "gap_named"
    found = {e.at: e.parameters["coulomb"].value for e in result.effects}
    assert found == pytest.approx({("r.b0",): 0.5, ("r.b1",): 0.3}, rel=0.05)
    assert result.says.startswith("r.b0 to r.b1: Joint r.b0 has Coulomb friction")
    assert "r.a0 to r.a1: scene and recordings agree" in result.says
    assert set(result.gap.per_channel) >= {"r.a0.position", "r.b1.position"}
    assert result.gap.after < 1.5


# ----- One result of several


@pytest.mark.parametrize(
    ("early", "by"),
    [((4e-4, 6e-4), 5e-4), ((0.0, 6e-4), 0.0), ((4e-4, 6e-4, 0.0, 0.0), 5e-4)],
)
def test_commands_of_one_loop_act_when_half_of_the_limbs_say(
    tmp_path, monkeypatch, early, by
):
    """In a single limb half a step may look like what its joints lack."""
    scene, file = recorded(tmp_path, [], 4.0)
    parts = split(read_recordings([file]))
    left = iter(early)
    monkeypatch.setattr(MechanismProblem, "commands_early", lambda self: next(left))
    moved = []
    monkeypatch.setattr(
        workflow, "moved_sooner", lambda some, by: (moved.append(by), [*some])[1]
    )
    limbs = (LIMBS * 2)[: len(early)]
    then, sooner, found = _with_commands_of_most(scene, parts, limbs, 1)
    assert then.tolerance.get(LOOPS, 0.0) == pytest.approx(by)
    assert len(found) == (by > 0.0) and (sooner is parts) == (by == 0.0)
    assert moved == pytest.approx([by] * 2 if by else [])


def result_of(verdict, effects=(), before=4.0, after=1.0, channel="r.a0.position", n=4):
    gap = GapMeasure(
        before, after, 1.0, 0.3, {channel: {"before": before, "after": after}},
        n_windows=n, seconds=1.0,
    )  # fmt: skip
    check = Finding("rate", "log", "time", 1.0, "s", "info", "The same of all.")
    return GapResult(verdict, f"It is {verdict}.", [], list(effects), gap, [], {},
                     [check])  # fmt: skip


def delay(at, value, std=0.001):
    return NamedEffect(
        "input_delay", at, {"delay": Estimate(value, std, "s")}, "Late.",
        Evidence(2.0, 1.0, "", 0.0),
    )  # fmt: skip


def test_limbs_that_are_done_count_where_time_is_up(tmp_path, monkeypatch):
    recorded(tmp_path, [("joint_coulomb_friction", ["r.a0"], {"coulomb": 0.2})])

    def until_the_second(calls, jobs):
        yield calls[0]()
        raise Stopped

    monkeypatch.setattr(workflow, "side_by_side", until_the_second)
    said: list[str] = []
    # In a budget of its own: what is left undone stays noted there.
    files = tmp_path / "scene.yaml", [tmp_path / "recording.csv"]
    result = run_gap(*files, budget_min=10.0, progress=said.append)
    # (Where copies of the process compare limbs, nothing else is heard meanwhile.)
    done = [text for text in said if "limbs" in text]
    assert done == [f"comparing limbs, {k} of 2 done" for k in range(2)]
    assert not any("measured efforts" in text for text in said)  # It was not asked.
    assert [(e.kind, e.at) for e in result.effects] == [
        ("joint_coulomb_friction", ("r.a0",))
    ]
    assert "nan" not in result.says and "agree" not in result.says
    assert any("r.b0" in what for what in result.unfinished)


@pytest.mark.parametrize(
    ("verdicts", "expected"),
    [(("no_gap", "no_gap"), "no_gap"), (("no_gap", "gap_named"), "gap_named"),
     (("gap_named", "gap_unnamed"), "gap_unnamed"),
     (("ambiguous", "gap_named"), "ambiguous"),
     (("no_gap", "not_judged"), "not_judged")],
)  # fmt: skip
def test_the_verdict_is_that_of_the_limb_of_which_least_is_known(verdicts, expected):
    result = joined(LIMBS, [result_of(v) for v in verdicts])
    assert result.verdict == expected
    assert len(result.checks) == 1
    if expected == "gap_unnamed":
        assert "r.b0 to r.b1: It is gap_unnamed." in result.says


def test_what_all_limbs_have_alike_is_one_effect_of_the_model():
    each = [result_of("gap_named", [delay(("r",), x)]) for x in (0.010, 0.011)]
    (effect,) = joined(LIMBS, each).effects
    assert effect.at == ("r",)
    assert effect.parameters["delay"].value == pytest.approx(0.0105)
    assert effect.parameters["delay"].std == pytest.approx(0.001 / np.sqrt(2.0))


def test_what_limbs_cannot_tell_apart_is_what_most_of_them_say():
    late = Effect("sensor_delay", ["r"], {"delay": 0.011})
    sure = replace(delay(("r",), 0.010), indistinguishable_from=(late,))
    other = replace(
        sure, kind="sensor_delay", parameters={"delay": Estimate(0.013, 0.001, "s")},
        indistinguishable_from=(Effect("input_delay", ["r"], {"delay": 0.012}),),
    )  # fmt: skip
    each = [result_of("ambiguous", [e]) for e in (other, sure, sure)]
    words = "It is seen late. These data cannot distinguish it from input_delay."
    other = replace(other, says="It is seen late.")
    each[0] = replace(each[0], effects=[other], says=words)
    limbs = [*LIMBS, ["r.c0"]]
    result = joined(limbs, each)
    (effect,) = result.effects
    assert "It is seen late" not in result.says and "Commands reach" in result.says
    assert "cannot distinguish it from sensor_delay" in result.says
    assert (effect.kind, effect.at) == ("input_delay", ("r",))
    assert effect.parameters["delay"].value == pytest.approx(0.032 / 3.0)
    even = joined(LIMBS, [result_of("ambiguous", [e]) for e in (sure, other)])
    assert [(e.kind, e.at) for e in even.effects] == [(sure.kind, ("r",))]
    untied = replace(other, indistinguishable_from=())
    each = [result_of("ambiguous", [e]) for e in (untied, sure, sure)]
    assert {e.kind for e in joined(limbs, each).effects} == {
        "sensor_delay", "input_delay"
    }  # fmt: skip


def test_what_limbs_have_otherwise_stays_at_their_joints():
    each = [result_of("gap_named", [delay(("r",), x)]) for x in (0.010, 0.030)]
    effects = joined(LIMBS, each).effects
    assert [e.at for e in effects] == [tuple(limb) for limb in LIMBS]
    assert "r.a0" in effects[0].says


@pytest.mark.parametrize("other, n", [(3.1, 1), (4.0, 2)])
def test_what_joints_of_limbs_have_alike_is_one_effect_of_all(other, n):
    each = [
        result_of("gap_named", [replace(
            delay(tuple(limb), 0.0), kind="joint_viscous_damping",
            parameters={"damping": Estimate(x, 0.1, "N m s/rad")},
        )])
        for limb, x in zip(LIMBS, (3.0, other), strict=True)
    ]  # fmt: skip
    effects = joined(LIMBS, each).effects
    assert len(effects) == n
    if n == 1:
        assert effects[0].at == ("r.a0", "r.a1", "r.b0", "r.b1")
        assert effects[0].parameters["damping"].value == pytest.approx(3.05)
        assert "3.05" in effects[0].says and "r.b1" in effects[0].says


def test_errors_are_pooled_by_windows_and_a_channel_counts_where_it_is():
    one = result_of("gap_named", before=3.0, n=1).gap
    two = result_of("gap_named", before=5.0, n=3, channel="r.b0.position").gap
    both = pooled([one, two])
    assert both.before == pytest.approx(np.sqrt((9.0 + 3 * 25.0) / 4))
    assert both.per_channel["r.a0.position"]["before"] == pytest.approx(3.0)
    assert both.per_channel["r.b0.position"]["before"] == pytest.approx(5.0)
    assert both.n_windows == 4


def test_limbs_with_windows_of_their_own_are_shown_together(tmp_path):
    scene, file = recorded(tmp_path, [], 2.0)
    recordings = read_recordings([file])

    def series(joint, n, off):
        y = recordings[0][f"{joint}.position"][:n]
        time = recordings[0].time[:n]
        return Series(f"{joint}.position", recordings[0].name, 0, time, y, y + off, y,
                      np.zeros(1), 1e-4)  # fmt: skip

    each = [
        replace(result_of("gap_named"), series=[series(j, n, off) for j in limb])
        for limb, n, off in zip(LIMBS, (40, 30), (0.1, 0.01), strict=True)
    ]
    motion = shown_motion(joined(LIMBS, each), SceneDynamics(scene).plant, recordings)
    assert motion is not None and len(motion.time) == 40
    before = motion.columns["before"]
    for limb, off in zip(LIMBS, (0.1, 0.0), strict=True):
        for joint in limb:
            y = recordings[0][f"{joint}.position"][:40]
            np.testing.assert_allclose(before[f"{joint}.position"] - y, off, atol=1e-9)

"""A scene in MuJoCo: against MuJoCo itself with the same changes in the file."""

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from makebreak.gap.does_not_fit import DoesNotFit  # noqa: E402
from makebreak.gap.simulation.commands import Commands  # noqa: E402
from makebreak.gap.simulation.mujoco_simulation import MujocoSimulation  # noqa: E402
from makebreak.models.effects.kind import Effect  # noqa: E402
from makebreak.models.mujoco_twin import MujocoTwin  # noqa: E402
from makebreak.models.scene import InitialSection, read_scene  # noqa: E402

FILE = """
<mujoco model="w"><option timestep="0.001" integrator="implicitfast"/>
<default><geom condim="4"/><general ctrlrange="-1 1" gear="5" dyntype="filter"
 dynprm="0.3"/></default><worldbody>
<geom name="floor" type="plane" size="3 3 .1" friction="{floor}"/>
<geom name="a_wall" type="box" size=".02 .5 .2" pos="{wall} 0 .2" euler="0 0 10"/>
<body name="pusher" pos="0 0 .05"><joint name="px" type="slide" axis="1 0 0"
 damping="{damping}" armature="{rotor}" frictionloss="{dry}"/>
 <geom type="sphere" size=".02" mass=".5" friction="{tip}"/></body>
<body name="box" pos=".12 .01 .04"><freejoint/>
 <geom type="box" size="{size} .05 .04" mass="{mass}" friction=".3" solref=".03 1"/>
</body><body name="arm" pos="0 -1 .3"><joint name="turn" axis="0 1 0" damping=".01"/>
 <inertial pos="{centre} 0 0" mass="{arm}" diaginertia=".002 .004 .003"/></body>
</worldbody>
<actuator><position joint="px" kp="{kp}" kv="30" forcerange="-40 40" gear="1"
 timeconst="0"/></actuator>
</mujoco>"""
PLAIN = {
    "floor": 0.4, "wall": 0.4, "damping": 8.0, "rotor": 0.1, "dry": 0.2, "tip": 0.3,
    "size": 0.06, "mass": 0.6, "kp": 600.0, "arm": 0.5, "centre": 0.2,
}  # fmt: skip
START = [0.0, 0.12, 0.01, 0.04, 1.0, 0.0, 0.0, 0.0, 0.0]


def own(**changes) -> tuple[np.ndarray, np.ndarray]:
    """(n, 9) qpos every 10 ms of 0.8 s in which the box is pushed against the wall, and
    an arm swings; and (8,) the mean rate about the start, of the steps before and after
    it."""
    model = mujoco.MjModel.from_xml_string(FILE.format(**PLAIN | changes))
    data = mujoco.MjData(model)
    data.qpos[:] = START
    data.qvel[:] = [0.1, 0.0, 0.2, 0.0, 0.1, 0.2, 1.0, 0.0]
    rows, rate = [], 0.5 * data.qvel
    for step in range(800):
        data.ctrl[:] = 0.3 * np.floor(step / 20) * 20 / 400
        mujoco.mj_step(model, data)
        rate = rate + 0.5 * data.qvel if step == 0 else rate
        if step % 10 == 9:
            rows.append(np.array(data.qpos))
    return np.array(rows), rate


def simulated(folder, rate, *effects: Effect, noted: dict | None = None) -> np.ndarray:
    """The same by a scene. rate (8,): at the start, of qvel's order. noted: the pairs
    that touch are added to it."""
    (folder / "w.xml").write_text(FILE.format(**PLAIN))
    (folder / "scene.yaml").write_text(
        "directives:\n- add_model: {name: w, file: w.xml}\n"
        "actuation: {type: servo, joints: [w.px], kp: [600], kd: [30], limit: [40]}\n"
        "effects:\n- {kind: contact_friction, at: w.box~w.floor, parameters: "
        "{friction: 0.4}}\n"
    )
    simulation = MujocoSimulation(read_scene(folder / "scene.yaml"))
    simulation.set_effects([*simulation.scene.effects, *effects])
    # In the world: the box begins level, so its own axes are the world's.
    initial = InitialSection(
        {"w.px": 0.0}, {"w.px": rate[0], "w.turn": rate[7]},
        {"w.box": [1.0, 0, 0, 0, *START[1:4]]},
        {"w.box": [*rate[4:7], *rate[1:4]]},
    )  # fmt: skip
    time = 0.02 * np.arange(40)
    commands = Commands(time, {"w.px.position_command": 0.3 * time / 0.4})
    axes = ("x", "y", "z", "qw", "qx", "qy", "qz")
    box = [f"w.box.{a}" for a in axes]
    channels = ["w.px.position", *box, "w.turn.position"]
    with simulation.noting_pairs() as pairs:
        path = simulation.run(
            initial, 0.01 * np.arange(1, 81), channels, commands, start_sec=0.0
        )
    if noted is not None:
        noted |= pairs
    return path


@pytest.mark.parametrize(
    ("changes", "effects"),
    [
        ({}, []),
        ({"mass": 0.9}, [("object_mass", "w.box", {"mass": 0.9})]),
        ({"wall": 0.37}, [("wall_position", "w.a_wall", {"x": -0.03, "y": 0, "z": 0})]),
        (
            {"damping": 28.0, "rotor": 0.4, "dry": 1.2, "kp": 900.0},
            [
                ("joint_viscous_damping", "w.px", {"damping": 20.0}),
                ("rotor_inertia", "w.px", {"inertia": 0.3}),
                ("joint_coulomb_friction", "w.px", {"coulomb": 1.0}),
                ("servo_gain", "w.px", {"kp": 900.0}),
            ],
        ),
        # The larger of two shapes' friction counts, so a tip's is the pair's.
        ({"tip": 0.8}, [("contact_friction", "w.box~w.pusher", {"friction": 0.8})]),
        ({"floor": 0.6}, [("contact_friction", "w.box~w.floor", {"friction": 0.6})]),
        # One value of two pairs.
        (
            {"floor": 0.55, "tip": 0.55},
            [
                (
                    "contact_friction",
                    "w.box~w.floor w.box~w.pusher",
                    {"friction": 0.55},
                ),
            ],
        ),
        # Of a link whose file gives moments of inertia.
        (
            {"arm": 0.8},
            [("payload", "w.arm", dict(mass=0.3, com_x=0.2, com_y=0, com_z=0))],
        ),
        ({"centre": 0.24}, [("link_com", "w.arm", {"x": 0.04, "y": 0, "z": 0})]),
    ],
)
def test_effects_are_what_the_same_change_of_the_file_is(tmp_path, changes, effects):
    each = [Effect(kind, at.split(), parameters) for kind, at, parameters in effects]
    expected, rate = own(**changes)
    if changes:
        assert np.abs(expected - own()[0]).max() > 1e-3  # It shows.
    same = slice(70)  # Later the last digit grows, between the pusher and the wall.
    np.testing.assert_allclose(
        simulated(tmp_path, rate, *each)[same], expected[same], atol=1e-7
    )


@pytest.mark.parametrize("wall", [0.4, 0.9])
def test_pairs_that_touch_are_those_of_mujoco(tmp_path, wall, monkeypatch):
    """What is fixed comes last; an arm that touches nothing is in none."""
    monkeypatch.setitem(PLAIN, "wall", wall)
    model = mujoco.MjModel.from_xml_string(FILE.format(**PLAIN))
    data = mujoco.MjData(model)
    expected, names = {}, ["floor", "a_wall", "pusher", "box"]
    for qpos in own()[0]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        expected |= {
            "~".join(
                f"w.{names[g]}" for g in sorted((c.geom1, c.geom2), reverse=True)
            ): pytest.approx(c.friction[0])
            for c in data.contact
        }
    simulated(tmp_path, own()[1], noted=(noted := {}))
    order = {"w.box~w.pusher": "w.box~w.pusher", "w.pusher~w.box": "w.box~w.pusher"}
    assert {order.get(at, at): mu for at, mu in noted.items()} == expected
    assert ("w.box~w.a_wall" in noted) == (wall == 0.4)


def test_what_mujoco_has_no_place_for_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no place for contact_stiffness"):
        effect = Effect("contact_stiffness", ["w.box~w.floor"], {"stiffness": 1e4})
        simulated(tmp_path, np.zeros(8), effect)
    (tmp_path / "other.yaml").write_text(
        "directives:\n- add_model: {name: ball, file: package://makebreak/models/"
        "ball.sdf}\n"
    )
    with pytest.raises(DoesNotFit, match="one MJCF file"):
        MujocoSimulation(read_scene(tmp_path / "other.yaml"))


@pytest.mark.parametrize("more", ["", '<exclude body1="trunk" body2="hat"/>'])
def test_a_pair_is_only_of_what_mujoco_lets_touch(tmp_path, more):
    """It does not of a link with the one that carries it, nor of what is excluded."""
    (tmp_path / "w.xml").write_text(
        '<mujoco model="w"><worldbody><geom name="floor" type="plane" size="3 3 .1"/>'
        '<body name="trunk" pos="0 0 .2"><freejoint/><geom size=".1"/><body name="leg">'
        '<joint name="j"/><geom size=".12"/></body></body><body name="hat" '
        'pos="0 0 .4"><freejoint/><geom size=".1"/></body></worldbody>'
        f"<contact>{more}</contact></mujoco>"
    )
    pairs = ["w.trunk~w.leg", "w.trunk~w.hat", "w.trunk~w.floor"]
    effects = "".join(
        f"- {{kind: contact_friction, at: {at}, parameters: {{friction: 0.5}}}}\n"
        for at in pairs
    )
    (tmp_path / "scene.yaml").write_text(
        f"directives:\n- add_model: {{name: w, file: w.xml}}\neffects:\n{effects}"
    )
    scene = read_scene(tmp_path / "scene.yaml")
    made = MujocoTwin(scene).with_effects(scene.effects).model
    assert made.npair == (1 if more else 2)


ARM = """<mujoco model="a"><option timestep="0.01" integrator="{integrator}"/>
<worldbody><body name="upper">
<joint name="j1" axis="0 1 0" damping=".3"/>
<inertial pos="0.1 0 -.2" mass="1" diaginertia=".01 .01 .002"/>{fore}</body>
</worldbody><actuator><motor joint="j1"/></actuator></mujoco>"""
FORE = """<body name="fore" pos="0 0 -.3" {turned}>{joint}
<inertial pos="0 .1 -.12" mass=".8" diaginertia=".006 .005 .002"/></body>"""


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_a_log_of_mujocos_steps_is_what_its_windows_show(tmp_path, integrator):
    """A joint is held where the scene has it fixed."""
    joint = '<joint name="j2" axis="1 0 0" damping=".1"/>'
    held = ARM.format(
        fore=FORE.format(turned='euler="30 0 0"', joint=""), integrator=integrator
    )
    free = ARM.format(fore=FORE.format(turned="", joint=joint), integrator=integrator)
    (tmp_path / "a.xml").write_text(free)
    (tmp_path / "scene.yaml").write_text(
        "directives:\n- add_model: {name: a, file: a.xml}\n"
        "fixed_joints: {a.j2: 0.5235987755982988}\n"
        "actuation: {type: effort, joints: [a.j1]}\n"
    )
    model = mujoco.MjModel.from_xml_string(held)
    data = mujoco.MjData(model)
    rows = []
    time = 0.01 * np.arange(120)
    u = 9.0 * np.sin(6.0 * time)
    for now in u:
        rows.append([data.qpos[0], data.qvel[0]])
        data.ctrl[:] = now
        mujoco.mj_step(model, data)
    (q, v), k = np.array(rows).T, 7
    mean = v[k] if integrator == "RK4" else 0.5 * (v[k] + v[k + 1])
    # Between steps positions go in lines, at the velocity that the step ends with.
    stamps = np.sort(np.r_[time[k:], time[k:-1] + 0.0025])
    path = MujocoSimulation(read_scene(tmp_path / "scene.yaml")).run(
        InitialSection({"a.j1": q[k]}, {"a.j1": mean}), stamps,
        ["a.j1.position", "a.j1.velocity"], Commands(time, {"a.j1.effort_command": u}),
    )  # fmt: skip
    np.testing.assert_allclose(path[::2], np.array(rows)[k:], atol=1e-6)
    if integrator != "RK4":
        np.testing.assert_allclose(path[1::2, 1], v[k + 1 :], atol=1e-6)
        rate = np.diff(path[:, 0])[::2] / 0.0025
        np.testing.assert_allclose(rate, v[k + 1 :], atol=1e-4)

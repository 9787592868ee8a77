"""Objects in a model's own file (MJCF here): their poses, and lists of coordinates."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from makebreak.gap.data.coordinates import by_lists
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.robot import Log, propose_scene, read_robot
from makebreak.gap.data.table import RecordingTable
from makebreak.gap.residuals import in_mujoco
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.simulation.windows import Window
from makebreak.gap.thresholds import AGREEMENT_RMS_MAX
from makebreak.gap.workflow import run_gap
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

mujoco = pytest.importorskip("mujoco", reason="MuJoCo has no wheels for Python 3.10")

N = 300
T = 0.01 * np.arange(N)
FLOOR = '<geom name="floor" type="plane" size="3 3 .1" friction="1 .005 .0001"/>'


def mjcf(bodies: str, more: str = "", option: str = "") -> str:
    return (
        '<mujoco model="w"><option timestep=".001" integrator="implicitfast" '
        f"{option}/><worldbody>{FLOOR}{bodies}</worldbody>{more}</mujoco>"
    )


def box(name: str, place: str, mass: float = 0.6) -> str:
    return (
        f'<body name="{name}" pos="{place}"><freejoint/><geom type="box" '
        f'size=".06 .05 .04" mass="{mass}" friction=".4 .005 .0001"/></body>'
    )


def slide(name: str, axis: str, inner: str = "") -> str:
    return (
        f'<body name="{name}_link"><joint name="{name}" type="slide" axis="{axis}" '
        'damping="8"/><geom type="sphere" size=".02" mass=".5" contype="0" '
        f'conaffinity="0"/>{inner}</body>'
    )


FINGER = (
    '<body name="pusher" pos="0 0 .05"><joint name="px" type="slide" axis="1 0 0" '
    'damping="8"/><joint name="py" type="slide" axis="0 1 0" damping="8"/>'
    '<geom type="sphere" size=".02" mass=".5" friction=".4 .005 .0001"/></body>'
)
SERVOS = (
    '<actuator><position joint="py" kp="600" kv="30"/>'
    '<position joint="px" kp="600" kv="30"/></actuator>'
)


def proposed(folder, text: str, columns):
    """A scene's text, {column: channel, with its scale}, and what is said."""
    (folder / "w.xml").write_text(text)
    table = {k: np.asarray(y, float) for k, y in columns.items()}
    log = Log(folder / "log.csv", RecordingTable(table, np.arange(N) + 1, N))
    found = propose_scene(read_robot(folder / "w.xml"), [log])
    own = yaml.safe_load(found.sidecars[log.path])["columns"]
    return found.scene, own, found


def swing(k: int) -> np.ndarray:
    return 0.1 * np.sin((1.0 + 0.3 * k) * T)


def pose(k: int) -> np.ndarray:
    """(N, 7): x y z, w x y z."""
    place = np.stack([swing(k), 0.1 + swing(k + 1), 0.04 + 0 * T], axis=1)
    turn = Rotation.from_euler("xyz", np.stack([0 * T, 0 * T, 3 * swing(k)], axis=1))
    return np.hstack([place, turn.as_quat(scalar_first=True)])


def listed(stem: str, y: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{stem}[{k}]": y[:, k] for k in range(y.shape[1])}


PARTS = ["x", "y", "z", "qw", "qx", "qy", "qz"]


@pytest.mark.parametrize("tail", ["qpos", "state"])
def test_lists_of_all_coordinates_are_the_models_own(tmp_path, tail):
    """A box before the joints, as the file has them; a state has velocities, too."""
    q = np.hstack([pose(0), swing(3)[:, None], swing(4)[:, None]])
    v = np.gradient(q[:, 1:], 0.01, axis=0)
    columns = {"time": T} | listed(tail, q if tail == "qpos" else np.hstack([q, v]))
    if tail == "qpos":
        columns |= listed("qvel", v)
    scene, own, found = proposed(
        tmp_path, mjcf(box("crate", "0 .1 .04") + FINGER, SERVOS), columns
    )
    for k, part in enumerate(PARTS):
        assert own[f"{tail}[{k}]"] == f"w.crate.{part}"
    assert [own[f"{tail}[{k}]"] for k in (7, 8)] == ["w.px.position", "w.py.position"]
    last = "qvel[6]" if tail == "qpos" else f"{tail}[15]"
    assert own[last] == "w.px.velocity"
    first = "qvel[0]" if tail == "qpos" else f"{tail}[9]"
    assert own[first] is None  # Of what is free: in whose axes is not said.
    assert "add_weld" not in scene  # Nothing holds it.
    assert "crate moves freely: its pose is in the log" in found.notes


def test_seven_numbers_of_a_body_are_known_in_any_order():
    p = pose(1)
    order, roll = [("box", 7), ("j", 1)], np.roll
    for columns, expected in (
        (p, ["x", "y", "z", "qw", "qx", "qy", "qz"]),  # MuJoCo
        (np.hstack([p[:, :3], roll(p[:, 3:], -1, 1)]),
         ["x", "y", "z", "qx", "qy", "qz", "qw"]),  # pinocchio
        (roll(p, 4, 1), ["qw", "qx", "qy", "qz", "x", "y", "z"]),  # Drake
    ):  # fmt: skip
        q = np.hstack([columns, swing(0)[:, None]])
        found = by_lists(listed("q", q), "m", order, ())
        told = [found[f"q[{k}]"].channel for k in range(8)]
        assert told == [*(f"m.box.{part}" for part in expected), "m.j.position"]
    # Seven numbers that are no pose, and a list that is shorter.
    assert not by_lists(listed("q", np.tile(T[:, None], 8)), "m", order, ())
    assert not by_lists(listed("q", p), "m", order, ())


def test_ctrl_counts_actuators_and_not_joints(tmp_path):
    """The first joint has none, and the file has them in another order."""
    passive = slide("rail", "0 1 0")
    columns = {"time": T, "qpos[0]": swing(0), "qpos[1]": swing(1), "qpos[2]": swing(2)}
    columns |= {"ctrl[0]": swing(2), "ctrl[1]": swing(1)}
    _, own, _ = proposed(tmp_path, mjcf(passive + FINGER, SERVOS), columns)
    assert own["ctrl[0]"] == "w.py.position_command"
    assert own["ctrl[1]"] == "w.px.position_command"


@pytest.mark.parametrize(("far", "drives"), [(0.3, True), (6.0, False)])
def test_a_command_that_holds_its_joint_is_a_command(tmp_path, far, drives):
    """A joint stays as near to a command that is 0 throughout as others to theirs; one
    that goes far from it is not driven by it."""
    late = np.interp(T - 0.5, T, swing(1))
    columns = {"time": T, "qpos[0]": late, "qpos[1]": far * swing(2)}
    columns |= {"ctrl[0]": 0 * T, "ctrl[1]": swing(1)}
    _, own, _ = proposed(tmp_path, mjcf(FINGER, SERVOS), columns)
    assert own["ctrl[1]"] == "w.px.position_command"
    held = own["ctrl[0]"]
    assert (held == "w.py.position_command") == drives, held


@pytest.mark.parametrize(
    ("names", "scale"),
    [
        ([f"crate_{p}" for p in PARTS], 1.0),
        ([*(f"crate.pos.{a} [mm]" for a in "xyz"),
          *(f"crate.rot.{a}" for a in "wxyz")], 1e-3),
        ([f"object_pose[{k}]" for k in range(3)]
         + [f"object_quat[{k}]" for k in range(4)], 1.0),
        (["x", "y", "z", "qw", "qx", "qy", "qz"], 1.0),
    ],
)  # fmt: skip
def test_an_objects_pose_is_known_by_names(tmp_path, names, scale):
    p = pose(2)
    p[:, :3] /= scale
    columns = {"time": T} | dict(zip(names, p.T, strict=True))
    scene, own, _ = proposed(tmp_path, mjcf(box("crate", "0 0 .04")), columns)
    for name, part in zip(names, PARTS, strict=True):
        channel = f"w.crate.{part}"
        mapped = own.get(name, name)
        if part in "xyz" and scale != 1.0:
            assert mapped == {"channel": channel, "scale": scale}
        else:
            assert mapped == channel
    assert "actuation: {type: none}" in scene
    # The ground has a name, so that an effect can be at it.
    (tmp_path / "scene.yaml").write_text(scene)
    dynamics = SceneDynamics(read_scene(tmp_path / "scene.yaml"))
    assert dynamics.places("contact_friction") == ["w.crate~w.floor"]
    assert dynamics.places("plane_height") == ["w.floor"]


def test_two_objects_have_their_own_columns_and_angles_are_a_pose(tmp_path):
    """The second one's turn is given in degrees; the first one's pose is not there."""
    bodies = box("box", "0 0 .04") + box("box_red", ".5 0 .04")
    place = dict(zip((f"box_red_{a}" for a in "xyz"), pose(0).T, strict=False))
    turn = {f"box_red_{a} [deg]": np.rad2deg(swing(k))
            for k, a in enumerate(("roll", "pitch", "yaw"))}  # fmt: skip
    scene, own, found = proposed(tmp_path, mjcf(bodies), {"time": T} | place | turn)
    assert own["box_red_x"] == "w.box_red.x"
    degree = {"channel": "w.box_red.yaw", "scale": pytest.approx(np.pi / 180)}
    assert own["box_red_yaw [deg]"] == degree
    # What has no pose stands where the file has it.
    (weld,) = [line for line in scene.splitlines() if "add_weld" in line]
    assert "child: w::box," in weld and "0.04]" in weld
    assert any(note.startswith("box is welded") for note in found.notes)
    table = np.column_stack([T, *place.values(), *turn.values()])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", comments="",
               header=",".join(["time", *place, *turn]))  # fmt: skip
    (tmp_path / "log.yaml").write_text(json.dumps({"columns": own}))
    (read,) = read_recordings([tmp_path / "log.csv"])
    q = read.stack("w.box_red", ("qw", "qx", "qy", "qz"))
    true = Rotation.from_euler("xyz", np.stack([swing(k) for k in range(3)], axis=1))
    off = true.inv() * Rotation.from_quat(q, scalar_first=True)
    assert off.magnitude().max() < 1e-6 and "w.box_red.yaw" not in read


def test_what_does_not_hang_together_may_touch(tmp_path):
    """A finger in a crate's side, and its foot in the ground: no filter takes that."""
    q = np.tile([0.05, 0.0], (N, 1)) + 0.02 * np.stack([swing(0), swing(1)], axis=1)
    columns = {"time": T} | listed("qpos", np.hstack([q, np.tile(
        [0.12, 0.0, 0.038, 1.0, 0.0, 0.0, 0.0], (N, 1))]))  # fmt: skip
    text = mjcf(FINGER + box("crate", ".12 0 .04"), SERVOS)
    scene, _, found = proposed(tmp_path, text, columns)
    assert "collision_filter" not in scene
    assert not any(each.kind == "parts_overlap" for each in found.said)
    (tmp_path / "scene.yaml").write_text(scene)
    plant = SceneDynamics(read_scene(tmp_path / "scene.yaml")).plant
    assert plant.num_positions() == 9


def pushed(folder, mass: float, cone: str):
    """A finger pushes a box of 0.9 kg, which the model takes for `mass`."""
    text = mjcf(FINGER + box("box", ".12 0 .04", 0.9), SERVOS, f'cone="{cone}"')
    text = text.replace('friction="1 ', 'friction=".4 ')
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    places = [(0, 0), (.15, 0), (.02, 0), (.05, .12), (.2, .12), (.2, .02),
              (.2, .2), (.05, .2), (.1, 0), (.3, .02), (.1, .02), (.1, .1),
              (.35, .1)]  # fmt: skip
    rows = []
    for step in range(16000):
        k, at = divmod(0.01 * (step // 10), 1.3)
        a, b = (np.array(places[min(int(k) + n, len(places) - 1)]) for n in (0, 1))
        u = min(at / 0.9, 1.0)
        data.ctrl[::-1] = a + (b - a) * (10 * u**3 - 15 * u**4 + 6 * u**5)
        mujoco.mj_step(model, data)
        if step % 5 == 0:
            given = data.ctrl, data.actuator_force
            rows.append([data.time, *data.qpos, *data.qvel[:2], *np.hstack(given)])
    table = np.array(rows)
    table[:, 1:10] += 1e-4 * np.random.default_rng(1).normal(size=(len(table), 9))
    names = [
        "time",
        *(f"qpos[{k}]" for k in range(9)),
        "v_px",
        "v_py",
        *(f"{x}[{k}]" for x in ("ctrl", "actuator_force") for k in "01"),
    ]
    columns = dict(zip(names, table.T, strict=True))
    np.savez(folder / "log.npz", **columns)
    (folder / "w.xml").write_text(text.replace('mass="0.9"', f'mass="{mass}"'))
    read = RecordingTable(columns, np.arange(len(table)) + 1, len(table))
    log = Log(folder / "log.npz", read)
    found = propose_scene(read_robot(folder / "w.xml"), [log])
    (folder / "scene.yaml").write_text(found.scene)
    (folder / "log.yaml").write_text(found.sidecars[folder / "log.npz"])
    # Efforts hold what the box pushes back with: they are not the motion's alone.
    assert not found.said
    return read_scene(folder / "scene.yaml"), read_recordings([folder / "log.npz"])


def test_contacts_that_creep_are_no_other_mass(tmp_path):
    """MuJoCo's friction is soft: what is held slips by centimetres a second. Taken for
    sliding, it tells of other masses; taken for what may hold, of the true one."""
    scene, recordings = pushed(tmp_path, 0.6, "elliptic")
    left = {}
    for slides in (0.01, 0.1):
        problem = ContactProblem(scene, recordings, slides=slides)
        true = [Effect("object_mass", ["w.box"], {"mass": 0.9})]
        left[slides] = [
            float(np.sqrt(np.mean(problem.residual(each) ** 2))) for each in ((), true)
        ]

    assert left[0.1][1] < AGREEMENT_RMS_MAX < left[0.01][1]
    assert left[0.1][1] < 0.7 * left[0.1][0]


def test_friction_of_a_pair_is_mujocos(tmp_path):
    """The larger of the two shapes', where Drake would have 2 a b / (a + b)."""
    text = mjcf(FINGER + box("crate", ".12 0 .04"), SERVOS).replace(
        'friction=".4 .005 .0001"/></body></w', 'friction=".3 .005 .0001"/></body></w'
    )
    q = np.hstack([swing(0)[:, None], swing(1)[:, None], pose(2)])
    columns = {"time": T} | listed("qpos", q)
    scene, _, _ = proposed(tmp_path, text, columns)
    (tmp_path / "scene.yaml").write_text(scene)
    dynamics = SceneDynamics(read_scene(tmp_path / "scene.yaml"))
    for pair, friction in (("w.floor", 1.0), ("w.pusher", 0.4)):
        now = dynamics.now("contact_friction", [f"w.crate~{pair}"])
        assert now["friction"] == pytest.approx(friction)


@pytest.mark.parametrize(("row", "times"), [(120, 1.0), (220, 25.0)])
def test_a_start_beside_an_impact_is_less_sure_than_smoothing_says(row, times):
    """Of an episode that begins at row 100: what was measured there is a deviation off
    the smoothed motion, and five from the 110th row after its first on."""
    first, noise = 100, 1e-3
    off = np.where(np.arange(250) < first + 110, noise, 5.0 * noise)
    path = {"a.box.x": np.zeros((150, 3))}

    class Log(dict):
        channels = {"a.box.x": SimpleNamespace(noise=noise)}

        def episode_at(self, row):
            return SimpleNamespace(first=first, rows=slice(first, 250))

    problem = SimpleNamespace(
        recordings=[Log({"a.box.x": off})], _paths={(0, 100): path}
    )
    w = Window(
        0, 0, 1.0, slice(row, row + 20), {}, np.ones((20, 1)), True,
        {"a.box.x": np.eye(2)},
    )  # fmt: skip
    wider = in_mujoco.MujocoProblem._as_smoothed(problem, w)  # type: ignore[arg-type]
    np.testing.assert_allclose(wider.spread["a.box.x"], times * np.eye(2))


@pytest.mark.parametrize(("off", "begins_again"), [(1, True), (2, False)])
def test_a_window_that_takes_the_other_branch_begins_again(off, begins_again):
    """A foot catches where the start is above 0, as measured; smoothing says -0.3 +- 1.
    Where most windows are off, it is the model."""

    class Problem(SimpleNamespace):
        def simulate(self, effects):
            return [np.full((5, 1), np.sign(w.state["a.x"][0])) for w in self.windows]

        def errors_over(self, simulated, std):
            return [(1.0 - y) / s for y, s in zip(simulated, std, strict=True)]

        def base(self):
            return np.concatenate(self.errors_over(self.simulate(()), 3 * [self.noise]))

        def _by_windows(self, left):
            return np.mean(left.reshape(3, -1) ** 2, axis=1)

    starts = [-0.3] * off + [0.3] * (3 - off)
    windows = [
        Window(
            0, 0, 0.0, slice(0, 5), {"a.x": np.array([x, 0.0, 0.0])}, np.ones((5, 1)),
            True, {"a.x": np.eye(2)},
        ) for x in starts
    ]  # fmt: skip
    weighed = []
    problem = Problem(
        windows=windows, noise=np.array([0.1]), _weigh=lambda e: weighed.append(1)
    )
    in_mujoco.MujocoProblem._start_again(problem)  # type: ignore[arg-type]
    assert (np.abs(problem.base()).max() == 0.0) == begins_again == bool(weighed)
    assert len(problem.windows) == 3


@pytest.mark.slow
def test_starts_at_random_have_the_covariance_of_all_axes(tmp_path, monkeypatch):
    """With fewer simulations: two for each of them, or for each axis."""
    scene, recordings = pushed(tmp_path, 0.9, "elliptic")
    monkeypatch.setattr(in_mujoco.MujocoProblem, "_start_again", lambda problem: None)
    made = []
    for most in (100, 12):
        monkeypatch.setattr(in_mujoco, "MOST_MOVES", most)
        made.append(in_mujoco.MujocoProblem(scene, recordings, 0.0))
    every, some = made
    axes = 2 * len(every.windows[0].state)
    assert axes > 12 and every.runs - some.runs == 2 * (axes - 12)
    wide = [
        np.concatenate([(w.std / p.noise) ** 2 - 1.0 for w in p.windows]) for p in made
    ]
    start = np.median(wide[1][wide[0] > 1.0] / wide[0][wide[0] > 1.0])
    assert 0.6 < start < 1.6


@pytest.mark.slow
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_a_right_model_with_contacts_of_mujoco_has_no_gap(tmp_path, cone):
    """And it is said. Friction holds softly there, and has the shape of a pyramid."""
    pushed(tmp_path, 0.9, cone)
    result = run_gap(tmp_path / "scene.yaml", [tmp_path / "log.npz"])
    assert result.verdict == "no_gap", result.says
    assert "mujoco_contacts" in {check.kind for check in result.checks}


def test_what_hangs_nobody_knows_where_touches_nothing(tmp_path):
    """A leg on a base without a pose in the log, which the file has near the ground."""
    leg = (
        '<body name="trunk" pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .02" '
        'mass="3"/><body name="foot"><joint name="lift" type="slide" axis="0 0 1"/>'
        '<geom type="sphere" size=".02" mass=".5" pos="0 0 -.1"/></body></body>'
    )
    columns = {"time": T, "lift_pos": swing(0), "lift_torque": 3.0 * swing(1)}
    scene, _, found = proposed(tmp_path, mjcf(leg), columns)
    assert "ignored_collision_filter_groups: [overlap_0]" in scene
    assert any(each.kind == "parts_overlap" for each in found.said)
    pose_of_trunk = {f"trunk_{part}": y for part, y in zip(
        PARTS, np.tile([0, 0, 0.1, 1, 0, 0, 0], (N, 1)).T, strict=True)}  # fmt: skip
    scene, _, _ = proposed(tmp_path, mjcf(leg), columns | pose_of_trunk)
    assert "overlap" not in scene


@pytest.mark.parametrize("radius", [0.03, 0.034])
def test_a_ball_of_another_size_is_named_by_windows_of_mujoco(tmp_path, radius):
    """And of the right size nothing. It is thrown against a wall and rolls back;
    contacts give way by 0.3 mm."""
    text = (
        '<mujoco model="w"><worldbody><geom name="floor" type="plane" size="3 3 .1"/>'
        '<geom name="back" type="box" size=".02 1 .3" pos=".8 0 .3"/>'
        '<body name="ball" pos="0 0 .4"><freejoint/><geom type="sphere" size="{}" '
        'mass=".06" condim="4"/></body></worldbody></mujoco>'
    )
    model = mujoco.MjModel.from_xml_string(text.format(radius))
    data = mujoco.MjData(model)
    data.qpos[:3], data.qvel[:3] = [-0.5, 0.0, 0.5], [1.2, 0.1, 0.0]
    rows = []
    for step in range(2000):
        mujoco.mj_step(model, data)
        if step % 2 == 0:
            rows.append([data.time, *data.qpos])
    table = np.array(rows)
    table[:, 1:] += 4e-4 * np.random.default_rng(3).normal(size=(len(table), 7))
    np.savez(tmp_path / "log.npz", time=table[:, 0], qpos=table[:, 1:])
    (tmp_path / "w.xml").write_text(text.format(0.03))
    read = RecordingTable(
        {"time": table[:, 0]} | {f"qpos[{k}]": table[:, 1 + k] for k in range(7)},
        np.arange(len(table)) + 1,
        len(table),
    )
    log = Log(tmp_path / "log.npz", read)
    found = propose_scene(read_robot(tmp_path / "w.xml"), [log])
    (tmp_path / "scene.yaml").write_text(found.scene)
    (tmp_path / "log.yaml").write_text(found.sidecars[tmp_path / "log.npz"])
    result = run_gap(tmp_path / "scene.yaml", [tmp_path / "log.npz"])
    assert "mujoco_contacts" in {check.kind for check in result.checks}
    if radius == 0.03:
        assert result.verdict == "no_gap", result.says
        return
    assert result.verdict == "gap_named", result.says
    (named,) = result.effects
    assert (named.kind, list(named.at)) == ("object_size", ["w.ball"])
    assert named.parameters["radius"].value == pytest.approx(0.034, abs=1e-4)


@pytest.mark.slow
def test_what_a_legged_robot_carries_is_named_by_windows_of_mujoco(tmp_path):
    """It stands on three legs that slide, of which one is held: a command that stays
    the same is a command."""
    legs = "".join(
        f'<body name="leg{k}" pos="{x} {y} 0"><joint name="leg{k}" type="slide" '
        'axis="0 0 1" damping="20" armature=".2"/><geom type="capsule" size=".02" '
        'fromto="0 0 0 0 0 -.3" mass=".3" friction="1"/></body>'
        for k, (x, y) in enumerate([(0.35, 0.3), (0.35, -0.3), (-0.4, 0.0)])
    )
    drives = "".join(f'<position joint="leg{k}" kp="3000"/>' for k in range(3))
    text = (
        '<mujoco model="w"><worldbody><geom name="floor" type="plane" size="3 3 .1"/>'
        '<body name="trunk" pos="0 0 .32"><freejoint/><inertial pos="0 0 0" mass="3" '
        f'diaginertia=".02 .04 .05"/>{{}}{legs}</body></worldbody><actuator>{drives}'
        "</actuator></mujoco>"
    )
    load = '<body pos=".08 0 .06"><geom size=".03" mass=".8" contype="0"/></body>'
    model = mujoco.MjModel.from_xml_string(text.format(load))
    data = mujoco.MjData(model)
    rows = []
    for step in range(2500):
        t = np.floor((data.time + 1e-9) * 125) / 125
        on = min(t, 1.0)
        data.ctrl[:] = on * np.array([0.03 * np.sin(5 * t), 0.02 * np.sin(4 * t), 0])
        if step % 2 == 0 and step >= 500:
            rows.append([data.time, *data.qpos, *data.ctrl])
        mujoco.mj_step(model, data)
    table = np.array(rows)
    table[:, 1:11] += 1e-4 * np.random.default_rng(4).normal(size=(len(table), 10))
    np.savez(
        tmp_path / "log.npz", time=table[:, 0], qpos=table[:, 1:11], ctrl=table[:, 11:]
    )
    (tmp_path / "w.xml").write_text(text.format(""))
    robot, log = tmp_path / "w.xml", tmp_path / "log.npz"
    names = [f"qpos[{k}]" for k in range(10)] + [f"ctrl[{k}]" for k in range(3)]
    columns = dict(zip(["time", *names], table.T, strict=True))
    read = RecordingTable(columns, np.arange(len(table)) + 1, len(table))
    found = propose_scene(read_robot(robot), [Log(log, read)])
    (tmp_path / "scene.yaml").write_text(found.scene)
    (tmp_path / "log.yaml").write_text(found.sidecars[log])
    assert "w.leg2" in found.scene
    result = run_gap(tmp_path / "scene.yaml", [log])
    assert result.verdict == "gap_named", result.says
    (named,) = result.effects
    assert (named.kind, list(named.at)) == ("payload", ["w.trunk"])
    for name, value in (("mass", 0.8), ("com_x", 0.08), ("com_z", 0.06)):
        of = named.parameters[name]
        assert of.value == pytest.approx(value, abs=max(3.0 * of.std, 0.01))

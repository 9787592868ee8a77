"""Each Python block of the documents runs: whole programs in the tests of their pages,
parts of a program here, beside what stands around them."""

import re
from pathlib import Path

import numpy as np
import pytest
from effect_scenes import double, pendulum
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Integrator

import makebreak as mb
from makebreak.diagrams.station import make_control_plant
from makebreak.gap.data.table import write_recording
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.signature import Motion
from makebreak.models.scene import InitialSection, load_scene
from makebreak.models.scene_file import write_scene
from makebreak.scripts.runner.session import Session

DOCS = Path(__file__).resolve().parent.parent / "docs"
# Programs, and the tests that run them.
WHOLE = {
    "c3.md": "test_readme.py",
    "lcs.md": "test_readme.py",
    "library.md": "test_readme.py",
    "own_diagram.md": "test_gentle_rolling.py",
    "gap.md": "test_gap_command.py",
}
PARTS = {
    "command_line.md": 1, "effects.md": 3, "impedance.md": 1, "install.md": 1,
    "parameter_learning.md": 1, "recordings.md": 1, "scenes.md": 1, "station.md": 1,
}  # fmt: skip


def blocks(page):
    return re.findall(r"^```python\n(.*?)^```", (DOCS / page).read_text(), re.S | re.M)


def ran(page, number, **names):
    """What is there after a block ran where these names are known. It is about a joint
    of the Panda; here that is one of a pendulum."""
    code = blocks(page)[number].replace("panda.panda_joint1", "p.j1")
    code = code.replace('"panda"', '"p"').replace(", ...", "")
    exec(compile(code, page, "exec"), names)
    return names


def test_every_block_is_run():
    found = {str(p.relative_to(DOCS)): len(blocks(p)) for p in DOCS.rglob("*.md")}
    assert {page: n for page, n in found.items() if n} == PARTS | dict.fromkeys(
        WHOLE, 1
    )
    for page, test in WHOLE.items():
        assert page in (Path(__file__).parent / test).read_text()
    assert blocks("install.md") == blocks("gap.md")


def test_an_experiments_run_is_scored(tmp_path):
    builder = DiagramBuilder()
    rate = builder.AddSystem(ConstantVectorSource([1e-3]))
    x = builder.AddSystem(Integrator(1))
    builder.Connect(rate.get_output_port(), x.get_input_port())
    builder.ExportOutput(x.get_output_port(), "x")
    text = blocks("command_line.md")[0]
    names = {"session": Session(tmp_path, progress=False), "diagram": builder.Build()}
    exec("def run(diagram, session):\n    " + text.replace("\n", "\n    "), names)
    result = names["run"](names["diagram"], names["session"])
    # It ends after 5 s, when x is 5 mm.
    assert result["success"] and result["error_max_m"] == pytest.approx(5e-3, abs=1e-4)


def test_effects_are_between_the_ports_of_a_scene(tmp_path):
    builder = DiagramBuilder()
    measured = builder.AddSystem(ConstantVectorSource([0.3]))
    known = {"load_scene": load_scene, "scene": pendulum(tmp_path), "builder": builder}
    ran("effects.md", 0, **known, port=measured.get_output_port())
    assert builder.Build().HasInputPort("panda.torque_commanded")


def test_windows_of_a_recording_are_simulated(tmp_path):
    time = np.arange(50) * 0.01
    effect = Effect("joint_viscous_damping", ["p.j1"], {"damping": 0.5})
    names = ran(
        "effects.md", 1, SceneSimulation=SceneSimulation, Commands=Commands, time=time,
        scene=pendulum(tmp_path), u1=np.ones(50), initial=InitialSection(), times=time,
        channels=["p.j1.position"], effects=[effect],
    )  # fmt: skip
    assert names["rows"].shape == (50, 1) and names["rows"][-1] > 0.0


def test_a_residual_is_the_sum_of_columns_and_coefficients(tmp_path):
    n = 20
    q, v, vd, effort = np.random.default_rng(0).normal(size=(4, n, 2))
    kinds = ["joint_viscous_damping", "joint_coulomb_friction"]
    names = ran(
        "effects.md", 2, SceneDynamics=SceneDynamics, scene=double(tmp_path), q=q, v=v,
        Motion=Motion, time=np.arange(n) * 0.01, vd=vd, effort=effort,
        KINDS={kind: KINDS[kind] for kind in kinds}, coefficients=np.array([0.7]),
    )  # fmt: skip
    assert names["r"].shape == (n, 2) and names["s"].columns.shape[:2] == (n, 2)


def test_an_own_arm_gets_an_impedance():
    names = ran(
        "impedance.md", 0, **{n: getattr(mb, n) for n in mb.__all__},
        builder=DiagramBuilder(), control_plant=make_control_plant(),
    )  # fmt: skip
    assert names["arm"].HasOutputPort("tau")


def test_what_may_be_wrong_in_a_model_is_named():
    named = ran("parameter_learning.md", 0)["parameters"]
    assert [each.kind for each in named] == ["mass", "damping", "friction", "gap"]


def test_recordings_are_read_and_checked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    time = np.arange(300) * 0.01
    for k in (1, 2):
        q = np.sin(k * time) + 1e-3 * np.random.default_rng(k).normal(size=300)
        columns = {"arm.j1.position": q, "arm.j1.effort_command": np.cos(time)}
        write_recording(Path(f"run{k}.csv"), {"time": time} | columns)
    names = ran("recordings.md", 0)
    assert len(names["t"]) == len(names["q"]) == len(names["u"]) == 300
    assert capsys.readouterr().out


def test_a_scene_is_read_and_loaded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scene(pendulum(tmp_path), tmp_path / "scene.yaml")
    names = ran("scenes.md", 0, builder=DiagramBuilder())
    assert names["loaded"].plant.num_positions() == 1


def test_stations_are_made():
    assert ran("station.md", 0)["station"].num_input_ports() > 0


# A user's page says what holds now; which runs showed it, on which seeds and with which
# code, is the lab book's. Commands that a page shows have seeds, of course.
OF_THE_LAB = (
    r"seeds? (?:\d|S\b)|(?:unseen|fresh) (?:seed|run)|\b(?:tuned|developed) on\b"
    r"|\bcommit [0-9a-f]{7}|(?:older|earlier) (?:version|code)|\| seed \|"
)
USER_PAGES = [
    DOCS.parent / "README.md",
    *(p for p in DOCS.glob("*.md") if p.name not in ("changelog.md",)),
    *(DOCS / "tutorials").glob("*.py"),
]


def of_the_lab(text):
    """What a page says in words, in front of a reader, that is for the lab book."""
    text = re.sub(
        r"^```[\s\S]*?^```|^    .*$|`[^`\n]*`|\]\([^)]*\)", "", text, flags=re.M
    )
    return re.findall(OF_THE_LAB, text, re.IGNORECASE)


@pytest.mark.parametrize("page", USER_PAGES, ids=lambda page: page.name)
def test_pages_for_users_say_what_holds_and_not_on_which_seeds(page):
    assert of_the_lab(page.read_text()) == []


def test_the_lab_book_has_the_seeds():
    """The words above are those of such texts."""
    for page in ("ball_rolling", "cube_pivoting", "planar", "shaping", "wall_friction"):
        assert of_the_lab((DOCS / "lab" / f"{page}_measured.md").read_text()), page
    shown = (
        "    makebreak run cube_pivoting --seed 0\n`--seed 3`: a seed draws the start"
    )
    assert of_the_lab(shown) == []

"""A motor that drives a cart by a wheel on the ground, and one that drags a tool: its
gain, the mass that it moves, and the friction."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from makebreak.gap.data.channel_noise import in_newton_metres
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.split import split
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.pressing import PressingProblem
from makebreak.gap.search.select import select
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

G, RATE = 9.81, 250.0


def link(name: str, mass: float, inertia: float, z: float, shape: str = "") -> str:
    axes = f"<ixx>{inertia}</ixx><iyy>{inertia}</iyy><izz>{inertia}</izz>"
    return (
        f'<link name="{name}"><pose>0 0 {z} 0 0 0</pose><inertial><mass>{mass}</mass>'
        f"<inertia>{axes}<ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>"
        f"{shape}</link>"
    )


def collision(geometry: str, friction: float, pose: str = "0 0 0 0 0 0") -> str:
    return (
        f'<collision name="shape"><pose>{pose}</pose><geometry>{geometry}</geometry>'
        f"<drake:proximity_properties><drake:mu_dynamic>{friction}</drake:mu_dynamic>"
        f"<drake:mu_static>{friction}</drake:mu_static>"
        "<drake:point_contact_stiffness>60000</drake:point_contact_stiffness>"
        "<drake:hunt_crossley_dissipation>1</drake:hunt_crossley_dissipation>"
        "</drake:proximity_properties></collision>"
    )


def joint(name: str, kind: str, parent: str, child: str, axis: str) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>{child}'
        f"</child><axis><xyz>{axis}</xyz><limit><effort>100</effort></limit></axis>"
        "</joint>"
    )


def model(folder: Path, name: str, inner: str) -> None:
    (folder / f"{name}.sdf").write_text(
        '<sdf version="1.9" xmlns:drake="drake.mit.edu">'
        f'<model name="{name}">{inner}</model></sdf>'
    )


def scene(folder: Path, welded: dict[str, str], driven: list[str]) -> Path:
    directives: list[dict] = []
    for name, base in welded.items():
        directives += [
            {"add_model": {"name": name, "file": f"{name}.sdf"}},
            {"add_weld": {"parent": "world", "child": f"{name}::{base}"}},
        ]
    whole = {
        "directives": directives,
        "plant": {"time_step": 5e-4},
        "actuation": {"type": "effort", "joints": driven},
    }
    (folder / "scene.yaml").write_text(yaml.safe_dump(whole))
    return folder / "scene.yaml"


def sines(t, size: float, top: float, seed: int):
    """Position, velocity and acceleration (n,) of four sines, and of their sum."""
    rng = np.random.default_rng(seed)
    w, phase = 2 * np.pi * rng.uniform(0.2, top, 4), rng.uniform(0.0, 6.0, 4)
    a = size * rng.uniform(0.5, 1.0, 4) / 4.0
    at = w * t[:, None] + phase
    return (
        (a * np.sin(at)).sum(axis=1),
        (a * w * np.cos(at)).sum(axis=1),
        -(a * w**2 * np.sin(at)).sum(axis=1),
    )


def write(folder: Path, columns: dict[str, np.ndarray]) -> Path:
    table = np.column_stack(list(columns.values()))
    path = folder / "log.csv"
    header = ",".join(columns)
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.9g")
    return path


WHEEL, R, CART = 0.8, 0.05, 2.5


def driven_cart(folder: Path, mass: float, gain: float) -> tuple[Path, Path]:
    """It rolls without slip; its mass, and what its motor gives of its torque."""
    J = 0.5 * WHEEL * R**2
    ball = collision(f"<sphere><radius>{R}</radius></sphere>", 0.9)
    model(
        folder, "cart",
        link("base", 1.0, 1e-3, 0.0) + link("box", CART, 0.01, R)
        + link("wheel", WHEEL, J, R, ball)
        + joint("rail", "prismatic", "base", "box", "1 0 0")
        + joint("post", "prismatic", "box", "fork", "0 0 1")
        + joint("axle", "revolute", "fork", "wheel", "0 1 0")
        + link("fork", 1e-6, 1e-9, R),
    )  # fmt: skip
    box = "<box><size>9 2 0.2</size></box>"
    ground = link("ground", 1.0, 1.0, 0.0, collision(box, 0.9, "0 0 -0.1 0 0 0"))
    model(folder, "ground", ground)
    rng, t = np.random.default_rng(1), np.arange(0.0, 16.0, 1.0 / RATE)
    x, _, a = sines(t, 0.15, 0.6, 3)
    torque = (J / R + (mass + WHEEL) * R) * a / gain
    rest = (WHEEL + 1e-6) * G / 30000.0  # How deep it lies.
    noise = rng.normal(size=(len(t), 4)) * [2e-5, 5e-6, 4e-4, 4e-3]
    log = write(folder, {
        "time": t,
        "cart.rail.position": x + noise[:, 0],
        "cart.post.position": noise[:, 1] - rest,
        "cart.axle.position": x / R + noise[:, 2],
        "cart.axle.effort_measured": torque + noise[:, 3],
    })  # fmt: skip
    welded = {"ground": "ground", "cart": "base"}
    return scene(folder, welded, ["cart.axle"]), log


SLED, TOOL = 2.0, 1.2


def dragged_tool(folder: Path, friction: float) -> tuple[Path, Path]:
    """A ball that a gantry presses on two plates side by side, and drags over them."""
    ball = collision("<sphere><radius>0.012</radius></sphere>", 0.25)
    model(
        folder, "rig",
        link("base", 1.0, 1e-3, 0.0) + link("sled", SLED, 0.01, 0.012)
        + link("tool", TOOL, 0.01, 0.012, ball)
        + joint("x", "prismatic", "base", "sled", "1 0 0")
        + joint("z", "prismatic", "sled", "tool", "0 0 1"),
    )  # fmt: skip
    box = "<box><size>0.5 1 0.2</size></box>"
    for name, at in (("left", -0.25), ("right", 0.25)):
        shape = collision(box, 0.25, f"{at} 0 -0.1 0 0 0")
        model(folder, name, link(name, 1.0, 1.0, 0.0, shape))
    rng, t = np.random.default_rng(2), np.arange(0.0, 20.0, 1.0 / RATE)
    x, v, a = sines(t, 0.3, 0.5, 5)
    force = 10.0 + 3.0 * np.sin(3.7 * t)
    noise = rng.normal(size=(len(t), 4)) * [1e-5, 1e-5, 2e-3, 2e-3]
    drag = friction * force * np.tanh(v / 1e-3)
    log = write(folder, {
        "time": t,
        "rig.x.position": x + noise[:, 0],
        "rig.z.position": noise[:, 1] - force / 30000.0,
        "rig.x.velocity": v + noise[:, 2],
        "rig.z.velocity": noise[:, 3],
        "rig.x.effort_command": (SLED + TOOL) * a + drag,
        "rig.z.effort_command": TOOL * G - force,
    })  # fmt: skip
    welded = {"left": "left", "right": "right", "rig": "base"}
    return scene(folder, welded, ["rig.x", "rig.z"]), log


def problem_of(files: tuple[Path, Path]) -> ContactProblem:
    read = read_scene(files[0])
    recordings = in_newton_metres(read_recordings([files[1]]), read.channels)
    return PressingProblem(read, split(recordings).decided)


@pytest.mark.parametrize(
    ("mass", "gain"), [(1.3, 1.0), pytest.param(1.0, 1.3, marks=pytest.mark.slow)]
)
def test_a_carts_mass_and_its_motors_gain_are_a_tie(tmp_path, mass, gain):
    """Nothing but torque and motion is measured. One was named alone: noise was weighed
    as that of the lighter cart, or two masses were taken at once, of which one went."""
    selection = select(problem_of(driven_cart(tmp_path, mass * CART, gain)))
    (choice,) = selection.choices
    tied = {(e.kind, e.at[0]): e.parameters for e in (choice.effect, *choice.ties)}
    moved = CART + 1.5 * WHEEL  # With what turns.
    ratio = (mass * CART + 1.5 * WHEEL) / moved / gain
    box = tied["link_mass", "cart.box"]["mass"]
    # As well as the mass of all is known, and a little more.
    assert 1.0 + box / moved == pytest.approx(ratio, rel=0.06)
    assert tied["actuator_gain", "cart.axle"]["gain"] == pytest.approx(
        1.0 / ratio, rel=0.06
    )


def test_a_gain_and_masses_that_do_the_same_leave_the_same(tmp_path):
    """All forces in another unit are no other model."""
    problem = problem_of(driven_cart(tmp_path, CART, 1.0))
    less = 0.7
    gain = [Effect("actuator_gain", ["cart.axle"], {"gain": less})]
    heavier = [
        Effect("link_mass", [f"cart.{name}"], {"mass": mass * (1.0 / less - 1.0)})
        for name, mass in (("box", CART), ("wheel", WHEEL), ("fork", 1e-6))
    ]
    n = len(problem.coordinates)
    one, other = (problem.left(e)[:, :n] for e in (gain, heavier))
    moves = np.sqrt(np.mean(one**2))
    assert moves > 1.0
    assert np.sqrt(np.mean((one - other) ** 2)) < 0.01 * moves
    (pair,) = problem.weighed_alike(gain, heavier)
    assert np.std(pair[0]) == pytest.approx(np.std(pair[1]), rel=0.02)


def test_a_gain_is_as_well_as_the_masses_are_known(tmp_path):
    problem = problem_of(driven_cart(tmp_path, CART, 1.3))
    n = problem.nuisances()
    screen = Screen(problem.base(), n.columns, n.prior, problem.train(), reach=n.reach)
    gain = [Effect("actuator_gain", ["cart.axle"], {"gain": 1.2})]
    fit = fit_effects(problem, screen, gain)
    of_box = n.names.index("object_mass of cart.box, mass")
    assert fit.b[of_box] == 0.0 and np.abs(fit.b).max() > 0.0
    std, _ = problem.widened(fit, 0)
    value = fit.effects[0].parameters["gain"]
    assert std["gain"] == pytest.approx(
        np.hypot(0.03 * value, fit.std[0]["gain"]), rel=1e-6
    )

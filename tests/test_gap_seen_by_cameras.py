"""Balls and pucks as cameras see them: closed forms, with a camera's noise and rate."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.residuals.objects import point_on_face_of
from makebreak.gap.simulation.free_windows import FreeBodyModel
from makebreak.gap.workflow import run_gap
from makebreak.models.scene import read_scene

G, RATE, NOISE = 9.81, 100.0, 6e-4
MASS, RADIUS, STIFFNESS = 0.046, 0.021, 2e6
PAIR, TURN = "ball.ball~desk.desk", ("qw", "qx", "qy", "qz")


def damper(share: float) -> float:
    """[N s/m] that gives back this share of a ball's speed (a damped half swing)."""
    log = np.log(share)
    zeta = -log / np.hypot(np.pi, log)
    return float(2.0 * zeta * np.sqrt(STIFFNESS * MASS))


def write_scene(folder: Path, shape: str, inertia, friction: float, effects=()) -> Path:
    surface = (
        '<drake:proximity_properties xmlns:drake="drake.mit.edu">'
        f"<drake:mu_static>{friction}</drake:mu_static>"
        f"<drake:mu_dynamic>{friction}</drake:mu_dynamic>"
        f"<drake:point_contact_stiffness>{2 * STIFFNESS}"
        "</drake:point_contact_stiffness>"
        "</drake:proximity_properties>"
    )
    moments = "".join(
        f"<{k}>{v}</{k}>" for k, v in zip(("ixx", "iyy", "izz"), inertia, strict=True)
    )
    moments += "<ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>"
    for name, inside in {
        "ball": f"<inertial><mass>{MASS}</mass><inertia>{moments}</inertia></inertial>"
        f'<collision name="c"><geometry>{shape}</geometry>{surface}</collision>',
        "desk": '<collision name="c"><pose>0 0 -0.5 0 0 0</pose><geometry><box><size>'
        f"9 9 1</size></box></geometry>{surface}</collision>",
    }.items():
        (folder / f"{name}.sdf").write_text(
            f'<sdf version="1.9"><model name="{name}"><link name="{name}">{inside}'
            "</link></model></sdf>"
        )
    scene = {
        "directives": [
            {"add_model": {"name": "desk", "file": "desk.sdf"}},
            {"add_weld": {"parent": "world", "child": "desk::desk"}},
            {"add_model": {"name": "ball", "file": "ball.sdf"}},
        ],
        "plant": {"time_step": 0.0005},
        "effects": list(effects),
    }
    file = folder / "scene.yaml"
    file.write_text(yaml.safe_dump(scene))
    return file


def ball_scene(folder: Path, effects=()) -> Path:
    shape = f"<sphere><radius>{RADIUS}</radius></sphere>"
    return write_scene(folder, shape, 3 * [0.4 * MASS * RADIUS**2], 0.3, effects)


def write_log(folder: Path, rows, names) -> Path:
    file = folder / "log.csv"
    header = ",".join(["episode", "time", *(f"ball.ball.{n}" for n in names)])
    np.savetxt(file, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    return file


def bounces(folder: Path, share: float, drag: float = 0.0, episodes: int = 8) -> Path:
    """Balls that are thrown with a spin nobody measures. A bounce gives back `share`
    of the speed at once, and friction 0.3 what it can. drag: [1/m] of v abs(v)."""
    rng, dt, rows = np.random.default_rng(0), 5e-4, []
    for episode in range(episodes):
        x = np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.4, 0.9)])
        v = np.array([*rng.uniform(-0.9, 0.9, 2), rng.uniform(-0.5, 0.8)])
        w = rng.uniform(-15.0, 15.0, 3)
        every = round(1.0 / RATE / dt)
        for k in range(int(1.5 / dt)):
            if k % every == 0:
                rows.append([episode, k * dt, *x + NOISE * rng.normal(size=3)])
            a = np.array([0.0, 0.0, -G]) - drag * np.linalg.norm(v) * v
            x, v = x + dt * v + 0.5 * dt**2 * a, v + dt * a
            if x[2] < RADIUS and v[2] < 0.0:
                down, v[2] = -v[2], -share * v[2]
                x[2] += 2.0 * (RADIUS - x[2]) * (0.5 + 0.5 * share)
                slip = np.array([v[0] - RADIUS * w[1], v[1] + RADIUS * w[0]])
                most = 0.3 * (1.0 + share) * down
                size = max(float(np.linalg.norm(slip)), 1e-9)
                change = -slip / size * min(most, size / 3.5)
                v[:2] += change
                w[:2] += np.array([change[1], -change[0]]) / (0.4 * RADIUS)
    return write_log(folder, rows, "xyz")


def model_of(scene: Path, log: Path) -> FreeBodyModel:
    recordings, _ = condition(read_recordings([log]), False)
    return FreeBodyModel(read_scene(scene), recordings)


def left(model: FreeBodyModel) -> float:
    return float(np.sqrt(np.mean(model.residual() ** 2)))


def damped(share: float) -> dict:
    damping = {"damping": damper(share)}
    return {"kind": "contact_damping", "at": PAIR, "parameters": damping}


def test_bounces_at_a_cameras_rate_leave_no_more_than_noise(tmp_path):
    """Each of eight balls bounces three or four times, and spins as nobody has seen."""
    model = model_of(ball_scene(tmp_path, [damped(0.8)]), bounces(tmp_path, 0.8))
    assert sum(w.after_hits > 0 for w in model.windows) >= 16
    assert left(model) < 1.2


@pytest.mark.slow
def test_what_slows_a_ball_in_the_air_does_not_spoil_where_it_is_thought_to_start(
    tmp_path,
):
    """About a tenth of its weight. With starts as gravity alone gives them the model
    with the drag in it leaves more than that without."""
    log = bounces(tmp_path, 0.8, drag=0.13)
    scene = ball_scene(tmp_path, [damped(0.8)])
    plain = left(model_of(scene, log))
    model = model_of(scene, log)
    # Of the speed at which most of the way is gone, 2 to 3 m/s.
    drag = [drag * 0.13 * MASS for drag in (2.0, 2.5)]
    body_drag = {"kind": "body_drag", "at": "ball.ball"}
    with_drag = min(
        left(model_of(
            ball_scene(tmp_path, [damped(0.8), body_drag
                       | {"parameters": {"linear": d, "angular": 0.0}}]), log))
        for d in drag
    )  # fmt: skip
    assert not model._falls_freely
    assert with_drag < 1.4 < 1.5 * with_drag < plain


@pytest.mark.slow
def test_a_ball_that_gives_back_the_same_share_of_any_speed_has_a_linear_damper(
    tmp_path,
):
    result = run_gap(ball_scene(tmp_path), [bounces(tmp_path, 0.75)])
    assert result.verdict == "gap_named"
    (effect,) = result.effects
    assert effect.kind == "contact_damping"
    found = effect.parameters["damping"].value
    # An impact that takes no time, for one of half a millisecond.
    assert found == pytest.approx(damper(0.75), rel=0.05)


def slid(folder: Path, friction: float, carried: float, episodes: int = 9) -> Path:
    """A disc of 4 cm that slides and turns until it stops. It is carried by two rings:
    its rim, with the share `carried`, and one at half of its radius."""
    rng, dt, r, rows = np.random.default_rng(1), 1e-3, 0.04, []
    angle = np.arange(12) * np.pi / 6.0
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    points = np.concatenate([r * ring, 0.5 * r * ring])
    load = np.repeat([carried, 1.0 - carried], 12) / 12.0
    for episode in range(episodes):
        way = rng.uniform(0.0, 2.0 * np.pi)
        v = rng.uniform(0.5, 1.5) * np.array([np.cos(way), np.sin(way)])
        x, w, turn = -0.4 * v, rng.uniform(-12.0, 12.0), rng.uniform(0.0, 6.0)
        for k in range(800):
            if k % 16 == 0:
                off = 5e-4 * rng.normal(size=3)
                half = 0.5 * turn + 1e-3 * rng.normal()
                pose = [np.cos(half), 0.0, 0.0, np.sin(half)]
                pose[1:3] = 1e-3 * rng.normal(size=2)
                sign = rng.choice([-1.0, 1.0])  # Both are one orientation.
                place = np.array([*x, 0.006]) + off
                rows.append([episode, k * dt, *place, *(sign * np.array(pose))])
            c, s = np.cos(turn), np.sin(turn)
            at = points @ np.array([[c, s], [-s, c]])
            u = v + w * np.column_stack([-at[:, 1], at[:, 0]])
            f = -friction * G * load[:, None] * u
            f /= np.maximum(np.linalg.norm(u, axis=1), 5e-3)[:, None]
            v = v + dt * f.sum(axis=0)
            w += (
                dt * float(np.sum(at[:, 0] * f[:, 1] - at[:, 1] * f[:, 0])) / (r**2 / 2)
            )
            x, turn = x + dt * v, turn + dt * w
    return write_log(folder, rows, ("x", "y", "z", *TURN))


def puck_scene(folder: Path, friction: float) -> Path:
    shape = "<cylinder><radius>0.04</radius><length>0.012</length></cylinder>"
    across = MASS * (3 * 0.04**2 + 0.012**2) / 12.0
    inertia = [across, across, MASS * 0.04**2 / 2.0]
    return write_scene(folder, shape, inertia, friction)


@pytest.mark.parametrize("carried", [1.0 / 3.0, 0.9], ids=["evenly", "by its rim"])
def test_a_puck_that_slides_and_turns_is_right_wherever_it_is_carried(
    tmp_path, carried
):
    """Drake's point contact would let it turn for ever, and rock."""
    model = model_of(puck_scene(tmp_path, 0.35), slid(tmp_path, 0.35, carried))
    assert left(model) < 1.3
    (finding,) = point_on_face_of(model)
    assert (
        finding.kind == "point_on_face" and "ball.ball lies on a face" in finding.says
    )


@pytest.mark.slow
def test_the_friction_of_a_puck_is_named(tmp_path):
    result = run_gap(puck_scene(tmp_path, 0.35), [slid(tmp_path, 0.22, 1.0 / 3.0)])
    assert result.verdict == "gap_named"
    (effect,) = result.effects
    assert effect.kind == "contact_friction"
    assert effect.parameters["friction"].value == pytest.approx(0.22, rel=0.03)

"""The benchmark's cases: what is hidden in which world, and the files of each.

    python tests/gap_benchmark/cases.py --set standard --out DIR --truth FILE

writes a folder for each case (scene.yaml, its model files, recording.csv and mostly
noise.json) under DIR, and what is hidden into FILE, which must lie elsewhere. What is
reported is of the set `standard`; `development` has the same table with other seeds,
for tuning. Nothing is drawn twice: a case is a function of its seed.
"""

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

if __name__ == "__main__":  # The package is found beside the tests.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gap_benchmark import contact_world as contact
from gap_benchmark.maker import make_cases
from gap_benchmark.mechanism import (
    MECHANISMS,
    quaternion,
    to_urdf,
    with_background,
)
from gap_benchmark.mechanism_world import MechanismWorld, Reference, Sampling
from gap_benchmark.sensing import hermite, linear, measured

SEEDS = {"standard": 50_000, "development": 90_000}
LINK_MASS, LINK_COM = 0.035, 0.0025  # The background, 1 sigma [-], [m].


@dataclass(frozen=True)
class Case:
    """kinds: hidden effects, also those outside the catalogue; ties: lists of kinds
    that this recording cannot tell apart."""

    name: str
    seed: int
    world: str
    kinds: tuple[str, ...]
    background: bool
    ties: tuple[tuple[str, ...], ...] = ()

    @property
    def folder(self) -> str:
        """A name that does not tell."""
        return f"case_{self.seed}"


@dataclass(frozen=True)
class Written:
    """What a case's folder holds as numbers, before it is files; and its truth.

    states: of joints and bodies at each row, as they truly were, under the names of
    the channels.
    """

    columns: dict
    scene: str
    models: dict[str, str]
    noise: dict | None
    truth: dict
    states: dict


OUTSIDE = ("bouc_wen", "magnetic_pull")
# Late commands and late sensors are one thing wherever commands are not fed back.
_TIE_DELAY = (("input_delay", "sensor_delay"),)
_TIE_LOAD = (("payload", "constant_force"),)
_TIE_REST = (("object_size", "plane_height"),)

# (world, kinds, background, ties). A "!" marks a recording made for a tie.
TABLE: list[tuple] = [
    ("arm", "", True), ("arm", "", False), ("pendulum", "", True),
    ("cartpole", "", True), ("scara", "", True), ("ball", "", False),
    ("bounce", "", False), ("cube", "", False), ("sledge", "", False),
    ("pushed", "", False),
    ("arm", "joint_viscous_damping", True),
    ("cartpole", "joint_viscous_damping", False),
    ("arm", "joint_coulomb_friction", True),
    ("pendulum", "joint_coulomb_friction", False),
    ("cartpole", "joint_coulomb_friction", True),
    ("arm", "joint_stribeck_friction", True),
    ("pendulum", "joint_stribeck_friction", False),
    ("pendulum", "joint_quadratic_drag", True),
    ("scara", "joint_quadratic_drag", False),
    ("arm", "rotor_inertia", False), ("scara", "rotor_inertia", True),
    ("arm", "payload", True), ("scara", "payload", False),
    ("arm", "gravity_tilt", True), ("scara", "gravity_tilt", False),
    ("arm", "joint_offset", True), ("pendulum", "joint_offset", False),
    ("arm", "actuator_gain", True), ("pendulum", "actuator_gain", False),
    ("arm", "actuator_bias", True), ("pendulum", "actuator_bias", False),
    ("arm", "actuator_saturation", True), ("pendulum", "actuator_saturation", False),
    ("arm", "input_delay", True, _TIE_DELAY),
    ("cartpole", "input_delay", False, _TIE_DELAY),
    ("arm", "actuator_lag", True), ("pendulum", "actuator_lag", False),
    ("arm", "sensor_delay", True), ("pendulum", "sensor_delay", False),
    ("arm", "clock_skew", True), ("pendulum", "sensor_bias", True),
    ("scara", "joint_elasticity", True), ("arm", "joint_elasticity", False),
    ("scara", "joint_backlash", False), ("pendulum", "joint_backlash", True),
    ("arm", "torque_ripple", True), ("scara", "torque_ripple", False),
    ("arm", "joint_spring", True), ("cartpole", "joint_spring", False),
    ("arm", "constant_force", True), ("arm", "sinusoidal_force", True),
    ("pendulum", "sinusoidal_force", False),
    ("scara", "body_drag", True), ("arm", "body_drag", False),
    ("cube", "contact_friction", False), ("sledge", "contact_friction", False),
    ("pushed", "contact_friction", False), ("sledge", "friction_patch", False),
    ("ball", "rolling_resistance", False), ("ball", "rolling_resistance", False),
    ("bounce", "contact_stiffness", False), ("cube", "contact_stiffness", False),
    ("bounce", "contact_dissipation", False), ("cube", "contact_dissipation", False),
    ("bounce", "plane_height", False), ("ball", "plane_tilt", False),
    ("sledge", "plane_tilt", False), ("cube", "object_size", False),
    ("ball", "object_size", False), ("cube", "corner_radius", False),
    ("cube", "length_scale", False), ("pushed", "object_mass", False),
    ("cube", "object_com", False), ("cube", "object_inertia", False),
    ("bounce", "body_drag", False),
    ("arm", "joint_coulomb_friction payload", True),
    ("arm", "joint_viscous_damping input_delay", False, _TIE_DELAY),
    ("scara", "joint_coulomb_friction torque_ripple", True),
    ("pendulum", "joint_coulomb_friction actuator_gain", False),
    ("cube", "contact_friction contact_dissipation", False),
    ("sledge", "contact_friction plane_tilt", False),
    ("arm", "joint_coulomb_friction rotor_inertia gravity_tilt", True),
    ("pendulum", "joint_coulomb_friction joint_spring actuator_bias", False),
    ("arm", "bouc_wen", True), ("pendulum", "bouc_wen", False),
    ("sledge", "magnetic_pull", False), ("bounce", "magnetic_pull", False),
    ("cartpole!", "input_delay", False, _TIE_DELAY),
    ("arm!", "payload", False, _TIE_LOAD),
    ("ball!", "object_size", False, _TIE_REST),
]  # fmt: skip


def cases(which: str = "standard", seed: int | None = None) -> list[Case]:
    """All cases of a set, `standard` or `development`; seed: of the first one, where it
    is not the set's own."""
    first = SEEDS[which] if seed is None else seed
    found = []
    for i, (world, kinds, background, *ties) in enumerate(TABLE):
        words = kinds.split()
        name = f"{i:02d}_{world.replace('!', '_tie')}_{'_and_'.join(words) or 'none'}"
        found.append(
            Case(
                name, first + i, world, tuple(words), background,
                ties[0] if ties else (),
            )
        )  # fmt: skip
    return found


def make(case: Case, exact: bool = False) -> Written:
    """Draws, simulates and records a case.

    exact: without noise, jitter, losses and background; with all channels. The hidden
    effects are the same.
    """
    world = case.world.rstrip("!")
    draw = _mechanism if world in MECHANISMS else _object
    columns, scene, models, noise, effects, states = draw(case, world, exact)
    outside = any(kind in OUTSIDE for kind in case.kinds)
    verdict = (
        "gap_unnamed"
        if outside
        else "ambiguous"
        if case.ties
        else "gap_named"
        if effects
        else "no_gap"
    )
    truth = {
        "name": case.name,
        "verdict": verdict,
        "effects": effects,
        "ties": [list(tie) for tie in case.ties],
        "background": case.background,
        "world": world,
    }
    return Written(columns, scene, models, noise, truth, states)


def write(case: Case, folder: Path, made: Written | None = None) -> dict:
    """Writes the case's folder. Returns: its truth, which is not in the folder."""
    made = made or make(case)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.yaml").write_text(made.scene)
    for name, text in made.models.items():
        (folder / name).write_text(text)
    names = list(made.columns)
    rows = zip(*(np.asarray(made.columns[n]).tolist() for n in names), strict=True)
    lines = [",".join(names)]
    lines += [",".join("" if v != v else repr(v) for v in row) for row in rows]
    (folder / "recording.csv").write_text("\n".join(lines) + "\n")
    if made.noise is not None:
        (folder / "noise.json").write_text(json.dumps(made.noise, indent=2) + "\n")
    return made.truth


# ----- mechanisms


def _mechanism(case: Case, world: str, exact: bool):
    rng = np.random.default_rng(case.seed)
    nominal = MECHANISMS[world](rng)
    true = (
        with_background(nominal, rng, LINK_MASS, LINK_COM)
        if case.background
        else nominal
    )
    drive = "pd" if world == "scara" else "effort"
    calm = 0.25 if case.world == "arm!" else 1.0
    references = [Reference(nominal, rng, calm) for _ in range(2)]
    if calm < 1.0:  # So slow that only weight counts, and the hand stays upright.
        for reference in references:
            reference.w = np.minimum(reference.w, 2 * np.pi * 0.12)
            reference.size[1:6] *= 0.15
            reference.size[[0, 6]] *= 0.4
    plain = MechanismWorld(nominal, nominal, [], drive)
    effects = _mechanism_effects(case, world, nominal, plain, references, rng)
    sampling = Sampling(
        time_scatter=float(rng.choice([0.0, 0.05])),
        lost_rows=float(rng.choice([0.0, 0.002])),
        position_noise=float(10 ** rng.uniform(-4.7, -4.0)),
        velocity_noise=float(10 ** rng.uniform(-2.7, -2.0)),
    )
    lost = float(rng.choice([0.0, 0.01]))
    with_velocity = rng.uniform() < 0.8 or "sensor_bias" in case.kinds
    with_velocity = with_velocity or "sensor_delay" in case.kinds
    with_effort = drive == "effort" and rng.uniform() < 0.3
    with_effort = with_effort and not any(
        kind.startswith(("actuator", "input")) for kind in case.kinds
    )
    if exact:
        true, lost, with_velocity = nominal, 0.0, True
        sampling = Sampling(200.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    true_world = MechanismWorld(nominal, true, effects, drive)
    seconds = 20.0 if calm < 1.0 else 12.0
    offsets = true_world.offset
    noise: dict[str, float] = {}
    episodes, states = [], []
    for number, reference in enumerate(references):
        track = true_world.run(seconds, reference, sampling, rng)
        columns = {"time": track.tick, "episode": np.full(len(track.tick), number)}
        functions = {}
        state = {}
        for i, joint in enumerate(nominal.joints):
            state[f"{joint}.position"] = np.interp(
                track.tick, track.time, track.q[:, i]
            )
            state[f"{joint}.velocity"] = np.interp(
                track.tick, track.time, track.v[:, i]
            )
            if i in nominal.driven:
                for key, value in track.commands.items():
                    columns[f"{joint}.{key}"] = value[:, i]
            q = track.q[:, i] + offsets[i]
            functions[f"{joint}.position"] = hermite(track.time, q, track.v[:, i])
            noise[f"{joint}.position"] = sampling.position_noise
            if with_velocity:
                functions[f"{joint}.velocity"] = linear(track.time, track.v[:, i])
                noise[f"{joint}.velocity"] = sampling.velocity_noise
            if with_effort and i in nominal.driven:
                functions[f"{joint}.effort_measured"] = linear(
                    track.time, track.effort[:, i]
                )
                noise[f"{joint}.effort_measured"] = sampling.effort_noise
        episodes.append(
            measured(columns, functions, track.tick, effects, noise, lost, rng)
        )
        states.append(state)
    table = {k: np.concatenate([e[k] for e in episodes]) for k in episodes[0]}
    known = {k: np.concatenate([e[k] for e in states]) for k in states[0]}
    scene = _mechanism_scene(case, nominal, drive, table, rng)
    given = noise if rng.uniform() < 0.7 else None
    models = {f"{nominal.model}.urdf": to_urdf(nominal)}
    return table, scene, models, given, effects, known


def _mechanism_effects(case, world, nominal, plain, references, rng) -> list[dict]:
    """Sizes relative to the torques of this motion: a tenth to a third of them."""
    times = np.linspace(0.0, 12.0, 240)
    q, v, a, tau = [], [], [], []
    for t in times:
        state = references[0].at(t)
        for into, value in zip((q, v, a), state, strict=True):
            into.append(value)
        tau.append(plain.inverse_dynamics(*state))
    q, v, a, tau = (np.array(x) for x in (q, v, a, tau))

    def rms(x):
        return np.sqrt(np.mean(x**2, axis=0))

    S, V, A = rms(tau), rms(v), rms(a)
    if len(nominal.driven) < len(nominal.links):
        # The free joint: what gravity would do at half a radian.
        link = nominal.links[1]
        S[1] = 0.5 * link.mass * 9.81 * abs(link.com[2])
        V[1] = 1.5
    driven, model = list(nominal.driven), nominal.model
    left = [i for i in range(len(nominal.links)) if i in driven]
    last = f"{model}.{nominal.links[-1].name}"
    sign = rng.choice([-1.0, 1.0], 8)
    found = []

    def joint(choices=None):
        pick = [i for i in (choices or left) if i in left] or left
        i = int(rng.choice(pick))
        if len(left) > 1:
            left.remove(i)
        return i, nominal.joints[i]

    heavy = {"arm": [1, 3], "pendulum": [0, 1], "scara": [2], "cartpole": [0]}[world]
    for kind in case.kinds:
        f = rng.uniform(0.12, 0.3)
        small = 0.5 if world == "pendulum" else 1.0
        at: str | list[str]
        if kind == "joint_viscous_damping":
            choices = [0, 1] if world == "cartpole" else None
            if choices:
                i = int(rng.choice(choices))
                at = nominal.joints[i]
            else:
                i, at = joint()
            p = {"damping": f * S[i] / V[i]}
        elif kind == "joint_coulomb_friction":
            i, at = joint()
            p = {"coulomb": f * S[i]}
        elif kind == "joint_stribeck_friction":
            i, at = joint()
            c = 0.6 * f * S[i]
            p = {
                "coulomb": c,
                "static": c * rng.uniform(1.8, 2.6),
                "stribeck_velocity": rng.uniform(0.04, 0.12),
            }
        elif kind == "joint_quadratic_drag":
            i, at = joint([0, 1] if world == "scara" else None)
            p = {"coefficient": f * S[i] / V[i] ** 2}
        elif kind == "rotor_inertia":
            i, at = joint([0, 2, 4] if world == "arm" else [0, 1])
            p = {"inertia": f * S[i] / A[i]}
        elif kind == "payload":
            at = last
            mass = rng.uniform(0.5, 1.5) * (1.0 if world == "arm" else 0.6)
            place = np.append(rng.uniform(-0.04, 0.04, 2), rng.uniform(0.04, 0.12))
            if world == "scara":
                place[2] *= -1.0
                place[0] += 0.05
            if case.world == "arm!":
                place[:] = 0.0
            p = {"mass": mass} | dict(
                zip(("com_x", "com_y", "com_z"), place, strict=True)
            )
        elif kind == "gravity_tilt":
            at = model
            p = {
                "roll": sign[0] * rng.uniform(0.02, 0.05),
                "pitch": sign[1] * rng.uniform(0.02, 0.05),
            }
        elif kind == "joint_offset":
            i, at = joint(heavy)
            p = {"offset": sign[0] * rng.uniform(0.03, 0.06)}
        elif kind == "actuator_gain":
            i, at = joint(heavy)
            p = {"gain": 1.0 + sign[0] * rng.uniform(0.1, 0.2)}
        elif kind == "actuator_bias":
            i, at = joint()
            p = {"bias": sign[1] * f * S[i]}
        elif kind == "actuator_saturation":
            i, at = joint([0, 4] if world == "arm" else None)
            p = {"limit": rng.uniform(0.6, 0.8) * np.abs(tau[:, i]).max()}
        elif kind == "input_delay":
            at, p = model, {"delay": rng.uniform(0.012, 0.03)}
        elif kind == "actuator_lag":
            at, p = model, {"time_constant": rng.uniform(0.015, 0.035)}
        elif kind == "sensor_delay":
            at = [f"{name}.velocity" for name in nominal.joints]
            p = {"delay": rng.uniform(0.006, 0.02)}
        elif kind == "clock_skew":
            at, p = model, {"skew": sign[0] * rng.uniform(1e-3, 3e-3)}
        elif kind == "sensor_bias":
            i, name = joint()
            at, p = f"{name}.velocity", {"bias": sign[0] * rng.uniform(0.1, 0.2) * V[i]}
        elif kind == "joint_elasticity":
            i, at = joint([0, 1] if world == "scara" else [0, 1, 3])
            still = np.array(nominal.middle)
            unit = np.eye(len(still))[i]
            beyond = (
                plain.inverse_dynamics(still, 0 * still, unit)
                - plain.inverse_dynamics(still, 0 * still, 0 * still)
            )[i] - nominal.links[i].rotor
            w = 2 * np.pi * rng.uniform(3.0, 7.0)
            p = {"stiffness": beyond * w**2, "damping": 2 * 0.04 * beyond * w}
        elif kind == "joint_backlash":
            i, at = joint([0, 1])
            p = {"gap": rng.uniform(0.015, 0.04)}
        elif kind == "torque_ripple":
            i, at = joint([0, 1, 4, 6] if world == "arm" else [0, 1])
            p = {
                "amplitude": f * S[i],
                "periods_per_rev": float(rng.integers(5, 13)),
                "phase": rng.uniform(0, 2 * np.pi),
            }
        elif kind == "joint_spring":
            i, at = joint()
            k = f * S[i] / max(q[:, i].std(), 0.1)
            rest = nominal.middle[i] + rng.uniform(-0.2, 0.2)
            p = {"stiffness": k, "rest": rest}
        elif kind in ("constant_force", "sinusoidal_force"):
            at = last
            force = rng.normal(size=3)
            if world == "pendulum":
                force[1] = 0.0
            force *= rng.uniform(4.0, 9.0) / np.linalg.norm(force)
            force *= 0.15 if world == "pendulum" else 1.0
            p = dict(zip(("fx", "fy", "fz"), force, strict=True))
            if kind == "sinusoidal_force":
                p |= {
                    "frequency": rng.uniform(1.2, 3.0),
                    "phase": rng.uniform(0, 2 * np.pi),
                }
        elif kind == "body_drag":
            at = last
            p = {"linear": rng.uniform(3.0, 8.0) * small, "angular": 0.0}
        elif kind == "bouc_wen":
            i, at = joint(heavy)
            p = {"force": 0.3 * S[i], "reach": rng.uniform(0.08, 0.2)}
        else:
            raise ValueError(f"no size for {kind} in {world}")
        found.append(
            {"kind": kind, "at": at, "parameters": {k: float(x) for k, x in p.items()}}
        )
    return found


def _mechanism_scene(case, nominal, drive, table, rng) -> str:
    step = float(rng.choice([0.0, 0.001]))
    driven = [nominal.joints[i] for i in nominal.driven]
    if drive == "pd":
        actuation = (
            f"  type: pd\n  joints: [{', '.join(driven)}]\n"
            f"  kp: {nominal.extra['kp']}\n  kd: {nominal.extra['kd']}\n"
            "  hold: zero_order\n  rate_hz: 200\n"
        )
    else:
        actuation = (
            f"  type: effort\n  joints: [{', '.join(driven)}]\n"
            "  hold: zero_order\n  rate_hz: 200\n"
        )
    tolerance = (LINK_MASS, LINK_COM) if case.background else (0.002, 0.0001)
    positions = "".join(
        f"    {j}: {float(table[f'{j}.position'][0])!r}\n" for j in nominal.joints
    )
    return (
        "directives:\n"
        f"  - add_model: {{name: {nominal.model}, file: {nominal.model}.urdf}}\n"
        f"  - add_weld: {{parent: world, child: {nominal.model}::base}}\n"
        f"plant:\n  time_step: {step}\n  gravity: [0, 0, -9.81]\n"
        f"actuation:\n{actuation}"
        f"initial:\n  positions:\n{positions}"
        f"tolerance:\n  link_mass: {tolerance[0]}\n  link_com_m: {tolerance[1]}\n"
        "effects: []\n"
    )


# ----- objects


def _object(case: Case, world: str, exact: bool):
    rng = np.random.default_rng(case.seed)
    shape = {"bounce": "ball", "pushed": "sledge"}.get(world, world)
    body = {"ball": contact.ball, "cube": contact.cube, "sledge": contact.sledge}[
        shape
    ](rng)
    bouncing = world in ("cube", "bounce")
    ground = contact.Ground(
        friction=rng.uniform(0.2, 0.5),
        stiffness=rng.uniform(6e3, 2e4) if bouncing else 1e5,
        dissipation=rng.uniform(0.4, 1.2),
    )
    if world == "ball":
        ground = replace(ground, friction=0.6)
    pusher = None
    if world == "pushed":
        x = -body.half[0] - 0.012 - 0.0005  # A hair before it touches.
        z = body.half[2]
        pusher = contact.Pusher((x, 0.0, z))
    effects = _object_effects(case, world, body, ground, rng)
    true_body, true_ground, around = contact.hidden(body, ground, effects)
    rate = float(rng.choice([150.0, 200.0, 250.0]))
    n_episodes = {"cube": 16, "bounce": 10, "ball": 8, "sledge": 10, "pushed": 4}[world]
    seconds = {"cube": 0.55, "bounce": 0.9, "ball": 2.0, "sledge": 0.9, "pushed": 4.0}[
        world
    ]
    if case.world == "ball!":  # At rest: where the ball is says nothing of its size.
        n_episodes, seconds = 4, 1.0
    place_noise = float(10 ** rng.uniform(-4.3, -3.8))
    turn_noise = float(10 ** rng.uniform(-3.5, -3.0))
    with_twist = rng.uniform() < 0.6
    with_turn = case.world != "ball!"
    scatter, lost = float(rng.choice([0.0, 0.05])), float(rng.choice([0.0, 0.01]))
    lost_rows = float(rng.choice([0.0, 0.002]))
    if exact:
        place_noise = turn_noise = scatter = lost = lost_rows = 0.0
        with_twist = with_turn = True
    name = body.name
    noise = {f"{name}.{axis}": place_noise for axis in "xyz"}
    if with_turn:
        noise |= {f"{name}.q{k}": 0.5 * turn_noise for k in "wxyz"}
    if with_twist and with_turn:
        noise |= {f"{name}.v{axis}": 150.0 * place_noise for axis in "xyz"}
        noise |= {f"{name}.w{axis}": 50.0 * turn_noise for axis in "xyz"}
    episodes, states = [], []
    for number in range(n_episodes):
        n = int(seconds * rate)
        t = (np.arange(n) + scatter * np.clip(rng.normal(size=n), -2.5, 2.5)) / rate
        t[0] = 0.0
        t = t[np.concatenate([[True] * 3, rng.uniform(size=n - 3) >= lost_rows])]
        start = _start(case, world, true_body, true_ground, rng)
        columns = {"time": t, "episode": np.full(len(t), number)}
        functions = {}
        if pusher is not None:
            path = _push_path(rng)
            rows, finger = contact.push(true_body, true_ground, pusher, start, t, path)
            columns["pusher.slide.effort_command"] = finger[:, 2]
            functions["pusher.slide.position"] = linear(t, finger[:, 0])
            functions["pusher.slide.velocity"] = linear(t, finger[:, 1])
            noise |= {"pusher.slide.position": place_noise}
            noise |= {"pusher.slide.velocity": 200.0 * place_noise}
        elif bouncing or true_ground.patch or any(around.pull):
            rows = contact.simulate(true_body, true_ground, around, start, t)
        else:
            rows = contact.simulate_in_mujoco(true_body, true_ground, around, start, t)
        for i, axis in enumerate("xyz"):
            functions[f"{name}.{axis}"] = linear(t, rows[:, i])
            if with_twist and with_turn:
                functions[f"{name}.v{axis}"] = linear(t, rows[:, 7 + i])
                functions[f"{name}.w{axis}"] = linear(t, rows[:, 10 + i])
        table = measured(columns, functions, t, effects, noise, 0.0, rng)
        keys = "x y z qw qx qy qz vx vy vz wx wy wz".split()
        states.append({f"{name}.{k}": rows[:, i] for i, k in enumerate(keys)})
        if with_turn:
            q = _turned(rows[:, 3:7], turn_noise, rng)
            table |= {f"{name}.q{k}": q[:, i] for i, k in enumerate("wxyz")}
        if lost:  # The camera loses the whole pose.
            gone = rng.uniform(size=len(t)) < lost
            gone[:3] = False
            for key in table:
                if key.startswith(name):
                    table[key] = np.where(gone, np.nan, table[key])
        if pusher is not None:
            states[-1]["pusher.slide.position"] = finger[:, 0]
            states[-1]["pusher.slide.velocity"] = finger[:, 1]
        episodes.append(table)
    table = {k: np.concatenate([e[k] for e in episodes]) for k in episodes[0]}
    known = {k: np.concatenate([e[k] for e in states]) for k in states[0]}
    models = {
        f"{shape}.sdf": contact.to_sdf(body, ground, pusher is not None),
        "ground.sdf": contact.ground_sdf(ground),
    }
    if pusher is not None:
        models["pusher.sdf"] = contact.pusher_sdf(pusher, ground)
    scene = _object_scene(case, world, shape, pusher, table, rng)
    given = noise if rng.uniform() < 0.7 else None
    return table, scene, models, given, effects, known


def _start(case, world, body, ground, rng) -> np.ndarray:
    """(13,) origin, orientation, velocity, angular velocity; at rest where it lies."""
    s = np.zeros(13)
    s[3] = 1.0
    n = contact.normal_of(ground)
    lying = body.half[2] - body.mass * 9.81 / len(body.spheres) / ground.stiffness
    turn = rng.uniform(-np.pi, np.pi)
    if world == "cube":
        q = rng.normal(size=4)
        s[3:7] = q / np.linalg.norm(q)
        s[2] = np.sqrt(3) * body.half[2] + ground.height + rng.uniform(0.08, 0.2)
        s[7:10] = [*rng.uniform(-1.0, 1.0, 2), rng.uniform(-0.8, 0.2)]
        s[10:13] = rng.uniform(-6.0, 6.0, 3)
        return s
    if world == "bounce":
        s[2] = body.radius + ground.height + rng.uniform(0.06, 0.25)
        s[7:10] = [*rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.5, 0.3)]
        s[10:13] = rng.uniform(-8.0, 8.0, 3)
        return s
    # On the plane, turned with it.
    tilt = quaternion((ground.roll, ground.pitch, 0.0))
    flat = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
    if world == "pushed":
        flat = np.array([1.0, 0.0, 0.0, 0.0])
    w, x = tilt[0], tilt[1:]
    s[3] = w * flat[0] - x @ flat[1:]
    s[4:7] = w * flat[1:] + flat[0] * x + np.cross(x, flat[1:])
    way = np.array([np.cos(turn), np.sin(turn), 0.0])
    way -= (way @ n) * n
    speed = rng.uniform(0.2, 1.0)
    place = np.array([*rng.uniform(-0.1, 0.1, 2), 0.0])
    if "friction_patch" in case.kinds or "magnetic_pull" in case.kinds:
        place = -0.3 * speed * way + np.array([*rng.uniform(-0.05, 0.05, 2), 0.0])
    if world == "pushed":
        place, speed = np.zeros(3), 0.0
        place[1] = rng.uniform(-0.015, 0.015)
    place[2] = -(place[:2] @ n[:2]) / n[2]
    s[:3] = place + lying * n + [0.0, 0.0, ground.height]
    if world == "ball":
        speed = rng.uniform(0.1, 0.6)
        if case.world == "ball!":
            speed = 0.0
        s[7:10] = speed * way
        s[10:13] = np.cross(n, speed * way) / body.radius
    elif world == "sledge":
        s[7:10] = speed * way
        s[10:13] = rng.uniform(-3.0, 3.0) * n
    return s


def _push_path(rng):
    """Forward, faster and slower, so gently that finger and object never part."""
    w, phase = 2 * np.pi * rng.uniform(0.3, 0.6), rng.uniform(0, 2 * np.pi)
    mean = rng.uniform(0.08, 0.12)
    size = mean * rng.uniform(0.5, 0.8)

    def path(t):
        fade = 1.0 - np.exp(-((t / 0.3) ** 2))
        v = fade * (mean + size * np.sin(w * t + phase))
        # Its integral by the mid-point rule is close enough for a reference.
        s = np.linspace(0.0, t, max(int(t * 500), 2))
        y = (1 - np.exp(-((s / 0.3) ** 2))) * (mean + size * np.sin(w * s + phase))
        return float(np.trapezoid(y, s)), float(v)

    return path


def _turned(q, noise, rng):
    """Orientations with noise [rad] about random axes."""
    half = 0.5 * noise * rng.normal(size=(len(q), 3))
    w, x = q[:, :1], q[:, 1:]
    out = np.column_stack(
        [w[:, 0] - np.sum(half * x, axis=1), x + w * half + np.cross(half, x)]
    )
    return out / np.linalg.norm(out, axis=1)[:, None]


def _object_effects(case, world, body, ground, rng) -> list[dict]:
    pair = f"{body.name}~ground.ground"
    found = []
    for kind in case.kinds:
        sign = rng.choice([-1.0, 1.0], 2)
        at: str = body.name
        if kind == "contact_friction":
            f = rng.choice([rng.uniform(0.45, 0.7), rng.uniform(1.4, 1.9)])
            at, p = pair, {"friction": ground.friction * f}
        elif kind == "contact_stiffness":
            f = rng.choice([rng.uniform(0.25, 0.45), rng.uniform(2.5, 4.0)])
            at, p = pair, {"stiffness": ground.stiffness * f}
        elif kind == "contact_dissipation":
            f = rng.choice([rng.uniform(0.2, 0.45), rng.uniform(2.2, 3.5)])
            at, p = pair, {"dissipation": ground.dissipation * f}
        elif kind == "rolling_resistance":
            at, p = pair, {"coefficient": rng.uniform(0.005, 0.02)}
        elif kind == "friction_patch":
            x, y = rng.uniform(-0.1, 0.0), rng.uniform(-0.1, 0.0)
            p = {"friction": ground.friction * rng.uniform(1.8, 2.4)}
            p |= {"x_min": x, "x_max": x + rng.uniform(0.15, 0.3)}
            p |= {"y_min": y, "y_max": y + rng.uniform(0.15, 0.3)}
            at = pair
        elif kind == "plane_height":
            at = "ground.ground"
            p = {"height": sign[0] * rng.uniform(0.003, 0.008)}
        elif kind == "plane_tilt":
            at = "ground.ground"
            p = {
                "roll": sign[0] * rng.uniform(0.01, 0.03),
                "pitch": sign[1] * rng.uniform(0.01, 0.03),
            }
        elif kind == "object_size":
            scale = 1.0 + sign[0] * rng.uniform(0.04, 0.1)
            p = {"scale": scale}
            if body.shape == "ball":
                p["radius"] = scale * body.radius
        elif kind == "corner_radius":
            p = {"radius": rng.uniform(0.005, 0.01)}
        elif kind == "length_scale":
            p = {"scale": 1.0 + sign[0] * rng.uniform(0.015, 0.04)}
        elif kind == "object_mass":
            p = {"mass": body.mass * rng.choice([rng.uniform(0.5, 0.75), 1.5])}
        elif kind == "object_com":
            p = dict(zip("xyz", rng.uniform(-0.006, 0.006, 3), strict=True))
            p["x"] += 0.004 * sign[0]
        elif kind == "object_inertia":
            f = rng.choice([rng.uniform(0.6, 0.75), rng.uniform(1.3, 1.5)])
            # Still the inertia of a body: no moment above the sum of the others.
            each = f * np.array(body.inertia) * rng.uniform(0.93, 1.07, 3)
            p = dict(zip(("ixx", "iyy", "izz"), each, strict=True))
        elif kind == "body_drag":
            p = {"linear": body.mass * rng.uniform(1.0, 2.0), "angular": 0.0}
        elif kind == "magnetic_pull":
            strength = body.mass * rng.uniform(0.02, 0.04)
            p = {"strength": strength, "x": 0.0, "y": 0.05, "z": 0.05}
        else:
            raise ValueError(f"no size for {kind} in {world}")
        found.append(
            {"kind": kind, "at": at, "parameters": {k: float(x) for k, x in p.items()}}
        )
    return found


def _object_scene(case, world, shape, pusher, table, rng) -> str:
    # A discrete plant is off by its step where something bounces: that is for the
    # workflow to find out.
    step = float(rng.choice([0.0, 0.0002 if world in ("bounce", "cube") else 0.0005]))
    name = f"{shape}.{shape}"
    place = [float(table[f"{name}.{axis}"][0]) for axis in "xyz"]
    turn = [1.0, 0.0, 0.0, 0.0]
    if f"{name}.qw" in table:
        turn = [float(table[f"{name}.q{k}"][0]) for k in "wxyz"]
    in_mujoco = world in ("ball", "sledge", "pushed")
    directives = (
        "  - add_model: {name: ground, file: ground.sdf}\n"
        "  - add_weld: {parent: world, child: ground::ground}\n"
        f"  - add_model: {{name: {shape}, file: {shape}.sdf}}\n"
    )
    actuation = "  type: none\n"
    if pusher is not None:
        p = ", ".join(repr(float(x)) for x in pusher.place)
        directives += (
            "  - add_model: {name: pusher, file: pusher.sdf}\n"
            "  - add_weld:\n      parent: world\n      child: pusher::base\n"
            f"      X_PC: {{translation: [{p}]}}\n"
        )
        actuation = (
            "  type: effort\n  joints: [pusher.slide]\n  hold: zero_order\n"
            "  rate_hz: 200\n"
        )
    # MuJoCo's damping in contact is linear, Drake's is Hunt-Crossley's.
    tolerance = (0.1, 1.0) if in_mujoco else (0.02, 0.02)
    return (
        f"directives:\n{directives}"
        f"plant:\n  time_step: {step}\n  contact_model: point\n"
        "  discrete_contact_approximation: lagged\n  gravity: [0, 0, -9.81]\n"
        f"actuation:\n{actuation}"
        f"initial:\n  poses:\n    {name}: {turn + place}\n"
        f"tolerance:\n  contact_stiffness: {tolerance[0]}\n"
        f"  contact_dissipation: {tolerance[1]}\n"
        "effects: []\n"
    )


if __name__ == "__main__":
    make_cases("the benchmark's recordings", list(SEEDS), cases, write)

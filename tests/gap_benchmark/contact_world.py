"""An object that touches the ground: by an ODE of our own, or in MuJoCo.

The object touches with spheres fixed to it: one for a ball, eight for the corners of a
cube, four feet for a sledge. The ODE has compliant contact with Hunt-Crossley damping,

    f_n = k depth (1 + d depth_rate)+,    f_t = -mu f_n v_t/sqrt(|v_t|^2 + v_s^2),

and is stepped by RK4 at 10 us. MuJoCo has its own contact law, set as near as it comes.
"""

from dataclasses import dataclass, replace
from itertools import product

import mujoco
import numba
import numpy as np

from gap_benchmark.mechanism import quaternion, rotation

STEP = 1e-5  # [s] of the ODE.
MUJOCO_STEP = 1e-4  # [s]
SLIP = 5e-4  # [m/s], v_s
G = 9.81
IMPEDANCE = 0.01  # So small that MuJoCo's contact is a spring of known stiffness.


@dataclass(frozen=True)
class Body:
    """Half sizes (3,) [m] of a cube or sledge; a ball has its radius in each."""

    shape: str  # ball, cube, sledge
    half: tuple[float, float, float]
    radius: float  # Of the spheres [m].
    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, float, float]  # Central [kg m2].

    @property
    def name(self) -> str:
        return f"{self.shape}.{self.shape}"

    @property
    def spheres(self) -> np.ndarray:
        """(n, 3) centres in the body's frame [m]."""
        h, r = np.array(self.half), self.radius
        if self.shape == "ball":
            return np.zeros((1, 3))
        if self.shape == "cube":
            return np.array(list(product(*((-(a - r), a - r) for a in h))))
        return np.array([(x, y, -h[2] + r) for x in (-h[0] + r, h[0] - r)
                         for y in (-h[1] + r, h[1] - r)])  # fmt: skip


@dataclass(frozen=True)
class Ground:
    """A plane, and how the object touches it. patch: (mu, x0, x1, y0, y1) or None."""

    friction: float
    stiffness: float  # [N/m]
    dissipation: float  # [s/m]
    height: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    patch: tuple[float, ...] | None = None
    rolling: float = 0.0  # [-], times the radius is the lever.


@dataclass(frozen=True)
class Around:
    """Other forces on the body: drag, and a force in world at its origin."""

    drag: float = 0.0  # [N s/m]
    spin_drag: float = 0.0  # [N m s/rad]
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [N]
    wave: tuple[float, float] = (0.0, 0.0)  # Frequency [Hz], phase; 0: constant.
    pull: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)  # Magnet: strength, place.


def ball(rng) -> Body:
    r = rng.uniform(0.025, 0.05)
    m = rng.uniform(0.05, 0.3)
    return Body("ball", (r, r, r), r, m, (0.0, 0.0, 0.0), (0.4 * m * r * r,) * 3)


def cube(rng) -> Body:
    h, m = rng.uniform(0.04, 0.06), rng.uniform(0.2, 0.5)
    i = m * (2 * h) ** 2 / 6 * rng.uniform(0.9, 1.3)
    return Body("cube", (h, h, h), 0.002, m, (0.0, 0.0, 0.0), (i, i, i))


def sledge(rng) -> Body:
    h = (rng.uniform(0.08, 0.12), rng.uniform(0.06, 0.1), rng.uniform(0.02, 0.03))
    m = rng.uniform(0.5, 1.5)
    i = (m * (h[1] ** 2 + h[2] ** 2) / 3, m * (h[0] ** 2 + h[2] ** 2) / 3,
         m * (h[0] ** 2 + h[1] ** 2) / 3)  # fmt: skip
    return Body("sledge", h, 0.008, m, (0.0, 0.0, 0.0), i)


def hidden(body: Body, ground: Ground, effects) -> tuple[Body, Ground, Around]:
    """What is true, given what the scene says and the effects that it lacks."""
    around = Around()
    for effect in effects:
        kind, p = effect["kind"], effect["parameters"]
        if kind == "object_mass":
            f = p["mass"] / body.mass
            body = replace(
                body, mass=p["mass"], inertia=tuple(f * np.array(body.inertia))
            )
        elif kind == "object_com":
            body = replace(body, com=(p["x"], p["y"], p["z"]))
        elif kind == "object_inertia":
            body = replace(body, inertia=(p["ixx"], p["iyy"], p["izz"]))
        elif kind == "object_size":
            s = p["scale"]
            body = replace(
                body,
                half=tuple(s * np.array(body.half)),
                radius=s * body.radius,
                com=tuple(s * np.array(body.com)),
                inertia=tuple(s * s * np.array(body.inertia)),
            )
        elif kind == "corner_radius":
            body = replace(body, radius=p["radius"])
        elif kind == "contact_friction":
            ground = replace(ground, friction=p["friction"])
        elif kind == "contact_stiffness":
            ground = replace(ground, stiffness=p["stiffness"])
        elif kind == "contact_dissipation":
            ground = replace(ground, dissipation=p["dissipation"])
        elif kind == "rolling_resistance":
            ground = replace(ground, rolling=p["coefficient"])
        elif kind == "plane_height":
            ground = replace(ground, height=p["height"])
        elif kind == "plane_tilt":
            ground = replace(ground, roll=p["roll"], pitch=p["pitch"])
        elif kind == "friction_patch":
            patch = [p[k] for k in ("friction", "x_min", "x_max", "y_min", "y_max")]
            ground = replace(ground, patch=tuple(patch))
        elif kind == "body_drag":
            around = replace(around, drag=p["linear"], spin_drag=p["angular"])
        elif kind in ("constant_force", "sinusoidal_force"):
            wave = (p.get("frequency", 0.0), p.get("phase", 0.0))
            force = (p["fx"], p["fy"], p["fz"])
            around = replace(around, force=force, wave=wave)
        elif kind == "magnetic_pull":
            pull = (p["strength"], p["x"], p["y"], p["z"])
            around = replace(around, pull=pull)
        elif kind not in ("length_scale", "sensor_delay", "clock_skew", "sensor_bias"):
            raise ValueError(f"no law for {kind}")
    return body, ground, around


def normal_of(ground: Ground) -> np.ndarray:
    return rotation(quaternion((ground.roll, ground.pitch, 0.0)))[:, 2]


@numba.njit(cache=True)
def _rate(t, s, spheres, radius, numbers, inertia, com, n, dx):
    """State: p (com, 3), q (4), v (com, 3), w in body (3)."""
    (mass, mu, k, d, height, rolling, mu_patch, x0, x1, y0, y1, drag, spin_drag,
     fx, fy, fz, hz, phase, pull, px, py, pz, slip) = numbers  # fmt: skip
    qw, qx, qy, qz = s[3] , s[4], s[5], s[6]  # fmt: skip
    R = rotation(s[3:7])
    v, wb = s[7:10], s[10:13]
    w, arm = np.zeros(3), np.zeros(3)  # World; the origin from the com.
    for i in range(3):
        for j in range(3):
            w[i] += R[i, j] * wb[j]
            arm[i] -= R[i, j] * com[j]
    force, torque = np.zeros(3), np.zeros(3)
    force[2] = -mass * 9.81
    # Forces at the body's origin.
    vo = v + np.array([w[1] * arm[2] - w[2] * arm[1], w[2] * arm[0] - w[0] * arm[2],
                       w[0] * arm[1] - w[1] * arm[0]])  # fmt: skip
    size = np.sin(2 * np.pi * hz * t + phase) if hz > 0.0 else 1.0
    f = np.array([fx * size, fy * size, fz * size]) - drag * vo
    if pull != 0.0:
        away = np.array([px, py, pz]) - (s[0:3] + arm)
        r2 = away[0] ** 2 + away[1] ** 2 + away[2] ** 2 + 1e-4
        f += pull / r2 / np.sqrt(r2) * away
    force += f
    torque += np.array([arm[1] * f[2] - arm[2] * f[1], arm[2] * f[0] - arm[0] * f[2],
                        arm[0] * f[1] - arm[1] * f[0]])  # fmt: skip
    torque -= spin_drag * w
    for i in range(len(spheres)):
        a = np.zeros(3)
        for j in range(3):
            for m in range(3):
                a[j] += R[j, m] * (spheres[i, m] - com[m])
        c = s[0:3] + a
        gap = n[0] * c[0] + n[1] * c[1] + n[2] * (c[2] - height)
        depth = radius - gap
        if depth <= 0.0:
            continue
        a = a - (radius - 0.5 * depth) * n
        u = v + np.array([w[1] * a[2] - w[2] * a[1], w[2] * a[0] - w[0] * a[2],
                          w[0] * a[1] - w[1] * a[0]])  # fmt: skip
        un = u[0] * n[0] + u[1] * n[1] + u[2] * n[2]
        fn = max(k * depth * (1.0 - d * un), 0.0)
        ut = u - un * n
        here = mu
        if x0 < c[0] < x1 and y0 < c[1] < y1:
            here = mu_patch
        speed = np.sqrt(ut[0] ** 2 + ut[1] ** 2 + ut[2] ** 2 + slip * slip)
        f = fn * n - here * fn / speed * ut
        force += f
        torque += np.array([a[1] * f[2] - a[2] * f[1], a[2] * f[0] - a[0] * f[2],
                            a[0] * f[1] - a[1] * f[0]])  # fmt: skip
        if rolling > 0.0:
            wn = w[0] * n[0] + w[1] * n[1] + w[2] * n[2]
            wt = w - wn * n
            turn = np.sqrt(wt[0] ** 2 + wt[1] ** 2 + wt[2] ** 2 + 1e-4)
            torque -= rolling * radius * fn / turn * wt
    dx[0:3] = v
    dx[3] = 0.5 * (-qx * wb[0] - qy * wb[1] - qz * wb[2])
    dx[4] = 0.5 * (qw * wb[0] + qy * wb[2] - qz * wb[1])
    dx[5] = 0.5 * (qw * wb[1] + qz * wb[0] - qx * wb[2])
    dx[6] = 0.5 * (qw * wb[2] + qx * wb[1] - qy * wb[0])
    dx[7:10] = force / mass
    for i in range(3):  # Euler's equation in the body's principal axes.
        tb = R[0, i] * torque[0] + R[1, i] * torque[1] + R[2, i] * torque[2]
        j, m = (i + 1) % 3, (i + 2) % 3
        dx[10 + i] = (tb + (inertia[j] - inertia[m]) * wb[j] * wb[m]) / inertia[i]


@numba.njit(cache=True)
def _simulate(s, times, step, spheres, radius, numbers, inertia, com, n):
    out = np.empty((len(times), 13))
    k1, k2, k3, k4 = np.empty(13), np.empty(13), np.empty(13), np.empty(13)
    t = times[0]
    out[0] = s
    for i in range(1, len(times)):
        count = max(int(np.ceil((times[i] - t) / step)), 1)
        h = (times[i] - t) / count
        for j in range(count):
            at = t + j * h
            _rate(at, s, spheres, radius, numbers, inertia, com, n, k1)
            _rate(at + h / 2, s + h / 2 * k1, spheres, radius, numbers, inertia, com,
                  n, k2)  # fmt: skip
            _rate(at + h / 2, s + h / 2 * k2, spheres, radius, numbers, inertia, com,
                  n, k3)  # fmt: skip
            _rate(at + h, s + h * k3, spheres, radius, numbers, inertia, com, n, k4)
            s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            s[3:7] /= np.sqrt(np.sum(s[3:7] ** 2))
        t = times[i]
        out[i] = s
    return out


def simulate(body: Body, ground: Ground, around: Around, start, times, step=STEP):
    """By the ODE. start: (13,) origin p, q, velocity of the origin v, w in world.

    Returns: (n, 13) likewise at the times.
    """
    com = np.array(body.com)
    patch = ground.patch or (0.0, 1.0, 0.0, 1.0, 0.0)
    numbers = (
        body.mass, ground.friction, ground.stiffness, ground.dissipation,
        ground.height, ground.rolling, *patch, around.drag, around.spin_drag,
        *around.force, *around.wave, *around.pull, SLIP,
    )  # fmt: skip
    R = rotation(start[3:7])
    s = np.array(start, dtype=float)
    s[:3] += R @ com
    s[7:10] += np.cross(start[10:13], R @ com)
    s[10:13] = R.T @ start[10:13]
    out = _simulate(
        s, np.asarray(times, dtype=float), step, body.spheres, body.radius,
        tuple(float(x) for x in numbers), np.array(body.inertia), com,
        normal_of(ground),
    )  # fmt: skip
    for row in out:
        R = rotation(row[3:7])
        row[10:13] = R @ row[10:13]
        row[:3] -= R @ com
        row[7:10] -= np.cross(row[10:13], R @ com)
    return out


def mjcf(body: Body, ground: Ground, pusher: "Pusher | None" = None) -> str:
    """The object, the ground, and a finger on a slide where there is one."""

    def text(values) -> str:
        return " ".join(f"{float(v):.17g}" for v in values)

    # Negative solref: f = m (k depth + b depth_rate), with MuJoCo's own division by the
    # impedance. A linear damper, as strong as Hunt-Crossley's at half the depth of an
    # impact of 0.5 m/s.
    k = ground.stiffness / body.mass
    depth = 0.5 * np.sqrt(body.mass / ground.stiffness) * 0.5
    b = ground.stiffness * ground.dissipation * depth / body.mass
    contact = f'solref="{-k:.17g} {-b:.17g}" solimp="{IMPEDANCE} {IMPEDANCE} 1"'
    lever = ground.rolling * body.radius
    friction = f'friction="{ground.friction} {ground.friction} 0 {lever} {lever}"'
    dim = 6 if ground.rolling else 3
    pairs = "".join(
        f'<pair geom1="s{i}" geom2="ground" condim="{dim}" {contact} {friction}/>'
        for i in range(len(body.spheres))
    )
    spheres = "".join(
        f'<geom name="s{i}" type="sphere" size="{body.radius:.17g}" '
        f'pos="{text(c)}" contype="0" conaffinity="0"/>'
        for i, c in enumerate(body.spheres)
    )
    finger = ""
    if pusher is not None:
        # Of two bodies, MuJoCo's spring acts on the mass that both have together.
        share = 1.0 + body.mass / pusher.mass
        tip = (
            f'solref="{-k * share:.17g} {-b * share:.17g}" '
            f'solimp="{IMPEDANCE} {IMPEDANCE} 1"'
        )
        top = body.half[2] - 0.5 * body.radius  # The block between feet and top.
        spheres += (
            f'<geom name="block" type="box" size="{body.half[0]} {body.half[1]} '
            f'{0.5 * (body.half[2] + top - body.radius)}" pos="0 0 '
            f'{0.5 * (body.half[2] - top + body.radius)}" contype="0" conaffinity="0"/>'
        )
        finger = (
            f'<body name="finger" pos="{text(pusher.place)}"><inertial pos="0 0 0" '
            f'mass="{pusher.mass}" diaginertia="1e-3 1e-3 1e-3"/><joint name="slide" '
            'type="slide" axis="1 0 0"/><geom name="tip" type="sphere" '
            f'size="{pusher.radius}" contype="0" conaffinity="0"/></body>'
        )
        pairs += (
            f'<pair geom1="tip" geom2="block" condim="1" {tip} '
            f'friction="{pusher.friction} {pusher.friction} 0 0 0"/>'
        )
    plane = quaternion((ground.roll, ground.pitch, 0.0))
    return (
        '<mujoco><compiler inertiafromgeom="false" angle="radian"/><option '
        f'timestep="{MUJOCO_STEP}" integrator="RK4" cone="elliptic" impratio="1e5" '
        f'iterations="100" tolerance="1e-12" gravity="0 0 {-G}"/><worldbody>'
        f'<geom name="ground" type="plane" size="5 5 1" pos="0 0 {ground.height}" '
        f'quat="{text(plane)}" contype="0" conaffinity="0"/>'
        f'<body name="object"><freejoint name="free"/><inertial pos="{text(body.com)}" '
        f'mass="{body.mass:.17g}" diaginertia="{text(body.inertia)}"/>{spheres}</body>'
        f"{finger}</worldbody><contact>{pairs}</contact></mujoco>"
    )


def simulate_in_mujoco(body: Body, ground: Ground, around: Around, start, times):
    """As simulate, by MuJoCo. No patch, no magnet."""
    if ground.patch or any(around.pull):
        raise ValueError("MuJoCo's world has no patch and no magnet")
    model = mujoco.MjModel.from_xml_string(mjcf(body, ground))
    data = mujoco.MjData(model)
    number = model.body("object").id
    force, wave = np.array(around.force), around.wave

    def passive(m, d):
        size = np.sin(2 * np.pi * wave[0] * d.time + wave[1]) if wave[0] else 1.0
        R = d.xmat[number].reshape(3, 3)
        v, w = d.qvel[:3], R @ d.qvel[3:6]
        mujoco.mj_applyFT(m, d, size * force - around.drag * v, -around.spin_drag * w,
                          d.xpos[number], number, d.qfrc_passive)  # fmt: skip

    data.qpos[:7] = start[:7]
    data.qvel[:3] = start[7:10]
    data.qvel[3:6] = rotation(start[3:7]).T @ start[10:13]
    out = []
    if around != Around():
        mujoco.set_mjcb_passive(passive)
    try:
        for i, t in enumerate(times):
            if i:
                n = max(int(np.ceil((t - times[i - 1]) / MUJOCO_STEP - 1e-9)), 1)
                model.opt.timestep = (t - times[i - 1]) / n
                data.time = times[i - 1]
                mujoco.mj_step(model, data, n)
            w = rotation(data.qpos[3:7]) @ data.qvel[3:6]
            out.append(np.concatenate([data.qpos[:7], data.qvel[:3], w]))
    finally:
        mujoco.set_mjcb_passive(None)
    return np.array(out)


@dataclass(frozen=True)
class Pusher:
    """A finger on a slide along x that pushes the object; driven by an effort.

    Its tip is a smooth one: friction there would hold the object up or down by a force
    that depends on how the contact began, which no measured state tells.
    """

    place: tuple[float, float, float]
    mass: float = 0.5
    radius: float = 0.012
    friction: float = 0.0


def push(body: Body, ground: Ground, pusher: Pusher, start, ticks, path, gain=1.0):
    """The pusher under position control follows path(t) -> (x, v); in MuJoCo.

    Returns: (n, 13) of the object, and (n, 3) position, velocity, effort of the slide.
    """
    model = mujoco.MjModel.from_xml_string(mjcf(body, ground, pusher))
    data = mujoco.MjData(model)
    slide = model.joint("slide").qposadr[0]
    dof = model.joint("slide").dofadr[0]
    data.qpos[:7] = start[:7]
    data.qpos[slide], data.qvel[dof] = path(0.0)
    rows, finger = [], []
    for i, t in enumerate(ticks):
        x, v = data.qpos[slide], data.qvel[dof]
        x_ref, v_ref = path(t)
        u = 400.0 * (x_ref - x) + 40.0 * (v_ref - v)
        w = rotation(data.qpos[3:7]) @ data.qvel[3:6]
        rows.append(np.concatenate([data.qpos[:7], data.qvel[:3], w]))
        finger.append([x, v, u])
        end = ticks[i + 1] if i + 1 < len(ticks) else t
        n = max(int(np.ceil((end - t) / MUJOCO_STEP - 1e-9)), 1)
        model.opt.timestep = max((end - t) / n, 1e-9)
        data.qfrc_applied[dof] = gain * u
        mujoco.mj_step(model, data, n)
    return np.array(rows), np.array(finger)


def to_sdf(body: Body, ground: Ground, pushed: bool = False) -> str:
    """The object as the scene knows it; each body of a pair has the pair's values."""
    ixx, iyy, izz = body.inertia
    shapes = "".join(
        f'<collision name="s{i}"><pose>{c[0]:.12g} {c[1]:.12g} {c[2]:.12g} 0 0 0</pose>'
        f"<geometry><sphere><radius>{body.radius:.12g}</radius></sphere></geometry>"
        f"{_surface(ground)}</collision>"
        for i, c in enumerate(body.spheres)
    )
    if pushed:
        top = body.half[2] - 0.5 * body.radius
        height = body.half[2] + top - body.radius
        middle = 0.5 * (body.half[2] - top + body.radius)
        shapes += (
            f'<collision name="block"><pose>0 0 {middle:.12g} 0 0 0</pose><geometry>'
            f"<box><size>{2 * body.half[0]} {2 * body.half[1]} {height}</size></box>"
            f"</geometry>{_surface(ground)}</collision>"
        )
    h = body.half
    seen = (
        f"<sphere><radius>{body.radius}</radius></sphere>"
        if body.shape == "ball"
        else f"<box><size>{2 * h[0]} {2 * h[1]} {2 * h[2]}</size></box>"
    )
    return _model(
        body.shape,
        f"<inertial><pose>{body.com[0]} {body.com[1]} {body.com[2]} 0 0 0</pose>"
        f"<mass>{body.mass:.12g}</mass><inertia><ixx>{ixx:.12g}</ixx>"
        f"<iyy>{iyy:.12g}</iyy><izz>{izz:.12g}</izz><ixy>0</ixy><ixz>0</ixz>"
        f'<iyz>0</iyz></inertia></inertial><visual name="seen"><geometry>{seen}'
        f"</geometry></visual>{shapes}",
    )


def ground_sdf(ground: Ground) -> str:
    return _model(
        "ground",
        '<collision name="top"><pose>0 0 -0.25 0 0 0</pose><geometry><box><size>8 8 0.5'
        f"</size></box></geometry>{_surface(ground)}</collision>",
    )


def pusher_sdf(pusher: Pusher, ground: Ground) -> str:
    """A base at the pusher's place, and the finger on its slide."""
    surface = _surface(replace(ground, friction=pusher.friction))
    return (
        '<?xml version="1.0"?>\n<sdf version="1.9" '
        'xmlns:drake="http://drake.mit.edu"><model name="pusher"><link name="base"/>'
        f'<link name="finger"><inertial><mass>{pusher.mass}</mass><inertia><ixx>1e-3'
        "</ixx><iyy>1e-3</iyy><izz>1e-3</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>"
        '</inertia></inertial><collision name="tip"><geometry><sphere><radius>'
        f"{pusher.radius}</radius></sphere></geometry>{surface}</collision></link>"
        '<joint name="slide" type="prismatic"><parent>base</parent><child>finger'
        "</child><axis><xyz>1 0 0</xyz><limit><lower>-2</lower><upper>2</upper>"
        "<effort>100</effort></limit></axis></joint></model></sdf>\n"
    )


def _surface(ground: Ground) -> str:
    """Both bodies alike: friction and dissipation are then the pair's; stiffnesses act
    in a row."""
    return (
        "<drake:proximity_properties>"
        f"<drake:mu_static>{ground.friction:.12g}</drake:mu_static>"
        f"<drake:mu_dynamic>{ground.friction:.12g}</drake:mu_dynamic>"
        f"<drake:point_contact_stiffness>{2 * ground.stiffness:.12g}"
        "</drake:point_contact_stiffness><drake:hunt_crossley_dissipation>"
        f"{ground.dissipation:.12g}</drake:hunt_crossley_dissipation>"
        "</drake:proximity_properties>"
    )


def _model(name: str, inside: str) -> str:
    return (
        '<?xml version="1.0"?>\n<sdf version="1.9" '
        f'xmlns:drake="http://drake.mit.edu"><model name="{name}"><link '
        f'name="{name}">{inside}</link></model></sdf>\n'
    )

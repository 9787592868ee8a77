"""Small mechanisms for the tests of effects, as scenes in memory.

pendulum: one joint `p.j1` about y; a mass of 1 kg at 0.5 m, hanging down at q = 0.
double: two such links, joints `d.j1`, `d.j2`, inertias in skew axes.
block: a free box `b.box` on four small spheres, and a ground box; ball: a free ball.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import AddModel, AddWeld, ModelDirective

from makebreak.models.effects.kind import Effect
from makebreak.models.scene import (
    ActuationSection,
    InitialSection,
    PlantSection,
    Scene,
)

G = 9.81
MASS, LENGTH, CENTRAL = 1.0, 0.5, 0.01
J = CENTRAL + MASS * LENGTH**2  # Inertia of the pendulum about its joint [kg m2].

PENDULUM = """<?xml version="1.0"?>
<robot name="p"><link name="base"/><link name="rod">
<inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j1" type="continuous"><parent link="base"/><child link="rod"/>
<axis xyz="0 1 0"/>%s</joint>%s</robot>"""
TRANSMISSION = """<transmission type="SimpleTransmission">
<actuator name="a1"/><joint name="j1"/></transmission>"""

DOUBLE = """<?xml version="1.0"?>
<robot name="d"><link name="base"/>
<link name="upper"><inertial><origin xyz="0.02 0.01 -0.3" rpy="0.1 0.2 0.3"/>
<mass value="1.5"/>
<inertia ixx="0.02" iyy="0.025" izz="0.01" ixy="0.001" ixz="0" iyz="0"/></inertial>
</link><link name="lower"><inertial><origin xyz="0 0.03 -0.2"/><mass value="0.8"/>
<inertia ixx="0.01" iyy="0.012" izz="0.004" ixy="0" ixz="0.0005" iyz="0"/></inertial>
</link>
<joint name="j1" type="continuous"><parent link="base"/><child link="upper"/>
<axis xyz="0 1 0"/><dynamics damping="0.1"/></joint>
<joint name="j2" type="continuous"><parent link="upper"/><child link="lower"/>
<origin xyz="0 0 -0.6"/><axis xyz="1 0 0"/></joint></robot>"""

FOOT = """<collision name="foot_%d"><pose>%g %g -0.01 0 0 0</pose><geometry><sphere>
<radius>0.01</radius></sphere></geometry>%s</collision>"""
SURFACE = """<drake:proximity_properties><drake:mu_dynamic>%g</drake:mu_dynamic>
<drake:mu_static>%g</drake:mu_static>
<drake:point_contact_stiffness>%g</drake:point_contact_stiffness>
<drake:hunt_crossley_dissipation>%g</drake:hunt_crossley_dissipation>
</drake:proximity_properties>"""
BLOCK = """<?xml version="1.0"?>
<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="b"><link name="box">
<inertial><mass>1</mass><inertia><ixx>0.01</ixx><iyy>0.01</iyy><izz>0.01</izz></inertia>
</inertial>%s</link></model></sdf>"""
CUBE = """<?xml version="1.0"?>
<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="b"><link name="box">
<inertial><mass>0.4</mass><inertia><ixx>0.001</ixx><iyy>0.001</iyy><izz>0.001</izz>
</inertia></inertial><collision name="c"><geometry><box><size>0.1 0.1 0.1</size></box>
</geometry>%s</collision></link></model></sdf>"""
BALL = """<?xml version="1.0"?>
<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="b"><link name="ball">
<inertial><mass>0.07</mass><inertia><ixx>2.7783e-5</ixx><iyy>2.7783e-5</iyy>
<izz>2.7783e-5</izz></inertia></inertial><collision name="c"><geometry><sphere>
<radius>0.0315</radius></sphere></geometry>%s</collision></link></model></sdf>"""
# A solid cylinder, 140 mm long, along x on two spheres of its radius.
CYLINDER = """<?xml version="1.0"?>
<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="b"><link name="roller">
<inertial><mass>0.4</mass><inertia><ixx>8e-5</ixx><iyy>6.9333e-4</iyy>
<izz>6.9333e-4</izz></inertia></inertial>
<collision name="c"><pose>0 0 0 0 1.5707963 0</pose><geometry><cylinder>
<radius>%g</radius><length>0.14</length></cylinder></geometry>%s</collision>
<collision name="s1"><pose>-0.035 0 0 0 0 0</pose><geometry><sphere><radius>0.02
</radius></sphere></geometry>%s</collision>
<collision name="s2"><pose>0.035 0 0 0 0 0</pose><geometry><sphere><radius>0.02
</radius></sphere></geometry>%s</collision></link></model></sdf>"""
GROUND = """<?xml version="1.0"?>
<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="g"><link name="plate">
<collision name="c"><pose>0 0 -0.05 0 0 0</pose><geometry><box><size>4 4 0.1</size>
</box></geometry>%s</collision></link></model></sdf>"""


def _add(folder: Path, name: str, text: str, suffix: str) -> ModelDirective:
    path = folder / f"{name}.{suffix}"
    path.write_text(text)
    model = AddModel()
    model.name, model.file = name, f"file://{path}"
    directive = ModelDirective()
    directive.add_model = model
    return directive


def _weld(child: str) -> ModelDirective:
    weld = AddWeld()
    weld.parent, weld.child = "world", child
    directive = ModelDirective()
    directive.add_weld = weld
    return directive


def pendulum(folder, time_step=0.0, gravity=G, actuator=True, joint="", **actuation):
    """A pendulum with effort commands, or with the given actuation."""
    text = PENDULUM % (joint, TRANSMISSION if actuator else "")
    actuation = actuation or dict(type="effort", joints=["p.j1"])
    return Scene(
        directives=[_add(Path(folder), "p", text, "urdf"), _weld("p::base")],
        plant=PlantSection(time_step=time_step, gravity=[0.0, 0.0, -gravity]),
        actuation=ActuationSection(**actuation),
    )


def double(folder, time_step=0.0):
    return Scene(
        directives=[_add(Path(folder), "d", DOUBLE, "urdf"), _weld("d::base")],
        plant=PlantSection(time_step=time_step),
        actuation=ActuationSection(type="effort", joints=["d.j1", "d.j2"]),
    )


def surface(mu=0.5, stiffness=2e5, dissipation=1.0) -> str:
    return SURFACE % (mu, mu, stiffness, dissipation)


def on_ground(folder, thing: str, time_step=0.001, ground=None, gravity=G, z=None):
    """`block`, `cube`, `ball` or `roller` (body b.box, b.ball or b.roller) on the
    ground plate g.plate; `roller 0.019`: with a cylinder of that radius [m]."""
    own = surface()
    if thing == "block":
        corners = [(x, y) for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
        text = BLOCK % "".join(FOOT % (i, *c, own) for i, c in enumerate(corners))
        body, rest = "b.box", 0.02
    elif thing == "cube":
        text, body, rest = CUBE % own, "b.box", 0.05
    elif thing.startswith("roller"):
        radius = float((thing.split() + ["0.0198"])[1])
        text, body, rest = CYLINDER % (radius, own, own, own), "b.roller", 0.02
    else:
        text, body, rest = BALL % own, "b.ball", 0.0315
    height = rest if z is None else z
    return Scene(
        directives=[
            _add(Path(folder), "g", GROUND % (ground or surface()), "sdf"),
            _weld("g::plate"),
            _add(Path(folder), "b", text, "sdf"),
        ],
        plant=PlantSection(time_step=time_step, gravity=[0.0, 0.0, -gravity]),
        initial=InitialSection(poses={body: [1.0, 0, 0, 0, 0, 0, height]}),
    )


def with_effects(scene: Scene, *effects) -> Scene:
    """effects: (kind, at, parameters), `at` a name or a list of them."""
    listed = [
        Effect(kind, [at] if isinstance(at, str) else list(at), dict(parameters))
        for kind, at, parameters in effects
    ]
    return replace(scene, effects=listed)


def at_rest_but(q=None, v=None, body=None, pose=None, twist=None) -> InitialSection:
    """An initial state by name: joints {name: value}, and one free body."""
    return InitialSection(
        positions=q or {},
        velocities=v or {},
        poses={} if pose is None else {body: list(pose)},
        body_velocities={} if twist is None else {body: list(twist)},
    )


def smooth_motion(n_v: int, n=41, seed=0, duration=1.0):
    """time, q, v, vd of sums of sines, (n, n_v) each."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, duration, n)
    q, v, vd = (np.zeros((n, n_v)) for _ in range(3))
    for j in range(n_v):
        for _ in range(3):
            a, w, p = rng.uniform(0.2, 0.6), rng.uniform(2, 9), rng.uniform(0, 6)
            q[:, j] += a * np.sin(w * time + p)
            v[:, j] += a * w * np.cos(w * time + p)
            vd[:, j] -= a * w**2 * np.sin(w * time + p)
    return time, q, v, vd

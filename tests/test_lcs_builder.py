from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.common.yaml import yaml_load_typed
from pydrake.geometry import (
    AddContactMaterial,
    Convex,
    HalfSpace,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    ContactModel,
    CoulombFriction,
    DiscreteContactApproximation,
    ExternallyAppliedSpatialForce,
    MultibodyPlant,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    LinearSpringDamper,
    PdControllerGains,
    QuaternionFloatingJoint,
    SpatialInertia,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from scipy.optimize import nnls

from makebreak import model_path
from makebreak.benchmarks import plants
from makebreak.diagrams.contact_mpc import (
    ContactMpcConfig,
    KnotWeights,
    make_contact_mpc,
    tuned,
)
from makebreak.systems.contact_mpc.lcs_builder import (
    Anitescu,
    AnitescuLcs,
    AnitescuLcsBuilder,
    ContactPair,
    LcsBuilderConfig,
    LcsBuilderStatus,
    StewartTrinkle,
)
from makebreak.systems.contact_mpc.multibody.contact_layout import ContactLayout
from makebreak.systems.contact_mpc.multibody.witness_points import WitnessPoints
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Options, Plan
from makebreak.systems.contact_mpc.numerics.contact_rows import (
    contact_rows,
    friction_edges,
    tangent_basis,
)
from makebreak.systems.contact_mpc.numerics.lcs import simulate

REFERENCE = Path(__file__).parent / "reference"
SDF = (REFERENCE / "ball_on_table.sdf").read_text()
MATRICES = ("A", "B", "D", "d", "E", "F", "H", "c")
G = 9.81
# In ball_on_table: q = [finger 3, quaternion 4, ball 3], v = [finger 3, omega 3, v 3].
BALL_Z, BALL_VZ = 9, 18


def diagram_of(text, extend=None, time_step=0.0):
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    Parser(plant).AddModelsFromString(text, "sdf")
    if extend is not None:
        extend(plant)
    plant.Finalize()
    return builder.Build()


def ball_pairs(mu=0.5, n_f=2):
    return [
        ContactPair("finger_link", "ball_link", mu, n_f),
        ContactPair("ball_link", "table_link", mu, n_f),
    ]


@pytest.fixture(scope="module")
def ball_diagram():
    return diagram_of(SDF)


@pytest.fixture(scope="module")
def reference():
    return np.load(REFERENCE / "anitescu_ball_on_table.npz")


def random_state(rng, x_default, quaternions=(3,)):
    x = x_default + 0.1 * rng.normal(size=x_default.size)
    for k in quaternions:
        x[k : k + 4] = rng.normal(size=4)
        x[k : k + 4] /= np.linalg.norm(x[k : k + 4])
    return x


# The numbers of the reference implementation.


@pytest.mark.parametrize("analytic", [True, False])
def test_both_paths_reproduce_the_reference_implementation(
    ball_diagram, reference, analytic
):
    model = AnitescuLcs(ball_diagram, ball_pairs(), 0.05, 0.0, analytic)
    assert model.is_analytic == analytic
    lcs = model.build(reference["x_touch"], reference["u_touch"])
    for name in MATRICES:
        expected = reference[f"anitescu_2_touch_{name}"]
        np.testing.assert_allclose(getattr(lcs, name), expected, atol=1e-9)
    assert lcs.dt == 0.05
    # The reference's witness points are 0.01 m apart and coincide.
    np.testing.assert_allclose(lcs.phi, [0.01] * 4 + [0.0] * 4, atol=1e-9)


def test_four_friction_directions_reproduce_the_reference_problem(ball_diagram):
    z = np.load(REFERENCE / "ball_mpc_problem.npz")
    model = AnitescuLcs(ball_diagram, ball_pairs(n_f=4), 0.05, 0.0)
    lcs = model.build(z["x0"], np.zeros(3))
    for name in MATRICES:
        np.testing.assert_allclose(getattr(lcs, name), z[name], atol=1e-9)


def test_the_order_of_a_pairs_bodies_does_not_matter(ball_diagram, reference):
    swapped = [ContactPair(p.b, p.a, p.friction) for p in ball_pairs()]
    x, u = reference["x_touch"], reference["u_touch"]
    one = AnitescuLcs(ball_diagram, ball_pairs(), 0.05).build(x, u)
    other = AnitescuLcs(ball_diagram, swapped, 0.05).build(x, u)
    np.testing.assert_array_equal(one.F, other.F)
    np.testing.assert_array_equal(one.D, other.D)


def test_names_of_bodies_and_geometries_mean_the_same(ball_diagram):
    by_geometry = [
        ContactPair("finger::finger_collision", "ball::ball_collision", 0.5),
        ContactPair("ball::ball_link", "table_link", 0.5),
    ]
    x = random_state(np.random.default_rng(0), np.zeros(19))
    one = AnitescuLcs(ball_diagram, ball_pairs(), 0.05).build(x, np.zeros(3))
    other = AnitescuLcs(ball_diagram, by_geometry, 0.05).build(x, np.zeros(3))
    np.testing.assert_array_equal(one.E, other.E)


# The maths: bases, edges, eps_c.


def test_the_tangent_basis_is_drakes():
    rng = np.random.default_rng(0)
    axes = [s * np.eye(3)[i] for i in range(3) for s in (1.0, -1.0)]
    for n in [*axes, *rng.normal(size=(50, 3))]:
        n = n / np.linalg.norm(n)
        R = RotationMatrix.MakeFromOneVector(n, 0).matrix()
        np.testing.assert_allclose(tangent_basis(n, np.zeros(3)), R.T[1:], atol=1e-15)


def test_a_reference_direction_keeps_the_tangent_from_jumping():
    reference = np.array([1.0, 0.0, 0.0])
    for k in range(12):  # A normal that wobbles about the vertical by 0.05 rad.
        n = np.array([0.05 * np.cos(k), 0.05 * np.sin(k), 1.0])
        n /= np.linalg.norm(n)
        t1, t2 = tangent_basis(n, reference)
        np.testing.assert_allclose(np.cross(t1, t2), n, atol=1e-15)
        assert t1[0] > 0.99
    # Along the normal there is no projection: Drake's basis, not NaN.
    t1, t2 = tangent_basis(reference, reference)
    np.testing.assert_allclose(np.cross(t1, t2), reference, atol=1e-15)


def test_friction_edges_are_opposite_pairs_at_equal_angles():
    kinds = [(True, friction_edges(n), True, False) for n in (1, 3)]
    rows = contact_rows(kinds)
    np.testing.assert_array_equal(rows.contact, [0, 0, 1, 1, 1, 1, 1, 1])
    edge = rows.edge
    np.testing.assert_array_equal(edge[::2], -edge[1::2])
    angles = np.sort(np.arctan2(edge[2:, 1], edge[2:, 0]))
    np.testing.assert_allclose(np.diff(angles), np.pi / 3, atol=1e-12)


def test_eps_c_is_added_to_F_and_is_the_least_eigenvalue(ball_diagram, reference):
    x, u = reference["x_touch"], reference["u_touch"]
    plain = AnitescuLcs(ball_diagram, ball_pairs(), 0.05, 0.0).build(x, u)
    default = AnitescuLcs(ball_diagram, ball_pairs(), 0.05).build(x, u)
    np.testing.assert_allclose(default.F - plain.F, 5e-4 * np.eye(8), atol=1e-15)
    # Eight forces in six directions at most: singular without eps_c.
    assert np.linalg.eigvalsh(default.F)[0] == pytest.approx(5e-4, rel=1e-9)


def test_lam_is_in_newtons(ball_diagram):
    # A ball at rest on the table: every edge has a share of the normal, sum = m g.
    model = AnitescuLcs(ball_diagram, ball_pairs(), 0.05, 0.0)
    x = np.zeros(19)
    x[:4] = [-1.0, 0.0, 0.05, 1.0]
    x[BALL_Z] = 0.05
    x_next, lam = simulate(model.build(x, np.zeros(3)), x, [0.0, 0.0, 0.1 * G])
    assert lam.sum() == pytest.approx(0.2 * G, rel=1e-9)
    np.testing.assert_allclose(x_next[3:10], x[3:10], atol=1e-12)


# Fast path against general path.

SPHERES = """<sdf version="1.7"><world name="w">
  <model name="post"><static>true</static><link name="post">
    <pose>0.3 -0.2 0.1 0.4 0.5 -0.6</pose>
    <collision name="post"><geometry><box><size>.2 .3 .4</size></box></geometry>
    </collision></link></model>
  <model name="one"><link name="one"><inertial><mass>0.2</mass>
      <inertia><ixx>2e-4</ixx><iyy>2e-4</iyy><izz>2e-4</izz></inertia></inertial>
    <collision name="s"><pose>.01 -.02 .03 .1 .2 .3</pose>
      <geometry><sphere><radius>.05</radius></sphere></geometry></collision></link>
  </model>
  <model name="two"><link name="two"><inertial><mass>0.3</mass>
      <inertia><ixx>3e-4</ixx><iyy>3e-4</iyy><izz>3e-4</izz></inertia></inertial>
    <collision name="b"><pose>.02 .01 .01 .3 .1 .2</pose>
      <geometry><box><size>.1 .08 .06</size></box></geometry></collision></link></model>
  <model name="slide"><link name="s1"><pose>.1 .2 .3 .5 .1 .2</pose>
      <inertial><mass>.1</mass></inertial></link>
    <link name="s2"><pose>.1 .2 .35 -.4 .1 .9</pose><inertial><mass>.4</mass></inertial>
      <collision name="s"><pose>.03 0 .01 0 0 0</pose>
        <geometry><sphere><radius>.03</radius></sphere></geometry></collision></link>
    <joint name="j1" type="prismatic"><parent>world</parent><child>s1</child>
      <axis><xyz>1 2 .5</xyz><dynamics><damping>.7</damping></dynamics></axis></joint>
    <joint name="j2" type="prismatic"><parent>s1</parent><child>s2</child>
      <axis><xyz>0 1 -1</xyz><limit><effort>5</effort></limit></axis></joint></model>
</world></sdf>"""


def add_slope(plant):
    X = RigidTransform(RotationMatrix.MakeXRotation(0.3), [0.0, 0.0, -0.4])
    plant.RegisterCollisionGeometry(
        plant.world_body(), X, HalfSpace(), "slope", CoulombFriction(1.0, 1.0)
    )


UNEVEN = (  # Of the body "two": three moments, products, and a centre of mass.
    SPHERES.replace(
        "<ixx>3e-4</ixx><iyy>3e-4</iyy><izz>3e-4</izz>",
        "<ixx>3e-4</ixx><iyy>5e-4</iyy><izz>4e-4</izz><ixy>4e-5</ixy><iyz>3e-5</iyz>",
    ).replace("<mass>0.3</mass>", "<pose>.02 -.03 .01 .3 .2 .1</pose><mass>0.3</mass>")
)
CYLINDER = UNEVEN.replace(
    "<box><size>.1 .08 .06</size></box>",
    "<cylinder><radius>.04</radius><length>.1</length></cylinder>",
)


@pytest.mark.parametrize("text", [SPHERES, UNEVEN, CYLINDER])
def test_the_fast_path_agrees_with_the_general_one_at_random_states(text):
    diagram = diagram_of(text, add_slope)
    pairs = [
        ContactPair("one", "slide::s2", 0.3),
        ContactPair("one", "post", 0.7, 3),
        ContactPair("one", "two", 0.5, 1, [1.0, 0.5, 0.0]),
        ContactPair("two", "slide::s2", 0.4),
        ContactPair("one", "world", 0.6),
        ContactPair("slide::s2", "world", 0.2),
    ]
    fast = AnitescuLcs(diagram, pairs, 0.05)
    general = AnitescuLcs(diagram, pairs, 0.05, analytic=False)
    assert fast.is_analytic and not general.is_analytic
    rng = np.random.default_rng(0)
    quaternions = [k for k in range(fast.n_q) if fast.x_default[k] == 1.0]
    deep = 0
    for _ in range(40):
        x = random_state(rng, fast.x_default, quaternions)
        if rng.random() < 0.5:  # The ball "one" around and inside the post.
            first = fast.x_names.index("one_one_x")
            x[first : first + 3] = [0.3, -0.2, 0.1] + 0.08 * rng.normal(size=3)
        else:  # And around the body "two", whose sphere meets it at its sides and ends.
            first, two = (fast.x_names.index(f"{n}_{n}_x") for n in ("one", "two"))
            x[first : first + 3] = x[two : two + 3] + 0.08 * rng.normal(size=3)
        u = rng.normal(size=fast.n_u)
        one, other = fast.build(x, u), general.build(x, u)
        deep += one.phi.min() < -0.06  # More than the radius.
        for name in (*MATRICES, "phi"):
            a, b = getattr(one, name), getattr(other, name)
            # Rounding: 1e-16 of the largest entry, through a few dozen sums.
            np.testing.assert_allclose(a, b, atol=1e-13 * max(1.0, np.abs(b).max()))
    assert deep > 5  # The ball's centre was inside the box too.


# The general path against the plant itself.

ARM = """<sdf version="1.7" xmlns:drake="http://drake.mit.edu"><world name="w">
  <model name="arm">
    <link name="l1"><pose>0 0 .2 0 .3 0</pose><inertial><pose>.01 .02 .1 0 0 0</pose>
      <mass>1.2</mass><inertia><ixx>.02</ixx><iyy>.03</iyy><izz>.015</izz>
      <ixy>.002</ixy></inertia></inertial></link>
    <link name="l2"><pose>.1 0 .5 .2 .3 .1</pose><inertial><pose>0 .01 .1 0 0 0</pose>
      <mass>.7</mass><inertia><ixx>.01</ixx><iyy>.012</iyy><izz>.004</izz></inertia>
      </inertial>
      <collision name="tip"><pose>0 0 .3 0 0 0</pose><geometry><{tip}></geometry>
      </collision></link>
    <joint name="j1" type="revolute"><parent>world</parent><child>l1</child>
      <axis><xyz>0 .6 .8</xyz><dynamics><damping>.3</damping></dynamics></axis></joint>
    <joint name="j2" type="revolute"><parent>l1</parent><child>l2</child>
      <axis><xyz>0 1 0</xyz></axis><drake:rotor_inertia>.002</drake:rotor_inertia>
      <drake:gear_ratio>4</drake:gear_ratio></joint></model>
  <model name="object"><link name="object"><pose>.4 .1 .9 0 0 0</pose>
    <inertial><pose>.01 .02 -.01 0 0 0</pose><mass>.5</mass>
      <inertia><ixx>.001</ixx><iyy>.002</iyy><izz>.0015</izz></inertia></inertial>
    <collision name="c"><geometry><{object}></geometry></collision></link></model>
</world></sdf>"""
SPHERE = "sphere><radius>.04</radius></sphere"
BOX = "box><size>.1 .12 .08</size></box"
CAPSULE = "capsule><radius>.03</radius><length>.1</length></capsule"


class Arm:
    """The two-link arm, an object with an uneven inertia, and the plant as truth."""

    def __init__(self, tip=SPHERE, target=SPHERE, time_step=0.0):
        text = ARM.format(tip=tip, object=target)
        self.diagram = diagram_of(text, time_step=time_step)
        self.plant = self.diagram.GetSubsystemByName("plant")
        self.scene_graph = self.diagram.GetSubsystemByName("scene_graph")
        self.context = self.diagram.CreateDefaultContext()
        self.own = self.plant.GetMyContextFromRoot(self.context)
        self.pairs = [ContactPair("l2", "object", 0.6)]
        self.port = self.plant.get_applied_spatial_force_input_port()

    def acceleration(self, x, u, forces=()):
        self.plant.SetPositionsAndVelocities(self.own, x)
        self.plant.get_actuation_input_port().FixValue(self.own, u)
        self.port.FixValue(self.own, list(forces))
        return self.plant.EvalTimeDerivatives(self.own).CopyToVector()[9:]

    def step(self, x, u, dt):
        """The discrete step without contact; x = [q 9, v 8], N taken at x."""
        v_next = x[9:] + dt * self.acceleration(x, u)
        return np.hstack([x[:9] + dt * self.N(x) @ v_next, v_next])

    def N(self, x):
        self.plant.SetPositionsAndVelocities(self.own, x)
        return self.plant.MakeVelocityToQDotMap(self.own).toarray()

    def distance(self, x):
        self.plant.SetPositionsAndVelocities(self.own, x)
        query = self.plant.get_geometry_query_input_port().Eval(self.own)
        ids = query.inspector().GetAllGeometryIds()
        return query.ComputeSignedDistancePairClosestPoints(ids[0], ids[1])

    def world_points(self, pair):
        inspector = self.scene_graph.model_inspector()
        points = []
        for id, p in ((pair.id_A, pair.p_ACa), (pair.id_B, pair.p_BCb)):
            frame = self.plant.GetBodyFromFrameId(inspector.GetFrameId(id)).body_frame()
            X_WF = frame.CalcPoseInWorld(self.own)
            points.append((frame.body(), X_WF @ inspector.GetPoseInFrame(id) @ p))
        return points


def arm_state(rng):
    x = rng.normal(size=17) * 0.5
    x[2:6] /= np.linalg.norm(x[2:6])
    x[6:9] = [0.4, 0.1, 1.6]  # Clear of the arm, so that the plant feels no contact.
    return x


@pytest.fixture(scope="module")
def arm():
    return Arm()


def test_A_and_B_are_the_derivatives_of_the_true_step(arm):
    dt, rng = 0.05, np.random.default_rng(0)
    model = AnitescuLcs(arm.diagram, arm.pairs, dt)
    assert not model.is_analytic and model.n_u == 2
    for _ in range(5):
        x, u = arm_state(rng), rng.normal(size=model.n_u)
        lcs = model.build(x, u)
        N, h = arm.N(x), 1e-6
        x_next = lcs.A @ x + lcs.B @ u + lcs.d
        np.testing.assert_allclose(x_next, arm.step(x, u, dt), atol=1e-12)
        for k in range(model.n_u):  # The step is linear in u.
            dx = arm.step(x, u + np.eye(model.n_u)[k], dt) - arm.step(x, u, dt)
            np.testing.assert_allclose(lcs.B[:, k], dx, atol=1e-12)
        for k in range(17):
            e = h * np.eye(17)[k]
            plus, minus = (
                x[9:] + s[9:] + dt * arm.acceleration(x + s, u) for s in (e, -e)
            )
            dv = (plus - minus) / (2 * h)
            dq = np.eye(17)[k][:9] + dt * N @ dv  # N frozen at x.
            # Central differences: h^2 times the third derivative, and 1e-16/h.
            np.testing.assert_allclose(lcs.A[:, k], [*dq, *dv], atol=1e-7)


def test_E_and_H_carry_the_gap_and_the_velocity_after_the_step():
    # w = gap(q)/dt + J_c v_next, where only the first term and v_next depend on x.
    arm = Arm(SPHERE, BOX)  # A box: the gap depends on the quaternion too.
    dt, rng = 0.05, np.random.default_rng(1)
    model = AnitescuLcs(arm.diagram, arm.pairs, dt, 0.0)
    x, u, h = arm_state(rng), rng.normal(size=model.n_u), 1e-6
    lcs = model.build(x, u)
    J_c = np.linalg.lstsq(
        np.linalg.inv(mass_matrix(arm, x)), lcs.D[9:] / dt, rcond=None
    )[0].T
    w = lcs.E @ x + lcs.H @ u + lcs.c
    gap = arm.distance(x).distance
    assert lcs.phi == pytest.approx([gap] * 4, abs=1e-12)
    v_next = arm.step(x, u, dt)[9:]
    np.testing.assert_allclose(w, gap / dt + J_c @ v_next, atol=1e-9)
    for k in range(17):
        e = h * np.eye(17)[k]
        ends = [
            arm.distance(x + s).distance / dt
            + J_c @ (x[9:] + s[9:] + dt * arm.acceleration(x + s, u))
            for s in (e, -e)
        ]
        slope = (ends[0] - ends[1]) / (2 * h)
        np.testing.assert_allclose(lcs.E[:, k], slope, atol=1e-5)  # |w| ~ 10.


def mass_matrix(arm, x):
    arm.plant.SetPositionsAndVelocities(arm.own, x)
    return arm.plant.CalcMassMatrix(arm.own)


@pytest.mark.parametrize(
    "tip, target", [(SPHERE, SPHERE), (BOX, SPHERE), (CAPSULE, SPHERE), (BOX, CAPSULE)]
)
def test_a_force_accelerates_as_the_same_force_pair_applied_to_the_plant(tip, target):
    arm = Arm(tip, target)
    dt, mu, rng = 0.05, 0.6, np.random.default_rng(2)
    model = AnitescuLcs(arm.diagram, arm.pairs, dt)
    x, u = arm_state(rng), rng.normal(size=model.n_u)
    lcs = model.build(x, u)
    free, pair = arm.acceleration(x, u), arm.distance(x)
    n, t1, t2 = RotationMatrix.MakeFromOneVector(pair.nhat_BA_W, 0).matrix().T
    for k, t in enumerate((t1, -t1, t2, -t2)):
        forces = []
        for (body, p_W), sign in zip(arm.world_points(pair), (1.0, -1.0), strict=True):
            force = ExternallyAppliedSpatialForce()
            force.body_index = body.index()
            X_WB = arm.plant.EvalBodyPoseInWorld(arm.own, body)
            force.p_BoBq_B = X_WB.inverse() @ p_W
            force.F_Bq_W = SpatialForce(np.zeros(3), sign * (n + mu * t))
            forces.append(force)
        pushed = arm.acceleration(x, u, forces)
        # D is dt times the acceleration per newton; accelerations are near 100.
        np.testing.assert_allclose(lcs.D[9:, k] / dt, pushed - free, atol=1e-9)


def test_a_discrete_plant_gives_the_lcs_of_a_continuous_one():
    arm = Arm()
    # A discrete plant gives the same LCS: only its model is asked, not its steps.
    discrete = Arm(time_step=0.001)
    x, u = arm_state(np.random.default_rng(3)), np.array([1.0, -2.0])
    one = AnitescuLcs(arm.diagram, arm.pairs, 0.05).build(x, u)
    other = AnitescuLcs(discrete.diagram, discrete.pairs, 0.05).build(x, u)
    np.testing.assert_allclose(one.A, other.A, atol=1e-12)
    np.testing.assert_allclose(one.d, other.d, atol=1e-12)


# Along a horizon.


def test_a_falling_ball_rolled_out_through_one_lcs_lands_at_the_right_step(
    ball_diagram,
):
    # Semi-implicit Euler: after k steps the gap is h - G dt^2 k (k + 1)/2. The force
    # acts from the step in which that would turn negative, and stops the ball at 0.
    h, dt = 0.2, 0.02
    model = AnitescuLcs(ball_diagram, ball_pairs(), dt, 0.0)
    x = np.zeros(19)
    x[:4], x[BALL_Z] = [-1.0, 0.0, 0.5, 1.0], 0.05 + h
    u = [0.0, 0.0, 0.1 * G]
    lcs = model.build(x, u)  # One linearisation for the whole horizon.
    k = np.arange(1, 15)
    free = h - G * dt**2 * k * (k + 1) / 2
    for gap in free:
        x, lam = simulate(lcs, x, u)
        assert x[BALL_Z] - 0.05 == pytest.approx(max(gap, 0.0), abs=1e-12)
        assert (lam.sum() > 0.0) == (gap < 0.0)
    assert (free < 0.0).any() and (free > 0.0).any()


def test_a_pushed_ball_rolls_through_the_lcs():
    # Finger on top of the ball, moving at s: a ball that rolls without slip goes s/2
    # and turns s/(2 R). (Friction 1 and eps_c keep it from slipping in 20 steps.)
    diagram = diagram_of(SDF)
    model = AnitescuLcs(diagram, ball_pairs(1.0), 0.01)
    x = np.zeros(19)
    x[:4], x[BALL_Z] = [0.0, 0.0, 0.12, 1.0], 0.05
    for _ in range(20):
        # 0.5 N down beyond its weight, and a stiff servo to 0.05 m/s along x.
        u = [2.0 * (0.05 - x[10]), -2.0 * x[11], 0.1 * G - 0.5]
        x, _ = simulate(model.build(x, u), x, u)
        x[3:7] /= np.linalg.norm(x[3:7])
    v_finger, omega_y, v_ball = x[10], x[14], x[16]
    assert v_finger > 0.02
    # The friction edges are soft by eps_c, and the contact lags by one step.
    assert v_ball == pytest.approx(v_finger / 2, rel=0.05)
    assert omega_y == pytest.approx(v_ball / 0.05, rel=0.05)


# Quaternions.


def test_position_rows_integrate_the_quaternion_to_first_order(ball_diagram):
    model = AnitescuLcs(ball_diagram, ball_pairs(), 1e-3)
    rng = np.random.default_rng(4)
    x = random_state(rng, model.x_default)
    x[BALL_Z] = 1.0
    x[13:16] = [1.0, -2.0, 0.5]
    lcs = model.build(x, np.zeros(3))
    x_next = lcs.A @ x + lcs.d
    w, q = 1e-3 * x[13:16], x[3:7]  # omega in the world: q_next = exp(w/2) q.
    angle = np.linalg.norm(w)
    p = np.array([np.cos(angle / 2), *np.sin(angle / 2) * w / angle])
    exact = np.array(
        [p[0] * q[0] - p[1:] @ q[1:]]
        + [*(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))]
    )
    np.testing.assert_allclose(x_next[3:7], exact, atol=angle**2)


@pytest.mark.parametrize("analytic", [True, False])
def test_a_quaternion_is_normalised(ball_diagram, analytic):
    model = AnitescuLcs(ball_diagram, ball_pairs(), 0.05, analytic=analytic)
    x = random_state(np.random.default_rng(5), model.x_default)
    scaled = x.copy()
    scaled[3:7] *= 1.3
    one, other = (model.build(y, np.zeros(3)) for y in (x, scaled))
    for name in MATRICES:
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-12)
    assert scaled[3:7] @ scaled[3:7] == pytest.approx(1.69)  # The input is untouched.


@pytest.mark.parametrize("factor", [0.0, 0.1, 10.0])
def test_a_quaternion_that_is_none_is_refused(ball_diagram, factor):
    model = AnitescuLcs(ball_diagram, ball_pairs(), 0.05)
    x = model.x_default.copy()
    x[3:7] *= factor
    with pytest.raises(ValueError, match=r"quaternion x\[3:7\] has norm"):
        model.build(x, np.zeros(3))


# Bad input.


def test_a_name_that_does_not_exist_is_refused_with_the_nearest(ball_diagram):
    with pytest.raises(ValueError, match="named 'bal_link'; nearest: .*ball_link"):
        AnitescuLcs(ball_diagram, [ContactPair("bal_link", "table_link")])


def test_a_body_without_collision_geometry_is_refused(ball_diagram):
    with pytest.raises(ValueError, match="'fx' has no collision geometry"):
        AnitescuLcs(ball_diagram, [ContactPair("fx", "ball_link")])


def test_an_ambiguous_name_is_refused_with_the_scoped_ones():
    two = SDF.replace('<model name="ball">', '<model name="b2">', 1)
    model = two[two.index('<model name="b2">') :].split("</model>")[0] + "</model>"
    diagram = diagram_of(SDF.replace("</world>", model + "</world>"))
    with pytest.raises(ValueError, match="ball::ball_link.*b2::ball_link|b2::ball_l"):
        AnitescuLcs(diagram, [ContactPair("ball_link", "table_link")])
    AnitescuLcs(diagram, [ContactPair("b2::ball_link", "ball::ball_link")])


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(friction=-0.1), "friction is -0.1"),
        (dict(friction=np.nan), "friction is nan"),
        (dict(friction_directions=0), "friction_directions is 0"),
        (dict(friction_directions=1.5), "friction_directions is 1.5"),
        (dict(tangent=[1.0]), "tangent is"),
        (dict(anisotropy=2.0), "anisotropy is 2.0, expected .* 1 without a tangent"),
        (dict(anisotropy=-1.0, tangent=[0.0, 0.0, 1.0]), "anisotropy is -1.0"),
        (dict(b="ball_link"), "same body"),
    ],
)
def test_a_bad_pair_is_refused(ball_diagram, change, message):
    pair = ContactPair("ball_link", "table_link")
    for name, value in change.items():
        setattr(pair, name, value)
    with pytest.raises(ValueError, match=message):
        AnitescuLcs(ball_diagram, [pair])


@pytest.mark.parametrize("analytic", [True, False])
def test_friction_may_differ_along_a_direction(ball_diagram, analytic):
    def pushes(anisotropy):
        pair = ContactPair("ball_link", "table_link", 0.5, tangent=[1.0, 0.0, 0.0])
        pair.anisotropy = anisotropy
        return AnitescuLcs(ball_diagram, [pair], analytic=analytic).at_default().J

    even, uneven = pushes(1.0), pushes(3.0)
    along, across = even[0] - even[1], even[2] - even[3]
    np.testing.assert_allclose(uneven[0] - uneven[1], 3.0 * along, atol=1e-12)
    np.testing.assert_allclose(uneven[2] - uneven[3], across, atol=1e-12)
    np.testing.assert_allclose(uneven.sum(axis=0), even.sum(axis=0), atol=1e-12)


def test_bad_parameters_are_refused(ball_diagram):
    for dt in (0.0, -0.1, np.nan):
        with pytest.raises(ValueError, match="dt_sec is"):
            AnitescuLcs(ball_diagram, ball_pairs(), dt)
    with pytest.raises(ValueError, match="eps_c is -1"):
        AnitescuLcs(ball_diagram, ball_pairs(), 0.1, -1.0)
    with pytest.raises(ValueError, match="no contact pairs"):
        AnitescuLcs(ball_diagram, [])
    with pytest.raises(ValueError, match="expected the Diagram"):
        AnitescuLcs(MultibodyPlant(0.0), ball_pairs())


def test_a_plant_that_is_not_finalized_is_refused():
    builder = DiagramBuilder()
    AddMultibodyPlantSceneGraph(builder, 0.0)
    with pytest.raises((ValueError, RuntimeError), match="[Ff]inalize"):
        AnitescuLcs(builder.Build(), ball_pairs())


def test_wrong_sizes_and_nan_are_refused(ball_diagram):
    model = AnitescuLcs(ball_diagram, ball_pairs())
    x, u = model.x_default, np.zeros(3)
    with pytest.raises(ValueError, match=r"x is \(18,\)"):
        model.build(x[1:], u)
    with pytest.raises(ValueError, match="not finite"):
        model.build(np.where(np.arange(19) == 4, np.nan, x), u)
    with pytest.raises(ValueError, match="not finite"):
        model.build(x, [0.0, np.inf, 0.0])


def test_shapes_without_a_distance_are_refused_by_name():
    with pytest.raises(ValueError, match="no signed distance of Box and HalfSpace"):
        AnitescuLcs(diagram_of(SPHERES, add_slope), [ContactPair("two", "world")])


def test_what_an_lcs_cannot_hold_is_refused():
    def constrain(plant):
        p = np.zeros(3)
        a, b = plant.GetBodyByName("ball_link"), plant.GetBodyByName("fx")
        plant.AddBallConstraint(a, p, b, p)

    with pytest.raises(ValueError, match="1 constraints"):
        AnitescuLcs(diagram_of(SDF, constrain, 0.001), ball_pairs())


def test_an_actuator_with_a_pd_controller_is_refused():
    def control(plant):
        gains = PdControllerGains(p=1.0, d=1.0)
        plant.GetJointActuatorByName("jx").set_controller_gains(gains)

    with pytest.raises(ValueError, match="jx has a PD controller"):
        AnitescuLcs(diagram_of(SDF, control, 0.001), ball_pairs())


def test_a_plant_without_actuators_has_no_input():
    text = SDF.replace("<effort>20</effort>", "<effort>0</effort>")
    model = AnitescuLcs(diagram_of(text), ball_pairs())
    assert model.build(model.x_default, np.zeros(0)).B.shape == (19, 0)
    assert model.is_analytic


def test_a_plant_without_actuators_is_refused_by_the_planner():
    diagram = diagram_of(SDF.replace("<effort>20</effort>", "<effort>0</effort>"))
    config = ContactMpcConfig(ball_pairs(), [1.0] * 19, [], [0.0] * 19)
    with pytest.raises(ValueError, match="has no actuators, expected at least one"):
        make_contact_mpc(diagram, config)


# Where the fast path must not be taken.


@pytest.mark.parametrize("what", ["spring", "welded", "revolute"])
def test_a_model_that_is_not_constant_takes_the_general_path(what):
    text, extend = SDF, None
    if what == "revolute":
        text = SDF.replace('name="jx" type="prismatic"', 'name="jx" type="revolute"')

    def add(plant):
        ball, table = (plant.GetBodyByName(n) for n in ("ball_link", "table_link"))
        if what == "spring":
            p = np.zeros(3)
            plant.AddForceElement(LinearSpringDamper(ball, p, table, p, 0.1, 9.0, 1.0))
        if what == "welded":
            inertia = SpatialInertia.SolidSphereWithMass(0.1, 0.01)
            extra = plant.AddRigidBody("extra", ball.model_instance(), inertia)
            at = plant.AddFrame(
                FixedOffsetFrame("at", ball.body_frame(), RigidTransform([0.1, 0, 0]))
            )
            plant.WeldFrames(at, extra.body_frame())

    extend = add if what in ("spring", "welded") else None
    assert not AnitescuLcs(diagram_of(text, extend), ball_pairs()).is_analytic


def test_a_damped_floating_joint_is_linearised_right():
    # Drag on a body with a centre of mass and three moments is not constant in its
    # orientation: the fast path, which took it for constant, had an A wrong by 10 %.
    def add(plant):
        two = plant.GetBodyByName("two").body_frame()
        joint = QuaternionFloatingJoint("drag", plant.world_frame(), two, 0.4, 0.4)
        plant.AddJoint(joint)

    diagram, pairs = diagram_of(UNEVEN, add), [ContactPair("one", "two", 0.5)]
    model = AnitescuLcs(diagram, pairs, 0.05)
    general = AnitescuLcs(diagram, pairs, 0.05, analytic=False)
    quaternions = [k for k in range(model.n_q) if model.x_default[k] == 1.0]
    x = random_state(np.random.default_rng(0), model.x_default, quaternions)
    u = np.zeros(model.n_u)
    np.testing.assert_allclose(
        model.build(x, u).A, general.build(x, u).A, atol=1e-12
    )  # Rounding, of entries of about 1.


# The system.


def system_of(ball_diagram, dt_sec=0.05, period_sec=0.0125):
    config = LcsBuilderConfig(ball_pairs(), dt_sec, period_sec=period_sec)
    return AnitescuLcsBuilder(ball_diagram, config)


def run_with(systems, x, u):
    builder = DiagramBuilder()
    sources = [builder.AddSystem(ConstantVectorSource(value)) for value in (x, u)]
    for system in systems:
        builder.AddSystem(system)
        for source, name in zip(sources, ("x", "u"), strict=True):
            builder.Connect(source.get_output_port(), system.GetInputPort(name))
    return Simulator(builder.Build())


def outputs(simulator, system):
    context = system.GetMyContextFromRoot(simulator.get_context())
    lcs = system.GetOutputPort("lcs").Eval(context)
    return lcs, system.GetOutputPort("status").Eval(context)[0]


def test_the_port_starts_with_the_default_state_and_then_follows_x(
    ball_diagram, reference
):
    system = system_of(ball_diagram)
    x, u = reference["x_touch"], reference["u_touch"]
    simulator = run_with([system], x, u)
    lcs, status = outputs(simulator, system)
    default = system.model.build(system.model.x_default, np.zeros(3))
    np.testing.assert_array_equal(lcs.c, default.c)
    assert status == 1.0
    simulator.AdvanceTo(0.001)
    lcs, status = outputs(simulator, system)
    np.testing.assert_array_equal(lcs.c, system.model.build(x, u).c)
    assert status == 1.0 and lcs.dt == 0.05


@pytest.mark.parametrize("bad", [np.nan, np.inf, "quaternion"])
def test_a_bad_state_holds_the_last_lcs_and_says_so(ball_diagram, reference, bad):
    system = system_of(ball_diagram)
    x = reference["x_touch"].copy()
    if bad == "quaternion":
        x[3:7] = 0.0
    else:
        x[0] = bad
    simulator = run_with([system], x, np.zeros(3))
    before, _ = outputs(simulator, system)
    simulator.AdvanceTo(0.03)
    after, status = outputs(simulator, system)
    assert status == 0.0
    np.testing.assert_array_equal(after.c, before.c)
    assert np.isfinite(after.c).all()


def test_three_builders_in_one_diagram_do_not_disturb_each_other(
    ball_diagram, reference
):
    x, u = reference["x_touch"], reference["u_touch"]
    times = (0.1, 0.05, 0.0125)
    systems = [system_of(ball_diagram, dt, 0.01) for dt in times]
    simulator = run_with(systems, x, u)
    simulator.AdvanceTo(0.025)
    for dt, system in zip(times, systems, strict=True):
        lcs, _ = outputs(simulator, system)
        alone = AnitescuLcs(ball_diagram, ball_pairs(), dt).build(x, u)
        assert lcs.dt == dt
        np.testing.assert_array_equal(lcs.E, alone.E)
        np.testing.assert_array_equal(lcs.F, alone.F)


# A plant in a plane, and spheres against meshes.

IN_PLANE = """
<sdf version='1.7'><model name='slider'>
  <link name='base'/>
  <joint name='weld' type='fixed'><parent>world</parent><child>base</child></joint>
  <link name='mid'><inertial><mass>0.001</mass></inertial></link>
  <link name='ball'><inertial><mass>1</mass></inertial>
    <collision name='c'><geometry><sphere><radius>0.1</radius></sphere></geometry>
    </collision></link>
  <joint name='x' type='prismatic'><parent>base</parent><child>mid</child>
    <axis><xyz>1 0 0</xyz></axis></joint>
  <joint name='z' type='prismatic'><parent>mid</parent><child>ball</child>
    <axis><xyz>0 0 1</xyz></axis></joint>
</model></sdf>"""


def add_ground(plant):
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform(), HalfSpace(), "ground", CoulombFriction()
    )


@pytest.mark.parametrize("analytic", [True, False])
def test_friction_of_a_planar_plant_lies_in_its_plane(analytic):
    """A ball on the ground in the x-z plane that slides along x: friction is mu N
    against the motion, as on paper."""
    pair = ContactPair("ball", "world", 0.4, 1, plane_normal=[0.0, 2.0, 0.0])
    diagram = diagram_of(IN_PLANE, add_ground)
    model = AnitescuLcs(diagram, [pair], 0.01, 0.0, analytic)
    assert model.is_analytic == analytic
    x = np.array([0.0, 0.1, 0.3, 0.0])
    lcs = model.build(x, np.zeros(model.n_u))
    x_next, lam = simulate(lcs, x, np.zeros(model.n_u))
    # Anitescu's contact separates by dt mu |v_t|; N then carries that velocity too:
    # v_z = mu v_x and m v_z = dt (N - m g), m v_x = m .3 - dt mu N.
    m, mu, dt = 1.001, 0.4, 0.01
    # The ball alone moves along z; along x the middle link's gram moves with it.
    m_z = 1.0
    A = np.array([[m, dt * mu], [-mu * m_z, dt]])
    v_x, N = np.linalg.solve(A, [m * 0.3, dt * m_z * G])
    np.testing.assert_allclose(lam.sum(), N, rtol=1e-9)
    np.testing.assert_allclose(x_next[2:], [v_x, mu * v_x], rtol=1e-9)


def test_one_friction_direction_without_a_direction_is_refused():
    diagram = diagram_of(IN_PLANE, add_ground)
    with pytest.raises(
        ValueError, match="friction_directions is 1 without a direction"
    ):
        AnitescuLcs(diagram, [ContactPair("ball", "world", 0.4, 1)])
    AnitescuLcs(diagram, [ContactPair("ball", "world", 0.0, 1)])  # No friction at all.
    pair = ContactPair("ball", "world", 0.4, 1, plane_normal=[0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="leaves the plane of plane_normal"):
        AnitescuLcs(diagram, [pair])
    pair = ContactPair("ball", "world", 0.4, 1, [1, 0, 0], [0, 1, 0])
    with pytest.raises(ValueError, match="tangent and plane_normal came"):
        AnitescuLcs(diagram, [pair])


VERTICES = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
TETRAHEDRON = """v 0 0 0
v .1 0 0
v 0 .1 0
v 0 0 .1
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""


def sphere_and_tetrahedron(tmp_path, sphere_first=True):
    """A free sphere of radius .05 and a tetrahedron in the world, as Convex."""
    path = tmp_path / "tetrahedron.obj"
    path.write_text(TETRAHEDRON)

    def extend(plant):
        def hull():
            plant.RegisterCollisionGeometry(
                plant.world_body(), RigidTransform([0.0, 0.0, 0.2]),
                Convex(str(path), 1.0), "hull", CoulombFriction(),
            )  # fmt: skip

        if not sphere_first:
            hull()
        inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.05)
        body = plant.AddRigidBody("sphere", inertia)
        plant.RegisterCollisionGeometry(
            body, RigidTransform(), Sphere(0.05), "s", CoulombFriction()
        )
        if sphere_first:
            hull()

    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    extend(plant)
    plant.Finalize()
    return builder.Build()


@pytest.mark.parametrize("sphere_first", [True, False])
def test_a_sphere_whose_centre_is_on_a_vertex_has_a_distance(tmp_path, sphere_first):
    diagram = sphere_and_tetrahedron(tmp_path, sphere_first)
    model = AnitescuLcs(diagram, [ContactPair("sphere", "hull")])
    x = np.zeros(13)
    x[0] = 1.0
    rng = np.random.default_rng(0)
    for vertex in VERTICES:
        for size in (0.0, 1e-12, 1e-7, 1e-5):
            x[4:7] = vertex + [0.0, 0.0, 0.2] + size * rng.normal(size=3)
            phi = model.build(x, np.zeros(model.n_u)).phi
            # Within `size` of the surface; a distance changes no faster than the point.
            np.testing.assert_allclose(phi, -0.05, atol=4.0 * size + 1e-12)


@pytest.mark.parametrize("sphere_first", [True, False])
def test_a_sphere_beside_a_hull_agrees_with_drake(tmp_path, sphere_first):
    """Where Drake's iteration ends: outside, and well away from vertices."""
    diagram = sphere_and_tetrahedron(tmp_path, sphere_first)
    plant = diagram.GetSubsystemByName("plant")
    inspector = diagram.GetSubsystemByName("scene_graph").model_inspector()
    layout = ContactLayout(
        [ContactPair("sphere", "hull")], plant, inspector, None, 0.1, 0.0
    )
    points = WitnessPoints(plant, inspector, layout)
    context = diagram.CreateDefaultContext()
    plant_context = plant.GetMyContextFromRoot(context)
    query = plant.get_geometry_query_input_port().Eval(plant_context)
    rng, x = np.random.default_rng(1), np.zeros(13)
    x[0] = 1.0
    for _ in range(40):
        x[4:7] = [0.03, 0.03, 0.23] + 0.15 * rng.normal(size=3)
        plant.SetPositionsAndVelocities(plant_context, x)
        id_A, id_B = layout.geometries[0]
        drakes = query.ComputeSignedDistancePairClosestPoints(id_A, id_B)
        if drakes.distance < 0.001:
            continue
        gap, n, p_A, p_B = points.distance(query, id_A, id_B)
        # The hull's nearest point by non-negative least squares: weights of the
        # vertices, their sum held at one by a heavy row (1e-8 of its weight squared).
        p = x[4:7] - [0.0, 0.0, 0.2]
        weights, _ = nnls(np.vstack([VERTICES.T, [1e4] * 4]), [*p, 1e4])
        assert gap == pytest.approx(
            np.linalg.norm(p - weights @ VERTICES) - 0.05, abs=1e-8
        )
        # Drake's iteration ends up to 2e-5 m too far away; in direction that is
        # sqrt(2 2e-5 / .05) = .03 at .05 m from the centre, along the surface 1.4 mm.
        assert drakes.distance - 3e-5 < gap < drakes.distance + 1e-6
        np.testing.assert_allclose(n, drakes.nhat_BA_W, atol=0.03)
        np.testing.assert_allclose(p_A, drakes.p_ACa, atol=2e-3)
        np.testing.assert_allclose(p_B, drakes.p_BCb, atol=2e-3)


LYING = """<sdf version="1.9"><world name="w">
  <model name="table"><static>true</static><link name="table">
    <collision name="top"><pose>0 0 -.5 0 0 0</pose>
      <geometry><box><size>4 4 1</size></box></geometry></collision></link></model>
  <model name="object"><link name="object"><pose>0 0 .05 1.5707963267948966 0 .3</pose>
    <inertial><mass>1</mass></inertial>
    <collision name="c"><geometry><{shape}><radius>.05</radius><length>.1</length>
      </{shape}></geometry></collision></link></model></world></sdf>"""


@pytest.mark.parametrize("shape", ["cylinder", "capsule"])
@pytest.mark.parametrize("gap", [0.0, 1e-13, -1e-12])
def test_shapes_that_just_touch_have_a_normal(shape, gap):
    # Drake's is a difference of witness points over the distance, here 1e-16 over 0.
    diagram = diagram_of(LYING.format(shape=shape))
    model = AnitescuLcs(diagram, [ContactPair("object", "table", 0.5)])
    x = model.x_default.copy()
    x[6] += gap
    lcs = model.build(x, np.zeros(0))
    np.testing.assert_allclose(lcs.phi, gap, atol=1e-11)
    np.testing.assert_allclose(lcs.J.mean(axis=0)[3:], [0, 0, 1], atol=1e-6)


# Other contact models: Stewart's and Trinkle's, a given stiffness, and mixtures.


def slider(dt, eps_c=0.0, analytic=True, **pair):
    """A ball of 1 kg in the x-z plane above the ground; 1 g more moves along x."""
    pair = {"plane_normal": [0.0, 1.0, 0.0], **pair}
    pairs = [ContactPair("ball", "world", 0.4, 1, **pair)]
    return AnitescuLcs(diagram_of(IN_PLANE, add_ground), pairs, dt, eps_c, analytic)


@pytest.mark.parametrize("analytic", [True, False])
@pytest.mark.parametrize("v_x", [0.3, -0.3, 0.02])
def test_a_sliding_ball_is_slowed_by_mu_N_and_does_not_open(v_x, analytic):
    m, m_z, mu, dt = 1.001, 1.0, 0.4, 0.01
    model = slider(dt, analytic=analytic, contact_model=StewartTrinkle())
    assert model.is_analytic == analytic
    assert [name.split(" ", 1)[1] for name in model.lam_names] == [
        "normal",
        "edge 0",
        "edge 1",
        "sliding speed",
    ]
    x = np.array([0.0, 0.1, v_x, 0.0])
    x_next, lam = simulate(model.build(x, np.zeros(model.n_u)), x, np.zeros(model.n_u))
    # On paper: N = m g, v_x loses dt mu N / m, and stops where that is more than it.
    N = m_z * G
    left = max(abs(v_x) - dt * mu * N / m, 0.0) * np.sign(v_x)
    assert (left == 0.0) == (abs(v_x) == 0.02)
    np.testing.assert_allclose(x_next, [dt * left, 0.1, left, 0.0], atol=1e-12)
    friction = m * (abs(v_x) - abs(left)) / dt
    np.testing.assert_allclose([lam[0], abs(lam[1] - lam[2])], [N, friction], rtol=1e-9)
    assert lam[3] == pytest.approx(abs(left), abs=1e-12)


def forces_of(lam, names):
    """Normal force, friction forces and sliding speed of a Stewart-Trinkle contact."""
    edges = [k for k, name in enumerate(names) if " edge " in name]
    return lam[0], lam[edges], lam[-1]


@pytest.mark.parametrize("seed", range(12))
def test_a_step_obeys_coulombs_law_with_the_plants_own_jacobians(ball_diagram, seed):
    """The conditions of Coulomb friction, with normal and tangents from Drake."""
    mu, dt, rng = 0.5, 0.05, np.random.default_rng(seed)
    pair = ContactPair("ball_link", "table_link", mu, 2, contact_model=StewartTrinkle())
    model = AnitescuLcs(ball_diagram, [pair], dt, 0.0)
    x = random_state(rng, model.x_default)
    x[:3] = [-2.0, 0.0, 1.0]
    x[BALL_Z] = 0.05 + rng.uniform(0.0, 0.02)
    x[13:] = rng.normal(size=6) * [5, 5, 5, 0.3, 0.3, 0.5]
    lcs = model.build(x, np.zeros(3))
    x_next, lam = simulate(lcs, x, np.zeros(3))
    f_n, f_t, gamma = forces_of(lam, model.lam_names)
    gap = x_next[BALL_Z] - 0.05
    v, omega = x_next[16:], x_next[13:16]
    slip = v + np.cross(omega, [0.0, 0.0, -0.05])  # Of the point that touches.
    # The force on the ball from Newton's law.
    force = 0.2 * ((v - x[16:]) / dt + [0.0, 0.0, G])
    np.testing.assert_allclose(f_n, force[2], atol=1e-9)
    assert gap > -1e-9 and f_n > -1e-9 and abs(gap * f_n) < 1e-9
    # The edges are along x and y: a square in the cone, so the slip is measured by its
    # largest component and the friction by the sum of its components.
    np.testing.assert_allclose(abs(force[:2]).sum(), f_t.sum(), atol=1e-9)
    assert f_t.sum() <= mu * f_n + 1e-9
    if f_n > 1e-6:
        np.testing.assert_allclose(gamma, abs(slip[:2]).max(), atol=1e-9)
        # Most dissipation that mu f_n allows; without slip anything within the cone.
        np.testing.assert_allclose(
            force[:2] @ slip[:2], -mu * f_n * abs(slip[:2]).max(), atol=1e-8
        )


def enumerated(lcs, q):
    """All solutions of the LCP, by trying every mode with least squares."""
    F, n, found = lcs.F, len(q), []
    for mode in range(2**n):
        on = [i for i in range(n) if mode >> i & 1]
        lam = np.zeros(n)
        if on:
            lam[on] = np.linalg.lstsq(F[np.ix_(on, on)], -q[on], rcond=None)[0]
        w = F @ lam + q
        if min(lam.min(), w.min()) > -1e-9 and abs(w[on]).max(initial=0.0) < 1e-9:
            found.append(lam)
    return found


@pytest.mark.parametrize("seed", range(8))
def test_mixed_models_in_one_lcs_step_as_enumeration_says(ball_diagram, seed):
    rng = np.random.default_rng(seed)
    pairs = [
        ContactPair("finger_link", "ball_link", 0.5, 2),
        ContactPair(
            "ball_link", "table_link", 0.6, 2,
            contact_model=StewartTrinkle(), stiffness=3e3,
        ),
    ]  # fmt: skip
    model = AnitescuLcs(ball_diagram, pairs, 0.05, 1e-3)
    assert model.n_lam == 4 + 6
    x = random_state(rng, np.zeros(19))
    x[:3], x[7:10] = [-0.11 + 0.01 * rng.normal(), 0.0, 0.05], [0.0, 0.0, 0.049]
    u = np.array([2.0, 0.5, 1.0]) + rng.normal(size=3)
    lcs = model.build(x, u)
    x_next, _ = simulate(lcs, x, u)
    motions = [
        lcs.A @ x + lcs.B @ u + lcs.D @ lam + lcs.d
        for lam in enumerated(lcs, lcs.E @ x + lcs.H @ u + lcs.c)
    ]
    assert motions
    # Coulomb's contact may have several solutions: ours must be one of them.
    assert min(abs(x_next - motion).max() for motion in motions) < 1e-9


@pytest.mark.parametrize("law", [Anitescu, StewartTrinkle])
@pytest.mark.parametrize("analytic", [True, False])
def test_a_contact_with_a_stiffness_is_a_spring(law, analytic):
    """At rest: penetration m g / k, whatever eps_c; and one free step onto it."""
    k, dt = 2e4, 0.01
    model = slider(dt, 5e-4, analytic, contact_model=law(), stiffness=k)
    x = np.array([0.0, 0.1 - G / k, 0.0, 0.0])
    lcs = model.build(x, np.zeros(model.n_u))
    x_next, lam = simulate(lcs, x, np.zeros(model.n_u))
    np.testing.assert_allclose(x_next, x, atol=1e-12)
    normal = lam.sum() if law is Anitescu else lam[0]
    assert normal == pytest.approx(G, rel=1e-9)
    # Falling: v' = v - g dt + dt k (-gap - dt v')/m where that is positive.
    x = np.array([0.0, 0.1, 0.0, -0.2])
    v_next = (-0.2 - dt * G) / (1.0 + dt**2 * k)
    x_next, _ = simulate(model.build(x, np.zeros(model.n_u)), x, np.zeros(model.n_u))
    assert x_next[3] == pytest.approx(v_next, rel=1e-9)


DROPPED = """<sdf version="1.7" xmlns:drake="http://drake.mit.edu">
<model name="ball"><link name="ball"><inertial><mass>0.2</mass>
<inertia><ixx>2e-4</ixx><iyy>2e-4</iyy><izz>2e-4</izz></inertia></inertial>
<collision name="c"><geometry><sphere><radius>.05</radius></sphere></geometry>
<drake:proximity_properties>
<drake:point_contact_stiffness>4e3</drake:point_contact_stiffness>
<drake:hunt_crossley_dissipation>0</drake:hunt_crossley_dissipation>
<drake:mu_dynamic>.4</drake:mu_dynamic><drake:mu_static>.4</drake:mu_static>
</drake:proximity_properties></collision></link></model></sdf>"""


def on_soft_ground(plant):
    properties = ProximityProperties()
    AddContactMaterial(0.0, 4e3, CoulombFriction(0.4, 0.4), properties)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform(), HalfSpace(), "ground", properties
    )


@pytest.mark.parametrize("law", [Anitescu, StewartTrinkle])
def test_a_compliant_contact_steps_as_drakes_point_contact(law):
    """One step of Drake's plant, two springs of 4e3 in a row, and of ours. With slip
    for Stewart's and Trinkle's alone: Anitescu's opens as it slips."""
    dt, rng = 1e-3, np.random.default_rng(0)
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, dt)
    Parser(plant).AddModelsFromString(DROPPED, "sdf")
    on_soft_ground(plant)
    # TAMSI: Drake's only one whose contact does not open as it slips. Drake 1.58 has it
    # no more; kLagged's does not open either, but its friction is that of the normal
    # force before the step, so that only what is along the normal can be compared.
    tamsi = getattr(DiscreteContactApproximation, "kTamsi", None)
    plant.set_discrete_contact_approximation(
        DiscreteContactApproximation.kLagged if tamsi is None else tamsi
    )
    plant.set_contact_model(ContactModel.kPoint)
    plant.Finalize()
    diagram = builder.Build()
    pair = ContactPair("ball", "world", 0.4, 2, contact_model=law(), stiffness=2e3)
    model = AnitescuLcs(diagram, [pair], dt)
    for slip in [0.0] * 5 + [0.5] * 5 * (law is StewartTrinkle):
        x, none = np.zeros(13), np.zeros(model.n_u)
        x[0], x[6] = 1.0, 0.05 - rng.uniform(1e-4, 1e-3)  # At most 2 % of the radius.
        x[10:13] = slip, 0.0, rng.uniform(-0.2, 0.1)
        simulator = Simulator(diagram)
        context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        plant.SetPositionsAndVelocities(context, x)
        simulator.AdvanceTo(dt)
        drakes = plant.GetVelocities(context)
        ours = simulate(model.build(x, none), x, none)[0][7:13]
        change = abs(drakes - x[7:13]).max()
        assert change > 5e-4
        # Drake's solver ends at 1e-4 of its stiction tolerance of 1e-4 m/s. Its force
        # acts in the middle of the overlap, ours on the surface: half of at most 2 %.
        np.testing.assert_allclose(ours[5], drakes[5], atol=1e-6)
        if tamsi is not None or slip == 0.0:
            np.testing.assert_allclose(ours[3:5], drakes[3:5], atol=1e-6)
            np.testing.assert_allclose(ours[:3], drakes[:3], rtol=0.01, atol=1e-9)


# The nearest of many.

MANY = 12


def rough_ball():
    """The ball of ball_on_table with a dozen small spheres on it, and a finger."""
    spheres = "".join(
        f'<collision name="bump{k}"><pose>{0.05 * np.cos(a)} {0.05 * np.sin(a)} 0 0 0 0'
        "</pose><geometry><sphere><radius>.004</radius></sphere></geometry></collision>"
        for k, a in enumerate(2.0 * np.pi * np.arange(MANY) / MANY)
    )
    body = f'<link name="ball_link">{spheres}'
    assert '<link name="ball_link">' in SDF
    return diagram_of(SDF.replace('<link name="ball_link">', body))


@pytest.mark.parametrize("analytic", [True, False])
def test_the_nearest_combinations_are_the_contacts_and_sizes_stay(analytic):
    diagram = rough_ball()
    pairs = [
        ContactPair("finger_link", "ball_link", 0.5, closest=2),
        ContactPair("ball_link", "table_link", 0.3, closest=3),
    ]
    model = AnitescuLcs(diagram, pairs, 0.05, analytic=analytic)
    everything = [ContactPair(p.a, p.b, p.friction) for p in pairs]
    all_of_them = AnitescuLcs(diagram, everything, 0.05, analytic=analytic)
    assert model.is_analytic == analytic
    assert (model.n_lam, all_of_them.n_lam) == (4 * 5, 4 * 2 * (MANY + 1))
    rng, seen = np.random.default_rng(0), set()
    for _ in range(10):
        x = random_state(rng, np.array([0.3, 0.0, 0.1, 1, 0, 0, 0, *np.zeros(12)]))
        x[BALL_Z] = 0.06
        lcs, whole = model.build(x, np.zeros(3)), all_of_them.build(x, np.zeros(3))
        phi = whole.phi[::4]
        nearest = [sorted(np.argsort(phi[: MANY + 1])[:2])]
        nearest += [sorted(MANY + 1 + np.argsort(phi[MANY + 1 :])[:3])]
        rows = [4 * i + k for of in nearest for i in of for k in range(4)]
        seen.add(tuple(rows))
        for name in ("E", "H", "c", "phi"):
            np.testing.assert_allclose(
                getattr(lcs, name), getattr(whole, name)[rows], atol=1e-12
            )
        np.testing.assert_allclose(lcs.D, whole.D[:, rows], atol=1e-12)
        np.testing.assert_allclose(lcs.F, whole.F[np.ix_(rows, rows)], atol=1e-12)
    assert len(seen) > 3


def test_the_nearest_of_all_pairs_keep_their_own_friction_and_stiffness():
    law = dict(contact_model=StewartTrinkle())
    pairs = [
        ContactPair("finger_link", "ball_link", 0.5, stiffness=2e3, **law),
        ContactPair("ball_link", "table_link", 0.3, stiffness=5e3, **law),
    ]
    model = AnitescuLcs(diagram_of(SDF), pairs, 0.05, closest=1)
    assert model.n_lam == 6
    x = model.x_default.copy()
    for z, i in ((0.06, 1), (0.5, 0)):  # Near the table, and far from it.
        x[:3], x[7:10] = [0.0, 0.0, z + 0.2], [0.0, 0.0, z]
        alone = AnitescuLcs(diagram_of(SDF), [pairs[i]], 0.05).build(x, np.zeros(3))
        lcs = model.build(x, np.zeros(3))
        for name in MATRICES:
            np.testing.assert_allclose(
                getattr(lcs, name), getattr(alone, name), atol=1e-12
            )


@pytest.mark.parametrize("analytic", [True, False])
@pytest.mark.parametrize("closest", [None, 2])
def test_a_friction_that_is_given_is_that_of_a_model_made_with_it(analytic, closest):
    def model_with(*mu):
        pairs = [
            ContactPair("finger_link", "ball_link", mu[0], closest=closest),
            ContactPair("ball_link", "table_link", mu[1], closest=closest),
        ]
        return AnitescuLcs(rough_ball(), pairs, 0.05, analytic=analytic)

    model, made_so = model_with(0.5, 0.3), model_with(0.8, 0.1)
    x = random_state(np.random.default_rng(7), model.x_default)
    given = model.build(x, np.zeros(3), friction=[0.8, 0.1])
    for name in MATRICES:
        expected = getattr(made_so.build(x, np.zeros(3)), name)
        np.testing.assert_array_equal(getattr(given, name), expected)
    assert (model.build(x, np.zeros(3)).E != given.E).any()


@pytest.mark.parametrize("analytic", [True, False])
def test_a_gap_that_is_given_is_as_if_the_finger_were_farther_off(
    ball_diagram, analytic
):
    model = AnitescuLcs(ball_diagram, ball_pairs(), 0.05, analytic=analytic)
    x = random_state(np.random.default_rng(8), model.x_default)
    x[:3], x[7:10] = [0.2, 0.1, 0.4], [0.0, 0.0, 0.1]
    n = (x[:3] - x[7:10]) / np.linalg.norm(x[:3] - x[7:10])  # Two spheres.
    far = x.copy()
    far[:3] += 0.003 * n
    given = model.build(x, np.zeros(3), gap=[0.003, -0.001])
    moved, plain = model.build(far, np.zeros(3)), model.build(x, np.zeros(3))
    np.testing.assert_allclose(given.phi[:4], moved.phi[:4], atol=1e-12)
    np.testing.assert_allclose(given.phi[4:], plain.phi[4:] - 0.001, atol=1e-12)
    w, w_plain = given.E @ x + given.c, plain.E @ x + plain.c
    w_moved = moved.E @ far + moved.c
    np.testing.assert_allclose(w[:4], w_moved[:4], atol=1e-10)
    np.testing.assert_allclose(w[4:], w_plain[4:] - 0.001 / 0.05, atol=1e-10)


@pytest.mark.parametrize(
    "given, message",
    [
        (dict(friction=[0.5]), r"friction is \[0.5\], expected \(2,\) of at least 0"),
        (dict(friction=[0.5, -0.1]), "of at least 0"),
        (dict(friction=[np.nan, 0.1]), "of at least 0"),
        (dict(friction=[0.1, 0.1]), "friction 0.1 came for a contact that was made"),
        (dict(gap=[0.0, np.inf]), r"expected \(2,\), finite"),
        (dict(gap=0.0), r"expected \(2,\), finite"),
    ],
)
def test_a_bad_friction_or_gap_is_refused(ball_diagram, given, message):
    pairs = ball_pairs()
    pairs[1] = ContactPair(
        "ball_link", "table_link", 0.0, contact_model=StewartTrinkle()
    )
    model = AnitescuLcs(ball_diagram, pairs, 0.05)
    model.build(model.x_default, np.zeros(3), friction=[0.1, 0.0])
    with pytest.raises(ValueError, match=message):
        model.build(model.x_default, np.zeros(3), **given)


def test_the_ports_of_friction_and_gap_act_where_they_are_connected(
    ball_diagram, reference
):
    system, x = system_of(ball_diagram), reference["x_touch"]
    builder = DiagramBuilder()
    builder.AddSystem(system)
    given = dict(x=x, u=np.zeros(3), friction=[0.2, 0.9], gap=[1e-3, 2e-3])
    for name, value in given.items():
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), system.GetInputPort(name))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.001)
    lcs, status = outputs(simulator, system)
    assert status == 1.0
    for name in MATRICES:
        expected = getattr(system.model.build(*given.values()), name)
        np.testing.assert_array_equal(getattr(lcs, name), expected)


def test_bad_kinds_of_contact_are_refused_in_one_line(ball_diagram):
    def refused(message, closest=None, **change):
        pairs = ball_pairs()
        for name, value in change.items():
            setattr(pairs[0], name, value)
        with pytest.raises(ValueError, match=message):
            AnitescuLcs(ball_diagram, pairs, closest=closest)

    refused("finger_link~ball_link.contact_model is 'st', exp", contact_model="st")
    refused("stiffness is 0.0, expected a positive number", stiffness=0.0)
    refused("stiffness is inf, expected a positive", stiffness=np.inf)
    refused("closest is 3, expected an integer from 1 to 2", 3)
    refused("closest is 0, expected an integer from 1 to 2", 0)
    refused("expected one kind", 1, friction_directions=3)
    refused("expected one kind", 1, stiffness=1e3)
    pairs = ball_pairs()
    pairs[0].closest = 2
    with pytest.raises(ValueError, match="ball_link: closest is 2, expected .* 1 to 1"):
        AnitescuLcs(ball_diagram, pairs)
    pairs[0].closest = 1
    with pytest.raises(ValueError, match="closest came for all pairs and for one"):
        AnitescuLcs(ball_diagram, pairs, closest=1)


def test_contact_models_are_read_from_yaml():
    text = "contacts: [{a: p, b: q, contact_model: !StewartTrinkle {}, stiffness: 1e4}]"
    config = yaml_load_typed(schema=LcsBuilderConfig, data=text)
    assert isinstance(config.contacts[0].contact_model, StewartTrinkle)
    assert config.contacts[0].stiffness == 1e4


# An LCS per knot, along the last plan.

PENDULUM = """<sdf version="1.7"><model name="pendulum"><link name="rod">
<inertial><pose>.5 0 0 0 0 0</pose><mass>1</mass></inertial><collision name="tip">
<pose>.5 0 0 0 0 0</pose><geometry><sphere><radius>.02</radius></sphere></geometry>
</collision></link><joint name="j" type="revolute"><parent>world</parent>
<child>rod</child><axis><xyz>0 1 0</xyz><limit><effort>1e4</effort></limit></axis>
</joint></model></sdf>"""


def add_floor(plant):
    X = RigidTransform([0.0, 0.0, -3.0])
    plant.RegisterCollisionGeometry(
        plant.world_body(), X, HalfSpace(), "floor", CoulombFriction()
    )


def swung(lcs_along_plan):
    """A pendulum is told to go from hanging to half a turn up, in its own plant."""
    c = ContactMpcConfig(
        [ContactPair("rod", "world", 0.5)],
        Q=[50.0, 1.0],
        R=[0.1],
        x_desired=[-0.5 * np.pi, 0.0],
        dt_sec=0.04,
        period_sec=0.02,
        options=C3Options(N=8, rounds=3, polish=3),
        lcs_along_plan=lcs_along_plan,
    )
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
    Parser(plant).AddModelsFromString(PENDULUM, "sdf")
    add_floor(plant)
    plant.Finalize()
    mpc = builder.AddSystem(make_contact_mpc(diagram_of(PENDULUM, add_floor), c))
    builder.Connect(plant.get_state_output_port(), mpc.GetInputPort("x"))
    builder.Connect(mpc.GetOutputPort("u"), plant.get_actuation_input_port())
    simulator = Simulator(builder.Build())
    start = [0.5 * np.pi, 0.0]
    plant.SetPositionsAndVelocities(
        plant.GetMyMutableContextFromRoot(simulator.get_mutable_context()), start
    )
    return simulator, plant, mpc


def test_the_lcs_of_each_knot_is_the_one_about_the_last_plan():
    simulator, plant, mpc = swung(True)
    lcs = mpc.GetSubsystemByName("lcs")
    model = AnitescuLcs(
        diagram_of(PENDULUM, add_floor), [ContactPair("rod", "world", 0.5)], 0.04
    )
    context = lcs.GetMyContextFromRoot(simulator.get_context())
    simulator.AdvanceTo(1e-5)  # The builder has run, C3 has not.
    x = [0.5 * np.pi, 0.0]
    first = model.build(x, [0.0])
    for built in lcs.GetOutputPort("lcs").Eval(context):
        np.testing.assert_array_equal(built.A, first.A)
    simulator.AdvanceTo(0.019)
    plan = mpc.GetOutputPort("plan").Eval(
        mpc.GetMyContextFromRoot(simulator.get_context())
    )
    assert (plan.time, plan.dt) == (1e-4, 0.04)
    simulator.AdvanceTo(0.02 + 1e-5)
    # The plan is .0199 s old, knots are .04 s apart.
    share, x_plan = 0.0199 / 0.04, plan.x
    built = lcs.GetOutputPort("lcs").Eval(context)
    assert lcs.GetOutputPort("status").Eval(context) == LcsBuilderStatus.BUILT
    for k in range(1, 8):
        between = (1.0 - share) * x_plan[k] + share * x_plan[k + 1]
        expected = model.build(between, plan.u[k])
        np.testing.assert_allclose(built[k].A, expected.A, atol=1e-5)
        np.testing.assert_allclose(built[k].d, expected.d, atol=1e-5)
    # And not those about x: gravity's lever turns along the plan.
    assert abs(built[7].A - built[0].A).max() > 1e-2


def test_plans_along_the_last_one_foresee_better_what_happens():
    errors = {}
    for along in (True, False):
        simulator, plant, mpc = swung(along)
        whole, errors[along] = mpc.GetMyContextFromRoot(simulator.get_context()), []
        for tick in range(1, 15):
            simulator.AdvanceTo(0.02 * tick + 0.01)
            plan = mpc.GetOutputPort("plan").Eval(whole)
            assert plan.status == 0
            x = plan.x[0].copy()  # Euler steps of the pendulum's own equation.
            for u in plan.u[:, 0]:
                x[1] += 0.04 * (u + G * 0.5 * np.cos(x[0])) / 1.25
                x[0] += 0.04 * x[1]
            errors[along].append(abs(plan.x[-1, 0] - x[0]))
    assert np.mean(errors[True]) < 0.01 * np.mean(errors[False])


def test_a_planned_state_that_is_none_is_told_and_the_present_one_stands_in(
    ball_diagram,
):
    config = LcsBuilderConfig(ball_pairs(), 0.05, period_sec=0.01, knots=3)
    system = AnitescuLcsBuilder(ball_diagram, config)
    x = random_state(np.random.default_rng(0), np.zeros(19))
    plan_x = np.tile(x, (4, 1))
    plan_x[2, 3:7] = 0.0  # No quaternion.
    plan = Plan(plan_x, np.zeros((3, 3)), np.zeros((3, 8)), 0, 0.0, 0.05)
    simulator = run_with([system], x, np.zeros(3))
    port, context = system.GetInputPort("plan"), simulator.get_mutable_context()
    port.FixValue(system.GetMyMutableContextFromRoot(context), AbstractValue.Make(plan))
    simulator.AdvanceTo(0.005)
    models, status = outputs(simulator, system)
    assert status == LcsBuilderStatus.BUILT_IN_PART and len(models) == 3
    np.testing.assert_array_equal(models[2].A, models[0].A)
    with pytest.raises(ValueError, match="knots is 1.5"):
        AnitescuLcsBuilder(ball_diagram, LcsBuilderConfig(ball_pairs(), knots=1.5))


@pytest.mark.parametrize("dt", [0.02, 0.1])
def test_a_learned_gap_is_planned_with_as_if_it_were_modelled(dt):
    """A puck that is 8 mm smaller, or the same puck and r_comp = 8 mm / dt_sec."""
    text = Path(model_path("puck.sdf")).read_text()
    puck = text.rindex("<link name")
    smaller = text[:puck] + text[puck:].replace("0.05", "0.042")

    def planned(text, r_comp=None):
        c = ContactMpcConfig(
            [ContactPair("finger", "puck", 0.3)],
            Q=[0, 200, 1, 20],
            R=[0.01],
            x_desired=[0.4, 0.5, 0, 0],
            dt_sec=dt,
        )
        mpc = make_contact_mpc(diagram_of(text), c)
        simulator = Simulator(mpc)
        context = simulator.get_mutable_context()
        # The finger is 10 mm before the modelled contact and moves to it at 0.3 m/s.
        mpc.GetInputPort("x").FixValue(context, [0.09, 0.0, 0.3, 0.0])
        if r_comp is not None:
            mpc.GetInputPort("r_comp").FixValue(context, r_comp)
        simulator.AdvanceTo(1e-3)
        return mpc.GetOutputPort("u").Eval(context)[0]

    expected = planned(smaller)
    # Both spheres on one line: only the constant of the gap differs.
    assert planned(text, np.full(4, 8e-3 / dt)) == pytest.approx(expected, abs=1e-6)
    assert abs(planned(text) - expected) > 1e-2


def test_a_goal_that_moves_is_the_goal_of_each_knot():
    """Without x_desired in the config a port has it; a goal that stands still is that
    of the config, and weights of knots act where they are."""
    text = Path(model_path("puck.sdf")).read_text()

    def planned(goal=None, **more):
        c = ContactMpcConfig(
            [ContactPair("finger", "puck", 0.3)], Q=[0, 200, 1, 20], R=[0.01],
            x_desired=[] if goal is not None else [0.4, 0.5, 0, 0], **more,
        )  # fmt: skip
        mpc = make_contact_mpc(diagram_of(text), c)
        simulator = Simulator(mpc)
        context = simulator.get_mutable_context()
        mpc.GetInputPort("x").FixValue(context, [0.09, 0.0, 0.3, 0.0])
        if goal is not None:
            mpc.GetInputPort("x_desired").FixValue(context, np.ravel(goal))
        simulator.AdvanceTo(1e-3)
        return mpc.GetOutputPort("u").Eval(context)[0]

    still = np.tile([0.4, 0.5, 0.0, 0.0], (11, 1))
    expected = planned()
    assert planned(still) == pytest.approx(expected, abs=1e-9)
    later = still.copy()
    later[1:, 1] += 0.1 * np.arange(10)
    assert planned(later) > expected + 0.1
    # The same as a goal that stands still, if the knots where it moves have no weight.
    weights = KnotWeights([0, 200, 1, 20], np.zeros((10, 4)).tolist())
    later[-1] = still[-1]
    assert planned(later, weights=weights) == pytest.approx(
        planned(still, weights=weights)
    )


SLIDER = plants.sdf(
    plants.finger("tip", plants.X, "0.1 0 0", 0.03, 0.5, damping=3.0),
    plants.link("s", 5.0, plants.shape("c", plants.box(0.1, 0.2, 0.1)), arm=0.05),
    plants.joint("s", "1 0 0", driven=False, damping=20.0),
)
LIFT = plants.sdf(
    plants.finger("tip", plants.XZ, "0 0 -0.04", 0.01, 0.3, damping=1.0),
    plants.link("s", 2.0, plants.shape("c", plants.box(0.1, 0.1, 0.05)), arm=0.03),
    plants.joint("s", "0 0 1", driven=False, damping=2.0),
)
FLAP = plants.sdf(
    plants.finger("tip", plants.XY, "0.15 0.05 0", 0.01, 0.2, damping=1.0),
    plants.link(
        "s", 0.3, plants.shape("c", plants.box(0.2, 0.02, 0.05), "0.1 0 0"), arm=0.12
    ),
    plants.joint("s", "0 0 1", kind="revolute", driven=False, damping=0.1),
)


@pytest.mark.parametrize(
    ("text", "normal", "at", "goal", "speed", "force", "coast_sec"),
    [
        (SLIDER, [0.0, 0.0, 1.0], 1, -0.4, 0.4, 18.0, 5.0 / 20.0),
        (LIFT, [0.0, 1.0, 0.0], 2, 0.2, 0.2, 24.4, 0.2 / (2 * 9.81)),
        (FLAP, [0.0, 0.0, 1.0], 2, -0.5, 1.0, 1.2, 0.3 * 0.12**2 / 0.1),
    ],
    ids=["slider", "lift", "flap"],
)
def test_the_rule_for_weights_and_time_step_pushes_what_it_was_not_tuned_on(
    text, normal, at, goal, speed, force, coast_sec
):
    """Within 5 % of the length in four times the time that it says."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001)
    Parser(plant).AddModelsFromString(text, "sdf")
    plant.Finalize()
    n, length = plant.num_positions(), abs(goal)
    x_desired = np.zeros(2 * n)
    x_desired[at] = goal
    c = ContactMpcConfig(
        [ContactPair("tip", "s", 0.3, 1, plane_normal=normal)],
        x_desired=x_desired.tolist(),
    )
    c = tuned(c, plant, [(at, at)], length, speed, force, coast_sec)
    mpc = builder.AddSystem(make_contact_mpc(diagram_of(text), c))
    builder.Connect(plant.get_state_output_port(), mpc.GetInputPort("x"))
    builder.Connect(mpc.GetOutputPort("u"), plant.get_actuation_input_port())
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(4.0 * length / speed)
    q = plant.GetPositions(plant.GetMyContextFromRoot(simulator.get_context()))
    assert abs(q[at] - goal) < 0.05 * length


def test_numbers_of_a_task_that_make_no_sense_are_refused():
    _, plant = plants.diagram_of(SLIDER)
    for numbers, said in (
        ((0.0, 1.0, 1.0, 1.0), "length is 0.0, expected a positive number"),
        ((1.0, -1.0, 1.0, 1.0), "speed is -1.0, expected a positive"),
        ((1.0, 1.0, np.inf, 1.0), "force is inf, expected"),
        ((1.0, 1.0, 1.0, -1.0), "coast_sec is -1.0, expected >= 0"),
    ):
        with pytest.raises(ValueError, match=said):
            tuned(ContactMpcConfig(), plant, [(1, 1)], *numbers)

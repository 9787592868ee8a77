from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.systems.contact_mpc.lcs_plant import LcsPlant, LcsPlantConfig
from makebreak.systems.contact_mpc.numerics.lcs import LCS, simulate

CARTPOLE = np.load(Path(__file__).parent / "reference" / "c3_cartpole.npz")


def wall(mass=2.0, k=100.0, at=0.1, dt=0.01):
    """A point mass [q, v] and a spring wall: 0 <= lam perp lam/k + at - q_next >= 0."""
    A, B = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[dt**2], [dt]]) / mass
    F, H = np.array([[1.0 / k + dt**2 / mass]]) / dt, -B[:1] / dt
    return LCS(A, B, -B, [0.0, 0.0], -A[:1] / dt, F, H, [at / dt], dt)


def test_a_pushed_mass_compresses_the_wall_by_force_over_stiffness():
    # At rest u = lam = k (q - at).
    lam = simulate(wall(), [0.1 + 3.0 / 100.0, 0.0], [3.0])[1]
    np.testing.assert_allclose(lam, [3.0], atol=1e-12)


def test_simulate_away_from_the_wall_is_the_free_step():
    x_next, lam = simulate(wall(), [0.0, 1.0], [4.0])
    # v = 1 + dt 4/2, q = dt v.
    np.testing.assert_allclose(x_next, [0.0102, 1.02], atol=1e-15)
    assert lam == [0.0]


def test_soft_wall_cartpole_steps_as_the_reference_implementation():
    z = CARTPOLE
    lcs = LCS(*(z[name] for name in ("A", "B", "D", "d", "E", "F", "H", "c")), dt=0.01)
    x0 = np.array([0.1, -0.5, 0.5, -0.4])
    # Values of c3_reference, printed there with six decimals.
    x_next, lam = simulate(lcs, x0, [1.0])
    np.testing.assert_allclose(lam, [5.0000019, 0.0], atol=5e-6)
    np.testing.assert_allclose(x_next, [0.105, -0.504, 0.510376, -0.089737], atol=2e-6)


def test_the_residual_shifts_the_gap():
    # The model has its wall at .1; a residual of -.02/dt moves it to .08.
    lcs = wall().with_residual(np.array([-0.02 / 0.01]))
    x, u = [0.079, 1.0], [0.0]
    np.testing.assert_allclose(
        simulate(lcs, x, u)[1], simulate(wall(at=0.08), x, u)[1], atol=1e-9
    )
    assert simulate(lcs, x, u)[1] > 0.0
    assert simulate(wall(), x, u)[1] == 0.0


def test_arrays_are_copies_and_cannot_be_changed():
    A = np.eye(2)
    lcs = wall()
    mine = LCS(A, lcs.B, lcs.D, lcs.d, lcs.E, lcs.F, lcs.H, lcs.c, lcs.dt)
    A[0, 0] = 7.0
    assert mine.A[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        mine.c[0] = 1.0


def test_a_copied_context_keeps_the_read_only_lcs():
    value = Value(wall()).Clone().get_value()
    with pytest.raises(ValueError, match="read-only"):
        value.A[0, 0] = 1.0


def test_wrong_shapes_and_time_steps_are_refused_by_name():
    eye, z = np.eye(2), np.zeros(2)
    with pytest.raises(ValueError, match=r"LCS.E is \(2, 3\), expected \(2, 2\)"):
        LCS(eye, eye, eye, z, np.ones((2, 3)), eye, eye, z, 0.1)
    with pytest.raises(ValueError, match=r"LCS.phi is \(3,\), expected \(2,\)"):
        LCS(eye, eye, eye, z, eye, eye, eye, z, 0.1, np.zeros(3))
    for dt in (0.0, -0.1, np.nan):
        with pytest.raises(ValueError, match="LCS.dt is"):
            LCS(eye, eye, eye, z, eye, eye, eye, z, dt)


def test_the_lcs_plant_replays_simulate_and_holds_its_input():
    lcs = wall()
    builder = DiagramBuilder()
    plant = builder.AddSystem(LcsPlant(lcs, [0.05, 0.3]))
    u = builder.AddSystem(ConstantVectorSource([2.0]))
    builder.Connect(u.get_output_port(), plant.GetInputPort("u"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.995)  # Steps at 0, dt, ... 99 dt.
    x, lam = np.array([0.05, 0.3]), None
    for _ in range(100):
        x, lam = simulate(lcs, x, [2.0])
    context = plant.GetMyContextFromRoot(simulator.get_context())
    np.testing.assert_array_equal(plant.GetOutputPort("x").Eval(context), x)
    np.testing.assert_array_equal(plant.GetOutputPort("lam").Eval(context), lam)


def test_the_lcs_plant_refuses_a_state_of_the_wrong_size():
    with pytest.raises(ValueError, match=r"x_initial is \(3,\), expected \(2,\)"):
        LcsPlant(wall(), np.zeros(3), LcsPlantConfig())

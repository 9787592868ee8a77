"""A chain's state beside Drake's at the same positions and velocities."""

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable


def assert_moves_as_in_drake(s, plant, context, tip, **close):
    """Mass matrix, Jacobian of the tip, its bias acceleration and its pose. (Drake's
    spatial vectors have rotation first.)"""
    np.testing.assert_allclose(s.M, plant.CalcMassMatrix(context), **close)
    world = plant.world_frame()
    args = (context, JacobianWrtVariable.kV, tip, [0, 0, 0], world, world)
    J = plant.CalcJacobianSpatialVelocity(*args)
    np.testing.assert_allclose(s.J, np.vstack([J[3:], J[:3]]), **close)
    a = plant.CalcBiasSpatialAcceleration(*args).get_coeffs()
    np.testing.assert_allclose(s.bias_a, np.concatenate([a[3:], a[:3]]), **close)
    X = tip.CalcPoseInWorld(context)
    np.testing.assert_allclose(s.p_WE, X.translation(), **close)
    np.testing.assert_allclose(s.R_WE, X.rotation().matrix(), **close)

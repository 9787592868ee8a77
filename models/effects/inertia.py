"""Common parts of the kinds that change a body's inertia."""

from collections.abc import Callable
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody, RotationalInertia, SpatialInertia

from makebreak.models.effects.kind import Effect, find_bodies
from makebreak.models.effects.signature import Signature

# Indices of ixx, iyy, izz, ixy, ixz, iyz in a (3, 3) inertia.
SIX = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def central_inertia(M: SpatialInertia) -> np.ndarray:
    """(3, 3) about the centre of mass [kg m2]."""
    mass, p = M.get_mass(), M.get_com()
    about = M.CalcRotationalInertia().CopyToFullMatrix3()
    return about - mass * (p @ p * np.eye(3) - np.outer(p, p))


def spatial_inertia(mass: float, com, central) -> SpatialInertia:
    """From mass [kg], com (3,) [m] and central (3, 3) [kg m2].

    Raises: RuntimeError if they are not physical.
    """
    products = [central[0, 1], central[0, 2], central[1, 2]]
    return SpatialInertia.MakeFromCentralInertia(
        mass, com, RotationalInertia(*np.diag(central), *products)
    )


def change_inertia(new_values: Callable):
    """A set_in_context from new_values(old, new, mass, com, central) ->
    (mass, com, central), with the effect before and after the change."""

    def set_in_context(old: Effect, new: Effect, plant: MultibodyPlant, context):
        for body in find_bodies(new, plant):
            M = body.CalcSpatialInertiaInBodyFrame(context)
            values = new_values(old, new, M.get_mass(), M.get_com(), central_inertia(M))
            try:
                changed = spatial_inertia(*values)
            except RuntimeError:
                raise ValueError(
                    f"effect {new.kind} at {new.at}: no body has the inertia of "
                    f"{new.parameters}"
                ) from None
            body.SetSpatialInertiaInBodyFrame(context, changed)

    return set_in_context


def mass_mix(M: SpatialInertia) -> np.ndarray:
    """(10, 1) derivative of the unknowns of inertial_columns by the mass, for a mass
    distribution that stays as it is."""
    mix = np.zeros((10, 1))
    mix[0], mix[1:4, 0] = 1.0, M.get_com()
    about = M.get_unit_inertia().CopyToFullMatrix3()  # Per kg, about the origin.
    mix[4:, 0] = [about[at] for at in SIX]
    return mix


def com_mix(M: SpatialInertia) -> np.ndarray:
    """(10, 3) derivative of the unknowns of inertial_columns by the centre of mass,
    about which the inertia is kept."""
    mass, com, mix = M.get_mass(), M.get_com(), np.zeros((10, 3))
    for i, e in enumerate(np.eye(3)):
        mix[1:4, i] = mass * e
        change = 2.0 * com[i] * np.eye(3) - np.outer(com, e) - np.outer(e, com)
        mix[4:, i] = [mass * change[at] for at in SIX]
    return mix


def inertial_columns(model, motion, body: RigidBody) -> tuple[np.ndarray, np.ndarray]:
    """The regressor of the inverse dynamics by the inertial parameters of one body.

    Unknowns: mass m, h = m com (3), and the inertia about the body's origin ixx, iyy,
    izz, ixy, ixz, iyz, in the body's axes.
    Returns: (n, n_v, 10) of the effort, and of the generalized momentum.
    """
    J, V, A, R = model.body_motion(body, motion.q, motion.v, motion.vd)
    w, alpha, a = V[:, :3], A[:, :3], A[:, 3:] - model.gravity
    n = len(w)
    wrench = np.zeros((n, 6, 10))
    momentum = np.zeros((n, 6, 10))
    wrench[:, 3:, 0] = a
    momentum[:, 3:, 0] = V[:, 3:]
    for i in range(3):
        h = R[:, :, i]
        wrench[:, 3:, 1 + i] = np.cross(alpha, h) + np.cross(w, np.cross(w, h))
        wrench[:, :3, 1 + i] = np.cross(h, a)
        momentum[:, 3:, 1 + i] = np.cross(w, h)
        momentum[:, :3, 1 + i] = np.cross(h, V[:, 3:])
    for i, (row, column) in enumerate(SIX):
        E = np.zeros((3, 3))
        E[row, column] = E[column, row] = 1.0
        E_W = R @ E @ R.swapaxes(1, 2)
        L = np.einsum("nij,nj->ni", E_W, w)
        wrench[:, :3, 4 + i] = np.einsum("nij,nj->ni", E_W, alpha) + np.cross(w, L)
        momentum[:, :3, 4 + i] = L
    JT = J.swapaxes(1, 2)
    return JT @ wrench, JT @ momentum


def inertial_signature(
    effect, model, motion, body, unknowns, mix, to_parameters, exact
) -> Signature:
    """A signature whose columns are inertial_columns @ mix (10, k). Its weak-form rest
    is the effort without acceleration less the momentum's rate along v."""
    columns, momentum = inertial_columns(model, motion, body)

    def at(q, vd):
        return inertial_columns(model, replace(motion, q=q, vd=vd), body)

    def weak():
        step = 1e-5  # [s]: central differences, so an error of step^2 = 1e-10 relative.
        zero = np.zeros_like(motion.vd)
        still, _ = at(motion.q, zero)
        _, after = at(model.shifted(motion.q, motion.v, step), zero)
        _, before = at(model.shifted(motion.q, motion.v, -step), zero)
        rest = still - (after - before) / (2.0 * step)
        return momentum @ mix, rest @ mix

    return Signature(
        effect,
        tuple(unknowns),
        columns @ mix,
        weak,
        to_parameters,
        exact=exact,
    )


def about_origin(com: np.ndarray, extent: float) -> np.ndarray:
    """(3, 3) unit inertia about the origin of a mass at com (3,) [m] with the radius of
    gyration `extent` [m] about any axis through its centre."""
    return (com @ com + extent**2) * np.eye(3) - np.outer(com, com)


def ten_parameters(mass: float, com: np.ndarray, extent: float = 0.0) -> np.ndarray:
    """(10,) unknowns of inertial_columns of a mass, perhaps negative, at com (3,) [m]
    with a radius of gyration [m]."""
    about = mass * about_origin(com, extent)
    return np.array([mass, *(mass * com), *(about[at] for at in SIX)])


_columns: WeakKeyDictionary = WeakKeyDictionary()  # {motion: inertial_columns}


def added_inertia(effect: Effect, model, motion, more: Callable) -> np.ndarray:
    """(n, n_v) effort that the bodies of an effect add with a change more(M) (10,) of
    the unknowns of inertial_columns; M: the SpatialInertia of the body."""
    known = _columns.setdefault(motion, {})
    added = np.zeros_like(motion.v)
    for body in find_bodies(effect, model.plant):
        key = (id(model), int(body.index()))
        if key not in known:
            known[key] = inertial_columns(model, motion, body)[0]
        added += known[key] @ more(body.default_spatial_inertia())
    return added

"""The tip's motion and the force on it, from joint sensors."""

import numba
import numpy as np

from makebreak.systems.arm.numerics.serial_chain import chain_of, chain_state
from makebreak.systems.contact_mpc.numerics.ball_state import (
    Q_BALL,
    V_TIP,
    W_BALL,
    compiled_pack,
)


@numba.njit(cache=True)
def tip_motion(chain, q, v, torque, tip_mass):
    """Position and velocity of an arm's tip, and the LCS's input that explains its
    motion.

    In the LCS the arm is a point of mass m. Its input is the force that gives this mass
    the acceleration that the motors give the free tip:

        u = m (J M^-1 (tau - bias) + Jdot v)

    The force at the real tip would not do: the tip's effective mass differs from m, and
    with the direction.

    Args:
        chain: SerialChain of the arm with its tool.
        q, v, torque: (n,) [rad], [rad/s], [N m] of the motors.
        tip_mass: m [kg].
    Returns: p_tip (3,) [m], v_tip (3,) [m/s], u (3,) [N].
    """
    return _motion(chain_state(chain, q, v), v, torque, tip_mass)


@numba.njit(cache=True)
def _motion(state, v, torque, tip_mass):
    J = state.J[:3]
    a = J @ np.linalg.solve(state.M, torque - state.bias) + state.bias_a[:3]
    return state.p_WE, J @ v, tip_mass * a


@numba.njit(cache=True)
def tip_mobility(state):
    """J M^-1 J' (3, 3) of the tip's translation [1/kg] in a ChainState."""
    J = np.ascontiguousarray(state.J[:3])
    return J @ np.linalg.solve(state.M, np.ascontiguousarray(J.T))


@numba.njit(cache=True)
def input_with_force(u, v_before, v_tip, mobility, tip_mass, dt):
    """The LCS's input that explains the tip's motion beside the real contact force.

    The contact force that the motion shows is F = (J M^-1 J')^-1 (a - u / m), with the
    tip's own mobility: two to three times what would move a point of mass m so, as the
    tip seems heavier. With the input m a - F, the point moves as the tip did under F.

    Args: u (3,): of tip_motion [N]; v_before, v_tip (3,): at the ends of dt [s];
        mobility (3, 3) [1/kg]; tip_mass: m [kg].
    Returns: (3,) [N].
    """
    a = (v_tip - v_before) / dt
    return tip_mass * a - np.linalg.solve(mobility, a - u / tip_mass)


@numba.njit(cache=True)
def observe_force(observer, v_tip, a_free, mobility, gain, dt):
    """A momentum observer of the external force on the tip.

    Args: observer (7,) = [expected v_tip (3), force (3), started]; v_tip (3,) [m/s];
        a_free (3,): acceleration of the tip by the motors alone [m/s2]; mobility (3, 3)
        [1/kg]; gain: the observer is a first-order lag of 1/gain [1/s]; dt [s].
    Returns: observer (7,) with the estimated external force [N].
    Source: De Luca, Haddadin et al., "Robot collisions: a survey on detection,
        isolation, and identification" (2017), III-D, here for the tip alone.
    """
    after = observer.copy()
    if observer[6] == 0.0:
        for k in range(3):
            after[k], after[3 + k] = v_tip[k], 0.0
        after[6] = 1.0
        return after
    pushed = gain * (v_tip - observer[:3])
    force = np.linalg.solve(mobility, pushed)
    for k in range(3):
        after[k] += dt * (a_free[k] + pushed[k])
        after[3 + k] = force[k]
    return after


@numba.njit(cache=True)
def estimate(
    chain, q, v, torque, p_ball, v_ball, seen, q_object, w_object, tip_mass, radius,
    gain, dt, x, window, observer, with_force,
):  # fmt: skip
    """One update of StateEstimator from one set of readings.

    Args:
        chain: SerialChain of the arm with its tool, packed (arm/numerics/packed.py).
        q, v, torque: as in tip_motion.
        p_ball, v_ball: (3,) [m], [m/s]. seen: (1,) above 0.5 if the ball is seen.
        q_object (4,), w_object (3,) [rad/s]: of an object of known orientation; both
            (0,): it is a rolling ball.
        tip_mass: [kg]; radius: of the modelled ball [m]; gain, dt: of observe_force.
        x (19,), window, observer (7,), with_force (3 n,): what the last update
            returned. window (3 n + 1,): the last n forces, oldest first [N], and the
            number of valid readings in a row, at most n. with_force: the last n of
            input_with_force, not a number where it is unknown.
    Returns: x, window, observer, with_force; valid: 1.0, or 0.0 if the object is not
        seen, or -1.0 if a reading beside torque is not finite: then x and observer are
        held.
    """
    n = window.size // 3
    after, forces = window.copy(), np.empty(3 * n)
    for i in range(3 * n):
        forces[i] = with_force[i + 3] if i < 3 * n - 3 else np.nan
    numbers = q.sum() + v.sum() + p_ball.sum() + v_ball.sum()
    turns = q_object.size > 0
    if turns:
        numbers += q_object.sum() + w_object.sum()
    if not np.isfinite(numbers) or (turns and not np.sum(q_object**2) > 0.25):
        after[3 * n] = 0.0
        return x.copy(), after, observer.copy(), forces, -1.0
    valid = 1.0 if seen[0] > 0.5 else 0.0
    felt = np.isfinite(torque.sum())
    state = chain_state(chain_of(chain), q, v)
    p_tip, v_tip, u = _motion(state, v, torque if felt else np.zeros(q.size), tip_mass)
    x_now = compiled_pack(p_tip, v_tip, p_ball, v_ball, radius)
    if turns:
        x_now[Q_BALL], x_now[W_BALL] = q_object / np.sqrt(np.sum(q_object**2)), w_object
    if not felt:  # The observer starts again with the next torque.
        after[3 * n] = 0.0
        observed = observer.copy()
        observed[6] = 0.0
        return x_now, after, observed, forces, valid
    for i in range(3 * n):
        after[i] = window[i + 3] if i < 3 * n - 3 else u[i + 3 - 3 * n]
    after[3 * n] = min(valid * (window[3 * n] + 1.0), n)
    mobility = tip_mobility(state)
    if window[3 * n] > 0.0:  # The last reading was good, too.
        felt_u = input_with_force(u, x[V_TIP], v_tip, mobility, tip_mass, dt)
        for k in range(3):
            forces[3 * n - 3 + k] = felt_u[k]
    observed = observe_force(observer, v_tip, u / tip_mass, mobility, gain, dt)
    return x_now, after, observed, forces, valid

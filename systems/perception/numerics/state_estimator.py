"""The tip's motion and the force on it, from joint sensors."""

import numba
import numpy as np

from makebreak.systems.arm.numerics.serial_chain import chain_of, chain_state
from makebreak.systems.contact_mpc.numerics.ball_state import (
    Q_BALL,
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
    state = chain_state(chain, q, v)
    J = state.J[:3]
    a = J @ np.linalg.solve(state.M, torque - state.bias) + state.bias_a[:3]
    return state.p_WE, J @ v, tip_mass * a


@numba.njit(cache=True)
def tip_mobility(chain, q):
    """J M^-1 J' (3, 3) of the tip's translation [1/kg] at q (n,)."""
    state = chain_state(chain, q, np.zeros(q.shape[0]))
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
        after[:3], after[3:6], after[6] = v_tip, 0.0, 1.0
        return after
    pushed = gain * (v_tip - observer[:3])
    after[:3] += dt * (a_free + pushed)
    after[3:6] = np.linalg.solve(mobility, pushed)
    return after


@numba.njit(cache=True)
def estimate(chain, q, v, torque, p_ball, v_ball, seen, tip_mass, radius, window):
    """The state of the LCS from one set of readings, and the window of forces.

    Args:
        chain: SerialChain, packed (arm/numerics/packed.py). q, v, torque: as in
            tip_motion.
        p_ball, v_ball: (3,) [m], [m/s]. seen: (1,) above 0.5 if the ball is seen.
        radius: of the modelled ball [m].
        window: (3 n + 1,) the last n forces, oldest first [N], and the number of valid
            readings in a row, at most n.
    Returns: whether all readings but torque are finite (if not, ignore the rest);
        whether torque is; x (19,); window, without a new force where torque is not
        finite; valid: 1.0, or 0.0 if the ball is not seen, or -1.0 if not all but
        torque are finite.
    """
    after = np.empty(window.size)
    if not np.isfinite(q.sum() + v.sum() + p_ball.sum() + v_ball.sum()):
        return False, False, after, after, -1.0
    felt = np.isfinite(torque.sum())
    p_tip, v_tip, u = tip_motion(
        chain_of(chain), q, v, torque if felt else np.zeros(q.size), tip_mass
    )
    n = window.size // 3
    valid = 1.0 if seen[0] > 0.5 else 0.0
    if felt:
        after[: 3 * n - 3] = window[3 : 3 * n]
        after[3 * n - 3 : 3 * n] = u
        after[3 * n] = min(valid * (window[3 * n] + 1.0), n)
    else:
        after[:] = window
        after[3 * n] = 0.0
    x = compiled_pack(p_tip, v_tip, p_ball, v_ball, radius)
    return True, felt, x, after, valid


def with_pose(finite, x, valid, q_object, w_object):
    """The results of `estimate` (without the window) for an object of known orientation
    q_object (4,) and angular velocity w_object (3,) [rad/s], not a rolling ball."""
    known = np.isfinite(q_object).all() and np.isfinite(w_object).all()
    size = np.sqrt(q_object @ q_object)
    if not (finite and known and size > 0.5):
        return False, x, -1.0
    x = x.copy()
    x[Q_BALL], x[W_BALL] = q_object / size, w_object
    return True, x, valid

"""A spring whose stiffness changes gives back no more energy than was put into it.

At an error e a rise of the stiffness by dK stores 1/2 e' dK e that nobody has brought
in: a spring that is soft while the tip leaves and stiff while it returns drives the tip
to ever larger swings, however little it is damped. So a tank of T joules pays for
every rise, and is filled by what the stiffness gives back where it falls, and by what
the damping takes out:

    T_next = T + 1/2 e' (K - K_next) e + share h de' D de,    0 <= T <= T_max

A rise that T cannot pay is made as far as it can. Then the energy of tip, spring and
tank grows by the work done from outside alone, whatever stiffness is asked for and
whatever the tip's mass is: with e the error, de its rate and f the force from outside,

    d/dt (1/2 de' M de + 1/2 e' K e + T) <= f' de.

A force that is held for a tick and comes `lag` late has less damping than D: to first
order D - K lag. The rest of what sampling does is less than what `share` leaves.

Source: Ferraguti, Secchi and Fantuzzi, "A tank-based approach to impedance control with
variable stiffness" (2013), section III; falls and rises of one tick in the place of
their power ports. The other way, Kronander and Billard, "Stability considerations for
variable impedance control" (2016), bounds dK/dt by about 2 K D/M whatever the tip does:
with CC's light damping a rise from 200 to 1000 N/m would take a second.
"""

import numba

# Memory: the stiffness in use (6), T [J], whether there was a tick.
N_TANK = 8
LEVEL, STARTED = 6, 7
# Of the energy that the damping takes out, what the tank counts. A damping force D de
# held for a tick takes out (1 - h D/2 M) of h de' D de, at least half as h D <= M.
COUNTED = 0.5


@numba.njit(cache=True)
def paid_stiffness(tank, wanted, error, capacity):
    """The stiffness (6,) of this tick; updates the tank (N_TANK,) in place.

    Args: wanted (6,): asked for [N/m], [N m/rad]; error (m,): of the first m axes [m],
        [rad]; capacity: T_max [J], infinite for the stiffness as it is asked for.
    """
    if tank[STARTED] == 0.0:
        tank[:6], tank[LEVEL], tank[STARTED] = wanted, capacity, 1.0
        return wanted
    rise = 0.0
    for i in range(error.size):
        work = 0.5 * (wanted[i] - tank[i]) * error[i] ** 2
        if work > 0.0:
            rise += work
        elif work < 0.0:
            tank[LEVEL] -= work
    K = wanted
    if rise > tank[LEVEL]:
        share = tank[LEVEL] / rise
        K = wanted.copy()
        for i in range(error.size):
            if wanted[i] > tank[i]:
                K[i] = tank[i] + share * (wanted[i] - tank[i])
        rise = tank[LEVEL]
    tank[:6] = K
    tank[LEVEL] = min(tank[LEVEL] - rise, capacity)
    return K


@numba.njit(cache=True)
def fill(tank, damping, rate, lag, period, capacity):
    """Adds to the tank what the damping takes out in one tick.

    Args: tank (N_TANK,), in place; damping (6,) [N s/m], [N m s/rad]; rate (m,): of the
        error [m/s], [rad/s]; lag: from a reading to the middle of the time for which
        its force acts [s]; period: of a tick [s]; capacity: T_max [J].
    """
    power = 0.0
    for i in range(rate.size):
        power += max(damping[i] - tank[i] * lag, 0.0) * rate[i] ** 2
    tank[LEVEL] = min(tank[LEVEL] + COUNTED * period * power, capacity)

"""Rows at which something struck a body, amid noise."""

import numpy as np

from makebreak.gap.numerics.struck import struck_rows

G, RATE, NOISE = 9.81, 100.0, 6e-4


def bounced(speeds, rng):
    """Heights of a ball that leaves the ground at these speeds [m/s], one after the
    other; and when it struck it."""
    t = np.arange(0.0, sum(2.0 * v / G for v in speeds), 1.0 / RATE)
    z, hits, since = np.zeros(len(t)), [], 0.0
    for v in speeds:
        on = t >= since
        z[on] = v * (t[on] - since) - 0.5 * G * (t[on] - since) ** 2
        since += 2.0 * v / G
        hits.append(since)
    return t, z + NOISE * rng.normal(size=len(t)), np.array(hits[:-1])


def test_bounces_are_found_and_nothing_in_between():
    """At this rate noise alone is 15 m/s2 in second differences; a weak bounce changes
    the speed by 1.2 m/s, a strong one by 8."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        t, z, hits = bounced([4.0, 4.0, 1.5, 0.6, 0.6], rng)
        at = t[struck_rows(t, z, NOISE, (), 20.0, 3)]
        off = np.abs(at[:, None] - hits)
        assert off.min(axis=0).max() < 1.5 / RATE
        # Of flights of an eighth of a second less can be said.
        assert off.min(axis=1)[at < 1.9].max() < 3.5 / RATE


def test_a_fall_is_no_impact_and_a_short_log_says_nothing():
    t = np.arange(0.0, 0.6, 1.0 / RATE)
    rng = np.random.default_rng(0)
    z = -0.5 * G * t**2 + NOISE * rng.normal(size=len(t))
    assert not struck_rows(t, z, NOISE, (), 20.0, 3).any()
    assert not struck_rows(t[:5], z[:5], NOISE, (), 20.0, 3).any()

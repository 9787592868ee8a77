"""Whether a time lies in an interval."""

# Tolerance [s]: times of events are sums of periods with rounding errors.
ROUNDING = 1e-9


def lasts(t: float, start: float, end: float) -> bool:
    """Whether t [s] is from `start` on and before `end`."""
    return start - ROUNDING <= t < end - ROUNDING

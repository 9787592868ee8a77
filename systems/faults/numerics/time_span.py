"""Whether an event's instant lies in a span of time."""

# An instant is a sum of periods: its rounding is no reason to wait for the next [s].
ROUNDING = 1e-9


def lasts(t: float, start: float, end: float) -> bool:
    """Whether t [s] is from `start` on and before `end`."""
    return start - ROUNDING <= t < end - ROUNDING

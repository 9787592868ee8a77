"""Where the times of a report count from."""

_DATE_SEC = 1e6  # Stamps beyond it count from a date, as Unix time, and are unreadable.


def zero_of(first: float) -> float:
    """The time that is shown as 0 [s]: 0, or a recording's first stamp where its stamps
    count from a date. first: that stamp [s]."""
    return first if abs(first) > _DATE_SEC else 0.0

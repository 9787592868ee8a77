"""The row of a bench that could not be measured."""


def failed(what: str, error: Exception) -> dict:
    """It has no value, says why, and counts as a missed target."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return {"what": what, "value": None, "met": False, "note": f"failed: {text}"}

"""The row of a benchmark that failed."""


def failed(what: str, error: Exception) -> dict:
    """A row without a value, with the error, that counts as a missed target."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return {"what": what, "value": None, "met": False, "note": f"failed: {text}"}

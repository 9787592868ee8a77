"""What benchmarks share: the row of one that failed, what may be asked of them."""


def failed(what: str, error: Exception) -> dict:
    """A row without a value, with the error, that counts as a missed target."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return {"what": what, "value": None, "met": False, "note": f"failed: {text}"}


def check_named(command: str, names, which: str, only: str) -> None:
    """Raises: ValueError for a --set, which this command does not have, or an --only
    that is in no name."""
    if which != "standard":
        raise ValueError(f"--set: got {which}, and {command} has no sets")
    if not any(only in name for name in names):
        raise ValueError(f"--only: got {only}, expected part of: {'; '.join(names)}")

"""meshcat.html: the animation of a run, for a browser without a server."""

from pydrake.geometry import Meshcat

_OPEN = "<script>viewer.gui.closed = false;</script>"


def with_controls(page: str) -> str:
    """A page of Meshcat's, with its controls open."""
    return page.replace("</body>", f"{_OPEN}</body>")


def page_of(meshcat: Meshcat) -> str:
    """Meshcat's recording as a page with its controls open: play, pause and time."""
    return with_controls(meshcat.StaticHtml())

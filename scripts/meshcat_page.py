"""meshcat.html: the animation of a run, for a browser without a server."""

from pydrake.geometry import Meshcat

_OPEN = "<script>viewer.gui.closed = false;</script>"


def page_of(meshcat: Meshcat) -> str:
    """Meshcat's page with its controls open: play, pause and the time."""
    return meshcat.StaticHtml().replace("</body>", f"{_OPEN}</body>")

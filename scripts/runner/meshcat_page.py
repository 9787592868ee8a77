"""meshcat.html: the animation of a run, for a browser without a server."""

from pydrake.geometry import Meshcat

OPEN_CONTROLS = "viewer.gui.closed = false"  # JavaScript in a page of Meshcat.


def page_of(meshcat: Meshcat) -> str:
    """Meshcat's page with its controls open: play, pause and the time."""
    opened = f"<script>{OPEN_CONTROLS};</script>"
    return meshcat.StaticHtml().replace("</body>", f"{opened}</body>")

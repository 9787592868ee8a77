"""meshcat.html: the animation of a run, for a browser without a server."""

from pydrake.geometry import Meshcat

OPEN_CONTROLS = "viewer.gui.closed = false"  # JavaScript in a page of Meshcat.


def page_of(meshcat: Meshcat) -> str:
    """Meshcat's page with its controls open: play, pause and the time. As #small,
    inside another page, it has none."""
    small = 'location.hash == "#small"'
    opened = f"<script>{small} ? viewer.gui.hide() : ({OPEN_CONTROLS});</script>"
    return meshcat.StaticHtml().replace("</body>", f"{opened}</body>")

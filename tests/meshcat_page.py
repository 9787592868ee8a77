"""A stand-in for the page that receives Meshcat's messages."""

import numpy as np


class Browser:
    """A fake Meshcat that keeps poses and scales as the page in the browser does: it
    splits a transform into translation, rotation and scale, so that a transform resets
    the scale of its path to 1, and the scale of a path applies to all paths below it.
    """

    def __init__(self):
        self.pose, self.scale = {}, {}

    def SetTransform(self, path, X, *_):
        self.pose[path] = X.translation()
        self.scale[path] = np.ones(3)

    def SetProperty(self, path, name, value, *_):
        if name == "scale":
            self.scale[path] = np.array(value)

    def shown_scale(self, path):
        """(3,) of the object that was set at a path."""
        parts = f"{path}/<object>".split("/")
        above = ["/".join(parts[: k + 1]) for k in range(1, len(parts))]
        return np.prod([self.scale.get(p, np.ones(3)) for p in above], axis=0)

    def __getattr__(self, _):
        return lambda *_: None

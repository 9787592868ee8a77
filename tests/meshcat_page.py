"""What a page makes of the messages that Meshcat sends to it."""

import numpy as np


class Browser:
    """Stands for Meshcat, and holds poses and scales as the page in the browser does:
    a transform is split into place, turn and scale, so it sets its path's scale to 1,
    and what lies below a path is scaled with it."""

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

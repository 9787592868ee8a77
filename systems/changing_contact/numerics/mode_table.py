"""Contact modes as clusters of features: BIRCH, and a table of modes over it.

BIRCH's subclusters change their order when a leaf splits, and one mode may have several
of them. So modes have numbers of their own, from 1, and centroids of their own; a
subcluster belongs to the mode with the nearest centroid.

Source: CC section 3.2; Zhang, Ramakrishnan, Livny, "BIRCH: a new data clustering
algorithm" (1997), as scikit-learn has it.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from sklearn.cluster import Birch

BAND = 1.5  # Thresholds from a subcluster within which a sample belongs to it,
REACH = 2.0  # and from a mode's centroid to a subcluster that is its own.
WEIGHT_MAX = 300.0  # Samples for which a centroid counts at most: it follows slowly.
SAMPLES_MAX = 3000  # Samples that BIRCH gets; what comes later moves centroids alone.


@dataclass(frozen=True, eq=False)
class ModeTable:
    """The modes that are known: a value; learning makes a new one."""

    threshold: float  # Radius of a subcluster, in units of the feature.
    centroids: np.ndarray  # (n_modes, d), mode k + 1 in row k.
    weights: np.ndarray  # (n_modes,) samples that each has had.
    # (n, d) All that BIRCH has been given, in order. Its tree is grown anew from them
    # when a batch comes (5 us per sample): scikit-learn's tree cannot be copied, for
    # its nodes hold views of their own arrays, and a tree that is shared would let a
    # restored Context see what was learned after it.
    samples: np.ndarray
    centres: np.ndarray  # (n_subclusters, d)
    labels: np.ndarray  # (n_subclusters,) mode of each, 0: none.

    def __post_init__(self):
        for name in ("centroids", "weights", "samples", "centres", "labels"):
            getattr(self, name).setflags(write=False)

    def __copy__(self):
        return self

    def __deepcopy__(self, _):
        return self

    def __len__(self) -> int:
        return len(self.centroids)

    def nearest(self, feature) -> tuple[int, float]:
        """Number of the mode with the nearest centroid and the distance; 0, inf if
        there is none."""
        if not len(self):
            return 0, np.inf
        distance = np.sqrt(np.sum((self.centroids - feature) ** 2, axis=1))
        k = int(np.argmin(distance))
        return k + 1, float(distance[k])

    def fractions(self, batch, tolerance: float = 0.0) -> np.ndarray:
        """(n_modes,) share of the samples of batch (n, d) that belong to each mode.

        Args: tolerance, of the distance to a subcluster, if more than BAND thresholds.
        """
        count = np.zeros(len(self))
        if not len(self):
            return count
        distance = np.linalg.norm(batch[:, None] - self.centres[None], axis=2)
        nearest = np.argmin(distance, axis=1)
        inside = distance[np.arange(len(batch)), nearest] <= max(
            BAND * self.threshold, tolerance
        )
        for mode in self.labels[nearest[inside]]:
            if mode:
                count[mode - 1] += 1.0
        return count / len(batch)

    def learned(self, batch, mode: int) -> "ModeTable":
        """The table after batch (n, d) was found to be of a mode, maybe of a new one:
        number len(self) + 1."""
        batch = np.array(batch, dtype=float)
        centroids, weights = self.centroids, self.weights
        if mode == len(self) + 1:
            centroids = np.vstack([centroids, batch.mean(axis=0)])
            weights = np.append(weights, float(len(batch)))
        else:
            centroids, weights = centroids.copy(), weights.copy()
            share = len(batch) / (weights[mode - 1] + len(batch))
            centroids[mode - 1] += share * (batch.mean(axis=0) - centroids[mode - 1])
            weights[mode - 1] = min(weights[mode - 1] + len(batch), WEIGHT_MAX)
        samples = self.samples
        if len(samples) + len(batch) <= SAMPLES_MAX:
            samples = np.vstack([samples, batch])
        return _labelled(self.threshold, centroids, weights, samples)

    def save(self, path: str | Path) -> None:
        """Writes it as JSON."""
        data = {"threshold": self.threshold}
        for name in ("centroids", "weights", "samples"):
            data[name] = getattr(self, name).tolist()
        Path(path).write_text(json.dumps(data) + "\n")

    @staticmethod
    def load(path: str | Path) -> "ModeTable":
        """What `save` wrote.

        Raises: ValueError if the file is missing or is no table.
        """
        try:
            data = json.loads(Path(path).read_text())
            d = len(data["samples"][0]) if data["samples"] else 1
            samples = np.array(data["samples"], dtype=float).reshape(-1, d)
            centroids = np.array(data["centroids"], dtype=float).reshape(-1, d)
            weights = np.array(data["weights"], dtype=float)
            threshold = float(data["threshold"])
            if weights.shape != (len(centroids),):
                raise ValueError("one weight per centroid is expected")
            if not all(np.all(np.isfinite(a)) for a in (samples, centroids, weights)):
                raise ValueError("a number is not finite")
            return _labelled(threshold, centroids, weights, samples)
        except (OSError, KeyError, TypeError, IndexError, ValueError) as error:
            raise ValueError(f"modes {path}: {' '.join(str(error).split())}") from None


def no_modes(n_features: int, threshold: float) -> ModeTable:
    """A table without modes."""
    none = np.zeros((0, n_features))
    return _labelled(float(threshold), none, np.zeros(0), none)


def _labelled(threshold, centroids, weights, samples) -> ModeTable:
    """The table, with the subclusters told off to the modes."""
    centres = np.zeros((0, centroids.shape[1]))
    if len(samples):
        tree = Birch(n_clusters=None, threshold=threshold, compute_labels=False)
        centres = np.array(tree.partial_fit(samples).subcluster_centers_, dtype=float)
    # A mode's own centroid counts as a subcluster: BIRCH may have merged it away.
    centres = np.vstack([centres, centroids])
    labels = np.zeros(len(centres), dtype=int)
    if len(centroids):
        distance = np.linalg.norm(centres[:, None] - centroids[None], axis=2)
        nearest = np.argmin(distance, axis=1)
        near = distance[np.arange(len(centres)), nearest] <= REACH * threshold
        labels[near] = nearest[near] + 1
    return ModeTable(threshold, centroids, weights, samples, centres, labels)

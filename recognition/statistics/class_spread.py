"""Class spread: a covariance for each class, between that of its grasps and the shared one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recognition.records import ArrayRecord

_PRIOR_GRASPS = 15.0
"""Weight of the shared covariance in that of a class, in grasps."""
_PAIRS = 1 << 14
"""Pairs of a point and a class that are computed at once: more would not fit into the caches."""
_MOST_AXES = 48
"""Number of axes, those that separate best: more cost time and memory."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassSpread(ArrayRecord):
    """Covariances of C classes in a space where the shared covariance is the identity."""

    centres: NDArray[np.float64]
    """(C, k) float64: the classes along the first k axes."""
    precision: NDArray[np.float32]
    """(C, k, k) float32: inverse of the covariance of each class along these axes."""
    log_volume: NDArray[np.float64]
    """(C,) float64: half the logarithm of its determinant."""

    def distances(
        self,
        z: NDArray[np.float64],
        plain: NDArray[np.float64],
        classes: NDArray[np.int64] | slice = slice(None),
    ) -> NDArray[np.float64]:
        """Return (n, K) squared distances of points to some classes, by the covariance of each.

        `z` (n, r) are the points, `plain` (n, K) their squared distances by the shared covariance.
        """
        centres, n_axes = self.centres[classes, None], self.centres.shape[1]
        beyond = self.precision[classes] - np.eye(n_axes)
        n_rows = max(1, _PAIRS // len(centres))
        offs = (
            z[start : start + n_rows, :n_axes] - centres
            for start in range(0, max(1, len(z)), n_rows)
        )
        added = np.concatenate([((off @ beyond) * off).sum(axis=-1).T for off in offs])
        return np.asarray(np.maximum(plain + added, 0.0), dtype=np.float64)


def fit_class_spread(
    z: NDArray[np.float64], classes: NDArray[np.int64], centres: NDArray[np.float64]
) -> ClassSpread:
    """Return the spread of points z (n, r) with classes (n,) about their centres (C, r)."""
    centres = centres[:, :_MOST_AXES]
    off = z[:, : centres.shape[1]] - centres[classes]
    # Taught grasps are closer to their centre than later ones; only the form counts here.
    off = off / max(float(np.sqrt((off**2).mean())), 1e-6)
    shared = _PRIOR_GRASPS * np.eye(centres.shape[1])
    covariance = np.stack(
        [
            (shared + off[classes == c].T @ off[classes == c])
            / (_PRIOR_GRASPS + np.count_nonzero(classes == c))
            for c in range(len(centres))
        ]
    )
    return ClassSpread(
        centres=centres,
        precision=np.linalg.inv(covariance).astype(np.float32),
        log_volume=0.5 * np.linalg.slogdet(covariance)[1],
    )

"""Class spread: covariance of each class, beside the covariance that all classes share.

Each class has a covariance of its own, from its few taught grasps and, as if by `_PRIOR_GRASPS`
more of them, from the one that all classes share. It differs from the shared one only in the
directions of its own grasps, so it is kept as those.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

_PRIOR_GRASPS = 15.0
"""Weight of the shared covariance in the covariance of a class, in grasps
(docs/explanations/recogniser.md)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassSpread:
    """Covariances of C classes in a space of r dimensions, where the shared one is the identity.

    Attributes
    ----------
    axes : (m, r) float64
        Directions in which classes vary more than they would by the shared covariance alone,
        sorted by class; each class has at least one.
    origin : (m,) float64
        Centre of the class along each of them.
    first : (C,) int64
        Where the directions of each class begin.
    across : (C,) float64
        What a squared distance is multiplied by in all other directions.
    log_volume : (C,) float64
        Half the logarithm of the determinant.
    """

    axes: NDArray[np.float64]
    origin: NDArray[np.float64]
    first: NDArray[np.int64]
    across: NDArray[np.float64]
    log_volume: NDArray[np.float64]

    def distances(self, z: NDArray[np.float64], plain: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (h, C) squared distances to the centres in standard deviations of each class.

        `z` (h, r) are the points, `plain` (h, C) their squared distances by the shared covariance.
        """
        along = z @ self.axes.T
        along -= self.origin
        along *= along
        less = np.add.reduceat(along, self.first, axis=1)
        return np.asarray(np.maximum(plain * self.across - less, 0.0), dtype=np.float64)

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        return {
            f"{prefix}axes": self.axes,
            f"{prefix}origin": self.origin,
            f"{prefix}first": self.first,
            f"{prefix}across": self.across,
            f"{prefix}log_volume": self.log_volume,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(
            axes=arrays[f"{prefix}axes"],
            origin=arrays[f"{prefix}origin"],
            first=arrays[f"{prefix}first"],
            across=arrays[f"{prefix}across"],
            log_volume=arrays[f"{prefix}log_volume"],
        )


def fit_spread(
    samples: NDArray[np.float64],
    classes: NDArray[np.int64],
    weight: NDArray[np.float64],
    centres: NDArray[np.float64],
) -> ClassSpread:
    """Return the spread of samples (m, r), sorted by class, with weights (m,)."""
    rank = samples.shape[1]
    residuals = (samples - centres[classes]) * np.sqrt(weight)[:, None]
    # Taught grasps lie closer to their centre than others will; only the form counts here.
    residuals /= np.sqrt(max(float((residuals**2).sum()) / (float(weight.sum()) * rank), 1e-12))
    axes, origin, across, log_volume = [], [], [], []
    for label, centre in enumerate(centres):
        mine = classes == label
        total = float(weight[mine].sum()) + _PRIOR_GRASPS
        _, singular, directions = np.linalg.svd(residuals[mine], full_matrices=False)
        floor = _PRIOR_GRASPS / total
        along = (singular**2 + _PRIOR_GRASPS) / total
        scaled = directions * np.sqrt(1.0 / floor - 1.0 / along)[:, None]
        axes.append(scaled)
        origin.append(scaled @ centre)
        across.append(1.0 / floor)
        log_volume.append(0.5 * (rank * np.log(floor) + float(np.log(along / floor).sum())))
    return ClassSpread(
        axes=np.concatenate(axes),
        origin=np.concatenate(origin),
        first=np.cumsum([0, *(len(part) for part in axes[:-1])]),
        across=np.array(across),
        log_volume=np.array(log_volume),
    )

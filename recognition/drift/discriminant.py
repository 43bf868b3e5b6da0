"""Discriminant of drifts: combinations of features that show a drift, whatever was grasped."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.statistics.lda import fit_lda

_FREEDOM = 3.0
"""Degrees of freedom of the t distribution of a grasp about its object: heavy tails."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriftDiscriminant:
    """A discriminant of drifts instead of objects.

    Attributes
    ----------
    projection : (F, r) float64
        From features to the space that separates drifts, where grasps of one object have unit
        covariance.
    centres : (C, r) float64
        The objects in that space, without drift.
    """

    projection: NDArray[np.float64]
    centres: NDArray[np.float64]

    def log_likelihood(
        self, tactile: NDArray[np.float64], aperture: NDArray[np.float64], label: int
    ) -> NDArray[np.float64]:
        """Return (G, O), up to a constant: of one grasp of a known object under each drift.

        `tactile` (G, Ft) and `aperture` (O, Fa) are its features with each gain and each offset
        undone. The tails are heavy: a single grasp may lie off.
        """
        n, rank = tactile.shape[1], self.projection.shape[1]
        touch = tactile @ self.projection[:n] - self.centres[label]
        opening = aperture @ self.projection[n:]
        squared = ((touch[:, None] + opening) ** 2).sum(axis=-1)
        likelihood: NDArray[np.float64] = -0.5 * (_FREEDOM + rank) * np.log1p(squared / _FREEDOM)
        return likelihood

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        return {f"{prefix}projection": self.projection, f"{prefix}centres": self.centres}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(projection=arrays[f"{prefix}projection"], centres=arrays[f"{prefix}centres"])


def fit_drift_discriminant(
    features: NDArray[np.float64],
    drifted: NDArray[np.float64],
    classes: NDArray[np.int64],
    n_classes: int,
) -> DriftDiscriminant:
    """Return a discriminant of drifts, from grasps and the same ones under a few drifts.

    Parameters
    ----------
    features : (n, F)
        Without drift.
    drifted : (k, n, F)
        Under k drifts.
    classes : (n,)
        Class of each grasp.
    n_classes
        Number of objects.

    Raises
    ------
    ValueError
        There are fewer grasps than show how grasps of one object vary.
    """
    means = np.stack([features[classes == c].mean(axis=0) for c in range(n_classes)])
    states = np.concatenate([features[None], drifted]) - means[classes]
    k, n, _ = states.shape
    lda = fit_lda(
        states.reshape(k * n, -1), np.repeat(np.arange(k), n), k, n_independent=n - n_classes + k
    )
    projection = lda.projection / lda.scale[:, None]
    return DriftDiscriminant(projection=projection, centres=means @ projection)

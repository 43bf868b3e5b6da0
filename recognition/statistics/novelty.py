"""Novelty detector: probability that an object was never taught, fitted on left-out objects."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

KNOWN_KEPT = 0.97
"""Share of grasps of taught objects that are to have ``unknown`` below 0.5."""

_RIDGE = 1.0
"""Ridge of the logistic regression, on features of unit deviation."""
_SINGLE_SLOPE = 2.0
"""Log odds for each unit of the log distance to the nearest class, where no object can be left
out."""
_LEAST_DISTANCE = 0.1
"""Added to squared distances before their logarithm: nearer grasps are no less novel."""


def novelty_features(
    distances: NDArray[np.float64],
    own_distances: NDArray[np.float64],
    nearest_sample: NDArray[np.float64],
    beside: NDArray[np.float64],
    second_distances: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return (n, 5) or (n, 7) novelty features of grasps, all logarithms of squared distances.

    Parameters
    ----------
    distances : (n, C)
        Squared distance of each grasp to each class. With a single class the second feature, the
        nearest class against the next, is 0.
    own_distances : (n, C)
        The same, in standard deviations of each class instead of those that all share.
    nearest_sample : (n,)
        Squared distance to the nearest taught grasp.
    beside : (n,)
        Squared distance from all classes in the directions in which they do not differ: a new
        object may differ there.
    second_distances : (n, C), optional
        Squared distances by another discriminant: of the class that the first one finds nearest,
        and against its own nearest. An odd grasp of a taught object is far in both, a new one in
        one.
    """
    ordered = np.sort(distances, axis=1)
    next_best = ordered[:, min(1, ordered.shape[1] - 1)]
    rows, nearest = np.arange(len(distances)), np.argmin(distances, axis=1)
    features = [
        _log(ordered[:, 0]),
        _log(ordered[:, 0]) - _log(next_best),
        _log(nearest_sample),
        _log(own_distances[rows, nearest]),
        _log(beside),
    ]
    if second_distances is not None:
        best = second_distances[rows, nearest]
        features += [_log(best), _log(best) - _log(second_distances.min(axis=1))]
    return np.stack(features, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoveltyDetector:
    """Logistic regression from novelty features to the probability that an object is new.

    Attributes
    ----------
    mean, scale, weight : (S,) float64
        Log odds are the weighted sum of the centred and scaled features, plus `offset`.
    offset
        Puts ``KNOWN_KEPT`` of the grasps of taught objects below even odds.
    """

    mean: NDArray[np.float64]
    scale: NDArray[np.float64]
    weight: NDArray[np.float64]
    offset: float

    def probability(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n,) probabilities that the object was never taught, for features (n, S)."""
        odds = ((features - self.mean) / self.scale) @ self.weight + self.offset
        return np.asarray(expit(odds), dtype=np.float64)

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        return {
            f"{prefix}mean": self.mean,
            f"{prefix}scale": self.scale,
            f"{prefix}weight": self.weight,
            f"{prefix}offset": np.array(self.offset),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(
            mean=arrays[f"{prefix}mean"],
            scale=arrays[f"{prefix}scale"],
            weight=arrays[f"{prefix}weight"],
            offset=float(arrays[f"{prefix}offset"]),
        )


def fit_novelty_detector(
    known: NDArray[np.float64],
    left_out: NDArray[np.float64],
    kept: NDArray[np.float64],
) -> NoveltyDetector:
    """Fit the detector on grasps of taught objects and of objects left out of teaching.

    Parameters
    ----------
    known, left_out : (n, S)
        Features of both kinds, from the same fits. With none of either, distance alone decides.
    kept : (n, S)
        Features of grasps of taught objects, out of sample, that place the even odds.
    """
    every = np.concatenate([known, left_out, kept])
    mean, scale = every.mean(axis=0), every.std(axis=0) + 1e-6
    n_features = every.shape[1]
    if len(known) and len(left_out):
        rows = (np.concatenate([known, left_out]) - mean) / scale
        is_new = np.repeat([False, True], [len(known), len(left_out)])
        weight = _logistic(rows, is_new)
    else:
        weight = np.zeros(n_features)
        weight[0] = _SINGLE_SLOPE * scale[0]
    scores = ((kept - mean) / scale) @ weight
    return NoveltyDetector(
        mean=mean, scale=scale, weight=weight, offset=-float(np.quantile(scores, KNOWN_KEPT))
    )


def _logistic(rows: NDArray[np.float64], is_new: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the weights of a logistic regression in which both kinds count alike."""
    design = np.column_stack([rows, np.ones(len(rows))])
    sign = np.where(is_new, 1.0, -1.0)
    share = float(is_new.mean())
    balance = np.where(is_new, 0.5 / share, 0.5 / (1.0 - share))

    def loss(v: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        margin = sign * (design @ v)
        value = float((balance * np.logaddexp(0.0, -margin)).sum())
        slope = -(balance * sign * expit(-margin)) @ design
        slope[:-1] += _RIDGE * v[:-1]
        return value + 0.5 * _RIDGE * float((v[:-1] ** 2).sum()), slope

    found = minimize(loss, np.zeros(design.shape[1]), jac=True, method="BFGS")
    return np.asarray(found.x[:-1], dtype=np.float64)


def _log(squared_distance: NDArray[np.float64]) -> NDArray[np.float64]:
    logs: NDArray[np.float64] = np.log(np.maximum(squared_distance, 0.0) + _LEAST_DISTANCE)
    return logs

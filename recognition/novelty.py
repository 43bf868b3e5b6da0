"""Is the object one that was never taught? Learnt by leaving taught objects out."""

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
_SINGLE_SLOPE = 2.0


def novelty_signs(
    distances: NDArray[np.float64],
    own_distances: NDArray[np.float64],
    nearest_sample: NDArray[np.float64],
    beside: NDArray[np.float64],
    second_opinion: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return (n, 5) or (n, 7) signs of a strange grasp, all logarithms.

    Parameters
    ----------
    distances : (n, C)
        Squared distance of each grasp to each class. With a single class the second sign, how
        much nearer the best class is than the next, is 0.
    own_distances : (n, C)
        The same, in standard deviations of each class instead of those that all share.
    nearest_sample : (n,)
        Squared distance to the nearest taught grasp.
    beside : (n,)
        Squared distance from all classes in the directions in which they do not differ: what they
        have in common a new object need not have.
    second_opinion : (n, C), optional
        Squared distances seen by another discriminant: how far it finds the class that the first
        one finds nearest. An odd grasp of a taught object is far in both, a new object in one.
    """
    ordered = np.sort(distances, axis=1)
    next_best = ordered[:, min(1, ordered.shape[1] - 1)]
    rows, nearest = np.arange(len(distances)), np.argmin(distances, axis=1)
    signs = [
        _log(ordered[:, 0]),
        _log(ordered[:, 0]) - _log(next_best),
        _log(nearest_sample),
        _log(own_distances[rows, nearest]),
        _log(beside),
    ]
    if second_opinion is not None:
        best = second_opinion[rows, nearest]
        signs += [_log(best), _log(best) - _log(second_opinion.min(axis=1))]
    return np.stack(signs, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Novelty:
    """From signs to the probability that an object was never taught.

    Attributes
    ----------
    mean, scale, weight : (S,) float64
        Log odds are the weighted sum of the centred and scaled signs, plus `offset`.
    offset
        Puts ``KNOWN_KEPT`` of the grasps of taught objects below even odds.
    """

    mean: NDArray[np.float64]
    scale: NDArray[np.float64]
    weight: NDArray[np.float64]
    offset: float

    def probability(self, signs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n,) probabilities that the object was never taught, for signs (n, S)."""
        odds = ((signs - self.mean) / self.scale) @ self.weight + self.offset
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


def fit_novelty(
    known: NDArray[np.float64],
    left_out: NDArray[np.float64],
    kept: NDArray[np.float64],
) -> Novelty:
    """Learn from grasps of known objects and of objects left out of teaching.

    Parameters
    ----------
    known, left_out : (n, S)
        Signs of both kinds, from the same fits. With none of either, distance alone decides.
    kept : (n, S)
        Signs of grasps of known objects, out of sample, that place the even odds.
    """
    every = np.concatenate([known, left_out, kept])
    mean, scale = every.mean(axis=0), every.std(axis=0) + 1e-6
    n_signs = every.shape[1]
    if len(known) and len(left_out):
        rows = (np.concatenate([known, left_out]) - mean) / scale
        strange = np.repeat([False, True], [len(known), len(left_out)])
        weight = _logistic(rows, strange)
    else:
        weight = np.zeros(n_signs)
        weight[0] = _SINGLE_SLOPE * scale[0]
    scores = ((kept - mean) / scale) @ weight
    return Novelty(
        mean=mean, scale=scale, weight=weight, offset=-float(np.quantile(scores, KNOWN_KEPT))
    )


def _logistic(rows: NDArray[np.float64], strange: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the weights of a logistic regression in which both kinds count alike."""
    design = np.column_stack([rows, np.ones(len(rows))])
    sign = np.where(strange, 1.0, -1.0)
    share = float(strange.mean())
    balance = np.where(strange, 0.5 / share, 0.5 / (1.0 - share))

    def loss(v: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        margin = sign * (design @ v)
        value = float((balance * np.logaddexp(0.0, -margin)).sum())
        slope = -(balance * sign * expit(-margin)) @ design
        slope[:-1] += _RIDGE * v[:-1]
        return value + 0.5 * _RIDGE * float((v[:-1] ** 2).sum()), slope

    found = minimize(loss, np.zeros(design.shape[1]), jac=True, method="BFGS")
    return np.asarray(found.x[:-1], dtype=np.float64)


def _log(squared_distance: NDArray[np.float64]) -> NDArray[np.float64]:
    logs: NDArray[np.float64] = np.log(np.maximum(squared_distance, 0.0) + 0.1)
    return logs

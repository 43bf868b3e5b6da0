"""Calibration: from scores to probabilities by one temperature, fitted out of sample."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax

UNIFORM_SHARE = 0.002
"""Share of the uniform distribution in each posterior, so that no taught object is impossible."""

_LOG_TEMPERATURES = (-3.0, 7.0)
"""Range of the logarithm of the temperature that is searched."""
MOST_TEMPERATURE = float(np.exp(2.0 * _LOG_TEMPERATURES[1]))
"""Temperature that no teaching gives, like its reciprocal."""
_N_TEMPERATURES = 41
"""Temperatures tried before the search is refined, because the loss may have several minima."""


_USUAL_TEMPERATURE = 2.0
"""Temperature that is expected before any grasp: features repeat each other, so the computed log
odds are too large."""
_TEMPERATURE_SD = 0.5
"""Standard deviation of the logarithm of that expectation. It decides if held-out grasps are few or
all right; without it every answer would be certain."""


def blocked_folds(classes: NDArray[np.int64], n_folds: int) -> list[NDArray[np.bool_]]:
    """Return for each fold a mask of the rows held out: one run in time of each class.

    Rows of one class must be in the order of time. Classes with too few rows keep at least one
    of them outside of every fold.
    """
    n = len(classes)
    fold_of = np.full(n, -1, dtype=np.int64)
    for k in np.unique(classes):
        rows = np.flatnonzero(classes == k)
        folds = min(n_folds, len(rows))
        if folds > 1:
            fold_of[rows] = np.arange(len(rows)) * folds // len(rows)
    return [fold_of == fold for fold in range(n_folds) if np.any(fold_of == fold)]


def fit_temperature(scores: NDArray[np.float64], classes: NDArray[np.int64]) -> float:
    """Return the likeliest temperature T of softmax(scores / T), scores (n, C), with a prior."""
    rows = np.arange(len(classes))

    def loss(log_t: float) -> float:
        p = to_probability(scores, float(np.exp(log_t)))
        prior = 0.5 * ((log_t - np.log(_USUAL_TEMPERATURE)) / _TEMPERATURE_SD) ** 2
        return float(prior - np.log(p[rows, classes]).sum())

    # The uniform share bounds the loss of each row, so there may be several minima.
    grid = np.linspace(*_LOG_TEMPERATURES, _N_TEMPERATURES)
    best = float(grid[int(np.argmin([loss(float(t)) for t in grid]))])
    step = float(grid[1] - grid[0])
    refined = minimize_scalar(loss, bounds=(best - step, best + step), method="bounded")
    return float(np.exp(refined.x))


def to_probability(scores: NDArray[np.float64], temperature: float) -> NDArray[np.float64]:
    """Return (n, C) probabilities: softmax(scores / T) with a small uniform share."""
    p = np.exp(log_softmax(scores / temperature, axis=1))
    p = (1.0 - UNIFORM_SHARE) * p + UNIFORM_SHARE / scores.shape[1]
    return np.asarray(p / p.sum(axis=1, keepdims=True), dtype=np.float64)

"""A few grasps of one known object -> what drifted since it was taught."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recognition.drift import Drift, DriftGrid

_DEPENDENCE = 0.2
"""Grasps of one object repeat each other: three tell less than three times what one tells."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gauged:
    """What gauge grasps told.

    Attributes
    ----------
    drift
        The mean of what it may be.
    log_gain_sd
        Standard deviation of the logarithm of the gain that is left.
    offset_sd_m
        Standard deviation of the offset of the opening that is left, in m; the spread of the prior
        where the opening is not used.
    n_grasps
        Number of grasps that told something.
    """

    drift: Drift
    log_gain_sd: float
    offset_sd_m: float
    n_grasps: int


def estimate_drift(log_likelihood: NDArray[np.float64], grid: DriftGrid) -> Gauged:
    """Return mean and spread of the drift after some grasps of a known object.

    Parameters
    ----------
    log_likelihood : (n, G, O)
        Of each grasp under each drift of the grid, given what was held.
    grid
        What the drift may be, without the grasps.

    Raises
    ------
    ValueError
        There is no grasp.
    """
    n = len(log_likelihood)
    if n == 0:
        raise ValueError("no gauge grasp touched both pads: grasp the gauge object again")
    total = grid.log_prior + log_likelihood.sum(axis=0) / (1.0 + (n - 1) * _DEPENDENCE)
    p = np.exp(total - logsumexp(total))
    log_gain, log_gain_sd = _moments(np.log(grid.gains), p.sum(axis=1))
    offset_mm, offset_sd_mm = _moments(grid.offsets_mm, p.sum(axis=0))
    return Gauged(
        drift=Drift(gain=float(np.exp(log_gain)), aperture_offset_m=offset_mm * 1e-3),
        log_gain_sd=log_gain_sd,
        offset_sd_m=offset_sd_mm * 1e-3,
        n_grasps=n,
    )


def _moments(values: NDArray[np.float64], p: NDArray[np.float64]) -> tuple[float, float]:
    mean = float(p @ values)
    return mean, float(np.sqrt(p @ (values - mean) ** 2))

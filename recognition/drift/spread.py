"""Spread of drifts: how far days and cells lie apart, learnt from grasps of the same objects.

A day effect is what all values of a day have in common, beside what belongs to the objects.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.drift.grid import DriftPrior
from recognition.features import sizes_mm
from recognition.grasp import Grasp
from recognition.ramp.levels import load_levels
from recognition.ramp.ramp import learn_rest

_PRIOR_GROUPS = 3.0
"""Weight of the usual spread between days, in days: few of them show little."""
_LEAST_LOG_GAIN_SD, _LEAST_OFFSET_SD_MM = 0.03, 0.3
"""Least deviations of gain (log) and opening: a step of the grid, and how objects are placed."""


def learn_spread(grasps: Sequence[Grasp], groups: Sequence[str]) -> DriftPrior | None:
    """Return the prior of the drift on a new day or cell; None where the grasps show none.

    Parameters
    ----------
    grasps
        Labelled grasps of n_groups days or cells.
    groups
        Day and cell of each of them.
    """
    levels = load_levels(grasps, learn_rest(grasps))
    loads = np.stack([maps[:, -1].sum(axis=1) for maps in levels.maps], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        values = np.stack([np.log(loads).mean(axis=1), sizes_mm(levels)[:, 1]], axis=1)
    labels, label = np.unique([g.label for g in grasps], return_inverse=True)
    names, group = np.unique(groups, return_inverse=True)
    usual = DriftPrior()
    sds = []
    for value, sd, least in (
        (values[:, 0], usual.log_gain_sd, _LEAST_LOG_GAIN_SD),
        (values[:, 1], usual.offset_sd_mm, _LEAST_OFFSET_SD_MM),
    ):
        known = np.isfinite(value) & levels.touched
        total, n = np.zeros((2, len(names), len(labels)))
        np.add.at(total, (group[known], label[known]), value[known])
        np.add.at(n, (group[known], label[known]), 1.0)
        mean = total / np.maximum(n, 1.0)
        n *= np.count_nonzero(n, axis=0) > 1  # an object of one group shows no difference
        rows = n.sum(axis=1) > 0
        freedom = np.count_nonzero(rows) - 1
        if freedom < 1:
            return None
        effect = day_effects(mean[rows], n[rows])
        # A new group differs from the mean of the taught ones by both their errors.
        between = float(effect @ effect) * (1.0 + 1.0 / len(effect))
        variance = (_PRIOR_GROUPS * sd**2 + between) / (_PRIOR_GROUPS + freedom)
        sds.append(max(least, float(np.sqrt(variance))))
    return DriftPrior(log_gain_sd=min(1.0, sds[0]), offset_sd_mm=min(30.0, sds[1]), unchanged=0.0)


def day_effects(mean: NDArray[np.float64], n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the effect of each of D days, (D,) float64 with the mean 0, by least squares.

    Parameters
    ----------
    mean : (D, L)
        Mean value of each object on each day; any number where there is none.
    n : (D, L)
        Number of values; each day has some.
    """
    day, label = np.nonzero(n)
    weight = np.sqrt(n[day, label])
    design = np.concatenate([np.eye(len(n))[day], np.eye(n.shape[1])[label]], axis=1)
    effects = np.linalg.lstsq(design * weight[:, None], mean[day, label] * weight)[0][: len(n)]
    return np.asarray(effects - effects.mean(), dtype=np.float64)

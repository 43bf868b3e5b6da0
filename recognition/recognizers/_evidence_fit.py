"""Teaches what one look at a grasp tells: the discriminants, the samples and their spread."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from recognition.lda import fit_lda
from recognition.recognizers._class_spread import fit_spread
from recognition.recognizers._evidence import Evidence

_VIRTUAL_WEIGHT = 0.3
_MOST_AXES = 48
"""Beyond these, means of many classes differ by little else than the few grasps of each."""
_MIN_SHRINKAGE = 0.15
"""Grasps of another placing vary in other directions than the taught ones do."""


def fit_evidence(
    features: NDArray[np.float64],
    classes: NDArray[np.int64],
    n_classes: int,
    *,
    virtual: NDArray[np.float64] | None = None,
    nuisance: NDArray[np.float64] | None = None,
    n_second: int | None = None,
) -> Evidence:
    """Teach classes.

    Parameters
    ----------
    features : (n, F)
        Finite features.
    classes : (n,)
        Class of each row.
    n_classes
        Number of classes.
    virtual : (n, F), optional
        Features of a virtual grasp for each row; it counts 0.3 of a real one.
    nuisance : (m, F), optional
        Deviations that the next placing may bring, whatever is grasped; together they count as one
        grasp of each class.
    n_second
        How many of the first features the second opinion goes by; None for no second opinion.

    Raises
    ------
    ValueError
        The rows do not show how grasps of one class vary.
    """
    n = len(features)
    rows, labels, weight = features, classes, np.ones(n)
    if virtual is not None:
        rows = np.concatenate([features, virtual])
        labels = np.concatenate([classes, classes])
        weight = np.concatenate([weight, np.full(n, _VIRTUAL_WEIGHT)])
    if n <= n_classes:
        rows, labels, weight = features, classes, np.ones(n)
    teach = partial(
        fit_lda,
        classes=labels,
        n_classes=n_classes,
        min_shrinkage=_MIN_SHRINKAGE,
        n_independent=n,
        weight=weight,
        max_rank=_MOST_AXES,
    )
    if nuisance is not None:
        # Together they count as one grasp of each class: what many grasps show outweighs them.
        nuisance = nuisance * np.sqrt(n_classes / n)
    first = teach(rows, nuisance=nuisance, keep_whitening=True)
    second = None
    if n_second is not None:
        cut = None if nuisance is None else nuisance[:, :n_second]
        second = teach(rows[:, :n_second], nuisance=cut)
    order = np.argsort(labels, kind="stable")
    labels, weight = labels[order], weight[order]
    total = np.bincount(labels, weights=weight, minlength=n_classes)
    samples = first.project(rows[order])
    return Evidence(
        discriminant=first,
        second=second,
        samples=samples,
        sample_class=labels,
        log_weight=np.log(weight / total[labels]),
        spread=fit_spread(samples, labels, weight, first.centres),
    )

"""Measures of recognition: confusion, intervals, calibration and separation."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

_N_BINS = 10
"""Bins of confidence of the calibration error."""


def confusion_matrix(
    truth: Sequence[str], answers: Sequence[str], labels: Sequence[str]
) -> NDArray[np.int64]:
    """Return (C, C) counts: row = true label, column = answer, in the order of `labels`.

    Raises ValueError where the lengths differ or a label is not listed.
    """
    if len(truth) != len(answers):
        raise ValueError(f"{len(truth)} truths and {len(answers)} answers")
    index = {label: i for i, label in enumerate(labels)}
    missing = sorted({*truth, *answers} - set(index))
    if missing:
        raise ValueError(f"labels {missing} are not listed")
    table = np.zeros((len(labels), len(labels)), dtype=np.int64)
    for true, answer in zip(truth, answers, strict=True):
        table[index[true], index[answer]] += 1
    return table


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """Return the Wilson score interval of a proportion at 95 %; (0, 1) where n is 0.

    Raises ValueError where successes are not from 0 to n.
    """
    if not 0 <= successes <= n:
        raise ValueError(f"{successes} of {n} is no proportion")
    if n == 0:
        return 0.0, 1.0
    z = float(ndtri(0.975))
    p = successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * float(np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)))
    return max(0.0, min(p, centre - half)), min(1.0, max(p, centre + half))


def paired_difference(first: ArrayLike, second: ArrayLike) -> tuple[float, tuple[float, float]]:
    """Return the difference of the second accuracy to the first, and its 95 % interval.

    Wald's interval with half a grasp added to each cell (Agresti and Min 2005, Stat. Med. 24:729).

    Parameters
    ----------
    first, second : (n,)
        Whether each was right on the same n grasps.

    Raises
    ------
    ValueError
        The two differ in length, or there is no grasp.
    """
    a, b = np.asarray(first, dtype=np.bool_), np.asarray(second, dtype=np.bool_)
    if a.shape != b.shape or a.ndim != 1 or len(a) == 0:
        raise ValueError(f"{a.shape} and {b.shape} are no answers to the same grasps")
    gained, lost = int((b & ~a).sum()), int((a & ~b).sum())
    n, discordant, middle = len(a) + 2, gained + lost + 1, (gained - lost) / (len(a) + 2)
    half = float(ndtri(0.975)) * float(np.sqrt(discordant - (gained - lost) ** 2 / n)) / n
    return (gained - lost) / len(a), (max(-1.0, middle - half), min(1.0, middle + half))


def expected_calibration_error(confidence: ArrayLike, correct: ArrayLike) -> float:
    """Return the mean gap between confidence and share of right answers over bins of confidence.

    Bins are tenths of 0 to 1, weighted by their number of answers. Raises ValueError where the two
    differ in length or are empty.
    """
    p = np.asarray(confidence, dtype=np.float64)
    right = np.asarray(correct, dtype=np.float64)
    if p.shape != right.shape or p.ndim != 1 or len(p) == 0:
        raise ValueError(f"confidence {p.shape} and correct {right.shape} must be equal 1-d rows")
    bins = np.minimum((p * _N_BINS).astype(np.int64), _N_BINS - 1)
    gaps = np.bincount(bins, weights=right - p, minlength=_N_BINS)
    return float(np.abs(gaps).sum() / len(p))


def auroc(negative: ArrayLike, positive: ArrayLike) -> float:
    """Return the probability that a positive score exceeds a negative one, ties counted half.

    NaN where either is empty.
    """
    low = np.asarray(negative, dtype=np.float64)
    high = np.asarray(positive, dtype=np.float64)
    if len(low) == 0 or len(high) == 0:
        return float("nan")
    ordered = np.sort(low)
    below = np.searchsorted(ordered, high, side="left") + np.searchsorted(
        ordered, high, side="right"
    )
    return float(0.5 * below.sum() / (len(low) * len(high)))

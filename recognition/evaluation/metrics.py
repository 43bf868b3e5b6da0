"""Measures of recognition: confusion, intervals and separation."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

_N_DRAWS = 2000
"""Samples of a bootstrap."""


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


def auroc(
    negative: ArrayLike, positive: ArrayLike, weights: tuple[ArrayLike, ArrayLike] | None = None
) -> NDArray[np.float64]:
    """Return the probability that a positive score exceeds a negative one, ties counted half.

    NaN where either is empty or has no weight.

    Parameters
    ----------
    negative, positive : (n,), (m,)
        Scores.
    weights
        Weights (..., n) and (..., m) of the scores; the result has their leading dimensions.
    """
    low = np.asarray(negative, dtype=np.float64)
    high = np.asarray(positive, dtype=np.float64)
    plain = np.ones(len(low)), np.ones(len(high))
    of_low, of_high = (np.asarray(one, dtype=np.float64) for one in weights or plain)
    order = np.argsort(low)
    below = np.cumsum(of_low[..., order], axis=-1)
    below = np.concatenate([np.zeros((*below.shape[:-1], 1)), below], axis=-1)
    first = np.searchsorted(low[order], high, side="left")
    last = np.searchsorted(low[order], high, side="right")
    beaten = 0.5 * (below[..., first] + below[..., last])
    with np.errstate(invalid="ignore"):
        area = np.sum(beaten * of_high, axis=-1) / (below[..., -1] * np.sum(of_high, axis=-1))
    return np.asarray(area, dtype=np.float64)


def object_weights(objects: Sequence[str], seed: int = 0) -> dict[str, NDArray[np.float64]]:
    """Return how often each object is in each of `_N_DRAWS` bootstrap samples of the objects.

    Grasps of one object in one series resemble each other, so objects are drawn, not grasps.
    """
    names = sorted(set(objects))
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(len(names), np.full(len(names), 1.0 / len(names)), size=_N_DRAWS)
    return dict(zip(names, counts.T.astype(np.float64), strict=True))


def percentile_interval(draws: ArrayLike) -> tuple[float, float]:
    """Return the 95 % percentile interval of bootstrap draws, NaN ones left out."""
    low, high = np.nanpercentile(np.asarray(draws, dtype=np.float64), [2.5, 97.5])
    return float(low), float(high)


def interval_by_object(right: Sequence[bool], objects: Sequence[str]) -> tuple[float, float]:
    """Return the 95 % interval of a share by a bootstrap of objects (cluster bootstrap).

    Where all grasps are right, or all wrong, it is Wilson's with one trial for each object. (0, 1)
    without grasps.
    """
    if not right:
        return 0.0, 1.0
    weights = object_weights(objects)
    if len(set(right)) < 2:
        return wilson_interval(len(weights) * int(all(right)), len(weights))
    each = np.array([weights[name] for name in objects])
    return percentile_interval(np.asarray(right, dtype=np.float64) @ each / each.sum(axis=0))

"""Which grasp next: the one after which the answer is expected to be least wrong."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_softmax

from recognition.dependence import evidence, independent_share
from recognition.placing import COLUMNS
from recognition.pose_memory import PoseMemory
from recognition.recognizer import Posterior

_SHARED = {"force": 0.2, "offset": 0.01, "rotation": 0.01, "roll": 0.01}
"""Share of the spread of the losses within a label that a part of the setting is thought to
explain beforehand, in the same way for all labels: a hard grasp shows more of anything."""
_OWN = {"force": 0.01, "offset": 0.01, "rotation": 0.04, "roll": 0.01}
"""The same for what each label has beside that."""
_NOISE = 0.8
"""Share that nothing explains."""
_N_CURVES = {"force": 2, "offset": 4, "rotation": 4, "roll": 4}
_SPARED = 8
"""One of so many candidates is good enough after the first grasp."""
_STILL = 1e-9
"""Spread, in m, rad or N, of what did not change while teaching."""


def expected_loss(
    memory: PoseMemory, posteriors: Sequence[Posterior], candidates: ArrayLike
) -> NDArray[np.float64]:
    """Say how wrong the fused answer would be after each candidate, up to a constant.

    The taught grasps of each label stand for what a further grasp may tell if that label is held;
    each is fused with the grasps so far, and minus the logarithm of the probability that the label
    then has is its loss. A regression of these losses on pose and force, each label counted as
    probable as it is now, says where they are small. Loss goes by what is true, not by how sure the
    answer is: a pose in which the recogniser errs with confidence is avoided.

    A few taught grasps of each label say little of it alone, so the labels are regressed together:
    slopes that all share, and deviations of each label that are drawn towards none the more, the
    less its grasps show of them.

    Parameters
    ----------
    memory
        What the taught grasps told.
    posteriors
        The grasps so far, possibly none.
    candidates : (m, 5)
        Placings of possible next grasps: `recognition.placing.COLUMNS`.

    Returns
    -------
    (m,) float64
        Smaller is better.

    Raises
    ------
    ValueError
        If candidates or posteriors do not fit the memory.
    """
    rows = np.asarray(candidates, dtype=np.float64)
    n_labels = len(memory.labels)
    if rows.ndim != 2 or rows.shape[1] != len(COLUMNS):
        raise ValueError(f"candidates have shape {rows.shape}, expected (m, {len(COLUMNS)})")
    if any(p.labels != memory.labels for p in posteriors):
        raise ValueError(f"posteriors do not speak of the {n_labels} remembered labels")
    so_far = np.zeros(n_labels)
    dependence = 0.0
    if posteriors:
        so_far = evidence(np.stack([p.probability for p in posteriors])).sum(axis=0)
        dependence = float(np.mean([p.dependence for p in posteriors]))
    now = np.exp(log_softmax(independent_share(max(len(posteriors), 1), dependence) * so_far))
    share = independent_share(len(posteriors) + 1, dependence)
    after = log_softmax(share * (so_far + memory.told), axis=1)
    loss = -after[np.arange(len(memory.classes)), memory.classes]
    found: NDArray[np.float64] = _basis(memory, rows) @ _slopes(memory, loss, now)
    return found


def best_of(memory: PoseMemory, posteriors: Sequence[Posterior], candidates: ArrayLike) -> int:
    """Return the index of the candidate to take.

    The first grasp is the one with the least expected loss. Later ones are the first candidate
    among the best eighth: the least loss alone asks for much the same grasp again and again, and
    like grasps repeat their errors.
    """
    loss = expected_loss(memory, posteriors, candidates)
    n_best = max(1, len(loss) // _SPARED) if posteriors else 1
    return int(np.argsort(loss, kind="stable")[:n_best].min())


def _basis(memory: PoseMemory, placings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the curves (n, k) along which losses may change; each varies by 1 over the memory.

    Pads and most objects look alike after half a turn, so turns count twice and four times.
    """
    curves, taught = _curves(memory, placings), _curves(memory, memory.placings)
    spread = taught.std(axis=0)
    basis: NDArray[np.float64] = curves - taught.mean(axis=0)
    return basis / np.where(spread > _STILL, spread, np.inf)


def _curves(memory: PoseMemory, placings: NDArray[np.float64]) -> NDArray[np.float64]:
    mean, spread = memory.placings.mean(axis=0), memory.placings.std(axis=0)
    z = (placings - mean) / np.where(spread > _STILL, spread, np.inf)
    x, y, force = z[:, 0], z[:, 1], z[:, 4]
    turned = [
        f(times * placings[:, column])
        for column in (2, 3)
        for times in (2.0, 4.0)
        for f in (np.cos, np.sin)
    ]
    return np.stack([force, force**2, x, y, x**2, y**2, *turned], axis=1)


def _shares(of: Mapping[str, float]) -> NDArray[np.float64]:
    """Return the share of each curve."""
    return np.concatenate([np.full(n, of[part] / n) for part, n in _N_CURVES.items()])


def _slopes(
    memory: PoseMemory, loss: NDArray[np.float64], now: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the slopes (k,) of the expected loss along the curves.

    Least squares with normal priors, for the shared slopes and all deviations at once. Given the
    shared slopes the labels are independent of each other, so their deviations are eliminated label
    by label.
    """
    n_labels = len(memory.labels)
    basis = _basis(memory, memory.placings)
    k = basis.shape[1]
    square, product = np.zeros((n_labels, k, k)), np.zeros((n_labels, k))
    for label in np.unique(memory.classes).tolist():
        rows = memory.classes == label
        centred = basis[rows] - basis[rows].mean(axis=0)
        square[label] = centred.T @ centred / _NOISE
        product[label] = centred.T @ (loss[rows] - loss[rows].mean()) / _NOISE
    own = np.linalg.inv(square + np.diag(1.0 / _shares(_OWN)))
    kept = np.eye(k) - square @ own
    shared = np.linalg.solve(
        np.diag(1.0 / _shares(_SHARED)) + (kept @ square).sum(axis=0),
        np.einsum("cij,cj->i", kept, product),
    )
    deviations = np.einsum("cij,cj->ci", own, product - square @ shared)
    slopes: NDArray[np.float64] = shared + now @ deviations
    return slopes

"""Which grasp next: the one after which the answer is expected to be least wrong."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_softmax

from recognition.calibration import blocked_folds
from recognition.dependence import evidence, independent_share
from recognition.grasp import Grasp
from recognition.recognizer import Posterior, Trainer

_FOLDS = 4
_RIDGE = 100.0
"""Grasps that it takes to believe a slope as much as that there is none."""
_SURE = 2.5
"""Standard errors by which a slope must differ from none: chance must not choose the pose."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseMemory:
    """What each taught grasp told a recogniser that had not seen it, and how it was taken.

    Attributes
    ----------
    settings : (n, d) float64
        Numbers that describe pose and force of each grasp; which ones, the caller decides.
    told : (n, C) float64
        Logarithm of the probability of each label over the even one.
    classes : (n,) int64
        What was held.
    """

    settings: NDArray[np.float64]
    told: NDArray[np.float64]
    classes: NDArray[np.int64]

    def __post_init__(self) -> None:
        n = len(self.classes)
        if n < 1 or self.settings.ndim != 2 or self.told.ndim != 2:
            raise ValueError("a memory needs at least one grasp, settings (n, d) and told (n, C)")
        if len(self.settings) != n or len(self.told) != n:
            raise ValueError(
                f"{len(self.settings)} settings and {len(self.told)} answers of {n} grasps"
            )
        if not (np.all(np.isfinite(self.settings)) and np.all(np.isfinite(self.told))):
            raise ValueError("settings or answers are not finite")

    def expected_loss(
        self, posteriors: Sequence[Posterior], candidates: ArrayLike
    ) -> NDArray[np.float64]:
        """Say how wrong the fused answer would be after each candidate, up to a constant.

        The taught grasps of each label stand for what a further grasp may tell if that label is
        held; each is fused with the grasps so far, and minus the logarithm of the probability that
        the label then has is its loss. A ridge regression of these losses on the settings and
        their squares, each label counted as probable as it is now, says where in the ranges of
        pose and force they are small; slopes that may be chance count as none. Loss goes by what is
        true, not by how sure the answer is: a pose in which the recogniser errs with confidence is
        avoided. Without any slope all candidates are equal.

        Parameters
        ----------
        posteriors
            The grasps so far, possibly none.
        candidates : (m, d)
            Settings of possible next grasps.

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
        n_labels = self.told.shape[1]
        if rows.ndim != 2 or rows.shape[1] != self.settings.shape[1]:
            raise ValueError(
                f"candidates have shape {rows.shape}, taught were {self.settings.shape[1]} settings"
            )
        if any(len(p.labels) != n_labels for p in posteriors):
            raise ValueError(f"posteriors do not speak of the {n_labels} taught labels")
        so_far = np.zeros(n_labels)
        dependence = 0.0
        if posteriors:
            so_far = evidence(np.stack([p.probability for p in posteriors])).sum(axis=0)
            dependence = float(np.mean([p.dependence for p in posteriors]))
        now = np.exp(log_softmax(independent_share(max(len(posteriors), 1), dependence) * so_far))
        share = independent_share(len(posteriors) + 1, dependence)
        after = log_softmax(share * (so_far + self.told), axis=1)
        loss = -after[np.arange(len(self.classes)), self.classes]
        slopes = self._slopes(loss, now)
        found: NDArray[np.float64] = self._basis(rows) @ slopes
        return found

    def best_of(self, posteriors: Sequence[Posterior], candidates: ArrayLike) -> int:
        """Return the index of the candidate with the least expected loss, the first of equals."""
        return int(np.argmin(self.expected_loss(posteriors, candidates)))

    def _basis(self, settings: NDArray[np.float64]) -> NDArray[np.float64]:
        mean, spread = self.settings.mean(axis=0), self.settings.std(axis=0)
        z = (settings - mean) / np.where(spread > 1e-9, spread, np.inf)
        return np.concatenate([z, z**2], axis=1)

    def _slopes(self, loss: NDArray[np.float64], now: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the slopes of the loss, the labels' own means taken off."""
        n_labels = len(now)
        count = np.maximum(np.bincount(self.classes, minlength=n_labels), 1)
        basis = self._basis(self.settings)
        member = (self.classes[:, None] == np.arange(n_labels)) / count
        basis = basis - (member.T @ basis)[self.classes]
        centred = loss - (member.T @ loss)[self.classes]
        weight = (now / count)[self.classes] * len(loss)
        normal = basis.T @ (weight[:, None] * basis) + _RIDGE * np.eye(basis.shape[1])
        inverse = np.linalg.inv(normal)
        slopes: NDArray[np.float64] = inverse @ (basis.T @ (weight * centred))
        left = weight * (centred - basis @ slopes)
        error = np.sqrt(np.diag(inverse @ (basis.T @ (left[:, None] ** 2 * basis)) @ inverse))
        return np.where(np.abs(slopes) > _SURE * error, slopes, 0.0)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays."""
        return {"settings": self.settings, "told": self.told, "classes": self.classes}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`. Raises KeyError or ValueError where that cannot be."""
        return cls(
            settings=np.asarray(arrays["settings"], dtype=np.float64),
            told=np.asarray(arrays["told"], dtype=np.float64),
            classes=np.asarray(arrays["classes"], dtype=np.int64),
        )


def remember(trainer: Trainer, grasps: Sequence[Grasp], settings: ArrayLike) -> PoseMemory:
    """Ask about each taught grasp a recogniser that was taught without it.

    Parameters
    ----------
    trainer
        What is taught, four times, on three quarters of the grasps.
    grasps
        The labelled grasps, those of a label in the order of time.
    settings : (n, d)
        Pose and force of each.

    Raises
    ------
    ValueError
        There are too few grasps of a label, or settings do not fit.
    """
    rows = np.asarray(settings, dtype=np.float64)
    if len(rows) != len(grasps):
        raise ValueError(f"{len(rows)} settings of {len(grasps)} grasps")
    labels, classes = np.unique([g.label for g in grasps], return_inverse=True)
    probability = np.full((len(grasps), len(labels)), np.nan)
    for held_out in blocked_folds(classes, _FOLDS):
        recognizer = trainer.fit([g for g, out in zip(grasps, held_out, strict=True) if not out])
        if recognizer.labels != tuple(labels.tolist()):
            raise ValueError(f"of {labels.tolist()} only {list(recognizer.labels)} could be taught")
        for row in np.flatnonzero(held_out).tolist():
            probability[row] = recognizer.posterior(grasps[row]).probability
    asked = np.all(np.isfinite(probability), axis=1)
    return PoseMemory(
        settings=rows[asked], told=evidence(probability[asked]), classes=classes[asked]
    )

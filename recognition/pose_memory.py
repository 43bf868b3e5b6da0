"""What each taught grasp told, and at which pose and force it was taken."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.calibration import blocked_folds
from recognition.dependence import evidence
from recognition.grasp import Grasp
from recognition.placing import COLUMNS
from recognition.recognizer import Trainer

_FOLDS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseMemory:
    """What each taught grasp told a recogniser that had not seen it, and how it was taken.

    Attributes
    ----------
    labels
        The taught objects.
    placings : (n, 5) float64
        Pose and force that were asked for: `recognition.placing.COLUMNS`.
    told : (n, C) float64
        Logarithm of the probability of each label over the even one.
    classes : (n,) int64
        What was held, as the place of its label.

    Raises
    ------
    ValueError
        Shapes or values do not fit.
    """

    labels: tuple[str, ...]
    placings: NDArray[np.float64]
    told: NDArray[np.float64]
    classes: NDArray[np.int64]

    def __post_init__(self) -> None:
        n, n_labels = len(self.classes), len(self.labels)
        if n < 1 or n_labels < 1:
            raise ValueError("a memory needs at least one grasp and one label")
        for name, shape in (
            ("placings", (n, len(COLUMNS))),
            ("told", (n, n_labels)),
            ("classes", (n,)),
        ):
            array = getattr(self, name)
            if array.shape != shape:
                raise ValueError(f"{name} of a memory have shape {array.shape}, expected {shape}")
            if not np.all(np.isfinite(array)):
                raise ValueError(f"{name} of a memory are not finite")
            array = array.copy()
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if self.classes.min() < 0 or self.classes.max() >= n_labels:
            raise ValueError(f"classes of a memory are not from 0 to {n_labels - 1}")

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays."""
        return {
            "labels": np.array(self.labels, dtype=np.str_),
            "placings": self.placings,
            "told": self.told,
            "classes": self.classes,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`. Raises KeyError or ValueError where that cannot be."""
        return cls(
            labels=tuple(map(str, arrays["labels"].tolist())),
            placings=np.asarray(arrays["placings"], dtype=np.float64),
            told=np.asarray(arrays["told"], dtype=np.float64),
            classes=np.asarray(arrays["classes"], dtype=np.int64),
        )


def remember(trainer: Trainer, grasps: Sequence[Grasp]) -> PoseMemory:
    """Ask about each taught grasp a recogniser that was taught without it.

    Grasps of unknown placing help to teach these recognisers; they are not remembered.

    Parameters
    ----------
    trainer
        What is taught, four times, on three quarters of the grasps.
    grasps
        The labelled grasps, those of a label in the order of time.

    Raises
    ------
    ValueError
        No placing is known, or there are too few grasps of a label.
    """
    labels, classes = np.unique([g.label for g in grasps], return_inverse=True)
    if not any(grasp.placing for grasp in grasps):
        raise ValueError("none of the grasps says at which pose and force it was taken")
    probability = np.full((len(grasps), len(labels)), np.nan)
    for held_out in blocked_folds(classes, _FOLDS):
        recognizer = trainer.fit([g for g, out in zip(grasps, held_out, strict=True) if not out])
        if recognizer.labels != tuple(labels.tolist()):
            raise ValueError(f"of {labels.tolist()} only {list(recognizer.labels)} could be taught")
        for row in np.flatnonzero(held_out).tolist():
            if grasps[row].placing:
                probability[row] = recognizer.posterior(grasps[row]).probability
    asked = np.flatnonzero(np.all(np.isfinite(probability), axis=1))
    placings = [placing.values for row in asked.tolist() if (placing := grasps[row].placing)]
    return PoseMemory(
        labels=tuple(labels.tolist()),
        placings=np.array(placings, dtype=np.float64).reshape(-1, len(COLUMNS)),
        told=evidence(probability[asked]),
        classes=classes[asked],
    )

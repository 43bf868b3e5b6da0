"""Plain classifiers: taught here or by scikit-learn, kept as arrays, asked in numpy alone."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax

from recognition.errors import MissingExtraError
from recognition.lda import LinearDiscriminant, fit_lda

_HIDDEN = 32
_WEIGHT_DECAY = 0.1
_ITERATIONS = 200


class Classifier(Protocol):
    """From rows of features to a score of each class; larger is likelier."""

    @classmethod
    def fit(cls, rows: NDArray[np.float64], classes: NDArray[np.int64], n_classes: int) -> Self:
        """Learn from rows (n, F), of each class at least one."""
        ...

    def scores(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, C) finite scores."""
        ...

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that was learnt as plain arrays."""
        ...

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        ...


def missing_extra(kind: str) -> MissingExtraError:
    """Return the error for a classifier whose library is not installed."""
    return MissingExtraError(
        f"{kind} is taught by scikit-learn, which is not installed: "
        "pip install 'tactile-cell[comparators]'; a taught model needs nothing more"
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Network:
    """A neural network with one hidden layer of rectified units.

    Attributes
    ----------
    hidden_weight, hidden_bias : (F, H), (H,) float64
    output_weight, output_bias : (H, C), (C,) float64
        Of both layers; with two classes one output tells the second from the first.
    """

    hidden_weight: NDArray[np.float64]
    hidden_bias: NDArray[np.float64]
    output_weight: NDArray[np.float64]
    output_bias: NDArray[np.float64]

    @classmethod
    def fit(cls, rows: NDArray[np.float64], classes: NDArray[np.int64], n_classes: int) -> Self:
        """Learn the weights. Raises MissingExtraError without scikit-learn."""
        del n_classes
        try:
            from sklearn.exceptions import ConvergenceWarning  # noqa: PLC0415
            from sklearn.neural_network import MLPClassifier  # noqa: PLC0415
        except ImportError as cause:
            raise missing_extra("a neural network") from cause
        network = MLPClassifier(
            (_HIDDEN,), solver="lbfgs", alpha=_WEIGHT_DECAY, max_iter=_ITERATIONS, random_state=0
        )
        with warnings.catch_warnings():
            # Stopping early is part of the method: it keeps a small network from rote learning.
            warnings.simplefilter("ignore", ConvergenceWarning)
            network.fit(rows, classes)
        hidden, output = network.coefs_
        hidden_bias, output_bias = network.intercepts_
        return cls(
            hidden_weight=np.asarray(hidden, dtype=np.float64),
            hidden_bias=np.asarray(hidden_bias, dtype=np.float64),
            output_weight=np.asarray(output, dtype=np.float64),
            output_bias=np.asarray(output_bias, dtype=np.float64),
        )

    def scores(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, C) logarithms of the network's probabilities."""
        hidden = np.maximum(rows @ self.hidden_weight + self.hidden_bias, 0.0)
        output = hidden @ self.output_weight + self.output_bias
        if output.shape[1] == 1:
            output = np.concatenate([np.zeros_like(output), output], axis=1)
        return np.asarray(log_softmax(output, axis=1), dtype=np.float64)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the weights."""
        return {
            "hidden_weight": self.hidden_weight,
            "hidden_bias": self.hidden_bias,
            "output_weight": self.output_weight,
            "output_bias": self.output_bias,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(
            hidden_weight=arrays["hidden_weight"],
            hidden_bias=arrays["hidden_bias"],
            output_weight=arrays["output_weight"],
            output_bias=arrays["output_bias"],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NearestNeighbour:
    """The taught rows themselves: a class is as likely as its nearest row is near.

    Attributes
    ----------
    rows : (n, F) float64
    classes : (n,) int64
        Taught rows and the class of each, 0 to n_classes - 1.
    """

    rows: NDArray[np.float64]
    classes: NDArray[np.int64]

    @classmethod
    def fit(cls, rows: NDArray[np.float64], classes: NDArray[np.int64], n_classes: int) -> Self:
        """Keep the rows."""
        del n_classes
        return cls(rows=rows, classes=classes)

    def scores(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, C): minus the squared distance to the nearest row of each class."""
        squared = (
            (rows**2).sum(axis=1)[:, None] + (self.rows**2).sum(axis=1) - 2.0 * rows @ self.rows.T
        )
        squared = np.maximum(squared, 0.0)
        n_classes = int(self.classes.max()) + 1
        nearest = [squared[:, self.classes == c].min(axis=1) for c in range(n_classes)]
        return -np.stack(nearest, axis=1)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return rows and classes."""
        return {"rows": self.rows, "row_classes": self.classes}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(rows=arrays["rows"], classes=arrays["row_classes"])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linear:
    """A shrinkage discriminant."""

    discriminant: LinearDiscriminant

    @classmethod
    def fit(cls, rows: NDArray[np.float64], classes: NDArray[np.int64], n_classes: int) -> Self:
        """Fit it; ValueError where the rows do not show how grasps of one class vary."""
        return cls(discriminant=fit_lda(rows, classes, n_classes))

    def scores(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, C): minus half the squared distance to each class."""
        return -0.5 * self.discriminant.distances(rows)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the discriminant."""
        return self.discriminant.to_arrays("lda_")

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(discriminant=LinearDiscriminant.from_arrays(arrays, "lda_"))

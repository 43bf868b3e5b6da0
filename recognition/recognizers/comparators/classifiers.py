"""Plain classifiers: taught here or by scikit-learn, stored as arrays, evaluated in numpy."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax

from recognition.statistics.array_record import ArrayRecord
from recognition.statistics.lda import LinearDiscriminant, fit_lda, squared_distances

_HIDDEN = 32
"""Hidden units of the network."""
_WEIGHT_DECAY = 0.1
_ITERATIONS = 200
"""L2 penalty and most iterations of its training; the early stop prevents overfitting."""
_TREES = 200
"""Trees of the forest."""


class Classifier(Protocol):
    """Returns a score of each class for rows of features; larger is likelier."""

    @classmethod
    def fit(cls, rows: NDArray[np.float64], classes: NDArray[np.int64], n_classes: int) -> Self:
        """Fit to rows (n, F), at least one of each class."""

    def scores(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, C) finite scores."""

    def space(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rows (n, r) in the space whose distance to taught rows is the novelty."""

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the taught classifier as plain arrays."""

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`; KeyError if an array is missing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Arrays(ArrayRecord):
    """A classifier whose fields are arrays, with novelty in the space of the features."""

    def space(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rows."""
        return rows


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Network(_Arrays):
    """A neural network with one hidden layer of rectified units."""

    hidden_weight: NDArray[np.float64]
    hidden_bias: NDArray[np.float64]
    """(F, H), (H,) float64: """
    output_weight: NDArray[np.float64]
    output_bias: NDArray[np.float64]
    """(H, C), (C,) float64: of both layers; with two classes one output is the log odds of the
    second."""

    @classmethod
    def fit(cls, rows: NDArray[np.float64], classes: NDArray[np.int64], n_classes: int) -> Self:
        """Fit the weights. Raises ImportError without scikit-learn."""
        from sklearn.exceptions import ConvergenceWarning  # noqa: PLC0415
        from sklearn.neural_network import MLPClassifier  # noqa: PLC0415

        del n_classes
        network = MLPClassifier(
            (_HIDDEN,), solver="lbfgs", alpha=_WEIGHT_DECAY, max_iter=_ITERATIONS, random_state=0
        )
        with warnings.catch_warnings():
            # Stopping early is part of the method.
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NearestNeighbour(_Arrays):
    """Nearest neighbour: the score of a class is minus the squared distance to its nearest row."""

    rows: NDArray[np.float64]
    """(n, F) float64: """
    row_classes: NDArray[np.int64]
    """(n,) int64: taught rows and the class of each, 0 to n_classes - 1."""

    @classmethod
    def fit(cls, rows: NDArray[np.float64], classes: NDArray[np.int64], n_classes: int) -> Self:
        """Keep the rows."""
        del n_classes
        return cls(rows=rows, row_classes=classes)

    def scores(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, C): minus the squared distance to the nearest row of each class."""
        squared = squared_distances(rows, self.rows)
        n_classes = int(self.row_classes.max()) + 1
        nearest = [squared[:, self.row_classes == c].min(axis=1) for c in range(n_classes)]
        return -np.stack(nearest, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linear:
    """A shrinkage discriminant."""

    discriminant: LinearDiscriminant

    @classmethod
    def fit(cls, rows: NDArray[np.float64], classes: NDArray[np.int64], n_classes: int) -> Self:
        """Fit it; ValueError if the rows do not show the variation of a class."""
        return cls(discriminant=fit_lda(rows, classes, n_classes))

    def scores(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, C): minus half the squared distance to each class."""
        return -0.5 * self.discriminant.distances(rows)

    def space(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, r): the rows in the space that separates the classes."""
        return self.discriminant.project(rows)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the discriminant."""
        return self.discriminant.to_arrays("lda_")

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`; KeyError if an array is missing."""
        return cls(discriminant=LinearDiscriminant.from_arrays(arrays, "lda_"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Forest(_Arrays):
    """A forest of extremely randomised trees, grown by scikit-learn, evaluated in numpy.

    All nodes of all trees are in one list; children come after their parent.
    """

    roots: NDArray[np.int32]
    """(n_trees,) int32: first node of each tree."""
    left: NDArray[np.int32]
    right: NDArray[np.int32]
    """(n_nodes,) int32: children; left if the feature is not above the threshold. A leaf is its own
    child."""
    feature: NDArray[np.int32]
    threshold: NDArray[np.float64]
    """(n_nodes,) int32, float64: the test of a node; 0 in leaves."""
    value: NDArray[np.float32]
    """(n_nodes, C) float32: shares of the classes among the taught rows in a node; used in leaves.
    """

    def __post_init__(self) -> None:
        own = np.arange(len(self.left))
        leaf = (self.left == own) & (self.right == own)
        if not np.all(leaf | ((self.left > own) & (self.right > own))):
            raise ValueError("the trees of the model do not go downwards: train again")

    @classmethod
    def fit(cls, rows: NDArray[np.float64], classes: NDArray[np.int64], n_classes: int) -> Self:
        """Grow the trees. Raises ImportError without scikit-learn."""
        from sklearn.ensemble import ExtraTreesClassifier  # noqa: PLC0415

        del n_classes
        grown = ExtraTreesClassifier(_TREES, random_state=0).fit(rows, classes)
        trees = [one.tree_ for one in grown.estimators_]
        starts = np.cumsum([0] + [tree.node_count for tree in trees])
        left, right = (
            np.concatenate(
                [
                    np.where(
                        tree.children_left < 0, np.arange(tree.node_count), getattr(tree, side)
                    )
                    + start
                    for tree, start in zip(trees, starts[:-1], strict=True)
                ]
            )
            for side in ("children_left", "children_right")
        )
        value = np.concatenate([tree.value[:, 0, :] for tree in trees])
        return cls(
            roots=starts[:-1].astype(np.int32),
            left=left.astype(np.int32),
            right=right.astype(np.int32),
            feature=np.maximum(np.concatenate([t.feature for t in trees]), 0).astype(np.int32),
            threshold=np.concatenate([np.where(t.feature < 0, 0.0, t.threshold) for t in trees]),
            value=(value / value.sum(axis=1, keepdims=True)).astype(np.float32),
        )

    def probability(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, C) mean shares of the leaves of each row."""
        # The trees were grown in single precision: the same rounding gives the same side.
        rows = rows.astype(np.float32).astype(np.float64)
        node = np.broadcast_to(self.roots, (len(rows), len(self.roots)))
        each = np.arange(len(rows))[:, None]
        while True:
            goes_left = rows[each, self.feature[node]] <= self.threshold[node]
            following = np.where(goes_left, self.left[node], self.right[node])
            if np.array_equal(following, node):
                break
            node = following
        mean: NDArray[np.float64] = self.value[node].mean(axis=1, dtype=np.float64)
        return mean

    def scores(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, C) logarithms of the probabilities, each raised by half a tree."""
        return np.log(self.probability(rows) + 0.5 / len(self.roots))

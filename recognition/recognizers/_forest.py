"""A forest of extremely randomised trees: grown by scikit-learn, walked in numpy."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.recognizers._classifiers import missing_extra

_TREES = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Forest:
    """All nodes of all trees in one list; children come after their parent.

    Attributes
    ----------
    roots : (n_trees,) int32
        First node of each tree.
    left, right : (n_nodes,) int32
        Children: left where the feature is not above the threshold. A leaf is its own child.
    feature, threshold : (n_nodes,) int32, float64
        What a node asks; 0 in leaves.
    value : (n_nodes, C) float32
        Shares of the classes among the taught rows in a node; used in leaves.
    """

    roots: NDArray[np.int32]
    left: NDArray[np.int32]
    right: NDArray[np.int32]
    feature: NDArray[np.int32]
    threshold: NDArray[np.float64]
    value: NDArray[np.float32]

    @classmethod
    def fit(cls, rows: NDArray[np.float64], classes: NDArray[np.int64], n_classes: int) -> Self:
        """Grow the trees. Raises MissingExtraError without scikit-learn."""
        del n_classes
        try:
            from sklearn.ensemble import ExtraTreesClassifier  # noqa: PLC0415
        except ImportError as cause:
            raise missing_extra("a forest of trees") from cause
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
        """Return (n, C) mean shares of the leaves that each row falls into."""
        # The trees were grown on single precision: the same rounding falls to the same side.
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
        lifted: NDArray[np.float64] = np.log(self.probability(rows) + 0.5 / len(self.roots))
        return lifted

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the nodes."""
        return {
            "roots": self.roots,
            "left": self.left,
            "right": self.right,
            "feature": self.feature,
            "threshold": self.threshold,
            "value": self.value,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`; KeyError for a missing array, ValueError for a loop."""
        forest = cls(
            roots=arrays["roots"],
            left=arrays["left"],
            right=arrays["right"],
            feature=arrays["feature"],
            threshold=arrays["threshold"],
            value=arrays["value"],
        )
        own = np.arange(len(forest.left))
        leaf = (forest.left == own) & (forest.right == own)
        if not np.all(leaf | ((forest.left > own) & (forest.right > own))):
            raise ValueError("the trees of the model do not go downwards: train again")
        return forest

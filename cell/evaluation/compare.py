"""Comparison of two models by the names that they give to the same grasps: paired."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cell.errors import CellError, raised_as
from cell.learning.blas import one_blas_thread
from cell.learning.model import LoadedModel
from recognition.evaluation.evaluation import Mapper, answers, one_by_one
from recognition.evaluation.metrics import paired_difference
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Names that two models give to the same grasps."""

    n: int
    """Number of grasps."""
    right: tuple[float, float]
    wrong: tuple[float, float]
    """Share that each names rightly and wrongly; the others are UNKNOWN."""
    alone: tuple[int, int]
    """Grasps that each of them alone names rightly."""
    difference: float
    interval: tuple[float, float]
    """How many more the second one names rightly, as a share, and its 95 % interval (paired)."""


def compared(truth: Sequence[str], first: Sequence[str], second: Sequence[str]) -> Comparison:
    """Return the comparison of the names by two models with the labels of the grasps."""
    named = np.array([first, second])
    right = named == np.array(truth)
    difference, interval = paired_difference(*right.tolist())
    return Comparison(
        n=len(truth),
        right=tuple(right.mean(axis=1).tolist()),
        wrong=tuple((~right & (named != UNKNOWN)).mean(axis=1).tolist()),
        alone=tuple((right & ~right[::-1]).sum(axis=1).tolist()),
        difference=difference,
        interval=interval,
    )


@one_blas_thread()
def compare(
    first: LoadedModel,
    second: LoadedModel,
    grasps: Sequence[Grasp],
    mapper: Mapper = one_by_one,
) -> Comparison:
    """Return how often each of two models names grasps rightly that taught neither of them.

    Raises CellError where no grasp is of an object that both were taught, or pads differ.
    """
    known = set(first.labels) & set(second.labels)
    asked = [grasp for grasp in grasps if grasp.label in known]
    if not asked:
        raise CellError(
            f"no grasp is of an object that {first.path} and {second.path} were both taught: "
            f"{', '.join(sorted(known)) or 'there is none'}"
        )
    with raised_as(CellError, ValueError, where="the models cannot answer these grasps"):
        names = [
            [posterior.name for posterior in answers(model.recognizer, asked, mapper)]
            for model in (first, second)
        ]
    return compared([grasp.label for grasp in asked], *names)

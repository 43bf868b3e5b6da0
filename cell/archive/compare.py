"""Comparison of two models on the same grasps: paired, with an interval."""

from collections.abc import Sequence
from dataclasses import dataclass

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
    """Number of grasps of objects that both were taught."""
    right: tuple[float, float]
    wrong: tuple[float, float]
    """Share that each names rightly and wrongly; the others are UNKNOWN."""
    only_first: int
    only_second: int
    """Grasps that one of them alone names rightly."""
    difference: float
    interval: tuple[float, float]
    """How many more the second one names rightly, as a share, and its 95 % interval (paired)."""


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
    truth = [grasp.label for grasp in asked]
    right = [[a == b for a, b in zip(named, truth, strict=True)] for named in names]
    wrong = [
        sum(a not in (b, UNKNOWN) for a, b in zip(named, truth, strict=True)) / len(truth)
        for named in names
    ]
    difference, interval = paired_difference(*right)
    pairs = list(zip(*right, strict=True))
    return Comparison(
        n=len(asked),
        right=(sum(right[0]) / len(asked), sum(right[1]) / len(asked)),
        wrong=(wrong[0], wrong[1]),
        only_first=sum(a and not b for a, b in pairs),
        only_second=sum(b and not a for a, b in pairs),
        difference=difference,
        interval=interval,
    )

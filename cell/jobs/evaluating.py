"""Accuracy of recognisers over recorded grasps, without buses."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cell.errors import CellError
from cell.jobs.progress import Progress
from recognition.evaluation import Evaluation, Mapper, evaluate, one_by_one, parse_split
from recognition.grasp import Grasp
from recognition.recognizers import DEFAULT_TRAINER, make_trainer


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognizerFigures:
    """Figures of one recogniser: with the aperture, where it uses one, and without."""

    full: Evaluation
    without_aperture: Evaluation | None


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationResult:
    """Figures of all recognisers on one split."""

    split: str
    n_train: int
    n_test: int
    labels: tuple[str, ...]
    seconds: float
    default: str
    recognizers: Mapping[str, RecognizerFigures]

    def as_json(self) -> dict[str, Any]:
        """Return what ``--json`` writes."""
        return {
            "split": self.split,
            "n_train": self.n_train,
            "n_test": self.n_test,
            "labels": list(self.labels),
            "seconds": round(self.seconds, 2),
            "default": self.default,
            "recognizers": {
                name: _figures(figures.full)
                | {
                    "without_aperture": None
                    if figures.without_aperture is None
                    else _figures(figures.without_aperture)
                }
                for name, figures in self.recognizers.items()
            },
        }


def evaluate_recognizers(
    grasps: Sequence[Grasp],
    *,
    split: str,
    train: Sequence[Grasp] | None = None,
    names: Sequence[str],
    fuse: Sequence[int] = (1,),
    seed: int = 0,
    mapper: Mapper = one_by_one,
    progress: Progress,
) -> EvaluationResult:
    """Train and test each named recogniser.

    Parameters
    ----------
    grasps
        Labelled grasps to split; with ``train``, all of them are tested.
    split
        As ``chronological:0.6`` or ``shuffled:0.8``.
    train
        Grasps to train on instead of splitting.
    fuse
        Numbers of grasps to fuse.
    mapper
        Who does the work, as `cell.parallel.workers` yields it.

    Raises
    ------
    CellError
        If the split leaves nothing to train or test, or the grasps were taken on other pads.
    """
    started_s = time.monotonic()
    if train is None:
        try:
            train_part, test_part = parse_split(split, seed=seed)(grasps)
        except ValueError as error:
            raise CellError(str(error)) from error
    else:
        split, train_part, test_part = "separate files", tuple(train), tuple(grasps)
    if not train_part or not test_part:
        raise CellError(
            f"split {split!r} leaves {len(train_part)} grasps to train and {len(test_part)} "
            "to test; both need at least one labelled grasp of each object"
        )
    if not train_part[0].pads.same_as(test_part[0].pads):
        raise CellError("the grasps to train and to test were taken on different pads")
    figures = {}
    for number, name in enumerate(names):
        progress("evaluate", 2 * number, 2 * len(names))
        trainer = make_trainer(name, use_aperture=True)
        try:
            full = evaluate(train_part, test_part, trainer, fuse=fuse, seed=seed, mapper=mapper)
            progress("evaluate", 2 * number + 1, 2 * len(names))
            without = (
                evaluate(
                    train_part,
                    test_part,
                    make_trainer(name, use_aperture=False),
                    fuse=fuse,
                    seed=seed,
                    mapper=mapper,
                )
                if trainer.uses_aperture
                else full
            )
        except ValueError as error:
            raise CellError(f"{name} cannot be evaluated: {error}") from error
        figures[name] = RecognizerFigures(full=full, without_aperture=without)
    progress("evaluate", 2 * len(names), 2 * len(names))
    return EvaluationResult(
        split=split,
        n_train=len(train_part),
        n_test=len(test_part),
        labels=tuple(sorted({grasp.label for grasp in train_part})),
        seconds=time.monotonic() - started_s,
        default=DEFAULT_TRAINER,
        recognizers=figures,
    )


def _figures(evaluation: Evaluation) -> dict[str, Any]:
    return {
        "single_accuracy": evaluation.single_accuracy,
        "interval": list(evaluation.interval),
        "fused_accuracy": {str(k): _known(v) for k, v in evaluation.fused_accuracy.items()},
        "random_fused_accuracy": {
            str(k): _known(v) for k, v in evaluation.random_fused_accuracy.items()
        },
        "unknown_auroc": _known(evaluation.unknown_auroc),
        "unknown_rejected": _known(evaluation.unknown_rejected),
        "known_rejected": evaluation.known_rejected,
        "calibration_error": evaluation.calibration_error,
        "labels": list(evaluation.labels),
        "confusion": [list(map(int, row)) for row in evaluation.confusion],
    }


def _known(value: float) -> float | None:
    """Return None for a figure that was not measured: JSON has no NaN."""
    return None if math.isnan(value) else value

"""Evaluation: recognizers are trained and tested on selected grasps, without buses."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from cell.archive.selection import Selection, cell_of, day_of, is_archive
from cell.errors import CellError, ConfigError, raised_as
from cell.installation import extra
from cell.learning.labelled_grasps import read_labelled_grasps
from cell.learning.model import Trained
from cell.learning.parallel import Progress, one_blas_thread
from cell.plugins import RECOGNIZERS
from recognition.drift.drift import DriftFollowing, DriftGrid, DriftPrior, learn_spread
from recognition.evaluation.evaluation import Evaluation, Mapper, evaluate, one_by_one
from recognition.evaluation.splits import (
    TrainTest,
    chronological_split,
    left_out_parts,
    parse_split,
    series_names,
)
from recognition.grasp import DRAWING_SOURCE, Grasp
from recognition.recognizers import DEFAULT_TRAINER

_MOST = 400
"""Grasps of each object that are taken of an archive at most, at random."""
LEFT_OUT = ("days", "cells", "series")
"""What can be left out in turn."""


def selected_grasps(
    places: Sequence[str], selection: Selection, note: Callable[[str], None]
) -> list[Grasp]:
    """Return the selected labelled grasps of archives, data sets and recordings.

    ``note`` gets what is left out. Raises CellError where one cannot be read, or none is selected.
    """
    grasps: list[Grasp] = []
    for place in places:
        if is_archive(place):
            with extra("archive", needed_by="an archive"):
                from cell.archive.store import Archive  # noqa: PLC0415  slow to load
            here = list(Archive(place).grasps(selection, most=_MOST))
            note(f"{place}: {len(here)} grasps, of each object {_MOST} at most")
        else:
            every = read_labelled_grasps(Path(place), note)
            here = [grasp for grasp in every if selection.fits(grasp)]
        grasps += here
    if not grasps:
        raise CellError(f"no labelled grasp of {', '.join(places)} is selected")
    return grasps


def left_out_in_turn(grasps: Sequence[Grasp], what: str) -> list[TrainTest]:
    """Return grasps to train and to test, for each of `LEFT_OUT`; ValueError with a single one."""
    if what == "series":
        return left_out_parts(grasps, series_names(grasps))
    day = what == "days"
    return left_out_parts(grasps, [day_of(g.start_ms) if day else cell_of(g) for g in grasps])


_NOT_WRITTEN = ("trainer", "uses_aperture", "n", "n_untaught")
"""Figures of a recognizer that ``--json`` omits, because the split has them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognizerFigures:
    """Figures of one recognizer: with the opening, if it uses it, and without it."""

    full: Evaluation
    without_aperture: Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationResult:
    """Figures of all recognizers on one split."""

    split: str
    n_train: int
    n_test: int
    labels: tuple[str, ...]
    seconds: float
    default: str
    recognizers: Mapping[str, RecognizerFigures]
    left_out: Mapping[str, str]
    """Recognizers that cannot be trained with these grasps, each with the reason."""

    def as_json(self) -> dict[str, Any]:
        """Return what ``--json`` writes."""
        names = ("split", "n_train", "n_test", "labels", "seconds", "default", "left_out")
        return {name: getattr(self, name) for name in names} | {
            "recognizers": {
                name: _figures(pair.full) | {"without_aperture": _figures(pair.without_aperture)}
                for name, pair in self.recognizers.items()
            }
        }


@one_blas_thread()
def evaluate_recognizers(
    grasps: Sequence[Grasp],
    *,
    split: str,
    train: Sequence[Grasp] | None = None,
    names: Sequence[str],
    fuse: Sequence[int] = (1,),
    mapper: Mapper = one_by_one,
    progress: Progress,
) -> EvaluationResult:
    """Train and test each named recognizer.

    Raises CellError if the split leaves nothing to train or test, the grasps were taken on other
    pads, or no recognizer can be trained with them.

    Parameters
    ----------
    grasps
        Labelled grasps to split; with ``train``, all of them are tested.
    split
        E.g. ``chronological:0.6``; ``series``, ``days`` and ``cells`` leave out each of them in
        turn.
    train
        Grasps to train on instead of splitting.
    fuse
        Numbers of grasps to fuse.
    mapper
        Map function for the work, from `cell.learning.parallel.workers`.
    """
    started_s = time.monotonic()
    if train is not None:
        split = "separate files"
    parts = _parts(grasps, split, train)
    measure = partial(evaluate, parts, fuse=fuse, mapper=mapper)
    if len(parts) > 1:
        # A part tests a single object: the others would have to be left out again for each.
        measure = partial(measure, unknown_groups=0)
    figures, left_out = {}, {}
    for number, name in enumerate(names):
        progress("evaluate", 2 * number, 2 * len(names))
        trainer = RECOGNIZERS[name](use_aperture=True)
        try:
            full = without = measure(trainer)
            progress("evaluate", 2 * number + 1, 2 * len(names))
            if trainer.uses_aperture:
                without = measure(RECOGNIZERS[name](use_aperture=False))
        except ValueError as error:
            left_out[name] = str(error)
            continue
        figures[name] = RecognizerFigures(full=full, without_aperture=without)
    progress("evaluate", 2 * len(names), 2 * len(names))
    if not figures:
        raise CellError(
            "; ".join(f"{name} cannot be evaluated: {w}" for name, w in left_out.items())
        )
    return EvaluationResult(
        split=split,
        n_train=min(len(taught) for taught, _ in parts),
        n_test=sum(len(test) for _, test in parts),
        labels=tuple(sorted({grasp.label for taught, _ in parts for grasp in taught})),
        seconds=round(time.monotonic() - started_s, 2),
        default=DEFAULT_TRAINER,
        recognizers=figures,
        left_out=left_out,
    )


def _parts(grasps: Sequence[Grasp], split: str, train: Sequence[Grasp] | None) -> list[TrainTest]:
    """Return pairs of grasps to train and to test; virtual grasps of a drawing test nothing.

    Raises CellError if a pair cannot be used.
    """
    if train is not None:
        parts: list[TrainTest] = [(tuple(train), tuple(grasps))]
    else:
        with raised_as(ConfigError, ValueError, where="--split"):
            if split in LEFT_OUT:
                parts = left_out_in_turn(grasps, split)
            else:
                parts = [chronological_split(grasps, parse_split(split))]
    parts = [
        (taught, tuple(grasp for grasp in tested if grasp.source != DRAWING_SOURCE))
        for taught, tested in parts
    ]
    # A part with virtual grasps alone is left out; if there is no other, it is the error below.
    parts = [part for part in parts if part[1]] or parts[:1]
    for train_part, test_part in parts:
        if not train_part or not test_part:
            raise CellError(
                f"split {split!r} leaves {len(train_part)} grasps to train and {len(test_part)} "
                "to test, without virtual ones; both need a labelled grasp of each object"
            )
        if not train_part[0].pads.same_as(test_part[0].pads):
            raise CellError(
                "training and test grasps are from different pads: use data sets of the same pads"
            )
    return parts


def _figures(evaluation: Evaluation) -> dict[str, Any]:
    names = [field.name for field in fields(evaluation) if field.name not in _NOT_WRITTEN]
    return {name: getattr(evaluation, name) for name in names}


def with_spread(trained: Trained, grasps: Sequence[Grasp]) -> tuple[Trained, DriftPrior | None]:
    """Return what was trained with the learnt spread, and that; None where there is none to learn.

    It takes a default recognizer without a self-zero, and several days or cells of one object.
    """
    recognizer = trained.recognizer
    if not isinstance(recognizer, DriftFollowing) or recognizer.zero is not None:
        return trained, None
    prior = learn_spread(grasps, [f"{day_of(grasp.start_ms)} {cell_of(grasp)}" for grasp in grasps])
    if prior is None:
        return trained, None
    return replace(trained, recognizer=recognizer.with_grid(DriftGrid(prior=prior))), prior

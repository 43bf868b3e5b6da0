"""Identification: of the object in a cell, or of recorded grasps, with a taught model."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from cell.build import Cell
from cell.config.model import CellConfig
from cell.control.identification import Identification, ReadShape
from cell.control.keeping import Keep
from cell.jobs.common import Progress
from cell.learning.blas import one_blas_thread
from cell.learning.drift import DriftTracker, estimate_values
from cell.learning.model import LoadedModel, check_pads
from cell.learning.taught_model import TaughtModel
from recognition.drift.estimate import DriftEstimate
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer
from recognition.shape.answer import ShapeAnswer


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedAnswer:
    """Answer to one recorded grasp."""

    number: int
    """Place of the grasp in its file, from 0."""
    label: str
    probability: float
    """The answer and its probability."""
    unknown: float
    """Probability that the object was never taught."""
    truth: str
    """Label in the file; empty where there is none."""
    drift: DriftEstimate | None = None
    """Estimate of the drift with which the answer was given; None where it is not followed."""
    shape: ShapeAnswer | None = None
    """Shape and size; None where they were not asked for, or the pads do not show them."""

    def as_json(self) -> dict[str, Any]:
        """Return the answer as plain data."""
        return {
            "grasp": self.number,
            "label": self.label,
            "probability": self.probability,
            "unknown": self.unknown,
            "truth": self.truth or None,
            "shape": None if self.shape is None else self.shape.as_dict(),
        } | ({} if self.drift is None else {"drift": estimate_values(self.drift)})


@one_blas_thread()
def identify_recorded(
    model: LoadedModel,
    grasps: Sequence[Grasp],
    *,
    tracker: DriftTracker | None = None,
    read_shape: ReadShape | None = None,
) -> list[RecordedAnswer]:
    """Answer each recorded grasp, in the order of the file.

    With a ``tracker`` they are answered in the order of time, and the drift is followed from object
    to object. Raises ModelError for grasps on other pads.
    """
    check_pads(model, grasps[0].pads)
    if tracker is None:
        return _answers(model.recognizer, list(enumerate(grasps)), read_shape)
    answers: list[RecordedAnswer] = []
    for run in objects_in_turn(grasps):
        answers += _answers(tracker.recognizer, run, read_shape, tracker.drift_estimate)
        tracker.add_grasps([grasp for _, grasp in run])
    return sorted(answers, key=lambda answer: answer.number)


def objects_in_turn(grasps: Sequence[Grasp]) -> list[list[tuple[int, Grasp]]]:
    """Return the grasps in the order of time with their numbers, one list for each object.

    Grasps that follow each other with the same label are of one object, those without a label
    stand by themselves.
    """
    ordered = sorted(enumerate(grasps), key=lambda at: at[1].start_ms)
    runs = groupby(ordered, key=lambda at: at[1].label or f"\n{at[0]}")
    return [list(run) for _, run in runs]


def _answers(
    recognizer: Recognizer,
    grasps: Sequence[tuple[int, Grasp]],
    read_shape: ReadShape | None,
    drift: DriftEstimate | None = None,
) -> list[RecordedAnswer]:
    answers = []
    for number, grasp in grasps:
        posterior = recognizer.posterior(grasp)
        shape = None if read_shape is None else read_shape(grasp)
        if shape is not None:
            posterior = posterior.with_size(shape.low_m, shape.high_m)
        answers.append(
            RecordedAnswer(
                number=number,
                label=posterior.name,
                probability=posterior.name_probability,
                unknown=posterior.unknown,
                truth=grasp.label,
                drift=drift,
                shape=shape,
            )
        )
    return answers


def identify_on_cell(
    cell: Cell,
    config: CellConfig,
    model: TaughtModel,
    *,
    held: str | None,
    keep: Keep = Keep.NEVER,
    progress: Progress,
) -> tuple[Identification, str | None]:
    """Run one sequence; return its answer and, where the cell is simulated, the object held.

    A simulated cell that is given no object draws one of its own.

    Raises
    ------
    cell.errors.NoPartFound, cell.errors.CellStopped, and what the devices raise
        As `TaughtModel.identify`.
    """
    if held is None and config.brings_objects:
        objects = [entry.label for entry in config.simulator.objects]
        held = str(np.random.default_rng(config.seed).choice(objects))
    n_grasps = config.sequence.max_grasps
    found = model.identify(
        cell.controller,
        held=held,
        seed=config.seed + 1,
        keep=keep,
        on_grasp=lambda number, *_rest: progress("identify", number, n_grasps),
    )
    return found, held

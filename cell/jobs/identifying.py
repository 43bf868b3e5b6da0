"""Naming objects with a taught model: on the cell, or from recorded grasps."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from cell.build import Cell
from cell.choosing import ActiveChooser, memory_for
from cell.config import CellConfig
from cell.early_heads import loaded_heads
from cell.errors import ModelError
from cell.identification import Identification
from cell.jobs.progress import Progress
from cell.model import LoadedModel
from cell.sequence import plan
from cell.shapes import ReadShape
from cell.shift import Shift, drift_values
from recognition.drift_following import DriftBelief
from recognition.grasp import Grasp, PadArray
from recognition.recognizer import UNKNOWN, Recognizer


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedAnswer:
    """What one recorded grasp tells.

    Attributes
    ----------
    number
        Place of the grasp in its file, from 0.
    label, probability
        The answer and its probability.
    unknown
        Probability that the object was never taught.
    truth
        Label in the file; empty where there is none.
    drift
        What was believed of the drift when the answer was given; None where it is not followed.
    """

    number: int
    label: str
    probability: float
    unknown: float
    truth: str
    drift: DriftBelief | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the answer as plain data."""
        return {
            "grasp": self.number,
            "label": self.label,
            "probability": self.probability,
            "unknown": self.unknown,
            "truth": self.truth or None,
        } | ({} if self.drift is None else {"drift": drift_values(self.drift)})


def identify_recorded(
    model: LoadedModel, grasps: Sequence[Grasp], *, shift: Shift | None = None
) -> list[RecordedAnswer]:
    """Answer each recorded grasp, in the order of the file.

    With a ``shift`` they are answered in the order of time, and the drift is followed from object
    to object. Raises ModelError for grasps on other pads.
    """
    check_pads(model, grasps[0].pads)
    if shift is None:
        return _answers(model.recognizer, list(enumerate(grasps)), None)
    answers: list[RecordedAnswer] = []
    for run in objects_in_turn(grasps):
        answers += _answers(shift.recognizer, run, shift.belief)
        shift.seen([grasp for _, grasp in run])
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
    recognizer: Recognizer, grasps: Sequence[tuple[int, Grasp]], drift: DriftBelief | None
) -> list[RecordedAnswer]:
    answers = []
    for number, grasp in grasps:
        posterior = recognizer.posterior(grasp)
        label = posterior.decision()
        answers.append(
            RecordedAnswer(
                number=number,
                label=label,
                probability=posterior.unknown
                if label == UNKNOWN
                else float(posterior.probability.max()),
                unknown=posterior.unknown,
                truth=grasp.label,
                drift=drift,
            )
        )
    return answers


def identify_on_cell(
    cell: Cell,
    config: CellConfig,
    model: LoadedModel,
    *,
    held: str | None,
    progress: Progress,
    read_shape: ReadShape | None = None,
) -> tuple[Identification, str | None]:
    """Run one sequence; return its answer and, where the cell is simulated, what was held.

    A simulated cell that is not told what to hold draws one of its objects.

    Raises
    ------
    ModelError
        If the model was taught on other pads, or lacks what the config wants.
    """
    check_pads(model, cell.controller.pads)
    memory = memory_for(config.sequence, model)
    early = loaded_heads(model, config.sequence)
    if held is None and config.positioner.kind == "simulated":
        objects = [entry.label for entry in config.simulator.objects]
        held = str(np.random.default_rng(config.seed).choice(objects))
    cell.controller.present(held)
    n_grasps = config.sequence.max_grasps
    found = cell.controller.identify(
        model.recognizer,
        plan(config.sequence, n_grasps, seed=config.seed + 1),
        early=early,
        chooser=None
        if memory is None
        else ActiveChooser(memory, config.sequence, seed=config.seed + 1),
        read_shape=read_shape,
        on_grasp=lambda number, *_told: progress("identify", number, n_grasps),
    )
    return found, held


def check_pads(model: LoadedModel, pads: PadArray) -> None:
    """Refuse a model that was taught on other pads. Raises ModelError."""
    if not model.pads.same_as(pads):
        raise ModelError(
            f"the model was taught on {model.pads.n_taxels} taxels in {model.pads.n_pads} pads, "
            f"these grasps have {pads.n_taxels} in {pads.n_pads}{what_differs(model.pads, pads)}; "
            "teach on these pads"
        )


def what_differs(taught: PadArray, pads: PadArray) -> str:
    """Say what differs between pads of which there are as many."""
    if (taught.n_taxels, taught.n_pads) != (pads.n_taxels, pads.n_pads):
        return ""
    if taught.adc_max != pads.adc_max:
        return f", but a full scale of {pads.adc_max} instead of {taught.adc_max}"
    return " at other places"

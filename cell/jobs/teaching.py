"""Grasping known objects and training recognisers on the grasps."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cell.build import Cell
from cell.collect import GraspRecord
from cell.config import CellConfig
from cell.dataset import read_dataset, write_dataset
from cell.errors import CellError
from cell.jobs.identifying import what_differs
from cell.jobs.progress import Progress
from cell.sequence import plan
from recognition.grasp import Grasp, PadArray
from recognition.recognizer import Recognizer
from recognition.recognizers import make_trainer


def teach(
    cell: Cell, config: CellConfig, label: str, n_grasps: int, *, seed: int, progress: Progress
) -> list[GraspRecord]:
    """Grasp one known object ``n_grasps`` times, each at another pose and force.

    Raises
    ------
    cell.errors.NoPartFound, cell.errors.CellStopped
        As `CellController.grasp`; the records so far are lost to the caller, not to the recording.
    """
    steps = plan(config.sequence, n_grasps, seed=seed)
    records = []
    for record in cell.controller.collect(label, steps):
        records.append(record)
        progress(f"teach {label}", len(records), n_grasps)
    return records


def train(grasps: Sequence[Grasp], name: str, *, use_aperture: bool = True) -> Recognizer:
    """Train one kind of recogniser.

    Raises
    ------
    CellError
        If the grasps do not suffice; the message says what is missing.
    """
    try:
        return make_trainer(name, use_aperture=use_aperture).fit(grasps)
    except ValueError as error:
        raise CellError(
            f"{name} cannot be trained on these {len(grasps)} grasps: {error}"
        ) from error


def repeated(grasps: Sequence[Grasp]) -> list[Grasp]:
    """Return the grasps that stood before already, at the same time with the same frames."""
    seen: dict[int, list[Grasp]] = {}
    found = []
    for grasp in grasps:
        others = seen.setdefault(grasp.start_ms, [])
        if any(np.array_equal(grasp.counts, other.counts) for other in others):
            found.append(grasp)
        others.append(grasp)
    return found


def dataset_to_extend(path: Path, pads: PadArray) -> tuple[Grasp, ...]:
    """Return the grasps that a data set holds already, before grasps of these pads are taken.

    Raises
    ------
    CellError
        If it cannot be read, holds grasps on other pads, or its folder does not exist.
    """
    if not path.parent.is_dir():
        raise CellError(f"{path}: the folder {path.parent} does not exist; make it first")
    before = read_dataset(path) if path.exists() else ()
    _check_pads(path, before, pads)
    return before


def append_to_dataset(path: Path, before: Sequence[Grasp], new: Sequence[Grasp]) -> None:
    """Write a data set anew with further grasps at its end.

    Raises
    ------
    CellError
        If the new grasps were taken on other pads; the file stays as it was.
    """
    _check_pads(path, before, new[0].pads)
    write_dataset(path, [*before, *new])


def _check_pads(path: Path, before: Sequence[Grasp], here: PadArray) -> None:
    if before and not before[0].pads.same_as(here):
        there = before[0].pads
        raise CellError(
            f"{path} holds grasps on other pads: {there.n_taxels} taxels in {there.n_pads} pads, "
            f"these have {here.n_taxels} in {here.n_pads}{what_differs(there, here)}; choose "
            "another file"
        )

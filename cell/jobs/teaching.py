"""Grasping known objects and training recognisers on the grasps."""

from collections.abc import Sequence

from cell.build import Cell
from cell.collect import GraspRecord
from cell.config import CellConfig
from cell.errors import CellError
from cell.jobs.progress import Progress
from cell.sequence import plan
from recognition.grasp import Grasp
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

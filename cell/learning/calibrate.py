"""Calibration of a taught model for sensor drift, by known objects or any grasps of a shift."""

from collections.abc import Mapping, Sequence

from cell.errors import CellError
from cell.learning.blas import one_blas_thread
from cell.learning.model import LoadedModel, check_pads
from cell.learning.training import gaugeable, gauged
from recognition.grasp import Grasp
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer

GAUGE_GRASPS = 3
"""Grasps of each gauge object at the start of a shift."""

MIN_UNNAMED_GRASPS = 5
"""Least number of unnamed grasps that show a drift."""


@one_blas_thread()
def calibrate_model(
    model: LoadedModel, grasps: Mapping[str, Sequence[Grasp]]
) -> ForceRampRecognizer:
    """Return a copy of the taught recogniser after gauges.

    The model was taught before the drift; results of earlier gauges are dropped. Each gauge object
    is a taught one with new grasps. Raises ModelError if the model is of a kind that cannot be
    gauged, or was taught on other pads. Raises CellError if an object was not taught, or no grasp
    of it touched both pads.
    """
    recognizer = gaugeable(model, *grasps).without_gauges()
    for label, taken in grasps.items():
        if taken:
            check_pads(model, taken[0].pads)
        recognizer = gauged(recognizer, label, taken)
    return recognizer


@one_blas_thread()
def follow_shift(model: LoadedModel, grasps: Sequence[Grasp]) -> ForceRampRecognizer:
    """Return a copy with the drift that the unnamed grasps of a shift show.

    Raises ModelError if the model is of a kind that cannot be gauged, or was taught on other pads,
    and CellError if there are too few grasps.
    """
    recognizer = gaugeable(model)
    if len(grasps) < MIN_UNNAMED_GRASPS:
        raise CellError(
            f"{len(grasps)} grasps are too few for a drift: give {MIN_UNNAMED_GRASPS} or more, of "
            "several objects, or name the object with --gauge"
        )
    check_pads(model, grasps[0].pads)
    for grasp in sorted(grasps, key=lambda g: g.start_ms):
        recognizer = recognizer.follow(grasp)
    return recognizer.with_grid(recognizer.grid.with_unnamed_kept())

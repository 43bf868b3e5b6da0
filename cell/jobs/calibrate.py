"""Calibration of a taught model for the drift since, by a known object or any grasps of a shift."""

from collections.abc import Sequence

from cell.errors import CellError
from cell.jobs.identify import objects_in_turn
from cell.learning.blas import one_blas_thread
from cell.learning.drift import gaugeable
from cell.learning.model import LoadedModel, check_pads
from recognition.drift.drift import Drift
from recognition.drift.estimate import DriftEstimate
from recognition.grasp import Grasp
from recognition.recognizers.force_ramp.recognizer import ForceRamp

GAUGE_GRASPS = 3
"""Grasps of the gauge object at the start of a shift."""

MIN_OBJECTS = 5
"""Objects in turn that show a drift when none of them is named."""


@one_blas_thread()
def calibrate_model(
    model: LoadedModel, label: str, grasps: Sequence[Grasp]
) -> tuple[ForceRamp, DriftEstimate]:
    """Return a copy of the taught recogniser that expects the drift which the grasps show.

    Parameters
    ----------
    model
        Taught before the drift; corrections do not add up, so gauge the same model each time.
    label
        The gauge object: one of the taught objects.
    grasps
        Grasps of it, taken now.

    Raises
    ------
    ModelError
        If the model is of a kind that cannot be gauged, or was taught on other pads.
    CellError
        If the object was not taught, or no grasp touched both pads.
    """
    recognizer = _force_ramp(model, grasps)
    try:
        found = recognizer.gauge(label, grasps)
    except ValueError as error:
        raise CellError(f"cannot calibrate: {error}") from error
    return recognizer.with_drift(found), found


@one_blas_thread()
def follow_shift(model: LoadedModel, grasps: Sequence[Grasp]) -> tuple[ForceRamp, Drift]:
    """Return a copy that expects the drift which a shift's grasps show, and that drift.

    Most of the objects must have been taught; which one each grasp held need not be known. Grasps
    that follow each other with the same label count as one object, those without a label by
    themselves.

    Raises
    ------
    ModelError
        If the model is of a kind that cannot be gauged, or was taught on other pads.
    CellError
        If there are fewer objects in turn than show a drift.
    """
    recognizer = _force_ramp(model, grasps)
    runs = objects_in_turn(grasps)
    if len(runs) < MIN_OBJECTS:
        raise CellError(
            f"{len(runs)} objects in turn do not show a drift: give grasps of {MIN_OBJECTS} or "
            "more, or name the object with --gauge"
        )
    recognizer = recognizer.expecting_taught_objects()
    for run in runs:
        recognizer = recognizer.track_drift([grasp for _, grasp in run])
    found = recognizer.drift_estimate
    return recognizer.with_drift(found), found.drift


def check_gauge(model: LoadedModel, label: str) -> None:
    """Refuse a gauge object that the model cannot be calibrated with, before it is grasped.

    Raises
    ------
    ModelError
        If the model is of a kind that cannot be gauged.
    CellError
        If the object was not taught.
    """
    _force_ramp(model, ())
    if label not in model.labels:
        raise CellError(
            f"{label!r} was not taught: gauge with one of {', '.join(model.labels)}, or teach it"
        )


def _force_ramp(model: LoadedModel, grasps: Sequence[Grasp]) -> ForceRamp:
    recognizer = gaugeable(model.recognizer, model.trainer_name)
    if grasps:
        check_pads(model, grasps[0].pads)
    return recognizer

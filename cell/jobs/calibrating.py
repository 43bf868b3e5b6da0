"""Correcting a taught model for what drifted since, by a few grasps of one known object."""

from collections.abc import Sequence

from cell.errors import CellError, ModelError
from cell.jobs.identifying import check_pads
from cell.model import LoadedModel
from recognition.gauge import Gauged
from recognition.grasp import Grasp
from recognition.recognizers.force_ramp import ForceRamp

GAUGE_GRASPS = 3
"""Grasps of the gauge object at the start of a shift."""


def calibrate_model(
    model: LoadedModel, label: str, grasps: Sequence[Grasp]
) -> tuple[ForceRamp, Gauged]:
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
    if not isinstance(model.recognizer, ForceRamp):
        raise ModelError(
            f"a model of {model.trainer_name} cannot be gauged; train one of force_ramp"
        )
    if grasps:
        check_pads(model, grasps[0].pads)
    try:
        found = model.recognizer.gauge(label, grasps)
    except ValueError as error:
        raise CellError(f"cannot calibrate: {error}") from error
    return model.recognizer.gauged(found), found

"""Training: from labelled grasps to a model and back; what recorded grasps show with a model."""

from collections.abc import Mapping, Sequence

from cell.control.identification import ReadShape
from cell.errors import CellError, ModelError, RequestRefused, TooFewGrasps, raised_as
from cell.learning.model import LoadedModel, Trained, check_pads
from cell.learning.parallel import one_blas_thread
from cell.plugins import RECOGNIZERS
from recognition.drift.drift import DriftFollowing, DriftGrid
from recognition.grasp import Grasp
from recognition.recognizer import Posterior, Recognizer
from recognition.shape.answer import ShapeAnswer
from recognition.statistics.fusion import fuse


def gaugeable(model: Trained, *labels: str) -> DriftFollowing:
    """Return the recognizer of a model if it can be gauged with these objects, or follow a drift.

    Raises ModelError if it is of another kind, and RequestRefused if an object was not taught.
    """
    recognizer = model.recognizer
    if not isinstance(recognizer, DriftFollowing):
        raise ModelError(
            f"a {model.trainer_name} model cannot follow or gauge a drift; train a force_ramp model"
        )
    for label in labels:
        if label not in recognizer.labels:
            raise RequestRefused(
                f"{label!r:.80} was not taught: gauge with one of {', '.join(recognizer.labels)}"
            )
    return recognizer


def gauged(recognizer: DriftFollowing, label: str, grasps: Sequence[Grasp]) -> DriftFollowing:
    """Return a recognizer gauged with new grasps of a taught object.

    Raises CellError if the object was not taught, no grasp touched both pads, or the grasps are
    most like another taught object also under the drift that they would show.
    """
    with raised_as(CellError, ValueError, where="cannot gauge"):
        after = recognizer.gauge(label, grasps)
        likeliest = fuse([after.posterior(grasp) for grasp in grasps]).best
    if likeliest != label:
        raise CellError(f"cannot gauge with {label}: these grasps are more like {likeliest}")
    return after


@one_blas_thread()
def train(grasps: Sequence[Grasp], name: str, *, use_aperture: bool = True) -> Trained:
    """Train one kind of recognizer.

    Raises CellError if the grasps are too few or unsuitable; the message names what is missing.

    Parameters
    ----------
    name
        Kind of recognizer, one of `cell.plugins.RECOGNIZERS`.
    use_aperture
        Whether the opening of the fingers is a feature.
    """
    trainer = RECOGNIZERS[name](use_aperture=use_aperture)
    try:
        recognizer = trainer.fit(grasps)
    except ValueError as error:
        raise TooFewGrasps(
            f"{name} cannot be trained on these {len(grasps)} grasps: {error}"
        ) from error
    return Trained(recognizer=recognizer, trainer_name=name)


MIN_UNNAMED_GRASPS = 5
"""Least number of unnamed grasps that show a drift."""

AnsweredGrasp = tuple[Posterior, ShapeAnswer | None, DriftGrid | None]
"""Answer to one recorded grasp, its shape and size, and the drift that it assumes; None: shape or
drift are not requested, or the pads do not show the shape."""


@one_blas_thread()
def calibrate_model(model: LoadedModel, grasps: Mapping[str, Sequence[Grasp]]) -> DriftFollowing:
    """Return a copy of the taught recognizer after gauges.

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
def follow_shift(model: LoadedModel, grasps: Sequence[Grasp]) -> DriftFollowing:
    """Return a copy with the drift that the unnamed grasps of a shift show.

    Raises ModelError if the model is of a kind that cannot be gauged, or was taught on other pads.
    Raises CellError if there are too few grasps.
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
    return recognizer.with_grid(recognizer.grid.with_unnamed_as_gauge())


@one_blas_thread()
def identify_recorded(
    model: LoadedModel,
    grasps: Sequence[Grasp],
    *,
    follow: bool = False,
    read_shape: ReadShape | None = None,
) -> list[AnsweredGrasp]:
    """Answer each recorded grasp, in the order of the file.

    With ``follow`` they are answered in the order of time, and the drift is followed from grasp to
    grasp. Raises ModelError for grasps on other pads, and if the recognizer cannot follow a drift.
    """
    check_pads(model, grasps[0].pads)
    recognizer: Recognizer = gaugeable(model) if follow else model.recognizer
    answers: dict[int, AnsweredGrasp] = {}
    order = range(len(grasps))
    for number in sorted(order, key=lambda i: grasps[i].start_ms) if follow else order:
        grasp = grasps[number]
        posterior = recognizer.posterior(grasp)
        shape = None if read_shape is None else read_shape(grasp)
        if shape is not None:
            posterior = posterior.with_size(shape.low_m, shape.high_m)
        drift = None
        if follow and isinstance(recognizer, DriftFollowing):
            drift, recognizer = recognizer.grid, recognizer.follow(grasp)
        answers[number] = posterior, shape, drift
    return [answers[number] for number in order]

"""Identification: of the object in a cell, or of recorded grasps, with a taught model."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.config.model import CellConfig
from cell.control.controller import CellController
from cell.control.identification import Identification, OnGrasp, ReadShape
from cell.control.keeping import Keep
from cell.control.plan import plan
from cell.errors import ModelError
from cell.learning.blas import one_blas_thread
from cell.learning.model import LoadedModel, check_pads
from cell.learning.taught_model import TaughtModel
from recognition.drift.grid import DriftFollowing, DriftGrid
from recognition.grasp import Grasp
from recognition.recognizer import Posterior
from recognition.shape.answer import ShapeAnswer

AnsweredGrasp = tuple[Posterior, ShapeAnswer | None, DriftGrid | None]
"""Answer to one recorded grasp, its shape and size, and the drift that it assumes; None: shape or
drift are not requested, or the pads do not show the shape."""


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
    grasp. Raises ModelError for grasps on other pads, and if the recogniser cannot follow a drift.
    """
    check_pads(model, grasps[0].pads)
    recognizer = model.recognizer
    if follow and not isinstance(recognizer, DriftFollowing):
        raise ModelError(
            f"a model of {model.trainer_name} cannot follow a drift; train a force_ramp model"
        )
    answers: dict[int, AnsweredGrasp] = {}
    order = range(len(grasps))
    for number in sorted(order, key=lambda i: grasps[i].start_ms) if follow else order:
        grasp = grasps[number]
        posterior = recognizer.posterior(grasp)
        shape = None if read_shape is None else read_shape(grasp)
        if shape is not None:
            posterior = posterior.with_size(shape.low_m, shape.high_m)
        followed = recognizer if follow and isinstance(recognizer, DriftFollowing) else None
        answers[number] = posterior, shape, None if followed is None else followed.grid
        if followed is not None:
            recognizer = followed.follow(grasp)
    return [answers[number] for number in order]


@one_blas_thread()
def identify(
    controller: CellController,
    model: TaughtModel,
    *,
    presented: str | None,
    seed: int,
    max_grasps: int | None = None,
    force_n: float | None = None,
    keep: Keep = Keep.NEVER,
    whole_ramps: bool = False,
    on_grasp: OnGrasp | None = None,
) -> Identification:
    """Grasp an object until its name is sure enough, then follow the drift that it shows.

    Raises CellStateError if nothing was taught yet. Else it raises as `CellController.identify`.

    Parameters
    ----------
    presented
        Object for the positioner to bring; None: the present object.
    max_grasps
        Most grasps; None: as many as the config allows.
    force_n
        Force at the end of each ramp in N; None: those of the plan.
    keep
        When the part stays in the grip.
    whole_ramps
        Whether no ramp ends early, also against the config.
    """
    recognizer, sequence = model.recognizer, model.config.sequence
    if force_n is not None:
        sequence = sequence.with_force(force_n)
    controller.moves.present(presented)
    found = controller.identify(
        recognizer,
        plan(sequence, max_grasps or sequence.max_grasps, seed=seed),
        early=model.ends_early and not whole_ramps,
        read_shape=model.shapes.reader,
        on_grasp=on_grasp,
        keep=keep,
    )
    remark = model.remark_on(found.records)
    if remark:
        controller.journal.note("drift", remark)
    return replace(found, remark=remark)


def drawn_object(config: CellConfig) -> str | None:
    """Return the object that a simulated cell draws by its seed; None if it cannot choose."""
    objects = [entry.label for entry in config.simulator.objects]
    draw = np.random.default_rng(config.seed)
    return str(draw.choice(objects)) if config.brings_objects else None

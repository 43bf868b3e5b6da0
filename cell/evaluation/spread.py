"""Spread between days and cells, learnt for a model."""

from collections.abc import Sequence
from dataclasses import replace

from cell.archive.selection import cell_of, day_of
from cell.learning.model import Trained
from recognition.drift.drift import DriftFollowing, DriftGrid, DriftPrior, learn_spread
from recognition.grasp import Grasp


def with_spread(trained: Trained, grasps: Sequence[Grasp]) -> tuple[Trained, DriftPrior | None]:
    """Return what was trained with the learnt spread, and that; None where there is none to learn.

    It takes a default recognizer without a self-zero, and several days or cells of one object.
    """
    recognizer = trained.recognizer
    if not isinstance(recognizer, DriftFollowing) or recognizer.zero is not None:
        return trained, None
    prior = learn_spread(grasps, [f"{day_of(one.start_ms)} {cell_of(one)}" for one in grasps])
    if prior is None:
        return trained, None
    return replace(trained, recognizer=recognizer.with_grid(DriftGrid(prior=prior))), prior

"""Spread between days, cells and series: learnt for a model, and what it gains on new ones."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

from cell.evaluation.compare import Comparison, compared
from cell.evaluation.selected_grasps import LEFT_OUT, day_and_cell, left_out_in_turn
from cell.learning.blas import one_blas_thread
from cell.learning.model import Trained
from cell.learning.progress import Progress
from cell.learning.training import train
from recognition.drift.grid import DriftFollowing, DriftGrid, DriftPrior
from recognition.drift.spread import learn_spread
from recognition.evaluation.evaluation import Mapper, one_by_one
from recognition.evaluation.splits import TrainTest
from recognition.grasp import Grasp

_MOST_PARTS = 12
"""Parts that are left out in turn at most: each costs a training."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpreadGain:
    """What the learnt spread gains on new days, cells or series, which are left out in turn."""

    what: str
    """``days``, ``cells`` or ``series``."""
    n_parts: int
    """Parts that were left out."""
    names: Comparison
    """Names of their grasps without the spread, and with it."""


def with_spread(trained: Trained, grasps: Sequence[Grasp]) -> tuple[Trained, DriftPrior | None]:
    """Return what was trained with the learnt spread, and that; None where there is none to learn.

    It takes a default recogniser without a self-zero, and several days or cells of one object.
    """
    recognizer = trained.recognizer
    if not isinstance(recognizer, DriftFollowing) or recognizer.zero is not None:
        return trained, None
    prior = learn_spread(grasps, day_and_cell(grasps))
    if prior is None:
        return trained, None
    return replace(trained, recognizer=recognizer.with_grid(DriftGrid(prior=prior))), prior


def spread_gains(
    grasps: Sequence[Grasp],
    name: str,
    *,
    mapper: Mapper = one_by_one,
    progress: Progress,
) -> list[SpreadGain]:
    """Return what the learnt spread gains on days, cells and series that are left out."""
    found = []
    work = partial(_answered, name)
    for what in LEFT_OUT:
        try:
            parts = left_out_in_turn(grasps, what)
        except ValueError:  # all of one day, cell or series
            continue
        parts = parts[:: -(-len(parts) // _MOST_PARTS)]
        rows = []
        for number, answered in enumerate(mapper(work, parts)):
            progress(f"leave out {what}", number + 1, len(parts))
            rows += answered
        if rows:
            names = compared(*zip(*rows, strict=True))
            found.append(SpreadGain(what=what, n_parts=len(parts), names=names))
    return found


@one_blas_thread()
def _answered(name: str, part: TrainTest) -> list[tuple[str, str, str]]:
    """Return label and both names of each tested grasp; none where the spread cannot be learnt."""
    taught, test = part
    plain = train(taught, name)
    spread, prior = with_spread(plain, taught)
    if prior is None:
        return []
    return [
        (g.label, plain.recognizer.posterior(g).name, spread.recognizer.posterior(g).name)
        for g in test
    ]


def spread_values(prior: DriftPrior, gains: Sequence[SpreadGain]) -> dict[str, Any]:
    """Return what ``--json`` writes of a learnt spread."""
    return {
        "log_gain_sd": prior.log_gain_sd,
        "offset_sd_mm": prior.offset_sd_mm,
        "left_out": [asdict(one) for one in gains],
    }

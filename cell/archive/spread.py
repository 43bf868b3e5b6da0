"""Spread between days, cells and individuals: learnt for a model, and what it gains on new ones."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

from cell.archive.selected_grasps import GROUPS, day_and_cell
from cell.learning.blas import one_blas_thread
from cell.learning.progress import Progress
from cell.learning.training import Trained, train
from recognition.drift.grid import DriftGrid, DriftPrior
from recognition.drift.spread import learn_spread
from recognition.evaluation.evaluation import Mapper, one_by_one
from recognition.evaluation.metrics import paired_difference
from recognition.evaluation.splits import TrainTest, left_out_parts, series_parts
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer

_MOST_PARTS = 12
"""Parts that are left out in turn at most: each costs a training."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpreadGain:
    """Names of grasps of new days, cells or individuals, with the learnt spread and without it."""

    what: str
    """``days``, ``cells`` or ``individuals``."""
    n_parts: int
    n: int
    """Parts that were left out in turn, and grasps in them."""
    right_without: float
    right: float
    wrong_without: float
    wrong: float
    """Share that is named rightly and wrongly; the others are UNKNOWN."""
    gained: float
    interval: tuple[float, float]
    """How many more are named rightly, as a share of all, and its 95 % interval (paired)."""


def with_spread(trained: Trained, grasps: Sequence[Grasp]) -> tuple[Trained, DriftPrior | None]:
    """Return what was trained with the learnt spread, and that; None where there is none to learn.

    It takes a default recogniser without a self-zero, and several days or cells of one object.
    """
    recognizer = trained.recognizer
    if not isinstance(recognizer, ForceRampRecognizer) or recognizer.zero is not None:
        return trained, None
    prior = learn_spread(grasps, day_and_cell(grasps), recognizer.rest)
    if prior is None:
        return trained, None
    return replace(trained, recognizer=recognizer.with_grid(DriftGrid(prior=prior))), prior


def spread_gains(
    grasps: Sequence[Grasp],
    name: str,
    *,
    use_aperture: bool = True,
    mapper: Mapper = one_by_one,
    progress: Progress,
) -> list[SpreadGain]:
    """Return what the learnt spread gains on days, cells and individuals that are left out."""
    found = []
    work = partial(_answered, name, use_aperture)
    for what in (*GROUPS, "individuals"):
        try:
            if what == "individuals":
                parts = series_parts(grasps)
            else:
                parts = left_out_parts(grasps, [GROUPS[what](grasp) for grasp in grasps])
        except ValueError:  # all of one day, cell or individual
            continue
        parts = parts[:: -(-len(parts) // _MOST_PARTS)]
        rows = []
        for number, answered in enumerate(mapper(work, parts)):
            progress(f"leave out {what}", number + 1, len(parts))
            rows += answered
        if rows:
            found.append(_gain(what, len(parts), rows))
    return found


@one_blas_thread()
def _answered(name: str, use_aperture: bool, part: TrainTest) -> list[tuple[str, str, str]]:
    """Return label and both names of each tested grasp; none where the spread cannot be learnt."""
    taught, test = part
    plain = train(taught, name, use_aperture=use_aperture)
    spread, prior = with_spread(plain, taught)
    if prior is None:
        return []
    return [
        (g.label, plain.recognizer.posterior(g).name, spread.recognizer.posterior(g).name)
        for g in test
    ]


def _gain(what: str, n_parts: int, rows: Sequence[tuple[str, str, str]]) -> SpreadGain:
    n = len(rows)
    before = [name == label for label, name, _ in rows]
    after = [name == label for label, _, name in rows]
    gained, interval = paired_difference(before, after)
    wrong = [sum(row[i] not in (row[0], UNKNOWN) for row in rows) / n for i in (1, 2)]
    return SpreadGain(
        what=what,
        n_parts=n_parts,
        n=n,
        right_without=sum(before) / n,
        right=sum(after) / n,
        wrong_without=wrong[0],
        wrong=wrong[1],
        gained=gained,
        interval=interval,
    )


def spread_values(prior: DriftPrior, gains: Sequence[SpreadGain]) -> dict[str, Any]:
    """Return what ``--json`` writes of a learnt spread."""
    return {
        "log_gain_sd": prior.log_gain_sd,
        "offset_sd_mm": prior.offset_sd_mm,
        "left_out": [asdict(one) for one in gains],
    }

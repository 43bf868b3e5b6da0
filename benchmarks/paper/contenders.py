"""The recognisers of the product on the grasps that the paper's level check is tried with."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.effort import Effort, Spread
from benchmarks.paper.grasps import PAPER_NOISE, random_grasp
from benchmarks.paper.level_trials import LABELS
from recognition.evaluation.metrics import confusion_matrix
from recognition.recognizer import UNKNOWN
from recognition.recognizers import make_trainer, trainer_names

LEVEL_CHECK = "level_check"
"""The paper's own, as the cell has it: probabilities and UNKNOWN, at the common force."""

_APERTURE_TOO = ("force_ramp", "shrinkage_lda")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contender:
    """One recogniser on the same kind of grasps."""

    name: str
    uses_aperture: bool
    """Which, and whether it sees the opening."""
    counts: NDArray[np.int64]
    """(objects, objects) int64: row: held; column: the likeliest label."""
    rejected: int
    """Trials that it took for an untaught object."""


def try_one(match: tuple[str, bool, Effort]) -> Contender:
    """Teach and test one recogniser (name, with the opening or not), once for each lesson."""
    name, uses_aperture, effort = match
    counts = np.zeros((len(LABELS), len(LABELS)), dtype=np.int64)
    rejected = 0
    for lesson in range(effort.other_lessons):
        rng = np.random.default_rng([effort.seed, 7, lesson])
        taught, tested = (
            [
                random_grasp(label, rng, PAPER_NOISE, start_ms=number)
                for label in LABELS
                for number in range(n)
            ]
            for n in (effort.n_taught, effort.other_tested)
        )
        recognizer = make_trainer(name, use_aperture=uses_aperture).fit(taught)
        answers = [recognizer.posterior(grasp) for grasp in tested]
        counts += confusion_matrix(
            [grasp.label for grasp in tested], [answer.best for answer in answers], LABELS
        )
        rejected += sum(answer.name == UNKNOWN for answer in answers)
    return Contender(name=name, uses_aperture=uses_aperture, counts=counts, rejected=rejected)


def contenders(effort: Effort, spread: Spread) -> tuple[Contender, ...]:
    """Try each recogniser by touch alone and, where it can, with the opening."""
    matches = [(name, False, effort) for name in trainer_names()]
    matches += [(name, True, effort) for name in _APERTURE_TOO]
    return tuple(spread(try_one, matches))

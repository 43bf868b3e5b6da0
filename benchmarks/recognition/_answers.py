"""Answers to grasps of known objects, and how right they are as text."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from benchmarks._measure import share
from cell.config.sequence import SequenceConfig
from cell.jobs.calibrate import GAUGE_GRASPS
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN, Posterior, Recognizer
from recognition.recognizers.early_classifiers import EarlyClassifiers, EarlyDecider
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer
from recognition.statistics.fusion import StopRule


@dataclass(frozen=True, slots=True)
class JudgedAnswer:
    """The answer to one grasp or sequence, and the truth."""

    truth: str
    taught: bool
    """What was grasped, and whether the recogniser was taught it."""
    best: str
    name: str
    """The likeliest label, and the name that is given: that label or ``UNKNOWN``."""
    early: bool = False
    """Whether the name ended the ramp early."""

    @classmethod
    def of(cls, truth: str, posterior: Posterior, *, early: bool = False) -> Self:
        """Return what a posterior answers."""
        return cls(truth, truth in posterior.labels, posterior.best, posterior.name, early)


def asked(
    recognizer: Recognizer, grasps: Sequence[Grasp], early: EarlyClassifiers | None = None
) -> list[JudgedAnswer]:
    """Answer each grasp by itself; with ``early`` by as much of its ramp as a cell would take."""
    heads = None if early is None else early.as_wary_as(recognizer)
    answers = []
    for grasp in grasps:
        ended = None if heads is None else _when_sure(heads, grasp)
        found = recognizer.posterior(grasp) if ended is None else ended
        answers.append(JudgedAnswer.of(grasp.label, found, early=ended is not None))
    return answers


def _when_sure(early: EarlyClassifiers, grasp: Grasp) -> Posterior | None:
    """Return the answer that ends the ramp of a recorded grasp; None where it is whole."""
    rule = StopRule(error_rate=SequenceConfig().error_rate)
    early_checks = EarlyDecider(early, (), rule)
    any(early_checks.add_frame(counts, lambda: grasp) for counts in grasp.counts)
    return early_checks.answer


def followed(
    recognizer: ForceRampRecognizer,
    grasps: Sequence[Grasp],
    seed: int,
    early: EarlyClassifiers | None = None,
) -> tuple[list[JudgedAnswer], ForceRampRecognizer]:
    """Answer the grasps of a shift in a mixed order, each after those before it.

    Ramps that ``early`` ends are not followed. Returns the answers, and the recogniser after the
    last one.
    """
    answers = []
    for i in np.random.default_rng(seed).permutation(len(grasps)).tolist():
        answers += asked(recognizer, [grasps[i]], early)
        if not answers[-1].early:
            recognizer = recognizer.follow(grasps[i])
    return answers, recognizer


def gauged(
    recognizer: ForceRampRecognizer, grasps: Sequence[Grasp], labels: Sequence[str]
) -> list[JudgedAnswer]:
    """Gauge with the first grasps of each label and answer all others."""
    taken: list[Grasp] = []
    for label in labels:
        some = [grasp for grasp in grasps if grasp.label == label][:GAUGE_GRASPS]
        recognizer = recognizer.gauge(label, some)
        taken += some
    return asked(recognizer, [g for g in grasps if not any(g is one for one in taken)])


def figures(answers: Sequence[JudgedAnswer], *, times: int = 1) -> str:
    """Return the shares of right, wrong and missing names, of taught objects and of new ones.

    Each grasp was answered several ``times``: for the intervals it counts as one.
    """
    known = [one for one in answers if one.taught]
    new = [one.name == UNKNOWN for one in answers if not one.taught]
    kinds = {
        "likeliest right": [one.best == one.truth for one in known],
        "named right": [one.name == one.truth for one in known],
        "wrong": [one.name not in (one.truth, UNKNOWN) for one in known],
        "UNKNOWN": [one.name == UNKNOWN for one in known],
    }
    texts = [f"{kind} {share(sum(hits), len(hits), times=times)}" for kind, hits in kinds.items()]
    text = f"{', '.join(texts)} of {len(known) // times}"
    if any(one.early for one in answers):
        text += f", {np.mean([one.early for one in answers]):.0%} of all ended early"
    return text + (f"; new UNKNOWN {share(sum(new), len(new))} of {len(new)}" if new else "")

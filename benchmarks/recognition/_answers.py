"""Answers to grasps of known objects, and how right they are as text."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from benchmarks._measure import share
from cell.jobs.calibrate import GAUGE_GRASPS
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN, Posterior, Recognizer
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer


@dataclass(frozen=True, slots=True)
class JudgedAnswer:
    """The answer to one grasp or sequence, and the truth."""

    truth: str
    taught: bool
    """What was grasped, and whether the recogniser was taught it."""
    best: str
    name: str
    """The likeliest label, and the name that is given: that label or ``UNKNOWN``."""

    @classmethod
    def of(cls, truth: str, posterior: Posterior) -> Self:
        """Return what a posterior answers."""
        return cls(truth, truth in posterior.labels, posterior.best, posterior.name)


def asked(recognizer: Recognizer, grasps: Sequence[Grasp]) -> list[JudgedAnswer]:
    """Answer each grasp by itself."""
    return [JudgedAnswer.of(grasp.label, recognizer.posterior(grasp)) for grasp in grasps]


def followed(
    recognizer: ForceRampRecognizer,
    grasps: Sequence[Grasp],
    seed: int,
) -> tuple[list[JudgedAnswer], ForceRampRecognizer]:
    """Answer the grasps of a shift in a mixed order, each after those before it.

    Returns the answers, and the recogniser after the last one.
    """
    answers = []
    for i in np.random.default_rng(seed).permutation(len(grasps)).tolist():
        answers += asked(recognizer, [grasps[i]])
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
    return text + (f"; new UNKNOWN {share(sum(new), len(new))} of {len(new)}" if new else "")

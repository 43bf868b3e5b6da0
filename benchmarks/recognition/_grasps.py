"""Grasps that recognition is measured on, and how right the answers to them are as text."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from benchmarks._measure import share
from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.runtime.tasks import Collection
from cell.simulation import simulator_settings
from recognition.evaluation.evaluation import interval_by_object
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN, Recognizer
from recognition.recognizers.force_ramp.recognizer import ForceRampRecognizer
from recognition.statistics.fusion import fuse


def cell_grasps(
    objects: Mapping[str, str], n_grasps: int, *, seed: int, **differs: Any
) -> list[Grasp]:
    """Have a simulated cell measure its zero and grasp each object (label -> shape) some times.

    It is in virtual time, through servos, buses and force loop. Fields of the simulator's settings
    in which it differs from its config may be given.
    """
    entries = [{"label": label, "shape": text} for label, text in objects.items()]
    changes = {"simulator.objects": entries, "seed": seed, "self_zero": "always"}
    config = changed_config(CellConfig(), changes)

    def settings(config: CellConfig, **others):
        return replace(simulator_settings(config, **others), **differs)

    with patch("cell.simulation.simulator_settings", settings):
        cell = build_cell(config)
    with closing(cell):
        cell.controller.start()
        grasps = list[Grasp]()
        for number, label in enumerate(objects, start=1000 * seed):
            collection = Collection(label=label, n_planned=n_grasps)
            collection.fill(cell.controller, config.sequence, seed=number)
            grasps += collection.grasps
        return grasps


class JudgedAnswer(NamedTuple):
    """The answer to one grasp, and the truth."""

    truth: str
    taught: bool
    """What was grasped, and whether the recognizer was taught it."""
    best: str
    name: str
    """The likeliest label, and the name that is given: that label or ``UNKNOWN``."""


def asked(recognizer: Recognizer, grasps: Sequence[Grasp], n_fused: int = 1) -> list[JudgedAnswer]:
    """Answer each grasp by itself, or each ``n_fused`` of one object together."""
    posteriors = [(grasp.label, recognizer.posterior(grasp)) for grasp in grasps]
    if n_fused > 1:
        parts = [posteriors[i : i + n_fused] for i in range(0, len(grasps), n_fused)]
        posteriors = [(part[0][0], fuse([posterior for _, posterior in part])) for part in parts]
    return [JudgedAnswer(truth, truth in p.labels, p.best, p.name) for truth, p in posteriors]


def followed(
    recognizer: ForceRampRecognizer, grasps: Sequence[Grasp]
) -> tuple[list[JudgedAnswer], ForceRampRecognizer]:
    """Answer grasps in a random order and follow the drift through them; also what followed it."""
    answers = list[JudgedAnswer]()
    for i in np.random.default_rng(0).permutation(len(grasps)).tolist():
        answers += asked(recognizer, [grasps[i]])
        recognizer = recognizer.follow(grasps[i])
    return answers, recognizer


def figures(answers: Sequence[JudgedAnswer], groups: Sequence[object] | None = None) -> str:
    """Return the shares of right, wrong and missing names, of taught objects and of new ones.

    With a group of each answer, the intervals are those of a bootstrap of the groups, which are
    many answers each: teachings, cells.
    """

    def text(kind: str, hits: Sequence[bool], taught: bool) -> str:
        among = [
            group for a, group in zip(answers, groups or (), strict=False) if a.taught is taught
        ]
        interval = interval_by_object(hits, list(map(str, among)), fewest=2) if among else None
        return f"{kind} {share(sum(hits), len(hits), interval)}"

    known = [answer for answer in answers if answer.taught]
    new = [answer.name == UNKNOWN for answer in answers if not answer.taught]
    kinds = {
        "likeliest right": [answer.best == answer.truth for answer in known],
        "named right": [answer.name == answer.truth for answer in known],
        "wrong": [answer.name not in (answer.truth, UNKNOWN) for answer in known],
        "UNKNOWN": [answer.name == UNKNOWN for answer in known],
    }
    texts = [text(kind, hits, True) for kind, hits in kinds.items()]
    unknown = f"; {text('new UNKNOWN', new, False)} of {len(new)}" if new else ""
    return f"{', '.join(texts)} of {len(known)}{unknown}"

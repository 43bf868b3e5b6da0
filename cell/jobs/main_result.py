"""What the main job found out: its trials, how often each recogniser was right, and the files."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cell.collect import GraspRecord
from cell.identification import Identification
from cell.shift import drift_values
from recognition.drift_following import DriftBelief
from recognition.evaluation import wilson_interval
from recognition.recognizer import UNKNOWN, Posterior, Recognizer


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One identification and what was really held."""

    truth: str
    found: Identification
    first: dict[str, Posterior]
    """What further recognisers say of the first grasp alone, by name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """How often one recogniser was right.

    Attributes
    ----------
    accuracy, interval
        Share of right answers and its 95 % interval (Wilson).
    n, n_right
        Answers in all and right ones.
    confusion : (n_labels, n_labels + 1) int
        Row: what was held; column: the answer, the last one UNKNOWN.
    """

    accuracy: float
    interval: tuple[float, float]
    n: int
    n_right: int
    confusion: tuple[tuple[int, ...], ...]


@dataclass(slots=True, kw_only=True)
class MainResult:
    """What the main job found out and where it is written."""

    labels: tuple[str, ...]
    default: str
    n_taught: int
    seconds: float
    scores: dict[str, Score]
    trials: tuple[Trial, ...]
    examples: dict[str, GraspRecord]
    recognizers: dict[str, Recognizer]
    dataset: Path | None
    model: Path | None
    recording: Path | None
    drift: DriftBelief | None = None
    """What is believed of the drift at the end; None where it is not followed."""
    remarks: tuple[str, ...] = ()
    """What an operator must know, as that the sensors have drifted."""
    report: Path | None = None
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def records(self) -> tuple[GraspRecord, ...]:
        """All grasps of the identifications, in order."""
        return tuple(record for trial in self.trials for record in trial.found.records)

    @property
    def grasp_s(self) -> float:
        """Mean time in s of a grasp of the identifications, from closing to the end of its ramp."""
        return float(np.mean([record.duration_s for record in self.records] or [0.0]))

    @property
    def n_ended_early(self) -> int:
        """Grasps of the identifications whose ramp ended early, because it sufficed."""
        return sum(record.early is not None for record in self.records)

    def as_json(self) -> dict[str, Any]:
        """Return what ``--json`` writes."""
        return {
            "seconds": round(self.seconds, 2),
            "n_taught": self.n_taught,
            "n_trials": len(self.trials),
            "labels": list(self.labels),
            "default": self.default,
            "recognizers": {
                name: {
                    "accuracy": score.accuracy,
                    "interval": list(score.interval),
                    "n": score.n,
                    "confusion": [list(row) for row in score.confusion],
                    "confusion_columns": [*self.labels, UNKNOWN],
                }
                for name, score in self.scores.items()
            },
            "identifications": [
                {
                    "held": trial.truth,
                    "label": trial.found.label,
                    "probability": trial.found.probability,
                    "n_grasps": len(trial.found.records),
                    "shape": None if trial.found.shape is None else trial.found.shape.as_dict(),
                }
                for trial in self.trials
            ],
            "grasps_per_trial": float(
                np.mean([float(len(trial.found.records)) for trial in self.trials] or [0.0])
            ),
            "grasp_seconds": self.grasp_s,
            "ramps_ended_early": self.n_ended_early,
            "drift": None if self.drift is None else drift_values(self.drift),
            "remarks": list(self.remarks),
            "report": None if self.report is None else str(self.report),
            "recording": None if self.recording is None else str(self.recording),
            "dataset": None if self.dataset is None else str(self.dataset),
            "model": None if self.model is None else str(self.model),
            **self.extra,
        }


def score(truths: Sequence[str], answers: Sequence[str], labels: Sequence[str]) -> Score:
    """Count answers against the truth."""
    columns = [*labels, UNKNOWN]
    counts = np.zeros((len(labels), len(columns)), dtype=int)
    for truth, answer in zip(truths, answers, strict=True):
        if truth in labels:
            place = columns.index(answer) if answer in columns else len(labels)
            counts[labels.index(truth), place] += 1
    n, n_right = int(counts.sum()), int(np.trace(counts))
    return Score(
        accuracy=n_right / n if n else float("nan"),
        interval=wilson_interval(n_right, n) if n else (0.0, 1.0),
        n=n,
        n_right=n_right,
        confusion=tuple(tuple(row) for row in counts.tolist()),
    )

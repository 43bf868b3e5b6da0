"""The main job: teach the objects, then identify each of them several times."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cell.build import Cell
from cell.choosing import ActiveChooser, memory_sections, remember_grasps
from cell.collect import GraspRecord
from cell.config import CellConfig
from cell.dataset import write_dataset
from cell.early_heads import heads_sections, wanted_heads
from cell.identification import Identification
from cell.jobs.progress import Progress
from cell.jobs.teaching import teach, train
from cell.model import save_model
from cell.sequence import plan
from cell.shapes import ReadShape, shape_reader
from cell.shift import Shift, drift_values
from recognition.drift_following import DriftBelief
from recognition.early import EarlyHeads
from recognition.evaluation import wilson_interval
from recognition.grasp import Grasp
from recognition.pose_memory import PoseMemory
from recognition.recognizer import UNKNOWN, Posterior, Recognizer
from recognition.recognizers import make_trainer

BASELINE = "level_check"
"""The paper's own classifier, told from one grasp, as in its Table 1."""


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


def teach_and_identify(
    cell: Cell,
    config: CellConfig,
    *,
    labels: Sequence[str],
    n_teach: int,
    n_trials: int,
    folder: Path,
    progress: Progress,
    recognizer: Recognizer | None = None,
    early: EarlyHeads | None = None,
    memory: PoseMemory | None = None,
) -> MainResult:
    """Teach each object, train, identify each object ``n_trials`` times; write data set and model.

    With a ``recognizer`` nothing is taught, ``early`` are its heads for ramps that end early, and
    ``memory`` is what an active sequence goes by.
    Plans of teaching and of identifying are drawn with different seeds, so no pose and force is met
    twice.

    Raises
    ------
    CellError, GripperError, TactileError
        What the cell raises; the recording has all that happened until then.
    """
    started_s = time.monotonic()
    default = config.recognition.recognizer
    taught: list[Grasp] = []
    examples: dict[str, GraspRecord] = {}
    recognizers: dict[str, Recognizer] = {}
    dataset: Path | None = None
    model: Path | None = None
    if recognizer is None:
        for number, label in enumerate(labels):
            records = teach(
                cell, config, label, n_teach, seed=_seed(config, 0, number), progress=progress
            )
            taught += [record.grasp for record in records]
            examples[label] = max(records, key=lambda record: record.step.force_n)
        dataset = folder / "taught.npz"
        write_dataset(dataset, taught)
        progress("train", 0, 2)
        recognizers[default] = train(taught, default, use_aperture=config.recognition.use_aperture)
        if config.sequence.kind == "active":
            trainer = make_trainer(default, use_aperture=config.recognition.use_aperture)
            memory = remember_grasps(trainer, taught)
        model = folder / "model.npz"
        early = wanted_heads(taught, recognizers[default], config)
        save_model(
            model,
            recognizers[default],
            trainer_name=default,
            pads=cell.controller.pads,
            sections={**heads_sections(early), **memory_sections(memory)},
        )
        progress("train", 1, 2)
        if default != BASELINE:
            recognizers[BASELINE] = train(taught, BASELINE)
        progress("train", 2, 2)
    else:
        recognizers[default] = recognizer
    read_shape = shape_reader(config)
    shift = Shift(recognizers[default], follow=config.recognition.follow_drift)
    trials, remarks = [], []
    for number, label in enumerate(labels):
        for repeat in range(n_trials):
            trial = _trial(
                cell,
                config,
                recognizers | {default: shift.recognizer},
                memory,
                early=early,
                read_shape=read_shape,
                label=label,
                seed=_seed(config, 1 + repeat, number),
            )
            trials.append(trial)
            remark = shift.answered(trial.found.records)
            if remark:
                cell.controller.remark("drift", remark)
                remarks.append(remark)
            progress(f"identify {label}", repeat + 1, n_trials)
    return MainResult(
        labels=tuple(labels),
        default=default,
        n_taught=len(taught),
        seconds=time.monotonic() - started_s,
        scores=_scores(trials, labels, default),
        trials=tuple(trials),
        examples=examples or {trial.truth: trial.found.records[0] for trial in trials},
        recognizers=recognizers,
        dataset=dataset,
        model=model,
        recording=cell.recording_path,
        drift=shift.belief,
        remarks=tuple(remarks),
    )


def _seed(config: CellConfig, use: int, number: int) -> int:
    """Give each plan its own seed, so that none repeats another."""
    return int(np.random.SeedSequence([config.seed, use, number]).generate_state(1)[0])


def _trial(
    cell: Cell,
    config: CellConfig,
    recognizers: dict[str, Recognizer],
    memory: PoseMemory | None,
    *,
    early: EarlyHeads | None,
    read_shape: ReadShape | None,
    label: str,
    seed: int,
) -> Trial:
    default = config.recognition.recognizer
    cell.controller.present(label)
    found = cell.controller.identify(
        recognizers[default],
        plan(config.sequence, config.sequence.max_grasps, seed=seed),
        early=early,
        chooser=None if memory is None else ActiveChooser(memory, config.sequence, seed=seed),
        read_shape=read_shape,
    )
    first = found.records[0].grasp
    return Trial(
        truth=label,
        found=found,
        first={
            name: found.posteriors[0] if name == default else recognizer.posterior(first)
            for name, recognizer in recognizers.items()
        },
    )


def _scores(trials: Sequence[Trial], labels: Sequence[str], default: str) -> dict[str, Score]:
    answers: dict[str, list[str]] = {default: [trial.found.label for trial in trials]}
    for name in trials[0].first if trials else ():
        key = f"{name}_one_grasp" if name == default else name
        answers[key] = [trial.first[name].decision() for trial in trials]
    truths = [trial.truth for trial in trials]
    return {name: score(truths, given, labels) for name, given in answers.items()}


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

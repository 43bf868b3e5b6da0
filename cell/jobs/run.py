"""The main job: teaches the objects, then identifies each of them several times."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cell.build import Cell
from cell.config.model import CellConfig
from cell.control.identification import Identification
from cell.control.records import GraspRecord
from cell.jobs.collection import Collection
from cell.jobs.common import Progress, progress_of
from cell.jobs.identify import identify
from cell.jobs.teach import teach
from cell.learning.blas import one_blas_thread
from cell.learning.taught_model import TaughtModel
from cell.learning.training import train
from cell.report.build import BASELINE, score_tables
from cell.report.data import ConfusionTable
from recognition.drift.grid import DriftGrid
from recognition.recognizer import Posterior, Recognizer


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One identification, the object that was really held, and answers to its first grasp."""

    truth: str
    """The object that was held."""
    found: Identification
    """The answer of the sequence."""
    first: dict[str, Posterior]
    """Answer of each recogniser to the first grasp alone, by name."""


@dataclass(slots=True, kw_only=True)
class MainResult:
    """Answers, scores and files of the main job."""

    labels: tuple[str, ...]
    """The identified objects."""
    default: str
    """Name of the recogniser that identified."""
    n_taught: int
    """Grasps that were taught."""
    seconds: float
    """Duration in s."""
    scores: dict[str, ConfusionTable]
    """Answers counted, by recogniser."""
    trials: tuple[Trial, ...]
    """The identifications, in order."""
    dataset: Path | None
    model: Path | None
    recording: Path | None
    """Files; None where none was written."""
    drift: DriftGrid | None = None
    """The drift at the end; None where it is not followed."""
    remarks: tuple[str, ...] = ()
    """Messages for the operator, as that the sensors have drifted."""
    report: Path | None = None
    """File of the report; None where none was written."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Further values for ``--json``."""

    @property
    def records(self) -> tuple[GraspRecord, ...]:
        """All grasps of the identifications, in order."""
        return tuple(record for trial in self.trials for record in trial.found.records)

    @property
    def grasp_s(self) -> float:
        """Mean time in s of a grasp of the identifications, from closing to the end of its ramp."""
        return float(np.mean([record.duration_s for record in self.records] or [0.0]))

    def as_json(self) -> dict[str, Any]:
        """Return what ``--json`` writes."""
        return {
            "seconds": round(self.seconds, 2),
            "n_taught": self.n_taught,
            "n_trials": len(self.trials),
            "labels": self.labels,
            "default": self.default,
            "recognizers": {
                name: {
                    key: getattr(counted, key) for key in ("accuracy", "interval", "n", "n_right")
                }
                | {"confusion": counted.counts, "confusion_columns": counted.columns}
                for name, counted in self.scores.items()
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
            "drift": None if self.drift is None else self.drift.values,
            "remarks": self.remarks,
            "report": self.report,
            "recording": self.recording,
            "dataset": self.dataset,
            "model": self.model,
            **self.extra,
        }


@one_blas_thread()
def teach_and_identify(
    cell: Cell,
    config: CellConfig,
    *,
    labels: Sequence[str],
    n_teach: int,
    n_trials: int,
    folder: Path,
    progress: Progress,
    model: TaughtModel | None = None,
) -> MainResult:
    """Teach each object, train, identify each object ``n_trials`` times; write data set and model.

    With a ``model`` nothing is taught. Plans of teaching and of identifying are drawn with
    different seeds, so no pose and force is met twice. Ramps are whole: all recognisers judge the
    same grasps.

    Raises
    ------
    CellError, GripperError, TactileError
        What the cell raises; the recording has all that happened until then.
    """
    started_s = time.monotonic()
    taught: list[Collection] = []
    files: dict[str, Path] = {}
    recognizers: dict[str, Recognizer] = {}
    if model is None:
        model = TaughtModel(config)
        files = {"dataset": folder / "taught.npz", "model": folder / "model.npz"}
        taught = teach_objects(cell, config, model, labels, n_teach, progress=progress)
        model.save_training_set(files["dataset"])
        progress("train", 0, 2)
        model.train()
        model.save(files["model"])
        progress("train", 1, 2)
        recognizers = baseline(config.recognition.recognizer, taught)
        progress("train", 2, 2)
    default = model.check_taught().trainer_name
    recognizers = {default: model.recognizer} | recognizers
    trials = []
    for number, label in enumerate(labels):
        for repeat in range(n_trials):
            seed = _seed(config, 1 + repeat, number)
            found = identify(cell.controller, model, held=label, seed=seed, whole_ramps=True)
            others = {
                name: recognizer.posterior(found.records[0].grasp)
                for name, recognizer in recognizers.items()
                if name != default
            }
            first = {default: found.posteriors[0]} | others
            trials.append(Trial(truth=label, found=found, first=first))
            progress(f"identify {label}", repeat + 1, n_trials)
    return MainResult(
        labels=tuple(labels),
        default=default,
        n_taught=sum(len(one.records) for one in taught),
        seconds=time.monotonic() - started_s,
        scores=score_tables(
            [(trial.truth, trial.found.label, trial.first) for trial in trials], labels, default
        ),
        trials=tuple(trials),
        dataset=files.get("dataset"),
        model=files.get("model"),
        recording=cell.recording_path,
        drift=model.drift,
        remarks=(
            *(str(one) for one in taught if one.n_missed),
            *(f"{one.label}: {one.short}" for one in taught if one.short),
            *(trial.found.remark for trial in trials if trial.found.remark),
        ),
    )


def baseline(default: str, taught: Sequence[Collection]) -> dict[str, Recognizer]:
    """Return the paper's classifier, by its name, taught the same; none where the model is one."""
    if default == BASELINE:
        return {}
    grasps = [grasp for one in taught for grasp in one.grasps]
    return {BASELINE: train(grasps, BASELINE).recognizer}


def teach_objects(
    cell: Cell,
    config: CellConfig,
    model: TaughtModel,
    labels: Sequence[str],
    n_grasps: int,
    *,
    progress: Progress,
) -> list[Collection]:
    """Grasp each object ``n_grasps`` times for the training set of the model.

    Raises as `cell.jobs.teach.teach`.
    """
    taught = [Collection(label=label, n_planned=n_grasps) for label in labels]
    for number, one in enumerate(taught):
        seed = _seed(config, 0, number)
        teach(cell.controller, model, one, seed=seed, on_grasp=progress_of(progress))
    return taught


def _seed(config: CellConfig, use: int, number: int) -> int:
    """Return a seed of its own for each plan, so that none repeats another."""
    return int(np.random.SeedSequence([config.seed, use, number]).generate_state(1)[0])

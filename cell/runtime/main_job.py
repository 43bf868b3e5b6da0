"""The main job: teaches the objects, then identifies each of them several times."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cell.config.model import CellConfig
from cell.control.identification import Identification
from cell.control.part import Part
from cell.learning.parallel import Progress, one_blas_thread
from cell.learning.training import train
from cell.report.confusion import BASELINE, ConfusionTable, score_tables
from cell.runtime.goals import IdentifyGoal, TeachGoal
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.worker import Job
from recognition.drift.drift import DriftGrid
from recognition.grasp import Grasp
from recognition.recognizer import Posterior, Recognizer


@dataclass(slots=True, kw_only=True)
class MainResult:
    """Answers, scores and files of the main job."""

    labels: tuple[str, ...]
    """The identified objects."""
    default: str
    """Name of the recognizer of the identifications."""
    n_taught: int
    """Number of taught grasps."""
    seconds: float
    """Duration in s of teaching and identification."""
    scores: dict[str, ConfusionTable]
    """Answers counted, by recognizer."""
    parts: tuple[Part, ...]
    trials: tuple[Identification, ...]
    """The parts of known objects, in order, and their grasps."""
    model: Path
    recording: Path | None
    """Files; None for no recording."""
    drift: DriftGrid | None = None
    """The drift at the end; None if drift is not followed."""
    remarks: tuple[str, ...] = ()
    """Messages for the operator, for example about sensor drift."""
    report: Path | None = None
    """File of the report; None if not written."""

    @property
    def grasp_s(self) -> float:
        """Mean time in s of a grasp of the identifications, from closing to the end of its ramp."""
        grasps_s = [record.duration_s for trial in self.trials for record in trial.records]
        return float(np.mean(grasps_s or [0.0]))

    def as_json(self) -> dict[str, Any]:
        """Return what ``--json`` writes."""
        n_grasps = [float(part.n_grasps) for part in self.parts] or [0.0]
        names = ("seconds", "n_taught", "labels", "default", "remarks")
        files = ("report", "recording", "model")
        return {
            **{name: getattr(self, name) for name in (*names, *files)},
            "n_trials": len(self.parts),
            "recognizers": {
                name: {
                    key: getattr(counted, key) for key in ("accuracy", "interval", "n", "n_right")
                }
                | {"confusion": counted.counts, "confusion_columns": counted.columns}
                for name, counted in self.scores.items()
            },
            "identifications": self.parts,
            "grasps_per_trial": float(np.mean(n_grasps)),
            "grasp_seconds": self.grasp_s,
            "drift": self.drift and self.drift.values,
        }


def teach_and_identify(
    plugin: TactileCellPlugin,
    config: CellConfig,
    *,
    labels: Sequence[str],
    n_teach: int,
    n_trials: int,
    folder: Path,
    progress: Progress,
) -> MainResult:
    """Teach each object, train, identify each object ``n_trials`` times; write the model.

    Plans of teaching and identifying have different seeds,
    so no pose and force repeats. Ramps are whole: all recognizers get the same grasps.

    Raises
    ------
    CellError, GripperError, TactileError
        Errors of the cell; the recording has everything until then.
    """
    started_s = time.monotonic()
    default, model = config.recognition.recognizer, folder / "model.npz"
    remarks = teach_objects(plugin, config, labels, n_teach, progress)
    progress("train", 0, 2)
    plugin.train()
    plugin.save(model)
    progress("train", 1, 2)
    recognizers = baseline(default, plugin.model.training_set)
    progress("train", 2, 2)
    parts: list[Part] = []
    trials: list[Identification] = []
    plugin.watch_parts(lambda _, named: trials.append(named) if named else None)
    firsts: list[dict[str, Posterior]] = []
    for number, label in enumerate(labels):
        for repeat in range(n_trials):
            seed = _seed(config, 1 + repeat, number)
            parts.append(plugin.run(IdentifyGoal(present=label, seed=seed, whole_ramps=True)))
            first = trials[-1].records[0].grasp
            others = {name: recognizer.posterior(first) for name, recognizer in recognizers.items()}
            firsts.append({default: trials[-1].posteriors[0]} | others)
            progress(f"identify {label}", repeat + 1, n_trials)
    return MainResult(
        labels=tuple(labels),
        default=default,
        n_taught=len(plugin.model.training_set),
        seconds=round(time.monotonic() - started_s, 2),
        scores=score_tables(
            [(p.presented, p.label, first) for p, first in zip(parts, firsts, strict=True)],
            labels,
            default,
        ),
        parts=tuple(parts),
        trials=tuple(trials),
        model=model,
        recording=plugin.recording_path,
        drift=plugin.model.drift,
        remarks=(*remarks, *(part.remark for part in parts if part.remark)),
    )


@one_blas_thread()
def baseline(default: str, grasps: Sequence[Grasp]) -> dict[str, Recognizer]:
    """Return the paper's classifier by its name, taught the same grasps; empty if it is default."""
    return {} if default == BASELINE else {BASELINE: train(grasps, BASELINE).recognizer}


def teach_objects(
    plugin: TactileCellPlugin,
    config: CellConfig,
    labels: Sequence[str],
    n_grasps: int,
    progress: Progress,
) -> list[str]:
    """Grasp each object ``n_grasps`` times for the training set; return remarks about it.

    Call `TactileCellPlugin.train` next. Raises as `TactileCellPlugin.run`.
    """
    missed, unreached = list[str](), list[str]()
    for number, label in enumerate(labels):
        values: dict[str, Any] = {}

        def on_progress(job: Job, values: dict[str, Any] = values) -> None:
            values.update(job.progress)
            progress(f"teach {values['label']}", values["grasps"] + values["missed"], n_grasps)

        seed = _seed(config, 0, number)
        goal = TeachGoal(label=label, grasps=n_grasps, seed=seed, train=False)
        plugin.run(goal, on_progress=on_progress)
        if values["missed"]:
            missed.append(f"{label}: {values['missed']} grasps found no part")
        if values["unreached"]:
            unreached.append(f"{label}: {values['unreached']}")
    return missed + unreached


def _seed(config: CellConfig, use: int, number: int) -> int:
    """Return a different seed for each plan, so that no plan repeats another."""
    return int(np.random.SeedSequence([config.seed, use, number]).generate_state(1)[0])

"""The main job: teach the objects, then identify each of them several times."""

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cell.build import Cell
from cell.choosing import ActiveChooser, memory_sections, remember_grasps
from cell.collect import GraspRecord
from cell.config import CellConfig
from cell.dataset import write_dataset
from cell.early_heads import heads_sections, wanted_heads
from cell.jobs.main_result import MainResult, Score, Trial, score
from cell.jobs.progress import Progress
from cell.jobs.teaching import teach, train
from cell.model import save_model
from cell.sequence import plan
from cell.shapes import ReadShape, shape_reader
from cell.shift import Shift
from recognition.early import EarlyHeads
from recognition.grasp import Grasp
from recognition.pose_memory import PoseMemory
from recognition.recognizer import Recognizer
from recognition.recognizers import make_trainer

BASELINE = "level_check"
"""The paper's own classifier, told from one grasp, as in its Table 1."""


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

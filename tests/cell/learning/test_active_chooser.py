"""Active sequences: the chooser's steps stay in the ranges, and the controller takes them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.config.sequence import SequenceConfig
from cell.control.plan import GraspStep, Pose, plan
from cell.errors import CellError, ModelError
from cell.jobs.identify import identify_on_cell
from cell.learning.active_chooser import ActiveChooser
from cell.learning.model import LoadedModel, load_model
from cell.learning.taught_model import TaughtModel
from cell.learning.training import MEMORY_SECTION, load_pose_memory, train
from recognition.recognizer import UNKNOWN, Posterior
from recognition.statistics.next_grasp import PoseMemory
from tests.cell.conftest import small_config
from tests.cell.learning.test_early import resaved

LABELS = ("ball", "box")
CONFIG = SequenceConfig(kind="active", candidates=16)


def memory() -> PoseMemory:
    """Grasps told the more, the larger their force."""
    rng = np.random.default_rng(0)
    classes = np.arange(80) % 2
    placings = rng.uniform(-2e-3, 2e-3, (80, 5))
    placings[:, 2:4] = rng.uniform(0.0, 6.28, (80, 2))
    placings[:, 4] = rng.uniform(2.0, 8.0, 80)
    told = np.zeros((80, 2))
    told[np.arange(80), classes] = 0.5 * placings[:, 4]
    return PoseMemory(labels=LABELS, commands=placings, log_evidence=told, classes=classes)


def test_the_most_telling_candidate_is_taken_and_the_same_again() -> None:
    chooser = ActiveChooser(memory(), CONFIG, seed=3)
    planned = GraspStep(pose=Pose(), force_n=2.0)
    step = chooser.next_step([], planned)
    assert step == ActiveChooser(memory(), CONFIG, seed=3).next_step([], planned)
    assert 6.5 < step.force_n <= 8.0
    assert abs(step.pose.x_m) <= 2e-3
    likely = Posterior(labels=LABELS, probability=np.array([0.6, 0.4]), unknown=0.1)
    assert chooser.next_step([likely], planned) != step


def test_a_planned_step_that_tells_most_is_kept() -> None:
    best = GraspStep(pose=Pose(), force_n=8.0)
    chooser = ActiveChooser(memory(), SequenceConfig(kind="active", force_n=(2.0, 3.0)), seed=1)
    assert chooser.next_step([], best) == best


def test_active_plans_are_drawn_like_random_ones() -> None:
    assert plan(CONFIG, 3, seed=2) == plan(SequenceConfig(), 3, seed=2)


def test_a_model_with_poses_is_chosen_by_and_one_without_is_refused(
    taught: Any, tmp_path: Path
) -> None:
    bare = load_model(taught.result.model)
    assert load_pose_memory(bare, SequenceConfig()) is None
    with pytest.raises(CellError, match=r"model\.npz has none: train it with .*--poses"):
        load_pose_memory(bare, CONFIG)
    known, path = memory(), tmp_path / "poses.npz"

    def model(sections: Any) -> LoadedModel:
        return load_model(resaved(bare, path, sections))

    kept = load_pose_memory(model({MEMORY_SECTION: known.to_arrays()}), CONFIG)
    assert kept is not None
    assert np.array_equal(kept.commands, known.commands)
    other = {MEMORY_SECTION: known.to_arrays() | {"labels": np.array(["ball", "cone"])}}
    with pytest.raises(ModelError, match="remembers ball, cone"):
        load_pose_memory(model(other), CONFIG)
    bad = {MEMORY_SECTION: known.to_arrays() | {"placings": np.zeros((80, 4))}}
    with pytest.raises(ModelError, match="commands of a memory have shape"):
        load_pose_memory(model(bad), CONFIG)


def test_identify_chooses_by_the_memory_in_the_model(
    taught: Any, make_bench: Any, tmp_path: Path
) -> None:
    bare = load_model(taught.result.model)
    path = resaved(bare, tmp_path / "poses.npz", {MEMORY_SECTION: memory().to_arrays()})
    config = small_config(sequence__kind="active", sequence__max_grasps=1)
    bench = make_bench(config)
    with pytest.raises(CellError, match="--poses"):
        TaughtModel(config, bare)
    bench.controller.start()
    model = TaughtModel.load(config, path)
    told: list[int] = []
    found, held = identify_on_cell(
        bench.cell, config, model, held=None, progress=lambda _task, done, _n: told.append(done)
    )
    assert found.records[0].step.force_n > 6.5
    assert held in ("ball", "box")
    assert found.label in (held, UNKNOWN)
    assert told == [1]


def test_grasps_without_poses_cannot_be_chosen_by(taught: Any) -> None:
    grasps = [replace(grasp, command=None) for grasp in taught.grasps]
    with pytest.raises(CellError, match="none of the grasps has a commanded pose"):
        train(grasps, "shrinkage_lda", poses=True)

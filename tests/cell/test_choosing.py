"""Active sequences: the chooser's steps stay in the ranges, and the controller takes them."""

from typing import Any

import numpy as np
import pytest

from cell.choosing import ActiveChooser, check_active, step_settings
from cell.config_sequence import SequenceConfig
from cell.errors import CellError
from cell.pose import Pose
from cell.sequence import GraspStep, plan
from recognition.next_pose import PoseMemory
from recognition.recognizer import Posterior

LABELS = ("ball", "box")
CONFIG = SequenceConfig(kind="active", candidates=16)


def memory() -> PoseMemory:
    """Grasps told the more, the larger their force."""
    rng = np.random.default_rng(0)
    classes = np.arange(80) % 2
    settings = rng.uniform(-1.0, 1.0, (80, 7))
    settings[:, 6] = rng.uniform(2.0, 8.0, 80)
    told = np.zeros((80, 2))
    told[np.arange(80), classes] = 0.5 * settings[:, 6]
    return PoseMemory(settings=settings, told=told, classes=classes)


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


def test_half_a_turn_changes_nothing() -> None:
    a = step_settings(GraspStep(pose=Pose(x_m=1e-3, rotation_rad=0.3), force_n=4.0))
    b = step_settings(GraspStep(pose=Pose(x_m=1e-3, rotation_rad=0.3 + np.pi), force_n=4.0))
    assert a == pytest.approx(b)
    assert (a[0], a[-1]) == (1.0, 4.0)


def test_active_plans_are_drawn_like_random_ones() -> None:
    assert plan(CONFIG, 3, seed=2) == plan(SequenceConfig(), 3, seed=2)


def test_a_model_without_poses_is_refused() -> None:
    check_active(CONFIG, taught=True)
    check_active(SequenceConfig(), taught=False)
    with pytest.raises(CellError, match="kind is active"):
        check_active(CONFIG, taught=False)


def test_the_controller_takes_the_chosen_steps(bench: Any) -> None:
    class Unsure:
        labels = LABELS

        def posterior(self, grasp: Any) -> Posterior:
            return Posterior(labels=LABELS, probability=np.array([0.5, 0.5]), unknown=0.1)

    class Counting:
        def next_step(self, posteriors: Any, planned: GraspStep, /) -> GraspStep:
            return GraspStep(pose=planned.pose, force_n=2.0 + len(posteriors))

    bench.ready()
    planned = [GraspStep(pose=Pose(), force_n=7.0)] * 2
    found = bench.controller.identify(Unsure(), planned, chooser=Counting())
    assert [record.step.force_n for record in found.records] == [2.0, 3.0]
    assert found.records[1].grasp.force_n[-1] == 3.0

"""The choice of the next grasp: it finds the commands that separate what is still possible."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from recognition.grasp import GraspCommand
from recognition.recognizer import Posterior
from recognition.recognizers import make_trainer
from recognition.statistics import next_grasp
from recognition.statistics.next_grasp import (
    PoseMemory,
    best_next_grasp,
    build_pose_memory,
    expected_loss,
)

LABELS = ("a", "b", "c")


def commands(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    low = [-2e-3, -2e-3, 0.0, 0.0, 2.0]
    return rng.uniform(low, [2e-3, 2e-3, math.tau, math.tau, 8.0], (n, 5))


def memory(n: int = 240, *, turned: bool = True, seed: int = 0) -> PoseMemory:
    """a and b are told apart by a rotation of 0 or half a turn, c by a large x; or vice versa."""
    rng = np.random.default_rng(seed)
    classes = np.arange(n) % 3
    rows = commands(rng, n)
    told = np.zeros((n, 3))
    told[np.arange(n), classes] += 0.2
    ab = classes < 2
    by_turn, by_x = 2.0 * (np.cos(2.0 * rows[:, 2]) + 1.0), 1e3 * (rows[:, 0] + 2e-3)
    told[np.arange(n), classes] += np.where(ab == turned, by_turn, by_x)
    return PoseMemory(labels=LABELS, commands=rows, log_evidence=told, classes=classes)


def posterior(*p: float) -> Posterior:
    return Posterior(labels=LABELS, probability=np.array(p), unknown=0.1)


CANDIDATES = np.array(
    [
        [-2e-3, 0.0, math.pi, 0.0, 5.0],
        [2e-3, 0.0, 0.5 * math.pi, 0.0, 5.0],
        [-2e-3, 0.0, 0.5 * math.pi, 0.0, 5.0],
    ]
)


def test_what_separates_the_likely_labels_is_chosen() -> None:
    known = memory()
    assert best_next_grasp(known, [posterior(0.5, 0.49, 0.01)], CANDIDATES) == 0
    assert best_next_grasp(memory(turned=False), [posterior(0.5, 0.49, 0.01)], CANDIDATES) == 1


def test_without_a_grasp_all_labels_count_alike() -> None:
    loss = expected_loss(memory(), [], CANDIDATES)
    assert loss.shape == (3,)
    assert loss[2] == loss.max()
    assert loss[0] < loss[1]


def test_after_the_first_grasp_one_of_the_best_eighth_will_do() -> None:
    many = commands(np.random.default_rng(8), 24)
    ranked = np.argsort(expected_loss(memory(), [], many))
    assert best_next_grasp(memory(), [], many) == ranked[0]
    even = [posterior(0.3334, 0.3333, 0.3333)]
    ranked = np.argsort(expected_loss(memory(), even, many))
    assert best_next_grasp(memory(), even, many) == min(ranked[:3]) != ranked[0]


def test_half_a_turn_changes_nothing() -> None:
    turned = CANDIDATES + np.array([0.0, 0.0, math.pi, math.pi, 0.0])
    assert expected_loss(memory(), [], turned) == pytest.approx(
        expected_loss(memory(), [], CANDIDATES)
    )


def test_a_setting_that_never_changed_does_not_matter() -> None:
    known = memory()
    fixed = known.commands.copy()
    fixed[:, 4] = 4.0
    same = PoseMemory(
        labels=LABELS, commands=fixed, log_evidence=known.log_evidence, classes=known.classes
    )
    near, far = (
        expected_loss(same, [], CANDIDATES + np.array([0.0, 0.0, 0.0, 0.0, more_n]))
        for more_n in (0.0, 9.0)
    )
    assert near == pytest.approx(far)


def test_labels_share_what_few_grasps_of_each_show() -> None:
    """Four grasps of each of many labels show together that force helps; one label's chance not."""
    rng = np.random.default_rng(5)
    labels = tuple(f"object {i}" for i in range(12))
    classes = np.repeat(np.arange(12), 4)
    rows = commands(rng, 48)
    told = np.zeros((48, 12))
    told[np.arange(48), classes] = 0.5 * rows[:, 4] + rng.normal(0.0, 0.7, 48)
    known = PoseMemory(labels=labels, commands=rows, log_evidence=told, classes=classes)
    likely = Posterior(labels=labels, probability=np.array([0.5, 0.5] + [0.0] * 10), unknown=0.1)
    asked = commands(rng, 200)
    loss = expected_loss(known, [likely], asked)
    assert np.corrcoef(loss, asked[:, 4])[0, 1] < -0.8


def test_labels_are_regressed_as_by_one_system_with_shared_and_own_columns() -> None:
    known = memory(60)
    basis = next_grasp._basis(known, known.commands)
    member = np.eye(3)[known.classes]
    basis -= (member @ (member.T @ basis)) / 20
    own = [basis * member[:, [label]] for label in range(3)]
    design = np.concatenate([basis, *own], axis=1)
    loss = -np.log(
        np.exp(known.log_evidence) / np.exp(known.log_evidence).sum(axis=1, keepdims=True)
    )
    loss = loss[np.arange(60), known.classes]
    loss -= member @ (member.T @ loss) / 20
    shares = [next_grasp._shares(next_grasp._SHARED), *[next_grasp._shares(next_grasp._OWN)] * 3]
    prior = np.diag(next_grasp._NOISE / np.concatenate(shares))
    slopes = np.linalg.solve(design.T @ design + prior, design.T @ loss).reshape(4, -1)
    asked = next_grasp._basis(known, CANDIDATES)
    expected = asked @ (slopes[0] + slopes[1:].mean(axis=0))
    assert expected_loss(known, [], CANDIDATES) == pytest.approx(expected)


def test_what_does_not_fit_is_refused() -> None:
    known = memory()
    with pytest.raises(ValueError, match=r"expected \(m, 5\)"):
        expected_loss(known, [], [[1.0, 2.0]])
    two = Posterior(labels=("a", "b"), probability=np.array([0.5, 0.5]), unknown=0.1)
    with pytest.raises(ValueError, match="3 remembered labels"):
        expected_loss(known, [two], CANDIDATES)
    for change, says in (
        ({"placings": known.commands[:2]}, "shape"),
        ({"told": known.log_evidence * np.nan}, "not finite"),
        ({"classes": known.classes + 1}, "from 0 to 2"),
        ({"classes": known.classes[:0]}, "at least one grasp"),
    ):
        with pytest.raises(ValueError, match=says):
            PoseMemory.from_arrays(known.to_arrays() | change)


def test_it_is_kept_as_arrays() -> None:
    known = memory()
    again = PoseMemory.from_arrays(known.to_arrays())
    ask = [posterior(0.4, 0.3, 0.3)]
    assert expected_loss(again, ask, CANDIDATES) == pytest.approx(
        expected_loss(known, ask, CANDIDATES)
    )


def test_remembering_answers_each_taught_grasp_that_has_a_command(train) -> None:
    rng = np.random.default_rng(3)
    placed = [
        replace(g, command=None if i == 1 else GraspCommand.from_values(row))
        for i, (g, row) in enumerate(zip(train, commands(rng, len(train)), strict=True))
    ]
    trainer = make_trainer("shrinkage_lda")
    known = build_pose_memory(trainer, placed)
    assert len(known.classes) == len(train) - 1
    assert known.commands[0] == pytest.approx(placed[0].command.values)
    assert known.commands[1] == pytest.approx(placed[2].command.values)
    assert np.mean(known.log_evidence.argmax(axis=1) == known.classes) > 0.8
    with pytest.raises(ValueError, match="none of the grasps has a commanded"):
        build_pose_memory(trainer, train)


def test_a_command_is_five_finite_numbers() -> None:
    asked = GraspCommand(x_m=1e-3, y_m=0.0, rotation_rad=1.0, roll_rad=2.0, force_n=5.0)
    assert GraspCommand.from_values(asked.values) == asked
    with pytest.raises(ValueError, match="force_n of a grasp command is nan"):
        GraspCommand.from_values([0.0, 0.0, 0.0, 0.0, math.nan])
    with pytest.raises(ValueError, match="argument"):
        GraspCommand.from_values([0.0])

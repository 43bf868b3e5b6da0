"""Evaluation spread over processes gives what one process gives."""

import os
import signal
from dataclasses import fields

import numpy as np
import pytest

from benchmarks.paper.grasps import PAPER_NOISE, random_grasp
from cell.errors import CellError
from cell.learning.parallel import workers
from recognition.evaluation.evaluation import Evaluation, evaluate
from recognition.grasp import Grasp
from recognition.recognizers import make_trainer
from simulator.world.shapes import PAPER_OBJECTS


@pytest.fixture(scope="module")
def parts() -> tuple[list[Grasp], list[Grasp]]:
    rng = np.random.default_rng(5)
    grasps = [
        [random_grasp(label, rng, PAPER_NOISE, start_ms=i) for i in range(12)]
        for label in list(PAPER_OBJECTS)[:3]
    ]
    return [g for row in grasps for g in row[:6]], [g for row in grasps for g in row[6:]]


@pytest.fixture(scope="module")
def alone(parts: tuple[list[Grasp], list[Grasp]]) -> Evaluation:
    return evaluate([parts], make_trainer("level_check"))


def test_one_process_works_here() -> None:
    seen: list[int] = []
    with workers(1) as mapper:
        list(mapper(seen.append, [3, 1, 2]))
    assert seen == [3, 1, 2]


def test_a_number_of_processes_below_none_is_refused() -> None:
    with pytest.raises(CellError, match="--jobs is -1"), workers(-1):
        pass


@pytest.mark.slow
@pytest.mark.timeout(60)
def test_two_workers_give_the_same_figures(parts, alone) -> None:
    with workers(2) as mapper:
        spread = evaluate([parts], make_trainer("level_check"), mapper=mapper)
    for field in fields(Evaluation):
        np.testing.assert_equal(getattr(spread, field.name), getattr(alone, field.name))


@pytest.mark.slow
def test_work_that_ends_its_process_is_an_error() -> None:
    def dies(_item: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with workers(2) as mapper, pytest.raises(CellError, match="ended at its work"):
        list(mapper(dies, [1, 2, 3]))

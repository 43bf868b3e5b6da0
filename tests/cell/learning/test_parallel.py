"""Evaluation spread over processes, and threads of the linear algebra."""

import os
import signal
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from cell.errors import CellError
from cell.learning.parallel import workers
from cell.learning.taught_model import TaughtModel
from cell.learning.training import train
from cell.runtime.goals import IdentifyGoal
from cell.runtime.tasks import ModelFile, Tasks
from recognition.evaluation.evaluation import Evaluation, evaluate
from recognition.recognizers import make_trainer
from tests.cell.cells import SURE, Scripted
from tests.recognition.conftest import make_grasps
from tests.values import make_pads


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
def test_two_workers_give_the_same_figures() -> None:
    parts = tuple(make_grasps(6, seed=seed, pads=make_pads()) for seed in (1, 2))
    trainer = make_trainer("level_check")
    alone = evaluate([parts], trainer)
    with workers(2) as mapper:
        spread = evaluate([parts], trainer, mapper=mapper)
    for field in fields(Evaluation):
        np.testing.assert_equal(getattr(spread, field.name), getattr(alone, field.name))


@pytest.mark.slow
def test_work_that_ends_its_process_is_an_error() -> None:
    def dies(_item: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with workers(2) as mapper, pytest.raises(CellError, match="ended at its work"):
        list(mapper(dies, [1, 2, 3]))


# -- Threads of the linear algebra -----------------------------------------------------------------


HOST_THREADS = 2


def threads() -> set[int]:
    """Threads of each BLAS library of this process."""
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_training_and_answering_have_one_thread(make_bench, taught, monkeypatch) -> None:
    noting: Any = Scripted(SURE, look=threads)
    noting.fit = lambda _grasps: noting.seen.append(threads()) or noting
    monkeypatch.setattr("cell.learning.training.RECOGNIZERS", {"force_ramp": lambda **_: noting})
    model = TaughtModel(taught.config, training_set=taught.grasps)
    bench = make_bench(taught.config)
    bench.controller.start()
    with threadpool_limits(HOST_THREADS, user_api="blas"):
        assert train([], "force_ramp").recognizer.labels == ("ball", "box")
        model.train()
        Tasks(bench.controller, ModelFile(model, None)).named(IdentifyGoal(present="ball"))
        assert noting.seen == [{1}] * 3
        assert threads() == {HOST_THREADS}

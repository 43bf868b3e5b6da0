"""The linear algebra has one thread while a cell works, and the host's number of threads after."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from cell.jobs.identify import identify
from cell.learning.blas import one_blas_thread
from cell.learning.taught_model import TaughtModel
from cell.learning.training import train
from recognition.recognizer import Posterior

HOST_THREADS = 2


def threads() -> set[int]:
    """Threads of each BLAS library of this process."""
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def host() -> Iterator[None]:
    """A host that has given BLAS two threads."""
    with threadpool_limits(HOST_THREADS, user_api="blas"):
        yield


def test_blocks_within_each_other_end_with_the_outer_one() -> None:
    with one_blas_thread():
        with one_blas_thread():
            assert threads() == {1}
        assert threads() == {1}
    assert threads() == {HOST_THREADS}


def test_an_error_gives_the_threads_back() -> None:
    with pytest.raises(ZeroDivisionError), one_blas_thread():
        raise ZeroDivisionError
    assert threads() == {HOST_THREADS}


def test_training_and_answering_have_one_thread(make_bench, taught, monkeypatch) -> None:
    seen: list[set[int]] = []

    class Noting:
        labels = ("ball", "box")

        def fit(self, grasps: Any) -> "Noting":
            seen.append(threads())
            return self

        def posterior(self, grasp: Any) -> Posterior:
            seen.append(threads())
            return Posterior(labels=self.labels, probability=np.array([1.0, 0.0]), unknown=0.0)

    monkeypatch.setattr("cell.learning.training.RECOGNISERS", {"force_ramp": lambda **_: Noting()})
    assert train([], "force_ramp").recognizer.labels == ("ball", "box")
    model = TaughtModel(taught.config, training_set=taught.grasps)
    model.train()
    bench = make_bench(taught.config)
    bench.controller.start()
    identify(bench.controller, model, presented="ball", seed=1)
    assert seen == [{1}] * 3
    assert threads() == {HOST_THREADS}

"""Shape and size in words; threads of the linear algebra."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from cell.control.part import Part
from cell.learning.blas import one_blas_thread
from cell.learning.shape_reading import after_label, in_words
from cell.learning.taught_model import TaughtModel
from cell.learning.training import train
from cell.runtime.goals import IdentifyGoal
from cell.runtime.tasks import ModelFile, Tasks
from recognition.recognizer import UNKNOWN
from recognition.shape.answer import UNCLEAR
from tests.cell.conftest import SURE, Scripted
from tests.values import make_shape

BAR = make_shape("flat", 10.0, 15.9, half_mm=0.4, n_grasps=2)


def test_what_has_no_name_is_described() -> None:
    pin = make_shape("cylinder", 10.0, half_mm=0.4)
    assert after_label(UNKNOWN, pin) == ": a cylinder of 10.0 mm (9.6 to 10.4)"
    assert after_label("pin", pin) == "; cylinder, 10.0 mm (9.6 to 10.4)"
    assert after_label(UNKNOWN, None) == ""
    assert in_words(replace(pin, kind=UNCLEAR)) == "an unclear shape of 10.0 mm (9.6 to 10.4)"


def test_all_thicknesses_are_told() -> None:
    told = "10.0 mm (9.6 to 10.4) and 15.9 mm (15.5 to 16.3)"
    assert in_words(BAR) == f"a flat object of {told}"
    assert str(BAR) == f"flat, {told}"


def test_a_host_gets_millimetres() -> None:
    part = Part(shape=BAR)
    assert part.size_mm == pytest.approx(15.9)
    fields = part.model_dump()
    assert (fields["shape"], fields["interval_mm"]) == ("flat", pytest.approx((15.5, 16.3)))


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
    noting: Any = Scripted(SURE, look=threads)
    noting.fit = lambda _grasps: noting.seen.append(threads()) or noting
    monkeypatch.setattr("cell.learning.training.RECOGNIZERS", {"force_ramp": lambda **_: noting})
    assert train([], "force_ramp").recognizer.labels == ("ball", "box")
    model = TaughtModel(taught.config, training_set=taught.grasps)
    model.train()
    bench = make_bench(taught.config)
    bench.controller.start()
    Tasks(bench.controller, ModelFile(model, None)).named(IdentifyGoal(present="ball"))
    assert noting.seen == [{1}] * 3
    assert threads() == {HOST_THREADS}

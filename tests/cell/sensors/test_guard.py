"""The guard of a source that another package brings, on a clock of the test."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cell.sensors.guard import GuardedSource
from tactile.errors import FrameTimeout, LinkFault, LinkStateError, PluginFault
from tactile.layout import pinch_layout
from tactile.source import (
    Arrivals,
    FrameStatistics,
    PadZero,
    SourceIdentity,
    SourceStatistics,
    TactileFrame,
)
from tests.fuzz.harness import Clock

LAYOUT = pinch_layout()
LIMIT_S = 10.0
ZERO = PadZero(
    offset_counts=np.zeros(LAYOUT.n_taxels),
    noise_counts=np.ones(LAYOUT.n_taxels),
    bad=np.zeros(LAYOUT.n_taxels, dtype=bool),
)


class Source:
    """A frame source whose next poll does what the test wants."""

    layout = LAYOUT
    sends_forces = False
    statistics = SourceStatistics(frames=FrameStatistics(complete=7))

    def __init__(self) -> None:
        self.then: Callable[[], Arrivals] = lambda: Arrivals((frame(),))
        self.begin: Callable[[], Any] = lambda: None
        self.stopped = threading.Event()

    def start(self) -> SourceIdentity:
        self.begin()
        return SourceIdentity(name="fake")

    def poll(self) -> Arrivals:
        return self.then()

    def set_zero(self, _zero: object) -> None:
        self.zeroed = threading.current_thread()

    def stop(self) -> None:
        self.stopped.set()


def frame(n: int = LAYOUT.n_taxels, kind: type = np.uint16) -> TactileFrame:
    return TactileFrame(t_s=0.0, counter=1, status=0, counts=np.ones(n, dtype=kind))


@pytest.fixture(params=[True, False], ids=["real", "virtual"])
def threaded(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture
def source() -> Source:
    return Source()


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def guard(source: Source, clock: Clock, threaded: bool) -> Iterator[GuardedSource]:
    one = GuardedSource(
        lambda: source,
        name="sensor fake of fake 1.0",
        layout=LAYOUT,
        clock=clock,
        threaded=threaded,
        silence_s=0.1,
        startup_timeout_s=-0.5,
    )
    yield one
    one.stop()


def polled(guard: GuardedSource) -> Arrivals:
    """Poll until something comes: the thread may take more than one period of the loop."""
    for _ in range(20_000):
        if (found := guard.poll()).frames:
            return found
    raise AssertionError("nothing came")


def test_frames_and_counts_come_through(guard: GuardedSource, source: Source) -> None:
    with pytest.raises(LinkStateError):
        guard.poll()
    assert guard.start().name == "fake"
    found = polled(guard)
    assert found.frames[0].counts.sum() == LAYOUT.n_taxels
    assert not found.frames[0].counts.flags.writeable
    assert guard.statistics.frames.complete == 7
    guard.set_zero(None)  # type: ignore[arg-type]
    assert (source.zeroed is threading.current_thread()) == (guard._worker is None)
    guard.stop()
    assert source.stopped.is_set()
    with pytest.raises(LinkStateError):
        guard.poll()


@pytest.mark.parametrize(
    ("then", "named"),
    [
        (lambda: 1 / 0, "fake 1.0 failed: ZeroDivisionError: division by zero. Report it"),
        (lambda: exec("raise SystemExit(3)"), "failed: SystemExit: 3"),
        (lambda: None, "failed: AttributeError"),
        (
            lambda: Arrivals((frame(3),)),
            r"failed: ValueError: a frame of \(3,\) uint16, not \(156,",
        ),
        (lambda: Arrivals((frame(kind=np.float64),)), "float64"),
        (
            lambda: Arrivals((replace(frame(), extra=np.ones((3, 2), np.uint16)),)),
            r"extra of \(3, 2\) uint16, not \(156, k\)",
        ),
    ],
)
def test_what_it_must_not_do_is_a_fault_of_each_call_until_the_next_start(
    guard: GuardedSource, source: Source, then: Any, named: str
) -> None:
    guard.start()
    sound, source.then = source.then, then
    for _ in range(2):
        with pytest.raises(PluginFault, match=named):
            polled(guard)
    source.then = sound
    with pytest.raises(PluginFault, match=named):
        guard.poll()
    guard.stop()
    guard.start()
    assert polled(guard)


def test_its_own_faults_stay_what_they_are(guard: GuardedSource, source: Source) -> None:
    def silent() -> Arrivals:
        raise FrameTimeout("silent")

    guard.start()
    source.then = silent
    for _ in range(2):
        with pytest.raises(FrameTimeout, match="silent"):
            polled(guard)
    source.begin = lambda: 1 / 0
    with pytest.raises(PluginFault, match="ZeroDivisionError"):
        guard.start()


@pytest.mark.parametrize("threaded", [True], indirect=True)
def test_a_poll_that_does_not_return_is_a_fault_and_the_next_start_has_a_thread_of_its_own(
    guard: GuardedSource, source: Source, clock: Clock
) -> None:
    goes_on = threading.Event()

    def hang() -> Arrivals:
        goes_on.wait(LIMIT_S)
        return Arrivals((frame(),))

    guard.start()
    source.then = hang
    assert guard.poll() == Arrivals()
    with pytest.raises(PluginFault, match="has not returned"):
        guard.set_zero(ZERO)
    clock.now_s = 0.09
    assert guard.poll() == Arrivals()
    clock.now_s = 0.11
    for _ in range(2):
        with pytest.raises(PluginFault, match=r"fake 1.0 has not returned for 0.1 s: restart the"):
            guard.poll()
    guard.stop()
    assert not source.stopped.is_set()
    source.then = lambda: Arrivals((frame(),))
    guard.start()
    assert polled(guard)
    goes_on.set()
    assert source.stopped.wait(LIMIT_S)


@pytest.mark.parametrize("threaded", [True], indirect=True)
def test_a_start_that_does_not_return_is_a_fault(guard: GuardedSource, source: Source) -> None:
    goes_on = threading.Event()
    source.begin = lambda: goes_on.wait(LIMIT_S)
    with pytest.raises(LinkFault, match=r"has not returned for 0\.5 s"):
        guard.start()
    goes_on.set()

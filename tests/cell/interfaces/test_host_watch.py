"""A host that falls silent while a job runs."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from cell.config.model import CellConfig
from cell.control.states import CellState
from cell.data.recorder_sink import DirectFile
from cell.errors import RecordingError
from cell.interfaces.plugin.host_watch import HostWatch
from cell.interfaces.plugin.plugin import (
    JobFailed,
    TactileCellPlugin,
    TeachGoal,
)
from cell.interfaces.plugin.worker import JobOutcome
from tests.cell.interfaces.conftest import LIMIT_S, until
from tests.fuzz.harness import Clock


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def silences() -> list[float]:
    return []


@pytest.fixture
def running() -> list[bool]:
    return [True]


@pytest.fixture
def watch(clock: Clock, silences: list[float], running: list[bool]) -> Iterator[HostWatch]:
    made = HostWatch(3600.0, running=lambda: running[0], silent=silences.append, clock=clock)
    yield made
    made.close()


def test_a_silence_is_told_once_and_again_after_the_host_was_heard(
    watch: HostWatch, clock: Clock, silences: list[float]
) -> None:
    for now_s, told in ((3600.0, 0), (3601.0, 1), (9000.0, 1)):
        clock.now_s = now_s
        watch.look()
        assert len(silences) == told
    with watch.calling():
        pass
    clock.now_s += 3601.0
    watch.look()
    assert silences == [3601.0, 3601.0]


def test_a_host_that_waits_in_a_call_is_there(
    watch: HostWatch, clock: Clock, silences: list[float]
) -> None:
    with watch.calling():
        clock.now_s = 5000.0
        watch.look()
    clock.now_s = 8000.0
    watch.look()
    assert silences == []


def test_silence_while_no_job_runs_is_no_silence(
    watch: HostWatch, clock: Clock, silences: list[float], running: list[bool]
) -> None:
    running[0] = False
    clock.now_s = 5000.0
    watch.look()
    assert silences == []


def test_the_job_of_a_silent_host_is_held_and_its_end_can_be_read(
    make_config: Callable[..., CellConfig],
) -> None:
    with TactileCellPlugin(make_config(host_timeout_s=0.2)) as plugin:
        controller = plugin._cell.controller
        job = plugin.start(TeachGoal(label="ball", grasps=1000))
        until(lambda: not plugin._worker.running)
        status = plugin.feedback(job)
        assert status.outcome is JobOutcome.CANCELED
        assert "stopped because the host was silent for 0." in status.error
        assert controller.state in (CellState.HELD, CellState.IDLE)
        with pytest.raises(JobFailed, match="the host was silent"):
            plugin.result(job, 1.0)
        if controller.state is CellState.HELD:
            plugin.release(LIMIT_S)
        assert plugin.status().state_number == CellState.IDLE.number


def test_each_call_of_the_host_is_heard(make_config: Callable[..., CellConfig]) -> None:
    with TactileCellPlugin(make_config(host_timeout_s=1000.0)) as plugin:
        for call in (plugin.alive, plugin.state, plugin.status, plugin.fault, plugin.forget_drift):
            plugin._watch._heard_s = -1.0
            call()
            assert plugin._watch._heard_s > 0.0, call


@pytest.mark.parametrize("when_lost", ["finish", "hold"])
def test_a_lost_recording_ends_the_grasp_as_the_config_says(
    when_lost: str,
    make_bench: Callable[..., Any],
    make_config: Callable[..., CellConfig],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = make_bench(make_config(recording__when_lost=when_lost), folder=tmp_path).ready()
    write = DirectFile.write

    def refuse(_self: DirectFile, _data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(DirectFile, "write", refuse)
    if when_lost == "finish":
        bench.grasp(6.0)
        assert bench.controller.state is CellState.IDLE
    else:
        with pytest.raises(RecordingError, match="No space left"):
            bench.grasp(6.0)
        assert bench.controller.state is CellState.ABORTED
    assert "No space left" in bench.cell.health()["recording"]
    monkeypatch.setattr(DirectFile, "write", write)
    with pytest.raises(RecordingError, match="No space left"):
        bench.cell.close()

"""A host that falls silent while a job runs."""

import re
from pathlib import Path

import pytest

from cell.control.lifecycle import CellLifecycle
from cell.control.states import CellState
from cell.data.recording_reader import read_recording
from cell.errors import RecordingError
from cell.plugin.goals import TeachGoal
from cell.plugin.health import health_values
from cell.plugin.lease import Lease
from cell.plugin.plugin import TactileCellPlugin
from cell.plugin.worker import JobFailed, JobOutcome
from tests.cell.conftest import small_config
from tests.cell.data.test_recording import fill_disk_after
from tests.cell.served import LIMIT_S, until
from tests.fuzz.harness import Clock


def test_a_silence_is_told_once_and_again_after_the_host_was_heard() -> None:
    clock, silences = Clock(), []
    lease = Lease(3600.0, given=lambda _name: None, lost=silences.append, clock=clock)

    def look(now_s: float) -> list[str]:
        clock.now_s = now_s
        lease.check_expiry()
        return [re.findall(r"[0-9.]+", text)[0] for text in silences]

    assert look(1.0) == []
    with lease.calling("host"):
        pass
    assert look(3601.0) == []
    assert look(3602.0) == look(9000.0) == ["3601.00"]
    with lease.calling("host"), lease.calling("host"):
        pass
    with lease.calling("host"):
        assert look(20_000.0) == ["3601.00"]  # a host that waits in a call is there
    assert look(23_600.0) == ["3601.00"]
    assert look(23_601.0) == ["3601.00", "3601.00"]


@pytest.mark.slow
def test_nothing_is_stopped_where_no_job_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    with TactileCellPlugin(small_config(host_timeout_s=0.2)) as plugin:
        stopped: list[str] = []
        with monkeypatch.context() as watched:
            watched.setattr(CellLifecycle, "cancel", lambda _cell, why="": stopped.append(why))
            plugin.alive()
            until(lambda: not plugin._lease.number)
        assert stopped == []
        job = plugin.start(TeachGoal(label="ball", grasps=3))
        assert plugin.result(job, LIMIT_S) == 3


@pytest.mark.slow
def test_the_job_of_a_silent_host_is_held_and_its_end_can_be_read() -> None:
    with TactileCellPlugin(small_config(host_timeout_s=0.2)) as plugin:
        controller = plugin._cell.controller
        job = plugin.start(TeachGoal(label="ball", grasps=1000))
        until(lambda: not plugin._worker.running)
        status = plugin.feedback(job)
        assert status.outcome is JobOutcome.CANCELED
        assert "stopped because 'the host' was silent for 0." in status.error
        assert controller.life.state in (CellState.HELD, CellState.IDLE)
        with pytest.raises(JobFailed, match="'the host' was silent"):
            plugin.result(job, 1.0)
        if controller.life.state is CellState.HELD:
            plugin.release(LIMIT_S)
        assert plugin.status().state_number == CellState.IDLE.number


def test_each_call_of_the_host_is_heard() -> None:
    with TactileCellPlugin(small_config(host_timeout_s=1000.0)) as plugin:
        for call in (plugin.alive, plugin.state, plugin.status, plugin.fault, plugin.forget_drift):
            plugin._lease._heard_s = -1.0
            call()
            assert plugin._lease._heard_s > 0.0, call


@pytest.mark.slow
def test_a_lost_recording_holds_the_grasp_where_the_config_says_so_until_there_is_room(
    make_bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make_bench(small_config(recording__when_lost="hold"), folder=tmp_path).ready()
    room = fill_disk_after(monkeypatch, 0)
    with pytest.raises(RecordingError, match="No space left"):
        bench.grasp(6.0)
    assert bench.controller.life.state is CellState.ABORTED
    assert "No space left" in bench.cell.health()["recording"]
    health = health_values(bench.config, bench.cell, None)["recording"]
    assert (health["level"], health["path"]) == ("bad", str(tmp_path / "recording.mcap"))
    room[0] = 1 << 40
    bench.life.clear()
    bench.controller.release_held()
    bench.life.reset()
    bench.controller.start()
    bench.grasp(6.0)
    assert bench.cell.health()["recording"] is None
    health = health_values(bench.config, bench.cell, None)["recording"]
    assert (health["level"], health["path"]) == ("ok", str(tmp_path / "recording-2.mcap"))
    bench.cell.close()
    assert len(read_recording(tmp_path / "recording-2.mcap").grasps) == 1

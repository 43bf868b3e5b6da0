"""The cell of a command: what is left when its recording ends early."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from cell.config.model import CellConfig
from cell.errors import CellError, CellStopped, ModelError, RecordingError
from cell.interfaces.cli import session
from cell.interfaces.cli.session import running_cell
from cell.recording import recorder
from cell.recording.sink import DirectFile
from cell.runtime.goals import TeachGoal
from cell.runtime.worker import Job
from tests.cell.conftest import quick_config

PRESSED_N = 1.0


@pytest.mark.slow
def test_a_disk_that_is_full_in_a_grasp_loses_neither_the_grip_nor_the_grasp_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = DirectFile.write_whole
    progress: dict[str, Any] = {"grasps": 0}

    def take_one_grasp(file: DirectFile, data: bytes) -> None:
        if progress["grasps"] and grip_n() > PRESSED_N:
            raise OSError(28, "No space left on device")
        write(file, data)

    def show(job: Job) -> None:
        progress.update(job.progress)

    def grip_n() -> float:
        return min(cell.plugin.cell.simulated.world.contact_force_n())

    monkeypatch.setattr(recorder, "CHUNK_BYTES", 1 << 12)
    monkeypatch.setattr(DirectFile, "write_whole", take_one_grasp)
    config, found = quick_config(recording__when_lost="hold"), tmp_path / "found.json"
    with (
        pytest.raises(
            CellError, match=r"(?s)No space left.*the grip is kept; recording so far: "
        ) as told,
        running_cell(config, "teach", tmp_path, config_file=None, json_file=found) as cell,
    ):
        cell.run(TeachGoal(label="ball", grasps=2, train=False), show)
    assert json.loads(found.read_text("utf-8"))["ended_early"] == str(told.value)
    assert grip_n() > PRESSED_N
    assert len(cell.plugin.model.training_set) == 1


@pytest.mark.parametrize(
    ("in_the_job", "at_the_end", "told"),
    [
        (None, [RecordingError], ""),
        (None, [ModelError], "ModelError"),
        (None, [ModelError, RecordingError], "RecordingError"),
        (RecordingError, [], "RecordingError"),
        (CellStopped, [RecordingError], "RecordingError"),
    ],
)
def test_a_job_ends_early_unless_its_recording_alone_fails_at_the_end(
    tmp_path, monkeypatch, in_the_job, at_the_end, told
) -> None:
    def fail(errors: list[type[Exception]]) -> None:
        if errors:
            try:
                fail(errors[:-1])
            finally:
                raise errors[-1](errors[-1].__name__)

    plugin = Mock(recording_path="r.mcap")
    plugin.close = lambda: fail(at_the_end)
    plugin.cell.health.return_value = {}
    plugin.cell.notes, plugin.cell.realtime = (), False
    plugin.cell.controller.zeroing.note = ""
    plugin.status.return_value = Mock(state="IDLE")
    monkeypatch.setattr(session, "TactileCellPlugin", lambda *_arguments, **_options: plugin)
    ended = ""
    try:
        with running_cell(CellConfig(), "run", tmp_path, config_file=None, json_file=None):
            if in_the_job is not None:
                raise in_the_job(in_the_job.__name__)
    except CellError as error:
        ended = str(error).partition("\n")[0]
    assert ended == told

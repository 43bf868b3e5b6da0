"""The cell of a command: what is left when its recording ends early."""

from unittest.mock import Mock

import pytest

from cell.config.model import CellConfig
from cell.errors import CellError, CellStopped, ModelError, RecordingError
from cell.interfaces.cli import session
from cell.interfaces.cli.session import running_cell


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
